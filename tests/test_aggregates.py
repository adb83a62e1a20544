"""Aggregates of scores against values by hand, and profiles."""

from __future__ import annotations

import numpy as np
import pytest

from cirl_marl import CirlError
from cirl_marl.evaluation.aggregates import aggregate, performance_profile, probability_of_improvement

SCORES = [[0.0, 0.2, 0.4, 1.0], [0.5, 0.6, 0.7, 0.8]]
"""Two tasks, four seeds."""


def test_figures_by_hand() -> None:
    """Of eight runs the two lowest and the two highest are left out; medians are of means of tasks."""
    found = {name: figure.value for name, figure in aggregate(SCORES).items()}
    assert found["IQM"] == pytest.approx((0.4 + 0.5 + 0.6 + 0.7) / 4)
    assert found["median"] == pytest.approx((0.4 + 0.65) / 2)
    assert found["mean"] == pytest.approx(4.2 / 8)
    assert found["optimality gap"] == pytest.approx(1 - 4.2 / 8)
    assert aggregate([[1.5, 0.5]])["optimality gap"].value == pytest.approx(0.25)  # nothing makes up for what lacks


def test_the_median_is_over_tasks() -> None:
    """One bad seed of a good task moves its mean, not the median of three tasks."""
    scores = [[0.9, 0.9, 0.0], [0.5, 0.5, 0.5], [0.1, 0.1, 0.1]]
    assert aggregate(scores)["median"].value == pytest.approx(0.5)


def test_resamples_stay_within_tasks() -> None:
    """If the seeds of each task agree there is nothing to resample, however different the tasks are."""
    for figure in aggregate([[0.1, 0.1], [0.9, 0.9]]).values():
        assert figure.low == figure.value == figure.high
    # of one task with two seeds a resample is (a, a), (a, b), (b, a) or (b, b)
    mean = aggregate([[0.0, 1.0]])["mean"]
    assert (mean.low, mean.value, mean.high) == (0.0, 0.5, 1.0)


def test_intervals_hold_the_truth() -> None:
    """Of normal scores of ten seeds on three tasks some 95 of 100 intervals of the mean hold it."""
    rng, held = np.random.default_rng(0), 0
    for _ in range(100):
        mean = aggregate(rng.normal(0.5, 0.1, (3, 10)), resamples=400)["mean"]
        held += mean.low <= 0.5 <= mean.high
    assert 85 <= held <= 99


def test_probability_of_improvement_by_hand() -> None:
    """It counts pairs on each task, halves ties, and is one minus that of the other side."""
    first, second = [[1.0, 3.0], [0.0, 0.0]], [[2.0, 2.0, 0.0], [0.0, 1.0, 0.0]]
    by_hand = ((1 + 3) / 6 + (4 * 0.5) / 6) / 2
    assert probability_of_improvement(first, second).value == pytest.approx(by_hand)
    assert probability_of_improvement(second, first).value == pytest.approx(1 - by_hand)
    assert probability_of_improvement([[2.0], [3.0]], [[1.0], [1.0]]).value == 1.0


def test_profiles_fall() -> None:
    """The share of runs with at least a score: 1 at the least score, falling, its interval around it."""
    thresholds = np.linspace(0.0, 1.0, 11)
    share, low, high = performance_profile(SCORES, thresholds)
    assert share[0] == 1.0
    assert share[5] == pytest.approx(5 / 8)  # 0.5 counts as reached
    assert (np.diff(share) <= 0).all()
    assert (low <= share).all()
    assert (share <= high).all()


@pytest.mark.parametrize("scores", [[], [1.0, 2.0], [[np.nan, 1.0]], [[1.0], [2.0, 3.0]][:0]])
def test_what_is_no_table_is_refused(scores: object) -> None:
    """Shape or numbers are named."""
    with pytest.raises(CirlError, match="scores must be finite, of shape"):
        aggregate(scores)  # type: ignore[arg-type]
    with pytest.raises(CirlError, match="of 1 and of 2 tasks"):
        probability_of_improvement([[1.0]], [[1.0], [2.0]])
