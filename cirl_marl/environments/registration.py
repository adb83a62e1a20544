"""Every environment under its versioned id in Gymnasium's registry: all networks and scenarios, and those of the paper.

Gymnasium 1.x loads no plug-ins, so that ``import cirl_marl`` registers, or ``gymnasium.make("cirl_marl:ID")``.
"""

from __future__ import annotations

from gymnasium.envs.registration import register as register_with_gymnasium
from gymnasium.envs.registration import registry

from cirl_marl.definitions.ids import ids, network_and_scenario

PAPER_ENVIRONMENTS = {
    "CopperNet": ("copper_net", "use_to_collection", "paper"),
    "CarboNet": ("carbo_net", "urban_to_capture", "paper"),
    "TransportTruck": ("solids_net", "truck", "paper_truck"),
    "Incinerator": ("solids_net", "incinerator", "paper_incinerator"),
    "Reacher": ("solids_net", "sorter", "paper_reacher"),
    "FetchWasteSorting": ("solids_net", "sorter", "paper_fetch"),
    "CO2MicroalgaeMonod": ("net_zero", "microalgae", "paper_monod"),
    "CO2MicroalgaeDroop": ("net_zero", "microalgae", "paper_droop"),
}
"""Name → (network, agent, scenario) of the environments of the paper, in which one agent acts."""
FOLDER = "cirl_marl.environments"
GOAL_TASKS = ("FetchWasteSorting",)
"""Names of those whose observations are dictionaries with goals, as hindsight needs them."""


def register() -> None:
    """Register every id that is not registered yet; called when ``cirl_marl`` is imported."""
    for name, id_ in ids().items():
        if id_ in registry:
            continue
        if name in PAPER_ENVIRONMENTS:
            kind = "goal:GoalEnv" if name in GOAL_TASKS else "single:SingleAgentEnv"
            arguments = dict(zip(("network", "agent", "scenario"), PAPER_ENVIRONMENTS[name], strict=True))
            register_with_gymnasium(id_, f"{FOLDER}.{kind}", kwargs=arguments)
        else:
            network, scenario = network_and_scenario(id_)
            register_with_gymnasium(
                id_,
                f"{FOLDER}.joint:JointEnv",
                vector_entry_point=f"{FOLDER}.joint:JointVectorEnv",
                kwargs={"network": network, "scenario": scenario},
            )
