"""Money, emissions and energy beside mass: what is booked, bounds and plans for it, budgets, files and messages."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_type_hints

import numpy as np
import pytest
from conftest import random_network
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle
from small_networks import ACCOUNTS, booked, plain_networks, small
from test_capacities import power
from test_optimum import bounded, certifiable, pinned
from typer.testing import CliRunner

from cirl_marl import (
    MPC,
    Account,
    Arc,
    CirlError,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    Role,
    Series,
    Trained,
    account_front,
    compare,
    gradient,
    levers,
    load_network,
    load_recipe,
    mo_parallel_env,
    parallel_env,
    plan,
    simulate,
    train,
    write_network,
)
from cirl_marl.cli import app
from cirl_marl.controllers import Neutral, Random
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.drawing.style import draw_steps, number
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.evaluation.compared_quantities import rank_quantities
from cirl_marl.evaluation.episode_count import concatenation
from cirl_marl.evaluation.sampling import sample_episodes, sensitivities
from cirl_marl.evaluation.simulations import Simulation, simulate_alternatives
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect, Markov
from cirl_marl.network.uncertainty import Spread, network_of_intervals
from cirl_marl.network.units import factor
from cirl_marl.optimum import bound, improve, improve_plan, simulate_plan, smooth, smooth_plan
from cirl_marl.optimum.aims import Aims, Budget
from cirl_marl.optimum.linearised import jacobians, step_program
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.solver import Basis
from cirl_marl.optimum.window_planner import WindowPlanner
from cirl_marl.optimum.windows import WindowPlan, WindowTask
from cirl_marl.report.account_tables import account_steps, accounts_table, save_accounts
from cirl_marl.report.data_package import read_package, write_package
from cirl_marl.report.iamc import read_iamc, write_iamc
from cirl_marl.report.lever_chart import levers_table, write_levers
from cirl_marl.report.page_data import page_data
from cirl_marl.report.report_page import page_of_alternatives
from cirl_marl.report.samples import write_samples
from cirl_marl.report.tradeoffs import summary_of


def with_lambda(network: Network) -> Network:
    """Return a network with an account of what moves finite-time sustainably: −λ̄·T/Δ if nothing is absolute."""
    signs = zip(network.arcs, network.sustainability.tolist(), strict=True)
    arcs = tuple(replace(arc, accounts={"moved": sign}) for arc, sign in signs)
    return replace(network, arcs=arcs, accounts=(Account(id="moved", unit=network.mass_unit),), scenarios={})


def city() -> Network:
    """Return the paper cycle of a city in which recycled fibre is cheaper than virgin one, and emits more."""
    network = load_network("paper_city")
    costs = {"virgin_fibre": 600.0, "collection": 40.0, "feed": 90.0, "bales_to_mill": 15.0}
    emissions = {"virgin_fibre": 0.2, "feed": 0.6, "bales_to_mill": 0.5}
    arcs = tuple(
        replace(
            arc,
            accounts={
                **({"cost": costs[arc.id]} if arc.id in costs else {}),
                **({"emissions": emissions[arc.id]} if arc.id in emissions else {}),
            },
        )
        for arc in network.arcs
    )
    nodes = tuple(replace(n, holding={"cost": 0.5}) if n.id in ("hall", "bales") else n for n in network.nodes)
    parts: dict[str, Any] = {"arcs": arcs, "nodes": nodes, "services": network.services[:1], "accounts": ACCOUNTS}
    return replace(network, name="city", scenarios={}, **parts)


def test_what_decays_books_what_left_and_what_was_held() -> None:
    """X' = −a·x: flows book c·(x₀ − x_T), discounted by year; stocks book the mean of their ends."""
    network = small({"store": 100.0, "sink": 0.0}, [Arc(id="out", donor="store", recipient="sink", rate=0.2)])
    store, sink = network.nodes
    network = replace(
        network,
        nodes=(replace(store, holding={"cost": 3.0}), replace(sink, accounts={"emissions": 0.5})),
        arcs=(replace(network.arcs[0], accounts={"cost": 7.0}),),
        accounts=(Account(id="cost", unit="EUR_2023", discount=0.5), Account(id="emissions", unit="t CO2e")),
        time_unit="year",
    )
    run = rollout(MultiAgentVectorEnv(network, num_envs=2), Random())
    stock = 100.0 * np.exp(-0.2 * np.arange(6))
    left, held = stock[:-1] - stock[1:], (stock[:-1] + stock[1:]) / 2
    np.testing.assert_allclose(run.bookings[0], [7 * left + 3 * held, 0.5 * left], rtol=1e-12)
    discounted = (7 * left + 3 * held) @ 1.5 ** -(np.arange(5) + 0.5)
    np.testing.assert_allclose(run.accounts[1], [discounted, 0.5 * left.sum()], rtol=1e-12)


@given(seed=st.integers(0, 10_000), nodes=st.integers(2, 8), arcs=st.integers(1, 16), lifetimes=st.booleans())
def test_every_view_books_the_same(seed: int, nodes: int, arcs: int, lifetimes: bool) -> None:
    """Copies alone and together, infos, rollouts and rates agree; what enters a node is what its arcs bring."""
    network = booked(random_network(seed, nodes, arcs, lifetimes=lifetimes), seed)
    env, steps = MultiAgentVectorEnv(network, num_envs=3), network.episode.horizon
    run = rollout(env, Random(), seed=seed)
    ledger = Ledger(network)
    by_flow, by_stock = ledger.rates()
    stock = np.concatenate([run.start[None], run.stock])
    totals = (by_flow * run.flow).sum(axis=(1, 2)) + (by_stock * (stock[1:] + stock[:-1]) / 2).sum(axis=(1, 2))
    size = (abs(by_flow) * run.flow).sum(axis=(1, 2)) + (abs(by_stock) * (stock[1:] + stock[:-1]) / 2).sum(axis=(1, 2))
    np.testing.assert_allclose(run.accounts[0], totals, atol=float(1e-12 * size.max(initial=1.0)))
    np.testing.assert_array_equal(ledger.sums(run.entries.T).T, run.bookings[0].T)
    alone, among = (rollout(MultiAgentVectorEnv(network, num_envs=n), Neutral(), seed=seed) for n in (1, 3))
    np.testing.assert_array_equal(alone.accounts[0], among.accounts[0])
    moved = [
        replace(
            arc,
            accounts={a: _sum(dict(arc.accounts), dict(network.nodes[i].accounts), a) for a in ("cost", "emissions")},
        )
        for arc, i in zip(network.arcs, network.recipients.tolist(), strict=True)
    ]
    elsewhere = replace(network, nodes=tuple(replace(n, accounts={}) for n in network.nodes), arcs=tuple(moved))
    other = rollout(MultiAgentVectorEnv(elsewhere, num_envs=3), Random(), seed=seed)
    np.testing.assert_allclose(other.accounts, run.accounts, atol=float(1e-12 * size.max(initial=1.0)))
    assert run.bookings.shape == (3, 2, steps)


