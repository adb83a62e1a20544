"""What policies reach that do not know the future, held against the bound for them and against perfect information.

python -m benchmarks.foresight [NETWORK ...]   # measures worlds of benchmarks.uncertain, and writes the table
python -m benchmarks.foresight --table         # writes the table of what is kept in results/foresight.json

Who acts, and the knobs, are those of ``benchmarks.uncertain``; the draws are others than those knobs were set on.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from benchmarks.document import measured_table, write_sections
from benchmarks.uncertain import DEMANDED, WORLDS, World, contenders, entries
from benchmarks.uncertain import RESULTS as KNOBS
from cirl_marl import MultiAgentVectorEnv, bound, load_network
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.evaluation.statistics import over_episodes
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.uncertain_bound import UncertainBound
from cirl_marl.records.files import write_json

DOCUMENT = Path(__file__).parent.parent / "docs" / "uncertainty.md"
RESULTS = Path(__file__).parent / "results" / "foresight.json"


def measured(world: World, sampling: Sampling) -> dict[str, Any]:
    """Return the figures of a world."""
    network, began = load_network(world.network).scenario(world.scenario), time.process_time()
    found = bound(network, min_service=DEMANDED, degree=1, uncertain=sampling)
    figures: dict[str, Any] = {
        "bound": found.value,
        "half_width": found.half_width / found.scale,
        "perfect_information": found.perfect_information,
        "draws": sampling.draws,
        "fit_draws": sampling.fit_draws,
        "seconds": time.process_time() - began,
        "unit": network.mass_unit,
    }
    sys.stdout.write(f"{found}: {figures}\n")
    return {**figures, "contenders": dict(_gaps(world, found))}


def _gaps(world: World, found: UncertainBound) -> Iterator[tuple[str, Any]]:
    knobs = json.loads(KNOBS.read_text())[world.network]["contenders"]
    env = MultiAgentVectorEnv(found.network, num_envs=len(found.values))
    for name, controller in contenders(world, found.network).items():
        run = rollout(env, controller(knobs[name]["knob"]), seed=first_seed(found.sampling.seed))
        gaps = (
            over_episodes(found.gaps(run.episode_circularity, run.episode_levels, with_foresight=informed)).as_dict()
            for informed in (False, True)
        )
        levels = run.episode_levels.mean(axis=0)
        figures = dict(zip(("gap", "foresight_gap"), gaps, strict=True))
        figures |= {"circularity": run.episode_circularity.mean(), "level": levels.min()}
        sys.stdout.write(f"{name}: {figures}\n")
        sys.stdout.flush()
        yield name, figures


def table(results: Mapping[str, Any]) -> str:
    """Return what was measured as a table, and what it was made with."""
    columns = ("world", "bound, + 95 %", "perfect information", "closed", "neutral", "plan", "rule", "draws")
    return measured_table(columns, _rows(results))


def _rows(results: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    for world, entry in entries(results):
        gaps = {name: figures["gap"] for name, figures in entry["contenders"].items()}
        best = min(figures["foresight_gap"]["value"] for figures in entry["contenders"].values())
        closed = (entry["perfect_information"] - entry["bound"]) / abs(entry["bound"]) / best
        yield (
            f"`{world.network}`, {entry['unit']}",
            f"{entry['bound']:.5g} + {100 * entry['half_width']:.2f} %",
            f"{entry['perfect_information']:.5g}",
            f"{100 * closed:z.1f} %",
            *(_percent(gaps[name]) for name in ("neutral", "plan", "rule")),
            f"{entry['draws']}",
        )


def _percent(figure: Mapping[str, float]) -> str:
    return f"{100 * figure['value']:.1f} ± {50 * (figure['high'] - figure['low']):.1f} %"


def main() -> None:
    """Measure what is asked for, keep it, and write the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("networks", nargs="*", metavar="NETWORK", help="default: all six")
    parser.add_argument("--table", action="store_true", help="measure nothing")
    parser.add_argument("--draws", type=int, default=200, help="of which the bound is the mean")
    parser.add_argument("--fit-draws", type=int, default=64, help="others, to which prices are fitted")
    options = parser.parse_args()
    for world in WORLDS:
        if not options.table and (not options.networks or world.network in options.networks):
            sampling = Sampling(draws=options.draws, fit_draws=options.fit_draws, numbers=False)
            figures = measured(world, sampling)
            results = json.loads(RESULTS.read_text()) if RESULTS.is_file() else {}
            write_json(RESULTS, {**results, world.network: figures})
    write_sections(DOCUMENT, {"foresight": table(json.loads(RESULTS.read_text()))})


if __name__ == "__main__":
    main()
