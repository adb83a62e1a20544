"""The study and the paper's tables: what counts as done, and that a trial leaves what is published alone."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest
import typer
from some import some
from test_uncertain_bound import works

from benchmarks import critics, foresight, paper, study, uncertain
from benchmarks.document import table_rows, write_sections
from cirl_marl import MultiAgentVectorEnv, compare, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.lqr import LinearSystem
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.environments.state import Interval
from cirl_marl.errors import CirlError
from cirl_marl.jobs import run_jobs
from cirl_marl.network import Floats
from cirl_marl.optimum import Sampling
from cirl_marl.optimum.uncertain_bound import UncertainBound

pytestmark = pytest.mark.medium

ROOT = Path(__file__).parent.parent


@pytest.mark.slow
def test_done_is_what_answers_the_same_question(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Runs are made again if their seeds, options, recipe or network are no longer those of the study."""
    options = (("steps", 320), ("reward", "team"))
    job = study.Job("copper_net", "independent_a2c", (0, 1), options, tmp_path / "run")
    assert not job.is_done()
    assert run_jobs([job], tmp_path / "jobs") == []
    assert job.is_done()
    stamps = some({path: path.stat().st_mtime_ns for path in tmp_path.rglob("status.json")})
    assert [run.config.seed for run in job.runs] == [0, 1]
    assert run_jobs([job], tmp_path / "jobs") == []
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("status.json")} == stamps
    assert not replace(job, seeds=(0, 1, 2)).is_done()
    assert not replace(job, options=(("steps", 640), ("reward", "team"))).is_done()
    assert not replace(job, options=options[:1]).is_done()
    assert not replace(job, recipe="independent_ppo").is_done()
    shorter = load_network("copper_net").with_options(episode={"horizon": 3})
    monkeypatch.setattr(study, "load_network", lambda name: shorter)
    assert not job.is_done()


@pytest.mark.slow
def test_a_trial_writes_a_document_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer recipes, seeds or steps than the study has change nothing that is published."""
    case = study.Case(("joint_ppo",), episodes=2, options={"horizon": 8})
    monkeypatch.setitem(study.CASES, "carbo_net", case)
    published = {path: path.read_bytes() for path in (ROOT / "docs" / "study.md", *study.RESULTS.rglob("*.json"))}
    study.main(out=tmp_path, only=["carbo_net"], recipes=["joint_ppo"], seeds=1, steps=320, episodes=2, jobs=1)
    assert all(path.read_bytes() == text for path, text in published.items())
    assert "| joint_ppo | PPO | joint | team | 320 |" in (tmp_path / "trial" / "study.md").read_text()
    names = [cells[0] for cells in table_rows(tmp_path / "trial" / "study.md", "carbo_net")]
    assert names == ["random", "neutral", "joint_ppo"]
    summary = json.loads((tmp_path / "trial" / "results" / "carbo_net" / "summary.json").read_text())
    assert sorted(row["name"] for row in summary["rows"]) == sorted(names)
    assert (tmp_path / "trial" / "pictures" / "study_carbo_net.png").is_file()


def test_rows_of_lqr_name_its_set_points() -> None:
    """Those that it was given, or else the definition's, of every stock that it regulates."""
    rows = (ROOT / "docs" / "study.md").read_text(encoding="utf-8").splitlines()
    for name, agent, given in study.LQR_CASES:
        network = load_network(name)
        states = LinearSystem.of(network, [agent]).states
        own = {node.id: node.set_point for node in network.nodes if node.id in states and node.set_point is not None}
        wanted = ", ".join(f"{node} {value:g} {network.mass_unit}" for node, value in (given or own).items())
        assert sum(row.startswith(f"| {name} | {agent} | lqr | {wanted} |") for row in rows) == 1


