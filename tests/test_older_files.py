"""What version 0.1.0 wrote loads, acts and goes on to the same bits (``fixtures/README.md``)."""

from __future__ import annotations

import csv
import hashlib
import json
import os
import shutil
import warnings
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from cirl_marl import parallel_env
from cirl_marl.cli import app
from cirl_marl.controllers.rollout import rollout
from cirl_marl.errors import RunError
from cirl_marl.learners.agent_env import StepResult
from cirl_marl.learners.barrier import CheckpointBarrier
from cirl_marl.learners.interface import Trained, resume
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.learners.teams.team import Team
from cirl_marl.records.machine import processor, versions

OLDER = Path(__file__).parent / "fixtures" / "0.1.0"
EXPECTED: dict[str, Any] = json.loads((OLDER / "expected.json").read_text())
HALF = sorted(path.name for path in (OLDER / "half").iterdir())

pytestmark = [
    pytest.mark.medium,
    pytest.mark.filterwarnings("ignore:.*other versions may give other bits", "ignore:.*rounds otherwise"),
]


def kernels() -> str:
    """Return a hash of what decides which kernels of NumPy and PyTorch are taken: instruction sets and settings."""
    import torch

    information = Path("/proc/cpuinfo")
    lines = information.read_text().splitlines() if information.is_file() else []
    flags = next((line for line in lines if line.startswith("flags")), "")
    settings = [os.environ.get(name, "") for name in ("OPENBLAS_CORETYPE", "ATEN_CPU_CAPABILITY", "MKL_CBWR")]
    return hashlib.sha256(repr([flags, torch.backends.cpu.get_cpu_capability(), *settings]).encode()).hexdigest()


def same_machine() -> bool:
    """Return whether this is a machine like that of the fixtures, so that bits can be compared and not only figures.

    Processors of one name may have other instruction sets, and then other kernels, which round otherwise.
    """
    here = versions() | {"processor": processor(), "kernels": kernels()}
    return all(here[name] == value for name, value in EXPECTED["made with"].items() if name != "cirl-marl")


def assert_same_figures(rows: list[dict[str, str]], expected: list[dict[str, str]]) -> None:
    """Compare tables: text to the letter, numbers to 1e-6, as the code that measures them has been rewritten since."""
    assert len(rows) == len(expected) > 0
    for row, other in zip(rows, expected, strict=True):
        assert row.keys() == other.keys()
        for key, text in row.items():
            try:
                assert float(text) == pytest.approx(float(other[key]), rel=1e-6)
            except ValueError:
                assert text == other[key]


def hashes(folder: Path) -> dict[str, str]:
    """Return the hash of each policy of a checkpoint."""
    files = (path for path in sorted(folder.glob("*.safetensors")) if path.name.count(".") == 1)
    return {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in files}


def copy_of(name: str, folder: Path) -> Path:
    """Return a copy of what is kept."""
    return Path(shutil.copytree(OLDER / name, folder / Path(name).name))


def test_there_are_fixtures_of_every_kind() -> None:
    """So that no test below passes on nothing."""
    assert HALF == ["ars_stacked", "ppo_of_two_lengths", "ppo_stacked", "sac_and_a2c"]
    journals = list(OLDER.glob("half/*/checkpoints/*/*.journal.json"))
    assert len(journals) == 8 and max(len(json.loads(path.read_text())) for path in journals) == 3


