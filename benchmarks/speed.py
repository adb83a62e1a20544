"""How fast is the library, and against what? One table of figures and ratios; nothing is asserted.

Run it with ``python benchmarks/speed.py``. What is compared is measured in turns, A B A B …, in one process, because a
machine that does other things at the same time is not equally fast from one minute to the next.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import partial
from itertools import product
from pathlib import Path
from statistics import median
from typing import Annotated, Any
from unittest.mock import patch

import numpy as np
import torch
import typer
from numpy.typing import NDArray
from rich.console import Console
from rich.markup import escape
from rich.table import Table

from benchmarks.generated import (
    FreeEnv,
    Weights,
    learn_alone,
    learn_together,
    random_network,
    simple_spread,
    yearly_network,
)
from benchmarks.variants import without_substances
from cirl_marl import load_network, parallel_env
from cirl_marl.environments.derivatives import Derivatives
from cirl_marl.environments.parallel import NetworkParallelEnv
from cirl_marl.environments.state import State
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.learners.interface import train, train_seeds
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.network import Network
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect, Markov
from cirl_marl.records.machine import processor

console = Console(width=150)

COPIES, AGENTS = 1024, 16
LONE = 64
"""Lone environments stepped in turn; 1 024 of them cost 16 times as much."""
ARCS = (10, 100, 1_000, 10_000, 100_000, 1_000_000)
LEARNT, SEEDS = 10_240, 5
"""Environment steps of a training, two rollouts of the recipe, and seeds that learn together."""
CROWDS = (1, 16)
"""Seeds that learn together on an accelerator."""
WORLDS = 256
"""Copies of the steel of the world."""
CELLS = 1_000_000
"""Arcs × copies at every size, so that every size has as much to compute and arrays of 8 MB each."""
PACKAGES = ("numpy", "scipy", "torch", "stable-baselines3", "gymnasium", "pettingzoo", "greenlet", "vmas")


class Measurement(StrEnum):
    """What ``--only`` can choose."""

    BATCHED = "batched"
    SINGLE = "single"
    SHARE = "share"
    LOCKSTEP = "lockstep"
    STACKED = "stacked"
    ARCS = "arcs"
    YEARLY = "yearly"
    WORLD = "world"
    DISTURBED = "disturbed"
    GRADIENTS = "gradients"
    SUBSTANCES = "substances"
    ACCELERATOR = "accelerator"


@dataclass(frozen=True, slots=True)
class Figure:
    """A row of the table; ``met`` is None where there is no goal."""

    what: str
    value: str
    goal: str = ""
    met: bool | None = None
    remark: str = ""

    @property
    def cells(self) -> tuple[str, str, str, str, str]:
        """The row as text."""
        met = "" if self.met is None else "yes" if self.met else "no"
        return self.what, self.value, self.goal, met, self.remark


def main(
    only: Annotated[Measurement | None, typer.Option(help="Measure this alone.")] = None,
    markdown: Annotated[Path | None, typer.Option(help="Also write machine and table here.")] = None,
) -> None:
    """Measure, and print figures and ratios with their goals."""
    torch.set_num_threads(1)
    machine = list(_machine())
    figures: list[Figure] = []
    for measurement, measure in MEASURES.items():
        if only in (None, measurement):
            with console.status(f"measuring: {measurement}"):
                figures += measure()
    header = ("what", "measured", "goal", "met", "remark")
    table = Table(*header, title="; ".join(machine))
    for figure in figures:
        table.add_row(*map(escape, figure.cells))
    console.print(table)
    if markdown is not None:
        rows = [header, ("-",) * len(header), *(figure.cells for figure in figures)]
        lines = [*(f"- {line}" for line in machine), "", *(f"| {' | '.join(row)} |" for row in rows)]
        markdown.write_text("\n".join(lines) + "\n")


def batched() -> list[Figure]:
    """Measure copper_net in 1 024 copies against VMAS and against lone environments, in agent-steps per second."""
    env = MultiAgentVectorEnv("copper_net", num_envs=COPIES)
    actions = _actions(env.agents, (COPIES, 1))
    env.reset(seed=0)
    horizon = env.network.episode.horizon

    def whole_episode() -> float:
        """Seconds per agent-step, the restart of every copy included."""
        return _seconds(lambda: env.step(actions), horizon) / (len(env.agents) * COPIES)

    def within_episode() -> float:
        env.reset(seed=0)
        return _seconds(lambda: env.step(actions), horizon - 1) / (len(env.agents) * COPIES)

    lone = [parallel_env("copper_net") for _ in range(LONE)]
    lone_actions = _actions(env.agents, (1,))
    for i, one in enumerate(lone):
        one.reset(seed=i)

    def step_all() -> None:
        for one in lone:
            _step_on(one, lone_actions)

    def lone_steps() -> float:
        return _seconds(step_all, 10) / (len(env.agents) * LONE)

    blocks = [whole_episode, within_episode, lone_steps]
    yardstick = simple_spread(COPIES, AGENTS)
    if yardstick is not None:
        blocks.append(lambda: _seconds(yardstick, 3) / (AGENTS * COPIES))
    whole, within, alone, *others = _interleaved(9, *blocks)
    figures = [
        Figure(
            "copper_net, 1 024 copies, 16 agents: agent-steps/s",
            _millions(whole),
            "≥ 50 million",
            1 / min(whole) >= 50e6,
            f"whole episodes of {horizon} steps, automatic restarts included; best of rounds (median)",
        ),
        Figure("the same, between two restarts", _millions(within), remark="best of rounds (median)"),
        Figure(
            "the same / 1 024 lone PettingZoo environments",
            _times(alone, whole),
            remark=f"estimated from {LONE}, {_millions(alone)}",
        ),
    ]
    against = "the same / VMAS simple_spread, 16 agents, 1 024 copies"
    if others:
        figures.append(Figure(against, _times(others[0], whole), remark=f"VMAS: {_millions(others[0])}"))
    else:
        figures.append(Figure(against, "not measured", remark="pip install -c constraints.txt -e '.[benchmarks]'"))
    return figures


def single() -> list[Figure]:
    """Measure one PettingZoo environment, in joint steps per second."""
    env = parallel_env("copper_net")
    env.reset(seed=0)
    actions = _actions(env.possible_agents, (1,))
    horizon = env.network.episode.horizon
    (costs,) = _interleaved(15, lambda: _seconds(lambda: _step_on(env, actions), horizon))
    best, middle = 1 / min(costs), 1 / median(costs)
    what = "one PettingZoo copper_net: joint steps/s"
    remark = "whole episodes with reset; best of rounds (median)"
    return [Figure(what, f"{best:,.0f} ({middle:,.0f})", "≥ 10 000", best >= 10_000, remark)]


def share() -> list[Figure]:
    """Measure which share of a training run PPO in lockstep spends in ``MultiAgentVectorEnv.step``."""
    spans: list[tuple[float, float]] = []
    step = MultiAgentVectorEnv.step

    def timed(env: MultiAgentVectorEnv, actions: Any) -> Any:
        began = time.perf_counter()
        outcome = step(env, actions)
        spans.append((began, time.perf_counter()))
        return outcome

    recipe, shares, rates = _learning_alone(), [], []
    with patch.object(MultiAgentVectorEnv, "step", timed):
        for seed in range(4):
            spans.clear()
            train("copper_net", recipe, steps=LEARNT, seed=seed, engine="lockstep")
            wall = time.perf_counter() - spans[0][0]  # making the learners is not training
            shares.append(sum(ended - began for began, ended in spans) / wall)
            rates.append(len(spans) * recipe.run.envs / wall)
    value = median(shares[1:])  # the first run warms up
    rate = f"{median(rates[1:]):,.0f} environment steps/s"
    remark = f"in lockstep; median of 3 runs of {LEARNT:,} steps in {recipe.run.envs} copies, {rate}"
    what = "independent_ppo on copper_net: share of the environment in training time"
    return [Figure(what, f"{value:.1%}", "≤ 5 %", value <= 0.05, remark)]


def _learning_alone() -> Recipe:
    """Return independent PPO without the evaluations, whose time is the environment's."""
    recipe = load_recipe("independent_ppo")
    return recipe.model_copy(update={"run": recipe.run.model_copy(update={"evaluations": 0, "price_rate": 0.0})})


