"""Policies that act together by the means of their actions, as a controller."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.learners.views import View, unseen_state


@dataclass(frozen=True, slots=True)
class Policy:
    """A model, its normaliser, None if it sees things as they are, and its view of the environment."""

    model: BaseAlgorithm
    normaliser: VecNormalize | None
    view: View


class Policies(Controller):
    """Every policy acts deterministically; normalisers are not changed, and remember nothing of what they see."""

    def __init__(self, policies: Mapping[str, Policy]) -> None:
        """``policies`` are those of the learners, by name; together they act for every agent once."""
        self._policies = policies
        self._memory: dict[str, Any] = {}
        self._starts = np.ones(1, dtype=bool)

    @property
    def policies(self) -> Mapping[str, Policy]:
        """The policies, by the names of their learners."""
        return self._policies

    @property
    def memory(self) -> Mapping[str, Any]:
        """What each remembers, as its algorithm has it; None of those that remember nothing, or have not acted yet."""
        return self._memory

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Forget the last episode."""
        self._memory = dict.fromkeys(self._policies)
        self._starts = np.ones(env.num_envs, dtype=bool)
        self._state = unseen_state(env)

    def act(self, observations: Arrays) -> Arrays:
        """Return each policy's deterministic action, which depends on the observations of its agents alone."""
        actions: dict[str, NDArray[np.floating]] = {}
        for name, policy in self._policies.items():
            view = policy.view
            seen = view.observe(observations, self._state)
            if policy.normaliser is not None:
                seen = policy.normaliser.normalize_obs(seen)
            starts = np.tile(self._starts, max(1, len(view.row_agents)))
            chosen, self._memory[name] = policy.model.predict(seen, self._memory[name], starts, deterministic=True)
            actions.update(view.act(chosen))
        self._starts = np.zeros_like(self._starts)
        return actions
