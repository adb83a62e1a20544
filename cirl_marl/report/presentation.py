"""What a result looks like, whatever it is of: tables and sentences, a picture, a report for the browser."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from rich.console import Group, RenderableType

from cirl_marl.controllers.schedule import Schedule
from cirl_marl.drawing.digraph import save_before_after
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.assessment import Evaluation
from cirl_marl.evaluation.comparison import Comparison
from cirl_marl.evaluation.levers import Levers
from cirl_marl.evaluation.pareto import ParetoFront
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.report import report_page
from cirl_marl.report.curves import save_circularity, save_learning_curves, save_trajectory
from cirl_marl.report.decisions import decisions_table, save_decisions, savings_table
from cirl_marl.report.differences import save_alternatives
from cirl_marl.report.lever_chart import levers_table, save_levers
from cirl_marl.report.page_html import write_page
from cirl_marl.report.terminal import evaluation_table
from cirl_marl.report.tradeoffs import comparison_notes, comparison_table, save_comparison, save_pareto

Reportable = Simulation | Sequence[Simulation] | Schedule | Comparison | ParetoFront | Evaluation
"""What ``simulate``, ``simulate_alternatives``, ``plan``, ``compare``, ``pareto_front`` and ``evaluate`` return."""


def write_report(path: str | Path, result: Reportable) -> Path:
    """Write a report for the browser and return its path: one HTML file, which needs no server.

    Args:
        path: an .html file; missing folders are made.
        result: what ``simulate``, ``simulate_alternatives``, ``plan``, ``compare``, ``pareto_front`` or ``evaluate``
            has returned. Of an evaluation the plan of the bound is solved for it, which may take minutes.

    Raises:
        CirlError: for a path without .html, or a result that has no report.
    """
    path = Path(path)
    if path.suffix != ".html":
        raise CirlError(f"{path}: a report needs the name of an .html file")
    return write_page(path, _of_its_kind(_PAGES, result, "report")(result))


def draw(path: str | Path, result: Reportable | Levers, *, title: str = "") -> Path:
    """Save the picture of a result as a PNG and return its path.

    Args:
        path: where it goes.
        result: of ``simulate`` λ, stocks and flows over time; of ``simulate_alternatives`` what differs most; of
            ``plan`` the levers that differ most from business as usual; of ``levers`` what each brings; of ``compare``
            and ``pareto_front`` service against circularity; of ``evaluate`` λ over time.
        title: heading; empty for one that names the network.

    Raises:
        CirlError: for a result that has no picture.
    """
    return _of_its_kind(_PICTURES, result, "picture")(Path(path), result, title=title)


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
    return save_circularity(path, evaluation.env.network, evaluation.rollouts, title=title)


def summarise(result: object) -> RenderableType:
    """Return the tables and sentences that the command line shows of a result, for ``rich.print``.

    Args:
        result: what ``plan``, ``compare``, ``levers`` or ``evaluate`` has returned; of anything else its ``str``.
    """
    if isinstance(result, Schedule):
        return Group(decisions_table(result), savings_table(result), str(result))
    if isinstance(result, Comparison):
        return Group(comparison_table(result), *comparison_notes(result))
    if isinstance(result, Levers):
        return levers_table(result)
    if isinstance(result, Evaluation):
        return Group(evaluation_table(result.figures), str(result))
    return str(result)


_PAGES: Mapping[type, Callable[[Any], report_page.ReportPage]] = {
    Simulation: lambda simulation: report_page.page_of_alternatives([simulation]),
    Sequence: report_page.page_of_alternatives,
    Schedule: report_page.page_of_schedule,
    Comparison: report_page.page_of_comparison,
    ParetoFront: report_page.page_of_front,
    Evaluation: report_page.page_of_evaluation,
}
_PICTURES: Mapping[type, Callable[..., Path]] = {
    Simulation: save_trajectory,
    Sequence: save_alternatives,
    Schedule: save_decisions,
    Comparison: save_comparison,
    Levers: save_levers,
    ParetoFront: save_pareto,
    Evaluation: draw_circularity,
}
Presenter = TypeVar("Presenter")


def _of_its_kind(presenters: Mapping[type, Presenter], result: object, form: str) -> Presenter:
    """Return what presents a result; several simulations are a kind of their own, ``Sequence``."""
    is_list = isinstance(result, Sequence) and result and all(isinstance(part, Simulation) for part in result)
    kind = Sequence if is_list else type(result)
    if kind not in presenters:
        raise CirlError(f"there is no {form} of a {type(result).__name__}")
    return presenters[kind]
