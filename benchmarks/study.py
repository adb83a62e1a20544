"""The study: every way of learning and controlling, on every network, against the proven bound (docs/study.md).

``python benchmarks/study.py`` trains what is missing, compares, and writes tables and pictures into the document. It
can be stopped and started again: complete runs are kept. ``--only NETWORK`` restricts it, ``--table`` trains nothing;
rows of recipes that are not compared stay as they are.
"""

from __future__ import annotations

import csv
import json
import shutil
import sys
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress

from benchmarks.document import made_with, markdown_table, table_rows, write_sections
from cirl_marl.controllers import LQR, Controller, Neutral
from cirl_marl.controllers.rollout import first_seed, rollout, starting_stocks
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RunError, unknown_name
from cirl_marl.evaluation import Comparison, Row, compare, solve_baseline
from cirl_marl.evaluation.statistics import Aggregate, over_episodes, over_seeds
from cirl_marl.jobs import JobStatus, Tell, raise_first, run_jobs
from cirl_marl.learners.interface import prepare, train_seeds
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Floats
from cirl_marl.optimum import gap
from cirl_marl.optimum.mpc import MPC, SERVICE_FIRST
from cirl_marl.records.files import write_json, write_table
from cirl_marl.report.curves import PointSeries, save_fronts
from cirl_marl.report.tradeoffs import write_comparison

DOCUMENT = Path(__file__).parent.parent / "docs" / "study.md"
FIRST_SEED, SEEDS, EPISODES = 300, 5, 256
"""No tuning looked at these training seeds; ``python -m benchmarks.causes`` has others."""
LQR_EPISODES = 64
"""Of the table where one agent acts, in which MPC plans."""
RESULTS = Path(__file__).parent / "results" / "study"
console = Console(width=None if sys.stdout.isatty() else 140)


@dataclass(frozen=True)
class Case:
    """What is compared on a network: all recipes with the steps of their files.

    Attributes:
        recipes: names in the catalogue.
        controllers: that need no training and fit the network.
        service: level of each that model predictive control and plans are asked for.
        episodes: of each policy, where a plan for each start takes long.
    """

    recipes: tuple[str, ...]
    controllers: tuple[str, ...] = ("random", "neutral")
    service: float = 0.99
    episodes: int = EPISODES
    options: dict[str, Any] = field(default_factory=dict)


RECIPES = (
    "exact_gradients",
    "independent_ars",
    "independent_ppo",
    "central_critic_ppo",
    "guided_ppo",
    "guided_td3",
    "shared_ppo",
    "mappo",
    "joint_ppo",
)
CASES = {
    "copper_net": Case(RECIPES),
    "carbo_net": Case(RECIPES),
}
LQR_CASES: tuple[tuple[str, str, dict[str, float] | None], ...] = (
    ("copper_net", "use_to_collection", None),
    ("carbo_net", "urban_to_capture", {"urban_air": 637.2}),
)
"""Networks, the one agent that acts, and set-points other than the definition's; LQR is for flows that are set."""


@dataclass(frozen=True)
class Job:
    """The training runs of a recipe in a network, all seeds together."""

    network: str
    recipe: str
    seeds: tuple[int, ...]
    options: tuple[tuple[str, Any], ...]
    directory: Path

    @property
    def runs(self) -> list[RunDirectory]:
        """The run of each seed."""
        return [RunDirectory(f"{self.directory}-seed{seed}") for seed in self.seeds]

    def is_done(self) -> bool:
        """Return whether complete runs are there, by the recipe and in the network of now."""
        if not all(_note(run).is_file() for run in self.runs):
            return False
        now = prepare(self.network, self.recipe, seed=self.seeds[0], **dict(self.options))
        kept = {"seed", "definition_sha256", "data_sha256", "region", "origins"}  # the network is compared itself
        wanted = now.config.model_dump(exclude=kept)
        return all(
            run.config.model_dump(exclude=kept) == wanted and run.network() == load_network(self.network)
            for run in self.runs
        )

    @property
    def name(self) -> str:
        """Name of its log."""
        return f"{self.network}-{self.recipe}"

    def run(self, tell: Tell) -> None:
        """Train from the beginning."""
        for run in self.runs:
            shutil.rmtree(run.path, ignore_errors=True)
        began, spent = time.perf_counter(), time.process_time()
        train_seeds(
            self.network,
            self.recipe,
            seeds=self.seeds,
            directory=self.directory,
            report=lambda now: tell("training", now.env_steps, max(now.total, 1)),
            **dict(self.options),
        )
        minutes = (time.perf_counter() - began) / 60
        for run in self.runs:
            each = (time.process_time() - spent) / 60 / len(self.seeds)
            write_json(_note(run), {"minutes": minutes / len(self.seeds), "cpu_minutes": each})


def _note(run: RunDirectory) -> Path:
    """What is written when all runs are complete."""
    return run.path / "study.json"


