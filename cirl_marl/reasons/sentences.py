"""Reasons in sentences, with units and calendar years."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence

import numpy as np

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import number, readable
from cirl_marl.evaluation.statistics import Aggregate
from cirl_marl.network import Network
from cirl_marl.network.calendar import labels
from cirl_marl.network.elements import Arc, ControlKind
from cirl_marl.reasons.attribution import AgentInputs, PairedDifference
from cirl_marl.reasons.explanation import Explanation
from cirl_marl.reasons.input_signals import TIME, Signal
from cirl_marl.reasons.prices import ShadowPrices
from cirl_marl.reasons.rules import Condition, Leaf, Rule
from cirl_marl.reasons.state_prices import StatePrices

MOST_PRICES = 5
"""Most stocks and agents of which prices are told in sentences."""
MOST_STATE_PRICES = 3
"""Most stocks whose prices by state are told of each disturbance."""
SMALL = 1e-6
"""Of the largest price of a kind: below it nothing is worth telling."""
TOLERANCE = 0.02
"""Part of a control's range within which two values are the same in words."""


def paragraphs(explanation: Explanation) -> Iterator[tuple[str, list[str]]]:
    """Yield headings with their sentences: of the network, then agent by agent."""
    network = explanation.network
    prices = [] if explanation.prices is None else price_sentences(explanation.prices)
    if explanation.no_prices:
        prices.append(f"There are no shadow prices: {explanation.no_prices}.")
    if explanation.prices is not None or explanation.no_prices:
        yield "What is worth what", prices
    if explanation.state_prices:
        by_state = (state_sentences(network, prices) for prices in explanation.state_prices)
        yield "What stocks are worth when", [sentence for texts in by_state for sentence in texts]
    sentences = {inputs.agent: [input_sentence(network, inputs)] for inputs in explanation.inputs}
    for rule in () if explanation.rules is None else explanation.rules.rules:
        sentences[rule.agent] = sentences.get(rule.agent, []) + rule_sentences(network, rule)
    for agent, of_agent in sentences.items():
        yield compartment_label(network, agent), of_agent
    if explanation.rules is not None:
        difference = difference_text(network, explanation.rules.together)
        yield "All rules together", [f"If all agents act by their rules, {difference}."]


def price_sentences(prices: ShadowPrices) -> list[str]:
    """Say what is worth most."""
    network, bound = prices.network, prices.bound
    mass, times = network.mass_unit, interval_names(network)
    sentences = [f"At the best, λ̄ is {number(bound.objective)} {mass}."]
    largest = np.abs(prices.stock).max(axis=0)
    for i in np.argsort(-largest, kind="stable")[:MOST_PRICES].tolist():
        if largest[i] <= SMALL * max(largest.max(), 1e-300):
            continue
        worth = prices.stock[:, i]
        step = int(np.abs(worth).argmax())
        moment = f"in {times[step]}" if times[step].isdigit() else f"at {times[step]}"
        verb, opposite = ("raises", "lowers") if worth[step] > 0 else ("lowers", "raises")
        change = f"{verb} λ̄ by up to {abs(worth[step]):.3g} {mass} {moment}"
        if abs(worth[0]) < abs(worth[step]):
            change += "," if worth[0] * worth[step] >= 0 else f", and {opposite} it"
            change += f" by {number(float(abs(worth[0])))} {mass} at the start"
        sentences.append(f"One more {mass} in {compartment_label(network, network.stores[i].id)} {change}.")
    demand = prices.demand.sum(axis=0)
    for s, service in enumerate(network.services):
        if prices.demand.any() and abs(demand[s]) > SMALL * np.abs(demand).max():
            unit = mass if service.quantity == "stock" else f"{mass}/{network.time_unit}"
            title = service.title or readable(service.id)
            sentences.append(
                f"One more {unit} of demand for {title} in every interval costs {number(float(-demand[s]))} {mass} of"
                f" λ̄; one per cent more of its level {number(float(-prices.level[s] / 100))} {mass}."
            )
    room = prices.room.sum(axis=1)
    for flat in np.argsort(-np.abs(room).ravel(), kind="stable")[:MOST_PRICES].tolist():
        side, a = divmod(flat, room.shape[1])
        if abs(room[side, a]) > SMALL * abs(bound.objective):
            end, direction = (("lower", "lower"), ("upper", "higher"))[side]
            sentences.append(
                f"If the {end} bound of {compartment_label(network, bound.agents[a])} were one per cent {direction}, λ̄"
                f" could be {number(float(room[side, a]))} {mass} higher."
            )
    return sentences


