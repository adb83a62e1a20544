"""Training: determinism, every algorithm at once, failure, interruption, resumption."""

from __future__ import annotations

import signal
import tempfile
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

import cirl_marl
from cirl_marl import Arc, Control, ControlKind, LearnerError, MultiAgentVectorEnv, Network, Node, RunError
from cirl_marl.learners.agent_env import AgentVecEnv
from cirl_marl.learners.interface import Trained, resume, train
from cirl_marl.learners.learner import derived_seed
from cirl_marl.learners.recipe import LearnerSettings, Match, Recipe, Run
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.learners.trainer import Training
from cirl_marl.learners.views import OneAgent
from cirl_marl.network.elements import Episode, Law
from cirl_marl.paper.results import PaperRow
from cirl_marl.paper.rows import run_row

pytestmark = pytest.mark.medium

OFF_POLICY = {
    "buffer_size": 1000,
    "learning_starts": 10,
    "batch_size": 8,
    "train_freq": 2,
    "policy_kwargs": {"net_arch": [8]},
}
MIXED: dict[str, dict[str, Any]] = {
    "A2C": {"n_steps": 7, "policy_kwargs": {"net_arch": [8]}},
    "SAC": OFF_POLICY,
    "TD3": OFF_POLICY | {"action_noise": {"kind": "normal", "sigma": 0.1}},
    "DDPG": OFF_POLICY | {"action_noise": {"kind": "ornstein_uhlenbeck", "sigma": 0.1}},
    "TQC": OFF_POLICY,
    "CrossQ": OFF_POLICY,
    "ARS": {"n_delta": 2},
    "TRPO": {"n_steps": 10, "batch_size": 20, "policy_kwargs": {"net_arch": [8]}},
    "RecurrentPPO": {
        "n_steps": 10,
        "batch_size": 20,
        "policy_kwargs": {"net_arch": [8], "lstm_hidden_size": 4},
    },
}


@pytest.fixture
def mixed_recipe(ppo_recipe: Recipe) -> Recipe:
    """Return a recipe in which agents of copper_net learn with ten different algorithms: PPO, and one each of MIXED."""
    agents = cirl_marl.load_network("copper_net").agents[1:]
    matches = [
        Match(agents=[agent], algorithm=name, parameters=MIXED[name], policy=policy_of(name))
        for agent, name in zip(agents, MIXED, strict=False)
    ]
    return ppo_recipe.model_copy(update={"match": matches})


def policy_of(name: str) -> str:
    """Return the policy class that an algorithm needs."""
    return "MlpLstmPolicy" if name == "RecurrentPPO" else "MlpPolicy"


def weights(training: Training) -> dict[str, torch.Tensor]:
    """Return every parameter of every policy."""
    return {
        f"{agent}.{name}": value.clone()
        for agent, learner in training.learners.items()
        for name, value in learner.model.policy.state_dict().items()
    }


