"""Rollouts of controllers and the figures that compare them: λ̄, circularity gain, service level, local returns."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Annotated

import numpy as np

from cirl_marl.controllers.basic import Arrays, Controller, Planner
from cirl_marl.dynamics.laws import LAWS
from cirl_marl.environments.starts import Starts
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import ControlError, instance_of, whole_number
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record

EVALUATION_SEEDS = 2**31
"""First seed of evaluations; training draws its seeds below it, so no evaluated episode was trained on."""

ROUNDING = 1e-9
"""Share of a scheduled flow by which what is realised may differ from it without being less."""

CONTROLLER_STREAM = 2
"""Which child of a seed's sequence controllers of disturbed networks draw from; see ``processes.STREAM``."""

SEED_SPACING = 1_000_000
"""Distance between the first seeds of two evaluations with different ``seed``, so that they share no episode."""


@positional_record
class EpisodeStart:
    """Where a single episode begins."""

    seed: Annotated[int, "seed of what is drawn"]
    initial_state: Annotated[Mapping[str, float], "stocks and inner states that are not drawn"]
    description: Annotated[str, "both in words"]

    def reset(self, env: MultiAgentVectorEnv) -> Arrays:
        """Begin an episode in ``env`` here, and return the observations."""
        return env.reset(seed=self.seed, options={"initial_state": self.initial_state})

    def play(
        self, env: MultiAgentVectorEnv, controller: Controller, progress: Callable[[float], None] = lambda share: None
    ) -> Rollout:
        """Run the episode in ``env``, a single copy."""
        return rollout(env, controller, seed=self.seed, start=self.initial_state, progress=progress)


@positional_record
class Rollout:
    """One episode of each of B copies under one controller."""

    circularity: Annotated[Floats, "λ at the end of each interval, shape (B, steps), mass"]
    circularity_mean: Annotated[Floats, "mean of λ over each interval, shape (B, steps), mass"]
    service: Annotated[Floats, "mean level of the services, shape (B, steps)"]
    levels: Annotated[Floats, "level of each service, shape (B, services, steps)"]
    entries: Annotated[Floats, "amount of each entry of the ledger, not discounted, first copy, (steps, entries)"]
    bookings: Annotated[Floats, "amount on each account, not discounted, shape (B, accounts, steps)"]
    accounts: Annotated[Floats, "amount on each account in all, discounted, shape (B, accounts)"]
    local_returns: Annotated[Floats, "sum of the local rewards of each agent, shape (agents, B)"]
    returns: Annotated[Floats, "sum of the rewards of each agent, shape (agents, B)"]
    stock: Annotated[Floats, "stocks after each interval in the first copy, shape (steps, stores), mass"]
    flow: Annotated[Floats, "mean flows of each interval in the first copy, shape (steps, arcs), mass/time"]
    load: Annotated[Floats, "masses that batch arcs hold, likewise, shape (steps, batch arcs), mass"]
    inner: Annotated[Floats, "inner states that an agent may see, likewise, shape (steps, states)"]
    controls: Annotated[Floats, "values of all controls, in the rows of ``network.control_rows``, (steps, controls)"]
    shortage: Annotated[Floats, "what scheduled flows lacked, mean over copies, shape (steps, scheduled arcs), mass"]
    contents: Annotated[Floats, "of each substance in nodes and flows, first copy, (steps, substances, compartments)"]
    final_stock: Annotated[Floats, "mean over copies of the last stocks, shape (stores,), mass"]
    mean_flow: Annotated[Floats, "mean over copies and time of the flows, shape (arcs,), mass/time"]
    disturbances: Annotated[Floats, "their values in each interval, shape (B, steps, names)"]
    start: Annotated[Floats, "stocks at the start in the first copy, shape (stores,), mass"]
    start_load: Annotated[Floats, "masses that batch arcs hold then, shape (batch arcs,), mass"]
    start_inner: Annotated[Floats, "inner states that an agent may see then, shape (states,)"]
    control_seconds: Annotated[float, "processor time that the controller took in all, its plans included"]

    @property
    def episode_circularity(self) -> Floats:
        """λ̄ of each episode, shape (B,), mass."""
        return np.asarray(self.circularity_mean.mean(axis=1))

    @property
    def episode_service(self) -> Floats:
        """Mean of the services' levels in each episode, shape (B,)."""
        return np.asarray(self.service.mean(axis=1))

    @property
    def episode_levels(self) -> Floats:
        """Mean level of each service in each episode, shape (B, services)."""
        return np.asarray(self.levels.mean(axis=2))

    @property
    def least_service(self) -> Floats:
        """Mean level of the service that lacks most in each episode, shape (B,); 1 without services."""
        return np.asarray(self.episode_levels.min(axis=1, initial=1.0))


