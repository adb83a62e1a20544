"""What arcs supply that make up for a service while nobody acts on them: business as usual.

The arcs of service s supply u_k = min(low_k + weight_k V_s, high_k). Without cuts the interval's map from V to what the
services measure is affine, q = β + A V with A ≥ 0: one interval with V gives q, one more for each service a column of
A, and then V solves ::

    V_s = 0 where q_s ≥ D_s,    V_s at its most where q_s ≤ D_s,    q_s = D_s elsewhere,

with D the lower ends of the services' bands: a linear complementarity problem, by projected Gauss-Seidel sweeps. Where
an arc is at its bound, or a donor delivers less, the map bends; it is then solved again from there. What others do in
the interval is known. Nothing is said about a service whose supply cannot be enough: its level falls short.
"""

from __future__ import annotations

from collections.abc import Container

import numpy as np

from cirl_marl.dynamics.factors import Scaled
from cirl_marl.dynamics.motion import Dynamics
from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.model import Bools
from cirl_marl.network.uncertainty import numbers_of

TINY = 1e-9
"""Part of a supply that arrives in an interval, below which it is taken for none."""
CLOSE = 1e-12
"""Distance of what is measured from what is demanded, relative to that, at which nothing lacks."""
PROBE, LEAST = 1e-3, 1e-6
"""Parts of what lacks, and of what is demanded, by the larger of which the columns of A are found."""
ROUNDS, SWEEPS = 8, 500
"""Most times that the map is followed where it bends, and Gauss-Seidel sweeps each time."""


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
        served = list(dict.fromkeys(arc.makes_up_for for arc in made_up))
        services = [service for service in network.services if service.id in served]
        order = [service.id for service in services]
        self._of: Integers = np.array([order.index(arc.makes_up_for) for arc in made_up], dtype=np.intp)
        self._rows: Integers = np.array([network.control_rows[arc.id].start for arc in made_up], dtype=np.intp)
        weights = [1.0 if arc.weight is None else arc.weight for arc in made_up]
        self._weights = np.array(weights).reshape(-1, 1)
        demand = [network.held(service.low) for service in services]
        self._demand = np.array(demand).reshape(len(services), network.episode.horizon)
        numbers = numbers_of(network, "services", "low")
        self._drawn = Scaled({row: numbers[each.id] for row, each in enumerate(services) if each.id in numbers})
        stores, rows, columns = len(network.stores), [], []
        for row, service in enumerate(services):
            if service.quantity == "stock":
                read = [network.node_index[each] for each in service.providers]
            else:
                read = [stores + int(k) for k in network.metered(service)]
            rows += [row] * len(read)
            columns += read
        self._measure = RowSum(rows, columns, 1.0, (len(services), stores + len(network.arcs)))

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
        batch, count = controls.shape[1], len(self._demand)
        idle = np.broadcast_to(idle, (len(self.arcs), batch))
        low, high = (
            table[self._rows].take(step, axis=1) for table in (self._dynamics.control_low, self._dynamics.control_high)
        )
        demand = self._drawn(self._demand.take(step, axis=1), factors)
        most = np.zeros((count, batch))
        weights = np.broadcast_to(self._weights, low.shape)
        room = np.divide(high - low, weights, out=np.zeros_like(low), where=idle & (weights > 0))
        np.maximum.at(most, self._of, room)

        def supplied(supply: Floats) -> Floats:
            """Return all controls for V, shape (services, B), shape (controls, B)."""
            found = controls.copy()
            wanted = np.minimum(low + self._weights * supply[self._of], high)
            found[self._rows] = np.where(idle, wanted, controls[self._rows])
            return found

        supply, interval = np.zeros((count, batch)), self._dynamics.network.episode.control_interval
        open_ = np.ones(batch, dtype=bool)
        for _ in range(ROUNDS):
            base = self._measured(stock, inner, supplied(supply), step, 1, factors)
            lacking = demand - base
            lacks = (lacking > CLOSE * demand) & (supply < most) | (lacking < -CLOSE * demand) & (supply > 0)
            open_ &= lacks.any(axis=0)
            if not open_.any():
                break
            # small beside what lacks, as a donor may hold little more than that, and not lost in rounding
            probe = np.minimum(np.maximum(PROBE * np.abs(lacking), LEAST * demand) / interval, PROBE * most)
            tried = [supplied(supply + probe * (np.arange(count) == s)[:, None]) for s in range(count)]
            measured = self._measured(stock, inner, np.concatenate(tried, axis=1), step, count, factors)
            more = measured.reshape(count, count, batch) - base[:, None]
            slope = np.divide(more, probe, out=np.zeros_like(more), where=probe > 0)
            better = _complementary(slope, lacking, supply, most, interval)
            supply = np.where(open_, better, supply)
        return supplied(supply)

    def _measured(
        self, stock: Floats, inner: Floats, controls: Floats, step: Integers, times: int, factors: Floats | None
    ) -> Floats:
        """Return what the services measure at the end of the interval under several controls, shape (services, …)."""
        dynamics = self._dynamics
        start, drawn = (np.tile(stock, (1, times)), np.tile(inner, (1, times))), None
        if factors is not None:
            drawn = np.tile(factors, (1, times))
        done = dynamics.advance(*start, controls, np.tile(step, times), drawn)
        flow = done.moved / dynamics.network.episode.control_interval
        return self._measure(np.concatenate([dynamics.rows.stocks(done.stock), flow]))


def _complementary(slope: Floats, lacking: Floats, supply: Floats, most: Floats, interval: float) -> Floats:
    """Return V, shape (services, B), at which nothing lacks that can be supplied, for q linear around ``supply``.

    Each copy goes its own way, whatever the others in the batch do.

    Args:
        slope: A, shape (services, services, B).
        lacking: D − q at ``supply``, shape (services, B).
        supply: V.
        most: largest V.
        interval: length of an interval, by which a flow becomes a stock.
    """
    count, found = len(lacking), supply.copy()
    open_ = np.ones(lacking.shape[1], dtype=bool)
    for _ in range(SWEEPS):
        before = found.copy()
        for s in range(count):
            short = lacking[s] - (slope[s] * (found - supply)).sum(axis=0)
            arrives = slope[s, s] > TINY * min(1.0, interval)
            # more of what does not arrive is not supplied
            step = np.divide(short, slope[s, s], out=np.zeros_like(short), where=arrives)
            found[s] = np.where(open_, np.clip(found[s] + step, 0.0, most[s]), found[s])
        open_ &= (np.abs(found - before) > 1e-15 * found).any(axis=0)
        if count == 1 or not open_.any():
            break
    return found
