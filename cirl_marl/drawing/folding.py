"""Networks of copies with the copies folded, so that a picture or a table of them can be read."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace

import numpy as np

from cirl_marl.drawing.style import readable
from cirl_marl.errors import check_names
from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Arc, Law, Node, Role

MARKETS = "between"
"""What joins the copies and stores nothing, as one box."""


@dataclass(frozen=True, kw_only=True)
class FoldedNetwork(Network):
    """A network in which boxes stand for parts of another one; it is looked at and does not move."""

    def __post_init__(self) -> None:
        """Take it as it is: the network that it stands for was checked."""
        object.__setattr__(self, "nodes", tuple(sorted(self.nodes, key=lambda node: not node.stores)))


def fold_copies(
    network: Network, stock: Floats, flow: Floats, open_copies: Collection[str] = ()
) -> tuple[Network, Floats, Floats]:
    """Return a network with its stocks and flows in which each copy is one box; one without copies is left as it is.

    Reservoirs and sinks of the folded copies are one box for each role, and so is all that joins the copies and stores
    nothing. Flows between two boxes are one arrow; those within a box, and those of nothing, are left out.

    Args:
        network: the network.
        stock: stocks, shape (stores,), mass; or (stores, n), of all and of substances.
        flow: flows, shape (arcs,), mass/time, likewise.
        open_copies: copies that are shown as they are.

    Raises:
        CirlError: if there is no copy of that name.
    """
    check_names("copy to unfold", open_copies, network.copies, f"network '{network.name}': ")
    if not network.copies:
        return network, stock, flow
    regions = {node: region for region, nodes in network.copies.items() for node in nodes if region not in open_copies}
    box_of = {node.id: _box(node, regions.get(node.id), network) for node in network.nodes}
    boxes = {box.id: box for box in box_of.values()}
    box_stocks = {id_: np.zeros(stock.shape[1:]) for id_ in boxes}
    scales = dict.fromkeys(boxes, 0.0)
    for node, amount in zip(network.stores, stock, strict=True):
        box_stocks[box_of[node.id].id] += amount
        scales[box_of[node.id].id] += node.scale  # reference stocks add up as stocks do
    nodes = tuple(replace(box, scale=scales[box.id] or box.scale) for box in boxes.values())
    flows: dict[tuple[str, str], Floats] = {}
    visible: list[tuple[Arc, Floats]] = []
    for arc, value in zip(network.arcs, flow, strict=True):
        ends = box_of[arc.donor].id, box_of[arc.recipient].id
        if ends == (arc.donor, arc.recipient):
            visible.append((arc, value))
        elif ends[0] != ends[1] and np.any(value != 0):
            flows[ends] = flows.get(ends, np.zeros(flow.shape[1:])) + value
    arcs = [Arc(id=f"{a}_to_{b}", donor=a, recipient=b, law=Law.SHARE) for a, b in flows]
    fields = {name: getattr(network, name) for name in network.__dataclass_fields__}
    fields |= {"nodes": nodes, "arcs": (*(arc for arc, _ in visible), *arcs), "services": (), "copies": {}}
    folded_network = FoldedNetwork(**fields)
    stocks = np.array([box_stocks[node.id] for node in folded_network.stores]).reshape(-1, *stock.shape[1:])
    values = np.array([*(value for _, value in visible), *flows.values()])
    return folded_network, stocks, values.reshape(-1, *flow.shape[1:])


def _box(node: Node, region: str | None, network: Network) -> Node:
    """Return the box that stands for a node of a folded region, or of none; itself if that is shown."""
    if region is None:
        in_copy = any(node.id in nodes for nodes in network.copies.values())
        return node if in_copy or node.stores else Node(id=MARKETS, title="Markets", stores=False)
    if node.role is Role.TECHNOSPHERE:
        return Node(id=region, title=readable(region).title())
    name = {Role.NONRENEWABLE_RESERVOIR: "Reservoirs", Role.LANDFILL: "Landfills"}.get(node.role, readable(node.role))
    return Node(id=f"all_{node.role.value}", title=name, role=node.role)
