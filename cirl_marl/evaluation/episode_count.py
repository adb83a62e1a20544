"""How many episodes a comparison needs: those of disturbed networks are added until differences can be told."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise

import numpy as np

from cirl_marl.controllers.episode_quantities import episode_quantities
from cirl_marl.controllers.rollout import Rollout
from cirl_marl.evaluation.statistics import over_episodes
from cirl_marl.network import Network

EPISODES_CERTAIN = 64
EPISODES_DISTURBED, MOST_EPISODES = 256, 1024
"""Episodes from which on something can be said of the 5 % worst, and most to which they are doubled."""
NEGLIGIBLE = 0.005
"""Part of |λ̄|, or of a full level, below which a difference need not be told from none."""


def enough_episodes(network: Network) -> int:
    """Return with how many episodes a comparison begins: of a disturbed network with more than of a certain one."""
    return EPISODES_DISTURBED if network.disturbed else EPISODES_CERTAIN


def ties(network: Network, rollouts: Mapping[str, Sequence[Rollout]]) -> Iterator[str]:
    """Yield pairs of rows, neighbours in a figure, of which the episodes do not tell which has more.

    That is where the 95 % interval of the mean difference, episode by episode, is wider to either side than the
    difference is large, and than what is negligible. Figures are λ̄ and the mean level of each service.

    Args:
        network: in which they acted.
        rollouts: by row, one for each training seed, of which the mean counts.
    """
    for figure in episode_quantities(network, "circularity", "service"):
        samples = {row: np.mean([figure.totals(run) for run in runs], axis=0) for row, runs in rollouts.items()}
        order = sorted(samples, key=lambda row: float(samples[row].mean()))
        for lower, upper in pairwise(order):
            difference = over_episodes(samples[upper] - samples[lower])
            scale = np.abs(samples[upper]).mean() if figure.kind == "circularity" else 1.0
            if difference.value - difference.low > max(difference.value, NEGLIGIBLE * scale):
                yield f"{lower} and {upper} ({figure.total_name})"


def concatenation(first: Rollout, second: Rollout) -> Rollout:
    """Return the episodes of two rollouts of one controller as one; what is of the first copy is of the first."""
    share = len(first.circularity) / (len(first.circularity) + len(second.circularity))
    along = {"circularity": 0, "circularity_mean": 0, "service": 0, "levels": 0, "disturbances": 0}
    along |= {"bookings": 0, "accounts": 0, "local_returns": 1, "returns": 1}
    changes = {name: np.concatenate([getattr(r, name) for r in (first, second)], axis) for name, axis in along.items()}
    for name in ("shortage", "final_stock", "mean_flow"):  # means over copies
        changes[name] = share * getattr(first, name) + (1.0 - share) * getattr(second, name)
    seconds = first.control_seconds + second.control_seconds
    return replace(first, control_seconds=seconds, **changes)
