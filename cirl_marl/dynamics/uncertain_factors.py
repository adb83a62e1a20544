"""What factors on uncertain numbers act on: the flows of arcs, or rows of a table such as the bands of services.

Factors have shape (numbers, B), a row for each of ``Network.uncertain``: every copy has a draw of its own.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Law
from cirl_marl.network.uncertainty import numbers_of


class RowFactors:
    """Rows of a table that uncertain numbers multiply.

    Attributes:
        rows: those rows.
    """

    def __init__(self, numbers: Mapping[int, int]) -> None:
        """Let rows of a table be multiplied by rows of the factors."""
        self.rows: Integers = np.array([*numbers], dtype=np.intp)
        self._numbers: Integers = np.array([*numbers.values()], dtype=np.intp)

    def __call__(self, table: Floats, factors: Floats | None) -> Floats:
        """Return a table of shape (rows, 1 or B) times what was drawn."""
        if factors is None or not len(self.rows):
            return table
        product = np.repeat(table, factors.shape[1] // table.shape[1], axis=1)
        product[self.rows] *= factors.take(self._numbers, axis=0)
        return product


class FlowFactors:
    """The arcs whose flow laws uncertain numbers multiply; shares are not among them (``shares``).

    Attributes:
        arcs: those arcs.
        highest: greatest factor on each, shape (arcs,).
    """

    def __init__(self, network: Network) -> None:
        """Find them in ``network``, which has its lifetimes as stages if it has any."""
        valves = network.valves if isinstance(network, StagedNetwork) else {}
        rates, flows = numbers_of(network, "arcs", "rate"), numbers_of(network, "arcs", "flow")
        releases, stretches = numbers_of(network, "nodes", "rate"), numbers_of(network, "nodes", "stretch")
        entries: list[tuple[int, int, bool]] = []
        for k, arc in enumerate(network.arcs):
            if arc.donor in valves:
                number = stretches.get(valves[arc.donor])
            elif arc.law is Law.SHARE:
                number = releases.get(arc.donor)
            else:
                number = (flows if arc.law is Law.EXOGENOUS else rates).get(arc.id)
            if number is not None:
                entries.append((k, number, arc.donor in valves))
        self.arcs: Integers = np.array([k for k, _, _ in entries], dtype=np.intp)
        self._numbers: Integers = np.array([number for _, number, _ in entries], dtype=np.intp)
        self._inverse_rows: Integers = np.flatnonzero([inverse for _, _, inverse in entries])
        ends = [spread.ends for spread in network.uncertain.values()]
        extremes = [1 / ends[number][0] if inverse else ends[number][1] for _, number, inverse in entries]
        self.highest: Floats = np.array(extremes, dtype=float)

    def multiply(self, rate: Floats, factors: Floats) -> None:
        """Multiply what was drawn into the rates of arcs, shape (arcs, B), in place."""
        if len(self.arcs):
            multipliers = factors.take(self._numbers, axis=0)
            multipliers[self._inverse_rows] = 1.0 / multipliers[self._inverse_rows]
            rate[self.arcs] *= multipliers
