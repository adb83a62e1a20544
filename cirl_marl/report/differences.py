"""Alternatives of a network shown: what differs in a table, their trajectories in one picture, and their files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import DASHES, SERIES, axis_time, readable, save, style_axes, time_axis
from cirl_marl.evaluation.quantities import ComparedQuantity
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.evaluation.statistics import defined
from cirl_marl.network import Floats, Network
from cirl_marl.records.files import publish_folder, write_table
from cirl_marl.report.curves import WIDTH

ROWS = 12
"""Largest number of quantities in a table on screen."""
PANELS = 8
SERVICE_PANELS = 3
COLUMNS = 2


def differences_table(found: Sequence[Simulation], quantities: Sequence[ComparedQuantity]) -> Table:
    """One row for each quantity, of 12 at most: its value in every alternative, and the difference to the first."""
    table = Table(title=f"differences to {found[0].name} stand below the values")
    table.add_column("quantity")
    table.add_column("unit")
    for each in found:
        table.add_column(each.name, justify="right")
    for quantity in quantities[:ROWS]:
        table.add_row(quantity.name, quantity.unit, *_cells(quantity))
    return table


def _cells(quantity: ComparedQuantity) -> Iterator[str]:
    """Yield each value, and below it the difference to the first, if there is one; a dash if there is no value."""
    differences = zip(quantity.values, quantity.differences, quantity.relative_differences, strict=True)
    for value, difference, relative in differences:
        text = "–" if math.isnan(value) else f"{value:.5g}"
        if abs(difference) > quantity.round_off:
            text += f"\n{difference:+.4g}" + ("" if math.isnan(relative) else f" ({100 * relative:+.3g}%)")
        yield text


def write_alternatives(
    folder: Path, name: str, files: Mapping[str, Simulation], quantities: Sequence[ComparedQuantity], *, title: str
) -> list[Path]:
    """Write the files of alternatives, all of them or none, and return their paths.

    Args:
        folder: where to write; it is made if it is not there.
        name: stem of ``name.csv``, with every quantity, and of the picture ``name.png``.
        files: the alternatives by the stem of a CSV file each, which holds its table.
        quantities: what ``rank_quantities`` found in them.
        title: heading of the picture.
    """
    found = list(files.values())
    header = ["quantity", "unit", found[0].name]
    for each in found[1:]:
        header += [each.name, f"difference of {each.name}", f"relative difference of {each.name}"]
    with publish_folder(folder) as partial:
        for stem, each in files.items():
            write_table(partial / f"{stem}.csv", *each.table())
        write_table(partial / f"{name}.csv", header, map(_row, quantities))
        save_alternatives(partial / f"{name}.png", found, quantities, title=title)
    return [folder / file for file in (*(f"{stem}.csv" for stem in files), f"{name}.csv", f"{name}.png")]


def _row(quantity: ComparedQuantity) -> list[object]:
    columns = np.column_stack([quantity.values, quantity.differences, quantity.relative_differences])
    figures = [defined(each) for each in columns.ravel().tolist()]
    return [quantity.name, quantity.unit, figures[0], *figures[columns.shape[1] :]]


def save_alternatives(
    path: str | Path, found: Sequence[Simulation], quantities: Sequence[ComparedQuantity], *, title: str = ""
) -> Path:
    """Save the trajectories of alternatives, laid over each other, as a PNG and return its path.

    There are at most 8 panels: mean λ, the levels of the 3 services that differ most, and the flows and stocks that
    differ most by ``quantities``, which are what ``rank_quantities`` found.
    """
    panels = _chosen(quantities)
    rows = math.ceil(len(panels) / COLUMNS)
    figure = Figure(figsize=(WIDTH, 1.0 + 2.1 * rows), layout="constrained")
    figure.suptitle(title, fontsize=11, fontweight="bold")
    network, grid = found[0].network, figure.subplots(rows, COLUMNS, squeeze=False).ravel()
    ends = interval_ends(network)
    for axes, quantity in zip(grid, panels, strict=False):
        for i in np.flatnonzero(~np.isnan(quantity.values)).tolist():
            time, values = _trajectory(found[i], quantity)
            dash = DASHES[(i + i // len(SERIES)) % len(DASHES)]  # colours come round before pairs do
            mark = "o" if len(time) == 1 else ""
            axes.plot(axis_time(time, network), values, color=SERIES[i % len(SERIES)], linestyle=dash, marker=mark)
        heading, unit = _labels(network, quantity)
        style_axes(axes, title=heading, ylabel=unit, size=8.0)
        time_axis(axes, axis_time(np.array([0.0, ends[-1]]), network), network)
        if quantity.kind == "service":
            axes.set_ylim(-0.03, 1.06)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    # every alternative has λ
    names = [each.name for each in found]
    figure.legend(grid[0].lines, names, loc="outside lower center", ncols=4, frameon=False, fontsize=9)
    return save(figure, path)


def _chosen(quantities: Sequence[ComparedQuantity]) -> list[ComparedQuantity]:
    """Return the quantities that are drawn; of flows and stocks, only such as differ."""
    circularity = [each for each in quantities if each.kind == "circularity"]
    services = [each for each in quantities if each.kind == "service"][:SERVICE_PANELS]
    rest = [each for each in quantities if each.kind in ("flow", "stock") and each.rank > 0]
    return [*circularity, *services, *rest][:PANELS]


def _trajectory(alternative: Simulation, quantity: ComparedQuantity) -> tuple[Floats, Floats]:
    """Return times and values, shape (points,) each: means in the middle of an interval, stocks at start and ends."""
    network, run = alternative.network, alternative.rollout
    ends = interval_ends(network)
    middle = ends - network.episode.control_interval / 2
    if quantity.kind == "circularity":
        return middle, run.circularity_mean[0]
    if quantity.kind == "service":
        return middle, run.levels[0, [service.id for service in network.services].index(quantity.of)]
    if quantity.kind == "flow":
        return middle, run.flow[:, network.arc_index[quantity.of]]
    row = network.node_index[quantity.of]  # nodes with a stock come first
    return np.append(0.0, ends), np.append(alternative.start[row], run.stock[:, row])


def _labels(network: Network, quantity: ComparedQuantity) -> tuple[str, str]:
    """Return the heading of a panel and the name of its vertical axis, with the unit."""
    mass, of = network.mass_unit, readable(quantity.of)
    return {
        "circularity": ("Mean circularity", f"λ / {mass}"),
        "service": (f"Service: {of}", "service level"),
        "flow": (f"Flow: {of}", f"{mass}/{network.time_unit}"),
        "stock": (f"Stock: {of}", mass),
    }[quantity.kind]
