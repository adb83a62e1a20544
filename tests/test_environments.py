"""Contracts of the environments: conformity, starts, rewards, restarts, who acts, what may not be written to."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.spaces import Box
from numpy.typing import NDArray
from small_networks import ONE_OF_EACH, PLAYED

from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlError,
    ControlKind,
    MultiAgentVectorEnv,
    Network,
    Node,
    aec_env,
    load_network,
    parallel_env,
    single_agent_env,
    vector_env,
)
from cirl_marl.controllers import Constant, Random, ScriptController
from cirl_marl.controllers.rollout import rollout
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.environments import rewards as credit
from cirl_marl.network.elements import Episode
from cirl_marl.testing import check_parallel_env, check_vector_env
from cirl_marl.testing.nested import same_or_raise

CATALOGUE = [pytest.param(name, scenario, id=f"{name}-{scenario}") for name, scenario in PLAYED]
anything = pytest.mark.parametrize(("name", "scenario"), CATALOGUE)
third_party = [
    # importing pettingzoo.test loads PettingZoo's own games through its deprecated interface
    pytest.mark.filterwarnings("ignore:The old environment creation API:DeprecationWarning"),
    # PettingZoo would rather have homogeneous agents called player_0
    pytest.mark.filterwarnings("ignore:We recommend agents to be named"),
    pytest.mark.filterwarnings("ignore:Agents have different observation space sizes"),
    pytest.mark.filterwarnings("ignore:Observations are different shapes"),
    # the published environments have no bounds
    pytest.mark.filterwarnings("ignore:.*observation space (minimum )?(maximum )?value is -?infinity"),
    pytest.mark.filterwarnings("ignore:.*not including the .* infinite"),
]


def marked(test: Callable[..., None]) -> Callable[..., None]:
    """Let the warnings of others pass in this test."""
    for mark in third_party:
        test = mark(test)
    return test


@pytest.mark.medium
@pytest.mark.sample(8)
@anything
@pytest.mark.parametrize(("observe", "horizon"), [(None, None), ("local", 12), ("full", 12)])
def test_catalogue_conforms(name: str, scenario: str, observe: str | None, horizon: int | None) -> None:
    """The stricter suite holds for every network, scenario and view; in its own view over its whole episode."""
    check_parallel_env(lambda: parallel_env(name, scenario=scenario, observe=observe, horizon=horizon))
    check_vector_env(lambda: vector_env(name, num_envs=3, scenario=scenario, observe=observe, horizon=7), steps=20)


@pytest.mark.medium
@pytest.mark.sample(5)
@marked
@anything
def test_pettingzoos_own_tests(name: str, scenario: str, capsys: pytest.CaptureFixture[str]) -> None:
    """Parallel and AEC interface, and seeding."""
    from pettingzoo.test import api_test, parallel_api_test, parallel_seed_test

    parallel_api_test(parallel_env(name, scenario=scenario), num_cycles=200)
    api_test(aec_env(name, scenario=scenario), num_cycles=30)
    parallel_seed_test(lambda: parallel_env(name, scenario=scenario), num_cycles=3)
    assert "Passed" in capsys.readouterr().out


@marked
@anything
@pytest.mark.sample(10)
def test_gymnasium_and_sb3_checkers(name: str, scenario: str) -> None:
    """The one-agent view, under both checkers."""
    from gymnasium.utils.env_checker import check_env as gymnasium_check
    from stable_baselines3.common.env_checker import check_env as sb3_check

    agent = load_network(name, scenario=scenario).agents[0]
    gymnasium_check(single_agent_env(name, agent=agent, scenario=scenario), skip_render_check=True)
    sb3_check(single_agent_env(name, agent=agent, scenario=scenario))


@pytest.mark.parametrize("id_", ["cirl_marl/CopperNet-v0", "cirl_marl/CarboNet-v0"])
def test_registered_environments(id_: str) -> None:
    """gymnasium.make finds them by id."""
    env = gymnasium.make(id_, disable_env_checker=True)
    assert env.action_space == Box(-1, 1, (1,), np.float32)
    env.close()


def test_initial_state_is_taken() -> None:
    """Given stocks are used, the others are drawn."""
    env = vector_env("copper_net", num_envs=2)
    env.reset(0, options={"initial_state": {"use": 150.0, "sorting": np.array([1.0, 2.0])}})
    index = env.network.node_index
    assert env.state()[:, index["use"]].tolist() == [150.0, 150.0]
    assert env.state()[:, index["sorting"]].tolist() == [1.0, 2.0]
    with pytest.raises(ControlError, match="Did you mean 'initial_state'"):
        env.reset(0, options={"initial_stat": {}})


def test_seeds_of_copies() -> None:
    """A list seeds each copy; an integer s seeds copy i with s + i."""
    env = vector_env("copper_net", num_envs=3)
    env.reset(5)
    first = env.state()
    env.reset([7, 6, 5])
    np.testing.assert_array_equal(first, env.state()[::-1])


def outcomes(reward: str, **options: Any) -> tuple[MultiAgentVectorEnv, list[Any]]:
    """Return an environment and what ten random steps of it brought."""
    env = vector_env("copper_net", num_envs=2, reward=reward, **options)
    env.reset(1)
    rng = np.random.default_rng(0)
    return env, [env.advance(rng.uniform(-1, 1, (len(env.agents), 2))) for _ in range(10)]


def test_reward_modes() -> None:
    """Local, circularity and mixed = w·λ/scale + (1 − w)·local, of the same trajectory."""
    env, mixed = outcomes("mixed")
    weight, scale = env.network.objective.circularity_weight, env.network.objective.circularity_scale
    _, local = outcomes("local")
    _, team = outcomes("circularity")
    _, mean = outcomes("circularity", circularity="mean")
    _, total = outcomes("local_sum")
    for a, b, c, d, e in zip(mixed, local, team, mean, total, strict=True):
        np.testing.assert_array_equal(b.reward, b.local)
        np.testing.assert_array_equal(c.reward, np.tile(c.circularity, (len(env.agents), 1)))
        np.testing.assert_array_equal(d.reward, np.tile(d.circularity_mean, (len(env.agents), 1)))
        np.testing.assert_allclose(
            a.reward, weight * c.circularity / scale + (1 - weight) * b.local, rtol=1e-13, atol=1e-15
        )
        assert (e.reward == e.reward[0]).all()
        assert (e.reward[0] <= b.local.sum(axis=0) + 1e-12).all()  # compartments that do not act count too


@pytest.mark.parametrize("circularity", ["end", "mean"])
def test_difference_reward_by_hand(circularity: str) -> None:
    """λ − λ with that agent neutral, re-simulated from a snapshot."""
    env = vector_env("copper_net", num_envs=2, reward="difference", circularity=circularity)
    imagined = vector_env("copper_net", num_envs=2, reward="circularity", circularity=circularity)
    env.reset(1)
    imagined.reset(1)
    rng = np.random.default_rng(0)
    neutral = env.stack(env.neutral_action)
    for _ in range(3):
        actions = rng.uniform(-1, 1, (len(env.agents), 2))
        here = env.snapshot()
        reward = env.advance(actions).reward
        imagined.restore(here)
        actual = imagined.advance(actions).reward[0]
        for row in range(len(env.agents)):
            imagined.restore(here)
            other = actions.copy()
            other[row] = neutral[row]
            # the neutral action maps to the neutral control to round-off
            counterfactual = imagined.advance(other).reward[row]
            np.testing.assert_allclose(reward[row], actual - counterfactual, rtol=1e-9, atol=1e-9)


def test_difference_rewards_stay_within_their_memory(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a dense network the flows, not the stocks, limit how many agents are imagined at once."""
    nodes = tuple(Node(id=f"n{i}", initial=(50.0, 100.0)) for i in range(8))
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=2.0)
    arcs = tuple(
        Arc(id=f"a{i}_{j}", donor=f"n{i}", recipient=f"n{j}", rate=0.05, control=valve)
        for i in range(8)
        for j in range(8)
        if i != j
    )
    env = MultiAgentVectorEnv(Network(name="dense", nodes=nodes, arcs=arcs), num_envs=3, reward="difference")
    actions = np.random.default_rng(0).uniform(-1, 1, (len(arcs), 3))
    env.reset(1)
    here = env.snapshot()
    at_once = env.advance(actions).reward
    widths: list[int] = []
    advance = Dynamics.advance

    def noted(self: Dynamics, stock: Any, *rest: Any, **options: Any) -> Any:
        widths.append(stock.shape[1])
        return advance(self, stock, *rest, **options)

    monkeypatch.setattr(Dynamics, "advance", noted)
    monkeypatch.setattr(credit, "CELLS", 2000)
    env.restore(here)
    np.testing.assert_array_equal(env.advance(actions).reward, at_once)
    assert sum(widths) == 3 + 3 * len(arcs)
    assert max(widths) * len(arcs) <= 2000


