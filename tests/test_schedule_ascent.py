"""Schedules that climb exact gradients over common draws."""

from __future__ import annotations

import numpy as np
import pytest

import cirl_marl
from cirl_marl import MultiAgentVectorEnv


@pytest.mark.slow
def test_schedules_climb_towards_the_bound() -> None:
    """Of a start that is known, most of the way to what is possible; the environment stays where it is."""
    env = MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=24)
    env.reset(3)
    state = env.physical
    start = np.zeros((24, len(env.actuators.control_rows)))
    best = cirl_marl.improve_schedule(env, start, min_service=0.99, updates=150)
    assert env.physical is state
    initial = dict(zip(env.state_names, env.state()[0][:-1], strict=False))
    bound = cirl_marl.bound(env.network, initial, min_service=0.99)
    assert best.levels.min() >= 0.99
    first = cirl_marl.gradient(env, start).circularity[0]
    assert bound.value >= best.circularity >= bound.value - 0.1 * (bound.value - first)
    played = cirl_marl.gradient(env, best.actions)
    assert played.circularity[0] == pytest.approx(best.circularity, rel=1e-12)
    # a hair of lack is none: what has more service and is worse does not take its place
    again = cirl_marl.improve_schedule(env, best.actions, min_service=best.levels + 5e-10, updates=30)
    assert again.circularity >= best.circularity


def test_the_best_of_common_draws_is_kept() -> None:
    """Never worse than what it began with, in the mean over the copies."""
    env = MultiAgentVectorEnv("paper_city", num_envs=3, horizon=6, scenario="breakdowns")
    env.reset(0)
    start = np.zeros((6, len(env.actuators.control_rows)))
    before = cirl_marl.gradient(env, start)
    best = cirl_marl.improve_schedule(env, start, updates=5, rate=1e-3)
    weight = env.circularity_weight
    prices = np.array([service.weight for service in env.network.services]) * (1 - weight) / weight
    scale = env.network.objective.circularity_scale

    def worth(circularity: float, levels: np.ndarray) -> float:
        return float(circularity / scale + prices @ levels)

    assert worth(best.circularity, best.levels) > worth(before.circularity.mean(), before.levels.mean(axis=1))
