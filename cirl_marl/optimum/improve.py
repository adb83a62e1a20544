"""Better actions for a plan: sequential linear programs on the exact simulator.

The relaxed flows of a bound are not quite what constant controls can do. Around an episode of the simulator the best
step within a trust region is a linear program (``linearised``). Steps are accepted by simulation alone, so the result
is an episode that exists.

Of a large network those Jacobians, dense in its stocks and actions, would take gigabytes. ``refine`` solves programs of
plain means instead, with controls held and what was lacking on top.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Annotated, Any, TypeVar

import numpy as np

from cirl_marl.controllers.rollout import Rollout
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.errors import instance_of
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.admissible import Admissible, normalised_actions
from cirl_marl.optimum.aims import Aims
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.linearised import ALL, Span, StepProgram, step_program
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.planned_episodes import simulate_plan
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.slopes import MOST_SLOPES, ActionPlan, jacobians, slopes_of
from cirl_marl.optimum.solver import Infeasible, SolverFailure, best_values, solve

P = TypeVar("P", bound=ActionPlan)

TRUST, SMALLEST = 0.25, 1e-5
"""First and smallest half-width of the trust region, in normalised actions: an eighth of their range, and what moves λ̄
by less than the tolerance of HiGHS."""
PENALTY = 3.0
"""What is charged for what a service lacks, times the price that the bound puts on it. Any factor above 1 is exact at
that price; constant controls pay more for service than the bound says."""
CORRECTIONS = 4
"""Most programs around an episode, after the first, that are told what the episode of the one before was away from what
it promised, while that is no better or lacks service: a Jacobian costs as much as many of them."""
REFINEMENT_ROUNDS = 2
"""Most programs that are solved, each in an eighth of the time of the bound of steel_world: the first makes up for
factors that vary in the bound's plan, the second for what is left to first order."""
CONTENT_STARTS, SMALL_STARTS, SMALL = 4, 16, 5000
"""Actions to begin from where contents are demanded, where Jacobians have at most SMALL entries SMALL_STARTS. Random
ones are ends and middles of ranges: of 24 such 8 lead to the optimum of Haverly's second pooling problem, of as many
uniform ones 3; three miss it where sources have 800 t in place of 600."""
LEAP = 2.0
"""Half-width of the trust region, all of the range, where small steps serve no more: of a step to what is not made any
more, as it is too impure, or to stocks that schedules empty, by wide slopes."""
DEARER = 10.0
"""By what prices of what is short rise where no step helps: beside contents, budgets and flows that the simulator cuts
only from empty donors the bound knows low ones."""
VAIN_RISES = 8
"""How often prices rise in a row while no less is short."""
STALL = 0.05
"""Part of what is charged for what is short, which a step has to gain if prices are to stay there."""
EXTENSION = 3
"""Times the usual rounds, of which there may be as many where prices may rise, while something is short."""
NO_PROMISE = 1e-10
"""Part of the objective that a step has to promise, to be tried: one within a smaller region promises even less."""
TOLERATED_SHORTFALL = 1e-4
"""What a service may lack of its demand without a further round: a hundredth of a gap of 1 %."""


def improve_plan(
    bound: Bound,
    *,
    rounds: int = 20,
    starts: int | None = None,
    least_gain: float = NO_PROMISE,
    enough: Callable[[Rollout], bool] = lambda run: False,
    progress: Callable[[float], None] = lambda share: None,
) -> Bound:
    """Return ``bound`` with actions that do better in the simulator; the bound and its certificate stay.

    Plans are compared by the objective of the bound; what each service lacks of ``min_service`` is charged PENALTY
    times what the bound says it costs to provide, and more where it stays short. Local optimality is all that is
    sought; ``bound.gap`` says how much better any plan could be. With services of contents, whose products with flows
    have many local optima, random actions are begun from as well (``starts``). Of a network so large that its Jacobians
    would have more than MOST_SLOPES entries the plan is made by ``refine``, whatever ``rounds`` is.

    Args:
        bound: with the actions to start from.
        rounds: most linear programs to solve, from each start.
        starts: how many actions to begin from: those of the bound, then random ones, constant in time and always the
            same; None: 1, with services of contents CONTENT_STARTS, in small networks SMALL_STARTS, as many as
            it takes of these where another small plan is short.
        least_gain: part of the objective that a step has to promise, or no more are made where nothing is short.
        enough: asked of each episode that is better than those before, whether to stop there.
        progress: called with the share of them that is solved; 1 when no more are needed.
    """
    network = instance_of(Bound, "bound", bound).network
    slopes = slopes_of(bound.actions.shape, Dynamics(network))
    if slopes > MOST_SLOPES:
        return refine(bound, enough=enough, progress=progress)
    # bands have local optima, too: where the first plan is short, others are begun from in a small network
    usual = start_count(network, slopes) if starts is None else starts
    starts = SMALL_STARTS if starts is None and slopes <= SMALL else usual
    trials = _trials(bound)
    plans: list[Bound] = []
    for start, actions in enumerate(starting_actions(bound.actions, starts)):
        if start >= usual and trials.total_shortage(simulate_plan(plans[-1])) == 0.0:
            break
        report = partial(_tell, progress, start, usual) if start < usual else lambda share: None
        first = replace(bound, actions=actions)
        plan, _ = climb(first, trials, prices(bound), rounds, enough, report, least_gain=least_gain, demand_first=True)
        plans.append(plan)
    if len(plans) == 1:
        return plans[0]
    runs, price = [simulate_plan(plan) for plan in plans], prices(bound)
    shortages = [trials.total_shortage(run) for run in runs]
    ranks = [(-short, penalised_objective(bound, run, price)) for short, run in zip(shortages, runs, strict=True)]
    return plans[ranks.index(max(ranks))]


