"""Substances: what is in stocks and flows, how nodes separate it, and what services demand of it."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from conftest import random_network, with_substances
from hypothesis import assume, example, given
from hypothesis import strategies as st

from benchmarks.variants import without_substances
from cirl_marl import (
    MPC,
    Account,
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
    improve_plan,
    load_network,
    simulate,
    simulate_plan,
)
from cirl_marl.controllers.lint import lint_warnings
from cirl_marl.controllers.rollout import Rollout, episode_start, rollout
from cirl_marl.definitions.writer import definition_of
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect
from cirl_marl.network.elements import FIXED_LIFETIME, Lifetime
from cirl_marl.network.series import Series, extremes
from cirl_marl.network.substances import follows_contents
from cirl_marl.network.uncertainty import Spread, draw_network
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.linearised import jacobians, step_program
from cirl_marl.optimum.options import by_stage, with_margin
from cirl_marl.optimum.program import LARGE, Programs
from cirl_marl.optimum.solver import solve
from cirl_marl.optimum.window_planner import Future
from cirl_marl.optimum.window_simulator import WindowSimulator
from cirl_marl.optimum.windows import Continuation, WindowTask
from cirl_marl.reasons.inverse import infer
from cirl_marl.reasons.objective_terms import PlannedEpisode, service_levels
from cirl_marl.reasons.prices import shadow_prices

substances_networks = st.builds(
    lambda seed, nodes, arcs, lifetimes: with_substances(random_network(seed, nodes, arcs, lifetimes=lifetimes), seed),
    st.integers(0, 2**32 - 1),
    st.integers(2, 12),
    st.integers(1, 20),
    st.booleans(),
)
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
def test_copies_are_alone_and_a_substance_that_is_nowhere_separated_changes_nothing(
    network: Network, seed: int
) -> None:
    """A copy has the bits that it has alone; without separation the whole moves as it does without substances."""
    _, together = rollout_of(network, 3, seed)
    _, alone = rollout_of(network, 1, seed)
    for left, right in zip(together, alone, strict=True):
        np.testing.assert_array_equal(left[:, :1], right)
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
    with pytest.raises(NetworkError, match=r"some draws of its contents sum to 1\.5, more than 1; give ranges"):
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
    path.write_text(definition_of(network))
    again = load_network(path)
    assert (again.substances, again.nodes, again.arcs) == (network.substances, network.nodes, network.arcs)
    assert again.services == network.services


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
    """A compartment sees the content of itself and of its ends, in parts of the scale of the substance."""
    env = MultiAgentVectorEnv(sorting_line(controlled=True), num_envs=1)
    seen = dict(zip(env.observation_names["rejects"], env.reset(seed=0)["rejects"][0].tolist(), strict=True))
    assert seen["copper in shredder"] == pytest.approx(2.0, rel=1e-6)
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
    network = Network(name="still", nodes=nodes, arcs=(), services=(service,), substances=COPPER)
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


EXAMPLE = Path(__file__).parent.parent / "examples" / "copper_in_steel.toml"


@given(network=substances_networks, seed=st.integers(0, 1000))
def test_no_episode_is_above_the_bound(network: Network, seed: int) -> None:
    """Whatever agents do, and whatever is separated, λ̄ stays below the bound of the whole."""
    limit = bound(network).objective
    env = MultiAgentVectorEnv(network, num_envs=64)
    middle = dict(zip([node.id for node in network.stores], network.initial.mean(axis=0).tolist(), strict=True))
    env.reset(seed=seed, options={"initial_state": middle})
    rng = np.random.default_rng(seed)
    entries = len(env.actuators.control_rows)
    for _ in range(network.episode.horizon):
        env.advance(rng.choice([-1.0, 1.0, 0.0], (entries, 64)))
    best = float((env.physical.circularity / network.episode.horizon).max())
    size = network.objective.reference_interval * float(np.abs(env.physical.flow).sum(axis=0).max())
    assert best <= limit + 1e-9 * (1.0 + abs(limit) + size)


@given(network=substances_networks, seed=st.integers(0, 1000))
def test_contents_of_flows_are_in_the_ranges_of_programs(network: Network, seed: int) -> None:
    """Every component of every flow is between its least and its greatest part of the whole, whatever agents do."""
    assume(follows_contents(network))
    mixtures = Admissible.of(network).mixtures
    assert mixtures is not None
    env = MultiAgentVectorEnv(network, num_envs=8)
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    for _ in range(network.episode.horizon):
        env.advance(rng.choice([-1.0, 1.0], (len(env.actuators.control_rows), 8)))
        flow, mass = env.physical.flow, env.rows.stocks(env.physical.stock).sum(axis=0)
        size = 1e-11 * mass / network.episode.control_interval + 1e-9 * flow.sum(axis=0)
        of_substances = env.physical.substances.reshape(len(network.substances), len(network.arcs), 8)
        parts = np.concatenate([(flow - of_substances.sum(axis=0))[None], of_substances])
        low, high = (side[:, :, None] * flow for side in mixtures.content)
        assert ((parts >= np.where(flow > size, low, 0.0) - size) & (parts <= high + size)).all()


@given(
    network=substances_networks, seed=st.integers(0, 1000), degree=st.integers(1, 2), large=st.sampled_from((1, LARGE))
)
@example(  # slots of a fixed lifetime begin at other times than its history
    network=with_substances(random_network(453209963, 10, 1, lifetimes=True), 453209963), seed=0, degree=1, large=1
)
@pytest.mark.medium
def test_no_episode_with_its_contents_is_above_their_bound(
    network: Network, seed: int, degree: int, large: int
) -> None:
    """Of whatever levels an episode has, of contents too, λ̄ stays below the bound that demands them."""
    assume(any(service.substance for service in network.services))
    plan, rng = bound(network, degree=degree), np.random.default_rng(seed)
    run = simulate_plan(replace(plan, actions=rng.choice([-1.0, 1.0, 0.0], plan.actions.shape)))
    with patch("cirl_marl.optimum.program.LARGE", large):
        limit = bound(network, degree=degree, min_service=np.maximum(run.episode_levels[0] - 1e-7, 0.0))
    size = network.objective.reference_interval * float(np.abs(run.flow).sum(axis=1).max())
    assert run.episode_circularity[0] <= limit.objective + 1e-8 * (1.0 + abs(limit.objective) + size)


def two_stocks(*shares: Arc, initial: tuple[float, float] = (0.0, 0.0), content: float = 0.0) -> Network:
    """Return a network in which a stock hands on copper in shares, and another one is emptied by orders."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=5.0)
    served = Service(id="served", provider="bc", quantity="flow", low=1.0, weight=1.0, owed_by=("bc",))
    return Network(
        name="two_stocks",
        nodes=(
            Node(id="a", initial=(100.0, 100.0), rate=0.5, content={"copper": 0.3}),
            Node(id="b", initial=initial, content={"copper": content}),
            Node(id="c", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            *shares,
            Arc(id="ac", donor="a", recipient="c", law=Law.SHARE),
            Arc(id="bc", donor="b", recipient="c", law=Law.CONTROLLED, control=order),
        ),
        services=(served, replace(served, id="clean", substance="copper", low=0.0, high=0.24)),
        substances=COPPER,
        mass_unit="t",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=2),
    )


