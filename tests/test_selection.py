"""Which checkpoint of a run acts, and the price of service that evaluations move."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import example, given
from hypothesis import strategies as st
from small_networks import ACCOUNTS, booked

from cirl_marl import CirlError, MultiAgentVectorEnv, RecipeError, RunError, load_network
from cirl_marl.controllers.rollout import rollout
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.assessment import acting_checkpoint
from cirl_marl.learners import trainer
from cirl_marl.learners.checkpoint import observation_statistics
from cirl_marl.learners.interface import Trained, resume, train
from cirl_marl.learners.policies import Policies, Policy
from cirl_marl.learners.recipe import LearnerSettings, Recipe, Run
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.learners.stacked.gradient_ascent import GradientStack
from cirl_marl.learners.stacked.stack import StackedPolicies
from cirl_marl.learners.validation import FIRST_SEED, LARGEST_MULTIPLIER, Multipliers, Score, validation_score

HORIZON, STEPS = 6, 96


def recipe(**run: Any) -> Recipe:
    """Return a recipe of eight rollouts, with as many evaluations."""
    parameters = {"n_steps": 6, "batch_size": 12, "learning_rate": 0.05, "policy_kwargs": {"net_arch": [8]}}
    asked = {"steps": STEPS, "envs": 2, "evaluations": 8, "episodes": 3} | run
    learner = LearnerSettings(algorithm="PPO", parameters=parameters)
    return Recipe(name="small", title="small", run=Run(**asked), learner=learner, environment={"reward": "team"})


def learnt(folder: Path, given: Recipe, **options: Any) -> RunDirectory:
    """Train on copper_net in short episodes."""
    train("copper_net", given, directory=folder, horizon=HORIZON, **options)
    return RunDirectory(folder)


def evaluations(run: RunDirectory) -> list[dict[str, float]]:
    """Return the rows of ``evaluations.csv``."""
    with (run.path / "evaluations.csv").open() as file:
        return [{key: float(value) for key, value in row.items()} for row in csv.DictReader(file)]


def numbers(policy: Policy) -> np.ndarray:
    """Return the weights of a policy, then the moments of what it observes."""
    assert policy.normaliser is not None
    weights = [value.numpy().ravel() for value in policy.model.policy.state_dict().values()]
    moments = observation_statistics(policy.normaliser)["observation"]
    return np.concatenate([*weights, moments.mean, moments.var])


@pytest.mark.parametrize(
    ("response", "trials"),
    [
        (2.0, [1.05, 0.525]),
        (0.15, [1.05, 7.0]),
        (0.0025, [1.05, 17.85, 286.65, 420.0]),
        (0.0, [1.05, 0.0]),
    ],
    ids=["too far", "not far enough", "far away", "never"],
)
@pytest.mark.sample(1)
def test_what_lacks_at_the_end_is_made_good_by_the_nearest(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, response: float, trials: list[float]
) -> None:
    """Policies move up the slope of what lacks as far as validations show they must; a training itself ends alike.

    Far is what slopes promise, in parts of what lacks; a twentieth more than that is wanted.
    """
    seen: list[tuple[float, np.ndarray]] = []
    found: list[tuple[torch.Tensor, np.ndarray]] = []
    slopes = GradientStack.slopes

    def watch(stack: GradientStack) -> np.ndarray:
        found.append((stack.parameters, slopes(stack)))
        return found[0][1]

    def score(env: MultiAgentVectorEnv, policies: StackedPolicies, aims: object) -> Score:
        stack, far = policies._parts[0][0], 0.0
        assert isinstance(stack, GradientStack)
        if found:
            (end, (row,)) = found[0]
            far = float((stack.parameters - end).flatten().numpy() @ row) / 0.01
        mine = next(member.policy for member in stack.members if member.name == "mine")
        seen.append((far, numbers(mine)))
        level = 0.98 + 0.01 * response * far
        return Score(-far, level, level, 0.0, {"copper_in_use": level})

    monkeypatch.setattr(trainer, "validation_score", score)
    monkeypatch.setattr(GradientStack, "slopes", watch)
    climb = recipe(engine="gradients", min_service=0.99, steps=24, evaluations=2)
    options: dict[str, Any] = {"horizon": HORIZON, "circularity": "mean"}
    last = numbers(train("copper_net", climb, directory=tmp_path / "run", **options).learners["mine"].policy)
    np.testing.assert_allclose([far for far, _ in seen[2:]], trials, rtol=1e-3)
    acting = numbers(Trained(tmp_path / "run").policies["mine"])
    np.testing.assert_array_equal(acting, seen[-1 if response else 0][1])
    np.testing.assert_array_equal(last, seen[1][1])
    assert not np.allclose(acting, last, atol=1e-6)
    seen.clear()  # a training that is kept nowhere tries nothing, and ends alike
    found.clear()
    np.testing.assert_array_equal(numbers(train("copper_net", climb, **options).learners["mine"].policy), last)
    assert len(seen) == 2


@given(st.integers(0, 10**6), st.integers(1, 5))
def test_least_weights(seed: int, count: int) -> None:
    """What is needed is had, and nothing that costs less has it: weights of random others are longer."""
    rng = np.random.default_rng(seed)
    slopes, needs = rng.normal(size=(count, 8)), rng.normal(size=count)
    gram = slopes @ slopes.T
    response = gram + 0.1 * rng.normal(size=gram.shape)
    least = trainer.least_weights(gram, response, needs)
    assert (response @ least >= needs - 1e-5 * (1.0 + np.abs(least).max())).all()
    for _ in range(20):
        other = least + 0.1 * rng.normal(size=count)
        if (response @ other >= needs).all():
            assert other @ gram @ other >= least @ gram @ least - 1e-5 * (1.0 + np.abs(least).max() ** 2)
    assert not trainer.least_weights(np.zeros((2, 2)), np.zeros((2, 2)), np.ones(2)).any()


@given(st.integers(0, 10**6))
@example(161)
@example(1863)
@example(6251)
def test_many_demands_alike(seed: int) -> None:
    """Thirty demands, many of which ask for the same or for nothing, have their weights in every trial."""
    rng = np.random.default_rng(seed)
    count = int(rng.integers(6, 31))
    rank = int(rng.integers(1, count + 1))
    slopes = rng.normal(size=(count, rank)) @ rng.normal(size=(rank, 200))
    slopes *= 10.0 ** rng.integers(-6, 1, size=(count, 1))
    slopes[rng.random(count) < 0.3] = 0
    gram = slopes @ slopes.T
    response, truth = gram.copy(), rng.uniform(-0.5, 1, size=gram.shape) * gram
    needs, weights = rng.random(count) * 10.0 ** rng.integers(-6, 0), np.zeros(count)
    for _ in range(6):
        step = trainer.least_weights(gram, response, response @ weights + needs) - weights
        assert np.isfinite(step).all()
        if not step.any():
            return
        change = truth @ step + 1e-5 * rng.normal(size=count)
        weights, needs = weights + step, needs - change
        response = response + np.outer(change - response @ step, step) / (step @ step)


@pytest.mark.parametrize(("engine", "share"), [("lockstep", 0.5), ("stacked", 1.0), ("gradients", 0.5)])
@pytest.mark.sample(1)
def test_the_last_update_is_evaluated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, engine: str, share: float
) -> None:
    """Nothing is learnt after the last evaluation, so that policies that all updates made can act; steps come once."""
    seen: list[np.ndarray] = []

    def score(env: MultiAgentVectorEnv, policies: Policies, aims: object) -> Score:
        seen.append(numbers(policies.policies["mine"]))
        return Score(float(len(seen)), 1.0, 1.0, 0.0)

    monkeypatch.setattr(trainer, "validation_score", score)
    monkeypatch.setattr(trainer, "StackedPolicies", lambda all_, _: Policies({k: v.policy for k, v in all_.items()}))
    learner = recipe().learner.model_copy(update={"share_of_steps": share})
    given = recipe(engine=engine, min_service=0.99).model_copy(update={"learner": learner})
    training = train("copper_net", given, directory=tmp_path / "run", horizon=HORIZON, circularity="mean")
    last = numbers(training.learners["mine"].policy)
    np.testing.assert_array_equal(seen[-1], last)
    assert not np.array_equal(seen[-2], last)
    steps = [row["joint_step"] for row in evaluations(RunDirectory(tmp_path / "run"))]
    assert steps == [6 * k for k in range(1, int(8 * share) + 1)]
    np.testing.assert_array_equal(numbers(Trained(tmp_path / "run").policies["mine"]), last)


@pytest.mark.sample(1)
@pytest.mark.parametrize("demanded", [None, 0.0, 0.97, 1.0])
@pytest.mark.medium
def test_the_best_checkpoint_acts(tmp_path: Path, demanded: float | None) -> None:
    """It is the best row by the rule, its policies give the figures of that row again, and the choice is said."""
    run = learnt(tmp_path / "run", recipe(min_service=demanded))
    rows = evaluations(run)
    assert [row["joint_step"] for row in rows] == [6 * k for k in range(1, 9)]
    scores = [Score(row["circularity"], row["service"], row["assured"], row["paid"]) for row in rows]
    best = max(range(8), key=lambda i: scores[i].rank(demanded))
    status = run.status["best"]
    assert status["joint_steps"] == rows[best]["joint_step"]
    assert run.acting_checkpoint.name == status["checkpoint"] == f"{6 * (best + 1):09d}-best"
    assert max(i for i in range(8) if rows[i]["best"]) == best
    env = MultiAgentVectorEnv("copper_net", num_envs=3, horizon=HORIZON, reward="team")
    again = rollout(env, Trained(run), seed=FIRST_SEED)
    assert float(again.episode_circularity.mean()) == pytest.approx(rows[best]["circularity"], rel=1e-6)
    assert float(again.returns.sum(axis=0).mean()) == pytest.approx(rows[best]["paid"], rel=1e-6)
    levels = again.episode_levels
    assert float(levels.mean(axis=0).min()) == pytest.approx(rows[best]["service"])
    spread = 1.645 * levels.std(axis=0, ddof=1) / np.sqrt(3)
    assert float((levels.mean(axis=0) - spread).min()) == pytest.approx(rows[best]["assured"])
    said = acting_checkpoint(run)
    assert f"after {12 * (best + 1)} environment steps, the best of 8 evaluations" in said
    assert ("none assured the service of 1" in said) == (demanded == 1.0)
    assert compare([run], ("neutral",), episodes=2, bounds=False).entries[0].checkpoint == run.acting_checkpoint.name
    names = {path.name for path in (run.path / "checkpoints").iterdir()}
    assert names == {run.acting_checkpoint.name, run.checkpoint.name}


@given(
    st.lists(st.tuples(st.floats(-9, 9), st.floats(0, 1), st.floats(-9, 9)), min_size=2, max_size=9), st.floats(0, 1)
)
def test_service_comes_first(figures: list[tuple[float, float, float]], demanded: float) -> None:
    """No score that falls short is above one that does not; among those that serve, λ̄ decides, else the level."""
    scores = [Score(circularity, assured, assured, paid) for circularity, assured, paid in figures]
    best = max(scores, key=lambda score: score.rank(demanded))
    serving = [score for score in scores if score.service_bound >= demanded]
    if serving:
        assert best in serving and best.circularity == max(score.circularity for score in serving)
    else:
        assert best.service_bound == max(score.service_bound for score in scores)
    returns = [score.episode_return for score in scores]
    assert max(scores, key=lambda score: score.rank(None)).episode_return == max(returns)


def test_without_evaluations_the_last_checkpoint_acts(tmp_path: Path) -> None:
    """And the same is learnt: evaluating changes nothing."""
    run, other = learnt(tmp_path / "a", recipe(evaluations=0)), learnt(tmp_path / "b", recipe())
    assert run.acting_checkpoint == run.checkpoint
    assert acting_checkpoint(run) == "who acts: the last checkpoint, after 96 environment steps"
    assert not evaluations(run)
    kept = list(run.checkpoint.glob("*"))
    assert len(kept) > 3
    for path in kept:
        assert path.read_bytes() == (other.checkpoint / path.name).read_bytes()


@pytest.mark.slow
def test_the_best_survives_a_resumption(tmp_path: Path) -> None:
    """A run that goes on keeps its best until there is a better one; rows go on, none twice."""
    run = learnt(tmp_path / "run", recipe(min_service=1.0))
    best, rows = run.status["best"], evaluations(run)
    resume(run.path, steps=2 * STEPS)
    after = evaluations(run)
    assert after[:8] == rows and len(after) > 8
    assert len({row["joint_step"] for row in after}) == len(after)
    scores = {row["joint_step"]: Score(row["circularity"], 0.0, row["assured"], row["paid"]) for row in after}
    assert run.status["best"]["joint_steps"] == max(scores, key=lambda step: scores[step].rank(1.0))
    assert scores[best["joint_steps"]].service_bound == pytest.approx(best["figures"]["assured"])


@pytest.mark.parametrize("best", [3, {"checkpoint": 4, "joint_steps": 1, "figures": {}}, {"checkpoint": "x"}])
@pytest.mark.sample(1)
def test_a_status_of_something_else_is_refused(tmp_path: Path, best: object) -> None:
    """And one from before there was a best is read."""
    run = learnt(tmp_path / "run", recipe(evaluations=0))
    path = run.path / "status.json"
    status = json.loads(path.read_text())
    del status["best"]
    path.write_text(json.dumps(status))
    assert run.acting_checkpoint == run.checkpoint
    path.write_text(json.dumps(status | {"best": best}))
    with pytest.raises(RunError, match="is not the status of a run"):
        assert run.acting_checkpoint


@pytest.mark.parametrize("damping", [0.0, 0.7])
@pytest.mark.parametrize(("assured", "step"), [(0.5, 0.2), (0.985, 0.1), (0.99, 0.0), (0.995, -0.1), (1.0, -0.2)])
def test_the_price_moves_by_what_lacks(assured: float, step: float, damping: float) -> None:
    """In closed form, at once in what is paid, and never without end."""
    env = MultiAgentVectorEnv("copper_net", num_envs=2, reward="team", circularity="mean", circularity_weight=0.8)
    price = Multipliers(env, 0.99, 0.2, damping)
    price.update([0.0])
    price.update([assured])
    weight = env.circularity_weight
    moved = 0.2 + step + damping * step / 0.2
    assert np.log((1 - weight) / weight) == pytest.approx(np.log(0.25) + max(moved, 0.0))
    env.reset(seed=0)
    outcome = env.advance(np.full((len(env.agents), 2), -1.0))
    objective, services = env.network.objective, env.network.services
    short = sum(service.weight * (1 - level) for service, level in zip(services, outcome.levels, strict=True))
    paid = weight * outcome.circularity_mean / objective.circularity_scale - (1 - weight) * short
    np.testing.assert_allclose(outcome.reward[0], paid, rtol=1e-9)
    for _ in range(2000):
        price.update([assured])
    ends = {0.2: LARGEST_MULTIPLIER, 0.1: LARGEST_MULTIPLIER, 0.0: 0.25 * np.exp(0.2)}
    end = ends.get(step, 0.25)  # it falls to what it was at first
    weight = env.circularity_weight
    assert (1 - weight) / weight == pytest.approx(end)


@pytest.mark.parametrize("reward", ["team", "mixed", "circularity"])
def test_each_budget_has_its_price(tmp_path: Path, reward: str) -> None:
    """What is exceeded becomes dear; all that is booked is paid at its price, also after a resumption."""
    network = booked(load_network("paper_city").with_options(episode={"horizon": 8}), 3)
    first, charged = ACCOUNTS[0].id, ACCOUNTS[1].id
    env, plain, other = (MultiAgentVectorEnv(network, num_envs=2, reward=reward) for _ in range(3))
    scale = network.objective.circularity_scale
    multiplier = Multipliers(env, 0.95, 0.5, 0.0, {charged: -40.0, first: 10.0})
    np.testing.assert_allclose(env.account_charges, 0.1 * scale / np.array([10.0, 40.0]))
    multiplier.update([1.0], {first: 10.2, charged: -39.0})
    shares = np.array([0.2 / 10.0, 1.0 / 40.0]) / 0.05
    expected = 0.1 * np.exp(0.5 * shares) * scale / [10.0, 40.0]
    np.testing.assert_allclose(env.account_charges, expected, rtol=1e-12)
    plain.circularity_weight, plain.service_factors = env.circularity_weight, env.service_factors
    rewards = []
    for each in (env, plain):
        each.reset(seed=0)
        outcome = each.advance(np.zeros((len(each.stack(each.neutral_action)), 2)))
        rewards.append(outcome.reward)
        bookings = each.physical.accounts
    per_mass = 1.0 if reward == "circularity" else env.circularity_weight / scale
    less = per_mass * 8 * expected @ bookings
    assert np.abs(less).min() > 0
    np.testing.assert_allclose(rewards[1] - rewards[0], np.repeat(less[None], len(env.agents), axis=0), rtol=1e-9)
    multiplier.save(tmp_path)
    again = Multipliers(other, 0.95, 0.5, 0.0, {charged: -40.0, first: 10.0})
    again.load(tmp_path)
    for moved in (multiplier, again):
        moved.update([1.0], {first: 9.9, charged: -41.0})
    np.testing.assert_array_equal(other.account_charges, env.account_charges)
    assert (env.account_charges < expected).all()
    for _ in range(100):
        multiplier.update([1.0], {first: 0.0, charged: -100.0})
    np.testing.assert_allclose(env.account_charges, 1e-4 * scale / np.array([10.0, 40.0]))


def test_budgets_come_beside_charges_and_without_services() -> None:
    """What the environment charges for anyhow stays; prices of budgets move where there is no service, too."""
    network = replace(booked(load_network("paper_city"), 3), services=())
    env = MultiAgentVectorEnv(network, num_envs=1, reward="team", charges={"emissions": 3.0})
    multiplier = Multipliers(env, 0.9, 1.0, 0.0, {"cost": 500.0})
    before, weight = env.account_charges.copy(), env.circularity_weight
    multiplier.update([], {"cost": 600.0})
    assert before[0] > 0 and env.account_charges[0] == pytest.approx(before[0] * np.e)
    assert env.account_charges[1] == before[1] == 3.0 and env.circularity_weight == weight


def test_budgets_move_in_a_training_without_services() -> None:
    """Prices are charged as evaluations have it."""
    network = replace(booked(load_network("paper_city").with_options(episode={"horizon": HORIZON}), 3), services=())
    given = recipe(min_service=0.9, price_rate=1.0, at_most={"cost": 1.0})
    training = train(network, given)
    first = 0.1 * network.objective.circularity_scale
    assert training.env.account_charges[0] not in (0.0, pytest.approx(first)) and training.env.account_charges[1] == 0


def test_a_checkpoint_that_exceeds_a_budget_is_no_better() -> None:
    """Whatever its λ̄; of those that all lack something the one that lacks least is best."""
    budgets = {"cost": 100.0}
    kept = Score(-5.0, 1.0, 1.0, 0.0, accounts={"cost": 99.0}).rank(0.9, budgets)
    over, far = (Score(-1.0, 1.0, 1.0, 0.0, accounts={"cost": cost}).rank(0.9, budgets) for cost in (101.0, 150.0))
    lacking = Score(-1.0, 0.8, 0.8, 0.0, accounts={"cost": 50.0}).rank(0.9, budgets)
    assert kept == (True, -5.0)
    assert kept > over > lacking > far


@pytest.mark.parametrize("reward", ["team", "mixed"])
def test_each_service_has_its_price(tmp_path: Path, reward: str) -> None:
    """What lacks becomes dear, what does not stays; shortfalls are paid at these prices, also after a resumption."""
    env = MultiAgentVectorEnv("carbo_net", num_envs=1, reward=reward, circularity="mean", circularity_weight=0.8)
    multiplier = Multipliers(env, 0.99, 0.5, 0.0)
    for _ in range(4):
        multiplier.update([0.9, 1.0])
    weight, factors = env.circularity_weight, env.service_factors
    np.testing.assert_allclose(factors * (1 - weight) / weight, [0.25 * np.exp(2.0), 0.25])
    multiplier.save(tmp_path)
    other = MultiAgentVectorEnv("carbo_net", num_envs=1, reward=reward, circularity="mean", circularity_weight=0.8)
    again = Multipliers(other, 0.99, 0.5, 0.0)
    again.load(tmp_path)
    again.update([0.9, 1.0])
    multiplier.update([0.9, 1.0])
    assert other.circularity_weight == env.circularity_weight and (other.service_factors == env.service_factors).all()
    plain = MultiAgentVectorEnv("carbo_net", num_envs=1, reward=reward, circularity="mean")
    plain.circularity_weight = env.circularity_weight
    outcomes = []
    for e in (env, plain):
        e.reset(seed=0)
        outcomes.append(e.advance(np.full((sum(box.shape[0] for box in e.action_spaces.values()), 1), -1.0)))
    short = 1.0 - outcomes[0].levels
    assert (short > 0).any()
    owed = [[s.weight * (agent in s.debtors or reward == "team") for s in env.network.services] for agent in env.agents]
    less = (1 - env.circularity_weight) * (np.array(owed) @ ((1 - env.service_factors)[:, None] * short))
    np.testing.assert_allclose(outcomes[0].reward - outcomes[1].reward, less, atol=1e-12)
    with pytest.raises(CirlError, match="service_factors must be 2 numbers of at least 0"):
        env.service_factors = [1.0]


def test_what_lacks_is_named(tmp_path: Path) -> None:
    """The services below what is demanded, the lowest first; a run from before they were kept names none."""
    train("carbo_net", recipe(min_service=0.99), directory=tmp_path / "run", horizon=HORIZON)
    run = RunDirectory(tmp_path / "run")
    status = json.loads((run.path / "status.json").read_text())
    figures = status["best"]["figures"]
    assert Score.from_dict(figures).as_dict() == figures
    assert min(figures["levels"].values()) == figures["assured"] and len(figures["levels"]) == 2
    first, second = figures["levels"]
    figures |= {"assured": 0.9, "levels": {first: 0.98, second: 0.9}}
    for levels, said in ((figures["levels"], f"demands ({second} 0.9000, {first} 0.9800)"), ({}, "demands")):
        figures["levels"] = levels
        (run.path / "status.json").write_text(json.dumps(status))
        assert acting_checkpoint(run).endswith(said)


def test_budgets_that_are_not_kept_are_named(tmp_path: Path) -> None:
    """With what is booked; those that are kept are not."""
    network = booked(load_network("copper_net"), 0)
    free = recipe(min_service=0.0, price_rate=0.1)
    for name, at_most in (("tight", {"cost": -1e9}), ("wide", {})):
        budgets = at_most | {"emissions": 1e9}
        run = free.run.model_copy(update={"at_most": budgets})
        train(network, free.model_copy(update={"run": run}), directory=tmp_path / name, horizon=HORIZON)
    booked_cost = RunDirectory(tmp_path / "tight").status["best"]["figures"]["accounts"]["cost"]
    said = acting_checkpoint(RunDirectory(tmp_path / "tight"))
    assert said.endswith(
        f"; it does not keep the budgets of the recipe (cost at most -1e+09 EUR_2023: {booked_cost:.6g})"
    )
    assert "budgets" not in acting_checkpoint(RunDirectory(tmp_path / "wide"))


def test_one_episode_is_enough_where_nothing_is_random(tmp_path: Path) -> None:
    """An evaluation plays as many episodes as differ."""
    fixed, drawn = (MultiAgentVectorEnv(network, num_envs=2) for network in ("copper_world", "copper_net"))
    assert drawn.is_random and not fixed.is_random
    disturbed = MultiAgentVectorEnv("copper_world", num_envs=2, scenario="shocks")
    assert disturbed.is_random
    training = train("copper_world", recipe(episodes=64), horizon=HORIZON)
    assert training._validation_env is not None and training._validation_env.num_envs == 1


def test_a_price_that_moves_is_kept(tmp_path: Path) -> None:
    """It follows the evaluations of the run, is written beside them, and a resumption goes on with it."""
    run = learnt(tmp_path / "run", recipe(min_service=1.0, price_rate=0.5, price_damping=0.25))
    rows = evaluations(run)
    assert rows[0]["circularity_weight"] == 0.5
    prices = [np.log((1 - row["circularity_weight"]) / row["circularity_weight"]) for row in rows]
    # never served wholly, so the largest step each time, and all the damping at the first one
    steps = [0.75] + [0.5] * 6
    np.testing.assert_allclose(np.diff(prices), steps, rtol=1e-6, atol=1e-9)
    told = json.loads((run.checkpoint / "price.json").read_text())
    kept = told["circularity_weight"]
    assert kept < rows[-1]["circularity_weight"]
    assert told["lasting_price"] == [pytest.approx((1 - kept) / kept * np.exp(-0.25))]
    resumed = resume(run.path, steps=STEPS + 12)
    assert resumed.env.circularity_weight <= kept
    assert resumed._multiplier is not None and resumed._multiplier._least == pytest.approx(1.0)
    for state in ({}, {**told, "service_factors": [1e300]}, {**told, "service_factors": [1.1]}):
        (run.checkpoint / "price.json").write_text(json.dumps(state))
        with pytest.raises(RunError, match=r"price\.json: cannot be read: .* it holds the price of service"):
            resume(run.path, steps=2 * STEPS)


def test_a_price_needs_what_it_needs(tmp_path: Path) -> None:
    """A level, evaluations, and a reward that has a price; a network without services has none to move."""
    for run, said in (({}, "min_service is not given"), ({"min_service": 0.9, "evaluations": 0}, "evaluations are 0")):
        with pytest.raises(RecipeError, match=f"run.price_rate: .*{said}"):
            learnt(tmp_path / "run", recipe(price_rate=0.1, **run))
    with pytest.raises(RecipeError, match="reward 'circularity' has no price of service that could move; choose mixed"):
        learnt(tmp_path / "run", recipe(price_rate=0.1, min_service=0.9), reward="circularity")
    assert not (tmp_path / "run").exists()


def test_an_evaluation_has_episodes_of_its_own() -> None:
    """The same each time, and none that a report plays."""
    env = MultiAgentVectorEnv("copper_net", num_envs=2, horizon=HORIZON)
    from cirl_marl.learners.policies import Policies

    class Still(Policies):
        def act(self, observations: Any) -> Any:
            return {agent: np.zeros((2, 1)) for agent in env.agents}

    first, again = (validation_score(env, Still({})) for _ in range(2))
    assert first == again
    reported = rollout(env, Still({}))
    assert float(reported.episode_circularity.mean()) != first.circularity
