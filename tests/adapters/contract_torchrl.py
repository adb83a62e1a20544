"""What TorchRL gets is the batched environment: the same numbers, padded, in any number of episodes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from torchrl.collectors import Collector
from torchrl.envs.utils import RandomPolicy, check_env_specs, step_mdp

from benchmarks.peers.problem import Scaling, by_agent, environment, padded
from benchmarks.peers.settings import SETTINGS
from benchmarks.peers.torchrl_env import ScaledEnv
from cirl_marl import CirlError, ControlError, MultiAgentVectorEnv
from cirl_marl.adapters.torchrl import GROUP, TorchRLEnv

CASES: dict[str, dict[str, Any]] = {"copper_net": {"reward": "team"}, "solids_net": {}}
"""Networks whose agents have observations of several lengths, and, the second, actions of several lengths."""
HORIZON = 4
FINAL = "final_obs"


@pytest.mark.parametrize("name", CASES)
def test_the_specifications_hold(name: str) -> None:
    """TorchRL's own check: shapes, types and bounds of what is returned are those that are declared."""
    check_env_specs(TorchRLEnv(name, num_envs=3, seed=1, horizon=HORIZON, **CASES[name]))


@pytest.mark.parametrize("name", CASES)
def test_what_is_seen_and_paid_is_ours(name: str) -> None:
    """Bit for bit, in two episodes on end, with zeros behind the entries of an agent that has fewer."""
    env = TorchRLEnv(name, num_envs=3, seed=5, horizon=HORIZON, **CASES[name])
    ours = MultiAgentVectorEnv(name, num_envs=3, horizon=HORIZON, **CASES[name])
    observations = ours.reset(seed=5)
    assert env.group_map == {GROUP: list(ours.agents)}
    random, told = np.random.default_rng(0), env.reset()
    for step in range(1, 2 * HORIZON + 1):
        assert_padded(told[GROUP, "observation"], observations)
        actions = torch.as_tensor(random.uniform(-1, 1, shape_of_actions(env)), dtype=torch.float32)
        told = env.step(told.set((GROUP, "action"), actions))["next"]
        mine = {a: actions[:, i, : ours.action_spaces[a].shape[0]].numpy() for i, a in enumerate(ours.agents)}
        observations, rewards, _, truncated, infos = ours.step(mine)
        expected = np.stack([rewards[agent] for agent in ours.agents], axis=1).astype(np.float32)
        assert np.array_equal(told[GROUP, "reward"][..., 0].numpy(), expected)
        assert np.array_equal(told["truncated"][:, 0].numpy(), truncated[ours.agents[0]])
        assert not told["terminated"].any() and bool(told["done"].all()) == (step % HORIZON == 0)
        if step % HORIZON == 0:
            assert_padded(told[GROUP, "observation"], {a: infos[a][FINAL] for a in ours.agents})
            told = env.reset()
    assert step == 2 * HORIZON


def shape_of_actions(env: TorchRLEnv) -> torch.Size:
    """Return (copies, agents, entries)."""
    return torch.Size(env.full_action_spec[GROUP, "action"].shape)


def assert_padded(tensor: Any, observations: Any) -> None:
    """Compare a padded tensor with observations by agent."""
    for place, observation in enumerate(observations.values()):
        length = observation.shape[1]
        assert np.array_equal(tensor[:, place, :length].numpy(), observation)
        assert not tensor[:, place, length:].any()


def collected(frames: int) -> Any:
    """Return a batch of what two copies go through under random actions."""
    torch.manual_seed(0)
    env = TorchRLEnv("copper_net", num_envs=2, seed=3, horizon=HORIZON)
    collector = Collector(env, None, frames_per_batch=frames, total_frames=frames)
    (batch,) = list(collector)
    return batch


def test_a_collector_goes_on_from_episode_to_episode() -> None:
    """Episodes follow each other in a batch of frames, each from a fresh start, and two runs of a seed are the same."""
    batches = [collected(2 * 3 * HORIZON) for _ in range(2)]
    assert all(torch.equal(one, other) for one, other in zip(*(b.values(True, True) for b in batches), strict=True))
    observation, ends = batches[0][GROUP, "observation"], batches[0]["next", "done"][..., 0]
    assert ends.sum(dim=1).tolist() == [3, 3] and ends[:, HORIZON - 1].all()
    starts = observation[:, ::HORIZON]
    assert len(torch.unique(starts.flatten(0, 1), dim=0)) == 6


def test_scaled_copies_are_the_environment() -> None:
    """What peers of the benchmarks see and are paid is ours, scaled; the last observation is that of the episode."""
    scaling, env = Scaling.measured(environment(4)), environment(2)
    scaled = ScaledEnv(2, 5, scaling)
    observations, random, told = env.reset(seed=5), np.random.default_rng(0), scaled.reset()
    for step in range(1, SETTINGS.steps + 1):
        assert np.array_equal(told[GROUP, "observation"].numpy(), scaling.seen(padded(env, observations)))
        actions = random.normal(size=(2, len(env.agents), 1)).astype(np.float32)
        told = scaled.step(told.set((GROUP, "action"), torch.from_numpy(actions)))["next"]
        observations, rewards, _, _, infos = env.step(by_agent(env, actions))
        paid = scaling.reward(np.stack([rewards[agent] for agent in env.agents], axis=1))
        assert told[GROUP, "reward"][..., 0].numpy() == pytest.approx(paid, rel=1e-6)
        assert bool(told["terminated"].all()) == (step == SETTINGS.steps)
    final = padded(env, {agent: infos[agent][FINAL] for agent in env.agents})
    assert np.array_equal(told[GROUP, "observation"].numpy(), scaling.seen(final))
    assert not np.array_equal(final, padded(env, observations))


def test_without_a_value_after_it_the_end_is_a_termination() -> None:
    """For learners to whom an episode is all there is."""
    env = TorchRLEnv("copper_net", num_envs=2, seed=3, horizon=HORIZON, bootstrap=False)
    last = env.rollout(HORIZON, RandomPolicy(env.full_action_spec))[:, -1]["next"]
    assert last["terminated"].all() and last["done"].all() and not last["truncated"].any()


def test_the_seed_decides() -> None:
    """Set when it is made or later; copies begin unlike each other."""
    env = TorchRLEnv("copper_net", num_envs=2, seed=1)
    first = env.reset()[GROUP, "observation"]
    assert not torch.equal(first[0], first[1])
    assert not torch.equal(env.reset()[GROUP, "observation"], first)
    env.set_seed(1)
    assert torch.equal(env.reset()[GROUP, "observation"], first)


def test_what_cannot_be_is_refused() -> None:
    """An unknown network or option, an action out of bounds or that is no number, and a reset of some copies."""
    with pytest.raises(CirlError, match="Did you mean 'copper_net'"):
        TorchRLEnv("coper_net")
    env = TorchRLEnv("copper_net", num_envs=2, seed=1)
    for wrong in (1.5, float("nan")):
        told = env.reset()
        with pytest.raises(ControlError):
            env.step(told.set((GROUP, "action"), torch.full(shape_of_actions(env), wrong)))
    with pytest.raises(ControlError, match=r"shape \(2, 16, 1\), got \(2, 16, 3\)"):
        env.step(env.reset().set((GROUP, "action"), torch.zeros(2, 16, 3)))
    some = step_mdp(env.rand_step(env.reset())).set("_reset", torch.tensor([[True], [False]]))
    with pytest.raises(ControlError, match="all copies begin an episode together"):
        env.reset(some)
