"""Demanded levels hold for each service: of two, the dear one could be starved for λ at the same mean level."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

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
    Objective,
    Role,
    Service,
    load_network,
)
from cirl_marl.cli.episodes import simulate
from cirl_marl.controllers import Constant, Neutral, Random
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.reader import write_network
from cirl_marl.evaluation import compare, solve_baseline
from cirl_marl.evaluation.pareto import pareto_front
from cirl_marl.optimum import Plan, bound, envelope, improve_plan, search, simulate_plan
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.bounds import highest_service
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.open_loop import Optimum
from cirl_marl.optimum.options import starting_stocks
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.vintages import Lifetimes

Levels = float | list[float]


def order(name: str, recipient: str) -> Arc:
    """Return an arc from the mine whose flow is set between 0 and 9."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=4.5, high=9.0)
    return Arc(id=name, donor="mine", recipient=recipient, law=Law.CONTROLLED, control=control)


def town(reserve: float = 1000.0, cars: float = 10.0, homes: float = 10.0) -> Network:
    """Return a mine that builds cars, which last short, and homes, which last long; 10 of each are wanted."""
    stocks = {"mine": reserve, "cars": cars, "homes": homes, "tip": 0.0}
    roles = {"mine": Role.NONRENEWABLE_RESERVOIR, "tip": Role.LANDFILL}
    nodes = [Node(id=n, role=roles.get(n, Role.TECHNOSPHERE), initial=(x, x)) for n, x in stocks.items()]
    lives = {"cars": 0.6, "homes": 0.1}
    wastes = [Arc(id=f"old_{name}", donor=name, recipient="tip", rate=rate) for name, rate in lives.items()]
    wanted = {"mobility": "cars", "housing": "homes"}
    return Network(
        name="town",
        nodes=tuple(nodes),
        arcs=(order("to_cars", "cars"), order("to_homes", "homes"), *wastes),
        services=tuple(Service(id=s, provider=p, quantity="stock", low=10.0) for s, p in wanted.items()),
        episode=Episode(control_interval=0.5, horizon=8),
        objective=Objective(circularity_scale=10.0),
    )


@pytest.mark.parametrize("demanded", [0.8, [0.5, 0.9], [0.7, 0.0]])
def test_each_service_is_held(demanded: Levels) -> None:
    """By the plan of the bound, improved, by optimum control, MPC with and without a window, and by the search."""
    found = bound(town(), min_service=demanded)
    assert (found.levels >= np.array(demanded) - 1e-6).all()
    played = {
        "improved": simulate_plan(improve_plan(found)),
        "optimum": rollout(MultiAgentVectorEnv(town(), num_envs=1), Optimum(min_service=demanded)),
        "mpc": rollout(MultiAgentVectorEnv(town(), num_envs=1), MPC(min_service=demanded)),
        "window": rollout(MultiAgentVectorEnv(town(), num_envs=1), MPC(min_service=demanded, horizon=4)),
    }
    for name, run in played.items():
        assert (run.episode_levels[0] >= np.array(demanded) - 1e-3).all(), name
        assert abs(found.gap(run.episode_circularity)[0]) < 0.01, name
    searched = search(town(), min_service=demanded, knots=2, iterations=20)
    assert (searched.levels >= np.array(demanded) - 2e-3).all()
    replayed = rollout(MultiAgentVectorEnv(town(), num_envs=1), Plan(searched))
    np.testing.assert_allclose(replayed.episode_levels[0], searched.levels)
    assert searched.service == pytest.approx(searched.levels.mean())


def test_improvement_finds_what_every_service_lacks() -> None:
    """From a plan that builds nothing, first steps that reach neither demand go towards both."""
    found = bound(town(), min_service=[0.7, 0.9])
    idle = replace(found, actions=np.full_like(found.actions, -1.0))
    first = simulate_plan(improve_plan(idle, rounds=1)).episode_levels[0] - simulate_plan(idle).episode_levels[0]
    assert (first > 0.02).all()
    run = simulate_plan(improve_plan(idle))
    assert (run.episode_levels[0] >= np.array([0.7, 0.9]) - 1e-4).all()
    assert 0 <= found.gap(run.episode_circularity)[0] < 0.01


