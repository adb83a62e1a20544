"""What arcs supply that make up for a service while nobody acts on them: business as usual.

The arcs of service s supply u_k = min(low_k + weight_k V_s, high_k). Without cuts the interval's map from V to what the
services measure is affine, q = β + A V with A ≥ 0: one interval with V gives q, one more for each service a column of
A, and then V solves ::

    V_s = 0 where q_s ≥ D_s,    V_s at its most where q_s ≤ D_s,    q_s = D_s elsewhere,

with D the lower ends of the services' bands: a linear complementarity problem. Where an arc is at its bound, or a donor
delivers less, the map bends; it is then solved again from there. What others do in the interval is known. Nothing is
said about a service whose supply cannot be enough: its level falls short.

Where more than ``MOST_PROBES`` services are made up for, A is not measured but what arrives at once (``Arrivals``),
with a factor for each service: how much of what was expected of the last correction has come about.
"""

from __future__ import annotations

from collections.abc import Container, Sequence

import numpy as np

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.uncertain_factors import ControlFactors, RowFactors
from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.elements import Service
from cirl_marl.network.uncertainty import numbers_of

TINY = 1e-9
"""Part of a supply that arrives in an interval, below which it is taken for none."""
CLOSE = 1e-12
"""Distance of what is measured from what is demanded, relative to that, at which nothing lacks."""
PROBE, LEAST = 1e-3, 1e-6
"""Parts of what lacks, and of what is demanded, by the larger of which the columns of A are found."""
ROUNDS, SWEEPS, CHANGES = 12, 500, 30
"""Most times that the map is followed where it bends; and each time Gauss-Seidel sweeps, and changes of which supplies
are at their bounds."""
MOST_PROBES = 4
"""Most services for each of which an interval is tried to find a column of A."""
CELLS = 80_000
"""Most masses of all copies together that are worked on at once; more do not stay in a cache."""
NOTICEABLE = 1e-7
"""Part of what is demanded, beyond which what a correction has brought about tells how the next one will do."""


