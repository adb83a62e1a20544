"""Places for a flow diagram whose ribbons are as wide as their flows: layers, what passes between them, and loops.

Compartments stand in layers, so that most of the mass moves forward. A flow that leads back runs in a lane of its own
around what lies between: a loop is drawn as a loop. All is deterministic: the same flows give the same places.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from cirl_marl.network import Floats, Integers

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


@dataclass(frozen=True, slots=True)
class LayeredLayout:
    """Where everything of a flow diagram goes; across is measured from the first lane on.

    Attributes:
        layers: layer of each node, shape (nodes,).
        middles: centre of each node, across, shape (nodes,).
        courses: one for each flow.
        breadth: of all, across.
    """

    layers: Integers
    middles: Floats
    routes: tuple[RibbonRoute, ...]
    breadth: float


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
        order = _forward(len(breadths), donors, recipients, weights)
        place = np.empty(len(breadths), dtype=np.intp)
        place[order] = np.arange(len(order))
        ahead = place[donors] < place[recipients]
        layers = _layers(order, donors[ahead], recipients[ahead])
        ahead = layers[donors] < layers[recipients]
        crowded = np.count_nonzero(~ahead) > MOST_LOOPS
        back = _beside_others(pairs, ahead) if crowded else np.zeros(len(pairs), dtype=bool)
    else:
        ahead, back = layers[donors] < layers[recipients], layers[donors] > layers[recipients]
    threads = _LayerItems(layers, breadths, clearance)
    links = [
        threads.link(*(pair if forward else pair[::-1]), float(width)) if forward or backward else ()
        for pair, width, forward, backward in zip(pairs, widths, ahead, back, strict=True)
    ]
    middles = threads.positions()
    courses = [
        RibbonRoute(via=tuple(float(middles[item]) for item in link), back=bool(backward))
        for link, backward in zip(links, back, strict=True)
    ]
    half = np.array(threads.sizes) / 2
    for arc, course in _lanes(
        np.flatnonzero(~ahead & ~back), layers[donors], layers[recipients], widths, threads, middles
    ):
        courses[arc] = course
    edges = [(each.lane, LANE + width / 2) for each, width in zip(courses, widths.tolist(), strict=True) if each.side]
    low = min([*(middles - half), *(lane - beside for lane, beside in edges)], default=0.0)
    high = max([*(middles + half), *(lane + beside for lane, beside in edges)], default=0.0)
    shifted = [
        replace(each, via=tuple(at - low for at in each.via), lane=each.lane - low if each.side else 0.0)
        for each in courses
    ]
    return LayeredLayout(layers, middles[: len(breadths)] - low, tuple(shifted), float(high - low))


def _beside_others(pairs: Sequence[tuple[int, int]], ahead: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether each flow leads back between two nodes of which another leads forward, shape (arcs,)."""
    forward = {pair for pair, each in zip(pairs, ahead, strict=True) if each}
    return np.array([not each and pair[::-1] in forward for pair, each in zip(pairs, ahead, strict=True)], dtype=bool)


def _forward(count: int, donors: Integers, recipients: Integers, weights: Floats) -> list[int]:
    """Order the nodes so that little mass leads back: what only gives first, what only takes last.

    References: Eades, Lin and Smyth 1993, A fast and effective heuristic for the feedback arc set problem.
    """
    out, into = ([defaultdict[int, float](float) for _ in range(count)] for _ in range(2))
    for donor, recipient, weight in zip(donors.tolist(), recipients.tolist(), weights.tolist(), strict=True):
        if donor != recipient:
            out[donor][recipient] += weight
            into[recipient][donor] += weight
    left, first, last = set(range(count)), list[int](), list[int]()
    while left:
        ends = [node for node in sorted(left) if not out[node]]
        sources = [node for node in sorted(left) if not into[node] and out[node]]
        chosen = (
            ends or sources or [max(sorted(left), key=lambda node: sum(out[node].values()) - sum(into[node].values()))]
        )
        for node in chosen:
            left.discard(node)
            for other in into[node]:
                out[other].pop(node, None)
            for other in out[node]:
                into[other].pop(node, None)
        if ends:
            last = [*chosen, *last]
        else:
            first += chosen
    return first + last


def _layers(order: Sequence[int], donors: Integers, recipients: Integers) -> Integers:
    """Return the layer of each node: one behind the last of its donors, and sources close to whom they give."""
    layers = np.zeros(len(order), dtype=np.intp)
    out, into = defaultdict[int, list[int]](list), defaultdict[int, list[int]](list)
    for donor, recipient in zip(donors.tolist(), recipients.tolist(), strict=True):
        out[donor].append(recipient)
        into[recipient].append(donor)
    for node in order:
        layers[node] = max((int(layers[donor]) + 1 for donor in into[node]), default=0)
    for node in reversed(order):
        if not into[node] and out[node]:
            layers[node] = min(int(layers[recipient]) for recipient in out[node]) - 1
    used = {int(layer): i for i, layer in enumerate(sorted(set(layers.tolist())))}
    return np.array([used[int(layer)] for layer in layers], dtype=np.intp)


