"""The adjoint of intervals in which supplies make up for services.

Where a supply lies between its bounds, what its service measures stays at what is demanded, q_s(v, …) = D_s, whatever
else changes. By the implicit function theorem a functional L then changes as L − Σ_s μ_s(q_s − D_s) does, with
(∂q/∂v)ᵀ μ = ∂L/∂v for the extents v of such supplies. μ is found by conjugate residuals: every direction that is tried
is one more interval backwards, whose derivatives count with it. What arrives at once (``Arrivals``) preconditions them,
so that a few directions are enough for many services.
"""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.adjoint import Adjoint, IntervalInputs
from cirl_marl.dynamics.complementarity import TINY
from cirl_marl.dynamics.krylov import conjugate_residuals
from cirl_marl.dynamics.supply import Supply
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers
from cirl_marl.network.compartment_model import Bools


class SupplyAdjoint:
    """Derivatives of ``Supply.advance``."""

    def __init__(self, supply: Supply, adjoint: Adjoint) -> None:
        """Take the supplies, and the adjoint of intervals in which controls are given."""
        self._supply, self._adjoint = supply, adjoint
        self._measures = [measure.transpose() for measure in supply.measures]

    def pull_back(
        self,
        inputs: IntervalInputs,
        step: Integers,
        idle: Bools,
        stock_adjoint: Floats,
        moved_adjoint: Floats,
        substances_adjoint: Floats | None = None,
    ) -> IntervalInputs:
        """Return what ``Adjoint.pull_back`` does, for controls that came with what ``idle`` arcs supply.

        By the controls of these the derivatives are 0: they follow from all else. A supply at a bound stays there.
        """
        result = self._adjoint.pull_back(inputs, step, stock_adjoint, moved_adjoint, substances_adjoint)
        if not idle.any():
            return result
        per_extent, transposed = self._extents(inputs, step, idle)
        residual = self._by_extent(result, per_extent)

        def respond(lack: Floats) -> tuple[Floats, Floats]:
            lacks = np.ascontiguousarray(lack.T)[..., None]
            direction: Floats = np.asarray(np.linalg.solve(transposed, lacks)[..., 0].T, dtype=np.float64)
            trial = self._adjoint.pull_back(inputs, step, *self._by_measures(direction))
            return self._by_extent(trial, per_extent), _stack(trial, direction)

        total = conjugate_residuals(residual, _stack(result, np.zeros_like(residual)), respond)
        if total is None:
            arcs, name = ", ".join(self._supply.arcs), self._adjoint.dynamics.network.name
            raise CirlError(f"network '{name}': how supplies answer each other has no derivative: {arcs}")
        return self._with_bounds(inputs, step, idle, per_extent, total)

    def _extents(self, inputs: IntervalInputs, step: Integers, idle: Bools) -> tuple[Floats, Floats]:
        """Return what free supplies grow by with the extents of their services, and Aᵀ between these.

        Shapes are (arcs, B) and (B, services, services); services whose supply is at a bound count as independent.
        """
        supply, dynamics = self._supply, self._adjoint.dynamics
        low, high = supply.bounds(step, inputs.factors)
        amount = inputs.controls[supply.rows]
        per_extent = np.where(idle & (amount > low) & (amount < high), supply.weights, 0.0)
        rate = dynamics.orders.further_shares(dynamics.rate(inputs.controls, step, inputs.factors))
        services = len(supply.demand)
        slope = supply.slope(supply.arrivals(dynamics.routing.routes(rate)), per_extent) * supply.duration
        least = TINY * dynamics.network.episode.control_interval * supply.total(per_extent)
        is_free = np.diagonal(slope, axis1=1, axis2=2) > least.T
        per_extent *= is_free.T[supply.of]
        transposed = np.where(is_free[:, :, None] & is_free[:, None], slope.transpose(0, 2, 1), np.eye(services))
        return per_extent, transposed

    def _by_extent(self, derivatives: IntervalInputs, per_extent: Floats) -> Floats:
        """Return derivatives by the extents, shape (services, B), of those by the controls."""
        return self._supply.total(derivatives.controls[self._supply.rows] * per_extent)

    def _by_measures(self, worth: Floats) -> tuple[Floats, Floats]:
        """Return the adjoints of masses and of moved mass for what a unit that each service measures is worth."""
        dynamics = self._adjoint.dynamics
        stocks, flow = (measure(worth) for measure in self._measures)
        return dynamics.rows.masses_adjoint(stocks), flow / dynamics.network.episode.control_interval

    def _with_bounds(
        self, inputs: IntervalInputs, step: Integers, idle: Bools, per_extent: Floats, total: Floats
    ) -> IntervalInputs:
        """Return the derivatives, with those by factors on what is demanded, and on bounds at which supplies are."""
        supply, factors = self._supply, inputs.factors
        ends = np.cumsum([len(inputs.stock), len(inputs.controls), 0 if factors is None else len(factors)])
        by_stock, by_controls, by_factors, by_lack = np.split(total, ends)
        by_supply = by_controls[supply.rows]
        by_controls[supply.rows] = np.where(idle, 0.0, by_supply)
        if factors is None:
            return IntervalInputs(by_stock, by_controls, None)
        supply.demand_factors.pull_back(supply.demand.take(step, 1), -by_lack, by_factors)
        low, amount = supply.bounds(step, factors)[0], inputs.controls[supply.rows]
        at_bound = np.where(idle & (per_extent == 0), by_supply, 0.0)
        ends = np.zeros((3, *by_controls.shape))
        ends[0, supply.rows], ends[2, supply.rows] = at_bound * (amount <= low), at_bound * (amount > low)
        self._adjoint.rates.pull_back_bounds(step, factors, ends, by_factors)
        return IntervalInputs(by_stock, by_controls, by_factors)


def _stack(derivatives: IntervalInputs, lacks: Floats) -> Floats:
    """Return all derivatives below each other, shape (rows, B)."""
    parts = (derivatives.stock, derivatives.controls, derivatives.factors, lacks)
    return np.concatenate([part for part in parts if part is not None])
