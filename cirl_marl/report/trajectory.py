"""One simulated episode on disk: a table and a picture of it, and the same of how old is what is in use."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cirl_marl.controllers.pyramids import Pyramid, pyramids
from cirl_marl.controllers.rollout import EpisodeStart, Rollout, interval_ends
from cirl_marl.drawing.style import SERIES, readable, save, style_axes
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Network
from cirl_marl.network.calendar import labels
from cirl_marl.records.files import write_atomically, write_table
from cirl_marl.report.curves import WIDTH, save_trajectory

PYRAMID_COLUMNS, PYRAMIDS = 3, 12
"""Panels side by side, and most of them; those with the largest stocks are shown."""


def write_trajectory(
    folder: Path, name: str, env: MultiAgentVectorEnv, begun: EpisodeStart, run: Rollout, title: str
) -> list[Path]:
    """Write ``name.csv`` and ``name.png`` of what ``run`` did in ``env`` from where it began; return their paths.

    The first holds what ``trajectory_table`` returns. The picture shows λ as a mean, as it does the flows. Of a network
    with lifetimes ``name_ages.csv`` and ``name_ages.png`` show how old what is in use is. ``env`` is left at the start
    of the episode.
    """
    folder.mkdir(parents=True, exist_ok=True)
    table, picture = folder / f"{name}.csv", folder / f"{name}.png"
    header, rows = trajectory_table(env, begun, run)
    write_atomically(table, lambda partial: write_table(partial, header, rows))
    start = env.physical.stock
    stock = env.rows.stocks(start)[:, 0]
    save_trajectory(
        picture,
        env.network,
        interval_ends(env.network),
        run.stock.T,
        run.flow.T,
        run.circularity_mean[0],
        start=np.concatenate([stock, env.dynamics.batches.loads(start)[:, 0]]),
        load=run.load.T,
        service=run.service[0] if env.network.services else None,
        title=title,
    )
    found = pyramids(env.network, run, stock)
    if not found:
        return [table, picture]
    ages, bars = folder / f"{name}_ages.csv", folder / f"{name}_ages.png"
    write_atomically(ages, lambda partial: write_table(partial, *ages_table(env.network, found)))
    save_pyramids(bars, env.network, found, title=title)
    return [table, picture, ages, bars]


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


def trajectory_table(
    env: MultiAgentVectorEnv, begun: EpisodeStart, run: Rollout
) -> tuple[list[str], list[list[object]]]:
    """Return header and rows of what ``run`` did in ``env`` from where it began.

    There is a row for the start and one for the end of each interval: year or date at the end, if the network has a
    start on the calendar, λ at the end and the mean of λ, the service level, stocks at the end, mean flows, what passes
    through nodes without stock, masses on the way, inner states that an agent may see and mean ages. ``env`` is left at
    the start of the episode.
    """
    begun.reset(env)
    start = env.physical
    stock, load = env.rows.stocks(start.stock)[:, 0], env.dynamics.batches.loads(start.stock)[:, 0]
    inner = start.inner[env.dynamics.inner.visible, 0]
    lambdas, moved = (run.circularity[0], run.circularity_mean[0]), (*run.flow.T, *env.network.throughput(run.flow.T))
    ages = [each.mean_age for each in pyramids(env.network, run, stock)]
    columns = (*lambdas, run.service[0], *run.stock.T, *moved, *run.load.T, *run.inner.T, *(age[1:] for age in ages))
    known = [*load.tolist(), *inner.tolist(), *(float(age[0]) for age in ages)]
    first = [*[None] * 3, *stock.tolist(), *[None] * len(moved), *known]
    times = np.concatenate([[0.0], interval_ends(env.network)])
    clock = zip(times.tolist(), *labels(env.network, times)[1], strict=True)
    measured = [first, *zip(*(column.tolist() for column in columns), strict=True)]
    return _header(env), [[*at, *values] for at, values in zip(clock, measured, strict=True)]


def _header(env: MultiAgentVectorEnv) -> list[str]:
    network, physics = env.network, env.dynamics.inner
    mass, time = network.mass_unit, network.time_unit
    header = [f"time ({time})", *(f"{each} at the end" for each in labels(network, 0.0)[0])]
    header += [f"circularity at the end ({mass})", f"mean circularity ({mass})", "service level"]
    header += [f"stock of {node.id} ({mass})" for node in network.stores]
    header += [f"flow of {arc.id} ({mass}/{time})" for arc in network.arcs]
    header += [f"throughput of {node.id} ({mass}/{time})" for node in network.nodes if not node.stores]
    header += [f"mass on {line.id} ({mass})" for line in env.dynamics.batches.lines]
    header += [physics.names[row] for row in physics.visible]
    return [*header, *(f"mean age of {node.id} ({time})" for node in network.stores if node.lifetime is not None)]
