"""The world's copper, aluminium and plastics: what their first years give is what was published."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.published import FIGURES, modelled
from cirl_marl import CirlError, MultiAgentVectorEnv, simulate
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import Rollout, rollout
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.network import Network

CYCLES = ("copper_world", "aluminium_world", "plastics_world")


def usual(name: str, scenario: str | None = None, horizon: int = 3) -> tuple[Network, Rollout]:
    """Return the first years in which nobody acts."""
    network = load_network(name, scenario=scenario)
    return network, rollout(MultiAgentVectorEnv(network, num_envs=1, horizon=horizon), Neutral(), seed=0)


def flow(network: Network, run: Rollout, *names: str, year: int = 0) -> float:
    """Return what flows through some arcs in a year."""
    places = [place for place, arc in enumerate(network.arcs) if arc.id in names]
    assert len(places) == len(names)
    return float(run.flow[year, places].sum())


def ends(network: Network) -> list[str]:
    """Return the arcs by which products leave use."""
    return [arc.id for arc in network.arcs if arc.id.endswith("_end") or arc.id == "to_packaging"]


def test_copper_of_2015() -> None:
    """26 Mt go into use, 12 Mt are discarded, of which 45 % come back; 8 Mt are recycled with new scrap."""
    network, run = usual("copper_world")
    products = flow(network, run, "to_goods")
    discarded = flow(network, run, *ends(network))
    new = flow(network, run, "new_scrap")
    assert products == pytest.approx(26, rel=0.04)
    assert discarded == pytest.approx(12, rel=0.06)
    assert flow(network, run, "recycled") - 0.95 * new == pytest.approx(0.45 * discarded, rel=0.05)
    assert flow(network, run, "recycled") == pytest.approx(8, rel=0.05)


def test_aluminium_of_2019() -> None:
    """64 Mt of primary metal, 20 Mt of old and 13 Mt of new scrap; 1.2 Gt are in use in 2021."""
    network, run = usual("aluminium_world")
    new = flow(network, run, "new_scrap")
    assert flow(network, run, "mining") == pytest.approx(64, rel=0.04)
    assert flow(network, run, "recycled") - 0.97 * new == pytest.approx(20, rel=0.05)
    assert new == pytest.approx(13, rel=0.05)
    in_use = [place for place, node in enumerate(network.stores) if node.lifetime is not None]
    assert float(run.stock[2, in_use].sum()) == pytest.approx(1200, rel=0.05)


def test_plastics_of_2020() -> None:
    """Nothing but what was made since 1950 and lifetimes: the waste that the OECD has between 2019 and 2060."""
    network, run = usual("plastics_world")
    waste = flow(network, run, *(arc.id for arc in network.arcs if arc.id.endswith(("_collected", "_rest"))))
    assert waste == pytest.approx(353 + (1014 - 353) / 41, rel=0.03)
    recycled, to_land = flow(network, run, "recycled"), flow(network, run, "to_landfill")
    assert recycled / waste == pytest.approx(0.09, rel=0.02)
    assert to_land / waste == pytest.approx(0.50, rel=0.02)


@pytest.mark.medium
@pytest.mark.parametrize("name", CYCLES)
def test_circularity_is_better_where_more_is_collected_or_less_is_wanted(name: str) -> None:
    """To 2050, and the demand is met in all of them as long as nobody acts."""
    horizon = load_network(name).episode.horizon
    found = {scenario: usual(name, scenario, horizon)[1] for scenario in (None, "high_circularity", "sufficiency")}
    assert all(np.allclose(run.levels, 1.0, atol=1e-6) for run in found.values())
    plain, high, less = (float(run.episode_circularity[0]) for run in found.values())
    assert plain < high < 0
    assert plain < less < 0


@pytest.mark.parametrize("name", CYCLES)
def test_what_is_held_against_published_years(name: str) -> None:
    """Sums and differences of the flows of a year, by hand; they are of the order that is published."""
    simulation = simulate(name, steps=8)
    network, run = simulation.network, simulation.rollout
    arcs = {
        "mined": ["mining"],
        "primary": ["mining"],
        "old scrap": [arc.id for arc in network.arcs if arc.id.endswith("_collected")],
        "into use": ["into_use"],
        "made, without fibres": ["virgin", "recycled"],
    }
    begins = {"copper_world": 2015, "aluminium_world": 2019, "plastics_world": 2020}[name]
    for figure in (each for each in FIGURES if each.network == name):
        for year, published in figure.values.items():
            expected = flow(network, run, *arcs[figure.name], year=year - begins)
            if "fibres" in figure.name:
                expected -= flow(network, run, "to_textiles", year=year - begins)
            found = modelled(figure, simulation, year)
            assert found == pytest.approx(expected) and abs(found / published - 1) < 0.2
        with pytest.raises(CirlError, match=r"unknown arc 'minig'"):
            modelled(replace(figure, arcs=("minig",)), simulation, begins)