def test_copies_restart_by_themselves() -> None:
    """The last observation of an ended episode is in infos; the one returned begins the next."""
    env, alone = (
        vector_env("copper_net", num_envs=2, horizon=3),
        vector_env("copper_net", num_envs=2, horizon=3),
    )
    env.reset(0)
    alone.reset(0)
    neutral = env.neutral_action
    for step in range(1, 8):
        observations, _, terminations, truncations, infos = env.step(neutral)
        expected = alone.advance(alone.stack(neutral)).observation
        ended = step % 3 == 0
        for agent in env.agents:
            assert not terminations[agent].any()
            assert (truncations[agent] == ended).all()
            assert ("final_obs" in infos[agent]) == ended
            last: NDArray[np.float32] = infos[agent]["final_obs"] if ended else observations[agent]
            np.testing.assert_array_equal(last, expected[alone.layout.slices[agent]].T)
        if ended:
            again = alone.reset()  # goes on with the streams, as the restart does
            for agent in env.agents:
                np.testing.assert_array_equal(observations[agent], again[agent])


@pytest.mark.parametrize("name", ONE_OF_EACH)
@pytest.mark.medium
@pytest.mark.sample(3)
def test_others_hold_their_neutral_control(name: str) -> None:
    """A one-agent environment is the whole network with everyone else neutral."""
    agent = load_network(name).agents[-1]
    one, many = parallel_env(name, agents=[agent]), parallel_env(name)
    one.reset(seed=2)
    many.reset(seed=2)
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(-1, 1, 1)
        one.step({agent: action})
        many.step({**many.neutral_action, agent: action})
        # neutral_action is float32, so the controls of the others are neutral to 1e-7
        np.testing.assert_allclose(one.state(), many.state(), rtol=1e-6, atol=1e-6)


