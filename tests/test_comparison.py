"""Comparisons: the same episodes for all, honest gaps, grouped seeds, whole files or none."""

from __future__ import annotations

import csv
import hashlib
import json
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RunError
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.assessment import evaluate
from cirl_marl.evaluation.contenders import differences
from cirl_marl.evaluation.figures import provenance
from cirl_marl.evaluation.pareto import pareto_front
from cirl_marl.evaluation.statistics import interquartile_mean
from cirl_marl.learners.interface import resume, train
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.learners.trainer import Progress, Training
from cirl_marl.network import Network
from cirl_marl.optimum import search_each
from cirl_marl.records.files import publish_folder
from cirl_marl.report.tradeoffs import write_comparison

pytestmark = pytest.mark.medium


@pytest.fixture(scope="module")
def runs(bottles: Network, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return three seeds of one recipe."""
    folder = tmp_path_factory.mktemp("runs")
    for seed in range(3):
        train(bottles, "independent_a2c", directory=folder / str(seed), seed=seed, steps=320, envs=8)
    return [folder / str(seed) for seed in range(3)]


def test_common_random_numbers(bottles: Network, runs: list[Path]) -> None:
    """Who else is compared changes nobody's episodes; seeds of training are out of reach."""
    alone = compare(runs[:1], ["neutral"], episodes=4, bounds=False)
    among = compare(runs, ["random", "neutral"], episodes=4, bounds=False)
    assert alone.first_seed >= 2**31
    for one in alone.entries:
        other = next(each for each in among.entries if (each.name, each.seed) == (one.name, one.seed))
        np.testing.assert_array_equal(one.circularity, other.circularity)
        np.testing.assert_array_equal(one.service, other.service)
    fresh = compare([], ["neutral"], network=bottles, episodes=4, seed=1, bounds=False)
    assert not np.isin(fresh.entries[0].circularity, alone.entries[-1].circularity).any()


def test_rows_are_recipes_and_controllers(runs: list[Path]) -> None:
    """Seeds of a recipe share a row, whose figure is the interquartile mean of their means."""
    found = compare(runs, ["neutral", "random"], episodes=3, bounds=False)
    trained, neutral, _ = found.rows
    assert [row.name for row in found.rows] == ["independent_a2c", "neutral", "random"]
    assert (trained.seeds, trained.has_few_seeds, neutral.seeds, neutral.has_few_seeds) == ((0, 1, 2), True, (), False)
    figure = trained.figure("circularity")
    assert figure is not None
    means = [entry.circularity.mean() for entry in trained.entries]
    assert figure.value == pytest.approx(interquartile_mean(means))
    assert min(means) <= figure.low <= figure.high <= max(means)
    assert trained.figure("gap") is None


def test_gap_is_to_the_best_episode_that_serves_as_well(bottles: Network) -> None:
    """No episode beats its bound; serving less raises the bound, so starving does not close the gap."""
    found = compare([], ["neutral", "random", "mpc", "optimum"], network=bottles, episodes=3)
    gaps = {}
    for entry in found.entries:
        assert entry.gap is not None and entry.bound is not None
        assert (entry.gap > -1e-9).all()
        np.testing.assert_allclose(entry.gap, (entry.bound - entry.circularity) / np.abs(entry.bound))
        gaps[entry.name] = float(entry.gap.mean())
    assert max(gaps["mpc"], gaps["optimum"]) < 0.1 < gaps["random"] < gaps["neutral"]
    front = found.baseline.front
    assert (np.diff(front[:, 0]) > 0).all()
    assert (np.diff(front[:, 1]) <= 1e-9).all()


def test_network_without_certificate() -> None:
    """There is a comparison, without gap, and the reason."""
    short = load_network("net_zero").with_options(episode={"horizon": 8})
    found = compare([], ["random"], network=short, episodes=2)
    assert found.entries[0].gap is None
    assert "no bound is proved" in found.baseline.reason


def reported(run: Callable[[Callable[[str, float], None]], object]) -> list[tuple[str, float]]:
    """Return what ``run`` tells about its progress, which never goes back and ends at 1."""
    told: list[tuple[str, float]] = []
    run(lambda what, share: told.append((what, share)))
    shares = [share for _, share in told]
    assert shares == sorted(shares)
    assert shares[-1] == pytest.approx(1.0)
    return told


def test_plans_tell_how_far_they_are(bottles: Network, monkeypatch: pytest.MonkeyPatch) -> None:
    """A search that takes hours, programs and improvements show in the progress, and so do the bounds."""
    monkeypatch.setattr("cirl_marl.optimum.open_loop.search_each", partial(search_each, population=8, iterations=2))
    short = load_network("net_zero").with_options(episode={"horizon": 16})
    told = reported(lambda progress: compare([], ["optimum"], network=short, episodes=2, progress=progress))
    begun = next(share for what, share in told if what == "optimum")
    searching = {share for what, share in told if what == "optimum" and share - begun < 0.99 / 3}
    assert len(searching) > 3 * 16  # every interval of the candidates and of both iterations
    everyone = ["neutral", "optimum", "mpc"]
    told = reported(lambda progress: compare([], everyone, network=bottles, episodes=2, progress=progress))
    seen = {what: len({share for each, share in told if each == what}) for what in [*everyone, "bounds"]}
    assert seen["neutral"] == 1 + 14 and seen["mpc"] == 1 + 2 + 14 and seen["bounds"] > 3 * 2
    assert seen["optimum"] > 2 * (1 + 1) + 14  # the bound and some rounds of improvement for both episodes


def test_evaluation_and_sweep_tell_how_far_they_are(bottles: Network, runs: list[Path], tmp_path: Path) -> None:
    """Bounds of an evaluation and plans of a sweep are several steps each."""
    told = reported(lambda progress: evaluate(runs[1], episodes=2, progress=progress))
    assert len({share for what, share in told if what == "bounds"}) >= 3 * 2 + 3
    told = reported(lambda progress: pareto_front(bottles, directory=tmp_path, points=3, progress=progress))
    assert len(set(told)) > 3 * 2


def test_files_are_whole_and_say_where_they_come_from(runs: list[Path], tmp_path: Path) -> None:
    """Every episode of every policy is a row; the provenance holds hashes of all that was read."""
    found = compare(runs, ["neutral"], episodes=3)
    paths = write_comparison(found, tmp_path / "out", episodes=3)
    assert [path.name for path in paths] == ["episodes.csv", "summary.csv", "summary.json", "comparison.png"]
    assert sorted(paths) == sorted((tmp_path / "out").iterdir())
    with (tmp_path / "out" / "episodes.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 4 * 3
    assert float(rows[0]["circularity (t)"]) == found.entries[0].circularity[0]
    assert {"training seed", "service level", "bound (t)", "gap to bound", "start seed"} <= set(rows[0])
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert [row["name"] for row in summary["rows"]] == ["independent_a2c", "neutral"]
    origin = summary["provenance"]
    assert [run["seed"] for run in origin["runs"]] == [0, 1, 2]
    assert all(len(run["config_sha256"]) == 64 for run in origin["runs"])
    assert {"numpy", "torch", "cirl-marl"} <= set(origin["versions"])
    assert len(origin["network"]["definition_sha256"]) == 64
    assert origin["options"] == {"episodes": 3}


def test_failed_writing_leaves_nothing(tmp_path: Path) -> None:
    """Neither files nor a new folder; an old folder keeps what it had."""
    (tmp_path / "old").mkdir()
    (tmp_path / "old" / "kept.txt").write_text("kept")
    for folder in ("new", "old"):
        with pytest.raises(RuntimeError, match="disk"), publish_folder(tmp_path / folder) as partial:
            (partial / "half.csv").write_text("half")
            raise RuntimeError("disk")
    assert sorted(str(path.relative_to(tmp_path)) for path in tmp_path.rglob("*")) == ["old", "old/kept.txt"]


def test_other_environments_are_refused(bottles: Network, runs: list[Path], tmp_path: Path) -> None:
    """The message names the run and what differs; observations and rewards may."""
    train(bottles, "independent_a2c", directory=tmp_path / "longer", steps=320, envs=8, horizon=15)
    with pytest.raises(RunError, match=r"longer: not the same environment as .*: horizon 15, not 14"):
        compare([runs[0], tmp_path / "longer"])
    train(bottles, "independent_a2c", directory=tmp_path / "alone", steps=320, envs=8, agents=["quarry"])
    with pytest.raises(RunError, match=r"agents \['quarry'\], not \['quarry', 'disposal'\]"):
        compare([runs[0], tmp_path / "alone"])
    with pytest.raises(RunError, match=r"0: not the same .* the network given: network 'bottles', not 'copper_net'"):
        compare(runs[:1], network="copper_net")
    with pytest.raises(RunError, match=r"scenario 'default', not 'crisis'"):
        compare(runs[:1], network=bottles, scenario="crisis")
    train(bottles, "independent_a2c", directory=tmp_path / "seeing", steps=320, envs=8, observe="full", reward="local")
    both = compare([runs[0], tmp_path / "seeing"], ["neutral"], episodes=2, bounds=False)
    assert [row.name for row in both.rows] == ["independent_a2c", f"independent_a2c ({tmp_path / 'seeing'})", "neutral"]


def test_recipes_called_like_controllers_are_no_controllers(bottles: Network, runs: list[Path], tmp_path: Path) -> None:
    """Gains refer to neutral control, whatever a recipe is called."""
    recipe = load_recipe("independent_a2c").model_copy(update={"name": "neutral"})
    train(bottles, recipe, directory=tmp_path / "run", seed=0, steps=320, envs=8)
    found = compare([tmp_path / "run"], episodes=3, bounds=False)
    same = compare(runs[:1], episodes=3, bounds=False)
    assert [row.name for row in found.rows] == [f"neutral ({tmp_path / 'run'})", "neutral", "random"]
    for one, other in zip(found.entries, same.entries, strict=True):
        np.testing.assert_array_equal(one.gain, other.gain)


def test_results_name_the_definition_that_was_read(bottles: Network, tmp_path: Path) -> None:
    """Not one that has been edited since, or that is gone."""
    assert bottles.source is not None
    path = tmp_path / "mine.toml"
    path.write_bytes(bottles.source.read_bytes())
    network = load_network(path)
    expected = hashlib.sha256(path.read_bytes()).hexdigest()
    path.write_text("no network any more")
    assert provenance(network)["network"]["file_sha256"] == expected
    path.unlink()
    assert provenance(network.with_options(episode={"horizon": 3}))["network"]["file_sha256"] == expected


def test_unfinished_runs_are_rows_of_their_own(
    bottles: Network, runs: list[Path], tmp_path: Path, ctrl_c_after: Callable[[int], Callable[[Progress], None]]
) -> None:
    """A run that was stopped is no seed of the recipe; its row says how far it came."""
    with pytest.raises(KeyboardInterrupt):
        train(
            bottles, "independent_a2c", directory=tmp_path / "run", seed=3, steps=320, envs=8, report=ctrl_c_after(80)
        )
    found = compare([*runs, tmp_path / "run"], ["neutral"], episodes=2, bounds=False)
    assert [(row.name, len(row.seeds)) for row in found.rows] == [
        ("independent_a2c", 3),
        ("independent_a2c, interrupted after 88 of 320 steps", 1),
        ("neutral", 0),
    ]


def test_bad_input(bottles: Network, runs: list[Path]) -> None:
    """Each mistake has its own message."""
    with pytest.raises(CirlError, match="give a training run or a network"):
        compare()
    with pytest.raises(CirlError, match=r"runs: 'copper_net' is a text; a list is needed, as \['copper_net'\]"):
        compare("copper_net")
    with pytest.raises(CirlError, match="controllers: 'neutral' is a text"):
        compare([], "neutral", network=bottles)
    with pytest.raises(CirlError, match="Did you mean 'mpc'"):
        compare([], ["mcp"], network=bottles)
    with pytest.raises(CirlError, match="must be distinct"):
        compare([], ["random", "random"], network=bottles)
    with pytest.raises(
        CirlError, match=r"tune 10: none of \['neutral', 'lqr'\] has a margin; add one of scripted, mpc"
    ):
        compare([], ["lqr"], network=bottles, min_service=0.9, tune=10)
    with pytest.raises(CirlError, match="at least 2"):
        compare(runs, episodes=1)
    with pytest.raises(RunError, match="the same recipe and seed 0"):
        compare([runs[0], runs[0]])


def test_evaluation_has_the_gap(runs: list[Path]) -> None:
    """``evaluate`` is the comparison of one run with neutral and random control."""
    evaluation = evaluate(runs[1], episodes=3)
    figures = evaluation.figures
    assert list(evaluation.rollouts) == ["trained", "neutral", "random"]
    same = compare([runs[1]], ["neutral", "random"], episodes=3)
    gap = same.entries[0].gap
    assert gap is not None
    assert figures["controllers"]["trained"]["gap"]["value"] == pytest.approx(float(gap.mean()))
    assert evaluation.write() == runs[1] / "evaluation.json"
    assert json.loads((runs[1] / "evaluation.json").read_text()) == figures
    assert f"gap to the bound {figures['controllers']['trained']['gap']['value']:.1%}" in str(evaluation)


def test_figures_are_of_the_checkpoint_that_acted(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """A run that is trained on while it is evaluated has newer policies, which are evaluated next time."""
    train("copper_net", ppo_recipe, directory=tmp_path, horizon=5, agents=["mine"])
    run = RunDirectory(tmp_path)
    moved: list[Training] = []

    def train_on(what: str, share: float) -> None:
        if not moved and what == "neutral":
            moved.append(resume(tmp_path, steps=160))

    evaluation = evaluate(run, episodes=2, bounds=False, progress=train_on)
    assert (evaluation.figures["checkpoint"], run.checkpoint.name) == ("000000040-complete", "000000080-complete")
    evaluation.write()
    again = evaluate(run, episodes=2, bounds=False)
    assert again.figures["checkpoint"] == "000000080-complete"
    assert json.loads(again.write().read_text()) == again.figures


def test_reports_keep_the_gap(runs: list[Path]) -> None:
    """Drawing a run again does not throw away what its evaluation found; other episodes take its place."""
    evaluate(runs[0], episodes=2).write()
    kept = (runs[0] / "evaluation.json").read_text()
    assert '"gap"' in kept
    evaluate(runs[0], episodes=2, bounds=False).write()
    assert (runs[0] / "evaluation.json").read_text() == kept
    evaluation = evaluate(runs[0], episodes=3, bounds=False)
    assert json.loads(evaluation.write().read_text()) == evaluation.figures


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"episode": {"horizon": 7}}, r"^horizon 7, not \d+$"),
        ({"episode": {"control_interval": 2.0}}, r"^episode Episode\(control_interval=2\.0, "),
        ({"episode": {"solver": "rk4", "solver_step": 0.05}}, r"^episode .*solver='rk4'"),
        ({"objective": {"reference_interval": 2.0}}, r"^reference interval 2\.0, not 1\.0$"),
        ({"objective": {"net_zero": "abs"}}, r"^net_zero 'abs', not 'signed'$"),
        ({"objective": {"circularity_weight": 0.9}}, None),
        ({"objective": {"reward": "local"}}, None),
        ({"observation": {"mode": "full"}}, None),
    ],
)
def test_what_makes_another_episode_is_named(changes: dict[str, dict[str, object]], message: str | None) -> None:
    """One change, one reason; rewards and observations are no reason not to compare."""
    network = load_network("copper_net")
    env, other = (MultiAgentVectorEnv(n, num_envs=1) for n in (network.with_options(**changes), network))
    found = list(differences(env, other))
    assert not found if message is None else len(found) == 1 and re.search(message, found[0])


