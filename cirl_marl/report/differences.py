"""Simulations of one network shown side by side: what differs in a table, one picture of all, and their files."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from rich.table import Table

from cirl_marl.controllers.episode_quantities import episode_quantities
from cirl_marl.drawing.style import DASHES, SERIES, axis_time, readable
from cirl_marl.evaluation.compared_quantities import ComparedQuantity, rank_quantities
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.evaluation.statistics import finite_or_none
from cirl_marl.records.files import publish_result
from cirl_marl.report.panels import LEVELS, PANELS, Panel, save_panels
from cirl_marl.report.terminal import text_table

ROWS = 12
"""Largest number of quantities in a table on screen."""
SERVICE_PANELS = 3


def differences_table(simulations: Sequence[Simulation], quantities: Sequence[ComparedQuantity]) -> Table:
    """One row for each quantity, of 12 at most: its value in every simulation, and the difference to the first."""
    rows = ([quantity.name, quantity.unit, *_cells(quantity)] for quantity in quantities[:ROWS])
    headings = ["quantity", "unit", *(simulation.name for simulation in simulations)]
    return text_table(f"differences to {simulations[0].name} stand below the values", headings, rows, text=headings[:2])


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
    first, *alternatives = files.values()
    header = ["quantity", "unit", first.name]
    for simulation in alternatives:
        header += [form.format(simulation.name) for form in ("{}", "difference of {}", "relative difference of {}")]
    tables = {f"{stem}.csv": simulation.table() for stem, simulation in files.items()}
    tables[f"{name}.csv"] = header, [*map(_row, quantities)]
    draw = partial(save_alternatives, simulations=[first, *alternatives], quantities=quantities, title=title)
    return publish_result(folder, tables, {f"{name}.png": draw})


def _row(quantity: ComparedQuantity) -> list[object]:
    columns = np.column_stack([quantity.values, quantity.differences, quantity.relative_differences])
    figures = [finite_or_none(figure) for figure in columns.ravel().tolist()]
    return [quantity.name, quantity.unit, figures[0], *figures[columns.shape[1] :]]


def save_alternatives(
    path: str | Path,
    simulations: Sequence[Simulation],
    quantities: Sequence[ComparedQuantity] | None = None,
    *,
    title: str = "",
) -> Path:
    """Save the trajectories of simulations, laid over each other, as a PNG and return its path.

    There are at most 8 panels: mean λ, the levels of the 3 services that differ most, and the flows and stocks that
    differ most by ``quantities``, which are what ``rank_quantities`` found.
    """
    network, quantities = simulations[0].network, quantities or rank_quantities(simulations)
    circularity, services = ([q for q in quantities if q.kind == kind] for kind in ("circularity", "service"))
    rest = [quantity for quantity in quantities if quantity.kind in ("flow", "stock") and quantity.rank > 0]
    panels = []
    for quantity in [*circularity, *services[:SERVICE_PANELS], *rest][:PANELS]:
        mass, name = network.mass_unit, readable(quantity.of)
        heading, unit = {
            "circularity": ("Mean circularity", f"λ / {mass}"),
            "service": (f"Service: {name}", "service level"),
            "flow": (f"Flow: {name}", f"{mass}/{network.time_unit}"),
            "stock": (f"Stock: {name}", mass),
        }[quantity.kind]
        limits = LEVELS if quantity.kind == "service" else None
        panels.append(Panel(heading, unit, partial(_draw, simulations=simulations, quantity=quantity), limits))
    return save_panels(path, network, panels, title=title or network.name, legend=4)


def _draw(axes: Axes, simulations: Sequence[Simulation], quantity: ComparedQuantity) -> None:
    for i in np.flatnonzero(~np.isnan(quantity.values)).tolist():
        network, run = simulations[i].network, simulations[i].rollout
        (curve,) = [part for part in episode_quantities(network, quantity.kind) if part.of == quantity.of]
        time, values = curve.points(network, run)
        dash = DASHES[(i + i // len(SERIES)) % len(DASHES)]  # colours come round before pairs do
        look: Any = {"color": SERIES[i % len(SERIES)], "linestyle": dash, "marker": "o" if len(time) == 1 else ""}
        axes.plot(axis_time(time, simulations[0].network), values, label=simulations[i].name, **look)
