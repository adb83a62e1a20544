"""What a result looks like, whatever it is of: tables and sentences, a picture, a report for the browser."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from rich.console import Group, RenderableType

from cirl_marl.controllers.schedule import Schedule
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.assessment import Evaluation
from cirl_marl.evaluation.comparison import Comparison
from cirl_marl.evaluation.pareto import ParetoFront
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.report import report_page
from cirl_marl.report.decisions import decisions_table, save_decisions, savings_table
from cirl_marl.report.differences import save_alternatives
from cirl_marl.report.page_html import write_page
from cirl_marl.report.run import draw_circularity, page_of_evaluation
from cirl_marl.report.terminal import evaluation_table
from cirl_marl.report.tradeoffs import comparison_notes, comparison_table, save_comparison, save_pareto
from cirl_marl.report.trajectory import draw_trajectory

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


def draw(path: str | Path, result: Reportable, *, title: str = "") -> Path:
    """Save the picture of a result as a PNG and return its path.

    Args:
        path: where it goes.
        result: of ``simulate`` λ, stocks and flows over time; of ``simulate_alternatives`` what differs most; of
            ``plan`` the levers that differ most from business as usual; of ``compare`` and ``pareto_front`` service
            against circularity; of ``evaluate`` λ over time.
        title: heading; empty for one that names the network.

    Raises:
        CirlError: for a result that has no picture.
    """
    return _of_its_kind(_PICTURES, result, "picture")(Path(path), result, title=title)


def summarise(result: object) -> RenderableType:
    """Return the tables and sentences that the command line shows of a result, for ``rich.print``.

    Args:
        result: what ``plan``, ``compare`` or ``evaluate`` has returned; of anything else its ``str``.
    """
    if isinstance(result, Schedule):
        return Group(decisions_table(result), savings_table(result), str(result))
    if isinstance(result, Comparison):
        return Group(comparison_table(result), *comparison_notes(result))
    if isinstance(result, Evaluation):
        return Group(evaluation_table(result.figures), str(result))
    return str(result)


_PAGES: Mapping[type, Callable[[Any], report_page.ReportPage]] = {
    Simulation: lambda simulation: report_page.page_of_alternatives([simulation]),
    Sequence: report_page.page_of_alternatives,
    Schedule: report_page.page_of_schedule,
    Comparison: report_page.page_of_comparison,
    ParetoFront: report_page.page_of_front,
    Evaluation: page_of_evaluation,
}
_PICTURES: Mapping[type, Callable[..., Path]] = {
    Simulation: draw_trajectory,
    Sequence: save_alternatives,
    Schedule: save_decisions,
    Comparison: save_comparison,
    ParetoFront: save_pareto,
    Evaluation: draw_circularity,
}
Presenter = TypeVar("Presenter")


def _of_its_kind(presenters: Mapping[type, Presenter], result: object, form: str) -> Presenter:
    """Return what presents a result; several simulations are a kind of their own, ``Sequence``."""
    several = isinstance(result, Sequence) and result and all(isinstance(part, Simulation) for part in result)
    kind = Sequence if several else type(result)
    if kind not in presenters:
        raise CirlError(f"there is no {form} of a {type(result).__name__}")
    return presenters[kind]
