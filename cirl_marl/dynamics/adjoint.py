"""Exact derivatives of the exact solver, backwards in time: the discrete adjoint of a control interval.

With F the flows that constant rates give, linear in the masses, a substep of length h is ::

    y_K = x,    y_{k−1} = x + (h/k)·S F(y_k),    m = h·F(y_1),    x' = x + S m,

and its adjoint goes through the same terms from the last to the first. A unit of mass is *worth* w_i in stock i, what
a functional of the future changes by; a flow is worth what its recipient makes of it less what its donor had, and a
node without stock is worth what it passes on: (I − P)⁻¹ of what its outflows are worth. Nothing is simulated anew but
the terms y_k. References: Giles and Pierce (2000), An introduction to the adjoint approach to design.

Where a function has a kink the derivative is one-sided: of a flow that just need not be cut as if it were not.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial
from typing import Annotated

import numpy as np

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.krylov import conjugate_residuals
from cirl_marl.dynamics.rate_adjoint import RateAdjoint
from cirl_marl.dynamics.routing import IntervalRoutes
from cirl_marl.dynamics.taylor import Taylor
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Law
from cirl_marl.network.rowsum import RowSum

Sweep = Callable[[Floats, Floats], tuple[Floats, Floats]]
"""``(stock, moved) → (stock, rates)``: adjoints after an interval become those before it."""


@positional_record
class IntervalInputs:
    """What an interval starts from, or derivatives by it."""

    stock: Annotated[Floats, "masses at its start, shape (masses, B)"]
    controls: Annotated[Floats, "controls, shape (controls, B)"]
    factors: Annotated[Floats | None, "factors on uncertain and disturbed numbers, shape (numbers, B), if any"]


class Adjoint:
    """Derivatives of ``Dynamics.advance`` of networks that the exact solver moves."""

    def __init__(self, dynamics: Dynamics) -> None:
        """Compile the adjoint of ``dynamics``.

        Raises:
            CirlError: for what has no derivative here; names the network, the compartment and the reason.
        """
        self.dynamics, self._taylor = dynamics, _differentiable(dynamics)
        self.rates = RateAdjoint(dynamics)
        network, rows, routing = dynamics.staged_network, dynamics.rows, dynamics.routing
        stores, arcs = rows.nodes.stop, np.arange(len(network.arcs))
        # nodes without stock stand below the masses
        below = rows.masses + routing.places[np.maximum(network.recipients - stores, 0)] if routing.nodes else 0
        self._recipients: Integers = np.where(network.recipients < stores, network.recipients, below)
        self._drives = RowSum(dynamics.driver, arcs, 1.0, (rows.masses, len(arcs)))
        shape = (routing.nodes, len(routing.arcs))
        self._passes = RowSum(routing.throughput_rows, np.arange(len(routing.arcs)), 1.0, shape)
        self._varying: Integers = np.flatnonzero(~dynamics.is_fixed)
        self._varying_drivers = self._taylor.driver[self._varying]

    def pull_back(
        self,
        inputs: IntervalInputs,
        step: Integers,
        stock_adjoint: Floats,
        moved_adjoint: Floats,
        substances_adjoint: Floats | None = None,
    ) -> IntervalInputs:
        """Return derivatives by what an interval starts from, of a functional of what it ends with.

        Args:
            inputs: of the interval.
            step: its index in each copy, shape (B,).
            stock_adjoint: derivatives by the masses after it, shape (masses, B); used up.
            moved_adjoint: by the mass that moved along each arc, shape (arcs, B).
            substances_adjoint: by that of each substance, shape (substances · arcs, B), if there are any.

        Raises:
            CirlError: if a node was overdrawn by what its recipients drew; names it and the copy.
        """
        dynamics, stock = self.dynamics, inputs.stock
        asked_rate = rate = dynamics.rate(inputs.controls, step, inputs.factors)
        if dynamics.capacities:
            dynamics.capacities.cut(rate := rate.copy(), stock, step, inputs.factors)
        ordered_rate, through = rate, None
        if dynamics.source_contents:
            dynamics.source_contents.share_out(rate := rate.copy(), step, inputs.factors)
        if dynamics.orders:
            inner = np.empty((0, stock.shape[1]))
            rate, through, _ = dynamics.hold_with_orders(stock, inner, inputs.controls, rate, step)
        if dynamics.slots is not None:
            stock = dynamics.slots.shift_slots(stock)
            dynamics.slots.set_outflows(stock, rate)
        routes, trace = dynamics.routing.routes(rate), []
        for _ in range(dynamics.substeps):
            realised_rate = dynamics.scheduled.cut(stock, rate)
            drivers = self._drivers(stock, realised_rate, routes)
            trace.append((stock, realised_rate, drivers))
            stock = self._after(stock, realised_rate, drivers[-1])
        sweep = partial(self._sweep, trace, rate, routes)
        moved = dynamics.of_arcs_adjoint(moved_adjoint, substances_adjoint)
        stock_adjoint, rate_adjoint = sweep(stock_adjoint, moved)
        if through is not None:
            stock_adjoint, rate_adjoint = self._of_orders(ordered_rate, through, sweep, stock_adjoint, rate_adjoint)
        if dynamics.slots is not None:
            stock_adjoint = dynamics.slots.pull_back(stock_adjoint, rate_adjoint)
        by_limits = None if inputs.factors is None else np.zeros_like(inputs.factors)
        if dynamics.source_contents:
            dynamics.source_contents.pull_back(ordered_rate, step, inputs.factors, rate_adjoint, by_limits)
        if dynamics.capacities:
            dynamics.capacities.pull_back(
                asked_rate, inputs.stock, step, inputs.factors, rate_adjoint, stock_adjoint, by_limits
            )
        by_controls, by_factors = self.rates.pull_back(inputs.controls, step, inputs.factors, rate_adjoint)
        if by_limits is not None and by_factors is not None:
            by_factors += by_limits
        return IntervalInputs(stock_adjoint, by_controls, by_factors)

    def _sweep(
        self,
        trace: Sequence[tuple[Floats, Floats, list[Floats]]],
        rate: Floats,
        routes: IntervalRoutes | None,
        stock_adjoint: Floats,
        moved_adjoint: Floats,
    ) -> tuple[Floats, Floats]:
        """Return the adjoints of the masses before an interval and of its rates; ``trace`` is of its substeps."""
        dynamics, rate_adjoint = self.dynamics, np.zeros_like(rate)
        stock_adjoint[dynamics.rows.unit] = 0.0
        for stock, realised_rate, drivers in reversed(trace):
            adjoint = np.zeros_like(rate)
            stock_adjoint = self._substep(realised_rate, drivers, routes, stock_adjoint, moved_adjoint, adjoint)
            dynamics.scheduled.pull_back(stock, rate, adjoint, stock_adjoint)
            rate_adjoint += adjoint
        return stock_adjoint, rate_adjoint

    def _of_orders(
        self, rate: Floats, through: Floats, sweep: Sweep, stock_adjoint: Floats, rate_adjoint: Floats
    ) -> tuple[Floats, Floats]:
        """Return the adjoints of masses and of rates with orders, of those with shares of what passes markets, q.

        q = Q(q, …) is what shares of q lead to: a functional L changes by it as L + λᵀ Q, (I − ∂Q/∂q)ᵀ λ = ∂L/∂q.
        """
        orders, interval = self.dynamics.orders, self.dynamics.network.episode.control_interval

        def respond(direction: Floats) -> tuple[Floats, Floats]:
            by_stock, by_rate = sweep(np.zeros_like(stock_adjoint), orders.worth_of_moved(direction / interval))
            return direction - orders.pull_back(rate, through, by_rate)[1], -np.concatenate([by_stock, by_rate])

        residual = orders.pull_back(rate, through, rate_adjoint)[1]
        total = conjugate_residuals(residual, np.concatenate([stock_adjoint, rate_adjoint]), respond)
        if total is None:
            raise CirlError(f"network '{self.dynamics.network.name}': how orders answer each other has no derivative")
        stock_adjoint, rate_adjoint = np.split(total, [len(stock_adjoint)])
        return stock_adjoint, orders.pull_back(rate, through, rate_adjoint)[0]

    def _drivers(self, stock: Floats, rate: Floats, routes: IntervalRoutes | None) -> list[Floats]:
        """Return what drives the arcs in each term of the series, from the innermost to the mean of the substep."""
        taylor, mean, drivers = self._taylor, stock, []
        for incidence in (*taylor.horner, None):
            drivers.append(taylor.drivers(mean, routes, rate))
            if incidence is not None:
                flow = drivers[-1].take(taylor.driver, 0)
                flow *= rate
                mean = incidence.add_to(stock.copy(), flow)
        return drivers

    def _after(self, stock: Floats, rate: Floats, drivers: Floats) -> Floats:
        """Return the masses after a substep."""
        moved = drivers.take(self._taylor.driver, 0) * rate * self.dynamics.substep
        after = self.dynamics.incidence.add_to(stock.copy(), moved)
        if self._taylor.pulls and after.min() < 0:
            row, copy_ = np.argwhere(after < 0)[0]
            subject = f"network '{self.dynamics.network.name}': {self.dynamics.rows.mass_names[row]} in copy {copy_}"
            raise CirlError(
                f"{subject} ran out: recipients draw whatever it holds, and such a cut has no derivative here"
            )
        return after

    def _substep(
        self,
        rate: Floats,
        drivers: list[Floats],
        routes: IntervalRoutes | None,
        stock_adjoint: Floats,
        moved_adjoint: Floats,
        rate_adjoint: Floats,
    ) -> Floats:
        """Return the adjoint of the masses before a substep, of those after it, and write that of the rates."""
        dynamics, varying = self.dynamics, self._varying
        result, slope = stock_adjoint.copy(), np.zeros((len(varying), rate.shape[1]))
        for k, term in enumerate(reversed(drivers), start=1):
            worth = self._flow_worth(stock_adjoint, rate, routes, moved_adjoint if k == 1 else None)
            worth *= dynamics.substep / k
            slope += worth.take(varying, 0) * term.take(self._varying_drivers, 0)
            worth *= rate
            stock_adjoint = self._drives(worth)
            stock_adjoint[dynamics.rows.unit] = 0.0
            result += stock_adjoint
        rate_adjoint[varying] = slope
        return result

    def _flow_worth(
        self, stock_worth: Floats, rate: Floats, routes: IntervalRoutes | None, direct: Floats | None = None
    ) -> Floats:
        """Return what a unit of each flow is worth, shape (arcs, B).

        It is worth what its recipient makes of it, less what its donor had, and ``direct``, if that is given.
        """
        worth, rows = stock_worth, self.dynamics.rows
        if routes is not None:
            routing = self.dynamics.routing
            worth = np.concatenate([worth, np.zeros((routing.nodes, rate.shape[1]))])
            onward = worth.take(self._recipients[routing.arcs], 0)
            if direct is not None:
                onward += direct[routing.arcs]
            onward *= rate.take(routing.arcs, 0)
            worth[rows.masses :] = routing.worths(self._passes(onward), routes)
        flow_worth: Floats = worth.take(self._recipients, 0)
        flow_worth -= worth.take(rows.donors, 0)
        if direct is not None:
            flow_worth += direct
        return flow_worth


def derivative_obstacle(network: Network) -> str:
    """Return why a network has no derivatives here; empty if it has."""
    for compartment in network.compartments.values():
        if compartment.model is not None:
            model = type(compartment.model).__name__
            return f"compartment '{compartment.id}' has a model, {model}, whose physics is not linear"
    for arc in network.arcs:
        if arc.law is Law.BATCH:
            return f"arc '{arc.id}' moves mass in batches"
    solver = network.episode.solver
    exact = "derivatives are of the exact solver (leave out solver and solver_step)"
    return "" if solver == "exact" else f"solver '{solver}' moves it; {exact}"


def _differentiable(dynamics: Dynamics) -> Taylor:
    """Return the solver, or say why what it moves has no derivative here."""
    if reason := derivative_obstacle(dynamics.network):
        raise CirlError(f"network '{dynamics.network.name}' cannot be differentiated: {reason}")
    assert dynamics.taylor is not None
    return dynamics.taylor
