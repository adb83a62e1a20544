"""Margins on what a controller aims at, set on draws of its own: services as demanded, budgets kept, on average."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Controller
from cirl_marl.controllers.rollout import SEED_SPACING, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.network import Floats
from cirl_marl.network.declarations import KeptRecord, positional_record
from cirl_marl.optimum.aims import NO_AIMS, Aims

FIRST_DRAW = 2**30 + 2**20
"""First seed of the draws; no evaluation has it."""
FEWEST = 10
"""Draws below which nothing is tuned."""
CLOSE = 0.002
"""How close the expected level of the service that lacks most has to come to what is demanded, and the expected amount
of a budget, in parts of it, if it exceeds it."""
TRIES = 8
FIRST_STEP, LIMITS = 0.1, (0.03, 30.0)
"""Least relative change of the first margins, and their ends."""


@positional_record
class Calibration(KeptRecord):
    """Margins and what they deliver."""

    margin: Annotated[float, "by what is multiplied what the controller aims at"]
    excess: Annotated[float, "least of expected levels less what is demanded, over the draws"]
    draws: Annotated[int, "how many"]
    budget_margin: Annotated[float, "by what multipliers of budgets of an episode are multiplied"] = 1.0
    overrun: Annotated[float, "most by which such a budget is exceeded on average, in parts of it; 0 for none"] = 0.0

    @property
    def margins(self) -> dict[str, float]:
        """Both as options of a controller, that on budgets where it is not 1."""
        options = {"margin": self.margin}
        return options if self.budget_margin == 1.0 else options | {"budget_margin": self.budget_margin}

    @property
    def miss(self) -> float:
        """How far it is from what is demanded."""
        return max(abs(self.excess), self.overrun)


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
    aims: Aims = NO_AIMS,
) -> Calibration:
    """Return the margins at which services are closest to what is demanded on average, and budgets are kept.

    The margin on services grows or falls until it brackets the level of what lacks most, then by secants (regula
    falsi). That on multipliers of budgets rises while an expected amount exceeds its budget.

    Args:
        env: makes so many copies.
        controller: makes it with a ``margin``, and where there are budgets of the episode with a ``budget_margin``.
        demand: expected level demanded of each service, shape (services,).
        draws: on which it is tuned.
        progress: called with the share that is done.
        aims: have the budgets; those of years, which hold in each copy, are left out.

    Raises:
        CirlError: for too few draws, or nothing that is demanded.
    """
    check_tuning(draws, demand)
    copies, tries, excess = env(draws), list[Calibration](), dict[float, float]()
    margins, step, budget_step = Calibration(1.0, 0.0, draws), FIRST_STEP, FIRST_STEP
    for done in range(TRIES):
        run = rollout(copies, controller(**margins.margins), seed=FIRST_DRAW)
        over = (aims.bookings(run).mean(axis=0) - aims.limits) / aims.sizes
        overrun, margin = float(over[~aims.by_year].max(initial=0.0)), margins.margin
        excess[margin] = float((run.episode_levels.mean(axis=0) - demand).min())
        tries.append(replace(margins, excess=excess[margin], overrun=overrun))
        progress((done + 1) / TRIES)
        if tries[-1].miss <= CLOSE / 2:
            break
        if overrun > CLOSE / 2:  # levels of before were at other multipliers
            dearer = margins.budget_margin * (1.0 + max(budget_step, 2.0 * overrun))
            margins, budget_step = replace(margins, budget_margin=dearer), 3.0 * budget_step
            excess, step = {margin: excess[margin]}, FIRST_STEP
        if abs(excess[margin]) > CLOSE / 2:
            margin, step = _next_margin(excess, margin, step)
        if not LIMITS[0] < margin < LIMITS[1]:
            break
        margins = replace(margins, margin=margin)
    progress(1.0)
    return min(tries, key=lambda calibration: calibration.miss)


def _next_margin(excess: Mapping[float, float], margin: float, step: float) -> tuple[float, float]:
    """Return what to try after a ``margin``, and the least change of the next, given the excess of those tried.

    It is not finite where more is aimed at and less comes about.
    """
    low = max((m for m in excess if excess[m] < 0), default=None)
    high = min((m for m in excess if excess[m] > 0), default=None)
    if low is None or high is None:
        change = max(step, 2 * abs(excess[margin]))
        return margin * (1 + change) if high is None else margin / (1 + change), 3 * step
    if low >= high:
        return np.inf, step
    share = excess[low] / (excess[low] - excess[high])
    return low + (high - low) * float(np.clip(share, 0.15, 0.85)), step
