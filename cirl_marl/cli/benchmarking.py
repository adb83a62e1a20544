"""``cirl benchmark run | table | verify``: the frozen suite of tasks, and rows of results that anybody adds."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from cirl_marl.cli import common
from cirl_marl.jobs import PLACES

benchmark = typer.Typer(no_args_is_help=True, rich_markup_mode="rich")
common.app.add_typer(
    benchmark,
    name="benchmark",
    rich_help_panel=common.COMPARISONS,
    help="Run the frozen benchmark, show its results, and verify rows by rerunning their policies.",
)
Tables = Annotated[
    list[Path] | None,
    typer.Argument(metavar="RESULTS...", help="Tables of results; default: the one that comes with the package."),
]


@benchmark.command()
def run(
    names: Annotated[list[str] | None, typer.Argument(metavar="TASK...", help="Tasks; default: all.")] = None,
    algorithm: Annotated[
        list[str] | None,
        typer.Option(help="Learner of the suite or controller, repeatable; default: the four controllers."),
    ] = None,
    seeds: Annotated[
        str | None, typer.Option(help="Training seeds, comma-separated; default: the ten of the suite.")
    ] = None,
    held_out: Annotated[
        bool, typer.Option("--held-out", help="Let the policies act on three held-out variants of each task, too.")
    ] = False,
    out: Annotated[Path, typer.Option(help="Folder of results.csv and weights.")] = Path("runs/benchmark"),
    contributor: Annotated[str, typer.Option(help="Who adds the rows; their last column.")] = "",
    on: Annotated[str, typer.Option(help=f"Where rows are made: {', '.join(PLACES)}.")] = "local",
    workers: Annotated[int | None, typer.Option(min=1, help="Rows at a time; default: as the place has.")] = None,
) -> None:
    """Make the rows that are missing: train, evaluate, keep the weights. Exit code 1: rows have failed."""
    from cirl_marl.errors import CirlError
    from cirl_marl.suite.row_jobs import benchmark as benchmarked

    folder = common.folder_for(out, "--out")
    try:
        numbers = None if seeds is None else [int(text) for text in common.comma_separated(seeds)]
    except ValueError:
        numbers = []
    if numbers == []:
        raise CirlError(f"--seeds '{seeds}': must be whole numbers, such as 401,402")
    before: dict[str, str] = {}
    outcome = benchmarked(
        names or None,
        algorithms=algorithm or None,
        seeds=numbers,
        out=folder,
        contributor=contributor,
        held_out=held_out,
        on=on,
        workers=workers,
        watch=lambda now: common.state_lines(now, before),
    )
    for row in outcome.rows:
        variant = f", variant {row.variant}" if row.variant else ""
        common.say(f"{row.id}{variant}: λ̄ {row.circularity:.5g}, service {row.service:.4f}, gap {row.gap:.2%}")
    common.say(f"rows asked for: {len(outcome.rows)}, in {folder / 'results.csv'}")
    common.end_with(outcome.failures)


@benchmark.command()
def table(
    results: Tables = None,
    out: Annotated[Path | None, typer.Option(help="PNG file for the performance profiles.")] = None,
) -> None:
    """Show gaps by task, scores over all tasks with bootstrap intervals, who is better than whom, and transfer."""
    from cirl_marl.report.benchmark_tables import benchmark_tables, save_profiles
    from cirl_marl.suite.result_rows import KEPT_RESULTS, key_of, read_rows

    # of the same row in several tables the last counts
    rows = [*{key_of(row): row for path in results or [KEPT_RESULTS] for row in read_rows(path)}.values()]
    for part in benchmark_tables(rows):
        common.console.print(part)
    if out is not None:
        common.say(f"wrote {save_profiles(out, rows)}")


@benchmark.command()
def verify(
    results: Tables = None,
    row: Annotated[list[str] | None, typer.Option(help="TASK/ALGORITHM/SEED, repeatable; default: all rows.")] = None,
    held_out: Annotated[bool, typer.Option("--held-out", help="Rerun rows of held-out variants, too.")] = False,
) -> None:
    """Rerun the policies of rows from their weights, and compare every digit. A row that differs ends it (code 2)."""
    from cirl_marl.suite.result_rows import KEPT_RESULTS
    from cirl_marl.suite.result_rows import verify as verified

    for path in results or [KEPT_RESULTS]:
        for name in verified(path, row or (), variants=held_out):
            common.say(f"as stated: {name}")
