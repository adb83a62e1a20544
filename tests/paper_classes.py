"""The published classes of single compartments: where they start, how their inputs are mapped, what they did."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cirl_marl.network.rowsum import Floats

REFERENCE = Path(__file__).parent / "reference"


def trajectory(name: str) -> tuple[Floats, Floats, Floats]:
    """Return normalised actions (n,), states (n + 1, k) and rewards (n,) of a class of the paper, by its name."""
    table = np.loadtxt(REFERENCE / f"{name}.csv", delimiter=",", skiprows=1)
    return table[:-1, 0], table[:, 1:-1], table[:-1, -1]


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperClass:
    """How one of the paper's environments starts and moves: explicit Euler steps ``dt`` of the ``published`` form.

    The published classes reset to ``np.float32`` numbers and then add float64 ones, so under NumPy 2 (NEP 50) the first
    step of the reference trajectories is partly rounded to float32, and every later one is not.
    ``reference_start`` is the start from which the same first step *in float64* ends where the published one did; it
    equals ``initial_state`` to the resolution of float32.

    Attributes:
        initial_state: state after the published ``reset()``. [published]
        input_low: input at the normalised action −1. [published]
        input_high: input at the normalised action +1; linear between, actions clipped. [published]
        dt: Euler step and control interval, in the model's time unit. [published]
        horizon: steps of an episode. [inferred from the published returns; the published classes never end an episode]
        inferred_initial: (low, high) per state, drawn uniformly; the start that the paper's *returns* need. [inferred]
        reference_start: see above. [derived]
    """

    initial_state: tuple[float, ...]
    input_low: tuple[float, ...]
    input_high: tuple[float, ...]
    horizon: int
    inferred_initial: tuple[tuple[float, float], ...]
    reference_start: tuple[float, ...]
    dt: float = 5e-5

    def inputs(self, action: Floats) -> Floats:
        """Return the physical inputs of normalised actions in [−1, 1], shape (c, B)."""
        low, high = (np.array(bound)[:, None] for bound in (self.input_low, self.input_high))
        inputs: Floats = (np.clip(action, -1.0, 1.0) + 1.0) / 2.0 * (high - low) + low
        return inputs


PAPER = {
    "incinerator": PaperClass(
        initial_state=(0.0, 0.0, 20.0, 0.0, 0.0, 20.0),
        input_low=(-1e6,),
        input_high=(1e6,),
        horizon=100,
        inferred_initial=((0.0, 0.0), (0.0, 0.0), (20.0, 20.0), (0.0, 0.0), (0.0, 0.0), (900.0, 1100.0)),
        # float32 of 20·dt, 1·dt, 20 + 0.84·dt, 4·dt, 3·dt less the same in float64; the last state was always float64
        reference_start=(
            float(np.float32(1e-3)) - 1e-3,
            float(np.float32(5e-5)) - 5e-5,
            20.0 + (float(np.float32(20.000042)) - 20.000042),
            float(np.float32(2e-4)) - 2e-4,
            float(np.float32(1.5e-4)) - 1.5e-4,
            20.0,
        ),
    ),
    "microalgae_monod": PaperClass(
        initial_state=(26.0, 0.0),
        input_low=(0.0,),
        input_high=(150.0,),
        horizon=200,
        inferred_initial=((26.0, 26.0), (1.0, 5.0)),
        reference_start=(26.0, 0.0),
    ),
    "microalgae_droop": PaperClass(
        initial_state=(26.0, 2.82, 0.0),
        input_low=(0.0,),
        input_high=(150.0,),
        horizon=200,
        inferred_initial=((26.0, 26.0), (2.82, 2.82), (0.0, 5.0)),
        # S: solves S + dt(45 − 0.45 S − 26·9.4·S/(S + 0.1)) = float32(0.00225), the published S after one step
        reference_start=(26.0, float(np.float32(2.82)), -1.1034407672264982e-10),
    ),
    "transport_truck": PaperClass(
        initial_state=(0.0, 4.0),
        input_low=(-1e6,),
        input_high=(1e6,),
        horizon=200,
        inferred_initial=((0.0, 500.0), (4.0, 4.0)),
        reference_start=(float(np.float32(2e-4)) - 2e-4, 4.0),
    ),
}
"""By kind of compartment model."""
