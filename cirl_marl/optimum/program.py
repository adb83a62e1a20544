"""The linear program that relaxes an episode: its variables, matrices and bounds (docs/bound.md).

Every piece is tested with the Bernstein polynomials B_0 … B_d of degree d: X_i and F_i are the means of stocks and
flows weighted with B_i. Integration by parts and the flow laws hold for them exactly, whatever the controls do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout
from cirl_marl.optimum.monotone import falls
from cirl_marl.optimum.objective import measures, objective
from cirl_marl.optimum.reach import ComparisonSystem, Delayed, Reach
from cirl_marl.optimum.rows import Chained, ProgramRows
from cirl_marl.optimum.scheduled import deliveries, openings, orders
from cirl_marl.optimum.settled import ends, has_fast, settled
from cirl_marl.optimum.shared import followers, passing
from cirl_marl.optimum.supplies import supplies
from cirl_marl.optimum.vintages import Lifetimes

LARGE = 30_000
"""Variables beyond which the substeps of an interval are merged, into one piece or, from degree 3 on, d − 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearProgram:
    """Minimise cᵀv subject to A v = b, G v ≤ g, l ≤ v ≤ u.

    Attributes:
        cost: c.
        equal: A, sparse.
        equal_to: b.
        under: G, sparse.
        under_to: g.
        low: l.
        high: u.
    """

    cost: Floats
    equal: Any
    equal_to: Floats
    under: Any
    under_to: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Program(LinearProgram):
    """The program of an episode, or a part of it, with finite bounds l and u; v has shape (steps · layout.size,).

    Attributes:
        layout: what v is.
        constant: what no plan changes; the objective to maximise is −cᵀv + ``constant``.
    """

    layout: Layout
    constant: float

    def interval_of_rows(self, matrix: Any) -> Integers:
        """Return the last interval whose variables each row of A or G is about, shape (rows,)."""
        return np.maximum.reduceat(matrix.indices, matrix.indptr[:-1]) // self.layout.size


class Programs:
    """The programs of a network for every start, demanded service and part of an episode.

    Attributes:
        admissible: ranges of the flows.
        layout: of the variables of an interval.
    """

    def __init__(
        self,
        admissible: Admissible,
        degree: int,
        service_weight: float | None,
        *,
        held: bool = False,
        merged: bool | None = None,
    ) -> None:
        """Write down what does not depend on the start.

        Args:
            admissible: ranges of the flows.
            degree: d of the test polynomials.
            service_weight: w of λ̄/circularity_scale + w·service; None if λ̄ is maximised.
            held: whether controls are constant within an interval to first order; the program then makes better plans
                and bounds nothing.
            merged: whether an interval has fewer pieces than the simulator has substeps; None: if the program were
                large otherwise.
        """
        self.admissible = admissible
        lifetimes = admissible.lifetimes
        living = lifetimes.planned is not lifetimes.reached
        self._system = ComparisonSystem(Admissible.of(lifetimes.reached, admissible.agents) if living else admissible)
        self.layout = layout = _layout(admissible, self._system.substeps, merged, degree)
        fading = ComparisonSystem(admissible) if living and layout.merged else self._system
        self._equal, self._under = Chained(layout), Chained(layout)
        for kind in np.unique(admissible.kinds).tolist():
            linked_equal, equal, linked_under, under = (ProgramRows(layout) for _ in range(4))
            _balances(layout, linked_equal)
            orders(admissible, layout, equal, under)
            _laws(admissible, layout, kind, equal, under)
            passing(admissible, layout, kind, equal)
            if held:
                _held(admissible, layout, kind, equal)
            deliveries(admissible, layout, kind, linked_under)
            falls(admissible, layout, kind, linked_under)
            if layout.merged:
                ends(admissible, layout, kind, equal, under)
                settled(admissible, layout, kind, fading.of_kind(kind), linked_under)
            measures(layout, admissible.served[kind], under)
            self._equal.add(kind, linked_equal, equal)
            self._under.add(kind, linked_under, under)
        self._weights, self._constant = objective(layout, service_weight)

    def at_start(self, interval: int) -> tuple[Any, Any]:
        """Return what the linked rows of A and of G have of the stocks at the start of an interval, (rows, stores)."""
        kind = int(self.admissible.kinds[interval])
        return self._equal.at_start(kind), self._under.at_start(kind)

    def program(self, initial: Floats, min_service: ArrayLike | None = None, intervals: range | None = None) -> Program:
        """Return the program from ``initial`` that gives each service the mean level demanded of it.

        Args:
            initial: stocks at the start, those with a lifetime by stage, as the simulator has them, mass.
            min_service: least mean level of every service, or of each, shape (services,), to which the last rows of G
                hold it; None if nothing is demanded.
            intervals: of the episode, one after the other; None is all of them.

        Raises:
            NoCertificate: if recipients may pull more from a node than it holds.
        """
        layout, network = self.layout, self.admissible.network
        when = range(network.episode.horizon) if intervals is None else intervals
        steps, kinds, lifetimes = len(when), self.admissible.kinds[when.start : when.stop], self.admissible.lifetimes
        reached, leaving = _reached(lifetimes, self._system, initial, when)
        asked = self.admissible.factor[1] * self.admissible.base
        cut = np.where(self.admissible.scheduled & ~reached.uncut, asked[when.start : when.stop], 0.0)
        start = lifetimes.start_planned @ initial
        equal, equal_to = self._equal.over(kinds, start, cut)
        under, under_to = self._under.over(kinds, start, cut)
        opened, opened_to = openings(self.admissible, reached, layout, when)
        supplied, supplied_to = supplies(self.admissible, reached, layout, when)
        lived, lived_to = lifetimes.rows(layout, initial, when)
        blocks, limits = [under, opened, supplied, lived], [under_to, opened_to, supplied_to, lived_to]
        if min_service is not None:
            services = len(network.services)
            levels = sparse.eye_array(services, layout.size, k=layout.level)
            blocks.append(sparse.kron(np.full((1, steps), -1.0 / steps), levels, format="csr"))
            limits.append(-np.broadcast_to(min_service, services))
        low, high = _box(self.admissible, reached, leaving, layout, when)
        return Program(
            layout=layout,
            cost=np.tile(-self._weights / steps, steps),
            constant=self._constant,
            equal=equal,
            equal_to=equal_to,
            under=sparse.vstack(blocks, format="csr"),
            under_to=np.concatenate(limits),
            low=low,
            high=high,
        )


