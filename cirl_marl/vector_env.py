"""The multi-agent environment of a material network, batched: arrays in and out.

Every other view (PettingZoo, Gymnasium, the seats of the learners) stands on this one.
"""

from __future__ import annotations

import copy
import difflib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from cirl_marl.catalogue import load_network
from cirl_marl.elements import REWARDS
from cirl_marl.errors import CirlError, ControlError, unknown
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.observe import ObservationLayout
from cirl_marl.reward import Scoring
from cirl_marl.simulate import Dynamics

Infos = dict[str, dict[str, Any]]
COUNTERFACTUAL_CELLS = 4_000_000
"""Largest number of stocks that difference rewards re-simulate at once."""


@dataclass(frozen=True, slots=True)
class State:
    """The physical state of B environments and the sums that an episode reports.

    Attributes:
        stock: stocks and the unit row, shape (nodes + 1, B), mass.
        flow: mean flows of the last control interval, shape (arcs, B), mass/time.
        step: control intervals done, shape (B,).
        circularity: sum over the episode of the interval means of λ, shape (B,), mass.
        service: sum over the episode of the service level, shape (B,).
    """

    stock: Floats
    flow: Floats
    step: Integers
    circularity: Floats
    service: Floats


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Everything needed to go on from here, bit for bit: physical state and random streams."""

    state: State
    streams: tuple[Mapping[str, Any], ...]
    agents: tuple[str, ...]
    network: str


@dataclass(frozen=True, slots=True)
class Outcome:
    """What one control interval brought, agents stacked along axis 0.

    Attributes:
        observation: shape (entries of all agents, B), float32.
        reward: shape (agents, B).
        local: local rewards, shape (agents, B).
        circularity: λ at the end of the interval, shape (B,), mass.
        circularity_mean: mean of λ over the interval, shape (B,), mass.
        service_level: shape (B,).
        flow: mean flows, shape (arcs, B), mass/time.
        truncated: time limit reached, shape (B,).
    """

    observation: NDArray[np.float32]
    reward: Floats
    local: Floats
    circularity: Floats
    circularity_mean: Floats
    service_level: Floats
    flow: Floats
    truncated: NDArray[np.bool_]


class VectorEnv:
    """``num_envs`` independent copies of a material network, stepped together.

    Observations, rewards and so on are dicts agent → array with leading axis ``num_envs``. A copy whose episode ended
    starts the next one within the same step; its last observation is then in
    ``infos[agent]["final_observation"]``, valid where ``infos[agent]["_final_observation"]`` is true.

    Attributes:
        network: the network under the chosen scenario.
        agents: compartments that act, in the order of every stacked array.
        reward_mode: one of ``local``, ``circularity``, ``mixed``, ``difference``, ``local_sum``.
        observation_spaces: by agent.
        action_spaces: by agent; Box(−1, 1), mapped linearly to the bounds of the control.
    """

    def __init__(
        self,
        network: str | Path | Network,
        *,
        num_envs: int = 64,
        scenario: str | None = None,
        agents: Sequence[str] | None = None,
        reward: str | None = None,
        observe: str | None = None,
        circularity: str = "end",
        horizon: int | None = None,
    ) -> None:
        """Make the environments.

        Args:
            network: catalogue name, path of a definition file, or a network.
            num_envs: B, number of copies.
            scenario: scenario of the definition; None is the default, physical one.
            agents: who acts; the others hold their neutral control. None: the network's own choice.
            reward: reward mode; None takes the scenario's own, which is ``mixed`` unless the definition says otherwise.
            observe: ``local``, ``neighbours`` or ``full``; None takes the scenario's own.
            circularity: whether the team reward is λ at the ``end`` of the interval or its ``mean`` over it.
            horizon: decisions per episode; None takes the definition's.

        Raises:
            CirlError: for an unknown network, scenario, agent or option.
        """
        found = load_network(network) if isinstance(network, str | Path) else network
        found = found.scenario(scenario)
        if horizon is not None:
            found = found.with_options(episode={"horizon": horizon})
        if num_envs < 1:
            raise CirlError(f"num_envs must be at least 1, got {num_envs}")
        self.network = found
        self.num_envs = num_envs
        self.agents = self._checked_agents(agents)
        self.reward_mode = _choice("reward", reward or found.objective.reward, REWARDS)
        self._team = _choice("circularity", circularity, ("end", "mean"))
        self.dynamics = Dynamics(found)
        self.layout = ObservationLayout(self.dynamics, self.agents, observe, num_envs)
        self.scoring = Scoring(found, self.agents)
        self.observation_spaces = self.layout.spaces
        self.action_spaces = {agent: Box(-1.0, 1.0, (1,), np.float32) for agent in self.agents}
        order = {id_: i for i, id_ in enumerate(found.controllable)}
        self._acting: Integers = np.array([order[agent] for agent in self.agents], dtype=np.intp)
        self._all_act = self._acting.tolist() == list(range(len(order)))
        low, high = self.dynamics.control_low[self._acting], self.dynamics.control_high[self._acting]
        self._middle, self._half = ((high + low) / 2)[:, None], ((high - low) / 2)[:, None]
        self._random: list[np.random.Generator] = [np.random.default_rng() for _ in range(num_envs)]
        self._low = np.array([node.initial[0] for node in found.nodes])
        self._width = np.array([node.initial[1] - node.initial[0] for node in found.nodes])
        self._rows = range(len(self.agents))
        self._state: State | None = None
        _keep_freed_memory()

    @property
    def neutral_action(self) -> dict[str, Floats]:
        """Normalised action of each agent that leaves it neutral, shape (1,) each."""
        neutral = (self.dynamics.neutral[self._acting] - self._middle[:, 0]) / self._half[:, 0]
        return {agent: neutral[i : i + 1] for i, agent in enumerate(self.agents)}

    @property
    def physical(self) -> State:
        """The current physical state; its arrays must not be written to.

        Raises:
            ControlError: before the first ``reset``.
        """
        if self._state is None:
            raise ControlError("the environment has no state yet: call reset() first")
        return self._state

    def reset(
        self, seed: int | Sequence[int] | None = None, options: Mapping[str, Any] | None = None
    ) -> dict[str, NDArray[np.float32]]:
        """Start an episode in every copy and return the observations.

        Args:
            seed: an integer s seeds copy i with s + i; a sequence gives each copy its own; None goes on with the
                streams.
            options: ``{"initial_state": …}``: a mapping node → stock (a number or shape (num_envs,)), the rest being
                drawn; or, in a scenario that observes ``stocks``, an array in the order of the observation.

        Raises:
            ControlError: for a seed, option or state that cannot be used; the environment is left as it was.
        """
        streams = self._random if seed is None else self._streams(seed)
        given = self._given_state(options)
        self._random = streams
        stock = self._draw(range(self.num_envs))
        for node, values in given.items():
            stock[node] = values
        self._state = self._fresh(stock)
        return self.by_agent(self._observe(self._state))

    def step(
        self, actions: Mapping[str, ArrayLike]
    ) -> tuple[
        dict[str, NDArray[np.float32]],
        dict[str, Floats],
        dict[str, NDArray[np.bool_]],
        dict[str, NDArray[np.bool_]],
        Infos,
    ]:
        """Hold the actions for one control interval.

        Args:
            actions: agent → array of shape (num_envs, 1) in [−1, 1].

        Returns:
            Observations, rewards, terminations, truncations and infos, each by agent.

        Raises:
            ControlError: for missing or unknown agents, wrong shapes, NaN or values out of bounds.
        """
        outcome = self.advance(self.stack(actions))
        infos = self.infos(outcome)
        observation = outcome.observation
        if outcome.truncated.any():
            self._report_ends(infos, outcome)
            observation = self._restart(outcome.truncated)
        terminated = np.zeros(self.num_envs, dtype=bool)
        return (
            self.by_agent(observation),
            {agent: outcome.reward[i] for i, agent in enumerate(self.agents)},
            dict.fromkeys(self.agents, terminated),
            dict.fromkeys(self.agents, outcome.truncated),
            infos,
        )

    def stack(self, actions: Mapping[str, ArrayLike]) -> Floats:
        """Stack the actions of all agents, shape (agents, B); the checks of ``step`` apply."""
        stacked = np.empty((len(self.agents), self.num_envs))
        if len(actions) != len(self.agents):
            raise ControlError(self._wrong_agents(actions))
        for i, agent in enumerate(self.agents):
            if agent not in actions:
                raise ControlError(self._wrong_agents(actions))
            action = np.asarray(actions[agent])
            if action.shape != (self.num_envs, 1):
                raise ControlError(f"action of agent '{agent}' has shape {action.shape}, expected {(self.num_envs, 1)}")
            if action.dtype.kind not in "biuf":
                raise ControlError(f"action of agent '{agent}' is {actions[agent]!r}; it must hold numbers in [-1, 1]")
            stacked[i] = action[:, 0]
        return stacked

    def advance(self, actions: Floats) -> Outcome:
        """Hold stacked actions, shape (agents, B), for one control interval; no copy is restarted.

        Raises:
            ControlError: for NaN, values outside [−1, 1], or an episode that is over.
        """
        state, dynamics = self.physical, self.dynamics
        if not (actions.max() <= 1.0 and actions.min() >= -1.0):
            raise ControlError(self._wrong_values(actions))
        horizon = self.network.episode.horizon
        if (state.step >= horizon).any():
            raise ControlError(f"the episode is over after {horizon} steps: call reset()")
        controls = self.controls(actions)
        transition = dynamics.advance(state.stock, dynamics.rate(controls, state.step))
        flow = transition.moved / self.network.episode.control_interval
        quantities = np.concatenate([transition.stock[:-1], flow])
        levels = self.scoring.levels(quantities)
        service = self.scoring.service_level(levels)
        terms = self.scoring.terms(quantities, levels)
        local = self.scoring.local(terms)
        circularity = self.network.circularity(dynamics.flow(transition.stock, transition.rate))
        mean = self.network.circularity(flow)
        team = circularity if self._team == "end" else mean
        reward = self._reward(team, local, terms, state, controls)
        step = state.step + 1
        self._state = State(transition.stock, flow, step, state.circularity + mean, state.service + service)
        observation = self.layout.observe(quantities, step / horizon, levels)
        return Outcome(observation, reward, local, circularity, mean, service, flow, step >= horizon)

    def controls(self, actions: Floats) -> Floats:
        """Map stacked actions, shape (agents, B), to the physical values of every control, shape (controls, B)."""
        acting = actions * self._half
        acting += self._middle
        if self._all_act:
            return acting
        controls = np.repeat(self.dynamics.neutral[:, None], actions.shape[1], axis=1)
        controls[self._acting] = acting
        return controls

    def local_rewards(self) -> dict[str, Floats]:
        """Return the local reward that the current state gives each compartment, acting or not, shape (B,)."""
        quantities = self._quantities(self.physical)
        rewards = self.scoring.local_of_all(self.scoring.terms(quantities, self.scoring.levels(quantities)))
        return dict(zip(self.network.compartments, rewards, strict=True))

    def state(self) -> Floats:
        """Return the whole state, shape (B, nodes + 1): stocks in mass units, then the elapsed share of time."""
        state = self.physical
        return np.concatenate([state.stock[:-1].T, (state.step / self.network.episode.horizon)[:, None]], axis=1)

    def snapshot(self) -> Snapshot:
        """Return a copy of the state and the random streams; environments are not changed."""
        streams = tuple(copy.deepcopy(dict(stream.bit_generator.state)) for stream in self._random)
        return Snapshot(_copied(self.physical), streams, self.agents, self._identity)

    def restore(self, snapshot: Snapshot) -> dict[str, NDArray[np.float32]]:
        """Go back to a snapshot and return the observations there.

        Raises:
            ControlError: if the snapshot is of another network, batch size or choice of agents.
        """
        theirs = (snapshot.network, len(snapshot.streams), snapshot.agents)
        ours = (self._identity, self.num_envs, self.agents)
        if theirs != ours:
            raise ControlError(f"the snapshot (network, copies, agents) {theirs} does not fit {ours}")
        for stream, saved in zip(self._random, snapshot.streams, strict=True):
            stream.bit_generator.state = copy.deepcopy(dict(saved))
        self._state = _copied(snapshot.state)
        return self.by_agent(self._observe(self._state))

    def close(self) -> None:
        """Do nothing; the environment holds no resources."""

    def by_agent(self, stacked: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
        """Split a stacked observation, shape (entries of all agents, B), into agent → (B, entries)."""
        return {agent: stacked[rows].T for agent, rows in self.layout.slices.items()}

    @property
    def _identity(self) -> str:
        """What a snapshot has to fit; the horizon may differ, as planners look less far ahead."""
        return f"{self.network.name}, scenario {self.network.scenario_name}"

    def infos(self, outcome: Outcome) -> Infos:
        """Return λ, local reward, flows (B, arcs) and service level for each agent."""
        flows = outcome.flow.T
        return {
            agent: {
                "circularity": outcome.circularity,
                "local_reward": outcome.local[i],
                "flows": flows,
                "service_level": outcome.service_level,
            }
            for i, agent in enumerate(self.agents)
        }

    def _reward(self, team: Floats, local: Floats, terms: Floats, state: State, controls: Floats) -> Floats:
        objective = self.network.objective
        if self.reward_mode == "local":
            return local.copy()
        if self.reward_mode == "mixed":
            shared = team * (objective.circularity_weight / objective.circularity_scale)
            mixed: Floats = local * (1.0 - objective.circularity_weight)
            mixed += shared
            return mixed
        if self.reward_mode == "difference":
            return team - self._counterfactuals(state, controls)
        common = team if self.reward_mode == "circularity" else self.scoring.local_sum(terms)
        return np.repeat(common[None], len(self.agents), axis=0)

    def _counterfactuals(self, state: State, controls: Floats) -> Floats:
        """λ had each agent in turn been neutral, re-simulated from the same state, shape (agents, B)."""
        dynamics, batch = self.dynamics, self.num_envs
        chunk = max(1, COUNTERFACTUAL_CELLS // state.stock.size)
        results = []
        for start in range(0, len(self._acting), chunk):
            rows = self._acting[start : start + chunk]
            count = len(rows)
            imagined = np.tile(controls, (1, count))
            for i, row in enumerate(rows):
                imagined[row, i * batch : (i + 1) * batch] = dynamics.neutral[row]
            rate = dynamics.rate(imagined, np.tile(state.step, count))
            transition = dynamics.advance(np.tile(state.stock, (1, count)), rate)
            flow = (
                dynamics.flow(transition.stock, transition.rate)
                if self._team == "end"
                else transition.moved / self.network.episode.control_interval
            )
            results.append(self.network.circularity(flow).reshape(count, batch))
        return np.concatenate(results)

    def _report_ends(self, infos: Infos, outcome: Outcome) -> None:
        """Add the final observations and the episode's λ̄ and service level of the copies that ended."""
        state, ended = self.physical, outcome.truncated
        steps = np.maximum(state.step, 1)
        final = self.by_agent(outcome.observation)
        for agent, info in infos.items():
            info["final_observation"] = final[agent]
            info["_final_observation"] = ended
            info["episode_circularity"] = state.circularity / steps
            info["episode_service_level"] = state.service / steps

    def _restart(self, ended: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Start the next episode in the copies that ended and return the observation of all."""
        which = np.flatnonzero(ended)
        stock = self.physical.stock[:-1].copy()
        stock[:, which] = self._draw(which)
        fresh = self._fresh(stock)
        old = self.physical
        self._state = State(
            fresh.stock,
            np.where(ended, fresh.flow, old.flow),
            np.where(ended, 0, old.step),
            np.where(ended, 0.0, old.circularity),
            np.where(ended, 0.0, old.service),
        )
        return self._observe(self._state)

    def _fresh(self, stock: Floats) -> State:
        """State at the start of an episode; the flows are those that neutral control would give."""
        dynamics, batch = self.dynamics, stock.shape[1]
        extended = dynamics.extend(stock)
        step = np.zeros(batch, dtype=np.intp)
        rate = dynamics.rate(np.repeat(dynamics.neutral[:, None], batch, axis=1), step)
        zeros = np.zeros(batch)
        return State(extended, dynamics.flow(extended, rate), step, zeros, zeros)

    def _quantities(self, state: State) -> Floats:
        return np.concatenate([state.stock[:-1], state.flow])

    def _observe(self, state: State) -> NDArray[np.float32]:
        quantities = self._quantities(state)
        time = state.step / self.network.episode.horizon
        return self.layout.observe(quantities, time, self.scoring.levels(quantities))

    def _draw(self, which: Sequence[int] | range | Integers) -> Floats:
        """Draw initial stocks of some copies, each from its own stream, shape (nodes, len(which))."""
        uniform = np.empty((len(self._low), len(which)))
        for column, i in enumerate(which):
            uniform[:, column] = self._random[i].random(len(self._low))
        uniform *= self._width[:, None]
        uniform += self._low[:, None]
        return uniform

    def _streams(self, seed: int | Sequence[int]) -> list[np.random.Generator]:
        if isinstance(seed, int | np.integer):
            seeds = [int(seed) + i for i in range(self.num_envs)]
        else:
            seeds = list(seed) if isinstance(seed, Sequence | np.ndarray) else []
        if len(seeds) != self.num_envs or any(not isinstance(s, int | np.integer) or s < 0 for s in seeds):
            raise ControlError(f"seed {seed!r} must be a non-negative integer, or {self.num_envs} of them")
        return [np.random.default_rng(s) for s in seeds]

    def _given_state(self, options: Mapping[str, Any] | None) -> dict[int, Floats]:
        """Return the given initial stocks by node position."""
        options = options or {}
        for key in options:  # other keys are for wrappers: PettingZoo's own test passes one; a misspelt one is an error
            if key != "initial_state" and difflib.get_close_matches(str(key), ["initial_state"]):
                raise ControlError(f"reset options: {unknown('option', key, ['initial_state'])}")
        given = options.get("initial_state", {})
        if not isinstance(given, Mapping):
            nodes = self.network.observation.nodes
            values = np.asarray(given, dtype=float)
            if not nodes or values.shape != (len(nodes),):
                raise ControlError(
                    f"initial_state has shape {values.shape}: give a mapping node → stock"
                    + (f", or the stocks of {', '.join(nodes)} in this order" if nodes else "")
                )
            given = dict(zip(nodes, values, strict=True))
        checked = {self._node(id_): self._stock(id_, values) for id_, values in given.items()}
        limit = sum(node.initial[1] for node in self.network.nodes)
        most = self._low + self._width
        if self.dynamics.exact and checked:
            total = sum(float(np.max(checked.get(i, most[i]))) for i in range(len(most)))
            if total > limit * (1 + 1e-9):
                raise ControlError(
                    f"initial_state: {total:.6g} {self.network.mass_unit} in all, but the observation space of "
                    f"'{self.network.name}' covers {limit:.6g}; widen the initial ranges of the definition"
                )
        return checked

    def _node(self, id_: str) -> int:
        if id_ not in self.network.node_index:
            raise ControlError(f"initial_state: {unknown('node', id_, self.network.node_index)}")
        return self.network.node_index[id_]

    def _stock(self, id_: str, values: ArrayLike) -> Floats:
        stock = np.asarray(values, dtype=float)
        if stock.shape not in ((), (self.num_envs,)):
            raise ControlError(f"initial_state of '{id_}' has shape {stock.shape}, expected () or {(self.num_envs,)}")
        if not np.isfinite(stock).all() or (self.dynamics.exact and (stock < 0).any()):
            raise ControlError(f"initial_state of '{id_}' is {values!r}: stocks are finite and not negative")
        return stock

    def _checked_agents(self, agents: Sequence[str] | None) -> tuple[str, ...]:
        network = self.network
        if agents is None:
            chosen = network.agents
        elif isinstance(agents, str):
            raise CirlError(f"agents must be a sequence of ids, not the string '{agents}'")
        else:
            chosen = tuple(agents)
        for agent in chosen:
            if agent not in network.controllable:
                raise CirlError(f"network '{network.name}': {unknown('agent', agent, network.controllable)}")
        if not chosen or len(set(chosen)) != len(chosen):
            raise CirlError(f"network '{network.name}': agents {list(chosen)} must be distinct and at least one")
        return chosen

    def _wrong_agents(self, actions: Mapping[str, object]) -> str:
        for agent in actions:
            if agent not in self.agents:
                return f"actions: {unknown('agent', agent, self.agents)}"
        return f"actions are missing for {[agent for agent in self.agents if agent not in actions]}"

    def _wrong_values(self, actions: Floats) -> str:
        wrong = ~((actions >= -1.0) & (actions <= 1.0))
        agent, copy_ = np.argwhere(wrong)[0]
        return (
            f"action of agent '{self.agents[agent]}' in copy {copy_} is {actions[agent, copy_]}; "
            "it must be a number in [-1, 1]"
        )


def _choice(what: str, value: str, known: Sequence[str]) -> str:
    if value not in known:
        raise CirlError(unknown(what, value, known))
    return value


def _keep_freed_memory() -> None:
    """Make glibc keep freed arrays for the next step instead of returning their pages to the system.

    Its thresholds follow the largest block freed so far; below them a step of 1 024 copies spends more time on page
    faults than on arithmetic. The block is never touched, so it costs nothing; other allocators ignore it.
    """
    np.empty(30 * 2**20, dtype=np.uint8)


def _copied(state: State) -> State:
    return replace(state, **{name: getattr(state, name).copy() for name in State.__slots__})
