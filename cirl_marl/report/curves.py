"""Curves: circularity and service over time and against each other, learning curves, and trajectories."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cirl_marl.controllers.rollout import Rollout, interval_ends
from cirl_marl.drawing.style import (
    DASHES,
    FAINT,
    GRID,
    INK,
    SERIES,
    WIDTH,
    axis_time,
    readable,
    save,
    style_axes,
    time_axis,
)
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.evaluation.statistics import mean_interval
from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Law

AGENT_PANELS = 20
MOST_CURVES = 10
"""Largest number of compartments in one panel of a trajectory."""
SCALE, SCALES = 10.0, 3
"""Ratio of stocks from which on they stand in panels of their own, and the most panels of stocks."""
MARKERS = "osD^vP*X"
LEAST_SERVICE, LEAST_CIRCULARITY = 0.02, 0.05
"""Least range of service levels, and of λ̄ relative to itself, in pictures of both."""


@dataclass(frozen=True, slots=True)
class PointSeries:
    """Points of one kind in the plane of service level and λ̄, mass, shape (points,) each; a line if ``is_line``."""

    name: str
    service: Floats
    circularity: Floats
    is_line: bool = False


def save_circularity(path: str | Path, network: Network, runs: Mapping[str, Rollout], *, title: str = "") -> Path:
    """Save λ over time and, below it, the service level of several controls as a PNG and return its path.

    Lines are means over the episodes of ``runs``, by control; bands are the 95 % confidence intervals of the means
    (Student's t), where there are at least two episodes.
    """
    time = axis_time(interval_ends(network) - network.episode.control_interval / 2, network)
    figure = Figure(figsize=(WIDTH, 5.4), layout="constrained")
    above, below = figure.subplots(2, 1, sharex=True, height_ratios=(1.7, 1))
    for place, (name, run) in enumerate(runs.items()):
        _draw_mean(above, time, run.circularity_mean, name, place)
        _draw_mean(below, time, run.service, name, place, top=1.0)
    subject = "Mean circularity of each step, averaged over episodes, with 95 % intervals"
    style_axes(above, title=title or subject, ylabel=f"λ / {network.mass_unit}")
    style_axes(below, title="Service level", ylabel="service level")
    below.set_ylim(-0.03, 1.06)
    time_axis(below, time, network)
    figure.legend(*above.get_legend_handles_labels(), loc="outside upper right", ncols=4, frameon=False, fontsize=9)
    return save(figure, path)


def save_learning_curves(path: str | Path, steps: Floats, returns: Mapping[str, Floats]) -> Path:
    """Save the episode returns of each agent while it learned as a PNG, one panel per agent; return its path.

    Raw returns are light, their centred moving average over a fifteenth of the episodes is bold. Of more
    than 20 agents the first 20 are shown. ``steps`` are environment steps at the end of each episode, and ``returns``
    those of episodes by agent, shape (episodes,) each.
    """
    agents = list(returns.items())[:AGENT_PANELS]
    columns = max(1, min(len(agents), 3 if len(agents) <= 9 else 4))
    rows = max(1, math.ceil(len(agents) / columns))
    figure = Figure(figsize=(WIDTH, 0.7 + max(1.7 * rows, 2.6)), layout="constrained")
    panels = figure.subplots(rows, columns, squeeze=False, sharex=True).ravel()
    for axes, (agent, values) in zip(panels, agents, strict=False):
        _draw_returns(axes, steps, values)
        style_axes(axes, title=readable(agent), size=8.0)
        axes.locator_params(nbins=4)
    for axes in panels[len(agents) :]:
        axes.set_axis_off()
    for axes in panels[: len(agents)][-columns:]:
        axes.tick_params(labelbottom=True)  # nothing may lie below the last panel of a column
    figure.supxlabel("environment steps", fontsize=9, color=FAINT)
    figure.supylabel("episode return", fontsize=9, color=FAINT)
    if len(returns) > len(agents):
        figure.suptitle(f"The first {len(agents)} of {len(returns)} agents", fontsize=9, color=FAINT)
    return save(figure, path)


def save_trajectory(path: str | Path, simulation: Simulation, *, title: str = "") -> Path:
    """Save λ, service level, stocks and flows of a simulated episode over time as a PNG and return its path.

    Stocks that are ten times smaller than others have a panel of their own. Of more than 10 compartments in a panel,
    those that change most are shown.
    """
    network, run, mass = simulation.network, simulation.rollout, simulation.network.mass_unit
    on_the_way = [network.compartments[arc.id].label for arc in network.arcs if arc.law is Law.BATCH]
    labels = [*(node.label for node in network.stores), *(f"on {label}" for label in on_the_way)]
    stock = np.vstack([np.append(run.start, run.start_load), np.column_stack([run.stock, run.load])]).T
    # what is a mean over an interval stands in its middle, a stock at its end
    ends, interval = interval_ends(network), network.episode.control_interval
    middle, stock_times = (axis_time(times, network) for times in (ends - interval / 2, np.append(0.0, ends)))
    groups = _by_scale(np.abs(np.nan_to_num(stock)).max(axis=1, initial=0.0))
    heights = [1.25 if len(groups) == 1 else 0.9] * len(groups) + [1.25, 0.8, *([0.5] if network.services else [])]
    figure = Figure(figsize=(WIDTH, 2.5 * sum(heights)), layout="constrained")
    heading = title or f"{network.title or network.name}, {simulation.control}"
    figure.suptitle(heading, fontsize=11, fontweight="bold")
    panels = figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    for place, (axes, rows) in enumerate(zip(panels, groups, strict=False)):
        name = "Stocks" if place == 0 else "Smaller stocks" if place == 1 else "The smallest stocks"
        _draw_largest(axes, stock_times, stock[rows], [labels[row] for row in rows], name, mass)
    flows, lambdas = panels[len(groups) : len(groups) + 2]
    arcs, unit = [arc.label for arc in network.arcs], f"{mass}/{network.time_unit}"
    _draw_largest(flows, middle, run.flow.T, arcs, "Mean flows", unit)
    _draw_mean(lambdas, middle, run.circularity_mean[:1], "", 0)
    style_axes(lambdas, title="Mean circularity", ylabel=f"λ / {mass}")
    if network.services:
        _draw_mean(panels[-1], middle, run.service[:1], "", 0)
        style_axes(panels[-1], title="Service level", ylabel="service level")
        panels[-1].set_ylim(-0.03, 1.06)
    time_axis(panels[-1], stock_times, network)
    return save(figure, path)


def save_fronts(
    path: str | Path, network: Network, series: Sequence[PointSeries], bound: Floats, *, title: str
) -> Path:
    """Save λ̄ against the service level of policies, plans or controllers as a PNG and return its path.

    Of several services it is the mean level of the one that lacks most. ``bound`` is the level of every service and the
    bound on λ̄, shape (points, 2), by level; what lies above is shaded. Empty for none.
    """
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    axes = figure.subplots()
    for place, points in enumerate(series):
        look: Any = {"linestyle": DASHES[place % len(DASHES)] if points.is_line else "", "linewidth": 1.4, "alpha": 0.9}
        look |= {"color": SERIES[place % len(SERIES)], "label": readable(points.name)}
        look["marker"] = MARKERS[(place + place // len(SERIES)) % len(MARKERS)]  # colours come round before pairs do
        axes.plot(points.service, points.circularity, **look)
    _widen(axes)
    if len(bound):
        _draw_bound(axes, bound)
    style_axes(axes, title=title, ylabel=f"λ̄ / {network.mass_unit}")
    axes.ticklabel_format(useOffset=False)
    of = "" if len(network.services) < 2 else " of the service that lacks most"
    axes.set_xlabel(f"mean service level{of}", fontsize=9)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8, borderaxespad=0)
    return save(figure, path)


def _widen(axes: Axes) -> None:
    """Show at least 2 points of service and 5 % of λ̄: what lies closer together is much the same."""
    widest = LEAST_CIRCULARITY * max(map(abs, axes.get_ylim()))
    for axis, least in ((axes.xaxis, LEAST_SERVICE), (axes.yaxis, widest)):
        low, high = axis.get_view_interval()
        if (gap := least - (high - low)) > 0:
            set_limits = axes.set_xlim if axis is axes.xaxis else axes.set_ylim
            set_limits(low - gap / 2, high + gap / 2)


def _dots(time: Floats) -> str:
    """A single point makes no line: mark it."""
    return "o" if len(time) == 1 else ""


def _draw_mean(axes: Axes, time: Floats, values: Floats, name: str, index: int, top: float = math.inf) -> None:
    """Draw the mean of episodes, shape (episodes, steps), with its interval, which ends at ``top``."""
    colour, dash = SERIES[index % len(SERIES)], DASHES[index % len(DASHES)]
    mean, low, high = mean_interval(values, (-math.inf, top))
    axes.plot(time, mean, color=colour, linestyle=dash, linewidth=1.8, label=readable(name), marker=_dots(time))
    if len(values) > 1:
        axes.fill_between(time, low, high, color=colour, alpha=0.2, linewidth=0)


def _draw_returns(axes: Axes, steps: Floats, values: Floats) -> None:
    if values.size == 0:
        axes.text(0.5, 0.5, "no episodes", transform=axes.transAxes, ha="center", va="center", color=FAINT, fontsize=8)
        return
    marker = "o" if values.size < 5 else ""
    axes.plot(steps, values, color=SERIES[5], linewidth=0.7, alpha=0.7, marker=marker, markersize=4)
    if values.size >= 5:
        axes.plot(steps, _moving_average(values, max(3, values.size // 15)), color=SERIES[0], linewidth=2.0)


def _moving_average(values: Floats, window: int) -> Floats:
    """Centred moving average over about ``window`` values, fewer at the ends and where some are not finite."""
    finite = np.isfinite(values)
    weights = np.ones(2 * (window // 2) + 1)
    total, count = (np.convolve(terms, weights, "same") for terms in (np.where(finite, values, 0.0), finite))
    return np.asarray(np.divide(total, count, out=np.full(len(values), np.nan), where=count > 0))


def _draw_largest(axes: Axes, time: Floats, values: Floats, names: Sequence[str], title: str, unit: str) -> None:
    """Draw the rows that change most, with a legend beside the panel."""
    change = np.ptp(values, axis=1) if values.size else np.zeros(len(values))
    largest = np.sort(np.argsort(-change, kind="stable")[:MOST_CURVES])
    for place, row in enumerate(largest.tolist()):
        colour, dash = SERIES[place % len(SERIES)], DASHES[place // len(SERIES)]
        axes.plot(time, values[row], dash, color=colour, linewidth=1.5, label=names[row], marker=_dots(time))
    axes.ticklabel_format(axis="y", useOffset=False)
    more = f": {MOST_CURVES} of {len(names)}, the largest changes" if len(names) > MOST_CURVES else ""
    style_axes(axes, title=title + more, ylabel=unit)
    if len(largest):
        axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8, borderaxespad=0)


def _by_scale(largest: Floats) -> list[list[int]]:
    """Return rows in groups, each in its order, so that none is ten times smaller than another of its group.

    There are at most three groups; the last takes all that is left.
    """
    groups: list[list[int]] = []
    top = np.inf
    for row in np.argsort(-largest, kind="stable").tolist():
        if not groups or (largest[row] < top / SCALE and len(groups) < SCALES):
            groups.append([])
            top = largest[row]
        groups[-1].append(row)
    return [sorted(group) for group in groups] or [[]]


def _draw_bound(axes: Axes, bound: Floats) -> None:
    """Draw the front of the bounds and shade what it rules out.

    The bound for a service holds for every higher one, so steps are what is proved, for the start that it is of. Where
    points are means over other starts, as that of their middle, one of them may lie above.
    """
    low, high = axes.get_ylim()
    high = max(high, float(bound[:, 1].max()) + 0.05 * (high - low))
    service, most = np.append(bound[:, 0], 1.0), np.append(bound[:, 1], bound[-1, 1])
    axes.step(service, most, where="post", color=INK, linewidth=1.6, label="bound")
    axes.fill_between(service, most, high, step="post", color=GRID, linewidth=0, zorder=0)
    note, below = "proved out of reach from a middle start", (-4, -12)
    axes.annotate(note, (1.0, high), xytext=below, textcoords="offset points", ha="right", fontsize=8, color=FAINT)
    axes.set_ylim(low, high)
