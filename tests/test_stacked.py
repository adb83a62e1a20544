"""Learners that run as one: the algorithms of Stable-Baselines3 up to rounding, learner by learner."""

from __future__ import annotations

import itertools
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium import spaces
from hypothesis import given, settings
from hypothesis import strategies as st
from sb3_contrib import ARS
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from cirl_marl import CirlError, MultiAgentVectorEnv, RecipeError
from cirl_marl.learners import trainer
from cirl_marl.learners.interface import Trained, export, resume, train, train_seeds
from cirl_marl.learners.learner import derived_seed
from cirl_marl.learners.lockstep import Streams
from cirl_marl.learners.policies import Policies
from cirl_marl.learners.recipe import LearnerSettings, Match, Normalisation, Recipe, Run, load_recipe
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.learners.stacked.perceptrons import ACTIVATIONS, Layer, Perceptrons
from cirl_marl.learners.stacked.stack import StackedPolicies
from cirl_marl.learners.trainer import Training
from cirl_marl.learners.validation import Score, validation_score
from cirl_marl.optimum.aims import Aims

PPO_SMALL = {"n_steps": 10, "batch_size": 10, "n_epochs": 2, "policy_kwargs": {"net_arch": [8, 8]}}
AGENTS = ["mine", "use", "sorting"]


def recipe(algorithm: str = "PPO", *, envs: int = 2, match: list[Match] | None = None, **settings: Any) -> Recipe:
    """Return a recipe for two rollouts of all agents."""
    learner = LearnerSettings(algorithm=algorithm, **settings)
    run = Run(steps=20 * envs, envs=envs, evaluations=0)
    return Recipe(name="small", title="small", run=run, learner=learner, match=match or [])


def both(given: Recipe, network: str = "copper_net", **options: Any) -> tuple[Training, Training]:
    """Train in lockstep and stacked."""
    options = {"horizon": 7, "agents": AGENTS if network == "copper_net" else None} | options
    return train(network, given, engine="lockstep", **options), train(network, given, engine="stacked", **options)


def assert_same(one: Training, other: Training, atol: float = 1e-5) -> None:
    """Assert that weights, optimisers, normalisers, counters and streams of every learner are equal up to rounding."""
    assert list(one.learners) == list(other.learners)
    for name, mine in one.learners.items():
        theirs = other.learners[name]
        assert mine.model.num_timesteps == theirs.model.num_timesteps
        assert mine.model._n_updates == theirs.model._n_updates
        own, their = mine.model.policy, theirs.model.policy
        for key, value in own.state_dict().items():
            torch.testing.assert_close(their.state_dict()[key], value, atol=atol, rtol=0)
        if not isinstance(mine.model, ARS):
            for a, b in zip(own.parameters(), their.parameters(), strict=True):
                kept, found = own.optimizer.state[a], their.optimizer.state[b]
                assert set(kept) == set(found)
                for key, value in kept.items():
                    torch.testing.assert_close(
                        torch.as_tensor(found[key]), torch.as_tensor(value), atol=atol, rtol=1e-4
                    )
        if isinstance(mine.env, VecNormalize):
            assert isinstance(theirs.env, VecNormalize)
            pairs = [(mine.env.ret_rms, theirs.env.ret_rms)]
            if mine.env.norm_obs:
                kept_moments, found_moments = (
                    env.obs_rms if isinstance(env.obs_rms, dict) else {"": env.obs_rms}
                    for env in (mine.env, theirs.env)
                )
                pairs += [(moments, found_moments[key]) for key, moments in kept_moments.items()]
            for moments, same in pairs:
                assert moments.count == pytest.approx(same.count)
                np.testing.assert_allclose(same.mean, moments.mean, rtol=1e-5, atol=1e-7)
                np.testing.assert_allclose(same.var, moments.var, rtol=1e-5, atol=1e-9)
        torch.testing.assert_close(mine.streams.torch_state, theirs.streams.torch_state)
        with mine.streams.active():
            drawn = np.random.rand(3)  # noqa: NPY002 (the legacy stream is what minibatches are drawn from)
        with theirs.streams.active():
            assert np.array_equal(np.random.rand(3), drawn)  # noqa: NPY002


