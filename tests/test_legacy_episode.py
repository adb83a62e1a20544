"""The published step counter and the saturated returns that it explains."""

from __future__ import annotations

import gymnasium
import numpy as np
import pytest
from paper_classes import PAPER

import cirl_marl


def episode(env: gymnasium.Env[object, object], action: float) -> tuple[int, float, bool]:
    """Return length, return and whether the episode ended by termination, under a constant action."""
    env.reset()
    steps, total = 0, 0.0
    while steps < 1000:
        _, reward, terminated, truncated, _ = env.step([action])
        steps, total = steps + 1, total + float(reward)
        if terminated or truncated:
            return steps, total, terminated
    raise AssertionError("the episode does not end")


@pytest.mark.parametrize(("name", "action", "published"), [("CopperNet", -1.0, -4.43e8), ("CarboNet", 1.0, -7.07e7)])
def test_legacy_episodes_give_the_published_saturated_returns(name: str, action: float, published: float) -> None:
    """51 steps, then 49 and one from a fresh state; the returns are those that the paper reports for DDPG and SAC."""
    env = gymnasium.make(f"cirl_marl/{name}-v0", legacy_episode=True, disable_env_checker=True)
    lengths, returns, ends = zip(*(episode(env, action) for _ in range(4)), strict=True)
    assert lengths == (51, 50, 50, 50)
    assert all(ends)
    assert returns[1] == pytest.approx(published, rel=1.5e-3)
    assert returns[1] == returns[2] == returns[3]


def test_published_spread_is_that_of_starts_within_a_unit() -> None:
    """Full control of CopperNet from starts within ±1 kt: the spread is of the size that the paper's log shows, 8e4."""
    network = cirl_marl.load_network("copper_net", scenario="paper")
    env = cirl_marl.MultiAgentVectorEnv(network, num_envs=4000)
    random = np.random.default_rng(0)
    env.reset(seed=0)
    around = {
        node.id: low + random.uniform(-1.0, 1.0, env.num_envs)
        for node, low in zip(network.stores, network.initial[0], strict=True)
        if node.id in network.observation.nodes
    }
    env.reset(seed=0, options={"initial_state": around})
    total = sum(env.step({env.agents[0]: np.ones((env.num_envs, 1))})[1][env.agents[0]] for _ in range(50))
    assert 6e4 < float(np.std(total)) < 9e4


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


@pytest.mark.parametrize(
    ("name", "horizon"),
    [("TransportTruck", 200), ("Incinerator", 100), ("CO2MicroalgaeMonod", 200), ("CO2MicroalgaeDroop", 200)],
)
def test_limit_of_the_compartments(name: str, horizon: int) -> None:
    """Horizon + 1 steps, then horizon − 1 and one more, which starts anew; the limit comes as termination."""
    env = gymnasium.make(f"cirl_marl/{name}-v0", legacy_episode=True, disable_env_checker=True)
    lone: cirl_marl.SingleAgentEnv = env.unwrapped  # type: ignore[assignment]
    model = lone.network.compartments[lone.agent].model
    assert model is not None
    paper = PAPER[model.kind]
    low, high = (np.array(end)[:, None] for end in zip(*paper.inferred_initial, strict=True))
    env.reset(seed=3)
    for length in (horizon + 1, horizon, horizon):
        for step in range(1, length + 1):
            _, _, terminated, truncated, info = env.step(np.ones(1))
            assert (terminated, truncated) == (step == length, False)
        # the state is one Euler step at full input away from a start of the inferred range, whatever came before
        state, inputs = info["state"][:, None], paper.inputs(np.ones((1, 1)))
        start = state.copy()
        for _ in range(60):
            start = state - paper.dt * model.derivative(start, inputs)  # type: ignore[attr-defined]
        assert (start >= low - 1e-9).all()
        assert (start <= high + 1e-9).all()
        env.reset()


def test_counter_survives_a_reset() -> None:
    """An episode that is cut short leaves the counter where it was; the next is so much shorter."""
    env = gymnasium.make("cirl_marl/CO2MicroalgaeMonod-v0", legacy_episode=True, disable_env_checker=True)
    env.reset(seed=0)
    for _ in range(30):
        env.step(np.zeros(1))
    assert episode(env, 0.0)[0] == 201 - 30
    assert episode(env, 0.0)[0] == 200
    plain = gymnasium.make("cirl_marl/CO2MicroalgaeMonod-v0", disable_env_checker=True)
    plain.reset(seed=0)
    for _ in range(30):
        plain.step(np.zeros(1))
    assert episode(plain, 0.0)[::2] == (200, False)


def test_saturated_truck() -> None:
    """The return that the paper reports for DDPG, −2.0e11, is full force in every step."""
    env = gymnasium.make("cirl_marl/TransportTruck-v0", legacy_episode=True, disable_env_checker=True)
    lengths, returns, _ = zip(*(episode(env, 1.0) for _ in range(3)), strict=True)
    assert lengths == (201, 200, 200)
    assert returns[1] == pytest.approx(-2.0e11, rel=2e-3)
