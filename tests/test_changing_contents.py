"""Contents that change in time: of what sources give and of what histories were, stated, uncertain and disturbed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from conftest import random_network, with_changing_contents, with_substances
from hypothesis import given
from hypothesis import strategies as st

from cirl_marl import (
    MPC,
    Account,
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    Network,
    NetworkError,
    Node,
    Role,
    Series,
    Service,
    Substance,
    bound,
    gradient,
    improve_plan,
    load_network,
    simulate_plan,
)
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.writer import definition_of
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.network.disturbances import AutoRegression, DisturbanceEffect, Markov
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.initial_ages import remaining_history
from cirl_marl.network.uncertainty import Spread, network_of_intervals
from cirl_marl.optimum.content_ranges import present_contents
from cirl_marl.optimum.draw_proofs import Sampling

HISTORY = Series(times=(-5.0,), values=(1.0,))
PATHS = tuple(f"nodes.ore.content.{name}" for name in ("copper", "tin"))
POORER = Series(times=(0.0, 2.0, 4.0), values=(0.2, 0.1, 0.05))
NOISE = AutoRegression(mean=1.0, deviation=0.2, persistence=0.5, low=0.5, high=1.5)
MORE = AutoRegression(mean=0.01, deviation=0.005, persistence=0.5, low=0.0, high=0.03)


def mine(copper: Series | float = POORER, tin: Series | float = 0.02, **options: Any) -> Network:
    """Return a mine of ore whose copper changes, a sorter that keeps copper back, and a limit of it."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=5.0, high=10.0)
    sorter = Control(kind=ControlKind.TRANSFER, low=0.1, neutral=0.3, high=0.8, substances=("copper",))
    return Network(
        name="mine",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR, content={"copper": copper, "tin": tin}),
            Node(id="mill", stores=False),
            Node(id="use", initial=(10.0, 10.0), content={"copper": 0.1}),
            Node(id="tailings", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="mined", donor="ore", recipient="mill", law=Law.CONTROLLED, control=order),
            Arc(id="dug", donor="ore", recipient="use", law=Law.EXOGENOUS, flow=1.0),
            Arc(id="milled", donor="mill", recipient="use", law=Law.SHARE),
            Arc(id="lost", donor="mill", recipient="tailings", law=Law.SHARE, share=0.05, control=sorter),
        ),
        services=(
            Service(id="made", provider="milled", quantity="flow", low=6.0, owed_by=("mined",)),
            Service(id="clean", provider="milled", quantity="flow", substance="copper", low=0.0, high=0.08),
        ),
        substances=(Substance(id="copper"), Substance(id="tin")),
        mass_unit="t",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=5),
        **options,
    )


def unforeseen() -> Network:
    """Return the mine with contents that are drawn for each episode and disturbed, by a factor and by a sum."""
    disturbed = {
        PATHS[0]: DisturbanceEffect(by="noise"),
        PATHS[1]: DisturbanceEffect(by="more", adds=True),
    }
    uncertain = {PATHS[0]: Spread(low=0.5, high=1.2, distribution="uniform")}
    return mine(uncertain=uncertain, disturbances={"noise": NOISE, "more": MORE}, disturbed=disturbed)


def rollout_of(network: Network, copies: int, seed: int, **options: Any) -> tuple[MultiAgentVectorEnv, np.ndarray]:
    """Return an environment after an episode of random actions, and contents of flows, (steps, substances, arcs, B)."""
    env = MultiAgentVectorEnv(network, num_envs=copies, **options)
    env.reset(seed=seed)
    rng, contents = np.random.default_rng(seed), []
    for _ in range(network.episode.horizon):
        env.advance(np.repeat(rng.uniform(0, 1, (len(env.actuators.control_rows), 1)), copies, axis=1))
        substances = env.physical.substances.reshape(len(network.substances), -1, copies)
        flow = env.physical.flow
        contents.append(np.divide(substances, flow, out=np.full_like(substances, np.nan), where=flow > 0))
    return env, np.array(contents)


