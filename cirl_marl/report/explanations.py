"""Reasons as text, tables and a picture."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from rich.table import Table

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import GOOD, SERIES, WARNING, axis_time, number, save, style_axes, time_axis
from cirl_marl.errors import RunError
from cirl_marl.evaluation.figures import provenance
from cirl_marl.evaluation.statistics import Aggregate
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Network
from cirl_marl.reasons.attribution import PairedDifference
from cirl_marl.reasons.explanation import Explanation
from cirl_marl.reasons.prices import ShadowPrices
from cirl_marl.reasons.sentences import (
    action_text,
    compartment_label,
    condition_text,
    interval_names,
    paragraphs,
    signal_text,
)
from cirl_marl.records.files import publish_folder, write_json, write_table
from cirl_marl.report.curves import WIDTH

FOLDER, FILE = "reasons", "reasons.json"
"""Where a run keeps its reasons."""
LINES, BARS = 6, 8
"""Most stocks and bounds of controls in the picture."""
WORTH_TELLING = 1e-3
"""Part of the largest price of its kind below which a price is left out on screen and in the picture."""
OUTCOME = ("change of λ̄ ({})", "λ̄, low", "λ̄, high", "change of service (1)", "service, low", "service, high")
Reasons = tuple[tuple[str, tuple[str, ...]], ...]
"""Headings with their sentences."""


def write_reasons(found: Explanation, folder: Path, **options: Any) -> list[Path]:
    """Write text, tables, picture and what a page shows, all of them or nothing, and return their paths.

    Raises:
        OSError: if the folder cannot be written.
    """
    written = ["reasons.txt", FILE]
    told = [(heading, tuple(said)) for heading, said in paragraphs(found)]
    with publish_folder(folder) as partial:
        text = "\n\n".join("\n".join([heading, *said]) for heading, said in told)
        (partial / "reasons.txt").write_text(text + "\n", encoding="utf-8")
        about = {"about": found.about, "checkpoint": found.checkpoint, "sections": told}
        write_json(partial / FILE, about | provenance(found.network, **options))
        for file, rows in (
            ("prices.csv", _prices(found)),
            ("inputs.csv", _inputs(found)),
            ("rules.csv", _rules(found)),
        ):
            if len(table := list(rows)) > 1:
                write_table(partial / file, [str(each) for each in table[0]], table[1:])
                written.append(file)
        if found.prices is not None or found.inputs:
            save_reasons(partial / "reasons.png", found)
            written.append("reasons.png")
    return [folder / each for each in written]


def read_reasons(run: RunDirectory, checkpoint: str) -> tuple[Reasons, str]:
    """Return what was written down of why a run's policies act as they do, and why nothing is shown; one is empty.

    Raises:
        RunError: if it cannot be read.
    """
    path = run.path / FOLDER / FILE
    if not path.is_file():
        return (), f"no reasons: cirl explain {run.path.name} finds them"
    try:
        kept = json.loads(path.read_text(encoding="utf-8"))
        sections = tuple((str(heading), tuple(map(str, said))) for heading, said in kept["sections"])
        of = kept["checkpoint"]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise RunError(f"{path}: cannot be read: {error!r}; delete it, or explain the run anew") from error
    if of != checkpoint:
        return (
            (),
            f"no reasons: those in {path.name} are of another checkpoint; cirl explain {run.path.name} finds them anew",
        )
    return sections, ""


def prices_table(found: ShadowPrices) -> Table:
    """Return one row a stock, demand and agent: the first, the largest and the last price of it, or the whole."""
    network, when = found.network, interval_names(found.network)
    mass = network.mass_unit
    table = Table(title=f"what a little more is worth in λ̄ ({mass})")
    for heading in ("more of", "what", when[0], "largest", when[-1]):
        table.add_column(heading, justify="left" if heading in ("more of", "what") else "right")
    groups = [
        (f"one {mass} in the stock", [node.id for node in network.stores], found.stock),
        ("one unit of demand", [service.id for service in network.services], found.demand),
        ("1 % lower bound, downwards", list(found.bound.agents), found.room[0]),
        ("1 % upper bound, upwards", list(found.bound.agents), found.room[1]),
    ]
    for what, ids, prices in groups:
        for i, id_ in enumerate(ids):
            series = prices[:, i]
            if np.abs(series).max() > WORTH_TELLING * np.abs(prices).max():
                largest = float(series[np.abs(series).argmax()])
                table.add_row(id_, what, *(f"{each:.3g}" for each in (series[0], largest, series[-1])))
    return table


def inputs_table(found: Explanation) -> Table:
    """Return one row an agent: what it looks at, and what became of λ̄ when that was held, or the least important."""
    mass = found.network.mass_unit
    table = Table(title=f"what agents look at, and λ̄ ({mass}) when it is held at its mean, with 95 % intervals")
    for heading in ("agent", "inputs", "these held", "least held"):
        table.add_column(heading)
    for each in found.inputs:
        shares = zip(each.signals[: each.top], each.share[: each.top].tolist(), strict=True)
        least = "–" if each.least_held is None else _change(each.least_held.circularity)
        looked = ", ".join(f"{signal.name} {100 * share:.0f} %" for signal, share in shares)
        table.add_row(each.agent, looked, _change(each.top_held.circularity), least)
    return table


def _change(found: Aggregate) -> str:
    return f"{found.value:+.3g} [{found.low:.3g}, {found.high:.3g}]"


def _prices(found: Explanation) -> Iterator[list[object]]:
    """Yield a table with a row for each price in each interval."""
    if found.prices is None:
        return
    prices, network = found.prices, found.network
    mass, rate = network.mass_unit, f"{network.mass_unit}/{network.time_unit}"
    yield ["more of", "compartment or service", "interval", "rise of λ̄", "unit"]
    when = interval_names(network)
    for i, node in enumerate(network.stores):
        for step, value in enumerate(prices.stock[:, i].tolist()):
            yield ["stock at the start", node.id, when[step], _number(value), f"{mass} per {mass}"]
    for s, service in enumerate(network.services):
        unit = mass if service.quantity == "stock" else rate
        for step, value in enumerate(prices.demand[:, s].tolist()):
            yield ["demand", service.id, when[step], _number(value), f"{mass} per {unit}"]
        yield ["level demanded", service.id, "all", _number(float(prices.level[s]) / 100), f"{mass} per percent"]
    for side, what in enumerate(("lower bound, downwards", "upper bound, upwards")):
        for a, agent in enumerate(prices.bound.agents):
            for step, value in enumerate(prices.room[side, :, a].tolist()):
                yield [what, agent, when[step], _number(value), f"{mass} per percent"]


def _inputs(found: Explanation) -> Iterator[list[object]]:
    """Yield a table with a row for each input of each agent; what became of λ̄ stands behind those that were held."""
    yield [
        "agent", "input", "unit", "share", "change of action per unit", "held together",
        *(each.format(found.network.mass_unit) for each in OUTCOME),
    ]  # fmt: skip
    for each in found.inputs:
        for i, signal in enumerate(each.signals):
            held, outcome = "", None
            if i < each.top:
                held, outcome = "most important", each.top_held
            elif each.least_held is not None and i >= len(each.signals) - each.top:
                held, outcome = "least important", each.least_held
            slope = "; ".join(_number(float(each_) / signal.scale) for each_ in each.slope[:, i])
            yield [each.agent, signal.name, signal.unit, _number(float(each.share[i])), slope, held, *_outcome(outcome)]


def _rules(found: Explanation) -> Iterator[list[object]]:
    """Yield a table with a row for each leaf of each agent's rule."""
    yield [
        "agent", "when", "what", "control", "share of decisions", "variance explained",
        *(each.format(found.network.mass_unit) for each in OUTCOME),
    ]  # fmt: skip
    if found.rules is None:
        return
    network = found.network
    for rule in found.rules.rules:
        for leaf in rule.leaves:
            control = "; ".join(_number(each) for each in leaf.control.tolist())
            when, what = condition_text(network, leaf.conditions) or "always", action_text(network, rule.agent, leaf)
            shares = _number(leaf.share), _number(rule.explained)
            yield [rule.agent, when, what, control, *shares, *_outcome(rule.cost)]
    yield ["all together", "", "", "", "", "", *_outcome(found.rules.together)]


