"""Networks in which lifetimes are written as chains of stores, and fixed ones as lines of slots.

A node with a lifetime becomes ::

    arcs in → entry → stages, each with donor flow μ to the next → release → arcs out, by their shares

entry and release store nothing. A fixed lifetime of D control intervals becomes D slots instead, which move on at the
start of each interval; what then comes out flows evenly through the interval. Stores and arcs of the network come
first, in their order; the row of the node itself is that of its last stage, or of what comes out.
"""

from __future__ import annotations

from collections.abc import Container, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Arc, Law, Node, Role, Service
from cirl_marl.network.initial_ages import slots
from cirl_marl.network.rowsum import Integers
from cirl_marl.network.series import Value, in_intervals


@dataclass(frozen=True, kw_only=True)
class StagedNetwork(Network):
    """A network without lifetimes that moves as one with lifetimes does.

    Attributes:
        stages: by node with a lifetime its stores here, first the one that what enters takes longest to leave; a single
            one where the lifetime is not written out.
        valves: by store the node whose control of kind ``stretch`` acts on what leaves it.
        release_arcs: by node with a lifetime the arc through which what has lived goes to the node that shares it out.
        parts: by node that only is here the one that it is a part of.
    """

    stages: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    valves: Mapping[str, str] = field(default_factory=dict)
    release_arcs: Mapping[str, str] = field(default_factory=dict)
    parts: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Take it as it is: the network that it stands for was checked."""

    def node_index_of(self, nodes: Sequence[str]) -> Integers:
        """Return the positions of nodes."""
        return np.array([self.node_index[node] for node in nodes], dtype=np.intp)

    @cached_property
    def sustainability(self) -> Floats:
        """σ_k of each arc; what moves within a node does not count."""
        return super().sustainability * ~self._within

    @cached_property
    def environmental(self) -> NDArray[np.bool_]:
        """Arcs that touch the environment and do not lie within a node of it."""
        return super().environmental & ~self._within

    def service_arcs(self, service: Service) -> Integers:
        """Return the arcs whose flows add up to what a service measures; an outflow is what leaves the whole node."""
        if service.quantity != "outflow":
            return super().service_arcs(service)
        leaves = [self.parts.get(arc.donor, arc.donor) in service.providers for arc in self.arcs]
        return np.flatnonzero(np.array(leaves, dtype=bool) & ~self._within)

    @property
    def _within(self) -> NDArray[np.bool_]:
        ends = [
            (self.parts.get(arc.donor, arc.donor), self.parts.get(arc.recipient, arc.recipient)) for arc in self.arcs
        ]
        return np.array([donor == recipient for donor, recipient in ends], dtype=bool)

    def _role(self, node: str) -> Role:
        return super()._role(self.parts.get(node, node))

    @property
    def lines(self) -> Mapping[str, str]:
        """The part of ``release_arcs`` that comes out of slots."""
        arcs = {arc.id: arc for arc in self.arcs}
        with_stages = {node: arc for node, arc in self.release_arcs.items() if len(self.stages[node]) > 1}
        return {node: arc for node, arc in with_stages.items() if arcs[arc].law is Law.EXOGENOUS}


def staged_network(network: Network, whole: Container[str] = (), *, plain: Container[str] = ()) -> StagedNetwork:
    """Return ``network`` with its lifetimes as chains and lines.

    Of nodes that stay ``whole`` the release arc alone is written, with the rate of the stages, or 1 for a line:
    what it carries does not follow from the stock. Those of a single stage may be ``plain``: stocks with that rate.
    """
    with_lifetime = [node for node in network.stores if node.lifetime is not None]
    parts = _Parts(network)
    for node in with_lifetime:
        assert node.lifetime is not None
        if node.id in plain:
            parts.stock(node)
        elif node.id in whole:
            parts.whole(node)
        elif node.lifetime.chain is None:
            parts.line(node)
        else:
            parts.chain(node)
    arcs = [
        replace(
            arc, donor=parts.leaves.get(arc.donor, arc.donor), recipient=parts.enters.get(arc.recipient, arc.recipient)
        )
        for arc in network.arcs
    ]
    last = {
        n.id: Node(id=n.id, role=n.role, scale=n.scale, control=n.control, rate=parts.rates.get(n.id, 0.0))
        for n in with_lifetime
    }
    stores = [last.get(node.id, node) for node in network.stores]
    stockless = [Node(id=item, stores=False) for item in (*parts.enters.values(), *parts.leaves.values())]
    fields_ = {item: getattr(network, item) for item in network.__dataclass_fields__}
    fields_ |= {"nodes": (*stores, *parts.stores, *network.nodes[len(stores) :], *stockless), "scenarios": {}}
    fields_["arcs"] = (*arcs, *parts.arcs)
    return StagedNetwork(
        **fields_, stages=parts.stages, valves=parts.valves, release_arcs=parts.release_arcs, parts=parts.of
    )


class _Parts:
    """What lifetimes are made of."""

    def __init__(self, network: Network) -> None:
        self.network = network
        self.arcs: list[Arc] = []
        self.stores: list[Node] = []
        self.enters: dict[str, str] = {}
        self.leaves: dict[str, str] = {}
        self.stages: dict[str, tuple[str, ...]] = {}
        self.valves: dict[str, str] = {}
        self.release_arcs: dict[str, str] = {}
        self.of: dict[str, str] = {}
        self.rates: dict[str, Value] = {}

    def stock(self, node: Node) -> None:
        """Let a lifetime of a single stage be a stock that leaves in proportion to itself."""
        self.stages[node.id], self.valves[node.id] = (node.id,), node.id
        self.rates[node.id] = self._rate(node)

    def chain(self, node: Node) -> None:
        """Add the stages of a lifetime that is spread."""
        assert node.lifetime is not None and node.lifetime.chain is not None
        chain, entry, release = node.lifetime.chain, self._entry(node), self._release(node)
        names = self._stores(node, chain.stages - 1)
        for name, successor in zip(names, (*names[1:], release), strict=True):
            self.valves[name] = node.id
            self.arcs.append(Arc(id=f"{name}.leaving", donor=name, recipient=successor, rate=self._rate(node)))
        for end, part in zip((*names, release), (*chain.inflow_shares, chain.weights[0]), strict=True):
            if part > 0:
                self.arcs.append(self._share_arc(entry, end, float(part)))

    def line(self, node: Node) -> None:
        """Add the slots of a fixed lifetime, and the arc through which it comes out."""
        assert node.lifetime is not None
        entry = self._entry(node)
        names = self._stores(node, slots(node.lifetime, self.network.episode.control_interval))
        self.arcs.append(self._share_arc(entry, names[0], 1.0))
        self._out(node, Law.EXOGENOUS)

    def whole(self, node: Node) -> None:
        """Add the arc through which a lifetime comes out."""
        assert node.lifetime is not None
        self.stages[node.id] = (node.id,)
        self._out(node, Law.EXOGENOUS if node.lifetime.chain is None else Law.DONOR)

    def _entry(self, node: Node) -> str:
        self.enters[node.id] = f"{node.id}.entry"
        self.of[self.enters[node.id]] = node.id
        return self.enters[node.id]

    def _release(self, node: Node) -> str:
        self.leaves[node.id], self.release_arcs[node.id] = f"{node.id}.release", f"{node.id}.leaving"
        self.of[self.leaves[node.id]] = node.id
        return self.leaves[node.id]

    def _out(self, node: Node, law: Law) -> None:
        release, by_stock = self._release(node), law is Law.DONOR
        rate, flow = (self._rate(node), 0.0) if by_stock else (0.0, 1.0)
        arc = Arc(id=self.release_arcs[node.id], donor=node.id, recipient=release, law=law, rate=rate, flow=flow)
        self.arcs.append(arc)

    def _stores(self, node: Node, further: int) -> tuple[str, ...]:
        """Add stores before that of the node, and return all of them, first the one that is longest to live."""
        names = tuple(f"{node.id}.stage_{i + 1}" for i in range(further))
        self.stores += [Node(id=name, role=node.role, scale=node.scale) for name in names]
        self.of |= dict.fromkeys(names, node.id)
        self.stages[node.id] = (*names, node.id)
        return self.stages[node.id]

    def _share_arc(self, entry: str, end: str, part: float) -> Arc:
        return Arc(id=f"{entry}.to.{end}", donor=entry, recipient=end, law=Law.SHARE, share=part)

    def _rate(self, node: Node) -> Value:
        """Return the rate of a node's stages, divided by the stretch of each interval."""
        assert node.lifetime is not None and node.lifetime.chain is not None
        rate = node.lifetime.chain.rate / node.lifetime.mean
        return in_intervals(rate / self.network.interval_means(node.stretch), self.network.episode.control_interval)


