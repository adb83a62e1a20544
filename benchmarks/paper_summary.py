"""The paper's tables in short: its best figure, ours, the optimum, and the goals that we set ourselves."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from benchmarks.document import markdown_table
from cirl_marl.paper.published import ENVIRONMENTS, PaperEnvironment
from cirl_marl.paper.results import Result
from cirl_marl.paper.table import NOT_RUN, number, over_seeds

COLUMNS = (
    "environment",
    "paper's best r_e",
    "tuned r_e",
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
    ends = {run.end_return: name for name, run in environment.runs.items() if run.end_return is not None}
    best = max(ends)
    optimum = number(environment.optima[0].value) if environment.optima else "not known"
    goal = GOALS.get(environment.name)
    tuned = [
        result
        for result in results
        if (result.row.environment, result.row.settings, result.row.steps)
        == (environment.name, "tuned", environment.steps)
    ]
    paper, asked = f"{number(best)} ({ends[best]})", str(goal) if goal is not None else ""
    if not tuned:
        return (environment.name, paper, NOT_RUN, "", "", optimum, asked, "")
    end = [result.end_return for result in tuned]
    played = [result.evaluation for result in tuned if result.evaluation is not None]
    final = over_seeds([evaluation.mean for evaluation in played]) if played else ""
    successes = [evaluation.success for evaluation in played if evaluation.success is not None]
    if environment.success_episodes and successes:
        final += f", s {over_seeds(successes)} %"
    met = ""
    if goal is not None:
        reached = successes if goal.figure == "success" else [evaluation.mean for evaluation in played]
        met = _yes(len(reached) == len(tuned) and float(np.mean(reached)) >= goal.least)
    better = _better(environment, best, tuned)
    return (environment.name, paper, over_seeds(end), better, final, optimum, asked, met)


def _better(environment: PaperEnvironment, best: float, tuned: Sequence[Result]) -> str:
    """Compare r_e, or what final policies return where the published class ends its episodes otherwise."""
    if not environment.comparable:
        return "not comparable"
    if not environment.published_ends:
        return _yes(float(np.mean([result.end_return for result in tuned])) > best)
    played = [result.published_ends.mean for result in tuned if result.published_ends is not None]
    return _yes(float(np.mean(played)) > best) if played else NOT_RUN


def _yes(met: bool) -> str:
    return "yes" if met else "no"
