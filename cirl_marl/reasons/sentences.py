"""Reasons in sentences, with units and calendar years."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence

import numpy as np

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.style import number, readable
from cirl_marl.evaluation.statistics import Aggregate
from cirl_marl.network import Network
from cirl_marl.network.calendar import labels
from cirl_marl.network.elements import Arc, ControlKind
from cirl_marl.reasons.attribution import AgentInputs, PairedDifference
from cirl_marl.reasons.explanation import Explanation
from cirl_marl.reasons.observations import TIME, Signal
from cirl_marl.reasons.prices import ShadowPrices
from cirl_marl.reasons.rules import Condition, Leaf, Rule

SHOWN = 5
"""Most stocks and agents of which prices are told in sentences."""
SMALL = 1e-6
"""Of the largest price of a kind: below it nothing is worth telling."""
SAME = 0.02
"""Part of a control's range within which two values are the same in words."""


def sentences(found: Explanation) -> list[str]:
    """Return what an explanation says, a sentence or two each."""
    said: list[str] = []
    if found.prices is not None:
        said += price_sentences(found.prices)
    if found.no_prices:
        said.append(f"There are no shadow prices: {found.no_prices}.")
    for each in found.inputs:
        said.append(input_sentence(found.network, each))
    if found.rules is not None:
        for rule in found.rules.rules:
            said += rule_sentences(found.network, rule)
        said.append(f"If all agents act by their rules, {difference_text(found.network, found.rules.together)}.")
    return said


def price_sentences(found: ShadowPrices) -> list[str]:
    """Say what is worth most."""
    network, bound = found.network, found.bound
    mass, when = network.mass_unit, interval_names(network)
    said = [f"At the best, λ̄ is {number(bound.objective)} {mass}."]
    largest = np.abs(found.stock).max(axis=0)
    for i in np.argsort(-largest, kind="stable")[:SHOWN].tolist():
        if largest[i] <= SMALL * max(largest.max(), 1e-300):
            continue
        prices, node = found.stock[:, i], network.stores[i]
        step = int(np.abs(prices).argmax())
        way = "raises" if prices[step] > 0 else "lowers"
        at = f"{abs(prices[step]):.3g} {mass} {_when(when[step])}"
        if abs(prices[0]) < abs(prices[step]):
            at += f", by {number(float(abs(prices[0])))} {mass} at the start"
        said.append(f"One more {mass} in {compartment_label(network, node.id)} {way} λ̄ by up to {at}.")
    demand = found.demand.sum(axis=0)
    for s, service in enumerate(network.services):
        if found.demand.any() and abs(demand[s]) > SMALL * np.abs(demand).max():
            unit = mass if service.quantity == "stock" else f"{mass}/{network.time_unit}"
            title = service.title or readable(service.id)
            said.append(
                f"One more {unit} of demand for {title} in every interval costs {number(float(-demand[s]))} {mass} of"
                f" λ̄; one per cent more of its level {number(float(-found.level[s] / 100))} {mass}."
            )
    room = found.room.sum(axis=1)
    for flat in np.argsort(-np.abs(room).ravel(), kind="stable")[:SHOWN].tolist():
        side, a = divmod(flat, room.shape[1])
        if abs(room[side, a]) > SMALL * abs(bound.objective):
            what, way = (("lower", "lower"), ("upper", "higher"))[side]
            said.append(
                f"If the {what} bound of {compartment_label(network, bound.agents[a])} were one per cent {way}, λ̄"
                f" could be {number(float(room[side, a]))} {mass} higher."
            )
    return said


def input_sentence(network: Network, found: AgentInputs) -> str:
    """Say what an agent looks at, and what becomes of λ̄ when it does not."""
    if not found.share.any():
        return f"*{compartment_label(network, found.agent)}* always does the same, whatever it sees."
    parts = []
    for i in range(found.top):
        ways = {bool(slope > 0) for slope in found.slope[:, i]}
        way = "" if len(ways) > 1 else f", acts {'more' if ways == {True} else 'less'} as it rises"
        parts.append(f"{signal_text(network, found.signals[i])} ({100 * found.share[i]:.0f} %{way})")
    hidden = (
        f"If it is shown their mean{'s' if len(parts) > 1 else ''} instead, {difference_text(network, found.top_held)}."
    )
    return f"*{compartment_label(network, found.agent)}* looks at {joined_text(parts)}. {hidden}"


def rule_sentences(network: Network, rule: Rule) -> list[str]:
    """Say what an agent does when, leaf after leaf, and what it costs if it does just that."""
    who, said = compartment_label(network, rule.agent), []
    for leaf in sorted(_merged(network, rule), key=lambda each: (_since(each), -each.share)):
        when = condition_text(network, leaf.conditions)
        deed = f"*{who}* {action_text(network, rule.agent, leaf)}"
        often = "" if len(rule.leaves) == 1 else f" ({100 * leaf.share:.0f} % of decisions)"
        said.append(f"{when[:1].upper() + when[1:]} {deed}{often}." if when else f"Always {deed}.")
    said.append(f"Acting by this rule, {difference_text(network, rule.cost)}.")
    return said


def _merged(network: Network, rule: Rule) -> list[Leaf]:
    """Join the leaves of a tree of two that say the same; others keep what sets them apart."""
    said = {action_text(network, rule.agent, leaf) for leaf in rule.leaves}
    if len(said) > 1:
        return [*rule.leaves]
    first = rule.leaves[0]
    return [Leaf((), first.action, first.control, 1.0)]


def _since(leaf: Leaf) -> float:
    return max((each.low for each in leaf.conditions if each.signal.name == TIME), default=-math.inf)


