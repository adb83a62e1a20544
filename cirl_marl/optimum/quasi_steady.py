"""How fast stocks and nodes without stock follow slow stocks: rows about merged pieces (theorem 3 of docs/bound.md).

Take the stores of a residence time far below a piece as fast, x, the others as slow. With the controls of an interval
ẋ = M x + g, the entries of M off the diagonal and g, the flows from slow stocks and by schedule, are not negative. What
a slow stock drives falls at most like e^{−κs}, so g(s) ≤ e^{κ(δ−s)} g(δ), and hence::

    x(s) ≤ e^{κ(δ−s)} x(δ) + e^{Ms} x(0)

A larger M̄ in place of M makes the last term, the transient, larger. The same holds for all flows that follow from x
and g, and for (w − w̲) and (w̄ − w) times what a factor w acts on. Of x_j, which leaves at a rate of at least k::

    x_j(δ) ≤ (1 − e^{−(k−κ)δ})/(k − κ)·(what enters j at the end) + (e^{Mδ} x(0))_j
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.constraints import followers, leader
from cirl_marl.optimum.kernels import weighted
from cirl_marl.optimum.matrices import Layout, ProgramRows
from cirl_marl.optimum.reach import Linear

FAST = (0.5, 2.0, 8.0)
"""Turnovers in a piece from which on a stock counts as fast; there are rows for each choice."""
WIDER, ROUND_OFF = 1.0 + 1e-9, 1e-12
"""Factor and allowance by which transients are widened; rounding errors are far smaller."""


def decay_rows(admissible: Admissible, layout: Layout, step: int, rows: ProgramRows) -> None:
    """Add the rows of an interval, each at most 0; their keys are (1, node, piece, what, i)."""
    network = admissible.network
    pulled = network.donors[~admissible.scheduled & (admissible.driver != network.donors)]
    nodes = np.setdiff1d(admissible.driver[~admissible.scheduled], pulled)
    nodes = nodes[nodes < len(network.stores)]
    if not len(nodes):
        return
    means, delays = _decay(admissible.exits(step)[1], layout.length, layout.degree)
    chain = _Decay(admissible, layout, rows, means, delays)
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


class _Decay:
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


def has_fast_stocks(admissible: Admissible, length: float) -> bool:
    """Return whether some stock counts as fast in pieces of a length, so that rows about it say something."""
    stores = len(admissible.network.stores)
    kinds = np.unique(admissible.kinds).tolist()
    return any((admissible.exits(kind)[0, :stores] * length >= FAST[0]).any() for kind in kinds)


def end_laws(admissible: Admissible, layout: Layout, step: int, equal: ProgramRows, under: ProgramRows) -> None:
    """Add the flow laws at the end of merged pieces; keys (3, piece, what, which, side)."""
    network, piece = admissible.network, np.arange(layout.pieces)[:, None]
    stores, nodes, arcs = len(network.stores), len(network.nodes), np.arange(len(network.arcs))
    rate = admissible.rate(step)
    orders = np.flatnonzero(admissible.scheduled)
    for side, sign in ((0, 1.0), (1, -1.0)):
        row = under.add(3, piece, 0, orders, side)
        under.put(row, layout.end_flow(piece) + orders, sign)
        under.put(row, layout.flow(0) + orders, -sign)
        under.loosen(row, orders, 1.0)
    driven = np.setdiff1d(np.flatnonzero(~admissible.scheduled & ~admissible.lived), followers(admissible, step))
    given = rate[0, driven] == rate[1, driven]
    for rows, which, side, sign in (
        (equal, driven[given], 0, 1.0),
        (under, driven[~given], 1, 1.0),
        (under, driven[~given], 0, -1.0),
    ):
        row = rows.add(3, piece, 1, which, side)
        rows.put(row, layout.end_flow(piece) + which, sign)
        rows.put(row, layout.end(piece) + admissible.driver[which], -sign * rate[side, which])
    passing = np.arange(stores, nodes)
    row = np.full((layout.pieces, nodes), -1)
    row[:, stores:] = equal.add(3, piece, 2, passing)
    entering = arcs[network.recipients >= stores]
    equal.put(row[:, network.recipients[entering]], layout.end_flow(piece) + entering, 1.0)
    equal.put(row[:, stores:], layout.end(piece) + passing, -1.0)
    for split in admissible.divided(step):
        donor, out = network.node_index[split.donor], np.array([*split.controlled_arcs, *split.other_arcs])
        least, most = admissible.valve[:, step, donor]
        if least == most:
            row = equal.add(3, piece, 3, donor)
            equal.put(row, layout.end_flow(piece) + out, 1.0)
            equal.put(row, layout.end(piece) + donor, -least * admissible.base[step, out[0]])
        lead, others, ratio = leader(split, step)
        row = equal.add(3, piece, 4, others)
        equal.put(row, layout.end_flow(piece) + others, 1.0)
        equal.put(row, layout.end_flow(piece) + lead, -ratio)


def quasi_steady_rows(admissible: Admissible, layout: Layout, step: int, linear: Linear, rows: ProgramRows) -> None:
    """Add the rows of theorem 3, at most 0, on an interval and the stocks before; keys (2, …)."""
    network = admissible.network
    if (admissible.driver[~admissible.scheduled] != network.donors[~admissible.scheduled]).any():
        return  # what recipients pull may make a stock fall faster than in proportion to it
    stores = len(network.stores)
    least, most = admissible.exits(step)[:, :stores]
    ordered = np.bincount(network.donors[admissible.scheduled], minlength=stores)[:stores] > 0
    _held_factors(admissible, layout, step, rows, ~ordered)
    known: set[bytes] = set()
    for turnover in FAST:
        fast = (least * layout.length >= turnover) & ~ordered
        if fast.tobytes() not in known:
            known.add(fast.tobytes())
            slow = ~fast & ~ordered
            writer = _QuasiSteady(admissible, layout, step, linear, rows, len(known), fast)
            writer.write(float(most[slow].max(initial=0.0)), least)


def _held_factors(
    admissible: Admissible, layout: Layout, step: int, rows: ProgramRows, usable: NDArray[np.bool_]
) -> None:
    """Add that (w − w̲)·x and (w̄ − w)·x fall at most as x does; keys (2, 0, piece, arc and side, i)."""
    (low, high), piece = admissible.rate(step), np.arange(layout.pieces)[:, None]
    fastest = admissible.exits(step)[1]
    known = np.append(usable & (fastest[: len(usable)] * layout.length < FAST[-1]), False)
    free = (low < high) & ~admissible.scheduled & ~admissible.lived
    arcs = np.flatnonzero(free & known[np.minimum(admissible.driver, len(usable))])
    arcs = np.setdiff1d(arcs, followers(admissible, step))
    driver = admissible.driver[arcs]
    for i in range(layout.degree + 1):
        moment = piece * (layout.degree + 1) + i
        growth = _growth(fastest[driver], layout, i)
        for side, sign, bound in ((0, 1.0, low[arcs]), (1, -1.0, high[arcs])):
            row = rows.add(2, 0, piece, 2 * arcs + side, i)
            rows.put(row, layout.flow(moment) + arcs, sign)
            rows.put(row, layout.stock(moment) + driver, -sign * bound)
            rows.put(row, layout.end_flow(piece) + arcs, -sign * growth)
            rows.put(row, layout.end(piece) + driver, sign * bound * growth)


class _QuasiSteady:
    """Writes the rows for one choice of fast stores."""

    def __init__(
        self,
        admissible: Admissible,
        layout: Layout,
        step: int,
        linear: Linear,
        rows: ProgramRows,
        choice: int,
        fast: NDArray[np.bool_],
    ) -> None:
        network = admissible.network
        self.admissible, self.layout, self.rows, self.choice = admissible, layout, rows, choice
        self.network, self.stores = network, len(network.stores)
        self.fast = np.flatnonzero(fast)
        self.low, self.high = admissible.rate(step)
        self.followers = followers(admissible, step)
        self._upstream(fast)
        gains = linear.gains.toarray()[np.ix_(fast, fast)]
        fading = np.diag(admissible.exits(step)[0, self.fast])
        means = _transients(gains - fading, layout.length, layout.degree)
        self.after = means[-1]
        # of every node the transient of its stock or throughput, from the fast stocks at the start
        self.transients = np.zeros((layout.degree + 1, len(network.nodes), len(self.fast)))
        self.transients[:, self.fast] = means[:-1]
        self.transients[:, self.stores :] = linear.thrown.toarray()[:, fast] @ means[:-1]
        fastest = float(admissible.exits(step)[1, : self.stores].max(initial=0.0))
        # what an arc carries can be nowhere more than this times what is asked of it
        self.loose = (1.0 + layout.network.episode.control_interval) * (1.0 + fastest) * linear.routes.longest

    def _upstream(self, fast: NDArray[np.bool_]) -> None:
        """Find the nodes that follow from slow stocks and schedules, and the schedules that they follow from."""
        network, orders = self.network, np.flatnonzero(self.admissible.scheduled)
        hands_on = np.append(fast, np.ones(len(network.nodes) - self.stores, dtype=bool))
        self.schedules = np.zeros((len(network.nodes), len(network.arcs)), dtype=bool)
        self.schedules[network.recipients[orders], orders] = True
        ordered = np.bincount(network.donors[orders], minlength=len(network.nodes)) > 0
        wrong, before = ordered & ~hands_on, -1
        driven = np.flatnonzero(~self.admissible.scheduled)
        donors, recipients = network.donors[driven], network.recipients[driven]
        while before != (before := int(self.schedules.sum() + wrong.sum())):
            through = hands_on[recipients]
            np.logical_or.at(wrong, recipients[through], wrong[donors[through]])
            through &= hands_on[donors]
            np.logical_or.at(self.schedules, recipients[through], self.schedules[donors[through]])
        self.covered = hands_on & ~wrong

    def write(self, slowest: float, least: Floats) -> None:
        """Write all rows, with κ = ``slowest`` and the least rates at which stocks are left."""
        layout, network, piece = self.layout, self.network, np.arange(self.layout.pieces)[:, None]
        nodes = np.flatnonzero(self.covered)
        arcs = np.flatnonzero((self.low < self.high) & ~self.admissible.scheduled)
        arcs = np.setdiff1d(arcs, self.followers)
        arcs = arcs[self.covered[self.admissible.driver[arcs]]]
        for i in range(layout.degree + 1):
            moment, growth = piece * (layout.degree + 1) + i, _growth(slowest, layout, i)
            row = self.rows.add(2, self.choice, piece, nodes, i)
            self.rows.put(row, layout.stock(moment) + nodes, 1.0)
            self.rows.put(row, layout.end(piece) + nodes, -growth)
            self._allow(row, piece, nodes, i, np.ones(len(nodes)))
            driver, spread = self.admissible.driver[arcs], self.high[arcs] - self.low[arcs]
            for side, sign, bound in ((0, 1.0, self.low[arcs]), (1, -1.0, self.high[arcs])):
                row = self.rows.add(2, self.choice, piece, len(network.nodes) + 2 * arcs + side, i)
                self.rows.put(row, layout.flow(moment) + arcs, sign)
                self.rows.put(row, layout.stock(moment) + driver, -sign * bound)
                self.rows.put(row, layout.end_flow(piece) + arcs, -sign * growth)
                self.rows.put(row, layout.end(piece) + driver, sign * bound * growth)
                self._allow(row, piece, driver, i, spread)
        fast = nodes[nodes < self.stores]
        row = np.full((layout.pieces, len(network.nodes)), -1)
        row[:, fast] = self.rows.add(2, self.choice, piece, fast, layout.degree + 1)
        self.rows.put(row[:, fast], layout.end(piece) + fast, 1.0)
        entering = np.flatnonzero(np.isin(network.recipients, fast))
        into = network.recipients[entering]
        margin = (least[np.minimum(into, self.stores - 1)] - slowest) * layout.length
        held = layout.length * special.exprel(-margin) * WIDER  # (1 − e^{−(k − κ)δ})/(k − κ)
        self.rows.put(row[:, into], layout.end_flow(piece) + entering, -held)
        self._start(row[:, fast], piece, self.after[np.searchsorted(self.fast, fast)])
        self._loosen(row[:, fast], fast, np.ones(len(fast)))

    def _allow(self, row: Integers, piece: Integers, nodes: Integers, i: int, factor: Floats) -> None:
        """Allow for the transients of nodes, times a factor, and for schedules that may be cut."""
        self._start(row, piece, self.transients[i, nodes] * factor[:, None])
        self._loosen(row, nodes, factor)

    def _start(self, row: Integers, piece: Integers, transients: Floats) -> None:
        place, source = np.nonzero(transients)
        self.rows.at_start(row[:, place], piece, self.fast[source], -transients[place, source])

    def _loosen(self, row: Integers, nodes: Integers, factor: Floats) -> None:
        place, arcs = np.nonzero(self.schedules[nodes])
        self.rows.loosen(row[:, place], arcs, self.loose * factor[place])


def _growth(rate: float | Floats, layout: Layout, i: int) -> Any:
    """Return the mean of e^{κ(δ−s)} under B_i."""
    return special.hyp1f1(layout.degree - i + 1, layout.degree + 2, rate * layout.length) * WIDER


def _transients(matrix: Floats, length: float, degree: int) -> Floats:
    """Return the means of e^{Ms} under B_0 … B_d, and e^{Mδ}, each at least as large, shape (d + 2, n, n)."""
    means, last = weighted(matrix, degree, length)
    found: Floats = np.maximum(np.concatenate([means, last[None]]), 0.0) * WIDER + ROUND_OFF
    return found
