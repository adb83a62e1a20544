"""Substances: what is in stocks and flows, how nodes separate it, and what services demand of it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import random_network, with_substances
from hypothesis import assume, given
from hypothesis import strategies as st

from benchmarks.variants import without_substances
from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlKind,
    DefinitionError,
    Episode,
    Law,
    Network,
    NetworkError,
    Node,
    Role,
    Service,
    Substance,
    bound,
    explain,
    gradient,
    load_network,
)
from cirl_marl.definitions.writer import definition_of
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect
from cirl_marl.network.elements import FIXED_LIFETIME, Lifetime
from cirl_marl.network.series import Series, extremes
from cirl_marl.network.uncertainty import Spread, draw_network
from cirl_marl.network.validation.content_limits import limit_problems

substances_networks = st.builds(
    lambda seed, nodes, arcs, lifetimes: with_substances(random_network(seed, nodes, arcs, lifetimes=lifetimes), seed),
    st.integers(0, 2**32 - 1),
    st.integers(2, 12),
    st.integers(1, 20),
    st.booleans(),
)
EXAMPLE = Path(__file__).parent.parent / "examples" / "copper_in_steel.toml"
COPPER = (Substance(id="copper", scale=0.01),)
TIN = Substance(id="tin")


def rollout_of(network: Network, copies: int, seed: int) -> tuple[MultiAgentVectorEnv, list[np.ndarray]]:
    """Return an environment at the end of an episode of random actions, and its masses after each interval."""
    env = MultiAgentVectorEnv(network, num_envs=copies)
    env.reset(seed=seed)
    rng, stocks = np.random.default_rng(seed), [env.physical.stock]
    for _ in range(network.episode.horizon):
        entries = len(env.actuators.control_rows)
        env.advance(np.repeat(rng.uniform(-1, 1, (entries, 1)), copies, axis=1))
        stocks.append(env.physical.stock)
    return env, stocks


@given(network=substances_networks, seed=st.integers(0, 1000))
def test_every_substance_is_conserved_and_within_the_whole(network: Network, seed: int) -> None:
    """Each is conserved to 1e-12 of its mass, none is negative, and together they are at most the whole."""
    env, stocks = rollout_of(network, 2, seed)
    rows, count = env.rows, len(network.substances)
    for masses in stocks:
        parts = rows.substances(masses).reshape(count, -1, 2)
        before = rows.substances(stocks[0]).reshape(count, -1, 2)
        np.testing.assert_allclose(parts.sum(axis=1), before.sum(axis=1), rtol=1e-12)
        assert parts.min() >= 0
        assert (parts.sum(axis=0) <= rows.stocks(masses) * (1 + 1e-12)).all()
    whole = [rows.stocks(masses).sum() for masses in stocks]
    np.testing.assert_allclose(whole, whole[0], rtol=1e-12)
    for agent, observation in env.observations().items():
        space = env.observation_spaces[agent]
        assert ((observation >= space.low) & (observation <= space.high)).all()


@pytest.mark.parametrize(("mass", "level"), [(0.0, 1.0), (100.0, 0.02 / 0.05)])
def test_a_grade_is_kept_where_there_is_nothing(mass: float, level: float) -> None:
    """Ore of 2 % where 5 % are asked for has a level of 0.4; where nothing flows the level is 1."""
    network = sorting_line(transfer=0.1)
    grade = Service(id="grade", provider="scrapping", quantity="flow", substance="copper", low=0.05)
    nodes = (replace(network.nodes[0], initial=(mass, mass)), *network.nodes[1:])
    env, _ = rollout_of(replace(network, nodes=nodes, services=(grade,)), 1, 0)
    assert env.physical.service[0, 0] == pytest.approx(level, rel=1e-12)


@given(network=substances_networks, seed=st.integers(0, 1000))
def test_balances_of_each_node_hold_for_each_substance(network: Network, seed: int) -> None:
    """What a stock gains of a substance in an interval is what flows in less what flows out, in flows of infos."""
    env = MultiAgentVectorEnv(network, num_envs=2)
    env.reset(seed=seed)
    before, length, stores = env.physical.stock, network.episode.control_interval, len(network.stores)
    outcome = env.advance(np.zeros((len(env.actuators.control_rows), 2)))
    info = env.team_info(outcome)
    incidence = np.zeros((len(network.nodes), len(network.arcs)))
    incidence[network.recipients, np.arange(len(network.arcs))] += 1
    incidence[network.donors, np.arange(len(network.arcs))] -= 1
    size = 1e-9 + env.rows.stocks(before).sum()
    for i, substance in enumerate(network.substances):
        held = [
            env.rows.substances(m).reshape(len(network.substances), stores, 2)[i] for m in (before, env.physical.stock)
        ]
        change = incidence @ info["substances"][substance.id].T * length
        np.testing.assert_allclose(change[:stores], held[1] - held[0], atol=1e-11 * size)
        np.testing.assert_allclose(change[stores:], 0.0, atol=1e-11 * size)
        assert (info["substances"][substance.id] <= info["flows"] * (1 + 1e-9) + 1e-12 * size).all()


@given(network=substances_networks, seed=st.integers(0, 1000))
def test_a_substance_that_is_nowhere_separated_changes_nothing(network: Network, seed: int) -> None:
    """Without separation the whole moves as it does without substances."""
    plain = without_substances(network)
    env, unseparated = rollout_of(replace(network, arcs=plain.arcs), 1, seed)
    other, masses = rollout_of(plain, 1, seed)
    size = float(other.rows.stocks(masses[0]).sum())
    for left, right in zip(unseparated, masses, strict=True):
        np.testing.assert_allclose(env.rows.stocks(left), other.rows.stocks(right), atol=1e-11 * size)


@given(network=substances_networks, seed=st.integers(0, 1000))
def test_derivatives_are_those_of_differences(network: Network, seed: int) -> None:
    """Exact gradients of λ̄ and levels, contents among them, by actions agree with central differences."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=seed)
    rng, entries = np.random.default_rng(seed), len(env.actuators.control_rows)
    assume(entries)
    weights = rng.uniform(0.5, 1.5, len(network.services))
    scale = network.objective.circularity_scale

    def value(actions: np.ndarray) -> float:
        found = gradient(env, actions, circularity=1 / scale, levels=weights)
        return float(found.circularity[0] / scale + weights @ found.levels[:, 0])

    actions = rng.uniform(-0.8, 0.8, (network.episode.horizon, entries, 1))
    exact = gradient(env, actions, circularity=1 / scale, levels=weights).actions
    direction = rng.choice([-1.0, 1.0], actions.shape)
    slopes = [(value(actions + d * direction) - value(actions - d * direction)) / (2 * d) for d in (1e-4, 1e-5, 1e-6)]
    one_sided = [(value(actions + s * 1e-6 * direction) - value(actions)) / (s * 1e-6) for s in (1, -1)]
    assume(abs(one_sided[0] - one_sided[1]) <= 1e-3 * (1 + abs(one_sided[0])))  # no kink between the two sides
    error = min(abs(slope - float((exact * direction).sum())) for slope in slopes)
    assert error <= 1e-6 * (1.0 + float(np.abs(exact).sum()))


