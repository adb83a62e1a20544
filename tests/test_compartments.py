"""Compartment models: published trajectories and figures, closed forms, balances."""

from __future__ import annotations

import pkgutil
import subprocess
import sys
from collections.abc import Callable
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import solve_ivp

from cirl_marl import compartments
from cirl_marl.compartments import ContinuousModel, PaperScenario, model_class, models
from cirl_marl.compartments.atmosphere import Atmosphere
from cirl_marl.compartments.delivery_truck import DeliveryTruck
from cirl_marl.compartments.digester import Digester
from cirl_marl.compartments.digester_published import DigesterPublished
from cirl_marl.compartments.incinerator import PUBLISHED_FLOWS, Incinerator
from cirl_marl.compartments.light import light_response
from cirl_marl.compartments.microalgae_droop import MicroalgaeDroop
from cirl_marl.compartments.microalgae_monod import MicroalgaeMonod
from cirl_marl.compartments.transport_truck import TransportTruck
from cirl_marl.compartments.troposphere_temperature import TroposphereTemperature
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats
from cirl_marl.units import factor

REFERENCE = Path(__file__).parent / "reference"
HELPERS = {"model", "light", "nutrient"}
"""Modules of the package that hold no model."""

PAPER: dict[str, tuple[ContinuousModel, PaperScenario, tuple[int, ...]]] = {
    "TransportTruck": (TransportTruck(form="published"), TransportTruck.paper, (0,)),
    "Incinerator": (Incinerator(form="published"), Incinerator.paper, (0, 1, 2, 3, 4)),
    "CO2MicroalgaeMonod": (MicroalgaeMonod(form="published"), MicroalgaeMonod.paper, ()),
    "CO2MicroalgaeDroop": (MicroalgaeDroop(form="published"), MicroalgaeDroop.paper, (2,)),
}
"""Model, scenario, and the states that the published first step rounds to float32."""

FORMS: list[ContinuousModel] = [
    *(entry[0] for entry in PAPER.values()),
    TransportTruck(),
    DeliveryTruck(),
    Incinerator(form="energy_balance"),
    Incinerator(),
    MicroalgaeMonod(),
    MicroalgaeDroop(),
    Digester(),
    DigesterPublished(),
    Atmosphere(volume_l=2.0),
    TroposphereTemperature(),
]
"""Every form of every model."""

RANGES: dict[str, tuple[list[float], list[float], list[float], list[float]]] = {
    "transport_truck": ([0, -5], [1000, 25], [-12e3], [12e3]),
    "delivery_truck": ([-5, -5, 0], [15, 5, 10], [-12e3], [12e3]),
    "incinerator": ([500, 20, 200, 20, 20, 800], [3000, 200, 500, 60, 60, 1200], [-1e5], [6e5]),
    "microalgae_monod": ([10, 0.5], [40, 20], [1], [150]),
    "microalgae_droop": ([10, 2, 0.5], [40, 4, 20], [1], [150]),
    "digester": ([1, 1, 4, 3, 205, 220], [2, 4, 8, 8, 215, 245], [0.3], [0.7]),
    "digester_published": ([1, 1, 4, 3, 205, 230], [2, 4, 8, 8, 215, 240], [0.4] * 6, [0.6] * 6),
    "atmosphere": ([1], [9], [0, 0], [5, 5]),
    "troposphere_temperature": ([280], [300], [600], [1500]),
}
"""State and input ranges from which samples are drawn."""

SPAN: dict[str, float] = {"s": 5.0, "min": 5.0, "day": 0.5}
"""How long a model runs, in its unit."""


def name_of(model: ContinuousModel) -> str:
    """Return the name of a test case."""
    return f"{model.kind}-{getattr(model, 'form', 'only')}"


def sample(model: ContinuousModel, size: int) -> tuple[Floats, Floats]:
    """Return states (k, B) and inputs (c, B) drawn from the model's ranges."""
    rng = np.random.default_rng(7)
    low, high, input_low, input_high = (np.array(bound, dtype=np.float64)[:, None] for bound in RANGES[model.kind])
    state = rng.uniform(low, high, size=(len(low), size))
    return state, rng.uniform(input_low, input_high, size=(len(input_low), size))


def rk4(model: ContinuousModel, state: Floats, inputs: Floats, span: float, steps: int) -> Floats:
    """Return the state after ``span`` at constant inputs, by the classical Runge-Kutta method."""
    h = span / steps
    for _ in range(steps):
        k1 = model.derivative(state, inputs)
        k2 = model.derivative(state + h / 2 * k1, inputs)
        k3 = model.derivative(state + h / 2 * k2, inputs)
        k4 = model.derivative(state + h * k3, inputs)
        state = state + h / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
    return state


def solve(model: ContinuousModel, state: Floats, inputs: Floats, times: list[float], method: str = "DOP853") -> Floats:
    """Return the states (k, times) of one column at constant inputs, by scipy at a tolerance of 1e-11."""

    def rate(_: float, z: Floats) -> Floats:
        return model.derivative(z[:, None], inputs[:, None])[:, 0]

    done = solve_ivp(rate, (0.0, times[-1]), state, t_eval=times, method=method, rtol=1e-11, atol=1e-11)
    assert done.success
    found: Floats = done.y
    return found


