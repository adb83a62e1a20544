"""Better actions for a plan: sequential linear programs on the exact simulator.

The relaxed flows of a bound are not quite what constant controls can do. Around an episode of the simulator every
interval is linear to first order, δx' = J_x δx + J_a δa, and so are mean flows; the best step within a trust region is
a linear program. Steps are accepted by simulation alone, so the result is an episode that exists.

Of a large network those Jacobians, dense in its stocks and actions, would take gigabytes. ``refine`` solves the program
of the bound again instead, with controls held and what was lacking on top.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy import sparse

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.supply import Supply
from cirl_marl.environments.actuators import Actuators
from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible, normalised_actions
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.planned_episodes import simulate_plan
from cirl_marl.optimum.program import LinearProgram, Programs
from cirl_marl.optimum.solver import Infeasible, SolverFailure, best_values, solve

DIFFERENCE = 1e-6
"""Step of the difference quotients, relative to the scale of a stock or to half the range of a control."""
MOST_SLOPES = 50_000_000
"""Entries of the largest Jacobians of all intervals that are written, 0.4 GB."""
TRUST, SMALLEST = 0.25, 1e-5
"""First and smallest half-width of the trust region, in normalised actions."""
PENALTY = 3.0
"""What is charged for what a service lacks, times the price that the bound puts on it."""
REFINEMENT_ROUNDS = 2
"""Most programs that are solved."""
REFINEMENT_DEGREE = 1
"""Degree of these programs, whatever that of the bound: they are solved several times."""
TOLERATED_SHORTFALL = 1e-4
"""What a service may lack of its demand without a further round."""


def improve_plan(
    bound: Bound,
    *,
    rounds: int = 20,
    enough: Callable[[Rollout], bool] = lambda run: False,
    progress: Callable[[float], None] = lambda share: None,
) -> Bound:
    """Return ``bound`` with actions that do better in the simulator; the bound and its certificate stay.

    Plans are compared by the objective of the bound; what each service lacks of ``min_service`` is charged PENALTY
    times what the bound says it costs to provide. Local optimality is all that is sought; ``bound.gap`` says how much
    better any plan could be. Of a network so large that its Jacobians would have more than MOST_SLOPES entries the plan
    is made by ``refine``, whatever ``rounds`` is.

    Args:
        bound: with the actions to start from.
        rounds: most linear programs to solve.
        enough: asked of each episode that is better than those before, whether to stop there.
        progress: called with the share of them that is solved; 1 when no more are needed.
    """
    dynamics = Dynamics(bound.network)
    inputs = dynamics.rows.nodes.stop + bound.actions.shape[1]
    if bound.actions.shape[0] * inputs * (dynamics.rows.nodes.stop + len(bound.network.arcs)) > MOST_SLOPES:
        return refine(bound, enough=enough, progress=progress)
    price = prices(bound)
    best, run = bound, simulate_plan(bound)
    value, trust, slopes = penalised_objective(bound, run, price), TRUST, None
    for done in range(rounds):
        if trust < SMALLEST or enough(run):
            break
        slopes = _jacobians(best, dynamics) if slopes is None else slopes
        step = _step(best, dynamics, run, price, trust, slopes)
        progress((done + 1) / rounds)
        if step is None:  # a smaller region is another program
            trust /= 4
            continue
        candidate = replace(best, actions=np.clip(best.actions + step, -1.0, 1.0))
        trial = simulate_plan(candidate)
        gain = penalised_objective(bound, trial, price) - value
        if gain > 0:
            best, run, value, trust, slopes = candidate, trial, value + gain, min(1.0, 2 * trust), None
        else:
            trust /= 4
    progress(1.0)
    return best


def _jacobians(bound: Bound, dynamics: Dynamics) -> tuple[Floats, Floats, Floats]:
    """Return ∂(x', f̄)/∂x and ∂(x', f̄)/∂a of every interval, and what each ends with, around the bound's actions.

    Shapes are (steps, stocks + arcs, stocks), (steps, stocks + arcs, entries) and (steps, stocks); stocks are those of
    the simulator, by stage where there is a lifetime.
    """
    network = bound.network
    steps, entries = bound.actions.shape
    rows, nodes = dynamics.rows, dynamics.rows.nodes.stop
    stock = _path(bound, dynamics)
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


def _path(bound: Bound, dynamics: Dynamics) -> Floats:
    """Return the stocks at the start and after each interval under the bound's actions, shape (steps + 1, stocks)."""
    actuators, inner = Actuators(bound.network, bound.agents or None, 1), np.empty((0, 1))
    masses, supply = dynamics.extend(bound.initial[:, None]), Supply(dynamics)
    idle, stocks = supply.idle(actuators.agents), [bound.initial]
    for step, actions in enumerate(bound.actions):
        interval = np.array([step])
        controls = actuators.controls(actions[:, None], interval)
        masses = supply.advance(masses, inner, controls, interval, idle)[1].stock
        stocks.append(masses[dynamics.rows.nodes, 0])
    return np.array(stocks)


