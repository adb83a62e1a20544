"""Networks of the catalogue as they would be without something."""

from __future__ import annotations

from dataclasses import replace

from cirl_marl.network import Network
from cirl_marl.network.elements import ControlKind


def without_substances(network: Network) -> Network:
    """Return the network with nothing said of what is in it; who acts on that alone acts no more."""
    arcs = []
    for arc in network.arcs:
        sets_transfer = arc.control is not None and arc.control.kind is ControlKind.TRANSFER
        arcs.append(replace(arc, transfer=(), control=None if sets_transfer else arc.control))
    nodes = tuple(replace(node, content=()) for node in network.nodes)
    services = tuple(service for service in network.services if not service.substance)
    acting = {part.id for part in (*nodes, *arcs) if part.control is not None}
    agents = tuple(agent for agent in network.default_agents if agent in acting)
    return replace(
        network,
        nodes=nodes,
        arcs=tuple(arcs),
        services=services,
        default_agents=agents,
        substances=(),
        scenarios={},
    )
