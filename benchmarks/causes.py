"""What holds independent learners back: one thing at a time differs from a recipe (docs/study.md).

``python -m benchmarks.causes`` trains what is missing on copper_net, seeds 0 and 1, and writes the table. It can be
stopped and started again: complete runs are kept. These are the seeds of the tuning; the study's own are others.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Iterator, Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console

from benchmarks.document import markdown_table, write_sections
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.evaluation import Entry, compare
from cirl_marl.learners.interface import train_seeds
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.records.files import write_json

DOCUMENT = Path(__file__).parent.parent / "docs" / "study.md"
ARS = "independent_ars"
NETWORK, SEEDS, EPISODES = "copper_net", (0, 1), 16
STEPS = {"independent_ppo": 300_000, ARS: 3_000_000}
"""Environment steps of each run, by recipe: about a minute of processor time."""
BEFORE = {"n_steps": 40, "batch_size": 640, "gamma": 0.98, "gae_lambda": 0.95, "learning_rate": 1e-3}
"""Parameters of the recipe that the study had before."""
OFTEN = {"evaluations": 20}
"""As many as recipes have."""
console = Console(width=None if sys.stdout.isatty() else 140)


@dataclass(frozen=True)
class Variant:
    """What differs from a recipe of the catalogue.

    Attributes:
        what: in words, for the table.
        base: the recipe.
        run: keys of its table ``run``.
        environment: likewise.
        learner: likewise.
        parameters: of the algorithm.
        match: of some agents; without it, as the recipe says.
    """

    what: str
    base: str = "independent_ppo"
    run: Mapping[str, Any] = field(default_factory=dict)
    environment: Mapping[str, Any] = field(default_factory=dict)
    learner: Mapping[str, Any] = field(default_factory=dict)
    parameters: Mapping[str, Any] = field(default_factory=dict)
    match: list[dict[str, Any]] = field(default_factory=list)

    def recipe(self, name: str) -> Recipe:
        """Return the recipe that differs."""
        plain = load_recipe(self.base).model_dump()
        plain["name"] = name
        plain["run"] |= {"evaluations": 5, "episodes": 64, **self.run}
        plain["environment"] |= self.environment
        plain["learner"] |= self.learner
        plain["learner"]["parameters"] |= self.parameters
        plain["match"] = [{**plain["learner"], **each} for each in self.match]
        return Recipe.model_validate(plain)


VARIANTS = {
    "ppo": Variant("PPO, the recipe"),
    "ppo_before": Variant(
        "PPO as before: mixed reward, short rollouts, discount, constant rate",
        environment={"reward": "mixed", "circularity": "end", "circularity_weight": None},
        learner={"bootstrap": True},
        parameters=BEFORE,
        run={"price_rate": 0.0},
    ),
    "ppo_mixed": Variant("reward `mixed`: own set-points count as well", environment={"reward": "mixed"}),
    "ppo_difference": Variant("credit: `mixed_difference`", environment={"reward": "mixed_difference"}),
    "ppo_dear": Variant(
        "price of service fixed, weight 0.5", run={"price_rate": 0.0}, environment={"circularity_weight": 0.5}
    ),
    "ppo_discount": Variant(
        "discount 0.98, λ_GAE 0.95, more expected after the episode",
        parameters={"gamma": 0.98, "gae_lambda": 0.95},
        learner={"bootstrap": True},
    ),
    "ppo_short": Variant("rollouts of 40 steps instead of an episode", parameters={"n_steps": 40}),
    "ppo_batch": Variant("minibatches of 320 instead of 1 280", parameters={"batch_size": 320}),
    "ppo_rate": Variant("learning rate 1e-3 throughout", parameters={"learning_rate": 1e-3}),
    "ppo_plain": Variant("rewards not normalised", learner={"normalise": {"observation": True, "reward": False}}),
    "ppo_noise": Variant(
        "exploration e⁻² instead of e⁻¹ at first", parameters={"policy_kwargs": {"log_std_init": -2.0}}
    ),
    "ppo_often": Variant("20 evaluations: the price of service moves more often", run=OFTEN),
    "ppo_centred": Variant("then the mean reward of all copies taken off", run=OFTEN, learner={"centre_rewards": True}),
    "ppo_critic": Variant("critics see the whole state", learner={"policy": "CentralCriticPolicy"}),
    "ppo_order": Variant(
        "arcs learn in the first half only, nodes throughout", match=[{"kind": "arc", "share_of_steps": 0.5}]
    ),
    "ppo_shared": Variant("one policy for all", learner={"scheme": "shared"}, parameters={"batch_size": 5120}),
    "ppo_joint": Variant("one learner for all", learner={"scheme": "joint"}),
    "ars": Variant("ARS, the recipe", base=ARS),
    "ars_starts": Variant("candidates begin in different states", base=ARS, run={"common_random_numbers": False}),
    "ars_dear": Variant(
        "service dear from the beginning, weight 0.85", base=ARS, environment={"circularity_weight": 0.85}
    ),
    "ars_mixed": Variant("reward `mixed`: own set-points count as well", base=ARS, environment={"reward": "mixed"}),
    "ars_linear": Variant("linear policies", base=ARS, parameters={"policy_kwargs": {"net_arch": []}}),
    "ars_best": Variant("the best quarter of the pairs counts", base=ARS, parameters={"n_top": 8}),
    "ars_small": Variant("perturbations of 0.02", base=ARS, parameters={"delta_std": 0.02}),
    "ars_neighbours": Variant("agents see their neighbours", base=ARS, environment={"observe": "neighbours"}),
    "ars_full": Variant("agents see the whole network", base=ARS, environment={"observe": "full"}),
    "ars_joint": Variant("one learner for all", base=ARS, learner={"scheme": "joint"}),
}


def main(
    out: Annotated[Path, typer.Option(help="Where the training runs are kept.")] = Path("runs/causes"),
    only: Annotated[list[str] | None, typer.Option(help="Variants; default: all.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Variants at a time.")] = 1,
    table: Annotated[bool, typer.Option("--table", help="Train nothing.")] = False,
    document: Annotated[Path, typer.Option(help="With a section 'causes'.")] = DOCUMENT,
) -> None:
    """Train what is missing and write the table."""
    for name in only or ():
        if name not in VARIANTS:
            raise CirlError(unknown_name("variant", name, VARIANTS))
    names = only or list(VARIANTS)
    missing = [name for name in names if not table and not _is_done(out, name)]
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn")) as pool:
        for done in as_completed([pool.submit(_train, out, name) for name in missing]):
            console.print(f"{done.result()}: trained", highlight=False)
    rows = [row for name in names if _is_done(out, name) for row in _row(out, name)]
    columns = ("what differs", "steps", "λ̄ (kt)", "lowest service", "gap", "CPU min a seed")
    write_sections(document, {"causes": markdown_table(columns, rows)})


def _is_done(out: Path, name: str) -> bool:
    """Whether every seed has a complete run of the variant of now."""
    found = [RunDirectory(f"{out / name}-seed{seed}") for seed in SEEDS]
    if not all((run.path / "causes.json").is_file() for run in found):
        return False
    now = VARIANTS[name].recipe(name)
    return all((run.config.steps, run.config.recipe) == (_steps(name), now) for run in found)


def _steps(name: str) -> int:
    return STEPS[VARIANTS[name].base]


def _train(out: Path, name: str) -> str:
    """Train all seeds of a variant together."""
    for seed in SEEDS:
        shutil.rmtree(f"{out / name}-seed{seed}", ignore_errors=True)
    began = time.process_time()
    train_seeds(NETWORK, VARIANTS[name].recipe(name), seeds=SEEDS, directory=out / name, steps=_steps(name))
    minutes = (time.process_time() - began) / 60 / len(SEEDS)
    for seed in SEEDS:
        write_json(Path(f"{out / name}-seed{seed}") / "causes.json", {"cpu_minutes": minutes})
    return name


def _row(out: Path, name: str) -> Iterator[tuple[str, ...]]:
    """Yield a row of the table: what each seed's chosen checkpoint does in the same fresh episodes."""
    runs = [Path(f"{out / name}-seed{seed}") for seed in SEEDS]
    entries = [entry for entry in compare(runs, ("neutral",), episodes=EPISODES).entries if entry.run is not None]
    minutes = json.loads((runs[0] / "causes.json").read_text())["cpu_minutes"]

    def each(figure: str) -> str:
        return ", ".join(figure.format(**_figures(entry)) for entry in entries)

    figures = each("{circularity:.1f}"), each("{service:.3f}"), each("{gap:.1%}")
    yield VARIANTS[name].what, f"{_steps(name):,}", *figures, f"{minutes:.1f}"


def _figures(entry: Entry) -> dict[str, float]:
    run, gap = entry.rollout, entry.gap
    assert gap is not None
    return {
        "circularity": float(run.episode_circularity.mean()),
        "service": float(run.episode_levels.mean(axis=0).min()),
        "gap": float(np.mean(gap)),
    }


if __name__ == "__main__":
    typer.run(main)
