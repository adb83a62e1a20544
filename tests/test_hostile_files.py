"""Every reader of folders, with files that a stranger has altered: refused in words of ours, or no harm; never slow."""

from __future__ import annotations

import copy
import json
import math
import os
import random
import shutil
import time
import warnings
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium import spaces
from pettingzoo import ParallelEnv
from some import some
from stable_baselines3 import PPO, TD3
from stable_baselines3.common.noise import OrnsteinUhlenbeckActionNoise

import cirl_marl
from cirl_marl import CirlError, LearnerError, RunError, Team
from cirl_marl.evaluation.assessment import evaluate
from cirl_marl.jobs.work import JobFiles, last_line
from cirl_marl.learners.checkpoint import model_state, set_model_state
from cirl_marl.learners.interface import Trained, resume, train
from cirl_marl.learners.recipe import Recipe
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Network
from cirl_marl.reasons.plan_files import episodes_of_plan
from cirl_marl.records.files import write_json
from cirl_marl.report.explanations import FILE, FOLDER, read_reasons
from cirl_marl.sweeps import CellStatus, sweep

pytestmark = pytest.mark.medium

VALUES: tuple[Any, ...] = (None, True, [], {}, "", "x", "../../x", -1, 0, 10**30, 1e300, math.nan, [[]], [0], {"x": 1})
"""What stands in the place of another value."""
SCRAPS = (b"", b"\0", b'"', b",", b"\n", b"\xff", b"1e999", b"nan", b"_")
"""What stands in the place of some bytes."""
READ = (".json", ".safetensors", ".csv", ".toml", ".log")
LONGEST = 20.0
"""Seconds of processor time that a use may take."""
COUNTS = pytest.mark.parametrize("count", [6, pytest.param(150, marks=pytest.mark.slow)])
"""How many files are altered."""
Use = Callable[[Path], object]


