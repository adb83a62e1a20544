"""Makes what is frozen of the benchmark: bounds of tasks and of their held-out variants, and the page about it.

python -m benchmarks.suite [TASK ...]   # bounds that are missing, then their hashes in suite.toml
python -m benchmarks.suite --table      # tables and picture of docs/benchmark.md, of the rows that are kept

A world with disturbances takes the bound of benchmarks.foresight for its own episodes; its variants have fewer draws.
"""

from __future__ import annotations

import hashlib
import sys
from pathlib import Path

import numpy as np
import tomlkit

from benchmarks.document import made_with, markdown_table, write_sections
from benchmarks.foresight import proof
from benchmarks.uncertain import WORLDS
from cirl_marl.controllers.rollout import first_seed, starting_stocks
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network import Network
from cirl_marl.optimum import Sampling, UncertainBound, bound
from cirl_marl.optimum.options import demanded_levels
from cirl_marl.records.files import write_atomically
from cirl_marl.report.benchmark_tables import TABLES, save_profiles
from cirl_marl.suite.result_rows import read_rows
from cirl_marl.suite.task_bounds import TaskBound, row_names, values_at
from cirl_marl.suite.tasks import (
    CONTROLLERS,
    DECLARATION,
    HELD_OUT_EPISODES,
    VARIANTS,
    BenchmarkTask,
    algorithms,
    load_task,
    tasks,
)

DRAWS, FIT_DRAWS = 200, 64
DOCUMENT = Path(__file__).parent.parent / "docs" / "benchmark.md"
SECTIONS = {
    "gaps": "gap to the bound",
    "scores": "scores over all tasks",
    "improvement": "probability of improvement",
    "transfer": "transfer",
}
"""Marks of the document, and tables by their titles."""


def prove(network: Network, episodes: int, seed: int, min_service: float) -> TaskBound:
    """Bound a network whose future is known, for the starts of an evaluation, by one program at their mean.

    Raises:
        CirlError: for a service out of reach, or a network for which nothing is proved.
    """
    starts = starting_stocks(MultiAgentVectorEnv(network, num_envs=episodes), first_seed(seed))
    solution = bound(network, starts.mean(axis=0), min_service=min_service)
    demand = demanded_levels(solution.network, min_service)
    values = values_at(network, starts, solution.certificate, demand)
    # the last rows of the program demand the services; of them μ are the multipliers
    prices = -np.minimum(solution.certificate.under[-len(demand) :], 0.0) if len(demand) else np.zeros(0)
    return TaskBound(
        values=values,
        prices=prices,
        demand=demand,
        scale=abs(float(values.mean())),
        half_width=0.0,
        equal=solution.certificate.equal,
        under=solution.certificate.under,
        rows=row_names(solution.problem)[solution.certificate.under != 0],
    )


def of_draws(proof: UncertainBound) -> TaskBound:
    """Return what is needed of a bound for who does not foresee."""
    return TaskBound(
        values=proof.values,
        prices=proof.prices.service,
        demand=proof.prices.demand,
        scale=proof.scale,
        half_width=proof.half_width,
        equal=np.zeros(0),
        under=np.zeros(0),
        rows=np.zeros(0),
    )


def proved(task: BenchmarkTask) -> TaskBound:
    """Return the bound of a task or variant."""
    network = task.network()
    if not network.disturbed:
        return prove(network, task.episodes, task.seed, task.min_service)
    if task.variant:
        sampling = Sampling(draws=task.episodes, fit_draws=HELD_OUT_EPISODES, seed=task.seed, numbers=False)
        return of_draws(bound(network, min_service=task.min_service, degree=1, uncertain=sampling))
    world = next(world for world in WORLDS if (world.network, world.scenario) == (network.name, network.scenario_name))
    return of_draws(proof(world, Sampling(draws=DRAWS, fit_draws=FIT_DRAWS, numbers=False))[0])


def write_page() -> None:
    """Write the tables and the picture of the document, of the rows that are kept."""
    rows = read_rows()
    names = (*CONTROLLERS, *algorithms())
    counts = {name: sum(row.algorithm == name and not row.variant for row in rows) for name in names}
    present = ", ".join(f"`{name}` {count}" for name, count in counts.items() if count)
    missing = ", ".join(f"`{name}`" for name, count in counts.items() if not count)
    wanted = len(tasks()) * len(load_task(tasks()[0]).seeds)
    coverage = f"Rows so far, of {len(tasks())} of each controller and {wanted} of each learner: {present}."
    coverage += f" None yet: {missing}." if missing else ""
    sections = {"coverage": f"{coverage} {made_with()}"}
    for name, title in SECTIONS.items():
        headings, body = TABLES[title](rows)
        sections[name] = markdown_table(headings, body) if body else "No rows yet."
    write_sections(DOCUMENT, sections)
    save_profiles(DOCUMENT.parent / "pictures" / "benchmark.png", rows)


def main() -> None:
    """Compute what is missing, and write hashes."""
    if sys.argv[1:] == ["--table"]:
        return write_page()
    bases = [load_task(name) for name in sys.argv[1:] or tasks()]
    for task in (*bases, *(base.held_out(variant) for base in bases for variant in VARIANTS)):
        if not task.bound_path.is_file():
            proved(task).write(task.bound_path)
            sys.stdout.write(f"{task.bound_path}\n")
            sys.stdout.flush()
    document = tomlkit.parse(DECLARATION.read_text())
    for base in bases:
        paths = [base.bound_path, *(base.held_out(variant).bound_path for variant in VARIANTS)]
        hashes = [hashlib.sha256(path.read_bytes()).hexdigest() for path in paths if path.is_file()]
        document["tasks"][base.name]["sha256"] = hashes
    text = tomlkit.dumps(document)
    write_atomically(DECLARATION, lambda path: path.write_text(text))


if __name__ == "__main__":
    main()
