"""One agent whose task is a goal, with the interface that hindsight experience replay needs."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium import spaces
from numpy.typing import ArrayLike, NDArray

from cirl_marl.environments.parallel import GymnasiumView
from cirl_marl.environments.single import SingleAgentEnv
from cirl_marl.environments.state import Snapshot
from cirl_marl.errors import CirlError
from cirl_marl.network import Network
from cirl_marl.network.compartment_model import GoalTask

Goals = dict[str, NDArray[np.float32]]
PARTS = ("observation", "achieved_goal", "desired_goal")


class GoalEnv(GymnasiumView):
    """A ``SingleAgentEnv`` whose observation is a dictionary, as in gymnasium-robotics.

    The entries ``observation``, ``achieved_goal`` and ``desired_goal`` are what the agent's model calls so; the reward
    is its local one, which consists of the model's alone: a function of the two goals, which ``compute_reward`` gives
    for any pair of them.

    Attributes:
        flat: the same environment with all entries in one array.
        agent: the compartment that acts.
    """

    def __init__(self, network: str | Path | Network, agent: str | None = None, **options: Any) -> None:
        """Make the environment; arguments are those of ``SingleAgentEnv``.

        Raises:
            CirlError: if the agent's model knows no goals, they are not all observed, the reward is not ``local``, or
                the local reward has a set-point or a service in it too.
        """
        self.flat = SingleAgentEnv(network, agent, **options)
        super().__init__(self.flat.parallel)
        self.agent = self.flat.agent
        model = self.flat.network.compartments[self.agent].model
        names = [name.split(".")[-1] for name in self.flat.parallel.layout.names[self.agent]]
        label = f"agent '{self.agent}' of '{self.network.name}'"
        if not isinstance(model, GoalTask):
            raise CirlError(f"{label} has no goals to observe")
        self._task, parts = model, (model.observation_names, model.achieved_names, model.desired_names)
        if not set().union(*parts) <= set(names):
            raise CirlError(f"{label} has no goals to observe")
        reward = options.get("reward") or self.network.objective.reward
        if reward != "local":  # hindsight would learn from two rewards that disagree
            raise CirlError(f"agent '{self.agent}': a function of the goals is the reward 'local', not '{reward}'")
        if terms := list(_terms_beside_goals(self.flat.network, self.agent)):
            beside = " and ".join(terms)
            raise CirlError(
                f"{label}: its local reward is no function of the goals alone, as it also contains {beside}"
            )
        rows = [np.array([names.index(name) for name in entries]) for entries in parts]
        self._parts = dict(zip(PARTS, rows, strict=True))
        box = self.flat.observation_space
        assert isinstance(box, spaces.Box)
        self.observation_space: spaces.Space[Any] = spaces.Dict(
            {part: spaces.Box(box.low[rows], box.high[rows], dtype=np.float32) for part, rows in self._parts.items()}
        )
        self.action_space = self.flat.action_space

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Goals, dict[str, Any]]:
        """Start an episode; see ``SingleAgentEnv.reset``."""
        super().reset(seed=seed)
        observation, info = self.flat.reset(seed=seed, options=options)
        return self._split(observation), info

    def step(self, action: ArrayLike) -> tuple[Goals, float, bool, bool, dict[str, Any]]:
        """Hold the action for one control interval."""
        observation, reward, terminated, truncated, info = self.flat.step(action)
        if "success" in info:
            info["is_success"] = info["success"]  # what gymnasium-robotics calls it, and Stable-Baselines3 looks for
        return self._split(observation), reward, terminated, truncated, info

    def compute_reward(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> Any:
        """Return the reward for goals of shape (..., 3); ``info`` has no influence."""
        reward = self._task.goal_reward(np.asarray(achieved_goal), np.asarray(desired_goal))
        return reward / self.flat.network.compartments[self.agent].reward_scale

    def compute_terminated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> bool:
        """Return False: the task goes on when the goal is reached."""
        return False

    def compute_truncated(self, achieved_goal: ArrayLike, desired_goal: ArrayLike, info: Any) -> bool:
        """Return False: goals do not end an episode, time does."""
        return False

    def snapshot(self) -> Snapshot:
        """Return a copy of the whole environment state, random streams included."""
        return self.flat.snapshot()

    def restore(self, snapshot: Snapshot) -> Goals:
        """Go back to a snapshot and return the observation there."""
        return self._split(self.flat.restore(snapshot))

    def _split(self, observation: NDArray[np.float32]) -> Goals:
        return {part: observation[rows] for part, rows in self._parts.items()}


def _terms_beside_goals(network: Network, agent: str) -> Iterator[str]:
    """Yield what the local reward of ``agent`` contains besides that of its model, and how to be rid of it."""
    if agent in network.objective.tracked:
        yield "the distance to its set-point (leave out its set_point and its place in objective.tracked)"
    elif not network.objective.tracked and network.compartments[agent].set_point is not None:
        yield "the distance to its set-point (leave out its set_point)"
    for service in network.services:
        if agent in service.debtors and service.weight > 0.0:
            yield f"the shortfall of service '{service.id}' (let another compartment owe it, or give it the weight 0)"
