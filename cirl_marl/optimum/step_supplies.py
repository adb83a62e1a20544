"""Idle supplies in the program of a small step: what they bring begins where a service gets short, and ends there.

Arcs that make up for service s bring U_s more than their least (``dynamics.supply``), as little as makes the quantity q
at least the demand D. Slopes of an episode in which U follows by itself are wrong as soon as a supply begins or ends: a
hair beyond, other slopes hold. In the program U is a variable of each interval instead, with the slopes of held
supplies and two rows,

    U + δU ≥ 0,    q + δq ≥ D.

So it knows where supplies begin and end. That U is no more than needed it does not ask for, as that is no linear row.
Where more is worth something, such as what reaches others beside, steps are worth trying in which supplies that bring
something keep to δq = 0, and others to δU = 0 (``at_need``): true to first order wherever neither begins.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from scipy import sparse

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.supply import Supply, SupplyRange
from cirl_marl.network import Floats, Integers
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.declarations import positional_record

NEAR = 1e-6
"""Part of the most that is supplied, and of what is demanded, below which a supply is about to begin or to end."""


@positional_record
class IdleSupplies:
    """What idle arcs bring for each service in an episode, and how far it may change along the same arcs."""

    services: Annotated[Integers, "for which they are, among those of the network, shape (supplies,)"]
    beyond: Annotated[Floats, "q − D, shape (steps, supplies), 0 within NEAR"]
    amount: Annotated[Floats, "U, likewise, mass/time, 0 within NEAR"]
    low: Annotated[Floats, "least change of U, likewise"]
    high: Annotated[Floats, "largest, likewise"]
    rows: Annotated[Integers, "of the arcs among the controls, shape (arcs,)"]
    controls: Annotated[Floats, "of these in each interval, shape (arcs, steps)"]
    unit: Annotated[Floats, "what of these a unit of each U is, shape (supplies, arcs, steps)"]
    is_held: Annotated[bool, "whether they bring just what is needed, see ``at_need``"] = False

    @classmethod
    def of(
        cls, dynamics: Dynamics, supply: Supply, is_idle: Bools, stock: Floats, controls: Floats, first: int
    ) -> IdleSupplies:
        """Find them.

        Args:
            dynamics: of the network.
            supply: of it.
            is_idle: which of its arcs are held, shape (arcs, 1).
            stock: at the start of each interval, as ``Dynamics.extend`` gives it.
            controls: of all others, shape (controls, steps).
            first: interval of the network in which the episode begins.
        """
        steps, arcs = controls.shape[1], np.flatnonzero(is_idle)
        interval, idle = np.arange(first, first + steps), np.repeat(is_idle, steps, axis=1)
        places = np.unique(supply.of[arcs])
        controls, done = supply.advance(stock, np.empty((0, steps)), controls, interval, idle)
        flow, range_ = controls[supply.rows], SupplyRange(supply, interval, idle, None)
        above = np.where(idle, flow - range_.low, 0.0)
        weights = np.broadcast_to(supply.weights, above.shape)
        unit = range_.unit(np.divide(above, weights, out=np.zeros_like(above), where=weights > 0))
        units = np.where(supply.of[:, None] == places[:, None, None], unit, 0.0)
        fall, rise = (
            np.divide(room, units, out=np.full_like(units, np.inf), where=units > 0).min(axis=1, initial=np.inf)
            for room in (above, range_.high - flow)
        )
        demand, most = supply.demand[places][:, interval], range_.most[places]
        beyond = supply.quantities(done.stock, done.moved_mass)[places] - demand
        beyond[np.abs(beyond) <= NEAR * demand] = 0.0
        amount = supply.total(above)[places]
        low = np.where(np.isfinite(fall) & (beyond >= 0), -fall, 0.0)
        services = [service.id for service in dynamics.network.services]
        return cls(
            np.array([services.index(supply.services[place]) for place in places], dtype=np.intp),
            beyond.T,
            np.where(amount > NEAR * most, amount, 0.0).T,
            low.T,
            np.where(np.isfinite(rise), rise, 0.0).T,
            supply.rows[arcs],
            flow[arcs],
            units[:, arcs],
        )

    @property
    def size(self) -> Floats:
        """The largest range of each U, shape (supplies,)."""
        return np.asarray((self.high - self.low).max(axis=0, initial=0.0))

    def at_need(self) -> IdleSupplies:
        """Return them without what may begin or end, but where that is about to happen."""
        return replace(self, high=np.where((self.amount == 0) & (self.beyond > 0), 0.0, self.high), is_held=True)

    def rows_of(self, t: int, table: Floats) -> tuple[sparse.csr_array, Floats]:
        """Return rows of interval t by which what can be had does not lack, and their limits.

        Args:
            t: the interval.
            table: what all services measure, of a unit of every action so far, shape (services, actions).
        """
        places = np.flatnonzero(self.high[t] > 0)
        exact = np.flatnonzero((self.amount[t] > 0) & (self.high[t] > 0) & self.is_held)
        rows = np.concatenate([-table[self.services[places]], table[self.services[exact]]])
        return sparse.csr_array(rows), np.append(np.maximum(self.beyond[t, places], 0.0), np.zeros(len(exact)))
