"""Gymnasium ids of the paper's environments."""

from __future__ import annotations

import gymnasium

PAPER_ENVIRONMENTS = {
    "cirl_marl/CopperNet-v0": ("copper_net", "use_to_collection"),
    "cirl_marl/CarboNet-v0": ("carbo_net", "urban_to_capture"),
}
"""Gymnasium id → (network, agent), each under ``scenario="paper"``."""


def register() -> None:
    """Register every id once; called when ``cirl_marl`` is imported."""
    for id_, (network, agent) in PAPER_ENVIRONMENTS.items():
        if id_ not in gymnasium.registry:
            gymnasium.register(
                id_,
                entry_point="cirl_marl.single_env:SingleAgentEnv",
                kwargs={"network": network, "agent": agent, "scenario": "paper"},
            )
