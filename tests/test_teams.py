"""Independent learners in any PettingZoo environment: as if each were alone, whoever dies, comes back, or sees what."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from crowds import Shifts, Strangers
from gymnasium import spaces
from sb3_contrib import ARS, TRPO, MaskablePPO, RecurrentPPO
from stable_baselines3 import A2C, DQN, PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import DummyVecEnv, VecNormalize

import cirl_marl
from cirl_marl import CirlError, LearnerError, RecipeError, RunError
from cirl_marl.learners.interface import train
from cirl_marl.learners.learner import derived_seed
from cirl_marl.learners.recipe import Normalisation, load_recipe
from cirl_marl.learners.teams.team import Team
from cirl_marl.learners.trainer import one_torch_thread

SMALL: dict[str, Any] = {"n_steps": 16, "batch_size": 16, "n_epochs": 2}
PAIR = {"early": range(3), "whole": range(7)}
KINDS: dict[str, Any] = {
    "walker": ("CartPole-v1", PPO, {"n_steps": 20, "batch_size": 10, "n_epochs": 2}),
    "jumper": ("CartPole-v1", DQN, {"learning_starts": 20, "batch_size": 8, "train_freq": 3}),
    "swinger": ("Pendulum-v1", SAC, {"learning_starts": 20, "batch_size": 8}),
    "climber": ("MountainCarContinuous-v0", A2C, {"n_steps": 7}),
}


def weights(model: BaseAlgorithm) -> dict[str, torch.Tensor]:
    """Return the weights of a policy."""
    return dict(model.policy.state_dict())


def same(one: BaseAlgorithm, other: BaseAlgorithm) -> bool:
    """Whether two policies have the same bits."""
    theirs = weights(other)
    return all(torch.equal(value, theirs[name]) for name, value in weights(one).items())


def short(name: str) -> gymnasium.Env[Any, Any]:
    """Return an environment with episodes of at most 30 steps."""
    return gymnasium.make(name, max_episode_steps=30)


def strangers() -> Strangers:
    """Return four environments that have nothing to do with each other."""
    return Strangers({agent: partial(short, name) for agent, (name, _, _) in KINDS.items()})


class Keeps(BaseCallback):
    """Keeps the weights that act in each rollout."""

    def __init__(self) -> None:
        """Keep nothing yet."""
        super().__init__()
        self.kept: list[torch.Tensor] = []

    def _on_rollout_start(self) -> None:
        found = [value.flatten().double() for value in weights(self.model).values()]
        if not self.kept or not torch.equal(torch.cat(found), self.kept[-1]):
            self.kept.append(torch.cat(found))

    def _on_step(self) -> bool:
        return True


def alone(agent: str, copies: int, seed: int, steps: int, keeps: Keeps) -> BaseAlgorithm:
    """Return what plain ``learn()`` makes of one of them, with nobody around."""
    name, algorithm, parameters = KINDS[agent]
    env = DummyVecEnv([partial(short, name)] * copies)
    with one_torch_thread():
        model: BaseAlgorithm = algorithm("MlpPolicy", env, seed=derived_seed(seed, agent), device="cpu", **parameters)
        env._seeds = [derived_seed(seed, "copies", i) for i in range(copies)]
        return model.learn(steps, callback=keeps)


@pytest.mark.medium
def test_weights_are_those_of_learning_alone() -> None:
    """One copy: whoever is there, and however long others last, a learner's weights are those of ``learn()`` alone."""
    kinds = {each: partial(kind, **given) for each, (_, kind, given) in KINDS.items()}
    team = cirl_marl.independent(strangers, PPO, overrides=kinds, seed=5)
    kept = {agent: Keeps() for agent in team}
    team.learn(150, callbacks=kept)
    for agent in team:
        lone, made = Keeps(), team[agent].num_timesteps
        whole = alone(agent, 1, 5, made, lone)
        assert len(kept[agent].kept) > 5
        assert all(torch.equal(ours, theirs) for ours, theirs in zip(kept[agent].kept, lone.kept, strict=False)), agent
        if getattr(team.world.agent_envs[agent], "missed_steps"):  # noqa: B009 (poles fall while others go on)
            assert agent in ("walker", "jumper")
            assert made < 150
        else:
            assert same(team[agent], whole)


