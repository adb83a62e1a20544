"""Anaerobic digestion in two steps, acidogenesis and methanogenesis (AM2, Bernard et al. 2001)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, ClassVar

import numpy as np

from cirl_marl.errors import CirlError
from cirl_marl.network.compartment_model import ContinuousModel, MeasuringModel, OutflowModel, RewardState
from cirl_marl.network.declarations import NotNegative, Positive, Quantity, Share, frozen_record
from cirl_marl.network.rowsum import Floats


@frozen_record
class Digester(ContinuousModel, OutflowModel, MeasuringModel):
    """AM2 with one dilution rate D, the control: the physically sound form.

    Ẋ1 = (μ1 − αD)X1, Ṡ1 = D(S1in − S1) − k1μ1X1, Ẋ2 = (μ2 − αD)X2, Ṡ2 = D(S2in − S2) + k2μ1X1 − k3μ2X2,
    Ż = D(Zin − Z), Ċ = D(Cin − C) − qC + k4μ1X1 + k5μ2X2, with
    μ1 = μ̄1·S1/(S1 + K_S1), μ2 = μ̄2·S2/(S2 + K_S2 + (S2/K_I2)²), w = C + S2 − Z (dissolved CO₂),
    φ = w + K_H P_T + (k6/kLa)μ2X2, P_C = (φ − √(φ² − 4K_H P_T w))/(2K_H), qC = kLa(w − K_H P_C).
    The root is real: φ ≥ w + K_H P_T, hence φ² ≥ 4K_H P_T w.

    At D = 0.5/d the equilibrium is X1 1.3351, S1 1.8684, X2 6.1420, S2 4.7408, Z 212.19, C 236.245; P_C = 0.3909 atm,
    qC = 446.37 and the emitted ṁ12 = f_r·qC = 66.96 mmol/(L d). No reward is published; it is −ṁ12.

    Source: published code of arXiv 2502.02382, after Bernard et al., Biotechnol. Bioeng. 75 (2001) 424, and
    Campos-Rodríguez et al., J. Process Control 76 (2019) 141. Operation is stable for 0.05 < D < 1.2 1/d.
    """

    kind: ClassVar[str] = "digester"
    state_names: ClassVar[tuple[str, ...]] = (
        "acidogens_g_l",
        "substrate_g_l",
        "methanogens_g_l",
        "fatty_acids_mmol_l",
        "alkalinity_mmol_l",
        "inorganic_carbon_mmol_l",
    )
    input_names: ClassVar[tuple[str, ...]] = ("dilution_per_day",)
    input_unit: ClassVar[str] = "1/day"
    measure_names: ClassVar[tuple[str, ...]] = ("methane_mmol_l_day",)
    time_unit: ClassVar[str] = "day"
    bounds: ClassVar[Mapping[str, tuple[float, float]]] = dict.fromkeys((*state_names, *input_names), (0.0, math.inf))
    reward_state: ClassVar[RewardState] = "before"

    growth1_per_day: Annotated[float, Positive("μ̄1 [published]")] = 1.2
    growth2_per_day: Annotated[float, Positive("μ̄2 [published]")] = 0.744
    half_saturation1_g_l: Annotated[float, Positive("K_S1 [published]")] = 7.1
    half_saturation2_mmol_l: Annotated[float, Positive("K_S2 [published]")] = 9.28
    inhibition2: Annotated[float, Positive("K_I2, √(mmol/L) [published]")] = 16.0
    suspended_share: Annotated[
        float, Quantity("α, suspended share of the biomass, which is washed out [published]", positive=True, high=1.0)
    ] = 0.5
    k1: Annotated[float, Positive("g S1 per g X1 [published]")] = 42.14
    k2: Annotated[float, Positive("mmol S2 per g X1 [published]")] = 116.5
    k3: Annotated[float, Positive("mmol S2 per g X2 [published]")] = 268.0
    k4: Annotated[float, Positive("mmol CO₂ per g X1 [published]")] = 50.6
    k5: Annotated[float, Positive("mmol CO₂ per g X2 [published]")] = 343.6
    k6: Annotated[float, Positive("mmol CH₄ per g X2 [published]")] = 453.0
    substrate_in_g_l: Annotated[float, NotNegative("S1in [published]")] = 30.0
    acids_in_mmol_l: Annotated[float, NotNegative("S2in [published]")] = 750.0
    carbon_in_mmol_l: Annotated[float, NotNegative('Cin [published: "chosen"]')] = 40.0
    acidity_constant_mol_l: Annotated[float, Positive("K_a [published]")] = 1.5e-5
    ph_in: Annotated[float, Positive("pH of the feed; Zin = K_a·S2in/(K_a + 10^−pH) = 212.188 [published]")] = 4.42
    henry_mmol_l_atm: Annotated[float, Positive("K_H [published]")] = 16.0
    pressure_atm: Annotated[float, Positive("P_T [published]")] = 1.0
    transfer_per_day: Annotated[float, Positive("kLa [published]")] = 19.8
    released_share: Annotated[
        float, Share('f_r, share of the CO₂ that reaches the atmosphere [published: "added by this paper"]')
    ] = 0.15

    @property
    def feed(self) -> Floats:
        """Concentrations in the feed, shape (6,); it carries no biomass. Zin follows from the acid's equilibrium."""
        dissociation = self.acidity_constant_mol_l / (self.acidity_constant_mol_l + 10.0**-self.ph_in)
        alkalinity = dissociation * self.acids_in_mmol_l
        return np.array([0.0, self.substrate_in_g_l, 0.0, self.acids_in_mmol_l, alkalinity, self.carbon_in_mmol_l])

    def growth(self, state: Floats) -> tuple[Floats, Floats]:
        """Return the growth of both populations, μ1X1 and μ2X2, g/(L d), each of shape (B,)."""
        x1, s1, x2, s2 = state[0], state[1], state[2], state[3]
        acidogens = self.growth1_per_day * s1 / (s1 + self.half_saturation1_g_l) * x1
        inhibition = s2 + self.half_saturation2_mmol_l + (s2 / self.inhibition2) ** 2
        return acidogens, self.growth2_per_day * s2 / inhibition * x2

    def reaction(self, state: Floats) -> Floats:
        """Return what the reactions and the gas change per day at no dilution, shape (6, B)."""
        grown1, grown2 = self.growth(state)
        acids = self.k2 * grown1 - self.k3 * grown2
        carbon = self.k4 * grown1 + self.k5 * grown2 - self.gas(state)
        return np.stack([grown1, -self.k1 * grown1, grown2, acids, np.zeros_like(grown1), carbon])

    def washout(self, state: Floats) -> Floats:
        """Return what a unit of dilution changes: −αX for the biomass, z_in − z for the rest, shape (6, B)."""
        outflow_ = self.feed[:, None] - state
        outflow_[[0, 2]] *= self.suspended_share
        return outflow_

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return dz/dt per day, shape (6, B); ``inputs`` is (D,), shape (1, B)."""
        rate: Floats = self.reaction(state) + inputs[0] * self.washout(state)
        return rate

    def partial_pressure(self, state: Floats, dissolved_mmol_l: Floats | None = None) -> Floats:
        """Return P_C, atm, shape (B,); w under the root is C + S2 − Z unless another is given, shape (B,)."""
        free = state[5] + state[3] - state[4]
        saturation = self.henry_mmol_l_atm * self.pressure_atm
        phi = free + saturation + self.k6 / self.transfer_per_day * self.growth(state)[1]
        square_root = free if dissolved_mmol_l is None else dissolved_mmol_l
        root = np.sqrt(np.maximum(phi**2 - 4.0 * saturation * square_root, 0.0))
        # (φ − √…)/(2K_H), multiplied out so that φ ≈ √… costs no digits
        pressure: Floats = 2.0 * self.pressure_atm * square_root / (phi + root)
        return pressure

    def gas(self, state: Floats) -> Floats:
        """Return qC, CO₂ that leaves the liquid, mmol/(L d), shape (B,)."""
        free = state[5] + state[3] - state[4]
        gas: Floats = self.transfer_per_day * (free - self.henry_mmol_l_atm * self.partial_pressure(state))
        return gas

    def methane(self, state: Floats) -> Floats:
        """Return k6μ2X2, CH₄ produced, mmol/(L d), shape (B,): the service of a digester."""
        return self.k6 * self.growth(state)[1]

    def measures(self, state: Floats, inputs: Floats) -> Floats:
        """Return the methane produced, shape (1, B)."""
        return self.methane(state)[None]

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return ṁ12 = f_r·qC, CO₂ emitted per litre, mmol/(L d), shape (B,)."""
        return self.released_share * self.gas(state)

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return −ṁ12, mmol/(L d), shape (B,)."""
        return -self.outflow(state, inputs)

    def equilibrium(self, dilution_per_day: float) -> Floats:
        """Return the equilibrium in which both populations live (SS6 of Campos-Rodríguez et al.), shape (6,).

        Raises:
            CirlError: if there is none; at that dilution a population is washed out.
        """
        washed_out = CirlError(
            f"digester: no equilibrium with living biomass at a dilution of {dilution_per_day!r}/day."
        )
        demand = self.suspended_share * dilution_per_day
        half = self.inhibition2**2 * (self.growth2_per_day - demand) / (2.0 * demand) if demand > 0.0 else 0.0
        square = half**2 - self.half_saturation2_mmol_l * self.inhibition2**2
        if not (0.0 < demand < self.growth1_per_day and half > 0.0 and square >= 0.0):
            raise washed_out
        s1 = demand * self.half_saturation1_g_l / (self.growth1_per_day - demand)
        # the smaller root of S2² − 2·half·S2 + K_S2·K_I2² = 0, without cancellation
        s2 = self.half_saturation2_mmol_l * self.inhibition2**2 / (half + square**0.5)
        x1 = (self.substrate_in_g_l - s1) / (self.suspended_share * self.k1)
        acids = self.k2 * demand * x1 + dilution_per_day * (self.acids_in_mmol_l - s2)
        x2 = acids / (self.k3 * demand)
        if x1 <= 0.0 or x2 <= 0.0:
            raise washed_out
        alkalinity = float(self.feed[4])
        carbon = self._equilibrium_carbon(dilution_per_day, demand * x1, demand * x2, alkalinity - s2)
        return np.array([x1, s1, x2, s2, alkalinity, carbon])

    def _equilibrium_carbon(self, dilution: float, grown1: float, grown2: float, bound: float) -> float:
        """Return C at equilibrium (Bernard et al. 2001, eq. 46 to 48); ``bound`` is Z − S2."""
        kla, saturation = self.transfer_per_day, self.henry_mmol_l_atm * self.pressure_atm
        supply = self.carbon_in_mmol_l - bound + (self.k4 * grown1 + self.k5 * grown2) / dilution
        omega = saturation + supply + (kla + dilution) / kla * self.k6 * grown2 / dilution
        pressure = (omega - (omega**2 - 4.0 * saturation * supply) ** 0.5) / (2.0 * self.henry_mmol_l_atm)
        solution = (kla * self.henry_mmol_l_atm * pressure + dilution * supply) / (kla + dilution)
        return float(solution + bound)
