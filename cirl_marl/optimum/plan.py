"""The controller that carries out plans, and what those of bounds achieve in the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import ControlError
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.population import starting_states

SAME = 1e-9
"""Relative difference of starts that count as the same."""


class Planned(Protocol):
    """What has a plan: a bound, or an incumbent."""

    @property
    def network(self) -> Network:
        """The network, under the scenario and horizon that the plan is for."""

    @property
    def agents(self) -> tuple[str, ...]:
        """Who acts."""

    @property
    def initial(self) -> Floats:
        """Stocks at the start, and inner states if there are any, the first of ``MultiAgentVectorEnv.state_names``."""

    @property
    def actions(self) -> Floats:
        """Normalised actions, shape (steps, entries)."""


class Plan(Controller):
    """Replays the actions of a plan, whatever it observes; each copy may have its own."""

    def __init__(self, plans: Planned | Sequence[Planned]) -> None:
        """Take one bound or incumbent for all copies, or one for each."""
        self._plans = list(plans) if isinstance(plans, Sequence) else [plans]
        self._actions = np.empty((0, 0, 0))
        self._step = 0

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Go to the beginning of the plan.

        Raises:
            ControlError: if the plan is not for ``env``: another network, horizon, choice of agents or start.
        """
        if len(self._plans) not in (1, env.num_envs):
            raise ControlError(f"plan: {len(self._plans)} plans for {env.num_envs} copies; give one, or one for each")
        for copy, start in enumerate(starting_states(env)):
            self._check(self._plans[copy % len(self._plans)], env, start, copy)
        actions = np.stack([plan.actions for plan in self._plans], axis=2)
        self._actions = np.broadcast_to(actions, (*actions.shape[:2], env.num_envs))
        self._env, self._step = env, 0

    def act(self, observations: Arrays) -> Arrays:
        """Return the actions of the next interval.

        Raises:
            ControlError: if the plan is at its end.
        """
        if self._step >= len(self._actions):
            raise ControlError(f"plan: it has {len(self._actions)} steps and all are done; start() begins again")
        actions = self._actions[self._step]
        self._step += 1
        return dict(self._env.unstack(actions))

    def _check(self, plan: Planned, env: MultiAgentVectorEnv, start: Floats, copy: int) -> None:
        ours, theirs = plan.network, env.network
        if (ours.nodes, ours.arcs, ours.episode) != (theirs.nodes, theirs.arcs, theirs.episode):
            raise ControlError(
                f"plan: it is for network '{ours.name}', scenario '{ours.scenario_name}', {ours.episode.horizon} steps,"
                f" not for '{theirs.name}', '{theirs.scenario_name}', {theirs.episode.horizon} steps"
            )
        if plan.agents != env.agents:
            raise ControlError(f"plan: it is for agents {list(plan.agents)}, not {list(env.agents)}")
        size = np.abs(plan.initial)  # a stock is near where it should be, measured by all the mass there is
        size[env.rows.nodes] = plan.initial[env.rows.nodes].sum()
        distant = np.abs(start[: len(size)] - plan.initial) > SAME * size
        if distant.any():
            row = int(distant.argmax())
            planned = f"{plan.initial[row]:g} in '{env.state_names[row]}'"
            raise ControlError(f"plan: it starts from {planned}, copy {copy} from {start[row]:g}")


def achieved(bound: Bound) -> Rollout:
    """Return the episode that the plan of ``bound`` makes in the simulator."""
    network = bound.network
    stores = [replace(n, initial=(x, x)) for n, x in zip(network.stores, bound.stock[0].tolist(), strict=True)]
    pinned = replace(network, nodes=(*stores, *network.nodes[len(stores) :]))
    env = MultiAgentVectorEnv(pinned, num_envs=1, agents=bound.agents or None)
    stages = [row for rows in env.rows.stages.values() for row in rows.tolist()]
    start = {env.rows.start_names[row]: float(bound.initial[row]) for row in stages}
    return rollout(env, Plan(replace(bound, network=pinned)), start=start)
