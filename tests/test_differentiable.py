"""Gradients of PyTorch through the environment and policies that see it."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from small_networks import KINDS, booked, cycle

import cirl_marl
from cirl_marl import ControlError, DifferentiableEnv, load_network
from cirl_marl.network.disturbances import DisturbanceEffect

NETWORK = replace(
    cycle(),
    disturbances={"ore": KINDS["ore"]},  # which agents see two intervals late
    disturbed={"nodes.use.rate": DisturbanceEffect(by="ore")},
)


def episode(env: DifferentiableEnv, weight: torch.Tensor, schedule: torch.Tensor) -> torch.Tensor:
    """Return what is climbed, of a policy beside a schedule, from the start that the environment is at."""
    observation, total = torch.tensor(env._derivatives.observation()), torch.zeros(2, dtype=torch.float64)
    for actions in schedule:
        observation, circularity, levels = env.step(torch.tanh(weight @ observation) * 0.3 + actions)
        total = total + circularity / 100 + levels.sum(dim=0)
    return total


def test_open_loop_gradients_are_those_of_numpy() -> None:
    """By actions, start and disturbances."""
    env = DifferentiableEnv(NETWORK, num_envs=2)
    env.reset(3)
    entries = len(env.env.actuators.control_rows)
    schedule = torch.tensor(np.random.default_rng(0).uniform(-0.5, 0.5, (4, entries, 2)), requires_grad=True)
    exact = cirl_marl.gradient(env.env, schedule.detach().numpy(), circularity=0.04, levels=4.0)
    weight = torch.zeros(entries, len(env._derivatives.observation()), dtype=torch.float64)
    episode(env, weight, schedule).sum().backward()  # type: ignore[no-untyped-call]
    assert schedule.grad is not None and env.start.grad is not None and env.disturbances.grad is not None
    np.testing.assert_allclose(schedule.grad.numpy(), exact.actions, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(env.start.grad[: len(exact.start)].numpy(), exact.start, rtol=1e-12, atol=1e-14)
    np.testing.assert_allclose(env.disturbances.grad.numpy(), exact.disturbances, rtol=1e-12, atol=1e-14)
    assert np.abs(exact.disturbances).max() > 0


def test_gradients_go_through_policies() -> None:
    """By the weights of a policy that sees stocks, flows, levels and late disturbances, and by these."""
    env, rng = DifferentiableEnv(NETWORK, num_envs=2), np.random.default_rng(0)
    env.reset(3)
    state, controls = env.env.physical, env.env.controls
    shape = (len(env.env.actuators.control_rows), len(env._derivatives.observation()))
    weight = torch.tensor(rng.normal(size=shape) * 0.1, requires_grad=True)
    schedule = torch.tensor(rng.uniform(-0.5, 0.5, (4, shape[0], 2)))
    episode(env, weight, schedule).sum().backward()  # type: ignore[no-untyped-call]
    assert weight.grad is not None and env.disturbances.grad is not None

    def along(part: str, direction: np.ndarray, step: float) -> float:
        changed = state if part == "weight" else replace(state, disturbances=state.disturbances + step * direction)
        env.env.go_back(changed, controls)
        moved = weight.detach() + (step * torch.tensor(direction) if part == "weight" else 0.0)
        with torch.no_grad():
            return float(episode(env, moved, schedule).sum())

    late = rng.normal(size=state.disturbances.shape)
    late[-1] = 0.0
    exact = {"weight": weight.grad.numpy(), "disturbances": env.disturbances.grad.numpy()}
    for part, direction in (("weight", rng.normal(size=shape)), ("disturbances", late)):
        slope = (along(part, direction, 1e-6) - along(part, direction, -1e-6)) / 2e-6
        assert float((exact[part] * direction).sum()) == pytest.approx(slope, rel=1e-6)


def test_steps_need_a_start() -> None:
    """And say so."""
    with pytest.raises(ControlError, match="call reset"):
        DifferentiableEnv(NETWORK, num_envs=1).step(torch.zeros(1, 1))


@pytest.mark.parametrize("actions", [torch.zeros(99, 2), torch.zeros(2), np.zeros((1, 2)), None])
def test_actions_are_checked(actions: Any) -> None:
    """What was given, and what is expected."""
    env = DifferentiableEnv(NETWORK, num_envs=2)
    env.reset(seed=0)
    with pytest.raises(ControlError, match=r"actions are a tensor of shape \(\d+, 2\), got (shape|ndarray|NoneType)"):
        env.step(actions)


def test_gradients_of_what_is_booked() -> None:
    """Amounts on accounts can be climbed down too, those that a policy's actions book later included."""
    network = booked(load_network("paper_city").with_options(episode={"horizon": 4}), 3)
    env = DifferentiableEnv(network, num_envs=2)
    env.reset(1)
    entries = len(env.env.actuators.control_rows)
    schedule = torch.tensor(np.random.default_rng(0).uniform(-0.5, 0.5, (4, entries, 2)), requires_grad=True)
    exact = cirl_marl.gradient(env.env, schedule.detach().numpy(), circularity=0.0, accounts=[2.0, -1.0])
    totals = torch.zeros(2, 2, dtype=torch.float64)
    for actions in schedule:
        env.step(actions)
        totals = totals + env.bookings
    np.testing.assert_allclose(totals.detach().numpy(), exact.accounts, rtol=1e-12)
    (2.0 * totals[0] - totals[1]).sum().backward()  # type: ignore[no-untyped-call]
    assert schedule.grad is not None and np.abs(exact.actions).max() > 0
    np.testing.assert_allclose(schedule.grad.numpy(), exact.actions, rtol=1e-12, atol=1e-12)
