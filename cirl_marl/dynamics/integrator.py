"""Batched integration of a material network and of the inner physics of its compartments."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial, reduce
from typing import Annotated

import numpy as np

from cirl_marl.dynamics.batches import BatchTransport
from cirl_marl.dynamics.capacities import Capacities
from cirl_marl.dynamics.inner_physics import InnerPhysics
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.routing import IntervalRoutes
from cirl_marl.dynamics.scheduled_flows import ScheduledFlows
from cirl_marl.dynamics.stages import FixedLifetimes, StagedNetwork
from cirl_marl.dynamics.taylor import Taylor
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Law
from cirl_marl.network.rowsum import RowSum, disposable
from cirl_marl.network.series import Series

Transfer = Callable[..., Floats]
"""``(rate, settled) → moved``: mass that a substep moves along each arc; flows in ``settled`` hold, but for NaN."""

Held = tuple[Floats, Floats, Floats, Floats, Floats | None]
"""Stocks, inner states, the mass moved, the last rates and what batches do in an interval."""

RUNGE_KUTTA = {"rk4": ((0.0, 0.5, 0.5, 1.0), (1 / 6, 1 / 3, 1 / 3, 1 / 6)), "euler": ((0.0,), (1.0,))}
"""Nodes and weights of the explicit schemes; each stage starts from the slope of the one before."""


@positional_record
class Transition:
    """What one control interval did."""

    stock: Annotated[Floats, "stocks after the interval with batch rows and unit row, shape (masses, B), mass"]
    inner: Annotated[Floats, "inner states of the models after the interval, shape (states, B)"]
    moved_mass: Annotated[Floats, "mass moved along each arc, by a batch arc delivered, shape (arcs, B), mass"]
    moved_substances: Annotated[
        Floats, "mass of each substance moved along each arc, shape (substances · arcs, B), mass"
    ]
    flow: Annotated[Floats, "realised continuous flows at the end of the interval, shape (arcs, B), mass/time"]
    batch_mass: Annotated[
        Floats | None, "m_fb of its start and of its end, as in ``Network.circularity``, shape (2, 2, B), mass, if any"
    ] = None


class Dynamics(FlowLaws):
    """Moves mass along the arcs and advances the inner physics.

    ``exact`` solves ẋ = S(r ∘ y[driver]) for constant r by its Taylor series (``taylor``). ``rk4`` and ``euler`` take
    stocks and inner states together. In the physical mode (all but ``euler``) no flow is negative or exceeds what its
    donor holds.

    Attributes:
        slots: those of fixed lifetimes; None if there are none.
        inner: the models of the compartments.
        batches: the batch arcs.
        capacities: cuts scheduled flows to what stocks let them carry.
        physical: whether stocks are kept non-negative.
        substeps: solver steps per control interval.
        taylor: the exact solver, if it is that.
        scheduled: cuts what asks for more than there is.
        terms: terms of the series of the exact solver.
    """

    def __init__(self, network: Network, *, uncertain: bool = False) -> None:
        """Compile ``network``."""
        super().__init__(network, uncertain=uncertain)
        rows, network = self.rows, self.staged_network
        self.slots = FixedLifetimes(network) if isinstance(network, StagedNetwork) and network.lines else None
        self.inner, self.batches = InnerPhysics(network, rows), BatchTransport(network, rows)
        episode = network.episode
        self.physical = episode.solver != "euler"
        self.substeps = self.solver_steps()
        self.substep = episode.control_interval / self.substeps
        self.taylor = Taylor(self, self.substep) if episode.solver == "exact" else None
        self.terms = self.taylor.terms if self.taylor is not None else 0
        self.capacities = Capacities(network, rows, self.factors.ranges)
        self.scheduled = ScheduledFlows(self, self.substep)
        shape = (rows.masses, len(network.arcs))
        self._outflow_sum = RowSum(rows.donors, np.arange(shape[1]), 1.0, shape)
        self._busiest = int(np.bincount(network.donors, minlength=1).max())
        laws = {arc.law for arc in network.arcs}
        self._heedless = self.physical and bool(laws & {Law.RECIPIENT, Law.COMPARTMENT})
        in_steps = [arc.id for arc in network.arcs if arc.law is Law.BATCH or isinstance(arc.capacity_rate, Series)]
        self._needs_step = (*self.time_dependent, *in_steps)

    def advance(
        self,
        stock: Floats,
        inner: Floats,
        controls: Floats,
        step: Integers | None = None,
        factors: Floats | None = None,
        routes: IntervalRoutes | None = None,
        rate: Floats | None = None,
    ) -> Transition:
        """Hold ``controls`` for one control interval; arguments are as in ``Transition`` and ``FlowLaws.rate``.

        Who knows the ``routes`` of the interval's shares already, or the ``rate``, which is used up, gives them.
        In the physical mode scheduled flows are first cut to what their donor can deliver, so the realised flows may be
        lower than those asked for. Networks without time series and batches need no ``step``.

        Raises:
            CirlError: if ``step`` is missing though an arc needs it, or if a state is no longer a finite number, as the
                solver's step is too long for the physics.
        """
        if step is None and self._needs_step:
            raise CirlError(
                f"network '{self.network.name}': advance needs step, the index of the control interval of each copy: "
                f"time series and batches depend on it, those of arc '{self._needs_step[0]}' for one"
            )
        rate = self.rate(controls, step, factors) if rate is None else rate
        self._limit(rate, stock, step, factors)
        if self.orders:
            _, _, (stock, inner, total, rate, batch_mass) = self.hold_with_orders(stock, inner, controls, rate, step)
            routes = self.routing.routes(rate)
        else:
            routes = routes or self.routing.routes(rate)
            stock, inner, total, rate, batch_mass = self._hold(stock, inner, controls, rate, routes, step, None)
        self._check_finite(stock, inner)
        flow, _ = self.of_arcs(self._flow_at(stock, inner, controls, rate, routes))
        return Transition(stock, inner, *self.of_arcs(total), flow, batch_mass)

    def estimate(
        self,
        stock: Floats,
        inner: Floats,
        controls: Floats,
        step: Integers,
        factors: Floats | None,
        routes: IntervalRoutes | None,
        rate: Floats,
        *,
        terms: int,
        flows: bool,
    ) -> tuple[Floats, Floats | None]:
        """Return roughly what an interval does, by so many ``terms`` of the exact solver's series.

        The other arguments are those of ``advance``; ``flows`` says whether what arcs carry is asked for.

        Returns:
            stocks after the interval, shape (masses, B), and the mass moved along each arc, shape (arcs, B).
        """
        self._limit(rate, stock, step, factors)
        if flows or self.batches.lines or self.taylor is None or self.taylor.pulls:
            stock, _, total, *_ = self._hold(stock, inner, controls, rate, routes, step, terms)
            return stock, self.of_arcs(total)[0]
        stock = self._move_slots(stock, rate)
        for _ in range(self.substeps):
            stock = self.taylor.end(stock, routes, terms, self.scheduled.cut(stock, rate))
            np.maximum(stock, 0.0, out=stock)  # few terms may overdraw it
        return stock, None

    def _hold(
        self,
        stock: Floats,
        inner: Floats,
        controls: Floats,
        rate: Floats,
        routes: IntervalRoutes | None,
        step: Integers | None,
        terms: int | None,
    ) -> Held:
        """Go through an interval."""
        stock = self._move_slots(stock, rate)
        actual_rate, batch_start = rate, None
        if self.batches.lines and step is not None:
            stock = stock.copy()
            batch_start = self.batches.dispatch(stock, step)
        inner = self.inner.tick(inner, controls, stock)
        total = None
        for _ in range(self.substeps):
            actual_rate = self.scheduled.cut(stock, rate) if self.physical else rate
            if self.taylor is not None:
                stock, transfer, actual_rate = self._settle(
                    stock, actual_rate, partial(self.taylor.moved_mass, stock, routes, terms)
                )
            else:
                stock, inner, transfer, actual_rate = self._explicit_step(stock, inner, actual_rate, routes, controls)
            total = transfer if total is None else total + transfer
        assert total is not None
        batch_mass = None
        if batch_start is not None and step is not None:
            inner = inner.copy()
            deliveries, batch_end = self.batches.settle(stock, inner, step, self.inner)
            total[self.batches.arcs] = deliveries
            batch_mass = np.stack([batch_start, batch_end])
        return stock, inner, total, actual_rate, batch_mass

    def hold_with_orders(
        self, stock: Floats, inner: Floats, controls: Floats, rate: Floats, step: Integers | None
    ) -> tuple[Floats, Floats, Held]:
        """Go through an interval in which orders are shares of what passes markets, q.

        Returns:
            rates with these shares, shape (arcs, B), q, shape (markets, B), and what ``_hold`` returns.
        """
        interval, copies = self.network.episode.control_interval, stock.shape[1]
        steps = None if step is None else np.broadcast_to(step, copies)
        done: list[Held] = []

        def simulate(columns: Integers, shares: Floats) -> Floats:
            masses, states, settings = (array.take(columns, axis=1) for array in (stock, inner, controls))
            routes, at = self.routing.routes(shares), None if steps is None else steps[columns]
            part = self._hold(masses, states, settings, shares, routes, at, None)
            if not done:
                done.append(part)
            else:
                for whole, some in zip(done[0][:4], part[:4], strict=True):
                    whole[:, columns] = some
            return part[2] / interval

        try:
            rate, through = self.orders.settle(rate, self.flow(stock, rate), simulate)
        except ArithmeticError as error:
            raise CirlError(f"network '{self.network.name}': {error}") from error
        return rate, through, done[0]

    def _move_slots(self, stock: Floats, rate: Floats) -> Floats:
        """Return the masses once slots have moved on, and set the rates of what comes out of them, in place."""
        if self.slots is None:
            return stock
        stock = self.slots.shift_slots(stock)
        self.slots.set_outflows(stock, rate)
        return stock

    def of_arcs(self, flow: Floats) -> tuple[Floats, Floats]:
        """Return what the arcs of the network carry, of all that is moved, shape (arcs of the simulator, B).

        Returns:
            The whole, shape (arcs, B), and of it each substance, shape (substances · arcs, B).
        """
        arcs, components = len(self.network.arcs), self.rows.components
        if components == 1:
            return flow[:arcs], flow[:0]
        parts = flow.reshape(components, -1, flow.shape[1])[:, :arcs]
        return reduce(np.add, parts), parts[1:].reshape(-1, flow.shape[1])

    def of_arcs_adjoint(self, whole: Floats, substances: Floats | None = None) -> Floats:
        """Return derivatives by all that is moved of those by what ``of_arcs`` returns; None: not by substances."""
        arcs, components = len(self.network.arcs), self.rows.components
        parts = np.zeros((components, len(self.staged_network.arcs) // components, whole.shape[1]))
        parts[:, :arcs] = whole
        if substances is not None:
            parts[1:, :arcs] += substances.reshape(components - 1, arcs, whole.shape[1])
        return parts.reshape(-1, whole.shape[1])

    def rate_within_capacities(
        self, stock: Floats, controls: Floats, step: Integers | None, factors: Floats | None
    ) -> Floats:
        """Return r of each arc in an interval that starts from ``stock``, which may limit scheduled flows."""
        rate = self.rate(controls, step, factors)
        if self.capacities:
            self.capacities.cut(rate, stock, step, factors)
        return rate

    def rate_of_components(
        self, stock: Floats, controls: Floats, step: Integers | None, factors: Floats | None
    ) -> Floats:
        """Return what ``rate_within_capacities`` does, of components where sources state what they give of each."""
        rate = self.rate(controls, step, factors)
        self._limit(rate, stock, step, factors)
        return rate

    def _limit(self, rate: Floats, stock: Floats, step: Integers | None, factors: Floats | None) -> None:
        """Cut rates to what capacities let them carry, and share them out among components, in place."""
        if self.capacities:
            self.capacities.cut(rate, stock, step, factors)
        if self.source_contents:
            self.source_contents.share_out(rate, step, factors)

    def _check_finite(self, stock: Floats, inner: Floats) -> None:
        if np.isfinite(stock).all() and np.isfinite(inner).all():
            return
        states = np.concatenate([stock, inner])
        row, copy_ = np.argwhere(~np.isfinite(states))[0]
        name = [*self.rows.mass_names, *self.rows.state_names][row]
        raise CirlError(
            f"network '{self.network.name}': {name} in copy {copy_} became {states[row, copy_]}: solver "
            f"'{self.network.episode.solver}' cannot follow the physics in steps of {self.substep:g} "
            f"{self.network.time_unit}; take a shorter solver_step or tighter bounds of the controls"
        )

    def start_flow(
        self, stock: Floats, inner: Floats, controls: Floats, factors: Floats | None = None
    ) -> tuple[Floats, Floats]:
        """Return the flows at the start of an episode, cut to what the donors hold, mass/time; see ``of_arcs``."""
        first = np.zeros(stock.shape[1], dtype=np.intp)
        rate = self.rate_of_components(stock, controls, first, factors)
        stock = self._move_slots(stock, rate)
        if self.physical:
            rate = self.scheduled.cut(stock, rate)
        if self.orders:
            rate = self.orders.shares(rate, self.orders.clear(rate, self.flow(stock, rate))[0])
        routes = self.routing.routes(rate)
        flow = self._flow_at(stock, inner, controls, rate, routes)
        if not self._heedless:
            return self.of_arcs(flow)
        out = self._outflow_sum(flow) * self.substep
        out[self.rows.unit] = 0.0
        share = np.divide(stock, out, out=np.ones_like(out), where=out > stock)
        flow *= share.take(self.rows.donors, axis=0)
        if routes is not None:
            self.routing.pass_on(flow, routes)
        return self.of_arcs(flow)

    def _flow_at(
        self, stock: Floats, inner: Floats, controls: Floats, rate: Floats, routes: IntervalRoutes | None
    ) -> Floats:
        if self.taylor is not None:
            return self.taylor.flow(stock, routes, rate)
        return self._forward(self.flow(self.inner.extend(stock, inner, controls), rate), routes)

    def _forward(self, flow: Floats, routes: IntervalRoutes | None) -> Floats:
        """Stop, in place, flows that a model or the stage of a solver would reverse, and pass on what is left."""
        if self.physical:
            np.maximum(flow, 0.0, out=flow)
        if routes is not None:
            self.routing.pass_on(flow, routes)
        return flow

    def _explicit_step(
        self, stock: Floats, inner: Floats, rate: Floats, routes: IntervalRoutes | None, controls: Floats
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """Take one Runge-Kutta step of stocks and inner states together; models with a step of their own go ahead."""
        h = self.substep
        ahead, means = self.inner.own_steps(inner, controls, h, stock)
        nodes, weights = RUNGE_KUTTA[self.network.episode.solver]
        change = np.zeros_like(inner)

        def transfer(rate: Floats, imposed_flow: Floats | None = None) -> Floats:
            """Go through the stages; leaves the change of the inner states in ``change``."""
            flow, slope, mass = np.zeros_like(rate), np.zeros_like(inner), np.zeros_like(rate)
            change.fill(0.0)
            for node, weight in zip(nodes, weights, strict=True):
                stage = self.incidence.add_to(stock.copy(), flow * (node * h)) if node else stock
                stage_inner = inner + slope * (node * h) if node else inner
                flow = self.flow(self.inner.extend(stage, stage_inner, controls, means), rate)
                if imposed_flow is not None:
                    np.copyto(flow, imposed_flow, where=~np.isnan(imposed_flow))
                flow = self._forward(flow, routes)
                slope = self.inner.derivative(stage_inner, controls, stage)
                mass += flow * (weight * h)
                np.add(change, slope * (weight * h), out=change)
            return mass

        if self.physical:
            after, moved_mass, rate = self._settle(stock, rate, transfer)
        else:
            moved_mass = transfer(rate)
            after = self.incidence.add_to(stock.copy(), moved_mass)
        return after, self.inner.after_change(ahead, change), moved_mass, rate

    def _settle(self, stock: Floats, rate: Floats, transfer: Transfer) -> tuple[Floats, Floats, Floats]:
        """Move mass; where a flow that does not heed its donor asked for more than that held, send what was there.

        Proportional and scheduled flows never overdraw. A recipient or a model that asks for more than there is gets
        its share: all outflows of the overdrawn node, and their rates, are scaled to the stock it started with. They
        are then settled, and the others follow from them, lest the recipient passes on what it did not get. Each pass
        settles at least one more node. Returned are the stocks at the end, the mass moved, and the rates realised.
        """
        moved_mass = transfer(rate)
        after = self.incidence.add_to(stock.copy(), moved_mass)
        if after.min() >= 0:
            return after, moved_mass, rate
        available = disposable(stock, self._busiest)
        imposed_flow, cut_copies = np.full_like(moved_mass, np.nan), np.zeros(moved_mass.shape[1], dtype=bool)
        while (after < 0).any():  # asked of every copy, as a NaN in one says nothing of the others
            out = self._outflow_sum(moved_mass)
            short = (after < 0) & (out > 0)
            share = np.divide(available, out, out=np.ones_like(out), where=short & (out > available))
            share = share.take(self.rows.donors, axis=0)
            cut = short.take(self.rows.donors, axis=0)
            imposed_flow[cut] = (moved_mass * share)[cut] / self.substep
            rate = rate * share
            # the copies in which nothing was cut keep what they have, to the bit
            cut_copies |= short.any(axis=0)
            moved_mass = np.where(cut_copies, transfer(rate, imposed_flow), moved_mass)
            after = self.incidence.add_to(stock.copy(), moved_mass)
        return after, moved_mass, rate
