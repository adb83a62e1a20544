"""What passes through nodes that store nothing: q = (I − Pᵀ)⁻¹ b, with loops, for many copies at once.

b is what enters such nodes from stocks, by schedule or from models, P_ij the share of what passes through i that goes
on to j. I − P is a singular M-matrix with what leaves the set taken out, so Gaussian elimination needs no pivots, and
every throughput is accurate to a few roundings however much goes round in loops (``elimination``).

Most shares are the same in all copies and intervals. Nodes all of whose shares are *constant* are eliminated once
(``detours``); what is left to do in each copy and interval are the *kept* nodes, whose shares are then those of their
arcs and of the detours through constant nodes.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from cirl_marl.dynamics.elimination import EliminatedShares
from cirl_marl.dynamics.static_elimination import SparseRow, StaticElimination, square_matrix
from cirl_marl.dynamics.visit_bounds import VisitBounds
from cirl_marl.network import Floats, Integers, Network, RowSum
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.uncertainty import widest_splits


@positional_record
class IntervalRoutes:
    """The shares of one control interval, in each copy."""

    rate: Annotated[Floats, "of all arcs, which is their share of those that leave nodes without stock, (arcs, B or 1)"]
    kept_nodes: Annotated[EliminatedShares, "the kept nodes, eliminated"]

    def of_copies(self, copies: Integers | slice) -> IntervalRoutes:
        """Return the shares of some copies."""
        if self.rate.shape[1] == 1:
            return self
        return IntervalRoutes(self.rate[:, copies], self.kept_nodes.of_copies(copies))


class Routing:
    """The arcs that leave nodes without stock.

    Attributes:
        nodes: number of nodes without stock.
        arcs: the arcs that leave them.
        donors: which of the nodes each leaves.
        ends: what each enters: one of the nodes, or the number of nodes plus a store.
        places: row of each node among the throughputs before elimination: constant nodes in their order, then the kept.
        throughput_rows: row of the donor of each of ``arcs`` among the throughputs.
        is_fixed: which of ``arcs`` have the same share in all copies and intervals.
        detours: the constant and the kept nodes.
    """

    def __init__(
        self,
        network: Network,
        rate: Floats,
        arc_is_fixed: NDArray[np.bool_],
        ranges: Mapping[str, tuple[float, float]],
    ) -> None:
        """Eliminate the constant nodes, and find the order of elimination of the others.

        Args:
            network: whose nodes they are.
            rate: rates of all arcs in one interval, shape (arcs, 1).
            arc_is_fixed: whether they are the same in all copies and intervals, shape (arcs,).
            ranges: lowest and highest factors on uncertain numbers, by path.
        """
        stores, self._network, self._ranges = len(network.stores), network, ranges
        self.nodes = len(network.nodes) - stores
        self.arcs: Integers = np.flatnonzero(network.donors >= stores)
        self.donors: Integers = network.donors[self.arcs] - stores
        # nodes without stock stand after those with one: stockless node j is end j, store s is end nodes + s
        ends = network.recipients[self.arcs] - stores
        self.ends: Integers = np.where(ends < 0, ends + stores + self.nodes, ends)
        self.is_fixed = arc_is_fixed[self.arcs]
        shares = rate[self.arcs, 0]
        gives: dict[int, SparseRow] = {i: {} for i in range(self.nodes)}
        for i, j, share, is_same in zip(
            self.donors.tolist(), self.ends.tolist(), shares.tolist(), self.is_fixed, strict=True
        ):
            if share > 0 or not is_same:
                gives[i][j] = gives[i].get(j, 0.0) + share
        constant = set(range(self.nodes)).difference(self.donors[~self.is_fixed].tolist())
        self.detours = StaticElimination(self.nodes, constant, gives)
        self._compile_passing()
        self._compile_shares(shares)
        self._constant = self._routes(rate) if self.is_fixed.all() else None

    def _compile_passing(self) -> None:
        """Arrange throughputs in the order in which constant nodes are eliminated; the kept ones follow."""
        detours, network, stores = self.detours, self._network, len(self._network.stores)
        early = len(detours.order)
        self._early = slice(0, early)
        place = {i: n for n, i in enumerate((*detours.order, *detours.kept_nodes))}
        self.places: Integers = np.array([place[i] for i in range(self.nodes)], dtype=np.intp)
        inflows = np.flatnonzero((network.donors < stores) & (network.recipients >= stores))
        shape = (self.nodes, len(network.arcs))
        self._inflow_sum = RowSum(self.places[network.recipients[inflows] - stores], inflows, 1.0, shape)
        gives = dict(zip(detours.order, detours.out, strict=True))
        self._ahead = square_matrix(gives, place, self.nodes)
        self._among = square_matrix(gives, {i: place[i] for i in detours.order}, self.nodes)
        # throughputs follow from the last to the first: their rows are in the opposite order
        self._inverse = np.array(detours.inverse)[::-1, None]
        back = {i: early - 1 - place[i] for i in detours.order}
        comes: dict[int, SparseRow] = {i: {} for i in detours.order}
        for i, into in zip(detours.order, detours.into, strict=True):
            for j, part in into.items():
                comes[j][i] = part
        self._back = square_matrix(comes, back, self.nodes)
        self.throughput_rows: Integers = np.where(self.places < early, early - 1 - self.places, self.places)[
            self.donors
        ]
        # arcs from kept nodes back to eliminated ones: their flow is known only after the kept throughputs are
        on = np.flatnonzero((self.places[self.donors] >= early) & (self.ends < self.nodes))
        on = on[self.places[self.ends[on]] < early]
        self._on, self._on_from = self.arcs[on], self.places[self.donors[on]] - early
        self._on_ends = self.places[self.ends[on]]
        self._on_to = RowSum(self._on_ends, range(len(on)), 1.0, (self.nodes, len(on)))

    def _compile_shares(self, shares: Floats) -> None:
        """Write the shares between kept nodes as weighted sums of the shares of arcs."""
        detours, order = self.detours, self.detours.elimination
        place, reach = {i: n for n, i in enumerate(detours.kept_nodes)}, detours.reach()
        fixed_terms: list[tuple[int, int, int, float]] = []
        varying_terms: list[tuple[int, int, int, float]] = []
        for k, (i, end) in enumerate(zip(self.donors.tolist(), self.ends.tolist(), strict=True)):
            if i in place and (shares[k] > 0 or not self.is_fixed[k]):
                terms = fixed_terms if self.is_fixed[k] else varying_terms
                parts = reach.get(end, {end if end < self.nodes else -1: 1.0})
                terms += [(k, place[i], place.get(j, -1), part) for j, part in parts.items() if j != i]
        fixed_table, varying_table = (np.array(terms).reshape(-1, 4) for terms in (fixed_terms, varying_terms))
        arcs, givers, getters = fixed_table[:, :3].T.astype(np.intp)
        products = fixed_table[:, 3] * shares[arcs]
        self._fixed_entries = np.bincount(order.entries(givers, getters), products, order.size).astype(float)[:, None]
        arcs, givers, getters = varying_table[:, :3].T.astype(np.intp)
        self._varying_arcs, columns = np.unique(arcs, return_inverse=True)
        shape = (order.size, len(self._varying_arcs))
        self._entries = RowSum(order.entries(givers, getters), columns, varying_table[:, 3], shape)

    def routes(self, rate: Floats) -> IntervalRoutes | None:
        """Return what to pass flows on with while ``rate``, shape (arcs, B), holds; None if every node stores."""
        return (self._constant or self._routes(rate)) if self.nodes else None

    def _routes(self, rate: Floats) -> IntervalRoutes:
        values = np.repeat(self._fixed_entries, rate.shape[1], axis=1)
        self._entries.add_to(values, rate.take(self.arcs[self._varying_arcs], 0))
        return IntervalRoutes(rate, EliminatedShares(self.detours.elimination, values))

    def pass_on(self, flow: Floats, routes: IntervalRoutes) -> None:
        """Fill in what leaves the nodes without stock, given in place what enters them, shape (arcs, B)."""
        outflows = self.throughputs(self._inflow_sum(flow), routes).take(self.throughput_rows, 0)
        outflows *= routes.rate.take(self.arcs, 0)
        flow[self.arcs] = outflows

    def throughputs(self, through: Floats, routes: IntervalRoutes) -> Floats:
        """Return what passes through, in the rows of ``result``, for what enters, in ``places``, which is used up.

        Shapes are (nodes, n·B), with n columns for each copy that ``routes`` are of.
        """
        early, late = self._early, slice(self._early.stop, self.nodes)
        result = np.empty_like(through)
        if late.start < late.stop:
            kept_rows = result[late]
            kept_rows[...] = self._ahead.substitute(through.copy())[late]
            routes.kept_nodes.throughput(kept_rows)
            back = kept_rows.take(self._on_from, 0)
            shares = routes.rate.take(self._on, 0)
            if (each := back.shape[1] // shares.shape[1]) > 1:
                shares = shares.repeat(each, axis=1)
            back *= shares
            self._on_to.add_to(through, back)
        self._among.substitute(through)
        np.multiply(through[early][::-1], self._inverse, out=result[early])
        return self._back.substitute(result)

    @cached_property
    def _on_sum(self) -> RowSum:
        """Add what arcs carry that come back to eliminated nodes at the kept nodes that they leave."""
        on, shape = np.arange(len(self._on)), (self.nodes, len(self._on))
        return RowSum(self._on_from + self._early.stop, on, 1.0, shape)

    def worths(self, worth: Floats, routes: IntervalRoutes) -> Floats:
        """Return what is worth a unit that enters each node, in ``places``, of the worth of what passes through each.

        It is the transpose of ``throughputs``: the worth of throughputs stands in the rows of its result, and is used
        up. Shapes are (nodes, B).
        """
        early, late = self._early, slice(self._early.stop, self.nodes)
        through = self.constant_worths(worth)
        if late.start < late.stop:
            kept_rows = self._on_sum.add_to(
                worth.copy(), self._on_to.transpose()(through.copy()) * routes.rate.take(self._on, 0)
            )
            kept_rows[early] = 0.0
            kept_rows[late] = routes.kept_nodes.worth(kept_rows[late])
            through = through + self._ahead.transpose(reverse=True).substitute(kept_rows[::-1].copy())[::-1]
        return through

    def constant_worths(self, worth: Floats) -> Floats:
        """Return the part of ``worths`` that is due to ways past constant nodes alone."""
        among, back = (matrix.transpose(reverse=True) for matrix in (self._among, self._back))
        worth = back.substitute(worth[::-1].copy())[::-1]
        through = np.zeros_like(worth)
        through[self._early] = (worth[self._early] * self._inverse)[::-1]
        return among.substitute(through[::-1].copy())[::-1]

    @property
    def return_arcs(self) -> tuple[Integers, Integers, Integers]:
        """Arcs from kept to constant nodes, which of the kept nodes they leave, and the place of what they enter."""
        return self._on, self._on_from, self._on_ends

    def most(self, flow: Floats) -> Floats:
        """Return upper bounds of the throughputs if flows that enter are at most ``flow``, shape (arcs,).

        Whatever the shares, what enters node j passes through nodes without stock at most v_j times in all
        (``passes``): no node sees more than that.
        """
        passes = VisitBounds(self._network, widest_splits(self._network, self._ranges))
        total = np.max([passes.total(step) for step in passes.kinds], axis=0)
        # every unit that enters node i passes through nodes at most total_i times
        inflow = self._inflow_sum(flow[:, None])[self.places, 0]
        return np.full(self.nodes, float(inflow @ total))