def test_the_mean_would_starve_the_dear_one() -> None:
    """At the same mean level λ̄ is better with fewer cars: who demands 0.7 of each service is promised no such λ̄."""
    starving, fair = bound(town(), min_service=[0.4, 1.0]), bound(town(), min_service=0.7)
    assert starving.service == pytest.approx(fair.service, abs=1e-3)
    assert starving.objective > fair.objective + 1.0
    np.testing.assert_allclose(fair.levels, [0.7, 0.7], atol=0.1)


def test_levels_are_broadcast() -> None:
    """A number is for every service; rows of levels are for each start or each question."""
    found = bound(town(), min_service=[0.5, 0.9])
    both = found.at(min_service=[[0.5, 0.9], [0.9, 0.5], [0.7, 0.7]])
    assert both.shape == (3,) and both[0] == found.objective
    np.testing.assert_array_equal(found.at(min_service=[[0.5], [0.7]]), found.at(min_service=[[0.5] * 2, [0.7] * 2]))
    assert found.at(min_service=0.7) == both[2]
    starts = np.tile(found.initial, (3, 1)) * [[1.0], [1.1], [0.9]]
    levels = np.array([[0.5, 0.9], [0.9, 0.5], [0.6, 0.6]])
    proved = envelope(town(), starts, min_service=levels, solves=4).at(starts, levels)
    solved = [bound(town(), start, min_service=level).objective for start, level in zip(starts, levels, strict=True)]
    np.testing.assert_allclose(proved, solved, rtol=1e-6)
    with pytest.raises(CirlError, match=r"shape \(3,\), expected \(2,\): a level for each service \(mobility, housing"):
        bound(town(), min_service=[0.1, 0.2, 0.3])
    with pytest.raises(CirlError, match=r"shape \(3,\), expected \(3, 2\)"):
        envelope(town(), starts, min_service=[0.1, 0.2, 0.3])
    with pytest.raises(CirlError, match=r"shape \(1, 2\), expected \(2,\)"):
        rollout(MultiAgentVectorEnv(town(), num_envs=1), MPC(min_service=[[0.1, 0.2]]))
    with pytest.raises(CirlError, match=r"min_service 1\.2 must lie in"):
        found.at(min_service=[0.5, 1.2])


def test_the_service_that_cannot_be_had_is_named() -> None:
    """With the highest level of each; where each can be had but not both, with those that can be had together."""
    poor = town(cars=0.0, homes=0.0)
    most = {}
    for name, levels in {"housing": [0.3, 1.0], "mobility": [1.0, 0.1]}.items():
        with pytest.raises(CirlError, match=rf"no actions reach a mean service level of 1 of '{name}' \(at m") as told:
            bound(poor, min_service=levels)
        most[name] = float(str(told.value).split("(at most ")[1].rstrip(")"))
    reached = rollout(
        MultiAgentVectorEnv(poor, num_envs=1), Constant({"to_cars": 1.0, "to_homes": 1.0})
    ).episode_levels[0]
    np.testing.assert_allclose([most["mobility"], most["housing"]], reached, rtol=1e-2)
    scarce = town(reserve=12.0, cars=0.0, homes=0.0)
    together = highest_service(scarce)
    with pytest.raises(CirlError, match=rf"0\.4 of 'mobility' \(at most {together:.6g}\), 0\.4 of 'hou.* same time$"):
        bound(scarce, min_service=0.4)
    assert bound(scarce, min_service=together - 1e-6).levels == pytest.approx([together] * 2, abs=1e-4)


def test_the_highest_level_of_a_service_beside_what_another_asks() -> None:
    """The more of what is scarce homes have, the less there is for cars; a bit more has no solution."""
    scarce = town(reserve=12.0, cars=0.0, homes=0.0)
    aim = scarce.services[0].id
    most = [float(bound(scarce, aim=aim, min_service=[0.0, demand]).objective) for demand in (0.0, 0.3, 0.5)]
    assert most[0] > most[1] + 0.05 > most[2] + 0.1
    assert bound(scarce, min_service=[most[1] - 1e-5, 0.3]).levels[1] >= 0.3 - 1e-5
    with pytest.raises(CirlError, match="no actions reach"):
        bound(scarce, min_service=[most[1] + 1e-4, 0.3])


