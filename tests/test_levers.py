"""What each lever brings: closed forms where levers do not meet, order and service where they do, files, mistakes."""

from __future__ import annotations

import csv
import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from small_networks import cycle
from typer.testing import CliRunner

import cirl_marl
from cirl_marl import Arc, CirlError, Control, ControlKind, Episode, Network, Node, Role, load_network
from cirl_marl.cli import app
from cirl_marl.evaluation.levers import SETTLED, SHORT, LeverRow, _agents_by_lever
from cirl_marl.optimum.bounds import Bound, bound

STOCKS, RATES, STEPS = {"glass": 40.0, "paper": 100.0, "metal": 10.0}, {"glass": 0.1, "paper": 0.2, "metal": 0.3}, 4
HALF = Control(kind=ControlKind.RATE, low=0.5, neutral=1.0, high=1.0)


def heaps() -> Network:
    """Return three heaps that are lost to a landfill, each by a valve of its own that may be half shut."""
    return Network(
        name="heaps",
        nodes=(
            *(Node(id=name, initial=(stock, stock)) for name, stock in STOCKS.items()),
            Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=tuple(
            Arc(id=f"{name}_lost", donor=name, recipient="tip", rate=rate, control=HALF) for name, rate in RATES.items()
        ),
        episode=Episode(control_interval=1.0, horizon=STEPS),
    )


def saved(name: str) -> float:
    """Return by how much λ̄ rises if the valve of a heap is half shut: −λ̄ is what is lost in all, per interval."""
    full, half = (1 - np.exp(-valve * RATES[name] * STEPS) for valve in (1.0, 0.5))
    return float(STOCKS[name] * (full - half) / STEPS)


def test_levers_that_do_not_meet_bring_the_same_in_any_order() -> None:
    """Alone, added and left out they bring what the closed form says; the largest comes first."""
    result = cirl_marl.levers(heaps())
    assert [row.name for row in result.rows] == ["paper lost", "glass lost", "metal lost"]
    for place, row in enumerate(result.rows):
        assert result.changes(place) == pytest.approx([saved(row.name.split()[0])] * 3, rel=1e-6)
        for trial in (row.alone, row.added, row.without):
            assert trial.gap is not None and -1e-9 <= trial.gap < 0.02 and trial.service == 1.0
    assert [result.share(place) for place in range(3)] == sorted(result.share(place) for place in range(3))
    assert result.share(2) == 1.0
    without_bounds = cirl_marl.levers(heaps(), bounds=False)
    assert [row.alone.gap for row in without_bounds.rows] == [None] * 3
    assert [without_bounds.changes(i) for i in range(3)] == [pytest.approx(result.changes(i)) for i in range(3)]


@pytest.mark.slow
def test_levers_that_meet_keep_the_service() -> None:
    """In a cycle every row delivers what there is as usual, but for a thousandth, and stays below its bound."""
    network = cycle().with_options(episode={"horizon": 2})
    result = cirl_marl.levers(network, groups={"waste": ["recycling", "hoarding", "release"]})
    assert {agent for row in result.rows for agent in row.agents} == set(network.agents)
    assert ("waste", ("recycling", "hoarding", "release")) in {(row.name, row.agents) for row in result.rows}
    demand = result.plan.min_service
    assert demand is not None
    assert (result.usual.run.episode_levels[0] >= demand).all()
    for row in result.rows:
        for trial in (row.alone, row.added, row.without):
            assert (trial.run.episode_levels[0] >= demand - SHORT).all()
            assert trial.bound is not None and trial.circularity <= trial.bound + 0.01 * abs(trial.bound)
            assert trial.bound <= result.plan.objective + 1e-6 * abs(trial.bound)
    assert result.rows[-1].added.circularity == result.together.circularity
    order, left = list[str](), {row.name: set(row.agents) for row in result.rows}
    value, whole = result.usual.circularity, result.plan.objective
    while left and whole - value > SETTLED * (whole - result.usual.circularity):
        values = {}
        for name in left:
            agents = set[str]().union(*(row.agents for row in result.rows if row.name in (name, *order)))
            values[name] = bound(
                network, min_service=demand, agents=[a for a in network.agents if a in agents]
            ).objective
        order.append(max(values, key=lambda name: values[name]))
        value = values[order[-1]]
        del left[order[-1]]
    assert [row.name for row in result.rows][: len(order)] == order
    best = max(result.rows, key=lambda row: row.alone.circularity)
    assert result.rows[0].added.circularity == pytest.approx(best.alone.circularity, rel=0.01)


@pytest.mark.medium
def test_copies_share_their_levers() -> None:
    """The same agent of all regions is one lever, and what supplies for a service is none."""
    world = load_network("steel_world")
    by_lever = _agents_by_lever(world, {"exports": ["semis_exports", "goods_exports"]})
    assert len(by_lever["old scrap"]) == len(world.copies) == 30
    assert len(by_lever["exports"]) == 60 and "semis exports" not in by_lever
    assert sum(map(len, by_lever.values())) == len(world.agents)


@pytest.mark.parametrize(
    ("groups", "message"),
    [
        ({"all": ["paper_last"]}, r"groups: 'all': unknown agent 'paper_last'. Did you mean 'paper_lost'\?"),
        ({"a": ["paper_lost"], "b": ["paper_lost"]}, "'paper_lost' is in 'a' and in 'b'; a lever has it alone"),
        ({"a": [f"{name}_lost" for name in STOCKS]}, "has one lever; two or more can be told apart"),
    ],
)
def test_mistakes(groups: dict[str, list[str]], message: str) -> None:
    """Groups name agents, each once, and leave two levers."""
    with pytest.raises(CirlError, match=message):
        cirl_marl.levers(heaps(), groups=groups)


def test_command(tmp_path: Path) -> None:
    """The command writes table, provenance and chart; what it groups and what is wrong with that."""
    path = tmp_path / "heaps.toml"
    cirl_marl.write_network(heaps(), path)
    arguments = ["levers", str(path), "--out", str(tmp_path / "out"), "--group", "dry=paper_lost, metal_lost"]
    outcome = CliRunner().invoke(app, arguments)
    assert outcome.exit_code == 0 and "all so far" in outcome.output
    with (tmp_path / "out" / "levers.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["agents"] for row in rows] == ["paper_lost metal_lost", "glass_lost"]
    mass = load_network(path).mass_unit
    assert float(rows[0][f"alone: change ({mass})"]) == pytest.approx(saved("paper") + saved("metal"), rel=1e-6)
    about = json.loads((tmp_path / "out" / "levers.json").read_text())
    assert about["all levers"] - about["as usual"] == pytest.approx(sum(map(saved, STOCKS)), rel=1e-6)
    assert (tmp_path / "out" / "levers.png").stat().st_size > 10_000
    outcome = CliRunner().invoke(app, ["levers", str(path), "--group", "paper_lost"])
    assert "needs a name and agents, as in scrap=old_scrap,new_scrap" in str(outcome.exception)
    twice = ["a=paper_lost", "a=glass_lost"]
    for groups, fault in ((["dry="], "needs a name and agents"), (twice, "'a' is given twice")):
        outcome = CliRunner().invoke(app, ["levers", str(path), *(f"--group={group}" for group in groups)])
        assert fault in str(outcome.exception)


def test_late_levers_share_a_row(tmp_path: Path) -> None:
    """They are one lever in the last of so many rows, of table and chart, and the command says which."""
    result = cirl_marl.levers(heaps(), most=2)
    assert [row.name for row in result.rows] == ["paper lost", "2 others"]
    assert {*result.rows[1].agents} == {"glass_lost", "metal_lost"}
    assert result.changes(1) == pytest.approx([saved("glass") + saved("metal")] * 3, rel=1e-6)
    assert cirl_marl.draw(tmp_path / "levers.png", result).stat().st_size > 10_000
    assert isinstance(result.rows[0], LeverRow)
    assert "2 others" in cirl_marl.summarise(result).columns[0]._cells  # type: ignore[union-attr]
    with pytest.raises(CirlError, match="most must be a whole number of at least 2, got 1"):
        cirl_marl.levers(heaps(), most=1)


def test_bounds_are_solved_where_they_decide(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lever that does next to nothing is tried once, and still stands in its place with what it brings."""
    monkeypatch.setitem(STOCKS, "dust", 1e-4)
    monkeypatch.setitem(RATES, "dust", 0.2)
    solved: list[set[str]] = []

    def counted(*args: object, agents: Sequence[str], **options: object) -> Bound:
        solved.append({agent.removesuffix("_lost") for agent in agents})
        return bound(*args, agents=agents, **options)  # type: ignore[call-overload, no-any-return]

    monkeypatch.setattr("cirl_marl.evaluation.levers.bound", counted)
    result = cirl_marl.levers(heaps())
    assert [row.name.split()[0] for row in result.rows] == ["paper", "glass", "metal", "dust"]
    for place, row in enumerate(result.rows):
        assert result.changes(place) == pytest.approx([saved(row.name.split()[0])] * 3, rel=1e-4)
    with_dust = {frozenset(agents) for agents in solved if "dust" in agents}
    assert with_dust == {frozenset({"dust"}), *(frozenset(STOCKS) - {name} for name in ("", "paper", "glass", "metal"))}
