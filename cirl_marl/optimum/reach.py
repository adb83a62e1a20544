"""Bounds of every stock that hold for any actions: a linear comparison system for the lowest and highest stocks.

The least inflow and the greatest outflow of each node give the system of x̲, the opposite that of x̄. In the coordinates
(x̲, −x̄) it has no negative entry off its diagonal, so its solution stays below (x, −x) for every control (Müller 1927,
Kamke 1932). Scheduled flows are cut when their donor cannot deliver; where x̲ excludes that, the flow asked for is the
flow realised.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cirl_marl.dynamics.motion import Dynamics
from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible, NoCertificate
from cirl_marl.optimum.held import Held

ROUNDING = 1e-9
"""Relative widening of every bound; rounding errors are far smaller."""
ROUND_OFF = 1e-13
"""Mass by which bounds are widened in each substep, relative to the mass in the network."""


@dataclass(frozen=True, slots=True)
class Reach:
    """What the stocks can be.

    Attributes:
        upper: bound of each stock within each interval, shape (steps, nodes), mass.
        uncut: whether the donor of each arc delivers all that is asked, whatever the actions, shape (steps, arcs).
    """

    upper: Floats
    uncut: NDArray[np.bool_]


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
        self._linear: dict[int, _Linear] = {}

    def reach(self, initial: Floats, intervals: range) -> Reach:
        """Bound the stocks from ``initial``, shape (nodes,), on, over the given intervals of the episode.

        Raises:
            NoCertificate: if recipients may pull more from a node than it holds: the solver then departs from the laws.
        """
        network, scheduled = self.network, self.admissible.scheduled
        nodes, steps = len(network.nodes), len(intervals)
        mass = float(initial.sum()) * (1 + ROUNDING)
        lower, upper = initial.copy(), initial.copy()
        highest = np.zeros((steps, nodes))
        uncut = np.ones((steps, len(network.arcs)), dtype=bool)
        for step, interval in enumerate(intervals):
            least, most = np.where(scheduled, self.admissible.rate(interval), 0.0)
            incoming, outgoing = self._by_node(most)
            linear = self._of_kind(int(self.admissible.kinds[interval]))
            for _ in range(self.substeps):
                # without any outflow no stock ends a substep lower than it began, so this bounds it throughout
                peak, missed = linear.growth(upper, incoming)
                peak = np.minimum(peak + missed, mass) * (1 + ROUNDING)
                highest[step] = np.maximum(highest[step], peak)
                # what may be asked in this piece, against what is left at the least: nothing is cut where it suffices
                enough = (outgoing + linear.pull @ peak) * self.substep <= lower * linear.share * (1 - ROUNDING)
                if (linear.pulled & ~enough).any():
                    node = network.nodes[int((linear.pulled & ~enough).argmax())].id
                    raise NoCertificate(
                        f"network '{network.name}': recipients may pull more from node '{node}' than it holds in "
                        f"interval {interval}; no bound is proved for what the solver then does"
                    )
                delivered = enough[network.donors]
                uncut[step] &= delivered
                sure = least * delivered
                gained, lost = self._by_node(sure)
                constant = np.concatenate([gained - outgoing, incoming - lost])
                bounds, missed = linear.solution(np.concatenate([lower, upper]), constant)
                missed += mass * ROUND_OFF
                lower = np.maximum(bounds[:nodes] - missed, 0.0)
                upper = np.minimum(bounds[nodes:] + missed, mass)
        return Reach(highest, uncut)

    def _by_node(self, flow: Floats) -> tuple[Floats, Floats]:
        """Return the sums of flows into and out of each node, shape (nodes,)."""
        network, nodes = self.network, len(self.network.nodes)
        gained = np.bincount(network.recipients, flow, nodes).astype(float)
        return gained, np.bincount(network.donors, flow, nodes).astype(float)

    def _of_kind(self, kind: int) -> _Linear:
        if kind not in self._linear:
            self._linear[kind] = _Linear(self.admissible, kind, self.substep)
        return self._linear[kind]


class _Linear:
    """What is proportional to stocks in a kind of interval.

    Attributes:
        solution: of the lowest and the highest stocks after a substep, shape (2 nodes,).
        growth: the same of the highest, had they no outflow, shape (nodes,).
        pull: most that recipients pull from each node, per stock, sparse, 1/time.
        pulled: nodes from which they do.
        share: z/(e^z − 1) for the most that leaves a node in proportion to its stock in a substep, z.
    """

    def __init__(self, admissible: Admissible, kind: int, substep: float) -> None:
        network, driven = admissible.network, ~admissible.scheduled
        nodes, low, high = len(network.nodes), *admissible.rate(kind)[:, driven]
        donor, recipient, p = network.donors[driven], network.recipients[driven], admissible.driver[driven]
        pulled = donor != p
        # rows and columns: x̲ of all nodes, then x̄. x̲ gains the least inflow and loses the greatest outflow, x̄ the
        # opposite; growth has no outflow at all
        other = np.where(pulled, nodes, 0)  # what leaves at the least x̲ is driven by x̲ itself or by x̄ elsewhere
        rows = np.stack([recipient, nodes + recipient, donor, nodes + donor], axis=1).ravel()
        columns = np.stack([p, nodes + p, other + p, nodes - other + p], axis=1).ravel()
        values = np.stack([low, high, -high, -low], axis=1).ravel()
        self.solution = Held(sparse.coo_array((values, (rows, columns)), shape=(2 * nodes, 2 * nodes)), substep)
        self.growth = Held(sparse.coo_array((high, (recipient, p)), shape=(nodes, nodes)), substep)
        taken = (high[pulled], (donor[pulled], p[pulled]))
        self.pull = sparse.csr_array(sparse.coo_array(taken, shape=(nodes, nodes)))
        self.pulled = np.bincount(donor[pulled], minlength=nodes) > 0
        z = np.bincount(donor[~pulled], high[~pulled], nodes) * substep
        self.share = np.divide(z, np.expm1(z), out=np.ones(nodes), where=z > ROUNDING)
