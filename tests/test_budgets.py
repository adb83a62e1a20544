"""Budgets and aims of accounts: bounds, prices, plans, MPC and learners that keep them."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from small_networks import city
from test_capacities import power

from cirl_marl import (
    MPC,
    CirlError,
    MultiAgentVectorEnv,
    Network,
    Trained,
    load_network,
    load_recipe,
    parallel_env,
    train,
)
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect
from cirl_marl.optimum import Bound, bound, improve, improve_plan, simulate_plan, smooth, smooth_plan
from cirl_marl.optimum.aims import Aims, Budget
from cirl_marl.optimum.linearised import StepProgram, step_program
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.slopes import jacobians
from cirl_marl.optimum.solver import Basis
from cirl_marl.optimum.window_planner import WindowPlanner
from cirl_marl.optimum.windows import WindowPlan, WindowTask


@pytest.mark.slow
def test_budgets_are_kept_at_a_price_between_the_difference_quotients() -> None:
    """The multiplier of a budget of carbon is its price, within 1 % of quotients of solved programs."""
    network = city().with_options(episode={"horizon": 14})
    free = bound(network, min_service=0.95)
    least = bound(network, aim="emissions", min_service=0.95)
    budget = float(0.5 * (free.accounts[1] - least.objective))
    assert free.accounts[1] > budget > -least.objective
    for aim in ("circularity", "cost"):
        solved = bound(network, aim=aim, min_service=0.95, at_most={"emissions": budget})
        step = 1e-3 * budget
        lower, higher = (
            bound(network, aim=aim, min_service=0.95, at_most={"emissions": budget + way * step}).objective
            for way in (-1, 1)
        )
        price, quotients = (
            solved.budget_prices["emissions"],
            sorted([solved.objective - lower, higher - solved.objective]),
        )
        assert 0.99 * quotients[0] / step <= price <= 1.01 * quotients[1] / step
        assert solved.accounts[1] <= budget * (1 + 1e-6)
        run = simulate_plan(smooth_plan(improve_plan(solved)))
        assert run.accounts[0, 1] <= budget * (1 + 1e-4)
        assert run.episode_levels.min() >= 0.95 - 1e-4
        assert solved.gap(solved.aims.value(run)) <= 0.01


def test_large_plans_keep_budgets(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans without Jacobians tighten a budget by what was booked too much."""
    monkeypatch.setattr(improve, "MOST_SLOPES", 0)
    network = city()
    least = -bound(network, aim="emissions", min_service=0.9).objective
    solved = bound(network, min_service=0.9, at_most={"emissions": 1.1 * least})
    run = simulate_plan(improve_plan(solved))
    assert run.accounts[0, 1] <= 1.1 * least * (1 + 1e-3)
    assert solved.gap(solved.aims.value(run)) <= 0.02


def halfway(network: Network) -> float:
    """Return emissions between the least and those of the best plan, at a service of 0.95."""
    free, least = (bound(network, aim=aim, min_service=0.95).accounts[1] for aim in ("circularity", "emissions"))
    return float(free + least) / 2


@pytest.mark.slow
def test_weights_are_prices_of_budgets() -> None:
    """Who pays the price of a budget per unit has the optimum of who keeps it, but for what the budget is worth."""
    network = city()
    kept = bound(network, min_service=0.95, at_most={"emissions": (most := halfway(network))})
    price = kept.budget_prices["emissions"]
    assert price > 0
    paid = bound(network, min_service=0.95, aim={"circularity": 1.0, "emissions": price})
    assert paid.objective == pytest.approx(kept.objective - price * most, rel=1e-6)
    assert f"1·λ̄ {-price:+g}·emissions ≤" in str(paid)
    run = simulate_plan(improve_plan(paid))
    short = max(0.95 - float(run.episode_levels.min()), 0.0)
    assert 0 <= short < 1e-3
    assert paid.aims.value(run) <= float(paid.at(min_service=0.95 - short)) + 1e-9 * abs(paid.objective)
    assert paid.aims.value(run) == pytest.approx(paid.objective, rel=0.01)
    dearer = bound(network, min_service=0.95, aim={"cost": 1.0, "emissions": 2e3})
    assert dearer.objective == pytest.approx(-dearer.accounts @ [1.0, 2e3], rel=1e-6)


