"""Elimination of nodes that store nothing, in numbers where shares never change, else in arrays over all copies.

The order is found once. Nodes that are not neighbours are eliminated in the same round, a handful of array operations
over all of them and all copies, so a column's bits do not depend on the batch it is in. As the shares of a node sum to
1, its pivot 1 − P_ii is the sum of its other shares (Grassmann, Taksar, Heyman 1985): nothing is ever subtracted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cached_property, lru_cache
from heapq import heapify, heappop, heappush
from typing import Annotated

import numpy as np

from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.rowsum import Triangle, kernels_round_products

_Link = tuple[int, int, int]
"""Place of a pivot in its round, then what gives and what gets."""

COSTLY = 2
"""A round eliminates nodes that are at most this many times as costly as the cheapest."""


@positional_record
class _Round:
    """Nodes that are eliminated together, and the shares of theirs that are left then."""

    nodes: Annotated[Integers, "the nodes"]
    out: Annotated[Integers, "entries of the shares that they give to nodes eliminated later"]
    giver: Annotated[Integers, "which of ``nodes`` each belongs to"]
    out_sum: Annotated[RowSum, "sum of ``out`` for each of ``nodes``"]
    into: Annotated[Integers, "entries of the shares that they get from nodes eliminated later"]
    getter: Annotated[Integers, "which of ``nodes`` each belongs to"]
    first: Annotated[Integers, "of each detour past a node of the round, its way in, among ``into``"]
    second: Annotated[Integers, "and its way out, among ``out`` and then ``nodes`` for what leaves the set"]
    detours: Annotated[RowSum, "adds the detours to the entries of the shares that they make up"]
    forward: Annotated[RowSum, "adds what ``out`` carries to the nodes that get it"]
    donors: Annotated[Integers, "node that gives each of ``out``"]
    backward: Annotated[RowSum, "adds what ``into`` carries to ``nodes``"]
    sources: Annotated[Integers, "node that gives each of ``into``"]


class EliminationOrder:
    """A sparse order: in each round nodes that are no neighbours and make few detours.

    Attributes:
        nodes: number of nodes.
        size: number of entries.
        pivots: the nodes that each round eliminates.
    """

    def __init__(self, nodes: int, pairs: Iterable[tuple[int, int]]) -> None:
        """Take the shares as pairs of nodes (from, to); ``to`` is negative for what leaves the set."""
        self._place: dict[tuple[int, int], int] = {}
        self.nodes, self.size = nodes, nodes
        self._gives: list[set[int]] = [set() for _ in range(nodes)]
        self._gets: list[set[int]] = [set() for _ in range(nodes)]
        for i, j in pairs:
            self._join(i, j)
        self.pivots: list[list[int]] = []
        self._links: list[tuple[list[_Link], list[_Link], list[tuple[int, int, int]]]] = []
        candidates = set(range(nodes))
        while candidates:
            pivots = self._independent(candidates)
            self.pivots.append(pivots)
            self._links.append(self._eliminate(pivots))
            candidates.difference_update(pivots)

    @property
    def work(self) -> tuple[int, int]:
        """Multiplications for every throughput, and for every elimination, in each copy."""
        multiplications = sum(len(out) + len(into) for out, into, _ in self._links)
        return multiplications, sum(len(detours) for _, _, detours in self._links)

    def entry(self, i: int, j: int) -> int:
        """Return the entry of the share that i gives to j; the first ones are what leaves the set."""
        return i if j < 0 else self._place[i, j]

    def _join(self, i: int, j: int) -> int:
        if j < 0:
            return i
        if (i, j) not in self._place:
            self._place[i, j] = self.size
            self.size += 1
            self._gives[i].add(j)
            self._gets[j].add(i)
        return self._place[i, j]

    def _independent(self, candidates: set[int]) -> list[int]:
        cost = {i: len(self._gives[i]) * len(self._gets[i]) for i in candidates}
        most = COSTLY * min(cost.values())
        pivots: list[int] = []
        near: set[int] = set()
        for i in sorted((i for i in candidates if cost[i] <= most), key=lambda i: (cost[i], i)):
            if i not in near:
                pivots.append(i)
                near |= self._gives[i] | self._gets[i]
        return pivots

    def _eliminate(self, pivots: list[int]) -> tuple[list[_Link], list[_Link], list[tuple[int, int, int]]]:
        """Eliminate the nodes of a round: what they give, what they get, and each detour as way in, way out, entry."""
        out = [(n, i, k) for n, i in enumerate(pivots) for k in sorted(self._gives[i])]
        into = [(n, j, i) for n, i in enumerate(pivots) for j in sorted(self._gets[i])]
        ways: list[list[tuple[int, int]]] = [[(len(out) + n, -1)] for n in range(len(pivots))]
        for place, (n, _, k) in enumerate(out):
            ways[n].append((place, k))
        for i in pivots:
            for k in self._gives[i]:
                self._gets[k].discard(i)
            for j in self._gets[i]:
                self._gives[j].discard(i)
        join = self._join
        detours = [
            (way_in, way_out, join(j, k)) for way_in, (n, j, _) in enumerate(into) for way_out, k in ways[n] if k != j
        ]
        return out, into, detours

    @cached_property
    def rounds(self) -> list[_Round]:
        """What each round does; only of the order that is chosen it has to be known."""
        return [self._round_of(pivots, *links) for pivots, links in zip(self.pivots, self._links, strict=True)]

    @cached_property
    def triangles(self) -> tuple[Integers, Triangle, Triangle]:
        """All rounds in one: the nodes as they are eliminated, what they give on, and what comes back, in reverse."""
        nodes = np.array([i for pivots in self.pivots for i in pivots], dtype=np.intp)
        place = np.argsort(nodes)
        out, into = (
            place[np.array([link[1:] for links in self._links for link in links[n]], dtype=np.intp).reshape(-1, 2)]
            for n in (0, 1)
        )
        back = self.nodes - 1 - into
        return nodes, Triangle(out[:, 1], out[:, 0], self.nodes), Triangle(back[:, 1], back[:, 0], self.nodes)

    def _round_of(
        self, pivots: list[int], out: list[_Link], into: list[_Link], detours: list[tuple[int, int, int]]
    ) -> _Round:
        givers, donors, receivers = np.array(out, dtype=np.intp).reshape(-1, 3).T.copy()
        getters, sources, gets = np.array(into, dtype=np.intp).reshape(-1, 3).T.copy()
        first, second, entries = np.array(detours, dtype=np.intp).reshape(-1, 3).T.copy()
        return _Round(
            nodes=np.array(pivots, dtype=np.intp),
            out=np.array([self._place[i, k] for _, i, k in out], dtype=np.intp),
            giver=givers,
            out_sum=RowSum(givers, range(len(out)), 1.0, (len(pivots), len(out))),
            into=np.array([self._place[j, i] for _, j, i in into], dtype=np.intp),
            getter=getters,
            first=first,
            second=second,
            detours=RowSum(entries, range(len(entries)), 1.0, (self.size, len(entries))),
            forward=RowSum(receivers, range(len(out)), 1.0, (self.nodes, len(out))),
            donors=donors,
            backward=RowSum(gets, range(len(into)), 1.0, (self.nodes, len(into))),
            sources=sources,
        )


@lru_cache(maxsize=16)  # scenarios of a network often differ in nothing that matters here
def elimination_order(nodes: int, pairs: tuple[tuple[int, int], ...]) -> EliminationOrder:
    """Return the order for the same nodes and pairs, found once."""
    return EliminationOrder(nodes, pairs)


class EliminatedShares:
    """The eliminated shares of one control interval, in each copy."""

    def __init__(self, order: EliminationOrder, values: Floats) -> None:
        """Eliminate ``values``, shape (entries, B or 1): of each node what leaves the set, then the shares."""
        self._steps = []
        self._inverse = np.empty((order.nodes, values.shape[1]))
        for round_ in order.rounds:
            out, into, exits = values.take(round_.out, 0), values.take(round_.into, 0), values.take(round_.nodes, 0)
            # the pivot 1 − P_ii as the sum of what goes elsewhere, so that nothing cancels
            inverse = 1.0 / round_.out_sum.add_to(exits.copy(), out)
            out *= inverse.take(round_.giver, 0)
            exits *= inverse
            round_.detours.add_to(
                values, into.take(round_.first, 0) * np.concatenate([out, exits]).take(round_.second, 0)
            )
            into *= inverse.take(round_.getter, 0)
            self._inverse[round_.nodes] = inverse
            self._steps.append((round_, out, into))
        self._order = order

    @cached_property
    def _numbers(self) -> tuple[Floats, Floats, Floats]:
        """What one copy gives on, the inverse pivots and what comes back, in the order of ``triangles``."""
        nodes, ahead, back = self._order.triangles
        out = np.concatenate([part[:, 0] for _, part, _ in self._steps])
        into = np.concatenate([part[:, 0] for _, _, part in self._steps])
        return ahead.arrange(out), self._inverse[nodes, 0], back.arrange(into)

    def throughput(self, inflow: Floats) -> Floats:
        """Return q in place of what enters from elsewhere, shape (nodes, B)."""
        # forward substitution in the order of elimination, then backward: (I − Pᵀ)⁻¹ = L⁻¹ D⁻¹ U⁻¹
        if inflow.shape[1] == 1 and self._steps and kernels_round_products():
            # of one copy each sum is that of many, but in two calls; a round takes longer to call than to compute
            nodes, ahead, back = self._order.triangles
            out, inverse, into = self._numbers
            values = inflow[nodes, 0]
            ahead.substitute(out, values)
            values *= inverse
            values = values[::-1].copy()
            back.substitute(into, values)
            inflow[nodes, 0] = values[::-1]
            return inflow
        for round_, out, _ in self._steps:
            round_.forward.add_to(inflow, inflow.take(round_.donors, 0) * out)
        inflow *= self._inverse
        for round_, _, into in reversed(self._steps):
            round_.backward.add_to(inflow, inflow.take(round_.sources, 0) * into)
        return inflow


SparseRow = dict[int, float]
"""End → part of what a node passes on. Node j is end j, stock s is end nodes + s."""

THRIFT = 4
"""Where the next constant node costs so many times as much as any before, stopping there is considered."""

ROUND = 50
"""What the calls of one round of ``EliminatedShares`` cost, in multiplications of as many copies as benchmarks have."""

SERIES = 12
"""Throughputs for each elimination: the usual number of terms of the solver's series."""