def euler(model: ContinuousModel, paper: PaperScenario, start: Floats, actions: Floats) -> tuple[Floats, Floats]:
    """Return the states (k, n + 1) and rewards (n,) of the published environment for one action sequence."""
    states, rewards = [start], []
    for action in actions:
        inputs = paper.inputs(np.array([[action]]))
        state = states[-1]
        new = state + paper.dt * model.derivative(state, inputs)
        rewards.append(model.reward(new if model.reward_state == "after" else state, inputs)[0])
        states.append(new)
    return np.concatenate(states, axis=1), np.array(rewards)


def episode_return(name: str, action: float, start: list[float] | None = None, steps: int = 200) -> float:
    """Return the sum of rewards at a constant normalised action."""
    model, paper, _ = PAPER[name]
    state = np.array(paper.initial_state if start is None else start)[:, None]
    return float(euler(model, paper, state, np.full(steps, action))[1].sum())


def reference(name: str) -> tuple[Floats, Floats, Floats]:
    """Return actions (n,), states (k, n + 1) and rewards (n,) of a published class; its last row has only a state."""
    table = np.loadtxt(REFERENCE / f"{name}.csv", delimiter=",", skiprows=1)
    return table[:-1, 0], table[:, 1:-1].T, table[:-1, -1]


class TestReference:
    """The trajectories of the published classes."""

    @pytest.mark.parametrize("name", PAPER)
    def test_every_row(self, name: str) -> None:
        """From the start that stands for the float32 first step, every later state and every reward to 1e-9."""
        model, paper, _ = PAPER[name]
        actions, published, earned = reference(name)
        states, rewards = euler(model, paper, np.array(paper.reference_start)[:, None], actions)
        np.testing.assert_allclose(states[:, 1:], published[:, 1:], rtol=1e-9, atol=1e-12)
        # Droop's first reward is K_CO2·ρ at S = 0; the start that stands for it is −1.1e-10
        np.testing.assert_allclose(rewards, earned, rtol=1e-9, atol=4e-9 if name == "CO2MicroalgaeDroop" else 1e-12)

    @pytest.mark.parametrize("name", PAPER)
    def test_from_the_second_row_to_the_last_digit(self, name: str) -> None:
        """The published step works in float64 from its second step on; there nothing is left to explain."""
        model, paper, _ = PAPER[name]
        actions, published, earned = reference(name)
        states, rewards = euler(model, paper, published[:, 1:2], actions[1:])
        np.testing.assert_allclose(states, published[:, 1:], rtol=2e-14)
        np.testing.assert_allclose(rewards, earned[1:], rtol=2e-14)

    @pytest.mark.parametrize("name", PAPER)
    def test_first_step_rounds_to_float32(self, name: str) -> None:
        """NumPy 2 keeps float32 where a float32 state meets Python floats: that is the whole of the first step."""
        model, paper, rounded = PAPER[name]
        actions, published, earned = reference(name)
        start = np.array(paper.initial_state, dtype=np.float32)[:, None]
        np.testing.assert_array_equal(start[:, 0], published[:, 0])
        inputs = paper.inputs(actions[:1][None])
        rate = model.derivative(start, inputs)  # type: ignore[arg-type]
        state = start + paper.dt * rate
        for i in rounded:
            state[i] = start[i] + np.float32(paper.dt * rate[i])
        np.testing.assert_allclose(state[:, 0], published[:, 1], rtol=1e-15)
        after = state if model.reward_state == "after" else start.astype(np.float64)
        np.testing.assert_allclose(model.reward(after, inputs)[0], earned[0], rtol=1e-10)

    @pytest.mark.parametrize("name", PAPER)
    def test_start_is_the_published_one_in_float32(self, name: str) -> None:
        """The start that stands for the float32 step differs from the published one by less than float32 resolves."""
        _, paper, _ = PAPER[name]
        np.testing.assert_allclose(paper.reference_start, paper.initial_state, rtol=6e-8, atol=2e-10)
        assert len(paper.inferred_initial) == len(paper.initial_state)

    def test_action_map(self) -> None:
        """−1 and +1 are the bounds, 0 the middle; what lies outside is clipped."""
        actions = np.array([[-2.0, -1.0, 0.0, 1.0, 2.0]])
        inputs = MicroalgaeMonod.paper.inputs(actions)
        np.testing.assert_array_equal(inputs, [[0.0, 0.0, 75.0, 150.0, 150.0]])


