"""λ at the end of an interval is that of the flows which the stocks at its end drive, not those at its start."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from small_networks import constant

from cirl_marl import Arc, ControlKind, Episode, Law, MultiAgentVectorEnv, Network, Node, Role

RESERVOIR, TIP = Role.NONRENEWABLE_RESERVOIR, Role.LANDFILL


def _stock_driven(network: Network) -> Network:
    """Return the network with donor laws only, so that every flow follows from the stocks and the controls."""
    arcs = [
        replace(arc, law=Law.DONOR, rate=arc.rate or 0.4, flow=0.0, batches=(), delay=0.0, control=None)
        for arc in network.arcs
    ]
    nodes = [
        replace(node, control=replace(node.control, kind=ControlKind.RATE)) if node.control is not None else node
        for node in network.nodes
    ]
    episode = replace(network.episode, solver="exact", solver_step=None)
    return replace(network, nodes=tuple(nodes), arcs=tuple(arcs), episode=episode)


@pytest.mark.parametrize(("solver", "step", "tolerance"), [("exact", None, 1e-12), ("rk4", 0.05, 1e-6)])
def test_at_the_end_of_a_decay(solver: str, step: float | None, tolerance: float) -> None:
    """A reservoir that loses a·x has λ(t) = −Δ·a·x_0·e^{−at}; the mean over an interval is another number."""
    network = Network(
        name="decay",
        nodes=(Node(id="mine", role=RESERVOIR, initial=(8.0, 8.0)), Node(id="use")),
        arcs=(Arc(id="extraction", donor="mine", recipient="use", rate=0.6),),
        episode=Episode(control_interval=0.5, horizon=3, solver=solver, solver_step=step),
    ).with_options(objective={"reference_interval": 2.0})
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    for interval in (1, 2, 3):
        outcome = env.advance(np.zeros((0, 1)))
        left = math.exp(-0.6 * 0.5 * interval)
        mean = 8.0 * left * math.expm1(0.6 * 0.5) / 0.5
        assert outcome.circularity[0] == pytest.approx(-2.0 * 0.6 * 8.0 * left, rel=tolerance)
        assert outcome.circularity_mean[0] == pytest.approx(-2.0 * mean, rel=tolerance)


def test_at_the_end_of_a_filling() -> None:
    """What falls into the landfill from a node that is being filled is more at the end than at the start, 0."""
    network = Network(
        name="filling",
        nodes=(Node(id="store", initial=(50.0, 50.0)), Node(id="use", initial=(0.0, 0.0)), Node(id="tip", role=TIP)),
        arcs=(
            Arc(id="supply", donor="store", recipient="use", law=Law.EXOGENOUS, flow=3.0),
            Arc(id="loss", donor="use", recipient="tip", rate=0.4),
        ),
        episode=Episode(control_interval=1.5, horizon=1),
    )
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    outcome = env.advance(np.zeros((0, 1)))
    assert outcome.circularity[0] == pytest.approx(3.0 * math.expm1(-0.4 * 1.5), rel=1e-12)


def test_a_scheduled_flow_at_the_end_is_the_one_realised() -> None:
    """A demand of 8 that finds 2 in the first of two substeps and nothing in the second is none at the end."""
    network = Network(
        name="emptied",
        nodes=(
            Node(id="mine", role=RESERVOIR, initial=(2.0, 2.0)),
            Node(id="use", initial=(9.0, 9.0)),
            Node(id="store"),
        ),
        arcs=(
            Arc(id="demand", donor="mine", recipient="use", law=Law.EXOGENOUS, flow=8.0),
            Arc(id="use_to_store", donor="use", recipient="store", rate=2.0),
        ),
        episode=Episode(control_interval=1.0, horizon=1),
    )
    env = MultiAgentVectorEnv(network, num_envs=1)
    assert env.dynamics.substeps == 2
    env.reset(seed=0)
    outcome = env.advance(np.zeros((0, 1)))
    assert outcome.circularity_mean[0] == pytest.approx(-2.0, rel=1e-9)
    assert outcome.circularity[0] == pytest.approx(0.0, abs=1e-9)


@given(network=st.from_type(Network), seed=st.integers(0, 1000))
def test_it_follows_from_the_stocks_at_the_end(network: Network, seed: int) -> None:
    """With flows driven by their donors, λ at the end is −Δ·σᵀ(v·a·x) of the stocks at the end."""
    assume(not network.time_dependent and not any(arc.law is Law.SHARE for arc in network.arcs))
    network = _stock_driven(network)
    env = MultiAgentVectorEnv(network, num_envs=3)
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    acting = [network.node_index[agent] for agent in env.agents]
    controls = [network.nodes[node].control for node in acting]
    for _ in range(network.episode.horizon):
        action = rng.uniform(-1, 1, (len(acting), 3))
        valve = np.ones((len(network.nodes), 3))
        for node, control, chosen in zip(acting, controls, action, strict=True):
            assert control is not None
            low, high = constant(control.low), constant(control.high)
            valve[node] = low + (chosen + 1) / 2 * (high - low)
        outcome = env.advance(action)
        stock = env.rows.stocks(env.physical.stock)
        rate = np.array([arc.rate for arc in network.arcs]).reshape(-1, 1)
        flow = rate * (valve * stock)[network.donors]
        size = network.objective.reference_interval * flow.sum(axis=0)
        assert (np.abs(outcome.circularity - network.circularity(flow)) <= 1e-12 * (1 + size)).all()