class StaticElimination:
    """The nodes whose shares never change, eliminated once in Python numbers, and the nodes that are kept.

    What enters such a node ends up, in fixed parts, in stocks and in nodes whose shares do change.

    Attributes:
        order: the eliminated nodes, in their order.
        kept: the others. Constant ones are among them where eliminating them would join too many others.
        inverse: 1/pivot of each of ``order``.
        out: parts in which each of ``order`` passes on what it has got when its turn comes, to later ones, ends.
        into: parts of the throughputs of later ones of ``order`` that come back to each of ``order``.
        elimination: order of elimination of the kept nodes, by their place in ``kept``.
    """

    def __init__(self, nodes: int, constant: Iterable[int], gives: Mapping[int, SparseRow]) -> None:
        """Eliminate ``constant`` of so many nodes; of the others the ends that each ``gives`` to matter, not how much.

        Args:
            nodes: number of nodes that store nothing.
            constant: those whose shares never change.
            gives: shares of every node.
        """
        self._nodes = nodes
        self._gives = {i: dict(gives[i]) for i in range(nodes)}
        self._gets: dict[int, set[int]] = {i: set() for i in range(nodes)}
        for i, parts in self._gives.items():
            for j in parts:
                if j < nodes:
                    self._gets[j].add(i)
        self.order: list[int] = []
        self.inverse: list[float] = []
        self.out: list[SparseRow] = []
        self.into: list[SparseRow] = []
        self._eliminate(set(constant))

    def reach(self) -> dict[int, SparseRow]:
        """Return in which parts what enters each of ``order`` gets to kept nodes, and past them, end −1."""
        rows: dict[int, SparseRow] = {}
        for i, out in zip(reversed(self.order), reversed(self.out), strict=True):
            row: SparseRow = {}
            for end, part in out.items():
                for j, further in rows.get(end, {end if end < self._nodes else -1: 1.0}).items():
                    row[j] = row.get(j, 0.0) + part * further
            rows[i] = row
        return rows

    def _eliminate(self, constant: set[int]) -> None:
        """Eliminate all constant nodes, the cheapest first, then take back those that were better kept."""
        queue = [(self._cost(i), i) for i in constant]
        heapify(queue)
        most = entries = 0
        ways: list[tuple[float, int, list[int], EliminationOrder]] = []
        while queue:
            cost, i = heappop(queue)
            if i not in constant or cost != self._cost(i):
                continue  # out of date: it stands in the queue again
            if cost > THRIFT * most:
                ways.append(self._way(entries))
            most = max(most, cost)
            near = self._without(i)
            constant.remove(i)
            entries += len(self.out[-1])
            for j in near & constant:
                heappush(queue, (self._cost(j), j))
        ways.append(self._way(entries))
        _, count, self.kept_nodes, self.elimination = min(ways, key=lambda way: way[:2])
        for sequence in (self.order, self.inverse, self.out, self.into):
            del sequence[count:]
        early = set(self.order)
        self.into = [{j: part for j, part in into.items() if j in early} for into in self.into]

    def _cost(self, i: int) -> int:
        return len(self._gets[i]) * len(self._gives[i])

    def _way(self, entries: int) -> tuple[float, int, list[int], EliminationOrder]:
        """Return what it costs to stop here, how many are eliminated then, who is kept, and in which order."""
        kept_nodes = sorted(self._gives)
        place = {i: n for n, i in enumerate(kept_nodes)}
        pairs = ((place[i], place[j]) for i in kept_nodes for j in self._gives[i] if j in place and j != i)
        order = elimination_order(len(kept_nodes), tuple(pairs))
        pass_cost, build_cost = order.work
        # factors that differ from copy to copy are gathered, multiplied and added: three passes over memory, not one
        cost = 2 * entries + 3 * pass_cost + 4 * build_cost / SERIES + ROUND * len(order.pivots)
        return cost, len(self.order), kept_nodes, order

    def _without(self, i: int) -> set[int]:
        """Eliminate node i and return its neighbours."""
        out, sources = self._gives.pop(i), self._gets.pop(i)
        # P_jk gains P_ji·P_ik/(Σ_k P_ik), the Kron reduction of node i
        inverse = 1.0 / sum(out.values())
        parts = {end: share * inverse for end, share in out.items()}
        into: SparseRow = {}
        for j in sources:
            share_ = self._gives[j].pop(i)
            into[j] = share_ * inverse
            for end, part in parts.items():
                if end != j:  # what comes back to j is left out, and its pivot is the sum of the rest
                    self._gives[j][end] = self._gives[j].get(end, 0.0) + share_ * part
                    if end < self._nodes:
                        self._gets[end].add(j)
        near = {end for end in out if end < self._nodes}
        for end in near:
            self._gets[end].discard(i)
        self.order.append(i)
        self.inverse.append(inverse)
        self.out.append(parts)
        self.into.append(into)
        return near | sources


