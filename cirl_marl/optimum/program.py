"""The linear program that relaxes an episode: its variables, matrices and bounds (docs/bound.md).

Every piece is tested with the Bernstein polynomials B_0 … B_d of degree d: X_i and F_i are the means of stocks and
flows weighted with B_i. Integration by parts and the flow laws hold for them exactly, whatever the controls do.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout, Link, MatrixRow, matrix_of, start_of
from cirl_marl.optimum.monotone import falls
from cirl_marl.optimum.objective import measures, objective
from cirl_marl.optimum.reach import ComparisonSystem, Reach
from cirl_marl.optimum.scheduled import deliveries, openings


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
        self, admissible: Admissible, degree: int, service_weight: float | None, *, held: bool = False
    ) -> None:
        """Write down what does not depend on the start.

        Args:
            admissible: ranges of the flows.
            degree: d of the test polynomials.
            service_weight: w of λ̄/circularity_scale + w·service; None if λ̄ is maximised.
            held: whether controls are constant within an interval to first order; the program then makes better plans
                and bounds nothing.
        """
        self.admissible = admissible
        self._system = ComparisonSystem(admissible)
        self.layout = layout = _layout(admissible, self._system.substeps, degree)
        equal, under = _laws(admissible, layout)
        if held:
            equal += _held(admissible, layout)
        self._equal = _Chained(_balances(layout), equal, layout)
        falling = [*deliveries(admissible, layout), *falls(admissible, layout)]
        self._under = _Chained(falling, [*under, *measures(layout)], layout)
        self._weights, self._constant = objective(layout, service_weight)

    def program(self, initial: Floats, min_service: ArrayLike | None = None, intervals: range | None = None) -> Program:
        """Return the program from ``initial``, shape (nodes,), that gives each service the mean level demanded of it.

        Args:
            initial: stocks at the start, mass.
            min_service: least mean level of every service, or of each, shape (services,), to which the last rows of G
                hold it; None if nothing is demanded.
            intervals: of the episode, one after the other; None is all of them.

        Raises:
            NoCertificate: if recipients may pull more from a node than it holds.
        """
        layout, network = self.layout, self.admissible.network
        when = range(network.episode.horizon) if intervals is None else intervals
        steps = len(when)
        reached = self._system.reach(initial, when)
        equal, equal_to = self._equal.over(steps, initial)
        under, under_to = self._under.over(steps, initial)
        opened, opened_to = openings(self.admissible, reached, layout, when)
        blocks, limits = [under, opened], [under_to, opened_to]
        if min_service is not None:
            services = len(network.services)
            levels = sparse.eye_array(services, layout.size, k=layout.level)
            blocks.append(sparse.kron(np.full((1, steps), -1.0 / steps), levels, format="csr"))
            limits.append(-np.broadcast_to(min_service, services))
        low, high = _box(self.admissible, reached, layout, when)
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


def _layout(admissible: Admissible, pieces: int, degree: int) -> Layout:
    network = admissible.network
    nodes = len(network.nodes)
    exits = np.bincount(network.donors[admissible.driver == network.donors], minlength=nodes)
    orders = np.bincount(network.donors[admissible.scheduled], minlength=nodes)
    movable = admissible.valve[0] < admissible.valve[1]
    openings = np.flatnonzero(movable & (exits > 0) & (orders > 0))
    valves = np.flatnonzero(movable & ((exits > 1) | (exits > 0) & (orders > 0)))
    return Layout(network, pieces, degree, valves, openings)


class _Chained:
    """Rows that are repeated in every interval, some of which link it to the interval before."""

    def __init__(self, linked: Sequence[Link], alone: Sequence[MatrixRow], layout: Layout) -> None:
        """Take the rows of an interval.

        Args:
            linked: pairs of rows on this interval's variables and on those of the one before, of which only the stocks
                at the end are used.
            alone: rows on this interval's variables.
            layout: of an interval.
        """
        self._layout = layout
        self._now, self._before = (matrix_of([link[side] for link in linked], layout) for side in (0, 1))
        self._alone = matrix_of(alone, layout)
        self._known: dict[int, Any] = {}

    def over(self, steps: int, initial: Floats) -> tuple[Any, Floats]:
        """Return the matrix over ``steps`` intervals, interval after interval, and the right-hand side."""
        if steps not in self._known:
            # block (t, t) holds the rows of interval t, block (t, t − 1) reaches back for the stocks it starts from
            once, shifted = sparse.eye_array(steps), sparse.eye_array(steps, k=-1)
            linked = sparse.kron(once, self._now) + sparse.kron(shifted, self._before)
            self._known[steps] = sparse.vstack([linked, sparse.kron(once, self._alone)], format="csr")
        # there is no interval before the first: its entries meet known stocks and go to the right-hand side
        layout, matrix = self._layout, self._known[steps]
        first = np.zeros(layout.size)
        first[layout.end(-1) : layout.level] = initial
        to = np.zeros(matrix.shape[0])
        to[: self._before.shape[0]] = -(self._before @ first)
        return matrix, to


def _balances(layout: Layout) -> list[Link]:
    """Return Y_i − Y_{i−1} − δ/(d + 1)·S F_i, which is 0, for i = 0 … d.

    Y_i = ((d − i) X_i + (i + 1) X_{i+1})/(d + 1) are the means weighted with the polynomials of degree d − 1;
    Y_{−1} and Y_d are the stocks at the two ends of the piece, δ its length.
    """
    network, d = layout.network, layout.degree
    links: list[Link] = []
    for j in layout.moments:
        piece, i = divmod(j, d + 1)
        for node in range(len(network.nodes)):
            row = _lower_degree(layout, j, node, 1.0)  # Y_i − Y_{i−1} = δ/(d + 1)·S F_i (theorem 1)
            before: MatrixRow = []
            if i > 0:
                row += _lower_degree(layout, j - 1, node, -1.0)
            else:
                start, before = start_of(layout, piece, node, -1.0)
                row += start
            row += [(layout.flow(j) + int(k), layout.portion) for k in np.flatnonzero(network.donors == node)]
            row += [(layout.flow(j) + int(k), -layout.portion) for k in np.flatnonzero(network.recipients == node)]
            links.append((row, before))
    return links


def _lower_degree(layout: Layout, moment: int, node: int, sign: float) -> list[tuple[int, float]]:
    """Return sign·Y_i, the mean weighted with B_i^{d−1}, raised to degree d; Y_d is the stock at the end."""
    d = layout.degree
    piece, i = divmod(moment, d + 1)
    if i == d:
        return [(layout.end(piece) + node, sign)]
    return [
        (layout.stock(moment) + node, sign * (d - i) / (d + 1)),
        (layout.stock(moment + 1) + node, sign * (i + 1) / (d + 1)),
    ]


def _laws(admissible: Admissible, layout: Layout) -> tuple[list[MatrixRow], list[MatrixRow]]:
    """Return the rows of the flow laws: those equal to 0 and those at most 0."""
    network = admissible.network
    position = {int(node): z for z, node in enumerate(layout.valves)}
    equal: list[MatrixRow] = []
    under: list[MatrixRow] = []

    def hold(column: int, driver: int, low: float, high: float) -> None:
        """Hold low·driver ≤ column ≤ high·driver."""
        if low == high:
            equal.append([(column, 1.0), (driver, -low)])
        else:
            under.extend(([(column, 1.0), (driver, -high)], [(column, -1.0), (driver, low)]))

    for i in layout.moments:
        first = i - i % (layout.degree + 1)
        if i > first:  # a scheduled flow is constant in its piece: F_i = F_0
            for k in np.flatnonzero(admissible.scheduled):
                equal.append([(layout.flow(i) + int(k), 1.0), (layout.flow(first) + int(k), -1.0)])
        for node, z in position.items():
            hold(layout.valve(i) + z, layout.stock(i) + node, *admissible.valve[:, node])
        for k in np.flatnonzero(~admissible.scheduled):
            donor, driver = int(network.donors[k]), int(admissible.driver[k])
            # behind a valve that several outflows share F_i = w·a·Z_i with Z_i = v·X_i; else F_i = v·w·a·X_i
            through_valve = donor == driver and donor in position
            factor = admissible.own[:, k] if through_valve else admissible.factor[:, k]
            column = layout.valve(i) + position[donor] if through_valve else layout.stock(i) + driver
            hold(layout.flow(i) + int(k), column, *(factor * admissible.base[0, k]))
    return equal, under


def _held(admissible: Admissible, layout: Layout) -> list[MatrixRow]:
    """Return F_i − F_{i−1} − r (X_i − X_{i−1}), r = v·w·a at neutral, and the same for Z.

    For a constant factor r' it is (r' − r)(X_i − X_{i−1}), a product of two differences, here held at 0.
    """
    network = admissible.network
    neutral = FlowLaws(network)
    rate = neutral.rate(neutral.neutral[:, :1])[:, 0]
    free = ~admissible.scheduled & (admissible.factor[0] < admissible.factor[1])
    pairs = [(layout.flow, int(k), int(admissible.driver[k]), float(rate[k])) for k in np.flatnonzero(free)]
    for z, node in enumerate(layout.valves):
        control = network.nodes[node].control
        assert control is not None
        pairs.append((layout.valve, z, int(node), control.neutral))
    return [
        [(first(i) + place, 1.0), (first(i - 1) + place, -1.0), (layout.stock(i) + p, -r), (layout.stock(i - 1) + p, r)]
        for i in layout.moments[1:]
        for first, place, p, r in pairs
    ]


def _box(admissible: Admissible, reached: Reach, layout: Layout, intervals: range) -> tuple[Floats, Floats]:
    """Return the lowest and highest value of every variable; all are finite, which makes every multiplier a bound."""
    network = admissible.network
    low, high = np.zeros((2, len(intervals), layout.size))
    scheduled = admissible.scheduled
    rates = admissible.factor[:, None] * admissible.base[intervals.start : intervals.stop]
    # no weighted mean exceeds the supremum: F ≤ r̄·x̄_p, and U ≤ ū; U ≥ u̲ only where nothing is ever cut
    most = rates[1] * np.where(scheduled, 1.0, reached.upper[:, admissible.driver])
    least = np.where(scheduled & reached.uncut, rates[0], 0.0)
    for i in layout.moments:
        high[:, layout.stock(i) : layout.flow(i)] = reached.upper
        high[:, layout.flow(i) : layout.valve(i)] = most
        low[:, layout.flow(i) : layout.valve(i)] = least
        high[:, layout.valve(i) :][:, : len(layout.valves)] = (reached.upper * admissible.valve[1])[:, layout.valves]
    for piece in range(layout.pieces):
        high[:, layout.end(piece) : layout.end(piece) + len(network.nodes)] = reached.upper
    high[:, layout.level : layout.imbalance] = 1.0
    weights = network.objective.reference_interval * np.abs(network.sustainability * network.environmental)
    high[:, layout.imbalance] = most @ weights
    low[:, layout.opening :], high[:, layout.opening :] = admissible.valve[:, None, layout.openings]
    return low.ravel(), high.ravel()
