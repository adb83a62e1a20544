"""The paper's tables in short: its best figure, ours, the optimum, and the goals that we set ourselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.document import markdown_table
from benchmarks.paper_difference import best_run, difference
from cirl_marl.paper.published import ENVIRONMENTS, PaperEnvironment
from cirl_marl.paper.results import Result
from cirl_marl.paper.table import NOT_RUN, above_optimum, number, over_seeds

COLUMNS = (
    "environment",
    "paper's best r_e",
    "tuned r_e",
    "difference",
    "better",
    "tuned, final policy",
    "optimum",
    "goal of the final policy",
    "met",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Goal:
    """What the mean over the seeds of a tuned recipe shall reach.

    Attributes:
        figure: return of the final policy, or share of its successes in percent.
        least: the least that meets it.
        how: the same in words; empty for the figure itself.
    """

    figure: Literal["return", "success"]
    least: float
    how: str = ""

    def __str__(self) -> str:
        """Write it for a table."""
        figure = f"s ≥ {number(self.least)} %" if self.figure == "success" else f"≥ {number(self.least)}"
        return f"{figure} ({self.how})" if self.how else figure


def _near(name: str, share: float) -> Goal:
    optimum = ENVIRONMENTS[name].optima[0].value
    return Goal(figure="return", least=optimum - share * abs(optimum), how=f"{100 * share:g} % of the optimum")


GOALS: Mapping[str, Goal] = {
    "Reacher": Goal(figure="success", least=95.0),
    "TransportTruck": _near("TransportTruck", 0.01),
    "CO2MicroalgaeMonod": Goal(figure="return", least=143.5),
    "CarboNet": _near("CarboNet", 0.05),
    "CopperNet": _near("CopperNet", 0.01),
    "FetchWasteSorting": Goal(figure="return", least=-9.0),
}
"""By environment; the others shall only be better than the paper's best."""


def summary(results: Sequence[Result]) -> str:
    """Return a Markdown table with a line for each environment."""
    return markdown_table(COLUMNS, (_line(environment, results) for environment in ENVIRONMENTS.values()))


def _line(environment: PaperEnvironment, results: Sequence[Result]) -> tuple[str, ...]:
    best, algorithm = best_run(environment)
    optimum = number(environment.optima[0].value) if environment.optima else "not known"
    goal = GOALS.get(environment.name)
    tuned = [
        result
        for result in results
        if (result.row.environment, result.row.settings, result.row.steps)
        == (environment.name, "tuned", environment.steps)
    ]
    paper = f"{number(best)} ({algorithm}){_chance(environment, [best])}"
    asked = str(goal) if goal is not None else ""
    if not tuned:
        return (environment.name, paper, NOT_RUN, "", "", "", optimum, asked, "")
    end = _returns(environment, [result.end_return for result in tuned])
    played = [result.evaluation for result in tuned if result.evaluation is not None]
    final = _returns(environment, [evaluation.mean for evaluation in played])
    successes = [evaluation.success for evaluation in played if evaluation.success is not None]
    if environment.success_episodes and successes:
        final += f", s {over_seeds(successes)} %"
    met = ""
    if goal is not None:
        reached = successes if goal.figure == "success" else [evaluation.mean for evaluation in played]
        met = _yes(len(reached) == len(tuned) and float(np.mean(reached)) >= goal.least)
    found = difference(environment, tuned, results)
    missing = NOT_RUN if environment.comparable else "not comparable"
    compared = (str(found), found.better) if found is not None else ("", missing)
    return (environment.name, paper, end, *compared, final, optimum, asked, met)


def _returns(environment: PaperEnvironment, found: Sequence[float]) -> str:
    return f"{over_seeds(found)}{_chance(environment, found)}" if found else ""


def _chance(environment: PaperEnvironment, found: Sequence[float]) -> str:
    return ", chance: above the optimum" if above_optimum(environment, float(np.mean(found))) else ""


def _yes(met: bool) -> str:
    return "yes" if met else "no"