def main(
    out: Annotated[Path, typer.Option(help="Where the training runs are kept.")] = Path("runs/study"),
    only: Annotated[list[str] | None, typer.Option(help="Networks; default: all of the study.")] = None,
    recipes: Annotated[list[str] | None, typer.Option("--recipe", help="Recipes; default: all of the study.")] = None,
    seeds: Annotated[int, typer.Option(min=1, help=f"Training seeds {FIRST_SEED}, {FIRST_SEED + 1}, …")] = SEEDS,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of every run, for a trial.")] = None,
    episodes: Annotated[int, typer.Option(min=2, help="Evaluation episodes of each run.")] = EPISODES,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time.")] = 2,
    table: Annotated[bool, typer.Option("--table", help="Train nothing: only what is complete is compared.")] = False,
    write: Annotated[
        Path | None, typer.Option(help="Folder of the document; default: docs, of a trial OUT/trial.")
    ] = None,
) -> None:
    """Train what is missing, compare, and write the tables and pictures of the document.

    With other seeds, steps or episodes than the study has it is a trial, which writes a document of its own.
    """
    names = only or list(CASES)
    trial = bool(steps) or (seeds, episodes) != (SEEDS, EPISODES)
    folder = write or (out / "trial" if trial else DOCUMENT.parent)
    results = RESULTS if folder == DOCUMENT.parent else folder / "results"
    if results == RESULTS and out.is_absolute():
        raise CirlError(f"--out {out}: results name it; give one relative to the project")
    document, pictures = folder / DOCUMENT.name, folder / "pictures"
    pictures.mkdir(parents=True, exist_ok=True)
    if not document.exists():
        shutil.copyfile(DOCUMENT, document)
    chosen = recipes or list(RECIPES)
    for name, known in (*((n, CASES) for n in names), *((r, RECIPES) for r in chosen)):
        if name not in known:
            raise CirlError(unknown_name("part of the study", name, known))
    planned = [job for name in names for job in _jobs(out, name, chosen, seeds, steps)]
    if not table:
        _train(planned, out / "jobs", jobs)
    sections = {}
    for name in names:
        runs = [run.path for job in planned if job.network == name and job.is_done() for run in job.runs]
        comparison = _compare(name, runs, episodes)
        past = None if trial else RESULTS / name
        _publish(comparison, results / name, past, seeds=seeds, recipes=chosen)
        shutil.copyfile(results / name / "comparison.png", pictures / f"study_{name}.png")
        sections[name] = "\n".join(_table(comparison, [] if trial else table_rows(document, name)))
    if {network for network, *_ in LQR_CASES} <= set(names):
        sections["lqr"] = "\n".join(_lqr_table(min(episodes, LQR_EPISODES)))
    sections["made"] = made_with()
    write_sections(document, sections)


def _jobs(out: Path, network: str, recipes: Sequence[str], seeds: int, steps: int | None) -> Iterator[Job]:
    case = CASES[network]
    options = case.options | ({} if steps is None else {"steps": steps})
    which = tuple(range(FIRST_SEED, FIRST_SEED + seeds))
    for recipe in (each for each in recipes if each in case.recipes):
        yield Job(network, recipe, which, tuple(options.items()), out / network / recipe)


