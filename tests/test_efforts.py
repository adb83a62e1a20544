"""What controls cost that are not neutral: booked, its gradient, bounds, plans and MPC, files and messages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from conftest import random_network
from hypothesis import given
from hypothesis import strategies as st
from small_networks import ACCOUNTS, booked, small
from test_budgets import small_step
from test_optimum import bounded, pinned
from test_substances import substances_networks

from cirl_marl import (
    MPC,
    Account,
    Arc,
    CirlError,
    Control,
    ControlKind,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    Role,
    Series,
    Service,
    bound,
    gradient,
    load_network,
    simulate,
    write_network,
)
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.network.disturbances import DisturbanceEffect, Markov
from cirl_marl.network.uncertainty import Spread
from cirl_marl.optimum import improve_plan, simulate_plan
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.slopes import ActionPlan
from cirl_marl.optimum.step_parts import Efforts
from cirl_marl.report.account_tables import accounts_table

COST = (Account(id="cost", unit="EUR_2023"),)
ORDER = Control(kind=ControlKind.FLOW, low=0.0, neutral=2.0, high=10.0)
PRICE = np.array([3.0, -0.5, 0.9, -4.0, 1.5])


def trade(effort: Any = 1.0, price: np.ndarray = PRICE, stock: float = 1000.0) -> Network:
    """Return a store whose sales earn what changes in time, and of which orders other than usual cost something."""
    earns = Series(times=tuple(np.arange(6.0)), values=(*(-price), 0.0), interpolation="step")
    sale = Arc(id="sale", donor="store", recipient="market", law=Law.CONTROLLED, control=ORDER)
    network = small({"store": stock, "market": 0.0}, [sale])
    return replace(network, arcs=(replace(sale, accounts={"cost": earns}, effort={"cost": effort}),), accounts=COST)


def of_kind(kind: str) -> tuple[Network, float, float]:
    """Return a network in which a control of some kind moves 1 a day by default, with its neutral and highest value."""
    control = Control(kind=ControlKind.RATE, low=0.0, neutral=0.5, high=2.0)
    out = Arc(id="out", donor="store", recipient="sink", rate=0.02)
    if kind == "rate":
        return small({"store": 100.0, "sink": 0.0}, [replace(out, control=control)]), 0.5, 2.0
    if kind == "valve":
        network = small({"store": 100.0, "sink": 0.0}, [out, replace(out, id="other", rate=0.01)])
        nodes = (replace(network.nodes[0], control=control), network.nodes[1])
        return replace(network, nodes=nodes), 0.5, 2.0
    if kind == "order_behind_valve":
        order = replace(out, law=Law.CONTROLLED, rate=0.0, control=replace(ORDER, low=1.0, neutral=1.0, high=3.0))
        network = small({"store": 100.0, "sink": 0.0}, [order])
        nodes = (replace(network.nodes[0], control=control), network.nodes[1])
        return replace(network, nodes=nodes), 0.5, 2.0
    if kind == "schedule":
        known = replace(out, law=Law.EXOGENOUS, rate=0.0, flow=2.0, control=control)
        return small({"store": 100.0, "sink": 0.0}, [known]), 0.5, 2.0
    share = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.1, high=1.0)  # whose neutral action rounds
    network = small({"store": 100.0, "sink": 0.0, "dump": 0.0}, [])
    market = Node(id="market", stores=False)
    arcs = (
        replace(out, recipient="market", law=Law.EXOGENOUS, rate=0.0, flow=2.0),
        Arc(id="back", donor="market", recipient="sink", law=Law.SHARE, control=share),
        Arc(id="rest", donor="market", recipient="dump", law=Law.SHARE),
    )
    return replace(network, nodes=(*network.nodes, market), arcs=arcs), 0.1, 1.0


KINDS = ("rate", "valve", "order_behind_valve", "schedule", "share")


def charged(network: Network, effort: Any = 2.0, agent: int = 0) -> Network:
    """Return a network in which the control of an agent, the first, costs its effort."""
    id_ = network.agents[agent]
    parts: list[Any] = [
        tuple(replace(part, effort={"cost": effort}) if part.id == id_ else part for part in kind)
        for kind in (network.nodes, network.arcs)
    ]
    return replace(network, nodes=parts[0], arcs=parts[1], accounts=COST)


@pytest.mark.parametrize("kind", KINDS)
def test_efforts_are_booked_by_distance(kind: str) -> None:
    """e·|u − n|·h, whatever flows; nothing while nobody acts, not even by rounding; e may change in time."""
    network, neutral, high = of_kind(kind)
    steps = Series(times=(0.0, 2.0), values=(2.0, 3.0), interpolation="step")
    network = charged(network.with_options(episode={"control_interval": 1.0}), steps)
    env = MultiAgentVectorEnv(network, num_envs=3)
    env.reset(seed=0)
    agent = env.agents[0]
    low = float(network.control_bounds[0, 0, 0])
    for t in range(5):
        actions = env.neutral_action
        actions[agent] = np.array([[-1.0], [1.0], [actions[agent][2, 0]]])
        info = env.step(actions)[-1][agent]
        rate = 2.0 if t < 2 else 3.0
        np.testing.assert_allclose(
            info["accounts"]["cost"][:2], [rate * (neutral - low), rate * (high - neutral)], rtol=1e-12
        )
        assert info["accounts"]["cost"][2] == 0.0


def test_every_input_of_a_model_counts() -> None:
    """Of a model with several inputs the sum of their distances is charged."""
    network = load_network("solids_net")
    agent = "sorter"
    inputs = network.control_bounds[:, network.control_rows[agent], 0]
    env = MultiAgentVectorEnv(charged(network, 1.5), num_envs=2)
    env.reset(seed=0)
    actions = env.neutral_action | {agent: np.ones((2, inputs.shape[1]))}
    outcome = env.step(actions)[-1][agent]["accounts"]["cost"]
    length = network.episode.control_interval
    np.testing.assert_allclose(outcome, 1.5 * length * (inputs[2] - inputs[1]).sum(), rtol=1e-12)


def test_bounds_of_orders_are_exact() -> None:
    """Who earns less than the change costs stays neutral, of the others each goes to an end: by hand, and by programs.

    A plan and MPC find it too.
    """
    network = trade()
    sales = np.where(PRICE > 1.0, 10.0, np.where(PRICE < -1.0, 0.0, 2.0))
    optimum = float(PRICE @ sales - np.abs(sales - 2.0).sum())
    solved = bound(network, aim="cost")
    assert solved.objective == pytest.approx(optimum, abs=1e-6)
    assert solved.accounts[0] == pytest.approx(-optimum, abs=1e-6)
    assert solved.verify().bound == solved.objective
    np.testing.assert_allclose(simulate_plan(solved).flow[:, 0], sales, atol=1e-6)
    poor = replace(solved, actions=np.full_like(solved.actions, 0.3))
    climbed = simulate_plan(improve_plan(poor))
    assert -climbed.accounts[0, 0] == pytest.approx(optimum, abs=1e-6)
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), MPC(aim="cost", replan=2))
    assert -run.accounts[0, 0] == pytest.approx(optimum, abs=1e-4)
    for start in (100.0, 1000.0):
        assert float(solved.at([start, 0.0])) == pytest.approx(
            float(bound(network, [start, 0.0], aim="cost").objective)
        )


def test_a_budget_of_effort_is_spent_where_it_earns_most() -> None:
    """It is worth what the best change that it leaves out would earn."""
    accounts = (*COST, Account(id="work", unit="hour"))
    network = replace(trade(), accounts=accounts)
    network = replace(network, arcs=(replace(network.arcs[0], effort={"work": 1.0}),))
    kept = bound(network, aim="cost", at_most={"work": 11.0})
    sales = np.array([10.0, 2.0, 2.0, 0.0, 3.0])  # 8 + 2 + 1, by size of the price a unit of change
    assert kept.objective == pytest.approx(float(PRICE @ sales), abs=1e-6)
    assert kept.budget_prices["work"] == pytest.approx(1.5, abs=1e-6)
    assert kept.accounts[1] == pytest.approx(11.0, abs=1e-6)


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("wish", [1.0, -1.0])
def test_the_variable_of_an_effort_is_nearly_the_distance(kind: str, wish: float) -> None:
    """Of what moves as a control is told the program knows the distance, of a rate by the part that a stock keeps."""
    network, neutral, high = of_kind(kind)
    network = charged(network)
    flow = {"valve": "out", "share": "back"}.get(kind, network.arcs[0].id)
    arcs = tuple(replace(arc, accounts={"cost": -wish * 1e4} if arc.id == flow else {}) for arc in network.arcs)
    solved = bound(replace(network, arcs=arcs), aim="cost", agents=[network.agents[0]])
    layout, plan = solved.problem.layout, solved.solution.reshape(5, -1)
    assert layout.size == layout.effort + 1
    kept = plan[:, layout.stock].max(axis=1) / 100.0 if kind in ("rate", "valve") else np.ones(5)
    exact = high - neutral if wish > 0 else neutral - float(network.control_bounds[0, 0, 0])
    np.testing.assert_allclose(plan[:, layout.effort], exact * kept, rtol=1e-6)
    assert kept[0] > 0.98


def short_of_flow(reason: str) -> Network:
    """Return a network in which a control that asks for what is usual may get less."""
    order = Arc(id="out", donor="store", recipient="sink", law=Law.CONTROLLED, control=ORDER)
    if reason == "donor":
        return small({"store": 3.0, "sink": 0.0}, [order])
    if reason == "capacity":
        arc = replace(order, capacity_node="plant", capacity_rate=1.0)
        return small({"store": 1e3, "sink": 0.0, "plant": 0.5}, [arc])
    if reason == "market":
        feed = Arc(id="feed", donor="store", recipient="market", law=Law.EXOGENOUS, flow=1.0)
        rest = Arc(id="rest", donor="market", recipient="sink", law=Law.SHARE)
        network, market = small({"store": 1e3, "sink": 0.0}, [order]), Node(id="market", stores=False)
        return replace(network, nodes=(*network.nodes, market), arcs=(replace(order, donor="market"), feed, rest))
    network, *_ = of_kind("share")
    back, rest = network.arcs[1:]
    assert back.control is not None
    greedy = replace(back, control=replace(back.control, neutral=0.4))
    rival = replace(greedy, id="rival", recipient="dump", accounts={"cost": -1e3})
    return replace(network, arcs=(network.arcs[0], greedy, rival, rest), accounts=COST)


@pytest.mark.parametrize("reason", ["donor", "capacity", "market", "shares"])
def test_flows_that_are_less_than_asked_prove_no_effort(reason: str) -> None:
    """Who asks for what is usual pays nothing, however little comes: the bound must not charge for what is missing."""
    network = short_of_flow(reason)
    agent = network.agents[0]
    arcs = tuple(replace(arc, effort={"cost": 5.0} if arc.id == agent else {}) for arc in network.arcs)
    network = replace(network, arcs=arcs, accounts=COST)
    solved = bound(network, aim="cost")
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset()
    for _ in range(5):
        actions = {name: action if name == agent else np.ones((1, 1)) for name, action in env.neutral_action.items()}
        amounts = env.step(actions)[-1][agent]
    asked = network.control_bounds[1, 0, 0] * (2.0 if reason == "shares" else 1.0)
    assert amounts["flows"][0, network.arc_index[agent]] < 0.9 * asked
    assert -solved.objective <= float(amounts["episode_accounts"]["cost"][0]) + 1e-6


@given(network=substances_networks, seed=st.integers(0, 1000))
@pytest.mark.slow
def test_no_episode_with_substances_books_less_than_the_bound(network: Network, seed: int) -> None:
    """Shares of single substances, sorting, and orders that carry what the donor has."""
    _no_episode_is_below(network, seed)


@pytest.mark.medium
@given(seed=st.integers(0, 10_000), nodes=st.integers(2, 6), arcs=st.integers(1, 12), lifetimes=st.booleans())
def test_no_episode_of_some_agents_books_less_than_the_bound(seed: int, nodes: int, arcs: int, lifetimes: bool) -> None:
    """Where the others stay neutral; efforts alone are booked, so that nothing hides what they count."""
    network = random_network(seed, nodes, arcs, lifetimes=lifetimes)
    _no_episode_is_below(network, seed)


def _no_episode_is_below(network: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    network = booked(bounded(network, float(rng.uniform(0.05, 0.5))).network, seed)
    agents = [agent for agent in network.agents if rng.random() < 0.7]
    if not any(network.compartments[agent].effort for agent in agents):
        return  # to assume some would be too much for what draws networks
    nodes = tuple(replace(node, accounts={}, holding={}) for node in network.nodes)
    network = replace(network, nodes=nodes, arcs=tuple(replace(arc, accounts={}) for arc in network.arcs))
    weights = {"circularity": 1.0, "cost": float(rng.choice([0.01, 1.0]))}
    best = bound(network, network.initial[1], aim=weights, agents=agents)
    env = MultiAgentVectorEnv(pinned(best), num_envs=32, agents=agents)
    env.reset(seed=seed)
    entries = len(env.actuators.control_rows)
    circularity = np.zeros(32)
    constant, moves = rng.choice([-1.0, 1.0], (entries, 32)), rng.random((entries, 32)) < np.linspace(0, 1, 32)
    for _ in range(network.episode.horizon):
        actions = np.where(moves, constant, env.stack(env.neutral_action))
        circularity += env.advance(actions).circularity_mean / network.episode.horizon
    values = best.aims.objective(circularity, env.physical.accounts)
    size = float(abs(best.problem.cost) @ np.maximum(abs(best.problem.low), abs(best.problem.high)))
    assert (values <= best.objective + 1e-9 * max(size, 1.0)).all()


def test_the_gradient_is_0_where_a_control_is_neutral() -> None:
    """On either side of it the sign times what a unit of action moves, discounted or not; by a drawn rate the sum."""
    network = replace(trade(price=np.zeros(5)), uncertain={"arcs.sale.effort.cost": Spread(deviation=0.2)})
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    env.reset(seed=0)
    factor = env.physical.factors[0]
    neutral = float(env.neutral_action["sale"][0, 0])
    actions = np.tile(np.array([-0.9, neutral, 0.4]), (5, 1, 1))
    result = gradient(env, actions, circularity=0.0, accounts=1.0)
    np.testing.assert_allclose(result.actions[:, 0], np.tile([-5.0, 0.0, 5.0] * factor, (5, 1)))
    np.testing.assert_allclose(result.draws[0], 5 * np.array([1.5, 0.0, 5.0]))
    network = replace(network, uncertain={"arcs.sale.control": Spread(deviation=0.2)})
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    env.reset(seed=0)
    result = gradient(env, actions, circularity=0.0, accounts=1.0)  # a draw multiplies all three values
    np.testing.assert_allclose(result.draws[0], 5 * np.array([1.5, 0.0, 5.0]), atol=1e-12)


@pytest.mark.parametrize("path", ["arcs.sale.effort.cost", "arcs.sale.control"])
def test_draws_and_disturbances_of_efforts(path: str) -> None:
    """Each copy books what the network that it drew books; the neutral value may be drawn as well."""
    regime = Markov(values=(1.0, 3.0), matrix=((0.5, 0.5), (0.5, 0.5)))
    network = replace(
        trade(),
        uncertain={path: Spread(low=0.5, high=1.0, distribution="uniform")},
        disturbances={"wage": regime},
        disturbed={"arcs.sale.effort.cost": DisturbanceEffect(by="wage")},
    )
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    run = rollout(env, _Constant())
    for copy in range(3):
        lone = MultiAgentVectorEnv(env.certain_network(copy), num_envs=1)
        again = rollout(lone, _Constant())
        np.testing.assert_allclose(again.accounts[0], run.accounts[copy], rtol=1e-12)
    assert len(set(run.accounts[:, 0].tolist())) == 3


class _Constant(Neutral):
    """All controls half way up."""

    def act(self, observations: Any) -> Any:
        """Return the actions."""
        return {agent: np.full((len(each), 1), 0.5) for agent, each in observations.items()}


@pytest.mark.slow
def test_expected_efforts_have_budgets() -> None:
    """Who may change little earns less in expectation; nobody who keeps it earns more than is proved."""
    disturbances = {"wage": Markov(values=(0.5, 1.5), matrix=((0.5, 0.5), (0.5, 0.5)))}
    out = Arc(id="out", donor="mine", recipient="store", law=Law.CONTROLLED, control=ORDER, effort={"cost": 1.0})
    network = small({"mine": 1000.0, "store": 0.0}, [replace(out, effort={})])
    nodes = (replace(network.nodes[0], role=Role.NONRENEWABLE_RESERVOIR), network.nodes[1])
    effect = {"arcs.out.effort.cost": DisturbanceEffect(by="wage")}
    parts: dict[str, Any] = {"nodes": nodes, "arcs": (out,), "accounts": COST}
    network = replace(network, **parts, disturbances=disturbances, disturbed=effect)
    sampling = Sampling(draws=16, fit_draws=16)
    free, kept = (bound(network, at_most=most, uncertain=sampling) for most in (None, {"cost": 2.0}))
    assert free.value == pytest.approx(0.0, abs=1e-6)
    # 2 are moved as usual; at most 2 EUR buy 4 tonnes less where a change costs 0.5 EUR
    assert -2.0 < kept.value <= -(10.0 - 4.0) / 5 + 0.1
    assert "expected cost at most 2 EUR_2023" in str(kept)


def test_steps_of_plans_know_the_kinks() -> None:
    """The program of a step has what efforts change by, beyond the neutral value as well as before it."""
    network = charged(of_kind("rate")[0])
    service = Service(id="flow", provider="out", quantity="flow", low=1.0)
    network = replace(network, services=(service,))
    solved = bound(network, aim="cost", min_service=0.1)
    middle, program, moves, run, _ = small_step(solved, 0.1)
    assert program.columns.part.shape == (5, 1)
    for share in (0.5, 2.0):
        target = middle.actions + share * (-0.5 - middle.actions)  # −0.5 is neutral
        trial = simulate_plan(replace(middle, actions=np.clip(target, -1.0, 1.0)))
        changes = np.abs(np.clip(target, -1, 1) + 0.5) - np.abs(middle.actions + 0.5)
        moves[program.columns.action], moves[program.columns.part] = np.clip(target, -1, 1) - middle.actions, changes
        assert program.problem.cost @ moves == pytest.approx(trial.accounts[0, 0] - run.accounts[0, 0], abs=1e-9)
        inside = program.problem.under @ moves - program.problem.under_to
        rows = abs(program.problem.under[:, program.columns.part.ravel()]).sum(axis=1) > 0
        assert (inside[rows] <= 1e-9).all() and inside[rows].max() == pytest.approx(0.0, abs=1e-9)


def test_networks_without_efforts_have_the_same_programs() -> None:
    """No variable and no row is added, and one whose control nobody uses has none either."""
    network = of_kind("rate")[0]
    free = bound(replace(network, accounts=COST))
    assert free.problem.layout.effort == free.problem.layout.size
    priced, shares = charged(network), of_kind("share")[0]
    others = [Arc(id="more", donor="store", recipient="sink", law=Law.CONTROLLED, control=ORDER)]
    both = replace(priced, arcs=(*priced.arcs, *others))
    assert bound(both, agents=["more"]).problem.layout.effort == bound(both, agents=["more"]).problem.layout.size
    assert bound(both).problem.layout.charged_controls == ("out",) and shares.agents == ("back",)


def test_tables_say_whose_effort_it_is() -> None:
    """Beside what flows there is a row of the same compartment, and both sum to the account."""
    simulation = simulate(charged(of_kind("rate")[0]), "random", steps=5)
    table = accounts_table(simulation)
    assert "out" in str(table)
    assert simulation.rollout.entries.sum() == pytest.approx(simulation.rollout.bookings[0].sum())


def test_files_state_efforts_in_units_of_the_control(tmp_path: Path) -> None:
    """A flow for a time is a mass; a rate, a share and what has no unit is charged by time alone."""
    file = tmp_path / "trade.toml"
    write_network(replace(trade(), mass_unit="kt", time_unit="year"), file)
    text = file.read_text(encoding="utf-8")
    stated = 'effort = {cost = {value = 1.0, unit = "(EUR_2023)/(((kt)/(year))*(year))"'
    assert stated in text
    assert load_network(file).arcs == replace(trade(), mass_unit="kt", time_unit="year").arcs
    for unit, factor in (("EUR_2023/t", 1e3), ("kEUR_2023/(kt/day)/day", 1e3), ("EUR_2023/(Mt/year*year)", 1e-3)):
        changed = f'effort = {{cost = {{value = 1.0, unit = "{unit}"'
        file.write_text(text.replace(stated, changed), encoding="utf-8")
        assert dict(load_network(file).arcs[0].effort)["cost"] == pytest.approx(factor)
    file.write_text(text.replace(stated, 'effort = {cost = {value = 1.0, unit = "EUR_2023/year"'), encoding="utf-8")
    with pytest.raises(CirlError, match=r"arcs\.sale\.effort\.cost: unit 'EUR_2023/year' is inconsistent"):
        load_network(file)
    for kind in KINDS:
        network = replace(charged(of_kind(kind)[0]), time_unit="year")
        write_network(network, file)
        again = load_network(file)
        assert (again.arcs, again.nodes) == (network.arcs, network.nodes)
    model = charged(load_network("solids_net"), 1.5, agent=1)
    write_network(model, file)
    assert 'unit = "(EUR_2023)/((kJ/min)*(s))"' in file.read_text(encoding="utf-8")
    assert load_network(file).compartments == model.compartments


def test_efforts_that_cannot_be_meant_are_refused() -> None:
    """Without a control, of what makes up for a service, of an unknown account, less than nothing."""
    network = trade()
    (sale,) = network.arcs
    service = Service(id="sold", provider="sale", quantity="flow", low=1.0)
    for change, message in (
        ({"control": None, "law": Law.DONOR, "rate": 0.1}, "arc 'sale': effort: it has no control"),
        ({"makes_up_for": "sold"}, "arc 'sale': effort: what it supplies to make up for 'sold' is neutral"),
        ({"effort": {"costs": 1.0}}, "arc 'sale': effort: unknown account 'costs'. Did you mean 'cost'"),
        ({"effort": {"cost": -1.0}}, "arc 'sale': effort.cost -1.0 must be finite and not negative"),
    ):
        with pytest.raises(NetworkError, match=message):
            replace(network, arcs=(replace(sale, **change),), services=(service,))
    much: Any = {"cost": "much"}
    with pytest.raises(NetworkError, match="effort must be 'cost': a number, got 'much'"):
        replace(sale, effort=much)
    assert ACCOUNTS[0].id == "cost"


def test_efforts_of_a_window_are_those_of_the_episode_there() -> None:
    """What a step changes is measured from the plan's own intervals, whose ranges change from year to year."""
    network = trade()
    order = replace(
        ORDER,
        neutral=Series(times=(0.0, 2.0, 4.0), values=(1.0, 3.0, 2.0), interpolation="step"),
        high=Series(times=(0.0, 3.0), values=(8.0, 12.0), interpolation="step"),
    )
    network = replace(network, arcs=(replace(network.arcs[0], control=order),))
    steps = network.episode.horizon
    actions = np.random.default_rng(0).uniform(-1.0, 1.0, (steps, len(network.agents)))
    is_charged = np.asarray(Ledger(network).rates()[2].any(axis=(0, 1)))
    parts = []
    for first, last in ((0, steps), (2, 5)):
        plan = SimpleNamespace(network=network, agents=network.agents, actions=actions[first:last])
        parts.append(Efforts.of(cast(ActionPlan, plan), is_charged, first))
    whole, window = parts
    assert whole.away.std() > 0 and whole.half.std(axis=0).max() > 0
    np.testing.assert_array_equal(window.away, whole.away[2:5])
    np.testing.assert_array_equal(window.half, whole.half[2:5])