CASES: dict[str, Recipe] = {
    "ppo": recipe(parameters=PPO_SMALL),
    "last minibatch smaller": recipe(parameters=PPO_SMALL | {"batch_size": 8}),
    "clipped value, entropy, schedule": recipe(
        parameters=PPO_SMALL
        | {"clip_range_vf": 0.05, "ent_coef": 0.01, "learning_rate": {"linear_from": 3e-3, "linear_to": 1e-4}}
    ),
    "whole returns": recipe(parameters=PPO_SMALL | {"gamma": 1.0, "gae_lambda": 1.0}, bootstrap=False),
    "advantages as they are": recipe(parameters=PPO_SMALL | {"normalize_advantage": False, "max_grad_norm": 0.01}),
    "nothing normalised": recipe(parameters=PPO_SMALL, normalise=Normalisation(observation=False, reward=False)),
    "rewards normalised": recipe(parameters=PPO_SMALL, normalise=Normalisation(observation=False)),
    "relu": recipe(parameters=PPO_SMALL | {"policy_kwargs": {"net_arch": [8], "activation_fn": nn.ReLU}}),
    "linear actor": recipe(parameters=PPO_SMALL | {"policy_kwargs": {"net_arch": {"pi": [], "vf": [8]}}}),
    "central critic": recipe(parameters=PPO_SMALL, policy="CentralCriticPolicy"),
    "shared": recipe(parameters=PPO_SMALL, scheme="shared"),
    "joint": recipe(parameters=PPO_SMALL, scheme="joint"),
    "a2c": recipe("A2C", parameters={"n_steps": 5, "policy_kwargs": {"net_arch": [8]}}),
    "a2c with adam": recipe("A2C", parameters={"n_steps": 5, "use_rms_prop": False, "normalize_advantage": True}),
    "half of the run": recipe(parameters=PPO_SMALL, share_of_steps=0.5),
}


@pytest.mark.filterwarnings("ignore:You have specified a mini-batch size")
@pytest.mark.parametrize("case", CASES)
@pytest.mark.sample(6)
def test_a_rollout_and_its_updates_are_those_of_the_library(case: str) -> None:
    """From the same weights and noise; two rollouts with ends of episodes within them."""
    assert_same(*both(CASES[case]))


def test_unequal_observations_and_actions_stack() -> None:
    """A robot with four inputs beside a truck and a furnace with one: padding changes nothing."""
    lockstep, stacked = both(recipe(parameters=PPO_SMALL), "solids_net", reward="mixed")
    assert len({each.agent_env.action_space.shape for each in stacked.learners.values()}) > 1
    assert_same(lockstep, stacked)


def test_random_search_in_turn_is_that_of_the_library() -> None:
    """Each candidate in all copies, as the library evaluates it; half the directions count."""
    parameters = {"n_delta": 2, "n_top": 1, "zero_policy": False, "policy_kwargs": {"net_arch": [8]}}
    search = recipe("ARS", parameters=parameters)
    search = search.model_copy(update={"run": search.run.model_copy(update={"steps": 2 * 4 * 7 * 2})})
    for policy, more in (("MlpPolicy", {}), ("LinearPolicy", {"policy_kwargs": {}, "delta_std": 0.3})):
        own = search.learner.model_copy(update={"policy": policy, "parameters": parameters | more})
        lockstep, stacked = both(search.model_copy(update={"learner": own}))
        assert stacked.learners["use"].model._n_updates == 2
        assert_same(lockstep, stacked)


