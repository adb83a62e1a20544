"""An episode of the simulator to first order: the linear program of small changes of its actions.

Every interval is linear to first order around an episode, δx' = J_x δx + J_a δa, and so are mean flows. The Jacobians
are difference quotients of the simulator, so that cuts of flows and supplies that make up for services are in them.
Beside budgets such supplies are held in these, and change as actions do (``step_supplies``).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from typing import Annotated, Protocol

import numpy as np
from scipy import sparse

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.dynamics.supply import Supply
from cirl_marl.environments.actuators import Actuators
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.aims import Aims, EpisodeRecord, RateTables, over
from cirl_marl.optimum.planned_episodes import HasPlan
from cirl_marl.optimum.program import LinearProgram
from cirl_marl.optimum.step_parts import Efforts, Excesses, account_shares
from cirl_marl.optimum.step_supplies import IdleSupplies
from cirl_marl.optimum.window_simulator import WindowSimulator, service_measures

DIFFERENCE = 1e-6
"""Step of the difference quotients, relative to the scale of a stock or to half the range of a control."""
TINY = 1e-12
"""Least half of a range that measures the distance of a control."""
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
class Later:
    """What comes after some intervals, by what they leave, in the objective of these."""

    cost: Annotated[Floats, "of rows of ``jacobians``, shape (steps, rows)"]
    level_cost: Annotated[Floats, "of levels, shape (steps, services)"]


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


def jacobians(plan: ActionPlan, dynamics: Dynamics, first: int = 0) -> Slopes:
    """Return the slopes of every interval from the first, around a plan."""
    network = plan.network
    steps, entries = plan.actions.shape
    rows, nodes = dynamics.rows, dynamics.rows.nodes.stop
    stock = WindowSimulator(dynamics, plan.agents).run(plan.initial, plan.actions, first)[0]
    actuators, interval = Actuators(network, plan.agents or None, steps), np.arange(first, first + steps)
    controls = actuators.controls(np.ascontiguousarray(plan.actions.T), interval)
    supply = Supply(dynamics)
    idle, is_held = supply.idle(actuators.agents), bool(plan.aims.budgets)
    supplies = IdleSupplies.of(dynamics, supply, idle & is_held, dynamics.extend(stock[:-1].T), controls, first)
    inputs, brought = np.concatenate([stock[:-1], plan.actions], axis=1), len(supplies.services)
    count = nodes + entries + brought
    scale = np.array([node.scale for node in dynamics.staged_network.stores])
    width = np.concatenate([np.maximum(stock.max(axis=0), scale), np.ones(entries)]) * DIFFERENCE
    # forward in stocks, which may be 0; inward in actions, which may be at a bound, and in what is brought
    # one batch simulates all difference quotients of all intervals: column (t, j) has input j of interval t shifted
    shift = np.where(np.arange(nodes + entries) < nodes, 1.0, -np.where(inputs >= 0, 1.0, -1.0)) * width
    inward = np.where(supplies.high > -supplies.low, 1.0, -1.0) * DIFFERENCE * np.maximum(supplies.size, TINY)
    columns = np.repeat(inputs[:, :, None], count + 1, axis=2)
    columns[:, np.arange(nodes + entries), np.arange(nodes + entries)] += shift
    flat = np.ascontiguousarray(columns.transpose(1, 0, 2).reshape(nodes + entries, -1))
    interval = np.repeat(interval, count + 1)
    controls = Actuators(network, plan.agents or None, flat.shape[1]).controls(flat[nodes:], interval)
    columns = np.repeat(supplies.controls[:, :, None], count + 1, axis=2)
    columns[:, :, nodes + entries : count] += (supplies.unit * inward.T[:, None]).transpose(1, 2, 0)
    controls[supplies.rows] = columns.reshape(len(columns), flat.shape[1])
    stocks, inner = dynamics.extend(flat[:nodes]), np.empty((0, flat.shape[1]))
    _, done = supply.advance(stocks, inner, controls, interval, idle & (not is_held))
    flows = np.concatenate([done.moved_mass, done.moved_substances]) / network.episode.control_interval
    outputs = np.concatenate([done.stock[rows.nodes], flows])
    by_interval = outputs.reshape(len(outputs), steps, -1).transpose(1, 0, 2)
    slopes = (by_interval[:, :, :-1] - by_interval[:, :, -1:]) / np.concatenate([shift, inward], axis=1)[:, None]
    return Slopes(slopes[:, :, :nodes], slopes[:, :, nodes:], np.ascontiguousarray(by_interval[:, :, -1]), supplies)


@positional_record
class StepProgram:
    """The program of the best step: δa, δU, levels, imbalance, changes of convex parts of intervals, lacks, excesses.

    Convex parts are charged distances of controls, and what rates in pieces have excesses of.
    """

    problem: Annotated[LinearProgram, "the program"]
    scale: Annotated[Floats, "measure of each variable, shape (variables,)"]
    origin: Annotated[Floats, "its variables if nothing changes, likewise"]
    action: Annotated[Integers, "columns of δa, shape (steps, entries)"]
    supply: Annotated[Integers, "columns of what idle supplies change by, shape (steps, supplies)"]
    part: Annotated[Integers, "columns of what convex parts change by, shape (steps, parts)"]
    level: Annotated[Integers, "columns of the levels, shape (steps, services)"]
    lack: Annotated[Integers, "columns of what services lack and budgets are exceeded by, (services + budgets,)"]
    measured: Annotated[Integers, "interval, and row of ``measure``, of each of the first rows of G, shape (rows, 2)"]
    measure: Annotated[Floats, "what rows read off stocks and mean flows, shape (measures, stores + arcs)"]
    contents: Annotated[list[int], "rows of ``measure`` that are of contents, which it does not read"]
    aims: Annotated[Aims, "whose budgets the last rows of G keep"]

    def promise(self, values: Floats) -> float:
        """Return by how much the objective gets better, to first order, by a solution."""
        return float(self.problem.cost @ (self.origin - values))

    def with_correction(self, values: Floats, run: EpisodeRecord, trial: EpisodeRecord) -> StepProgram:
        """Return the program with what an episode was away from what its solution promised: a second-order correction.

        Args:
            values: the solution.
            run: the episode that the program is around.
            trial: that of the solution.
        """
        step, row = self.measured.T
        before, after = (np.concatenate([each.stock, each.flow], axis=1) @ self.measure.T for each in (run, trial))
        moves = np.zeros(len(values))
        for columns in (self.action, self.supply, self.part):
            moves[columns] = values[columns]
        limits = self.problem.under_to.copy()
        correction = (after - before)[step, row] + self.problem.under[: len(row)] @ moves
        limits[: len(row)] += np.where(np.isin(row, self.contents), 0.0, correction)
        first = len(limits) - len(self.aims.budgets)
        limits[first:] -= self.aims.totals(trial) - self.aims.totals(run) - self.problem.under[first:] @ moves
        return replace(self, problem=replace(self.problem, under_to=limits))


def step_program(
    plan: ActionPlan,
    dynamics: Dynamics,
    run: EpisodeRecord,
    demand: Floats,
    price: Floats,
    trust: float,
    slopes: Slopes,
    margin: Floats | float = 0.0,
    limits: Floats | None = None,
    is_leap: bool = False,
    first: int = 0,
    later: Later | None = None,
    rates: tuple[RateTables, RateTables] | None = None,
    is_held: bool = False,
    free: int | None = None,
) -> StepProgram:
    """Return the program of the best change of the actions within a trust region, to first order.

    Stocks and flows are no variables of it: to first order δ(x', f̄)_t = J_x δx'_{t−1} + J_a δa_t makes each a sum over
    the actions so far. Rows that no step within the region can come to are left out.

    Args:
        plan: whose objective counts, with the actions of the episode.
        dynamics: of its network.
        run: the episode.
        demand: mean level demanded of each service, shape (services,).
        price: of what each service lacks, and by which each budget is exceeded, shape (services + budgets,).
        trust: half-width of the region, in normalised actions.
        slopes: ``jacobians`` of the episode.
        margin: by how much more of a service than its band begins with counts as all of it, relative to that, shape
            (services, steps).
        limits: budgets of accounts, shape (budgets,); None: those of the plan.
        is_leap: whether what products of contents would be at the levels demanded counts, not at those of the episode:
            what is too impure then gets better as less is made, as it will once nothing is.
        first: interval of the network in which the plan begins.
        later: what comes after it.
        rates: of the accounts that are weighed, and of the budgets, over its intervals; None: those of the network.
        is_held: whether idle supplies that bring something go on to bring just what is needed, and others nothing.
        free: how many of the first intervals may change; None: all.
    """
    network, limits = plan.network, plan.aims.limits if limits is None else limits
    steps, entries = plan.actions.shape
    state, services, is_absolute = slopes.end, len(network.services), network.objective.net_zero == "abs"
    supplies = slopes.supplies.at_need() if is_held else slopes.supplies
    acts = entries + len(supplies.services)
    period = slice(first, first + steps)
    intervals = range(period.start, period.stop)
    if rates is None:
        rates = over(Ledger(network).rates(), intervals), over(plan.aims.rates(network), intervals)
    rates_of_accounts, rates_of_budgets = rates
    ledger, controls = Ledger(network), rates_of_accounts[2].shape[2]
    controls -= len(ledger.excesses)
    is_charged = np.asarray(rates_of_accounts[2][:, :, :controls].any(axis=(0, 1)))
    is_charged |= ledger.excess_subjects[2].any(axis=0)
    efforts = Efforts.of(plan, is_charged, first)
    excesses = Excesses.of(ledger, dynamics, efforts, plan.initial, state)
    count_efforts = len(efforts.entries)
    size = acts + services + 1 + count_efforts + len(ledger.excesses)
    level, imbalance, count = acts, acts + services, size * steps + services + len(limits)
    step_low = np.concatenate([np.maximum(-trust, -1 - plan.actions), supplies.low], axis=1)
    step_high = np.concatenate([np.minimum(trust, 1 - plan.actions), supplies.high], axis=1)
    if free is not None:
        step_low[free:, :entries] = step_high[free:, :entries] = 0.0
    furthest = np.maximum(-step_low, step_high)
    low = np.array([network.interval_means(service.low)[period] for service in network.services]).reshape(-1, steps)
    low *= 1.0 + margin
    measure, by_stage, imbalances = _measures(plan, dynamics)
    contents = _contents(plan, dynamics)
    accounts = account_shares(rates_of_accounts, dynamics)
    weights = -plan.aims.objective(-_circularity_cost(plan, dynamics), accounts)
    cost, cost_later, spent = np.zeros(count), np.zeros(count), np.zeros((len(limits), count))
    budgets = account_shares(rates_of_budgets, dynamics)
    columns = size * np.arange(steps)[:, None] + np.arange(size)
    convex = columns[:, imbalance + 1 :]
    effort, part_bounds = convex[:, :count_efforts], slice(size - len(ledger.excesses), size)
    parts = np.append(efforts.controls, np.arange(controls, rates_of_accounts[2].shape[2]))
    cost[convex] = -plan.aims.objective(np.zeros(convex.shape), rates_of_accounts[2][:, :, parts])
    spent[:, convex] = rates_of_budgets[2][:, :, parts]
    bounds = np.tile(np.array([0.0, np.inf]), (steps, size, 1))
    before = np.empty((len(state[0]), 0))
    rows: list[sparse.csr_array] = []
    rights: list[Floats] = []
    measured: list[Integers] = []
    rows_of_parts: list[sparse.csr_array] = []
    rights_of_parts: list[Floats] = []
    for t, response in enumerate(_responses(slopes.by_stock, slopes.by_action)):
        past = columns[: t + 1, :acts].ravel()
        cost[past] += weights[t] @ response
        if later is not None:
            cost_later[past] += later.cost[t] @ response
        spent[:, past] += budgets[:, t] @ response
        # low·level − δq ≤ q; −δx ≤ x; and ±(φ + δφ) ≤ imbalance, with q, x and φ those of the simulated episode
        table, limit, own = -by_stage @ response, by_stage @ state[t], np.zeros((len(measure), size))
        own[np.arange(services), level + np.arange(services)] = low[:, t]
        for s, part, whole, least, most in contents:
            share, mass, total = run.levels[0, s, t], float(part @ state[t]), float(whole @ state[t])
            share = max(share, demand[s]) if is_leap else share
            if math.isfinite(most[first + t]) and mass >= least[first + t] * total:
                # level·part ≤ most·whole, to first order: part·level + level₀·δpart − most·δwhole ≤ most·whole
                table[s] = (share * part - most[first + t] * whole) @ response
                limit[s], own[s, level + s] = most[first + t] * total, mass
            else:  # level·least·whole ≤ part
                table[s] = (share * least[first + t] * whole - part) @ response
                limit[s], own[s, level + s] = mass, least[first + t] * total
        is_near = abs(table) @ furthest[: t + 1].ravel() > limit - own.sum(axis=1)
        if is_absolute:
            own[-2:, imbalance], is_near[-2:] = -1.0, True
        near = np.flatnonzero(is_near)
        block = sparse.csr_array(np.concatenate([table, own[:, acts:]], axis=1)[near])
        places = np.append(past, columns[t, acts:])[block.indices]
        rows.append(sparse.csr_array((block.data, places, block.indptr), (len(near), count)))
        rights.append(limit[near])
        measured.append(np.stack([np.full_like(near, t), near], axis=1))
        block, room = supplies.rows_of(t, by_stage[:services] @ response)
        rows_of_parts.append(sparse.csr_array((block.data, past[block.indices], block.indptr), (len(room), count)))
        rights_of_parts.append(room)
        if convex.shape[1] > count_efforts:
            moves = furthest[: t + 1].ravel(), efforts.half[t] * furthest[t, efforts.entries]
            block, room, bounds[t, part_bounds] = excesses.rows(t, response, before, *moves)
            places = np.append(past, convex[t])[block.indices]
            rows_of_parts.append(sparse.csr_array((block.data, places, block.indptr), (len(room), count)))
            rights_of_parts.append(room)
            before = response
    rows += rows_of_parts
    rights += rights_of_parts
    for sign in (1.0, -1.0):
        rows.append(efforts.rows(sign, columns[:, efforts.entries], effort, count))
        rights.append(efforts.limits(sign))
    # mean level + lack ≥ demanded level
    means = sparse.kron(np.full((1, steps), -1.0 / steps), sparse.eye_array(services, size, k=level))
    lacks = sparse.hstack([means, -sparse.eye_array(services), sparse.csr_array((services, len(limits)))], format="csr")
    rows.append(lacks)
    # what is booked − excess ≤ budget
    spent[:, size * steps + services :] = -np.eye(len(limits))
    rows.append(sparse.csr_array(spent))
    bounds[:, :acts] = np.stack([step_low, step_high], axis=2)
    bounds[:, level:imbalance, 1] = 1.0
    most = efforts.half * furthest[:, efforts.entries]
    bounds[:, imbalance + 1 : part_bounds.start] = np.stack([-np.abs(efforts.away), most], axis=2)
    lower, upper = np.concatenate([bounds.reshape(-1, 2), np.tile([0.0, np.inf], (services + len(limits), 1))]).T
    if plan.service_weight is not None:
        cost /= network.objective.circularity_scale
        cost[columns[:, level:imbalance]] = -plan.service_weight / (steps * max(services, 1))
    if is_absolute:
        scale = 1.0 if plan.service_weight is None else network.objective.circularity_scale
        cost[columns[:, imbalance]] += plan.aims.circularity / (steps * scale)
    for service, weight in plan.aims.levels.items():
        cost[columns[:, level + service]] -= weight / steps
    if later is not None:
        cost[columns[:, level:imbalance]] += later.level_cost
    cost += cost_later
    cost[size * steps :] = price
    problem = LinearProgram(
        cost=cost,
        equal=sparse.csr_array((0, count)),
        equal_to=np.empty(0),
        under=sparse.vstack(rows, format="csr"),
        under_to=np.concatenate([*rights, -demand, limits - plan.aims.totals(run)]),
        low=lower,
        high=upper,
    )
    net_flow = np.abs(run.flow @ imbalances)[:, None]
    largest = max(float(net_flow.max()), network.objective.circularity_scale)
    unchanged = np.zeros(convex.shape)
    origin = np.concatenate([np.zeros((steps, acts)), run.levels[0].T, net_flow, unchanged], axis=1)
    measures = [np.ones(entries), np.maximum(supplies.size, TINY), np.ones(services), np.array([largest])]
    scales = [np.tile(np.concatenate(measures), (steps, 1)), np.maximum(efforts.half, TINY)]
    scales.append(np.tile(ledger.amounts.T, (steps, 1)))
    size_of_excess = np.maximum(np.abs(plan.aims.totals(run)), np.abs(limits))
    short = [np.maximum(demand - run.levels[0].mean(axis=1), 0.0), np.maximum(plan.aims.totals(run) - limits, 0.0)]
    return StepProgram(
        problem,
        np.concatenate([np.concatenate(scales, axis=1).ravel(), np.ones(services), size_of_excess]),
        np.concatenate([origin.ravel(), *short]),
        columns[:, :entries],
        columns[:, entries:acts],
        convex,
        columns[:, level:imbalance],
        np.arange(size * steps, count),
        np.concatenate(measured),
        measure,
        [content[0] for content in contents],
        plan.aims,
    )


def _responses(by_stock: Floats, by_action: Floats) -> Iterator[Floats]:
    """Give δ(x', f̄) of each interval for a unit of every action so far, shape (stocks + arcs, (t + 1)·entries)."""
    nodes = by_stock.shape[2]
    stock = np.empty((nodes, 0))
    for to_stock, to_action in zip(by_stock, by_action, strict=True):
        response = np.concatenate([to_stock @ stock, to_action], axis=1)
        yield response
        stock = response[:nodes]


def _measures(plan: ActionPlan, dynamics: Dynamics) -> tuple[Floats, Floats, Floats]:
    """Return what is read off stocks and mean flows, the same of stocks by stage, and −Δ·σ_env of flows.

    Read are each service; stocks that scheduled flows leave, as no others could become negative to first order; and
    where |φ| counts, −φ and φ. Shapes are (measures, stores + arcs), (measures, stocks + arcs) and (arcs,).
    """
    network, stores = plan.network, len(plan.network.stores)
    columns = np.eye(stores + len(network.arcs))
    services = [
        columns[[network.node_index[node] for node in service.providers]].sum(axis=0)
        if service.quantity == "stock"
        else columns[stores + network.service_arcs(service)].sum(axis=0)
        for service in network.services
    ]
    donors = np.unique(network.donors[dynamics.is_scheduled[: len(network.arcs)]])
    imbalances = -network.circularity_weights[1]
    rows = [*services, *columns[donors[donors < stores]]]
    if network.objective.net_zero == "abs":
        rows += [sign * np.append(np.zeros(stores), imbalances) for sign in (-1.0, 1.0)]
    measure = np.array(rows).reshape(-1, len(columns))
    by_stage = np.zeros((len(measure), dynamics.rows.nodes.stop + len(network.arcs) * dynamics.rows.components))
    for store in range(stores):
        by_stage[:, np.atleast_1d(dynamics.rows.stages.get(store, store))] = measure[:, [store]]
    flows = slice(dynamics.rows.nodes.stop, dynamics.rows.nodes.stop + len(network.arcs))
    by_stage[:, flows] = measure[:, stores:]
    return measure, by_stage, imbalances


def _contents(plan: ActionPlan, dynamics: Dynamics) -> list[tuple[int, Floats, Floats, Floats, Floats]]:
    """Return each service of a content: its number, what reads its substance and its whole, and the ends of its band.

    Both read the rows of Jacobians, shape (rows,); the ends have shape (steps,).
    """
    network, (part, whole) = plan.network, service_measures(plan.network, dynamics)
    return [
        (s, part[s], whole[s], network.interval_means(service.low), network.interval_means(service.high))
        for s, service in enumerate(network.services)
        if service.substance
    ]


def _circularity_cost(plan: ActionPlan, dynamics: Dynamics) -> Floats:
    """Return minus the share of (x', f̄) of intervals in λ̄, but for an absolute imbalance, (steps, stocks + arcs)."""
    network, steps = plan.network, len(plan.actions)
    weights = network.circularity_weights
    counted = weights[0] if network.objective.net_zero == "abs" else weights.sum(axis=0)
    of_substances = np.zeros(len(network.arcs) * (dynamics.rows.components - 1))
    cost = np.concatenate([np.zeros(dynamics.rows.nodes.stop), -counted / steps, of_substances])
    return np.broadcast_to(cost, (steps, len(cost)))