def test_sources_give_what_is_stated_for_the_interval() -> None:
    """A ramp counts with its mean over each interval, and every arc of a source carries the same."""
    ramp = Series(times=(0.0, 5.0), values=(0.2, 0.1), interpolation="linear")
    network = mine(copper=ramp)
    _, contents = rollout_of(network, 2, 0)
    stated = np.repeat((0.19 - 0.02 * np.arange(5.0))[:, None], 2, axis=1)
    np.testing.assert_allclose(contents[:, 0, 0], stated, rtol=1e-12)
    np.testing.assert_allclose(contents[:, 0, 1], stated, rtol=1e-12)
    np.testing.assert_allclose(contents[:, 1, :2], 0.02, rtol=1e-12)


def test_sources_hold_what_can_be_asked_of_each_substance() -> None:
    """Who takes the most in every interval leaves next to nothing of any component."""
    network = mine()
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    copper = 11.0 * np.array([0.2, 0.2, 0.1, 0.1, 0.05]).sum()
    np.testing.assert_allclose(env.physical.stock[[0, 3, 6], 0], [55 - copper - 1.1, copper, 1.1], rtol=2e-6)
    assert network.initial[0, 0] == pytest.approx(55.0, rel=2e-6)
    for _ in range(5):
        env.advance(np.ones((2, 1)))
    assert (np.abs(env.physical.stock[[0, 3, 6], 0]) < 1e-4).all()


def test_a_constant_series_is_a_constant_content() -> None:
    """Of what has no other source the stock has what it gives, stated as a number or as a series."""
    constant, series = (mine(copper=copper) for copper in (0.2, Series(times=(0.0,), values=(0.2,))))
    masses = [rollout_of(network, 1, 3)[0].physical.stock for network in (constant, series)]
    np.testing.assert_allclose(masses[0], masses[1], rtol=1e-9, atol=1e-9)


def test_all_components_are_cut_alike() -> None:
    """A source that is given less than is asked of it keeps its contents until one of its components is out."""
    env = MultiAgentVectorEnv(mine(), num_envs=1)
    env.reset(seed=0, options={"initial_state": {"ore": 20.0}})
    copper, shares = 20.0 * 0.13 / 1.0, []
    for t in range(3):
        env.advance(np.ones((2, 1)))
        flow, substances = env.physical.flow[:2, 0], env.physical.substances.reshape(2, -1)[:, :2]
        if flow.sum() > 1e-9:
            np.testing.assert_allclose(substances[0] / flow, (0.2, 0.2, 0.1)[t], rtol=1e-9)
        shares.append(flow.sum())
    assert env.physical.stock.min() >= 0
    assert shares[0] == pytest.approx(11.0, rel=1e-9)
    assert shares[1] == pytest.approx(copper / 0.2 - 11.0, rel=1e-5)  # copper is out, other ore is left
    assert shares[2] == pytest.approx(0.0, abs=1e-9)


def test_draws_and_disturbances_of_contents() -> None:
    """Each copy has its own, times or plus what disturbs it; a copy is what it is alone, and as its drawn network."""
    network = unforeseen()
    env, contents = rollout_of(network, 3, 5, uncertain=True)
    values = env.physical.disturbances[:5, 0]
    stated = np.array([0.2, 0.2, 0.1, 0.1, 0.05])[:, None]
    np.testing.assert_allclose(contents[:, 0, 0], stated * env.physical.factors[0] * values, rtol=1e-11)
    np.testing.assert_allclose(contents[:, 1, 0], 0.02 + env.physical.disturbances[:5, 1], rtol=1e-11)
    assert np.ptp(env.physical.factors[0]) > 0.1
    lone, _ = rollout_of(network, 1, 5, uncertain=True)
    np.testing.assert_array_equal(lone.physical.stock[:, 0], env.physical.stock[:, 0])
    certain, drawn = rollout_of(env.certain_network(2), 1, 5)
    np.testing.assert_allclose(drawn[..., 0], contents[..., 2], rtol=1e-11)
    outside = [i for i, name in enumerate(env.rows.start_names) if not name.startswith("ore.")]
    np.testing.assert_allclose(certain.physical.stock[outside, 0], env.physical.stock[outside, 2], rtol=1e-11)