class TestPublishedFigures:
    """Returns and values of PHYSICS §1, 3 and 4, computed there independently."""

    @pytest.mark.parametrize(
        ("name", "action", "start", "total", "digits"),
        [
            ("CO2MicroalgaeMonod", -1.0, None, 103.446, 1e-3),
            ("CO2MicroalgaeMonod", 0.0, None, 101.638, 1e-3),
            ("CO2MicroalgaeMonod", 1.0, None, 90.823, 1e-3),
            ("CO2MicroalgaeMonod", -1.0, [26.0, 1.0], 143.8, 0.05),
            ("CO2MicroalgaeMonod", 0.0, [26.0, 1.0], 114.7, 0.05),
            ("CO2MicroalgaeMonod", 1.0, [26.0, 2.0], 95.4, 0.05),
            ("CO2MicroalgaeDroop", -1.0, None, 98.52, 0.006),
            ("CO2MicroalgaeDroop", 1.0, None, 98.62, 0.006),
            ("CO2MicroalgaeDroop", 0.0, [26.0, 2.82, 2.0], 504.0, 0.5),
            ("TransportTruck", 0.0, None, -1.99992e8, 500.0),
            ("TransportTruck", 1e-4, None, -1.99992e8 - 2000.0, 500.0),
            ("TransportTruck", 1.0, None, -2.002e11, 5e7),
            ("Incinerator", -1.0, None, -1.888e8, 5e4),
        ],
    )
    def test_returns(self, name: str, action: float, start: list[float] | None, total: float, digits: float) -> None:
        """Two hundred steps at a constant action."""
        assert episode_return(name, action, start) == pytest.approx(total, abs=digits)

    @pytest.mark.parametrize(("action", "total"), [(-1.0, 102.9), (0.0, 101.1), (1.0, 90.4)])
    def test_monod_with_the_reward_of_the_state_before(self, action: float, total: float) -> None:
        """PHYSICS §3 sums the reward of the state before each step; the published class takes S after it, 0.5 more."""
        model, paper, _ = PAPER["CO2MicroalgaeMonod"]
        states, _ = euler(model, paper, np.array(paper.initial_state)[:, None], np.full(200, action))
        inputs = paper.inputs(np.full((1, 200), action))
        assert model.reward(states[:, :-1], inputs).sum() == pytest.approx(total, abs=0.05)

    def test_incinerator_step(self) -> None:
        """From the released 20 °C a step costs 9.6e5; from 1000 °C on average, 100 idle steps cost 3.4e5."""
        assert episode_return("Incinerator", 0.0, steps=1) == pytest.approx(-9.6e5, rel=1e-3)
        starts = np.linspace(900.0, 1100.0, 201)
        totals = [episode_return("Incinerator", 0.0, [0, 0, 20, 0, 0, start], 100) for start in starts]
        assert np.mean(totals) == pytest.approx(-3.40e5, rel=0.02)

    @pytest.mark.parametrize(
        ("model", "temperature"),
        [
            (Incinerator(form="published"), 743.3),
            (Incinerator(form="energy_balance", grate_heat_kj_kg_k=5.0), 20.80),
            (Incinerator(form="energy_balance"), 20.63),
        ],
    )
    def test_wastebed_after_three_hours(self, model: Incinerator, temperature: float) -> None:
        """T_w at 180 min: the published feed term heats the bed without end."""
        start = np.array(Incinerator.paper.initial_state)
        assert solve(model, start, np.array([40.0]), [180.0])[2, -1] == pytest.approx(temperature, abs=0.05)

    def test_digester_equilibrium(self) -> None:
        """The published equilibrium at D = 0.5 1/d, and what leaves it."""
        digester, inputs = Digester(), np.array([[0.5]])
        state = digester.equilibrium(0.5)[:, None]
        expected = [1.3351, 1.8684, 6.1420, 4.7408, 212.19, 236.245]
        np.testing.assert_allclose(state[:, 0], expected, atol=2e-3, rtol=2e-5)
        np.testing.assert_allclose(digester.derivative(state, inputs), 0.0, atol=1e-10)
        assert digester.partial_pressure(state)[0] == pytest.approx(0.3909, abs=5e-5)
        assert digester.gas(state)[0] == pytest.approx(446.37, abs=5e-3)
        assert digester.outflow(state, inputs)[0] == pytest.approx(66.96, abs=6e-3)
        assert digester.reward(state, inputs)[0] == -digester.outflow(state, inputs)[0]
        assert digester.feed[4] == pytest.approx(212.188, abs=1e-3)

    def test_volume_ratio(self) -> None:
        """Digester over algae: 625 with the misprint and a rounded uptake, 248 without, 4960 per litre of culture."""
        published, digester = DigesterPublished(), Digester()
        state, none = digester.equilibrium(0.5)[:, None], np.zeros((6, 1))
        wrong, right = published.outflow(state, none)[0], digester.outflow(state, none)[0]
        assert wrong == pytest.approx(175.08, abs=5e-3)
        assert DigesterPublished(misprint=False).outflow(state, none)[0] == right
        monod, light = MicroalgaeMonod(form="published"), np.array([50.0])
        culture = solve(monod, np.array([26.0, 0.0]), light, [15.0], "LSODA")
        uptake = monod.outflow(culture, light[:, None])[0]
        assert uptake == pytest.approx(0.2702, abs=1e-4)
        assert culture[0, 0] == pytest.approx(49.97, abs=0.02)
        per_litre = uptake * culture[0, 0] / 1000.0
        assert per_litre == pytest.approx(0.0135, abs=5e-5)
        assert wrong / 0.28 == pytest.approx(625, abs=1)
        assert wrong / uptake == pytest.approx(648, abs=1)
        assert right / uptake == pytest.approx(248, abs=1)
        assert right / per_litre == pytest.approx(4960, abs=10)

    def test_troposphere(self) -> None:
        """Steady temperatures of the closed and the open loop, and the slow approach to them."""
        model = TroposphereTemperature()
        open_loop = (915.4 + 1830.8 + 210 / 0.7 + 500 / 0.4) / 3.0
        celsius = model.steady_state_k(np.array([637.2, open_loop, 4000.0])) - 273.15
        assert celsius[0] == pytest.approx(13.454, abs=5e-4)
        assert celsius[1] == pytest.approx(35.38, abs=5e-3)
        assert np.isnan(celsius[2])
        steady = model.steady_state_k(np.array([637.2]))[0]
        eased = solve(model, np.array([steady + 1.0]), np.array([637.2]), [2785.0])[0, -1] - steady
        assert eased == pytest.approx(np.exp(-1.0), rel=0.01)
        assert model.reward(np.array([[288.05]]), np.array([[637.2]]))[0] == pytest.approx(-1.0)