def start_count(network: Network, slopes: int) -> int:
    """Return how many actions plans begin from whose Jacobians have so many entries."""
    if not any(service.substance for service in network.services):
        return 1
    return SMALL_STARTS if slopes <= SMALL else CONTENT_STARTS


def starting_actions(actions: Floats, starts: int) -> Iterator[Floats]:
    """Yield actions to begin from: those of a plan, then random ones, constant in time and always the same."""
    yield actions
    for start in range(1, starts):
        constant = np.random.default_rng(start).choice([-1.0, 0.0, 1.0], actions.shape[1])
        yield np.broadcast_to(constant, actions.shape)


def _tell(progress: Callable[[float], None], start: int, starts: int, share: float) -> None:
    """Tell the share of all starts that is done, when ``start`` of them and a share of the next are."""
    progress((start + share) / starts)


@positional_record
class Trials:
    """How plans of some intervals from the same start are tried, and what is expected of them."""

    simulate: Annotated[Callable[[Any], Any], "plan → its episode in the simulator"]
    objective: Annotated[Callable[[Any], float], "episode → objective reached"]
    demand: Annotated[Floats, "mean level of each service, 0 for none, shape (services,)"]
    aims: Annotated[Aims, "with the budgets"]
    span: Annotated[Span, "these intervals"] = ALL

    def value(self, run: Any, price: Floats) -> float:
        """Return the objective that an episode reaches, less the price of what is short, see ``climb``."""
        lacks = np.maximum(0.0, self.demand - run.episode_levels[0])
        return self.objective(run) - float(price @ np.concatenate([lacks, self.aims.excess(run)]))

    def shortages(self, run: Any) -> Floats:
        """Return what an episode is short of each demand and, relative to it, of each budget."""
        return np.concatenate([self.demand - run.episode_levels[0], self.aims.excess(run) / self.aims.sizes])

    def total_shortage(self, run: Any) -> float:
        """Return the sum of what is short beyond what is tolerated: as one is out of reach others may still be kept."""
        shortages = self.shortages(run)
        return float(shortages[shortages > TOLERATED_SHORTFALL].sum())


