"""Two and three aims against each other: proved and achieved fronts, their volumes, and limits of idle supplies."""

from __future__ import annotations

import csv
import itertools
import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from rich.console import Console
from small_networks import city, with_lambda
from test_each_service import town as scarce_town
from test_supply import town
from typer.testing import CliRunner

from cirl_marl import (
    Account,
    Arc,
    CirlError,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Service,
    account_front,
    load_network,
    write_network,
)
from cirl_marl.cli import app
from cirl_marl.controllers import Constant
from cirl_marl.controllers.basic import Neutral
from cirl_marl.controllers.rollout import Rollout, episode_start, rollout
from cirl_marl.drawing.style import save
from cirl_marl.evaluation.account_front import AccountFront, _Sweep, _within_reach, volume_dominated
from cirl_marl.network.elements import Role
from cirl_marl.optimum import bound, improve_plan, simulate_plan, supply_limits
from cirl_marl.optimum.aims import Budget
from cirl_marl.optimum.supply_limits import _with_ends, with_supply_limits
from cirl_marl.report import account_tables
from cirl_marl.report.account_tables import front_table, write_account_front


@pytest.mark.slow
def test_the_front_of_two_aims_is_proved_and_reached(tmp_path: Path) -> None:
    """Plans lie on the worse side of the front and near it; prices are its slope; both have a hypervolume."""
    file = tmp_path / "city.toml"
    write_network(city().with_options(episode={"horizon": 24}), file)
    for axes in (("circularity", "emissions"), ("cost", "emissions")):
        front = account_front(file, axes, min_service=0.9, points=4)
        at_plans = front.at(front.plans[:, 1:])
        assert (front.signs[0] * (at_plans - front.plans[:, 0]) >= -1e-5 * abs(at_plans)).all()
        np.testing.assert_allclose(front.at(front.demands), front.bounds, rtol=1e-4)
        assert (np.diff(front.prices[:, 0]) <= 1e-6 * front.prices[0]).all() and front.prices[0] > 0
        assert (front.plans[:, 1] <= front.demands[:, 0] * (1 + 1e-4)).all() and (front.levels <= 1).all()
        proved, achieved = front.volumes
        assert 0.99 * proved <= achieved <= proved * (1 + 1e-5)
        assert replace(front, shortages=np.ones(4)).volumes == (proved, 0.0)
    out = ["--min-service", "0.9", "--points", "3", "--out", str(tmp_path / "front")]
    result = CliRunner().invoke(app, ["pareto", str(file), "--between", "cost,emissions", *out])
    assert result.exit_code == 0, result.output
    with (tmp_path / "front" / "pareto.csv").open(encoding="utf-8") as lines:
        assert len(list(csv.reader(lines))) == 4
    assert (tmp_path / "front" / "pareto.png").stat().st_size > 1000
    with pytest.raises(CirlError, match="nothing to weigh"):
        paper = load_network("paper_city").with_options(episode={"horizon": 24})
        account_front(with_lambda(paper), ("circularity", "moved"), min_service=0.9)
    with pytest.raises(CirlError, match="nothing to weigh"):  # less ore is less of both
        account_front("copper_world", ("circularity", "emissions"), min_service=1.0)


@pytest.mark.slow
def test_a_service_may_come_first(tmp_path: Path) -> None:
    """Against an account it is the front of that account against it, the other way round; beside two it has planes."""
    network = city().with_options(episode={"horizon": 10})
    (service,) = (part.id for part in network.services)
    front, other = (account_front(network, axes, points=4) for axes in ((service, "cost"), ("cost", service)))
    assert front.signs.tolist() == [1.0, -1.0] and front.units == ("1", "EUR_2023")
    np.testing.assert_allclose(front.demands[[0, -1], 0], other.bounds[[0, -1]], rtol=1e-4)
    proved = other.at(front.bounds[:, None]) / front.demands[:, 0]  # between demands planes prove a bit less
    assert (proved <= 1 + 1e-6).all() and (proved >= 0.99).all()
    assert front.volumes[1] >= 0.98 * front.volumes[0]
    np.testing.assert_allclose(front.at(2 * front.demands[-1:]), 1.0, atol=1e-5)
    file = tmp_path / "city.toml"
    write_network(network, file)
    words = ["pareto", str(file), "--between", f"{service},cost,emissions", "--points", "3"]
    result = CliRunner().invoke(app, [*words, "--out", str(tmp_path / "front")])
    assert result.exit_code == 0, result.output
    three = account_front(network, (service, "cost", "emissions"), points=3)
    assert (three.at(three.plans[:, 1:]) >= three.plans[:, 0] - 1e-6).all()
    assert 0.98 * three.volumes[0] <= three.volumes[1] <= three.volumes[0] * (1 + 1e-6)


