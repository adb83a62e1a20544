"""Disturbances in time: moments and conditional means against closed forms, and networks that they disturb."""

from __future__ import annotations

import csv
import re
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import integrate, stats
from small_networks import CORRELATION, KINDS, disturbed_networks
from typer.testing import CliRunner

from cirl_marl import (
    Arc,
    CirlError,
    Constant,
    Control,
    ControlError,
    ControlKind,
    DefinitionError,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    Role,
    Service,
    bound,
    load_network,
    parallel_env,
    plan,
)
from cirl_marl.cli import app
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.definitions.reader import write_network
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.sampling import sample_episodes
from cirl_marl.evaluation.statistics import worst_mean
from cirl_marl.learners.lockstep import NetworkWorld
from cirl_marl.network.disturbances import (
    AutoRegression,
    BlockBootstrap,
    Correlation,
    Disturbance,
    DisturbanceEffect,
    Gaussian,
    Markov,
    RandomWalk,
)
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.processes import Paths
from cirl_marl.network.uncertainty import CAPACITY, Spread, draw_network, expected_network
from cirl_marl.optimum.mpc import MPC, Optimum
from cirl_marl.report.page_data import page_data
from cirl_marl.report.report_page import page_of_samples
from cirl_marl.report.tradeoffs import comparison_notes, summary_of, worst_notes

Floats = NDArray[np.floating]


def line(disturbed: Mapping[str, DisturbanceEffect], names: Mapping[str, Disturbance] = KINDS, **more: Any) -> Network:
    """Return a mine, whose ore is shared out between a dump and a store that leaks and is to be kept full."""
    return Network(
        name="line",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="mill", stores=False),
            Node(id="store", initial=(40.0, 60.0)),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="dig", donor="mine", recipient="mill", law=Law.EXOGENOUS, flow=10.0),
            Arc(id="tails", donor="mill", recipient="dump", law=Law.SHARE, share=0.2),
            Arc(id="metal", donor="mill", recipient="store", law=Law.SHARE),
            Arc(id="leak", donor="store", recipient="dump", rate=0.1),
        ),
        services=(Service(id="metal_kept", provider="store", quantity="stock", low=50.0),),
        disturbances=names,
        disturbed=disturbed,
        **{"episode": Episode(horizon=6), **more},
    )


PLACES = ("arcs.dig.flow", "arcs.tails.share", "arcs.leak.rate", "services.metal_kept.low")
EVERYWHERE = dict(
    zip(PLACES, map(lambda name: DisturbanceEffect(by=name), ("price", "season", "outage", "record")), strict=True)
)


def each_alone(name: str) -> Network:
    """Return a network that one disturbance disturbs."""
    return line({"arcs.dig.flow": DisturbanceEffect(by=name)}, episode=Episode(horizon=12))


def drawn_paths(network: Network, copies: int) -> Paths:
    """Return paths of copies with seeds 0, 1, …."""
    return network.processes.sample(range(copies))


@pytest.mark.parametrize("name", KINDS)
def test_means_are_those_of_many_draws(name: str) -> None:
    """Before anything is known, and given F_t: what remains has mean 0 whatever the state was."""
    processes, disturbance = each_alone(name).processes, KINDS[name]
    paths = drawn_paths(each_alone(name), 4000)
    low, high = disturbance.ends
    assert paths.values.min() >= low and paths.values.max() <= high
    error = paths.values.std(axis=2)[:, 0] / np.sqrt(4000) + 1e-12
    assert (np.abs(paths.values.mean(axis=2)[:, 0] - processes.prior_means(13)[:, 0]) < 5 * error).all()
    means = processes.conditional_means(paths.states[5], 5, 4)
    for k in range(4):
        rest = (paths.values[6 + k] - means[k])[0]
        for weight in (np.ones(4000), paths.values[5, 0] - 1, paths.states[5, 0]):
            product = rest * weight
            assert abs(product.mean()) < 5 * product.std() / np.sqrt(4000) + 1e-12


@pytest.mark.parametrize("name", [name for name, kind in KINDS.items() if isinstance(kind, Gaussian)])
@given(state=st.floats(-4, 4), ahead=st.integers(1, 6), step=st.integers(0, 6))
def test_gaussian_means_are_integrals(name: str, state: float, ahead: int, step: int) -> None:
    """Of the clipped value over the density of the latent one, φ^k z with variance s²(1 + φ² + …)."""
    kind = KINDS[name]
    assert isinstance(kind, Gaussian)
    network = each_alone(name)
    phi, noise = kind.memory
    spread = noise * np.sqrt(sum(phi ** (2 * j) for j in range(ahead)))
    offset = kind.offsets(step + ahead + 1, 1.0)[-1]
    low, high = kind.ends

    def density(z: float) -> float:
        latent = offset + kind.deviation * z
        value = np.clip(np.exp(latent) if kind.logarithm else latent, low, high)
        return float(value * stats.norm.pdf(z, phi**ahead * state, spread))

    middle = phi**ahead * state
    bends = [((np.log(end) if kind.logarithm else end) - offset) / kind.deviation for end in (low, high)]
    edges = [middle - 12 * spread, middle + 12 * spread]
    edges[1:1] = sorted(bend for bend in bends if edges[0] < bend < edges[1])
    parts = [integrate.quad(density, a, b, epsabs=1e-12)[0] for a, b in pairwise(edges)]
    found = network.processes.conditional_means(np.array([[state]]), step, ahead)[-1, 0, 0]
    assert found == pytest.approx(sum(parts), abs=1e-9)


