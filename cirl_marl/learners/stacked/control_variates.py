"""Means over copies without most of the luck of the draws: control variates, estimated from the last episodes."""

from __future__ import annotations

from typing import Any

import numpy as np

from cirl_marl.network import Floats

SAMPLES = 512
"""Episodes, counted by copies, from which slopes are estimated: some thirty updates of sixteen copies."""
ROUNDING = 1e-9
"""Spread of a draw, in parts of its mean, up to which it is taken not to vary."""


class ControlVariates:
    """What outcomes of episodes owe to what was drawn for them, by a linear regression on the draws x.

    With β the slopes of an outcome y, estimated within episodes, as policies change from one to the next, its mean over
    copies is ȳ − β·(x̄ − E x): unbiased but for the estimate of β, and of less variance by the share that is explained
    (Glasserman 2003, Monte Carlo Methods in Financial Engineering, section 4.1). E x is the mean of all draws so far.
    Slopes shrink by a ridge of draws/samples, so that many draws explain nothing that few samples do not show.
    """

    def __init__(self, state: Any = None) -> None:
        """Begin anew, or from a ``state``."""
        self._count: int
        self._mean: Floats
        self._draws: Floats
        self._outcomes: Floats
        fresh = (0, np.zeros(1), np.zeros((0, 0)), np.zeros((0, 0)))
        self._count, self._mean, self._draws, self._outcomes = fresh if state is None else state

    @property
    def state(self) -> tuple[int, Floats, Floats, Floats]:
        """All that it goes on from: number and mean of the draws so far, and the last draws and outcomes, centred."""
        return self._count, self._mean, self._draws, self._outcomes

    def luck(self, draws: Floats, outcomes: Floats) -> Floats:
        """Return by how much the mean of each outcome is above what other draws give, shape (outcomes,); learn from it.

        Args:
            draws: of each copy, shape (B, draws).
            outcomes: of its episode, shape (B, outcomes).
        """
        count, mean = len(draws), draws.mean(axis=0)
        self._count += count
        self._mean = self._mean + (mean - self._mean) * (count / self._count)
        centred = draws - mean, outcomes - outcomes.mean(axis=0)
        if not len(self._draws):
            self._draws, self._outcomes = (part[:0] for part in centred)
        earlier = self._draws[-SAMPLES:], self._outcomes[-SAMPLES:]
        self._draws, self._outcomes = (np.concatenate(parts)[-SAMPLES:] for parts in zip(earlier, centred, strict=True))
        spread = self._draws.std(axis=0)
        varies = spread > ROUNDING * np.abs(self._mean)
        scaled, excess = self._draws[:, varies] / spread[varies], (mean - self._mean)[varies] / spread[varies]
        samples, entries = scaled.shape
        ridge = float(entries)  # draws/samples of each one's variance, summed over the samples
        if entries <= samples:
            slopes = np.linalg.solve(scaled.T @ scaled + ridge * np.eye(entries), scaled.T @ self._outcomes)
        else:
            slopes = scaled.T @ np.linalg.solve(scaled @ scaled.T + ridge * np.eye(samples), self._outcomes)
        luck: Floats = excess @ slopes
        return luck
