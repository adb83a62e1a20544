"""Microalgae whose growth follows the nutrient stored in the cell, after Droop."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from cirl_marl.compartments.light import light_response
from cirl_marl.compartments.model import PaperScenario, RewardState, check_form, check_not_negative, check_positive
from cirl_marl.rowsum import Floats

PAPER = PaperScenario(
    initial_state=(26.0, 2.82, 0.0),
    input_low=(0.0,),
    input_high=(150.0,),
    horizon=200,
    inferred_initial=((26.0, 26.0), (2.82, 2.82), (0.0, 5.0)),
    # S: solves S + dt(45 − 0.45 S − 26·9.4·S/(S + 0.1)) = float32(0.00225), the published S after one step
    reference_start=(26.0, float(np.float32(2.82)), -1.1034407672264982e-10),
)
"""CO2MicroalgaeDroop: one step is 5·10⁻⁵ d. S(0) ~ U[0, 5] µmol/L is inferred (mean return 454; the paper's end at 446
to 473). The light changes the return by no more than 0.1 %."""


@dataclass(frozen=True, slots=True, kw_only=True)
class MicroalgaeDroop:
    """Chemostat with biomass X, cell quota Q and dissolved nutrient S; the control is the light I.

    μ = μ̃·f(I)·(1 − k_q/Q), ρ = ρ_max·S/(S + K_S), Ẋ = (μ − D)X, Q̇ = ρ − μQ, Ṡ = D(S_in − S) − ρX; both forms.
    Nutrient is conserved: d(S + XQ)/dt = D(S_in − S − XQ).

    ``published``: K_sI = 0 and reward K_CO2·ρ per biovolume; ``sound``: K_sI > 0 and reward K_CO2·ρ·X. See
    ``MicroalgaeMonod``. The reward takes S *before* the step, unlike Monod's.

    Source: published code of arXiv 2505.21536 (equations, parameters, bounds, start, reward); the reference trajectory
    is reproduced to the last digit from its second row on. Its first step is rounded to float32.

    Attributes:
        form: ``published`` or ``sound``.
        growth_per_day: μ̃, growth at full light and unlimited quota. [published]
        minimal_quota_umol_um3: k_q. [published]
        light_half_saturation: K_sI of the sound form, µmol/(m² s); the published is 0. [chosen]
        light_inhibition: K_iI, µmol/(m² s). [published]
        uptake_umol_um3_day: ρ_max. [published]
        nutrient_half_saturation_umol_l: K_S. [published]
        dilution_per_day: D = 1/T_h. [published]
        nutrient_in_umol_l: S_in. [published]
        co2_per_nutrient: K_CO2. [published: "freely chosen"]
    """

    kind: ClassVar[str] = "microalgae_droop"
    state_names: ClassVar[tuple[str, ...]] = ("biomass_um3_l", "quota_umol_um3", "nutrient_umol_l")
    input_names: ClassVar[tuple[str, ...]] = ("light_umol_m2_s",)
    time_unit: ClassVar[str] = "day"
    reward_state: ClassVar[RewardState] = "before"
    paper: ClassVar[PaperScenario] = PAPER

    form: Literal["published", "sound"] = "sound"
    growth_per_day: float = 1.7
    minimal_quota_umol_um3: float = 1.7
    light_half_saturation: float = 20.0
    light_inhibition: float = 295.0
    uptake_umol_um3_day: float = 9.4
    nutrient_half_saturation_umol_l: float = 0.1
    dilution_per_day: float = 0.45
    nutrient_in_umol_l: float = 100.0
    co2_per_nutrient: float = 0.3

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        check_form(self.form, ("published", "sound"))
        check_positive(
            self.kind,
            growth_per_day=self.growth_per_day,
            minimal_quota_umol_um3=self.minimal_quota_umol_um3,
            light_half_saturation=self.light_half_saturation,
            light_inhibition=self.light_inhibition,
            uptake_umol_um3_day=self.uptake_umol_um3_day,
            nutrient_half_saturation_umol_l=self.nutrient_half_saturation_umol_l,
        )
        check_not_negative(
            self.kind,
            dilution_per_day=self.dilution_per_day,
            nutrient_in_umol_l=self.nutrient_in_umol_l,
            co2_per_nutrient=self.co2_per_nutrient,
        )

    def uptake(self, state: Floats) -> Floats:
        """Return ρ, nutrient taken up per biovolume and day, shape (B,)."""
        rho: Floats = self.uptake_umol_um3_day * (state[2] / (state[2] + self.nutrient_half_saturation_umol_l))
        return rho

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return (Ẋ, Q̇, Ṡ) per day, shape (3, B)."""
        biomass, quota, nutrient = state
        half_saturation = 0.0 if self.form == "published" else self.light_half_saturation
        light = light_response(inputs[0], half_saturation=half_saturation, inhibition=self.light_inhibition)
        growth = self.growth_per_day * light * (1.0 - self.minimal_quota_umol_um3 / quota)
        rho = self.uptake(state)
        supply = self.dilution_per_day * (self.nutrient_in_umol_l - nutrient)
        return np.stack(
            [growth * biomass - self.dilution_per_day * biomass, rho - growth * quota, supply - rho * biomass]
        )

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return K_CO2·ρ (published) or K_CO2·ρ·X in µmol/(L d) (sound), shape (B,)."""
        per_biovolume = self.co2_per_nutrient * self.uptake(state)
        return per_biovolume if self.form == "published" else per_biovolume * state[0]

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return the CO₂ that the culture takes *in* per litre, ṁ23 in mmol/(L d), shape (B,); see Monod."""
        taken = self.reward(state, inputs)
        return taken if self.form == "published" else taken / 1000.0