def test_copies_are_those_of_a_vector_environment() -> None:
    """Three copies in which nobody is ever absent: the weights of plain learning in a ``DummyVecEnv`` of three."""
    team = cirl_marl.independent(
        lambda: Strangers({"swinger": partial(short, "Pendulum-v1"), "climber": partial(short, "Pendulum-v1")}),
        partial(A2C, n_steps=7),
        num_envs=3,
        seed=2,
    )
    team.learn(210)
    env = DummyVecEnv([partial(short, "Pendulum-v1")] * 3)
    with one_torch_thread():
        model = A2C("MlpPolicy", env, seed=derived_seed(2, "climber"), device="cpu", n_steps=7)
        env._seeds = [derived_seed(2, "copies", i) for i in range(3)]
        model.learn(210)
    assert same(team["climber"], model)
    assert type(team["climber"].rollout_buffer).__module__.startswith("stable_baselines3")  # type: ignore[attr-defined]


@pytest.mark.medium
def test_a_network_is_one_of_them() -> None:
    """On a network, a team learns what ``train`` does: batched or copy by copy, the same bits."""
    recipe = load_recipe("independent_ppo")
    parameters: dict[str, Any] = {"n_steps": 8, "batch_size": 16, "n_epochs": 2}
    plain_learner = {"parameters": parameters, "bootstrap": True, "normalise": Normalisation()}
    spec = recipe.learner.model_copy(update=plain_learner)
    run = recipe.run.model_copy(
        update={"envs": 2, "evaluations": 0, "engine": "lockstep", "min_service": None, "price_rate": 0.0}
    )
    plain = recipe.model_copy(update={"learner": spec, "run": run, "environment": {}})
    options: dict[str, Any] = {"horizon": 5, "reward": "local"}
    ours = train("copper_net", plain, steps=40, seed=1, **options)
    team = cirl_marl.independent(
        lambda: cirl_marl.parallel_env("copper_net", **options),
        partial(PPO, **parameters),
        num_envs=2,
        seed=1,
        normalise=True,
    )
    team.learn(40)
    assert set(team) == set(ours.learners)
    assert all(same(team[agent], learner.model) for agent, learner in ours.learners.items())


class Watches(BaseCallback):
    """Keeps what is learnt from in each update: observations of rollouts, of all minibatches."""

    def __init__(self) -> None:
        """Keep nothing yet."""
        super().__init__()
        self.learnt: list[list[tuple[float, ...]]] = []

    def _on_rollout_end(self) -> None:
        buffer = self.model.rollout_buffer  # type: ignore[attr-defined]
        self.learnt.append([tuple(row.tolist()) for batch in buffer.get(5) for row in batch.observations])

    def _on_step(self) -> bool:
        return True


@pytest.mark.parametrize(
    "algorithm", [partial(PPO, **SMALL), partial(A2C, n_steps=6), partial(TRPO, n_steps=16, batch_size=16)]
)
@pytest.mark.sample(1)
def test_absent_rows_are_not_learnt(algorithm: Any) -> None:
    """Every step in which the agent acted is in one minibatch, and nothing else is."""
    log: list[tuple[Any, ...]] = []
    shifts = {"early": [0, 1, 4], "late": [2, 5], "whole": range(7)}
    lengths = iter([7, 5, 6])
    team = cirl_marl.independent(lambda: Shifts(shifts, next(lengths), log=log), algorithm, num_envs=3)
    watches = {agent: Watches() for agent in team}
    team.learn(400, callbacks=watches)
    for agent in team:
        learnt = [row for update in watches[agent].learnt for row in update]
        assert len(set(learnt)) == len(learnt)
        assert all(row[3] == 0 for row in learnt)
        acted = {
            (float(serial), float(episode), float(step), 0.0) for who, serial, episode, step, _ in log if who == agent
        }
        assert set(learnt) <= acted
        assert len(learnt) > 0.7 * len(acted)  # but for the last rollout, which is not over
    early = team.world.agent_envs["early"]
    assert early.absent == (not getattr(early, "present").any())  # noqa: B009


