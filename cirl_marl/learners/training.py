"""Training: seat the learners, let them run in lockstep, keep what they learn."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from types import FrameType

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import configure

from cirl_marl.environments.vector import Infos, VectorEnv
from cirl_marl.errors import CirlError, unknown
from cirl_marl.learners.demonstrations import Demonstrator
from cirl_marl.learners.learner import Learner, derived_seed
from cirl_marl.learners.lockstep import Interrupted, Lockstep
from cirl_marl.learners.run import MetricsFile, RunConfig, RunDirectory
from cirl_marl.learners.start import begin_from

CHECKPOINTS = 10
"""Checkpoints of a run, evenly spaced; a crash loses at most what came after the last."""


@dataclass(frozen=True, slots=True)
class Progress:
    """What a running training reports.

    Attributes:
        env_steps: environment steps done in this call, summed over the copies, of ``total``.
        seconds: since training began.
        circularity: mean over the copies of λ at the end of the last step, or λ̄ of the last episode; mass.
        service_level: likewise.
        episode: whether the two figures are those of a finished episode.
    """

    env_steps: int
    total: int
    seconds: float
    circularity: float
    service_level: float
    episode: bool


class Training:
    """A run in progress: what it was asked to do, the joint environment, its learners by name, and where it is kept."""

    def __init__(self, config: RunConfig, env: VectorEnv, resumed: RunDirectory | None = None) -> None:
        """Seat the learners and make their algorithms, or load those of a run that is resumed."""
        self.config = config
        self.env = env
        self.run: RunDirectory | None = None
        self._metrics: MetricsFile | None = None
        self._interrupted = False
        checkpoint = None
        self.done = 0
        if resumed is not None and resumed.status["checkpoint"] is not None:
            checkpoint, self.done = resumed.checkpoint, int(resumed.status["joint_steps"])
        seeds = [derived_seed(config.seed, "copies", i, self.done) for i in range(config.envs)]
        groups = {group.name: group for group in config.recipe.groups(env.network, env.agents)}
        self.lockstep = Lockstep(env, seeds, {name: group.view(env) for name, group in groups.items()}, done=self.done)
        self.learners: dict[str, Learner] = {}
        for name, seat in self.lockstep.seats.items():
            learner = Learner(seat, groups[name].spec, config.seed, done=self.done)
            self.learners[name] = learner.load(checkpoint) if checkpoint else learner.build()
        if checkpoint is None:
            self._begin_from_others()
        self._appoint_demonstrators()

    def _begin_from_others(self) -> None:
        """Give learners their starts, and say in the configuration from where."""
        asked = {name: each.spec.start for name, each in self.learners.items()}
        origins = {
            name: begin_from(start, self.learners[name], self.env, self.config.seed)
            for name, start in asked.items()
            if start is not None
        }
        self.config = self.config.model_copy(update={"origins": origins})

    def keep_in(self, run: RunDirectory) -> None:
        """Keep metrics, logs and checkpoints in ``run`` from now on."""
        self.run = run
        self._metrics = MetricsFile(run.path / "metrics.csv", self.env.agents, self.done)
        for name, learner in self.learners.items():
            learner.model.set_logger(configure(str(run.path / "tensorboard" / name), ["tensorboard"]))
        if self.config.origins and self.joint_steps == 0:
            self._save("running")  # so that the run does not need those from which it started any more

    def _appoint_demonstrators(self) -> None:
        """Give learners that have demonstrations to come a controller to follow, learners of the same one together."""
        known: dict[str, Demonstrator] = {}
        for learner in self.learners.values():
            asked = learner.spec.demonstrations
            if asked is not None and learner.demonstrations:
                seed = derived_seed(self.config.seed, "demonstrations", asked.controller, self.done)
                leader = known.setdefault(asked.controller, Demonstrator(asked.controller, self.env, seed))
                leader.check(learner.seat.view.agents, learner.seat.title)
                learner.demonstrator = leader

    def start(
        self, *, callbacks: Mapping[str, BaseCallback] | None = None, report: Callable[[Progress], None] | None = None
    ) -> None:
        """Train to the end of the budget; the arguments are those of ``train``.

        Raises:
            LearnerError: if a learner fails; what was learnt is saved first, as it is after Ctrl-C.
        """
        callbacks = callbacks or {}
        steps = self.config.steps
        try:
            with one_torch_thread(), self._interruptible():
                self.lockstep.run(
                    learners={a: partial(each.learn, steps, callbacks.get(a)) for a, each in self.learners.items()},
                    actors={a: each.act for a, each in self.learners.items()},
                    streams={a: each.streams for a, each in self.learners.items()},
                    budgets={a: each.budget(steps) for a, each in self.learners.items()},
                    hook=partial(self._after_step, time.perf_counter(), report),
                )
        except Interrupted:
            self._save("interrupted", "stopped by the user")
            raise KeyboardInterrupt from None
        except Exception as error:
            self._save("failed", str(error).partition("\n")[0] or repr(error))
            raise
        else:
            self._save("complete")
        finally:
            for learner in self.learners.values():
                learner.model.logger.close()

    def check_callbacks(self, callbacks: Mapping[str, BaseCallback]) -> None:
        """Raise a ``CirlError`` for callbacks of learners that there are not."""
        for name in callbacks:
            if name not in self.learners:
                raise CirlError(f"callbacks: {unknown('learner', name, self.learners)}")

    @property
    def joint_steps(self) -> int:
        """Joint steps done, those before a resumption included."""
        return self.lockstep.joint_steps

    def _after_step(
        self, began: float, report: Callable[[Progress], None] | None, infos: Infos, ended: NDArray[np.bool_]
    ) -> None:
        """Report, record finished episodes, save checkpoints, heed Ctrl-C."""
        seconds, copies, steps = time.perf_counter() - began, self.env.num_envs, self.joint_steps
        finished = bool(ended.any())
        if finished or report is not None:
            first, which = infos[self.env.agents[0]], ended if finished else slice(None)
            names = ("episode_circularity", "episode_service_level") if finished else ("circularity", "service_level")
            circularity, service = (float(first[name][which].mean()) for name in names)
            if report is not None:
                total = max(self.config.steps, steps * copies) - self.done * copies
                report(Progress((steps - self.done) * copies, total, seconds, circularity, service, finished))
            if finished and self._metrics is not None:
                returns = [float(info["episode_return"][ended].mean()) for info in infos.values()]
                spent = self._metrics.seconds + seconds
                self._metrics.append([steps, steps * copies, spent, circularity, service, *returns])
        if steps % max(1, self.config.steps // copies // CHECKPOINTS) == 0:
            self._save("running")
        if self._interrupted:
            raise Interrupted

    def _save(self, state: str, reason: str = "") -> None:
        if self.run is None:
            return

        def write(folder: Path) -> None:
            for learner in self.learners.values():
                learner.save(folder, replay=state != "complete")

        self.run.save_checkpoint(self.joint_steps, write, state, reason)

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Turn the first Ctrl-C into a clean stop at the next joint step; the second acts as usual."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return
        before = signal.getsignal(signal.SIGINT)

        def note(_signal: int, _frame: FrameType | None) -> None:
            self._interrupted = True
            signal.signal(signal.SIGINT, before)

        signal.signal(signal.SIGINT, note)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)


@contextmanager
def one_torch_thread() -> Iterator[None]:
    """Small networks learn fastest on one thread, and trainings may run side by side."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
