"""Running means and variances of many learners at once, as Stable-Baselines3's ``RunningMeanStd`` keeps them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd

from cirl_marl.network import Floats


class Moments:
    """Mean and variance by learner and entry, shape (learners, entries), of all samples so far; counts (learners, 1).

    Two samples of n_a and n_b with means and variances (m, v) are put together by::

        m = m_a + (m_b - m_a) n_b/n,    v = (n_a v_a + n_b v_b + (m_b - m_a)² n_a n_b/n)/n,    n = n_a + n_b
    """

    def __init__(self, learners: int, entries: int) -> None:
        """Begin with nothing: entries that no learner has stay as they are."""
        self.mean, self.var = np.zeros((learners, entries)), np.ones((learners, entries))
        self.count = np.ones((learners, 1))

    def take(self, learner: int, columns: slice, kept: RunningMeanStd) -> None:
        """Take over the moments of a learner, whose entries stand in these columns."""
        self.mean[learner, columns], self.var[learner, columns] = kept.mean, kept.var
        self.count[learner] = kept.count

    def give(self, learner: int, columns: slice, kept: RunningMeanStd) -> None:
        """Give a learner its moments back, in the shape in which it keeps them."""
        shape = np.shape(kept.mean)
        kept.mean, kept.var = (np.array(own[learner, columns]).reshape(shape) for own in (self.mean, self.var))
        kept.count = float(self.count[learner, 0])

    def update(self, samples: NDArray[np.floating]) -> None:
        """Add samples, shape (learners, samples, entries); their own moments are of their own precision."""
        own, new = self.count, samples.shape[1]
        self.count = total = own + new
        shift = samples.mean(axis=1) - self.mean
        self.mean = self.mean + shift * new / total
        self.var = (self.var * own + samples.var(axis=1) * new + np.square(shift) * own * new / total) / total

    def scale(self, epsilon: float) -> Floats:
        """Return the standard deviations, shape (learners, 1, entries); ``epsilon`` is added to the variances."""
        scale: Floats = np.sqrt(self.var + epsilon)[:, None]
        return scale
