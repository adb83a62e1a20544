"""What the program maximises, and how service is read off its variables."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from cirl_marl.network import Floats
from cirl_marl.optimum.layout import Layout, MatrixRow


def measures(layout: Layout) -> Iterator[MatrixRow]:
    """Yield low·level − q ≤ 0 for each service, and ±Δ·σ_env·f̄ − imbalance ≤ 0.

    The level is at most min(1, q/low): a finite upper end of the band could only lower it further.
    """
    network, count = layout.network, len(layout.moments)
    for s, service in enumerate(network.services):
        if service.quantity == "stock":
            measured = [(layout.end(-1) + network.node_index[service.provider], -1.0)]
        else:
            arcs = network.metered(service)
            measured = [(layout.flow(i) + int(k), -1.0 / count) for i in layout.moments for k in arcs]
        yield [(layout.level + s, service.low), *measured]  # level ≤ q/low; level ≤ 1 is a box
    weights = -network.circularity_weights[1]
    counted = [(i, int(k)) for i in layout.moments for k in np.flatnonzero(weights)]
    for sign in (1.0, -1.0):
        flows = [(layout.flow(i) + k, sign * float(weights[k]) / count) for i, k in counted]
        yield [*flows, (layout.imbalance, -1.0)]


def circularity_weights(layout: Layout) -> Floats:
    """Return the weights of the mean of λ over an interval on its variables, shape (size,), mass."""
    network = layout.network
    weights = np.zeros(layout.size)
    counted = network.circularity_weights.sum(axis=0)
    if network.objective.net_zero == "abs":
        counted = network.circularity_weights[0]
        weights[layout.imbalance] = -1.0
    for i in layout.moments:
        weights[layout.flow(i) : layout.valve(i)] = counted / len(layout.moments)
    return weights


def objective(layout: Layout, service_weight: float | None) -> tuple[Floats, float]:
    """Return the weights of the objective on the variables of an interval, and what it has beside them."""
    network = layout.network
    weights, constant = circularity_weights(layout), 0.0
    if service_weight is not None:
        weights = weights / network.objective.circularity_scale
        if network.services:
            weights[layout.level : layout.imbalance] = service_weight / len(network.services)
        else:
            constant = service_weight
    return weights, constant