@pytest.mark.parametrize("copper", [POORER, 0.15])
@pytest.mark.parametrize("reserve", [None, 4.0])
def test_supplies_carry_what_orders_of_as_much_carry(copper: Series | float, reserve: float | None) -> None:
    """Each component of what nobody orders, but the mine makes up for, also where the mine runs empty."""
    network, demand = mine(copper), Service(id="milled", provider="milled", quantity="flow", low=7.0)
    ore = replace(network.nodes[0], initial=None if reserve is None else (reserve, reserve))
    supply = replace(network.arcs[0], makes_up_for="milled")
    services = demand, replace(network.services[1])
    network = replace(network, nodes=(ore, *network.nodes[1:]), services=services)
    supplied = replace(network, arcs=(supply, *network.arcs[1:]), default_agents=("lost",))
    env, other = (MultiAgentVectorEnv(each, num_envs=1) for each in (supplied, network))
    env.reset(seed=0), other.reset(seed=0)
    row = network.control_rows["mined"].start
    for _ in range(network.episode.horizon):
        env.advance(np.full((1, 1), 0.3))
        order = env.interval.controls[row, 0]
        actions = {"mined": order / 5.0 - 1.0, "lost": 0.3}
        other.advance(np.array([[actions[name]] for name in other.actuators.entries]))
        for part in ("stock", "flow", "substances"):
            of_env, of_other = getattr(env.physical, part), getattr(other.physical, part)
            np.testing.assert_allclose(of_env, of_other, rtol=1e-9, atol=1e-12)
    if reserve is None:
        assert env.physical.flow[network.arc_index["milled"], 0] == pytest.approx(7.0, rel=1e-9)


def test_draws_that_do_not_change_still_have_reserves() -> None:
    """A disturbance that stands still makes a series, so that starts of the draw are those of the network."""
    still = Markov(values=(1.0, 0.5), lengths=(1e9, 1e9), start=1)
    network = mine(copper=0.2, disturbances={"noise": still}, disturbed={PATHS[0]: DisturbanceEffect(by="noise")})
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    certain = env.certain_network(0)
    assert isinstance(dict(certain.nodes[0].content)["copper"], Series)
    bound(certain, env.physical.stock[env.rows.nodes, 0])


@pytest.mark.parametrize("factor", [0.5, 1.2])
def test_reserves_do_for_every_draw(factor: float) -> None:
    """Of the poorest ore as of the richest all that is asked for is there."""
    network = mine(uncertain={PATHS[0]: Spread(low=0.5, high=1.2, distribution="uniform")})
    env = MultiAgentVectorEnv(network, num_envs=1, uncertain=True)
    env.reset(seed=0)
    env.physical.factors[...] = factor
    for _ in range(5):
        env.advance(np.ones((2, 1)))
        np.testing.assert_allclose(env.physical.flow[:2, 0], [10.0, 1.0], rtol=1e-12)


def test_programs_of_windows_keep_what_histories_were() -> None:
    """A network of some intervals has what its sources give in them, and the past as it was."""
    past = {"copper": Series(times=(-5.0, -2.0), values=(0.1, 0.3))}
    cars = Node(id="cars", lifetime=Lifetime(mean=3.0, deviation=1.0), history=HISTORY, content=past)
    scrapped = Arc(id="scrapped", donor="cars", recipient="tailings", law=Law.SHARE)
    network = replace(mine(), nodes=(*mine().nodes, cars), arcs=(*mine().arcs, scrapped))
    window = network_of_intervals(network, np.array([1, 2, 4]))
    assert dict(window.compartments["cars"].content) == past
    np.testing.assert_array_equal(window.interval_means(dict(window.nodes[0].content)["copper"]), [0.2, 0.1, 0.05])


