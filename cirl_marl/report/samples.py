"""Bands of uncertain episodes: tables, what causes their spread, and a picture."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from rich.table import Table

from cirl_marl.controllers.episode_quantities import QuantityKind, episode_quantities
from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import SERIES, axis_time, readable
from cirl_marl.evaluation.sampling import SampledEpisodes, Sensitivity
from cirl_marl.evaluation.statistics import finite_or_none
from cirl_marl.network import Floats
from cirl_marl.network.calendar import time_columns
from cirl_marl.records.files import publish_result
from cirl_marl.report.panels import LEVELS, PANELS, Panel, save_panels
from cirl_marl.report.terminal import text_table

QUANTILES = (0.025, 0.25, 0.5, 0.75, 0.975)
KINDS: tuple[QuantityKind, ...] = ("circularity", "service", "account", "stock", "flow", "disturbance")
"""Kinds of quantities that have bands."""
SHOWN = 3
"""Single samples in a picture."""
ROWS = 8
"""Largest number of causes in a table on screen."""


def sensitivity_table(samples: SampledEpisodes, causes: Sequence[Sensitivity]) -> Table:
    """Return the numbers that cause most of the spread, with the share of each figure that they cause."""
    rows = [[samples.names[i], *(_share_text(cause, i) for cause in causes)] for i in _order(causes)[:ROWS]]
    headings = ["number", *(cause.figure for cause in causes)]
    return text_table("share of the spread that a number causes by itself", headings, rows, text=["number"])


def _order(causes: Sequence[Sensitivity]) -> list[int]:
    """Return the numbers, first what causes most of the spread of anything."""
    most = np.nan_to_num(np.array([cause.shares for cause in causes]), nan=-1.0).max(axis=0)
    return [int(i) for i in np.argsort(-most, kind="stable")]


def _share_text(cause: Sensitivity, i: int) -> str:
    if math.isnan(cause.shares[i]):
        return "–"
    return f"{max(0.0, cause.shares[i]):.0%} ± {cause.margins[i]:.0%}"


def write_samples(
    folder: Path, name: str, samples: SampledEpisodes, causes: Sequence[Sensitivity], *, title: str
) -> list[Path]:
    """Write ``name_bands.csv``, ``name_draws.csv``, ``name_causes.csv`` and ``name_bands.png``, all or none.

    Bands are quantiles of each quantity over the samples, by time. Draws are what was drawn in each sample and what
    came of it. Causes are first-order Sobol indices with 95 % intervals; there are none of too few samples.
    """
    header, clock = time_columns(samples.network, interval_ends(samples.network))
    header += ["quantity", "unit", "mean", *(f"quantile {level:g}" for level in QUANTILES)]
    rows = []
    for quantity in episode_quantities(samples.network, *KINDS):
        values = quantity.values(samples.rollout)
        bands = np.array([values.mean(axis=0), *np.quantile(values, QUANTILES, axis=0)]).T.tolist()
        rows += [[*time, quantity.name, quantity.unit, *band] for time, band in zip(clock, bands, strict=True)]
    tables = {f"{name}_bands.csv": (header, rows), f"{name}_draws.csv": _draws(samples)}
    if causes:
        tables[f"{name}_causes.csv"] = _causes(samples, causes)
    draw = partial(save_bands, samples=samples, title=title)
    return publish_result(folder, tables, {f"{name}_bands.png": draw})


def _draws(samples: SampledEpisodes) -> tuple[list[str], list[list[object]]]:
    network = samples.network
    header = ["sample", *(f"factor on {name}" for name in samples.names), f"mean circularity ({network.mass_unit})"]
    header += [f"mean level of {service.id}" for service in network.services]
    header += [f"{account.id} ({account.unit})" for account in network.accounts]
    header += [f"mean of {disturbance.heading}" for disturbance in episode_quantities(network, "disturbance")]
    figures = [values for _, _, values in samples.figures()]
    columns = [samples.factors, *figures, samples.rollout.disturbances.mean(axis=1)]
    return header, [[i, *row] for i, row in enumerate(np.column_stack(columns).tolist())]


def _causes(samples: SampledEpisodes, causes: Sequence[Sensitivity]) -> tuple[list[str], list[list[object]]]:
    header = ["number", *(part for cause in causes for part in (f"share of {cause.figure}", "half-width"))]
    figures = np.array([column for cause in causes for column in (cause.shares, cause.margins)]).T.tolist()
    return header, [[samples.names[i], *map(finite_or_none, figures[i])] for i in _order(causes)]


def save_bands(path: str | Path, samples: SampledEpisodes, *, title: str) -> Path:
    """Save bands of λ, of services and of what spreads most, as a PNG and return its path."""
    network, ends = samples.network, interval_ends(samples.network)
    series = [(quantity, quantity.values(samples.rollout)) for quantity in episode_quantities(network, *KINDS)]
    services = len(network.services)
    rest = sorted(series[1 + services :], key=lambda pair: -_width(pair[1]))
    uncertain = [pair for pair in rest if _width(pair[1]) > 0]
    panels = []
    for quantity, values in [*series[: 1 + min(3, services)], *uncertain][:PANELS]:
        time = axis_time(ends if quantity.kind == "stock" else ends - network.episode.control_interval / 2, network)
        draw = partial(_draw_bands, time=time, bands=np.quantile(values, QUANTILES, axis=0), draws=values[:SHOWN])
        limits = LEVELS if quantity.kind == "service" else None
        panels.append(Panel(readable(quantity.name), quantity.unit, draw, limits))
    return save_panels(path, network, panels, title=title, legend=4)


def _draw_bands(axes: Axes, time: Floats, bands: Floats, draws: Floats) -> None:
    lowest, low, median, high, highest = bands
    axes.fill_between(time, lowest, highest, color=SERIES[0], alpha=0.18, linewidth=0, label="95 % of samples")
    axes.fill_between(time, low, high, color=SERIES[0], alpha=0.35, linewidth=0, label="half of them")
    axes.plot(time, median, color=SERIES[0], label="median")
    for i, draw in enumerate(draws):
        axes.plot(time, draw, color=SERIES[1], linewidth=0.7, label="" if i else f"{len(draws)} of them")


def _width(values: Floats) -> float:
    """Return the width of the outer band at the end, relative to the median."""
    low, median, high = np.quantile(values[:, -1], (QUANTILES[0], 0.5, QUANTILES[-1]))
    return float((high - low) / max(abs(median), 1e-300)) if high > low else 0.0
