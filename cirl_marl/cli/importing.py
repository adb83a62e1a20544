"""``cirl import | fit``: from tables of measured numbers to definition files."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cirl_marl.cli.common import NETWORKS, app, bar, errors, say, values_by_name

if TYPE_CHECKING:
    from cirl_marl.importing.balances import Reconciliation
    from cirl_marl.network.elements import Role

Patterns = list[str] | None
IMPLAUSIBLE = 0.01
"""p-value of an adjustment below which the table is said to contradict itself."""
CHANGES_SHOWN = 12
"""Most changes that are listed on screen."""


@app.command("import", rich_help_panel=NETWORKS)
def import_(
    flows: Annotated[Path, typer.Argument(metavar="FLOWS", help="CSV or .xlsx: a long table, or a matrix.")],
    stocks: Annotated[
        Path | None, typer.Argument(metavar="STOCKS", help="Stocks at the ends of years: process, year, value, unit.")
    ] = None,
    out: Annotated[Path, typer.Option(help="The definition to write; data files come beside it.")] = Path(
        "network.toml"
    ),
    reservoir: Annotated[Patterns, typer.Option(help="Non-renewable reservoirs; * stands for any text.")] = None,
    landfill: Annotated[Patterns, typer.Option(help="Landfills, and other losses for good.")] = None,
    incinerator: Annotated[Patterns, typer.Option(help="Incinerators.")] = None,
    environment: Annotated[Patterns, typer.Option(help="Air, water, soil.")] = None,
    outside: Annotated[Patterns, typer.Option(help="Sources and sinks that are other economies: trade.")] = None,
    store: Annotated[Patterns, typer.Option(help="Processes that hold a stock.")] = None,
    region: Annotated[Patterns, typer.Option(help="Regions to take; default: all, each a network of its own.")] = None,
    reconcile: Annotated[bool, typer.Option("--reconcile", help="Adjust flows so that processes balance.")] = False,
    sheet: Annotated[str | None, typer.Option(help="Sheet of the workbook.")] = None,
    unit: Annotated[str | None, typer.Option(help="Unit of the flows, if the table states none.")] = None,
    year: Annotated[int | None, typer.Option(help="Year of a matrix, or of a table without years.")] = None,
    title: Annotated[str, typer.Option(help="Title of the network.")] = "",
    source: Annotated[str, typer.Option(help="Where the numbers come from, with the licence.")] = "",
) -> None:
    """Make a network of a table of flows: processes become nodes, what passes through them shares, years series.

    A long table has the columns source, target, year, value, unit, and may have type, region, uncertainty and
    substance: rows that name one say how much of it is in a flow, in % or as an amount.
    What sources and sinks are is asked for, or given. The neutral simulation of the network gives back the table.
    """
    from cirl_marl.importing.assembly import import_flows
    from cirl_marl.importing.balances import ProcessKind

    patterns = {"nonrenewable_reservoir": reservoir, "landfill": landfill, "incinerator": incinerator}
    patterns |= {"environment": environment, "technosphere": outside}
    roles = {role: names for role, names in patterns.items() if names}
    ask = _ask if sys.stdin.isatty() else None
    options: dict[str, Any] = {"stores": store or (), "regions": region or (), "reconcile": reconcile, "sheet": sheet}
    options |= {"unit": unit, "year": year, "title": title, "source": source}
    with bar("checking") as progress:
        report = import_flows(flows, out, stocks, roles=roles, ask=ask, progress=progress, **options)
    table = report.table
    for kind in ProcessKind:
        if names := report.processes.of(kind):
            say(f"{KINDS[kind.value]}: {', '.join(names)}")
    for name in report.processes.inferred_stores:
        say(f"'{name}' takes more than it gives, so that it became a store; without --store it was not said to be one")
    if report.changes:
        say(f"flows adjusted: {len(report.changes)}; the largest changes are")
        for change in sorted(report.changes, key=lambda entry: -abs(entry.after - entry.before))[:CHANGES_SHOWN]:
            say(f"  {change.pair} ({change.place}): {change.before:g} → {change.after:g} {table.unit}")
    if report.reconciliation is not None:
        _say_plausibility(report.reconciliation)
    for name, apart in report.stock_mistakes.items():
        say(f"stocks of '{name}': their growth and the flows are up to {apart:g} {table.unit} apart")
    which = "the table"
    if report.reconciliation is not None:
        moved = max((abs(change.after - change.before) for change in report.changes), default=0.0)
        which = f"the adjusted table, which is up to {moved:.2g} {table.unit} from the original"
    say(f"simulated without agents, no flow is further than {report.largest_error:.2g} {table.unit} from {which}")
    if table.substances is not None:
        distance = (
            f"up to {100 * report.content_error:.2g} percentage points from {which.partition(',')[0]}, as stores mix"
        )
        say(f"simulated contents of {', '.join(table.substances.names)} are {distance}")
    say(f"wrote {', '.join(map(str, report.files))}")


def _say_plausibility(reconciliation: Reconciliation) -> None:
    """Say how far flows were moved in standard deviations, and warn if the table contradicts itself."""
    far, p_value = reconciliation.far, reconciliation.p_value
    degrees = f"degrees of freedom {reconciliation.degrees}"
    say(f"χ² of the adjustment: {reconciliation.chi_square:.4g}, {degrees}, p = {p_value:.2g}")
    if far:
        furthest = f"{far[0].pair} by {abs(far[0].in_deviations):.1f}"
        say(f"moved by more than two standard deviations: {len(far)}, {furthest}")
    if p_value < IMPLAUSIBLE:
        say("warning: flows contradict each other more than their uncertainties allow; look at those moved furthest")


KINDS = {
    "source": "sources",
    "sink": "sinks",
    "passing": "without stock, as they balance",
    "store": "stores",
}
ANSWERS = {"reservoir": "nonrenewable_reservoir", "outside": "technosphere"}
ANSWERS |= {role: role for role in ("landfill", "incinerator", "environment")}
"""Roles by what is answered."""


def _ask(name: str, kind: str) -> Role:
    from cirl_marl.network.elements import Role

    choices = ", ".join(ANSWERS)
    while True:
        answer = str(typer.prompt(f"{kind} '{name}': {choices}?")).strip().lower()
        if answer in ANSWERS:
            return Role(ANSWERS[answer])


@app.command(rich_help_panel=NETWORKS)
def fit(
    table: Annotated[Path, typer.Argument(metavar="TABLE", help="CSV file with a row for each time.")],
    column: Annotated[list[str], typer.Option(help="A column with a series; several are correlated.")],
    kind: Annotated[str, typer.Option(help="Process: ar1, resampled, seasonal or markov.")] = "ar1",
    plain: Annotated[
        bool, typer.Option("--plain", help="Noise of the values themselves, not of their logarithm.")
    ] = False,
    trend: Annotated[str, typer.Option(help="Trend that is removed: linear (of the logarithm), or none.")] = "linear",
    unit: Annotated[str, typer.Option(help="Unit of a disturbance that is added; default: it is a factor.")] = "",
    interval: Annotated[
        str, typer.Option(help="Control interval, such as '0.25 day'; default: the time between two rows.")
    ] = "",
    seasons: Annotated[int, typer.Option(help="Rows after which the season comes again, for seasonal.")] = 0,
    rows: Annotated[Patterns, typer.Option("--where", help="Which rows: COLUMN=TEXT.")] = None,
    times: Annotated[str | None, typer.Option(help="Column of times; default: year.")] = None,
    scenario: Annotated[str, typer.Option(help="Scenario of the definition that has the disturbances.")] = "",
    source: Annotated[str, typer.Option(help="Where the numbers come from, with the licence.")] = "",
) -> None:
    """Estimate disturbances from measured series, and print the tables of a definition, standard errors in the source.

    For example: cirl fit prices.csv --column copper --interval '0.25 day' >> my.toml
    """
    from cirl_marl.importing.disturbance_fits import fit_disturbances

    conditions = values_by_name(rows, "--where", "COLUMN=TEXT, such as country=Japan", str)
    options: dict[str, Any] = {"kind": kind, "trend": trend, "unit": unit, "interval": interval, "seasons": seasons}
    fits = fit_disturbances(table, column, logarithm=not plain, rows=conditions, times=times, source=source, **options)
    for name, (change, error) in fits.trends.items():
        amount = f"{change:.3g} ± {error:.2g} {unit}" if unit else f"{100 * change:.3g} ± {100 * error:.2g} %"
        errors.print(f"{name}: {fits.rows}; its trend, which is left out, is {amount} a row", soft_wrap=True)
    typer.echo(fits.tables(scenario), nl=False)
