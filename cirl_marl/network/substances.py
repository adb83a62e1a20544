"""What each substance does in a network: where nodes separate it, it has shares of its own."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np

from cirl_marl.network.elements import Arc, ControlKind, Law, Node
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.series import Series, Value
from cirl_marl.network.specification import Specification
from cirl_marl.network.split_fractions import Split, splits, trap_problems

REMAINDER = "remainder"
"""What that of a stock is called which is no substance."""
CONTENT = "content."
"""What names of numbers that are contents begin with, before the substance."""


def arc_of_substance(arc: Arc, substance: str) -> Arc:
    """Return an arc as a substance takes it: of law ``share`` with the share of that substance."""
    control, transfer = arc.control, dict(arc.transfer)
    if arc.law is not Law.SHARE or (control is None and not transfer):
        return arc
    if control is not None and substance in control.substances:
        return replace(arc, share=None, control=replace(control, kind=ControlKind.SHARE, substances=()), transfer=())
    if substance in transfer:
        return replace(arc, share=transfer[substance], control=None, transfer=())
    if control is not None and control.kind is ControlKind.TRANSFER:
        control = None
    return replace(arc, control=control, transfer=())


def network_of_substance(network: Specification, substance: str) -> Specification:
    """Return the nodes and arcs of a network as a substance takes them."""
    arcs = tuple(arc_of_substance(arc, substance) for arc in network.arcs)
    return Specification(name=network.name, nodes=network.nodes, arcs=arcs, episode=network.episode)


def separated_substances(network: Specification) -> list[str]:
    """Return the substances that some node separates, in the order of the network."""
    names = {id_ for arc in network.arcs for id_ in dict(arc.transfer)}
    names |= {id_ for arc in network.arcs if arc.control is not None for id_ in arc.control.substances}
    return [substance.id for substance in network.substances if substance.id in names]


def separates(network: Specification, split: Split) -> bool:
    """Whether the arcs of a split separate substances."""
    arcs = [network.arcs[k] for k in (*split.controlled_arcs, *split.other_arcs)]
    return any(arc.transfer or (arc.control is not None and arc.control.substances) for arc in arcs)


def follows_contents(network: Specification) -> bool:
    """Whether masses or services depend on contents: by a node that separates, a service, or a changing source."""
    if any(service.substance for service in network.services):
        return True
    return bool(separated_substances(network) or changing_sources(network))


def is_past(part: Any, name: str) -> bool:
    """Whether a number of a part is the content of a history, so that it is about the time before the episode."""
    return name.startswith(CONTENT) and part.history is not None


def changes(node: Node) -> bool:
    """Whether some content of a node changes in time."""
    return any(isinstance(part, Series) for part in dict(node.content).values())


def changing_sources(network: Specification) -> list[Node]:
    """Return the sources whose contents change in time, or are disturbed, in the order of the nodes.

    What they give has the content of the interval. Of their stock each component is a reserve of its own: they hold
    what can be asked of each at most, and give out when one of them does.
    """
    ids = {path.split(".")[1] for path in network.disturbed if f".{CONTENT}" in path}
    return [
        node
        for node in network.nodes
        if node.history is None and (node.id in ids or changes(node)) and network.original(node.id) == node.id
    ]


def contents(network: Specification, node: Node, values: Callable[[Value], Floats]) -> Floats:
    """Return the parts of a node's mass: what is no substance, then each substance, shape (components, times).

    They sum to 1. ``values`` says what a number is at some times.
    """
    content: dict[str, Any] = dict(node.content)
    parts = np.array([values(content.get(substance.id, 0.0)) for substance in network.substances])
    whole = np.maximum(parts.sum(axis=0), 1.0)  # of sums of decimals, which round
    return np.concatenate([np.maximum(1.0 - parts.sum(axis=0, keepdims=True), 0.0), parts / whole])


def separation_problems(network: Specification) -> Iterator[str]:
    """Yield what is wrong with the shares of substances, of a network whose shares of all else are right."""
    for substance in separated_substances(network):
        of_substance = network_of_substance(network, substance)
        divisions = splits(of_substance)
        faults = [problem for split in divisions for problem in split.problems()] or trap_problems(
            of_substance, divisions
        )
        yield from (f"substance '{substance}': {fault}" for fault in faults)