def test_two_services_that_need_the_same_are_weighed() -> None:
    """The more of one, the less of the other: proved, reached, and as dear as programs nearby say."""
    network = scarce_town(reserve=12.0, cars=0.0, homes=0.0)
    front = account_front(network, ("mobility", "housing"), points=4)
    assert (np.diff(front.bounds) < 0).all() and front.bounds[-1] == pytest.approx(0.0, abs=1e-4)
    assert (front.at(front.plans[:, 1:]) >= front.plans[:, 0] - 1e-6).all()
    proved, achieved = front.volumes
    assert 0.99 * proved <= achieved <= proved * (1 + 1e-6)
    assert front.units == ("1", "1") and front.signs.tolist() == [1.0, 1.0]
    np.testing.assert_allclose(front.levels, np.minimum(front.plans.min(axis=1), 1.0), rtol=1e-9)
    level = front.demands[1, 0]
    nearby = [bound(network, aim="mobility", min_service=[0.0, level + way * 1e-3]).objective for way in (-1, 1)]
    slopes = np.diff([nearby[0], front.bounds[1], nearby[1]]) / 1e-3
    assert slopes.min() - 1e-2 <= front.prices[1, 0] <= slopes.max() + 1e-2


@pytest.mark.slow
def test_the_front_of_three_aims_is_proved_and_reached(tmp_path: Path) -> None:
    """Each service level has a front of its own, whose plans no plane cuts off; the slopes are those of programs."""
    network = city().with_options(episode={"horizon": 20})
    file, folder = tmp_path / "city.toml", tmp_path / "front"
    write_network(network, file)
    (service,) = network.services
    front = account_front(network, ("circularity", "emissions", service.id), points=3)
    assert front.demands.shape == (9, 2) and len(np.unique(front.demands[:, 1])) == 3
    assert (front.plans[:, 2] >= front.demands[:, 1] - 1e-3).all()
    gap = front.at(front.plans[:, 1:]) - front.plans[:, 0]
    assert (gap >= -1e-6 * abs(front.plans[:, 0])).all()
    np.testing.assert_allclose(front.at(front.demands), front.bounds, rtol=1e-4, atol=1e-4)
    assert (front.prices[:, 0] >= 0).all() and (front.prices[:, 1] <= 0).all()
    budget, level = front.demands[4]
    for shift, price in zip(np.diag([1e-3 * budget, 1e-3]), front.prices[4], strict=True):
        ends = [(budget, level) + way * shift for way in (-1, 1)]
        solved = [bound(network, at_most={"emissions": e}, min_service=m).objective for e, m in ends]
        slopes = np.diff([solved[0], front.bounds[4], solved[1]]) / shift.sum()
        assert slopes.min() - 1e-2 * abs(price) <= price <= slopes.max() + 1e-2 * abs(price)
    proved, achieved = front.volumes
    assert 0.98 * proved <= achieved <= proved * (1 + 1e-4)
    words = ["pareto", str(file), "--between", f"circularity,emissions,{service.id}", "--points", "3"]
    result = CliRunner().invoke(app, [*words, "--out", str(folder)])
    assert result.exit_code == 0, result.output
    with (folder / "pareto.csv").open(encoding="utf-8") as lines:
        header, *rows = csv.reader(lines)
    assert f"{service.id} at least (1)" in header and "emissions at most (t CO2e)" in header
    np.testing.assert_allclose(np.array(rows, dtype=float)[:, :2], front.demands, rtol=1e-6)
    volumes = json.loads((folder / "pareto.json").read_text(encoding="utf-8"))["hypervolume"]
    assert volumes["plans"] == pytest.approx(achieved, rel=1e-6)


