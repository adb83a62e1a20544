"""Elimination, in numbers, of the nodes without stock whose shares never change, and what is left of them."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from heapq import heapify, heappop, heappush

from cirl_marl.dynamics.elimination import EliminationOrder
from cirl_marl.network import RowSum

SparseRow = dict[int, float]
"""End → part of what a node passes on. Node j is end j, stock s is end nodes + s."""

THRIFT = 4
"""Where the next constant node costs so many times as much as any before, stopping there is considered."""


class StaticElimination:
    """The nodes whose shares never change, eliminated once in Python numbers, and the nodes that are kept.

    What enters such a node ends up, in fixed parts, in stocks and in nodes whose shares do change.

    Attributes:
        order: the eliminated nodes, in their order.
        kept_nodes: the others. Constant ones are among them where eliminating them would join too many others.
        inverse: 1/pivot of each of ``order``.
        out: parts in which each of ``order`` passes on what it has got when its turn comes, to later ones, ends.
        into: parts of the throughputs of later ones of ``order`` that come back to each of ``order``.
        elimination: order of elimination of the kept nodes, by their place in ``kept_nodes``.
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
        self.kept_nodes: list[int] = []
        self.elimination = EliminationOrder([])
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
        """Eliminate constant nodes, the cheapest first, as long as that may pay, then take back what did not."""
        queue = [(self._cost(i), i) for i in constant]
        heapify(queue)
        most = entries = joined = 0
        least, count, is_constant = math.inf, 0, len(constant) == self._nodes

        def improves() -> bool:
            """Find out what it costs to stop here: what passes through ``out``, and the elimination of who is kept."""
            nonlocal least, count, joined
            kept_nodes, joined = sorted(self._gives), 0
            place = {i: n for n, i in enumerate(kept_nodes)}
            gives = [{place[j] for j in self._gives[i] if j != i and j in place} for i in kept_nodes]
            order = EliminationOrder(gives, is_constant=is_constant, most=least - 2 * entries)
            if is_better := 2 * entries + order.cost < least:
                least, count = 2 * entries + order.cost, len(self.order)
                self.kept_nodes, self.elimination = kept_nodes, order
            return is_better

        while queue:
            cost, i = heappop(queue)
            if i not in constant or cost != self._cost(i):
                continue  # out of date: it stands in the queue again
            if cost > THRIFT * most:
                improves()
            if (joined > least and not improves()) or max(cost, 2 * entries) > least:
                break  # more is joined than there is work without: what follows are hubs
            most, joined = max(most, cost), joined + cost
            near = self._without(i)
            constant.remove(i)
            entries += len(self.out[-1])
            for j in near & constant:
                heappush(queue, (self._cost(j), j))
        else:
            improves()
        for sequence in (self.order, self.inverse, self.out, self.into):
            del sequence[count:]
        early = set(self.order)
        self.into = [{j: part for j, part in into.items() if j in early} for into in self.into]

    def _cost(self, i: int) -> int:
        return len(self._gets[i]) * len(self._gives[i])

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
