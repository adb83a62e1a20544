"""What holds for every network under any action (mass, positivity, determinism, equal views)."""

from __future__ import annotations

import pickle
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from conftest import random_network
from hypothesis import example, given
from hypothesis import strategies as st
from small_networks import PLAYED, disturbed_networks
from test_batch_contents import batch_networks
from test_substances import substances_networks

from cirl_marl import Law, MultiAgentVectorEnv, Network, SingleAgentEnv, load_network, parallel_env
from cirl_marl.network.elements import REWARDS
from cirl_marl.testing import check_parallel_env, check_vector_env
from cirl_marl.testing.nested import same_or_raise

EPS = float(np.finfo(float).eps)
CATALOGUE = [pytest.param(name, scenario, id=f"{name}-{scenario}") for name, scenario in PLAYED]
Actions = dict[str, np.ndarray[Any, Any]]
anything = pytest.mark.parametrize(("name", "scenario"), CATALOGUE)
any_network = st.from_type(Network) | disturbed_networks()
random_networks = given(network=any_network, seed=st.integers(0, 2**31))


def draw(env: MultiAgentVectorEnv, rng: np.random.Generator) -> Actions:
    """Draw actions, a third of them at the bounds."""
    shapes = {agent: (env.num_envs, *env.action_spaces[agent].shape) for agent in env.agents}
    drawn = {agent: np.clip(rng.uniform(-1.5, 1.5, shape), -1, 1) for agent, shape in shapes.items()}
    return {agent: action.astype(np.float32) for agent, action in drawn.items()}


def lone(actions: Actions, i: int) -> Actions:
    """Return the actions of copy ``i``."""
    return {agent: action[i] for agent, action in actions.items()}


def episode(env: MultiAgentVectorEnv, seed: int) -> Iterator[Actions]:
    """Reset and yield the actions of one episode."""
    rng = np.random.default_rng(seed)
    env.reset(seed)
    for _ in range(env.network.episode.horizon):
        yield draw(env, rng)


def assert_conserves(network: Network, seed: int) -> None:
    """Mass to round-off, stocks finite and, in the physical mode, not negative."""
    env = MultiAgentVectorEnv(network, num_envs=3)
    moved = np.zeros(3)
    start = largest = None
    for step, actions in enumerate(episode(env, seed), start=1):
        if start is None or largest is None:
            start = env.physical.stock[:-1].copy()
            largest = np.abs(start).sum(axis=0)
        outcome = env.advance(env.stack(actions))
        stock = env.physical.stock[:-1]
        moved += np.abs(outcome.flow).sum(axis=0) * network.episode.control_interval
        largest = np.maximum(largest, np.abs(stock).sum(axis=0))
        assert np.isfinite(stock).all()
        residual = np.abs((stock - start).sum(axis=0))
        # 1e-12 of what moved, plus what adding the flows to the stocks rounds away in each solver step
        bound = 1e-12 * moved + step * env.dynamics.substeps * EPS * largest
        assert (residual <= bound).all(), f"step {step}: residual {residual}, bound {bound}"
        if env.dynamics.physical:
            assert (stock >= 0).all(), f"step {step}: stock {stock.min()}"
            assert (outcome.flow >= 0).all(), f"step {step}: flow {outcome.flow.min()}"


@random_networks
def test_random_networks_conserve_mass(network: Network, seed: int) -> None:
    """Mass is conserved to round-off and stocks stay non-negative and finite."""
    assert_conserves(network, seed)


@pytest.mark.medium
@pytest.mark.sample(5)
@anything
def test_catalogue_conserves_mass(name: str, scenario: str) -> None:
    """Mass is conserved to round-off and stocks stay non-negative and finite."""
    assert_conserves(load_network(name, scenario=scenario), 1)


