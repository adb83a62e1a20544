"""The paper scenario against the published environments."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray

from cirl_marl import Law, VectorEnv, load_network, parallel_env, single_agent_env
from cirl_marl.simulate import Dynamics

REFERENCE = Path(__file__).parent / "reference"
PAPER = {"CopperNet": ("copper_net", "use_to_collection"), "CarboNet": ("carbo_net", "urban_to_capture")}


def reference(name: str) -> dict[str, NDArray[np.float64]]:
    """Return the published trajectory: normalised actions, states and rewards."""
    table = np.loadtxt(REFERENCE / f"{name}.csv", delimiter=",", skiprows=1)
    return {"action": table[:, 0], "state": table[:, 1:-1], "reward": table[:, -1]}


@pytest.mark.parametrize("name", PAPER)
def test_published_trajectory(name: str) -> None:
    """Through gymnasium.make: row t's action leads to row t+1's state and to row t's reward."""
    published = reference(name)
    env = gymnasium.make(f"cirl_marl/{name}-v0", disable_env_checker=True)
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(info["state"], published["state"][0], rtol=1e-9)
    for t in range(50):
        observation, reward, terminated, truncated, info = env.step(published["action"][t : t + 1])
        assert reward == pytest.approx(published["reward"][t], rel=1e-9)
        assert not terminated
        assert truncated == (t == 49)
        if t + 1 < len(published["state"]):
            np.testing.assert_allclose(info["state"], published["state"][t + 1], rtol=1e-9)
        np.testing.assert_array_equal(observation, info["state"].astype(np.float32))
    env.close()


@pytest.mark.parametrize("name", PAPER)
def test_initial_state_in_the_papers_order(name: str) -> None:
    """An array is taken in the paper's order; one step from it is one published step."""
    published = reference(name)
    network, agent = PAPER[name]
    env: gymnasium.Env[Any, Any] = single_agent_env(network, agent=agent, scenario="paper")
    _, info = env.reset(seed=0, options={"initial_state": published["state"][7]})
    np.testing.assert_array_equal(info["state"], published["state"][7])
    *_, info = env.step(published["action"][7:8])
    np.testing.assert_allclose(info["state"], published["state"][8], rtol=1e-9)


def test_local_rewards_sum_to_the_papers() -> None:
    """The local rewards of copper_net's compartments are the paper's reward, split."""
    published = reference("CopperNet")
    env = parallel_env("copper_net", scenario="paper")
    env.reset(seed=0)
    for t in range(20):
        env.step({"use_to_collection": published["action"][t : t + 1]})
        assert sum(env.local_rewards().values()) == pytest.approx(published["reward"][t], rel=1e-9)


@pytest.mark.parametrize(
    ("name", "eigenvalues"),
    [("CopperNet", [-1.0, -0.84, -0.3, -0.25, -0.19, -0.1]), ("CarboNet", [-0.7, -0.4, -0.3, 0.0])],
)
def test_eigenvalues(name: str, eigenvalues: list[float]) -> None:
    """The published system matrices, read off the flows of unit stocks."""
    network = load_network(PAPER[name][0], scenario="paper")
    dynamics = Dynamics(network)
    sets_flow = np.isin(network.controllable, [arc.id for arc in network.arcs if arc.law is Law.CONTROLLED])
    rate = dynamics.rate(np.where(sets_flow, 0.0, dynamics.neutral)[:, None])
    unit = np.eye(len(network.nodes) + 1)
    matrix = dynamics.incidence(dynamics.flow(unit, np.repeat(rate, unit.shape[1], axis=1)))[:-1, :-1]
    order = [network.node_index[node] for node in network.observation.nodes]
    found = np.sort(np.linalg.eigvals(matrix[np.ix_(order, order)]).real)
    np.testing.assert_allclose(found, eigenvalues, atol=1e-9)


def test_equilibrium_of_copper_net() -> None:
    """At u = 1 kt/d the set-points are the equilibrium, and λ = −5.28 kt."""
    network = load_network("copper_net", scenario="paper")
    env = VectorEnv(network, num_envs=1)
    env.reset(0, options={"initial_state": {n.id: n.set_point for n in network.nodes if n.set_point is not None}})
    before = env.physical.stock[:-1].copy()
    outcome = env.advance(np.array([[1e-6]]))
    tracked = [network.node_index[node] for node in network.observation.nodes]
    np.testing.assert_allclose(env.physical.stock[:-1][tracked], before[tracked], rtol=1e-12)
    assert outcome.circularity[0] == pytest.approx(-5.28, rel=1e-9)
    assert outcome.reward[0, 0] == pytest.approx(0.0, abs=1e-18)


@pytest.mark.parametrize(
    ("name", "action", "total", "digits"),
    [
        ("copper_net", -1.0, -4.615e8, 1e-3),
        ("copper_net", 0.0, -8.387e7, 1e-3),
        ("carbo_net", 1.0, -7.561e7, 1e-3),
        ("carbo_net", -1.0, -3.882e6, 1e-3),
        ("carbo_net", 0.0, -1.293e7, 1e-3),
    ],
)
def test_returns_of_constant_actions(name: str, action: float, total: float, digits: float) -> None:
    """Returns of clean 50-step episodes, computed independently."""
    env = parallel_env(name, scenario="paper")
    env.reset(seed=0)
    agent = env.possible_agents[0]
    earned = sum(env.step({agent: [action]})[1][agent] for _ in range(50))
    assert earned == pytest.approx(total, rel=digits)
