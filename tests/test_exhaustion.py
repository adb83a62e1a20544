"""Donors that hold less than is asked of them: nothing becomes negative, is lost, or is passed on unreceived."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from small_networks import NO_STATES, advanced, small, start

from cirl_marl import Arc, Control, ControlKind, Episode, Law, MultiAgentVectorEnv, Network, Node, Role
from cirl_marl.compartments import ContinuousModel, OutflowModel, RewardState
from cirl_marl.dynamics.integrator import Dynamics

Floats = NDArray[np.float64]


def order(id_: str, donor: str, recipient: str, most: float) -> Arc:
    """Return an arc whose flow is set between 0 and ``most``, ``most`` being neutral."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=most, high=most)
    return Arc(id=id_, donor=donor, recipient=recipient, law=Law.CONTROLLED, control=control)


@dataclass(frozen=True, slots=True, kw_only=True)
class Source(ContinuousModel, OutflowModel):
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


@pytest.mark.parametrize("rate", [0.0, 0.5, 8.0])
def test_overdrawn_donor_is_emptied(rate: float) -> None:
    """A controlled flow larger than the donor can give takes what is there, and no more."""
    arcs = [order("take", "a", "b", 1000.0)]
    if rate:
        arcs.append(Arc(id="leak", donor="a", recipient="c", rate=rate))
    network = small({"a": 10.0, "b": 0.0, "c": 0.0}, arcs)
    dynamics = Dynamics(network)
    transition = dynamics.advance(start(network), NO_STATES, dynamics.neutral[:, :1])
    stock = transition.stock[:-1, 0]
    assert 0 <= stock[0] <= 1e-10
    assert stock.sum() == pytest.approx(10.0, rel=1e-14)
    assert transition.moved_mass.sum() == pytest.approx(10.0, rel=1e-11)


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
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(0)
    neutral = env.stack({"plant": np.ones((1, 1))})
    first = env.advance(neutral)
    assert first.flow[0, 0] == pytest.approx(3.0, rel=1e-11)
    np.testing.assert_allclose(env.state()[0, :2], [0.0, 13.0], rtol=1e-11, atol=1e-10)
    second = env.advance(neutral)
    assert abs(second.flow[0, 0]) < 1e-10
    assert abs(second.circularity[0]) < 1e-10
    assert env.state()[0, :2].sum() == pytest.approx(13.0, rel=1e-14)


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
    env = MultiAgentVectorEnv(emptied(-1.0, (3.0,), 5.0), num_envs=1)
    env.reset(seed=0)
    assert env.physical.flow[0, 0] == 0.0
    transition = env.dynamics.advance(env.physical.stock, env.physical.inner, np.empty((0, 1)), env.physical.step)
    assert transition.moved_mass[0, 0] == transition.flow[0, 0] == 0.0


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
        env = MultiAgentVectorEnv(small({"a": held, "b": 10.0}, [pull]), num_envs=1)
        env.reset(seed=0)
        assert env.physical.flow[0, 0] == pytest.approx(flow, rel=1e-12)


def test_start_flows_are_what_the_donors_hold() -> None:
    """The first observation does not promise a flow from an empty store."""
    env = MultiAgentVectorEnv("copper_net", num_envs=1)
    env.reset(seed=0, options={"initial_state": {"use": 0.0}})
    assert env.physical.flow[env.network.arc_index["use_to_collection"], 0] == 0.0