def check_truck() -> None:
    """Constant force: x = v₀t + F t²/2m."""
    found = solve(TransportTruck(form="published"), np.array([0.0, 4.0]), np.array([4000.0]), [15.0])
    np.testing.assert_allclose(found[:, -1], [60.0 + 4000 / 3210 * 112.5, 4.0 + 4000 / 3210 * 15], rtol=1e-10)


def check_incinerator() -> None:
    """Repaired bed: T − 20.8 = −0.8·(C₀/(C₀ + 21t))^(125/21), for C grows by 21 kJ/K a minute."""
    found = solve(Incinerator(form="energy_balance"), np.array(Incinerator.paper.initial_state), np.zeros(1), [180.0])
    expected = 20.8 - 0.8 * (12500.0 / (12500.0 + 21.0 * 180.0)) ** (125.0 / 21.0)
    assert found[2, -1] == pytest.approx(expected, rel=1e-10)


def check_monod() -> None:
    """Nutrient outside and inside, S + X/Y, tends to the feed's like a tracer."""
    found = solve(MicroalgaeMonod(), np.array([26.0, 3.0]), np.array([80.0]), [2.0])
    expected = 100.0 + (3.0 + 26.0 / 0.5 - 100.0) * np.exp(-0.45 * 2.0)
    assert found[1, -1] + found[0, -1] / 0.5 == pytest.approx(expected, rel=1e-9)


def check_droop() -> None:
    """Nutrient outside and inside, S + XQ, tends to the feed's like a tracer (the authors' own check)."""
    found = solve(MicroalgaeDroop(), np.array([26.0, 2.82, 3.0]), np.array([80.0]), [2.0])
    expected = 100.0 + (3.0 + 26.0 * 2.82 - 100.0) * np.exp(-0.45 * 2.0)
    assert found[2, -1] + found[0, -1] * found[1, -1] == pytest.approx(expected, rel=1e-9)


def check_digester() -> None:
    """Alkalinity is a tracer: Z − Zin decays by e^(−Dt)."""
    digester = Digester()
    start = digester.equilibrium(0.5) + np.array([0.1, 0.1, 0.1, 0.1, 5.0, 1.0])
    found = solve(digester, start, np.array([0.4]), [3.0])
    assert found[4, -1] - digester.feed[4] == pytest.approx(5.0 * np.exp(-1.2), rel=1e-8)


def check_digester_published() -> None:
    """Under its controller |x̃| = |x̃0|·(1 − t/T)^((1 + T)/2): zero at T = 3.5 d, misprint or not."""
    for model in (DigesterPublished(), DigesterPublished(misprint=False)):
        middle = model.equilibrium
        start = middle + np.array([-1.0, 0.5, 1.0, 1.5, 0.8, -0.5])

        def rate(_: float, z: Floats, model: DigesterPublished = model, start: Floats = start) -> Floats:
            return model.derivative(z[:, None], model.controller(z[:, None], start[:, None]))[:, 0]

        done = solve_ivp(rate, (0.0, 3.0), start, rtol=1e-11, atol=1e-12)
        expected = np.linalg.norm(start - middle) * (1.0 - 3.0 / 3.5) ** 2.25
        assert np.linalg.norm(done.y[:, -1] - middle) == pytest.approx(expected, rel=1e-6)


def check_atmosphere() -> None:
    """The stock changes by the net flow."""
    box = Atmosphere(volume_l=4.0)
    found = solve(box, np.array([10.0]), np.array([3.0, 1.0]), [2.0])
    assert found[0, -1] == pytest.approx(14.0)
    assert box.concentration_mmol_l(found)[0] == pytest.approx(3.5)
    assert box.reward(found, np.array([[3.0], [1.0]]))[0] == -2.0