@given(seed=st.integers(0, 2**32 - 1), nodes=st.integers(2, 7), arcs=st.integers(1, 12))
def test_masses_of_networks_with_changing_contents(seed: int, nodes: int, arcs: int) -> None:
    """Each substance is conserved to 1e-12 and below its whole, however little the source holds at the start."""
    network = with_substances(random_network(seed, nodes, arcs), seed)
    if "quarry" not in network.node_index:
        network = with_changing_contents(network, seed)
    env, rng = MultiAgentVectorEnv(network, num_envs=3), np.random.default_rng(seed)
    reserve = network.initial[0, network.node_index["quarry"]]
    env.reset(seed=seed % 1000, options={"initial_state": {"quarry": reserve * rng.uniform(0, 1, 3)}})
    rows, count, before = env.rows, len(network.substances), env.physical.stock
    for _ in range(network.episode.horizon):
        env.advance(rng.choice([-1.0, 1.0, 0.3], (len(env.actuators.control_rows), 3)))
        parts, first = (rows.substances(masses).reshape(count, -1, 3) for masses in (env.physical.stock, before))
        np.testing.assert_allclose(parts.sum(axis=1), first.sum(axis=1), rtol=1e-12)
        assert env.physical.stock.min() >= 0
        assert (parts.sum(axis=0) <= rows.stocks(env.physical.stock) * (1 + 1e-12)).all()


@given(seed=st.integers(0, 2**32 - 1), nodes=st.integers(2, 6), arcs=st.integers(1, 9), lifetimes=st.booleans())
def test_random_draws_move_as_their_networks(seed: int, nodes: int, arcs: int, lifetimes: bool) -> None:
    """A copy whose contents are drawn and disturbed moves as the certain network, below its bound; and as alone."""
    network = with_substances(random_network(seed, nodes, arcs, lifetimes=lifetimes), seed)
    if "quarry" not in network.node_index:
        network = with_changing_contents(network, seed)
    path = f"nodes.quarry.content.{network.substances[0].id}"
    spread, noise = Spread(low=0.5, high=1.05, distribution="uniform"), replace(NOISE, high=1.3)
    network = replace(
        network.with_options(episode={"horizon": min(network.episode.horizon, 4)}),
        uncertain={path: spread},
        disturbances={"noise": noise},
        disturbed={path: DisturbanceEffect(by="noise")},
    )
    env, alone = (MultiAgentVectorEnv(network, num_envs=copies, uncertain=True) for copies in (2, 1))
    env.reset(seed=seed % 1000)
    alone.reset(seed=seed % 1000)
    rng, start = np.random.default_rng(seed), env.physical.stock[env.rows.nodes, 0]
    certain = MultiAgentVectorEnv(env.certain_network(0), num_envs=1)
    certain.reset(options={"initial_state": dict(zip(env.rows.start_names, start.tolist(), strict=True))})
    for _ in range(network.episode.horizon):
        actions = rng.uniform(-1, 1, (len(env.actuators.control_rows), 1))
        env.advance(np.repeat(actions, 2, axis=1))
        alone.advance(actions)
        certain.advance(actions)
    np.testing.assert_array_equal(alone.physical.stock[:, 0], env.physical.stock[:, 0])
    size = start.sum()
    np.testing.assert_allclose(certain.physical.stock[:, 0], env.physical.stock[:, 0], rtol=1e-8, atol=1e-10 * size)
    limit = bound(certain.network, start).objective
    reached = float(env.physical.circularity[0] / network.episode.horizon)
    assert reached <= limit + 1e-7 * (1.0 + abs(limit))


@pytest.mark.parametrize("scarce", [False, True])
def test_derivatives_by_what_is_unforeseen(scarce: bool) -> None:
    """By draws and disturbances of contents, by actions and starts, also where a component is out."""
    network = unforeseen()
    env = MultiAgentVectorEnv(network, num_envs=1, uncertain=True)
    state = {"ore": 22.0} if scarce else {}
    env.reset(seed=2, options={"initial_state": state})
    actions = np.random.default_rng(0).uniform(0.2, 0.8, (5, 2, 1))
    weights = np.array([0.3, 1.0])
    exact = gradient(env, actions, circularity=0.01, levels=weights)

    def value(part: str, change: np.ndarray) -> float:
        trial = MultiAgentVectorEnv(network, num_envs=1, uncertain=True)
        trial.reset(seed=2, options={"initial_state": state})
        if part == "draws":
            trial.physical.factors[...] += change
        elif part == "disturbances":
            trial.physical.disturbances[: len(change)] += change
        found = gradient(trial, actions + (change if part == "actions" else 0.0), circularity=0.01, levels=weights)
        return float(0.01 * found.circularity[0] + weights @ found.levels[:, 0])

    for part in ("actions", "draws", "disturbances"):
        slopes = getattr(exact, part)
        direction = np.random.default_rng(1).choice([-1.0, 1.0], slopes.shape)
        difference = (value(part, 1e-6 * direction) - value(part, -1e-6 * direction)) / 2e-6
        assert difference == pytest.approx(float((slopes * direction).sum()), abs=1e-6 * (1 + np.abs(slopes).sum()))
        assert np.abs(slopes).max() > 1e-4