def state_sentences(network: Network, prices: StatePrices) -> list[str]:
    """Say of which stocks the price differs most by the state of a disturbance, and what it is."""
    spread, mass = np.ptp(prices.stock, axis=0), network.mass_unit
    sentences = []
    for i in np.argsort(-spread, kind="stable")[:MOST_STATE_PRICES].tolist():
        if spread[i] > SMALL * max(float(np.abs(prices.stock).max()), 1e-300):
            parts = [
                f"{number(float(price))} {mass} of λ̄ while {readable(prices.disturbance)} is "
                + (number(low) if low == high else f"{number(low)} to {number(high)}")
                for (low, high), price in zip(prices.states.tolist(), prices.stock[:, i], strict=True)
            ]
            label = compartment_label(network, network.stores[i].id)
            sentences.append(f"One more {mass} in {label} is worth {joined_text(parts)}.")
    return sentences


def input_sentence(network: Network, inputs: AgentInputs) -> str:
    """Say what an agent looks at, and what becomes of λ̄ when it does not."""
    agent = f"*{compartment_label(network, inputs.agent)}*"
    if not inputs.share.any():
        return f"{agent} always does the same, whatever it sees."
    parts = []
    for i in range(inputs.top):
        rises = {bool(slope > 0) for slope in inputs.slope[:, i]}
        tendency = "" if len(rises) > 1 else f", acts {'more' if rises == {True} else 'less'} as it rises"
        parts.append(f"{signal_text(network, inputs.signals[i])} ({100 * inputs.share[i]:.0f} %{tendency})")
    means = "their means" if len(parts) > 1 else "their mean"
    effect = f"If it is shown {means} instead, {difference_text(network, inputs.top_held)}."
    return f"{agent} looks at {joined_text(parts)}. {effect}"


def rule_sentences(network: Network, rule: Rule) -> list[str]:
    """Say what an agent does when, leaf after leaf, and what it costs if it does just that."""
    leaves = list(rule.leaves)
    if len({action_text(network, rule.agent, leaf) for leaf in leaves}) == 1:  # all say the same
        leaves = [Leaf((), leaves[0].action, leaves[0].control, 1.0)]
    sentences = []
    for leaf in sorted(leaves, key=lambda leaf: (_first_time(leaf), -leaf.share)):
        condition = condition_text(network, leaf.conditions)
        action = f"*{compartment_label(network, rule.agent)}* {action_text(network, rule.agent, leaf)}"
        share = "" if len(rule.leaves) == 1 else f" ({100 * leaf.share:.0f} % of decisions)"
        sentences.append(
            f"{condition[:1].upper() + condition[1:]} {action}{share}." if condition else f"Always {action}."
        )
    sentences.append(f"Acting by this rule, {difference_text(network, rule.cost)}.")
    return sentences


def _first_time(leaf: Leaf) -> float:
    return max((condition.low for condition in leaf.conditions if condition.signal.name == TIME), default=-math.inf)


def condition_text(network: Network, conditions: Sequence[Condition]) -> str:
    """Say when: first the calendar, then what is seen.

    A condition on time is one on the beginning of intervals.
    """
    calendar, signals = "", []
    for condition in conditions:
        if condition.signal.name == TIME:
            calendar = _time_text(condition, interval_names(network))
            continue
        low, high = condition.low * condition.signal.scale, condition.high * condition.signal.scale
        unit = "" if condition.signal.unit == "1" else f" {condition.signal.unit}"
        span = f"above {number(low)}" if math.isfinite(low) else f"at most {number(high)}"
        if math.isfinite(low) and math.isfinite(high):
            span = f"between {number(low)} and {number(high)}"
        signals.append(f"{signal_text(network, condition.signal)} is {span}{unit}")
    parts = [calendar] if calendar else []
    parts += [f"while {joined_text(signals)}"] if signals else []
    return f"{', '.join(parts)}," if parts else ""


