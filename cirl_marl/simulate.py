"""Batched integration of a material network.

Every flow law is one product, ``f_k = r_k · y[driver_k]``: the driver is the stock of the donor or of the recipient
(r in 1/time), or the constant 1 for flows that are scheduled (r in mass/time). Stocks are therefore kept with one more
row, the *unit row*, which is 1. While the rates r hold, the network is linear.

Arrays are compartment-major, shape (compartments, batch), contiguous along the batch. Gather, multiply and sparse
segment sum treat each column alike, so a column's bits do not depend on the batch it is in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cirl_marl.elements import Arc, ControlKind, Law
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.rowsum import RowSum

MAX_TURNOVER = 1.0
"""Largest share, rate × substep, that a node may turn over in one substep of the exact solver."""

NOTHING = 1e-290
"""Stock that no recipient can pull: emptied again and again it would become subnormal, which does not round well."""

TRUNCATION = 1e-13
"""Bound on the first neglected term of the exact solver's series, relative to the mass in the network."""


@dataclass(frozen=True, slots=True)
class Transition:
    """What one control interval did.

    Attributes:
        stock: stocks after the interval with the unit row, shape (nodes + 1, B), mass.
        moved: mass moved along each arc, shape (arcs, B), mass.
        rate: realised r at the end of the interval, shape (arcs, B).
    """

    stock: Floats
    moved: Floats
    rate: Floats


