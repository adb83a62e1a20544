"""Orders from nodes that store nothing: pro rata of what is ordered, the rest to those who share it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_gradient import check

from cirl_marl import (
    Account,
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    NetworkError,
    Node,
    Role,
    Series,
    Service,
    Substance,
    gradient,
)
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.lint import lint_warnings
from cirl_marl.controllers.lqr import LQR
from cirl_marl.controllers.rollout import rollout
from cirl_marl.dynamics.krylov import Acceleration, conjugate_residuals
from cirl_marl.environments.state import State
from cirl_marl.errors import CirlError
from cirl_marl.network import Network
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.uncertainty import Spread
from cirl_marl.optimum import bound, simulate_plan
from cirl_marl.optimum.mpc import MPC

Floats = NDArray[np.float64]


def markets(seed: int, beside: bool = False) -> Network:
    """Return markets that several order from, by agents or by schedule, and that pass on and get back what is left.

    Primary material enters ``beside`` what some get from there, and makes up for a service of theirs.
    """
    rng = np.random.default_rng(seed)
    count, interval, horizon = int(rng.integers(1, 5)), float(rng.choice([1.0, 2.0])), 5
    nodes = [Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR), Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0))]
    arcs: list[Arc] = []
    needs = [Service(id="need", provider="p00", quantity="stock", low=30.0)]
    uncertain: dict[str, Spread] = {}

    def add(id_: str, donor: str, recipient: str, law: Law = Law.SHARE, **fields: Any) -> None:
        price = {"cost": float(rng.normal())}
        arcs.append(Arc(id=id_, donor=donor, recipient=recipient, law=law, accounts=price, **fields))

    def flow(high: float, most: float) -> Control:
        return Control(kind=ControlKind.FLOW, low=0.0, neutral=float(rng.uniform(0, most)), high=high)

    for i in range(count):
        market = f"m{i}"
        nodes.append(Node(id=market, stores=False))
        for use in (f"p{i}0", f"p{i}1"):
            mean = float(rng.uniform(2, 12))
            lifetime = Lifetime(mean=mean, deviation=0.4 * mean, distribution="weibull")
            leaves: dict[str, Any] = {"rate": float(rng.uniform(0.05, 1.2))} if rng.random() < 0.6 else {}
            nodes.append(Node(id=use, initial=(35.0, 35.0), **(leaves or {"lifetime": lifetime})))
            others = [f"m{k}" for k in range(count) if k != i]
            end = str(rng.choice([use, *others])) if rng.random() < 0.4 else use
            if beside and rng.random() < 0.6:
                end = f"make_{use}"
                nodes.append(Node(id=end, stores=False))
                needs.append(Service(id=use, provider=use, quantity="stock", low=float(rng.uniform(20, 60))))
                add(f"good_{use}", end, use, share=float(rng.uniform(0.7, 1.0)))
                add(f"chips_{use}", end, f"m{rng.integers(count)}")
                add(f"primary_{use}", "ore", end, Law.CONTROLLED, makes_up_for=use, control=flow(30.0, 1.0))
            ends = tuple(rng.uniform(0, 15, 2).tolist())
            demand = Series(times=(0.0, horizon * interval), values=ends, interpolation="linear")
            if rng.random() < 0.6:
                add(f"order_{use}", market, end, Law.CONTROLLED, control=flow(25.0, 12.0))
            else:
                add(f"order_{use}", market, end, Law.EXOGENOUS, flow=demand if rng.random() < 0.5 else ends[0])
                uncertain[f"arcs.order_{use}.flow"] = Spread(deviation=0.3, low=0.2, high=2.0)
            add(f"scrap_{use}", use, f"m{rng.integers(count)}", share=float(rng.uniform(0.1, 0.9)))
            add(f"loss_{use}", use, "dump")
        if count > 1:
            add(f"on_{i}", market, f"m{(i + 1) % count}", share=float(rng.uniform(0.1, 0.8)))
        add(f"rest_{i}", market, "dump")
        add(f"mine_{i}", "ore", market, Law.CONTROLLED, control=flow(40.0, 15.0))
    return Network(
        name="markets", nodes=tuple(nodes), arcs=tuple(arcs), accounts=(Account(id="cost", unit="GJ"),),
        services=tuple(needs), episode=Episode(horizon=horizon, control_interval=interval), time_unit="year",
        uncertain=uncertain, disturbed={path: DisturbanceEffect(by="mood") for path in list(uncertain)[1:]},
        disturbances={"mood": AutoRegression(deviation=0.3, persistence=0.5, low=0.5, high=1.6)},
    )  # fmt: skip


def environment(network: Network, copies: int) -> MultiAgentVectorEnv:
    """Return copies of a network in which supplies make up for services."""
    agents = [agent for agent in network.agents if not agent.startswith("primary")]
    return MultiAgentVectorEnv(network, num_envs=copies, agents=agents, uncertain=bool(network.uncertain))


def certain(network: Network) -> Network:
    """Return a network without what is drawn and disturbed."""
    return replace(network, uncertain={}, disturbed={}, disturbances={})


def possible(seed: int, beside: bool = False) -> Network:
    """Return the first of some ``markets`` in which no loop can keep mass for ever."""
    while True:
        try:
            return markets(seed, beside)
        except NetworkError:
            seed += 1


def shop(inflow: float, *orders: float, rest: str = "dump", **changed: Any) -> Network:
    """Return one market that so much enters and from which each order goes to a sink of its own."""
    nodes = [Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR), Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0))]
    nodes += [Node(id="market", stores=False), *(Node(id=f"u{n}", initial=(0.0, 0.0)) for n in range(len(orders)))]
    arcs = [Arc(id="mine", donor="ore", recipient="market", law=Law.EXOGENOUS, flow=inflow)]
    arcs += [
        Arc(id=f"order_{n}", donor="market", recipient=f"u{n}", law=Law.EXOGENOUS, flow=order)
        for n, order in enumerate(orders)
    ]
    arcs += [Arc(id="rest", donor="market", recipient=rest, law=Law.SHARE)] if rest else []
    return replace(
        Network(name="shop", nodes=tuple(nodes), arcs=tuple(arcs), episode=Episode(horizon=2), time_unit="year"),
        **changed,
    )


@pytest.mark.parametrize(
    ("inflow", "orders", "flows"),
    [(12.0, (3.0, 6.0), (3.0, 6.0, 3.0)), (6.0, (3.0, 6.0), (2.0, 4.0, 0.0)), (9.0, (3.0, 6.0), (3.0, 6.0, 0.0)),
     (0.0, (3.0, 6.0), (0.0, 0.0, 0.0)), (5.0, (0.0, 0.0), (0.0, 0.0, 5.0)), (0.0, (0.0,), (0.0, 0.0))],
)  # fmt: skip
def test_orders_are_met_or_cut_pro_rata(inflow: float, orders: tuple[float, ...], flows: tuple[float, ...]) -> None:
    """What is more than all of them goes to the rest."""
    run = rollout(MultiAgentVectorEnv(shop(inflow, *orders), num_envs=1), Neutral())
    np.testing.assert_allclose(run.flow[:, 1:], [flows] * 2, rtol=1e-13, atol=1e-300)


@given(seed=st.integers(0, 2**31))
@example(seed=87)
@example(seed=5)
@settings(max_examples=8)
def test_random_networks(seed: int) -> None:
    """The rule holds for means of every interval, mass is conserved, and a copy is what it is alone.

    So it is with orders that are drawn and disturbed. Supplies beside them make up for what they can make up for.
    """
    network, copies = possible(seed, bool(seed % 2)), 4
    env, lone = (environment(network, count) for count in (copies, 1))
    env.reset(seed=seed % 1000)
    lone.reset(seed=[seed % 1000 + copies - 1])
    rng, interval, stores = np.random.default_rng(seed), network.episode.control_interval, len(network.stores)
    incidence = np.zeros((len(network.nodes), len(network.arcs)))
    np.add.at(incidence, (network.donors, np.arange(len(network.arcs))), -1.0)
    np.add.at(incidence, (network.recipients, np.arange(len(network.arcs))), 1.0)
    for step in range(network.episode.horizon):
        state, actions = env.physical, rng.uniform(-1, 1, (len(env.agents), copies))
        before = env.rows.stocks(state.stock)
        flow = env.advance(actions).flow
        np.testing.assert_array_equal(lone.advance(actions[:, -1:]).flow, flow[:, -1:])
        after = env.rows.stocks(env.physical.stock)
        gain = np.concatenate([after - before, np.zeros((len(network.nodes) - stores, copies))])
        np.testing.assert_allclose(incidence @ flow * interval, gain, atol=1e-12 * flow.sum() * interval)
        assert (flow >= 0).all() and (after >= 0).all()
        for market in network.nodes[stores:]:
            exits = [k for k, arc in enumerate(network.arcs) if arc.donor == market.id]
            orders = [k for k in exits if network.arcs[k].law is not Law.SHARE]
            if not orders:
                continue
            ordered = np.array([ordered_flow(env, state, k, step) for k in orders])
            part = np.minimum(1.0, flow[exits].sum(axis=0) / np.maximum(ordered.sum(axis=0), 1e-300))
            np.testing.assert_allclose(flow[orders], ordered * part, rtol=1e-11, atol=1e-11)
        for service in network.services[1:]:
            supply, stock = flow[network.arc_index[f"primary_{service.id}"]], after[network.node_index[service.id]]
            low = network.interval_means(service.low)[step]
            assert ((stock > low * (1 - 1e-9)) | (supply > 30.0 * (1 - 1e-12))).all()
            assert ((stock < low * (1 + 1e-9)) | (supply == 0.0)).all()


def ordered_flow(env: MultiAgentVectorEnv, before: State, k: int, step: int) -> Floats:
    """Return what an arc of ``env`` was asked for in the interval after ``before``, shape (copies,)."""
    arc, dynamics = env.network.arcs[k], env.dynamics
    if arc.law is Law.CONTROLLED:
        return np.asarray(env.controls[env.network.control_rows[arc.id].start])
    factors = dynamics.factors(before.factors, before.disturbances, np.full(env.num_envs, step))
    assert factors is not None
    row = [*dynamics.factors.ranges].index(f"arcs.{arc.id}.flow")
    return np.asarray(env.network.interval_means(arc.flow)[step] * factors[row])


@given(seed=st.integers(0, 2**31))
@settings(max_examples=30)
def test_what_passes_markets_is_what_steps_from_nothing_come_to(seed: int) -> None:
    """However often it goes round: the oracle sends on what arrives, from nothing, until nothing changes."""
    network = possible(seed)
    dynamics = MultiAgentVectorEnv(network, num_envs=1).dynamics
    orders, staged, rng = dynamics.orders, dynamics.staged_network, np.random.default_rng(seed)
    rate = dynamics.rate(dynamics.neutral[:, :1], np.zeros(1, dtype=np.intp))
    rate[orders.arcs] *= rng.integers(0, 2, (len(orders.arcs), 1)) if seed % 2 else 1.0  # some order nothing
    flow = np.zeros_like(rate)
    flow[orders.inflows] = rng.uniform(0, 20, (len(orders.inflows), 1)) * rng.integers(0, 2)
    through, _ = orders.clear(rate, flow)
    stores, arcs = len(staged.stores), np.arange(len(staged.arcs))
    is_order = np.isin(arcs, orders.arcs)
    for _ in range(20_000):
        passing = np.bincount(staged.recipients, flow[:, 0], len(staged.nodes))[staged.donors]
        total = np.bincount(staged.donors, rate[:, 0] * is_order, len(staged.nodes))[staged.donors]
        part = np.divide(np.minimum(passing, total), total, out=np.zeros_like(total), where=total > 0)
        sent = np.where(is_order, rate[:, 0] * part, rate[:, 0] * np.maximum(passing - total, 0.0))
        before, flow = flow, np.where(staged.donors >= stores, sent, flow[:, 0])[:, None]
        if np.abs(flow - before).max() <= 1e-15 * flow.max():
            break
    passed = np.bincount(staged.recipients, flow[:, 0], len(staged.nodes))[orders.markets]
    np.testing.assert_allclose(through[:, 0], passed, rtol=1e-10, atol=1e-10)
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr("cirl_marl.dynamics.orders.BLOCKS", 0)
        np.testing.assert_allclose(orders.clear(rate, flow)[0], through, rtol=1e-10, atol=1e-10)
    # where just as much is ordered as there is, both what has enough and what has not is right
    total = np.bincount(staged.donors[orders.arcs], rate[orders.arcs, 0], len(staged.nodes))
    part = np.divide(through[:, 0], total[orders.markets], out=np.ones(len(through)), where=total[orders.markets] > 0)
    part = np.minimum(part, 1.0)[np.searchsorted(orders.markets, staged.donors[orders.arcs])]
    rate[orders.arcs] *= part[:, None]
    np.testing.assert_allclose(orders.clear(rate, flow)[0], through, rtol=1e-10, atol=1e-10)


def test_fixed_points_are_found_in_as_many_steps_as_there_are_unknowns() -> None:
    """Of linear maps, however slowly these lead there; rows go each their own way, and one may be left alone."""
    rng, size = np.random.default_rng(0), 4
    matrix, constant = np.diag([0.99, 0.9, 0.6, 0.2]), rng.normal(size=(2, size))
    exact = np.linalg.solve(np.eye(size) - matrix, constant.T).T
    accelerate, point = Acceleration(), np.zeros((2, size))
    for _ in range(size + 1):
        point = accelerate(point, point @ matrix.T + constant - point)
    accelerate.select(np.array([False, True]))
    point = accelerate(point[1:], (point @ matrix.T + constant - point)[1:])
    np.testing.assert_allclose(point, exact[1:], rtol=1e-8)


@pytest.mark.parametrize("prices", [(1.0, -1.0, 0.5), (-1.0, 1.0, 0.5), (0.5, 0.5, -1.0), (-1.0, -1.0, 1.0)])
@pytest.mark.parametrize("inflow", [6.0, 12.0])
def test_nobody_can_give_one_customer_more_than_the_rule(inflow: float, prices: tuple[float, ...]) -> None:
    """What passes the market is next to fixed, and so is what the bound makes of it, whatever it costs."""
    network = shop(inflow, 3.0, 6.0, accounts=(Account(id="cost", unit="GJ"),))
    mine = Control(kind=ControlKind.FLOW, low=inflow, neutral=inflow, high=inflow + 1e-6)
    costs = dict(zip(("order_0", "order_1", "rest"), prices, strict=True))
    arcs = [
        replace(arc, law=Law.CONTROLLED, flow=0.0, control=mine)
        if arc.id == "mine"
        else replace(arc, accounts={"cost": costs[arc.id]})
        for arc in network.arcs
    ]
    network = replace(network, arcs=tuple(arcs))
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral())
    np.testing.assert_allclose(bound(network, aim="cost").objective, -run.accounts[0, 0], atol=1e-4)


@pytest.mark.parametrize("seed", [9, *(pytest.param(seed, marks=pytest.mark.slow) for seed in (1, 6))])
def test_derivatives_are_exact(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of orders that are met, of those that are cut, and through what they leave to others."""
    assert check(environment(possible(seed, beside=seed == 6), 3), seed, monkeypatch) > 20


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(1, 7))
def test_no_episode_books_less_than_the_bound(seed: int) -> None:
    """Nor do those that a search comes to from the plan, which is as good as its promise where orders are free."""
    network = certain(possible(10 * seed))
    solved = bound(network, aim="cost")
    solved.verify()
    copies, rng, best = 64, np.random.default_rng(seed), -np.inf
    env = MultiAgentVectorEnv(network, num_envs=copies)
    mean, width = np.array(solved.actions), np.ones_like(np.array(solved.actions))
    for _ in range(8):
        env.reset(seed=seed)
        actions = np.clip(mean[..., None] + width[..., None] * rng.normal(size=(*mean.shape, copies)), -1, 1)
        for action in actions:
            env.advance(action)
        value = -env.physical.accounts[0]
        best, elite = max(best, float(value.max())), np.argsort(-value)[:10]
        mean, width = actions[..., elite].mean(axis=2), actions[..., elite].std(axis=2) + 0.02
    assert best <= solved.objective + 1e-9 * abs(solved.objective)


