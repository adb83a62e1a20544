"""Rows one after the other in this process, with a live bar; finished rows are kept and not run again."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

from cirl_marl.errors import CirlError
from cirl_marl.paper.final_policy import Report
from cirl_marl.paper.published import ENVIRONMENTS
from cirl_marl.paper.results import PaperRow, Results
from cirl_marl.paper.running import outdated, run_row
from cirl_marl.paper.selection import overview
from cirl_marl.paper.table import environment_table, result_line
from cirl_marl.paper.untuned import check_registered

REFRESH_S = 0.2


def run_session(
    rows: Sequence[PaperRow], results: Results, console: Console, *, episodes: int | None
) -> list[PaperRow]:
    """Run the rows that are not done, show the tables of their environments, and return the rows that failed.

    Raises:
        CirlError: if an environment is missing or results cannot be kept there, before anything is run.
        KeyboardInterrupt: after Ctrl-C; the row that ran leaves nothing.
    """
    environments = [ENVIRONMENTS[name] for name in dict.fromkeys(row.environment for row in rows)]
    for environment in environments:
        check_registered(environment)
    results.prepare()
    changed = {row: outdated(results.read(row), episodes) for row in rows if results.has(row)}
    left = [row for row in rows if row not in changed or changed[row]]
    console.print(f"{overview(rows, left)}; results in {results.path}", soft_wrap=True, highlight=False)
    failed: list[PaperRow] = []
    for i, row in enumerate(rows):
        if changed.get(row):
            console.print(f"{row}: once more, as {changed[row]}", soft_wrap=True, highlight=False)
        if row in left:
            title = f"{i + 1} of {len(rows)}: {row.environment} {row.algorithm}, seed {row.seed}"
            try:
                with live_bar(console, title) as bar:
                    results.write(run_row(row, report=bar, episodes=episodes))
            except CirlError as error:
                failed.append(row)
                console.print(f"{row}: failed: {error}", soft_wrap=True, markup=False, highlight=False)
                continue
        console.print(result_line(results.read(row)), soft_wrap=True, highlight=False)
    for environment in environments:
        asked = {(row.algorithm, row.settings) for row in rows if row.environment == environment.name}
        shown = [
            each for each in results.all() if each.row in rows or (each.row.algorithm, each.row.settings) not in asked
        ]
        console.print(environment_table(environment, shown))
    return failed


@contextmanager
def live_bar(console: Console, title: str) -> Iterator[Report]:
    """Bar with the time remaining; starts anew when the row goes on to something else. Nothing without a terminal."""
    columns = (TextColumn("{task.description}"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console, transient=True, disable=not console.is_terminal) as progress:
        task = progress.add_task(title, total=None)
        current, shown = "", 0.0

        def report(what: str, done: int, total: int) -> None:
            nonlocal current, shown
            if what != current:
                current = what
                progress.reset(task, description=f"{title}: {what}", total=total)
            if time.perf_counter() - shown > REFRESH_S:
                shown = time.perf_counter()
                progress.update(task, completed=done)

        yield report
