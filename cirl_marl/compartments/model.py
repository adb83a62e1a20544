"""What every compartment model offers, and what is known of a model's environment in the paper.

A model is frozen parameters and pure functions of arrays that are compartment-major: states (k, B), inputs (c, B),
results (k, B) or (B,), in float64, contiguous along the batch. Nothing loops over the batch, and every operation is
elementwise along it, so that a column's bits do not depend on the batch it is in.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar, Literal, Protocol

import numpy as np

from cirl_marl.errors import CirlError, unknown
from cirl_marl.rowsum import Floats

RewardState = Literal["before", "after"]


class CompartmentModel(Protocol):
    """Dynamics ż = f(z, u) and reward of one kind of compartment.

    Models that exchange material with the network also have ``outflow(state, inputs)``, shape (B,). Models that depend
    on the network take what they need through keyword arguments; their docstrings name them.

    Attributes:
        kind: name in the registry.
        state_names: the states, with units, in order.
        input_names: the controls, with units, in order.
        time_unit: unit of the derivative's time, as pint reads it.
        reward_state: whether the reward of a step takes the state ``before`` or ``after`` it; the published
            environments differ in this. The input is that of the step in either case.
    """

    kind: ClassVar[str]
    state_names: ClassVar[tuple[str, ...]]
    input_names: ClassVar[tuple[str, ...]]
    time_unit: ClassVar[str]
    reward_state: ClassVar[RewardState]

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return dz/dt, shape (k, B)."""
        ...

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return the reward of a step, shape (B,)."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class PaperScenario:
    """One of the paper's environments: explicit Euler steps ``dt`` of the ``published`` form.

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


def check_form(form: str, known: tuple[str, ...]) -> None:
    """Raise a ``CirlError`` unless ``form`` is one of ``known``."""
    if form not in known:
        raise CirlError(unknown("form", form, known))


def check_positive(kind: str, **parameters: float) -> None:
    """Raise a ``CirlError`` that names the first parameter that is not a positive finite number."""
    for name, value in parameters.items():
        if not (math.isfinite(value) and value > 0.0):
            raise CirlError(f"{kind}: {name} = {value!r}, but it must be positive and finite.")


def check_not_negative(kind: str, **parameters: float) -> None:
    """Raise a ``CirlError`` that names the first parameter that is negative or not finite."""
    for name, value in parameters.items():
        if not (math.isfinite(value) and value >= 0.0):
            raise CirlError(f"{kind}: {name} = {value!r}, but it must be finite and not negative.")
