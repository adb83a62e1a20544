"""A conformance suite for multi-agent environments, stricter than PettingZoo's own.

PettingZoo's tests let NaN and out-of-range observations pass, compare no reset with another, and look at
one step after seeding. ``check_parallel_env`` runs whole episodes of any PettingZoo ``ParallelEnv`` and
names agent, step and value of the first breach:

>>> import cirl_marl
>>> from cirl_marl.testing import check_parallel_env
>>> check_parallel_env(lambda: cirl_marl.parallel_env("copper_net"), steps=20)
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Mapping
from itertools import combinations
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv

from cirl_marl.testing.nested import ConformanceError, check_member, check_memory, require, same_or_raise

if TYPE_CHECKING:
    from cirl_marl.environments.vector import MultiAgentVectorEnv

__all__ = ["ConformanceError", "check_parallel_env", "check_vector_env"]

AnyEnv: TypeAlias = ParallelEnv[Any, Any, Any]
RETURNS = ("observations", "rewards", "terminations", "truncations", "infos")
MEMORY_STEPS = 4
"""How many steps back observations are watched for later change."""


def check_parallel_env(make: Callable[[], AnyEnv], *, steps: int = 200, seed: int = 0) -> None:
    """Check a PettingZoo parallel environment, of whatever spaces, over two episodes.

    Two environments are stepped side by side under the same actions, up to the end of the episode or
    ``steps``; then the first is reset in mid-episode and has to repeat the episode bit for bit. Checked
    at every step: observations lie in their spaces (NaN, bounds, dtype, shape), share no memory with
    each other and do not change afterwards; rewards are finite; terminations and truncations are
    booleans; keys equal the agents that acted; agents leave exactly when they are done and nobody joins;
    actions are left untouched; spaces are one lasting object per agent.

    Infinite observations pass only where the bound of a ``Box`` is infinite.

    Args:
        make: makes a fresh environment; called twice.
        steps: longest stretch to check.
        seed: seed of the environments; the actions are drawn from it too.

    Raises:
        ConformanceError: at the first breach.
    """
    first, second = make(), make()
    checked_env = _CheckedEnv(first)
    history = [checked_env.reset(seed)]
    _compare(history[0], _CheckedEnv(second).reset(seed), "two environments after reset with the same seed", 0)
    actions = _Actions(first, seed)
    action_history = []
    for step in range(1, steps + 1):
        if not first.agents:
            break
        action_history.append(actions.sample(history[-1]))
        history.append(checked_env.step(action_history[-1], step))
        twin = copy.deepcopy(second.step(copy.deepcopy(dict(action_history[-1]))))
        _compare(history[-1], twin, "two environments with the same seed and actions", step)
    _check_restart(checked_env, seed, history, action_history)
    first.close()
    second.close()


def check_vector_env(make: Callable[[], MultiAgentVectorEnv], *, steps: int = 200, seed: int = 0) -> None:
    """Check every copy of a ``MultiAgentVectorEnv``, and restarts; arguments are those of ``check_parallel_env``."""
    first, second = make(), make()
    generator = np.random.default_rng(seed)
    observations = first.reset(seed)
    _compare((observations,), (second.reset(seed),), "two environments after reset with the same seed", 0)
    _check_batch(first, observations, 0)
    for step in range(1, steps + 1):
        before = copy.deepcopy(observations)
        shapes = {agent: (first.num_envs, *space.shape) for agent, space in first.action_spaces.items()}
        sample = {agent: generator.uniform(-1, 1, shape) for agent, shape in shapes.items()}
        actions = copy.deepcopy(sample)
        result = first.step(actions)
        same_or_raise(sample, actions, f"step {step}: the actions were changed")
        same_or_raise(before, observations, f"step {step}: observations returned at step {step - 1} changed")
        _compare(result, second.step(sample), "two environments with the same seed and actions", step)
        observations, rewards, terminations, truncations, infos = result
        _check_batch(first, observations, step)
        check_memory(observations, f"step {step}")
        for agent in first.agents:
            label = f"agent {agent!r}, step {step}"
            require(rewards[agent].shape == (first.num_envs,), f"{label}: rewards of shape {rewards[agent].shape}")
            require(bool(np.isfinite(rewards[agent]).all()), f"{label}: reward {rewards[agent]} is not finite")
            for name, ends in (("terminations", terminations[agent]), ("truncations", truncations[agent])):
                require(ends.dtype == np.bool_, f"{label}: {name} have dtype {ends.dtype}, not bool")
            done = terminations[agent] | truncations[agent]
            if done.any():
                final = infos[agent].get("final_obs")
                require(final is not None, f"{label}: an episode ended without 'final_obs' in infos")
                _check_rows(first, agent, final, f"{label}, final_obs")


class _Actions:
    """Draws from copies of the action spaces, so that the environment's own are left alone."""

    def __init__(self, env: AnyEnv, seed: int) -> None:
        self._spaces = {agent: copy.deepcopy(env.action_space(agent)) for agent in env.possible_agents}
        for i, space in enumerate(self._spaces.values()):
            space.seed(seed + i)

    def sample(self, outcome: tuple[Any, ...]) -> dict[Any, Any]:
        """Draw one action for each agent that has an observation and is not done."""
        observations, infos = outcome[0], outcome[-1]
        flag_dicts = outcome[2:4] if len(outcome) == len(RETURNS) else ()
        actions = {}
        for agent, observation in observations.items():
            if any(flags[agent] for flags in flag_dicts):
                continue
            mask = (
                observation.get("action_mask") if isinstance(observation, Mapping) else infos[agent].get("action_mask")
            )
            actions[agent] = self._spaces[agent].sample(mask)
        return actions