def assert_same(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    """Require bit-identical parameters."""
    assert one.keys() == other.keys()
    assert [name for name in one if not torch.equal(one[name], other[name])] == []


@pytest.mark.slow
def test_ten_algorithms_in_one_run_are_reproducible(mixed_recipe: Recipe) -> None:
    """The same seed gives bit-identical weights, for on-policy, off-policy and evolutionary learners side by side."""
    first = train("copper_net", mixed_recipe, seed=4, horizon=10)
    names = {type(learner.model).__name__ for learner in first.learners.values()}
    assert names == {"PPO", *MIXED}
    again = train("copper_net", mixed_recipe, seed=4, horizon=10)
    assert_same(weights(first), weights(again))
    other = train("copper_net", mixed_recipe, seed=5, horizon=10)
    assert any(not torch.equal(value, weights(other)[name]) for name, value in weights(first).items())


def test_every_algorithm_learns_something(mixed_recipe: Recipe) -> None:
    """Training changes the weights of each learner, so none of them was starved or left out."""
    settings = {"seed": 0, "horizon": 10}
    before = train("copper_net", mixed_recipe, steps=1, **settings)  # type: ignore[arg-type]
    after = train("copper_net", mixed_recipe, steps=200, **settings)  # type: ignore[arg-type]
    start, end = weights(before), weights(after)
    for agent in after.env.agents:
        changed = [name for name in start if name.startswith(f"{agent}.") and not torch.equal(start[name], end[name])]
        assert changed, f"{agent} ({type(after.learners[agent].model).__name__}) did not change"


class Draws(BaseCallback):
    """A callback that draws from its own generator and evaluates in another environment."""

    def __init__(self) -> None:
        """Make the other environment."""
        super().__init__()
        self.env = MultiAgentVectorEnv("copper_net", num_envs=2, horizon=5)
        self.calls = 0

    def _on_step(self) -> bool:
        self.calls += 1
        self.env.reset(seed=0)
        assert self.model is not None
        self.model.predict(np.zeros((2, *self.training_env.observation_space.shape)), deterministic=True)  # type: ignore[misc]
        return True


def test_callbacks_and_evaluations_do_not_change_what_is_learnt(ppo_recipe: Recipe) -> None:
    """Weights are the same with a callback attached and with global draws between joint steps."""
    plain = train("copper_net", ppo_recipe, seed=1, horizon=10)
    callback = Draws()

    def report(_: object) -> None:
        np.random.rand(3)  # noqa: NPY002 (the legacy stream is the subject)
        torch.rand(3)

    watched = train("copper_net", ppo_recipe, seed=1, horizon=10, callbacks={"use": callback}, report=report)
    assert callback.calls == 40
    assert_same(weights(plain), weights(watched))


def two_chains() -> Network:
    """Two chains without a connection, one agent in each."""
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=2.0)
    nodes, arcs = [], []
    for name in ("a", "b"):
        nodes += [
            Node(id=f"{name}_from", initial=(5.0, 10.0), set_point=3.0),
            Node(id=f"{name}_to", initial=(0.0, 1.0)),
        ]
        arcs.append(
            Arc(
                id=name,
                donor=f"{name}_from",
                recipient=f"{name}_to",
                law=Law.DONOR,
                rate=0.3,
                control=valve,
                set_point=1.0,
            )
        )
    return Network(
        name="two_chains",
        nodes=tuple(nodes),
        arcs=tuple(arcs),
        episode=Episode(control_interval=0.5, horizon=10),
    )


class Alone(AgentVecEnv):
    """The seat of a lone agent that steps its environment itself."""

    def __init__(self, env: MultiAgentVectorEnv, seeds: list[int]) -> None:
        """Seat the only agent of ``env``."""
        self.joint = env
        super().__init__(env, env.agents[0], OneAgent(env, env.agents[0]))
        self.receive_reset(env.reset(seed=seeds), env.state)

    def step_wait(self) -> VecEnvStepReturn:
        """Step the environment."""
        assert self.action is not None
        observations, rewards, _terminations, truncations, infos = self.joint.step({self.name: self.action})
        seen = np.ascontiguousarray(observations[self.name])
        done = truncations[self.name]
        details: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        for copy in np.flatnonzero(done):
            final = infos[self.name]["final_obs"][copy].copy()
            details[copy] = {"TimeLimit.truncated": True, "terminal_observation": final}
        return seen, rewards[self.name].astype(np.float32), done, details


def test_lockstep_equals_plain_learning_where_agents_do_not_meet(ppo_recipe: Recipe) -> None:
    """On chains that are not connected, learning together gives the bits of plain ``PPO.learn()`` alone."""
    together = train(two_chains(), ppo_recipe, seed=3, reward="local")
    alone = train(two_chains(), ppo_recipe, seed=3, reward="local", agents=["a"])
    lone = {name: value for name, value in weights(together).items() if name.startswith("a.")}
    assert_same(lone, weights(alone))

    env = MultiAgentVectorEnv(two_chains(), num_envs=2, reward="local", agents=["a"])
    parameters = ppo_recipe.learner.parameters
    agent_env = Alone(env, [derived_seed(3, "copies", i) for i in range(2)])
    model = PPO("MlpPolicy", VecNormalize(agent_env, gamma=0.99), seed=derived_seed(3, "a"), device="cpu", **parameters)
    model.learn(80)
    assert_same(lone, {f"a.{name}": value for name, value in model.policy.state_dict().items()})


class CountsEnds(BaseCallback):
    """Counts how often it is told that training has ended."""

    ends = 0

    def _on_step(self) -> bool:
        return True

    def _on_training_end(self) -> None:
        self.ends += 1


