"""The best that can be done without looking: one action for all time, or one schedule for all that may happen.

Both are optimised over common draws of all that episodes draw. The best constant is found by the cross-entropy method,
from the ends and the middle of all ranges; the best schedule climbs exact gradients (``improve_schedule``), from that
constant and from the best plan for what is expected, which may demand more of the services than is expected of them.
Networks without derivatives are searched.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import partial
from typing import Self

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Arrays, Controller, Planner
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.bounds import bound
from cirl_marl.optimum.cross_entropy import KNOTS, SHORTFALL_PRICE, explore, objective_of
from cirl_marl.optimum.improve import improve_plan
from cirl_marl.optimum.options import check_margin, check_options, demanded_levels, starting_stocks, with_margin
from cirl_marl.optimum.planned_episodes import DrawnPopulation
from cirl_marl.optimum.schedule_ascent import ScheduleAscent, improve_schedule
from cirl_marl.optimum.window_planner import Future, WindowPlanner
from cirl_marl.optimum.windows import WindowTask

FIRST_DRAW = 2**30
"""First seed of the draws; no evaluation has it."""
FEWEST, DRAWS = 2, 32
"""Fewest draws over which anything is optimised, and how many there are unless another number is asked for."""
PLAN_MARGINS = (1.0, 1.15, 1.35, 1.6, 2.0)
"""What plans for what is expected demand of services, relative to their bands."""
LEVELS = (-1.0, -0.5, 0.0, 0.5, 1.0)
"""Actions with which the search for a constant begins."""
DEGREE, ROUNDS = 1, 10
"""Of the programs of plans, and most steps by which the last of them is improved."""
MORE_DRAWS = 4
"""Times as many draws for a schedule, which has an action for every interval, and would fit itself to few."""
UPDATES, FEWER = 200, 2
"""Of the ascent; what part of these, and of iterations, there are where another margin's actions are begun with."""
SHORTFALL, RISE, RISES = 5e-4, 10.0, 2
"""Expected level that may be lacking without a higher price of it; by what that is multiplied, how often at most."""


