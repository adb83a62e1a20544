"""Networks of a few nodes with given stocks, and what becomes of these under neutral control."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cirl_marl import Arc, Episode, Network, Node
from cirl_marl.dynamics.motion import Dynamics

Floats = NDArray[np.float64]


def small(
    nodes: dict[str, float],
    arcs: list[Arc],
    *,
    interval: float = 1.0,
    horizon: int = 5,
    solver: str = "exact",
) -> Network:
    """Return a network with given initial stocks."""
    return Network(
        name="small",
        nodes=tuple(Node(id=name, initial=(stock, stock)) for name, stock in nodes.items()),
        arcs=tuple(arcs),
        episode=Episode(
            control_interval=interval,
            horizon=horizon,
            solver=solver,
            solver_step=None if solver == "exact" else interval,
        ),
    )


NO_STATES = np.empty((0, 1))


def neutral_rate(dynamics: Dynamics, step: int = 0) -> Floats:
    """Return the rates under neutral control."""
    return dynamics.rate(dynamics.neutral[:, :1], np.array([step]))


def start(network: Network) -> Floats:
    """Return the upper initial stocks with the unit row, one column."""
    return np.array([*(node.initial[1] for node in network.nodes), 1.0])[:, None]


def advanced(network: Network, steps: int = 1) -> Floats:
    """Return the stocks after ``steps`` intervals of neutral control, shape (nodes,)."""
    dynamics = Dynamics(network)
    stock = start(network)
    for step in range(steps):
        stock = dynamics.advance(stock, NO_STATES, dynamics.neutral[:, :1], np.array([step])).stock
    return stock[:-1, 0]
