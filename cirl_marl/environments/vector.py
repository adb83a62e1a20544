"""The multi-agent environment of a material network, batched: arrays in and out.

Every other view (PettingZoo, Gymnasium, the environments of the learners) stands on this one.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import reduce
from pathlib import Path
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.definitions.ids import environment_name
from cirl_marl.dynamics.integrator import Dynamics, Transition
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.dynamics.supply import Supply
from cirl_marl.environments.actuators import Actuators
from cirl_marl.environments.observations import ObservationLayout
from cirl_marl.environments.rewards import Credit, Scoring
from cirl_marl.environments.starts import Starts, float_array
from cirl_marl.environments.state import Interval, Outcome, Snapshot, State
from cirl_marl.environments.substance_masses import SubstanceMasses
from cirl_marl.errors import CirlError, ControlError, check_names, real_number, whole_number
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.calendar import years
from cirl_marl.network.elements import MOMENTS, REWARDS
from cirl_marl.network.processes import Paths, interval_of
from cirl_marl.network.uncertainty import draw_network

MOST = 2**24
"""Most copies, and most decisions of an episode."""

Infos = dict[str, dict[str, Any]]
Observations = dict[str, NDArray[np.float32]]
Flags = dict[str, NDArray[np.bool_]]


class MultiAgentVectorEnv:
    """``num_envs`` independent copies of a material network, stepped together: a dict of agents, of arrays.

    Observations, rewards and so on are dicts agent → array with leading axis ``num_envs``. ``infos[agent]`` holds what
    ``team_info`` gives, which is the same for all agents, and

    =============================  ====================================================================================
    ``local_reward``               the agent's local reward
    ``success``                    whether the task of its model is done, if the model has a criterion
    =============================  ====================================================================================

    A copy whose episode ended starts the next one within the same step (Gymnasium's ``AutoresetMode.SAME_STEP``). In
    such a step ``infos[agent]`` also has these, which are valid where ``_final_obs`` and ``_final_info`` are true:

    =============================  ====================================================================================
    ``final_obs``                  the last observation of the episode
    ``final_info``                 the info of its last step, and as ``state`` what ``state()`` was at its end
    ``episode_circularity``        mean of λ over the episode, mass
    ``episode_service_level``      mean of the service level over the episode
    ``episode_accounts``           discounted total on each account, a dict account → shape (B,), if there are any
    =============================  ====================================================================================

    Attributes:
        network: the network under the chosen scenario.
        agents: compartments that act, in the order of every stacked array.
        uncertain: whether the uncertain numbers are drawn.
        reward_mode: one of those of ``rewards.Credit``.
        observation_names: by agent, what each entry of its observation is.
        action_spaces: by agent; Box(−1, 1), mapped linearly to the bounds of the control.
        rows: which row of the physical state is what.
        actuators: from actions to controls.
        idle: which arcs of ``supply`` nobody acts on.
        ledger: what is booked on accounts.
        substance_masses: what substances there are in stocks and flows.
        supply: the arcs that make up for services.
        controls: their values in the last interval, in the rows of ``network.control_rows``, (controls, num_envs).
        state_names: nodes, ``compartment.state`` of the inner states, ``arc.row`` of the masses of batch arcs, and
            ``disturbance.state`` of the disturbances, in the order of ``state()``.
        interval: the last interval, as derivatives need it.
        episodes: episodes begun in each copy, those gone back to included, shape (num_envs,).
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
        countdown: bool | None = None,
        circularity: str = "end",
        circularity_weight: float | None = None,
        charges: Mapping[str, float] | None = None,
        horizon: int | None = None,
        uncertain: bool = False,
    ) -> None:
        """Make the environments.

        Args:
            network: catalogue name, path of a definition file, or a network.
            num_envs: B, number of copies.
            scenario: scenario of the definition; None is the default, physical one.
            agents: who acts; the others hold their neutral control. None: the network's own choice.
            reward: reward mode; None takes the scenario's own, which is ``mixed`` unless the definition says otherwise.
            observe: ``local``, ``neighbours``, ``full`` or ``model``; None takes the scenario's own.
            countdown: whether agents also see 1/(intervals left), and so the end; None takes the scenario's own.
            circularity: whether the team reward is λ at the ``end`` of the interval or its ``mean`` over it.
            circularity_weight: w in [0, 1], weight of λ in the reward; None takes the definition's.
            charges: what a unit of each account costs in rewards with λ, mass; see ``Credit``.
            horizon: decisions per episode; None takes the definition's.
            uncertain: whether each copy draws the network's uncertain numbers (``Network.uncertain``) at each reset,
                after its start and from the same stream. Agents do not see the draw; it is in ``physical.factors``
                and, as ``drawn``, in every info.

        Raises:
            CirlError: for an unknown network, scenario, agent or option.
        """
        variant = load_network(network, scenario=scenario)
        default = variant.episode.horizon
        for name, value in (("num_envs", num_envs), ("horizon", default if horizon is None else horizon)):
            if whole_number(name, value, 1) > MOST:
                raise CirlError(f"{name} must be at most {MOST:,}, got {value:,}: no memory holds as many")
        if horizon is not None:
            variant = variant.with_options(episode={"horizon": horizon})
        if circularity_weight is not None:
            weight = real_number("circularity_weight", circularity_weight, 0, 1)
            variant = variant.with_options(objective={"circularity_weight": weight})
        self.network = variant
        self.num_envs = num_envs
        self.reward_mode = variant.objective.reward if reward is None else reward
        check_names("reward", [self.reward_mode], REWARDS)
        check_names("circularity", [circularity], MOMENTS)
        if uncertain and not variant.uncertain:
            remedy = "give a number a deviation or a range, or leave out uncertain"
            raise CirlError(f"network '{variant.name}': nothing is uncertain; {remedy}")
        self.uncertain = uncertain
        self.dynamics = Dynamics(variant, uncertain=uncertain)
        self.supply = Supply(self.dynamics)
        self.actuators = Actuators(variant, agents, num_envs, self.dynamics.factors.ranges)
        self.agents = self.actuators.agents
        self.action_spaces = self.actuators.spaces
        self.layout = ObservationLayout(self.dynamics, self.agents, observe, num_envs, countdown)
        self.ledger = Ledger(variant, self.dynamics.factors.ranges)
        self.scoring = Scoring(self.dynamics, self.layout, self.agents, num_envs)
        self.idle = self.supply.idle(self.agents)
        self._credit = Credit(self.dynamics, self.supply, self.scoring, self.agents, self.reward_mode, circularity)
        charges = {} if charges is None else charges
        self._check_charges(charges)
        self.account_charges = [charges.get(account, 0.0) for account in self.ledger.accounts]
        self.observation_names = self.layout.names
        self._starts = Starts(variant, self.dynamics, num_envs, self.layout.array_order)
        self.rows = self.dynamics.rows
        self.substance_masses = SubstanceMasses(variant, self.rows)
        self.state_names = (*self.rows.start_names, *self.rows.batch_names, *variant.processes.state_names)
        self.episodes: Integers = np.zeros(num_envs, dtype=np.intp)
        self.controls: Floats = np.empty((len(self.dynamics.neutral), num_envs))
        self.interval: Interval
        self._state: State | None = None
        self._services = [service.id for service in variant.services]
        self._costs = [f"cost_{service}" for service in self._services]
        _keep_freed_memory()

    def __str__(self) -> str:
        """Return the name of the network and its scenario, as in ids of environments."""
        return environment_name(self.network)

    @property
    def observation_spaces(self) -> dict[str, Box[np.float32]]:
        """Observation space of each agent; float32."""
        return self.layout.spaces

    @property
    def circularity_weight(self) -> float:
        """Weight of λ in the reward, in [0, 1]; another one counts from the next step on."""
        return self._credit.weight

    @circularity_weight.setter
    def circularity_weight(self, weight: float) -> None:
        self._credit.weigh(real_number("circularity_weight", weight, 0, 1))

    @property
    def service_factors(self) -> Floats:
        """Factors on the weights of services in rewards, shape (services,); others count from the next step on."""
        return self.scoring.service_factors

    @service_factors.setter
    def service_factors(self, factors: ArrayLike) -> None:
        values = float_array("service_factors", factors)
        if values.shape != self.scoring.service_factors.shape or not (np.isfinite(values) & (values >= 0)).all():
            raise CirlError(f"service_factors must be {len(self._services)} numbers of at least 0, got {factors!r}")
        self.scoring.service_factors = values

    @property
    def account_charges(self) -> Floats:
        """What a unit of each account costs in rewards with λ, mass; others count from now on.

        The shape is (accounts,), or (accounts, horizon) if it changes in time.
        """
        return self._credit.charges

    @account_charges.setter
    def account_charges(self, charges: ArrayLike) -> None:
        values = float_array("charges", charges)
        shapes = (len(self.ledger.accounts),), self.ledger.discount.shape
        if values.shape not in shapes or not np.isfinite(values).all():
            raise CirlError(f"charges must be finite numbers, one for each account, got {charges!r}")
        self._credit.charges = values

    def _check_charges(self, charges: Mapping[str, float]) -> None:
        """Refuse charges of what is no account, that are no numbers, or in rewards that have no λ."""
        if not isinstance(charges, Mapping):
            raise CirlError(f"charges: give {{account: number}}, got {charges!r}")
        for account, charge in charges.items():
            real_number(f"charges: that of '{account}'", charge)
            check_names("account", [account], self.ledger.accounts, f"network '{self.network.name}': charges: ")
        if any(charges.values()) and self.reward_mode in ("local", "local_sum"):
            raise CirlError(f"charges count in rewards with λ, not in '{self.reward_mode}'")

    @property
    def is_random(self) -> bool:
        """Whether episodes differ by anything but what agents do: starts, models, uncertain numbers, disturbances."""
        return self.uncertain or self._starts.are_random

    @property
    def neutral_action(self) -> dict[str, Floats]:
        """Action of each agent that leaves it neutral in the coming interval, shape (num_envs, entries) each.

        An agent that makes up for a service supplies what lacks while all are neutral.
        """
        return self.neutral_beside({})

    def neutral_beside(self, actions: Mapping[str, ArrayLike]) -> dict[str, Floats]:
        """Return the actions of all agents, of which those that are not given stay neutral.

        What an agent supplies to make up for a service depends on what others do in the interval, so that it can be
        told only beside their actions.
        """
        step, state = self._next_interval(), self._state
        factors = None if state is None else self.factors_in(step)
        neutral: dict[str, Floats] = self.actuators.neutral_action(step, factors)
        joint = neutral | {agent: np.asarray(action) for agent, action in actions.items()}
        suppliers = [arc for arc in self.supply.arcs if arc in self.agents and arc not in actions]
        if suppliers and state is not None and (state.step < self.network.episode.horizon).all():
            controls = self.actuators.controls(self.stack(joint), step, factors)
            idle = self.supply.idle([agent for agent in self.agents if agent not in suppliers])
            controls = self.supply(state.stock, state.inner, controls, step, idle, factors)
            for arc in suppliers:
                joint[arc] = self.normalise(arc, controls[self.network.control_rows[arc]])
        return joint

    def normalise(self, agent: str, values: Floats) -> Floats:
        """Return the action that comes closest to physical values of an agent's control in the coming interval.

        Values have shape (entries of its action, num_envs), actions (num_envs, entries).
        """
        step = self._next_interval()
        factors = None if self._state is None else self.factors_in(step)
        return self.actuators.normalise(agent, values, step, factors).T

    def control_values(self, actions: Mapping[str, ArrayLike]) -> Floats:
        """Return the values of all controls under actions of all agents in the coming interval, (controls, B)."""
        step = self._next_interval()
        return self.actuators.controls(self.stack(actions), step, self.factors_in(step))

    @property
    def physical(self) -> State:
        """The current physical state; its arrays must not be written to. Before ``reset`` there is none."""
        if self._state is None:
            raise ControlError("the environment has no state yet: call reset() first")
        return self._state

    @property
    def year(self) -> Floats | None:
        """Calendar year of each copy, with its fraction, shape (B,); None if the network does not begin in a year."""
        episode = self.network.episode
        return None if episode.start is None else years(self.network, self.physical.step * episode.control_interval)

    def reset(self, seed: int | Sequence[int] | None = None, options: Mapping[str, Any] | None = None) -> Observations:
        """Start an episode in every copy and return the observations.

        Args:
            seed: an integer s seeds copy i with s + i; a sequence gives each copy its own; None goes on with the
                streams.
            options: ``{"initial_state": …}``: a mapping of node → stock and ``compartment.state`` → inner state (a
                number or shape (num_envs,)), the rest being drawn; or, if a single agent observes ``stocks`` or its
                ``model``, an array in the order of its observation.

        Raises:
            ControlError: for a seed, option or state that cannot be used; the environment is left as it was.
        """
        start, factors = self._starts.begin(seed, options, uncertain=self.uncertain)
        self._state = self._fresh(start, factors, self._starts.paths(range(self.num_envs)))
        self.episodes = self.episodes + 1
        return self.observations()

    def step(self, actions: Mapping[str, ArrayLike]) -> tuple[Observations, dict[str, Floats], Flags, Flags, Infos]:
        """Hold the actions, agent → array (num_envs, entries of its action) in [−1, 1], for one control interval.

        Returned are observations, rewards, terminations, truncations and infos, each by agent.

        Raises:
            ControlError: for missing or unknown agents, wrong shapes, NaN or values out of bounds.
        """
        outcome = self.advance(self.stack(actions))
        team = self.team_info(outcome)
        infos: Infos = {a: {**team, "local_reward": local} for a, local in zip(self.agents, outcome.local, strict=True)}
        for agent in outcome.success.keys() & infos.keys():
            infos[agent]["success"] = outcome.success[agent]
        observation = outcome.observation
        if outcome.truncated.any():
            self._report_ends(infos, outcome)
            observation = self._restart(outcome.truncated)
        terminated = np.zeros(self.num_envs, dtype=bool)
        terminated.flags.writeable = outcome.truncated.flags.writeable = False  # one array for all agents
        rewards = dict(zip(self.agents, outcome.reward, strict=True))
        terminations, truncations = (dict.fromkeys(self.agents, flag) for flag in (terminated, outcome.truncated))
        return self.by_agent(observation), rewards, terminations, truncations, infos

    def team_info(self, outcome: Outcome) -> dict[str, Any]:
        """Return what infos say to all agents of the interval of ``outcome``, the last one; arrays are read-only.

        =====================  ==================================================================================
        ``circularity``        λ at the end of the interval, shape (B,), mass
        ``flows``              mean flows in the order of ``network.arcs``, shape (B, arcs), mass/time
        ``service_level``      mean level of the services, shape (B,); 1 without services
        ``service_levels``     level of each service, a dict service → shape (B,)
        ``cost_SERVICE``       shortfall 1 − level of each service, shape (B,)
        ``cost``               sum of the shortfalls, shape (B,): what safe reinforcement learning keeps below a budget
        ``accounts``           amount booked on each account in the interval, a dict account → shape (B,), if any
        ``entries``            amounts booked by ``ledger.compartments`` on ``ledger.account``, shape (B, entries)
        ``region_accounts``    a dict region → account → amount, shape (B,), in a network of copies
        ``substances``         mean flows of each substance, a dict substance → (B, arcs), mass/time, if there are any
        ``drawn``              with ``uncertain``: factors in the order of ``network.uncertain``, shape (B, numbers)
        ``disturbances``       their values in the interval, a dict disturbance → shape (B,), if there are any
        ``year``               calendar year at the end, shape (B,), if the network begins in one
        =====================  ==================================================================================
        """
        levels = outcome.levels
        shortfalls = 1.0 - levels
        for array in (outcome.circularity, outcome.service_level, levels, shortfalls):
            array.setflags(write=False)  # the same for all agents
        costs = [*shortfalls]
        # np.sum would add in another order for another number of copies
        cost = reduce(np.add, costs) if costs else np.zeros(self.num_envs)
        cost.setflags(write=False)
        info: dict[str, Any] = {
            "circularity": outcome.circularity,
            "flows": outcome.flow.T,
            "service_level": outcome.service_level,
            "service_levels": dict(zip(self._services, levels, strict=True)),
            "cost": cost,
            **dict(zip(self._costs, costs, strict=True)),
        }
        if self.ledger.accounts:
            outcome.bookings.setflags(write=False)
            info["accounts"] = dict(zip(self.ledger.accounts, outcome.bookings, strict=True))
            info["entries"] = outcome.entries.T
            info["entries"].flags.writeable = False
        if self.ledger.regions:
            amounts = self.ledger.regional_sums(outcome.entries)
            amounts.setflags(write=False)
            by_region = (dict(zip(self.ledger.accounts, region, strict=True)) for region in amounts)
            info["region_accounts"] = dict(zip(self.ledger.regions, by_region, strict=True))
        if self.network.substances:
            flows = self.physical.substances.reshape(len(self.network.substances), -1, self.num_envs)
            flows.flags.writeable = False
            names = (substance.id for substance in self.network.substances)
            info["substances"] = {name: flow.T for name, flow in zip(names, flows, strict=True)}
        info |= self.drawn_info(np.maximum(self.physical.step - 1, 0))
        if (year := self.year) is not None:
            year.flags.writeable = False
            info["year"] = year
        return info

    def drawn_info(self, step: Integers) -> dict[str, Any]:
        """Return what infos say of what an episode drew and what disturbs an interval of each copy, shape (B,)."""
        info: dict[str, Any] = {"drawn": self.physical.factors.T.copy()} if self.uncertain else {}
        if names := self._starts.processes.names:
            values = interval_of(self.physical.disturbances, step).view()
            values.setflags(write=False)
            info["disturbances"] = dict(zip(names, values, strict=True))
        return info

    def factors_in(self, step: Integers) -> Floats | None:
        """Return the factors on numbers that are not certain in an interval of each copy, shape (numbers, B), if any.

        Their rows are those of ``dynamics.factors.ranges``.
        """
        return self.dynamics.factors(self.physical.factors, self.physical.disturbances, step)

    def lacks(self) -> dict[str, Floats]:
        """Return what is missing of what is aimed at in the coming interval, relative to that, shape (B,) each.

        Of services it is what they lack now of their lower ends in that interval, of nodes what they lack of their
        set-points; a surplus is negative.
        """
        state, step = self.physical, self._next_interval()
        services = self.scoring.lack(self.quantities(state), step, self.factors_in(step))
        lacks = dict(zip(self._services, services, strict=True))
        for node, stock in zip(self.network.stores, self.rows.stocks(state.stock), strict=True):
            if node.set_point:
                lacks[node.id] = 1.0 - stock / node.set_point
        return lacks

    def certain_network(self, copy: int) -> Network:
        """Return the network of the episode in a copy: certain, with all that it drew and that disturbs it.

        Its solver takes as many steps as here, as flows are cut in each of them to what their donors hold.
        """
        if not self.dynamics.factors.ranges:
            return self.network
        state = self.physical
        path = state.disturbances[:-1, :, copy] if len(state.disturbances) else None
        network: Network = draw_network(self.network, state.factors[:, copy].tolist(), path)
        steps = {"solver_step": self.dynamics.substep} if self.dynamics.substeps > 1 else {}
        return network.with_options(episode=steps)

    def stack(self, actions: Mapping[str, ArrayLike]) -> Floats:
        """Stack the actions of all agents, shape (entries, B); the checks of ``step`` apply."""
        return self.actuators.stack(actions)

    def unstack(self, actions: Floats) -> dict[str, Floats]:
        """Split stacked actions, shape (entries, B), into agent → (B, entries of its action)."""
        return self.actuators.unstack(actions)

    def advance(self, actions: Floats) -> Outcome:
        """Hold stacked actions, shape (entries, B), for one control interval; no copy is restarted.

        Raises:
            ControlError: for NaN, values outside [−1, 1], or an episode that is over.
            CirlError: if the solver cannot follow the physics, which leaves the environment as it was.
        """
        state, dynamics = self.physical, self.dynamics
        horizon = self.network.episode.horizon
        if (state.step >= horizon).any():
            raise ControlError(f"the episode is over after {horizon} steps: call reset()")
        factors = self.factors_in(state.step)
        controls = self.actuators.controls(actions, state.step, factors)
        deviation = self.actuators.deviation(controls, state.step, factors) if self.ledger.has_efforts else None
        controls, transition = self.supply.advance(state.stock, state.inner, controls, state.step, self.idle, factors)
        self.controls = controls
        quantities, flow = self._measure(transition, controls)
        levels = self.scoring.levels(quantities, state.step, factors)
        service = self.scoring.service_level(levels)
        terms = self.scoring.terms(quantities, levels, dynamics.inner.rewards(state.inner, transition.inner, controls))
        local = self.scoring.local(terms)
        circularity, mean, batch_mass = self._credit.circularity(state, transition, flow)
        step = state.step + 1
        entries = bookings = accounts = state.accounts
        if self.ledger.accounts:
            before, after = self.rows.stocks(state.stock), self.rows.stocks(transition.stock)
            entries = self.ledger.entries(flow, before, after, deviation, state.step, factors)
            bookings = self.ledger.sums(entries)
            accounts = accounts + bookings * self.ledger.discount.take(state.step, axis=1)
        amounts = accounts - state.accounts
        reward = self._credit.pay(circularity, mean, local, terms, levels, state, controls, amounts)
        substances = transition.moved_substances / self.network.episode.control_interval
        totals = (state.circularity + mean, state.service + levels, accounts, substances)
        measures = quantities[self.layout.signals.measures]
        drawn = (state.processes, state.disturbances)
        self._state = State(
            transition.stock, transition.inner, flow, measures, step, state.factors, batch_mass, *totals, *drawn
        )
        self.interval = Interval(state, self._state, actions, controls)
        observation = self.layout.observe(quantities, step / horizon, levels, self._sight(self._state))
        success = dynamics.inner.successes(transition.inner, controls)
        scores = (reward, local, circularity, mean, levels, service)
        return Outcome(observation, *scores, flow, entries, bookings, step >= horizon, success)

    def go_back(self, state: State, controls: Floats) -> None:
        """Go back to a state of this episode, as ``physical`` gave it, and the ``controls`` that led to it."""
        self._state, self.controls = state, controls

    def local_rewards(self) -> dict[str, Floats]:
        """Return the local reward that the current state gives each compartment, acting or not, shape (B,)."""
        state = self.physical
        done = np.maximum(state.step - 1, 0)  # the interval that the state is scored in
        quantities = self.quantities(state)
        factors = self.factors_in(done)
        inner = self.dynamics.inner.rewards(state.inner, state.inner, self.dynamics.neutral_in(done, factors))
        levels = self.scoring.levels(quantities, done, factors)
        rewards = self.scoring.local_of_all(self.scoring.terms(quantities, levels, inner))
        return dict(zip(self.network.compartments, rewards, strict=True))

    def state(self) -> Floats:
        """Return the whole state, shape (B, entries): ``state_names``, then the elapsed share of time."""
        state = self.physical
        time = state.step / self.network.episode.horizon
        processes = interval_of(state.processes, state.step)
        masses = state.stock[self.rows.nodes], state.inner, state.stock[self.rows.batches]
        return np.concatenate([*masses, processes, time[None]]).T

    def observations(self) -> Observations:
        """Return the observations that the agents act on next, equal to what the last reset, step or restore gave."""
        return self.by_agent(self.stacked_observation())

    def snapshot(self) -> Snapshot:
        """Return a copy of the state and the random streams; environments are not changed."""
        return Snapshot(self.physical.copy(), self._starts.saved_streams(), self.agents, self.network)

    def restore(self, snapshot: Snapshot) -> Observations:
        """Go back to a snapshot, which must be of the same network, horizon, batch size and agents, and observe."""
        if not isinstance(snapshot, Snapshot):
            raise ControlError(f"a snapshot is needed, as ``snapshot()`` returns it, got {type(snapshot).__name__}")
        snapshot.check(self.network, self.num_envs, self.agents, uncertain=self.uncertain)
        self._starts.restore_streams(snapshot.streams)
        self._state = snapshot.state.copy()
        self.episodes = self.episodes + 1
        return self.observations()

    def close(self) -> None:
        """Do nothing; the environment holds no resources."""

    def by_agent(self, observation: NDArray[np.float32]) -> Observations:
        """Split a stacked observation, shape (entries of all agents, B), into agent → (B, entries)."""
        return self.layout.by_agent(observation)

    def _report_ends(self, infos: Infos, outcome: Outcome) -> None:
        """Add what infos say of the copies whose episode ended."""
        final, over = self.by_agent(outcome.observation), outcome.truncated
        figures, state = self.episode_figures(), self.state()
        for agent, info in infos.items():
            info |= figures
            info |= {"final_obs": final[agent], "final_info": {**info, "state": state}}
            info |= {"_final_obs": over, "_final_info": over}

    def episode_figures(self) -> dict[str, Any]:
        """Return λ̄, the mean service level and totals on accounts up to now, shape (B,) each, as infos name them."""
        state = self.physical
        steps = np.maximum(state.step, 1)
        service = self.scoring.service_level(state.service / steps)
        figures = {"episode_circularity": state.circularity / steps, "episode_service_level": service}
        amounts = state.accounts.view()
        amounts.setflags(write=False)
        totals = dict(zip(self.ledger.accounts, amounts, strict=True))
        return figures | ({"episode_accounts": totals} if totals else {})

    def _restart(self, over: NDArray[np.bool_]) -> NDArray[np.float32]:
        """Start the next episode in copies whose last is ``over``, shape (B,), and return the observation of all."""
        self.episodes = self.episodes + over
        copies, last = np.flatnonzero(over), self.physical
        start = self.rows.start_of(last.stock, last.inner)
        factors = last.factors.copy()
        start[:, copies], factors[:, copies] = self._starts.draw(copies, uncertain=self.uncertain)
        paths = self._starts.paths(copies)
        if len(copies) < self.num_envs and len(paths.states):
            episode = Paths(last.processes.copy(), last.disturbances.copy())
            episode.states[..., copies], episode.values[..., copies] = paths.states, paths.values
            paths = episode
        fresh = self._fresh(start, factors, paths)
        self._state = fresh if len(copies) == self.num_envs else last.replace(over, fresh)
        return self.stacked_observation()

    def _next_interval(self) -> Integers:
        """Return the index of the next interval in each copy, shape (num_envs,); at the end that of the last."""
        step = np.zeros(self.num_envs, dtype=np.intp) if self._state is None else self._state.step
        return np.minimum(step, self.network.episode.horizon - 1)

    def _fresh(self, start: Floats, factors: Floats, paths: Paths) -> State:
        """State at the start of an episode; flows and measures are those that neutral control would give."""
        dynamics, batch = self.dynamics, start.shape[1]
        stocks, inner = self.rows.split(start)
        stock, step = dynamics.extend(stocks), np.zeros(batch, dtype=np.intp)
        scales = dynamics.factors(factors, paths.values, step)
        idle = np.ones((len(self.supply.arcs), 1), dtype=bool)
        neutral = self.supply(stock, inner, dynamics.neutral_in(step, scales), step, idle, scales)
        flow, substances = dynamics.start_flow(stock, inner, neutral, scales)
        measures = dynamics.inner.measures(inner, neutral)
        batched, circularity = np.zeros((2, batch)), np.zeros(batch)
        service, accounts = (np.zeros((len(part), batch)) for part in (self.network.services, self.network.accounts))
        sums = (batched, circularity, service, accounts, substances)
        return State(stock, inner, flow, measures, step, factors, *sums, paths.states, paths.values)

    def _measure(self, transition: Transition, controls: Floats) -> tuple[Floats, Floats]:
        """Return all quantities in one array, and the mean flows, which are read-only."""
        signals, dynamics = self.layout.signals, self.dynamics
        quantities = np.empty((signals.quantities, self.num_envs))
        flow = quantities[signals.flows]
        np.divide(transition.moved_mass, self.network.episode.control_interval, out=flow)
        quantities[signals.stocks] = self.rows.stocks(transition.stock)
        if signals.throughputs.start < signals.throughputs.stop:
            quantities[signals.throughputs] = self.network.throughput(flow)
        if signals.inside:
            quantities[signals.states] = transition.inner
            quantities[signals.measures] = dynamics.inner.measures(transition.inner, controls)
            quantities[signals.loads] = dynamics.batches.loads(transition.stock)
        substances = transition.moved_substances / self.network.episode.control_interval
        quantities[signals.substances] = self.substance_masses(transition.stock, substances)
        flow.flags.writeable = False  # infos hand it out, and the state keeps it
        return quantities, flow

    def quantities(self, state: State) -> Floats:
        """Return the quantities of a state, in the rows of ``layout.signals``, shape (quantities, B)."""
        loads = self.dynamics.batches.loads(state.stock)
        through = self.network.throughput(state.flow)
        substances = self.substance_masses(state.stock, state.substances)
        stocks = self.rows.stocks(state.stock)
        return np.concatenate([stocks, through, state.flow, state.inner, state.measures, loads, substances])

    def stacked_observation(self, table: Floats | None = None, layout: ObservationLayout | None = None) -> NDArray[Any]:
        """Return the present observations, shape (entries of all agents, B), by way of a ``table`` of the ``layout``.

        None is that of the environment.
        """
        layout = self.layout if layout is None else layout
        state = self.physical
        quantities = self.quantities(state)
        time = state.step / self.network.episode.horizon
        done = np.maximum(state.step - 1, 0)
        factors = self.dynamics.factors(state.factors, state.disturbances, done)
        levels = self.scoring.levels(quantities, done, factors)
        return layout.observe(quantities, time, levels, self._sight(state), table)

    def _sight(self, state: State) -> Floats | None:
        """Return what the disturbances show of themselves, in the rows of ``layout.sights``; None if nothing."""
        return self.layout.sights.see(state.processes, state.disturbances, state.step) if self.layout.sights else None


def _keep_freed_memory() -> None:
    """Make glibc keep freed arrays for the next step instead of returning their pages to the system.

    Its thresholds follow the largest block freed so far; below them a step of 1 024 copies spends more time on page
    faults than on arithmetic. The block is never touched, so it costs nothing; other allocators ignore it.
    """
    np.empty(30 * 2**20, dtype=np.uint8)
