"""The tables of docs/plans.md: how tight the bound is, what plans, search and MPC reach, what service costs.

``python benchmarks/bound.py`` measures all of them and writes them into the document; ``--only SECTION`` measures some.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

from benchmarks.document import made_with, write_sections
from cirl_marl import MultiAgentVectorEnv
from cirl_marl.controllers.rollout import EVALUATION_SEEDS, rollout, starting_stocks
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.optimum import (
    Bound,
    Envelope,
    Incumbent,
    Plan,
    bound,
    envelope,
    gap,
    improve_plan,
    search,
    simulate_plan,
)
from cirl_marl.optimum.mpc import MPC

DOCUMENT = Path(__file__).parent.parent / "docs" / "plans.md"
NETWORKS = ("copper_net", "carbo_net")
SERVICE = 0.99
"""Mean level demanded of every service, but in the section on its price."""
PRICED = 0.985
STEP = 0.005
"""Demanded levels differ by this for the difference quotient of the price."""
WEIGHTS = (0.5, 0.9)
"""Circularity weights of the ``team`` reward."""
STARTS = 32
EPISODES = 8
SOLVES = 3
console = Console(width=None if sys.stdout.isatty() else 140)
Rows = Iterator[str]


@dataclass(frozen=True)
class Section:
    """A table that is measured.

    Attributes:
        head: its columns.
        parts: what is measured, by name; each gives some rows.
    """

    head: tuple[str, ...]
    parts: Mapping[str, Callable[[], Rows]]


def main(
    only: Annotated[list[str] | None, typer.Option(help="Sections; default: all.")] = None,
    document: Annotated[Path, typer.Option(help="Whose tables are written.")] = DOCUMENT,
) -> None:
    """Measure the tables of docs/plans.md and write them into it."""
    known = _sections()
    for name in only or known:
        if name not in known:
            raise CirlError(unknown_name("section", name, known))
    chosen = {name: section for name, section in known.items() if name in (only or known)}
    columns = (TextColumn("{task.description}"), BarColumn(), TimeElapsedColumn())
    written = {}
    with Progress(*columns, console=console, disable=not console.is_terminal) as progress:
        task = progress.add_task("measuring", total=sum(len(section.parts) for section in chosen.values()))
        for name, section in chosen.items():
            lines = [_row(section.head), "|" + "-|" * len(section.head)]
            for what, measured in section.parts.items():
                progress.update(task, description=f"{name}: {what}")
                for line in measured():
                    console.print(f"{name}: {line}", soft_wrap=True, highlight=False, markup=False)
                    lines.append(line)
                progress.advance(task)
            written[name] = "\n".join(lines)
    write_sections(document, {**written, "made": made_with()})


def _sections() -> dict[str, Section]:
    return {
        "starts": Section(
            ("network", "programs solved", "largest excess", "mean excess", "CPU s of `at` per start"),
            {name: partial(_starts, name) for name in NETWORKS},
        ),
        "plans": Section(
            ("network", "degree", "bound on λ̄", "CPU s", "`plan`: λ̄, service", "`improve_plan`: λ̄, service", "gap"),
            {f"{name}, degree {d}": partial(_plan, name, d) for name in NETWORKS for d in (1, 2, 3)},
        ),
        "price": Section(
            (
                "network",
                "multiplier",
                "difference quotient",
                *(f"`team` with {weight:g} charges" for weight in WEIGHTS),
                *(f"ratio with {weight:g}" for weight in WEIGHTS),
                "weight with ratio 1",
            ),
            {name: partial(_price, name) for name in NETWORKS},
        ),
        "search": Section(
            (
                "network",
                "bound on λ̄",
                "`improve_plan`: λ̄, service",
                "population × iterations",
                "search: λ̄, service",
                "gap",
                "CPU s",
            ),
            {name: partial(_search, name) for name in NETWORKS},
        ),
        "unproved": Section(
            (
                "network",
                "neutral: λ̄, service",
                "scripted",
                "search",
                "penalised objectives",
                "population × iterations",
                "CPU s",
                "per episode",
            ),
            {
                "net_zero": partial(_unproved, "net_zero", None),
                "net_zero, droop": partial(_unproved, "net_zero", "droop"),
                "solids_net": partial(_unproved, "solids_net", None),
            },
        ),
        "mpc": Section(
            ("network", "control", "lowest service", "highest service", "gap", "CPU s for all"),
            {
                f"{name}, horizon {horizon}": partial(_mpc, name, horizon)
                for name in NETWORKS
                for horizon in (None, 40, 0)
            },
        ),
    }


def _starts(name: str) -> Rows:
    """Hold what a few solutions prove from drawn starts against what a program solved for each start proves."""
    starts = starting_stocks(MultiAgentVectorEnv(name, num_envs=STARTS), EVALUATION_SEEDS)
    members = envelope(name, starts, solves=SOLVES, min_service=SERVICE, degree=1).members
    best = np.array([bound(name, start, min_service=SERVICE, degree=1, near=members[0]).objective for start in starts])
    for count in range(1, SOLVES + 1):
        began = time.process_time()
        proved = Envelope(members[:count]).at(starts)
        seconds = (time.process_time() - began) / STARTS
        excess = (proved - best) / np.abs(best)
        yield _row((name, count, _percent(excess.max()), _percent(excess.mean()), f"{seconds:.3f}"))


def _plan(name: str, degree: int) -> Rows:
    """Hold plans for the middle of the initial ranges against their bounds."""
    began = time.process_time()
    found = bound(name, min_service=SERVICE, degree=degree)
    seconds = time.process_time() - began
    better = improve_plan(found)
    left = found.gap(simulate_plan(better).episode_circularity)[0]
    shown = f"{found.objective:.6g} {found.network.mass_unit}"
    yield _row((name, degree, shown, f"{seconds:.0f}", _achieved(found), _achieved(better), _percent(left)))


def _price(name: str) -> Rows:
    """Hold what the bound pays for service against what the ``team`` reward charges for its shortfall.

    Per unit of the level of every service, in λ̄: S services of weight g cost (1 − w)·g·S·(1 − level) beside w·λ/c.
    """
    found = bound(name, min_service=PRICED, degree=1)
    below, above = (bound(name, min_service=PRICED + step, degree=1, near=found).objective for step in (-STEP, STEP))
    network = found.network
    multiplier = -float(found.certificate.under[-len(network.services) :].sum())
    quotient = (below - above) / (2 * STEP)
    weights = {service.weight for service in network.services}
    if len(weights) != 1:
        raise CirlError(f"network '{name}': services of different weights {sorted(weights)} have no common price")
    scale = network.objective.circularity_scale * weights.pop() * len(network.services)
    charges = [(1 - weight) / weight * scale for weight in WEIGHTS]
    ratios = [f"{charge / multiplier:.3g}" for charge in charges]
    prices = [f"{each:.5g} {network.mass_unit}" for each in (multiplier, quotient, *charges)]
    yield _row((name, *prices, *ratios, f"{scale / (scale + multiplier):.3f}"))


def _search(name: str) -> Rows:
    """Hold the search from the first evaluated episode against the bound of degree 2 from there."""
    start = starting_stocks(MultiAgentVectorEnv(name, num_envs=1), EVALUATION_SEEDS)[0]
    proved = bound(name, start, min_service=SERVICE, degree=2)
    shown = [f"{proved.objective:.5g} {proved.network.mass_unit}", _achieved(improve_plan(proved))]
    for population, iterations in ((64, 30), (64, 150), (256, 300)):
        began = time.process_time()
        found = search(name, min_service=SERVICE, population=population, iterations=iterations)
        seconds = time.process_time() - began
        cells = [_figures(found.circularity, found.service), _percent(float(proved.gap(found.circularity)))]
        yield _row((name, *shown, f"{population} × {iterations}", *cells, f"{seconds:.0f}"))


def _unproved(name: str, scenario: str | None) -> Rows:
    """Search where nothing is proved; solids_net weighs service with 1, the others demand it."""
    weight = 1.0 if name == "solids_net" else None
    population, iterations = (64, 30) if weight is None else (16, 20)
    began = time.process_time()
    found = search(
        name,
        scenario=scenario,
        service_weight=weight,
        min_service=SERVICE if weight is None else None,
        population=population,
        iterations=iterations,
    )
    seconds = time.process_time() - began
    reached = [found.candidates["neutral"], found.candidates["scripted"], (found.circularity, found.service)]
    cells = [_figures(*figures) for figures in reached]
    if np.allclose(reached[0], reached[1], rtol=1e-12):
        cells[1] = "no scripts"
    yield _row(
        (
            name if scenario is None else f"{name}, {scenario}",
            *cells,
            ", ".join(f"{_merit(found, *figures, weight):.3g}" for figures in reached),
            f"{population} × {iterations}",
            f"{seconds:.0f}",
            f"{seconds / found.evaluations:.2g}",
        )
    )


def _merit(found: Incumbent, circularity: float, service: float, weight: float | None) -> float:
    """Return λ̄/scale, plus service if it is weighed."""
    return circularity / found.network.objective.circularity_scale + (0.0 if weight is None else weight * service)


def _mpc(name: str, horizon: int | None) -> Rows:
    """Run MPC from drawn starts, or with horizon 0 the open-loop plans, and hold it against the bound of degree 2."""
    env = MultiAgentVectorEnv(name, num_envs=EPISODES)
    starts = starting_stocks(env, EVALUATION_SEEDS)
    began = time.process_time()
    if horizon == 0:
        plans = [bound(name, start, min_service=SERVICE, degree=1) for start in starts]
        run, label = rollout(env, Plan(plans)), "plans of degree 1, open loop"
    else:
        run, label = rollout(env, MPC(horizon=horizon, min_service=SERVICE)), f"MPC, horizon={horizon}"
    seconds = time.process_time() - began
    proved = envelope(name, starts, min_service=SERVICE).at(starts, np.minimum(1.0, run.episode_levels))
    gaps = gap(proved, run.episode_circularity)
    service = run.least_service
    shown = f"{_percent(gaps.min())} to {_percent(gaps.max())}"
    yield _row((name, label, f"{service.min():.4f}", f"{service.max():.4f}", shown, f"{seconds:.0f}"))


def _achieved(plan: Bound) -> str:
    run = simulate_plan(plan)
    return _figures(float(run.episode_circularity[0]), float(run.episode_service[0]))


def _figures(circularity: float, service: float) -> str:
    return f"{circularity:.6g}, {service:.4f}"


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %"


def _row(cells: tuple[object, ...]) -> str:
    return f"| {' | '.join(str(cell) for cell in cells)} |"


if __name__ == "__main__":
    typer.run(main)