def test_slots_before_a_history_have_its_first_content() -> None:
    """That of its first piece, half an interval here: 0.2·(t + 2.5) is 0.05 from −2.5 to −2, and 0.2, 0.4 after it."""
    ramp = Series(times=(-2.5, 0.0), values=(0.0, 0.5), interpolation="linear")
    history = Series(times=(-2.5, 0.0), values=(8.0, 8.0))
    node = Node(id="use", lifetime=Lifetime(mean=5.0, distribution="fixed"), history=history, growth=0.0)
    copper, whole = remaining_history(node, 1.0, ramp), remaining_history(node, 1.0)
    np.testing.assert_allclose(whole[:-1], 8.0)
    np.testing.assert_allclose(copper[:-1] / whole[:-1], [0.4, 0.2, 0.05, 0.05, 0.05], rtol=1e-12)


@pytest.mark.parametrize(
    "lifetime",
    [Lifetime(mean=3.0, deviation=1.0), Lifetime(mean=4.0, distribution="fixed"), Lifetime(mean=2.0, deviation=2.0)],
)
def test_histories_hold_what_entered(lifetime: Lifetime) -> None:
    """A stock whose history had changing contents is one into which just that has flowed."""
    inflow = Series(times=(0.0, 1.0, 4.0, 7.0), values=(3.0, 5.0, 2.0, 6.0))
    copper = Series(times=(0.0, 3.0, 8.0), values=(0.4, 0.1, 0.3), interpolation="linear")

    def earlier(series: Series) -> Series:
        return replace(series, times=tuple(time - 8.0 for time in series.times), until=0.0)

    use = Node(id="use", initial=(0.0, 0.0), lifetime=lifetime)
    network = Network(
        name="past",
        nodes=(
            Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR, content={"copper": copper}),
            use,
            Node(id="waste", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="made", donor="ore", recipient="use", law=Law.EXOGENOUS, flow=inflow),
            Arc(id="scrapped", donor="use", recipient="waste", law=Law.SHARE),
        ),
        substances=(Substance(id="copper"),),
        episode=Episode(control_interval=1.0, horizon=8),
    )
    grown, _ = rollout_of(network, 1, 0)
    held = replace(use, initial=None, history=earlier(inflow), content={"copper": earlier(copper)})
    nodes = (network.nodes[0], held, network.nodes[2])
    begun = MultiAgentVectorEnv(replace(network, nodes=nodes), num_envs=1)
    begun.reset(seed=0)
    rows = [row for row, name in enumerate(begun.rows.start_names) if name.startswith("use")]
    np.testing.assert_allclose(begun.physical.stock[rows], grown.physical.stock[rows], rtol=1e-9, atol=1e-11)


def test_what_grew_before_a_history_has_its_first_content() -> None:
    """So that content is all of one kind where the series is constant."""
    history = Series(times=(-3.0,), values=(2.0,))
    for lifetime in (Lifetime(mean=4.0, distribution="fixed"), Lifetime(mean=4.0, deviation=1.0)):
        rising = Series(times=(-3.0, 0.0), values=(0.2, 0.5), interpolation="linear")
        for copper in (Series(times=(-3.0,), values=(0.2,)), rising):
            node = Node(id="use", lifetime=lifetime, history=history, growth=0.02, content={"copper": copper})
            network = Network(
                name="grown",
                nodes=(node, Node(id="waste", role=Role.LANDFILL, initial=(0.0, 0.0))),
                arcs=(Arc(id="scrapped", donor="use", recipient="waste", law=Law.SHARE),),
                substances=(Substance(id="copper"),),
                episode=Episode(control_interval=1.0, horizon=2),
            )
            parts = network.start_shares(node).reshape(2, -1)
            content = parts[1, parts.sum(axis=0) > 0] / parts.sum(axis=0)[parts.sum(axis=0) > 0]
            if len(copper.times) == 1:
                np.testing.assert_allclose(content, 0.2, rtol=1e-9)
            else:
                assert 0.25 - 1e-9 <= content.min() < 0.26 and 0.4 < content.max() <= 0.45 + 1e-9


