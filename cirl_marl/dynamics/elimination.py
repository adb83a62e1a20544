"""Elimination of nodes that store nothing, in arrays over all copies.

The order is found once. Nodes that are not neighbours are eliminated in the same round, a handful of array operations
over all of them and all copies, so a column's bits do not depend on the batch it is in. As the shares of a node sum to
1, its pivot 1 − P_ii is the sum of its other shares (Grassmann, Taksar, Heyman 1985): nothing is ever subtracted.

Where the nodes that remain pass to a good part of each other, as in random graphs of markets, they are a *core*: its
shares are a full matrix, and its visits are found at once, by blocks.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from copy import copy
from functools import cached_property, partial
from itertools import chain
from typing import Annotated

import numpy as np

from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.rowsum import Triangle, kernels_round_products

_Ways = tuple[Integers, Integers]
"""How many neighbours each pivot of a round has on one side, and these, pivot by pivot."""

COSTLY = 2
"""A round eliminates nodes that are at most this many times as costly as the cheapest."""

CORE, CROWDED = 64, 0.25
"""Least number of nodes in a core, and least part of the pairs of them that have a share between them."""

ROUND = 50
"""What the calls of one round of ``EliminatedShares`` cost, in multiplications of as many copies as benchmarks have."""

SERIES = 12
"""Throughputs for each elimination: the usual number of terms of the solver's series."""


@positional_record
class _Round:
    """Nodes that are eliminated together, and the shares of theirs that are left then."""

    nodes: Annotated[Integers, "the nodes"]
    entries: Annotated[Integers, "of the shares that they give to nodes eliminated later, of what leaves, and get"]
    giver: Annotated[Integers, "which of ``nodes`` each of the first belongs to"]
    out_sum: Annotated[RowSum, "sum of the first for each of ``nodes``"]
    getter: Annotated[Integers, "which of ``nodes`` each of the last belongs to"]
    first: Annotated[Integers, "of each detour past a node of the round, its way in, among the last"]
    second: Annotated[Integers, "and its way out, among the others"]
    detours: Annotated[RowSum, "adds the detours to the entries of the shares that they make up"]
    forward: Annotated[RowSum, "adds what is given on to the nodes that get it"]
    donors: Annotated[Integers, "node that gives each of the first"]
    recipients: Annotated[Integers, "node that gets each of them"]
    backward: Annotated[RowSum, "adds what comes back to ``nodes``"]
    sources: Annotated[Integers, "node that gives each of the last"]


