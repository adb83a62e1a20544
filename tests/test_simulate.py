"""The solver against independent ones, closed forms, its order, and its limits."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.linalg import expm

from cirl_marl import Arc, CirlError, Control, ControlKind, Episode, Law, Network, Node, Role, VectorEnv, parallel_env
from cirl_marl.compartments import RewardState
from cirl_marl.controllers import Neutral
from cirl_marl.evaluate import rollout
from cirl_marl.simulate import Dynamics

Floats = NDArray[np.float64]


def continuous(network: Network) -> Network:
    """Return the network with its batches replaced by proportional flows, which the exact solver is about."""
    arcs = [
        replace(arc, law=Law.DONOR, rate=0.3, batches=(), delay=0.0) if arc.batches else arc for arc in network.arcs
    ]
    return replace(network, arcs=tuple(arcs)).with_options(episode={"solver": "exact", "solver_step": None})


any_network = st.from_type(Network).map(continuous)


def small(
    nodes: dict[str, float],
    arcs: list[Arc],
    *,
    interval: float = 1.0,
    horizon: int = 5,
    solver: str = "exact",
) -> Network:
    """Return a network with given initial stocks."""
    return Network(
        name="small",
        nodes=tuple(Node(id=name, initial=(stock, stock)) for name, stock in nodes.items()),
        arcs=tuple(arcs),
        episode=Episode(
            control_interval=interval,
            horizon=horizon,
            solver=solver,
            solver_step=None if solver == "exact" else interval,
        ),
    )


def order(id_: str, donor: str, recipient: str, most: float) -> Arc:
    """Return an arc whose flow is set between 0 and ``most``, ``most`` being neutral."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=most, high=most)
    return Arc(id=id_, donor=donor, recipient=recipient, law=Law.CONTROLLED, control=control)


