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
        self._samples: tuple[Floats, Floats] | None
        self._count, self._mean, self._samples = (0, np.zeros(1), None) if state is None else state

    @property
    def state(self) -> tuple[int, Floats, tuple[Floats, Floats] | None]:
        """All that it goes on from: number and mean of the draws so far, and the last draws and outcomes, centred."""
        return self._count, self._mean, self._samples

    def luck(self, draws: Floats, outcomes: Floats) -> Floats:
        """Return by how much the mean of each outcome is above what other draws give, shape (outcomes,); learn from it.

        Args:
            draws: of each copy, shape (B, draws).
            outcomes: of its episode, shape (B, outcomes).
        """
        mean = draws.mean(axis=0)
        self._count += len(draws)
        self._mean = self._mean + (mean - self._mean) * (len(draws) / self._count)
        x, y = draws - mean, outcomes - outcomes.mean(axis=0)
        if self._samples is not None:
            x, y = np.concatenate([self._samples[0], x]), np.concatenate([self._samples[1], y])
        self._samples = x, y = x[-SAMPLES:], y[-SAMPLES:]
        spread = x.std(axis=0)
        varies = spread > ROUNDING * np.abs(self._mean)
        x, excess = x[:, varies] / spread[varies], (mean - self._mean)[varies] / spread[varies]
        samples, entries = x.shape
        ridge = float(entries)  # draws/samples of each one's variance, summed over the samples
        if entries <= samples:
            slopes = np.linalg.solve(x.T @ x + ridge * np.eye(entries), x.T @ y)
        else:
            slopes = x.T @ np.linalg.solve(x @ x.T + ridge * np.eye(samples), y)
        luck: Floats = excess @ slopes
        return luck
