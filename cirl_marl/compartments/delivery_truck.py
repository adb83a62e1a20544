"""The truck as a vehicle of the network: out with a load, back empty."""

from __future__ import annotations

from typing import Annotated, ClassVar

import numpy as np
from numpy.typing import NDArray

from cirl_marl.compartments.transport_truck import TransportTruck
from cirl_marl.errors import CirlError
from cirl_marl.network.compartment_model import RewardState, Vehicle
from cirl_marl.network.declarations import NotNegative, Positive, Quantity, frozen_record
from cirl_marl.network.rowsum import Floats


@frozen_record
class DeliveryTruck(TransportTruck, Vehicle):
    """The point mass of ``TransportTruck`` with the load that the network gives it, on a road of ``target_m``.

    m v̇ = F − resistances with m = truck + load; the third state is where the truck is heading: ``target_m`` with a
    load, 0 on the way back and while it waits. It loads and unloads where it is within ``reach_m`` of the place and
    slower than ``rest_m_s``. Reward: −((destination − x)² + 0.1 v² + weight·F²), after the step.

    Source: the paper's truck and reward (arXiv 2505.21536); the trips are ours, the paper has one trip that never ends.
    """

    kind: ClassVar[str] = "delivery_truck"
    state_names: ClassVar[tuple[str, ...]] = ("position_m", "speed_m_s", "destination_m")
    reward_state: ClassVar[RewardState] = "after"
    context_names: ClassVar[tuple[str, ...]] = ("load_kg",)

    load_kg: Annotated[float, Quantity("0 and nothing else, the network knows the load")] = 0.0
    target_m: Annotated[
        float, Positive("length of the road [chosen: scaled to the robot's clock; the paper's is 1000 m]")
    ] = 10.0
    force_weight: Annotated[
        float, NotNegative("weight of F² in the reward, m²/N² [chosen: 10 kN for a second weigh as much as 10 m]")
    ] = 1e-8
    reach_m: Annotated[float, Positive("distance at which the truck is there [chosen]")] = 0.5
    rest_m_s: Annotated[float, Positive("speed below which it can be loaded [chosen]")] = 1.0

    def __post_init__(self) -> None:
        """Refuse what has no meaning."""
        TransportTruck.__post_init__(self)
        if self.load_kg != 0.0:
            raise CirlError(
                f"{self.kind}: load_kg = {self.load_kg!r}, but the network knows what is aboard: leave it out, and let "
                "batches bring the load."
            )
        if 2.0 * self.reach_m >= self.target_m:
            raise CirlError(
                f"{self.kind}: reach_m = {self.reach_m!r}, but on a road of {self.target_m!r} m it must be below half."
            )

    def derivative(self, state: Floats, inputs: Floats, *, load_kg: Floats | float | None = None) -> Floats:
        """Return (ẋ, v̇, 0), shape (3, B); arguments as of ``TransportTruck``."""
        in_motion = TransportTruck.derivative(self, state[:2], inputs, load_kg=load_kg)
        return np.concatenate([in_motion, np.zeros_like(state[2:])])

    def can_board(self, state: Floats) -> NDArray[np.bool_]:
        """Return where the truck rests at the donor and heads nowhere, shape (B,)."""
        return self._at(state, 0.0)

    def has_arrived(self, state: Floats) -> NDArray[np.bool_]:
        """Return where the truck rests at the recipient with its load, shape (B,)."""
        return self._at(state, self.target_m)

    def depart(self, state: Floats, mask: NDArray[np.bool_]) -> Floats:
        """Return the state with the recipient as destination where, by ``mask``, the truck was loaded."""
        return self._heading(state, mask, self.target_m)

    def turn_back(self, state: Floats, mask: NDArray[np.bool_]) -> Floats:
        """Return the state with the donor as destination where, by ``mask``, it was unloaded."""
        return self._heading(state, mask, 0.0)

    def _at(self, state: Floats, place_m: float) -> NDArray[np.bool_]:
        position_m, speed_m_s, destination_m = state
        near, slow = np.abs(position_m - place_m) <= self.reach_m, np.abs(speed_m_s) <= self.rest_m_s
        at_goal: NDArray[np.bool_] = near & slow & (destination_m == place_m)
        return at_goal

    def _heading(self, state: Floats, mask: NDArray[np.bool_], place_m: float) -> Floats:
        state_ = state.copy()
        state_[2] = np.where(mask, place_m, state[2])
        return state_