class PresentEnv(MultiAgentVectorEnv):
    """A copy of an environment that knows what disturbances were and are, not what they will be.

    Its random streams are others, so that nobody sees the future by going ahead in it, or by starting it again.
    """

    def __init__(self, env: MultiAgentVectorEnv) -> None:
        """Copy an environment that was reset."""
        self.__dict__.update(env.__dict__)
        self._starts = Starts(self.network, self.dynamics, self.num_envs, self.layout.array_order)
        self.follow(env)

    def follow(self, env: MultiAgentVectorEnv) -> None:
        """Go to where the environment is by now."""
        self._state, self.episodes, self.controls = env.physical.without_future(), env.episodes, env.controls


def rollout(
    env: MultiAgentVectorEnv,
    controller: Controller,
    *,
    seed: int = EVALUATION_SEEDS,
    start: Mapping[str, float] | None = None,
    progress: Callable[[float], None] = lambda share: None,
    watch: Callable[[int], None] = lambda intervals: None,
) -> Rollout:
    """Run one whole episode in every copy of ``env``, of which copy i is reset with ``seed + i``.

    The same seed gives every controller the same start states; what stands in ``start`` is not drawn (see
    ``MultiAgentVectorEnv.reset``). Of a disturbed network the controller gets the environment at present, and a seed of
    its own (``PresentEnv``): what is to come is nowhere to be seen. ``progress`` is called with the share of the work
    that is done, plans that a controller makes beforehand included, and ``watch`` with the number of intervals done.

    >>> from cirl_marl.controllers import Neutral
    >>> shares = []
    >>> _ = rollout(MultiAgentVectorEnv("net_zero", num_envs=1, horizon=2), Neutral(), progress=shares.append)
    >>> shares
    [0.5, 1.0]

    Raises:
        ControlError: if ``env`` or ``controller`` is something else, such as a PettingZoo view or a name.
    """
    if not isinstance(env, MultiAgentVectorEnv):
        raise ControlError(f"rollout takes what vector_env(network, num_envs=…) returns, not {type(env).__name__}")
    if not isinstance(controller, Controller):
        raise ControlError(f"rollout takes a controller, such as Neutral() or Trained(run), not {controller!r}")
    observations = env.reset(seed=seed, options={"initial_state": start or {}})
    steps, rows, batches, physics = env.network.episode.horizon, env.rows, env.dynamics.batches, env.dynamics.inner
    before = env.physical
    stocks, loads = (masses(before.stock)[:, 0].copy() for masses in (rows.stocks, batches.loads))
    origin = (stocks, loads, before.inner[physics.visible, 0].copy())
    ahead = controller.ahead if isinstance(controller, Planner) else 0.0
    present = PresentEnv(env) if env.network.disturbed else None
    clock = time.process_time()
    actor_env = env if present is None else present
    if present is not None:  # from its seeds the future could be drawn
        seed = int(np.random.SeedSequence(seed, spawn_key=(CONTROLLER_STREAM,)).generate_state(1)[0])
    if isinstance(controller, Planner):
        controller.plan(actor_env, seed, lambda share: progress(ahead * share))
    else:
        controller.start(actor_env, seed)
    seconds = time.process_time() - clock
    circularity, mean, service = np.empty((3, env.num_envs, steps))
    levels = np.empty((env.num_envs, len(env.network.services), steps))
    entries = np.empty((steps, len(env.ledger.compartments)))
    bookings = np.empty((env.num_envs, len(env.network.accounts), steps))
    local, returns = np.zeros((2, len(env.agents), env.num_envs))
    stock, flow = np.empty((steps, len(env.network.stores))), np.empty((steps, len(env.network.arcs)))
    load, inner = np.empty((steps, len(batches.lines))), np.empty((steps, len(physics.visible)))
    total_flow, places = np.zeros(len(env.network.arcs)), len(env.network.compartments)
    contents = np.zeros((steps, len(env.network.substances), places))
    orders = np.flatnonzero([LAWS[arc.law].is_scheduled for arc in env.network.arcs])
    controls = np.empty((steps, len(env.dynamics.neutral)))
    shortage = np.zeros((steps, len(orders)))
    for t in range(steps):
        clock = time.process_time()
        if present is not None:
            present.follow(env)
        actions = controller.act(observations)
        seconds += time.process_time() - clock
        outcome = env.advance(env.stack(actions))
        controls[t] = env.controls[:, 0]
        if len(orders):
            step = np.full(env.num_envs, t)
            factors, begin = env.factors_in(step), env.interval.before.stock
            ordered_flow = env.dynamics.rate_within_capacities(begin, env.controls, step, factors)[orders]
            short = ordered_flow - outcome.flow[orders]
            shortage[t] = np.where(short > ROUNDING * np.abs(ordered_flow), short, 0.0).mean(axis=1)
        circularity[:, t], mean[:, t] = outcome.circularity, outcome.circularity_mean
        service[:, t], levels[:, :, t] = outcome.service_level, outcome.levels.T
        entries[t], bookings[:, :, t] = outcome.entries[:, 0], outcome.bookings.T
        local += outcome.local
        returns += outcome.reward
        stock[t], flow[t] = rows.stocks(env.physical.stock)[:, 0], outcome.flow[:, 0]
        load[t], inner[t] = batches.loads(env.physical.stock)[:, 0], env.physical.inner[physics.visible, 0]
        if contents.size:
            contents[t] = env.layout.contents(env.quantities(env.physical))[:, 0].reshape(-1, places)
        total_flow += outcome.flow.mean(axis=1)
        observations = env.by_agent(outcome.observation)
        watch(t + 1)
        progress(ahead + (1.0 - ahead) * (t + 1) / steps)
    shortage *= env.network.episode.control_interval
    final = rows.stocks(env.physical.stock).mean(axis=1)
    flows = total_flow / steps
    first_copy = (stock, flow, load, inner, controls)
    values = np.zeros((env.num_envs, steps, len(env.network.processes.names)))
    if values.size:
        values[...] = np.moveaxis(env.physical.disturbances[:-1], 2, 0)
    return Rollout(
        circularity,
        mean,
        service,
        levels,
        entries,
        bookings,
        env.physical.accounts.T,
        local,
        returns,
        *first_copy,
        shortage,
        contents,
        final,
        flows,
        values,
        *origin,
        seconds,
    )


