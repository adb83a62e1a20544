"""The frozen benchmark: its tasks, bounds and scores; rows, their weights, and how they are checked."""

from __future__ import annotations

import csv
import hashlib
import json
from collections.abc import Iterator
from dataclasses import fields, replace
from functools import partialmethod
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from command import run
from numpy.typing import NDArray
from scipy import sparse
from some import some

import cirl_marl
from benchmarks.suite import prove
from cirl_marl import CirlError, Network, Neutral, RunError, Trained, load_task, tasks
from cirl_marl.controllers.rollout import first_seed, rollout, starting_stocks
from cirl_marl.definitions.ids import ids
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.jobs import run_jobs
from cirl_marl.learners import interface
from cirl_marl.learners.acting_weights import acting_weights, rebuild_run
from cirl_marl.learners.recipe import Recipe
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import Certificate
from cirl_marl.optimum.options import DEGREE
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.report.benchmark_tables import aggregate_cells, gap_cells, held_out_cells, save_profiles
from cirl_marl.suite import row_jobs
from cirl_marl.suite import tasks as declared
from cirl_marl.suite.result_rows import ResultRow, add_rows, is_reproduced, key_of, last_digit, read_rows, verify
from cirl_marl.suite.task_bounds import TaskBound, row_names, rows_path, values_at
from cirl_marl.suite.tasks import PACKAGE_DATA, SPREAD, algorithms, load_algorithm
from cirl_marl.suite.weights import LARGEST_FILE, read_weights, write_weights

ALL_WEIGHTS = 4_000_000
"""Bytes of all weights that come with the package, at most."""
ALL_BOUNDS = 2_000_000
TASKS_SHA256 = "fb348dff50f0c79e5789ba814895dd0f1c0624538c3e9aa2d8350c9e87ffe121"
"""Of all that suite.toml declares of version 1: who changes it makes version 2."""
TASK = "paper_city-v0"
"""A task with three agents, of which an episode takes milliseconds."""


def test_the_declaration_is_frozen() -> None:
    """Tasks, budgets, seeds, demands, bounds and learners of version 1 stay as they are."""
    document = declared._declaration()
    digest = hashlib.sha256(json.dumps(document, sort_keys=True).encode()).hexdigest()
    assert digest == TASKS_SHA256, "suite.toml has changed: rows of version 1 no longer mean what they did"


def test_there_are_enough_tasks() -> None:
    """At least eight of several agents, three of which are disturbed, with ids that exist; ten learners, ten seeds."""
    suite = [load_task(name) for name in tasks()]
    networks = [task.network() for task in suite]
    assert len(suite) >= 8
    assert all(len(network.agents) >= 2 for network in networks)
    assert sum(bool(network.disturbed) for network in networks) >= 3
    assert all(task.id in ids().values() for task in suite)
    assert len(algorithms()) == len(suite[0].seeds) == 10
    for name in algorithms():
        load_algorithm(name).recipe_of(suite[0]).check(10_000)


