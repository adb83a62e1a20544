"""The clock of a training, which stands still while policies are judged, and what is kept of it."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from benchmarks.peers.problem import environment
from cirl_marl.controllers.basic import Controller
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.records.files import write_json

EPISODES = 256
"""Judged on, those of the study: the same for everyone, drawn by nobody in training."""

LEAST = 2
"""Laps of a training, of which the first warms up."""


class TimeIsUp(Exception):
    """Ends a training whose library has no other way out."""


@dataclass(frozen=True, slots=True)
class Lap:
    """Since training began: seconds, those of this process on its processors, and environment steps."""

    seconds: float
    processor: float
    steps: int


@dataclass(frozen=True, slots=True)
class Judged:
    """What a policy did after a lap: λ̄ of each episode, and the mean level of each service in it."""

    lap: Lap
    circularity: list[float]
    levels: list[list[float]]


@dataclass(slots=True)
class Record:
    """A training of one contender, as it is written.

    Attributes:
        contender: whose.
        setup: versions and vectorisation in words.
        load: of the machine before and after, over a minute.
        laps: after each rollout and its update.
        judged: after some of them.
    """

    contender: str
    setup: dict[str, Any] = field(default_factory=dict)
    load: list[float] = field(default_factory=list)
    laps: list[Lap] = field(default_factory=list)
    judged: list[Judged] = field(default_factory=list)

    @property
    def rate(self) -> float:
        """Environment steps per second after the first lap, which warms up."""
        first, last = self.laps[0], self.laps[-1]
        return (last.steps - first.steps) / (last.seconds - first.seconds)

    @property
    def processor_rate(self) -> float:
        """Environment steps per second that this process was on a processor, likewise."""
        first, last = self.laps[0], self.laps[-1]
        return (last.steps - first.steps) / (last.processor - first.processor)

    def write(self, path: Path) -> None:
        """Write it as JSON."""
        write_json(path, asdict(self))

    @classmethod
    def read(cls, path: Path) -> Record:
        """Read what ``write`` wrote."""
        told = json.loads(path.read_text(encoding="utf-8"))
        laps = [Lap(**lap) for lap in told["laps"]]
        judged = [Judged(Lap(**each["lap"]), each["circularity"], each["levels"]) for each in told["judged"]]
        return cls(told["contender"], told["setup"], told["load"], laps, judged)


class Watch:
    """Takes the time of a training.

    Attributes:
        record: what it has seen.
    """

    def __init__(
        self, contender: str, seconds: float, every: float, clock: Callable[[], float] = time.process_time
    ) -> None:
        """Let the training last ``seconds`` of the processor, and judge after ``every`` of them, never if that is 0.

        Wall time is noted as well, but how much of it a machine gives to a process is not the process's doing.
        """
        self.record = Record(contender, load=[os.getloadavg()[0]])
        self._seconds, self._every, self._clock = seconds, every, clock
        self._env = environment(EPISODES) if every else None
        self._began: tuple[float, float] | None = None
        self._next = every

    def begin(self) -> None:
        """Start the clock: everything is made, nothing is sampled."""
        self._began = time.perf_counter(), self._clock()

    @property
    def judges(self) -> bool:
        """Whether policies are judged."""
        return self._env is not None

    def lap(self, steps: int) -> None:
        """Note that so many environment steps are done and learnt from.

        Raises:
            TimeIsUp: if the training has lasted long enough.
        """
        lap = self._lap(steps)
        self.record.laps.append(lap)
        if lap.processor >= self._seconds and len(self.record.laps) >= LEAST:
            raise TimeIsUp

    def after(self, steps: int, policy: Callable[[], Controller]) -> None:
        """Note a lap, and judge the policy if it is time, or over.

        Raises:
            TimeIsUp: if the training has lasted long enough.
        """
        processor = self._lap(steps).processor
        if self.judges and processor >= min(self._next, self._seconds):
            self.judge(policy(), steps)
            self._next = processor + self._every
        self.lap(steps)

    def judge(self, policy: Controller, steps: int) -> None:
        """Judge the policy after so many environment steps, while the clock stands still."""
        assert self._env is not None and self._began is not None
        lap, wall, processor = self._lap(steps), time.perf_counter(), self._clock()
        run = rollout(self._env, policy, seed=first_seed(0))
        self.record.judged.append(Judged(lap, run.episode_circularity.tolist(), run.episode_levels.tolist()))
        began = self._began
        self._began = began[0] + time.perf_counter() - wall, began[1] + self._clock() - processor

    def _lap(self, steps: int) -> Lap:
        assert self._began is not None, "the training has not begun"
        return Lap(time.perf_counter() - self._began[0], self._clock() - self._began[1], steps)
