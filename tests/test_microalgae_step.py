"""The microalgae's own time step: positive, conservative, second order, and right where the nutrient is stiff."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import cast

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from paper_classes import PAPER
from scipy.integrate import solve_ivp

from cirl_marl.compartments import microalgae
from cirl_marl.compartments.microalgae import draw_down
from cirl_marl.compartments.microalgae_droop import MicroalgaeDroop
from cirl_marl.compartments.microalgae_monod import MicroalgaeMonod
from cirl_marl.network.rowsum import Floats

Model = MicroalgaeMonod | MicroalgaeDroop

MODELS: list[Model] = [
    MicroalgaeMonod(),
    MicroalgaeMonod(form="published"),
    MicroalgaeDroop(),
    MicroalgaeDroop(form="published"),
]
JUMPING_LIGHT = [0.0, 150.0, 80.0, 0.0, 3.0, 150.0, 10.0, 0.0, 600.0, 75.0]
FEED, DILUTION = 100.0, 0.45
KINETICS = {"span": 0.006, "dilution": DILUTION, "feed": FEED, "half_saturation": 0.0012}

every_model = pytest.mark.parametrize("model", MODELS, ids=lambda model: f"{model.kind}-{model.form}")


def column(model: Model, biomass: float, surplus: float, outside: float) -> Floats:
    """Return a state (k, 1); ``surplus`` is Q − k_q."""
    if isinstance(model, MicroalgaeMonod):
        return np.array([[biomass], [outside]])
    return np.array([[biomass], [model.minimal_quota_umol_um3 + surplus], [outside]])


def total(model: Model, state: Floats) -> Floats:
    """Return N, nutrient outside and inside the cells, shape (B,)."""
    if isinstance(model, MicroalgaeMonod):
        return cast(Floats, state[1] + state[0] / model.biovolume_yield)
    return cast(Floats, state[2] + state[0] * state[1])


def exact(model: Model, state: Floats, light: float, interval: float) -> tuple[Floats, float]:
    """Return the state (k, 1) and the mean outflow by scipy's Radau; the outflow is integrated along."""
    inputs = np.array([[light]])

    def rate(_: float, z: Floats) -> Floats:
        return np.append(model.derivative(z[:-1, None], inputs)[:, 0], model.outflow(z[:-1, None], inputs))

    done = solve_ivp(rate, (0.0, interval), np.append(state[:, 0], 0.0), method="Radau", rtol=1e-10, atol=1e-14)
    assert done.success
    return done.y[:-1, -1:], done.y[-1, -1] / interval


@st.composite
def situations(draw: st.DrawFn) -> tuple[Model, Floats, Floats, float]:
    """Draw a model, a state, a light up to ten times the published, and an interval of 10⁻⁶ to 5 days."""

    def spread(low: float, high: float) -> float:
        return draw(st.just(0.0) | st.floats(low, high).map(lambda exponent: float(10.0**exponent)))

    model = draw(st.sampled_from(MODELS))
    surplus = draw(st.floats(-9.0, 2.0).map(lambda exponent: float(10.0**exponent)))
    state = column(model, spread(-15.0, 4.0), surplus, spread(-15.0, 4.0))
    interval = 10.0 ** draw(st.floats(-6.0, np.log10(5.0)))
    return model, state, np.array([[draw(st.floats(0.0, 1500.0))]]), interval