def test_learners_train_for_what_their_task_demands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What a training gets asks for the service of its task, of which some demand more than others."""
    suite = [load_task(name) for name in tasks()]
    assert len({task.min_service for task in suite}) > 1

    def stop(directory: Path, network: Network, recipe: Recipe, **settings: Any) -> None:
        raise RunError(f"{recipe.name} asks for {recipe.run.min_service}")

    monkeypatch.setattr(interface, "complete_run", stop)
    for task, name in zip(suite, algorithms(), strict=True):
        job = row_jobs.ResultJob(row=ResultRow(task=task.name, algorithm=name, seed=401, episodes=2), out=tmp_path)
        with pytest.raises(RunError, match=f"^{name} asks for {task.min_service}$"):
            job.run(lambda *progress: None)


@pytest.mark.parametrize("name", tasks())
def test_resets_and_rollouts_are_those_of_the_version(name: str) -> None:
    """Neutral control reaches what its row says to the last digit, against the bound of this version."""
    assert verify(ids=[f"{name}/neutral"]) == [f"{name}/neutral"], "other numbers need another version of the task"
    task = load_task(name)
    assert task.sha256
    for variant in (task, *map(task.held_out, task.variants)):
        bound = variant.bound()
        assert len(bound.values) == variant.episodes
        assert (bound.prices >= 0).all()
        assert bound.scale > 0


def test_certificates_prove_the_bounds() -> None:
    """Computed anew from the multipliers, without a solver, in every episode; draws have none of their own."""
    task = load_task(TASK)
    network, kept = task.network(), task.bound()
    assert kept.recompute(network, task.seed) == pytest.approx(kept.values, rel=1e-9)
    fresh = prove(network, 3, task.seed, task.min_service)
    assert fresh.values == pytest.approx(kept.values[:3], rel=1e-3)
    assert fresh.prices[0] > 0
    world = load_task("paper_city.breakdowns-v0")
    with pytest.raises(RunError, match="each draw of its bound has multipliers"):
        world.bound().recompute(world.network(), world.seed)
    # the price is the slope of what the same multipliers prove of another demand
    certificate = Certificate(equal=fresh.equal, under=fresh.under)
    starts = starting_stocks(MultiAgentVectorEnv(network, num_envs=1), first_seed(task.seed))
    looser = values_at(network, starts, certificate, fresh.demand - [0.01, 0.0])
    assert looser[0] - fresh.values[0] == pytest.approx(0.01 * fresh.prices[0], rel=1e-6)


def test_multipliers_are_matched_to_rows_by_name(monkeypatch: pytest.MonkeyPatch) -> None:
    """Rows may come, go if they have no multiplier, and change places; one with a multiplier is missed."""
    task = load_task(TASK)
    network, kept, plain = task.network(), task.bound(), Programs.program
    rng = np.random.default_rng(3)
    order = rng.permutation(np.flatnonzero((kept.under != 0) | (rng.random(len(kept.under)) < 0.5)))
    largest = int(np.flatnonzero(order == kept.under.argmin())[0])

    def other_rows(*args: Any, places: NDArray[np.intp]) -> Program:
        problem = plain(*args)
        under = sparse.vstack([1.5 * problem.under[[0]], problem.under[places]], format="csr")
        limits = np.append(1.5 * problem.under_to[0], problem.under_to[places])
        return replace(problem, under=under, under_to=limits)

    starts = starting_stocks(MultiAgentVectorEnv(network, num_envs=task.episodes), first_seed(task.seed))
    names = row_names(Programs(Admissible.of(network), DEGREE, None).program(starts.mean(axis=0), kept.demand))
    assert kept.rows == pytest.approx(names[kept.under != 0], rel=1e-12)
    certificate = Certificate(equal=kept.equal, under=kept.under)
    for places, same in ((order, True), (np.delete(order, largest), False)):
        monkeypatch.setattr(Programs, "program", partialmethod(other_rows, places=places))
        proved = values_at(network, starts, certificate, kept.demand, kept.rows)
        assert (proved == pytest.approx(kept.values, rel=1e-9)) == same
        assert (proved >= kept.values - 1e-9 * np.abs(kept.values)).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["aluminium_world-v0", "copper_world-v0", "steel_japan-v1"])
def test_frozen_multipliers_prove_bounds_of_idle_supplies(name: str) -> None:
    """They are of programs that had other rows."""
    task = load_task(name)
    assert task.bound().recompute(task.network(), task.seed) == pytest.approx(task.bound().values, rel=1e-9)


def test_who_does_nothing_has_no_score() -> None:
    """Nothing moved and nobody served is almost no gap, but service counts; a gap counts from 0 to 1."""
    task = load_task("copper_net-v0")
    gap = float(task.bound().gaps(np.zeros(task.episodes), np.zeros((task.episodes, 1))).mean())
    assert gap < 0.05
    assert task.score(gap, 0.0) == task.score(0.0, task.min_service - 2 * task.tolerance) == 0.0
    assert task.score(0.25, task.min_service - 0.5 * task.tolerance) == 0.75
    assert task.score(7.0, 1.0) == 0.0
    assert task.score(-0.1, 1.0) == 1.0


def test_held_out_variants_have_other_numbers() -> None:
    """Rates, demands and starts differ within the stated range, always alike; agents and arcs are the same."""
    task = load_task("copper_net-v0")
    network, variant, other = task.network(), task.held_out(1).network(), task.held_out(2).network()
    rates = np.array([(a.rate, b.rate) for a, b in zip(network.arcs, variant.arcs, strict=True) if a.rate], float)
    bands = np.array([(a.low, b.low) for a, b in zip(network.services, variant.services, strict=True)], float)
    factors = [after / before for before, after in (*rates, *bands)]
    factors += (variant.initial[network.initial > 0] / network.initial[network.initial > 0]).tolist()
    assert len(set(factors)) > 5
    assert np.abs(np.array(factors) - 1).max() <= SPREAD * (1 + 1e-9)
    assert variant == task.held_out(1).network() != other
    assert variant.agents == network.agents
    with pytest.raises(CirlError, match="held-out variants are"):
        task.held_out(4)


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Yield the folder of a benchmark with a learner's row, of a training of some seconds, and neutral control's."""
    folder, patch, budget = tmp_path_factory.mktemp("suite"), pytest.MonkeyPatch(), pytest.MonkeyPatch()
    whole = declared.SuiteAlgorithm.steps

    def few(algorithm: declared.SuiteAlgorithm, task: declared.BenchmarkTask) -> int:
        return 2 * 32 * 160 if algorithm.name == "ppo" else whole(algorithm, task)

    budget.setattr(declared.SuiteAlgorithm, "steps", few)

    def keep(run: Path) -> None:
        if run.is_dir():
            run.rename(folder / "original")

    patch.setattr(row_jobs, "shutil", SimpleNamespace(rmtree=keep))
    outcome = cirl_marl.benchmark(
        [TASK], algorithms=["neutral", "ppo"], seeds=[401], out=folder, contributor="me", held_out=True
    )
    patch.undo()
    assert not outcome.failures
    yield folder
    budget.undo()


