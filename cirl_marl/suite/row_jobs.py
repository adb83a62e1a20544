"""Rows that are missing are made: trained or planned, measured from their own weights, and added to a table."""

from __future__ import annotations

import shutil
from collections import Counter
from collections.abc import Sequence
from contextlib import suppress
from importlib import metadata
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.errors import CirlError, whole_number
from cirl_marl.evaluation.calibration import FIRST_DRAW, calibrate
from cirl_marl.jobs import Failure, Tell, run_jobs
from cirl_marl.jobs.driver import Watch
from cirl_marl.network.declarations import frozen_record, positional_record
from cirl_marl.optimum.blind import FEWEST, BestConstant, BestSchedule
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.options import demanded_levels
from cirl_marl.suite.result_rows import ResultRow, add_rows, columns_of, key_of, read_rows, task_of
from cirl_marl.suite.tasks import CONTROLLERS, BenchmarkTask, load_algorithm, load_task, tasks
from cirl_marl.suite.weights import controller_of, read_weights, write_weights

TABLE = "results.csv"
PLANNED_EPISODES, DISTURBED_EPISODES = 4, 16
"""Episodes of MPC, and where something disturbs it, in which case its margin is set on as many draws."""
WINDOW = 3
"""Decisions that MPC looks ahead where something is drawn; elsewhere to the end."""
DRAWS = 8
"""Draws for which blind controllers are optimised, where starts or disturbances are drawn."""
BLIND = {"best_constant": BestConstant, "best_schedule": BestSchedule}


@positional_record
class BenchmarkOutcome:
    """What came of a benchmark."""

    rows: Annotated[tuple[ResultRow, ...], "that were asked for, those that were there before among them"]
    failures: Annotated[tuple[Failure, ...], "rows that were not made, and why"]


@frozen_record
class ResultJob:
    """The work on a row, of which ``row`` says what it is, without figures."""

    row: ResultRow
    out: Path

    @property
    def run_directory(self) -> Path:
        """Its training, while there is no row."""
        return self.out / "runs" / self.name

    @property
    def name(self) -> str:
        """Name of its files."""
        return self.row.id.replace("/", "-") + (f".{self.row.variant}" if self.row.variant else "")

    def is_done(self) -> bool:
        """Return whether the row is in the table."""
        return key_of(self.row) in map(key_of, _rows(self.out))

    def run(self, tell: Tell) -> None:
        """Train, or plan, keep the weights, and add the row that these give."""
        row, task, columns = self.row, task_of(self.row), dict[str, Any]()
        weights = None
        if row.algorithm != "neutral":
            stem = row.algorithm if row.seed is None else f"{row.algorithm}-{row.seed}"
            columns["weights"] = f"weights/{row.task}/{stem}.safetensors"
            weights = self.out / columns["weights"]
            if not row.variant:
                columns["sha256"] = write_weights(weights, *self._train_or_plan(task, tell))
            elif (base := (row.id, 0)) in (before := {key_of(row): row for row in _rows(self.out)}):
                columns["sha256"] = before[base].sha256
            else:
                raise CirlError(
                    f"{self.out / TABLE}: has no row '{row.id}' whose weights could act on held-out numbers"
                )
            if row.seed is not None:
                columns["steps"] = read_weights(weights)[1]["config"]["steps"]
        tell("evaluating", 0, 1)
        controller, options = controller_of(task, row.algorithm, weights)
        columns |= columns_of(task.measure(controller, episodes=row.episodes, **options))
        add_rows(self.out / TABLE, [ResultRow(**{**row.as_dict(), **columns})])
        self.clear()

    def clear(self) -> None:
        """Remove the training, which whoever was killed while doing so left in part, and several may do at once."""
        with suppress(FileNotFoundError):
            shutil.rmtree(self.run_directory)

    def _train_or_plan(self, task: BenchmarkTask, tell: Tell) -> tuple[dict[str, NDArray[Any]], dict[str, Any]]:
        """Return arrays and description of what acts."""
        row = self.row
        if row.algorithm == "mpc":
            return {}, _mpc_settings(task)
        if row.algorithm in BLIND:
            env = task.env(1)
            draws = DRAWS if env.network.disturbed or np.ptp(env.network.initial, axis=0).any() else FEWEST
            controller = BLIND[row.algorithm](min_service=task.min_service, draws=draws)
            controller.plan(env, FIRST_DRAW, lambda share: tell("planning", share, 1.0))
            return {"actions": controller.actions.astype(np.float32)}, {}
        from cirl_marl.learners.acting_weights import acting_weights  # it needs torch
        from cirl_marl.learners.interface import complete_run

        algorithm = load_algorithm(row.algorithm)
        steps = algorithm.steps(task)
        run = complete_run(
            self.run_directory,
            task.network(),
            algorithm.recipe_of(task),
            steps=steps,
            seed=row.seed,
            report=lambda now: tell("training", steps - now.total + now.env_steps, steps),
        )
        return acting_weights(run)