def check_temperature() -> None:
    """The steady state is where absorbed equals emitted."""
    model, co2 = TroposphereTemperature(), np.array([[637.2, 1000.0]])
    np.testing.assert_allclose(model.derivative(model.steady_state_k(co2), co2), 0.0, atol=1e-15)


def check_delivery_truck() -> None:
    """Without resistance a constant force gives a parabola; the destination stays; the load counts."""
    truck = DeliveryTruck(form="published")
    state, inputs = np.array([[1.0], [2.0], [10.0]]), np.array([[3.4e3]])
    found = rk4(truck, state, inputs, 4.0, 1)
    np.testing.assert_allclose(found[:, 0], [1.0 + 8.0 + 0.5 * 3.4 / 3.0 * 16.0, 2.0 + 4 * 3.4 / 3.0, 10.0], rtol=1e-13)
    loaded = truck.derivative(state, inputs, load_kg=np.array([400.0]))
    np.testing.assert_allclose(loaded[:, 0], [2.0, 1.0, 0.0], rtol=1e-14)


ANALYTIC: dict[str, Callable[[], None]] = {
    "transport_truck": check_truck,
    "delivery_truck": check_delivery_truck,
    "incinerator": check_incinerator,
    "microalgae_monod": check_monod,
    "microalgae_droop": check_droop,
    "digester": check_digester,
    "digester_published": check_digester_published,
    "atmosphere": check_atmosphere,
    "troposphere_temperature": check_temperature,
}
"""The analytic answer of each kind."""


LIGHT = {kind: model for kind, model in models().items() if ".robots." not in model.__module__}
"""Kinds without an engine; test_robots.py tests the robots."""


class TestRegistry:
    """What lies in the folder is what there is, and all of it is tested."""

    def test_every_model_has_an_analytic_answer(self) -> None:
        """A model without a test fails here, and so does a test without a model."""
        assert set(LIGHT) == set(ANALYTIC) == set(RANGES) == {model.kind for model in FORMS}

    def test_every_module_holds_a_model(self) -> None:
        """Each module but the helpers is found by the registry."""
        modules = {info.name for info in pkgutil.iter_modules(compartments.__path__) if not info.ispkg}
        assert {kind.__module__.rpartition(".")[2] for kind in LIGHT.values()} == modules - HELPERS

    @pytest.mark.parametrize("kind", ANALYTIC)
    def test_analytic_answer(self, kind: str) -> None:
        """The closed form."""
        ANALYTIC[kind]()

    def test_discovery_is_light(self) -> None:
        """Finding the models loads neither torch nor mujoco."""
        code = (
            "import sys, cirl_marl.compartments as c; c.model_class('digester');"
            "print({'torch', 'mujoco'} & {*sys.modules})"
        )
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
        assert done.stdout.strip() == "set()"

    def test_unknown_kind(self) -> None:
        """The error names the nearest match."""
        with pytest.raises(CirlError, match="Did you mean 'digester'"):
            model_class("digestor")

    def test_models_returns_a_copy(self) -> None:
        """Nobody can empty the registry."""
        models().clear()
        assert models()

    @pytest.mark.parametrize(
        ("build", "message"),
        [
            (lambda: TransportTruck(form="publised"), "Did you mean 'published'"),  # type: ignore[arg-type]
            (lambda: TransportTruck(truck_kg=-1.0), "truck_kg = -1.0"),
            (lambda: Incinerator(gas_residence_min=0.0), "gas_residence_min = 0.0"),
            (lambda: Incinerator(reference_degc=-300.0), "reference_k"),
            (lambda: MicroalgaeMonod(light_half_saturation=0.0), "light_half_saturation = 0.0"),
            (lambda: MicroalgaeDroop(dilution_per_day=float("nan")), "dilution_per_day = nan"),
            (lambda: Digester(k1=0.0), "k1 = 0.0"),
            (lambda: Digester().equilibrium(3.0), "no equilibrium"),
            (lambda: Digester().equilibrium(0.0), "no equilibrium"),
            (lambda: DigesterPublished(settling_day=0.0), "settling_day"),
            (lambda: Atmosphere(volume_l=0.0), "volume_l"),
            (lambda: TroposphereTemperature(albedo=1.0), "albedo = 1.0"),
        ],
    )
    def test_bad_parameters(self, build: Callable[[], Any], message: str) -> None:
        """Parameters without a meaning are refused by name."""
        with pytest.raises(CirlError, match=message):
            build()