def test_candidates_side_by_side_against_policies_stepped_by_hand() -> None:
    """Copy k has candidate k of every learner; the update is the algorithm's, from returns that are counted by hand."""
    copies, horizon = 4, 6
    search = recipe(
        "ARS",
        envs=copies,
        parameters={"n_delta": 2, "n_eval_episodes": 1, "zero_policy": False, "policy_kwargs": {"net_arch": [8]}},
        normalise=Normalisation(observation=False, reward=False),
    )
    run = search.run.model_copy(update={"steps": copies * horizon, "common_random_numbers": True})
    search = search.model_copy(update={"run": run})
    stacked = train("copper_net", search, engine="stacked", agents=AGENTS, horizon=horizon, seed=3)
    env = MultiAgentVectorEnv("copper_net", num_envs=copies, agents=AGENTS, horizon=horizon)
    observations = env.reset(seed=[derived_seed(3, "copies", 0)] * copies)
    assert all(np.ptp(seen, axis=0).max() == 0 for seen in observations.values())  # all copies begin alike
    models, deltas = {}, {}
    for agent in AGENTS:
        streams = Streams(derived_seed(3, agent))
        with streams.active():
            lone = Still(env.observation_spaces[agent], env.action_spaces[agent])
            parameters = search.learner.parameters
            models[agent] = ARS("MlpPolicy", lone, seed=derived_seed(3, agent), device="cpu", **parameters)
            deltas[agent] = torch.normal(0.0, 1.0, (2, models[agent].n_params))
    returns = np.zeros((len(AGENTS), copies))
    tried = {
        agent: torch.cat([m.weights + 0.05 * deltas[agent], m.weights - 0.05 * deltas[agent]])  # type: ignore[operator]
        for agent, m in models.items()
    }
    for _ in range(horizon):
        actions = {}
        for agent, model in models.items():
            each = []
            for copy in range(copies):
                model.policy.load_from_vector(tried[agent][copy].numpy())
                each.append(model.predict(observations[agent][copy])[0])
            actions[agent] = np.stack(each)
        observations, rewards, *_ = env.step(actions)
        returns += np.stack([rewards[agent] for agent in AGENTS])
    for i, agent in enumerate(AGENTS):
        plus, minus = (torch.as_tensor(part, dtype=torch.float32) for part in np.split(returns[i], 2))
        size = 0.02 / (2 * torch.cat([plus, minus]).std() + 1e-6)
        expected = models[agent].weights + size * (plus - minus) @ deltas[agent]  # type: ignore[operator]
        found = nn.utils.parameters_to_vector(stacked.learners[agent].model.policy.parameters())
        torch.testing.assert_close(found, expected, atol=1e-5, rtol=1e-5)


class Still(gymnasium.Env[Any, Any]):
    """Just enough of an environment to build an algorithm on."""

    def __init__(self, observation: spaces.Box, action: spaces.Box) -> None:
        """Have these spaces."""
        self.observation_space, self.action_space = observation, action


@pytest.mark.parametrize("algorithm", ["PPO", "ARS"])
def test_seeds_that_learn_together_learn_what_they_learn_alone(algorithm: str, tmp_path: Path) -> None:
    """Who stands beside a learner in the stack changes nothing."""
    parameters: dict[str, Any] = PPO_SMALL if algorithm == "PPO" else {"n_delta": 2, "n_eval_episodes": 1}
    given = recipe(algorithm, envs=4, parameters=parameters)
    options: dict[str, Any] = {"horizon": 7, "agents": AGENTS}
    together = train_seeds("copper_net", given, seeds=[4, 9], directory=tmp_path / "run", **options)
    for seed, training in zip((4, 9), together, strict=True):
        assert_same(train("copper_net", given, seed=seed, **options), training, atol=1e-6)
        assert RunDirectory(tmp_path / f"run-seed{seed}").config.seed == seed


@given(
    st.integers(1, 3), st.integers(1, 9), st.lists(st.integers(1, 9), max_size=3), st.integers(1, 3),
    st.sampled_from(list(ACTIVATIONS)), st.booleans(), st.integers(0, 2**31),
)  # fmt: skip
@settings(max_examples=25)
def test_gradients_are_those_of_autograd(
    learners: int, samples: int, hidden: list[int], outputs: int, kind: type[nn.Module], biased: bool, seed: int
) -> None:
    """For perceptrons of any shape, all learners at once or some of them."""
    stream = torch.Generator().manual_seed(seed)

    def drawn(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=stream)

    widths = [2, *hidden, outputs]
    layers = [
        Layer(drawn(learners, into, out), drawn(learners, into) if biased else None)
        for out, into in itertools.pairwise(widths)
    ]
    empty = [
        Layer(torch.zeros_like(x.weight), torch.zeros(learners, x.weight.shape[1]) if biased else None) for x in layers
    ]
    inputs, weighed = drawn(learners, samples, 2), drawn(learners, samples, outputs)
    stacked = Perceptrons(layers, ACTIVATIONS[kind], empty)
    for learner in range(learners):
        some = slice(learner, learner + 1)
        values = stacked.forward(inputs[some].clone(), some)
        stacked.backward(values, weighed[some], some)
    for i in range(learners):
        modules: list[nn.Module] = []
        for layer in layers:
            linear = nn.Linear(layer.weight.shape[2], layer.weight.shape[1], bias=biased)
            linear.weight.data = layer.weight[i].clone()
            if layer.bias is not None:
                linear.bias.data = layer.bias[i].clone()
            modules += [linear, kind()]
        network = nn.Sequential(*modules[:-1])
        (network(inputs[i]) * weighed[i]).sum().backward()
        for layer, module in zip(empty, modules[::2], strict=True):
            torch.testing.assert_close(layer.weight[i], module.weight.grad, atol=1e-4, rtol=1e-4)
            if layer.bias is not None:
                torch.testing.assert_close(layer.bias[i], module.bias.grad, atol=1e-4, rtol=1e-4)


