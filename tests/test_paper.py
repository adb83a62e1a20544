"""The paper's tables: rows are trained, kept, not run again, and shown beside the published figures."""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray
from stable_baselines3 import SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecEnv, VecNormalize

from benchmarks.paper import study_rows
from benchmarks.paper_difference import difference
from benchmarks.paper_document import markdown
from cirl_marl import CirlError, RecipeError, cli
from cirl_marl.errors import RunError
from cirl_marl.learners.algorithms import build
from cirl_marl.learners.interface import train
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.trainer import Training
from cirl_marl.paper import published, rows, training
from cirl_marl.paper.published import ALGORITHMS, ENVIRONMENTS, PaperEnvironment, PublishedRun
from cirl_marl.paper.results import EvaluationFigures, PaperRow, Result, Results, thin_out
from cirl_marl.paper.row_selection import select_rows
from cirl_marl.paper.rows import evaluate, reason_to_repeat, run_row
from cirl_marl.paper.table import above_optimum, table_rows
from cirl_marl.paper.training import TrainingRecord, describe, train_tuned

COPPER = ENVIRONMENTS["CopperNet"]
KEPT = Path(__file__).parent.parent / "benchmarks" / "results" / "paper"


class Toy(gymnasium.Env[dict[str, NDArray[np.float32]], NDArray[np.float32]]):
    """A goal task of ten steps; it succeeds in every other episode."""

    def __init__(self) -> None:
        """Make the spaces."""
        box = gymnasium.spaces.Box(-1, 1, (2,), np.float32)
        names = ("observation", "achieved_goal", "desired_goal")
        self.observation_space = gymnasium.spaces.Dict({name: box for name in names})  # type: ignore[assignment]
        self.action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
        self._episode = self._step = 0

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> tuple[Any, dict[str, Any]]:
        """Start the next episode; a seed starts counting anew."""
        super().reset(seed=seed)
        self._episode = 0 if seed is not None else self._episode + 1
        self._step = 0
        return self._observe(), {}

    def step(self, action: NDArray[np.float32]) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        """Succeed in the third step of even episodes, though not for long."""
        self._step += 1
        success = self._step == 3 and self._episode % 2 == 0
        return self._observe(), -1.0, False, self._step == 10, {"success": success, "is_success": success}

    def compute_reward(self, achieved: NDArray[Any], desired: NDArray[Any], info: Any) -> NDArray[Any]:
        """Reward of any goal."""
        return -np.ones(len(achieved), dtype=np.float32)

    def _observe(self) -> dict[str, NDArray[np.float32]]:
        return {name: np.zeros(2, dtype=np.float32) for name in self.observation_space.spaces}  # type: ignore[attr-defined]


@pytest.fixture
def toy(monkeypatch: pytest.MonkeyPatch) -> Iterator[PaperEnvironment]:
    """Put a goal task among the environments of the paper."""
    found = PaperEnvironment(
        name="Toy", steps=1000, runs={"SAC-HER": PublishedRun(end_return=-1.0)}, success_episodes=7
    )
    gymnasium.register(found.id, entry_point=lambda **_: Toy())
    monkeypatch.setattr(published, "ENVIRONMENTS", {"Toy": found})
    yield found
    del gymnasium.registry[found.id]


def result(algorithm: str = "A2C", steps: int = 200_000, seed: int = 0, end: float = -5e7, **changes: Any) -> Result:
    """Return a result as a training would."""
    made = Result(
        row=PaperRow(environment="CopperNet", algorithm=algorithm, steps=steps, seed=seed),
        steps_done=steps,
        seconds=90.0,
        episodes=4000,
        start_return=-1.5e8,
        end_return=end,
        curve=[(50, -1.5e8)],
        evaluation=EvaluationFigures(episodes=100, mean=-4.9e7, deviation=0.0, success=None),
        settings={},
        versions={"torch": "2.13.0"},
        machine={"cpus": 2, "torch_threads": 1},
        cpu_seconds=60.0,
        finished="2025-01-02T03:04:05+00:00",
    )
    return replace(made, **changes)


