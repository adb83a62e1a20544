"""One question answered from end to end, for ``docs/japan.md``: what Japan can do by 2050 to cut ore and losses.

python -m benchmarks.japan               # levers and their order, and how sure it is (half an hour)
python -m benchmarks.japan --only later  # some sections, here what to decide now and what later
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np

from benchmarks.document import write_sections
from benchmarks.japan_copper import copper, world
from benchmarks.japan_costs import abatement, front
from benchmarks.japan_decisions import decisions, levers_of
from benchmarks.steel import PRIMARY, TABLE, calibrated, countries, populations, possible_network
from cirl_marl import Levers, MultiAgentVectorEnv, levers, load_network
from cirl_marl.controllers import Constant, Neutral
from cirl_marl.controllers.rollout import episode_start
from cirl_marl.evaluation.levers import ROUNDING
from cirl_marl.evaluation.sampling import sample_episodes, sensitivities
from cirl_marl.importing.flow_table import read_flows
from cirl_marl.network import Network
from cirl_marl.optimum import bound, gap, improve_plan, simulate_plan
from cirl_marl.report.decisions import savings
from cirl_marl.report.lever_chart import save_levers

DOCUMENT = Path(__file__).parent.parent / "docs" / "japan.md"
NAME = "steel_japan"
SAMPLES = 500
POSSIBLE = 16
"""Histories and lifetimes that the data allow, for which levers are pulled."""
TOGETHER = {"what is exported, steel or goods": ("semis_exports", "long_exports", "flat_exports", "goods_exports")}
"""Agents of one decision: what Japan exports, whatever its form."""
SECTIONS = (
    *("saved", "levers", "costs", "abatement", "ranges", "trade", "lives", "spread", "copper", "copper_world", "later"),
)
"""Parts of the document that are measured."""
ORE = {"ore": ("mining", "ore_imports")}
"""What makes up for what is lacking in the world without shocks, and is a decision where demand is not known."""


def question(result: Levers) -> Iterator[str]:
    """Yield what is taken and lost, as usual and as planned."""
    yield "| 2025–2050, Mt | as usual | plan | saved |"
    yield "|-|-|-|-|"
    for what, with_plan, without in savings(result.network, result.together.run, result.usual.run):
        yield f"| {what} | {without / 1e3:.0f} | {with_plan / 1e3:.0f} | {(without - with_plan) / without:.0%} |"
    yield ""
    limit = result.plan.verify().bound
    off = float(gap(limit, result.together.circularity))
    yield f"The bound is λ̄ = {limit / 1e3:.2f} Mt/a; the plan is {off:.2%} from it, at full service."


def order(result: Levers) -> Iterator[str]:
    """Yield the levers in the order in which each adds most to those before it."""
    yield "| lever | alone, Mt/a | with those above, Mt/a | without it, Mt/a | all so far |"
    yield "|-|-|-|-|-|"
    for place, row in enumerate(result.rows):
        changes = " | ".join(f"{change / 1e3:+.2f}" for change in result.changes(place))
        yield f"| {row.name} | {changes} | {result.share(place):.0%} |"
    trials = [trial for row in result.rows for trial in (row.alone, row.added, row.without)]
    least, most = min(trial.service for trial in trials), max(trial.gap or 0.0 for trial in trials)
    yield ""
    yield f"The lowest service of these {len(trials)} episodes is {least:.4f}, the largest gap to a bound {most:.1%}."


def ranges() -> Iterator[str]:
    """Yield what levers bring with other histories and lifetimes that the data allow."""
    everyone = countries(read_flows(TABLE))
    country = next(each for each in everyone if each.name == "Japan")
    known, people = calibrated(country), populations()["Japan"][2025]
    facts, alone = dict[str, list[float]](), dict[str, list[float]]()
    services: list[float] = []
    for level, stretch in known.draws(POSSIBLE):
        at = int(np.searchsorted(known.levels, level)), int(np.searchsorted(known.stretches, stretch))
        facts.setdefault("in use at the end of 2024, t a head", []).append(1e3 * float(known.stock[at]) / people)
        facts.setdefault("collected today, % of discards", []).append(100 * float(known.collection[at]))
        network = possible_network(country, everyone, level, stretch)
        env = MultiAgentVectorEnv(network, num_envs=1)
        begun = episode_start(env)
        usual = begun.play(env, Neutral())
        demand = usual.episode_levels[0] - ROUNDING
        together = simulate_plan(improve_plan(bound(network, min_service=demand)))
        for what, planned, as_usual in savings(network, together, usual):
            facts.setdefault(f"{what} as usual, Mt", []).append(as_usual / 1e3)
            facts.setdefault(f"{what} by the plan, Mt", []).append(planned / 1e3)
        for name, agents in levers_of(network, TOGETHER).items():
            run = simulate_plan(improve_plan(bound(network, min_service=demand, agents=agents)))
            alone.setdefault(name, []).append(float(run.episode_circularity[0] - usual.episode_circularity[0]) / 1e3)
            services.append(float(run.episode_levels[0].min()))
    places = {
        name: [1 + sum(each[i] > own[i] for each in alone.values()) for i in range(POSSIBLE)]
        for name, own in alone.items()
    }
    yield "| what | mean | 90 % of draws | place among levers |"
    yield "|-|-|-|-|"
    for name, values in facts.items():
        yield f"| {name} | {np.mean(values):.1f} | {_span(values)} | |"
    for name in sorted(alone, key=lambda name: -float(np.mean(alone[name]))):
        least, most = min(places[name]), max(places[name])
        place = f"{least}" if least == most else f"{least} to {most}"
        yield f"| {name}, alone, Mt/a | {np.mean(alone[name]):+.1f} | {_span(alone[name])} | {place} |"
    yield ""
    yield f"{POSSIBLE} draws; the lowest service of their episodes is {min(services):.4f}."


def _span(values: Sequence[float]) -> str:
    low, high = np.quantile(values, (0.05, 0.95)).tolist()
    return f"{low:.1f} to {high:.1f}"


def trade() -> Iterator[str]:
    """Yield how much less primary iron is taken in Japan, and in the world, if Japan keeps its scrap."""
    world = load_network("steel_world")
    env = MultiAgentVectorEnv(world, num_envs=1, agents=["japan_scrap_exports"])
    begun = episode_start(env)
    controls = (Neutral(), Constant({"japan_scrap_exports": -1.0}))
    usual, keeps = (begun.play(env, each) for each in controls)
    primary = [arc.id.endswith(PRIMARY) for arc in world.arcs]
    japan = [arc.id.startswith("japan_") for arc in world.arcs]
    saved = (usual.flow - keeps.flow).sum(axis=0) / 1e3
    own, everywhere = (float(saved[np.logical_and(primary, where)].sum()) for where in (japan, True))
    exported = float(usual.flow[:, world.arc_index["japan_scrap_exports"]].sum()) / 1e3
    yield f"As usual Japan exports {exported:.0f} Mt of scrap in 2025–2050 (`steel_world`). If it keeps them, it takes"
    yield f"{own:.0f} Mt less primary iron, and the world {everywhere:.0f} Mt less: who bought the scrap takes more."


def lives() -> Iterator[str]:
    """Yield what longer lives are worth, by themselves and on top of what agents do until then."""
    network = load_network(NAME, scenario="longer_lives")
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env)
    neutral = {agent: float(action[0, 0]) for agent, action in env.neutral_action.items()}
    usual = begun.play(env, Neutral())
    yield "| a quarter longer by 2050 | λ̄, Mt/a | from as usual | lowest service |"
    yield "|-|-|-|-|"
    sectors = ("vehicles", "machinery", "construction", "other_products")
    for name, held in {**{each: (each,) for each in sectors}, "all four": sectors}.items():
        run = begun.play(env, Constant({**neutral, **dict.fromkeys(held, 1.0)}))
        label = name if name not in network.compartments else network.compartments[name].label.lower()
        change = float(run.episode_circularity[0] - usual.episode_circularity[0])
        least = run.levels[0].mean(axis=1).min()
        yield f"| {label} | {run.episode_circularity[0] / 1e3:.2f} | {change / 1e3:+.2f} | {least:.3f} |"


def spread(network: Network) -> Iterator[str]:
    """Yield how λ̄ as usual spreads, and which number causes it."""
    found = sample_episodes(network, samples=SAMPLES)
    mean = found.rollout.episode_circularity / 1e3
    low, high = np.quantile(mean, (0.025, 0.975)).tolist()
    (cause, *_) = sensitivities(found)
    yield f"As usual, {SAMPLES} draws: λ̄ = {mean.mean():.1f} Mt/a, 95 % in [{low:.1f}, {high:.1f}]."
    yield ""
    yield "| number | share of the spread |"
    yield "|-|-|"
    for i in np.argsort(-cause.shares).tolist():
        yield f"| `{found.names[i]}` | {max(0.0, cause.shares[i]):.0%} ± {cause.margins[i]:.0%} |"


def main() -> None:
    """Write the measured parts of the document."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", help=f"sections, of {', '.join(SECTIONS)}; default: all")
    asked = parser.parse_args()
    network = load_network(NAME)
    sections = SECTIONS if asked.only is None else tuple(asked.only.split(","))
    parts: dict[str, Iterator[str]] = {}
    if {"saved", "levers"} & {*sections}:
        result = levers(network, groups=TOGETHER)
        save_levers(DOCUMENT.parent / "pictures" / "japan_levers.png", result)
        parts = {"saved": question(result), "levers": order(result)}
    parts |= {
        "costs": front(NAME),
        "abatement": abatement(NAME),
        "ranges": ranges(),
        "trade": trade(),
        "lives": lives(),
        "spread": spread(network),
        "copper": copper(),
        "copper_world": world(),
        "later": decisions(NAME, {**ORE, **TOGETHER}),
    }
    for name in sections:
        write_sections(DOCUMENT, {name: "\n".join(parts[name])})


if __name__ == "__main__":
    main()
