"""Small multiples: many quantities over the same time, a panel each in two columns, with one legend below."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import WIDTH, axis_time, save, style_axes, time_axis
from cirl_marl.network import Network

PANELS, COLUMNS = 8, 2
"""Largest number of panels of a picture, and how many stand side by side."""
LINE = 80
"""Characters of a line of the title."""
LEVELS = (-0.03, 1.06)
"""Limits of axes that show service levels."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One quantity over time: its heading and unit, a function that draws it, and the limits of the vertical axis."""

    title: str
    unit: str
    draw: Callable[[Axes], object]
    limits: tuple[float | None, float | None] | None = None


def save_panels(path: str | Path, network: Network, panels: Sequence[Panel], *, title: str, legend: int) -> Path:
    """Save panels as a PNG and return its path; the legend, in so many columns, is that of the first panel."""
    rows = math.ceil(len(panels) / COLUMNS)
    figure = Figure(figsize=(WIDTH, 1.0 + 2.1 * rows), layout="constrained")
    figure.suptitle(textwrap.fill(title, LINE), fontsize=11, fontweight="bold")
    grid = figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    span = axis_time(np.array([0.0, interval_ends(network)[-1]]), network)
    for axes, panel in zip(grid, panels, strict=False):
        panel.draw(axes)
        style_axes(axes, title=panel.title, ylabel=panel.unit, size=8.0)
        if panel.limits is not None:
            axes.set_ylim(*panel.limits)
        time_axis(axes, span, network)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    handles, labels = grid[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=legend, frameon=False, fontsize=9)
    return save(figure, path)
