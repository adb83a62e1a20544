"""Convex parts of accounts in the program of a small step: distances of controls, and excesses of rates in pieces.

Each changes by a variable that is at least what it changes by to first order.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.environments.actuators import Actuators, planned_deviation
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.aims import RateTables
from cirl_marl.optimum.planned_episodes import HasPlan


@positional_record
class Efforts:
    """Controls of which something is charged for the distance from their neutral values, d + half·δa."""

    entries: Annotated[Integers, "of stacked actions, shape (controls,)"]
    controls: Annotated[Integers, "these among all controls, likewise"]
    away: Annotated[Floats, "d, shape (steps, controls)"]
    half: Annotated[Floats, "half the range of each, likewise"]

    @classmethod
    def of(cls, plan: HasPlan, is_charged: NDArray[np.bool_], first: int) -> Efforts:
        """Take those that act in a plan, which begins in interval ``first``, and are charged, shape (controls,)."""
        network, actions = plan.network, plan.actions
        acting = Actuators(network, plan.agents or None, len(actions)).control_rows
        is_charged = np.append(is_charged, False)  # there are no columns if nothing is charged
        entries = np.flatnonzero(is_charged[np.minimum(acting, len(is_charged) - 1)])
        controls = acting[entries]
        low, _, high = network.control_bounds[:, controls, first : first + len(actions)]
        away = planned_deviation(network, plan.agents, actions, first)[controls].T
        return cls(entries, controls, away, (high - low).T / 2)

    def rows(self, sign: float) -> sparse.csr_array:
        """Return ±half·δa − δe, of all δa and δe, interval by interval, which is at most ``limits``."""
        half = sparse.diags_array(sign * self.half.ravel())
        return sparse.hstack([half, -sparse.eye_array(half.shape[0])], format="csr")

    def limits(self, sign: float) -> Floats:
        """Return |d| ∓ d."""
        return np.asarray(np.abs(self.away) - sign * self.away).ravel()


@positional_record
class Excesses:
    """What rates in pieces count beyond amounts b of what they are of, q = s·(x', f̄) + s'·x + s''·d + q_0.

    Around an episode e = max(0, q − b) changes by δe ≥ −e with δq ≤ δe + max(0, b − q).
    """

    by_end: Annotated[Floats, "s, of what an interval ends with, shape (excesses, stocks + arcs)"]
    by_start: Annotated[Floats, "s', of its stocks at the start, shape (excesses, stocks)"]
    by_effort: Annotated[Floats, "s'', of charged distances of controls, shape (excesses, controls)"]
    beyond: Annotated[Floats, "q − b, shape (steps, excesses)"]

    @classmethod
    def of(cls, ledger: Ledger, dynamics: Dynamics, efforts: Efforts, initial: Floats, ends: Floats) -> Excesses:
        """Find them around an episode, by its stocks at the start and what its intervals end with, (steps, rows)."""
        by_flow, by_stock, by_control = ledger.excess_subjects
        stocks = dynamics.rows.nodes.stop
        by_end = account_shares((by_flow[:, None], by_stock[:, None], by_control[:, None]), dynamics)[:, 0]
        by_start, by_effort = by_end[:, :stocks], by_control[:, efforts.controls]
        starts = np.concatenate([initial[None], ends[:-1, :stocks]])
        subjects = ends @ by_end.T + starts @ by_start.T + np.abs(efforts.away) @ by_effort.T
        return cls(by_end, by_start, by_effort, subjects - ledger.amounts.T)

    def rows(
        self, t: int, response: Floats, before: Floats, further: Floats, effort: Floats
    ) -> tuple[sparse.csr_array, Floats, Floats]:
        """Return δq − δe by actions so far, efforts and excesses of interval t, its limits, and the ends of each δe.

        Args:
            t: the interval.
            response: of what it ends with to a unit of every action so far, shape (stocks + arcs, actions).
            before: of what the one before ended with, with fewer actions.
            further: most that actions change, shape (actions,).
            effort: most that distances of controls grow, shape (controls,).

        Returns:
            Shapes (excesses, actions + controls + excesses), (excesses,) and (excesses, 2).
        """
        change = self.by_end @ response
        change[:, : before.shape[1]] += self.by_start @ before[: self.by_start.shape[1]]
        room = np.maximum(-self.beyond[t], 0.0)
        most = np.maximum(np.abs(change) @ further + self.by_effort @ effort - room, 0.0)
        table = np.concatenate([change, self.by_effort, -np.eye(len(change))], axis=1)
        return sparse.csr_array(table), room, np.stack([-np.maximum(self.beyond[t], 0.0), most], axis=1)


def account_shares(rates: RateTables, dynamics: Dynamics) -> Floats:
    """Return the share of (x', f̄) of each interval in what is booked at some rates, (rates, steps, stocks + arcs)."""
    by_flow, by_stock, _ = rates
    by_stock = by_stock.copy()
    by_stock[:, :-1] += by_stock[:, 1:]  # a stock ends one interval and begins the next
    stages = np.zeros((by_stock.shape[2], dynamics.rows.nodes.stop))
    for store in range(len(stages)):
        stages[store, np.atleast_1d(dynamics.rows.stages.get(store, store))] = 1.0
    of_substances = np.zeros((*by_flow.shape[:2], by_flow.shape[2] * (dynamics.rows.components - 1)))
    return np.concatenate([by_stock / 2 @ stages, by_flow, of_substances], axis=2)
