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
from scipy import linalg

from cirl_marl.dynamics.motion import Dynamics
from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible, NoCertificate

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
        network = admissible.network
        self.admissible, self.network = admissible, network
        dynamics = Dynamics(network)
        self.substeps, self.substep = dynamics.substeps, dynamics.substep
        nodes, arcs = len(network.nodes), np.arange(len(network.arcs))
        self.outgoing, self.incoming = np.zeros((2, nodes, len(arcs)))
        self.outgoing[network.donors, arcs] = 1.0
        self.incoming[network.recipients, arcs] = 1.0
        low, high = admissible.rate(0)
        driven = ~admissible.scheduled
        self.pulled = driven & (admissible.driver != network.donors)
        # rows and columns: x̲ of all nodes, then x̄. x̲ gains the least inflow and loses the greatest outflow, x̄ the
        # opposite; growth has no outflow at all
        system, growth = np.zeros((2 * nodes, 2 * nodes)), np.zeros((nodes, nodes))
        self.pull = np.zeros((nodes, nodes))
        for k in np.flatnonzero(driven):
            donor, recipient, p = network.donors[k], network.recipients[k], admissible.driver[k]
            system[recipient, p] += low[k]
            system[nodes + recipient, nodes + p] += high[k]
            growth[recipient, p] += high[k]
            other = nodes if self.pulled[k] else 0  # what leaves at the least x̲ is driven by x̲ itself or by x̄ elsewhere
            system[donor, other + p] -= high[k]
            system[nodes + donor, nodes - other + p] -= low[k]
            if self.pulled[k]:
                self.pull[donor, p] += high[k]
        self.solution, self.response = _held(system, self.substep)
        self.growth, self.surge = _held(growth, self.substep)
        turned_over = self.outgoing @ (high * (driven & ~self.pulled)) * self.substep
        self.share = np.divide(turned_over, np.expm1(turned_over), out=np.ones(nodes), where=turned_over > ROUNDING)

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
        pulled_from = self.outgoing @ self.pulled > 0
        for step, interval in enumerate(intervals):
            least, most = np.where(scheduled, self.admissible.rate(interval), 0.0)
            for _ in range(self.substeps):
                # without any outflow no stock ends a substep lower than it began, so this bounds it throughout
                peak = np.minimum(self.growth @ upper + self.surge @ (self.incoming @ most), mass) * (1 + ROUNDING)
                highest[step] = np.maximum(highest[step], peak)
                # what may be asked in this piece, against what is left at the least: nothing is cut where it suffices
                asked = (self.outgoing @ most + self.pull @ peak) * self.substep
                enough = asked <= lower * self.share * (1 - ROUNDING)
                if (pulled_from & ~enough).any():
                    node = network.nodes[int((pulled_from & ~enough).argmax())].id
                    raise NoCertificate(
                        f"network '{network.name}': recipients may pull more from node '{node}' than it holds in "
                        f"interval {interval}; no bound is proved for what the solver then does"
                    )
                delivered = enough[network.donors]
                uncut[step] &= delivered
                sure = least * delivered
                constant = np.concatenate(
                    [
                        self.incoming @ sure - self.outgoing @ most,
                        self.incoming @ most - self.outgoing @ sure,
                    ]
                )
                bounds = self.solution @ np.concatenate([lower, upper]) + self.response @ constant
                lower = np.maximum(bounds[:nodes] - mass * ROUND_OFF, 0.0)
                upper = np.minimum(bounds[nodes:] + mass * ROUND_OFF, mass)
        return Reach(highest, uncut)


def _held(matrix: Floats, interval: float) -> tuple[Floats, Floats]:
    """Return exp(M h) and its integral over [0, h], which answer the state and a constant input."""
    size = len(matrix)
    # exp of [[M, I], [0, 0]]·h has both in its upper blocks (Van Loan 1978)
    extended = np.zeros((2 * size, 2 * size))
    extended[:size, :size], extended[:size, size:] = matrix, np.eye(size)
    solved = linalg.expm(extended * interval)
    return solved[:size, :size], solved[:size, size:]