def _sum(first: dict[str, float | Series], second: dict[str, float | Series], account: str) -> float | Series:
    a, b = first.get(account, 0.0), second.get(account, 0.0)
    series = next((x for x in (a, b) if isinstance(x, Series)), None)
    if series is None:
        assert not isinstance(a, Series) and not isinstance(b, Series)
        return a + b
    values = [np.array(x.values) if isinstance(x, Series) else np.full(2, x) for x in (a, b)]
    return replace(series, values=tuple((values[0] + values[1]).tolist()))


def test_infos_hold_what_each_interval_and_the_episode_book() -> None:
    """The parallel view tells amounts as numbers, and totals of the episode at its end."""
    env = parallel_env(city(), horizon=3)
    env.reset(seed=1)
    sums = np.zeros(2)
    for _ in range(3):
        *_, infos = env.step({agent: env.action_space(agent).sample() for agent in env.agents})
        info = next(iter(infos.values()))
        sums += [info["accounts"][account.id] for account in ACCOUNTS]
    batch = MultiAgentVectorEnv(city(), num_envs=2, horizon=3)
    batch.reset(seed=1)
    for _ in range(3):
        *_, infos = batch.step(batch.neutral_action)
    final = next(iter(infos.values()))["final_info"]
    assert final["episode_emissions"].shape == final["episode_cost"].shape == (2,)
    assert (final["episode_emissions"] > 0).all() and (sums > 0).all()


def test_vector_rewards_add_up_to_what_is_reported() -> None:
    """λ̄, levels and totals of an episode, each by itself, and the same for all; a finished episode pays nothing."""
    env = mo_parallel_env(city(), horizon=4)
    assert env.reward_names == ("circularity", "paper_delivered", "cost", "emissions")
    env.reset(seed=2)
    rewards = []
    while env.agents:
        paid = env.step(env.neutral_action)[1]
        assert {reward.tobytes() for reward in paid.values()} == {paid["feed"].tobytes()}
        assert all(env.reward_space(agent).contains(reward) for agent, reward in paid.items())
        rewards.append(paid["feed"])
    state = env.batch.physical
    expected = np.concatenate([state.circularity, state.service[:, 0], -state.accounts[:, 0]])
    np.testing.assert_allclose(np.sum(rewards, axis=0), expected, rtol=1e-5)
    assert len(rewards) == 4 and env.step({})[1] == {}


@given(network=plain_networks)
def test_an_account_of_lambda_has_the_bound_and_the_plan_of_lambda(network: Network) -> None:
    """Two ways to ask for the same thing: keep λ̄ high, or what it counts low."""
    network = certifiable(network, 0.2, pulls=False)
    network = with_lambda(replace(network, objective=replace(network.objective, net_zero="signed")))
    episode = network.episode
    scale = network.objective.reference_interval / (episode.horizon * episode.control_interval)
    high, low = bound(network), bound(network, aim="moved")
    size = scale * float(abs(high.problem.cost) @ np.maximum(abs(high.problem.low), abs(high.problem.high))) / scale
    assert low.objective * scale == pytest.approx(high.objective, abs=1e-5 * max(size, 1e-9))
    run = simulate_plan(low)
    assert -float(run.accounts[0, 0]) * scale == pytest.approx(
        float(run.episode_circularity[0]), abs=1e-9 * size + 1e-9
    )


@pytest.mark.medium
@given(
    network=st.from_type(Network), interval=st.floats(0.02, 0.4), seed=st.integers(0, 1000), aim=st.sampled_from([0, 1])
)
def test_no_episode_books_less_than_the_bound(network: Network, interval: float, seed: int, aim: int) -> None:
    """Random actions on random networks with random rates; with a budget, no episode that keeps it has a higher λ̄."""
    network = booked(bounded(network, interval).network, seed)
    account = ACCOUNTS[aim].id
    least = bound(network, network.initial[1], aim=account)
    run = rollout(MultiAgentVectorEnv(pinned(least), num_envs=24), Random(), seed=seed)
    totals = run.accounts[:, aim]
    size = float(abs(least.problem.cost) @ np.maximum(abs(least.problem.low), abs(least.problem.high)))
    assert (totals >= -least.objective - 1e-9 * max(size, 1.0)).all()
    assert least.verify().bound == least.objective
    budget = float(np.median(totals))
    kept = totals <= budget
    best = bound(network, network.initial[1], at_most={account: budget})
    scale = max(float(abs(best.problem.cost) @ np.maximum(abs(best.problem.low), abs(best.problem.high))), 1.0)
    assert (run.episode_circularity[kept] <= best.objective + 1e-9 * scale).all()


def test_budgets_are_kept_at_a_price_between_the_difference_quotients() -> None:
    """The multiplier of a budget of carbon is its price, within 1 % of quotients of solved programs."""
    network = city().with_options(episode={"horizon": 30})
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


