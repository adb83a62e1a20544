"""The paper's tables: every algorithm on every environment with the paper's settings, our tuned recipes beside them.

``python benchmarks/paper.py`` runs row after row, each in a process of its own, and can be stopped and started again:
finished rows are kept. ``--table`` only writes the tables, ``--speed`` compares training times.
"""

from __future__ import annotations

import signal
import sys
from collections.abc import Sequence
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from benchmarks.paper_document import markdown
from cirl_marl.cli.common import shares
from cirl_marl.errors import CirlError
from cirl_marl.jobs import JobStatus, run_jobs
from cirl_marl.paper.published import BOX_ALGORITHMS, GOAL_ALGORITHMS
from cirl_marl.paper.results import PaperRow, Results
from cirl_marl.paper.row_selection import minutes, overview, select_rows
from cirl_marl.paper.rows import RowJob, reason_to_repeat
from cirl_marl.paper.table import result_line

console = Console(width=None if sys.stdout.isatty() else 140)
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
                row
                for names in choices
                for row in select_rows(*names, steps=steps, seeds=seeds or 1, settings=settings)
            )
            rows = list(dict.fromkeys(found))
        else:
            rows = study_rows(steps=steps, seeds=seeds, settings=settings)
        try:
            failed = run(results, rows, jobs, episodes)
        except KeyboardInterrupt:
            message = f"\nstopped; finished rows are kept in {out}. The same command goes on."
            console.print(message, soft_wrap=True, highlight=False)
            raise typer.Exit(130) from None
    part = only or steps or seeds or episodes or settings or out.resolve() != KEPT.resolve()
    path = write or (out / DOCUMENT.name if part else DOCUMENT)
    path.parent.mkdir(parents=True, exist_ok=True)
    comment = out / COMMENT
    text = markdown(results.read_all(), comment.read_text(encoding="utf-8") if comment.is_file() else "")
    path.write_text(text, encoding="utf-8")
    console.print(f"tables: {path}", soft_wrap=True)
    if failed:
        raise typer.Exit(1)


def study_rows(*, steps: int | None = None, seeds: int | None = None, settings: str | None = None) -> list[PaperRow]:
    """Return every row of the paper's tables: fast learners with three seeds first, then tuned, slow and goal learners.

    A seed comes to its end on every environment before the next begins, so that the tables fill evenly.
    """
    rows = select_rows(None, None, steps=steps, seeds=seeds or 3, settings=settings)
    groups = (*FAST, *(name for name in BOX_ALGORITHMS if name not in FAST), *GOAL_ALGORITHMS)

    def order(row: PaperRow) -> tuple[int, int, int]:
        slow = row.algorithm not in FAST and row.settings == "published"
        stage = 1 if row.settings == "tuned" else 2 * slow
        return stage, row.seed, groups.index(row.algorithm) if row.settings == "published" else 0

    wanted = [row for row in rows if row.settings == "tuned" or row.algorithm in FAST or row.seed < (seeds or 1)]
    return sorted(wanted, key=order)


def run(results: Results, rows: Sequence[PaperRow], workers: int, episodes: int | None) -> list[PaperRow]:
    """Run every row that is not done, some at a time; one that fails has a second try. Return those that failed twice.

    Raises:
        KeyboardInterrupt: after Ctrl-C, when the rows that ran are stopped.
    """
    left = []
    for row in rows:
        again = reason_to_repeat(results.read(row), episodes) if results.has(row) else ""
        if again:
            say(f"{row}: once more, as {again}")
        if again or not results.has(row):
            left.append(row)
    results.prepare()
    say(f"{overview(rows, left)}; results in {results.path}")
    failed = _run_once(results, left, workers, episodes)
    if failed:
        say(f"once more: {len(failed)} rows that failed")
    return _run_once(results, failed, workers, episodes) if failed else []


def _run_once(results: Results, rows: Sequence[PaperRow], workers: int, episodes: int | None) -> list[PaperRow]:
    """Run rows in processes of their own; return those that failed."""
    jobs = {row.stem: RowJob(row, results.path, episodes) for row in rows}
    shown: set[str] = set()
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, disable=not console.is_terminal) as bars:
        whole = bars.add_task("all rows", total=sum(minutes(row) for row in rows))

        def watch(standings: Sequence[JobStatus]) -> None:
            busy = [f"{jobs[each.name].row}: {each.figures.get('what', '')}" for each in standings if _runs(each)]
            done = sum(minutes(jobs[each.name].row) * _trained(each) for each in standings)
            bars.update(whole, description=", ".join(busy), completed=done)
            for each in standings:
                if each.state == "done" and each.name not in shown:
                    shown.add(each.name)
                    say(result_line(results.read(jobs[each.name].row)))

        failures = run_jobs([*jobs.values()], results.path / "logs", on="local", workers=workers, watch=watch)
    for failure in failures:
        say(f"{jobs[failure.name].row}: failed: {failure.message}")
    return [jobs[failure.name].row for failure in failures]


def _runs(each: JobStatus) -> bool:
    return each.state in ("running", "elsewhere")


def _trained(each: JobStatus) -> float:
    """Return the part of a row that is done; to evaluate takes next to nothing."""
    return each.share if each.figures.get("what") == "training" else float(each.state == "done")


def say(line: str) -> None:
    """Print a line as it is."""
    console.print(line, soft_wrap=True, highlight=False, markup=False)


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
