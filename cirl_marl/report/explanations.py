"""Explanations as text, tables and a picture."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import GOOD, SERIES, WARNING, WIDTH, axis_time, number, save, style_axes, time_axis
from cirl_marl.errors import RunError
from cirl_marl.evaluation.figures import provenance
from cirl_marl.evaluation.statistics import Aggregate
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.reasons import sentences
from cirl_marl.reasons.attribution import PairedDifference
from cirl_marl.reasons.explanation import Explanation
from cirl_marl.reasons.prices import ShadowPrices
from cirl_marl.records.files import publish_folder, read_record, write_json, write_table
from cirl_marl.report.terminal import text_table

FOLDER, FILE = "reasons", "reasons.json"
"""Where a run keeps its reasons."""
LINES, BARS = 6, 8
"""Most stocks and bounds of controls in the picture."""
WORTH_TELLING = 1e-3
"""Part of the largest price of its kind below which a price is left out on screen and in the picture."""
OUTCOME = ("change of λ̄ ({})", "λ̄, low", "λ̄, high", "change of service (1)", "service, low", "service, high")
Reasons = tuple[tuple[str, tuple[str, ...]], ...]
"""Headings with their sentences."""
Rows = Iterator[list[str]]
"""Rows of a table, the header first."""


def write_reasons(explanation: Explanation, folder: Path, **options: Any) -> list[Path]:
    """Write text, tables, picture and what a page shows, all of them or nothing, and return their paths.

    Raises:
        OSError: if the folder cannot be written.
    """
    names = ["reasons.txt", FILE]
    sections = list(sentences.paragraphs(explanation))
    tables = {"prices.csv": price_rows, "inputs.csv": _input_rows, "rules.csv": _rule_rows}
    with publish_folder(folder) as draft:
        text = "\n\n".join("\n".join([heading, *sentences]) for heading, sentences in sections)
        (draft / "reasons.txt").write_text(text + "\n", encoding="utf-8")
        about = {"about": explanation.about, "checkpoint": explanation.checkpoint, "sections": sections}
        write_json(draft / FILE, about | provenance(explanation.network, **options))
        for name, rows_of in tables.items():
            header, *rows = rows_of(explanation)
            if rows:
                write_table(draft / name, header, rows)
                names.append(name)
        if explanation.prices is not None or explanation.inputs:
            save_reasons(draft / "reasons.png", explanation)
            names.append("reasons.png")
    return [folder / name for name in names]


def read_reasons(run: RunDirectory, checkpoint: str) -> tuple[Reasons, str]:
    """Return what was written down of why a run's policies act as they do, and why nothing is shown; one is empty.

    Raises:
        RunError: if it cannot be read.
    """
    path = run.path / FOLDER / FILE
    advice = f"cirl explain {run.path.name} finds them"
    if not path.is_file():
        return (), f"no reasons: {advice}"
    try:
        record = read_record(path)
        sections = tuple((str(heading), tuple(map(str, sentences))) for heading, sentences in record["sections"])
        if record["checkpoint"] != checkpoint:
            return (), f"no reasons: those in {path.name} are of another checkpoint; {advice} anew"
    except (ValueError, KeyError, TypeError) as error:
        raise RunError(f"{path}: cannot be read: {error!r}; delete it, or explain the run anew") from error
    return sections, ""


def prices_table(prices: ShadowPrices) -> Table:
    """Return one row a stock, demand and agent: the first, the largest and the last price of it, or the whole."""
    network, agents = prices.network, list(prices.bound.agents)
    times, mass = sentences.interval_names(network), network.mass_unit
    groups = [
        (f"one {mass} in the stock", [node.id for node in network.stores], prices.stock),
        ("one unit of demand", [service.id for service in network.services], prices.demand),
        ("1 % lower bound, downwards", agents, prices.room[0]),
        ("1 % upper bound, upwards", agents, prices.room[1]),
    ]
    rows = []
    for unit, ids, values in groups:
        for id_, series in zip(ids, values.T, strict=True):
            if np.abs(series).max() > WORTH_TELLING * np.abs(values).max():
                largest = float(series[np.abs(series).argmax()])
                rows.append([id_, unit, *(f"{price:.3g}" for price in (series[0], largest, series[-1]))])
    headings = ["more of", "what", times[0], "largest", times[-1]]
    return text_table(f"what a little more is worth in λ̄ ({mass})", headings, rows, text=headings[:2])


def inputs_table(explanation: Explanation) -> Table:
    """Return one row an agent: what it looks at, and what became of λ̄ when that was held, or the least important."""
    rows = []
    for inputs in explanation.inputs:
        shares = zip(inputs.signals[: inputs.top], inputs.share[: inputs.top].tolist(), strict=True)
        signals = ", ".join(f"{signal.name} {100 * share:.0f} %" for signal, share in shares)
        least = "–" if inputs.least_held is None else _interval(inputs.least_held.circularity)
        rows.append([inputs.agent, signals, _interval(inputs.top_held.circularity), least])
    headings, mass = ["agent", "inputs", "these held", "least held"], explanation.network.mass_unit
    title = f"what agents look at, and λ̄ ({mass}) when it is held at its mean, with 95 % intervals"
    return text_table(title, headings, rows, text=headings)


def _interval(aggregate: Aggregate) -> str:
    return f"{aggregate.value:+.3g} [{aggregate.low:.3g}, {aggregate.high:.3g}]"


def price_rows(explanation: Explanation) -> Rows:
    """Yield a table with a row for each price, by interval or by the state of a disturbance."""
    yield ["more of", "compartment or service", "interval", "rise of λ̄", "unit"]
    if explanation.prices is None:
        return
    prices, network = explanation.prices, explanation.network
    mass, times = network.mass_unit, sentences.interval_names(network)
    for i, node in enumerate(network.stores):
        for time, price in zip(times, prices.stock[:, i].tolist(), strict=True):
            yield ["stock at the start", node.id, time, _digits(price), f"{mass} per {mass}"]
    for by_state in explanation.state_prices:
        for (low, high), worth in zip(by_state.states.tolist(), by_state.stock, strict=True):
            state = f"stock while {by_state.disturbance} is {low:g} to {high:g}"
            for node, price in zip(network.stores, worth.tolist(), strict=True):
                yield [state, node.id, "all", _digits(price), f"{mass} per {mass}"]
    for s, service in enumerate(network.services):
        unit = mass if service.quantity == "stock" else f"{mass}/{network.time_unit}"
        for time, price in zip(times, prices.demand[:, s].tolist(), strict=True):
            yield ["demand", service.id, time, _digits(price), f"{mass} per {unit}"]
        yield ["level demanded", service.id, "all", _digits(float(prices.level[s]) / 100), f"{mass} per percent"]
    for side, end in enumerate(("lower bound, downwards", "upper bound, upwards")):
        for a, agent in enumerate(prices.bound.agents):
            for time, price in zip(times, prices.room[side, :, a].tolist(), strict=True):
                yield [end, agent, time, _digits(price), f"{mass} per percent"]


def _input_rows(explanation: Explanation) -> Rows:
    """Yield a table with a row for each input of each agent; what became of λ̄ stands behind those that were held."""
    outcome = (name.format(explanation.network.mass_unit) for name in OUTCOME)
    yield ["agent", "input", "unit", "share", "change of action per unit", "held together", *outcome]
    for inputs in explanation.inputs:
        for i, signal in enumerate(inputs.signals):
            group, difference = "", None
            if i < inputs.top:
                group, difference = "most important", inputs.top_held
            elif inputs.least_held is not None and i >= len(inputs.signals) - inputs.top:
                group, difference = "least important", inputs.least_held
            slope = "; ".join(_digits(float(change) / signal.scale) for change in inputs.slope[:, i])
            share = _digits(float(inputs.share[i]))
            yield [inputs.agent, signal.name, signal.unit, share, slope, group, *_outcome(difference)]


def _rule_rows(explanation: Explanation) -> Rows:
    outcome = (name.format(explanation.network.mass_unit) for name in OUTCOME)
    yield ["agent", "when", "what", "control", "share of decisions", "variance explained", *outcome]
    if explanation.rules is None:
        return
    network = explanation.network
    for rule in explanation.rules.rules:
        for leaf in rule.leaves:
            control = "; ".join(_digits(value) for value in leaf.control.tolist())
            condition = sentences.condition_text(network, leaf.conditions) or "always"
            action = sentences.action_text(network, rule.agent, leaf)
            shares = _digits(leaf.share), _digits(rule.explained_variance)
            yield [rule.agent, condition, action, control, *shares, *_outcome(rule.cost)]
    yield ["all together", "", "", "", "", "", *_outcome(explanation.rules.together)]


def _outcome(difference: PairedDifference | None) -> list[str]:
    if difference is None:
        return [""] * len(OUTCOME)
    aggregates = (difference.circularity, difference.service)
    return [_digits(end) for aggregate in aggregates for end in (aggregate.value, aggregate.low, aggregate.high)]


def _digits(value: float) -> str:
    return f"{value:.10g}"


def save_reasons(path: Path, explanation: Explanation) -> Path:
    """Save prices of stocks over time, what room is worth, and what agents look at, as a PNG, and return its path."""
    heights = [] if explanation.prices is None else [3.2, 2.4]
    heights += [0.24 * len(explanation.inputs) + 1.2] if explanation.inputs else []
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    axes = figure.subplots(len(heights), 1, squeeze=False, height_ratios=heights).ravel()
    if explanation.prices is not None:
        _draw_stocks(axes[0], explanation.prices)
        _draw_room(axes[1], explanation.prices)
    if explanation.inputs:
        _draw_inputs(axes[-1], explanation)
    return save(figure, path)


def _draw_stocks(axes: Axes, prices: ShadowPrices) -> None:
    network, largest = prices.network, np.abs(prices.stock).max(axis=0)
    time = axis_time(interval_ends(network) - network.episode.control_interval, network)
    for place, i in enumerate(np.argsort(-largest, kind="stable")[:LINES].tolist()):
        if largest[i] > 0:
            label = sentences.compartment_label(network, network.stores[i].id)
            axes.plot(time, prices.stock[:, i], color=SERIES[place], label=label)
    mass = network.mass_unit
    style_axes(axes, title=f"What one more {mass} in a stock is worth in λ̄", ylabel=f"{mass} per {mass}")
    time_axis(axes, time, network)
    if axes.lines:
        axes.legend(frameon=False, fontsize=8, ncols=2)


def _draw_room(axes: Axes, prices: ShadowPrices) -> None:
    network, agents, room = prices.network, prices.bound.agents, prices.room.sum(axis=1)
    sizes = np.abs(room).ravel()
    largest = np.argsort(-sizes, kind="stable")[:BARS]
    cells = [divmod(flat, room.shape[1]) for flat in largest.tolist() if sizes[flat] > WORTH_TELLING * sizes.max()]
    labels = [f"{sentences.compartment_label(network, agents[a])}, {('lower', 'upper')[side]}" for side, a in cells]
    values = [float(room[cell]) for cell in cells]
    axes.barh(range(len(values)), values, color=[GOOD if value > 0 else WARNING for value in values], height=0.6)
    axes.set_yticks(range(len(labels)), labels)
    axes.invert_yaxis()
    style_axes(axes, title="What one per cent more room is worth, by bound of a control")
    axes.set_xlabel(f"rise of λ̄ / {network.mass_unit}", fontsize=9)


def _draw_inputs(axes: Axes, explanation: Explanation) -> None:
    network = explanation.network
    for row, inputs in enumerate(explanation.inputs):
        start = 0.0
        for i, share in enumerate(inputs.share[: inputs.top].tolist()):
            axes.barh(row, share, left=start, color=SERIES[i % len(SERIES)], height=0.7, alpha=0.85)
            if share > 0.12:
                label, letters = sentences.signal_text(network, inputs.signals[i]), int(105 * share)
                label = label if len(label) <= letters else label[: letters - 1] + "…"
                axes.text(start + 0.005, row, label, va="center", fontsize=7, color="white")
            start += share
        cost = number(inputs.top_held.circularity.value)
        axes.text(1.01, row, cost, va="center", fontsize=7, transform=axes.get_yaxis_transform())
    labels = [sentences.compartment_label(network, inputs.agent) for inputs in explanation.inputs]
    axes.set_yticks(range(len(labels)), labels)
    axes.set_xlim(0, 1)
    axes.invert_yaxis()
    style_axes(axes, title="What agents look at, and the change of λ̄ when these inputs are held", size=8.0)
    axes.set_xlabel(f"share of the attribution; at the right change of λ̄ / {network.mass_unit}", fontsize=9)