class Dynamics:
    """The flow laws of a network, compiled to arrays.

    ``exact`` solves ẋ = S(r ∘ y[driver]) for constant r by its Taylor series, summed in Horner form for the mean of the
    state over the substep, ȳ = x + (h/2)·ẋ(x + (h/3)·ẋ(x + …)); the mass moved is h·r∘ȳ[driver]. A node turns over at
    most its stock in a substep, so the series is free of cancellation, and it is cut where the neglected term is below
    ``TRUNCATION``. ``euler`` is the explicit step of the published environments.

    Attributes:
        network: what is simulated.
        incidence: S with an empty unit row, shape (nodes + 1, arcs).
        control_low: lower bounds of the controls, in the order of ``network.controllable``.
        control_high: upper bounds.
        neutral: values while nobody acts.
    """

    def __init__(self, network: Network) -> None:
        """Compile ``network``."""
        self.network = network
        nodes, arcs = len(network.nodes), len(network.arcs)
        donors, recipients = network.donors, network.recipients
        laws = np.array([arc.law for arc in network.arcs])
        scheduled = np.isin(laws, [Law.CONTROLLED, Law.EXOGENOUS])
        columns = np.arange(arcs)
        self.incidence = RowSum(
            np.concatenate([donors, recipients]),
            np.tile(columns, 2),
            np.repeat([-1.0, 1.0], arcs),
            (nodes + 1, arcs),
        )
        self._outgoing = RowSum(donors, columns, np.ones(arcs), (nodes + 1, arcs))
        self.driver: Integers = np.where(scheduled, nodes, np.where(laws == Law.RECIPIENT, recipients, donors))
        self._compile_controls()
        self._compile_solver(scheduled, laws)

    def _compile_controls(self) -> None:
        """Find for each arc the rows of the control array that act on it; the row past the last is 1."""
        network = self.network
        position = {id_: i for i, id_ in enumerate(network.controllable)}
        none = len(position)
        controls = [c.control for c in network.compartments.values() if c.control is not None]
        self.control_low: Floats = np.array([c.low for c in controls], dtype=float)
        self.control_high: Floats = np.array([c.high for c in controls], dtype=float)
        self.neutral: Floats = np.array([c.neutral for c in controls], dtype=float)

        def acting_on(arc: Arc) -> tuple[int, int]:
            donor = network.compartments[arc.donor]
            own, valve = position.get(arc.id, none), position.get(arc.donor, none)
            if donor.control is not None and donor.control.kind is ControlKind.FLOW:
                return (valve, none) if arc.law is Law.CONTROLLED else (own, none)
            return own, valve

        rows = np.array([acting_on(arc) for arc in network.arcs], dtype=np.intp).reshape(-1, 2)
        self._own_control, self._donor_control = rows[:, 0].copy(), rows[:, 1].copy()
        self._base: Floats = np.array(
            [_base_rate(arc) for arc in network.arcs],
        ).reshape(-1, 1)
        self._series_arcs: Integers = np.flatnonzero([bool(arc.times) for arc in network.arcs])
        self._series = np.array(
            [_interval_means(network.arcs[k], network) for k in self._series_arcs],
        ).reshape(len(self._series_arcs), network.episode.horizon)

    def _compile_solver(self, scheduled: NDArray[np.bool_], laws: NDArray[np.str_]) -> None:
        network, episode = self.network, self.network.episode
        self.exact = episode.solver == "exact"
        highest = self.rate(self.control_high[:, None])[:, 0]
        if len(self._series_arcs):
            highest[self._series_arcs] *= self._series.max(axis=1)
        self.max_rate: Floats = highest
        turnover = np.bincount(self.driver[~scheduled], weights=highest[~scheduled], minlength=len(network.nodes))
        fastest = float(turnover.max(initial=0.0))
        if self.exact:
            self.substeps = max(1, math.ceil(fastest * episode.control_interval / MAX_TURNOVER - 1e-9))
        else:
            assert episode.solver_step is not None
            self.substeps = round(episode.control_interval / episode.solver_step)
        self.substep = episode.control_interval / self.substeps
        self.terms = _series_terms(2 * fastest * self.substep) if self.exact else 1
        self._horner = [self.incidence.scaled(self.substep / k) for k in range(self.terms, 1, -1)]
        self._order_arcs: Integers = np.flatnonzero(scheduled)
        self._order_donors, order_slot = np.unique(network.donors[self._order_arcs], return_inverse=True)
        self._order_slot: Integers = order_slot
        slot = {int(node): i for i, node in enumerate(self._order_donors)}
        own = np.flatnonzero([laws[k] == Law.DONOR and int(d) in slot for k, d in enumerate(network.donors)])
        exit_slot = [len(slot) + slot[int(network.donors[k])] for k in own]
        self._orders_and_exits = RowSum(
            np.concatenate([order_slot, np.array(exit_slot, dtype=np.intp)]),
            np.concatenate([self._order_arcs, own]),
            np.ones(len(self._order_arcs) + len(own)),
            (2 * len(slot), len(network.arcs)),
        )
        self._pulls = bool((laws == Law.RECIPIENT).any())

    def rate(self, controls: Floats, step: Integers | None = None) -> Floats:
        """Return r of each arc for given controls.

        Args:
            controls: physical values in the order of ``network.controllable``, shape (controls, B).
            step: index of the control interval in each environment, shape (B,); picks the value of time series.

        Returns:
            r, shape (arcs, B): 1/time for stock-driven arcs, mass/time for scheduled ones.
        """
        extended = np.concatenate([controls, np.ones((1, controls.shape[1]))])
        rate: Floats = extended.take(self._own_control, axis=0)
        rate *= self._base
        rate *= extended.take(self._donor_control, axis=0)
        if step is not None and len(self._series_arcs):
            rate[self._series_arcs] *= self._series[:, step]
        return rate

    def flow(self, stock: Floats, rate: Floats) -> Floats:
        """Return the instantaneous flows f = r ∘ y[driver], shape (arcs, B), mass/time."""
        flow: Floats = stock.take(self.driver, axis=0)
        flow *= rate
        return flow

    def extend(self, stock: Floats) -> Floats:
        """Append the unit row to stocks of shape (nodes, B)."""
        return np.concatenate([stock, np.ones((1, stock.shape[1]))])

    def advance(self, stock: Floats, rate: Floats) -> Transition:
        """Hold ``rate`` for one control interval.

        In the physical mode (``exact``) scheduled flows are first cut to what their donor can deliver, so the realised
        rate may be lower than the one asked for.

        Args:
            stock: stocks with the unit row, shape (nodes + 1, B).
            rate: r, shape (arcs, B), from ``rate``.
        """
        total = None
        for _ in range(self.substeps):
            if self.exact:
                realised = self._limit_orders(stock, rate)
                moved = self._moved_exactly(stock, realised)
                stock, moved, realised = self._move(stock, moved, realised)
            else:
                realised = rate
                moved = self.flow(stock, rate) * self.substep
                stock = self.incidence.add_to(stock.copy(), moved)
            total = moved if total is None else total + moved
        assert total is not None
        return Transition(stock, total, realised)

    def _moved_exactly(self, stock: Floats, rate: Floats, settled: Floats | None = None) -> Floats:
        """Return h·r∘ȳ[driver], ȳ the exact mean of the state over the substep.

        Flows given in ``settled``, shape (arcs, B), hold whatever the state; NaN where the flow law does.
        """
        mean, moved = stock.copy(), np.empty_like(rate)
        for incidence in (*self._horner, None):
            mean.take(self.driver, axis=0, out=moved, mode="clip")
            moved *= rate
            if settled is not None:
                np.copyto(moved, settled, where=~np.isnan(settled))
            if incidence is not None:
                mean[...] = stock
                incidence.add_to(mean, moved)
        moved *= self.substep
        return moved

    def _limit_orders(self, stock: Floats, rate: Floats) -> Floats:
        """Cut scheduled flows so that no donor is overdrawn.

        A donor with stock x, proportional exits a and a constant outflow U obeys ẋ ≥ −a·x − U, which stays
        non-negative for a substep h if U ≤ x·a/(e^{ah} − 1). Flows from one donor are cut by the same factor.
        """
        if not len(self._order_arcs):
            return rate
        outflows = self._orders_and_exits(rate)
        outflows *= self.substep
        asked, turned_over = outflows[: len(self._order_donors)], outflows[len(self._order_donors) :]
        held = stock.take(self._order_donors, axis=0)
        if (asked <= held * (1.0 - turned_over) * (1.0 - 1e-12)).all():
            return rate  # x·a/(e^{ah} − 1) ≥ x(1 − ah)/h: nothing can be overdrawn
        share = np.divide(turned_over, np.expm1(turned_over), out=np.ones_like(held), where=turned_over > 1e-12)
        available = held * share * (1.0 - 1e-12)
        factor = np.divide(available, asked, out=np.ones_like(held), where=asked > available)
        rate = rate.copy()
        rate[self._order_arcs] *= factor.take(self._order_slot, axis=0)
        return rate

    def _move(self, stock: Floats, moved: Floats, rate: Floats) -> tuple[Floats, Floats, Floats]:
        """Move mass; where a recipient-driven flow asked for more than its donor held, send what was there.

        Proportional and scheduled flows never overdraw. A recipient that pulls more than there is gets its share: all
        outflows of the overdrawn node, and their rates, are scaled to the stock it started with. They are then settled,
        and the others follow from them, lest the recipient passes on what it did not get. Each pass settles at least
        one more node.
        """
        if self._pulls:
            moved = np.maximum(moved, 0.0)  # the mean of an overdrawn stock may be negative
        after = self.incidence.add_to(stock.copy(), moved)
        if after.min() >= 0:
            return after, moved, rate
        settled = np.full_like(moved, np.nan)
        while after.min() < 0:
            out = self._outgoing(moved)
            short = (after < 0) & (out > 0)
            held = np.where(stock > NOTHING, stock * (1.0 - 1e-12), 0.0)
            kept = np.divide(held, out, out=np.ones_like(out), where=short)
            share = np.minimum(kept, 1.0).take(self.network.donors, axis=0)
            cut = short.take(self.network.donors, axis=0)
            settled[cut] = (moved * share)[cut] / self.substep
            rate = rate * share
            moved = np.maximum(self._moved_exactly(stock, rate, settled), 0.0)
            after = self.incidence.add_to(stock.copy(), moved)
        return after, moved, rate


def _base_rate(arc: Arc) -> float:
    if arc.law in (Law.DONOR, Law.RECIPIENT):
        return arc.rate
    if arc.law is Law.EXOGENOUS and not arc.times:
        return arc.flow[0]
    return 1.0


def _interval_means(arc: Arc, network: Network) -> Floats:
    """Mean of a step function over each control interval; the last value holds on."""
    edges = np.arange(network.episode.horizon + 1) * network.episode.control_interval
    times, values = np.array(arc.times), np.array(arc.flow)
    total = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(times))])
    index = np.searchsorted(times, edges, side="right") - 1
    means: Floats = np.diff(total[index] + values[index] * (edges - times[index])) / np.diff(edges)
    return means


def _series_terms(size: float) -> int:
    """Smallest K ≥ 2 with size^K/K! ≤ TRUNCATION, size = ‖A‖₁·h."""
    term, k = size, 1
    while term > TRUNCATION or k < 2:
        k += 1
        term *= size / k
    return k