def places(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield where values stand in a tree."""
    yield path
    if isinstance(value, dict | list):
        for key in value if isinstance(value, dict) else range(len(value)):
            yield from places(value[key], (*path, key))


def altered(value: Any, draw: random.Random) -> Any:
    """Return a tree in which one value is another one, or is gone."""
    *path, last = draw.choice([place for place in places(value) if place] or [(None,)])
    value = copy.deepcopy(value)
    if last is None or draw.random() < 0.05:
        return draw.choice(VALUES)
    parent = value
    for key in path:
        parent = parent[key]
    if draw.random() < 0.2:
        del parent[last]
    else:
        parent[last] = draw.choice(VALUES)
    return value


def alter(file: Path, draw: random.Random) -> None:
    """Alter a file by what it is: a value of JSON, the header of safetensors, else bytes."""
    content = file.read_bytes()
    if file.suffix == ".json":
        content = json.dumps(altered(json.loads(content), draw)).encode()
    elif file.suffix == ".safetensors" and draw.random() < 0.8:
        size = int.from_bytes(content[:8], "little")
        header = json.dumps(altered(json.loads(content[8 : 8 + size]), draw)).encode()
        told = draw.choice((len(header), len(header), len(header), 2**60, 2**26))
        content = told.to_bytes(8, "little") + header + content[8 + size :]
    else:
        at = draw.randrange(len(content) + 1)
        content = content[:at] + draw.choice(SCRAPS) + content[at + draw.randrange(9) :]
    file.write_bytes(content)


def use_altered(folder: Path, uses: Mapping[str, Use], scratch: Path, count: int, within: str = "**") -> int:
    """Alter files of copies of a folder, use these, and return how often that was refused."""
    seed, refused = 0 if "CI" in os.environ else random.SystemRandom().randrange(10**6), 0
    files = some([path.relative_to(folder) for path in sorted(folder.glob(f"{within}/*")) if path.suffix in READ])
    for number in range(count):
        draw = random.Random(f"{seed} {number}")
        file, (name, use) = draw.choice(files), draw.choice(list(uses.items()))
        shutil.copytree(folder, copied := scratch / "altered")
        alter(copied / file, draw)
        began = time.process_time()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", UserWarning)  # of other versions, and of a damaged checkpoint
                use(copied)
        except (CirlError, LearnerError) as error:
            refused += 1
            assert len(str(error)) < 20_000, f"{name}, {file}, {seed} {number}"
        except Exception as error:
            raise AssertionError(f"{name}, {file}, {seed} {number}: {error!r}") from error
        assert time.process_time() - began < LONGEST, f"{name}, {file}, {seed} {number}"
        shutil.rmtree(copied)
    return refused


def settings(algorithm: str, **parameters: Any) -> dict[str, Any]:
    """Return a small learner."""
    normalise = {"observation": True, "reward": True}
    parameters["policy_kwargs"] = {"net_arch": [4]}
    return {"algorithm": algorithm, "parameters": parameters, "normalise": normalise}


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a run that ended in the middle of rollouts, with journals and a price that moves."""
    run = {"steps": 60, "envs": 2, "engine": "lockstep", "evaluations": 3, "episodes": 2}
    recipe = {
        "name": "stopped",
        "title": "stopped",
        "run": run | {"min_service": 0.5, "price_rate": 0.1},
        "environment": {"horizon": 5, "reward": "mixed"},
        "learner": settings("SAC", learning_starts=4, buffer_size=20, batch_size=2),
        "match": [{"agents": ["mine"], **settings("PPO", n_steps=7, batch_size=7)}],
    }
    folder = tmp_path_factory.mktemp("runs") / "stopped"

    def report(now: Any) -> None:
        if now.env_steps >= 46:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train("copper_net", Recipe.model_validate(recipe), directory=folder, agents=["mine", "use"], report=report)
    checkpoint = RunDirectory(folder).checkpoint
    assert {"mine.journal.json", "training.safetensors", "price.json"} <= {path.name for path in checkpoint.iterdir()}
    return folder


@COUNTS
@pytest.mark.slow
def test_runs(count: int, unfinished: Path, tmp_path: Path) -> None:
    """An unfinished one, its checkpoints and journals among it, is read, gone on with, evaluated and exported."""
    uses: dict[str, Use] = {
        "trained": Trained,
        "metrics": lambda path: (RunDirectory(path).metrics(), RunDirectory(path).evaluations()),
        "evaluate": lambda path: evaluate(path, episodes=2, bounds=False).write(),
        "plan": cirl_marl.plan,
        "export": lambda path: cirl_marl.export(path, tmp_path / "exported"),
    }
    use_altered(unfinished, uses, tmp_path, count)
    refused = use_altered(unfinished, {"resume": resume}, tmp_path, count, within="checkpoints/**")
    assert refused or count < 20


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (("normaliser", "rewards", "count"), {"x": 1}, "count is .* not of type float"),
        (("normaliser", "returns", "values"), [0.0], r"returns of shape \(1,\), not \(2,\)"),
        (("buffer", "pos"), "x", "pos is .* not of type int"),
        (("buffer", "full"), 1, "full is 1, not of type bool"),
        (("model", "values", "_n_updates"), {"x": 1}, "_n_updates is .* no number"),
        (("model", "action_stream", "uinteger"), 10**30, "too large"),
        (("streams", "torch"), {"x": 1}, "cannot be read"),
    ],
)
def test_numbers_of_a_learner(place: Sequence[str], value: object, said: str, unfinished: Path, tmp_path: Path) -> None:
    """Something else in the place of a number is refused in the words of the file, before anything is written."""
    shutil.copytree(unfinished, copied := tmp_path / "altered")
    file = RunDirectory(copied).checkpoint / "use.state.json"
    state = json.loads(file.read_text())
    parent = state
    for key in place[:-1]:
        parent = parent[key]
    parent[place[-1]] = value
    file.write_text(json.dumps(state))
    with pytest.raises(RunError, match=rf"use\.state.*{said}"):
        resume(copied)
    assert file.exists()


