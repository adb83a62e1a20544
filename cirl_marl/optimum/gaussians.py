"""The distributions that the cross-entropy method draws deviations from, refined in time as it goes on.

References: Rubinstein 1999; Pinneri et al. 2020 (elites kept from one iteration to the next).
"""

from __future__ import annotations

import numpy as np

from cirl_marl.network import Floats

ELITE_SHARE = 0.125
"""Share of a population that makes up the elite."""
SMOOTHING = 0.6
"""Weight of the elite's mean and variance against those of the iteration before."""
SPREAD = 0.5
"""First standard deviation, in normalised actions."""
NARROWING = 0.7
"""Standard deviation at the beginning of a refinement against that of the one before."""


class Gaussians:
    """Deviations from each start, independent in every stretch of time and entry; first constants around 0."""

    def __init__(self, merit: Floats, population: int, entries: int, seed: int) -> None:
        """Begin with constants.

        Args:
            merit: of no deviation, shape (starts,).
            population: deviations drawn for each start.
            entries: of an action.
            seed: of the draws.
        """
        self._merit, self._elite = merit[:, None], np.zeros((len(merit), 1, 1, entries))
        self._mean, self._variance = self._elite[:, 0].copy(), np.full((len(merit), 1, entries), SPREAD**2)
        self._spread, self._population = SPREAD, population
        self._random = np.random.default_rng(seed)

    def refine(self, knots: int) -> None:
        """Cut each stretch into equal parts, ``knots`` in all, and draw around the best deviation so far again.

        Of the elite only that one stays: the others, all but equal by now, would take the variance away at once.
        """
        parts = knots // self._mean.shape[1]
        if parts == 1:
            return
        self._spread *= NARROWING
        self._merit, self._elite = self._merit[:, :1], np.repeat(self._elite[:, :1], parts, axis=2)
        self._mean = self._elite[:, 0].copy()
        self._variance = np.full(self._mean.shape, self._spread**2)

    def draw(self) -> Floats:
        """Draw deviations, from the same normal numbers for each start, shape (starts, population, knots, entries)."""
        normal = self._random.standard_normal((self._population, *self._mean.shape[1:]))
        drawn: Floats = self._mean[:, None] + np.sqrt(self._variance)[:, None] * normal
        return drawn

    def learn(self, merit: Floats, deviation: Floats) -> None:
        """Move the Gaussians towards the best deviations so far; those of earlier iterations compete.

        Args:
            merit: shape (starts, population).
            deviation: as it came through the bounds of the actions, shape (starts, population, knots, entries).
        """
        merit = np.concatenate([self._merit, merit], axis=1)
        deviation = np.concatenate([self._elite, deviation], axis=1)
        order = np.argsort(-merit, axis=1, kind="stable")[:, : round(self._population * ELITE_SHARE)]
        self._merit = np.take_along_axis(merit, order, axis=1)
        self._elite = np.take_along_axis(deviation, order[:, :, None, None], axis=1)
        self._mean += SMOOTHING * (self._elite.mean(axis=1) - self._mean)
        self._variance += SMOOTHING * (self._elite.var(axis=1) - self._variance)


def stages(knots: int, iterations: int) -> list[int]:
    """Return the number of knots in each iteration: 1, then ``knots`` halved as often as it can be, up to ``knots``.

    >>> stages(12, 8)
    [1, 1, 3, 3, 6, 6, 12, 12]
    """
    counts = [knots]
    while counts[0] % 2 == 0:
        counts.insert(0, counts[0] // 2)
    if counts[0] > 1:
        counts.insert(0, 1)
    return [counts[i * len(counts) // iterations] for i in range(iterations)]