def condition_text(network: Network, found: Sequence[Condition]) -> str:
    """Say when: first the calendar, then what is seen.

    A condition on time is one on the beginning of intervals.
    """
    when, seen, labelled = "", [], interval_names(network)
    for each in found:
        if each.signal.name == TIME:
            steps = len(labelled)
            since = 0 if each.low == -math.inf else min(math.floor(each.low * steps + 1e-6) + 1, steps - 1)
            until = steps if each.high == math.inf else min(math.floor(each.high * steps + 1e-6) + 1, steps - 1)
            begins, ends = since > 0, until < steps
            if begins and ends:
                when = f"from {labelled[since]} to before {labelled[until]}"
            elif begins:
                when = f"from {labelled[since]} on"
            elif ends:
                when = f"before {labelled[until]}"
            continue
        low, high = each.low * each.signal.scale, each.high * each.signal.scale
        unit = "" if each.signal.unit == "1" else f" {each.signal.unit}"
        what = signal_text(network, each.signal)
        if math.isfinite(low) and math.isfinite(high):
            seen.append(f"{what} is between {number(low)} and {number(high)}{unit}")
        elif math.isfinite(low):
            seen.append(f"{what} is above {number(low)}{unit}")
        else:
            seen.append(f"{what} is at most {number(high)}{unit}")
    where = f"while {joined_text(seen)}," if seen else ""
    return f"{when}{', ' if when and where else ',' if when else ''}{where}".replace(",,", ",")


def action_text(network: Network, agent: str, leaf: Leaf) -> str:
    """Say what an agent does in a leaf."""
    compartment = network.compartments[agent]
    control, rows = compartment.control, network.control_rows[agent]
    assert control is not None
    low, neutral, high = (each.mean() for each in network.control_bounds[:, rows.start])
    value, action = float(leaf.control[0]), float(leaf.action[0])
    if control.kind is ControlKind.INPUT:
        names = compartment.model.input_names if compartment.model is not None else ()
        return "sets " + joined_text(
            [f"{each} to {number(at)}" for each, at in zip(names, leaf.control.tolist(), strict=True)]
        )
    shown = {
        ControlKind.FLOW: f"{number(value)} {network.mass_unit}/{network.time_unit}",
        ControlKind.SHARE: f"{100 * value:.3g} %" + _of_donor(network, agent),
        ControlKind.STRETCH: f"a lifetime {100 * (value - 1):+.0f} %".replace("-", "−"),
        ControlKind.RATE: f"{100 * value:.3g} % of its flow",
    }[control.kind]
    if action > 1 - 2 * SAME:
        return f"opens as far as it can, to {shown}"
    if action < -1 + 2 * SAME:
        return f"closes as far as it can, to {shown}"
    if abs(value - neutral) < SAME * (high - low):
        return f"stays about as usual, at {shown}"
    return f"{'opens' if value > neutral else 'closes'} to {shown}"


def _of_donor(network: Network, agent: str) -> str:
    compartment = network.compartments[agent]
    return f" of {network.compartments[compartment.donor].label}" if isinstance(compartment, Arc) else ""


def difference_text(network: Network, found: PairedDifference) -> str:
    """Say how λ̄ and service differ, with 95 % intervals."""
    if found.usual == 0:
        by = _ranged(found.circularity, 1.0, network.mass_unit)
    else:
        by = _ranged(found.circularity, 100 / abs(found.usual), "%")
    return f"λ̄ changes by {by} and service by {_ranged(found.service, 100.0, 'points')}"


def _ranged(found: Aggregate, factor: float, unit: str) -> str:
    value, low, high = (f"{factor * each:+.2f}".replace("-", "−") for each in (found.value, found.low, found.high))
    return f"{value} {unit} [{low}, {high}]"


def signal_text(network: Network, found: Signal) -> str:
    """Name a signal."""
    if not found.about:
        return "the time" if found.name == TIME else readable(found.name)
    kind = found.name[: -len(found.about)].rstrip()
    return f"{kind} {compartment_label(network, found.about)}"


def compartment_label(network: Network, compartment: str) -> str:
    """Name a compartment as pictures do."""
    return network.compartments[compartment].label


def interval_names(network: Network) -> list[str]:
    """Return what the beginning of each interval is called: a year or date, or the time since the start."""
    begins = interval_ends(network) - network.episode.control_interval
    _, dates = labels(network, begins)
    return dates[0] if dates else [f"{network.time_unit} {each:.6g}" for each in begins.tolist()]


def _when(moment: str) -> str:
    return f"in {moment}" if moment.isdigit() else f"at {moment}"


def joined_text(parts: Sequence[str]) -> str:
    """Join parts with commas and an ``and``."""
    return parts[0] if len(parts) == 1 else f"{', '.join(parts[:-1])} and {parts[-1]}"


def paragraphs(found: Explanation) -> Iterator[tuple[str, list[str]]]:
    """Yield headings with their sentences: of the network, then agent by agent."""
    if found.prices is not None or found.no_prices:
        only = Explanation(network=found.network, about="", prices=found.prices, no_prices=found.no_prices)
        yield "What is worth what", sentences(only)
    rules = {} if found.rules is None else {rule.agent: rule for rule in found.rules.rules}
    looked = {each.agent: each for each in found.inputs}
    for agent in dict.fromkeys([*looked, *rules]):
        said = [input_sentence(found.network, looked[agent])] if agent in looked else []
        said += rule_sentences(found.network, rules[agent]) if agent in rules else []
        yield compartment_label(found.network, agent), said
    if found.rules is not None:
        yield (
            "All rules together",
            [f"If all agents act by their rules, {difference_text(found.network, found.rules.together)}."],
        )
