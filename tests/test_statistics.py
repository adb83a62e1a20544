"""Interquartile means and bootstrap intervals against closed forms and simulated coverage."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from cirl_marl.evaluation.statistics import interquartile_mean, over_episodes, over_seeds


def test_intervals_end_where_the_figure_does() -> None:
    """A share has no interval beyond 0 and 1, and rounding does not move a mean out of its own interval."""
    found = over_episodes(np.array([0.9, 1.0]), (0.0, 1.0))
    assert found.value == pytest.approx(0.95)
    assert found.high == 1.0
    assert 0.0 < found.low < 0.95
    assert over_episodes(np.array([0.1, 0.9]), (0.0, 1.0)).low == 0.0
    beyond = over_episodes(np.array([1.0, 1.0 + 4e-16]), (0.0, 1.0))
    assert beyond.low <= beyond.value <= beyond.high


@pytest.mark.parametrize(
    ("scores", "expected"),
    [
        ([4.0], 4.0),
        ([1.0, 2.0, 3.0, 40.0], 2.5),
        ([9.0, 0.0, 3.0, 1.0, 2.0], 2.0),
        ([[0.0, 1.0, 2.0, 3.0], [4.0, 5.0, 6.0, 70.0]], 3.5),  # all networks are trimmed together
    ],
)
def test_interquartile_mean(scores: list[float], expected: float) -> None:
    """A quarter, rounded down, is left out at either end, over all networks and seeds at once."""
    assert interquartile_mean(scores) == expected


def test_interval_of_two_seeds_is_their_range() -> None:
    """Of two seeds the bootstrap draws (a, a), (a, b), (b, a), (b, b): the outer 2.5 % are a and b themselves."""
    found = over_seeds([1.0, 3.0])
    assert (found.value, found.low, found.high) == (2.0, 1.0, 3.0)


@pytest.mark.medium
def test_interval_against_all_resamples() -> None:
    """With five seeds every one of the 5⁵ resamples can be listed; their percentiles are the interval's."""
    scores = np.array([0.0, 1.0, 3.0, 4.0, 10.0])
    means = [interquartile_mean(scores[list(drawn)]) for drawn in itertools.product(range(5), repeat=5)]
    found = over_seeds(scores, resamples=50_000)
    low, high = np.percentile(means, [2.5, 97.5])
    assert found.value == pytest.approx(8 / 3)
    assert found.low == pytest.approx(low, abs=0.05)
    assert found.high == pytest.approx(high, abs=0.05)


@pytest.mark.slow
@pytest.mark.parametrize(("seeds", "least", "most"), [(10, 0.92, 0.95), (5, 0.89, 0.92)])
def test_coverage(seeds: int, least: float, most: float) -> None:
    """Intervals hold the true value about 95 times in 100, of few seeds fewer times, as documented."""
    rng, hits = np.random.default_rng(1), 0
    for trial in range(4000):
        found = over_seeds(rng.normal(0.0, 1.0, seeds), resamples=400, seed=trial)
        hits += found.low <= 0.0 <= found.high
    assert least <= hits / 4000 <= most


def test_one_seed_has_no_interval() -> None:
    """The figure stands, its interval does not."""
    found = over_seeds([7.0])
    assert found.as_dict() == {"value": 7.0, "low": None, "high": None}


def test_same_seed_same_interval() -> None:
    """Resampling is reproducible."""
    assert over_seeds([1.0, 2.0, 4.0, 8.0, 16.0]) == over_seeds([1.0, 2.0, 4.0, 8.0, 16.0])


def test_over_episodes_is_students_t() -> None:
    """Mean and t-interval of 1, 2, 3: 2 ± 4.303·1/√3."""
    found = over_episodes(np.array([1.0, 2.0, 3.0]))
    assert found.value == 2.0
    assert (found.low, found.high) == pytest.approx((2 - 2.4841, 2 + 2.4841), abs=1e-4)
    assert over_episodes(np.array([7.0])).as_dict() == {"value": 7.0, "low": None, "high": None}
