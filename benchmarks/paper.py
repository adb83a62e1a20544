"""The paper's tables: every algorithm on every environment with the paper's settings, our tuned recipes beside them.

``python benchmarks/paper.py`` runs row after row, each in a process of its own, and can be stopped and started again:
finished rows are kept. ``--table`` only writes the tables, ``--speed`` compares training times.
"""

from __future__ import annotations

import os
import signal
import sys
import time
import traceback
from collections import deque
from dataclasses import dataclass
from multiprocessing import get_context
from multiprocessing.process import BaseProcess
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskID, TaskProgressColumn, TextColumn, TimeRemainingColumn

from benchmarks.paper_document import markdown
from cirl_marl.cli.common import shares
from cirl_marl.errors import CirlError
from cirl_marl.paper.published import BOX_ALGORITHMS, GOAL_ALGORITHMS
from cirl_marl.paper.results import PaperRow, Results
from cirl_marl.paper.running import outdated
from cirl_marl.paper.selection import minutes, overview, planned
from cirl_marl.paper.table import result_line

console = Console(width=None if sys.stdout.isatty() else 140)
processes = get_context("spawn")
PHASES = ("waiting", "training", "evaluating")
KEPT = Path(__file__).parent / "results" / "paper"
FAST = ("ARS", "PPO", "A2C")
"""Learners that take minutes; the others take half an hour and more."""
COMMENT = "comment.md"
"""In OUT: what somebody has to say about the results there; it goes into the document."""
DOCUMENT = Path(__file__).parent.parent / "docs" / "paper_tables.md"


def main(
    out: Annotated[Path, typer.Option(help="Where results are kept; trials need a place of their own.")] = KEPT,
    only: Annotated[list[str] | None, typer.Option(help="ENV or ENV:ALGORITHM; repeatable. Default: all.")] = None,
    settings: Annotated[str | None, typer.Option("--recipe", help="published or tuned; default: both.")] = None,
    steps: Annotated[int | None, typer.Option(min=1, help="Steps of each row; default: the paper's.")] = None,
    seeds: Annotated[int | None, typer.Option(min=1, help="Seeds of each row; default: 3, of slow learners 1.")] = None,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Evaluation episodes; default: 100, where successes count the paper's.")
    ] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Rows at a time.")] = 1,
    table: Annotated[bool, typer.Option("--table", help="Run nothing, only write the tables.")] = False,
    speed: Annotated[bool, typer.Option("--speed", help="Only compare training times on CopperNet.")] = False,
    write: Annotated[
        Path | None,
        typer.Option(help="The tables; default: docs/paper_tables.md; of a part, a trial or another OUT: in OUT."),
    ] = None,
) -> None:
    """Run what is missing, then write the tables."""
    signal.signal(signal.SIGTERM, _stop)
    results = Results(out)
    if speed:
        _compare_speed(steps or 200_000)
        return
    failed: list[PaperRow] = []
    if not table:
        if only:
            choices = [_names(name) for name in only]
            found = (
                row for names in choices for row in planned(*names, steps=steps, seeds=seeds or 1, settings=settings)
            )
            rows = list(dict.fromkeys(found))
        else:
            rows = study_rows(steps=steps, seeds=seeds, settings=settings)
        try:
            failed = Study(results, rows, jobs, episodes).run()
        except KeyboardInterrupt:
            message = f"\nstopped; finished rows are kept in {out}. The same command goes on."
            console.print(message, soft_wrap=True, highlight=False)
            raise typer.Exit(130) from None
    part = only or steps or seeds or episodes or settings or out.resolve() != KEPT.resolve()
    path = write or (out / DOCUMENT.name if part else DOCUMENT)
    path.parent.mkdir(parents=True, exist_ok=True)
    comment = out / COMMENT
    text = markdown(results.all(), comment.read_text(encoding="utf-8") if comment.is_file() else "")
    path.write_text(text, encoding="utf-8")
    console.print(f"tables: {path}", soft_wrap=True)
    if failed:
        raise typer.Exit(1)


def study_rows(*, steps: int | None = None, seeds: int | None = None, settings: str | None = None) -> list[PaperRow]:
    """Return every row of the paper's tables: fast learners with three seeds first, then tuned, slow and goal learners.

    A seed comes to its end on every environment before the next begins, so that the tables fill evenly.
    """
    rows = planned(None, None, steps=steps, seeds=seeds or 3, settings=settings)
    groups = (*FAST, *(name for name in BOX_ALGORITHMS if name not in FAST), *GOAL_ALGORITHMS)

    def order(row: PaperRow) -> tuple[int, int, int]:
        slow = row.algorithm not in FAST and row.settings == "published"
        stage = 1 if row.settings == "tuned" else 2 * slow
        return stage, row.seed, groups.index(row.algorithm) if row.settings == "published" else 0

    wanted = [row for row in rows if row.settings == "tuned" or row.algorithm in FAST or row.seed < (seeds or 1)]
    return sorted(wanted, key=order)