def stated(part: Arc | Node, name: str) -> bool:
    """Whether a number of an arc or a node is above 0 at some time."""
    value = getattr(part, name)
    return value is not None and extremes(value)[1] > 0


def can_stretch(node: Node) -> bool:
    """Whether a node has a lifetime whose length may be uncertain."""
    return node.lifetime is not None and node.lifetime.distribution != FIXED_LIFETIME


@given(network=substances_networks, seed=st.integers(0, 1000))
def test_draws_of_shares_and_transfers_are_networks(network: Network, seed: int) -> None:
    """An episode that drew shares, transfers and controls is, in all it moves, that of the network with these."""
    rng, spread = np.random.default_rng(seed), Spread(low=0.7, high=1.1, distribution="uniform")
    paths = [f"arcs.{arc.id}.transfer.{name}" for arc in network.arcs for name in dict(arc.transfer)]
    paths += [
        f"arcs.{arc.id}.{name}" for arc in network.arcs for name in ("share", "rate", "flow") if stated(arc, name)
    ]
    paths += [f"nodes.{node.id}.rate" for node in network.nodes if stated(node, "rate")]
    paths += [f"nodes.{node.id}.stretch" for node in network.nodes if can_stretch(node)]
    paths += [
        f"arcs.{arc.id}.control"
        for arc in network.arcs
        if arc.control is not None and arc.control.kind in (ControlKind.TRANSFER, ControlKind.SHARE)
    ]
    assume(paths)
    try:
        network = replace(network, uncertain={path: spread for path in paths if rng.random() < 0.7 or path == paths[0]})
    except NetworkError:
        assume(False)  # a rate on an arc that has none, or a loop that could keep what it gets
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    env.reset(seed=seed)
    actions = rng.uniform(-1, 1, (network.episode.horizon, len(env.actuators.control_rows)))
    middle = dict(zip([node.id for node in network.stores], network.initial.mean(axis=0).tolist(), strict=True))
    env.reset(seed=seed, options={"initial_state": middle})
    networks = [env.certain_network(copy) for copy in range(3)]
    for action in actions:
        env.advance(np.repeat(action[:, None], 3, axis=1))
    for copy, certain in enumerate(networks):
        alone = MultiAgentVectorEnv(certain, num_envs=1)
        alone.reset(seed=seed, options={"initial_state": middle})
        for action in actions:
            alone.advance(action[:, None])
        masses, expected = alone.physical.stock[:, 0], env.physical.stock[:, copy]
        np.testing.assert_allclose(masses, expected, rtol=1e-9, atol=1e-10 * expected.sum())