class Replay(Controller):
    """The same actions in every copy, whatever happens."""

    def __init__(self, actions: Floats) -> None:
        """Take normalised actions, shape (steps, entries), or (1, entries) for all time."""
        self.actions = actions

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Begin with the first; a ``ControlError`` says that they are of other agents."""
        entries = sum(space.shape[0] for space in env.action_spaces.values())
        if self.actions.ndim != 2 or not len(self.actions) or self.actions.shape[1] != entries:
            raise ControlError(f"a schedule of {env} has shape (steps, {entries}), got {self.actions.shape}")
        self._env = env

    def act(self, observations: Arrays) -> Arrays:
        """Return those of the interval; a ``ControlError`` says that there are no more."""
        step = int(self._env.physical.step[0])
        if len(self.actions) > 1 and step >= len(self.actions):
            raise ControlError(f"the schedule is over after {len(self.actions)} steps: call reset()")
        action = self.actions[min(step, len(self.actions) - 1)]
        return dict(self._env.unstack(np.repeat(action[:, None], self._env.num_envs, axis=1)))


class BestConstant(Planner):
    """One action for all time and all that may happen, the best on average over common draws.

    Attributes:
        actions: once started, normalised, shape (1, entries).
    """

    ahead = 0.99
    knots, iterations = 1, 30

    def __init__(
        self,
        *,
        min_service: ArrayLike | None = None,
        service_weight: float | None = None,
        margin: ArrayLike = 1.0,
        draws: int = DRAWS,
        population: int = 48,
    ) -> None:
        """Choose the objective.

        Args:
            min_service: expected level demanded of every service, or of each, shape (services,), a share in [0, 1].
            service_weight: w of λ̄/circularity_scale + w·service; excludes ``min_service``.
            margin: by what the share of every service that may lack, or of each, shape (services,), is divided.
            draws: of which the mean counts, with seeds of their own; MORE_DRAWS times as many for a schedule.
            population: actions tried in an iteration.

        Raises:
            CirlError: for an option that cannot be used.
        """
        check_options(service_weight, min_service, DEGREE)
        check_margin(margin)
        if draws < FEWEST:
            raise CirlError(f"draws {draws}: too few to say what is best on average, at least {FEWEST}")
        self._min_service, self._weight = min_service, service_weight
        self._margin, self._draws, self._population = np.asarray(margin, dtype=float), draws, population
        self._results: list[tuple[Network, dict[tuple[float, ...], Floats]]] = []
        self.actions = np.empty((0, 0))

    def with_margin(self, margin: ArrayLike) -> Self:
        """Return one with another margin, which begins with what is found for others."""
        check_margin(margin)
        other = copy(self)
        other._margin = np.asarray(margin, dtype=float)
        return other

    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Look for the actions; ``seed`` has no effect."""
        if not self._results or self._results[0][0] is not env.network:
            self._results[:] = [(env.network, {})]
        by_margin, margins = self._results[0][1], env.network.by_service("margin", self._margin, "a margin")
        if (key := tuple(margins.tolist())) not in by_margin:
            nearest = min(by_margin, key=lambda place: np.abs(place - margins).max(initial=0.0), default=None)
            by_margin[key] = self._best(env, None if nearest is None else by_margin[nearest], progress)
        self.actions = by_margin[key]
        self._replay = Replay(self.actions)
        self._replay.start(env, seed)

    def _best(self, env: MultiAgentVectorEnv, similar: Floats | None, progress: Callable[[float], None]) -> Floats:
        """Return the best actions, beginning with what is best for another margin, if that is known."""
        if similar is None:
            return self._search(env, LEVELS, self.knots, self.iterations, progress)
        return self._search(env, (*LEVELS, similar), self.knots, self.iterations // FEWER, progress)

    def _demand(self, network: Network) -> Floats | None:
        """Return the expected levels that are aimed at, shape (services,)."""
        if self._min_service is None:
            return None
        lack = 1.0 - demanded_levels(network, self._min_service)
        return 1.0 - lack / network.by_service("margin", self._margin, "a margin")

    def act(self, observations: Arrays) -> Arrays:
        """Return the actions of the interval."""
        return self._replay.act(observations)

    def _search(
        self,
        env: MultiAgentVectorEnv,
        candidates: Sequence[float | Floats],
        knots: int,
        iterations: int,
        progress: Callable[[float], None],
    ) -> Floats:
        """Return the best actions that are found, shape (1 or steps, entries)."""
        network, entries = env.network, sum(action.shape[1] for action in env.neutral_action.values())
        demand = np.zeros(0) if (aim := self._demand(network)) is None else np.maximum(aim, 0.0)
        seeds, price = range(FIRST_DRAW, FIRST_DRAW + self._draws), SHORTFALL_PRICE
        actions = [part if np.ndim(part) else np.full((1, entries), part) for part in candidates]
        for rise in range(RISES + 1):
            _, best, _ = explore(
                lambda size: DrawnPopulation(network, env.agents, seeds, size, uncertain=env.uncertain),
                [Replay(np.asarray(part)) for part in actions],
                partial(objective_of, network, service_weight=self._weight, demand=demand, price=price),
                knots=knots,
                population=self._population,
                iterations=iterations,
                seed=rise,
                progress=lambda share, objective: progress(share),
            )
            if not len(demand) or (demand - best.levels[0]).max() <= SHORTFALL:
                break
            actions, price = [*actions, best.actions[0]], price * RISE
        return np.asarray(best.actions[0])


class BestSchedule(BestConstant):
    """One schedule for all that may happen, the best on average over common draws that is found.

    Attributes:
        actions: once started, normalised, shape (steps, entries).
    """

    iterations = 40

    def _best(self, env: MultiAgentVectorEnv, similar: Floats | None, progress: Callable[[float], None]) -> Floats:
        try:
            if similar is not None:
                return self._ascend(env, similar, UPDATES // FEWER).actions
            constant = self._search(env, LEVELS, 1, self.iterations, lambda share: progress(0.3 * share))
            plans = sorted((self._ascend(env, plan, 0) for plan in self._plans(env)), key=self._rank(env))
            starts = [constant, *(plan.actions for plan in plans[-1:])]
            progress(0.4)
            return max((self._ascend(env, start, UPDATES) for start in starts), key=self._rank(env)).actions
        except CirlError as reason:
            self.note = f"found by search, without derivatives: {reason}"
        candidates: list[float | Floats] = [*LEVELS, *self._plans(env)] if similar is None else [similar]
        return self._search(env, candidates, min(KNOTS, env.network.episode.horizon), self.iterations, progress)

    def _ascend(self, env: MultiAgentVectorEnv, start: Floats, updates: int) -> ScheduleAscent:
        """Return the best schedule met on the way up from one, over the common draws."""
        count = MORE_DRAWS * self._draws
        draws = MultiAgentVectorEnv(env.network, num_envs=count, agents=env.agents, uncertain=env.uncertain)
        draws.reset(seed=list(range(FIRST_DRAW, FIRST_DRAW + count)))
        demand, weight = self._demand(env.network), self._weight
        return improve_schedule(draws, start, min_service=demand, service_weight=weight, updates=updates)

    def _rank(self, env: MultiAgentVectorEnv) -> Callable[[ScheduleAscent], tuple[float, float]]:
        """Return by what schedules are told apart: what they lack, then what they are worth."""
        scale, demand, weight = env.network.objective.circularity_scale, self._demand(env.network), self._weight or 0.0

        def rank(best: ScheduleAscent) -> tuple[float, float]:
            lack = 0.0 if demand is None else max(0.0, float((demand - best.levels).max(initial=0.0)) - SHORTFALL)
            return -lack, best.circularity / scale + weight * float(best.levels.mean() if best.levels.size else 0.0)

        return rank

    def _plans(self, env: MultiAgentVectorEnv) -> Iterator[Floats]:
        """Yield the actions of plans for what is expected, from the middle of the initial ranges."""
        expected, intervals = expected_network(env.network), range(env.network.episode.horizon)
        demand = None if self._min_service is None else demanded_levels(expected, self._min_service)
        try:
            for margin in PLAN_MARGINS if demand is not None else (1.0,):
                admissible = Admissible.of(with_margin(expected, margin), env.agents or None)
                planner = WindowPlanner([Future(admissible, DEGREE, self._weight)], self._weight)
                start = starting_stocks(admissible.lifetimes, None)
                task = WindowTask(start, intervals, demand, None, planner.first_price, None)
                yield planner.plan(task, None, len(intervals)).actions
            service, weight = self._min_service, self._weight
            proof = bound(
                expected, agents=env.agents or None, min_service=service, service_weight=weight, degree=DEGREE
            )
            yield improve_plan(proof, rounds=ROUNDS).actions
        except CirlError as reason:
            self.note = f"not begun with all plans for what is expected: {reason}"
