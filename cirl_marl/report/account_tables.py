"""What compartments book on accounts in an episode: a table and a picture, by compartment and over time."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import NEUTRAL, SERIES, WIDTH, save, style_axes
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.network import Floats
from cirl_marl.network.calendar import in_years, years
from cirl_marl.records.files import write_atomically, write_table

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
