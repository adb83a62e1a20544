"""One row of the paper's tables: train one learner in one environment, evaluate what it learnt."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

import gymnasium
import numpy as np
import torch
from pydantic import ValidationError
from stable_baselines3 import HerReplayBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from cirl_marl.catalogue import load_network
from cirl_marl.errors import CirlError, RunError
from cirl_marl.evaluate import EVALUATION_SEEDS, SEED_SPACING
from cirl_marl.learners.algorithms import build
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.training import one_torch_thread
from cirl_marl.machine import processor, versions
from cirl_marl.paper.evaluation import Predict, Report, evaluate, evaluation_episodes, predictor
from cirl_marl.paper.plan import tuned_recipe
from cirl_marl.paper.published import PaperEnvironment, environment_of
from cirl_marl.paper.results import WINDOW, Result, Row, thinned
from cirl_marl.results import fingerprint

PACKAGES = ("gymnasium-robotics", "mujoco")
"""On which the two robots depend, beside what every training run records."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Trained:
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


def run_row(row: Row, *, report: Report | None = None, episodes: int | None = None) -> Result:
    """Train and evaluate one row.

    Args:
        row: what to run.
        report: called now and then.
        episodes: that the final policy plays; None takes 100, or the paper's number where it counts successes.

    Raises:
        CirlError: if the environment is missing in this version, or no training episode ended.
    """
    environment = environment_of(row.environment)
    check_registered(environment)
    if environment.success_episodes:
        _check_success(environment)
    report = report or _silent
    with one_torch_thread():
        if row.recipe == "published":
            trained = train_published(environment, row, report)
        else:
            from cirl_marl.paper.tuned import train_tuned

            trained = train_tuned(environment, row, report)
        if not trained.returns:
            raise CirlError(f"{row}: no training episode ended; use more steps")
        episodes = evaluation_episodes(environment, episodes)
        seed = EVALUATION_SEEDS + SEED_SPACING * row.seed
        evaluation = published_ends = None
        if trained.predict is not None:
            evaluation = evaluate(environment.id, trained.predict, episodes, seed, report, trained.options)
            if environment.published_ends:
                options = trained.options | {"legacy_episode": True}  # its first episode is longer than all others
                published_ends = evaluate(environment.id, trained.predict, episodes, seed, report, options, warm_up=1)
        threads = torch.get_num_threads()
    window = max(1, min(WINDOW, len(trained.returns) // 2))
    return Result(
        row=row,
        steps_done=trained.steps,
        seconds=trained.seconds,
        episodes=len(trained.returns),
        start_return=float(np.mean(trained.returns[:window])),
        end_return=float(np.mean(trained.returns[-window:])),
        curve=thinned(trained.ends, trained.returns),
        evaluation=evaluation,
        settings=trained.settings,
        versions=versions() | {package: metadata.version(package) for package in PACKAGES},
        machine={
            "cpus": os.cpu_count(),
            "model": processor(),
            "torch_threads": threads,
            "load": os.getloadavg()[0],
            "device": "cpu",
        },
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
        cpu_seconds=trained.cpu_seconds,
        published_ends=published_ends,
    )


def outdated(result: Result, episodes: int | None = None) -> str:
    """Return in what a result differs from what its row would give today; empty if in nothing that is known.

    Args:
        result: of a row that is done.
        episodes: as for ``run_row``.
    """
    environment, settings = environment_of(result.row.environment), result.settings
    wanted = evaluation_episodes(environment, episodes)
    if result.evaluation is not None and result.evaluation.episodes != wanted:
        return f"its policy played {result.evaluation.episodes} episodes, not {wanted}"
    recorded = settings.get("definition_sha256")
    if recorded is not None and recorded != described(environment).get("definition_sha256"):
        return "the definition of the environment is another now"
    name = tuned_recipe(environment.name) if result.row.recipe == "tuned" else None
    if name is not None and not _is_recipe(settings["recipe"], load_recipe(name)):
        return f"the recipe '{name}' is another now"
    return ""


def _is_recipe(recorded: Mapping[str, Any], recipe: Recipe) -> bool:
    try:
        return Recipe.model_validate(recorded) == recipe
    except ValidationError:  # it has keys that recipes no longer have
        return False


def check_registered(environment: PaperEnvironment) -> gymnasium.envs.registration.EnvSpec:
    """Return the Gymnasium specification of an environment of the paper.

    Raises:
        RunError: if this version does not have it.
    """
    found = gymnasium.registry.get(environment.id)
    if found is None:
        raise RunError(f"{environment.id}: this version of cirl_marl does not register it")
    return found


def _check_success(environment: PaperEnvironment) -> None:
    """Find out before the training, not after it, whether successes can be counted."""
    env = gymnasium.make(environment.id)
    env.reset(seed=0)
    info = env.step(env.action_space.sample())[-1]
    env.close()
    if "success" not in info:
        raise RunError(f"{environment.id}: its info lacks 'success', whose share is a figure of this row")


def train_published(environment: PaperEnvironment, row: Row, report: Report) -> Trained:
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
    return Trained(
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


def _silent(what: str, done: int, total: int) -> None:
    del what, done, total
