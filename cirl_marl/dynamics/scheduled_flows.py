"""Scheduled flows, and their cuts where a donor could be overdrawn."""

from __future__ import annotations

import numpy as np

from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.rowsum import RowSum

KEPT = 1.0 - 1e-12
"""Part of what can be delivered that is delivered, so that rounding overdraws nothing."""


class ScheduledFlows:
    """Cuts scheduled flows so that no donor is overdrawn.

    A donor with stock x, proportional exits a and a constant outflow U obeys ẋ ≥ −a·x − U, which stays non-negative for
    a substep h if U ≤ x·a/(e^{ah} − 1). Flows from one donor are cut by the same factor.
    """

    def __init__(self, network: Network, is_scheduled: Bools, driver: Integers, substep: float) -> None:
        """Find the donors of scheduled flows, and their outflows by schedule and in proportion to their stock."""
        self._substep = substep
        self._arcs: Integers = np.flatnonzero(is_scheduled)
        self._donors, place = np.unique(network.donors[self._arcs], return_inverse=True)
        self._slot: Integers = place
        slot = {int(node): i for i, node in enumerate(self._donors)}
        proportional = driver == network.donors
        exits = [k for k, d in enumerate(network.donors) if int(d) in slot and proportional[k]]
        exit_slot = [len(slot) + slot[int(network.donors[k])] for k in exits]
        rows, columns = [*self._slot, *exit_slot], [*self._arcs, *exits]
        self._outflows = RowSum(rows, columns, 1.0, (2 * len(slot), len(network.arcs)))
        self._sum = RowSum(self._slot, np.arange(len(self._arcs)), 1.0, (len(slot), len(self._arcs)))

    def cut(self, stock: Floats, rate: Floats) -> Floats:
        """Return the rates, shape (arcs, B), with those of scheduled flows cut; the same array if none is."""
        if not len(self._arcs):
            return rate
        demand, turned_over = self._demand(rate)
        available_stock = stock.take(self._donors, axis=0)
        if (demand <= available_stock * (1.0 - turned_over) * KEPT).all():
            return rate  # x·a/(e^{ah} − 1) ≥ x(1 − ah)/h: nothing can be overdrawn
        available = available_stock * _deliverable(turned_over) * KEPT
        factor = np.divide(available, demand, out=np.ones_like(available_stock), where=demand > available)
        rate = rate.copy()
        rate[self._arcs] *= factor.take(self._slot, axis=0)
        return rate

    def pull_back(self, stock: Floats, rate: Floats, adjoint: Floats, stock_adjoint: Floats) -> None:
        """Turn, in place, the adjoint of the rates that ``cut`` returned into that of those it was given.

        What comes by the stocks is added to theirs. A flow that just need not be cut counts as uncut.
        """
        if not len(self._arcs):
            return
        demand, turned_over = self._demand(rate)
        deliverable = _deliverable(turned_over)
        available_stock = stock.take(self._donors, axis=0)
        available = available_stock * deliverable * KEPT
        is_cut = demand > available
        if not is_cut.any():
            return
        ratio = np.divide(1.0, demand, out=np.zeros_like(demand), where=is_cut)
        factor_adjoint = self._sum(adjoint[self._arcs] * rate[self._arcs]) * ratio
        adjoint[self._arcs] *= np.where(is_cut, available * ratio, 1.0).take(self._slot, axis=0)
        stock_adjoint[self._donors] += factor_adjoint * deliverable * KEPT
        # d/dT of T/(e^T − 1), T what is turned over
        grown = np.expm1(turned_over)
        slope = np.divide(1.0 - deliverable * (grown + 1.0), grown, out=np.full_like(grown, -0.5), where=grown > 1e-8)
        outflows = np.concatenate(
            [-factor_adjoint * available * ratio, factor_adjoint * available_stock * slope * KEPT]
        )
        self._outflows.transpose().add_to(adjoint, outflows * self._substep)

    def _demand(self, rate: Floats) -> tuple[Floats, Floats]:
        """Return what is asked of each donor by schedule, mass, and the part of its stock that it turns over."""
        outflows = self._outflows(rate)
        outflows *= self._substep
        return outflows[: len(self._donors)], outflows[len(self._donors) :]


def _deliverable(turned_over: Floats) -> Floats:
    """Return T/(e^T − 1), the part of a stock that can be sent off evenly while a part T of it is turned over."""
    return np.divide(turned_over, np.expm1(turned_over), out=np.ones_like(turned_over), where=turned_over > 1e-12)