def test_chains_and_records_by_their_matrix() -> None:
    """Conditional means are powers of the transition matrix times the values, whatever the state."""
    outage, record = KINDS["outage"], KINDS["record"]
    assert isinstance(outage, Markov) and isinstance(record, BlockBootstrap)
    places, leave = len(record.values), 1 / record.block
    shift = np.roll(np.eye(places), 1, axis=1) * (1 - leave) + leave / places
    for name, matrix, values in (("outage", outage.transitions, outage.values), ("record", shift, record.values)):
        states = np.arange(len(values), dtype=float)[None]
        found = each_alone(name).processes.conditional_means(states, 0, 5)[:, 0]
        for k in range(5):
            np.testing.assert_allclose(found[k], np.linalg.matrix_power(matrix, k + 1) @ values, rtol=1e-12)
    np.testing.assert_allclose(outage.stationary @ outage.transitions, outage.stationary, atol=1e-12)
    stop = KINDS["stop"]
    assert isinstance(stop, Markov)
    np.testing.assert_allclose(stop.transitions, [[7 / 8, 1 / 8], [1 / 2, 1 / 2]])


def test_what_is_correlated_is() -> None:
    """Innovations by the matrix, and stationary states by what follows from it and their memories."""
    places = dict(
        zip(PLACES, map(lambda name: DisturbanceEffect(by=name), ("price", "walk", "season", "stop")), strict=True)
    )
    network = line(places, correlation=CORRELATION)
    states = drawn_paths(network, 20_000).states
    row = {name: i for i, name in enumerate(network.processes.names)}
    memory = {name: KINDS[name].memory[0] for name in row if isinstance(KINDS[name], Gaussian)}
    for i, a in enumerate(CORRELATION.names):
        for j, b in enumerate(CORRELATION.names):
            steps = [states[3, row[name]] - memory[name] * states[2, row[name]] for name in (a, b)]
            assert np.corrcoef(*steps)[0, 1] == pytest.approx(CORRELATION.matrix[i][j], abs=0.03)
    phi, psi = memory["price"], memory["season"]
    expected = -0.3 * np.sqrt((1 - phi**2) * (1 - psi**2)) / (1 - phi * psi)
    for t in (0, 4):
        for name in ("price", "season"):  # as at any other time
            assert states[t, row[name]].var() == pytest.approx(1.0, rel=0.05)
        assert np.corrcoef(states[t, row["price"]], states[t, row["season"]])[0, 1] == pytest.approx(expected, abs=0.03)


def test_streams_are_apart() -> None:
    """Starts are as without disturbances; a copy's path follows from its seed alone; actions do not change it."""
    network, certain = line(EVERYWHERE), line({})
    env, plain = (MultiAgentVectorEnv(each, num_envs=3) for each in (network, certain))
    env.reset(seed=7)
    plain.reset(seed=7)
    np.testing.assert_array_equal(env.physical.stock[1:], plain.physical.stock[1:])  # the mine needs a larger reserve
    lone = MultiAgentVectorEnv(network, num_envs=1)
    lone.reset(seed=9)
    np.testing.assert_array_equal(env.physical.disturbances[..., 2:], lone.physical.disturbances)
    paths = network.processes.sample((7, 8, 9))
    np.testing.assert_array_equal(env.physical.processes, paths.states)
    np.testing.assert_array_equal(env.physical.disturbances, paths.values)
    shorter = MultiAgentVectorEnv(network, num_envs=3, horizon=4)
    shorter.reset(seed=7)
    np.testing.assert_array_equal(shorter.physical.disturbances, paths.values[:5])


@pytest.mark.medium
@given(disturbed_networks(), st.integers(0, 99))
def test_a_disturbed_network_is_the_network_of_its_path(network: Network, seed: int) -> None:
    """Simulated with series of what came; mass is kept, no stock negative; batch = lone, and back is as before."""
    options: dict[str, Any] = {"uncertain": bool(network.uncertain), "reward": "mixed_difference"}
    env, lone = (MultiAgentVectorEnv(network, num_envs=copies, **options) for copies in (2, 1))
    env.reset(seed=seed)
    lone.reset(seed=seed + 1)
    certain = MultiAgentVectorEnv(env.certain_network(1), num_envs=1, reward="mixed_difference")
    start = env.physical.stock[env.rows.nodes, 1].tolist()
    certain.reset(seed=0, options={"initial_state": dict(zip(env.rows.start_names, start, strict=True))})
    assert certain.dynamics.substeps == env.dynamics.substeps  # else another part of what is scheduled is cut
    rng, saved, seen = np.random.default_rng(seed), env.snapshot(), []
    entries = sum(space.shape[0] for space in env.action_spaces.values())
    mass = env.physical.stock[: env.rows.unit].sum(axis=0)
    for _ in range(network.episode.horizon):
        action = rng.uniform(-1, 1, (entries, 1))
        outcome = env.advance(np.repeat(action, 2, axis=1))
        alone, other = lone.advance(action), certain.advance(action)
        seen.append((action, outcome))
        np.testing.assert_array_equal(outcome.observation[:, 1], alone.observation[:, 0])
        np.testing.assert_array_equal(outcome.reward[:, 1], alone.reward[:, 0])
        assert (env.physical.stock >= 0).all()
        np.testing.assert_allclose(env.physical.stock[: env.rows.unit].sum(axis=0), mass, rtol=1e-12)
        for space, row in zip(env.observation_spaces.values(), env.by_agent(outcome.observation).values(), strict=True):
            assert all(space.contains(copy) for copy in row)
        for what in ("flow", "circularity_mean", "levels", "reward", "local"):
            ours, theirs = getattr(outcome, what)[..., 1], getattr(other, what)[..., 0]
            np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-8, err_msg=what)
    env.restore(saved)
    for action, outcome in seen:
        np.testing.assert_array_equal(env.advance(np.repeat(action, 2, axis=1)).observation, outcome.observation)


