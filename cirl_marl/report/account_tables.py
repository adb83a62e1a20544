"""What compartments book on accounts in an episode, and two aims against each other: tables and pictures."""

from __future__ import annotations

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
from cirl_marl.records.files import publish_folder, write_atomically, write_json, write_table
from cirl_marl.report.terminal import text_table

SHOWN = len(SERIES)
"""Compartments of an account that the picture shows apart; the others are one."""


def write_accounts(folder: Path, name: str, simulation: Simulation, title: str) -> list[Path]:
    """Write ``name_accounts.csv`` and ``name_accounts.png`` of a simulated episode; return their paths."""
    table, picture = folder / f"{name}_accounts.csv", folder / f"{name}_accounts.png"
    write_atomically(table, lambda draft: write_table(draft, *accounts_table(simulation)))
    return [table, save_accounts(picture, simulation, title=title)]


def accounts_table(simulation: Simulation) -> tuple[list[str], list[list[object]]]:
    """Return header and rows: what each compartment books on each account in the episode, the largest amounts first."""
    network, amounts = simulation.network, simulation.rollout.entries
    regions = {node: region for region, nodes in network.copies.items() for node in nodes}
    rows: list[list[object]] = []
    for place, account in enumerate(network.accounts):
        for compartment, entries, total in _by_compartment(simulation, place):
            part = network.compartments[compartment]
            ends = [getattr(part, end, "") for end in ("id", "donor", "recipient")]
            region = next((regions[end] for end in ends if end in regions), "")
            amount = float(amounts[:, entries].sum())
            rows.append([account.id, compartment, part.label, region, amount, total, account.unit])
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
    """Return budgets, what is proved and planned at each, and what one more of the budget is worth."""
    (first, second), (unit, other) = front.axes, front.units
    headings = [
        f"{second} at most ({other})",
        f"best {first} ({unit})",
        f"plan ({unit})",
        f"worth ({unit} per {other})",
    ]
    columns = (front.budgets, front.bounds, front.plans[:, 0], front.prices)
    rows = [[f"{cell:.5g}" for cell in cells] for cells in zip(*(column.tolist() for column in columns), strict=True)]
    return text_table(f"{first} against {second}", headings, rows, text=[])


def write_account_front(front: AccountFront, folder: Path, **options: Any) -> list[Path]:
    """Write table, provenance and picture, all of them or none, and return their paths."""
    (first, second), (unit, other) = front.axes, front.units
    header = [f"budget of {second} ({other})", f"proved {first} ({unit})", f"worth of one more ({unit}/({other}))"]
    header += [f"planned {first} ({unit})", f"planned {second} ({other})", "least service level of the plan"]
    columns = [front.budgets, front.bounds, front.prices, *front.plans.T, front.levels]
    rows = [list(row) for row in zip(*(column.tolist() for column in columns), strict=True)]
    bounds, plans = front.volumes
    about: dict[str, Any] = {"provenance": provenance(front.network, **options), "columns": header, "points": rows}
    about |= {"as_usual": front.as_usual.tolist(), "hypervolume": {"proved": bounds, "plans": plans}}
    names = ("pareto.csv", "pareto.json", "pareto.png")
    with publish_folder(folder) as draft:
        write_table(draft / names[0], header, rows)
        write_json(draft / names[1], about)
        save_account_front(draft / names[2], front)
    return [folder / name for name in names]


def save_account_front(path: str | Path, front: AccountFront, *, title: str = "") -> Path:
    """Save two aims against each other as a PNG and return its path; what no episode can reach is shaded."""
    (first, second), (unit, other), network = front.axes, front.units, front.network
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    axes = figure.subplots()
    axes.plot(*front.plans.T[::-1], marker="o", color=SERIES[0], label="plan in the simulator")
    axes.plot(*front.as_usual[::-1], marker="s", linestyle="", color=SERIES[1], label="as usual")
    within = np.linspace(*axes.get_xlim(), 500)
    bounds = front.at(within)
    axes.plot(within, bounds, color=NEUTRAL, linewidth=1, label="best possible")
    low, high = axes.get_ylim()
    axes.fill_between(within, bounds, high if front.sign > 0 else low, color=NEUTRAL, alpha=0.2, linewidth=0)
    axes.set_ylim(low, high)
    axes.set_xlim(within[0], within[-1])
    label = "λ̄" if first == CIRCULARITY else readable(first)
    style_axes(axes, title=title or f"{network.title or network.name}", ylabel=f"{label} / {unit}")
    axes.set_xlabel(f"{readable(second)} / {other}", fontsize=9)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8, borderaxespad=0)
    return save(figure, Path(path))
