"""A margin on what a controller aims at, set on draws of its own so that services are what is demanded of them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Controller
from cirl_marl.controllers.rollout import SEED_SPACING, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.network import Floats
from cirl_marl.network.declarations import KeptRecord, positional_record

FIRST_DRAW = 2**30 + 2**20
"""First seed of the draws; no evaluation has it."""
FEWEST = 10
"""Draws below which nothing is tuned."""
CLOSE = 0.002
"""How close the expected level of the service that lacks most has to come to what is demanded."""
TRIES = 8
FIRST_STEP, LIMITS = 0.1, (0.03, 30.0)
"""Least relative change of the first margins, and their ends."""


@positional_record
class Calibration(KeptRecord):
    """A margin and what it delivers."""

    margin: Annotated[float, "by what is multiplied what the controller aims at"]
    excess: Annotated[float, "least of expected levels less what is demanded, over the draws"]
    draws: Annotated[int, "how many"]


def check_tuning(draws: int, demand: ArrayLike | None) -> None:
    """Refuse what no margin can be set by, before anything is computed.

    Raises:
        CirlError: for too few draws, or nothing that is demanded.
    """
    if whole_number("tune", draws, 0) < FEWEST:
        raise CirlError(f"tune {draws}: too few draws to tell an expected level, at least {FEWEST}")
    if draws > SEED_SPACING:
        raise CirlError(f"tune {draws}: more draws than seeds set apart for it, {SEED_SPACING:,}")
    if demand is None:
        raise CirlError("tune: give min_service, to which expected levels are tuned")
    if not np.size(demand):
        raise CirlError("tune: there is no service of which a level is demanded")


def calibrate(
    env: Callable[[int], MultiAgentVectorEnv],
    controller: Callable[..., Controller],
    demand: Floats,
    draws: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Calibration:
    """Return the margin at which the service that lacks most is closest to what is demanded of it on average.

    Margins grow or fall until they bracket it, then by secants (regula falsi).

    Args:
        env: makes so many copies.
        controller: makes it with a ``margin``.
        demand: expected level demanded of each service, shape (services,).
        draws: on which it is tuned.
        progress: called with the share that is done.

    Raises:
        CirlError: for too few draws, or nothing that is demanded.
    """
    check_tuning(draws, demand)
    copies, excess = env(draws), dict[float, float]()
    margin, step = 1.0, FIRST_STEP
    for done in range(TRIES):
        levels = rollout(copies, controller(margin=margin), seed=FIRST_DRAW).episode_levels.mean(axis=0)
        excess[margin] = float((levels - demand).min())
        progress((done + 1) / TRIES)
        if abs(excess[margin]) <= CLOSE / 2:
            break
        low = max((m for m in excess if excess[m] < 0), default=None)
        high = min((m for m in excess if excess[m] > 0), default=None)
        if low is None or high is None:
            change = max(step, 2 * abs(excess[margin]))
            margin, step = margin * (1 + change) if high is None else margin / (1 + change), 3 * step
            if not LIMITS[0] < margin < LIMITS[1]:
                break
        elif low >= high:  # more is aimed at and less comes about
            break
        else:
            share = excess[low] / (excess[low] - excess[high])
            margin = low + (high - low) * float(np.clip(share, 0.15, 0.85))
    best = min(excess, key=lambda m: abs(excess[m]))
    progress(1.0)
    return Calibration(best, excess[best], draws)