def _train(jobs: Sequence[Job], folder: Path, workers: int) -> None:
    """Run what is missing, several at a time; what fails is raised when the others are done."""
    with Progress(console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("training", total=len(jobs))

        def watch(standings: Sequence[JobStatus]) -> None:
            progress.update(task, completed=sum(each.share for each in standings))

        raise_first(run_jobs(jobs, folder, on="local", workers=workers, watch=watch))


def _compare(network: str, runs: Sequence[Path], episodes: int) -> Comparison:
    case = CASES[network]
    if not runs:
        raise RunError(f"{network}: no training run of the study is complete")
    with Progress(console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(f"comparing on {network}", total=1.0)
        return compare(
            runs,
            case.controllers,
            episodes=min(episodes, case.episodes),
            min_service=case.service,
            progress=lambda what, share: progress.update(task, completed=share, description=f"{network}: {what}"),
        )


def _publish(comparison: Comparison, folder: Path, past: Path | None, **options: Any) -> None:
    """Write the files of a comparison, and what those of a past one have of recipes that it lacks."""
    network, names = comparison.network, {row.name for row in comparison.rows}
    tables = {} if past is None else {name: list(_csv_rows(past / name)) for name in ("episodes.csv", "summary.csv")}
    before = None if past is None else json.loads((past / "summary.json").read_text())
    write_comparison(comparison, folder, **options)
    if before is None:
        return
    for name, (_, *rows) in tables.items():
        header, *fresh = _csv_rows(folder / name)
        merged = [*fresh, *(row for row in rows if row[0] not in names)]
        merged.sort(key=lambda row: _place(network.name, row[0]))
        write_table(folder / name, header, merged)
    summary = json.loads((folder / "summary.json").read_text())
    summary["rows"] += [row for row in before["rows"] if row["name"] not in names]
    summary["rows"].sort(key=lambda row: _place(network.name, row["name"]))
    summary["provenance"]["runs"] += [run for run in before["provenance"]["runs"] if run["recipe"] not in names]
    write_json(folder / "summary.json", summary)
    points: dict[str, dict[str, list[list[float]]]] = {}
    for name, seed, _, _, circularity, _, service, *_ in [*_csv_rows(folder / "episodes.csv")][1:]:
        points.setdefault(name, {}).setdefault(seed, []).append([float(service), float(circularity)])
    means = {name: np.array([np.mean(rows, axis=0) for rows in seeds.values()]) for name, seeds in points.items()}
    series = [PointSeries(name, *rows.T) for name, rows in means.items()]
    title = f"{network.name}: {comparison.episodes} episodes"
    save_fronts(folder / "comparison.png", network, series, comparison.baseline.front, title=title)


def _csv_rows(path: Path) -> Iterator[list[str]]:
    with path.open(newline="", encoding="utf-8") as file:
        yield from csv.reader(file)


def _place(network: str, name: str) -> int:
    """Return where a row stands: recipes first, then controllers."""
    order = (*CASES[network].recipes, *CASES[network].controllers)
    return order.index(name) if name in order else len(order)


def _table(comparison: Comparison, published: Sequence[Sequence[str]]) -> Iterator[str]:
    """Yield the lines of a section; rows that are published of recipes that the comparison lacks stay."""
    unit = comparison.network.mass_unit
    heads = (f"λ̄ ({unit})", f"over neutral ({unit})", "lowest service", f"bound ({unit})", "gap to the bound")
    columns = ("", "algorithm", "who learns", "reward", "steps", *heads, "seeds", "CPU min")
    network, names = comparison.network.name, [row.name for row in comparison.rows]
    neutral = comparison.rows[names.index("neutral")].entries[0].circularity
    controllers = [list(_cells(row, neutral, network)) for row in comparison.rows if not row.seeds]
    learners = [list(_cells(row, neutral, network)) for row in comparison.rows if row.seeds]
    learners += [list(cells) for cells in published if cells[0] not in names]
    learners.sort(key=lambda cells: _place(network, cells[0]))
    yield from markdown_table(columns, [*controllers, *learners]).split("\n")
    yield ""
    yield f"{comparison.episodes} episodes each, the same for all."
    yield ""
    yield f"![λ̄ against service](pictures/study_{comparison.network.name}.png)"
    if comparison.baseline.reason:
        yield ""
        yield f"No bound: {comparison.baseline.reason}."


def _cells(row: Row, neutral: Floats, network: str) -> Iterator[str]:
    """Yield the cells of a row: each thing that a recipe could have chosen otherwise has a column of its own."""
    mine = [entry.run for entry in row.entries if entry.run is not None]
    demanded = f", service {CASES[network].service:g}"
    yield f"{row.name}{demanded if row.name in ('mpc', 'optimum') else ''}"
    if mine:
        config = mine[0].config
        learner = config.recipe.learner
        algorithm = "exact gradients" if config.recipe.run.engine == "gradients" else learner.algorithm
        yield from (algorithm, learner.scheme, config.options.get("reward", "mixed"), f"{config.steps:,}")
    else:
        yield from ("", "", "", "")
    yield _figure(row.figure("circularity"), "{:.4g}")
    yield _figure(_over(row, [entry.circularity - neutral for entry in row.entries]), "{:+.4g}")
    yield _figure(_over(row, [entry.rollout.episode_levels for entry in row.entries]), "{:.4f}")
    yield _figure(row.figure("bound"), "{:.4g}", interval=False)
    yield _figure(row.figure("gap"), "{:.1%}")
    if not mine:
        yield from ("", "")
        return
    yield str(len(row.seeds))
    yield f"{np.mean([json.loads(_note(run).read_text())['cpu_minutes'] for run in mine]):.1f}"


def _over(row: Row, samples: Sequence[Floats]) -> Aggregate:
    """Aggregate figures of episodes as ``Row.figure`` does; of several services the one that lacks most counts."""
    if samples[0].ndim == 2:
        samples = [each[:, each.mean(axis=0).argmin()] for each in samples]
    return over_seeds([float(each.mean()) for each in samples]) if row.seeds else over_episodes(samples[0])


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
        env = MultiAgentVectorEnv(name, num_envs=episodes, agents=[agent])
        starts = starting_stocks(env, first_seed(0))
        acting: dict[str, Controller] = {
            "neutral": Neutral(),
            "lqr": LQR(set_points=set_points),
            "mpc": MPC(service_weight=SERVICE_FIRST),
        }
        runs = {label: rollout(env, each, seed=first_seed(0)) for label, each in acting.items()}
        measure = solve_baseline(env.network, env.agents, starts, [run.episode_levels for run in runs.values()])
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


if __name__ == "__main__":
    typer.run(main)
