"""The steel of the world: copies of the countries, the markets between them, and what nobody wins by trade."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest

from benchmarks import steel, steel_world
from benchmarks.steel import PRIMARY, TABLE, Country, countries
from benchmarks.steel_world import GOODS, RAW, STEEL, markets, write_trade
from cirl_marl import MultiAgentVectorEnv, Network, load_network, parallel_env
from cirl_marl.controllers import Constant, Neutral
from cirl_marl.controllers.rollout import Rollout, episode_start, rollout
from cirl_marl.importing.definition import identifiers
from cirl_marl.importing.flow_table import read_flows
from cirl_marl.network import Floats
from cirl_marl.network.elements import Role
from cirl_marl.testing import check_parallel_env


@pytest.fixture(scope="module")
def everyone() -> list[Country]:
    """Return the flows of all countries."""
    return countries(read_flows(TABLE))


@pytest.fixture(scope="module")
def world() -> Network:
    """Return the network."""
    return load_network("steel_world")


@pytest.fixture(scope="module")
def usual(world: Network) -> Rollout:
    """Return the episode in which nobody acts."""
    env = MultiAgentVectorEnv(world, num_envs=1)
    begun = episode_start(env)
    return begun.play(env, Neutral())


def of(network: Network, run: Rollout, arcs: Sequence[str]) -> Floats:
    """Return the flow of some arcs together by year."""
    flow: Floats = run.flow[:, [network.arc_index[arc] for arc in arcs]].sum(axis=1)
    return flow


def test_every_country_is_in_it(world: Network, everyone: list[Country]) -> None:
    """Each with its agents and one service of demand; markets store nothing; one service more is that of the rest."""
    regions = identifiers(each.name for each in everyone).values()
    assert len(world.default_agents) == 13 * 30 and len(world.default_agents) == len(set(world.default_agents))
    asked = [service.id for service in world.services]
    assert sorted(asked) == sorted([*(f"{each}_steel_in_use" for each in regions), "rest_of_world_supply"])
    market = {node.id for node in world.nodes if node.id.startswith("world_")}
    assert market == {f"world_{good}" for good in GOODS}
    assert not any(world.nodes[world.node_index[each]].stores for each in market)
    country = load_network("steel_japan")
    ours, theirs = world.compartments["japan_long_scrap"], country.compartments["long_scrap"]
    assert (ours.control, ours.scale, ours.title) == (theirs.control, theirs.scale, "Japan: scrap of long rolling")
    start = {node.id: i for i, node in enumerate(world.stores)}
    for i, node in enumerate(country.stores):
        if node.lifetime is not None:
            np.testing.assert_array_equal(world.initial[:, start[f"japan_{node.id}"]], country.initial[:, i])


@pytest.mark.medium
def test_what_is_reported_comes_back(everyone: list[Country]) -> None:
    """Every flow of every country between two processes in every year, within 0.003 kt."""
    flows, _ = steel_world.simulated("reported")
    for name, region in identifiers(each.name for each in everyone).items():
        reported = next(each for each in everyone if each.name == name).flows
        assert {arc for arc in flows if arc.startswith(f"{region}_")} == {
            f"{region}_{arc}" for arc in reported.keys() - {"into_use"}
        }
        for arc in reported.keys() - {"into_use"}:
            np.testing.assert_allclose(
                flows[f"{region}_{arc}"], reported[arc], rtol=0, atol=0.003, err_msg=f"{name} {arc}"
            )
    for good in GOODS:
        imports, exports = (sum(each.flows[f"{good}_{way}"] for each in everyone) for way in ("imports", "exports"))
        net = flows[f"rest_of_world_{good}_bought"] - flows[f"rest_of_world_{good}_sold"]
        np.testing.assert_allclose(net, exports - imports, rtol=0, atol=0.01, err_msg=good)


@pytest.mark.medium
def test_business_as_usual_is_served(world: Network, usual: Rollout, everyone: list[Country]) -> None:
    """λ is what leaves reservoirs and enters landfills in all countries; what they trade changes nothing in it."""
    assert usual.levels.min() > 0.99 and (usual.levels.mean(axis=2) > 1 - 1e-6).sum() >= 29
    regions = [*identifiers(each.name for each in everyone).values()]
    primary = of(world, usual, [f"{region}_{arc}" for region in regions for arc in PRIMARY])
    lost = [arc.id for arc in world.arcs if arc.recipient.endswith(("_losses", "_uncollected"))]
    np.testing.assert_allclose(usual.circularity_mean[0], -(primary + of(world, usual, lost)), rtol=1e-9)
    assert not any(of(world, usual, [f"rest_of_world_{good}_sold"]).any() for good in RAW)
    trade = [arc for arc in world.arcs if "world_" in arc.donor or "world_" in arc.recipient]
    roles = {node.id: node.role for node in world.nodes}
    for arc in trade:
        assert (roles[arc.donor] is Role.NONRENEWABLE_RESERVOIR) == (arc.donor == "rest_of_world_mine")
        assert roles[arc.recipient] is Role.TECHNOSPHERE
    # what is for sale is bought
    for good in STEEL:
        sold = of(world, usual, [*(f"{each}_{good}_exports" for each in regions), f"rest_of_world_{good}_sold"])
        bought = of(world, usual, [*(f"{each}_{good}_imports" for each in regions), f"rest_of_world_{good}_bought"])
        np.testing.assert_allclose(bought, sold, rtol=1e-9)


@pytest.mark.medium
def test_as_usual_each_country_does_what_it_does_alone(world: Network, usual: Rollout, everyone: list[Country]) -> None:
    """What the markets give each is what it imports in its own network, which goes on from today."""
    for region in [*identifiers(each.name for each in everyone).values()][::6]:
        flows, _ = steel.simulated(region, "default")
        for arc in ("goods_to_use", "bof_steel", "eaf_steel", "scrap_to_eaf", "flat_imports", "goods_exports"):
            ours = of(world, usual, [f"{region}_{arc}"])
            np.testing.assert_allclose(ours, flows[arc], rtol=1e-3, atol=1.0, err_msg=f"{region} {arc}")


@pytest.mark.slow
def test_mass_is_conserved(world: Network) -> None:
    """Under any actions, in every copy, and a batch is what its copies are alone."""
    env = MultiAgentVectorEnv(world, num_envs=3, horizon=3)
    random = np.random.default_rng(5)
    actions = [{agent: random.uniform(-1, 1, (3, 1)) for agent in env.agents} for _ in range(3)]
    lone = MultiAgentVectorEnv(world, num_envs=1, horizon=3)
    env.reset(seed=[1, 2, 3])
    lone.reset(seed=[2])
    before = env.snapshot().state.stock.sum(axis=0)
    for each in actions[:2]:
        env.step(each)
        lone.step({agent: action[1:2] for agent, action in each.items()})
        after = env.snapshot().state.stock
        assert (after >= 0).all()
        np.testing.assert_allclose(after.sum(axis=0), before, rtol=1e-12)
        np.testing.assert_array_equal(lone.snapshot().state.stock[:, 0], after[:, 1])


@pytest.mark.slow
def test_what_stays_at_home_saves_ore_there_and_is_missed_elsewhere(world: Network, usual: Rollout) -> None:
    """Scrap that Japan does not export is melted in Japan; those who bought it take more ore."""
    env = MultiAgentVectorEnv(world, num_envs=1, agents=["japan_scrap_exports"])
    begun = episode_start(env)

    run = begun.play(env, Constant({"japan_scrap_exports": -1.0}))
    own = [f"japan_{arc}" for arc in PRIMARY]
    everyone_ = [arc.id for arc in world.arcs if arc.makes_up_for]
    saved = {
        name: (of(world, usual, arcs) - of(world, run, arcs)).sum() for name, arcs in (("own", own), ("all", everyone_))
    }
    assert saved["own"] > 0
    assert saved["all"] < 0.7 * saved["own"]


@pytest.mark.slow
def test_the_data_files_are_of_the_table(
    everyone: list[Country], usual: Rollout, world: Network, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Written again from the published table, they are the same."""
    least = float(of(world, usual, [f"rest_of_world_{good}_bought" for good in STEEL]).min())
    found = markets(everyone)
    monkeypatch.setattr(steel_world, "ENVS", tmp_path)
    write_trade(everyone, found, 0.9 * least)
    for name in ("steel_world.csv", "steel_world_rest.csv"):
        texts = [(folder / name).read_text(encoding="utf-8") for folder in (tmp_path, steel.ENVS)]
        ours, theirs = (list(csv.reader(text.splitlines())) for text in texts)
        assert [row[0] for row in ours] == [row[0] for row in theirs] and ours[0] == theirs[0]
        given, again = (np.array([[float(cell) for cell in row[1:]] for row in each[1:]]) for each in (ours, theirs))
        np.testing.assert_allclose(given, again, rtol=1e-7, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("scenario", ["default", "longer_lives"])
def test_conformance(scenario: str) -> None:
    """Some years of hundreds of agents."""
    check_parallel_env(lambda: parallel_env("steel_world", scenario=scenario, horizon=4), steps=4)


@pytest.mark.slow
def test_all_that_can_be_had_is_had(world: Network, usual: Rollout) -> None:
    """Where nobody acts and all improves by 2050, λ is better."""
    env = MultiAgentVectorEnv(load_network("steel_world", scenario="high_circularity"), num_envs=1)
    begun = episode_start(MultiAgentVectorEnv(world, num_envs=1))
    later = rollout(env, Neutral(), start=begun.initial_state)
    assert later.episode_circularity[0] > 0.9 * usual.episode_circularity[0]
    assert len(load_network("steel_world", scenario="longer_lives").default_agents) == 17 * 30
