"""Checkpoint barrier with a replay log: how learners are saved together that update at other times.

A barrier is a point of a computation at which its state is small and complete. That of a learner lies between two
rollouts (of ARS, before it draws candidates). Learners come to theirs at different joint steps, and waiting for the
others would change what they learn. So each one writes its state when it comes to its barrier after a checkpoint was
requested, goes on, and logs from then on its actions and what the environment answered. When all have written, the
environment is saved, and with it the logs: the checkpoint is a consistent cut, as in Chandy and Lamport 1985.

A resumed learner is loaded with its state at its first barrier. The environment is already where the logs end, so the
learner is fed the logged answers until it gets there. It draws from random streams of its own and therefore acts as it
did, to the bit; an action that differs from the logged one is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sb3_contrib import ARS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import Schedule

from cirl_marl.errors import RunError
from cirl_marl.learners.agent_env import AgentVecEnv, StepResult

LoggedStep = tuple[NDArray[np.float32], StepResult]
"""An action, and what the environment answered."""


class CheckpointBarrier:
    """The barrier of one learner.

    Attributes:
        write: writes the state to a folder, with what else belongs to it; None if the run is kept nowhere.
        folder: where a checkpoint is requested; None if none is.
        log: steps since the learner wrote its state for that checkpoint; None if it has not.
        replay_log: steps that a resumed learner has still to repeat.
    """

    def __init__(self, agent_env: AgentVecEnv) -> None:
        """Of the learner in ``agent_env``."""
        self._agent_env = agent_env
        self.write: Callable[[Path, dict[str, Any]], None] | None = None
        self._load: Callable[[], None] | None = None
        self._acting_state: Mapping[str, Any] | None = None
        self.folder: Path | None = None
        self.log: list[LoggedStep] | None = None
        self.replay_log: list[LoggedStep] = []

    def resume_from(self, load: Callable[[], None], step: StepResult, acting_state: Mapping[str, Any] | None) -> None:
        """Have ``load`` bring the learner into its saved state at the first barrier, where ``step`` was its last."""

        def load_at_barrier() -> None:
            self._agent_env.last_step = step
            load()

        self._load, self._acting_state = load_at_barrier, acting_state

    @property
    def is_restoring(self) -> bool:
        """Whether a resumed learner has not come to its first barrier yet."""
        return self._load is not None

    @property
    def acting_state(self) -> Mapping[str, Any] | None:
        """The saved memory of a policy whose learner had finished; None if the learner goes on learning."""
        return self._acting_state if self.is_restoring else None

    def arrive(self, acting_state: Mapping[str, Any] | None = None) -> None:
        """Load the state to resume from, or write it if requested; ``acting_state`` is that of a finished learner."""
        if self._load is not None:
            load, self._load = self._load, None
            load()
        if self.folder is not None and self.log is None and self.write is not None:
            self.log = []
            self.write(self.folder, {"handed": self._agent_env.last_step.state_dict(), "acting": acting_state})

    def record(self) -> None:
        """Log the last step, if the learner has written its state."""
        if self.log is not None:
            assert self._agent_env.action is not None
            self.log.append((self._agent_env.action.copy(), self._agent_env.last_step))

    def replay_step(self, place: int) -> None:
        """Answer from the replay log; a ``RunError`` if the learner's action is not the logged one."""
        action, step = self.replay_log[place]
        if self._agent_env.action is None or not np.array_equal(action, self._agent_env.action):
            raise RunError(f"{self._agent_env.title} does not do again what it did: versions or files are others now")
        self._agent_env.last_step = step

    def release(self) -> None:
        """End the request, and with it the log."""
        self.folder = self.log = None


class BarrierCallback(BaseCallback):
    """Arrives at a barrier at the beginning of every rollout."""

    def __init__(self, barrier: CheckpointBarrier) -> None:
        """Arrive at ``barrier``."""
        super().__init__()
        self._barrier = barrier

    def _on_rollout_start(self) -> None:
        if not isinstance(self.model, ARS):
            self._barrier.arrive()

    def _on_step(self) -> bool:
        return True


class _BarrierSchedule:
    """A schedule that ARS asks at the beginning of every update, before it draws; pickled as the schedule itself."""

    def __init__(self, schedule: Schedule, model: ARS, barrier: CheckpointBarrier) -> None:
        self._schedule, self._model, self._barrier = schedule, model, barrier

    def __call__(self, _progress: float) -> float:
        self._barrier.arrive()
        return self._schedule(self._model._current_progress_remaining)  # loading the state may have changed it

    def __reduce__(self) -> tuple[Any, ...]:
        return _identity, (self._schedule,)


def _identity(value: Any) -> Any:
    return value


@contextmanager
def barrier_at_updates(model: BaseAlgorithm, barrier: CheckpointBarrier) -> Iterator[None]:
    """Let ARS arrive before every update: its candidates are drawn when ``on_rollout_start`` comes."""
    if not isinstance(model, ARS):
        yield
        return
    schedule = model.delta_std_schedule
    model.delta_std_schedule = _BarrierSchedule(schedule, model, barrier)  # type: ignore[assignment]
    try:
        yield
    finally:
        model.delta_std_schedule = schedule
