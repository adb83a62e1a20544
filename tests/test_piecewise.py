"""Rates that rise with what is charged for: booked, gradients, bounds, plans, MPC, files, tables and messages."""

from __future__ import annotations

import tempfile
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import random_network
from hypothesis import assume, given
from hypothesis import strategies as st
from scipy.optimize import linprog
from small_networks import ACCOUNTS, booked, city, in_pieces, small
from test_budgets import small_step
from test_gradient import check, differentiable
from test_optimum import bounded, pinned
from test_substances import substances_networks

from cirl_marl import (
    MPC,
    Account,
    Arc,
    CirlError,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    PiecewiseRate,
    Role,
    Series,
    Service,
    bound,
    gradient,
    load_network,
    simulate,
    write_network,
)
from cirl_marl.controllers import Neutral, Random
from cirl_marl.controllers.rollout import rollout
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.network.disturbances import DisturbanceEffect, Markov
from cirl_marl.network.series import means
from cirl_marl.network.uncertainty import Spread
from cirl_marl.optimum import improve_plan, simulate_plan
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.step_parts import Efforts, Excesses, account_shares
from cirl_marl.report.account_tables import account_steps, accounts_table
from cirl_marl.report.data_package import read_package, write_package

STEPS, INTEREST = 6, 0.05
DEMAND = (30.0, 60.0, 90.0, 120.0, 150.0, 80.0)
OLD, NEW = PiecewiseRate(to=(40.0, 80.0), rates=(20.0, 30.0, 45.0)), PiecewiseRate(to=(50.0,), rates=(25.0, 60.0))
HELD = PiecewiseRate(to=(20.0,), rates=(0.5, 3.0))
START = 40.0


def technologies(**rates: Any) -> Network:
    """Return two technologies that become dearer the more they make, and a store that becomes dearer to keep."""
    rates = {"old": OLD, "new": NEW, "hall": HELD} | rates
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=120.0)
    arcs = [
        Arc(id=name, donor="mine", recipient="hall", law=Law.CONTROLLED, control=order, accounts=accounts)
        for name, accounts in (
            ("old", {"cost": rates["old"], "carbon": 2.0}),
            ("new", {"cost": rates["new"], "carbon": 1.0}),
        )
    ]
    use = Arc(id="use", donor="hall", recipient="used", law=Law.CONTROLLED, control=replace(order, high=200.0))
    return Network(
        name="technologies",
        nodes=(
            Node(id="mine", initial=(1e5, 1e5), role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="hall", initial=(START, START), holding={"cost": rates["hall"]}),
            Node(id="used", initial=(0.0, 0.0)),
        ),
        arcs=(*arcs, use),
        episode=Episode(control_interval=1.0, horizon=STEPS),
        mass_unit="t",
        time_unit="year",
        services=(Service(id="demand", provider="use", quantity="flow", low=series(DEMAND)),),
        accounts=(Account(id="cost", unit="EUR_2023", discount=INTEREST), Account(id="carbon", unit="t CO2e")),
    )


def series(values: tuple[float, ...]) -> Series:
    """Return what has these values in years."""
    return Series(times=tuple(np.arange(float(len(values))).tolist()), values=values)


