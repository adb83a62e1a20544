"""The plan of a network's picture: places of nodes, courses and labels of arcs, computed once for each structure."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from cirl_marl.drawing.placement import place_nodes
from cirl_marl.drawing.style import label_lines
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Role

LABELLED_NODES = 60
"""Largest network drawn with boxes and labels."""
LABELLED_ARCS = 200
LINE_LETTERS = 12
BENDS = (0.0, 0.16, -0.16, 0.3, -0.3, 0.45, -0.45, 0.65, -0.65, 0.9, -0.9)
MUTUAL_BEND = 0.3
"""Least bend of two arcs that run against each other."""
POINTS = 48
LABEL = np.array([3.3, 1.2])
"""Width and height kept free for a label, em."""
CLEAR = 0.6
"""Distance of a label from the middle of its arrow, em."""
SHARES = (0.5, 0.42, 0.58, 0.34, 0.66, 0.26, 0.74, 0.18, 0.82)


@dataclass(frozen=True, slots=True)
class Routes:
    """The visible course of each arc from donor to recipient, shape (arcs, points, 2), and its label's centre, em."""

    curves: Floats
    labels: Floats


@dataclass(frozen=True, slots=True)
class DigraphLayout:
    """Where everything of one network goes, in em: ``positions`` are the centres of the nodes, shape (nodes, 2).

    ``routes`` are None for networks too large to label; ``names`` are the labels of the nodes, in lines.
    """

    positions: Floats
    routes: Routes | None
    box: Floats
    names: tuple[tuple[str, ...], ...]

    def extent(self) -> tuple[Floats, Floats]:
        """Return the lower left and upper right corner of all that is drawn."""
        places, half, label = self.positions, self.box / 2 + 0.3, LABEL / 2
        if self.routes is None:
            margin = 0.04 * np.ptp(places, axis=0) + 1
            return places.min(axis=0) - margin, places.max(axis=0) + margin
        labels = self.routes.labels
        corners = [places - half, places + half, self.routes.curves.reshape(-1, 2), labels - label, labels + label]
        points = np.concatenate(corners)
        return points.min(axis=0), points.max(axis=0)


def digraph_layout(network: Network, aspect: float) -> DigraphLayout:
    """Return the layout of ``network`` for pictures of about this width over height."""
    nodes = tuple((node.label, node.role) for node in network.nodes)
    arcs = tuple((arc.donor, arc.recipient) for arc in network.arcs)
    return _layout(_Structure(nodes, arcs, network), round(2 * aspect) / 2 or 0.5)


@dataclass(frozen=True, slots=True)
class _Structure:
    """A network that equals every other with the same nodes, arcs and roles, whatever its numbers."""

    nodes: tuple[tuple[str, Role], ...]
    arcs: tuple[tuple[str, str], ...]
    network: Network = field(compare=False)


@lru_cache(maxsize=16)
def _layout(structure: _Structure, aspect: float) -> DigraphLayout:
    network = structure.network
    names = tuple(label_lines(node.label, LINE_LETTERS) for node in network.nodes)
    letters = max(len(line) for name in names for line in name)
    box = np.array([max(5.5, 0.62 * letters + 1.0), 1.2 * (max(map(len, names)) + 1) + 0.6])
    positions = place_nodes(network, box + np.array([4.8, 3.7]), aspect)
    has_labels = len(network.nodes) <= LABELLED_NODES and len(network.arcs) <= LABELLED_ARCS
    routes = route(positions, network.donors, network.recipients, box) if has_labels else None
    return DigraphLayout(positions, routes, box, names)


def bezier(start: Floats, end: Floats, bend: Floats, points: int) -> Floats:
    """Return parabolas that bend to their right, by ``bend`` of their length, shape (arcs, points, 2)."""
    along = end - start
    right = np.stack([along[..., 1], -along[..., 0]], axis=-1)
    control = (start + end) / 2 + right * np.asarray(bend)[..., None]
    share = np.linspace(0, 1, points)[:, None]
    return (1 - share) ** 2 * start[:, None] + 2 * share * (1 - share) * control[:, None] + share**2 * end[:, None]


