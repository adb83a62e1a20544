"""A plan as somebody reads it who decides: levers in words beside business as usual, and what they save."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
from matplotlib.axes import Axes
from rich.table import Table

from cirl_marl.controllers.rollout import Rollout, interval_ends
from cirl_marl.controllers.schedule import Schedule
from cirl_marl.drawing.style import SERIES, axis_time, number
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Node
from cirl_marl.reasons.objective_terms import circularity_part
from cirl_marl.reasons.sentences import interval_names
from cirl_marl.records.files import write_atomically
from cirl_marl.report.panels import PANELS, Panel, save_panels
from cirl_marl.report.terminal import text_table

SHOWN_LEVERS = 10
"""Largest number of levers in a table on screen."""
SHARES = (ControlKind.SHARE, ControlKind.TRANSFER)
"""Kinds of controls that are read in percent."""
NO_WORKBOOK = "no workbook (.xlsx) beside it: it needs openpyxl: pip install 'cirl-marl[excel]'"


@positional_record
class Setting:
    """One thing that an agent sets."""

    agent: Annotated[str, "id of the agent"]
    name: Annotated[str, "title of the agent, with what it sets if it is an input of a model"]
    kind: Annotated[ControlKind, "what is set"]
    of: Annotated[str, "what a share is of"]
    unit: Annotated[str, "of the values"]
    row: Annotated[int, "place among all controls"]


@positional_record
class Lever(Setting):
    """What one agent sets in an episode, beside what it would be if nobody acted."""

    plan: Annotated[Floats, "shape (steps,)"]
    usual: Annotated[Floats, "shape (steps,)"]
    width: Annotated[float, "largest range that it may be set in"]

    @property
    def change(self) -> float:
        """Mean distance from business as usual, as part of the range."""
        return float(np.abs(self.plan - self.usual).mean() / self.width) if self.width > 0 else 0.0

    def text(self, step: int) -> str:
        """Say what is set in an interval, in words."""
        value, usual = float(self.plan[step]), float(self.usual[step])
        if self.kind is ControlKind.STRETCH:
            return f"lifetime {100 * (value - 1):+.0f} %"
        if self.kind in SHARES:
            return f"{100 * value:.1f} % of {self.of} ({100 * (value - usual):+.1f} points)"
        if self.kind is ControlKind.RATE:
            return f"flow {100 * (value - 1):+.0f} %"
        change = f" ({100 * (value / usual - 1):+.0f} %)" if usual > 0 else ""
        return f"{number(value)} {self.unit}{change}".rstrip()


def settings(network: Network, agents: Sequence[str]) -> Iterator[Setting]:
    """Yield what agents set, agent by agent."""
    flow = f"{network.mass_unit}/{network.time_unit}"
    for agent in agents:
        compartment, rows = network.compartments[agent], network.control_rows[agent]
        control, model = compartment.control, compartment.model
        assert control is not None
        names = model.input_names if control.kind is ControlKind.INPUT and model is not None else ("",)
        unit = {ControlKind.FLOW: flow, ControlKind.INPUT: ""}.get(control.kind, "1")
        donor = network.compartments[compartment.donor].label if isinstance(compartment, Arc) else ""
        if control.substances:
            donor = f"{', '.join(control.substances)} in {donor}"
        for name, row in zip(names, range(rows.start, rows.stop), strict=True):
            title = _title(network, compartment) + (f", {name}" if name else "")
            yield Setting(agent, title, control.kind, donor, unit, row)


def levers(schedule: Schedule) -> list[Lever]:
    """Return what the agents of a plan set, first what differs most from business as usual."""
    low, _, high = schedule.network.control_bounds
    by_agent = []
    for setting in settings(schedule.network, schedule.agents):
        row, about = setting.row, (setting.agent, setting.name, setting.kind, setting.of, setting.unit)
        plan, usual = (episode.controls[:, row] for episode in (schedule.rollout, schedule.usual))
        by_agent.append(Lever(*about, row, plan, usual, float((high[row] - low[row]).max())))
    return sorted(by_agent, key=lambda lever: -lever.change)


def _title(network: Network, compartment: Compartment) -> str:
    """Name an agent: an arc that has no title by what it connects."""
    if isinstance(compartment, Arc) and not compartment.title:
        donor, recipient = (network.compartments[end].label for end in (compartment.donor, compartment.recipient))
        return f"{compartment.label} ({donor} → {recipient})"
    assert isinstance(compartment, Node | Arc)
    return compartment.label


def savings(network: Network, plan: Rollout, usual: Rollout) -> list[tuple[str, float, float]]:
    """Return what an episode takes from reservoirs and loses, as planned and as usual, mass.

    They add up to −λ̄·T/Δ but for what moves in batches: what leaves each kind of node for good, or comes back to it.
    """
    masses: dict[str, list[float]] = {}
    for k, sign in enumerate(network.sustainability.tolist()):
        if sign:
            part = masses.setdefault(circularity_part(network, k), [0.0, 0.0])
            for i, episode in enumerate((plan, usual)):
                part[i] += sign * network.episode.control_interval * float(episode.flow[:, k].sum())
    return [(name, mass, usual_mass) for name, (mass, usual_mass) in masses.items()]


def decisions_table(schedule: Schedule) -> Table:
    """Return the levers that differ most from business as usual, in words, in the first, a middle and the last year."""
    count = schedule.network.episode.horizon
    steps, times = sorted({0, count // 2, count - 1}), _times(schedule.network)
    shown = [lever for lever in levers(schedule)[:SHOWN_LEVERS] if lever.change > 0]
    rows = [[lever.name, *(lever.text(step) for step in steps)] for lever in shown]
    headings = ["lever", *(times[step] for step in steps)]
    return text_table("what to do, beside business as usual", headings, rows, text=headings)


def savings_table(schedule: Schedule) -> Table:
    """Return what the plan takes and loses, beside business as usual."""
    rows = []
    for name, plan, usual in savings(schedule.network, schedule.rollout, schedule.usual):
        part = f" ({(usual - plan) / usual:.0%})" if usual > 0 else ""
        rows.append([name, f"{usual:.5g}", f"{plan:.5g}", f"{usual - plan:.5g}{part}"])
    title = f"what it saves in all ({schedule.network.mass_unit})"
    return text_table(title, ["", "as usual", "plan", "saved"], rows, text=[""])


def write_decisions(path: Path, schedule: Schedule, *, title: str) -> list[Path]:
    """Write beside the CSV at ``path`` a workbook of decisions, stocks, flows and savings, and a picture.

    Returns:
        The paths of both; of the picture alone where openpyxl is not installed: ``NO_WORKBOOK`` says how to get it.
    """
    book, picture = path.with_suffix(".xlsx"), path.with_suffix(".png")
    save_decisions(picture, schedule, title=title)
    try:
        import openpyxl  # noqa: F401
    except ImportError:
        return [picture]
    write_atomically(book, lambda draft: _write_book(draft, schedule))
    return [book, picture]


def _write_book(path: Path, schedule: Schedule) -> None:
    from openpyxl import Workbook
    from openpyxl.styles import Font

    network, plan, usual = schedule.network, schedule.rollout, schedule.usual
    mass, flow = network.mass_unit, f"{network.mass_unit}/{network.time_unit}"
    book = Workbook()
    book.remove(book.active)
    sheets = {
        "decisions": _decision_rows(schedule),
        "stocks": _series_rows(network, [(node.label, mass) for node in network.stores], plan.stock, usual.stock),
        "flows": _series_rows(network, [(_title(network, arc), flow) for arc in network.arcs], plan.flow, usual.flow),
        "savings": _saving_rows(schedule),
    }
    for name, rows in sheets.items():
        sheet = book.create_sheet(name)
        for row in rows:
            sheet.append(list(row))
        for cell in sheet[1]:
            cell.font = Font(bold=True)
        sheet.freeze_panes = "B2"
        for column in sheet.columns:
            texts = (f"{cell.value:.6g}" if isinstance(cell.value, float) else str(cell.value) for cell in column)
            sheet.column_dimensions[column[0].column_letter].width = min(60, max(map(len, texts)) + 2)
    book.save(path)


def _decision_rows(schedule: Schedule) -> Iterator[Sequence[object]]:
    yield ["when", "lever", "in words", "value", "as usual", "unit"]
    for lever in levers(schedule):
        for step, time in enumerate(_times(schedule.network)):
            yield [time, lever.name, lever.text(step), float(lever.plan[step]), float(lever.usual[step]), lever.unit]


def _series_rows(
    network: Network, names: Sequence[tuple[str, str]], plan: Floats, usual: Floats
) -> Iterator[Sequence[object]]:
    """Yield quantities over time, each as planned and as usual; values have shape (steps, quantities)."""
    yield ["when", *(f"{name}, {case} ({unit})" for name, unit in names for case in ("plan", "as usual"))]
    pairs = np.stack([plan, usual], axis=2).reshape(len(plan), -1)
    for time, row in zip(_times(network), pairs.tolist(), strict=True):
        yield [time, *row]


def _saving_rows(schedule: Schedule) -> Iterator[Sequence[object]]:
    yield [f"in all ({schedule.network.mass_unit})", "as usual", "plan", "saved"]
    for name, plan, usual in savings(schedule.network, schedule.rollout, schedule.usual):
        yield [name, usual, plan, usual - plan]


def _times(network: Network) -> list[str]:
    """Return when each interval begins, in words: on the calendar if there is one."""
    return interval_names(network, lambda time: f"{number(time)} {network.time_unit}")


def save_decisions(path: str | Path, schedule: Schedule, *, title: str = "") -> Path:
    """Save λ and the levers that differ most from business as usual, plan beside usual, as a PNG; return its path."""
    network, mass = schedule.network, schedule.network.mass_unit
    time = axis_time(interval_ends(network) - network.episode.control_interval / 2, network)
    plan, usual = schedule.rollout.circularity_mean[0], schedule.usual.circularity_mean[0]
    panels = [Panel("mean circularity", mass, partial(_draw, time=time, plan=plan, usual=usual))]
    for lever in [lever for lever in levers(schedule) if lever.change > 0][: PANELS - 1]:
        unit, factor, limits = lever.unit, 1, None
        if lever.kind in SHARES:
            unit, factor, limits = f"% of {lever.of}", 100, (0.0, None)
        elif lever.kind is ControlKind.STRETCH:
            unit = "factor on lifetime"
        draw = partial(_draw, time=time, plan=lever.plan * factor, usual=lever.usual * factor)
        panels.append(Panel(lever.name, unit, draw, limits))
    return save_panels(path, network, panels, title=title or network.title or network.name, legend=2)


def _draw(axes: Axes, time: Floats, plan: Floats, usual: Floats) -> None:
    marker = "o" if len(time) == 1 else ""
    axes.plot(time, usual, color=SERIES[1], linestyle="--", marker=marker, label="as usual")
    axes.plot(time, plan, color=SERIES[0], marker=marker, label="plan")