def least_cost(carbon: float = np.inf) -> float:
    """Return the least cost of the demand, of a linear program of flows in blocks, written by hand."""
    pieces = [*OLD.rates, *NEW.rates]
    sizes = [*np.diff([0.0, *OLD.to, 120.0]), *np.diff([0.0, *NEW.to, 120.0])]
    width, discount = len(pieces) + 3, (1 + INTEREST) ** -(np.arange(STEPS) + 0.5)
    use, store, dear = range(len(pieces), width)  # flow, stock at the end, what is held beyond the first block
    cost, beside = np.zeros((STEPS, width)), discount[0] * HELD.rates[0] / 2 * START
    equal, under = np.zeros((STEPS, STEPS, width)), np.zeros((2 * STEPS + 1, STEPS, width))
    equal_to, limits = np.zeros(STEPS), np.zeros(2 * STEPS + 1)
    equal_to[0], limits[0], limits[STEPS] = -START, HELD.to[0] - START / 2, START
    for t in range(STEPS):
        cost[t, : len(pieces)] = discount[t] * np.array(pieces)
        cost[t, store] += discount[t] * HELD.rates[0] / 2
        cost[t, dear] = discount[t] * (HELD.rates[1] - HELD.rates[0])
        equal[t, t, : len(pieces)], equal[t, t, use], equal[t, t, store] = 1.0, -1.0, -1.0
        under[t, t, store], under[t, t, dear], under[STEPS + t, t, use] = 0.5, -1.0, 1.0  # none goes that is not there
        under[-1, t, : len(pieces)] = [2.0] * len(OLD.rates) + [1.0] * len(NEW.rates)
        if t:
            cost[t - 1, store] += discount[t] * HELD.rates[0] / 2
            equal[t, t - 1, store], under[t, t - 1, store], under[STEPS + t, t - 1, store] = 1.0, 0.5, -1.0
            limits[t] = HELD.to[0]
    limits[-1] = min(carbon, 1e9)
    bounds = [
        (low, high)
        for demand in DEMAND
        for low, high in [*((0.0, size) for size in sizes), (demand, 200.0), (0.0, None), (0.0, None)]
    ]
    tables = [table.reshape(len(table), -1) for table in (equal, under)]
    found = linprog(cost.ravel(), A_ub=tables[1], b_ub=limits, A_eq=tables[0], b_eq=equal_to, bounds=bounds)
    assert found.success
    return float(found.fun + beside)


def test_least_cost_of_two_technologies_is_that_of_a_program_by_hand() -> None:
    """Bound, plan, MPC and the price of a budget."""
    network, best = technologies(), least_cost()
    solved = bound(network, aim="cost", min_service=1)
    assert -solved.objective == pytest.approx(best, rel=1e-6)
    assert solved.accounts[0] == pytest.approx(best, rel=1e-6)
    assert solved.verify().bound == solved.objective
    run = simulate_plan(improve_plan(solved))
    assert run.accounts[0, 0] == pytest.approx(best, rel=1e-6) and run.episode_levels.min() >= 1 - 1e-6
    mpc = rollout(MultiAgentVectorEnv(network, num_envs=1), MPC(aim="cost", min_service=1, replan=2))
    assert mpc.accounts[0, 0] == pytest.approx(best, rel=1e-4) and mpc.episode_levels.min() >= 1 - 1e-6
    for budget in (700.0, 650.0):
        kept = bound(network, aim="cost", min_service=1, at_most={"carbon": budget})
        assert -kept.objective == pytest.approx(least_cost(budget), rel=1e-6)
        quotients = sorted(abs(least_cost(budget) - least_cost(budget + side)) for side in (-0.1, 0.1))
        assert 0.99 * quotients[0] / 0.1 <= kept.budget_prices["carbon"] <= 1.01 * quotients[1] / 0.1
    start = np.array([1e5, 60.0, 0.0])
    other = bound(network, start, aim="cost", min_service=1)
    assert other.objective - 1e-6 * best <= float(solved.at(start)) <= other.objective + 0.01 * best


def test_the_most_that_can_be_booked_is_bounded_exactly() -> None:
    """Where more is wanted chords count, which are exact where all that flows and is held is the most there can be."""
    network = technologies()
    proved = bound(network, aim={"cost": -1.0})
    full = replace(proved, actions=np.tile([1.0 if agent != "use" else -1.0 for agent in proved.agents], (STEPS, 1)))
    assert simulate_plan(full).accounts[0, 0] == pytest.approx(proved.objective, rel=1e-6)
    layout, high = proved.problem.layout, proved.problem.high.reshape(STEPS, -1)
    held = START + 240.0 * (np.arange(STEPS) + 0.5)  # old and new, and half of it in the mean of an interval
    np.testing.assert_allclose(high[:, layout.excess], held - HELD.to[0])
    np.testing.assert_allclose(high[:, layout.excess + 1 :], np.tile([80.0, 40.0, 70.0], (STEPS, 1)))
    served = bound(network, aim={"cost": -1.0}, min_service=1)
    stock, excess = served.stock[:, 1], served.solution.reshape(STEPS, -1)[:, layout.excess]
    np.testing.assert_allclose(excess, (1 - HELD.to[0] / held) * (stock[1:] + stock[:-1]) / 2, rtol=1e-6)
    assert (excess[1:] < high[1:, layout.excess] - 1.0).all()


