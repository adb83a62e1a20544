"""Plans of some intervals of an episode: solved with a price on service, tried in the simulator, and solved again.

The program relaxes what controls held within an interval can do, so that a plan promises more of a service than comes
about, or less. With q̂ the planned quantity of a service in an interval, q what the simulator makes of the planned
actions, and l the lower end of its band, the next program counts as its level at most

    (q̂' − (q̂ − q))/l

for what it plans, q̂': what was missed is raised, what was met better is not paid for twice. Of the plans tried, that
one is carried out which does best in the simulator.

The price of what services lack, and of what budgets are exceeded by, rises until no more can be had. What is booked
beyond a plan, the next program has that much less of.

Of what nobody foresees several futures may be planned for at once: each has its own rows, what is done in the first
interval is the same in all, and services count by their mean.

Reference: Marchetti, Chachuat and Bonvin 2009, Industrial & Engineering Chemistry Research 48, 6022 (the model's error
is added to its constraints).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import replace
from functools import partial
from typing import Annotated, Any

import numpy as np
from scipy import sparse

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.environments.actuators import planned_deviation
from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.admissible import Admissible, normalised_actions
from cirl_marl.optimum.aims import NO_AIMS, Aims, RateTables, account_rows
from cirl_marl.optimum.constraints import held_controls
from cirl_marl.optimum.linearised import Later
from cirl_marl.optimum.matrices import IntervalCache, Layout, ProgramRows
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.optimum.solver import LARGE_PROGRAM, Basis, Infeasible, Solution, SolverFailure, solve
from cirl_marl.optimum.vintages import LOOSE
from cirl_marl.optimum.window_simulator import WindowSimulator, service_measures
from cirl_marl.optimum.windows import (
    DISTANCE,
    EMPTY,
    Continuation,
    Correction,
    JointProgram,
    WindowPlan,
    WindowTask,
    level_columns,
    level_rows,
    with_distance,
)

FIRST_PRICE, RISE, RISES = 3.0, 10.0, 8
"""The price of service that is tried first, against λ̄/circularity_scale; by what it is multiplied while more could be
had, and how often at most."""
SHORTFALL, ROUGH_SHORTFALL = 1e-6, 1e-4
"""Mean level that a plan may lack of what is demanded without a higher price; where it is solved roughly."""
ROUNDS, MOST_ROUNDS, LARGE_ROUNDS = 3, 10, 2
"""Most programs for a plan, but for those with higher prices: usually, while it falls short, and of large programs, of
whose outlooks the first will do."""
FALLS_SHORT = 2e-3
"""By how much the simulator must not miss what a program promises, in λ̄/circularity_scale."""
EXCEEDED = 1e-5
"""Part of a budget by which what a plan books may differ from what was reckoned with, without a further round."""
NOTABLE = 2e-3
"""Part of a budget, or level of a service, by which a plan misses it and says so."""
TOLERANCE = 2e-4
"""Level by which the intervals that are carried out may miss what is planned, in the mean, without a further round."""


@positional_record
class WindowOutcome:
    """What the simulator makes of actions of some intervals."""

    level: Annotated[Floats, "of services, shape (intervals, services)"]
    ratio: Annotated[Floats, "of what there is to the lower end, of a content 1 and what room is left, likewise"]
    bookings: Annotated[Floats, "on budgeted accounts, in parts of budgets, shape (intervals, budgets)"]
    amounts: Annotated[Floats, "on all accounts, not discounted, (accounts, intervals); empty if none counts"]
    accounts: Annotated[Floats, "their totals, discounted, shape (accounts,)"]
    value: Annotated[float, "objective reached, less what is left to later intervals"]
    stock: Annotated[Floats, "after each interval, shape (intervals, stores), mass"]
    flow: Annotated[Floats, "mean of each interval, shape (intervals, arcs), mass/time"]


@positional_record
class WindowTrial:
    """What became of the plan of a window in one future."""

    actions: Annotated[Floats, "normalised, shape (intervals, entries)"]
    value: Annotated[float, "objective reached, less what is left to later intervals"]
    level: Annotated[Floats, "mean level of each service, shape (services,)"]
    correction: Annotated[Correction, "what the plan promised and did not keep"]
    bookings: Annotated[Floats, "on budgeted accounts, in parts of budgets, shape (intervals, budgets)"]
    promised: Annotated[Floats, "levels of the program, shape (intervals, services)"]


class Future:
    """One course that a network may take: its programs and its simulator.

    Attributes:
        admissible: what agents can do.
        network: the network, certain.
        layout: of the variables of an interval.
        horizon: decisions of an episode, of which the network may have some, or some several times.
        cache: rows of intervals.
        aims: objective and budgets.
        dynamics: of the network.
    """

    def __init__(
        self,
        admissible: Admissible,
        degree: int,
        service_weight: float | None,
        like: Future | None = None,
        aims: Aims = NO_AIMS,
    ) -> None:
        """Write down what does not depend on the start; see ``Programs``.

        The network may have other numbers than that of another future and still be ``like`` it: rows that they have in
        common are written once, and its intervals are parts of an episode (``at``).
        """
        self.admissible = admissible
        network = self.network = admissible.lifetimes.network
        self.horizon: int = network.episode.horizon if like is None else like.horizon
        self.cache: IntervalCache = IntervalCache() if like is None else like.cache
        self._shift = 0
        self.aims: Aims = aims if like is None else like.aims
        self._budgets = [budget.account for budget in self.aims.budgets]
        self._ledger, self._discount, self._counts = None, EMPTY, EMPTY
        if not self.aims.is_circular or self._budgets:
            self._ledger = Ledger(network)
            self._discount = self._ledger.discount if like is None else like._discount
            self._counts = self.aims.counts(self._ledger) if like is None else like._counts
            self._rate_tables: RateTables = self._ledger.rates(with_discount=False)
        if like is None:
            self._programs = Programs(admissible, degree, service_weight, constant_shares=False, loose=LOOSE)
        else:
            admissible.lifetimes.cache = like.admissible.lifetimes.cache
            self._programs = Programs(admissible, degree, service_weight, layout=like.layout, cache=self.cache)
        self.layout: Layout = self._programs.layout
        self.dynamics = Dynamics(network)
        self._simulator = WindowSimulator(self.dynamics, admissible.agents)
        self._measure, self._whole = service_measures(network, self.dynamics)
        mixtures, self._arcs = admissible.mixtures, len(network.arcs)
        self._planned_arcs = np.arange(self._arcs) if mixtures is None else mixtures.arcs.ravel()
        contents = [service for service in network.services if service.substance]
        self._contents = np.array([network.services.index(service) for service in contents], dtype=np.intp)
        bands = [[network.interval_means(end) for end in (service.low, service.high)] for service in network.services]
        self._bands = np.array(bands).reshape(-1, 2, network.episode.horizon).transpose(1, 2, 0)
        self._weight = service_weight
        controlled = ~admissible.by_schedule & (admissible.rate[0] < admissible.rate[1]).any(axis=0)
        controlled[admissible.lifetimes.exit_arcs] = False
        donors = admissible.network.donors
        self._markets = np.unique(donors[[*admissible.network.orders]])
        self._exits = np.flatnonzero(np.isin(donors, self._markets))
        self._exit_sum = RowSum(
            np.searchsorted(self._markets, donors[self._exits]), self._exits, 1.0, (len(self._markets), self._arcs)
        )
        self._hold: Integers = np.flatnonzero(controlled) if like is None else like._hold

    def at(self, place: int, interval: int) -> Future:
        """Return the same, with the network's interval ``place`` as an ``interval`` of the episode."""
        future = copy(self)
        future._shift = place - interval
        return future

    def places(self, intervals: range) -> range:
        """Return intervals of an episode as those of the network."""
        return range(intervals.start + self._shift, intervals.stop + self._shift)

    def program(self, task: WindowTask, correction: Correction | None) -> Program:
        """Return the program of a task, corrected by what became of a plan before; its demand is no part of it."""
        places = self.places(task.intervals)
        admissible, period = self.admissible, slice(places.start, places.stop)
        problem = self._programs.program(task.stock, None, places)
        layout, steps = problem.layout, len(task.intervals)
        cost = problem.cost * (steps / self.horizon)
        if self._ledger is not None:
            rates = self._rates(task.intervals, slice(None), self._discount)
            totals = account_rows(admissible.lifetimes, layout, task.stock, rates)[0].toarray()
            cost = -self.aims.objective(-cost, totals)
            if len(task.charges):
                rates = self._rates(task.intervals, self._budgets, self._counts)
                totals = account_rows(admissible.lifetimes, layout, task.stock, rates)[0].toarray()
                cost += (task.charges / self.aims.sizes) @ totals
        cost = cost.reshape(steps, -1)
        if task.later is not None:
            cost += task.later.costs
        problem = replace(problem, cost=cost.ravel())
        if correction is not None:
            rows, error = ProgramRows(layout, steps), correction.error
            rate, valve = correction.rate, correction.valve
            # those of other intervals, or of another future, may be out of range
            rate = np.clip(rate, *admissible.rate[:, period])
            valve = np.clip(valve, *admissible.valve[:, period])
            held_controls(admissible.driver, self._hold, rate, valve, rows)
            low, under_to = problem.low.copy(), problem.under_to.copy()
            rows_of_levels, numbers, weights = level_rows(problem)
            under_to[rows_of_levels] -= weights * error.ravel()[numbers]
            low[level_columns(problem)] = -np.maximum(error, 0.0).ravel()
            matrix = rows.matrices()[0]
            equal = sparse.vstack([problem.equal, matrix], format="csr")
            equal_to = np.append(problem.equal_to, np.zeros(matrix.shape[0]))
            under, leftover = problem.under, self._leftovers(layout, correction.through)
            if leftover is not None:
                under = sparse.vstack([under, leftover.matrices()[0]], format="csr")
                under_to = np.append(under_to, leftover.limits())
            problem = replace(problem, equal=equal, equal_to=equal_to, low=low, under=under, under_to=under_to)
        return problem if task.later is None else with_distance(problem, task.later)

    def _leftovers(self, layout: Layout, through: Floats) -> ProgramRows | None:
        """Return rows by which nodes leave so much beside what is ordered as less passed them than was planned."""
        if not len(self._markets):
            return None
        rows, t = ProgramRows(layout, len(through)), np.arange(len(through))[:, None]
        rest_arcs = np.setdiff1d(self._exits, self.admissible.network.orders)
        row, columns = rows.add(0, t, self._markets), (t * layout.size + layout.flow)[..., None] + rest_arcs
        of = np.searchsorted(self._markets, self.admissible.network.donors[rest_arcs])
        rows.put(row[:, None, of], columns, -1.0 / len(layout.moments))
        rows.limit(row, -np.maximum(through, 0.0))
        return rows

    def _rates(self, intervals: range, accounts: slice | list[int], counts: Floats) -> RateTables:
        """Return the rates of some accounts, times what amounts of each interval of the episode count."""
        places, count = self.places(intervals), counts[:, intervals.start : intervals.stop, None]
        by_flow, by_stock, by_control = (
            rates[accounts, places.start : places.stop] * count for rates in self._rate_tables
        )
        return by_flow, by_stock, by_control

    def aims_of(self, task: WindowTask) -> Aims:
        """Return the aims of a task as those of an episode of its intervals; see ``account_rates``."""
        share, aims, first = len(task.intervals) / self.horizon, self.aims, len(self.network.accounts)
        charges = {account: charge / share for account, charge in aims.charges.items()}
        prices = enumerate((task.charges / (aims.sizes * share)).tolist() if len(task.charges) else (), first)
        amounts = zip(aims.budgets, (task.limits * aims.sizes).tolist(), strict=True) if len(task.limits) else ()
        budgets = tuple(replace(budget, most=most) for budget, most in amounts)
        return Aims(aims.circularity, charges | dict(prices), budgets)

    def account_rates(self, task: WindowTask) -> tuple[RateTables, RateTables] | None:
        """Return the rates of the accounts of ``aims_of`` over a task, and of its budgets; None if none counts.

        What is charged for as it is booked stands after the accounts.
        """
        if self._ledger is None:
            return None
        by_account = self._rates(task.intervals, slice(None), self._discount)
        by_budget = self._rates(task.intervals, self._budgets, self._counts)
        no_budgets = by_budget[0][:0], by_budget[1][:0], by_budget[2][:0]
        if len(task.charges):
            flow, stock, control = (np.concatenate(pair) for pair in zip(by_account, by_budget, strict=True))
            by_account = flow, stock, control
        return by_account, by_budget if len(task.limits) else no_budgets

    def booking_rows(self, problem: Program, task: WindowTask) -> tuple[Any, Floats]:
        """Return rows of what is booked of budgets over the variables of a program, and what they have beside.

        Both are in parts of the budgets; shapes are (budgets, variables) and (budgets,).
        """
        if not self._budgets:
            return sparse.csr_array((0, len(problem.cost))), np.empty(0)
        rates = self._rates(task.intervals, self._budgets, self._counts)
        totals, beside = account_rows(self.admissible.lifetimes, problem.layout, task.stock, rates)
        further = sparse.csr_array((len(self._budgets), len(problem.cost) - totals.shape[1]))
        rows = sparse.diags_array(1.0 / self.aims.sizes) @ totals
        return sparse.hstack([rows, further], format="csr"), beside / self.aims.sizes

    def trial(self, problem: Program, plan: Floats, task: WindowTask) -> WindowTrial:
        """Carry a plan out in the simulator.

        Args:
            problem: the program of the future.
            plan: its variables.
            task: what was planned.
        """
        intervals, admissible, layout = self.places(task.intervals), self.admissible, problem.layout
        variables = plan[: len(intervals) * layout.size].reshape(len(intervals), -1)
        actions = normalised_actions(admissible, layout, variables, task.stock, intervals)
        promise, weight = self._promise(problem, plan, variables)
        outcome = self.carry_out(task, actions, weight)
        bookings = outcome.bookings
        error = np.where(weight > 0, np.clip(promise - outcome.ratio, -1.0, 1.0), 0.0)
        excess = np.zeros_like(bookings)
        if self._budgets:
            rows_of_totals, beside = self.booking_rows(problem, task)
            is_counted = (self._counts[:, task.intervals.start : task.intervals.stop] != 0).T
            more = bookings.sum(axis=0) - rows_of_totals @ plan - beside
            excess += np.where(is_counted, more / np.maximum(is_counted.sum(axis=0), 1), 0.0)
        through = self._exit_sum((layout.means(variables)[1][:, : self._arcs] - outcome.flow).T).T
        return WindowTrial(
            actions,
            outcome.value,
            outcome.level.mean(axis=0),
            Correction(error, excess, through, *self._factors(variables, intervals)),
            bookings,
            variables[:, layout.level : layout.imbalance],
        )

    def carry_out(self, task: WindowTask, actions: Floats, most: Floats | None = None) -> WindowOutcome:
        """Return what the simulator makes of actions, shape (intervals, entries).

        Room of contents is in parts of the ``most`` that there is of a substance, shape (intervals, services); without
        it there is none.
        """
        intervals = self.places(task.intervals)
        stocks, flows_of_all = self._simulator.run(task.stock, actions, intervals.start)
        low, flows = self.admissible.service_low[intervals.start : intervals.stop], flows_of_all[:, : self._arcs]
        masses = np.concatenate([stocks[1:], flows_of_all], axis=1)
        quantity = masses @ self._measure.T
        ratio = np.divide(quantity, low, out=np.ones_like(low), where=low > 0)
        if len(self._contents):
            ratio[:, self._contents] = self._content_levels(quantity, masses @ self._whole.T, intervals, most)
        level, high = np.minimum(ratio, 1.0), self._bands[1, intervals.start : intervals.stop]
        is_over = quantity > high
        is_over[:, self._contents] = False
        np.divide(high, quantity, out=level, where=is_over)
        bookings, amounts = np.zeros((len(intervals), len(self._budgets))), np.zeros((0, len(intervals)))
        accounts = np.zeros(0)
        if self._ledger is not None:  # whose copies are the intervals here
            stores = self.dynamics.rows.stocks(np.append(stocks, np.ones((len(stocks), 1)), axis=1).T)
            deviation, agents = None, self.admissible.agents
            if self._ledger.has_efforts:
                deviation = planned_deviation(self.network, agents, actions, intervals.start)
            entries = self._ledger.entries(
                np.ascontiguousarray(flows.T), stores[:, :-1], stores[:, 1:], deviation, np.array(intervals)
            )
            amounts, period = self._ledger.sums(entries), slice(task.intervals.start, task.intervals.stop)
            accounts = (amounts * self._discount[:, period]).sum(axis=1)
            bookings = (amounts[self._budgets] * self._counts[:, period] / self.aims.sizes[:, None]).T
        value = self._value(task, flows_of_all, stocks[-1], level, accounts)
        if len(task.charges):
            value -= float(task.charges @ bookings.sum(axis=0))
        stock = self.dynamics.rows.stocks(stocks[1:].T).T
        return WindowOutcome(level, ratio, bookings, amounts, accounts, value, stock, flows)

    def _content_levels(self, part: Floats, whole: Floats, intervals: range, most: Floats | None) -> Floats:
        """Return the levels of contents, shape (intervals, contents), of masses, shape (intervals, services)."""
        part, whole = part[:, self._contents], whole[:, self._contents]
        low, high = (ends[intervals.start : intervals.stop, self._contents] for ends in self._bands)
        finite = np.isfinite(high)
        excess = np.maximum(low * whole - part, np.where(finite, part - np.where(finite, high, 0.0) * whole, -np.inf))
        # min(1, content/low, high/content) by what is too little, or too much
        size = np.where(part < low * whole, low * whole, part)
        level: Floats = 1.0 - np.divide(np.maximum(excess, 0.0), size, out=np.zeros_like(size), where=size > 0)
        if most is not None:
            most = most[:, self._contents]
            level -= np.divide(np.minimum(excess, 0.0), most, out=np.zeros_like(most), where=most > 0)
        return level

    def _factors(self, variables: Floats, intervals: range) -> tuple[Floats, Floats]:
        """Return the rates and valves of a plan, the neutral ones where nothing flows; see ``Correction``."""
        admissible, layout = self.admissible, self.layout
        period = slice(intervals.start, intervals.stop)
        stock, flow, through = layout.means(variables)
        rate, valve = admissible.neutral_rate[period].copy(), admissible.neutral_valve[period].copy()
        driver = stock[:, admissible.driver]
        np.divide(flow, driver, out=rate, where=driver > 1e-12 * np.abs(flow))
        held = stock[:, layout.valves]
        valve[:, layout.valves] = np.divide(
            through, held, out=valve[:, layout.valves], where=held > 1e-12 * np.abs(through)
        )
        return np.clip(rate, *admissible.rate[:, period]), np.clip(valve, *admissible.valve[:, period])

    def _promise(self, problem: Program, plan: Floats, variables: Floats) -> tuple[Floats, Floats]:
        """Return q̂/l of a plan and l, of contents 1 − e/m with the excess e and m, shape (intervals, services)."""
        layout = problem.layout
        levels = variables[:, layout.level : layout.imbalance]
        rows, numbers, weights = level_rows(problem)
        # l·level − q̂, of contents m·level + e
        activity = problem.under[rows] @ plan
        ahead, most = np.full(levels.size, np.inf), np.zeros(levels.size)
        np.minimum.at(ahead, numbers, (weights * levels.ravel()[numbers] - activity) / weights)
        np.maximum.at(most, numbers, weights)
        promise = np.where(most > 0, ahead, 0.0).reshape(levels.shape)
        promise[:, self._contents] += 1.0
        return promise, most.reshape(levels.shape)

    def _value(self, task: WindowTask, flows_of_all: Floats, end: Floats, levels: Floats, accounts: Floats) -> float:
        """Return the objective that the simulator reaches, in parts of that of the episode."""
        network, share = self.network, len(flows_of_all) / self.horizon
        flows = flows_of_all[:, : self._arcs]
        weights = network.circularity_weights
        per_interval = flows @ weights.sum(axis=0)
        if network.objective.net_zero == "abs":
            per_interval = flows @ weights[0] - np.abs(flows @ weights[1])
        value = float(self.aims.objective(per_interval.mean() * share, accounts))
        if self._weight is not None:
            value = value / network.objective.circularity_scale
            value += self._weight * share * float(levels.mean()) if levels.size else 0.0
        if task.later is not None:
            value -= self._later_cost(task.later, flows_of_all, self.admissible.lifetimes.start_planned @ end)
            if not task.is_redrawn:  # else all that lacks has its price
                value -= float(np.sum(task.later.costs[:, self.layout.level : self.layout.imbalance] * levels))
        return value

    def later(self, task: WindowTask) -> Later | None:
        """Return what a task charges for what is left to later intervals, but for its distance from their plan."""
        if task.later is None:
            return None
        layout, costs, nodes = self.layout, task.later.costs, self.dynamics.rows.nodes.stop
        arcs = self._planned_arcs
        by_flow = np.sum([costs[:, first + arcs] for first in layout.flow.tolist()], axis=0)
        # of a whole flow what is no substance, and beside it by how much each substance differs
        by_flow[:, self._arcs :] -= np.tile(by_flow[:, : self._arcs], len(arcs) // self._arcs - 1)
        cost = np.zeros((len(costs), nodes + self._arcs * self.dynamics.rows.components))
        cost[:, nodes : nodes + len(arcs)] = by_flow
        cost[-1, :nodes] = costs[-1, layout.last] @ self.admissible.lifetimes.start_planned
        return Later(cost, costs[:, layout.level : layout.imbalance] * (not task.is_redrawn))

    def _later_cost(self, later: Continuation, flows: Floats, end: Floats) -> float:
        """Return what an episode of the simulator leaves to later intervals, by its last stocks and its mean flows."""
        layout, arcs = self.layout, self._planned_arcs
        flows = flows[:, : len(arcs)].copy()
        for first in range(self._arcs, len(arcs), self._arcs):  # of what is no substance, then of each
            flows[:, : self._arcs] -= flows[:, first : first + self._arcs]
        by_flow = sum(later.costs[:, first + arcs] for first in layout.flow.tolist())
        price = later.costs[-1, layout.last]
        distance = DISTANCE * np.abs(price) @ np.abs(end - later.stocks)
        return float(price @ end + distance + np.sum(by_flow * flows))


class WindowPlanner:
    """Plans windows of a network, the better ones of which are found by trying them.

    Attributes:
        futures: that are planned for, with the same stocks and disturbances in the first interval of a window.
        first_price: of each budget by which it is exceeded, and of a unit of each service that an episode lacks, in the
            objective, shape (budgets + services,).
    """

    def __init__(self, futures: Sequence[Future], service_weight: float | None) -> None:
        """Plan for some futures of a network."""
        self.futures, self._weight = tuple(futures), service_weight
        network, self._horizon = futures[0].network, futures[0].horizon
        # with a service weight the objective is in parts of the scale
        aims, size = futures[0].aims, network.objective.circularity_scale
        self._scale = 1.0 if service_weight is not None else size
        if aims.charges:
            ledger, (low, neutral, high) = Ledger(network), network.control_bounds
            scales = [np.array([[part.scale] for part in parts]) for parts in (network.arcs, network.stores)]
            furthest = np.maximum(high - neutral, neutral - low).max(axis=1)[:, None]
            scales.append(ledger.convex_parts(scales[0], scales[1], furthest if ledger.has_efforts else None))
            pairs = zip(ledger.rates(), scales, strict=True)
            accounts = sum((np.abs(rate) @ scale[:, 0]).sum(axis=1) for rate, scale in pairs)
            self._scale = size = aims.size(network, np.asarray(accounts))
        slack_count = len(aims.budgets) + len(network.services)
        self.first_price = np.full(slack_count, FIRST_PRICE * size)

    def plan(
        self, task: WindowTask, basis: Basis | None, carried_out: int, most_rounds: int = MOST_ROUNDS
    ) -> WindowPlan:
        """Return the best plan that is found, of which the first intervals will be ``carried_out``.

        Raises:
            SolverFailure: if the solver fails before there is a plan.
        """
        near = FALLS_SHORT * self._scale
        trial = best = self._first_trial(task, basis)
        task = replace(task, corrections=trial.task.corrections)
        for done in range(1, most_rounds + 1):
            # beside budgets prices of service rise with theirs, and plans are compared at the same ones
            if trial.merit > (self._merit(best, trial.task.price) if len(task.limits) else best.merit):
                best = trial
            promise = -float(trial.problem.cost @ trial.solution.plan)
            is_large = len(trial.problem.cost) >= LARGE_PROGRAM  # each program starts from nothing
            is_near = task.is_redrawn or promise - best.merit <= near
            if (done >= ROUNDS and is_near) or (is_large and (task.is_outlook or done == LARGE_ROUNDS)):
                break
            if task.corrections is not None:
                pairs = [*zip(trial.corrections, task.corrections, strict=True)]
                error = np.mean(
                    [(now.error - before.error)[:carried_out].mean(axis=0) for now, before in pairs], axis=0
                )
                excess = sum((now.excess - before.excess).sum(axis=0) for now, before in pairs) / len(pairs)
                if np.abs(error).max(initial=0.0) <= TOLERANCE and np.abs(excess).max(initial=0.0) <= EXCEEDED:
                    break
            if done < most_rounds:
                task = replace(trial.task, corrections=trial.corrections)
                try:
                    trial = self._trial(task, trial.basis(task.intervals))
                except (Infeasible, SolverFailure):  # what was learnt leaves no further plan
                    break
        return best

    def _first_trial(self, task: WindowTask, basis: Basis | None) -> WindowPlan:
        """Try a plan with what was learnt in a window before, or without where that leaves none that serves.

        Controls of intervals that no window had are expected to be as in the last one, which may be out of their range.
        """
        if task.corrections is not None:
            try:
                trial = self._trial(task, basis, rises=0)
            except (Infeasible, SolverFailure):
                return self._trial(replace(task, corrections=None), None)
            first = len(trial.solution.plan) - self._slack_count(task)
            is_priced = task.later is not None or task.is_redrawn
            if is_priced or trial.solution.plan[first:].max(initial=0.0) <= SHORTFALL:
                return trial
            task, basis = replace(task, corrections=None), None
        return self._trial(task, basis)

    def _trial(self, task: WindowTask, basis: Basis | None, rises: int = RISES) -> WindowPlan:
        """Solve the program of a task and carry its plan out in the simulator."""
        corrections = task.corrections or (None,) * len(self.futures)
        parts = [f.program(task, correction) for f, correction in zip(self.futures, corrections, strict=True)]
        pairs = [future.booking_rows(part, task) for future, part in zip(self.futures, parts, strict=True)]
        limits = task.limits
        if len(limits):
            limits = limits - np.mean([beside for _, beside in pairs], axis=0)
            if task.corrections is not None:
                limits = limits - np.mean([correction.excess.sum(axis=0) for correction in task.corrections], axis=0)
        joint = JointProgram.of(parts, task.demand, [rows for rows, _ in pairs], limits)
        task, solution = self._solve(joint.problem, task, basis, rises)
        triples = zip(self.futures, parts, joint.columns, strict=True)
        trials = [future.trial(part, solution.plan[columns], task) for future, part, columns in triples]
        value, level = float(np.mean([t.value for t in trials])), np.mean([t.level for t in trials], axis=0)
        bookings = np.mean([t.bookings for t in trials], axis=0)
        promised = np.mean([trial.promised for trial in trials], axis=0)
        corrections = tuple(trial.correction for trial in trials)
        reached = (promised, level, bookings, value)
        plan = WindowPlan(task, joint.problem, solution, trials[0].actions, corrections, *reached, merit=0.0)
        return replace(plan, merit=self._merit(plan, task.price))

    def better_of(self, plan: WindowPlan, actions: Sequence[Floats]) -> WindowPlan:
        """Return a plan, or in its place other actions of its intervals if they do better at the same prices.

        Where demands have to be met they must not lack more, however much that saves. Actions are those in each future,
        shape (intervals, entries), the first of which are the same in all.
        """
        other = self.with_actions(plan, actions)
        tolerance = ROUGH_SHORTFALL * self._slack_count(plan.task)  # a climb ends where each lacks as little
        if plan.task.has_to_serve:
            (lack, shortage), (new_lack, new_shortage) = self._shortages(plan), self._shortages(other)
            if max(new_lack - lack, new_shortage - shortage) > tolerance:
                return plan
            if len(plan.task.limits) and shortage - new_shortage > NOTABLE:
                return other
        return other if other.merit > self._merit(plan, plan.task.price) else plan

    def with_actions(self, plan: WindowPlan, actions: Sequence[Floats]) -> WindowPlan:
        """Return a plan with other actions, and what comes of them; see ``better_of``."""
        outcomes = [future.carry_out(plan.task, course) for future, course in zip(self.futures, actions, strict=True)]
        levels = np.mean([outcome.level for outcome in outcomes], axis=0)
        bookings = np.mean([outcome.bookings for outcome in outcomes], axis=0)
        value = float(np.mean([outcome.value for outcome in outcomes]))
        figures = {"levels": levels, "level": levels.mean(axis=0), "bookings": bookings, "value": value}
        other = replace(plan, actions=actions[0], **figures)
        return replace(other, merit=self._merit(other, plan.task.price))

    def is_short(self, plan: WindowPlan) -> bool:
        """Return whether a plan lacks more of services, or exceeds budgets by more, than further steps are worth."""
        return self._shortages(plan)[1] > ROUGH_SHORTFALL

    def at_price(self, plan: WindowPlan, price: Floats) -> WindowPlan:
        """Return a plan at another price of what is exceeded and lacks, shape (budgets + services,)."""
        return replace(plan, task=replace(plan.task, price=price), merit=self._merit(plan, price))

    def _shortages(self, plan: WindowPlan) -> tuple[float, float]:
        """Return the sum of what services lack, and that with the parts by which budgets are exceeded."""
        task = plan.task
        lack = 0.0 if task.demand is None else np.maximum(0.0, task.demand - plan.level).sum()
        excess = np.maximum(0.0, plan.bookings.sum(axis=0) - task.limits).sum() if len(task.limits) else 0.0
        return float(lack), float(lack + excess)

    def _merit(self, plan: WindowPlan, price: Floats) -> float:
        """Return the objective of a plan, less what it exceeds and lacks at a price, shape (budgets + services,)."""
        task, budgets, merit = plan.task, len(plan.task.limits), plan.value
        if budgets:
            merit -= float(price[:budgets] @ np.maximum(0.0, plan.bookings.sum(axis=0) - task.limits))
        if task.demand is not None:
            share = len(task.intervals) / self._horizon
            merit -= float(price[budgets:] @ np.maximum(0.0, task.demand - plan.level)) * share
        return merit

    def _slack_count(self, task: WindowTask) -> int:
        """Return how many budgets and services have a variable for what is exceeded or lacks."""
        return len(task.limits) + (0 if task.demand is None else len(task.demand))

    def _solve(
        self, problem: Program, task: WindowTask, basis: Basis | None, rises: int
    ) -> tuple[WindowTask, Solution]:
        """Solve a program, with a higher price of what lacks as long as that helps; the task comes back with it."""
        size = len(problem.cost), len(problem.equal_to) + len(problem.under_to)
        if basis is not None and (len(basis.columns), len(basis.rows)) != size:
            basis = None  # of a program with other rows
        label = f"the program of MPC for decisions {task.intervals.start} to {task.intervals.stop - 1}"
        slack_count, price, least, same_rows = self._slack_count(task), task.price, None, False
        # a level that lacks counts as the part of the episode that it lacks in
        share = np.repeat(
            [1.0, len(task.intervals) / self._horizon], [len(task.limits), slack_count - len(task.limits)]
        )
        is_rough = task.is_outlook and len(problem.cost) >= LARGE_PROGRAM
        run = partial(solve, label=label, certify=task.is_outlook and not is_rough, is_rough=is_rough)
        shortfall = ROUGH_SHORTFALL if is_rough else SHORTFALL
        if not slack_count:
            return task, run(problem, basis)
        solution = self._all_demanded(problem, run, slack_count) if is_rough else None
        for rise in range(rises + 1 if solution is None else 0):
            problem.cost[-slack_count:] = price * share
            solution = run(problem, basis, same_rows=same_rows, is_near=task.is_redrawn)
            lack, basis, same_rows = solution.plan[-slack_count:], solution.basis, solution.basis is not None
            # what comes after was priced beside this price: another one would weigh the two differently
            has_fixed_price = task.later is not None or is_rough or (task.is_redrawn and not task.is_outlook)
            if lack.max() <= shortfall or has_fixed_price or rise == rises:
                break
            if least is None:
                only_lack = replace(problem, cost=np.repeat([0.0, 1.0], [len(problem.cost) - slack_count, slack_count]))
                least = run(only_lack, basis, certify=False, same_rows=same_rows).plan[-slack_count:].sum()
            if lack.sum() <= least + shortfall * slack_count:
                break
            price = np.where(lack > shortfall, price * RISE, price)
        assert solution is not None
        if task.is_outlook:  # what turns out dearer within windows is not left undone
            multipliers, lack = -solution.certificate.under[-slack_count:], solution.plan[-slack_count:]
            price = np.where(lack > shortfall, price, np.maximum(price, FIRST_PRICE * multipliers))
        return replace(task, price=price), solution

    def _all_demanded(
        self, problem: Program, run: Callable[[Program, None], Solution], slack_count: int
    ) -> Solution | None:
        """Return the optimum of a program in which no service or budget may lack anything; None if there is none.

        Of a large program it is tried first: where prices of service are far above all other costs, HiPO stops early.
        """
        cost, high = problem.cost.copy(), problem.high.copy()
        cost[-slack_count:], high[-slack_count:] = 0.0, 0.0
        try:
            return run(replace(problem, cost=cost, high=high), None)
        except (Infeasible, SolverFailure):
            return None
