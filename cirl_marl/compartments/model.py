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
    """What every kind of compartment has; how it moves in time is one of the three protocols below.

    Besides, a model may offer

    - ``outflow(state, inputs)``, shape (B,): the output that drives flows of law ``compartment``;
    - ``measure_names`` and ``measures(state, inputs)``, shape (measures, B): what services and observers may read;
    - ``success(state, inputs)``, shape (B,): whether the task is done, reported in the infos of the agent;
    - ``observed``: names of the states that an agent sees, by default all;
    - ``context_names``: keyword arguments that ``derivative`` or ``advance`` takes from the network: ``stock_kg``, what
      the node holds, or ``load_kg``, what the vehicle of an arc carries, shape (B,) each;
    - ``receive(state, mass_kg)``: the state after a delivery of ``mass_kg``, shape (B,);
    - ``ports``, ``released(state)``, shape (ports, B), and ``complete(state)``, shape (B,): units released into batch
      arcs in the last step, and whether that completed a batch;
    - ``boarding(state)``, ``depart(state, where)``, ``arrived(state)``, ``turn_back(state, where)``: a vehicle, which
      says where it can load and has arrived, shape (B,), and is told where it leaves, loaded or empty.

    Attributes:
        kind: name in the registry.
        state_names: the states, with units, in order.
        input_names: the controls, with units, in order.
        time_unit: unit of the model's time, as pint reads it.
        reward_state: whether the reward of a step takes the state ``before`` or ``after`` it; the published
            environments differ in this. The input is that of the step in either case.
    """

    kind: ClassVar[str]
    time_unit: ClassVar[str]
    reward_state: ClassVar[RewardState]

    @property
    def state_names(self) -> tuple[str, ...]: ...  # noqa: D102
    @property
    def input_names(self) -> tuple[str, ...]: ...  # noqa: D102

    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return the reward of a step, shape (B,)."""
        ...


class ContinuousModel(CompartmentModel, Protocol):
    """ż = f(z, u), integrated by the solver of the network."""

    def derivative(self, state: Floats, inputs: Floats) -> Floats:
        """Return dz/dt, shape (k, B)."""
        ...


class OwnStepModel(CompartmentModel, Protocol):
    """Continuous in time, with a step of its own, for physics that Runge-Kutta cannot follow."""

    def advance(self, state: Floats, inputs: Floats, interval: float) -> tuple[Floats, Floats]:
        """Return the state after ``interval``, shape (k, B), and the mean of its outflow over it, shape (B,)."""
        ...


class DiscreteTimeModel(CompartmentModel, Protocol):
    """Moves once per control interval, which must be its own.

    Attributes:
        interval: length of its step in its time unit.
    """

    @property
    def interval(self) -> float: ...  # noqa: D102

    def start(self, stream: np.random.Generator) -> Floats:
        """Draw a start, shape (k,)."""
        ...

    def advance(self, state: Floats, inputs: Floats, interval: float) -> Floats:
        """Return the state one step later, shape (k, B)."""
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


def check_step(kind: str, interval: float, own: float) -> None:
    """Raise a ``CirlError`` unless ``interval`` is the step ``own`` of a model in discrete time."""
    if not math.isclose(interval, own, rel_tol=1e-9):
        raise CirlError(f"{kind}: moves in steps of {own:g}, not {interval:g}.")


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


def check_share(kind: str, **parameters: float) -> None:
    """Raise a ``CirlError`` that names the first parameter that is no share of a whole, in [0, 1]."""
    for name, value in parameters.items():
        if not 0.0 <= value <= 1.0:
            raise CirlError(f"{kind}: {name} = {value!r}, but it must lie in [0, 1].")
