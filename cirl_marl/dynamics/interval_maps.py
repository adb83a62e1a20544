"""How intervals depend on the stocks that they start from: products of the matrices of substeps.

While rates hold, a substep is linear in its stocks x and in the scheduled flows φ asked for, x' = M x + G φ, and so is
what moves, m = F x + H φ. With the φ of an interval below its stocks, z = (x, φ) goes through n substeps as W^n z, by
repeated squaring, where difference quotients would go through all of them for every stock. Where φ_k is cut it is
c_k x_d, with x_d the stock of its donor: other columns of W, in the substeps in which that is so. Flows that are cut
share what their donor can deliver, c_k = p φ_k/Σφ: what is asked for more of one, the others lose.
"""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.adjoint import derivative_obstacle
from cirl_marl.dynamics.complementarity import TINY
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.supply import Supply
from cirl_marl.network import Floats, Integers
from cirl_marl.network.compartment_model import Bools


def has_interval_maps(dynamics: Dynamics) -> bool:
    """Whether the motion is linear between cuts, its coefficients the same in all substeps of an interval."""
    if derivative_obstacle(dynamics.network) or dynamics.taylor is None:
        return False
    is_coupled = dynamics.orders or dynamics.capacities or dynamics.rows.components > 1
    return not (is_coupled or dynamics.taylor.pulls)


class IntervalMaps:
    """The derivatives of intervals under given controls by their stocks and by their scheduled flows."""

    def __init__(self, dynamics: Dynamics) -> None:
        """Take a motion that ``has_interval_maps``."""
        self._dynamics, self.arcs = dynamics, dynamics.scheduled.arcs
        self._donors = dynamics.staged_network.donors[self.arcs]

    def responses(self, stock: Floats, rate: Floats) -> tuple[Floats, Floats]:
        """Return them of stocks after each interval, and below these of mean flows.

        Args:
            stock: masses at the start of each interval, as ``Dynamics.advance`` takes them, shape (masses, steps).
            rate: of the arcs in each, shape (arcs, steps).

        Returns:
            By stocks at the start, shape (steps, rows, stocks), and by flows that ``arcs`` are asked for, likewise.
        """
        dynamics, (stocks, steps) = self._dynamics, (self._dynamics.rows.nodes.stop, stock.shape[1])
        start, is_cut, factor, per_stock = self._start(), *self._limits(stock, rate)
        response = np.empty((steps, stocks + len(dynamics.network.arcs), len(start)))
        for t in range(steps):
            substep, state, transfer = self._substep(rate[:, [t]]), start, np.zeros((1, 1))
            # substeps in which the same flows are cut
            changes = np.flatnonzero((is_cut[1:, :, t] != is_cut[:-1, :, t]).any(axis=1)) + 1
            for run in np.split(np.arange(dynamics.substeps), changes):
                limits = is_cut[run[0], :, t], per_stock[run[0], :, t]
                of_run = self._with_limits(substep, *limits)
                shared = self._shares(substep, of_run, *limits, factor[run, :, t]) @ state[stocks:]
                whole, through = _power(of_run[:stocks], of_run[stocks:], len(run))
                transfer, state = transfer + through @ state + shared[stocks:], whole @ state
                state[:stocks] += shared[:stocks]
            response[t] = np.concatenate([state[:stocks], transfer / dynamics.network.episode.control_interval])
        return response[:, :, :stocks], response[:, :, stocks:]

    def _limits(self, stock: Floats, rate: Floats) -> tuple[Bools, Floats, Floats]:
        """Return what is cut in each substep, by what factor, and c, shape (substeps, arcs, steps) each."""
        dynamics, routes, rate = self._dynamics, self._dynamics.routing.routes(rate), rate.copy()
        if dynamics.slots is not None:
            stock = dynamics.slots.shift_slots(stock)
            dynamics.slots.set_outflows(stock, rate)
        is_cut, factor, per_stock = np.empty((3, dynamics.substeps, len(self.arcs), stock.shape[1]))
        assert dynamics.taylor is not None
        for j in range(dynamics.substeps if len(self.arcs) else 0):
            is_cut[j], part = dynamics.scheduled.limits(stock, rate)
            factor[j], per_stock[j] = part * stock[self._donors], part * rate[self.arcs]
            transfer = dynamics.taylor.moved_mass(stock, routes, None, dynamics.scheduled.cut(stock, rate))
            stock = dynamics.incidence.add_to(stock.copy(), transfer)
        return is_cut.astype(bool), factor, per_stock

    def _substep(self, rate: Floats) -> Floats:
        """Return M and G, and below them F and H, of an interval with rates of shape (arcs, 1)."""
        dynamics = self._dynamics
        stocks, size = dynamics.rows.nodes.stop, dynamics.rows.nodes.stop + len(self.arcs)
        # one copy for each stock, with a unit of it and nothing asked for, then one for a unit of each scheduled flow
        masses, rates = np.zeros((dynamics.rows.masses, size)), np.repeat(rate, size, axis=1)
        masses[np.arange(stocks), np.arange(stocks)] = 1.0
        masses[dynamics.rows.unit, stocks:] = 1.0
        rates[self.arcs, stocks:] = np.eye(len(self.arcs))
        assert dynamics.taylor is not None
        transfer = dynamics.taylor.moved_mass(masses, dynamics.routing.routes(rates), None, rates)
        after = dynamics.incidence.add_to(masses, transfer)
        return np.concatenate([after[:stocks], transfer[: len(dynamics.network.arcs)]])

    def _with_limits(self, substep: Floats, is_cut: Bools, per_stock: Floats) -> Floats:
        """Return a substep in which flows that are cut follow from the stocks of their donors."""
        response, stocks = substep.copy(), self._dynamics.rows.nodes.stop
        for k in np.flatnonzero(is_cut).tolist():
            response[:, self._donors[k]] += per_stock[k] * substep[:, stocks + k]
            response[:, stocks + k] = 0.0
        return response

    def _shares(self, substep: Floats, of_run: Floats, is_cut: Bools, per_stock: Floats, factor: Floats) -> Floats:
        """Return how stocks and flows change in substeps in which the same flows are cut with what these are asked for.

        With s = φ_k/Σφ it is ∂(c_k x_d)/∂φ_j = factor·(δ_kj − s), which is 0 for the only flow of a donor.
        """
        stocks, result = self._dynamics.rows.nodes.stop, np.zeros((len(substep), len(self.arcs)))
        is_together = self._donors[:, None] == self._donors
        cut = np.flatnonzero(is_cut & (is_together.sum(axis=0) > 1))
        is_together = is_together[np.ix_(cut, cut)]
        share = per_stock[cut] / (is_together @ per_stock[cut])
        by_flow = substep[:, stocks + cut] @ (np.eye(len(cut)) - is_together * share[:, None])
        for now in factor[:, cut] if len(cut) else ():
            change = by_flow * now + of_run[:, :stocks] @ result[:stocks, cut]
            change[stocks:] += result[stocks:, cut]
            result[:, cut] = change
        return result

    def _start(self) -> Floats:
        """Return z at the start of an interval: slots move on, and what comes out of them is asked for."""
        dynamics, stocks = self._dynamics, self._dynamics.rows.nodes.stop
        state = np.eye(stocks + len(self.arcs))
        if dynamics.slots is not None:
            masses = dynamics.slots.shift_slots(np.eye(dynamics.rows.masses))[:, :stocks]
            outflow = np.zeros((len(dynamics.staged_network.arcs), stocks))
            dynamics.slots.set_outflows(masses, outflow)
            state[:stocks, :stocks], state[stocks:, :stocks] = masses[:stocks], outflow[self.arcs]
        return state


