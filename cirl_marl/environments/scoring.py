"""Local rewards of compartments, service levels and the team's circularity."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cirl_marl.dynamics.uncertain_factors import RowFactors
from cirl_marl.environments.observations import ObservationLayout
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.rowsum import RowSum
from cirl_marl.network.series import Series
from cirl_marl.network.uncertainty import numbers_of


class Scoring:
    """Scores stocks and mean flows.

    The local reward of compartment c with quantity q (stock or throughput of a node, mean flow of an arc) is::

        r_c = −((q − set_point)/scale)² − Σ_s weight_s · shortfall_s,    s over the services that c owes

    plus the reward of its model, if it has one. Here shortfall = 1 − level, and the level of a service with band
    [low, high] is min(1, q/low, high/q), without q/low if low = 0.

    Args of all methods are compartment-major, shape (rows, B).
    """

    def __init__(self, network: Network, layout: ObservationLayout, agents: Sequence[str], batch: int) -> None:
        """Compile the scores of ``agents`` and of the network as a whole, for arrays of ``batch`` columns."""
        compartments = list(network.compartments.values())
        position = {c.id: i for i, c in enumerate(compartments)}
        tracked_ids = network.objective.tracked or [c.id for c in compartments if c.set_point is not None]
        with_set_point = [position[c] for c in tracked_ids]
        set_point = np.array([c.set_point or 0.0 for c in compartments])
        inverse_scale = 1.0 / np.array([c.scale for c in compartments])
        self._set_point = np.repeat(set_point[:, None], batch, axis=1)  # equal shapes are faster than a broadcast
        self._inverse_scale = np.repeat(inverse_scale[:, None], batch, axis=1)
        services = network.services
        self._measure = _measurement(network, layout)
        self._vary_in_time = any(isinstance(band, Series) for s in services for band in (s.low, s.high))
        width = network.episode.horizon if self._vary_in_time else 1
        bands = [
            np.array([network.interval_means(getattr(s, end))[:width] for s in services]) for end in ("low", "high")
        ]
        self._low, self._high = (band.reshape(len(services), width) for band in bands)
        self._factors = [
            RowFactors({row: numbers[s.id] for row, s in enumerate(services) if s.id in numbers})
            for numbers in (numbers_of(network, "services", end) for end in ("low", "high"))
        ]
        self._has_high = bool(np.isfinite(self._high).any())
        with_model = [position[c.id] for c in compartments if c.model is not None]
        count = len(compartments)
        terms = count + len(services) + len(with_model)
        debts = [(position[d], count + i, s.weight) for i, s in enumerate(services) for d in s.debtors]
        inner = range(count + len(services), terms)
        owners = np.array([*with_set_point, *(owner for owner, _, _ in debts), *with_model], dtype=np.intp)
        columns = np.array([*with_set_point, *(term for _, term, _ in debts), *inner], dtype=np.intp)
        weights = np.array(
            [*[1.0] * len(with_set_point), *(weight for _, _, weight in debts), *[-1.0] * len(with_model)]
        )
        self._by_compartment = RowSum(owners, columns, -weights, (len(compartments), terms))
        self._by_agent = self._by_compartment.select_rows([position[agent] for agent in agents])
        sums = self._by_compartment.column_sums()
        nonzero = np.flatnonzero(sums)
        self._total = RowSum(np.zeros(len(nonzero), dtype=np.intp), nonzero, sums[nonzero], (1, terms))
        rows, shape = range(len(services)), (1, len(services))
        self._weighted_shortfall = RowSum([0] * len(services), rows, [s.weight for s in services], shape)
        self._sum_of_levels = RowSum([0] * len(services), rows, 1.0, shape)

    def levels(self, quantities: Floats, step: Integers, factors: Floats | None = None) -> Floats:
        """Return the level of each service in [0, 1], shape (services, B), in the interval ``step`` of each copy.

        ``factors`` are those on the uncertain numbers, shape (numbers, B), if any were drawn.
        """
        quantity = self._measure(quantities)
        low, high = self._low, self._high
        if self._vary_in_time:
            low, high = low.take(step, axis=1), high.take(step, axis=1)
        low, high = (scale(band, factors) for scale, band in zip(self._factors, (low, high), strict=True))
        level: Floats = np.divide(quantity, low, out=np.ones_like(quantity), where=low > 0)
        if self._has_high:
            np.divide(high, quantity, out=level, where=quantity > high)
        np.minimum(level, 1.0, out=level)
        return np.maximum(level, 0.0, out=level)

    def terms(self, quantities: Floats, levels: Floats, inner: Floats) -> Floats:
        """Return every squared scaled distance, service shortfall and model's reward, shape (terms, B)."""
        count, services = len(self._set_point), len(levels)
        terms = np.empty((count + services + len(inner), quantities.shape[1]))
        distance = terms[:count]
        np.subtract(quantities[:count], self._set_point, out=distance)
        distance *= self._inverse_scale
        distance *= distance
        np.subtract(1.0, levels, out=terms[count : count + services])
        terms[count + services :] = inner
        return terms

    def local(self, terms: Floats) -> Floats:
        """Return the local reward of each agent, shape (agents, B)."""
        return self._by_agent(terms)

    def local_of_all(self, terms: Floats) -> Floats:
        """Return the local reward of each compartment, nodes first, shape (nodes + arcs, B)."""
        return self._by_compartment(terms)

    def local_sum(self, terms: Floats) -> Floats:
        """Return the sum of the local rewards of all compartments, shape (B,)."""
        total: Floats = self._total(terms)[0]
        return total

    def shortfall(self, levels: Floats) -> Floats:
        """Return Σ_s weight_s · (1 − level_s), shape (B,)."""
        total: Floats = self._weighted_shortfall(1.0 - levels)[0]
        return total

    def service_level(self, levels: Floats) -> Floats:
        """Return the mean level over the services, shape (B,); 1 for a network that owes none."""
        if len(levels) == 0:
            return np.ones(levels.shape[1])
        total: Floats = self._sum_of_levels(levels)[0]
        total /= len(levels)
        return total


def _measurement(network: Network, layout: ObservationLayout) -> RowSum:
    """Matrix that reads each service off the quantities, shape (services, quantities)."""
    rows, columns = [], []
    for row, service in enumerate(network.services):
        if service.quantity == "outflow":
            quantities = [layout.signals.flows.start + int(k) for k in network.service_arcs(service)]
        else:
            quantities = [layout.row(c, service.quantity, service.measure) for c in service.providers]
        rows += [row] * len(quantities)
        columns += quantities
    return RowSum(rows, columns, 1.0, (len(network.services), layout.signals.quantities))
