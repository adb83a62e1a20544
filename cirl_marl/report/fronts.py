"""Circularity against service: where policies are, and what is proved to be out of reach."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.figure import Figure

from cirl_marl.drawing.style import DASHES, GRID, INK, MUTED, SERIES, dressed, save, spoken
from cirl_marl.network import Floats, Network
from cirl_marl.report.curves import WIDTH

if TYPE_CHECKING:
    from matplotlib.axes import Axes

MARKERS = "osD^vP*X"


@dataclass(frozen=True, slots=True)
class PointSeries:
    """Points of one kind in the plane of mean service level and λ̄, mass, shape (points,) each; ``joined`` by a line."""

    name: str
    service: Floats
    circularity: Floats
    joined: bool = False


def save_fronts(
    path: str | Path, network: Network, series: Sequence[PointSeries], bound: Floats, *, title: str
) -> Path:
    """Save λ̄ against the service level of policies, plans or controllers as a PNG and return its path.

    ``bound`` is service level and bound on λ̄, shape (points, 2), by service; what lies above is shaded. Empty for none.
    """
    figure = Figure(figsize=(WIDTH, 5.2), layout="constrained")
    axes = figure.subplots()
    for place, each in enumerate(series):
        colour = SERIES[place % len(SERIES)]
        line = DASHES[place % len(DASHES)] if each.joined else ""
        axes.plot(
            each.service,
            each.circularity,
            color=colour,
            marker=MARKERS[(place + place // len(SERIES)) % len(MARKERS)],  # colours come round before pairs do
            linestyle=line,
            linewidth=1.4,
            alpha=0.9,
            label=spoken(each.name),
        )
    if len(bound):
        _draw_bound(axes, bound)
    dressed(axes, title=title, ylabel=f"λ̄ / {network.mass_unit}")
    axes.set_xlabel("mean service level", fontsize=9)
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1.0), frameon=False, fontsize=8, borderaxespad=0)
    return save(figure, path)


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
    axes.annotate(note, (1.0, high), xytext=below, textcoords="offset points", ha="right", fontsize=8, color=MUTED)
    axes.set_ylim(low, high)