def test_a_summand_is_added() -> None:
    """To what was drawn, in its own unit; the reserve of the mine is enough for whatever comes."""
    more = AutoRegression(unit="kg/day", mean=0.0, deviation=4.0, persistence=0.5, low=-5.0, high=6.0)
    network = line(
        {"arcs.dig.flow": DisturbanceEffect(by="more", adds=True)},
        {"more": more},
        uncertain={"arcs.dig.flow": Spread(low=0.9, high=1.1, distribution="uniform")},
    )
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    env.reset(seed=0)
    for t in range(6):
        outcome = env.advance(np.empty((0, 3)))
        expected = 10.0 * env.physical.factors[0] + env.physical.disturbances[t, 0]
        np.testing.assert_allclose(outcome.flow[0], expected, rtol=1e-12)
    assert network.initial[0, network.node_index["mine"]] == pytest.approx(6 * (11.0 + 6.0))


def test_what_agents_see() -> None:
    """The value of the coming interval, an earlier one, means of later ones, as a share of the largest; or nothing."""
    names: dict[str, Any] = {**KINDS, "hidden": Markov(values=(1.0, 0.9), lengths=(5.0, 5.0), observed="none")}
    copper = load_network("copper_net").with_options(episode={"horizon": 5})
    arcs = [arc.id for arc in copper.arcs if arc.law is Law.DONOR]
    by = ("price", "ore", "hidden")
    names["ore"] = replace(names["ore"], observed_by=("mine",))
    disturbed = {f"arcs.{arc}.rate": DisturbanceEffect(by=name) for arc, name in zip(arcs, by, strict=False)}
    network = replace(copper, disturbances=names, disturbed=disturbed)
    env = MultiAgentVectorEnv(network, num_envs=2)
    seen = env.reset(seed=3)
    assert env.observation_names["mine"][-5:] == (
        "disturbance price",
        "forecast of price in 1 intervals",
        "forecast of price in 2 intervals",
        "disturbance ore 2 intervals ago",
        "time",
    )
    assert not any("disturbance ore" in name for name in env.observation_names["use"])
    size = {name: max(map(abs, names[name].ends)) for name in by}
    assert env.state_names[-3:] == ("price.latent", "ore.latent", "hidden.regime")
    for t in range(6):
        state = env.physical
        means = network.processes.conditional_means(state.processes[t], t, 2)[:, 0] / size["price"]
        past = state.disturbances[t - 2, 1] if t >= 2 else np.full(2, 1.05)
        expected = np.array([state.disturbances[t, 0] / size["price"], *means, past / size["ore"]]).T
        np.testing.assert_allclose(seen["mine"][:, -5:-1], expected, rtol=1e-6)
        np.testing.assert_array_equal(env.state()[:, -4:-1], state.processes[t].T)
        np.testing.assert_array_equal(env.observations()["mine"], seen["mine"])
        if t < 5:
            outcome = env.advance(env.stack(env.neutral_action))
            seen = env.by_agent(outcome.observation)
            told = env.team_info(outcome)["disturbances"]
            assert [*told] == [*by]
            for name, values in zip(by, state.disturbances[t], strict=True):
                np.testing.assert_array_equal(told[name], values)
    lone = parallel_env(network)
    assert set(lone.reset(seed=3)[1]["mine"]["disturbances"]) == {*by}


def test_episodes_go_on_drawing() -> None:
    """In the next episode there is something else; a snapshot has the streams, and fits what it was taken of."""
    network = line(EVERYWHERE, episode=Episode(horizon=2))
    env = MultiAgentVectorEnv(network, num_envs=2)
    env.reset(seed=1)
    saved, first = env.snapshot(), env.physical.disturbances.copy()
    for _ in range(2):
        env.step({})
    second = env.physical.disturbances.copy()
    assert (second[:, 0] != first[:, 0]).any()
    env.restore(saved)
    for _ in range(2):
        env.step({})
    np.testing.assert_array_equal(env.physical.disturbances, second)
    with pytest.raises(ControlError, match="another definition"):
        MultiAgentVectorEnv(line({}, episode=Episode(horizon=2)), num_envs=2).restore(saved)


