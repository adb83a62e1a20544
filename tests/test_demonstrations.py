"""Demonstrations: the replay buffer holds what the controller did, the steps count once, mistakes are named."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, get_args

import gymnasium
import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from sb3_contrib import ARS
from stable_baselines3 import PPO, SAC, HerReplayBuffer
from stable_baselines3.common.monitor import Monitor
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

from cirl_marl import ControlError, DefinitionError, MultiAgentVectorEnv, RecipeError
from cirl_marl.controllers import Controller, ScriptController
from cirl_marl.environments.goal import GoalEnv
from cirl_marl.learners.demonstrations import demonstrate, in_copies
from cirl_marl.learners.interface import resume, train
from cirl_marl.learners.learner import derived_seed
from cirl_marl.learners.recipe import Demonstrations, Recipe, load_recipe
from cirl_marl.learners.trainer import Training
from cirl_marl.learners.views import View
from cirl_marl.optimum.registry import CONTROLLERS, UNCERTAIN, named_controller
from cirl_marl.paper.published import ENVIRONMENTS
from cirl_marl.paper.results import PaperRow
from cirl_marl.paper.training import train_tuned

HORIZON, COPIES, SEED = 4, 2, 5
AGENTS = ("mine", "use", "use_to_collection")
SMALL = {"batch_size": 4, "buffer_size": 200, "learning_starts": 0, "policy_kwargs": {"net_arch": [8]}}
PLAIN = {"observation": False, "reward": False}
NORMALISED = {"observation": True, "reward": False}
Transition = tuple[NDArray[Any], NDArray[Any], NDArray[Any], NDArray[Any], bool]


def recipe(shown: dict[str, Any], steps: int = 40, **learner: Any) -> Recipe:
    """Return a recipe in which everybody learns by SAC, after demonstrations."""
    common = {"algorithm": "SAC", "parameters": SMALL, "demonstrations": shown}
    return Recipe.model_validate(
        {"name": "a", "title": "a", "run": {"steps": steps, "envs": COPIES}, "learner": common | learner}
    )


def trained(asked: Recipe, **options: Any) -> Training:
    """Train three agents of ``copper_net`` in episodes of four steps."""
    return train("copper_net", asked, agents=list(AGENTS), horizon=HORIZON, **{"seed": SEED} | options)


def buffer_of(training: Training, name: str) -> Any:
    """Return the replay buffer of a learner."""
    model = training.learners[name].model
    assert isinstance(model, OffPolicyAlgorithm)
    return model.replay_buffer


def shown_by(controller: Controller, seed: int, view_of: Any, steps: int) -> Iterator[Transition]:
    """Yield what ``controller``, started anew with each episode, does and sees in the copies that a run steps."""
    env = MultiAgentVectorEnv("copper_net", num_envs=COPIES, agents=AGENTS, horizon=HORIZON)
    view: View = view_of(env)
    observations = env.reset(seed=[derived_seed(SEED, "copies", i) for i in range(COPIES)])
    for t in range(steps):
        if t % HORIZON == 0:
            controller.start(env, seed + t // HORIZON)
        actions = controller.act(observations)
        exact = {agent: np.asarray(action, dtype=np.float32) for agent, action in actions.items()}
        before = view.observe(observations, env.state)
        observations, rewards, _, ends, infos = env.step(exact)
        done = bool(ends[AGENTS[0]].all())
        seen = {agent: info["final_obs"] for agent, info in infos.items()} if done else observations
        after = view.observe(seen, env.state)
        rows = [exact[agent] for agent in view.agents]
        joined = np.concatenate(rows, axis=0 if view.row_agents else 1)
        assert isinstance(before, np.ndarray) and isinstance(after, np.ndarray)
        yield before, after, joined, view.score(rewards), done


@pytest.mark.parametrize("controller", ["random", "mpc"])
@pytest.mark.parametrize("scheme", ["independent", "shared", "joint"])
@pytest.mark.medium
@pytest.mark.sample(2)
def test_buffer_holds_what_the_controller_did(scheme: str, controller: str) -> None:
    """In its own units, with the true last observation, whoever the learner acts for; all follow one controller."""
    shown = {"controller": controller, "steps": 20}
    training = trained(recipe(shown, scheme=scheme), steps=20)
    seed = derived_seed(SEED, "demonstrations", controller)
    assert len(training.learners) == (3 if scheme == "independent" else 1)
    for name, learner in training.learners.items():
        buffer, view = buffer_of(training, name), learner.agent_env.view
        groups = {group.name: group for group in training.config.recipe.groups(training.env.network, AGENTS)}
        expected = list(shown_by(named_controller(controller), seed, groups[name].view, 10))
        assert buffer.pos == len(expected) == 10
        assert learner.model.num_timesteps == 20 * max(1, len(view.row_agents))
        for t, (before, after, actions, rewards, done) in enumerate(expected):
            np.testing.assert_array_equal(buffer.actions[t], actions)
            np.testing.assert_array_equal(buffer.observations[t], before)
            # a normaliser keeps the last observation of an episode in its own units only
            np.testing.assert_allclose(buffer.next_observations[t], after, rtol=1e-4 * done, atol=1e-4 * done)
            np.testing.assert_array_equal(buffer.rewards[t], rewards.astype(np.float32))
            assert (buffer.dones[t] == done).all() and (buffer.timeouts[t] == done).all()


def test_last_observation_of_an_episode_is_exact_without_a_normaliser() -> None:
    """And is not the first of the next."""
    training = trained(recipe({"controller": "random", "steps": 20}, normalise=PLAIN), steps=20)
    seed = derived_seed(SEED, "demonstrations", "random")
    buffer, view = buffer_of(training, "use"), training.learners["use"].agent_env.view
    for t, (_, after, _, _, done) in enumerate(shown_by(named_controller("random"), seed, lambda env: view, 10)):
        np.testing.assert_array_equal(buffer.next_observations[t], after)
        assert not done or (buffer.observations[t + 1] != after).any()


@pytest.mark.medium
@pytest.mark.parametrize(("starts", "updates"), [(0, 10), (30, 5)])
def test_steps_count_once(starts: int, updates: int, tmp_path: Path) -> None:
    """In the budget, in ``learning_starts`` and in the metrics; learning begins when the demonstrations are over."""
    parameters = SMALL | {"learning_starts": starts}
    shown = recipe({"controller": "neutral", "steps": 20}, parameters=parameters)
    training = trained(shown, directory=tmp_path / "run")
    assert training.joint_steps == 20
    for name, learner in training.learners.items():
        model, buffer = learner.model, buffer_of(training, name)
        assert (model.num_timesteps, buffer.pos, model._n_updates) == (40, 20, updates)
        neutral = training.env.neutral_action[name][0].astype(np.float32)
        assert (buffer.actions[:10] == neutral).all() and (buffer.actions[10:20] != neutral).all()
    assert training.run is not None
    assert training.run.metrics()["env_steps"] == [8, 16, 24, 32, 40]
    assert training.run.config.recipe.learner.demonstrations == Demonstrations(controller="neutral", steps=20)


ROLLOUTS: dict[str, Any] = {"n_steps": 8, "batch_size": 8, "n_epochs": 1, "policy_kwargs": {"net_arch": [32]}}


@pytest.mark.parametrize(
    ("algorithm", "policy", "parameters"),
    [
        ("PPO", "MlpPolicy", ROLLOUTS),
        ("A2C", "MlpPolicy", {"n_steps": 8}),
        ("PPO", "CentralCriticPolicy", ROLLOUTS),
        ("ARS", "MlpPolicy", {"n_delta": 1, "zero_policy": False, "policy_kwargs": {"net_arch": [32]}}),
    ],
)
@pytest.mark.sample(1)
def test_learner_without_a_buffer_imitates(algorithm: str, policy: str, parameters: dict[str, Any]) -> None:
    """What it has been shown it then does: much less of a random start is left; only then does it learn by itself."""
    shown = {"controller": "neutral", "steps": 320}
    far: dict[int, float] = {}
    for steps in (8, 320):
        asked = recipe(
            shown | {"steps": steps},
            320,
            algorithm=algorithm,
            policy=policy,
            parameters=parameters,
            normalise=NORMALISED,
        )
        training = trained(asked, steps=steps)
        neutral, observations = named_controller("neutral"), training.env.reset(seed=[1, 2])
        neutral.start(training.env, 0)
        wanted, found = neutral.act(observations), 0.0
        for name, learner in training.learners.items():
            counted = learner.agent_env.num_envs if algorithm == "ARS" else 1
            assert learner.model.num_timesteps == steps * counted and learner.demonstrations == 0
            if isinstance(learner.model, ARS):
                parameters_now = torch.nn.utils.parameters_to_vector(learner.model.policy.parameters())
                assert learner.model.weights is not None and torch.equal(learner.model.weights, parameters_now)
            assert isinstance(learner.env, VecNormalize)
            seen = learner.env.normalize_obs(learner.agent_env.view.observe(observations, training.env.state))
            action, _ = learner.model.predict(seen, deterministic=True)
            found = max(found, float(np.abs(action - wanted[name]).max()))
        far[steps] = found
    assert far[320] < 0.05 and far[320] < far[8]


class Told(DummyVecEnv):
    """Keeps the actions that it is told."""

    def step_async(self, actions: NDArray[Any]) -> None:
        """Keep them as they come."""
        self.told = [*getattr(self, "told", []), actions.copy()]
        super().step_async(actions)


def test_the_learner_acts_after_its_first_rollout() -> None:
    """The controller says what it would do in states that the learner brings about itself."""
    env = Told([lambda: gymnasium.make("MountainCarContinuous-v0")] * COPIES)
    model = PPO("MlpPolicy", env, n_steps=4, batch_size=8, n_epochs=1, seed=1, device="cpu")
    shown: list[NDArray[np.float32]] = []

    def act() -> NDArray[np.float32]:
        shown.append(np.full((COPIES, 1), 0.25 + len(shown) / 100, dtype=np.float32))
        return shown[-1]

    demonstrate(model, 12 * COPIES, act)
    assert model.num_timesteps == 12 * COPIES and len(shown) == len(env.told) == 12
    assert all((told == said).all() for told, said in zip(env.told[:4], shown[:4], strict=True))
    assert all((told != said).any() for told, said in zip(env.told[4:], shown[4:], strict=True))


def test_imitation_goes_on_after_it_was_stopped(tmp_path: Path, ctrl_c_after: Any) -> None:
    """By the policy that was saved, for what is left of the demonstrations; then the learner learns by itself."""
    asked = recipe({"controller": "neutral", "steps": 64}, 96, algorithm="PPO", parameters=ROLLOUTS)
    with pytest.raises(KeyboardInterrupt):
        trained(asked, directory=tmp_path / "run", report=ctrl_c_after(20))
    found = resume(tmp_path / "run")
    assert [each.model.num_timesteps for each in found.learners.values()] == [96] * 3


def test_others_learn_from_the_start() -> None:
    """A learner without demonstrations does not wait for one that has them."""
    asked = recipe({"controller": "neutral", "steps": 20}).model_dump(mode="json")
    asked["learner"]["demonstrations"] = None
    asked["match"] = [{**asked["learner"], "agents": ["use"], "demonstrations": {"controller": "random", "steps": 20}}]
    training = trained(Recipe.model_validate(asked))
    updates = {name: learner.model._n_updates for name, learner in training.learners.items()}
    assert updates == {"mine": 20, "use": 10, "use_to_collection": 20}


@pytest.mark.medium
def test_same_seed_gives_the_same_bits() -> None:
    """Also of what a random controller shows."""

    def values(seed: int) -> NDArray[np.floating]:
        training = trained(recipe({"controller": "random", "steps": 20}), seed=seed)
        weights = [p.detach().numpy().ravel() for t in training.learners.values() for p in t.model.policy.parameters()]
        return np.concatenate([*weights, buffer_of(training, "use").actions.ravel()])

    first, again, other = values(3), values(3), values(4)
    assert (first == again).all() and (first != other).any()


@pytest.mark.medium
@pytest.mark.parametrize("stop", [6, 14])
def test_resumed_run_gets_the_rest(stop: int, tmp_path: Path, ctrl_c_after: Any) -> None:
    """Stopped in the middle of the demonstrations it gets the others, stopped after them none; none are lost."""
    asked = recipe({"controller": "neutral", "steps": 20})
    with pytest.raises(KeyboardInterrupt):
        trained(asked, directory=tmp_path / "run", report=ctrl_c_after(COPIES * stop))
    training = resume(tmp_path / "run")
    for name in AGENTS:
        buffer, neutral = buffer_of(training, name), training.env.neutral_action[name][0].astype(np.float32)
        by_controller = (buffer.actions[: buffer.pos] == neutral).all(axis=(1, 2))
        assert training.learners[name].model.num_timesteps == 40
        assert by_controller.tolist() == [True] * 10 + [False] * 10


@pytest.mark.parametrize("normalise", [False, True])
def test_goal_task_in_copies(normalise: bool) -> None:
    """Hindsight finds whole episodes of the script; the model goes on in the middle of the next."""
    envs = [Monitor(GoalEnv("solids_net", "sorter", scenario="paper_fetch", horizon=4)) for _ in range(COPIES)]
    env: Any = DummyVecEnv([lambda env=env: env for env in envs])  # type: ignore[misc]
    env = VecNormalize(env) if normalise else env
    parameters = SMALL | {"batch_size": 8, "policy_kwargs": {"net_arch": [8]}}  # of its own, as SAC writes into it
    model = SAC("MultiInputPolicy", env, replay_buffer_class=HerReplayBuffer, seed=1, device="cpu", **parameters)  # type: ignore[arg-type]
    demonstrate(model, 20, in_copies("scripted", envs, [0, 1]))
    buffer: Any = model.replay_buffer
    assert (model.num_timesteps, buffer.pos, model._n_updates) == (20, 10, 0)
    for copy in range(COPIES):
        own = GoalEnv("solids_net", "sorter", scenario="paper_fetch", horizon=4)
        flat, script = own.flat, ScriptController()
        observation, _ = own.reset(seed=1 + copy)
        script.start(flat.parallel.batch, 0)
        for t in range(10):
            (action,) = script.act(flat.parallel.batch.observations())["sorter"].astype(np.float32)
            following, reward, _, done, _ = own.step(action)
            np.testing.assert_array_equal(buffer.actions[t, copy], action)
            for part, value in observation.items():
                np.testing.assert_array_equal(buffer.observations[part][t, copy], value)
                tolerance = 1e-4 * (done and normalise)
                found = buffer.next_observations[part][t, copy]
                np.testing.assert_allclose(found, following[part], rtol=tolerance, atol=tolerance)
            assert (buffer.rewards[t, copy], buffer.dones[t, copy], buffer.timeouts[t, copy]) == (reward, done, done)
            observation = own.reset()[0] if done else following
    assert buffer.ep_length[:10].tolist() == [[4, 4]] * 8 + [[0, 0]] * 2
    model.learn(4, reset_num_timesteps=False)
    assert (model.num_timesteps, buffer.pos, model._n_updates) == (24, 12, 2)
    assert buffer.ep_length[8:12].tolist() == [[4, 4]] * 4


@pytest.mark.medium
def test_tuned_row_counts_its_demonstrations(monkeypatch: pytest.MonkeyPatch) -> None:
    """As steps and as training episodes; the script succeeds where a random policy does not.

    Goals keep their scale when observations are normalised: hindsight puts what was achieved in place of what was
    desired.
    """
    parameters = SMALL | {"buffer_size": 500}
    small = recipe(
        {"controller": "scripted", "steps": 200}, 300, algorithm="TQC", parameters=parameters, normalise=NORMALISED
    )
    normalisers: list[VecNormalize] = []

    class Kept(VecNormalize):
        def __init__(self, *arguments: Any, **options: Any) -> None:
            super().__init__(*arguments, **options)
            normalisers.append(self)

    monkeypatch.setattr("cirl_marl.learners.learner.VecNormalize", Kept)
    row = PaperRow(environment="FetchWasteSorting", algorithm="TQC", settings="tuned", steps=300)
    found = train_tuned(ENVIRONMENTS["FetchWasteSorting"], row, lambda *_: None, small)
    statistics: Any = normalisers[0].obs_rms
    assert list(statistics) == ["observation"]
    assert (found.steps, found.ends) == (300, [100, 100, 200, 200, 300, 300])
    assert max(found.returns[:4]) < -5.0 and min(found.returns[:4]) > -30.0
    assert found.settings["recipe"]["learner"]["demonstrations"] == {"controller": "scripted", "steps": 200}
    with pytest.raises(RecipeError, match=r"learner\.demonstrations\.steps: 200 is more than the 100 steps of the run"):
        short = PaperRow(environment="FetchWasteSorting", algorithm="TQC", settings="tuned", steps=100)
        train_tuned(ENVIRONMENTS["FetchWasteSorting"], short, lambda *_: None, small)


GOOD = """
name = "mine"
title = "a recipe"
[run]
steps = 100
[learner]
algorithm = "SAC"
demonstrations = { controller = "scripted", steps = 50 }
"""


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"scripted"', '"scriptd"', "learner.demonstrations.controller: unknown value 'scriptd'. Did you mean 'script"),
        ("steps = 50", "steps = 0", "learner.demonstrations.steps: must be more than 0, got 0"),
        ("steps = 50", "step = 50", "learner.demonstrations.step: unknown key 'step'. Did you mean 'steps'?"),
        ("steps = 50", "steps = 101", "learner.demonstrations.steps: 101 is more than the 100 steps of the run"),
        ("[learner]", "[learner]\nshare_of_steps = 0.4", "50 is more than the 100 steps of the run times share_of_"),
        (
            '"SAC"',
            '"RecurrentPPO"\npolicy = "MlpLstmPolicy"',
            "learner.demonstrations: RecurrentPPO can neither keep nor imitate them; use one of A2C, ARS, CrossQ",
        ),
    ],
)
def test_mistakes_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    """Each is an error that names file, key, value and what would do."""
    path = tmp_path / "recipe.toml"
    path.write_text(GOOD)
    assert load_recipe(path).learner.demonstrations == Demonstrations(controller="scripted", steps=50)
    path.write_text(GOOD.replace(old, new))
    with pytest.raises(DefinitionError) as raised:
        load_recipe(path)
    assert str(path) in str(raised.value)
    assert message in str(raised.value)


@pytest.mark.parametrize(
    ("network", "controller", "options", "message"),
    [
        (
            "copper_net",
            "scripted",
            {},
            "agent 'refinery': demonstrations by scripted control: there is no script for i",
        ),
        ("copper_net", "lqr", {}, "agent 'refinery': demonstrations by lqr control: "),
        ("copper_net", "neutral", {"steps": 8}, "learner.demonstrations.steps: 10 is more than the 8 steps of the run"),
    ],
)
def test_controllers_that_do_not_fit_are_named(
    network: str, controller: str, options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """Before anything is trained or written."""
    with pytest.raises(RecipeError) as raised:
        train(network, recipe({"controller": controller, "steps": 10}), directory=tmp_path / "run", **options)
    assert message in str(raised.value)
    assert not (tmp_path / "run").exists()


def test_copies_must_be_of_a_network() -> None:
    """Another environment has nothing that a controller could read."""
    with pytest.raises(RecipeError, match="controllers act in networks, and PendulumEnv is none"):
        in_copies("neutral", [gymnasium.make("Pendulum-v1")], [0])


def test_controllers_are_those_of_the_library() -> None:
    """All but the one that needs values, and those for what is drawn."""
    known = get_args(Demonstrations.model_fields["controller"].annotation)
    assert set(known) == set(CONTROLLERS) - {"constant", *UNCERTAIN}


def test_current_observations_are_those_last_returned() -> None:
    """After a reset, within an episode, where the next begins, and after going back."""
    env = MultiAgentVectorEnv("net_zero", num_envs=2, horizon=2)
    with pytest.raises(ControlError, match=r"call reset\(\) first"):
        env.observations()
    actions = {agent: np.full_like(neutral, 0.5) for agent, neutral in env.neutral_action.items()}
    seen, snapshot = env.reset(0), env.snapshot()
    for _ in range(3):
        for agent, value in env.observations().items():
            np.testing.assert_array_equal(value, seen[agent])
        seen = env.step(actions)[0]
    again = env.restore(snapshot)
    for agent, value in env.observations().items():
        np.testing.assert_array_equal(value, again[agent])