@pytest.mark.parametrize("copies", [1, 3])
def test_replay_buffers_hold_steps_that_were_made(copies: int) -> None:
    """What a row holds is what the agent did, saw next and was paid; where its shift ends, the episode does."""
    log: list[tuple[Any, ...]] = []
    shifts = {"early": [0, 1, 4], "whole": range(7)}
    lengths = iter([7, 5, 6])
    dqn = partial(DQN, learning_starts=10**6, buffer_size=300, train_freq=1)
    team = cirl_marl.independent(lambda: Shifts(shifts, next(lengths), log=log), dqn, num_envs=copies)
    team.learn(90)
    for agent in team:
        buffer = team[agent].replay_buffer  # type: ignore[attr-defined]
        made = {
            (float(serial), float(episode), float(step)): action
            for who, serial, episode, step, action in log
            if who == agent
        }
        used = (slice(None, buffer.pos), slice(None))
        rows = zip(
            buffer.observations[used].reshape(-1, 4).tolist(),
            buffer.next_observations[used].reshape(-1, 4).tolist(),
            buffer.actions[used].ravel(),
            buffer.rewards[used].ravel(),
            buffer.dones[used].ravel(),
            buffer.timeouts[used].ravel(),
            strict=True,
        )
        found = set()
        for seen, following, action, reward, done, timeout in rows:
            assert made[tuple(seen[:3])] == action
            assert reward == seen[2]
            assert following[:2] == seen[:2] and following[2] > seen[2]
            assert done == following[3]
            assert not timeout or done
            found.add(tuple(seen[:3]))
        assert len(found) >= len(made) - copies


