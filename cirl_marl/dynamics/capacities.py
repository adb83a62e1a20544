"""Capacities: scheduled flows that a stock limits, such as that of a plant or a fleet.

In an interval the flow asked for is cut to c·x, x being the stock of the node that limits it at the start of the
interval: what is built in an interval serves from the next one on. The limit is constant within the interval, and
programs have it as a linear row.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.dynamics.uncertain_factors import RowFactors
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.rowsum import RowSum
from cirl_marl.network.uncertainty import numbers_of


class Capacities:
    """The flows of a network that stocks limit.

    Attributes:
        arcs: whose flows they are, shape (limited,).
    """

    def __init__(self, network: Network, rows: StateLayout, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Find them in ``network``, which has its lifetimes as stages; ``ranges`` are of all factors."""
        self.arcs: Integers = np.array([k for k, arc in enumerate(network.arcs) if arc.capacity_node], dtype=np.intp)
        arcs = [network.arcs[k] for k in self.arcs.tolist()]
        nodes = [network.node_index[arc.capacity_node] for arc in arcs]
        places = [(n, int(row)) for n, node in enumerate(nodes) for row in np.atleast_1d(rows.stages.get(node, node))]
        of, stock_rows = np.array(places, dtype=np.intp).reshape(-1, 2).T
        self._stock_sum = RowSum(of, stock_rows, 1.0, (len(arcs), rows.masses))
        rates = [network.interval_means(arc.capacity_rate) for arc in arcs]
        constant = all(rate.strides[-1] == 0 for rate in rates)
        table = np.array(rates).reshape(len(arcs), network.episode.horizon)
        self._rates = table[:, :1] if constant else table
        numbers = numbers_of(ranges, "arcs", "capacity_rate")
        originals = [network.original(arc.id) for arc in arcs]  # a substance is limited as all of it is
        self._factors = RowFactors({n: numbers[id_] for n, id_ in enumerate(originals) if id_ in numbers})

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(len(self.arcs))

    def cut(self, rate: Floats, stock: Floats, step: Integers | None, factors: Floats | None) -> None:
        """Cut the rates of arcs, shape (arcs, B), in place, to what ``stock``, shape (masses, B), lets them carry."""
        limit = self._stock_sum(stock) * self._factors(self._rates_in(step), factors)
        rate[self.arcs] = np.minimum(rate[self.arcs], limit)

    def pull_back(
        self,
        rate: Floats,
        stock: Floats,
        step: Integers,
        factors: Floats | None,
        adjoint: Floats,
        stock_adjoint: Floats,
        factor_adjoint: Floats | None,
    ) -> None:
        """Turn the adjoint of rates that were cut into that of stocks and of the factors, in place.

        Args:
            rate: before they were cut, shape (arcs, B).
            stock: at the start of the interval, shape (masses, B).
            step: the interval of each copy, shape (B,).
            factors: on numbers that are not certain, shape (numbers, B).
            adjoint: of the rates that were carried; becomes that of those asked for.
            stock_adjoint: to which is added what the limits bring.
            factor_adjoint: likewise, if there are factors.
        """
        rates, stocks = self._rates_in(step), self._stock_sum(stock)
        limit_rates = self._factors(rates, factors)
        by_limit = np.where(stocks * limit_rates < rate[self.arcs], adjoint[self.arcs], 0.0)
        adjoint[self.arcs] -= by_limit
        self._stock_sum.transpose().add_to(stock_adjoint, by_limit * limit_rates)
        if factor_adjoint is not None:
            self._factors.pull_back(np.broadcast_to(rates, stocks.shape) * stocks, by_limit, factor_adjoint)

    def _rates_in(self, step: Integers | None) -> Floats:
        """Return c in the interval of each copy, in the first one without it."""
        if step is None or self._rates.shape[1] == 1:
            return self._rates[:, :1]
        return self._rates.take(step, axis=1)
