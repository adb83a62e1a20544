"""A plan as somebody reads it who decides: levers in words beside business as usual, and what they save."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.controllers.rollout import Rollout, interval_ends
from cirl_marl.controllers.schedule import Schedule
from cirl_marl.drawing.style import SERIES, axis_time, number, save, style_axes, time_axis
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import labels
from cirl_marl.network.declarations import with_field_docs
from cirl_marl.network.elements import Arc, ControlKind, Node, Role
from cirl_marl.records.files import write_atomically
from cirl_marl.report.curves import WIDTH

PANELS, COLUMNS = 8, 2
SHOWN = 10
"""Largest number of levers in a table on screen."""


@with_field_docs
@dataclass(frozen=True, slots=True)
class Lever:
    """What one agent sets in an episode, beside what it would be if nobody acted."""

    name: Annotated[str, "title of the agent, with what it sets if it is an input of a model"]
    kind: Annotated[ControlKind, "what is set"]
    of: Annotated[str, "what a share is of"]
    unit: Annotated[str, "of the values"]
    planned: Annotated[Floats, "shape (steps,)"]
    usual: Annotated[Floats, "shape (steps,)"]
    width: Annotated[float, "largest range that it may be set in"]

    @property
    def change(self) -> float:
        """Mean distance from business as usual, as part of the range."""
        return float(np.abs(self.planned - self.usual).mean() / self.width) if self.width > 0 else 0.0

    def said(self, step: int) -> str:
        """Say what is set in an interval, in words."""
        value, usual = float(self.planned[step]), float(self.usual[step])
        if self.kind is ControlKind.STRETCH:
            return f"lifetime {100 * (value - 1):+.0f} %"
        if self.kind is ControlKind.SHARE:
            return f"{100 * value:.1f} % of {self.of} ({100 * (value - usual):+.1f} points)"
        if self.kind is ControlKind.RATE:
            return f"flow {100 * (value - 1):+.0f} %"
        change = f" ({100 * (value / usual - 1):+.0f} %)" if usual > 0 else ""
        return f"{number(value)} {self.unit}{change}".rstrip()


@with_field_docs
@dataclass(frozen=True, slots=True)
class Setting:
    """One thing that an agent sets."""

    agent: Annotated[str, "id of the agent"]
    name: Annotated[str, "title of the agent, with what it sets if it is an input of a model"]
    kind: Annotated[ControlKind, "what is set"]
    of: Annotated[str, "what a share is of"]
    unit: Annotated[str, "of the values"]
    row: Annotated[int, "place among all controls"]


def settings(network: Network, agents: Sequence[str]) -> Iterator[Setting]:
    """Yield what agents set, agent by agent."""
    for agent in agents:
        compartment, rows = network.compartments[agent], network.control_rows[agent]
        control, model = compartment.control, compartment.model
        assert control is not None
        names = model.input_names if control.kind is ControlKind.INPUT and model is not None else ("",)
        flow = f"{network.mass_unit}/{network.time_unit}"
        unit = {ControlKind.FLOW: flow, ControlKind.INPUT: ""}.get(control.kind, "1")
        for name, row in zip(names, range(rows.start, rows.stop), strict=True):
            title = _title(network, compartment) + (f", {name}" if name else "")
            yield Setting(agent, title, control.kind, _donor(network, compartment), unit, row)


def levers(found: Schedule) -> list[Lever]:
    """Return what the agents of a plan set, first what differs most from business as usual."""
    low, _, high = found.network.control_bounds
    every = [
        Lever(
            each.name,
            each.kind,
            each.of,
            each.unit,
            found.rollout.controls[:, each.row],
            found.usual.controls[:, each.row],
            float((high[each.row] - low[each.row]).max()),
        )
        for each in settings(found.network, found.agents)
    ]
    return sorted(every, key=lambda each: -each.change)


def _title(network: Network, compartment: object) -> str:
    """Name an agent: an arc that has no title by what it connects."""
    assert isinstance(compartment, Node | Arc)
    if isinstance(compartment, Node) or compartment.title:
        return compartment.label
    ends = network.compartments[compartment.donor].label, network.compartments[compartment.recipient].label
    return f"{compartment.label} ({ends[0]} → {ends[1]})"


def _donor(network: Network, compartment: object) -> str:
    return network.compartments[compartment.donor].label if isinstance(compartment, Arc) else ""


def savings(network: Network, run: Rollout, usual: Rollout) -> list[tuple[str, float, float]]:
    """Return what an episode takes from reservoirs and loses, as planned and as usual, mass.

    They add up to −λ̄·T/Δ but for what moves in batches: what leaves each kind of node for good, or comes back to it.
    """
    names = {
        Role.NONRENEWABLE_RESERVOIR: "taken from reservoirs",
        Role.LANDFILL: "put into landfills",
        Role.INCINERATOR: "burnt",
        Role.ENVIRONMENT: "released to the environment",
    }
    roles = {node.id: node.role for node in network.nodes}
    time = network.episode.control_interval
    found: dict[str, list[float]] = {}
    for k, arc in enumerate(network.arcs):
        if sign := float(network.sustainability[k]):
            ends = (roles[arc.donor], roles[arc.recipient])
            counted = next(role for role in names if role in (ends if sign > 0 else ends[::-1]))
            masses = found.setdefault(names[counted], [0.0, 0.0])
            for i, each in enumerate((run, usual)):
                masses[i] += sign * time * float(each.flow[:, k].sum())
    return [(name, masses[0], masses[1]) for name, masses in found.items()]


def decisions_table(found: Schedule) -> Table:
    """Return the levers that differ most from business as usual, in words, in the first, a middle and the last year."""
    steps = len(found.rollout.circularity[0])
    at = sorted({0, steps // 2, steps - 1})
    when = _when(found.network)
    table = Table(title="what to do, beside business as usual")
    table.add_column("lever")
    for step in at:
        table.add_column(when[step])
    for lever in levers(found)[:SHOWN]:
        if lever.change > 0:
            table.add_row(lever.name, *(lever.said(step) for step in at))
    return table


def savings_table(found: Schedule) -> Table:
    """Return what the plan takes and loses, beside business as usual."""
    network = found.network
    table = Table(title=f"what it saves in all ({network.mass_unit})")
    for name in ("", "as usual", "plan", "saved"):
        table.add_column(name, justify="right" if name else "left")
    for what, planned, usual in savings(network, found.rollout, found.usual):
        part = f" ({(usual - planned) / usual:.0%})" if usual > 0 else ""
        table.add_row(what, f"{usual:.5g}", f"{planned:.5g}", f"{usual - planned:.5g}{part}")
    return table


def write_decisions(path: Path, found: Schedule, *, title: str) -> list[Path]:
    """Write beside the CSV at ``path`` a workbook of decisions, stocks, flows and savings, and a picture.

    Returns:
        The paths of both.
    """
    book, picture = path.with_suffix(".xlsx"), path.with_suffix(".png")
    write_atomically(book, lambda partial: _write_book(partial, found))
    save_decisions(picture, found, title=title)
    return [book, picture]


def _write_book(path: Path, found: Schedule) -> None:
    from openpyxl import Workbook
    from openpyxl.styles import Font

    network, when = found.network, _when(found.network)
    mass, flow = network.mass_unit, f"{network.mass_unit}/{network.time_unit}"
    book = Workbook()
    book.remove(book.active)
    sheets: dict[str, Iterator[Sequence[object]]] = {
        "decisions": _decision_rows(found, when),
        "stocks": _beside(
            when, [(each.label, mass) for each in network.stores], found.rollout.stock, found.usual.stock
        ),
        "flows": _beside(
            when, [(_title(network, each), flow) for each in network.arcs], found.rollout.flow, found.usual.flow
        ),
        "savings": _saving_rows(found),
    }
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(list(row))
        for cell in sheet[1]:
            cell.font = Font(bold=True)
        sheet.freeze_panes = "B2"
        for column in sheet.columns:
            widest = max(
                len(f"{cell.value:.6g}" if isinstance(cell.value, float) else str(cell.value)) for cell in column
            )
            sheet.column_dimensions[column[0].column_letter].width = min(60, widest + 2)
    book.save(path)


def _decision_rows(found: Schedule, when: Sequence[str]) -> Iterator[Sequence[object]]:
    yield ["when", "lever", "in words", "value", "as usual", "unit"]
    for lever in levers(found):
        for step, time in enumerate(when):
            yield [time, lever.name, lever.said(step), float(lever.planned[step]), float(lever.usual[step]), lever.unit]


def _beside(
    when: Sequence[str], names: Sequence[tuple[str, str]], planned: Floats, usual: Floats
) -> Iterator[Sequence[object]]:
    """Yield quantities over time, each as planned and as usual; values have shape (steps, quantities)."""
    yield ["when", *(f"{name}, {what} ({unit})" for name, unit in names for what in ("plan", "as usual"))]
    both = np.stack([planned, usual], axis=2).reshape(len(planned), -1)
    for time, row in zip(when, both.tolist(), strict=True):
        yield [time, *row]


def _saving_rows(found: Schedule) -> Iterator[Sequence[object]]:
    mass = found.network.mass_unit
    yield [f"in all ({mass})", "as usual", "plan", "saved"]
    for what, planned, usual in savings(found.network, found.rollout, found.usual):
        yield [what, usual, planned, usual - planned]


def _when(network: Network) -> list[str]:
    """Return when each interval begins, in words: on the calendar if there is one."""
    begins = interval_ends(network) - network.episode.control_interval
    calendar, dates = labels(network, begins)
    if calendar:
        return [str(each) for each in dates[0]]
    return [f"{number(float(time))} {network.time_unit}" for time in begins]


def save_decisions(path: str | Path, found: Schedule, *, title: str) -> Path:
    """Save λ and the levers that differ most from business as usual, plan beside usual, as a PNG; return its path."""
    network, run, usual = found.network, found.rollout, found.usual
    shown = [each for each in levers(found) if each.change > 0][: PANELS - 1]
    rows = math.ceil((1 + len(shown)) / COLUMNS)
    figure = Figure(figsize=(WIDTH, 1.0 + 2.1 * rows), layout="constrained")
    figure.suptitle(title, fontsize=11, fontweight="bold")
    grid, ends = figure.subplots(rows, COLUMNS, squeeze=False).ravel(), interval_ends(network)
    time = axis_time(ends - network.episode.control_interval / 2, network)
    panels = [("mean circularity", network.mass_unit, run.circularity_mean[0], usual.circularity_mean[0])]
    for lever in shown:
        percent = lever.kind is ControlKind.SHARE
        values = [each * (100 if percent else 1) for each in (lever.planned, lever.usual)]
        unit = (
            f"% of {lever.of}" if percent else "factor on lifetime" if lever.kind is ControlKind.STRETCH else lever.unit
        )
        panels.append((lever.name, unit, values[0], values[1]))
    for axes, (name, unit, planned, as_usual) in zip(grid, panels, strict=False):
        mark = "o" if len(time) == 1 else ""
        axes.plot(time, as_usual, color=SERIES[1], linestyle="--", marker=mark, label="as usual")
        axes.plot(time, planned, color=SERIES[0], marker=mark, label="plan")
        style_axes(axes, title=name, ylabel=unit, size=8.0)
        if unit.startswith("%"):
            axes.set_ylim(bottom=0.0)
        time_axis(axes, axis_time(np.array([0.0, ends[-1]]), network), network)
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    handles, names = grid[0].get_legend_handles_labels()
    figure.legend(handles, names, loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return save(figure, path)
