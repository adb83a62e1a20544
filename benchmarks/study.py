"""The study: every way of learning and controlling, on every network, against the proven bound (docs/study.md).

``python benchmarks/study.py`` trains what is missing, compares, and writes tables and pictures into the document. It
can be stopped and started again: complete runs are kept. ``--only NETWORK`` restricts it, ``--table`` trains nothing.
"""

from __future__ import annotations

import json
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from matplotlib.figure import Figure
from rich.console import Console
from rich.progress import Progress

from benchmarks.document import made_with, write_sections
from cirl_marl.controllers import LQR, Controller, Neutral
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.drawing.style import SERIES, dressed, save
from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import CirlError, RunError, unknown
from cirl_marl.evaluation import Comparison, Row, compare, yardstick
from cirl_marl.evaluation.comparison import starting_stocks
from cirl_marl.evaluation.statistics import Aggregate, interquartile_mean, over_episodes, over_seeds
from cirl_marl.learners import RunDirectory, load_recipe, train
from cirl_marl.network import Floats
from cirl_marl.optimum import gap
from cirl_marl.optimum.mpc import MPC, SERVICE_FIRST
from cirl_marl.records.files import write_json
from cirl_marl.report.comparison import write_comparison

DOCUMENT = Path(__file__).parent.parent / "docs" / "study.md"
SEEDS, EPISODES = 5, 16
RESULTS = Path(__file__).parent / "results" / "study"
console = Console(width=None if sys.stdout.isatty() else 140)


@dataclass(frozen=True)
class Case:
    """What is compared on a network.

    Attributes:
        steps: environment steps of the recipes that learn here; a joint learner computes least per step.
        controllers: that need no training and fit the network.
        options: of the environment, for the recipes that would be paid by ``team``.
    """

    steps: dict[str, int]
    controllers: tuple[str, ...] = ("random", "neutral")
    options: dict[str, Any] = field(default_factory=dict)


RECIPES = ("independent_ppo", "difference_ppo", "shared_ppo", "shared_ars", "mappo", "joint_ppo", "joint_sac")
LARGE = {
    "independent_ppo": 60_000,
    "difference_ppo": 60_000,
    "shared_ppo": 200_000,
    "mappo": 200_000,
    "joint_ppo": 6_000_000,
    "joint_sac": 30_000,
}
SMALL = dict.fromkeys(LARGE, 10_240) | {"joint_sac": 7_680}
CASES = {
    "copper_net": Case(LARGE, ("random", "neutral", "mpc", "optimum")),
    "carbo_net": Case(
        LARGE | {"mappo": 1_000_000, "joint_ppo": 1_500_000, "shared_ars": 2_000_000},
        ("random", "neutral", "mpc", "optimum"),
    ),
    "net_zero": Case(SMALL),
    "solids_net": Case(SMALL, ("random", "neutral", "scripted"), {"reward": "mixed"}),
}
LQR_CASES: tuple[tuple[str, str, dict[str, float] | None], ...] = (
    ("copper_net", "use_to_collection", None),
    ("carbo_net", "urban_to_capture", {"urban_air": 637.2}),
)
"""Networks, the one agent that acts, and set-points other than the definition's; LQR is for flows that are set."""
CREDIT = ("circularity", "difference")
"""Rewards that the section on difference rewards sets against each other."""
CREDIT_STEPS = 30_720


@dataclass(frozen=True)
class Job:
    """One training run of the study."""

    network: str
    recipe: str
    seed: int
    steps: int
    options: tuple[tuple[str, Any], ...]
    directory: Path

    def is_done(self) -> bool:
        """Return whether a complete run is there, of as many steps, by the recipe and in the network of now."""
        if not self._note.is_file():
            return False
        run, now = RunDirectory(self.directory), load_recipe(self.recipe)
        config = run.config
        found = (config.steps, config.envs, config.options, config.recipe.learner, config.recipe.match)
        wanted = (self.steps, now.run.envs, now.environment | dict(self.options), now.learner, now.match)
        return found == wanted and run.network() == load_network(self.network)

    @property
    def _note(self) -> Path:
        """What is written when the run is complete."""
        return self.directory / "study.json"

    def run(self) -> float:
        """Train, unless it is done; return the minutes that it took."""
        if self.is_done():
            return 0.0
        shutil.rmtree(self.directory, ignore_errors=True)
        began, spent = time.perf_counter(), time.process_time()
        train(
            self.network,
            self.recipe,
            directory=self.directory,
            seed=self.seed,
            steps=self.steps,
            **dict(self.options),
        )
        minutes = (time.perf_counter() - began) / 60
        write_json(self._note, {"minutes": minutes, "cpu_minutes": (time.process_time() - spent) / 60})
        return minutes