@pytest.mark.slow
def test_mpc_keeps_budgets() -> None:
    """With the service and close to the λ̄ of the bound from the same start; stocks book too."""
    network = city()
    stores = [replace(node, holding={"emissions": 0.05}) if node.stores else node for node in network.nodes]
    network = replace(network, nodes=tuple(stores))
    most = halfway(network)
    env = MultiAgentVectorEnv(network, num_envs=1)
    run = rollout(env, MPC(min_service=0.95, at_most={"emissions": most}))
    found = bound(network, run.start, min_service=0.95, at_most={"emissions": most})
    assert run.accounts[0, 1] <= most * (1 + 1e-5)
    assert run.episode_levels.min() >= 0.95 - 2e-3
    assert -1e-4 <= found.gap(run.episode_circularity)[0] < 0.01


@pytest.mark.slow
def test_learners_keep_budgets(tmp_path: Path) -> None:
    """By prices that move: independent policies by exact gradients have the service and stay within the budget."""
    network = city().with_options(episode={"horizon": 60})
    most, given = halfway(network), load_recipe("exact_gradients")
    run = given.run.model_copy(update={"min_service": 0.95, "at_most": {"emissions": most}})
    train(network, given.model_copy(update={"run": run}), steps=300_000, seed=2, directory=tmp_path / "run")
    played = rollout(MultiAgentVectorEnv(network, num_envs=16), Trained(tmp_path / "run"), seed=7)
    found = bound(network, min_service=0.95, at_most={"emissions": most})
    assert played.accounts[:, 1].mean() < most * 1.01
    assert played.episode_levels.mean() > 0.95 - 5e-3
    assert played.episode_circularity.mean() > found.objective - 0.05 * abs(found.objective)


def test_budgets_of_learners_that_cannot_be_meant_are_refused() -> None:
    """Without a demanded service, of no account, or charged for in a reward without λ."""
    network, given = city(), load_recipe("exact_gradients")
    for changes, message in (
        ({"min_service": None, "price_rate": 0.0, "at_most": {"cost": 1.0}}, "run.at_most: budgets are kept beside"),
        ({"at_most": {"cots": 1.0}}, "at_most: unknown account 'cots'.*Did you mean 'cost'"),
    ):
        wrong = given.model_copy(update={"run": given.run.model_copy(update=changes)})
        with pytest.raises(CirlError, match=message):
            train(network, wrong, steps=1000)
    with pytest.raises(CirlError, match=r"charges: unknown account 'cots'.*Did you mean 'cost'"):
        MultiAgentVectorEnv(network, num_envs=1, charges={"cots": 1.0})
    with pytest.raises(CirlError, match="charges count in rewards with λ, not in 'local'"):
        MultiAgentVectorEnv(network, num_envs=1, reward="local", charges={"cost": 1.0})
    wrong_charges: list[tuple[Any, str]] = [({"cost": "x"}, "that of 'cost' must be a number")]
    for charges, message in (*wrong_charges, (["cost"], "give {account: number}")):
        with pytest.raises(CirlError, match=f"charges: {message}"):
            MultiAgentVectorEnv(network, num_envs=1, charges=charges)
    with pytest.raises(CirlError, match="charges must be finite numbers"):
        MultiAgentVectorEnv(network, num_envs=1, charges={"cost": float("inf")})
    charged = parallel_env(network, reward="team", charges={"cost": 1e-6}).unwrapped
    assert charged.batch.account_charges[0] == 1e-6


