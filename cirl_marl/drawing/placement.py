"""Where the compartments of a digraph go: small networks by search on a grid, large ones in layers.

Everything here is deterministic: the same network gives the same places.
"""

from __future__ import annotations

import math

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import SINKS, Role

SEARCHED_NODES = 24
"""Largest network whose places are searched for."""
SEARCHED_EDGES = 72
"""Largest number of connected pairs for which they are."""
RESTARTS = 6
STRETCH = 1.6


def place_nodes(network: Network, pitch: Floats, aspect: float) -> Floats:
    """Return the centre of each node, in em.

    Args:
        network: whose nodes are placed.
        pitch: distance between the centres of neighbouring places, across and down, em.
        aspect: width over height that the picture should have.

    Returns:
        Positions (x to the right, y upwards), shape (nodes, 2).
    """
    layers = layer_cells(network, pitch, aspect)
    edges = np.unique(np.sort(np.stack([network.donors, network.recipients], axis=1), axis=1), axis=0)
    small = 2 < len(network.nodes) <= SEARCHED_NODES and len(edges) <= SEARCHED_EDGES
    cells = _Search(network, edges, pitch, aspect).best(layers) if small else layers
    cells = _without_gaps(cells)
    return np.asarray(cells * _pitch(cells, pitch, aspect) * np.array([1.0, -1.0]))


def _pitch(cells: Floats, pitch: Floats, aspect: float) -> Floats:
    """Return the pitch widened, at most by ``STRETCH``, so that the cells fill a picture of this aspect."""
    wide, high = (np.ptp(cells, axis=0) + 1) * pitch
    stretch: Floats = np.clip(np.array([high * aspect / wide, wide / aspect / high]), 1.0, STRETCH)
    return pitch * stretch


def depths(network: Network) -> Integers:
    """Return the number of arcs from the nearest reservoir or source to each node, shape (nodes,)."""
    graph = nx.DiGraph(zip(network.donors.tolist(), network.recipients.tolist(), strict=True))
    graph.add_nodes_from(range(len(network.nodes)))
    starts = [i for i, node in enumerate(network.nodes) if node.role is Role.NONRENEWABLE_RESERVOIR]
    starts += [i for i in graph if not graph.in_degree(i)]
    depth_of: dict[int, int] = {}
    # What no source reaches hangs on a cycle: its first node counts as a source.
    for sources in (starts, *([i] for i in range(len(graph)))):
        if fresh := [i for i in sources if i not in depth_of]:
            depth_of = nx.multi_source_dijkstra_path_length(graph, fresh) | depth_of
    depth = np.array([depth_of[i] for i in range(len(graph))], dtype=np.intp)
    for i, node in enumerate(network.nodes):
        if node.role in SINKS and node.role is not Role.ENVIRONMENT and not graph.out_degree(i):
            depth[i] = depth.max()
    return depth


def layer_cells(network: Network, pitch: Floats, aspect: float) -> Floats:
    """Return cells (column, row) with the nodes ordered by depth and, within a depth, by their neighbours."""
    depth = depths(network)
    count = len(depth)
    height = np.zeros(count)
    levels = np.split(np.argsort(depth, kind="stable"), np.cumsum(np.bincount(depth))[:-1])
    for level in levels:
        _spread(height, level)
    neighbours = np.bincount(network.donors, minlength=count) + np.bincount(network.recipients, minlength=count)
    for _ in range(4):
        total = np.bincount(network.donors, height[network.recipients], count)
        total += np.bincount(network.recipients, height[network.donors], count)
        height = total / np.maximum(neighbours, 1)
        for level in levels:
            _spread(height, level)
    rows = max(1, math.ceil(math.sqrt(count * pitch[0] / (aspect * pitch[1]))))
    return _in_columns(depth, height, rows)


def _spread(height: Floats, members: Integers) -> None:
    """Put the members of a layer at equal distances in (-1, 1), in the order of their height."""
    order = members[np.argsort(height[members], kind="stable")]
    height[order] = (2 * np.arange(len(order)) + 1) / len(order) - 1 if len(order) else 0.0


def _in_columns(depth: Integers, height: Floats, rows: int) -> Floats:
    """Fill columns of at most ``rows`` cells; thin layers share columns, up and down in turn."""
    order = np.lexsort((height, depth))
    snakes = int(depth.max()) + 1 > 2 * math.ceil(len(depth) / rows)
    groups = [order] if snakes else [order[depth[order] == level] for level in range(int(depth.max()) + 1)]
    cells = np.zeros((len(depth), 2))
    column = 0
    for group in groups:
        for part in np.array_split(group, math.ceil(len(group) / rows)) if len(group) else []:
            row = np.arange(len(part)) + (0.0 if snakes else (rows - len(part)) / 2)
            if snakes and column % 2:
                row = len(part) - 1 - row
            cells[part, 0], cells[part, 1] = column, row
            column += 1
    return cells


def _without_gaps(cells: Floats) -> Floats:
    """Close empty rows and columns."""
    return np.stack([np.unique(cells[:, axis], return_inverse=True)[1] for axis in (0, 1)], axis=1).astype(float)


