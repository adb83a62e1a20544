"""Checkpoint barrier with a replay log: how learners are saved together that update at other times.

A barrier is a point of a computation at which its state is small and complete. That of a learner lies between two
rollouts (of ARS, before it draws candidates). Learners come to theirs at different joint steps, and waiting for the
others would change what they learn. So each one writes its state when it comes to its barrier after a checkpoint was
requested, goes on, and logs from then on its actions and what the environment answered. When all have written, the
environment is saved, and with it the logs: the checkpoint is a consistent cut, as in Chandy and Lamport 1985.

A resumed learner is loaded with its state at its first barrier. The environment is already where the logs end, so the
learner is fed the logged answers until it gets there. It draws from random streams of its own and therefore acts as it
did: to the bit on the same kind of processor, within rounding on another, which a warning says. An action that differs
by more from the logged one is an error.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from sb3_contrib import ARS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.type_aliases import Schedule

from cirl_marl.errors import RunError
from cirl_marl.learners.agent_env import AgentVecEnv, StepResult
from cirl_marl.network.declarations import with_field_docs

LoggedStep = tuple[NDArray[np.float32], StepResult]
"""An action, and what the environment answered."""

ROUNDING = 1e-3
"""How far an action in [−1, 1] may be from the logged one: other kernels round otherwise, and updates enlarge it."""


@with_field_docs
@dataclass(slots=True, eq=False)
class CheckpointBarrier:
    """The barrier of one learner."""

    agent_env: Annotated[AgentVecEnv, "its environment"]
    write: Annotated[Callable[[Path, dict[str, Any]], None] | None, "writes its state and more to a folder"] = None
    load: Annotated[Callable[[], None] | None, "brings a resumed learner into its state at the first barrier"] = None
    loaded_acting_state: Annotated[Mapping[str, Any] | None, "saved memory of a policy that had learnt enough"] = None
    folder: Annotated[Path | None, "where a checkpoint is requested; None if none is"] = None
    log: Annotated[list[LoggedStep] | None, "steps since the state was written for that; None if it was not"] = None
    replay_log: Annotated[list[LoggedStep], "what a resumed learner has still to repeat"] = field(default_factory=list)

    @property
    def is_restoring(self) -> bool:
        """Whether a resumed learner has not come to its first barrier yet."""
        return self.load is not None

    @property
    def acting_state(self) -> Mapping[str, Any] | None:
        """The saved memory of a policy whose learner had finished; None if the learner goes on learning."""
        return self.loaded_acting_state if self.is_restoring else None

    def arrive(self, acting_state: Mapping[str, Any] | None = None) -> None:
        """Load the state to resume from, or write it if requested; ``acting_state`` is that of a finished learner."""
        if self.load is not None:
            load, self.load = self.load, None
            load()
        if self.folder is not None and self.log is None and self.write is not None:
            self.log = []
            self.write(self.folder, {"handed": self.agent_env.last_step.as_dict(), "acting": acting_state})

    def record(self) -> None:
        """Log the last step, if the learner has written its state."""
        if self.log is not None:
            assert self.agent_env.action is not None
            self.log.append((self.agent_env.action.copy(), self.agent_env.last_step))

    def replay_step(self, place: int) -> None:
        """Answer from the replay log.

        Raises:
            RunError: if the learner's action is not the logged one.
        """
        (logged, step), action = self.replay_log[place], self.agent_env.action
        if action is None or action.shape != logged.shape or not np.allclose(action, logged, rtol=0.0, atol=ROUNDING):
            raise RunError(f"{self.agent_env.title} does not do again what it did: versions or files are others now")
        if not np.array_equal(action, logged):
            message = f"{self.agent_env.title} goes on, but not to the same bits: this processor rounds otherwise"
            warnings.warn(message, stacklevel=2)
        self.agent_env.last_step = step

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
