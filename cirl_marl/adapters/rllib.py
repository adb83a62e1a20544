"""A network as a multi-agent environment of RLlib, which steps one environment at a time."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from gymnasium.spaces import Dict
from numpy.typing import ArrayLike
from pettingzoo import ParallelEnv

from cirl_marl.adapters import needs
from cirl_marl.environments.parallel import parallel_env

with needs("ray", "'cirl-marl[rllib]'"):
    from ray.rllib.env.multi_agent_env import MultiAgentEnv


class RLlibEnv(MultiAgentEnv):  # type: ignore[misc]
    """One copy of a network.

    Attributes:
        parallel_env: the environment for PettingZoo that is stepped.
        possible_agents: who acts, in the order of the network.
    """

    def __init__(self, config: Mapping[str, Any]) -> None:
        """Make the copy.

        Args:
            config: ``network``, a catalogue name, path or network, and options of ``parallel_env``.

        Raises:
            CirlError: for an unknown network or option.
        """
        super().__init__()
        self.parallel_env = self._make_env(**config)
        self.possible_agents = list(self.parallel_env.possible_agents)
        self.agents = list(self.possible_agents)
        self.observation_spaces = {agent: self.parallel_env.observation_space(agent) for agent in self.agents}
        self.action_spaces = {agent: self.parallel_env.action_space(agent) for agent in self.agents}
        self.observation_space, self.action_space = Dict(self.observation_spaces), Dict(self.action_spaces)

    @staticmethod
    def _make_env(**config: Any) -> ParallelEnv[str, Any, Any]:
        return parallel_env(**config)

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Start an episode."""
        observations, infos = self.parallel_env.reset(seed=seed, options=options)
        self.agents = list(self.parallel_env.agents)
        return observations, infos

    def step(self, action_dict: Mapping[str, ArrayLike]) -> tuple[Any, Any, Any, Any, Any]:
        """Hold one action per agent, each in its Box(−1, 1), for one control interval."""
        observations, rewards, terminated, truncated, infos = self.parallel_env.step(dict(action_dict))
        self.agents = list(self.parallel_env.agents)
        ends = ({**flags, "__all__": all(flags.values())} for flags in (terminated, truncated))
        return observations, rewards, *ends, infos

    def close(self) -> None:
        """Close the environment."""
        self.parallel_env.close()
