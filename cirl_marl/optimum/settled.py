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
from cirl_marl.optimum.kernels import weighted
from cirl_marl.optimum.layout import Layout
from cirl_marl.optimum.reach import Linear
from cirl_marl.optimum.rows import ProgramRows
from cirl_marl.optimum.shared import followers, leader

FAST = (0.5, 2.0, 8.0)
"""Turnovers in a piece from which on a stock counts as fast; there are rows for each choice."""
WIDER, ROUND_OFF = 1.0 + 1e-9, 1e-12
"""Factor and allowance by which transients are widened; rounding errors are far smaller."""


def has_fast(admissible: Admissible, length: float) -> bool:
    """Return whether some stock counts as fast in pieces of a length, so that rows about it say something."""
    stores = len(admissible.network.stores)
    kinds = np.unique(admissible.kinds).tolist()
    return any((admissible.exits(kind)[0, :stores] * length >= FAST[0]).any() for kind in kinds)


def ends(admissible: Admissible, layout: Layout, step: int, equal: ProgramRows, under: ProgramRows) -> None:
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
        donor, out = network.node_index[split.donor], np.array([*split.controlled, *split.others])
        least, most = admissible.valve[:, step, donor]
        if least == most:
            row = equal.add(3, piece, 3, donor)
            equal.put(row, layout.end_flow(piece) + out, 1.0)
            equal.put(row, layout.end(piece) + donor, -least * admissible.base[step, out[0]])
        lead, others, ratio = leader(split, step)
        row = equal.add(3, piece, 4, others)
        equal.put(row, layout.end_flow(piece) + others, 1.0)
        equal.put(row, layout.end_flow(piece) + lead, -ratio)


def settled(admissible: Admissible, layout: Layout, step: int, linear: Linear, rows: ProgramRows) -> None:
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
            writer = _Follows(admissible, layout, step, linear, rows, len(known), fast)
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


class _Follows:
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
