"""Policies that climb exact gradients: what they climb, and who cannot."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from small_networks import ONE_OF_EACH, booked

from cirl_marl import MultiAgentVectorEnv, RecipeError, load_network, train
from cirl_marl.controllers.rollout import rollout
from cirl_marl.environments.derivatives import Derivatives
from cirl_marl.errors import CirlError
from cirl_marl.learners.interface import default_recipe, prepare
from cirl_marl.learners.policies import Policies
from cirl_marl.learners.recipe import LearnerSettings, Recipe, Run
from cirl_marl.learners.stacked import gradient_ascent
from cirl_marl.learners.stacked.control_variates import ControlVariates
from cirl_marl.learners.stacked.gradient_ascent import GradientStack

PARAMETERS = {"policy_kwargs": {"net_arch": [4]}, "max_grad_norm": 1e9, "n_steps": 4, "batch_size": 8}
BUFFERED: dict[str, Any] = {"buffer_size": 8, "policy_kwargs": {"net_arch": [4], "activation_fn": torch.nn.Tanh}}
SQUASHED = ("TD3", "DDPG", "SAC", "TQC")


def recipe(run: dict[str, Any] | None = None, **learner: Any) -> Recipe:
    """Return a recipe for a few episodes of four intervals in two copies."""
    settings = {"algorithm": "PPO", "parameters": PARAMETERS, "normalise": {"observation": True, "reward": False}}
    return Recipe(
        name="climb",
        title="climb",
        run=Run(
            **({"steps": 24, "envs": 2, "engine": "gradients", "evaluations": 0, "min_service": 0.99} | (run or {}))
        ),
        environment={"reward": "team", "circularity": "mean", "horizon": 4},
        learner=LearnerSettings.model_validate(settings | learner),
    )


def test_gradients_that_grow_are_taken_with_less_feedback(monkeypatch: pytest.MonkeyPatch) -> None:
    """Where policies are steep, half of it does, or none; where the objective is dear, less of it is of no use."""
    climb, go_back, passes = GradientStack._climb, GradientStack._go_back, list[float]()

    def watch(stack: GradientStack, weight: float, prices: Any, charges: Any, feedback: float) -> None:
        passes.append(feedback)
        go_back(stack, weight, prices, charges, feedback)

    def gradient(stack: GradientStack, weight: float, feedback: float | None = None) -> Any:
        passes.clear()
        arguments = weight, weight * stack._prices, weight * stack._charges[:, None]
        stack._write_gradient(*arguments) if feedback is None else stack._go_back(*arguments, feedback)
        return stack._weights.gradient.clone()

    def check(stack: GradientStack, progress_remaining: float) -> None:
        assert (gradient(stack, 1.0) == gradient(stack, 1.0, 0.5)).all()
        monkeypatch.setattr(gradient_ascent, "FEEDBACK", 1e6)
        halved = gradient(stack, 1.0)
        assert len(passes) > 5
        assert passes == [1e6 / 2**i for i in range(len(passes))]
        assert gradient_ascent.GROWN / 100 < torch.linalg.vector_norm(halved, dim=1).max() <= gradient_ascent.GROWN
        monkeypatch.setattr(gradient_ascent, "FEEDBACK", 1e30)  # beyond all numbers
        monkeypatch.setattr(gradient_ascent, "LEAST_FEEDBACK", 1e29)
        alone = gradient(stack, 1.0)
        assert passes[-1] == 0.0
        assert len(passes) == 6
        assert (alone == gradient(stack, 1.0, 0.0)).all()
        for name, value in (("FEEDBACK", 0.5), ("LEAST_FEEDBACK", 0.01)):
            monkeypatch.setattr(gradient_ascent, name, value)
        gradient(stack, 1e9)
        assert passes == [0.5, 0.25]
        climb(stack, progress_remaining)

    monkeypatch.setattr(GradientStack, "_go_back", watch)
    monkeypatch.setattr(GradientStack, "_climb", check)
    steep = {**PARAMETERS, "policy_kwargs": {"net_arch": [4], "ortho_init": False}}
    train("copper_net", recipe({"steps": 8}, parameters=steep))
    assert passes


@pytest.mark.parametrize(
    ("share", "budgets", "algorithm"),
    [(1.0, {}, "PPO"), (0.5, {"emissions": -50.0, "cost": 20.0}, "PPO"), *((1.0, {}, name) for name in SQUASHED)],
)
@pytest.mark.sample(2)
def test_gradients_go_through_the_policies(
    monkeypatch: pytest.MonkeyPatch, share: float, budgets: dict[str, float], algorithm: str
) -> None:
    """They are those of the mean over copies of λ̄/c, levels and budgeted totals at their prices, by every weight.

    A share of them comes from episodes whose policies see so much of what changed.
    """
    ascend, checked = GradientStack._climb, []

    def check(stack: GradientStack, progress_remaining: float) -> None:
        tape, env, prices = stack._tape, stack._env, stack._prices.copy()
        charges = env.account_charges / env.network.objective.circularity_scale
        for place, (account, most) in enumerate(budgets.items()):
            charges[env.ledger.accounts.index(account)] += stack._budget_prices[1][place] / abs(most)
        monkeypatch.setattr(stack._weights.optimiser, "step", lambda: None)
        ascend(stack, progress_remaining)
        monkeypatch.undo()
        matrix, now, controls = stack._weights.matrix, env.physical, env.controls

        def objective() -> float:
            env.go_back(tape[0][0].before, controls)
            inputs = tape[0][1][0]
            for t in range(len(tape)):
                outputs = stack._weights.actor.forward(inputs)[-1].numpy()
                actions = np.empty_like(tape[0][0].actions)
                for rows, member in zip(outputs, stack.members, strict=True):
                    entries = env.actuators.entries[member.name]
                    actions[entries] = np.clip(rows[:, : entries.stop - entries.start], -1, 1).T
                env.advance(actions)
                if t + 1 < len(tape):
                    # what is seen changes by the slopes of the normaliser, from what was seen on the tape
                    seen, now_here = env.stacked_observation(), env.physical
                    env.go_back(tape[t][0].after, controls)
                    before = env.stacked_observation()
                    env.go_back(now_here, controls)
                    change = np.zeros(inputs.shape)
                    for rows, member in zip(change, stack.members, strict=True):
                        span = env.layout.slices[member.name]
                        rows[:, : span.stop - span.start] = (seen[span] - before[span]).T
                    inputs = tape[t + 1][1][0] + torch.as_tensor(share * change * tape[t + 1][2], dtype=torch.float32)
            state = env.physical
            value = state.circularity.mean() / env.network.objective.circularity_scale
            booked = (state.accounts - tape[0][0].before.accounts).mean(axis=1)
            return float(value + prices @ state.service.mean(axis=1)) / len(tape) - float(charges @ booked)

        largest = float(stack._weights.gradient.abs().max())
        for place in np.random.default_rng(0).integers(0, matrix.numel(), 20):
            row, column = divmod(int(place), matrix.shape[1])
            value, ends = float(matrix[row, column]), []
            for shift in (0.02, -0.02, 0.01, -0.01):
                matrix[row, column] = value + shift
                ends.append(objective())
            matrix[row, column] = value
            slope = (8 * (ends[2] - ends[3]) - (ends[0] - ends[1])) / 0.12  # of fourth order
            assert -float(stack._weights.gradient[row, column]) == pytest.approx(slope, abs=1e-3 * largest)
        env.go_back(now, controls)
        checked.append(largest)

    monkeypatch.setattr(GradientStack, "_climb", check)
    monkeypatch.setattr(gradient_ascent, "FEEDBACK", share)
    monkeypatch.setattr(gradient_ascent, "LARGEST_NORM", 1e9)
    asked = {"steps": 8, "evaluations": 1, "at_most": budgets, "price_rate": 0.1}
    climb = recipe(asked, algorithm=algorithm, parameters=PARAMETERS if algorithm == "PPO" else BUFFERED)
    train(booked(load_network("carbo_net"), 2, efforts=False), climb, charges={"cost": 30.0} if budgets else {})
    assert len(checked) == 1 and checked[0] > 0


@pytest.mark.parametrize("algorithm", SQUASHED)
@pytest.mark.sample(2)
def test_actors_that_climbed_are_those_of_the_models(algorithm: str) -> None:
    """Each model does what the stack does, its target as well; critics stay, and what is paid at its prices grows."""
    parameters = BUFFERED | {"learning_rate": 0.03}
    climb = recipe({"steps": 320, "price_rate": 0.0}, algorithm=algorithm, parameters=parameters)
    fresh, found = prepare("copper_net", climb, seed=3), train("copper_net", climb, seed=3)
    (stack,) = found._stacks
    assert isinstance(stack, GradientStack)
    rows = np.random.default_rng(0).normal(size=(len(found.learners), 5, stack._inputs.local))
    for part, columns in zip(rows, stack._inputs.actor_columns, strict=True):
        part[:, len(columns) :] = 0.0
    outputs = stack._deterministic_actions(torch.as_tensor(rows, dtype=torch.float32)).numpy()
    for name, part, output in zip(found.learners, rows, outputs, strict=True):
        model: Any = found.learners[name].model
        seen, entries = part[:, : model.observation_space.shape[0]].astype(np.float32), model.action_space.shape[0]
        np.testing.assert_allclose(model.predict(seen, deterministic=True)[0], output[:, :entries], atol=1e-6)
        if algorithm in ("TD3", "DDPG"):
            states = model.actor.state_dict(), model.actor_target.state_dict()
            assert all(torch.equal(value, states[1][key]) for key, value in states[0].items())
        before: Any = fresh.learners[name].model
        critics = zip(model.critic.parameters(), before.critic.parameters(), strict=True)
        assert all(torch.equal(new, old) for new, old in critics)
    paid = []
    for training in (fresh, found):
        env = MultiAgentVectorEnv("copper_net", num_envs=8, reward="team", circularity="mean", horizon=4)
        run = rollout(env, Policies({key: learner.policy for key, learner in training.learners.items()}), seed=1)
        prices = stack._prices
        paid.append(run.episode_circularity.mean() / env.network.objective.circularity_scale)
        paid[-1] += prices @ run.episode_levels.mean(axis=0)
    assert paid[1] > paid[0] + 0.01


@pytest.mark.parametrize("budgets", [{}, {"emissions": -50.0, "cost": 20.0}], ids=["services", "budgets"])
def test_slopes_are_those_of_what_is_demanded(monkeypatch: pytest.MonkeyPatch, budgets: dict[str, float]) -> None:
    """Of each level and of minus each budget in parts of it, in the coming episode; the environment stays as it is."""
    monkeypatch.setattr(gradient_ascent, "FEEDBACK", 1.0)
    asked = {"steps": 16, "evaluations": 1, "at_most": budgets, "price_rate": 0.1}
    climb = recipe(asked, parameters={**PARAMETERS, "learning_rate": 1e-3})
    training = train(booked(load_network("carbo_net"), 2, efforts=False), climb, seed=4)
    (stack,) = training._stacks
    assert isinstance(stack, GradientStack)
    before, end, slopes = stack._env.physical, stack.parameters, stack.slopes()
    assert stack._env.physical is before and torch.equal(stack.parameters, end)

    def outcomes(change: np.ndarray) -> np.ndarray:
        stack.parameters = end + torch.as_tensor(change, dtype=torch.float32).view_as(end)
        stack._look_ahead()
        levels = stack._tape[-1][0].after.service.mean(axis=1) / len(stack._tape)
        return np.append(levels, -stack._amounts().mean(axis=0) / stack._aims.sizes)

    assert len(slopes) == 2 + len(budgets)
    for row in slopes:
        change = 1e-3 * row / max(1e-9, np.linalg.norm(row))
        expected = slopes @ change
        rise = (outcomes(change) - outcomes(-change)) / 2
        np.testing.assert_allclose(rise, expected, atol=0.02 * np.abs(expected).max())


def test_beyond_its_bounds_only_what_leads_back_counts() -> None:
    """An output beyond 1 gets no gradient further out, and all of one back, as if it were not clipped; padding none."""
    (stack,) = train("copper_net", recipe({"steps": 8}))._stacks
    assert isinstance(stack, GradientStack)
    count = len(stack._env.actuators.control_rows)
    shape = (len(stack.members), stack._env.num_envs, max(space.shape[0] for space in stack._inputs.spaces))
    for value, out in ((1.5, 1.0), (-1.5, -1.0), (0.5, 0.0)):
        for worth in (1.0, -1.0):
            gradient = stack._by_output(np.full((count, shape[1]), worth), torch.full(shape, value)).numpy()
            found = gradient[stack._action_places.index]
            np.testing.assert_array_equal(found, np.zeros_like(found) if worth == out else -worth * np.ones_like(found))
            assert np.abs(gradient).sum() == np.abs(found).sum()


def test_each_service_has_a_price(monkeypatch: pytest.MonkeyPatch) -> None:
    """Its logarithm moves by what an evaluation would lack of it, and what follows is paid at that price."""
    move, errors, variates = GradientStack._move_prices, list[np.ndarray](), ControlVariates()
    model: list[Any] = []

    def watch(stack: GradientStack, levels: np.ndarray, accounts: np.ndarray) -> None:
        move(stack, levels, accounts)
        doubt = 2 * 1.645 * levels.std(axis=1) / 3  # of nine episodes
        lower = levels.mean(axis=1) - variates.luck(stack._draws(), levels.T) - np.maximum(doubt, 0.05 * 0.02)
        errors.append(np.clip((0.98 - lower) / 0.02, -1, 1))
        model[:] = [stack._models[0], stack._prices]

    monkeypatch.setattr(GradientStack, "_move_prices", watch)
    asked = {"steps": 40, "evaluations": 1, "episodes": 9, "min_service": 0.98, "price_rate": 0.3, "price_damping": 0.7}
    training = train("carbo_net", recipe(asked), circularity_weight=0.8)
    assert training.env.circularity_weight == 0.8  # evaluations move no price
    assert len(errors) == 5 and np.abs(errors).max() > 0
    stated = np.array([0.25 * service.weight for service in load_network("carbo_net").services])
    prices = stated * np.exp(0.3 * np.sum(errors, axis=0) + 0.7 * errors[-1])
    np.testing.assert_allclose(model[1], prices, rtol=1e-12)
    np.testing.assert_allclose(model[0].price_integrals, stated * np.exp(0.3 * np.sum(errors[:-1], axis=0)), rtol=1e-12)


@pytest.mark.parametrize(
    ("changes", "options", "reason"),
    [
        (
            {"algorithm": "A2C", "parameters": {}},
            {},
            "algorithm A2C: its policies are those of PPO, TD3, DDPG, ",
        ),
        (
            {"algorithm": "SAC", "parameters": {"use_sde": True}},
            {},
            "parameters.use_sde: what acts is no",
        ),
        (
            {"algorithm": "TD3", "parameters": {"policy_kwargs": {"activation_fn": torch.nn.ELU}}},
            {},
            "parameters.policy_kwargs: activation ELU is not one of Tanh, ReLU",
        ),
        (
            {"algorithm": "TQC", "parameters": {"policy_kwargs": {"optimizer_class": torch.optim.Adagrad}}},
            {},
            "parameters.policy_kwargs: optimiser Adagrad is not element by element",
        ),
        ({"scheme": "joint"}, {}, "scheme joint: each agent has a policy of its own"),
        ({}, {"reward": "mixed"}, "reward 'mixed'"),
    ],
)
def test_who_cannot_climb(changes: dict[str, Any], options: dict[str, Any], reason: str) -> None:
    """Is told why, before anything is learnt."""
    with pytest.raises(RecipeError, match=f"engine gradients: {reason}"):
        train("copper_net", recipe(**changes), **options)


@pytest.mark.medium
@pytest.mark.sample(4)
@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_what_has_derivatives_learns_by_them_if_no_recipe_is_given(name: str) -> None:
    """And what has none learns by random search."""
    network = load_network(name)
    chosen = default_recipe(network)
    try:
        Derivatives(MultiAgentVectorEnv(network, num_envs=1))
    except CirlError as error:
        assert chosen == "independent_ars" and "cannot be differentiated" in str(error)
    else:
        assert chosen == "exact_gradients"
    assert prepare(network, None).config.recipe.name == chosen


def test_a_scenario_may_have_another_recipe() -> None:
    """The paper's has a solver of its own, without derivatives."""
    assert prepare("copper_net", None, scenario="paper").config.recipe.name == "independent_ars"
    assert prepare("copper_net", None, scenario="outages").config.recipe.name == "exact_gradients"
