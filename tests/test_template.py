"""A first network from five numbers: it checks, gives the numbers back, and can be improved."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cirl_marl import CirlError, MultiAgentVectorEnv, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.basic import Constant
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.template import FirstCycle, write_first

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
        ({"mass": "ton"}, "a.toml", r"ton"),
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
