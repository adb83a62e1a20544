"""Exact derivatives of episodes: by actions, by what they start from, and by what disturbs them."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.dynamics.adjoint import Adjoint, IntervalInputs
from cirl_marl.dynamics.supply_adjoint import SupplyAdjoint
from cirl_marl.environments.state import Interval
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import ControlError, instance_of
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record


@positional_record
class Outputs:
    """What an interval ended with, or derivatives by it."""

    stock: Annotated[Floats, "masses, shape (masses, B)"]
    circularity: Annotated[Floats, "mean of λ over the interval, shape (B,)"]
    levels: Annotated[Floats, "service levels, shape (services, B)"]
    observation: Annotated[
        Floats | None, "stacked observation in double precision, shape (entries of all agents, B); None: nobody looks"
    ] = None
    accounts: Annotated[Floats | None, "discounted amounts on accounts, shape (accounts, B); None: nobody counts"] = (
        None
    )


@positional_record
class Gradient:
    """What open-loop actions do, and the derivatives of c·λ̄ + Σ_s w_s·l_s + Σ_a v_a·A_a, in each copy."""

    circularity: Annotated[Floats, "λ̄, mean of λ over the intervals, shape (B,), mass"]
    levels: Annotated[Floats, "l, mean level of each service, shape (services, B)"]
    accounts: Annotated[Floats, "A, discounted total on each account, shape (accounts, B)"]
    actions: Annotated[Floats, "by the actions, shape (intervals, entries, B)"]
    start: Annotated[Floats, "by the stocks at the start, those with a lifetime by stage, shape (stocks, B), 1/mass"]
    disturbances: Annotated[Floats, "by the values of the disturbances, shape (intervals, names, B)"]
    draws: Annotated[Floats, "by the factors on uncertain numbers, shape (numbers, B)"]


class Derivatives:
    """Intervals of a batched environment, forwards and backwards.

    Derivatives by disturbances are those by the values ξ; forecasts, which follow from the states behind them, stay.
    """

    def __init__(self, env: MultiAgentVectorEnv) -> None:
        """Compile the adjoint of ``env``; a ``CirlError`` says what of it has no derivative."""
        self.env = instance_of(MultiAgentVectorEnv, "env", env)
        self._adjoint = Adjoint(env.dynamics)
        self._supply = SupplyAdjoint(env.supply, self._adjoint)
        self._table = env.layout.double_table()

    def advance(self, actions: Floats) -> tuple[Interval, Outputs]:
        """Hold stacked actions, shape (entries, B), for an interval, as ``MultiAgentVectorEnv.advance`` does."""
        env, outcome = self.env, self.env.advance(actions)
        bookings = env.interval.after.accounts - env.interval.before.accounts
        seen = self.observation()
        return env.interval, Outputs(env.physical.stock, outcome.circularity_mean, outcome.levels, seen, bookings)

    def observation(self) -> Floats:
        """Return the present stacked observation in double precision, shape (entries of all agents, B)."""
        return self.env.stacked_observation(self._table)

    def pull_back(self, interval: Interval, adjoint: Outputs, path_adjoint: Floats) -> tuple[Floats, Floats, Floats]:
        """Return derivatives by masses at the start, actions and draws, given those by what an interval ended with.

        Those by the values of the disturbances are added to ``path_adjoint``, shape (intervals, names, B).
        """
        env, before, after = self.env, interval.before, interval.after
        network, signals, step = env.network, env.layout.signals, before.step
        factors = env.dynamics.factors(before.factors, before.disturbances, step)
        factor_adjoint = None if factors is None else np.zeros_like(factors)
        levels, by_seen, quantities = adjoint.levels, None, env.quantities(after)
        if adjoint.observation is not None:
            by_seen, by_level, by_sight = env.layout.pull_back(quantities, adjoint.observation)
            levels = levels + by_level
            if env.layout.sights:
                env.layout.sights.pull_back(after.step, by_sight, path_adjoint)
        by_quantity = env.scoring.pull_back(quantities, step, factors, levels, factor_adjoint)
        if by_seen is not None:
            by_quantity += by_seen
        by_flow = by_quantity[signals.flows] + network.circularity_adjoint(after.flow) * adjoint.circularity
        by_flow += network.throughput_adjoint(by_quantity[signals.throughputs])
        by_stock, by_start, by_control = by_quantity[signals.stocks], None, None
        if adjoint.accounts is not None and env.ledger.accounts:
            held = (env.rows.stocks(before.stock) + env.rows.stocks(after.stock)) / 2
            deviation = None
            if env.ledger.has_efforts:
                controls = env.actuators.controls(interval.actions, step, factors)
                deviation = env.actuators.deviation(controls, step, factors)
            bookings = env.ledger.pull_back(
                adjoint.accounts, after.flow, held, deviation, step, factors, factor_adjoint
            )
            by_flow += bookings[0]
            by_start, by_control = bookings[1] / 2, bookings[2]
            by_stock = by_stock + by_start
        by_substance, by_its_flow = env.substance_masses.pull_back(by_quantity[signals.substances])
        stock = adjoint.stock + env.rows.masses_adjoint(by_stock, by_substance)
        inputs = IntervalInputs(before.stock, interval.controls, factors)
        length = network.episode.control_interval
        result = self._supply.pull_back(inputs, step, env.idle, stock, by_flow / length, by_its_flow / length)
        controls_adjoint = result.controls if by_control is None else result.controls + by_control
        actions, ends = env.actuators.pull_back(interval.actions, step, factors, controls_adjoint)
        if by_control is not None:
            ends[1] -= by_control  # the distance is from the neutral value
        draws = np.zeros_like(before.factors)
        if factors is not None and factor_adjoint is not None and result.factors is not None:
            factor_adjoint += result.factors
            self._adjoint.rates.pull_back_bounds(step, factors, ends, factor_adjoint)
            draws = env.dynamics.factors.pull_back(
                before.factors, before.disturbances, step, factor_adjoint, path_adjoint
            )
        start = result.stock if by_start is None else result.stock + env.rows.masses_adjoint(by_start)
        return start, actions, draws

    def open_loop(
        self, actions: Floats, circularity: ArrayLike = 1.0, levels: ArrayLike = 0.0, accounts: ArrayLike = 0.0
    ) -> Gradient:
        """Return ``gradient`` of actions that have its shape."""
        env, (steps, _, batch) = self.env, actions.shape
        state, controls, services = env.physical, env.controls, len(env.network.services)
        by_circularity = _weights("circularity", circularity, (batch,)) / steps
        by_level = _weights("levels", levels, (services, batch)) / steps
        by_account = _weights("accounts", accounts, (len(env.ledger.accounts), batch))
        try:
            tape = [(env.advance(action), env.interval) for action in actions]
        finally:
            env.go_back(state, controls)
        stock, draws = np.zeros_like(state.stock), np.zeros_like(state.factors)
        paths, by_action = np.zeros_like(state.disturbances), np.empty(actions.shape)
        for t in reversed(range(steps)):
            outputs = Outputs(stock, by_circularity, by_level, accounts=by_account)
            stock, by_action[t], drawn = self.pull_back(tape[t][1], outputs, paths)
            draws += drawn
        mean_circularity = np.mean([outcome.circularity_mean for outcome, _ in tape], axis=0)
        mean_levels = np.mean([outcome.levels for outcome, _ in tape], axis=0)
        totals = tape[-1][1].after.accounts - state.accounts
        return Gradient(mean_circularity, mean_levels, totals, by_action, stock[env.rows.nodes], paths, draws)


def _weights(name: str, weights: ArrayLike, shape: tuple[int, ...]) -> Floats:
    """Return weights, a number, one for each row or of this shape, in it.

    Raises:
        ControlError: for others, and for what is not finite.
    """
    try:
        array = np.asarray(weights, dtype=float)
    except (TypeError, ValueError):
        raise ControlError(f"{name} {weights!r} are no numbers") from None
    if array.shape not in ((), shape[:1], shape):
        expectation = " or ".join(map(str, dict.fromkeys((shape[:1], shape))))
        raise ControlError(f"{name} have shape {array.shape}, expected a number, or {expectation}")
    if not np.isfinite(array).all():
        raise ControlError(f"{name} {array.tolist()} are not finite")
    return np.broadcast_to(array[:, None] if array.shape != shape and array.ndim else array, shape)


def gradient(
    env: MultiAgentVectorEnv,
    actions: ArrayLike,
    *,
    circularity: ArrayLike = 1.0,
    levels: ArrayLike = 0.0,
    accounts: ArrayLike = 0.0,
) -> Gradient:
    """Return what open-loop actions do from here, and exact derivatives of c·λ̄ + Σ_s w_s·l_s + Σ_a v_a·A_a.

    λ̄ and l_s are means over the intervals, A_a totals on accounts; every copy is by itself. The environment stays where
    it is. Derivatives are those of the simulator: cuts of flows, clips and supplies that make up for services are in
    them. At a kink they are one-sided: of a flow as if it were not cut, of a level as within its band, of an action
    from within its bounds.

    Args:
        env: after ``reset``.
        actions: stacked actions, shape (intervals, entries, num_envs), or without the last axis.
        circularity: c, a number or shape (num_envs,).
        levels: w, a number, shape (services,) or (services, num_envs).
        accounts: v, likewise, of accounts.

    Raises:
        CirlError: for what has no derivative: compartments with models, batches, other solvers than ``exact``, and
            stocks that recipients empty; names the network, the compartment and the reason.
        ControlError: for actions of another shape or out of bounds, and for weights of another shape or not finite.
    """
    return Derivatives(env).open_loop(stacked_schedule(env, actions), circularity, levels, accounts)


def stacked_schedule(env: MultiAgentVectorEnv, actions: ArrayLike) -> Floats:
    """Return actions of several intervals, shape (intervals, entries, B), from those or from (intervals, entries).

    Raises:
        ControlError: for another shape, or for more intervals than are left of the episode.
    """
    schedule = np.asarray(actions, dtype=np.float64)
    entries, left = len(env.actuators.control_rows), env.network.episode.horizon - int(env.physical.step.max())
    if schedule.ndim == 2:
        schedule = np.repeat(schedule[..., None], env.num_envs, axis=2)
    if schedule.ndim != 3 or schedule.shape[1:] != (entries, env.num_envs) or not 1 <= len(schedule) <= left:
        expectation = f"(intervals, {entries}) or (intervals, {entries}, {env.num_envs}) with 1 to {left} intervals"
        raise ControlError(f"actions have shape {np.shape(actions)}, expected {expectation}")
    return schedule
