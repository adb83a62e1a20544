"""Gymnasium ids of the paper's environments."""

from __future__ import annotations

import gymnasium

PAPER_ENVIRONMENTS = {
    "cirl_marl/CopperNet-v0": ("copper_net", "use_to_collection", "paper"),
    "cirl_marl/CarboNet-v0": ("carbo_net", "urban_to_capture", "paper"),
    "cirl_marl/TransportTruck-v0": ("solids_net", "truck", "paper_truck"),
    "cirl_marl/Incinerator-v0": ("solids_net", "incinerator", "paper_incinerator"),
    "cirl_marl/Reacher-v0": ("solids_net", "sorter", "paper_reacher"),
    "cirl_marl/FetchWasteSorting-v0": ("solids_net", "sorter", "paper_fetch"),
    "cirl_marl/CO2MicroalgaeMonod-v0": ("net_zero", "microalgae", "paper_monod"),
    "cirl_marl/CO2MicroalgaeDroop-v0": ("net_zero", "microalgae", "paper_droop"),
}
"""Gymnasium id → (network, agent, scenario)."""
GOAL_TASKS = ("cirl_marl/FetchWasteSorting-v0",)
"""Ids whose observations are dictionaries with goals, as hindsight needs them."""


def register() -> None:
    """Register every id once; called when ``cirl_marl`` is imported."""
    for id_, (network, agent, scenario) in PAPER_ENVIRONMENTS.items():
        if id_ not in gymnasium.registry:
            kind = "goal:GoalEnv" if id_ in GOAL_TASKS else "single:SingleAgentEnv"
            arguments = {"network": network, "agent": agent, "scenario": scenario}
            gymnasium.register(id_, entry_point=f"cirl_marl.environments.{kind}", kwargs=arguments)
