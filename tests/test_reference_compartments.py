"""The paper's environments of one compartment, through Gymnasium: published trajectories, starts, returns, limits."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
from numpy.typing import NDArray
from paper_classes import PAPER, trajectory
from scipy.integrate import solve_ivp

from cirl_marl import SingleAgentEnv
from cirl_marl.compartments import model_class

MODELS = {
    "TransportTruck": ("transport_truck", 200),
    "Incinerator": ("incinerator", 100),
    "CO2MicroalgaeMonod": ("microalgae_monod", 200),
    "CO2MicroalgaeDroop": ("microalgae_droop", 200),
}


def make(name: str, **options: Any) -> gymnasium.Env[Any, Any]:
    """Return a registered environment without Gymnasium's checker, whose warnings are errors here."""
    return gymnasium.make(f"cirl_marl/{name}-v0", disable_env_checker=True, **options)


@pytest.mark.parametrize("name", MODELS)
def test_horizon_is_a_truncation(name: str) -> None:
    """The last of 200 or 100 decisions truncates the episode and terminates nothing."""
    _, horizon = MODELS[name]
    env = make(name)
    env.reset(seed=0)
    ends = [env.step(np.zeros(1))[2:4] for _ in range(horizon)]
    assert ends == [(False, False)] * (horizon - 1) + [(False, True)]


@pytest.mark.parametrize("name", MODELS)
def test_published_trajectory_of_one_compartment(name: str) -> None:
    """Through gymnasium.make, started where the published class starts, over every published row."""
    kind, _ = MODELS[name]
    actions, states, rewards = trajectory(name)
    paper = PAPER[kind]
    env = make(name, horizon=len(states))
    _, info = env.reset(seed=0, options={"initial_state": paper.reference_start})
    np.testing.assert_array_equal(info["state"], paper.reference_start)
    for t, action in enumerate(actions):
        observation, reward, terminated, truncated, info = env.step(np.array([action]))
        assert not (terminated or truncated)
        assert info["state"].dtype == np.float64
        assert observation.dtype == np.float32
        np.testing.assert_array_equal(observation, info["state"].astype(np.float32))
        np.testing.assert_allclose(info["state"], states[t + 1], rtol=1e-9, atol=1e-12)
        # Droop's first reward is K_CO2·ρ at S = 0; the start that stands for it is −1.1e-10
        assert reward == pytest.approx(rewards[t], rel=1e-9, abs=4e-9 if t == 0 else 1e-12)
    assert t == 199


@pytest.mark.parametrize("name", MODELS)
def test_starts_and_bounds(name: str) -> None:
    """Starts fill the inferred ranges; the observation is the model's state in the paper's order."""
    kind, horizon = MODELS[name]
    cls = model_class(kind)
    env = make(name)
    low, high = np.array(PAPER[kind].inferred_initial).T
    starts = np.array([env.reset(seed=seed)[1]["state"] for seed in range(200)])
    assert (starts >= low).all()
    assert (starts <= high).all()
    np.testing.assert_allclose(starts.min(axis=0), low, atol=0.05 * (high - low).max() + 1e-12)
    np.testing.assert_allclose(starts.max(axis=0), high, atol=0.05 * (high - low).max() + 1e-12)
    agent: SingleAgentEnv = env.unwrapped  # type: ignore[assignment]
    assert agent.network.observation.mode in ("stocks", "model")
    assert [name.split(".")[1] for name in agent.parallel.layout.names[agent.agent]] == list(cls.state_names)
    control = agent.network.compartments[agent.agent].control
    assert control is not None
    assert (control.low, control.high) == (PAPER[kind].input_low[0], PAPER[kind].input_high[0])
    assert agent.network.episode.horizon == horizon
    assert agent.network.episode.control_interval == 5e-5
    assert env.action_space.shape == (1,)


