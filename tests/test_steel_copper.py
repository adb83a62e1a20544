"""Copper in the steel of countries and of the world: masses, contents that are published, and plans that keep it."""

from __future__ import annotations

import numpy as np
import pytest

from cirl_marl import MultiAgentVectorEnv, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import Rollout, episode_start
from cirl_marl.definitions.catalogue import families
from cirl_marl.network import Floats, Network
from cirl_marl.optimum import bound, gap, improve_plan, simulate_plan


def as_usual(name: str, scenario: str | None) -> tuple[Network, Rollout]:
    """Return a network and its episode in which nobody acts."""
    network = load_network(name, scenario=scenario)
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env)
    return network, begun.play(env, Neutral())


def content(network: Network, run: Rollout, arc: str) -> Floats:
    """Return the content of a flow in each year."""
    content: Floats = run.contents[:, 0, len(network.nodes) + network.arc_index[arc]]
    return content


@pytest.mark.medium
@pytest.mark.sample(3)
@pytest.mark.parametrize("name", families()["steel"])
def test_copper_adds_itself_to_the_masses(name: str) -> None:
    """What copper is not moves as without it, to within the part that it takes in the demand for steel in use."""
    (plain, without), (network, run) = as_usual(name, None), as_usual(name, "copper")
    for arc in ("goods_to_use", "old_scrap"):
        expected, flow = without.flow[:, plain.arc_index[arc]], run.flow[:, network.arc_index[arc]]
        np.testing.assert_allclose(flow, expected, rtol=0.05)


def test_furnaces_have_what_is_published() -> None:
    """Electric steel of Japan has 0.2 to 0.3 % of copper, that of oxygen furnaces a tenth; long products have most."""
    network, run = as_usual("steel_japan", "copper")
    electric, oxygen = (content(network, run, arc) for arc in ("eaf_steel", "bof_steel"))
    assert ((electric > 0.002) & (electric < 0.003)).all() and (oxygen < 0.15 * electric).all()
    ratio = content(network, run, "semis_to_long") / content(network, run, "semis_to_flat")
    np.testing.assert_allclose(ratio, 7.0, rtol=0.05)


@pytest.mark.slow
def test_the_world_bears_its_copper_until_2050() -> None:
    """As Daehn, Cabrera Serrenho and Allwood (2017) expect; its content rises, as each year brings more old scrap."""
    world, run = as_usual("steel_world", "copper")
    regions = [arc.id.removesuffix("_cast") for arc in world.arcs if arc.id.endswith("_cast")]
    assert len(regions) == 30
    cast, flat, long = (
        run.flow[:, [world.arc_index[f"{region}_{part}"] for region in regions]].sum(axis=1)
        for part in ("cast", "semis_to_flat", "semis_to_long")
    )
    copper = sum(
        content(world, run, f"{region}_cast") * run.flow[:, world.arc_index[f"{region}_cast"]] for region in regions
    )
    mean = np.asarray(copper) / cast
    assert (np.diff(mean[2:]) > 0).all()
    assert (mean < (0.001 * flat + 0.004 * long) / (flat + long)).all()


@pytest.mark.slow
def test_the_plan_of_japan_keeps_copper_and_comes_to_the_bound() -> None:
    """At full service, of contents too."""
    limit = bound("steel_japan", scenario="copper", min_service=1.0)
    run = simulate_plan(improve_plan(limit, starts=1))
    assert float(gap(limit.objective, run.episode_circularity[0])) < 0.002
    assert run.episode_levels.min() > 0.9995