class _CheckedEnv:
    def __init__(self, env: AnyEnv) -> None:
        self.env = env
        self._spaces: dict[Any, tuple[spaces.Space[Any], spaces.Space[Any]]] = {}
        self._recent: list[tuple[int, Any, Any]] = []

    def reset(self, seed: int | None = None) -> tuple[Any, Any]:
        env = self.env
        observations, infos = env.reset(seed=seed)
        require(set(env.agents) <= set(env.possible_agents), f"agents {env.agents} go beyond possible_agents")
        require(len(set(env.agents)) == len(env.agents) > 0, f"reset: agents {env.agents} are not distinct or none")
        self._check_keys({"observations": observations, "infos": infos}, list(env.agents), 0)
        self._check_spaces(0)
        self._check_observations(observations, 0)
        return copy.deepcopy((observations, infos))

    def step(self, actions: Mapping[Any, Any], step: int) -> tuple[Any, ...]:
        env = self.env
        before = list(env.agents)
        handed_over = copy.deepcopy(dict(actions))
        outcome = env.step(handed_over)
        same_or_raise(dict(actions), handed_over, f"step {step}: the actions were changed")
        require(len(outcome) == len(RETURNS), f"step {step}: returned {len(outcome)} things, not {RETURNS}")
        self._check_keys(dict(zip(RETURNS, outcome, strict=True)), before, step)
        observations, rewards, terminations, truncations, _ = outcome
        newcomers = [agent for agent in env.agents if agent not in before]
        require(not newcomers, f"step {step}: agents {newcomers} joined in mid-episode")
        for agent in before:
            label = f"agent {agent!r}, step {step}"
            _check_reward(rewards[agent], label)
            for name, flag in (("termination", terminations[agent]), ("truncation", truncations[agent])):
                require(isinstance(flag, bool | np.bool_), f"{label}: {name} {flag!r} is not a bool")
            done = bool(terminations[agent] or truncations[agent])
            require(done != (agent in env.agents), f"{label}: done is {done}, but env.agents is {env.agents}")
        self._check_spaces(step)
        self._check_observations(observations, step)
        return copy.deepcopy(outcome)

    def _check_keys(self, parts: Mapping[str, Any], agents: list[Any], step: int) -> None:
        for name, by_agent in parts.items():
            require(isinstance(by_agent, dict), f"step {step}: {name} are a {type(by_agent).__name__}, not a dict")
            matches = set(by_agent) == set(agents)
            require(matches, f"step {step}: {name} have keys {list(by_agent)}, agents are {agents}")

    def _check_spaces(self, step: int) -> None:
        env = self.env
        for agent in env.possible_agents:
            now = (env.observation_space(agent), env.action_space(agent))
            before = self._spaces.setdefault(agent, now)
            for name, old, new in zip(("observation_space", "action_space"), before, now, strict=True):
                require(old is new, f"agent {agent!r}, step {step}: {name} returned another object than before")
        if step == 0:
            for (agent_a, spaces_a), (agent_b, spaces_b) in combinations(self._spaces.items(), 2):
                for name, a, b in zip(("observation", "action"), spaces_a, spaces_b, strict=True):
                    require(a is not b, f"agents {agent_a!r} and {agent_b!r} share one {name} space object")

    def _check_observations(self, observations: Mapping[Any, Any], step: int) -> None:
        for agent, observation in observations.items():
            check_member(self._spaces[agent][0], observation, f"agent {agent!r}, step {step}: observation")
        check_memory(observations, f"step {step}")
        for earlier, original, snapshot in self._recent:
            same_or_raise(snapshot, original, f"step {step}: observations returned at step {earlier} changed")
        self._recent = [*self._recent[-MEMORY_STEPS:], (step, observations, copy.deepcopy(observations))]


def _check_restart(
    checked_env: _CheckedEnv, seed: int, history: list[tuple[Any, ...]], action_history: list[dict[Any, Any]]
) -> None:
    """Reset in mid-episode, then repeat what was recorded."""
    checked_env.reset(seed + 1)
    actions = _Actions(checked_env.env, seed + 1)
    outcome: tuple[Any, ...] = checked_env.reset(None)
    for step in (1, 2):
        if checked_env.env.agents:
            outcome = checked_env.step(actions.sample(outcome), step)
    _compare(history[0], checked_env.reset(seed), "one environment reset twice with the same seed", 0)
    for step, actions_then in enumerate(action_history, start=1):
        again = checked_env.step(actions_then, step)
        _compare(history[step], again, "one environment run twice with the same seed and actions", step)


def _check_batch(env: MultiAgentVectorEnv, observations: Mapping[str, Any], step: int) -> None:
    require(list(observations) == list(env.agents), f"step {step}: observations have keys {list(observations)}")
    for agent, observation in observations.items():
        _check_rows(env, agent, observation, f"agent {agent!r}, step {step}: observation")


def _check_rows(env: MultiAgentVectorEnv, agent: str, rows: Any, label: str) -> None:
    require(len(rows) == env.num_envs, f"{label}: {len(rows)} rows for {env.num_envs} copies")
    for i, row in enumerate(rows):
        check_member(env.observation_spaces[agent], row, f"{label} of copy {i}")


def _check_reward(reward: Any, label: str) -> None:
    number = isinstance(reward, int | float | np.number) or (isinstance(reward, np.ndarray) and reward.shape == ())
    require(number and not isinstance(reward, bool), f"{label}: reward {reward!r} is not a number")
    require(bool(np.isfinite(reward)), f"{label}: reward {reward!r} is not finite")


def _compare(first: tuple[Any, ...], second: tuple[Any, ...], subject: str, step: int) -> None:
    names = RETURNS if len(first) == len(RETURNS) else ("observations", "infos")
    for name, a, b in zip(names, first, second, strict=False):
        same_or_raise(a, b, f"step {step}: {subject} differ in {name}")