@pytest.mark.slow
def test_what_a_plan_books_beyond_its_program_the_next_one_has_less_of() -> None:
    """On a network whose plans are carried out a little otherwise; without it the budget is exceeded by 0.06 %."""
    run = rollout(MultiAgentVectorEnv("steel_japan", num_envs=1), MPC(min_service=0.99, at_most={"emissions": 2860.0}))
    assert run.accounts[0, 0] <= 2860.0 * (1 + 2e-5)
    assert run.episode_levels.min() >= 0.99 - 2e-3


def test_budgets_out_of_reach_are_approached_and_said() -> None:
    """Zero of what costs something: nothing is done, and what is missing is told."""
    network, control = power(6), MPC(min_service=0.5, at_most={"cost": 0.0})
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), control)
    assert run.accounts[0, 0] == pytest.approx(0.0, abs=1e-6)
    assert "this one has 0.5000 less of 'demand'; network" in control.note
    assert "no actions keep the budget of" in control.note and "its price would be infinite" in control.note
    tight = MPC(min_service=1.0, at_most={"cost": 1.02 * bound(power(8), aim="cost", min_service=1.0).accounts[0]})
    run = rollout(MultiAgentVectorEnv(power(8), num_envs=1), tight)
    assert not tight.note and run.episode_levels.min() > 1 - 1e-6


def test_a_budget_of_nothing_has_a_price() -> None:
    """Plans beside it get better; its price is no infinity."""
    network = power(6)
    arcs = [replace(arc, accounts={"cost": -400.0}) if arc.id == "use" else arc for arc in network.arcs]
    network = replace(network, arcs=tuple(arcs), objective=replace(network.objective, circularity_scale=100.0))
    found = bound(network, at_most={"cost": 0.0}, min_service=0.5)
    assert np.isfinite(improve.prices(found)).all()
    assert simulate_plan(improve_plan(found)).accounts[0, 0] <= 1e-6


def test_a_plan_goes_on_as_it_ends() -> None:
    """In each interval that it has it does what was planned; in those that come after it, what is done last."""
    plan: Any = SimpleNamespace(task=SimpleNamespace(intervals=range(1, 4)), actions=np.arange(3.0)[:, None])
    assert WindowPlan.actions_of(plan, range(2, 5)).ravel().tolist() == [1.0, 2.0, 2.0]


@pytest.mark.slow
def test_a_plan_is_not_left_for_a_worse_one() -> None:
    """Where no plan is within the budget, what is done in the end takes no more than the first plan did, or nearly."""
    free = rollout(MultiAgentVectorEnv("steel_japan", num_envs=1, horizon=8), MPC(min_service=0.95))
    control = MPC(min_service=0.95, at_most={"emissions": 0.93 * float(free.accounts[0, 0])})
    run = rollout(MultiAgentVectorEnv("steel_japan", num_envs=1, horizon=8), control)
    assert run.accounts[0, 0] <= free.accounts[0, 0] * (1 + 1e-6)
    least = bound("steel_japan", horizon=8, aim="emissions", min_service=0.95, degree=1)
    assert f"(at least {least.accounts[0]:.6g}): its price would be infinite" in control.note


