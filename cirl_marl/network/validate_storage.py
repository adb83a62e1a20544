"""What is wrong with stocks, shares and series of a network."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from cirl_marl.network.calendar import labels
from cirl_marl.network.declared import Quantity, declarations
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Law, Node, Role
from cirl_marl.network.parts import Parts
from cirl_marl.network.series import Series, extremes


def storage_problems(node: Node, outflows: Sequence[Arc]) -> Iterator[str]:
    """Yield what does not go with a stock that a node has, has not, or whose start is unknown."""
    where, shares = f"node '{node.id}'", [arc.id for arc in outflows if arc.law is Law.SHARE]
    if node.stores:
        unscheduled = [arc.id for arc in outflows if arc.law not in (Law.CONTROLLED, Law.EXOGENOUS)]
        if node.initial is None and node.history is None and unscheduled:
            allowed = "only a node whose outflows are all scheduled may leave it out"
            yield f"{where}: initial: missing; {allowed}, and '{unscheduled[0]}' is not"
        if node.lifetime is not None:
            return
        if bool(shares) != (extremes(node.rate)[1] > 0):
            remedy = "give the node a rate, 1/time, a lifetime, or stores = false"
            told = f"arc '{shares[0]}' shares what it releases; {remedy}" if shares else "it is for arcs of law 'share'"
            yield f"{where}: rate = {node.rate!r}: {told}"
        return
    given_ = {"initial": node.initial, "model": node.model, "rate": node.rate or None, "lifetime": node.lifetime}
    for name, given in given_.items():
        if given is not None:
            yield f"{where}: {name}: it stores nothing, so that it has none"
    if node.control is not None:
        remedy = "put controls of kind 'share' on its arcs"
        yield f"{where}: control: it stores nothing, so that all it gets leaves at once; {remedy}"
    if node.role is not Role.TECHNOSPHERE:
        yield f"{where}: role '{node.role}': a node that stores nothing is of the technosphere"
    if not outflows:
        yield f"{where}: it stores nothing and no arc leaves it, so that what enters has nowhere to go"
    for arc in outflows:
        if arc.law is not Law.SHARE:
            reason = f"its donor '{node.id}' stores nothing, so that only law 'share' can leave it"
            yield f"arc '{arc.id}': law '{arc.law}': {reason}"


def series_problems(network: Parts) -> Iterator[str]:
    """Yield series that are none, or that do not cover the episode."""
    length = network.episode.control_interval * network.episode.horizon

    def said(time: float) -> str:
        return f"{time:g}" + "".join(f" ({each})" for dates in labels(network, time)[1] for each in dates)

    parts: list[Any] = [*network.nodes, *network.arcs, *network.services]
    named: list[tuple[str, Any]] = [(f"{type(part).__name__.lower()} '{part.id}': ", part) for part in parts]
    named += [(f"{where}control.", c.control) for where, c in named if isinstance(c, Compartment) and c.control]
    for where, part in named:
        for name, declared in declarations(type(part)).items():
            value = getattr(part, name)
            if isinstance(value, Series):
                past = isinstance(declared, Quantity) and declared.past
                told = list(value.problems()) or [value.unfinished(said) if past else value.uncovered(length, said)]
                origin = f" ({value.origin})" if value.origin else ""
                yield from (f"{where}{name}: {each}{origin}" for each in told if each)


def share_problems(where: str, arc: Arc, nodes: Mapping[str, Node]) -> Iterator[str]:
    """Yield what does not go with shares, or with an end that stores nothing."""
    kind = arc.control.kind if arc.control else None
    if kind is ControlKind.SHARE and arc.law is not Law.SHARE:
        yield f"{where}: control.kind 'share' needs law 'share', not '{arc.law}'"
    if arc.law is Law.SHARE and kind not in (None, ControlKind.SHARE):
        remedy = f"a valve on '{arc.donor}' acts on all that it releases"
        yield f"{where}: law 'share' needs control.kind 'share', not '{kind}'; {remedy}"
    if kind is ControlKind.SHARE and arc.share is not None:
        yield f"{where}: share: its control sets it; leave it out"
    if arc.law in (Law.BATCH, Law.RECIPIENT):
        for node in (nodes.get(arc.donor), nodes.get(arc.recipient)):
            if node is not None and not node.stores:
                yield f"{where}: law '{arc.law}' needs a stock at both ends; '{node.id}' stores nothing"
