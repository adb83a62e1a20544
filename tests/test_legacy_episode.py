"""The published step counter and the saturated returns that it explains."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest

import cirl_marl


def episode(env: gymnasium.Env[object, object], action: float) -> tuple[int, float, bool]:
    """Return length, return and whether the episode ended by termination, under a constant action."""
    env.reset()
    steps, total = 0, 0.0
    while True:
        _, reward, terminated, truncated, _ = env.step([action])
        steps, total = steps + 1, total + float(reward)
        if terminated or truncated:
            return steps, total, terminated


@pytest.mark.parametrize(("name", "action", "published"), [("CopperNet", -1.0, -4.43e8), ("CarboNet", 1.0, -7.07e7)])
def test_legacy_episodes_give_the_published_saturated_returns(name: str, action: float, published: float) -> None:
    """51 steps, then 49 and one from a fresh state; the returns are those that the paper reports for DDPG and SAC."""
    env = gymnasium.make(f"cirl_marl/{name}-v0", legacy_episode=True, disable_env_checker=True)
    lengths, returns, ends = zip(*(episode(env, action) for _ in range(4)), strict=True)
    assert lengths == (51, 50, 50, 50)
    assert all(ends)
    assert returns[1] == pytest.approx(published, rel=1.5e-3)
    assert returns[1] == returns[2] == returns[3]


@pytest.mark.parametrize(("name", "action", "clean"), [("CopperNet", -1.0, -4.615e8), ("CarboNet", 1.0, -7.561e7)])
def test_default_episodes_end_by_truncation(name: str, action: float, clean: float) -> None:
    """Fifty steps, ended by truncation; the clean returns of the same constant actions."""
    env = gymnasium.make(f"cirl_marl/{name}-v0", disable_env_checker=True)
    for _ in range(2):
        steps, total, terminated = episode(env, action)
        assert (steps, terminated) == (50, False)
        assert total == pytest.approx(clean, rel=1e-3)


def test_step_counter_is_part_of_a_snapshot() -> None:
    """After a restore the published step counter goes on from where it was."""
    env = cirl_marl.single_agent_env("copper_net", scenario="paper", legacy_episode=True)
    env.reset(seed=0)
    for _ in range(5):
        env.step(np.zeros(1))
    saved = env.snapshot()
    first = [env.step(np.zeros(1))[2] for _ in range(60)]
    env.restore(saved)
    assert [env.step(np.zeros(1))[2] for _ in range(60)] == first