@dataclass(frozen=True, slots=True, kw_only=True)
class Source:
    """A model without states whose output is constant."""

    kind: ClassVar[str] = "source"
    state_names: ClassVar[tuple[str, ...]] = ()
    input_names: ClassVar[tuple[str, ...]] = ()
    time_unit: ClassVar[str] = "day"
    reward_state: ClassVar[RewardState] = "after"

    output: float

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return nothing: there is no state."""
        return state

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return the output."""
        return np.full(state.shape[1], self.output)

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return 0."""
        return np.zeros(state.shape[1])


def emptied(output: float, rates: Sequence[float], stock: float, step: float = 0.01) -> Network:
    """Return a node that gives to others at constant rates, as long as it has something to give."""
    arcs = [
        Arc(id=f"f{k}", donor="a", recipient="b", law=Law.COMPARTMENT, by="a", rate=rate)
        for k, rate in enumerate(rates)
    ]
    network = small({"a": stock, "b": 0.0}, [], interval=step, solver="rk4")
    nodes = (replace(network.nodes[0], model=Source(output=output)), network.nodes[1])
    return replace(network, nodes=nodes, arcs=tuple(arcs))


NO_STATES = np.empty((0, 1))


def neutral_rate(dynamics: Dynamics, step: int = 0) -> Floats:
    """Return the rates under neutral control."""
    return dynamics.rate(dynamics.neutral[:, None], np.array([step]))


def start(network: Network) -> Floats:
    """Return the upper initial stocks with the unit row, one column."""
    return np.array([*(node.initial[1] for node in network.nodes), 1.0])[:, None]


def advanced(network: Network, steps: int = 1) -> Floats:
    """Return the stocks after ``steps`` intervals of neutral control, shape (nodes,)."""
    dynamics = Dynamics(network)
    stock = start(network)
    for step in range(steps):
        stock = dynamics.advance(stock, NO_STATES, dynamics.neutral[:, None], np.array([step])).stock
    return stock[:-1, 0]


def system(network: Network) -> Floats:
    """Return M of d(x, 1)/dt = M (x, 1) under neutral control, assembled arc by arc."""
    dynamics = Dynamics(network)
    matrix = np.zeros((len(network.nodes) + 1,) * 2)
    for k, rate in enumerate(neutral_rate(dynamics)[:, 0]):
        matrix[network.donors[k], dynamics.driver[k]] -= rate
        matrix[network.recipients[k], dynamics.driver[k]] += rate
    return matrix


def ample(network: Network, interval: float) -> Network:
    """Return the network with stocks that nothing exhausts soon."""
    nodes = tuple(replace(node, initial=(900.0, 1000.0 + 10 * i)) for i, node in enumerate(network.nodes))
    episode = replace(network.episode, control_interval=interval)
    return replace(network, nodes=nodes, episode=episode)


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
    arcs = tuple(replace(arc, flow=arc.flow[:1], times=()) for arc in network.arcs)
    whole = ample(replace(network, arcs=arcs), 0.3)
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


@pytest.mark.parametrize("rate", [0.0, 0.5, 8.0])
def test_overdrawn_donor_is_emptied(rate: float) -> None:
    """A controlled flow larger than the donor can give takes what is there, and no more."""
    arcs = [order("take", "a", "b", 1000.0)]
    if rate:
        arcs.append(Arc(id="leak", donor="a", recipient="c", rate=rate))
    network = small({"a": 10.0, "b": 0.0, "c": 0.0}, arcs)
    dynamics = Dynamics(network)
    transition = dynamics.advance(start(network), NO_STATES, dynamics.neutral[:, None])
    stock = transition.stock[:-1, 0]
    assert 0 <= stock[0] <= 1e-10
    assert stock.sum() == pytest.approx(10.0, rel=1e-14)
    assert transition.moved.sum() == pytest.approx(10.0, rel=1e-11)


def test_competing_orders_share_the_donor() -> None:
    """Orders that exceed the donor's stock are cut in the same proportion."""
    network = small({"a": 12.0, "b": 0.0, "c": 0.0}, [order("much", "a", "b", 300.0), order("little", "a", "c", 100.0)])
    np.testing.assert_allclose(advanced(network), [0.0, 9.0, 3.0], rtol=1e-11, atol=1e-10)


def test_order_within_reach_is_met() -> None:
    """A controlled flow that the donor can give is given exactly."""
    network = small({"a": 10.0, "b": 0.0}, [order("take", "a", "b", 2.5)])
    np.testing.assert_allclose(advanced(network, steps=3), [2.5, 7.5], rtol=1e-15)


def test_recipient_on_exhausted_reservoir() -> None:
    """A recipient that pulls more than there is gets what is there, and λ does not count what cannot flow."""
    arc = Arc(id="pull", donor="reserve", recipient="plant", law=Law.RECIPIENT, rate=0.5)
    nodes = (
        Node(id="reserve", role=Role.NONRENEWABLE_RESERVOIR, initial=(3.0, 3.0)),
        Node(id="plant", initial=(10.0, 10.0), control=Control(kind=ControlKind.RATE, low=0, neutral=1, high=1)),
    )
    network = Network(name="small", nodes=nodes, arcs=(arc,), episode=Episode(horizon=4))
    env = VectorEnv(network, num_envs=1)
    env.reset(0)
    neutral = env.stack({"plant": np.ones((1, 1))})
    first = env.advance(neutral)
    assert first.flow[0, 0] == pytest.approx(3.0, rel=1e-11)
    np.testing.assert_allclose(env.state()[0, :2], [0.0, 13.0], rtol=1e-11, atol=1e-10)
    second = env.advance(neutral)
    assert abs(second.flow[0, 0]) < 1e-10
    assert abs(second.circularity[0]) < 1e-10
    assert env.state()[0, :2].sum() == pytest.approx(13.0, rel=1e-14)


