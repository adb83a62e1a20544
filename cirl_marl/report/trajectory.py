"""One simulated episode on disk: a table and a picture of it, and the same of how old is what is in use."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cirl_marl.controllers.pyramids import Pyramid, pyramids
from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import SERIES, readable, save, style_axes
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.network import Network
from cirl_marl.network.calendar import labels
from cirl_marl.records.files import write_atomically, write_table
from cirl_marl.report.curves import WIDTH, save_trajectory

PYRAMID_COLUMNS, PYRAMIDS = 3, 12
"""Panels side by side, and most of them; those with the largest stocks are shown."""


def write_trajectory(folder: Path, name: str, simulation: Simulation, title: str) -> list[Path]:
    """Write ``name.csv`` and ``name.png`` of a simulated episode; return their paths.

    The first holds the table of the episode. The picture shows λ as a mean, as it does the flows. Of a network with
    lifetimes ``name_ages.csv`` and ``name_ages.png`` show how old what is in use is. The environment of the simulation
    is left at the start of the episode.
    """
    env, run = simulation.env, simulation.rollout
    table = simulation.write(folder / f"{name}.csv")
    picture = draw_trajectory(folder / f"{name}.png", simulation, title)
    found = pyramids(env.network, run, simulation.start)
    if not found:
        return [table, picture]
    ages, bars = folder / f"{name}_ages.csv", folder / f"{name}_ages.png"
    write_atomically(ages, lambda partial: write_table(partial, *ages_table(env.network, found)))
    save_pyramids(bars, env.network, found, title=title)
    return [table, picture, ages, bars]


def draw_trajectory(path: Path, simulation: Simulation, title: str) -> Path:
    """Save λ, service level, stocks and flows of a simulated episode over time as a PNG; return its path."""
    env, run = simulation.env, simulation.rollout
    simulation.episode_start.reset(env)
    return save_trajectory(
        path,
        env.network,
        interval_ends(env.network),
        run.stock.T,
        run.flow.T,
        run.circularity_mean[0],
        start=np.concatenate([simulation.start, env.dynamics.batches.loads(env.physical.stock)[:, 0]]),
        load=run.load.T,
        service=run.service[0] if env.network.services else None,
        title=title,
    )


def ages_table(network: Network, found: Sequence[Pyramid]) -> tuple[list[str], list[list[object]]]:
    """Return header and rows of age pyramids: a row for each node, time and age that there is something of."""
    mass, time = network.mass_unit, network.time_unit
    header = [f"time ({time})", *(f"{each} at the end" for each in labels(network, 0.0)[0]), "node"]
    header += [f"from the age of ({time})", f"to the age of ({time})", f"stock ({mass})"]
    times = np.concatenate([[0.0], interval_ends(network)])
    clock = [list(each) for each in zip(times.tolist(), *labels(network, times)[1], strict=True)]
    rows: list[list[object]] = []
    for each in found:
        edges = (each.interval * np.arange(each.mass.shape[1] + 1)).tolist()
        for at, masses in zip(clock, each.mass.tolist(), strict=True):
            rows += [[*at, each.node, edges[i], edges[i + 1], held] for i, held in enumerate(masses) if held > 0]
    return header, rows


def save_pyramids(path: str | Path, network: Network, found: Sequence[Pyramid], *, title: str) -> Path:
    """Save the age pyramids of nodes, at the start and at the end of an episode, as a PNG and return its path."""
    shown = sorted(found, key=lambda each: -float(each.mass.sum(axis=1).max()))[:PYRAMIDS]
    count = math.ceil(len(shown) / PYRAMID_COLUMNS)
    figure = Figure(figsize=(WIDTH, 0.6 + 2.8 * count), layout="constrained")
    panels = figure.subplots(count, min(PYRAMID_COLUMNS, len(shown)), squeeze=False)
    ends = np.array([0.0, interval_ends(network)[-1]])
    named = [column for _, column in zip(*labels(network, ends), strict=True)] or [["start", "end"]]
    for panel, each in zip(panels.flat, shown, strict=False):
        ages, last = each.ages, int(np.flatnonzero(each.mass[[0, -1]].max(axis=0) > 0).max(initial=0)) + 1
        panel.barh(ages[:last], each.mass[-1, :last], height=each.interval, color=SERIES[0], label=named[0][1])
        edges = each.interval * np.arange(last + 1)
        panel.stairs(each.mass[0, :last], edges, orientation="horizontal", color=SERIES[1], label=named[0][0])
        unit = f"{network.mass_unit}" if each.interval == 1 else f"{network.mass_unit} in {each.interval:g}"
        style_axes(panel, title=readable(each.node), ylabel=f"age / {network.time_unit}")
        panel.set_xlabel(unit)
    for panel in list(panels.flat)[len(shown) :]:
        panel.remove()
    panels.flat[0].legend(frameon=False, loc="upper right")
    figure.suptitle(title)
    return save(figure, path)
