"""What large yearly networks cost: memory, a simulated year, the linear program of the bound; ``benchmarks/README.md``.

python -m benchmarks.large              # networks of 1 386 to a million arcs, and programs
python -m benchmarks.large --regions 33              # one of them, here, as a line of JSON
python -m benchmarks.large --regions 33 --program    # its program
python -m benchmarks.large --markets 3000            # markets that pass to each other at random

Each network is measured in a process of its own, so that peaks of memory are its own; times are processor time.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.document import markdown_table, write_sections
from benchmarks.generated import market_network, yearly_network
from cirl_marl import MultiAgentVectorEnv, Network
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.options import starting_stocks
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.solver import solve

DOCUMENT = Path(__file__).parent / "README.md"
REGIONS = (33, 120, 480, 2400, 24_000)
"""Regions of the networks that are simulated: each has 15 nodes and 42 arcs."""
MARKETS = (300, 1000, 3000, 10_000)
"""Markets of the random networks that are simulated."""
SOLVED = (8, 16)
"""Regions of those whose program is solved."""
YEARS = 30
"""Years that are timed."""


def simulated(make: Callable[[], Network]) -> dict[str, float]:
    """Return what a network costs to make, to compile and to simulate."""
    begun = time.process_time()
    network = make()
    made = time.process_time()
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    compiled, mass = time.process_time(), float(env.physical.stock.sum())
    actions = {agent: np.zeros((1, 1)) for agent in env.agents}
    for _ in range(YEARS - 1):
        env.step(actions)
    drift = abs(float(env.physical.stock.sum()) / mass - 1.0)
    env.step(actions)  # at the end of it the next episode begins
    done = time.process_time()
    return {
        "arcs": len(network.arcs),
        "nodes": len(network.nodes),
        "made": made - begun,
        "compiled": compiled - made,
        "year": (done - compiled) / YEARS,
        "memory": _peak(),
        "kept": len(env.dynamics.routing.detours.kept_nodes),
        "core": len(env.dynamics.routing.detours.elimination.core),
        "drift": drift,
    }


def solved(regions: int) -> dict[str, float]:
    """Return what the program of degree 1 for the bound on λ̄ costs to write and to solve."""
    network = yearly_network(regions=regions)
    begun = time.process_time()
    admissible = Admissible.of(network, None)
    program = Programs(admissible, 1, None).program(starting_stocks(admissible.lifetimes, None))
    written = time.process_time()
    memory = _peak()
    solve(program)
    done = time.process_time()
    return {
        "arcs": len(network.arcs),
        "variables": len(program.cost),
        "entries": program.equal.nnz + program.under.nnz,
        "written": written - begun,
        "written_memory": memory,
        "solved": done - written,
        "memory": _peak(),
    }


def _peak() -> float:
    """Return the most memory that the process has had, GB."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e6


def _apart(*options: str) -> dict[str, float]:
    """Measure a network in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.large", *options]
    found: dict[str, float] = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    return found


def simulation_table(option: str, sizes: Sequence[int]) -> str:
    """Return the table of networks that are simulated."""
    rows = []
    for size in sizes:
        found = _apart(option, str(size))
        rows.append(
            (
                f"{found['arcs']:,.0f}",
                f"{found['nodes']:,.0f}",
                f"{found['kept']:,.0f}",
                f"{found['core']:,.0f}",
                f"{found['made']:.1f}",
                f"{found['compiled']:.1f}",
                f"{1e3 * found['year']:.3g}",
                f"{1e6 * found['year'] / found['arcs']:.2g}",
                f"{found['memory']:.2g}",
            )
        )
    header = ("arcs", "nodes", "kept", "core", "made, s", "compiled, s", "a year, ms", "per arc, µs", "memory, GB")
    return markdown_table(header, rows)


def program_table() -> str:
    """Return the table of programs that are solved."""
    rows = []
    for regions in SOLVED:
        found = _apart("--regions", str(regions), "--program")
        rows.append(
            (
                f"{found['arcs']:,.0f}",
                f"{found['variables']:,.0f}",
                f"{found['entries']:,.0f}",
                f"{found['written']:.1f}",
                f"{found['solved']:.0f}",
                f"{found['memory']:.2g}",
            )
        )
    return markdown_table(("arcs", "variables", "entries", "written, s", "solved, s", "memory, GB"), rows)


def main() -> None:
    """Write the tables, or measure one network."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--regions", type=int, help="measure the network of so many regions alone")
    parser.add_argument("--markets", type=int, help="measure the random network of so many markets alone")
    parser.add_argument("--program", action="store_true", help="its program instead of its simulation")
    given = parser.parse_args()
    if given.regions is None and given.markets is None:
        sections = {"large": simulation_table("--regions", REGIONS), "large_programs": program_table()}
        write_sections(DOCUMENT, sections | {"large_markets": simulation_table("--markets", MARKETS)})
        return
    if given.program:
        found = solved(given.regions)
    elif given.markets is not None:
        found = simulated(partial(market_network, given.markets))
    else:
        found = simulated(partial(yearly_network, regions=given.regions))
    sys.stdout.write(json.dumps(found) + "\n")


if __name__ == "__main__":
    main()
