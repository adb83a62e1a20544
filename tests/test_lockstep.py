"""The bridge between one coupled environment and many learners: seats, lockstep, random streams."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from cirl_marl import LearnerError, MultiAgentVectorEnv
from cirl_marl.learners.agent_env import AgentVecEnv
from cirl_marl.learners.lockstep import Lockstep, NetworkWorld, Participant, Streams, TrainingStop

HORIZON = 5
COPIES = 3


def make_world(agents: list[str] | None = None) -> NetworkWorld:
    """Seat the agents of a short copper_net."""
    env = MultiAgentVectorEnv("copper_net", num_envs=COPIES, agents=agents, horizon=HORIZON)
    return NetworkWorld(env, seeds=[11, 12, 13])


def scripted(
    agent_env: AgentVecEnv, steps: int, seen: list[VecEnvStepReturn], value: float = 0.0
) -> Callable[[], None]:
    """Return a learner that takes a fixed action for some steps and notes what comes back."""

    def run() -> None:
        agent_env.reset()
        for _ in range(steps):
            seen.append(agent_env.step(np.full((COPIES, 1), value, dtype=np.float32)))

    return run


def hold(agent_env: AgentVecEnv) -> Callable[[], None]:
    """Return an actor that holds action 0 for ever."""

    def run() -> None:
        while True:
            agent_env.step(np.zeros((COPIES, 1), dtype=np.float32))

    return run


def run_scripted(world: NetworkWorld, steps: dict[str, int], **options: Any) -> dict[str, list[VecEnvStepReturn]]:
    """Run scripted learners for the given numbers of steps."""
    seen: dict[str, list[VecEnvStepReturn]] = {agent: [] for agent in world.agent_envs}
    learn = {agent: scripted(agent_env, steps[agent], seen[agent]) for agent, agent_env in world.agent_envs.items()}
    Lockstep([world], participants(world, learn)).run(**options)
    return seen


def participants(world: NetworkWorld, learn: dict[str, Callable[[], None]]) -> list[Participant]:
    """Return who learns by its own function, and holds action 0 after it."""
    agent_envs = world.agent_envs.items()
    return [
        Participant(agent_env.title, learn[a], hold(agent_env), Streams(i))
        for i, (a, agent_env) in enumerate(agent_envs)
    ]


def test_lockstep_equals_the_environment_stepped_by_hand() -> None:
    """Every seat sees just what ``MultiAgentVectorEnv`` gives its agent, and the true last observation at the end."""
    world = make_world()
    first = {agent: agent_env.last_step.observation for agent, agent_env in world.agent_envs.items()}
    seen = run_scripted(world, dict.fromkeys(world.agent_envs, HORIZON + 2))
    env = MultiAgentVectorEnv("copper_net", num_envs=COPIES, horizon=HORIZON)
    by_hand = env.reset(seed=[11, 12, 13])
    actions = {agent: np.zeros((COPIES, 1)) for agent in env.agents}
    assert all(np.array_equal(np.asarray(first[agent]), by_hand[agent]) for agent in env.agents)
    for t in range(HORIZON + 2):
        observations, rewards, _, truncations, infos = env.step(actions)
        for agent in env.agents:
            observation, reward, done, info = seen[agent][t]
            assert np.array_equal(np.asarray(observation), observations[agent])
            assert np.array_equal(reward, rewards[agent].astype(np.float32))
            assert np.array_equal(done, truncations[agent])
            for copy in range(COPIES):
                assert info[copy].get("TimeLimit.truncated", False) == bool(done[copy])
                if done[copy]:
                    final = infos[agent]["final_obs"][copy]
                    assert np.array_equal(info[copy]["terminal_observation"], final)
                    assert not np.array_equal(final, observations[agent][copy])


def test_copies_have_their_own_seeds() -> None:
    """SuperSuit's bridge gives all copies one stream; here no two copies start alike."""
    world = make_world()
    starts = np.asarray(world.agent_envs["use"].last_step.observation)
    assert len(np.unique(starts[:, 0])) == COPIES


def test_seeded_algorithm_can_be_built_on_a_seat() -> None:
    """With SuperSuit's bridge ``PPO(seed=…)`` raises; here it works and does not reseed the environment."""
    world = make_world()
    before = np.asarray(world.agent_envs["use"].last_step.observation).copy()
    with Streams(0).active():
        model = PPO("MlpPolicy", world.agent_envs["use"], seed=3, device="cpu")
    assert model.seed == 3
    assert np.array_equal(np.asarray(world.agent_envs["use"].last_step.observation), before)


