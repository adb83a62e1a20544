"""Run directories from strangers: nothing in them runs code, and nothing outside of them is read or written."""

from __future__ import annotations

import json
import os
import pickle
import random
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from fuzz import fuzzed
from some import some
from test_own_models import brewery

from cirl_marl import CirlError, MultiAgentVectorEnv, RunError, load_network, single_agent_env
from cirl_marl.cli import main
from cirl_marl.definitions.catalogue import folder
from cirl_marl.definitions.reader import write_network
from cirl_marl.evaluation import assessment
from cirl_marl.learners.interface import Trained, resume, train
from cirl_marl.learners.recipe import Recipe
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network.units import factor

pytestmark = pytest.mark.medium

STOCKS: list[Any] = [True, np.ma.masked, torch.ones(1, requires_grad=True), "1", 1j]
"""What is no stock."""
SOURCES = Path(__file__).parent.parent / "cirl_marl"
OPENERS = re.compile(
    r"\b(pickle|cloudpickle|dill|joblib|shelve|marshal)\b|torch\.load|allow_pickle|\.load_replay_buffer|VecNormalize\.load|\beval\(|\bexec\("
)


class Planted:
    """What runs code when it is unpickled."""

    def __init__(self, proof: Path) -> None:
        """Leave ``proof`` behind."""
        self.proof = proof

    def __reduce__(self) -> tuple[object, ...]:  # noqa: D105 (pickle calls it)
        return os.system, (f"touch {self.proof}",)


def test_no_source_opens_what_can_run_code() -> None:
    """Nowhere in the package is a format read that can hold code, but for what a driver sends its own workers.

    That lies in a private folder, and is read only if its hash is the one that the queue was told (test_slurm.py).
    """
    said = [
        f"{path.name}:{number}: {line.strip()}"
        for path in some(sorted(SOURCES.rglob("*.py")))
        for number, line in enumerate(path.read_text().splitlines(), 1)
        if OPENERS.search(line.split("#")[0]) and '"""' not in line and "allow_pickle=False" not in line
    ]
    sent = [line for line in said if line.startswith(("slurm.py", "worker.py"))]
    assert [line.partition(": ")[2] for line in sent] == [
        "import pickle",
        "payload, progress = pickle.dumps(work), _progress(work)",
        "import pickle",
        "work: Work = pickle.loads(payload)",
    ]
    assert [line for line in said if line not in sent and not line.startswith("interface.py")] == []


def metrics(run: Path) -> object:
    """Read the episodes of a run."""
    return RunDirectory(run).metrics()


def resumed(run: Path) -> object:
    """Go on with a run."""
    return resume(run, steps=64)


