"""How much scrap Japan can melt before copper stops it, for ``docs/japan.md``: plans under what is not known."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np

from cirl_marl import MultiAgentVectorEnv, bound, improve_plan, load_network, simulate_plan
from cirl_marl.controllers import Constant
from cirl_marl.controllers.rollout import Rollout, episode_start
from cirl_marl.network import Floats, Network
from cirl_marl.network.series import in_intervals
from cirl_marl.optimum import gap

STEEL = 0.1
"""Copper of the steel in use, %; the rest of what products hold is what stays with it when they are shredded."""
PRODUCTS = (0.15, 0.2, 0.3, 0.4)
"""Copper that stays with products, %: not known better."""
FLAT, LONG = (0.1, 0.06), 0.4
"""Copper that flat products bear, %: Daehn, Cabrera Serrenho and Allwood 2019 and 2017; that long ones bear."""
USUAL = 0.2
"""Copper of products in the scenario, %."""
FIRST = 2025
ALL = {"old_scrap": 1.0} | dict.fromkeys(
    ("scrap_losses", "bof_losses", "eaf_losses", "long_scrap", "flat_scrap", "goods_scrap"), -1.0
)
"""What agents of each country do to collect all scrap and lose little, by the end of their names."""
REMOVES, SORTS = "copper_removed", "semis_to_long"
"""Who removes copper from shredded scrap, and who keeps melts with much copper for long products."""


def network_of(products: float, flat: float | None) -> Network:
    """Return the scenario with other contents, in %, and without limits where ``flat`` is None."""
    network = load_network("steel_japan", scenario="copper")
    interval = network.episode.control_interval
    added = network.arcs[network.arc_index["copper_added"]]
    flow = in_intervals(network.interval_means(added.flow) * products / USUAL, interval)
    content = (("copper", (STEEL + products) / 100),)
    nodes = [node if node.lifetime is None else replace(node, content=content) for node in network.nodes]
    arcs = [replace(arc, flow=flow) if arc is added else arc for arc in network.arcs]
    services = [service for service in network.services if flat is not None or not service.substance]
    services = [replace(each, high=flat / 100) if each.id == "clean_flat" and flat else each for each in services]
    return replace(network, nodes=tuple(nodes), arcs=tuple(arcs), services=tuple(services), scenarios={})


def planned(network: Network, without: str = "") -> tuple[Rollout, float]:
    """Return the plan for full service in which one agent stays as it is, and its gap to the bound."""
    agents = [agent for agent in network.agents if agent != without]
    limit = bound(network, min_service=1.0, agents=agents)
    run = simulate_plan(improve_plan(limit, starts=1))
    return run, float(gap(limit.objective, run.episode_circularity[0]))


def copper() -> Iterator[str]:
    """Yield what limits of copper do to the plan, and what removing it and keeping melts apart bring."""
    yield "| copper of products | flat steel bears | in steel, 2025 and 2050 | products bear | too much from |"
    yield "|-|-|-|-|-|"
    free: dict[float, float] = {}
    for products in PRODUCTS:
        network = network_of(products, None)
        run, _ = planned(network)
        free[products] = float(run.episode_circularity[0])
        flat, long, cast = (
            run.flow[:, network.arc_index[k]] for k in ("semis_to_flat", "semis_to_long", "semis_exports")
        )
        content = 100 * run.contents[:, 0, len(network.nodes) + network.arc_index["cast"]]
        for bears in FLAT:
            most = ((flat + cast) * bears + long * LONG) / (flat + long + cast)
            above = np.flatnonzero(content > most)
            first = str(FIRST + int(above[0])) if len(above) else "after 2050"
            contents = f"{content[0]:.2f}, {content[-1]:.2f} %"
            yield f"| {products:g} % | {bears:g} % | {contents} | {most[-1]:.2f} % | {first} |"
    yield ""
    yield "| copper of products | flat steel bears | removed in 2050 | plan | nothing removed | one kind of melt |"
    yield "|-|-|-|-|-|-|"
    gaps, services = [], []
    for products in PRODUCTS[1:]:
        for bears in FLAT:
            network = network_of(products, bears)
            cases = planned(network), planned(network, REMOVES), planned(one_melt(network))
            gaps.append([off for _, off in cases])
            removed = cases[0][0].flow[-1, network.arc_index[REMOVES]]
            services.append(min(float(run.episode_levels.min()) for run, _ in cases))
            changes = [f"{(run.episode_circularity[0] - free[products]) / 1e3:+.2f}" for run, _ in cases]
            yield f"| {products:g} % | {bears:g} % | {removed:.0f} kt | {' | '.join(changes)} |"
    yield ""
    yield "λ̄ in Mt/a, against a plan without limits. By column plans are at most"
    largest = ", ".join(f"{100 * off:.0f}" for off in np.max(gaps, axis=0))
    yield f"{largest} % from their bounds; no service is below {min(services):.3f}."


def world() -> Iterator[str]:
    """Yield what copper the steel of the world has, as usual and with all levers, against what products bear."""
    network = load_network("steel_world", scenario="copper")
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env)
    usual = {agent: float(action[0, 0]) for agent, action in env.neutral_action.items()}
    levers = {agent: next((v for k, v in ALL.items() if agent.endswith(f"_{k}")), usual[agent]) for agent in usual}
    yield "| the world | in steel, 2025 and 2050 | products bear | countries with too much by themselves in 2050 |"
    yield "|-|-|-|-|"
    regions = [arc.id.removesuffix("_cast") for arc in network.arcs if arc.id.endswith("_cast")]
    for name, actions in (("as usual", usual), ("all scrap is collected, little is lost", levers)):
        run = begun.play(env, Constant(actions))

        def flows(part: str, run: Rollout = run) -> Floats:
            return run.flow[:, [network.arc_index[f"{region}_{part}"] for region in regions]]

        cast, flat, long = (flows(part) for part in ("cast", "semis_to_flat", "semis_to_long"))
        rows = [len(network.nodes) + network.arc_index[f"{region}_cast"] for region in regions]
        content = 100 * run.contents[:, 0, rows]
        bears = (FLAT[0] * flat + LONG * long) / (flat + long)
        mean, most = (content * cast).sum(axis=1) / cast.sum(axis=1), (bears * cast).sum(axis=1) / cast.sum(axis=1)
        texts = [
            f"{mean[0]:.2f}, {mean[-1]:.2f} %",
            f"{most[-1]:.2f} %",
            f"{(content > bears)[-1].sum()} of {len(regions)}",
        ]
        yield f"| {name} | {' | '.join(texts)} |"


def one_melt(network: Network) -> Network:
    """Return a network in which long products have the copper that all steel has."""
    arcs = [replace(arc, control=None) if arc.id == SORTS else arc for arc in network.arcs]
    agents = tuple(agent for agent in network.default_agents if agent != SORTS)
    services = [replace(each, owed_by=tuple(id_ for id_ in each.owed_by if id_ != SORTS)) for each in network.services]
    return replace(network, arcs=tuple(arcs), default_agents=agents, services=tuple(services), scenarios={})