def test_what_cannot_be_asked_for_is_told() -> None:
    """Budgets out of reach, alone or together, unknown accounts, two aims at once."""
    network = city()
    least = {a.id: -bound(network, aim=a.id, min_service=0.95).objective for a in ACCOUNTS}
    with pytest.raises(CirlError, match=r"no actions keep the budget of emissions at most .* \(at least ") as raised:
        bound(network, min_service=0.95, at_most={"emissions": 0.5 * least["emissions"]})
    told = float(str(raised.value).rpartition("at least ")[2].rstrip(")"))
    assert told == pytest.approx(least["emissions"], rel=1e-4)
    hungry = replace(network, services=(replace(network.services[0], low=1e6),))
    with pytest.raises(CirlError, match=r"no actions reach a mean service level of 0.9 of 'paper_delivered'"):
        bound(hungry, min_service=0.9, at_most={"emissions": 1e9})
    for options, message in (
        ({"aim": "costs"}, "Did you mean 'cost'"),
        ({"at_most": {"emission": 1.0}}, "Did you mean 'emissions'"),
        ({"at_most": {"cost": float("nan")}}, "must be a finite number"),
        ({"aim": "cost", "at_most": {"cost": 1.0}}, "kept as low as can be already"),
        ({"aim": "cost", "service_weight": 1.0}, "service_weight goes with"),
        ({"aim": "cost", "uncertain": True}, "go with a certain future"),
        ({"aim": {"cost": 1.0, "cots": 2.0}}, "unknown account 'cots'.*Did you mean 'cost'"),
        ({"aim": {"cost": float("inf")}}, "the weight of 'cost' must be a finite number"),
        ({"aim": {"circularity": -1.0, "cost": 1.0}}, "the weight of 'circularity' must not be negative"),
        ({"aim": {"circularity": 0.0}}, "weights of these that are not all 0"),
        ({"aim": {"circularity": 1.0, "cost": 1.0}, "service_weight": 1.0}, "service_weight goes with"),
    ):
        with pytest.raises(CirlError, match=message):
            bound(network, **options)
    with pytest.raises(CirlError, match="say which service is demanded"):
        plan(network, "optimum", aim="cost")
    with pytest.raises(CirlError, match="go with mpc, scenario_mpc, optimum control, not with best_schedule"):
        plan(network, "best_schedule", at_most={"cost": 1.0})
    with pytest.raises(CirlError, match=r"aim.*Did you mean 'cost'"):
        plan(network, "mpc", aim="costs", min_service=0.9)
    with pytest.raises(CirlError, match="service_weight goes with the aim"):
        MPC(aim="cost", service_weight=1.0)
    with pytest.raises(CirlError, match="horizon 5: whether a budget is kept depends on the whole episode"):
        MPC(horizon=5, at_most={"cost": 1e9}).start(MultiAgentVectorEnv(network, num_envs=1), 0)
    for wrong, words in (
        ({"aim": 3}, "aim: give 'circularity', an account"),
        ({"aim": None}, "aim: give 'circularity', an account"),
        ({"at_most": ["cost"]}, "at_most: give {account: total}"),
        ({"aim": {"cost": 1.0}, "at_most": {"cost": 1.0}}, "kept as low as can be already"),
    ):
        with pytest.raises(CirlError, match=words):
            bound(network, **wrong)
    assert bound(network, aim={"circularity": 1.0}, service_weight=1.0).aims.is_circular


def halfway(network: Network) -> float:
    """Return emissions between the least and those of the best plan, at a service of 0.95."""
    free, least = (bound(network, aim=aim, min_service=0.95).accounts[1] for aim in ("circularity", "emissions"))
    return float(free + least) / 2


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
        MultiAgentVectorEnv(network, num_envs=1, charges={"cost": float("nan")})
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
    assert "this one has 0.5000 less of 'demand'" in control.note
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


@pytest.mark.medium
def test_a_plan_is_not_left_for_a_worse_one() -> None:
    """Where no plan is within the budget, what is done in the end takes no more than the first plan did, or nearly."""
    free = rollout(MultiAgentVectorEnv("steel_japan", num_envs=1, horizon=8), MPC(min_service=0.95))
    control = MPC(min_service=0.95, at_most={"emissions": 0.93 * float(free.accounts[0, 0])})
    run = rollout(MultiAgentVectorEnv("steel_japan", num_envs=1, horizon=8), control)
    assert run.accounts[0, 0] <= free.accounts[0, 0] * (1 + 1e-6)


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
    future = control._planner.futures[0]
    charged = replace(plan.task, charges=np.array([50.0]))
    values = [future.carry_out(task, plan.actions)[2] for task in (plan.task, charged)]
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
    level, bookings, value = control._planner.futures[0].carry_out(plan.task, idle)
    worse = replace(plan, actions=idle, level=np.minimum(level, 1.0).mean(axis=0), bookings=bookings, value=value)
    assert (control._planner.better_of(worse, plan).actions == plan.actions).all()
    assert control._planner.better_of(plan, worse) is plan


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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"accounts": (Account(id="cost", unit="EUR"),)}, "give the year of its prices, as in EUR_2023"),
        ({"accounts": (Account(id="cost", unit="EUR_2023", discount=-1.0),)}, r"must lie in \[-0.99, 10\]"),
        ({"accounts": (Account(id="cost", unit="appels"),)}, "cannot be read"),
        ({"accounts": (Account(id="circularity", unit="t"),)}, "names a figure of every episode"),
        ({"accounts": (Account(id="cost", unit="t"), Account(id="cost", unit="t"))}, "used twice"),
        ({"accounts": (Account(id="costs", unit="EUR_2023"),)}, "Did you mean 'costs'"),
    ],
)
def test_accounts_that_cannot_be_meant_are_refused(change: dict[str, Any], message: str) -> None:
    """Units, discounts, ids and rates of accounts that there are not."""
    network = small({"store": 1.0, "sink": 0.0}, [Arc(id="out", donor="store", recipient="sink", rate=0.2)])
    network = replace(network, accounts=(Account(id="cost", unit="EUR_2023"),))
    network = replace(network, arcs=(replace(network.arcs[0], accounts={"cost": 1.0}),))
    with pytest.raises(NetworkError, match=message):
        replace(network, **change)
    with pytest.raises(NetworkError, match="accounts must be 'cost': a number, got 'much'"):
        much: Any = {"cost": "much"}
        replace(network.arcs[0], accounts=much)
    with pytest.raises(NetworkError, match="it stores nothing; charge what enters it"):
        replace(
            network,
            nodes=(*network.nodes, Node(id="market", role=Role.TECHNOSPHERE, stores=False, holding={"cost": 1.0})),
            arcs=(
                *network.arcs,
                Arc(id="into", donor="store", recipient="market", rate=0.1),
                Arc(id="from", donor="market", recipient="sink", law=Law.SHARE),
            ),
        )


