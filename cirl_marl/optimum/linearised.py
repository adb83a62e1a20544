"""An episode of the simulator to first order: the linear program of small changes of its actions (``slopes``)."""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.aims import Aims, EpisodeRecord, RateTables, over
from cirl_marl.optimum.program import LinearProgram
from cirl_marl.optimum.slopes import TINY, ActionPlan, Slopes
from cirl_marl.optimum.step_measures import Measures
from cirl_marl.optimum.step_parts import Efforts, Excesses, account_shares


@positional_record
class Later:
    """What comes after some intervals, by what they leave, in the objective of these."""

    cost: Annotated[Floats, "of rows of ``jacobians``, shape (steps, rows)"]
    level_cost: Annotated[Floats, "of levels, shape (steps, services)"]


@positional_record
class Span:
    """Which intervals of an episode a plan is of, and what of them may change."""

    first: Annotated[int, "interval of the network in which it begins"] = 0
    later: Annotated[Later | None, "what comes after it; None: nothing"] = None
    rates: Annotated[
        tuple[RateTables, RateTables] | None, "of accounts, and of budgets, over its intervals; None: the network's"
    ] = None
    free: Annotated[int | None, "how many of its first intervals may change; None: all"] = None

    def rates_of(self, plan: ActionPlan) -> tuple[RateTables, RateTables]:
        """Return the rates of the accounts that are weighed, and of the budgets, over the intervals of a plan."""
        if self.rates is not None:
            return self.rates
        intervals = range(self.first, self.first + len(plan.actions))
        return over(Ledger(plan.network).rates(), intervals), over(plan.aims.rates(plan.network), intervals)


ALL = Span()


@positional_record
class StepColumns:
    """Where the variables of a step are: interval by interval, then what is short in the mean.

    Efforts are changes of charged distances of controls, excesses those of what is charged beyond amounts.
    """

    action: Annotated[Integers, "of δa, shape (steps, entries)"]
    supply: Annotated[Integers, "of δU, what idle supplies change by, shape (steps, supplies)"]
    level: Annotated[Integers, "of the levels, shape (steps, services)"]
    imbalance: Annotated[Integers, "of what is at least |φ|, shape (steps, 1)"]
    effort: Annotated[Integers, "of efforts, shape (steps, controls)"]
    excess: Annotated[Integers, "of excesses, shape (steps, excesses)"]
    lack: Annotated[Integers, "of what services lack and budgets are exceeded by, shape (services + budgets,)"]

    @classmethod
    def of(cls, steps: int, sizes: tuple[int, ...], lacks: int) -> StepColumns:
        """Lay them out, by how many of each kind an interval has."""
        table = np.arange(steps * sum(sizes)).reshape(steps, -1)
        action, supply, level, imbalance, effort, excess = np.split(table, np.cumsum(sizes)[:-1], axis=1)
        return cls(action, supply, level, imbalance, effort, excess, table.size + np.arange(lacks))

    @property
    def moves(self) -> Integers:
        """What changes the episode, shape (steps, entries + supplies)."""
        return np.concatenate([self.action, self.supply], axis=1)

    @property
    def part(self) -> Integers:
        """Convex parts of accounts, shape (steps, controls + excesses)."""
        return np.concatenate([self.effort, self.excess], axis=1)


class _Rows:
    """Rows G v ≤ h of some variables, block by block."""

    def __init__(self, count: int) -> None:
        self._count = count
        self.blocks: list[sparse.csr_array] = []
        self.limits: list[Floats] = []

    def add(self, block: sparse.csr_array, columns: Integers, limits: Floats) -> None:
        """Add rows, whose block has a column for each of some variables."""
        shape = len(limits), self._count
        self.blocks.append(sparse.csr_array((block.data, columns[block.indices], block.indptr), shape))
        self.limits.append(limits)


