"""How one learner sees the joint environment: as one agent, as many agents that share a policy, or as all at once.

A view maps what the environment gives to agents (agent → array with leading axis B) to the rows of one
Stable-Baselines3 ``VecEnv``, and the learner's actions back. Views hold no state, so that the same view serves training
and evaluation, with any number of copies.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Protocol

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from cirl_marl.controllers.basic import Arrays
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Floats

ObservedRows = NDArray[np.floating] | dict[str, NDArray[np.floating]]
Scheme = Literal["independent", "shared", "joint"]
CENTRAL_CRITIC = "CentralCriticPolicy"
"""Name of the policy whose critic sees the whole state."""


def by_part(function: Callable[[Any], Any], observation: Any) -> Any:
    """Apply a function to an observation, or to every part of one that is a dict."""
    if isinstance(observation, dict):
        return {key: function(part) for key, part in observation.items()}
    return function(observation)


def rows_of(observation: Any, rows: Any) -> Any:
    """Return some rows of an observation."""
    return by_part(lambda part: part[rows], observation)


class BatchedEnv(Protocol):
    """Several copies of an environment of many agents, all stepped at once; ``MultiAgentVectorEnv`` is one.

    What it takes and gives is by agent, with a leading axis of ``num_envs`` entries. An episode that has ended is
    followed by the next at once; what was seen last is ``final_obs`` in the infos.
    """

    num_envs: int
    agents: tuple[str, ...]
    action_spaces: Any

    @property
    def observation_spaces(self) -> Any:
        """Observation space of each agent."""

    def reset(self, *, seed: Any = None) -> Any:
        """Begin episodes in all copies and return the first observations."""

    def step(self, actions: Any) -> Any:
        """Move all copies; return observations, rewards, terminations, truncations and infos."""

    def state(self) -> Floats:
        """Return the whole state, for critics that see it."""


class View(ABC):
    """What one learner sees and does.

    Attributes:
        agents: who acts by its actions.
        row_agents: the agent of each row that a copy of the environment fills; empty if its row is that of all agents.
        observation_space: of one row.
        action_space: of one row.
        state_entries: of the whole state beside a row; 0 if it is not shown.
    """

    agents: tuple[str, ...]
    row_agents: tuple[str, ...]
    observation_space: spaces.Space[Any]
    action_space: spaces.Space[Any]
    state_entries = 0

    def with_state(self, env: MultiAgentVectorEnv) -> View:
        """Show the whole state beside the rows from now on: ``{"observation": …, "state": …}``; return the view.

        The state is that of ``MultiAgentVectorEnv.state()``, in physical units and double precision.
        """
        self.state_entries = len(env.state_names) + 1
        state = spaces.Box(-np.inf, np.inf, (self.state_entries,), dtype=np.float64)
        self.observation_space = spaces.Dict({"observation": self.observation_space, "state": state})
        return self

    def observe(self, observations: Arrays, state: Callable[[], Floats]) -> ObservedRows:
        """Return the rows of all copies, agent by agent; ``state`` is called by those who see the whole state."""
        rows = self.rows(observations)
        if not self.state_entries:
            return rows
        return {"observation": rows, "state": np.tile(state(), (max(1, len(self.row_agents)), 1))}

    @abstractmethod
    def rows(self, observations: Arrays) -> NDArray[np.floating]:
        """Return what the agents see, without the state."""

    @abstractmethod
    def act(self, actions: NDArray[np.floating]) -> Arrays:
        """Split the actions of all rows into agent → (B, entries)."""

    @abstractmethod
    def join(self, actions: Arrays) -> NDArray[np.float32]:
        """Join the actions of agents to rows of their own: the inverse of ``act``; what ``act`` ignores is zero."""

    @abstractmethod
    def score(self, rewards: Arrays) -> Floats:
        """Return the reward of each row."""


class OneAgent(View):
    """The view of a single agent: its own observation, action and reward, as they are."""

    def __init__(self, env: BatchedEnv, agent: str) -> None:
        """View ``env`` as ``agent``."""
        self.agents, self.row_agents = (agent,), (agent,)
        self.observation_space = env.observation_spaces[agent]
        self.action_space = env.action_spaces[agent]

    def rows(self, observations: Arrays) -> NDArray[np.floating]:
        """Return the agent's observation, shape (B, k), or as its space has it."""
        observation = observations[self.agents[0]]
        return observation if isinstance(observation, Mapping) else np.ascontiguousarray(observation)

    def act(self, actions: NDArray[np.floating]) -> Arrays:
        """Return the actions, shape (B, m), as the agent's."""
        return {self.agents[0]: actions}

    def join(self, actions: Arrays) -> NDArray[np.float32]:
        """Return the agent's actions, shape (B, m)."""
        return np.array(actions[self.agents[0]], dtype=np.float32)

    def score(self, rewards: Arrays) -> Floats:
        """Return the agent's reward, shape (B,)."""
        return np.asarray(rewards[self.agents[0]], dtype=np.float64)