def test_plans_are_for_what_is_expected() -> None:
    """Expected flows are conditional means from the state on; no bound is proved of what nobody foresees."""
    copper = load_network("copper_net").with_options(episode={"horizon": 6})
    (arc, *_) = (arc for arc in copper.arcs if arc.law is Law.DONOR)
    network = replace(copper, disturbances=KINDS, disturbed={f"arcs.{arc.id}.rate": DisturbanceEffect(by="stop")})
    prior, states = network.processes.prior_means(6)[:, 0], np.array([0.0])
    expected = expected_network(network)
    assert isinstance(arc.rate, float)
    np.testing.assert_allclose(expected.interval_means(expected.arcs[network.arc_index[arc.id]].rate), arc.rate * prior)
    later = expected_network(network, states, 2)
    means = network.processes.conditional_means(states[:, None], 2, 3)[:, 0, 0]
    found = later.interval_means(later.arcs[network.arc_index[arc.id]].rate)
    np.testing.assert_allclose(found[2:], np.array([1.0, *means]) * arc.rate)
    with pytest.raises(CirlError, match=r"nobody foresees what disturbs it \(stop\)"):
        bound(network)
    env = MultiAgentVectorEnv(network, num_envs=2, agents=["mine"])
    for controller in (Optimum(min_service=0.5), MPC(replan=6, min_service=0.5)):
        assert rollout(env, controller).episode_circularity.shape == (2,)
    assert not expected.disturbed and expected_network(copper) is copper
    table = plan(network, "optimum", min_service=0.5)
    assert not table.proof and "expected to be, carried out whatever they are" in str(table)


def works(neutral: float = 6.0, **more: Any) -> Network:
    """Return a mine whose output is ordered within a capacity, and a furnace with a valve."""
    order = Control(kind=ControlKind.FLOW, low=1.0, neutral=neutral, high=8.0)
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=1.0)
    return Network(
        name="works",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="furnace", initial=(30.0, 30.0), control=valve),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="dig", donor="mine", recipient="furnace", law=Law.CONTROLLED, control=order, **more),
            Arc(id="melt", donor="furnace", recipient="dump", rate=0.2),
        ),
        services=(Service(id="molten", provider="furnace", quantity="stock", low=40.0),),
        episode=Episode(horizon=8),
    )


def test_capacities_are_disturbed() -> None:
    """The whole range of actions is what there is; who is neutral, or makes up for something, takes no more."""
    names = {"outage": KINDS["outage"], "boom": RandomWalk(deviation=0.3, low=0.5, high=1.5)}
    effects = {f"arcs.dig.{CAPACITY}": "boom", f"nodes.furnace.{CAPACITY}": "outage"}
    disturbed = {path: DisturbanceEffect(by=by) for path, by in effects.items()}
    network = replace(works(), disturbances=names, disturbed=disturbed)
    env = MultiAgentVectorEnv(network, num_envs=3, reward="difference")
    assert network.initial[0, network.node_index["mine"]] == pytest.approx(8 * 8.0 * 1.5, rel=1e-6)
    env.reset(seed=1)
    for t in range(8):
        outage, boom = env.physical.disturbances[t]
        most = 8.0 * boom
        neutral = np.minimum(6.0, most)
        np.testing.assert_allclose(env.neutral_action["dig"][:, 0], 2 * (neutral - 1) / (most - 1) - 1)
        asked = env.unstack(np.random.default_rng(t).uniform(-1, 1, (2, 3)))
        action = asked["dig"][:, 0]
        before, factors = env.physical, env.factors_in(env.physical.step)
        outcome = env.advance(env.stack(asked))
        np.testing.assert_allclose(outcome.flow[0], 1 + (action + 1) / 2 * (most - 1), rtol=1e-12)
        np.testing.assert_allclose(env.controls[0], (asked["furnace"][:, 0] + 1) / 2 * outage, atol=1e-12)
        # what would have been, had the mine been neutral
        controls = env.controls.copy()
        controls[1] = neutral
        other = env.dynamics.advance(before.stock, before.inner, controls, before.step, factors)
        expected = outcome.circularity - network.circularity(other.flow)
        np.testing.assert_allclose(outcome.reward[env.agents.index("dig")], expected, atol=1e-9)
    idle = MultiAgentVectorEnv(network, num_envs=3, agents=["furnace"])
    idle.reset(seed=1)
    lowest = np.full(3, 6.0)
    for t in range(8):
        idle.advance(np.zeros((1, 3)))
        np.testing.assert_allclose(idle.controls[1], np.minimum(6.0, 8.0 * idle.physical.disturbances[t, 1]))
        lowest = np.minimum(lowest, idle.controls[1])
    assert lowest.min() < 5.9
    faster = {f"nodes.furnace.{CAPACITY}": DisturbanceEffect(by="boom")}
    furnace = MultiAgentVectorEnv(replace(network, disturbed=faster), num_envs=1).dynamics
    assert furnace.turnover[network.node_index["furnace"]] == pytest.approx(0.2 * 1.5)
    makes_up = replace(works(makes_up_for="molten"), disturbances=names, disturbed=disturbed)
    run = rollout(MultiAgentVectorEnv(makes_up, num_envs=2), Neutral(), seed=5)
    path = makes_up.processes.sample([5]).values[:-1, :, 0]
    np.testing.assert_allclose(run.controls[:3, 1], 8.0 * path[:3, 1], rtol=1e-9)  # all of it, as much lacks
    certain = rollout(MultiAgentVectorEnv(draw_network(makes_up, (), path), num_envs=1), Neutral(), seed=5)
    np.testing.assert_allclose(certain.circularity_mean[0], run.circularity_mean[0], rtol=1e-12)