@pytest.mark.slow
def test_plans_are_compared_by_what_they_exceed() -> None:
    """At the price of a budget; and charges on what is booked are no part of the objective that is left."""
    network = city().with_options(episode={"horizon": 30})
    least = -bound(network, aim="emissions", min_service=0.95).objective
    control = MPC(min_service=0.95, at_most={"emissions": 0.8 * least})
    plan = first_window(control, network)
    assert "less of 'paper_delivered'" in control.note
    merit, booked_parts = control._planner._merit, plan.bookings.sum(axis=0)
    assert plan.merit == pytest.approx(merit(plan, plan.task.price))
    over = replace(plan, task=replace(plan.task, limits=booked_parts - 0.05))
    merits = [merit(over, np.array([factor, 0.0])) for factor in (0.0, 1.0, 3.0)]
    np.testing.assert_allclose(np.diff(merits), [-0.05, -0.1])
    assert merits[0] == plan.value
    better_of = control._planner.better_of
    over = replace(over, task=replace(over.task, price=np.array([1.0, 0.0])))
    for excess, is_left in ((0.02, True), (1e-4, False)):  # what exceeds by much less takes the place of what is dearer
        dirty = replace(over, bookings=plan.bookings + excess / len(plan.bookings), value=plan.value + 10.0)
        assert (better_of(dirty, [plan.actions]).value == pytest.approx(plan.value)) == is_left
        served = replace(dirty, level=plan.level + 0.01, task=replace(dirty.task, demand=plan.level + 0.01))
        assert better_of(served, [plan.actions]) is served  # but no service is given for it
    future = control._planner.futures[0]
    charged = replace(plan.task, charges=np.array([50.0]))
    values = [future.carry_out(task, plan.actions).value for task in (plan.task, charged)]
    assert values[0] - values[1] == pytest.approx(50.0 * float(plan.bookings.sum()))


