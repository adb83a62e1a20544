"""Controllers that plan with the program of the bound: again and again (MPC), or once for the episode (Optimum).

Every ``replan`` decisions each copy solves the linear program of ``cirl_marl.optimum`` from its true current stocks and
carries out the first planned actions; what the program promised and the simulator did not do is made up for by the
next plan. Controls are held within an interval to first order (``Programs(hold_controls=True)``): that bounds nothing
and plans better. Nothing is random.

A receding window ends before the episode does. What comes after it is priced by the multipliers y of the program of the
whole episode, solved once from the start of the episode: the rows of the interval after the window are moved into the
objective, c' = c − Aᵀy, which leaves a price on each stock at the window's end. By duality this is an upper bound on
what those stocks are worth to the rest of the episode, exact along its plan, so that nothing is run down because the
window ends. With ``horizon=None`` the window shrinks with what is left of the episode and needs no prices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.controllers.basic import Arrays, Planner
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum.admissible import Admissible, NoCertificate, normalised_actions
from cirl_marl.optimum.bounds import Bound, bound
from cirl_marl.optimum.cross_entropy import KNOTS, Incumbent, search_each
from cirl_marl.optimum.improve import improve_plan
from cirl_marl.optimum.options import check_options, demanded_levels
from cirl_marl.optimum.planned_episodes import Plan, starting_states
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.optimum.smooth import MOST_ROWS, program_rows, smooth_plan
from cirl_marl.optimum.solver import Basis, Infeasible, Solution, SolverFailure, solve

SERVICE_FIRST = 1000.0
"""Weight of the mean service level, against λ̄/circularity_scale, where a demanded level is out of reach."""
BOUND = 0.3
"""About the share of solving for the bound in the work on a plan; the rest is to improve it."""


@positional_record
class _Plan:
    """What is planned for one copy."""

    episode: Annotated[int, "of the copy, by its number"]
    intervals: Annotated[range, "of the episode"]
    optimum: Annotated[tuple[Program, Solution] | None, "of which program, and which; None if nothing could be planned"]
    actions: Annotated[Floats, "of the first intervals, shape (decisions, entries)"]
    unit: Annotated[float, "what 1 of its objective is in the objective of plans that meet the demand"]

    def basis(self, intervals: range) -> Basis | None:
        """Return the basis from which to plan ``intervals``; None if they are neither as many nor the last of these."""
        if self.optimum is None or self.optimum[1].basis is None:
            return None
        problem, basis = self.optimum[0], self.optimum[1].basis
        if len(intervals) == len(self.intervals):
            return basis
        if intervals.stop != self.intervals.stop or intervals.start < self.intervals.start:
            return None
        return basis.without_first(problem, intervals.start - self.intervals.start)

    def levels(self) -> Floats:
        """Return the planned level of each service in each interval, shape (intervals, services)."""
        assert self.optimum is not None
        layout = self.optimum[0].layout
        return self.optimum[1].plan.reshape(-1, layout.size)[:, layout.level : layout.imbalance]

    def prices(self) -> Floats:
        """Return what the rows of the next interval charge for the stocks at the end of each, shape (intervals, nodes).

        They are the terms of c − Aᵀy − Gᵀμ, for those stocks, of rows that belong to the interval after, in the
        objective of plans that meet the demand.
        """
        assert self.optimum is not None
        problem, certificate, layout = self.optimum[0], self.optimum[1].certificate, self.optimum[0].layout
        costs = np.zeros(len(problem.cost))
        for matrix, multipliers in ((problem.equal, certificate.equal), (problem.under, certificate.under)):
            # entry (row, column): the row belongs to the last interval that it touches, the column to its own
            entries = matrix.tocoo()
            interval = entries.col // layout.size
            ends = entries.col - interval * layout.size
            later = problem.interval_of_rows(matrix)[entries.row] > interval
            later &= (ends >= layout.last.start) & (ends < layout.last.stop)
            np.subtract.at(costs, entries.col[later], (entries.data * multipliers[entries.row])[later])
        prices: Floats = costs.reshape(-1, layout.size)[:, layout.last]
        return prices * self.unit


class MPC(Planner):
    """Plans again and again from the current stocks; each copy has its own plan.

    The objective is λ̄ of the episode; with ``service_weight`` w, λ̄/circularity_scale + w·service. With ``min_service``
    the mean level of each service over the whole episode is held at the demanded level or above: what the past
    intervals lacked the planned ones have to make up for. If that is out of reach for one of them, w = SERVICE_FIRST
    takes the place of the demand in that plan. It then comes as close as it can: no service counts beyond its demand.
    """

    ahead = 0.1  # a first plan takes longer than the later ones, which start from it

    def __init__(
        self,
        *,
        horizon: int | None = None,
        min_service: ArrayLike | None = None,
        service_weight: float | None = None,
        degree: int = 1,
        replan: int = 4,
    ) -> None:
        """Choose what is planned.

        Args:
            horizon: decisions that a plan looks ahead; None looks to the end of the episode.
            min_service: mean level demanded, in [0, 1], of every service, or of each, shape (services,); excludes
                ``service_weight``.
            service_weight: w ≥ 0.
            degree: degree of the test polynomials; see ``bound``.
            replan: decisions carried out of each plan.

        Raises:
            CirlError: for an option that cannot be used.
        """
        check_options(service_weight, min_service, degree)
        for name, value in (("replan", replan), ("horizon", replan if horizon is None else horizon)):
            if not isinstance(value, int | np.integer) or isinstance(value, bool) or value < 1:
                raise CirlError(f"{name} must be a whole number of at least 1, got {value!r}")
        if horizon is not None and horizon < replan:
            raise CirlError(f"horizon {horizon} is shorter than the {replan} decisions carried out of each plan")
        self._horizon, self._replan = horizon, replan
        self._min_service, self._weight, self._degree = min_service, service_weight, degree

    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Make the first plan of every copy; ``seed`` has no effect.

        Raises:
            NoCertificate: for a network whose flows are not linear laws; see ``bound``.
            CirlError: for another number of demanded levels than services.
        """
        network = env.network
        self._levels = None if self._min_service is None else demanded_levels(network, self._min_service)
        self.note = ""
        self._env = env
        self._admissible = Admissible.of(expected_network(network), env.agents or None)
        self._programs = Programs(self._admissible, self._degree, self._weight, hold_controls=True)
        self._urgent = Programs(self._admissible, self._degree, SERVICE_FIRST, hold_controls=True)
        self._outlooks: dict[int, _Plan] = {}
        self._plans = []
        for copy in range(env.num_envs):
            self._plans.append(self._next(copy, None))
            progress((copy + 1) / env.num_envs)

    def act(self, observations: Arrays) -> Arrays:
        """Return the next actions, from the current state of the environment that was started.

        Raises:
            ControlError: after the end of the episode.
        """
        env = self._env
        actions = []
        for copy, step in enumerate(env.physical.step.tolist()):
            plan = self._plans[copy]
            if plan.episode != env.episodes[copy]:
                plan = self._plans[copy] = self._next(copy, None)
            elif not 0 <= step - plan.intervals.start < len(plan.actions):
                plan = self._plans[copy] = self._next(copy, plan)
            actions.append(plan.actions[step - plan.intervals.start])
        return env.unstack(np.stack(actions, axis=1))

    def _next(self, copy: int, last: _Plan | None) -> _Plan:
        """Plan for one copy from its current stocks, after the ``last`` plan of its episode."""
        state, steps = self._env.physical, self._env.network.episode.horizon
        step = int(state.step[copy])
        if step >= steps:
            raise ControlError(f"MPC: the episode is over after {steps} steps: call reset()")
        rest = range(step, steps)
        window = rest if self._horizon is None else rest[: self._horizon]
        try:
            return self._solve_window(copy, rest, window, last)
        except SolverFailure as failure:
            self.note = f"MPC goes on as it planned before, or neutrally, where a plan is missing: {failure}"
            return self._older(copy, window, last)

    def _solve_window(self, copy: int, rest: range, window: range, last: _Plan | None) -> _Plan:
        """Plan the ``window`` of what is left of the episode, the ``rest``."""
        state, steps = self._env.physical, self._env.network.episode.horizon
        deficit = None if self._levels is None else self._levels * steps - state.service[:, copy]
        if len(window) == len(rest):
            return self._plan(copy, window, deficit, last.basis(window) if last else None)
        if last is None:
            self._outlooks.pop(copy, None)
        if copy not in self._outlooks:
            self._outlooks[copy] = self._plan(copy, rest, deficit, None, as_outlook=True)  # its multipliers are prices
        outlook = self._outlooks[copy]
        after = window.stop - outlook.intervals.start
        if deficit is not None:
            deficit -= outlook.levels()[after:].sum(axis=0)
        return self._plan(copy, window, deficit, last.basis(window) if last else None, outlook.prices()[after - 1])

    def _older(self, copy: int, window: range, last: _Plan | None) -> _Plan:
        """Return the last plan, to be carried out for longer, or one to be neutral where it has come to its end."""
        if last is not None and last.optimum is not None and window.start in last.intervals:
            problem, solution = last.optimum
            done = window.start - last.intervals.start + self._replan
            plan = solution.plan.reshape(len(last.intervals), -1)[:done]
            return replace(last, actions=normalised_actions(self._admissible, problem.layout, plan, last.intervals))
        neutral = np.concatenate([action[copy] for action in self._env.neutral_action.values()])
        return _Plan(int(self._env.episodes[copy]), window, None, np.tile(neutral, (self._replan, 1)), 1.0)

    def _plan(
        self,
        copy: int,
        intervals: range,
        deficit: Floats | None,
        basis: Basis | None,
        prices: Floats | None = None,
        as_outlook: bool = False,
    ) -> _Plan:
        """Plan some intervals.

        Args:
            copy: whose stocks they start from.
            intervals: to be planned.
            deficit: least sum of the levels of each service over all intervals, shape (services,); None if nothing is
                demanded.
            basis: from which the solver starts.
            prices: of the stocks at the end, shape (nodes,), in the objective of plans that meet the demand, per mass.
            as_outlook: whether the multipliers must be good, as they are the prices of later plans.
        """
        env, episode = self._env, self._env.network.episode
        stock = env.physical.stock[env.rows.nodes, copy]
        demand = None if deficit is None else np.maximum(0.0, deficit / len(intervals))
        task = f"the program of MPC for decisions {intervals.start} to {intervals.stop - 1}"
        for programs, unit in ((self._programs, 1.0), (self._urgent, env.network.objective.circularity_scale)):
            problem = programs.program(stock, demand, intervals)
            cost = problem.cost.reshape(len(intervals), -1) * (len(intervals) / episode.horizon)
            if prices is not None:
                cost[-1, problem.layout.last] += prices / unit
            problem = replace(problem, cost=cost.ravel())
            if programs is self._urgent:
                problem = _without_demand(problem)
            try:
                solution = solve(problem, basis, label=task, certify=as_outlook)
                break
            except Infeasible:
                if demand is None or programs is self._urgent:
                    raise
        variables = solution.plan.reshape(len(intervals), -1)[: self._replan]
        actions = normalised_actions(self._admissible, problem.layout, variables, intervals)
        return _Plan(int(env.episodes[copy]), intervals, (problem, solution), actions, unit)


