"""What came of one episode, in sentences: its figures, scheduled flows that were cut, and services that lacked.

A scheduled flow is cut where its donor held too little; a service lacks though nobody could make up for it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cirl_marl.controllers.indicators import indicators
from cirl_marl.controllers.rollout import EpisodeStart, Rollout
from cirl_marl.dynamics.laws import LAWS
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import labels
from cirl_marl.network.elements import Arc

NOTABLE = 1e-3
"""Share of what was asked of a flow in an episode that is worth a word; plans are solved less accurately than run."""


def outcome_lines(network: Network, run: Rollout, origin: EpisodeStart) -> list[str]:
    """Return where the first episode of a rollout began, λ̄, services, accounts, indicators, and what lacked.

    A network that states the criticality of its material has its time-window circularity as well.
    """
    circularity = float(run.episode_circularity[0])
    figures = [f"λ̄ = {circularity:.5g} {network.mass_unit}", f"service level {float(run.episode_service[0]):.4f}"]
    if (of_window := time_window(network, run)) is not None:
        figures.append(f"time-window circularity {of_window[0]:.5g} {network.mass_unit}")
    lines = [f"start: {origin.description}", ", ".join(figures)]
    if len(network.services) > 1:
        levels = zip(network.services, run.episode_levels[0].tolist(), strict=True)
        lines.append(f"service levels: {', '.join(f'{service.id} {level:.4f}' for service, level in levels)}")
    if network.accounts:
        lines.append(f"accounts: {totals_text(network, run)}")
    found = indicators(network, run.flow.mean(axis=0))
    return [*lines, *([found.text(network)] if found else []), *shortage_lines(network, run)]


def time_window(network: Network, run: Rollout) -> Floats | None:
    """Return the time-window circularity of CIRO7.2, 2·c·λ̄ of each episode, shape (B,), mass; None without a c.

    c is the criticality that the network states. That it is twice the mean of λ, the publication gives no reason for.
    """
    criticality = network.objective.criticality
    return None if criticality is None else 2.0 * criticality * run.episode_circularity


def totals_text(network: Network, run: Rollout) -> str:
    """Say what the first episode of a rollout comes to on each account, discounted where the account is."""
    totals = zip(network.accounts, run.accounts[0].tolist(), strict=True)
    return ", ".join(f"{account.id} {total:.5g} {account.unit}" for account, total in totals)


def shortage_lines(network: Network, run: Rollout) -> list[str]:
    """Return which flows and services were less than was asked for, as means over the episodes of a rollout."""
    return [*(shortage.description for shortage in shortages(run, network)), *service_shortages(run, network)]


@dataclass(frozen=True, slots=True)
class Shortage:
    """A scheduled flow that was cut: which, when first, how much less came in all, and ``said``, this in words."""

    arc: Arc
    begins: float
    mass: float
    description: str


def shortages(run: Rollout, network: Network) -> Iterator[Shortage]:
    """Yield the scheduled flows that were cut in a rollout of ``network``; masses are means over its copies."""
    interval = network.episode.control_interval
    scheduled_arcs = [k for k, arc in enumerate(network.arcs) if LAWS[arc.law].is_scheduled]
    for k, lack in zip(scheduled_arcs, run.shortage.T, strict=True):
        mass = float(lack.sum())
        order = mass + float(run.mean_flow[k]) * interval * len(lack)
        if mass > NOTABLE * order:
            arc, begins = network.arcs[k], float(np.argmax(lack > 0)) * interval
            less = f"{mass:.4g} {network.mass_unit} ({mass / order:.1%}) less than asked for"
            first = f"first at {begins:g} {network.time_unit}"
            verb = "held" if network.nodes[network.node_index[arc.donor]].stores else "got"
            yield Shortage(arc, begins, mass, f"arc '{arc.id}' moved {less}, {first}: '{arc.donor}' {verb} too little")


def service_shortages(run: Rollout, network: Network) -> Iterator[str]:
    """Yield the services that fell short in a rollout of ``network`` though arcs make up for them."""
    interval = network.episode.control_interval
    for s, service in enumerate(network.services):
        arcs = [arc for arc in network.arcs if arc.makes_up_for == service.id]
        levels = run.levels[:, s].mean(axis=0)
        if arcs and levels.min() < 1 - NOTABLE:
            first = int(np.argmax(levels < 1 - NOTABLE))
            date = " ".join(f"({column[0]})" for column in labels(network, first * interval)[1])
            at = f"{first * interval:g} {network.time_unit} {date}".strip()
            flows = [f"'{arc.id}' {run.controls[first, network.control_rows[arc.id].start]:.4g}" for arc in arcs]
            unit = f"{network.mass_unit}/{network.time_unit}"
            text = (
                f"falls to {levels.min():.4f}, short first at {at}, when {' and '.join(flows)} {unit} makes up for it"
            )
            yield f"service '{service.id}' {text}"
