"""Runs that fail or are stopped: what is kept of them, and how they go on."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback, CheckpointCallback

from cirl_marl import CirlError, LearnerError, RecipeError, RunError
from cirl_marl.learners.interface import resume, train
from cirl_marl.learners.recipe import Demonstrations, LearnerSettings, Recipe, Run
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.learners.trainer import Progress

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
    status = run.status
    assert status["state"] == "failed" and status["checkpoint"] == f"{status['joint_steps']:09d}-running"
    names = sorted(path.name for path in (directory / "checkpoints").iterdir())
    assert names[-1] == "000000030-failed" and names[-2] == status["checkpoint"] and len(names) <= 4
    assert resume(directory).joint_steps >= 40
    assert RunDirectory(directory).status["state"] == "complete"


def test_a_run_that_goes_on_says_so(tmp_path: Path, ppo_recipe: Recipe, ctrl_c_after: Any) -> None:
    """What is not saved yet is not called saved: the state is that of a running training from the first step."""
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", ppo_recipe, agents=["mine", "use"], directory=tmp_path, report=ctrl_c_after(50))
    seen: list[tuple[str, int, int, int]] = []

    def watch(now: Progress) -> None:
        status = RunDirectory(tmp_path).status
        seen.append((status["state"], status["joint_steps"], now.env_steps, now.total))

    resume(tmp_path, report=watch)
    assert seen[0] == ("running", 31, 2, 18)  # at 30 the next rollouts begin
    assert seen[-1][2:] == (18, 18) and seen[-1][1] >= 31


def test_misspelt_callbacks_leave_nothing_behind(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """The check comes before the run directory, so that the same call can be made again."""
    with pytest.raises(CirlError, match="Did you mean 'mine'"):
        train("copper_net", ppo_recipe, directory=tmp_path / "run", callbacks={"mime": None})  # type: ignore[dict-item]
    one = CheckpointCallback(1, str(tmp_path / "checkpoints"))
    wrong: list[tuple[dict[str, Any], str]] = [
        ({"mine": [one]}, "that of 'mine' must be a BaseCallback, several a CallbackList of them, got"),
        ({"mine": CheckpointCallback}, "that of 'mine' must be a BaseCallback"),
        ({"mine": one, "use": one}, "that of 'use' is that of 'mine' too"),
    ]
    for callbacks, message in wrong:
        with pytest.raises(CirlError, match=f"callbacks: {message}"):
            train("copper_net", ppo_recipe, directory=tmp_path / "run", callbacks=callbacks)
    assert not (tmp_path / "run").exists()


@pytest.mark.parametrize("damage", [lambda path: path.unlink(), lambda path: path.write_bytes(b"nothing")])
def test_lost_experience_is_an_error(damage: Callable[[Path], None], tmp_path: Path, ctrl_c_after: Any) -> None:
    """A replay buffer that is gone, or no longer one, is named instead of begun anew."""
    learner = LearnerSettings(algorithm="SAC", parameters={"learning_starts": 100, "buffer_size": 100})
    recipe = Recipe(name="x", title="x", run=Run(steps=40, envs=1, engine="lockstep", evaluations=0), learner=learner)
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["use"], directory=tmp_path, report=ctrl_c_after(20))
    damaged = RunDirectory(tmp_path).checkpoint
    damage(damaged / "use.state.safetensors")
    with pytest.warns(
        UserWarning, match=rf"{damaged.name}.use\.state\.safetensors: cannot be read.*going on from 0000"
    ):
        resume(tmp_path)
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["use"], directory=tmp_path / "b", report=ctrl_c_after(20))
    for each in RunDirectory(tmp_path / "b").resumable():
        damage(each / "use.state.safetensors")
    with pytest.raises(RunError, match=r"use\.state\.safetensors: cannot be read"):
        resume(tmp_path / "b")


def test_room_in_a_replay_buffer_costs_little(tmp_path: Path, ctrl_c_after: Any) -> None:
    """A checkpoint is not as large as the buffer may become, but as what is in it."""
    learner = LearnerSettings(algorithm="SAC", parameters={"learning_starts": 100, "buffer_size": 1_000_000})
    recipe = Recipe(name="x", title="x", run=Run(steps=40, envs=1, engine="lockstep", evaluations=0), learner=learner)
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", recipe, agents=["use"], directory=tmp_path, report=ctrl_c_after(20))
    saved = RunDirectory(tmp_path).checkpoint / "use.state.safetensors"
    assert saved.stat().st_size < 2e6  # of networks and optimisers; the buffer alone has room for 60


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
    model = resume(tmp_path).learners["mine"].model
    assert (run.status["state"], run.status["joint_steps"], run.config.steps) == ("complete", 80, 160)
    assert model.num_timesteps == 160
    assert model.policy.optimizer.param_groups[0]["lr"] == pytest.approx(
        0.0, abs=1e-9
    )  # not of the 80 steps that it had at first
    after = run.metrics()
    assert after["joint_step"][: len(before["joint_step"])] == before["joint_step"]
    assert after["joint_step"][-1] == 80
    for steps in (None, 150, 160):
        with pytest.raises(CirlError, match=r"complete \(160 environment steps\)|at least 161"):
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


def test_a_run_is_trained_by_one_at_a_time(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """Neither do two trainings share a directory, nor the random streams of a process."""
    train("copper_net", ppo_recipe, agents=["mine", "use"], directory=tmp_path)
    with RunDirectory(tmp_path).lock(), pytest.raises(RunError, match="is being trained by another process"):
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
    kept = [RunDirectory(tmp_path / name).checkpoint for name in "ab"]
    for kind in ("json", "safetensors"):
        (kept[0] / f"use.state.{kind}").replace(kept[1] / f"use.state.{kind}")
    with pytest.raises(RunError, match=r"use\.state\.json: cannot be read"):
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
