"""What both cultures of microalgae share: a chemostat under light, and the step in which nutrient is drawn down."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
from scipy.special import wrightomega

from cirl_marl.network.compartment_model import ContinuousModel, Form, OwnStepModel
from cirl_marl.network.rowsum import Floats

NEWTON_STEPS = 6
"""Measured over S 0…10⁴, q 0…10⁶ and t 10⁻⁶…1 d: with the published parameters the fifth step changes S by less than
10⁻⁵ of it and a sixth ends at round-off; a falling S needs three."""

SUBSTEP = 1.0 / 64.0
"""Longest substep times the fastest slow rate, μ_max + D: two substeps in 0.0125 d. At the published parameters X and Q
then err by less than 10⁻⁵ and the mean uptake by less than 10⁻⁴ in each interval of a jumping light; the worst of 120
random starts is 5·10⁻⁵, and 2·10⁻⁴ for Droop's published outflow where S collapses within the interval."""

_LEAST_DILUTION = 1e-30
"""Stands for D = 0 where the formulas divide by D; over any span it dilutes by less than round-off."""

_LEAST_DEMAND = 1e-200
"""Keeps 0/0 out of a culture that takes up nothing; far below any demand that changes S."""


class Drawdown(NamedTuple):
    """What a time t under a constant demand q does, shapes (B,).

    Attributes:
        nutrient: S at its end.
        saturation: ∫s dt with s = S/(S + K), so that q·saturation was taken up; in units of time.
        share_retained: ∫e^(−D(t−τ)) s dτ, so that q·retained of it has not been washed out by the end.
    """

    nutrient: Floats
    saturation: Floats
    share_retained: Floats


def draw_down(
    nutrient: Floats, demand: Floats, *, span: float, dilution: float, feed: float, half_saturation: float
) -> Drawdown:
    """Solve Ṡ = D(S_in − S) − q·S/(S + K) over a time t exactly, for any t > 0, S ≥ 0, q ≥ 0.

    Times S + K the right side is −D(S − r₁)(S − r₂) with r₁ ≥ 0, the quasi-steady value, and r₂ ≤ −K. With
    S(λ) = r₁ + (S₀ − r₁)e^(−λ) separation leaves one increasing function of λ ≥ 0,

        t = α λ + (1/D − α)·ln((S₀ − r₂)/(S(λ) − r₂)),   α = (r₁ + K)/(D(r₁ − r₂)),

    concave if S falls and convex if it rises, which Newton solves from where it converges without leaving λ ≥ 0. S
    stays between S₀ and r₁ whatever λ is, hence positive, and for long t it is r₁.

    What was taken up follows from the balance of S. That is a difference which round-off swallows where q is tiny; but
    as S is monotone, ∫s dt lies between t·s at both ends, and the weighted integral between e^(−Dt) and 1 of it. Only
    round-off can leave these bounds, so enforcing them costs no mass, and a vanishing culture stays positive.

    Args:
        nutrient: S₀ ≥ 0, shape (B,).
        demand: q ≥ 0, uptake per volume at saturation, shape (B,).
        span: t > 0.
        dilution: D ≥ 0.
        feed: S_in ≥ 0.
        half_saturation: K > 0.
    """
    dilution = max(dilution, _LEAST_DILUTION)
    supply = dilution * feed
    middle = dilution * half_saturation + demand - supply
    root = np.sqrt(middle * middle + 4.0 * dilution * supply * half_saturation)  # D(r₁ − r₂)
    # D·r₁ and −D·r₂ are (root ∓ middle)/2; the smaller comes from their product, D·supply·K, without cancellation
    large = 0.5 * (root + np.abs(middle))
    small = dilution * supply * half_saturation / large
    scarce = middle >= 0.0
    quasi_steady = np.where(scarce, small, large) / dilution
    below = np.where(scarce, large, small)  # −D·r₂

    steady_sum = quasi_steady + half_saturation
    excess = dilution * (nutrient - quasi_steady) / root
    start = (dilution * nutrient + below) / root  # (S₀ − r₂)/(r₁ − r₂) = 1 + excess
    goal = span * root / steady_sum  # t/α
    weight = demand * half_saturation / (dilution * steady_sum * steady_sum)  # 1/(αD) − 1

    # S falls: replace ln(1 + excess·e^(−λ)) by its chord in e^(−λ), which leaves ω + ln ω = known and errs to the left
    chord = weight * np.log1p(excess)
    falls = chord > 0.0
    chord = np.where(falls, chord, 1.0)
    residual = chord - goal
    fall = np.minimum(residual - wrightomega(np.log(chord) + residual), 0.0)
    # S rises: the slope grows from ``first`` to 1, taken as linear in λ
    first = (nutrient + half_saturation) / (start * steady_sum)
    rise = -2.0 * goal / (first + np.sqrt(first * first + 2.0 * np.maximum(1.0 - first, 0.0) * goal))
    ratio = excess / start
    pull = weight * ratio
    exponent = np.where(falls, fall, rise)  # −λ
    for _ in range(NEWTON_STEPS):
        decay = np.expm1(exponent)
        change = ratio * decay
        remainder = 1.0 + change  # (S − r₂)/(S₀ − r₂)
        defect = goal + exponent + weight * np.log1p(change)
        exponent = exponent - defect * remainder / (remainder + (pull + pull * decay))

    decay = np.expm1(exponent)
    end: Floats = nutrient * np.exp(exponent) - quasi_steady * decay
    # ∫dt/(S + K) = (t + ln((S − r₂)/(S₀ − r₂))/D)/(r₁ + K), and s = 1 − K/(S + K)
    saturation = span - half_saturation / steady_sum * (span + np.log1p(ratio * decay) / dilution)

    before, after = nutrient / (nutrient + half_saturation), end / (end + half_saturation)
    saturation = np.minimum(np.maximum(saturation, span * np.minimum(before, after)), span * np.maximum(before, after))
    kept_water = math.exp(-dilution * span)
    no_draw = nutrient * kept_water - feed * math.expm1(-dilution * span)
    retention = (no_draw - end) / (demand + _LEAST_DEMAND)
    return Drawdown(end, saturation, np.minimum(np.maximum(retention, kept_water * saturation), saturation))


def substeps(interval: float, rate: float) -> int:
    """Return into how many equal substeps an interval is cut for slow processes of that rate.

    >>> substeps(0.0125, 1.65), substeps(0.25, 1.65)
    (2, 27)
    """
    return max(1, math.ceil(interval * rate / SUBSTEP))


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
