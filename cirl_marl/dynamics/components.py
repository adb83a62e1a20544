"""Networks in which what is no substance and each substance move as materials of their own.

A network with n substances has 1 + n *components*, each with a copy of its nodes and arcs: first what is no substance,
in the places of the network itself, then the substances in their order. All copies have the same laws, so that what is
proportional to a stock moves each component in the same proportion; arcs that separate substances have shares of
their own. What couples copies are scheduled flows, which are of the whole: ``ScheduledFlows`` shares them out by the
content of their donor. The whole is the sum of its components, and no component is ever negative.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from types import MappingProxyType

from cirl_marl.dynamics.stages import StagedNetwork, staged_network
from cirl_marl.network import Network
from cirl_marl.network.elements import Arc
from cirl_marl.network.substances import arc_of_substance


@dataclass(frozen=True, kw_only=True)
class ComponentNetwork(StagedNetwork):
    """A network, with lifetimes as stages, that moves its components one beside the other.

    Attributes:
        originals: by node and arc that is a copy for a substance the one that it is a copy of.
    """

    originals: Mapping[str, str] = field(default_factory=dict)

    @cached_property
    def controllable(self) -> tuple[str, ...]:
        """Compartments that have a control; that of a copy is the one of its original."""
        return tuple(id_ for id_ in super().controllable if id_ not in self.originals)

    @cached_property
    def control_rows(self) -> Mapping[str, slice]:
        """Rows of each compartment in control arrays, copies included."""
        rows = dict(super().control_rows)
        copies = {id_: rows[original] for id_, original in self.originals.items() if original in rows}
        return MappingProxyType(rows | copies)

    def original(self, id_: str) -> str:
        """Return the compartment that one is a copy of, or itself."""
        return self.originals.get(id_, id_)

    def components_of(self, id_: str) -> tuple[str, ...]:
        """Return a compartment and its copies."""
        return (id_, *(copy_id(id_, substance.id) for substance in self.substances))


def copy_id(id_: str, substance: str) -> str:
    """Return what the copy of a node or an arc for a substance is called, as no part of a lifetime is."""
    return f"{id_}:{substance}"


def component_network(network: StagedNetwork) -> StagedNetwork:
    """Return a network with a copy for each of its substances; without substances it is as it is."""
    if not network.substances:
        return network
    stores, stockless = ([node for node in network.nodes if node.stores is stores] for stores in (True, False))
    arcs: list[Arc] = list(network.arcs)
    all_stores, all_stockless = list(stores), list(stockless)
    originals: dict[str, str] = {}
    maps: dict[str, dict[str, object]] = {
        "stages": dict(network.stages),
        "valves": dict(network.valves),
        "release_arcs": dict(network.release_arcs),
        "parts": dict(network.parts),
    }
    for substance in (substance.id for substance in network.substances):
        name = partial(copy_id, substance=substance)
        for nodes, copies in ((stores, all_stores), (stockless, all_stockless)):
            copies += [replace(node, id=name(node.id)) for node in nodes]
        arcs += [_arc_copy(arc, substance, name) for arc in network.arcs]
        compartments = [c.id for c in (*network.nodes, *network.arcs)]
        originals |= {name(id_): id_ for id_ in compartments}
        maps["stages"] |= {name(node): tuple(map(name, parts)) for node, parts in network.stages.items()}
        maps["valves"] |= {name(store): node for store, node in network.valves.items()}
        maps["release_arcs"] |= {name(node): name(arc) for node, arc in network.release_arcs.items()}
        maps["parts"] |= {name(node.id): network.parts.get(node.id, node.id) for node in network.nodes}
    values = {item.name: getattr(network, item.name) for item in fields(network)}
    values |= {"nodes": (*all_stores, *all_stockless), "arcs": tuple(arcs), **maps}
    return ComponentNetwork(**values, originals=originals)


def simulated_network(network: Network) -> Network:
    """Return the network whose motion the simulator follows: with lifetimes and components as nodes of their own.

    One that is written in stages already is as it is.
    """
    if isinstance(network, StagedNetwork):
        return network
    if network.substances or any(node.lifetime is not None for node in network.stores):
        return component_network(staged_network(network))
    return network


def _arc_copy(arc: Arc, substance: str, name: Callable[[str], str]) -> Arc:
    arc = arc_of_substance(arc, substance)
    return replace(arc, id=name(arc.id), donor=name(arc.donor), recipient=name(arc.recipient))