@given(seed=st.integers(0, 10_000))
def test_a_file_reads_back_what_is_booked(seed: int) -> None:
    """Rates in time, uncertain and disturbed ones go to a definition and back to the last bit."""
    import tempfile

    network = booked(random_network(seed, 5, 8), seed)
    arcs = [arc for arc in network.arcs if any(value == value and rate > 0 for value, rate in _plain(arc))]
    if arcs:
        account, _ = next(pair for pair in _plain(arcs[0]) if pair[1] > 0)
        path = f"arcs.{arcs[0].id}.accounts.{account}"
        network = replace(network, uncertain={path: Spread(deviation=0.1)})
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "random.toml"
        write_network(network, file)
        again = load_network(file)
    assert (again.accounts, again.nodes, again.arcs, again.uncertain) == (
        network.accounts,
        network.nodes,
        network.arcs,
        network.uncertain,
    )


def _plain(arc: Arc) -> list[tuple[str, float]]:
    return [(account, rate) for account, rate in dict(arc.accounts).items() if not isinstance(rate, Series)]


def test_units_of_files_are_converted_and_refused(tmp_path: Path) -> None:
    """Rates come in any unit of the account per mass; another currency, or a mass for emissions, is an error."""
    file = tmp_path / "city.toml"
    write_network(city(), file)
    text = file.read_text(encoding="utf-8")
    assert factor("MEUR_2023/kt", "EUR_2023/t") == pytest.approx(1000.0)
    rate = 'cost = {value = 600.0, unit = "(EUR_2023)/(t)"'
    assert rate in text
    file.write_text(text.replace(rate, 'cost = {value = 0.6, unit = "kEUR_2023/t"'), encoding="utf-8")
    assert dict(load_network(file).arcs[10].accounts)["cost"] == pytest.approx(600.0)
    for wrong, message in (
        ('cost = {value = 600.0, unit = "USD_2023/t"', "'USD_2023/t' is inconsistent"),
        ('cost = {value = 600.0, unit = "EUR/t"', "give the year of its prices"),
        ('cost = {value = 600.0, unit = "t/t"', "is inconsistent"),
        ('costs = {value = 600.0, unit = "EUR_2023/t"', "Did you mean 'cost'"),
    ):
        file.write_text(text.replace(rate, wrong), encoding="utf-8")
        with pytest.raises(CirlError, match=f"arcs.virgin_fibre.accounts.*{message}"):
            load_network(file)


def test_uncertain_and_disturbed_prices_are_each_copy_s_own() -> None:
    """A drawn price multiplies what a copy books, a disturbed one what an interval does; flows stay as they are."""
    regime = Markov(values=(1.0, 3.0), matrix=((0.5, 0.5), (0.5, 0.5)))
    plain = city()
    network = replace(
        plain,
        uncertain={"arcs.virgin_fibre.accounts.cost": Spread(low=0.5, high=1.5, distribution="uniform")},
        disturbances={"carbon": regime},
        disturbed={"arcs.virgin_fibre.accounts.emissions": DisturbanceEffect(by="carbon")},
        nodes=tuple(replace(n, accounts={}, holding={}) for n in plain.nodes),
        arcs=tuple(replace(a, accounts=a.accounts if a.id == "virgin_fibre" else {}) for a in plain.arcs),
        accounts=tuple(replace(account, discount=0.0) for account in ACCOUNTS),
    )
    env = MultiAgentVectorEnv(network, num_envs=4, uncertain=True)
    run = rollout(env, Random())
    fibre = network.arc_index["virgin_fibre"]
    draws = env.physical.factors[0]
    assert len(set(draws.tolist())) == 4
    np.testing.assert_allclose(run.bookings[0, 0], 600 * draws[0] * run.flow[:, fibre], rtol=1e-12)
    np.testing.assert_allclose(run.bookings[0, 1], 0.2 * run.disturbances[0, :, 0] * run.flow[:, fibre], rtol=1e-12)
    certain = env.certain_network(0)
    again = Ledger(certain).rates()[0] * run.flow
    np.testing.assert_allclose(again.sum(axis=(1, 2)), run.accounts[0], rtol=1e-12)


def test_the_command_line_writes_and_plans(tmp_path: Path) -> None:
    """``simulate`` says totals and writes who books what; ``plan`` keeps costs low under a budget."""
    file = tmp_path / "city.toml"
    write_network(city().with_options(episode={"horizon": 14}), file)
    result = CliRunner().invoke(app, ["simulate", str(file), "--out", str(tmp_path)])
    assert result.exit_code == 0, result.output
    assert "accounts: cost" in result.output
    with (tmp_path / "city_neutral_accounts.csv").open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    sums = sum(float(row["discounted"]) for row in rows if row["account"] == "cost")
    assert f"cost {sums:.5g} EUR_2023" in " ".join(result.output.split())
    assert (tmp_path / "city_neutral_accounts.png").stat().st_size > 1000
    asked = ["--control", "optimum", "--min-service", "0.9", "--aim", "cost", "--at-most"]
    out = ["--out", str(tmp_path / "p.csv")]
    result = CliRunner().invoke(app, ["plan", str(file), *asked, "emissions=100000", *out])
    assert result.exit_code == 0, result.output
    assert "one more is worth 0 EUR_2023" in " ".join(result.output.split())
    assert "cost ≥" in result.output and "emissions at most 100000 t CO2e" in " ".join(result.output.split())
    result = CliRunner().invoke(app, ["plan", str(file), *asked, "emissions", *out])
    assert "needs ACCOUNT=TOTAL" in str(result.exception)


