"""Networks of a few nodes with given stocks, and what becomes of these under neutral control."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cirl_marl import Arc, Episode, Network, Node
from cirl_marl.dynamics.motion import Dynamics
from cirl_marl.network.series import Value

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
    return dynamics.rate(dynamics.neutral[:, [step]], np.array([step]))


def start(network: Network) -> Floats:
    """Return the upper initial stocks with the unit row, one column."""
    return np.append(network.initial[1], 1.0)[:, None]


def constant(value: Value | None) -> float:
    """Return a number of a network that does not change in time."""
    assert isinstance(value, float)
    return value


def advanced(network: Network, steps: int = 1) -> Floats:
    """Return the stocks after ``steps`` intervals of neutral control, shape (stores,)."""
    if steps > network.episode.horizon:
        network = network.with_options(episode={"horizon": steps})
    dynamics, stock = Dynamics(network), start(network)
    for step in range(steps):
        stock = dynamics.advance(stock, NO_STATES, dynamics.neutral[:, [step]], np.array([step])).stock
    return stock[:-1, 0]
