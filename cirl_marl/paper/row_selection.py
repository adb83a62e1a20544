"""Which rows to run, and in which order."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from cirl_marl.definitions.catalogue import recipes
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.paper.published import ALGORITHMS, ENVIRONMENTS, PaperEnvironment, environment_of
from cirl_marl.paper.results import PaperRow

SETTINGS = ("published", "tuned")


def select_rows(
    environment: str | None,
    algorithm: str | None,
    *,
    steps: int | None = None,
    seeds: int = 1,
    settings: str | None = "published",
) -> list[PaperRow]:
    """Return the rows that the names choose; None chooses all, the paper's steps, or both settings.

    Each has the seeds 0, 1, … below ``seeds``.

    Raises:
        CirlError: for a name that does not exist, or a combination that the paper did not run.
    """
    if settings is not None and settings not in SETTINGS:
        raise CirlError(f"--recipe: {unknown_name('settings', settings, SETTINGS)}")
    if environment in ALGORITHMS:
        raise CirlError(f"{environment} is an algorithm, which comes after an environment: {', '.join(ENVIRONMENTS)}")
    if algorithm is not None and algorithm not in ALGORITHMS:
        raise CirlError(unknown_name("algorithm of the paper", algorithm, ALGORITHMS))
    names = [] if settings == "tuned" else [(*run, "published") for run in _published_rows(environment, algorithm)]
    if settings != "published":
        only = environment is not None and settings == "tuned"
        names += [(*run, "tuned") for run in _tuned_rows(environment, algorithm, must_fit=only)]
    if not names:
        raise CirlError(f"there is no tuned recipe agents/paper_*.toml for {environment or algorithm or 'any'}")
    return [
        PaperRow(environment=target.name, algorithm=name, settings=kind, steps=steps or target.steps, seed=seed)
        for target, name, kind in names
        for seed in range(seeds)
    ]


def _environments(name: str | None) -> list[PaperEnvironment]:
    return list(ENVIRONMENTS.values()) if name is None else [environment_of(name)]


def _published_rows(environment: str | None, algorithm: str | None) -> Iterator[tuple[PaperEnvironment, str]]:
    for rows in _environments(environment):
        if environment is not None and algorithm not in (None, *rows.runs):
            raise CirlError(f"the paper did not run {algorithm} on {rows.name}; it ran {', '.join(rows.runs)}")
        yield from ((rows, name) for name in rows.runs if algorithm in (None, name))


def _tuned_rows(
    environment: str | None, algorithm: str | None, *, must_fit: bool
) -> Iterator[tuple[PaperEnvironment, str]]:
    """Yield what there are tuned recipes for, with the algorithms that these use."""
    from cirl_marl.learners.recipe import load_recipe

    for rows in _environments(environment):
        if (name := tuned_recipe(rows.name)) is not None:
            learner = load_recipe(name).learner.algorithm + ("-HER" if rows.has_goals else "")
            if algorithm in (None, learner):
                yield rows, learner
            elif must_fit:
                raise CirlError(f"the tuned recipe '{name}' uses {learner}, not {algorithm}")


def minutes(row: PaperRow) -> float:
    """Guess how long a row takes: as long as it took the authors, of a tuned one two minutes."""
    environment = environment_of(row.environment)
    reference = environment.runs.get(row.algorithm)
    whole = 2.0 if row.settings == "tuned" else (reference.minutes if reference else None) or 40.0
    return whole * row.steps / environment.steps


def overview(rows: Sequence[PaperRow], rest: Sequence[PaperRow]) -> str:
    """Say how many rows there are, how many of them are done, and how long those that are ``rest`` may take.

    >>> rows = [PaperRow(environment="Reacher", algorithm=name, steps=100_000, seed=0) for name in ("SAC", "PPO")]
    >>> overview(rows, rows[:1])
    "rows: 2, done: 1, to go by the paper's training times: 22 min"
    """
    to_go = sum(map(minutes, rest))
    takes = f"{to_go:.0f} min" if to_go < 120 else f"{to_go / 60:.0f} h"
    done = f"rows: {len(rows)}, done: {len(rows) - len(rest)}"
    return f"{done}, to go by the paper's training times: {takes}" if rest else done


def tuned_recipe(environment: str) -> str | None:
    """Return the name of the catalogue's recipe for an environment of the paper, ``paper_…``; None if there is none."""
    key = environment.lower()
    return next((name for name in recipes() if name.replace("_", "") == f"paper{key}"), None)
