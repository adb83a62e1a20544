"""The network of digester, atmosphere and microalgae: λ, the volume ratio, accuracy, and what each agent can do."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cirl_marl import Network, VectorEnv, load_network
from cirl_marl.compartments import model_class
from cirl_marl.controllers import Constant, Neutral
from cirl_marl.evaluate import Rollout, rollout
from cirl_marl.network import Floats

KG_PER_MMOL = 44.01e-6
SCENARIOS = ("default", "droop")


def models(network: Network) -> tuple[Any, Any]:
    """Return the models of digester and microalgae."""
    return network.compartments["digester"].model, network.compartments["microalgae"].model


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_circularity_is_removal_less_emission(scenario: str) -> None:
    """λ = −Δ(ṁ12 − ṁ23) at the end of each interval, and its mean follows from the atmosphere's stock."""
    env = VectorEnv("net_zero", num_envs=3, scenario=scenario, horizon=10)
    env.reset(seed=0)
    network, rng = env.network, np.random.default_rng(0)
    digester, culture = models(network)
    air = network.node_index["atmosphere"]
    for _ in range(10):
        before = env.physical.stock[air].copy()
        actions = rng.uniform(-1, 1, (2, 3))
        outcome = env.advance(actions)
        rows = env.dynamics.inner.rows
        inner = env.physical.inner
        dilution, light = 0.5 + 0.2 * actions[:1], 75.0 + 75.0 * actions[1:]
        emitted = 0.04401 * digester.outflow(inner[rows["digester"]], dilution)
        removed = 218.29 * culture.outflow(inner[rows["microalgae"]], light)
        np.testing.assert_allclose(outcome.circularity, removed - emitted, rtol=1e-12)
        risen = env.physical.stock[air] - before
        np.testing.assert_allclose(outcome.circularity_mean, -risen / 0.25, rtol=1e-9)


def test_neutral_emission_is_the_published_one() -> None:
    """66.96 mmol/(L d) of one cubic metre are 2.947 kg/d."""
    network = load_network("net_zero")
    digester, _ = models(network)
    emission = digester.outflow(digester.equilibrium(0.5)[:, None], np.array([[0.5]]))[0]
    assert emission == pytest.approx(66.96, abs=0.01)
    arc = network.arcs[network.arc_index["emission"]]
    assert arc.rate == pytest.approx(1000.0 * KG_PER_MMOL, rel=1e-12)
    assert arc.rate * emission == pytest.approx(2.947, abs=1e-3)


def uptake_after(days: float, light: float, form: str) -> tuple[float, float]:
    """Return K_CO2·ρ per biovolume and the uptake per litre, mmol/(L d), of Monod's culture from (26, 0)."""
    culture = model_class("microalgae_monod")(form=form)

    def slope(_: float, z: Floats) -> Floats:
        return np.asarray(culture.derivative(z[:, None], np.array([[light]]))[:, 0])

    end = solve_ivp(slope, (0, days), [26.0, 0.0], method="Radau", rtol=1e-10, atol=1e-12).y[:, -1:]
    per_biovolume = culture.co2_per_nutrient * culture.uptake(end, np.array([[light]]))[0]
    return float(per_biovolume), float(per_biovolume * end[0, 0] / 1000.0)


def test_volume_ratios_of_net_zero() -> None:
    """248 with the misprint corrected, 648 with it (625 rounded), 4960, the definition's, with the units kept."""
    corrected, misprinted = 66.955, 175.08
    per_biovolume, per_litre = uptake_after(15.0, 50.0, "published")
    assert per_biovolume == pytest.approx(0.2702, abs=2e-4)
    assert corrected / per_biovolume == pytest.approx(248, abs=1)
    assert misprinted / per_biovolume == pytest.approx(648, abs=1)
    assert corrected / per_litre == pytest.approx(4960, rel=2e-3)
    removal = load_network("net_zero").arcs[1]
    assert removal.rate == pytest.approx(4960e3 * KG_PER_MMOL, rel=1e-4)
    assert uptake_after(40.0, 50.0, "sound")[1] == pytest.approx(per_litre, rel=2e-3), (
        "the sound form has the same limit"
    )


