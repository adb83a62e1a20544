"""How good each episode could have been: bounds on λ̄ for its own start and the service that it delivered.

An episode is held against the best λ̄ of those that deliver at least as much, so that none looks good by starving the
service. A program is solved for each row of a comparison, at the mean start and the mean service; the multipliers prove
a bound for every other start and service, so that no episode needs a program of its own.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cirl_marl.network import Floats, Network
from cirl_marl.optimum import Envelope, bound

STEP = 1e-4
"""Service levels are demanded in these steps, rounded down: rows that hardly differ share a program."""


@dataclass(frozen=True, slots=True)
class Yardstick:
    """Proven bounds on λ̄ by start and service.

    Attributes:
        envelope: proves them; None if nothing is proved.
        front: service levels and bounds on λ̄ at the mean start, shape (points, 2), by service.
        reason: why nothing is proved; empty if something is, or nothing was asked for.
    """

    envelope: Envelope | None
    front: Floats
    reason: str = ""

    def at(self, starts: Floats, service: Floats) -> Floats | None:
        """Return the bounds of episodes from ``starts``, shape (episodes, nodes), with the mean levels ``service``.

        Raises:
            NoCertificate: if nothing is proved for one of the starts.
        """
        return None if self.envelope is None else self.envelope.at(starts, np.clip(service, 0.0, 1.0))


def yardstick(
    network: Network,
    agents: Sequence[str],
    starts: Floats,
    services: Sequence[float],
    *,
    progress: Callable[[], None] = lambda: None,
) -> Yardstick:
    """Solve the program at the mean of ``starts`` for each of some mean service levels.

    Args:
        network: under its scenario and horizon.
        agents: who acts.
        starts: shape (episodes, nodes), mass.
        services: mean service levels.
        progress: called after each.

    Raises:
        NoCertificate: if the network has flows for which nothing is proved.
        CirlError: if the solver fails.
    """
    levels = sorted({max(0.0, math.floor(level / STEP) * STEP) for level in services})
    solved = []
    for level in levels:
        solved.append(bound(network, starts.mean(axis=0), min_service=level, agents=agents or None))
        progress()
    envelope = Envelope(tuple(solved))
    return Yardstick(envelope, envelope.front())
