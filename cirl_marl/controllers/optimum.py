"""The best plan from each start, carried out without looking back: that of the bound, or the best found without one."""

from __future__ import annotations

from cirl_marl.controllers.basic import Arrays
from cirl_marl.optimum.admissible import NoCertificate
from cirl_marl.optimum.bound import Bound
from cirl_marl.optimum.improve import improved
from cirl_marl.optimum.maximise import bound
from cirl_marl.optimum.plan import Plan
from cirl_marl.optimum.population import starting_states
from cirl_marl.optimum.search import KNOTS, Incumbent, search_each
from cirl_marl.vector_env import VectorEnv


class Optimum:
    """Open-loop optimal control: once started, every copy has a plan of its own for the whole episode.

    Attributes:
        plans: once started, whose plan each copy carries out: bounds, or incumbents where nothing is proved.
        note: once started, what is to be said beside its figures; empty if the plans are those of bounds.
    """

    def __init__(self, *, min_service: float | None = None, service_weight: float | None = None) -> None:
        """Choose the objective; see ``bound``."""
        self._min_service, self._service_weight = min_service, service_weight
        self.plans: list[Bound] | list[Incumbent] = []
        self.note = ""
        self._plan = Plan(())

    def start(self, env: VectorEnv, seed: int) -> None:
        """Solve a program for the start of every copy and improve its plan; ``seed`` has no effect.

        Where no program bounds the network (``NoCertificate``), look for plans by simulation, from all starts at once.

        Raises:
            CirlError: for a service that no plan reaches, a solver that fails, or an environment in which nobody acts.
        """
        try:
            self.plans, self.note = self._bounded(env), ""
        except NoCertificate as missing:
            self.plans = self._found(env)
            self.note = f"best plan found, no certificate: {missing}"
        self._plan = Plan(self.plans)
        self._plan.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return the planned actions of the next interval."""
        return self._plan.act(observations)

    def _bounded(self, env: VectorEnv) -> list[Bound]:
        return [
            improved(
                bound(
                    env.network,
                    start,
                    min_service=self._min_service,
                    service_weight=self._service_weight,
                    agents=env.agents or None,
                )
            )
            for start in env.physical.stock[: len(env.network.nodes)].T
        ]

    def _found(self, env: VectorEnv) -> list[Incumbent]:
        return search_each(
            env.network,
            starting_states(env),
            min_service=self._min_service,
            service_weight=self._service_weight,
            agents=env.agents or None,
            knots=min(KNOTS, env.network.episode.horizon),
        )