def climb(
    plan: P,
    trials: Trials,
    price: Floats,
    rounds: int,
    enough: Callable[[Any], bool] = lambda run: False,
    progress: Callable[[float], None] = lambda share: None,
    *,
    least_gain: float = NO_PROMISE,
    demand_first: bool = False,
) -> tuple[P, Floats]:
    """Return a plan with better actions, by linear programs around episodes, from its own, and the price it needed.

    Where contents are demanded or there are budgets, or with ``demand_first``, prices rise of what is short and no step
    helps. Where rises are in vain, what is short is out of reach, and the plan that is least short counts.

    Args:
        plan: with the actions to start from.
        trials: of plans like it.
        price: what is charged for a unit that each service lacks, and by which each budget is exceeded.
        rounds: most steps, in each of which a few programs are solved; EXTENSION times as many where prices may rise
            while something is short.
        enough: asked of each episode that is better than those before, whether to stop there.
        progress: called with the share of rounds that are done.
        least_gain: as in ``improve_plan``.
        demand_first: whether what is demanded comes before the price that it has at first.
    """
    dynamics, demand, aims, price = Dynamics(plan.network), trials.demand, trials.aims, price.copy()
    lack, excess = np.zeros(len(demand)), np.zeros(len(aims.budgets))
    best, run = plan, trials.simulate(plan)
    value, trust, slopes = trials.value(run, price), TRUST, None
    has_contents, is_leap = any(service.substance for service in plan.network.services), False
    may_rise = has_contents or bool(aims.budgets) or demand_first
    shortfall = trials.total_shortage(run)
    nearest, nearest_shortfall, vain_rises = (plan, price.copy()), shortfall, 0
    for done in range(EXTENSION * rounds if may_rise else rounds):
        is_short = trials.shortages(run) > TOLERATED_SHORTFALL
        if done >= rounds and not is_short.any():
            break
        if trust < SMALLEST and may_rise and is_short.any():
            is_leap, trust = not is_leap, LEAP
            slopes = slopes if has_contents else None
            if not is_leap:
                if vain_rises == VAIN_RISES:
                    break
                price[is_short] *= DEARER
                value, trust, vain_rises = trials.value(run, price), TRUST, vain_rises + 1
        if trust < SMALLEST or enough(run):
            break
        if slopes is None:
            slopes = jacobians(best, dynamics, trials.span.first, is_wide=is_leap and not has_contents)
        wanted, limits = np.minimum(demand + lack, 1.0), aims.limits - excess
        steps = list[_Step | None]()
        for is_held in (False, True) if len(slopes.supplies.services) else (False,):
            around = best, dynamics, run, wanted, price, trust, slopes
            program = step_program(*around, limits=limits, span=trials.span, is_leap=is_leap, is_held=is_held)
            least = abs(value) * (least_gain if shortfall <= TOLERATED_SHORTFALL else NO_PROMISE)
            steps.append(_corrected_step(program, best, run, trials, price, value, least))
        progress(min((done + 1) / rounds, 1.0))
        step = max(filter(None, steps), key=lambda step: step.gain, default=_Step(best, run, 0.0))
        if step.gain > 0:
            best, run = step.plan, step.run
            lack = np.maximum(demand - run.episode_levels[0], 0.0)  # a step lacks about what the last one did
            excess = aims.excess(run)
            shortfall = trials.total_shortage(run)
            if shortfall < nearest_shortfall - TOLERATED_SHORTFALL:
                vain_rises = 0
            if shortfall <= nearest_shortfall:  # at other prices less may be kept later
                nearest, nearest_shortfall = (best, price.copy()), shortfall
            value, slopes = value + step.gain, None
            is_stalled = may_rise and step.gain < STALL * float(price @ np.append(lack, excess))
            trust = 0.0 if is_stalled else min(1.0, 2 * trust)
            is_leap = is_leap and is_stalled
        else:
            trust = 0.0 if is_leap or not any(steps) else trust / 4
    progress(1.0)
    return nearest if may_rise else (best, price)


@positional_record
class _Step:
    """The best plan of a step and of its corrections."""

    plan: Any
    run: Annotated[Any, "its episode"]
    gain: Annotated[float, "of the value at the prices"]


def _corrected_step(
    program: StepProgram, plan: P, run: Any, trials: Trials, price: Floats, value: float, least: float
) -> _Step | None:
    """Return the best of a step around a plan and of its corrections; None if it promises no more than the least."""
    best, corrected = _Step(plan, run, 0.0), program
    for _ in range(1 + CORRECTIONS):
        values = best_values(corrected.problem, corrected.scale)
        if values is None:  # a smaller region is another program
            break
        if corrected is program and program.promise(values) <= least:
            return None
        moves = values[program.columns.action]
        candidate, trial, gain = _trial_of(plan, moves, trials, price, value)
        if gain <= 0 and moves[program.idle].any():  # flows that were cut may not be beyond
            candidate, trial, gain = _trial_of(plan, np.where(program.idle, 0.0, moves), trials, price, value)
        if gain > best.gain:
            best = _Step(candidate, trial, gain)
        elif best.gain > 0:
            break
        if best.gain > 0 and trials.shortages(trial).max(initial=0.0) <= TOLERATED_SHORTFALL:
            break
        corrected = program.with_correction(values, run, trial)
    return best


def _trial_of(plan: P, moves: Floats, trials: Trials, price: Floats, value: float) -> tuple[P, Any, float]:
    """Return a plan with actions that have moved, its episode, and the gain."""
    candidate: P = replace(plan, actions=np.clip(plan.actions + moves, -1.0, 1.0))  # type: ignore[type-var]
    trial = trials.simulate(candidate)
    return candidate, trial, trials.value(trial, price) - value


