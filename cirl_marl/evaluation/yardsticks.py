"""How good each episode could have been: bounds on λ̄ for its own start and the service that it delivered.

An episode is held against the best λ̄ of those that deliver at least as much, so that none looks good by starving the
service. For each row of a comparison two programs are solved, at the mean start and where that one proves least; their
multipliers prove a bound for every other start and service, so that no episode needs a program of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from cirl_marl.network import Floats, Network
from cirl_marl.optimum import Bound, Envelope, envelope

STEP = 1e-4
"""Service levels are demanded in these steps, rounded down: rows that hardly differ share their programs."""
MARGIN = 1e-6
"""Kept from the highest service that can be had, where the solver's tolerance would call the program infeasible."""
SOLVES = 2
"""Programs of each row; docs/bound.md shows what more would change."""
FRONT = 41
"""Service levels at which the front is drawn."""


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
        """Return the bounds of episodes from ``starts``, shape (episodes, nodes), with the mean levels ``service``."""
        return None if self.envelope is None else self.envelope.at(starts, np.clip(service, 0.0, 1.0))


def yardstick(
    network: Network,
    agents: Sequence[str],
    starts: Floats,
    services: Sequence[Floats],
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> Yardstick:
    """Solve the programs for ``services``, the mean service levels, shape (episodes,), that each row delivered.

    ``starts`` are of shape (episodes, nodes), mass; ``progress`` is called with the share that is done.

    Raises:
        NoCertificate: if the network has flows for which nothing is proved.
        CirlError: if the solver fails.
    """
    members: dict[int, tuple[Bound, ...]] = {}
    near: Bound | None = None
    for row, service in enumerate(services):

        def tell(solved: int, row: int = row) -> None:
            progress((row + solved / SOLVES) / len(services))

        tell(0)
        demanded = np.maximum(np.floor((service - MARGIN) / STEP) * STEP, 0.0)
        level = round(float(demanded.mean()) / STEP)
        if level not in members:
            found = envelope(
                network, starts, solves=SOLVES, min_service=demanded, agents=agents or None, near=near, progress=tell
            )
            members[level] = found.members
            near = found.members[0]
    everyone = Envelope(tuple(each for level in sorted(members) for each in members[level]))
    levels = STEP * np.linspace(min(members), max(members), FRONT)
    return Yardstick(everyone, np.stack([levels, everyone.at(starts.mean(axis=0), levels)], axis=1))
