"""Layered layout (after Sugiyama) of a flow diagram whose ribbons are as wide as their flows.

Nodes stand in layers, so that most of the mass moves forward; a ribbon that passes layers has a place of its own in
each. A flow that leads back runs in a lane around what lies between: a loop is drawn as a loop. *Across* is the
direction along a layer. All is deterministic: the same flows give the same places.

References: Sugiyama, Tagawa and Toda 1981, Methods for visual understanding of hierarchical system structures.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record

SWEEPS = 24
"""How often the layers are put in order and moved towards what they are connected with."""
NARROW = 4.0
"""Kept free around a ribbon that passes a layer."""
LANE = 8.0
"""Between the lanes of loops."""
MOST_LOOPS = 12
"""Of more loops, those of two nodes run beside each other."""
LEAST_BREADTH = 3.0
"""Least breadth kept free for a ribbon."""


@dataclass(frozen=True, slots=True)
class RibbonRoute:
    """How a ribbon gets from its donor to its recipient.

    ``via`` is where it passes each layer in between, across, from the first layer to the last; it runs ``back`` against
    this order beside one that runs forward. A loop has a ``lane`` instead, across, that lies before (−1) or behind (+1)
    everything that it goes around: its ``side``, which is 0 for all others.
    """

    via: tuple[float, ...] = ()
    lane: float = 0.0
    side: int = 0
    back: bool = False


@positional_record
class LayeredLayout:
    """Where everything of a flow diagram goes; across is measured from the first lane on."""

    layers: Annotated[Integers, "layer of each node, shape (nodes,)"]
    middles: Annotated[Floats, "centre of each node, across, shape (nodes,)"]
    routes: Annotated[tuple[RibbonRoute, ...], "one for each flow"]
    breadth: Annotated[float, "of all, across"]


def layered_layout(
    donors: Integers,
    recipients: Integers,
    widths: Floats,
    breadths: Floats,
    clearance: float,
    layers: Integers | None = None,
) -> LayeredLayout:
    """Place nodes of some ``breadths``, shape (nodes,), between which ribbons of ``widths`` run, shape (arcs,).

    ``clearance`` is kept free around a node. In ``layers`` that are given, shape (nodes,), only what stays in one is a
    loop; what leads back runs back.
    """
    pairs = list(zip(donors.tolist(), recipients.tolist(), strict=True))
    if layers is None:
        weights = widths + 1e-6 * max(1.0, float(widths.max(initial=0.0)))
        order = _forward_order(len(breadths), donors, recipients, weights)
        place = np.argsort(order)
        ahead = place[donors] < place[recipients]
        layers = _layers(order, donors[ahead], recipients[ahead])
        ahead = layers[donors] < layers[recipients]
        too_many = np.count_nonzero(~ahead) > MOST_LOOPS
        back = _runs_beside(pairs, ahead) if too_many else np.zeros(len(pairs), dtype=bool)
    else:
        ahead, back = layers[donors] < layers[recipients], layers[donors] > layers[recipients]
    items = _LayerItems(layers, breadths, clearance)
    links = [
        items.link(*(pair if forward else pair[::-1]), float(width)) if forward or backward else ()
        for pair, width, forward, backward in zip(pairs, widths, ahead, back, strict=True)
    ]
    middles = items.positions()
    routes = [
        RibbonRoute(via=tuple(middles[list(link)].tolist()), back=bool(backward))
        for link, backward in zip(links, back, strict=True)
    ]
    half = np.array(items.sizes) / 2
    loops = np.flatnonzero(~ahead & ~back)
    for arc, route in _lanes(loops, layers[donors], layers[recipients], widths, items, middles):
        routes[arc] = route
    lanes = [(route.lane, LANE + width / 2) for route, width in zip(routes, widths.tolist(), strict=True) if route.side]
    low = min([*(middles - half), *(lane - room for lane, room in lanes)], default=0.0)
    high = max([*(middles + half), *(lane + room for lane, room in lanes)], default=0.0)
    routes = [
        replace(route, via=tuple(place - low for place in route.via), lane=route.lane - low if route.side else 0.0)
        for route in routes
    ]
    return LayeredLayout(layers, middles[: len(breadths)] - low, tuple(routes), float(high - low))


def _runs_beside(pairs: Sequence[tuple[int, int]], ahead: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether each flow leads back between two nodes of which another leads forward, shape (arcs,)."""
    flags = ahead.tolist()
    forward = {pair for pair, flag in zip(pairs, flags, strict=True) if flag}
    return np.array([not flag and pair[::-1] in forward for pair, flag in zip(pairs, flags, strict=True)], dtype=bool)


