"""Microalgae whose growth follows the nutrient outside the cell, after Monod."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial
from typing import ClassVar, Literal

import numpy as np

from cirl_marl.compartments.light import light_response
from cirl_marl.compartments.nutrient import draw_down, substeps
from cirl_marl.compartments.parameters import check_form, check_not_negative, check_positive
from cirl_marl.network.model import ContinuousModel, OwnStepModel, RewardState
from cirl_marl.network.rowsum import Floats

# The registered environment: one step is 5·10⁻⁵ d. S(0) ~ U[1, 5] µmol/L is inferred: from S = 0 constant darkness
# returns 103.4, while the paper reports up to 143.1. At S = 1 darkness returns 143.8, I = 75 114.7 and I = 150 95.3,
# more S at most 0.2 more: the paper's best end, its untrained policies, its DDPG stuck at full light.


@dataclass(frozen=True, slots=True, kw_only=True)
class MicroalgaeMonod(ContinuousModel, OwnStepModel):
    """Chemostat with biomass X and dissolved nutrient S; the control is the light I.

    μ = μ_max·f(I)·S/(S + K_S), ρ = μ/Y, Ẋ = (μ − D)X, Ṡ = D(S_in − S) − ρX; both forms.
    Nutrient is conserved: d(S + X/Y)/dt = D(S_in − S − X/Y).

    ``published``: K_sI = 0, so f falls with the light and is 0/0 in darkness (here its limit 1); the reward is K_CO2·ρ,
    an uptake per biovolume. ``sound``: Haldane light response with K_sI > 0 and its optimum at √(K_sI K_iI) = 77; the
    reward is the uptake of the culture, K_CO2·ρ·X. The reward takes I of the step and S after it.

    Source: published code of arXiv 2505.21536 and 2502.02382 (equations, parameters, bounds, start, reward); the
    reference trajectory is reproduced to 4·10⁻¹², from its second row to 10⁻¹⁵. Constant light from (26, 0), 200 steps:
    103.446 (I = 0), 101.638 (75), 90.823 (150).

    Attributes:
        form: ``published`` or ``sound``.
        growth_per_day: μ_max. [published]
        light_half_saturation: K_sI of the sound form, µmol/(m² s); the published is 0. [chosen: I* within bounds]
        light_inhibition: K_iI, µmol/(m² s). [published]
        nutrient_half_saturation_umol_l: K_S. [published]
        biovolume_yield: Y, biovolume per µmol. [published]
        dilution_per_day: D = 1/T_h. [published]
        nutrient_in_umol_l: S_in. [published]
        co2_per_nutrient: K_CO2, CO₂ taken up per nutrient. [published: "freely chosen"]
    """

    kind: ClassVar[str] = "microalgae_monod"
    state_names: ClassVar[tuple[str, ...]] = ("biomass_um3_l", "nutrient_umol_l")
    input_names: ClassVar[tuple[str, ...]] = ("light_umol_m2_s",)
    input_unit: ClassVar[str] = "umol/m**2/s"
    time_unit: ClassVar[str] = "day"
    reward_state: ClassVar[RewardState] = "after"

    form: Literal["published", "sound"] = "sound"
    growth_per_day: float = 1.2
    light_half_saturation: float = 20.0
    light_inhibition: float = 295.0
    nutrient_half_saturation_umol_l: float = 0.0012
    biovolume_yield: float = 0.5
    dilution_per_day: float = 0.45
    nutrient_in_umol_l: float = 100.0
    co2_per_nutrient: float = 0.3

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Nothing is negative; the published form has no bounds."""
        names = () if self.form == "published" else (*self.state_names, *self.input_names)
        return dict.fromkeys(names, (0.0, math.inf))

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        check_form(self.form, ("published", "sound"))
        check_positive(
            self.kind,
            growth_per_day=self.growth_per_day,
            light_half_saturation=self.light_half_saturation,
            light_inhibition=self.light_inhibition,
            nutrient_half_saturation_umol_l=self.nutrient_half_saturation_umol_l,
            biovolume_yield=self.biovolume_yield,
        )
        check_not_negative(
            self.kind,
            dilution_per_day=self.dilution_per_day,
            nutrient_in_umol_l=self.nutrient_in_umol_l,
            co2_per_nutrient=self.co2_per_nutrient,
        )

    def light(self, inputs: Floats) -> Floats:
        """Return f(I), shape (B,)."""
        half_saturation = 0.0 if self.form == "published" else self.light_half_saturation
        return light_response(inputs[0], half_saturation=half_saturation, inhibition=self.light_inhibition)

    def uptake(self, state: Floats, inputs: Floats) -> Floats:
        """Return ρ, nutrient taken up per biovolume and day, shape (B,)."""
        nutrient = state[1] / (state[1] + self.nutrient_half_saturation_umol_l)
        rho: Floats = self.growth_per_day * self.light(inputs) * nutrient / self.biovolume_yield
        return rho

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return (Ẋ, Ṡ) per day, shape (2, B)."""
        biomass, nutrient = state
        rho = self.uptake(state, inputs)
        growth = self.biovolume_yield * rho * biomass - self.dilution_per_day * biomass
        supply = self.dilution_per_day * (self.nutrient_in_umol_l - nutrient)
        return np.stack([growth, supply - rho * biomass])

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return K_CO2·ρ (published) or K_CO2·ρ·X in µmol/(L d) (sound), shape (B,)."""
        per_biovolume = self.co2_per_nutrient * self.uptake(state, inputs)
        return per_biovolume if self.form == "published" else per_biovolume * state[0]

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return the CO₂ that the culture takes *in* per litre, ṁ23 in mmol/(L d), shape (B,).

        ``published`` returns K_CO2·ρ: arXiv 2502.02382 equates µmol/(µm³ d) with mmol/(L d). ``sound`` returns
        K_CO2·ρ·X/1000.
        """
        taken = self.reward(state, inputs)
        return taken if self.form == "published" else taken / 1000.0

    def integrate(self, state: Floats, inputs: Floats, interval: float) -> tuple[Floats, Floats]:
        """Return the state after an interval of constant light, (2, B), and the mean ``outflow`` over it, (B,).

        S relaxes within seconds, X within hours. So a substep h is two halves, in each of which X is frozen in the
        demand q = μ_max f X/Y only and S is solved exactly (``draw_down``). In the first half X is that at the start;
        in the second that at the end, foretold by repeating the uptake of the first: the trapezoidal rule in X,
        second order. With E = e^(−Dh/2) and U what was taken up and not washed out,

            S ← S_in + (S − S_in)E − U,   X ← X E + Y U.

        Hence N = S + X/Y is S_in + (N₀ − S_in)e^(−D·interval) to round-off, S and X stay positive for any step, and S
        ends at its quasi-steady value. The mean is that of ρX (sound) or ρ (published) along the exact S.

        Args:
            state: X, S ≥ 0, shape (2, B).
            inputs: I ≥ 0, shape (1, B).
            interval: days, > 0.
        """
        biomass, nutrient = state
        steps = substeps(interval, self.growth_per_day + self.dilution_per_day)
        half = interval / steps / 2.0
        kept = math.exp(-self.dilution_per_day * half)
        most = self.growth_per_day * self.light(inputs) / self.biovolume_yield  # ρ at saturation
        draw = partial(
            draw_down,
            span=half,
            dilution=self.dilution_per_day,
            feed=self.nutrient_in_umol_l,
            half_saturation=self.nutrient_half_saturation_umol_l,
        )
        uptake = np.zeros_like(biomass)
        for _ in range(steps):
            early_demand = most * biomass
            early = draw(nutrient, early_demand)
            grown = self.biovolume_yield * early_demand * early.retained
            biomass = biomass * kept + grown

            late_demand = most * (biomass * kept + grown)
            late = draw(early.nutrient, late_demand)
            biomass = biomass * kept + self.biovolume_yield * late_demand * late.retained
            nutrient = late.nutrient
            if self.form == "published":
                uptake += most * (early.saturation + late.saturation)
            else:
                uptake += (early_demand * early.saturation + late_demand * late.saturation) / 1000.0
        return np.stack([biomass, nutrient]), self.co2_per_nutrient / interval * uptake
