"""The problem as other libraries take it: observations of one length, everything scaled, an episode that is all."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from benchmarks.peers.settings import ENVIRONMENT, NETWORK, SETTINGS
from cirl_marl import MultiAgentVectorEnv, parallel_env
from cirl_marl.controllers.basic import Arrays, Controller

Array = NDArray[np.float32]
Act = Callable[[Array], NDArray[np.floating]]
"""Scaled observations of all agents, (copies, agents, entries), to actions, (copies, agents, 1)."""
LIMIT = 10.0
"""Standard deviations at which observations and rewards are cut, as our normaliser does."""
SAMPLE, SAMPLED = 256, 2**20
"""Episodes from which the scales come, and the seed of the first: nobody trains or is judged on them."""


def environment(copies: int) -> MultiAgentVectorEnv:
    """Return our batched environment with the reward of the recipe."""
    return MultiAgentVectorEnv(NETWORK, num_envs=copies, **ENVIRONMENT)


@dataclass(frozen=True, slots=True)
class Scaling:
    """Means and deviations of padded observations, (agents, entries), and the deviation of what has been paid."""

    mean: Array
    deviation: Array
    paid: float

    @classmethod
    def measured(cls, env: MultiAgentVectorEnv, noise: float = float(np.exp(SETTINGS.log_std))) -> Scaling:
        """Return the scales of episodes in which every agent acts by ``noise`` alone, as an untrained policy does.

        Our own learners normalise as they go, peers by these: fixed scales cost them nothing, and are the same in all
        their processes. Rewards are divided by the deviation of the sums paid so far, as our normaliser does.
        """
        random = np.random.default_rng(SAMPLED)
        seen, total = [padded(env, env.reset(seed=SAMPLED))], np.zeros((len(env.agents), env.num_envs))
        sums = []
        for _ in range(env.network.episode.horizon):
            actions = np.clip(random.normal(0.0, noise, (env.num_envs, len(env.agents), 1)), -1.0, 1.0)
            observations, rewards, *_ = env.step(by_agent(env, actions))
            seen.append(padded(env, observations))
            total = total + np.array([rewards[agent] for agent in env.agents])
            sums.append(total)
        every = np.concatenate(seen)
        deviation = every.std(axis=0)
        varies = np.where(deviation > 1e-6, deviation, 1.0).astype(np.float32)
        return cls(every.mean(axis=0), varies, float(np.std(sums)))

    def seen(self, observations: Array) -> Array:
        """Scale padded observations."""
        scaled: Array = np.clip((observations - self.mean) / self.deviation, -LIMIT, LIMIT)
        return scaled

    def reward(self, paid: NDArray[np.floating]) -> Array:
        """Scale rewards."""
        return np.clip(np.asarray(paid) / self.paid, -LIMIT, LIMIT).astype(np.float32)


def padded(env: MultiAgentVectorEnv, observations: Mapping[str, NDArray[np.floating]]) -> Array:
    """Return the observations of all agents, (copies, agents, longest), with zeros where an agent sees less."""
    longest = max(space.shape[0] for space in env.observation_spaces.values())
    found = np.zeros((env.num_envs, len(env.agents), longest), dtype=np.float32)
    for place, agent in enumerate(env.agents):
        seen = observations[agent]
        found[:, place, : seen.shape[1]] = seen
    return found


def by_agent(env: MultiAgentVectorEnv, actions: NDArray[np.floating]) -> dict[str, NDArray[np.floating]]:
    """Split actions, (copies, agents, 1), by agent; what is out of bounds is cut, as Stable-Baselines3 does."""
    return {agent: np.clip(actions[:, place], -1.0, 1.0) for place, agent in enumerate(env.agents)}


class Acting(Controller):
    """A policy of a peer as one of our controllers."""

    def __init__(self, act: Act, scaling: Scaling) -> None:
        """``act`` must be deterministic."""
        self._act, self._scaling = act, scaling

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Act in ``env`` from now on."""
        self._env = env

    def act(self, observations: Arrays) -> dict[str, Any]:
        """Return the policy's actions, cut at their bounds."""
        seen = self._scaling.seen(padded(self._env, observations))
        return by_agent(self._env, np.asarray(self._act(seen), dtype=float))


def measured_scaling() -> Scaling:
    """Return the scales that every peer has."""
    return Scaling.measured(environment(SAMPLE))


class Lone(ParallelEnv[str, Array, Array]):  # type: ignore[misc]
    """Our PettingZoo environment with padded and scaled observations, for libraries that step copies one by one."""

    metadata: dict[str, Any] = {"name": "lone"}  # noqa: RUF012 (PettingZoo declares it so)

    def __init__(self, scaling: Scaling) -> None:
        """Make one copy."""
        self._env, self._scaling = parallel_env(NETWORK, **ENVIRONMENT), scaling
        self.possible_agents = list(self._env.possible_agents)
        self.agents: list[str] = []
        shape = scaling.mean.shape[1:]
        self.observation_spaces = {a: Box(-LIMIT, LIMIT, shape, np.float32) for a in self.possible_agents}
        self.action_spaces = {a: self._env.action_space(a) for a in self.possible_agents}

    def observation_space(self, agent: str) -> Box[np.float32]:
        """Return the space of what ``agent`` sees, scaled."""
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box[np.float32]:
        """Return the space of what ``agent`` does."""
        return self.action_spaces[agent]

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin an episode."""
        observations, _ = self._env.reset(seed=seed)
        self.agents = list(self.possible_agents)
        return self._seen(observations), {agent: {} for agent in self.agents}

    def step(self, actions: Mapping[str, NDArray[np.floating]]) -> tuple[Any, Any, Any, Any, Any]:
        """Act; at its end an episode is terminated, as nothing is expected after it."""
        agents = self.possible_agents
        cut = {agent: np.clip(actions[agent], -1.0, 1.0) for agent in agents}
        observations, rewards, _, truncated, _ = self._env.step(cut)
        paid = self._scaling.reward(np.array([rewards[agent] for agent in agents]))
        self.agents = list(self._env.agents)
        return (
            self._seen(observations),
            dict(zip(agents, paid.tolist(), strict=True)),
            dict(truncated),
            dict.fromkeys(agents, False),
            {agent: {} for agent in agents},
        )

    def _seen(self, observations: Mapping[str, Array]) -> dict[str, Array]:
        batch = self._env.batch
        seen = self._scaling.seen(padded(batch, {agent: each[None] for agent, each in observations.items()}))
        return dict(zip(self.possible_agents, seen[0], strict=True))
