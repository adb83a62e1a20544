"""SuperSuit: its wrappers work on our environments; the defects of its vector bridge are shown, and not shared."""

from __future__ import annotations

import warnings
from typing import Any

import numpy as np
import pytest
from stable_baselines3 import PPO

import cirl_marl
from cirl_marl import MultiAgentVectorEnv
from cirl_marl.learners.lockstep import Lockstep, NetworkWorld, Participant, Streams

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from supersuit import agent_indicator_v0, concat_vec_envs_v1, pad_observations_v0, pettingzoo_env_to_vec_env_v1

AGENTS = ["refinery", "mine"]


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
