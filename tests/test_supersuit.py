"""SuperSuit: its wrappers work on our environments; the adapter mends the defects of its bridge."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO

import cirl_marl
from cirl_marl import CirlError, MultiAgentVectorEnv, parallel_env
from cirl_marl.learners.lockstep import Lockstep, NetworkWorld, Participant, Streams

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from supersuit import agent_indicator_v0, concat_vec_envs_v1, pad_observations_v0, pettingzoo_env_to_vec_env_v1

    from cirl_marl.adapters.supersuit import SharedPolicyEnv

AGENTS = ["refinery", "mine"]
HORIZON = 4


def padded() -> Any:
    """Two agents with observations of different lengths, padded to one length and marked with their agent."""
    env = cirl_marl.parallel_env("copper_net", agents=AGENTS, horizon=4)
    return agent_indicator_v0(pad_observations_v0(env))


@pytest.mark.filterwarnings("ignore")
def test_padding_and_indicator_work() -> None:
    """Heterogeneous observations become one shape, and the values stay."""
    plain = cirl_marl.parallel_env("copper_net", agents=AGENTS, horizon=4)
    env = padded()
    seen, _ = env.reset(seed=3)
    expected, _ = plain.reset(seed=3)
    assert len({seen[agent].shape for agent in AGENTS}) == 1
    for agent in AGENTS:
        assert np.array_equal(seen[agent][: len(expected[agent])], expected[agent])


def bridged(copies: int) -> Any:
    """The padded environment behind SuperSuit's vector bridge."""
    vector = pettingzoo_env_to_vec_env_v1(padded())
    return concat_vec_envs_v1(vector, copies, num_cpus=1, base_class="stable_baselines3")


@pytest.mark.filterwarnings("ignore")
def test_three_defects_of_the_vector_bridge_are_not_ours() -> None:
    """SuperSuit: copies start alike, ``PPO(seed=…)`` raises, truncation is not reported. Ours: none of the three."""
    theirs = bridged(2)
    start = theirs.reset()
    assert np.array_equal(start[: len(AGENTS)], start[len(AGENTS) :])
    with pytest.raises(AttributeError, match="seed"):
        PPO("MlpPolicy", theirs, seed=1, device="cpu")
    for _ in range(4):
        _, _, dones, infos = theirs.step(np.zeros((2 * len(AGENTS), 1), dtype=np.float32))
    assert np.all(dones)
    assert not any("TimeLimit.truncated" in info for info in infos)

    ours = NetworkWorld(MultiAgentVectorEnv("copper_net", num_envs=2, agents=AGENTS, horizon=4), seeds=[1, 2])
    agent_env = ours.agent_envs["refinery"]
    mine = np.asarray(agent_env.last_step.observation)
    assert not np.array_equal(mine[0], mine[1])
    with Streams(0).active():
        assert PPO("MlpPolicy", agent_env, seed=1, device="cpu").seed == 1
    seen: list[list[dict[str, Any]]] = []

    def learn() -> None:
        for _ in range(4):
            seen.append(agent_env.step(np.zeros((2, 1), dtype=np.float32))[3])

    def rest() -> None:
        other = ours.agent_envs["mine"]
        while True:
            other.step(np.zeros((2, 1), dtype=np.float32))

    acting = {"refinery": learn, "mine": rest}
    Lockstep(
        [ours], [Participant(agent, acting[agent], acting[agent], Streams(0), budget=lambda: 4) for agent in AGENTS]
    ).run()
    assert all(info["TimeLimit.truncated"] and "terminal_observation" in info for info in seen[3])


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", ["copper_net", "solids_net"])
def test_what_is_seen_and_paid_is_ours(name: str) -> None:
    """Of each copy, in two episodes on end, padded, and truncated at the end."""
    env = SharedPolicyEnv(name, copies=2, seed=5, horizon=HORIZON)
    ours = [parallel_env(name, horizon=HORIZON) for _ in range(2)]
    agents, longest = env.agents, max(ours[0].action_space(agent).shape[0] for agent in env.agents)
    assert env.num_envs == 2 * len(agents) and env.action_space.shape == (longest,)
    random = np.random.default_rng(0)
    rows: Any = env.reset()
    expected = [copy.reset(seed=5 + i)[0] for i, copy in enumerate(ours)]
    for step in range(1, 2 * HORIZON + 1):
        shown = [expected[copy][agent] for copy in range(2) for agent in agents]
        assert all(np.array_equal(row[: len(seen)], seen) for row, seen in zip(rows, shown, strict=True))
        actions = random.uniform(-1, 1, (env.num_envs, longest)).astype(np.float32)
        rows, rewards, ends, infos = env.step(actions)
        paid = []
        for i, copy in enumerate(ours):
            acts = {a: actions[i * len(agents) + j][: copy.action_space(a).shape[0]] for j, a in enumerate(agents)}
            expected[i], given, *_ = copy.step(acts)
            paid += [given[agent] for agent in agents]
        assert rewards.tolist() == np.array(paid, dtype=np.float32).tolist()
        assert ends.tolist() == [step % HORIZON == 0] * env.num_envs
        if ends.all():
            assert all(info["TimeLimit.truncated"] for info in infos)
            last = [expected[copy][agent] for copy in range(2) for agent in agents]
            kept = [info["terminal_observation"] for info in infos]
            assert all(np.array_equal(row[: len(seen)], seen) for row, seen in zip(kept, last, strict=True))
            expected = [copy.reset()[0] for copy in ours]


@pytest.mark.filterwarnings("ignore")
def test_a_model_seeds_it() -> None:
    """Two models of a seed learn the same from copies that begin unlike each other; those of another seed do not."""
    ends = []
    for seed in (1, 1, 2):
        env = SharedPolicyEnv("copper_net", copies=2, horizon=HORIZON)
        model = PPO("MlpPolicy", env, n_steps=HORIZON, batch_size=32, n_epochs=1, seed=seed, device="cpu")
        first = env.reset()
        assert not np.array_equal(first[:16], first[16:])
        model.learn(2 * HORIZON * env.num_envs)
        ends.append([parameter.detach().numpy() for parameter in model.policy.parameters()])
    assert all(np.array_equal(one, same) for one, same in zip(ends[0], ends[1], strict=True))
    assert not all(np.array_equal(one, other) for one, other in zip(ends[0], ends[2], strict=True))


@pytest.mark.filterwarnings("ignore")
def test_what_cannot_be_is_refused() -> None:
    """An unknown network, and what would be one agent's own."""
    with pytest.raises(CirlError, match="Did you mean 'copper_net'"):
        SharedPolicyEnv("coper_net")
    env = SharedPolicyEnv("copper_net", copies=1)
    with pytest.raises(AttributeError, match="agents share a copy"):
        env.set_attr("horizon", 3)
    with pytest.raises(AttributeError, match="agents share a copy"):
        env.env_method("reset")
    assert env.env_is_wrapped(PPO) == [False] * 16
