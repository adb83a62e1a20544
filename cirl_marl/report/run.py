"""Evaluation of a training run and its pictures."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from cirl_marl.controllers.rollout import Rollout, interval_ends
from cirl_marl.drawing.digraph import save_before_after
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import RunError
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.comparison import Comparison, part_of
from cirl_marl.evaluation.figures import summary
from cirl_marl.evaluation.statistics import over_episodes
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.records.files import write_json
from cirl_marl.report.curves import save_circularity, save_learning_curves
from cirl_marl.report.explanations import read_reasons
from cirl_marl.report.report_page import PLAN, ReportPage, add_plan, page_of_comparison

CONTROLLERS = ("neutral", "random")
"""Whom a run is compared with."""
EVALUATED = 0.6
"""Share of the evaluation in the work on a page; the rest is to plan."""


def evaluate_run(
    run: RunDirectory,
    *,
    episodes: int = 64,
    seed: int = 0,
    bounds: bool = True,
    progress: Callable[[str, float], None] = lambda what, share: None,
) -> tuple[dict[str, Any], dict[str, Rollout], MultiAgentVectorEnv]:
    """Compare the trained policies with neutral and random control on fresh episodes.

    The other arguments are those of ``compare``; bounds take longer than the episodes.

    Returns:
        The figures, which are also written to ``evaluation.json`` (``not_written`` says why, where that cannot be), the
        rollouts by controller, and the environment. An
        evaluation of the same checkpoint in the same episodes is left there if this one has no bounds.

    Raises:
        CirlError: if ``episodes`` or ``seed`` cannot be used.
        RunError: if the run is incomplete.
    """
    comparison = compare([run], CONTROLLERS, episodes=episodes, seed=seed, bounds=bounds, progress=progress)
    return figures_of(run, comparison, bounds=bounds)


def evaluate_story(
    run: RunDirectory, *, episodes: int, seed: int, progress: Callable[[str, float], None]
) -> tuple[tuple[dict[str, Any], dict[str, Rollout], MultiAgentVectorEnv], ReportPage]:
    """Return what ``evaluate_run`` does, and the page: business as usual, the policies, and the plan of the bound.

    Reasons are on it if they were found of the checkpoint that acts; else it says how to find them.
    """
    comparison = compare(
        [run], CONTROLLERS, episodes=episodes, seed=seed, progress=lambda what, share: progress(what, EVALUATED * share)
    )
    found = figures_of(run, comparison, bounds=True)
    story = page_of_comparison(comparison, without=CONTROLLERS[1:])
    reasons, missing = read_reasons(run, comparison.entries[0].checkpoint)
    notes = (*story.notes, f"{missing}.") if missing else story.notes
    story = replace(story, reasons=reasons, notes=notes)
    return found, add_plan(story, comparison, run.make_env(1), part_of(progress, PLAN, EVALUATED, 1 - EVALUATED))


def figures_of(
    run: RunDirectory, comparison: Comparison, *, bounds: bool
) -> tuple[dict[str, Any], dict[str, Rollout], MultiAgentVectorEnv]:
    """Return, and write, what ``evaluate_run`` does of a comparison of the run with ``CONTROLLERS``."""
    episodes = comparison.episodes
    entries = dict(zip(("trained", "neutral", "random"), comparison.entries, strict=True))
    rollouts = {name: entry.rollout for name, entry in entries.items()}
    env = run.make_env(episodes)
    figures = summary(env, rollouts)
    for name, entry in entries.items():
        if entry.bound is not None and entry.gap is not None:
            figures["controllers"][name] |= {
                "bound": over_episodes(entry.bound).as_dict(),
                "gap": over_episodes(entry.gap, (0.0, np.inf)).as_dict(),
            }
    if comparison.baseline.reason:
        figures["no_bound"] = comparison.baseline.reason
    config = run.config
    figures |= {"network": config.network, "recipe": config.recipe.name, "first_seed": comparison.first_seed}
    figures["checkpoint"] = entries["trained"].checkpoint
    if bounds or not _is_evaluated(run, figures):
        try:
            write_json(run.path / "evaluation.json", figures)
        except OSError as error:
            figures["not_written"] = str(error)
    return figures, rollouts, env


def choice(run: RunDirectory) -> str:
    """Say which checkpoint of a run acts, and by what it was chosen."""
    status, config, network = run.status, run.config, run.network()
    best = status["best"]
    if best is None:
        return f"who acts: the last checkpoint, after {status['joint_steps'] * config.envs:,} environment steps"
    figures, demanded = best["figures"], config.recipe.run.min_service
    said = (
        f"who acts: the checkpoint after {best['joint_steps'] * config.envs:,} environment steps, the best of "
        f"{run.evaluations()} evaluations (λ̄ {figures['circularity']:.4g} {network.mass_unit}, "
        f"lowest service {figures['service']:.4f})"
    )
    if demanded is not None and figures["assured"] < demanded:
        said += f"; none assured the service of {demanded:g} that the recipe demands"
    return said


def _is_evaluated(run: RunDirectory, figures: Mapping[str, Any]) -> bool:
    """Whether ``evaluation.json`` is of the same checkpoint and episodes as ``figures``."""
    path = run.path / "evaluation.json"
    try:
        found = json.loads(path.read_text()) if path.is_file() else {}
    except ValueError as error:
        raise RunError(f"{path}: cannot be read: {error}; delete it to evaluate anew") from error
    return all(found.get(name) == figures[name] for name in ("checkpoint", "episodes", "first_seed"))


def draw_run(run: RunDirectory, rollouts: Mapping[str, Rollout], env: MultiAgentVectorEnv) -> list[Path]:
    """Draw the network before and after, λ over time trained against neutral and random, and the learning curves.

    There are no learning curves if no episode ended while training.
    """
    folder = run.path / "pictures"
    folder.mkdir(exist_ok=True)
    network = env.network
    before, after = rollouts["neutral"], rollouts["trained"]
    first, last = ((each.final_stock, each.mean_flow) for each in (before, after))
    labels = ("neutral: mean λ and flows, last stocks", "trained: mean λ and flows, last stocks")
    means = float(before.episode_circularity.mean()), float(after.episode_circularity.mean())
    flows = save_before_after(folder / "flows_before_after.png", network, first, last, labels, means)
    runs = {name: each.circularity_mean for name, each in rollouts.items()}
    services = {name: each.service for name, each in rollouts.items()}
    circularity = save_circularity(folder / "circularity.png", network, interval_ends(network), runs, services)
    curves, metrics = folder / "learning_curves.png", run.metrics()
    curves.unlink(missing_ok=True)
    if not metrics["env_steps"]:
        return [flows, circularity]
    returns = {agent: np.array(metrics[f"return:{agent}"]) for agent in env.agents}
    save_learning_curves(curves, np.array(metrics["env_steps"]), returns)
    return [flows, circularity, curves]
