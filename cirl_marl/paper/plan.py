"""Which rows to run, and in which order."""

from __future__ import annotations

from collections.abc import Sequence

from cirl_marl.definitions.catalogue import recipes
from cirl_marl.errors import CirlError, unknown
from cirl_marl.paper.published import ALGORITHMS, BOX_ALGORITHMS, ENVIRONMENTS, GOAL_ALGORITHMS, chosen, environment_of
from cirl_marl.paper.results import Row

RECIPES = ("published", "tuned")
FAST = ("ARS", "PPO", "A2C")
"""Learners that take minutes; the others take half an hour and more."""


def planned(
    environment: str | None,
    algorithm: str | None,
    *,
    steps: int | None = None,
    seeds: int = 1,
    recipe: str | None = "published",
) -> list[Row]:
    """Return the rows that the names choose.

    Args:
        environment: name in the paper; None chooses all eight.
        algorithm: name in the paper; None chooses all that it ran there.
        steps: environment steps of each row; None takes the paper's.
        seeds: seeds 0, 1, … of each row.
        recipe: ``published``, ``tuned``, or None for both.

    Raises:
        CirlError: for a name that does not exist, or a combination that the paper did not run.
    """
    if recipe is not None and recipe not in RECIPES:
        raise CirlError(f"--settings: {unknown('settings', recipe, RECIPES)}")
    if environment in ALGORITHMS:
        raise CirlError(f"{environment} is an algorithm, which comes after an environment: {', '.join(ENVIRONMENTS)}")
    if algorithm is not None and algorithm not in ALGORITHMS:
        raise CirlError(unknown("algorithm of the paper", algorithm, ALGORITHMS))
    rows = []
    if recipe != "tuned":
        rows += [
            Row(environment=found.name, algorithm=name, steps=steps or found.steps, seed=seed)
            for found, name in chosen(environment, algorithm)
            for seed in range(seeds)
        ]
    if recipe != "published":
        rows += _tuned(environment, algorithm, steps, seeds, must_exist=recipe == "tuned")
    if not rows:
        raise CirlError(f"there is no tuned recipe agents/paper_*.toml for {environment or algorithm or 'any'}")
    return rows


def study(*, steps: int | None = None, seeds: int | None = None, recipe: str | None = None) -> list[Row]:
    """Return every row of the paper's tables: fast learners with three seeds first, then tuned, slow and goal learners.

    A seed comes to its end on every environment before the next begins, so that the tables fill evenly.
    """
    rows = planned(None, None, steps=steps, seeds=seeds or 3, recipe=recipe)
    groups = (*FAST, *(name for name in BOX_ALGORITHMS if name not in FAST), *GOAL_ALGORITHMS)

    def order(row: Row) -> tuple[int, int, int]:
        slow = row.algorithm not in FAST and row.recipe == "published"
        stage = 1 if row.recipe == "tuned" else 2 * slow
        return stage, row.seed, groups.index(row.algorithm) if row.recipe == "published" else 0

    wanted = [row for row in rows if row.recipe == "tuned" or row.algorithm in FAST or row.seed < (seeds or 1)]
    return sorted(wanted, key=order)


def minutes(row: Row) -> float:
    """Guess how long a row takes: as long as it took the authors, of a tuned one two minutes."""
    environment = environment_of(row.environment)
    published = environment.runs.get(row.algorithm)
    whole = 2.0 if row.recipe == "tuned" else (published.minutes if published else None) or 40.0
    return whole * row.steps / environment.steps


def overview(rows: Sequence[Row], left: Sequence[Row]) -> str:
    """Say how many rows there are, how many of them are done, and how long those that are ``left`` may take.

    >>> rows = [Row(environment="Reacher", algorithm=name, steps=100_000, seed=0) for name in ("SAC", "PPO")]
    >>> overview(rows, rows[:1])
    "rows: 2, done: 1, to go by the paper's training times: 22 min"
    """
    to_go = sum(map(minutes, left))
    takes = f"{to_go:.0f} min" if to_go < 120 else f"{to_go / 60:.0f} h"
    done = f"rows: {len(rows)}, done: {len(rows) - len(left)}"
    return f"{done}, to go by the paper's training times: {takes}" if left else done


def tuned_recipe(environment: str) -> str | None:
    """Return the name of the catalogue's recipe for an environment of the paper, ``paper_…``; None if there is none."""
    key = environment.lower()
    return next((name for name in recipes() if name.replace("_", "") == f"paper{key}"), None)


def _tuned(
    environment: str | None, algorithm: str | None, steps: int | None, seeds: int, *, must_exist: bool
) -> list[Row]:
    from cirl_marl.learners.recipe import load_recipe

    rows = []
    for found in [environment_of(environment)] if environment is not None else ENVIRONMENTS.values():
        name = tuned_recipe(found.name)
        if name is None:
            if must_exist and environment is not None:
                raise CirlError(f"there is no tuned recipe agents/paper_*.toml for {environment}")
            continue
        learner = load_recipe(name).learner.algorithm + ("-HER" if found.has_goals else "")
        if algorithm not in (None, learner):
            if must_exist and environment is not None:
                raise CirlError(f"the tuned recipe '{name}' uses {learner}, not {algorithm}")
            continue
        rows += [
            Row(environment=found.name, algorithm=learner, recipe="tuned", steps=steps or found.steps, seed=seed)
            for seed in range(seeds)
        ]
    return rows