def lockstep() -> list[Figure]:
    """Measure 16 learners in lockstep against the same 16 one after another, where the environment costs nothing."""
    recipe = load_recipe("independent_ppo")
    steps = 2 * recipe.run.envs * int(recipe.learner.parameters["n_steps"])
    env = FreeEnv("copper_net", recipe.run.envs)
    work = steps * len(env.agents)
    weights: dict[str, Weights] = {}

    def together() -> float:
        seconds, weights["together"] = learn_together(env, recipe, steps)
        return seconds / work

    def alone() -> float:
        seconds, weights["alone"] = learn_alone(env, recipe, steps)
        return seconds / work

    joint, lone = _interleaved(7, together, alone)
    same = all(map(np.array_equal, weights["together"], weights["alone"]))
    ratio = median(b / a for a, b in zip(joint, lone, strict=True))
    return [
        Figure(
            f"{len(env.agents)} PPO learners in lockstep / the same alone, free environment: agent-steps/s",
            f"{ratio:.2f}",
            "≥ 0.9",
            ratio >= 0.9,
            f"{1 / median(joint):,.0f} / {1 / median(lone):,.0f}; weights {'bit-identical' if same else 'DIFFER'}",
        )
    ]


def stacked() -> list[Figure]:
    """Measure learners that run as one against the same in lockstep, and seeds together against one after another."""
    recipe = _learning_alone()

    def seconds(engine: str, *seeds: int) -> Callable[[], float]:
        def run() -> float:
            began = time.process_time()
            train_seeds("copper_net", recipe, seeds=seeds, steps=LEARNT, engine=engine)
            return time.process_time() - began

        return run

    def one_by_one() -> float:
        return sum(seconds("stacked", seed)() for seed in range(SEEDS))

    alone, as_one, together, after = _interleaved(
        3, seconds("lockstep", 0), seconds("stacked", 0), seconds("stacked", *range(SEEDS)), one_by_one
    )
    ratio = median(a / b for a, b in zip(alone, as_one, strict=True))
    gain = median(a / b for a, b in zip(after, together, strict=True))
    rates = [f"{LEARNT / median(each):,.0f}" for each in (as_one, alone)]
    return [
        Figure(
            "independent_ppo on copper_net, stacked / in lockstep: environment steps per second of one core",
            f"{ratio:.1f} ×",
            "≥ 4 ×",
            ratio >= 4,
            f"{rates[0]} / {rates[1]}; {LEARNT:,} steps, median of 3 rounds, the making of learners included",
        ),
        Figure(
            f"{SEEDS} stacked seeds together / one after another: environment steps per second of one core",
            f"{gain:.2f} ×",
            "≥ 2 ×",
            gain >= 2,
            "median of 3 rounds",
        ),
    ]