def first_window(control: MPC, network: Network) -> WindowPlan:
    """Return the first plan of the first copy."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    control.start(env, 0)
    plan = control._plans[0].window
    assert plan is not None
    return plan


def test_the_rest_of_a_plan_stays_where_a_new_one_is_worse() -> None:
    """And is left for one that is better, at the price of what either exceeds."""
    network = city().with_options(episode={"horizon": 30})
    control = MPC(min_service=0.95, at_most={"emissions": halfway(network)})
    plan = first_window(control, network)
    idle = np.full_like(plan.actions, -1.0)
    outcome = control._planner.futures[0].carry_out(plan.task, idle)
    level = np.minimum(outcome.level, 1.0).mean(axis=0)
    worse = replace(plan, actions=idle, level=level, bookings=outcome.bookings, value=outcome.value)
    assert (control._planner.better_of(worse, [plan.actions]).actions == plan.actions).all()
    assert control._planner.better_of(plan, [worse.actions]) is plan


@pytest.mark.parametrize("changes", [True, False])
def test_budgets_ask_for_further_rounds(monkeypatch: pytest.MonkeyPatch, changes: bool) -> None:
    """As long as what is booked beyond the program changes, ten programs are solved where plans keep little of it."""
    trial, rounds = WindowPlanner._trial, list[int]()

    def erring(planner: WindowPlanner, task: WindowTask, basis: Basis | None, rises: int = 8) -> WindowPlan:
        plan = trial(planner, task, basis, rises)
        rounds.append(len(rounds))
        more = 0.001 * len(rounds) if changes else 0.001
        parts = [replace(part, error=0 * part.error, excess=0 * part.excess + more) for part in plan.corrections]
        return replace(plan, value=plan.value - 1e6, merit=plan.merit - 1e6, corrections=tuple(parts))

    monkeypatch.setattr(WindowPlanner, "_trial", erring)
    network = city().with_options(episode={"horizon": 6})
    first_window(MPC(min_service=0.5, at_most={"emissions": 1e3}), network)
    assert len(rounds) == (10 if changes else 2)


def test_plans_at_different_prices_are_compared_at_the_higher(monkeypatch: pytest.MonkeyPatch) -> None:
    """A first one that exceeds its budget a little at a low price is no better than a second that keeps it."""
    trial, plans = WindowPlanner._trial, list[WindowPlan]()

    def told(planner: WindowPlanner, task: WindowTask, basis: Basis | None, rises: int = 8) -> WindowPlan:
        plan, is_first = trial(planner, task, basis, rises), not plans
        price = np.array([1.0, 1.0]) if is_first else np.array([100.0, 1.0])
        bookings = np.zeros_like(plan.bookings)
        bookings[0] = task.limits + (0.1 if is_first else 0.0)
        reached: dict[str, Any] = {"bookings": bookings, "level": np.ones(1), "value": 0.0 if is_first else -1.0}
        plan = replace(plan, task=replace(plan.task, price=price), **reached)
        plans.append(replace(plan, merit=planner._merit(plan, price)))
        return plans[-1]

    monkeypatch.setattr(WindowPlanner, "_trial", told)
    chosen = first_window(MPC(min_service=0.5, at_most={"emissions": 1e3}), city().with_options(episode={"horizon": 6}))
    assert plans[0].merit > plans[1].merit and chosen.value == -1.0


@pytest.mark.slow
def test_mpc_in_a_disturbed_network_charges_for_budgets() -> None:
    """It books less than without one, at about the service."""
    network = city().with_options(episode={"horizon": 60})
    most, path = halfway(network), f"services.{network.services[0].id}.low"
    disturbances = {"demand": AutoRegression(deviation=0.3, persistence=0.8, low=0.5, high=1.6)}
    network = replace(network, disturbances=disturbances, disturbed={path: DisturbanceEffect(by="demand")})
    booked_emissions = {}
    for futures in (None, 2):
        for budget in (None, {"emissions": most}):
            env = MultiAgentVectorEnv(network, num_envs=4)
            run = rollout(env, MPC(futures=futures, min_service=0.95, at_most=budget))
            booked_emissions[budget is None] = float(run.accounts[:, 1].mean())
            assert run.episode_levels.mean() > 0.95 - 0.01
        assert booked_emissions[False] < 0.85 * booked_emissions[True]


def test_multipliers_of_a_budget_hold_at_other_starts() -> None:
    """``Bound.at`` takes the aim and the budgets along: it proves no less than a program of that start."""
    network = city()
    least = -bound(network, aim="emissions", min_service=0.9).objective
    solved = bound(network, min_service=0.9, at_most={"emissions": 1.5 * least})
    for aim, found in (("circularity", solved), ("cost", bound(network, aim="cost", min_service=0.9))):
        start = found.initial * np.array([1.0, 1.1, 0.9, 1.2, 1.0])
        budgets = {"emissions": 1.5 * least} if found is solved else None
        own = bound(network, start, aim=aim, min_service=0.9, at_most=budgets)
        proved = float(found.at(start))
        assert own.objective - 1e-6 * abs(own.objective) <= proved <= own.objective + 0.2 * abs(own.objective)
        assert float(found.at()) == pytest.approx(found.objective, rel=1e-9)


def small_step(solved: Bound, level: float) -> tuple[Bound, StepProgram, NDArray[np.float64], Rollout, Rollout]:
    """Return a plan of drawn actions, the program of a step from it, a small one, and episodes without and with it."""
    rng, dynamics = np.random.default_rng(0), Dynamics(solved.network)
    middle = replace(solved, actions=rng.uniform(-0.5, 0.5, solved.actions.shape))
    run, services = simulate_plan(middle), len(solved.network.services)
    prices = np.ones(services + len(solved.aims.limits))
    program = step_program(middle, dynamics, run, np.full(services, level), prices, 0.1, jacobians(middle, dynamics))
    moves = np.zeros(len(program.origin))
    moves[program.columns.action] = 1e-4 * rng.uniform(-1, 1, program.columns.action.shape)
    trial = simulate_plan(replace(middle, actions=middle.actions + moves[program.columns.action]))
    return middle, program, moves, run, trial


def test_a_step_of_a_plan_knows_what_it_books() -> None:
    """To first order the program of a step has the account that is kept low, and the budget, as the simulator does."""
    network = city()
    # so that what is held counts as much as what flows
    nodes = tuple(replace(n, holding={"cost": 5.0}) if n.holding else n for n in network.nodes)
    network = replace(network, nodes=nodes)
    solved = bound(network, aim="cost", min_service=0.9, at_most={"emissions": 3000.0})
    middle, program, moves, run, trial = small_step(solved, 0.9)
    books = trial.accounts[0] - run.accounts[0]
    row = program.problem.under[[len(program.problem.under_to) - 1]].toarray()[0]
    assert program.problem.cost @ moves == pytest.approx(books[0], rel=1e-3)
    assert row @ moves == pytest.approx(books[1], rel=1e-3)
    assert program.problem.under_to[-1] == pytest.approx(3000.0 - run.accounts[0, 1])
    moves *= 3000.0
    trial = simulate_plan(replace(middle, actions=np.clip(middle.actions + moves[program.columns.action], -1.0, 1.0)))
    corrected = program.with_correction(moves, run, trial)
    assert corrected.problem.under_to[-1] == pytest.approx(3000.0 - trial.accounts[0, 1] + row @ moves, rel=1e-9)


def test_what_exceeds_a_budget_is_charged_and_asked_for_again(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans over their budget are worth less; the next program of a large network has that much less to spend."""
    network = city()
    solved = bound(network, min_service=0.9, at_most={"emissions": 3000.0})
    run = simulate_plan(solved)
    tight = replace(
        solved, aims=replace(solved.aims, budgets=(Budget(1, float(run.accounts[0, 1]) - 100.0, "emissions"),))
    )
    rates = np.array([0.0, 2.0])
    values = [improve.penalised_objective(plan, run, rates) for plan in (solved, tight)]
    assert values[1] == pytest.approx(float(run.episode_circularity[0]) - 200.0)
    assert values[0] >= values[1] + 199.0
    assert improve.shortage(tight, run) == pytest.approx(100.0 / (float(run.accounts[0, 1]) - 100.0), rel=1e-6)
    good: Any = SimpleNamespace(run=run, bound=solved)
    bad: Any = SimpleNamespace(run=_with_more(run, 1.01), bound=solved)
    assert smooth._as_good(good, good) and not smooth._as_good(bad, good)
    budgets: list[float] = []
    program = Programs.program

    def recorded(self: Programs, initial: Any, min_service: Any = None, **options: Any) -> Any:
        budgets.append(options["aims"].limits[0])
        return program(self, initial, min_service, **options)

    monkeypatch.setattr(Programs, "program", recorded)
    monkeypatch.setattr(Aims, "excess", lambda self, run: np.array([5.0]))
    improve.refine(solved)
    assert budgets == [2995.0, 2990.0]