def test_capacities_in_files(tmp_path: Path) -> None:
    """A control says what disturbs it; bounds that would cross, and bounds that are no capacity, are refused."""
    effect = {f"arcs.dig.{CAPACITY}": DisturbanceEffect(by="outage")}
    network = replace(works(), disturbances={"outage": KINDS["outage"]}, disturbed=effect)
    path = tmp_path / "works.toml"
    write_network(network, path)
    assert load_network(path).disturbed == effect
    text = path.read_text()
    assert text.count('disturbed_by = "outage"') == 1
    for old, new, message in (
        ("high = 8.0", "high = 6.0", None),
        ("values = [1.0, 0.4, 0.7]", "values = [1.0, 0.1, 0.7]", "'outage' it may be 0.8, below control.low 1; lower"),
        ('disturbed_by = "outage"', 'disturbed_by = "outrage"', "disturbed_by: .*Did you mean 'outage'"),
        ("rate = {value = 0.2", 'rate = {disturbed_by = "outrage", value = 0.2', "Did you mean 'outage'"),
        ("initial = {", 'initial = {disturbed_by = "outage", ', "initial.disturbed_by: only rates, flows, shares"),
        (
            "rate = {value = 0.2",
            'rate = {multiplied_by = {value = 2.0, unit = "1", source = "x", disturbed_by = "outage"}, value = 0.2',
            "rate.multiplied_by.disturbed_by: belongs beside it",
        ),
    ):
        assert old in text
        path.write_text(text.replace(old, new, 1))
        if message is None:
            load_network(path)
        else:
            with pytest.raises(DefinitionError, match=message):
                load_network(path)
    scenario = '[scenarios.hazards.nodes.furnace.control]\ndisturbed_by = "outage"\n'
    path.write_text(f"{text}\n{scenario}")
    assert f"nodes.furnace.{CAPACITY}" in load_network(path, scenario="hazards").disturbed
    shares = replace(line({}), disturbances=KINDS)
    tails = replace(shares.arcs[1], share=None, control=Control(kind=ControlKind.SHARE, low=0.0, neutral=0.1, high=0.2))
    shares = replace(shares, arcs=(shares.arcs[0], tails, *shares.arcs[2:]))
    for part, message in (
        ("arcs.tails", "a control of kind 'share' has no capacity: shares are parts of a whole"),
        ("arcs.leak", "arcs.leak.control.high: it has no control"),
        ("services.metal_kept", "of services these can be uncertain or disturbed: low, high; 'control.high' cannot"),
    ):
        with pytest.raises(NetworkError, match=message):
            replace(shares, disturbed={f"{part}.{CAPACITY}": DisturbanceEffect(by="outage")})
    with pytest.raises(NetworkError, match="can be disturbed in time, but not drawn"):
        replace(works(), uncertain={f"arcs.dig.{CAPACITY}": Spread(low=0.9, high=1.1, distribution="uniform")})


def test_both_ends_of_a_band_may_move_together() -> None:
    """As one disturbance never turns the band; two may."""
    network = line({})
    band = replace(network.services[0], high=55.0)
    ends = {f"services.metal_kept.{end}": DisturbanceEffect(by="record") for end in ("low", "high")}
    moved = replace(network, services=(band,), disturbed=ends)
    env = MultiAgentVectorEnv(moved, num_envs=2)
    env.reset(seed=0, options={"initial_state": {"mine": 20.0, "store": 70.0}})
    outcome = env.advance(np.empty((0, 2)))
    store = env.rows.stocks(env.physical.stock)[moved.node_index["store"]]
    np.testing.assert_allclose(outcome.levels[0], np.minimum(1.0, 55.0 * env.physical.disturbances[0, 0] / store))
    other = {**ends, "services.metal_kept.high": DisturbanceEffect(by="outage")}
    with pytest.raises(NetworkError, match=r"metal_kept.high: disturbed by 'outage': some draws turn the band"):
        replace(network, services=(band,), disturbed=other)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"outage": replace(KINDS["outage"], matrix=((1.0, 0, 0), (0.5, 0.5, 0), (0, 0, 1.0)))}, "never returns to"),
        ({"outage": replace(KINDS["outage"], matrix=((0.5, 0.4, 0), (0.5, 0.5, 0), (0, 1, 0)))}, "row 1: .* sum to 1"),
        (
            {"outage": Markov(values=(1.0, 0.5), lengths=(5.0, 0.5))},
            "lengths: needs 2 numbers of intervals, at least 1",
        ),
        ({"outage": Markov(values=(1.0, 0.5))}, "give either the matrix or the lengths"),
        ({"price": AutoRegression(deviation=0.3, persistence=1.0)}, "persistence 1 must lie between -1 and 1"),
        (
            {"price": AutoRegression(deviation=0.3, persistence=0.5)},
            r"arcs.dig.flow: disturbed by 'price' it may be -0.2",
        ),
        ({"price": AutoRegression(deviation=0.3, persistence=0.5, low=2.0, high=1.0)}, "low 2 must lie below high 1"),
        ({"price": replace(KINDS["price"], observed="none")}, "price: forecast: it is hidden"),
        ({"price": replace(KINDS["price"], delayed=1)}, "price: forecast: .* leave one of the two out"),
        (
            {"price": replace(KINDS["price"], forecast=-1)},
            "forecast -1: must be a number of intervals, 0 to 1000",
        ),
        (
            {"price": replace(KINDS["price"], observed_by=("stor",))},
            "observed_by: unknown agent 'stor'. Did you mean 'store'",
        ),
        ({"walk": replace(KINDS["walk"], start=2.0)}, r"walk: start 2 must lie in \[0.7, 1.3\]"),
    ],
)
def test_mistakes_of_disturbances_are_named(changes: dict[str, Disturbance], message: str) -> None:
    """By name and number."""
    with pytest.raises(NetworkError, match=message):
        line(EVERYWHERE, {**KINDS, **changes})