def shares_beside_a_sorter() -> tuple[Arc, ...]:
    """Return a share that anybody sets, of which a sorter leaves less of the copper than of all else."""
    share = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.0, high=0.5)
    sorter = Control(kind=ControlKind.TRANSFER, low=0.0, neutral=0.0, high=0.9, substances=("copper",))
    return (
        Arc(id="ab", donor="a", recipient="b", law=Law.SHARE, control=share),
        Arc(id="ax", donor="a", recipient="c", law=Law.SHARE, share=0.1, control=sorter),
    )


def shares_that_cross() -> tuple[Arc, ...]:
    """Return shares of the same range, at other times."""
    rising, falling = (Series(times=(0.0, 1.0), values=values) for values in ((0.1, 0.5), (0.5, 0.1)))
    return (Arc(id="ab", donor="a", recipient="b", law=Law.SHARE, share=rising, transfer={"copper": falling}),)


@pytest.mark.parametrize("shares", [shares_beside_a_sorter(), shares_that_cross()])
def test_ranges_that_are_alike_are_not_the_same_shares(shares: tuple[Arc, ...]) -> None:
    """What has other shares of copper may have another content, though each may be anywhere in the same range."""
    network = two_stocks(*shares)
    run = simulate_plan(replace(bound(network), actions=np.ones((2, len(network.agents)))))
    limit = bound(network, min_service=np.maximum(run.episode_levels[0] - 1e-6, 0.0))
    assert run.episode_circularity[0] <= limit.objective + 1e-9


