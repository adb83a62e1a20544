"""Copies of any PettingZoo environment as one joint environment, with a record of who is there."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium import spaces
from gymnasium.vector.utils import create_empty_array
from numpy.typing import NDArray
from pettingzoo import AECEnv, ParallelEnv
from pettingzoo.utils.conversions import aec_to_parallel, turn_based_aec_to_parallel

from cirl_marl.errors import CirlError, LearnerError, unknown_name, whole_number
from cirl_marl.learners.views import by_part
from cirl_marl.network import Floats

MakeEnv = Callable[[], Any]
"""Makes an environment: a PettingZoo ``ParallelEnv`` or ``AECEnv``."""
AgentObservations = NDArray[Any] | dict[str, NDArray[Any]]
"""Observations of an agent in all copies."""
MASK = "action_mask"
"""Key of an observation, or of the infos, under which PettingZoo's environments tell which actions are legal."""
MOST_COPIES = 10_000
"""Most copies of an environment, all of which live in one process."""


def parallel(env: Any) -> Any:
    """Return an environment in which all agents act at once, by PettingZoo's own conversion if it is none.

    Agents that take turns act at once then, too; the actions of those whose turn it is not are ignored.
    """
    if isinstance(env, AECEnv):
        return aec_to_parallel(env) if env.metadata.get("is_parallelizable") else turn_based_aec_to_parallel(env)
    if not isinstance(env, ParallelEnv):
        raise CirlError(f"make_env() must return a PettingZoo ParallelEnv or AECEnv, got {type(env).__name__}")
    return env


def copies_number(num_envs: int) -> int:
    """Return a number of copies; a ``CirlError`` says why it is none."""
    if whole_number("num_envs", num_envs, 1) > MOST_COPIES:
        reason = "each copy is an environment of its own"
        raise CirlError(f"num_envs must be at most {MOST_COPIES:,}, got {num_envs:,}: {reason}")
    return num_envs


class Copies:
    """Copies of a PettingZoo environment, stepped one after the other.

    A copy in which nobody is left begins its next episode at once. An agent whose episode ended while others go on is
    absent, as one is that has not come yet: it has the observation that it had last, and what it does is ignored.

    Attributes:
        num_envs: the copies, B.
        agents: all that may take part, by their names as text, in the order of ``possible_agents``.
        observation_spaces: of each agent.
        action_spaces: of each agent.
        present: the copies in which each agent acts next, shape (B,).
        masks: of each agent that has such, which actions are legal, shape (B, actions).
        new_episode: the copies whose episode has just begun, shape (B,).
    """

    def __init__(self, make_env: MakeEnv, num_envs: int) -> None:
        """Make the copies; they begin with ``reset``.

        Raises:
            CirlError: for something else than an environment, or one that does not say who may take part.
        """
        self.envs = [parallel(make_env()) for _ in range(num_envs)]
        self.num_envs = num_envs
        first = self.envs[0]
        possible = getattr(first, "possible_agents", None)
        if not possible:
            raise CirlError(f"environment '{first}': has no possible_agents, so nobody knows who will need a learner")
        self._native_names = {str(agent): agent for agent in possible}
        if len(self._native_names) != len(possible):
            raise CirlError(f"environment '{first}': agents share a name: {[str(agent) for agent in possible]}")
        self.agents = tuple(self._native_names)
        self._place = {name: place for place, name in enumerate(self.agents)}
        self.observation_spaces = {name: first.observation_space(native) for name, native in self._native_names.items()}
        self.action_spaces = {name: first.action_space(native) for name, native in self._native_names.items()}
        for name, space in self.observation_spaces.items():
            _check(name, space)
        self.present = {name: np.zeros(num_envs, dtype=bool) for name in self.agents}
        self.masks: dict[str, NDArray[np.int8]] = {}
        self.new_episode = np.ones(num_envs, dtype=bool)
        self._observations: dict[str, Any] = {
            name: create_empty_array(space, num_envs) for name, space in self.observation_spaces.items()
        }

    def reset(self, *, seed: Sequence[int] | None = None) -> dict[str, AgentObservations]:
        """Begin an episode in every copy, with one of the seeds each; return what everybody sees."""
        self._renew()
        for i in range(self.num_envs):
            self._begin(i, None if seed is None else int(seed[i]))
        return dict(self._observations)

    def step(self, actions: Mapping[str, NDArray[Any]]) -> tuple[Any, ...]:
        """Let those who are present act; return observations, rewards, terminations, truncations and infos.

        Raises:
            LearnerError: if an environment tells of others than it promised; names the copy and them.
        """
        shape = (len(self.agents), self.num_envs)
        rewards, dones, truncated = np.zeros(shape), np.zeros(shape, dtype=bool), np.zeros(shape, dtype=bool)
        copy_infos: dict[str, list[dict[str, Any]]] = {name: [{} for _ in self.envs] for name in self.agents}
        before = self.present
        self._renew()
        last = {name: by_part(np.copy, rows) for name, rows in self._observations.items()}
        for i, env in enumerate(self.envs):
            actors = [name for name in self.agents if before[name][i]]
            chosen = {self._native_names[n]: _action(self.action_spaces[n], actions[n][i]) for n in actors}
            observations, copy_rewards, terminations, truncations, infos = env.step(chosen)
            for name in actors:
                native, place = self._native_names[name], self._place[name]
                try:
                    over = bool(terminations[native]) or bool(truncations[native])
                    rewards[place, i], dones[place, i] = copy_rewards[native], over
                    truncated[place, i] = over and not terminations[native]
                    if over:
                        _put(last[name], i, observations[native], self.observation_spaces[name], self._label(i, name))
                except KeyError:
                    raise LearnerError(f"{self._label(i, name)}: acted, but step() tells nothing of it") from None
                copy_infos[name][i] = dict(infos.get(native) or {})
            self._arrive(i, observations, infos, {name for name in actors if dones[self._place[name], i]})
            if not env.agents:
                self._begin(i, None)
        joint_infos = {name: {"final_obs": last[name], "copies": copy_infos[name]} for name in self.agents}
        outcomes = (rewards, dones & ~truncated, truncated)
        by_agent = [dict(zip(self.agents, rows, strict=True)) for rows in outcomes]
        return dict(self._observations), *by_agent, joint_infos

    def state(self) -> Floats:
        """Refuse: PettingZoo's environments differ in whether they tell their state, and how."""
        raise CirlError("the state of these environments is not shown to critics; use another policy")

    def close(self) -> None:
        """Close all copies."""
        for env in self.envs:
            env.close()

    def _renew(self) -> None:
        """Begin new arrays of what changes in a step: learners may have kept those that there were."""
        self.present = {name: np.zeros(self.num_envs, dtype=bool) for name in self.agents}
        self.new_episode = np.zeros(self.num_envs, dtype=bool)
        self._observations = {name: by_part(np.copy, rows) for name, rows in self._observations.items()}

    def _begin(self, i: int, seed: int | None) -> None:
        observations, infos = self.envs[i].reset(seed=seed)
        self.new_episode[i] = True
        self._arrive(i, observations, infos, set())
        if not self.envs[i].agents:
            raise LearnerError(f"copy {i} of the environment: nobody is there after reset()")

    def _arrive(
        self, i: int, observations: Mapping[Any, Any], infos: Mapping[Any, Any], finished_agents: Iterable[str]
    ) -> None:
        """Note who is in a copy now, and what they see."""
        for native in self.envs[i].agents:
            name = str(native)
            if name not in self._native_names:
                raise LearnerError(
                    f"copy {i} of the environment: possible_agents: {unknown_name('agent', name, self.agents)}"
                )
            if name in finished_agents:
                raise LearnerError(f"{self._label(i, name)}: its episode has ended, and it is still in env.agents")
            if native not in observations:
                raise LearnerError(f"{self._label(i, name)}: is in env.agents, but there is no observation for it")
            observation = observations[native]
            _put(self._observations[name], i, observation, self.observation_spaces[name], self._label(i, name))
            self.present[name][i] = True
            has_mask = isinstance(observation, Mapping) and MASK in observation
            mask = observation[MASK] if has_mask else (infos.get(native) or {}).get(MASK)
            if mask is not None:
                flat = np.asarray(mask, dtype=np.int8).ravel()
                self.masks.setdefault(name, np.ones((self.num_envs, flat.size), dtype=np.int8))[i] = flat

    def _label(self, i: int, name: str) -> str:
        return f"copy {i} of the environment: agent '{name}'"


