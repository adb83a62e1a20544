"""How fast stocks follow slow ones: rows of theorem 3 of docs/bound.md.

Take the stores of a residence time far below a piece as fast, x, the others as slow. With the controls of an interval
ẋ = M x + g, the entries of M off the diagonal and g, the flows from slow stocks and by schedule, are not negative.
What a slow stock drives falls at most like e^{−κs}, so g(s) ≤ e^{κ(δ−s)} g(δ), κ that of the fastest of the slow stocks
which drive a node, and hence::

    x(s) ≤ e^{κ(δ−s)} x(δ) + e^{Ms} x(0)

A larger M̄ in place of M makes the last term, the transient, larger. What leaves a lifetime may fall faster: where a
part of it is constant (theorem 6), the rest is allowed for as if it passed in whatever moment. The same holds for all
flows that follow from x and g, and for (w − w̲) and (w̄ − w) times what a factor w acts on. Of x_j, which leaves at a
rate of at least k::

    x_j(δ) ≤ (1 − e^{−(k−κ)δ})/(k − κ)·(what enters j at the end) + (e^{Mδ} x(0))_j
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import special

from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.admissible import Admissible, IntervalRanges
from cirl_marl.optimum.kernels import bernstein_means
from cirl_marl.optimum.matrices import Layout, ProgramRows
from cirl_marl.optimum.reach import Linear

FAST = 2.0
"""Turnovers in a piece from which on a stock counts as fast. Rows for 0.5 and 8 beside it, twice as many, brought
3e-6 of the bound at most on five generated cycles with one piece a year, 1.4e-4 with five."""
WIDER, ROUND_OFF = 1.0 + 1e-9, 1e-12
"""Factor and allowance by which transients are widened; rounding errors are far smaller."""


def has_fast_stocks(admissible: Admissible, length: float) -> bool:
    """Return whether some stock counts as fast in pieces of a length, so that rows about it say something."""
    stores = len(admissible.network.stores)
    kinds = np.unique(admissible.kinds).tolist()
    return any((admissible.ranges[kind].exits[0, :stores] * length >= FAST).any() for kind in kinds)


def end_laws(ranges: IntervalRanges, equal: ProgramRows, under: ProgramRows) -> None:
    """Add the flow laws at the end of merged pieces; keys (3, piece, family, index, side)."""
    network, rate, layout = ranges.network, ranges.rate, equal.layout
    piece = np.arange(layout.pieces)[:, None]
    stores, nodes, arcs = len(network.stores), len(network.nodes), np.arange(len(network.arcs))
    schedules = np.flatnonzero(ranges.by_schedule)
    for side, sign in ((0, 1.0), (1, -1.0)):
        row = under.add(3, piece, 0, schedules, side)
        under.put(row, layout.end_flow[piece] + schedules, sign)
        under.put(row, layout.flow[0] + schedules, -sign)
        under.loosen(row, schedules, 1.0)
    proportional = np.setdiff1d(np.flatnonzero(ranges.proportional), ranges.followers)
    exact = rate[0, proportional] == rate[1, proportional]
    for rows, index, side, sign in (
        (equal, proportional[exact], 0, 1.0),
        (under, proportional[~exact], 1, 1.0),
        (under, proportional[~exact], 0, -1.0),
    ):
        row = rows.add(3, piece, 1, index, side)
        rows.put(row, layout.end_flow[piece] + index, sign)
        rows.put(row, layout.end[piece] + ranges.driver[index], -sign * rate[side, index])
    transit = np.arange(stores, nodes)
    row = np.full((layout.pieces, nodes), -1)
    row[:, stores:] = equal.add(3, piece, 2, transit)
    inflows = arcs[network.recipients >= stores]
    equal.put(row[:, network.recipients[inflows]], layout.end_flow[piece] + inflows, 1.0)
    equal.put(row[:, stores:], layout.end[piece] + transit, -1.0)
    for split in ranges.free_splits:
        least, most = ranges.valve[:, split.donor]
        if least == most:
            row = equal.add(3, piece, 3, split.donor)
            equal.put(row, layout.end_flow[piece] + split.arcs, 1.0)
            equal.put(row, layout.end[piece] + split.donor, -least * ranges.base[split.arcs[0]])
        row = equal.add(3, piece, 4, split.followers)
        equal.put(row, layout.end_flow[piece] + split.followers, 1.0)
        equal.put(row, layout.end_flow[piece] + split.leader, -split.ratio)


def quasi_steady_rows(ranges: IntervalRanges, linear: Linear, rows: ProgramRows) -> None:
    """Add the rows of theorem 3, at most 0, on an interval and the stocks before; keys (2, …)."""
    network, layout, has_schedule = ranges.network, rows.layout, ranges.by_schedule
    if (ranges.driver[~has_schedule] != network.donors[~has_schedule]).any():
        return  # what recipients pull may make a stock fall faster than in proportion to it
    stores = len(network.stores)
    least = ranges.exits[0, :stores]
    by_schedule = np.bincount(network.donors[has_schedule], minlength=stores)[:stores] > 0
    _write_held_factors(ranges, rows, ~by_schedule)
    fast = (least * layout.length >= FAST) & ~by_schedule
    _QuasiSteady(ranges, linear, rows, fast).write()


def _write_held_factors(ranges: IntervalRanges, rows: ProgramRows, usable: NDArray[np.bool_]) -> None:
    """Add that (w − w̲)·x and (w̄ − w)·x fall at most as x does; keys (2, 0, piece, arc and side, i)."""
    stores, (low, high), fastest, layout = len(usable), ranges.rate, ranges.exits[1], rows.layout
    slow = np.append(usable & (fastest[:stores] * layout.length < FAST), False)
    arcs = np.flatnonzero((low < high) & ranges.proportional & slow[np.minimum(ranges.driver, stores)])
    arcs = np.setdiff1d(arcs, ranges.followers)
    for i in range(layout.degree + 1):
        growth = _growth(fastest[ranges.driver[arcs]], layout, i)
        for side in (0, 1):
            _put_factor(ranges, rows, (0, 2 * arcs + side), arcs, side, i, growth)


def _put_factor(
    ranges: IntervalRanges, rows: ProgramRows, key: tuple[int, Integers], arcs: Integers, side: int, i: int, growth: Any
) -> Integers:
    """Write that (w − w̲)·x, or (w̄ − w)·x on side 1, is in moment i at most ``growth`` times what it is at the end."""
    (choice, index), layout = key, rows.layout
    piece = np.arange(layout.pieces)[:, None]
    moment = piece * (layout.degree + 1) + i
    sign, bound, driver = (1.0, -1.0)[side], ranges.rate[side, arcs], ranges.driver[arcs]
    row = rows.add(2, choice, piece, index, i)
    rows.put(row, layout.flow[moment] + arcs, sign)
    rows.put(row, layout.stock[moment] + driver, -sign * bound)
    rows.put(row, layout.end_flow[piece] + arcs, -sign * growth)
    rows.put(row, layout.end[piece] + driver, sign * bound * growth)
    return row


class _QuasiSteady:
    """Writes the rows of fast stores, which are given by a mask."""

    def __init__(self, ranges: IntervalRanges, linear: Linear, rows: ProgramRows, fast: NDArray[np.bool_]) -> None:
        self.ranges, self.layout, self.rows = ranges, rows.layout, rows
        self.network, self.stores = ranges.network, len(ranges.network.stores)
        self.fast = np.flatnonzero(fast)
        # out of lifetimes whose flow has a constant part
        exits = np.flatnonzero(ranges.leaves_lifetime & ~ranges.by_schedule)
        self.exits = np.intersect1d(exits, rows.layout.steady_arcs)
        self._find_sources(fast)
        gains = linear.gains.toarray()[np.ix_(fast, fast)]
        exits = np.diag(ranges.exits[0, self.fast])
        # e^{Ms} under B_0 … B_d, and e^{Mδ}, each at least as large as it is
        means, last = bernstein_means(gains - exits, rows.layout.degree, rows.layout.length)
        means = np.maximum(np.concatenate([means, last[None]]), 0.0) * WIDER + ROUND_OFF
        self.after = means[-1]
        # of every node the transient of its stock or throughput, from the fast stocks at the start
        self.transients = np.zeros((rows.layout.degree + 1, len(self.network.nodes), len(self.fast)))
        self.transients[:, self.fast] = means[:-1]
        self.transients[:, self.stores :] = linear.pass_flow.toarray()[:, fast] @ means[:-1]
        # of what is cut of a flow into a node, the most that misses in each, and of what enters stocks
        self.responses, self.arrivals = cut_responses(ranges, linear, self.fast)

    def _find_sources(self, fast: NDArray[np.bool_]) -> None:
        """Find the nodes that follow from slow stocks and schedules, and the schedules that they follow from."""
        network, arcs = self.network, np.flatnonzero(self.ranges.by_schedule)
        hands_on = np.append(fast, np.ones(len(network.nodes) - self.stores, dtype=bool))
        self.schedules = np.zeros((len(network.nodes), len(network.arcs)), dtype=bool)
        self.schedules[network.recipients[arcs], arcs] = True
        by_schedule = np.bincount(network.donors[arcs], minlength=len(network.nodes)) > 0
        wrong, before = by_schedule & ~hands_on, -1
        stock_driven = np.flatnonzero(~self.ranges.by_schedule)
        donors, recipients = network.donors[stock_driven], network.recipients[stock_driven]
        # go on along the arcs until nothing is added
        while before != (before := int(self.schedules.sum() + wrong.sum())):
            through = hands_on[recipients]
            np.logical_or.at(wrong, recipients[through], wrong[donors[through]])
            through &= hands_on[donors]
            np.logical_or.at(self.schedules, recipients[through], self.schedules[donors[through]])
        self.follows = hands_on & ~wrong
        # κ of each node: the greatest rate of the slow stocks that it follows from, but for those lifetimes
        links = np.setdiff1d(stock_driven, self.exits)
        donors, recipients = network.donors[links], network.recipients[links]
        self.fall, previous = np.zeros(len(network.nodes)), np.full(len(network.nodes), -1.0)
        while (self.fall != previous).any():
            previous = self.fall.copy()
            np.maximum.at(self.fall, recipients, np.where(hands_on, previous, self.ranges.exits[1])[donors])

    def write(self) -> None:
        """Write all rows."""
        ranges, layout, network = self.ranges, self.layout, self.network
        piece, (low, high) = np.arange(layout.pieces)[:, None], ranges.rate
        nodes = np.flatnonzero(self.follows)
        arcs = np.setdiff1d(np.flatnonzero((low < high) & ~ranges.by_schedule), ranges.followers)
        arcs = arcs[self.follows[ranges.driver[arcs]]]
        for i in range(layout.degree + 1):
            moment, growth = piece * (layout.degree + 1) + i, _growth(self.fall, layout, i)
            row = self.rows.add(2, 1, piece, nodes, i)
            self.rows.put(row, layout.stock[moment] + nodes, 1.0)
            self.rows.put(row, layout.end[piece] + nodes, -growth[nodes])
            self._allow(row, nodes, self.transients[i, nodes], growth[nodes, None] * self.responses[nodes])
            self._allow_varying(row, (layout.degree + 1) * self.responses[nodes])
            for side in (0, 1):
                key = 1, len(network.nodes) + 2 * arcs + side
                driver = ranges.driver[arcs]
                row = _put_factor(ranges, self.rows, key, arcs, side, i, growth[driver])
                spread = (high[arcs] - low[arcs])[:, None]
                responses = growth[driver, None] * self.responses[driver]
                self._allow(row, driver, spread * self.transients[i, driver], spread * responses)
                self._allow_varying(row, spread * (layout.degree + 1) * self.responses[driver])
        fast = nodes[nodes < self.stores]
        row = np.full((layout.pieces, len(network.nodes)), -1)
        row[:, fast] = self.rows.add(2, 1, piece, fast, layout.degree + 1)
        self.rows.put(row[:, fast], layout.end[piece] + fast, 1.0)
        inflows = np.flatnonzero(np.isin(network.recipients, fast))
        into = network.recipients[inflows]
        margin = (ranges.exits[0, np.minimum(into, self.stores - 1)] - self.fall[into]) * layout.length
        factor = layout.length * special.exprel(-margin) * WIDER  # (1 − e^{−(k − κ)δ})/(k − κ)
        self.rows.put(row[:, into], layout.end_flow[piece] + inflows, -factor)
        lengths = np.zeros(self.stores)
        lengths[into] = factor
        shortfall = lengths[fast, None] * self.arrivals[fast]
        self._allow(row[:, fast], fast, self.after[np.searchsorted(self.fast, fast)], shortfall)
        self._allow_varying(row[:, fast], layout.length * self.arrivals[fast])

    def _allow_varying(self, row: Integers, weight: Floats) -> None:
        """Allow rows so many times what lifetimes give, in the mean of a piece, beside what is constant.

        Args:
            row: shape (pieces, rows).
            weight: by the node that it enters, shape (rows, nodes).
        """
        layout, count = self.layout, self.layout.degree + 1
        of_exits = weight[:, self.network.recipients[self.exits]]
        place, exit_ = np.nonzero(of_exits)
        arcs, of_exits = self.exits[exit_], of_exits[place, exit_]
        columns = layout.flow.reshape(layout.pieces, 1, count) + arcs[:, None]
        self.rows.put(row[:, place, None], columns, -of_exits[:, None] / count)
        self.rows.put(row[:, place], layout.steady_column(arcs), of_exits)

    def _allow(self, row: Integers, nodes: Integers, transients: Floats, responses: Floats) -> None:
        """Allow for the transients of nodes, and for what they respond to schedules that may be cut."""
        place, source = np.nonzero(transients)
        piece = np.arange(self.layout.pieces)[:, None]
        self.rows.at_start(row[:, place], piece, self.fast[source], -transients[place, source])
        place, arcs = np.nonzero(self.schedules[nodes])
        self.rows.loosen(row[:, place], arcs, responses[place, self.network.recipients[arcs]])


def cut_responses(ranges: IntervalRanges, linear: Linear, fast: Integers) -> tuple[Floats, Floats]:
    """Return the most that an interval makes of a flow of at most 1 into each node, 0 before it.

    Fast stocks hold ∫ e^{Ms} ds times what arrives at them. The same misses where so much is cut of a flow.

    Args:
        ranges: of the interval.
        linear: what is proportional to stocks in it.
        fast: stocks that hand on; the others keep it.

    Returns:
        What fast stocks hold, time, and nodes without stock pass, shape (nodes, nodes that it enters), and what enters
        stocks, shape (stores, nodes).
    """
    network, into = ranges.network, np.eye(len(ranges.network.nodes))
    stores, interval = len(network.stores), network.episode.control_interval
    gains = linear.gains.toarray()[:, fast]
    motion = gains[fast] - np.diag(ranges.exits[0, fast])
    contents = np.maximum(bernstein_means(motion, 0, interval)[0][0] * interval, 0.0) * WIDER + ROUND_OFF
    arrivals = linear.routes.most(into)
    stocks = contents @ arrivals[fast]
    responses = np.zeros_like(into)
    responses[fast] = stocks
    responses[stores:] = linear.routes.through(into[stores:]) + linear.pass_flow.toarray()[:, fast] @ stocks
    return responses, arrivals + gains @ stocks


def _growth(rate: float | Floats, layout: Layout, i: int) -> Any:
    """Return the mean of e^{κ(δ−s)} under B_i."""
    return special.hyp1f1(layout.degree - i + 1, layout.degree + 2, rate * layout.length) * WIDER