def test_bounds_are_of_the_contents_at_their_start() -> None:
    """A stock that is empty by definition has its content where it is not; what it cannot have is refused."""
    network = two_stocks(*shares_that_cross(), content=0.6)
    start = bound(network, {"b": 50.0}).initial.copy()
    for initial in ({"b": 50.0}, start):
        found = bound(network, initial, min_service=[0.99, 0.3])
        assert found.levels[0] >= 0.99 - 1e-6
    assert start.tolist() == pytest.approx([70, 20, 0, 30, 30, 0])  # what is no copper of each stock, then copper
    message = r"initial: 0\.9 of 'b' is copper; by its content, and by what enters it, 0\.\d+ to 0\.\d+ may be"
    for stock in (50.0, 1e-5):  # a little is not as good as none
        start[[1, 4]] = 0.1 * stock, 0.9 * stock
        for ask in (partial(bound, network, start), partial(found.at, start)):
            with pytest.raises(CirlError, match=message):
                ask()


@pytest.mark.medium
def test_uncertain_bounds_start_with_the_contents_that_are_drawn() -> None:
    """Whether the start is given or not, as the simulator does."""
    network = replace(
        two_stocks(*shares_that_cross(), initial=(50.0, 50.0), content=0.3),
        uncertain={"nodes.b.content.copper": Spread(low=0.5, high=2.0, distribution="uniform")},
    )
    sampling = Sampling(draws=16, fit_draws=4)
    limits = [bound(network, start, min_service=[0.99, 0.0], uncertain=sampling) for start in (None, {"b": 50.0})]
    assert limits[0].value == pytest.approx(limits[1].value, rel=1e-9)


@pytest.mark.medium
def test_prices_of_a_network_with_contents() -> None:
    """Of what nobody demands yet, a grade, too; more demand brings nothing."""
    prices = shadow_prices(load_network(EXAMPLE).with_options(episode={"horizon": 4}), min_service=0.9)
    assert np.isfinite(prices.demand).all() and (prices.demand[:, :2] <= 1e-9).all()


def test_plans_order_the_whole_of_a_flow() -> None:
    """What is planned by components is asked for in one, whatever its donor has in it."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=20.0)
    network = Network(
        name="orders",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0), content={"copper": 0.4}),
            Node(id="mill", stores=False),
            Node(id="use", initial=(0.0, 0.0)),
            Node(id="tailings", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="ordered", donor="ore", recipient="mill", law=Law.CONTROLLED, control=order),
            Arc(id="milled", donor="mill", recipient="use", law=Law.SHARE),
            Arc(id="lost", donor="mill", recipient="tailings", law=Law.SHARE, share=0.5, transfer={"copper": 0.1}),
        ),
        services=(Service(id="wanted", provider="milled", quantity="flow", low=6.6, weight=1.0, owed_by=("ordered",)),),
        substances=COPPER,
        mass_unit="t",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=3),
    )
    run = simulate_plan(bound(network, min_service=1.0))
    np.testing.assert_allclose(run.flow[:, 0], 10.0, rtol=1e-6)  # 0.5·0.6 and 0.9·0.4 of it arrive
    np.testing.assert_allclose(run.episode_levels, 1.0, atol=1e-6)


@pytest.mark.parametrize("refilled", [False, True])
def test_bounds_allow_what_idle_supplies_bring(refilled: bool) -> None:
    """Of sources that make up for a service by weights, with contents of their own, which may change as they mix."""

    def supply(name: str, weight: float) -> Arc:
        control = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=30.0)
        return Arc(
            id=f"{name}_in", donor=name, recipient="mill", law=Law.CONTROLLED, control=control,
            makes_up_for="wanted", weight=weight,
        )  # fmt: skip

    sorter = Control(kind=ControlKind.TRANSFER, low=0.1, neutral=0.1, high=0.5, substances=("copper",))
    mixing = Arc(id="mixing", donor="rich", recipient="poor", law=Law.EXOGENOUS, flow=400.0)
    network = Network(
        name="supplies",
        nodes=(
            Node(id="poor", role=Role.NONRENEWABLE_RESERVOIR, initial=(200.0, 200.0), content={"copper": 0.1}),
            Node(id="rich", role=Role.NONRENEWABLE_RESERVOIR, initial=(1e4, 1e4), content={"copper": 0.5}),
            Node(id="mill", stores=False),
            Node(id="use", initial=(0.0, 0.0)),
            Node(id="tailings", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            supply("poor", 0.25),
            supply("rich", 0.75),
            Arc(id="milled", donor="mill", recipient="use", law=Law.SHARE),
            Arc(id="lost", donor="mill", recipient="tailings", law=Law.SHARE, share=0.5, control=sorter),
            *([mixing] if refilled else []),
        ),
        services=(Service(id="wanted", provider="milled", quantity="flow", low=8.0, weight=1.0),),
        substances=COPPER,
        default_agents=("lost",),
        mass_unit="t",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=3),
    )
    run = simulate_plan(replace(bound(network), actions=-np.ones((3, 1))))
    assert (run.flow[:, 1] > 1.0).all() and run.episode_levels[0] > 0.9
    limit = bound(network, min_service=run.episode_levels[0] - 1e-9)
    assert run.episode_circularity[0] <= limit.objective + 1e-6


def controlled_by_mpc(network: Network, horizon: int | None, demanded: float) -> Rollout:
    """Return an episode of MPC from the middle of the initial ranges."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    start = episode_start(env)
    return rollout(env, MPC(horizon=horizon, min_service=demanded), seed=start.seed, start=start.initial_state)


