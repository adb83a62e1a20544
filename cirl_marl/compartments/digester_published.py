"""The digester as published: six independent dilutions, and a product where a sum is meant."""

from __future__ import annotations

from dataclasses import field
from typing import Annotated, ClassVar

import numpy as np

from cirl_marl.compartments.digester import Digester
from cirl_marl.network.compartment_model import ContinuousModel, OutflowModel, RewardState
from cirl_marl.network.declarations import Declaration, Positive, frozen_record
from cirl_marl.network.rowsum import Floats


@frozen_record
class DigesterPublished(ContinuousModel, OutflowModel):
    """AM2 after arXiv 2502.02382: ż = f(z) + G(z)·(D̄ + φ) with one dilution D̄ + φ_i for each state.

    The initial-condition-dependent controller φ = −½G⁻¹(2f + ∇V) with V = p(x̃ᵀx̃)^q and x̃ = z − z̄ gives x̃̇ = −½∇V and
    x̃ = 0 at ``settling_day``. It needs six actuators; a digester has one pump. ``Digester`` has one dilution.

    The published P_C has ``x̃6·C̄`` under the root where ``x̃6 + C̄`` = C is meant (``misprint``). At equilibrium that
    gives ṁ12 = 175.08 instead of 66.96 mmol/(L d), and with it the ratio of digester to algae emission: published
    175.08/0.28 = 625 (exactly 175.08/0.2702 = 648); corrected 66.96/0.2702 = 248; and 66.96/0.0135 = 4960 when the
    uptake per litre is ρX, not ρ.
    """

    kind: ClassVar[str] = "digester_published"
    state_names: ClassVar[tuple[str, ...]] = Digester.state_names
    input_names: ClassVar[tuple[str, ...]] = tuple(f"dilution_{name}_per_day" for name in "x1 s1 x2 s2 z c".split())
    input_unit: ClassVar[str] = "1/day"
    time_unit: ClassVar[str] = "day"
    reward_state: ClassVar[RewardState] = "before"

    process: Annotated[Digester, Declaration("the parameters, and what both forms share")] = field(
        default_factory=Digester
    )
    dilution_per_day: Annotated[float, Positive("D̄ at the equilibrium z̄ [published]")] = 0.5
    settling_day: Annotated[float, Positive("T_max of the controller, d [published]")] = 3.5
    misprint: Annotated[bool, Declaration("whether P_C has the published product [published: True]")] = True

    @property
    def equilibrium(self) -> Floats:
        """z̄ at the dilution D̄, shape (6,)."""
        return self.process.equilibrium(self.dilution_per_day)

    def gas(self, state: Floats) -> Floats:
        """Return qC, with the misprint if asked, mmol/(L d), shape (B,)."""
        if not self.misprint:
            return self.process.gas(state)
        carbon = self.equilibrium[5]
        free = state[3] - state[4]
        pressure = self.process.partial_pressure(state, (state[5] - carbon) * carbon + free)
        transfer, henry = self.process.transfer_per_day, self.process.henry_mmol_l_atm
        gas: Floats = transfer * (state[5] + free - henry * pressure)
        return gas

    def reaction(self, state: Floats) -> Floats:
        """Return what the reactions and the gas change per day, shape (6, B)."""
        change = self.process.reaction(state)
        change[5] += self.process.gas(state) - self.gas(state)
        return change

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return dz/dt per day, shape (6, B); ``inputs`` are the six dilutions, shape (6, B)."""
        return self.reaction(state) + inputs * self.process.washout(state)

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return ṁ12 = f_r·qC, CO₂ emitted per litre, mmol/(L d), shape (B,)."""
        return self.process.released_share * self.gas(state)

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return −ṁ12, mmol/(L d), shape (B,); none is published."""
        return -self.outflow(state, inputs)

    def controller(self, state: Floats, start: Floats) -> Floats:
        """Return the published six dilutions D̄ + φ that bring ``start`` to z̄ at ``settling_day``, shape (6, B).

        q = T/(1 + T), p = ½|x̃0|^(2/(1 + T))/q². They are not finite where a flushing rate is zero (z = feed).
        """
        middle = self.equilibrium[:, None]
        q = self.settling_day / (1.0 + self.settling_day)
        p = 0.5 * np.sum((start - middle) ** 2, axis=0) ** (1.0 - q) / q**2
        deviation = state - middle
        gradient = 2.0 * p * q * np.sum(deviation**2, axis=0) ** (q - 1.0) * deviation
        washout = self.process.washout(state)
        drift = self.reaction(state) + self.dilution_per_day * washout
        dilutions: Floats = self.dilution_per_day - (drift + 0.5 * gradient) / washout
        return dilutions
