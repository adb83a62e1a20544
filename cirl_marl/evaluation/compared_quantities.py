"""What differs between simulations: figures of whole episodes, those first that differ most."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Annotated

import numpy as np

from cirl_marl.controllers.episode_quantities import QuantityKind, episode_quantities
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.bounds import relative

ROUND_OFF = 1e-12
"""Share of the largest value of its kind by which a quantity may differ and yet count as the same."""

NAMES: Mapping[QuantityKind, str] = {
    "circularity": "mean circularity",
    "service": "mean level of service {}",
    "account": "total of {}",
    "flow": "total flow of {}",
    "stock": "final stock of {}",
}
"""What quantities are called, {} standing for the id of the service, account, arc or node."""


@positional_record
class ComparedQuantity:
    """A figure of a whole episode in each of A alternatives."""

    kind: Annotated[
        QuantityKind, "λ̄, mean level of a service, amount on an account, mass that an arc moved, or stock at the end"
    ]
    of: Annotated[str, "id of the service, arc or node; empty for λ̄"]
    unit: Annotated[str, "that of the values"]
    values: Annotated[Floats, "shape (A,); NaN where a scenario has no such service, arc or node"]
    round_off: Annotated[float, "largest difference at which values count as the same"]

    @property
    def name(self) -> str:
        """What it is, in words."""
        return NAMES[self.kind].format(self.of)

    @property
    def differences(self) -> Floats:
        """Differences to the first alternative, shape (A,), in the unit of the values; NaN where one is missing."""
        return np.asarray(self.values - self.values[0])

    @property
    def relative_differences(self) -> Floats:
        """Differences in units of the first value's magnitude, shape (A,); NaN where that is 0 or one is missing."""
        return relative(self.differences, self.values[0])

    @property
    def rank(self) -> float:
        """Largest relative difference to the first value; 0 if all count as the same.

        What does not exist counts as 0, and a first value below ``round_off`` as ``round_off``.
        """
        figures = np.nan_to_num(self.values)
        largest = float(np.abs(figures - figures[0]).max())
        return largest / max(abs(float(figures[0])), self.round_off) if largest > self.round_off else 0.0


def rank_quantities(simulations: Sequence[Simulation]) -> list[ComparedQuantity]:
    """Return the figures of episodes of ``simulate_alternatives``, those first that differ most.

    They are λ̄, the mean level of each service, the amount on each account, the mass that each arc moved in the episode,
    and the stock of each node at the end.

    The order is that of ``ComparedQuantity.rank``. Round-off is ``ROUND_OFF`` of the largest value of the same kind, or
    account.
    """
    quantities: list[ComparedQuantity] = []
    for kind in NAMES:
        units: dict[str, str] = {}
        figures: list[dict[str, float]] = []
        for simulation in simulations:
            episode, members = simulation.network.episode, episode_quantities(simulation.network, kind)
            scale = episode.horizon * episode.control_interval if kind == "flow" else 1.0  # masses that moved
            units |= {q.of: simulations[0].network.mass_unit if kind == "flow" else q.unit for q in members}
            figures.append({q.of: float(q.totals(simulation.rollout)[0] * scale) for q in members})
        values = np.array([[of_one.get(id_, math.nan) for of_one in figures] for id_ in units])
        for (id_, unit), row in zip(units.items(), values, strict=True):
            alike = row if kind == "account" else values
            round_off = ROUND_OFF * float(np.abs(np.nan_to_num(alike)).max(initial=0.0))
            quantities.append(ComparedQuantity(kind, id_, unit, row, round_off))
    return sorted(quantities, key=lambda quantity: -quantity.rank)