def _forward_order(count: int, donors: Integers, recipients: Integers, weights: Floats) -> list[int]:
    """Order the nodes so that little mass leads back: what only gives first, what only takes last.

    References: Eades, Lin and Smyth 1993, A fast and effective heuristic for the feedback arc set problem.
    """
    out, into = ([defaultdict[int, float](float) for _ in range(count)] for _ in range(2))
    for donor, recipient, weight in zip(donors.tolist(), recipients.tolist(), weights.tolist(), strict=True):
        if donor != recipient:
            out[donor][recipient] += weight
            into[recipient][donor] += weight
    rest, first, last = set(range(count)), list[int](), list[int]()
    while rest:
        sinks = [node for node in sorted(rest) if not out[node]]
        sources = [node for node in sorted(rest) if not into[node] and out[node]]
        # on a cycle, the node that gives most more than it takes opens it
        surplus = {node: sum(out[node].values()) - sum(into[node].values()) for node in sorted(rest)}
        nodes = sinks or sources or [max(surplus, key=lambda node: surplus[node])]
        for node in nodes:
            rest.discard(node)
            for donor in into[node]:
                out[donor].pop(node, None)
            for recipient in out[node]:
                into[recipient].pop(node, None)
        first, last = (first, [*nodes, *last]) if sinks else ([*first, *nodes], last)
    return first + last


def _layers(order: Sequence[int], donors: Integers, recipients: Integers) -> Integers:
    """Return the layer of each node: one behind the last of its donors, and sources close to whom they give."""
    layers = np.zeros(len(order), dtype=np.intp)
    for node in order:
        layers[node] = (layers[donors[recipients == node]] + 1).max(initial=0)
    for node in reversed(order):
        if node in donors and node not in recipients:
            layers[node] = layers[recipients[donors == node]].min() - 1
    return np.asarray(np.unique(layers, return_inverse=True)[1], dtype=np.intp)


Links = dict[int, list[tuple[int, float]]]
"""What each item is tied to, and how strongly."""