def test_truncation_bootstraps() -> None:
    """SuperSuit's bridge never reports truncation; here PPO adds the value of the final observation."""
    world = make_world(["use"])
    agent_env = world.agent_envs["use"]
    streams = Streams(0)
    with streams.active():
        model = PPO(
            "MlpPolicy", agent_env, n_steps=HORIZON, batch_size=HORIZON * COPIES, seed=0, device="cpu", gamma=0.9
        )
    finals: list[np.ndarray] = []
    rewards: list[np.ndarray] = []
    values: list[np.ndarray] = []

    def learn() -> None:
        learner = model.learn(HORIZON * COPIES)
        rewards.append(learner.rollout_buffer.rewards[-1].copy())

    original = model.train

    def keep_values() -> None:
        with torch.no_grad():
            final = torch.as_tensor(finals[0])
            values.append(model.policy.predict_values(final).numpy()[:, 0])
        original()

    model.train = keep_values  # type: ignore[method-assign]
    last: list[np.ndarray] = []

    def hook(infos: Any, done: np.ndarray) -> None:
        if done.any():
            finals.append(infos["use"]["final_obs"].copy())
            last.append(agent_env.last_step.rewards.copy())

    Lockstep([world], [Participant("use", learn, hold(agent_env), streams)]).run([hook])
    assert np.allclose(rewards[0], last[0] + 0.9 * values[0], atol=1e-4)
    assert np.all(np.abs(values[0]) > 0.1)  # so that it would show if the value were not added


def test_learners_of_different_length_finish_and_go_on_acting() -> None:
    """A learner that is done acts until the last one is done."""
    world = make_world(["mine", "use", "sorting"])
    seen = run_scripted(world, {"mine": 3, "use": 11, "sorting": 7})
    assert {agent: len(steps) for agent, steps in seen.items()} == {"mine": 3, "use": 11, "sorting": 7}
    assert world.joint_steps == 11


def test_failing_learner_is_named() -> None:
    """The error says whose learner failed and when; the others are ended."""
    world = make_world(["mine", "use"])
    ended: list[str] = []

    def fails() -> None:
        for _ in range(4):
            world.agent_envs["mine"].step(np.zeros((COPIES, 1), dtype=np.float32))
        raise ValueError("exploded")

    def steady() -> None:
        try:
            hold(world.agent_envs["use"])()
        finally:
            ended.append("use")

    with pytest.raises(LearnerError, match=r"agent 'mine' failed at joint step 4: ValueError\('exploded'\)"):
        Lockstep([world], participants(world, {"mine": fails, "use": steady})).run()
    assert ended == ["use"]


def test_everything_can_be_stopped() -> None:
    """``TrainingStop`` ends all learners cleanly."""
    world = make_world(["mine", "use"])

    def stop() -> None:
        if world.joint_steps == 4:
            raise TrainingStop

    with pytest.raises(TrainingStop):
        run_scripted(world, {"mine": 100, "use": 100}, after=stop)
    assert world.joint_steps == 4


def test_rewards_are_each_agents_own() -> None:
    """PPO changes its rewards in place; nobody else may see that."""
    world = make_world(["mine", "use"])
    seen = run_scripted(world, {"mine": 2, "use": 2})
    assert not np.shares_memory(seen["mine"][0][1], seen["use"][0][1])
    assert not np.shares_memory(np.asarray(seen["mine"][0][0]), np.asarray(seen["mine"][1][0]))


def test_env_method_and_attributes_reach_the_agent() -> None:
    """HER calls ``env_method``; it reaches the agent's view of the chosen copies, and through it the environment."""
    world = make_world()
    agent_env = world.agent_envs["use"]
    rewards = agent_env.env_method("local_reward", indices=[0, 2])
    expected = world.env.local_rewards()["use"]
    assert rewards == [expected[0], expected[2]]
    assert agent_env.get_attr("compartment")[0] is world.env.network.compartments["use"]
    assert agent_env.get_attr("network", indices=1) == [world.env.network]
    agent_env.set_attr("note", "here", indices=[1])
    assert agent_env.get_attr("note", indices=[1]) == ["here"]
    assert agent_env.env_is_wrapped(object) == [False] * COPIES
    with pytest.raises(AttributeError):
        agent_env.env_method("no_such_method")


@pytest.mark.parametrize("keep", [True, False])
def test_streams_are_private(keep: bool) -> None:
    """Draws in one set of streams do not show in another, nor in the caller's, and the gradient mode stays apart."""
    torch.manual_seed(5)
    np.random.seed(5)  # noqa: NPY002 (the legacy stream is the subject)
    expected = (torch.rand(3), np.random.rand(3))  # noqa: NPY002
    torch.manual_seed(5)
    np.random.seed(5)  # noqa: NPY002
    one, other = Streams(1, keep_gaussian=keep), Streams(2, keep_gaussian=keep)
    with one.active():
        first = torch.rand(2)
        torch.set_grad_enabled(False)
    with other.active():
        torch.rand(100)
        np.random.rand(100)  # noqa: NPY002
        assert torch.is_grad_enabled()
    with one.active():
        second = torch.rand(2)
        assert not torch.is_grad_enabled()
    with Streams(1).active():
        assert torch.equal(torch.rand(4), torch.cat([first, second]))
    assert torch.equal(torch.rand(3), expected[0])
    assert np.array_equal(np.random.rand(3), expected[1])  # noqa: NPY002


def test_cached_gaussian_survives_a_switch() -> None:
    """NumPy hands out Gaussians in pairs; the second of a pair is not lost with ``keep_gaussian``."""
    with Streams(1).active():
        expected = [np.random.normal() for _ in range(4)]  # noqa: NPY002
    streams = Streams(1, keep_gaussian=True)
    drawn = []
    for _ in range(4):
        with streams.active():
            drawn.append(np.random.normal())  # noqa: NPY002
    assert drawn == expected
