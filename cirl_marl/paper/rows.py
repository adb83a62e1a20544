"""One row of the paper's tables: train one learner in one environment, evaluate what it learnt."""

from __future__ import annotations

import os
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import metadata
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import torch
from pydantic import ValidationError
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.vec_env import DummyVecEnv

from cirl_marl.controllers.rollout import EVALUATION_SEEDS, SEED_SPACING
from cirl_marl.errors import CirlError, RunError
from cirl_marl.jobs import Tell
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.trainer import one_torch_thread
from cirl_marl.paper.published import PaperEnvironment, environment_of
from cirl_marl.paper.results import WINDOW, EvaluationFigures, PaperRow, Result, Results, thin_out
from cirl_marl.paper.row_selection import tuned_recipe
from cirl_marl.paper.training import Predict, Report, check_registered, describe, train_published, train_tuned
from cirl_marl.records.machine import processor, versions

PACKAGES = ("gymnasium-robotics", "mujoco")
"""On which the two robots depend, beside what every training run records."""
EVALUATION_EPISODES = 100
EVALUATION_COPIES = 20


def run_row(row: PaperRow, *, report: Report = lambda stage, done, total: None, episodes: int | None = None) -> Result:
    """Train and evaluate one row; the final policy plays 100 ``episodes``, or the paper's where it counts successes.

    Raises:
        CirlError: if the environment is missing in this version, or no training episode ended.
    """
    environment = environment_of(row.environment)
    check_registered(environment)
    if environment.success_episodes:
        _check_success(environment)
    with one_torch_thread():
        train = train_published if row.settings == "published" else train_tuned
        training = train(environment, row, report)
        if not training.returns:
            raise CirlError(f"{row}: no training episode ended; use more steps")
        episodes = _evaluation_episodes(environment, episodes)
        seed = EVALUATION_SEEDS + SEED_SPACING * row.seed
        evaluation = published_ends = None
        if training.predict is not None:
            evaluation = evaluate(environment.id, training.predict, episodes, seed, report, training.options)
            if environment.published_ends:
                options = training.options | {"legacy_episode": True}  # its first episode is longer than all others
                published_ends = evaluate(environment.id, training.predict, episodes, seed, report, options, warm_up=1)
        threads = torch.get_num_threads()
    machine = {"cpus": os.cpu_count(), "model": processor(), "torch_threads": threads, "device": "cpu"}
    window = max(1, min(WINDOW, len(training.returns) // 2))
    return Result(
        row=row,
        steps_done=training.steps,
        seconds=training.seconds,
        episodes=len(training.returns),
        start_return=float(np.mean(training.returns[:window])),
        end_return=float(np.mean(training.returns[-window:])),
        curve=thin_out(training.ends, training.returns),
        evaluation=evaluation,
        settings=training.settings,
        versions=versions() | {package: metadata.version(package) for package in PACKAGES},
        machine=machine | {"load": os.getloadavg()[0]},
        finished=datetime.now(UTC).isoformat(timespec="seconds"),
        cpu_seconds=training.cpu_seconds,
        published_ends=published_ends,
    )


@dataclass(frozen=True, slots=True)
class RowJob:
    """A row as a job, whose result is kept in a folder."""

    row: PaperRow
    folder: Path
    episodes: int | None

    @property
    def name(self) -> str:
        """Name of its files."""
        return self.row.stem

    def is_done(self) -> bool:
        """Return whether a result is kept that ``run_row`` would give today."""
        results = Results(self.folder)
        return results.has(self.row) and not reason_to_repeat(results.read(self.row), self.episodes)

    def run(self, tell: Tell) -> None:
        """Train and evaluate from the beginning, and keep the result."""
        Results(self.folder).write(run_row(self.row, report=tell, episodes=self.episodes))


def reason_to_repeat(result: Result, episodes: int | None = None) -> str:
    """Return in what a result differs from what ``run_row`` would give today; empty if in nothing that is known."""
    environment, settings = environment_of(result.row.environment), result.settings
    options = _evaluation_episodes(environment, episodes)
    if result.evaluation is not None and result.evaluation.episodes != options:
        return f"its policy played {result.evaluation.episodes} episodes, not {options}"
    content = settings.get("definition_sha256")
    if content is not None and content != describe(environment).get("definition_sha256"):
        return "the definition of the environment is another now"
    if result.row.settings == "tuned" and (name := tuned_recipe(environment.name)) is not None:
        try:
            is_equal = Recipe.model_validate(settings["recipe"]) == load_recipe(name)
        except ValidationError:  # it has keys that recipes no longer have
            is_equal = False
        return "" if is_equal else f"the recipe '{name}' is another now"
    return ""


def _evaluation_episodes(environment: PaperEnvironment, episodes: int | None) -> int:
    """Return how many episodes a final policy plays: as many as ``episodes``, else 100, or the paper's that succeed."""
    return episodes or environment.success_episodes or EVALUATION_EPISODES


def _check_success(environment: PaperEnvironment) -> None:
    """Find out before the training, not after it, whether successes can be counted."""
    env = gymnasium.make(environment.id)
    env.reset(seed=0)
    info = env.step(env.action_space.sample())[-1]
    env.close()
    if "success" not in info:
        raise RunError(f"{environment.id}: its info lacks 'success', whose share is a figure of this row")


def evaluate(
    id_: str, predict: Predict, episodes: int, seed: int, report: Report, options: dict[str, Any], *, warm_up: int = 0
) -> EvaluationFigures:
    """Return mean return and share of successes of ``episodes`` fresh episodes.

    Each copy plays a fixed number of episodes, so that short ones are not favoured, after ``warm_up`` that do not
    count.
    """
    copies = min(EVALUATION_COPIES, episodes)
    env = DummyVecEnv([lambda: Monitor(gymnasium.make(id_, **options))] * copies)
    env.seed(seed)
    quota = np.array([(episodes + copy) // copies for copy in range(copies)])
    episodes_done = np.full(copies, -warm_up)
    success_count, starts = np.zeros(copies, dtype=bool), np.ones(copies, dtype=bool)
    returns: list[float] = []
    successes: list[bool] = []
    knows_success, state, observation = False, None, env.reset()
    while (episodes_done < quota).any():
        actions, state = predict(observation, state, starts)
        observation, _, starts, infos = env.step(actions)
        for copy, info in enumerate(infos):
            knows_success |= "success" in info
            success_count[copy] |= bool(info.get("success", False))
            if starts[copy]:
                if 0 <= episodes_done[copy] < quota[copy]:
                    returns.append(float(info["episode"]["r"]))
                    successes.append(bool(success_count[copy]))
                episodes_done[copy] += 1
                success_count[copy] = False
        report("evaluating", len(returns), episodes)
    env.close()
    mean, deviation = float(np.mean(returns)), float(np.std(returns))
    success = 100 * float(np.mean(successes)) if knows_success else None
    return EvaluationFigures(episodes=len(returns), mean=mean, deviation=deviation, success=success)
