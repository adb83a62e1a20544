"""The robots under their Gymnasium ids: the libraries' episodes, the goal interface, hindsight."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import gymnasium
import gymnasium_robotics
import numpy as np
import pytest
from gymnasium import spaces
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

from cirl_marl import CirlError, Network, Node, Service, load_network
from cirl_marl.compartments.robots.fetch import BIN
from cirl_marl.controllers.scripted import fetch
from cirl_marl.environments.goal import PARTS, GoalEnv
from cirl_marl.testing.nested import same_or_raise

FETCH, REACHER = "cirl_marl/FetchWasteSorting-v0", "cirl_marl/Reacher-v0"
robots = pytest.mark.parametrize("id_", [FETCH, REACHER])


def wanted(env: Any) -> Any:
    """Return the scripted action of Fetch, from what the environment shows."""
    base: GoalEnv = env.unwrapped
    names = [name.split(".")[-1] for name in base.flat.parallel.layout.names[base.agent]]
    state = base.flat.parallel.state()
    own = base.network.compartments[base.agent].model
    assert own is not None
    shown = dict(zip(base.flat.parallel.state_names, state, strict=False))
    seen = {name: np.array([shown[f"sorter.{name}"]]) for name in names}
    return np.clip(fetch(seen)[:, 0], -1.0, 1.0).astype(np.float32)


@robots
@pytest.mark.parametrize("legacy", [False, True])
@pytest.mark.filterwarnings("ignore:.*observation space (minimum )?(maximum )?value is -?infinity")
def test_gymnasium_accepts_them(id_: str, legacy: bool) -> None:
    """By its own checker; like the libraries' they have no bounds, of which it warns."""
    env = gymnasium.make(id_, legacy_episode=legacy)
    check_env(env.unwrapped, skip_render_check=True)
    env.close()


def test_success_has_the_name_that_learners_look_for() -> None:
    """``is_success`` of gymnasium-robotics, from which Stable-Baselines3 takes its success rate."""
    env = gymnasium.make("cirl_marl/FetchWasteSorting-v0")
    env.reset(seed=0)
    infos = [env.step(wanted(env))[-1] for _ in range(50)]
    assert [info["is_success"] for info in infos] == [info["success"] for info in infos]
    assert not infos[0]["is_success"]
    assert infos[-1]["is_success"]


def library(id_: str) -> Any:
    """Return the library's own environment."""
    gymnasium.register_envs(gymnasium_robotics)
    return gymnasium.make("Reacher-v5" if id_ == REACHER else "FetchPickAndPlace-v4").unwrapped


def flat(seen: Any) -> Any:
    """Return an observation as one array."""
    return np.concatenate([seen[part] for part in PARTS]) if isinstance(seen, dict) else seen


@robots
@pytest.mark.parametrize("seed", [0, 12])
def test_episodes_are_the_library_s(id_: str, seed: int) -> None:
    """For the same seed and actions, in float32, over two episodes of 50 steps."""
    ours, theirs = gymnasium.make(id_), library(id_)
    rng = np.random.default_rng(seed)
    for episode in (seed, seed + 1):
        begun, expected = ours.reset(seed=episode)[0], theirs.reset(seed=episode)[0]
        if id_ == FETCH:
            theirs.goal = expected["desired_goal"] = np.array(BIN)
        np.testing.assert_array_equal(flat(begun), flat(expected).astype(np.float32))
        for step in range(1, 51):
            action = rng.uniform(-1, 1, ours.action_space.shape or ())
            seen, reward, terminated, truncated, info = ours.step(action)
            expected, theirs_reward, *_ = theirs.step(action)
            np.testing.assert_array_equal(flat(seen), flat(expected).astype(np.float32))
            assert reward == theirs_reward
            assert not terminated
            assert truncated == (step == 50)
            assert isinstance(info["success"], bool)
    ours.close()
    theirs.close()


def test_success_is_reported_when_it_happens() -> None:
    """The scripted robot puts the object into the bin: reward and success follow from the distance."""
    env = gymnasium.make(FETCH)
    env.reset(seed=5)
    found = []
    for _ in range(50):
        seen, reward, _, _, info = env.step(wanted(env))
        state = info["state"]
        names = list(env.unwrapped.flat.parallel.layout.names["sorter"])  # type: ignore[attr-defined]
        item = state[[names.index(f"sorter.object_{axis}") for axis in "xyz"]]
        near = bool(np.linalg.norm(item - BIN) <= 0.05)
        assert info["success"] == near
        assert reward == (0.0 if near else -1.0)
        np.testing.assert_array_equal(seen["achieved_goal"], item.astype(np.float32))
        found.append(near)
    assert not found[0]
    assert found[-1]
    env.close()


