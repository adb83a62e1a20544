"""What policies reach that do not know the future, held against the bound for them and against perfect information.

python -m benchmarks.foresight [NETWORK ...]            # bounds worlds of benchmarks.uncertain, and who acts there
python -m benchmarks.foresight paper_city --only mpc    # measures some; what is known of others stays
python -m benchmarks.foresight paper_city --information # what it costs MPC to see disturbances late, or never
python -m benchmarks.foresight paper_city --sight       # what learners gain from seeing more, and lose by seeing less
python -m benchmarks.foresight --table                  # writes the tables of what is kept in results/foresight.json

Each contender has a knob, which is set on draws of its own so that the lowest expected service is what is demanded; all
figures are of the draws of the bound, or of the first of them. Bounds are kept in results/bounds and used again.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.document import markdown_table, measured_table, write_sections
from benchmarks.food_bank import BestOrders, SafetyStock
from benchmarks.uncertain import CLOSE, DEMANDED, WORLDS, World, entries
from benchmarks.uncertain import RESULTS as KNOBS
from benchmarks.uncertain import contenders as simple_contenders
from cirl_marl import MultiAgentVectorEnv, Network, Trained, bound, load_network, train
from cirl_marl.controllers import Controller
from cirl_marl.controllers.basic import Arrays
from cirl_marl.controllers.rollout import Rollout, first_seed, rollout
from cirl_marl.definitions.writer import fingerprint
from cirl_marl.evaluation.calibration import Calibration, calibrate
from cirl_marl.evaluation.statistics import Aggregate, over_episodes, worst_mean
from cirl_marl.network import Floats
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.draws import Prices
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.registry import controllers_by_margin
from cirl_marl.optimum.uncertain_bound import UncertainBound
from cirl_marl.records.files import write_atomically, write_json

DOCUMENT = Path(__file__).parent.parent / "docs" / "uncertainty.md"
RESULTS = Path(__file__).parent / "results" / "foresight.json"
BOUNDS = Path(__file__).parent / "results" / "bounds"
RUNS = Path("runs") / "foresight"
WINDOW, FUTURES, DEAR = 3, 4, 3.0
"""Decisions that MPC looks ahead, futures that scenario MPC plans for, and the margin of MPC with a reserve."""
SIMPLE = ("neutral", "plan", "rule")
"""Contenders of ``benchmarks.uncertain``, whose knobs are set there."""
CERTAIN = ("safety_stock", "mpc_with_reserve", "mpc")
"""Certainty-equivalent MPC: learners are compared to the first of these that was measured."""
PLANNERS = (*CERTAIN, "scenario_mpc", "price_policy")
"""Contenders that solve a program for every decision, of which fewer episodes are measured."""
LEARNERS = ("exact_gradients", "guided_ppo", "guided_td3")
"""Recipes of independent learners, who see what is local; prices in their training see to their service."""
NEVER = -1
LATE = {"at once": 0, "an interval late": 1, "four intervals late": 4, "never": NEVER}
"""How late disturbances are seen, in intervals, by name; stocks always are."""
DELAYED = [*LATE][1:]
SIGHT: Mapping[str, tuple[Mapping[str, Any], Mapping[str, Any]]] = {
    "local": ({"mode": "local"}, {}),
    "neighbours": ({"mode": "neighbours"}, {}),
    "all stocks": ({"mode": "full"}, {}),
    "late": ({"mode": "local"}, {"delayed": 1}),
    "never": ({"mode": "local"}, {"observed": "none"}),
    "forecasts of 1": ({"mode": "local"}, {"forecast": 1}),
    "of 4": ({"mode": "local"}, {"forecast": 4}),
}
"""What learners see, by name: how they observe, and what is seen of every disturbance; the first is compared to."""
BY_DRAW, PRICES = (
    ("values", "informed_values", "luck", "informed_luck", "gross_mass"),
    ("prices", "informed_prices"),
)
"""What is kept of a bound."""
NOTICEABLE = 0.001
"""Least processor time of a decision that is told, ms."""
Maker = Callable[..., Controller]


def _simple(name: str, world: World, found: UncertainBound) -> Maker:
    """Return a contender of ``benchmarks.uncertain``."""
    controller = simple_contenders(world, found.network)[name]
    return lambda margin: controller(margin)


CONTENDERS: Mapping[str, Callable[[World, UncertainBound], Maker]] = {
    "best_constant": lambda world, found: controllers_by_margin("best_constant", min_service=DEMANDED),
    "best_schedule": lambda world, found: controllers_by_margin("best_schedule", min_service=DEMANDED),
    **{name: partial(_simple, name) for name in SIMPLE},
    "mpc": lambda world, found: partial(MPC, min_service=DEMANDED, horizon=WINDOW),
    "mpc_with_reserve": lambda world, found: (
        lambda margin: MPC(min_service=DEMANDED, horizon=WINDOW, margin=DEAR, reserve=margin)
    ),
    "scenario_mpc": lambda world, found: partial(MPC, min_service=DEMANDED, horizon=WINDOW, futures=FUTURES),
    "price_policy": lambda world, found: partial(MPC, min_service=DEMANDED, prices=found.prices),
    "safety_stock": lambda world, found: partial(
        SafetyStock, found.network, {"min_service": DEMANDED, "horizon": WINDOW, "margin": DEAR}
    ),
    "dynamic_programming": lambda world, found: partial(BestOrders, found.network),
}
"""Who acts, by name: what makes a controller with a ``margin`` in a world, given its bound."""
SMALL = dict.fromkeys(("safety_stock", "dynamic_programming"), "food_bank")
"""Contenders that can act in a single world."""


class Alternating(Controller):
    """Teams that take turns: of n teams team k acts in the copies k, k + n, and so on."""

    def __init__(self, teams: Sequence[Controller]) -> None:
        """Take the teams."""
        self._teams = teams

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start every team."""
        for team in self._teams:
            team.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return in each copy what its team does."""
        actions = {agent: rows.copy() for agent, rows in self._teams[0].act(observations).items()}
        for k, team in enumerate(self._teams[1:], 1):
            for agent, rows in team.act(observations).items():
                actions[agent][k :: len(self._teams)] = rows[k :: len(self._teams)]
        return actions


def seen_by(network: Network, sight: str) -> Network:
    """Return a network in which agents see what ``SIGHT`` says."""
    observation, seen = SIGHT[sight]
    network = network.with_options(observation=observation)
    if not seen:
        return network
    seen = {"observed": "now", "delayed": 0, "forecast": 0, **seen}
    disturbances = {id_: replace(disturbance, **seen) for id_, disturbance in network.disturbances.items()}
    return replace(network, disturbances=disturbances)


def learners(recipe: str, network: Network, sight: str, seeds: Sequence[int], steps: int | None) -> list[Controller]:
    """Return what a recipe learns in a network from several seeds; runs are kept in runs/foresight, and used again."""
    teams = list[Controller]()
    for seed in seeds:
        directory = RUNS / "-".join((network.name, *sight.split(), recipe, str(seed)))
        if not directory.is_dir():
            train(network, recipe, seed=seed, steps=steps, directory=directory)
        teams.append(Trained(directory))
    return teams


def _whatever_margin(controller: Controller) -> Maker:
    return lambda margin: controller


def proof(world: World, sampling: Sampling) -> tuple[UncertainBound, float]:
    """Return the bound of a world without its certificates, and the processor time that it took, s.

    It is kept in a file, for contenders that come later; what is proved of draws is kept in runs/foresight meanwhile.
    """
    network = load_network(world.network).scenario(world.scenario)
    path, question = BOUNDS / f"{world.network}.npz", f"{fingerprint(network)} {DEMANDED} {sampling}"
    if path.is_file():
        with np.load(path) as arrays:
            if str(arrays["question"]) == question:
                return _kept(network, sampling, arrays), float(arrays["seconds"])
    began = time.process_time()
    found = bound(
        network,
        min_service=DEMANDED,
        degree=1,
        uncertain=replace(sampling, directory=RUNS / f"{network.name}-draws"),
    )
    seconds = time.process_time() - began
    _keep(path, found, question=np.array(question), seconds=np.array(seconds))
    return found, seconds


def _keep(path: Path, found: UncertainBound, **about: Any) -> None:
    arrays = {name: getattr(found, name) for name in BY_DRAW} | about
    for name in PRICES:
        arrays |= {f"{name}.{part.name}": getattr(getattr(found, name), part.name) for part in fields(Prices)}
    BOUNDS.mkdir(exist_ok=True)

    def write(place: Path) -> None:
        with place.open("wb") as file:
            np.savez_compressed(file, **arrays)

    write_atomically(path, write)


def _kept(network: Network, sampling: Sampling, arrays: Mapping[str, Any]) -> UncertainBound:
    prices = {name: Prices(**{part.name: arrays[f"{name}.{part.name}"] for part in fields(Prices)}) for name in PRICES}
    return UncertainBound(
        network=network,
        agents=MultiAgentVectorEnv(network, num_envs=1).agents,
        initial=None,
        degree=1,
        sampling=sampling,
        min_service=prices["prices"].demand,
        certificates=(),
        prices=prices["prices"],
        informed_prices=prices["informed_prices"],
        **{name: arrays[name] for name in BY_DRAW},
    )


def bound_figures(found: UncertainBound, seconds: float) -> dict[str, Any]:
    """Return the figures of a bound."""
    return {
        "bound": found.value,
        "half_width": found.half_width / found.scale,
        "perfect_information": found.perfect_information,
        "draws": found.sampling.draws,
        "fit_draws": found.sampling.fit_draws,
        "seconds": seconds,
        "unit": found.network.mass_unit,
    }


def measured(
    name: str, make: Maker, found: UncertainBound, tune: int | None, episodes: int, margin: ArrayLike = 1.0
) -> dict[str, Any]:
    """Return the figures of a contender on the first draws of a bound, its margin set on others if ``tune`` says so."""
    network, figures = found.network, dict[str, Any]()
    if tune is not None:
        calibration = calibration_of(network, make, tune)
        margin, figures = calibration.margin, {"tuned_on": tune, "excess": calibration.excess}
    run, gaps = played(found, network, make(margin=margin), episodes)
    informed_gaps = found.gaps(run.episode_circularity, run.episode_levels, with_foresight=True)
    figures |= {"gap": over_episodes(gaps).as_dict(), "foresight_gap": over_episodes(informed_gaps).as_dict()}
    if name in PLANNERS:
        figures["gap_by_draw"] = gaps.tolist()
    figures |= {
        "knob": margin,
        "draws": episodes,
        "circularity": over_episodes(run.episode_circularity).as_dict(),
        "worst_circularity": worst_mean(run.episode_circularity).as_dict(),
        "levels": _by_service(network, run, _expected_level),
        "worst_levels": _by_service(network, run, worst_mean),
        "milliseconds": 1e3 * run.control_seconds / run.circularity.size,
    }
    sys.stdout.write(f"{network.name} {name}: {json.dumps(figures)}\n")
    sys.stdout.flush()
    return figures


def played(found: UncertainBound, network: Network, controller: Controller, draws: int) -> tuple[Rollout, Floats]:
    """Return the episodes of a controller in the first draws of a bound, and the gap of each."""
    run = rollout(MultiAgentVectorEnv(network, num_envs=draws), controller, seed=first_seed(found.sampling.seed))
    return run, found.gaps(run.episode_circularity, run.episode_levels)


def less_than_planner(found: UncertainBound, teams: Sequence[Controller], gaps: Sequence[float]) -> dict[str, Any]:
    """Return by how much the gaps of teams, who all play every draw, are less than the ``gaps`` of a planner there.

    The interval is over draws, the mean of the teams in each; beside it stands the difference of each team alone.
    """
    own = np.stack([played(found, found.network, team, len(gaps))[1] for team in teams])
    less = np.array(gaps) - own
    return {**over_episodes(less.mean(axis=0)).as_dict(), "by_seed": less.mean(axis=1).tolist(), "draws": len(gaps)}


def _by_service(network: Network, run: Rollout, figure: Callable[[Floats], Aggregate]) -> dict[str, Any]:
    """Return a figure of the mean level of each service, by its id."""
    levels = zip(network.services, run.episode_levels.T, strict=True)
    return {service.id: figure(level).as_dict() for service, level in levels}


def _expected_level(levels: Floats) -> Aggregate:
    return over_episodes(levels, (0.0, 1.0))


def calibration_of(network: Network, make: Maker, draws: int) -> Calibration:
    """Return the margin at which what is made delivers what is demanded, on draws of its own."""
    demand = np.full(len(network.services), DEMANDED)
    return calibrate(lambda copies: MultiAgentVectorEnv(network, num_envs=copies), make, demand, draws)


def information(world: World, found: UncertainBound, tune: int, episodes: int) -> dict[str, Any]:
    """Return the gaps of MPC that sees disturbances late, its knob set anew, and what is lost to that at once."""
    network, figures, gaps = found.network, dict[str, Any](), dict[str, Floats]()
    for name, delay in LATE.items():
        late = network.episode.horizon if delay == NEVER else delay
        planner = partial(MPC, min_service=DEMANDED, horizon=WINDOW, delay=late)
        margin = calibration_of(network, planner, tune).margin
        run, gaps[name] = played(found, network, planner(margin=margin), episodes)
        figures[name] = {
            "gap": over_episodes(gaps[name]).as_dict(),
            "loss": over_episodes(gaps[name] - gaps["at once"]).as_dict(),
            "knob": margin,
            "levels": _by_service(network, run, _expected_level),
        }
        sys.stdout.write(f"{world.network} {name}: {json.dumps(figures[name])}\n")
        sys.stdout.flush()
    return {"draws": episodes, "seen": figures}


def value_of_sight(
    world: World, found: UncertainBound, recipe: str, seeds: int, steps: int | None, sights: Collection[str]
) -> dict[str, Any]:
    """Return the gaps of what a recipe learns from each of some ``seeds``, by what it sees, and what that gains."""
    figures, gaps = dict[str, Any](), dict[str, Floats]()
    for sight in sights:
        network, means, levels = seen_by(found.network, sight), list[float](), list[float]()
        for seed in range(1, seeds + 1):
            (team,) = learners(recipe, network, sight, [seed], steps)
            run, own = played(found, network, team, found.sampling.draws)
            means.append(float(own.mean()))
            levels.append(float(run.episode_levels.mean(axis=0).min()))
        gaps[sight] = np.array(means)
        figures[sight] = {
            "gap": over_episodes(gaps[sight]).as_dict(),
            "change": over_episodes(gaps[sight] - gaps["local"]).as_dict(),
            "level": min(levels),
        }
        sys.stdout.write(f"{world.network} {sight}: {json.dumps(figures[sight])}\n")
        sys.stdout.flush()
    return {"seeds": seeds, "steps": steps, "seen": figures}


def sight_table(results: Mapping[str, Any]) -> str:
    """Return what learners gain from seeing more, a row for each world."""
    others, rows = [*SIGHT][1:], []
    for world, entry in entries(results):
        if "sight" in entry:
            seen = entry["sight"]["seen"]
            changes = (_percent(seen[name]["change"], signed=True) if name in seen else "" for name in others)
            level = f"{min(figures['level'] for figures in seen.values()):.4f}"
            rows.append(
                (f"`{world.network}`", _percent(seen["local"]["gap"]), *changes, level, str(entry["sight"]["seeds"]))
            )
    return markdown_table(("world", "gap if all is local, %", *others, "lowest service", "seeds"), rows)


def information_table(results: Mapping[str, Any]) -> str:
    """Return what it costs to see late, a row for each world."""
    rows = []
    for world, entry in entries(results):
        if "information" in entry:
            seen = entry["information"]["seen"]
            cells = [_percent(seen["at once"]["gap"]), *(_percent(seen[name]["loss"], signed=True) for name in DELAYED)]
            services = [_service(seen[name]["levels"]) for name in LATE]
            cells = [f"{cell}<br>{service}" for cell, service in zip(cells, services, strict=True)]
            rows.append((f"`{world.network}`", *cells, str(entry["information"]["draws"])))
    return markdown_table(("world", "gap if seen at once, %", *DELAYED, "draws"), rows)


def table(results: Mapping[str, Any]) -> str:
    """Return what was measured as a table, and what it was made with."""
    columns = (
        "world",
        "who acts",
        "gap to the bound, %",
        "less than MPC's, paired, %",
        "lowest service",
        "λ̄",
        "of the 5 % worst",
        "ms",
        "draws",
    )
    return measured_table(columns, _rows(results))


def _rows(results: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for world, entry in entries(results):
        value, informed = entry["bound"], entry["perfect_information"]
        least = f"{_mass(value)} + {100 * entry['half_width']:.2f} %"
        yield f"`{world.network}`, {entry['unit']}", "bound", *[""] * 3, least, "", "", f"{entry['draws']}"
        yield "", "perfect information", *[""] * 3, _mass(informed), "", "", f"{entry['draws']}"
        for name in [name for name in (*CONTENDERS, *LEARNERS) if name in entry["contenders"]]:
            figures = entry["contenders"][name]
            yield (
                "",
                name.replace("_", " ") + (f", seeds: {figures['seeds']}" if name in LEARNERS else ""),
                _percent(figures["gap"]),
                _percent(figures["less_than_mpc"], signed=True) if "less_than_mpc" in figures else "",
                _service(figures["levels"]),
                _mass(figures["circularity"]["value"], figures["circularity"]),
                _mass(figures["worst_circularity"]["value"], figures["worst_circularity"]),
                _time(figures["milliseconds"]),
                f"{figures['draws']}",
            )


def _mass(value: float, interval: Mapping[str, float] | None = None) -> str:
    digits = 0 if abs(value) >= 1000 else max(0, 3 - math.floor(math.log10(max(abs(value), 1e-9))))
    doubt = "" if interval is None else f" ± {(interval['high'] - interval['low']) / 2:.{digits}f}"
    return f"{value:.{digits}f}{doubt}"


def _time(milliseconds: float) -> str:
    return "" if milliseconds < NOTICEABLE else f"{milliseconds:.{0 if milliseconds >= 1 else 3}f}"


def _service(levels: Mapping[str, Mapping[str, float]]) -> str:
    """Return the lowest expected level with its interval, and whether that is not within CLOSE of what is demanded."""
    level = min(levels.values(), key=lambda figure: figure["value"])
    doubt, off = (level["high"] - level["low"]) / 2, abs(level["value"] - DEMANDED)
    return f"{level['value']:.4f} ± {doubt:.4f}{' (missed)' if off > CLOSE + doubt else ''}"


def _percent(figure: Mapping[str, float], signed: bool = False) -> str:
    return f"{100 * figure['value']:{'+' if signed else ''}.2f} ± {50 * (figure['high'] - figure['low']):.2f}"


def main() -> None:
    """Measure what is asked for, keep it, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("networks", nargs="*", metavar="NETWORK", help="default: all")
    parser.add_argument("--table", action="store_true", help="measure nothing")
    everything = ",".join((*CONTENDERS, *LEARNERS, *SIGHT))
    parser.add_argument("--only", default=everything, help="contenders, or what learners see; default: all")
    parser.add_argument("--information", action="store_true", help="of MPC, instead")
    parser.add_argument("--sight", action="store_true", help="what learners gain from it, instead")
    parser.add_argument("--draws", type=int, default=200, help="of which the bound is the mean")
    parser.add_argument("--fit-draws", type=int, default=64, help="others, to which prices are fitted")
    parser.add_argument("--tune", type=int, default=32, help="draws on which margins of those that plan are set")
    parser.add_argument("--seeds", type=int, default=2, help="trainings of learners, which take turns in the draws")
    parser.add_argument("--steps", type=int, help="of a training; default: the recipe's")
    parser.add_argument("--episodes", type=int, default=64, help="of those that plan for every decision")
    options = parser.parse_args()
    for world in WORLDS:
        if options.table or (options.networks and world.network not in options.networks):
            continue
        found, seconds = proof(world, Sampling(draws=options.draws, fit_draws=options.fit_draws, numbers=False))
        if options.information:
            figures = information(world, found, options.tune, options.episodes)
            results = json.loads(RESULTS.read_text())
            results[world.network]["information"] = figures
            write_json(RESULTS, results)
            continue
        if options.sight:
            sights = [name for name in SIGHT if name in ("local", *options.only.split(","))]
            gained = value_of_sight(world, found, LEARNERS[0], options.seeds, options.steps, sights)
            results = json.loads(RESULTS.read_text())
            known = results[world.network].get("sight", gained)
            if known["seen"]["local"] == gained["seen"]["local"]:  # the same learners: others are compared to them, too
                gained["seen"] = known["seen"] | gained["seen"]
            results[world.network]["sight"] = gained
            write_json(RESULTS, results)
            continue
        for name in options.only.split(","):
            if name in SIGHT or SMALL.get(name, world.network) != world.network:
                continue
            episodes = min(options.episodes, options.draws) if name in PLANNERS else options.draws
            seen, tune, margin = found, options.tune, 1.0
            if name in SIMPLE:
                tune, margin = None, json.loads(KNOBS.read_text())[world.network]["contenders"][name]["knob"]
            if name in LEARNERS:
                seen = replace(found, network=seen_by(found.network, "local"))
                seeds = range(1, options.seeds + 1)
                teams = learners(name, seen.network, "local", seeds, options.steps)
                tune, make = None, _whatever_margin(Alternating(teams))
            else:
                make = CONTENDERS[name](world, found)
            figures = measured(name, make, seen, tune, episodes, margin)
            results = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
            entry = results.get(world.network, {})
            rows = entry.get("contenders", {})
            if name in LEARNERS:
                figures |= {"seeds": options.seeds, "steps": options.steps}
                figures["milliseconds"] /= options.seeds  # all teams act in all draws
                for gaps in [rows[p]["gap_by_draw"] for p in CERTAIN if "gap_by_draw" in rows.get(p, {})][:1]:
                    figures["less_than_mpc"] = less_than_planner(seen, teams, gaps)
            rows = {**rows, name: figures}
            results[world.network] = {**entry, **bound_figures(found, seconds), "contenders": rows}
            write_json(RESULTS, results)
    results = json.loads(RESULTS.read_text())
    write_sections(
        DOCUMENT,
        {"foresight": table(results), "information": information_table(results), "sight": sight_table(results)},
    )


if __name__ == "__main__":
    main()
