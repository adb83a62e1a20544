"""A blind schedule that climbs the exact gradient of its mean over common draws, with prices on services."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.environments.derivatives import Derivatives, stacked_schedule
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record

MEMORY, SQUARES = 0.9, 0.9
"""Weights of the past in the moments of Adam (Kingma and Ba 2015)."""
PRICE_RATE, PRICE_DAMPING = 10.0, 5.0
"""Dual ascent: the price of a service moves by RATE·(lack + DAMPING·change of the lack), per circularity scale."""
ROUND_OFF = 1e-9
"""Mean level that a schedule may lack and still keep its demand: plans end a hair below."""


@positional_record
class ScheduleAscent:
    """The best schedule that was met, and what it does in the mean over the draws."""

    actions: Annotated[Floats, "stacked actions, shape (intervals, entries)"]
    circularity: Annotated[float, "mean λ̄, mass"]
    levels: Annotated[Floats, "mean level of each service, shape (services,)"]


def improve_schedule(
    env: MultiAgentVectorEnv,
    actions: ArrayLike,
    *,
    min_service: ArrayLike | None = None,
    service_weight: float | None = None,
    updates: int = 200,
    rate: float = 0.2,
) -> ScheduleAscent:
    """Return a schedule that does better than ``actions`` in the mean over the copies of ``env``, from where they are.

    What copies begin with, draw and are disturbed by are the common draws: ``env.reset(seed)`` settles them, and they
    stay. The schedule climbs the gradient of mean λ̄/c + Σ_s p_s·l_s, c the circularity scale, by Adam with a rate that
    falls to a hundredth, and is clipped to its bounds. The best one met counts: of those whose every mean level is at
    least ``min_service`` that of the highest λ̄; if there is none, that which lacks least.

    Args:
        env: after ``reset``.
        actions: to begin with, shape (intervals, entries).
        min_service: mean level demanded of every service, or of each, shape (services,); None weighs them.
        service_weight: w of λ̄/c + w·(mean level), if nothing is demanded; None: as reward ``team`` has it.
        updates: steps of the ascent.
        rate: first step, in normalised actions.

    Raises:
        CirlError: for networks without derivatives (``gradient``).
    """
    derivatives, network = Derivatives(env), env.network
    schedule = stacked_schedule(env, actions).mean(axis=2)
    scale, weight = network.objective.circularity_scale, max(env.circularity_weight, 1e-6)
    prices = np.array([service.weight for service in network.services]) * (1.0 - weight) / weight
    if service_weight is not None:
        prices = np.full(len(prices), service_weight / max(len(prices), 1))
    mean, square, best_rank = np.zeros_like(schedule), np.zeros_like(schedule), (-np.inf, -np.inf)
    best, earlier_lacks = ScheduleAscent(schedule, 0.0, np.zeros(len(prices))), np.zeros_like(prices)
    for update in range(updates + 1):
        slope = derivatives.open_loop(stacked_schedule(env, schedule), 1.0 / scale, prices)
        levels, circularity = slope.levels.mean(axis=1), float(slope.circularity.mean())
        lacks = np.zeros_like(prices) if min_service is None else min_service - levels
        worth = circularity if min_service is not None else circularity / scale + float(prices @ levels)
        rank = (-max(0.0, lacks.max(initial=0.0) - ROUND_OFF), worth)
        if rank > best_rank:
            best, best_rank = ScheduleAscent(schedule, circularity, levels), rank
        by_action = slope.actions.mean(axis=2)
        mean, square = MEMORY * mean + (1 - MEMORY) * by_action, SQUARES * square + (1 - SQUARES) * by_action**2
        corrected = mean / (1 - MEMORY ** (update + 1)), square / (1 - SQUARES ** (update + 1))
        step = rate * 0.01 ** (update / max(updates, 1))
        schedule = np.clip(schedule + step * corrected[0] / (np.sqrt(corrected[1]) + 1e-12), -1.0, 1.0)
        if min_service is not None:
            change = lacks + PRICE_DAMPING * (lacks - earlier_lacks) * (update > 0)
            prices, earlier_lacks = np.maximum(prices + PRICE_RATE * change, 0.0), lacks
    return best