def test_with_enough_material_the_bound_is_reached() -> None:
    """Customers ask for what the program gives them, and get it; what is left is dumped."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=8.0)
    network = shop(12.0, 3.0, 6.0, services=(Service(id="need", provider="u1", quantity="stock", low=9.0),))
    arcs = [
        replace(arc, law=Law.CONTROLLED, flow=0.0, control=control) if arc.id == "order_1" else arc
        for arc in network.arcs
    ]
    network = replace(network, arcs=tuple(arcs))
    solved = bound(network, min_service=0.9)
    run = simulate_plan(solved)
    assert run.episode_levels[0].min() >= 0.9 - 1e-9
    np.testing.assert_allclose(run.circularity_mean.mean(), solved.value, rtol=1e-9)
    followed = rollout(MultiAgentVectorEnv(network, num_envs=1), MPC(min_service=0.9))
    np.testing.assert_allclose(followed.circularity_mean.mean(), solved.value, rtol=1e-6)


@pytest.mark.slow
def test_mpc_meets_what_each_customer_orders() -> None:
    """Programs promise a little more than passes a market, and so plans leave that much over there."""
    horizon, mine = 8, Control(kind=ControlKind.FLOW, low=0.0, neutral=10.0, high=40.0)
    lifetime = Lifetime(mean=14.0, deviation=5.0, distribution="lognormal")
    demand = Series(times=(0.0, float(horizon)), values=(14.0, 16.0), interpolation="linear")
    nodes = (
        Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR), Node(id="market", stores=False),
        Node(id="yard", initial=(0.0, 0.0)), Node(id="cars", initial=(200.0, 200.0), lifetime=lifetime),
        Node(id="cans", initial=(10.0, 10.0), rate=1.0), Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
    )  # fmt: skip
    arcs = (
        Arc(id="mine", donor="ore", recipient="market", law=Law.CONTROLLED, control=mine),
        Arc(id="order_cars", donor="market", recipient="cars", law=Law.EXOGENOUS, flow=demand),
        Arc(id="order_cans", donor="market", recipient="cans", law=Law.EXOGENOUS, flow=8.0),
        Arc(id="rest", donor="market", recipient="yard", law=Law.SHARE),
        Arc(id="car_scrap", donor="cars", recipient="market", law=Law.SHARE, share=0.8),
        Arc(id="car_loss", donor="cars", recipient="dump", law=Law.SHARE),
        Arc(id="can_scrap", donor="cans", recipient="market", law=Law.SHARE),
    )
    lows: dict[str, Series | float] = {"cars": demand, "cans": 8.0}
    services = tuple(Service(id=use, provider=f"order_{use}", quantity="flow", low=low) for use, low in lows.items())
    network = Network(
        name="customers", nodes=nodes, arcs=arcs, services=services, episode=Episode(horizon=horizon), time_unit="year"
    )
    solved, env = bound(network, min_service=1.0), MultiAgentVectorEnv(network, num_envs=1)
    run = rollout(env, MPC(min_service=1.0, horizon=5))
    assert run.episode_levels.min() > 1 - 1e-3
    usual = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral()).circularity_mean.mean()
    assert usual < run.circularity_mean.mean() <= solved.value + 2e-3 * abs(solved.value)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"rest": ""},
            r"controls or orders set all that leaves it; an arc of law 'share' without a control has to take the rest",
        ),
        (
            {"substances": (Substance(id="tin"),)},
            r"orders from it, as of arcs 'order_0', 'order_1', do not go with sub",
        ),
        ({"episode": Episode(horizon=2, solver="rk4", solver_step=0.1)}, r"do not go with solver 'rk4'"),
    ],
)
def test_what_does_not_go_with_orders_is_refused(changed: dict[str, Any], message: str) -> None:
    """With the node and the reason."""
    with pytest.raises(NetworkError, match=message):
        shop(6.0, 3.0, 6.0, **changed)


@pytest.mark.parametrize(
    ("changed", "fields", "message"),
    [
        ("rest", {"control": Control(kind=ControlKind.SHARE, low=0.0, neutral=0.5, high=1.0)}, "serves arcs 'order_0'"),
        ("order_0", {"capacity_node": "u1", "capacity_rate": 1.0}, "capacity_node: it orders from 'market'"),
        ("order_0", {"makes_up_for": "need"}, "makes_up_for: it orders from 'market'"),
        ("mine", {"makes_up_for": "need"}, "makes_up_for 'need'"),
    ],
)
def test_what_no_arc_beside_orders_can_do_is_refused(changed: str, fields: dict[str, Any], message: str) -> None:
    """Nor is what is ordered more for a supply that enters before it."""
    network = shop(6.0, 3.0, 6.0, services=(Service(id="need", provider="u0", quantity="stock", low=9.0),))
    if "makes_up_for" in fields:
        control = Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=8.0)
        fields = {**fields, "law": Law.CONTROLLED, "flow": 0.0, "control": control}
    arcs = tuple(replace(arc, **fields) if arc.id == changed else arc for arc in network.arcs)
    with pytest.raises(NetworkError, match=message):
        replace(network, arcs=arcs)


def test_flows_at_the_start_follow_the_rule() -> None:
    """As agents see them before they act."""
    env = MultiAgentVectorEnv(shop(6.0, 3.0, 6.0), num_envs=2)
    env.reset(seed=0)
    np.testing.assert_allclose(env.physical.flow, np.repeat([[6.0], [2.0], [4.0], [0.0]], 2, axis=1), rtol=1e-13)


def test_lqr_refuses_what_may_be_cut() -> None:
    """The rule is not linear."""
    with pytest.raises(CirlError, match="orders from nodes that store nothing, 'order_0' for one, may be cut"):
        rollout(MultiAgentVectorEnv(shop(6.0, 3.0), num_envs=1), LQR())


def test_a_check_tells_which_orders_are_cut() -> None:
    """As of scheduled flows out of stocks."""
    warnings = " ".join(lint_warnings(shop(6.0, 3.0, 6.0)))
    assert "'order_0': under neutral control 'market' gets too little for its flow from 0 year on" in warnings
    assert "gets too little" not in " ".join(lint_warnings(shop(9.0, 3.0, 6.0)))


def test_pivots_settle_one_by_one_where_blocks_go_round() -> None:
    """Three markets, of which two send nine tenths of what is ordered to each other, and two of what is left."""
    inflow, demand = (2.0, 0.0, 4.0), (7.0, 8.0, 3.0)
    nodes = [Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR), Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0))]
    arcs: list[Arc] = []
    for i, (enters, total) in enumerate(zip(inflow, demand, strict=True)):
        nodes += [Node(id=name, stores=False) for name in (f"m{i}", f"ordered_{i}", f"left_{i}")]
        arcs += [
            Arc(id=f"in_{i}", donor="ore", recipient=f"m{i}", law=Law.EXOGENOUS, flow=enters),
            Arc(id=f"order_{i}", donor=f"m{i}", recipient=f"ordered_{i}", law=Law.EXOGENOUS, flow=total),
            Arc(id=f"rest_{i}", donor=f"m{i}", recipient=f"left_{i}", law=Law.SHARE),
        ]
        for name, others in (("ordered", {1: 2, 2: 1}), ("left", {0: 2, 2: 0})):
            if i in others:
                arcs.append(
                    Arc(id=f"{name}_on_{i}", donor=f"{name}_{i}", recipient=f"m{others[i]}", law=Law.SHARE, share=0.9)
                )
            arcs.append(Arc(id=f"{name}_dumped_{i}", donor=f"{name}_{i}", recipient="dump", law=Law.SHARE))
    network = Network(name="rings", nodes=tuple(nodes), arcs=tuple(arcs), episode=Episode(horizon=1), time_unit="year")
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral())
    flow = dict(zip([arc.id for arc in arcs], run.flow[0].tolist(), strict=True))
    for i, total in enumerate(demand):
        through = sum(flow[arc.id] for arc in arcs if arc.recipient == f"m{i}")
        assert flow[f"order_{i}"] == pytest.approx(min(total, through), rel=1e-12)
        assert flow[f"rest_{i}"] == pytest.approx(max(0.0, through - total), rel=1e-12)


def test_just_as_much_as_is_ordered_counts_as_less() -> None:
    """What arrives more is worth what customers pay, not what the rest costs."""
    network = shop(0.0, 3.0, 6.0, accounts=(Account(id="cost", unit="GJ"),), episode=Episode(horizon=1))
    mine = Control(kind=ControlKind.FLOW, low=0.0, neutral=9.0, high=18.0)
    costs = {"order_0": 3.0, "order_1": 6.0, "rest": 100.0}
    arcs = [
        replace(arc, law=Law.CONTROLLED, flow=0.0, control=mine)
        if arc.id == "mine"
        else replace(arc, accounts={"cost": costs[arc.id]})
        for arc in network.arcs
    ]
    env = MultiAgentVectorEnv(replace(network, arcs=tuple(arcs)), num_envs=1)
    env.reset(seed=0)
    exact_gradient = gradient(env, np.zeros((1, 1, 1)), circularity=0.0, levels=[], accounts=[1.0])
    np.testing.assert_allclose(exact_gradient.actions, 9.0 * (3.0 / 3.0 + 6.0 * 2.0 / 3.0), rtol=1e-12)


def test_of_what_arrives_more_where_all_have_what_they_order_nothing_is_ordered() -> None:
    """All of it goes to the rest: from there supplies estimate what arrives."""
    dynamics = MultiAgentVectorEnv(shop(12.0, 3.0, 6.0), num_envs=1).dynamics
    rate = dynamics.rate(dynamics.neutral[:, :1], np.zeros(1, dtype=np.intp))
    shares = dynamics.orders.further_shares(rate)
    assert (shares[dynamics.orders.arcs] == 0).all() and (shares[dynamics.orders.rest_arcs] == 1.0).all()


def test_linear_systems_of_which_images_are_known_are_solved_to_round_off() -> None:
    """Of each copy its own; where images do not reach the right-hand side there is no solution."""
    rng, size, copies = np.random.default_rng(0), 12, 3
    matrix, effect = np.eye(size) + 0.02 * rng.normal(size=(copies, size, size)), rng.normal(size=(copies, 4, size))
    residual, total = rng.normal(size=(size, copies)), rng.normal(size=(4, copies))
    solution = np.linalg.solve(matrix, residual.T[..., None])
    exact = total - (effect @ solution)[..., 0].T

    def respond(direction: Floats) -> tuple[Floats, Floats]:
        image, further = ((part @ direction.T[..., None])[..., 0].T for part in (matrix, effect))
        return image, further

    result = conjugate_residuals(residual, total, respond)
    assert result is not None
    np.testing.assert_allclose(result, exact, rtol=1e-9, atol=1e-10)
    flat = np.diag([1.0, 0.0])
    assert conjugate_residuals(np.ones((2, 1)), np.zeros((1, 1)), lambda r: (flat @ r, r[:1])) is None
