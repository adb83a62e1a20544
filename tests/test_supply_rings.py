"""Supplies of services that hang on each other: rings of markets in which each serves others more than its own."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Node,
    Role,
    Service,
)
from cirl_marl.dynamics import supply
from cirl_marl.dynamics.complementarity import _complementary_pivots, complementary
from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Lifetime


def rings(seed: int) -> Network:
    """Return markets in a ring with a product each; what makes up for a service enters another market."""
    rng = np.random.default_rng(seed)
    count, interval = int(rng.integers(2, 6)), float(rng.choice([1.0, 2.0]))
    nodes = [Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR), Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0))]
    arcs: list[Arc] = []
    services = []
    for i in range(count):
        market, use, onward = f"m{i}", f"p{i}", f"m{(i + 1) % count}"
        mean = float(rng.uniform(2, 15))
        lifetime = Lifetime(mean=mean, deviation=0.4 * mean, distribution="weibull")
        leaves: dict[str, Any] = (
            {"rate": float(rng.uniform(0.05, 1.5))} if rng.random() < 0.6 else {"lifetime": lifetime}
        )
        nodes += [Node(id=market, stores=False), Node(id=use, initial=(20.0, 60.0), **leaves)]
        trade = Control(kind=ControlKind.SHARE, low=0.1, neutral=0.4, high=0.9)
        part = float(rng.uniform(0.2, 0.9))
        split: dict[str, Any] = {"control": trade} if rng.random() < 0.3 else {"share": part}
        arcs += [
            Arc(id=f"on_{i}", donor=market, recipient=onward, law=Law.SHARE, **split),
            Arc(id=f"make_{i}", donor=market, recipient=use, law=Law.SHARE),
            Arc(
                id=f"scrap_{i}",
                donor=use,
                recipient=f"m{rng.integers(count)}",
                law=Law.SHARE,
                share=float(rng.uniform(0.1, 0.9)),
            ),
            Arc(id=f"loss_{i}", donor=use, recipient="dump", law=Law.SHARE),
        ]
        measures = (("outflow", market, (3, 40)), ("flow", f"make_{i}", (1, 20)), ("stock", use, (30, 80)))
        quantity, provider, range_ = measures[rng.integers(3)]
        low = float(rng.uniform(*range_))
        services.append(Service(id=f"s{i}", provider=provider, quantity=quantity, low=low))
        low, high = float(rng.choice([0.0, 1.0])), float(rng.choice([3.0, 30.0, 300.0]))
        flow, entry = Control(kind=ControlKind.FLOW, low=low, neutral=1.0, high=high), int(rng.integers(1, count))
        mined: dict[str, Any] = {"donor": "ore", "recipient": f"m{(i + entry) % count}", "makes_up_for": f"s{i}"}
        arcs.append(Arc(id=f"mine_{i}", law=Law.CONTROLLED, control=flow, **mined))
    episode = Episode(horizon=4, control_interval=interval)
    return Network(
        name="rings", nodes=tuple(nodes), arcs=tuple(arcs), services=tuple(services), episode=episode, time_unit="year"
    )


def step(env: MultiAgentVectorEnv, actions: np.ndarray) -> np.ndarray:
    """Take a step; return supply, its least and its most, and level of each service, shape (4, services, B)."""
    flow, network = env.advance(actions).flow, env.network
    stock = env.rows.stocks(env.physical.stock)
    result = []
    for n, service in enumerate(network.services):
        row = network.control_rows[f"mine_{n}"].start
        low, high = (
            np.full(env.num_envs, table[row, 0]) for table in (env.dynamics.control_low, env.dynamics.control_high)
        )
        amount = (
            stock[network.node_index[service.provider]]
            if service.quantity == "stock"
            else flow[[int(k) for k in network.service_arcs(service)]].sum(axis=0)
        )
        result.append([env.controls[row], low, high, amount / service.low])
    return np.array(result).transpose(1, 0, 2)


@pytest.mark.slow
@given(seed=st.integers(0, 2**31), copies=st.just(8))
@example(seed=29, copies=8)  # sweeps over one service after the other found no solution
@example(seed=59, copies=8)
@example(seed=1072, copies=8)  # neither factors nor secants came to what differences tell
@example(seed=1387, copies=8)
@example(seed=479001598, copies=8)  # a pivot left 1e-16 of the most where nothing was to be supplied
@example(seed=268435456, copies=8)  # a change that had told what it brought was taken for one that brought nothing
@settings(max_examples=8)
def test_services_that_hang_on_each_other_lack_nothing_that_can_be_had(seed: int, copies: int) -> None:
    """Nothing lacks where there is room for more, nothing is supplied in vain, and a copy is what it is alone."""
    network = rings(seed)
    traders = [arc.id for arc in network.arcs if arc.control is not None and arc.control.kind is ControlKind.SHARE]
    env, lone = (MultiAgentVectorEnv(network, num_envs=n, agents=traders or ["mine_0"]) for n in (copies, 1))
    env.reset(seed=seed)
    lone.reset(seed=[seed + copies - 1])
    random, idle = np.random.default_rng(seed), slice(0 if traders else 1, None)
    for _ in range(network.episode.horizon):
        actions = random.uniform(-1, 1, (len(env.agents), copies))
        together = step(env, actions)
        np.testing.assert_array_equal(step(lone, actions[:, -1:]), together[:, :, -1:])
        amount, low, high, level = together[:, idle]
        assert ((amount >= high * (1 - 1e-12)) | (level > 1 - 5e-9)).all()
        assert ((amount <= low * (1 + 1e-12) + 1e-12) | (level < 1 + 5e-9)).all()


@pytest.mark.parametrize("side", [0.0, 1.0])
def test_round_off_at_the_ends_of_supplies_is_nothing(side: float, monkeypatch: pytest.MonkeyPatch) -> None:
    """Who is within it of nothing, or of the most, is there: no corrections run out, and nothing is told."""
    network = rings(479001598)
    traders = [arc.id for arc in network.arcs if arc.control is not None and arc.control.kind is ControlKind.SHARE]
    env = MultiAgentVectorEnv(network, num_envs=2, agents=traders or ["mine_0"])
    actions = np.zeros((len(env.agents), 2))
    env.reset(seed=1)
    expected = step(env, actions)

    def rounded(slope: Floats, shortage: Floats, now: Floats, most: Floats, interval: float) -> Floats:
        found, end = complementary(slope, shortage, now, most, interval), side * most
        return np.where(found == end, abs(end - 1e-15 * most), found)

    monkeypatch.setattr(supply, "complementary", rounded)
    env.reset(seed=1)
    np.testing.assert_allclose(step(env, actions), expected, rtol=1e-8)
    assert (expected[0] == expected[1 + int(side)]).any()


@given(seed=st.integers(0, 2**31))
@settings(max_examples=200)
def test_supplies_solve_every_linear_problem(seed: int) -> None:
    """By its definition: what lacks does so where supplies are at their most, what is too much where at their least."""
    rng = np.random.default_rng(seed)
    size, density = int(rng.integers(2, 9)), rng.uniform(0.3, 1.0)
    slope = rng.uniform(0, 1, (size, size)) * (rng.random((size, size)) < density) + 1e-3 * np.eye(size)
    slope *= 10.0 ** rng.uniform(-2, 2, (size, 1))
    most = rng.choice([0.0, 1.0, 10.0, 100.0], size)
    now = rng.uniform(0, 1, size) * most
    shortage = rng.normal(size=size) * slope.sum(axis=1) * 5
    found = complementary(slope[None], shortage[:, None], now[:, None], most[:, None], 1.0)[:, 0]
    assert ((found >= 0) & (found <= most)).all()
    lack, scale = shortage - slope @ (found - now), abs(shortage) + slope @ most
    assert (lack[found < most * (1 - 1e-12)] <= 1e-9 * scale[found < most * (1 - 1e-12)]).all()
    assert (lack[found > most * 1e-12] >= -1e-9 * scale[found > most * 1e-12]).all()


@pytest.mark.parametrize("seed", [303, 795, 1151, 2362, 3801, 3967, 4254, 10771, 25964, 28791])
def test_pivots_solve_problems_in_which_ratios_tie(seed: int) -> None:
    """Whole numbers make equal rows and ratios, and equations of which some follow from others."""
    rng = np.random.default_rng(seed)
    size = int(rng.integers(2, 9))
    if seed % 2:
        slope = rng.integers(0, 4, (size, size)) + np.eye(size) * rng.integers(0, 2)
    else:
        slope = rng.uniform(0, 1, (size, size)) * (rng.random((size, size)) < rng.uniform(0.3, 1))
        slope += 1e-3 * np.eye(size)
    np.fill_diagonal(slope, np.maximum(np.diag(slope), 1e-3))
    most = rng.choice([0.0, 1.0, 2.0, 10.0], size)
    now = rng.integers(0, 3, size) / 2 * most
    shortage = rng.integers(-4, 5, size) * (1.0 if seed % 2 else slope.sum(axis=1))
    found = _complementary_pivots(slope, shortage, now, most, np.ones(size, dtype=bool))
    lack = (shortage - slope @ (found - now)) / (np.abs(shortage) + slope @ most + 1e-9)
    assert ((found >= 0) & (found <= most)).all()
    assert (lack[found < most] < 1e-12).all() and (lack[found > 0] > -1e-12).all()


@pytest.mark.parametrize("interval", [0.01, 1.0, 7.0])
def test_supplies_of_which_too_little_arrives_stay(interval: float) -> None:
    """A thousand millionth of them at least, of a shorter interval as a part of that."""
    for part, is_more in ((3e-10, False), (3e-9, True)):
        slope = np.array([[[part * min(1.0, interval)]]])
        shortage, now, most = (np.array([[value]]) for value in (1.0, 2.0, 5.0))
        assert complementary(slope, shortage, now, most, interval)[0, 0] == (5.0 if is_more else 2.0)


def test_pivots_leave_what_is_supplied_where_it_does_not_arrive() -> None:
    """It still counts in what others lack."""
    slope, now, most = np.array([[2.0, 0.5, 1.0], [0.0, 0.0, 0.0], [0.5, 1.0, 1.0]]), np.full(3, 4.0), np.full(3, 10.0)
    shortage, arrives = np.array([3.0, 1.0, 1.0]), np.array([True, False, True])
    supply = _complementary_pivots(slope, shortage, now, most, arrives)
    lack = shortage - slope @ (supply - now)
    assert supply[1] == 4.0
    assert (lack[[0, 2]] <= 1e-12).all() and (lack[[0, 2]][supply[[0, 2]] > 0] >= -1e-12).all()


def test_sources_that_ran_out_are_no_cause_to_warn() -> None:
    """Though there is room for more, none of it would arrive; a warning would be an error here."""
    network = rings(118)
    nodes = tuple(replace(node, initial=(6.0, 30.0)) if node.id == "ore" else node for node in network.nodes)
    env = MultiAgentVectorEnv(replace(network, nodes=nodes), num_envs=4)
    env.idle = np.ones_like(env.idle)
    env.reset(seed=118)
    for _ in range(4):
        env.advance(np.zeros((len(env.agents), 4)))
    assert env.rows.stocks(env.physical.stock)[env.network.node_index["ore"]].min() < 1e-9


def test_where_corrections_run_out_a_warning_says_so_once(monkeypatch: pytest.MonkeyPatch) -> None:
    """It names the service, how much it is off, and what could make up for it."""
    monkeypatch.setattr(supply, "LEVELS", ((None, 0.0, 2),))
    env = MultiAgentVectorEnv(rings(1387), num_envs=8)
    env.idle = np.ones_like(env.idle)
    with pytest.warns(
        RuntimeWarning, match=r"network 'rings': service 's\d' is .* of its demand off in interval"
    ) as told:
        env.reset(seed=0)
        for _ in range(4):
            env.advance(np.zeros((len(env.agents), 8)))
    services = [str(warning.message).split("service ")[1].split(" ")[0] for warning in told]
    assert len(services) == len(set(services))
