"""Control variates: the luck of draws, closed forms, an independent ridge regression, and what they save."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cirl_marl.learners.stacked.control_variates import SAMPLES, ControlVariates


@pytest.mark.parametrize("explained", [0.5, 0.9])
def test_means_swing_less_by_what_is_explained(explained: float) -> None:
    """Outcomes are linear in the draws but for noise: what is left of the variance of means is that of the noise."""
    rng, variates, slopes = np.random.default_rng(1), ControlVariates(), np.array([[1.0], [-2.0], [0.0]])
    noise = np.sqrt((slopes**2).sum() * (1.0 / explained - 1.0))
    plain, corrected = [], []
    for level in np.linspace(0.0, 50.0, 600):  # policies change, which is no luck
        draws = rng.normal(3.0, 1.0, (16, 3))
        outcomes = level + draws @ slopes + noise * rng.normal(size=(16, 1))
        plain.append(outcomes.mean() - level + 3.0)
        corrected.append(plain[-1] - variates.luck(draws, outcomes)[0])
    late = slice(100, None)
    assert np.mean(corrected[late]) == pytest.approx(0.0, abs=4 * np.std(corrected[late]) / np.sqrt(500) + 0.1)
    assert np.var(corrected[late]) / np.var(plain[late]) == pytest.approx(1.0 - explained, abs=0.12)


@given(st.integers(0, 10**6), st.integers(2, 40), st.integers(0, 60), st.integers(1, 5))
def test_slopes_are_those_of_a_ridge_within_episodes(seed: int, copies: int, entries: int, episodes: int) -> None:
    """More draws than samples or fewer, some that never vary; a state goes on alike."""
    rng, variates = np.random.default_rng(seed), ControlVariates()
    draws, outcomes = rng.normal(5.0, 2.0, (episodes, copies, entries)), rng.normal(size=(episodes, copies, 2))
    draws[:, :, : entries // 4] = 0.7
    for episode in range(episodes):
        variates = ControlVariates(variates.state)
        luck = variates.luck(draws[episode], outcomes[episode])
    draws = draws[:, :, entries // 4 :]
    centred = [part - part.mean(axis=1, keepdims=True) for part in (draws, outcomes)]
    x, y = (part.reshape(episodes * copies, -1)[-SAMPLES:] for part in centred)
    spread = x.std(axis=0)
    x = x / spread
    size = np.sqrt(draws.shape[2])
    ridge = np.linalg.lstsq(np.vstack([x, size * np.eye(draws.shape[2])]), np.pad(y, ((0, draws.shape[2]), (0, 0))))[0]
    expected = (draws[-1].mean(axis=0) - draws.mean(axis=(0, 1))) / spread @ ridge
    np.testing.assert_allclose(luck, expected, atol=1e-9)


def test_nothing_is_luck_where_nothing_is_drawn() -> None:
    """One copy, or the same start in all of them."""
    variates = ControlVariates()
    for _ in range(3):
        assert variates.luck(np.full((4, 2), 3.0), np.arange(4.0)[:, None]) == 0.0
    alone = ControlVariates()
    assert [alone.luck(np.array([[x]]), np.array([[x]]))[0] for x in (1.0, 2.0, 5.0)] == [0.0, 0.0, 0.0]
