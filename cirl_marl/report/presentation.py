"""What a result looks like, whatever it is of: tables and sentences, a picture, a report for the browser."""

from __future__ import annotations

from collections.abc import Sequence
from functools import singledispatch
from pathlib import Path

from rich.console import Group, RenderableType

from cirl_marl.controllers.schedule import Schedule
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.assessment import Evaluation
from cirl_marl.evaluation.compared_quantities import rank_quantities
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
    return write_page(path, _page(result))


@singledispatch
def _page(result: object) -> report_page.ReportPage:
    if isinstance(result, Sequence) and result and all(isinstance(simulation, Simulation) for simulation in result):
        return report_page.page_of_alternatives(result)
    raise CirlError(f"there is no report of a {type(result).__name__}")


_page.register(Schedule, report_page.page_of_schedule)
_page.register(Comparison, report_page.page_of_comparison)
_page.register(ParetoFront, report_page.page_of_front)
_page.register(Evaluation, page_of_evaluation)
_page.register(Simulation, lambda simulation: report_page.page_of_alternatives([simulation]))


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
    return _draw(result, Path(path), title)


@singledispatch
def _draw(result: object, path: Path, title: str) -> Path:
    if isinstance(result, Sequence) and result and all(isinstance(simulation, Simulation) for simulation in result):
        return save_alternatives(path, result, rank_quantities(result), title=title or result[0].network.name)
    raise CirlError(f"there is no picture of a {type(result).__name__}")


@_draw.register
def _(result: Simulation, path: Path, title: str) -> Path:
    return draw_trajectory(path, result, title or f"{result.network.title or result.network.name}, {result.control}")


@_draw.register
def _(result: Schedule, path: Path, title: str) -> Path:
    return save_decisions(path, result, title=title or result.network.title or result.network.name)


@_draw.register
def _(result: Comparison, path: Path, title: str) -> Path:
    return save_comparison(path, result, title=title)


@_draw.register
def _(result: ParetoFront, path: Path, title: str) -> Path:
    return save_pareto(path, result, title=title)


@_draw.register
def _(result: Evaluation, path: Path, title: str) -> Path:
    del title
    return draw_circularity(path, result)


@singledispatch
def summarise(result: object) -> RenderableType:
    """Return the tables and sentences that the command line shows of a result, for ``rich.print``.

    Args:
        result: what ``plan``, ``compare`` or ``evaluate`` has returned; of anything else its ``str``.
    """
    return str(result)


@summarise.register
def _(result: Schedule) -> RenderableType:
    return Group(decisions_table(result), savings_table(result), str(result))


@summarise.register
def _(result: Comparison) -> RenderableType:
    return Group(comparison_table(result), *comparison_notes(result))


@summarise.register
def _(result: Evaluation) -> RenderableType:
    return Group(evaluation_table(result.figures), str(result))
