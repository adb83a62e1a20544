"""Gymnasium's Reacher: an arm of two joints that moves its tip to a target."""

from __future__ import annotations

from typing import Annotated, ClassVar

import gymnasium
import numpy as np
from numpy.typing import NDArray

from cirl_marl.compartments.robots.engine import Engine, Robot, one_per_thread
from cirl_marl.network.compartment_model import Task
from cirl_marl.network.declarations import Quantity, frozen_record
from cirl_marl.network.rowsum import Floats

OBSERVATION_ROWS = tuple(
    "cos_0 cos_1 sin_0 sin_1 target_x_m target_y_m speed_0_rad_s speed_1_rad_s to_target_x_m to_target_y_m".split()
)


class ReacherEngine(Engine):
    """``Reacher-v5`` of Gymnasium."""

    def __init__(self) -> None:
        """Make the environment."""
        super().__init__(gymnasium.make("Reacher-v5").unwrapped, (*OBSERVATION_ROWS, "distance_m"))

    def _act(self, inputs: Floats) -> None:
        self.env.do_simulation(inputs, self.env.frame_skip)

    def _show(self) -> Floats:
        apart = self.env.get_body_com("fingertip") - self.env.get_body_com("target")
        return np.array([*self.env._get_obs(), np.linalg.norm(apart)])


@frozen_record
class Reacher(Robot, Task):
    """Gymnasium's Reacher-v5, unchanged, as in the paper.

    Inputs are the control signals of both joints in [−1, 1], which Gymnasium documents as torques in N·m; the model
    file gears them up by 200. Reward: −|tip − target| − |inputs|², after the step. The task is done while the tip is
    within 0.04 m of the target and both torques, taken as Gymnasium's, are below 0.005 N·m (arXiv 2505.21536), which
    here means their amounts [inferred: signed, any strong push backwards would do]; the speed does not count. Equal
    seeds and float64 actions give Gymnasium's episodes bit for bit; with float32 actions Gymnasium squares them in
    float32.

    The state holds Gymnasium's ten observations, the distance of tip and target, and the simulator's state.
    """

    kind: ClassVar[str] = "reacher"
    input_names: ClassVar[tuple[str, ...]] = ("torque_0_n_m", "torque_1_n_m")
    engine = staticmethod(one_per_thread(ReacherEngine))
    interval: ClassVar[float] = 0.02
    observed_states: ClassVar[tuple[str, ...]] = OBSERVATION_ROWS

    reach_m: Annotated[float, Quantity("distance that counts as a success [published]")] = 0.04
    torque_n_m: Annotated[float, Quantity("torque below which the arm counts as at rest [published]")] = 0.005

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return −|tip − target| − |inputs|², shape (B,)."""
        reward: Floats = -state[len(OBSERVATION_ROWS)] - np.square(inputs).sum(axis=0)
        return reward

    def success(self, state: Floats, inputs: Floats) -> NDArray[np.bool_]:
        """Return whether the tip is at the target and the joints are at rest, shape (B,)."""
        near: NDArray[np.bool_] = state[len(OBSERVATION_ROWS)] < self.reach_m
        return near & (np.abs(inputs) < self.torque_n_m).all(axis=0)