@pytest.fixture(scope="module")
def stopped(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that was stopped, with everything that a run can hold."""
    recipe = Recipe.model_validate(
        {
            "name": "stopped", "title": "stopped",
            "run": {"steps": 60, "envs": 1, "engine": "lockstep", "evaluations": 3, "episodes": 2},
            "learner": {
                "algorithm": "SAC", "parameters": {"learning_starts": 4, "buffer_size": 20, "batch_size": 2},
                "normalise": {"observation": True, "reward": True},
            },
        }
    )  # fmt: skip
    folder = tmp_path_factory.mktemp("runs") / "stopped"
    train("copper_net", recipe, directory=folder, agents=["mine"], horizon=5)
    status = json.loads((folder / "status.json").read_text())
    (folder / "status.json").write_text(json.dumps(status | {"state": "interrupted"}))
    return folder


@pytest.mark.parametrize("form", ["pickle", "nested", "nul", "empty"])
@pytest.mark.sample(2)
def test_hostile_files_run_nothing(form: str, stopped: Path, tmp_path: Path) -> None:
    """Every file of a run, replaced by code or nonsense: an error of ours or no harm, and never the code."""
    proof = tmp_path / "proof"
    bytes_ = {"pickle": pickle.dumps(Planted(proof)), "nested": b"[" * 100_000, "nul": b"\0" * 99, "empty": b""}[form]
    files = [path.relative_to(stopped) for path in sorted(stopped.rglob("*")) if path.is_file()]
    tried = [path for path in files if path.suffix in (".json", ".safetensors", ".csv", ".toml")]
    assert len(tried) >= 12
    for number, file in enumerate(tried):
        run = tmp_path / f"run{number}"
        shutil.copytree(stopped, run)
        (run / file).write_bytes(bytes_)
        for use in (Trained, metrics, resumed):
            try:
                use(run)
            except CirlError as error:
                assert str(run) in str(error)
        assert not proof.exists(), file
        shutil.rmtree(run)


@pytest.mark.parametrize("name", ["../../outside", "/outside", "..", "000000060-complete/../../../outside", ""])
def test_names_that_lead_out_are_refused(name: str, stopped: Path, tmp_path: Path) -> None:
    """Of checkpoints in the status, whoever reads it."""
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    (outside := tmp_path / "outside").mkdir()
    (outside / "precious").write_text("kept")
    status = json.loads((run / "status.json").read_text())
    best = status["best"] | {"checkpoint": name}
    for changed in ({"checkpoint": name, "best": None}, {"best": best}):
        (run / "status.json").write_text(json.dumps(status | changed))
        with pytest.raises(RunError, match="is no name of a checkpoint"):
            Trained(run)
    assert (outside / "precious").read_text() == "kept"


def test_links_are_not_followed(stopped: Path, tmp_path: Path) -> None:
    """A link at any place of a run is named, and what it leads to stays as it is."""
    places = some([path.relative_to(stopped) for path in sorted(stopped.rglob("*"))])
    for number, place in enumerate([*places, Path("next"), Path("checkpoints/next.partial"), Path(".lock")]):
        run, outside = tmp_path / f"run{number}", tmp_path / f"outside{number}"
        shutil.copytree(stopped, run)
        target = run / place
        if target.is_dir():
            target.rename(outside)
        elif target.exists():
            outside.mkdir()
            target.rename(outside / "file")
        else:
            outside.mkdir()
        before = {path: path.read_bytes() for path in outside.rglob("*") if path.is_file()}
        target.symlink_to(outside / "file" if (outside / "file").is_file() else outside)
        for use in (Trained, resumed):
            with pytest.raises(RunError, match="is a link"):
                use(run)
        assert {path: path.read_bytes() for path in outside.rglob("*") if path.is_file()} == before
        shutil.rmtree(run)


def test_a_network_that_was_edited_is_refused_before_anything_is_trained(stopped: Path, tmp_path: Path) -> None:
    """And strangers among the checkpoints change nothing."""
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    (run / "checkpoints" / "notes.txt").write_text("mine")
    Trained(run)
    text = (run / "network.toml").read_text()
    (run / "network.toml").write_text(text.replace("horizon", "horizon ", 1))
    for use in (Trained, resumed):
        with pytest.raises(RunError, match=r"network\.toml: is not the file of this training"):
            use(run)
    assert (run / "checkpoints" / "notes.txt").read_text() == "mine"


@pytest.mark.parametrize(
    "unit",
    ["9**9**9 kg", "(9**99)**99 kg", "((kg**9)**9)**9", "kg**999999999", "((((kg", "(" * 60 + "kg", "k" * 10**6,
     "9" * 5000 + " kg", "kg^9^9", "2**99*kg", "kg**(9**9)", "[" * 90, "kg**-9**9", "1e999 kg", "kg\x00"],
)  # fmt: skip
def test_units_from_strangers(unit: str) -> None:
    """None takes long or ends in an error that is not ours, and what people write goes on to work."""
    with pytest.raises(CirlError, match=r"^unit '"):
        factor(unit, "kg")
    for good in ("kg/day", "kg*m**2/s^2", "t/year", "1/day", "m**-3", "W/m**2", "(kg/m)**2", "g/(l*day)"):
        factor(good, good)


def test_definitions_import_nothing_unless_they_may(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Models of somebody else are imported when that is allowed, and then what ends a process is an error."""
    name = f"stranger_{os.getpid()}"
    (tmp_path / f"{name}.py").write_text(
        f"import pathlib\npathlib.Path({str(tmp_path / 'proof')!r}).touch()\nraise SystemExit(3)\n"
    )
    monkeypatch.syspath_prepend(str(tmp_path))
    path = tmp_path / "brewery.toml"
    write_network(brewery(), path)
    path.write_text(path.read_text().replace("own_models:", f"{name}:"))
    for use in (lambda: load_network(path), lambda: MultiAgentVectorEnv(path, num_envs=1)):
        with pytest.raises(CirlError, match=rf"kind '{name}:Fermenter' would import '{name}'.*--allow-code"):
            use()
    assert not (tmp_path / "proof").exists()
    with pytest.raises(CirlError, match="importing it failed: SystemExit: 3"):
        load_network(path, allow_code=True)
    assert (tmp_path / "proof").exists()
    monkeypatch.setattr(sys, "argv", ["cirl", "check", str(path)])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2


KILLED = """
import os, signal, sys
from cirl_marl.learners.interface import train, resume
from cirl_marl.learners.recipe import Recipe
from cirl_marl.learners import trainer as training
import cirl_marl.records.files as files, cirl_marl.learners.run_directory as run_module
from pathlib import Path

directory, at = sys.argv[1], int(sys.argv[2])
count = 0
def killed_before(function):
    def run(*args, **kwargs):
        global count
        count += 1
        if count == at:
            os.kill(os.getpid(), signal.SIGKILL)
        return function(*args, **kwargs)
    return run
for name in ("replace", "mkdir", "write_text", "unlink"):
    setattr(Path, name, killed_before(getattr(Path, name)))
recipe = Recipe.model_validate({"name": "k", "title": "k",
    "run": {"steps": 48, "envs": 2, "evaluations": 4, "episodes": 2},
    "learner": {"algorithm": "PPO", "parameters": {"n_steps": 6, "batch_size": 6, "policy_kwargs": {"net_arch": [4]}}}})
if not (Path(directory) / "config.json").is_file():
    train("copper_net", recipe, directory=directory, agents=["mine", "use"], horizon=5, seed=1)
else:
    resume(directory)
"""


@pytest.mark.slow
def test_a_training_that_is_killed_at_any_file_operation(tmp_path: Path) -> None:
    """SIGKILL before each of them, and taken up again: the same bits in the end."""
    script = tmp_path / "train.py"
    script.write_text(KILLED)

    def run(folder: Path, at: int) -> int:
        done = subprocess.run([sys.executable, script, folder, str(at)], check=False, capture_output=True, text=True)
        assert done.returncode in (0, -9), done.stderr
        return done.returncode

    def kept(folder: Path) -> dict[str, bytes]:
        chosen = RunDirectory(folder).checkpoint
        return {path.name: path.read_bytes() for path in chosen.iterdir()} | {
            "evaluations": (folder / "evaluations.csv").read_bytes()
        }

    assert run(tmp_path / "whole", 0) == 0
    whole, at, killed = kept(tmp_path / "whole"), 1, 1
    while killed:
        folder = tmp_path / f"killed{at}"
        killed = run(folder, at)
        for _ in range(3):
            if killed and run(folder, 0) == 0:
                break
        assert kept(folder) == whole, at
        shutil.rmtree(folder)
        at += 7
    assert at > 50


def test_mutated_definitions_are_refused_or_work() -> None:
    """500 of them, others each time unless in continuous integration; ``make fuzz`` tries 10 000."""
    seed = 0 if "CI" in os.environ else random.SystemRandom().randrange(10**6)
    found = fuzzed(500, seed)
    assert found["refused"] > 100 and found["works"] > 30
    assert not found["without the file's name"]
    assert not found["slow"]


def test_what_is_no_network_agent_or_seed(tmp_path: Path) -> None:
    """Errors are of ours, also for what nobody would write by mistake."""
    text = (folder("envs") / "copper_net.toml").read_text()
    (path := tmp_path / "x.toml").write_text(text)
    env, alone = MultiAgentVectorEnv(path, num_envs=1), single_agent_env("copper_net", agent="mine")
    wrong: list[tuple[Any, str]] = [
        (lambda: load_network("a\0b.toml"), "network: .* is no path: embedded null"),
        (lambda: load_network(path, scenario=[]), "unknown scenario"),  # type: ignore[arg-type]
        (lambda: MultiAgentVectorEnv(path, num_envs=1, agents=[["mine"]]), "agents must be a sequence of ids"),  # type: ignore[list-item]
        (lambda: env.restore(None), "a snapshot is needed"),  # type: ignore[arg-type]
        *((lambda seed=seed: alone.reset(seed=seed), "must be a non-negative integer") for seed in (-1, "a", 1.5, [1])),
        *(
            (lambda stock=stock: env.reset(options={"initial_state": {"mine": stock}}), "it must hold numbers")
            for stock in STOCKS
        ),
    ]
    for bad, said in wrong:
        with pytest.raises(CirlError, match=said):
            bad()
    first = alone.reset(seed=np.int64(3))[0]  # type: ignore[arg-type]
    np.testing.assert_array_equal(first, alone.reset(seed=3)[0])
    for line, said in (
        ("x = " + "[" * 5000 + "]" * 5000, "nested too deeply"),
        ("x = " + "9" * 5000, "thousands of digits"),
        ("x = " + "9" * 30, "x: is an integer of 30 digits"),
        ("x = 0x" + "f" * 4000, "x: is an integer of 4816 digits"),
    ):
        path.write_text(line + "\n" + text)
        with pytest.raises(CirlError, match=said):
            load_network(path)


def test_a_missing_file_is_all_that_is_told(tmp_path: Path) -> None:
    """Nothing is said of numbers that could not be read from it."""
    (path := tmp_path / "steel.toml").write_text((folder("envs") / "steel.toml").read_text())
    with pytest.raises(CirlError) as refused:
        load_network(f"{path}:japan")
    lines = str(refused.value).splitlines()
    assert [re.findall("'(steel.*?csv)': is not there", line) for line in lines] == [
        ["steel_regions.csv"],
        ["steel_history.csv"],
    ]


def test_figures_are_shown_where_they_cannot_be_kept(
    stopped: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """On a disk that is full or read-only."""
    run = tmp_path / "run"
    shutil.copytree(stopped, run)

    def full(path: Path, value: object) -> None:
        raise OSError(28, "No space left on device", str(path))

    monkeypatch.setattr(assessment, "write_json", full)
    monkeypatch.setattr(sys, "argv", ["cirl", "evaluate", str(run), "--episodes", "2"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in (0, None)
    printed = capsys.readouterr().out
    assert "neutral" in printed and "No space left on device" in printed


def test_other_versions_and_other_steps_are_told(stopped: Path, tmp_path: Path) -> None:
    """A run that goes on with others is warned; a status that tells of other steps than its checkpoint is refused."""
    run = tmp_path / "run"
    shutil.copytree(stopped, run)
    versions = json.loads((run / "versions.json").read_text())
    (run / "versions.json").write_text(json.dumps(versions | {"numpy": "0.1"}))
    with pytest.warns(UserWarning, match=r"other versions may give other bits: numpy 0\.1, now"):
        resume(run, steps=64)
    for steps in (-5, 10**9):
        status = json.loads((run / "status.json").read_text())
        (run / "status.json").write_text(json.dumps(status | {"joint_steps": steps}))
        with pytest.raises(RunError, match="is not the status of a run"):
            resume(run)