def market() -> Network:
    """Return a store of which more sells at a lower price, and that costs more the more is in it; changes cost, too."""
    earns = PiecewiseRate(to=(4.0, 7.0), rates=(-5.0, -2.0, 1.0), factor=series((1.0, 0.3, 1.2, 0.9, 0.5, 1.0)))
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=3.0, high=20.0)
    effort = PiecewiseRate(to=(1.0,), rates=(0.1, 1.5))
    parts: dict[str, Any] = {"accounts": {"cost": earns}, "effort": {"cost": effort}}
    sale = Arc(id="sale", donor="store", recipient="sold", law=Law.CONTROLLED, control=order)
    network = small({"store": 33.0, "sold": 0.0}, [sale], horizon=STEPS)
    held = replace(network.nodes[0], holding={"cost": PiecewiseRate(to=(12.0,), rates=(0.01, 0.3))})
    parts |= {"nodes": (held, network.nodes[1]), "arcs": (replace(sale, **parts),)}
    return replace(network, nodes=parts["nodes"], arcs=parts["arcs"], accounts=ACCOUNTS, time_unit="year")


@pytest.mark.slow
def test_plans_climb_to_the_optimum_from_anywhere() -> None:
    """Steps know that rates rise of what flows, is held and is changed; MPC of a window does no worse than 1 %."""
    network = market()
    solved = bound(network, aim="cost")
    for seed in range(3):
        actions = np.random.default_rng(seed).uniform(-1.0, 1.0, solved.actions.shape)
        run = simulate_plan(improve_plan(replace(solved, actions=actions), rounds=40))
        assert -run.accounts[0, 0] == pytest.approx(solved.objective, rel=1e-6)
    mpc = rollout(MultiAgentVectorEnv(network, num_envs=1), MPC(aim="cost"))
    assert -mpc.accounts[0, 0] == pytest.approx(solved.objective, rel=1e-2)


def leaking() -> Network:
    """Return a store that leaks as it is steered; what leaks, what is held, and changes cost in pieces."""
    effort = PiecewiseRate(to=(0.3,), rates=(0.0, 5.0))
    rising = {"mass": PiecewiseRate(to=(1.0,), rates=(-1.0, 2.0)), "stock": PiecewiseRate(to=(90.0,), rates=(0.1, 1.0))}
    control = Control(kind=ControlKind.RATE, low=0.0, neutral=0.5, high=2.0)
    out = Arc(id="out", donor="store", recipient="sink", rate=0.02, control=control)
    network = small({"store": 100.0, "sink": 0.0}, [out])
    nodes = (replace(network.nodes[0], holding={"cost": rising["stock"]}), network.nodes[1])
    arcs = (replace(out, accounts={"cost": rising["mass"]}, effort={"cost": effort}),)
    return replace(network, nodes=nodes, arcs=arcs, accounts=ACCOUNTS)


