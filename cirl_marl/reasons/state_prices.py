"""What stocks are worth by the state of what disturbs a network: shadow prices of many futures, sorted by state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np

from cirl_marl.controllers.rollout import first_seed
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.draws import DrawProgram, Prices, draws_of, past_of
from cirl_marl.optimum.options import DEGREE
from cirl_marl.optimum.sensitivity import with_wide_boxes

DRAWS = 8
"""Futures that are solved."""
MOST_STATES = 4
"""Values of a disturbance that are told apart one by one; more are put together in thirds."""


@frozen_record
class StatePrices:
    """What one more unit of mass in a stock adds to λ̄, on average while a disturbance has some values."""

    disturbance: Annotated[str, "its name"]
    states: Annotated[Floats, "lowest and highest value of each group, shape (groups, 2)"]
    stock: Annotated[Floats, "price of each stock at the start of the intervals of a group, shape (groups, stores), 1"]


def state_prices(
    network: Network, level_prices: Floats, progress: Callable[[float], None] = lambda share: None
) -> tuple[StatePrices, ...]:
    """Return the prices of stocks by the state of each disturbance.

    In each of DRAWS futures the program of the draw is solved, with what services are worth as their price.
    Its multipliers are the prices of who knows that future; sorted by the value of a disturbance they say what to hold
    when.

    Args:
        network: a disturbed one.
        level_prices: rise of λ̄ per unit of the level that is demanded of each service, shape (services,), mass.
        progress: called with the share that is done.

    Raises:
        CirlError: if HiGHS does not solve a draw.
    """
    env = MultiAgentVectorEnv(network, num_envs=DRAWS)
    env.reset(seed=first_seed(0))
    worth = []
    for i, draw in enumerate(draws_of(env)):
        program = DrawProgram(draw, None, DEGREE)
        problem = program.with_prices(_service_prices(network, draw.features, -level_prices))
        proof = program.prove(with_wide_boxes(problem, Admissible.of(draw.network, None)))
        if proof.plan is None:
            raise CirlError(f"network '{network.name}': HiGHS does not solve future {i} of {DRAWS}")
        worth.append(program.stock_values(proof.certificate))
        progress((i + 1) / DRAWS)
    values = env.physical.disturbances[1 : network.episode.horizon].transpose(1, 2, 0)
    of_states = np.concatenate(worth)  # by draw and interval, as ``values`` of each disturbance
    return tuple(
        _by_state(name, path.ravel(), of_states) for name, path in zip(network.processes.names, values, strict=True)
    )


def _service_prices(network: Network, features: Floats, service: Floats) -> Prices:
    """Return prices on services alone."""
    steps, functions = features.shape
    return Prices(
        stock=np.zeros((1, len(network.stores), functions)),
        reference=np.zeros((steps - 1, len(network.stores))),
        response=np.zeros((past_of(features).shape[1], len(network.stores))),
        service=np.maximum(service, 0.0),
        demand=np.zeros(len(service)),
        shocks=np.zeros((2, functions)),
    )


def _by_state(name: str, values: Floats, worth: Floats) -> StatePrices:
    """Return the mean worth, shape (cases, stores), of cases in which a disturbance has like values, shape (cases,)."""
    distinct = np.unique(values)
    if len(distinct) <= MOST_STATES:
        group = np.searchsorted(distinct, values)
    else:
        group = np.searchsorted(np.quantile(values, [1 / 3, 2 / 3]), values)
    members = [group == k for k in np.unique(group)]
    return StatePrices(
        disturbance=name,
        states=np.array([(values[member].min(), values[member].max()) for member in members]),
        stock=np.array([worth[member].mean(axis=0) for member in members]),
    )
