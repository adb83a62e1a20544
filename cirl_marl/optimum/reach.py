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
from scipy import sparse

from cirl_marl.dynamics.motion import Dynamics
from cirl_marl.dynamics.passes import Passes
from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible, NoCertificate
from cirl_marl.optimum.held import Held
from cirl_marl.optimum.routes import ROUNDING, RouteBounds

ROUND_OFF = 1e-13
"""Mass by which bounds are widened in each substep, relative to the mass in the network."""


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
class Delayed:
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
        self._passes = Passes(admissible.network)
        self._routes: dict[bytes, RouteBounds] = {}
        self._passed_on = self.network.donors >= len(self.network.stores)
        kinds = np.unique(admissible.kinds).tolist()
        ranges = [np.diff(admissible.rate(kind)[:, self._passed_on], axis=0).sum() for kind in kinds]
        self._widest = kinds[int(np.argmax(ranges))]
        self._linear: dict[int, Linear] = {}

    def reach(self, initial: Floats, intervals: range, delayed: Sequence[Delayed] = ()) -> Reach:
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
        self.solution = Held(sparse.coo_array((values, (rows, columns)), shape=(2 * stores, 2 * stores)), substep)
        gains = (np.append(recipient[straight], most.row), np.append(p[straight], most.col))
        values = np.append(high[straight], most.data)
        self.gains = sparse.csr_array(sparse.coo_array((values, gains), shape=(stores, stores)))
        self.growth = Held(self.gains, substep)
        self.sent = entering(high, past | split)[stores:]
        self.thrown = routes.through(self.sent)
        taken = (high[pulled], (donor[pulled], p[pulled]))
        self.pull = sparse.csr_array(sparse.coo_array(taken, shape=(stores, stores)))
        self.pulled = np.bincount(donor[pulled], minlength=stores) > 0
        z = exits[1] * substep
        self.share = np.divide(z, np.expm1(z), out=np.ones(stores), where=z > ROUNDING)
