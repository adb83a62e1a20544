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
        self._stockless_ends: Integers = np.flatnonzero(ends >= 0)
        self._into: Integers = routing.places[ends[self._stockless_ends]]
        rows: list[int] = []
        columns: list[int] = []
        place = {int(k): n for n, k in enumerate([*routing.arcs, *arcs])}
        for row, service in enumerate(services):
            if service.quantity == "stock":
                measured_arcs = self._inflows_of_stock(service)
            else:
                measured_arcs = [int(k) for k in laws.staged_network.service_arcs(service)]
            columns_ = [place[k] for k in measured_arcs if k in place]
            rows += [row] * len(columns_)
            columns += columns_
        self._measure = RowSum(rows, columns, 1.0, (len(services), len(place)))

    def _inflows_of_stock(self, service: Service) -> list[int]:
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