class TestAnyStep:
    """What holds for whatever state, light and interval."""

    @given(situations())
    def test_positive(self, situation: tuple[Model, Floats, Floats, float]) -> None:
        """S > 0 (it is fed), X > 0 unless there was none, Q > k_q, uptake ≥ 0."""
        model, state, inputs, interval = situation
        after, outflow = model.integrate(state, inputs, interval)
        assert after[-1, 0] > 0.0
        assert after[0, 0] > 0.0 if state[0, 0] > 0.0 else after[0, 0] == 0.0
        if isinstance(model, MicroalgaeDroop):
            assert after[1, 0] > model.minimal_quota_umol_um3
        assert np.isfinite(after).all()
        assert outflow[0] >= 0.0
        assert (outflow[0] > 0.0) == (model.outflow(after, inputs)[0] > 0.0)

    @pytest.mark.medium
    @given(situations())
    def test_nutrient_is_conserved(self, situation: tuple[Model, Floats, Floats, float]) -> None:
        """N tends to the feed's like a tracer, N = S_in + (N₀ − S_in)e^(−Dt), to round-off."""
        model, state, inputs, interval = situation
        after, _ = model.integrate(state, inputs, interval)
        before = total(model, state)[0]
        expected = FEED + (before - FEED) * np.exp(-DILUTION * interval)
        if before < FEED:  # without the difference of two nearly equal numbers
            expected = before * np.exp(-DILUTION * interval) - FEED * np.expm1(-DILUTION * interval)
        assert total(model, after)[0] == pytest.approx(expected, rel=1e-12)

    @every_model
    @pytest.mark.parametrize("size", [2, 7, 64, 1001])
    def test_batched_equals_alone(self, model: Model, size: int) -> None:
        """A column's bits do not depend on the batch it is in."""
        rng = np.random.default_rng(3)
        rows = [10.0 ** rng.uniform(-3, 2, size), 1.7 + 10.0 ** rng.uniform(-3, 1, size)]
        state = np.stack([*rows[: len(model.state_names) - 1], 10.0 ** rng.uniform(-5, 2, size)])
        inputs = rng.uniform(0.0, 150.0, (1, size))
        kept = state.copy(), inputs.copy()
        after, outflow = model.integrate(state, inputs, 0.02)
        assert after.shape == state.shape
        assert outflow.shape == (size,)
        for b in range(0, size, max(1, size // 50)):
            own, own_outflow = model.integrate(state[:, b : b + 1].copy(), inputs[:, b : b + 1].copy(), 0.02)
            np.testing.assert_array_equal(own, after[:, b : b + 1])
            np.testing.assert_array_equal(own_outflow, outflow[b : b + 1])
        np.testing.assert_array_equal(state, kept[0])
        np.testing.assert_array_equal(inputs, kept[1])


class TestAccuracy:
    """Against scipy's Radau at a tolerance of 1e-10."""

    @every_model
    @pytest.mark.parametrize("interval", [0.0125, 0.25])
    @pytest.mark.medium
    @pytest.mark.sample(1)
    def test_jumping_light(self, model: Model, interval: float) -> None:
        """X and Q to 1e-5 and the mean uptake to 1e-4, in every interval, from a start without nutrient."""
        reference = column(model, 26.0, 1.12, 0.0)
        state = reference
        for light in JUMPING_LIGHT:
            reference, uptake = exact(model, reference, light, interval)
            state, outflow = model.integrate(state, np.array([[light]]), interval)
            np.testing.assert_allclose(state[:-1], reference[:-1], rtol=1e-5)
            np.testing.assert_allclose(state[-1], reference[-1], rtol=1e-2)
            assert outflow[0] == pytest.approx(uptake, rel=1e-4)

    @every_model
    @pytest.mark.parametrize("start", [(26.0, 1.0, 1e-3), (0.5, 1.0, 3.0), (1e-3, 0.2, 1e-3)])
    @pytest.mark.sample(4)
    def test_second_order(
        self, model: Model, start: tuple[float, float, float], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """Halving the substep quarters the errors of X and of the uptake, stiff or not."""
        state, light, interval = column(model, *start), 40.0, 0.5
        reference, uptake = exact(model, state, light, interval)
        rate, steps, errors = model.growth_per_day + model.dilution_per_day, [8, 16, 32], []
        for count in steps:
            monkeypatch.setattr(microalgae, "SUBSTEP", interval * rate / (count - 0.5))
            assert microalgae.substeps(interval, rate) == count
            after, outflow = model.integrate(state, np.array([[light]]), interval)
            errors.append([abs(after[0, 0] / reference[0, 0] - 1.0), abs(outflow[0] / uptake - 1.0)])
        slopes = np.polyfit(np.log(steps), np.log(errors), 1)[0]
        # below 2e-8 what is left is the lag of S behind its quasi-steady value, which no slow step resolves
        assert ((slopes <= -1.9) | (np.array(errors[-1]) < 2e-8)).all(), (slopes, errors)

    @every_model
    @pytest.mark.parametrize("interval", [0.0125, 0.25, 5.0])
    @pytest.mark.parametrize("outside", [0.0, 2.0])
    def test_stiff_nutrient_settles(self, model: Model, interval: float, outside: float) -> None:
        """Hundreds of time constants later S is where supply and uptake balance."""
        state, inputs = column(model, 60.0, 1.0, outside), np.array([[30.0]])
        after, _ = model.integrate(state, inputs, interval + 0.1)
        assert abs(model.derivative(after, inputs)[-1, 0]) < 1e-4 * DILUTION * FEED
        again, _ = model.integrate(after, inputs, 1e-6)
        assert again[-1, 0] == pytest.approx(after[-1, 0], rel=1e-3)

    @pytest.mark.parametrize("model", [MicroalgaeMonod(), MicroalgaeDroop()], ids=lambda model: model.kind)
    def test_uptake_and_state_agree(self, model: Model) -> None:
        """∫ρX = ∫D(S_in − S) − (S⁺ − S): without dilution, what S lost to round-off."""
        inputs, state, interval = np.array([[60.0]]), column(model, 20.0, 1.0, 4.0), 0.02
        after, outflow = replace(model, dilution_per_day=0.0).integrate(state, inputs, interval)
        taken = 1000.0 * interval * outflow[0] / model.co2_per_nutrient
        assert taken == pytest.approx(state[-1, 0] - after[-1, 0], rel=1e-12)
        after, outflow = model.integrate(state, inputs, interval)
        taken = 1000.0 * interval * outflow[0] / model.co2_per_nutrient
        nodes, weights = np.polynomial.legendre.leggauss(24)
        passed = [model.integrate(state, inputs, interval / 2.0 * (1.0 + node))[0][-1, 0] for node in nodes]
        supplied = DILUTION * interval * (FEED - weights @ np.array(passed) / 2.0)
        assert taken == pytest.approx(supplied - (after[-1, 0] - state[-1, 0]), rel=1e-6)

    def test_published_uptake_and_state_agree(self) -> None:
        """Monod's biomass has no other source: ∫Yρ = ln(X⁺/X) + D·interval, to second order."""
        model, state = MicroalgaeMonod(form="published"), np.array([[20.0], [4.0]])
        after, outflow = model.integrate(state, np.array([[60.0]]), 0.25)
        grown = np.log(after[0, 0] / state[0, 0]) + DILUTION * 0.25
        taken = 0.25 * outflow[0] / model.co2_per_nutrient
        assert model.biovolume_yield * taken == pytest.approx(grown, rel=1e-5)

    @every_model
    def test_vanishing_culture(self, model: Model) -> None:
        """Where the uptake is below the round-off of S the culture still grows, at the rate of a larger one."""
        biomass = 10.0 ** np.arange(-40.0, -5.0)
        for outside in (1e-4, 0.01, 50.0):
            state = np.concatenate([column(model, size, 1.0, outside) for size in biomass], axis=1)
            after, outflow = model.integrate(state, np.full((1, len(biomass)), 60.0), 0.0125)
            np.testing.assert_allclose(after[0] / biomass, after[0, -1] / biomass[-1], rtol=1e-3)
            assert (after[:-1] > 0.0).all()
            size = biomass if model.form == "sound" else np.ones_like(biomass)
            np.testing.assert_allclose(outflow / size, outflow[-1] / size[-1], rtol=1e-3)

    def test_nothing_there(self) -> None:
        """Without cells S is diluted like a tracer; without feed or nutrient nothing is taken up; no warning."""
        for model in MODELS:
            state, inputs = column(model, 0.0, 1.0, 3.0), np.array([[60.0]])
            after, _ = model.integrate(state, inputs, 0.3)
            assert after[0, 0] == 0.0
            assert after[-1, 0] == pytest.approx(FEED - 97.0 * np.exp(-DILUTION * 0.3), rel=1e-13)
            starved = replace(model, nutrient_in_umol_l=0.0)
            after, outflow = starved.integrate(column(model, 5.0, 1.0, 0.0), inputs, 0.3)
            assert (after[-1, 0], outflow[0]) == (0.0, 0.0)
            batch = replace(model, dilution_per_day=0.0)
            after, outflow = batch.integrate(state, inputs, 0.3)
            np.testing.assert_allclose(after[[0, -1]], state[[0, -1]], rtol=1e-15)
        dark = MicroalgaeMonod().integrate(np.array([[26.0], [1.0]]), np.zeros((1, 1)), 0.3)
        assert dark[0][0, 0] == pytest.approx(26.0 * np.exp(-DILUTION * 0.3), rel=1e-13)
        assert dark[1][0] == 0.0


class TestDrawDown:
    """The exact flow of S under a constant demand."""

    @pytest.mark.parametrize("outside", [0.0, 1e-4, 0.3, 50.0])
    @pytest.mark.parametrize("demand", [1e-3, 20.0, 45.0, 45.01, 60.0, 3000.0])
    @pytest.mark.sample(8)
    def test_against_scipy(self, outside: float, demand: float) -> None:
        """S, ∫s dt and ∫e^(−D(t−τ)) s dτ, for demands below, at and above the supply of 45."""
        k = KINETICS["half_saturation"]

        def rate(_: float, z: Floats) -> list[float]:
            share = z[0] / (z[0] + k)
            return [DILUTION * (FEED - z[0]) - demand * share, share, share - DILUTION * z[2]]

        done = solve_ivp(rate, (0.0, 0.006), [outside, 0.0, 0.0], method="Radau", rtol=1e-11, atol=1e-15)
        drawn = draw_down(np.array([outside]), np.array([demand]), **KINETICS)
        np.testing.assert_allclose([part[0] for part in drawn], done.y[:, -1], rtol=1e-7)

    def test_newton_has_converged(self, monkeypatch: pytest.MonkeyPatch) -> None:
        """Twice the iterations change nothing, for S, q and t over many decades and where q meets the supply."""
        rng = np.random.default_rng(1)
        size = 20_000
        outside, demand = 10.0 ** rng.uniform(-9, 4, size), 10.0 ** rng.uniform(-9, 6, size)
        outside[:100] = 0.0
        demand[50:5000] = FEED * DILUTION * (1.0 + rng.choice([-1.0, 1.0], 4950) * 10.0 ** rng.uniform(-8, -1, 4950))
        for half_saturation in (0.0012, 0.1):
            for span in (1e-6, 1e-4, 0.004, 0.02, 1.0):
                flow = partial(draw_down, span=span, dilution=DILUTION, feed=FEED, half_saturation=half_saturation)
                found = flow(outside, demand)
                with monkeypatch.context() as patched:
                    patched.setattr(microalgae, "NEWTON_STEPS", 2 * microalgae.NEWTON_STEPS)
                    settled = flow(outside, demand)
                np.testing.assert_allclose(found.nutrient, settled.nutrient, rtol=1e-10)
                np.testing.assert_allclose(found.saturation, settled.saturation, rtol=0.0, atol=1e-11 * span)
                untouched = outside * np.exp(-DILUTION * span) - FEED * np.expm1(-DILUTION * span)
                np.testing.assert_allclose(found.nutrient + demand * found.share_retained, untouched, rtol=1e-13)

    def test_long_span_is_quasi_steady(self) -> None:
        """S tends to r₁, the positive root of DS² + (DK + q − DS_in)S − D·S_in·K."""
        demand = np.array([0.0, 10.0, 44.9, 60.0, 5000.0])
        drawn = draw_down(np.full(5, 7.0), demand, **{**KINETICS, "span": 200.0})
        s, k = drawn.nutrient, KINETICS["half_saturation"]
        np.testing.assert_allclose(demand * s / (s + k), DILUTION * (FEED - s), rtol=1e-9, atol=1e-12 * FEED)


@pytest.mark.parametrize(("action", "figure"), [(-1.0, 143.8), (0.0, 114.7), (1.0, 95.4)])
def test_start_that_the_returns_of_the_paper_need(action: float, figure: float) -> None:
    """Darkness, I = 75 and I = 150 from S in the inferred range; from S = 0 even darkness returns 103.4."""
    model = MicroalgaeMonod(form="published")
    paper = PAPER["microalgae_monod"]
    inputs = paper.inputs(np.full((1, 3), action))
    low, high = paper.inferred_initial[1]
    state = np.array([[26.0] * 3, [low, high, 0.0]])
    returns = np.zeros(3)
    for _ in range(paper.horizon):
        state = state + paper.dt * model.derivative(state, inputs)
        returns += model.reward(state, inputs)
    assert (low, high) == (1.0, 5.0)
    assert returns[0] == pytest.approx(figure, abs=0.06)
    assert returns[0] < returns[1] < returns[0] + 0.2
    assert returns[2] < 103.5
