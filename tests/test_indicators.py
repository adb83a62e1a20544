"""Where what leaves use ends, and what enters it was before: closed forms, a walk along the flows, and conservation."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from cirl_marl import MultiAgentVectorEnv, Network, load_network, simulate
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.indicators import Indicators, indicators
from cirl_marl.controllers.rollout import rollout
from cirl_marl.evaluation.figures import summary
from cirl_marl.network import Floats
from cirl_marl.network.elements import Arc, Episode, Law, Lifetime, Node, Role

ENDS = {
    "mined": ("mine", "goods"),
    "bought": ("goods", "use"),
    "end": ("use", "discards"),
    "collected": ("discards", "sorting"),
    "dumped": ("discards", "dump"),
    "recycled": ("sorting", "goods"),
    "rejected": ("sorting", "dump"),
    "sold": ("sorting", "abroad"),
    "dug": ("dump", "goods"),
}


def cycle() -> Network:
    """Return a mine, goods, products in use, collection with sorting, a dump and exports."""
    roles = {"mine": Role.NONRENEWABLE_RESERVOIR, "dump": Role.LANDFILL}
    names = dict.fromkeys(end for ends in ENDS.values() for end in ends)
    nodes = {name: Node(id=name, role=roles.get(name, Role.TECHNOSPHERE), initial=(50.0, 50.0)) for name in names}
    nodes["use"] = replace(nodes["use"], lifetime=Lifetime(mean=9.0, deviation=3.0))
    laws = {"end": {"law": Law.SHARE}}
    arcs = (
        Arc(id=id_, donor=a, recipient=b, **laws.get(id_, {"law": Law.EXOGENOUS, "flow": 1.0}))
        for id_, (a, b) in ENDS.items()
    )
    return Network(
        name="cycle",
        nodes=tuple(nodes.values()),
        arcs=tuple(arcs),
        episode=Episode(control_interval=1.0, horizon=4),
        mass_unit="kt",
        time_unit="year",
    )


def found(flows: dict[str, float]) -> Indicators:
    """Return the indicators of flows of the cycle."""
    result = indicators(cycle(), np.array([flows.get(id_, 0.0) for id_ in ENDS]))
    assert result is not None
    return result


BALANCED = {"mined": 4, "bought": 10, "end": 10, "collected": 8, "dumped": 2, "recycled": 6, "rejected": 1, "sold": 1}


def test_what_is_collected_and_not_rejected_is_recycled() -> None:
    """By hand: 3 of 10 are lost, at home or in sorting, one is sold abroad, and 6 of what is bought was used before."""
    result = found({name: float(flow) for name, flow in BALANCED.items()})
    np.testing.assert_allclose(
        [result.recycling_rate, result.recycled_content, result.primary_content, result.losses], [0.7, 0.6, 0.4, 3.0]
    )


def test_what_a_store_keeps_is_not_lost() -> None:
    """Of 10 discarded 3 wait to be collected; what was in store before is no content of new products."""
    result = found({**BALANCED, "collected": 5.0, "recycled": 3.0, "mined": 4.0, "bought": 10.0})
    np.testing.assert_allclose(result.losses, 2 + 5 * 1 / 5)
    np.testing.assert_allclose(result.recycling_rate, 0.7)
    np.testing.assert_allclose([result.recycled_content, result.primary_content], [0.3, 0.4])


def test_what_is_dug_out_of_a_dump_was_lost() -> None:
    """It ends there, whatever becomes of it later; where it comes back it was in use before."""
    result = found({**BALANCED, "dug": 2.0, "mined": 2.0})
    np.testing.assert_allclose([result.losses, result.recycling_rate], [3.0, 0.7])
    np.testing.assert_allclose([result.recycled_content, result.primary_content], [0.8, 0.2])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("name", ["copper_net", "paper_city"])
def test_a_walk_along_the_flows_ends_where_they_say(name: str, seed: int) -> None:
    """Random flows of networks that have loops: mass is followed step by step, forwards and backwards."""
    network = load_network(name)
    flow = np.random.default_rng(seed).uniform(0.0, 5.0, len(network.arcs))
    result = indicators(network, flow)
    assert result is not None
    size = len(network.nodes)
    matrix = np.zeros((size, size))
    np.add.at(matrix, (network.donors, network.recipients), flow)
    use = np.zeros(size, dtype=bool)
    served = {service.provider for service in network.services if service.quantity == "stock"} & {*network.node_index}
    use[[network.node_index[each] for each in served]] = True
    lost = np.array([node.role in {Role.LANDFILL, Role.INCINERATOR, Role.ENVIRONMENT} for node in network.nodes])
    primary = np.array([node.role is Role.NONRENEWABLE_RESERVOIR for node in network.nodes])
    through = np.maximum(matrix.sum(axis=0), matrix.sum(axis=1))

    def walk(flows: Floats, ends: NDArray[np.bool_]) -> Floats:
        at, arrived = flows[use].sum(axis=0), np.zeros(size)
        for _ in range(2000):
            arrived += np.where(ends, at, 0.0)
            at = (np.where(ends, 0.0, at) / np.where(through > 0, through, 1.0)) @ flows
        assert at.sum() < 1e-9
        return arrived

    forwards, backwards = walk(matrix, use | lost), walk(matrix.T, use | primary)
    np.testing.assert_allclose(result.losses, forwards[lost].sum(), rtol=1e-9)
    np.testing.assert_allclose(result.recycling_rate, 1 - forwards[lost].sum() / matrix[use].sum(), rtol=1e-9)
    np.testing.assert_allclose(result.recycled_content, backwards[use].sum() / matrix[:, use].sum(), rtol=1e-9)
    np.testing.assert_allclose(result.primary_content, backwards[primary].sum() / matrix[:, use].sum(), rtol=1e-9)


def test_where_nothing_is_in_use_nothing_is_said() -> None:
    """Fuel is burnt, and not used again."""
    network = load_network("carbo_net")
    assert indicators(network, np.ones(len(network.arcs))) is None
    assert indicators(cycle(), np.zeros(len(ENDS))) is None


def test_the_world_recycles_as_is_published() -> None:
    """Copper some 40 to 50 % at the end of life (Glöser 2013: 45 %), aluminium some 70 to 76 % (IAI)."""
    for name, low, high in (("copper_world", 0.4, 0.5), ("aluminium_world", 0.68, 0.78)):
        simulation = simulate(name)
        result = indicators(simulation.network, simulation.rollout.mean_flow)
        assert result is not None and low < result.recycling_rate < high
        assert result.text(simulation.network) in str(simulation)


def test_comparisons_state_them() -> None:
    """In the figures of each controller."""
    env = MultiAgentVectorEnv(load_network("copper_net"), num_envs=2, horizon=20)
    run = rollout(env, Neutral())
    figures = summary(env, {"neutral": run})["controllers"]["neutral"]
    expected = indicators(env.network, run.mean_flow)
    assert expected is not None and figures["indicators"] == asdict(expected)
