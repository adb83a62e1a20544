"""The second program of plans: as good as before, nearer to business as usual, with less change."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from test_optimum import certifiable

from benchmarks.smooth import warehouse_cycle
from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlKind,
    Episode,
    Law,
    Network,
    Node,
    Role,
    Series,
    Service,
    bound,
    improve_plan,
    plan,
    simulate_plan,
    smooth_plan,
)
from cirl_marl.optimum import open_loop, slopes
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.smooth import TOLERANCE, Distance

STEPS, TOTAL = 5, 20.0


def store(neutral: float) -> Network:
    """Return a store that is filled by order from a mine, and has to hold TOTAL at the end."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=neutral, high=10.0)
    demand = Series(times=(0.0, STEPS - 1.0), values=(1e-6, TOTAL))
    return Network(
        name="store",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0)),
            Node(id="store", initial=(1.0, 1.0)),
        ),
        arcs=(Arc(id="mining", donor="mine", recipient="store", law=Law.CONTROLLED, control=control),),
        services=(Service(id="use", provider="store", quantity="stock", low=demand),),
        episode=Episode(control_interval=1.0, horizon=STEPS),
    )


def assert_as_good(smooth: Bound, before: Bound) -> None:
    """λ̄ and services are within the tolerance, changes and distance have not grown, and what is proved stays."""
    run, reference, distance = simulate_plan(smooth), simulate_plan(before), Distance(before)
    loss = reference.episode_circularity[0] - run.episode_circularity[0]
    assert loss <= TOLERANCE * abs(reference.episode_circularity[0])
    assert (run.episode_levels[0] >= reference.episode_levels[0] * (1 - TOLERANCE)).all()
    assert distance.changes(smooth.actions) <= distance.changes(before.actions) + 1e-6
    assert distance(smooth.actions) <= distance(before.actions)
    assert smooth.certificate is before.certificate and smooth.objective == before.objective


@pytest.mark.parametrize("neutral", [0.0, 2.0])
def test_an_order_is_the_same_every_year(neutral: float) -> None:
    """λ̄ is −total/steps whenever it is mined, so that the same every year is best, whatever the plan began with."""
    found = bound(store(neutral), min_service=1.0)
    orders = np.array([9.0, 0.0, 4.0, 5.9999, 0.0001])[:, None] * (TOTAL - 1.0) / 19.0
    before = replace(found, actions=orders / 5.0 - 1.0)
    after = smooth_plan(before)
    assert_as_good(after, before)
    # λ̄ may fall by its tolerance, which brings nothing nearer where everything has to go beyond business as usual
    np.testing.assert_allclose(5.0 * (after.actions + 1.0), (TOTAL - 1.0) / STEPS, rtol=1e-5)


def test_what_makes_no_difference_is_as_usual() -> None:
    """Without any demand nothing is mined but what λ̄ may lose: an order that λ̄ does not see goes back to neutral."""
    network = store(2.0)
    spare = Control(kind=ControlKind.FLOW, low=0.0, neutral=3.0, high=8.0)
    back = Arc(id="moving", donor="store", recipient="yard", law=Law.CONTROLLED, control=spare)
    stores = (network.nodes[0], replace(network.nodes[1], initial=(90.0, 90.0)), Node(id="yard", initial=(0.0, 0.0)))
    network = replace(network, nodes=stores, arcs=(*network.arcs, back), services=())
    found = bound(network)
    jumps = np.where(np.arange(STEPS) % 2 == 0, 1.0, -1.0)
    before = replace(found, actions=np.stack([np.full(STEPS, -0.9), jumps], axis=1))
    after = smooth_plan(before)
    assert_as_good(after, before)
    np.testing.assert_allclose(4.0 * (after.actions[:, 1] + 1.0), 3.0, atol=1e-6)
    # λ̄ is −0.5, and a tenth of an order of 5e-5 more is what half the tolerance allows
    np.testing.assert_allclose(5.0 * (after.actions[:, 0] + 1.0).mean(), 0.5 * (1 + TOLERANCE / 2), rtol=1e-6)


@given(network=st.from_type(Network), interval=st.floats(0.02, 0.4), seed=st.integers(0, 1000))
def test_random_networks(network: Network, interval: float, seed: int) -> None:
    """Whatever the actions were, the episode stays as good, and neither changes nor distance grow."""
    network = certifiable(network, interval, pulls=False)
    found = bound(network)
    rng = np.random.default_rng(seed)
    before = replace(found, actions=rng.uniform(-1.0, 1.0, found.actions.shape))
    assert_as_good(smooth_plan(before), before)


@pytest.mark.slow
def test_orders_that_jump_calm_down() -> None:
    """A cycle with lifetimes, shares and orders: at most 0.6 of the changes, in the plan that users get."""
    found = improve_plan(bound(warehouse_cycle(10), min_service=1.0))
    after, distance = smooth_plan(found), Distance(found)
    assert_as_good(after, found)
    assert distance.changes(after.actions) <= 0.6 * distance.changes(found.actions)
    shown = plan(warehouse_cycle(10), "optimum", min_service=1.0)
    assert shown.note == ""
    np.testing.assert_allclose(shown.rollout.flow, simulate_plan(after).flow, rtol=1e-9)


def test_who_asks(monkeypatch: pytest.MonkeyPatch) -> None:
    """Large plans are made smooth only where they are asked to be, and too large ones never."""
    network, orders = store(1.0), np.zeros(0)
    monkeypatch.setattr(open_loop, "MOST_ROWS", 14)
    found = plan(network, "optimum", min_service=1.0)
    assert "has 15 rows; beyond 14 ask for it" in found.note
    orders = plan(network, "optimum", min_service=1.0, smooth=False).rollout.flow
    np.testing.assert_array_equal(found.rollout.flow, orders)
    assert plan(network, "optimum", min_service=1.0, smooth=True).note == ""
    with pytest.raises(CirlError, match="--smooth and --no-smooth go with --control optimum"):
        plan(network, "neutral", smooth=False)
    monkeypatch.setattr("cirl_marl.optimum.smooth.MOST_SLOPES", 10)
    with pytest.raises(CirlError, match="'store': plans cannot be made smooth, as its Jacobians have 45 entries"):
        plan(network, "optimum", smooth=True)
    assert slopes.MOST_SLOPES > 10