def prices(bound: Bound) -> Floats:
    """Return what is charged for a unit that each service lacks, and by which each budget is exceeded.

    It covers what the certificate asks for it. Shape (services + budgets,); 0 for services if nothing is demanded.
    """
    network, budgets = bound.network, np.array([*bound.budget_prices.values()])
    # what a budget is worth at least: to exceed it by all of it is as bad as all that is aimed at
    scale = _scale(bound)
    budgets = np.maximum(budgets, scale / bound.aims.sizes)
    services = np.zeros(len(network.services))
    if bound.min_service is not None:
        multipliers = -bound.certificate.under[len(bound.certificate.under) - len(services) :]
        services = np.maximum(multipliers, scale)
    return PENALTY * np.concatenate([services, budgets])


def _scale(bound: Bound) -> float:
    """Return the size of the objective, which prices are no less than."""
    return 1.0 if bound.service_weight is not None else bound.aims.size(bound.network, bound.accounts)


def penalised_objective(bound: Bound, run: Rollout, prices: Floats) -> float:
    """Return the objective of the bound that an episode reaches, less the price of what is short of its demands."""
    return _trials(bound).value(run, prices)


def objective(bound: Bound, run: Rollout) -> float:
    """Return the objective of the bound that an episode reaches, whatever it is short of."""
    if bound.service_weight is not None:
        scale = bound.network.objective.circularity_scale
        return float(run.episode_circularity[0]) / scale + bound.service_weight * float(run.episode_service[0])
    return bound.aims.value(run)


def shortage(bound: Bound, run: Rollout) -> float:
    """Return the most that an episode is short of a demand: of a mean level, or of a budget, relative to that."""
    return float(_trials(bound).shortages(run).max(initial=0.0))


def demand(bound: Bound) -> Floats:
    """Return the mean level demanded of each service, 0 for none, shape (services,)."""
    return np.zeros(len(bound.network.services)) if bound.min_service is None else bound.min_service


def _trials(bound: Bound) -> Trials:
    return Trials(simulate_plan, partial(objective, bound), demand(bound), bound.aims)


def refine(
    bound: Bound,
    *,
    enough: Callable[[Rollout], bool] = lambda run: False,
    progress: Callable[[float], None] = lambda share: None,
) -> Bound:
    """Return ``bound`` with actions that do better in the simulator; the bound and its certificate stay.

    Each round solves the program of plain means (degree 0 of ``Programs``), whose controls are constant within an
    interval to first order, which the simulator carries out more faithfully. Where an episode delivers less of a
    service than its program promised, the next one demands that much more: the lower end l of its band becomes

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
    excess = bound.aims.excess(run)
    for done in range(REFINEMENT_ROUNDS):
        if enough(run):
            break
        demand_ranges = replace(admissible, service_low=admissible.service_low * factor)
        programs = Programs(demand_ranges, 0, bound.service_weight, system=bound.problem.system)
        try:
            aims = bound.aims.with_lower_budgets(excess)
            problem = programs.program(bound.initial, bound.min_service, aims=aims)
            variables = solve(problem, label="the program of a better plan", certify=False).plan
        except (Infeasible, SolverFailure):  # more than can be had: what was found so far is the plan
            break
        layout = programs.layout
        actions = normalised_actions(demand_ranges, layout, variables.reshape(-1, layout.size), bound.initial)
        candidate = replace(bound, actions=actions)
        trial = simulate_plan(candidate)
        progress((done + 1) / REFINEMENT_ROUNDS)
        if (worth := penalised_objective(bound, trial, price)) > value:
            best, run, value = candidate, trial, worth
        shortfall = _shortfall(layout, variables, trial, factor)
        if shortfall.mean(axis=0).max(initial=0.0) <= TOLERATED_SHORTFALL and not bound.aims.excess(trial).any():
            break
        factor += shortfall
        excess += bound.aims.excess(trial)
    progress(1.0)
    return best


def _shortfall(layout: Layout, plan: Floats, run: Rollout, factor: float | Floats) -> Floats:
    """Return what an episode lacks of the levels that its program promised, shape (steps, services).

    The program's levels are of bands that were raised by ``factor``.
    """
    levels = plan.reshape(-1, layout.size)[:, layout.level : layout.imbalance]
    shortfall: Floats = np.maximum(np.minimum(levels * factor, 1.0) - run.levels[0].T, 0.0)
    return shortfall
