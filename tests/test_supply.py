"""Business as usual: arcs that make up for what a service lacks while nobody acts on them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import random_network, with_substances
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from test_invariants import assert_batch_is_lone

from cirl_marl import (
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
    load_network,
)
from cirl_marl.controllers import Constant, Neutral
from cirl_marl.controllers.lint import lint_warnings
from cirl_marl.controllers.outcome import service_shortages
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.reader import write_network
from cirl_marl.dynamics import supply
from cirl_marl.dynamics.complementarity import complementary
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.network import Network
from cirl_marl.network.elements import Lifetime
from cirl_marl.optimum import bound, improve_plan, simulate_plan
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.constraints import idle_supplies
from cirl_marl.optimum.matrices import ProgramRows
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.reach import Reach

Floats = NDArray[np.floating]
EXAMPLE = Path(__file__).parent.parent / "examples" / "metal_cycle.toml"


def cycle(scenario: str | None = None, *, high: float = 400.0, **arc: Any) -> Network:
    """Return the example, in which mining makes up for what recycling does not deliver."""
    network = load_network(EXAMPLE).scenario(scenario)
    assert network.arcs[0].control is not None
    mining = replace(network.arcs[0], makes_up_for="supply", **arc)
    mining = replace(mining, control=Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=high))
    return replace(network, arcs=(mining, *network.arcs[1:]), scenarios={})


def demanded(network: Network) -> Floats:
    """Return the demand of each year."""
    return np.array(network.interval_means(network.services[0].low))


@pytest.mark.parametrize("scenario", ["default", "lifetimes"])
def test_supply_is_what_lacks(scenario: str) -> None:
    """Whatever the others do: the stock is the demand, unless nothing or all that can be had is supplied."""
    network = cycle(scenario)
    env, rng = MultiAgentVectorEnv(network, num_envs=3, agents=["old_scrap"]), np.random.default_rng(1)
    env.reset(seed=0, options={"initial_state": {"use": np.array([1050.0, 1100.0, 1150.0])}})
    met = np.zeros(3, dtype=int)
    for year, demand in enumerate(demanded(network)):
        env.advance(rng.uniform(-1, 1, (1, 3)))
        mined, use = env.controls[0], env.rows.stocks(env.physical.stock)[network.node_index["use"]]
        exact = (mined > 0) & (mined < 400.0)
        np.testing.assert_allclose(use[exact], demand, rtol=1e-9, err_msg=str(year))
        assert (use[mined == 0.0] >= demand * (1 - 1e-9)).all() and (mined < 400.0).all()
        met += exact
    assert (met > 15).all()


def test_the_first_flows_are_those_of_business_as_usual() -> None:
    """What is seen before anybody acts: nothing is mined unless something lacks."""
    network = cycle()
    env = MultiAgentVectorEnv(network, num_envs=2)
    env.reset(seed=0, options={"initial_state": {"use": np.array([900.0, 1150.0])}})
    first = env.physical.flow[0].copy()
    neutral = env.advance(env.stack(env.neutral_action)).flow[0]
    assert first[0] > 50.0 and first[1] == 0.0
    np.testing.assert_allclose(first, neutral, rtol=1e-6)


def test_a_chain_falls_short_as_far_as_its_bounds_say() -> None:
    """Then all that can be had is supplied, and the level of the service tells what lacks."""
    network = cycle(high=60.0)
    run = rollout(MultiAgentVectorEnv(network, num_envs=1, agents=["old_scrap"]), Neutral())
    mined = run.controls[:, 0]
    short = run.levels[0, 0] < 1.0 - 1e-3
    assert short.any() and (mined[short] == 60.0).all()
    stock = run.stock[:, network.node_index["use"]]
    np.testing.assert_allclose(run.levels[0, 0], np.minimum(1.0, stock / demanded(network)), rtol=1e-9)

    (said,) = service_shortages(run, network)
    first = int(np.argmax(short))
    assert f"'supply' falls to {run.levels.min():.4f}, short first at {first} year ({2020 + first})" in said
    assert "'smelting' 60 Mt/year" in said
    assert any(said in remark for remark in lint_warnings(network)) and not list(lint_warnings(cycle()))
    assert not list(service_shortages(rollout(MultiAgentVectorEnv(cycle(), num_envs=1), Neutral()), cycle()))


def test_an_agent_that_acts_overrides_it() -> None:
    """Its action is what it carries; neutral, it supplies what lacks beside what the others do."""
    network = cycle()
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    outcome = env.advance(np.array([[0.5], [0.0]]))
    assert outcome.flow[0, 0] == pytest.approx(300.0)
    for action in (-1.0, 0.3, 1.0):
        alone = rollout(MultiAgentVectorEnv(network, num_envs=1, agents=["old_scrap"]), Constant({"old_scrap": action}))
        beside = rollout(env, Constant({"old_scrap": action}))
        np.testing.assert_allclose(beside.flow, alone.flow, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("acting", [["old_scrap"], ["smelting", "old_scrap"]])
def test_counterfactuals_supply_anew(acting: list[str]) -> None:
    """The difference to a second network, in which the agent is neutral and mining makes up for what then lacks."""
    network = cycle()
    env = MultiAgentVectorEnv(network, num_envs=2, agents=acting, reward="difference")
    other = MultiAgentVectorEnv(network, num_envs=2, agents=acting, reward="circularity")
    for each in (env, other):
        each.reset(3, options={"initial_state": {"use": 1000.0}})
    rng = np.random.default_rng(0)
    for _ in range(8):
        actions, here = rng.uniform(-1, -0.8, (len(acting), 2)), env.snapshot()  # too little to need nothing more
        reward = env.advance(actions).reward
        for row, agent in enumerate(acting):
            other.restore(here)
            actual = other.advance(actions).reward[0]
            other.restore(here)
            given = {each: action for each, action in other.unstack(actions).items() if each != agent}
            imagined = other.advance(other.stack(other.neutral_beside(given))).reward[0]
            np.testing.assert_allclose(reward[row], actual - imagined, atol=1e-7)


DEMAND = Series(times=(0.0, 9.0), values=(52.0, 60.0), interpolation="linear")


def town(weights: tuple[float | None, float | None], high: tuple[float, float] = (99.0, 99.0)) -> Network:
    """Return two products from one market, whose makers are fed by two sources each."""
    control = [Control(kind=ControlKind.FLOW, low=1.0, neutral=1.0, high=most) for most in (*high, 50.0)]
    ore, ores = Role.NONRENEWABLE_RESERVOIR, ("ore_a", "ore_b", "ore_c")
    return Network(
        name="town",
        nodes=(
            *(Node(id=each, role=ore) for each in ores),
            Node(id="market", stores=False),
            Node(id="cars", lifetime=Lifetime(mean=8.0, deviation=3.0, distribution="weibull"), initial=(40.0, 60.0)),
            Node(id="homes", rate=0.05, initial=(80.0, 90.0)),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            *(
                Arc(id=f"mine_{c}", donor=f"ore_{c}", recipient="market", law=Law.CONTROLLED, control=control[i],
                    makes_up_for="driving", weight=weights[i])
                for i, c in enumerate("ab")
            ),
            Arc(id="import", donor="ore_c", recipient="homes", law=Law.CONTROLLED, control=control[2],
                makes_up_for="living"),
            Arc(id="to_cars", donor="market", recipient="cars", law=Law.SHARE, share=0.7),
            Arc(id="to_homes", donor="market", recipient="homes", law=Law.SHARE),
            Arc(id="old_cars", donor="cars", recipient="dump", law=Law.SHARE),
            Arc(id="old_homes", donor="homes", recipient="dump", law=Law.SHARE),
        ),
        services=(
            Service(id="driving", provider="cars", quantity="stock", low=DEMAND),
            Service(id="living", provider="homes", quantity="stock", low=88.0),
        ),
        episode=Episode(horizon=8),
        time_unit="year",
        mass_unit="Mt",
    )  # fmt: skip


def test_several_services_are_solved_together() -> None:
    """What is mined for cars builds homes, too, of which so much less is imported; sources keep their weights."""
    network = town((0.25, 0.75))
    run = rollout(MultiAgentVectorEnv(network, num_envs=2), Neutral())
    a, b, imported = run.controls.T
    np.testing.assert_allclose((a - 1.0) * 3, b - 1.0, rtol=1e-9)
    exact = (imported > 1.0) & (a > 1.0)
    assert exact.sum() >= 4
    homes, cars = (run.stock[:, network.node_index[each]] for each in ("homes", "cars"))
    np.testing.assert_allclose(homes[exact], 88.0, rtol=1e-9)
    np.testing.assert_allclose(cars[exact], np.array(network.interval_means(network.services[0].low))[exact], rtol=1e-9)


def workshops(seed: int, count: int, *, is_fast: bool = False) -> Network:
    """Return products with a maker each; makers pass to each other, get scrap back, and are fed by two sources.

    Fast products come back as scrap within the interval, which is of two years.
    """
    rng = np.random.default_rng(seed)
    nodes = [Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR), Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0))]
    arcs: list[Arc] = []
    services = []
    for i in range(count):
        nodes.append(Node(id=f"maker_{i}", stores=False))
        mean = float(rng.uniform(2.0, 20.0))
        lifetime = Lifetime(mean=mean, deviation=0.4 * mean, distribution="weibull")
        use = {"rate": float(rng.uniform(0.5, 3.0))} if is_fast else {"lifetime": lifetime}
        nodes.append(Node(id=f"product_{i}", initial=(80.0, 120.0), **use))
        services.append(
            Service(id=f"need_{i}", provider=f"product_{i}", quantity="stock", low=float(rng.uniform(70, 130)))
        )
        for n, weight in enumerate((0.9, 0.1)):
            high = float(rng.choice([1.0, 10.0, 200.0]))
            control = Control(kind=ControlKind.FLOW, low=float(rng.uniform(0, 1)), neutral=1.0, high=high)
            arcs.append(
                Arc(id=f"mine_{i}_{n}", donor="ore", recipient=f"maker_{i}", law=Law.CONTROLLED, control=control,
                    makes_up_for=f"need_{i}", weight=weight)
            )  # fmt: skip
        trade = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.1, high=0.3)
        scrap: dict[str, Any] = {"donor": f"product_{i}", "law": Law.SHARE}
        if count > 1:
            arcs.append(
                Arc(
                    id=f"trade_{i}",
                    donor=f"maker_{i}",
                    recipient=f"maker_{(i + 1) % count}",
                    law=Law.SHARE,
                    control=trade,
                )
            )
        arcs.append(Arc(id=f"make_{i}", donor=f"maker_{i}", recipient=f"product_{i}", law=Law.SHARE))
        arcs.append(Arc(id=f"scrap_{i}", recipient=f"maker_{rng.integers(count)}", share=0.6, **scrap))
        arcs.append(Arc(id=f"loss_{i}", recipient="dump", **scrap))
    return Network(
        name="workshops", nodes=tuple(nodes), arcs=tuple(arcs), services=tuple(services),
        episode=Episode(horizon=4, control_interval=1.0 + is_fast), time_unit="year",
    )  # fmt: skip


@given(seed=st.integers(0, 2**31), count=st.integers(1, 7), is_fast=st.booleans())
@example(seed=1, count=5, is_fast=True)  # what comes back at once is more than arrives
@example(seed=3, count=4, is_fast=True)
@example(seed=859, count=3, is_fast=False)  # what others supplied outweighed what a correction was expected to bring
@settings(max_examples=8)
def test_nothing_lacks_that_can_be_had_and_nothing_is_supplied_in_vain(seed: int, count: int, is_fast: bool) -> None:
    """What complementarity says, for random networks, whatever the agents do; and a copy is what it is alone."""
    network = workshops(seed, count, is_fast=is_fast)
    traders = [arc.id for arc in network.arcs if arc.id.startswith("trade")] or ["mine_0_1"]
    env, lone = (MultiAgentVectorEnv(network, num_envs=n, agents=traders) for n in (3, 1))
    env.reset(seed=[1, 2, 3])
    lone.reset(seed=[3])
    demand = np.array([network.interval_means(service.low) for service in network.services])
    supplies = [[env.network.control_rows[f"mine_{i}_{n}"].start for n in (0, 1)] for i in range(count)]
    for year in range(4):
        actions = np.random.default_rng(seed + year).uniform(-1, 1, (len(traders), 3))
        flow = env.advance(actions).flow
        np.testing.assert_array_equal(flow[:, 2:], lone.advance(actions[:, 2:]).flow)
        stock = env.rows.stocks(env.physical.stock)
        for i, (rows, service) in enumerate(zip(supplies, network.services, strict=True)):
            if traders == ["mine_0_1"]:
                continue
            low, high = (table[rows][:, :1] for table in (env.dynamics.control_low, env.dynamics.control_high))
            asked, level = env.controls[rows], stock[network.node_index[service.provider]] / demand[i, year]
            assert ((asked >= low) & (asked <= high)).all()
            extent = (asked - low) / np.array([[0.9], [0.1]])
            is_full = asked >= high * (1 - 1e-12)
            assert (is_full.all(axis=0) | (level > 1 - 1e-9)).all()
            assert ((asked <= low * (1 + 1e-12)).all(axis=0) | (level < 1 + 1e-9)).all()
            proportional = ~is_full.any(axis=0)
            np.testing.assert_allclose(extent[0, proportional], extent[1, proportional], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(("seed", "count", "is_fast"), [(1, 3, True), (4, 4, False), (7, 5, True)])
def test_supplies_within_their_bounds_meet_demand_to_ten_digits(seed: int, count: int, is_fast: bool) -> None:
    """One part in ten thousand million of it, not in a hundred million, where estimates end before that."""
    network = workshops(seed, count, is_fast=is_fast)
    traders = [arc.id for arc in network.arcs if arc.id.startswith("trade")]
    env, errors = MultiAgentVectorEnv(network, num_envs=6, agents=traders), []
    env.reset(seed=0)
    for year in range(4):
        env.advance(np.random.default_rng(seed + year).uniform(-1, 1, (len(traders), 6)))
        stock = env.rows.stocks(env.physical.stock)
        for i, service in enumerate(network.services):
            rows = [network.control_rows[f"mine_{i}_{n}"].start for n in (0, 1)]
            low, high = (table[rows, :1] for table in (env.dynamics.control_low, env.dynamics.control_high))
            is_between = ((env.controls[rows] > low * 1.000001) & (env.controls[rows] < high * 0.999999)).all(axis=0)
            demand = network.interval_means(service.low)[year]
            errors += np.abs(stock[network.node_index[service.provider], is_between] / demand - 1.0).tolist()
    assert len(errors) > 4
    assert max(errors) < 1.001e-10


def ring() -> Network:
    """Return five markets in a ring, of which three services are fed by supplies that soon come to their bounds."""
    fed = {"m0": "m1 0.197, p1", "m1": "m2 0.189, p0 0.385, dump", "m2": "m3 *, p1 0.115, p1", "m3": "m4 *, p1"}
    fed |= {"m4": "m0 0.083, p2 0.277, p2", "p0": "m4 0.679, dump", "p1": "m3 0.586, dump", "p2": "m2 0.047, dump"}
    arcs: list[Arc] = []
    for donor, ends in fed.items():
        for n, end in enumerate(ends.split(", ")):
            recipient, _, part = end.partition(" ")
            control = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.2, high=0.9) if part == "*" else None
            share = None if control or not part else float(part)
            id_ = f"{donor}_{n}"
            arcs.append(Arc(id=id_, donor=donor, recipient=recipient, law=Law.SHARE, share=share, control=control))
    several = [("m3", "s1", 0.095, 2000), ("m2", "s1", 0.022, 3), ("m0", "s1", 0.883, 2000)]
    mines = [("p0", "s0", None, 500), *several, ("m0", "s2", None, 30)]
    for n, (recipient, service, weight, high) in enumerate(mines):
        flow = Control(kind=ControlKind.FLOW, low=float(n in (1, 2)), neutral=1.0, high=float(high))
        made_up: dict[str, Any] = {"makes_up_for": service, "weight": weight}
        arcs.append(Arc(id=f"mine_{n}", donor="ore", recipient=recipient, law=Law.CONTROLLED, control=flow, **made_up))
    lives = (Lifetime(mean=mean, deviation=2.0, distribution="weibull") for mean in (3.6, 14.7))
    nodes = [Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR), Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0))]
    nodes += [Node(id=f"m{n}", stores=False) for n in range(5)]
    nodes += [Node(id=f"p{n}", initial=(50.0, 90.0), lifetime=life) for n, life in zip((0, 2), lives, strict=True)]
    nodes += [Node(id="p1", initial=(50.0, 90.0), rate=0.5)]
    services = (
        Service(id="s0", provider="p0", quantity="stock", low=80.9),
        Service(id="s1", provider="m2_1", quantity="flow", low=7.42),
        Service(id="s2", provider="m4", quantity="outflow", low=15.5),
    )
    episode = Episode(horizon=4, control_interval=2.0)
    return Network(
        name="ring", nodes=tuple(nodes), arcs=tuple(arcs), services=services, episode=episode, time_unit="year"
    )


def test_what_lacks_is_found_past_bends() -> None:
    """Where supplies come to their bounds one by one, nothing lacks and nothing is in vain: each has room to move."""
    network, copies = ring(), 64
    env = MultiAgentVectorEnv(network, num_envs=copies, agents=["m2_0", "m3_0"])
    env.reset(seed=0)
    idle = [n for n, arc in enumerate(network.arcs) if arc.makes_up_for]
    rows = [env.network.control_rows[network.arcs[n].id].start for n in idle]
    of = np.array([network.arcs[n].makes_up_for for n in idle])
    random, met = np.random.default_rng(0), 0
    for _ in range(4):
        flow = env.advance(random.uniform(-1, 1, (2, copies))).flow
        stock, name = env.rows.stocks(env.physical.stock), {arc.id: n for n, arc in enumerate(network.arcs)}
        measured = {
            "s0": stock[network.node_index["p0"]] / 80.9,
            "s1": flow[name["m2_1"]] / 7.42,
            "s2": sum(flow[name[f"m4_{n}"]] for n in range(3)) / 15.5,
        }
        for service, level in measured.items():
            mine = np.array(rows)[of == service]
            low, high = (table[mine, :1] for table in (env.dynamics.control_low, env.dynamics.control_high))
            assert ((env.controls[mine] >= low) & (env.controls[mine] <= high)).all()
            is_most = (env.controls[mine] >= high * (1 - 1e-12)).all(axis=0)
            is_least = (env.controls[mine] <= low + 1e-12).all(axis=0)
            assert (is_most | (level > 1 - 1e-9)).all()
            assert (is_least | (level < 1 + 1e-9)).all()
            met += int((~is_most & ~is_least).sum())
    assert met > copies


@pytest.mark.medium
def test_supplies_cost_few_intervals(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two estimates, by two and by eight terms, and the interval itself are the usual year of steel in Japan."""
    env = MultiAgentVectorEnv("steel_japan", num_envs=2)
    advance, estimate, terms = env.dynamics.advance, env.dynamics.estimate, list[int]()

    def advance_counted(*args: Any) -> Any:
        terms.append(env.dynamics.terms)
        return advance(*args)

    def estimate_counted(*args: Any, **options: Any) -> Any:
        terms.append(options["terms"])
        return estimate(*args, **options)

    env.reset(seed=0)
    monkeypatch.setattr(env.dynamics, "advance", advance_counted)
    monkeypatch.setattr(env.dynamics, "estimate", estimate_counted)
    rng = np.random.default_rng(0)
    for _ in range(20):
        env.advance(rng.uniform(-1, 1, (len(env.agents), 2)))
    assert terms.count(env.dynamics.terms) == 20
    assert len(terms) == 3 * 20


