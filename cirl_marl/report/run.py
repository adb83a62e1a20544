"""An evaluated training run: its page for the browser and its pictures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np

from cirl_marl.controllers.rollout import interval_ends
from cirl_marl.drawing.digraph import save_before_after
from cirl_marl.evaluation.assessment import CONTROLLERS, Evaluation
from cirl_marl.report.curves import save_circularity, save_learning_curves
from cirl_marl.report.explanations import read_reasons
from cirl_marl.report.report_page import ReportPage, add_plan, page_of_comparison


def page_of_evaluation(evaluation: Evaluation, progress: Callable[[float], None] = lambda share: None) -> ReportPage:
    """Return the page of a run: business as usual, the policies, and the plan of the bound, which is solved here.

    Reasons are on it if they were found of the checkpoint that acts; else it says how to find them. ``progress`` is
    called with the share of the plan that is done.
    """
    run, comparison = evaluation.run, evaluation.comparison
    page = page_of_comparison(comparison, without=CONTROLLERS[1:])
    reasons, advice = read_reasons(run, comparison.entries[0].checkpoint)
    notes = (*page.notes, f"{advice}.") if advice else page.notes
    return add_plan(replace(page, reasons=reasons, notes=notes), comparison, run.make_env(1), progress)


def draw_run(evaluation: Evaluation) -> list[Path]:
    """Draw the network before and after, λ over time trained against neutral and random, and the learning curves.

    There are no learning curves if no episode ended while training.
    """
    run, env, rollouts = evaluation.run, evaluation.env, evaluation.rollouts
    folder = run.path / "pictures"
    folder.mkdir(exist_ok=True)
    network = env.network
    before, after = rollouts["neutral"], rollouts["trained"]
    first, last = ((rollout.final_stock, rollout.mean_flow) for rollout in (before, after))
    labels = ("neutral: mean λ and flows, last stocks", "trained: mean λ and flows, last stocks")
    means = float(before.episode_circularity.mean()), float(after.episode_circularity.mean())
    flows = save_before_after(folder / "flows_before_after.png", network, first, last, labels, means)
    circularity = draw_circularity(folder / "circularity.png", evaluation)
    curves, metrics = folder / "learning_curves.png", run.metrics()
    curves.unlink(missing_ok=True)
    if not metrics["env_steps"]:
        return [flows, circularity]
    returns = {agent: np.array(metrics[f"return:{agent}"]) for agent in env.agents}
    save_learning_curves(curves, np.array(metrics["env_steps"]), returns)
    return [flows, circularity, curves]


def draw_circularity(path: Path, evaluation: Evaluation, *, title: str = "") -> Path:
    """Save λ and service level over time, trained beside neutral and random control, as a PNG; return its path."""
    network, rollouts = evaluation.env.network, evaluation.rollouts
    means = {name: rollout.circularity_mean for name, rollout in rollouts.items()}
    services = {name: rollout.service for name, rollout in rollouts.items()}
    return save_circularity(path, network, interval_ends(network), means, services)