def test_excesses_are_of_flows_of_mean_stocks_and_of_distances() -> None:
    """Beyond their amounts, also where controls fall below their neutral value."""
    network = leaking()
    solved = bound(network, aim="cost")
    actions = np.array([-0.95, 0.8, -0.6, 0.1, -1.0])[:, None]
    plan, ledger, dynamics = replace(solved, actions=actions), Ledger(network), Dynamics(network)
    run, efforts = simulate_plan(plan), Efforts.of(plan, np.ones(1, dtype=bool), 0)
    ends = np.concatenate([run.stock, run.flow], axis=1)
    excesses = Excesses.of(ledger, dynamics, efforts, run.start, ends)
    stock = np.append(run.start[0], run.stock[:, 0])
    subjects = {1.0: run.flow[:, 0], 90.0: (stock[1:] + stock[:-1]) / 2, 0.3: np.abs(actions[:, 0] + 0.5)}
    expected = np.array([subjects[amount] - amount for amount in ledger.amounts[:, 0].tolist()]).T
    np.testing.assert_allclose(excesses.beyond, expected, atol=1e-9)


def test_steps_of_plans_have_what_pieces_change_by() -> None:
    """What the program of a small step charges is what the simulator books, and rows hold with no room to spare."""
    network = leaking()
    solved = bound(network, aim="cost", at_most={"emissions": 1.0})
    middle, program, moves, run, trial = small_step(solved, 0.0)
    ledger = Ledger(network)

    def parts(actions: np.ndarray, episode: Any) -> np.ndarray:
        stock = np.concatenate([episode.start[None], episode.stock])
        distance = abs(1.0 + actions.T - 0.5)
        return ledger.convex_parts(episode.flow.T, (stock[1:] + stock[:-1]).T / 2, distance).T

    changes = parts(middle.actions + moves[program.columns.action], trial) - parts(middle.actions, run)
    moves[program.columns.part] = changes
    books = trial.accounts[0, 0] - run.accounts[0, 0]
    assert program.columns.part.shape == (5, 4) and abs(changes).max(axis=0).all()
    assert program.problem.cost @ moves == pytest.approx(books, rel=1e-5)
    room = program.problem.under_to - program.problem.under @ moves
    rows = abs(program.problem.under[:, program.columns.part[:, 1:].ravel()]).sum(axis=1) > 0
    assert room[rows].min() >= -1e-8 and (room[rows] < 1e-8).sum() >= 4
    assert (moves >= program.problem.low - 1e-9).all() and (moves <= program.problem.high + 1e-9).all()


def test_excesses_of_a_step_are_measured_by_their_amounts() -> None:
    """So the unit of mass makes no difference to the solver."""
    network = technologies()
    program = small_step(bound(network, aim="cost", min_service=0.5), 0.5)[1]
    amounts = Ledger(network).amounts
    assert sorted(set(amounts.ravel().tolist())) == [20.0, 40.0, 50.0, 80.0]
    np.testing.assert_array_equal(program.scale[program.columns.part], np.tile(amounts.T, (STEPS, 1)))


def test_a_step_leaves_rates_as_they_are() -> None:
    """Programs of several steps have the same rates, in which what is held counts once."""
    network = market()
    rates = Ledger(network).rates()
    before = [table.copy() for table in rates]
    account_shares(rates, Dynamics(network))
    for table, other in zip(rates, before, strict=True):
        np.testing.assert_array_equal(table, other)


def by_hand(network: Network, run: Any, account: int) -> np.ndarray:
    """Return what is booked in each interval of the first episode, not discounted, block by block."""
    stock = np.concatenate([run.start[None], run.stock])
    total, length = np.zeros(len(run.flow)), network.episode.control_interval
    edges = length * np.arange(network.episode.horizon + 1, dtype=np.float64)
    for part in (*network.nodes, *network.arcs):
        subjects = {}
        if isinstance(part, Arc):
            subjects["accounts"] = run.flow[:, network.arc_index[part.id]]
        else:
            subjects["accounts"] = run.flow[:, network.recipients == network.node_index[part.id]].sum(axis=1)
            if isinstance(part, Node) and part.stores:
                subjects["holding"] = (stock[1:] + stock[:-1])[:, network.node_index[part.id]] / 2
        if part.control is not None:
            row = network.control_rows[part.id].start
            subjects["effort"] = abs(run.controls[:, row] - network.control_bounds[1, row])
        for name, subject in subjects.items():
            rate = dict(getattr(part, name)).get(network.accounts[account].id, 0.0)
            if not isinstance(rate, PiecewiseRate):
                rate = PiecewiseRate(to=(), rates=(1.0,), factor=rate)
            ends = [0.0, *rate.to, np.inf]
            blocks = [np.clip(subject, low, high) - low for low, high in pairwise(ends)]
            amounts = sum(r * block for r, block in zip(rate.rates, blocks, strict=True))
            total += amounts * means(rate.factor, edges) * length
    return total