def test_noise_of_another_learner_is_refused() -> None:
    """What draws the noise of actions goes on from what it drew last, of the same shape."""
    noise = OrnsteinUhlenbeckActionNoise(np.zeros(1), np.ones(1))
    model = TD3("MlpPolicy", "Pendulum-v1", action_noise=noise, buffer_size=1, policy_kwargs={"net_arch": [4]})
    state = model_state(model)
    assert noise().any()
    set_model_state(model, state)
    assert not noise.noise_prev.any()
    state["noise"][0]["noise_prev"] = np.zeros(2)
    with pytest.raises(RunError, match=r"noise_prev has shape \(2,\), not \(1,\)"):
        set_model_state(model, state)


@COUNTS
def test_teams(count: int, tmp_path: Path) -> None:
    """Teams of environments of others."""
    team = cirl_marl.independent(Walk, partial(PPO, n_steps=8, batch_size=8), normalise=True)
    team.learn(16)
    team.save(tmp_path / "team")
    uses: dict[str, Use] = {
        "load": lambda path: Team.load(path, Walk),
        "learn": lambda path: Team.load(path, Walk).learn(16),
    }
    assert use_altered(tmp_path / "team", uses, tmp_path, count) or count < 20
    written = json.loads((tmp_path / "team" / "team.json").read_text())
    shutil.copytree(tmp_path / "team", tmp_path / "unseeded")
    (tmp_path / "unseeded" / "team.json").write_text(json.dumps({**written, "seed": -1}))
    with pytest.raises(RunError, match="seed must be a whole number of at least 0, got -1"):
        Team.load(tmp_path / "unseeded", Walk)
    (tmp_path / "unseeded" / "team.json").write_text(json.dumps({**written, "num_envs": 10**30}))
    with pytest.raises(RunError, match=r"team\.json: .*num_envs must be at most 10,000, got 1,000,000,000,000,000,000"):
        Team.load(tmp_path / "unseeded", Walk)
    (tmp_path / "outside").mkdir()
    (tmp_path / "team" / "one.json").rename(tmp_path / "outside" / "one.json")
    (tmp_path / "team" / "one.json").symlink_to(tmp_path / "outside" / "one.json")
    with pytest.raises(RunError, match="is a link"):
        Team.load(tmp_path / "team", Walk)