@pytest.mark.parametrize(
    ("disturbed", "correlation", "message"),
    [
        ({"arcs.dig.flow": DisturbanceEffect(by="prise")}, None, "arcs.dig.flow: disturbed_by: .*Did you mean 'price'"),
        ({"arcs.dig.flw": DisturbanceEffect(by="price")}, None, "of arcs these can be uncertain or disturbed"),
        ({"arcs.leak.flow": DisturbanceEffect(by="price")}, None, "arcs.leak.flow: it is 0"),
        (
            {"nodes.store.stretch": DisturbanceEffect(by="price")},
            None,
            "only a lifetime with a deviation can be stretched",
        ),
        ({}, Correlation(names=("price", "outage"), matrix=((1, 0), (0, 1))), "'outage' is of kind 'markov'"),
        ({}, Correlation(names=("price", "ore"), matrix=((1, 0.5), (0.4, 1))), "is no correlation: symmetric"),
        (
            {},
            Correlation(names=("price", "ore", "walk"), matrix=((1, 0.9, -0.9), (0.9, 1, 0.9), (-0.9, 0.9, 1))),
            "nothing is correlated like that",
        ),
        ({}, Correlation(names=("price", "ore"), matrix=((1,),)), "needs 2 rows of 2 numbers"),
    ],
)
def test_mistakes_of_what_is_disturbed_are_named(
    disturbed: dict[str, DisturbanceEffect], correlation: Correlation | None, message: str
) -> None:
    """By path, or by the table of correlations."""
    with pytest.raises(NetworkError, match=message):
        line(disturbed, correlation=correlation)


def test_a_file_says_all_of_it(tmp_path: Path) -> None:
    """What is written reads back to the last bit; a scenario that says what disturbs a quantity keeps its number."""
    network = line(EVERYWHERE, correlation=CORRELATION)
    path = tmp_path / "line.toml"
    write_network(network, path)
    again = load_network(path)
    assert again.disturbances == network.disturbances and again.disturbed == network.disturbed
    assert again.correlation == CORRELATION
    (tmp_path / "record.csv").write_text("year,grade\n1,1.0\n2,0.8\n3,1.1\n")
    source = 'source = "measured"'
    text = (
        path.read_text()
        + f"""
[scenarios.hazards]
without = ["disturbances.record"]

[scenarios.hazards.disturbances.grade]
kind = "resampled"
values = {{ file = "record.csv", column = "grade" }}
block = 2
unit = "1"
{source}

[scenarios.hazards.disturbances.flood]
kind = "markov"
values = [0.0, 24.0]
lengths = [9, 1]
unit = "kg/hour"
{source}

[scenarios.hazards.arcs.dig]
flow = {{ disturbed_by = "flood", disturbed_as = "summand" }}

[scenarios.hazards.services.metal_kept]
low.disturbed_by = "grade"
"""
    )
    path.write_text(text)
    hazards = load_network(path, scenario="hazards")
    assert hazards.arcs[0].flow == 10.0
    assert hazards.disturbed["arcs.dig.flow"] == DisturbanceEffect(by="flood", adds=True, scale=24.0)
    assert hazards.disturbances["grade"] == BlockBootstrap(values=(1.0, 0.8, 1.1), block=2.0)
    assert hazards.disturbed["services.metal_kept.low"].by == "grade" and "record.csv" in hazards.data_sha256
    for old, new, message in (
        ('kind = "resampled"', 'kind = "resampledd"', "record.kind: .*Did you mean 'resampled'"),
        ("block = 2\n", "", r"scenarios.hazards.disturbances.grade.block: missing"),
        ('"kg/hour"', '"kg"', "flood', which is added: unit 'kg' is inconsistent"),
        (', disturbed_as = "summand"', "", "'flood' has unit 'kg/hour': a factor has unit '1'"),
        ('column = "grade"', 'column = "grad"', "Did you mean 'grade'"),
        ("lengths = [9, 1]", "length = [9, 1]", "Did you mean 'lengths'"),
    ):
        path.write_text(text.replace(old, new))
        with pytest.raises(DefinitionError, match=message):
            load_network(path, scenario="hazards")


def test_supplies_and_difference_rewards_meet_the_same_disturbances() -> None:
    """What makes up for a service, and what would have been, are those of the network of the path."""
    example = Path(__file__).parent.parent / "examples" / "metal_cycle.toml"
    network = load_network(example).scenario("business_as_usual").with_options(episode={"horizon": 5})
    service = network.services[0].id
    shaken = replace(
        network, uncertain={}, disturbances=KINDS, disturbed={f"services.{service}.low": DisturbanceEffect(by="record")}
    )
    env = MultiAgentVectorEnv(shaken, num_envs=2, reward="difference")
    run = rollout(env, Neutral(), seed=2)
    act = rollout(env, Constant(dict.fromkeys(env.agents[:1], 0.5)), seed=2)
    for i in range(2):
        path = shaken.processes.sample([2 + i]).values[:-1, :, 0]
        other = MultiAgentVectorEnv(draw_network(shaken, (), path), num_envs=2, reward="difference")
        for ours, controller in ((run, Neutral()), (act, Constant(dict.fromkeys(env.agents[:1], 0.5)))):
            alone = rollout(other, controller, seed=2)
            np.testing.assert_allclose(ours.circularity_mean[i], alone.circularity_mean[i], rtol=1e-9)
            np.testing.assert_allclose(ours.returns[:, i], alone.returns[:, i], atol=1e-9)