@pytest.mark.slow
@pytest.mark.parametrize(("horizon", "worst"), [(6, -10.5), (10, -8.6), (None, -7.95)])
def test_mpc_keeps_contents(horizon: int | None, worst: float) -> None:
    """As usual it were -28.5 Mt, the plan has -7.93; a window of six years ends before what is made now is scrap."""
    run = controlled_by_mpc(load_network(EXAMPLE), horizon, 1.0)
    assert run.least_service[0] >= 0.9999
    assert run.episode_circularity[0] >= worst


@pytest.mark.parametrize("options", [{"aim": "cost"}, {"at_most": {"cost": 1.0}}])
def test_mpc_refuses_accounts_beside_contents(options: dict[str, Any]) -> None:
    """Its windows climb for λ̄ and services alone; the message says what does more."""
    network = replace(sorter(), accounts=(Account(id="cost", unit="EUR_2023"),))
    env = MultiAgentVectorEnv(network, num_envs=1)
    with pytest.raises(CirlError, match=r"network 'sorter': beside services of contents .* leave out at_most and aim"):
        rollout(env, MPC(min_service=0.9, **options))


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


@pytest.mark.parametrize("horizon", [2, None])
def test_mpc_takes_as_much_scrap_as_the_limit_allows(horizon: int | None) -> None:
    """Of ore without copper and scrap with 4 % half may be scrap where 2 % are allowed, three quarters of 3 %."""
    for limit, part in ((0.02, 0.5), (0.03, 0.75)):
        run = controlled_by_mpc(sorter(limit, low=0.0, high=limit), horizon, 1.0)
        np.testing.assert_allclose(run.flow[:, :2], np.tile([6 * (1 - part), 6 * part], (6, 1)), rtol=1e-3)
        assert run.least_service[0] >= 1.0 - 1e-4


@pytest.mark.parametrize("horizon", [2, None])
def test_mpc_keeps_least_contents_and_those_of_stocks(horizon: int | None) -> None:
    """A product that must have copper takes scrap for it; what is in use counts by its stock."""
    run = controlled_by_mpc(sorter(low=0.03), horizon, 1.0)
    assert run.contents[:, 0, 7].min() >= 0.03 - 1e-5  # with as much ore as scrap it were 0.02
    run = controlled_by_mpc(sorter(low=0.0, high=0.015, provider="use", quantity="stock"), horizon, 1.0)
    assert run.least_service[0] >= 1.0 - 1e-4
    assert run.contents[-1, 0, 2] == pytest.approx(0.015, rel=2e-2)


def test_margins_of_contents_are_stricter() -> None:
    """A limit is divided by the margin, a least content multiplied."""
    products, clean = with_margin(sorter(low=0.01, high=0.02), 1.25).services
    assert (products.low, clean.low, clean.high) == (7.5, 0.0125, 0.016)