def test_weighed_levels_have_bounds_and_plans() -> None:
    """Beside λ̄ or alone; multipliers prove it; weights below 0, other names, and MPC are refused."""
    scarce = town(reserve=12.0, cars=0.0, homes=0.0)
    alone = bound(scarce, aim={"housing": 1.0})
    assert str(alone).startswith("bound of town over 8 steps: level of housing ≤ 0.88")
    weighed = bound(scarce, aim={"circularity": 0.01, "mobility": 1.0, "housing": 2.0})
    assert weighed.verify().bound == weighed.objective
    run = simulate_plan(improve_plan(replace(weighed, actions=np.zeros_like(weighed.actions))))
    value = 0.01 * run.episode_circularity[0] + run.episode_levels[0] @ [1.0, 2.0]
    assert weighed.aims.value(run) == pytest.approx(value)
    assert value <= weighed.objective <= value + 0.01 * abs(value)
    drawn = rollout(MultiAgentVectorEnv(scarce, num_envs=32), Random())
    values = 0.01 * drawn.episode_circularity + drawn.episode_levels @ [1.0, 2.0]
    assert (values <= weighed.objective + 1e-9).all() and values.max() > 0.3 * weighed.objective
    for aim, message in (
        ({"housing": -1.0}, "the weight of 'housing' must not be negative, got -1"),
        ("houses", "aim: unknown account or service 'houses'"),
    ):
        with pytest.raises(CirlError, match=message):
            bound(scarce, aim=aim)
    with pytest.raises(CirlError, match="aim: unknown account 'housing'"):
        rollout(MultiAgentVectorEnv(scarce, num_envs=1), MPC(aim="housing"))


def test_mpc_approaches_one_demand_and_leaves_the_other() -> None:
    """Homes come as near as they can, for which cars neither starve nor are built beyond what is asked."""
    env = MultiAgentVectorEnv(town(cars=0.0, homes=1.0), num_envs=1)
    most = rollout(env, Constant({"to_cars": 1.0, "to_homes": 1.0})).episode_levels[0, 1]
    found = bound(env.network, min_service=[0.3, most - 1e-3])
    for horizon, replan in ((None, None), (4, None), (None, 1), (4, 1)):
        run = rollout(env, MPC(min_service=[0.3, 0.99], horizon=horizon, replan=replan))
        np.testing.assert_allclose(run.episode_levels[0], [0.3, most], atol=2e-3)
        assert found.gap(run.episode_circularity)[0] < 0.01  # what is out of reach costs no more than it takes


def test_episodes_are_held_against_what_each_service_got() -> None:
    """Plans that starve one service are no better than their bound, which is that for the levels they delivered."""
    found = compare([], ["neutral", "optimum"], network=town(), episodes=2, min_service=[0.4, 1.0])
    plan = found.entries[1]
    assert plan.gap is not None and plan.bound is not None
    assert (plan.gap >= 0).all() and (plan.gap < 0.02).all()
    starts = np.tile(starting_stocks(Lifetimes(town(), ()), None), (2, 1))
    np.testing.assert_array_equal(plan.bound, found.baseline.at(starts, plan.rollout.episode_levels))
    np.testing.assert_allclose(plan.rollout.least_service, 0.4, atol=1e-3)
    np.testing.assert_allclose(plan.service, 0.7, atol=1e-3)
    # what was said of the same mean level in every service lies below what the plan achieved
    fair = solve_baseline(town(), (), starts, [np.full((2, 2), 0.7)])
    proved = fair.at(starts, np.full((2, 2), 0.7))
    assert proved is not None and (proved < plan.circularity).all()
    # points of the picture lie at the least level, so that none is above the front
    assert found.baseline.front[0, 0] == pytest.approx(0.4, abs=1e-3)


