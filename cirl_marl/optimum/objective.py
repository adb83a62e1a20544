"""What the program maximises, and how service is read off its variables."""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.network import Floats
from cirl_marl.optimum.layout import Layout
from cirl_marl.optimum.rows import ProgramRows


def measures(layout: Layout, low: Floats, rows: ProgramRows) -> None:
    """Add low·level − q ≤ 0 for each service and ±Δ·σ_env·f̄ − imbalance ≤ 0; their keys are (1, …).

    The level is at most min(1, q/low): a finite upper end of the band could only lower it further.
    """
    network, count = layout.network, len(layout.moments)
    for s, service in enumerate(network.services):
        row = rows.add(1, s)
        rows.put(row, layout.level + s, low[s])  # level ≤ q/low; level ≤ 1 is a box
        if service.quantity == "stock":
            stages = network.stages if isinstance(network, StagedNetwork) else {}
            for store in (store for each in service.providers for store in stages.get(each, (each,))):
                rows.put(row, layout.end(-1) + network.node_index[store], -1.0)
        else:
            rows.put(row, layout.flow(layout.moment_column) + network.metered(service), -1.0 / count)
    weights = -network.circularity_weights[1]
    counted = np.flatnonzero(weights)
    row = rows.add(1, len(network.services), [0, 1])
    for each, sign in zip(row, (1.0, -1.0), strict=True):
        rows.put(each, layout.flow(layout.moment_column) + counted, sign * weights[counted] / count)
    rows.put(row, layout.imbalance, -1.0)


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