@pytest.mark.medium
def test_the_command_shows_what_happened(tmp_path: Path) -> None:
    """Values of each interval in the table of an episode; bands of them, and means of draws, of many."""
    path = tmp_path / "line.toml"
    write_network(line(EVERYWHERE), path)
    shown = CliRunner().invoke(app, ["simulate", str(path), "--out", str(tmp_path)])
    assert shown.exit_code == 0, shown.output
    (table,) = tmp_path.glob("*neutral.csv")
    with table.open(newline="") as file:
        rows = list(csv.DictReader(file))
    env = MultiAgentVectorEnv(load_network(path), num_envs=1)
    env.reset(seed=first_seed(0))
    assert rows[0]["disturbance price (1)"] == ""
    found = [float(row["disturbance price (1)"]) for row in rows[1:]]
    np.testing.assert_allclose(found, env.physical.disturbances[:-1, 0, 0])
    shown = CliRunner().invoke(app, ["show", str(path), "--picture", str(tmp_path / "line.png")])
    assert shown.exit_code == 0 and re.search(r"outage +│ markov +│ +0.4 … 1 +│ now +│ arcs.leak.rate", shown.output)
    shown = CliRunner().invoke(app, ["simulate", str(path), "--samples", "5", "--out", str(tmp_path)])
    assert shown.exit_code == 0, shown.output
    with (tmp_path / "line_neutral_bands.csv").open(newline="") as file:
        bands = [row for row in csv.DictReader(file) if row["quantity"] == "disturbance outage"]
    with (tmp_path / "line_neutral_draws.csv").open(newline="") as file:
        draws = list(csv.DictReader(file))
    samples = load_network(path).processes.sample(range(first_seed(0), first_seed(0) + 5)).values[:-1]
    names = load_network(path).processes.names
    np.testing.assert_allclose([float(row["mean"]) for row in bands], samples[:, names.index("outage")].mean(axis=1))
    data = page_data(page_of_samples(sample_episodes(load_network(path), samples=5), "neutral"))
    assert [part["id"] for part in data["networks"][0]["disturbances"]] == [*names]
    for i, scene in enumerate(data["scenes"][1:]):
        np.testing.assert_allclose([part["value"] for part in scene["disturbances"]], samples[..., i].T, rtol=1e-5)
    found = [float(row["mean of disturbance record (1)"]) for row in draws]
    np.testing.assert_allclose(found, samples[:, names.index("record")].mean(axis=0))


def test_what_stands_still_throughout_can_be_drawn() -> None:
    """A rate that is disturbed to 0 in all intervals of a short horizon is 0 in the network of that path."""
    network = line(EVERYWHERE).with_options(episode={"horizon": 2})
    path = np.ones((2, len(network.processes.names)))
    path[:, network.processes.names.index("outage")] = 0.0
    env = MultiAgentVectorEnv(draw_network(network, (), path), num_envs=1)
    still = rollout(env, Neutral(), seed=0)
    assert (still.flow[:, env.network.arc_index["leak"]] == 0).all() and (still.flow > 0).any()
    with pytest.raises(CirlError, match="arc 'leak': law 'donor' needs a positive rate"):
        replace(network, arcs=tuple(replace(a, rate=0.0) if a.id == "leak" else a for a in network.arcs), disturbed={})


