"""What a shortfall of service costs while learners learn, so that they come to the level that is demanded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.records.files import write_json

FIRST = 0.5
"""Share of a run after which the price moves: a multiplier has to be slower than those who learn under it."""

STEEPEST = 1e3
"""Largest price."""


class ServicePrice:
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
        weight = max(env.circularity_weight, 1.0 / (1.0 + STEEPEST))
        self._least = self._lasting = (1.0 - weight) / weight

    def heed(self, assured: float) -> None:
        """Move the price after an evaluation."""
        lacks = np.clip((self._demanded - assured) / max(1.0 - self._demanded, 1.0 / STEEPEST), -1.0, 1.0)
        self._lasting = self._within(self._lasting * np.exp(self._rate * lacks))
        self._env.circularity_weight = 1.0 / (1.0 + self._within(self._lasting * np.exp(self._damping * lacks)))

    def _within(self, price: float) -> float:
        return float(np.clip(price, self._least, STEEPEST))

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
