"""What every compartment model offers.

A model is frozen parameters and pure functions of arrays that are compartment-major: states (k, B), inputs (c, B),
results (k, B) or (B,), in float64, contiguous along the batch. Nothing loops over the batch, and every operation is
elementwise along it, so that a column's bits do not depend on the batch it is in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import ClassVar, Literal, Protocol

import numpy as np

from cirl_marl.errors import CirlError, unknown
from cirl_marl.network.rowsum import Floats

RewardState = Literal["before", "after"]


class CompartmentModel(Protocol):
    """What every kind of compartment has; how it moves in time is one of the three protocols below.

    Besides, a model may offer

    - ``outflow(state, inputs)``, shape (B,): the output that drives flows of law ``compartment``;
    - ``measure_names`` and ``measures(state, inputs)``, shape (measures, B): what services and observers may read;
    - ``success(state, inputs)``, shape (B,): whether the task is done, reported in the infos of the agent;
    - ``observed``: names of the states that an agent sees, by default all;
    - ``input_unit``: unit of all inputs, as pint reads it, to which definitions are converted; without it they give
      bounds of controls as numbers without unit, ``unit = "1"``;
    - ``bounds``: lowest and highest value of states and inputs, by name, between which the equations hold; starts and
      controls beyond are refused;
    - ``context_names``: keyword arguments that ``derivative`` or ``advance`` takes from the network, shape (B,) each:
      on a node ``stock_kg``, what it holds; on a batch arc whose vehicle it is ``load_kg``, what that carries;
    - ``receive(state, mass_kg)``: the state after a delivery of ``mass_kg``, shape (B,);
    - ``ports``, ``released(state)``, shape (ports, B), and ``complete(state)``, shape (B,): units released into batch
      arcs in the last step, and whether that completed a batch; ``unit_kg`` and ``batch_kg``: the mass of a
      unit and of a batch, if the model needs them;
    - ``goal_reward(achieved, desired)`` with ``observation_names``, ``achieved_names`` and ``desired_names``: a task
      with goals, for ``GoalEnv``;
    - ``robot``: the model that acts within this one;
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

    @property
    def derivative(self) -> Callable[..., Floats]:
        """``derivative(state, inputs)`` is dz/dt, shape (k, B); by keyword it is told what ``context_names`` lists."""
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
