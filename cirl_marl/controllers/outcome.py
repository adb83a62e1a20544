"""What came of one episode, in sentences."""

from __future__ import annotations

from cirl_marl.controllers.rollout import EpisodeStart, Rollout
from cirl_marl.controllers.shortages import service_shortages, shortages
from cirl_marl.network import Network
from cirl_marl.network.batch_circularity import CIRO_FACTOR


def outcome_lines(network: Network, run: Rollout, origin: EpisodeStart) -> list[str]:
    """Return where the first episode of a rollout began, λ̄ and service levels, and which flows and services lacked.

    A network that states the criticality of its material has its time-window circularity as well.
    """
    criticality, circularity = network.objective.criticality, float(run.episode_circularity[0])
    figures = [f"λ̄ = {circularity:.5g} {network.mass_unit}", f"service level {float(run.episode_service[0]):.4f}"]
    if criticality is not None:
        figures.append(f"time-window circularity {CIRO_FACTOR * criticality * circularity:.5g} {network.mass_unit}")
    lines = [f"start: {origin.description}", ", ".join(figures)]
    if len(network.services) > 1:
        levels = zip(network.services, run.episode_levels[0].tolist(), strict=True)
        lines.append(f"service levels: {', '.join(f'{service.id} {level:.4f}' for service, level in levels)}")
    return [*lines, *shortage_lines(network, run)]


def shortage_lines(network: Network, run: Rollout) -> list[str]:
    """Return which flows and services were less than was asked for, as means over the episodes of a rollout."""
    return [*(shortage.description for shortage in shortages(run, network)), *service_shortages(run, network)]
