"""Two or three aims against each other, λ̄, services, totals of accounts: what is possible, and what plans achieve.

The first is the best that there is at several demands on the others: budgets of accounts, from what the plan with least
of it takes to what the best of the first takes, and levels of services, from those of the best of the first to the
highest. Each program proves a plane that no episode exceeds, v + Σ_i p_i·(b_i − b_ki), v its optimum at the demands b_k
and p_i the price of each; the least of all planes is the front. Between money and emissions p is the price of carbon,
and the front the curve of marginal costs.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Neutral
from cirl_marl.controllers.episode_quantities import QuantityKind, episode_quantities
from cirl_marl.controllers.rollout import Rollout, episode_start
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, check_names, whole_number
from cirl_marl.evaluation.comparison import ProgressReport
from cirl_marl.network import Floats, Network
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum import Bound, bound, improve_plan, simulate_plan
from cirl_marl.optimum.aims import aims_of
from cirl_marl.optimum.improve import shortage
from cirl_marl.optimum.options import demanded_levels
from cirl_marl.optimum.supply_limits import with_supply_limits

TIGHTEST = 1e-4
"""Range of a demand, relative to the highest, below which there is nothing to weigh."""
SERVED = 1e-3
"""What a plan may lack of a service, or exceed its budget by relative to that, and count."""
POINTS = {2: 7, 3: 4}
"""How many demands there are on each other aim, by the number of aims."""
AIMS: tuple[QuantityKind, ...] = ("circularity", "service", "account")
"""Kinds of what is weighed."""
WITHIN_REACH = 1e-6
"""By how much the highest level demanded of a service is less than the highest there is, which no solver holds."""


@positional_record
class AccountFront:
    """λ̄, the total of an account or the level of a service at k demands on one or two other aims; d aims in all."""

    network: Network
    axes: Annotated[tuple[str, ...], "what is aimed at, and what has demands"]
    min_service: Annotated[Floats, "mean level demanded of each service that is no aim, shape (services,)"]
    demands: Annotated[Floats, "budgets, and least levels of services, shape (k, d − 1)"]
    bounds: Annotated[Floats, "best possible of the first, shape (k,)"]
    prices: Annotated[Floats, "what the first gains by one more of a demand, loses by a level, shape (k, d − 1)"]
    plans: Annotated[Floats, "what plans come to in the simulator, shape (k, d)"]
    levels: Annotated[Floats, "least mean level of a service under each plan, shape (k,)"]
    shortages: Annotated[Floats, "most that a plan is short of a service or exceeds its budget, relative, shape (k,)"]
    as_usual: Annotated[Floats, "the aims under neutral control, shape (d,)"]
    is_limited: Annotated[Bools, "bounds that hold for episodes at least as good as ``least`` alone, shape (k,)"]
    least: Annotated[float, "objective, which is λ̄, minus a total or a level"]
    highest: Annotated[float, "level of a service that comes first, whatever is demanded"] = math.inf

    @property
    def signs(self) -> Floats:
        """1 where more is better, −1 where less is, shape (d,)."""
        accounts = {account.id for account in self.network.accounts}
        return np.array([-1.0 if axis in accounts else 1.0 for axis in self.axes])

    @property
    def units(self) -> tuple[str, ...]:
        """Those of the aims."""
        units = {figure.of or CIRCULARITY: figure.unit for figure in episode_quantities(self.network, *AIMS)}
        return tuple(units[axis] for axis in self.axes)

    def at(self, demands: ArrayLike) -> Floats:
        """Return what is proved of the first, shape (n,), at other demands, shape (n, d − 1)."""
        points = np.reshape(demands, (-1, len(self.axes) - 1))
        planes = self.signs[0] * self.bounds + ((points[:, None] - self.demands) * self.prices).sum(axis=2)
        limited = planes.min(axis=1, where=self.is_limited, initial=np.inf)
        always = planes.min(axis=1, where=~self.is_limited, initial=np.inf)
        proved = np.minimum(np.minimum(always, np.maximum(limited, self.least)), self.highest)
        return np.asarray(self.signs[0] * proved)

    @property
    def volumes(self) -> tuple[float, float]:
        """What proved points and plans dominate within the nadir of the proved ones: the hypervolumes.

        Points are proved at demands, and by planes where plans have less of an account or more of a service than
        demanded. Plans that are short of what is demanded do not count.
        """
        proved = self.signs * np.column_stack([self.bounds, self.demands])
        nadir, others = proved.min(axis=0), self.plans[:, 1:]
        at_plans = self.signs * np.column_stack([self.at(others), others])
        plans = self.signs * self.plans[self.shortages <= SERVED]
        return volume_dominated(np.concatenate([proved, at_plans]), nadir), volume_dominated(plans, nadir)


def volume_dominated(points: Floats, nadir: Floats) -> float:
    """Return the volume of all that is at most as good as one of some points, shape (k, d), and better than ``nadir``.

    More is better. Volumes of fewer dimensions are added along the last one.

    >>> volume_dominated(np.array([[1.0, 3.0], [3.0, 2.0]]), np.array([0.0, 0.0]))
    7.0
    """
    points = points[(points > nadir).all(axis=1)]
    if not len(points):
        return 0.0
    points = points[np.argsort(-points[:, -1])]
    if len(nadir) == 1:
        return float(points[0, 0] - nadir[0])
    heights = -np.diff(np.append(points[:, -1], nadir[-1]))
    areas = [volume_dominated(points[: k + 1, :-1], nadir[:-1]) for k in range(len(points))]
    return float(heights @ areas)


def account_front(
    network: str | Path | Network,
    axes: Sequence[str],
    *,
    min_service: ArrayLike | None = None,
    scenario: str | None = None,
    points: int | None = None,
    progress: ProgressReport = lambda activity, share: None,
) -> AccountFront:
    """Hold two or three of λ̄, accounts and services against each other at a demanded level of other services.

    Args:
        network: catalogue name, definition file, or network.
        axes: two or three accounts or services, in place of the first perhaps ``circularity``.
        min_service: mean level of every service that is no aim, or of each, shape (services,); needed if there is one.
        scenario: of the definition; None is the default.
        points: how many demands on each other aim, at least 3; None: POINTS.
        progress: as for ``compare``.

    Raises:
        CirlError: for input that cannot be used, or if all can be had at once, so that there is nothing to weigh.
        NoCertificate: for a network whose flows are not linear laws.
    """
    definition = load_network(network, scenario=scenario)
    _check_axes(definition, axes)
    points = whole_number("points", POINTS[len(axes)] if points is None else points, 3)
    others = [service.id for service in definition.services if service.id not in axes]
    if min_service is None and others:
        raise CirlError(
            f"front of {', '.join(axes)}: give min_service, at which they are weighed, of {', '.join(others)}"
        )
    levels = demanded_levels(definition, 0.0 if min_service is None else min_service).copy()
    levels[[service.id in axes for service in definition.services]] = 0.0
    sweep = _Sweep(definition, tuple(axes), points, levels, progress)
    sweep.run(tuple(axes), {}, levels)
    progress("bounds and plans", 1.0)  # there are fewer points where an aim has a single value
    if len(sweep.solutions) == 1:
        ends = " and ".join(f"{axis} {value:.6g}" for axis, value in zip(axes[1:], sweep.demands[0], strict=True))
        raise CirlError(
            f"network '{definition.name}': the best {axes[0]} takes no more than the best there is of {ends}, so "
            "that there is nothing to weigh"
        )
    return sweep.front()


def _check_axes(network: Network, axes: Sequence[str]) -> None:
    names = [figure.of or CIRCULARITY for figure in episode_quantities(network, *AIMS)]
    check_names("aim", axes, names, f"network '{network.name}': front: ")
    if len(axes) not in (2, 3) or len(set(axes)) < len(axes) or CIRCULARITY in axes[1:]:
        choice = f"give two or three different accounts or services, the first of which may be '{CIRCULARITY}'"
        raise CirlError(f"front of {', '.join(axes)}: {choice}")


def _within_reach(level: float) -> float:
    """Return what may be demanded where a level is the highest there is."""
    return max(float(level) - WITHIN_REACH, 0.0)


class _Sweep:
    """Programs and plans at all demands.

    Idle supplies have lower ends in programs, which no episode exceeds that is as good as where others are best.
    """

    def __init__(
        self, network: Network, axes: tuple[str, ...], points: int, min_service: Floats, progress: ProgressReport
    ) -> None:
        """Find out how bad the first of ``axes`` is where each other one is best."""
        self.definition, self.axes, self.points, self.min_service = network, axes, points, min_service
        self.demands: list[list[float]] = []
        self.solutions: list[Bound] = []
        self.runs: list[Rollout] = []
        self._progress, self._aims = progress, aims_of(network, axes[0], None, with_services=True)
        self._accounts = [account.id for account in network.accounts]
        self._services = [service.id for service in network.services]
        progress("bounds and plans", 0.0)
        self.are_limited: list[bool] = []
        free = bound(network, aim=axes[0], min_service=min_service)
        self._highest = free.objective if axes[0] in self._services else math.inf
        self._least = min(self._aims.value(self._plan_of_best(axis)) for axis in axes[1:])
        self._programs = with_supply_limits(free, self._least)
        self._has_limits = self._programs is not free.network

    def _plan_of_best(self, axis: str) -> Rollout:
        """Return the episode of the plan that has most of a service, or least of an account."""
        if axis in self._accounts:
            return self._carried_out(bound(self.definition, aim=axis, min_service=self.min_service))
        service = self._services.index(axis)
        levels = self.min_service.copy()
        levels[service] = _within_reach(bound(self.definition, aim=axis, min_service=levels).levels[service])
        return self._carried_out(bound(self.definition, aim=self.axes[0], min_service=levels))

    def _carried_out(self, solution: Bound) -> Rollout:
        """Return the episode of the network under the plan of a program."""
        return simulate_plan(improve_plan(replace(solution, network=self.definition)))

    def run(self, axes: tuple[str, ...], budgets: Mapping[str, float], levels: Floats) -> None:
        """Solve the program at some demands, or those at several demands on the last of ``axes``."""
        last = axes[-1]
        if len(axes) == 1:
            solution, is_limited = self._best(budgets, levels)
            self.solutions.append(solution)
            self.are_limited.append(is_limited)
            self.runs.append(self._carried_out(solution))
            self.demands.append([budgets.get(axis, levels[self._place(axis)]) for axis in self.axes[1:]])
            share = len(self.solutions) / self.points ** (len(self.axes) - 1)
            self._progress("bounds and plans", share)
            return
        free = self._best_of_last(last, self._best(budgets, levels)[0], budgets, levels)
        if last in self._accounts:
            place = self._accounts.index(last)
            best = bound(self.definition, aim=last, at_most=budgets, min_service=levels)
            ends = float(self._carried_out(best).accounts[0, place]), float(free.accounts[place])
        else:
            place = self._services.index(last)
            most = _within_reach(bound(self.definition, aim=last, at_most=budgets, min_service=levels).levels[place])
            ends = min(self._level(free, place), most), most
        is_range = ends[1] - ends[0] > TIGHTEST * abs(ends[1])
        for demand in np.linspace(*ends, self.points).tolist() if is_range else [max(ends)]:
            more = levels.copy()
            if last in self._services:
                more[self._services.index(last)] = demand
            self.run(axes[:-1], {**budgets, last: demand} if last in self._accounts else budgets, more)

    def _best_of_last(self, last: str, free: Bound, budgets: Mapping[str, float], levels: Floats) -> Bound:
        """Return the bound with most of the ``last`` aim where the first, if it is a service, is as good as ``free``.

        Many plans may have the highest level of a service.
        """
        if self.axes[0] not in self._services:
            return free
        first, most = self._place(self.axes[0]), levels.copy()
        most[first] = _within_reach(free.levels[first])
        return bound(self.definition, aim=last, at_most=budgets, min_service=most)

    def _level(self, free: Bound, place: int) -> float:
        """Return the level that a service has anyway, of which a program that does not ask for it says too little."""
        if self.axes[0] in self._services:
            return float(free.levels[place])
        return float(simulate_plan(replace(free, network=self.definition)).episode_levels[0, place])

    def _best(self, budgets: Mapping[str, float], levels: Floats) -> tuple[Bound, bool]:
        """Return the bound on the first aim at some demands, and whether it is that of limited supplies.

        Limits are none of episodes that are worse than where others are best, all that there may be at these demands.
        """
        aim = self.axes[0]
        if self._has_limits:
            try:
                solution = bound(self._programs, aim=aim, at_most=budgets, min_service=levels, tight=True)
            except CirlError:
                return bound(self.definition, aim=aim, at_most=budgets, min_service=levels, tight=True), False
            if solution.objective >= self._least:
                return solution, True
        return bound(self.definition, aim=aim, at_most=budgets, min_service=levels, tight=True), False

    def _place(self, axis: str) -> int:
        """Return the position of a service; 0 of what is none."""
        return self._services.index(axis) if axis in self._services else 0

    def front(self) -> AccountFront:
        """Return what was solved."""
        env = MultiAgentVectorEnv(self.definition, num_envs=1)
        as_usual = episode_start(env).play(env, Neutral())
        sign = 1.0 if self._aims.account is None else -1.0
        pairs = zip(self.solutions, self.runs, strict=True)
        return AccountFront(
            network=self.definition,
            axes=self.axes,
            min_service=self.min_service,
            demands=np.array(self.demands),
            bounds=sign * np.array([solution.objective for solution in self.solutions]),
            prices=np.array([self._prices(solution) for solution in self.solutions]),
            plans=np.array([self._coordinates(run) for run in self.runs]),
            levels=np.array([float(run.least_service[0]) for run in self.runs]),
            shortages=np.array([shortage(solution, run) for solution, run in pairs]),
            as_usual=np.array(self._coordinates(as_usual)),
            is_limited=np.array(self.are_limited),
            least=self._least,
            highest=self._highest,
        )

    def _prices(self, solution: Bound) -> list[float]:
        """Return what one more of each demand adds to the objective."""
        levels = dict(zip(self._services, solution.certificate.under[-len(self._services) :].tolist(), strict=True))
        return [(solution.budget_prices | levels)[axis] for axis in self.axes[1:]]

    def _coordinates(self, run: Rollout) -> list[float]:
        """Return what an episode has of each aim."""
        figures = {figure.of or CIRCULARITY: figure for figure in episode_quantities(self.definition, *AIMS)}
        return [float(figures[axis].totals(run)[0]) for axis in self.axes]