@given(gaps=st.lists(st.floats(0.01, 2), max_size=6), interval=st.floats(0.05, 2), seed=st.integers(0, 2**32 - 1))
def test_series_means_are_exact(gaps: list[float], interval: float, seed: int) -> None:
    """What an exogenous series moves in an interval is its integral over it."""
    times = np.array([0.0, *np.cumsum(gaps)])
    values = np.random.default_rng(seed).uniform(0, 5, len(times))
    arc = Arc(id="feed", donor="a", recipient="b", law=Law.EXOGENOUS, flow=tuple(values), times=tuple(times))
    network = small({"a": 1e3, "b": 0.0}, [arc], interval=interval, horizon=6)
    for step in range(1, 7):
        held = np.clip(np.append(times[1:], np.inf), 0, step * interval) - np.clip(times, 0, step * interval)
        assert advanced(network, step)[1] == pytest.approx(values @ held, rel=1e-12, abs=1e-12)


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
    env = VectorEnv(Network(name="large", nodes=nodes, arcs=arcs, episode=Episode(horizon=3)), num_envs=2)
    env.reset(0)
    before = env.state()[:, :-1].sum(axis=1)
    for _ in range(3):
        _, rewards, _, truncations, _ = env.step({agent: np.ones((2, 1)) for agent in env.agents})
        assert all(np.isfinite(reward).all() for reward in rewards.values())
        assert (env.physical.stock >= 0).all()
        if not truncations[env.agents[0]].any():
            np.testing.assert_allclose(env.state()[:, :-1].sum(axis=1), before, rtol=1e-12)


def test_recipient_passes_on_only_what_it_got() -> None:
    """Where a donor is exhausted, what leaves the recipient follows from what really arrived."""
    arcs = [
        Arc(id="pull", donor="reserve", recipient="plant", law=Law.RECIPIENT, rate=0.9),
        Arc(id="out", donor="plant", recipient="sink", rate=0.09),
    ]
    stock = advanced(small({"reserve": 0.0, "plant": 10.0, "sink": 0.0}, arcs))
    np.testing.assert_allclose(stock, [0.0, 10 * math.exp(-0.09), -10 * math.expm1(-0.09)], rtol=1e-11, atol=1e-12)


def test_exhausted_reservoir_stays_exhausted() -> None:
    """Emptied again and again, a stock may become subnormal, where shares do not round as they should."""
    rates = (1.4115465964017506, 3.65622291933343, 2.845279648320207)
    arcs = [Arc(id=f"a{k}", donor="r", recipient=f"p{k}", law=Law.RECIPIENT, rate=r) for k, r in enumerate(rates)]
    for stock in (3.0, 1e-289, 1e-300, 1.5e-322, 5e-324):
        nodes = {"r": stock, "p0": 10.0, "p1": 0.5, "p2": 3.0}
        after = advanced(small(nodes, arcs, interval=0.48504374067280137, horizon=40), steps=40)
        assert 0 <= after[0] <= stock
        assert after.sum() == pytest.approx(13.5 + stock, rel=1e-14)


@settings(max_examples=10)
@given(any_network)
def test_local_order_changes_nothing_but_the_order(network: Network) -> None:
    """The reordered network has the same compartments and the same trajectory, to round-off."""
    ordered = network.in_local_order()
    assert set(ordered.nodes) == set(network.nodes)
    assert set(ordered.arcs) == set(network.arcs)
    mass = sum(node.initial[1] for node in network.nodes) + 1.0
    place = [ordered.node_index[node.id] for node in network.nodes]
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


def test_runge_kutta_ends_on_vanishing_stocks() -> None:
    """Emptied again and again, a stock reaches subnormal numbers; the step still ends and nothing is lost."""
    arcs = [Arc(id=f"f{k}", donor="a", recipient="b", rate=0.2) for k in range(5)]
    network = small({"a": 1.0, "b": 0.0}, arcs, horizon=3000)
    stock = advanced(replace(network, episode=Episode(solver="rk4", solver_step=1.0, horizon=3000)), steps=3000)
    assert stock[0] >= 0
    assert stock.sum() == pytest.approx(1.0, rel=1e-12)