def assert_batch_is_lone(network: Network, seed: int, reward: str) -> None:
    """Copy i of a batch equals a lone environment with seed + i, bit for bit."""
    batch = MultiAgentVectorEnv(network, num_envs=3, reward=reward)
    alone = [parallel_env(network, reward=reward) for _ in range(3)]
    seen = batch.reset(seed)
    for i, env in enumerate(alone):
        for agent, observation in env.reset(seed + i)[0].items():
            np.testing.assert_array_equal(observation, seen[agent][i])
    rng = np.random.default_rng(seed)
    for _ in range(network.episode.horizon):
        actions = draw(batch, rng)
        outcome = batch.advance(batch.stack(actions))
        for i, env in enumerate(alone):
            observations, rewards, _, truncations, infos = env.step(lone(actions, i))
            for row, agent in enumerate(batch.agents):
                np.testing.assert_array_equal(observations[agent], outcome.observation[batch.layout.slices[agent], i])
                assert rewards[agent] == outcome.reward[row, i]
                assert infos[agent]["circularity"] == outcome.circularity[i]
                assert infos[agent]["service_level"] == outcome.service_level[i]
                assert infos[agent]["local_reward"] == outcome.local[row, i]
                np.testing.assert_array_equal(infos[agent]["flows"], outcome.flow[:, i])
                assert truncations[agent] == outcome.truncated[i]
            np.testing.assert_array_equal(env.state(), batch.state()[i])
            np.testing.assert_array_equal(env.batch.physical.stock[:, 0], batch.physical.stock[:, i])
            np.testing.assert_array_equal(env.batch.physical.substances[:, 0], batch.physical.substances[:, i])


@pytest.mark.medium
@pytest.mark.sample(2)
@pytest.mark.parametrize("networks", [any_network, substances_networks, batch_networks])
@given(data=st.data(), seed=st.integers(0, 2**31), reward=st.sampled_from(REWARDS))
def test_random_batch_equals_lone(
    networks: st.SearchStrategy[Network], data: st.DataObject, seed: int, reward: str
) -> None:
    """Same seed, same bits; a copy of a batch equals a lone environment, and all views agree."""
    assert_batch_is_lone(data.draw(networks), seed, reward)


@pytest.mark.sample(10)
@pytest.mark.parametrize("reward", REWARDS)
@anything
@pytest.mark.medium
def test_catalogue_batch_equals_lone(name: str, scenario: str, reward: str) -> None:
    """Same seed, same bits; a copy of a batch equals a lone environment, and all views agree."""
    network = load_network(name, scenario=scenario).with_options(episode={"horizon": 5})
    assert_batch_is_lone(network, 3, reward)


@anything
@pytest.mark.sample(15)
def test_single_equals_parallel(name: str, scenario: str) -> None:
    """One agent under Gymnasium is the same agent under PettingZoo, bit for bit."""
    network = load_network(name, scenario=scenario).with_options(episode={"horizon": 6})
    agent = network.agents[0]
    one, many = SingleAgentEnv(network, agent), parallel_env(network, agents=[agent])
    np.testing.assert_array_equal(one.reset(seed=4)[0], many.reset(4)[0][agent])
    rng = np.random.default_rng(0)
    for _ in range(6):
        action = rng.uniform(-1, 1, one.action_space.shape).astype(np.float32)
        observation, reward, terminated, truncated, info = one.step(action)
        observations, rewards, terminations, truncations, infos = many.step({agent: action})
        np.testing.assert_array_equal(observation, observations[agent])
        assert (reward, terminated, truncated) == (rewards[agent], terminations[agent], truncations[agent])
        assert info["circularity"] == infos[agent]["circularity"]
    assert truncated


@pytest.mark.medium
@random_networks
def test_random_networks_conform(network: Network, seed: int) -> None:
    """Determinism and membership, over whole episodes and restarts."""
    check_parallel_env(lambda: parallel_env(network), seed=seed)
    check_vector_env(lambda: MultiAgentVectorEnv(network, num_envs=2), steps=6, seed=seed)


@given(network=any_network, seed=st.integers(0, 2**31), mode=st.sampled_from(["neighbours", "full"]))
@example(network=random_network(14662095, 8, 0, lifetimes=True), seed=0, mode="neighbours")  # what comes out of slots
@example(network=random_network(83522, 12, 4, lifetimes=True), seed=0, mode="neighbours")  # a pass of 1 less rounding
def test_wider_observations_conform(network: Network, seed: int, mode: str) -> None:
    """Membership in the other observation modes."""
    check_vector_env(lambda: MultiAgentVectorEnv(network, num_envs=2, observe=mode), steps=6, seed=seed)


