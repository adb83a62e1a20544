"""How much more tuned recipes return than the paper's best run, and whether that is more than chance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cirl_marl.paper.published import PaperEnvironment
from cirl_marl.paper.results import WINDOW, Result
from cirl_marl.paper.table import number

ERRORS = 2.0
"""Standard errors that a difference must exceed; chance alone exceeds two about once in twenty times."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Difference:
    """What tuned recipes return more than the paper's best run, with ``ERRORS`` standard errors of that."""

    value: float
    error: float

    def __str__(self) -> str:
        """Write it for a table."""
        return f"{number(self.value)} ± {number(self.error)}"

    @property
    def better(self) -> str:
        """Say whether the recipes are better."""
        if abs(self.value) <= self.error:
            return "within its error"
        return "yes" if self.value > 0 else "no"


def best_run(environment: PaperEnvironment) -> tuple[float, str]:
    """Return the paper's best r_e, and the algorithm."""
    return max((run.end_return, name) for name, run in environment.runs.items() if run.end_return is not None)


def difference(environment: PaperEnvironment, tuned: Sequence[Result], results: Sequence[Result]) -> Difference | None:
    """Compare r_e, or what final policies return where the published class ends its episodes otherwise.

    A run varies by the standard deviation over seeds, or by σ/√n of its n episodes, σ being that of one episode of the
    tuned policies; by whichever is more, as three seeds say little about a spread. A mean over k runs varies 1/√k as
    much. The paper's figure is of one run: it is taken to vary as ours do, or as those of its algorithm in ``results``
    do, by whichever is more.

    Returns:
        None where nothing can be compared.
    """
    best, algorithm = best_run(environment)
    played = [result.published_ends if environment.published_ends else result.evaluation for result in tuned]
    final = [evaluation for evaluation in played if evaluation is not None]
    if environment.published_ends:
        ours, episodes = [evaluation.mean for evaluation in final], [evaluation.episodes for evaluation in final]
    else:
        ours, episodes = [result.end_return for result in tuned], [result.window for result in tuned]
    if not ours or not environment.comparable:
        return None
    one = float(np.mean([evaluation.deviation for evaluation in final])) if final else 0.0
    again = [result.end_return for result in results if _repeats(result, environment, algorithm)]
    run = max(_over_seeds(ours), one / math.sqrt(min(episodes)))
    theirs = max(run, _over_seeds(again), one / math.sqrt(WINDOW))
    error = math.hypot(run / math.sqrt(len(ours)), theirs)
    return Difference(value=float(np.mean(ours)) - best, error=ERRORS * error)


def _repeats(result: Result, environment: PaperEnvironment, algorithm: str) -> bool:
    """Return whether this is the paper's run done here, with as many steps and to the end."""
    row, wanted = result.row, (environment.name, algorithm, "published", environment.steps)
    return (row.environment, row.algorithm, row.settings, row.steps) == wanted and not result.has_diverged


def _over_seeds(figures: Sequence[float]) -> float:
    return float(np.std(figures, ddof=1)) if len(figures) > 1 else 0.0
