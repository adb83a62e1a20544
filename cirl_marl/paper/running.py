"""One row of the paper's tables: train one learner in one environment, evaluate what it learnt."""

from __future__ import annotations

import os
from collections.abc import Mapping
from datetime import UTC, datetime
from importlib import metadata
from typing import Any

import gymnasium
import numpy as np
import torch
from pydantic import ValidationError

from cirl_marl.controllers.rollout import EVALUATION_SEEDS, SEED_SPACING
from cirl_marl.errors import CirlError, RunError
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.training import one_torch_thread
from cirl_marl.paper.final_policy import Report, evaluate, evaluation_episodes
from cirl_marl.paper.published import PaperEnvironment, environment_of
from cirl_marl.paper.results import WINDOW, PaperRow, Result, thinned
from cirl_marl.paper.selection import tuned_recipe
from cirl_marl.paper.tuned import train_tuned
from cirl_marl.paper.untuned import check_registered, described, train_published
from cirl_marl.records.machine import processor, versions

PACKAGES = ("gymnasium-robotics", "mujoco")
"""On which the two robots depend, beside what every training run records."""


def run_row(row: PaperRow, *, report: Report | None = None, episodes: int | None = None) -> Result:
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
        if row.settings == "published":
            trained = train_published(environment, row, report)
        else:
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
    name = tuned_recipe(environment.name) if result.row.settings == "tuned" else None
    if name is not None and not _is_recipe(settings["recipe"], load_recipe(name)):
        return f"the recipe '{name}' is another now"
    return ""


def _is_recipe(recorded: Mapping[str, Any], recipe: Recipe) -> bool:
    try:
        return Recipe.model_validate(recorded) == recipe
    except ValidationError:  # it has keys that recipes no longer have
        return False


def _check_success(environment: PaperEnvironment) -> None:
    """Find out before the training, not after it, whether successes can be counted."""
    env = gymnasium.make(environment.id)
    env.reset(seed=0)
    info = env.step(env.action_space.sample())[-1]
    env.close()
    if "success" not in info:
        raise RunError(f"{environment.id}: its info lacks 'success', whose share is a figure of this row")


def _silent(what: str, done: int, total: int) -> None:
    del what, done, total
