"""Training time: the paper's settings against vectorised rollouts, on the same machine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from rich.table import Table

from cirl_marl.learners import load_recipe
from cirl_marl.learners.training import one_torch_thread
from cirl_marl.paper.published import HARDWARE, environment_of
from cirl_marl.paper.results import WINDOW, Row
from cirl_marl.paper.table import number
from cirl_marl.paper.training import Report, Trained, train_published
from cirl_marl.paper.tuned import train_tuned

ENVIRONMENT = "CopperNet"
RECIPES = {"A2C": "independent_a2c", "PPO": "independent_ppo"}


@dataclass(frozen=True, slots=True, kw_only=True)
class Comparison:
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
    published: Trained
    ours: Trained

    @property
    def ratio(self) -> float:
        """How many times as fast a step is in the vectorised run, in processor time."""
        return (self.published.cpu_seconds / self.published.steps) / (self.ours.cpu_seconds / self.ours.steps)


def compare(steps: int, report: Report) -> list[Comparison]:
    """Train A2C and PPO on CopperNet both ways, one after the other."""
    environment = environment_of(ENVIRONMENT)
    found = []
    with one_torch_thread():
        for algorithm, name in RECIPES.items():
            row, recipe = Row(environment=ENVIRONMENT, algorithm=algorithm, steps=steps), load_recipe(name)
            published = train_published(environment, row, report)
            ours = train_tuned(environment, row, report, recipe)
            found.append(
                Comparison(algorithm=algorithm, recipe=name, copies=recipe.run.envs, published=published, ours=ours)
            )
    return found


def speed_table(comparisons: list[Comparison]) -> Table:
    """One row an algorithm: seconds, what was learnt, and the ratio of the times per step."""
    table = Table(title=f"Training time on {ENVIRONMENT}, one CPU core")
    columns = ("algorithm", "published settings", "r_e", "recipe", "vectorised", "r_e", "ratio", f"paper, {HARDWARE}")
    for column in columns:
        table.add_column(column, justify="left" if column in ("algorithm", "recipe") else "right")
    for row in comparisons:
        minutes = environment_of(ENVIRONMENT).runs[row.algorithm].minutes
        table.add_row(
            row.algorithm,
            f"{row.published.seconds:.1f} s, {row.published.steps:,} steps",
            number(float(np.mean(row.published.returns[-WINDOW:]))),
            f"{row.recipe}, {row.copies} copies",
            f"{row.ours.seconds:.1f} s, {row.ours.steps:,} steps",
            number(float(np.mean(row.ours.returns[-WINDOW:]))),
            f"{row.ratio:.1f} ×",
            "" if minutes is None else f"{minutes:.1f} min",
        )
    return table