class AgentInCopy:
    """An agent in one copy: what ``env_method`` and ``get_attr`` of a learner's ``VecEnv`` reach.

    Attributes that it lacks are those of the copy itself.
    """

    def __init__(self, copies: Copies, index: int, agent: str) -> None:
        """View copy ``index``, whose ``env`` is a PettingZoo ``ParallelEnv``, as ``agent``."""
        self.index, self.agent, self.env, self._masks = index, agent, copies.envs[index], copies.masks
        self.render_mode: str | None = getattr(self.env, "render_mode", None)

    @property
    def action_masks(self) -> Callable[[], NDArray[np.int8]]:
        """Returns which actions are legal now, for ``MaskablePPO``; there is no such attribute if all always are."""
        if self.agent not in self._masks:
            raise AttributeError(f"agent '{self.agent}' has no {MASK} in its observations or infos")
        return lambda: self._masks[self.agent][self.index]

    def __getattr__(self, name: str) -> Any:
        """Fall back on the copy."""
        if name.startswith("_") or name == "action_masks":
            raise AttributeError(name)
        return getattr(self.env, name)


def _check(agent: str, space: spaces.Space[Any]) -> None:
    """Refuse what no learner can take: arrays, numbers, or a dict of such."""
    parts = space.spaces if isinstance(space, spaces.Dict) else {"": space}
    plain = (spaces.Box, spaces.Discrete, spaces.MultiDiscrete, spaces.MultiBinary)
    for key, part in parts.items():
        if not isinstance(part, plain):
            label = f" '{key}'" if key else ""
            raise CirlError(
                f"agent '{agent}': learners cannot take its observation{label}, which is {part}; wrap the environment "
                f"so that it gives a Box, Discrete, MultiDiscrete, MultiBinary, or a Dict of these"
            )


def _put(rows: AgentObservations, i: int, observation: Any, space: spaces.Space[Any], place: str) -> None:
    parts = [(None, rows)] if not isinstance(rows, dict) else list(rows.items())
    for key, part in parts:
        if key is not None and not (isinstance(observation, Mapping) and key in observation):
            raise LearnerError(f"{place}: its observation lacks '{key}', which its space {space} has")
        value = np.asarray(observation if key is None else observation[key])
        if value.shape != part.shape[1:]:
            label = "" if key is None else f" '{key}'"
            raise LearnerError(f"{place}: its observation{label} has the shape {value.shape}, not that of {space}")
        part[i] = value


def _action(space: spaces.Space[Any], row: Any) -> Any:
    """Return an action as the space has it; a whole number of a ``Discrete`` one."""
    if isinstance(space, spaces.Discrete):
        return int(row)
    return row
