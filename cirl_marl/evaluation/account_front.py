"""Two aims against each other, λ̄ or totals of accounts: what is possible at most, and what plans achieve.

The second is bounded by budgets from what the plan with least of it takes to what the best of the first takes. Each
program proves a line that no episode exceeds, v + p·(b − b_k), v its optimum at the budget b_k and p the price of that;
the least of all lines is the front. Between money and emissions p is the price of carbon, and the front the curve of
marginal costs.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Neutral
from cirl_marl.controllers.rollout import Rollout, episode_start, rollout
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.evaluation.comparison import ProgressReport, part_of
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum import bound, improve_plan, simulate_plan
from cirl_marl.optimum.aims import aims_of
from cirl_marl.optimum.improve import shortage

TIGHTEST = 1e-4
"""Range of budgets, relative to the highest, below which there is nothing to weigh."""
SERVED = 1e-3
"""What a plan may lack of a service, or exceed its budget by relative to that, and count."""


@positional_record
class AccountFront:
    """λ̄, or the total of an account, at each of several budgets of another account; k budgets."""

    network: Network
    axes: Annotated[tuple[str, str], "what is aimed at, and what has budgets"]
    min_service: Annotated[Floats, "mean level demanded of each service, shape (services,)"]
    budgets: Annotated[Floats, "shape (k,), rising"]
    bounds: Annotated[Floats, "best possible of the first, shape (k,)"]
    prices: Annotated[Floats, "what the first gains by one more of the budget, shape (k,)"]
    plans: Annotated[Floats, "what plans come to in the simulator, first and second, shape (k, 2)"]
    levels: Annotated[Floats, "least mean level of a service under each plan, shape (k,)"]
    shortages: Annotated[Floats, "most that a plan is short of a service or exceeds its budget, relative, shape (k,)"]
    as_usual: Annotated[Floats, "first and second under neutral control, shape (2,)"]

    @property
    def sign(self) -> float:
        """1 if more of the first is better, −1 if less is."""
        return 1.0 if self.axes[0] == CIRCULARITY else -1.0

    @property
    def units(self) -> tuple[str, str]:
        """Those of the two."""
        units = {account.id: account.unit for account in self.network.accounts}
        return tuple(units.get(axis, self.network.mass_unit) for axis in self.axes)  # type: ignore[return-value]

    def at(self, budgets: ArrayLike) -> Floats:
        """Return what is proved of the first at other budgets."""
        lines = self.sign * self.bounds[:, None] + self.prices[:, None] * (np.ravel(budgets) - self.budgets[:, None])
        return self.sign * np.asarray(lines.min(axis=0))

    @property
    def volumes(self) -> tuple[float, float]:
        """Areas that proved points and plans dominate within the nadir of the proved ones: the hypervolumes.

        Plans that are short of what is demanded do not count.
        """
        nadir = self.budgets[-1], float(self.sign * self.bounds[0])
        served_plans = self.plans[self.shortages <= SERVED]
        points = (np.stack([self.budgets, self.sign * self.bounds]), served_plans.T[::-1] * [[1.0], [self.sign]])
        bounds, plans = (area_dominated(second, first, *nadir) for second, first in points)
        return bounds, plans


def area_dominated(second: Floats, first: Floats, most: float, least: float) -> float:
    """Return the area below and right of some points, up to ``most`` of the second and down to ``least`` of the first.

    >>> area_dominated(np.array([1.0, 2.0]), np.array([1.0, 3.0]), 4.0, 0.0)
    7.0
    """
    order = np.argsort(second)
    ends = np.append(np.minimum(second[order], most), most)
    heights = np.maximum.accumulate(np.maximum(first[order] - least, 0.0))
    return float(np.diff(ends) @ heights)


def account_front(
    network: str | Path | Network,
    axes: tuple[str, str],
    *,
    min_service: ArrayLike,
    scenario: str | None = None,
    points: int = 7,
    progress: ProgressReport = lambda activity, share: None,
) -> AccountFront:
    """Hold two aims against each other at a demanded service: λ̄ or an account, and a further account.

    Args:
        network: catalogue name, definition file, or network, with accounts.
        axes: ``circularity`` or an account, and an account.
        min_service: mean level of every service, or of each, shape (services,).
        scenario: of the definition; None is the default.
        points: how many budgets, at least 3.
        progress: as for ``compare``.

    Raises:
        CirlError: for input that cannot be used, or if both can be had at once, so that there is nothing to weigh.
        NoCertificate: for a network whose flows are not linear laws.
    """
    whole_number("points", points, 3)
    definition = (load_network(network) if isinstance(network, str | Path) else network).scenario(scenario)
    first, second = axes
    if first == second or second == CIRCULARITY:
        raise CirlError(f"front of {first} and {second}: give '{CIRCULARITY}' or an account, then another account")
    aims, bounded = aims_of(definition, first, None), aims_of(definition, second, None)
    assert bounded.account is not None
    progress("bounds and plans", 0.0)
    free, least = (bound(definition, aim=aim, min_service=min_service) for aim in axes)
    lowest = simulate_plan(improve_plan(least)).accounts[0, bounded.account]
    highest = free.accounts[bounded.account]
    if highest - lowest <= TIGHTEST * abs(highest):
        raise CirlError(
            f"network '{definition.name}': the best {first} takes no more {second} than the least that a plan does, "
            f"{lowest:.6g} {definition.accounts[bounded.account].unit}, so that there is nothing to weigh"
        )
    budgets = np.linspace(lowest, highest, points)
    solutions, runs = [], []
    for place, budget in enumerate(budgets.tolist()):
        solutions.append(bound(definition, aim=first, at_most={second: budget}, min_service=min_service))
        report = part_of(progress, "bounds and plans", place / points, 1 / points)
        runs.append(simulate_plan(improve_plan(solutions[-1], progress=report)))
    env = MultiAgentVectorEnv(definition, num_envs=1)
    origin = episode_start(env)
    as_usual = rollout(env, Neutral(), seed=origin.seed, start=origin.initial_state)
    sign = 1.0 if aims.account is None else -1.0

    def coordinates(run: Rollout) -> list[float]:
        return [sign * aims.value(run), -bounded.value(run)]

    return AccountFront(
        network=definition,
        axes=axes,
        min_service=np.zeros(0) if free.min_service is None else free.min_service,
        budgets=budgets,
        bounds=np.array([sign * each.objective for each in solutions]),
        prices=np.array([each.budget_prices[second] for each in solutions]),
        plans=np.array([coordinates(run) for run in runs]),
        levels=np.array([float(run.least_service[0]) for run in runs]),
        shortages=np.array([shortage(each, run) for each, run in zip(solutions, runs, strict=True)]),
        as_usual=np.array(coordinates(as_usual)),
    )