@dataclass(slots=True)
class Job:
    """A row that runs in a process of its own."""

    row: PaperRow
    process: BaseProcess
    state: Any
    bar: TaskID


class Study:
    """Runs rows in processes, some at a time; a row that fails has a second try after all others."""

    def __init__(self, results: Results, rows: list[PaperRow], jobs: int, episodes: int | None) -> None:
        """Leave out the rows that are done."""
        self._results, self._jobs, self._episodes = results, jobs, episodes
        self._queue = deque(row for row in rows if not self._is_done(row))
        self._failed: list[PaperRow] = []
        self._again = True
        self._running: list[Job] = []
        results.prepare()
        overall = overview(rows, self._queue)
        console.print(f"{overall}; results in {results.path}", soft_wrap=True, highlight=False)

    def _is_done(self, row: PaperRow) -> bool:
        again = outdated(self._results.read(row), self._episodes) if self._results.has(row) else ""
        if again:
            console.print(f"{row}: once more, as {again}", soft_wrap=True, highlight=False)
        return self._results.has(row) and not again

    def run(self) -> list[PaperRow]:
        """Run every row and return those that failed twice.

        Raises:
            KeyboardInterrupt: after Ctrl-C, when the rows that ran are stopped.
        """
        columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
            finished = 0.0
            whole = bars.add_task("all rows", total=sum(minutes(row) for row in self._queue))
            try:
                while self._queue or self._running or self._retry():
                    while self._queue and len(self._running) < self._jobs:
                        self._start(self._queue.popleft(), bars)
                    time.sleep(0.2)
                    underway = 0.0
                    for job in list(self._running):
                        phase, done, total = job.state
                        bars.update(job.bar, description=f"{job.row}: {PHASES[phase]}", completed=done, total=total)
                        if job.process.exitcode is not None:
                            self._finish(job, bars)
                            finished += minutes(job.row)
                        elif PHASES[phase] == "training":
                            underway += minutes(job.row) * done / total
                    bars.update(whole, completed=finished + underway)
            finally:
                for job in self._running:
                    job.process.terminate()
                    job.process.join()
        return self._failed

    def _start(self, row: PaperRow, bars: Progress) -> None:
        log = _log(self._results, row)
        log.parent.mkdir(parents=True, exist_ok=True)
        state = processes.Array("q", [0, 0, 1], lock=False)
        arguments = (row, str(self._results.path), self._episodes, state)
        process = processes.Process(target=work, args=arguments, daemon=True)
        process.start()
        self._running.append(Job(row, process, state, bars.add_task(str(row), total=1)))

    def _finish(self, job: Job, bars: Progress) -> None:
        job.process.join()
        self._running.remove(job)
        bars.remove_task(job.bar)
        if job.process.exitcode == 0:
            console.print(result_line(self._results.read(job.row)), soft_wrap=True, highlight=False)
            return
        self._failed.append(job.row)
        lines = _log(self._results, job.row).read_text().splitlines() or ["no message"]
        console.print(f"{job.row}: failed: {lines[-1]}", soft_wrap=True, markup=False)

    def _retry(self) -> bool:
        again = self._again and bool(self._failed)
        if again:
            console.print(f"once more: {len(self._failed)} rows that failed")
            self._queue.extend(self._failed)
            self._failed, self._again = [], False
        return again


def work(row: PaperRow, folder: str, episodes: int | None, state: Any) -> None:
    """Run one row in this process; what it says goes into its log."""
    parent = os.getppid()
    os.nice(10)
    results = Results(folder)
    log = _log(results, row).open("w", buffering=1)
    os.dup2(log.fileno(), 1)
    os.dup2(log.fileno(), 2)
    said = time.perf_counter()

    def report(what: str, done: int, total: int) -> None:
        nonlocal said
        state[0], state[1], state[2] = PHASES.index(what), done, total
        if time.perf_counter() - said > 30:
            said = time.perf_counter()
            log.write(f"{what}: {done:,} of {total:,}\n")
            if os.getppid() != parent:
                raise KeyboardInterrupt("the study that started this row is gone")

    try:
        from cirl_marl.paper.running import run_row

        results.write(run_row(row, report=report, episodes=episodes))
        log.write("done\n")
    except BaseException:
        log.write(traceback.format_exc())
        raise SystemExit(1) from None


def _log(results: Results, row: PaperRow) -> Path:
    """Return where the process that runs a row writes what it says."""
    return results.path / "logs" / f"{row.stem}.log"


def _names(text: str) -> tuple[str, str | None]:
    environment, _, algorithm = text.partition(":")
    return environment, algorithm or None


def _stop(_signal: int, _frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def _compare_speed(steps: int) -> None:
    from benchmarks.paper_speed import compare, speed_table

    with shares() as told:
        found = compare(steps, lambda what, done, total: told(f"CopperNet: {what}", done / total))
    console.print(speed_table(found), soft_wrap=True, markup=False)


if __name__ == "__main__":
    try:
        typer.run(main)
    except CirlError as error:
        console.print(f"error: {error}", markup=False, soft_wrap=True)
        sys.exit(2)
