"""Our batched environment for TorchRL and BenchMARL, scaled as for every peer."""

from __future__ import annotations

from typing import Any

import torch

from benchmarks.peers.problem import Scaling
from benchmarks.peers.settings import ENVIRONMENT, NETWORK
from cirl_marl.adapters.torchrl import GROUP, TorchRLEnv


class ScaledEnv(TorchRLEnv):
    """Actions out of bounds are cut, as Stable-Baselines3 does, and nothing is expected after an episode."""

    def __init__(self, copies: int, seed: int, scaling: Scaling) -> None:
        """Begin ``copies`` episodes, that of copy i by ``seed + i``."""
        super().__init__(NETWORK, num_envs=copies, seed=seed, bootstrap=False, **ENVIRONMENT)
        self._scaling = scaling

    def _reset(self, tensordict: Any = None, **options: Any) -> Any:
        return self._scaled(super()._reset(tensordict, **options))

    def _step(self, tensordict: Any) -> Any:
        actions = tensordict[GROUP, "action"].clamp(-1.0, 1.0)
        outcome = self._scaled(super()._step(tensordict.copy().set((GROUP, "action"), actions)))
        rewards = self._scaling.reward(outcome[GROUP, "reward"].numpy())
        return outcome.set((GROUP, "reward"), torch.from_numpy(rewards))

    def _scaled(self, outcome: Any) -> Any:
        observation = self._scaling.seen(outcome[GROUP, "observation"].numpy())
        return outcome.set((GROUP, "observation"), torch.from_numpy(observation))

    def _set_seed(self, seed: int | None) -> None:
        """Leave the streams of the copies, which have their seeds."""
