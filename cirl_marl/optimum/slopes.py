"""How what intervals of an episode end with changes with their stocks and actions, to first order.

Every interval is linear to first order around an episode, δx' = J_x δx + J_a δa, and so are mean flows. The Jacobians
are difference quotients of the simulator, or by stocks products of the matrices of its substeps (``IntervalMaps``), so
that cuts of flows and supplies that make up for services are in them.
Beside budgets such supplies are held in these, and change as actions do (``step_supplies``).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Protocol

import numpy as np

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.interval_maps import FollowingSupplies, IntervalMaps, has_interval_maps
from cirl_marl.dynamics.supply import Supply
from cirl_marl.environments.actuators import Actuators
from cirl_marl.network import Floats, Integers
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.aims import Aims
from cirl_marl.optimum.planned_episodes import HasPlan
from cirl_marl.optimum.step_supplies import IdleSupplies
from cirl_marl.optimum.window_simulator import WindowSimulator

DIFFERENCE = 1e-6
"""Step of the difference quotients, relative to the scale of a stock or to half the range of a control."""
TINY = 1e-12
"""Least range of a control or supply that measures a change of it."""
MOST_SLOPES = 50_000_000
"""Entries of the largest Jacobians of all intervals that are written, 0.4 GB."""


def slopes_of(shape: tuple[int, ...], dynamics: Dynamics) -> int:
    """Return how many entries the Jacobians of actions of a shape, (steps, entries), have."""
    (steps, entries), stocks = shape, dynamics.rows.nodes.stop
    return int(steps * (stocks + entries) * (stocks + len(dynamics.network.arcs)))


class ActionPlan(HasPlan, Protocol):
    """What has actions, of some intervals of an episode: a bound, or the plan of a window."""

    @property
    def aims(self) -> Aims:
        """What is weighed, and budgets of accounts."""

    @property
    def service_weight(self) -> float | None:
        """W of λ̄/scale + w·service; None if the objective is λ̄."""


@positional_record
class Slopes:
    """∂(x', f̄)/∂x and ∂(x', f̄)/∂(a, U) of the intervals of an episode, and what each ends with.

    Stocks are those of the simulator, by stage where there is a lifetime. Rows are stocks x', mean flows f̄ and those of
    each substance.
    """

    by_stock: Annotated[Floats, "shape (steps, rows, stocks)"]
    by_action: Annotated[Floats, "shape (steps, rows, entries + supplies)"]
    end: Annotated[Floats, "shape (steps, rows)"]
    supplies: Annotated[IdleSupplies, "U of each interval"]

    def responses(self) -> Iterator[Floats]:
        """Give δ(x', f̄) of each interval for a unit of every action and supply so far, shape (rows, (t + 1)·moves)."""
        nodes = self.by_stock.shape[2]
        stock = np.empty((nodes, 0))
        for to_stock, to_action in zip(self.by_stock, self.by_action, strict=True):
            response = np.concatenate([to_stock @ stock, to_action], axis=1)
            yield response
            stock = response[:nodes]


def jacobians(plan: ActionPlan, dynamics: Dynamics, first: int = 0, *, is_wide: bool = False) -> Slopes:
    """Return the slopes of every interval from the first, around a plan.

    If ``is_wide``, those by actions are quotients over all of a range, each to its farther end: of a little more that
    comes to an empty stock a schedule takes nearly all.
    """
    steps = len(plan.actions)
    stock = WindowSimulator(dynamics, plan.agents).run(plan.initial, plan.actions, first)[0]
    actuators, interval = Actuators(plan.network, plan.agents or None, steps), np.arange(first, first + steps)
    controls = actuators.controls(np.ascontiguousarray(plan.actions.T), interval)
    masses, inner, supply = dynamics.extend(stock[:-1].T), np.empty((0, steps)), Supply(dynamics)
    idle, is_held = supply.idle(actuators.agents), bool(plan.aims.budgets)
    supplies = IdleSupplies.of(dynamics, supply, idle & is_held, masses, controls, first)
    follows = idle & (not is_held)
    if not has_interval_maps(dynamics):
        return _quotients(plan, dynamics, stock, supplies, follows, interval, is_wide=is_wide)
    controls = supply(masses, inner, controls, interval, follows)
    by_stock, by_schedule = IntervalMaps(dynamics).responses(masses, dynamics.rate(controls, interval))
    idle_rows = supply.rows[follows.ravel()]
    idle_controls = idle_rows, controls[idle_rows]
    slopes = _quotients(
        plan, dynamics, stock, supplies, np.zeros_like(follows), interval, idle_controls, is_wide=is_wide
    )
    following_supplies = FollowingSupplies(supply, follows, interval, controls, by_schedule)
    return replace(
        slopes, by_stock=following_supplies.after(by_stock), by_action=following_supplies.after(slopes.by_action)
    )


def _quotients(
    plan: ActionPlan,
    dynamics: Dynamics,
    stock: Floats,
    supplies: IdleSupplies,
    follows: Bools,
    interval: Integers,
    fixed_controls: tuple[Integers, Floats] | None = None,
    *,
    is_wide: bool,
) -> Slopes:
    """Return the slopes as difference quotients; by actions alone where rows and values of some controls are given."""
    network, nodes, (steps, entries) = plan.network, dynamics.rows.nodes.stop, plan.actions.shape
    inputs, brought = np.concatenate([stock[:-1], plan.actions], axis=1), len(supplies.services)
    shifted_rows = np.arange(nodes if fixed_controls else 0, nodes + entries)
    count = len(shifted_rows) + brought
    scale = np.array([node.scale for node in dynamics.staged_network.stores])
    width = np.concatenate([np.maximum(stock.max(axis=0), scale), np.ones(entries)]) * DIFFERENCE
    # forward in stocks, which may be 0; inward in actions, which may be at a bound, and in what is brought
    # one batch simulates all difference quotients of all intervals: column (t, j) has input j of interval t shifted
    shift = np.where(np.arange(nodes + entries) < nodes, 1.0, -np.where(inputs >= 0, 1.0, -1.0)) * width
    if is_wide:
        shift[:, nodes:] = -np.where(plan.actions >= 0, 1.0, -1.0) - plan.actions
    shift = shift[:, shifted_rows]
    inward = np.where(supplies.high > -supplies.low, 1.0, -1.0) * DIFFERENCE * np.maximum(supplies.size, TINY)
    columns = np.repeat(inputs[:, :, None], count + 1, axis=2)
    columns[:, shifted_rows, np.arange(len(shifted_rows))] += shift
    flat = np.ascontiguousarray(columns.transpose(1, 0, 2).reshape(nodes + entries, -1))
    interval = np.repeat(interval, count + 1)
    controls = Actuators(network, plan.agents or None, flat.shape[1]).controls(flat[nodes:], interval)
    columns = np.repeat(supplies.controls[:, :, None], count + 1, axis=2)
    columns[:, :, len(shifted_rows) : count] += (supplies.unit * inward.T[:, None]).transpose(1, 2, 0)
    controls[supplies.rows] = columns.reshape(len(columns), flat.shape[1])
    if fixed_controls is not None:
        controls[fixed_controls[0]] = np.repeat(fixed_controls[1], count + 1, axis=1)
    stocks, inner = dynamics.extend(flat[:nodes]), np.empty((0, flat.shape[1]))
    _, done = Supply(dynamics).advance(stocks, inner, controls, interval, follows)
    flows = np.concatenate([done.moved_mass, done.moved_substances]) / network.episode.control_interval
    outputs = np.concatenate([done.stock[dynamics.rows.nodes], flows])
    by_interval = outputs.reshape(len(outputs), steps, -1).transpose(1, 0, 2)
    slopes = (by_interval[:, :, :-1] - by_interval[:, :, -1:]) / np.concatenate([shift, inward], axis=1)[:, None]
    end, stocks_shifted = np.ascontiguousarray(by_interval[:, :, -1]), len(shifted_rows) - entries
    return Slopes(slopes[:, :, :stocks_shifted], slopes[:, :, stocks_shifted:], end, supplies)