def test_a_scenario_may_have_a_disturbance_of_another_kind(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its table takes the place of the other; who alone sees it is shown, and pictures of draws name the scenario."""
    path = tmp_path / "line.toml"
    write_network(line(EVERYWHERE), path)
    table = '[scenarios.stops.disturbances.price]\nkind = "markov"\nvalues = [1, 0.5]\nlengths = [4, 2]\n'
    path.write_text(f'{path.read_text()}\n{table}unit = "1"\nsource = "x"\nobserved_by = ["leak"]\n')
    network = load_network(path, scenario="stops")
    assert network.disturbances["price"] == Markov(values=(1.0, 0.5), lengths=(4.0, 2.0), observed_by=("leak",))
    assert network.disturbed == load_network(path).disturbed
    shown = CliRunner().invoke(app, ["show", str(path), "--scenario", "stops"])
    assert re.search(r"price +│ markov +│ +0.5 … 1 +│ now, by leak", shown.output)
    titles = list[str]()
    monkeypatch.setattr("cirl_marl.report.samples.save_bands", lambda *_, title: titles.append(title))
    command = ["simulate", str(path), "--samples", "2", "--steps", "2", "--out", str(tmp_path)]
    for options in ([], ["--scenario", "stops"]):
        assert CliRunner().invoke(app, [*command, *options]).exit_code == 0
    assert titles == ["line, neutral control, 2 samples", "line, scenario stops, neutral control, 2 samples"]


@pytest.mark.medium
def test_the_worst_episodes_are_told(tmp_path: Path) -> None:
    """CVaR with a fraction of an episode, its interval, and that of every policy in tables and files."""
    rng = np.random.default_rng(0)
    draws = rng.normal(size=(400, 250))
    tail = stats.norm.pdf(stats.norm.ppf(0.05)) / -0.05
    found = [worst_mean(row) for row in draws]
    for row, figure in zip(draws[:20], found, strict=False):
        lowest = np.sort(row)[:13]
        assert figure.value == pytest.approx((lowest[:12].sum() + 0.5 * lowest[12]) / 12.5)
    assert np.mean([figure.value for figure in found]) == pytest.approx(tail, abs=0.05)
    assert np.mean([figure.low <= tail <= figure.high for figure in found]) > 0.85
    assert worst_mean(np.array([3.0, 1.0, 2.0])).value == 1.0
    network = line(EVERYWHERE)
    comparison = compare((), ("neutral",), network=network, bounds=False)
    assert comparison.episodes == 256 and comparison.ties == ()
    assert compare((), ("neutral",), network=line({}), bounds=False).episodes == 64
    (row,) = comparison.rows
    kept = comparison.entries[0].rollout
    np.testing.assert_array_equal(
        kept.disturbances[3], network.processes.sample([comparison.first_seed + 3]).values[:-1, :, 0]
    )
    circularity, level = row.worst()
    assert circularity.value == worst_mean(kept.episode_circularity).value < kept.episode_circularity.mean()
    assert level.low <= level.value <= level.high and level.value < row.levels()[0].value == kept.episode_levels.mean()
    assert "worst level of metal_kept" in worst_notes(comparison)[0]
    assert summary_of(comparison)["rows"][0]["worst_service_levels"]["metal_kept"]["value"] == level.value
    held = compare((), ("neutral",), network=network.with_options(episode={"horizon": 3}), episodes=3)
    entry = held.entries[0]
    assert entry.bound is not None and (entry.bound >= entry.circularity - 1e-6).all() and np.ptp(entry.bound) > 0.1


def test_a_world_is_resumed_with_its_disturbances() -> None:
    """From what a checkpoint keeps; one from before there were any is read where there are none."""
    network = line(EVERYWHERE, episode=Episode(horizon=2))
    env, other = (MultiAgentVectorEnv(network, num_envs=2) for _ in range(2))
    world, again = (NetworkWorld(each, [seed, seed + 1], {}) for each, seed in ((env, 3), (other, 8)))
    env.step({})
    again.load_state_dict(world.state_dict())
    for _ in range(4):  # past the end of the episode
        env.step({})
        other.step({})
        np.testing.assert_array_equal(env.state(), other.state())
    certain = MultiAgentVectorEnv(line({}), num_envs=2)
    old = NetworkWorld(certain, [0, 1], {}).state_dict()
    for name in ("processes", "disturbances"):
        del old["state"][name]
    NetworkWorld(MultiAgentVectorEnv(certain.network, num_envs=2), [5, 6], {}).load_state_dict(old)


def test_lifetimes_are_disturbed_unless_they_are_fixed() -> None:
    """A stretch of all that is in use; what leaves follows from it, as in the network of the path."""
    network, disturbed = line({}), {"nodes.store.stretch": DisturbanceEffect(by="record")}
    leak = Arc(id="leak", donor="store", recipient="dump", law=Law.SHARE, share=1.0)
    arcs = tuple(leak if arc.id == "leak" else arc for arc in network.arcs)

    def living(lifetime: Lifetime) -> Network:
        nodes = tuple(replace(n, lifetime=lifetime) if n.id == "store" else n for n in network.nodes)
        return replace(network, nodes=nodes, arcs=arcs, disturbed=disturbed)

    spread = living(Lifetime(mean=5.0, deviation=2.5, distribution="gamma"))
    env = MultiAgentVectorEnv(spread, num_envs=2)
    run = rollout(env, Neutral(), seed=4)
    for i in (0, 1):
        same = MultiAgentVectorEnv(env.certain_network(i), num_envs=2)
        np.testing.assert_allclose(
            rollout(same, Neutral(), seed=4).circularity_mean[i], run.circularity_mean[i], rtol=1e-9
        )
    assert np.ptp(run.episode_circularity) > 1e-3
    with pytest.raises(
        NetworkError, match=r"nodes.store.stretch: only a lifetime with a deviation can be .* disturbed"
    ):
        living(Lifetime(mean=2.0, distribution="fixed"))


@pytest.mark.medium
def test_episodes_are_added_until_differences_can_be_told() -> None:
    """As those of one comparison with as many; random orders are on average those of who is neutral."""
    outage = replace(KINDS["outage"], values=(1.0, 0.05, 0.5))
    disturbed = {"arcs.melt.rate": DisturbanceEffect(by="outage")}
    network = replace(works(4.5), disturbances={"outage": outage}, disturbed=disturbed, default_agents=("dig",))
    clear = compare((), ("neutral", "scripted"), network=replace(network, default_agents=()), bounds=False)
    assert clear.episodes == 256 and clear.ties == ()
    unclear = compare((), ("random",), network=network, bounds=False)
    assert unclear.episodes > 256
    whole = compare((), ("random",), network=network, bounds=False, episodes=unclear.episodes)
    assert whole.ties is None
    entry, other = unclear.entries[0], whole.entries[0]
    assert entry.name == "neutral" and unclear.entries[1].name == "random"
    for name in ("circularity_mean", "levels", "disturbances", "returns", "flow"):
        np.testing.assert_array_equal(getattr(entry.rollout, name), getattr(other.rollout, name))
    np.testing.assert_allclose(entry.rollout.mean_flow, other.rollout.mean_flow, rtol=1e-12)
    difference = unclear.entries[1].circularity - unclear.entries[0].circularity
    wide = 1.96 * difference.std() / np.sqrt(unclear.episodes) > max(abs(difference.mean()), 0.005 * 6)
    assert unclear.episodes == 1024 or not wide
    assert f"episodes: {unclear.episodes}, doubled from 256 to at most 1,024" in comparison_notes(unclear)[0]