def episode_start(env: MultiAgentVectorEnv, seed: int | None = None) -> EpisodeStart:
    """Return where the single episode begins that ``cirl show``, ``simulate`` and ``plan`` are about.

    That is the middle of all initial ranges, with inner states that models draw themselves as the first evaluation
    draws them; or, with a ``seed``, the first start of the evaluation of that seed.
    """
    if seed is not None:
        return EpisodeStart(first_seed(seed), {}, f"the first episode of evaluation {seed}")
    nodes = (node.id for node in env.network.stores)
    middle = dict(zip(nodes, env.network.initial.mean(axis=0).tolist(), strict=True))
    inner = env.dynamics.inner
    rows = zip(inner.range_rows.tolist(), inner.low.tolist(), inner.high.tolist(), strict=True)
    middle |= {inner.names[row]: (low + high) / 2 for row, low, high in rows}
    note = "" if len(inner.range_rows) == len(inner.names) else "; what models draw themselves as in evaluation 0"
    return EpisodeStart(first_seed(0), middle, f"the middle of all initial ranges{note}")


def starting_stocks(env: MultiAgentVectorEnv, seed: int) -> Floats:
    """Return the stocks in which the copies of ``env`` start, shape (copies, nodes), mass."""
    env.reset(seed=seed)
    return env.physical.stock[env.rows.nodes].T.copy()


def interval_ends(network: Network) -> Floats:
    """Return the time at which each control interval of an episode ends, shape (steps,)."""
    episode = instance_of(Network, "network", network).episode
    return np.multiply(np.arange(1, episode.horizon + 1), episode.control_interval, dtype=np.float64)


def first_seed(seed: int) -> int:
    """Return the seed of the first episode of the evaluation ``seed``."""
    return EVALUATION_SEEDS + SEED_SPACING * whole_number("seed", seed, 0)
