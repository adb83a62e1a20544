"""Disturbances in time: moments and conditional means against closed forms, and networks that they disturb."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from disturbed_line import EVERYWHERE, PLACES, line, works
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import integrate, stats
from small_networks import CORRELATION, KINDS, disturbed_networks

from cirl_marl import (
    Arc,
    CirlError,
    Constant,
    ControlError,
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
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.learners.lockstep import NetworkWorld
from cirl_marl.network.disturbances import (
    AutoRegression,
    BlockBootstrap,
    DisturbanceEffect,
    Gaussian,
    Markov,
    RandomWalk,
)
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.processes import Paths
from cirl_marl.network.uncertainty import CAPACITY, Spread, draw_network, expected_network
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.open_loop import Optimum

Floats = NDArray[np.floating]


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
    """Expected flows are means before anything is known; no bound is proved of what nobody foresees."""
    copper = load_network("copper_net").with_options(episode={"horizon": 6})
    (arc, *_) = (arc for arc in copper.arcs if arc.law is Law.DONOR)
    network = replace(copper, disturbances=KINDS, disturbed={f"arcs.{arc.id}.rate": DisturbanceEffect(by="stop")})
    prior = network.processes.prior_means(6)[:, 0]
    expected = expected_network(network)
    assert isinstance(arc.rate, float)
    np.testing.assert_allclose(expected.interval_means(expected.arcs[network.arc_index[arc.id]].rate), arc.rate * prior)
    with pytest.raises(CirlError, match=r"nobody foresees what disturbs it \(stop\)"):
        bound(network)
    env = MultiAgentVectorEnv(network, num_envs=2, agents=["mine"])
    for controller in (Optimum(min_service=0.5), MPC(replan=6, min_service=0.5)):
        assert rollout(env, controller).episode_circularity.shape == (2,)
    assert not expected.disturbed and expected_network(copper) is copper
    table = plan(network, "optimum", min_service=0.5)
    assert not table.proof and "expected to be, carried out whatever they are" in str(table)


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


def test_what_stands_still_all_the_time_is_a_network() -> None:
    """In a draw a node may release nothing and a service ask for nothing, so that it has a bound; a file may not."""
    on = DisturbanceEffect(by="on")
    network = Network(
        name="shop",
        nodes=(Node(id="shop", initial=(9.0, 9.0), rate=0.5), Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0))),
        arcs=(Arc(id="sales", donor="shop", recipient="tip", law=Law.SHARE),),
        services=(Service(id="held", provider="shop", quantity="stock", low=5.0),),
        episode=Episode(horizon=3),
        disturbances={"on": Markov(values=(1.0, 0.0), lengths=(2.0, 4.0))},
        disturbed={"nodes.shop.rate": on, "services.held.low": on},
    )
    env = MultiAgentVectorEnv(network, num_envs=8)
    env.reset(seed=0)
    still = (env.physical.disturbances[:-1] == 0).all(axis=(0, 1))
    assert still.any() and not still.all()
    for copy in np.flatnonzero(still).tolist():
        certain = env.certain_network(copy)
        assert bound(certain, min_service=1.0).objective == pytest.approx(0.0, abs=1e-6)
        for field in ("nodes", "services"):
            with pytest.raises(NetworkError, match=r"shares what it releases|asks for nothing"):
                replace(network, **{field: getattr(certain, field)}, disturbances={}, disturbed={})