@pytest.mark.parametrize(
    ("make", "most"),
    [
        (lambda: workshops(17, 4, is_fast=True), 12),  # what other numbers of terms change teaches nothing
        (lambda: workshops(1, 4, is_fast=True), 40),  # by secants
        (lambda: reserve(12.0, 50.0), 6),  # of which nothing is left, so that no correction changes anything
    ],
)
def test_corrections_learn_from_those_before_them(
    make: Callable[[], Network], most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So few intervals are simulated in full in an episode."""
    env, counts = MultiAgentVectorEnv(make(), num_envs=4), list[int]()
    advance = env.dynamics.advance

    def advance_counted(*args: Any) -> Any:
        counts.append(1)
        return advance(*args)

    env.idle = np.ones_like(env.idle)
    env.reset(seed=1)
    monkeypatch.setattr(env.dynamics, "advance", advance_counted)
    for _ in range(env.network.episode.horizon):
        env.advance(np.zeros((len(env.agents), 4)))
    assert len(counts) <= most


def test_a_copy_that_an_estimate_satisfies_is_as_a_lone_one() -> None:
    """It waits for others of the batch, and what its last correction was to bring tells how the next one will do."""
    batch, lone = (MultiAgentVectorEnv(workshops(147, 1), num_envs=count) for count in (6, 1))
    for env, seeds in ((batch, [*range(6)]), (lone, [5])):
        env.idle = np.ones_like(env.idle)
        env.reset(seed=seeds)
    for _ in range(2):
        flow = batch.advance(np.zeros((len(batch.agents), 6))).flow[:, 5:]
        np.testing.assert_array_equal(flow, lone.advance(np.zeros((len(lone.agents), 1))).flow)


@given(seed=st.integers(0, 2**31), lifetimes=st.booleans(), substances=st.booleans())
@settings(max_examples=25)
def test_estimates_of_stocks_are_what_all_terms_come_to(seed: int, lifetimes: bool, substances: bool) -> None:
    """With every term an estimate is the interval; with few it is what the flows of as many terms leave."""
    network = random_network(seed, 6, 14, lifetimes=lifetimes)
    network = with_substances(network, seed, batches=True) if substances else network
    env = MultiAgentVectorEnv(network, num_envs=3)
    env.reset(seed=seed)
    state = env.physical
    done = env.dynamics.advance(state.stock, state.inner, env.dynamics.neutral_in(state.step), state.step)
    near = partial(np.testing.assert_allclose, rtol=0, atol=1e-12 * done.stock.max())
    stocks, moved_mass = estimate(env, env.dynamics.terms, flows=False)
    near(stocks, done.stock)
    assert env.dynamics.taylor is not None
    assert (moved_mass is None) is not (env.dynamics.taylor.pulls or len(env.dynamics.batches.lines) > 0)
    near(estimate(env, env.dynamics.terms, flows=True)[1], done.moved_mass)


def estimate(env: MultiAgentVectorEnv, terms: int, *, flows: bool) -> tuple[Floats, Floats | None]:
    """Return what the next interval is estimated to do."""
    dynamics, state = env.dynamics, env.physical
    controls = dynamics.neutral_in(state.step)
    rate = dynamics.rate(controls, state.step)
    routes = dynamics.routing.routes(rate)
    inputs = state.stock, state.inner, controls, state.step, None, routes, rate
    return dynamics.estimate(*inputs, terms=terms, flows=flows)


@pytest.mark.parametrize("terms", [2, 6])
def test_few_terms_leave_what_their_flows_leave(terms: int) -> None:
    """Where they overdraw no stock; elsewhere it is empty."""
    env = MultiAgentVectorEnv("steel_japan", num_envs=2)
    env.reset(seed=0)
    np.testing.assert_allclose(estimate(env, terms, flows=False)[0], estimate(env, terms, flows=True)[0], rtol=1e-12)
    env = MultiAgentVectorEnv(with_substances(random_network(8080, 6, 14), 8080), num_envs=3)
    env.reset(seed=8080)
    assert estimate(env, terms, flows=False)[0].min() >= 0.0


@pytest.mark.parametrize("name", ["steel_japan", pytest.param("steel_world", marks=pytest.mark.slow)])
def test_estimates_leave_flows_within_1e_9(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of those of supplies that are corrected in full until nothing lacks to thirteen digits."""
    env = MultiAgentVectorEnv(name, num_envs=2)
    years = [np.random.default_rng(year).uniform(-1, 1, (len(env.agents), 2)) for year in range(5)]

    def flows() -> Floats:
        env.reset(seed=0)
        return np.array([env.advance(actions).flow.copy() for actions in years])

    estimated = flows()
    monkeypatch.setattr(supply, "CLOSE", 1e-13)
    monkeypatch.setattr(supply, "LEVELS", supply.LEVELS[-1:])
    exact = flows()
    np.testing.assert_allclose(estimated, exact, rtol=0, atol=1e-9 * exact.max())


def reserve(stock: float, most: float, demand: float = 47.0, export: float = 0.0) -> Network:
    """Return a product made from a reserve that may not last."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=most)
    return Network(
        name="reserve",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR, initial=(stock, stock)),
            Node(id="use", rate=0.1, initial=(50.0, 50.0)),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="mine", donor="ore", recipient="use", law=Law.CONTROLLED, control=control, makes_up_for="need"),
            Arc(id="export", donor="ore", recipient="dump", law=Law.EXOGENOUS, flow=export),
            Arc(id="old", donor="use", recipient="dump", law=Law.SHARE),
        ),
        services=(Service(id="need", provider="use", quantity="stock", low=demand),),
        episode=Episode(horizon=6),
    )


def twins(demand: tuple[float, float], most: tuple[float, float], rate: float) -> Network:
    """Return two products, each with a mine and a demand of its own."""
    nodes, arcs = list[Node](), list[Arc]()
    for i, high in enumerate(most):
        nodes.append(Node(id=f"use_{i}", rate=rate, initial=(20.0, 90.0)))
        arcs.append(Arc(id=f"old_{i}", donor=f"use_{i}", recipient="dump", law=Law.SHARE))
        control = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=high)
        made_up: dict[str, Any] = {"control": control, "makes_up_for": f"need_{i}"}
        arcs.append(Arc(id=f"mine_{i}", donor="ore", recipient=f"use_{i}", law=Law.CONTROLLED, **made_up))
    ends = (Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR), Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)))
    services = tuple(
        Service(id=f"need_{i}", provider=f"use_{i}", quantity="stock", low=low, high=99.0)
        for i, low in enumerate(demand)
    )
    return Network(name="twins", nodes=(*nodes, *ends), arcs=tuple(arcs), services=services, episode=Episode(horizon=2))


def test_a_source_that_two_services_empty_is_no_cause_to_warn() -> None:
    """Corrections run out with room left where none of it would arrive; a warning would be an error here."""
    network = twins((51.0, 73.0), (50.0, 1e4), 0.1)
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.idle = np.ones_like(env.idle)
    env.reset(seed=0, options={"initial_state": {"use_0": 28.0, "use_1": 24.0, "ore": 61.0}})
    env.advance(np.zeros((len(env.agents), 1)))
    assert env.rows.stocks(env.physical.stock)[network.node_index["ore"]] < 1e-9


def test_what_nothing_is_demanded_of_is_not_supplied_in_vain(monkeypatch: pytest.MonkeyPatch) -> None:
    """Corrections that supply it by mistake are themselves corrected, though nothing else lacks then."""
    env, solve, calls = MultiAgentVectorEnv(twins((0.0, 47.0), (1e4, 1e4), 0.1), num_envs=1), complementary, list[int]()
    env.reset(seed=0, options={"initial_state": {"use_0": 50.0, "use_1": 50.0}})

    def mistaken(*args: Any) -> Floats:
        calls.append(1)
        supplied: Floats = solve(*args) + np.array([[5.0 * (len(calls) <= 2)], [0.0]])
        return supplied

    monkeypatch.setattr(supply, "complementary", mistaken)
    monkeypatch.setattr(supply, "LEVELS", supply.LEVELS[-1:])
    state = env.physical
    supplied = env.supply(state.stock, state.inner, env.controls * 0.0, state.step, np.ones((2, 1), dtype=bool))
    assert supplied[0, 0] == 0.0
    assert supplied[1, 0] > 1.0


def test_a_copy_that_is_done_keeps_what_it_lacked() -> None:
    """As a lone one does, also where it came to a bound then while another copy had yet to be corrected."""
    network, starts = twins((50.0, 50.0), (0.5, 99.0), 0.01), np.exp(0.01) * np.array([[49.25, 20.0], [49.95, 40.0]])

    def advanced(copies: slice) -> Floats:
        stocks = {f"use_{i}": stock[copies] for i, stock in enumerate(starts)}
        env = MultiAgentVectorEnv(network, num_envs=len(stocks["use_0"]))
        env.reset(seed=0, options={"initial_state": stocks})
        state, idle = env.physical, np.ones((2, 1), dtype=bool)
        return env.supply.advance(state.stock, state.inner, env.controls * 0.0, state.step, idle)[1].stock

    together = advanced(slice(None))
    np.testing.assert_array_equal(together[:, :1], advanced(slice(1)))
    np.testing.assert_array_equal(together[:, 1:], advanced(slice(1, None)))


def test_what_a_correction_brought_tells_how_the_next_one_does(monkeypatch: pytest.MonkeyPatch) -> None:
    """A twentieth of what is supplied has left the product again at the end; one interval in full is enough."""
    env = MultiAgentVectorEnv(reserve(1e6, 1e4), num_envs=1)
    env.reset(seed=0)
    advance, intervals = env.dynamics.advance, list[int]()

    def advance_counted(*args: Any) -> Any:
        intervals.append(1)
        return advance(*args)

    monkeypatch.setattr(env.dynamics, "advance", advance_counted)
    state, idle = env.physical, np.ones((1, 1), dtype=bool)
    done = env.supply.advance(state.stock, state.inner, env.controls, state.step, idle)[1]
    np.testing.assert_allclose(env.rows.stocks(done.stock)[1], 47.0, rtol=1e-9)
    assert len(intervals) == 1


@pytest.mark.parametrize("most", [50.0, 1e4, 1e7])
@pytest.mark.parametrize(("stock", "export"), [(12.0, 0.0), (1000.0, 0.0), (120.0, 10.0)])
def test_a_small_reserve_gives_no_more_than_is_needed(stock: float, export: float, most: float) -> None:
    """However wide the bounds of the control; when it is used up the service falls short."""
    run = rollout(MultiAgentVectorEnv(reserve(stock, most, export=export), num_envs=1), Neutral())
    use, left = run.stock[:, 1], run.stock[:, 0]
    enough = left > 1e-6
    np.testing.assert_allclose(use[enough], 47.0, rtol=1e-9)
    assert enough[0] and (use <= 47.0 * (1 + 1e-9)).all()
    assert enough.all() == (stock >= 1000.0 or export > 0)


@pytest.mark.parametrize("high", [(3.0, 99.0), (0.5, 99.0)])
def test_where_one_is_at_its_bound_others_supply_more(high: tuple[float, float]) -> None:
    """Of arcs that share a service; and of services, one that cannot be met leaves the others as they should be."""
    network = town((0.5, 0.5), high=(1.0 + high[0], high[1]))
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral())
    cars = run.stock[:, network.node_index["cars"]]
    wanted = np.array(network.interval_means(network.services[0].low))
    np.testing.assert_allclose(cars, np.maximum(cars, wanted), rtol=1e-9)
    assert (run.controls[:, 0] == 1.0 + high[0]).any()
    arcs = tuple(
        replace(arc, control=Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=0.5))
        if arc.id == "import"
        else arc
        for arc in network.arcs
    )
    short = replace(network, arcs=arcs, services=(network.services[0], replace(network.services[1], low=120.0)))
    run = rollout(MultiAgentVectorEnv(short, num_envs=1), Neutral())
    assert run.levels[0, 1].max() < 1.0 and (run.controls[:, 2] == 0.5).all()
    np.testing.assert_allclose(run.stock[:, network.node_index["cars"]], wanted, rtol=1e-9)


def test_services_that_hang_together_are_all_met() -> None:
    """Two sources of one market, one for each product: as much as the product needs that lacks more."""
    network = town((0.25, 0.75))
    homes = {"weight": None, "makes_up_for": "living"}
    changed: dict[str, dict[str, Any]] = {"mine_a": {"weight": None}, "mine_b": homes}
    arcs = [replace(arc, **changed.get(arc.id, {})) for arc in network.arcs if arc.id != "import"]
    run = rollout(MultiAgentVectorEnv(replace(network, arcs=tuple(arcs)), num_envs=1), Neutral())
    wanted = np.array([network.interval_means(service.low) for service in network.services])
    stock = run.stock[:, [network.node_index[each] for each in ("cars", "homes")]].T
    lowest = (stock / wanted).min(axis=0)
    np.testing.assert_allclose(lowest[run.controls[:, :2].max(axis=1) > 1.0], 1.0, rtol=1e-6)
    assert (lowest > 1 - 1e-6).all()


@pytest.mark.parametrize("network", [cycle("lifetimes"), town((0.25, 0.75))])
def test_copies_are_lone_environments(network: Network) -> None:
    """To the bit."""
    assert_batch_is_lone(replace(network, default_agents=network.agents[-1:]), 7, "local")


@pytest.mark.slow
def test_bounds_allow_all_that_may_be_supplied() -> None:
    """An idle supply may be any amount in the program; its plan is carried out with what is supplied then."""
    network = replace(cycle("lifetimes"), default_agents=("old_scrap",))
    found = bound(network, min_service=0.999)
    assert str(found).endswith("smelting may supply more or less in it than in the simulator")
    assert "may supply" not in str(bound(cycle(), min_service=0.9, horizon=3))
    run = simulate_plan(improve_plan(found))
    assert float(run.episode_circularity[0]) <= found.objective
    neutral = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral())
    assert float(run.episode_circularity[0]) > float(neutral.episode_circularity[0])
    assert run.episode_levels[0].min() > 0.999 - 1e-6


@given(
    weight=st.sampled_from([0.0, 0.25, 0.5]),
    high=st.tuples(st.sampled_from([1.5, 2.5, 99.0]), st.sampled_from([1.5, 4.0, 99.0])),
    ore=st.sampled_from([3.0, 1e6]),
    merged=st.booleans(),
    seed=st.integers(0, 99),
)
def test_supplies_keep_the_proportions_that_the_program_knows(
    weight: float, high: tuple[float, float], ore: float, merged: bool, seed: int
) -> None:
    """Its rows hold for what is simulated, at bounds and with a source that runs empty; they leave nothing else open.

    Flows are means over the interval, which satisfy rows that are the same in each of its pieces.
    """
    network = replace(town((weight, 1 - weight), high), default_agents=("import",))
    nodes = tuple(replace(node, initial=(ore, ore)) if node.id == "ore_a" else node for node in network.nodes)
    network = replace(network, nodes=nodes)
    programs = Programs(Admissible.of(network, ("import",)), 2, None, merge_pieces=merged)
    layout, planned, steps = programs.layout, programs.admissible.network, network.episode.horizon
    mines = [planned.arc_index[each] for each in ("mine_a", "mine_b")]
    uncut = np.ones((steps, len(planned.arcs)), dtype=bool)
    uncut[:, mines[0]] = ore > 1e3
    reached = Reach(np.zeros((steps, len(planned.nodes))), 1.0 * uncut, np.zeros(steps), 0.0 * uncut)
    written = ProgramRows(layout, steps)
    idle_supplies(programs.admissible, reached, range(steps), written)
    rows, limits = written.matrices()[0], written.limits()
    played = np.random.default_rng(seed).uniform(-1, 1, (steps, 1, 1))
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed)
    values = np.zeros((steps, layout.size))
    starts = layout.flow.tolist()
    starts += layout.end_flow.tolist() if layout.has_end_flows else []
    for t in range(steps):
        flow = env.advance(played[t]).flow[:, 0]
        for start in starts:
            values[t, [start + k for k in mines]] = flow[:2]
    left = limits - rows @ values.ravel()
    assert rows.shape[0] == 2 * 2 * steps * (layout.pieces * (2 if layout.has_end_flows else 1))
    assert left.min() > -1e-9
    if ore > 1e3 and min(high) == 99.0:  # the chord is the tangent if both come to their bounds together
        sides = slice(1) if weight == 0.25 else slice(2)
        np.testing.assert_allclose(left.reshape(-1, 2)[:, sides], 0.0, atol=1e-9)


def test_no_bound_chooses_among_sources_that_nobody_chooses_among() -> None:
    """One source counts in λ, one does not: both are drawn on alike in the plan of the bound, as in the simulator."""
    network = replace(town((0.5, 0.5)), default_agents=("import",))
    nodes = tuple(replace(node, role=Role.ENVIRONMENT) if node.id == "ore_b" else node for node in network.nodes)
    network = replace(network, nodes=nodes)
    found = bound(network, min_service=0.999)
    mined = found.flow[:, :2] - 1.0
    np.testing.assert_allclose(mined[:, 0], mined[:, 1], atol=1e-6)
    assert mined.max() > 0.5


def test_demand_is_what_each_needs_times_how_many_there_are(tmp_path: Path) -> None:
    """A stock per head, or anything else, may be multiplied by a series, inline or in a file; so are the units."""
    text = EXAMPLE.read_text().replace("metal_cycle.csv", "people.csv")
    people = EXAMPLE.with_suffix(".csv").read_text().splitlines()
    heads_of = ("people", "7.8e9", "8.5e9", "9.2e9", "9.8e9")
    rows = [f"{line},{heads}" for line, heads in zip(people, heads_of, strict=True)]
    (tmp_path / "people.csv").write_text("\n".join(rows) + "\n")
    old = text[text.index("low = { times = [2020, 2050], values = [1000, 1800]") :].partition("\n")[0]
    by = '{ file = "people.csv", column = "people", interpolation = "linear", unit = "1", source = "a census" }'
    each = 'times = [2020, 2050], values = [128, 184], interpolation = "linear", unit = "kg", source = "made up"'
    path = tmp_path / "metal_cycle.toml"
    path.write_text(text.replace(old, f"low = {{ {each}, multiplied_by = {by} }}"))
    network = load_network(str(path))
    time = np.linspace(0, 30, 300_001)
    middle = (time[:-1] + time[1:]) / 2
    heads = np.interp(middle, [0, 10, 20, 31], [7.8, 8.5, 9.2, 9.8])
    wanted = (heads * np.interp(middle, [0, 30], [128.0, 184.0])).reshape(30, -1).mean(axis=1)
    np.testing.assert_allclose(demanded(network), wanted, rtol=1e-6)
    write_network(network, tmp_path / "again.toml")
    assert load_network(str(tmp_path / "again.toml")).services == network.services
    for wrong, said in (
        (by.replace('"1"', '"kg"'), r"services.supply.low: unit '\(kg\)\*\(kg\)' is inconsistent"),
        ("{ times = [2020], values = [-1], unit = '1', source = 'x' }", r"multiplied_by: series: -1 is negative"),
        ("{ times = [2030], values = [1], unit = '1', source = 'x' }", r"multiplied_by: series begins at 10 \(2030\)"),
    ):
        path.write_text(text.replace(old, f"low = {{ {each}, multiplied_by = {wrong} }}"))
        with pytest.raises(NetworkError, match=said):
            load_network(str(path))


def test_files_hold_it(tmp_path: Path) -> None:
    """And read back the same."""
    network = town((0.25, 0.75))
    write_network(network, tmp_path / "town.toml")
    assert load_network(str(tmp_path / "town.toml")).arcs == network.arcs


@pytest.mark.parametrize(
    ("weights", "changed", "said"),
    [
        ((None, 0.5), {}, r"service 'driving': mine_a, mine_b make up for it; each needs a weight"),
        ((0.5, 0.7), {}, r"the weights of mine_a, mine_b, which make up for it, sum to 1.2, not to 1"),
        ((0.25, 0.75), {"import": {"makes_up_for": "livin"}}, r"unknown service 'livin'. Did you mean 'living'"),
        ((0.25, 0.75), {"import": {"makes_up_for": "", "weight": 0.5}}, r"weight: it makes up for no service"),
        ((0.25, 0.75), {"import": {"recipient": "dump"}}, r"'import': makes_up_for 'living': .*'homes' at once"),
        ((0.25, 0.75), {"to_homes": {"makes_up_for": "living"}}, r"'to_homes': makes_up_for needs law 'controlled'"),
    ],
)  # fmt: skip
def test_what_cannot_make_up_is_refused(
    weights: tuple[float | None, float | None], changed: dict[str, dict[str, Any]], said: str
) -> None:
    """With the arc or service, the value, and what to do."""
    with pytest.raises(NetworkError, match=said):
        network = town(weights)
        arcs = tuple(replace(arc, **changed.get(arc.id, {})) for arc in network.arcs)
        replace(network, arcs=arcs)


@pytest.mark.parametrize("name", ["solids_net", "net_zero", "paper_city", "cycle"])
def test_blocks_of_copies_are_the_whole(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Copies that do not fit a cache together go through an interval block by block, to the same bits."""

    def episode() -> tuple[Floats, ...]:
        env = MultiAgentVectorEnv(cycle() if name == "cycle" else load_network(name), num_envs=5)
        rng, arrays = np.random.default_rng(2), list[Floats]()
        env.reset(seed=1)
        entries = len(env.actuators.control_rows)
        for _ in range(4):
            env.advance(rng.uniform(-1, 1, (entries, 5)))
            physical = env.physical
            arrays += [physical.stock, physical.inner, physical.flow, physical.batched]
        return tuple(arrays)

    whole, shapes = episode(), list[int]()
    advance = Dynamics.advance

    def seen(self: Dynamics, stock: Any, *others: Any) -> Any:
        shapes.append(stock.shape[1])
        return advance(self, stock, *others)

    monkeypatch.setattr(Dynamics, "advance", seen)
    monkeypatch.setattr(supply, "CELLS", 1)
    for parts, array in zip(episode(), whole, strict=True):
        np.testing.assert_array_equal(parts, array)
    assert set(shapes) == {1}
