"""Derivatives of intervals by the stocks that they start from, against difference quotients of the simulator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_networks import small

from benchmarks.yearly import Family, yearly_network
from cirl_marl import Arc, Control, ControlKind, Law, Service
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.optimum import slopes
from cirl_marl.optimum.aims import NO_AIMS
from cirl_marl.optimum.options import starting_stocks
from cirl_marl.optimum.vintages import Lifetimes
from cirl_marl.optimum.window_climb import WindowActions

FAMILY = Family(years=(5, 5), regions=(2, 2), products=(3, 3), lifetimes=(6, 6), supplied=1.0, idle=1.0)
"""Cycles with hoards, with lifetimes, fixed ones too, and with supplies that nobody acts on."""


def plan_of(seed: int, interval: float) -> WindowActions:
    """Return random actions in the network of a seed, under which hoards run dry and services need supplies."""
    network = yearly_network(seed, FAMILY).with_options(episode={"control_interval": interval})
    agents = network.default_agents
    initial = starting_stocks(Lifetimes(network, agents), None)
    actions = np.random.default_rng(seed).uniform(-1, 1, (5, len(agents)))
    for entry, agent in enumerate(agents):
        if agent.endswith(("_mining", "_release")):
            actions[:, entry] = -0.9 if agent.endswith("_mining") else 1.0
    return WindowActions(network, agents, initial, actions, None, NO_AIMS)


@pytest.mark.parametrize(("seed", "interval", "hoard"), [(4, 1.0, "r0_release"), (8, 0.5, "")])
def test_maps_of_intervals_are_what_quotients_come_to(
    seed: int, interval: float, hoard: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By stocks and by actions: of slots, past a hoard that runs dry in an interval, and of supplies that follow."""
    plan = plan_of(seed, interval)
    dynamics = Dynamics(plan.network)
    exact = slopes.jacobians(plan, dynamics)
    flow = exact.end[:, dynamics.rows.nodes.stop :]
    supplies = flow[:, [plan.network.arc_index[arc.id] for arc in plan.network.arcs if arc.makes_up_for]]
    assert dynamics.slots is not None and dynamics.substeps > 9 and (supplies == 0).any() and (supplies > 0).any()
    if hoard:  # which is asked for as much in every interval
        released = flow[:, plan.network.arc_index[hoard]]
        assert released[0] == released[2] > released[3] > released[4] > 0
    monkeypatch.setattr(slopes, "has_interval_maps", lambda dynamics: False)
    monkeypatch.setattr(slopes, "DIFFERENCE", 1e-7)
    quotients = slopes.jacobians(plan, dynamics)
    assert_alike(exact, quotients, 3e-4)
    np.testing.assert_array_equal(exact.end, quotients.end)


def assert_alike(exact: slopes.Slopes, quotients: slopes.Slopes, tolerance: float) -> None:
    """Compare derivatives relative to the largest."""
    for entries, of_quotients in ((exact.by_stock, quotients.by_stock), (exact.by_action, quotients.by_action)):
        np.testing.assert_allclose(entries, of_quotients, rtol=0, atol=tolerance * abs(of_quotients).max())


def test_supplies_share_what_is_left_with_others(monkeypatch: pytest.MonkeyPatch) -> None:
    """A supply from a mine that runs dry brings more, if it is asked for more, at the cost of an order from there."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=5.0, high=10.0)
    supply = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=30.0)
    network = small(
        {"mine": 12.0, "use": 10.0, "shop": 3.0, "tip": 0.0},
        [
            Arc(id="order", donor="mine", recipient="shop", law=Law.CONTROLLED, control=order),
            Arc(id="sales", donor="shop", recipient="tip", rate=2.0),
            Arc(id="wear", donor="use", recipient="tip", rate=0.8),
            Arc(id="supply", donor="mine", recipient="use", law=Law.CONTROLLED, control=supply),
        ],
        interval=2.0,
        horizon=1,
    )
    network = replace(
        network,
        arcs=(*network.arcs[:-1], replace(network.arcs[-1], makes_up_for="held")),
        services=(Service(id="held", provider="use", quantity="stock", low=3.5),),
        default_agents=("order",),
    )
    plan = WindowActions(network, ("order",), network.initial[0], np.full((1, 1), 0.6), None, NO_AIMS)
    dynamics = Dynamics(network)
    exact = slopes.jacobians(plan, dynamics)
    mine, use, *_ = exact.end[0]
    assert dynamics.substeps > 2 and mine < 1e-9 and use == pytest.approx(3.5)
    monkeypatch.setattr(slopes, "has_interval_maps", lambda dynamics: False)
    assert_alike(exact, slopes.jacobians(plan, dynamics), 1e-4)
