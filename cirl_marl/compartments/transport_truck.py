"""The truck that carries unsorted material from the sorter to the incinerator."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np

from cirl_marl.network.compartment_model import ContinuousModel, Form, RewardState
from cirl_marl.network.declarations import NotNegative, Positive, frozen_record
from cirl_marl.network.rowsum import Floats

# The registered environment: one step is 5·10⁻⁵ s, an episode 0.01 s. x(0) ~ U[0, 500] m is inferred: from 0 the
# published returns of −1.2·10⁸ are out of reach (the best is −1.99992·10⁸).


@frozen_record
class TransportTruck(ContinuousModel):
    """Point mass on a straight road, driven by a force F.

    ``published``: ẋ = v, v̇ = F/m with m = 3000 + 210 kg.
    ``sound``: m v̇ = F − c_rr m g·s(v) − ½ρ c_d A·v|v| with s(v) = tanh(v/v_s), the sign of v smoothed so that the
    truck comes to rest instead of chattering. Kinetic energy changes by F·v less a dissipation that is never negative.
    Reward of both: −((x* − x)² + 0.1 v² + 0.001 F²), in the state after the step.

    Source: published code of arXiv 2505.21536 (equation, masses, reward, bounds ±10⁶ N, start (0, 4)); confirmed by
    the reference trajectory, whose 200 later steps are reproduced to the last bit. The resistances are chosen, typical
    of a light lorry. ±10⁶ N is 312 m/s²; the default scenario should stay at what tyres transmit, about ±12 kN (0.4 g).
    """

    kind: ClassVar[str] = "transport_truck"
    state_names: ClassVar[tuple[str, ...]] = ("position_m", "speed_m_s")
    input_names: ClassVar[tuple[str, ...]] = ("force_n",)
    input_unit: ClassVar[str] = "N"
    time_unit: ClassVar[str] = "s"
    reward_state: ClassVar[RewardState] = "after"

    form: Form = "sound"
    truck_kg: Annotated[float, Positive("mass of the empty truck [published]")] = 3000.0
    load_kg: Annotated[float, NotNegative("mass carried unless ``derivative`` is given another [published: m_u]")] = (
        210.0
    )
    target_m: Annotated[float, NotNegative("position x* of the incinerator [published]")] = 1000.0
    speed_weight: Annotated[float, NotNegative("weight of v² in the reward, s² [published]")] = 0.1
    force_weight: Annotated[float, NotNegative("weight of F² in the reward, m²/N² [published]")] = 0.001
    rolling_resistance: Annotated[float, NotNegative("c_rr [chosen, lorry tyres 0.006 to 0.015]")] = 0.01
    drag_area_m2: Annotated[float, NotNegative("c_d·A [chosen: 0.6 × 5 m²]")] = 3.0
    air_density_kg_m3: Annotated[float, NotNegative("ρ [air at 20 °C]")] = 1.2
    gravity_m_s2: Annotated[float, NotNegative("g [standard]")] = 9.80665
    standstill_m_s: Annotated[float, Positive("v_s of the smoothed sign [chosen]")] = 0.05

    def derivative(self, state: Floats, inputs: Floats, *, load_kg: Floats | float | None = None) -> Floats:
        """Return (ẋ, v̇) in m/s and m/s², shape (2, B); another load than the parameter is a number or shape (B,)."""
        mass_kg = self.truck_kg + (self.load_kg if load_kg is None else load_kg)
        force_n = inputs[0]
        if self.form == "sound":
            force_n = force_n - self.resistance_n(state[1], mass_kg)
        return np.stack([state[1], force_n / mass_kg])

    def resistance_n(self, speed_m_s: Floats, mass_kg: Floats | float) -> Floats:
        """Return rolling resistance plus drag, in N, shape (B,); it always opposes the motion."""
        friction = self.rolling_resistance * mass_kg * self.gravity_m_s2 * np.tanh(speed_m_s / self.standstill_m_s)
        drag = 0.5 * self.air_density_kg_m3 * self.drag_area_m2 * speed_m_s * np.abs(speed_m_s)
        return friction + drag

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return −((x* − x)² + 0.1 v² + 0.001 F²), shape (B,); x* is the third state if there is one."""
        position_m, speed_m_s, *destination_m = state
        distance = ((destination_m[0] if destination_m else self.target_m) - position_m) ** 2
        cost: Floats = distance + self.speed_weight * speed_m_s**2 + self.force_weight * inputs[0] ** 2
        return -cost
