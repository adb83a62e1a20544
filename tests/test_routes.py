"""Bounds of shares, and of what passes through nodes that store nothing, against what is chosen at random."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from small_networks import plain_networks

from benchmarks.yearly import planned, yearly_network
from cirl_marl import Law, Network
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.visit_bounds import VisitBounds
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.reach import RouteBounds


@given(network=plain_networks, seed=st.integers(0, 1000))
def test_shares_lie_in_their_ranges(network: Network, seed: int) -> None:
    """Whatever some agents ask for while the others are neutral; the ends of the ranges are met."""
    network = network.with_options(episode={"solver": "exact", "solver_step": None})
    arcs = tuple(arc for arc in network.arcs if arc.law is not Law.BATCH)
    network = replace(network, arcs=arcs, services=(), default_agents=())
    rng = np.random.default_rng(seed)
    agents = [agent for agent in network.agents if rng.random() < 0.6] or None
    admissible, laws = Admissible.of(network, agents), FlowLaws(network)
    low, neutral, high = network.control_bounds
    rows = np.zeros(len(neutral), dtype=bool)
    for agent in admissible.agents:
        rows[network.control_rows[agent]] = True
    for step in range(network.episode.horizon):
        asked = np.repeat(neutral[:, step, None], 200, axis=1)
        mixed = np.where(rng.random((rows.sum(), 200)) < 0.7, rng.integers(0, 2, (rows.sum(), 200)), rng.random())
        asked[rows] = low[rows, step, None] + mixed * (high - low)[rows, step, None]
        rate = laws.rate(asked, np.full(200, step))
        least, most = admissible.rate[:, step]
        for each in (rate.min(axis=1) - least, most - rate.max(axis=1)):
            assert (each >= -1e-12 * (1 + most))[~admissible.by_schedule].all()


@pytest.mark.parametrize("seed", range(8))
def test_routes_bound_what_passes(seed: int) -> None:
    """Throughputs and arrivals under random shares lie within their bounds."""
    network = yearly_network(seed)
    admissible, laws, stores = Admissible.of(network), FlowLaws(network), len(network.stores)
    routes = RouteBounds(admissible.ranges[0], VisitBounds(network, admissible.splits), 0)
    low, _, high = network.control_bounds[:, :, 0]
    rng = np.random.default_rng(seed)
    for _ in range(50):
        asked = low + (high - low) * rng.integers(0, 2, len(low))
        rate = laws.rate(asked[:, None], np.zeros(1, dtype=np.intp))[:, 0]
        entering = rng.uniform(0, 1, len(network.nodes)) * (np.arange(len(network.nodes)) >= stores)
        arcs = network.donors >= stores
        shares = np.zeros((len(network.nodes), len(network.nodes)))
        np.add.at(shares, (network.donors[arcs], network.recipients[arcs]), rate[arcs])
        through = np.linalg.solve(np.eye(len(shares) - stores) - shares[stores:, stores:].T, entering[stores:])
        arrived = shares[stores:, :stores].T @ through
        assert (through <= routes.through(entering[stores:]) * (1 + 1e-12)).all()
        assert (arrived <= routes.most(entering) * (1 + 1e-12)).all()
        assert (arrived >= routes.least(entering) * (1 - 1e-12)).all()


@pytest.mark.parametrize("seed", [0, 1, 3, 8])
@pytest.mark.slow
def test_plans_of_generated_cycles_come_close(seed: int) -> None:
    """The certificate is verified, every service kept, and the plan within 1 % of the bound."""
    outcome = planned(seed)
    assert not outcome.reason
    assert 0.0 <= outcome.gap <= 0.01
