"""From plans to aims: plans made with known weights, closed forms, and tables that are plans of something else."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

import cirl_marl
from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Role,
    RunError,
    Series,
    Service,
    load_network,
)
from cirl_marl.controllers.basic import Random
from cirl_marl.controllers.schedule import schedule
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.optimum import Bound, NoCertificate, bound
from cirl_marl.reasons.inverse import ObjectiveWeights, infer
from cirl_marl.reasons.objective_terms import PlannedEpisode, objective_terms
from cirl_marl.reasons.plan_files import episodes_of_plan
from cirl_marl.reasons.prices import shadow_prices
from cirl_marl.report.objective_weights import weights_sentences, write_weights


def ladder(steps: int = 24, growth: float = 1.03, start: float = 1000.0, **arc: Any) -> Network:
    """Return a shop that needs more from interval to interval, so that a full level costs more in each."""
    low = Series(times=tuple(map(float, range(steps))), values=tuple(growth**t for t in range(steps)))
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=10.0)
    supply = Arc(id="supply", donor="mine", recipient="shop", law=Law.CONTROLLED, control=control, **arc)
    return Network(
        name="ladder",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(start, start)),
            Node(id="shop", initial=(0.0, 0.0)),
        ),
        arcs=(supply,),
        services=(Service(id="fed", provider="supply", quantity="flow", low=low),),
        episode=Episode(control_interval=1.0, horizon=steps),
    )


def course(found: Bound) -> PlannedEpisode:
    """Return the plan of the program itself."""
    return PlannedEpisode("plan", found.initial, found.stock[1:], found.flow)


def shares(found: ObjectiveWeights, weights: list[float]) -> Any:
    """Return weights as shares."""
    scaled = np.array(weights) * found.spread
    return scaled / scaled.sum()


def holds(found: ObjectiveWeights, weights: list[float]) -> None:
    """Assert that the cone contains these weights, and that its centre is within 5 % where it is that narrow."""
    assert found.fits(weights) and found.distance < 1e-6
    true = shares(found, weights)
    assert (found.low <= true + 1e-5).all() and (true <= found.high + 1e-5).all()
    assert found.fits(found.weights(found.centre))
    for j in range(len(true)):
        if found.high[j] - found.low[j] <= 0.05 * found.low[j]:
            assert found.centre[j] == pytest.approx(true[j], rel=0.05)


@pytest.mark.medium
@settings(max_examples=3)
@given(weight=st.floats(1.01, 1.9))
def test_the_weight_of_a_plan_is_found(weight: float) -> None:
    """The level is worth serving where it costs less than its weight: steps of 3 % enclose the weight."""
    found = infer(ladder(), course(bound(ladder(), service_weight=weight)), within=0.0)
    holds(found, [1.0, weight])
    assert found.identifiable == [0, 1], "the cone is narrow"
    assert found.weights(found.centre)[1] == pytest.approx(weight, rel=0.05)


def test_several_plans_narrow_the_cone() -> None:
    """Plans of two networks of one kind that were made with the same weights, each from its own start."""
    network, weight = ladder(growth=1.2, steps=8), 2.0
    starts = [1000.0, 9.0]
    plans = [course(bound(network, {"mine": start}, service_weight=weight)) for start in starts]
    one = infer(network, plans[0], within=0.0)
    both = infer(network, plans, within=0.0)
    for each in (one, both):
        holds(each, [1.0, weight])
    assert both.plans == ("plan", "plan")
    widths = [each.high / each.spread - each.low / each.spread for each in (one, both)]
    assert (widths[1] <= widths[0] + 1e-6).all()


def test_what_is_found_in_no_time_holds() -> None:
    """Ranges of a search that is cut short enclose those of one that is not, and it says that it was."""
    network = ladder(growth=1.2, steps=8)
    made = course(bound(network, service_weight=2.0))
    whole, part = infer(network, made), infer(network, made, seconds=0.0)
    assert whole.finished and not part.finished and part.programs < whole.programs
    assert (part.low <= whole.low + 1e-6).all() and (part.high >= whole.high - 1e-6).all()
    assert any("Time ran out" in sentence for sentence in weights_sentences(part))
    assert not any("Time ran out" in sentence for sentence in weights_sentences(whole))
    wide = infer(network, made, within=0.9)
    assert not wide.identifiable and any("No weight is identified: many" in said for said in weights_sentences(wide))


@pytest.mark.parametrize("network", ["carbo_net"])
def test_a_demanded_level_is_worth_its_shadow_price(network: str) -> None:
    """A plan that was made for a level, not for weights, is best for the prices of the levels."""
    short = load_network(network).with_options(episode={"horizon": 4})
    prices = shadow_prices(short, min_service=0.9)
    weighed = objective_terms(short, ["circularity", "services"])
    parts = [each for each in weighed if each.kind == "circularity"]
    found = infer(short, course(prices.bound), kinds=["circularity", "services"], within=1e-4)
    assert found.fits([1.0] * len(parts) + (-prices.level).tolist())
    assert found.distance < 1e-4


def through_a_yard(network: Network) -> Network:
    """Return the ladder with what is supplied, and its set-point, passing a node without stock."""
    supply = network.arcs[0]
    yard = Node(id="yard", stores=False, set_point=supply.set_point, scale=supply.scale)
    arcs = (
        replace(supply, recipient="yard", set_point=None, scale=1.0),
        Arc(id="on", donor="yard", recipient="shop", law=Law.SHARE),
    )
    return replace(network, nodes=(*network.nodes, yard), arcs=arcs)


@pytest.mark.parametrize("passes", [False, True])
def test_set_points_bend(passes: bool) -> None:
    """The flow f = p − w₁ s²/(2 w₂) is best for −w₁ f − w₂ ((f − p)/s)²: a plan tells the ratio."""
    network = replace(ladder(steps=4, set_point=5.0, scale=2.0), services=())
    if passes:
        network = through_a_yard(network)
    flow = 3.0
    stock = np.cumsum(np.full(4, flow))
    flows = np.full((4, len(network.arcs)), flow)
    made = PlannedEpisode("by hand", np.array([1000.0, 0.0]), np.stack([1000 - stock, stock], axis=1), flows)
    found = infer(network, made, within=0.0)
    assert [each.kind for each in found.terms] == ["circularity", "set-points"]
    # 3 = 5 − w₁ · 4/(2 w₂), so w₂ = w₁
    np.testing.assert_allclose(found.weights(found.centre), [1.0, 1.0], rtol=1e-4)
    assert found.identifiable == [0, 1] and found.distance < 1e-9


def test_what_nothing_changes_cannot_be_told() -> None:
    """An exogenous loss is part of λ whatever is done: its weight may be anything."""
    network = ladder(steps=6)
    nodes = (*network.nodes, Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)))
    loss = Arc(id="loss", donor="shop", recipient="tip", law=Law.EXOGENOUS, flow=0.0)
    other = replace(network, nodes=nodes, arcs=(*network.arcs, loss))
    found = infer(other, course(bound(other, service_weight=1.1)), within=0.0)
    idle = [each.name for each in found.terms].index("put into landfills")
    assert found.spread[idle] == 0 and (found.low[idle], found.high[idle]) == (0.0, 1.0)
    assert any("put into landfills" in said and "nothing" in said for said in weights_sentences(found))


@pytest.mark.medium
def test_a_poor_plan_is_far_from_the_best() -> None:
    """Under every weight some other plan is better; the least of that is what is said."""
    network = ladder(steps=8, growth=1.1)
    flow = np.full((8, 1), 0.0)
    flow[-1] = network.interval_means(network.services[0].low)[-1]  # it serves when that costs most
    stock = np.cumsum(flow[:, 0])
    made = PlannedEpisode("late", np.array([1000.0, 0.0]), np.stack([1000 - stock, stock], axis=1), flow)
    found = infer(network, made, within=0.0)

    def short(share: float) -> float:
        w = share / found.spread[0], (1 - share) / found.spread[1]
        best = bound(network, service_weight=w[1] / w[0]).objective * w[0]
        return float(best + w[0] * flow.mean() - w[1] / 8)

    least = minimize_scalar(short, bounds=(0.02, 0.98), method="bounded", options={"xatol": 1e-4})
    assert found.distance == pytest.approx(least.fun, abs=1e-3)
    assert found.distance > 0.01
    assert any("short of the best" in said for said in weights_sentences(found))


def test_tables_of_plan_and_simulate_are_the_same_course(tmp_path: Path) -> None:
    """One holds controls and is carried out again, the other stocks and flows; another seed or network is refused."""
    network = load_network("carbo_net").with_options(episode={"horizon": 5})
    env = MultiAgentVectorEnv(network, num_envs=1)
    planned = schedule(env, Random(), seed=3)
    planned.write(tmp_path / "plan.csv")
    simulation = Simulation("", "random", env, planned.episode_start, planned.rollout)
    simulation.write(tmp_path / "simulated.csv")
    (one,) = episodes_of_plan(network, tmp_path / "plan.csv", seed=3)
    (two,) = episodes_of_plan(network, tmp_path / "simulated.csv")
    for which in ("initial", "stock", "flow"):
        np.testing.assert_allclose(getattr(one, which), getattr(two, which), rtol=1e-7, atol=1e-9)
    np.testing.assert_allclose(one.flow, planned.rollout.flow, rtol=1e-7, atol=1e-9)
    with pytest.raises(CirlError, match=r"of another start \(--seed\), scenario or definition"):
        episodes_of_plan(network, tmp_path / "plan.csv")
    other = load_network("copper_net").with_options(episode={"horizon": 5})
    for file in ("plan.csv", "simulated.csv"):
        with pytest.raises(CirlError, match=f"{file}: unknown column"):
            episodes_of_plan(other, tmp_path / file)
        with pytest.raises(CirlError, match="has 5 intervals, an episode of 'carbo_net' has 160"):
            episodes_of_plan(load_network("carbo_net"), tmp_path / file)
    text = (tmp_path / "plan.csv").read_text().splitlines()
    (tmp_path / "bad.csv").write_text("\n".join([text[0], text[1].replace(text[1].split(",")[2], "x", 1), *text[2:]]))
    with pytest.raises(CirlError, match=r"bad\.csv, line 2: .* is 'x', not a number"):
        episodes_of_plan(network, tmp_path / "bad.csv", seed=3)
    (tmp_path / "short.csv").write_text("\n".join([*text[:2], "1,2"]))
    with pytest.raises(CirlError, match=r"line 3: 2 cells in"):
        episodes_of_plan(network, tmp_path / "short.csv", seed=3)


@pytest.mark.medium
def test_policies_have_aims_too(copper_run: Path, tmp_path: Path) -> None:
    """Episodes of a run are plans from several starts; a run of another network is refused."""
    found = infer("copper_net", copper_run, episodes=2, kinds=["circularity", "services"])
    assert len(found.plans) == 2 and found.network.episode.horizon == 5 and 0 <= found.distance <= 1
    assert (found.low <= found.centre + 1e-9).all() and (found.centre <= found.high + 1e-9).all()
    path = write_weights(found, tmp_path / "aims.csv")
    assert len(path.read_text().splitlines()) == 1 + len(found.terms)
    shutil.copytree(copper_run, weighted := tmp_path / "weighted")
    config = json.loads((weighted / "config.json").read_text())
    config["options"]["circularity_weight"] = 0.87  # how it was paid, not what it did
    (weighted / "config.json").write_text(json.dumps(config))
    same = infer("copper_net", weighted, episodes=2, kinds=["circularity", "services"])
    np.testing.assert_array_equal(same.centre, found.centre)
    with pytest.raises(RunError, match="was trained on 'copper_net'"):
        infer("carbo_net", copper_run)


@pytest.mark.parametrize(
    ("plans", "options", "said"),
    [
        ("none.csv", {}, r"none\.csv: no such file; a plan is a CSV file"),
        ([], {}, "no plans were given"),
        ("none.csv", {"within": 1.5}, "within 1.5 must be at least 0"),
        ("none.csv", {"kinds": ["service"]}, "unknown kind 'service'. Did you mean 'services'"),
        ("none.csv", {"kinds": ["services"]}, "nothing to weigh: of services it has 1 term"),
        ("none.csv", {"episodes": 0}, "episodes must be a whole number of at least 1"),
    ],
)
def test_bad_questions(plans: Any, options: dict[str, Any], said: str) -> None:
    """Each is refused in words."""
    with pytest.raises(CirlError, match=said):
        cirl_marl.infer("copper_net", plans, **options)


def test_weights_that_cannot_be() -> None:
    """As many as terms, none negative; and no certificate, no aims."""
    found = infer(ladder(), course(bound(ladder(), service_weight=1.5)))
    for wrong in ([1.0], [-1.0, 1.0], [0.0, 0.0]):
        with pytest.raises(CirlError, match="needs one for each of 2 terms"):
            found.fits(wrong)
    with pytest.raises(NoCertificate, match="inner physics"):
        cirl_marl.infer("net_zero", "any.csv")