def test_goal_interface() -> None:
    """A Dict of three boxes as gymnasium-robotics has it; the reward is a function of the goals, of any shape."""
    env, theirs = GoalEnv("solids_net", "sorter", scenario="paper_fetch"), library(FETCH)
    assert isinstance(env.observation_space, spaces.Dict)
    assert set(env.observation_space.spaces) == set(PARTS)
    for part, space in env.observation_space.spaces.items():
        assert space.shape == theirs.observation_space[part].shape
        assert space.dtype == np.dtype(np.float32)
    assert env.action_space == spaces.Box(-1.0, 1.0, (4,), np.float32)
    seen, rewards = [env.reset(seed=1)[0]], []
    np.testing.assert_allclose(seen[0]["desired_goal"], BIN, rtol=1e-7)
    for _ in range(50):
        observation, reward, *_ = env.step(wanted(env))
        assert env.observation_space.contains(observation)
        seen.append(observation)
        rewards.append(reward)
    achieved, desired = (np.stack([each[part] for each in seen[1:]]) for part in PARTS[1:])
    found = env.compute_reward(achieved, desired, [{}] * 50)
    np.testing.assert_array_equal(found, rewards)
    assert set(rewards) == {0.0, -1.0}
    np.testing.assert_array_equal(
        env.compute_reward(achieved.reshape(5, 10, 3), desired.reshape(5, 10, 3), {}).ravel(), found
    )
    assert [env.compute_reward(a, d, {}) for a, d in zip(achieved, desired, strict=True)] == rewards
    assert (
        env.compute_terminated(achieved[-1], desired[-1], {}) is env.compute_truncated(achieved, desired, {}) is False
    )


@given(goal=st.tuples(*[st.floats(-2.0, 2.0)] * 3), offset=st.tuples(*[st.floats(-0.06, 0.06)] * 3))
def test_reward_of_any_goal(goal: tuple[float, ...], offset: tuple[float, ...]) -> None:
    """Also of goals that the robot never had, which is what hindsight asks for."""
    env = shared()
    achieved = np.array(goal) + offset
    distance = np.linalg.norm(achieved - np.array(goal))
    assert env.compute_reward(achieved, goal, {}) == (-1.0 if distance > 0.05 else 0.0)
    assert env.compute_reward(list(goal), goal, {}) == 0.0


def shared() -> GoalEnv:
    """Return an environment that is not stepped; making one is cheap, the engine is shared."""
    return GoalEnv("solids_net", "sorter", scenario="paper_fetch")


def test_seeds_and_streams() -> None:
    """Equal seeds repeat, a reset without one goes on, and both views start alike."""
    one, other = shared(), shared()
    first = [flat(one.reset(seed=3)[0]), flat(one.reset()[0])]
    again = [flat(other.reset(seed=3)[0]), flat(other.reset()[0])]
    np.testing.assert_array_equal(first, again)
    assert (first[0] != first[1]).any()
    np.testing.assert_array_equal(first[0], one.flat.reset(seed=3)[0])


def test_snapshot_goes_back() -> None:
    """The dictionary comes back, and so does what follows."""
    env = shared()
    env.reset(seed=2)
    shown = [env.step(wanted(env))[0] for _ in range(9)][-1]
    snapshot, actions = env.snapshot(), np.random.default_rng(0).uniform(-1, 1, (20, 4))
    once = [env.step(action) for action in actions]
    same_or_raise(shown, env.restore(snapshot), "observations of the snapshot and after going back")
    for action, (seen, reward, *_) in zip(actions, once, strict=True):
        now, earned, *_ = env.step(action)
        np.testing.assert_array_equal(flat(now), flat(seen))
        assert earned == reward


@robots
def test_published_step_counter(id_: str) -> None:
    """``legacy_episode`` passes through: 51 steps, then 49 and one, ended by termination."""
    env = gymnasium.make(id_, legacy_episode=True)
    env.reset(seed=0)
    action, lengths, steps = np.zeros(env.action_space.shape or ()), [], 0
    for _ in range(101):
        _, _, terminated, truncated, _ = env.step(action)
        assert not truncated
        steps += 1
        if terminated:
            lengths.append(steps)
            steps = 0
            env.reset()
    assert lengths == [51, 50]
    env.close()


def test_options_pass_through() -> None:
    """Horizon and observation mode are those of the flat environment; wider observations keep the three parts."""
    env = gymnasium.make(FETCH, horizon=3, observe="full")
    seen, _ = env.reset(seed=0)
    np.testing.assert_array_equal(flat(seen), flat(gymnasium.make(FETCH).reset(seed=0)[0]))
    assert [env.step(np.zeros(4))[3] for _ in range(3)] == [False, False, True]
    assert len(env.unwrapped.flat.observation_space.low) > 31  # type: ignore[attr-defined]
    env.close()
    moved = {"sorter.desired_x": 1.2}
    assert shared().reset(seed=0, options={"initial_state": moved})[0]["desired_goal"][0] == np.float32(1.2)