@pytest.mark.parametrize(("rates", "stock"), [((10, 1), 0.22), ((10, 2), 0.24), ((3, 22), 0.5)])
def test_what_is_just_asked_for_is_given(rates: tuple[float, float], stock: float) -> None:
    """Two flows whose sum rounds to the stock, while taking one after the other rounds below nothing."""
    left = advanced(emptied(2.0, rates, stock))
    assert (left >= 0).all()
    assert left[1] == pytest.approx(stock, rel=1e-11)


@given(outputs=st.lists(st.floats(1e-3, 1e3), min_size=1, max_size=40), share=st.floats(0.1, 1.5))
def test_models_give_no_more_than_there_is(outputs: list[float], share: float) -> None:
    """Whatever the sums of many flows round to, the step ends, nothing is negative and nothing is lost."""
    stock = share * sum(outputs) * 0.01
    left = advanced(emptied(1.0, outputs, stock))
    assert (left >= 0).all()
    assert left.sum() == pytest.approx(stock, rel=1e-12)
    assert left[1] == pytest.approx(min(1.0, 1 / share) * stock, rel=1e-10)


def test_models_do_not_reverse_flows() -> None:
    """A negative output moves nothing, at the start, in the step and at its end."""
    env = VectorEnv(emptied(-1.0, (3.0,), 5.0), num_envs=1)
    env.reset(seed=0)
    assert env.physical.flow[0, 0] == 0.0
    transition = env.dynamics.advance(env.physical.stock, env.physical.inner, np.empty((0, 1)), env.physical.step)
    assert transition.moved[0, 0] == transition.flow[0, 0] == 0.0


@pytest.mark.parametrize("solver", ["exact", "rk4"])
def test_nothing_passes_on_what_it_did_not_get(solver: str) -> None:
    """Node b pulls from an empty donor: its own decay is as without the pull, x_b(h) = 10·e^{-2h}."""
    pull = Arc(id="pull", donor="a", recipient="b", law=Law.RECIPIENT, rate=7.0)
    decay = Arc(id="decay", donor="b", recipient="c", rate=2.0)
    stock = advanced(small({"a": 0.0, "b": 10.0, "c": 0.0}, [pull, decay], interval=0.05, solver=solver), steps=10)
    np.testing.assert_allclose(stock, [0.0, 10 * math.exp(-1), 10 - 10 * math.exp(-1)], rtol=1e-6)


def test_empty_donors_give_nothing_at_the_start() -> None:
    """The flow that is observed first is none that cannot be."""
    pull = Arc(id="pull", donor="a", recipient="b", law=Law.RECIPIENT, rate=0.5)
    for held, flow in ((0.0, 0.0), (1.0, 1.0), (100.0, 5.0)):
        env = VectorEnv(small({"a": held, "b": 10.0}, [pull]), num_envs=1)
        env.reset(seed=0)
        assert env.physical.flow[0, 0] == pytest.approx(flow, rel=1e-12)


def test_network_without_controls_can_be_simulated() -> None:
    """A pure material-flow model has no agents; it runs under nobody's control, but no agent environment is made."""
    network = small({"a": 8.0, "b": 0.0}, [Arc(id="f", donor="a", recipient="b", rate=0.5)])
    run = rollout(VectorEnv(network, num_envs=2), Neutral())
    assert run.stock[-1].sum() == pytest.approx(8.0, rel=1e-12)
    with pytest.raises(CirlError, match="nothing can act"):
        parallel_env(network)


def test_start_flows_are_what_the_donors_hold() -> None:
    """The first observation does not promise a flow from an empty store."""
    env = VectorEnv("copper_net", num_envs=1)
    env.reset(seed=0, options={"initial_state": {"use": 0.0}})
    assert env.physical.flow[env.network.arc_index["use_to_collection"], 0] == 0.0
