"""The solver against independent ones, closed forms, its order, and its limits."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm
from small_networks import advanced, neutral_rate, plain_networks, small, start

from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    parallel_env,
)
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.network.series import Series

Floats = NDArray[np.float64]


def continuous(network: Network) -> Network:
    """Return the network with its batches replaced by proportional flows, which the exact solver is about."""
    arcs = [
        replace(arc, law=Law.DONOR, rate=0.3, batches=(), delay=0.0) if arc.batches else arc for arc in network.arcs
    ]
    return replace(network, arcs=tuple(arcs)).with_options(episode={"solver": "exact", "solver_step": None})


any_network = plain_networks.map(continuous)


def system(network: Network) -> Floats:
    """Return M of d(x, 1)/dt = M (x, 1) under neutral control, assembled arc by arc."""
    dynamics, stores, nodes = Dynamics(network), len(network.stores), len(network.nodes)
    rates = neutral_rate(dynamics)[:, 0]
    gains, entering, passed = (
        np.zeros((len(rates), stores + 1)),
        np.zeros((nodes, stores + 1)),
        np.zeros((nodes, nodes)),
    )
    for k, (i, j) in enumerate(zip(network.donors, network.recipients, strict=True)):
        if i < stores:
            gains[k, dynamics.driver[k]] = rates[k]
            entering[j] += gains[k]
        else:
            passed[j, i] += rates[k]
    # q = P q + b, b what enters from elsewhere; of the stocks it says what goes nowhere at once
    through = np.linalg.solve(np.eye(nodes) - passed, entering)
    matrix = np.zeros((stores + 1,) * 2)
    for k, (i, j) in enumerate(zip(network.donors, network.recipients, strict=True)):
        if i >= stores:
            gains[k] = rates[k] * through[i]
        for end, sign in ((i, -1.0), (j, 1.0)):
            if end < stores:
                matrix[end] += sign * gains[k]
    return matrix


def ample(network: Network, interval: float) -> Network:
    """Return the network with stocks that nothing exhausts soon, and no limits on flows."""
    nodes = tuple(
        replace(node, initial=(900.0, 1000.0 + 10 * i)) if node.stores else node for i, node in enumerate(network.nodes)
    )
    episode = replace(network.episode, control_interval=interval)
    arcs = tuple(replace(arc, capacity_node="", capacity_rate=0.0) for arc in network.arcs)
    return replace(network, nodes=nodes, arcs=arcs, episode=episode)


def stays_positive(network: Network, interval: float) -> bool:
    """Whether the linear system itself exhausts no stock, so that no flow has to be cut."""
    step = expm(system(network) * interval / 20)
    path = [start(network)]
    for _ in range(20):
        path.append(step @ path[-1])
    return bool(np.array(path)[:, :-1].min() > 1.0)


@given(network=any_network, interval=st.floats(0.05, 0.5))
def test_exact_solver_against_matrix_exponential(network: Network, interval: float) -> None:
    """Zero-order hold: x(h) = exp(Mh) x(0)."""
    network = ample(network, interval)
    assume(stays_positive(network, interval))
    expected = expm(system(network) * interval) @ start(network)
    mass = start(network)[:-1].sum()
    np.testing.assert_allclose(advanced(network), expected[:-1, 0], rtol=0, atol=1e-12 * mass)


@given(network=any_network, interval=st.floats(0.05, 0.5))
def test_exact_solver_against_solve_ivp(network: Network, interval: float) -> None:
    """An adaptive Runge-Kutta solver at rtol 1e-10 gives the same stocks."""
    network = ample(network, interval)
    assume(stays_positive(network, interval))
    matrix = system(network)
    solved = solve_ivp(
        lambda t, x: matrix @ x, (0, interval), start(network)[:, 0], method="DOP853", rtol=1e-10, atol=1e-12
    )
    np.testing.assert_allclose(advanced(network), solved.y[:-1, -1], rtol=1e-8)


def test_single_decay() -> None:
    """X(t) = x0·exp(−a t), also where the interval is many residence times."""
    for rate in (0.01, 1.0, 30.0):
        arc = Arc(id="decay", donor="a", recipient="b", rate=rate)
        stock = advanced(small({"a": 7.0, "b": 0.0}, [arc]), steps=2)
        expected = 7.0 * math.exp(-2 * rate)
        np.testing.assert_allclose(stock, [expected, 7.0 - expected], rtol=1e-11, atol=1e-12)


def test_two_nodes_in_exchange() -> None:
    """X_a relaxes to b/(a+b) of the mass at the rate a + b."""
    arcs = [
        Arc(id="to", donor="a", recipient="b", rate=0.7),
        Arc(id="fro", donor="b", recipient="a", rate=0.2),
    ]
    stock = advanced(small({"a": 9.0, "b": 0.0}, arcs), steps=3)
    rest = 9.0 * 0.2 / 0.9
    np.testing.assert_allclose(stock[0], rest + (9.0 - rest) * math.exp(-0.9 * 3), rtol=1e-12)


@given(network=any_network)
def test_intervals_compose(network: Network) -> None:
    """Two half intervals are one interval, where nothing is cut and no series changes."""
    assume(not network.time_dependent)
    whole = ample(network, 0.3)
    assume(stays_positive(whole, 0.3))
    mass = start(whole)[:-1].sum()
    np.testing.assert_allclose(advanced(whole), advanced(ample(whole, 0.15), steps=2), rtol=0, atol=1e-12 * mass)


def test_euler_is_of_first_order() -> None:
    """Halving the step halves the error."""
    arcs = [
        Arc(id="to", donor="a", recipient="b", rate=0.7),
        Arc(id="fro", donor="b", recipient="a", rate=0.2),
        Arc(id="pull", donor="c", recipient="a", law=Law.RECIPIENT, rate=0.4),
    ]
    network = small({"a": 9.0, "b": 1.0, "c": 50.0}, arcs)
    exact = advanced(network)
    errors = [
        np.abs(
            advanced(replace(network, episode=Episode(solver="euler", solver_step=step, control_interval=1.0))) - exact
        ).max()
        for step in (1 / 64, 1 / 128, 1 / 256)
    ]
    orders = np.log2(np.array(errors[:-1]) / errors[1:])
    np.testing.assert_allclose(orders, 1.0, atol=0.02)


@given(gaps=st.lists(st.floats(0.01, 2), max_size=6), interval=st.floats(0.05, 2), seed=st.integers(0, 2**32 - 1))
def test_series_means_are_exact(gaps: list[float], interval: float, seed: int) -> None:
    """What an exogenous series moves in an interval is its integral over it."""
    times = np.array([0.0, *np.cumsum(gaps)])
    values = np.random.default_rng(seed).uniform(0, 5, len(times))
    arc = Arc(
        id="feed", donor="a", recipient="b", law=Law.EXOGENOUS, flow=Series(times=tuple(times), values=tuple(values))
    )
    network = small({"a": 1e3, "b": 0.0}, [arc], interval=interval, horizon=6)
    for step in range(1, 7):
        held = np.clip(np.append(times[1:], np.inf), 0, step * interval) - np.clip(times, 0, step * interval)
        assert advanced(network, step)[1] == pytest.approx(values @ held, rel=1e-12, abs=1e-12)


@pytest.mark.slow
@pytest.mark.medium
def test_hundred_thousand_compartments() -> None:
    """A generated network of 50 000 nodes and 50 000 arcs steps, conserves mass and stays positive."""
    size = 50_000
    rng = np.random.default_rng(0)
    rates, stocks, ends = rng.uniform(0.1, 0.9, size), rng.uniform(0, 10, size), rng.integers(1, size, size)
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=2.0)
    nodes = tuple(
        Node(id=f"n{i}", initial=(float(x), float(x)), control=valve if i < 3 else None) for i, x in enumerate(stocks)
    )
    arcs = tuple(
        Arc(id=f"a{i}", donor=f"n{i}", recipient=f"n{(i + int(hop)) % size}", rate=float(rate))
        for i, (rate, hop) in enumerate(zip(rates, ends, strict=True))
    )
    env = MultiAgentVectorEnv(Network(name="large", nodes=nodes, arcs=arcs, episode=Episode(horizon=3)), num_envs=2)
    env.reset(0)
    before = env.state()[:, :-1].sum(axis=1)
    for _ in range(3):
        _, rewards, _, truncations, _ = env.step({agent: np.ones((2, 1)) for agent in env.agents})
        assert all(np.isfinite(reward).all() for reward in rewards.values())
        assert (env.physical.stock >= 0).all()
        if not truncations[env.agents[0]].any():
            np.testing.assert_allclose(env.state()[:, :-1].sum(axis=1), before, rtol=1e-12)


@settings(max_examples=10)
@given(any_network)
def test_local_order_changes_nothing_but_the_order(network: Network) -> None:
    """The reordered network has the same compartments and the same trajectory, to round-off."""
    ordered = network.in_local_order()
    assert set(ordered.nodes) == set(network.nodes)
    assert set(ordered.arcs) == set(network.arcs)
    mass = network.initial[1].sum() + 1.0
    place = [ordered.node_index[node.id] for node in network.stores]
    steps = min(3, network.episode.horizon)
    np.testing.assert_allclose(advanced(ordered, steps)[place], advanced(network, steps), rtol=0, atol=1e-11 * mass)


def test_rates_that_no_solver_can_follow_are_refused() -> None:
    """A rate in the wrong unit would need a million substeps; a long Runge-Kutta step would be unstable."""
    fast = small({"a": 1.0, "b": 0.0}, [Arc(id="f", donor="a", recipient="b", rate=1e6)])
    with pytest.raises(CirlError, match=r"node 'a' turns over 1e\+06/day.*wrong unit"):
        Dynamics(fast)
    slow = small({"a": 1.0, "b": 0.0}, [Arc(id="f", donor="a", recipient="b", rate=2.5)])
    coarse = replace(slow, episode=Episode(solver="rk4", solver_step=1.0))
    with pytest.raises(CirlError, match=r"solver_step of at most 0\.4 day, not 1"):
        Dynamics(coarse)


def test_network_without_controls_can_be_simulated() -> None:
    """A pure material-flow model has no agents; it runs under nobody's control, but no agent environment is made."""
    network = small({"a": 8.0, "b": 0.0}, [Arc(id="f", donor="a", recipient="b", rate=0.5)])
    run = rollout(MultiAgentVectorEnv(network, num_envs=2), Neutral())
    assert run.stock[-1].sum() == pytest.approx(8.0, rel=1e-12)
    with pytest.raises(CirlError, match="nothing can act"):
        parallel_env(network)


@pytest.mark.parametrize(
    "arc",
    [
        Arc(id="k", donor="a", recipient="b", law=Law.EXOGENOUS, flow=Series(times=(0.0, 2.0), values=(2.0, 3.0))),
        Arc(id="k", donor="a", recipient="b", law=Law.BATCH, batches=((0.0, 5.0),), delay=1.0),
    ],
)
def test_what_depends_on_the_time_needs_it(arc: Arc) -> None:
    """Without its interval a series would flow at 1 and a batch not at all; a constant network needs none."""
    dynamics = Dynamics(small({"a": 10.0, "b": 0.0}, [arc]))
    stock = dynamics.extend(np.array([[10.0], [0.0]]))
    with pytest.raises(CirlError, match=r"'small': advance needs step, .* those of arc 'k'"):
        dynamics.advance(stock, np.empty((0, 1)), np.empty((0, 1)))
    dynamics.advance(stock, np.empty((0, 1)), np.empty((0, 1)), np.array([0]))
    steady = Dynamics(small({"a": 10.0, "b": 0.0}, [Arc(id="k", donor="a", recipient="b", rate=0.1)]))
    steady.advance(steady.extend(np.array([[10.0], [0.0]])), np.empty((0, 1)), np.empty((0, 1)))