def test_normalisers_do_not_know_absent_rows() -> None:
    """Moments are those of what the agent saw when it was there."""
    seen: list[np.ndarray] = []

    class Tells(Shifts):
        """Notes what the early one is shown in order to act."""

        def reset(self, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, Any]:
            found = super().reset(seed, options)
            seen.extend(found[0][agent] for agent in self.agents if agent == "early")
            return found

        def step(self, actions: dict[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
            found = super().step(actions)
            seen.extend(found[0][agent] for agent in self.agents if agent == "early")
            return found

    lengths = iter([7, 5, 6])
    team = cirl_marl.independent(
        lambda: Tells({"early": [0, 1, 4], "whole": range(7)}, next(lengths)),
        partial(A2C, n_steps=4),
        num_envs=3,
        normalise=True,
    )
    team.learn(120)
    env = team.learners["early"].env
    assert isinstance(env, VecNormalize)
    rows = np.array(seen)
    moments = env.obs_rms
    assert isinstance(moments, RunningMeanStd)
    assert moments.count == pytest.approx(len(rows), abs=3.1)
    assert np.allclose(moments.mean[2], rows[:, 2].mean(), atol=0.05)


def test_who_learns_from_sequences_needs_one_copy() -> None:
    """Recurrent policies and ARS say so when somebody is absent in some copies; in one they learn."""
    thrifty = {"optimize_memory_usage": True, "replay_buffer_kwargs": {"handle_timeout_termination": False}}
    thrifty_dqn: Any = partial(DQN, buffer_size=100, **thrifty)  # type: ignore[arg-type]
    kinds: tuple[Any, ...] = (partial(RecurrentPPO, n_steps=8, batch_size=8), ARS, thrifty_dqn)
    for kind in kinds:
        lengths = iter([7, 5, 7])
        team = cirl_marl.independent(lambda: Shifts(PAIR, next(lengths)), kind, num_envs=2)  # noqa: B023
        with pytest.raises(LearnerError, match=r"agent 'early': is absent in some copies .* use num_envs=1"):
            team.learn(40)
        cirl_marl.independent(lambda: Shifts(PAIR, 7), kind).learn(20)


def test_who_comes_late_or_never_does_not_hold_up_the_others() -> None:
    """Joint steps are as many as were asked for; one that never comes has learnt nothing."""
    shifts = {"never": [], "late": [5], "whole": range(7)}
    team = cirl_marl.independent(lambda: Shifts(shifts, 7), partial(PPO, **SMALL))
    before = weights(team["never"])["value_net.bias"].clone()
    team.learn(64)
    assert [team[agent].num_timesteps for agent in shifts] == [0, 8, 64]  # its last step waits for its next shift
    assert torch.equal(before, weights(team["never"])["value_net.bias"])
    team.learn(32)
    assert team["whole"].num_timesteps == 96
    assert team.world.joint_steps == 96
    assert team.evaluate(3)["never"].tolist() == [0, 0, 0]


def test_evaluation_pays_what_the_environment_pays() -> None:
    """Episodes of different length, and one who is paid in its shift only, each by hand."""
    lengths = iter([7, 5, 7, 5] * 3)
    team = cirl_marl.independent(lambda: Shifts(PAIR, next(lengths)), partial(PPO, **SMALL), num_envs=2)
    paid = team.evaluate(5)
    assert paid["early"].tolist() == [0 + 1 + 2] * 5
    assert paid["whole"].tolist() == [21, 10, 21, 10, 21]


def test_evaluation_begins_every_episode_without_memory() -> None:
    """A recurrent policy that always sees the same does the same in every episode."""
    log: list[tuple[Any, ...]] = []
    plain: dict[str, Any] = {"seen": spaces.Discrete(1), "does": spaces.Box(-2, 5, (2,)), "log": log}
    team = cirl_marl.independent(lambda: Shifts(PAIR, 7, **plain), partial(RecurrentPPO, n_steps=8, batch_size=8))
    team.evaluate(2)
    for agent, steps in PAIR.items():
        done = [action for who, *_, action in log if who == agent]
        first, second = np.array(done[: len(steps)]), np.array(done[len(steps) :])
        assert np.array_equal(first, second)
        assert not np.array_equal(first[0], first[1])


SEEN: dict[str, tuple[spaces.Space[Any], str]] = {
    "box": (spaces.Box(-1, 1, (2, 3)), "ActorCriticPolicy"),
    "discrete": (spaces.Discrete(4), "ActorCriticPolicy"),
    "several": (spaces.MultiDiscrete([2, 3]), "ActorCriticPolicy"),
    "binary": (spaces.MultiBinary(3), "ActorCriticPolicy"),
    "dict": (spaces.Dict({"a": spaces.Box(-1, 1, (2,)), "b": spaces.Discrete(3)}), "MultiInputActorCriticPolicy"),
    "image": (spaces.Box(0, 255, (36, 36, 3), dtype=np.uint8), "ActorCriticCnnPolicy"),
}
DOES: tuple[spaces.Space[Any], ...] = (
    spaces.Discrete(3),
    spaces.MultiDiscrete([2, 3]),
    spaces.MultiBinary(2),
    spaces.Box(-2, 5, (2,)),
)


@pytest.mark.parametrize("seen", SEEN)
def test_every_space_is_learnt_in(seen: str) -> None:
    """Observations and actions of every kind that Stable-Baselines3 knows, with agents that are absent."""
    space, policy = SEEN[seen]
    for place, does in enumerate(DOES if seen == "dict" else DOES[:1]):
        lengths = iter([7, 5] * 2)
        team = cirl_marl.independent(
            lambda: Shifts(PAIR, next(lengths), seen=space, does=does),  # noqa: B023
            partial(PPO, n_steps=8, batch_size=8, n_epochs=1),
            num_envs=2,
            seed=place,
        )
        before = torch.cat([value.flatten() for value in weights(team["early"]).values()])
        team.learn(40)
        after = torch.cat([value.flatten() for value in weights(team["early"]).values()])
        assert not torch.equal(before, after)
        assert type(team["early"].policy).__name__ == policy or isinstance(
            team["early"].policy, type(team["whole"].policy)
        )
        assert team.evaluate(2)["early"].tolist() == [3, 3]


def test_masks_are_heeded() -> None:
    """``MaskablePPO`` does what is legal only, in learning, acting and evaluating; others may do anything."""

    class Forbids(Shifts):
        """Only one action is legal, another at each step."""

        def _observe(self, last: int) -> Any:
            legal = np.arange(3) == self._step % 3
            return {"observation": super()._observe(last), "action_mask": legal.astype(np.int8)}

        def observation_space(self, agent: str) -> spaces.Space[Any]:
            return spaces.Dict({"observation": super().observation_space(agent), "action_mask": spaces.MultiBinary(3)})

    log: list[tuple[Any, ...]] = []
    lengths = iter([7, 5] * 2)
    kinds: dict[str, Any] = {
        "early": partial(MaskablePPO, n_steps=8, batch_size=8),
        "whole": partial(PPO, n_steps=8, batch_size=8),
    }
    team = cirl_marl.independent(lambda: Forbids(PAIR, next(lengths), log=log), PPO, overrides=kinds, num_envs=2)
    team.learn(60)
    team.evaluate(2, deterministic=False)
    assert all(action == step % 3 for who, _, _, step, action in log if who == "early")
    assert not all(action == step % 3 for who, _, _, step, action in log if who == "whole")


def test_a_team_is_kept_and_goes_on(tmp_path: Path) -> None:
    """What was saved acts as before, learns on, and holds no code; a model by itself is a plain one."""
    kinds: dict[str, Any] = {"early": partial(DQN, learning_starts=10, batch_size=8), "whole": partial(PPO, **SMALL)}

    def make() -> Shifts:
        return Shifts(PAIR, 7)

    team = cirl_marl.independent(make, A2C, overrides=kinds, num_envs=2, normalise=True)
    team.learn(64)
    team.save(tmp_path / "kept")
    assert {path.suffix for path in (tmp_path / "kept").iterdir()} == {".json", ".safetensors"}
    again = Team.load(tmp_path / "kept", make)
    assert again["early"].num_timesteps == team["early"].num_timesteps
    assert all(same(team[agent], again[agent]) for agent in team)
    assert all(np.array_equal(team.evaluate(3)[agent], paid) for agent, paid in again.evaluate(3).items())
    again.learn(64)
    assert not same(team["whole"], again["whole"])
    with pytest.raises(RunError, match="is there already"):
        team.save(tmp_path / "kept")
    with pytest.raises(RunError, match=r"of the agents \['early', 'whole'\], the environment has \['other'\]"):
        Team.load(tmp_path / "kept", lambda: Shifts({"other": range(3)}, 3))
    (tmp_path / "kept" / "early.state.safetensors").write_bytes(b"\x80\x04.")
    with pytest.raises(RunError, match=r"early\.state\.safetensors"):
        Team.load(tmp_path / "kept", make)
    with pytest.raises(RunError, match=r"team.*cannot be read"):
        Team.load(tmp_path / "nothing", make)


@pytest.mark.slow
def test_a_model_by_itself_needs_nothing_of_ours(tmp_path: Path) -> None:
    """Even of an agent that was absent at times, ``save`` writes what Stable-Baselines3 alone reads."""
    lengths = iter([7, 5])
    kinds = {"early": partial(DQN, learning_starts=10, batch_size=8)}
    team = cirl_marl.independent(
        lambda: Shifts(PAIR, next(lengths)), partial(PPO, **SMALL), overrides=kinds, num_envs=2
    )
    team.learn(64)
    team["early"].save(tmp_path / "early")
    team["whole"].save(tmp_path / "whole")
    program = f"""
import sys, numpy
sys.modules["cirl_marl"] = None
from stable_baselines3 import DQN, PPO
for kind, name in ((DQN, "early"), (PPO, "whole")):
    print(kind.load({str(tmp_path)!r} + "/" + name).predict(numpy.zeros(4, dtype=numpy.float32))[0])
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert len(done.stdout.split()) == 2


def test_curves_and_callbacks_are_of_each(tmp_path: Path) -> None:
    """Learning curves stand below the folder, one for each agent; a callback is of one agent."""
    team = cirl_marl.independent(lambda: Shifts(PAIR, 7), partial(PPO, **SMALL), tensorboard_log=tmp_path)
    team.learn(40, progress_bar=True)
    assert all(list((tmp_path / agent).glob("events.*")) for agent in PAIR)
    with pytest.raises(CirlError, match=r"callbacks: .*'erly'.*early"):
        team.learn(10, callbacks={"erly": Keeps()})


def test_without_tensorboard_who_asks_for_curves_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is an extra: what to install is said before anything is learnt."""
    monkeypatch.setitem(sys.modules, "tensorboard", None)
    monkeypatch.setattr("cirl_marl.learners.learner.find_spec", lambda name: None)
    with pytest.raises(
        CirlError, match=r"tensorboard_log='.*' needs TensorBoard: pip install 'cirl-marl\[tensorboard\]'"
    ):
        cirl_marl.independent(lambda: Shifts(PAIR, 7), partial(PPO, **SMALL), tensorboard_log=tmp_path / "curves")
    assert not (tmp_path / "curves").exists()


class Breaks(Shifts):
    """Tells something else than it promised, after two steps."""

    def __init__(self, how: str) -> None:
        """Break the promise that ``how`` names."""
        super().__init__(PAIR, 7)
        self.how = how

    def step(self, actions: dict[str, Any]) -> tuple[Any, Any, Any, Any, Any]:
        """Break the promise."""
        seen, rewards, gone, cut, infos = super().step(actions)
        if self._step == 2:
            match self.how:
                case "stranger":
                    self.agents.append("erly")
                case "silent":
                    del rewards["early"]
                case "blind":
                    del seen["whole"]
                case "shape":
                    seen["whole"] = np.zeros(5)
                case "undead":
                    gone["early"] = True
        return seen, rewards, gone, cut, infos


@pytest.mark.parametrize(
    ("how", "said"),
    [
        ("stranger", r"copy 0 of the environment: possible_agents: .*'erly'.*'early'"),
        ("silent", r"copy 0 of the environment: agent 'early': acted, but step\(\) tells nothing of it"),
        ("blind", r"agent 'whole': is in env.agents, but there is no observation for it"),
        ("shape", r"agent 'whole': its observation has the shape \(5,\), not that of Box"),
        ("undead", r"agent 'early': its episode has ended, and it is still in env.agents"),
    ],
)
def test_environments_that_break_their_promise(how: str, said: str) -> None:
    """The copy, the agent and what is wrong are named."""
    with pytest.raises(LearnerError, match=said):
        cirl_marl.independent(lambda: Breaks(how), partial(PPO, **SMALL)).learn(32)


def bad_teams() -> Iterator[tuple[Any, type[Exception], str]]:
    """Yield what cannot be made, the error and what it says."""
    make = partial(Shifts, PAIR, 7)
    misspelt: dict[str, Any] = {"n_step": 8}
    yield lambda: cirl_marl.independent(make, PPO, overrides={"erly*": A2C}), CirlError, r"overrides: .*'erly\*'"
    yield lambda: cirl_marl.independent(make, SAC), RecipeError, r"agent 'early': SAC .* Discrete\(3\)"
    yield lambda: cirl_marl.independent(make, partial(PPO, **misspelt)), RecipeError, r"'n_step'.*n_steps"
    yield lambda: cirl_marl.independent(make, partial(PPO, seed=8)), RecipeError, r"PPO: seed: the team sees to that"
    yield lambda: cirl_marl.independent(make, partial(PPO, "NoPolicy")), RecipeError, r"agent 'early': .*NoPolicy"
    yield lambda: cirl_marl.independent(make, dict), RecipeError, r"agent 'early': .*'dict'"  # type: ignore[arg-type]
    yield lambda: cirl_marl.independent(make, PPO, num_envs=0), CirlError, r"num_envs must be"
    yield lambda: cirl_marl.independent(make, PPO, seed=-1), CirlError, r"seed must be"
    yield lambda: cirl_marl.independent(make, PPO).evaluate(seed=True), CirlError, r"seed must be"
    yield lambda: cirl_marl.independent(lambda: short("CartPole-v1"), PPO), CirlError, r"PettingZoo ParallelEnv"
    yield lambda: cirl_marl.independent(lambda: Shifts({}, 7), PPO), CirlError, r"has no possible_agents"
    nested = spaces.Dict({"a": spaces.Dict({"b": spaces.Discrete(2)})})
    yield lambda: cirl_marl.independent(lambda: Shifts(PAIR, 7, seen=nested), PPO), CirlError, r"agent 'early'.*Dict"
    yield lambda: cirl_marl.independent(make, PPO)["erly"], CirlError, r"'erly'.*'early'"
    yield (
        lambda: cirl_marl.independent(make, PPO).learn(0),
        CirlError,
        r"total_timesteps .* at least 1",
    )


@pytest.mark.parametrize(("make", "kind", "said"), [*bad_teams()])
def test_bad_input(make: Any, kind: type[Exception], said: str) -> None:
    """What cannot be used is named before anybody learns."""
    with pytest.raises(kind, match=said):
        make()


@pytest.mark.medium
@pytest.mark.parametrize("name", ["spread", "tag", "zombies", "turns"])
def test_known_environments(name: str) -> None:
    """MPE with discrete and continuous actions, archers and knights who die, and a game of turns with masks."""
    team = known(name)
    team.learn(60)
    assert all(np.isfinite(paid).all() for paid in team.evaluate(2).values())
    assert max(team[agent].num_timesteps for agent in team) >= 60


def known(name: str) -> Team:
    """Return a team in an environment of the MPE2 and PettingZoo packages."""
    from mpe2 import simple_spread_v3, simple_tag_v3
    from pettingzoo.butterfly.knights_archers_zombies import knights_archers_zombies
    from pettingzoo.classic.tictactoe import tictactoe

    ppo, dqn = partial(PPO, **SMALL), partial(DQN, learning_starts=20, buffer_size=200, batch_size=8)
    if name == "spread":
        return cirl_marl.independent(lambda: simple_spread_v3.env(max_cycles=10), ppo, num_envs=2)
    if name == "tag":
        sac = partial(SAC, learning_starts=20, buffer_size=200, batch_size=8)
        tag = partial(simple_tag_v3.parallel_env, max_cycles=10, continuous_actions=True)
        return cirl_marl.independent(tag, ppo, overrides={"adversary_*": sac}, num_envs=2)
    if name == "zombies":
        zombies = partial(knights_archers_zombies.parallel_env, max_cycles=60)
        return cirl_marl.independent(zombies, ppo, overrides={"archer_*": dqn}, num_envs=2)
    return cirl_marl.independent(tictactoe.env, partial(MaskablePPO, **SMALL))
