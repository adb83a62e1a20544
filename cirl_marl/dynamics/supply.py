"""What arcs supply that make up for a service while nobody acts on them: business as usual.

The arcs of service s supply u_k = min(low_k + weight_k v_s, high_k), with v_s such that together they supply U_s more
than low. Without cuts the interval's map from U to what the services measure is affine, q = β + A U with A ≥ 0, and
U solves ::

    U_s = 0 where q_s ≥ D_s,    U_s at its most where q_s ≤ D_s,    q_s = D_s elsewhere,

with D the lower ends of the services' bands: a linear complementarity problem. A is what arrives at once past nodes
without stock (``Arrivals``), with a factor for each service: how much of what was expected of a correction has come
about. Where that does not lead there, as where much comes back within the interval, A is what secants make of it
(Broyden). Intervals are estimated by few terms of the solver's series until little lacks, then simulated; the last of
these is the interval itself. What others do in it is known. A service whose supply cannot be enough falls short.

U exists, as q is continuous and U bounded (Brouwer), but where supplies serve other services more than their own there
may be several. A service that is off though it need not be, as corrections ran out, is told in a warning.
"""

from __future__ import annotations

import warnings
from collections.abc import Container, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from cirl_marl.dynamics.arrivals import Arrivals
from cirl_marl.dynamics.complementarity import TINY, complementary
from cirl_marl.dynamics.integrator import Dynamics, Transition
from cirl_marl.dynamics.uncertain_factors import ControlFactors, RowFactors
from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.uncertainty import numbers_of

CLOSE = 1e-10
"""Distance of what is measured from what is demanded, relative to that, at which nothing lacks."""
ROUNDS, FACTOR_ROUNDS = 24, 4
"""Most corrections, and those after which A is changed as a whole where factors have not led there."""
SECANTS, DIFFERENCE = 6, 1e-4
"""Corrections by secants after which A is measured anew, and the part of the most by which it then shifts supplies."""
LEVELS = ((2, 4e-4, 2), (8, 3e-9, 5), (None, 0.0, ROUNDS + 1))
"""Terms of the solver's series by which intervals are estimated; part of the demand that may lack after one more
correction, if that does as well as the last one; and most of these intervals. The last ones are simulated in full."""
NOTABLE = 1e-6
"""Part of a demand that, if it lacks though it could be had, is told in a warning."""
ROUND_OFF = 1e-12
"""Part of the most that a supply may be from its ends and still be at them."""
CELLS = 80_000
"""Most masses of all copies together that are worked on at once; more do not stay in a cache."""
NOTICEABLE = 3e-3, 1e-7
"""Part of what is demanded, beyond which what a correction has brought about tells how the next one will do: between
intervals with other numbers of terms, and with the same."""


