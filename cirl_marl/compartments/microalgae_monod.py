"""Microalgae whose growth follows the nutrient outside the cell, after Monod."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from cirl_marl.compartments.microalgae import Microalgae
from cirl_marl.network.compartment_model import Form, RewardState
from cirl_marl.network.declarations import NotNegative, Positive, frozen_record
from cirl_marl.network.rowsum import Floats

# The registered environment: one step is 5·10⁻⁵ d. S(0) ~ U[1, 5] µmol/L is inferred: from S = 0 constant darkness
# returns 103.4, while the paper reports up to 143.1. At S = 1 darkness returns 143.8, I = 75 114.7 and I = 150 95.3,
# more S at most 0.2 more: the paper's best end, its untrained policies, its DDPG stuck at full light.


@frozen_record
class MicroalgaeMonod(Microalgae):
    """Chemostat with biomass X and dissolved nutrient S; the control is the light I.

    μ = μ_max·f(I)·S/(S + K_S), ρ = μ/Y, Ẋ = (μ − D)X, Ṡ = D(S_in − S) − ρX; both forms.
    Nutrient is conserved: d(S + X/Y)/dt = D(S_in − S − X/Y).

    ``published``: K_sI = 0, so f falls with the light and is 0/0 in darkness (here its limit 1); the reward is K_CO2·ρ,
    an uptake per biovolume. ``sound``: Haldane light response with K_sI > 0 and its optimum at √(K_sI K_iI) = 77; the
    reward is the uptake of the culture, K_CO2·ρ·X. The reward takes I of the step and S after it.

    Source: published code of arXiv 2505.21536 and 2502.02382 (equations, parameters, bounds, start, reward); the
    reference trajectory is reproduced to 4·10⁻¹², from its second row to 10⁻¹⁵. Constant light from (26, 0), 200 steps:
    103.446 (I = 0), 101.638 (75), 90.823 (150).
    """

    kind: ClassVar[str] = "microalgae_monod"
    state_names: ClassVar[tuple[str, ...]] = ("biomass_um3_l", "nutrient_umol_l")
    reward_state: ClassVar[RewardState] = "after"

    form: Form = "sound"
    growth_per_day: Annotated[float, Positive("μ_max [published]")] = 1.2
    light_half_saturation: Annotated[
        float, Positive("K_sI of the sound form, µmol/(m² s); the published is 0 [chosen: I* within bounds]")
    ] = 20.0
    light_inhibition: Annotated[float, Positive("K_iI, µmol/(m² s) [published]")] = 295.0
    nutrient_half_saturation_umol_l: Annotated[float, Positive("K_S [published]")] = 0.0012
    biovolume_yield: Annotated[float, Positive("Y, biovolume per µmol [published]")] = 0.5
    dilution_per_day: Annotated[float, NotNegative("D = 1/T_h [published]")] = 0.45
    nutrient_in_umol_l: Annotated[float, NotNegative("S_in [published]")] = 100.0
    co2_per_nutrient: Annotated[float, NotNegative('K_CO2, CO₂ taken up per nutrient [published: "freely chosen"]')] = (
        0.3
    )

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

    def integrate(self, state: Floats, inputs: Floats, interval: float) -> tuple[Floats, Floats]:
        """Return the state after an interval of constant light, (2, B), and the mean ``outflow`` over it, (B,).

        S relaxes within seconds, X within hours. So a substep h is two halves, in each of which X is frozen in the
        demand q = μ_max f X/Y only and S is solved exactly (``draw_down``). In the first half X is that at the start;
        in the second that at the end, foretold by repeating the uptake of the first: the trapezoidal rule in X,
        second order. With E = e^(−Dh/2) and U what was taken up and not washed out,

            S ← S_in + (S − S_in)E − U,   X ← X E + Y U.

        Hence N = S + X/Y is S_in + (N₀ − S_in)e^(−D·interval) to round-off, S and X stay positive for any step, and S
        ends at its quasi-steady value. The mean is that of ρX (sound) or ρ (published) along the exact S. All this
        holds for X, S, I ≥ 0.
        """
        biomass, nutrient = state
        steps, _, retention, draw = self._halves(interval)
        most = self.growth_per_day * self.light(inputs) / self.biovolume_yield  # ρ at saturation
        uptake = np.zeros_like(biomass)
        for _ in range(steps):
            early_demand = most * biomass
            early = draw(nutrient, early_demand)
            growth = self.biovolume_yield * early_demand * early.share_retained
            biomass = biomass * retention + growth

            late_demand = most * (biomass * retention + growth)
            late = draw(early.nutrient, late_demand)
            biomass = biomass * retention + self.biovolume_yield * late_demand * late.share_retained
            nutrient = late.nutrient
            uptake += self._uptake_from_states(most, (early_demand, early), (late_demand, late))
        return np.stack([biomass, nutrient]), self.co2_per_nutrient / interval * uptake