@pytest.mark.parametrize("aims", [1, 2, 3])
def test_volumes_are_those_of_random_points(aims: int) -> None:
    """The part of random points that some of the front dominates."""
    rng = np.random.default_rng(aims)
    points, samples = rng.uniform(-0.2, 1.0, (6, aims)), rng.uniform(0.0, 1.0, (100_000, aims))
    share = np.mean(np.any(np.all(samples[:, None] < points, axis=2), axis=1))
    assert volume_dominated(points, np.zeros(aims)) == pytest.approx(share, abs=5e-3)
    assert volume_dominated(points, np.full(aims, 2.0)) == 0.0


def test_plans_that_do_more_than_is_demanded_dominate_no_more_than_is_proved() -> None:
    """What planes prove where they are counts; by hand, with lines of slope 0 and −2 that meet at a level of 0.75."""
    front = AccountFront(
        network=city(),
        axes=("circularity", city().services[0].id),
        min_service=np.zeros(1),
        demands=np.array([[0.5], [1.0]]),
        bounds=np.array([-1.0, -1.5]),
        prices=np.array([[0.0], [-2.0]]),
        plans=np.array([[-1.25, 0.75], [-1.5, 1.0]]),
        levels=np.array([0.75, 1.0]),
        shortages=np.zeros(2),
        as_usual=np.array([-9.0, 0.5]),
        is_limited=np.zeros(2, dtype=bool),
        least=-9.0,
    )
    assert front.volumes == pytest.approx((0.5 * 0.25, 0.25 * 0.25))
    for lack, counts in ((0.9e-3, True), (1.1e-3, False)):  # a plan that is short of a demand counts up to a thousandth
        volume = replace(front, shortages=np.array([lack, 0.0])).volumes[1]
        assert volume == pytest.approx(0.25 * 0.25 if counts else 0.0)
    limited = replace(front, is_limited=np.array([False, True]), least=-1.1)
    np.testing.assert_allclose(limited.at([[0.5], [0.75], [1.0]]), [-1.0, -1.0, -1.1])


