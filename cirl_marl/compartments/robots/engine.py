"""A MuJoCo environment of a library, used as a pure function of its state.

One environment object is loaded with a column of numbers, stepped by the library's own methods and read out again, copy
after copy. The column is the simulator's whole state (``mjSTATE_INTEGRATION``: positions, velocities, controls, warm
start, mocap, time) with what the library reads before the next step computes it anew: after ``mj_step`` the positions
of bodies lag behind the joints by one substep, so observations and the pose of a body welded to a mocap are kept, too.
"""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from typing import Any, ClassVar, TypeVar

import mujoco
import numpy as np

from cirl_marl.network.compartment_model import DiscreteTimeModel, RewardState
from cirl_marl.network.rowsum import Floats

STATE = mujoco.mjtState.mjSTATE_INTEGRATION


class Engine(ABC):
    """An environment as a function.

    Attributes:
        env: the library's environment, unwrapped.
        visible_rows: names of the rows that the library shows.
        names: names of all rows.
        interval: time of a step, s.
    """

    def __init__(self, env: Any, visible_rows: Sequence[str]) -> None:
        """Take an environment of gymnasium or gymnasium-robotics."""
        self.env = env
        self.interval = float(env.dt)
        self.visible_rows = tuple(visible_rows)
        self._mocap_bodies = _welded_bodies(env.model)
        self._size = mujoco.mj_stateSize(env.model, STATE)
        pose = [
            f"weld{i}_{part}"
            for i in range(len(self._mocap_bodies))
            for part in ("x", "y", "z", "qw", "qx", "qy", "qz")
        ]
        self.names = (*self.visible_rows, *pose, *(f"mujoco_{i}" for i in range(self._size)))

    def start(self, stream: np.random.Generator) -> Floats:
        """Reset as the library does, with its draws from ``stream``; return the column, shape (rows,)."""
        self.env.np_random = stream
        self.env.reset()
        return self._read()

    def step(self, state: Floats, inputs: Floats) -> Floats:
        """Return every column one step later, shape (rows, B)."""
        after = np.empty_like(state)
        for i in range(state.shape[1]):
            self._load(state[:, i])
            self._act(inputs[:, i])
            after[:, i] = self._read()
        return after

    def _load(self, column: Floats) -> None:
        """Put the simulator into the state of a column."""
        model, data = self.env.model, self.env.data
        mujoco.mj_setState(model, data, np.ascontiguousarray(column[-self._size :]), STATE)
        poses = column[len(self.visible_rows) : -self._size].reshape(-1, 7)
        data.xpos[self._mocap_bodies], data.xquat[self._mocap_bodies] = poses[:, :3], poses[:, 3:]
        self._load_task(column)

    def _read(self) -> Floats:
        data = self.env.data
        physics = np.empty(self._size)
        mujoco.mj_getState(self.env.model, data, physics, STATE)
        poses = np.concatenate([data.xpos[self._mocap_bodies], data.xquat[self._mocap_bodies]], axis=1)
        return np.concatenate([self._show(), poses.ravel(), physics])

    def _load_task(self, column: Floats) -> None:
        """Load what the library keeps outside the simulator."""
        return

    @abstractmethod
    def _act(self, inputs: Floats) -> None:
        """Step the library's environment."""

    @abstractmethod
    def _show(self) -> Floats:
        """Return what the library shows, in the order of ``shown``."""


E = TypeVar("E", bound=Engine)


def one_per_thread(make: Callable[[], E]) -> Callable[[], E]:
    """Return a function that gives each thread an engine of its own; MuJoCo lets others run while it steps."""
    of_thread = threading.local()

    def engine() -> E:
        if not hasattr(of_thread, "engine"):
            of_thread.engine = make()
        engine_: E = of_thread.engine
        return engine_

    return engine


class Robot(DiscreteTimeModel):
    """A model that is an engine: its state holds what the library shows, poses of welded bodies and the simulator's."""

    __slots__ = ()
    input_unit: ClassVar[str] = "1"
    time_unit: ClassVar[str] = "s"
    reward_state: ClassVar[RewardState] = "after"

    @staticmethod
    @abstractmethod
    def engine() -> Engine:
        """Return the engine of this thread."""

    @property
    def state_names(self) -> tuple[str, ...]:
        """What the library shows, poses, state of the simulator."""
        return self.engine().names

    def start(self, stream: np.random.Generator) -> Floats:
        """Return a start as the library draws it, shape (k,)."""
        return self.engine().start(stream)

    def advance(self, state: Floats, inputs: Floats) -> Floats:
        """Return the state after one step of the library, shape (k, B)."""
        return self.engine().step(state, inputs)


def _welded_bodies(model: Any) -> list[int]:
    bodies = []
    for kind, first, second in zip(model.eq_type, model.eq_obj1id, model.eq_obj2id, strict=True):
        if kind == mujoco.mjtEq.mjEQ_WELD:
            bodies.append(int(second if model.body_mocapid[first] != -1 else first))
    return bodies
