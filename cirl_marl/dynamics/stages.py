"""Networks in which lifetimes are written as chains of stores, and fixed ones as lines of slots.

A node with a lifetime becomes ::

    arcs in → entry → stages, each with donor flow μ to the next → release → arcs out, by their shares

entry and release store nothing. A fixed lifetime of D control intervals becomes D slots instead, which move on at the
start of each interval; what then comes out flows evenly through the interval. Stores and arcs of the network come
first, in their order; the row of the node itself is that of its last stage, or of what comes out.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cirl_marl.network import Floats, Network
from cirl_marl.network.ages import slots
from cirl_marl.network.elements import Arc, Law, Node
from cirl_marl.network.rowsum import Integers
from cirl_marl.network.series import Series, Value


@dataclass(frozen=True, kw_only=True)
class StagedNetwork(Network):
    """A network without lifetimes that moves as one with lifetimes does.

    Attributes:
        stages: by node with a lifetime its stores here, first the one that what enters takes longest to leave.
        valves: by store the node whose control of kind ``stretch`` acts on what leaves it.
        lines: arcs through which fixed lifetimes come out, by the node.
    """

    stages: Mapping[str, tuple[str, ...]] = field(default_factory=dict)
    valves: Mapping[str, str] = field(default_factory=dict)
    lines: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Take it as it is: the network that it stands for was checked."""

    def node_index_of(self, nodes: Sequence[str]) -> Integers:
        """Return the positions of nodes."""
        return np.array([self.node_index[node] for node in nodes], dtype=np.intp)


def staged(network: Network) -> StagedNetwork:
    """Return ``network`` with its lifetimes as chains and lines."""
    living = [node for node in network.stores if node.lifetime is not None]
    stores, passing = list(network.stores), list(network.nodes[len(network.stores) :])
    ends, arcs = {node.id: (f"{node.id}.entry", f"{node.id}.release") for node in living}, []
    for arc in network.arcs:
        donor, recipient = ends.get(arc.donor, ("", arc.donor))[1], ends.get(arc.recipient, (arc.recipient,))[0]
        arcs.append(replace(arc, donor=donor, recipient=recipient))
    parts = _Parts(network, arcs)
    for node in living:
        entry, release = ends[node.id]
        stores[stores.index(node)] = Node(id=node.id, role=node.role, scale=node.scale, control=node.control)
        (parts.line if node.lifetime is not None and node.lifetime.chain is None else parts.chain)(node, entry, release)
        passing += [Node(id=each, stores=False) for each in ends[node.id]]
    kept = {each: getattr(network, each) for each in network.__dataclass_fields__}
    nodes = (*stores, *parts.stores, *passing)
    changed = {"nodes": nodes, "arcs": tuple(parts.arcs), "scenarios": {}}
    return StagedNetwork(**kept | changed, stages=parts.stages, valves=parts.valves, lines=parts.lines)


class _Parts:
    """What lifetimes are made of."""

    def __init__(self, network: Network, arcs: list[Arc]) -> None:
        self.network, self.arcs = network, arcs
        self.stores: list[Node] = []
        self.stages: dict[str, tuple[str, ...]] = {}
        self.valves: dict[str, str] = {}
        self.lines: dict[str, str] = {}

    def chain(self, node: Node, entry: str, release: str) -> None:
        """Add the stages of a lifetime that is spread."""
        assert node.lifetime is not None and node.lifetime.chain is not None
        chain = node.lifetime.chain
        names = self._stores(node, chain.stages - 1)
        rate = self._over(chain.rate / node.lifetime.mean, node.stretch)
        for name, following in zip(names, (*names[1:], release), strict=True):
            self.valves[name] = node.id
            self.arcs.append(Arc(id=f"{name}.leaving", donor=name, recipient=following, rate=rate))
        for end, part in zip((*names, release), (*chain.entering, chain.weights[0]), strict=True):
            if part > 0:
                self.arcs.append(self._shared(entry, end, float(part)))

    def line(self, node: Node, entry: str, release: str) -> None:
        """Add the slots of a fixed lifetime, and the arc through which it comes out."""
        assert node.lifetime is not None
        names = self._stores(node, slots(node.lifetime, self.network.episode.control_interval))
        self.arcs.append(self._shared(entry, names[0], 1.0))
        self.lines[node.id] = f"{node.id}.leaving"
        self.arcs.append(Arc(id=self.lines[node.id], donor=node.id, recipient=release, law=Law.EXOGENOUS))

    def _stores(self, node: Node, further: int) -> tuple[str, ...]:
        """Add stores before that of the node, and return all of them, first the one that is longest to live."""
        names = tuple(f"{node.id}.stage_{i + 1}" for i in range(further))
        self.stores += [Node(id=name, role=node.role, scale=node.scale) for name in names]
        self.stages[node.id] = (*names, node.id)
        return self.stages[node.id]

    def _shared(self, entry: str, end: str, part: float) -> Arc:
        return Arc(id=f"{entry}.to.{end}", donor=entry, recipient=end, law=Law.SHARE, share=part)

    def _over(self, rate: float, stretch: Value) -> Value:
        """Return a rate, divided by the stretch of each interval."""
        if not isinstance(stretch, Series):
            return rate / stretch
        interval, held = self.network.episode.control_interval, self.network.held(stretch)
        return Series(times=tuple(interval * np.arange(len(held))), values=tuple(rate / held))


class FixedLifetimes:
    """The slots of fixed lifetimes, which move on at the start of each interval."""

    def __init__(self, network: StagedNetwork) -> None:
        """Compile the lines of ``network``."""
        self._interval = network.episode.control_interval
        places = [network.node_index_of(network.stages[node]) for node in network.lines]
        self._from = np.concatenate([rows[:-1] for rows in places])
        self._to = np.concatenate([rows[1:] for rows in places])
        self._young = np.array([rows[0] for rows in places], dtype=np.intp)
        self._old = np.array([rows[-1] for rows in places], dtype=np.intp)
        self._arcs = np.array([network.arc_index[arc] for arc in network.lines.values()], dtype=np.intp)

    def moved_on(self, stock: Floats) -> Floats:
        """Return the masses, shape (rows, B), with those of each slot in the next one, and an empty first slot."""
        after = stock.copy()
        # what rounding left of what came out comes out now
        left = stock[self._old]
        after[self._to] = stock[self._from]
        after[self._old] += left
        after[self._young] = 0.0
        return after

    def come_out(self, stock: Floats, rate: Floats) -> None:
        """Set the flows of what comes out in the interval, in place; ``rate`` has shape (arcs, B)."""
        rate[self._arcs] = stock[self._old] / self._interval
