"""Better actions for a plan of a large network: the program again, with controls held and what was lacking on top.

The Jacobians of ``improve`` are dense in the stocks and actions of the whole network. Of a large one they would take
gigabytes; here nothing but the program itself is solved again.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.network import Floats
from cirl_marl.optimum.actions import normalised_actions
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.layout import Layout
from cirl_marl.optimum.merit import merit, prices
from cirl_marl.optimum.plan import achieved
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.solver import Infeasible, Unsolved, solve

ROUNDS = 2
"""Most programs that are solved."""
DEGREE = 1
"""Degree of these programs, whatever that of the bound: they are solved several times."""
KEPT = 1e-4
"""What a service may lack of its demand without a further round."""


def replanned(
    bound: Bound,
    *,
    rounds: int = ROUNDS,
    enough: Callable[[Rollout], bool] = lambda run: False,
    progress: Callable[[float], None] = lambda share: None,
) -> Bound:
    """Return ``bound`` with actions that do better in the simulator; the bound and its certificate stay.

    Each round solves the program of the bound with controls that are constant within an interval to first order
    (``Programs``), which the simulator carries out more faithfully. Where an episode delivers less of a service than
    its program promised, the next one demands that much more: the lower end l of its band becomes

        l·(1 + Σ max(0, promised level − delivered level)),

    summed over the episodes so far, that of the bound's plan being the first. The best episode counts, by the merit of
    ``improved``; rounds end when no service lacks more than KEPT.

    Args:
        bound: with the actions to start from.
        rounds: most programs to solve.
        enough: asked of each episode that is better than those before, whether to stop there.
        progress: called with the share of them that is solved; 1 when no more are needed.
    """
    admissible = Admissible.of(bound.network, bound.agents or None)
    charged, best, run = prices(bound), bound, achieved(bound)
    reached = merit(bound, run, charged)
    raised = 1.0 + _lacking(bound.problem.layout, bound.solution, run, 1.0)
    for done in range(rounds):
        if enough(run):
            break
        asked = replace(admissible, served=admissible.served * raised)
        programs = Programs(asked, DEGREE, bound.service_weight, held=True)
        try:
            problem = programs.program(bound.initial, bound.min_service)
            planned = solve(problem, what="the program of a better plan", certified=False).plan
        except (Infeasible, Unsolved):  # more than can be had: what was found so far is the plan
            break
        layout = programs.layout
        candidate = replace(bound, actions=normalised_actions(asked, layout, planned.reshape(-1, layout.size)))
        tried = achieved(candidate)
        progress((done + 1) / rounds)
        if (worth := merit(bound, tried, charged)) > reached:
            best, run, reached = candidate, tried, worth
        lacking = _lacking(layout, planned, tried, raised)
        if lacking.mean(axis=0).max(initial=0.0) <= KEPT:
            break
        raised += lacking
    progress(1.0)
    return best


def _lacking(layout: Layout, planned: Floats, run: Rollout, raised: float | Floats) -> Floats:
    """Return what an episode lacks of the levels that its program promised, shape (steps, services).

    The program's levels are of bands that were ``raised``.
    """
    levels = planned.reshape(-1, layout.size)[:, layout.level : layout.imbalance]
    lacking: Floats = np.maximum(np.minimum(levels * raised, 1.0) - run.levels[0].T, 0.0)
    return lacking