class FollowingSupplies:
    """What idle supplies do to derivatives at held controls, by the implicit function theorem.

    Where supplies lie between their bounds their services measure what is demanded, q = Q y = D of stocks and flows y,
    whatever else changes. With E the responses of y to supplies, derivatives J become J − E (Q E)⁻¹ Q J.
    """

    def __init__(self, supply: Supply, idle: Bools, step: Integers, controls: Floats, by_schedule: Floats) -> None:
        """Find the supplies that follow.

        Args:
            supply: of the network.
            idle: which of its arcs follow, shape (arcs, 1).
            step: index of each interval, shape (steps,).
            controls: with what they bring, shape (controls, steps).
            by_schedule: see ``IntervalMaps.responses``.
        """
        dynamics, services = supply.dynamics, len(supply.demand)
        places = np.searchsorted(dynamics.scheduled.arcs, supply.indices)
        (low, high), amount = supply.bounds(step, None), controls[supply.rows]
        is_free = idle & (amount > low) & (amount < high)
        rate = dynamics.rate(controls, step)[supply.indices]
        per_extent = np.divide(supply.weights * rate, amount, out=np.zeros_like(amount), where=is_free)
        by_arc = by_schedule[:, :, places] * per_extent.T[:, None]
        by_extent = by_arc @ np.eye(services)[supply.of]
        stocks, flows = np.eye(dynamics.rows.masses), np.eye(len(dynamics.network.arcs))
        of_stocks = supply.quantities(stocks, None)[:, : dynamics.rows.nodes.stop]
        self._measures = np.concatenate([of_stocks, supply.measures[1](flows)], axis=1)
        slope = self._measures @ by_extent
        is_met = np.diagonal(slope, axis1=1, axis2=2) > TINY * dynamics.network.episode.control_interval
        by_extent, both = by_extent * is_met[:, None], is_met[:, :, None] & is_met[:, None]
        self._gains = by_extent @ np.linalg.pinv(np.where(both, slope, np.eye(services)))

    def after(self, slopes: Floats) -> Floats:
        """Return derivatives with what follows, shape (steps, rows, …), of those at held controls."""
        result: Floats = slopes - self._gains @ (self._measures @ slopes)
        return result


def _power(step: Floats, transfer: Floats, count: int) -> tuple[Floats, Floats]:
    """Return W^count, and F (1 + W + … + W^(count − 1)), by repeated squaring; of W the rows of stocks are given."""
    stocks, size = step.shape
    step = np.concatenate([step, np.eye(size - stocks, size, k=stocks)])
    whole, total = step, transfer
    for bit in f"{count:b}"[1:]:
        total, whole = total + total @ whole, whole @ whole
        if bit == "1":
            total, whole = transfer + total @ step, whole @ step
    return whole, total
