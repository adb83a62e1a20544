"""The inner physics of compartments: all models of a network as one batched state."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.dynamics.rows import Rows
from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import ControlKind
from cirl_marl.network.units import factor


class InnerPhysics:
    """Stacks the inner states of every compartment that has a model.

    Models move in one of three ways: the solver integrates their ``derivative``, or they bring their own step
    (``advance`` of any length, which also gives the mean of their output), or they live in discrete time (``advance``
    of one control interval, their ``interval``).

    Attributes:
        names: ``compartment.state`` of each row of the stacked state.
        owners: compartments with a model, in network order.
        rows: rows of each owner's state.
        observed: rows of each owner's state that an agent sees.
        visible: all of them, in order; the others are states of a simulator.
        measure_names: ``compartment.measure`` of each measured quantity.
        ranged: rows whose start is drawn from a range; the others are drawn by their models.
        low: lower ends of the initial ranges, shape (ranged rows,).
        high: upper ends.
    """

    def __init__(self, network: Network, rows: Rows) -> None:
        """Compile the models of ``network``, whose states have the rows of ``rows``."""
        self._network = network
        owners = [c for c in network.compartments.values() if c.model is not None]
        self.owners, self.names, self.rows = rows.owners, rows.state_names, rows.states
        self._models: list[Any] = [owner.model for owner in owners]
        self._place = {owner: i for i, owner in enumerate(self.owners)}
        self.measure_names = self._labels("measure_names")
        self.observed = {owner: self._observed(owner) for owner in self.owners}
        visible = [row for rows in self.observed.values() for row in sorted(rows)]
        self.visible = np.array(visible, dtype=np.intp)
        euler = network.episode.solver == "euler"
        self._discrete = [i for i, model in enumerate(self._models) if hasattr(model, "interval")]
        self._own_step = [
            i
            for i, model in enumerate(self._models)
            if i not in self._discrete and hasattr(model, "advance") and not (euler and hasattr(model, "derivative"))
        ]
        self._continuous = [i for i in range(len(owners)) if i not in {*self._discrete, *self._own_step}]
        moving = [self.rows[self.owners[i]] for i in self._continuous]
        self._moving = np.array([row for rows in moving for row in range(rows.start, rows.stop)], dtype=np.intp)
        self._starting = [i for i, model in enumerate(self._models) if hasattr(model, "start")]
        drawn = [self.rows[owner] for i, owner in enumerate(self.owners) if i not in self._starting]
        self.ranged = np.array([row for rows in drawn for row in range(rows.start, rows.stop)], dtype=np.intp)
        ranges = [span for owner in owners for span in owner.inner]
        self.low: Floats = np.array([low for low, _ in ranges], dtype=float)
        self.high: Floats = np.array([high for _, high in ranges], dtype=float)
        self._reward_scale = np.array([owner.reward_scale for owner in owners]).reshape(-1, 1)
        self._speed = [factor(network.time_unit, model.time_unit) for model in self._models]
        takes_inputs = [o.control is not None and o.control.kind is ControlKind.INPUT for o in owners]
        self._inputs = [
            network.control_rows[owner.id] if takes else slice(0, 0)
            for owner, takes in zip(owners, takes_inputs, strict=True)
        ]
        self._held = [network.node_index[o] if o in network.node_index else rows.aboard.get(o) for o in self.owners]
        self._kg = factor(network.mass_unit, "kg") if owners else 1.0
        self._plant_of = {network.node_index[o]: o for o in self.owners if o in network.node_index}

    def _labels(self, attribute: str) -> tuple[str, ...]:
        labelled = zip(self.owners, self._models, strict=True)
        return tuple(f"{owner}.{name}" for owner, model in labelled for name in getattr(model, attribute, ()))

    def _observed(self, owner: str) -> tuple[int, ...]:
        model = self._models[self._place[owner]]
        seen = getattr(model, "observed", model.state_names)
        return tuple(self.rows[owner].start + model.state_names.index(name) for name in seen)

    def start(self, stream: np.random.Generator) -> Floats:
        """Draw the states of the models that draw their own, one after the other, shape (rows not ranged,)."""
        drawn = [self._models[i].start(stream) for i in self._starting]
        return np.concatenate(drawn) if drawn else np.empty(0)

    def derivative(self, inner: Floats, controls: Floats, stock: Floats) -> Floats:
        """Return dz/dt of continuous models in the network's time unit, 0 for the others, shape (states, B)."""
        slope = np.zeros_like(inner)
        for i in self._continuous:
            rows, model = self.rows[self.owners[i]], self._models[i]
            context = self._context(i, stock)
            slope[rows] = model.derivative(inner[rows], controls[self._inputs[i]], **context) * self._speed[i]
        return slope

    def moved(self, inner: Floats, change: Floats) -> Floats:
        """Return the states after continuous models changed by ``change``; states of the others keep their bits."""
        if len(self._moving) == len(inner):
            return inner + change
        after = inner.copy()
        after[self._moving] += change[self._moving]
        return after

    def own_steps(self, inner: Floats, controls: Floats, interval: float, stock: Floats) -> tuple[Floats, Floats]:
        """Let models that bring their own step move by ``interval``.

        Returns:
            Inner states, shape (states, B), those of the other models as they were; mean outputs of all models,
            shape (models, B), NaN for the others.
        """
        means = np.full((len(self._models), stock.shape[1]), np.nan)
        if not self._own_step:
            return inner, means
        after = inner.copy()
        for i in self._own_step:
            rows, model = self.rows[self.owners[i]], self._models[i]
            step = interval * self._speed[i]
            context = self._context(i, stock)
            after[rows], means[i] = model.advance(inner[rows], controls[self._inputs[i]], step, **context)
        return after, means

    def tick(self, inner: Floats, controls: Floats, stock: Floats) -> Floats:
        """Let models in discrete time move by one control interval, given the masses at its start."""
        if not self._discrete:
            return inner
        after = inner.copy()
        for i in self._discrete:
            rows, model = self.rows[self.owners[i]], self._models[i]
            context = self._context(i, stock)
            after[rows] = model.advance(inner[rows], controls[self._inputs[i]], model.interval, **context)
        return after

    def extend(self, stock: Floats, inner: Floats, controls: Floats, means: Floats | None = None) -> Floats:
        """Append the output of each model to the masses with their unit row; ``means`` replace it where not NaN."""
        if not self._models:
            return stock
        outputs = np.zeros((len(self._models), stock.shape[1]))
        for i, (owner, model) in enumerate(zip(self.owners, self._models, strict=True)):
            if means is not None and i in self._own_step:
                outputs[i] = means[i]
            elif hasattr(model, "outflow"):
                outputs[i] = model.outflow(inner[self.rows[owner]], controls[self._inputs[i]])
        return np.concatenate([stock, outputs])

    def rewards(self, before: Floats, after: Floats, controls: Floats) -> Floats:
        """Return the scaled reward of each model for a step between two inner states, shape (models, B)."""
        rewards = [
            model.reward(
                (before if model.reward_state == "before" else after)[self.rows[owner]], controls[self._inputs[i]]
            )
            for i, (owner, model) in enumerate(zip(self.owners, self._models, strict=True))
        ]
        return np.stack(rewards) / self._reward_scale if rewards else np.empty((0, after.shape[1]))

    def measures(self, inner: Floats, controls: Floats) -> Floats:
        """Return what the models measure, shape (measures, B)."""
        measured = [
            model.measures(inner[self.rows[owner]], controls[self._inputs[i]])
            for i, (owner, model) in enumerate(zip(self.owners, self._models, strict=True))
            if hasattr(model, "measures")
        ]
        return np.concatenate(measured) if measured else np.empty((0, inner.shape[1]))

    def successes(self, inner: Floats, controls: Floats) -> dict[str, NDArray[np.bool_]]:
        """Return, for each model with a criterion of success, whether it is met, shape (B,)."""
        return {
            owner: model.success(inner[self.rows[owner]], controls[self._inputs[i]])
            for i, (owner, model) in enumerate(zip(self.owners, self._models, strict=True))
            if hasattr(model, "success")
        }

    def released(self, owner: str, port: str, inner: Floats) -> Floats:
        """Return the units that a model released into a port in the last interval, shape (B,)."""
        model = self._models[self._place[owner]]
        units: Floats = model.released(inner[self.rows[owner]])[model.ports.index(port)]
        return units

    def complete(self, owner: str, inner: Floats) -> NDArray[np.bool_]:
        """Return where a model completed a batch in the last interval, shape (B,)."""
        complete: NDArray[np.bool_] = self._models[self._place[owner]].complete(inner[self.rows[owner]])
        return complete

    def arrive(self, arc: str, inner: Floats) -> NDArray[np.bool_]:
        """Return where the vehicle of ``arc`` is at the recipient; it turns back, in place."""
        return self._turn(arc, inner, "arrived", "turn_back", None)

    def board(self, arc: str, inner: Floats, waiting: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Return where the vehicle of ``arc`` takes the waiting load; it departs, in place."""
        return self._turn(arc, inner, "boarding", "depart", waiting)

    def _turn(
        self, arc: str, inner: Floats, where: str, turn: str, also: NDArray[np.bool_] | None
    ) -> NDArray[np.bool_]:
        rows, model = self.rows[arc], self._models[self._place[arc]]
        turns: NDArray[np.bool_] = getattr(model, where)(inner[rows])
        if also is not None:
            turns = turns & also
        inner[rows] = getattr(model, turn)(inner[rows], turns)
        return turns

    def receive(self, node: int, inner: Floats, mass: Floats) -> None:
        """Hand a delivery, shape (B,), to the model of the node at that row, in place; most take no notice."""
        owner = self._plant_of.get(node)
        if owner is None:
            return
        receive: Callable[..., Floats] | None = getattr(self._models[self._place[owner]], "receive", None)
        if receive is not None:
            inner[self.rows[owner]] = receive(inner[self.rows[owner]], mass * self._kg)

    def _context(self, i: int, stock: Floats) -> dict[str, Floats]:
        """What model i asks for: the mass that its node holds or that its vehicle carries."""
        names = getattr(self._models[i], "context_names", ())
        held = self._held[i]
        return {name: stock[held] * self._kg for name in names} if held is not None else {}
