"""Worlds in which feedback matters: nobody acting, a plan replayed blindly and a rule, at equal expected service.

python -m benchmarks.uncertain [NETWORK ...]   # measures all, or some (half an hour), and writes the table
python -m benchmarks.uncertain --table         # writes the table of what is kept in results/uncertain.json

Each contender has one knob, which is set on draws of its own so that the lowest expected service is what is demanded:
*neutral* and *rule* multiply what the suppliers of the world order, *rule* also all that it aims at, *plan* the demand
that is planned for. The figures are of other draws, the same for all.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from benchmarks.document import measured_table, write_sections
from cirl_marl import MultiAgentVectorEnv, Network, load_network
from cirl_marl.controllers import Controller, Neutral, ScriptController
from cirl_marl.controllers.basic import Arrays
from cirl_marl.controllers.rollout import Rollout, first_seed, rollout
from cirl_marl.evaluation.statistics import over_episodes, worst_mean
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.series import Series, Value
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum.blind import Replay
from cirl_marl.optimum.mpc import MPC
from cirl_marl.records.files import write_json

DOCUMENT = Path(__file__).parent.parent / "docs" / "uncertain_worlds.md"
RESULTS = Path(__file__).parent / "results" / "uncertain.json"
BLIND = ("neutral", "plan")
"""Contenders that do the same whatever happens."""
DEMANDED, CLOSE = 0.99, 0.002
"""Lowest expected level of a service, as recipes demand it, and how close a contender has to come to it."""
TUNED, REPORTED = 128, 256
"""Draws on which knobs are set, and others of which the figures are."""
SPREAD, LIMITS, TRIES = 1.3, (0.1, 10.0), 9
"""Factor between the first settings of a knob, its ends, and how often the bracket is then halved at most."""


@positional_record
class World:
    """A network under a scenario that is disturbed."""

    network: Annotated[str, "its name"]
    scenario: Annotated[str, "the scenario"]
    suppliers: Annotated[tuple[str, ...], "agents whose orders the knob of neutral control and of the rule multiplies"]


WORLDS = (
    World("copper_net", "outages", ("mine", "mine_to_refinery")),
    World("carbo_net", "weather", ("reserve_to_vehicles", "reserve_to_heaters")),
    World("steel_japan", "japan_shocks", ("ore_imports",)),
    World("copper_world", "shocks", ("mining",)),
    World("paper_city", "breakdowns", ("feed", "bales_to_mill", "virgin_fibre")),
    World("car_batteries", "adoption", ("mining", "to_second_use")),
    World("food_bank", "gluts", ("ordering",)),
)


class Supplied(Controller):
    """Another controller, of which what some agents order is multiplied by a factor, within their bounds."""

    def __init__(self, controller: Controller, suppliers: Sequence[str], factor: float) -> None:
        """Take whom to listen to, whose orders to change, and the factor."""
        self._controller, self._suppliers, self._factor = controller, suppliers, factor

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start the other controller."""
        self._env = env
        self._controller.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return its actions, those of the suppliers changed."""
        actions = dict(self._controller.act(observations))
        orders = self._env.control_values(actions)
        for agent in self._suppliers:
            actions[agent] = self._env.normalise(agent, self._factor * orders[self._env.network.control_rows[agent]])
        return actions


def planned(network: Network, factor: float) -> Replay:
    """Return the plan for the expected network from the middle of its starts, if ``factor`` times as much is demanded.

    One program for the whole episode, with controls held within intervals, carried out whatever happens.
    """
    services = tuple(replace(s, low=_times(s.low, factor)) for s in expected_network(network).services)
    wanting = replace(expected_network(network), services=services)
    env = MultiAgentVectorEnv(wanting, num_envs=1)
    nodes = (node.id for node in wanting.stores)
    env.reset(seed=0, options={"initial_state": dict(zip(nodes, wanting.initial.mean(axis=0).tolist(), strict=True))})
    planner = MPC(min_service=DEMANDED, replan=wanting.episode.horizon)
    planner.plan(env, 0, lambda share: None)
    actions = np.empty((wanting.episode.horizon, sum(a.shape[1] for a in env.neutral_action.values())))
    for step in range(len(actions)):
        action = env.stack(planner.act({}))
        actions[step] = action[:, 0]
        env.advance(action)
    return Replay(actions)


def _times(value: Value, factor: float) -> Value:
    if isinstance(value, Series):
        return replace(value, values=tuple(factor * part for part in value.values))
    return factor * value


def contenders(world: World, network: Network) -> Mapping[str, Callable[[float], Controller]]:
    """Return who acts, each for a setting of its knob."""
    return {
        "neutral": lambda factor: Supplied(Neutral(), world.suppliers, factor),
        "plan": lambda factor: planned(network, factor),
        "rule": lambda factor: Supplied(ScriptController(margin=factor), world.suppliers, factor),
    }


def least_level(run: Rollout) -> float:
    """Return the lowest expected level of a service."""
    return float(run.episode_levels.mean(axis=0).min())


def tuned(network: Network, controller: Callable[[float], Controller]) -> float:
    """Return the setting of the knob at which the lowest expected service is closest to what is demanded."""
    env = MultiAgentVectorEnv(network, num_envs=TUNED)
    levels: dict[float, float] = {}

    def off(factor: float) -> float:
        if factor not in levels:
            levels[factor] = least_level(rollout(env, controller(factor), seed=first_seed(1))) - DEMANDED
        return levels[factor]

    low = high = 1.0
    while off(high) < 0 and high < LIMITS[1]:
        low, high = high, high * SPREAD
    while off(low) > 0 and low > LIMITS[0]:
        low, high = low / SPREAD, low
    for _ in range(TRIES):
        if min(map(abs, levels.values())) < CLOSE / 4 or not off(low) < 0 < off(high):
            break
        middle = (low + high) / 2
        low, high = (middle, high) if off(middle) < 0 else (low, middle)
    return min(levels, key=lambda factor: abs(levels[factor]))


def measured(world: World) -> dict[str, Any]:
    """Return the figures of a world."""
    network = load_network(world.network).scenario(world.scenario)
    env, runs, figures = MultiAgentVectorEnv(network, num_envs=REPORTED), dict[str, Rollout](), dict[str, Any]()
    for name, controller in contenders(world, network).items():
        factor = tuned(network, controller)
        runs[name] = run = rollout(env, controller(factor), seed=first_seed(0))
        levels = dict(zip((s.id for s in network.services), run.episode_levels.T, strict=True))
        figures[name] = {
            "knob": factor,
            "circularity": over_episodes(run.episode_circularity).as_dict(),
            "worst_circularity": worst_mean(run.episode_circularity).as_dict(),
            "levels": {service: over_episodes(level, (0.0, 1.0)).as_dict() for service, level in levels.items()},
            "worst_levels": {service: worst_mean(level).as_dict() for service, level in levels.items()},
        }
        sys.stdout.write(f"{world.network} {name}: {json.dumps(figures[name])}\n")
        sys.stdout.flush()
    blind = max(BLIND, key=lambda name: (is_met(figures[name]), figures[name]["circularity"]["value"]))
    advantage = over_episodes(runs["rule"].episode_circularity - runs[blind].episode_circularity).as_dict()
    entry = {"scenario": world.scenario, "unit": network.mass_unit, "blind": blind, "advantage": advantage}
    return {**entry, "contenders": figures}


def is_met(figures: Mapping[str, Any]) -> bool:
    """Whether a contender comes as close to what is demanded as other draws allow."""
    return bool(min(level["value"] for level in figures["levels"].values()) > DEMANDED - 2 * CLOSE)


def table(results: Mapping[str, Any]) -> str:
    """Return what was measured as a table, and what it was made with."""
    columns = ("world", "who acts", "λ̄", "of the 5 % worst", "lowest service", "of the 5 % worst", "knob")
    return measured_table(columns, _rows(results))


def entries(results: Mapping[str, Any]) -> Iterator[tuple[World, Any]]:
    """Yield each world that was measured, and what came out."""
    return ((world, results[world.network]) for world in WORLDS if world.network in results)


def _rows(results: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for world, entry in entries(results):
        for name, figures in entry["contenders"].items():
            service = min(figures["levels"].items(), key=lambda item: float(item[1]["value"]))[0]
            place = f"`{world.network}`, {entry['scenario']}, {entry['unit']}" if name == "neutral" else ""
            worst, level = figures["worst_circularity"]["value"], figures["levels"][service]
            half = (level["high"] - level["low"]) / 2
            yield (
                place,
                name,
                _interval(figures["circularity"]),
                f"{worst:.0f}" if abs(worst) >= 1000 else f"{worst:.4g}",
                f"{level['value']:.4f} ± {half:.4f}{'' if is_met(figures) else ' (not met)'}",
                f"{figures['worst_levels'][service]['value']:.3f}",
                f"{figures['knob']:.3f}",
            )
        gain, blind = entry["advantage"], entry["contenders"][entry["blind"]]["circularity"]["value"]
        yield (
            "",
            f"rule less {entry['blind']}",
            _interval(gain),
            f"{gain['value'] / abs(blind):+.0%} of it",
            "",
            "",
            "",
        )


def _interval(figure: Mapping[str, float]) -> str:
    half = (figure["high"] - figure["low"]) / 2
    digits = max(0, 1 - math.floor(math.log10(half)))  # two that the interval leaves sure
    return f"{figure['value']:.{digits}f} ± {half:.{digits}f}"


def main() -> None:
    """Measure what is asked for, keep it, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("networks", nargs="*", metavar="NETWORK", help="default: all six")
    parser.add_argument("--table", action="store_true", help="measure nothing")
    options = parser.parse_args()
    results: dict[str, Any] = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
    for world in WORLDS:
        if not options.table and (not options.networks or world.network in options.networks):
            results[world.network] = measured(world)
            write_json(RESULTS, results)
    write_sections(DOCUMENT, {"uncertain": table(results)})


if __name__ == "__main__":
    main()