@pytest.mark.parametrize("name", HALF)
def test_a_half_trained_run_ends_as_it_would_have(name: str, tmp_path: Path) -> None:
    """Policies and evaluations are those of the resumption by the code that had begun it.

    That evaluated what there was before the last update, where now what this made is evaluated, and can act.
    """
    run, expected = copy_of(f"half/{name}", tmp_path), EXPECTED[name]
    assert RunDirectory(run).status["state"] == "interrupted"
    resume(run)
    status = RunDirectory(run).status
    assert (status["state"], status["checkpoint"]) == ("complete", expected["checkpoint"])
    rows = list(csv.reader((run / "evaluations.csv").read_text().splitlines()))
    header, *figures = csv.reader(expected["evaluations"])
    config = RunDirectory(run).config
    before = [row for row in figures if int(row[0]) < config.steps // config.envs]
    assert rows[0] == header and len(rows) == 2 + len(before) and rows[-1][0] == figures[-1][0]
    np.testing.assert_allclose(np.array(rows[1:-1], dtype=float), np.array(before, dtype=float), rtol=1e-3, atol=1e-6)
    if same_machine():
        folder = expected["checkpoint"]
        policies = {path: digest for path, digest in expected["policies"].items() if path.startswith(f"{folder}/")}
        assert policies == {f"{folder}/{file}": h for file, h in hashes(run / "checkpoints" / folder).items()}


def test_actions_of_a_replay_are_those_of_the_log() -> None:
    """To the bit, or within the rounding of another processor, which is said; what differs by more is refused."""
    logged, step = (
        np.array([[0.25], [-0.5]], dtype=np.float32),
        StepResult(np.zeros((2, 1)), np.zeros(2, dtype=np.float32), np.zeros(2, dtype=np.bool_)),
    )
    agent_env = SimpleNamespace(action=logged.copy(), last_step=None, title="agent 'mine'")
    barrier = CheckpointBarrier(agent_env, replay_log=[(logged, step)])  # type: ignore[arg-type]
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        barrier.replay_step(0)
    assert agent_env.last_step is step
    agent_env.action = np.nextafter(logged, np.float32(1.0))
    with pytest.warns(UserWarning, match="agent 'mine' goes on, but not to the same bits"):
        barrier.replay_step(0)
    for action in (None, logged[:1], logged + np.float32(0.01), np.full_like(logged, np.nan)):
        agent_env.action = action
        with pytest.raises(RunError, match="does not do again"):
            barrier.replay_step(0)


def test_a_complete_run_acts_and_learns_on(tmp_path: Path) -> None:
    """By the checkpoint that it has chosen, and to more steps."""
    run = RunDirectory(copy_of("complete", tmp_path))
    trained = Trained(run)
    assert (
        trained.checkpoint.name
        == run.status["best"]["checkpoint"]
        == EXPECTED["ppo_of_two_lengths"]["best"]["checkpoint"]
    )
    episode = rollout(run.make_env(2), trained, seed=1)
    assert np.isfinite(episode.episode_circularity).all()
    resume(run.path, steps=160)
    assert run.status["joint_steps"] * 2 >= 160
    if same_machine():
        assert hashes(run.checkpoint) == EXPECTED["more"]


def test_the_reasons_of_a_run_are_shown(tmp_path: Path) -> None:
    """They are those of the checkpoint that acts."""
    from cirl_marl.report.explanations import read_reasons

    run = RunDirectory(OLDER / "complete")
    sections, missing = read_reasons(run, run.acting_checkpoint.name)
    assert sections and not missing


@pytest.mark.parametrize("command", ["sweep", "pareto"])
def test_what_is_done_is_not_done_again(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The names of cells and runs are still those of the same question."""
    for name in ("bottles.toml", "recipe.toml", "sweep.toml"):
        shutil.copy(OLDER / name, tmp_path / name)
    folder = copy_of(command, tmp_path)
    monkeypatch.chdir(tmp_path)
    before = {path: path.read_bytes() for path in folder.rglob("*.safetensors")}
    assert before
    words = ["sweep.toml", "--out", "sweep"]
    if command == "pareto":
        words = ["bottles.toml", "--recipe", "recipe.toml", "--points", "2", "--episodes", "2", "--out", "pareto"]
    app([command, *words], standalone_mode=False)
    assert {path: path.read_bytes() for path in folder.rglob("*.safetensors")} == before
    tables = [
        list(csv.DictReader((place / f"{command}.csv").read_text().splitlines())) for place in (folder, OLDER / command)
    ]
    for row in (*tables[0], *tables[1]):
        row.pop("cpu_seconds", None)  # a job's own record, which is not kept
    new = tables[0][0].keys() - tables[1][0].keys()  # columns of options that came later, which nobody asked for
    assert not any(row.pop(name) for row in tables[0] for name in new)
    assert_same_figures(*tables)


def test_aims_are_inferred_from_a_plan() -> None:
    """A CSV file of ``cirl plan`` is read as the course of its network."""
    from cirl_marl import infer

    assert infer(OLDER / "bottles.toml", OLDER / "plan.csv").terms


def test_a_team_goes_on() -> None:
    """Its policies act in the environment, and learn on."""
    team = Team.load(OLDER / "team", partial(parallel_env, OLDER / "bottles.toml", horizon=6))
    before = team["quarry"].num_timesteps
    assert before == 24
    team.learn(12)
    assert team["quarry"].num_timesteps > before
    assert np.isfinite(team.evaluate(2)["disposal"]).all()
