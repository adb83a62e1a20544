"""``cirl sweep``: many trainings, on every core or machine."""

from __future__ import annotations

import json
import sys
import time as clock
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import timedelta
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from rich.live import Live
from rich.table import Table

from cirl_marl.cli.common import (
    COMPARISONS,
    CheckpointEvery,
    app,
    console,
    end_with,
    errors,
    folder_for,
    stoppable,
    values_by_name,
)
from cirl_marl.jobs import PLACES

if TYPE_CHECKING:
    from cirl_marl.sweeps import CellStatus

ROWS = 30
"""Most rows of the live table; those at work come first."""
ORDER = ("running", "elsewhere", "failed", "waiting", "done")


@app.command(rich_help_panel=COMPARISONS)
def sweep(
    file: Annotated[Path, typer.Argument(metavar="SWEEP", help="Sweep file: networks, scenarios, recipes, seeds.")],
    on: Annotated[str, typer.Option(help=f"Where the cells are trained: {', '.join(PLACES)}.")] = "local",
    workers: Annotated[
        int | None, typer.Option(min=1, help="Cells at a time; default: as many as there are cores, or the place has.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the sweep; default: runs/sweep-NAME.")] = None,
    slurm: Annotated[
        list[str] | None,
        typer.Option(metavar="NAME=VALUE", help="Of sbatch, such as partition=long or timeout_min=600; repeatable."),
    ] = None,
    checkpoint_every: CheckpointEvery = None,
    as_json: Annotated[
        bool, typer.Option("--json", help="Print the results as JSON; all else goes to stderr.")
    ] = False,
) -> None:
    """Train every cell of a sweep as a run of its own, and hold each against the bound.

    The cells are networks x scenarios x recipes x options x seeds. The same command does what is missing and goes on
    with what was interrupted; several may share a folder. Results are in sweep.csv. Exit code 1: cells have failed.
    """
    from cirl_marl.sweeps import sweep as swept

    if out is not None:
        folder_for(out, "--out")
    printer = errors if as_json else console
    settings = values_by_name(slurm, "--slurm", "NAME=VALUE, such as partition=long", str)
    options: dict[str, Any] = {"on": on, "workers": workers, "out": out, "settings": settings}
    place = out or Path("runs") / f"sweep-{file.stem}"
    with stoppable(f"everything learnt is kept in {place}", printer), _live(as_json) as watch:
        say = partial(printer.print, soft_wrap=True, highlight=False, markup=False)
        outcome = swept(file, **options, checkpoint_every=checkpoint_every, watch=watch, say=say)
    if as_json:
        sys.stdout.write(json.dumps(outcome.rows, indent=2) + "\n")
    else:
        console.print(_results(outcome.rows))
    done = sum(row["state"] == "done" for row in outcome.rows)
    message = f"{done} of {len(outcome.rows)} cells done; table: {outcome.folder / 'sweep.csv'}"
    printer.print(message, soft_wrap=True, highlight=False)
    end_with(outcome.failures)


@contextmanager
def _live(on_stderr: bool) -> Iterator[Callable[[Sequence[CellStatus]], None]]:
    """Live table of all cells; where nobody looks on, a line for each cell that begins or ends."""
    printer = errors if on_stderr else console
    if printer.is_terminal:
        first: list[tuple[float, float]] = []

        def update(statuses: Sequence[CellStatus]) -> None:
            now = clock.monotonic(), sum(map(share_done, statuses)) / len(statuses)
            if not first:
                first.append(now)
            live.update(table_of(statuses, time_left(first[0], now)), refresh=True)

        with Live(console=printer, transient=True, auto_refresh=False) as live:
            yield update
        return
    before: dict[str, str] = {}

    def tell(statuses: Sequence[CellStatus]) -> None:
        for cell in statuses:
            name, state = cell.job_status.name, cell.job_status.state
            if before.setdefault(name, "waiting") != state:
                before[name] = state
                gap = "" if state != "done" or cell.gap is None else f", gap {cell.gap:.1%}"
                printer.print(f"{state}: {name}{gap}", soft_wrap=True, highlight=False, markup=False)

    yield tell


def share_done(cell: CellStatus) -> float:
    """Return the share of a cell's training that is done; what follows on it is short."""
    activity = str(cell.job_status.figures.get("what", ""))
    if cell.job_status.state == "done" or activity.startswith("evaluat"):
        return 1.0
    return cell.job_status.share if activity == "training" else 0.0


def time_left(first: tuple[float, float], now: tuple[float, float]) -> float | None:
    """Return the seconds that are left if all goes on as since ``first``; each is a time and a share that is done.

    None while nothing has been done since.

    >>> time_left((0.0, 0.5), (60.0, 0.75))
    60.0
    """
    done = now[1] - first[1]
    return (now[0] - first[0]) * (1.0 - now[1]) / done if done > 0 else None


def table_of(statuses: Sequence[CellStatus], seconds_to_go: float | None = None) -> Table:
    """Draw who is how far, and about how many seconds are left."""
    counts = {state: sum(cell.job_status.state == state for cell in statuses) for state in ORDER}
    title = ", ".join(f"{count} {state}" for state, count in counts.items() if count)
    if seconds_to_go:
        title += f"; about {timedelta(seconds=round(seconds_to_go))} left"
    table = Table("cell", "state", "steps", "gap to the bound", title=title)
    rows = sorted(statuses, key=lambda cell: ORDER.index(cell.job_status.state))
    for cell in rows[:ROWS]:
        about = "" if cell.job_status.state == "done" else "~"
        gap = "" if cell.gap is None else f"{about}{cell.gap:.1%}"
        table.add_row(cell.job_status.name, _activity(cell), _steps(cell), gap)
    if len(rows) > ROWS:
        table.add_row(f"… and {len(rows) - ROWS} more", "", "", "")
    return table


def _activity(cell: CellStatus) -> str:
    activity = cell.job_status.figures.get("what", "") if cell.job_status.state in ("running", "elsewhere") else ""
    return f"{cell.job_status.state} {activity}".strip()


def _steps(cell_status: CellStatus) -> str:
    figures, steps = cell_status.job_status.figures, f"{cell_status.cell.steps:,}"
    if cell_status.job_status.state == "done" or figures.get("what", "").startswith("evaluat"):
        return f"{steps} of {steps}"
    return f"{figures['done']:,} of {steps}" if figures.get("what") == "training" else ""


def _results(rows: Sequence[Mapping[str, Any]]) -> Table:
    """Draw the results, with those options that were swept."""
    from cirl_marl.sweeps.folder import OPTION_COLUMNS

    identity = ("network", "scenario", "recipe", "seed")
    recipes = {row["recipe"] for row in rows}
    options = [key for key in OPTION_COLUMNS if len({(row["recipe"], row[key]) for row in rows}) > len(recipes)]
    columns = [*identity, *options]
    table = Table(*columns, "λ̄", "service", "gap to the bound")
    for row in rows:
        figures = (("circularity", "{:.5g}"), ("service", "{:.4f}"), ("gap", "{:.1%}"))
        table.add_row(*(str(row[key]) for key in columns), *(_figure(row, key, form) for key, form in figures))
    return table


def _figure(row: Mapping[str, Any], key: str, form: str) -> str:
    if row[key] is None:
        return "—"
    low, high = row[f"{key}_low"], row[f"{key}_high"]
    interval = "" if low is None or high is None else f" [{form.format(low)}, {form.format(high)}]"
    unit = f" {row['unit']}" if key == "circularity" else ""
    return (form.format(row[key]) + interval + unit).replace("[", r"\[")
