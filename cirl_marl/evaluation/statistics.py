"""Means with confidence intervals: over episodes, and over training seeds.

Results of few training seeds are reported as the interquartile mean (IQM) with stratified bootstrap intervals: the
quarter of lowest and the quarter of highest scores are left out, which is steadier than the mean and sees more than the
median; seeds are resampled within each network, the stratum. Such intervals are meant to hold the true figure 95 times
in 100; of five normal scores on one network they hold it some 90 times, of ten 93 times.

References: Agarwal et al. 2021, Deep Reinforcement Learning at the Edge of the Statistical Precipice (rliable).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from cirl_marl.errors import CirlError
from cirl_marl.network import Floats

ENOUGH_SEEDS = 5
"""Fewest training seeds whose interval is reported without a mark."""
TRIM_SHARE = 0.25
"""Share of the scores that the interquartile mean leaves out at either end."""
RESAMPLES = 10_000
WORST, TAIL_RESAMPLES = 0.05, 1000
"""Share of the episodes that count as the worst, and resamples of what is said of them."""


@dataclass(frozen=True, slots=True)
class Aggregate:
    """A figure with the ends of its 95 % confidence interval, which are NaN if there is none."""

    value: float
    low: float
    high: float

    def as_dict(self) -> dict[str, float | None]:
        """Return the three numbers by name; None stands for one that is not defined."""
        return {name: finite_or_none(getattr(self, name)) for name in ("value", "low", "high")}


SHARE = (0.0, 1.0)
"""Within which a service level lies."""


def over_episodes(samples: Floats, within: tuple[float, float] = (-np.inf, np.inf)) -> Aggregate:
    """Return the mean of independent episodes with its interval (Student's t); a single one has no interval.

    The interval ends where what is measured does, ``within`` (lowest, highest).

    >>> found = over_episodes(np.array([1.0, 2.0, 3.0]))
    >>> f"{found.value:.1f} [{found.low:.1f}, {found.high:.1f}]"
    '2.0 [-0.5, 4.5]'
    """
    samples = np.asarray(samples, dtype=float)
    mean = float(samples.mean())
    if len(samples) < 2:
        return Aggregate(mean, float("nan"), float("nan"))
    error = float(samples.std(ddof=1)) / np.sqrt(len(samples))
    half_width = float(stats.t.ppf(0.975, len(samples) - 1) * error)
    low, high = within
    return Aggregate(mean, max(mean - half_width, min(low, mean)), min(mean + half_width, max(high, mean)))


def worst_mean(samples: ArrayLike) -> Aggregate:
    """Return the mean of the worst 5 % of independent episodes (CVaR), those with the lowest figures.

    Of n episodes the lowest 0.05·n count, the last of them with the fraction that is left. The interval is that of the
    percentile bootstrap; a single episode has none.

    References: Rockafellar and Uryasev 2002, Conditional value-at-risk for general loss distributions.

    >>> round(worst_mean(np.arange(50.0)).value, 12)
    0.8
    """
    figures = np.sort(np.asarray(samples, dtype=float))
    count = len(figures)
    tail = WORST * count
    # the k lowest weigh 1 each, the next what is left of 0.05·n
    weights = np.clip(tail - np.arange(count), 0.0, 1.0) / tail if tail >= 1 else np.eye(count)[0]
    value = float(figures @ weights)
    if count < 2:
        return Aggregate(value, float("nan"), float("nan"))
    picks = np.random.default_rng(0).integers(count, size=(TAIL_RESAMPLES, count))
    low, high = np.quantile(np.sort(figures[picks], axis=1) @ weights, (0.025, 0.975)).tolist()
    return Aggregate(value, low, high)


def interquartile_mean(scores: ArrayLike) -> float:
    """Return the mean of all scores but the lowest and the highest quarter, each rounded down to whole scores.

    >>> interquartile_mean([0.0, 1.0, 2.0, 3.0, 100.0])
    2.0
    """
    return float(stats.trim_mean(np.asarray(scores, dtype=float).ravel(), TRIM_SHARE))


def over_seeds(scores: Sequence[ArrayLike], *, resamples: int = RESAMPLES, seed: int = 0) -> Aggregate:
    """Return the interquartile mean of scores of training seeds with its stratified percentile bootstrap interval.

    Of each network there is one score a seed. Scores of different networks must be on one scale, such as a gain or a
    gap. A single seed has no interval.

    Raises:
        CirlError: if there are no scores, or a network has another number of seeds than the first.
    """
    strata = [np.asarray(sample, dtype=float) for sample in scores]
    seeds = strata[0].size if strata else 0
    if not seeds or any(sample.shape != (seeds,) for sample in strata):
        raise CirlError(f"scores must be one sequence for each network, equally long; got {[s.shape for s in strata]}")
    value = interquartile_mean(strata)
    if seeds == 1 or not np.isfinite(value):
        return Aggregate(value, float("nan"), float("nan"))
    rng = np.random.default_rng(seed)
    resampling = stats.bootstrap(
        strata, _joint_mean, n_resamples=resamples, vectorized=True, method="percentile", rng=rng
    )
    interval = resampling.confidence_interval
    return Aggregate(value, float(interval.low), float(interval.high))


def finite_or_none(value: float) -> float | None:
    """Return a number as JSON has it: None if it is not finite."""
    return float(value) if np.isfinite(value) else None


def _joint_mean(*strata: Floats, axis: int = -1) -> Floats:
    return np.asarray(stats.trim_mean(np.concatenate(strata, axis=axis), TRIM_SHARE, axis=axis))