@pytest.mark.parametrize("model", FORMS, ids=name_of)
class TestEveryModel:
    """The contract of a compartment model."""

    def test_shapes_units_purity(self, model: ContinuousModel) -> None:
        """Shapes and dtypes are as stated, inputs stay as they were, the time unit can be read."""
        state, inputs = sample(model, 5)
        kept = state.copy(), inputs.copy()
        assert state.shape[0] == len(model.state_names)
        assert inputs.shape[0] == len(model.input_names)
        rate, reward = model.derivative(state, inputs), model.reward(state, inputs)
        assert rate.shape == state.shape
        assert reward.shape == (5,)
        assert rate.dtype == reward.dtype == np.float64
        if hasattr(model, "outflow"):
            assert model.outflow(state, inputs).shape == (5,)
        np.testing.assert_array_equal(state, kept[0])
        np.testing.assert_array_equal(inputs, kept[1])
        assert factor(model.time_unit, "s") > 0.0
        with pytest.raises(AttributeError):
            setattr(model, fields(model)[0].name, 1.0)  # type: ignore[arg-type]

    @pytest.mark.parametrize("size", [2, 7, 64])
    def test_batched_equals_alone(self, model: ContinuousModel, size: int) -> None:
        """A column's bits do not depend on the batch it is in."""
        state, inputs = sample(model, size)
        rate, reward = model.derivative(state, inputs), model.reward(state, inputs)
        for b in range(size):
            own_state, own_inputs = state[:, b : b + 1].copy(), inputs[:, b : b + 1].copy()
            np.testing.assert_array_equal(model.derivative(own_state, own_inputs), rate[:, b : b + 1])
            np.testing.assert_array_equal(model.reward(own_state, own_inputs), reward[b : b + 1])

    def test_agrees_with_scipy(self, model: ContinuousModel) -> None:
        """Runge-Kutta at a fine step and scipy's DOP853 at 1e-11 agree."""
        state, inputs = sample(model, 3)
        span = SPAN[model.time_unit]
        fine = rk4(model, state, inputs, span, 4000)
        for b in range(3):
            exact = solve(model, state[:, b], inputs[:, b], [span])[:, -1]
            np.testing.assert_allclose(fine[:, b], exact, rtol=2e-9, atol=1e-9)


class TestLight:
    """The light response, and darkness."""

    def test_limit_in_darkness(self) -> None:
        """Published: 1, the limit of 0/0. Sound: 0."""
        dark = np.zeros(2)
        np.testing.assert_array_equal(light_response(dark, half_saturation=0.0, inhibition=295.0), 1.0)
        np.testing.assert_array_equal(light_response(dark, half_saturation=20.0, inhibition=295.0), 0.0)
        state, inputs = np.array([[26.0], [1.0]]), np.zeros((1, 1))
        published = MicroalgaeMonod(form="published").reward(state, inputs)[0]
        assert published == pytest.approx(0.72 / 1.0012)
        assert MicroalgaeMonod().reward(state, inputs)[0] == 0.0
        nearly = MicroalgaeMonod(form="published").reward(state, inputs + 1e-9)[0]
        assert published == pytest.approx(nearly, rel=1e-10)

    def test_optimum(self) -> None:
        """Haldane's light response is greatest at √(K_sI·K_iI), within the bounds of the control."""
        light = np.linspace(0.0, 150.0, 15001)
        best = light[np.argmax(light_response(light, half_saturation=20.0, inhibition=295.0))]
        assert best == pytest.approx(np.sqrt(20.0 * 295.0), abs=0.01)

    @pytest.mark.parametrize("kind", [MicroalgaeMonod, MicroalgaeDroop])
    def test_uptake_is_of_the_culture(self, kind: type[MicroalgaeMonod] | type[MicroalgaeDroop]) -> None:
        """Sound: reward and outflow scale with the biomass; published: they do not."""
        state, inputs = np.array([[10.0, 30.0], [3.0, 3.0], [3.0, 3.0]]), np.full((1, 2), 50.0)
        state = state[: len(kind.state_names)]
        thin, dense = kind().outflow(state, inputs)
        assert dense == pytest.approx(3.0 * thin)
        thin, dense = kind(form="published").outflow(state, inputs)
        assert dense == thin


