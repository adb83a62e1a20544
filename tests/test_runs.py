"""A training run on disk: what is kept, that it acts as what was learnt, and which damage is refused."""

from __future__ import annotations

import errno
import json
import multiprocessing
import os
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from safetensors import SafetensorError
from small_networks import constant
from stable_baselines3.common.vec_env import VecNormalize

import cirl_marl
from cirl_marl import MultiAgentVectorEnv, RunError
from cirl_marl.controllers.rollout import rollout
from cirl_marl.learners import checkpoint
from cirl_marl.learners import run_directory as learners_run
from cirl_marl.learners.interface import Trained, resume, train
from cirl_marl.learners.recipe import LearnerSettings, Normalisation, Recipe, Run
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.records import files as files_module
from cirl_marl.records.files import write_atomically

pytestmark = pytest.mark.medium


def test_run_directory_holds_what_is_needed(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """Saved policies, with their normalisers, act exactly like those in memory."""
    training = train("carbo_net", ppo_recipe, directory=tmp_path / "run", horizon=5)
    run = RunDirectory(tmp_path / "run")
    assert run.config == training.config
    env = run.make_env(3)
    observations = env.reset(seed=9)
    controller = Trained(run)
    controller.start(env, 0)
    actions = controller.act(observations)
    for agent, learner in training.learners.items():
        assert isinstance(learner.env, VecNormalize)
        seen = learner.env.normalize_obs(np.ascontiguousarray(observations[agent]))
        assert np.array_equal(actions[agent], learner.model.predict(seen, deterministic=True)[0])
    versions = json.loads((run.path / "versions.json").read_text())
    assert versions["stable-baselines3"]
    metrics = run.metrics()
    assert metrics["env_steps"][-1] == 80
    assert all(np.isfinite(metrics[f"return:{agent}"]).all() for agent in env.agents)
    assert all(list((run.path / "tensorboard" / agent).glob("events*")) for agent in env.agents)


def test_without_tensorboard_a_run_has_no_curves(
    tmp_path: Path, ppo_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is an extra; all else is kept."""
    monkeypatch.setattr("cirl_marl.learners.learner.find_spec", lambda name: None)
    train("carbo_net", ppo_recipe, directory=tmp_path / "run", horizon=5)
    assert not (tmp_path / "run" / "tensorboard").exists()
    assert RunDirectory(tmp_path / "run").metrics()["env_steps"][-1] == 80


def test_network_built_in_python_can_be_kept(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """A run of a network without a file holds a definition that reads back as the same network."""
    network = replace(cirl_marl.load_network("copper_net"), source=None)
    train(network, ppo_recipe, agents=["mine"], directory=tmp_path / "run")
    assert RunDirectory(tmp_path / "run").make_env(1).network == network


def test_half_written_runs_are_refused(tmp_path: Path, ppo_recipe: Recipe, own_copper_run: Path) -> None:
    """Whatever is missing from a run directory is named; nothing is overwritten."""
    directory = own_copper_run
    with pytest.raises(RunError, match="not empty"):
        train("copper_net", ppo_recipe, directory=directory, horizon=5)
    for name in ("config.json", "status.json", "network.toml"):
        broken = tmp_path / f"without_{name}"
        shutil.copytree(directory, broken)
        (broken / name).unlink()
        with pytest.raises(RunError, match=name):
            Trained(broken)
    checkpoint = RunDirectory(directory).checkpoint
    (checkpoint / "use.json").write_bytes(b"{half a file")
    with pytest.raises(RunError, match=r"use\.json"):
        Trained(directory)
    (checkpoint / "mine.json").unlink()
    with pytest.raises(RunError, match="lacks the policies of mine"):
        Trained(directory)
    (directory / "status.json").write_text('{"state": "run')
    with pytest.raises(RunError, match=r"status.json: cannot be read"):
        Trained(directory)


def test_what_a_kill_leaves_of_a_run_that_was_being_made(
    tmp_path: Path, own_copper_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """At any operation on files: it is made anew. A folder with the definition of somebody is left alone."""
    config, definition = RunDirectory(own_copper_run).config, own_copper_run / "network.toml"
    operations = [(Path, "mkdir"), (Path, "write_text"), (Path, "replace"), (shutil, "copyfile")]
    originals = [getattr(owner, name) for owner, name in operations]
    left, kills, run = 0, 0, tmp_path / "made"

    class Killed(BaseException):
        """Ends a process in a test."""

    def counted(original: Any, *args: Any, **options: Any) -> Any:
        nonlocal left
        left -= 1
        if left < 0:
            raise Killed
        return original(*args, **options)

    def begin(path: Path) -> None:
        with RunDirectory.create(path, config, definition):
            pass

    def create(allowed: int) -> None:
        nonlocal left
        left = allowed
        with monkeypatch.context() as patch:
            for (owner, name), original in zip(operations, originals, strict=True):
                patch.setattr(owner, name, lambda *args, original=original, **more: counted(original, *args, **more))
            patch.setattr(Path, "unlink", lambda *_, **__: None)  # nobody clears up after a kill
            begin(run)

    for allowed in range(100):
        try:
            create(allowed)
            break
        except Killed:
            kills += 1
            assert not (run / "config.json").is_file()
            begin(run)
            assert RunDirectory(run).config.steps == config.steps
            shutil.rmtree(run)
    assert kills >= 8
    (mine := tmp_path / "mine").mkdir()
    shutil.copy(definition, mine)
    with pytest.raises(RunError, match="already exists and is not empty"):
        begin(mine)


def test_a_run_that_another_process_is_making_is_left_to_it(tmp_path: Path, own_copper_run: Path) -> None:
    """Half made it looks like what a crash left, and only its lock says that it is none."""
    config, definition = RunDirectory(own_copper_run).config, own_copper_run / "network.toml"
    (run := tmp_path / "made").mkdir()
    shutil.copy(own_copper_run / "versions.json", run)
    with RunDirectory(run).lock(), pytest.raises(RunError, match="is being trained by another process"):
        with RunDirectory.create(run, config, definition):
            pass
    assert (run / "versions.json").is_file() and not (run / "config.json").exists()
    with RunDirectory.create(run, config, definition) as first, pytest.raises(RunError, match="by another process"):
        with RunDirectory(run).lock():
            pass
    assert first.config.steps == config.steps


def test_directories_without_a_run_are_named(tmp_path: Path) -> None:
    """With the runs beside them, if there are any."""
    (tmp_path / "runs" / "empty").mkdir(parents=True)
    for name in ("first", "empty"):
        with pytest.raises(RunError) as raised:
            Trained(tmp_path / "runs" / name)
        assert str(raised.value) == f"no run in {tmp_path / 'runs' / name} (it has no config.json)"
    first = tmp_path / "runs" / "first"
    first.mkdir()
    (first / "config.json").write_text("{}")
    with pytest.raises(RunError) as raised:
        Trained(tmp_path / "runs" / "frist")
    missing = tmp_path / "runs" / "frist"
    beside = f"unknown run '{missing}'. Did you mean '{first}'? Known: {first}."
    assert str(raised.value) == f"no run in {missing} (it has no config.json): {beside}"


def test_run_directory_describes_what_was_trained(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """A network changed in Python, whatever part of it, is kept as it was trained, not as its file says."""
    network = cirl_marl.load_network("copper_net")
    arcs = tuple(
        replace(arc, rate=2 * constant(arc.rate)) if arc.id == "use_to_landfill" else arc for arc in network.arcs
    )
    changed = replace(network, arcs=arcs).with_options(objective={"circularity_weight": 0.9})
    train(changed, ppo_recipe, agents=["mine"], directory=tmp_path / "changed", horizon=5)
    kept = RunDirectory(tmp_path / "changed").make_env(1).network
    assert (kept.arcs, kept.objective) == (changed.arcs, changed.objective)
    paper = cirl_marl.load_network("copper_net", scenario="paper")
    train(paper, ppo_recipe, directory=tmp_path / "paper")
    assert RunDirectory(tmp_path / "paper").make_env(1).network == paper
    assert RunDirectory(tmp_path / "paper").config.scenario == "paper"


def test_missing_or_damaged_normaliser_is_an_error(own_copper_run: Path) -> None:
    """A policy without its normaliser would act on the wrong numbers; weights without their names on nothing."""
    path = RunDirectory(own_copper_run).checkpoint / "use.json"
    told = json.loads(path.read_text())
    assert told["normaliser"]["observations"]
    path.write_text(json.dumps(told | {"normaliser": None}))
    with pytest.raises(RunError, match=r"use\.json: cannot be read"):
        Trained(own_copper_run)
    path.write_text(json.dumps(told))
    weights = path.with_suffix(".safetensors")
    weights.write_bytes(weights.read_bytes()[:50])
    with pytest.raises(RunError, match=r"use\.safetensors: cannot be read"):
        Trained(own_copper_run)
    weights.unlink()
    with pytest.raises(RunError, match=r"use\.safetensors: cannot be read"):
        Trained(own_copper_run)


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("config.json", "{}"),
        ("status.json", "{}"),
        ("status.json", "[]"),
        ("status.json", '{"state": "done", "joint_steps": 1, "checkpoint": null}'),
        ("status.json", '{"state": "complete", "joint_steps": null, "checkpoint": "000000040-complete"}'),
        ("status.json", '{"state": "complete", "joint_steps": 40, "checkpoint": 5}'),
    ],
)
def test_files_that_say_something_else_are_refused(own_copper_run: Path, name: str, text: str) -> None:
    """A readable file with the wrong contents is named."""
    (own_copper_run / name).write_text(text)
    with pytest.raises(RunError, match=name):
        Trained(own_copper_run)


@pytest.mark.parametrize(("key", "value"), [("seed", "x"), ("steps", 1.5), ("envs", None), ("options", {"horzon": 5})])
def test_configurations_of_something_else_are_refused(own_copper_run: Path, key: str, value: object) -> None:
    """A wrong value is found when it is read, not in the middle of a run."""
    path = own_copper_run / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | {key: value}))
    with pytest.raises(RunError, match=r"config\.json: is not a run configuration: .*(seed|steps|envs|horzon)"):
        Trained(own_copper_run)


def test_recurrent_policies_remember_within_an_episode_and_forget_after_it(tmp_path: Path) -> None:
    """A run's LSTM is fed its state from step to step, from nothing at each start."""
    parameters = {"n_steps": 10, "batch_size": 10, "n_epochs": 1, "policy_kwargs": {"lstm_hidden_size": 8}}
    normalise = Normalisation(observation=False, reward=False)
    learner = LearnerSettings(
        algorithm="RecurrentPPO", policy="MlpLstmPolicy", parameters=parameters, normalise=normalise
    )
    recipe = Recipe(name="x", title="x", run=Run(steps=40, envs=2, evaluations=0), learner=learner)
    training = train("copper_net", recipe, agents=["use"], directory=tmp_path / "run", horizon=5)
    env = RunDirectory(tmp_path / "run").make_env(2)
    controller, model = Trained(tmp_path / "run"), training.learners["use"].model
    for seed in (0, 1):
        seen = env.reset(seed=seed)
        controller.start(env, 0)
        state, begins = None, np.ones(2, dtype=bool)
        for _ in range(5):
            expected, state = model.predict(seen["use"], state, begins, deterministic=True)
            forgetful = model.predict(seen["use"], None, np.ones(2, dtype=bool), deterministic=True)[0]
            np.testing.assert_array_equal(controller.act(seen)["use"], expected)
            assert begins.all() or not np.array_equal(expected, forgetful)
            begins = np.zeros(2, dtype=bool)
            seen = env.step({"use": expected})[0]
    with pytest.raises(RunError, match=r"trained \['use'\], not \['mine'\]"):
        controller.start(cirl_marl.vector_env("copper_net", num_envs=2, agents=["mine"]), 0)


def test_policies_of_others_are_refused(own_copper_run: Path) -> None:
    """A policy for other observations, or its normaliser, does not act."""
    folder = RunDirectory(own_copper_run).checkpoint
    kept = {each: (folder / each).read_bytes() for each in ("mine.json", "mine.safetensors")}
    for name in kept:
        shutil.copyfile(folder / name.replace("mine", "use"), folder / name)
    with pytest.raises(RunError, match="'mine' is for other observations"):
        Trained(own_copper_run)
    for name, content in kept.items():
        (folder / name).write_bytes(content)
    theirs = json.loads((folder / "use.json").read_text())["normaliser"]
    own = json.loads(kept["mine.json"])
    (folder / "mine.json").write_text(json.dumps(own | {"normaliser": theirs}))
    with pytest.raises(RunError, match="'mine' is for other observations"):
        Trained(own_copper_run)
    (folder / "mine.json").write_bytes(kept["mine.json"])
    Trained(own_copper_run)


def test_policies_act_on_what_they_learnt_to_see(copper_run: Path) -> None:
    """Whatever an environment shows; a network in which they would see something else is refused."""
    policy = Trained(copper_run)
    other = cirl_marl.load_network("copper_net")
    showing = other.with_options(observation={"mode": "full", "countdown": True})
    runs = [
        rollout(MultiAgentVectorEnv(network, num_envs=2, horizon=3, **shown), policy, seed=0)
        for network, shown in ((other, {}), (other, {"observe": "full"}), (other, {"countdown": True}), (showing, {}))
    ]
    for run in runs[1:]:
        np.testing.assert_array_equal(run.stock, runs[0].stock)
        np.testing.assert_array_equal(run.controls, runs[0].controls)
    other = replace(other, nodes=tuple(replace(node, set_point=1.0) for node in other.nodes))
    with pytest.raises(RunError, match=r"learnt from other observations \(set-point of"):
        policy.start(MultiAgentVectorEnv(other, num_envs=2), seed=0)


def test_failed_writing_leaves_the_old_file_and_no_other(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Half of a file is nowhere."""
    path = tmp_path / "kept.txt"
    path.write_text("old")

    def write(partial: Path) -> None:
        partial.write_text("ha")
        raise OSError("disk full")

    with pytest.raises(OSError, match="disk full"):
        write_atomically(path, write)
    with pytest.raises(OSError, match=r"No space left on device: '.*kept.txt'"):
        write_atomically(path, lambda partial: Path("/dev/full").write_text("ha"))
    assert [each.name for each in tmp_path.iterdir()] == ["kept.txt"]
    assert path.read_text() == "old"

    def refuse(partial: Path, *_: Any) -> None:
        raise OSError(errno.EROFS, os.strerror(errno.EROFS), str(partial))

    monkeypatch.setattr(Path, "write_text", refuse)
    monkeypatch.setattr(Path, "unlink", refuse)
    with pytest.raises(OSError, match=r"Read-only file system: '.*kept.txt'"):
        write_atomically(path, lambda partial: partial.write_text("ha"))


def test_two_writers_of_a_file_do_not_mix(tmp_path: Path) -> None:
    """Each writes to a place of its own: what is there is what one of them wrote."""
    path = tmp_path / "both.txt"

    def write(draft: Path) -> None:
        draft.write_text("first")
        write_atomically(path, lambda other: other.write_text("second"))
        assert path.read_text() == "second"

    write_atomically(path, write)
    assert path.read_text() == "first" and len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("is_folder", [False, True])
def test_what_a_killed_process_left_is_removed(is_folder: bool, tmp_path: Path) -> None:
    """By the next that writes there; what a living process writes stays."""
    draft = files_module._partial(tmp_path)
    process = multiprocessing.get_context("spawn").Process(target=int)
    process.start()
    process.join()
    for id_ in (process.pid, os.getppid(), 2**70):
        left = tmp_path / draft.name.replace(f"-{os.getpid()}-", f"-{id_}-")
        (left.mkdir if is_folder else left.touch)()
    write_atomically(tmp_path / "new.txt", lambda path: path.write_text("new"))
    kept = draft.name.replace(f"-{os.getpid()}-", f"-{os.getppid()}-")
    assert sorted(path.name for path in tmp_path.iterdir()) == [kept, "new.txt"]


def test_the_file_that_names_the_others_comes_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is killed in between leaves no definition without its data."""
    moved: list[str] = []
    replace = os.replace

    def recorded(source: Path, target: Path) -> None:
        moved.append(target.name)
        replace(source, target)

    monkeypatch.setattr(os, "replace", recorded)
    with files_module.publish_folder(tmp_path, last="b.toml") as draft:
        for name in ("c.csv", "b.toml", "a.csv"):
            (draft / name).touch()
    assert moved == ["a.csv", "c.csv", "b.toml"]


def test_checkpoints_are_on_the_disk_before_they_count(
    tmp_path: Path, ppo_recipe: Recipe, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Every file of a checkpoint, then its folder, then the status that names it."""
    synced: list[Path] = []
    sync = files_module.sync

    def recorded(path: Path) -> None:
        sync(path)
        synced.append(path)

    for module in (learners_run, files_module):
        monkeypatch.setattr(module, "sync", recorded)
    train("copper_net", ppo_recipe, directory=tmp_path, agents=["mine"])
    names = [path.name for path in synced]
    end = [place for place, name in enumerate(names) if name == "next.partial"][-1]
    kept = {"mine.json", "mine.safetensors", "mine.state.json", "mine.state.safetensors"}
    assert set(names[end - 4 : end]) == kept
    assert names[end + 1] == "checkpoints" and names[end + 2].endswith(".json")


def test_metrics_survive_a_crash(tmp_path: Path, ppo_recipe: Recipe, ctrl_c_after: Any) -> None:
    """A row that a crash cut short is left out, and rows past the checkpoint are not repeated on resumption."""
    directory = tmp_path / "run"
    with pytest.raises(KeyboardInterrupt):
        train("copper_net", ppo_recipe, agents=["mine"], directory=directory, horizon=5, report=ctrl_c_after(60))
    metrics = directory / "metrics.csv"
    before = RunDirectory(directory).metrics()["joint_step"]
    metrics.write_text(metrics.read_text() + "35,70,1.0,-9")
    assert RunDirectory(directory).metrics()["joint_step"] == before
    metrics.write_text(metrics.read_text() + "\n")
    resume(directory)
    steps = RunDirectory(directory).metrics()["joint_step"]
    assert steps == sorted(set(steps))
    assert steps[: len(before)] == before
    assert len(steps) > len(before)


def test_run_opens_with_the_horizon_that_it_was_trained_with(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """Whether the horizon came as an option or in the network itself."""
    network = cirl_marl.load_network("carbo_net").with_options(episode={"horizon": 7})
    in_network = train(network, ppo_recipe, directory=tmp_path / "network", steps=4)
    as_option = train("carbo_net", ppo_recipe, directory=tmp_path / "option", steps=4, horizon=7)
    for training in (in_network, as_option):
        assert training.run is not None
        assert training.run.make_env(1).network.episode.horizon == 7


def test_a_full_disk_is_said_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The file, and what the system says of it, in an error of the system and not of the format."""

    def fail(*_: object) -> None:
        raise SafetensorError("I/O error: No space left on device (os error 28)")

    monkeypatch.setattr(checkpoint, "save_file", fail)
    with pytest.raises(OSError, match=r"learner.safetensors: cannot be written: .*No space left on device"):
        checkpoint.write_tree(tmp_path, "learner", {"weights": np.zeros(10)})
