"""Plans in the simulator: the controller that carries them out, what those of bounds achieve, many side by side."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Annotated, Protocol

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller
from cirl_marl.controllers.rollout import EVALUATION_SEEDS, Rollout, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError, instance_of
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.bounds import Bound

SAME_START = 1e-9
"""Relative difference of starts that count as the same."""


class HasPlan(Protocol):
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

    def __init__(self, plans: HasPlan | Sequence[HasPlan]) -> None:
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

    def _check(self, plan: HasPlan, env: MultiAgentVectorEnv, start: Floats, copy: int) -> None:
        parts = [(network.nodes, network.arcs, network.episode) for network in (plan.network, env.network)]
        if parts[0] != parts[1]:
            plan_text, env_text = (
                f"'{network.name}', scenario '{network.scenario_name}', {network.episode.horizon} steps"
                for network in (plan.network, env.network)
            )
            raise ControlError(f"plan: it is for network {plan_text}, not for {env_text}")
        if plan.agents != env.agents:
            raise ControlError(f"plan: it is for agents {list(plan.agents)}, not {list(env.agents)}")
        size = np.abs(plan.initial)  # a stock is near where it should be, measured by all the mass there is
        size[env.rows.nodes] = plan.initial[env.rows.nodes].sum()
        distant = np.abs(start[: len(size)] - plan.initial) > SAME_START * size
        if distant.any():
            row = int(distant.argmax())
            amount = f"{plan.initial[row]:g} in '{env.state_names[row]}'"
            raise ControlError(f"plan: it starts from {amount}, copy {copy} from {start[row]:g}")


def simulate_plan(bound: Bound) -> Rollout:
    """Return the episode that the plan of ``bound`` makes in the simulator."""
    network = instance_of(Bound, "bound", bound).network
    stores = [replace(n, initial=(x, x)) for n, x in zip(network.stores, bound.stock[0].tolist(), strict=True)]
    start_network = network.variant(nodes=(*stores, *network.nodes[len(stores) :]))
    env = MultiAgentVectorEnv(start_network, num_envs=1, agents=bound.agents or None)
    stages = [row for rows in env.rows.stages.values() for row in rows.tolist()]
    start = {env.rows.start_names[row]: float(bound.initial[row]) for row in stages}
    return rollout(env, Plan(replace(bound, network=start_network)), start=start)


@positional_record
class Episodes:
    """What episodes were like, for each start and each copy that began there."""

    circularity: Annotated[Floats, "λ̄, shape (starts, copies), mass"]
    service: Annotated[Floats, "mean service level, shape (starts, copies)"]
    levels: Annotated[Floats, "mean level of each service, shape (services, starts, copies)"]
    actions: Annotated[Floats, "normalised actions, shape (steps, entries, starts, copies)"]
    deviation: Annotated[
        Floats, "what clipped actions had beyond the controller's, mean between knots, (starts, copies, knots, entries)"
    ]


class Population:
    """Copies of a network, equally many from each of some starts; ``agents`` act by ``entries`` of an action."""

    def __init__(
        self,
        network: Network,
        agents: Sequence[str] | None,
        starts: Floats | Sequence[int],
        size: int,
        *,
        uncertain: bool = False,
    ) -> None:
        """Make the environment and put its copies where they start.

        Args:
            network: under its scenario and horizon.
            agents: who acts; None is the network's own choice.
            starts: stocks and inner states, the first of ``MultiAgentVectorEnv.state_names``, shape (starts, rows); or
                seeds of episodes, which draw them and all else.
            size: copies from each start.
            uncertain: whether numbers of the network are drawn.

        Raises:
            CirlError: for starts that no episode can begin with, or if nobody acts.
        """
        self._shape = (len(starts), size)
        self._env = env = MultiAgentVectorEnv(network, num_envs=len(starts) * size, agents=agents, uncertain=uncertain)
        if not env.agents:
            raise CirlError(f"network '{network.name}': nobody acts, so there is nothing to search for")
        self.agents = env.agents
        self.entries = sum(neutral.shape[1] for neutral in env.neutral_action.values())
        repeated = np.repeat(starts, size, axis=0)
        if repeated.ndim == 1:
            env.reset(seed=repeated.tolist())
        else:
            env.reset(seed=EVALUATION_SEEDS, options={"initial_state": by_state_name(env, repeated)})
        self._start = env.snapshot()

    @property
    def starts(self) -> int:
        """How many starts figures are of."""
        return self._shape[0]

    def run(
        self,
        controllers: Sequence[Controller],
        choices: Integers,
        deviation: Floats,
        progress: Callable[[float], None] = lambda share: None,
    ) -> Episodes:
        """Run an episode in every copy.

        Args:
            controllers: each has to act for all copies.
            choices: whose actions each copy takes, shape (starts, copies).
            deviation: what is added to them between knots, shape (starts, copies, knots, entries).
            progress: called with the share of the episode that is done.
        """
        env, shape = self._env, self._shape
        observations = env.restore(self._start)
        choice = choices.ravel()
        chosen_controllers = {int(i): controllers[i] for i in np.unique(choice)}
        for controller in chosen_controllers.values():
            controller.start(env, EVALUATION_SEEDS)
        steps, knots = env.network.episode.horizon, deviation.shape[2]
        added_deviation = np.ascontiguousarray(np.moveaxis(deviation.reshape(len(choice), knots, -1), 0, 2))
        deviation_sum = np.zeros_like(added_deviation)
        counts = np.bincount(np.arange(steps) * knots // steps, minlength=knots)
        actions = np.empty((steps, *added_deviation.shape[1:]))
        for t in range(steps):
            action = actions[t]
            for i, controller in chosen_controllers.items():
                np.copyto(action, env.stack(controller.act(observations)), where=choice == i)
            knot = t * knots // steps
            bounded_action = np.clip(action + added_deviation[knot], -1.0, 1.0)
            deviation_sum[knot] += bounded_action - action
            actions[t] = bounded_action
            observations = env.by_agent(env.advance(bounded_action).observation)
            progress((t + 1) / steps)
        deviation_sum /= counts[:, None, None]
        state = env.physical
        levels = state.service / steps
        return Episodes(
            (state.circularity / steps).reshape(shape),
            env.scoring.service_level(levels).reshape(shape),
            levels.reshape(-1, *shape),
            actions.reshape(*actions.shape[:2], *shape),
            np.moveaxis(deviation_sum, 2, 0).reshape(deviation.shape),
        )


class DrawnPopulation(Population):
    """Copies that meet the same draws: what each does is the same in all of them, and its figures are their means."""

    @property
    def starts(self) -> int:
        """One: figures are means over draws."""
        return 1

    def run(
        self,
        controllers: Sequence[Controller],
        choices: Integers,
        deviation: Floats,
        progress: Callable[[float], None] = lambda share: None,
    ) -> Episodes:
        """Run an episode of every draw in every copy; see ``Population.run``, with a single start.

        Controllers must act alike in all draws.
        """
        draws = self._shape[0]
        episodes = super().run(
            controllers, np.repeat(choices, draws, axis=0), np.repeat(deviation, draws, axis=0), progress
        )
        return Episodes(
            episodes.circularity.mean(axis=0, keepdims=True),
            episodes.service.mean(axis=0, keepdims=True),
            episodes.levels.mean(axis=1, keepdims=True),
            episodes.actions[:, :, :1],
            episodes.deviation[:1],
        )


def starting_states(env: MultiAgentVectorEnv) -> Floats:
    """Return the stocks and inner states in which the copies of ``env`` are, shape (copies, rows)."""
    state = env.physical
    return env.rows.start_of(state.stock, state.inner).T


def by_state_name(env: MultiAgentVectorEnv, starts: Floats) -> dict[str, Floats]:
    """Return stocks and inner states, shape (copies, rows), by their names, shape (copies,) each.

    Raises:
        CirlError: for another shape.
    """
    names = env.rows.start_names
    if starts.ndim != 2 or starts.shape[1] != len(names):
        raise CirlError(f"initial has shape {starts.shape}, expected (starts, {len(names)})")
    return dict(zip(names, starts.T, strict=True))