@given(seed=st.integers(0, 10_000), shown=st.integers(1, 9))
def test_steps_of_who_books_lead_to_the_total(seed: int, shown: int) -> None:
    """Costs and revenues, the largest first, those that are not shown apart as one; nothing is in two of them."""
    network = booked(random_network(seed, 6, 12), seed)
    arcs = [replace(arc, accounts={"cost": -3.0, **dict(arc.accounts)}) for arc in network.arcs]
    simulation = simulate(replace(network, arcs=tuple(arcs)), "random")
    for place, account in enumerate(network.accounts):
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr("cirl_marl.report.account_tables.SHOWN", shown)
            steps = account_steps(simulation, place)
        sizes = [abs(amount) for _, _, amount in steps[:shown]]
        total, amounts = float(simulation.rollout.accounts[0, place]), [amount for _, _, amount in steps]
        assert sum(amounts) == pytest.approx(total, rel=1e-9, abs=1e-9 * max(sizes, default=0.0))
        assert sizes == sorted(sizes, reverse=True) and len(steps) <= shown + 1
        rows = [row for row in accounts_table(simulation)[1] if row[0] == account.id]
        assert [row[2] for row in rows[:shown]] == [label for label, _, _ in steps[:shown]]
        assert len(steps) <= shown or steps[-1][0] == f"{len(rows) - shown} others"
        entries = [entry for _, part, _ in steps for entry in part]
        assert len(entries) == len(set(entries)) and {*simulation.env.ledger.account[entries]} <= {place}


def test_each_step_of_a_waterfall_begins_where_the_last_one_ends() -> None:
    """From the start on, to either side; its note stands to the right of it."""
    axes = Figure().subplots()
    draw_steps(axes, np.array([3.0, -5.0, 1.0]), ["red", "green", "blue"], ["a", "b", "c"], start=2.0)
    boxes = [bar.get_bbox() for bar in axes.patches if isinstance(bar, Rectangle)]
    ends = [(box.x0, box.x1, (box.y0 + box.y1) / 2) for box in boxes]
    np.testing.assert_allclose(ends, [(2, 5, 1), (5, 0, 2), (0, 1, 3)], atol=1e-12)
    lines = [np.asarray(line.get_xydata()).tolist() for line in axes.lines]
    assert lines == [[[x, i], [x, i + 1]] for i, x in enumerate([2.0, 5.0, 0.0, 1.0])]
    np.testing.assert_allclose([note.get_position() for note in axes.texts], [(5.075, 1), (5.075, 2), (1.075, 3)])
    assert [note.get_text() for note in axes.texts] == ["a", "b", "c"]


