"""Compartment models: closed forms, balances, and what distinguishes the sound forms from the published ones."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper_classes import PAPER
from scipy.integrate import solve_ivp

from cirl_marl import MultiAgentVectorEnv
from cirl_marl.compartments import models
from cirl_marl.compartments.atmosphere import Atmosphere
from cirl_marl.compartments.delivery_truck import DeliveryTruck
from cirl_marl.compartments.digester import Digester
from cirl_marl.compartments.digester_published import DigesterPublished
from cirl_marl.compartments.incinerator import PUBLISHED_FLOWS, Incinerator
from cirl_marl.compartments.microalgae import light_response
from cirl_marl.compartments.microalgae_droop import MicroalgaeDroop
from cirl_marl.compartments.microalgae_monod import MicroalgaeMonod
from cirl_marl.compartments.transport_truck import TransportTruck
from cirl_marl.compartments.troposphere_temperature import TroposphereTemperature
from cirl_marl.network.compartment_model import ContinuousModel
from cirl_marl.network.rowsum import Floats


def solve(
    model: ContinuousModel, state: Floats, inputs: Floats, times: list[float], method: str = "DOP853", **context: Any
) -> Floats:
    """Return the states (k, times) of one column at constant inputs, by scipy at a tolerance of 1e-11."""

    def rate(_: float, z: Floats) -> Floats:
        return model.derivative(z[:, None], inputs[:, None], **context)[:, 0]

    done = solve_ivp(rate, (0.0, times[-1]), state, t_eval=times, method=method, rtol=1e-11, atol=1e-11)
    assert done.success
    found: Floats = done.y
    return found


def uniform(low: list[float], high: list[float], size: int) -> Floats:
    """Return states (k, B) between two corners, always the same."""
    rng = np.random.default_rng(7)
    return rng.uniform(np.array(low)[:, None], np.array(high)[:, None], (len(low), size))


HOT = ([500.0, 20.0, 200.0, 20.0, 20.0, 800.0], [3000.0, 200.0, 500.0, 60.0, 60.0, 1200.0])
"""States of a burning incinerator."""

LIVING = ([1.0, 1.0, 4.0, 3.0, 205.0, 220.0], [2.0, 4.0, 8.0, 8.0, 215.0, 245.0])
"""States of a working digester."""


def check_truck() -> None:
    """Constant force: x = v₀t + F t²/2m."""
    found = solve(TransportTruck(form="published"), np.array([0.0, 4.0]), np.array([4000.0]), [15.0])
    np.testing.assert_allclose(found[:, -1], [60.0 + 4000 / 3210 * 112.5, 4.0 + 4000 / 3210 * 15], rtol=1e-10)


def check_delivery_truck() -> None:
    """Without resistance x = v₀t + Ft²/2m; with drag alone x = ln(1 + kv₀t)/k; with rolling alone v = v₀ − c_rr·g·t."""
    start = np.array([1.0, 5.0, 10.0])
    bare = DeliveryTruck(rolling_resistance=0.0, drag_area_m2=0.0)
    coasted = solve(bare, start, np.zeros(1), [2.0])[:, -1]
    np.testing.assert_allclose(coasted, [11.0, 5.0, 10.0], rtol=1e-10)
    pulled = solve(bare, start, np.array([-6000.0]), [2.0], load_kg=600.0)[:, -1]
    np.testing.assert_allclose(
        pulled, [1.0 + 10.0 - 6000.0 / 3600.0 * 2.0, 5.0 - 6000.0 / 3600.0 * 2.0, 10.0], rtol=1e-9
    )
    dragged = solve(DeliveryTruck(rolling_resistance=0.0), start, np.zeros(1), [50.0], load_kg=200.0)[:, -1]
    k = 0.5 * 1.2 * 3.0 / 3200.0
    np.testing.assert_allclose(dragged, [1.0 + np.log1p(k * 250.0) / k, 5.0 / (1.0 + k * 250.0), 10.0], rtol=1e-9)
    rolled = solve(DeliveryTruck(drag_area_m2=0.0), start, np.zeros(1), [20.0], load_kg=200.0)[:, -1]
    braked = 0.01 * 9.80665
    np.testing.assert_allclose(rolled, [1.0 + 100.0 - braked * 200.0, 5.0 - braked * 20.0, 10.0], rtol=1e-9)


def check_incinerator() -> None:
    """Repaired bed: T − 20.8 = −0.8·(C₀/(C₀ + 21t))^(125/21), for C grows by 21 kJ/K a minute."""
    found = solve(
        Incinerator(form="energy_balance"), np.array(PAPER["incinerator"].initial_state), np.zeros(1), [180.0]
    )
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
    box = Atmosphere()
    found = solve(box, np.array([10.0]), np.array([3.0, 1.0]), [2.0])
    assert found[0, -1] == pytest.approx(14.0)
    assert box.reward(found, np.array([[3.0], [1.0]]))[0] == -2.0


def test_atmosphere_is_the_stock_of_a_network() -> None:
    """Of net_zero, whose node has no model: fed with the flows of its arcs the box holds what the node holds."""
    env, box, kg_per_mmol = MultiAgentVectorEnv("net_zero", num_envs=3, horizon=20), Atmosphere(), 44.01e-6
    env.reset(seed=0)
    air, rng = env.network.node_index["atmosphere"], np.random.default_rng(0)
    assert env.network.nodes[air].model is None
    arcs = [env.network.arc_index[arc] for arc in ("emission", "removal")]
    state = env.physical.stock[[air]] / kg_per_mmol
    for _ in range(20):
        flow = env.advance(rng.uniform(-1.0, 1.0, (2, 3))).flow[arcs]
        # the rate does not depend on the stock, so that mean flows give the change exactly
        state = state + env.network.episode.control_interval * box.derivative(state, flow / kg_per_mmol)
        np.testing.assert_allclose(state[0] * kg_per_mmol, env.physical.stock[air], rtol=1e-13)


def check_temperature() -> None:
    """The steady state is where absorbed equals emitted."""
    model, co2 = TroposphereTemperature(), np.array([[637.2, 1000.0]])
    rate = model.derivative(model.steady_state_k(co2), np.empty((0, 2)), stock_kg=1000.0 * co2[0])
    np.testing.assert_allclose(rate, 0.0, atol=1e-15)


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


class TestAnswers:
    """Closed forms."""

    def test_every_model_has_an_analytic_answer(self) -> None:
        """A continuous model without one fails here, and so does an answer without a model."""
        assert {kind for kind, model in models().items() if issubclass(model, ContinuousModel)} == set(ANALYTIC)

    @pytest.mark.parametrize("kind", ANALYTIC)
    def test_analytic_answer(self, kind: str) -> None:
        """The closed form."""
        ANALYTIC[kind]()

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
        start = np.array(PAPER["incinerator"].initial_state)
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

    def test_troposphere(self) -> None:
        """Steady temperatures of the closed and the open loop, and the slow approach to them."""
        model = TroposphereTemperature()
        open_loop = (915.4 + 1830.8 + 210 / 0.7 + 500 / 0.4) / 3.0
        celsius = model.steady_state_k(np.array([637.2, open_loop, 4000.0])) - 273.15
        assert celsius[0] == pytest.approx(13.454, abs=5e-4)
        assert celsius[1] == pytest.approx(35.38, abs=5e-3)
        assert np.isnan(celsius[2])
        steady = model.steady_state_k(np.array([637.2]))[0]
        held = np.array([637.2e3])
        eased = solve(model, np.array([steady + 1.0]), np.empty(0), [2785.0], stock_kg=held)[0, -1] - steady
        assert eased == pytest.approx(np.exp(-1.0), rel=0.01)
        assert model.reward(np.array([[288.05]]), np.array([[637.2]]))[0] == pytest.approx(-1.0)


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


class TestDeliveryTruck:
    """When the truck may load and unload, and where it then heads."""

    TRUCK = DeliveryTruck()

    @given(
        position=st.floats(-2.0, 12.0),
        speed=st.floats(-3.0, 3.0),
        destination=st.sampled_from([0.0, 10.0]),
    )
    def test_loads_and_unloads_at_rest(self, position: float, speed: float, destination: float) -> None:
        """Within 0.5 m of the place it heads for and slower than 1 m/s, in either direction; nowhere else."""
        state = np.array([[position], [speed], [destination]])
        slow = abs(speed) <= 1.0
        assert self.TRUCK.can_board(state)[0] == (abs(position) <= 0.5 and slow and destination == 0.0)
        assert self.TRUCK.has_arrived(state)[0] == (9.5 <= position <= 10.5 and slow and destination == 10.0)

    def test_turns_only_where_it_is_told(self) -> None:
        """The destination of the chosen columns changes, nothing else, and the given state stays as it was."""
        state = np.array([[0.1, 0.2, 9.9, 10.1], [0.3, -0.2, 0.1, 0.0], [0.0, 0.0, 10.0, 10.0]])
        kept, where = state.copy(), np.array([True, False, True, False])
        left = self.TRUCK.depart(state, where)
        np.testing.assert_array_equal(left[2], [10.0, 0.0, 10.0, 10.0])
        back = self.TRUCK.turn_back(state, where)
        np.testing.assert_array_equal(back[2], [0.0, 0.0, 0.0, 10.0])
        for turned in (left, back):
            np.testing.assert_array_equal(turned[:2], kept[:2])
        np.testing.assert_array_equal(state, kept)

    @pytest.mark.parametrize("load_kg", [0.0, 600.0])
    def test_round_trip_at_full_force(self, load_kg: float) -> None:
        """Full force, then full brake: v_p² = 9.5a + ½ brings it to 9.5 m at 1 m/s after (2v_p − 1)/a, loaded later."""
        truck, h, yes = DeliveryTruck(rolling_resistance=0.0, drag_area_m2=0.0), 1e-3, np.array([True])
        acceleration = 12e3 / (3000.0 + load_kg)
        peak = np.sqrt(9.5 * acceleration + 0.5)
        state = truck.depart(np.array([[0.0], [0.0], [0.0]]), yes)
        elapsed = 0.0
        while not truck.has_arrived(state)[0]:
            assert not truck.can_board(state)[0]
            assert elapsed < 10.0
            force = np.array([[12e3 if elapsed < peak / acceleration else -12e3]])
            state = state + h * truck.derivative(state, force, load_kg=load_kg)
            elapsed += h
        assert elapsed == pytest.approx((2.0 * peak - 1.0) / acceleration, abs=5 * h)
        state = truck.turn_back(state, yes)
        assert not truck.has_arrived(state)[0]
        home = np.array([[0.4], [-0.9], [state[2, 0]]])
        assert truck.can_board(home)[0]

    def test_reward_is_the_distance_to_where_it_heads(self) -> None:
        """−((destination − x)² + 0.1 v² + 1e-8 F²), and nothing is better than to rest where it heads."""
        state, force = np.array([[4.0], [2.0], [10.0]]), np.array([[1e4]])
        assert self.TRUCK.reward(state, force)[0] == pytest.approx(-(36.0 + 0.4 + 1.0), rel=1e-14)
        assert self.TRUCK.reward(np.array([[10.0], [0.0], [10.0]]), np.zeros((1, 1)))[0] == 0.0


class TestReceive:
    """A delivery that is tipped onto the wastebed."""

    @given(
        waste=st.floats(0.0, 5000.0),
        char=st.floats(0.0, 500.0),
        bed=st.floats(-20.0, 1200.0),
        mass=st.floats(0.0, 2000.0),
        form=st.sampled_from(["published", "energy_balance", "sound"]),
    )
    def test_energy_and_mass(self, waste: float, char: float, bed: float, mass: float, form: Any) -> None:
        """(c_w M + c_c M_c + C_grate)(T_w − T_a) is kept, M grows by the mass, the rest stays to the last bit."""
        model = Incinerator(form=form)
        state = np.array([[waste], [char], [bed], [36.0], [37.0], [900.0]])
        after = model.receive(state, np.array([mass]))
        grate = 500.0 * (5.0 if form == "published" else 25.0)
        energy = [(z[0] + z[1] + grate) * (z[2] - 20.0) for z in (state, after)]
        np.testing.assert_allclose(energy[1], energy[0], rtol=1e-12, atol=1e-6)
        assert after[0, 0] == waste + mass
        np.testing.assert_array_equal(after[[1, 3, 4, 5]], state[[1, 3, 4, 5]])
        assert abs(after[2, 0] - 20.0) <= abs(bed - 20.0) * (1.0 + 1e-15) + 1e-13
        assert state[0, 0] == waste

    def test_parts_make_the_whole(self) -> None:
        """Two deliveries are one of their sum, nothing delivered changes no bit, each column has its own mass."""
        model, state = Incinerator(), uniform(*HOT, 4)
        masses = np.array([0.0, 100.0, 200.0, 300.0])
        once = model.receive(state, masses)
        twice = model.receive(model.receive(state, 0.25 * masses), 0.75 * masses)
        np.testing.assert_allclose(twice, once, rtol=1e-14)
        np.testing.assert_array_equal(once[:, 0], state[:, 0])
        assert (once[2, 1:] < state[2, 1:]).all()
        bed = 2400.0 + 150.0 + 25.0 * 500.0
        cooled = model.receive(np.array([[2400.0], [150.0], [300.0], [36.0], [37.0], [1000.0]]), np.array([300.0]))
        assert cooled[2, 0] == pytest.approx(20.0 + 280.0 * bed / (bed + 300.0), rel=1e-14)


class TestMeasures:
    """What a digester's service reads."""

    def test_methane_at_equilibrium(self) -> None:
        """k6/k3 of the fatty acids fed, made and not washed out; 695.58 at 0.5/d, of which net_zero asks for 95 %."""
        digester = Digester()
        for dilution in (0.3, 0.475, 0.5, 0.7):
            state, inputs = digester.equilibrium(dilution)[:, None], np.array([[dilution]])
            made = 116.5 / 42.14 * dilution * (30.0 - state[1, 0])
            eaten = dilution * (750.0 - state[3, 0]) + made
            assert digester.measures(state, inputs)[0, 0] == pytest.approx(453.0 / 268.0 * eaten, rel=1e-10)

        neutral, low = (digester.methane(digester.equilibrium(d)[:, None])[0] for d in (0.5, 0.475))
        assert neutral == pytest.approx(695.58, abs=0.01)
        assert low / neutral == pytest.approx(0.95, abs=1e-3)

    def test_is_the_methane(self) -> None:
        """One row for the one name, k6·μ2X2, whatever the dilution at the moment."""
        digester, state = Digester(), uniform(*LIVING, 6)
        assert digester.measure_names == ("methane_mmol_l_day",)
        fast, slow = (digester.measures(state, np.full((1, 6), dilution)) for dilution in (0.7, 0.3))
        np.testing.assert_array_equal(fast, slow)
        np.testing.assert_array_equal(fast[0], 453.0 * digester.growth(state)[1])
        np.testing.assert_array_equal(fast[0], digester.methane(state))


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
        state, inputs = uniform(*HOT, 50), uniform([-1e5], [6e5], 50)
        flows = model.flows(state, feed)
        rate = model.derivative(state, inputs, feed_kg_min=feed)
        stored = rate[[0, 1, 3, 4]].sum(axis=0)
        net = flows.feed + 5.0 + 3.0 - flows.ash - flows.char_out - flows.flue
        np.testing.assert_allclose(stored, net, rtol=1e-12, atol=1e-12)
        usual = PUBLISHED_FLOWS
        assert usual.waste_consumed - usual.char_made + usual.char_burnt - usual.gas_made == 66.0

    def test_incinerator_recovers_the_published_rates(self) -> None:
        """At the reference inventories and temperature the rates of the bed are the published ones."""
        state = np.array([2400.0, 150.0, 300.0, 1.0, 1.0, 900.0])[:, None]
        found, usual = Incinerator().flows(state), PUBLISHED_FLOWS
        for name in ("feed", "ash", "waste_consumed", "char_made", "char_burnt", "char_out"):
            np.testing.assert_allclose(getattr(found, name), getattr(usual, name), rtol=1e-14, err_msg=name)

    def test_incinerator_conserves_enthalpy(self) -> None:
        """Freeboard: what is stored is what flows in and out with its own temperature, plus heat released and taken."""
        model = Incinerator()
        state, inputs = uniform(*HOT, 50), uniform([-1e5], [6e5], 50)
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
        """At the reference 3.56e5 kJ/min hold it for half a minute; with 6.44e5 the plant comes to rest there."""
        start = np.array([2400.0, 150.0, 300.0, 36.0, 37.5, 1000.0])
        model, inputs = Incinerator(), np.array([[6.44e5]])
        for feed in (0.0, 100.0):
            soon = solve(model, start, np.array([3.56e5]), [0.1, 28 / 60], feed_kg_min=feed)
            np.testing.assert_allclose(soon[5], 1000.0, atol=2.0)
            assert solve(model, start, np.array([6.4e5]), [28 / 60], feed_kg_min=feed)[5, 0] < 860.0
        np.testing.assert_allclose(model.derivative(start[:, None], inputs)[[3, 4]], 0.0, atol=1e-12)
        end = solve(model, start, inputs[:, 0], [1000.0], "LSODA")
        assert end[5, 0] == pytest.approx(1000.0, abs=10.0)
        np.testing.assert_allclose(model.derivative(end, inputs), 0.0, atol=1e-3)
        assert model.outflow(end, inputs)[0] == pytest.approx(model.flows(end).flue)

    def test_digester_conserves_what_it_digests(self) -> None:
        """In the reactions alone, S1 + k1·X1 and S2 − k2·X1 + k3·X2 do not change; no dilution, no alkalinity lost."""
        digester = Digester()
        state = uniform(*LIVING, 50)
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
        assert np.isfinite(pressure)
        phi = free + 16.0 + 453.0 / 19.8 * digester.growth(state)[1][0]
        if phi > 1.0:  # below, the two roots are of either sign and the expression has lost its meaning
            residual = 16.0 * pressure**2 - phi * pressure + free
            assert abs(residual) <= 1e-9 * (1.0 + phi**2)

    def test_one_dilution_for_all_is_the_sound_form(self) -> None:
        """Six equal dilutions and no misprint: the published form is the sound one."""
        state, inputs = uniform(*LIVING, 8), uniform([0.3], [0.7], 8)
        published = DigesterPublished(misprint=False).derivative(state, np.repeat(inputs, 6, axis=0))
        np.testing.assert_allclose(published, Digester().derivative(state, inputs), rtol=1e-12, atol=1e-9)
