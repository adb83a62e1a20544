"""What both cultures of microalgae share: a chemostat under light, and the step in which nutrient is drawn down."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import ClassVar

from cirl_marl.compartments.nutrient import Drawdown, draw_down, substeps
from cirl_marl.network.compartment_model import ContinuousModel, Form, OwnStepModel
from cirl_marl.network.rowsum import Floats


def light_response(light: Floats, *, half_saturation: float, inhibition: float) -> Floats:
    """Return f(I) = I/(I + K_sI + I²/K_iI), in [0, 1], shape as I.

    With K_sI > 0 (Haldane) f(0) = 0 and f is greatest at I* = √(K_sI·K_iI). With the published K_sI = 0 the expression
    is 0/0 in darkness; it is evaluated as its limit 1/(1 + I/K_iI), which falls with I: less light, more growth. The
    light I ≥ 0, half-saturation K_sI and inhibition K_iI are in µmol/(m² s).
    """
    if half_saturation == 0.0:
        return 1.0 / (1.0 + light / inhibition)
    return light / (light + half_saturation + light**2 / inhibition)


class Microalgae(ContinuousModel, OwnStepModel):
    """Chemostat whose first state is the biomass X; the control is the light I. Fields are those of its two forms."""

    __slots__ = ()
    input_names: ClassVar[tuple[str, ...]] = ("light_umol_m2_s",)
    input_unit: ClassVar[str] = "umol/m**2/s"
    time_unit: ClassVar[str] = "day"

    form: Form
    growth_per_day: float
    light_half_saturation: float
    light_inhibition: float
    nutrient_half_saturation_umol_l: float
    dilution_per_day: float
    nutrient_in_umol_l: float
    co2_per_nutrient: float

    @property
    def bounds(self) -> dict[str, tuple[float, float]]:
        """Nothing is negative; the published form has no bounds."""
        names = () if self.form == "published" else (*self.state_names, *self.input_names)
        return dict.fromkeys(names, (0.0, math.inf))

    def light(self, inputs: Floats) -> Floats:
        """Return f(I), shape (B,)."""
        half_saturation = 0.0 if self.form == "published" else self.light_half_saturation
        return light_response(inputs[0], half_saturation=half_saturation, inhibition=self.light_inhibition)

    @abstractmethod
    def uptake(self, state: Floats, inputs: Floats) -> Floats:
        """Return ρ, nutrient taken up per biovolume and day, shape (B,)."""

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return K_CO2·ρ (published) or K_CO2·ρ·X in µmol/(L d) (sound), shape (B,)."""
        per_biovolume = self.co2_per_nutrient * self.uptake(state, inputs)
        return per_biovolume if self.form == "published" else per_biovolume * state[0]

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return the CO₂ that the culture takes *in* per litre, ṁ23 in mmol/(L d), shape (B,).

        ``published`` returns K_CO2·ρ: arXiv 2502.02382 equates µmol/(µm³ d) with mmol/(L d). ``sound`` returns
        K_CO2·ρ·X/1000.
        """
        uptake = self.reward(state, inputs)
        return uptake if self.form == "published" else uptake / 1000.0

    def _halves(self, interval: float) -> tuple[int, float, float, Callable[[Floats, Floats], Drawdown]]:
        """Return the number of substeps, half of one h/2, E = e^(−Dh/2) and (S, demand) → drawdown in half of one."""
        steps = substeps(interval, self.growth_per_day + self.dilution_per_day)
        half = interval / steps / 2.0
        draw = partial(
            draw_down,
            span=half,
            dilution=self.dilution_per_day,
            feed=self.nutrient_in_umol_l,
            half_saturation=self.nutrient_half_saturation_umol_l,
        )
        return steps, half, math.exp(-self.dilution_per_day * half), draw

    def _uptake_from_states(self, most: Floats | float, *halves: tuple[Floats, Drawdown]) -> Floats:
        """Return what a substep adds to ∫ρ dt (published) or ∫ρX/1000 dt (sound), of (demand, drawdown) in its halves.

        ``most`` is ρ at saturation, by which the demand is its product with X.
        """
        (early_demand, early), (late_demand, late) = halves
        if self.form == "published":
            return most * (early.saturation + late.saturation)
        return (early_demand * early.saturation + late_demand * late.saturation) / 1000.0