class TestBalances:
    """What the sound forms conserve."""

    @given(
        speed=st.floats(-60, 60),
        force=st.floats(-2e4, 2e4),
        load=st.floats(0, 1e4),
    )
    def test_truck_loses_energy_only_to_friction(self, speed: float, force: float, load: float) -> None:
        """d(½mv²)/dt = F·v − dissipation, and dissipation ≥ 0."""
        truck, mass = TransportTruck(), 3000.0 + load
        rate = truck.derivative(np.array([[0.0], [speed]]), np.array([[force]]), load_kg=load)
        dissipation = truck.resistance_n(np.array([speed]), mass)[0] * speed
        assert dissipation >= 0.0
        assert mass * speed * rate[1, 0] == pytest.approx(force * speed - dissipation, rel=1e-9, abs=1e-6)

    def test_truck_without_resistance_is_the_published(self) -> None:
        """The sound form contains the published one; a load of its own per truck counts."""
        bare = TransportTruck(rolling_resistance=0.0, drag_area_m2=0.0)
        state, inputs = np.array([[0.0, 5.0], [4.0, 9.0]]), np.array([[4000.0, -100.0]])
        np.testing.assert_array_equal(
            bare.derivative(state, inputs), TransportTruck(form="published").derivative(state, inputs)
        )
        loaded = bare.derivative(state, inputs, load_kg=np.array([0.0, 1000.0]))
        np.testing.assert_allclose(loaded[1], [4000.0 / 3000.0, -100.0 / 4000.0])

    def test_truck_reaches_its_terminal_speed(self) -> None:
        """Where force equals resistance, and it comes to rest without a force."""
        truck = TransportTruck()
        terminal = np.sqrt((1000.0 - 0.01 * 3210.0 * 9.80665) / (0.5 * 1.2 * 3.0))
        assert solve(truck, np.array([0.0, 4.0]), np.array([1000.0]), [5000.0])[1, -1] == pytest.approx(terminal)
        assert abs(solve(truck, np.array([0.0, 4.0]), np.array([0.0]), [200.0])[1, -1]) < 1e-6

    @pytest.mark.parametrize("feed", [None, 40.0])
    def test_incinerator_conserves_mass(self, feed: float | None) -> None:
        """What stays is what came in less what went out; the published rates lose 66 kg/min of the waste consumed."""
        model = Incinerator()
        state, inputs = sample(model, 50)
        flows = model.flows(state, feed)
        rate = model.derivative(state, inputs, feed_kg_min=feed)
        stored = rate[[0, 1, 3, 4]].sum(axis=0)
        net = flows.feed + 5.0 + 3.0 - flows.ash - flows.char_out - flows.flue
        np.testing.assert_allclose(stored, net, rtol=1e-12, atol=1e-12)
        usual = PUBLISHED_FLOWS
        assert usual.consumed - usual.char_made + usual.char_burnt - usual.gas_made == 66.0

    def test_incinerator_recovers_the_published_rates(self) -> None:
        """At the reference inventories and temperature the rates of the bed are the published ones."""
        state = np.array([2400.0, 150.0, 300.0, 1.0, 1.0, 900.0])[:, None]
        found, usual = Incinerator().flows(state), PUBLISHED_FLOWS
        for name in ("feed", "ash", "consumed", "char_made", "char_burnt", "char_out"):
            np.testing.assert_allclose(getattr(found, name), getattr(usual, name), rtol=1e-14, err_msg=name)

    def test_incinerator_conserves_enthalpy(self) -> None:
        """Freeboard: what is stored is what flows in and out with its own temperature, plus heat released and taken."""
        model = Incinerator()
        state, inputs = sample(model, 50)
        flows, rate = model.flows(state), model.derivative(state, inputs)
        bed_capacity, capacity = model.capacities(state)
        released = 10_000.0 * flows.gas_made
        exchanged = 20.0 * (state[5] - state[2])
        stored = capacity * rate[5] + 5.0 * rate[4] * state[5]
        carried = 5.0 * (flows.to_freeboard * state[2] + 3.0 * 20.0 - flows.flue * state[5])
        np.testing.assert_allclose(stored, carried + 0.95 * released - exchanged - inputs[0], rtol=1e-9)
        fed = (flows.feed * 1.0 + 5.0 * 5.0) * (20.0 - state[2])
        np.testing.assert_allclose(bed_capacity * rate[2], fed + 0.05 * released + exchanged, rtol=1e-9)

    @given(bed=st.floats(20, 1500), freeboard=st.floats(20, 1500), waste=st.floats(0, 5000))
    def test_incinerator_does_not_heat_by_itself(self, bed: float, freeboard: float, waste: float) -> None:
        """Without combustion nothing gets hotter than the hottest, nor colder than ambient; published, the bed does."""
        model = Incinerator(combustion_kj_kg=0.0)
        state = np.array([waste, 10.0, bed, 5.0, 5.0, freeboard])[:, None]
        rate = model.derivative(state, np.array([[1e6]]))
        if bed >= freeboard:
            assert rate[2, 0] <= 1e-12
        if freeboard >= bed:
            assert rate[5, 0] <= 1e-12
        cold = np.array([waste, 10.0, 20.0, 5.0, 5.0, 20.0])[:, None]
        np.testing.assert_allclose(model.derivative(cold, np.array([[1e6]]))[[2, 5]], 0.0, atol=1e-12)
        assert Incinerator(form="published", bed_heat_kj_min=0.0).derivative(cold, np.zeros((1, 1)))[2, 0] > 0.0

    def test_incinerator_can_hold_its_set_point(self) -> None:
        """With 6.4e5 kJ/min of heat recovered the freeboard settles at 1000 °C, at finite masses."""
        start = np.array([2400.0, 150.0, 300.0, 36.0, 37.0, 1000.0])[:, None]
        model, inputs = Incinerator(), np.array([[6.44e5]])
        end = rk4(model, start, inputs, 1000.0, 5000)
        assert end[5, 0] == pytest.approx(1000.0, abs=10.0)
        np.testing.assert_allclose(model.derivative(end, inputs), 0.0, atol=1e-3)
        assert model.outflow(end, inputs)[0] == pytest.approx(model.flows(end).flue)

    def test_digester_conserves_what_it_digests(self) -> None:
        """In the reactions alone, S1 + k1·X1 and S2 − k2·X1 + k3·X2 do not change; no dilution, no alkalinity lost."""
        digester = Digester()
        state, _ = sample(digester, 50)
        rate = digester.derivative(state, np.zeros((1, 50)))
        np.testing.assert_allclose(rate[1] + 42.14 * rate[0], 0.0, atol=1e-12)
        np.testing.assert_allclose(rate[3] - 116.5 * rate[0] + 268.0 * rate[2], 0.0, atol=1e-11)
        np.testing.assert_array_equal(rate[4], 0.0)
        carbon = 50.6 * rate[0] + 343.6 * rate[2] - digester.gas(state)
        np.testing.assert_allclose(rate[5], carbon, rtol=1e-12)
        np.testing.assert_allclose(digester.methane(state), 453.0 * rate[2], rtol=1e-12)

    @given(
        carbon=st.floats(0, 400), acids=st.floats(0, 100), alkalinity=st.floats(0, 300), methanogens=st.floats(0, 20)
    )
    def test_digester_gas_is_always_defined(
        self, carbon: float, acids: float, alkalinity: float, methanogens: float
    ) -> None:
        """The root is real for any state, and P_C solves its quadratic."""
        digester = Digester()
        state = np.array([1.0, 1.0, methanogens, acids, alkalinity, carbon])[:, None]
        free = carbon + acids - alkalinity
        pressure = digester.partial_pressure(state)[0]
        phi = free + 16.0 + 453.0 / 19.8 * digester.growth(state)[1][0]
        if phi > 1.0:  # below, the two roots are of either sign and the expression has lost its meaning
            residual = 16.0 * pressure**2 - phi * pressure + free
            assert abs(residual) <= 1e-9 * (1.0 + phi**2)

    def test_one_dilution_for_all_is_the_sound_form(self) -> None:
        """Six equal dilutions and no misprint: the published form is the sound one."""
        state, inputs = sample(Digester(), 8)
        published = DigesterPublished(misprint=False).derivative(state, np.repeat(inputs, 6, axis=0))
        np.testing.assert_allclose(published, Digester().derivative(state, inputs), rtol=1e-12, atol=1e-9)