def test_contents_of_initial_stocks_are_drawn() -> None:
    """Each copy has its own, with a lifetime or not, and moves as the network that was drawn; masses are the same."""
    lifetime = Lifetime(mean=3.0, deviation=1.0, distribution="normal")
    network = Network(
        name="drawn",
        nodes=(
            Node(id="cars", initial=(40.0, 60.0), lifetime=lifetime, content={"copper": 0.1}),
            Node(id="scrap", initial=(10.0, 10.0), content={"copper": 0.2}),
            Node(id="sink", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="scrapped", donor="cars", recipient="scrap", law=Law.SHARE),
            Arc(id="lost", donor="scrap", recipient="sink", rate=0.3),
        ),
        substances=COPPER,
        uncertain={
            "nodes.cars.content.copper": Spread(low=0.5, high=2.0, distribution="uniform"),
            "nodes.scrap.content.copper": Spread(deviation=0.2),
        },
        mass_unit="t",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=4),
    )
    drawn, stated = (MultiAgentVectorEnv(network, num_envs=5, uncertain=uncertain) for uncertain in (True, False))
    for env in (drawn, stated):
        env.reset(seed=3)
    factors = drawn.physical.factors
    assert factors.shape == (2, 5) and (np.ptp(factors, axis=1) > 0.1).all()
    masses = drawn.rows.stocks(drawn.physical.stock)
    np.testing.assert_allclose(masses, stated.rows.stocks(stated.physical.stock), rtol=1e-12)
    content = drawn.rows.substances(drawn.physical.stock)[:2] / masses[:2]
    np.testing.assert_allclose(content, factors * np.array([[0.1], [0.2]]), rtol=1e-12)
    for copy in range(5):
        lone = MultiAgentVectorEnv(draw_network(network, factors[:, copy].tolist()), num_envs=1)
        lone.reset(options={"initial_state": dict(zip(("cars", "scrap"), masses[:2, copy].tolist(), strict=True))})
        np.testing.assert_allclose(lone.physical.stock[:, 0], drawn.physical.stock[:, copy], rtol=1e-12, atol=1e-15)
    for _ in range(4):
        drawn.advance(np.zeros((0, 5)))
    drawn.reset()  # the next draw
    assert not np.array_equal(drawn.physical.factors, factors)


def test_contents_that_no_stock_can_have_are_not_drawn() -> None:
    """Nor is it disturbed in time what is in a stock that others enter, or what a history was."""
    network, path = load_network(EXAMPLE), "nodes.wires.content.copper"
    with pytest.raises(
        NetworkError, match=r"some draws of its contents sum to 1\.5, more than 1: end its range, or 'high', lower"
    ):
        replace(network, uncertain={path: Spread(low=0.5, high=1.5, distribution="uniform")})
    ups = AutoRegression(mean=1.0, deviation=0.1, persistence=0.5, low=0.5, high=1.5)
    disturbed = {"nodes.scrap.content.copper": DisturbanceEffect(by="ups")}
    with pytest.raises(NetworkError, match="node 'scrap': content: arc 'shredded' enters it: a stock mixes what"):
        replace(network, disturbances={"ups": ups}, disturbed=disturbed)
    history = Series(times=(-30.0,), values=(10.0,))
    nodes = tuple(replace(node, history=history) if node.id == "cars" else node for node in network.nodes)
    disturbed = {"nodes.cars.content.copper": DisturbanceEffect(by="ups")}
    with pytest.raises(NetworkError, match="what is in a stock at the start cannot be disturbed in time, but drawn"):
        replace(network, nodes=nodes, disturbances={"ups": ups}, disturbed=disturbed)