@given(seed=st.integers(0, 10_000), nodes=st.integers(2, 8), arcs=st.integers(1, 16), lifetimes=st.booleans())
def test_blocks_are_booked_at_their_own_rates(seed: int, nodes: int, arcs: int, lifetimes: bool) -> None:
    """Of flows, inflows, stocks and efforts, as by hand; alone and among others to the bit; entries add up."""
    network = in_pieces(booked(random_network(seed, nodes, arcs, lifetimes=lifetimes), seed), seed)
    env = MultiAgentVectorEnv(network, num_envs=3)
    run = rollout(env, Random(), seed=seed)
    for account, amounts in enumerate(run.bookings[0]):
        expected = by_hand(network, run, account)
        np.testing.assert_allclose(amounts, expected, atol=1e-9 * float(abs(run.entries).sum() + 1.0))
    np.testing.assert_array_equal(env.ledger.sums(run.entries.T).T, run.bookings[0].T)
    alone, among = (rollout(MultiAgentVectorEnv(network, num_envs=n), Neutral(), seed=seed) for n in (1, 3))
    np.testing.assert_array_equal(alone.accounts[0], among.accounts[0])


@pytest.mark.medium
@given(network=st.from_type(Network) | substances_networks, interval=st.floats(0.02, 0.4), seed=st.integers(0, 1000))
def test_no_episode_is_above_the_bound(network: Network, interval: float, seed: int) -> None:
    """Random rates in pieces on random networks, of which less or more is wanted; λ̄ of those that keep a budget."""
    network = in_pieces(booked(bounded(network, interval).network, seed), seed)
    charge = (1.0, -1.0, 0.01)[seed % 3]
    best = bound(network, network.initial[1], aim={"circularity": 1.0, "cost": charge})
    run = rollout(MultiAgentVectorEnv(pinned(best), num_envs=24), Random(), seed=seed)
    values = best.aims.objective(run.episode_circularity, run.accounts.T)
    size = float(abs(best.problem.cost) @ np.maximum(abs(best.problem.low), abs(best.problem.high)))
    assert (values <= best.objective + 1e-9 * max(size, 1.0)).all()
    assert best.verify().bound == best.objective
    budget = float(np.median(run.accounts[:, 1]))
    kept = bound(network, network.initial[1], at_most={"emissions": budget})
    scale = max(float(abs(kept.problem.cost) @ np.maximum(abs(kept.problem.low), abs(kept.problem.high))), 1.0)
    assert (run.episode_circularity[run.accounts[:, 1] <= budget] <= kept.objective + 1e-9 * scale).all()


@pytest.mark.medium
@given(network=st.from_type(Network), seed=st.integers(0, 1000))
def test_gradients_are_those_of_differences(network: Network, seed: int) -> None:
    """Where no rate changes within the difference; by actions, starts and draws."""
    network = differentiable(in_pieces(booked(network, seed), seed))
    assume(network.agents)
    rates = [(arc, dict(arc.accounts)) for arc in network.arcs]
    path = next(
        (f"arcs.{arc.id}.accounts.cost" for arc, by in rates if isinstance(by.get("cost"), PiecewiseRate)), None
    )
    if path is not None:
        network = replace(network, uncertain={path: Spread(deviation=0.1)}, scenarios={})
    env = MultiAgentVectorEnv(network, num_envs=2, uncertain=bool(network.uncertain))
    with pytest.MonkeyPatch.context() as monkeypatch:
        try:
            check(env, seed, monkeypatch)
        except CirlError as error:
            assert "ran out" in str(error)
            assume(False)


