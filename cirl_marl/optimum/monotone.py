"""How fast a stock can fall: inequalities between its weighted means, and between those of the flows it drives.

Within a piece ẋ ≥ −k x − U, with k the greatest rate of the proportional exits and U the scheduled outflow, so
y(s) = e^{ks} (x(s) + U (1 − e^{−ks})/k) never falls. Weighted with B_i(s) e^{−ks} its means rise with i (theorem 2 of
docs/bound.md)::

    x_start ≤ X̃_0/ω_0 ≤ … ≤ X̃_d/ω_d ≤ x̃_end/e^{−kδ},    X̃_i = X_i + U η_i,

with ω_i the mean of e^{−ks} and η_i that of (1 − e^{−ks})/k, weighted with B_i. Controls are constant within a piece,
so (w − w̲)·x and (w̄ − w)·x obey the same, with U times the range of w.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout
from cirl_marl.optimum.rows import ProgramRows
from cirl_marl.optimum.shared import followers


def falls(admissible: Admissible, layout: Layout, step: int, rows: ProgramRows) -> None:
    """Add the rows of an interval, each at most 0; their keys are (1, node, piece, what, i)."""
    network = admissible.network
    pulled = network.donors[~admissible.scheduled & (admissible.driver != network.donors)]
    nodes = np.setdiff1d(admissible.driver[~admissible.scheduled], pulled)
    nodes = nodes[nodes < len(network.stores)]
    if not len(nodes):
        return
    means, delays = _decay(admissible.exits(step)[1], layout.length, layout.degree)
    chain = _Chains(admissible, layout, rows, means, delays)
    chain.of_stocks(nodes)
    position = np.full(len(network.nodes), -1)
    position[layout.valves] = np.arange(len(layout.valves))
    valve = admissible.valve[:, step]
    through = np.intersect1d(layout.valves, nodes)
    chain.driven(through, 0 * through, layout.valve(0) + position[through], through, valve[:, through], 1.0)
    arcs = np.flatnonzero(np.isin(admissible.driver, nodes) & ~admissible.lived)
    arcs = np.setdiff1d(arcs, followers(admissible, step))
    drivers = admissible.driver[arcs]
    via = (position[drivers] >= 0) & (network.donors[arcs] == drivers)
    factor = np.where(via, admissible.own[:, step, arcs], admissible.factor[:, step, arcs])
    chain.driven(
        drivers,
        1 + arcs,
        layout.flow(0) + arcs,
        np.where(via, layout.valve(0) + position[drivers], drivers),
        factor * admissible.base[step, arcs],
        np.where(via, valve[1, drivers], 1.0),
    )


def _decay(rate: Floats, length: float, degree: int) -> tuple[Floats, Floats]:
    """Return ω_0 … ω_d, e^{−kδ} and η_0 … η_d, (1 − e^{−kδ})/k; ω_i = ₁F₁(i + 1; d + 2; −kδ)."""
    i = np.arange(degree + 1)
    turned_over = (rate * length)[:, None]
    means = np.concatenate([special.hyp1f1(i + 1, degree + 2, -turned_over), np.exp(-turned_over)], axis=1)
    # x + U·s in place of x + U (1 − e^{−ks})/k serves for every k ≥ 0, and is a little weaker
    slow = np.broadcast_to(np.append((i + 1) / (degree + 2), 1.0) * length, means.shape)
    return means, np.divide(1.0 - means, rate[:, None], out=slow.copy(), where=turned_over >= 1e-6)


class _Chains:
    """Writes that weighted means of something which falls at most like e^{−ks}, but for U, rise with i."""

    def __init__(
        self, admissible: Admissible, layout: Layout, rows: ProgramRows, means: Floats, delays: Floats
    ) -> None:
        self.layout, self.rows, self.means, self.delays = layout, rows, means, delays
        self.first = np.arange(layout.pieces) * (layout.degree + 1)  # moment of each piece
        donors = np.where(admissible.scheduled, admissible.network.donors, len(means))
        self.orders = np.argsort(donors, kind="stable")  # scheduled arcs, donor after donor
        self.counts = np.bincount(donors, minlength=len(means))[: len(means)]
        self.starts = np.cumsum(self.counts) - self.counts

    def of_stocks(self, nodes: Integers) -> None:
        """Write the chain of each stock from the start of a piece to its end."""
        layout, rows, d = self.layout, self.rows, self.layout.degree
        piece, moment = np.arange(layout.pieces)[:, None], self.first[:, None]
        means, delays = self.means[nodes], self.delays[nodes]
        start = rows.add(1, nodes, piece, -1)
        rows.at_start(start, piece, nodes, means[:, 0])
        rows.put(start, layout.stock(moment) + nodes, -1.0)
        self._orders(start, nodes, -delays[:, 0])
        none = np.zeros(len(nodes))
        self._between(nodes, -1, nodes, np.ones(len(nodes)), nodes, none, 1.0)
        end = rows.add(1, nodes, piece, -1, d + 1)
        ratio = means[:, d + 1] / means[:, d]  # (X_d + U η_d)/ω_d ≤ (x_end + U η_end)/e^{−kδ}, times e^{−kδ}
        rows.put(end, layout.stock(moment + d) + nodes, ratio)
        rows.put(end, layout.end(piece) + nodes, -1.0)
        self._orders(end, nodes, ratio * delays[:, d] - delays[:, d + 1])

    def driven(
        self, nodes: Integers, what: Integers, column: Integers, driver: Integers, factor: Floats, scale: float | Floats
    ) -> None:
        """Write the chains of (w − w̲)·x and (w̄ − w)·x, with w in ``factor`` and w·x and x in given columns.

        Args:
            nodes: whose stocks x are, times ``scale`` at the most.
            what: keys of the factors of each node, in their order.
            column: of w·x in the first moment.
            driver: of x.
            factor: w̲ and w̄, shape (2, …).
            scale: largest factor of the stock itself that is in x.
        """
        free = factor[0] < factor[1]
        nodes, what, column, driver, (low, high) = nodes[free], what[free], column[free], driver[free], factor[:, free]
        spread = (high - low) * np.broadcast_to(scale, free.shape)[free]
        one = np.ones(len(nodes))
        self._between(nodes, 2 * what, column, one, driver, -low, spread)
        self._between(nodes, 2 * what + 1, column, -one, driver, high, spread)

    def _between(
        self,
        nodes: Integers,
        what: int | Integers,
        column: Integers,
        weight: Floats,
        other: Integers,
        other_weight: Floats,
        spread: float | Floats,
    ) -> None:
        """Write ω_{i+1}/ω_i·q_i − q_{i+1} − spread·U·(…) ≤ 0 for q the weighted sum of two columns of a moment."""
        layout, rows = self.layout, self.rows
        piece, moment = np.arange(layout.pieces)[:, None], self.first[:, None]
        means, delays = self.means[nodes], self.delays[nodes]
        for i in range(layout.degree):
            # (q_i + U η_i)/ω_i ≤ (q_{i+1} + U η_{i+1})/ω_{i+1}, times ω_{i+1}
            ratio = means[:, i + 1] / means[:, i]
            row = rows.add(1, nodes, piece, what, i + 1)
            for place, factor in ((moment + i, ratio), (moment + i + 1, -1.0)):
                rows.put(row, layout.stock(place) + column, factor * weight)
                rows.put(row, layout.stock(place) + other, factor * other_weight)
            self._orders(row, nodes, spread * (ratio * delays[:, i] - delays[:, i + 1]))

    def _orders(self, row: Integers, nodes: Integers, weight: Floats) -> None:
        """Put a weight at every scheduled outflow of each row's node; rows are of shape (pieces, nodes).

        In coarse pieces what is asked in the interval stands for it; a flow that may be cut is below it at times.
        """
        counts = self.counts[nodes]
        which = np.repeat(np.arange(len(nodes)), counts)
        offset = np.arange(len(which)) - np.repeat(np.cumsum(counts) - counts, counts)
        arcs = self.orders[self.starts[nodes[which]] + offset]
        moment = 0 * self.first if self.layout.coarse else self.first
        self.rows.put(row[:, which], self.layout.flow(moment[:, None]) + arcs, weight[which])
        if self.layout.coarse:
            self.rows.loosen(row[:, which], arcs, np.maximum(-weight[which], 0.0))
