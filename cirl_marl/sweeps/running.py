"""A sweep from its file to its table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.errors import RunError, path_of
from cirl_marl.jobs import Failure, Job, JobStatus, Tell, check_place, run_jobs
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum import NoCertificate, bound, gap
from cirl_marl.optimum.bounds import highest_service
from cirl_marl.records.files import read_record, write_json
from cirl_marl.sweeps.cells import DIGITS, Cell, CellJob, cells_of, plain_name
from cirl_marl.sweeps.folder import SweepFolder
from cirl_marl.sweeps.reading import load_sweep

DEMAND = 0.9
"""Part of the highest service that the program of the front demands; its multipliers prove what holds elsewhere."""


@dataclass(frozen=True, slots=True)
class FrontJob:
    """What no policy of a network exceeds, by the service it delivers: for gaps that are shown while cells train.

    It is proved for the middle of the initial ranges, so these gaps are a little off; results have their own bounds.
    """

    address: str
    network: str
    scenario: str
    horizon: int | None
    definition_sha256: str
    folder: Path

    @classmethod
    def of(cls, cell: Cell, folder: Path) -> FrontJob:
        """Return the work on the front to which a cell is held; cells share it."""
        horizon = dict(cell.options).get("horizon", cell.recipe.environment.get("horizon"))
        return cls(cell.address, cell.network, cell.scenario, horizon, cell.definition_sha256, folder)

    @property
    def name(self) -> str:
        """Name of its file and of the job."""
        words = plain_name(f"bound-{self.network}-{self.scenario}")
        return f"{words}{'' if self.horizon is None else f'-{self.horizon}'}-{self.definition_sha256[:DIGITS]}"

    @property
    def file(self) -> Path:
        """Where the front is kept."""
        return self.folder / f"{self.name}.json"

    def is_done(self) -> bool:
        """Return whether it is known what is proved."""
        return self.file.is_file()

    def run(self, tell: Tell) -> None:
        """Prove what can be proved."""
        network = load_network(self.address, scenario=self.scenario)
        if self.horizon is not None:
            network = network.with_options(episode={"horizon": self.horizon})
        self.folder.mkdir(parents=True, exist_ok=True)
        try:
            most = highest_service(network)
            tell("bound", 1, 3)
            solution = bound(network, min_service=DEMAND * most)
            tell("bound", 2, 3)
            levels = np.linspace(0.0, most, 3)
            points = solution.at(min_service=levels[:, None])
        except NoCertificate as missing:
            write_json(self.file, {"levels": [], "proved": [], "reason": str(missing)})
            return
        write_json(self.file, {"levels": levels.tolist(), "proved": points.tolist(), "reason": ""})

    def gap(self, figures: Mapping[str, Any]) -> float | None:
        """Return how far policies with these figures are from the front, about; None if that is not known."""
        if not self.is_done() or "circularity" not in figures:
            return None
        front = read_record(self.file)
        try:
            levels, proved = (np.array(front[name], dtype=float) for name in ("levels", "proved"))
            points = np.interp(figures["service"], levels, proved) if levels.size else None
        except (KeyError, TypeError, ValueError) as error:
            raise RunError(f"{self.file}: is not what is proved of a network: {error!r}; delete it") from error
        if points is None:
            return None
        return max(0.0, float(gap(points, figures["circularity"])))


@positional_record
class CellStatus:
    """How far a cell is."""

    cell: Cell
    job_status: Annotated[JobStatus, "how far the work on it is"]
    gap: Annotated[
        float | None,
        "to the bound: that of its result, or about that of the best policies so far; None if it is not known",
    ]


@positional_record
class SweepOutcome:
    """What came of a sweep."""

    folder: Path
    rows: Annotated[tuple[Mapping[str, Any], ...], "a row for each cell, as in ``sweep.csv``"]
    failures: Annotated[tuple[Failure, ...], "cells, and bounds, that were not done, and why"]


def sweep(
    file: str | Path,
    *,
    on: str = "local",
    workers: int | None = None,
    out: str | Path | None = None,
    settings: Mapping[str, str] | None = None,
    checkpoint_every: float | None = None,
    watch: Callable[[Sequence[CellStatus]], None] = lambda statuses: None,
    say: Callable[[str], None] = lambda line: None,
) -> SweepOutcome:
    """Train and evaluate all cells of a sweep file that are not done: networks x scenarios x recipes x options x seeds.

    Each cell has a folder named by the hash of its content, so the same call does what is missing and goes on with what
    was interrupted, from its last checkpoint and to the same bits. Several calls may share a folder, on any machine
    that sees it. Whatever is killed in between, the results are the same.

    Args:
        file: the sweep file.
        on: ``here``, ``local``, ``slurm`` or ``ray``.
        workers: how many cells at a time; None is as many as the place has.
        out: folder of the sweep; None is ``runs/sweep-NAME`` after the name of the file.
        settings: options of ``sbatch``, for ``slurm``.
        checkpoint_every: seconds after which a training is saved; None is a minute.
        watch: called with the status of all cells, about once a second.
        say: called with where the cells are trained.

    Raises:
        CirlError: for input that cannot be used, before anything is trained; the folder of another sweep among it.
        KeyboardInterrupt: after Ctrl-C; what was learnt is saved.
    """
    check_place(on, workers, settings)
    path = path_of("sweep", file)
    request = load_sweep(path)
    cells = cells_of(request)
    folder = SweepFolder(Path("runs") / f"sweep-{path.stem}" if out is None else Path(out))
    folder.claim(request, cells)
    jobs_of_cells = [CellJob(cell, folder.cell(cell.name), request.evaluation, checkpoint_every) for cell in cells]
    work = {job.name: job for job in jobs_of_cells}
    fronts = {cell.name: FrontJob.of(cell, folder.bounds) for cell in cells} if request.evaluation.bounds else {}
    rest = {fronts[name].name: fronts[name] for name, job in work.items() if name in fronts and not job.is_done()}

    def report(statuses: Sequence[JobStatus]) -> None:
        by_name = {status.name: status for status in statuses}
        watch([_cell_status(work[name].cell, by_name[name], fronts.get(name)) for name in work])

    jobs: list[Job] = [*rest.values(), *work.values()]
    failures = run_jobs(jobs, folder.jobs, on=on, workers=workers, settings=settings, watch=report, say=say)
    return SweepOutcome(folder.path, tuple(folder.write_table()), tuple(failures))


def _cell_status(cell: Cell, status: JobStatus, front: FrontJob | None) -> CellStatus:
    if status.state == "done":
        return CellStatus(cell, status, status.figures.get("gap"))
    return CellStatus(cell, status, None if front is None else front.gap(status.figures))