def cirl(monkeypatch: pytest.MonkeyPatch, *arguments: str) -> int:
    """Run ``cirl paper CopperNet …`` and return its exit code."""
    monkeypatch.setattr(sys, "argv", ["cirl", "paper", "CopperNet", *arguments])
    with pytest.raises(SystemExit) as ended:
        cli.main()
    return int(ended.value.code or 0)


@pytest.mark.parametrize(("algorithm", "steps", "done"), [("A2C", 300, 300), ("ARS", 300, 800), ("DDPG", 150, 150)])
@pytest.mark.slow
def test_row_is_trained_kept_and_not_run_again(
    algorithm: str,
    steps: int,
    done: int,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Every finished training episode counts, also of ARS; a second call shows the same figures without training."""
    arguments = (algorithm, "--steps", str(steps), "--out", str(tmp_path))
    assert cirl(monkeypatch, *arguments) == 0
    begun, _, shown = capsys.readouterr().out.partition("\n")
    assert begun.startswith("rows: 1, done: 0, to go by the paper's training times: 0 min; results in ")
    assert f"{steps} of 200,000" in shown
    (path,) = tmp_path.glob("*.json")
    kept = json.loads(path.read_text())
    assert kept["row"] == {
        "environment": "CopperNet",
        "algorithm": algorithm,
        "settings": "published",
        "steps": steps,
        "seed": 0,
    }
    assert (kept["steps_done"], kept["episodes"]) == (done, done // 50)
    assert kept["curve"][-1][0] == done
    assert kept["evaluation"]["episodes"] == 100
    assert kept["evaluation"]["success"] is None
    assert {"torch", "stable-baselines3", "mujoco"} <= set(kept["versions"])
    assert kept["settings"]["environment"] == "cirl_marl/CopperNet-v0"
    assert len(kept["settings"]["definition_sha256"]) == 64
    returns = np.array([value for _, value in kept["curve"]])
    half = max(1, len(returns) // 2)
    assert kept["start_return"] == pytest.approx(returns[:half].mean())
    assert kept["end_return"] == pytest.approx(returns[-half:].mean())
    assert (returns < 0).all()

    monkeypatch.setattr(rows, "run_row", lambda *_, **__: pytest.fail("the row was run again"))
    assert cirl(monkeypatch, *arguments) == 0
    assert capsys.readouterr().out.partition("\n") == (f"rows: 1, done: 1; results in {tmp_path}", "\n", shown)


@pytest.mark.slow
def test_same_seed_same_figures() -> None:
    """The seed decides model and environment."""
    first, second, other = (
        run_row(PaperRow(environment="CopperNet", algorithm="A2C", steps=100, seed=seed), episodes=20)
        for seed in (1, 1, 2)
    )
    assert first.curve == second.curve != other.curve
    assert first.evaluation == second.evaluation


@pytest.mark.parametrize("algorithm", ["SAC", "DDPG", "PPO"])
@pytest.mark.medium
@pytest.mark.sample(1)
def test_weights_that_become_nan_are_a_result(
    algorithm: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A learner that breaks shows its episodes until then and the step; there is no policy to evaluate."""

    def wild(name: str, policy: str, env: VecEnv, parameters: dict[str, Any], **fixed: Any) -> BaseAlgorithm:
        return build(name, policy, env, parameters | {"learning_rate": 1e30}, **fixed)

    monkeypatch.setattr(training, "build", wild)
    arguments = (algorithm, "--steps", "10000", "--out", str(tmp_path))
    assert cirl(monkeypatch, *arguments) == 0
    assert "weights NaN after" in capsys.readouterr().out
    (found,) = Results(tmp_path).read_all()
    assert found.has_diverged
    assert found.evaluation is None
    assert 100 < found.steps_done < 10_000
    assert found.episodes == found.steps_done // 50
    assert found.gain_per_step == found.gain / found.steps_done
    assert not reason_to_repeat(found)
    line = next(line for line in markdown([found]).splitlines() if f"| {algorithm} | ours | 0 |" in line)
    assert f"seed 0: weights NaN after {found.steps_done:,} of 10,000 steps" in line
    assert "nan" not in line


@pytest.mark.slow
def test_saturated_sac_raises_its_entropy_coefficient_without_end() -> None:
    """Its logarithm grows by one learning rate an update on rewards of −10⁶ a step, which ends in NaN."""
    model = SAC("MlpPolicy", gymnasium.make(COPPER.id), seed=0, learning_starts=20).learn(120)
    assert model.log_ent_coef is not None
    assert model.log_ent_coef.item() == pytest.approx(100 * 3e-4, rel=0.01)


def test_a_session_goes_on_after_a_row_that_fails(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The failure is said and in the exit code; other rows are run and shown."""

    def run(row: PaperRow, **_: Any) -> Result:
        if row.algorithm == "A2C":
            raise CirlError("no training episode ended")
        return replace(result(row.algorithm), row=row)

    monkeypatch.setattr(rows, "run_row", run)
    assert cirl(monkeypatch, "--steps", "200", "--out", str(tmp_path)) == 1
    shown = capsys.readouterr().out
    assert "CopperNet A2C (published, 200 steps, seed 0): failed: no training episode ended" in shown
    assert [each.row.algorithm for each in Results(tmp_path).read_all()] == ["ARS", "DDPG", "PPO", "SAC"]
    assert cirl(monkeypatch, "PPO", "--steps", "400", "--out", str(tmp_path)) == 0
    assert "400 of 200,000" in capsys.readouterr().out
    assert cirl(monkeypatch, "PPO", "--steps", "200", "--out", str(tmp_path)) == 0
    assert "400 of 200,000" not in capsys.readouterr().out


def test_recipes_of_other_versions_are_outdated() -> None:
    """A recorded recipe with a key that recipes no longer have is another one."""
    found = replace(
        result("PPO"), row=PaperRow(environment="CopperNet", algorithm="PPO", settings="tuned", steps=200_000)
    )
    recorded = load_recipe("paper_copper_net").model_dump(mode="json")
    assert reason_to_repeat(replace(found, settings={"recipe": recorded})) == ""
    assert "another now" in reason_to_repeat(replace(found, settings={"recipe": recorded | {"gone": 1}}))


def test_other_failures_of_a_training_are_no_result() -> None:
    """Only broken weights are what the settings give; anything else that goes wrong is said."""

    def broken(*_: object) -> None:
        raise ValueError("not of NaN")

    with pytest.raises(ValueError, match="not of NaN"):
        run_row(PaperRow(environment="CopperNet", algorithm="SAC", steps=200), report=broken)


def test_interrupted_row_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Ctrl-C ends with code 130 and says how to go on; the rows done before stay."""
    results = Results(tmp_path)
    results.write(result())

    def interrupted(*_: Any, **__: Any) -> Result:
        raise KeyboardInterrupt

    monkeypatch.setattr(rows, "run_row", interrupted)
    assert cirl(monkeypatch, "A2C", "--seeds", "2", "--out", str(tmp_path)) == 130
    assert "The same command goes on" in capsys.readouterr().out
    assert results.read_all() == [result()]


def test_result_is_written_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A crash while writing leaves no result, and a damaged file is named."""
    results = Results(tmp_path)
    with monkeypatch.context() as broken, pytest.raises(OSError, match="disk"):
        broken.setattr("os.fsync", lambda _: (_ for _ in ()).throw(OSError("disk")))
        results.write(result())
    assert not results.has(result().row)
    assert results.read_all() == []
    results.write(result())
    assert results.read(result().row) == result()
    results.file(result().row).write_text('{"row": 1}')
    with pytest.raises(RunError, match="is not the result of a row"):
        results.read_all()


def test_gain_and_gain_per_step() -> None:
    """ζ = r_e − r_s and ψ = ζ/steps."""
    assert result().gain == 1.0e8
    assert result().gain_per_step == 500.0


def test_curves_are_thinned_to_means() -> None:
    """At most 500 points; their mean, weighted by length, is that of the episodes."""
    ends, returns = list(range(50, 50 * 1234, 50)), list(np.random.default_rng(0).normal(size=1233))
    curve = thin_out(ends, returns)
    assert len(curve) == 500
    assert curve[-1][0] == ends[-1]
    assert curve[0][0] == 150
    assert curve[0][1] == pytest.approx(np.mean(returns[:3]))


def test_table_shows_both_and_what_was_not_run() -> None:
    """The paper's figures, ours over the seeds with all steps, shorter runs as such, and what is missing."""
    runs = [result(end=-6e7), result(seed=1, end=-5e7), result(steps=500, end=-1.0), result("PPO", 50_000)]
    shown = {"recipe": {"learner": {"demonstrations": {"controller": "scripted", "steps": 7_500}}}}
    runs.append(result("ARS", settings=shown))
    rows = {(row[0], row[1]): row for row in table_rows(COPPER, runs)}
    assert rows["A2C", "paper"][3:7] == ("-1.34e8", "-5.30e7", "8.10e7", "405")
    assert rows["A2C", "ours"][2:5] == ("0, 1", "-1.50e8 ± 0.00e8", "-5.50e7 ± 0.71e7")
    assert rows["A2C", "ours"][-3:] == ("1.5", "1.0", "")
    assert rows["PPO", "ours"][-1] == "50,000 of 200,000 steps"
    assert rows["ARS", "ours"][-1] == "the first 7,500 steps, and r_s with them, are shown by scripted control"
    assert rows["SAC", "ours"][-1] == rows["", "tuned"][-1] == "not run"
    text = markdown(runs)
    assert "| DDPG | paper |  | -60.2 | -5.5 | 54.7 | 5.47e-4 | 72.3 |  | 13.7 |  |  |" in text
    assert "| TQC-HER | paper |  |  | -11.45 |" in text
    assert "Optimum: -4.60e7" in text
    assert "torch 2.13.0" in text
    assert markdown([]).count("not run") == sum(len(found.runs) for found in ENVIRONMENTS.values()) + 2 * len(
        ENVIRONMENTS
    )


def test_summary_says_what_was_reached() -> None:
    """Means over the seeds of a tuned recipe are held against the paper's best and against the goal."""

    def line(
        name: str, algorithm: str, end: float, final: list[float], success: float | None = None, there: float = -2e6
    ) -> list[str]:
        ends = EvaluationFigures(episodes=100, mean=there, deviation=0.1, success=None)
        environment = ENVIRONMENTS[name]
        made = result(algorithm)
        runs = [
            replace(
                made,
                row=PaperRow(
                    environment=name, algorithm=algorithm, settings="tuned", steps=environment.steps, seed=seed
                ),
                end_return=end,
                evaluation=EvaluationFigures(episodes=100, mean=mean, deviation=0.1, success=success),
                published_ends=ends,
            )
            for seed, mean in enumerate(final)
        ]
        found = next(found for found in markdown(runs).splitlines() if found.startswith(f"| {name} |"))
        return [cell.strip() for cell in found.split("|")[1:-1]]

    near = line("CarboNet", "PPO", -1e6, [-1.10e5, -1.12e5])
    assert near[1:5] == ["-2.04e6 (ARS)", "-1.00e6 ± 0.00e6", "4.00e4 ± 0.02449", "yes"]
    assert near[6:] == ["-1.07e5", "≥ -1.13e5 (5 % of the optimum)", "yes"]
    assert line("CarboNet", "PPO", -3e6, [-1.10e5, -1.20e5])[4::4] == ["yes", "no"]
    assert line("CarboNet", "PPO", -1e6, [-1.10e5], there=-3e6)[4] == "no"
    assert line("TransportTruck", "PPO", -1.3e8, [-1.18e8])[4:6] == ["no", "-1.18e8"]
    assert line("FetchWasteSorting", "TQC-HER", -9.0, [-8.0], 100.0)[3:5] == ["", "not comparable"]
    assert line("FetchWasteSorting", "TQC-HER", -9.0, [-8.0], 100.0)[-1] == "yes"
    assert line("Reacher", "SAC", -5.0, [-4.0], 94.0)[-1] == "no"
    assert line("Reacher", "SAC", -5.0, [-4.0], 95.0)[5:] == ["-4, s 95 %", "not known", "s ≥ 95 %", "yes"]
    droop = line("CO2MicroalgaeDroop", "PPO", 480.0, [450.0])
    assert droop[1:3] == ["473 (A2C), chance: above the optimum", "480, chance: above the optimum"]
    assert droop[5:] == ["450", "454", "", ""]
    assert markdown([], "## Mine\n").index("## Mine") < markdown([], "## Mine\n").index("## Reacher")


@pytest.mark.parametrize(
    ("ends", "one", "again", "error", "better"),
    [
        ([-5.0], 1.0, [], math.hypot(0.1, 0.1), "yes"),  # one run each, of 100 episodes
        ([-5.5, -4.5], 1.0, [], math.hypot(0.5, 0.5**0.5), "within its error"),  # seeds vary by the root of a half
        ([-5.0, -5.0], 4.0, [], math.hypot(0.4 / 2**0.5, 0.4), "within its error"),  # their episodes vary more
        ([-5.0, -5.0], 1.0, [-4.0, -6.0], math.hypot(0.1 / 2**0.5, 2**0.5), "within its error"),
        ([-6.0, -6.0], 1.0, [-5.0], math.hypot(0.1 / 2**0.5, 0.1), "no"),
        ([-6.0, -5.0], 1.0, [], math.hypot(0.5, 0.5**0.5), "within its error"),  # no difference at all
    ],
)
def test_differences_are_held_against_their_error(
    ends: list[float], one: float, again: list[float], error: float, better: str
) -> None:
    """Two standard errors: of the mean over our seeds, and of the paper's one run, −5.5 with DDPG on Reacher."""

    def reacher(end: float, seed: int, algorithm: str, settings: str) -> Result:
        row = PaperRow(environment="Reacher", algorithm=algorithm, settings=settings, steps=100_000, seed=seed)
        played = EvaluationFigures(episodes=10_000, mean=-4.0, deviation=one, success=95.0)
        return result(end=end, row=row, evaluation=played)

    tuned = [reacher(end, seed, "SAC", "tuned") for seed, end in enumerate(ends)]
    others = [reacher(end, seed, "DDPG", "published") for seed, end in enumerate(again)]
    others += [reacher(end, seed, "SAC", "published") for seed, end in enumerate((-1.0, -99.0))]
    found = difference(ENVIRONMENTS["Reacher"], tuned, [*tuned, *others])
    assert found is not None
    assert found.value == pytest.approx(np.mean(ends) + 5.5)
    assert found.error == pytest.approx(2 * error)
    assert found.better == better


def test_what_the_kept_rows_say_is_better() -> None:
    """As the prose beside the table says."""
    kept = Results(KEPT).read_all()
    found = {}
    for name, environment in ENVIRONMENTS.items():
        tuned = [each for each in kept if (each.row.environment, each.row.settings) == (name, "tuned")]
        found[name] = getattr(difference(environment, tuned, kept), "better", "not comparable")
    assert {name for name, better in found.items() if better == "yes"} == {"Reacher", "CO2MicroalgaeMonod", "CarboNet"}
    assert {name for name, better in found.items() if better == "no"} == {"CO2MicroalgaeDroop"}
    assert [name for name, better in found.items() if better == "not comparable"] == ["FetchWasteSorting"]


def test_figures_above_the_optimum_are_chance() -> None:
    """They are said to be so in the rows that have them, and lie within three standard errors of it."""
    kept = Results(KEPT).read_all()
    marked = 0
    for environment in ENVIRONMENTS.values():
        mine = [each for each in kept if each.row.environment == environment.name]
        deviation = [each.evaluation.deviation for each in mine if each.row.settings == "tuned" and each.evaluation]
        for each in mine:
            figures = {"r_s": each.start_return, "r_e": each.end_return}
            figures |= {"final policy": each.evaluation.mean} if each.evaluation is not None else {}
            above = [name for name, value in figures.items() if above_optimum(environment, value)]
            remark = next(row[-1] for row in table_rows(environment, [each]) if row[2])
            assert (f"{', '.join(above)} above the optimum: chance" in remark) == bool(above)
            for name in above:
                error = np.mean(deviation) / each.window**0.5
                assert figures[name] - environment.optima[0].value < 3 * error
                marked += 1
    assert marked > 20


def test_published_table_is_whole() -> None:
    """Five algorithms on seven environments and four on one, with the relations that the paper states."""
    assert [len(found.runs) for found in ENVIRONMENTS.values()] == [5] * 7 + [4]
    assert {name for found in ENVIRONMENTS.values() for name in found.runs} == set(ALGORITHMS)
    assert all(run.end_return is not None for found in ENVIRONMENTS.values() for run in found.runs.values())
    minutes = {
        (found.name, name): run.minutes or 0 for found in ENVIRONMENTS.values() for name, run in found.runs.items()
    }
    assert max(minutes, key=lambda key: minutes[key]) == ("TransportTruck", "SAC")
    assert minutes["TransportTruck", "SAC"] == pytest.approx(88.3)


def test_study_runs_fast_learners_first() -> None:
    """ARS, PPO and A2C with three seeds on every Box environment, then one seed of the slow ones, then the goals."""
    rows = [row for row in study_rows() if row.settings == "published"]
    assert len(rows) == 3 * 3 * 7 + 2 * 7 + 4
    assert {row.algorithm for row in rows[:63]} == {"ARS", "PPO", "A2C"}
    assert [row.seed for row in rows[:63]] == sorted(row.seed for row in rows[:63])
    assert [row.algorithm for row in rows[63:70]] == ["DDPG"] * 7
    assert all("HER" in row.algorithm for row in rows[-4:])
    assert len(set(map(str, rows))) == len(rows) == len({row.stem for row in rows})


def test_names_choose_rows() -> None:
    """No environment means all, no algorithm means all that the paper ran there."""
    assert len(select_rows(None, None)) == 39
    assert [row.algorithm for row in select_rows("FetchWasteSorting", None)] == list(
        ENVIRONMENTS["FetchWasteSorting"].runs
    )
    assert [row.seed for row in select_rows("CopperNet", "ARS", seeds=3)] == [0, 1, 2]
    assert len(select_rows(None, "SAC")) == 7
    assert [row.environment for row in select_rows(None, "SAC", settings="tuned")] == ["Reacher"]
    assert [row.algorithm for row in select_rows("FetchWasteSorting", "TQC-HER", settings=None)] == ["TQC-HER"] * 2
    with pytest.raises(CirlError, match=r"unknown algorithm of the paper 'PP0'\. Did you mean 'PPO'"):
        select_rows(None, "PP0", settings="tuned")
    with pytest.raises(CirlError, match=r"unknown algorithm of the paper 'ppo'\. Did you mean 'PPO'"):
        select_rows("CopperNet", "ppo")
    with pytest.raises(CirlError, match="A2C is an algorithm, which comes after an environment: Reacher, Tran"):
        select_rows("A2C", None)
    with pytest.raises(CirlError, match=r"no tuned recipe .* for A2C"):
        select_rows(None, "A2C", settings="tuned")


def test_results_that_answer_another_question_are_outdated() -> None:
    """Other evaluation episodes, definitions or recipes are named; what is not on record is not held against it."""
    kept = result()
    assert kept.evaluation is not None
    assert reason_to_repeat(kept) == ""
    assert "played 50 episodes, not 100" in reason_to_repeat(
        replace(kept, evaluation=replace(kept.evaluation, episodes=50))
    )
    assert "played 100 episodes, not 7" in reason_to_repeat(kept, episodes=7)
    now = describe(COPPER)
    assert reason_to_repeat(replace(kept, settings=now)) == ""
    assert "definition" in reason_to_repeat(replace(kept, settings=now | {"definition_sha256": "0" * 64}))
    row = PaperRow(environment="CopperNet", algorithm="PPO", settings="tuned", steps=200_000)
    plain = load_recipe("paper_copper_net").model_dump(mode="json")
    assert reason_to_repeat(replace(kept, row=row, settings=now | {"recipe": plain})) == ""
    longer = plain | {"run": {"steps": 1, "envs": 1}}
    assert "the recipe 'paper_copper_net' is another now" in reason_to_repeat(
        replace(kept, row=row, settings=now | {"recipe": longer})
    )


@pytest.mark.medium
def test_every_kept_row_is_of_the_definitions_of_today() -> None:
    """Those on record are those of today, as all are but in 16 early rows, and the document shows all rows."""
    kept = Results(KEPT).read_all()
    assert len(kept) > 80
    assert sum("definition_sha256" not in result.settings for result in kept) == 16
    assert [(str(result.row), why) for result in kept if (why := reason_to_repeat(result))] == []
    text = markdown(kept, (KEPT / "comment.md").read_text(encoding="utf-8"))
    assert text == (Path(__file__).parent.parent / "docs" / "paper_tables.md").read_text(encoding="utf-8")


def test_results_need_a_directory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A path that cannot be one is refused before anything is trained."""
    monkeypatch.setattr(rows, "run_row", lambda *_, **__: pytest.fail("a row was run"))
    (tmp_path / "file").touch()
    assert cirl(monkeypatch, "A2C", "--out", str(tmp_path / "file")) == 2
    assert f"{tmp_path / 'file'}: results need a directory" in capsys.readouterr().err


@pytest.mark.medium
def test_goal_task_learns_with_hindsight(toy: PaperEnvironment) -> None:
    """Successes count when they come, in the number of episodes asked for."""
    del toy
    found = run_row(PaperRow(environment="Toy", algorithm="SAC-HER", steps=110), episodes=40)
    assert found.evaluation == EvaluationFigures(episodes=40, mean=-10.0, deviation=0.0, success=50.0)
    assert found.end_return == -10.0
    assert found.settings["policy"] == "MultiInputPolicy"


def recipe(algorithm: str, environment: dict[str, Any] | None = None, **parameters: Any) -> Recipe:
    """Return a recipe with four copies."""
    return Recipe.model_validate(
        {
            "name": "mine",
            "title": "a recipe",
            "run": {"envs": 4},
            "environment": environment or {},
            "learner": {"algorithm": algorithm, "parameters": parameters},
        }
    )


@pytest.mark.medium
def test_tuned_network_counts_steps_and_episodes_over_the_copies() -> None:
    """As many environment steps as asked for, the returns of all copies, the paper's reward."""
    row = PaperRow(environment="CopperNet", algorithm="PPO", settings="tuned", steps=800)
    trained = train_tuned(COPPER, row, lambda *_: None, recipe("PPO", n_steps=50, batch_size=100))
    assert (trained.steps, len(trained.returns), trained.ends[-1]) == (800, 16, 800)
    assert all(-5e8 < value < -4.6e7 for value in trained.returns)
    with pytest.raises(RecipeError, match="keeps the paper's problem"):
        train_tuned(COPPER, row, lambda *_: None, recipe("PPO", {"reward": "circularity"}))
    with pytest.raises(RecipeError, match="uses SAC, but the row says PPO"):
        train_tuned(COPPER, row, lambda *_: None, recipe("SAC"))


def test_tuned_policy_is_measured_behind_its_normaliser(monkeypatch: pytest.MonkeyPatch) -> None:
    """What the final policy is shown is what it was trained on, scaled by what training saw."""
    kept: list[Training] = []

    def keeping(*arguments: Any, **options: Any) -> Training:
        kept.append(train(*arguments, **options))
        return kept[-1]

    monkeypatch.setattr(training, "train", keeping)
    row = PaperRow(environment="CopperNet", algorithm="PPO", settings="tuned", steps=200)
    trained = train_tuned(COPPER, row, lambda *_: None, recipe("PPO", n_steps=50, batch_size=100))
    (learner,) = kept[0].learners.values()
    assert isinstance(learner.env, VecNormalize)
    seen = np.random.default_rng(0).uniform(50, 2000, (3, 6)).astype(np.float32)
    assert trained.predict is not None
    chosen = trained.predict(seen, None, np.ones(3, dtype=bool))[0]
    expected = learner.model.predict(np.asarray(learner.env.normalize_obs(seen)), deterministic=True)[0]
    np.testing.assert_array_equal(chosen, expected)
    assert not np.array_equal(chosen, learner.model.predict(seen, deterministic=True)[0])


@pytest.mark.slow
def test_final_policies_play_their_quota_on_episodes_of_their_own() -> None:
    """23 episodes in 20 copies: one each and a second one for the last three, from the seed given on."""
    id_, first = ENVIRONMENTS["CO2MicroalgaeMonod"].id, 2**31 + 7
    returns = []
    for copy in range(20):
        env = gymnasium.make(id_)
        for episode in range(2 if copy >= 17 else 1):
            env.reset(seed=first + copy if episode == 0 else None)
            returns.append(sum(float(env.step(np.ones(1, dtype=np.float32))[1]) for _ in range(200)))

    def full_light(observation: Any, state: Any, starts: Any) -> tuple[NDArray[Any], None]:
        return np.ones((len(observation), 1), dtype=np.float32), None

    found = evaluate(id_, full_light, 23, first, lambda *_: None, {})
    assert (found.episodes, found.success) == (23, None)
    assert found.mean == pytest.approx(np.mean(returns), abs=1e-6)
    assert found.deviation == pytest.approx(np.std(returns), abs=1e-6)


@pytest.mark.medium
@pytest.mark.parametrize(("episodes", "window"), [(300, 100), (150, 75), (3, 1), (1, 1)])
def test_first_and_last_episodes_do_not_overlap(episodes: int, window: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """r_s and r_e are means over 100 episodes each, or over half of those that there were."""
    returns = list(np.random.default_rng(0).normal(size=episodes))
    done = TrainingRecord(
        predict=lambda *_: (np.zeros((2, 1), dtype=np.float32), None),
        ends=[50 * (i + 1) for i in range(episodes)],
        returns=returns,
        steps=50 * episodes,
        seconds=1.0,
        cpu_seconds=1.0,
        settings={},
        options={},
    )
    monkeypatch.setattr(rows, "train_published", lambda *_: done)
    monkeypatch.setattr(rows, "EVALUATION_EPISODES", 2)
    found = run_row(PaperRow(environment="CopperNet", algorithm="A2C", steps=50 * episodes))
    assert found.start_return == pytest.approx(np.mean(returns[:window]))
    assert found.end_return == pytest.approx(np.mean(returns[-window:]))


@pytest.mark.medium
def test_tuned_robot_trains_in_copies(toy: PaperEnvironment) -> None:
    """A goal task gets hindsight and as many steps as asked for."""
    row = PaperRow(environment="Toy", algorithm="SAC", settings="tuned", steps=120)
    trained = train_tuned(toy, row, lambda *_: None, recipe("SAC", learning_starts=100, batch_size=16))
    assert (trained.steps, trained.returns) == (120, [-10.0] * 12)


@pytest.mark.medium
def test_rows_of_other_seeds_have_starts_of_their_own(toy: PaperEnvironment, monkeypatch: pytest.MonkeyPatch) -> None:
    """The copies of a row begin from seeds that no copy of another row has."""
    given: dict[int, list[int]] = {0: [], 1: []}
    reset = Toy.reset
    for seed, seeds in given.items():

        def recorded(self: Toy, *, seed: int | None = None, options: Any = None, kept: list[int] = seeds) -> Any:
            kept += [] if seed is None else [seed]
            return reset(self, seed=seed, options=options)

        monkeypatch.setattr(Toy, "reset", recorded)
        row = PaperRow(environment="Toy", algorithm="SAC", settings="tuned", steps=120, seed=seed)
        train_tuned(toy, row, lambda *_: None, recipe("SAC", learning_starts=100, batch_size=16))
    assert given[0]
    assert not set(given[0]) & set(given[1])


def test_rows_that_cannot_run_say_why(monkeypatch: pytest.MonkeyPatch) -> None:
    """Too few steps for an episode, and an environment that is not there, are errors."""
    with pytest.raises(CirlError, match="no training episode ended"):
        run_row(PaperRow(environment="CopperNet", algorithm="A2C", steps=5))
    monkeypatch.delitem(gymnasium.registry, COPPER.id)
    with pytest.raises(RunError, match="does not register it"):
        run_row(PaperRow(environment="CopperNet", algorithm="A2C", steps=5))