class EliminationOrder:
    """A sparse order: in each round nodes that are no neighbours and make few detours; then the core, if there is one.

    Attributes:
        nodes: number of nodes.
        pivots: the nodes that each round eliminates.
        core: those that are left then.
        cost: multiplications for every throughput, and what they share of those for every elimination, in each copy;
            all of them, if it is not above ``most``.
    """

    def __init__(self, gives: Sequence[set[int]], *, is_constant: bool = False, most: float = np.inf) -> None:
        """Find the order, or give it up once it costs more than ``most``.

        Args:
            gives: the other nodes that each node passes to; used up.
            is_constant: whether no share ever changes, so that a core is inverted once.
            most: highest cost that is of interest.
        """
        self.nodes, self._gives = len(gives), gives
        self._gets: list[set[int]] = [set() for _ in gives]
        for i, ends in enumerate(gives):
            for j in ends:
                self._gets[j].add(i)
        self.pivots: list[list[int]] = []
        self.core: Integers = np.empty(0, dtype=np.intp)
        self._ways: list[tuple[_Ways, _Ways]] = []
        self.cost = 0.0
        candidates, passes, detours = set(range(self.nodes)), 0, 0
        while candidates and self.cost <= most:
            costs = {i: len(gives[i]) * len(self._gets[i]) for i in candidates}
            count = len(candidates)
            if count >= CORE and sum(len(gives[i]) for i in candidates) >= CROWDED * count**2:
                self.core = np.array(sorted(candidates), dtype=np.intp)
                # one pass over memory; and as many additions as detours, but in blocks that stay in a cache
                self.cost += count**2 + (0.0 if is_constant else count**3 / SERIES)
                break
            pivots = self._independent(costs)
            self.pivots.append(pivots)
            self._ways.append((_ways_of(pivots, gives), _ways_of(pivots, self._gets)))
            passes += sum(len(ends) for _, ends in self._ways[-1])
            detours += self._eliminate(pivots)
            # factors that differ from copy to copy are gathered, multiplied and added: three passes over memory
            self.cost = 3 * passes + 4 * detours / SERIES + ROUND * len(self.pivots)
            candidates.difference_update(pivots)

    @property
    def size(self) -> int:
        """Number of entries: what leaves the set, then shares between two nodes, then the full matrix of the core."""
        return self.nodes + len(self._keys) + len(self.core) ** 2

    def entries(self, givers: Integers, getters: Integers) -> Integers:
        """Return the entries of the shares that nodes give to others, or to −1 where that leaves the set."""
        places = np.full(self.nodes, -1, dtype=np.intp)
        places[self.core] = np.arange(len(self.core))
        row, column = places[givers], places[getters]
        full = self.nodes + len(self._keys) + row * len(self.core) + column
        sparse = self.nodes + np.searchsorted(self._keys, givers * self.nodes + getters)
        between: Integers = np.where((row >= 0) & (column >= 0), full, sparse)
        return np.where(getters < 0, givers, between)

    def _pairs(self, side: int) -> _Ways:
        """Return the pivots of all rounds, once for each neighbour on one side, and these neighbours."""
        nothing = np.empty(0, dtype=np.intp)
        counts, ends = zip((nothing, nothing), *(ways[side] for ways in self._ways), strict=True)
        pivots = np.array([*chain(*self.pivots)], dtype=np.intp)
        return np.repeat(pivots, np.concatenate(counts)), np.concatenate(ends)

    @cached_property
    def _keys(self) -> Integers:
        """Pairs with a share between them, but those within the core, as giver · nodes + getter, sorted."""
        (givers, out), (getters, into) = self._pairs(0), self._pairs(1)
        return np.sort(np.concatenate([givers * self.nodes + out, into * self.nodes + getters]))

    def _independent(self, costs: Mapping[int, int]) -> list[int]:
        most = COSTLY * min(costs.values())
        pivots: list[int] = []
        near: set[int] = set()
        for _, i in sorted((cost, i) for i, cost in costs.items() if cost <= most):
            if i not in near:
                pivots.append(i)
                near |= self._gives[i] | self._gets[i]
        return pivots

    def _eliminate(self, pivots: Iterable[int]) -> int:
        """Join the neighbours of a round, and return how many detours past its nodes there are."""
        detours = 0
        for i in pivots:
            out, into = self._gives[i], self._gets[i]
            detours += len(into) * (len(out) + 1) - len(into & out)
            for nodes, ends, neighbours in ((into, out, self._gives), (out, into, self._gets)):
                for j in nodes:
                    neighbours[j] |= ends
                    neighbours[j] -= {i, j}
        return detours

    @cached_property
    def rounds(self) -> list[_Round]:
        """What each round does; only of the order that is chosen it has to be known."""
        return [self._round_of(np.array(pivots), *ways) for pivots, ways in zip(self.pivots, self._ways, strict=True)]

    @cached_property
    def factors(self) -> tuple[Integers, _Ways, _Ways]:
        """The nodes as they are eliminated; by place in this order who gives on to whom, and who gets back from whom.

        The shares themselves are ``EliminatedShares.factors``.
        """
        nodes = np.concatenate([np.array([*chain(*self.pivots)], dtype=np.intp), self.core])
        place = np.argsort(nodes)
        (givers, out), (getters, into) = (map(place.take, self._pairs(side)) for side in (0, 1))
        return nodes, (givers, out), (getters, into)

    @cached_property
    def triangle(self) -> Triangle:
        """All rounds in one: what comes to nodes as they are eliminated; then, in reverse, what passes them.

        Its numbers are ``EliminatedShares.factors`` with the inverse pivots between what nodes give on and get back.
        """
        nodes, (givers, out), (getters, into) = self.factors
        places, last = np.arange(len(nodes)), 2 * len(nodes) - 1
        rows, columns = (out, last - places, last - getters), (givers, places, last - into)
        return Triangle(np.concatenate(rows), np.concatenate(columns), 2 * len(nodes))

    @cached_property
    def transposed_rounds(self) -> list[tuple[RowSum, RowSum]]:
        """``forward`` and ``backward`` of each round the other way, from those that get to those that give."""
        return [
            (
                RowSum(round_.donors, np.arange(len(round_.donors)), 1.0, (self.nodes, len(round_.donors))),
                RowSum(round_.sources, np.arange(len(round_.sources)), 1.0, (self.nodes, len(round_.sources))),
            )
            for round_ in self.rounds
        ]

    def _round_of(self, nodes: Integers, out_ways: _Ways, into_ways: _Ways) -> _Round:
        (out_counts, out), (into_counts, into) = out_ways, into_ways
        giver, getter = np.repeat(np.arange(len(nodes)), out_counts), np.repeat(np.arange(len(nodes)), into_counts)
        # each way in with each way out of its node, of which that out of the set comes first
        counts = out_counts[getter] + 1
        first = np.repeat(np.arange(len(into)), counts)
        number = np.arange(len(first)) - np.repeat(np.cumsum(counts) - counts, counts)
        begins = np.cumsum(out_counts) - out_counts
        second = np.where(number > 0, begins[getter[first]] + number - 1, len(out) + getter[first])
        ends = np.append(out, np.full(len(nodes), -1))[second]
        is_detour = ends != into[first]  # what comes back to where it was is left out
        first, second = first[is_detour], second[is_detour]
        entries = self.entries(into[first], ends[is_detour])
        return _Round(
            nodes=nodes,
            entries=np.concatenate([self.entries(nodes[giver], out), nodes, self.entries(into, nodes[getter])]),
            giver=giver,
            out_sum=RowSum(giver, np.arange(len(out)), 1.0, (len(nodes), len(out))),
            getter=getter,
            first=first,
            second=second,
            detours=RowSum(entries, np.arange(len(entries)), 1.0, (self.size, len(entries))),
            forward=RowSum(out, np.arange(len(out)), 1.0, (self.nodes, len(out))),
            donors=nodes[giver],
            recipients=out,
            backward=RowSum(nodes[getter], np.arange(len(into)), 1.0, (self.nodes, len(into))),
            sources=into,
        )


