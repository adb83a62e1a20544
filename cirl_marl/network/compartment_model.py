"""What every compartment model offers, and what some offer besides.

A model is frozen parameters and pure functions of arrays that are compartment-major: states (k, B), inputs (c, B),
results (k, B) or (B,), in float64, contiguous along the batch. Nothing loops over the batch, and every operation is
elementwise along it, so that a column's bits do not depend on the batch it is in.

A model inherits from the class that says how it moves (``MOTIONS``) and from one for each thing that it offers besides
(``OFFERS``); Python refuses to make a model that lacks a method of theirs.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping
from inspect import isabstract
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray

from cirl_marl.errors import NetworkError
from cirl_marl.network.declarations import Word, bound_problems, check_types
from cirl_marl.network.rowsum import Floats

RewardState = Literal["before", "after"]
Form = Annotated[Literal["published", "sound"], Word("``published`` or ``sound``", of=("published", "sound"))]
"""Which equations, of a model that has those that were published and physically sound ones."""
Bools = NDArray[np.bool_]


ABSTRACT: Any = abstractmethod(lambda: None)
"""Stands for an attribute that the class of a model has to state: Python takes it for abstract."""


class CompartmentModel(ABC):
    """What every kind of compartment has.

    Attributes:
        kind: name in the registry.
        time_unit: unit of the model's time, as pint reads it.
        reward_state: whether the reward of a step takes the state ``before`` or ``after`` it; the published
            environments differ in this. The input is that of the step in either case.
        input_unit: unit of all inputs, as pint reads it, to which definitions are converted; without it they give
            bounds of controls as numbers without unit, ``unit = "1"``.
        context_names: keyword arguments that the method by which it moves takes from the network, shape (B,) each: on a
            node ``stock_kg``, what it holds; on a batch arc whose vehicle it is ``load_kg``, what that carries.
    """

    __slots__ = ()
    kind: ClassVar[str] = ABSTRACT
    time_unit: ClassVar[str] = ABSTRACT
    reward_state: ClassVar[RewardState] = ABSTRACT
    input_unit: ClassVar[str | None] = None
    context_names: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        """Refuse parameters of another kind, or out of other bounds, than declared; a ``NetworkError`` names all."""
        check_types(self.kind, self)
        if faults := list(bound_problems(self)):
            raise NetworkError(self.kind, faults)

    @property
    @abstractmethod
    def state_names(self) -> tuple[str, ...]:
        """The states, with units, in order."""

    @property
    @abstractmethod
    def input_names(self) -> tuple[str, ...]:
        """The controls, with units, in order."""

    @abstractmethod
    def reward(self, state: Floats, inputs: Floats) -> Floats:
        """Return the reward of a step, shape (B,)."""

    @property
    def observed_states(self) -> tuple[str, ...]:
        """States that an agent sees; by default all."""
        return self.state_names

    @property
    def ranged_states(self) -> tuple[str, ...]:
        """States whose start is drawn from a range that the network gives."""
        return self.state_names

    @property
    def bounds(self) -> Mapping[str, tuple[float, float]]:
        """Lowest and highest value of states and inputs, by name, for which the equations hold; others are refused."""
        return {}

    @property
    def robot(self) -> CompartmentModel:
        """The model that acts: this one, or one within it."""
        return self

    def receive(self, state: Floats, mass_kg: Floats) -> Floats:
        """Return the state, shape (k, B), after a delivery, shape (B,); by default it takes no notice."""
        return state


class OutflowModel(CompartmentModel):
    """A model whose output drives flows of law ``compartment``."""

    __slots__ = ()

    @abstractmethod
    def outflow(self, state: Floats, inputs: Floats) -> Floats:
        """Return the output, shape (B,); the arc's rate converts it to mass/time."""


class ContinuousModel(CompartmentModel):
    """ż = f(z, u), integrated by the solver of the network."""

    __slots__ = ()

    @abstractmethod
    def derivative(self, state: Floats, inputs: Floats, *_: Any, **context: Any) -> Floats:
        """Return dz/dt, shape (k, B), per ``time_unit``; a model names the ``context`` that it takes."""


class OwnStepModel(OutflowModel):
    """Continuous in time, with a step of its own, for physics that Runge-Kutta cannot follow.

    If it has a ``derivative`` too, solver ``euler`` takes that, as the published environments do.
    """

    __slots__ = ()

    @abstractmethod
    def integrate(self, state: Floats, inputs: Floats, interval: float, *_: Any, **more: Any) -> tuple[Floats, Floats]:
        """Return the state after ``interval`` ``time_unit``, (k, B), and the mean of ``outflow`` over it, (B,)."""


