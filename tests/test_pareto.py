"""Sweeps between service and circularity: bounds above plans, trainings kept, honest where nothing is proved."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest

from cirl_marl.definitions.catalogue import folder, load_network
from cirl_marl.errors import CirlError, RunError
from cirl_marl.evaluation.baselines import FRONT
from cirl_marl.evaluation.pareto import ParetoFront, pareto_front
from cirl_marl.learners.recipe import load_recipe
from cirl_marl.network import Network
from cirl_marl.optimum import NoCertificate, bound
from cirl_marl.report.tradeoffs import write_front

pytestmark = pytest.mark.medium


def swept(network: Network, directory: Path, **options: object) -> ParetoFront:
    """Sweep with three weights and a short training."""
    return pareto_front(network, "independent_a2c", directory=directory, points=3, steps=320, episodes=2, **options)  # type: ignore[arg-type]


def test_bounds_are_above_plans(bottles: Network, tmp_path: Path) -> None:
    """More service costs circularity; each plan delivers what was demanded and stays below its bound."""
    shares = list[float]()
    found = pareto_front(
        bottles, directory=str(tmp_path), points=4, progress=lambda activity, share: shares.append(share)
    )
    assert shares == sorted(shares) and shares[0] == 0.0 and shares[-1] == 1.0 and len(set(shares)) > 8
    bounds, plans = found.of("bound"), found.of("plan")
    assert len(bounds) == len(plans) == 4
    assert (np.diff([each.service for each in bounds]) > 0).all()
    assert (np.diff([each.circularity for each in bounds]) <= 1e-9).all()
    for most, plan in zip(bounds, plans, strict=True):
        assert plan.service >= most.service - 1e-3
        assert plan.circularity <= most.circularity + 1e-9 or plan.service < most.service
        assert plan.circularity == pytest.approx(most.circularity, rel=0.05)
    assert list(tmp_path.iterdir()) == []
    # from where service costs nothing to where no more can be had, in equal steps
    assert bounds[0].circularity == pytest.approx(bound(bottles).objective, rel=1e-4)
    assert bounds[1].circularity < bounds[0].circularity - 1e-3 * abs(bounds[0].circularity)
    with pytest.raises(CirlError):
        bound(bottles, min_service=bounds[-1].service + 3e-4)
    np.testing.assert_allclose(np.diff([each.service for each in bounds], 2), 0.0, atol=2.1e-4)
    # what their multipliers prove between them, and where each is solved just that
    levels, circularity = found.front.T
    assert levels.shape == (FRONT,)
    np.testing.assert_allclose(levels[[0, -1]], [bounds[0].service, bounds[-1].service], atol=1.1e-4)
    assert (np.diff(circularity) <= 1e-9).all()
    for most in bounds:
        assert np.interp(most.service, levels, circularity) == pytest.approx(most.circularity, rel=2e-2)


@pytest.mark.slow
def test_trainings_are_kept(bottles: Network, tmp_path: Path) -> None:
    """Every weight is trained once; the second time nothing is, and the figures are the same."""
    found = swept(bottles, tmp_path)
    assert [each.weight for each in found.of("trained")] == [0.0, 0.5, 1.0]
    stamps = {path: path.stat().st_mtime_ns for path in tmp_path.rglob("status.json")}
    assert len(stamps) == 3
    again = swept(bottles, tmp_path)
    assert again.points == found.points
    assert {path: path.stat().st_mtime_ns for path in tmp_path.rglob("status.json")} == stamps
    paths = write_front(found, tmp_path / "out", points=3)
    assert [path.name for path in paths] == ["pareto.csv", "pareto.json", "pareto.png"]
    with (tmp_path / "out" / "pareto.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["kind"] for row in rows].count("trained") == 3
    assert {row["circularity weight"] for row in rows} == {"", "0.0", "0.5", "1.0"}
    longer = pareto_front(bottles, "independent_a2c", directory=tmp_path / "other", points=2, steps=640, episodes=2)
    (tmp_path / "runs").rename(tmp_path / "old")
    (tmp_path / "other" / "runs").rename(tmp_path / "runs")
    assert len(longer.runs) == 2
    with pytest.raises(RunError, match=r"another sweep \(640 steps, not 320\); choose another folder"):
        swept(bottles, tmp_path)


@pytest.mark.slow
def test_swept_weights_stay_as_they_are(bottles: Network, tmp_path: Path) -> None:
    """Also by a recipe that moves the price of service for what it demands; the best checkpoint is paid most."""
    given = load_recipe("independent_a2c")
    moving = {"min_service": 1.0, "price_rate": 1.0, "evaluations": 8, "episodes": 2}
    given = given.model_copy(update={"run": given.run.model_copy(update=moving)})
    options = {"directory": tmp_path, "points": 2, "steps": 5120, "episodes": 2}
    for weight, run in zip((0.0, 1.0), pareto_front(bottles, given, **options).runs, strict=True):  # type: ignore[arg-type]
        with (run.path / "evaluations.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        assert len(rows) > 4
        assert {float(row["circularity_weight"]) for row in rows} == {weight}
        paid = [float(row["paid"]) for row in rows]
        best = [value > max(paid[:i], default=-np.inf) for i, value in enumerate(paid)]
        assert [row["best"] == "1" for row in rows] == best


@pytest.mark.slow
def test_runs_without_a_checkpoint_are_begun_again_by_their_owner_only(bottles: Network, tmp_path: Path) -> None:
    """What another process trains is left alone, even before its first checkpoint; what nobody trains is begun anew."""
    found = swept(bottles, tmp_path)
    run = found.runs[0]
    status = json.loads((run.path / "status.json").read_text())
    (run.path / "status.json").write_text(json.dumps(status | {"state": "running", "checkpoint": None}))
    kept = sorted(path.name for path in run.path.iterdir())
    with run.lock(), pytest.raises(RunError, match="is being trained"):
        swept(bottles, tmp_path)
    assert sorted(path.name for path in run.path.iterdir()) == kept
    assert swept(bottles, tmp_path).points == found.points


def test_network_without_certificate(tmp_path: Path) -> None:
    """Only the learners have a front, with the reason; without learners there is nothing to show."""
    short = load_network("net_zero").with_options(episode={"horizon": 8})
    with pytest.raises(NoCertificate, match="no bound is proved"):
        pareto_front(short, directory=tmp_path)
    found = pareto_front(short, "independent_a2c", directory=tmp_path, points=2, steps=320, episodes=2)
    assert found.of("bound") == found.of("plan") == []
    assert len(found.of("trained")) == 2
    assert "no bound is proved" in found.reason


def test_weight_without_effect_is_refused(bottles: Network, tmp_path: Path) -> None:
    """A reward in which the weight has no part cannot be swept; nothing is trained."""
    recipe = (folder("agents") / "independent_a2c.toml").read_text()
    path = tmp_path / "team.toml"
    path.write_text(recipe + '\n[environment]\nreward = "circularity"\n')
    with pytest.raises(CirlError, match="the weight of circularity has no part"):
        pareto_front(bottles, path, directory=tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_recipe_of_another_scenario_is_refused(bottles: Network, tmp_path: Path) -> None:
    """Bounds of one scenario beside policies of another would say nothing."""
    recipe = load_recipe("independent_a2c")
    other = recipe.model_copy(update={"environment": recipe.environment | {"scenario": "crisis"}})
    with pytest.raises(CirlError, match="is for scenario 'crisis', the sweep for 'default'"):
        pareto_front(bottles, other, directory=tmp_path, points=2)
    budget = recipe.model_copy(update={"run": recipe.run.model_copy(update={"at_most": {"cost": 3.0}})})
    with pytest.raises(CirlError, match=r"run\.at_most: cost: no price moves while weights are compared"):
        pareto_front(bottles, budget, directory=tmp_path, points=2)
    found = pareto_front(bottles, other, directory=tmp_path, scenario="crisis", points=2, steps=320, episodes=2)
    assert {run.config.scenario for run in found.runs} == {"crisis"}