class SharedPolicy(View):
    """N agents as rows of one learner: observations padded with zeros, then a one-hot indicator of the agent.

    Row a·B + b is agent a in copy b. Values are those of SuperSuit's ``pad_observations_v0``, ``pad_action_space_v0``
    and ``agent_indicator_v0``, but for the indicator, which is 1 where SuperSuit writes the largest bound of the space.
    """

    def __init__(self, env: MultiAgentVectorEnv, agents: Sequence[str]) -> None:
        """View ``env`` as each of ``agents`` in turn."""
        self.agents = self.row_agents = tuple(agents)
        boxes = [env.observation_spaces[agent] for agent in self.agents]
        self._actions = {agent: env.action_spaces[agent].shape[0] for agent in self.agents}
        self._length = max(box.shape[0] for box in boxes)
        low, high = np.zeros((2, self._length + len(self.agents)), dtype=np.float32)
        for box in boxes:
            low[: len(box.low)] = np.minimum(low[: len(box.low)], box.low)
            high[: len(box.high)] = np.maximum(high[: len(box.high)], box.high)
        high[self._length :] = 1.0
        self.observation_space = spaces.Box(low, high, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (max(self._actions.values()),), dtype=np.float32)

    def rows(self, observations: Arrays) -> NDArray[np.floating]:
        """Return the padded and marked observations, shape (N·B, longest + N)."""
        rows = self._pad(observations, self._length + len(self.agents))
        for a in range(len(self.agents)):
            rows[a, :, self._length + a] = 1.0
        return rows.reshape(-1, rows.shape[2])

    def act(self, actions: NDArray[np.floating]) -> Arrays:
        """Return each agent's part of the rows, without the padding."""
        by_agent = actions.reshape(len(self.agents), -1, max(self._actions.values()))
        return {agent: by_agent[a, :, :n] for a, (agent, n) in enumerate(self._actions.items())}

    def join(self, actions: Arrays) -> NDArray[np.float32]:
        """Return the padded actions, shape (N·B, longest)."""
        longest = max(self._actions.values())
        return self._pad(actions, longest).reshape(-1, longest)

    def _pad(self, arrays: Arrays, length: int) -> NDArray[np.float32]:
        """Return the agents' arrays with zeros after them, shape (N, B, length)."""
        rows = np.zeros((len(self.agents), len(arrays[self.agents[0]]), length), dtype=np.float32)
        for row, agent in zip(rows, self.agents, strict=True):
            row[:, : arrays[agent].shape[1]] = arrays[agent]
        return rows

    def score(self, rewards: Arrays) -> Floats:
        """Return each agent's reward, shape (N·B,)."""
        return np.concatenate([rewards[agent] for agent in self.agents])


class AllAtOnce(View):
    """N agents as one: observations and actions one after the other, the reward their mean."""

    def __init__(self, env: MultiAgentVectorEnv, agents: Sequence[str]) -> None:
        """View ``env`` as all of ``agents``."""
        self.agents, self.row_agents = tuple(agents), ()
        boxes = [env.observation_spaces[agent] for agent in self.agents]
        lengths = [env.action_spaces[agent].shape[0] for agent in self.agents]
        self._ends = np.cumsum(lengths)
        low, high = (np.concatenate([getattr(box, end) for box in boxes]) for end in ("low", "high"))
        self.observation_space = spaces.Box(low, high, dtype=np.float32)
        self.action_space = spaces.Box(-1.0, 1.0, (int(self._ends[-1]),), dtype=np.float32)

    def rows(self, observations: Arrays) -> NDArray[np.floating]:
        """Return the observations side by side, shape (B, Σ k)."""
        return np.concatenate([observations[agent] for agent in self.agents], axis=1)

    def act(self, actions: NDArray[np.floating]) -> Arrays:
        """Return each agent's columns."""
        return dict(zip(self.agents, np.split(actions, self._ends[:-1], axis=1), strict=True))

    def join(self, actions: Arrays) -> NDArray[np.float32]:
        """Return the actions side by side, shape (B, Σ m)."""
        return np.concatenate([actions[agent] for agent in self.agents], axis=1, dtype=np.float32, casting="same_kind")

    def score(self, rewards: Arrays) -> Floats:
        """Return the mean of the agents' rewards, shape (B,): λ itself if every agent is paid λ."""
        mean: Floats = np.mean([rewards[agent] for agent in self.agents], axis=0)
        return mean


def unseen_state(env: MultiAgentVectorEnv) -> Callable[[], Floats]:
    """Return zeros in the place of the state, for acting: an actor does not look at it."""
    return lambda: np.zeros((env.num_envs, len(env.state_names) + 1))
