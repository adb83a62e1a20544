"""What arcs supply that make up for a service while nobody acts on them: business as usual.

Without cuts the interval's map from what they supply to what services measure, q = β + A V, is affine: V_s is what the
arcs of service s supply together above their lowest flows, each by its weight. One interval with the lowest flows gives
β, one more for each service a column of A; then ::

    V = A⁻¹ (D − β),    u_k = clip(low_k + weight_k V_s, low_k, high_k)

with D the lower ends of the services' bands. What others do in the interval is known. Nothing is said about a service
of which a bound, or a donor that is empty, keeps the supply too small: its level falls short.
"""

from __future__ import annotations

from collections.abc import Container

import numpy as np

from cirl_marl.dynamics.motion import Dynamics
from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.model import Bools

TINY = 1e-12
"""Part of a supply that arrives, below which it is taken for none."""


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
        stores, rows, columns = len(network.stores), [], []
        for row, service in enumerate(services):
            if service.quantity == "stock":
                read = [network.node_index[service.provider]]
            else:
                read = [stores + int(k) for k in network.metered(service)]
            rows += [row] * len(read)
            columns += read
        self._measure = RowSum(rows, columns, 1.0, (len(services), stores + len(network.arcs)))

    def idle(self, agents: Container[str]) -> Bools:
        """Return which of ``arcs`` nobody acts on, shape (arcs, 1)."""
        return np.array([arc not in agents for arc in self.arcs], dtype=bool).reshape(-1, 1)

    def __call__(self, stock: Floats, inner: Floats, controls: Floats, step: Integers, idle: Bools) -> Floats:
        """Return the controls of an interval with what ``idle`` arcs supply, shape (controls, B).

        Args:
            stock: masses at its start, as ``Dynamics.advance`` takes them.
            inner: inner states.
            controls: of all others.
            step: index of the interval in each copy, shape (B,).
            idle: which arcs nobody acts on in each copy, shape (arcs, B or 1).
        """
        if not idle.any():
            return controls
        batch, count = controls.shape[1], len(self._demand)
        idle = np.broadcast_to(idle, (len(self.arcs), batch))
        low, high = (
            table[self._rows].take(step, axis=1) for table in (self._dynamics.control_low, self._dynamics.control_high)
        )
        least = controls.copy()
        least[self._rows] = np.where(idle, low, controls[self._rows])
        tried = np.tile(least, (1, 1 + count))
        size = np.zeros((count, batch))
        np.maximum.at(size, self._of, np.where(idle, high - low, 0.0))
        for s in range(count):
            arcs = self._of == s
            part = tried[:, (1 + s) * batch : (2 + s) * batch]
            part[self._rows[arcs]] += np.where(idle[arcs], self._weights[arcs] * size[s], 0.0)
        measured = self._measured(stock, inner, tried, step, 1 + count).reshape(count, 1 + count, batch)
        base, more = measured[:, 0], measured[:, 1:] - measured[:, :1]
        lacking = self._demand.take(step, axis=1) - base
        supply = size * _solved(more, lacking, size)
        found = least
        wanted = low + self._weights * supply[self._of]
        found[self._rows] = np.where(idle, np.clip(wanted, low, high), controls[self._rows])
        return found

    def _measured(self, stock: Floats, inner: Floats, controls: Floats, step: Integers, times: int) -> Floats:
        """Return what the services measure at the end of the interval under several controls, shape (services, …)."""
        dynamics = self._dynamics
        done = dynamics.advance(np.tile(stock, (1, times)), np.tile(inner, (1, times)), controls, np.tile(step, times))
        flow = done.moved / dynamics.network.episode.control_interval
        return self._measure(np.concatenate([dynamics.rows.stocks(done.stock), flow]))


def _solved(more: Floats, lacking: Floats, size: Floats) -> Floats:
    """Return x, shape (services, B), of Σ_s more_is x_s = lacking_i, with 0 where nobody supplies or nothing lacks.

    ``more`` has shape (services, services, B). A supply that does not arrive is as large as it can be.
    """
    count = len(lacking)
    if count == 1:
        arrives = more[0] > TINY * size
        ratio = np.divide(lacking, more[0], out=np.where(lacking > 0, np.inf, 0.0), where=arrives)
        return np.where(size > 0, np.maximum(ratio, 0.0), 0.0)
    matrix, right = more.transpose(2, 0, 1).copy(), np.where(size > 0, lacking, 0.0).T.copy()
    own = np.arange(count)
    absent = ~(matrix[:, own, own] > TINY * size.T)
    # a service without supply, or one whose supply does not arrive, has an equation of its own
    matrix = np.where(absent[:, :, None], np.eye(count), np.where(absent[:, None, :], 0.0, matrix))
    right = np.where(absent, np.where(right > 0, 1.0 / TINY, 0.0), right)
    solved = np.linalg.solve(matrix, right[:, :, None])[:, :, 0].T
    return np.where(size > 0, np.maximum(solved, 0.0), 0.0)
