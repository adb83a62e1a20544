"""The best plan from each start, carried out without looking back: that of the bound, or the best found without one."""

from __future__ import annotations

from collections.abc import Callable

from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Arrays, Planner
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.optimum.admissible import NoCertificate
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.cross_entropy import KNOTS, Incumbent, search_each
from cirl_marl.optimum.improve import improved
from cirl_marl.optimum.maximise import bound
from cirl_marl.optimum.plan import Plan
from cirl_marl.optimum.population import starting_states

BOUND = 0.3
"""About the share of solving for the bound in the work on a plan; the rest is to improve it."""


class Optimum(Planner):
    """Open-loop optimal control: once started, every copy has a plan of its own for the whole episode.

    Attributes:
        plans: once started, whose plan each copy carries out: bounds, or incumbents where nothing is proved.
        note: empty if the plans are those of bounds.
    """

    ahead = 0.99

    def __init__(self, *, min_service: ArrayLike | None = None, service_weight: float | None = None) -> None:
        """Choose the objective; see ``bound``."""
        self._min_service, self._service_weight = min_service, service_weight
        self.plans: list[Bound] | list[Incumbent] = []
        self._plan = Plan(())

    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Solve a program for the start of every copy and improve its plan; ``seed`` has no effect.

        Where no program bounds the network (``NoCertificate``), look for plans by simulation, from all starts at once.

        Raises:
            CirlError: for a service that no plan reaches, a solver that fails, or an environment in which nobody acts.
        """
        try:
            self.plans, self.note = self._bounded(env, progress), ""
        except NoCertificate as missing:
            self.plans = self._found(env, progress)
            self.note = f"best plan found, no certificate: {missing}"
        self._plan = Plan(self.plans)
        self._plan.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return the planned actions of the next interval."""
        return self._plan.act(observations)

    def _bounded(self, env: MultiAgentVectorEnv, progress: Callable[[float], None]) -> list[Bound]:
        plans: list[Bound] = []
        known: dict[bytes, Bound] = {}  # copies that start alike have the same plan, though their draws differ
        for copy, start in enumerate(env.physical.stock[env.rows.nodes].T):
            told = _told(progress, copy, env.num_envs)
            if (key := start.tobytes()) in known:
                plans.append(known[key])
                told(1.0)
                continue
            found = bound(
                env.network,
                start,
                min_service=self._min_service,
                service_weight=self._service_weight,
                agents=env.agents or None,
            )
            told(0.0)
            plans.append(improved(found, progress=told))
            known[key] = plans[-1]
        return plans

    def _found(self, env: MultiAgentVectorEnv, progress: Callable[[float], None]) -> list[Incumbent]:
        return search_each(
            env.network,
            starting_states(env),
            min_service=self._min_service,
            service_weight=self._service_weight,
            agents=env.agents or None,
            knots=min(KNOTS, env.network.episode.horizon),
            progress=lambda share, merit: progress(share),
        )


def _told(progress: Callable[[float], None], copy: int, copies: int) -> Callable[[float], None]:
    """Return what takes the share of a copy's improvement that is done; its bound is solved."""
    return lambda improvement: progress((copy + BOUND + (1 - BOUND) * improvement) / copies)