def can_stop(name: str) -> bool:
    """Whether agents can stop a network: not where a supply delivers what they leave out."""
    return not any(arc.makes_up_for for arc in load_network(name).arcs)


@pytest.mark.parametrize("name", [*filter(can_stop, ONE_OF_EACH)])
@pytest.mark.slow
def test_zero_throughput_is_not_best(name: str) -> None:
    """Stopping everything is good for λ, but the service fails and the mixed reward falls.

    It is compared with neutral control and, where compartments have a script, with the script.
    """
    env = vector_env(name, num_envs=2)
    stopped = rollout(env, Constant(dict.fromkeys(env.agents, -1.0)), seed=0)
    usual = rollout(env, ScriptController(), seed=0)
    assert (stopped.returns.sum(axis=0) < usual.returns.sum(axis=0)).all()
    assert (stopped.episode_service < usual.episode_service).all()


@pytest.mark.filterwarnings("ignore:overflow encountered", "ignore:invalid value encountered")
def test_what_cannot_be_imagined_names_its_agent() -> None:
    """Difference rewards simulate each agent neutral; where that fails, the copy is one of the environment's own."""
    still = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=1.0)
    network = Network(
        name="brink",
        nodes=(Node(id="a", initial=(1.0, 1.0)), Node(id="b", initial=(1.0, 1.0)), Node(id="c")),
        arcs=(
            Arc(id="slow", donor="a", recipient="c", rate=0.01, control=still),
            Arc(id="fast", donor="b", recipient="c", rate=1e3, control=still),
        ),
        episode=Episode(control_interval=300.0, horizon=3, solver="euler", solver_step=1.0),
    )
    env = MultiAgentVectorEnv(network, num_envs=2, reward="difference")
    env.reset(options={"initial_state": {"b": np.array([0.0, 1.0])}})
    before = env.state()
    with pytest.raises(CirlError, match=r"^with agent 'fast' neutral.*: network 'brink': stock of node 'b' in copy 1"):
        env.step({agent: np.full((2, 1), -1.0) for agent in env.agents})
    np.testing.assert_array_equal(env.state(), before)
    with pytest.raises(CirlError, match=r"^network 'brink': stock of node 'b' in copy 1"):
        env.step({agent: np.full((2, 1), 1.0) for agent in env.agents})


def test_results_cannot_be_written_through() -> None:
    """Flows and ends are shared by all agents and by the state, so they are read-only."""
    env = vector_env("copper_net", num_envs=2)
    env.reset(seed=0)
    actions = {agent: np.zeros((2, 1)) for agent in env.agents}
    _, _, terminations, truncations, infos = env.step(actions)
    for shared in (infos["mine"]["flows"], terminations["mine"], truncations["mine"]):
        with pytest.raises(ValueError, match="read-only"):
            shared[:] = 0


def test_observations_belong_to_the_caller() -> None:
    """What is written into them does not reach the environment."""
    env, lone = vector_env("net_zero", num_envs=2, horizon=2), parallel_env("net_zero")
    actions = {agent: np.zeros((2, *space.shape)) for agent, space in env.action_spaces.items()}
    seen = env.reset(seed=0)
    snapshot = env.snapshot()
    for _ in range(3):  # over a restart
        for given in (seen, env.observations()):
            kept = copy.deepcopy(given)
            for each in given.values():
                each[:] = 99.0
            same_or_raise(kept, env.observations(), "observations returned and asked for")
        seen = env.step(actions)[0]
    env.restore(snapshot)["microalgae"][:] = 99.0
    assert (env.observations()["microalgae"] != 99.0).all()
    lone.reset(seed=0)[0]["microalgae"][:] = 99.0
    assert (lone.batch.observations()["microalgae"] != 99.0).all()


def test_random_control_does_not_copy_the_start_state() -> None:
    """Actions and initial stocks come from different streams though both have the same seed."""
    env = vector_env("copper_net", num_envs=1)
    observations = env.reset(seed=7)
    controller = Random()
    controller.start(env, 7)
    drawn = np.array([action[0, 0] for action in controller.act(observations).values()]) / 2 + 0.5
    low, high = env.network.initial
    drawn_from = np.flatnonzero(low < high)
    place = ((env.physical.stock[:-1, 0] - low) / np.maximum(high - low, 1e-9))[drawn_from]
    assert not np.isclose(place, drawn[: len(drawn_from)], rtol=1e-6).any()