class _Search:
    """Coordinate descent over the cells of a grid: short, uncrossed arcs, reservoirs left and sinks right."""

    def __init__(self, network: Network, edges: Integers, pitch: Floats, aspect: float) -> None:
        count = len(network.nodes)
        self._edges, self._count = edges, count
        places = 1.5 * count
        self._columns = max(3, round(math.sqrt(places * aspect * pitch[1] / pitch[0])))
        self._rows = max(2, math.ceil(places / self._columns))
        self._unit = np.array([1.0, pitch[1] / pitch[0]])
        self._grid = np.indices((self._columns, self._rows)).reshape(2, -1).T.astype(float)
        roles = [node.role for node in network.nodes]
        pull = dict.fromkeys(SINKS, -0.6) | {Role.NONRENEWABLE_RESERVOIR: 0.6, Role.ENVIRONMENT: -0.2}
        self._pull = np.array([pull.get(role, 0.0) for role in roles])  # price of one column to the right
        self._upward = np.array([0.1 * (role is Role.NONRENEWABLE_RESERVOIR) for role in roles])
        self._donors, self._recipients = network.donors, network.recipients
        first, second = np.triu_indices(len(edges), 1)
        apart = ~(edges[first][:, :, None] == edges[second][:, None, :]).any(axis=(1, 2))
        self._first, self._second = first[apart], second[apart]
        self._pairs_at_node = (first[~apart], second[~apart])

    def best(self, seed: Floats) -> Floats:
        """Return the cheapest cells found from ``seed`` and some shuffled starts."""
        random = np.random.default_rng(0)
        starts = [np.argsort(np.lexsort((seed[:, 1], seed[:, 0])))]
        restarts = RESTARTS // max(1, self._count // 8)
        starts += [random.permutation(len(self._grid))[: self._count] for _ in range(restarts)]
        return self._grid[min(map(self._descend, starts), key=lambda outcome: outcome[0])[1]]

    def _descend(self, cells: Integers) -> tuple[float, Integers]:
        cells = cells.copy()
        cost = float(self._cost(self._grid[cells][None])[0])
        moves = True
        while moves:
            moves = False
            for node in range(self._count):
                trials = self._trials(cells, node)
                costs = self._cost(self._grid[trials])
                cheapest = int(np.argmin(costs))
                if costs[cheapest] < cost - 1e-9:
                    cells, cost, moves = trials[cheapest], float(costs[cheapest]), True
        return cost, cells

    def _trials(self, cells: Integers, node: int) -> Integers:
        """Every move of ``node`` to a cell, changing places with whoever is there, shape (cells, nodes)."""
        trials = np.repeat(cells[None], len(self._grid), axis=0)
        for neighbour in range(self._count):
            trials[cells[neighbour], neighbour] = cells[node]
        trials[:, node] = np.arange(len(self._grid))
        return trials

    def _cost(self, cells: Floats) -> Floats:
        """Price each trial, shape (trials,), from its cells, shape (trials, nodes, 2)."""
        points = cells * self._unit
        start, end = points[:, self._edges[:, 0]], points[:, self._edges[:, 1]]
        length = np.hypot(*np.moveaxis(end - start, -1, 0))
        crossings = _cross(start[:, self._first], end[:, self._first], start[:, self._second], end[:, self._second])
        backwards = np.maximum(cells[:, self._donors, 0] - cells[:, self._recipients, 0], 0)
        span = cells[..., 0] * self._pull + cells[..., 1] * self._upward
        middle = np.abs(cells[..., 1] - (self._rows - 1) / 2)
        price: Floats = (
            (length + 0.5 * length**2).sum(axis=1)
            + 3.0 * crossings.sum(axis=1)
            + 4.0 * self._obstruction(points, start, end).sum(axis=(1, 2))
            + 0.8 * self._sharpness(points).sum(axis=1)
            + 0.35 * backwards.sum(axis=1)
            + span.sum(axis=1)
            + 0.02 * middle.sum(axis=1)
        )
        return price

    def _obstruction(self, points: Floats, start: Floats, end: Floats) -> Floats:
        """How far each arc runs into the boxes of other nodes, shape (trials, edges, nodes)."""
        along = end - start
        square = np.maximum((along**2).sum(axis=-1), 1e-12)
        offset = points[:, None] - start[:, :, None]
        share = np.clip((offset * along[:, :, None]).sum(axis=-1) / square[..., None], 0, 1)
        gap = (offset - share[..., None] * along[:, :, None]) / self._unit
        near: Floats = np.clip(1.6 - 3 * np.abs(gap).max(axis=-1), 0, 1)
        rows = np.arange(len(self._edges))
        near[:, rows, self._edges[:, 0]] = 0
        near[:, rows, self._edges[:, 1]] = 0
        return near

    def _sharpness(self, points: Floats) -> Floats:
        """Cosine above 0.8 between two arcs of one node, shape (trials, pairs): labels would collide."""
        a, b = (self._edges[side] for side in self._pairs_at_node)
        hub = np.where((a[:, :1] == b).any(axis=1), a[:, 0], a[:, 1])
        first, second = a.sum(axis=1) - hub, b.sum(axis=1) - hub
        first_arm, second_arm = points[:, first] - points[:, hub], points[:, second] - points[:, hub]
        norm = np.hypot(*np.moveaxis(first_arm, -1, 0)) * np.hypot(*np.moveaxis(second_arm, -1, 0))
        cosine = (first_arm * second_arm).sum(axis=-1) / np.maximum(norm, 1e-12)
        return np.asarray(np.maximum(cosine - 0.8, 0) * 5)


def _cross(a: Floats, b: Floats, c: Floats, d: Floats) -> NDArray[np.bool_]:
    """Whether the segments a–b and c–d cross."""
    of_ab = _turn(a, b, c) * _turn(a, b, d)
    of_cd = _turn(c, d, a) * _turn(c, d, b)
    return (of_ab < 0) & (of_cd < 0)


def _turn(a: Floats, b: Floats, c: Floats) -> Floats:
    """Twice the signed area of the triangles a–b–c."""
    u, v = b - a, c - a
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]
