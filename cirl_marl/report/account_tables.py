"""What compartments book on accounts in an episode, and two aims against each other: tables and pictures."""

from __future__ import annotations

from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import INK, NEUTRAL, SERIES, WIDTH, draw_steps, number, readable, save, style_axes
from cirl_marl.evaluation.account_front import AccountFront
from cirl_marl.evaluation.figures import provenance
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.network import Floats
from cirl_marl.network.calendar import in_years, years
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.records.files import publish_result, write_table
from cirl_marl.report.terminal import text_table

SHOWN = len(SERIES)
"""Compartments of an account that the picture shows apart; the others are one."""


def write_accounts(folder: Path, name: str, simulation: Simulation, title: str) -> list[Path]:
    """Write ``name_accounts.csv`` and ``name_accounts.png`` of a simulated episode; return their paths."""
    table = write_table(folder / f"{name}_accounts.csv", *accounts_table(simulation))
    return [table, save_accounts(folder / f"{name}_accounts.png", simulation, title=title)]


def accounts_table(simulation: Simulation) -> tuple[list[str], list[list[object]]]:
    """Return header and rows: what each compartment books on each account in the episode, the largest amounts first."""
    network, amounts = simulation.network, simulation.rollout.entries
    rows: list[list[object]] = []
    for place, account in enumerate(network.accounts):
        for compartment, entries, total in _by_compartment(simulation, place):
            label, region = network.compartments[compartment].label, network.region_of(compartment)
            amount = float(amounts[:, entries].sum())
            rows.append([account.id, compartment, label, region, amount, total, account.unit])
    header = ["account", "compartment", "title", "region", "amount", "discounted", "unit"]
    return header, rows


def save_accounts(path: Path, simulation: Simulation, *, title: str) -> Path:
    """Save what is booked on each account as a PNG: in each interval, stacked by compartment, and who adds what."""
    network, amounts = simulation.network, simulation.rollout.entries
    figure = Figure(figsize=(WIDTH, 0.6 + 3.6 * len(network.accounts)), layout="constrained")
    panels = figure.subplots(len(network.accounts), 2, squeeze=False, width_ratios=(1.3, 1))
    ends, interval = interval_ends(network), network.episode.control_interval
    dated = network.episode.start is not None and in_years(network.time_unit)
    times = years(network, ends - interval) if dated else ends - interval
    width = interval if not dated else float(np.diff(years(network, [0.0, interval]))[0])
    for place, (account, (panel, beside)) in enumerate(zip(network.accounts, panels, strict=True)):
        parts = account_steps(simulation, place)
        colours = [*SERIES, NEUTRAL][: len(parts)]
        tops: Floats = np.zeros((2, len(times)))  # of what is stacked below and above zero
        for (_, entries, _), colour in zip(parts, colours, strict=True):
            values = amounts[:, entries].sum(axis=1)
            sides = (values > 0).astype(int)
            bottom = tops[sides, np.arange(len(times))]
            panel.bar(times, values, width, bottom, align="edge", color=colour)
            tops[sides, np.arange(len(times))] += values
        per = f"{interval:g} {network.time_unit}" if interval != 1 else network.time_unit
        style_axes(panel, title=account.title or account.id, ylabel=f"{account.unit} per {per}")
        steps, total = np.array([step for _, _, step in parts]), float(simulation.rollout.accounts[0, place])
        draw_steps(beside, steps, colours, [number(step) for step in steps])
        beside.barh(len(parts) + 1, total, height=0.62, color=INK)
        beside.set_yticks(range(1, len(parts) + 2), [*(label for label, _, _ in parts), f"total {number(total)}"])
        beside.invert_yaxis()
        style_axes(beside, title=f"in all, {account.unit}" + (", discounted" if account.discount else ""))
        beside.margins(x=0.15)
        beside.grid(False, axis="y")
        beside.locator_params(axis="x", nbins=4)
    panels[-1, 0].set_xlabel("year" if dated else f"time / {network.time_unit}")
    figure.suptitle(title)
    return save(figure, path)


def account_steps(simulation: Simulation, account: int) -> list[tuple[str, list[int], float]]:
    """Return the steps to the total of an account: label, entries and amount of each compartment that adds most to it.

    The rest is the last of them. Amounts are discounted, as totals are.
    """
    by_size, parts = _by_compartment(simulation, account), simulation.network.compartments
    steps = [(parts[id_].label, entries, amount) for id_, entries, amount in by_size[:SHOWN]]
    if rest := by_size[SHOWN:]:
        entries, amounts = [entry for _, part, _ in rest for entry in part], [amount for _, _, amount in rest]
        steps.append((f"{len(rest)} others", entries, sum(amounts)))
    return steps


