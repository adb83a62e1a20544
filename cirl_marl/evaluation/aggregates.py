"""Scores of many runs on many tasks in a few figures, with stratified bootstrap intervals, and performance profiles.

Scores are of shape (tasks, seeds) and on one scale, on which 1 is the best possible. In every resample the seeds of
each task are drawn anew, with replacement; intervals are 95 % percentiles.

References: Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice (rliable).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from cirl_marl.errors import CirlError
from cirl_marl.evaluation.statistics import TRIM_SHARE, Aggregate
from cirl_marl.network import Floats

RESAMPLES = 2000
ENDS = (0.025, 0.975)
Statistic = Callable[[Floats], Floats]
"""Takes scores of shape (..., tasks, seeds), returns figures of shape (...)."""


STATISTICS: Mapping[str, Statistic] = {
    "IQM": lambda scores: np.asarray(stats.trim_mean(scores.reshape(*scores.shape[:-2], -1), TRIM_SHARE, axis=-1)),
    "median": lambda scores: np.median(scores.mean(axis=-1), axis=-1),
    "mean": lambda scores: scores.mean(axis=(-2, -1)),
    "optimality gap": lambda scores: 1.0 - np.minimum(scores, 1.0).mean(axis=(-2, -1)),
}
"""Interquartile mean of all runs; median and mean over tasks of means over seeds; what runs lack to a score of 1."""


def aggregate(scores: ArrayLike, *, resamples: int = RESAMPLES) -> dict[str, Aggregate]:
    """Return the figures of STATISTICS by name.

    >>> found = aggregate([[0.0, 0.5], [0.5, 1.0]])
    >>> {name: figure.value for name, figure in found.items()}
    {'IQM': 0.5, 'median': 0.5, 'mean': 0.5, 'optimality gap': 0.5}

    Raises:
        CirlError: if scores are no table of finite numbers.
    """
    table = _table(scores)
    samples = _resample(table, np.random.default_rng(0), resamples)
    return {name: _interval(statistic(table), statistic(samples)) for name, statistic in STATISTICS.items()}


def probability_of_improvement(scores: ArrayLike, other_scores: ArrayLike) -> Aggregate:
    """Return the probability that a run has a higher score than one of another algorithm, on a task at random.

    P(X > Y) + P(X = Y)/2 of all pairs of seeds (Mann and Whitney), as a mean over tasks.

    >>> probability_of_improvement([[1.0, 0.0]], [[0.5, 0.5]]).value
    0.5

    Raises:
        CirlError: if scores are no tables of finite numbers, or have other numbers of tasks.
    """
    first, second = _table(scores), _table(other_scores)
    if len(first) != len(second):
        raise CirlError(f"scores are of {len(first)} and of {len(second)} tasks; give the same tasks of both")
    rng = np.random.default_rng(0)
    samples = _improvement(_resample(first, rng), _resample(second, rng))
    return _interval(_improvement(first, second), samples)


def performance_profile(scores: ArrayLike, thresholds: ArrayLike) -> tuple[Floats, Floats, Floats]:
    """Return the share of runs whose score is at least each threshold, and the ends of its interval.

    Each is of shape (thresholds,).

    >>> performance_profile([[0.25, 0.75]], [0.0, 0.5, 1.0])[0].tolist()
    [1.0, 0.5, 0.0]

    Raises:
        CirlError: if scores are no table of finite numbers.
    """
    table, levels = _table(scores), np.asarray(thresholds, dtype=float)
    profile = partial(_share_above, levels)
    samples = profile(_resample(table, np.random.default_rng(0)))
    low, high = np.quantile(samples, ENDS, axis=0)
    return profile(table), low, high


def _share_above(levels: Floats, scores: Floats) -> Floats:
    """Return the share of runs with at least each level, shape (..., levels)."""
    return np.stack([(scores >= level).mean(axis=(-2, -1)) for level in levels], axis=-1)


def _improvement(scores: Floats, rival_scores: Floats) -> Floats:
    difference = scores[..., :, None] - rival_scores[..., None, :]
    return np.asarray((0.5 + 0.5 * np.sign(difference)).mean(axis=(-3, -2, -1)))


def _table(scores: ArrayLike) -> Floats:
    table = np.asarray(scores, dtype=float)
    if table.ndim != 2 or not table.size or not np.isfinite(table).all():
        raise CirlError(f"scores must be finite, of shape (tasks, seeds); got shape {table.shape}")
    return table


def _resample(scores: Floats, rng: np.random.Generator, resamples: int = RESAMPLES) -> Floats:
    """Return scores with the seeds of each task drawn anew, shape (resamples, tasks, seeds)."""
    picks = rng.integers(scores.shape[1], size=(resamples, *scores.shape))
    return np.asarray(np.take_along_axis(scores[None], picks, axis=2))


def _interval(value: Floats, samples: Floats) -> Aggregate:
    low, high = np.quantile(samples, ENDS).tolist()
    return Aggregate(float(value), low, high)
