"""How good each episode could have been: bounds on λ̄ for its own start and the services that it delivered.

An episode is held against the best λ̄ of those that deliver at least as much of each, so that none looks good by
starving a service. For each row of a comparison two programs are solved, at the mean start and where that one proves
least; their multipliers prove a bound for every other start and service, so that no episode needs a program of its own.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import field
from typing import Annotated

import numpy as np

from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum import Bound, Envelope, bound, envelope

STEP = 1e-4
"""Service levels are demanded in these steps, rounded down: rows that hardly differ share their programs."""
MARGIN = 1e-6
"""Kept from the highest service that can be had, where the solver's tolerance would call the program infeasible."""
SOLVES = 2
"""Programs of each row; docs/plans.md shows what more would change."""
FRONT = 41
"""Service levels at which the front is drawn."""


@positional_record
class Baseline:
    """Proven bounds on λ̄ by start and service."""

    envelope: Annotated[Envelope | None, "proves them; None if nothing is proved"] = None
    front: Annotated[
        Floats, "levels demanded of all services and bounds on λ̄ at the mean start, by level, shape (points, 2)"
    ] = field(default_factory=lambda: np.empty((0, 2)))
    reason: Annotated[str, "why nothing is proved; empty if something is, or nothing was asked for"] = ""

    def at(self, starts: Floats, levels: Floats) -> Floats | None:
        """Return the bounds of episodes from ``starts``, shape (episodes, nodes), with the mean ``levels`` of services.

        These are of shape (episodes, services).
        """
        return None if self.envelope is None else self.envelope.at(starts, np.clip(levels, 0.0, 1.0))


def solve_baseline(
    network: Network,
    agents: Sequence[str],
    starts: Floats,
    services: Sequence[Floats],
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> Baseline:
    """Solve the programs for ``services``, the mean levels, shape (episodes, services), that each row delivered.

    ``starts`` are of shape (episodes, nodes), mass; ``progress`` is called with the share that is done.

    Raises:
        NoCertificate: if the network has flows for which nothing is proved.
        CirlError: if the solver fails.
    """
    members: dict[tuple[int, ...], tuple[Bound, ...]] = {}
    near: Bound | None = None
    for row, service in enumerate(services):

        def tell(count: int, row: int = row) -> None:
            progress((row + count / SOLVES) / len(services))

        tell(0)
        demand = levels_to_demand(service)
        level = tuple(np.rint(demand.mean(axis=0) / STEP).astype(int).tolist())
        if level not in members:
            solution = envelope(
                network, starts, solves=SOLVES, min_service=demand, agents=agents or None, near=near, progress=tell
            )
            members[level] = solution.members
            near = solution.members[0]
    union = Envelope(tuple(member for level in sorted(members) for member in members[level]))
    least = [min(level, default=1.0 / STEP) for level in members]
    levels = STEP * np.linspace(min(least), max(least), FRONT)
    return Baseline(union, np.stack([levels, union.at(starts.mean(axis=0), levels[:, None])], axis=1))


def bounds_of_draws(
    networks: Sequence[Network],
    agents: Sequence[str],
    starts: Floats,
    services: Sequence[Floats],
    *,
    progress: Callable[[float], None] = lambda share: None,
) -> list[Floats]:
    """Return the bounds of episodes that drew numbers, for each of ``services``, shape (episodes,) each.

    An episode is held against the best that somebody could reach who knew from the start what it draws. Every draw has
    programs of its own: multipliers of the stated numbers would hold too, but prove less, and to write a program down
    takes as long as to solve it.

    Args:
        networks: that of each episode, with what it drew.
        agents: who acts.
        starts: shape (episodes, nodes), mass.
        services: mean levels that each row delivered, shape (episodes, services).
        progress: called with the share that is done.

    Raises:
        NoCertificate: if the network has flows for which nothing is proved.
        CirlError: if the solver fails.
    """
    proofs = np.empty((len(services), len(starts)))
    for i, (start, certain) in enumerate(zip(starts, networks, strict=True)):
        near = None
        for k, levels in enumerate(services):
            near = bound(certain, start, min_service=levels_to_demand(levels[i]), agents=agents or None, near=near)
            proofs[k, i] = near.objective
            progress((i + (k + 1) / len(services)) / len(starts))
    return [*proofs]


def levels_to_demand(levels: Floats) -> Floats:
    """Return the levels that programs demand of episodes that delivered ``levels``."""
    return np.asarray(np.maximum(np.floor((levels - MARGIN) / STEP) * STEP, 0.0))