def test_pictures_show_who_books_what_and_the_total(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In the colours of the stacks beside it; an account on which nobody books has a total of 0."""
    figures = list[Figure]()
    monkeypatch.setattr("cirl_marl.report.account_tables.save", lambda figure, path: figures.append(figure))
    accounts = (*ACCOUNTS, Account(id="idle", unit="t"))
    simulation = simulate(replace(city(), accounts=accounts), "scripted", steps=3)
    save_accounts(tmp_path / "accounts.png", simulation, title="city")
    (cost, waterfall, _, _, _, idle) = figures[0].axes
    steps = account_steps(simulation, 0)
    labels = [tick.get_text() for tick in waterfall.get_yticklabels()]
    assert labels == [*(label for label, _, _ in steps), f"total {number(simulation.rollout.accounts[0, 0])}"]
    assert [tick.get_text() for tick in idle.get_yticklabels()] == ["total 0"]
    bars = [bar for bar in waterfall.patches if isinstance(bar, Rectangle)]
    assert [bar.get_width() for bar in bars] == pytest.approx(
        [*(amount for _, _, amount in steps), simulation.rollout.accounts[0, 0]]
    )
    assert [bar.get_facecolor() for bar in bars[:-1]] == [bar.get_facecolor() for bar in cost.patches[::3]]
    assert "discounted" in waterfall.get_title("left") and "discounted" not in idle.get_title("left")


@pytest.mark.slow
def test_the_front_of_two_aims_is_proved_and_reached(tmp_path: Path) -> None:
    """Plans lie on the worse side of the front and near it; prices are its slope; both have a hypervolume."""
    file = tmp_path / "city.toml"
    write_network(city(), file)
    for axes in (("circularity", "emissions"), ("cost", "emissions")):
        front = account_front(file, axes, min_service=0.9, points=4)
        at_plans = front.at(front.plans[:, 1])
        assert (front.sign * (at_plans - front.plans[:, 0]) >= -1e-5 * abs(at_plans)).all()
        np.testing.assert_allclose(front.at(front.budgets), front.bounds, rtol=1e-4)
        assert (np.diff(front.prices) <= 1e-6 * front.prices[0]).all() and front.prices[0] > 0
        assert (front.plans[:, 1] <= front.budgets * (1 + 1e-4)).all() and (front.levels <= 1).all()
        proved, achieved = front.volumes
        assert 0.99 * proved <= achieved <= proved * (1 + 1e-5)
        assert replace(front, shortages=np.ones(4)).volumes == (proved, 0.0)
    out = ["--min-service", "0.9", "--points", "3", "--out", str(tmp_path / "front")]
    result = CliRunner().invoke(app, ["pareto", str(file), "--between", "cost,emissions", *out])
    assert result.exit_code == 0, result.output
    with (tmp_path / "front" / "pareto.csv").open(encoding="utf-8") as lines:
        assert len(list(csv.reader(lines))) == 4
    assert (tmp_path / "front" / "pareto.png").stat().st_size > 1000
    with pytest.raises(CirlError, match="then another account"):
        account_front(file, ("cost", "circularity"), min_service=0.9)
    with pytest.raises(CirlError, match="nothing to weigh"):
        account_front(with_lambda(load_network("paper_city")), ("circularity", "moved"), min_service=0.9)
    with pytest.raises(CirlError, match="nothing to weigh"):  # less ore is less of both
        account_front("copper_world", ("circularity", "emissions"), min_service=1.0)


@pytest.mark.parametrize(
    ("name", "least", "most"),
    [("steel_world", 3300.0, 3800.0), ("aluminium_world", 900.0, 1150.0), ("copper_world", 87.0, 110.0)],
)
def test_emissions_of_the_first_year_are_near_those_reported(name: str, least: float, most: float) -> None:
    """worldsteel: 1.91 t CO2 a tonne of 1.89 Gt of steel; International Aluminium Institute: 1.11 Gt with rolling.

    International Copper Association: 97 Mt for the refined copper of 2018.
    """
    run = rollout(MultiAgentVectorEnv(name, num_envs=1, horizon=1), Neutral())
    assert least <= float(run.bookings[0, 0, 0]) <= most


def test_copies_and_intervals_keep_what_is_booked() -> None:
    """Regions share accounts, each compartment of a copy its rates; a network of other intervals has their rates."""
    world = load_network("steel_world")
    assert [account.id for account in world.accounts] == ["emissions"]
    assert dict(world.compartments["japan_pig_iron_made"].accounts) == {"emissions": pytest.approx(0.00259)}
    network = booked(random_network(5, 6, 12), 5)
    steps = network.episode.horizon
    backwards = network_of_intervals(network, np.arange(steps)[::-1])
    undiscounted = [
        replace(each, accounts=tuple(replace(a, discount=0.0) for a in ACCOUNTS)) for each in (network, backwards)
    ]
    for rates, others in zip(*(Ledger(each).rates() for each in undiscounted), strict=True):
        np.testing.assert_allclose(rates[:, ::-1], others)
    assert any(isinstance(rate, Series) for arc in network.arcs for rate in dict(arc.accounts).values())


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


def test_a_step_of_a_plan_knows_what_it_books() -> None:
    """To first order the program of a step has the account that is kept low, and the budget, as the simulator does."""
    network = city()
    # so that what is held counts as much as what flows
    nodes = tuple(replace(n, holding={"cost": 5.0}) if n.holding else n for n in network.nodes)
    network = replace(network, nodes=nodes)
    solved = bound(network, aim="cost", min_service=0.9, at_most={"emissions": 3000.0})
    rng, dynamics = np.random.default_rng(0), Dynamics(network)
    middle = replace(solved, actions=rng.uniform(-0.5, 0.5, solved.actions.shape))
    run = simulate_plan(middle)
    program = step_program(middle, dynamics, run, np.array([0.9]), np.ones(2), 0.1, jacobians(middle, dynamics))
    moves = np.zeros(len(program.origin))
    moves[program.action] = 1e-4 * rng.uniform(-1, 1, program.action.shape)
    trial = simulate_plan(replace(middle, actions=middle.actions + moves[program.action]))
    books = trial.accounts[0] - run.accounts[0]
    row = program.problem.under[[len(program.problem.under_to) - 1]].toarray()[0]
    assert program.problem.cost @ moves == pytest.approx(books[0], rel=1e-3)
    assert row @ moves == pytest.approx(books[1], rel=1e-3)
    assert program.problem.under_to[-1] == pytest.approx(3000.0 - run.accounts[0, 1])
    moves *= 3000.0
    trial = simulate_plan(replace(middle, actions=np.clip(middle.actions + moves[program.action], -1.0, 1.0)))
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


def test_gradients_by_uncertain_and_disturbed_prices() -> None:
    """A total is linear in a factor on one of its rates: the derivative is what that rate books at a factor of 1."""
    network = replace(
        city(),
        uncertain={"arcs.feed.accounts.cost": Spread(low=0.5, high=1.5, distribution="uniform")},
        disturbances={"carbon": Markov(values=(1.0, 3.0), matrix=((0.5, 0.5), (0.5, 0.5)))},
        disturbed={"arcs.feed.accounts.emissions": DisturbanceEffect(by="carbon")},
    ).with_options(episode={"horizon": 3})
    env = MultiAgentVectorEnv(network, num_envs=2, uncertain=True)
    env.reset(seed=1)
    actions = env.stack(env.neutral_action)[None].repeat(3, axis=0)
    found = gradient(env, actions, circularity=0.0, accounts=[1.0, 1.0])
    run = rollout(env, Neutral(), seed=1)
    flow, discount = run.flow[:, network.arc_index["feed"]], env.ledger.discount
    np.testing.assert_allclose(found.draws[0, 0], 90 * (discount[0, :3] @ flow), rtol=1e-10)
    np.testing.assert_allclose(found.disturbances[:3, 0, 0], 0.6 * discount[1, :3] * flow, rtol=1e-10)


def test_pages_show_what_is_booked() -> None:
    """Each interval's amounts, and the totals of episodes, with their units."""
    simulation = simulate(city(), "scripted", steps=5)
    page = page_data(page_of_alternatives([simulation]))
    run = simulation.rollout
    assert [(each["id"], each["unit"]) for each in page["networks"][0]["accounts"]] == [
        ("cost", "EUR_2023"),
        ("emissions", "t CO2e"),
    ]
    (scene,) = page["scenes"]
    np.testing.assert_allclose([each["value"] for each in scene["accounts"]], run.bookings[0], rtol=1e-5)
    assert scene["figures"]["account:cost"][0] == pytest.approx(run.accounts[0, 0], rel=1e-5)


def test_samples_and_comparisons_tell_what_is_booked(tmp_path: Path) -> None:
    """An uncertain price spreads costs and nothing else, and is named as what causes that; batches of episodes add."""
    price = {"arcs.virgin_fibre.accounts.cost": Spread(deviation=0.2)}
    network = replace(city(), uncertain=price).with_options(episode={"horizon": 10})
    samples = sample_episodes(network, samples=80)
    assert np.ptp(samples.accounts[:, 0]) > 0 and np.ptp(samples.accounts[:, 1]) <= 1e-9 * samples.accounts[:, 1].max()
    by_figure = {cause.figure: cause.shares[0] for cause in sensitivities(samples)}
    assert by_figure["cost"] > 0.9 and np.isnan(by_figure["emissions"])
    bands, draws, *_ = write_samples(tmp_path, "city", samples, [], title="city")
    assert "cost,EUR_2023" in bands.read_text() and "cost (EUR_2023)" in draws.read_text().splitlines()[0]
    parts = [rollout(MultiAgentVectorEnv(network, num_envs=n), Random(), seed=seed) for n, seed in ((2, 1), (3, 9))]
    whole = concatenation(*parts)
    notes = {name: note.__metadata__[0] for name, note in get_type_hints(Rollout, include_extras=True).items()}
    episodes = {name for name, note in notes.items() if "shape (B," in note}
    assert {"accounts", "bookings", "levels"} <= episodes
    assert all(len(getattr(whole, name)) == 5 for name in episodes)
    found = compare([], ["neutral"], network=network, episodes=3, bounds=False)
    told = summary_of(found)["rows"][0]["accounts"]["emissions"]["value"]
    assert told == pytest.approx(float(found.entries[0].rollout.accounts[:, 1].mean()))


@pytest.mark.slow
def test_levers_tell_what_they_add_to_accounts(tmp_path: Path) -> None:
    """Alone, with those above, which adds up, and left out; the table has what each does alone."""
    found = levers(city().with_options(episode={"horizon": 20}), min_service=0.9)
    changes = np.array([found.account_changes(row) for row in range(len(found.rows))])
    together = found.together.run.accounts[0] - found.usual.run.accounts[0]
    np.testing.assert_allclose(changes[:, 1].sum(axis=0), together, rtol=1e-9)
    alone = found.rows[0].alone.run.accounts[0] - found.usual.run.accounts[0]
    np.testing.assert_allclose(changes[0, 0], alone)
    path, *_ = write_levers(found, tmp_path / "levers")
    with path.open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    told = [float(row["alone: change of emissions (t CO2e)"]) for row in rows]
    np.testing.assert_allclose(told, changes[:, 0, 1], rtol=1e-9)
    assert any("emissions, alone" in str(column.header) for column in levers_table(found).columns)


def test_years_go_to_the_format_of_scenario_databases(tmp_path: Path) -> None:
    """Every stock, flow and amount stands there to the last digit, under its region; parts add up to the account."""
    world, japan = simulate("steel_world", steps=2), simulate("steel_japan", steps=2)
    with write_iamc(tmp_path / "iamc.csv", [world, japan]).open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    keys = [(row["Scenario"], row["Region"], row["Variable"]) for row in rows]
    assert len(set(keys[: -_size(japan)])) == len(keys) - _size(japan)
    table = {(row["Region"], row["Variable"]): row for row in rows[: -_size(japan)]}
    network, run = world.network, world.rollout
    made = table["japan", "Flow|pig_iron_made"]
    assert made["Unit"] == "kt/yr" and made["Model"].startswith("cirl_marl ")
    assert [float(made[year]) for year in ("2025", "2026")] == run.flow[
        :, network.arc_index["japan_pig_iron_made"]
    ].tolist()
    total = [float(table["World", "Greenhouse gases"][year]) for year in ("2025", "2026")]
    parts = [row for (_, variable), row in table.items() if variable.startswith("Greenhouse gases|")]
    assert {row["Region"] for row in parts} >= {"japan", "china"}
    np.testing.assert_allclose([sum(float(row[year]) for row in parts) for year in ("2025", "2026")], total, rtol=1e-9)
    assert rows[-1]["Region"] == "japan" and total == run.bookings[0, 0].tolist()
    with pytest.raises(CirlError, match="IAMC has calendar years; give"):
        write_iamc(tmp_path / "no.csv", [simulate(city(), steps=2)])
    with pytest.raises(CirlError, match="Circularity would come 2 times; give other titles"):
        write_iamc(tmp_path / "no.csv", [japan, japan])
    with pytest.raises(CirlError, match="give at least one episode"):
        write_iamc(tmp_path / "no.csv", [])
    with pytest.raises(CirlError, match="no such file"):
        read_iamc(tmp_path / "no.csv")
    with pytest.raises(CirlError, match="different years"):
        write_iamc(tmp_path / "no.csv", [japan, simulate("steel_japan", steps=3)])


def test_years_come_back_from_files_of_scenario_databases(tmp_path: Path) -> None:
    """What was written, to the last digit; empty cells are missing; what is wrong is named with its line."""
    japan = simulate("steel_japan", steps=3)
    path = write_iamc(tmp_path / "iamc.csv", [japan])
    rows = {row.variable: row for row in read_iamc(path)}
    assert len(rows) == _size(japan)
    pig_iron = rows["Flow|pig_iron_made"]
    flow = japan.rollout.flow[:, japan.network.arc_index["pig_iron_made"]]
    assert pig_iron.values == dict(zip((2025, 2026, 2027), flow.tolist(), strict=True)) and pig_iron.unit == "kt/yr"
    head = "Model,Scenario,Region,Variable,Unit,2025,2030\n"
    path.write_text(f"{head}m,s,World,Primary Energy,EJ/yr,,3.5\n")
    assert [dict(row.values) for row in read_iamc(path)] == [{2030: 3.5}]
    for text, message in (
        (head.replace("Unit", "Units"), "unknown column 'Unit'. Did you mean 'Units'"),
        (head.replace("2030", "notes"), "column 'notes' is no year"),
        (head.replace("2030", "2025"), "column '2025' comes a second time"),
        (f"{head}m,s,World,Steel,t,1,many\n", "line 2: the value of 2030 is no finite number"),
        (f"{head}m,s,World,Steel,t,1,2\nm,s,World,Steel,kt,1,2\n", "line 3: m, s, World, Steel comes a second time"),
    ):
        path.write_text(text)
        with pytest.raises(CirlError, match=message):
            read_iamc(path)


@pytest.mark.parametrize("name", ["city", "copper_net", "steel_japan"])
def test_a_data_package_has_a_network_and_its_episode(tmp_path: Path, name: str) -> None:
    """All numbers come back as they were, with a network that moves in the same way."""
    network = city().with_options(episode={"horizon": 5}) if name == "city" else load_network(name)
    done = simulate(network, steps=5)
    descriptor = json.loads(write_package(tmp_path / "package", done).read_text(encoding="utf-8"))
    assert {part["name"] for part in descriptor["resources"]} >= {"nodes", "arcs", "stocks", "flows", "accounts"}
    back, run = read_package(tmp_path / "package"), done.rollout
    assert (back.scenario, back.control) == ("default", "neutral")
    np.testing.assert_array_equal(back.stock, np.concatenate([run.start[None], run.stock]))
    np.testing.assert_array_equal(back.flow, run.flow)
    np.testing.assert_array_equal(back.levels, run.levels[0].T)
    np.testing.assert_array_equal(back.circularity, run.circularity_mean[0])
    np.testing.assert_allclose(back.bookings, run.bookings[0].T, rtol=1e-12)
    again = simulate(back.network, steps=5).rollout
    np.testing.assert_allclose(again.flow, run.flow, rtol=1e-9, atol=1e-9 * np.abs(run.flow).max())
    with pytest.raises(CirlError, match="package: exists; a data package is a folder of its own"):
        write_package(tmp_path / "package", done)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("flows.csv", "0,feed,", "0,fed,", "flows.csv, line .*: unknown arc 'fed'.*Did you mean 'feed'"),
        ("flows.csv", "interval,arc,flow", "interval,arc,floww", "unknown column 'flow'.*Did you mean 'floww'"),
        ("stocks.csv", "2,hall,", "7,hall,", "interval '7' is none of 0 to 2"),
        ("stocks.csv", "2,hall,", "2,hall,x", "stock 'x.*' is no finite number"),
        ("circularity.csv", "1,", "0,", "line 3: circularity of the network comes a second time"),
        ("flows.csv", "1,feed,", "0,feed,", "flows.csv, line .*: flow of feed comes a second time"),
        ("stocks.csv", "2,hall,", "2,hall,1\n2,bales,", "stocks.csv, line .*: stock of bales comes a second time"),
        ("datapackage.json", '"name": "services"', '"name": "service"', "unknown table 'services'.*'service'"),
        ("datapackage.json", '"resources"', '"resource"', "unknown table 'stocks'"),
    ],
)
def test_data_packages_that_say_something_else_are_refused(
    tmp_path: Path, file: str, old: str, new: str, message: str
) -> None:
    """With the file, the line, and the nearest valid name."""
    write_package(tmp_path / "package", simulate(city(), steps=2))
    path = tmp_path / "package" / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(CirlError, match=message):
        read_package(tmp_path / "package")


