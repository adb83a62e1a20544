"""What arcs supply that make up for a service while nobody acts on them: business as usual.

The arcs of service s supply u_k = min(low_k + weight_k v_s, high_k), with v_s such that together they supply U_s more
than low. Without cuts the interval's map from U to what the services measure is affine, q = β + A U with A ≥ 0, and
U solves ::

    U_s = 0 where q_s ≥ D_s,    U_s at its most where q_s ≤ D_s,    q_s = D_s elsewhere,

with D the lower ends of the services' bands: a linear complementarity problem. A is what arrives at once past nodes
without stock (``Arrivals``), with a factor for each service: how much of what was expected of the last correction has
come about. Where arcs have come to their bounds their column is found anew. The last of the intervals that are
simulated on the way is the interval itself. What others do in it is known. Nothing is said about a service whose supply
cannot be enough: its level falls short.
"""

from __future__ import annotations

from collections.abc import Container, Sequence
from dataclasses import fields
from typing import Any

import numpy as np

from cirl_marl.dynamics.complementarity import complementary
from cirl_marl.dynamics.integrator import Dynamics, Transition
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.routing import IntervalRoutes
from cirl_marl.dynamics.uncertain_factors import ControlFactors, RowFactors
from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.elements import Service
from cirl_marl.network.uncertainty import numbers_of

CLOSE = 3e-10
"""Distance of what is measured from what is demanded, relative to that, at which nothing lacks."""
ROUNDS = 12
"""Most corrections."""
TERMS, SURE, GUESSES = 5, 6e-6, 4
"""Terms of the solver's series by which intervals are guessed until no more than this part of the demand lacks: what is
left then after one more correction is little; and most corrections by guesses."""
CELLS = 80_000
"""Most masses of all copies together that are worked on at once; more do not stay in a cache."""
NOTICEABLE = 1e-7
"""Part of what is demanded, beyond which what a correction has brought about tells how the next one will do."""