def assert_window_circularity(network: Network, seed: int) -> None:
    """λ̄ = −(Δ·(finite-time sustainable mass that flowed)/T + mean of m_fb)."""
    env = MultiAgentVectorEnv(network, num_envs=3)
    interval, horizon = network.episode.control_interval, network.episode.horizon
    infos: dict[str, dict[str, Any]] = {}
    moved = np.zeros((len(network.arcs), 3))
    batched = np.zeros((2, 3))
    continuous = np.array([arc.law is not Law.BATCH for arc in network.arcs], dtype=bool)
    for step, actions in enumerate(episode(env, seed)):
        held = env.physical.stock.copy()
        sent = env.dynamics.batches.dispatch(held, env.physical.step)
        batched += env.physical.batched + sent
        assert step > 0 or not env.physical.batched.any()
        infos = env.step(actions)[4]
        moved += infos[env.agents[0]]["flows"].T * interval
    lost = network.sustainability[continuous] @ moved[continuous]
    expected = -network.objective.reference_interval * lost / (interval * horizon) - batched.sum(axis=0) / horizon
    tolerance = 1e-12 * (1 + network.objective.reference_interval * moved.sum(axis=0) / (interval * horizon))
    tolerance = tolerance + 1e-12 * np.abs(batched).sum(axis=0)
    for agent in env.agents:
        assert (np.abs(infos[agent]["episode_circularity"] - expected) <= tolerance).all()


@random_networks
def test_window_circularity_is_mass_moved(network: Network, seed: int) -> None:
    """The mean of λ over an episode follows from the mass moved."""
    assert_window_circularity(network.with_options(objective={"net_zero": "signed"}), seed)


def test_window_circularity_is_read_off_the_stocks() -> None:
    """In copper_net the mine's loss and the landfill's gain are all that counts."""
    network = load_network("copper_net")
    env = MultiAgentVectorEnv(network, num_envs=2)
    mine, landfill = network.node_index["mine"], network.node_index["landfill"]
    means = np.zeros(2)
    start = end = np.zeros((2, 1))
    for step, actions in enumerate(episode(env, 0)):
        start = env.state() if step == 0 else start
        means += env.advance(env.stack(actions)).circularity_mean
        end = env.state()
    lost = start[:, mine] - end[:, mine] + end[:, landfill] - start[:, landfill]
    time = network.episode.control_interval * network.episode.horizon
    # the mine holds 1e6 kt, of which EPS is 2e-10 kt
    np.testing.assert_allclose(means / network.episode.horizon, -lost / time, rtol=1e-10)


@pytest.mark.medium
@random_networks
def test_snapshot_replays(network: Network, seed: int) -> None:
    """From a snapshot in mid-episode, also a pickled one, all comes again, restarts included."""
    env = MultiAgentVectorEnv(network, num_envs=2)
    rng = np.random.default_rng(seed)
    shown = env.reset(seed)
    for _ in range(network.episode.horizon // 2):
        shown = env.step(draw(env, rng))[0]
    snapshot = env.snapshot()
    before = env.state().copy()
    stored = pickle.dumps(snapshot)
    actions = [draw(env, rng) for _ in range(network.episode.horizon + 1)]
    first = [(*env.step(a)[:2], env.state().copy()) for a in actions]
    fresh = MultiAgentVectorEnv(network, num_envs=2)
    for other, source in ((env, snapshot), (fresh, pickle.loads(stored))):
        same_or_raise(shown, other.restore(source), "observations of the snapshot and after going back")
        np.testing.assert_array_equal(other.state(), before)
        for a, (observations, rewards, state) in zip(actions, first, strict=True):
            seen, earned = other.step(a)[:2]
            for agent in env.agents:
                np.testing.assert_array_equal(seen[agent], observations[agent])
                np.testing.assert_array_equal(earned[agent], rewards[agent])
            np.testing.assert_array_equal(other.state(), state)


@given(network=st.from_type(Network), seed=st.integers(0, 2**31))
@example(network=load_network("copper_net"), seed=0)
@example(network=load_network("carbo_net"), seed=0)
def test_circularity_follows_from_the_roles(network: Network, seed: int) -> None:
    """Stopping every flow gives λ = 0; with signs alone λ is linear in the flows."""
    signed = network.with_options(objective={"net_zero": "signed"})
    flow = np.random.default_rng(seed).random((len(network.arcs), 2))
    assert (network.circularity(np.zeros_like(flow)) == 0).all()
    np.testing.assert_allclose(signed.circularity(3 * flow), 3 * signed.circularity(flow), rtol=1e-12, atol=1e-12)
    through = network.objective.net_zero == "abs"
    assert not through or (network.circularity(flow) <= signed.circularity(flow) + 1e-12).all()
