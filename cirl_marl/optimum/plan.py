"""The controller that carries out the plans of bounds, and what they achieve in the simulator."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from cirl_marl.controllers.basic import Arrays
from cirl_marl.errors import ControlError
from cirl_marl.evaluate import Rollout, rollout
from cirl_marl.network import Floats
from cirl_marl.optimum.bound import Bound
from cirl_marl.vector_env import VectorEnv

SAME = 1e-9
"""Relative difference of starts that count as the same."""


class Plan:
    """Replays the actions of a plan, whatever it observes; each copy may have its own."""

    def __init__(self, bounds: Bound | Sequence[Bound]) -> None:
        """Take one bound for all copies, or one for each."""
        self._bounds = [bounds] if isinstance(bounds, Bound) else list(bounds)
        self._actions = np.empty((0, 0, 0))
        self._step = 0

    def start(self, env: VectorEnv, seed: int) -> None:
        """Go to the beginning of the plan.

        Raises:
            ControlError: if the plan is not for ``env``: another network, horizon, choice of agents or start.
        """
        if len(self._bounds) not in (1, env.num_envs):
            raise ControlError(f"plan: {len(self._bounds)} plans for {env.num_envs} copies; give one, or one for each")
        stock = env.physical.stock[: len(env.network.nodes)].T
        for copy, start in enumerate(stock):
            bound = self._bounds[copy % len(self._bounds)]
            self._check(bound, env, start, copy)
        actions = np.stack([bound.actions for bound in self._bounds], axis=1)
        self._actions = np.broadcast_to(actions, (len(actions), env.num_envs, actions.shape[2]))
        ends = np.cumsum([0, *(len(neutral) for neutral in env.neutral_action.values())])
        self._entries = {a: slice(ends[i], ends[i + 1]) for i, a in enumerate(env.neutral_action)}
        self._step = 0

    def act(self, observations: Arrays) -> Arrays:
        """Return the actions of the next interval.

        Raises:
            ControlError: if the plan is at its end.
        """
        if self._step >= len(self._actions):
            raise ControlError(f"plan: it has {len(self._actions)} steps and all are done; start() begins again")
        actions = self._actions[self._step]
        self._step += 1
        return {agent: actions[:, entries] for agent, entries in self._entries.items()}

    def _check(self, bound: Bound, env: VectorEnv, start: Floats, copy: int) -> None:
        ours, theirs = bound.network, env.network
        if (ours.nodes, ours.arcs, ours.episode) != (theirs.nodes, theirs.arcs, theirs.episode):
            raise ControlError(
                f"plan: it is for network '{ours.name}', scenario '{ours.scenario_name}', {ours.episode.horizon} steps,"
                f" not for '{theirs.name}', '{theirs.scenario_name}', {theirs.episode.horizon} steps"
            )
        if bound.agents != env.agents:
            raise ControlError(f"plan: it is for agents {list(bound.agents)}, not {list(env.agents)}")
        distant = np.abs(start - bound.initial) > SAME * bound.initial.sum()
        if distant.any():
            node = int(distant.argmax())
            planned = f"{bound.initial[node]:g} in '{ours.nodes[node].id}'"
            raise ControlError(f"plan: it starts from {planned}, copy {copy} from {start[node]:g}")


def achieved(bound: Bound) -> Rollout:
    """Return the episode that the plan of ``bound`` makes in the simulator."""
    nodes = zip(bound.network.nodes, bound.initial.tolist(), strict=True)
    pinned = replace(bound.network, nodes=tuple(replace(node, initial=(stock, stock)) for node, stock in nodes))
    env = VectorEnv(pinned, num_envs=1, agents=bound.agents or None)
    return rollout(env, Plan(replace(bound, network=pinned)))
