"""What scheduled flows lacked because their donors held too little, which no service need show."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.dynamics.laws import LAWS
from cirl_marl.network import Network
from cirl_marl.network.elements import Arc

NOTABLE = 1e-3
"""Share of what was asked of a flow in an episode that is worth a word; plans are solved less accurately than run."""


@dataclass(frozen=True, slots=True)
class Shortage:
    """A scheduled flow that was cut: which, when first, how much less came in all, and ``said``, this in words."""

    arc: Arc
    begins: float
    mass: float
    said: str


def shortages(run: Rollout, network: Network) -> Iterator[Shortage]:
    """Yield the scheduled flows that were cut in a rollout of ``network``; masses are means over its copies."""
    interval = network.episode.control_interval
    scheduled = [k for k, arc in enumerate(network.arcs) if LAWS[arc.law].scheduled]
    for k, unmet in zip(scheduled, run.unmet.T, strict=True):
        mass = float(unmet.sum())
        asked = mass + float(run.mean_flow[k]) * interval * len(unmet)
        if mass > NOTABLE * asked:
            arc, begins = network.arcs[k], float(np.argmax(unmet > 0)) * interval
            less = f"{mass:.4g} {network.mass_unit} ({mass / asked:.1%}) less than asked for"
            first = f"first at {begins:g} {network.time_unit}"
            yield Shortage(arc, begins, mass, f"arc '{arc.id}' moved {less}, {first}: '{arc.donor}' held too little")
