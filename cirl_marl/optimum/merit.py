"""What an episode in the simulator is worth against a bound: its objective, less what the demanded services lack."""

from __future__ import annotations

import numpy as np

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.network import Floats
from cirl_marl.optimum.bounds import Bound

PENALTY = 3.0
"""Price of what a service lacks in the merit, times the price that the bound puts on it."""


def prices(bound: Bound) -> Floats:
    """Return what the merit charges for a unit that each service lacks, which covers what the certificate asks for it.

    Shape (services,); 0 if nothing is demanded.
    """
    services = len(bound.network.services)
    if bound.min_service is None:
        return np.zeros(services)
    charged = -bound.certificate.under[len(bound.certificate.under) - services :]
    return PENALTY * np.maximum(charged, bound.network.objective.circularity_scale)


def merit(bound: Bound, run: Rollout, prices: Floats) -> float:
    """Return the objective of the bound that an episode reaches, less the price of what its services lack."""
    circularity = float(run.episode_circularity[0])
    if bound.service_weight is not None:
        scale = bound.network.objective.circularity_scale
        return circularity / scale + bound.service_weight * float(run.episode_service[0])
    return circularity - float(prices @ np.maximum(0.0, demanded(bound) - run.episode_levels[0]))


def demanded(bound: Bound) -> Floats:
    """Return the mean level demanded of each service, 0 for none, shape (services,)."""
    return np.zeros(len(bound.network.services)) if bound.min_service is None else bound.min_service