@positional_record
class StepProgram:
    """The program of the best step."""

    problem: Annotated[LinearProgram, "the program"]
    columns: Annotated[StepColumns, "where its variables are"]
    scale: Annotated[Floats, "measure of each variable, shape (variables,)"]
    origin: Annotated[Floats, "its variables if nothing changes, likewise"]
    idle: Annotated[NDArray[np.bool_], "actions that move nothing to first order, shape (steps, entries)"]
    place: Annotated[Integers, "interval and measure of each of the first rows of G, shape (rows, 2)"]
    measures: Annotated[Measures, "what these read"]
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
        (step, row), table = self.place.T, self.measures.table.T
        before, after = (np.concatenate([each.stock, each.flow], axis=1) @ table for each in (run, trial))
        moves = np.zeros(len(values))
        for columns in (self.columns.moves, self.columns.part):
            moves[columns] = values[columns]
        limits = self.problem.under_to.copy()
        correction = (after - before)[step, row] + self.problem.under[: len(row)] @ moves
        contents = [content.service for content in self.measures.contents]  # read by no table
        limits[: len(row)] += np.where(np.isin(row, contents), 0.0, correction)
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
    span: Span = ALL,
    *,
    is_leap: bool = False,
    is_held: bool = False,
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
        span: its intervals.
        is_leap: whether what products of contents would be at the levels demanded counts, not at those of the episode:
            what is too impure then gets better as less is made, as it will once nothing is.
        is_held: whether idle supplies that bring something go on to bring just what is needed, and part_rows nothing.
    """
    network, aims, limits = plan.network, plan.aims, plan.aims.limits if limits is None else limits
    (steps, entries), services = plan.actions.shape, len(network.services)
    supplies = slopes.supplies.at_need() if is_held else slopes.supplies
    ledger, (rates, budget_rates) = Ledger(network), span.rates_of(plan)
    pieces = len(ledger.excesses)
    controls = rates[2].shape[2] - pieces
    is_charged = np.asarray(rates[2][:, :, :controls].any(axis=(0, 1))) | ledger.excess_subjects[2].any(axis=0)
    efforts = Efforts.of(plan, is_charged, span.first)
    excesses = Excesses.of(ledger, dynamics, efforts, plan.initial, slopes.end)
    sizes = entries, len(supplies.services), services, 1, len(efforts.entries), pieces
    columns = StepColumns.of(steps, sizes, services + len(limits))
    moves, part, count = columns.moves, columns.part, steps * sum(sizes) + len(columns.lack)
    effort_actions = columns.action[:, efforts.entries]

    low, high = np.zeros(count), np.full(count, np.inf)
    low[columns.action] = np.maximum(-trust, -1 - plan.actions)
    high[columns.action] = np.minimum(trust, 1 - plan.actions)
    if span.free is not None:
        low[columns.action[span.free :]] = high[columns.action[span.free :]] = 0.0
    low[columns.supply], high[columns.supply] = supplies.low, supplies.high
    furthest = np.maximum(-low, high)
    low[columns.effort], high[columns.effort] = -np.abs(efforts.away), efforts.half * furthest[effort_actions]
    high[columns.level] = 1.0

    weights = -aims.objective(-_circularity_cost(plan, dynamics), account_shares(rates, dynamics))
    budget_weights = account_shares(budget_rates, dynamics)
    cost, cost_later, budget_rows = np.zeros(count), np.zeros(count), np.zeros((len(limits), count))
    parts = np.append(efforts.controls, np.arange(controls, controls + pieces))
    cost[part] = -aims.objective(np.zeros(part.shape), rates[2][:, :, parts])
    budget_rows[:, part] = budget_rates[2][:, :, parts]
    measures = Measures.of(network, dynamics, slice(span.first, span.first + steps), margin)
    measure_rows, part_rows, places = _Rows(count), _Rows(count), list[Integers]()
    before = np.empty((slopes.end.shape[1], 0))
    is_idle = np.ones(count, dtype=bool)
    for t, response in enumerate(slopes.responses()):
        past, end = moves[: t + 1].ravel(), slopes.end[t]
        is_idle[past] &= ~response.any(axis=0)
        cost[past] += weights[t] @ response
        budget_rows[:, past] += budget_weights[:, t] @ response
        if span.later is not None:
            cost_later[past] += span.later.cost[t] @ response
        levels = np.maximum(run.levels[0, :, t], demand) if is_leap else run.levels[0, :, t]
        block, room, near = measures.rows(t, levels, end, response, furthest[past])
        measure_rows.add(block, np.concatenate([past, columns.level[t], columns.imbalance[t]]), room)
        places.append(np.stack([np.full_like(near, t), near], axis=1))
        block, room = supplies.rows_of(t, measures.by_stage[:services] @ response)
        part_rows.add(block, past, room)
        if pieces:
            furthest_parts = furthest[past], efforts.half[t] * furthest[effort_actions[t]]
            block, room, ends = excesses.rows(t, response, before, *furthest_parts)
            low[columns.excess[t]], high[columns.excess[t]] = ends.T
            part_rows.add(block, np.append(past, part[t]), room)
            before = response
    for sign in (1.0, -1.0):
        part_rows.add(efforts.rows(sign), np.append(effort_actions, columns.effort), efforts.limits(sign))
    # mean level + lack ≥ demanded level; what is booked − excess ≤ budget
    means = sparse.kron(np.full((1, steps), 1.0 / steps), sparse.eye_array(services))
    lacks = -sparse.hstack([means, sparse.eye_array(services)], format="csr")
    part_rows.add(lacks, np.append(columns.level, columns.lack[:services]), -demand)
    budget_rows[:, columns.lack[services:]] = -np.eye(len(limits))
    part_rows.add(sparse.csr_array(budget_rows), np.arange(count), limits - aims.totals(run))

    size = network.objective.circularity_scale
    if plan.service_weight is not None:
        cost /= size
        cost[columns.level] = -plan.service_weight / (steps * max(services, 1))
    if measures.is_absolute:
        cost[columns.imbalance] += aims.circularity / (steps * (1.0 if plan.service_weight is None else size))
    for service, weight in aims.levels.items():
        cost[columns.level[:, service]] -= weight / steps
    if span.later is not None:
        cost[columns.level] += span.later.level_cost
    cost += cost_later
    cost[columns.lack] = price

    origin = np.zeros(count)
    origin[columns.level] = run.levels[0].T
    origin[columns.imbalance] = np.abs(run.flow @ network.circularity_weights[1])[:, None]
    short = demand - run.levels[0].mean(axis=1), aims.totals(run) - limits
    origin[columns.lack] = np.maximum(np.concatenate(short), 0.0)
    scale = np.ones(count)
    scale[columns.supply] = np.maximum(supplies.size, TINY)
    scale[columns.imbalance] = max(float(origin[columns.imbalance].max()), size)
    scale[columns.effort] = np.maximum(efforts.half, TINY)
    scale[columns.excess] = ledger.amounts.T
    scale[columns.lack[services:]] = np.maximum(np.abs(aims.totals(run)), np.abs(limits))
    problem = LinearProgram(
        cost=cost,
        equal=sparse.csr_array((0, count)),
        equal_to=np.empty(0),
        under=sparse.vstack(measure_rows.blocks + part_rows.blocks, format="csr"),
        under_to=np.concatenate(measure_rows.limits + part_rows.limits),
        low=low,
        high=high,
    )
    return StepProgram(problem, columns, scale, origin, is_idle[columns.action], np.concatenate(places), measures, aims)


def _circularity_cost(plan: ActionPlan, dynamics: Dynamics) -> Floats:
    """Return minus the share of (x', f̄) of intervals in λ̄, but for an absolute imbalance, (steps, stocks + arcs)."""
    network, steps = plan.network, len(plan.actions)
    weights = network.circularity_weights
    counted = weights[0] if network.objective.net_zero == "abs" else weights.sum(axis=0)
    of_substances = np.zeros(len(network.arcs) * (dynamics.rows.components - 1))
    cost = np.concatenate([np.zeros(dynamics.rows.nodes.stop), -counted / steps, of_substances])
    return np.broadcast_to(cost, (steps, len(cost)))