def _step(
    bound: Bound, dynamics: Dynamics, run: Rollout, price: Floats, trust: float, slopes: tuple[Floats, Floats, Floats]
) -> Floats | None:
    """Return the best change of the actions within the trust region to first order, shape (steps, entries).

    None if HiGHS finds none; ``slopes`` are the Jacobians around the episode and its stocks.

    Variables of an interval: δx', δf̄, δa, the levels, the imbalance; after the last, what each service lacks.
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
        under_to=np.append(limits.ravel(), -demand(bound)),
        low=low,
        high=high,
    )
    # states and flows change by shares of their largest values, the others by shares of 1
    parts = (*dynamics.staged_network.stores, *network.arcs)
    largest = np.maximum(np.abs(state).max(axis=0), [part.scale for part in parts])
    net = max(float(np.abs(state @ imbalances).max()), network.objective.circularity_scale)
    sizes = np.concatenate([largest, np.ones(entries + services), [net]])
    values = best_values(problem, np.append(np.tile(sizes, steps), np.ones(services)))
    return None if values is None else values[: steps * size].reshape(steps, size)[:, outputs:level]


def _diagonal(blocks: Floats, shape: tuple[int, int]) -> Any:
    return sparse.block_diag([block.reshape(shape) for block in blocks], format="csr")


def _measures(bound: Bound, dynamics: Dynamics) -> tuple[Floats, Floats]:
    """Return what each service reads off (x', f̄), shape (services, stocks + arcs), and Δ·σ_env padded with zeros."""
    network = bound.network
    nodes = dynamics.rows.nodes.stop
    measure = np.zeros((len(network.services), nodes + len(network.arcs)))
    for s, service in enumerate(network.services):
        if service.quantity == "stock":
            for place in (network.node_index[node] for node in service.providers):
                measure[s, dynamics.rows.stages.get(place, place)] = 1.0
        else:
            measure[s, nodes + network.service_arcs(service)] = 1.0
    return measure, np.concatenate([np.zeros(nodes), -network.circularity_weights[1]])


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


def prices(bound: Bound) -> Floats:
    """Return what is charged for a unit that each service lacks, which covers what the certificate asks for it.

    Shape (services,); 0 if nothing is demanded.
    """
    services = len(bound.network.services)
    if bound.min_service is None:
        return np.zeros(services)
    multipliers = -bound.certificate.under[len(bound.certificate.under) - services :]
    return PENALTY * np.maximum(multipliers, bound.network.objective.circularity_scale)


def penalised_objective(bound: Bound, run: Rollout, prices: Floats) -> float:
    """Return the objective of the bound that an episode reaches, less the price of what its services lack."""
    circularity = float(run.episode_circularity[0])
    if bound.service_weight is not None:
        scale = bound.network.objective.circularity_scale
        return circularity / scale + bound.service_weight * float(run.episode_service[0])
    return circularity - float(prices @ np.maximum(0.0, demand(bound) - run.episode_levels[0]))


def demand(bound: Bound) -> Floats:
    """Return the mean level demanded of each service, 0 for none, shape (services,)."""
    return np.zeros(len(bound.network.services)) if bound.min_service is None else bound.min_service


def refine(
    bound: Bound,
    *,
    enough: Callable[[Rollout], bool] = lambda run: False,
    progress: Callable[[float], None] = lambda share: None,
) -> Bound:
    """Return ``bound`` with actions that do better in the simulator; the bound and its certificate stay.

    Each round solves the program of the bound with controls that are constant within an interval to first order
    (``Programs``), which the simulator carries out more faithfully. Where an episode delivers less of a service than
    its program promised, the next one demands that much more: the lower end l of its band becomes

        l·(1 + Σ max(0, promised level − delivered level)),

    summed over the episodes so far, that of the bound's plan being the first. The best episode counts, by the penalised
    objective; rounds end when no service lacks more than TOLERATED_SHORTFALL.

    Args:
        bound: with the actions to start from.
        enough: asked of each episode that is better than those before, whether to stop there.
        progress: called with the share of REFINEMENT_ROUNDS programs that is solved; 1 when no more are needed.
    """
    admissible = Admissible.of(bound.network, bound.agents or None)
    price, best, run = prices(bound), bound, simulate_plan(bound)
    value = penalised_objective(bound, run, price)
    factor = 1.0 + _shortfall(bound.problem.layout, bound.solution, run, 1.0)
    for done in range(REFINEMENT_ROUNDS):
        if enough(run):
            break
        demand_ranges = replace(admissible, service_low=admissible.service_low * factor)
        programs = Programs(demand_ranges, REFINEMENT_DEGREE, bound.service_weight, hold_controls=True)
        try:
            problem = programs.program(bound.initial, bound.min_service)
            variables = solve(problem, label="the program of a better plan", certify=False).plan
        except (Infeasible, SolverFailure):  # more than can be had: what was found so far is the plan
            break
        layout = programs.layout
        actions = normalised_actions(demand_ranges, layout, variables.reshape(-1, layout.size))
        candidate = replace(bound, actions=actions)
        trial = simulate_plan(candidate)
        progress((done + 1) / REFINEMENT_ROUNDS)
        if (worth := penalised_objective(bound, trial, price)) > value:
            best, run, value = candidate, trial, worth
        shortfall = _shortfall(layout, variables, trial, factor)
        if shortfall.mean(axis=0).max(initial=0.0) <= TOLERATED_SHORTFALL:
            break
        factor += shortfall
    progress(1.0)
    return best


def _shortfall(layout: Layout, plan: Floats, run: Rollout, factor: float | Floats) -> Floats:
    """Return what an episode lacks of the levels that its program promised, shape (steps, services).

    The program's levels are of bands that were raised by ``factor``.
    """
    levels = plan.reshape(-1, layout.size)[:, layout.level : layout.imbalance]
    shortfall: Floats = np.maximum(np.minimum(levels * factor, 1.0) - run.levels[0].T, 0.0)
    return shortfall
