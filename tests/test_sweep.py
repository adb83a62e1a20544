"""Sweeps: what is multiplied out, named by its content, done once, killed at will, and held to the bound."""

from __future__ import annotations

import csv
import json
import os
import random
import re
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from some import some
from test_exact_resumption import files
from test_jobs import is_alive, wait_until

from cirl_marl import cli, load_network
from cirl_marl.errors import CirlError, DefinitionError, RunError
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.pareto import pareto_front
from cirl_marl.evaluation.statistics import over_episodes
from cirl_marl.jobs import JobStatus
from cirl_marl.learners.interface import train
from cirl_marl.network import Network
from cirl_marl.sweeps import Cell, CellStatus, load_sweep, sweep
from cirl_marl.sweeps.cells import cells_of
from cirl_marl.sweeps.folder import SweepFolder
from cirl_marl.sweeps.reading import SweepFile, SweepOptions

RECIPE = """
name = "{name}"
title = "{name}"
run = {{ steps = 160, envs = 2, evaluations = 2, episodes = 2 }}
environment = {{ horizon = 5 }}
learner = {{ algorithm = "{algorithm}", parameters = {{ n_steps = {n_steps}, policy_kwargs = {{ net_arch = [4] }} }} }}
"""
SWEEP = """
networks = ["bottles.toml"]
recipes = ["quick.toml"]
seeds = [0, 1]

[options]
circularity_weight = [0.2, 0.8]

[evaluation]
episodes = 2
bounds = false
"""