@pytest.mark.parametrize(("excess", "demands"), [(2e-4, [100.0, 100.01, 100.02]), (0.5e-4, [100.005])])
def test_demands_cover_the_range_of_an_account_if_there_is_one(
    excess: float, demands: list[float], monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the least that a plan books to what the best plan of the first does; a ten-thousandth is no range."""
    network, least, free = city(), SimpleNamespace(accounts=np.full((1, 2), 100.0)), np.full(2, 100.0 * (1 + excess))
    monkeypatch.setattr("cirl_marl.evaluation.account_front.bound", lambda *arguments, **options: None)
    monkeypatch.setattr(_Sweep, "_best", lambda *arguments: (SimpleNamespace(accounts=free), False))
    monkeypatch.setattr(_Sweep, "_carried_out", lambda *arguments: least)
    sweep = _Sweep.__new__(_Sweep)
    sweep.definition, sweep.axes, sweep.points = network, ("circularity", "cost"), 3
    sweep._accounts, sweep._services = [account.id for account in network.accounts], [network.services[0].id]
    sweep.demands, sweep.solutions, sweep.runs, sweep.are_limited = [], [], [], []
    sweep._progress = lambda activity, share: None
    sweep.run(sweep.axes, {}, np.zeros(1))
    np.testing.assert_allclose(np.array(sweep.demands)[:, 0], demands, rtol=1e-12)


def test_the_highest_service_is_had_at_the_least_of_the_other_aim() -> None:
    """Of the many plans that deliver all, that of least cost ends the front; of a level a bit less is demanded."""
    network = city().with_options(episode={"horizon": 2})
    front = account_front(network, (network.services[0].id, "cost"), points=3)
    cheapest = -bound(network, aim="cost", min_service=front.bounds[-1] - 1e-6).objective
    assert front.demands[-1, 0] == pytest.approx(cheapest, rel=1e-4)
    np.testing.assert_allclose(front.at(2 * front.demands[-1:]), front.bounds[-1], atol=1e-5)  # there is no more
    assert 1.0 - 1e-5 < _within_reach(1.0) < 1.0 and _within_reach(0.0) == 0.0


def test_what_is_no_aim_is_demanded() -> None:
    """A level that is asked for of all services is none of that which has demands of its own."""
    levels: list[np.ndarray] = []

    def noted(network: Network, axes: object, points: object, min_service: np.ndarray, progress: object) -> None:
        levels.append(min_service)
        raise CirlError("enough")

    with pytest.MonkeyPatch.context() as patch, pytest.raises(CirlError, match="enough"):
        patch.setattr("cirl_marl.evaluation.account_front._Sweep", noted)
        account_front(two_sources(), ("circularity", "living"), min_service=0.9)
    assert dict(zip([service.id for service in two_sources().services], levels[0], strict=True)).pop("living") == 0.0
    assert sorted(levels[0].tolist()) == [0.0, 0.9]


def test_money_against_emissions_in_numbers_and_in_a_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Less of both is better: what is proved lies below what plans take; tables, files and picture say the same."""
    network = corner()
    front = account_front(network, ("cost", "emissions"), min_service=0.97, points=3)
    assert front.signs.tolist() == [-1.0, -1.0] and front.units == ("EUR_2023", "t CO2e")
    middle = bound(network, aim="cost", at_most={"emissions": front.demands[1, 0]}, min_service=0.97, tight=True)
    assert front.bounds[1] == pytest.approx(-middle.objective, rel=1e-6)
    assert (np.diff(front.bounds) < 0).all() and (front.plans[:, 0] >= front.bounds - 1e-6).all()
    usual = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral())
    np.testing.assert_allclose(front.as_usual, usual.accounts[0], rtol=1e-12)
    printer = Console(width=200)
    with printer.capture() as shown:
        printer.print(front_table(front))
    rows = [
        [cell.strip() for cell in line.strip("│┃").split("│" if "│" in line else "┃")]
        for line in shown.get().splitlines()
    ]
    names = ["cost (EUR_2023)", "emissions (t CO2e)"]
    header = ["emissions at most (t CO2e)", f"best {names[0]}", *(f"plan: {name}" for name in names)]
    header.append("worth of emissions (EUR_2023/(t CO2e))")
    assert header in rows
    table = np.column_stack([front.demands, front.bounds, front.plans, front.prices])
    assert [[f"{cell:.5g}" for cell in row] for row in table.tolist()] == [row for row in rows if len(row) == 5][1:]
    drawn: list[Figure] = []

    def noted(figure: Figure, path: Path) -> Path:
        drawn.append(figure)
        return save(figure, path)

    monkeypatch.setattr(account_tables, "save", noted)
    files = write_account_front(front, tmp_path / "front")
    assert [path.name for path in files] == ["pareto.csv", "pareto.json", "pareto.png"]
    record = json.loads(files[1].read_text(encoding="utf-8"))
    assert record["hypervolume"] == dict(zip(("proved", "plans"), front.volumes, strict=True))
    np.testing.assert_allclose(np.array(record["points"])[:, :5], table, rtol=1e-12)
    (axes,) = drawn[0].axes
    (shaded,) = (np.asarray(part.get_paths()[0].vertices)[:, 1] for part in axes.collections)
    assert shaded.min() == pytest.approx(axes.get_ylim()[0]) and shaded.max() < axes.get_ylim()[1]


@pytest.mark.parametrize(
    ("axes", "message"),
    [
        (("circularity", "emisions"), "Did you mean 'emissions'"),
        (("cost", "circularity"), "accounts or services, the first of which may be 'circularity'"),
        (("cost", "cost"), "two or three different"),
        (("circularity",), "two or three different"),
        (("circularity", "emissions"), "give min_service, at which they are weighed, of"),
    ],
)
def test_aims_that_cannot_be_weighed(axes: tuple[str, ...], message: str) -> None:
    """The message names them, the nearest ones, and what is missing."""
    with pytest.raises(CirlError, match=message):
        account_front(city(), axes)