class Supply:
    """The arcs of a network that make up for services.

    Attributes:
        arcs: their ids.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        """Compile the arcs of ``dynamics``."""
        self._dynamics, network = dynamics, dynamics.network
        made_up = [arc for arc in network.arcs if arc.makes_up_for]
        self.arcs = tuple(arc.id for arc in made_up)
        service_ids = list(dict.fromkeys(arc.makes_up_for for arc in made_up))
        services = [service for service in network.services if service.id in service_ids]
        order = [service.id for service in services]
        self._of: Integers = np.array([order.index(arc.makes_up_for) for arc in made_up], dtype=np.intp)
        self._rows: Integers = np.array([network.control_rows[arc.id].start for arc in made_up], dtype=np.intp)
        weights = [1.0 if arc.weight is None else arc.weight for arc in made_up]
        self._weights = np.array(weights).reshape(-1, 1)
        demand = [network.interval_means(service.low) for service in services]
        self._demand = np.array(demand).reshape(len(services), network.episode.horizon)
        numbers = numbers_of(dynamics.factors.ranges, "services", "low")
        self._factors = RowFactors(
            {row: numbers[service_.id] for row, service_ in enumerate(services) if service_.id in numbers}
        )
        self._drawn = ControlFactors(network, dynamics.factors.ranges, self._rows)
        stores, rows, columns = len(network.stores), [], []
        for row, service in enumerate(services):
            if service.quantity == "stock":
                read = [network.node_index[service_] for service_ in service.providers]
            else:
                read = [stores + int(k) for k in network.service_arcs(service)]
            rows += [row] * len(read)
            columns += read
        self._measure = RowSum(rows, columns, 1.0, (len(services), stores + len(network.arcs)))
        indices = np.array([network.arc_index[arc] for arc in self.arcs], dtype=np.intp)
        self._arrivals = Arrivals(dynamics, services, indices, self._of)
        interval = network.episode.control_interval
        self._duration = np.array([interval if service_.quantity == "stock" else 1.0 for service_ in services])[
            :, None, None
        ]

    def idle(self, agents: Container[str]) -> Bools:
        """Return which of ``arcs`` nobody acts on, shape (arcs, 1)."""
        return np.array([arc not in agents for arc in self.arcs], dtype=bool).reshape(-1, 1)

    def __call__(
        self,
        stock: Floats,
        inner: Floats,
        controls: Floats,
        step: Integers,
        idle: Bools,
        factors: Floats | None = None,
    ) -> Floats:
        """Return the controls of an interval with what ``idle`` arcs supply, shape (controls, B).

        Args:
            stock: masses at its start, as ``Dynamics.advance`` takes them.
            inner: inner states.
            controls: of all others.
            step: index of the interval in each copy, shape (B,).
            idle: which arcs nobody acts on in each copy, shape (arcs, B or 1).
            factors: on the uncertain numbers, as ``Dynamics.advance`` takes them.
        """
        if not idle.any():
            return controls
        batch, idle = controls.shape[1], np.broadcast_to(idle, (len(self.arcs), controls.shape[1]))
        block = max(1, CELLS // self._dynamics.rows.masses)
        if batch <= block:
            return self._controls_of_block(stock, inner, controls, step, idle, factors)
        parts = []
        for columns in (slice(first, first + block) for first in range(0, batch, block)):
            masses, states, others = (np.ascontiguousarray(array[:, columns]) for array in (stock, inner, controls))
            draws = None if factors is None else np.ascontiguousarray(factors[:, columns])
            parts.append(self._controls_of_block(masses, states, others, step[columns], idle[:, columns], draws))
        return np.concatenate(parts, axis=1)

    def _controls_of_block(
        self, stock: Floats, inner: Floats, controls: Floats, step: Integers, idle: Bools, factors: Floats | None
    ) -> Floats:
        """Return what ``__call__`` does, for copies so few that all they take stays in a cache."""
        batch, count = controls.shape[1], len(self._demand)
        low = self._drawn(self._dynamics.control_low[self._rows].take(step, axis=1), factors)
        high = self._dynamics.capacity_in(step, factors)[self._rows]
        demand = self._factors(self._demand.take(step, axis=1), factors)
        most = np.zeros((count, batch))
        weights = np.broadcast_to(self._weights, low.shape)
        range_ = np.divide(high - low, weights, out=np.zeros_like(low), where=idle & (weights > 0))
        np.maximum.at(most, self._of, range_)

        def controls_for(supply: Floats) -> Floats:
            """Return all controls for V, shape (services, B), shape (controls, B)."""
            all_controls = controls.copy()
            target = np.minimum(low + self._weights * supply[self._of], high)
            all_controls[self._rows] = np.where(idle, target, controls[self._rows])
            return all_controls

        def probed_slope(supply: Floats, base: Floats) -> Floats:
            """Return A, shape (services, services, B), from an interval for each column."""
            # small beside what lacks, as a donor may hold little more than that, and not lost in rounding
            probe = np.minimum(np.maximum(PROBE * np.abs(demand - base), LEAST * demand) / interval, PROBE * most)
            trials = [controls_for(supply + probe * (np.arange(count) == s)[:, None]) for s in range(count)]
            responses = self._service_quantities(stock, inner, np.concatenate(trials, axis=1), step, count, factors)
            more = responses.reshape(count, count, batch) - base[:, None]
            return np.divide(more, probe, out=np.zeros_like(more), where=probe > 0)

        def room(supply: Floats) -> Bools:
            """Return which arcs can supply more, shape (arcs, B)."""
            has_room: Bools = idle & (low + self._weights * supply[self._of] < high)
            return has_room

        def arrival_slope(supply: Floats) -> Floats:
            """Return A, but for a factor in each row."""
            rate = self._dynamics.rate(controls_for(supply), step, factors)
            slope_: Floats = self._arrivals(rate, np.where(room(supply), self._weights, 0.0)) * self._duration
            return slope_

        supply, interval = np.zeros((count, batch)), self._dynamics.network.episode.control_interval
        open_, factor = np.ones(batch, dtype=bool), np.ones((count, batch))
        before: tuple[Floats, Floats, Floats] | None = None
        for _ in range(ROUNDS):
            base = self._service_quantities(stock, inner, controls_for(supply), step, 1, factors)
            shortage = demand - base
            lacks = (shortage > CLOSE * demand) & (supply < most) | (shortage < -CLOSE * demand) & (supply > 0)
            open_ &= lacks.any(axis=0)
            if not open_.any():
                break
            if count <= MOST_PROBES:
                slope = _by_copy(probed_slope(supply, base))
            else:
                has_bent = np.ones((1, batch), dtype=bool)
                if before is not None:
                    has_bent = (room(supply) != room(before[0])).any(axis=0, keepdims=True)
                    # where an arc has come to its bound, less was to be expected
                    is_telling = (np.abs(before[2]) > NOTICEABLE * demand) & ~has_bent
                    factor *= np.divide(base - before[1], before[2], out=np.ones_like(base), where=is_telling)
                if has_bent.any():
                    arrivals = _by_copy(arrival_slope(supply))
                slope = arrivals * factor.T[..., None]
            better = np.where(open_, _complementary(slope, shortage, supply, most, interval), supply)
            before = supply, base, (slope * np.ascontiguousarray((better - supply).T)[:, None]).sum(axis=2).T
            supply = better
        return controls_for(supply)

    def _service_quantities(
        self, stock: Floats, inner: Floats, controls: Floats, step: Integers, times: int, factors: Floats | None
    ) -> Floats:
        """Return what the services measure at the end of the interval under several controls, shape (services, …)."""
        dynamics = self._dynamics
        start = np.tile(stock, (1, times)), np.tile(inner, (1, times))
        draws = None if factors is None else np.tile(factors, (1, times))
        done = dynamics.advance(*start, controls, np.tile(step, times), draws)
        flow = done.moved_mass / dynamics.network.episode.control_interval
        return self._measure(np.concatenate([dynamics.rows.stocks(done.stock), flow]))


def _by_copy(slope: Floats) -> Floats:
    """Return A copy by copy, shape (B, services, services), so that sums have the same order whatever the batch."""
    return np.ascontiguousarray(np.moveaxis(slope, 2, 0))


def _complementary(slope: Floats, shortage: Floats, supply: Floats, most: Floats, interval: float) -> Floats:
    """Return V, shape (services, B), at which nothing lacks that can be supplied, for q linear around ``supply``.

    Each copy goes its own way, whatever the others in the batch do.

    Args:
        slope: A, shape (B, services, services).
        shortage: D − q at ``supply``, shape (services, B).
        supply: V.
        most: largest V.
        interval: length of an interval, by which a flow becomes a stock.
    """
    short, now, high = (np.ascontiguousarray(array.T) for array in (shortage, supply, most))
    # more of what does not arrive is not supplied
    arrives = np.diagonal(slope, axis1=1, axis2=2) > TINY * min(1.0, interval)
    if len(shortage) == 1:
        return _gauss_seidel(slope, short, now, high, arrives).T
    solution, is_solved = _active_set(slope, short, now, high, arrives)
    if not is_solved.all():
        solution = np.where(is_solved[:, None], solution, _gauss_seidel(slope, short, now, high, arrives))
    return np.ascontiguousarray(solution.T)


def _active_set(slope: Floats, shortage: Floats, supply: Floats, most: Floats, arrives: Bools) -> tuple[Floats, Bools]:
    """Return V as ``_complementary`` does, shape (B, services), and in which copies it is found.

    All supplies between their bounds are solved for together; then it is changed which these are. A copy for which that
    comes to no end is left to others.
    """
    target = shortage + (slope * supply[:, None]).sum(axis=2)
    pinned_values: Floats
    free, pinned_values = arrives & (most > 0), np.where(arrives, 0.0, supply)
    solution, is_solved, unit = supply.copy(), np.zeros(len(supply), dtype=bool), np.eye(supply.shape[1])
    for _ in range(CHANGES):
        trial = _solve(np.where(free[..., None], slope, unit), np.where(free, target, pinned_values))
        excess = target - (slope * trial[:, None]).sum(axis=2)  # what lacks still
        under, over = free & (trial < 0), free & (trial > most)
        back = ~free & arrives & (most > 0) & np.where(pinned_values > 0, excess < 0, excess > 0)
        is_settled = ~(under | over | back).any(axis=1) & np.isfinite(trial).all(axis=1)
        solution[is_settled & ~is_solved] = trial[is_settled & ~is_solved]
        is_solved |= is_settled
        if is_solved.all():
            break
        pinned_values = np.where(under, 0.0, np.where(over, most, pinned_values))
        free = np.asarray((free & ~under & ~over) | back)
    return solution, is_solved


def _solve(matrix: Floats, target: Floats) -> Floats:
    """Return the solutions of linear systems, shape (B, services); NaN where one is singular."""
    try:
        solution: Floats = np.asarray(np.linalg.solve(matrix, target[..., None])[..., 0], dtype=np.float64)
    except np.linalg.LinAlgError:
        if len(matrix) == 1:
            return np.full_like(target, np.nan)
        return np.concatenate([_solve(matrix[i : i + 1], target[i : i + 1]) for i in range(len(matrix))])
    return solution


def _gauss_seidel(slope: Floats, shortage: Floats, supply: Floats, most: Floats, arrives: Bools) -> Floats:
    """Return V as ``_complementary`` does, shape (B, services), by projected Gauss-Seidel sweeps."""
    count, solution = shortage.shape[1], supply.copy()
    open_ = np.ones(len(shortage), dtype=bool)
    for _ in range(SWEEPS):
        before = solution.copy()
        for s in range(count):
            short = shortage[:, s] - (slope[:, s] * (solution - supply)).sum(axis=1)
            step = np.divide(short, slope[:, s, s], out=np.zeros_like(short), where=arrives[:, s])
            solution[:, s] = np.where(open_, np.clip(solution[:, s] + step, 0.0, most[:, s]), solution[:, s])
        open_ &= (np.abs(solution - before) > 1e-15 * solution).any(axis=1)
        if count == 1 or not open_.any():
            break
    return solution


class Arrivals:
    """What some arcs add at once to what services measure, past nodes that store nothing, by the shares of an interval.

    What reaches a stock counts in full, as if it stayed there for the interval.
    """

    def __init__(self, laws: FlowLaws, services: Sequence[Service], arcs: Integers, of: Integers) -> None:
        """Take the arcs, and which of ``services`` each stands for."""
        self._laws, self._arcs, self._of, self._count = laws, arcs, of, len(services)
        network, routing = laws.staged_network, laws.routing
        stores = len(network.stores)
        ends = network.recipients[arcs] - stores
        self._stockless_ends: Integers = np.flatnonzero(ends >= 0)
        self._into: Integers = routing.places[ends[self._stockless_ends]]
        into: dict[str, list[int]] = {}
        for k, arc in enumerate(network.arcs):
            into.setdefault(arc.recipient, []).append(k)
        parts, stocks = getattr(network, "parts", {}), dict[str, set[str]]()
        for node in network.stores:
            stocks.setdefault(parts.get(node.id, node.id), set()).add(node.id)
        rows: list[int] = []
        columns: list[int] = []
        place = {int(k): n for n, k in enumerate([*routing.arcs, *arcs])}
        for row, service in enumerate(services):
            if service.quantity == "stock":
                stock = set[str]().union(*(stocks.get(id_, ()) for id_ in service.providers))
                # what its parts hand on to each other is there already
                measured_arcs = [k for id_ in stock for k in into.get(id_, ()) if network.arcs[k].donor not in stock]
            else:
                measured_arcs = [int(k) for k in laws.staged_network.service_arcs(service)]
            columns_ = [place[k] for k in measured_arcs if k in place]
            rows += [row] * len(columns_)
            columns += columns_
        self._measure = RowSum(rows, columns, 1.0, (len(services), len(place)))

    def __call__(self, rate: Floats, weights: Floats) -> Floats:
        """Return what each service measures more per supply to each, shape (services, services, B), per time.

        Args:
            rate: of all arcs in the interval, with their shares, shape (arcs, B).
            weights: of each of ``arcs`` in the supply that it belongs to, shape (arcs, B).
        """
        routing = self._laws.routing
        routes = routing.routes(rate)
        response = np.zeros((self._count, self._count, rate.shape[1]))
        shares = rate.take(routing.arcs, 0)
        for s in range(self._count):
            supply = np.where(self._of[:, None] == s, weights, 0.0)
            through = np.zeros((routing.nodes, rate.shape[1]))
            np.add.at(through, self._into, supply[self._stockless_ends])
            onward_flow = np.empty((0, rate.shape[1]))
            if routes is not None:
                onward_flow = routing.throughputs(through, routes).take(routing.throughput_rows, 0) * shares
            response[:, s] = self._measure(np.concatenate([onward_flow, supply]))
        return response
