"""What arcs add at once to what services measure, past nodes that store nothing: xᵀ (I − P)⁻¹ y (``routing``).

x is where an arc enters, y what of a throughput a service measures. Few nodes are between an arc and a service, so the
factors of the elimination are applied to each sparse x and y alone, along their ways to nodes that are eliminated
later; they meet in the few nodes to which both come.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cirl_marl.dynamics.elimination import EliminatedShares, EliminationOrder
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.routing import IntervalRoutes, Routing
from cirl_marl.network import Floats, Integers, Network, RowSum
from cirl_marl.network.elements import Service
from cirl_marl.network.rowsum import Triangle


class Crossings:
    """xᵀ (I − P)⁻¹ y between the nodes of an elimination, for some constant sparse x, and some y made of rates."""

    def __init__(
        self,
        order: EliminationOrder,
        entries: tuple[Integers, Integers, Floats],
        exits: tuple[Integers, Integers, Integers, Floats],
        columns: tuple[int, int],
    ) -> None:
        """Follow x and y through the elimination.

        Args:
            order: of the elimination.
            entries: node, column and value of each entry of all x.
            exits: node, column, arc and weight of its rate of each entry of all y; those at the same place are added.
            columns: how many x and how many y there are.
        """
        nodes, gives, gets = order.factors
        place = np.argsort(nodes)
        x_pairs, x_links, x_rows = _ways(place[entries[0]], entries[1], *gives)
        y_pairs, y_links, y_rows = _ways(place[exits[0]], exits[1], *gets)
        self._x = np.bincount(x_rows, entries[2], len(x_pairs))[:, None]
        self._y = RowSum(y_rows, exits[2], exits[3], (len(y_pairs), int(exits[2].max(initial=-1)) + 1))
        links = np.concatenate([x_links, y_links + np.array([len(x_pairs), len(x_pairs), len(gives[0])])])
        self._factors, self._columns = links[:, 2], columns
        self._triangle = Triangle(links[:, 0], links[:, 1], len(x_pairs) + len(y_pairs))
        # of places to which one of them does not come the product is 0; the core stands last
        meeting = np.intersect1d(x_pairs[:, 0], y_pairs[:, 0])
        meeting = np.union1d(meeting, np.arange(order.nodes - len(order.core), order.nodes))
        self._nodes, self._ends = nodes[meeting], list[tuple[Integers, Integers, Integers]]()
        for pairs, first in ((x_pairs, 0), (y_pairs, len(x_pairs))):
            rows = np.flatnonzero(np.isin(pairs[:, 0], meeting))
            self._ends.append((first + rows, pairs[rows, 1], np.searchsorted(meeting, pairs[rows, 0])))

    def __call__(self, rate: Floats, shares: EliminatedShares) -> Floats:
        """Return the products for ``rate``, shape (arcs, B), and its ``shares``, shape (x columns, B, y columns)."""
        batch = rate.shape[1]
        values = np.concatenate([self._x.repeat(batch, axis=1), self._y(rate[: self._y.shape[1]])])
        self._triangle.substitute(self._triangle.arrange(shares.factors.take(self._factors, 0)), values, batch)
        x, y = (np.zeros((batch, columns, len(self._nodes))) for columns in self._columns)
        for full, (rows, columns, places) in zip((x, y), self._ends, strict=True):
            full[:, columns, places] = values[rows].T
        products = shares.pass_pivots(x, self._nodes) @ y.transpose(0, 2, 1)
        return np.ascontiguousarray(products.transpose(1, 0, 2))


def _ways(
    places: Integers, columns: Integers, givers: Integers, getters: Integers
) -> tuple[Integers, Integers, Integers]:
    """Follow entries of columns from their places on, from givers to getters.

    Returns:
        place and column of all entries that there are then, in the order of places, shape (entries, 2).
        Of each step between two entries the row it leads to, the one it comes from, and its giver and getter.
        Rows of the entries that were there.
    """
    onward: dict[int, list[tuple[int, int]]] = {}
    for link, (giver, getter) in enumerate(zip(givers.tolist(), getters.tolist(), strict=True)):
        onward.setdefault(giver, []).append((getter, link))
    starts = [*zip(places.tolist(), columns.tolist(), strict=True)]
    pairs, front = set(starts), [*dict.fromkeys(starts)]
    while front:
        place, column = front.pop()
        ends = [pair for getter, _ in onward.get(place, ()) if (pair := (getter, column)) not in pairs]
        pairs.update(ends)
        front += ends
    entries = sorted(pairs)
    row = {pair: n for n, pair in enumerate(entries)}
    links = [
        (row[getter, column], row[place, column], link)
        for place, column in entries
        for getter, link in onward.get(place, ())
    ]
    first_rows = np.array([row[pair] for pair in starts], dtype=np.intp)
    return _table(entries, 2), _table(links, 3), first_rows


def _table(rows: Sequence[tuple[int, ...]], columns: int) -> Integers:
    return np.array(rows, dtype=np.intp).reshape(-1, columns)


class Arrivals:
    """What some arcs add at once to what services measure, past nodes that store nothing, by the shares of an interval.

    What reaches a stock counts in full, as if it stayed there for the interval.
    """

    def __init__(self, laws: FlowLaws, services: Sequence[Service], arcs: Integers) -> None:
        """Take the arcs and the services."""
        network, routing = laws.staged_network, laws.routing
        readings = _service_arcs(network, services)
        column = {int(k): n for n, k in enumerate(arcs)}
        # by arc and service; of what passes nodes without stock only where none of its shares ever changes
        self._constant = np.zeros((len(arcs), len(services)))
        np.add.at(self._constant, tuple(_table([(column[k], row) for row, k in readings if k in column], 2).T), 1.0)
        ends = network.recipients[arcs] - len(network.stores)
        self._entry_arcs = np.flatnonzero(ends >= 0)
        entry_nodes, self._entry = np.unique(ends[self._entry_arcs], return_inverse=True)
        self._crossings: Crossings | None = None
        if len(entry_nodes):
            rates = laws.rate(laws.neutral[:, :1])[:, 0]
            self._constant[self._entry_arcs] += self._compile_passing(routing, rates, readings, entry_nodes)[
                self._entry
            ]

    def _compile_passing(
        self, routing: Routing, rates: Floats, readings: Sequence[tuple[int, int]], entry_nodes: Integers
    ) -> Floats:
        """Compile what passes kept nodes, and return what comes past constant nodes alone, (entry nodes, services)."""
        position = {int(k): n for n, k in enumerate(routing.arcs)}
        services, exit_arcs = _table([(row, position[k]) for row, k in readings if k in position], 2).T
        senders, kept_nodes = routing.throughput_rows[exit_arcs], routing.detours.kept_nodes
        early = routing.nodes - len(kept_nodes)
        is_early = senders < early
        worth = np.zeros((routing.nodes, self._constant.shape[1]))
        np.add.at(worth, (senders[is_early], services[is_early]), rates[routing.arcs[exit_arcs[is_early]]])
        worth = routing.constant_worths(worth)

        number, reach = {node: n for n, node in enumerate(kept_nodes)}, routing.detours.reach()
        parts = [
            (number[node], entry, part)
            for entry, end in enumerate(entry_nodes.tolist())
            for node, part in reach.get(end, {end: 1.0}).items()
            if node >= 0
        ]
        nodes, entries, amounts = np.array(parts).reshape(-1, 3).T
        arcs, givers, places = routing.return_arcs
        returns, of = worth[places].nonzero()
        exits = (
            np.append(senders[~is_early] - early, givers[returns]),
            np.append(services[~is_early], of),
            np.append(routing.arcs[exit_arcs[~is_early]], arcs[returns]),
            np.append(np.ones(np.count_nonzero(~is_early)), worth[places][returns, of]),
        )
        sparse_entries = nodes.astype(np.intp), entries.astype(np.intp), amounts
        columns = len(entry_nodes), worth.shape[1]
        self._crossings = Crossings(routing.detours.elimination, sparse_entries, exits, columns)
        return worth[routing.places[entry_nodes]]

    def __call__(self, routes: IntervalRoutes | None) -> Floats:
        """Return what each arc adds to what each service measures, per unit and time, shape (arcs, B or 1, services).

        Args:
            routes: by the shares of an interval; None if every node stores.
        """
        constant = self._constant[:, None]
        if self._crossings is None or routes is None:
            return constant
        crossing = self._crossings(routes.rate, routes.kept_nodes)
        result = constant.repeat(crossing.shape[1], axis=1)
        result[self._entry_arcs] += crossing.take(self._entry, 0)
        return result


def _service_arcs(network: Network, services: Sequence[Service]) -> list[tuple[int, int]]:
    """Return the services, by position, and the arcs whose flows add to what they measure."""
    into: dict[str, list[int]] = {}
    for k, arc in enumerate(network.arcs):
        into.setdefault(arc.recipient, []).append(k)
    parts, stocks = getattr(network, "parts", {}), dict[str, set[str]]()
    for node in network.stores:
        stocks.setdefault(parts.get(node.id, node.id), set()).add(node.id)
    readings: list[tuple[int, int]] = []
    for row, service in enumerate(services):
        if service.quantity == "stock":
            stock = set[str]().union(*(stocks.get(id_, ()) for id_ in service.providers))
            # what its parts hand on to each other is there already
            inflows = [k for id_ in sorted(stock) for k in into.get(id_, ()) if network.arcs[k].donor not in stock]
        else:
            inflows = [int(k) for k in network.service_arcs(service)]
        readings += [(row, k) for k in inflows]
    return readings
