"""Batches in networks with substances: they have the content of their donor when they leave, and keep it on the way."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import random_network, with_substances
from hypothesis import given
from hypothesis import strategies as st
from test_substances import rollout_of

from benchmarks.variants import without_substances
from cirl_marl import Arc, Episode, Law, Network, NetworkError, Node, Role, Service, Substance
from cirl_marl.environments.vector import MultiAgentVectorEnv

batch_networks = st.builds(
    lambda seed, nodes, arcs, lifetimes: with_substances(
        random_network(seed, nodes, arcs, lifetimes=lifetimes), seed, batches=True
    ),
    st.integers(0, 2**32 - 1),
    st.integers(2, 10),
    st.integers(1, 20),
    st.booleans(),
)


def quarry(**changes: Any) -> Network:
    """Return a heap with 10 % copper that gets 2 t of pure copper a day, and what is sent from it to a dump."""
    options: dict[str, Any] = {"donor": "heap", "recipient": "dump", "law": Law.BATCH}
    parts: dict[str, Any] = {
        "name": "quarry",
        "nodes": (
            Node(id="heap", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0), content={"copper": 0.1}),
            Node(id="mint", initial=(50.0, 50.0), content={"copper": 1.0}),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        "arcs": (
            Arc(id="thrown", donor="mint", recipient="heap", law=Law.EXOGENOUS, flow=2.0),
            Arc(id="sledge", batches=((1.0, 10.0),), delay=1.0, **options),
            Arc(id="carts", batches=((1.0, 20.0), (2.0, 30.0)), delay=2.0, **options),
        ),
        "services": (),
        "substances": (Substance(id="copper"),),
        "mass_unit": "t",
        "time_unit": "day",
        "episode": Episode(control_interval=1.0, horizon=5),
    }
    return Network(**parts | changes)


def by_component(env: MultiAgentVectorEnv, masses: np.ndarray) -> np.ndarray:
    """Return all that there is of each component, on the way too, shape (components, B)."""
    rows, parts = env.rows, env.rows.components
    nodes = masses[rows.nodes].reshape(parts, -1, masses.shape[1]).sum(axis=1)
    total: np.ndarray = nodes + masses[rows.batches].reshape(parts, -1, masses.shape[1]).sum(axis=1)
    return total


def test_a_batch_keeps_what_its_donor_had_when_it_left() -> None:
    """By hand: 12 of 102 t on day 1, of which 30 leave; more copper comes to the heap, less of it to the batch."""
    env, masses = rollout_of(quarry(), 1, 0)
    content = [12.0 / 102.0]
    content.append((12.0 - 30.0 * content[0] + 2.0) / 74.0)
    copper = [env.rows.substances(table)[2, 0] for table in masses]
    carried = [10.0 * content[0], 20.0 * content[0], 30.0 * content[1]]
    np.testing.assert_allclose(copper, [0.0, 0.0, *np.cumsum(carried), sum(carried)], rtol=1e-12)
    whole = [env.rows.stocks(table)[2, 0] for table in masses]
    np.testing.assert_allclose(whole, [0.0, 0.0, 10.0, 30.0, 60.0, 60.0], rtol=1e-12)
    loads = [env.dynamics.batches.loads(table)[:, 0] for table in masses]
    np.testing.assert_allclose(loads, [[0, 0], [0, 0], [0, 20], [0, 30], [0, 0], [0, 0]], atol=1e-12)


def test_flows_of_batches_have_their_content() -> None:
    """In ``infos`` and observations, in the interval in which they arrive."""
    network = quarry(services=(Service(id="rich", provider="carts", quantity="flow", substance="copper", low=0.5),))
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    for _ in range(3):
        outcome = env.advance(np.zeros((0, 1)))
    copper = env.team_info(outcome)["substances"]["copper"][0]
    np.testing.assert_allclose(copper[1:], [0.0, 20 * 12 / 102], rtol=1e-12)
    contents = env.layout.contents(env.quantities(env.physical))[:, 0]
    assert contents[len(network.nodes) + 2] == pytest.approx(12 / 102, rel=1e-12)
    assert env.physical.service[0, 0] == pytest.approx(2.0 + 2 * 12 / 102, rel=1e-12)


def test_a_donor_that_is_short_sends_what_it_has_of_each() -> None:
    """Both arcs get their part of it, at one content, and nothing goes below 0."""
    arcs = [replace(arc, batches=tuple((time, 10 * mass) for time, mass in arc.batches)) for arc in quarry().arcs]
    env, masses = rollout_of(quarry(arcs=tuple(arcs)), 1, 0)
    copper, whole = (
        np.array([part(table)[:, 0] for table in masses]) for part in (env.rows.substances, env.rows.stocks)
    )
    np.testing.assert_allclose(whole[2:4, 2], [102 / 3, 102.0], rtol=1e-9)
    np.testing.assert_allclose(copper[2:4, 2], [12 / 3, 12.0], rtol=1e-9)
    assert min(table.min() for table in masses) >= 0


@given(network=batch_networks, seed=st.integers(0, 1000), factor=st.sampled_from((1.0, 100.0)))
def test_substances_in_batches_are_conserved(network: Network, seed: int, factor: float) -> None:
    """Each to 1e-12 of its mass, on the way too; none is negative; observations are within their bounds.

    Donors that are asked for a hundred times as much have less than that.
    """
    arcs = (replace(a, batches=tuple((time, factor * mass) for time, mass in a.batches)) for a in network.arcs)
    network = replace(network, arcs=tuple(arcs))
    env, masses = rollout_of(network, 2, seed)
    start = by_component(env, masses[0])
    for table in masses:
        np.testing.assert_allclose(by_component(env, table), start, rtol=1e-12, atol=1e-280)
        assert table.min() >= 0
        loads = table[env.rows.batches].reshape(env.rows.components, -1, 2).sum(axis=(0, 1))
        np.testing.assert_allclose(env.dynamics.batches.loads(table).sum(axis=0), loads, rtol=1e-12)
    for agent, observation in env.observations().items():
        space = env.observation_spaces[agent]
        assert ((observation >= space.low) & (observation <= space.high)).all()


def test_a_donor_that_has_nothing_sends_nothing() -> None:
    """Nor is a level of content missed where nothing arrives."""
    rich = Service(id="rich", provider="carts", quantity="flow", substance="copper", low=0.5)
    network = quarry(services=(rich,))
    heap, *others = network.nodes
    network = replace(network, nodes=(replace(heap, initial=(0.0, 0.0)), *others), arcs=network.arcs[1:])
    env, masses = rollout_of(network, 1, 0)
    assert all(not env.dynamics.batches.loads(table).any() and not env.rows.stocks(table)[2] for table in masses)
    assert env.physical.service[0, 0] == 5.0


@given(seed=st.integers(0, 2**32 - 1), nodes=st.integers(2, 8), arcs=st.integers(2, 16))
def test_what_is_in_batches_changes_no_mass(seed: int, nodes: int, arcs: int) -> None:
    """Where nothing is separated stocks, loads and λ, m_fb in it, are those of the network without substances."""
    network = with_substances(random_network(seed, nodes, arcs), seed, batches=True)
    network = replace(network, arcs=tuple(arc for arc in without_substances(network).arcs))
    plain = without_substances(network)
    (env, together), (other, masses) = rollout_of(network, 1, 0), rollout_of(plain, 1, 0)
    for whole, table in zip(together, masses, strict=True):
        size = table[:-1].sum()
        np.testing.assert_allclose(env.rows.stocks(whole), other.rows.stocks(table), rtol=1e-9, atol=1e-10 * size)
        loads, plain_loads = env.dynamics.batches.loads(whole), other.dynamics.batches.loads(table)
        np.testing.assert_allclose(loads, plain_loads, rtol=1e-9, atol=1e-10 * size)
    np.testing.assert_allclose(env.physical.circularity, other.physical.circularity, rtol=1e-9, atol=1e-9 * size)


def test_contents_on_the_way_are_no_service() -> None:
    """The mass is, its content is not measured."""
    service = Service(id="rich", provider="carts", quantity="stock", substance="copper", low=0.5)
    with pytest.raises(NetworkError, match=r"no content is measured of what is on the way along 'carts'"):
        quarry(services=(service,))