class _LayerItems:
    """Nodes, and what passes a layer without stopping there, as items that share the breadth of their layer."""

    def __init__(self, layers: Integers, breadths: Floats, clearance: float) -> None:
        self.layers: list[int] = layers.tolist()
        self.sizes: list[float] = breadths.tolist()
        self._nodes, self._clearance = len(self.sizes), clearance
        self._links: list[tuple[int, int, float]] = []

    def link(self, donor: int, recipient: int, width: float) -> tuple[int, ...]:
        """Connect two nodes through new items in the layers between, and return these."""
        passed = range(self.layers[donor] + 1, self.layers[recipient])
        items = tuple(range(len(self.sizes), len(self.sizes) + len(passed)))
        self.layers += passed
        self.sizes += [max(width, LEAST_BREADTH)] * len(passed)
        self._links += [(one, two, width + 0.1) for one, two in pairwise((donor, *items, recipient))]
        return items

    def positions(self) -> Floats:
        """Return the middle of each item: close to what it is connected with, and clear of its neighbours."""
        members: list[list[int]] = [[] for _ in range(max(self.layers, default=-1) + 1)]
        for item, place in enumerate(self.layers):
            members[place].append(item)
        before: dict[int, list[tuple[int, float]]] = defaultdict(list)
        behind: dict[int, list[tuple[int, float]]] = defaultdict(list)
        for one, two, weight in self._links:
            behind[one].append((two, weight))
            before[two].append((one, weight))
        room = max((sum(map(self._room, layer)) for layer in members), default=0.0)
        at = [0.0] * len(self.sizes)
        for sweep in range(SWEEPS):
            for sides, layers in (((before,), members), ((behind,), members[::-1])):
                for layer in layers:
                    self._pull(layer, at, sides, 0.99**sweep, room)
        for _ in range(SWEEPS):
            for layer in members:
                self._pull(layer, at, (before, behind), 0.5, room)
        return np.array(at)

    def _room(self, item: int) -> float:
        """Return the breadth of an item with what is kept free around it."""
        return self.sizes[item] + (self._clearance if item < self._nodes else NARROW)

    def _pull(
        self,
        layer: list[int],
        at: list[float],
        sides: Sequence[dict[int, list[tuple[int, float]]]],
        strength: float,
        room: float,
    ) -> None:
        """Move the items of a layer towards what they are tied to, and apart."""
        for item in layer:
            tied = [each for side in sides for each in side.get(item, ())]
            if tied:
                goal = sum(at[other] * weight for other, weight in tied) / sum(weight for _, weight in tied)
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
        left, least = sum(length for _, length, _ in blocks), -room / 2
        items = iter(layer)
        for begin, length, count in blocks:
            begin = max(least, min(begin, room / 2 - left))
            least, left = begin + length, left - length
            for _ in range(count):
                item = next(items)
                at[item] = begin + self._room(item) / 2
                begin += self._room(item)

    def span(self, layers: range, middles: Floats) -> tuple[float, float]:
        """Return where the items of some layers begin and end."""
        within = [i for i, layer in enumerate(self.layers) if layer in layers]
        return (
            min(float(middles[i]) - self.sizes[i] / 2 for i in within),
            max(float(middles[i]) + self.sizes[i] / 2 for i in within),
        )


def _lanes(
    arcs: Integers, starts: Integers, ends: Integers, widths: Floats, threads: _LayerItems, middles: Floats
) -> list[tuple[int, RibbonRoute]]:
    """Give every loop a lane, short ones inside: on the side to which both its ends are closer."""
    found: list[tuple[int, RibbonRoute]] = []
    taken: dict[int, list[tuple[range, float]]] = {-1: [], 1: []}
    for arc in sorted(arcs.tolist(), key=lambda k: (int(starts[k] - ends[k]), k)):
        layers = range(int(ends[arc]), int(starts[arc]) + 1)
        width, (low, high) = max(float(widths[arc]), LEAST_BREADTH), threads.span(layers, middles)
        edges = {-1: low, 1: high}
        for side, others in taken.items():
            met = [edge for span, edge in others if span[0] <= layers[-1] and layers[0] <= span[-1]]
            edges[side] = side * max([side * edges[side], *(side * edge for edge in met)])
        lengths = {side: abs(edges[side] - (low + high) / 2) for side in edges}
        side = min((1, -1), key=lambda each: lengths[each])
        lane = edges[side] + side * (LANE + width / 2)
        taken[side].append((layers, lane + side * width / 2))
        found.append((arc, RibbonRoute(lane=lane, side=side)))
    return found