@pytest.mark.medium
def test_sweep_ends_where_all_services_can_be_had(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Where services compete, no more is demanded of each than both can have, and each plan gives it to both."""
    scarce = town(reserve=8.0, cars=0.0, homes=4.0)
    found = pareto_front(scarce, directory=tmp_path_factory.mktemp("sweep"), points=3)
    bounds, plans = found.of("bound"), found.of("plan")
    assert bounds[-1].service == pytest.approx(highest_service(scarce), abs=2e-4)
    for most, plan in zip(bounds, plans, strict=True):
        assert plan.service == pytest.approx(most.service, abs=5e-3)
        assert plan.circularity <= most.circularity + 1e-9 or plan.service < most.service


def test_episodes_sum_up_each_service() -> None:
    """Over a restart and a snapshot too; what is reported beside λ is the mean of the services."""
    env = MultiAgentVectorEnv(town(), num_envs=2, horizon=3)
    env.reset(seed=0)
    actions = {"to_cars": np.full((2, 1), -1.0), "to_homes": np.full((2, 1), 1.0)}
    expected: NDArray[np.float64] = np.zeros((2, 2))
    for step in range(3):
        if step == 1:
            taken = env.snapshot()
        *_, infos = env.step(actions)
        stock = infos["to_cars"]["final_info"]["state"].T if step == 2 else env.physical.stock
        levels = np.minimum(1.0, stock[1:3] / 10.0)
        expected += levels
        np.testing.assert_allclose(infos["to_cars"]["service_level"], levels.mean(axis=0))
    np.testing.assert_allclose(infos["to_cars"]["episode_service_level"], expected.mean(axis=0) / 3)
    np.testing.assert_array_equal(env.physical.service, np.zeros((2, 2)))
    env.restore(taken)
    for _ in range(2):
        outcome = env.advance(env.stack(actions))
    np.testing.assert_allclose(env.physical.service, expected)
    run = rollout(env, Constant({"to_cars": -1.0, "to_homes": 1.0}))
    np.testing.assert_allclose(run.episode_levels.T, expected / 3)
    np.testing.assert_allclose(run.least_service, expected.min(axis=0) / 3)
    np.testing.assert_allclose(run.episode_service, expected.mean(axis=0) / 3)
    np.testing.assert_allclose(run.levels[:, :, -1].T, outcome.levels)


def test_networks_without_services() -> None:
    """Any level is met, there are no rows for it, and episodes have the level 1."""
    still = replace(town(), services=())
    for options in ({}, {"min_service": 0.9}, {"service_weight": 2.0}):
        found = bound(still, **options)  # type: ignore[call-overload]
        run = simulate_plan(improve_plan(found, rounds=2))
        assert (found.service, found.levels.shape, run.episode_levels.shape) == (1.0, (0,), (1, 0))
        assert run.least_service == run.episode_service == 1.0
    env = MultiAgentVectorEnv(still, num_envs=2, horizon=2)
    assert rollout(env, MPC(min_service=0.9)).levels.shape == (2, 0, 2)
    assert search(still, min_service=0.9, knots=1, iterations=1).levels.shape == (0,)
    env.restore(env.snapshot())
    env.reset()
    for _ in range(2):
        *_, infos = env.step(env.unstack(np.zeros((2, 2))))
    assert env.physical.service.shape == (0, 2)
    np.testing.assert_array_equal(infos["to_cars"]["episode_service_level"], 1.0)
    gaps = [entry.gap for entry in compare([], ["neutral", "mpc"], network=still, episodes=2).entries]
    assert all(each is not None and (each >= 0).all() for each in gaps)
    assert rollout(env, Neutral()).least_service.tolist() == [1.0, 1.0]


def test_one_service_is_the_mean() -> None:
    """Of a single service the row is that of the mean level: −1/steps for its level in each interval."""
    admissible = Admissible.of(load_network("copper_net").with_options(episode={"horizon": 5}))
    programs = Programs(admissible, 1, None)
    start = starting_stocks(admissible.lifetimes, None)
    free, held = programs.program(start), programs.program(start, 0.9)
    assert held.under.shape[0] == free.under.shape[0] + 1
    row = held.under[[-1]].toarray().reshape(5, -1)
    assert np.flatnonzero(row[0]).tolist() == [programs.layout.level]
    np.testing.assert_array_equal(row[:, programs.layout.level], -1.0 / 5)
    np.testing.assert_array_equal(held.under_to, np.append(free.under_to, -0.9))


def test_a_simulation_says_the_level_of_each(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Beside the mean, which hides the one that starves."""
    monkeypatch.chdir(tmp_path)
    write_network(town(cars=0.0), Path("town.toml"))
    simulate("town.toml", set_=[], control=["neutral"])
    printed = " ".join(capsys.readouterr().out.split())
    run = rollout(MultiAgentVectorEnv("town.toml", num_envs=1), Neutral())
    mobility, housing = run.episode_levels[0]
    assert f"service levels: mobility {mobility:.4f}, housing {housing:.4f}" in printed
    assert mobility < housing