def _mpc_settings(task: BenchmarkTask) -> dict[str, Any]:
    """Return horizon and margin of MPC in a task; the margin is set where something disturbs what is planned for."""
    network, settings = task.network(), {"task": task.name, "horizon": None, "margin": 1.0}
    if not network.disturbed:
        return settings
    demand = demanded_levels(network, task.min_service)

    def make(margin: float = 1.0) -> MPC:
        return MPC(min_service=task.min_service, horizon=WINDOW, margin=margin)

    return settings | {"horizon": WINDOW, "margin": calibrate(task.env, make, demand, DISTURBED_EPISODES).margin}


def benchmark(
    names: Sequence[str] | None = None,
    *,
    algorithms: Sequence[str] | None = None,
    seeds: Sequence[int] | None = None,
    out: str | Path = "runs/benchmark",
    contributor: str = "",
    held_out: bool = False,
    on: str = "here",
    workers: int | None = None,
    watch: Watch = lambda statuses: None,
) -> BenchmarkOutcome:
    """Make the rows of the benchmark that are missing, and add them to ``results.csv`` in a folder.

    Every row is measured from its weights, which lie beside the table. The same call goes on with what was interrupted.

    Args:
        names: tasks; None: all of ``tasks()``.
        algorithms: learners of the suite, or controllers; None: the controllers.
        seeds: of trainings; None: the task's.
        out: folder of table, weights and trainings under way.
        contributor: who adds the rows.
        held_out: whether the policies act on the held-out variants of the tasks as well.
        on: ``here``, ``local``, ``slurm`` or ``ray``.
        workers: how many rows at a time; None is as many as the place has.
        watch: called with the status of all rows, about once a second; those of held-out variants come last.

    Raises:
        CirlError: for an unknown task or algorithm, before anything is done; it names the nearest.
    """
    for name, options in (("task", names), ("algorithm", algorithms), ("seed", seeds)):
        if doubles := [value for value, count in Counter(options or ()).items() if count > 1]:
            raise CirlError(f"{name} {doubles[0]} is given more than once")
    selection, folder = [load_task(name) for name in (tasks() if names is None else names)], Path(out)
    about: dict[str, Any] = {"version": metadata.version("cirl-marl"), "contributor": contributor}
    jobs = []
    for algorithm in CONTROLLERS if algorithms is None else algorithms:
        if algorithm not in CONTROLLERS:
            load_algorithm(algorithm)
        for task in selection:
            trainings = [whole_number("seed", seed, 0) for seed in (task.seeds if seeds is None else seeds)]
            for seed in [None] if algorithm in CONTROLLERS else trainings:
                for part in (task, *(map(task.held_out, task.variants) if held_out else ())):
                    episodes = min(_most_episodes(algorithm, task), part.episodes)
                    what: dict[str, Any] = {"task": task.name, "variant": part.variant, "algorithm": algorithm}
                    jobs.append(ResultJob(row=ResultRow(seed=seed, episodes=episodes, **what, **about), out=folder))
    for job in jobs:
        if job.is_done():
            job.clear()
    failures: list[Failure] = []
    # what acts on a variant is in the row of its task
    for wave in ([job for job in jobs if not job.row.variant], [job for job in jobs if job.row.variant]):
        failures += run_jobs(wave, folder / "jobs", on=on, workers=workers, watch=watch) if wave else []
    keys = [key_of(job.row) for job in jobs]
    return BenchmarkOutcome(tuple(row for row in _rows(folder) if key_of(row) in keys), tuple(failures))


def _most_episodes(algorithm: str, task: BenchmarkTask) -> int:
    """Return of how many episodes an algorithm can be measured in minutes: MPC plans at every decision."""
    if algorithm != "mpc":
        return task.episodes
    return DISTURBED_EPISODES if task.network().disturbed else PLANNED_EPISODES


def _rows(folder: Path) -> list[ResultRow]:
    path = folder / TABLE
    return read_rows(path) if path.is_file() else []
