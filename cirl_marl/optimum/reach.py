"""Bounds of every stock that hold for any actions: a linear comparison system for the lowest and highest stocks.

The least inflow and the greatest outflow of each node give the system of x̲, the opposite that of x̄. In the coordinates
(x̲, −x̄) it has no negative entry off its diagonal, so its solution stays below (x, −x) for every control (Müller 1927,
Kamke 1932). Scheduled flows are cut when their donor cannot deliver; where x̲ excludes that, the flow asked for is the
flow realised.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

from cirl_marl.dynamics.laws import ArcRates
from cirl_marl.dynamics.visit_bounds import VisitBounds
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.admissible import Admissible, IntervalRanges, NoCertificate
from cirl_marl.optimum.matrices import IntervalCache
from cirl_marl.optimum.vintages import WholeLifetime

DENSE = 64
"""Rows of the largest system whose solution is kept as matrices. Of 256 rows these take 50 ms, the series 0.2 ms."""
TRUNCATION = 1e-17
"""Sum of the terms of the series that are left out, relative to the change that the first term makes."""
ROUNDING = 1e-9
"""Relative widening of every bound; rounding errors are far smaller."""
LEAST_FALL = 1e-3
"""Relative fall of an upper bound in a round below which no further is made."""
ROUNDS = 1000
"""Most such rounds."""
ROUND_OFF = 1e-13
"""Mass by which bounds are widened in each substep, relative to the mass in the network."""


class ZeroOrderHold:
    """x after a substep h, e^{Mh} x + ∫ e^{Ms} c ds, of a sparse matrix M.

    Of a small system both matrices are kept. Of a large one they would be full, so the series
    x + h Σ_k (Mh)^k/(k + 1)! (M x + c) is summed. With μ = ‖Mh‖₁ the terms from K on are, in the 1-norm, at most
    μ^K/(K + 1)!·1/(1 − μ/(K + 2)) of the first, since each is at most μ/(K + 2) of the one before.
    """

    def __init__(self, matrix: Any, interval: float) -> None:
        """Take M, in coordinates, 1/time, and h."""
        self._size, self._interval = matrix.shape[0], interval
        if self._size <= DENSE:
            # exp of [[M, I], [0, 0]]·h has both in its upper blocks (Van Loan 1978)
            size = self._size
            blocks = np.zeros((2 * size, 2 * size))
            blocks[:size, :size], blocks[:size, size:] = matrix.toarray(), np.eye(size)
            exponential = linalg.expm(blocks * interval)
            self._solution, self._response = exponential[:size, :size], exponential[:size, size:]
            return
        self._matrix = sparse.csr_array(matrix)
        norm = float(abs(self._matrix).sum(axis=0).max(initial=0.0)) * interval
        self._terms, term = 1, norm / 2  # the first term that is left out, relative to the first
        while norm >= self._terms + 2 or term / (1 - norm / (self._terms + 2)) > TRUNCATION:
            self._terms += 1
            term *= norm / (self._terms + 1)
        self._truncation = term / (1 - norm / (self._terms + 2))

    def __call__(self, state: Floats, constant: Floats) -> tuple[Floats, float]:
        """Return x after the substep, from ``state`` and with c = ``constant``, and how far off it may be at most."""
        if self._size <= DENSE:
            return self._solution @ state + self._response @ constant, 0.0
        term = self._interval * (self._matrix @ state + constant)
        error = self._truncation * float(np.abs(term).sum())
        after = state + term
        for k in range(1, self._terms):
            term = self._matrix @ term * (self._interval / (k + 1))
            after += term
        return after, error


class RouteBounds:
    """What passes through nodes that store nothing, per mass that enters them, in one interval, whatever the shares.

    With the least shares P̲ among these nodes and R̲ into stocks, at least (I − P̲)⁻¹ R̲ arrives. The greatest number of
    visits V_ij to node j by what enters i solves V = I + max_s P(s) V, a Markov decision process; from a V that is too
    large this iteration falls towards it, so any iterate bounds it. What enters i reaches a stock in a share of at most
    V_i R̄, and of at most 1.

    Attributes:
        longest: most visits of all nodes together, at least 1.
        visits: V, shape (nodes, nodes).
    """

    def __init__(
        self, ranges: IntervalRanges, visit_bounds: VisitBounds, step: int, wider: RouteBounds | None = None
    ) -> None:
        """Take the ranges of shares in interval ``step``; the visits of ``wider`` ranges are where to begin from."""
        network = ranges.network
        stores, nodes = len(network.stores), len(network.nodes)
        self._stores, inner = stores, nodes - stores
        arcs = np.flatnonzero(network.donors >= stores)
        places = (network.donors[arcs] - stores, network.recipients[arcs])
        low, high = (sparse.csc_array((rate, places), shape=(inner, nodes)) for rate in ranges.rate[:, arcs])
        total = visit_bounds.total(step)
        arrivals = _least_arrivals(low[:, stores:], low[:, :stores].toarray(), total)
        self.longest = float(total.max(initial=1.0))
        visits, fewer = np.repeat(total[:, None], inner, axis=1), np.empty(0)
        if wider is not None:
            fewer = np.eye(inner) + visit_bounds.best(wider.visits, step)
            if (fewer <= wider.visits * (1 + ROUNDING)).all():  # a bound: V ≥ I + max_s P(s) V
                visits = np.minimum(visits, wider.visits * (1 + ROUNDING))
        for _ in range(ROUNDS if inner else 0):
            fewer = np.minimum(visits, np.eye(inner) + visit_bounds.best(visits, step))
            fall = (visits - fewer).max()
            visits = fewer
            if fall <= LEAST_FALL * visits.max():
                break
        most = np.minimum(visits @ high[:, :stores].toarray(), 1.0)
        self._least = sparse.csr_array(arrivals.T * (1 - ROUNDING))
        self._most = sparse.csr_array(most.T * (1 + ROUNDING))
        self.visits: Floats = visits
        self._visits = sparse.csr_array(visits.T * (1 + ROUNDING))

    def least(self, inflow: Any) -> Any:
        """Return the least that stocks get of what enters nodes, shape (nodes, …) → (stores, …)."""
        return inflow[: self._stores] + self._least @ inflow[self._stores :]

    def most(self, inflow: Any) -> Any:
        """Return the most that stocks get, likewise."""
        return inflow[: self._stores] + self._most @ inflow[self._stores :]

    def through(self, inflow: Any) -> Any:
        """Return the most that passes through the nodes that store nothing, given what enters these from elsewhere."""
        return self._visits @ inflow


def _least_arrivals(shares: Any, arrivals: Floats, visits: Floats) -> Floats:
    """Return a lower bound of A = (I − P̲)⁻¹ R̲ that is as near as its equation can be solved.

    No inverse of I − P̲ has a negative entry, so what exceeds R̲ + P̲ A by at most η is too large by at most η visits.

    Args:
        shares: P̲, sparse, shape (nodes, nodes).
        arrivals: R̲, shape (nodes, stores).
        visits: most visits of all nodes together by what enters each, shape (nodes,).
    """
    if not len(visits):
        return arrivals
    solution = splu(sparse.eye_array(len(visits), format="csc") - shares).solve(arrivals)
    excess = max(float((solution - arrivals - shares @ solution).max(initial=0.0)), 0.0)
    excess += 8 * float(np.finfo(float).eps)
    least: Floats = np.maximum(solution - excess * visits[:, None], 0.0)
    return least


@positional_record
class Reach:
    """What the stocks can be."""

    upper: Annotated[
        Floats, "most in each stock, mass, or through a node that stores nothing, mass/time, shape (steps, nodes)"
    ]
    delivered: Annotated[Floats, "least part of what is asked that donors deliver, whatever the actions, (steps, arcs)"]
    inflow: Annotated[Floats, "most that enters each stock in each interval, shape (steps, stores), mass"]
    chord: Annotated[
        Floats, "that part per stock of the donor at the start of a substep, at least, (steps, arcs), 1/mass"
    ]

    @property
    def uncut(self) -> NDArray[np.bool_]:
        """Whether donors deliver all that is asked, shape (steps, arcs)."""
        return np.asarray(self.delivered >= 1.0)


class ComparisonSystem:
    """The comparison system, advanced by the substeps of the simulator, in which scheduled flows are constant.

    Attributes:
        substeps: of the simulator in an interval.
    """

    def __init__(self, admissible: Admissible, cache: IntervalCache | None = None) -> None:
        """Compile the system for the ranges of ``admissible``; ``cache`` is that of its programs, see there."""
        self.admissible, self.network = admissible, admissible.network
        self.substeps = ArcRates(admissible.network).solver_steps()
        self.substep = self.network.episode.control_interval / self.substeps
        self._visit_bounds = VisitBounds(admissible.network, admissible.splits)
        self._cache = cache
        self._routes: dict[bytes, RouteBounds] = {}
        self._linear: dict[int, Linear] = {}

    def reach(
        self, initial: Floats, intervals: range, delay_lines: Sequence[tuple[WholeLifetime, Floats]] = ()
    ) -> Reach:
        """Bound the stocks from ``initial``, shape (stores,), on, over the given intervals of the episode.

        What comes out of ``delay_lines``, fixed lifetimes and what is in their slots, is at most what entered so many
        intervals before.

        Raises:
            NoCertificate: if recipients may pull more from a node than it holds: the solver then departs from the laws.
        """
        network, schedules = self.network, self.admissible.by_schedule
        nodes, stores, steps = len(network.nodes), len(network.stores), len(intervals)
        duration = network.episode.control_interval
        mass = float(initial.sum()) * (1 + ROUNDING)
        lower, upper = initial.copy(), initial.copy()
        highest, inflow = np.zeros((steps, nodes)), np.zeros((steps, stores))
        # components of changing sources are cut as the shortest of them
        mixtures, together = self.admissible.mixtures, np.empty((1, 0), dtype=np.intp)
        if mixtures is not None:
            together = mixtures.arcs[:, mixtures.has_grade]
        delivered, chord = np.ones((steps, len(network.arcs))), np.full((steps, len(network.arcs)), np.inf)
        for step, interval in enumerate(intervals):
            least, most = np.where(schedules, self.admissible.rate[:, interval], 0.0)
            for line, slots in delay_lines:
                least[line.reached_arc], most[line.reached_arc] = 0.0, line.most_out(slots, step, inflow) / duration
            linear = self.of_interval(interval)
            node_inflow, outflow = self._by_node(most)
            stock_inflow = linear.routes.most(node_inflow)
            for _ in range(self.substeps):
                # without any outflow no stock ends a substep lower than it began, so this bounds it throughout
                peak, error = linear.growth(upper, stock_inflow)
                inflow[step] += np.maximum(peak + error - upper, 0.0)
                peak = np.minimum(peak + error, mass) * (1 + ROUNDING)
                highest[step, :stores] = np.maximum(highest[step, :stores], peak)
                # what may be asked in this piece, against what is left at the least: nothing is cut where it suffices
                asked = (outflow + linear.pull @ peak) * self.substep
                available = lower * linear.share * (1 - ROUNDING)
                enough = asked <= available
                if (linear.has_pull & ~enough).any():
                    node = network.nodes[int((linear.has_pull & ~enough).argmax())].id
                    raise NoCertificate(
                        f"network '{network.name}': recipients may pull more from node '{node}' than it holds in "
                        f"interval {interval}; no bound is proved for what the solver then does"
                    )
                # nodes that store nothing have no entry of their own: what they pass on is never cut
                part = np.divide(available, asked, out=np.ones(stores), where=~enough)
                part = np.append(part, 1.0)[np.minimum(network.donors, stores)]
                part[together] = part[together].min(axis=0)
                delivered[step] = np.minimum(delivered[step], part)
                # what is delivered is concave in the stock x, min(1, x·share/asked), so it lies above its chord from 0
                least_part = np.minimum(
                    1.0, np.divide(upper * linear.share, asked, out=np.ones(stores), where=asked > 0)
                )
                slope = np.divide(
                    least_part * (1 - ROUNDING), upper, out=np.zeros(stores), where=upper > ROUNDING * mass
                )
                slope = np.append(slope, 0.0)[np.minimum(network.donors, stores)]
                slope[together] *= part[together] >= 1.0  # others may be short earlier
                chord[step] = np.minimum(chord[step], slope)
                least_in, least_out = self._by_node(least * part)
                constant = np.concatenate([linear.routes.least(least_in) - outflow, stock_inflow - least_out])
                bounds, error = linear.solution(np.concatenate([lower, upper]), constant)
                error += mass * ROUND_OFF
                lower = np.maximum(bounds[:stores] - error, 0.0)
                upper = np.minimum(bounds[stores:] + error, mass)
            highest[step, stores:] = linear.routes.through(
                node_inflow[stores:] + linear.pass_inflow @ highest[step, :stores]
            )
        delivered[:, [line.reached_arc for line, _ in delay_lines]] = 1.0  # a slot holds what comes out of it
        return Reach(highest, delivered, inflow, chord)

    def _by_node(self, flow: Floats) -> tuple[Floats, Floats]:
        """Return the sums of flows into each node, shape (nodes,), and out of each stock, shape (stores,)."""
        network, nodes = self.network, len(self.network.nodes)
        inflow, outflow = (
            np.bincount(side, flow, nodes).astype(float) for side in (network.recipients, network.donors)
        )
        return inflow, outflow[: len(network.stores)]

    def __getstate__(self) -> dict[str, object]:
        """Leave out what is found again when it is needed, and large."""
        return {**self.__dict__, "_routes": {}, "_linear": {}, "_cache": None}

    def of_interval(self, interval: int) -> Linear:
        """Return what is proportional to stocks in an interval."""
        kind = int(self.admissible.kinds[interval])
        if kind not in self._linear:
            self._linear[kind] = self._linear_of(kind)
        return self._linear[kind]

    def _linear_of(self, kind: int) -> Linear:
        admissible, cache = self.admissible, self._cache
        if cache is None:
            return Linear(admissible.ranges[kind], self._routes_of(kind), self.substep)
        shares, size = self._share_rates(kind).tobytes(), len(self.network.nodes)

        def routes() -> RouteBounds:  # what is found must not depend on what else there is: it begins from nowhere
            return RouteBounds(admissible.ranges[kind], self._visit_bounds, kind)

        def linear() -> Linear:
            return Linear(admissible.ranges[kind], cache.value(("routes", size, shares), routes), self.substep)

        return cache.value(("linear", size, self.substep, admissible.key(kind)), linear)

    def _share_rates(self, kind: int) -> Floats:
        """Return the least and greatest shares of what leaves nodes that store nothing, shape (2, some arcs)."""
        rates: Floats = self.admissible.rate[:, kind, self.network.donors >= len(self.network.stores)]
        return rates

    @cached_property
    def _widest(self) -> int:
        """The kind of intervals in which the ranges of these shares are widest; from there the others begin."""
        widths = {
            int(kind): np.diff(self._share_rates(kind), axis=0).sum() for kind in np.unique(self.admissible.kinds)
        }
        return max(widths, key=lambda kind: widths[kind])

    def _routes_of(self, kind: int) -> RouteBounds:
        """Return what holds in a kind of interval, found from what holds where ranges are widest."""
        key = self._share_rates(kind).tobytes()
        if key not in self._routes:
            wider = None if kind == self._widest else self._routes_of(self._widest)
            self._routes[key] = RouteBounds(self.admissible.ranges[kind], self._visit_bounds, kind, wider)
        return self._routes[key]


class Linear:
    """What is proportional to stocks in a kind of interval.

    Attributes:
        routes: what passes through nodes that store nothing.
        solution: of the lowest and the highest stocks after a substep, shape (2 stores,).
        gains: most that each stock gets, per stock, sparse, 1/time.
        growth: the highest stocks after a substep, had they no outflow, shape (stores,).
        pass_inflow: most that enters each node that stores nothing, per stock, sparse, 1/time.
        pass_flow: most that passes through these, likewise.
        pull: most that recipients pull from each stock, per stock, sparse, 1/time.
        has_pull: stocks from which they do.
        share: z/(e^z − 1) for the most that leaves a stock in proportion to it in a substep, z.
    """

    def __init__(self, ranges: IntervalRanges, routes: RouteBounds, substep: float) -> None:
        """Compile it for the intervals of one kind."""
        network, self.routes = ranges.network, routes
        stores, nodes = len(network.stores), len(network.nodes)
        arcs = ~ranges.by_schedule & (network.donors < stores)
        low, high = ranges.rate[:, arcs]
        donor, recipient, driver = network.donors[arcs], network.recipients[arcs], ranges.driver[arcs]
        pulls, split = donor != driver, ranges.share_arcs[arcs]
        release, exits = ranges.release[:, :stores], ranges.exits[:, :stores]

        def inflow(rate: Floats, mask: NDArray[np.bool_]) -> Any:
            return sparse.csr_array((rate[mask], (recipient[mask], driver[mask])), shape=(nodes, stores))

        # what a stock releases in shares arrives once, at once or past nodes that store nothing
        past = ~split & (recipient >= stores)
        least = sparse.coo_array(routes.least(inflow(low, past | split)))
        once = sparse.coo_array(routes.most(inflow(high, split)))
        once.data = np.minimum(once.data, release[1, once.col])
        most = sparse.coo_array(routes.most(inflow(high, past)) + once)
        # rows and columns: x̲ of all stocks, then x̄. x̲ gains the least inflow and loses the greatest outflow, x̄ the
        # opposite; growth has no outflow at all
        shift = np.where(pulls, stores, 0)  # what leaves at the least x̲ is driven by x̲ itself or by x̄ elsewhere
        straight = ~split & ~past
        mask = np.stack([straight, straight, ~split, ~split], axis=1)
        diagonal = np.arange(stores)
        rows = np.stack([recipient, stores + recipient, donor, stores + donor], axis=1)[mask]
        columns = np.stack([driver, stores + driver, shift + driver, stores - shift + driver], axis=1)[mask]
        values = np.stack([low, high, -high, -low], axis=1)[mask]
        rows = np.concatenate([rows, least.row, stores + most.row, diagonal, stores + diagonal])
        columns = np.concatenate([columns, least.col, stores + most.col, diagonal, stores + diagonal])
        values = np.concatenate([values, least.data, most.data, -release[1], -release[0]])
        matrix = sparse.coo_array((values, (rows, columns)), shape=(2 * stores, 2 * stores))
        self.solution = ZeroOrderHold(matrix, substep)
        places = (np.append(recipient[straight], most.row), np.append(driver[straight], most.col))
        values = np.append(high[straight], most.data)
        self.gains = sparse.csr_array(sparse.coo_array((values, places), shape=(stores, stores)))
        self.growth = ZeroOrderHold(self.gains, substep)
        self.pass_inflow = inflow(high, past | split)[stores:]
        self.pass_flow = routes.through(self.pass_inflow)
        entries = (high[pulls], (donor[pulls], driver[pulls]))
        self.pull = sparse.csr_array(sparse.coo_array(entries, shape=(stores, stores)))
        self.has_pull = np.bincount(donor[pulls], minlength=stores) > 0
        z = exits[1] * substep
        self.share = np.divide(z, np.expm1(z), out=np.ones(stores), where=z > ROUNDING)