def test_what_nobody_books_comes_back_as_nothing(tmp_path: Path) -> None:
    """And a table that is not there is named."""
    network = replace(city(), accounts=(*ACCOUNTS, Account(id="idle", unit="t")))
    write_package(tmp_path / "package", simulate(network, steps=2))
    back = read_package(tmp_path / "package")
    assert not back.bookings[:, 2].any() and back.bookings[:, :2].all()
    (tmp_path / "package" / "flows.csv").unlink()
    with pytest.raises(CirlError, match=r"flows\.csv: no such file"):
        read_package(tmp_path / "package")


def test_the_command_writes_a_data_package(tmp_path: Path) -> None:
    """Of one episode; of several it says what to give."""
    package = ["simulate", "paper_city", "--steps", "3", "--out", str(tmp_path), "--package", str(tmp_path / "data")]
    done = CliRunner().invoke(app, package)
    assert done.exit_code == 0 and "datapackage.json" in done.output
    assert len(read_package(tmp_path / "data").flow) == 3
    several = ["--control", "neutral", "--control", "random"]
    for more, message in ((several, "holds one episode"), (["--samples", "2"], "go without --samples")):
        refused = CliRunner().invoke(app, [*package, *more])
        assert isinstance(refused.exception, CirlError) and message in str(refused.exception)