def _outcome(found: PairedDifference | None) -> list[str]:
    if found is None:
        return [""] * len(OUTCOME)
    ends = [end for each in (found.circularity, found.service) for end in (each.value, each.low, each.high)]
    return [_number(end) for end in ends]


def _number(value: float) -> str:
    return f"{value:.10g}"


def save_reasons(path: Path, found: Explanation) -> Path:
    """Save prices of stocks over time, what room is worth, and what agents look at, as a PNG, and return its path."""
    panels = 2 * (found.prices is not None) + bool(found.inputs)
    tall = 0.24 * len(found.inputs) + 1.2 if found.inputs else 0.0
    heights = [3.2] * (found.prices is not None) + [2.4] * (found.prices is not None) + [tall] * bool(found.inputs)
    figure = Figure(figsize=(WIDTH, sum(heights)), layout="constrained")
    axes = list(figure.subplots(panels, 1, squeeze=False, height_ratios=heights).ravel())
    if found.prices is not None:
        _draw_stocks(axes.pop(0), found.network, found.prices)
        _draw_room(axes.pop(0), found.network, found.prices)
    if found.inputs:
        _draw_inputs(axes.pop(0), found)
    return save(figure, path)


def _draw_stocks(axes: Any, network: Network, prices: ShadowPrices) -> None:
    begins = interval_ends(network) - network.episode.control_interval
    time, largest = axis_time(begins, network), np.abs(prices.stock).max(axis=0)
    for place, i in enumerate(np.argsort(-largest, kind="stable")[:LINES].tolist()):
        if largest[i] > 0:
            axes.plot(
                time, prices.stock[:, i], color=SERIES[place], label=compartment_label(network, network.stores[i].id)
            )
    mass = network.mass_unit
    style_axes(axes, title=f"What one more {mass} in a stock is worth in λ̄", ylabel=f"{mass} per {mass}")
    time_axis(axes, time, network)
    if axes.lines:
        axes.legend(frameon=False, fontsize=8, ncols=2)


