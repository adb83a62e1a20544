"""The inner physics of compartments: all models of a network as one batched state."""

from __future__ import annotations

import numpy as np

from cirl_marl.elements import ControlKind
from cirl_marl.network import Floats, Network
from cirl_marl.units import factor


class InnerPhysics:
    """Stacks the inner states of every compartment that has a model.

    Attributes:
        names: ``compartment.state`` of each row of the stacked state.
        owners: compartments with a model, in network order.
        rows: rows of each owner's state.
        low: lower ends of the initial ranges, shape (states,).
        high: upper ends.
    """

    def __init__(self, network: Network) -> None:
        """Compile the models of ``network``."""
        self._network = network
        owners = [c for c in network.compartments.values() if c.model is not None]
        self.owners = tuple(owner.id for owner in owners)
        self._models = [owner.model for owner in owners if owner.model is not None]
        self.names = tuple(
            f"{owner.id}.{name}"
            for owner, model in zip(owners, self._models, strict=True)
            for name in model.state_names
        )
        edges = np.cumsum([0, *(len(model.state_names) for model in self._models)]).tolist()
        self.rows = {owner: slice(edges[i], edges[i + 1]) for i, owner in enumerate(self.owners)}
        ranges = [span for owner in owners for span in owner.inner]
        self.low: Floats = np.array([low for low, _ in ranges], dtype=float)
        self.high: Floats = np.array([high for _, high in ranges], dtype=float)
        self._speed = [factor(network.time_unit, model.time_unit) for model in self._models]
        self._inputs = [
            network.controllable.index(owner.id)
            if owner.control is not None and owner.control.kind is ControlKind.INPUT
            else None
            for owner in owners
        ]

    def derivative(self, inner: Floats, controls: Floats, stock: Floats) -> Floats:
        """Return dz/dt in the network's time unit, shape (states, B)."""
        slope = np.empty_like(inner)
        for i, (owner, model) in enumerate(zip(self.owners, self._models, strict=True)):
            rows = self.rows[owner]
            slope[rows] = model.derivative(inner[rows], self._input(i, controls)) * self._speed[i]
        return slope

    def extend(self, stock: Floats, inner: Floats, controls: Floats) -> Floats:
        """Append the output of each model to stocks with their unit row."""
        if not self._models:
            return stock
        outputs = [
            model.outflow(inner[self.rows[owner]], self._input(i, controls))
            if hasattr(model, "outflow")
            else np.zeros(stock.shape[1])
            for i, (owner, model) in enumerate(zip(self.owners, self._models, strict=True))
        ]
        return np.concatenate([stock, np.stack(outputs)])

    def rewards(self, before: Floats, after: Floats, controls: Floats) -> Floats:
        """Return the reward of each model for a step between two inner states, shape (models, B)."""
        rewards = [
            model.reward(
                (before if model.reward_state == "before" else after)[self.rows[owner]], self._input(i, controls)
            )
            for i, (owner, model) in enumerate(zip(self.owners, self._models, strict=True))
        ]
        return np.stack(rewards) if rewards else np.empty((0, after.shape[1]))

    def _input(self, i: int, controls: Floats) -> Floats:
        row = self._inputs[i]
        return controls[row : row + 1] if row is not None else np.empty((0, controls.shape[1]))