def test_draws_of_releases_are_those_of_all_components() -> None:
    """What an episode drew of the rate of a stock holds for copper as for all else."""
    spread = Spread(low=0.5, high=1.5, distribution="uniform")
    network = replace(sorting_line(), uncertain={"nodes.use.rate": spread})
    env = MultiAgentVectorEnv(network, num_envs=2, uncertain=True)
    env.reset(seed=1)
    env.advance(np.zeros((0, 2)))
    left = 2.0 ** -env.physical.factors[0]
    np.testing.assert_allclose(env.rows.stocks(env.physical.stock)[0], 100 * left, rtol=1e-12)
    np.testing.assert_allclose(env.rows.substances(env.physical.stock)[0], 2 * left, rtol=1e-12)


def test_draws_of_a_control_leave_what_is_separated() -> None:
    """Where an uncertain control sets the share of all else, other arcs keep that of copper, drawn networks too."""
    network = sorting_line()
    scrapping, recovery, rejects = network.arcs
    control = Control(kind=ControlKind.SHARE, low=0.05, neutral=0.1, high=0.2)
    left = Arc(id="left", donor="shredder", recipient="waste", law=Law.SHARE, share=0.3)
    arcs = (scrapping, recovery, replace(rejects, share=None, control=control, transfer={"copper": 0.5}), left)
    spread = Spread(low=0.6, high=1.4, distribution="uniform")
    network = replace(network, arcs=arcs, uncertain={"arcs.rejects.control": spread})
    env = MultiAgentVectorEnv(network, num_envs=1, uncertain=True)
    env.reset(seed=4)
    certain = env.certain_network(0)
    env.advance(np.array([[0.5]]))
    alone = MultiAgentVectorEnv(certain, num_envs=1)
    alone.reset(seed=4)
    alone.advance(np.array([[0.5]]))
    np.testing.assert_allclose(alone.physical.stock, env.physical.stock, rtol=1e-12)
    assert env.rows.substances(env.physical.stock)[2, 0] == pytest.approx(0.5 + 0.3, rel=1e-12)


def test_draws_without_a_rest_sum_to_one() -> None:
    """Where every arc states its share of a substance, what was drawn is scaled to a whole."""
    network = sorting_line()
    scrapping, recovery, rejects = network.arcs
    arcs = (scrapping, replace(recovery, share=0.9, transfer={"copper": 0.2}), rejects)
    spread = Spread(low=0.5, high=1.5, distribution="uniform")
    network = replace(network, arcs=arcs, uncertain={"arcs.recovery.transfer.copper": spread})
    env = MultiAgentVectorEnv(network, num_envs=1, uncertain=True)
    env.reset(seed=3)
    factor = float(env.physical.factors[0, 0])
    certain = env.certain_network(0)
    env.advance(np.zeros((0, 1)))
    alone, masses = rollout_of(certain, 1, 3)
    rejected = 0.8 / (0.8 + 0.2 * factor)
    assert env.rows.substances(env.physical.stock)[2, 0] == pytest.approx(rejected, rel=1e-12)
    assert alone.rows.substances(masses[-1])[2, 0] == pytest.approx(rejected, rel=1e-12)


@given(network=substances_networks)
def test_definitions_read_back(network: Network, tmp_path_factory: pytest.TempPathFactory) -> None:
    """Contents, transfers and services of substances go to a file and back to the last bit."""
    path = tmp_path_factory.mktemp("substances") / "network.toml"
    strict = [service for service in network.services if any(service.id in fault for fault in limit_problems(network))]
    network = replace(network, services=tuple(service for service in network.services if service not in strict))
    path.write_text(definition_of(network))
    again = load_network(path)
    assert (again.substances, again.nodes, again.arcs) == (network.substances, network.nodes, network.arcs)
    assert again.services == network.services