@pytest.mark.parametrize("name", MODELS)
def test_euler_is_first_order(name: str) -> None:
    """At a constant input a whole episode agrees with scipy, and the error falls with the step, to order 1."""
    kind, _ = MODELS[name]
    model = model_class(kind)(form="published")
    env: Any = make(name).unwrapped
    paper = PAPER[kind]
    start = np.mean(paper.inferred_initial, axis=1)
    span = 0.002
    value = 0.25 * (paper.input_high[0] - paper.input_low[0]) + paper.input_low[0]

    def slope(_: float, z: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.asarray(model.derivative(z[:, None], np.array([[value]]))[:, 0])

    exact = solve_ivp(slope, (0, span), start, method="Radau", rtol=1e-10, atol=1e-12).y[:, -1]
    errors = []
    for refine in (1, 2, 4):
        step = 5e-5 / refine
        network = env.network.with_options(
            episode={"control_interval": step, "solver_step": step, "horizon": round(span / step)}
        )
        fine = SingleAgentEnv(network, env.agent)
        fine.reset(seed=0, options={"initial_state": start})
        for _ in range(round(span / step)):
            *_, info = fine.step(np.array([-0.5]))
        errors.append(np.abs(info["state"] - exact).max())
    assert errors[0] < 0.05 * np.abs(exact - start).max()
    np.testing.assert_allclose(np.log2(np.divide(errors[:-1], errors[1:])), 1.0, atol=0.15)


@pytest.mark.parametrize(
    ("name", "start", "action", "total", "digits"),
    [
        ("CO2MicroalgaeMonod", [26, 0], -1.0, 103.446, 1e-5),
        ("CO2MicroalgaeMonod", [26, 0], 0.0, 101.638, 1e-5),
        ("CO2MicroalgaeMonod", [26, 0], 1.0, 90.823, 1e-5),
        ("CO2MicroalgaeMonod", [26, 1], -1.0, 143.8, 3e-4),
        ("CO2MicroalgaeMonod", [26, 1], 0.0, 114.7, 3e-4),
        ("CO2MicroalgaeMonod", [26, 2], -1.0, 143.89, 1e-3),
        ("CO2MicroalgaeMonod", [26, 2], 0.0, 114.7, 1e-3),
        ("CO2MicroalgaeMonod", [26, 2], 1.0, 95.4, 1e-3),
        ("CO2MicroalgaeDroop", [26, 2.82, 1], 0.0, 329.0, 3e-3),
        ("CO2MicroalgaeDroop", [26, 2.82, 2], 0.0, 504.0, 3e-3),
        ("CO2MicroalgaeDroop", [26, 2.82, 5], 0.0, 550.0, 3e-3),
        ("TransportTruck", [0, 4], 0.0, -1.99992e8, 2e-6),
        ("TransportTruck", [0, 4], 1e-4, -1.99992e8 - 2000.0, 2e-6),
        ("TransportTruck", [0, 4], -1.0, -2.002e11, 1e-4),
        ("TransportTruck", [0, 4], 1.0, -2.002e11, 1e-4),
        ("Incinerator", [0, 0, 20, 0, 0, 20], -1.0, -9.52e7, 1e-3),
    ],
)
def test_published_figures_of_constant_actions(
    name: str, start: list[float], action: float, total: float, digits: float
) -> None:
    """Returns that were computed independently; Monod in darkness is the limit, 0/0 in the published code."""
    env = make(name)
    env.reset(seed=0, options={"initial_state": np.array(start, dtype=float)})
    earned, over = 0.0, False
    while not over:
        _, reward, _, over, _ = env.step(np.array([action]))
        earned += float(reward)
    assert earned == pytest.approx(total, rel=digits)


def best_action(name: str, start: list[float]) -> float:
    """Return which of some constant actions earns most from a start."""
    earned = {}
    for action in (-1.0, -0.5, 0.0, 1e-4, 0.5, 1.0):
        env, over, total = make(name), False, 0.0
        env.reset(seed=0, options={"initial_state": start})
        while not over:
            _, reward, _, over, _ = env.step(np.array([action]))
            total += float(reward)
        earned[action] = total
    return max(earned, key=lambda action: earned[action])


@pytest.mark.parametrize(
    ("name", "start", "best"),
    [
        ("CO2MicroalgaeMonod", [26.0, 1.0], -1.0),
        ("CO2MicroalgaeDroop", [26.0, 2.82, 0.0], 1.0),
        ("TransportTruck", [0.0, 4.0], 0.0),
        ("Incinerator", [0.0, 0.0, 20.0, 0.0, 0.0, 20.0], -1.0),
    ],
)
def test_best_constant_action(name: str, start: list[float], best: float) -> None:
    """Monod: darkness; Droop: full light, by a hair; truck: no force; incinerator from 20 °C: all the heat there is."""
    assert best_action(name, start) == best


def test_idle_incinerator_from_the_inferred_start() -> None:
    """T_g(0) ~ U[900, 1100] °C and 100 idle steps: −3.40e5 on average, as the paper's episodes; 9.6e5 from 20 °C."""
    totals = []
    for start in np.linspace(900.0, 1100.0, 21):
        env = make("Incinerator")
        env.reset(seed=0, options={"initial_state": [0.0, 0.0, 20.0, 0.0, 0.0, start]})
        totals.append(sum(float(env.step(np.zeros(1))[1]) for _ in range(100)))
    assert np.trapezoid(totals, dx=1.0 / 20.0) == pytest.approx(-3.40e5, rel=0.02)
    env.reset(seed=0, options={"initial_state": [0.0, 0.0, 20.0, 0.0, 0.0, 20.0]})
    assert float(env.step(np.zeros(1))[1]) == pytest.approx(-9.6e5, rel=1e-3)


def test_darkness_is_a_limit() -> None:
    """Monod's f(I) is 0/0 at I = 0 in the published code; here the action −1 is what actions near it tend to."""
    found = {}
    for action in (-1.0, -1.0 + 1e-6, -1.0 + 2e-6):
        env = make("CO2MicroalgaeMonod")
        env.reset(seed=0, options={"initial_state": [26.0, 3.0]})
        _, reward, _, _, info = env.step(np.array([action]))
        found[action] = np.array([float(reward), *info["state"]])
    dark, near, further = found.values()
    assert np.isfinite(dark).all()
    assert dark[0] == pytest.approx(0.72 * dark[2] / (dark[2] + 0.0012), rel=1e-12)
    np.testing.assert_allclose(2.0 * near - further, dark, rtol=1e-11)
    assert near[0] < dark[0]


def test_light_does_not_matter_to_droop() -> None:
    """By 0.1 % at most: differences between the paper's algorithms come from the start."""
    totals = []
    for action in (-1.0, 0.0, 1.0):
        env = make("CO2MicroalgaeDroop")
        env.reset(seed=0, options={"initial_state": np.array([26.0, 2.82, 0.0])})
        totals.append(sum(float(env.step(np.array([action]))[1]) for _ in range(200)))
    assert max(totals) / min(totals) - 1.0 < 1.1e-3
    assert totals == pytest.approx([98.52, 98.6, 98.62], rel=1e-3)
