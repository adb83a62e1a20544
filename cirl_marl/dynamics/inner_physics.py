"""The inner physics of compartments: all models of a network as one batched state."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.network import Floats, Network
from cirl_marl.network.compartment_model import (
    ContinuousModel,
    DiscreteTimeModel,
    MeasuringModel,
    OutflowModel,
    OwnStepModel,
    ReleasingModel,
    Task,
    Vehicle,
)
from cirl_marl.network.elements import ControlKind
from cirl_marl.network.units import factor


class InnerPhysics:
    """Stacks the inner states of every compartment that has a model.

    Models move in one of three ways: the solver integrates their ``derivative``, or they ``integrate`` themselves over
    any length, which also gives the mean of their output, or they ``advance`` by one control interval.

    Attributes:
        names: ``compartment.state`` of each row of the stacked state.
        owners: compartments with a model, in network order.
        rows: rows of each owner's state.
        observed_rows: rows of each owner's state that an agent sees.
        visible: all of them, in order; the others are states of a simulator.
        measure_names: ``compartment.measure`` of each measured quantity.
        range_rows: rows whose start is drawn from a range; the others are drawn by their models.
        low: lower ends of the initial ranges, shape (ranged rows,).
        high: upper ends.
    """

    def __init__(self, network: Network, rows: StateLayout) -> None:
        """Compile the models of ``network``, whose states have the rows of ``rows``."""
        owners = [c for c in network.compartments.values() if c.model is not None]
        self.owners, self.names, self.rows = rows.owners, rows.state_names, rows.states
        self._models = [owner.model for owner in owners if owner.model is not None]
        self._states = list(self.rows.values())
        numbered_models = list(enumerate(self._models))
        model_of = dict(zip(self.owners, self._models, strict=True))
        self._outflow_models = [(i, model) for i, model in numbered_models if isinstance(model, OutflowModel)]
        self._measuring_models = [(i, model) for i, model in numbered_models if isinstance(model, MeasuringModel)]
        self._tasks = [(i, model) for i, model in numbered_models if isinstance(model, Task)]
        self._releasing_models = {id_: model for id_, model in model_of.items() if isinstance(model, ReleasingModel)}
        self._vehicles = {owner: model for owner, model in model_of.items() if isinstance(model, Vehicle)}
        self.measure_names = tuple(
            f"{self.owners[i]}.{name}" for i, model in self._measuring_models for name in model.measure_names
        )
        self.observed_rows = {
            owner: tuple(self.rows[owner].start + model.state_names.index(name) for name in model.observed_states)
            for owner, model in model_of.items()
        }
        self.visible = np.array([row for rows_ in self.observed_rows.values() for row in sorted(rows_)], dtype=np.intp)
        euler = network.episode.solver == "euler"
        self._discrete = [(i, model) for i, model in numbered_models if isinstance(model, DiscreteTimeModel)]
        own_steppers = ((i, model) for i, model in numbered_models if isinstance(model, OwnStepModel))
        self._own_step = [(i, model) for i, model in own_steppers if not (euler and isinstance(model, ContinuousModel))]
        self._with_mean_output = {i for i, _ in self._own_step}
        not_by_solver = self._with_mean_output.union(i for i, _ in self._discrete)
        continuous = ((i, model) for i, model in numbered_models if isinstance(model, ContinuousModel))
        self._continuous = [(i, model) for i, model in continuous if i not in not_by_solver]
        all_rows = np.arange(len(self.names))
        self._solver_rows = np.concatenate([all_rows[:0], *(all_rows[self._states[i]] for i, _ in self._continuous)])
        has_range = (name in model.ranged_states for model in self._models for name in model.state_names)
        self.range_rows = np.flatnonzero(np.fromiter(has_range, dtype=bool))
        ranges = [span for owner in owners for span in owner.inner]
        self.low: Floats = np.array([low for low, _ in ranges], dtype=float)
        self.high: Floats = np.array([high for _, high in ranges], dtype=float)
        self._reward_scale = np.array([owner.reward_scale for owner in owners]).reshape(-1, 1)
        self._speed = [factor(network.time_unit, model.time_unit) for model in self._models]
        takes = (o.control is not None and o.control.kind is ControlKind.INPUT for o in owners)
        self._inputs = [network.control_rows[o.id] if t else slice(0, 0) for o, t in zip(owners, takes, strict=True)]
        index = network.node_index
        self._context_rows = [index[o] if o in index else rows.aboard.get(o) for o in self.owners]
        self._kg = factor(network.mass_unit, "kg") if owners else 1.0
        self._plants = {index[o]: (self.rows[o], model) for o, model in model_of.items() if o in index}

    def start(self, stream: np.random.Generator) -> Floats:
        """Draw the states of the models that draw their own, one after the other, shape (rows not ranged,)."""
        starts = [model.start(stream) for _, model in self._discrete]
        return np.concatenate(starts) if starts else np.empty(0)

    def derivative(self, inner: Floats, controls: Floats, stock: Floats) -> Floats:
        """Return dz/dt of continuous models in the network's time unit, 0 for the others, shape (states, B)."""
        slope = np.zeros_like(inner)
        for i, model in self._continuous:
            rows, context = self._states[i], self._context(i, stock)
            slope[rows] = model.derivative(inner[rows], controls[self._inputs[i]], **context) * self._speed[i]
        return slope

    def after_change(self, inner: Floats, change: Floats) -> Floats:
        """Return the states after continuous models changed by ``change``; states of the others keep their bits."""
        if len(self._solver_rows) == len(inner):
            return inner + change
        after = inner.copy()
        after[self._solver_rows] += change[self._solver_rows]
        return after

    def own_steps(self, inner: Floats, controls: Floats, interval: float, stock: Floats) -> tuple[Floats, Floats]:
        """Let models that bring their own step move by ``interval``.

        Returned are the inner states, shape (states, B), and mean outputs of all models, shape (models, B): as they
        were and NaN for the other models.
        """
        means = np.full((len(self._models), stock.shape[1]), np.nan)
        if not self._own_step:
            return inner, means
        after = inner.copy()
        for i, model in self._own_step:
            rows, context, step = self._states[i], self._context(i, stock), interval * self._speed[i]
            after[rows], means[i] = model.integrate(inner[rows], controls[self._inputs[i]], step, **context)
        return after, means

    def tick(self, inner: Floats, controls: Floats, stock: Floats) -> Floats:
        """Let models in discrete time move by one control interval, given the masses at its start."""
        if not self._discrete:
            return inner
        after = inner.copy()
        for i, model in self._discrete:
            rows, context = self._states[i], self._context(i, stock)
            after[rows] = model.advance(inner[rows], controls[self._inputs[i]], **context)
        return after

    def extend(self, stock: Floats, inner: Floats, controls: Floats, means: Floats | None = None) -> Floats:
        """Append the output of each model to the masses with their unit row; ``means`` replace it where not NaN."""
        if not self._models:
            return stock
        outputs = np.zeros((len(self._models), stock.shape[1]))
        for i, model in self._outflow_models:
            if means is not None and i in self._with_mean_output:
                outputs[i] = means[i]
            else:
                outputs[i] = model.outflow(inner[self._states[i]], controls[self._inputs[i]])
        return np.concatenate([stock, outputs])

    def rewards(self, before: Floats, after: Floats, controls: Floats) -> Floats:
        """Return the scaled reward of each model for a step between two inner states, shape (models, B)."""
        rewards = [
            model.reward((before if model.reward_state == "before" else after)[rows], controls[inputs])
            for model, rows, inputs in zip(self._models, self._states, self._inputs, strict=True)
        ]
        return np.stack(rewards) / self._reward_scale if rewards else np.empty((0, after.shape[1]))

    def measures(self, inner: Floats, controls: Floats) -> Floats:
        """Return what the models measure, shape (measures, B)."""
        readings = [
            model.measures(inner[self._states[i]], controls[self._inputs[i]]) for i, model in self._measuring_models
        ]
        return np.concatenate(readings) if readings else np.empty((0, inner.shape[1]))

    def successes(self, inner: Floats, controls: Floats) -> dict[str, NDArray[np.bool_]]:
        """Return, for each model with a criterion of success, whether it is met, shape (B,)."""
        return {
            self.owners[i]: model.success(inner[self._states[i]], controls[self._inputs[i]]) for i, model in self._tasks
        }

    def released_units(self, owner: str, port: str, inner: Floats) -> Floats:
        """Return the units that a model released into a port in the last interval, shape (B,)."""
        model = self._releasing_models[owner]
        units: Floats = model.released_units(inner[self.rows[owner]])[model.ports.index(port)]
        return units

    def complete(self, owner: str, inner: Floats) -> NDArray[np.bool_]:
        """Return where a model completed a batch in the last interval, shape (B,)."""
        return self._releasing_models[owner].complete(inner[self.rows[owner]])

    def arrive(self, arc: str, inner: Floats) -> NDArray[np.bool_]:
        """Return where the vehicle of ``arc`` is at the recipient; it turns back, in place."""
        rows, vehicle = self.rows[arc], self._vehicles[arc]
        at_recipient = vehicle.has_arrived(inner[rows])
        inner[rows] = vehicle.turn_back(inner[rows], at_recipient)
        return at_recipient

    def board(self, arc: str, inner: Floats, load: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return where the vehicle of ``arc`` takes the waiting load; it departs, in place."""
        rows, vehicle = self.rows[arc], self._vehicles[arc]
        leaves = vehicle.can_board(inner[rows]) & load
        inner[rows] = vehicle.depart(inner[rows], leaves)
        return leaves

    def receive(self, node: int, inner: Floats, mass: Floats) -> None:
        """Hand a delivery, shape (B,), to the model of the node at that row, in place, if it has one."""
        if node in self._plants:
            rows, model = self._plants[node]
            inner[rows] = model.receive(inner[rows], mass * self._kg)

    def _context(self, i: int, stock: Floats) -> dict[str, Floats]:
        """What model i asks for: the mass that its node holds or that its vehicle carries."""
        row = self._context_rows[i]
        return {name: stock[row] * self._kg for name in self._models[i].context_names} if row is not None else {}