def test_services_do_not_hide_compartments_of_their_name(bottles: Network) -> None:
    """A service may have the id of a node; a change of either is seen."""
    node = bottles.nodes[1]
    named = replace(bottles, services=(replace(bottles.services[0], id=node.id), *bottles.services[1:]))
    wider = replace(node, initial=(bottles.initial[0, 1], bottles.initial[1, 1] + 1.0))
    other = replace(named, nodes=(bottles.nodes[0], wider, *bottles.nodes[2:]))
    (found,) = differences(MultiAgentVectorEnv(named, num_envs=1), MultiAgentVectorEnv(other, num_envs=1))
    assert f"'{node.id}'" in found


def test_other_parts_and_agents_make_another_episode() -> None:
    """Compartments and services that differ are named, as are those who act, and no more than five of them."""
    network = load_network("copper_net")
    env = MultiAgentVectorEnv(network, num_envs=1)
    fewer = MultiAgentVectorEnv(network, num_envs=1, agents=["mine"])
    assert list(differences(fewer, env)) == [f"agents ['mine'], not {list(env.agents)}"]
    for part in ("nodes", "arcs", "services"):
        first, *rest = getattr(network, part)
        field = "low" if part == "services" else "scale"
        other: Any = {part: (replace(first, **{field: 3.0 * getattr(first, field)}), *rest)}
        changed = replace(network, **other)
        assert list(differences(MultiAgentVectorEnv(changed, num_envs=1), env)) == [f"the definition of '{first.id}'"]
    nodes = tuple(replace(node, scale=3.0 * node.scale) for node in network.nodes)
    (many,) = differences(MultiAgentVectorEnv(replace(network, nodes=nodes), num_envs=1), env)
    assert re.fullmatch(r"the definition of ('\w+', ){4}'\w+' and others", many)
