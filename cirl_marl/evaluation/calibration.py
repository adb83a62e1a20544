"""Margins on what a controller aims at, set on draws of its own: services as demanded, budgets kept, on average."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Controller
from cirl_marl.controllers.rollout import SEED_SPACING, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.network.declarations import KeptRecord, positional_record
from cirl_marl.optimum.aims import NO_AIMS, Aims
from cirl_marl.optimum.options import check_service, demanded_levels

FIRST_DRAW = 2**30 + 2**20
"""First seed of the draws; no evaluation has it."""
FEWEST = 10
"""Draws below which nothing is tuned."""
CLOSE = 0.002
"""How close the expected level of the service that lacks most has to come to what is demanded, and the expected amount
of a budget, in parts of it, if it exceeds it."""
TRIES = 10
OUTDATED = 3
"""Tries in a row on one side of what is demanded after which the margin on the other side is no end any more."""
FIRST_STEP, LIMITS = 0.1, (0.03, 30.0)
"""Least relative change of the first margins, and their ends."""


@positional_record
class Calibration(KeptRecord):
    """Margins and what they deliver."""

    margin: Annotated[
        float | tuple[float, ...], "by what is multiplied what the controller aims at: one, or by service"
    ]
    excess: Annotated[float, "least of expected levels less what is demanded, over the draws"]
    draws: Annotated[int, "how many"]
    budget_margin: Annotated[float, "by what multipliers of budgets of an episode are multiplied"] = 1.0
    overrun: Annotated[float, "most by which such a budget is exceeded on average, in parts of it; 0 for none"] = 0.0

    @property
    def margins(self) -> dict[str, Any]:
        """Both as options of a controller, that on budgets where it is not 1."""
        options: dict[str, Any] = {"margin": self.margin}
        return options if self.budget_margin == 1.0 else options | {"budget_margin": self.budget_margin}

    @property
    def miss(self) -> float:
        """How far it is from what is demanded."""
        return max(abs(self.excess), self.overrun)


def check_tuning(draws: int, demand: ArrayLike | None) -> None:
    """Refuse what no margin can be set by, before anything is computed.

    Raises:
        CirlError: for too few draws, nothing that is demanded, or what is no level.
    """
    if whole_number("tune", draws, 0) < FEWEST:
        raise CirlError(f"tune {draws}: too few draws to tell an expected level, at least {FEWEST}")
    if draws > SEED_SPACING:
        raise CirlError(f"tune {draws}: more draws than seeds set apart for it, {SEED_SPACING:,}")
    if demand is None:
        raise CirlError("tune: give min_service, to which expected levels are tuned")
    if not np.size(demand):
        raise CirlError("tune: there is no service of which a level is demanded")
    check_service(demand)


def calibrate(
    env: Callable[[int], MultiAgentVectorEnv],
    controller: Callable[..., Controller],
    demand: ArrayLike,
    draws: int,
    progress: Callable[[float], None] = lambda share: None,
    aims: Aims = NO_AIMS,
) -> Calibration:
    """Return the margins at which each service is closest to what is demanded on average, and budgets are kept.

    The margin on a service grows or falls until it brackets that level, then by secants (regula falsi), all at once;
    one that is delivered anyway ends at the least margin. That on multipliers of budgets rises while an expected amount
    exceeds its budget.

    Args:
        env: makes so many copies.
        controller: makes it with a ``margin``, and where there are budgets of the episode with a ``budget_margin``.
        demand: expected level demanded of every service, or of each, shape (services,), in [0, 1].
        draws: on which it is tuned.
        progress: called with the share that is done.
        aims: have the budgets; those of years, which hold in each copy, are left out.

    Raises:
        CirlError: as ``check_tuning`` does, or for another number of levels than services.
    """
    check_tuning(draws, demand)
    copies, tries = env(draws), list[tuple[float, float, Calibration]]()
    demand = demanded_levels(copies.network, demand)
    searches, budget_margin, budget_step = [_MarginSearch() for _ in demand], 1.0, FIRST_STEP
    for done in range(TRIES):
        values = tuple(search.margin for search in searches)
        margins = Calibration(values[0] if len({*values}) == 1 else values, 0.0, draws, budget_margin)
        run = rollout(copies, controller(**margins.margins), seed=FIRST_DRAW)
        over = (aims.bookings(run).mean(axis=0) - aims.limits) / aims.sizes
        overrun, excess = float(over[~aims.by_year].max(initial=0.0)), run.episode_levels.mean(axis=0) - demand
        outcome = replace(margins, excess=float(excess.min()), overrun=overrun)
        tries.append((max(CLOSE / 2, outcome.miss), float(np.abs(excess).sum()), outcome))
        progress((done + 1) / TRIES)
        if overrun > CLOSE / 2:  # levels of before were at other multipliers
            budget_margin *= 1.0 + max(budget_step, 2.0 * overrun)
            budget_step, searches = 3.0 * budget_step, [_MarginSearch(search.margin) for search in searches]
        moves = [search.moves(level) for search, level in zip(searches, excess.tolist(), strict=True)]
        if overrun <= CLOSE / 2 and not any(moves):
            break
    progress(1.0)
    return min(tries, key=lambda attempt: attempt[:2])[-1]


class _MarginSearch:
    """The search for the margin on one service, beside those for others, which change what it delivers.

    Attributes:
        margin: what is tried next.
    """

    def __init__(self, margin: float = 1.0) -> None:
        """Begin with a margin."""
        self.margin, self._step, self._is_settled = margin, FIRST_STEP, False
        self._ends = dict[bool, tuple[float, float]]()  # last margin that delivers too much, or too little, and excess
        self._run = 0  # tries between two ends, in a row, that delivered too much, or if negative too little

    def moves(self, excess: float) -> bool:
        """Go on to the next margin, given what the last delivers beyond what is demanded, if there is one to try."""
        if abs(excess) <= CLOSE / 2:
            self._is_settled = True
            return False
        margin, is_surplus, end = self.margin, excess > 0, self._ends.get(excess < 0)
        if end is not None:
            self._run = max(self._run, 0) + 1 if is_surplus else min(self._run, 0) - 1
        is_stale = end is not None and (abs(self._run) == OUTDATED or (end[0] < margin) != is_surplus)
        if self._is_settled or is_stale:
            self._ends, self._step, self._run = {}, FIRST_STEP, 0
        self._ends[is_surplus] = margin, excess
        if len(self._ends) == 2:
            (low, lack), (high, surplus) = self._ends[False], self._ends[True]
            self.margin = low * (high / low) ** float(np.clip(lack / (lack - surplus), 0.15, 0.85))
        else:
            change = 1.0 + max(self._step, 2.0 * abs(excess))
            self.margin, self._step = (
                max(LIMITS[0], margin / change) if is_surplus else margin * change,
                3.0 * self._step,
            )
        self._is_settled = self.margin == margin or self.margin >= LIMITS[1]
        if self._is_settled:
            self.margin = margin
        return not self._is_settled