def _with_more(run: Rollout, factor: float) -> Rollout:
    return replace(run, accounts=np.maximum(run.accounts, 3000.0) * factor)


def test_a_smoother_plan_may_book_what_the_last_one_did() -> None:
    """Where a region is too small to keep a budget again, the program of the nearest actions has a solution."""
    network = city().with_options(episode={"horizon": 8})
    least = -bound(network, aim="emissions", min_service=0.9).objective
    solved = bound(network, min_service=0.9, at_most={"emissions": 1.05 * least})
    more = replace(solved, actions=np.clip(solved.actions + 0.2, -1.0, 1.0))
    dynamics, distance = Dynamics(network), smooth.Distance(solved)
    reference, centre = (smooth._Episode(plan, dynamics) for plan in (solved, more))
    assert centre.run.accounts[0, 1] > 1.05 * least > reference.run.accounts[0, 1] * 0.999
    margin = np.zeros_like(reference.run.levels[0])
    assert smooth._nearer(centre, reference, dynamics, distance, 1e9, 1e-6, margin, restore=False) is not None


@pytest.mark.slow
def test_of_drawn_numbers_nothing_is_said_to_be_out_of_reach() -> None:
    """What a program of their means cannot keep an episode of others may; without draws it is said."""
    network = load_network("copper_world", scenario="factor_ranges").with_options(episode={"horizon": 3})
    for uncertain in (False, True):
        control = MPC(min_service=0.9, at_most={"emissions": 1.0})
        env = MultiAgentVectorEnv(network, num_envs=1, uncertain=uncertain)
        env.reset(seed=0)
        control.start(env, 0)
        assert "more emissions" in control.note
        assert ("no actions keep the budget of emissions" in control.note) != uncertain
