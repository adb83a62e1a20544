"""A first network from five numbers: it checks, gives the numbers back, and can be improved."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from cirl_marl import CirlError, MultiAgentVectorEnv, load_network
from cirl_marl.cli import app
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.basic import Constant
from cirl_marl.controllers.lint import lint_warnings
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.template import FirstCycle, write_first

SOURCE = 'unit = "Mt/year", source = "test"'
ZINC: dict[str, Any] = {"material": "zinc", "mass": "Mt", "in_use": 200.0, "lifetime": 18.0, "recycled": 0.3}


@pytest.mark.parametrize(
    ("in_use", "lifetime", "recycled", "growth", "years"),
    [(200.0, 18.0, 0.3, 0.0, 25), (0.7, 60.0, 0.0, 4.0, 30), (5e3, 4.0, 1.0, -0.5, 7), (1.0, 9.0, 0.55, 1.0, 2)],
)
def test_what_was_told_comes_back(
    tmp_path: Path, in_use: float, lifetime: float, recycled: float, growth: float, years: int
) -> None:
    """The stock in use, its growth and the share that is recycled, in every year, with the demand met."""
    path = tmp_path / "zinc.toml"
    told: dict[str, Any] = {"in_use": in_use, "lifetime": lifetime, "recycled": recycled, "growth": growth}
    write_first(FirstCycle(material="zinc", mass="kt", years=years, **told), path)
    network = load_network(path)
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral(), seed=0)
    assert network.agents == ("recycling",)
    assert np.allclose(run.levels, 1.0, atol=1e-6)
    place = [node.id for node in network.stores].index("in_use")
    expected = in_use * (1 + growth / 100) ** np.arange(1, years + 1)
    assert np.allclose(run.stock[:, place], expected, rtol=1e-2)  # the demand is a line between every fifth year
    flow = {arc.id: run.flow[:, k] for k, arc in enumerate(network.arcs)}
    extraction = next(arc for arc in network.arcs if arc.id == "extraction")
    assert extraction.control is not None and extraction.control.high == pytest.approx(10 * in_use / lifetime, rel=1e-5)
    assert np.allclose(flow["recycling"], recycled * flow["end_of_life"], rtol=1e-5, atol=1e-9)


def test_more_recycling_is_better(tmp_path: Path) -> None:
    """The agent can raise the circularity, without a lack of service."""
    write_first(FirstCycle(**ZINC), tmp_path / "zinc.toml")
    env = MultiAgentVectorEnv(tmp_path / "zinc.toml", num_envs=1)
    usual, best = rollout(env, Neutral(), seed=0), rollout(env, Constant({"recycling": 1.0}), seed=0)
    assert float(best.episode_circularity[0]) > float(usual.episode_circularity[0]) + 1
    assert np.allclose(best.levels, 1.0, atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "name", "said"),
    [
        ({"recycled": 30.0}, "a.toml", r"recycled 30.0: a share from 0 to 1"),
        ({"in_use": float("nan")}, "a.toml", r"in-use nan: a mass above 0"),
        ({"lifetime": 0.5}, "a.toml", r"lifetime 0.5: years, at least 1"),
        ({"mass": "year"}, "a.toml", r"year"),
        ({"mass": "ton"}, "a.toml", r"^(?!.*tmp\w*/a).*a.toml: units.mass: unit .ton"),
        ({"material": 'zi"nc'}, "a.toml", r"material 'zi\"nc'"),
        ({}, "a.txt", r"needs the name of a .toml file"),
        ({}, "old.toml", r"old.toml: is there already"),
    ],
)
def test_bad_answers(tmp_path: Path, changes: dict[str, Any], name: str, said: str) -> None:
    """What cannot be meant is named, and no file is written or changed."""
    (tmp_path / "old.toml").write_text("mine")
    with pytest.raises(CirlError, match=said):
        write_first(FirstCycle(**ZINC | changes), tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == ["old.toml"]
    assert (tmp_path / "old.toml").read_text() == "mine"


PRODUCTS = {"buildings": (120.0, 40.0), "cars": (60.0, 14.0), "cans": (3.0, 1.0)}


@pytest.mark.parametrize(("recycled", "growth"), [(0.3, 1.0), (0.0, 3.0), (0.9, 0.0)])
def test_products_get_what_each_demands(tmp_path: Path, recycled: float, growth: float) -> None:
    """A market without stock shares out what is recycled; behind it each product gets what it lacks, and no more."""
    first = FirstCycle(**ZINC | {"recycled": recycled}, growth=growth, products=PRODUCTS)
    write_first(first, tmp_path / "zinc.toml")
    network = load_network(tmp_path / "zinc.toml")
    assert list(lint_warnings(network)) == []
    assert not {node.id for node in network.stores} - {"deposit", "landfill", *(f"in_use_{name}" for name in PRODUCTS)}
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral(), seed=0)
    flow = {arc.id: run.flow[:, k] for k, arc in enumerate(network.arcs)}
    for name in PRODUCTS:
        demand = network.interval_means(network.services[[s.id for s in network.services].index(f"demand_{name}")].low)
        stock = run.stock[:, network.node_index[f"in_use_{name}"]]
        assert np.allclose(stock, demand, rtol=1e-9)
        made = flow[f"extraction_{name}"] + flow[f"recycled_{name}"]
        assert np.allclose(flow[f"products_{name}"], 0.98 * made)
        assert (flow[f"extraction_{name}"] > 0).all()
    assert np.allclose(sum(flow[f"recycled_{name}"] for name in PRODUCTS), flow["recycling"], atol=1e-12)


def test_an_invented_store_is_told(tmp_path: Path) -> None:
    """What shares out to several products by a stock or by orders, or leaves one short, is told of the pattern."""
    write_first(FirstCycle(**ZINC, products=PRODUCTS), tmp_path / "zinc.toml")
    text = (tmp_path / "zinc.toml").read_text()
    order = f'law = "controlled"\ncontrol = {{ kind = "flow", low = 0, neutral = 1, high = 9, {SOURCE} }}'
    shares = re.compile(r'(from = "market"\n.*\n)law = "share"\nshare = .*')
    ordered = tmp_path / "ordered.toml"
    ordered.write_text(shares.sub(rf"\1{order}", text))
    with pytest.raises(CirlError) as refused:
        load_network(ordered)
    told = "controls or orders set all that leaves it; an arc of law 'share' without a control has to take the rest"
    assert str(refused.value) == f"{ordered}: node 'market': {told}"
    stock = f"initial = {{ low = 90, high = 90, {SOURCE.replace('/year', '')} }}"
    head, tail = ordered.read_text().split("[nodes.market]")
    ordered.write_text(f"{head}[nodes.market]{tail.replace('stores = false', stock, 1)}")
    (told,) = [line for line in lint_warnings(load_network(ordered)) if "'market'" in line]
    assert "take what they ask for; if it is a market: stores = false, and a share for the rest" in told
    short = tmp_path / "short.toml"
    short.write_text(
        text.replace('makes_up_for = "demand_cans"', "").replace("neutral = 0, high = 30", "neutral = 1, high = 30")
    )
    (told,) = [line for line in lint_warnings(load_network(short)) if "nothing makes up for it" in line]
    assert told.startswith("service 'demand_cans': under neutral control its level is 0.")


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--product", "cars=60"], "--product cars=60: needs a name and two numbers, as in cars=120,14"),
        (["--product", "Cars=60,14"], "product 'Cars': begins with a letter and has lower-case letters"),
        (["--product", "cars=60,0.2"], "product 'cars': lifetime 0.2: years, at least 1"),
        (["--product", "cars=60,14", "--in-use", "3"], "leave out --in-use and --lifetime"),
    ],
)
def test_products_that_cannot_be_meant(tmp_path: Path, arguments: list[str], said: str) -> None:
    """The command names what is wrong; right, it asks for no more."""
    file, plain = str(tmp_path / "zinc.toml"), ["--material", "zinc", "--mass", "Mt", "--recycled", "0.3"]
    outcome = CliRunner().invoke(app, ["new", file, *plain, *arguments])
    assert said in str(outcome.exception)
    outcome = CliRunner().invoke(app, ["new", file, *plain, "--product", "cars=60,14", "--product", "cans=3,1"])
    assert outcome.exit_code == 0, outcome.output
    assert [service.id for service in load_network(file).services] == ["demand_cars", "demand_cans"]
