"""Actor-critic with a central critic: the actor sees its agent's observation, the critic the whole state as well.

For any on-policy algorithm of Stable-Baselines3 whose policies are its ``ActorCriticPolicy`` (PPO, A2C, TRPO). With a
policy that all agents share and PPO this is MAPPO (Yu et al. 2022, The Surprising Effectiveness of PPO in Cooperative
Multi-Agent Games, arXiv 2103.01955). The environment is seen as a dict of ``observation`` and ``state``
(``View.with_state``); no gradient of the actor reaches the critic or the reverse, and no action depends on the state.
"""

from __future__ import annotations

from typing import Any

import torch
from gymnasium import spaces
from stable_baselines3.common.policies import MultiInputActorCriticPolicy
from stable_baselines3.common.torch_layers import MlpExtractor


class _LocalActor(MlpExtractor):
    """Two networks on observation and state side by side: the actor's reads the first ``local`` entries only."""

    def __init__(self, local: int, features: int, **options: Any) -> None:
        super().__init__(features, **options)
        self.local = local
        self.policy_net = MlpExtractor(local, **options).policy_net

    def forward_actor(self, features: torch.Tensor) -> torch.Tensor:
        return super().forward_actor(features[:, : self.local])


class CentralCriticPolicy(MultiInputActorCriticPolicy):
    """Stable-Baselines3's actor-critic policy with an actor that does not see the state."""

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