def test_what_no_file_holds_is_refused_before_anything_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names of files, years and titles are known before an episode is."""
    monkeypatch.setattr("cirl_marl.evaluation.simulations.rollout", None)
    (tmp_path / "file").touch()
    iamc, japan, twice = str(tmp_path / "iamc.csv"), ["steel_japan"], tmp_path / "twice.toml"
    network = load_network("steel_japan")
    write_network(replace(network, accounts=(replace(network.accounts[0], title="Circularity"),)), twice)
    for arguments, message in (
        ([*japan, "--iamc", "iamc.xlsx"], "--iamc iamc.xlsx: needs the name of a .csv file"),
        ([*japan, "--iamc", str(tmp_path / "file" / "iamc.csv")], "file is a file, not a folder"),
        (["paper_city", "--iamc", iamc], "IAMC has calendar years; give"),
        ([str(twice), "--iamc", iamc], "Circularity would come 2 times; give other titles"),
        ([*japan, "--package", str(tmp_path / "file" / "data")], "file is a file, not a folder"),
    ):
        refused = CliRunner().invoke(app, ["simulate", *arguments, "--out", str(tmp_path)])
        assert isinstance(refused.exception, CirlError) and message in str(refused.exception)
    assert {path.name for path in tmp_path.iterdir()} == {"file", "twice.toml"}


def test_the_command_writes_years_of_scenarios_and_controls(tmp_path: Path) -> None:
    """Of as many steps as are asked for, which scenarios may differ in otherwise."""
    path, controls = tmp_path / "iamc.csv", ["--control", "neutral", "--control", "random"]
    options = ["--steps", "2", "--out", str(tmp_path), "--iamc", str(path)]
    done = CliRunner().invoke(app, ["simulate", "steel_japan", *controls, *options])
    assert done.exit_code == 0, done.output
    rows = read_iamc(path)
    assert {row.scenario for row in rows} == {"steel_japan default neutral", "steel_japan default random"}
    assert {tuple(row.values) for row in rows} == {(2025, 2026)}
    file = tmp_path / "japan.toml"
    write_network(load_network("steel_japan"), file)
    short = '\n[scenarios.short.episode]\nhorizon = { value = 3, unit = "1", source = "chosen" }\n'
    file.write_text(file.read_text(encoding="utf-8") + short, encoding="utf-8")
    done = CliRunner().invoke(app, ["simulate", str(file), "--scenario", "default", "--scenario", "short", *options])
    assert done.exit_code == 0, done.output
    assert {row.scenario for row in read_iamc(path)} == {"steel_japan default neutral", "steel_japan short neutral"}


def _size(simulation: Simulation) -> int:
    network = simulation.network
    parts = {(simulation.env.ledger.account[e], c) for e, c in enumerate(simulation.env.ledger.compartments)}
    figures = 1 + len(network.services) + len(network.stores) + len(network.arcs)
    return figures + len(network.accounts) + len(parts)


def test_small_accounts_differ_beside_large_ones() -> None:
    """Round-off is that of the account itself: what comes to a few tonnes is not lost beside what comes to billions."""
    network = city()
    huge = tuple(replace(a, accounts={**dict(a.accounts), "cost": 1e15}) for a in network.arcs)
    cases = simulate_alternatives(replace(network, arcs=huge), controls=["neutral", "scripted", "random"], steps=4)
    ranks = {q.of: q.rank for q in rank_quantities(cases) if q.kind == "account"}
    totals = [case.rollout.accounts[0] for case in cases]
    assert np.ptp([total[1] for total in totals]) < 1e-12 * totals[0][0]
    assert ranks["emissions"] > 0


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
