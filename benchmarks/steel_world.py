"""The data of ``envs/steel_world.toml``, and what was measured with it; ``docs/data.md`` has the sources.

python -m benchmarks.steel_world           # writes envs/steel_world.csv and steel_world_rest.csv anew
python -m benchmarks.steel_world --levers  # what single levers and countries bring, in docs/cycles.md
python -m benchmarks.steel_world --plan    # bound and plan, and who brings how much of it, there (ten minutes)
"""

from __future__ import annotations

import argparse
import resource
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from benchmarks import steel
from benchmarks.document import write_sections
from benchmarks.plans import DOCUMENT as CYCLES
from benchmarks.steel import ENVS, FUTURE, TABLE, YEARS, Country, countries
from cirl_marl import MultiAgentVectorEnv, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.rollout import episode_start
from cirl_marl.importing.definition import identifiers, shares_of
from cirl_marl.importing.flow_table import read_flows
from cirl_marl.network import Floats, Network
from cirl_marl.optimum import bound, improve_plan, simulate_plan
from cirl_marl.optimum.planned_episodes import HasPlan, Plan
from cirl_marl.records.files import write_table

GOODS = ("ore", "pig_iron", "dri", "scrap", "semis", "long", "flat", "goods")
"""What world markets trade."""
STEEL = ("semis", "long", "flat", "goods")
"""The part of it that the rest of the world wants for its own sake."""
RAW = ("ore", "pig_iron", "dri")
"""The part that counts where it is made into steel, from 2025 on, so that nothing of it is traded then."""
LEVERS = {
    "collection of old scrap": {"old_scrap": 1.0},
    "losses in scrap preparation": {"scrap_losses": -1.0},
    "losses of oxygen furnaces": {"bof_losses": -1.0},
    "losses of electric furnaces": {"eaf_losses": -1.0},
    "scrap of rolling and manufacturing": {"long_scrap": -1.0, "flat_scrap": -1.0, "goods_scrap": -1.0},
}
"""Levers that nothing speaks against, and the actions of their agents."""
SHOWN = 8
"""Countries that the tables of levers and of the plan have."""


@dataclass(frozen=True, slots=True)
class Market:
    """What the countries trade of one good in 2000-2024, then from 2025 on as usual, kt/a."""

    imports: Annotated[Floats, "of each country, shape (years, countries)"]
    exports: Annotated[Floats, "likewise"]

    @property
    def sold(self) -> Floats:
        """What the rest of the world sells: what the countries import beyond their exports, shape (years,)."""
        found: Floats = np.maximum((self.imports - self.exports).sum(axis=1), 0.0)
        return found

    @property
    def bought(self) -> Floats:
        """What the rest of the world buys: what they export beyond their imports, shape (years,)."""
        found: Floats = np.maximum((self.exports - self.imports).sum(axis=1), 0.0)
        return found

    @property
    def shares(self) -> Floats:
        """What part of all that is for sale each country buys, shape (years, countries)."""
        found: Floats = shares_of(np.column_stack([self.imports, self.bought])[None])[0][:, :-1]
        return found


def markets(everyone: Sequence[Country]) -> dict[str, Market]:
    """Return the world markets, by good.

    Exports are as the network of each country gives them back, in which processes balance, as rounded ones do not. From
    2025 on, what is traded is what it trades there while nobody acts.
    """
    ids = identifiers(each.name for each in everyone)
    returned, usual = (
        [steel.simulated(ids[each.name], scenario)[0] for each in everyone] for scenario in ("reported", "default")
    )
    found = {}
    for good in GOODS:
        reported = np.array([each.flows[f"{good}_imports"] for each in everyone]).T
        imports = np.vstack([reported, _flows(usual, f"{good}_imports") * (good not in RAW)])
        exports = np.vstack([_flows(each, f"{good}_exports") for each in (returned, usual)])
        exports[len(YEARS) :] *= good not in RAW
        found[good] = Market(imports, exports)
    return found


def _flows(simulated: Sequence[Mapping[str, Floats]], arc: str) -> Floats:
    return np.array([flows[arc] for flows in simulated]).T