def test_different_rollouts_and_shares_finish_cleanly(ppo_recipe: Recipe) -> None:
    """Learners with different ``n_steps`` and different budgets end without waiting for each other."""
    parameters = ppo_recipe.learner.parameters
    matches = [
        Match(agents=["mine"], algorithm="PPO", parameters=parameters | {"n_steps": 3, "batch_size": 6}),
        Match(agents=["use"], algorithm="A2C", parameters={"n_steps": 4}, share_of_steps=0.3),
        Match(agents=["sorting"], algorithm="ARS", parameters={"n_delta": 1}, share_of_steps=0.5),
    ]
    ends = {agent: CountsEnds() for agent in ("mine", "use", "sorting", "refinery")}
    training = train("copper_net", ppo_recipe.model_copy(update={"match": matches}), horizon=5, callbacks=ends)
    assert {agent: callback.ends for agent, callback in ends.items()} == dict.fromkeys(ends, 1)
    steps = {agent: learner.model.num_timesteps for agent, learner in training.learners.items()}
    assert steps["mine"] == 84  # 14 rollouts of 3 steps in 2 copies: the first count of at least 80
    assert steps["use"] == 24
    assert steps["refinery"] == 80
    assert training.joint_steps == 42


def test_who_has_learnt_enough_acts_without_exploring(ppo_recipe: Recipe, monkeypatch: pytest.MonkeyPatch) -> None:
    """Past its share a learner's actions are the mean of its policy; before, they are drawn."""
    match = Match(agents=["use"], algorithm="A2C", parameters={"n_steps": 4}, share_of_steps=0.5)
    seen, done = MultiAgentVectorEnv("copper_net", num_envs=2, horizon=20).reset(seed=0)["use"], []
    step = MultiAgentVectorEnv.step

    def recorded(env: MultiAgentVectorEnv, actions: Any) -> Any:
        nonlocal seen
        done.append((seen, actions["use"].copy()))
        result = step(env, actions)
        seen = result[0]["use"].copy()
        return result

    monkeypatch.setattr(MultiAgentVectorEnv, "step", recorded)
    training = train("copper_net", ppo_recipe.model_copy(update={"match": [match]}), horizon=20)
    model, normaliser = training.learners["use"].model, training.learners["use"].env
    assert model.num_timesteps == 40
    assert isinstance(normaliser, VecNormalize)
    means = [model.predict(normaliser.normalize_obs(shown), deterministic=True)[0] for shown, _ in done]
    same = [np.array_equal(mean, actions) for mean, (_, actions) in zip(means, done, strict=True)]
    assert same == [False] * 20 + [True] * 20


NAME: ContextVar[str] = ContextVar("NAME", default="nobody")


class Signs(BaseCallback):
    """A callback that may set a context variable, as libraries do, and notes what it reads at every step."""

    def __init__(self, name: str | None) -> None:
        """Take the value to set; None sets none."""
        super().__init__()
        self.name = name
        self.read: set[str] = set()

    def _on_training_start(self) -> None:
        if self.name is not None:
            NAME.set(self.name)

    def _on_step(self) -> bool:
        self.read.add(NAME.get())
        return True


def test_learners_have_contexts_of_their_own(ppo_recipe: Recipe) -> None:
    """Learners begin with the caller's context; what one sets in its own no other sees, nor who called."""
    callbacks = {"mine": Signs("mine"), "use": Signs("use"), "refinery": Signs(None)}
    token = NAME.set("caller")
    try:
        train("copper_net", ppo_recipe, callbacks=callbacks)
        assert NAME.get() == "caller"
    finally:
        NAME.reset(token)
    read = {name: callback.read for name, callback in callbacks.items()}
    assert read == {"mine": {"mine"}, "use": {"use"}, "refinery": {"caller"}}


class Explodes(BaseCallback):
    """A callback that fails at its tenth step."""

    def _on_step(self) -> bool:
        if self.n_calls == 10:
            raise RuntimeError("no more")
        return True