def main(
    out: Annotated[Path, typer.Option(help="Where the training runs are kept.")] = Path("runs/study"),
    only: Annotated[list[str] | None, typer.Option(help="Networks; default: all of the study.")] = None,
    recipes: Annotated[list[str] | None, typer.Option("--recipe", help="Recipes; default: all of the study.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help="Training seeds 0, 1, …")] = SEEDS,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of every run, for a trial.")] = None,
    episodes: Annotated[int, typer.Option(min=2, help="Evaluation episodes of each run.")] = EPISODES,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time.")] = 2,
    table: Annotated[bool, typer.Option("--table", help="Train nothing: only what is complete is compared.")] = False,
    write: Annotated[
        Path | None, typer.Option(help="Folder of the document; default: docs, of a trial OUT/trial.")
    ] = None,
) -> None:
    """Train what is missing, compare, and write the tables and pictures of the document.

    With fewer recipes, seeds, steps or episodes than the study has it is a trial, which writes a document of its own.
    """
    names = only or list(CASES)
    trial = bool(recipes or steps) or (seeds, episodes) != (SEEDS, EPISODES)
    folder = write or (out / "trial" if trial else DOCUMENT.parent)
    results = RESULTS if folder == DOCUMENT.parent else folder / "results"
    document, pictures = folder / DOCUMENT.name, folder / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    if not document.exists():
        shutil.copyfile(DOCUMENT, document)
    chosen = recipes or list(RECIPES)
    for name, known in (*((n, CASES) for n in names), *((r, RECIPES) for r in chosen)):
        if name not in known:
            raise CirlError(unknown("part of the study", name, known))
    planned = [job for name in names for job in _jobs(out, name, chosen, seeds, steps)]
    credit = list(_credit_jobs(out, seeds, steps)) if "copper_net" in names else []
    if not table:
        _train([*planned, *credit], jobs)
    sections = {}
    for name in names:
        runs = [job.directory for job in planned if job.network == name and job.is_done()]
        comparison = _compare(name, runs, episodes)
        write_comparison(comparison, results / name, seeds=seeds, recipes=chosen)
        shutil.copyfile(results / name / "comparison.png", pictures / f"study_{name}.png")
        sections[name] = "\n".join(_table(comparison, runs))
    done = [job for job in credit if job.is_done()]
    if {dict(job.options)["reward"] for job in done} == set(CREDIT):
        sections["difference"] = "\n".join(_credit_table(done, pictures))
    if {network for network, *_ in LQR_CASES} <= set(names):
        sections["lqr"] = "\n".join(_lqr_table(episodes))
    sections["made"] = made_with()
    write_sections(document, sections)


def _jobs(out: Path, network: str, recipes: Sequence[str], seeds: int, steps: int | None) -> Iterator[Job]:
    case = CASES[network]
    for recipe in (each for each in recipes if each in case.steps):
        found = load_recipe(recipe)
        length = steps or case.steps[recipe]
        options = case.options if found.environment.get("reward") == "team" else {}
        for seed in range(seeds):
            yield Job(network, recipe, seed, length, tuple(options.items()), out / network / f"{recipe}-{seed}")


def _credit_jobs(out: Path, seeds: int, steps: int | None) -> Iterator[Job]:
    for reward in CREDIT:
        for seed in range(seeds):
            where = out / "credit" / f"{reward}-{seed}"
            yield Job("copper_net", "independent_ppo", seed, steps or CREDIT_STEPS, (("reward", reward),), where)


def _train(jobs: Sequence[Job], workers: int) -> None:
    """Run what is missing, several at a time."""
    missing = [job for job in jobs if not job.is_done()]
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("training", total=len(missing))
        with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
            running = {pool.submit(job.run): job for job in missing}
            for future in as_completed(running):
                job = running[future]
                console.print(f"{job.directory}: {future.result():.1f} min", soft_wrap=True, highlight=False)
                progress.advance(task)


def _compare(network: str, runs: Sequence[Path], episodes: int) -> Comparison:
    if not runs:
        raise RunError(f"{network}: no training run of the study is complete")
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"comparing on {network}", total=1.0)
        return compare(
            runs,
            CASES[network].controllers,
            episodes=episodes,
            progress=lambda what, share: progress.update(task, completed=share, description=f"{network}: {what}"),
        )


def _table(comparison: Comparison, runs: Sequence[Path]) -> Iterator[str]:
    unit = comparison.network.mass_unit
    heads = (f"λ̄ ({unit})", "gain over neutral", "service level", f"bound ({unit})", "gap to the bound")
    yield f"| | {' | '.join(heads)} | seeds | steps | CPU min |"
    yield "|-|-|-|-|-|-|-|-|-|"
    for row in sorted(comparison.rows, key=lambda row: bool(row.seeds)):
        yield f"| {row.name} | " + " | ".join(_cells(row, runs)) + " |"
    yield ""
    yield f"{comparison.episodes} episodes each, the same for all."
    yield ""
    yield f"![λ̄ against service](pictures/study_{comparison.network.name}.png)"
    if comparison.yardstick.reason:
        yield ""
        yield f"No bound: {comparison.yardstick.reason}."


