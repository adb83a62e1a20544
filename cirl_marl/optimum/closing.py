"""A bound and a plan within a gap of each other: cheap programs first, dearer ones while there is time.

Programs of higher degree prove more and take longer, and whether the bound or the plan is what keeps them apart is only
known once the plan gets no better. So the plan of the cheapest bound is improved until steps make or promise little of
the gap; if the two are still apart, a tighter bound is proved, as long as it can be had in the time that is left, and
the plan is improved from where it was.
"""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated, Any

from numpy.typing import ArrayLike

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.errors import CirlError
from cirl_marl.network import Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.optimum.bounds import Bound, bound, gap
from cirl_marl.optimum.improve import TOLERATED_SHORTFALL, improve_plan, shortage
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.options import check_margin
from cirl_marl.optimum.planned_episodes import simulate_plan
from cirl_marl.optimum.program import fewest_pieces

DEGREES = (1, 2, 3, 4)
"""Degrees of the test polynomials, in turn, all with constant parts (``tight``). Without these degree 3 bounded seeds
42 and 81 of the cycles with lifetimes of ``benchmarks.yearly`` by 2.0 % and 0.03 % more, more than degrees 1 and 2 do
with them; they took it 2 and 1 s more of 10 and 12."""
LONGER = 1.5
"""Power of the number of moments with which the time for a bound grows, of cycles with lifetimes. With as many pieces
degree 2 took 1.6 times as long as degree 1 (seeds 45 and 62: power 1.1); degree 3 took 4.0 and 4.7 times as long as
degree 2 where one piece became two (42, 29: 1.4, 1.6), degree 4 more than 4.0 times as long as 3 (42: 2.2)."""
NEGLIGIBLE = 0.05
"""Part of the gap that is asked for, which a step of a plan has to promise to be made."""
STALLED, STEPS = 0.25, 3
"""Part of what a plan is still too far from the bound, which so many steps have to bring it nearer, or a tighter bound
comes before the next. After one such step numbers 108, 110 and 107 of the cycles with lifetimes ended at 1.57 %, 1.42 %
and, by degree 2, 0.59 %; with three at 1.01 %, 1.33 % and, by degree 1, 0.61 %; bounds are tighter since."""


@frozen_record
class GapClosure:
    """What came of it."""

    bound: Annotated[Bound, "the lowest that was proved, with the actions of the best plan"]
    run: Annotated[Rollout, "the episode of the plan in the simulator"]
    gap: Annotated[float, "of the plan, relative to the bound; NaN if it is short of a service or over a budget"]
    seconds: Annotated[float, "of processor time"]


def close_gap(
    network: str | Network,
    *,
    within: float = 0.01,
    seconds: float = math.inf,
    degrees: Sequence[int] = DEGREES,
    min_service: ArrayLike | None = None,
    **options: Any,
) -> GapClosure:
    """Return a plan and a bound that are ``within`` a gap of each other, or as near as they come in the time.

    Args:
        network: catalogue name, path of a definition file, or a network.
        within: gap that is enough, relative to the bound.
        seconds: of processor time in which to begin what takes long; the first bound, and a step, are seen through.
        degrees: of the test polynomials, tried in turn.
        min_service: see ``bound``.
        options: others of ``bound``, but ``degree``, ``tight`` and ``service_weight``.

    Raises:
        CirlError: as ``bound`` of the first degree does.
    """
    check_margin(within, "within")
    start = time.process_time()

    def clock() -> float:
        return time.process_time() - start

    tightest: Bound | None = None
    for degree, higher in zip(degrees, [*degrees, None][1:], strict=True):
        bound_start = clock()
        try:
            solution = bound(network, min_service=min_service, degree=degree, tight=True, **options)
            options["near"] = solution
        except CirlError:
            if tightest is None:
                raise
            break  # a solver that fails at a higher degree takes nothing back
        duration = clock() - bound_start
        actions = solution.actions if tightest is None else tightest.actions
        if tightest is None or solution.objective < tightest.objective:
            tightest = replace(solution, actions=actions)
        distances = list[float]()

        growth = math.inf if higher is None else _moments_ratio(solution.problem.layout, higher) ** LONGER

        def is_last(duration: float = growth * duration) -> bool:
            return math.isinf(duration) or clock() + duration > seconds

        def is_enough(episode: Rollout, tightest: Bound = tightest, distances: list[float] = distances) -> bool:
            distances.append(_gap(tightest, episode) - within)
            is_stalled = len(distances) > STEPS and distances[-1 - STEPS] - distances[-1] < STALLED * distances[-1]
            return distances[-1] <= 0 or clock() > seconds or (is_stalled and not is_last())

        plan = improve_plan(tightest, least_gain=NEGLIGIBLE * within, enough=is_enough)
        tightest = replace(tightest, actions=plan.actions)
        if is_last() or _gap(tightest, simulate_plan(tightest)) <= within:
            break
    if tightest is None:
        raise CirlError("degrees: give at least one")
    run = simulate_plan(tightest)
    return GapClosure(bound=tightest, run=run, gap=_gap(tightest, run), seconds=clock())


def _moments_ratio(layout: Layout, degree: int) -> float:
    """Return how many times the moments of a layout one of another degree has, in as many pieces if it may."""
    return max(layout.pieces, fewest_pieces(degree)) * (degree + 1) / len(layout.moments)


def _gap(solution: Bound, run: Rollout) -> float:
    """Return the gap of an episode; NaN if it is short of what is demanded."""
    if shortage(solution, run) > TOLERATED_SHORTFALL:
        return math.nan
    return float(gap(solution.objective, solution.aims.value(run)))