def _by_compartment(simulation: Simulation, account: int) -> list[tuple[str, list[int], float]]:
    """Return entries and discounted amount on an account of each compartment that books on it, the largest first."""
    ledger, amounts = simulation.env.ledger, simulation.rollout.entries
    entries: dict[str, list[int]] = {}
    for entry in np.flatnonzero((ledger.account == account) & amounts.any(axis=0)).tolist():
        entries.setdefault(ledger.compartments[entry], []).append(entry)
    discount = ledger.discount[account]
    parts = [(id_, rows, float(discount @ amounts[:, rows].sum(axis=1))) for id_, rows in entries.items()]
    return sorted(parts, key=lambda part: -abs(part[2]))


def front_table(front: AccountFront) -> Table:
    """Return demands, what is proved and planned at each, and what one more of each demand is worth."""
    headings = [name for name, _ in _front_columns(front)]
    columns = [column.tolist() for _, column in _front_columns(front)]
    rows = [[f"{cell:.5g}" for cell in cells] for cells in zip(*columns, strict=True)]
    return text_table(f"{front.axes[0]} against {' and '.join(front.axes[1:])}", headings, rows, text=[])


def _front_columns(front: AccountFront) -> list[tuple[str, Floats]]:
    """Return the columns of the table of a front, with their headings."""
    (first, *others), (unit, *units) = front.axes, front.units
    demanded = ["at least" if sign > 0 else "at most" for sign in front.signs[1:]]
    named = [*zip(others, units, strict=True)]
    headings = [f"{name} {way} ({of})" for (name, of), way in zip(named, demanded, strict=True)]
    columns = [*zip(headings, front.demands.T, strict=True), (f"best {first} ({unit})", front.bounds)]
    names = [f"plan: {name} ({of})" for name, of in [(first, unit), *named]]
    worth = [f"worth of {name} ({unit}/({of}))" for name, of in named]
    return [*columns, *zip(names, front.plans.T, strict=True), *zip(worth, front.prices.T, strict=True)]


def write_account_front(front: AccountFront, folder: Path, **options: Any) -> list[Path]:
    """Write table, provenance and picture, all of them or none, and return their paths."""
    columns = [*_front_columns(front), ("least service level of the plan", front.levels)]
    header = [name for name, _ in columns]
    rows = [list(row) for row in zip(*(column.tolist() for _, column in columns), strict=True)]
    bounds, plans = front.volumes
    about: dict[str, Any] = {"provenance": provenance(front.network, **options), "columns": header, "points": rows}
    about |= {"as_usual": front.as_usual.tolist(), "hypervolume": {"proved": bounds, "plans": plans}}
    picture = partial(save_account_front, front=front)
    return publish_result(folder, {"pareto.csv": (header, rows)}, {"pareto.png": picture}, {"pareto.json": about})


def save_account_front(path: str | Path, front: AccountFront, *, title: str = "") -> Path:
    """Save the first two aims against each other as a PNG and return its path; a third has a line for each demand.

    Of two aims what no episode can reach is shaded.
    """
    (first, second), (unit, other), network = front.axes[:2], front.units[:2], front.network
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    axes = figure.subplots()
    thirds = np.unique(front.demands[:, 1:]).tolist() or [None]
    for third, colour in zip(thirds, cycle(SERIES[1:] if len(thirds) > 1 else SERIES), strict=False):
        part = np.flatnonzero((front.demands[:, 1:] == third).all(axis=1))
        order = part[np.argsort(front.demands[part, 0])]
        label = "plan in the simulator" if third is None else f"{readable(front.axes[2])} {number(third)}"
        axes.plot(*front.plans[order, :2].T[::-1], marker="o", color=colour, label=label)
        if third is not None:
            axes.plot(front.demands[order, 0], front.bounds[order], color=colour, linewidth=1, linestyle="--")
    axes.plot(*front.as_usual[:2][::-1], marker="s", linestyle="", color=INK, label="as usual")
    if thirds == [None]:
        within = np.linspace(*axes.get_xlim(), 500)
        bounds = front.at(within)
        axes.plot(within, bounds, color=NEUTRAL, linewidth=1, label="best possible")
        low, high = axes.get_ylim()
        axes.fill_between(within, bounds, high if front.signs[0] > 0 else low, color=NEUTRAL, alpha=0.2, linewidth=0)
        axes.set_ylim(low, high)
        axes.set_xlim(within[0], within[-1])
    else:
        axes.plot([], [], color=NEUTRAL, linewidth=1, linestyle="--", label="best possible")
    label = "λ̄" if first == CIRCULARITY else readable(first)
    style_axes(axes, title=title or f"{network.title or network.name}", ylabel=f"{label} / {unit}")
    axes.set_xlabel(f"{readable(second)} / {other}", fontsize=9)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8, borderaxespad=0)
    return save(figure, Path(path))