def two_sources() -> Network:
    """Return a town in which the source that counts in λ comes to its end first; nobody chooses among the two."""
    network = replace(town((0.9, 0.1), high=(200.0, 999.0)), default_agents=("import",))
    nodes = {node.id: node for node in network.nodes}
    nodes["ore_b"] = replace(nodes["ore_b"], role=Role.TECHNOSPHERE, initial=(5000.0, 5000.0))
    return replace(network, nodes=tuple(nodes.values()))


def test_idle_supplies_of_good_episodes_share_what_is_asked_for() -> None:
    """The program of all episodes draws on the source that does not count; that of good ones on both, by weight."""
    network = two_sources()
    loose = bound(network, min_service=0.999)
    mined = loose.flow[:, :2] - 1.0
    assert (mined[:, 1] > 0.2 * mined[:, 0] + 0.1).any()
    run = simulate_plan(improve_plan(loose))
    narrow = with_supply_limits(loose, float(run.episode_circularity[0]))
    tight = bound(narrow, min_service=0.999)
    mined = tight.flow[:, :2] - 1.0
    np.testing.assert_allclose(mined[:, 1], mined[:, 0] / 9, atol=1e-6)
    assert tight.objective < loose.objective


@pytest.mark.slow
def test_points_worse_than_others_are_bounded_without_limits_of_supplies() -> None:
    """Limits are none of episodes worse than where the others are best; and plans are carried out without any."""
    network, levels = two_sources(), np.array([0.999, 0.9])
    sweep = _Sweep(network, ("circularity", "living"), 3, np.array([0.999, 0.0]), lambda activity, share: None)
    sweep.run(("circularity",), {}, levels)
    sweep._least = 0.0
    sweep.run(("circularity",), {}, levels)
    tight, loose = (solution.objective for solution in sweep.solutions)
    solved = bound(network, min_service=levels)
    assert tight < loose == pytest.approx(solved.objective, rel=1e-9)
    dry = replace(solved, network=_with_ends(network, {"mine_a": np.full(8, 1.5), "mine_b": np.full(8, 1.5)}))
    sweep._programs = dry.network
    np.testing.assert_array_equal(sweep._carried_out(dry).flow, simulate_plan(improve_plan(solved)).flow)


@pytest.mark.slow
def test_good_episodes_stay_what_they_are_under_limits() -> None:
    """Whatever agents do: an episode at least as good as was asked for is the same in the narrower network."""
    network = two_sources()
    actions = np.random.default_rng(3).uniform(-1.0, 0.0, 12).tolist()
    least = float(np.median([middle_episode(network, action).episode_circularity[0] for action in actions]))
    narrow = with_supply_limits(bound(network, min_service=0.5), least)
    ends = [n.control_bounds[2, n.control_rows["mine_b"].start] for n in (network, narrow)]
    assert (ends[1] < ends[0]).all()
    good = 0
    for action in actions:
        run = middle_episode(network, action)
        if run.episode_circularity[0] >= least and run.least_service[0] >= 0.5:
            np.testing.assert_allclose(run.flow, middle_episode(narrow, action).flow, rtol=1e-9)
            good += 1
    assert 1 <= good < 12


@pytest.mark.slow
def test_nothing_is_put_into_use_late_and_sold_early_in_each_year() -> None:
    """The bound of Japan's steel is 0.4 kt above its plan; 5.4 where shares may move with flows that hardly vary."""
    free = bound("steel_japan", min_service=1.0)
    reached = float(simulate_plan(improve_plan(free)).episode_circularity[0])
    narrow = with_supply_limits(free, reached - 200.0)
    tight = bound(narrow, min_service=1.0, tight=True)
    assert tight.verify().bound == tight.objective
    assert 0.0 <= tight.objective - reached < 0.7


