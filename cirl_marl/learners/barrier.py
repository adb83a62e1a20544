"""Where a learner can be saved: between two rollouts. What came after that is kept, and handed to it again.

A checkpoint is asked for at any time. Every learner writes its state when it comes to its next boundary, and from then
on what it does and what is handed to it is noted. When all have done so, the environment is saved, too. Who goes on
from there begins as it did, is brought into its state at the first boundary, and does again what it did; what it is
handed is what was noted, until it has come to where the environment is. Each draws from streams of its own, so that it
does the same to the bit; an action that differs is an error.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.errors import RunError
from cirl_marl.learners.agent_env import AgentVecEnv, StepResult

LoggedStep = tuple[NDArray[np.float32], StepResult]
"""An action, and what was handed to the learner after it."""


class CheckpointBarrier:
    """The boundaries of one learner.

    Attributes:
        folder: where its state is asked for; None if it is not.
        noted: what came after the state that it wrote; None if it wrote none yet.
        again: what is to be handed to it again.
    """

    def __init__(self, seat: AgentVecEnv) -> None:
        """Of the learner of ``seat``; ``keeps`` says how it is saved."""
        self._seat = seat
        self._write: Callable[[Path, dict[str, Any]], None] | None = None
        self._read: Callable[[], None] | None = None
        self._acting: Mapping[str, Any] | None = None
        self.folder: Path | None = None
        self.noted: list[LoggedStep] | None = None
        self.again: list[LoggedStep] = []

    def keeps(self, write: Callable[[Path, dict[str, Any]], None]) -> None:
        """Have the state written by ``write``, which takes the folder and what else belongs to the state."""
        self._write = write

    def begins_at(self, read: Callable[[], None], handed: StepResult, acting: Mapping[str, Any] | None) -> None:
        """Go on at the first boundary: ``read`` brings the learner into its state, ``handed`` is what it knew."""

        def back() -> None:
            self._seat.handed = handed
            read()

        self._read, self._acting = back, acting

    @property
    def resuming(self) -> bool:
        """Whether the learner has not come to the boundary yet at which it goes on."""
        return self._read is not None

    @property
    def acting(self) -> Mapping[str, Any] | None:
        """What a learner that had learnt enough knew when it was saved; None if it goes on learning."""
        return self._acting if self.resuming else None

    def reached(self, acting: Mapping[str, Any] | None = None) -> None:
        """Write the state if it is asked for, or go on from it; ``acting`` is what one knows that has learnt enough."""
        if self._read is not None:
            read, self._read = self._read, None
            read()
        if self.folder is not None and self.noted is None and self._write is not None:
            self.noted = []
            self._write(self.folder, {"handed": self._seat.handed.told(), "acting": acting})

    def note(self) -> None:
        """Note what the learner did and what was handed to it, if it has written its state."""
        if self.noted is not None:
            assert self._seat.action is not None
            self.noted.append((self._seat.action.copy(), self._seat.handed))

    def repeat(self, place: int) -> None:
        """Hand over again what was noted; a ``RunError`` if the learner did not do again what it did."""
        action, handed = self.again[place]
        if self._seat.action is None or not np.array_equal(action, self._seat.action):
            raise RunError(f"{self._seat.title} does not do again what it did: versions or files are others now")
        self._seat.handed = handed

    def forget(self) -> None:
        """Ask for nothing any more."""
        self.folder = self.noted = None
