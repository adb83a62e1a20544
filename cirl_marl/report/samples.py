"""Bands of uncertain episodes: tables, what causes their spread, and a picture."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import SERIES, axis_time, readable, save, style_axes, time_axis
from cirl_marl.evaluation.sampling import SampledEpisodes, Sensitivity
from cirl_marl.evaluation.statistics import defined
from cirl_marl.network import Floats
from cirl_marl.network.calendar import labels
from cirl_marl.records.files import publish_folder, write_table
from cirl_marl.report.curves import WIDTH

QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
PANELS, COLUMNS = 8, 2
ROWS = 8
"""Largest number of causes in a table on screen."""


def sensitivity_table(found: SampledEpisodes, causes: Sequence[Sensitivity]) -> Table:
    """Return the numbers that cause most of the spread, with the share of each figure that they cause."""
    table = Table(title="share of the spread that a number causes by itself")
    table.add_column("number")
    for each in causes:
        table.add_column(each.figure, justify="right")
    for i in _ranked(causes)[:ROWS]:
        table.add_row(found.names[i], *(_said(each, i) for each in causes))
    return table


def _ranked(causes: Sequence[Sensitivity]) -> list[int]:
    """Return the numbers, first what causes most of the spread of anything."""
    most = np.nan_to_num(np.array([each.shares for each in causes]), nan=-1.0).max(axis=0)
    return [int(i) for i in np.argsort(-most, kind="stable")]


def _said(each: Sensitivity, i: int) -> str:
    if math.isnan(each.shares[i]):
        return "–"
    return f"{max(0.0, each.shares[i]):.0%} ± {each.margins[i]:.0%}"


def write_samples(
    folder: Path, name: str, found: SampledEpisodes, causes: Sequence[Sensitivity], *, title: str
) -> list[Path]:
    """Write ``name_bands.csv``, ``name_draws.csv``, ``name_causes.csv`` and ``name_bands.png``, all or none.

    Bands are quantiles of each quantity over the samples, by time. Draws are what was drawn in each sample and what
    came of it. Causes are first-order Sobol indices with 95 % intervals; there are none of too few samples.
    """
    network = found.network
    times = interval_ends(network)
    clock = [list(each) for each in zip(times.tolist(), *labels(network, times)[1], strict=True)]
    header = [f"time ({network.time_unit})", *(f"{each} at the end" for each in labels(network, 0.0)[0])]
    header += ["quantity", "unit", "mean", *(f"quantile {each:g}" for each in QUANTILES)]
    files = [f"{name}_bands.csv", f"{name}_draws.csv", *([f"{name}_causes.csv"] if causes else []), f"{name}_bands.png"]
    with publish_folder(folder) as partial:
        rows = []
        for quantity, unit, values in _quantities(found):
            bands = [values.mean(axis=0), *np.quantile(values, QUANTILES, axis=0)]
            rows += [[*at, quantity, unit, *now] for at, now in zip(clock, np.transpose(bands).tolist(), strict=True)]
        write_table(partial / files[0], header, rows)
        write_table(partial / files[1], *_draws(found))
        if causes:
            write_table(partial / files[2], *_causes(found, causes))
        save_bands(partial / files[-1], found, title=title)
    return [folder / file for file in files]


def _draws(found: SampledEpisodes) -> tuple[list[str], list[list[object]]]:
    network = found.network
    header = ["sample", *(f"factor on {name}" for name in found.names), f"mean circularity ({network.mass_unit})"]
    header += [f"mean level of {service.id}" for service in network.services]
    columns = [found.factors, found.circularity.mean(axis=1)[:, None], found.levels.mean(axis=2)]
    return header, [[i, *row] for i, row in enumerate(np.concatenate(columns, axis=1).tolist())]


def _causes(found: SampledEpisodes, causes: Sequence[Sensitivity]) -> tuple[list[str], list[list[object]]]:
    header = ["number", *(part for each in causes for part in (f"share of {each.figure}", "half-width"))]
    return header, [
        [found.names[i], *(defined(float(part)) for each in causes for part in (each.shares[i], each.margins[i]))]
        for i in _ranked(causes)
    ]


def _quantities(found: SampledEpisodes) -> Iterator[tuple[str, str, Floats]]:
    """Yield name, unit and values, shape (samples, steps), of everything that has a band."""
    network = found.network
    mass, flow = network.mass_unit, f"{network.mass_unit}/{network.time_unit}"
    yield "mean circularity", mass, found.circularity
    yield from ((f"level of {each.id}", "1", found.levels[:, s]) for s, each in enumerate(network.services))
    yield from ((f"stock of {each.id}", mass, found.stock[:, :, i]) for i, each in enumerate(network.stores))
    yield from ((f"flow of {each.id}", flow, found.flow[:, :, k]) for k, each in enumerate(network.arcs))


def save_bands(path: str | Path, found: SampledEpisodes, *, title: str) -> Path:
    """Save bands of λ, of services and of what spreads most, as a PNG and return its path."""
    network, every = found.network, list(_quantities(found))
    first = 1 + min(3, len(network.services))
    rest = sorted(every[1 + len(network.services) :], key=lambda each: -_width(each[2]))
    shown = [*every[:first], *(each for each in rest if _width(each[2]) > 0)][:PANELS]
    rows = math.ceil(len(shown) / COLUMNS)
    figure = Figure(figsize=(WIDTH, 1.0 + 2.1 * rows), layout="constrained")
    figure.suptitle(title, fontsize=11, fontweight="bold")
    grid, ends = figure.subplots(rows, COLUMNS, squeeze=False).ravel(), interval_ends(network)
    for axes, (name, unit, values) in zip(grid, shown, strict=False):
        time = axis_time(ends if name.startswith("stock") else ends - network.episode.control_interval / 2, network)
        lowest, low, middle, high, highest = np.quantile(values, QUANTILES, axis=0)
        axes.fill_between(time, lowest, highest, color=SERIES[0], alpha=0.18, linewidth=0, label="95 % of samples")
        axes.fill_between(time, low, high, color=SERIES[0], alpha=0.35, linewidth=0, label="half of them")
        axes.plot(time, middle, color=SERIES[0], label="median")
        style_axes(axes, title=readable(name), ylabel=unit, size=8.0)
        time_axis(axes, axis_time(np.array([0.0, ends[-1]]), network), network)
        if name.startswith("level"):
            axes.set_ylim(-0.03, 1.06)
    for axes in grid[len(shown) :]:
        axes.set_axis_off()
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=3, frameon=False, fontsize=9)
    return save(figure, path)


def _width(values: Floats) -> float:
    """Return the width of the outer band at the end, relative to the median."""
    low, middle, high = np.quantile(values[:, -1], (QUANTILES[0], 0.5, QUANTILES[-1]))
    return float((high - low) / max(abs(middle), 1e-300)) if high > low else 0.0