class Supply:
    """The arcs of a network that make up for services.

    Attributes:
        dynamics: of the network.
        arcs: their ids.
        of: service that each stands for, among those that arcs make up for, shape (arcs,).
        indices: position of each among the arcs of the network.
        rows: row of each among the controls.
        weights: of each, shape (arcs, 1).
        total: sums over the arcs of each service.
        services: ids of these services.
        demand: D in each interval, shape (services, horizon).
        demand_factors: factors on it.
        drawn: factors on the bounds of ``rows``.
        measures: q of stocks, and of mean flows.
        arrivals: A.
        duration: by which A is multiplied, an interval or 1.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        """Compile the arcs of ``dynamics``."""
        self.dynamics, network = dynamics, dynamics.network
        made_up = [arc for arc in network.arcs if arc.makes_up_for]
        self.arcs = tuple(arc.id for arc in made_up)
        service_ids = list(dict.fromkeys(arc.makes_up_for for arc in made_up))
        services = [service for service in network.services if service.id in service_ids]
        order = [service.id for service in services]
        self.of: Integers = np.array([order.index(arc.makes_up_for) for arc in made_up], dtype=np.intp)
        self.rows: Integers = np.array([network.control_rows[arc.id].start for arc in made_up], dtype=np.intp)
        weights = [1.0 if arc.weight is None else arc.weight for arc in made_up]
        self.weights = np.array(weights).reshape(-1, 1)
        self.total = RowSum(self.of, np.arange(len(made_up)), 1.0, (len(services), len(made_up)))
        demand = [network.interval_means(service.low) for service in services]
        self.services, self._warnings = order, set[int]()
        self.demand = np.array(demand).reshape(len(services), network.episode.horizon)
        numbers = numbers_of(dynamics.factors.ranges, "services", "low")
        self.demand_factors = RowFactors(
            {row: numbers[service_.id] for row, service_ in enumerate(services) if service_.id in numbers}
        )
        self.drawn = ControlFactors(network, dynamics.factors.ranges, self.rows)
        of_stocks: list[tuple[int, int]] = []
        of_flows: list[tuple[int, int]] = []
        for row, service in enumerate(services):
            if service.quantity == "stock":
                of_stocks += [(row, network.node_index[node]) for node in service.providers]
            else:
                of_flows += [(row, int(k)) for k in network.service_arcs(service)]
        widths = (of_stocks, len(network.stores)), (of_flows, len(network.arcs))
        self.measures = tuple(
            RowSum([row for row, _ in places], [column for _, column in places], 1.0, (len(services), width))
            for places, width in widths
        )
        self._reads_flows = bool(of_flows)
        self.indices: Integers = np.array([network.arc_index[arc] for arc in self.arcs], dtype=np.intp)
        # what is supplied is an order of each component
        staged_network = dynamics.staged_network
        copies = [staged_network.components_of(id_) for id_ in self.arcs]
        self._order_arcs = np.array([staged_network.arc_index[id_] for ids in copies for id_ in ids], dtype=np.intp)
        self._order_rows: Integers = np.repeat(self.rows, [len(ids) for ids in copies])
        self.arrivals = Arrivals(dynamics, services, self.indices)
        self._interval = interval = network.episode.control_interval
        self.duration = np.array([interval if service_.quantity == "stock" else 1.0 for service_ in services])[:, None]

    def idle(self, agents: Container[str]) -> Bools:
        """Return which of ``arcs`` nobody acts on, shape (arcs, 1)."""
        return np.array([arc not in agents for arc in self.arcs], dtype=bool).reshape(-1, 1)

    def bounds(self, step: Integers, factors: Floats | None) -> tuple[Floats, Floats]:
        """Return the least and the most that each of ``arcs`` can supply in an interval of each copy, (arcs, B)."""
        low = self.drawn(self.dynamics.control_low[self.rows].take(step, axis=1), factors)
        return low, self.dynamics.capacity_in(step, factors)[self.rows]

    def __call__(
        self,
        stock: Floats,
        inner: Floats,
        controls: Floats,
        step: Integers,
        idle: Bools,
        factors: Floats | None = None,
    ) -> Floats:
        """Return the controls of an interval with what ``idle`` arcs supply; arguments are as in ``advance``."""
        return self.advance(stock, inner, controls, step, idle, factors)[0] if idle.any() else controls

    def advance(
        self,
        stock: Floats,
        inner: Floats,
        controls: Floats,
        step: Integers,
        idle: Bools,
        factors: Floats | None = None,
    ) -> tuple[Floats, Transition]:
        """Hold controls for an interval in which ``idle`` arcs make up for services.

        Args:
            stock: masses at its start, as ``Dynamics.advance`` takes them.
            inner: inner states.
            controls: of all others, shape (controls, B).
            step: index of the interval in each copy, shape (B,).
            idle: which arcs nobody acts on in each copy, shape (arcs, B or 1).
            factors: on the uncertain numbers, as ``Dynamics.advance`` takes them.

        Returns:
            the controls with what the arcs supply, and what the interval did.
        """
        batch, is_idle = controls.shape[1], bool(idle.any())
        block = max(1, CELLS // self.dynamics.rows.masses)
        if not is_idle and batch <= block:
            return controls, self.dynamics.advance(stock, inner, controls, step, factors)
        idle, parts = np.broadcast_to(idle, (len(self.arcs), batch)), []
        for columns in (slice(first, first + block) for first in range(0, batch, block)):
            masses, states, others = (np.ascontiguousarray(array[:, columns]) for array in (stock, inner, controls))
            draws = None if factors is None else np.ascontiguousarray(factors[:, columns])
            inputs = masses, states, others, step[columns]
            if is_idle:
                parts.append(self._advance_block(*inputs, idle[:, columns], draws))
            else:
                parts.append((others, self.dynamics.advance(*inputs, draws)))
        if len(parts) == 1:
            return parts[0]
        arrays = zip(*([getattr(done, field.name) for field in fields(done)] for _, done in parts), strict=True)
        joint: list[Any] = [None if array[0] is None else np.concatenate(array, axis=-1) for array in arrays]
        return np.concatenate([part for part, _ in parts], axis=1), Transition(*joint)

    def slope(self, arrivals: Floats, supply: Floats) -> Floats:
        """Return A, what each service measures more, per time, of a unit for each, shape (B, services, services).

        Args:
            arrivals: what one unit of each arc adds (``Arrivals``).
            supply: what each of the arcs carries of a unit for its service, shape (arcs, B).
        """
        services = len(self.demand)
        flows = (arrivals * supply[..., None]).reshape(len(supply), -1)
        # copy by copy in memory, so that sums have the same order whatever the batch
        return np.ascontiguousarray(self.total(flows).reshape(services, -1, services).transpose(1, 2, 0))

    def _advance_block(
        self, stock: Floats, inner: Floats, controls: Floats, step: Integers, idle: Bools, factors: Floats | None
    ) -> tuple[Floats, Transition]:
        """Do what ``advance`` does, for copies so few that all they take stays in a cache."""
        dynamics, batch = self.dynamics, controls.shape[1]
        range_, all_controls = SupplyRange(self, step, idle, factors), controls.copy()
        demand = self.demand_factors(self.demand.take(step, axis=1), factors)
        supply, base, expected = np.zeros((3, *demand.shape))
        factor, done = np.ones(demand.shape), None
        change, slope = np.zeros_like(supply), np.zeros((batch, len(demand), len(demand)))
        all_controls[self.rows] = 1.0
        unit_rate = dynamics.rate(all_controls, step, factors)
        routes = dynamics.routing.routes(dynamics.orders.further_shares(unit_rate))
        arrivals = self.arrivals(routes)
        lack = np.ones(batch)
        for terms, accuracy, rounds in LEVELS if dynamics.taylor is not None and not dynamics.orders else LEVELS[-1:]:
            open_ = np.ones(batch, dtype=bool)
            for correction in range(rounds):
                extent = range_.extents(supply)[self.of]
                all_controls[self.rows] = np.where(idle, range_.amounts(extent), controls[self.rows])
                copies, earlier, base = np.flatnonzero(open_), base, base.copy()
                rate = unit_rate.copy()
                rate[self._order_arcs] *= all_controls[self._order_rows]
                inputs = _of_copies(copies, stock, inner, all_controls, step, factors, routes, rate)
                if terms is None:
                    part = dynamics.advance(*inputs)
                    done = part if done is None or len(copies) == batch else _with_copies(done, copies, part)
                    base[:, copies] = self.quantities(part.stock, part.moved_mass)
                else:
                    estimate = dynamics.estimate(*inputs, terms=terms, flows=self._reads_flows)
                    base[:, copies] = self.quantities(*estimate)
                shortage = demand - base
                end = ROUND_OFF * range_.most
                has_room = np.where(shortage > 0, supply < range_.most - end, supply > end)
                gap = np.where(has_room, np.abs(shortage), 0.0)
                is_wrong = open_ & (gap > CLOSE * demand).any(axis=0)
                expected = np.where(open_ & ~is_wrong, 0.0, expected)  # what stays as it is changes nothing
                if not is_wrong.any() or (terms is None and correction == rounds - 1):
                    break
                before, wrong = supply.copy(), np.flatnonzero(is_wrong)
                if terms is None and correction > FACTOR_ROUNDS:
                    slope = _broyden(slope, change, base - earlier - expected)
                    if (correction - FACTOR_ROUNDS) % SECANTS == 0:
                        inputs = _of_copies(wrong, stock, inner, controls, step, idle, factors, supply, base)
                        slope[wrong] = self._measured_slope(*inputs)
                else:
                    is_telling = is_wrong & (np.abs(expected) > NOTICEABLE[correction > 0] * demand)
                    factor *= np.divide(base - earlier, expected, out=np.ones_like(base), where=is_telling)
                    factor[factor <= 0] = 1.0  # what others supplied outweighed it
                    slope = self.slope(arrivals, range_.unit(extent))
                    slope = slope * np.ascontiguousarray((self.duration * factor).T)[..., None]
                short, now, most = (array.take(wrong, axis=1) for array in (shortage, supply, range_.most))
                supply[:, wrong] = complementary(slope[wrong], short, now, most, self._interval)
                change = supply - before
                expected = np.where(is_wrong, (slope * np.ascontiguousarray(change.T)[:, None]).sum(axis=2).T, expected)
                # what nothing is demanded of lacks as a whole
                lacks, earlier_lack = np.divide(gap, demand, out=np.sign(gap), where=demand > 0), lack
                lack = np.where(is_wrong, lacks.max(axis=0), lack)  # others keep theirs, as if they were alone
                open_ = is_wrong & (lack * lack > accuracy * earlier_lack) & (change != 0.0).any(axis=0)
                if not open_.any():
                    break
        assert done is not None
        if (gap > NOTABLE * demand).any():
            # more would arrive, and no source has run out
            arrives = np.diagonal(slope, axis1=1, axis2=2).T > TINY * min(1.0, self._interval)
            is_cut = done.moved_mass[self.indices] < (1.0 - NOTABLE) * self._interval * all_controls[self.rows]
            could_move = arrives & (self.total(np.where(is_cut & idle, 1.0, 0.0)) == 0)
            self._warn(np.where(could_move, gap, 0.0), demand, step)
        return all_controls, done

    def _warn(self, gap: Floats, demand: Floats, step: Integers) -> None:
        """Warn, once for each service, that corrections ran out before supplies were what they should be."""
        for row, copy in np.argwhere(gap > NOTABLE * demand).tolist():
            if row not in self._warnings:
                self._warnings.add(row)
                part = gap[row, copy] / demand[row, copy] if demand[row, copy] else np.inf
                arcs = ", ".join(arc for arc, of in zip(self.arcs, self.of.tolist(), strict=True) if of == row)
                warnings.warn(
                    f"network '{self.dynamics.network.name}': service '{self.services[row]}' is {part:.3g} of its "
                    f"demand off in interval {step[copy]} of copy {copy}; "
                    f"{arcs} could make up for it, but corrections ran out",
                    RuntimeWarning,
                    stacklevel=2,
                )

    def _measured_slope(
        self,
        stock: Floats,
        inner: Floats,
        controls: Floats,
        step: Integers,
        idle: Bools,
        factors: Floats | None,
        supply: Floats,
        base: Floats,
    ) -> Floats:
        """Return A, shape (B, services, services), by difference quotients around ``supply``, which gave ``base``."""
        services, batch = supply.shape
        copies, shifted = np.repeat(np.arange(batch), services), np.tile(np.arange(services), batch)
        stock, inner, controls, step, idle, factors, supply, base = _of_copies(
            copies, stock, inner, controls, step, idle, factors, supply, base
        )
        range_, place = SupplyRange(self, step, idle, factors), (shifted, np.arange(len(copies)))
        most = range_.most[place]
        shift = np.where(supply[place] < most / 2, DIFFERENCE, -DIFFERENCE) * most
        supply, controls = supply.copy(), controls.copy()
        supply[place] += shift
        amounts = range_.amounts(range_.extents(supply)[self.of])
        controls[self.rows] = np.where(idle, amounts, controls[self.rows])
        done = self.dynamics.advance(stock, inner, controls, step, factors)
        change = self.quantities(done.stock, done.moved_mass) - base
        slope = np.divide(change, shift, out=np.zeros_like(change), where=shift != 0)
        return np.ascontiguousarray(slope.reshape(services, batch, services).transpose(1, 0, 2))

    def quantities(self, stock: Floats, moved_mass: Floats | None) -> Floats:
        """Return what the services measure at the end of an interval, shape (services, B)."""
        of_stocks, of_flows = self.measures
        measured = of_stocks(self.dynamics.rows.stocks(stock))
        return measured if moved_mass is None else of_flows.add_to(measured, moved_mass / self._interval)


class SupplyRange:
    """What arcs can supply in an interval of each copy: between ``low`` and ``high``, by ``weights`` of an extent v.

    Attributes:
        low: the least of each arc, shape (arcs, B).
        high: the most.
        weights: those of arcs that are idle, 0 of others.
        most: largest U, shape (services, B).
    """

    def __init__(self, supply: Supply, step: Integers, idle: Bools, factors: Floats | None) -> None:
        """Find the ranges of ``idle`` arcs of ``supply``."""
        self._of, self._total = supply.of, supply.total
        self.low, self.high = supply.bounds(step, factors)
        self.weights = np.where(idle, supply.weights, 0.0)
        room = np.maximum(self.high - self.low, 0.0)
        self._reach = np.divide(room, self.weights, out=np.zeros_like(room), where=self.weights > 0)
        self.most, self._furthest = self._total(self.weights * self._reach), np.zeros((len(supply.demand), len(step)))
        np.maximum.at(self._furthest, self._of, self._reach)
        self._bends = int(np.bincount(self._of).max(initial=0))

    def extents(self, supply: Floats) -> Floats:
        """Return v, at which arcs supply U, shape (services, B)."""
        extent, is_open = np.zeros_like(supply), np.ones(supply.shape, dtype=bool)
        for bend in range(1, self._bends + 1):  # U is concave in v: each tangent leads past a bend, or to the end
            of_arcs = extent[self._of]
            lack = supply - self._total(self.weights * np.minimum(of_arcs, self._reach))
            per_extent = self._total(np.where(of_arcs < self._reach, self.weights, 0.0))
            extent += np.divide(lack, per_extent, out=np.zeros_like(lack), where=is_open & (per_extent > 0))
            if bend == self._bends:
                break
            is_open = self._total(np.where((extent[self._of] > self._reach) & (of_arcs < self._reach), 1.0, 0.0)) > 0
            if not is_open.any():
                break
        return np.where(supply < self.most, extent, self._furthest)

    def amounts(self, extent: Floats) -> Floats:
        """Return what arcs supply at their extents, shape (arcs, B)."""
        return np.minimum(self.low + self.weights * extent, self.high)

    def unit(self, extent: Floats) -> Floats:
        """Return what each arc carries of a further unit for its service, at the extents of arcs, shape (arcs, B)."""
        # where all have come to their bounds, the last that did can go back
        has_room = (self.weights > 0) & ((extent < self._reach) | (self._reach >= self._furthest[self._of]))
        per_extent = self._total(np.where(has_room, self.weights, 0.0))[self._of]
        return np.divide(self.weights, per_extent, out=np.zeros_like(self.weights), where=has_room)


def _broyden(slope: Floats, change: Floats, difference: Floats) -> Floats:
    """Return A, shape (B, services, services), with the least change by which it tells what a change of supplies did.

    Where nothing more of a service would arrive by it, its row stays.

    Args:
        slope: A.
        change: ΔU, shape (services, B).
        difference: Δq − A ΔU, likewise.

    References: Broyden 1965, Mathematics of Computation 19, 577.
    """
    moved, error = np.ascontiguousarray(change.T), np.ascontiguousarray(difference.T)
    size = (moved * moved).sum(axis=1)[:, None]
    direction = np.divide(moved, size, out=np.zeros_like(moved), where=size > 0)
    better: Floats = slope + error[:, :, None] * direction[:, None]
    arrives = np.diagonal(better, axis1=1, axis2=2) > 0.0
    return np.where(arrives[..., None], better, slope)


def _of_copies(copies: Integers, *arrays: Any) -> Sequence[Any]:
    """Return some copies of arrays whose last axis they are, and of routes; the same if these are all."""
    if len(copies) == arrays[0].shape[-1]:
        return arrays
    return [
        array.take(copies, axis=-1) if isinstance(array, np.ndarray) else array and array.of_copies(copies)
        for array in arrays
    ]


def _with_copies(done: Transition, copies: Integers, part: Transition) -> Transition:
    """Return what an interval did, with some copies, in place, as they are in ``part``."""
    for field in fields(done):
        if (array := getattr(done, field.name)) is not None:
            array[..., copies] = getattr(part, field.name)
    return done