def _reached(lifetimes: Lifetimes, system: ComparisonSystem, initial: Floats, intervals: range) -> tuple[Reach, Floats]:
    """Return what the planned network can reach, and the most that leaves lifetimes, shape (steps, lifetimes)."""
    delayed = [
        Delayed(each.reached_arc, each.reached_node, each.slots(initial), lifetimes.network.episode.control_interval)
        for each in lifetimes.lived
        if not len(each.rate)
    ]
    slots = {each.arc: each for each in delayed}
    found = system.reach(lifetimes.start_reached @ initial, intervals, delayed)
    most = [
        each.rate[intervals.start : intervals.stop] * found.upper[:, each.reached_node]
        + each.at_once * found.upper[:, each.reached_entry]
        if len(each.rate)
        else np.array([slots[each.reached_arc].most(t, found.entered) for t in range(len(intervals))])
        for each in lifetimes.lived
    ]
    upper = found.upper @ lifetimes.nodes_reached.T
    leaving = np.array(most).reshape(len(most), len(intervals)).T
    return Reach(upper, found.uncut[:, lifetimes.arcs_reached], found.entered), leaving


def _layout(admissible: Admissible, substeps: int, merged: bool | None, degree: int) -> Layout:
    network = admissible.network
    nodes = len(network.nodes)
    pieces = admissible.lifetimes.pieces(degree, substeps) if admissible.lifetimes.lived else substeps
    exits = np.bincount(network.donors[admissible.driver == network.donors], minlength=nodes)
    orders = np.bincount(network.donors[admissible.scheduled], minlength=nodes)
    movable = (admissible.valve[0] < admissible.valve[1]).any(axis=0)
    openings = np.flatnonzero(movable & (exits > 0) & (orders > 0))
    valves = np.flatnonzero(movable & ((exits > 1) | (exits > 0) & (orders > 0)))
    fine = Layout(network, pieces, pieces < substeps, False, degree, valves, openings)
    few = max(1, degree - 1)
    if pieces > few and (fine.size * network.episode.horizon > LARGE if merged is None else merged):
        coarse = replace(fine, pieces=few, coarse=True)
        return replace(coarse, merged=True) if merged or has_fast(admissible, coarse.length) else coarse
    return fine


def _balances(layout: Layout, rows: ProgramRows) -> None:
    """Add Y_i − Y_{i−1} − δ/(d + 1)·S F_i, which is 0, for i = 0 … d (theorem 1); keys (moment, node).

    Y_i = ((d − i) X_i + (i + 1) X_{i+1})/(d + 1) are the means weighted with the polynomials of degree d − 1;
    Y_{−1} and Y_d are the stocks at the two ends of the piece, δ its length.
    """
    network, d = layout.network, layout.degree
    moment, node = layout.moment_column, np.arange(len(network.stores))
    row = rows.add(moment, node)
    for side, sign in ((network.donors, 1.0), (network.recipients, -1.0)):
        arcs = np.flatnonzero(side < len(node))
        rows.put(row[:, side[arcs]], layout.flow(moment) + arcs, sign * layout.portion)
    for j in layout.moments:
        piece, i = divmod(j, d + 1)
        if i < d:  # Y_i
            rows.put(row[j], layout.stock(j) + node, (d - i) / (d + 1))
            rows.put(row[j], layout.stock(j + 1) + node, (i + 1) / (d + 1))
        else:
            rows.put(row[j], layout.end(piece) + node, 1.0)
        if i > 0:  # − Y_{i−1}
            rows.put(row[j], layout.stock(j - 1) + node, -(d - i + 1) / (d + 1))
            rows.put(row[j], layout.stock(j) + node, -i / (d + 1))
        else:
            rows.at_start(row[j], piece, node, -1.0)


