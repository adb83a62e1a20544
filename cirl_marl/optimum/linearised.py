"""An episode of the simulator to first order: the linear program of small changes of its actions.

Every interval is linear to first order around an episode, δx' = J_x δx + J_a δa, and so are mean flows. The Jacobians
are difference quotients of the simulator, so that cuts of flows and supplies that make up for services are in them.
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from scipy import sparse

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.supply import Supply
from cirl_marl.environments.actuators import Actuators
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.program import LinearProgram
from cirl_marl.optimum.window_planner import WindowSimulator, service_measures

DIFFERENCE = 1e-6
"""Step of the difference quotients, relative to the scale of a stock or to half the range of a control."""
MOST_SLOPES = 50_000_000
"""Entries of the largest Jacobians of all intervals that are written, 0.4 GB."""


def slopes_of(bound: Bound, dynamics: Dynamics) -> int:
    """Return how many entries the Jacobians of an episode have."""
    steps, entries = bound.actions.shape
    stocks = dynamics.rows.nodes.stop
    return int(steps * (stocks + entries) * (stocks + len(bound.network.arcs)))


def jacobians(bound: Bound, dynamics: Dynamics) -> tuple[Floats, Floats, Floats]:
    """Return ∂(x', f̄)/∂x and ∂(x', f̄)/∂a of every interval, and what each ends with, around the bound's actions.

    Shapes are (steps, stocks + arcs, stocks), (steps, stocks + arcs, entries) and (steps, stocks); stocks are those of
    the simulator, by stage where there is a lifetime.
    """
    network = bound.network
    steps, entries = bound.actions.shape
    rows, nodes = dynamics.rows, dynamics.rows.nodes.stop
    stock = WindowSimulator(bound.network, bound.agents).run(bound.initial, bound.actions)[0]
    inputs = np.concatenate([stock[:-1], bound.actions], axis=1)
    scale = np.array([node.scale for node in dynamics.staged_network.stores])
    width = np.concatenate([np.maximum(stock.max(axis=0), scale), np.ones(entries)]) * DIFFERENCE
    # forward in stocks, which may be 0; inward in actions, which may be at a bound
    # one batch simulates all difference quotients of all intervals: column (t, j) has input j of interval t shifted
    shift = np.where(np.arange(nodes + entries) < nodes, 1.0, -np.where(inputs >= 0, 1.0, -1.0)) * width
    columns = np.repeat(inputs[:, :, None], nodes + entries + 1, axis=2)
    columns[:, np.arange(nodes + entries), np.arange(nodes + entries)] += shift
    flat = np.ascontiguousarray(columns.transpose(1, 0, 2).reshape(nodes + entries, -1))
    actuators = Actuators(bound.network, bound.agents or None, flat.shape[1])
    interval = np.repeat(np.arange(steps), nodes + entries + 1)
    inner = np.empty((0, flat.shape[1]))
    stocks, supply = dynamics.extend(flat[:nodes]), Supply(dynamics)
    _, done = supply.advance(
        stocks, inner, actuators.controls(flat[nodes:], interval), interval, supply.idle(actuators.agents)
    )
    outputs = np.concatenate([done.stock[rows.nodes], done.moved_mass / network.episode.control_interval])
    by_interval = outputs.reshape(len(outputs), steps, -1).transpose(1, 0, 2)
    slopes = (by_interval[:, :, :-1] - by_interval[:, :, -1:]) / shift[:, None]
    return slopes[:, :, :nodes], slopes[:, :, nodes:], stock[1:]


@positional_record
class StepProgram:
    """The program of the best step: δx', δf̄, δa, levels, imbalance of each interval; then what each service lacks."""

    problem: Annotated[LinearProgram, "the program"]
    scale: Annotated[Floats, "measure of each variable, shape (variables,)"]
    origin: Annotated[Floats, "its variables if nothing changes, likewise"]
    action: Annotated[Integers, "columns of δa, shape (steps, entries)"]
    level: Annotated[Integers, "columns of the levels, shape (steps, services)"]
    lack: Annotated[Integers, "columns of what services lack, shape (services,)"]