def test_the_gradient_at_an_amount_has_the_lower_rate() -> None:
    """Below, at and beyond it; the derivative by a drawn factor is what is booked at a factor of 1."""
    network = replace(technologies(), uncertain={"arcs.new.accounts.cost": Spread(deviation=0.2)})
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    env.reset(seed=0)
    flows = np.array([20.0, 50.0, 70.0])
    actions = np.full((STEPS, 3, 3), -1.0)
    actions[0, list(env.agents).index("new")] = flows / 60.0 - 1.0
    free = replace(technologies(), nodes=tuple(replace(node, holding={}) for node in network.nodes))
    free = replace(free, uncertain=network.uncertain)
    env = MultiAgentVectorEnv(free, num_envs=3, uncertain=True)
    env.reset(seed=0)
    result = gradient(env, actions, circularity=0.0, accounts=[1.0, 0.0])
    discount, factor = env.ledger.discount[0, 0], env.physical.factors[0]
    expected = 60.0 * np.array([25.0, 25.0, 60.0]) * factor * discount
    np.testing.assert_allclose(result.actions[0, list(env.agents).index("new")], expected)
    np.testing.assert_allclose(result.draws[0], discount * np.array([500.0, 1250.0, 2450.0]))


class Full(Neutral):
    """All controls at 0.8."""

    def act(self, observations: Any) -> Any:
        """Return the actions."""
        return {agent: np.full((len(each), 1), 0.8) for agent, each in observations.items()}


def test_draws_and_disturbances_are_factors_on_all_pieces() -> None:
    """Each copy books what the network that it drew books, and no policy is above the mean that is proved."""
    regime = Markov(values=(1.0, 3.0), matrix=((0.5, 0.5), (0.5, 0.5)))
    network = replace(
        technologies(),
        uncertain={"arcs.old.accounts.cost": Spread(low=0.5, high=1.5, distribution="uniform")},
        disturbances={"wage": regime},
        disturbed={"arcs.new.accounts.cost": DisturbanceEffect(by="wage")},
    )
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    run = rollout(env, Full())
    for copy in range(3):
        drawn = env.certain_network(copy)
        lone = rollout(MultiAgentVectorEnv(drawn, num_envs=1), Full())
        np.testing.assert_allclose(lone.accounts[0], run.accounts[copy], rtol=1e-12)
        rates = dict(drawn.arcs[1].accounts)["cost"]
        assert isinstance(rates, PiecewiseRate) and isinstance(rates.factor, Series | float)


