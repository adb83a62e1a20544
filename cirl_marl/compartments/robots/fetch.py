"""The Fetch robot of gymnasium-robotics, sorting: it puts an object where the bin is."""

from __future__ import annotations

from contextlib import redirect_stderr
from dataclasses import dataclass
from io import StringIO
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from cirl_marl.compartments.robots.engine import Engine, Robot, one_per_thread
from cirl_marl.network.compartment_model import GoalTask
from cirl_marl.network.rowsum import Floats

with redirect_stderr(StringIO()):  # the package prints a notice about its robot hands, which are not used here
    from gymnasium_robotics.envs.fetch.pick_and_place import MujocoFetchPickAndPlaceEnv

BIN = (1.34, 0.95, 0.4)
"""Where the target lies, m: on the table (z = 0.4, published). Its x, y are chosen: beside the objects, which lie
within 0.15 m of (1.34, 0.75), as near as it can be without an object in it at the start, 5 cm from where they end."""


def _names(*groups: tuple[str, str]) -> tuple[str, ...]:
    return tuple(f"{quantity}_{axis}" for quantity, axes in groups for axis in axes)


OBSERVATION = _names(
    *((what, "xyz") for what in ("grip", "object", "object_from_grip")),
    ("finger", "rl"),
    *((what, "xyz") for what in ("object_angle", "object_slip", "object_spin", "grip_move")),
    ("finger_move", "rl"),
)
ACHIEVED_GOAL, DESIRED_GOAL = _names(("achieved", "xyz")), _names(("desired", "xyz"))


class WasteSorting(MujocoFetchPickAndPlaceEnv):  # type: ignore[misc]
    """Pick-and-place with a fixed target."""

    def _sample_goal(self) -> NDArray[np.float64]:
        return np.array(BIN)


class FetchEngine(Engine):
    """Fetch pick-and-place with the target on the table."""

    def __init__(self) -> None:
        """Make the environment."""
        super().__init__(WasteSorting(reward_type="sparse"), (*OBSERVATION, *ACHIEVED_GOAL, *DESIRED_GOAL))

    def _load_task(self, column: Floats) -> None:
        self.env.goal = column[len(OBSERVATION) + 3 : len(OBSERVATION) + 6].copy()

    def _act(self, inputs: Floats) -> None:
        action = np.clip(inputs, -1.0, 1.0)  # as the library's own step does
        self.env._set_action(action)
        self.env._mujoco_step(action)
        self.env._step_callback()

    def _show(self) -> Floats:
        observation: dict[str, Any] = self.env._get_obs()
        return np.concatenate([observation["observation"], observation["achieved_goal"], observation["desired_goal"]])


@dataclass(frozen=True, slots=True, kw_only=True)
class Fetch(Robot, GoalTask):
    """FetchWasteSorting: gymnasium-robotics' Fetch pick-and-place with the target fixed on the table.

    Inputs in [−1, 1]: displacement of the gripper in x, y, z, in 5 cm, and the fingers. Reward: 0 while the object is
    within 5 cm of the target, else −1. The published model differs from the library's in one number, the height of the
    target, 0.4 m (arXiv 2505.21536); its place on the table is not published.

    The state holds the library's 25 observations and both goals, the pose of the gripper and the simulator's state.
    """

    kind: ClassVar[str] = "fetch"
    input_names: ClassVar[tuple[str, ...]] = ("move_x", "move_y", "move_z", "fingers")
    engine = staticmethod(one_per_thread(FetchEngine))
    interval: ClassVar[float] = 0.04
    observed_states: ClassVar[tuple[str, ...]] = (*OBSERVATION, *ACHIEVED_GOAL, *DESIRED_GOAL)
    observation_names: ClassVar[tuple[str, ...]] = OBSERVATION
    achieved_names: ClassVar[tuple[str, ...]] = ACHIEVED_GOAL
    desired_names: ClassVar[tuple[str, ...]] = DESIRED_GOAL

    def goal_reward(self, achieved_goal: Floats, desired_goal: Floats) -> Floats:
        """Return the sparse reward for goals of shape (..., 3)."""
        reward: Floats = self.engine().env.compute_reward(achieved_goal, desired_goal, {})
        return reward

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return 0 where the object is at the target, else −1, shape (B,)."""
        achieved_goal, desired_goal = self._goals(state)
        return self.goal_reward(achieved_goal, desired_goal).astype(np.float64)

    def success(self, state: Floats, inputs: Floats) -> NDArray[np.bool_]:
        """Return whether the object is at the target, shape (B,)."""
        return self.reward(state, inputs) >= 0.0

    def _goals(self, state: Floats) -> tuple[Floats, Floats]:
        first = len(OBSERVATION)
        return state[first : first + 3].T, state[first + 3 : first + 6].T
