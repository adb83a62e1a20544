"""The plan of the bound from each start, improved on the simulator and carried out without looking back."""

from __future__ import annotations

from cirl_marl.controllers.basic import Arrays
from cirl_marl.optimum.bound import Bound
from cirl_marl.optimum.improve import improved
from cirl_marl.optimum.maximise import bound
from cirl_marl.optimum.plan import Plan
from cirl_marl.vector_env import VectorEnv


class Optimum:
    """Open-loop optimal control: once started, every copy has a plan of its own for the whole episode.

    Attributes:
        bounds: once started, the bound whose plan each copy carries out.
    """

    def __init__(self, *, min_service: float | None = None, service_weight: float | None = None) -> None:
        """Choose the objective; see ``bound``."""
        self._min_service, self._service_weight = min_service, service_weight
        self.bounds: list[Bound] = []
        self._plan = Plan(())

    def start(self, env: VectorEnv, seed: int) -> None:
        """Solve a program for the start of every copy and improve its plan; ``seed`` has no effect.

        Raises:
            NoCertificate: for a network whose flows are not linear laws; see ``bound``.
            CirlError: for a service that no plan reaches, or a solver that fails.
        """
        starts = env.physical.stock[: len(env.network.nodes)].T
        self.bounds = [
            improved(
                bound(
                    env.network,
                    start,
                    min_service=self._min_service,
                    service_weight=self._service_weight,
                    agents=env.agents or None,
                )
            )
            for start in starts
        ]
        self._plan = Plan(self.bounds)
        self._plan.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return the planned actions of the next interval."""
        return self._plan.act(observations)
