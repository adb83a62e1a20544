"""Colours, numbers and the writing of pictures that all reports share."""

from __future__ import annotations

import math
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.backends.backend_agg import FigureCanvasAgg

from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import years
from cirl_marl.network.elements import Role
from cirl_marl.records.files import write_atomically

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

INK = "#222222"
FAINT = "#5f6368"
GRID = "#e3e5e8"
WARNING = "#d55e00"
GOOD = "#009e73"
NEUTRAL = "#9aa0a6"
# Okabe and Ito's palette, which people with any kind of colour blindness can tell apart.
SERIES = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#7f7f7f", "#000000")
DASHES = ("-", "--", "-.", ":")
ROLE_COLOURS = {
    Role.NONRENEWABLE_RESERVOIR: "#e8b84a",
    Role.TECHNOSPHERE: "#9db4d6",
    Role.LANDFILL: "#c9a3c4",
    Role.INCINERATOR: "#c9a3c4",
    Role.ENVIRONMENT: "#86d0e6",
}
DPI = 200
WIDTH = 9.0
"""Width of a figure, inch; shown 900 pixels wide, 9 points are about 12 pixels."""
_SUPERSCRIPT = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def number(value: float) -> str:
    """Write a value with three digits, without an exponent unless it is very large or small.

    >>> number(46.83), number(-1830.84), number(1e6), number(0.0)
    ('46.8', '−1831', '1×10⁶', '0')
    """
    if not math.isfinite(value):
        return str(value)
    size = abs(value)
    if size < 1e-9:
        return "0"
    if 1e-3 <= size < 99_999.5:
        text = f"{value:.0f}" if size >= 99.95 else f"{value:.3g}"
        return text.replace("-", "−")
    mantissa, exponent = f"{value:.2e}".split("e")
    mantissa = mantissa.rstrip("0").rstrip(".").replace("-", "−")
    return f"{mantissa}×10{str(int(exponent)).translate(_SUPERSCRIPT)}"


def check_shape(name: str, values: Floats, shape: tuple[int, ...]) -> Floats:
    """Return ``values`` as floats; a ``CirlError`` names them if they have another shape."""
    numbers = np.asarray(values, dtype=float)
    if numbers.shape != shape:
        raise CirlError(f"{name} has shape {numbers.shape}, expected {shape}")
    return numbers


def label_lines(label: str, letters: int) -> tuple[str, ...]:
    """Break a label at its spaces into lines of so many letters."""
    return tuple(textwrap.wrap(label, letters, break_long_words=False, break_on_hyphens=False)) or ("",)


def readable(identifier: str) -> str:
    """Write an id with spaces."""
    return identifier.replace("_", " ")


def style_axes(axes: Axes, *, title: str = "", ylabel: str = "", size: float = 9.0) -> None:
    """Give axes the plain look of the reports, without touching matplotlib's settings."""
    axes.set_title(title, loc="left", fontsize=size + 1, color=INK, fontweight="bold")
    axes.set_ylabel(ylabel, fontsize=size, color=INK)
    axes.tick_params(labelsize=size - 1, color=GRID, labelcolor=FAINT)
    axes.grid(True, color=GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    for side, spine in axes.spines.items():
        spine.set_visible(side in ("left", "bottom"))
        spine.set_color(NEUTRAL)


def draw_steps(axes: Axes, steps: Floats, colours: Sequence[str], notes: Sequence[str], *, start: float = 0.0) -> None:
    """Draw a waterfall: a bar for each step, one below the other from 1 on, each from where the one above it ends."""
    ends = start + np.cumsum(steps)
    span = np.ptp(np.append(ends, start)) or 1.0
    axes.plot([start, start], [0, 1], color=NEUTRAL, linewidth=0.8)
    for place, (end, step, colour, note) in enumerate(zip(ends, steps, colours, notes, strict=True), 1):
        axes.barh(place, step, left=end - step, height=0.62, color=colour)
        axes.plot([end, end], [place, place + 1], color=NEUTRAL, linewidth=0.8)
        axes.text(max(end, end - step) + 0.015 * span, place, note, va="center", fontsize=8, color=INK)


def axis_time(time: Floats, network: Network) -> Floats:
    """Return times as axes show them: as calendar years, if the network has a start."""
    return time if network.episode.start is None else years(network, time)


def time_axis(axes: Axes, time: Floats, network: Network) -> None:
    """Let the horizontal axis span ``time``, given as ``dated`` returns it, and name it."""
    axes.set_xlabel("year" if network.episode.start is not None else f"time / {network.time_unit}", fontsize=9)
    axes.ticklabel_format(axis="x", useOffset=False)  # 2000, not 0 with +2e3 in a corner
    if len(time) > 1:
        axes.set_xlim(float(np.min(time)), float(np.max(time)))


def save(figure: Figure, path: str | Path) -> Path:
    """Write ``figure`` as a PNG and return the path; a reader never sees half of it, and missing folders are made."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    FigureCanvasAgg(figure)
    write_atomically(target, lambda part: figure.savefig(part, format="png", dpi=DPI, facecolor="white"))
    return target