def contract_hubs(gives: dict[int, SparseRow], hubs: Iterable[int]) -> list[int]:
    """Take hubs out of an acyclic graph, in place, where the ways past them are no more than the ways to and from them.

    Args:
        gives: parts in which each source or hub passes on what it has.
        hubs: in an order in which each passes on to later ones only.

    Returns:
        the hubs that are left, in their order.
    """
    hubs = [hub for hub in hubs if hub in gives]
    gets: dict[int, set[int]] = {hub: set() for hub in hubs}
    for i, parts in gives.items():
        for j in parts.keys() & gets.keys():
            gets[j].add(i)
    for hub in hubs:
        sources, parts = gets[hub], gives[hub]
        if len(sources) * len(parts) > len(sources) + len(parts):
            continue
        for i in sources:
            share = gives[i].pop(hub)
            for j, part in parts.items():
                gives[i][j] = gives[i].get(j, 0.0) + share * part
        for j in parts.keys() & gets.keys():
            gets[j].discard(hub)
            gets[j] |= sources
        del gives[hub], gets[hub]
    return [hub for hub in hubs if hub in gets]


def square_matrix(gives: Mapping[int, SparseRow], row: Mapping[int, int], size: int) -> RowSum:
    """Return the square matrix of the parts whose source and end have a ``row``; the others are left out."""
    ways = [(row[j], row[i], part) for i, parts in gives.items() if i in row for j, part in parts.items() if j in row]
    return RowSum([i for i, _, _ in ways], [j for _, j, _ in ways], [part for _, _, part in ways], (size, size))
