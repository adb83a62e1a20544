"""Pictures of how old what is in use is."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from cirl_marl.controllers.pyramids import Pyramid
from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import SERIES, dressed, save, spoken
from cirl_marl.network import Network
from cirl_marl.network.calendar import labels
from cirl_marl.report.curves import WIDTH

COLUMNS, SHOWN = 3, 12
"""Panels side by side, and most of them; those with the largest stocks are shown."""


def save_pyramids(path: str | Path, network: Network, found: Sequence[Pyramid], *, title: str) -> Path:
    """Save the age pyramids of nodes, at the start and at the end of an episode, as a PNG and return its path."""
    shown = sorted(found, key=lambda each: -float(each.mass.sum(axis=1).max()))[:SHOWN]
    count = math.ceil(len(shown) / COLUMNS)
    figure = Figure(figsize=(WIDTH, 0.6 + 2.8 * count), layout="constrained")
    panels = figure.subplots(count, min(COLUMNS, len(shown)), squeeze=False)
    ends = np.array([0.0, interval_ends(network)[-1]])
    named = [column for _, column in zip(*labels(network, ends), strict=True)] or [["start", "end"]]
    for panel, each in zip(panels.flat, shown, strict=False):
        ages, last = each.ages, int(np.flatnonzero(each.mass[[0, -1]].max(axis=0) > 0).max(initial=0)) + 1
        panel.barh(ages[:last], each.mass[-1, :last], height=each.interval, color=SERIES[0], label=named[0][1])
        edges = each.interval * np.arange(last + 1)
        panel.stairs(each.mass[0, :last], edges, orientation="horizontal", color=SERIES[1], label=named[0][0])
        unit = f"{network.mass_unit}" if each.interval == 1 else f"{network.mass_unit} in {each.interval:g}"
        dressed(panel, title=spoken(each.node), ylabel=f"age / {network.time_unit}")
        panel.set_xlabel(unit)
    for panel in list(panels.flat)[len(shown) :]:
        panel.remove()
    panels.flat[0].legend(frameon=False, loc="upper right")
    figure.suptitle(title)
    return save(figure, path)