@pytest.fixture
def asked(tmp_path: Path, bottles: Network, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return the file of a sweep of four cells, in the working directory, with what it names beside it."""
    assert bottles.source is not None
    (tmp_path / "bottles.toml").write_text(bottles.source.read_text())
    (tmp_path / "quick.toml").write_text(RECIPE.format(name="quick", algorithm="A2C", n_steps=5))
    (tmp_path / "sweep.toml").write_text(SWEEP)
    monkeypatch.chdir(tmp_path)
    return Path("sweep.toml")


def changed(file: Path, old: str, new: str) -> Path:
    """Return the sweep file with another text in it."""
    text = file.read_text()
    assert old in text
    file.write_text(text.replace(old, new))
    return file


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("networks =", "network =", "network: unknown key 'network'. Did you mean 'networks'?"),
        ('"bottles.toml"', '"coper_net"', "networks: unknown network 'coper_net'. Did you mean 'copper_net'?"),
        ('"bottles.toml"', '"nowhere.toml"', "nowhere.toml: no such file"),
        ('"bottles.toml"', '"bottles.toml", "bottles.toml"', "networks: lists 'bottles.toml' twice"),
        ("[options]", "[options]\nenvs = [1, true]", "options.envs, entry 2: must be a whole number, got True"),
        ('"quick.toml"', '"independent_aars"', "recipes: unknown recipe 'independent_aars'. Did you mean 'independ"),
        ('"quick.toml"', '""', "recipes: unknown recipe ''"),
        ("seeds = [0, 1]", "seeds = []", "seeds: lists nothing"),
        ("seeds = [0, 1]", "seeds = [0.5]", "seeds, entry 1: must be a whole number, got 0.5"),
        (
            "seeds =",
            'scenarios = ["crises"]\nseeds =',
            "network 'bottles': unknown scenario 'crises'. Did you mean 'crisis'? Known: default, crisis.",
        ),
        ("circularity_weight", "circularity_wait", "options.circularity_wait: unknown key 'circularity_wait'. Did you"),
        ("[0.2, 0.8]", "[0.2, 1.8]", "options.circularity_weight, entry 2: must be at most 1, got 1.8"),
        (
            "[options]",
            '[options]\nreward = "teem"',
            "options.reward, entry 1: unknown value 'teem'. Did you mean 'team'?",
        ),
        ("episodes = 2", "episode = 2", "evaluation.episode: unknown key 'episode'. Did you mean 'episodes'?"),
        ("seeds = [0, 1]", "seeds = [0, 1", "not valid TOML"),
    ],
)
def test_mistakes_are_named(asked: Path, old: str, new: str, message: str) -> None:
    """Each with its key, its value and the nearest valid one, and nothing is written."""
    with pytest.raises(DefinitionError, match=re.escape(message)):
        sweep(changed(asked, old, new), on="here")
    assert not Path("runs").exists()


def test_mistakes_of_all_kinds_are_named_together(asked: Path) -> None:
    """Those of the file, and those in what it names, whose own mistakes are named, too."""
    changed(Path("quick.toml"), "A2C", "A2D")
    changed(changed(asked, "episodes = 2", "episodes = 1"), '"bottles.toml"', '"coper_net"')
    with pytest.raises(DefinitionError) as raised:
        sweep(asked, on="here")
    assert [each.partition(":")[0] for each in raised.value.problems] == ["evaluation.episodes", "networks", "recipes"]
    assert "Did you mean 'A2C'?" in str(raised.value)


def test_what_cannot_be_trained_is_refused_before_anything_is(asked: Path) -> None:
    """An agent that the network does not have, in a recipe that is sound by itself."""
    changed(Path("quick.toml"), "learner =", 'match = [{ agents = ["quarri"], algorithm = "A2C" }]\nlearner =')
    with pytest.raises(CirlError, match=r"unknown agent 'quarri'\. Did you mean 'quarry'"):
        sweep(asked, on="here")
    climbing = SweepFile(networks=["bottles.toml"], options=SweepOptions(reward=["team", "local"]))
    with pytest.raises(CirlError, match="engine gradients: reward 'local'"):
        cells_of(climbing)
    assert not Path("runs").exists()


def test_a_place_that_cannot_be_is_refused_before_anything_is_written(
    asked: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The exit code is 2."""
    for arguments, said in (
        (("--on", "slrm"), "unknown place 'slrm'. Did you mean 'slurm'?"),
        (
            ("--slurm", "slurm_partition=long"),
            "--slurm slurm_partition=long: goes with --on slurm, not with --on local",
        ),
        (("--on", "slurm", "--slurm", "long"), "--slurm long: needs NAME=VALUE"),
    ):
        assert command(monkeypatch, "sweep", str(asked), *arguments) == 2
        assert said in capsys.readouterr().err
    with pytest.raises(CirlError, match="unknown place 'slrm'"):
        pareto_front("bottles.toml", "quick.toml", directory=Path("runs"), on="slrm")
    assert not Path("runs").exists()


def names(file: Path) -> list[str]:
    """Return the names of all cells."""
    return [cell.name for cell in cells_of(load_sweep(file))]


def test_cells_are_named_by_their_content(asked: Path) -> None:
    """What changes a result changes the name, in files that are read too; the same in other words does not."""
    first = names(asked)
    assert len(set(first)) == 4
    assert [re.sub(r"-\w{12}$", "", name) for name in first] == ["bottles-default-quick-seed0"] * 2 + [
        "bottles-default-quick-seed1"
    ] * 2
    changed(asked, "[options]", "[options]\nsteps = 160\nhorizon = 5")
    changed(asked, "seeds = [0, 1]", 'scenarios = "default"\nseeds = [1, 0]')
    assert sorted(names(asked)) == sorted(first)
    changed(asked, "episodes = 2", "episodes = 3")
    assert sorted(names(asked)) == sorted(first)
    for file, old, new in (
        (asked, "steps = 160", "steps = 320"),
        (asked, 'scenarios = "default"', 'scenarios = "crisis"'),
        (Path("quick.toml"), "n_steps = 5", "n_steps = 10"),
        (Path("bottles.toml"), "0.05", "0.06"),
    ):
        before = set(names(asked))
        changed(file, old, new)
        assert not before & set(names(asked)), (old, new)


@pytest.mark.medium
def test_a_cell_is_a_training_and_its_evaluation(asked: Path) -> None:
    """With the bits of ``train`` and the figures of ``compare``; who watches sees steps and the gap to the bound."""
    changed(changed(asked, "seeds = [0, 1]", "seeds = 1"), "[0.2, 0.8]", "0.2")
    changed(changed(asked, "bounds = false", "bounds = true"), "[options]", "[options]\ncountdown = true")
    seen: list[CellStatus] = []
    found = sweep(asked, on="here", watch=lambda statuses: seen.extend(statuses))
    (row,) = found.rows
    run = found.folder / "cells" / row["cell"] / "run"
    train("bottles.toml", "quick.toml", directory="alone", seed=1, circularity_weight=0.2, countdown=True)
    assert files(run) == files(Path("alone"))
    entry = compare([run], ["neutral"], episodes=2).entries[0]
    assert entry.run is not None and entry.gap is not None
    gap = over_episodes(entry.gap, (0.0, float("inf")))
    assert [row["gap"], row["gap_low"], row["gap_high"]] == pytest.approx([gap.value, gap.low, gap.high])
    assert row["circularity"] == pytest.approx(entry.circularity.mean())
    assert row["service"] == pytest.approx(entry.service.mean())
    assert (row["unit"], row["circularity_weight"], row["steps"], row["no_bound"]) == ("t", 0.2, 160, None)
    assert row["countdown"] is True
    assert seen[-1].job_status.state == "done" and seen[-1].gap == pytest.approx(gap.value)
    with (found.folder / "sweep.csv").open(newline="") as file:
        (kept,) = csv.DictReader(file)
    assert kept == {key: "" if value is None else str(value) for key, value in row.items()}


def test_gaps_are_shown_while_cells_train(asked: Path) -> None:
    """That of the best policies so far, to a bound for the middle of the initial ranges."""
    from cirl_marl.optimum import bound
    from cirl_marl.sweeps.running import FrontJob

    cell = cells_of(load_sweep(asked))[0]
    front = FrontJob.of(cell, Path("bounds"))
    assert front.gap({"circularity": -1.0, "service": 0.5}) is None
    front.run(lambda *_: None)
    network = load_network("bottles.toml").with_options(episode={"horizon": 5})
    proved = bound(network, min_service=0.5).objective
    assert front.gap({}) is None
    assert front.gap({"circularity": proved, "service": 0.5}) == pytest.approx(0.0, abs=0.05)
    worse = front.gap({"circularity": proved - abs(proved), "service": 0.5})
    assert worse is not None and 0.9 < worse < 1.1
    other = FrontJob.of(replace(cell, options=(("horizon", 6),)), Path("bounds"))
    assert other.name != front.name and not other.is_done()


@pytest.mark.medium
def test_only_what_is_missing_is_done(asked: Path) -> None:
    """A sweep may grow; each cell is trained once, and the table has all of them."""
    first = sweep(asked, on="here")
    assert [row["state"] for row in first.rows] == ["done"] * 4
    stamps = {path: path.stat().st_mtime_ns for path in first.folder.rglob("status.json")}
    assert len(stamps) == 4
    again = sweep(asked, on="here")
    assert again.rows == first.rows
    grown = sweep(changed(asked, "[0, 1]", "[0, 1, 2]"), on="here")
    assert len(grown.rows) == 6
    assert grown.rows[:4] == first.rows
    now = {path: path.stat().st_mtime_ns for path in first.folder.rglob("status.json")}
    assert len(now) == 6 and now | stamps == now


def test_another_sweep_in_the_folder_is_refused(asked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With what differs, and nothing of the first is touched; a folder of something else is no place, either."""
    monkeypatch.setattr("cirl_marl.sweeps.running.run_jobs", lambda *_, **__: [])
    sweep(asked, on="here", out="out")
    before = some({path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()})
    for old, new, said in (
        ("[0.2, 0.8]", "[0.2, 0.9]", r"options.circularity_weight: \[0.2, 0.9\], there \[0.2, 0.8\]"),
        ("[0.2, 0.9]", "0.2", r"options.circularity_weight: \[0.2\], there \[0.2, 0.8\]\), of which 2 of 4 cells are"),
        ("0.2", "[0.2, 0.8]\nsteps = 320", r"options.steps: \[320\], there null"),
        ("steps = 320", "steps = 160", ""),
        ("episodes = 2", "episodes = 3", r"evaluation.episodes: 3, there 2"),
    ):
        changed(asked, old, new)
        if said:
            with pytest.raises(RunError, match=rf"out: holds another sweep \(.*{said}"):
                sweep(asked, on="here", out="out")
            assert {path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()} == before
        else:
            sweep(asked, on="here", out="out")
            before = some({path: path.read_bytes() for path in Path("out").rglob("*") if path.is_file()})
    changed(Path("bottles.toml"), "0.05", "0.06")
    with pytest.raises(RunError, match=r"definitions.bottles, default: "):
        sweep(asked, on="here", out="out")
    Path("else").mkdir()
    Path("else", "notes.txt").write_text("mine")
    with pytest.raises(RunError, match=r"else: holds something else than a sweep \(notes.txt\)"):
        sweep(asked, on="here", out="else")
    assert [path.name for path in Path("else").iterdir()] == ["notes.txt"]


@pytest.mark.medium
def test_a_cell_that_fails_is_named_and_the_others_go_on(
    asked: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The exit code is 1, the table says which is missing, and the same command does it."""
    real = train

    def failing(*arguments: Any, **options: Any) -> Any:
        if (options["seed"], options["circularity_weight"]) == (0, 0.8):
            raise MemoryError("no room")
        return real(*arguments, **options)

    monkeypatch.setattr("cirl_marl.learners.interface.train", failing)
    assert command(monkeypatch, "sweep", "sweep.toml", "--on", "here", "--json") == 1
    printed = capsys.readouterr()
    rows = json.loads(printed.out)
    missing = rows[1]["cell"]
    assert [row["state"] for row in rows] == ["done", "missing", "done", "done"]
    assert f"failed: {missing}: MemoryError: no room" in printed.err
    assert "3 of 4 cells done" in printed.err
    monkeypatch.setattr("cirl_marl.learners.interface.train", real)
    assert command(monkeypatch, "sweep", "sweep.toml", "--on", "here") == 0
    shown = capsys.readouterr().out
    assert f"done: {missing}" in shown and "4 of 4 cells done; table: runs/sweep-sweep/sweep.csv" in shown


def test_a_sweep_that_was_killed_while_it_was_begun_is_begun(asked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What was being written then, by this machine or another that is at it, is nothing else than a sweep."""
    monkeypatch.setattr("cirl_marl.sweeps.running.run_jobs", lambda *_, **__: [])
    Path("out").mkdir()
    for name in (f".partial-{0:08x}-1-0.json", ".asked.lock"):
        Path("out", name).touch()
    assert len(sweep(asked, on="here", out="out").rows) == 4


def test_the_table_of_two_that_share_a_folder_has_the_results_of_both(
    asked: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Who ends while another writes its table waits, and writes one in which nothing is missing."""
    monkeypatch.setattr("cirl_marl.sweeps.running.run_jobs", lambda *_, **__: [])
    first = sweep(asked, on="here", out="out")
    folder, others = SweepFolder(Path("out")), list[threading.Thread]()
    real, cell = SweepFolder.rows, folder.cell(first.rows[0]["cell"])

    def rows(self: SweepFolder) -> list[dict[str, Any]]:
        seen = real(self)
        if not others:
            (cell / "result.json").write_text('{"unit": "t"}')
            others.append(threading.Thread(target=SweepFolder(Path("out")).write_table))
            others[0].start()
            others[0].join(timeout=0.3)
        return seen

    monkeypatch.setattr(SweepFolder, "rows", rows)
    folder.write_table()
    others[0].join()
    with folder.table.open(newline="") as file:
        assert [row["state"] for row in csv.DictReader(file)] == ["done"] + ["missing"] * 3


def test_a_network_that_is_edited_meanwhile_is_noticed(asked: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A folder that is named by a content holds this content."""

    def edit(jobs: Any, *_: Any, **__: Any) -> list[Any]:
        changed(Path("bottles.toml"), "0.05", "0.06")
        with pytest.raises(RunError, match=r"bottles.toml: was edited while the sweep was running; start the sweep"):
            jobs[-1].run(lambda *_: None)
        return []

    monkeypatch.setattr("cirl_marl.sweeps.running.run_jobs", edit)
    assert [row["state"] for row in sweep(asked, on="here").rows] == ["missing"] * 4


def command(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run ``cirl`` and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["cirl", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


def test_the_live_table_says_who_is_how_far(asked: Path) -> None:
    """Those at work first; gaps of those that are not done are only about right."""
    from rich.console import Console

    from cirl_marl.cli.sweeping import ROWS, share_done, table_of

    cell = cells_of(load_sweep(asked))[0]
    training = {"what": "training", "done": 80, "total": 160}
    statuses = [
        cell_status(cell, "first", "waiting", {}, None),
        cell_status(cell, "second", "done", {"what": "done"}, 0.25),
        cell_status(cell, "third", "elsewhere", {"what": "evaluating", "done": 0.5}, 0.3),
        cell_status(cell, "fourth", "running", training, 0.5),
    ]
    printer = Console(width=100)
    with printer.capture() as shown:
        printer.print(table_of(statuses))
    title, *lines = [line.strip() for line in shown.get().splitlines()]
    assert title == "1 running, 1 elsewhere, 1 waiting, 1 done"
    rows = [[part.strip() for part in line.strip("│").split("│")] for line in lines if line.startswith("│")]
    assert rows == [
        ["fourth", "running training", "80 of 160", "~50.0%"],
        ["third", "elsewhere evaluating", "160 of 160", "~30.0%"],
        ["first", "waiting", "", ""],
        ["second", "done", "160 of 160", "25.0%"],
    ]
    assert table_of(statuses[:1] * (ROWS + 1)).row_count == ROWS + 1
    assert [share_done(each) for each in statuses] == [0.0, 1.0, 1.0, 0.5]
    assert str(table_of(statuses, 90.2).title).endswith("; about 0:01:30 left")


def test_the_example_is_the_one_of_the_guide() -> None:
    """The file that the page shows is the one that its command names, but for how long it evaluates."""
    root = Path(__file__).parent.parent
    example = root / "examples" / "sweep.toml"
    shown = (root / "docs" / "sweeps.md").read_text().split("```toml\n")[1].split("```")[0]
    assert shown in example.read_text()
    asked = load_sweep(example)
    assert (asked.networks, asked.seeds, asked.options.circularity_weight) == (["copper_net"], [0, 1], [0.5, 0.9])


def cell_status(cell: Cell, name: str, state: Any, figures: dict[str, Any], gap: float | None) -> CellStatus:
    """Return how far a cell is."""
    return CellStatus(cell, JobStatus(name, state, figures), gap)


def outcome(folder: Path) -> dict[str, Any]:
    """Return all that a sweep has found: results, and every file of the runs that is no time."""
    found: dict[str, Any] = {}
    for cell in sorted((folder / "cells").iterdir()):
        found[cell.name] = files(cell / "run"), json.loads((cell / "result.json").read_text())
    return found


def training(folder: Path) -> list[int]:
    """Return the processes in which cells are being trained."""
    told = [json.loads(path.read_text()) for path in (folder / "jobs").glob("[!.]*.json")]
    return [each["pid"] for each in told if each["what"] == "training" and is_alive(each["pid"])]


@pytest.mark.slow
@pytest.mark.skipif(sys.platform == "win32", reason="Windows has no SIGKILL")
def test_kills_change_nothing(asked: Path) -> None:
    """Workers and drivers are killed while they train, two drivers at once; the policies end with the same bits."""
    draw, kills, saved = random.Random(7), {"worker": 0, "driver": 0}, 0
    changed(asked, "[options]", "[options]\nsteps = 10_000")
    environment = os.environ | {"PYTHONPATH": str(Path(__file__).parent.parent), "OMP_NUM_THREADS": "1"}
    line = [sys.executable, "-m", "cirl_marl.cli", "sweep", "sweep.toml", "--checkpoint-every", "0.05", "--out"]
    subprocess.run([*line, "whole", "--workers", "2"], check=True, env=environment, capture_output=True)

    def begin() -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [*line, "killed", "--workers", "1"], env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )

    drivers = [begin(), begin()]
    for victim in ("worker", "driver") * 4:
        wait_until(lambda: training(Path("killed")) or len(list(Path("killed").glob("cells/*/result.json"))) == 4)
        time.sleep(draw.uniform(0.0, 1.5))
        working = training(Path("killed"))
        if victim == "worker" and working:
            os.kill(draw.choice(working), signal.SIGKILL)
            kills[victim] += 1
        elif victim == "driver":
            chosen = draw.choice(drivers)
            kills[victim] += chosen.poll() is None
            chosen.kill()
            chosen.wait()
        saved += any(Path("killed").glob("cells/*/run/checkpoints/*-[ri][un]*"))
        drivers = [begin() if each.poll() is not None else each for each in drivers]
    for driver in drivers:
        driver.wait()
    done = subprocess.run([*line, "killed"], check=False, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert min(kills.values()) >= 2 and saved, (kills, saved)
    assert outcome(Path("killed")) == outcome(Path("whole"))


def test_without_recipes_each_network_has_its_default() -> None:
    """Exact gradients where there are derivatives, else random search; what is named counts for all."""
    file = SweepFile(networks=["copper_net", "net_zero"], seeds=[0, 1])
    found = [(cell.network, cell.recipe.name, cell.seed) for cell in cells_of(file)]
    recipes = {"copper_net": "exact_gradients", "net_zero": "independent_ars"}
    assert found == [(network, recipes[network], seed) for seed in (0, 1) for network in recipes]
    scenarios = SweepFile(networks=["copper_net"], scenarios=["default", "paper"])
    assert [cell.recipe.name for cell in cells_of(scenarios)] == ["exact_gradients", "independent_ars"]
    named = SweepFile(networks=["copper_net", "net_zero"], recipes=["mappo", "shared_ppo"])
    assert [cell.recipe.name for cell in cells_of(named)] == ["mappo", "shared_ppo"] * 2