def test_failure_names_the_agent_and_keeps_what_was_learnt(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """The error names agent and step; the run says why it failed and its policies can be used."""
    with pytest.raises(LearnerError, match=r"agent 'use' failed at joint step 10.*no more"):
        train("copper_net", ppo_recipe, directory=tmp_path / "run", horizon=5, callbacks={"use": Explodes()})
    run = RunDirectory(tmp_path / "run")
    assert run.status["state"] == "failed"
    assert "agent 'use'" in run.status["reason"]
    env = run.make_env(2)
    controller = Trained(run)
    controller.start(env, 0)
    assert set(controller.act(env.reset(seed=0))) == set(env.agents)


@pytest.mark.sample(1)
@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_interruption_saves_and_resumption_finishes(
    which: int, tmp_path: Path, mixed_recipe: Recipe, ctrl_c_after: Any
) -> None:
    """Ctrl-C and requests to end save everything; the run goes on from there, and a finished run is not run again."""
    directory, before = tmp_path / "run", signal.getsignal(which)
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", mixed_recipe, directory=directory, horizon=5, report=ctrl_c_after(30, which))
    assert signal.getsignal(which) == before
    status = RunDirectory(directory).status
    assert status["state"] == "interrupted" and 15 <= status["joint_steps"] < 30
    assert not list(directory.rglob("*.partial*"))
    training = resume(directory)
    assert RunDirectory(directory).status["state"] == "complete"
    assert training.joint_steps >= 40
    assert training.learners["refinery"].model.num_timesteps >= 80
    rows = RunDirectory(directory).metrics()["joint_step"]
    assert rows == sorted(set(rows))
    assert rows[0] == 5
    with pytest.raises(RunError, match="complete"):
        resume(directory)


def test_torch_threads_and_streams_are_left_alone(ppo_recipe: Recipe) -> None:
    """Training leaves the caller's threads and random streams as they were."""
    torch.manual_seed(1)
    expected = torch.rand(2)
    torch.manual_seed(1)
    threads = torch.get_num_threads()
    train("copper_net", ppo_recipe, horizon=5)
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.rand(2), expected)


@pytest.mark.slow
def test_no_temporary_folders_are_left(
    tmp_path: Path, ppo_recipe: Recipe, mixed_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Left to itself, Stable-Baselines3 makes one for each model."""
    (scratch := tmp_path / "scratch").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(scratch))
    train("copper_net", mixed_recipe, horizon=5)
    train("copper_net", ppo_recipe, directory=tmp_path / "run", horizon=5)
    resume(tmp_path / "run", steps=1000)
    run_row(PaperRow(environment="CopperNet", algorithm="A2C", steps=100))
    assert list(scratch.iterdir()) == []


@pytest.mark.parametrize("options", [{"steps": 0}, {"steps": -5}, {"steps": 1.5}, {"envs": 0}, {"seed": -1}])
def test_budgets_are_whole_numbers(options: dict[str, Any], ppo_recipe: Recipe) -> None:
    """Zero, negative and fractional budgets are errors that name the option; none falls back on a default."""
    with pytest.raises(cirl_marl.CirlError, match=f"{next(iter(options))} must be a whole number"):
        train("copper_net", ppo_recipe, **options)


@pytest.mark.parametrize("algorithm", ["PPO", "SAC", "ARS"])
@pytest.mark.sample(1)
def test_schedules_run_from_their_first_value_to_their_last(algorithm: str) -> None:
    """Each algorithm ends with the learning rate that the recipe ends with, and learns for the steps asked for."""
    parameters = {
        "PPO": {"n_steps": 10, "batch_size": 20, "n_epochs": 1},
        "SAC": {"learning_starts": 10, "buffer_size": 200, "batch_size": 8},
        "ARS": {"n_delta": 2, "n_top": 1},
    }[algorithm]
    seen = []

    class Rates(BaseCallback):
        def _on_step(self) -> bool:
            return True

        def _on_rollout_end(self) -> None:
            seen.append(self.model.lr_schedule(self.model._current_progress_remaining))

    rate = {"linear_from": 1e-3, "linear_to": 1e-5}
    policy = "LinearPolicy" if algorithm == "ARS" else "MlpPolicy"
    learner = LearnerSettings(algorithm=algorithm, policy=policy, parameters={**parameters, "learning_rate": rate})
    recipe = Recipe(name="x", title="x", run=Run(steps=480, envs=2, evaluations=0), learner=learner)
    training = train("copper_net", recipe, agents=["use"], horizon=10, callbacks={"use": Rates()})
    assert training.joint_steps == 240
    assert seen == sorted(seen, reverse=True)
    assert seen[0] == pytest.approx(1e-3, rel=0.05)
    assert seen[-1] == pytest.approx(1e-5, abs=2e-4)