def test_what_is_kept_is_an_ordinary_model(tmp_path: Path) -> None:
    """It loads by the library alone and acts as the run does; either engine goes on with it."""
    given = recipe(parameters=PPO_SMALL)
    run = tmp_path / "run"
    training = train("copper_net", given, directory=run, agents=AGENTS, horizon=7)
    assert {path.name for path in export(run, tmp_path / "zips")} == {f"{agent}.zip" for agent in AGENTS} | {
        path.name for path in (tmp_path / "zips").glob("*.pkl")
    }
    loaded = PPO.load(tmp_path / "zips" / "use.zip", device="cpu")
    seen = np.random.default_rng(0).normal(size=(5, *loaded.observation_space.shape)).astype(np.float32)  # type: ignore[misc]
    assert np.array_equal(
        loaded.predict(seen, deterministic=True)[0], training.learners["use"].model.predict(seen, deterministic=True)[0]
    )
    logs = list((run / "tensorboard" / "use").iterdir())
    assert logs and logs[0].stat().st_size > 500
    further = resume(run, steps=80)
    assert further.learners["use"].model.num_timesteps == 80
    config = RunDirectory(run).config
    changed = config.recipe.model_copy(update={"run": config.recipe.run.model_copy(update={"engine": "lockstep"})})
    RunDirectory(run).reopen(config.model_copy(update={"recipe": changed}), RunDirectory(run).checkpoint)
    RunDirectory(run).set_status("complete", 40, RunDirectory(run).status["checkpoint"])
    assert resume(run, steps=120).learners["use"].model.num_timesteps == 120


def test_an_optimiser_goes_on_where_it_was(tmp_path: Path) -> None:
    """Half a run and its resumption stack the moments of Adam: the second half in lockstep learns the same."""
    for engine in ("lockstep", "stacked"):
        run = tmp_path / engine
        train("copper_net", recipe(parameters=PPO_SMALL), directory=run, engine=engine, agents=AGENTS, horizon=7)
    assert_same(resume(tmp_path / "lockstep", steps=80), resume(tmp_path / "stacked", steps=80))


def test_a_search_goes_on_where_it_was(tmp_path: Path) -> None:
    """What is resumed does what is left of the steps, in either engine."""
    search = recipe("ARS", parameters={"n_delta": 2, "zero_policy": False, "policy_kwargs": {"net_arch": [8]}})
    search = search.model_copy(update={"run": search.run.model_copy(update={"steps": 2 * 4 * 7})})
    for engine in ("lockstep", "stacked"):
        run = tmp_path / engine
        train("copper_net", search, directory=run, engine=engine, agents=AGENTS, horizon=7)
        model = resume(run, steps=3 * 2 * 4 * 7).learners["use"].model
        assert (model._n_updates, model.num_timesteps) == (3, 3 * 2 * 4 * 7 * 2)


class Counts(BaseCallback):
    """Counts steps."""

    def _on_step(self) -> bool:
        return True