def _draw_room(axes: Any, network: Network, prices: ShadowPrices) -> None:
    room = prices.room.sum(axis=1)
    sizes = np.abs(room).ravel()
    order = [
        each for each in np.argsort(-sizes, kind="stable")[:BARS].tolist() if sizes[each] > WORTH_TELLING * sizes.max()
    ]
    labels = []
    for flat in order:
        side, a = divmod(flat, room.shape[1])
        labels.append(f"{compartment_label(network, prices.bound.agents[a])}, {('lower', 'upper')[side]}")
    values = [float(room.ravel()[each]) for each in order]
    axes.barh(range(len(values)), values, color=[GOOD if each > 0 else WARNING for each in values], height=0.6)
    axes.set_yticks(range(len(labels)), labels)
    axes.invert_yaxis()
    style_axes(axes, title="What one per cent more room is worth, by bound of a control")
    axes.set_xlabel(f"rise of λ̄ / {network.mass_unit}", fontsize=9)


def _draw_inputs(axes: Any, found: Explanation) -> None:
    for row, each in enumerate(found.inputs):
        left = 0.0
        for i in range(each.top):
            share = float(each.share[i])
            axes.barh(row, share, left=left, color=SERIES[i % len(SERIES)], height=0.7, alpha=0.85)
            if share > 0.12:
                label, room = signal_text(found.network, each.signals[i]), int(105 * share)
                label = label if len(label) <= room else label[: room - 1] + "…"
                axes.text(left + 0.005, row, label, va="center", fontsize=7, color="white")
            left += share
        cost = number(each.top_held.circularity.value)
        axes.text(1.01, row, cost, va="center", fontsize=7, transform=axes.get_yaxis_transform())
    axes.set_yticks(range(len(found.inputs)), [compartment_label(found.network, each.agent) for each in found.inputs])
    axes.set_xlim(0, 1)
    axes.invert_yaxis()
    style_axes(axes, title="What agents look at, and the change of λ̄ when these inputs are held", size=8.0)
    axes.set_xlabel(f"share of the attribution; at the right change of λ̄ / {found.network.mass_unit}", fontsize=9)