def step_program(
    bound: Bound,
    dynamics: Dynamics,
    run: Rollout,
    demand: Floats,
    price: Floats,
    trust: float,
    slopes: tuple[Floats, Floats, Floats],
    margin: Floats | float = 0.0,
) -> StepProgram:
    """Return the program of the best change of the actions within a trust region, to first order.

    Args:
        bound: whose objective counts, with the actions of the episode.
        dynamics: of its network.
        run: the episode.
        demand: mean level demanded of each service, shape (services,).
        price: of what each lacks, likewise.
        trust: half-width of the region, in normalised actions.
        slopes: ``jacobians`` of the episode.
        margin: by how much more of a service than its band begins with counts as all of it, relative to that, shape
            (services, steps).
    """
    network = bound.network
    steps, entries = bound.actions.shape
    by_stock, by_action, stocks = slopes
    nodes, arcs, services = stocks.shape[1], len(network.arcs), len(network.services)
    outputs = nodes + arcs
    size = outputs + entries + services + 1
    level, imbalance = outputs + entries, size - 1
    # δ(x', f̄)_t − J_x δx'_{t−1} − J_a δa_t = 0, block row t of the equations
    now, before = sparse.identity(steps), sparse.eye_array(steps, k=-1)
    select_out, select_in = sparse.eye_array(outputs, size), sparse.eye_array(entries, size, k=outputs)
    carry = sparse.csr_array(_diagonal(-by_stock, (outputs, nodes)))
    carry_over = carry @ sparse.kron(before, sparse.eye_array(nodes, size))
    effect = sparse.csr_array(_diagonal(by_action, (outputs, entries))) @ sparse.kron(now, select_in)
    linear = sparse.kron(now, select_out) - effect
    measure, imbalances = _measures(bound, dynamics)
    state = np.concatenate([stocks, run.flow], axis=1)
    low = np.array([network.interval_means(service.low) for service in network.services]).reshape(services, steps)
    low *= 1.0 + margin
    # low·level − δq ≤ q, and ±(φ + δφ) ≤ imbalance, with q and φ those of the simulated episode
    rows = np.zeros((steps, services + 2, size))
    rows[:, :services, :outputs] = -measure
    rows[:, np.arange(services), level + np.arange(services)] = low.T
    rows[:, services:, :outputs], rows[:, services:, imbalance] = np.stack([imbalances, -imbalances]), -1.0
    limits = np.concatenate([state @ measure.T, -(state @ imbalances)[:, None] * [1.0, -1.0]], axis=1)
    # mean level + lack ≥ demanded level
    means = sparse.kron(np.full((1, steps), -1.0 / steps), sparse.eye_array(services, size, k=level))
    per_interval = _diagonal(rows, rows.shape[1:])
    under = sparse.block_array([[per_interval, None], [means, -sparse.eye_array(services)]], format="csr")
    bounds = np.tile(np.array([-np.inf, np.inf]), (steps, size, 1))
    bounds[:, :nodes, 0] = -stocks
    bounds[:, outputs:level] = np.stack(
        [np.maximum(-trust, -1 - bound.actions), np.minimum(trust, 1 - bound.actions)], axis=2
    )
    bounds[:, level:imbalance] = [0.0, 1.0]
    bounds[:, imbalance, 0] = 0.0
    low, high = np.concatenate([bounds.reshape(-1, 2), np.tile([0.0, np.inf], (services, 1))]).T
    problem = LinearProgram(
        cost=np.append(np.tile(_cost(bound, size, level, nodes), steps), price),
        equal=sparse.hstack([linear + carry_over, sparse.csr_array((steps * outputs, services))], format="csr"),
        equal_to=np.zeros(steps * outputs),
        under=under,
        under_to=np.append(limits.ravel(), -demand),
        low=low,
        high=high,
    )
    # states and flows change by shares of their largest values, the others by shares of 1
    parts = (*dynamics.staged_network.stores, *network.arcs)
    largest = np.maximum(np.abs(state).max(axis=0), [part.scale for part in parts])
    net = max(float(np.abs(state @ imbalances).max()), network.objective.circularity_scale)
    sizes = np.concatenate([largest, np.ones(entries + services), [net]])
    levels, net_flow = run.levels[0].T, np.abs(state @ imbalances)[:, None]
    origin = np.concatenate([np.zeros((steps, level)), levels, net_flow], axis=1)
    return StepProgram(
        problem,
        np.append(np.tile(sizes, steps), np.ones(services)),
        np.append(origin, np.maximum(demand - levels.mean(axis=0), 0.0)),
        size * np.arange(steps)[:, None] + np.arange(outputs, level),
        size * np.arange(steps)[:, None] + np.arange(level, imbalance),
        size * steps + np.arange(services),
    )


def _diagonal(blocks: Floats, shape: tuple[int, int]) -> Any:
    return sparse.block_diag([block.reshape(shape) for block in blocks], format="csr")


def _measures(bound: Bound, dynamics: Dynamics) -> tuple[Floats, Floats]:
    """Return what each service reads off (x', f̄), shape (services, stocks + arcs), and Δ·σ_env padded with zeros."""
    imbalances = np.concatenate([np.zeros(dynamics.rows.nodes.stop), -bound.network.circularity_weights[1]])
    return service_measures(bound.network, dynamics), imbalances


def _cost(bound: Bound, size: int, level: int, nodes: int) -> Floats:
    """Return the cost of the variables of one interval: minus the share in λ̄, or in the weighted objective."""
    network, steps = bound.network, len(bound.actions)
    services = len(network.services)
    cost = np.zeros(size)
    weights = network.circularity_weights.sum(axis=0)
    if network.objective.net_zero == "abs":
        weights = network.circularity_weights[0]
        cost[-1] = 1.0 / steps
    cost[nodes : nodes + len(weights)] = -weights / steps
    if bound.service_weight is not None:
        cost /= network.objective.circularity_scale
        cost[level : level + services] = -bound.service_weight / (steps * max(services, 1))
    return cost
