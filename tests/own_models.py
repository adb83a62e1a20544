"""A compartment model outside the library, as a user would write it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from cirl_marl.compartments import ContinuousModel, OutflowModel, RewardState

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Fermenter(ContinuousModel, OutflowModel):
    """Chemostat: Ẋ = (μ − D)X, Ṡ = D(S_in − S) − μX/Y with Monod growth μ; it gives off gas in proportion to μX."""

    kind: ClassVar[str] = "fermenter"
    state_names: ClassVar[tuple[str, ...]] = ("biomass_g_l", "sugar_g_l")
    input_names: ClassVar[tuple[str, ...]] = ("dilution_per_day",)
    input_unit: ClassVar[str] = "1/day"
    time_unit: ClassVar[str] = "day"
    reward_state: ClassVar[RewardState] = "after"

    growth_per_day: float = 0.8
    half_saturation_g_l: float = 2.0
    sugar_in_g_l: float = 20.0
    biomass_yield: float = 0.5

    def _grown(self, state: Floats) -> Floats:
        grown: Floats = self.growth_per_day * state[1] / (state[1] + self.half_saturation_g_l) * state[0]
        return grown

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return dz/dt per day, shape (2, B)."""
        grown = self._grown(state)
        fed = inputs[0] * (self.sugar_in_g_l - state[1])
        return np.stack([grown - inputs[0] * state[0], fed - grown / self.biomass_yield])

    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return the gas given off, shape (B,)."""
        return self._grown(state)

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return the biomass, shape (B,)."""
        biomass: Floats = state[0]
        return biomass


@dataclass(frozen=True, kw_only=True)
class LeakyFermenter(Fermenter):
    """A fermenter whose parameters have no default, and which refuses some of them with errors of Python's own."""

    kind: ClassVar[str] = "leaky_fermenter"

    leak_per_day: float
    stirred: bool

    def __post_init__(self) -> None:
        """Refuse a leak that is none."""
        if self.leak_per_day < 0.0:
            raise ValueError(f"leak_per_day = {self.leak_per_day}: a leak takes away")


class Aimless(ContinuousModel):
    """A class with a reward and no physics."""

    kind: ClassVar[str] = "aimless"
    input_names: ClassVar[tuple[str, ...]] = ()

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return nothing."""
        return np.zeros(state.shape[1])


class Stray:
    """A class that knows nothing of the library."""

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return nothing."""
        return state
