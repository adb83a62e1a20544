"""Plants, fleets and other stocks that limit what flows: motion, bounds, plans, gradients, files and messages."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.optimize import linprog

from cirl_marl import (
    MPC,
    Account,
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    Role,
    Series,
    Service,
    Substance,
    load_network,
    parallel_env,
    simulate,
    write_network,
)
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.uncertainty import Spread
from cirl_marl.optimum import bound, improve_plan, simulate_plan
from cirl_marl.report.terminal import law_text

ORDER = Control(kind=ControlKind.FLOW, low=0.0, neutral=10.0, high=10.0)
YEARS = 30
GROWTH = Series(times=(0.0, 30.0), values=(3.0, 20.0), interpolation="linear")
TECHNOLOGIES = {"old": (10, 4.0, 100.0, 30.0), "new": (15, 0.0, 300.0, 6.0)}
"""Life, capacity at the start, what a unit of capacity costs, and what a unit made with it costs."""


def power(years: int = YEARS, in_stages: bool = False, available: Series | float = 1.0) -> Network:
    """Return two technologies, whose capacity is built and retires, that meet a demand together."""
    nodes = [Node(id="makers", initial=(1e4, 1e4)), Node(id="retired", initial=(0.0, 0.0))]
    nodes += [Node(id="market", stores=False), Node(id="fuel", initial=(1e5, 1e5), role=Role.NONRENEWABLE_RESERVOIR)]
    nodes += [Node(id="used", initial=(0.0, 0.0))]
    arcs = [Arc(id="use", donor="market", recipient="used", law=Law.SHARE)]
    for name, (life, held, to_build, to_run) in TECHNOLOGIES.items():
        lifetime = Lifetime(mean=life, deviation=life / 3) if in_stages else Lifetime(mean=life, distribution="fixed")
        nodes.append(Node(id=name, lifetime=lifetime, initial=(held, held)))
        arcs += [
            Arc(id=f"build_{name}", donor="makers", recipient=name, law=Law.CONTROLLED, control=replace(ORDER)),
            Arc(id=f"retire_{name}", donor=name, recipient="retired", law=Law.SHARE),
            Arc(
                id=f"run_{name}",
                donor="fuel",
                recipient="market",
                law=Law.CONTROLLED,
                control=replace(ORDER, high=30.0),
                capacity_node=name,
                capacity_rate=available if name == "old" else 1.0,
            ),
        ]
        arcs[-3] = replace(arcs[-3], accounts={"cost": to_build})
        arcs[-1] = replace(arcs[-1], accounts={"cost": to_run})
    return Network(
        name="power",
        nodes=tuple(nodes),
        arcs=tuple(arcs),
        episode=Episode(control_interval=1.0, horizon=years),
        time_unit="year",
        services=(Service(id="demand", provider="use", quantity="flow", low=GROWTH),),
        accounts=(Account(id="cost", unit="EUR_2023", discount=0.05),),
    )


def least_cost(available: Series | float = 1.0) -> float:
    """Return the least cost of meeting the demand, by a linear program of builds and outputs written by hand."""
    names, steps = [*TECHNOLOGIES], YEARS
    size = len(names) * steps
    cost, discount = np.zeros(2 * size), 1.05 ** -(np.arange(steps) + 0.5)
    under, limits = np.zeros((size + steps, 2 * size)), np.zeros(size + steps)
    network = power()
    demand, rates = network.interval_means(GROWTH), [network.interval_means(available), np.ones(steps)]
    for n, (life, held, to_build, to_run) in enumerate(TECHNOLOGIES.values()):
        for t in range(steps):
            built, made, row = n * steps + t, size + n * steps + t, n * steps + t
            cost[built], cost[made] = discount[t] * to_build, discount[t] * to_run
            under[row, made] = 1.0  # output ≤ what was built in the last life + what is left of the start
            for s in range(max(0, t - life), t):
                under[row, n * steps + s] = -rates[n][t]
            limits[row] = rates[n][t] * held * max(0.0, 1 - t / life)  # its ages are spread evenly over a life
            under[size + t, made] = -1.0
    limits[size:] = -demand
    bounds = [(0, 10.0)] * size + [(0, 30.0)] * size
    found = linprog(cost, A_ub=under, b_ub=limits, bounds=bounds, method="highs")
    assert found.success
    return float(found.fun)


@pytest.mark.parametrize(("life", "years", "interest"), [(15, 10, 0.05), (7, 7, 0.1), (20, 3, 0.02)])
def test_an_annuity_on_what_is_held_is_the_investment_less_its_salvage(life: int, years: int, interest: float) -> None:
    """By hand: a plant built before the start costs, until the end, I less what is left of its annuities then.

    Amounts of a year count in its middle, so that the total is that of annuities at ends of years times √(1 + i).
    """
    investment, units = 1000.0, 2.0
    annuity = investment * interest / (1 - (1 + interest) ** -life)
    plant = Node(id="plant", initial=(units, units), holding={"cost": annuity})
    arc = Arc(id="build", donor="makers", recipient="plant", law=Law.CONTROLLED, control=replace(ORDER, neutral=0.0))
    network = Network(
        name="annuity",
        nodes=(Node(id="makers", initial=(9.0, 9.0)), plant),
        arcs=(arc,),
        episode=Episode(control_interval=1.0, horizon=years),
        time_unit="year",
        accounts=(Account(id="cost", unit="EUR_2023", discount=interest),),
    )
    total = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral()).accounts[0, 0]
    left = sum(annuity / (1 + interest) ** year for year in range(1, life - years + 1))
    by_hand = units * (investment - left / (1 + interest) ** years)
    assert total == pytest.approx(by_hand * (1 + interest) ** 0.5, rel=1e-12)


@pytest.mark.parametrize("available", [1.0, Series(times=(0.0, 12.0, 20.0), values=(1.0, 0.6, 0.9))])
@pytest.mark.sample(1)
def test_least_cost_of_two_technologies_is_that_of_a_program_by_hand(available: Series | float) -> None:
    """Built, aged, retired and run as a linear program of two technologies over 30 years has it, to 1e-6."""
    found = bound(power(available=available), aim="cost", min_service=1.0)
    least = least_cost(available)
    assert found.accounts[0] == pytest.approx(least, rel=1e-6)
    run = simulate_plan(improve_plan(found))
    assert run.episode_levels.min() > 1 - 2e-3
    assert run.accounts[0, 0] == pytest.approx(least, rel=3e-3)


@pytest.mark.parametrize(("horizon", "regret"), [(None, 0.0), (5, 0.0), (2, 0.0014)])
@pytest.mark.sample(1)
def test_who_sees_a_window_pays_little_more(horizon: int | None, regret: float) -> None:
    """What a window leaves is priced by the plan of the episode, so that its cost is close to that of foresight."""
    env = MultiAgentVectorEnv(power(), num_envs=1)
    run = rollout(env, MPC(horizon=horizon, replan=1, aim="cost", min_service=1.0))
    assert run.episode_levels.min() > 1 - 1e-6
    assert run.accounts[0, 0] / least_cost() - 1 == pytest.approx(regret, abs=2e-4)


@pytest.mark.parametrize("in_stages", [False, True])
def test_what_is_built_serves_from_the_next_interval_on(in_stages: bool) -> None:
    """Who orders more than there is capacity for gets c·x of the start of the interval, of a life in stages too."""
    env = MultiAgentVectorEnv(power(in_stages=in_stages), num_envs=1)
    env.reset(seed=0)
    assert env.physical.flow[env.network.arc_index["run_old"], 0] == pytest.approx(4.0)  # as it is seen at the start
    run = rollout(env, Neutral())
    stock, flow = run.stock[:, [env.network.node_index[name] for name in TECHNOLOGIES]], run.flow
    made = flow[:, [env.network.arc_index[f"run_{name}"] for name in TECHNOLOGIES]]
    start = np.array([[4.0, 0.0], *stock[:-1]])
    np.testing.assert_allclose(made, np.minimum(start, 10.0), rtol=1e-12, atol=1e-12)
    assert made[0, 1] == 0.0 < made[1, 1] <= 10.0 == made[-1, 1]
    assert made[0, 0] == pytest.approx(4.0)


def test_a_plant_is_no_lack_of_its_donor(tmp_path: Path) -> None:
    """Tables say what limits a flow; nobody is told that a donor held too little where the plant was too small."""
    text = str(simulate(power(), control="neutral"))
    assert "held too little" not in text
    assert law_text(power(), power().arcs[3]) == "u ≤ 1 x(old)"
    changing = power(available=Series(times=(0.0, 9.0), values=(1.0, 0.5)))
    assert law_text(changing, changing.arcs[3]) == f"u ≤ {changing.arcs[3].capacity_rate:g} x(old)"


def test_agents_see_what_limits_them(tmp_path: Path) -> None:
    """Who orders sees the stock that limits it, who builds and sees its neighbours what is limited; so do files."""
    network = power()
    write_network(network, tmp_path / "power.toml")
    again = load_network(tmp_path / "power.toml")
    assert [(arc.capacity_node, arc.capacity_rate) for arc in again.arcs] == [
        (arc.capacity_node, arc.capacity_rate) for arc in network.arcs
    ]
    names = parallel_env(again, observe="local").unwrapped.observation_names
    assert "stock of old" in names["run_old"] and "stock of new" not in names["run_old"]
    near = parallel_env(again, observe="neighbours").unwrapped.observation_names
    assert "flow of run_new" in near["build_new"]


def test_uncertain_capacity_rates_are_drawn() -> None:
    """What an episode carries is what its own draw lets it carry, and the bound of the draw holds."""
    spread = Spread(low=0.5, high=1.0, distribution="uniform")
    network = replace(power(), uncertain={"arcs.run_old.capacity_rate": spread})
    env = MultiAgentVectorEnv(network, num_envs=2, uncertain=True)
    run = rollout(env, Neutral())
    factor = float(env.physical.factors[0, 0])
    assert 0.5 < factor < 0.99
    assert run.flow[0, network.arc_index["run_old"]] == pytest.approx(4.0 * factor)


def test_all_substances_are_limited_by_the_same_draw() -> None:
    """What is no substance and each substance, of a source that gives what is stated: as in the network of the draw."""
    stated = {"sulphur": Series(times=(0.0, float(YEARS)), values=(0.1, 0.3), interpolation="linear")}
    plain, substances = power(), (Substance(id="sulphur"),)
    nodes = tuple(replace(node, content=stated) if node.id == "fuel" else node for node in plain.nodes)
    spread = Spread(low=0.5, high=1.0, distribution="uniform")
    path = "arcs.run_old.capacity_rate"
    network = replace(plain, nodes=nodes, substances=substances, uncertain={path: spread})
    env = MultiAgentVectorEnv(network, num_envs=2, uncertain=True)
    env.reset(seed=3)
    lone = MultiAgentVectorEnv(env.certain_network(1), num_envs=1)
    lone.reset(seed=4)
    actions = len(env.actuators.control_rows)
    for _ in range(6):
        drawn, certain = (each.advance(np.ones((actions, each.num_envs))) for each in (env, lone))
        np.testing.assert_allclose(drawn.flow[:, 1], certain.flow[:, 0], rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(env.physical.substances[:, 1], lone.physical.substances[:, 0], rtol=1e-9, atol=1e-9)
    assert (lone.physical.substances > 0).any()


@pytest.mark.parametrize(
    ("arc", "change", "message"),
    [
        ("run_old", {"capacity_node": "od"}, "capacity_node: unknown node with a stock 'od'.*Did you mean 'old'"),
        ("run_old", {"capacity_node": "market"}, "capacity_node: unknown node with a stock 'market'"),
        ("run_old", {"capacity_node": ""}, "capacity_rate: no stock limits it; name its node, capacity_node"),
        ("run_old", {"capacity_rate": 0.0}, "capacity_node: it needs a capacity_rate above 0"),
        ("run_old", {"capacity_rate": -1.0}, "capacity_rate -1.0 must be finite and not negative"),
        (
            "run_old",
            {"makes_up_for": "demand"},
            "capacity_node: what makes up for a service has the bounds of its control",
        ),
        (
            "retire_old",
            {"capacity_node": "new", "capacity_rate": 1.0},
            "needs law 'controlled', not 'share'.*not be linear",
        ),
    ],
)
def test_capacities_that_cannot_be_meant_are_refused(arc: str, change: dict[str, Any], message: str) -> None:
    """Named are the arc, the field and what to write."""
    network = power()
    arcs = [replace(each, **change) if each.id == arc else each for each in network.arcs]
    with pytest.raises(NetworkError, match=f"(?s)arc '{arc}'.*{message}"):
        replace(network, arcs=tuple(arcs))


@pytest.mark.parametrize(
    ("law", "reason"), [(Law.DONOR, "would not be linear in stocks"), (Law.BATCH, "leaves at once")]
)
def test_only_orders_have_capacities(law: Law, reason: str) -> None:
    """What flows in proportion to a stock, and what leaves in batches, is refused, each with its reason."""
    arc = Arc(id="out", donor="plant", recipient="sink", law=law, rate=0.1, capacity_node="plant", capacity_rate=1.0)
    nodes = tuple(Node(id=id_, initial=(1.0, 1.0)) for id_ in ("plant", "sink"))
    with pytest.raises(NetworkError, match=f"capacity_node needs law 'controlled', not '{law}': .*{reason}"):
        Network(name="plants", nodes=nodes, arcs=(arc,))