@given(seed=st.integers(0, 2**32 - 1), nodes=st.integers(2, 6), arcs=st.integers(1, 9), lifetimes=st.booleans())
@pytest.mark.medium
def test_no_episode_is_above_the_bound_of_its_levels(seed: int, nodes: int, arcs: int, lifetimes: bool) -> None:
    """Whatever a source holds and gives, λ̄ stays below the bound that demands the levels of the episode."""
    network = with_substances(random_network(seed, nodes, arcs, lifetimes=lifetimes), seed)
    if "quarry" not in network.node_index:
        network = with_changing_contents(network, seed)
    network, rng = (
        network.with_options(episode={"horizon": min(network.episode.horizon, 5)}),
        np.random.default_rng(seed),
    )
    start = network.initial.mean(axis=0)
    start[network.node_index["quarry"]] *= rng.choice([1.0, rng.uniform(0, 1)])
    plan = bound(network, start)
    run = simulate_plan(replace(plan, actions=rng.choice([-1.0, 1.0, 0.2], plan.actions.shape)))
    demanded = np.maximum(run.episode_levels[0] - 1e-7, 0.0) if network.services else None
    limit = bound(network, start, min_service=demanded)
    size = network.objective.reference_interval * float(np.abs(run.flow).sum(axis=1).max())
    assert run.episode_circularity[0] <= limit.objective + 1e-8 * (1.0 + abs(limit.objective) + size)


@pytest.mark.slow
def test_plans_wait_for_cleaner_ore() -> None:
    """Ore that is too rich at first is sorted as well as can be; where it is poor nothing has to be lost."""
    solution = bound(mine(), min_service=[0.9, 0.99])
    run = simulate_plan(improve_plan(solution))
    assert run.episode_levels.min() >= 0.9 - 2e-4 and run.episode_levels[0, 1] >= 0.99 - 2e-4
    assert run.episode_circularity[0] <= solution.objective + 1e-9
    assert solution.gap(run.episode_circularity[0]) < 0.02
    lost = run.flow[:, 3] / run.flow[:, 0]
    assert lost[:2].min() > lost[4] + 0.02


def test_bounds_know_contents_exactly_where_nothing_is_chosen() -> None:
    """Of what flows as stated the bound is what happens: contents of sources are no ranges."""
    services = tuple(replace(service, owed_by=()) for service in mine().services)
    fixed = Arc(id="mined", donor="ore", recipient="mill", law=Law.EXOGENOUS, flow=8.0)
    lost = replace(mine().arcs[3], control=None, transfer={"copper": 0.5})
    network = replace(mine(), arcs=(fixed, mine().arcs[1], mine().arcs[2], lost), services=services)
    limit = bound(network)
    run = simulate_plan(limit)
    assert run.episode_circularity[0] == pytest.approx(limit.objective, rel=1e-9)


def test_bounds_allow_what_is_cut_together() -> None:
    """Where copper runs out so does all else of the source, and less is mined than is stated."""
    fixed = Arc(id="mined", donor="ore", recipient="mill", law=Law.EXOGENOUS, flow=8.0)
    lost = replace(mine().arcs[3], control=None, transfer={"copper": 0.5})
    services = tuple(replace(service, owed_by=()) for service in mine().services)
    network = replace(mine(), arcs=(fixed, *mine().arcs[1:3], lost), services=services)
    start = network.initial[0].copy()
    start[0] = 20.0
    limit = bound(network, start)
    run = simulate_plan(limit)
    assert run.flow[-1, 0] < 1e-6 < run.stock[-1, 0]
    assert run.episode_circularity[0] <= limit.objective + 1e-9