def test_reward_is_scaled_alike() -> None:
    """A definition that scales the model's reward scales the reward of goals by the same number."""
    network = load_network("solids_net", scenario="paper_fetch")
    scaled = replace(network, nodes=tuple(replace(node, reward_scale=4.0) for node in network.nodes))
    env = GoalEnv(scaled, "sorter")
    env.reset(seed=0)
    seen, reward, *_ = env.step(np.zeros(4))
    assert reward == env.compute_reward(seen["achieved_goal"], seen["desired_goal"], {}) == -0.25


@pytest.mark.parametrize(
    ("agent", "options", "message"),
    [
        ("sorter", {"scenario": "paper_reacher"}, "agent 'sorter' of 'solids_net' has no goals to observe"),
        ("sorter", {}, "no goals to observe"),
        ("truck", {}, "no goals to observe"),
        ("sorter", {"scenario": "paper_fetch", "reward": "mixed"}, "the reward 'local', not 'mixed'"),
        ("sorter", {"scenario": "paper_fetch", "horizn": 3}, "Did you mean 'horizon'"),
        ("sorter", {"scenario": "paper_fetch", "agents": ["sorter"]}, "takes agent=, not agents="),
        ("sortr", {"scenario": "paper_fetch"}, "Did you mean 'sorter'"),
    ],
)
def test_what_has_no_goals_is_refused(agent: str, options: dict[str, Any], message: str) -> None:
    """With the agent's name and what is wrong."""
    with pytest.raises(CirlError, match=message):
        GoalEnv("solids_net", agent, **options)


def beside_a_depot(*, set_point: float | None = None, tracked: tuple[str, ...] = (), **service: Any) -> Network:
    """Return the sorter's network with a depot, perhaps set-points, and a service that the sorter provides."""
    network = load_network("solids_net", scenario="paper_fetch")
    nodes = tuple(replace(node, set_point=set_point) for node in (*network.nodes, Node(id="depot")))
    services = (Service(id="tidiness", provider="sorter", quantity="stock", low=0.5, **service),) if service else ()
    return replace(network, nodes=nodes, services=services).with_options(objective={"tracked": tracked})


@pytest.mark.parametrize(
    ("network", "message"),
    [
        (beside_a_depot(set_point=0.0), r"set-point \(leave out its set_point\)$"),
        (
            beside_a_depot(set_point=0.0, tracked=("sorter",)),
            r"\(leave out its set_point and its place in objective\.tracked\)$",
        ),
        (beside_a_depot(weight=1.0), r"the shortfall of service 'tidiness' \(let another compartment owe it"),
        (beside_a_depot(set_point=0.0, weight=1.0), r"set-point \(.*\) and the shortfall of service"),
    ],
)
def test_a_reward_of_more_than_the_goals_is_refused(network: Network, message: str) -> None:
    """Hindsight would relabel with the model's part alone."""
    with pytest.raises(CirlError, match=rf"'sorter' of 'solids_net': its local reward is no function.*{message}"):
        GoalEnv(network, "sorter")


@pytest.mark.parametrize(
    "network",
    [
        beside_a_depot(set_point=0.0, tracked=("depot",)),
        beside_a_depot(weight=0.0),
        beside_a_depot(weight=1.0, owed_by=("depot",)),
    ],
)
def test_what_does_not_count_is_no_obstacle(network: Network) -> None:
    """A set-point that is not tracked, a service of no weight, one that another owes: the rewards are equal."""
    env = GoalEnv(network, "sorter")
    env.reset(seed=0)
    seen, reward, *_ = env.step(np.zeros(4))
    assert reward == env.compute_reward(seen["achieved_goal"], seen["desired_goal"], {})


@pytest.mark.medium
def test_hindsight_runs() -> None:
    """SAC with a hindsight buffer trains: relabelled goals give rewards of 0 though no object was moved."""
    from stable_baselines3 import SAC, HerReplayBuffer

    env = gymnasium.make(FETCH)
    learner = SAC(
        "MultiInputPolicy",
        env,
        replay_buffer_class=HerReplayBuffer,
        replay_buffer_kwargs={"n_sampled_goal": 4, "goal_selection_strategy": "future"},
        learning_starts=110,
        train_freq=10,
        gradient_steps=2,
        batch_size=64,
        policy_kwargs={"net_arch": [16]},
        buffer_size=1000,
        seed=0,
        device="cpu",
    )
    learner.learn(300)
    assert learner.num_timesteps == 300
    assert learner._n_updates > 20
    buffer: Any = learner.replay_buffer
    assert (buffer.rewards[: buffer.pos] == -1.0).all()
    drawn = buffer.sample(200).rewards.numpy()
    assert set(np.unique(drawn)) == {-1.0, 0.0}
    env.close()