def middle_episode(network: Network, action: float) -> Rollout:
    """Return the episode from the middle of the initial ranges in which imports are constant."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    origin = episode_start(env)
    return origin.play(env, Constant({"import": action}))


@pytest.mark.slow
def test_nothing_is_limited_where_nothing_is_proved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of episodes however bad, of supplies that are alike or may run dry, and of programs that are too large."""
    network = two_sources()
    solution = bound(network, min_service=0.999)
    assert with_supply_limits(solution, -1e6) is solution.network == network
    alike = replace(town((0.5, 0.5)), default_agents=("import",))
    assert with_supply_limits(bound(alike, min_service=0.999), -1e6) == alike
    nodes = [replace(node, initial=(60.0, 60.0)) if node.id == "ore_a" else node for node in network.nodes]
    scarce = replace(network, nodes=tuple(nodes))  # who is asked for more than it holds delivers less, at any V
    poor = bound(scarce, min_service=0.5)
    assert with_supply_limits(poor, 1.01 * poor.objective) == scarce
    monkeypatch.setattr(supply_limits, "LARGE", 1)
    assert with_supply_limits(solution, solution.objective) is network
    row = network.control_rows["mine_a"].start
    least = _with_ends(network, {"mine_a": np.full(8, -1.0)})  # what is supplied while nothing lacks may always be
    np.testing.assert_array_equal(least.control_bounds[2, row], network.control_bounds[1, row])


