"""Services with an upper end, and orders that are cut: plans keep what constant actions keep."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from cirl_marl import (
    MPC,
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Objective,
    Role,
    Service,
)
from cirl_marl.controllers.rollout import Rollout, episode_start
from cirl_marl.errors import CirlError
from cirl_marl.evaluation.plans import plan as tell_plan
from cirl_marl.network.elements import Account
from cirl_marl.optimum import bound, gap, improve_plan, simulate_plan
from cirl_marl.optimum.blind import Replay
from cirl_marl.optimum.cross_entropy import search

Floats = NDArray[np.float64]


def maker(low: float, high: float, ore: float = 0.3) -> Network:
    """Return a use whose inflow is to lie in a band: what is wasted, an agent's share, comes back otherwise."""
    share = Control(kind=ControlKind.SHARE, low=0.1, neutral=0.5, high=0.8)
    return Network(
        name="maker",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="market", stores=False),
            Node(id="use", initial=(1.0, 1.0)),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="mining", donor="ore", recipient="market", law=Law.EXOGENOUS, flow=ore),
            Arc(id="waste", donor="market", recipient="dump", law=Law.SHARE, control=share),
            Arc(id="made", donor="market", recipient="use", law=Law.SHARE),
            Arc(id="back", donor="use", recipient="market", rate=1.0),
        ),
        services=(Service(id="product", provider="made", quantity="flow", low=low, high=high),),
        episode=Episode(control_interval=1.0, horizon=4),
    )


def orders(order: float) -> Network:
    """Return a stock that orders ``order`` a year of all that a market without stock gets from it and passes on."""

    def flow(low: float, neutral: float, high: float) -> Control:
        return Control(kind=ControlKind.FLOW, low=low, neutral=neutral, high=high)

    return Network(
        name="orders",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="market", stores=False),
            Node(id="stock", initial=(1500.0, 1500.0)),
            Node(id="away", role=Role.ENVIRONMENT, initial=(0.0, 0.0)),
            Node(id="burnt", role=Role.INCINERATOR, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="mining", donor="ore", recipient="stock", law=Law.CONTROLLED, control=flow(34.0, 124.0, 160.0)),
            Arc(id="lost", donor="market", recipient="burnt", law=Law.SHARE, share=0.57),
            Arc(id="passed", donor="market", recipient="away", law=Law.SHARE),
            Arc(id="ordered", donor="market", recipient="stock", law=Law.CONTROLLED, control=flow(40.0, 300.0, order)),
            Arc(id="sent", donor="stock", recipient="market", law=Law.CONTROLLED, control=flow(100.0, 180.0, 220.0)),
            Arc(id="dumped", donor="stock", recipient="away", law=Law.EXOGENOUS, flow=80.0),
            Arc(id="worn", donor="stock", recipient="burnt", rate=0.05),
        ),
        services=(
            Service(id="sending", provider="market", quantity="outflow", low=149.0),
            Service(id="keeping", provider="stock", quantity="stock", low=1440.0),
        ),
        episode=Episode(control_interval=1.0, horizon=7),
    )


@pytest.mark.slow
@settings(max_examples=8)
@given(low=st.floats(0.1, 0.5), width=st.floats(0.0, 0.6), ore=st.floats(0.1, 0.6), part=st.floats(0.5, 0.98))
@example(low=0.25, width=0.15, ore=0.3, part=0.8)
def test_plans_keep_within_a_band(low: float, width: float, ore: float, part: float) -> None:
    """Plan, MPC and MPC in windows keep what the best of 21 constant shares keeps; the first two are not worse."""
    network = maker(low, low + width, ore)
    runs = [simulate(network, share) for share in np.linspace(-1.0, 1.0, 21)]
    levels = np.array([run.episode_levels[0, 0] for run in runs])
    demand = part * float(levels.max())
    assume(demand > 0.2)
    best = max(float(run.episode_circularity[0]) for run in runs if run.episode_levels[0, 0] >= demand)
    solution = bound(network, min_service=demand)
    assert best <= solution.objective + 1e-6 * abs(best)
    run = simulate_plan(improve_plan(solution))
    assert run.episode_levels[0, 0] >= demand - 1e-3
    assert run.episode_circularity[0] >= best - 2e-3 * abs(best)
    for horizon in (None, 3):
        env = MultiAgentVectorEnv(network, num_envs=1)
        controller = MPC(min_service=demand, horizon=horizon)
        run = episode_start(env).play(env, controller)
        assert not controller.note and run.episode_levels[0, 0] >= demand - 2e-3
        assert horizon or run.episode_circularity[0] >= best - 2e-2 * abs(best)


