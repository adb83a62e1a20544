"""What trainings of the paper's environments share, and the training by the paper's own settings."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import gymnasium
import numpy as np
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.definitions.writing import fingerprint
from cirl_marl.errors import CirlError, RunError
from cirl_marl.learners.algorithms import build
from cirl_marl.paper.final_policy import Predict, Report, predictor
from cirl_marl.paper.published import PaperEnvironment
from cirl_marl.paper.results import PaperRow


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperTraining:
    """What a training hands over to be measured.

    Attributes:
        predict: the final policy; None if its weights became NaN.
        ends: environment steps at which each training episode ended.
        returns: undiscounted return of each.
        steps: environment steps done.
        seconds: wall time.
        cpu_seconds: processor time.
        settings: what the row depends on.
        options: options of the environment to evaluate in.
    """

    predict: Predict | None
    ends: list[int]
    returns: list[float]
    steps: int
    seconds: float
    cpu_seconds: float
    settings: dict[str, Any]
    options: dict[str, Any]


def check_registered(environment: PaperEnvironment) -> gymnasium.envs.registration.EnvSpec:
    """Return the Gymnasium specification of an environment of the paper.

    Raises:
        RunError: if this version does not have it.
    """
    found = gymnasium.registry.get(environment.id)
    if found is None:
        raise RunError(f"{environment.id}: this version of cirl_marl does not register it")
    return found


def train_published(environment: PaperEnvironment, row: PaperRow, report: Report) -> PaperTraining:
    """Train with the paper's settings: the library's default hyperparameters, one copy; hindsight for goal tasks.

    A learner whose weights become NaN ends there, and that is what these settings give: the same seed gives it again.
    """
    env = Monitor(gymnasium.make(environment.id))
    name, _, hindsight = row.algorithm.partition("-")
    policy = "MultiInputPolicy" if hindsight else "MlpPolicy"
    extra: dict[str, Any] = {"replay_buffer_class": HerReplayBuffer} if hindsight else {}
    model = build(name, policy, DummyVecEnv([lambda: env]), extra, seed=row.seed, device="cpu")
    elapsed = stopwatch()
    diverged = False
    try:
        model.learn(row.steps, callback=Watch(report, row.steps))
    except (CirlError, ValueError):  # what torch's distributions and the environments say of NaN
        diverged = not _is_finite(model)
        if not diverged:
            raise
    seconds, cpu_seconds = elapsed()
    settings = {"policy": policy, "hyperparameters": "defaults of the library", "copies": 1, **described(environment)}
    if hindsight:
        settings["replay_buffer_class"] = "HerReplayBuffer, defaults of the library"
    ends, returns = episodes_of([env])
    env.close()
    return PaperTraining(
        predict=None if diverged else predictor(model),
        ends=ends,
        returns=returns,
        steps=model.num_timesteps,
        seconds=seconds,
        cpu_seconds=cpu_seconds,
        settings=settings,
        options={},
    )


def _is_finite(model: BaseAlgorithm) -> bool:
    return all(bool(weights.isfinite().all()) for weights in model.policy.parameters())


def described(environment: PaperEnvironment) -> dict[str, Any]:
    """Return id, arguments and fingerprint of the definition of an environment, for the record."""
    spec = check_registered(environment)
    found = {"environment": spec.id, "arguments": {key: str(value) for key, value in spec.kwargs.items()}}
    if "network" in spec.kwargs:
        network = load_network(spec.kwargs["network"], scenario=spec.kwargs.get("scenario"))
        found["definition_sha256"] = fingerprint(network)
    return found


def episodes_of(monitors: list[Monitor[Any, Any]]) -> tuple[list[int], list[float]]:
    """Return when the episodes of several copies ended, in steps summed over the copies, and their returns, in order.

    What the monitor of each copy saw counts, as ARS keeps its episodes from callbacks.
    """
    found = [
        (int(end) * len(monitors), copy, value)
        for copy, monitor in enumerate(monitors)
        for end, value in zip(np.cumsum(monitor.get_episode_lengths()), monitor.get_episode_rewards(), strict=True)
    ]
    found.sort()
    return [end for end, _, _ in found], [value for _, _, value in found]


class Watch(BaseCallback):
    """Reports the steps done."""

    def __init__(self, report: Report, total: int) -> None:
        """Report to ``report``."""
        super().__init__()
        self._report = report
        self._total = total

    def _on_step(self) -> bool:
        self._report("training", min(self.num_timesteps, self._total), self._total)
        return True


def stopwatch() -> Callable[[], tuple[float, float]]:
    """Start to measure; the function returned gives wall time and processor time since then, in seconds."""
    wall, cpu = time.perf_counter(), time.process_time()
    return lambda: (time.perf_counter() - wall, time.process_time() - cpu)
