"""What a shortfall of service costs while learners learn, so that they come to the level that is demanded."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import RunError
from cirl_marl.records.files import write_json

FIRST = 0.5
"""Share of a run after which the price moves: a multiplier has to be slower than those who learn under it."""

STEEPEST = 1e3
"""Largest price."""


class ServicePrice:
    """The price p of a shortfall in units of circularity, moved by what evaluations find.

    The reward is w·λ/c − (1 − w)·shortfall, so that p = (1 − w)/w. A level s* that is demanded is a constraint, and p
    its multiplier (Altman 1999, Constrained Markov Decision Processes; Stooke et al. 2020, arXiv 2007.03964). After an
    evaluation that assures the level s of every service::

        log p ← log p + rate · clip((s* − s)/(1 − s*), −1, 1)

    but p does not fall below what it was at first, where learners that serve more than is demanded would give up at
    once what takes them long to learn.
    """

    def __init__(self, env: VectorEnv, demanded: float, rate: float) -> None:
        """Begin with the weight that ``env`` has."""
        self._env, self._demanded, self._rate = env, demanded, rate
        weight = max(env.circularity_weight, 1.0 / (1.0 + STEEPEST))
        self._least = (1.0 - weight) / weight

    def heed(self, assured: float) -> None:
        """Move the price after an evaluation."""
        lacks = (self._demanded - assured) / max(1.0 - self._demanded, 1.0 / STEEPEST)
        weight = self._env.circularity_weight
        price = (1.0 - weight) / weight * np.exp(self._rate * np.clip(lacks, -1.0, 1.0))
        self._env.circularity_weight = 1.0 / (1.0 + float(np.clip(price, self._least, STEEPEST)))

    def save(self, folder: Path) -> None:
        """Keep the weight in a checkpoint."""
        write_json(folder / "price.json", {"circularity_weight": self._env.circularity_weight})

    def load(self, folder: Path) -> None:
        """Go on with the weight of a checkpoint; a ``RunError`` if it is missing or none."""
        path = folder / "price.json"
        try:
            self._env.circularity_weight = json.loads(path.read_text())["circularity_weight"]
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise RunError(f"{path}: cannot be read: {error!r}; it holds the price of service") from error
