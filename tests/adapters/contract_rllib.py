"""What RLlib gets is the environment for PettingZoo, agent by agent."""

from __future__ import annotations

import numpy as np
import pytest

from cirl_marl import CirlError, parallel_env
from cirl_marl.adapters.rllib import RLlibEnv

HORIZON = 4


@pytest.mark.parametrize("name", ["copper_net", "solids_net"])
def test_what_is_seen_and_paid_is_ours(name: str) -> None:
    """Bit for bit, in two episodes on end, and an end is a truncation of all."""
    env = RLlibEnv({"network": name, "horizon": HORIZON})
    ours = parallel_env(name, horizon=HORIZON)
    assert env.possible_agents == ours.possible_agents
    assert all(env.action_spaces[a] == ours.action_space(a) for a in env.possible_agents)
    assert all(env.observation_space[a] == ours.observation_space(a) for a in env.possible_agents)
    random = np.random.default_rng(0)
    for seed in (5, None):
        observations, expected = env.reset(seed=seed)[0], ours.reset(seed=seed)[0]
        assert env.agents == env.possible_agents
        for step in range(1, HORIZON + 1):
            assert list(observations) == list(expected) == env.possible_agents
            assert all(np.array_equal(observations[agent], expected[agent]) for agent in expected)
            actions = {a: random.uniform(-1, 1, space.shape) for a, space in env.action_spaces.items()}
            observations, rewards, terminated, truncated, _ = env.step(actions)
            expected, paid, *_ = ours.step(actions)
            assert rewards == paid
            assert not terminated["__all__"] and truncated["__all__"] == (step == HORIZON)
        assert env.agents == []


def test_unknown_networks_and_options_are_refused() -> None:
    """When an environment is made."""
    with pytest.raises(CirlError, match="Did you mean 'copper_net'"):
        RLlibEnv({"network": "coper_net"})
    with pytest.raises(CirlError, match="horizont"):
        RLlibEnv({"network": "copper_net", "horizont": 5})
