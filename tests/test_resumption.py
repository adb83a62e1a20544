"""Runs that fail or are stopped: what is kept of them, and how they go on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import NStepReplayBuffer
from stable_baselines3.common.callbacks import BaseCallback

from cirl_marl import CirlError, LearnerError, RecipeError, RunError
from cirl_marl.learners import Progress, Recipe, RunDirectory, resume, train
from cirl_marl.learners.learner import load_model
from cirl_marl.learners.recipe import Demonstrations, LearnerSettings, Run

pytestmark = pytest.mark.medium


class FailsAt(BaseCallback):
    """Fails at a step of its learner."""

    def __init__(self, step: int) -> None:
        """Fail at ``step``."""
        super().__init__()
        self.step = step

    def _on_step(self) -> bool:
        if self.n_calls == self.step:
            raise ValueError("no more")
        return True


def test_a_failed_learner_does_not_take_the_good_checkpoint_with_it(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """What was saved before goes on to count, the run can be resumed from it, and the step is that of the run."""
    directory = tmp_path / "run"
    with pytest.raises(LearnerError, match="failed at joint step 30"):
        train(
            "copper_net",
            ppo_recipe,
            agents=["mine", "use"],
            directory=directory,
            horizon=5,
            callbacks={"use": FailsAt(30)},
        )
    run = RunDirectory(directory)
    assert run.status == {"state": "failed", "joint_steps": 28, "checkpoint": "000000028-running", "best": None} | {
        "reason": run.status["reason"]
    }
    assert sorted(path.name for path in (directory / "checkpoints").iterdir()) == [
        "000000028-running",
        "000000030-failed",
    ]
    assert resume(directory).joint_steps >= 40
    assert RunDirectory(directory).status["state"] == "complete"


def test_resumed_exploration_is_fresh(tmp_path: Path, ctrl_c_after: Any) -> None:
    """Before it learns, SAC draws its actions; after a resumption it does not draw the same ones again."""
    learner = LearnerSettings(algorithm="SAC", parameters={"learning_starts": 100, "buffer_size": 100})
    recipe = Recipe(name="x", title="x", run=Run(steps=40, envs=1, engine="lockstep", evaluations=0), learner=learner)
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["use"], directory=tmp_path, report=ctrl_c_after(20))
    model = resume(tmp_path).learners["use"].model
    drawn = model.replay_buffer.actions[:40, 0, 0]  # type: ignore[attr-defined]
    assert len(np.unique(drawn)) == 40


def test_returns_of_several_steps_end_where_a_run_was_stopped(tmp_path: Path, ctrl_c_after: Any) -> None:
    """19 transitions were kept; the next begins an episode, so that no return goes on into it."""
    parameters = {"learning_starts": 100, "buffer_size": 100, "n_steps": 3}
    recipe = Recipe(
        name="x",
        title="x",
        run=Run(steps=40, envs=1, engine="lockstep", evaluations=0),
        learner=LearnerSettings(algorithm="SAC", parameters=parameters),
    )
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["use"], directory=tmp_path, report=ctrl_c_after(20))
    model = resume(tmp_path).learners["use"].model
    assert isinstance(model, SAC)
    assert isinstance(model.replay_buffer, NStepReplayBuffer)
    assert model.replay_buffer.pos == 40
    for row, last in ((10, 12), (16, 18), (17, 18), (18, 18), (19, 21)):
        sample = model.replay_buffer._get_samples(np.array([row]))
        np.testing.assert_array_equal(sample.next_observations[0], model.replay_buffer.next_observations[last, 0])
        assert sample.discounts is not None
        assert sample.discounts.item() == pytest.approx(0.99 ** (last - row + 1))
        assert sample.dones.item() == 0.0


def test_a_run_that_goes_on_says_so(tmp_path: Path, ppo_recipe: Recipe, ctrl_c_after: Any) -> None:
    """What is not saved yet is not called saved: the state is that of a running training from the first step."""
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", ppo_recipe, agents=["mine", "use"], directory=tmp_path, report=ctrl_c_after(70))
    seen: list[tuple[str, int, int, int]] = []

    def watch(now: Progress) -> None:
        status = RunDirectory(tmp_path).status
        seen.append((status["state"], status["joint_steps"], now.env_steps, now.total))

    resume(tmp_path, report=watch)
    assert seen[0] == ("running", 35, 2, 10)
    assert seen[-1] == ("running", 44, 20, 20)  # the rollout that was interrupted is begun anew
    assert all(done <= total for _, _, done, total in seen)


def test_misspelt_callbacks_leave_nothing_behind(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """The check comes before the run directory, so that the same call can be made again."""
    with pytest.raises(CirlError, match="Did you mean 'mine'"):
        train("copper_net", ppo_recipe, directory=tmp_path / "run", callbacks={"mime": None})  # type: ignore[dict-item]
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"nothing")])
def test_lost_experience_is_an_error(damage: Callable[[Path], None], tmp_path: Path, ctrl_c_after: Any) -> None:
    """A replay buffer that is gone, or no longer one, is named instead of begun anew."""
    learner = LearnerSettings(algorithm="SAC", parameters={"learning_starts": 100, "buffer_size": 100})
    recipe = Recipe(name="x", title="x", run=Run(steps=40, envs=1, engine="lockstep", evaluations=0), learner=learner)
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["use"], directory=tmp_path, report=ctrl_c_after(20))
    damage(RunDirectory(tmp_path).checkpoint / "use.replay.pkl.gz")
    with pytest.raises(RunError, match=r"use\.replay\.pkl\.gz: cannot be read"):
        resume(tmp_path)


def test_room_in_a_replay_buffer_costs_little(tmp_path: Path, ctrl_c_after: Any) -> None:
    """A checkpoint is not as large as the buffer may become, but as what is in it."""
    learner = LearnerSettings(algorithm="SAC", parameters={"learning_starts": 100, "buffer_size": 1_000_000})
    recipe = Recipe(name="x", title="x", run=Run(steps=40, envs=1, engine="lockstep", evaluations=0), learner=learner)
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["use"], directory=tmp_path, report=ctrl_c_after(20))
    saved = RunDirectory(tmp_path).checkpoint / "use.replay.pkl.gz"
    assert saved.stat().st_size < 1e6


def test_a_complete_run_goes_on_to_more_steps(tmp_path: Path, ppo_recipe: Recipe, ctrl_c_after: Any) -> None:
    """It learns on from where it was, by the schedule of a run of so many steps, and can be interrupted again."""
    with_schedule = ppo_recipe.learner.parameters | {"learning_rate": {"linear_from": 1e-2, "linear_to": 0.0}}
    learner = ppo_recipe.learner.model_copy(update={"parameters": with_schedule})
    recipe = ppo_recipe.model_copy(update={"learner": learner})
    train("copper_net", recipe, agents=["mine", "use"], directory=tmp_path, horizon=5)
    run = RunDirectory(tmp_path)
    before = run.metrics()
    with pytest.raises(KeyboardInterrupt):
        resume(tmp_path, steps=160, report=ctrl_c_after(50))
    policy = load_model(run.checkpoint, "mine", "PPO").policy
    assert policy.optimizer.param_groups[0]["lr"] == pytest.approx(1e-2 * (1 - 120 / 160))
    model = resume(tmp_path).learners["mine"].model
    assert (run.status["state"], run.status["joint_steps"], run.config.steps) == ("complete", 85, 160)
    assert model.num_timesteps == 160  # the rollout that was interrupted is begun anew
    after = run.metrics()
    assert after["joint_step"][: len(before["joint_step"])] == before["joint_step"]
    assert after["joint_step"][-1] == 85
    for steps in (None, 160, 170):
        with pytest.raises(CirlError, match=r"complete \(170 environment steps\)|at least 171"):
            resume(tmp_path, steps=steps)
    assert run.config.steps == 160


def test_what_needs_its_past_does_not_go_on_without(tmp_path: Path) -> None:
    """A complete run has no replay buffers; it says so, and stays what it was."""
    learner = LearnerSettings(algorithm="SAC", parameters={"learning_starts": 100, "buffer_size": 100})
    recipe = Recipe(name="x", title="x", run=Run(steps=20, envs=1, engine="lockstep", evaluations=0), learner=learner)
    train("copper_net", recipe, agents=["use"], directory=tmp_path)
    with pytest.raises(RunError, match=r"keep no replay buffers, without which \['use'\] cannot go on"):
        resume(tmp_path, steps=40)
    assert (RunDirectory(tmp_path).status["state"], RunDirectory(tmp_path).config.steps) == ("complete", 20)


def test_an_interrupted_rollout_is_begun_anew(tmp_path: Path, ppo_recipe: Recipe, ctrl_c_after: Any) -> None:
    """Steps whose rollout was lost do not count as learnt, however often the run is interrupted."""
    parameters = ppo_recipe.learner.parameters | {"n_steps": 40}
    learner = ppo_recipe.learner.model_copy(update={"parameters": parameters})
    recipe = ppo_recipe.model_copy(
        update={"learner": learner, "run": Run(steps=160, envs=2, engine="lockstep", evaluations=0)}
    )
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["mine", "use"], directory=tmp_path, report=ctrl_c_after(100))
    for _ in range(3):
        with pytest.raises(KeyboardInterrupt):
            resume(tmp_path, report=ctrl_c_after(60))
    for each in resume(tmp_path).learners.values():
        assert each.model.num_timesteps == 160
        assert each.model._n_updates == 2 * 2  # rollouts and epochs
    assert RunDirectory(tmp_path).status["joint_steps"] == 50 + 3 * 30 + 40


def test_a_run_is_trained_by_one_at_a_time(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """Neither do two trainings share a directory, nor the random streams of a process."""
    train("copper_net", ppo_recipe, agents=["mine", "use"], directory=tmp_path)
    with RunDirectory(tmp_path).claimed(), pytest.raises(RunError, match="is being trained by another process"):
        resume(tmp_path, steps=160)
    refused = []

    def nested(_: Progress) -> None:
        with pytest.raises(CirlError, match="another training is under way in this process"):
            train("copper_net", ppo_recipe)
        refused.append(True)

    resume(tmp_path, steps=160, report=nested)
    assert len(refused) == 40


def test_demonstrations_have_room_in_a_run_that_goes_on(tmp_path: Path, ctrl_c_after: Any) -> None:
    """A run is not cut so short that nobody would learn from what is shown."""
    shown = Demonstrations(controller="neutral", steps=60)
    learner = LearnerSettings(algorithm="SAC", parameters={"buffer_size": 100}, demonstrations=shown)
    recipe = Recipe(name="x", title="x", run=Run(steps=100, envs=1, engine="lockstep", evaluations=0), learner=learner)
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["use"], directory=tmp_path, report=ctrl_c_after(20))
    with pytest.raises(RecipeError, match="60 is more than the 30 steps"):
        resume(tmp_path, steps=30)
    assert RunDirectory(tmp_path).config.steps == 100


def test_the_experience_of_another_learner_is_refused(tmp_path: Path, ctrl_c_after: Any) -> None:
    """Replay buffers that were mixed up are found out before anybody learns from them."""
    learner = LearnerSettings(algorithm="SAC", parameters={"learning_starts": 100, "buffer_size": 100})
    for name, observe in (("a", "local"), ("b", "full")):
        options: dict[str, Any] = {"observe": observe}
        recipe = Recipe(
            name="x",
            title="x",
            run=Run(steps=40, envs=1, engine="lockstep", evaluations=0),
            environment=options,
            learner=learner,
        )
        with pytest.raises(KeyboardInterrupt):
            train("copper_net", recipe, agents=["use"], directory=tmp_path / name, report=ctrl_c_after(20))
    kept = [RunDirectory(tmp_path / name).checkpoint / "use.replay.pkl.gz" for name in "ab"]
    kept[0].replace(kept[1])
    with pytest.raises(RunError, match=r"use\.replay\.pkl\.gz: holds what another learner saw"):
        resume(tmp_path / "b")


@pytest.mark.parametrize("algorithm", ["TD3", "SAC"])
def test_a_policy_that_breaks_is_a_failure(algorithm: str, tmp_path: Path) -> None:
    """Learners whose weights overflow end the run as failed, with a reason of one line."""
    parameters = {"learning_starts": 2, "buffer_size": 100, "batch_size": 4, "learning_rate": 1e30}
    recipe = Recipe(
        name="x",
        title="x",
        run=Run(steps=40, envs=1, engine="lockstep", evaluations=0),
        learner=LearnerSettings(algorithm=algorithm, parameters=parameters),
    )
    with pytest.raises(LearnerError, match="failed at joint step"):
        train("copper_net", recipe, agents=["use"], directory=tmp_path)
    status = RunDirectory(tmp_path).status
    assert status["state"] == "failed"
    assert "failed at joint step" in status["reason"]
    assert "\n" not in status["reason"]


def test_what_cannot_be_kept_is_refused_before_anything_is_written(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """Recipes of Python objects train in memory; a directory needs plain values."""
    parameters = ppo_recipe.learner.parameters | {"learning_rate": lambda left: 1e-3 * left}
    recipe = ppo_recipe.model_copy(update={"learner": LearnerSettings(algorithm="PPO", parameters=parameters)})
    with pytest.raises(RunError, match="needs a recipe of plain values"):
        train("copper_net", recipe, directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert train("copper_net", recipe).joint_steps == 40
    train("copper_net", ppo_recipe, agents=["mine"], directory=tmp_path / "run", horizon=np.int64(5))
    assert RunDirectory(tmp_path / "run").config.options["horizon"] == 5


def test_the_clock_goes_on(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """Training times of a run that went on add up."""
    train("copper_net", ppo_recipe, agents=["mine", "use"], directory=tmp_path, horizon=5)
    resume(tmp_path, steps=160)
    seconds = RunDirectory(tmp_path).metrics()["seconds"]
    assert len(seconds) == 16
    assert seconds == sorted(seconds)