def test_levels_of_contents_in_windows_are_those_of_the_simulator() -> None:
    """Whatever actions do, and of both ends of a band; nothing at all is as good as what is wanted."""
    network = sorter(low=0.01, high=0.02)
    future = Future(Admissible.of(network), 2, None)
    start = by_stage(network, future.dynamics.rows, network.initial[0])
    task = WindowTask(start, range(6), None, None, np.zeros(0), None)
    actions = np.random.default_rng(0).choice([-1.0, -0.6, 0.0, 1.0], (6, 2))
    actions[0] = -1.0
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    sums = []
    for action in actions:
        env.advance(action[:, None])
        sums.append(env.physical.service[:, 0])
    levels = np.diff(sums, axis=0, prepend=0.0)
    outcome = future.carry_out(task, actions)
    np.testing.assert_allclose(np.minimum(outcome.level, 1.0), levels, rtol=1e-9)
    assert outcome.level[0, 1] == 1.0 and len(np.unique(levels[:, 1])) >= 3
    assert (future.carry_out(task, actions, np.full((6, 2), 2.0)).level[:, 1] > 1.0).any()


def test_plans_tell_what_contents_are_worth() -> None:
    """Where less ore is all that is wanted, contents beside it weigh what they cost: copper bounds the scrap."""
    network = sorter(low=0.0, high=0.02)
    solution = improve_plan(bound(network, min_service=1.0))
    run = simulate_plan(solution)
    episode = PlannedEpisode("plan", solution.initial, run.stock, run.flow, run.contents)
    np.testing.assert_allclose(service_levels(network, episode), run.levels[0].T, rtol=1e-12)
    idle = infer(network, replace(episode, name="idle"))
    clean = [term.about for term in idle.terms].index("clean")
    assert idle.distance < 1e-4 and idle.high[clean] > 0.9
    scrap_alone = simulate_plan(replace(solution, actions=np.tile([-1.0, 0.2], (6, 1))))
    impure = PlannedEpisode("scrap", solution.initial, scrap_alone.stock, scrap_alone.flow, scrap_alone.contents)
    assert infer(network, impure).high[clean] < 0.2


@pytest.mark.slow
def test_sorting_lets_more_scrap_into_steel(tmp_path: Path) -> None:
    """The plan of the example keeps masses and contents; whose sorter stays as it is has less circularity."""
    limit = bound(EXAMPLE, min_service=0.99, degree=1)
    run = simulate_plan(improve_plan(limit, starts=1))
    assert run.episode_levels.min() >= 0.99 - 2e-4
    assert run.episode_circularity[0] <= limit.objective
    others = [agent for agent in limit.agents if agent != "rejects"]
    unsorted = simulate_plan(improve_plan(bound(EXAMPLE, min_service=0.99, degree=1, agents=others), starts=1))
    assert unsorted.episode_levels.min() >= 0.99 - 2e-4
    assert unsorted.episode_circularity[0] < run.episode_circularity[0] - 1.0
    simulation = simulate(EXAMPLE, steps=2)
    header, rows = simulation.table()
    place = header.index("copper in scrap (1)")
    assert rows[0][place] is None
    assert 0.001 < float(str(rows[1][place])) < 0.004


def blending(low: float, high: float = np.inf) -> Network:
    """Return a blend of rich and poor ore, of which rich ore is mined for, that has to have a grade."""
    flow = Control(kind=ControlKind.FLOW, low=0.0, neutral=5.0, high=10.0)
    mines = (("rich", 0.10), ("poor", 0.02))
    return Network(
        name="blending",
        nodes=(
            *(
                Node(id=n, initial=(100.0, 100.0), content={"copper": part}, role=Role.NONRENEWABLE_RESERVOIR)
                for n, part in mines
            ),
            Node(id="blend", stores=False),
            Node(id="smelter", initial=(0.0, 0.0)),
        ),
        arcs=(
            *(Arc(id=f"of_{n}", donor=n, recipient="blend", law=Law.CONTROLLED, control=flow) for n, _ in mines),
            Arc(id="feed", donor="blend", recipient="smelter", law=Law.SHARE),
        ),
        services=(
            Service(id="mass", provider="feed", quantity="flow", low=10.0),
            Service(id="grade", provider="feed", quantity="flow", substance="copper", low=low, high=high),
        ),
        accounts=(Account(id="cost", unit="EUR_2023"),),
        substances=COPPER,
        episode=Episode(control_interval=1.0, horizon=2),
    )