@pytest.mark.slow
def test_expected_costs_in_pieces_have_budgets() -> None:
    """What a tonne costs more beyond 4 is twice as much in an outage: what a budget buys at least is known."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=10.0, high=10.0)
    rate = {"emissions": PiecewiseRate(to=(4.0,), rates=(1.0, 3.0))}
    dig = Arc(id="dig", donor="mine", recipient="store", law=Law.CONTROLLED, control=order)
    network = small({"mine": 1e3, "store": 0.0}, [dig])
    network = replace(
        network,
        nodes=(replace(network.nodes[0], role=Role.NONRENEWABLE_RESERVOIR), network.nodes[1]),
        arcs=(replace(dig, accounts=rate),),
        accounts=ACCOUNTS[1:],
        services=(Service(id="dug", provider="dig", quantity="flow", low=10.0),),
        disturbances={"outage": Markov(values=(1.0, 2.0), matrix=((0.5, 0.5), (0.5, 0.5)))},
        disturbed={"arcs.dig.accounts.emissions": DisturbanceEffect(by="outage")},
    )
    sampling = Sampling(draws=16, fit_draws=16)
    # in expectation 4 cost 6 in each of 5 intervals, and where there is no outage each further tonne 3
    assert bound(network, at_most={"emissions": 66.0}, min_service=0.6, uncertain=sampling).value < 0
    with pytest.raises(CirlError, match="no policy"):
        bound(network, at_most={"emissions": 48.0}, min_service=0.6, uncertain=sampling)


def rising_file(tmp_path: Path, rate: str) -> Path:
    """Return a definition of the technologies in which the cost of the new one stands as ``rate``."""
    file = tmp_path / "technologies.toml"
    write_network(technologies(), file)
    text = file.read_text(encoding="utf-8")
    stated = (
        '{to = [50.0], to_unit = "(t)/(year)", values = [25.0, 60.0], unit = "(EUR_2023)/(t)", '
        'source = "network built in Python"}'
    )
    assert stated in text
    file.write_text(text.replace(stated, rate), encoding="utf-8")
    return file


def test_files_state_pieces_in_any_unit(tmp_path: Path) -> None:
    """Amounts, rates, factors and spreads; what cannot be meant is refused by its place."""
    rate = '{ to = [0.05], to_unit = "kt/year", values = [0.025, 0.06], unit = "MEUR_2023/kt", source = "s"'
    assert load_network(rising_file(tmp_path, f"{rate} }}")).arcs == technologies().arcs
    doubled = f'{rate}, deviation = "10 %", multiplied_by = {{ value = 2, unit = "1", source = "s" }} }}'
    network = load_network(rising_file(tmp_path, doubled))
    assert dict(network.arcs[1].accounts)["cost"] == replace(NEW, factor=2.0)
    assert network.uncertain["arcs.new.accounts.cost"].deviation == 0.1
    of_mean = load_network(rising_file(tmp_path, f"{rate}, deviation = 0.0085 }}"))
    assert of_mean.uncertain["arcs.new.accounts.cost"].deviation == pytest.approx(0.2)
    ranged = load_network(rising_file(tmp_path, f"{rate}, range = [0.03, 0.06] }}"))
    write_network(ranged, tmp_path / "ranged.toml")
    again = load_network(tmp_path / "ranged.toml")
    assert again.uncertain["arcs.new.accounts.cost"].low == pytest.approx(0.03 / 0.0425)
    assert again.uncertain["arcs.new.accounts.cost"].high == pytest.approx(0.06 / 0.0425)
    disturbance = (
        '\n[disturbances.wage]\nkind = "markov"\nvalues = [1, 3]\nmatrix = [[0.5, 0.5], [0.5, 0.5]]\n'
        'unit = "1"\nsource = "s"\n'
    )
    file = rising_file(tmp_path, f'{rate}, disturbed_by = "wage" }}')
    file.write_text(file.read_text(encoding="utf-8") + disturbance, encoding="utf-8")
    again = load_network(file)
    assert again.disturbed["arcs.new.accounts.cost"].by == "wage"
    write_network(again, str(tmp_path / "again.toml"))
    assert load_network(tmp_path / "again.toml").disturbed == again.disturbed
    for change, message in (
        (("0.025, 0.06", "0.06, 0.025"), r"arc 'new': accounts.cost: rates must rise, but 25 follows 60.*not convex"),
        (("0.025, 0.06", "0.025"), "accounts.cost: 1 rates and 1 amounts up to which they hold: give one rate more"),
        (("[0.05]", "[0.0]"), "accounts.cost: amounts up to which rates hold must be positive and rise, but 0 follows"),
        (("[0.05]", "[0.05, 0.04]"), "give one rate more"),
        (("kt/year", "kt"), r"arcs\.new\.accounts\.cost\.to_unit: unit 'kt' is inconsistent"),
        (("MEUR_2023/kt", "MEUR_2023"), r"arcs\.new\.accounts\.cost: unit 'MEUR_2023' is inconsistent"),
        (("to_unit", "to_units"), "unknown key 'to_units'.*Did you mean 'to_unit'"),
        (('"s"', '"s", disturbed_by = "wage", disturbed_as = "summand"'), "a disturbance is a factor on rates"),
    ):
        file = rising_file(tmp_path, f"{rate.replace(*change)} }}")
        file.write_text(file.read_text(encoding="utf-8") + disturbance.replace('"1"', '"EUR_2023/t"'), encoding="utf-8")
        with pytest.raises(CirlError, match=message):
            load_network(file)


@given(seed=st.integers(0, 10_000))
def test_a_file_reads_pieces_back(seed: int) -> None:
    """Of flows, stocks and efforts, with factors in time, to the last bit."""
    network = in_pieces(booked(random_network(seed, 5, 8), seed), seed)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "random.toml"
        write_network(network, file)
        again = load_network(file)
    assert (again.nodes, again.arcs) == (network.nodes, network.arcs)


@pytest.mark.parametrize(
    ("rate", "message"),
    [
        (PiecewiseRate(to=(1.0, 1.0), rates=(1.0, 2.0, 3.0)), "accounts.cost: amounts .* but 1 follows 1"),
        (PiecewiseRate(to=(1.0,), rates=(1.0, 1.0)), "accounts.cost: rates must rise, but 1 follows 1"),
        (PiecewiseRate(to=(), rates=(1.0,)), "accounts.cost: 1 rates and 0 amounts"),
        (PiecewiseRate(to=(1.0,), rates=(1.0, np.inf)), "accounts.cost: rates, and the amounts .* must be finite"),
        (PiecewiseRate(to=(1.0,), rates=(1.0, 2.0), factor=-1.0), "accounts.cost -1.0 must be finite and not negative"),
        (
            PiecewiseRate(to=(1.0,), rates=(1.0, 2.0), factor=Series(times=(3.0,), values=(1.0,))),
            "accounts.cost: series begins at 3",
        ),
    ],
)
def test_pieces_that_cannot_be_meant_are_refused(rate: PiecewiseRate, message: str) -> None:
    """Rates that fall, amounts that do not rise, another count, factors below 0 or that miss a part of the episode."""
    with pytest.raises(NetworkError, match=message):
        technologies(old=rate)


def test_only_rates_on_accounts_have_pieces() -> None:
    """Efforts are not negative; contents and numbers are no rates."""
    rate: Any = PiecewiseRate(to=(1.0,), rates=(-1.0, 2.0))
    network = technologies()
    effort = replace(network.arcs[0], effort={"cost": rate})
    with pytest.raises(NetworkError, match=r"arc 'old': effort\.cost: rates -1 must be finite"):
        replace(network, arcs=(effort, *network.arcs[1:]))
    with pytest.raises(NetworkError, match="content must be 'copper': a number, got PiecewiseRate"):
        replace(network.nodes[0], content={"copper": rate})
    with pytest.raises(NetworkError, match="rate must be a number, got PiecewiseRate"):
        replace(network.arcs[0], rate=rate)


def test_networks_without_pieces_have_the_same_programs() -> None:
    """No variable is added."""
    layout = bound(city(), aim="cost").problem.layout
    assert layout.excess == layout.size
    layout = bound(technologies(), aim="cost").problem.layout
    assert layout.size == layout.excess + 4


def test_tables_and_packages_have_what_pieces_book(tmp_path: Path) -> None:
    """A compartment has a row whatever its pieces; the waterfall leads to the total; a package brings all back."""
    simulation = simulate(technologies(), "random")
    steps, total = account_steps(simulation, 0), simulation.rollout.accounts[0, 0]
    assert sum(amount for *_, amount in steps) == pytest.approx(total, rel=1e-12)
    assert sorted(label for label, *_ in steps) == ["hall", "new", "old"]
    assert [row[0] for row in accounts_table(simulation)[1]].count("cost") == 3
    write_package(tmp_path / "package", simulation)
    back = read_package(tmp_path / "package")
    np.testing.assert_allclose(back.bookings, simulation.rollout.bookings[0].T, rtol=1e-12)
    assert back.network.arcs == technologies().arcs