def _time_text(condition: Condition, times: Sequence[str]) -> str:
    steps = len(times)
    first, end = (
        share if math.isinf(share) else min(math.floor(share * steps + 1e-6) + 1, steps - 1)
        for share in (condition.low, condition.high)
    )
    if first > 0 and end < steps:
        return f"from {times[int(first)]} to before {times[int(end)]}"
    if first > 0:
        return f"from {times[int(first)]} on"
    return f"before {times[int(end)]}" if end < steps else ""


def action_text(network: Network, agent: str, leaf: Leaf) -> str:
    """Say what an agent does in a leaf."""
    compartment = network.compartments[agent]
    control = compartment.control
    assert control is not None
    low, neutral, high = network.control_bounds[:, network.control_rows[agent].start].mean(axis=1)
    value, action = float(leaf.control[0]), float(leaf.action[0])
    if control.kind is ControlKind.INPUT:
        names = compartment.model.input_names if compartment.model is not None else ()
        values = zip(names, leaf.control.tolist(), strict=True)
        return "sets " + joined_text([f"{name} to {number(level)}" for name, level in values])
    donor = f" of {compartment_label(network, compartment.donor)}" if isinstance(compartment, Arc) else ""
    amount = {
        ControlKind.FLOW: f"{number(value)} {network.mass_unit}/{network.time_unit}",
        ControlKind.SHARE: f"{100 * value:.3g} %{donor}",
        ControlKind.TRANSFER: f"{100 * value:.3g} % of the {' and '.join(control.substances)}{donor}",
        ControlKind.STRETCH: f"a lifetime {100 * (value - 1):+.0f} %".replace("-", "−"),
        ControlKind.RATE: f"{100 * value:.3g} % of its flow",
    }[control.kind]
    if action > 1 - 2 * TOLERANCE:
        return f"opens as far as it can, to {amount}"
    if action < -1 + 2 * TOLERANCE:
        return f"closes as far as it can, to {amount}"
    if abs(value - neutral) < TOLERANCE * (high - low):
        return f"stays about as usual, at {amount}"
    return f"{'opens' if value > neutral else 'closes'} to {amount}"


def difference_text(network: Network, difference: PairedDifference) -> str:
    """Say how λ̄ and service differ, with 95 % intervals."""
    factor, unit = (100 / abs(difference.usual), "%") if difference.usual else (1.0, network.mass_unit)
    circularity = _interval_text(difference.circularity, factor, unit)
    return f"λ̄ changes by {circularity} and service by {_interval_text(difference.service, 100.0, 'points')}"


def _interval_text(aggregate: Aggregate, factor: float, unit: str) -> str:
    figures = (aggregate.value, aggregate.low, aggregate.high)
    value, low, high = (f"{factor * figure:+.2f}".replace("-", "−") for figure in figures)
    return f"{value} {unit} [{low}, {high}]"


def signal_text(network: Network, signal: Signal) -> str:
    """Name a signal."""
    if not signal.about:
        return "the time" if signal.name == TIME else readable(signal.name)
    kind = signal.name[: -len(signal.about)].rstrip()
    return f"{kind} {compartment_label(network, signal.about)}"


def compartment_label(network: Network, compartment: str) -> str:
    """Name a compartment as pictures do."""
    return network.compartments[compartment].label


def interval_names(network: Network, form: Callable[[float], str] | None = None) -> list[str]:
    """Return what the beginning of each interval is called: a year or date, or ``form`` of the time since the start."""
    begins = interval_ends(network) - network.episode.control_interval
    _, dates = labels(network, begins)
    form = form or (lambda time: f"{network.time_unit} {time:.6g}")
    return dates[0] if dates else [form(time) for time in begins.tolist()]


def joined_text(parts: Sequence[str]) -> str:
    """Join parts with commas and an ``and``."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"