class _LayerItems:
    """Nodes, and what passes a layer without stopping there, as items that share the breadth of their layer."""

    def __init__(self, layers: Integers, breadths: Floats, clearance: float) -> None:
        self.layers: list[int] = layers.tolist()
        self.sizes: list[float] = breadths.tolist()
        self._nodes, self._clearance = len(self.sizes), clearance
        self._before: Links = defaultdict(list)
        self._behind: Links = defaultdict(list)

    def link(self, donor: int, recipient: int, width: float) -> tuple[int, ...]:
        """Connect two nodes through new items (dummy nodes) in the layers between, and return these."""
        between = range(self.layers[donor] + 1, self.layers[recipient])
        items = tuple(range(len(self.sizes), len(self.sizes) + len(between)))
        self.layers += between
        self.sizes += [max(width, LEAST_BREADTH)] * len(between)
        for start, end in pairwise((donor, *items, recipient)):
            self._behind[start].append((end, width + 0.1))
            self._before[end].append((start, width + 0.1))
        return items

    def positions(self) -> Floats:
        """Return the middle of each item: close to what it is connected with, and clear of its neighbours."""
        members: list[list[int]] = [[] for _ in range(max(self.layers, default=-1) + 1)]
        for item, place in enumerate(self.layers):
            members[place].append(item)
        room = max((sum(map(self._room, layer)) for layer in members), default=0.0)
        at = [0.0] * len(self.sizes)
        # sweeps forward and back put the layers in order; then both sides pull at once
        for sweep in range(SWEEPS):
            for links, layers in ((self._before, members), (self._behind, members[::-1])):
                for layer in layers:
                    self._pull(layer, at, [links], 0.99**sweep, room)
        for _ in range(SWEEPS):
            for layer in members:
                self._pull(layer, at, [self._before, self._behind], 0.5, room)
        return np.array(at)

    def _room(self, item: int) -> float:
        """Return the breadth of an item with what is kept free around it."""
        return self.sizes[item] + (self._clearance if item < self._nodes else NARROW)

    def _pull(self, layer: list[int], at: list[float], sides: Sequence[Links], strength: float, room: float) -> None:
        """Move the items of a layer towards what they are tied to, and apart."""
        for item in layer:
            ties = [tie for side in sides for tie in side.get(item, ())]
            if ties:
                goal = sum(at[end] * weight for end, weight in ties) / sum(weight for _, weight in ties)
                at[item] += (goal - at[item]) * strength
        self._spread(layer, at, room)

    def _spread(self, layer: list[int], at: list[float], room: float) -> None:
        """Move items apart, as little as their order allows, within the room that the fullest layer takes.

        Those that touch share a block around the mean of where they were.
        """
        layer.sort(key=lambda item: at[item])
        blocks: list[tuple[float, float, int]] = []  # begin, length, items
        for item in layer:
            blocks.append((at[item] - self._room(item) / 2, self._room(item), 1))
            while len(blocks) > 1 and sum(blocks[-2][:2]) > blocks[-1][0]:
                (start, length, count), (begin, size, more) = blocks[-2:]
                middle = (count * (start + length / 2) + more * (begin + size / 2)) / (count + more)
                blocks[-2:] = [(middle - (length + size) / 2, length + size, count + more)]
        rest, least = sum(length for _, length, _ in blocks), -room / 2
        items = iter(layer)
        for begin, length, count in blocks:
            begin = max(least, min(begin, room / 2 - rest))
            least, rest = begin + length, rest - length
            for _ in range(count):
                item = next(items)
                at[item] = begin + self._room(item) / 2
                begin += self._room(item)

    def span(self, layers: range, middles: Floats) -> tuple[float, float]:
        """Return where the items of some layers begin and end."""
        within = np.array([layer in layers for layer in self.layers])
        half = np.array(self.sizes)[within] / 2
        return float((middles[within] - half).min()), float((middles[within] + half).max())


def _lanes(
    loops: Integers, starts: Integers, ends: Integers, widths: Floats, items: _LayerItems, middles: Floats
) -> list[tuple[int, RibbonRoute]]:
    """Give every loop a lane, short ones inside: on the side to which both its ends are closer."""
    routes: list[tuple[int, RibbonRoute]] = []
    lanes: dict[int, list[tuple[range, float]]] = {-1: [], 1: []}
    for arc in sorted(loops.tolist(), key=lambda k: (int(starts[k] - ends[k]), k)):
        layers = range(int(ends[arc]), int(starts[arc]) + 1)
        width, (low, high) = max(float(widths[arc]), LEAST_BREADTH), items.span(layers, middles)
        edges = {-1: low, 1: high}
        for side, neighbours in lanes.items():
            # how far lanes that go around the same layers already reach
            reach = [side * edge for span, edge in neighbours if span[0] <= layers[-1] and layers[0] <= span[-1]]
            edges[side] = side * max([side * edges[side], *reach])
        lengths = {side: abs(edge - (low + high) / 2) for side, edge in edges.items()}
        side = min((1, -1), key=lambda side: lengths[side])
        lane = edges[side] + side * (LANE + width / 2)
        lanes[side].append((layers, lane + side * width / 2))
        routes.append((arc, RibbonRoute(lane=lane, side=side)))
    return routes
