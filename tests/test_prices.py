"""Shadow prices against closed forms, and against programs that are solved again with a little more of something."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from small_networks import cycle
from test_lifetimes import INFLOW, LIVES, town
from test_optimum import RESERVE, TIP, USE, order, valve
from test_optimum import small as timed

from cirl_marl import Arc, Control, ControlKind, Network, Service, load_network
from cirl_marl.network.disturbances import DisturbanceEffect, Markov
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.series import in_intervals
from cirl_marl.optimum import Bound, NoCertificate, bound
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.options import by_stage
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.solver import solve
from cirl_marl.optimum.vintages import Lifetimes
from cirl_marl.reasons.explanation import explain
from cirl_marl.reasons.prices import shadow_prices, with_bound
from cirl_marl.reasons.sentences import paragraphs, price_sentences
from cirl_marl.report.explanations import price_rows

Floats = NDArray[np.floating]


def optimum(found: Bound) -> float:
    """Return λ̄ of the plan in the program, without what the certificate leaves open."""
    return -math.fsum(found.problem.cost * found.solution)


def test_a_stock_that_only_leaks() -> None:
    """Of a unit in the reserve at time t the part 1 − e^{−a w̲ (T − t)} is extracted, and counts 1/T in λ̄."""
    arc = Arc(id="extraction", donor="reserve", recipient="use", rate=0.4, control=valve(0.5, 2.0))
    found = shadow_prices(timed([RESERVE, USE], [arc]))
    left = 4 - 0.5 * np.arange(8)
    np.testing.assert_allclose(found.stock[:, 0], -(1 - np.exp(-0.4 * 0.5 * left)) / 4, rtol=1e-3)
    np.testing.assert_allclose(found.stock[:, 1], 0.0, atol=1e-9)
    # d/dw̲ of −x_0 (1 − e^{−a w̲ T})/T, one per cent of w̲ downwards; the upper bound is worth nothing
    assert found.room[0].sum() == pytest.approx(0.01 * 0.5 * 100 * 0.4 * math.exp(-0.4 * 0.5 * 4), rel=1e-3)
    np.testing.assert_allclose(found.room[1], 0.0, atol=1e-5)
    assert found.demand.shape == (8, 0) and not found.level.size


@pytest.mark.medium
def test_prices_by_state() -> None:
    """A reserve that leaks ξ times as fast, for ever: as above with a·ξ, on average over intervals."""
    arc = Arc(id="extraction", donor="reserve", recipient="use", rate=0.4, control=valve(0.5, 2.0))
    network = replace(
        timed([RESERVE, USE], [arc]),
        disturbances={"luck": Markov(values=(0.5, 1.0), lengths=(1e12, 1e12))},
        disturbed={"arcs.extraction.rate": DisturbanceEffect(by="luck")},
    )
    found = explain(network)
    (by_state,) = found.state_prices
    np.testing.assert_array_equal(by_state.states, [[0.5, 0.5], [1.0, 1.0]])
    left = 4 - 0.5 * np.arange(1, 8)
    for factor, worth in zip((0.5, 1.0), by_state.stock, strict=True):
        assert worth[0] == pytest.approx(-(1 - np.exp(-0.4 * 0.5 * factor * left)).mean() / 4, rel=1e-3)
        assert worth[1] == pytest.approx(0.0, abs=1e-9)
    (sentence,) = dict(paragraphs(found))["What stocks are worth when"]
    assert "while luck is 0.5 and" in sentence
    rows = [row for row in price_rows(found) if row[0] == "stock while luck is 1 to 1"]
    assert [row[1] for row in rows] == ["reserve", "use"]
    assert float(rows[0][3]) == pytest.approx(by_state.stock[1, 0])


def test_a_service_that_needs_its_throughput() -> None:
    """A stock that loses a·x needs U = a·x extracted and loses as much: a unit of demand costs 2 a in every interval.

    Less in the first one, which must also fill what is missing at the start: and then holds what it filled.
    """
    arcs = [order("extraction", "reserve", "use", 9.0), Arc(id="loss", donor="use", recipient="tip", rate=0.3)]
    service = Service(id="served", provider="use", quantity="stock", low=10.0)
    found = shadow_prices(timed([RESERVE, USE, TIP], arcs, [service]), min_service=1.0)
    # all demands a unit higher: the stock that is missing is extracted, and throughput rises: −(1 + 2·a·T)/T, but for
    # what the new stock does not lose while it is filled
    assert found.demand.sum() == pytest.approx(-(1 + 2 * 0.3 * 4) / 4, rel=0.1)
    again = []
    for more in (0.0, 1e-3):
        higher = replace(service, low=10.0 + more)
        again.append(optimum(bound(timed([RESERVE, USE, TIP], arcs, [higher]), min_service=1.0)))
    assert found.demand.sum() == pytest.approx((again[1] - again[0]) / 1e-3, rel=1e-3)
    # a unit more in use need not be extracted, one more in the reserve is worth nothing
    assert found.stock[0, 1] > 0.2 and found.stock[0, 0] == pytest.approx(0.0, abs=1e-9)


@pytest.mark.parametrize(("lifetime", "longest"), [*((lifetime, 1.0) for lifetime in LIVES), (LIVES[0], 1.3)])
def test_what_lives_is_new(lifetime: Lifetime, longest: float) -> None:
    """Of products that are new at time t those that die by the end count 1/T in λ̄, as the survival function says.

    Who may prolong lives does so as much as can be.
    """
    years, stretch = 12, Control(kind=ControlKind.STRETCH, low=0.9, neutral=1.0, high=longest)
    network = town(lifetime, INFLOW[:years], initial=30.0, control=stretch if longest > 1 else None)
    found = shadow_prices(network)
    (node,) = [i for i, each in enumerate(network.stores) if each.lifetime is not None]
    given = network.stores[node].lifetime
    assert given is not None
    weights = network.circularity_weights.sum(axis=0)
    per_tonne = weights[network.arc_index["discard"]]  # −Δ where what is discarded counts in λ
    left = years - np.arange(years)
    if given.chain is None:
        dead = (left >= given.mean).astype(float)
    else:
        at_once = given.chain.weights[0]
        dead = 1 - given.chain.survival(left / given.mean / longest) / (1 - at_once)
    np.testing.assert_allclose(found.stock[:, node], per_tonne * dead / years, atol=2e-4 * abs(per_tonne) / years)


NETWORKS = {"copper_net": 0.98, "carbo_net": 0.9}


@pytest.fixture(params=["carbo_net", pytest.param("copper_net", marks=pytest.mark.slow)])
def shortened(request: pytest.FixtureRequest) -> tuple[Network, float]:
    """Return networks of the catalogue over a few intervals, and a level of service."""
    return load_network(request.param).with_options(episode={"horizon": 5}), NETWORKS[request.param]


@pytest.mark.medium
def test_stocks_against_programs_solved_again(shortened: tuple[Network, float]) -> None:
    """More at the start, and more in the middle: the program of what is left from there, at the prices of service."""
    network, level = shortened
    found = shadow_prices(network, min_service=level)
    best, stores, middle = found.bound, len(network.stores), 2
    programs = Programs(Admissible.of(network), best.degree, None)
    scale = best.initial[best.initial < 1e6].max()
    for t, start in ((0, best.initial), (middle, best.stock[middle])):
        for i in range(stores):
            values = []
            for sign in (1e-4, -1e-4):
                stocks = start.copy()
                stocks[i] = max(stocks[i] + sign * scale, 0.0)
                problem = programs.program(stocks, level if t == 0 else None, range(t, 5))
                if t:  # levels of the rest of the episode are paid for at the price of the level that is demanded
                    cost = problem.cost.reshape(-1, problem.layout.size) * (5 - t) / 5
                    cost[:, problem.layout.level : problem.layout.imbalance] = found.level / 5
                    problem = replace(problem, cost=cost.ravel())
                values.append((stocks[i], -float(problem.cost @ solve(problem).plan)))
            (upper, more), (lower, less) = values
            price, middle_price = found.stock[t, i], (more - less) / (upper - lower)
            slack = 1e-3 * np.abs(found.stock[t]).max()
            assert price == pytest.approx(middle_price, rel=2e-2, abs=slack), (t, network.stores[i].id)


def between(found: float, slopes: list[float], scale: float) -> bool:
    """Whether a slope lies between those to either side of a kink, to a per cent."""
    slack = 1e-2 * max(map(abs, slopes)) + 1e-3 * scale
    return min(slopes) - slack <= found <= max(slopes) + slack


@pytest.mark.medium
def test_demands_and_levels_against_programs_solved_again(shortened: tuple[Network, float]) -> None:
    """A higher and a lower band in one interval; a higher level of one service alone."""
    network, level = shortened
    found = shadow_prices(network, min_service=level)
    basic, interval = optimum(found.bound), network.episode.control_interval
    for s, service in enumerate(network.services):
        slopes = []
        for step in (1e-4, -1e-4):
            low = np.array(network.interval_means(service.low))
            low[3] *= 1 + step
            other = replace(service, low=in_intervals(low, interval))
            services = tuple(other if each is service else each for each in network.services)
            moved = bound(replace(network, services=services, scenarios={}), min_service=level)
            slopes.append((optimum(moved) - basic) / (low[3] / (1 + step) * step))
        assert found.demand[3, s] < 0 and between(found.demand[3, s], slopes, 0.0)
        levels = np.full(len(network.services), level)
        levels[s] += 1e-5
        assert found.level[s] == pytest.approx((optimum(bound(network, min_service=levels)) - basic) / 1e-5, rel=1e-2)


@pytest.mark.medium
@pytest.mark.parametrize("agents", [slice(1, 2), pytest.param(slice(None), marks=pytest.mark.slow)])
def test_room_against_programs_solved_again(shortened: tuple[Network, float], agents: slice) -> None:
    """Bounds of controls by a hundredth of a per cent, in all intervals and in one."""
    network, level = shortened
    found = shadow_prices(network, min_service=level)
    basic, steps = optimum(found.bound), network.episode.horizon
    for a, agent in [*enumerate(found.bound.agents)][agents]:
        for side, way in enumerate((-1.0, 1.0)):
            values = network.control_bounds[2 * side, network.control_rows[agent].start]
            worths = ((np.ones(steps), found.room[side, :, a].sum()), (np.eye(steps)[2], found.room[side, 2, a]))
            for when, worth in worths:
                slopes = []
                for step in (1e-4, -1e-4):
                    moved = with_bound(network, agent, side, values * (1 + step * way * when))
                    slopes.append((optimum(bound(moved, min_service=level)) - basic) / step)
                assert between(worth / 0.01, slopes, abs(basic)), agent


@pytest.mark.slow
def test_a_cycle_against_programs_solved_again() -> None:
    """Shares, throughputs, valves and orders that may be cut; all bounds, and all stocks at the start."""
    network = cycle()
    found = shadow_prices(network, min_service=0.9)
    basic = optimum(found.bound)
    for a, agent in enumerate(found.bound.agents):
        for side, way in enumerate((-1.0, 1.0)):
            values = network.control_bounds[2 * side, network.control_rows[agent].start]
            rise = optimum(bound(with_bound(network, agent, side, values * (1 + 1e-4 * way)), min_service=0.9)) - basic
            assert found.room[side, :, a].sum() / 0.01 == pytest.approx(rise / 1e-4, rel=5e-2, abs=5e-3), agent
    for i, node in enumerate(network.stores):
        stocks = by_stage(network, Lifetimes(network, ()).state_layout, network.initial.mean(axis=0))
        stocks[i] += 1e-3
        rise = (optimum(bound(network, stocks, min_service=0.9)) - basic) / 1e-3
        # what more of a stock changes in the boxes of orders, and in what they deliver at least, is left out
        assert found.stock[0, i] == pytest.approx(rise, rel=1e-2, abs=5e-4), node.id


def test_sentences_keep_the_sign_of_a_price() -> None:
    """What is worth something late and costs something at the start is said so, and not as if both were alike."""
    network = load_network("copper_net").with_options(episode={"horizon": 4})
    prices = shadow_prices(network)
    worth = np.zeros_like(prices.stock)
    for start, late, words in (
        (-0.00289, 0.5, "raises λ̄ by up to 0.5 kt at day 0.75, and lowers it by 0.00289 kt at the start."),
        (0.00289, 0.5, "raises λ̄ by up to 0.5 kt at day 0.75, by 0.00289 kt at the start."),
        (0.00289, -0.5, "lowers λ̄ by up to 0.5 kt at day 0.75, and raises it by 0.00289 kt at the start."),
    ):
        worth[0, 0], worth[-1, 0] = start, late
        assert any(sentence.endswith(words) for sentence in price_sentences(replace(prices, stock=worth)))


def test_what_has_no_certificate_has_no_prices() -> None:
    """Inner physics is not convex: the error says so."""
    with pytest.raises(NoCertificate, match="inner physics"):
        shadow_prices("net_zero")
