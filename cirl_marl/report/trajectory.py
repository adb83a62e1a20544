"""One simulated episode on disk: a table and a picture of it, and the ages of what is in use."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cirl_marl.controllers.pyramids import Pyramid, pyramids
from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import SERIES, WIDTH, readable, save, style_axes
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.network import Network
from cirl_marl.network.calendar import labels, time_columns
from cirl_marl.records.files import write_table
from cirl_marl.report.account_tables import write_accounts
from cirl_marl.report.curves import save_trajectory

PYRAMID_COLUMNS, PYRAMIDS = 3, 12
"""Panels side by side, and most of them; those with the largest stocks are shown."""


def write_trajectory(folder: Path, name: str, simulation: Simulation, title: str) -> list[Path]:
    """Write ``name.csv`` and ``name.png`` of a simulated episode; return their paths.

    The first holds the table of the episode. The picture shows λ as a mean, as it does the flows. Of a network with
    lifetimes ``name_ages.csv`` and ``name_ages.png`` show how old what is in use is, of one with accounts
    ``name_accounts.csv`` and ``name_accounts.png`` what each compartment books.
    """
    network = simulation.env.network
    files = [simulation.write(folder / f"{name}.csv"), save_trajectory(folder / f"{name}.png", simulation, title=title)]
    if network.accounts:
        files += write_accounts(folder, name, simulation, title)
    if of_ages := pyramids(network, simulation.rollout):
        files.append(write_table(folder / f"{name}_ages.csv", *ages_table(network, of_ages)))
        files.append(save_pyramids(folder / f"{name}_ages.png", network, of_ages, title=title))
    return files


def ages_table(network: Network, of_ages: Sequence[Pyramid]) -> tuple[list[str], list[list[object]]]:
    """Return header and rows of age pyramids: a row for each node, time and age that there is something of."""
    mass, time = network.mass_unit, network.time_unit
    header, clock = time_columns(network, np.append(0.0, interval_ends(network)))
    header += ["node", f"from the age of ({time})", f"to the age of ({time})", f"stock ({mass})"]
    rows: list[list[object]] = []
    for pyramid in of_ages:
        edges = (pyramid.interval * np.arange(pyramid.mass.shape[1] + 1)).tolist()
        for time_cells, masses in zip(clock, pyramid.mass.tolist(), strict=True):
            classes = zip(edges[:-1], edges[1:], masses, strict=True)
            rows += [[*time_cells, pyramid.node, *cells] for cells in classes if cells[-1] > 0]
    return header, rows


def save_pyramids(path: str | Path, network: Network, of_ages: Sequence[Pyramid], *, title: str) -> Path:
    """Save the age pyramids of nodes, at the start and at the end of an episode, as a PNG and return its path."""
    largest = sorted(of_ages, key=lambda pyramid: -float(pyramid.mass.sum(axis=1).max()))[:PYRAMIDS]
    count = math.ceil(len(largest) / PYRAMID_COLUMNS)
    figure = Figure(figsize=(WIDTH, 0.6 + 2.8 * count), layout="constrained")
    panels = figure.subplots(count, min(PYRAMID_COLUMNS, len(largest)), squeeze=False)
    _, dates = labels(network, np.array([0.0, interval_ends(network)[-1]]))
    first, last = dates[0] if dates else ("start", "end")
    for panel, pyramid in zip(panels.flat, largest, strict=False):
        oldest = int(np.flatnonzero(pyramid.mass[[0, -1]].max(axis=0) > 0).max(initial=0)) + 1
        before, after = pyramid.mass[[0, -1], :oldest]
        panel.barh(pyramid.ages[:oldest], after, height=pyramid.interval, color=SERIES[0], label=last)
        edges = pyramid.interval * np.arange(oldest + 1)
        panel.stairs(before, edges, orientation="horizontal", color=SERIES[1], label=first)
        unit = f"{network.mass_unit}" if pyramid.interval == 1 else f"{network.mass_unit} in {pyramid.interval:g}"
        style_axes(panel, title=readable(pyramid.node), ylabel=f"age / {network.time_unit}")
        panel.set_xlabel(unit)
    for panel in list(panels.flat)[len(largest) :]:
        panel.remove()
    panels.flat[0].legend(frameon=False, loc="upper right")
    figure.suptitle(title)
    return save(figure, path)
