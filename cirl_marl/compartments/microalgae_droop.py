"""Microalgae whose growth follows the nutrient stored in the cell, after Droop."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

import numpy as np

from cirl_marl.compartments.microalgae import Microalgae
from cirl_marl.network.compartment_model import Form, RewardState
from cirl_marl.network.declarations import NotNegative, Positive, frozen_record
from cirl_marl.network.rowsum import Floats

# The registered environment: one step is 5·10⁻⁵ d. S(0) ~ U[0, 5] µmol/L is inferred (mean return 454; the paper's end
# at 446 to 473). The light changes the return by no more than 0.1 %.


@frozen_record
class MicroalgaeDroop(Microalgae):
    """Chemostat with biomass X, cell quota Q and dissolved nutrient S; the control is the light I.

    μ = μ̃·f(I)·(1 − k_q/Q), ρ = ρ_max·S/(S + K_S), Ẋ = (μ − D)X, Q̇ = ρ − μQ, Ṡ = D(S_in − S) − ρX; both forms.
    Nutrient is conserved: d(S + XQ)/dt = D(S_in − S − XQ).

    ``published``: K_sI = 0 and reward K_CO2·ρ per biovolume; ``sound``: K_sI > 0 and reward K_CO2·ρ·X. See
    ``MicroalgaeMonod``. The reward takes S *before* the step, unlike Monod's.

    Source: published code of arXiv 2505.21536 (equations, parameters, bounds, start, reward); the reference trajectory
    is reproduced to the last digit from its second row on. Its first step is rounded to float32.
    """

    kind: ClassVar[str] = "microalgae_droop"
    state_names: ClassVar[tuple[str, ...]] = ("biomass_um3_l", "quota_umol_um3", "nutrient_umol_l")
    reward_state: ClassVar[RewardState] = "before"

    form: Form = "sound"
    growth_per_day: Annotated[float, Positive("μ̃, growth at full light and unlimited quota [published]")] = 1.7
    minimal_quota_umol_um3: Annotated[float, Positive("k_q [published]")] = 1.7
    light_half_saturation: Annotated[
        float, Positive("K_sI of the sound form, µmol/(m² s); the published is 0 [chosen]")
    ] = 20.0
    light_inhibition: Annotated[float, Positive("K_iI, µmol/(m² s) [published]")] = 295.0
    uptake_umol_um3_day: Annotated[float, Positive("ρ_max [published]")] = 9.4
    nutrient_half_saturation_umol_l: Annotated[float, Positive("K_S [published]")] = 0.1
    dilution_per_day: Annotated[float, NotNegative("D = 1/T_h [published]")] = 0.45
    nutrient_in_umol_l: Annotated[float, NotNegative("S_in [published]")] = 100.0
    co2_per_nutrient: Annotated[float, NotNegative('K_CO2 [published: "freely chosen"]')] = 0.3

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Nothing is negative, and cells hold their minimal quota; the published form has no bounds."""
        if self.form == "published":
            return {}
        return dict.fromkeys((*self.state_names, *self.input_names), (0.0, math.inf)) | {
            "quota_umol_um3": (self.minimal_quota_umol_um3, math.inf)
        }

    def uptake(self, state: Floats, inputs: Floats) -> Floats:
        """Return ρ, nutrient taken up per biovolume and day, shape (B,)."""
        rho: Floats = self.uptake_umol_um3_day * (state[2] / (state[2] + self.nutrient_half_saturation_umol_l))
        return rho

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return (Ẋ, Q̇, Ṡ) per day, shape (3, B)."""
        biomass, quota, nutrient = state
        growth = self.growth_per_day * self.light(inputs) * (1.0 - self.minimal_quota_umol_um3 / quota)
        rho = self.uptake(state, inputs)
        supply = self.dilution_per_day * (self.nutrient_in_umol_l - nutrient)
        biovolume_growth = growth * biomass - self.dilution_per_day * biomass
        return np.stack([biovolume_growth, rho - growth * quota, supply - rho * biomass])

    def integrate(self, state: Floats, inputs: Floats, interval: float) -> tuple[Floats, Floats]:
        """Return the state after an interval of constant light, (3, B), and the mean ``outflow`` over it, (B,).

        A substep h splits what the cells do, after Strang: uptake and dilution for h/2, growth for h, uptake and
        dilution for h/2. Each is exact and positive, the whole is of second order, and as uptake comes last S ends at
        its quasi-steady value.

        Growth leaves S and XQ alone: Q ← k_q + (Q − k_q)e^(−μ̃fh), X ← X·Q_before/Q_after. Uptake for t = h/2 with
        E = e^(−Dt) leaves X ← X E. S is solved exactly (``draw_down``) for the demand q = ρ_max·X with X frozen, at the
        start of the substep in the first half and at its end in the second, which is the trapezoidal rule. Of U, what
        was taken up and not washed out,

            S ← S_in + (S − S_in)E − U,   Q ← Q + U/(X E).

        Hence N = S + XQ is S_in + (N₀ − S_in)e^(−D·interval) to round-off, and Q stays above k_q. The mean is that of
        ρX (sound) or ρ (published) along the exact S. All this holds for X ≥ 0, Q > k_q, S ≥ 0, I ≥ 0.
        """
        biomass, quota, nutrient = state
        steps, half, retention, draw = self._halves(interval)
        ungrown = np.exp(-2.0 * half * self.growth_per_day * self.light(inputs))
        least, most = self.minimal_quota_umol_um3, self.uptake_umol_um3_day
        uptake = np.zeros_like(biomass)
        for _ in range(steps):
            early_demand = most * biomass
            early = draw(nutrient, early_demand)
            quota = quota + most / retention * early.share_retained

            growth = least + (quota - least) * ungrown
            biomass, quota = biomass * (retention * retention) * (quota / growth), growth

            late_demand = most * biomass
            late = draw(early.nutrient, late_demand)
            quota, nutrient = quota + most * late.share_retained, late.nutrient
            uptake += self._uptake_from_states(most, (early_demand, early), (late_demand, late))
        return np.stack([biomass, quota, nutrient]), self.co2_per_nutrient / interval * uptake
