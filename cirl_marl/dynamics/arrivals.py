"""What a flow adds at once to what services measure, past nodes that store nothing."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.elements import Service


class Arrivals:
    """The way from some arcs to services, for the shares of an interval.

    What reaches a stock counts in full, as if it stayed there for the interval.
    """

    def __init__(self, laws: FlowLaws, services: Sequence[Service], arcs: Integers, of: Integers) -> None:
        """Take the arcs, and which of ``services`` each stands for."""
        self._laws, self._arcs, self._of, self._count = laws, arcs, of, len(services)
        network, routing = laws.staged_network, laws.routing
        stores = len(network.stores)
        ends = network.recipients[arcs] - stores
        self._entering: Integers = np.flatnonzero(ends >= 0)
        self._into: Integers = routing.places[ends[self._entering]]
        rows: list[int] = []
        columns: list[int] = []
        place = {int(k): n for n, k in enumerate([*routing.arcs, *arcs])}
        for row, service in enumerate(services):
            if service.quantity == "stock":
                measured = self._arriving(service)
            else:
                measured = [int(k) for k in laws.staged_network.service_arcs(service)]
            found = [place[k] for k in measured if k in place]
            rows += [row] * len(found)
            columns += found
        self._measure = RowSum(rows, columns, 1.0, (len(services), len(place)))

    def _arriving(self, service: Service) -> list[int]:
        """Return the arcs that bring something to the stock that a service measures, from elsewhere."""
        network = self._laws.staged_network
        parts = getattr(network, "parts", {})
        stock = {node.id for node in network.stores if parts.get(node.id, node.id) in service.providers}
        return [k for k, arc in enumerate(network.arcs) if arc.recipient in stock and arc.donor not in stock]

    def __call__(self, rate: Floats, weights: Floats) -> Floats:
        """Return what each service measures more per supply to each, shape (services, services, B), per time.

        Args:
            rate: of all arcs in the interval, with their shares, shape (arcs, B).
            weights: of each of ``arcs`` in the supply that it belongs to, shape (arcs, B).
        """
        routing = self._laws.routing
        routes = routing.routes(rate)
        found = np.zeros((self._count, self._count, rate.shape[1]))
        shares = rate.take(routing.arcs, 0)
        for s in range(self._count):
            own = np.where(self._of[:, None] == s, weights, 0.0)
            through = np.zeros((routing.nodes, rate.shape[1]))
            np.add.at(through, self._into, own[self._entering])
            passed = np.empty((0, rate.shape[1]))
            if routes is not None:
                passed = routing.throughputs(through, routes).take(routing.throughput_rows, 0) * shares
            found[:, s] = self._measure(np.concatenate([passed, own]))
        return found
