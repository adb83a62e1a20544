"""The paper scenario of the networks against the published environments, and which scenario an agent has."""

from __future__ import annotations

import warnings
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from gymnasium.utils.env_checker import check_env
from numpy.typing import NDArray
from paper_classes import trajectory
from scipy.integrate import solve_ivp
from small_networks import constant

from cirl_marl import CirlError, Law, MultiAgentVectorEnv, load_network, parallel_env, single_agent_env
from cirl_marl.definitions.ids import ids
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.environments.registration import PAPER_ENVIRONMENTS

PAPER = {"CopperNet": ("copper_net", "use_to_collection"), "CarboNet": ("carbo_net", "urban_to_capture")}


@pytest.mark.parametrize("name", PAPER)
def test_published_trajectory(name: str) -> None:
    """Through gymnasium.make: row t's action leads to row t+1's state and to row t's reward."""
    actions, states, rewards = trajectory(name)
    env = gymnasium.make(f"cirl_marl/{name}-v0", disable_env_checker=True)
    observation, info = env.reset(seed=0)
    np.testing.assert_allclose(info["state"], states[0], rtol=1e-9)
    for t in range(50):
        observation, reward, terminated, truncated, info = env.step(actions[t : t + 1])
        assert reward == pytest.approx(rewards[t], rel=1e-9)
        assert not terminated
        assert truncated == (t == 49)
        np.testing.assert_allclose(info["state"], states[t + 1], rtol=1e-9)
        np.testing.assert_array_equal(observation, info["state"].astype(np.float32))
    env.close()


@pytest.mark.parametrize("name", PAPER)
def test_initial_state_in_the_papers_order(name: str) -> None:
    """An array is taken in the paper's order; one step from it is one published step."""
    actions, states, _ = trajectory(name)
    network, agent = PAPER[name]
    env: gymnasium.Env[Any, Any] = single_agent_env(network, agent=agent, scenario="paper")
    _, info = env.reset(seed=0, options={"initial_state": states[7]})
    np.testing.assert_array_equal(info["state"], states[7])
    *_, info = env.step(actions[7:8])
    np.testing.assert_allclose(info["state"], states[8], rtol=1e-9)


@pytest.mark.parametrize("id_", [ids()[name] for name in PAPER_ENVIRONMENTS])
def test_gymnasiums_own_check(id_: str) -> None:
    """check_env passes for every id; it only regrets that states have no bounds, as published."""
    env = gymnasium.make(id_).unwrapped
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message=".*observation space (minimum|maximum) value is -?infinity")
        check_env(env, skip_render_check=True)
    assert env.action_space == Box(-1.0, 1.0, env.action_space.shape, np.float32)
    env.close()


@pytest.mark.parametrize("name", PAPER)
def test_euler_of_the_networks_is_first_order(name: str) -> None:
    """At a constant action the stocks agree with scipy's of the same linear system, and halving the step the error."""
    network_name, agent = PAPER[name]
    network, span = load_network(network_name, scenario="paper"), 0.002
    dynamics = Dynamics(network)
    control = network.compartments[agent].control
    assert control is not None
    held = dynamics.neutral[:, :1].copy()
    held[network.control_rows[agent]] = 0.25 * constant(control.low) + 0.75 * constant(control.high)
    rate = dynamics.rate(held)

    def slope(_: float, stock: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(dynamics.incidence(dynamics.flow(stock[:, None], rate))[:, 0])

    errors, start, exact = [], np.empty(0), np.empty(0)
    for refine in (1, 2, 4):
        step = 5e-5 / refine
        episode = {"control_interval": step, "solver_step": step, "horizon": round(span / step)}
        env = MultiAgentVectorEnv(network.with_options(episode=episode), num_envs=1)
        env.reset(seed=0)
        if refine == 1:
            start = env.physical.stock[:, 0].copy()
            exact = solve_ivp(slope, (0, span), start, method="Radau", rtol=1e-10, atol=1e-10).y[:, -1]
        for _ in range(env.network.episode.horizon):
            env.advance(np.array([[0.5]]))
        errors.append(np.abs(env.physical.stock[:, 0] - exact).max())
    assert errors[0] < 1e-3 * np.abs(exact - start).max()
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 1.0, atol=0.05)


