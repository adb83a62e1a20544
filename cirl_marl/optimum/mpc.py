"""Model predictive control with the program of the bound.

Every ``replan`` decisions each copy solves the linear program of ``cirl_marl.optimum`` from its true current stocks,
tries the plan in the simulator, corrects it (``window_planner``), and carries out the first planned actions. Nothing is
random.

A receding window ends before the episode does. What comes after it is priced by the multipliers y of the program of the
whole episode, solved once from the start of the episode: the rows of the interval after the window are moved into the
objective, c' = c − Aᵀy, which leaves a price on each stock at the window's end and on what goes into use. By duality
this is an upper bound on what those are worth to the rest of the episode, exact along its plan, so that nothing is run
down because the window ends. Prices that are linear leave many plans equal; of these the one that ends nearest to the
plan of the episode is taken. With ``horizon=None`` the window shrinks with what is left of the episode.

Where nobody foresees what disturbs the network, a plan is for the conditional means of the disturbances given their
present states (certainty equivalence), or for several futures drawn from there, whose first interval is the same
(scenario MPC). Prices are then those of one episode in which all is as expected from the start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import field, replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Arrays, Planner
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError, whole_number
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import CIRCULARITY, is_of_circularity
from cirl_marl.network.innovations import innovations
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.aims import Aim, Aims, aims_of
from cirl_marl.optimum.bounds import out_of_reach
from cirl_marl.optimum.draws import Prices
from cirl_marl.optimum.futures import DrawnFutures
from cirl_marl.optimum.improve import start_count, starting_actions
from cirl_marl.optimum.options import (
    check_margin,
    check_options,
    demanded_levels,
    lack_texts,
    starting_stocks,
    with_margin,
)
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.slopes import MOST_SLOPES, slopes_of
from cirl_marl.optimum.solver import Infeasible, SolverFailure
from cirl_marl.optimum.window_climb import climb_window
from cirl_marl.optimum.window_planner import FIRST_PRICE, MOST_ROUNDS, NOTABLE, RISE, Future, WindowPlanner
from cirl_marl.optimum.windows import EMPTY, Continuation, WindowPlan, WindowTask

SERVICE_FIRST = 1000.0
"""Weight of the mean service level, against λ̄/circularity_scale, at which service comes first."""
LEAST_PRICE = 0.1
"""Least that is charged in a disturbed network for a unit of service that lacks, and for a budget of the episode that
is exceeded by itself, in λ̄/circularity_scale."""
WINDOW = 3
"""Decisions that a plan looks ahead where the network is disturbed, unless another number is asked for. What comes
after them has its price, and nobody knows it: on paper_city and steel_japan longer windows did no better."""
FROM_START = "MPC: budgets per year need every interval of an episode, from its start on"
LEAD = 0.05
"""Part by which less than the demanded level has to be enough for the rest of a disturbed episode with yearly budgets,
before a service costs no more than in the plan of the expected episode."""
SPREAD = 0.5
"""ε: the part by which a budget of a disturbed episode is dearer beyond its plan, and cheaper below."""
FIRST_SAMPLE, SAMPLES = 2**30, 256
"""First seed and number of the paths over which what is expected of their functions is averaged."""


@positional_record
class _Plan:
    """What one copy carries out."""

    episode: Annotated[int, "of the copy, by its number"]
    first: Annotated[int, "interval of the episode in which the actions begin"]
    actions: Annotated[Floats, "of the next intervals, shape (decisions, entries)"]
    window: Annotated[WindowPlan | None, "what they are the first of; None if nothing could be planned"]


@positional_record
class _Demands:
    """What services and budgets ask of some intervals."""

    deficit: Annotated[Floats | None, "least sum of levels, shape (services,); None if nothing is demanded"]
    limits: Annotated[Floats, "highest totals, in parts of budgets; empty for none"] = field(
        default_factory=lambda: EMPTY
    )
    charges: Annotated[Floats, "of totals, in parts of budgets; empty for none"] = field(default_factory=lambda: EMPTY)
    price: Annotated[Floats | None, "see ``WindowTask``; None: as in the plan before"] = None


class _Bookings:
    """What was booked of each budget in each copy, followed from interval to interval for those per year."""

    def __init__(self, aims: Aims, env: MultiAgentVectorEnv) -> None:
        """Begin with what the episodes of ``env`` have booked so far.

        Raises:
            ControlError: if a budget is per year and an episode has begun.
        """
        self._aims, self._env, self._counts = aims, env, aims.counts(env.ledger)
        self._accounts = [budget.account for budget in aims.budgets]
        self._by_year = np.flatnonzero(aims.by_year)
        self._step, self._totals = env.physical.step.copy(), env.physical.accounts.copy()
        if len(self._by_year) and self._step.any():
            raise ControlError(FROM_START)
        self._in_years = np.zeros((len(self._by_year), env.num_envs))

    def follow(self, is_new: Sequence[bool]) -> None:
        """Take what the interval before booked in each copy, or nothing where an episode is new.

        Raises:
            ControlError: if a budget is per year and an interval was left out.
        """
        state, ledger = self._env.physical, self._env.ledger
        moved = np.flatnonzero((state.step != self._step) & ~np.array(is_new))
        if len(self._by_year) and (state.step[moved] != self._step[moved] + 1).any():
            raise ControlError(FROM_START)
        before, accounts = self._step[moved], np.array(self._accounts, dtype=np.intp)[self._by_year]
        change = (state.accounts - self._totals)[accounts][:, moved]
        amounts = change / ledger.discount[accounts][:, before]
        self._in_years[:, moved] += amounts * self._counts[self._by_year][:, before]
        self._in_years[:, is_new] = 0.0
        self._step, self._totals = state.step.copy(), state.accounts.copy()

    def remainders(self, copy: int) -> Floats:
        """Return what is left of each budget, shape (budgets,)."""
        remainder = self._aims.limits - self._totals[self._accounts, copy]
        remainder[self._by_year] = self._aims.limits[self._by_year] - self._in_years[:, copy]
        return remainder

    def limits(self, copy: int, window: range, reference: Floats) -> tuple[Floats, Floats]:
        """Return what a window may book of each budget, and which part of what is left of its time it has.

        Args:
            copy: whose.
            window: intervals.
            reference: what a plan of the episode books, in parts of budgets, shape (horizon, budgets).
        """
        counts = (self._counts != 0).T
        rest, within = counts[window.start :].sum(axis=0), counts[window.start : window.stop].sum(axis=0)
        share = within / np.maximum(rest, 1)
        left = self.remainders(copy) / self._aims.sizes - reference[window.start :].sum(axis=0)
        return reference[window.start : window.stop].sum(axis=0) + share * left, share


class MPC(Planner):
    """Plans again and again from the current stocks; each copy has its own plan.

    The objective is λ̄ of the episode; with ``service_weight`` w, λ̄/circularity_scale + w·service. With ``min_service``
    the mean level of each service over the whole episode is held at the demanded level or above: what the past
    intervals lacked the planned ones have to make up for. What is out of reach is asked for as far as it can be had; no
    service counts beyond its demand. A service that arcs make up for while nobody acts on them is planned in full, as
    they will supply it.

    An ``aim`` and budgets are those of ``bound``: what past intervals booked the planned ones have no more of. Whether
    a budget is kept depends on all that is to come, so that plans look to the end of the episode.

    In a disturbed network ``min_service`` is of the *expected* levels: what lacks in any interval is charged for at the
    multipliers of the plan for what is expected, or those of the ``prices``, whatever was delivered before. Budgets per
    year hold in each copy as far as they can: with what is booked already a window may book what is left of the year,
    less what is planned for after it, with an equal part of the deviation for each interval to come. Beside them a
    service that is not ahead of its demand is dearer. Budgets of the episode hold in expectation: what is booked costs
    (1 − ε) of their multiplier, and what a window has beyond such a part (1 + ε). So a copy pays nearly the same
    wherever it is, and returns to the plan where the multiplier leaves the choice open. That is within some percent;
    margins on both prices (``compare`` with ``tune``) make means what is demanded.
    """

    ahead = 0.1  # a first plan takes longer than the later ones, which start from it

    def __init__(
        self,
        *,
        horizon: int | None = None,
        min_service: ArrayLike | None = None,
        service_weight: float | None = None,
        aim: Aim = CIRCULARITY,
        at_most: Mapping[str, float] | None = None,
        degree: int = 1,
        replan: int | None = None,
        futures: int | None = None,
        margin: ArrayLike = 1.0,
        budget_margin: float = 1.0,
        prices: Prices | None = None,
        delay: int = 0,
        reserve: float = 1.0,
    ) -> None:
        """Choose what is planned.

        Args:
            horizon: decisions that a plan looks ahead; None looks to the end of the episode, in a disturbed network
                WINDOW ahead.
            min_service: mean level demanded, in [0, 1], of every service, or of each, shape (services,); excludes
                ``service_weight``.
            service_weight: w ≥ 0; goes with the aim ``circularity``.
            aim: see ``bound``.
            at_most: budgets, likewise; in a certain network without a ``horizon``.
            degree: degree of the test polynomials; see ``bound``.
            replan: decisions carried out of each plan; None: 4, in a disturbed network 1.
            futures: how many are drawn at every decision in a disturbed network; None: one, in which all is as it is
                expected to be.
            margin: by what the demanded bands of services are multiplied in plans, or in a disturbed network what is
                charged for service that lacks; of every service, or of each, shape (services,).
            budget_margin: by what the multipliers of budgets of a disturbed episode are multiplied.
            prices: of a bound for who does not foresee (``bound(…, uncertain=True)``): a plan then looks a single
                interval ahead, and what stocks are worth after it follows the states of the disturbances.
            delay: intervals by which disturbances are seen late; from the horizon on they are never seen.
            reserve: by what the lower ends of services are multiplied in plans of a disturbed network, but for the
                coming interval. Conditional means ask for nothing to be kept back; this does.

        Raises:
            CirlError: for an option that cannot be used.
        """
        check_options(service_weight, min_service, degree)
        check_margin(margin)
        check_margin(budget_margin, "budget_margin")
        check_margin(reserve, "reserve")
        if prices is not None and (not is_of_circularity(aim) or at_most):
            raise CirlError("prices are those of λ̄ and service: leave out aim and at_most")
        if service_weight is not None and not is_of_circularity(aim):
            raise CirlError(f"service_weight goes with the aim '{CIRCULARITY}', not with {aim!r}; demand min_service")
        if futures is not None and replan not in (None, 1):
            raise CirlError(f"replan {replan}: of a plan for several futures only the first decision is carried out")
        if prices is not None and (horizon, futures) != (None, None):
            raise CirlError("prices are for plans of a single interval; leave out horizon and futures")
        if whole_number("delay", delay, 0) and (prices, futures) != (None, None):
            raise CirlError(f"delay {delay}: goes with plans for conditional means; leave out prices and futures")
        for name, value in (("replan", replan), ("horizon", horizon), ("futures", futures)):
            if value is not None:
                whole_number(name, value, 1)
        if horizon is not None and horizon < (replan or 1):
            raise CirlError(f"horizon {horizon} is shorter than the {replan} decisions carried out of each plan")
        self._options = horizon, replan, futures
        self._prices, self._delay, self._reserve = prices, delay, reserve
        self._margin, self._budget_margin, self._aim, self._at_most = margin, budget_margin, aim, at_most
        self._min_service, self._weight, self._degree = min_service, service_weight, degree

    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Make the first plan of every copy; ``seed`` has no effect.

        Raises:
            NoCertificate: for a network whose flows are not linear laws; see ``bound``.
            CirlError: for another number of demanded levels, or of margins, than services.
        """
        network, (horizon, replan, futures) = env.network, self._options
        self._aims = aims = aims_of(network, self._aim, self._at_most)
        self._levels = None if self._min_service is None else demanded_levels(network, self._min_service)
        margins = network.by_service("margin", self._margin, "a margin")
        self._climbs = any(service.substance for service in network.services)
        self.note, self._env, is_disturbed = "", env, bool(network.disturbed)
        if self._prices is not None and len(self._prices.service) > len(network.services):
            raise CirlError("prices: those of a bound with budgets, which no plan of one interval can keep")
        if self._reserve != 1.0 and not is_disturbed:
            raise CirlError(f"reserve {self._reserve:g}: nothing is disturbed in '{network.name}'; take a margin")
        if horizon is not None and aims.budgets and not is_disturbed:
            raise CirlError(f"horizon {horizon}: whether a budget is kept depends on the whole episode; leave it out")
        self._horizon = (WINDOW if self._prices is None else 1) if horizon is None and is_disturbed else horizon
        self._replan = (1 if is_disturbed else 4) if replan is None else replan
        if self._prices is not None:
            paths = network.processes.sample(range(FIRST_SAMPLE, FIRST_SAMPLE + SAMPLES)).states
            self._mean_features = innovations(network.processes, paths[:-1]).features.mean(axis=2)
        expected, self._planners = self._future_as_expected(), dict[int, WindowPlanner]()
        self._planner, self._drawn = WindowPlanner([expected], self._weight), None
        if is_disturbed:
            self._drawn = DrawnFutures(env, expected, self._degree, self._weight, futures, self._delay, self._reserve)
        dynamics, shape = expected.dynamics, (network.episode.horizon, len(env.actuators.control_rows))
        self._follows = self._climbs and not is_disturbed and slopes_of(shape, dynamics) <= MOST_SLOPES
        supplies = {arc.makes_up_for for arc in network.arcs if arc.makes_up_for and arc.id not in env.agents}
        self._full = np.array([service.id in supplies for service in network.services], dtype=bool)
        self._outlooks: dict[int, WindowPlan] = {}
        self._common_outlook: WindowPlan | None = None
        self._price = np.zeros(0)
        self._bookings = _Bookings(aims, env)
        is_short = self._horizon is not None and self._horizon < network.episode.horizon
        if is_disturbed and (is_short or self._levels is not None or aims.budgets):
            self._common_outlook = outlook = self._expected_outlook()
            multipliers = -outlook.solution.certificate.under[len(outlook.problem.under_to) - len(network.services) :]
            if self._prices is not None:
                multipliers = self._prices.service
            if self._levels is not None:
                least = LEAST_PRICE * network.objective.circularity_scale
                self._price = margins * np.maximum(multipliers, least)
                if self._climbs:
                    self._price = margins * outlook.task.price[len(aims.budgets) :]
        self._plans = []
        self._look_ahead(range(env.num_envs))
        for copy in range(env.num_envs):
            self._plans.append(self._next(copy, None))
            self._note_faults(self._common_outlook or self._outlooks.get(copy) or self._plans[copy].window)
            progress((copy + 1) / env.num_envs)

    def _note_faults(self, plan: WindowPlan | None) -> None:
        """Say what a first plan of all intervals exceeds of a budget, what it lacks of a service, and if it has to."""
        if plan is None or self.note:
            return
        network = self._env.network
        excess, units = plan.bookings.sum(axis=0) - plan.task.limits, [account.unit for account in network.accounts]
        pairs = zip(self._aims.budgets, excess.tolist(), strict=True)
        faults = [
            f"{part:.2%} more {budget.name}" if budget.most else f"{part:.4g} {units[budget.account]} of {budget.name}"
            for budget, part in pairs
            if part > NOTABLE
        ]
        if plan.task.demand is not None:
            faults += lack_texts(network, plan.task.demand, plan.level)
        if faults:
            demands = "services and budgets" if self._aims.budgets else "services"
            self.note = f"no plan was found that keeps {demands}; this one has {', '.join(faults)}"
        if faults and self._aims.budgets and not (network.disturbed or self._env.uncertain):
            programs = Programs(Admissible.of(network, self._env.agents), self._degree, None)
            reason = out_of_reach(programs, plan.task.stock, self._levels, self._aims)
            self.note += f"; {reason}" if reason else ""

    def act(self, observations: Arrays) -> Arrays:
        """Return the next actions, from the current state of the environment that was started.

        Raises:
            ControlError: after the end of the episode.
        """
        env, steps, plans = self._env, self._env.physical.step.tolist(), self._plans
        is_new = [plan.episode != env.episodes[copy] for copy, plan in enumerate(plans)]
        over = [
            new or not 0 <= step - p.first < len(p.actions) for new, step, p in zip(is_new, steps, plans, strict=True)
        ]
        self._bookings.follow(is_new)
        self._look_ahead(copies := np.flatnonzero(over).tolist())
        for copy in copies:
            plans[copy] = self._next(copy, None if is_new[copy] else plans[copy])
        actions = [plan.actions[step - plan.first] for step, plan in zip(steps, plans, strict=True)]
        return env.unstack(np.stack(actions, axis=1))

    def _next(self, copy: int, last: _Plan | None) -> _Plan:
        """Plan for one copy from its current stocks, after the ``last`` plan of its episode."""
        state, steps = self._env.physical, self._env.network.episode.horizon
        step = int(state.step[copy])
        if step >= steps:
            raise ControlError(f"MPC: the episode is over after {steps} steps: call reset()")
        rest = self._rest(step)
        window = rest if self._horizon is None else rest[: self._horizon]
        earlier = None if last is None else last.window
        try:
            planned = self._solve_window(copy, rest, window, earlier)
        except (Infeasible, SolverFailure) as failure:
            self.note = f"MPC goes on as it planned before, or neutrally, where a plan is missing: {failure}"
            return self._older(copy, step, earlier)
        return _Plan(int(self._env.episodes[copy]), step, planned.actions[: self._replan], planned)

    def _solve_window(self, copy: int, rest: range, window: range, last: WindowPlan | None) -> WindowPlan:
        """Plan the ``window`` of what is left of the episode, the ``rest``."""
        state, steps = self._env.physical, self._env.network.episode.horizon
        deficit, outlook = None, self._common_outlook
        if self._levels is not None:
            deficit = self._levels * steps - state.service[:, copy]
        if outlook is None:
            demands = _Demands(deficit, self._bookings.remainders(copy) / self._aims.sizes)
        else:
            if deficit is not None and not self._climbs:  # no level is demanded, all that lacks has its price
                deficit = np.full(len(deficit), float(len(rest)))
            demands = _Demands(deficit, price=self._price)
            if self._aims.budgets:
                limits, share = self._bookings.limits(copy, window, outlook.bookings)
                part = np.where(self._aims.by_year, share < 1, self._budget_margin * (1.0 - SPREAD))
                charges = part * outlook.charges
                demands = _Demands(deficit, limits, charges, self._present_price(copy, outlook))
        if last is None:
            self._outlooks.pop(copy, None)
        if self._follows:
            return self._follow(copy, rest, demands, last)
        if len(window) == len(rest):
            return self._plan(copy, window, demands, last)
        if outlook is None and copy not in self._outlooks:
            self._outlooks[copy] = self._plan(copy, rest, demands, None, is_outlook=True)
        outlook = outlook or self._outlooks[copy]
        if deficit is not None:
            after = window.stop - outlook.task.intervals.start
            later_levels = outlook.levels[after:].sum(axis=0)
            if self._common_outlook is not None and self._levels is not None:
                later_levels = (self._levels if self._climbs else 1.0) * (steps - window.stop)
            demands = replace(demands, deficit=deficit - later_levels)
        later = outlook.continuation(window)
        if self._prices is not None:
            later = replace(later, costs=self._state_costs(later.costs, copy, window))
        return self._plan(copy, window, demands, last or outlook, later)

    def _follow(self, copy: int, rest: range, demands: _Demands, last: WindowPlan | None) -> WindowPlan:
        """Plan the rest of an episode in which contents count; within the horizon it may leave the plan before.

        What a window leaves is worth what comes of it if that plan goes on then. In prices of the program substances
        would go separate ways. The first plan begins from as many actions as ``improve_plan``.
        """
        planner, (future,) = self._planner, self._planner.futures
        if last is None:
            plan, free = self._plan(copy, rest, demands, None), None
            starts = start_count(future.network, slopes_of(plan.actions.shape, future.dynamics))
        else:
            ahead, free, starts = rest.start - last.task.intervals.start, self._horizon, 1
            task = self._task(planner, self._stock(copy), rest, demands, last)
            plan = planner.with_actions(replace(last, task=task), [last.actions[ahead:]])
        for actions in starting_actions(plan.actions, starts):
            course, price = climb_window(future, plan.task, actions, self._weight, free)
            plan = planner.at_price(plan, np.maximum(price, plan.task.price))
            plan = planner.better_of(plan, [course])
        return plan

    def _present_price(self, copy: int, outlook: WindowPlan) -> Floats:
        """Return what a disturbed copy is charged for budgets that are exceeded and for services that lack.

        Budgets of years come first. Beside them a service is dearer until what was delivered is ahead of its demand.
        """
        aims, service_price = self._aims, self._price
        least = LEAST_PRICE / FIRST_PRICE * self._planner.first_price[: len(aims.budgets)]
        beyond = 2.0 * SPREAD * self._budget_margin * np.maximum(outlook.charges, least)
        if self._levels is not None and aims.has_years:
            state, steps = self._env.physical, self._env.network.episode.horizon
            rest = (self._levels * steps - state.service[:, copy]) / (steps - state.step[copy])
            service_price = service_price * np.where(rest >= (1.0 - LEAD) * self._levels, FIRST_PRICE, 1.0)
        of_years = RISE * outlook.task.price[: len(aims.budgets)]
        return np.append(np.where(aims.by_year, of_years, beyond), service_price)

    def _state_costs(self, costs: Floats, copy: int, window: range) -> Floats:
        """Return the costs of what comes after a window, with prices that follow the states of the disturbances.

        What a stock is worth then, beside what it is on average, is E[Σ_f θ_f φ_f(s_{t+1}) | s_t], less its mean.
        """
        assert self._prices is not None
        processes, step = self._env.network.processes, window.stop - 1
        state = self._env.physical.processes[step, :, [copy]].T
        now = innovations(processes, np.stack([state, state]))
        table = np.zeros((len(self._mean_features) - 1, now.features.shape[1]))
        table[step] = (now.features[1] - now.new[0])[:, 0] - self._mean_features[step + 1]
        (future,), costs = self._planner.futures, costs.copy()
        costs[-1, future.layout.last] -= self._prices.weights(table)[step] @ future.admissible.lifetimes.totals
        return costs

    def _older(self, copy: int, step: int, last: WindowPlan | None) -> _Plan:
        """Return the last plan or that of the episode, to be carried out for longer; neutral actions without either."""
        episode = int(self._env.episodes[copy])
        for plan in (last, self._outlooks.get(copy, self._common_outlook)):
            if plan is not None and step in plan.task.intervals:
                first = step - plan.task.intervals.start
                return _Plan(episode, step, plan.actions[first : first + self._replan], plan)
        return _Plan(episode, step, np.tile(self._neutral_entries(copy), (self._replan, 1)), None)

    def _plan(
        self,
        copy: int,
        intervals: range,
        demands: _Demands,
        last: WindowPlan | None,
        later: Continuation | None = None,
        *,
        is_outlook: bool = False,
    ) -> WindowPlan:
        """Plan some intervals.

        Args:
            copy: whose stocks they start from.
            intervals: to be planned.
            demands: what services and budgets ask of them.
            last: plan before, from whose basis the solver starts.
            later: what comes after; None at the end of the episode.
            is_outlook: whether the multipliers must be good, as they are the prices of later plans.
        """
        planner = self._planner if is_outlook or self._drawn is None else self._planners[copy]
        task = self._task(planner, self._stock(copy), intervals, demands, last, later, is_outlook=is_outlook)
        rounds = 1 if self._follows else MOST_ROUNDS  # what contents come to no correction of the program foresees
        plan = planner.plan(task, last.basis(intervals) if last else None, self._replan, rounds)
        is_certain = self._drawn is None
        if is_certain and demands.deficit is not None and self._full.any():  # they may be short
            demand = np.clip(demands.deficit / len(intervals), 0.0, 1.0)
            plan = planner.at_price(replace(plan, task=replace(plan.task, demand=demand)), plan.task.price)
        if not self._follows:
            if last is not None and (self._climbs or is_certain):
                plan = planner.better_of(plan, [last.actions_of(intervals)] * len(planner.futures))
            if self._climbs or (is_certain and planner.is_short(plan)):
                plan = self._climb(planner, plan)
        if is_outlook or self._drawn is not None:
            return plan
        return planner.better_of(plan, [np.tile(self._neutral_entries(copy), (len(intervals), 1))])

    def _climb(self, planner: WindowPlanner, plan: WindowPlan) -> WindowPlan:
        """Return a plan improved in the simulator, where contents come about and demands are kept.

        In each of several futures other actions may be best. Of what is best at first in one of them, and the mean of
        these, that is done which does best in all.
        """
        climbs = [climb_window(future, plan.task, plan.actions, self._weight) for future in planner.futures]
        courses, prices = zip(*climbs, strict=True)
        if plan.task.has_to_serve:
            plan = planner.at_price(plan, np.max(prices, axis=0))
        firsts = [course[0] for course in courses]
        for first in (*firsts, np.mean(firsts, axis=0))[: None if len(courses) > 1 else 1]:
            plan = planner.better_of(plan, [np.concatenate([first[None], course[1:]]) for course in courses])
        return plan

    def _stock(self, copy: int) -> Floats:
        """Return the stocks of a copy, by stage, shape (rows,), mass."""
        stock: Floats = self._env.physical.stock[self._env.rows.nodes, copy]
        return stock

    def _neutral_entries(self, copy: int) -> Floats:
        """Return neutral actions of a copy, shape (entries,)."""
        return np.concatenate([action[copy] for action in self._env.neutral_action.values()])

    def _task(
        self,
        planner: WindowPlanner,
        stock: Floats,
        intervals: range,
        demands: _Demands,
        last: WindowPlan | None,
        later: Continuation | None = None,
        *,
        is_outlook: bool = False,
    ) -> WindowTask:
        """Return what is to be planned of some intervals from a ``stock``, by stage; see ``_plan``."""
        demand, budgets = None, len(demands.limits)
        if demands.deficit is not None:  # no interval delivers more than all that is wanted
            demand = np.where(self._full, 1.0, np.clip(demands.deficit / len(intervals), 0.0, 1.0))
        corrections = None if last is None else last.corrections_of(intervals, len(planner.futures))
        price = demands.price
        if price is None:
            price = planner.first_price[: budgets if demand is None else None] if last is None else last.task.price
        is_redrawn = any(low < high for low, high in (part.ends for part in self._env.network.processes.disturbances))
        return WindowTask(
            stock, intervals, demand, later, price, corrections, is_outlook, is_redrawn, demands.limits, demands.charges
        )

    def _look_ahead(self, copies: Sequence[int]) -> None:
        """Prepare plans of some copies of a disturbed network, each for its own futures."""
        if self._drawn is None:
            return
        steps = self._env.physical.step[list(copies)]
        for step in np.unique(steps[steps < self._env.network.episode.horizon]).tolist():
            alike = [copy for copy, own in zip(copies, steps.tolist(), strict=True) if own == step]
            futures = self._drawn.of(alike, self._rest(step)[: self._horizon])
            self._planners |= {c: WindowPlanner(own, self._weight) for c, own in zip(alike, futures, strict=True)}

    def _rest(self, step: int) -> range:
        """Return what is left of an episode."""
        return range(step, self._env.network.episode.horizon)

    def _future_as_expected(self) -> Future:
        """Return the network in which disturbances are as expected from the start, as plans have it."""
        env, network = self._env, self._env.network
        if network.disturbed:
            network = expected_network(network)
            if env.dynamics.substeps > 1:
                network = network.with_options(episode={"solver_step": env.dynamics.substep})
        elif self._levels is not None:
            network = with_margin(network, self._margin)
        return Future(Admissible.of(network, env.agents or None), self._degree, self._weight, aims=self._aims)

    def _expected_outlook(self) -> WindowPlan:
        """Return the plan of an episode in which all is as expected, from the middle of the initial ranges."""
        (future,), steps = self._planner.futures, range(self._env.network.episode.horizon)
        deficit = None if self._levels is None else self._levels * len(steps)
        demands = _Demands(deficit, self._aims.limits / self._aims.sizes, EMPTY)
        stock = starting_stocks(future.admissible.lifetimes, None)
        task = self._task(self._planner, stock, steps, demands, None, is_outlook=True)
        return self._planner.plan(task, None, self._replan)