def test_a_row_is_made_once(trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What has a row is neither trained nor evaluated again; the trained policies have rows on all variants."""
    rows = read_rows(trained / "results.csv")
    assert [key_of(row) for row in rows] == [
        (f"{TASK}/{who}", variant) for who in ("neutral", "ppo/401") for variant in range(4)
    ]
    assert {row.contributor for row in rows} == {"me"}
    assert {row.steps for row in rows} == {0, 2 * 32 * 160}
    monkeypatch.setattr(row_jobs.ResultJob, "run", lambda job, tell: pytest.fail("a row was made again"))
    again = cirl_marl.benchmark([TASK], algorithms=["neutral", "ppo"], seeds=[401], out=trained, held_out=True)
    assert list(again.rows) == rows
    assert not list((trained / "runs").iterdir())


class Killed(BaseException):
    """What no job survives."""


HALF = SimpleNamespace(value=0.5, low=0.4, high=0.6)
MEASURED = SimpleNamespace(circularity=HALF, service=HALF, gap=HALF)
"""Figures of tests of when something is measured."""


def test_kills_lose_nothing_and_double_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Wherever a benchmark is killed, the same call goes on: one training, one row, and no training is left behind."""
    trainings, options = list[Path](), {"algorithms": ["ppo"], "seeds": [401], "out": tmp_path}
    monkeypatch.setattr(declared.SuiteAlgorithm, "steps", lambda algorithm, task: 32 * 160)
    real = interface.train

    def counted(*arguments: Any, directory: Path, **settings: Any) -> Any:
        trainings.append(directory)
        return real(*arguments, directory=directory, **settings)

    def killed(*arguments: Any, **settings: Any) -> None:
        raise Killed

    def killed_in_half(path: Path) -> None:
        (path / "config.json").unlink()
        raise Killed

    monkeypatch.setattr(interface, "train", counted)
    monkeypatch.setattr(declared.BenchmarkTask, "measure", lambda *arguments, **options: MEASURED)
    for place, name in ((row_jobs, "write_weights"), (declared.BenchmarkTask, "measure"), (row_jobs, "add_rows")):
        with monkeypatch.context() as patch, pytest.raises(Killed):
            patch.setattr(place, name, killed)
            cirl_marl.benchmark([TASK], **options)  # type: ignore[arg-type]
        assert not (tmp_path / "results.csv").exists()
    with monkeypatch.context() as patch, pytest.raises(Killed):
        patch.setattr(row_jobs, "shutil", SimpleNamespace(rmtree=killed_in_half))
        cirl_marl.benchmark([TASK], **options)  # type: ignore[arg-type]
    assert trainings[0].is_dir()
    outcome = cirl_marl.benchmark([TASK], **options)  # type: ignore[arg-type]
    assert [row.id for row in outcome.rows] == [f"{TASK}/ppo/401"] and not outcome.failures
    assert list(outcome.rows) == read_rows(tmp_path / "results.csv")
    assert len(trainings) == 1 and not trainings[0].exists()


def test_policies_act_on_variants_when_there_are_some(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Several rows may be made at a time, so that those of variants are begun when the others are there."""
    monkeypatch.setattr(declared.BenchmarkTask, "measure", lambda *arguments, **options: MEASURED)
    monkeypatch.setattr(row_jobs, "run_jobs", lambda jobs, *rest, **options: run_jobs(jobs[::-1], *rest, **options))
    outcome = cirl_marl.benchmark([TASK], algorithms=["mpc"], out=tmp_path, held_out=True)
    assert not outcome.failures and [row.variant for row in outcome.rows] == [0, 1, 2, 3]
    assert len({row.sha256 for row in outcome.rows}) == 1


def test_weights_act_as_the_run_did(trained: Path, tmp_path: Path) -> None:
    """A run that is rebuilt from what acts gives the same actions to the bit, and is a run like any other."""
    policies = cirl_marl.pretrained(f"{TASK}/ppo/401", tmp_path / "run", results=trained / "results.csv")
    arrays, description = acting_weights(policies.run)
    kept, words = read_weights(trained / "weights" / TASK / "ppo-401.safetensors")
    assert {key: array.tolist() for key, array in kept.items()} == {key: a.tolist() for key, a in arrays.items()}
    assert words == description
    assert not [key for key in arrays if "value_net" in key]
    task = load_task(TASK)
    twin = Trained(rebuild_run(tmp_path / "twin", arrays, description, task.network()))
    env = task.env(2, **{**policies.run.config.options})
    first, *rest = (rollout(env, team, seed=5) for team in (Trained(trained / "original"), policies, twin))
    assert all((first.controls == again.controls).all() for again in rest)
    comparison = cirl_marl.compare([policies.run], ["neutral"], episodes=2, bounds=False)
    assert {row.name for row in comparison.rows} == {"ppo", "neutral"}
    del arrays[next(iter(arrays))]
    with pytest.raises(RunError, match="do not fit the learners"):
        rebuild_run(tmp_path / "lacking", arrays, description, task.network())


def changed(trained: Path, folder: Path, **cells: str) -> Path:
    """Return a copy of the table in which the learner's row has other cells."""
    with (trained / "results.csv").open() as file:
        header, *lines = list(csv.reader(file))
    row = next(line for line in lines if line[2] == "ppo")
    for name, text in cells.items():
        row[header.index(name)] = text
    for path in (trained / "weights").rglob("*.safetensors"):
        copy = folder / path.relative_to(trained)
        copy.parent.mkdir(parents=True, exist_ok=True)
        copy.write_bytes(path.read_bytes())
    (folder / "results.csv").write_text("\n".join(map(",".join, [header, row])) + "\n")
    return folder / "results.csv"


def altered(text: str) -> str:
    """Return a number whose last digit differs by 2 or more; by 1 both may be right where a digit is about to turn."""
    return text[:-1] + str((int(text[-1]) + 2) % 10)


@pytest.mark.parametrize("column", ["circularity", "service", "gap_high"])
def test_a_changed_digit_is_found(trained: Path, tmp_path: Path, column: str) -> None:
    """A rerun of the policy gives every digit of its row, and no other."""
    (row,) = (row for row in read_rows(trained / "results.csv") if row.algorithm == "ppo" and not row.variant)
    assert verify(trained / "results.csv", [row.id]) == [row.id]
    stated = next(csv.DictReader(changed(trained, tmp_path).read_text().splitlines()))[column]
    table = changed(trained, tmp_path, **{column: altered(stated)})
    with pytest.raises(RunError, match=f"row '{row.id}': {column} is {altered(stated)}, a rerun gives {stated}"):
        verify(table)


BAD: dict[str, tuple[dict[str, str], str]] = {
    "weights elsewhere": (
        {"weights": "weights/none.safetensors"},
        r"row '.*/ppo/401': its weights are missing: .*none",
    ),
    "no weights": ({"weights": ""}, "names no weights"),
    "another hash": ({"sha256": "0" * 64}, r"has another SHA-256, \w+, than the row, 0000"),
    "unknown task": ({"task": "paper_cty-v0"}, r"row 2: unknown task .*Did you mean 'paper_city-v0'"),
    "no number": ({"gap": "small"}, "row 2: gap 'small' is no number"),
    "infinite": ({"gap": "inf"}, "row 2: gap is inf"),
    "no variant": ({"variant": "9"}, "results.csv: row 2: task .* held-out variants are"),
    "no episodes": ({"episodes": "0"}, "row 2: episodes must be a whole number of at least 1, got 0"),
    "too many episodes": ({"episodes": "99"}, r"row '.*/ppo/401': task .* has 64 episodes, got episodes 99"),
    "negative seed": ({"seed": "-1"}, "row 2: seed must be"),
    "another seed": ({"seed": "402"}, r"row '.*/ppo/402': seed is 402, but that of the policies 401"),
    "other steps": ({"steps": "7"}, r"row '.*/ppo/401': steps is 7, but that of the policies 10240"),
    "another algorithm": ({"algorithm": "sac"}, r"row '.*/sac/401': algorithm is sac, but that of the policies ppo"),
    "out of the folder": ({"weights": "../a.safetensors"}, r"row 2: weights '\.\./a\.safetensors' are not below the"),
    "anywhere": ({"weights": "/any/a.safetensors"}, "row 2: weights '/any/a.safetensors' are not below the folder"),
    "nobody": ({"algorithm": " "}, "row 2: algorithm is empty; name one of the suite, or your own"),
    "a seed of nobody": ({"algorithm": "neutral"}, "row 2: seed 401: 'neutral' is not trained; leave it empty"),
    "steps of nobody": ({"algorithm": "neutral", "seed": ""}, "row 2: steps 10240: 'neutral' is not trained; write 0"),
    "only a variant": ({"variant": "1"}, "has no rows but those of held-out variants to rerun"),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_rows_are_named(trained: Path, tmp_path: Path, case: str) -> None:
    """File, row and value stand in the message."""
    cells, message = BAD[case]
    table = changed(trained, tmp_path, **cells)
    with pytest.raises(CirlError, match=message):
        verify(table)


def test_rows_of_other_names_have_other_budgets(trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """An algorithm of the suite has the steps of the suite; a name of one's own, as many as were made."""
    monkeypatch.setattr(declared.SuiteAlgorithm, "steps", lambda algorithm, task: 5 * 160)
    with pytest.raises(RunError, match=r"row '.*/ppo/401': steps are 10,240, where 'ppo' has 800: give it"):
        verify(changed(trained, tmp_path))
    assert verify(changed(trained, tmp_path, algorithm="mine")) == [f"{TASK}/mine/401"]


@pytest.mark.parametrize("repeated", ["tasks", "algorithms", "seeds"])
def test_what_is_asked_for_twice_is_named_before_anything_is_done(tmp_path: Path, repeated: str) -> None:
    """Nothing is left behind."""
    asked: dict[str, Any] = {"tasks": [TASK], "algorithms": ["ppo"], "seeds": [401]}
    asked[repeated] *= 2
    with pytest.raises(CirlError, match=f"{repeated.removesuffix('s')} {asked[repeated][0]} is given more than once"):
        cirl_marl.benchmark(asked.pop("tasks"), **asked, out=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_bad_tables_and_files_are_named(trained: Path, tmp_path: Path) -> None:
    """A table that is none, a row that is there twice, weights that are none or too large, unknown ids."""
    table = changed(trained, tmp_path)
    weights = tmp_path / "weights" / TASK / "ppo-401.safetensors"
    weights.write_bytes(b"nothing")
    (row,) = read_rows(table)
    with pytest.raises(RunError, match="is not the file of row"):
        cirl_marl.pretrained(row.id, results=table)
    add_rows(table, [replace(row, sha256=hashlib.sha256(b"nothing").hexdigest())])
    with pytest.raises(RunError, match="is no file of weights"):
        verify(table)
    with pytest.raises(CirlError, match=f"unknown policy .*Did you mean '{row.id}'"):
        cirl_marl.pretrained(f"{TASK}/ppo/402", results=table)
    with pytest.raises(CirlError, match="unknown row"):
        verify(table, [f"{TASK}/ppo/402"])
    table.write_text(table.read_text() + table.read_text().splitlines()[1] + "\n")
    with pytest.raises(RunError, match=r"row 3: 'paper_city-v0/ppo/401', variant 0, is there already"):
        read_rows(table)
    table.write_text("a,b\n1,2\n")
    with pytest.raises(RunError, match="has the columns a, b"):
        read_rows(table)
    table.write_text("")
    with pytest.raises(RunError, match="has the columns ; a table of results has task, variant"):
        read_rows(table)
    add_rows(tmp_path / "marked.csv", [row])
    marked = (tmp_path / "marked.csv").read_bytes()
    (tmp_path / "marked.csv").write_bytes(b"\xef\xbb\xbf" + marked)
    assert read_rows(tmp_path / "marked.csv") == [row]
    with pytest.raises(RunError, match="no such table"):
        read_rows(tmp_path / "none.csv")
    with pytest.raises(RunError, match="take smaller policies"):
        write_weights(tmp_path / "large.safetensors", {"a": np.zeros(LARGEST_FILE)}, {})
    with pytest.raises(CirlError, match=r"unknown algorithm 'pppo'. Did you mean 'ppo'"):
        cirl_marl.benchmark([TASK], algorithms=["pppo"], out=tmp_path)
    with pytest.raises(CirlError, match="unknown task"):
        load_task("copper_nt-v0")
    assert last_digit("0.00310") == pytest.approx(1e-5)


def test_no_two_files_of_weights_are_alike(tmp_path: Path) -> None:
    """What checks the wheel refuses files that are the same, also where a planner has nothing to keep."""
    hashes = {
        name: write_weights(tmp_path / name, {}, row_jobs._mpc_settings(load_task(name)))
        for name in (TASK, "aluminium_world-v0")
    }
    assert len(set(hashes.values())) == 2
    kept = [row.sha256 for row in read_rows() if row.sha256 and not row.variant]
    assert len(set(kept)) == len(kept) > 20


def test_what_is_kept_is_whole_and_small() -> None:
    """Every kept row has the weights that it names and no file is nobody's; all of it is small."""
    rows = read_rows()
    files = {
        path.relative_to(PACKAGE_DATA).as_posix(): path
        for path in (PACKAGE_DATA / "weights").rglob("*")
        if path.is_file()
    }
    assert set(files) == {row.weights for row in some(rows) if row.weights}
    assert {row.algorithm for row in rows if not row.weights} == {"neutral"}
    for row in rows:
        if row.weights:
            assert hashlib.sha256(files[row.weights].read_bytes()).hexdigest() == row.sha256
    assert max(path.stat().st_size for path in files.values()) <= LARGEST_FILE
    assert sum(path.stat().st_size for path in files.values()) <= ALL_WEIGHTS
    assert sum(path.stat().st_size for path in (PACKAGE_DATA / "bounds").iterdir()) <= ALL_BOUNDS
    for algorithm in ("neutral", "best_constant"):
        assert {row.task for row in rows if row.algorithm == algorithm} == set(tasks())
    bounds = {task.bound_path for name in tasks() for task in [load_task(name)]}
    bounds |= {task.held_out(k).bound_path for task in map(load_task, tasks()) for k in task.variants}
    assert {*(PACKAGE_DATA / "bounds").iterdir()} == bounds | {
        rows_path(path) for path in bounds if len(TaskBound.read(path).equal)
    }


@pytest.mark.slow
@pytest.mark.parametrize("row", ["steel_japan-v1/mpc", "car_batteries.adoption-v0/mpc", "paper_city-v0/best_schedule"])
def test_rows_of_controllers_are_still_what_they_do(row: str) -> None:
    """Plans depend on every box of their programs, down to the digits that rows have."""
    assert verify(ids=[row]) == [row]


def test_reruns_of_plans_may_end_at_another_optimum() -> None:
    """Of MPC, whose programs may have several, and by no more than that."""
    row = next(row for row in read_rows() if row.id == "steel_japan-v1/mpc")
    other = replace(row, algorithm="best_schedule")
    near, far = row.circularity * (1 + 1e-4), row.circularity * (1 + 5e-4)
    for each in (row, other):
        assert is_reproduced(each, "circularity", row.circularity) and not is_reproduced(each, "circularity", far)
    assert is_reproduced(row, "circularity", near) and not is_reproduced(other, "circularity", near)


def test_pretrained_policies_come_with_the_package() -> None:
    """A kept policy acts in its task as its row says, and no learner is far below the bound unnoticed."""
    (id_,) = verify(ids=[f"{TASK}/exact_gradients/401"])
    policies = cirl_marl.pretrained(id_)
    assert isinstance(policies, Trained)
    assert policies.run.config.network == "paper_city"
    assert load_task(TASK).measure(policies, episodes=4).gap.value < 0.02


def made_up(task: str, algorithm: str, seed: int | None, gap: float, **more: float) -> ResultRow:
    """Return a row with a gap."""
    figures = {"circularity": -1.0, "service": 1.0, "gap_low": gap, "gap_high": gap} | more
    return ResultRow(task=task, algorithm=algorithm, seed=seed, episodes=4, gap=gap, **figures)  # type: ignore[arg-type]


def test_tables_say_what_rows_do(tmp_path: Path) -> None:
    """Gaps by task, missed services marked; figures over all tasks of those alone that have rows on all of them."""
    rows = [made_up(name, "ppo", seed, 0.25 * (seed - 400)) for name in tasks() for seed in (401, 402)]
    rows += [made_up(TASK, "a2c", 401, 0.5), made_up(TASK, "mpc", None, 0.1, service=0.5)]
    headings, body = gap_cells(rows)
    assert headings == ["task", "mpc", "ppo", "a2c"]
    assert dict(zip(headings, body[tasks().index(TASK)], strict=True)) == {
        "task": f"`{TASK}`", "mpc": "10.0% (missed)", "ppo": "37.5%", "a2c": "50.0%",
    }  # fmt: skip
    (row,) = aggregate_cells(rows)[1]
    assert row[:2] == ["ppo", "2"]
    assert row[4].startswith("0.625")
    transferred = [replace(row, variant=1, gap=row.gap + 0.1) for row in rows if row.algorithm == "ppo"]
    assert held_out_cells([*rows, *transferred])[1] == [["ppo", "20", "0.625", "0.525", "100%"]]
    assert save_profiles(tmp_path / "profiles.png", rows).stat().st_size > 5_000


def test_commands(
    trained: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command line makes rows, shows them, and verifies them."""
    table, mine = str(trained / "results.csv"), str(tmp_path / "mine")
    assert run(monkeypatch, "benchmark", "verify", table, "--held-out") == 0
    assert f"as stated: {TASK}/ppo/401" in capsys.readouterr().out
    assert run(monkeypatch, "benchmark", "table", table) == 0
    assert "gap to the bound" in capsys.readouterr().out
    assert run(monkeypatch, "benchmark", "table", table, "--out", str(tmp_path / "profiles.png")) == 2
    assert "nobody has rows on every task" in capsys.readouterr().err
    assert run(monkeypatch, "benchmark", "run", TASK, "--algorithm", "neutral", "--out", mine, "--on", "here") == 0
    assert f"{TASK}/neutral: λ̄" in capsys.readouterr().out
    for seeds in ("one", ""):
        assert run(monkeypatch, "benchmark", "run", TASK, "--seeds", seeds) == 2
    assert "must be whole numbers" in capsys.readouterr().err


def test_measure_takes_policies_of_ones_own() -> None:
    """Whatever ``rollout`` takes can be held against the bound of a task."""
    figures = load_task(TASK).measure(Neutral(), episodes=3)
    assert figures.gap.value > 0
    assert 0 < figures.service.value <= 1


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"horizon": 3}, "has no bound of other episodes: horizon 3, not 91"),
        ({"scenario": "breakdowns"}, "has no bound of other episodes: scenario 'breakdowns', not 'default'"),
        ({"episodes": 65}, "has 64 episodes, got episodes 65"),
        ({"episodes": 0}, "episodes must be a whole number of at least 1"),
    ],
)
def test_a_bound_is_held_against_its_episodes_alone(options: dict[str, Any], message: str) -> None:
    """Others, of which it proves nothing, are refused."""
    with pytest.raises(CirlError, match=message):
        load_task(TASK).measure(Neutral(), **{"episodes": 2, **options})


def test_weights_are_measured_in_the_episodes_of_the_task(trained: Path, tmp_path: Path) -> None:
    """However long those were in which they learnt; schedules of other agents are refused."""
    table = changed(trained, tmp_path)
    (row,) = read_rows(table)
    arrays, description = read_weights(tmp_path / row.weights)
    description["config"]["options"] |= {"horizon": 3, "circularity_weight": 0.5}
    add_rows(table, [replace(row, sha256=write_weights(tmp_path / row.weights, arrays, description))])
    assert verify(table) == [row.id]
    sha256 = write_weights(tmp_path / row.weights, {"actions": np.zeros((1, 4), dtype=np.float32)}, {})
    add_rows(table, [replace(row, sha256=sha256)])
    with pytest.raises(RunError, match=rf"row '{row.id}': a schedule of \S+ has shape \(steps, 3\), got \(1, 4\)"):
        verify(table)


def test_a_bound_of_draws_is_one_file(tmp_path: Path) -> None:
    """It has no multipliers whose rows had names; a certificate without its names is refused."""
    for name, files in (("paper_city.breakdowns-v0", 1), ("paper_city-v0", 2)):
        bound, path = TaskBound.read(load_task(name).bound_path), tmp_path / name / "bound.npz"
        path.parent.mkdir()
        bound.write(path)
        assert len([*path.parent.iterdir()]) == files
        again = TaskBound.read(path)
        for field in fields(TaskBound):
            np.testing.assert_array_equal(getattr(again, field.name), getattr(bound, field.name))
    rows_path(path).unlink()
    with pytest.raises(RunError, match=r"bound\.rows\.npz: is not the bound of a task"):
        TaskBound.read(path)
