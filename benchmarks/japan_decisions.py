"""What Japan has to decide now and what it may decide later, for ``docs/japan.md``: each lever settled beforehand.

Who looks every year acts by the price policy. A lever is settled if it follows, whatever happens, the mean of what that
policy did with it in other futures; of the rest the margin is set anew, so that expected service is what is demanded.
What that costs, in the same futures, is the worth of deciding later.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from benchmarks.foresight import CONTENDERS, RESULTS, calibration_of, proof
from benchmarks.uncertain import DEMANDED, WORLDS, contenders
from benchmarks.uncertain import RESULTS as KNOBS
from cirl_marl import MultiAgentVectorEnv
from cirl_marl.controllers import Controller
from cirl_marl.controllers.basic import Arrays
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.evaluation.statistics import Aggregate, over_episodes
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.blind import Replay
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.mpc import MPC

DRAWS, EARLIER_DRAWS = 32, 32
"""Futures in which policies are held against each other, and others over which what is settled is averaged."""
YEARS = 5
"""At the beginning and at the end, of which means are told."""


class Watched(Controller):
    """Another controller, of which is kept what it does.

    Attributes:
        actions: stacked, of each interval.
    """

    def __init__(self, controller: Controller) -> None:
        """Take it."""
        self._controller = controller

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start it."""
        self._env, self.actions = env, list[Floats]()
        self._controller.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return what it does."""
        actions = self._controller.act(observations)
        self.actions.append(self._env.stack(actions))
        return actions


class Settled(Controller):
    """Another controller, of which what some agents do is settled beforehand."""

    def __init__(self, controller: Controller, agents: Sequence[str], schedule: Floats) -> None:
        """Take who acts, whose actions are settled, and a schedule of all actions, shape (intervals, entries)."""
        self._controller, self._agents, self._replay = controller, tuple(agents), Replay(schedule)

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Start both."""
        self._controller.start(env, seed)
        self._replay.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return the actions."""
        settled = self._replay.act(observations)
        return {**self._controller.act(observations), **{agent: settled[agent] for agent in self._agents}}


def levers_of(network: Network, groups: Mapping[str, Sequence[str]]) -> dict[str, tuple[str, ...]]:
    """Return the levers, groups of agents by their names, and each agent that is in no group by its label."""
    grouped = {agent for agents in groups.values() for agent in agents}
    single = {network.compartments[agent].label: (agent,) for agent in network.agents if agent not in grouped}
    return {**{name: tuple(agents) for name, agents in groups.items()}, **single}


def decisions(name: str, groups: Mapping[str, Sequence[str]]) -> Iterator[str]:
    """Yield what it costs to settle each lever now instead of following what happens, and the regret of a plan."""
    world = next(world for world in WORLDS if world.network == name)
    found, _ = proof(world, Sampling(draws=200, fit_draws=64, numbers=False))
    network, seed = found.network, found.sampling.seed
    kept = json.loads(RESULTS.read_text())[name]["contenders"]
    knob, blind_knob = kept["price_policy"]["knob"], kept["best_schedule"]["knob"]
    plan_knob = json.loads(KNOBS.read_text())[name]["contenders"]["plan"]["knob"]

    def looking(margin: ArrayLike = 1.0) -> MPC:
        return MPC(min_service=DEMANDED, prices=found.prices, margin=np.multiply(knob, margin))

    def outcome(controller: Controller) -> tuple[Floats, float]:
        run = rollout(MultiAgentVectorEnv(network, num_envs=DRAWS), controller, seed=first_seed(seed))
        loss = found.scale * found.gaps(run.episode_circularity, run.episode_levels)
        return loss, float(run.episode_levels.mean(axis=0).min())

    env, watched = MultiAgentVectorEnv(network, num_envs=EARLIER_DRAWS), Watched(looking())
    rollout(env, watched, seed=first_seed(seed + 1))
    actions = np.array(watched.actions)
    means, spread = (env.unstack(part.T) for part in (actions.mean(axis=2), actions.std(axis=2)))
    levers, (least, service) = levers_of(network, groups), outcome(looking())

    def regret(controller: Controller) -> tuple[Aggregate, float]:
        loss, level = outcome(controller)
        return over_episodes((loss - least) / 1e3), level

    def without(agents: Sequence[str]) -> tuple[Aggregate, float]:
        def settled(margin: ArrayLike) -> Controller:
            return Settled(looking(margin), agents, actions.mean(axis=2))

        return regret(settled(calibration_of(network, settled, EARLIER_DRAWS).margin))

    costs = {lever: without(agents) for lever, agents in levers.items()}
    first, last = slice(0, YEARS), slice(-YEARS, None)
    yield "| lever, in % of its range | first five years | last five | spread | settled now, Mt/a | lowest service |"
    yield "|-|-|-|-|-|-|"
    for lever in sorted(levers, key=lambda lever: -costs[lever][0].value):
        shares = [
            50 * np.mean([part[agent][years] + offset for agent in levers[lever]])
            for part, years, offset in ((means, first, 1.0), (means, last, 1.0), (spread, slice(None), 0.0))
        ]
        yield f"| {lever} | {' | '.join(f'{share:.0f}' for share in shares)} | {_cells(*costs[lever])} |"
    blind = CONTENDERS["best_schedule"](world, found)(margin=blind_knob)
    yield f"| all of them, by the best schedule | | | | {_cells(*regret(blind))} |"
    plan = contenders(world, network)["plan"](plan_knob)
    yield f"| all of them, by the plan for what is expected | | | | {_cells(*regret(plan))} |"
    yield ""
    yield (
        f"Means of {DRAWS} futures, 95 % intervals. Who looks every year is {_interval(over_episodes(least / 1e3))} "
        f"Mt/a from the bound, at a service of {service:.4f}."
    )


def _cells(figure: Aggregate, level: float) -> str:
    return f"{_interval(figure)} | {level:.4f}"


def _interval(figure: Aggregate) -> str:
    return f"{figure.value:+.2f} ± {(figure.high - figure.low) / 2:.2f}"
