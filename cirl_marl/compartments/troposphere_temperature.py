"""The mean temperature of the troposphere over the city of carbo_net."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from cirl_marl.network.compartment_model import ContinuousModel, RewardState
from cirl_marl.network.declarations import NotNegative, Positive, Share, frozen_record
from cirl_marl.network.rowsum import Floats

SECONDS_PER_DAY = 86400.0


@frozen_record
class TroposphereTemperature(ContinuousModel):
    """Radiation balance C·Ṫ = S(1 − α) − ε·σ·T⁴ with the emissivity ε = ε_n − η·x₁/V₁ of air that holds x₁ of CO₂.

    The steady state is T = (S(1 − α)/(εσ))^¼: 13.454 °C at the pre-industrial x₁ = 637.2 t (closed loop) and 35.38 °C
    at x₁ = 1432.1 t, which the uncontrolled network tends to; the time constant is about 2785 d. There is one form: the
    published one has no defect named, but ε is linear in x₁, and below zero from 3750 t on, where it means nothing.
    No reward is published; it is −(T − T*)².

    Source: published code of arXiv 2508.16774; the model is Elsherif and Taha's, arXiv 2504.21153. T(0) = 288.33 K.
    """

    kind: ClassVar[str] = "troposphere_temperature"
    state_names: ClassVar[tuple[str, ...]] = ("temperature_k",)
    input_names: ClassVar[tuple[str, ...]] = ()
    context_names: ClassVar[tuple[str, ...]] = ("stock_kg",)
    time_unit: ClassVar[str] = "day"
    reward_state: ClassVar[RewardState] = "after"

    heat_capacity_j_m2_k: Annotated[float, Positive("C [published]")] = 8e8
    solar_w_m2: Annotated[float, Positive("S, mean over the sphere, 1361/4 W/m² [published]")] = 1361.0 / 4.0
    albedo: Annotated[float, Share("α [published]")] = 0.3
    emissivity: Annotated[float, Positive("ε_n [published]")] = 0.75
    greenhouse_m3_mg: Annotated[float, NotNegative("η [published; unit inferred]")] = 2.36e-4
    volume_km3: Annotated[float, Positive("V₁; x₁/V₁ in t/km³ is mg/m³ [published; unit inferred]")] = 1.18
    stefan_boltzmann_w_m2_k4: Annotated[float, Positive("σ [published]")] = 5.67e-8
    set_point_k: Annotated[float, Positive("T*, pre-industrial [published as T_e]")] = 287.05

    def effective_emissivity(self, co2_t: Floats) -> Floats:
        """Return ε = ε_n − η·x₁/V₁, shape as x₁."""
        return self.emissivity - self.greenhouse_m3_mg * (co2_t / self.volume_km3)

    def derivative(self, state: Floats, inputs: Floats, *, stock_kg: Floats) -> Floats:
        """Return Ṫ, K/d, shape (1, B); ``stock_kg`` is x₁, the CO₂ that the network holds there, shape (B,)."""
        co2_t = stock_kg[None] / 1000.0
        absorption = self.solar_w_m2 * (1.0 - self.albedo)
        emission = self.effective_emissivity(co2_t) * self.stefan_boltzmann_w_m2_k4 * np.square(np.square(state))
        return SECONDS_PER_DAY / self.heat_capacity_j_m2_k * (absorption - emission)

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return −(T − T*)², K², shape (B,)."""
        cost: Floats = (state[0] - self.set_point_k) ** 2
        return -cost

    def steady_state_k(self, co2_t: Floats) -> Floats:
        """Return T = (S(1 − α)/(εσ))^¼, K; NaN where ε ≤ 0."""
        emissivity = self.effective_emissivity(np.asarray(co2_t, dtype=np.float64))
        usable = np.where(emissivity > 0.0, emissivity, np.nan)
        return (self.solar_w_m2 * (1.0 - self.albedo) / (usable * self.stefan_boltzmann_w_m2_k4)) ** 0.25
