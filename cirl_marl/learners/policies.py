"""Policies: with a central critic; trained ones as a controller, all acting together, or as a function of rows."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor
from stable_baselines3.common.vec_env import VecNormalize

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.learners.views import View, unseen_state


@dataclass(frozen=True, slots=True)
class Policy:
    """A model, its normaliser, None if observations are taken as they are, and its view of the environment."""

    model: BaseAlgorithm
    normaliser: VecNormalize | None
    view: View


class Policies(Controller):
    """Trained policies as a controller: all act deterministically, and the moments of normalisers stay as they are.

    Attributes:
        policies: by the names of their learners; together they act for every agent once.
        memory: what each remembers, as its algorithm has it; None of those that remember nothing, or have not acted.
    """

    def __init__(self, policies: Mapping[str, Policy]) -> None:
        """Act by ``policies``."""
        self.policies = policies
        self.memory: dict[str, Any] = {}

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Forget the last episode."""
        self.memory = dict.fromkeys(self.policies)
        self._starts = np.ones(env.num_envs, dtype=bool)
        self._state = unseen_state(env)

    def act(self, observations: Arrays) -> Arrays:
        """Return each policy's deterministic action, which depends on the observations of its agents alone."""
        actions: dict[str, NDArray[np.floating]] = {}
        for name, policy in self.policies.items():
            view = policy.view
            rows = view.observe(observations, self._state)
            if policy.normaliser is not None:
                rows = policy.normaliser.normalize_obs(rows)
            starts = np.tile(self._starts, max(1, len(view.row_agents)))
            action, self.memory[name] = policy.model.predict(rows, self.memory[name], starts, deterministic=True)
            actions.update(view.act(action))
        self._starts = np.zeros_like(self._starts)
        return actions


class _LocalActor(MlpExtractor):
    """Two networks on observation and state side by side: the actor's reads the first ``local`` entries only."""

    def __init__(self, local: int, features: int, **options: Any) -> None:
        super().__init__(features, **options)
        self.local = local
        self.policy_net = MlpExtractor(local, **options).policy_net

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward_actor(features[:, : self.local])


class CentralCriticPolicy(MultiInputActorCriticPolicy):
    """Actor-critic policy with a central critic: the actor sees its agent's observation, the critic the state as well.

    For any on-policy algorithm of Stable-Baselines3 whose policies are its ``ActorCriticPolicy`` (PPO, A2C, TRPO). With
    a policy that all agents share and PPO this is MAPPO (Yu et al. 2022, The Surprising Effectiveness of PPO in
    Cooperative Multi-Agent Games, arXiv 2103.01955). The environment is seen as a dict of ``observation`` and ``state``
    (``View.with_state``); no gradient of the actor reaches the critic or the reverse.
    """

    def _build_mlp_extractor(self) -> None:
        assert isinstance(self.observation_space, spaces.Dict)
        observation = self.observation_space["observation"]
        self.mlp_extractor = _LocalActor(
            spaces.flatdim(observation),  # "observation" comes before "state" in the features: keys are sorted
            self.features_dim,
            net_arch=self.net_arch,
            activation_fn=self.activation_fn,
            device=self.device,
        )


class DifferentiablePolicy(torch.nn.Module):
    """What a policy does deterministically, before it is clipped to [−1, 1], as a function of rows of its view.

    The normaliser is part of the function, so that rows are in the units of the environment. A policy that remembers
    takes what it remembers as two more arguments.
    """

    def __init__(self, policy: Policy) -> None:
        """Take a policy, which stays as it is."""
        super().__init__()
        self._policy, self._view = policy.model.policy, policy.view
        self._policy.set_training_mode(False)
        normaliser = policy.normaliser
        self._normaliser: tuple[torch.Tensor, torch.Tensor, float] | None = None
        if normaliser is not None and normaliser.norm_obs:
            statistics: Any = normaliser.obs_rms
            if isinstance(statistics, dict):
                statistics = statistics.get("observation")
            if statistics is not None:
                spread = (torch.as_tensor(statistics.var) + normaliser.epsilon).sqrt()
                self._normaliser = torch.as_tensor(statistics.mean), spread, normaliser.clip_obs

    @property
    def remembers(self) -> bool:
        """Whether it is recurrent."""
        return isinstance(self._policy, RecurrentActorCriticPolicy)

    def forward(self, rows: torch.Tensor, *memory: torch.Tensor) -> torch.Tensor:
        """Return actions, shape (rows, entries), for rows of shape (rows, columns).

        ``memory`` are what it remembers, hidden and cell states, shape (rows, layers, units) each.
        """
        if self._normaliser is not None:
            mean, spread, clip = self._normaliser
            rows = ((rows - mean) / spread).clamp(-clip, clip).to(rows.dtype)
        inputs: Any = rows
        if self._view.state_entries:
            # no action depends on the state (``CentralCriticPolicy``)
            inputs = {"observation": rows, "state": rows.new_zeros((len(rows), self._view.state_entries))}
        policy: Any = self._policy
        if not self.remembers:
            action: torch.Tensor = policy._predict(inputs, deterministic=True)
            return action
        states = tuple(state.transpose(0, 1).contiguous() for state in memory)
        return policy._predict(inputs, states, rows.new_zeros(len(rows)), deterministic=True)[0]  # type: ignore[no-any-return]