def _laws(admissible: Admissible, layout: Layout, step: int, equal: ProgramRows, under: ProgramRows) -> None:
    """Add the flow laws of an interval: rows that are 0 and rows at most 0; keys (0, moment, what, which, side)."""
    network, moment = admissible.network, layout.moment_column

    def hold(what: int, which: Integers, column: Integers, driver: Integers, factor: Floats) -> None:
        """Hold low·driver ≤ column ≤ high·driver, with columns of shape (moments, which)."""
        low, high = factor
        given = low == high
        row = equal.add(0, moment, what, which[given])
        equal.put(row, column[:, given], 1.0)
        equal.put(row, driver[:, given], -low[given])
        for side, sign, bound in ((0, 1.0, high), (1, -1.0, low)):
            row = under.add(0, moment, what, which[~given], side)
            under.put(row, column[:, ~given], sign)
            under.put(row, driver[:, ~given], -sign * bound[~given])

    valves, driven = layout.valves, ~admissible.scheduled & ~admissible.lived
    arcs = np.setdiff1d(np.flatnonzero(driven), followers(admissible, step))
    place = np.arange(len(valves))
    hold(1, place, layout.valve(moment) + place, layout.stock(moment) + valves, admissible.valve[:, step, valves])
    # behind a valve that several outflows share F_i = w·a·Z_i with Z_i = v·X_i; else F_i = v·w·a·X_i
    driver = admissible.driver[arcs]
    through = (network.donors[arcs] == driver) & np.isin(driver, valves)
    factor = np.where(through, admissible.own[:, step, arcs], admissible.factor[:, step, arcs])
    behind = layout.valve(moment) + np.searchsorted(valves, driver)
    column = np.where(through, behind, layout.stock(moment) + driver)
    hold(2, arcs, layout.flow(moment) + arcs, column, factor * admissible.base[step, arcs])


def _held(admissible: Admissible, layout: Layout, step: int, rows: ProgramRows) -> None:
    """Add F_i − F_{i−1} − r (X_i − X_{i−1}), r = v·w·a at neutral, and the same for Z; keys (1, moment, what, which).

    For a constant factor r' it is (r' − r)(X_i − X_{i−1}), a product of two differences, here held at 0.
    """
    moment = layout.moment_column[1:]
    free = ~admissible.scheduled & ~admissible.lived & (admissible.factor[0, step] < admissible.factor[1, step])
    arcs, valves = np.flatnonzero(free), np.arange(len(layout.valves))
    opened = admissible.neutral_valve[step, layout.valves]
    parts = (
        (0, arcs, layout.flow, arcs, admissible.driver[arcs], admissible.neutral_rate[step, arcs]),
        (1, valves, layout.valve, valves, layout.valves, opened),
    )
    for what, which, first, place, driver, rate in parts:
        row = rows.add(1, moment, what, which)
        for at, sign in ((moment, 1.0), (moment - 1, -1.0)):
            rows.put(row, first(at) + place, sign)
            rows.put(row, layout.stock(at) + driver, -sign * rate)


def _box(
    admissible: Admissible, reached: Reach, leaving: Floats, layout: Layout, intervals: range
) -> tuple[Floats, Floats]:
    """Return the lowest and highest value of every variable; all are finite, which makes every multiplier a bound."""
    network = admissible.network
    low, high = np.zeros((2, len(intervals), layout.size))
    scheduled = admissible.scheduled
    during = slice(intervals.start, intervals.stop)
    rates, valve = (admissible.factor * admissible.base)[:, during], admissible.valve[:, during]
    # no weighted mean exceeds the supremum: F ≤ r̄·x̄_p, and U ≤ ū; U ≥ u̲ only where nothing is ever cut
    most = rates[1] * np.where(scheduled, 1.0, reached.upper[:, admissible.driver])
    least = np.where(scheduled & reached.uncut, rates[0], 0.0)
    most[:, admissible.lifetimes.leaving] = leaving
    for i in layout.moments:
        high[:, layout.stock(i) : layout.flow(i)] = reached.upper
        high[:, layout.flow(i) : layout.valve(i)] = most
        low[:, layout.flow(i) : layout.valve(i)] = least
        high[:, layout.valve(i) :][:, : len(layout.valves)] = (reached.upper * valve[1])[:, layout.valves]
    for piece in range(layout.pieces):
        last = layout.end(piece)
        high[:, last : last + len(network.stores)] = reached.upper[:, : len(network.stores)]
        if layout.merged:
            high[:, last : last + len(network.nodes)] = reached.upper
            high[:, layout.end_flow(piece) :][:, : len(network.arcs)] = most
            low[:, layout.end_flow(piece) :][:, : len(network.arcs)] = least
    high[:, layout.level : layout.imbalance] = 1.0
    weights = network.objective.reference_interval * np.abs(network.sustainability * network.environmental)
    high[:, layout.imbalance] = most @ weights
    low[:, layout.opening :], high[:, layout.opening :] = valve[:, :, layout.openings]
    return low.ravel(), high.ravel()
