"""The plan of a network's picture: places, courses and names, computed once for each structure."""

from __future__ import annotations

import textwrap
from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np

from cirl_marl.drawing.places import place
from cirl_marl.drawing.routing import LABEL, Routes, route
from cirl_marl.drawing.style import spoken
from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Role

LABELLED_NODES = 60
"""Largest network drawn with boxes and labels."""
LABELLED_ARCS = 200
LINE_LETTERS = 12


@dataclass(frozen=True, slots=True)
class Arrangement:
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


def arrangement_of(network: Network, aspect: float) -> Arrangement:
    """Return the layout of ``network`` for pictures of about this width over height."""
    nodes = tuple((node.id, node.role) for node in network.nodes)
    arcs = tuple((arc.donor, arc.recipient) for arc in network.arcs)
    return _layout(_Structure(nodes, arcs, network), round(2 * aspect) / 2 or 0.5)


@dataclass(frozen=True, slots=True)
class _Structure:
    """A network that equals every other with the same nodes, arcs and roles, whatever its numbers."""

    nodes: tuple[tuple[str, Role], ...]
    arcs: tuple[tuple[str, str], ...]
    network: Network = field(compare=False)


@lru_cache(maxsize=16)
def _layout(structure: _Structure, aspect: float) -> Arrangement:
    network = structure.network
    names = tuple(_lines(node.id) for node in network.nodes)
    letters = max(len(line) for name in names for line in name)
    box = np.array([max(5.5, 0.62 * letters + 1.0), 1.2 * (max(map(len, names)) + 1) + 0.6])
    positions = place(network, box + np.array([4.8, 3.7]), aspect)
    labelled = len(network.nodes) <= LABELLED_NODES and len(network.arcs) <= LABELLED_ARCS
    routes = route(positions, network.donors, network.recipients, box) if labelled else None
    return Arrangement(positions, routes, box, names)


def _lines(identifier: str) -> tuple[str, ...]:
    """Break an id into lines at its spaces."""
    lines = textwrap.wrap(spoken(identifier), LINE_LETTERS, break_long_words=False, break_on_hyphens=False)
    return tuple(lines) or ("",)
