"""One policy for all agents of a network with a plain Stable-Baselines3 model, through SuperSuit's wrappers.

SuperSuit pads observations and actions to one length, says in each observation whose it is, and lays the agents side by
side as if they were copies of one environment. Three defects of its vector environment are mended here: copies begin
alike, a model cannot seed it, and truncations look like terminations.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.adapters import needs
from cirl_marl.environments.parallel import parallel_env
from cirl_marl.network import Network

with needs("supersuit", "supersuit"), warnings.catch_warnings():
    warnings.simplefilter("ignore")  # of its own imports
    import supersuit
    from stable_baselines3.common.vec_env import VecEnv


class SharedPolicyEnv(VecEnv):
    """The agents of all copies as sub-environments of a ``VecEnv``: those of the first copy, of the second, and so on.

    Attributes:
        agents: who acts in each copy, in order.
    """

    def __init__(self, network: str | Path | Network, *, copies: int = 8, seed: int = 0, **options: Any) -> None:
        """Make the copies.

        Args:
            network: catalogue name, path of a definition file, or a network.
            copies: of the network; there are as many sub-environments as all of them have agents.
            seed: copy i begins with ``seed + i``; a model that is made with a seed sets it again.
            **options: those of ``parallel_env``.

        Raises:
            CirlError: for an unknown network or option.
        """
        env = parallel_env(network, **options)
        self.agents = list(env.possible_agents)
        env = supersuit.agent_indicator_v0(supersuit.pad_action_space_v0(supersuit.pad_observations_v0(env)))
        bridge = supersuit.pettingzoo_env_to_vec_env_v1(env)
        self._bridge = supersuit.concat_vec_envs_v1(bridge, copies, num_cpus=1, base_class="gymnasium")
        super().__init__(self._bridge.num_envs, self._bridge.observation_space, self._bridge.action_space)
        self._next_seed: int | None = seed

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Have the next reset begin copy i with ``seed + i``."""
        self._next_seed = seed
        return [None if seed is None else seed + i // len(self.agents) for i in range(self.num_envs)]

    def reset(self) -> NDArray[np.float32]:
        """Start an episode in every copy."""
        observations, self.reset_infos = self._bridge.reset(seed=self._next_seed)
        self._next_seed = None  # the streams go on
        return np.asarray(observations)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions of all agents, in [−1, 1]."""
        self._actions = actions

    def step_wait(self) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.bool_], list[dict[str, Any]]]:
        """Step; what is truncated is not terminated, so that a value is expected after it."""
        observations, rewards, terminated, truncated, infos = self._bridge.step(self._actions)
        ends = np.asarray(terminated, dtype=bool) | np.asarray(truncated, dtype=bool)
        for info, done, termination in zip(infos, ends, terminated, strict=True):
            info["TimeLimit.truncated"] = bool(done and not termination)
        return observations, rewards, ends, infos

    def close(self) -> None:
        """Close the copies."""
        self._bridge.close()

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the bridge, the same for every agent."""
        return [getattr(self._bridge, attr_name)] * len(list(self._get_indices(indices)))

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Refuse: agents share a copy."""
        raise AttributeError(f"{attr_name}: agents share a copy, none has attributes of its own")

    def env_method(
        self, method_name: str, *arguments: Any, indices: int | Iterable[int] | None = None, **keywords: Any
    ) -> list[Any]:
        """Refuse: agents share a copy."""
        raise AttributeError(f"{method_name}: agents share a copy, none has methods of its own")

    def env_is_wrapped(self, wrapper_class: type[Any], indices: int | Iterable[int] | None = None) -> list[bool]:
        """No agent is wrapped by a wrapper of Gymnasium."""
        return [False] * len(list(self._get_indices(indices)))
