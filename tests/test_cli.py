"""The command line, in process: what it prints, what it writes, how it fails."""

from __future__ import annotations

import csv
import json
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import highspy
import numpy as np
import pytest
from command import SOURCE, bottles, guide, run
from pages import shown
from some import some

import cirl_marl
from cirl_marl import MultiAgentVectorEnv, cli
from cirl_marl.cli import demonstration
from cirl_marl.controllers.rollout import episode_start, first_seed
from cirl_marl.definitions.catalogue import folder
from cirl_marl.evaluation.assessment import evaluate
from cirl_marl.learners import interface
from cirl_marl.learners.interface import train
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.optimum import search_each
from cirl_marl.report import presentation as pictures
from cirl_marl.report import trajectory
from cirl_marl.report.curves import save_trajectory

pytestmark = pytest.mark.usefixtures("elsewhere")


@pytest.fixture(scope="module")
def trained(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a short training run in the small network of the guide."""
    folder_ = tmp_path_factory.mktemp("trained")
    (folder_ / "bottles.toml").write_text(guide())
    train(folder_ / "bottles.toml", "independent_a2c", directory=folder_ / "run", steps=320, envs=8)
    return folder_ / "run"


def test_networks_and_show(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """The catalogue is listed; a network's tables, λ and picture appear."""
    assert run(monkeypatch, "networks") == 0
    listed = capsys.readouterr().out
    assert cirl_marl.load_network("copper_net").title.endswith("collection draws on copper in use, not on discards")
    assert all(word in listed for word in ("copper_net", "steel_* (30 regions)", "Solids: a", "independent_ppo"))
    assert run(monkeypatch, "networks", "--all") == 0
    listed = capsys.readouterr().out
    assert all(name in listed for name in cirl_marl.networks())
    assert run(monkeypatch, "show", "copper_net") == 0
    shown = capsys.readouterr().out
    assert "λ of the start state: -93.6 kt" in shown
    assert all(word in shown for word in ("mine_to_refinery", "nonrenewable_reservoir", "copper_in_use"))
    assert Path("copper_net.png").read_bytes().startswith(b"\x89PNG")


def test_a_stopped_training_says_what_is_saved(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """All of it after one Ctrl-C, the last checkpoint after two, nothing before the first."""
    shutil.copytree(trained, "run")
    kept = RunDirectory("run")

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(interface, "train", stop)
    checkpoint = kept.status["checkpoint"]
    for state, name, said in (
        ("interrupted", checkpoint, "everything learnt is saved. Go on with: cirl train --resume run"),
        ("running", checkpoint, "what was learnt in the first 320 steps is saved. Go on with"),
        ("running", None, "nothing was learnt yet that could be saved"),
    ):
        kept.set_status(state, 0 if name is None else 40, name)
        assert run(monkeypatch, "train", "copper_net", "--out", "run") == 130
        assert said in " ".join(capsys.readouterr().out.split())


@pytest.mark.medium
def test_short_trainings_say_that_there_are_no_curves(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """No empty picture is drawn, and the number of steps that would do is given."""
    Path("bottles.toml").write_text(guide(days=60))
    training = "train bottles.toml --recipe independent_a2c --steps 640 --out run --episodes 2"
    assert run(monkeypatch, *training.split()) == 0
    assert "no learning curves, as no episode ended: 32 copies need 1,920 steps" in capsys.readouterr().out
    assert {path.name for path in Path("run/pictures").iterdir()} == {"flows_before_after.png", "circularity.png"}
    monkeypatch.setattr(sys, "argv", [])
    assert run(monkeypatch, "plan", "run") == 0
    assert Path("plan_run.csv").is_file()
    assert run(monkeypatch, "evaluate", "rum", "--episodes", "2") == 2
    assert "Did you mean 'run'?" in capsys.readouterr().err


@pytest.mark.medium
@pytest.mark.parametrize("control", ["neutral", "random", "constant"])
def test_simulate_writes_csv_and_picture(control: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Every interval is a row with λ, service, stocks and flows; the mean of λ is that of the mean flows beside it."""
    drawn: list[np.ndarray] = []

    def recorded(*arguments: Any, **options: Any) -> Path:
        drawn.append(arguments[1].rollout.circularity_mean[0])
        return save_trajectory(*arguments, **options)

    monkeypatch.setattr(trajectory, "save_trajectory", recorded)
    extra = ["--set", "mine=-0.5"] if control == "constant" else []
    assert run(monkeypatch, "simulate", "copper_net", "--control", control, "--steps", "7", "--out", "out", *extra) == 0
    with Path(f"out/copper_net_{control}.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 1 + 7, "the start and the end of every interval"
    assert [float(row["time (day)"]) for row in rows] == [0.25 * i for i in range(8)]
    stocks = [name for name in rows[0] if name.startswith("stock of")]
    masses = [sum(float(row[name]) for name in stocks) for row in rows]
    np.testing.assert_allclose(masses, masses[0], rtol=1e-12)
    assert {"circularity at the end (kt)", "service level", "stock of use (kt)"} <= set(rows[0])
    mean = [float(row["mean circularity (kt)"]) for row in rows[1:]]
    counted = [f"flow of {arc} (kt/day)" for arc in ("mine_to_refinery", "use_to_landfill")]
    np.testing.assert_allclose(mean, [-sum(float(row[name]) for name in counted) for row in rows[1:]], rtol=1e-12)
    assert Path(f"out/copper_net_{control}.png").is_file()
    np.testing.assert_allclose(drawn[0], mean, rtol=1e-12, err_msg="λ in the picture is that of the flows above it")


@pytest.mark.medium
def test_train_evaluate_report(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A run is trained, evaluated on fresh seeds, drawn, and evaluated again."""
    bottles()
    arguments = ["--steps", "6000", "--envs", "32", "--seed", "3", "--out", "run", "--episodes", "4"]
    assert run(monkeypatch, "train", "bottles.toml", *arguments) == 0
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("environment steps/s", "trained", "neutral", "random", "gain over neutral"))
    for name in ("evaluation.json", "metrics.csv", "config.json", "versions.json"):
        assert Path("run", name).is_file()
    pictures = {path.name for path in Path("run/pictures").iterdir()}
    assert pictures == {"flows_before_after.png", "circularity.png", "learning_curves.png"}
    assert run(monkeypatch, "evaluate", "run", "--episodes", "4", "--seed", "7") == 0
    printed = capsys.readouterr().out
    assert "local return of each agent" in printed and "gap to bound" in printed
    assert run(monkeypatch, "report", "run", "--episodes", "4", "--html", "pages/run.html") == 0
    told = shown(Path("pages/run.html").read_text(encoding="utf-8"))
    names = [scene["name"] for scene in told["scenes"]]
    assert names == ["business as usual", "trained, exact gradients", "plan of the bound"]
    assert told["scenes"][1]["figures"]["gap"][0] > 0 and "mean of 4 episodes" in told["scenes"][1]["about"]


@pytest.mark.medium
def test_demo_trains_compares_and_opens_its_report(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Where there is a display, unless it is told not to; a second call trains nothing, another run is refused."""
    bottles()
    opened: list[str] = []

    def open_(uri: str) -> bool:
        opened.append(uri)
        return True

    monkeypatch.setattr("webbrowser.open", open_)
    monkeypatch.setattr(demonstration, "NETWORK", "bottles.toml")
    monkeypatch.setattr(demonstration, "COMPARISON_EPISODES", 4)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    monkeypatch.delenv("DISPLAY", raising=False)
    assert run(monkeypatch, "demo", "--steps", "2000") == 0
    page = Path("runs/demo/report.html").resolve()
    said = f"report: {page} (open it in a browser; it needs no server)"
    assert said in " ".join(capsys.readouterr().out.split()) and opened == []
    names = [scene["name"] for scene in shown(page.read_text(encoding="utf-8"))["scenes"]]
    assert names == ["business as usual", "trained, exact gradients", "plan of the bound"]
    steps = RunDirectory(Path("runs/demo")).status["joint_steps"]
    monkeypatch.setenv("DISPLAY", ":0")
    assert run(monkeypatch, "demo") == 0
    printed = capsys.readouterr().out
    assert opened == [page.as_uri()] and "open it in a browser" not in printed
    assert "runs/demo is trained already" in printed
    assert RunDirectory(Path("runs/demo")).status["joint_steps"] == steps
    assert run(monkeypatch, "demo", "--no-open") == 0
    assert len(opened) == 1 and "open it in a browser" in capsys.readouterr().out
    monkeypatch.setattr(demonstration, "NETWORK", "copper_net")
    assert run(monkeypatch, "demo") == 2
    assert "is a run of exact_gradients in bottles, not of the demo" in " ".join(capsys.readouterr().err.split())


def test_demo_stopped_says_what_is_kept(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Ctrl-C ends it with 130."""

    def stop(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("cirl_marl.learners.interface.complete_run", stop)
    assert run(monkeypatch, "demo") == 130
    assert "stopped; nothing was learnt yet" in capsys.readouterr().out


@pytest.mark.medium
def test_ctrl_c_before_a_command_begins(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ends it with 130, and without a traceback."""

    def interrupted() -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(cli, "app", interrupted)
    assert run(monkeypatch, "networks") == 130


def test_plan_and_compare(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A controller's plan has units in its columns; a comparison without runs writes its four files."""
    bottles()
    asked = ("--control", "neutral", "--out", "plan.csv", "--html", "plan.html")
    assert run(monkeypatch, "plan", "bottles.toml", *asked) == 0
    told = shown(Path("plan.html").read_text(encoding="utf-8"))
    assert [scene["name"] for scene in told["scenes"]] == ["business as usual", "neutral"]
    header, *rows = Path("plan.csv").read_text().splitlines()
    assert header.startswith("from (day),to (day),")
    assert len(rows) == 7
    short_net_zero(8)
    assert run(monkeypatch, "compare", "--network", "short.toml", "--controllers", "random", "--episodes", "2",
               "--out", "out", "--html", "compared.html") == 0  # fmt: skip
    told = shown(Path("compared.html").read_text(encoding="utf-8"))
    assert [scene["name"] for scene in told["scenes"]] == ["business as usual", "random"]
    assert any("no bound is proved" in note for note in told["notes"])
    printed = capsys.readouterr().out
    assert "gap to bound: network 'net_zero'" in printed
    assert "no bound is proved" in printed
    assert sorted(path.name for path in Path("out").iterdir()) == [
        "comparison.png",
        "episodes.csv",
        "summary.csv",
        "summary.json",
    ]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--controllers", "mcp"], "unknown control 'mcp'. Did you mean 'mpc'"),
        (["--controllers", "mpc", "--futures", "3"], "futures 3: only scenario_mpc plans for them"),
        (["--episodes", "8"], "--bound-draws 20 is the number of episodes: leave out --episodes 8"),
        (["--tune", "4", "--min-service", "0.9"], "tune 4: too few draws"),
        (["--network", "carbo_net"], "network 'carbo_net': unknown scenario 'adoption'"),
    ],
)
def test_what_cannot_be_compared_waits_for_no_bound(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A bound of draws takes minutes."""
    monkeypatch.setattr("cirl_marl.optimum.bound", None)
    place = ("--network", "car_batteries", "--scenario", "adoption", "--bound-draws", "20")
    assert run(monkeypatch, "compare", *place, *arguments) == 2
    assert message in " ".join(capsys.readouterr().err.split())


def test_only_draws_of_a_bound_are_proved_elsewhere(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Without them a place is an error, not ignored."""
    assert run(monkeypatch, "compare", "--network", "car_batteries", "--on", "local") == 2
    assert "only draws of --bound-draws are proved elsewhere" in " ".join(capsys.readouterr().err.split())


@pytest.mark.medium
def test_pareto(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Both fronts are printed, tabulated and drawn in one picture; the runs stay."""
    bottles()
    asked = ("--recipe", "independent_a2c", "--points", "2", "--steps", "320", "--episodes", "2", "--out", "out")
    assert run(monkeypatch, "pareto", "bottles.toml", *asked, "--html", "front.html") == 0
    told = shown(Path("front.html").read_text(encoding="utf-8"))
    assert {point["name"] for point in told["points"]} == {"plans", "trained", "business as usual"}
    assert {point["name"] for point in told["points"] if point["about"]} == {"trained"}
    assert len(told["front"]) > 2
    with Path("out/pareto.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["kind"] == "trained"]
    assert [float(row["circularity weight"]) for row in rows] == [0.0, 1.0]
    points = [(point["service"], point["lambda"]) for point in told["points"] if point["name"] == "trained"]
    figures = [(float(row["least service level"]), float(row["circularity (t)"])) for row in rows]
    np.testing.assert_allclose(figures, points, rtol=1e-5)
    printed = capsys.readouterr().out
    assert all(word in printed for word in ("bound    service", "plan     service", "(weight 1, seed 0)"))
    assert {path.name for path in Path("out").iterdir()} == {"pareto.csv", "pareto.json", "pareto.png", "runs"}


@pytest.mark.medium
def test_runs_that_do_not_fit(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A run of another network, a plan of a run under a controller, a recipe of other agents: nothing is written."""
    bottles()
    options = ("--recipe", "independent_a2c", "--steps", "320", "--envs", "8", "--episodes", "2", "--out", "run")
    assert run(monkeypatch, "train", "bottles.toml", "--agents", "quarry", "--countdown", *options) == 0
    config = json.loads(Path("run/config.json").read_text())
    assert config["agents"] == ["quarry"] and config["options"]["countdown"] is True
    assert run(monkeypatch, "plan", "run", "--out", "plan.csv") == 0
    assert Path("plan.csv").read_text().startswith("from (day),to (day),quarry: valve factor (1),")
    assert run(monkeypatch, "compare", "run", "--episodes", "2", "--out", "compared") == 0
    capsys.readouterr()
    recipe = (folder("agents") / "independent_a2c.toml").read_text()
    Path("recipe.toml").write_text(f'{recipe}\n[[match]]\nagents = ["quary"]\nalgorithm = "PPO"\n')
    before = some({path: path.stat().st_mtime_ns for path in Path().rglob("*")})
    for arguments, message in (
        (["compare", "run", "--network", "copper_net", "--out", "new"], "network 'bottles', not 'copper_net'"),
        (["compare", "run", "run", "--out", "new"], "the same recipe and seed 0"),
        (["plan", "run", "--control", "mpc", "--out", "new.csv"], "leave out --control"),
        (["plan", "run", "--scenario", "crisis", "--out", "new.csv"], "a run has its own scenario"),
        (["plan", "run", "--no-smooth", "--out", "new.csv"], "--no-smooth go with --control optimum"),
        (["pareto", "bottles.toml", "--recipe", "recipe.toml", "--out", "new"], "Did you mean 'quarry'?"),
        (["train", "bottles.toml", "--recipe", "recipe.toml", "--out", "new"], "Did you mean 'quarry'?"),
        (["compare", "run", "--out", "recipe.toml"], "is a file, not a folder"),
    ):
        assert run(monkeypatch, *arguments) == 2
        assert message in capsys.readouterr().err
    assert {path: path.stat().st_mtime_ns for path in Path().rglob("*")} == before


def test_infeasible_plan(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """A service that nobody can deliver is said to be out of reach, with the most that can be had; no file is left."""
    bottles(**{"low = { value = 95": "low = { value = 500"})
    asked = ("plan", "bottles.toml", "--control", "optimum", "--min-service", "0.9", "--out", "p.csv")
    assert run(monkeypatch, *asked) == 2
    assert "no actions reach a mean service level of 0.9 of 'bottles_in_use' (at most 0." in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["bottles.toml"]


def short_net_zero(intervals: int) -> None:
    """Write ``short.toml``, the network of the catalogue of which nothing is proved, with a shorter episode."""
    text = (folder("envs") / "net_zero.toml").read_text(encoding="utf-8")
    Path("short.toml").write_text(
        text.replace("horizon = { value = 120", f"horizon = {{ value = {intervals}"), encoding="utf-8"
    )


@pytest.mark.slow
def test_plan_shows_how_far_the_search_is(monkeypatch: pytest.MonkeyPatch) -> None:
    """The bar of ``cirl plan`` moves while the best plan is searched for, not only while it is carried out."""
    shares: list[float] = []

    @contextmanager
    def bar(what: str) -> Iterator[Callable[[float], None]]:
        yield shares.append

    monkeypatch.setattr("cirl_marl.cli.common.bar", bar)
    monkeypatch.setattr("cirl_marl.optimum.open_loop.search_each", partial(search_each, population=8, iterations=2))
    short_net_zero(24)
    assert run(monkeypatch, "plan", "short.toml", "--control", "optimum", "--out", "p.csv") == 0
    searching = [share for share in shares if share < 0.99]
    assert 3 * 20 < len(searching) < 3 * 100 and shares == sorted(shares) and shares[-1] == 1.0


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> Callable[[int], None]:
    """Return what makes HiGHS run out of time once it has been asked so many times."""

    def fail(after: int) -> None:
        left = after

        class Hurried(highspy.Highs):
            def __init__(self) -> None:
                nonlocal left
                super().__init__()  # type: ignore[no-untyped-call]
                left -= 1
                if left < 0:
                    self.setOptionValue("time_limit", 0.0)

        monkeypatch.setattr("cirl_marl.optimum.solver.highspy.Highs", Hurried)

    return fail


@pytest.mark.parametrize(
    ("arguments", "solved", "what"),
    [
        (["evaluate", "run", "--episodes", "2"], 0, "the program of the bound with a mean service level of 0."),
        (["compare", "run", "--controllers", "random", "--episodes", "2"], 0, "the program of the bound"),
        (["compare", "run", "--episodes", "2", "--out", "new"], 0, "the program of the bound with a mean service"),
        (["compare", "run", "--controllers", "mpc", "--episodes", "2"], 1, "the program of the bound with a mean"),
        (["compare", "run", "--controllers", "optimum", "--episodes", "2"], 0, "the program of the bound"),
        (["plan", "bottles.toml", "--control", "optimum", "--out", "p.csv"], 0, "with a service weight of 1000"),
        (
            ["plan", "bottles.toml", "--control", "mpc", "--out", "p.csv"],
            4,
            "the program of MPC for decisions 56 to 59",
        ),
        (["pareto", "bottles.toml", "--recipe", "quick.toml", "--points", "2", "--out", "new"], 0, "service weight of"),
    ],
)
@pytest.mark.medium
@pytest.mark.sample(3)
def test_solver_that_fails(
    arguments: list[str],
    solved: int,
    what: str,
    failing: Callable[[int], None],
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    trained: Path,
) -> None:
    """There is no bound, with network, program and the solver's status; all other figures are there."""
    Path("bottles.toml").write_text(guide(days=60))
    Path("quick.toml").write_text(
        'name = "quick"\ntitle = "quick"\nrun = { steps = 120, envs = 1 }\n'
        'learner = { algorithm = "A2C", parameters = { n_steps = 60 } }\n'
    )
    shutil.copytree(trained, "run")
    failing(solved)
    assert run(monkeypatch, *arguments) == 0
    said = " ".join(capsys.readouterr().out.split())
    assert "network 'bottles': HiGHS did not solve" in said
    assert what in said and "Time limit reached" in said
    assert "service" in said


@pytest.mark.slow
def test_terminals_that_write_no_greek() -> None:
    """In a locale without λ it becomes a question mark; without any output the exit code says it all."""
    bottles()
    Path("bottles.toml").write_bytes(b"\xef\xbb\xbf" + Path("bottles.toml").read_bytes())  # as some editors begin
    command = [sys.executable, "-m", "cirl_marl.cli", "show", "bottles.toml"]
    places = {"PYTHONPATH": os.pathsep.join(sys.path), "PYTHONIOENCODING": "ascii"}
    screen = subprocess.run(command, env=os.environ | places, capture_output=True, check=True)
    assert b"\n? of the start state: -" in screen.stdout
    silent = [sys.executable, "-c", f"import os; os.close(1); os.execv({command[0]!r}, {command!r})"]
    assert subprocess.run(silent, env=os.environ | places, check=True, stderr=subprocess.PIPE).stderr == b""


def test_nothing_else_than_a_bound_was_asked_for(
    failing: Callable[[int], None], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Then a solver that fails is an error, and nothing is written."""
    Path("bottles.toml").write_text(guide(days=60))
    failing(4)
    assert run(monkeypatch, "pareto", "bottles.toml", "--out", "new") == 2
    assert "error: network 'bottles': HiGHS did not solve the program of the bound" in capsys.readouterr().err
    assert [path.name for path in Path().iterdir()] == ["bottles.toml"]


def test_improvement_that_fails(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    """Where no program improves a plan, it stays the plan of the bound."""
    Path("bottles.toml").write_text(guide(days=60))
    monkeypatch.setattr("cirl_marl.optimum.improve.best_values", lambda *_: None)
    assert run(monkeypatch, "plan", "bottles.toml", "--control", "optimum", "--out", "p.csv") == 0
    assert "service level" in capsys.readouterr().out and Path("p.csv").is_file()


@pytest.mark.slow
def test_scenarios_write_files_of_their_own(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names carry network, scenario and control, of a simulation as of a plan; what is demanded has a unit."""
    monkeypatch.chdir(tmp_path)
    for command in ("simulate", "plan"):
        for scenario in ((), ("--scenario", "paper")):
            assert run(monkeypatch, command, "carbo_net", "--control", "neutral", *scenario) == 0
    for scenario in ((), ("--scenario", "paper")):
        assert run(monkeypatch, "show", "carbo_net", *scenario) == 0
    assert "outflow of heaters at least 510 t/day" in capsys.readouterr().out
    names = {path.name for path in tmp_path.iterdir()}
    stems = ("carbo_net_neutral", "carbo_net_paper_neutral")
    plans = {f"plan_{stem}.{kind}" for stem in stems for kind in ("csv", "xlsx", "png")}
    assert names == plans | {f"{stem}.csv" for stem in stems} | {
        f"{stem}.png" for stem in (*stems, "carbo_net", "carbo_net_paper")
    }


@pytest.mark.medium
def test_sweeps_of_scenarios_have_folders_of_their_own(monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep of a scenario leaves that of the default one where it is."""
    bottles()
    for scenario in ((), ("--scenario", "crisis")):
        assert run(monkeypatch, "pareto", "bottles.toml", "--points", "2", "--episodes", "2", *scenario) == 0
    assert {path.name for path in Path("runs").iterdir()} == {"pareto-bottles", "pareto-bottles_crisis"}


@pytest.mark.parametrize("network", ["bottles.toml", pytest.param("net_zero", marks=pytest.mark.slow)])
def test_show_simulate_and_plan_start_alike(
    network: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """In the middle of all ranges, or with a seed at the first start of its evaluation; each says which."""
    bottles()
    found = cirl_marl.load_network(network)
    for seed, said in (
        ((), "start: the middle of all initial ranges"),
        (("--seed", "2"), "start: the first episode of evaluation 2"),
    ):
        env = MultiAgentVectorEnv(found, num_envs=1)
        episode_start(env, 2 if seed else None).reset(env)
        started = env.state()[0, : len(found.nodes)]
        if seed:
            env.reset(seed=first_seed(2))
            np.testing.assert_array_equal(env.state()[0, : len(found.nodes)], started)
        else:
            np.testing.assert_allclose(started, found.initial.mean(axis=0))
        figures = []
        for command in (("show",), ("simulate",), ("plan", "--control", "neutral", "--out", "plan.csv")):
            name, *options = command
            assert run(monkeypatch, name, network, *options, *seed) == 0
            printed = capsys.readouterr().out
            assert said in printed.splitlines()
            figures += re.findall(r"^λ̄ = (\S+)", printed, re.MULTILINE)
        assert len(figures) == 2 and figures[0] == figures[1]
        with Path(f"{found.name}_neutral.csv").open(newline="") as file:
            first = next(csv.DictReader(file))
        stocks = [float(value) for name, value in first.items() if name.startswith("stock of")]
        np.testing.assert_allclose(stocks, started, rtol=1e-12)


def test_flows_that_are_cut_are_said(
    trained: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A source that is too small shows in the output of every run, though the service is all there."""
    Path("bottles.toml").write_text(guide() + SOURCE)
    for command in ("simulate", "plan"):
        assert run(monkeypatch, command, "bottles.toml", "--control", "neutral") == 0
        printed = capsys.readouterr().out
        assert "service level 1.0000" in printed
        said = "arc 'imports' moved 40 t (57.1%) less than asked for, first at 3 day: 'world' held too little"
        assert said in printed.splitlines()
    Path("bottles.toml").write_text(guide() + SOURCE.replace("30", "1e6"))
    assert run(monkeypatch, "simulate", "bottles.toml") == 0
    assert "less than asked for" not in capsys.readouterr().out
    options = ("--recipe", "independent_a2c", "--steps", "320", "--envs", "8", "--episodes", "2", "--out", "run")
    Path("bottles.toml").write_text(guide() + SOURCE)
    assert run(monkeypatch, "train", "bottles.toml", *options) == 0
    assert f"neutral: {said}" in capsys.readouterr().out.splitlines()
    assert run(monkeypatch, "evaluate", "run", "--episodes", "2") == 0
    assert f"neutral: {said}" in capsys.readouterr().out.splitlines()


def test_pictures_of_a_run_show_mean_circularity(trained: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """λ beside mean flows is that of these flows, and the curve is of the means that λ̄ is the mean of."""
    drawn: dict[str, tuple[Any, ...]] = {}
    for name in ("save_before_after", "save_circularity"):

        def record(path: Path, *arguments: Any, name: str = name, title: str = "") -> Path:
            drawn[name] = *arguments, title
            return path

        monkeypatch.setattr(pictures, name, record)
    shutil.copytree(trained, "run")
    evaluation = evaluate("run", episodes=2, bounds=False)
    pictures.draw_run(evaluation)
    network, before, after, _, shown, _ = drawn["save_before_after"]
    assert shown == pytest.approx([float(network.circularity(flow)) for _, flow in (before, after)], rel=1e-9)
    for name, rollout in drawn["save_circularity"][1].items():
        assert rollout.episode_circularity.mean() == pytest.approx(
            evaluation.figures["controllers"][name]["circularity"]["value"], rel=1e-12
        )
    pictures.draw("x.png", evaluation, title="a heading")
    assert drawn["save_circularity"][-1] == "a heading"


@pytest.mark.medium
def test_simulate_with_inner_physics(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The CSV holds masses on the way and what an agent may see of inner states; the regulator runs where it can."""
    monkeypatch.chdir(tmp_path)
    held = ("simulate", "solids_net", "--control", "scripted", "--set", "sorter=0", "--steps", "40")
    assert run(monkeypatch, *held) == 0
    figures = re.findall(r"(λ̄ =|time-window circularity) (\S+) kg", capsys.readouterr().out)
    assert float(figures[1][1]) == pytest.approx(2 * 0.1 * float(figures[0][1]), rel=1e-3)
    header, *rows = (tmp_path / "solids_net_scripted.csv").read_text().splitlines()
    assert len(rows) == 1 + 40
    columns = header.split(",")
    assert "mass on first_use (kg)" in columns
    assert "truck.position_m" in columns
    assert not any("mujoco" in column for column in columns)
    assert run(monkeypatch, "simulate", "carbo_net", "--scenario", "paper", "--control", "lqr", "--steps", "5") == 0


@pytest.mark.medium
@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["show", "coper_net"], "unknown network 'coper_net'. Did you mean 'copper_net'?"),
        (["show", "copper_net", "--scenario", "papr"], "unknown scenario 'papr'. Did you mean 'paper'?"),
        (["train", "copper_net", "--recipe", "independent_pp"], "Did you mean 'independent_ppo'?"),
        (["train", "copper_net", "--agents", "mine, ues"], "Did you mean 'use'?"),
        (["train", "copper_net", "--reward", "mixd"], "unknown reward 'mixd'. Did you mean 'mixed'?"),
        (["train"], "train needs NETWORK, or --resume RUN"),
        (["train", "--resume", "nowhere"], "no run in nowhere (it has no config.json)"),
        (["train", "--resume", "nowhere", "--envs", "5", "--seed", "1"], "leave out --envs, --seed"),
        (["show", "copper_net", "--picture", "picture.pdf"], "needs the name of a .png file"),
        (["evaluate", "nowhere"], "no run in nowhere (it has no config.json)"),
        (["report", "nowhere", "--html", "page.html"], "no run in nowhere (it has no config.json)"),
        (["report", "nowhere", "--html", "page.pdf"], "--html page.pdf: needs the name of an .html file"),
        (["simulate", "copper_net", "--html", "/dev/null/page.html"], "/dev/null is a file, not a folder"),
        (["simulate", "copper_net", "--out", "/dev/null/new"], "/dev/null is a file, not a folder"),
        (["compare", "--network", "copper_net", "--out", "/dev/null/new"], "/dev/null is a file, not a folder"),
        (["pareto", "copper_net", "--out", "/dev/null/new"], "/dev/null is a file, not a folder"),
        (["plan", "copper_net", "--control", "neutral", "--html", "page"], "needs the name of an .html file"),
        (["compare", "--network", "copper_net", "--html", "/.html"], "needs the name of an .html file"),
        (["pareto", "copper_net", "--html", "page.htm"], "needs the name of an .html file"),
        (["simulate", "copper_net", "--control", "nutral"], "Did you mean 'neutral'?"),
        (["simulate", "copper_net", "--control", "constant", "--set", "mien=0"], "Did you mean 'mine'?"),
        (["simulate", "copper_net", "--control", "constant", "--set", "mine=nan"], "must lie in [-1, 1]"),
        (["simulate", "copper_net", "--set", "mine=0"], "goes with --control constant"),
        (["simulate", "copper_net", "--control", "lqr"], "rate controls multiply flows"),
        (["plan", "copper_net", "--out", "p.csv"], "which control?"),
        (["plan", "copper_net", "--control", "mcp", "--out", "p.csv"], "Did you mean 'mpc'?"),
        (["plan", "copper_net", "--control", "lqr", "--out", "p.csv"], "rate controls multiply flows"),
        (["plan", "net_zero", "--control", "mpc", "--out", "p.csv"], "no bound is proved"),
        (["plan", "copper_net", "--control", "neutral", "--out", "p.txt"], "needs the name of a .csv file"),
        (["plan", "copper_net", "--control", "neutral", "--min-service", "1", "--out", "p.csv"], "goes with mpc"),
        (["plan", "nowhere", "--out", "p.csv"], "no run in nowhere (it has no config.json)"),
        (["pareto", "net_zero", "--out", "new"], "no bound is proved"),
        (["pareto", "coper_net", "--out", "new"], "Did you mean 'copper_net'?"),
        (["compare"], "give a training run or a network"),
        (["compare", "nowhere"], "no run in nowhere (it has no config.json)"),
        (["compare", "--network", "coper_net"], "Did you mean 'copper_net'?"),
        (["compare", "--network", "copper_net", "--controllers", "mcp"], "Did you mean 'mpc'?"),
        (
            ["compare", "--network", "copper_net", "--controllers", "lqr", "--out", "new"],
            "rate controls multiply flows",
        ),
        (["compare", "--network", "net_zero", "--controllers", "lqr", "--out", "new"], "is no linear system"),
        (["compare", "--network", "net_zero", "--controllers", "mpc", "--out", "new"], "no bound is proved"),
        (["compare", "nowhere", "--scenario", "paper"], "goes with a network; runs have their own"),
        (["paper", "CoperNet"], "unknown environment of the paper 'CoperNet'. Did you mean 'CopperNet'?"),
        (["paper", "CopperNet", "A2"], "unknown algorithm of the paper 'A2'. Did you mean 'A2C'?"),
        (["paper", "CopperNet", "SAC-HER"], "did not run SAC-HER on CopperNet; it ran A2C, ARS, DDPG, PPO, SAC"),
        (["paper", "CopperNet", "--recipe", "tund"], "unknown settings 'tund'. Did you mean 'tuned'?"),
    ],
)
def test_bad_input_ends_with_code_2(
    arguments: list[str], message: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The message names what is wrong and what would be right; nothing is written."""
    assert run(monkeypatch, *arguments) == 2
    assert message in capsys.readouterr().err
    assert list(Path().iterdir()) == []


def test_words_in_the_help_are_those_that_are_taken(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """They are written out so that help is quick; the version is that of the package."""
    from cirl_marl.cli import common
    from cirl_marl.network.elements import OBSERVE, REWARDS
    from cirl_marl.optimum.registry import CONTROLLERS

    words = {common.CONTROLLERS: CONTROLLERS, common.REWARDS: REWARDS, common.OBSERVE: OBSERVE}
    assert {text: tuple(text.split(", ")) for text in words} == words
    assert run(monkeypatch, "--version") == 0
    assert capsys.readouterr().out == f"cirl_marl {cirl_marl.__version__}\n"
