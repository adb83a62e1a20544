"""What compartments book on accounts in an episode, and two aims against each other: tables and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import NEUTRAL, SERIES, WIDTH, readable, save, style_axes
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
    network, ledger = simulation.network, simulation.env.ledger
    amounts = simulation.rollout.entries
    discounted = amounts * ledger.discount[ledger.account].T
    regions = {node: region for region, nodes in network.copies.items() for node in nodes}
    rows: list[list[object]] = []
    for place, account in enumerate(network.accounts):
        for compartment, entries in _by_compartment(simulation, place):
            part = network.compartments[compartment]
            ends = [getattr(part, end, "") for end in ("id", "donor", "recipient")]
            region = next((regions[end] for end in ends if end in regions), "")
            sums = [float(each[:, entries].sum()) for each in (amounts, discounted)]
            rows.append([account.id, compartment, part.label, region, *sums, account.unit])
    header = ["account", "compartment", "title", "region", "amount", "discounted", "unit"]
    return header, rows


def save_accounts(path: Path, simulation: Simulation, *, title: str) -> Path:
    """Save what is booked in each interval as a PNG, a panel for each account, stacked by compartment."""
    network, amounts = simulation.network, simulation.rollout.entries
    figure = Figure(figsize=(WIDTH, 0.6 + 3.2 * len(network.accounts)), layout="constrained")
    panels = figure.subplots(len(network.accounts), 1, squeeze=False)[:, 0]
    ends, interval = interval_ends(network), network.episode.control_interval
    dated = network.episode.start is not None and in_years(network.time_unit)
    times = years(network, ends - interval) if dated else ends - interval
    width = interval if not dated else float(np.diff(years(network, [0.0, interval]))[0])
    for place, (account, panel) in enumerate(zip(network.accounts, panels, strict=True)):
        parts = [(network.compartments[id_].label, entries) for id_, entries in _by_compartment(simulation, place)]
        shown = [(label, amounts[:, entries].sum(axis=1)) for label, entries in parts[:SHOWN]]
        if rest := [entry for _, entries in parts[SHOWN:] for entry in entries]:
            shown.append((f"{len(parts) - SHOWN} others", amounts[:, rest].sum(axis=1)))
        tops: Floats = np.zeros((2, len(times)))  # of what is stacked below and above zero
        for number, (label, values) in enumerate(shown):
            sides = (values > 0).astype(int)
            bottom = tops[sides, np.arange(len(times))]
            colour = SERIES[number] if number < SHOWN else NEUTRAL
            panel.bar(times, values, width, bottom, align="edge", color=colour, label=label)
            tops[sides, np.arange(len(times))] += values
        per = f"{interval:g} {network.time_unit}" if interval != 1 else network.time_unit
        style_axes(panel, title=account.title or account.id, ylabel=f"{account.unit} per {per}")
        if shown:
            panel.legend(frameon=False, loc="center left", bbox_to_anchor=(1.0, 0.5))
    panels[-1].set_xlabel("year" if dated else f"time / {network.time_unit}")
    figure.suptitle(title)
    return save(figure, path)


def _by_compartment(simulation: Simulation, account: int) -> list[tuple[str, list[int]]]:
    """Return the entries of an account by compartment, those that book most first; those that book nothing are left."""
    ledger, amounts = simulation.env.ledger, simulation.rollout.entries
    entries: dict[str, list[int]] = {}
    for entry in np.flatnonzero(ledger.account == account).tolist():
        entries.setdefault(ledger.compartments[entry], []).append(entry)
    sizes = {id_: abs(float(amounts[:, rows].sum())) for id_, rows in entries.items()}
    return [(id_, entries[id_]) for id_ in sorted(sizes, key=lambda id_: -sizes[id_]) if amounts[:, entries[id_]].any()]


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