@pytest.mark.slow
def test_uncertain_bounds_of_disturbed_contents() -> None:
    """No policy that sees nothing has a better mean than the bound; draws start as episodes do."""
    network = unforeseen()
    env = MultiAgentVectorEnv(network, num_envs=256, uncertain=True)
    env.reset(seed=0)
    for _ in range(5):
        env.advance(np.full((2, 256), 0.5))
    levels, circularity = env.physical.service.mean(axis=1) / 5, env.physical.circularity / 5
    limit = bound(network, uncertain=Sampling(draws=64, fit_draws=8), min_service=np.maximum(levels - 0.02, 0.0))
    assert 0.5 < levels[1] < 0.99
    assert circularity.mean() <= limit.value + 0.05
    assert limit.value < circularity.mean() + 2.0


@pytest.mark.parametrize("futures", [None, 2])
@pytest.mark.slow
def test_mpc_plans_for_disturbed_contents_as_expected(futures: int | None) -> None:
    """From stocks with whatever is in them: both services come out better than as usual, in every copy."""
    means = []
    for controller in (MPC(min_service=1.0, futures=futures), Neutral()):
        env = MultiAgentVectorEnv(unforeseen(), num_envs=6)
        means.append(rollout(env, controller, seed=3).episode_levels.mean(axis=0))
        if isinstance(controller, MPC):
            assert not controller.note
    assert (means[0] >= 0.97).all() and (means[1] < 0.85).all()


@pytest.mark.slow
@pytest.mark.parametrize("options", [{}, {"horizon": 5}, {"futures": 2}, {"aim": "ore"}], ids=str)
def test_mpc_delivers_what_is_demanded_of_disturbed_contents(options: dict[str, Any]) -> None:
    """In every episode as much as is asked for, and no more of the product, whatever is charged for."""
    run = rollout(MultiAgentVectorEnv(booked_mine(), num_envs=2), MPC(min_service=0.75, **options), seed=0)
    assert run.episode_levels.min() >= 0.75 - 2e-3
    assert run.episode_levels[:, 0].max() <= 0.75 + 2e-3


@pytest.mark.slow
def test_mpc_keeps_expected_budgets_beside_disturbed_contents() -> None:
    """What is mined and what is delivered are on average as demanded; who is not charged mines more."""
    env, budget = MultiAgentVectorEnv(booked_mine(), num_envs=8), 23.9
    free, run = (rollout(env, MPC(min_service=0.75, at_most=at_most), seed=0) for at_most in (None, {"ore": budget}))
    assert (run.episode_levels.mean(axis=0) >= 0.75 - 2e-3).all()
    assert run.accounts.mean() <= budget * (1 + 2e-3) < free.accounts.mean()


def booked_mine() -> Network:
    """Return a disturbed mine that books what it mines."""
    network = mine(disturbances={"noise": NOISE}, disturbed={PATHS[0]: DisturbanceEffect(by="noise")})
    arcs = tuple(replace(arc, accounts={"ore": 1.0} if arc.id == "mined" else {}) for arc in network.arcs)
    return replace(network, arcs=arcs, accounts=(Account(id="ore", unit="EUR_2023"),))


def test_present_contents_are_those_of_the_copies() -> None:
    """From the least to the greatest part of each component in any copy, and stage."""
    env, _ = rollout_of(unforeseen(), 5, 1)
    least, most = present_contents(env.rows, env.physical.stock)
    parts = env.physical.stock[[i + 3 * c for c in range(3) for i in (1, 2)]].reshape(3, 2, 5)
    parts = parts / parts.sum(axis=0)
    np.testing.assert_allclose(least[:, 1:], parts.min(axis=2), rtol=1e-12)
    np.testing.assert_allclose(most[:, 1:], parts.max(axis=2), rtol=1e-12)
    assert (least[1:, 1:] < most[1:, 1:]).all()


def changed(**changes: Any) -> Network:
    """Return the mine with other fields of its ore."""
    network = mine()
    return replace(network, nodes=(replace(network.nodes[0], **changes), *network.nodes[1:]))


