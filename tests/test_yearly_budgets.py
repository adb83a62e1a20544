"""Budgets of accounts per year: what is proved, planned and told beside them, and where they are refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_networks import ACCOUNTS, booked, city, small
from test_budgets import first_window, small_step
from test_optimum import bounded, pinned
from typer.testing import CliRunner

from cirl_marl import (
    MPC,
    Account,
    Arc,
    CirlError,
    Control,
    ControlKind,
    Law,
    MultiAgentVectorEnv,
    Network,
    Series,
    Trained,
    bound,
    load_network,
    load_recipe,
    train,
    write_network,
)
from cirl_marl.cli import app
from cirl_marl.controllers import Neutral, Random
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.learners.policies import Policies
from cirl_marl.learners.validation import FIRST_SEED, Multipliers, validation_score
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect
from cirl_marl.optimum import improve, improve_plan, simulate_plan, smooth_plan
from cirl_marl.optimum.aims import aims_of, budget_texts


def yearly(horizon: int = 6) -> Network:
    """Return the city with a year in place of a day; nothing is discounted."""
    network = city().with_options(episode={"horizon": horizon})
    return replace(network, time_unit="year", accounts=tuple(replace(each, discount=0.0) for each in ACCOUNTS))


def by_year(run: Rollout) -> Any:
    """Return the emissions of each interval, which is a year."""
    return run.bookings[0, 1]


@pytest.mark.parametrize("start", [None, 2030.5])
def test_a_budget_per_year_is_spent_when_it_earns_most(start: float | None) -> None:
    """Of flows that emit as much in each half of a year, and earn differently, by a program written by hand.

    In five halves from a January on there are three years, from a July on as many; each has what it may emit.
    """
    price = np.array([3.0, 5.0, 2.0, 4.0, 1.0])
    earns = Series(times=tuple(np.arange(6) / 2), values=(*-price, 0.0), interpolation="step")
    sale = Arc(
        id="sale",
        donor="store",
        recipient="market",
        law=Law.CONTROLLED,
        control=Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=10.0),
    )
    network = small({"store": 1000.0, "market": 0.0}, [sale], interval=0.5)
    accounts = (Account(id="earnings", unit="EUR_2023"), Account(id="emissions", unit="t CO2e", discount=0.1))
    arcs = (replace(sale, accounts={"earnings": earns, "emissions": 0.5}),)
    network = replace(network, accounts=accounts, arcs=arcs, time_unit="year").with_options(episode={"start": start})
    kept = bound(network, aim="earnings", at_most={"emissions/year": 1.0})
    parts = [[0, 1], [2, 3], [4]] if start is None else [[0], [1, 2], [3, 4]]
    assert kept.objective == pytest.approx(sum(2.0 * price[part].max() for part in parts))  # 2 t emit 1 t CO2e
    names = ("year 1", "year 2", "year 3") if start is None else ("2030", "2031", "2032")
    expected = {f"emissions in {name}": 2.0 * price[part].max() for name, part in zip(names, parts, strict=True)}
    assert kept.budget_prices == pytest.approx(expected)
    assert kept.accounts[0] == pytest.approx(-kept.objective)
    run = simulate_plan(kept)
    sums = [run.bookings[0, 1, part].sum() for part in parts]
    np.testing.assert_allclose(sums, 1.0, atol=1e-6)
    np.testing.assert_allclose(kept.aims.totals(run), sums)


def test_the_budget_of_the_only_year_is_that_of_the_episode() -> None:
    """Of an account that is not discounted: the same bound, price and plan; both together are no more than either."""
    network = city().with_options(episode={"horizon": 30})
    free, least = (bound(network, aim=aim, min_service=0.95).accounts[1] for aim in ("circularity", "emissions"))
    most = float(free + least) / 2
    in_all, in_year, both = (
        bound(network, min_service=0.95, at_most=dict.fromkeys(names, most))
        for names in (["emissions"], ["emissions/year"], ["emissions/year", "emissions"])
    )
    assert in_all.objective == in_year.objective == pytest.approx(both.objective, rel=1e-6)
    assert [*in_all.budget_prices.values()] == [*in_year.budget_prices.values()]
    assert [*both.budget_prices] == ["emissions in year 1", "emissions"]
    np.testing.assert_array_equal(in_all.actions, in_year.actions)


@pytest.mark.slow
@given(
    network=st.from_type(Network),
    interval=st.floats(0.2, 0.7),
    seed=st.integers(0, 1000),
    place=st.sampled_from([0, 1]),
)
def test_no_episode_that_keeps_each_year_is_above_the_bound(
    network: Network, interval: float, seed: int, place: int
) -> None:
    """Random actions on random networks with random rates, in up to three years."""
    network = replace(booked(bounded(network, interval).network, seed), time_unit="year")
    free = bound(network, network.initial[1])
    run = rollout(MultiAgentVectorEnv(pinned(free), num_envs=24), Random(), seed=seed)
    account, middle = ACCOUNTS[place].id, np.arange(network.episode.horizon) + 0.5
    year = (middle * network.episode.control_interval).astype(int)
    years = np.stack([run.bookings[:, place, year == number].sum(axis=1) for number in range(year[-1] + 1)])
    budget = float(np.median(years.max(axis=0)))
    kept = (years <= budget).all(axis=0)
    best = bound(network, network.initial[1], at_most={f"{account}/year": budget})
    scale = max(float(abs(best.problem.cost) @ np.maximum(abs(best.problem.low), abs(best.problem.high))), 1.0)
    assert kept.any() and (run.episode_circularity[kept] <= best.objective + 1e-9 * scale).all()
    assert best.verify().bound == best.objective
    assert float(best.at()) == pytest.approx(best.objective, rel=1e-9, abs=1e-12 * scale)
    size = float((abs(best.problem.under) @ abs(best.solution)).max(initial=1.0))
    assert (best.problem.under @ best.solution <= best.problem.under_to + 1e-5 * size).all()


@pytest.mark.parametrize("most_slopes", [None, 0])
def test_plans_keep_the_budget_of_each_year(monkeypatch: pytest.MonkeyPatch, most_slopes: int | None) -> None:
    """Small ones by Jacobians, large ones by tightening; a budget of the years is worth what solved programs say."""
    if most_slopes is not None:
        monkeypatch.setattr(improve, "MOST_SLOPES", most_slopes)
    network = yearly()
    free, least = (bound(network, aim=aim, min_service=0.95) for aim in ("circularity", "emissions"))
    most = 1.05 * float(by_year(simulate_plan(least)).max())
    assert most < by_year(simulate_plan(free)).max()
    solved = bound(network, min_service=0.95, at_most={"emissions/year": most})
    plan = improve_plan(solved)
    run = simulate_plan(plan if most_slopes == 0 else smooth_plan(plan))
    assert by_year(run).max() <= most * (1 + 1e-3 * (most_slopes == 0) + 1e-4)
    assert run.episode_levels.min() >= 0.95 - 1e-3
    assert solved.gap(solved.aims.value(run)) <= 0.02
    step = 1e-3 * most
    around = [bound(network, min_service=0.95, at_most={"emissions/year": most + way * step}) for way in (-1, 1)]
    quotients = np.diff([around[0].objective, solved.objective, around[1].objective]) / step
    assert 0.99 * quotients[1] <= sum(solved.budget_prices.values()) <= 1.01 * quotients[0]
    assert f"emissions at most {most:.6g} t CO2e a year;" in str(solved)


def test_a_step_of_a_plan_knows_what_each_year_books() -> None:
    """To first order, stocks included, as the simulator does; what is discounted in all is not within a year."""
    network = yearly(4)
    stores = [replace(node, holding={"emissions": 0.05}) if node.stores else node for node in network.nodes]
    network = replace(network, nodes=tuple(stores), accounts=tuple(replace(a, discount=0.3) for a in ACCOUNTS))
    solved = bound(network, min_service=0.5, at_most={"emissions/year": 3000.0, "emissions": 9000.0})
    _, program, moves, run, trial = small_step(solved, 0.5)
    changes = np.append(by_year(trial) - by_year(run), trial.accounts[0, 1] - run.accounts[0, 1])
    np.testing.assert_allclose(program.problem.under[-5:] @ moves, changes, rtol=1e-3)
    np.testing.assert_allclose(program.problem.under_to[-5:-1], 3000.0 - by_year(run))


def test_budgets_per_year_that_cannot_be_meant_are_refused() -> None:
    """Other periods, intervals of several years, out of reach, and whoever keeps budgets of episodes alone."""
    network = yearly()
    least = float(by_year(simulate_plan(bound(network, aim="emissions", min_service=0.95))).max())
    slow = replace(network, time_unit="century")
    for name, of, message in (
        ("emissions/month", network, "'emissions/month': a budget is of an episode, 'emissions', or 'emissions/year'"),
        ("emissions/", network, "'emissions/': a budget is of an episode"),
        ("/year", network, "at_most: '/year' names no account; write one before it, as in 'NAME/year'"),
        ("emission/year", network, "unknown account 'emission'. Did you mean 'emissions'"),
        ("emissions/year", slow, "'emissions/year': an interval, 1 century, is longer than a year; give the total"),
    ):
        with pytest.raises(CirlError, match=message):
            bound(of, at_most={name: 1.0})
    with pytest.raises(CirlError, match=r"the budget of 'emissions/year' must be a finite number"):
        bound(network, at_most={"emissions/year": float("nan")})
    with pytest.raises(CirlError, match=r"the budget of emissions in year 1 at most .*\(at least .*emissions in year"):
        bound(network, min_service=0.95, at_most={"emissions/year": 0.5 * least})
    assert bound(network, aim="emissions", min_service=0.95, at_most={"emissions/year": 1.01 * least}).verify()
    given = load_recipe("exact_gradients")
    recipe = given.model_copy(update={"run": given.run.model_copy(update={"at_most": {"emission/year": 1e9}})})
    with pytest.raises(CirlError, match=r"at_most: unknown account 'emission'. Did you mean 'emissions'"):
        train(network, recipe, steps=1000)


def quarterly(horizon: int = 8) -> Network:
    """Return the city with a quarter of a year in place of a day, and costs that are discounted."""
    network = city().with_options(episode={"horizon": horizon, "control_interval": 365.25 / 4})
    return replace(network, accounts=tuple(replace(each, discount=0.5) for each in ACCOUNTS))


@pytest.mark.parametrize(("replan", "share"), [(2, None), (3, 0.9)])
@pytest.mark.slow
def test_mpc_keeps_budgets_per_year(replan: int, share: float | None) -> None:
    """In each copy and in each of its episodes; beside one of the episode, which is discounted."""
    network = quarterly()
    least = simulate_plan(bound(network, aim="emissions", min_service=0.9)).bookings[0, 1].reshape(2, 4).sum(axis=1)
    budgets = {"emissions/year": 1.6 * float(least.max())}
    total = float(bound(network, min_service=0.9, at_most=budgets).accounts[1])
    budgets |= {} if share is None else {"emissions": share * total}
    env = MultiAgentVectorEnv(network, num_envs=2)
    env.reset(seed=3)
    control = MPC(min_service=0.9, at_most=budgets, replan=replan)
    control.start(env, 3)
    amounts = np.zeros((2, 8, 2))
    totals = np.zeros((2, 2))
    for episode, step in np.ndindex(2, 8):
        outcome = env.step(control.act({}))
        infos = outcome[-1][env.agents[0]]
        amounts[episode, step] = infos["accounts"]["emissions"]
        if step == 7:
            totals[episode] = infos["episode_accounts"]["emissions"]
    booked = amounts.reshape(2, 2, 4, 2).sum(axis=2)
    assert (booked <= budgets["emissions/year"] * (1 + 1e-4)).all()
    if share is None:
        assert (booked > 0.99 * budgets["emissions/year"]).all()
    else:
        assert (booked.max(axis=1) > 0.99 * budgets["emissions/year"]).all()
        assert (totals <= budgets["emissions"] * (1 + 1e-4)).all() and (totals > 0.99 * budgets["emissions"]).all()


@pytest.mark.slow
def test_what_a_plan_books_beyond_its_program_is_of_the_years_that_count() -> None:
    """So that the next program has less of the same year."""
    network = quarterly()
    plan = first_window(MPC(min_service=0.9, at_most={"emissions/year": 1e4, "emissions": 1.5e4}), network)
    (correction,) = plan.corrections
    assert correction.excess.shape == (8, 3)
    assert (correction.excess[4:, 0] == 0).all() and (correction.excess[:4, 1] == 0).all()
    assert (correction.excess[:4, 0] != 0).all() and (correction.excess[:, 2] != 0).all()


def test_budgets_per_year_need_every_interval() -> None:
    """What was booked in an interval that MPC did not see is of no year."""
    env = MultiAgentVectorEnv(quarterly(), num_envs=1)
    env.reset(seed=0)
    control = MPC(min_service=0.5, at_most={"emissions/year": 1e5})
    control.start(env, 0)
    for _ in range(2):
        env.step(env.neutral_action)
    with pytest.raises(CirlError, match="budgets per year need every interval"):
        control.act({})
    with pytest.raises(CirlError, match="budgets per year need every interval"):  # what the year booked is not known
        control.start(env, 0)


def test_intervals_are_of_the_year_of_their_middle() -> None:
    """Of weeks some begin in one year and end in the next; each is of one of them."""
    network = replace(city(), time_unit="week").with_options(episode={"horizon": 106})
    budgets = aims_of(network, "circularity", {"emissions/year": 5.0}).budgets
    assert [budget.year for budget in budgets] == [slice(0, 52), slice(52, 104), slice(104, 106)]
    assert {budget.most for budget in budgets} == {5.0}
    dated = aims_of(load_network("steel_japan"), "circularity", {"emissions/year": 5.0}).budgets
    assert [budget.name for budget in dated[:2]] == ["emissions in 2025", "emissions in 2026"]
    assert [budget.year for budget in dated[:2]] == [slice(0, 1), slice(1, 2)]


def test_the_command_line_plans_with_budgets_per_year(tmp_path: Path) -> None:
    """It says the budget once, with the year in which more of it is worth most."""
    file, network = tmp_path / "city.toml", yearly(3)
    write_network(network, file)
    most = 1.05 * float(by_year(simulate_plan(bound(network, aim="emissions", min_service=0.9))).max())
    asked = ["--control", "optimum", "--min-service", "0.9", "--at-most", f"emissions/year={most}"]
    result = CliRunner().invoke(app, ["plan", str(file), *asked, "--out", str(tmp_path / "p.csv")])
    assert result.exit_code == 0, result.output
    solved = bound(network, min_service=0.9, at_most={"emissions/year": most})
    dearest = max(solved.budget_prices, key=solved.budget_prices.__getitem__)
    worth = f"one more is worth {solved.budget_prices[dearest]:.4g} t of λ̄ of {dearest}, no more in others"
    assert f"emissions at most {most:.6g} t CO2e a year ({worth})" in " ".join(result.output.split())


def test_a_weight_of_circularity_alone_scales_the_bound() -> None:
    """What is said of 2·λ̄ is twice what is said of λ̄, and a plan has as much of it."""
    network = city().with_options(episode={"horizon": 5})
    once, twice = (bound(network, aim={"circularity": weight}) for weight in (1.0, 2.0))
    assert twice.objective == pytest.approx(2 * once.objective, rel=1e-6)
    assert str(twice).partition("2·λ̄ ≤ ")[2].startswith(f"{twice.objective:.6g}")
    plans = [first_window(MPC(aim={"circularity": weight}, min_service=0.5), network) for weight in (1.0, 2.0)]
    promises = [float(plan.problem.cost @ plan.solution.plan) for plan in plans]
    assert promises[1] == pytest.approx(2 * promises[0], rel=1e-4) and promises[0] > 0
    assert plans[1].value == pytest.approx(2 * plans[0].value, rel=1e-4)


def test_each_account_has_a_text_of_its_own() -> None:
    """Of the years of one there is one, and of another another."""
    network = yearly(2)
    aims = aims_of(network, "circularity", {"emissions/year": 5.0, "cost/year": 1e4, "cost": 3e4})
    assert budget_texts(network, aims) == [
        ("emissions at most 5 t CO2e a year", ["emissions in year 1", "emissions in year 2"]),
        ("cost at most 10000 EUR_2023 a year", ["cost in year 1", "cost in year 2"]),
        ("cost at most 30000 EUR_2023", ["cost"]),
    ]


def test_each_year_has_its_price(tmp_path: Path) -> None:
    """What is booked in a year is paid at the price of that year, whatever the discount; prices go on from a file."""
    network = yearly(4).with_options(episode={"control_interval": 0.5})
    network = replace(network, accounts=tuple(replace(each, discount=0.3) for each in ACCOUNTS))
    budgets = {"emissions/year": 1000.0, "emissions": 3000.0, "cost": -50.0}
    env, plain, other = (MultiAgentVectorEnv(network, num_envs=2, reward="circularity") for _ in range(3))
    scale, multiplier = network.objective.circularity_scale, Multipliers(env, 0.9, 0.5, 0.0, budgets)
    # half an episode each, then all of it
    np.testing.assert_allclose(multiplier._budget_integrals, [0.05, 0.05, 0.1, 0.1])
    amounts = {"emissions in year 1": 1050.0, "emissions in year 2": 975.0, "emissions": 3000.0, "cost": -50.0}
    multiplier.update([1.0], amounts)
    prices = np.array([0.05 * np.exp(0.25), 0.05 * np.exp(-0.125)]).repeat(2) * scale / 1000.0
    discount = env.ledger.discount
    expected = np.stack([np.full(4, 0.1 * scale / 50.0), prices / discount[1] + 0.1 * scale / 3000.0])
    np.testing.assert_allclose(env.account_charges, expected, rtol=1e-12)
    for each in (env, plain):
        each.reset(seed=0)
    plain.circularity_weight, plain.service_factors = env.circularity_weight, env.service_factors
    for t in range(4):
        actions = np.zeros((len(env.actuators.control_rows), 2))
        paid, bookings = env.advance(actions).reward, plain.advance(actions)
        less = 4 * (expected[:, t] * discount[:, t]) @ bookings.bookings
        np.testing.assert_allclose(bookings.reward - paid, np.repeat(less[None], len(env.agents), axis=0), rtol=1e-9)
    multiplier.save(tmp_path)
    again = Multipliers(other, 0.9, 0.5, 0.0, budgets)
    again.load(tmp_path)
    for moved in (multiplier, again):
        moved.update([1.0], amounts)
    np.testing.assert_array_equal(other.account_charges, env.account_charges)
    with pytest.raises(CirlError, match="it holds the price of service"):
        Multipliers(other, 0.9, 0.5, 0.0, {"emissions": 3000.0}).load(tmp_path)


def test_scores_tell_what_each_year_books() -> None:
    """A checkpoint with one year too many is no better than one that keeps all; older ones have totals alone."""
    network, policies = yearly(3), cast(Policies, Neutral())
    aims = aims_of(network, "circularity", {"emissions/year": 10.0})
    score = validation_score(MultiAgentVectorEnv(network, num_envs=2), policies, aims)
    run = rollout(MultiAgentVectorEnv(network, num_envs=2), Neutral(), seed=FIRST_SEED)
    assert [*score.accounts] == ["cost", "emissions", *(budget.name for budget in aims.budgets)]
    np.testing.assert_allclose([*score.accounts.values()][2:], run.bookings[0, 1])
    assert [*validation_score(MultiAgentVectorEnv(network, num_envs=2), policies).accounts] == ["cost", "emissions"]
    most = {budget.name: amount + 1.0 for budget, amount in zip(aims.budgets, run.bookings[0, 1].tolist(), strict=True)}
    score = replace(score, service_bound=1.0)
    assert score.rank(0.9, most)[0] and not score.rank(0.9, most | {"emissions in year 2": 0.0})[0]


@pytest.mark.slow
def test_learners_keep_the_budget_of_each_year(tmp_path: Path) -> None:
    """By exact gradients and a price for each year, near the bound that knows them."""
    network = yearly(6)
    least = simulate_plan(bound(network, aim="emissions", min_service=0.9))
    most = 1.3 * float(by_year(least).max())
    free = simulate_plan(bound(network, min_service=0.9))
    assert by_year(free).max() > 1.1 * most
    given = load_recipe("exact_gradients")
    run = given.run.model_copy(update={"min_service": 0.9, "at_most": {"emissions/year": most}})
    train(network, given.model_copy(update={"run": run}), steps=120_000, seed=2, directory=tmp_path / "run")
    played = rollout(MultiAgentVectorEnv(network, num_envs=16), Trained(tmp_path / "run"), seed=7)
    assert (played.bookings[:, 1].mean(axis=0) < most * 1.03).all()
    assert played.episode_levels.mean() > 0.9 - 5e-3
    limit = bound(network, min_service=0.9, at_most={"emissions/year": most}).objective
    assert played.episode_circularity.mean() > limit - 0.1 * abs(limit)


@pytest.mark.slow
@pytest.mark.parametrize("futures", [None, 2])
def test_mpc_in_a_disturbed_network_charges_for_years(futures: int | None) -> None:
    """At the multipliers that the plan of what is expected has for each year: less is booked, and no less delivered."""
    network = yearly(6)
    disturbances = {"demand": AutoRegression(deviation=0.1, persistence=0.5, low=0.7, high=1.3)}
    effect = {f"services.{network.services[0].id}.low": DisturbanceEffect(by="demand")}
    least = simulate_plan(bound(network, aim="emissions", min_service=0.9))
    most = 1.3 * float(by_year(least).max())
    network = replace(network, disturbances=disturbances, disturbed=effect)
    runs = []
    for budgets in (None, {"emissions/year": most}):
        control = MPC(futures=futures, min_service=0.9, at_most=budgets)
        runs.append(rollout(MultiAgentVectorEnv(network, num_envs=8), control))
    outlook = control._common_outlook
    assert outlook is not None and outlook.charges.shape == (6,) and (outlook.charges > 0).all()
    free, kept = (run.bookings[:, 1].mean(axis=0) for run in runs)
    assert kept.sum() < 0.7 * free.sum() and (kept[:3] < 0.5 * free[:3]).all()
    assert runs[1].episode_levels.mean() >= runs[0].episode_levels.mean()
    future = control._planner.futures[0]
    task = replace(outlook.task, charges=np.eye(6)[1], is_outlook=False)
    difference = future.program(task, None).cost - future.program(replace(task, charges=np.zeros(0)), None).cost
    years = np.flatnonzero(difference.reshape(6, -1).any(axis=1))
    assert years.tolist() == [1]


def with_random_demand(network: Network) -> Network:
    """Return the city with a demand that nobody foresees."""
    demand = AutoRegression(deviation=0.2, persistence=0.7, low=0.5, high=1.6)
    effect = {f"services.{network.services[0].id}.low": DisturbanceEffect(by="demand")}
    return replace(network, disturbances={"demand": demand}, disturbed=effect)


@pytest.mark.parametrize("futures", [None, 2])
@pytest.mark.slow
def test_mpc_in_a_disturbed_network_keeps_each_year(futures: int | None) -> None:
    """In each copy, whether a window has all of a year or a part of it; and serves as demanded, or nearly."""
    certain = quarterly(4)
    least = float(bound(certain, aim="emissions", min_service=0.9).accounts[1])
    most = 1.15 * float(simulate_plan(bound(certain, aim="emissions", min_service=0.9)).bookings[0, 1].sum())
    assert most > least
    env = MultiAgentVectorEnv(with_random_demand(certain), num_envs=4)
    control = MPC(min_service=0.9, at_most={"emissions/year": most}, futures=futures)
    run = rollout(env, control, seed=1)
    totals = run.bookings[:, 1].sum(axis=1)
    assert (totals <= most * (1 + 5e-3)).all() and totals.mean() > 0.9 * most
    assert run.episode_levels.mean() > 0.9 - 0.05
    assert not control.note


def test_a_window_may_book_its_part_of_what_a_year_has_left() -> None:
    """What is planned for its intervals, and for each of them an equal part of what was booked less than planned."""
    env = MultiAgentVectorEnv(with_random_demand(quarterly()), num_envs=1)
    env.reset(seed=0)
    control = MPC(min_service=0.5, at_most={"emissions/year": 1e4, "emissions": 3e4})
    control.start(env, 0)
    outlook, bookings = control._common_outlook, control._bookings
    assert outlook is not None
    reference = np.zeros((8, 3))
    reference[:4, 0] = reference[4:, 1] = 0.2
    reference[:, 2] = 0.1
    limits, share = bookings.limits(0, range(0, 3), reference)
    np.testing.assert_allclose(share, [3 / 4, 0.0, 3 / 8])
    np.testing.assert_allclose(limits, [0.6 + 0.75 * 0.2, 0.0, 0.3 + 3 / 8 * 0.2])
    env.step(control.act({}))
    bookings.follow([False])
    limits, share = bookings.limits(0, range(1, 4), reference)
    np.testing.assert_allclose(share, [1.0, 0.0, 3 / 7])
    np.testing.assert_allclose(limits[0], 1.0 - env.physical.accounts[1, 0] / env.ledger.discount[1, 0] / 1e4)
    plan = control._plans[0].window
    assert plan is not None
    np.testing.assert_allclose(plan.task.charges[1:], outlook.charges[1:] * [0.0, 1.0] + [outlook.charges[1], 0.0])


def test_a_service_is_dearer_until_it_is_ahead() -> None:
    """Beside budgets, which come first; by what was delivered, not by what was planned."""
    env = MultiAgentVectorEnv(with_random_demand(quarterly()), num_envs=2)
    env.reset(seed=0)
    control = MPC(min_service=0.5, at_most={"emissions/year": 1e4})
    control.start(env, 0)
    outlook = control._common_outlook
    assert outlook is not None
    env.physical.service[:] = [[0.0, 2.5]]
    env.physical.step[:] = 4
    prices = [control._present_price(copy, outlook) for copy in (0, 1)]
    np.testing.assert_allclose(prices[1][2:], control._price)
    np.testing.assert_allclose(prices[0], [*(10.0 * outlook.task.price[:2]), *(3.0 * control._price)])
    env.physical.service[:] = 0.5 * 8 - 4 * 0.48  # what is left to deliver, 0.48 in the mean, is less, but hardly
    np.testing.assert_allclose(control._present_price(0, outlook)[2:], 3.0 * control._price)