@pytest.mark.parametrize(
    ("low", "high", "costs", "rich"),
    [(0.06, np.inf, (1.0, 0.5), 5.0), (0.06, 0.07, (1.0, 0.5), 5.0), (0.0, 0.05, (-1.0, 2.0), 3.75)],
)
def test_plans_keep_grades(low: float, high: float, costs: tuple[float, float], rich: float) -> None:
    """Of 10 t with at least 6 % copper half is of 10 %, if that is dear; of at most 5 %, if it is cheap, 3.75 t."""
    network = blending(low, high)
    arcs = [replace(arc, accounts={"cost": cost}) for arc, cost in zip(network.arcs[:2], costs, strict=True)]
    solution = bound(replace(network, arcs=(*arcs, network.arcs[2])), aim="cost", min_service=1.0)
    run = simulate_plan(improve_plan(solution))
    assert run.episode_levels.min() >= 1 - 2e-4
    np.testing.assert_allclose(run.flow[:, 0], rich, rtol=2e-3)
    assert run.accounts[0, 0] >= -solution.objective - 1e-9


@pytest.mark.slow
def test_alloys_of_aluminium_are_planned() -> None:
    """Castings have enough alloying elements and not too many, all else few; the plan comes to the bound."""
    limit = bound("aluminium_world", scenario="alloys", min_service=1.0, degree=1)
    run = simulate_plan(improve_plan(limit, starts=1))
    assert limit.gap(run.episode_circularity[0]) < 0.01
    np.testing.assert_allclose(run.episode_levels, 1.0, atol=2e-4)


def test_corrections_of_steps_leave_contents_out() -> None:
    """What an episode was away from its program is told of masses, which steps read, not of contents."""
    solution = bound(blending(0.06), min_service=1.0)
    solution = replace(solution, actions=np.zeros_like(solution.actions))  # 5 t of each, just what is asked for
    dynamics, run = Dynamics(solution.network), simulate_plan(solution)
    slopes, services = jacobians(solution, dynamics), len(solution.network.services)
    program = step_program(solution, dynamics, run, np.ones(services), np.ones(services), 0.5, slopes)
    values = np.zeros(len(program.scale))
    values[program.action] = 0.1
    trial = simulate_plan(replace(solution, actions=np.clip(solution.actions - 0.4, -1.0, 1.0)))
    corrected, rows = program.with_correction(values, run, trial), program.measured[:, 1]
    change = corrected.problem.under_to[: len(rows)] - program.problem.under_to[: len(rows)]
    assert (change[rows == 1] == 0).all() and (change[rows == 0] != 0).all()
    assert (rows == 1).any() and (rows == 0).any()


LIMIT = Service(id="clean", provider="use", quantity="stock", substance="copper", high=0.9, low=0.0)


def pot(*arcs: Arc, copper: float = 0.5, services: tuple[Service, ...] = (LIMIT,), **options: Any) -> Network:
    """Return 20 t with some copper that get 4 t of copper a year, ore beside it, and what is poured of either."""
    return Network(
        name="pot",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0)),
            Node(id="wires", initial=(100.0, 100.0), content={"copper": 1.0}),
            Node(id="pot", initial=(20.0, 20.0), content={"copper": copper}),
            Node(id="use", initial=(0.0, 0.0)),
        ),
        arcs=(Arc(id="wired", donor="wires", recipient="pot", law=Law.EXOGENOUS, flow=4.0), *arcs),
        services=services,
        substances=COPPER,
        mass_unit="t",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=1, **options),
    )


@pytest.mark.parametrize(("merge", "rise"), [(False, 0.28525), (True, (6 * 0.28525 + 2 * 0.095) / 16)])
def test_programs_let_contents_change_within_an_interval(merge: bool, rise: float) -> None:
    """Of 4 t a year four substeps carry 2, 2.1, 2.195 and 2.28525 t of copper; merged they have two moments."""
    network = pot(Arc(id="poured", donor="pot", recipient="use", law=Law.EXOGENOUS, flow=4.0), solver_step=0.25)
    programs = Programs(Admissible.of(network), 1, None, merge_pieces=merge)
    problem = programs.program(by_stage(network, Dynamics(network).rows, network.initial[0]))
    flow = programs.layout.flow + programs.admissible.network.arc_index["poured:copper"]
    cost = np.zeros(len(problem.cost))
    cost[flow[[0, -1]]] = 1.0, -1.0
    assert programs.layout.pieces == (1 if merge else 4)
    assert solve(replace(problem, cost=cost), label="the rise").plan @ -cost >= rise - 1e-9