@pytest.mark.parametrize(
    ("mistake", "message"),
    [
        (
            lambda: mine(copper=Series(times=(0.0, 2.0), values=(0.2, 1.2)), tin=0.0),
            "content.copper 1.2 must lie in [0, 1], at time 2 of",
        ),
        (lambda: mine(copper=Series(times=(1.0,), values=(0.2,))), "content.copper: series begins at 1"),
        (lambda: mine(tin=Series(times=(0.0, 3.0), values=(0.8, 0.95))), "its substances sum to 1.05 of its mass"),
        (
            lambda: replace(mine(), arcs=(*mine().arcs, Arc(id="back", donor="use", recipient="ore", rate=0.1))),
            "node 'ore': content: arc 'back' enters it: a stock mixes what enters it",
        ),
        (
            lambda: replace(mine(), arcs=(*mine().arcs, Arc(id="leak", donor="ore", recipient="use", rate=0.1))),
            "node 'ore': content: arc 'leak' leaves it by law 'donor'",
        ),
        (
            lambda: changed(
                lifetime=Lifetime(mean=3.0, deviation=1.0), history=HISTORY, content={"copper": replace(POORER)}
            ),
            "content.copper: series begins at 0, not before the episode does",
        ),
        (
            lambda: changed(
                lifetime=Lifetime(mean=3.0, deviation=1.0),
                history=HISTORY,
                content={"copper": Series(times=(-4.0,), values=(0.1,))},
            ),
            "node 'ore': content: series begins at -4, after the history at -5",
        ),
        (
            lambda: mine(
                disturbances={"noise": replace(NOISE, high=6.0)}, disturbed={PATHS[0]: DisturbanceEffect(by="noise")}
            ),
            "some draws of its contents sum to 1.22, more than 1",
        ),
        (
            lambda: mine(
                disturbances={"noise": NOISE}, disturbed={"nodes.ore.content.cooper": DisturbanceEffect(by="noise")}
            ),
            "nodes.ore.content.cooper: content: unknown substance 'cooper'. Did you mean 'copper'?",
        ),
    ],
)
def test_mistakes_are_named(mistake, message: str) -> None:  # type: ignore[no-untyped-def]
    """What cannot be is refused, with the object, its value and the nearest valid one."""
    with pytest.raises(NetworkError) as error:
        mistake()
    assert message in str(error.value)


def test_files_say_how_contents_change(tmp_path: Path) -> None:
    """By series, distributions and disturbances, of which a scenario states others."""
    path = tmp_path / "mine.toml"
    richer = '\n[scenarios.rich.nodes.ore]\ncontent.copper = { value = 25, unit = "%", source = "s" }\n'
    path.write_text(definition_of(unforeseen()) + richer)
    network = load_network(path)
    assert (network.nodes, network.uncertain) == (unforeseen().nodes, unforeseen().uncertain)
    assert network.disturbed == unforeseen().disturbed
    assert dict(network.scenario("rich").nodes[0].content)["copper"] == 0.25


def test_draws_of_histories_are_summed_at_the_same_time() -> None:
    """Copper and tin of a past in which one gave way to the other are never both at their most."""
    network, times = mine(), (-5.0, -2.0)
    past = {"copper": Series(times=times, values=(0.8, 0.1)), "tin": Series(times=times, values=(0.1, 0.8))}
    lifetime = Lifetime(mean=3.0, deviation=1.0)
    cars = Node(id="cars", lifetime=lifetime, history=HISTORY, content=past)
    arcs = (*network.arcs, Arc(id="scrapped", donor="cars", recipient="tailings", law=Law.SHARE))

    def drawn(high: float) -> Network:
        spread = Spread(low=0.9, high=high, distribution="uniform")
        return replace(
            network, nodes=(*network.nodes, cars), arcs=arcs, uncertain={"nodes.cars.content.copper": spread}
        )

    assert drawn(1.1).uncertain
    with pytest.raises(NetworkError, match=r"some draws of its contents sum to 1.02, more than 1"):
        drawn(1.15)