class Supply:
    """The arcs of a network that make up for services.

    Attributes:
        arcs: their ids.
        of: service that each stands for, among those that arcs make up for, shape (arcs,).
        rows: row of each among the controls.
        weights: of each, shape (arcs, 1).
        total: sums over the arcs of each service.
        demand: D in each interval, shape (services, horizon).
        demand_factors: factors on it.
        drawn: factors on the bounds of ``rows``.
        measure: q of stocks and mean flows.
        arrivals: A.
        duration: by which A is multiplied, an interval or 1.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        """Compile the arcs of ``dynamics``."""
        self._dynamics, network = dynamics, dynamics.network
        made_up = [arc for arc in network.arcs if arc.makes_up_for]
        self.arcs = tuple(arc.id for arc in made_up)
        service_ids = list(dict.fromkeys(arc.makes_up_for for arc in made_up))
        services = [service for service in network.services if service.id in service_ids]
        order = [service.id for service in services]
        self.of: Integers = np.array([order.index(arc.makes_up_for) for arc in made_up], dtype=np.intp)
        self.rows: Integers = np.array([network.control_rows[arc.id].start for arc in made_up], dtype=np.intp)
        weights = [1.0 if arc.weight is None else arc.weight for arc in made_up]
        self.weights, self._most_arcs = np.array(weights).reshape(-1, 1), int(np.bincount(self.of).max(initial=0))
        self.total = RowSum(self.of, np.arange(len(made_up)), 1.0, (len(services), len(made_up)))
        demand = [network.interval_means(service.low) for service in services]
        self.demand = np.array(demand).reshape(len(services), network.episode.horizon)
        numbers = numbers_of(dynamics.factors.ranges, "services", "low")
        self.demand_factors = RowFactors(
            {row: numbers[service_.id] for row, service_ in enumerate(services) if service_.id in numbers}
        )
        self.drawn = ControlFactors(network, dynamics.factors.ranges, self.rows)
        stores, rows, columns = len(network.stores), [], []
        for row, service in enumerate(services):
            if service.quantity == "stock":
                read = [network.node_index[service_] for service_ in service.providers]
            else:
                read = [stores + int(k) for k in network.service_arcs(service)]
            rows += [row] * len(read)
            columns += read
        self.measure = RowSum(rows, columns, 1.0, (len(services), stores + len(network.arcs)))
        indices = np.array([network.arc_index[arc] for arc in self.arcs], dtype=np.intp)
        self.arrivals = Arrivals(dynamics, services, indices, self.of)
        interval = network.episode.control_interval
        self.duration = np.array([interval if service_.quantity == "stock" else 1.0 for service_ in services])[:, None]

    def idle(self, agents: Container[str]) -> Bools:
        """Return which of ``arcs`` nobody acts on, shape (arcs, 1)."""
        return np.array([arc not in agents for arc in self.arcs], dtype=bool).reshape(-1, 1)

    def bounds(self, step: Integers, factors: Floats | None) -> tuple[Floats, Floats]:
        """Return the least and the most that each of ``arcs`` can supply in an interval of each copy, (arcs, B)."""
        low = self.drawn(self._dynamics.control_low[self.rows].take(step, axis=1), factors)
        return low, self._dynamics.capacity_in(step, factors)[self.rows]

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
        if not idle.any():
            return controls, self._dynamics.advance(stock, inner, controls, step, factors)
        batch, idle = controls.shape[1], np.broadcast_to(idle, (len(self.arcs), controls.shape[1]))
        block = max(1, CELLS // self._dynamics.rows.masses)
        parts = []
        for columns in (slice(first, first + block) for first in range(0, batch, block)):
            masses, states, others = (np.ascontiguousarray(array[:, columns]) for array in (stock, inner, controls))
            draws = None if factors is None else np.ascontiguousarray(factors[:, columns])
            parts.append(self._advance_block(masses, states, others, step[columns], idle[:, columns], draws))
        if len(parts) == 1:
            return parts[0]
        arrays = zip(*([getattr(done, field.name) for field in fields(done)] for _, done in parts), strict=True)
        joint: list[Any] = [None if array[0] is None else np.concatenate(array, axis=-1) for array in arrays]
        return np.concatenate([part for part, _ in parts], axis=1), Transition(*joint)

    def _advance_block(
        self, stock: Floats, inner: Floats, controls: Floats, step: Integers, idle: Bools, factors: Floats | None
    ) -> tuple[Floats, Transition]:
        """Do what ``advance`` does, for copies so few that all they take stays in a cache."""
        dynamics, batch, count = self._dynamics, controls.shape[1], len(self.demand)
        low, high = self.bounds(step, factors)
        demand = self.demand_factors(self.demand.take(step, axis=1), factors)
        weights = np.where(idle, self.weights, 0.0)
        reach = np.divide(np.maximum(high - low, 0.0), weights, out=np.zeros_like(low), where=weights > 0)
        most, furthest = self.total(weights * reach), np.zeros((count, batch))
        np.maximum.at(furthest, self.of, reach)

        def extents(supply: Floats) -> Floats:
            """Return v, at which arcs supply U, shape (services, B)."""
            extent = np.zeros_like(supply)
            for _ in range(self._most_arcs):  # U is concave in v: each tangent leads past a bend, or to the end
                lack = supply - self.total(weights * np.minimum(extent[self.of], reach))
                per_extent = self.total(np.where(extent[self.of] < reach, weights, 0.0))
                extent += np.divide(lack, per_extent, out=np.zeros_like(lack), where=per_extent > 0)
            return np.where(supply < most, extent, furthest)

        supply, base = np.zeros((2, count, batch))
        factor = np.ones((count, batch))
        all_controls, room = controls.copy(), None
        rate = dynamics.rate(controls, step, factors)
        routes, interval = dynamics.routing.routes(rate), dynamics.network.episode.control_interval
        done: Transition | None = None
        for terms, accuracy, rounds in ((TERMS, SURE, GUESSES), (None, CLOSE, ROUNDS)):
            open_, expected = np.ones(batch, dtype=bool), np.zeros((count, batch))
            for correction in range(rounds + 1):
                extent = extents(supply)[self.of]
                target = np.minimum(low + weights * extent, high)
                all_controls[self.rows] = np.where(idle, target, controls[self.rows])
                copies = np.flatnonzero(open_)
                masses, insides, asked = (table.take(copies, axis=1) for table in (stock, inner, all_controls))
                drawn = None if factors is None else factors.take(copies, axis=1)
                ways = routes if routes is None or len(copies) == batch else routes.of_copies(copies)
                part = dynamics.advance(masses, insides, asked, step[copies], drawn, routes=ways, terms=terms)
                done = part if done is None or len(copies) == batch else _with_copies(done, copies, part)
                earlier, base[:, copies] = base.copy(), self._quantities(part)
                shortage = demand - base
                gap = np.where(np.where(shortage > 0, supply < most, supply > 0), np.abs(shortage), 0.0)
                is_wrong = open_ & (gap > CLOSE * demand).any(axis=0)
                if correction == rounds or not is_wrong.any():
                    break
                is_telling = is_wrong & (np.abs(expected) > NOTICEABLE * demand)
                factor *= np.divide(base - earlier, expected, out=np.ones_like(base), where=is_telling)
                factor[factor <= 0] = 1.0  # what others supplied outweighed it
                # where all have come to their bounds, the last that did can go back
                has_room = (weights > 0) & ((extent < reach) | (reach >= furthest[self.of]))
                per_extent = self.total(np.where(has_room, weights, 0.0))[self.of]
                unit = np.divide(weights, per_extent, out=np.zeros_like(weights), where=has_room)
                if room is None:
                    slope = self.arrivals(rate, routes, unit, np.arange(count)[:, None].repeat(batch, 1))
                else:
                    bent, where = np.nonzero(self.total((has_room != room).astype(float)))
                    if len(bent):
                        ways = None if routes is None else routes.of_copies(where)
                        column = self.arrivals(rate.take(where, 1), ways, unit.take(where, 1), bent[None])
                        slope[where, :, bent] = column[..., 0]
                room = has_room
                # copy by copy in memory, so that sums have the same order whatever the batch
                per_supply = slope * np.ascontiguousarray((self.duration * factor).T)[..., None]
                before, wrong = supply.copy(), np.flatnonzero(is_wrong)
                short, now, high_ = (array.take(wrong, axis=1) for array in (shortage, supply, most))
                supply[:, wrong] = complementary(per_supply[wrong], short, now, high_, interval)
                change = supply - before
                expected = (per_supply * np.ascontiguousarray(change.T)[:, None]).sum(axis=2).T
                open_ = is_wrong & (gap > accuracy * demand).any(axis=0) & (change != 0.0).any(axis=0)
                if not open_.any():
                    break
        assert done is not None
        return all_controls, done

    def _quantities(self, done: Transition) -> Floats:
        """Return what the services measure at the end of an interval, shape (services, B)."""
        flow = done.moved_mass / self._dynamics.network.episode.control_interval
        return self.measure(np.concatenate([self._dynamics.rows.stocks(done.stock), flow]))


def _with_copies(done: Transition, copies: Integers, part: Transition) -> Transition:
    """Return what an interval did, with some copies, in place, as they are in ``part``."""
    for field in fields(done):
        if (array := getattr(done, field.name)) is not None:
            array[..., copies] = getattr(part, field.name)
    return done


class Arrivals:
    """What some arcs add at once to what services measure, past nodes that store nothing, by the shares of an interval.

    What reaches a stock counts in full, as if it stayed there for the interval.
    """

    def __init__(self, laws: FlowLaws, services: Sequence[Service], arcs: Integers, of: Integers) -> None:
        """Take the arcs, and which of ``services`` each stands for."""
        self._routing, self._of, self._count = laws.routing, of, len(services)
        network, routing = laws.staged_network, laws.routing
        ends = network.recipients[arcs] - len(network.stores)
        passed_on = np.flatnonzero(ends >= 0)
        self._into = RowSum(routing.places[ends[passed_on]], passed_on, 1.0, (routing.nodes, len(arcs)))
        into: dict[str, list[int]] = {}
        for k, arc in enumerate(network.arcs):
            into.setdefault(arc.recipient, []).append(k)
        parts, stocks = getattr(network, "parts", {}), dict[str, set[str]]()
        for node in network.stores:
            stocks.setdefault(parts.get(node.id, node.id), set()).add(node.id)
        entries: list[tuple[int, int]] = []
        for row, service in enumerate(services):
            if service.quantity == "stock":
                stock = set[str]().union(*(stocks.get(id_, ()) for id_ in service.providers))
                # what its parts hand on to each other is there already
                entered = [k for id_ in stock for k in into.get(id_, ()) if network.arcs[k].donor not in stock]
            else:
                entered = [int(k) for k in network.service_arcs(service)]
            entries += [(row, k) for k in entered]
        place = {int(k): n for n, k in enumerate(routing.arcs)}
        onward = sorted({k for _, k in entries if k in place})
        self._onward: Integers = np.array(onward, dtype=np.intp)
        self._senders = routing.throughput_rows[[place[k] for k in onward]]
        columns = {k: n for n, k in enumerate([*onward, *arcs.tolist()])}
        read = [(row, columns[k]) for row, k in entries if k in columns]
        rows, read_columns = np.array(read, dtype=np.intp).reshape(-1, 2).T
        self._measure = RowSum(rows, read_columns, 1.0, (len(services), len(columns)))

    def __call__(self, rate: Floats, routes: IntervalRoutes | None, supply: Floats, columns: Integers) -> Floats:
        """Return what each service measures more per supply to n of them, per time, shape (B, services, n).

        Args:
            rate: of all arcs in the interval, with their shares, shape (arcs, B).
            routes: by these shares.
            supply: what each of the arcs carries of a unit for its service, shape (arcs, B).
            columns: which services are supplied, n for each copy, shape (n, B).
        """
        batch, count, nodes = supply.shape[1], len(columns), self._routing.nodes
        slope = np.empty((batch, self._count, count))
        block = max(1, CELLS // (1 + nodes * count))
        for copies in (slice(first, first + block) for first in range(0, batch, block)):
            # the columns of a copy stand beside each other
            is_own = self._of[:, None, None] == columns.T[copies]
            entry_flow = np.where(is_own, supply[:, copies, None], 0.0).reshape(len(supply), -1)
            onward_flow = np.empty((0, *entry_flow.shape[1:]))
            if routes is not None:
                through = self._routing.throughputs(self._into(entry_flow), routes.of_copies(copies))
                shares = rate[:, copies].take(self._onward, 0).repeat(count, axis=1)
                onward_flow = through.take(self._senders, 0) * shares
            measured = self._measure(np.concatenate([onward_flow, entry_flow])).reshape(self._count, -1, count)
            slope[copies] = measured.transpose(1, 0, 2)
        return slope