class FixedLifetimes:
    """The slots of fixed lifetimes, which move on at the start of each interval.

    Attributes:
        arcs: through which what has lived comes out.
    """

    def __init__(self, network: StagedNetwork) -> None:
        """Compile the lines of ``network``."""
        self._interval = network.episode.control_interval
        places = [network.node_index_of(network.stages[node]) for node in network.lines]
        self._from = np.concatenate([rows[:-1] for rows in places])
        self._to = np.concatenate([rows[1:] for rows in places])
        self._young = np.array([rows[0] for rows in places], dtype=np.intp)
        self._old = np.array([rows[-1] for rows in places], dtype=np.intp)
        self.arcs: Integers = np.array([network.arc_index[arc] for arc in network.lines.values()], dtype=np.intp)

    def shift_slots(self, stock: Floats) -> Floats:
        """Return the masses, shape (rows, B), with those of each slot in the next one, and an empty first slot."""
        after = stock.copy()
        # what rounding left of what came out comes out now
        rest = stock[self._old]
        after[self._to] = stock[self._from]
        after[self._old] += rest
        after[self._young] = 0.0
        return after

    def set_outflows(self, stock: Floats, rate: Floats) -> None:
        """Set the flows of what comes out in the interval, in place; ``rate`` has shape (arcs, B)."""
        rate[self.arcs] = stock[self._old] / self._interval

    def pull_back(self, stock_adjoint: Floats, rate_adjoint: Floats) -> Floats:
        """Return the adjoint of the masses before ``shift_slots``, of those after it and of what comes out, in place.

        Rates of what comes out follow from the slots alone, so that their adjoint is used up.
        """
        stock_adjoint[self._old] += rate_adjoint[self.arcs] / self._interval
        rate_adjoint[self.arcs] = 0.0
        before = stock_adjoint.copy()
        before[self._from] = stock_adjoint[self._to]
        return before
