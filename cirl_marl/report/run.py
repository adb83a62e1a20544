"""Evaluation of a training run and its pictures."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from cirl_marl.controllers import Controller, Neutral, Random
from cirl_marl.controllers.trained import Trained
from cirl_marl.errors import CirlError, RunError
from cirl_marl.evaluate import EVALUATION_SEEDS, SEED_SPACING, Rollout, interval_ends, rollout, summary
from cirl_marl.learners.run import RunDirectory, write_json
from cirl_marl.report.curves import save_circularity, save_learning_curves
from cirl_marl.report.digraph import save_before_after
from cirl_marl.vector_env import VectorEnv


def evaluate_run(
    run: RunDirectory,
    *,
    episodes: int = 64,
    seed: int = 0,
    progress: Callable[[str, int], None] | None = None,
) -> tuple[dict[str, Any], dict[str, Rollout], VectorEnv]:
    """Compare the trained policies with neutral and random control on fresh episodes.

    All controllers start from the same states; their seeds lie above those that training draws.

    Args:
        run: a run with a checkpoint.
        episodes: number of episodes.
        seed: different seeds evaluate on different episodes.
        progress: called with the controller's name and the number of intervals done.

    Returns:
        The figures, which are also written to ``evaluation.json``, the rollouts by controller, and the environment.

    Raises:
        CirlError: if ``episodes`` or ``seed`` cannot be used.
        RunError: if the run is incomplete.
    """
    if episodes < 2:
        raise CirlError(f"episodes must be at least 2 for a confidence interval, got {episodes}")
    if seed < 0:
        raise CirlError(f"seed must not be negative, got {seed}")
    first = EVALUATION_SEEDS + SEED_SPACING * seed
    trained = Trained(run)
    env = run.make_env(episodes)
    controllers: Mapping[str, Controller] = {"trained": trained, "neutral": Neutral(), "random": Random()}
    rollouts = {
        name: rollout(
            env,
            controller,
            seed=first,
            progress=None if progress is None else _named(progress, name),
        )
        for name, controller in controllers.items()
    }
    figures = summary(env, rollouts)
    config = run.config
    figures |= {"network": config.network, "recipe": config.recipe.name, "first_seed": first}
    write_json(run.path / "evaluation.json", figures)
    return figures, rollouts, env


def draw_run(run: RunDirectory, rollouts: Mapping[str, Rollout], env: VectorEnv) -> list[Path]:
    """Draw the network before and after, λ(t) trained against neutral and random, and the learning curves."""
    folder = run.path / "pictures"
    folder.mkdir(exist_ok=True)
    network = env.network
    before, after = rollouts["neutral"], rollouts["trained"]
    flows = folder / "flows_before_after.png"
    save_before_after(
        flows,
        network,
        (before.final_stock, before.mean_flow),
        (after.final_stock, after.mean_flow),
        ("neutral", "trained"),
    )
    time = interval_ends(network)
    circularity = folder / "circularity.png"
    save_circularity(
        circularity,
        network,
        time,
        {name: run_.circularity for name, run_ in rollouts.items()},
        {name: run_.service for name, run_ in rollouts.items()},
    )
    drawn = [flows, circularity]
    try:
        metrics = run.metrics()
    except RunError:
        return drawn  # no episode ended while training, so there is no curve
    curves = folder / "learning_curves.png"
    returns = {agent: np.array(metrics.get(f"return:{agent}", [])) for agent in env.agents}
    save_learning_curves(curves, np.array(metrics.get("env_steps", [])), returns)
    return [*drawn, curves]


def _named(progress: Callable[[str, int], None], name: str) -> Callable[[int], None]:
    return lambda steps: progress(name, steps)