def arcs() -> list[Figure]:
    """Measure what one step costs per arc and copy on random networks of growing size, put into local order."""
    envs = [MultiAgentVectorEnv(random_network(size).in_local_order(), num_envs=max(1, CELLS // size)) for size in ARCS]
    envs.append(MultiAgentVectorEnv(random_network(ARCS[-1]), num_envs=1))
    for env in envs:
        env.reset(seed=0)

    def cost_of(env: MultiAgentVectorEnv) -> Callable[[], float]:
        actions = _actions(env.agents, (env.num_envs, 1))
        cells = len(env.network.arcs) * env.num_envs
        return lambda: _seconds(lambda: env.step(actions), 3) / cells

    costs = _interleaved(7, *map(cost_of, envs))
    figures = [
        Figure(f"{size:,} arcs × {env.num_envs:,} copies: ns per arc and copy", f"{1e9 * median(cost):.0f}")
        for size, env, cost in zip(ARCS, envs, costs, strict=False)
    ]
    *ordered, unordered = costs
    ratio = median(max(each) / min(each) for each in zip(*ordered, strict=True))
    what = f"{ARCS[-1]:,} arcs in random order, not in local order: ns per arc"
    figures.append(Figure(what, f"{1e9 * median(unordered):.0f}"))
    what = "cost per arc and copy from 10 to 1 000 000 arcs: largest / smallest"
    remark = f"random networks in local order, {CELLS:,} arcs × copies at every size"
    return [*figures, Figure(what, f"{ratio:.1f}", "≤ 2", ratio <= 2, remark)]


def yearly() -> list[Figure]:
    """Measure a yearly cycle with 400 nodes without stock against the same with stocks in them, and copper_net."""
    envs: dict[str, Network | str] = {
        "cycle": yearly_network(),
        "monthly": yearly_network(monthly=True),
        "copper_net": "copper_net",
    }
    found = {name: MultiAgentVectorEnv(network, num_envs=COPIES) for name, network in envs.items()}
    for env in found.values():
        env.reset(seed=0)

    def cost_of(env: MultiAgentVectorEnv, steps: int) -> Callable[[], float]:
        actions = _actions(env.agents, (COPIES, 1))
        return lambda: _seconds(lambda: env.step(actions), steps) / COPIES

    steps = {"cycle": 10, "monthly": 1, "copper_net": 160}
    cycle, monthly, copper = _interleaved(9, *(cost_of(found[name], steps[name]) for name in found))
    arcs = len(found["cycle"].network.arcs), len(found["copper_net"].network.arcs)
    faster = median(b / a for a, b in zip(cycle, monthly, strict=True))
    dearer = median((a / arcs[0]) / (c / arcs[1]) for a, c in zip(cycle, copper, strict=True))
    per_arc = [f"{1e9 * min(costs) / count:.0f} ns" for costs, count in zip((cycle, copper), arcs, strict=True)]
    what = f"yearly cycle, {len(found['cycle'].network.nodes)} nodes, 400 without stock, 1 024 copies"
    return [
        Figure(
            f"{what}: years/s", f"{1 / min(cycle):,.0f} ({1 / median(cycle):,.0f})", remark="best of rounds (median)"
        ),
        Figure(
            "the same / with stocks of a month in the 400",
            f"{faster:.0f} ×",
            "≥ 15 ×",
            faster >= 15,
            f"with stocks: {1 / min(monthly):,.0f} years/s",
        ),
        Figure(
            "cost per arc and copy, the same / copper_net",
            f"{dearer:.2f} ×",
            "≤ 2 ×",
            dearer <= 2,
            f"{per_arc[0]} in {arcs[0]:,} arcs, {per_arc[1]} in {arcs[1]}",
        ),
    ]


def world() -> list[Figure]:
    """Measure the steel of the world against that of Japan: every service is made up for, under random actions."""
    found = {name: MultiAgentVectorEnv(name, num_envs=WORLDS) for name in ("steel_world", "steel_japan")}

    def cost_of(env: MultiAgentVectorEnv, steps: int) -> Callable[[], float]:
        env.reset(seed=0)
        actions = _actions(env.agents, (WORLDS, 1))
        return lambda: _seconds(lambda: env.step(actions), steps) / WORLDS

    ours, theirs = _interleaved(5, *(cost_of(env, steps) for env, steps in zip(found.values(), (2, 26), strict=True)))
    arcs = [len(env.network.arcs) for env in found.values()]
    dearer = median((a / arcs[0]) / (b / arcs[1]) for a, b in zip(ours, theirs, strict=True))
    per_arc = [f"{1e9 * min(costs) / count:,.0f} ns" for costs, count in zip((ours, theirs), arcs, strict=True)]
    return [
        Figure(
            f"steel_world, {WORLDS} copies, {len(found['steel_world'].agents)} agents: years/s",
            f"{1 / min(ours):,.0f} ({1 / median(ours):,.0f})",
            remark="best of rounds (median)",
        ),
        Figure(
            "cost per arc and copy, the same / steel_japan",
            f"{dearer:.2f} ×",
            "≤ 3 ×",
            dearer <= 3,
            f"{per_arc[0]} in {arcs[0]:,} arcs, {per_arc[1]} in {arcs[1]}",
        ),
    ]


def disturbances() -> list[Figure]:
    """Measure copper_net in 1 024 copies with outages of two plants and volatile scrap, against itself without."""
    network = load_network("copper_net")
    scrap = AutoRegression(deviation=0.3, persistence=0.9, logarithm=True)
    parts = {
        "refinery_to_fabrication": Markov(values=(1.0, 0.2), lengths=(60.0, 6.0)),
        "sorting_to_refinery": Markov(values=(1.0, 0.3), lengths=(50.0, 4.0)),
        "use_to_landfill": scrap,
    }
    effects = {f"arcs.{arc}.rate": DisturbanceEffect(by=arc) for arc in parts}
    disturbed = replace(network, disturbances=parts, disturbed=effects, scenarios={})
    envs = [MultiAgentVectorEnv(each, num_envs=COPIES) for each in (network, disturbed)]
    actions = _actions(envs[0].agents, (COPIES, 1))
    for env in envs:
        env.reset(seed=0)
    horizon = network.episode.horizon
    blocks = [partial(_seconds, partial(env.step, actions), horizon) for env in envs]
    without, with_ = _interleaved(9, *blocks)
    ratio = median(a / b for a, b in zip(without, with_, strict=True))
    what = "copper_net with three disturbances / without, 1 024 copies"
    return [Figure(what, f"{ratio:.0%}", "≥ 70 %", ratio >= 0.7, "whole episodes, restarts included; median of rounds")]


def substances() -> list[Figure]:
    """Measure networks with a substance against the same without: who acts on the substance alone is left out.

    A substance moves as much mass again, so that with many copies, where little but arithmetic is left, it doubles it.
    """
    figures = []
    for name, scenario in (("steel_japan", "copper"), ("aluminium_world", "alloys")):
        network = load_network(name, scenario=scenario)
        for copies in (1, 32, WORLDS):
            envs = [MultiAgentVectorEnv(each, num_envs=copies) for each in (network, without_substances(network))]
            blocks = []
            for env in envs:
                env.reset(seed=0)
                step = partial(env.step, _actions(env.agents, (copies, 1)))
                blocks.append(partial(_seconds, step, network.episode.horizon))
            with_, without = _interleaved(9, *blocks)
            ratio = median(a / b for a, b in zip(with_, without, strict=True))
            what = f"{name} with {scenario}, {copies} {'copies' if copies > 1 else 'copy'} / without the substance"
            rates = " and ".join(f"{copies / min(costs):,.0f}" for costs in (with_, without))
            figures.append(
                Figure(what, f"{ratio:.2f} ×", "≤ 1.5 ×", ratio <= 1.5, f"{rates} intervals/s, best of rounds")
            )
    return figures


def gradients() -> list[Figure]:
    """Measure an episode with its exact gradient by actions, start and disturbances against the episode alone."""
    figures = []
    for name, copies, intervals in (("copper_net", 256, 160), ("car_batteries", 64, 25), ("steel_japan", 64, 26)):
        env = MultiAgentVectorEnv(name, num_envs=copies)
        env.reset(seed=0)
        derivatives, start = Derivatives(env), env.physical
        schedule = np.random.default_rng(0).uniform(-1, 1, (intervals, len(env.actuators.control_rows), copies))

        def episode(env: MultiAgentVectorEnv = env, schedule: NDArray[np.float64] = schedule) -> None:
            for actions in schedule:
                env.advance(actions)

        def alone(env: MultiAgentVectorEnv = env, start: State = start, play: Callable[[], None] = episode) -> float:
            env.go_back(start, env.controls)
            cost = _seconds(play, 1)
            env.go_back(start, env.controls)
            return cost

        with_gradient = partial(_seconds, partial(derivatives.open_loop, schedule), 1)
        forward, both = _interleaved(5, alone, with_gradient)
        ratio = median(b / a for a, b in zip(forward, both, strict=True))
        what = f"{name}, {copies} copies: an episode and its exact gradient / the episode"
        figures.append(Figure(what, f"{ratio:.1f} ×", "≤ 6 ×", ratio <= 6, "medians of rounds"))
    return figures


def accelerator() -> list[Figure]:
    """Measure stacked learners and exact gradients on an accelerator against the same on one core, by the clock."""
    if not torch.cuda.is_available():
        return [Figure("learners on an accelerator / on one core", "", remark="no accelerator here")]
    figures = []
    for name, seeds in product(("independent_ppo", "exact_gradients"), CROWDS):
        recipe = load_recipe(name)
        recipe = recipe.model_copy(update={"run": recipe.run.model_copy(update={"evaluations": 0, "price_rate": 0.0})})
        steps = 4 * recipe.run.envs * int(recipe.learner.parameters["n_steps"])
        learnt: dict[str, torch.Tensor] = {}
        train_on = partial(_training_seconds, recipe, seeds, steps, learnt)
        core, chip = _interleaved(1, partial(train_on, "cpu"), partial(train_on, "cuda"))
        ratio = median(a / b for a, b in zip(core, chip, strict=True))
        apart = float((learnt["cpu"] - learnt["cuda"]).abs().max())
        what = (
            f"{name} on copper_net, {seeds} seeds, {seeds * AGENTS} learners: {torch.cuda.get_device_name()} / one core"
        )
        rates = " / ".join(f"{seeds * steps / median(each):,.0f}" for each in (chip, core))
        remark = f"{rates} environment steps/s, making of learners included; weights differ by {apart:.1e} at most"
        figures.append(Figure(what, f"{ratio:.2f} ×", remark=remark))
    return figures


MEASURES: dict[Measurement, Callable[[], list[Figure]]] = dict(
    zip(
        Measurement,
        (
            *(batched, single, share, lockstep, stacked, arcs, yearly, world, disturbances, gradients),
            *(substances, accelerator),
        ),
        strict=True,
    )
)


def _training_seconds(recipe: Recipe, seeds: int, steps: int, learnt: dict[str, torch.Tensor], device: str) -> float:
    """Train seeds of copper_net on a device, put their weights into ``learnt``, and return seconds."""
    began = time.perf_counter()
    trainings = train_seeds("copper_net", recipe, seeds=range(seeds), steps=steps, device=device)
    cost = time.perf_counter() - began
    policies = [learner.model.policy for learner in trainings[0].learners.values()]
    learnt[device] = torch.cat([weights.detach().cpu().flatten() for each in policies for weights in each.parameters()])
    return cost


def _interleaved(rounds: int, *blocks: Callable[[], float]) -> list[list[float]]:
    """Run the blocks in turns, after one round that does not count, and return what each cost in each round."""
    for block in blocks:
        block()
    costs = [[block() for block in blocks] for _ in range(rounds)]
    return [list(column) for column in zip(*costs, strict=True)]


def _seconds(action: Callable[[], object], times: int) -> float:
    """Seconds per call of ``action``."""
    began = time.perf_counter()
    for _ in range(times):
        action()
    return (time.perf_counter() - began) / times


def _actions(agents: Sequence[str], shape: tuple[int, ...]) -> dict[str, NDArray[np.float32]]:
    """Draw one random action array for each agent, the kind that learners hand in."""
    random = np.random.default_rng(0)
    return {agent: random.uniform(-1, 1, shape).astype(np.float32) for agent in agents}


def _step_on(env: NetworkParallelEnv, actions: dict[str, NDArray[np.float32]]) -> None:
    """Step, and start the next episode if that was the last of one."""
    env.step(actions)
    if not env.agents:
        env.reset()


def _millions(costs: Sequence[float]) -> str:
    """Best and median rate of some costs in seconds."""
    return f"{1e-6 / min(costs):.3g} million ({1e-6 / median(costs):.3g})"


def _times(slow: Sequence[float], fast: Sequence[float]) -> str:
    return f"{median(a / b for a, b in zip(slow, fast, strict=True)):,.0f} ×"


def _machine() -> Iterator[str]:
    """Yield what was measured on: processor, load by others, versions."""
    yield f"{processor()}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before the measurement"
    found = {distribution.metadata["Name"].lower() for distribution in importlib.metadata.distributions()}
    versions = [f"{name} {importlib.metadata.version(name)}" for name in PACKAGES if name in found]
    yield f"Python {platform.python_version()}, {', '.join(versions)}"


if __name__ == "__main__":
    typer.run(main)