def _cells(row: Row, runs: Sequence[Path]) -> Iterator[str]:
    yield _figure(row.figure("circularity"), "{:.4g}")
    yield _figure(row.figure("gain"), "{:+.1%}")
    yield _figure(row.figure("service"), "{:.4f}")
    yield _figure(row.figure("bound"), "{:.4g}", interval=False)
    yield _figure(row.figure("gap"), "{:.1%}")
    if not row.seeds:
        yield from ("", "", "")
        return
    mine = [entry.run for entry in row.entries if entry.run is not None]
    notes = [json.loads((run.path / "study.json").read_text()) for run in mine]
    yield str(len(row.seeds))
    yield f"{mine[0].config.steps:,}"
    yield f"{np.mean([note['cpu_minutes'] for note in notes]):.1f}"


def _figure(found: Aggregate | None, form: str, *, interval: bool = True) -> str:
    if found is None or not np.isfinite(found.value):
        return "—"
    if not interval or not np.isfinite(found.low):
        return form.format(found.value)
    return f"{form.format(found.value)} [{form.format(found.low)}, {form.format(found.high)}]"


def _lqr_table(episodes: int) -> Iterator[str]:
    """Compare LQR, MPC and neutral control where a single agent acts."""
    yield "| network | who acts | controller | set-points | λ̄ | service level | bound | gap to the bound |"
    yield "|-|-|-|-|-|-|-|-|"
    for name, agent, set_points in LQR_CASES:
        env = VectorEnv(name, num_envs=episodes, agents=[agent])
        starts = starting_stocks(env, first_seed(0))
        acting: dict[str, Controller] = {
            "neutral": Neutral(),
            "lqr": LQR(set_points=set_points),
            "mpc": MPC(service_weight=SERVICE_FIRST),
        }
        runs = {label: rollout(env, each, seed=first_seed(0)) for label, each in acting.items()}
        measure = yardstick(env.network, env.agents, starts, [run.episode_levels for run in runs.values()])
        for label, run in runs.items():
            proved = measure.at(starts, run.episode_levels)
            assert proved is not None
            left = over_episodes(gap(proved, run.episode_circularity))
            cells = [_figure(over_episodes(each), "{:.4g}") for each in (run.episode_circularity, run.episode_service)]
            shown = _figure(over_episodes(proved), "{:.4g}", interval=False)
            who = f"{name} | {agent} | {label} | {_set_points(acting[label], env.network.mass_unit)}"
            yield f"| {who} | {' | '.join(cells)} | {shown} | {_figure(left, '{:.1%}')} |"


def _set_points(controller: Controller, unit: str) -> str:
    """Name the stocks that LQR has been given set-points for, and these; others pursue none."""
    if not isinstance(controller, LQR):
        return ""
    given = zip(controller.system.states, controller.system.set_points, strict=True)
    return ", ".join(f"{node} {value:g} {unit}" for node, value in given if np.isfinite(value))


def _credit_table(jobs: Sequence[Job], pictures: Path) -> Iterator[str]:
    """Compare learning curves of λ̄ under team λ and difference rewards; draw them."""
    curves = {reward: [_curve(job) for job in jobs if dict(job.options)["reward"] == reward] for reward in CREDIT}
    _draw_credit(curves, pictures)
    start = interquartile_mean([curve[1][0] for each in curves.values() for curve in each])
    best = max(interquartile_mean([curve[1][-1] for curve in each]) for each in curves.values())
    yield "| reward | λ̄ of the last training episodes (kt) | steps to half of the better one's gain | seeds |"
    yield "|-|-|-|-|"
    for reward, each in curves.items():
        last = over_seeds([[float(curve[1][-3:].mean()) for curve in each]])
        half = [_first(curve, (start + best) / 2) for curve in each]
        reached = [steps for steps in half if steps is not None]
        every = len(reached) == len(half)
        when = _figure(over_seeds([reached]), "{:,.0f}") if every else f"reached by {len(reached)} of {len(half)} seeds"
        yield f"| {reward} | {_figure(last, '{:.4g}')} | {when} | {len(each)} |"
    yield ""
    yield "![λ̄ while learning](pictures/study_difference.png)"


def _curve(job: Job) -> tuple[Floats, Floats]:
    """Return environment steps and λ̄ of the episodes of a training run."""
    columns = RunDirectory(job.directory).metrics()
    return np.array(columns["env_steps"]), np.array(columns["circularity"])


def _first(curve: tuple[Floats, Floats], level: float) -> float | None:
    reached = np.flatnonzero(curve[1] >= level)
    return float(curve[0][reached[0]]) if len(reached) else None


def _draw_credit(curves: dict[str, list[tuple[Floats, Floats]]], pictures: Path) -> None:
    drawing = Figure(figsize=(7.0, 3.6), layout="constrained")
    axes = drawing.add_subplot()
    for (reward, each), colour in zip(curves.items(), SERIES, strict=False):
        values = np.array([curve[1] for curve in each])
        axes.plot(each[0][0], np.median(values, axis=0), label=f"{reward} (median and range of seeds)", color=colour)
        axes.fill_between(each[0][0], values.min(axis=0), values.max(axis=0), color=colour, alpha=0.2, linewidth=0)
    axes.set_xlabel("environment steps")
    dressed(axes, title="λ̄ while learning, copper_net", ylabel="λ̄ of training episodes (kt)")
    axes.legend(frameon=False, fontsize=8)
    save(drawing, pictures / "study_difference.png")


if __name__ == "__main__":
    typer.run(main)