def test_auto_stacks_those_that_can_be() -> None:
    """Off-policy learners and those with callbacks run beside the stack, unmodified."""
    counts = Counts()
    sac = Match(algorithm="SAC", agents=["mine"], parameters={"learning_starts": 4, "buffer_size": 99, "batch_size": 4})
    given = recipe(parameters=PPO_SMALL, match=[sac])
    mixed = train("copper_net", given, agents=AGENTS, horizon=7, callbacks={"use": counts})
    assert counts.n_calls == 20
    assert [type(each.model).__name__ for each in mixed.learners.values()] == ["SAC", "PPO", "PPO"]
    by_name = {name: each.model for name, each in mixed.learners.items()}
    assert by_name["sorting"].rollout_buffer.values.max() == 0.0  # type: ignore[attr-defined]  # learnt in the stack
    assert by_name["use"].rollout_buffer.values.max() != 0.0  # type: ignore[attr-defined]
    lockstep = train("copper_net", given, agents=AGENTS, horizon=7, engine="lockstep")
    for key, value in lockstep.learners["sorting"].model.policy.state_dict().items():
        torch.testing.assert_close(by_name["sorting"].policy.state_dict()[key], value, atol=1e-4, rtol=0)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (recipe("SAC", parameters={"buffer_size": 99}), "algorithm SAC is not PPO, A2C or ARS"),
        (recipe(parameters=PPO_SMALL | {"use_sde": True}), "parameters.use_sde"),
        (recipe(parameters=PPO_SMALL | {"target_kl": 0.1}), "parameters.target_kl"),
        (recipe(parameters=PPO_SMALL | {"policy_kwargs": {"activation_fn": nn.ELU}}), "with Tanh or ReLU between them"),
        (
            recipe(parameters=PPO_SMALL | {"policy_kwargs": {"optimizer_class": torch.optim.LBFGS}}),
            "optimiser LBFGS is not element by element",
        ),
        (
            recipe("ARS", parameters={"n_delta": 3, "n_eval_episodes": 1}, envs=4),
            r"6 candidates \(2 n_delta\) of 1 episodes each \(n_eval_episodes\) do not fill 4 copies",
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_stacked_is_named(given: Recipe, said: str, tmp_path: Path) -> None:
    """The learner, why, and what would do; nothing is written; auto runs it in lockstep."""
    match = f"recipe 'small': agent 'mine': engine stacked: .*{said}.*; use engine auto or lockstep"
    with pytest.raises(RecipeError, match=match):
        train("copper_net", given, engine="stacked", agents=["mine"], directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    if "LBFGS" not in said:
        assert train("copper_net", given, agents=["mine"], horizon=7, steps=4).joint_steps


def test_engines_are_named(tmp_path: Path) -> None:
    """Words that are none are refused, and callbacks where nothing would call them."""
    given = recipe(parameters=PPO_SMALL)
    with pytest.raises(CirlError, match=r"unknown engine 'stack'\. Did you mean 'stacked'\?"):
        train("copper_net", given, engine="stack")
    with pytest.raises(CirlError, match="callbacks: agent 'use': engine stacked calls none"):
        train("copper_net", given, engine="stacked", callbacks={"use": Counts()}, directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_stacked_runs_are_reproducible_and_act(tmp_path: Path) -> None:
    """The same seed gives the same bits; a share of the run is learnt and the rest acted."""
    given = recipe("A2C", parameters={"n_steps": 5}, share_of_steps=0.5)
    one, other = (train("copper_net", given, agents=AGENTS, horizon=7, directory=tmp_path / n) for n in "ab")
    for name, each in one.learners.items():
        assert isinstance(each.model, A2C) and each.model.num_timesteps == 20
        for key, value in each.model.policy.state_dict().items():
            assert torch.equal(value, other.learners[name].model.policy.state_dict()[key])
    assert Trained(tmp_path / "a").checkpoint.name.endswith("complete")


@pytest.mark.parametrize("name", ["independent_ars", "mappo", "independent_ppo"])
def test_evaluations_act_by_stacks_as_by_policies(monkeypatch: pytest.MonkeyPatch, name: str) -> None:
    """The same but for rounding, each training's own learners, in other numbers of copies, with central critics too."""
    seen: list[tuple[Score, Score]] = []

    def watch(env: MultiAgentVectorEnv, policies: StackedPolicies, aims: Aims) -> Score:
        members = [member for stack, part in policies._parts for member in stack.members[part]]
        alone = Policies({member.name: member.policy for member in members})
        assert not policies.policies and len(members) == len({member.name for member in members})
        seen.append((validation_score(env, policies, aims), validation_score(env, alone, aims)))
        return seen[-1][0]

    monkeypatch.setattr(trainer, "validation_score", watch)
    given = load_recipe(name)
    short = {"evaluations": 2, "episodes": 3, "envs": 64 if name == "independent_ars" else 2}
    given = given.model_copy(update={"run": given.run.model_copy(update=short)})
    if "n_steps" in given.learner.parameters:
        given.learner.parameters.update(n_steps=10, batch_size=20)
    train_seeds("copper_net", given, seeds=[1, 2], steps=short["envs"] * 20, horizon=5)
    assert len(seen) == 4 or len(seen) == 6
    for stacked, alone in seen:
        assert stacked.circularity == pytest.approx(alone.circularity, rel=1e-5)
        assert stacked.service == pytest.approx(alone.service, rel=1e-5)
    assert len({stacked.circularity for stacked, _ in seen}) > 2