def route(positions: Floats, donors: Integers, recipients: Integers, box: Floats) -> Routes:
    """Choose, arc by arc, the least bent course that is free of boxes and of the arcs before it.

    Nodes have their centres at ``positions``, shape (nodes, 2), and width and height ``box``, em.
    """
    pairs = Counter(zip(donors.tolist(), recipients.tolist(), strict=True))
    length = np.hypot(*(positions[recipients] - positions[donors]).T)
    curves = np.zeros((len(donors), POINTS, 2))
    done: list[int] = []
    for arc in np.argsort(length, kind="stable").tolist():
        donor, recipient = int(donors[arc]), int(recipients[arc])
        mutual = pairs[recipient, donor] > 0
        bends = np.array([bend for bend in BENDS if bend >= MUTUAL_BEND or not mutual])
        ends = np.repeat(positions[[donor, recipient]][:, None], len(bends), axis=1)
        trials = bezier(ends[0], ends[1], bends, POINTS)
        trials = np.stack([_outside_boxes(trial, positions[donor], positions[recipient], box) for trial in trials])
        other_nodes = np.delete(positions, [donor, recipient], axis=0)
        price = 2.5 * np.abs(bends) + _inside(trials, other_nodes, box + 1.2) + _closeness(trials, curves[done])
        curves[arc] = trials[int(np.argmin(price))]
        done.append(arc)
    return Routes(curves, _labels(curves, positions, box))


def _outside_boxes(curve: Floats, donor: Floats, recipient: Floats, box: Floats) -> Floats:
    """Cut off what lies in the boxes of the two ends and space the rest evenly again."""
    fine = np.linspace(0, 1, 4 * POINTS)
    share = np.linspace(0, 1, len(curve))
    dense = np.stack([np.interp(fine, share, curve[:, axis]) for axis in (0, 1)], axis=1)
    reach = box / 2 + 0.15
    free = ~((np.abs(dense - donor) < reach).all(axis=1) | (np.abs(dense - recipient) < reach).all(axis=1))
    outside = dense[free] if free.sum() > 1 else dense
    step = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(outside, axis=0).T))])
    even = np.linspace(0, step[-1], POINTS)
    return np.stack([np.interp(even, step, outside[:, axis]) for axis in (0, 1)], axis=1)


def _inside(trials: Floats, centres: Floats, box: Floats) -> Floats:
    """Price of running through boxes, shape (trials,)."""
    inside = (np.abs(trials[:, :, None] - centres) < box / 2).all(axis=-1)
    return np.asarray(inside.sum(axis=(1, 2)) * 0.5)


def _closeness(trials: Floats, curves: Floats) -> Floats:
    """Price of running close to earlier arcs, shape (trials,)."""
    if not len(curves):
        return np.zeros(len(trials))
    points = curves[:, ::3].reshape(-1, 2)
    away = np.hypot(*np.moveaxis(trials[:, ::3, None] - points, -1, 0))
    return np.asarray(np.clip(1.3 - away, 0, None).sum(axis=(1, 2)) * 0.25)


def _labels(curves: Floats, positions: Floats, box: Floats) -> Floats:
    """Put each label beside its arc where it hides least of boxes, arcs and earlier labels."""
    places = np.zeros((len(curves), 2))
    for arc, curve in enumerate(curves):
        centres, price = _beside(curve)
        price += _overlap(centres, positions, box + LABEL) * 15 + _overlap(centres, places[:arc], 2 * LABEL) * 8
        other_curves = np.delete(curves, arc, axis=0)[:, ::2]
        hidden_curves = (np.abs(centres[:, None, None] - other_curves) < LABEL / 2 + 0.5).all(axis=-1)
        price += hidden_curves.sum(axis=(1, 2)) * 0.6
        places[arc] = centres[int(np.argmin(price))]
    return places


def _beside(curve: Floats) -> tuple[Floats, Floats]:
    """Centres that a label of this arc may have and the price of each."""
    centres, price = [], []
    for share in SHARES:
        index = round(share * (len(curve) - 1))
        along = curve[min(index + 1, len(curve) - 1)] - curve[max(index - 1, 0)]
        normal = np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
        clear = float(np.abs(normal) @ (LABEL / 2)) + CLEAR
        upward = normal if (normal[1], normal[0]) > (0, 0) else -normal
        for side, extra in ((upward, 0.0), (-upward, 0.05)):
            centres.append(curve[index] + side * clear)
            price.append(abs(share - 0.5) + extra)
    return np.array(centres), np.array(price)


def _overlap(centres: Floats, rivals: Floats, size: Floats) -> Floats:
    """Shared area, in labels, of boxes whose half sizes sum to half of ``size``, shape (centres,)."""
    overlap = np.clip(size / 2 - np.abs(centres[:, None] - rivals), 0, LABEL)
    return np.asarray(overlap.prod(axis=-1).sum(axis=1) / LABEL.prod())