def simulate(network: Network, action: float) -> Rollout:
    """Return the episode of a constant action."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    shares = np.full((network.episode.horizon, 1), action)
    return episode_start(env).play(env, Replay(shares))


@pytest.mark.parametrize("demand", [0.1, 0.106])
def test_a_plan_that_is_short_is_begun_elsewhere_too(demand: float) -> None:
    """From the actions of the bound nothing but 0.027 is found beside a budget; without it the plan keeps both."""
    source, market, tip = "source", "market", "tip"

    def ordered(recipient: str, name: str, span: tuple[float, float], cost: float) -> Arc:
        control = Control(kind=ControlKind.FLOW, low=span[0], neutral=span[0], high=span[1])
        law, accounts = Law.CONTROLLED, {"cost": cost}
        return Arc(donor=source, recipient=recipient, id=name, law=law, control=control, accounts=accounts)

    share = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.1375, high=0.1466)
    network = Network(
        name="yard",
        nodes=(
            Node(id=source, initial=(0.2813, 0.2813), role=Role.ENVIRONMENT),
            Node(id=tip, initial=(0.0, 0.0), role=Role.INCINERATOR),
            Node(id=market, stores=False),
        ),
        arcs=(
            ordered(tip, "sold", (7.785, 29.88), -0.2291),
            Arc(donor=market, recipient=tip, id="lost", law=Law.SHARE, control=share),
            Arc(donor=market, recipient=tip, id="rest", law=Law.SHARE),
            replace(ordered(market, "idle", (0.0, 3.866), 1.138), makes_up_for="made", weight=0.08),
            replace(ordered(market, "order", (0.845, 8.45), 0.5731), makes_up_for="made", weight=0.92),
        ),
        services=(Service(id="made", provider=market, also=(source,), quantity="outflow", low=1.2298, high=1.2298),),
        accounts=(Account(id="cost", unit="EUR_2023"),),
        episode=Episode(control_interval=0.019165, horizon=3),
        objective=Objective(reference_interval=0.23, net_zero="abs", circularity_scale=0.148),
        default_agents=("sold", "lost", "order"),
        time_unit="year",
    )
    solution = bound(network, min_service=demand, at_most={"cost": -0.0423})
    run = simulate_plan(improve_plan(solution))
    assert run.episode_levels[0, 0] >= demand - 1e-4 and run.accounts[0, 0] <= -0.0423 + 1e-6
    assert simulate_plan(improve_plan(solution, starts=1)).episode_levels[0, 0] < demand


def test_what_a_band_cannot_keep_is_said() -> None:
    """Too much is made whatever is done: plan and MPC come as near as they can, and say what lacks."""
    network = maker(0.1, 0.15, ore=0.6)
    nearest = max(simulate(network, share).episode_levels[0, 0] for share in np.linspace(-1.0, 1.0, 21))
    assert nearest < 0.8
    env = MultiAgentVectorEnv(network, num_envs=1)
    controller = MPC(min_service=0.9)
    run = episode_start(env).play(env, controller)
    assert run.episode_levels[0, 0] == pytest.approx(nearest, abs=5e-3)
    assert f"this one has {0.9 - run.episode_levels[0, 0]:.4f} less of 'product'" in controller.note


@pytest.mark.sample(4)
@pytest.mark.parametrize("order", [300.0, 420.0, 900.0])
@pytest.mark.parametrize("kept", [0.5, 0.79, 0.83])
def test_orders_that_are_cut_do_not_stop_a_plan(order: float, kept: float) -> None:
    """To order more of a market that gives all it has changes nothing: the plan mines more instead."""
    network, demand = orders(order), np.array([0.99, kept])
    run = simulate_plan(improve_plan(bound(network, min_service=demand)))
    assert (run.episode_levels[0] >= demand - 1e-3).all()
    assert float(gap(bound(network, min_service=demand).objective, run.episode_circularity[0])) < 0.2


def test_a_bound_says_something_where_services_are_out_of_reach() -> None:
    """A relaxation that serves more than any episode says nothing of λ̄; a bound at the service delivered does."""
    network = maker(0.1, 0.15, ore=0.6)
    table = tell_plan(network, "optimum")
    told = float(table.proof.split("≤ ")[1].split()[0])
    reached = float(table.rollout.episode_circularity[0])
    served = bound(network, min_service=table.rollout.episode_levels[0] - 1e-6).objective
    assert reached <= told <= served + 1e-4 * abs(served)


def test_budgets_of_nothing_are_exceeded_by_amounts() -> None:
    """Not by parts of nothing."""
    paid = maker(0.25, 0.4)
    mining = replace(paid.arcs[0], accounts={"cost": 2.0})
    network = replace(paid, arcs=(mining, *paid.arcs[1:]), accounts=(Account(id="cost", unit="EUR_2020"),))
    controller = MPC(min_service=0.5, at_most={"cost": 0.0})
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    controller.start(env, seed=0)
    assert "this one has 2.4 EUR_2020 of cost" in controller.note


def test_an_unknown_aim_is_named_before_anything_else() -> None:
    """Not that a service is to be demanded beside it."""
    with pytest.raises(CirlError, match=r"unknown account or service 'prodct'.*Did you mean 'product'"):
        tell_plan(maker(0.25, 0.4), "optimum", aim="prodct")


def test_a_search_has_as_many_knots_as_decisions_at_most() -> None:
    """Nobody has to say so."""
    found = search(maker(0.25, 0.4), min_service=0.8, population=16, iterations=2)
    assert found.levels[0] >= 0.8