def write_trade(everyone: Sequence[Country], found: Mapping[str, Market], supply: float) -> None:
    """Write the share of each country in each world market, and what the rest of the world sells and wants there."""
    shares = {good: market.shares for good, market in found.items()}
    rows: list[list[object]] = []
    for n, country in enumerate(everyone):
        for y, year in enumerate((*YEARS, *FUTURE)):
            rows.append([country.name, year, *(_said(shares[good][y, n]) for good in GOODS)])
    write_table(ENVS / "steel_world.csv", ["region", "year", *GOODS], rows)
    wanted = np.sum([found[good].bought for good in STEEL], axis=0)
    wanted[len(YEARS) :] = supply
    sold = np.array([found[good].sold for good in GOODS]).T
    rest = [
        [year, *map(_said, row)] for year, row in zip((*YEARS, *FUTURE), np.column_stack([sold, wanted]), strict=True)
    ]
    write_table(ENVS / "steel_world_rest.csv", ["year", *GOODS, "supply"], rest)


def _said(value: float) -> str:
    return f"{float(value):.12g}"


def simulated(scenario: str) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return flows by arc and stocks by node of a scenario in which nobody acts."""
    network = load_network(ENVS / "steel_world.toml", scenario=scenario)
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env)
    run = begun.play(env, Neutral())
    flows = {arc.id: run.flow[:, k] for k, arc in enumerate(network.arcs)}
    return flows, {node.id: run.stock[:, i] for i, node in enumerate(network.stores)}


class _Apart(Controller):
    """Holds other actions in each copy, agent → action; agents that are not named stay neutral."""

    def __init__(self, held: Sequence[Mapping[str, float]]) -> None:
        self._held = held

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        self._env = env

    def act(self, observations: Arrays) -> Arrays:
        neutral = {agent: np.zeros((len(self._held), 1)) + action for agent, action in self._env.neutral_action.items()}
        for copy, held in enumerate(self._held):
            for agent, value in held.items():
                neutral[agent][copy] = value
        return neutral


def lever_lines() -> Iterator[str]:
    """Yield the table of what levers bring in all countries, and all levers in one country."""
    network = load_network(ENVS / "steel_world.toml")
    everybody, every = list(network.copies), [each for agents in LEVERS.values() for each in agents.items()]

    def held(regions: Sequence[str], levers: Iterable[tuple[str, float]]) -> dict[str, float]:
        return {f"{region}_{agent}": value for region in regions for agent, value in levers}

    rows = [("nobody acts", held([], [])), ("all of these, in all countries", held(everybody, every))]
    rows += [(f"{name}, in all countries", held(everybody, agents.items())) for name, agents in LEVERS.items()]
    names = {region: region.replace("_", " ").title() for region in everybody}
    rows += [(f"all of these, in {name} alone", held([region], every)) for region, name in names.items()]
    env = MultiAgentVectorEnv(network, num_envs=len(rows))
    begun = episode_start(env)
    run = begun.play(env, _Apart([actions for _, actions in rows]))
    reached, service = run.episode_circularity / 1e3, run.levels.min(axis=(1, 2))
    gains = reached - reached[0]
    best = sorted(range(2 + len(LEVERS), len(rows)), key=lambda i: -gains[i])[:SHOWN]
    yield "| what is set to its best | λ̄, Mt/a | from as usual | lowest service |"
    yield "|-|-|-|-|"
    for i in [*range(2 + len(LEVERS)), *best]:
        yield f"| {rows[i][0]} | {reached[i]:.1f} | {gains[i]:+.1f} | {service[i]:.3f} |"


@dataclass(frozen=True, slots=True)
class _Part:
    """A plan of which some agents do their part, while the others are neutral."""

    network: Network
    agents: tuple[str, ...]
    initial: Floats
    actions: Annotated[Floats, "normalised, shape (steps, entries)"]


def gain_lines(plan: HasPlan) -> Iterator[str]:
    """Yield the table of what the plan gains where one kind of agent, or one country, keeps to it, or all but these."""
    network = plan.network
    kinds = {agent: next(r for r in network.copies if agent.startswith(f"{r}_")) for agent in plan.agents}
    levers = {agent: agent.removeprefix(f"{region}_") for agent, region in kinds.items()}
    names = {region: region.replace("_", " ").title() for region in network.copies}
    groups = {
        f"`{lever}`, in all countries": [a for a in plan.agents if levers[a] == lever] for lever in levers.values()
    }
    countries_ = {f"all of {name}": [a for a in plan.agents if kinds[a] == region] for region, name in names.items()}
    chosen = [[], list(plan.agents)]
    for part in (*groups.values(), *countries_.values()):
        chosen += [part, [agent for agent in plan.agents if agent not in part]]
    env = MultiAgentVectorEnv(network, num_envs=len(chosen))
    begun = episode_start(env)
    env.reset(seed=begun.seed, options={"initial_state": begun.initial_state})
    neutral = env.stack(env.neutral_action)[:, 0]
    acts = np.array([[agent in part for agent in plan.agents] for part in chosen])
    parts = [_Part(network, plan.agents, plan.initial, np.where(who, plan.actions, neutral)) for who in acts]
    run = begun.play(env, Plan(parts))
    reached, service = run.episode_circularity / 1e3, run.episode_levels.min(axis=1)
    gains = reached - reached[0]
    yield "| who keeps to the plan | gain alone, Mt/a | lowest service | gain without them, Mt/a |"
    yield "|-|-|-|-|"
    yield f"| everybody | {gains[1]:+.1f} | {service[1]:.4f} | |"
    rows = {name: 2 + 2 * i for i, name in enumerate((*groups, *countries_))}
    best = sorted(countries_, key=lambda name: -gains[rows[name]])[:SHOWN]
    for name in (*sorted(groups, key=lambda name: -gains[rows[name]]), *best):
        i = rows[name]
        yield f"| {name} | {gains[i]:+.1f} | {service[i]:.4f} | {gains[i + 1]:+.1f} |"


def planned() -> tuple[HasPlan, Iterator[str]]:
    """Return the plan of the world at full service, and the table that says how good it is."""
    begun = time.process_time()
    found = bound(load_network(ENVS / "steel_world.toml"), min_service=1.0)
    proved = found.verify().bound
    solved = time.process_time()
    plan = improve_plan(found)
    run = simulate_plan(plan)
    done = time.process_time()
    reached, levels = float(run.episode_circularity[0]), run.episode_levels[0]
    there = float(found.at(min_service=np.minimum(levels, 1.0)))
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6

    def lines() -> Iterator[str]:
        yield "| bound, Mt | plan, Mt | gap | lowest service | gap at its services | bound, s | plan, s | memory, GB |"
        yield "|-|-|-|-|-|-|-|-|"
        gaps = f"{found.gap(reached):.2%} | {levels.min():.4f} | {(there - reached) / abs(there):.2%}"
        spent = f"{solved - begun:.0f} | {done - begun:.0f} | {memory:.1f}"
        yield f"| {proved / 1e3:.1f} | {reached / 1e3:.1f} | {gaps} | {spent} |"

    return plan, lines()


def main() -> None:
    """Write the data files, or the table of levers."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levers", action="store_true", help="write the table of levers instead")
    parser.add_argument("--plan", action="store_true", help="write the tables of the bound and its plan instead")
    given = parser.parse_args()
    if given.plan:
        plan, lines = planned()
        write_sections(CYCLES, {"world_plan": "\n".join(lines), "world_gains": "\n".join(gain_lines(plan))})
        return
    if given.levers:
        write_sections(CYCLES, {"levers": "\n".join(lever_lines())})
        return
    everyone = countries(read_flows(TABLE))
    found = markets(everyone)
    write_trade(everyone, found, 1.0)
    flows, _ = simulated("default")
    write_trade(everyone, found, 0.9 * float(np.min(sum(flows[f"rest_of_world_{good}_bought"] for good in STEEL))))


if __name__ == "__main__":
    main()