def test_intervals_are_proved_together_where_the_nearest_end_is_out_of_reach(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of what is supplied beyond the least: 5 in two intervals come to neither end of 10, but may come to one of 4."""
    costs: list[np.ndarray] = []

    def with_cost(problem: object, cost: np.ndarray) -> object:
        costs.append(cost)
        return problem

    monkeypatch.setattr(supply_limits, "replace", with_cost)
    monkeypatch.setattr(supply_limits, "solve", lambda *arguments, **options: SimpleNamespace(certificate=0, plan=0))
    monkeypatch.setattr(supply_limits, "verify", lambda *arguments: SimpleNamespace(bound=5.0))
    layout = SimpleNamespace(size=3, flow=np.array([0, 1]), moments=range(2))
    problem: Any = SimpleNamespace(layout=layout, cost=np.zeros(6))

    def proved(low: float, room: list[float]) -> list[int]:
        first, least = np.zeros(2, dtype=np.intp), np.full((2, 1), low)
        return supply_limits._below(problem, [0, 1], first, least, np.array(room))

    assert proved(0.0, [10.0, 10.0]) == [0, 1] and proved(0.0, [10.0, 4.0]) == [0]
    assert proved(1.0, [10.0, 4.0]) == [0, 1]
    np.testing.assert_array_equal(costs[0], [-0.5, -0.5, 0.0] * 2)  # the mean flows of both intervals


def test_limits_of_supplies_hold_whatever_the_budget() -> None:
    """They are of all episodes that are good enough, not of those alone that keep the budget of a bound."""
    free = bound(corner(), min_service=0.95)
    least = float(simulate_plan(improve_plan(free)).episode_circularity[0]) - 1.0
    thrifty = replace(free, aims=replace(free.aims, budgets=(Budget(0, 1e-6, "cost"),)))
    assert with_supply_limits(thrifty, least) == with_supply_limits(free, least)


def corner() -> Network:
    """Return cars whose metal is recycled or reused, each at a cost of its own, and two mines that make up for it."""

    def chosen(name: str, recipient: str, **accounts: float) -> Arc:
        control = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.0, high=0.45)
        return Arc(id=name, donor="cars", recipient=recipient, law=Law.SHARE, control=control, accounts=accounts)

    def mined(name: str, weight: float, high: float) -> Arc:
        control = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=high)
        return Arc(
            id=f"mined_{name}",
            donor=name,
            recipient="market",
            law=Law.CONTROLLED,
            control=control,
            makes_up_for="driving",
            weight=weight,
            accounts={"cost": 0.01, "emissions": 0.01},
        )

    return Network(
        name="corner",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="tailings", initial=(5000.0, 5000.0)),
            Node(id="market", stores=False),
            Node(id="cars", rate=0.3, initial=(100.0, 100.0)),
            Node(id="dump", initial=(0.0, 0.0)),
        ),
        arcs=(
            mined("ore", 0.9, 16.0),
            mined("tailings", 0.1, 99.0),
            chosen("recycling", "market", emissions=1.0),
            chosen("reuse", "market", cost=1.0),
            Arc(id="sold", donor="market", recipient="cars", law=Law.SHARE),
            Arc(id="dumped", donor="cars", recipient="dump", law=Law.SHARE),
        ),
        services=(Service(id="driving", provider="cars", quantity="stock", low=100.0),),
        accounts=(Account(id="cost", unit="EUR_2023"), Account(id="emissions", unit="t CO2e")),
        episode=Episode(horizon=1),
        time_unit="year",
        mass_unit="t",
        default_agents=("recycling", "reuse"),
    )


@pytest.mark.parametrize("min_service", [0.95, 0.99])
@pytest.mark.slow
def test_limits_of_supplies_prove_nothing_of_worse_episodes(min_service: float) -> None:
    """Without recycling and reuse both are cheapest, though no episode of limited supplies can be like that."""
    network, shares = corner(), list[float]()
    front = account_front(
        network,
        ("circularity", "cost", "emissions"),
        min_service=min_service,
        points=3,
        progress=lambda activity, share: shares.append(share),
    )
    assert shares == sorted(shares) and shares[-1] == 1.0
    env = MultiAgentVectorEnv(network, num_envs=1)
    for recycling, reuse in itertools.product(np.linspace(-1.0, 1.0, 5).tolist(), repeat=2):
        run = rollout(env, Constant({"recycling": recycling, "reuse": reuse}))
        if run.episode_levels[0, 0] >= min_service:
            assert run.episode_circularity[0] <= front.at(run.accounts[:1])[0] + 1e-6
    assert front.is_limited.any()


@pytest.mark.medium
def test_fronts_reach_the_highest_service_that_there_is() -> None:
    """Ends of what is demanded are those of the network, not those of its limited supplies."""
    network = replace(corner(), services=(replace(corner().services[0], low=130.0),))
    sweep = _Sweep(network, ("circularity", "driving"), 3, np.zeros(1), lambda activity, share: None)
    sweep._programs = _with_ends(network, {"mined_ore": np.full(1, 1.0), "mined_tailings": np.full(1, 1.0)})
    sweep.run(("circularity", "driving"), {}, np.zeros(1))
    most = bound(network, aim="driving").objective
    assert np.max(sweep.demands) == pytest.approx(most, abs=1e-5)
    assert bound(sweep._programs, aim="driving").objective < most - 0.01


def test_a_service_that_is_made_up_for_is_not_weighed() -> None:
    """Its level is what idle supplies make of it, whatever is demanded; programs that demand nothing tell none."""
    network = corner()
    assert bound(network, min_service=0.0).levels[0] < 0.5
    with pytest.raises(CirlError, match="takes no more than the best there is of driving"):
        account_front(network, ("circularity", "driving"), points=3)


@pytest.mark.slow
def test_circular_copper_costs_more_where_metal_is_cheap_and_scrap_dear() -> None:
    """At these ends of factors plans dominate 99 % of what is proved; as stated there is nothing to weigh."""
    stated = load_network("copper_world").with_options(episode={"horizon": 8})
    spreads = load_network("copper_world", scenario="factor_ranges").uncertain
    arcs = []
    for arc in stated.arcs:
        rates: dict[str, Any] = dict(arc.accounts)
        if (path := f"arcs.{arc.id}.accounts.cost") in spreads:
            rates["cost"] *= spreads[path].ends[0 if arc.id == "mining" else 1]
        arcs.append(replace(arc, accounts=rates))
    front = account_front(replace(stated, arcs=tuple(arcs)), ("circularity", "cost"), min_service=1.0, points=3)
    proved, achieved = front.volumes
    assert 0.99 * proved <= achieved <= proved * (1 + 1e-5) and front.prices[0] > 0
    with pytest.raises(CirlError, match="nothing to weigh"):
        account_front(stated, ("circularity", "cost"), min_service=1.0)
