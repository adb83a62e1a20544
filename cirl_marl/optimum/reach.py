"""Bounds of every stock that hold for any actions: a linear comparison system for the lowest and highest stocks.

The least inflow and the greatest outflow of each node give the system of x̲, the opposite that of x̄. In the coordinates
(x̲, −x̄) it has no negative entry off its diagonal, so its solution stays below (x, −x) for every control (Müller 1927,
Kamke 1932). Scheduled flows are cut when their donor cannot deliver; where x̲ excludes that, the flow asked for is the
flow realised.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, sparse
from scipy.sparse.linalg import splu

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.visit_bounds import VisitBounds
from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible, NoCertificate

DENSE = 256
"""Rows of the largest system whose solution is kept as matrices."""
TRUNCATION = 1e-17
"""Sum of the terms of the series that are left out, relative to the change that the first term makes."""
ROUNDING = 1e-9
"""Relative widening of every bound; rounding errors are far smaller."""
CONVERGED = 1e-3
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
        self._neglected = 0.0
        if self._size <= DENSE:
            # exp of [[M, I], [0, 0]]·h has both in its upper blocks (Van Loan 1978)
            extended = np.zeros((2 * self._size, 2 * self._size))
            extended[: self._size, : self._size], extended[: self._size, self._size :] = (
                matrix.toarray(),
                np.eye(self._size),
            )
            solved = linalg.expm(extended * interval)
            self._solution, self._response = solved[: self._size, : self._size], solved[: self._size, self._size :]
            return
        self._matrix = sparse.csr_array(matrix)
        norm = float(abs(self._matrix).sum(axis=0).max(initial=0.0)) * interval
        self._terms, term = 1, norm / 2  # the first term that is left out, relative to the first
        while norm >= self._terms + 2 or term / (1 - norm / (self._terms + 2)) > TRUNCATION:
            self._terms += 1
            term *= norm / (self._terms + 1)
        self._neglected = term / (1 - norm / (self._terms + 2))

    def __call__(self, state: Floats, constant: Floats) -> tuple[Floats, float]:
        """Return x after the substep, from ``state`` and with c = ``constant``, and how far off it may be at most."""
        if self._size <= DENSE:
            return self._solution @ state + self._response @ constant, 0.0
        term = self._interval * (self._matrix @ state + constant)
        missed = self._neglected * float(np.abs(term).sum())
        after = state + term
        for k in range(1, self._terms):
            term = self._matrix @ term * (self._interval / (k + 1))
            after += term
        return after, missed


class RouteBounds:
    """Bounds of what leaves such nodes in one interval, per mass that enters them.

    With the least shares P̲ among these nodes and R̲ into stocks, at least (I − P̲)⁻¹ R̲ arrives. The greatest number of
    visits V_ij to node j by what enters i solves V = I + max_s P(s) V, a Markov decision process; from a V that is too
    large this iteration falls towards it, so any iterate bounds it. What enters i reaches a stock in a share of at most
    V_i R̄, and of at most 1.

    Attributes:
        longest: most visits of all nodes together, at least 1.
        visits: V, shape (nodes, nodes).
    """

    def __init__(
        self, admissible: Admissible, passes: VisitBounds, step: int, wider: RouteBounds | None = None
    ) -> None:
        """Take the ranges of shares in interval ``step``; the visits of ``wider`` ranges are where to begin from."""
        network = admissible.network
        stores, nodes = len(network.stores), len(network.nodes)
        self._stores, inner = stores, nodes - stores
        arcs = np.flatnonzero(network.donors >= stores)
        places = (network.donors[arcs] - stores, network.recipients[arcs])
        low, high = (sparse.csc_array((rate, places), shape=(inner, nodes)) for rate in admissible.rate(step)[:, arcs])
        total = passes.total(step)
        arrives = _least(low[:, stores:], low[:, :stores].toarray(), total)
        self.longest = float(total.max(initial=1.0))
        visits, fewer = np.repeat(total[:, None], inner, axis=1), np.empty(0)
        if wider is not None:
            fewer = np.eye(inner) + passes.best(wider.visits, step)
            if (fewer <= wider.visits * (1 + ROUNDING)).all():  # a bound: V ≥ I + max_s P(s) V
                visits = np.minimum(visits, wider.visits * (1 + ROUNDING))
        for _ in range(ROUNDS if inner else 0):
            fewer = np.minimum(visits, np.eye(inner) + passes.best(visits, step))
            fallen = (visits - fewer).max()
            visits = fewer
            if fallen <= CONVERGED * visits.max():
                break
        most = np.minimum(visits @ high[:, :stores].toarray(), 1.0)
        self._least = sparse.csr_array(arrives.T * (1 - ROUNDING))
        self._most = sparse.csr_array(most.T * (1 + ROUNDING))
        self.visits: Floats = visits
        self._visits = sparse.csr_array(visits.T * (1 + ROUNDING))

    def least(self, entering: Any) -> Any:
        """Return the least that stocks get of what enters nodes, shape (nodes, …) → (stores, …)."""
        return entering[: self._stores] + self._least @ entering[self._stores :]

    def most(self, entering: Any) -> Any:
        """Return the most that stocks get, likewise."""
        return entering[: self._stores] + self._most @ entering[self._stores :]

    def through(self, entering: Any) -> Any:
        """Return the most that passes through the nodes that store nothing, given what enters these from elsewhere."""
        return self._visits @ entering


def _least(passed: Any, arriving: Floats, visits: Floats) -> Floats:
    """Return a lower bound of A = (I − P̲)⁻¹ R̲ that is as near as its equation can be solved.

    No inverse of I − P̲ has a negative entry, so what exceeds R̲ + P̲ A by at most η is too large by at most η visits.

    Args:
        passed: P̲, sparse, shape (nodes, nodes).
        arriving: R̲, shape (nodes, stores).
        visits: most visits of all nodes together by what enters each, shape (nodes,).
    """
    if not len(visits):
        return arriving
    found = splu(sparse.eye_array(len(visits), format="csc") - passed).solve(arriving)
    above = max(float((found - arriving - passed @ found).max(initial=0.0)), 0.0) + 8 * float(np.finfo(float).eps)
    least: Floats = np.maximum(found - above * visits[:, None], 0.0)
    return least


@dataclass(frozen=True, slots=True)
class Reach:
    """What the stocks can be.

    Attributes:
        upper: bound of each stock within each interval, mass, and of what passes through each node that stores
            nothing, mass/time, shape (steps, nodes).
        uncut: whether the donor of each arc delivers all that is asked, whatever the actions, shape (steps, arcs).
        entered: most that enters each stock in each interval, shape (steps, stores), mass.
    """

    upper: Floats
    uncut: NDArray[np.bool_]
    entered: Floats


@dataclass(frozen=True, slots=True)
class DelayLine:
    """What comes out of a fixed lifetime.

    Attributes:
        arc: through which it comes out.
        node: from which.
        slots: what is in it at the start, first what comes out first, mass.
        interval: length of an interval.
    """

    arc: int
    node: int
    slots: Floats
    interval: float

    def most(self, step: int, entered: Floats) -> float:
        """Return the most that comes out in an interval, given what ``entered`` in those before, mass/time."""
        delay = len(self.slots)
        return float(self.slots[step] if step < delay else entered[step - delay, self.node]) / self.interval


class ComparisonSystem:
    """The comparison system, advanced by the substeps of the simulator, in which scheduled flows are constant.

    Attributes:
        substeps: of the simulator in an interval.
    """

    def __init__(self, admissible: Admissible) -> None:
        """Compile the system for the ranges of ``admissible``."""
        self.admissible, self.network = admissible, admissible.network
        dynamics = Dynamics(admissible.network)
        self.substeps, self.substep = dynamics.substeps, dynamics.substep
        self._passes = VisitBounds(admissible.network)
        self._routes: dict[bytes, RouteBounds] = {}
        self._passed_on = self.network.donors >= len(self.network.stores)
        kinds = np.unique(admissible.kinds).tolist()
        ranges = [np.diff(admissible.rate(kind)[:, self._passed_on], axis=0).sum() for kind in kinds]
        self._widest = kinds[int(np.argmax(ranges))]
        self._linear: dict[int, Linear] = {}

    def reach(self, initial: Floats, intervals: range, delayed: Sequence[DelayLine] = ()) -> Reach:
        """Bound the stocks from ``initial``, shape (stores,), on, over the given intervals of the episode.

        What comes out of fixed lifetimes, ``delayed``, is at most what entered so many intervals before.

        Raises:
            NoCertificate: if recipients may pull more from a node than it holds: the solver then departs from the laws.
        """
        network, scheduled = self.network, self.admissible.scheduled
        nodes, stores, steps = len(network.nodes), len(network.stores), len(intervals)
        mass = float(initial.sum()) * (1 + ROUNDING)
        lower, upper = initial.copy(), initial.copy()
        highest, entered = np.zeros((steps, nodes)), np.zeros((steps, stores))
        uncut = np.ones((steps, len(network.arcs)), dtype=bool)
        for step, interval in enumerate(intervals):
            least, most = np.where(scheduled, self.admissible.rate(interval), 0.0)
            for each in delayed:
                least[each.arc], most[each.arc] = 0.0, each.most(step, entered)
            linear = self.of_kind(int(self.admissible.kinds[interval]))
            entering, outgoing = self._by_node(most)
            incoming = linear.routes.most(entering)
            for _ in range(self.substeps):
                # without any outflow no stock ends a substep lower than it began, so this bounds it throughout
                peak, missed = linear.growth(upper, incoming)
                entered[step] += np.maximum(peak + missed - upper, 0.0)
                peak = np.minimum(peak + missed, mass) * (1 + ROUNDING)
                highest[step, :stores] = np.maximum(highest[step, :stores], peak)
                # what may be asked in this piece, against what is left at the least: nothing is cut where it suffices
                enough = (outgoing + linear.pull @ peak) * self.substep <= lower * linear.share * (1 - ROUNDING)
                if (linear.pulled & ~enough).any():
                    node = network.nodes[int((linear.pulled & ~enough).argmax())].id
                    raise NoCertificate(
                        f"network '{network.name}': recipients may pull more from node '{node}' than it holds in "
                        f"interval {interval}; no bound is proved for what the solver then does"
                    )
                delivered = np.append(enough, True)[np.minimum(network.donors, stores)]
                uncut[step] &= delivered
                gained, lost = self._by_node(least * delivered)
                constant = np.concatenate([linear.routes.least(gained) - outgoing, incoming - lost])
                bounds, missed = linear.solution(np.concatenate([lower, upper]), constant)
                missed += mass * ROUND_OFF
                lower = np.maximum(bounds[:stores] - missed, 0.0)
                upper = np.minimum(bounds[stores:] + missed, mass)
            highest[step, stores:] = linear.routes.through(entering[stores:] + linear.sent @ highest[step, :stores])
        uncut[:, [each.arc for each in delayed]] = True  # a slot holds what comes out of it
        return Reach(highest, uncut, entered)

    def _by_node(self, flow: Floats) -> tuple[Floats, Floats]:
        """Return the sums of flows into each node, shape (nodes,), and out of each stock, shape (stores,)."""
        network, nodes = self.network, len(self.network.nodes)
        gained, lost = (np.bincount(ends, flow, nodes).astype(float) for ends in (network.recipients, network.donors))
        return gained, lost[: len(network.stores)]

    def of_kind(self, kind: int) -> Linear:
        """Return what is proportional to stocks in a kind of interval."""
        if kind not in self._linear:
            self._linear[kind] = Linear(self.admissible, kind, self._routes_of(kind), self.substep)
        return self._linear[kind]

    def _routes_of(self, kind: int) -> RouteBounds:
        """Return what holds in a kind of interval, found from what holds where ranges are widest."""
        key = self.admissible.rate(kind)[:, self._passed_on].tobytes()
        if key not in self._routes:
            wider = None if kind == self._widest else self._routes_of(self._widest)
            self._routes[key] = RouteBounds(self.admissible, self._passes, kind, wider)
        return self._routes[key]


class Linear:
    """What is proportional to stocks in a kind of interval.

    Attributes:
        routes: what passes through nodes that store nothing.
        solution: of the lowest and the highest stocks after a substep, shape (2 stores,).
        gains: most that each stock gets, per stock, sparse, 1/time.
        growth: the highest stocks after a substep, had they no outflow, shape (stores,).
        sent: most that enters each node that stores nothing, per stock, sparse, 1/time.
        thrown: most that passes through these, likewise.
        pull: most that recipients pull from each stock, per stock, sparse, 1/time.
        pulled: stocks from which they do.
        share: z/(e^z − 1) for the most that leaves a stock in proportion to it in a substep, z.
    """

    def __init__(self, admissible: Admissible, kind: int, routes: RouteBounds, substep: float) -> None:
        """Compile it for the intervals like the first of that kind."""
        network, self.routes = admissible.network, routes
        stores, nodes = len(network.stores), len(network.nodes)
        driven = ~admissible.scheduled & (network.donors < stores)
        low, high = admissible.rate(kind)[:, driven]
        donor, recipient, p = network.donors[driven], network.recipients[driven], admissible.driver[driven]
        pulled, split = donor != p, admissible.shared[driven]
        released, exits = admissible.released(kind)[:, :stores], admissible.exits(kind)[:, :stores]

        def entering(rate: Floats, where: NDArray[np.bool_]) -> Any:
            return sparse.csr_array((rate[where], (recipient[where], p[where])), shape=(nodes, stores))

        # what a stock releases in shares arrives once, at once or past nodes that store nothing
        past = ~split & (recipient >= stores)
        least = sparse.coo_array(routes.least(entering(low, past | split)))
        once = sparse.coo_array(routes.most(entering(high, split)))
        once.data = np.minimum(once.data, released[1, once.col])
        most = sparse.coo_array(routes.most(entering(high, past)) + once)
        # rows and columns: x̲ of all stocks, then x̄. x̲ gains the least inflow and loses the greatest outflow, x̄ the
        # opposite; growth has no outflow at all
        other = np.where(pulled, stores, 0)  # what leaves at the least x̲ is driven by x̲ itself or by x̄ elsewhere
        straight = ~split & ~past
        kept = np.stack([straight, straight, ~split, ~split], axis=1)
        own = np.arange(stores)
        rows = np.stack([recipient, stores + recipient, donor, stores + donor], axis=1)[kept]
        columns = np.stack([p, stores + p, other + p, stores - other + p], axis=1)[kept]
        values = np.stack([low, high, -high, -low], axis=1)[kept]
        rows = np.concatenate([rows, least.row, stores + most.row, own, stores + own])
        columns = np.concatenate([columns, least.col, stores + most.col, own, stores + own])
        values = np.concatenate([values, least.data, most.data, -released[1], -released[0]])
        self.solution = ZeroOrderHold(
            sparse.coo_array((values, (rows, columns)), shape=(2 * stores, 2 * stores)), substep
        )
        gains = (np.append(recipient[straight], most.row), np.append(p[straight], most.col))
        values = np.append(high[straight], most.data)
        self.gains = sparse.csr_array(sparse.coo_array((values, gains), shape=(stores, stores)))
        self.growth = ZeroOrderHold(self.gains, substep)
        self.sent = entering(high, past | split)[stores:]
        self.thrown = routes.through(self.sent)
        taken = (high[pulled], (donor[pulled], p[pulled]))
        self.pull = sparse.csr_array(sparse.coo_array(taken, shape=(stores, stores)))
        self.pulled = np.bincount(donor[pulled], minlength=stores) > 0
        z = exits[1] * substep
        self.share = np.divide(z, np.expm1(z), out=np.ones(stores), where=z > ROUNDING)