def test_the_papers_scenario_of_an_agent() -> None:
    """``paper`` means the scenario in which the agent acts alone; where there are two, both are named."""
    truck = single_agent_env("solids_net", agent="truck", scenario="paper")
    assert truck.network.scenario_name == "paper_truck"
    assert single_agent_env("solids_net", agent="incinerator", scenario="paper").network.scenario_name == (
        "paper_incinerator"
    )
    with pytest.raises(CirlError, match="paper_monod, paper_droop"):
        single_agent_env("net_zero", agent="microalgae", scenario="paper")
    with pytest.raises(CirlError, match="unknown scenario"):
        single_agent_env("net_zero", agent="digester", scenario="paper")


@pytest.mark.parametrize(
    ("network", "agent"),
    [(name, agent) for name in ("net_zero", "solids_net") for agent in load_network(name).agents],
)
@pytest.mark.medium
@pytest.mark.sample(2)
def test_one_agent_is_all_agents_with_the_others_neutral(network: str, agent: str) -> None:
    """Bit for bit, in the default scenario."""
    one, all_ = single_agent_env(network, agent=agent, horizon=30), parallel_env(network, horizon=30)
    first, _ = one.reset(seed=5)
    np.testing.assert_array_equal(first, all_.reset(seed=5)[0][agent])
    rng = np.random.default_rng(0)
    held = MultiAgentVectorEnv(network, num_envs=1).neutral_action  # in float64, as nobody acting holds it
    neutral = {each: action[0] for each, action in held.items()}
    for _ in range(30):
        action = rng.uniform(-1, 1, one.action_space.shape).astype(np.float32)
        observation, reward, *_ = one.step(action)
        observations, rewards, *_ = all_.step(neutral | {agent: action})
        np.testing.assert_array_equal(observation, observations[agent])
        assert reward == rewards[agent]
    np.testing.assert_array_equal(one.parallel.state(), all_.state())


def test_local_rewards_sum_to_the_papers() -> None:
    """The local rewards of copper_net's compartments are the paper's reward, split."""
    actions, _, rewards = trajectory("CopperNet")
    env = parallel_env("copper_net", scenario="paper")
    env.reset(seed=0)
    for t in range(20):
        env.step({"use_to_collection": actions[t : t + 1]})
        assert sum(env.local_rewards().values()) == pytest.approx(rewards[t], rel=1e-9)


@pytest.mark.parametrize(
    ("name", "eigenvalues"),
    [("CopperNet", [-1.0, -0.84, -0.3, -0.25, -0.19, -0.1]), ("CarboNet", [-0.7, -0.4, -0.3, 0.0])],
)
def test_eigenvalues(name: str, eigenvalues: list[float]) -> None:
    """The published system matrices, read off the flows of unit stocks."""
    network = load_network(PAPER[name][0], scenario="paper")
    dynamics = Dynamics(network)
    sets_flow = np.isin(network.controllable, [arc.id for arc in network.arcs if arc.law is Law.CONTROLLED])
    rate = dynamics.rate(np.where(sets_flow, 0.0, dynamics.neutral[:, 0])[:, None])
    unit = np.eye(len(network.nodes) + 1)
    matrix = dynamics.incidence(dynamics.flow(unit, np.repeat(rate, unit.shape[1], axis=1)))[:-1, :-1]
    order = [network.node_index[node] for node in network.observation.nodes]
    found = np.sort(np.linalg.eigvals(matrix[np.ix_(order, order)]).real)
    np.testing.assert_allclose(found, eigenvalues, atol=1e-9)


def test_equilibrium_of_copper_net() -> None:
    """At u = 1 kt/d the set-points are the equilibrium, and λ = −5.28 kt."""
    network = load_network("copper_net", scenario="paper")
    env = MultiAgentVectorEnv(network, num_envs=1)
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
