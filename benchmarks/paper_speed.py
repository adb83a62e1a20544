"""Training time: the paper's settings against vectorised rollouts, on the same machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from benchmarks.document import markdown_table
from cirl_marl.learners.recipe import load_recipe
from cirl_marl.learners.trainer import one_torch_thread
from cirl_marl.paper.published import HARDWARE, environment_of
from cirl_marl.paper.results import WINDOW, PaperRow
from cirl_marl.paper.table import number
from cirl_marl.paper.training import Report, TrainingRecord, train_published, train_tuned

ENVIRONMENT = "CopperNet"
RECIPES = (("A2C", "independent_a2c"), ("PPO", "independent_ppo"), ("PPO", "paper_copper_net"))
"""Algorithm and recipe: those that learners have by default, and the one that is tuned for the result."""
GOAL = 10.0
COLUMNS = (
    "algorithm",
    "published settings",
    "ours",
    "wall time",
    "processor time",
    "goal",
    "met",
    f"paper, {HARDWARE}",
)


@dataclass(frozen=True, slots=True, kw_only=True)
class Timing:
    """One algorithm, trained both ways for as many environment steps.

    Attributes:
        algorithm: which.
        recipe: of the vectorised run.
        copies: of the environment in the vectorised run.
        published: the run with the paper's settings.
        ours: the vectorised run.
    """

    algorithm: str
    recipe: str
    copies: int
    published: TrainingRecord
    ours: TrainingRecord

    @property
    def wall_ratio(self) -> float:
        """How many times as fast a step is in the vectorised run, in wall time, which other work lengthens."""
        return (self.published.seconds / self.published.steps) / (self.ours.seconds / self.ours.steps)

    @property
    def ratio(self) -> float:
        """The same in processor time."""
        return (self.published.cpu_seconds / self.published.steps) / (self.ours.cpu_seconds / self.ours.steps)


def compare(steps: int, report: Report) -> list[Timing]:
    """Train A2C and PPO on CopperNet both ways, one after the other."""
    environment = environment_of(ENVIRONMENT)
    published: dict[str, TrainingRecord] = {}
    found = []
    with one_torch_thread():
        for algorithm, name in RECIPES:
            row, recipe = PaperRow(environment=ENVIRONMENT, algorithm=algorithm, steps=steps), load_recipe(name)
            if algorithm not in published:
                published[algorithm] = train_published(environment, row, report)
            ours = train_tuned(environment, row, report, recipe)
            found.append(
                Timing(
                    algorithm=algorithm,
                    recipe=name,
                    copies=recipe.run.envs,
                    published=published[algorithm],
                    ours=ours,
                )
            )
    return found


def speed_table(timings: list[Timing]) -> str:
    """Return a Markdown table: seconds, what was learnt, and how many times as fast a step is."""
    return markdown_table(COLUMNS, map(_line, timings))


def _line(row: Timing) -> tuple[str, ...]:
    minutes = environment_of(ENVIRONMENT).runs[row.algorithm].minutes
    return (
        row.algorithm,
        _run(row.published),
        f"`{row.recipe}`, {row.copies} copies: {_run(row.ours)}",
        f"{row.wall_ratio:.1f} ×",
        f"{row.ratio:.1f} ×",
        f"≥ {GOAL:g} ×",
        "yes" if min(row.wall_ratio, row.ratio) >= GOAL else "no",
        "" if minutes is None else f"{minutes:.1f} min",
    )


def _run(trained: TrainingRecord) -> str:
    end = float(np.mean(trained.returns[-WINDOW:]))
    return (
        f"{trained.seconds:.1f} s ({trained.cpu_seconds:.1f} s processor), {trained.steps:,} steps, r_e {number(end)}"
    )
