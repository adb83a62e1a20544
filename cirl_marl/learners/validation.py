"""Which checkpoint of a run counts: the best by evaluation episodes of their own, not the last."""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cirl_marl.controllers.rollout import rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.learners.policies import Policies
from cirl_marl.records.files import write_json

FIRST_SEED = 2**40
"""First seed of the episodes that choose; those of training and of reports are below it."""

QUANTILE_95 = 1.645
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


class ValidationEpisodes:
    """The episodes that choose: the same ones each time, each in a copy of the environment of its own."""

    def __init__(self, env: MultiAgentVectorEnv) -> None:
        """``env`` has a copy for each episode, and is used by nobody else."""
        self._env = env

    def score(self, policies: Policies) -> Score:
        """Play the episodes by deterministic policies; training is not touched."""
        run = rollout(self._env, policies, seed=FIRST_SEED)
        levels = run.episode_levels
        spread = levels.std(axis=0, ddof=1) if len(levels) > 1 else np.zeros(levels.shape[1])
        assured = levels.mean(axis=0) - QUANTILE_95 * spread / math.sqrt(len(levels))
        return Score(
            circularity=float(run.episode_circularity.mean()),
            service=float(levels.mean(axis=0).min(initial=1.0)),
            assured=float(assured.min(initial=1.0)),
            paid=float(run.returns.sum(axis=0).mean()),
        )


def score_of(plain: Any) -> Score | None:
    """Return a score that was written to a file; None if there is none."""
    return None if plain is None else Score(**plain)


MULTIPLIER_FROM = 0.5
"""Share of a run after which the price moves: a multiplier has to be slower than those who learn under it."""

LARGEST_MULTIPLIER = 1e3
"""Largest price."""


class ServiceMultiplier:
    """The price p of a shortfall in units of circularity, moved by what evaluations find.

    The reward is w·λ/c − (1 − w)·shortfall, so that p = (1 − w)/w. A level s* that is demanded is a constraint, and p
    its multiplier (Altman 1999, Constrained Markov Decision Processes), here with a controller that integrates and
    damps (Stooke et al. 2020, arXiv 2007.03964). After an evaluation that assures the level s of every service::

        e = clip((s* − s)/(1 − s*), −1, 1),    q ← q · exp(rate · e),    p = q · exp(damping · e)

    but neither falls below what p was at first, where learners that serve more than is demanded would give up at once
    what takes them long to learn. Where one more unit of service costs about the same over a wide range, learners
    drift through it at any other price, and only the damping, which is at once, stops them.
    """

    def __init__(self, env: MultiAgentVectorEnv, demanded: float, rate: float, damping: float) -> None:
        """Begin with the weight that ``env`` has."""
        self._env, self._demanded, self._rate, self._damping = env, demanded, rate, damping
        weight = max(env.circularity_weight, 1.0 / (1.0 + LARGEST_MULTIPLIER))
        self._least = self._lasting = (1.0 - weight) / weight

    def heed(self, assured: float) -> None:
        """Move the price after an evaluation."""
        lacks = np.clip((self._demanded - assured) / max(1.0 - self._demanded, 1.0 / LARGEST_MULTIPLIER), -1.0, 1.0)
        self._lasting = self._within(self._lasting * np.exp(self._rate * lacks))
        self._env.circularity_weight = 1.0 / (1.0 + self._within(self._lasting * np.exp(self._damping * lacks)))

    def _within(self, price: float) -> float:
        return float(np.clip(price, self._least, LARGEST_MULTIPLIER))

    def save(self, folder: Path) -> None:
        """Keep weight and lasting price in a checkpoint."""
        told = {"circularity_weight": self._env.circularity_weight, "lasting_price": self._lasting}
        write_json(folder / "price.json", told)

    def load(self, folder: Path) -> None:
        """Go on with weight and price of a checkpoint; a ``RunError`` if they are missing or none."""
        path = folder / "price.json"
        try:
            told = json.loads(path.read_text())
            self._env.circularity_weight, self._lasting = told["circularity_weight"], told["lasting_price"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunError(f"{path}: cannot be read: {error!r}; it holds the price of service") from error