class TestVehicleAndDeliveries:
    """What models do for the network besides moving in time."""

    def test_a_truck_loads_and_unloads_where_it_rests(self) -> None:
        """Boarding and arrival need the place, rest and the right destination; turning changes the destination only."""
        truck = DeliveryTruck()
        #                 waiting  moving  away  bound   there  too fast  empty there
        position = np.array([0.2, 0.2, 3.0, 0.2, 9.8, 9.8, 9.8])
        speed = np.array([0.1, 2.0, 0.0, 0.0, -0.3, 1.5, 0.0])
        destination = np.array([0.0, 0.0, 0.0, 10.0, 10.0, 10.0, 0.0])
        state = np.stack([position, speed, destination])
        assert truck.boarding(state).tolist() == [True, *[False] * 6]
        assert truck.arrived(state).tolist() == [False] * 4 + [True, False, False]
        left = truck.depart(state, truck.boarding(state))
        assert left[2].tolist() == [10.0, 0.0, 0.0, 10.0, 10.0, 10.0, 0.0]
        back = truck.turn_back(state, truck.arrived(state))
        assert back[2].tolist() == [0.0, 0.0, 0.0, 10.0, 0.0, 10.0, 0.0]
        np.testing.assert_array_equal(left[:2], state[:2])
        assert state[2].tolist() == destination.tolist()

    @pytest.mark.parametrize("form", ["published", "energy_balance", "sound"])
    def test_a_delivery_cools_the_bed_and_keeps_its_heat(self, form: str) -> None:
        """(c M + c M_c + C)(T_w − T_a) is the same before and after; nothing but M and T_w changes."""
        plant = Incinerator(form=form)  # type: ignore[arg-type]
        state, _ = sample(plant, 20)
        mass = np.random.default_rng(0).uniform(0.0, 500.0, 20)
        after = plant.receive(state, mass)

        def heat(z: Floats) -> Floats:
            stored: Floats = plant.capacities(z)[0] * (z[2] - plant.ambient_degc)
            return stored

        np.testing.assert_allclose(heat(after), heat(state), rtol=1e-13)
        np.testing.assert_allclose(after[0] - state[0], mass, rtol=1e-12, atol=1e-12)
        assert (after[2] < state[2]).all()
        np.testing.assert_array_equal(after[[1, 3, 4, 5]], state[[1, 3, 4, 5]])

    def test_methane_is_what_the_digester_measures(self) -> None:
        """k6·μ2·X2 at the published equilibrium, 695.6 mmol/(L d)."""
        digester = Digester()
        state = digester.equilibrium(0.5)[:, None]
        assert digester.measure_names == ("methane_mmol_l_day",)
        assert digester.measures(state, np.array([[0.5]]))[0, 0] == pytest.approx(695.58, abs=0.01)
        assert digester.k6 * digester.growth(state)[1][0] == pytest.approx(695.58, abs=0.01)
