"""The best that can be done without looking: one action for all time, or one schedule for all that may happen.

Both are optimised over common draws of all that episodes draw, with the cross-entropy method: the best constant from
the ends and the middle of all ranges, the best schedule from that constant and from plans for what is expected, which
demand more or less of the services than is expected of them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Arrays, Controller, Planner
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError
from cirl_marl.network import Floats
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.bounds import bound
from cirl_marl.optimum.cross_entropy import KNOTS, SHORTFALL_PRICE, explore, objective_of
from cirl_marl.optimum.improve import improve_plan
from cirl_marl.optimum.options import check_margin, check_options, demanded_levels, starting_stocks, with_margin
from cirl_marl.optimum.planned_episodes import DrawnPopulation
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
SHORTFALL, RISE, RISES = 5e-4, 10.0, 2
"""Expected level that may be lacking without a higher price of it; by what that is multiplied, how often at most."""


class Replay(Controller):
    """The same actions in every copy, whatever happens."""

    def __init__(self, actions: Floats) -> None:
        """Take normalised actions, shape (steps, entries), or (1, entries) for all time."""
        self.actions = actions

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Begin with the first."""
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
        margin: float = 1.0,
        draws: int = DRAWS,
        population: int = 48,
    ) -> None:
        """Choose the objective.

        Args:
            min_service: expected level demanded of every service, or of each, shape (services,), a share in [0, 1].
            service_weight: w of λ̄/circularity_scale + w·service; excludes ``min_service``.
            margin: by what the demanded levels are multiplied, up to 1.
            draws: of which the mean counts; seeds of their own.
            population: actions tried in an iteration.

        Raises:
            CirlError: for an option that cannot be used.
        """
        check_options(service_weight, min_service, DEGREE)
        check_margin(margin)
        if draws < FEWEST:
            raise CirlError(f"draws {draws}: too few to say what is best on average, at least {FEWEST}")
        self._min_service, self._weight = min_service, service_weight
        self._margin, self._draws, self._population = margin, draws, population
        self.actions = np.empty((0, 0))

    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Look for the actions; ``seed`` has no effect."""
        self.actions = self._search(env, LEVELS, self.knots, progress)
        self._replay = Replay(self.actions)
        self._replay.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return the actions of the interval."""
        return self._replay.act(observations)

    def _search(
        self,
        env: MultiAgentVectorEnv,
        candidates: Iterator[Floats] | tuple[float, ...],
        knots: int,
        progress: Callable[[float], None],
    ) -> Floats:
        """Return the best actions that are found, shape (1 or steps, entries)."""
        network, entries = env.network, sum(action.shape[1] for action in env.neutral_action.values())
        demand = np.zeros(0)
        if self._min_service is not None:
            demand = np.minimum(self._margin * demanded_levels(network, self._min_service), 1.0)
        seeds, price = range(FIRST_DRAW, FIRST_DRAW + self._draws), SHORTFALL_PRICE
        actions = [part if np.ndim(part) else np.full((1, entries), part) for part in candidates]
        for rise in range(RISES + 1):
            _, best, _ = explore(
                lambda size: DrawnPopulation(network, env.agents, seeds, size, uncertain=env.uncertain),
                [Replay(np.asarray(part)) for part in actions],
                partial(objective_of, network, service_weight=self._weight, demand=demand, price=price),
                knots=knots,
                population=self._population,
                iterations=self.iterations,
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

    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Look for the actions; ``seed`` has no effect."""
        constant = self._search(env, LEVELS, 1, lambda share: progress(0.3 * share))
        candidates = [constant, *self._plans(env)]
        knots = min(KNOTS, env.network.episode.horizon)
        self.actions = self._search(env, iter(candidates), knots, lambda share: progress(0.4 + 0.6 * share))
        self._replay = Replay(self.actions)
        self._replay.start(env, seed)

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
