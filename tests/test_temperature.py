"""carbo_net with the temperature of the urban troposphere as one more state."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.interpolate import CubicSpline

from cirl_marl import MultiAgentVectorEnv, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.network import Floats

STEPS = 40


def test_temperature_follows_the_stock() -> None:
    """The stocks are those of the default scenario, and the temperature obeys the radiation balance driven by them."""
    plain = rollout(MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=STEPS), Neutral(), seed=0)
    env = MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=STEPS, scenario="temperature")
    warm = rollout(env, Neutral(), seed=0)
    np.testing.assert_allclose(warm.stock, plain.stock, rtol=1e-7)
    assert env.dynamics.inner.names == ("urban_air.temperature_k",)

    network = env.network
    air = network.node_index["urban_air"]
    env.reset(seed=0)
    start = env.physical.stock[air, 0]
    time = np.arange(STEPS + 1) * network.episode.control_interval
    stock = CubicSpline(time, [start, *plain.stock[:, air]])
    model = network.nodes[air].model

    def slope(at: float, state: Floats) -> Floats:
        held = 1000.0 * stock(np.array([at]))
        return model.derivative(state[:, None], np.empty((0, 1)), stock_kg=held)[:, 0]  # type: ignore[union-attr,no-any-return]

    expected = solve_ivp(slope, (0.0, time[-1]), [288.33], rtol=1e-10, atol=1e-10, t_eval=time[1:]).y[0]
    np.testing.assert_allclose(warm.inner[:, 0], expected, atol=1e-6)
    assert abs(expected[-1] - 288.33) > 1e-3, "a temperature that does not move would prove nothing"


def test_neutral_control_leaves_the_model_s_range_within_eleven_days() -> None:
    """Beyond 3750 t of carbon in the urban air no radiation leaves, as docs/compartments.md says."""
    env = MultiAgentVectorEnv("carbo_net", num_envs=1, scenario="temperature")
    run, day = rollout(env, Neutral(), seed=0), env.network.episode.control_interval
    air = run.stock[:, env.network.node_index["urban_air"]]
    assert 10.0 < (int(np.argmax(air > 3750.0)) + 1) * day <= 11.0


def test_more_carbon_dioxide_is_warmer() -> None:
    """The published sign: more of it in the air, less radiation leaves."""
    env = MultiAgentVectorEnv(load_network("carbo_net", scenario="temperature"), num_envs=2, horizon=20)
    env.reset(seed=0, options={"initial_state": {"urban_air": np.array([830.0, 1000.0])}})
    neutral = env.stack(env.neutral_action)
    for _ in range(20):
        env.advance(neutral)
    cold, warm = env.physical.inner[0]
    assert warm > cold
    assert cold == pytest.approx(288.33, abs=1.0)