def sorter(limit: float = 0.02, **service: Any) -> Network:
    """Return ore without copper and scrap with 4 % of it that make one product."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=2.0, high=10.0)
    place: dict[str, Any] = {"provider": "made", "quantity": "flow", "low": 0.001}
    return Network(
        name="sorter",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR, initial=(500.0, 500.0)),
            Node(id="scrap", initial=(100.0, 100.0), content={"copper": 0.04}),
            Node(id="melt", stores=False),
            Node(id="use", initial=(50.0, 50.0), rate=0.1, content={"copper": limit / 2}),
            Node(id="landfill", role=Role.LANDFILL),
        ),
        arcs=(
            Arc(id="mined", donor="ore", recipient="melt", law=Law.CONTROLLED, control=order),
            Arc(id="melted", donor="scrap", recipient="melt", law=Law.CONTROLLED, control=order),
            Arc(id="made", donor="melt", recipient="use", law=Law.SHARE),
            Arc(id="left", donor="use", recipient="landfill", law=Law.SHARE),
        ),
        services=(
            Service(id="products", provider="made", quantity="flow", low=6.0, owed_by=("mined",)),
            Service(id="clean", substance="copper", owed_by=("mined",), **place | service),
        ),
        substances=COPPER,
        mass_unit="t",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=6),
    )


def sorting_line(*, transfer: float = 0.8, lifetime: Lifetime | None = None, controlled: bool = False) -> Network:
    """Return a network in which half of a stock of 100 t with 2 % copper is shredded and sorted in a year."""
    control = Control(kind=ControlKind.TRANSFER, low=0.0, neutral=0.5, high=0.9, substances=("copper",))
    own = {"control": control} if controlled else {"transfer": {"copper": transfer}}
    return Network(
        name="sorting",
        nodes=(
            Node(
                id="use",
                initial=(100.0, 100.0),
                content={"copper": 0.02},
                rate=0.0 if lifetime else np.log(2),
                lifetime=lifetime,
            ),
            Node(id="shredder", stores=False),
            Node(id="scrap", initial=(0.0, 0.0)),
            Node(id="waste", initial=(0.0, 0.0), role=Role.LANDFILL),
        ),
        arcs=(
            Arc(id="scrapping", donor="use", recipient="shredder", law=Law.SHARE),
            Arc(id="recovery", donor="shredder", recipient="scrap", law=Law.SHARE),
            Arc(id="rejects", donor="shredder", recipient="waste", law=Law.SHARE, share=0.1, **own),
        ),
        services=(Service(id="purity", provider="recovery", quantity="flow", substance="copper", low=0.0, high=0.002),),
        substances=COPPER,
        episode=Episode(control_interval=1.0, horizon=1),
        is_variant=True,  # no transfer keeps this limit
    )


def test_separation_in_closed_form() -> None:
    """Of 49 t iron and 1 t copper 10 % and 80 % are rejected; content and level follow by hand."""
    env, stocks = rollout_of(sorting_line(), 1, 0)
    copper = env.rows.substances(stocks[-1])[:, 0]
    np.testing.assert_allclose(copper, [1.0, 0.2, 0.8], rtol=1e-12)
    np.testing.assert_allclose(env.rows.stocks(stocks[-1])[:, 0], [50.0, 44.1 + 0.2, 4.9 + 0.8], rtol=1e-12)
    assert env.physical.service[0, 0] == pytest.approx(0.002 / (0.2 / 44.3), rel=1e-12)


@pytest.mark.parametrize("setting", [-1.0, 0.3, 1.0])
def test_who_sets_a_transfer_acts_on_the_substance_alone(setting: float) -> None:
    """The share of copper is what the control sets, that of all else is stated."""
    env = MultiAgentVectorEnv(sorting_line(controlled=True), num_envs=1)
    env.reset(seed=0)
    env.advance(np.array([[setting]]))
    rejected = env.rows.substances(env.physical.stock)[2, 0]
    assert rejected == pytest.approx(0.45 * (setting + 1), abs=1e-12)
    assert env.rows.stocks(env.physical.stock)[2, 0] == pytest.approx(4.9 + rejected, rel=1e-12)


def test_lifetimes_keep_the_content_of_what_entered() -> None:
    """Of a fixed lifetime comes out what went in: first the old stock with 2 %, then what has none."""
    network = sorting_line(lifetime=Lifetime(mean=3.0, distribution="fixed"), transfer=0.1)
    source = Node(id="ore", initial=(500.0, 500.0), role=Role.NONRENEWABLE_RESERVOIR)
    mining = Arc(id="mining", donor="ore", recipient="use", law=Law.EXOGENOUS, flow=20.0)
    network = replace(
        network,
        nodes=(*network.nodes, source),
        arcs=(*network.arcs, mining),
        episode=Episode(control_interval=1.0, horizon=6),
    )
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    contents = []
    for _ in range(6):
        outcome = env.advance(np.zeros((0, 1)))
        flows = env.team_info(outcome)["substances"]["copper"][0]
        contents.append(flows[0] / outcome.flow[0, 0])
    np.testing.assert_allclose(contents, [0.02] * 3 + [0.0] * 3, atol=1e-12)


def test_lifetimes_that_agents_stretch_are_those_of_the_whole() -> None:
    """Without separation a stock whose lifetime agents stretch moves as in the network without substances."""
    network = sorting_line(lifetime=Lifetime(mean=3.0, deviation=1.5))
    stretch = Control(kind=ControlKind.STRETCH, low=0.5, neutral=1.0, high=3.0)
    arcs = (*network.arcs[:2], replace(network.arcs[2], transfer={}))
    nodes = (replace(network.nodes[0], control=stretch), *network.nodes[1:])
    network = replace(network, nodes=nodes, arcs=arcs, episode=Episode(control_interval=1.0, horizon=5))
    (env, together), (other, masses) = rollout_of(network, 1, 5), rollout_of(without_substances(network), 1, 5)
    for left, right in zip(together, masses, strict=True):
        np.testing.assert_allclose(env.rows.stocks(left), other.rows.stocks(right), rtol=1e-11)
        np.testing.assert_allclose(env.rows.substances(left), 0.02 * other.rows.stocks(right), rtol=1e-11)


def test_scheduled_flows_carry_the_content_at_the_start_of_a_substep() -> None:
    """The error of a mixed stock that a schedule empties is of first order in the substep."""

    def copper_left(step: float) -> float:
        network = Network(
            name="mixing",
            nodes=(
                Node(id="ore", initial=(100.0, 100.0), role=Role.NONRENEWABLE_RESERVOIR),
                Node(id="scrap", initial=(10.0, 10.0), content={"copper": 0.1}),
                Node(id="use", initial=(0.0, 0.0)),
            ),
            arcs=(
                Arc(id="mining", donor="ore", recipient="scrap", law=Law.EXOGENOUS, flow=5.0),
                Arc(id="melting", donor="scrap", recipient="use", law=Law.EXOGENOUS, flow=5.0),
            ),
            substances=COPPER,
            episode=Episode(control_interval=1.0, horizon=1, solver_step=step),
        )
        env, stocks = rollout_of(network.with_options(), 1, 0)
        return float(env.rows.substances(stocks[-1])[1, 0])

    exact = np.exp(-0.5)  # dx/dt = −5·x/10
    errors = [abs(copper_left(step) - exact) for step in (0.1, 0.05, 0.025)]
    ratios = np.divide(errors[:-1], errors[1:])
    assert errors[-1] < 0.005 and ((ratios > 1.9) & (ratios < 2.1)).all()


def test_observations_show_own_content() -> None:
    """A compartment sees the content of itself and of its ends, in parts of the scale of each substance."""
    network = sorting_line(controlled=True)
    use = replace(network.nodes[0], content={"copper": 0.02, "tin": 0.03})
    substances = (*COPPER, Substance(id="tin", scale=0.3))
    network = replace(network, nodes=(use, *network.nodes[1:]), substances=substances)
    env = MultiAgentVectorEnv(network, num_envs=1)
    seen = dict(zip(env.observation_names["rejects"], env.reset(seed=0)["rejects"][0].tolist(), strict=True))
    assert seen["copper in shredder"] == pytest.approx(2.0, rel=1e-6)
    assert seen["tin in shredder"] == pytest.approx(0.1, rel=1e-6)
    assert seen["copper in rejects"] == pytest.approx(0.5 * 0.02 / (0.1 * 0.98 + 0.5 * 0.02) / 0.01, rel=1e-6)


def test_bounds_of_observations_cover_what_separation_does() -> None:
    """Of pure copper 90 % are rejected, though of all else it is 10 %: the observed flow lies in its space."""
    network = sorting_line(controlled=True)
    network = replace(network, nodes=(replace(network.nodes[0], content={"copper": 1.0}), *network.nodes[1:]))
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    env.advance(np.array([[1.0]]))
    space, seen = env.observation_spaces["rejects"], env.observations()["rejects"][0]
    assert env.physical.flow[2, 0] == pytest.approx(0.9 * 50.0)
    assert ((seen >= space.low) & (seen <= space.high)).all()


def test_shares_of_the_whole_may_change_within_an_interval() -> None:
    """Copper leaves fast and iron slowly, so that the shredder rejects ever less: the bound holds all the same."""
    stocks = (("rich", 1.0, 6.0), ("poor", 0.0, 0.5))
    nodes = tuple(
        Node(id=name, initial=(50.0, 50.0), content={"copper": content}, rate=rate) for name, content, rate in stocks
    )
    network = sorting_line()
    arcs = tuple(Arc(id=f"of_{node.id}", donor=node.id, recipient="shredder", law=Law.SHARE) for node in nodes)
    network = replace(
        network, nodes=(*nodes, *network.nodes[1:]), arcs=(*arcs, *network.arcs[1:]), services=(), substances=COPPER
    )
    env, _ = rollout_of(network, 1, 0)
    assert env.physical.circularity[0] <= bound(network).objective + 1e-9


def test_networks_without_arcs_have_derivatives() -> None:
    """Of stocks that nothing moves the levels, contents among them, are what they are, and derivatives are 0."""
    nodes = tuple(Node(id=name, initial=(1.0, 1.0), content={"copper": 0.1}) for name in ("a", "b"))
    service = Service(id="pure", provider="a", quantity="stock", substance="copper", low=0.0, high=0.05)
    still = Network(name="still", nodes=nodes, arcs=(), substances=COPPER)
    network = still.variant(services=(service,))
    env = MultiAgentVectorEnv(network, num_envs=2, horizon=2)
    env.reset(seed=0)
    slopes = gradient(env, np.zeros((2, 0, 2)), levels=1.0)
    np.testing.assert_allclose(slopes.levels, 0.5)
    # of level 0.05/content: more copper lowers it, more of all else raises it
    rows = dict(zip(env.rows.start_names, slopes.start[:, 0].tolist(), strict=True))
    assert rows["a.copper"] == pytest.approx(-4.5, rel=1e-9) and rows["a.remainder"] == pytest.approx(0.5, rel=1e-9)


def with_content(network: Network, **content: float) -> Network:
    """Return a network whose first stock has this content."""
    return replace(network, nodes=(replace(network.nodes[0], content=content), *network.nodes[1:]))


@pytest.mark.parametrize("name", ["release", "entry", "stage_1", "leaving", "use", "scrapping"])
def test_names_of_substances_are_free(name: str) -> None:
    """A substance called like a part of a lifetime, a node or an arc moves as under any other name."""
    network = sorting_line(lifetime=Lifetime(mean=3.0, deviation=1.5))
    arcs = (*network.arcs[:2], replace(network.arcs[2], transfer={name: 0.8}))
    nodes = (replace(network.nodes[0], content={name: 0.02}), *network.nodes[1:])
    services = (replace(network.services[0], substance=name),)
    other = replace(network, nodes=nodes, arcs=arcs, services=services, substances=(Substance(id=name, scale=0.01),))
    (env, stocks), (_, expected) = rollout_of(other, 1, 0), rollout_of(network, 1, 0)
    np.testing.assert_array_equal(stocks[-1], expected[-1])
    assert f"use.stage_1.{name}" in env.rows.start_names


def test_draws_that_no_network_could_have_are_refused() -> None:
    """Two transfers of which some draws exceed the whole need ranges, as shares do."""
    network = sorting_line(controlled=True)
    scrapping, recovery, rejects = network.arcs
    assert rejects.control is not None
    arcs = (scrapping, recovery, rejects, replace(rejects, id="more"))
    spread = Spread(low=0.5, high=1.5, distribution="uniform")
    with pytest.raises(NetworkError, match="substance 'copper': node 'shredder': some draws of its neutral shares sum"):
        replace(network, arcs=arcs, uncertain={"arcs.rejects.control": spread})


def test_explanations_know_who_sets_transfers() -> None:
    """Prices of the bounds of a control that sets a transfer are those of the program, which has masses alone."""
    prices = explain(replace(sorting_line(controlled=True), services=())).prices
    assert prices is not None and np.isfinite(prices.room).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda n: with_content(n, coper=0.1), "unknown substance 'coper'. Did you mean 'copper'"),
        (lambda n: with_content(n, copper=1.5), "content.copper 1.5 must lie in"),
        (lambda n: with_content(n), "substance 'copper': no node has any of it"),
        (
            lambda n: replace(
                n,
                substances=(*COPPER, Substance(id="tin")),
                nodes=(replace(n.nodes[0], content={"copper": 0.6, "tin": 0.7}), *n.nodes[1:]),
            ),
            "its substances sum to 1.3 of its mass",
        ),
        (
            lambda n: replace(
                n, arcs=(*n.arcs[:1], replace(n.arcs[1], share=0.9, transfer={"copper": 0.1}), n.arcs[2])
            ),
            "substance 'copper': node 'shredder': the shares of its arcs sum to 0.9",
        ),
        (
            lambda n: replace(n, services=(replace(n.services[0], substance="cop"),)),
            "service 'purity': substance: unknown substance 'cop'",
        ),
        (
            lambda n: replace(n, substances=(Substance(id="copper", scale=0.0),)),
            "scale 0.0 must be positive and finite",
        ),
        (
            lambda n: replace(
                n,
                arcs=(
                    n.arcs[0],
                    replace(n.arcs[1], share=0.0, transfer={"copper": 0.2}),
                    replace(n.arcs[2], share=None, transfer={}),
                    Arc(
                        id="supply",
                        donor="use",
                        recipient="shredder",
                        law=Law.CONTROLLED,
                        makes_up_for="scrap",
                        control=Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=9.0),
                    ),
                ),
                services=(Service(id="scrap", provider="recovery", quantity="flow", low=1.0),),
            ),
            "arc 'supply': makes_up_for 'scrap': what it carries does not reach 'recovery' at once",
        ),
        (lambda n: n.with_options(episode={"solver": "rk4", "solver_step": 0.1}), "solver 'rk4' does not follow them"),
        (
            lambda n: replace(
                n, arcs=(replace(n.arcs[0], law=Law.DONOR, rate=1.0, transfer={"copper": 0.1}), *n.arcs[1:])
            ),
            "transfer: law 'donor' takes none",
        ),
        (
            lambda n: replace(n, nodes=(*n.nodes[:3], replace(n.nodes[3], content={"copper": 0.1}))),
            "it stores nothing, and what it hands on has the content of what enters it",
        ),
    ],
)
def test_mistakes_are_named(change, message: str) -> None:  # type: ignore[no-untyped-def]
    """What cannot be is refused, with the object, its value and the nearest valid one."""
    with pytest.raises(CirlError, match="(?s)" + message.replace(".", r"\.")):
        change(sorting_line())


def test_files_name_what_is_wrong(tmp_path: Path) -> None:
    """A definition with a content of an unknown substance is refused with its path."""
    text = definition_of(sorting_line()).replace("content = {copper", "content = {cooper")
    path = tmp_path / "sorting.toml"
    path.write_text(text)
    with pytest.raises(CirlError, match=r"nodes\.use\.content: unknown substance 'cooper'\. Did you mean 'copper'"):
        load_network(path)


def test_a_content_above_all_there_is_is_one_fault() -> None:
    """And of a sum where no single one is."""
    for parts, fault in (
        ({"copper": 1.4}, "content.copper 1.4 must lie in [0, 1]"),
        ({"copper": 0.7, "tin": 0.6}, "sum to 1.3"),
    ):
        with pytest.raises(NetworkError) as error:
            replace(sorter(), nodes=(Node(id="ore", content=parts), *sorter().nodes[1:]), substances=(*COPPER, TIN))
        assert fault in str(error.value)
        assert len([line for line in error.value.problems if "ore" in line]) == 1


@pytest.mark.parametrize("band", [{"low": 0.0, "high": 1.5}, {"low": 2.0, "high": 3.0}])
def test_limits_of_contents_are_at_most_one(band: dict[str, float]) -> None:
    """A limit of 1.5 was meant in percent."""
    with pytest.raises(NetworkError, match=r"service 'clean': substance: .* is more than 1, all there is"):
        sorter(**band)


def test_uncertain_contents_are_of_substances_that_are_stated() -> None:
    """The nearest name is told."""
    spread = Spread(low=0.5, high=1.5, distribution="uniform")
    for path, fault in (
        ("coper", "content: unknown substance 'coper'. Did you mean 'copper'"),
        ("tin", "is not stated"),
    ):
        with pytest.raises(NetworkError, match=fault):
            replace(sorter(), substances=(*COPPER, TIN), uncertain={f"nodes.scrap.content.{path}": spread})


def test_an_unknown_distribution_is_one_fault(tmp_path: Path) -> None:
    """What would be wrong with the nearest one is not told as well."""
    text = EXAMPLE.read_text()
    before = 'content.copper = { value = 0.4, unit = "%"'
    path = tmp_path / "steel.toml"
    path.write_text(text.replace(before, f'{before}, range = [0.2, 0.6], distribution = "norml"'))
    with pytest.raises(DefinitionError) as error:
        load_network(path)
    assert str(error.value).count("\n") == 0 and "unknown value 'norml'. Did you mean 'normal'?" in str(error.value)


@pytest.mark.parametrize(
    ("before", "key", "fault"),
    [
        ("[arcs.rejects]", "content", "arcs.rejects.content: a flow, or a batch, has the content of its donor when it"),
        ("[nodes.wires]", "transfer", "nodes.wires.transfer: state the transfer of the arcs that leave it"),
    ],
)
def test_contents_are_of_nodes_and_transfers_of_arcs(before: str, key: str, fault: str, tmp_path: Path) -> None:
    """Where the other is stated nothing that is spelt alike is offered."""
    path = tmp_path / "steel.toml"
    addition = f'{before}\n{key}.copper = {{ value = 1, unit = "%", source = "made up" }}'
    path.write_text(EXAMPLE.read_text().replace(before, addition))
    with pytest.raises(DefinitionError) as error:
        load_network(path)
    assert fault in str(error.value) and "Did you mean" not in str(error.value)