@COUNTS
@pytest.mark.slow
def test_sweeps(count: int, bottles: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder in which a cell is done, or still to be evaluated: what was asked for, results, bounds, progress."""
    assert bottles.source is not None
    (work := tmp_path / "work").mkdir()
    monkeypatch.chdir(work)
    (work / "bottles.toml").write_text(bottles.source.read_text())
    (work / "quick.toml").write_text(
        'name = "quick"\ntitle = "quick"\nrun = { steps = 40, envs = 2, evaluations = 1, episodes = 2 }\n'
        'environment = { horizon = 5 }\n[learner]\nalgorithm = "A2C"\n'
        "parameters = { n_steps = 5, policy_kwargs = { net_arch = [4] } }\n"
    )
    text = 'networks = ["bottles.toml"]\nrecipes = ["quick.toml"]\n[evaluation]\nepisodes = 2\n'
    (work / "sweep.toml").write_text(text)

    def watch(statuses: Sequence[CellStatus]) -> None:
        for status in statuses:
            assert f"{status.job_status.share:.0%} {status.gap or 0.0:.1%}"

    def again(path: Path) -> None:
        outcome = sweep("sweep.toml", on="here", out=path, watch=watch)
        for failure in outcome.failures:
            if failure.error is not None:
                raise failure.error
        assert [row["state"] for row in outcome.rows] == ["done"]

    again(done := tmp_path / "done")
    shutil.copytree(done, half := tmp_path / "half")
    shutil.copytree(done, empty := tmp_path / "empty")
    for result in some(list(empty.glob("cells/*/result.json"))):
        result.write_text("{}")
    with pytest.raises(RunError, match=r"result.json: says nothing of what came of a cell; delete it"):
        again(empty)
    for result in half.glob("cells/*/result.json"):
        result.unlink()
    for folder in (done, half):
        refused = use_altered(folder, {"sweep": again}, tmp_path, count)
        assert refused or count < 20


def test_plans(tmp_path: Path) -> None:
    """Tables of plans, as ``cirl explain`` and ``cirl infer`` read them."""
    network = cirl_marl.load_network("net_zero").with_options(episode={"horizon": 5})
    (tmp_path / "plans").mkdir()
    cirl_marl.plan(network, "scripted").write(tmp_path / "plans" / "plan.csv")
    uses: dict[str, Use] = {"plan": lambda path: episodes_of_plan(network, path / "plan.csv")}
    assert use_altered(tmp_path / "plans", uses, tmp_path, 12)
    os.mkfifo(tmp_path / "pipe.csv")
    for path, said in (("pipe.csv", "no such file"), ("missing.csv", "no such file"), ("plans", "no run in")):
        with pytest.raises(CirlError, match=said):
            episodes_of_plan(network, tmp_path / path)


@pytest.mark.parametrize("record", [*VALUES, {"checkpoint": "x", "sections": 3}, {"checkpoint": "x", "sections": [[]]}])
def test_reasons(record: Any, tmp_path: Path) -> None:
    """What an explanation wrote is shown with a run, or refused."""
    (tmp_path / FOLDER).mkdir()
    write_json(tmp_path / FOLDER / FILE, record)
    with pytest.raises(RunError, match="delete it, or explain the run anew"):
        read_reasons(RunDirectory(tmp_path), "x")


def test_what_never_ends_is_not_opened(unfinished: Path, tmp_path: Path) -> None:
    """A pipe in the place of a file, for which a reader would wait for ever; nor is a long log read as a whole."""
    for place in ("config.json", "checkpoints/notes", "metrics.csv"):
        shutil.copytree(unfinished, run := tmp_path / "run")
        (run / place).unlink(missing_ok=True)
        os.mkfifo(run / place)
        with pytest.raises(RunError, match="is no file but a pipe"):
            resume(run)
        shutil.rmtree(run)
    files = JobFiles(tmp_path, "a")
    with files.log.open("wb") as log:
        log.truncate(2**40)
        log.seek(2**40)
        log.write(b"\nthe pen breaks\n")
    assert last_line(files.log) == "the pen breaks"


class Walk(ParallelEnv):  # type: ignore[misc]
    """Two agents, who see the same whatever they do."""

    metadata: dict[str, Any] = {"name": "walk"}  # noqa: RUF012
    possible_agents = ["one", "two"]  # noqa: RUF012

    def observation_space(self, agent: str) -> spaces.Box:
        """Return two numbers."""
        return spaces.Box(-1, 1, (2,))

    def action_space(self, agent: str) -> spaces.Box:
        """Return one number."""
        return spaces.Box(-1, 1, (1,))

    def reset(self, seed: int | None = None, options: Any = None) -> Any:
        """Begin an episode of five steps."""
        self.agents, self._left = self.possible_agents[:], 5
        return {agent: np.zeros(2, np.float32) for agent in self.agents}, {agent: {} for agent in self.agents}

    def step(self, actions: Any) -> Any:
        """Pay 1."""
        self._left -= 1
        agents = self.agents
        self.agents = agents if self._left else []
        seen = {agent: np.full(2, 0.1, np.float32) for agent in agents}
        over = dict.fromkeys(agents, not self._left)
        return seen, dict.fromkeys(agents, 1.0), dict.fromkeys(agents, False), over, {agent: {} for agent in agents}
