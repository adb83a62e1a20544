"""How far the judged policies of a training were from the bound, and when they first came near enough."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from benchmarks.peers.settings import NETWORK, SERVICE
from benchmarks.peers.watch import Judged
from cirl_marl import MultiAgentVectorEnv
from cirl_marl.controllers.rollout import first_seed, starting_stocks
from cirl_marl.evaluation import solve_baseline
from cirl_marl.evaluation.baselines import Baseline
from cirl_marl.network import Floats
from cirl_marl.optimum import gap

LEVELS = (0.99, 0.995, 0.999)
"""Services at which programs are solved; their multipliers hold at every other, and prove a little less there."""

BOUNDED = 64
"""Episodes whose bounds are computed, each of which takes some 30 ms."""


@dataclass(frozen=True, slots=True)
class Standing:
    """Means over the episodes on which a policy was judged, those of gaps over the first of them.

    Attributes:
        seconds: of training until then.
        processor: those that its process was on processors.
        steps: of the environment.
        circularity: λ̄; mass.
        service: mean level of the service that lacks most.
        gap: to the bound at the service that was delivered.
    """

    seconds: float
    processor: float
    steps: int
    circularity: float
    service: float
    gap: float


@dataclass(frozen=True, slots=True)
class Reference:
    """Bounds of the first episodes on which all are judged."""

    starts: Floats
    measure: Baseline

    @classmethod
    def solved(cls, levels: Sequence[float] = LEVELS, episodes: int = BOUNDED) -> Reference:
        """Solve the programs at ``levels`` of service."""
        env = MultiAgentVectorEnv(NETWORK, num_envs=episodes)
        starts = starting_stocks(env, first_seed(0))
        services = [np.full((episodes, len(env.network.services)), level) for level in levels]
        return cls(starts, solve_baseline(env.network, env.agents, starts, services))

    def standing(self, judged: Judged) -> Standing:
        """Hold a policy against the bounds, episode by episode."""
        levels, circularity = np.array(judged.levels), np.array(judged.circularity)
        first = len(self.starts)
        proved = self.measure.at(self.starts, levels[:first])
        assert proved is not None
        lap, left = judged.lap, float(gap(proved, circularity[:first]).mean())
        return Standing(
            lap.seconds, lap.processor, lap.steps, float(circularity.mean()), float(levels.mean(axis=0).min()), left
        )


def reached(standings: Sequence[Standing], goal: float, service: float = SERVICE) -> Standing | None:
    """Return the first policy that had this gap and at least this service; None if none had."""
    return next((each for each in standings if each.service >= service and each.gap <= goal), None)
