"""A sweep from its file to its table."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

from cirl_marl.jobs import Failure, Job, JobStatus, check_place, run_jobs
from cirl_marl.network.declarations import positional_record
from cirl_marl.sweeps.cells import Cell, CellJob, cells_of
from cirl_marl.sweeps.folder import SweepFolder
from cirl_marl.sweeps.fronts import FrontJob
from cirl_marl.sweeps.reading import load_sweep


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
    path = Path(file)
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
