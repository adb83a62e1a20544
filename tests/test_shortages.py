"""A stock that idle arcs make up for falls short only while these supply the most that they can."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from conftest import with_substances
from numpy.typing import NDArray
from scipy import optimize

from benchmarks.yearly import Family, yearly_network
from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Role,
    Service,
    Substance,
    bound,
)
from cirl_marl.dynamics.supply import NOTABLE
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.substances import follows_contents
from cirl_marl.optimum import simulate_plan
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.matrices import ProgramRows
from cirl_marl.optimum.options import starting_stocks
from cirl_marl.optimum.program import Programs, possible_range
from cirl_marl.optimum.shortages import _least_sum, shortage_rows

Floats = NDArray[np.float64]
YEARS, LIFE, DEMAND, START = 12, 8.0, 100.0, 110.0
SUPPLIED = Family(years=(4, 12), regions=(1, 1), products=(1, 4), lifetimes=(0, 4), supplied=1.0, idle=1.0)


def flow(high: float, low: float = 0.0) -> Control:
    """Return the control of a flow."""
    return Control(kind=ControlKind.FLOW, low=low, neutral=low, high=high)


def village(high: float = 9.0, ore: float = 1e6, use: dict[str, Any] | None = None, low: float = 0.0) -> Network:
    """Return homes that a quarry makes up for; somebody may bring more from a pit."""
    use = {"rate": 1.0 / LIFE} if use is None else use
    nodes = (
        Node(id="quarry", role=Role.NONRENEWABLE_RESERVOIR, initial=(ore, ore)),
        Node(id="pit", role=Role.NONRENEWABLE_RESERVOIR, initial=(1e6, 1e6)),
        Node(id="homes", initial=(START, START), **use),
        Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
    )
    supply: dict[str, Any] = {"law": Law.CONTROLLED, "control": flow(high, low), "makes_up_for": "living"}
    arcs = (
        Arc(id="supply", donor="quarry", recipient="homes", **supply),
        Arc(id="bring", donor="pit", recipient="homes", law=Law.CONTROLLED, control=flow(80.0)),
        Arc(id="waste", donor="homes", recipient="dump", law=Law.SHARE),
    )
    return Network(
        name="village",
        nodes=nodes,
        arcs=arcs,
        services=(Service(id="living", provider="homes", quantity="stock", low=DEMAND),),
        episode=Episode(control_interval=1.0, horizon=YEARS),
        default_agents=("bring",),
    )


def rows_of(network: Network, *, merged: bool | None = None) -> tuple[Programs, Any, Floats]:
    """Return the programs of a network, and the rows with their limits."""
    admissible = Admissible.of(network)
    programs = Programs(admissible, 2, None, merge_pieces=merged)
    start, intervals = starting_stocks(admissible.lifetimes, None), range(network.episode.horizon)
    reach = possible_range(admissible.lifetimes, programs.system, start, intervals)[0]
    rows = ProgramRows(programs.layout, len(intervals))
    shortage_rows(admissible, programs.system, reach, start, intervals, rows)
    return programs, rows.matrices()[0], rows.limits()


def room(network: Network, actions: Floats) -> Floats:
    """Return what the rows leave open in episodes of some actions, shape (rows, copies); (steps, entries, copies)."""
    programs, matrix, limits = rows_of(network)
    layout, plan_network = programs.layout, programs.admissible.network
    env = MultiAgentVectorEnv(network, num_envs=actions.shape[2])
    env.reset(seed=0)
    values = np.zeros((len(actions), layout.size, actions.shape[2]))
    for value, action in zip(values, actions, strict=True):
        env.advance(action)
        stocks = env.rows.stocks(env.physical.stock), env.rows.substances(env.physical.stock)
        for store, parts in zip(network.stores, by_component(network, *stocks), strict=True):
            for name, mass in zip(plan_network.components_of(store.id), parts, strict=False):
                value[layout.end[-1] + plan_network.node_index[name]] = mass
        for arc, parts in zip(
            network.arcs, by_component(network, env.physical.flow, env.physical.substances), strict=True
        ):
            for name, flow_of_part in zip(plan_network.components_of(arc.id), parts, strict=False):
                value[layout.flow + plan_network.arc_index[name]] = flow_of_part
    left: Floats = limits[:, None] - matrix @ values.reshape(-1, actions.shape[2])
    return left


def by_component(network: Network, whole: Floats, substances: Floats) -> Floats:
    """Return what programs have of stocks or flows: what is no substance, then each, shape (…, components, copies)."""
    if not follows_contents(network):
        return whole[:, None]
    parts = substances.reshape(len(network.substances), *whole.shape)
    return np.concatenate([(whole - parts.sum(axis=0))[None], parts]).swapaxes(0, 1)


def town(high: float = 40.0, *, sorts: bool = False, copper: float = 0.2, life: float = LIFE) -> Network:
    """Return homes and sheds that are built by a market, which loses more of copper; somebody may bring more."""
    dies = Lifetime(mean=life, deviation=0.3 * life, distribution="normal")
    substances = (Substance(id="copper"),) if copper else ()
    content = {"copper": copper} if copper else {}
    sorter = Control(kind=ControlKind.TRANSFER, low=0.1, neutral=0.3, high=0.5, substances=("copper",))
    losses: dict[str, Any] = {"control": sorter} if sorts else {"transfer": {"copper": 0.3} if copper else {}}
    supply: dict[str, Any] = {"law": Law.CONTROLLED, "control": flow(high), "makes_up_for": "living"}
    return Network(
        name="town",
        nodes=(
            Node(id="quarry", role=Role.NONRENEWABLE_RESERVOIR, initial=(1e6, 1e6), content=content),
            Node(id="pit", role=Role.NONRENEWABLE_RESERVOIR, initial=(1e6, 1e6)),
            Node(id="market", stores=False),
            Node(id="homes", initial=(80.0, 80.0), lifetime=dies, content=content),
            Node(id="sheds", initial=(30.0, 30.0), lifetime=replace(dies, mean=0.6 * life)),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="supply", donor="quarry", recipient="market", **supply),
            Arc(id="bring", donor="pit", recipient="market", law=Law.CONTROLLED, control=flow(80.0)),
            Arc(id="homing", donor="market", recipient="homes", law=Law.SHARE, share=0.6),
            Arc(id="losing", donor="market", recipient="dump", law=Law.SHARE, share=0.1, **losses),
            Arc(id="shedding", donor="market", recipient="sheds", law=Law.SHARE),
            Arc(id="razing", donor="homes", recipient="dump", law=Law.SHARE),
            Arc(id="clearing", donor="sheds", recipient="dump", law=Law.SHARE),
        ),
        services=(Service(id="living", provider="homes", also=("sheds",), quantity="stock", low=DEMAND),),
        substances=substances,
        episode=Episode(control_interval=1.0, horizon=YEARS),
        default_agents=("bring", "losing") if sorts else ("bring",),
    )


def largest_shortages(network: Network) -> Floats:
    """Return L of each interval, read off what the rows have of a supply."""
    programs, matrix, _ = rows_of(network)
    layout, k = programs.layout, programs.admissible.network.arc_index["supply"]
    table = matrix.toarray().reshape(YEARS, YEARS, layout.size)[np.arange(YEARS), np.arange(YEARS)]
    high = network.compartments["supply"].control
    assert high is not None
    slopes: Floats = -table[:, layout.flow + k].sum(axis=1) * float(high.high - high.low)  # type: ignore[operator]
    return slopes


def starved(high: float) -> Floats:
    """Return what homes lack at the end of each year if nobody brings anything, by the closed form."""
    stock, lacks = START, np.zeros(YEARS)
    for year in range(YEARS):
        stock = stock * np.exp(-1 / LIFE) + high * LIFE * (1 - np.exp(-1 / LIFE))
        lacks[year] = max(0.0, DEMAND - stock)
        stock = min(stock, DEMAND)
    return lacks


@pytest.mark.parametrize("high", [4.0, 11.0, 40.0])
def test_a_stock_lacks_no_more_than_where_it_is_starved(high: float) -> None:
    """L is what lacks in the simulator if nobody brings anything, and the row is met with what is tolerated."""
    network = village(high, low=1.0)
    np.testing.assert_allclose(largest_shortages(network), starved(high), atol=1e-6)
    left = room(network, np.full((YEARS, 1, 1), -1.0)).ravel()
    # of what is supplied by need more may be left open
    is_starved = starved(high) > 0
    tolerated = NOTABLE * (DEMAND + starved(high))
    np.testing.assert_allclose(left[is_starved], tolerated[is_starved], rtol=1e-2)
    assert left.min() > 0


def test_an_exponential_lifetime_lacks_what_a_rate_lacks() -> None:
    """It is a stock that leaves in proportion to itself."""
    use = {"lifetime": Lifetime(mean=LIFE, distribution="exponential")}
    np.testing.assert_allclose(largest_shortages(village(9.0, use=use)), starved(9.0), atol=1e-9 * DEMAND)


@pytest.mark.parametrize("distribution", ["normal", "weibull", "lognormal"])
@pytest.mark.sample(1)
def test_a_flood_that_dies_out_at_once_is_allowed_for(distribution: str) -> None:
    """Much that comes in one year dies together; what then lacks is below L, and more than without the flood."""
    use = {"lifetime": Lifetime(mean=LIFE, deviation=0.25 * LIFE, distribution=distribution)}
    network = village(10.0, use=use)
    floods = np.full((YEARS, 1, YEARS), -1.0)
    floods[np.arange(YEARS), 0, np.arange(YEARS)] = 1.0
    left = room(network, floods)
    assert left.min() > 0
    # where what is tolerated is all that is left, q = D
    assert (left < 1.01 * NOTABLE * DEMAND * 2).any()
    assert largest_shortages(network)[0] == pytest.approx(max(0.0, DEMAND - _first_year(network)), abs=1e-2)
    assert largest_shortages(network).max() > 0


def _first_year(network: Network) -> float:
    """Return the stock after a year in which all that can be is supplied, and nothing is brought."""
    network = replace(network, services=(replace(network.services[0], low=1e6),))
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    env.advance(np.full((1, 1), -1.0))
    return float(env.rows.stocks(env.physical.stock)[2, 0])


@pytest.mark.parametrize(
    ("seed", "separates"), [*((seed, False) for seed in range(12)), *((s, True) for s in range(8))]
)
@pytest.mark.sample(4)
def test_rows_hold_in_random_cycles(seed: int, separates: bool) -> None:
    """Supplies that are scarce, enough or ample; actions that stay at their ends for long starve and flood stocks."""
    network, rng = yearly_network(seed, SUPPLIED), np.random.default_rng(seed)
    network = with_substances(network, seed) if separates else network
    factor = float(rng.choice([0.3, 1.0, 3.0]))
    arcs = [
        replace(arc, control=replace(arc.control, high=factor * float(arc.control.high)))  # type: ignore[arg-type]
        if arc.makes_up_for and arc.control is not None
        else arc
        for arc in network.arcs
    ]
    network = replace(network, arcs=tuple(arcs))
    env = MultiAgentVectorEnv(network, num_envs=1)
    shape, half = (network.episode.horizon, len(env.actuators.control_rows), 16), network.episode.horizon // 2
    ends = rng.choice([-1.0, 1.0], (2, *shape[1:])).repeat([half, shape[0] - half], axis=0)
    actions = np.where(rng.random(shape) < np.linspace(0.5, 1.0, shape[2]), ends, rng.uniform(-1, 1, shape))
    assert room(network, actions).min(initial=0.0) >= 0


@pytest.mark.parametrize("merged", [False, True])
def test_what_nobody_can_change_is_bounded_by_what_happens(merged: bool) -> None:
    """Where the supply is enough the bound is the episode, though 90 % of the service would do."""
    network = village(40.0)
    pit = replace(network.arcs[1], control=flow(1e-6))
    network = replace(network, arcs=(network.arcs[0], pit, network.arcs[2]))
    solution = bound(network, min_service=0.9)
    run = simulate_plan(replace(solution, actions=np.full_like(solution.actions, -1.0)))
    assert float(run.episode_levels.min()) == pytest.approx(1.0)
    assert solution.verify().bound == solution.objective
    assert solution.objective == pytest.approx(float(run.episode_circularity[0]), rel=1e-4)
    assert solution.objective >= float(run.episode_circularity[0])


@pytest.mark.parametrize("copper", [0.0, 0.2])
def test_several_stocks_that_a_market_fills_lack_nothing_where_enough_arrives(copper: float) -> None:
    """What a market has is shared out, so that no flood dies out at once: 90 % of the service costs what all does."""
    np.testing.assert_allclose(largest_shortages(town(copper=copper, life=1.5 * LIFE)), 0.0, atol=1e-6)
    network = town(copper=copper, life=4 * LIFE)
    pit = replace(network.arcs[1], control=flow(1e-6))
    network = replace(network, arcs=(network.arcs[0], pit, *network.arcs[2:]))
    solution = bound(network, min_service=0.9)
    run = simulate_plan(replace(solution, actions=np.full_like(solution.actions, -1.0)))
    assert float(run.episode_levels.min()) == pytest.approx(1.0)
    assert solution.objective == pytest.approx(float(run.episode_circularity[0]), rel=1e-3)
    assert solution.objective >= float(run.episode_circularity[0])


@pytest.mark.parametrize(("high", "sorts", "copper"), [(14.0, False, 0.0), (14.0, False, 0.2), (20.0, True, 0.2)])
def test_several_stocks_lack_no_more_after_a_flood(high: float, sorts: bool, copper: float) -> None:
    """Much that comes in one year, and sorting that changes, leave no row unmet; supplies are at their most."""
    network = town(high, sorts=sorts, copper=copper)
    entries = len(network.default_agents or ())
    actions = np.full((YEARS, entries, YEARS), -1.0)
    actions[np.arange(YEARS), 0, np.arange(YEARS)] = 1.0
    actions[:, 1:] = np.random.default_rng(0).choice([-1.0, 1.0], (YEARS, entries - 1, YEARS))
    assert 0 < largest_shortages(network).max() < DEMAND
    assert room(network, actions).min() >= 0


def test_stocks_without_lifetimes_have_a_floor_too_but_not_beside_lifetimes() -> None:
    """Of a mixture all that is demanded may lack; of two rates what is left at the faster one, and rows hold."""
    network = town(14.0, copper=0.0)
    mixed, plain = network, network
    for name, mean in (("sheds", 0.6 * LIFE), ("homes", LIFE)):
        mixed = plain
        nodes = tuple(replace(node, lifetime=None, rate=1 / mean) if node.id == name else node for node in plain.nodes)
        plain = replace(plain, nodes=nodes)
    np.testing.assert_allclose(largest_shortages(mixed), DEMAND, rtol=1e-9)
    assert 0 < largest_shortages(plain).max() < DEMAND
    actions = np.full((YEARS, 1, YEARS), -1.0)
    actions[np.arange(YEARS), 0, np.arange(YEARS)] = 1.0
    assert room(plain, actions).min() >= 0


def test_nothing_is_said_where_a_source_may_run_dry_or_a_route_be_closed() -> None:
    """There a stock may lack while its arc supplies less than the most."""
    assert rows_of(village(9.0, ore=30.0))[1].toarray().any(axis=1).sum() < YEARS
    network = village(9.0)
    gate = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.5, high=1.0)
    arcs = (
        replace(network.arcs[0], recipient="market"),
        *network.arcs[1:],
        Arc(id="homing", donor="market", recipient="homes", law=Law.SHARE, control=gate),
        Arc(id="scrapping", donor="market", recipient="dump", law=Law.SHARE),
    )
    nodes, agents = (*network.nodes, Node(id="market", stores=False)), ("bring", "homing")
    network = replace(network, nodes=nodes, arcs=arcs, default_agents=agents)
    assert not rows_of(network)[1].toarray().any()
    starving = room(network, np.full((YEARS, 2, 1), -1.0))
    assert starving.min() >= 0
    half_open = tuple(
        replace(arc, control=replace(gate, low=0.2)) if arc.id == "homing" else arc for arc in network.arcs
    )
    opened = replace(network, arcs=half_open)
    assert rows_of(opened)[1].toarray().any(axis=1).all()
    assert room(opened, np.random.default_rng(0).choice([-1.0, 1.0], (YEARS, 2, 40))).min() >= 0


def test_a_valve_a_life_that_agents_shorten_and_what_they_take_are_allowed_for() -> None:
    """What is asked for passes a valve in part; what is left of a life that may be short is not known."""
    network = village(40.0)
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=1.0)
    quarry = replace(network.nodes[network.node_index["quarry"]], control=valve)
    nodes = tuple(quarry if node.id == "quarry" else node for node in network.nodes)
    gated = replace(network, nodes=nodes, default_agents=("bring", "quarry"))
    assert not rows_of(gated)[1].toarray().any()
    shorter = Control(kind=ControlKind.STRETCH, low=0.2, neutral=1.0, high=1.0)
    use = {"lifetime": Lifetime(mean=LIFE, deviation=2.0, distribution="normal"), "control": shorter}
    network = replace(village(9.0, use=use), default_agents=("bring", "homes"))
    np.testing.assert_array_equal(largest_shortages(network), DEMAND)
    assert room(network, np.random.default_rng(0).choice([-1.0, 1.0], (YEARS, 2, 40))).min() >= 0
    network = village(9.0)
    demolition = Arc(id="demolition", donor="homes", recipient="dump", law=Law.CONTROLLED, control=flow(5.0))
    network = replace(network, arcs=(*network.arcs, demolition), default_agents=("bring", "demolition"))
    assert largest_shortages(network).max() > starved(9.0).max() + 5.0
    assert room(network, np.random.default_rng(0).choice([-1.0, 1.0], (YEARS, 2, 40))).min() >= 0


@pytest.mark.parametrize("factor", [0.0, 0.5, 1.0, 1.5, 4.0])
def test_any_multipliers_prove_a_least_sum(monkeypatch: pytest.MonkeyPatch, factor: float) -> None:
    """Those of a solver that is off prove less; those of its optimum prove it."""
    rng, solve = np.random.default_rng(0), optimize.linprog
    cost, rows, most = rng.uniform(0.5, 1, 6), rng.uniform(0, 1, (4, 6)), rng.uniform(90, 99, 6)
    limits = rng.uniform(5, 10, 4)
    least = float(solve(cost, A_ub=-rows, b_ub=-limits, bounds=np.stack([0 * most, most], axis=1)).fun)

    def inexact(*arguments: Any, **options: Any) -> Any:
        solution = solve(*arguments, **options)
        solution.ineqlin.marginals *= factor
        return solution

    monkeypatch.setattr("cirl_marl.optimum.shortages.optimize.linprog", inexact)
    value = _least_sum(cost, rows, limits, most)
    assert 0.0 <= value <= least + 1e-12
    assert factor != 1.0 or value == pytest.approx(least)