def _ways_of(pivots: Sequence[int], neighbours: Sequence[set[int]]) -> _Ways:
    ends = [sorted(neighbours[i]) for i in pivots]
    return np.array([*map(len, ends)], dtype=np.intp), np.array([*chain(*ends)], dtype=np.intp)


def visits(shares: Floats, exits: Floats) -> Floats:
    """Return how often what enters each node passes through each, (I − P)⁻¹, without a subtraction, shape (…, n, n).

    One half of the nodes is eliminated from the other, by blocks. All copies go through the same products, each alone,
    so that their bits do not depend on their number.

    Args:
        shares: P, shape (…, n, n), whose diagonal is not read: a node passes on what comes back to it at once.
        exits: what leaves the nodes altogether, 1 − Σ_j P_ij but for P_ii, shape (…, n).
    """
    count = exits.shape[-1]
    if count == 1:
        return 1.0 / exits[..., None]
    early, late = slice(0, count // 2), slice(count // 2, count)
    on, back = shares[..., early, late], shares[..., late, early]
    result: Floats = np.empty(shares.shape)
    among = visits(shares[..., early, early], exits[..., early] + on.sum(axis=-1))
    on, back_among = among @ on, back @ among
    further = exits[..., late] + (back_among @ exits[..., early, None])[..., 0]
    result[..., late, late] = rest = visits(shares[..., late, late] + back @ on, further)
    result[..., early, late] = on = on @ rest
    result[..., late, early] = rest @ back_among
    result[..., early, early] = among + on @ back_among
    return result


class EliminatedShares:
    """The eliminated shares of one control interval, in each copy."""

    def __init__(self, order: EliminationOrder, values: Floats) -> None:
        """Eliminate ``values``, shape (entries, B or 1): of each node what leaves the set, then the shares."""
        self._steps = []
        self._inverse = np.ones((order.nodes, values.shape[1]))
        for round_ in order.rounds:
            shares, ways, leave = (
                values.take(round_.entries, 0),
                len(round_.giver),
                len(round_.giver) + len(round_.nodes),
            )
            out, exits, onward, into = shares[:ways], shares[ways:leave], shares[:leave], shares[leave:]
            # the pivot 1 − P_ii as the sum of what goes elsewhere, so that nothing cancels
            inverse = 1.0 / round_.out_sum.add_to(exits.copy(), out)
            out *= inverse.take(round_.giver, 0)
            exits *= inverse
            round_.detours.add_to(values, into.take(round_.first, 0) * onward.take(round_.second, 0))
            into *= inverse.take(round_.getter, 0)
            self._inverse[round_.nodes] = inverse
            self._steps.append((round_, out, into))
        self._order, core = order, order.core
        if len(core):
            shares = np.ascontiguousarray(values[order.size - len(core) ** 2 :].T)
            self._visits = visits(shares.reshape(-1, len(core), len(core)), np.ascontiguousarray(values[core].T))

    @cached_property
    def _numbers(self) -> Floats:
        """The numbers of ``triangle``."""
        return self._order.triangle.arrange(self._between_sides(self._inverse[self._order.factors[0]]))

    @property
    def factors(self) -> Floats:
        """What nodes give on to those eliminated later, then what they get from them, shape (entries, B)."""
        return self._between_sides(self._inverse[:0])

    def _between_sides(self, middle: Floats) -> Floats:
        """Return what nodes give on, ``middle``, and what they get, below each other."""
        return np.concatenate([*(out for _, out, _ in self._steps), middle, *(into for _, _, into in self._steps)])

    def pass_pivots(self, values: Floats, nodes: Integers) -> Floats:
        """Return what passes some ``nodes``, the core last, of what comes to each, shape (B, columns, nodes)."""
        through: Floats = values * self._inverse[nodes].T[:, None]
        if core := len(self._order.core):
            through[..., -core:] = values[..., -core:] @ self._visits
        return through

    def of_copies(self, copies: Integers | slice) -> EliminatedShares:
        """Return the eliminated shares of some copies."""
        part = copy(self)
        part.__dict__.pop("_numbers", None)
        part._steps = [(round_, out[:, copies], into[:, copies]) for round_, out, into in self._steps]
        part._inverse = self._inverse[:, copies]
        if len(self._order.core):
            part._visits = self._visits[copies]
        return part

    def _pass_core_rows(self, rows: Floats) -> None:
        rows[...] = self._pass_core(rows)

    def _pass_core(self, core_inflow: Floats) -> Floats:
        """Return what passes through the core for what enters it, shape (nodes of the core, B·n)."""
        by_copy = core_inflow.reshape(len(core_inflow), len(self._visits), -1)
        rows = np.ascontiguousarray(by_copy.transpose(1, 2, 0))[:, :, None]
        through = (rows @ self._visits[:, None])[:, :, 0]
        return through.transpose(2, 0, 1).reshape(core_inflow.shape)

    def throughput(self, inflow: Floats) -> Floats:
        """Return q in place of what enters from elsewhere, shape (nodes, B·n), with n columns for each copy."""
        nodes = self._order.factors[0]
        values = np.zeros((2 * len(nodes), inflow.shape[1]))
        inflow.take(nodes, 0, out=values[: len(nodes)])
        self.pass_through(values)
        inflow[nodes] = values[: len(nodes) - 1 : -1]
        return inflow

    def pass_through(self, values: Floats) -> None:
        """Set the second half of ``values``, which is 0, to q from the last node that is eliminated to the first.

        The first half, shape (nodes, B·n), is what enters nodes from elsewhere, in that order; it is used up.
        """
        for pass_on in self.passes(values):
            pass_on()

    def passes(self, values: Floats) -> list[Callable[[], object]]:
        """Return what ``pass_through`` calls, one after the other, for as often as it is to be done."""
        # forward substitution in the order of elimination, then backward: (I − Pᵀ)⁻¹ = L⁻¹ D⁻¹ U⁻¹
        nodes, batch, core = self._order.nodes, self._inverse.shape[1], len(self._order.core)
        if not kernels_round_products():
            return [partial(self._pass_rounds, values)]
        triangle = partial(self._order.triangle.substitution, self._numbers, values, batch)
        if not core:
            return [triangle()]  # in one call; a round takes longer to call than to compute
        return [
            triangle(last=nodes),
            partial(self._pass_core_rows, values[nodes - core : nodes]),
            triangle(first=nodes),
        ]

    def _pass_rounds(self, values: Floats) -> None:
        """Do what ``pass_through`` does, round by round."""
        nodes, core, batch = self._order.factors[0], self._order.core, self._inverse.shape[1]
        inflow = np.empty_like(values[: len(nodes)])
        inflow[nodes] = values[: len(nodes)]
        by_copy: Floats = inflow.reshape(len(inflow), batch, inflow.shape[1] // batch)

        def send(total: RowSum, senders: Integers, parts: Floats) -> None:
            total.add_to(inflow, (by_copy.take(senders, 0) * parts[..., None]).reshape(-1, inflow.shape[1]))

        for round_, out, _ in self._steps:
            send(round_.forward, round_.donors, out)
        by_copy *= self._inverse[..., None]
        if len(core):
            inflow[core] = self._pass_core(inflow[core])
        for round_, _, into in reversed(self._steps):
            send(round_.backward, round_.sources, into)
        values[len(nodes) :] = inflow[nodes[::-1]]

    def worth(self, values: Floats) -> Floats:
        """Return, in place of the worth of what passes through each node, that of what enters it, shape (nodes, B).

        It is (I − P)⁻¹ w, the transpose of ``throughput``: the same factors in the opposite order.
        """
        core, transposed_rounds = self._order.core, self._order.transposed_rounds
        for (round_, _, into), (_, backward) in zip(self._steps, transposed_rounds, strict=True):
            backward.add_to(values, values.take(round_.nodes[round_.getter], 0) * into)
        values *= self._inverse
        if len(core):
            values[core] = (self._visits @ np.ascontiguousarray(values[core].T)[..., None])[..., 0].T
        for (round_, out, _), (forward, _) in zip(reversed(self._steps), reversed(transposed_rounds), strict=True):
            forward.add_to(values, values.take(round_.recipients, 0) * out)
        return values
