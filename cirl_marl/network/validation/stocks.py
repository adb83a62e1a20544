"""What is wrong with stocks, lifetimes, shares and series of a network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cirl_marl.network.calendar import labels
from cirl_marl.network.declarations import Quantity, bound_problems, default_of, numbers
from cirl_marl.network.elements import (
    FIXED_LIFETIME,
    MAX_STEPS,
    Arc,
    Compartment,
    ControlKind,
    Law,
    Lifetime,
    Node,
    Role,
)
from cirl_marl.network.initial_ages import age_problems
from cirl_marl.network.series import Series, extremes
from cirl_marl.network.specification import Specification
from cirl_marl.network.substances import is_past
from cirl_marl.network.validation.settings import is_whole

ORDER_LAWS = (Law.CONTROLLED, Law.EXOGENOUS)
"""Laws of flows that are asked for, whatever there is."""
NARROWEST, WIDEST = 0.02, 3.0
"""Deviations of a lifetime, relative to its mean, that stages follow at all."""


def storage_problems(network: Specification, node: Node, outflows: Sequence[Arc]) -> Iterator[str]:
    """Yield what does not go with a stock that a node has, has not, or whose start is unknown."""
    subject, shares = f"node '{node.id}'", [arc.id for arc in outflows if arc.law is Law.SHARE]
    if node.stores:
        proportional = [arc.id for arc in outflows if arc.law not in (Law.CONTROLLED, Law.EXOGENOUS)]
        if node.initial is None and node.history is None and proportional:
            rule = "only a node whose outflows are all scheduled may leave it out"
            yield f"{subject}: initial: missing; {rule}, and '{proportional[0]}' is not"
        if node.lifetime is not None:
            return
        has_rate = extremes(node.rate)[1] > 0 or (bool(shares) and network.is_variant)  # a draw may stop it
        if bool(shares) != has_rate:
            remedy = "give the node a rate, 1/time, a lifetime, or stores = false"
            remedy_ = (
                f"arc '{shares[0]}' shares what it releases; {remedy}" if shares else "it is for arcs of law 'share'"
            )
            yield f"{subject}: rate = {node.rate!r}: {remedy_}"
        return
    fields = {"initial": node.initial, "model": node.model, "rate": node.rate or None, "lifetime": node.lifetime}
    for name, number in fields.items():
        if number is not None:
            yield f"{subject}: {name}: it stores nothing, so that it has none"
    if node.control is not None:
        remedy = "put controls of kind 'share' on its arcs"
        yield f"{subject}: control: it stores nothing, so that all it gets leaves at once; {remedy}"
    if node.role is not Role.TECHNOSPHERE:
        yield f"{subject}: role '{node.role}': a node that stores nothing is of the technosphere"
    if not outflows:
        yield f"{subject}: it stores nothing and no arc leaves it, so that what enters has nowhere to go"
    orders = [arc.id for arc in outflows if arc.law in ORDER_LAWS]
    for arc in outflows:
        if arc.law is not Law.SHARE and arc.id not in orders:
            reason = f"its donor '{node.id}' stores nothing, so that only shares and orders leave it"
            yield f"arc '{arc.id}': law '{arc.law}': {reason}"
    if orders:
        yield from _order_problems(network, subject, orders, outflows)


def _order_problems(
    network: Specification, subject: str, orders: Sequence[str], outflows: Sequence[Arc]
) -> Iterator[str]:
    """Yield what does not go with orders from a node that stores nothing."""
    arcs = f"arc{'s' * (len(orders) > 1)} {', '.join(map(repr, orders))}"
    batches = any(arc.law is Law.BATCH for arc in network.arcs)
    obstacles = {
        "substances": bool(network.substances),
        "batches": batches,
        f"solver '{network.episode.solver}'": network.episode.solver != "exact",
    }
    for obstacle in (obstacle for obstacle, is_there in obstacles.items() if is_there):
        yield f"{subject}: it stores nothing, and orders from it, as of {arcs}, do not go with {obstacle}"
    for arc in outflows:
        if arc.id in orders and (arc.makes_up_for or arc.capacity_node):
            field = "makes_up_for" if arc.makes_up_for else "capacity_node"
            yield f"arc '{arc.id}': {field}: it orders from '{arc.donor}', which stores nothing; leave it out"
        if arc.law is Law.SHARE and arc.control is not None:
            remedy = f"let it share out what arrives at another node that stores nothing, behind '{arc.donor}'"
            yield f"arc '{arc.id}': control: its donor serves {arcs} first, and others share the rest; {remedy}"


def series_problems(network: Specification) -> Iterator[str]:
    """Yield series that are none, or that do not cover the episode."""
    length = network.episode.control_interval * network.episode.horizon

    def format_time(time: float) -> str:
        return f"{time:g}" + "".join(f" ({fault})" for dates in labels(network, time)[1] for fault in dates)

    parts: list[Any] = [*network.nodes, *network.arcs, *network.services]
    owners: list[tuple[str, Any]] = [(f"{type(part).__name__.lower()} '{part.id}': ", part) for part in parts]
    owners += [(f"{prefix}control.", c.control) for prefix, c in owners if isinstance(c, Compartment) and c.control]
    for prefix, part in owners:
        for name, declaration, value in numbers(part):
            if isinstance(value, Series):
                past = (isinstance(declaration, Quantity) and declaration.past) or is_past(part, name)
                faults = list(value.problems())
                if not faults:
                    faults = [
                        value.history_problem(format_time) if past else value.coverage_problem(length, format_time)
                    ]
                origin = f" ({value.origin})" if value.origin else ""
                yield from (f"{prefix}{name}: {fault}{origin}" for fault in faults if fault)


def share_problems(subject: str, arc: Arc, nodes: Mapping[str, Node]) -> Iterator[str]:
    """Yield what does not go with shares, or with an end that stores nothing."""
    kind = arc.control.kind if arc.control else None
    if kind in (ControlKind.SHARE, ControlKind.TRANSFER) and arc.law is not Law.SHARE:
        yield f"{subject}: control.kind '{kind}' needs law 'share', not '{arc.law}'"
    if kind is ControlKind.TRANSFER and arc.control is not None and not arc.control.substances:
        yield f"{subject}: control.kind 'transfer' needs control.substances, whose share it sets"
    if arc.law is Law.SHARE and kind not in (None, ControlKind.SHARE, ControlKind.TRANSFER):
        remedy = f"a valve on '{arc.donor}' acts on all that it releases"
        yield f"{subject}: law 'share' needs control.kind 'share', not '{kind}'; {remedy}"
    if kind is ControlKind.SHARE and arc.share is not None:
        yield f"{subject}: share: its control sets it; leave it out"
    if arc.law in (Law.BATCH, Law.RECIPIENT):
        for node in (nodes.get(arc.donor), nodes.get(arc.recipient)):
            if node is not None and not node.stores:
                yield f"{subject}: law '{arc.law}' needs a stock at both ends; '{node.id}' stores nothing"


def lifetime_problems(network: Specification, node: Node, arcs: Sequence[Arc]) -> Iterator[str]:
    """Yield what does not go with a lifetime that a node has or has not; ``arcs`` are those that enter or leave it."""
    prefix, kind = f"node '{node.id}': ", node.control.kind if node.control else None
    if node.lifetime is None:
        for name in ("stretch", "history_stretch", "history", "growth"):
            if getattr(node, name) != default_of(Node, name):
                yield f"{prefix}{name}: it has no lifetime; give it one, or leave this out"
        if kind is ControlKind.STRETCH:
            yield f"{prefix}control.kind 'stretch' needs a lifetime; a valve is of kind 'rate'"
        return
    if not node.stores:
        return  # told with all else that such a node has not
    for name, states_it in (("model", node.model is not None), ("rate", extremes(node.rate)[1] > 0)):
        if states_it:
            yield f"{prefix}lifetime: it says when what enters leaves, so that there is no {name}"
    if kind not in (None, ControlKind.STRETCH):
        yield f"{prefix}control.kind '{kind}': a node with a lifetime is controlled by kind 'stretch'"
    yield from _end_problems(node, arcs)
    mistakes = [*bound_problems(node.lifetime, f"{prefix}lifetime.")]
    mistakes = mistakes or [f"{prefix}lifetime.{fault}" for fault in _spread_problems(network, node.lifetime)]
    stretches = kind is ControlKind.STRETCH or node.stretch != 1.0 or node.history_stretch != 1.0
    if node.lifetime.distribution == FIXED_LIFETIME and stretches:
        mistakes.append(f"{prefix}stretch: a fixed lifetime has none; give it a distribution and a small deviation")
    yield from mistakes
    if not mistakes and not [*bound_problems(node)]:
        yield from (f"{prefix}{fault}" for fault in age_problems(node, network.episode.control_interval))


def _end_problems(node: Node, arcs: Sequence[Arc]) -> Iterator[str]:
    if not any(arc.donor == node.id for arc in arcs):
        yield f"node '{node.id}': lifetime: no arc leaves it, so that what has lived has nowhere to go"
    for arc in arcs:
        law = f"arc '{arc.id}': law '{arc.law}'"
        if arc.donor == node.id and arc.law is not Law.SHARE:
            yield f"{law}: its donor '{node.id}' has a lifetime, so that only law 'share' can leave it"
        if arc.recipient == node.id and arc.law in (Law.BATCH, Law.RECIPIENT):
            yield f"{law}: it cannot enter '{node.id}', which has a lifetime"


def _spread_problems(network: Specification, lifetime: Lifetime) -> Iterator[str]:
    mean, deviation, interval = lifetime.mean, lifetime.deviation, network.episode.control_interval
    if lifetime.distribution == FIXED_LIFETIME:
        if deviation is not None:
            yield f"deviation {deviation:g}: a fixed lifetime has none"
        if not is_whole(mean / interval) or not 1 <= round(mean / interval) <= MAX_STEPS:
            whole = f"a whole number, from 1 to {MAX_STEPS:,}, of control intervals of {interval:g}"
            yield f"mean {mean:g} {network.time_unit}: a fixed lifetime is {whole}"
    elif lifetime.distribution == "exponential":
        if deviation not in (None, mean):
            yield f"deviation {deviation:g}: that of an exponential lifetime is its mean; leave it out"
    elif deviation is None:
        yield f"deviation: missing; a {lifetime.distribution} lifetime needs one"
    elif not NARROWEST <= deviation / mean <= WIDEST:
        remedy = "take distribution = 'fixed'" if deviation < mean else "is it in the unit of the mean?"
        range_ = f"{deviation / mean:.3g} of the mean; from {NARROWEST:g} to {WIDEST:g} can be followed"
        yield f"deviation {deviation:g} is {range_}: {remedy}"
