"""Which checkpoint of a run counts: the best by evaluation episodes of their own, not the last."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from cirl_marl.controllers.rollout import rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.learners.policies import Policies

SEEDS = 2**40
"""First seed of the episodes that choose; those of training and of reports are below it."""

CONFIDENT = 1.645
"""Standard errors by which a service must exceed what is demanded, so that it does so in 95 of 100 evaluations."""


@dataclass(frozen=True, slots=True)
class Score:
    """Figures of an evaluation.

    Attributes:
        circularity: mean λ̄ of the episodes; mass.
        service: mean level of the service that lacks most; 1 without services.
        assured: the level that this service exceeds with 95 % confidence.
        paid: mean return of an episode, summed over the agents.
    """

    circularity: float
    service: float
    assured: float
    paid: float

    def rank(self, min_service: float | None) -> tuple[bool, float]:
        """Return what the higher of two scores is better by.

        With a level of service that is demanded: whether it is assured, and then λ̄, or else the level. Without: what
        the learners are paid.
        """
        if min_service is None:
            return True, self.paid
        served = self.assured >= min_service
        return served, self.circularity if served else self.assured

    def said(self) -> dict[str, float]:
        """Return the figures by name."""
        return asdict(self)


class Selection:
    """The episodes that choose: the same ones each time, each in a copy of the environment of its own."""

    def __init__(self, env: MultiAgentVectorEnv) -> None:
        """``env`` has a copy for each episode, and is used by nobody else."""
        self._env = env

    def score(self, policies: Policies) -> Score:
        """Play the episodes by deterministic policies; training is not touched."""
        run = rollout(self._env, policies, seed=SEEDS)
        levels = run.episode_levels
        spread = levels.std(axis=0, ddof=1) if len(levels) > 1 else np.zeros(levels.shape[1])
        assured = levels.mean(axis=0) - CONFIDENT * spread / math.sqrt(len(levels))
        return Score(
            circularity=float(run.episode_circularity.mean()),
            service=float(levels.mean(axis=0).min(initial=1.0)),
            assured=float(assured.min(initial=1.0)),
            paid=float(run.returns.sum(axis=0).mean()),
        )


def score_of(plain: Any) -> Score | None:
    """Return a score that was written to a file; None if there is none."""
    return None if plain is None else Score(**plain)