def _without_demand(problem: Program) -> Program:
    """Return the program in which the mean level of each service counts up to what is demanded, and is not held there.

    A level is a variable of at most q/low, so that a service may be better than what is counted of it.
    """
    under, services = problem.under, len(problem.layout.network.services)
    is_demand = np.arange(len(problem.under_to)) >= len(problem.under_to) - services
    sign = np.where(is_demand, -1.0, 1.0)
    return replace(problem, under=sparse.csr_array(sparse.diags_array(sign) @ under), under_to=problem.under_to * sign)


class Optimum(Planner):
    """Open-loop optimal control: once started, every copy has a plan of its own for the whole episode.

    Attributes:
        plans: once started, whose plan each copy carries out: bounds, or incumbents where nothing is proved.
        note: empty if the plans are those of bounds.
    """

    ahead = 0.99

    def __init__(
        self,
        *,
        min_service: ArrayLike | None = None,
        service_weight: float | None = None,
        smooth: bool | None = False,
    ) -> None:
        """Choose the objective; see ``bound``.

        Args:
            min_service: see ``bound``.
            service_weight: likewise.
            smooth: whether ``smooth_plan`` has the last word; None: where ``program_rows`` is at most MOST_ROWS.
        """
        self._min_service, self._service_weight, self._smooth = min_service, service_weight, smooth
        self.plans: list[Bound] | list[Incumbent] = []
        self._plan = Plan(())

    def plan(self, env: MultiAgentVectorEnv, seed: int, progress: Callable[[float], None]) -> None:
        """Solve a program for the start of every copy and improve its plan; ``seed`` has no effect.

        Where no program bounds the network (``NoCertificate``), look for plans by simulation, from all starts at once.

        Raises:
            CirlError: for a service that no plan reaches, a solver that fails, or an environment in which nobody acts.
        """
        try:
            network, notes = expected_network(env.network), []
            if env.network.disturbed:
                notes.append("plans for what disturbances are expected to be, carried out whatever they are")
            is_small = (rows := program_rows(network)) <= MOST_ROWS
            if self._smooth is None and not is_small:
                notes.append(f"not made smooth: that program has {rows:,} rows; beyond {MOST_ROWS:,} ask for it")
            smooth = is_small if self._smooth is None else self._smooth
            self.plans, self.note = self._bound_plans(env, network, smooth, progress), "; ".join(notes)
        except NoCertificate as reason:
            self.plans = self._search_plans(env, progress)
            self.note = f"best plan found, no certificate: {reason}"
        self._plan = Plan(self.plans)
        self._plan.start(env, seed)

    def act(self, observations: Arrays) -> Arrays:
        """Return the planned actions of the next interval."""
        return self._plan.act(observations)

    def _bound_plans(
        self, env: MultiAgentVectorEnv, network: Network, smooth: bool, progress: Callable[[float], None]
    ) -> list[Bound]:
        plans: list[Bound] = []
        by_start: dict[bytes, Bound] = {}  # copies that start alike have the same plan, though their draws differ
        for copy, start in enumerate(env.physical.stock[env.rows.nodes].T):

            def report(improvement: float, copy: int = copy) -> None:
                progress((copy + BOUND + (1 - BOUND) * improvement) / env.num_envs)

            if (key := start.tobytes()) in by_start:
                plans.append(by_start[key])
                report(1.0)
                continue
            service, weight = self._min_service, self._service_weight
            solution = bound(network, start, min_service=service, service_weight=weight, agents=env.agents or None)
            report(0.0)
            plan = improve_plan(solution, progress=report)
            plans.append(replace(smooth_plan(plan) if smooth else plan, network=env.network))
            by_start[key] = plans[-1]
        return plans

    def _search_plans(self, env: MultiAgentVectorEnv, progress: Callable[[float], None]) -> list[Incumbent]:
        incumbents = search_each(
            expected_network(env.network),
            starting_states(env),
            min_service=self._min_service,
            service_weight=self._service_weight,
            agents=env.agents or None,
            knots=min(KNOTS, env.network.episode.horizon),
            progress=lambda share, objective: progress(share),
        )
        return [replace(incumbent, network=env.network) for incumbent in incumbents]