@pytest.mark.slow
def test_rows_of_the_paper_are_planned_once_and_failures_are_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A row that fails has a second try, the others are kept, and the command fails; a part has tables of its own."""
    published = paper.DOCUMENT.read_bytes()
    only = ["CopperNet:A2C", "CopperNet:A2C"]
    with pytest.raises(typer.Exit) as ended:
        paper.main(out=tmp_path, only=only, settings="published", steps=20)
    assert ended.value.exit_code == 1
    said = capsys.readouterr().out
    assert "rows: 1, done: 0" in said
    assert said.count("no training episode ended") == 2
    paper.main(out=tmp_path, only=only, settings="published", steps=60)
    assert "rows: 1, done: 1" not in capsys.readouterr().out
    paper.main(out=tmp_path, only=only, settings="published", steps=60)
    assert "rows: 1, done: 1" in capsys.readouterr().out
    paper.main(out=tmp_path / "new", only=["CopperNet"], table=True)
    assert (tmp_path / "new" / "paper_tables.md").is_file()
    assert paper.DOCUMENT.read_bytes() == published


@pytest.mark.parametrize(
    ("benchmark", "name"),
    [(uncertain, "table"), (foresight, "table"), (foresight, "information_table"), (foresight, "sight_table")],
)
def test_tables_of_worlds_are_those_of_kept_results(benchmark: ModuleType, name: str) -> None:
    """The figures in the document are what was measured, row by row."""
    table = getattr(benchmark, name)(json.loads(benchmark.RESULTS.read_text()))
    rows = [line for line in table.splitlines() if line.startswith("|")]
    assert len(rows) > 2 and "\n".join(rows) in benchmark.DOCUMENT.read_text(encoding="utf-8")


@pytest.mark.slow
def test_bounds_of_worlds_are_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """With all that gaps and the price policy need; of another question there is none."""
    world, sampling = uncertain.World("works", "", ()), Sampling(draws=10, fit_draws=4, numbers=False)
    monkeypatch.setattr(foresight, "BOUNDS", tmp_path / "bounds")
    monkeypatch.setattr(foresight, "RUNS", tmp_path / "runs")
    monkeypatch.setattr(foresight, "DEMANDED", 0.8)
    monkeypatch.setattr(foresight, "load_network", lambda name: replace(works(2), scenario_name=""))
    found, seconds = foresight.proof(world, sampling)
    monkeypatch.setattr(foresight, "bound", None)
    again, same_seconds = foresight.proof(world, sampling)
    assert same_seconds == seconds > 0 and again.agents == found.agents
    assert foresight.bound_figures(again, seconds) == foresight.bound_figures(found, seconds)
    run = foresight.measured("price_policy", foresight.CONTENDERS["price_policy"](world, again), again, None, 10)
    assert (
        run["gap"]["value"] == found.gaps(*outcomes(found, foresight.CONTENDERS["price_policy"](world, found))).mean()
    )
    planner = foresight.CONTENDERS["price_policy"](world, again)()
    neutral_gaps = foresight.played(again, again.network, Neutral(), 8)[1]
    less = foresight.less_than_planner(again, [Neutral(), planner], run["gap_by_draw"][:8])
    own = np.array(run["gap_by_draw"][:8]) - neutral_gaps
    np.testing.assert_allclose(less["by_seed"], [own.mean(), 0.0], atol=1e-12)
    half_width = 2.365 * own.std(ddof=1) / 2 / 8**0.5  # Student, seven degrees of freedom
    np.testing.assert_allclose([less["value"], less["high"] - less["value"]], [own.mean() / 2, half_width], rtol=1e-3)
    with pytest.raises(TypeError):
        foresight.proof(world, replace(sampling, seed=1))


@pytest.mark.parametrize("world", uncertain.WORLDS[4:], ids=lambda world: world.network)
def test_who_sees_more_or_less_meets_the_same_world(world: uncertain.World) -> None:
    """What is seen differs, what happens does not."""
    network = load_network(world.network).scenario(world.scenario)
    envs = {sight: MultiAgentVectorEnv(foresight.seen_by(network, sight), num_envs=2) for sight in foresight.SIGHT}
    first = rollout(envs["local"], Neutral(), seed=7).circularity
    for sight, env in envs.items():
        assert (rollout(env, Neutral(), seed=7).circularity == first).all(), sight
    widths = {sight: sum(space.shape[0] for space in env.observation_spaces.values()) for sight, env in envs.items()}
    assert widths["never"] < widths["local"] == widths["late"] < widths["forecasts of 1"] < widths["of 4"]
    assert widths["local"] < widths["neighbours"] <= widths["all stocks"]


def outcomes(found: UncertainBound, make: foresight.Maker) -> tuple[Any, Any]:
    """Return λ̄ and levels of the episodes of a bound."""
    run = rollout(MultiAgentVectorEnv(found.network, num_envs=len(found.values)), make(), seed=first_seed(0))
    return run.episode_circularity, run.episode_levels


def test_rows_of_recipes_that_are_not_compared_stay(tmp_path: Path) -> None:
    """Tables, figures and picture have what is compared now, and of a past comparison what is not."""
    past, both, now = (
        compare((), names, network="carbo_net", episodes=episodes, bounds=False)
        for names, episodes in ((("random", "neutral"), 2), (("random", "neutral"), 3), (("neutral",), 3))
    )
    for name, comparison in (("past", past), ("both", both), ("alone", now)):
        study._publish(comparison, tmp_path / name, None)
    summary = json.loads((tmp_path / "past" / "summary.json").read_text())
    summary["provenance"]["runs"] = [{"recipe": "mappo"}, {"recipe": "neutral"}]
    (tmp_path / "past" / "summary.json").write_text(json.dumps(summary))
    study._publish(now, tmp_path / "now", tmp_path / "past")
    older, newer, whole = (
        (tmp_path / name / "episodes.csv").read_text().splitlines() for name in ("past", "now", "both")
    )
    assert newer == [*(line for line in older if not line.startswith("neutral")), *whole[-3:]]
    summaries = {name: json.loads((tmp_path / name / "summary.json").read_text()) for name in ("past", "now", "both")}
    assert summaries["now"]["provenance"]["runs"] == [{"recipe": "mappo"}]
    rows = {name: summary["rows"] for name, summary in summaries.items()}
    assert [row["name"] for row in rows["now"]] == ["random", "neutral"]
    assert rows["now"][0] == rows["past"][0]
    assert rows["now"][1]["circularity"] == rows["both"][1]["circularity"] != rows["past"][1]["circularity"]
    assert (tmp_path / "now" / "comparison.png").read_bytes() != (tmp_path / "alone" / "comparison.png").read_bytes()
    document = tmp_path / "study.md"
    document.write_text("<!-- carbo_net -->\n<!-- /carbo_net -->\n")
    write_sections(document, {"carbo_net": "\n".join(study._table(past, []))})
    kept, _ = table_rows(document, "carbo_net")
    published = [["mappo", "PPO"], kept, ["independent_ppo", "PPO"], ["neutral", "of old"]]
    lines = [line for line in study._table(now, published) if line.startswith("| ")][1:]
    assert [line.split(" | ")[0] for line in lines] == ["| neutral", "| independent_ppo", "| mappo", "| random"]
    assert lines[-1] == f"| {' | '.join(kept)} |"


def test_kept_results_name_no_machine() -> None:
    """Directories in results are relative to the project, wherever they were made."""
    kept = [path for path in study.RESULTS.parent.rglob("*") if path.suffix in (".json", ".csv", ".md")]
    assert len(kept) > 100
    absolute = re.compile(r"""(?<![^\s"',=])/\w[\w.-]*/""")
    assert [path.name for path in kept if absolute.search(path.read_text(encoding="utf-8"))] == []
    assert absolute.search('"/home/somebody/runs"')
    with pytest.raises(CirlError, match="relative to the project"):
        study.main(out=Path("/home/somebody/runs"), table=True)


def test_exact_slopes_are_of_discounted_rewards() -> None:
    """Slopes that critics are held against are central differences of Σ_k γ^k r_{t+k}, the rewards that agents get."""
    options: dict[str, Any] = {"reward": "team", "circularity": "mean", "circularity_weight": 0.8}
    network = load_network("carbo_net").with_options(episode={"horizon": 4})
    env, rng, discount, step, size = (
        MultiAgentVectorEnv(network, num_envs=2, **options),
        np.random.default_rng(2),
        0.9,
        1,
        1e-4,
    )
    schedule = [
        {agent: rng.uniform(-0.6, 0.6, space.shape) * np.ones((2, 1)) for agent, space in env.action_spaces.items()}
        for _ in range(4)
    ]

    def play(agent: str, change: float) -> tuple[list[Interval], Floats]:
        """Return what is played, and the discounted rewards to come in the copies from ``step`` on."""
        env.reset(seed=3)
        tape, to_come = [], np.zeros(2)
        for t, actions in enumerate(schedule):
            rewards = env.step(actions | {agent: actions[agent] + change * (t == step)})[1]
            tape.append(env.interval)
            to_come += discount ** (t - step) * rewards[agent] * (t >= step)
        return tape, to_come

    slopes = critics.exact_slopes(env, play(env.agents[0], 0.0)[0], discount)
    for agent in env.agents:
        difference = (play(agent, size)[1] - play(agent, -size)[1]) / (2.0 * size)
        exact = slopes[step, env.actuators.entries[agent]].sum(axis=0)
        np.testing.assert_allclose(exact, difference, atol=1e-6 * np.abs(slopes).max() + 1e-9)
