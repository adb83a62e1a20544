"""PettingZoo environments for tests: agents that do not meet, that leave and come back, and that have odd spaces."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from pettingzoo import ParallelEnv


class Strangers(ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """Gymnasium environments side by side, one for each agent; the episode is over when the last one's is."""

    metadata: dict[str, Any] = {"name": "strangers"}  # noqa: RUF012 (as PettingZoo has it)
    render_mode = None

    def __init__(self, makers: Mapping[str, Callable[[], gymnasium.Env[Any, Any]]]) -> None:
        """Make the environments."""
        self.alone = {agent: make() for agent, make in makers.items()}
        self.possible_agents = list(makers)
        self.agents: list[str] = []

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return that of the agent's own environment."""
        return self.alone[agent].observation_space

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return that of the agent's own environment."""
        return self.alone[agent].action_space

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin everybody's episode, all with the same seed."""
        self.agents = list(self.possible_agents)
        found = {agent: env.reset(seed=seed) for agent, env in self.alone.items()}
        return {agent: seen for agent, (seen, _) in found.items()}, {agent: {} for agent in found}

    def step(self, actions: dict[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Step those who are left."""
        assert set(actions) == set(self.agents)
        found = {agent: self.alone[agent].step(action) for agent, action in actions.items()}
        self.agents = [agent for agent, (_, _, over, cut, _) in found.items() if not (over or cut)]
        return tuple({agent: told[place] for agent, told in found.items()} for place in range(5))  # type: ignore[return-value]


class Shifts(ParallelEnv[str, Any, Any]):  # type: ignore[misc]
    """Agents that are there at some steps of an episode only; each sees how often it acted in how many episodes.

    Attributes:
        shifts: the steps at which each agent acts.
        log: what every agent did and was paid, as tuples (agent, episode, step, action, reward).
    """

    metadata: dict[str, Any] = {"name": "shifts"}  # noqa: RUF012
    render_mode = None

    def __init__(
        self,
        shifts: Mapping[str, Sequence[int]],
        horizon: int,
        *,
        seen: spaces.Space[Any] | None = None,
        does: spaces.Space[Any] | None = None,
        log: list[tuple[Any, ...]] | None = None,
    ) -> None:
        """Last ``horizon`` steps; ``seen`` and ``does`` are spaces to draw observations and actions from."""
        self.shifts, self.horizon = shifts, horizon
        self.possible_agents = list(shifts)
        self.agents: list[str] = []
        self.log = [] if log is None else log
        self._seen, self._does = seen, does or spaces.Discrete(3)
        self._episode = 0

    def observation_space(self, agent: str) -> spaces.Space[Any]:
        """Return what is drawn, or a box for serial number, episode, step and whether it is the last."""
        return self._seen or spaces.Box(-np.inf, np.inf, (4,))

    def action_space(self, agent: str) -> spaces.Space[Any]:
        """Return the same for everybody."""
        return self._does

    def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
        """Begin with those whose shift it is."""
        if seed is not None:
            self._serial = seed % 1000
            if self._seen is not None:
                self._seen.seed(seed)
        self._episode, self._step = self._episode + 1, 0
        self._come()
        return {agent: self._observe(0) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: dict[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Pay everybody who is there the number of the step; their episode ends where their shift does."""
        assert set(actions) == set(self.agents)
        acting, now = self.agents, self._step
        rewards = {agent: float(now) for agent in acting}
        self.log += [(agent, self._serial, self._episode, now, actions[agent]) for agent in acting]
        self._step += 1
        self._come()
        over = {agent: agent not in self.agents for agent in acting}
        cut = {agent: over[agent] and self._step >= self.horizon for agent in acting}
        gone = {agent: over[agent] and not cut[agent] for agent in acting}
        seen = {agent: self._observe(int(over.get(agent, False))) for agent in {**over, **dict.fromkeys(self.agents)}}
        return seen, rewards, gone, cut, {agent: {"step": now} for agent in acting}

    def _come(self) -> None:
        left = range(self._step, self.horizon)
        self.agents = [agent for agent, steps in self.shifts.items() if self._step in steps and self._step in left]
        if not self.agents and any(step in left for steps in self.shifts.values() for step in steps):
            self._step += 1
            self._come()

    def _observe(self, last: int) -> Any:
        if self._seen is not None:
            return self._seen.sample()
        return np.array([self._serial, self._episode, self._step, last], dtype=np.float32)
