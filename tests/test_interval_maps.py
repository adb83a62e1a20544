"""Derivatives of intervals by the stocks that they start from, against difference quotients of the simulator."""

from __future__ import annotations

import numpy as np
import pytest

from benchmarks.yearly import Family, yearly_network
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
    for entries, of_quotients in ((exact.by_stock, quotients.by_stock), (exact.by_action, quotients.by_action)):
        np.testing.assert_allclose(entries, of_quotients, rtol=0, atol=3e-4 * abs(of_quotients).max())
    np.testing.assert_array_equal(exact.end, quotients.end)