class DiscreteTimeModel(CompartmentModel):
    """Moves once per control interval, and draws its own start."""

    __slots__ = ()

    @property
    @abstractmethod
    def interval(self) -> float:
        """Length of its step, ``time_unit``; the control interval of its network must be that."""

    @property
    def ranged_states(self) -> tuple[str, ...]:
        """None: it draws them itself."""
        return ()

    @abstractmethod
    def start(self, stream: np.random.Generator) -> Floats:
        """Draw a start, shape (k,)."""

    @abstractmethod
    def advance(self, state: Floats, inputs: Floats, *_: Any, **context: Any) -> Floats:
        """Return the state one step later, shape (k, B)."""


class MeasuringModel(CompartmentModel):
    """A model of which services and observers may read more than states: ``measure_names``, with units, in order."""

    __slots__ = ()
    measure_names: ClassVar[tuple[str, ...]] = ABSTRACT

    @abstractmethod
    def measures(self, state: Floats, inputs: Floats) -> Floats:
        """Return what it measures, shape (measures, B)."""


class Task(CompartmentModel):
    """A model whose agent has a task that can be done; the agent's infos report it."""

    __slots__ = ()

    @abstractmethod
    def success(self, state: Floats, inputs: Floats) -> Bools:
        """Return whether the task is done, shape (B,)."""


class GoalTask(Task):
    """A task with goals, for ``GoalEnv``: names of observed states besides the goal, of it as it is and should be."""

    __slots__ = ()
    observation_names: ClassVar[tuple[str, ...]] = ABSTRACT
    achieved_names: ClassVar[tuple[str, ...]] = ABSTRACT
    desired_names: ClassVar[tuple[str, ...]] = ABSTRACT

    @abstractmethod
    def goal_reward(self, achieved_goal: Floats, desired_goal: Floats) -> Floats:
        """Return the reward, shape (...), for goals of shape (..., entries of a goal)."""


class ReleasingModel(CompartmentModel):
    """A model that releases units of its node's stock into batch arcs, of which each of its ``ports`` has one."""

    __slots__ = ()
    ports: ClassVar[tuple[str, ...]] = ABSTRACT

    @property
    def unit_kg(self) -> float | None:
        """Mass of a unit, if the model knows it."""
        return None

    @property
    def batch_kg(self) -> float | None:
        """Mass of a batch, if the model knows it."""
        return None

    @abstractmethod
    def released_units(self, state: Floats) -> Floats:
        """Return the units released in the last step, shape (ports, B)."""

    @abstractmethod
    def complete(self, state: Floats) -> Bools:
        """Return where the last step completed a batch, shape (B,)."""


class Vehicle(CompartmentModel):
    """A model that carries the batches of its arc, and is told where it leaves, loaded or empty."""

    __slots__ = ()

    @abstractmethod
    def can_board(self, state: Floats) -> Bools:
        """Return where it can be loaded, shape (B,)."""

    @abstractmethod
    def depart(self, state: Floats, mask: Bools) -> Floats:
        """Return the state, shape (k, B), after it was loaded ``mask``, shape (B,)."""

    @abstractmethod
    def has_arrived(self, state: Floats) -> Bools:
        """Return where it is at the recipient with its load, shape (B,)."""

    @abstractmethod
    def turn_back(self, state: Floats, mask: Bools) -> Floats:
        """Return the state, shape (k, B), after it was unloaded ``mask``, shape (B,)."""


MOTIONS = (ContinuousModel, OwnStepModel, DiscreteTimeModel)
"""How a model moves."""

OFFERS = (*MOTIONS, OutflowModel, MeasuringModel, Task, GoalTask, ReleasingModel, Vehicle)
"""All that a model may inherit from."""


def model_faults(model_class: type[Any]) -> Iterator[str]:
    """Yield why a class is none of compartment models, the methods of an offer that it does not make included."""
    if not issubclass(model_class, MOTIONS):
        yield f"it inherits from none of {', '.join(motion.__name__ for motion in MOTIONS)}"
    elif isabstract(model_class):
        yield f"it lacks {', '.join(sorted(model_class.__abstractmethods__))}"
    for offer in OFFERS:
        methods = [name for name in vars(offer) if name in offer.__abstractmethods__ and hasattr(model_class, name)]
        if methods and not issubclass(model_class, offer):
            yield f"it has {', '.join(methods)} and does not inherit from {offer.__name__}"