def test_net_zero_is_reached() -> None:
    """At neutral dilution and with enough light the coupled network ends within 1 % of net zero."""
    env = VectorEnv("net_zero", num_envs=1)
    digester, _ = models(env.network)
    names = [f"digester.{name}" for name in digester.state_names]
    env.reset(seed=0, options={"initial_state": dict(zip(names, digester.equilibrium(0.5), strict=True))})
    circularity = np.nan
    for _ in range(env.network.episode.horizon):
        circularity = env.advance(np.array([[0.0], [0.0]])).circularity[0]
    assert abs(circularity) < 0.01 * 2.947


@pytest.mark.parametrize("scenario", SCENARIOS)
def test_against_scipy(scenario: str) -> None:
    """A day of jumping controls: stocks to 2e-5 of what moved, inner states to 1e-4, at the definition's step."""
    network = load_network("net_zero", scenario=scenario)
    env = VectorEnv(network, num_envs=1)
    env.reset(seed=3)
    digester, culture = models(network)
    state = np.concatenate([env.physical.stock[:3, 0], env.physical.inner[:, 0]])
    moved = 0.0
    for actions in np.array([[0.9, -0.9], [-1.0, 1.0], [0.3, -0.2], [1.0, 0.4]]):
        outcome = env.advance(actions[:, None])
        moved += float(outcome.flow.sum()) * 0.25
        inputs = np.array([[0.5 + 0.2 * actions[0]]]), np.array([[75.0 + 75.0 * actions[1]]])

        def slope(_: float, y: Floats, inputs: tuple[Floats, Floats] = inputs) -> Floats:
            tank, algae = y[3:9, None], y[9:, None]
            emitted = 0.04401 * digester.outflow(tank, inputs[0])[0]
            removed = 218.29 * culture.outflow(algae, inputs[1])[0]
            inner = digester.derivative(tank, inputs[0])[:, 0], culture.derivative(algae, inputs[1])[:, 0]
            return np.concatenate([[-emitted, emitted - removed, removed], *inner])

        done = solve_ivp(slope, (0, 0.25), state, method="Radau", rtol=1e-10, atol=1e-12)
        state = done.y[:, -1]
    np.testing.assert_allclose(env.physical.stock[:3, 0], state[:3], atol=2e-5 * moved)
    np.testing.assert_allclose(env.physical.inner[:-1, 0], state[3:-1], rtol=1e-4)


def constant(dilution: float, light: float) -> Rollout:
    """Run an episode of constant controls."""
    env = VectorEnv("net_zero", num_envs=2)
    actions = {"digester": (dilution - 0.5) / 0.2, "microalgae": (light - 75.0) / 75.0}
    return rollout(env, Constant(actions), seed=0)


def test_dilution_trades_methane_for_emission() -> None:
    """Less dilution: less emission, higher λ̄, and the methane service fails."""
    low, high = constant(0.3, 15.0), constant(0.7, 15.0)
    assert (low.mean_flow[0] < high.mean_flow[0]).all()
    assert (low.episode_circularity > high.episode_circularity).all()
    assert (low.episode_service < 0.85).all()
    assert (high.episode_service > 0.999).all()


def test_light_matters() -> None:
    """The optimum of the sound light response beats neutral light, which beats darkness, at the same service."""
    best, dark = constant(0.5, 77.0), constant(0.5, 0.0)
    neutral = rollout(VectorEnv("net_zero", num_envs=2), Neutral(), seed=0)
    assert (best.episode_circularity > neutral.episode_circularity).all()
    assert (neutral.episode_circularity > dark.episode_circularity).all()
    np.testing.assert_allclose(best.service, dark.service, rtol=1e-12)