def test_supplies_of_varying_content_are_shared_by_weight() -> None:
    """Of two idle supplies one carries more and more copper; of all else the other supplies as much as it does."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=6.0)
    arcs = [
        Arc(
            id=f"from_{donor}",
            donor=donor,
            recipient="use",
            law=Law.CONTROLLED,
            control=order,
            makes_up_for="made",
            weight=0.5,
        )
        for donor in ("ore", "pot")
    ]
    made = Service(id="made", provider="from_ore", also=("from_pot",), quantity="flow", low=4.0)
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=0.1, high=1.0)
    away = Arc(id="thrown", donor="use", recipient="wires", law=Law.DONOR, rate=1.0, control=valve)
    network = replace(pot(*arcs, away, copper=0.0, services=(made, LIMIT)), default_agents=("thrown",))
    solution = bound(network, min_service=[1.0, 0.0])
    run = simulate_plan(solution)
    np.testing.assert_allclose(run.flow[0, 1:3], 2.0, rtol=1e-6)
    assert run.episode_circularity[0] <= solution.objective + 1e-9


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


@pytest.mark.parametrize(
    ("band", "remark"),
    [
        ({"low": 0.0, "high": 0.02}, ""),
        ({"low": 0.01, "high": 0.02}, ""),
        ({"low": 0.05}, "no stock has more than 0.04 of it, less than the 0.05 that it asks for"),
    ],
)
def test_contents_that_no_mixture_has_are_told(band: dict[str, float], remark: str) -> None:
    """Between the poorest and the richest stock everything can be mixed; a node that separates can do more."""
    remarks = [text for text in lint_warnings(sorter(**band)) if "separates" in text]
    assert (remark in "".join(remarks)) and bool(remark) == bool(remarks)
    rich = sorter(low=0.0, high=0.02)
    nodes = tuple(replace(node, content={"copper": 0.03}) if node.stores else node for node in rich.nodes)
    assert [text for text in lint_warnings(replace(rich, nodes=nodes)) if "less than 0.03 of it, more" in text]
    arcs = [replace(arc, share=0.1, transfer={"copper": 0.9}) if arc.id == "left" else arc for arc in rich.arcs]
    arcs.append(Arc(id="kept", donor="use", recipient="scrap", law=Law.SHARE))
    separating = replace(rich, nodes=nodes, arcs=tuple(arcs))
    assert not [text for text in lint_warnings(separating) if "separates" in text]


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


def test_what_comes_after_a_window_prices_each_component() -> None:
    """At random prices of flows and stocks a plan is charged for each by itself, and to first order by the same."""
    network = sorter(low=0.01, high=0.02)
    future, random = Future(Admissible.of(network), 2, None), np.random.default_rng(0)
    rows, layout, mixtures = future.dynamics.rows, future.layout, future.admissible.mixtures
    assert mixtures is not None
    start, actions = by_stage(network, rows, network.initial[0]), random.uniform(-0.5, 1.0, (2, 2))
    stocks, flows = WindowSimulator(network, ()).run(start, actions)
    copper = flows[:, 4:]
    costs, prices = np.zeros((2, layout.size)), random.uniform(1.0, 2.0, (2, 4))
    for component, flow in enumerate((flows[:, :4] - copper, copper)):
        costs[:, layout.flow[0] + mixtures.arcs[component]] = prices[component] * flow
    expected = (prices[0] * (flows[:, :4] - copper) ** 2 + prices[1] * copper**2).sum()
    costs[-1, layout.last] = price = random.uniform(0.0, 1.0, layout.last.stop - layout.last.start)
    end = future.admissible.lifetimes.start_planned @ stocks[-1]
    task = WindowTask(start, range(2), None, Continuation(costs, end), np.zeros(0), None)
    charge = future.carry_out(replace(task, later=None), actions).value - future.carry_out(task, actions).value
    assert charge == pytest.approx(expected + price @ end, rel=1e-9)
    later = future.later(task)
    assert later is not None and future.later(replace(task, later=None)) is None
    assert (later.cost * np.concatenate([stocks[1:], flows], axis=1)).sum() == pytest.approx(charge, rel=1e-9)


def test_a_plan_that_comes_about_needs_no_correction() -> None:
    """What a program promises of contents is measured as what the simulator makes of it."""
    env = MultiAgentVectorEnv(sorter(low=0.0, high=0.02), num_envs=1)
    env.reset(seed=0)
    control = MPC(min_service=1.0)
    control.start(env, 0)
    window = control._plans[0].window
    assert window is not None
    np.testing.assert_allclose(window.corrections[0].error, 0.0, atol=1e-3)
