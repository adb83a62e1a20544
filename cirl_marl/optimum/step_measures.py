"""What rows of the program of a small step read off an episode: services, contents, what runs empty, the imbalance."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from scipy import sparse

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.window_simulator import service_measures


@positional_record
class ContentMeasure:
    """What a service of a content reads, and the ends of its band."""

    service: Annotated[int, "its number"]
    part: Annotated[Floats, "what reads its substance off rows of Jacobians, shape (rows,)"]
    whole: Annotated[Floats, "what reads all of it, likewise"]
    least: Annotated[Floats, "lower end, shape (steps,)"]
    most: Annotated[Floats, "upper end, likewise"]

    def row(self, t: int, level: float, end: Floats, response: Floats) -> tuple[Floats, float, float]:
        """Return what bounds its level in interval t to first order: of every action so far, the limit, of the level.

        Args:
            t: the interval.
            level: around which products of it are taken.
            end: what the interval ends with, shape (rows,).
            response: of that to a unit of every action so far, shape (rows, actions).
        """
        mass, total = float(self.part @ end), float(self.whole @ end)
        least, most = self.least[t], self.most[t]
        if math.isfinite(most) and mass >= least * total:
            # level·part ≤ most·whole, to first order: part·level + level₀·δpart − most·δwhole ≤ most·whole
            return (level * self.part - most * self.whole) @ response, most * total, mass
        # level·least·whole ≤ part
        return (level * least * self.whole - self.part) @ response, mass, least * total


@positional_record
class Measures:
    """What rows read off stocks and mean flows.

    Read are each service; stocks that scheduled flows leave, as no others could become negative to first order; less
    each service whose band has an upper end; and where |φ| counts, −φ and φ, the imbalance, of flows.
    """

    table: Annotated[Floats, "of stocks and mean flows, shape (measures, stores + arcs)"]
    by_stage: Annotated[Floats, "of rows of Jacobians, shape (measures, rows)"]
    low: Annotated[Floats, "with how much of a service its band begins, shape (services, steps)"]
    high: Annotated[Floats, "with how much its band ends, infinite where it does not, likewise"]
    ends: Annotated[Integers, "services that are read once more, whose band ends"]
    contents: Annotated[list[ContentMeasure], "services of contents, of which ``table`` reads masses alone"]
    is_absolute: Annotated[bool, "whether |φ| counts"]

    @classmethod
    def of(cls, network: Network, dynamics: Dynamics, period: slice, margin: Floats | float) -> Measures:
        """Find them for intervals of a network.

        Args:
            network: the network.
            dynamics: of it.
            period: the intervals.
            margin: by how much more than that bands begin later, relative to it, shape (services, steps).
        """
        stores, arcs = len(network.stores), len(network.arcs)
        columns = np.eye(stores + arcs)
        services = [
            columns[[network.node_index[node] for node in service.providers]].sum(axis=0)
            if service.quantity == "stock"
            else columns[stores + network.service_arcs(service)].sum(axis=0)
            for service in network.services
        ]
        donors = np.unique(network.donors[dynamics.is_scheduled[:arcs]])
        is_absolute = network.objective.net_zero == "abs"
        low, high = (
            np.array([network.interval_means(end)[period] for end in ends]).reshape(
                len(services), period.stop - period.start
            )
            for ends in ([s.low for s in network.services], [s.high for s in network.services])
        )
        is_plain = np.array([not service.substance for service in network.services], dtype=bool)
        ends = np.flatnonzero(np.isfinite(high).all(axis=1) & is_plain)
        rows = [*services, *columns[donors[donors < stores]], *(-services[s] for s in ends)]
        if is_absolute:
            rows += [sign * np.append(np.zeros(stores), -network.circularity_weights[1]) for sign in (-1.0, 1.0)]
        table = np.array(rows).reshape(-1, len(columns))
        nodes = dynamics.rows.nodes.stop
        by_stage = np.zeros((len(table), nodes + arcs * dynamics.rows.components))
        for store in range(stores):
            by_stage[:, np.atleast_1d(dynamics.rows.stages.get(store, store))] = table[:, [store]]
        by_stage[:, nodes : nodes + arcs] = table[:, stores:]
        part, whole = service_measures(network, dynamics)
        contents = [
            ContentMeasure(s, part[s], whole[s], low[s], high[s])
            for s, service in enumerate(network.services)
            if service.substance
        ]
        return cls(table, by_stage, low * (1.0 + margin), high, ends, contents, is_absolute)

    def rows(
        self, t: int, levels: Floats, end: Floats, response: Floats, furthest: Floats
    ) -> tuple[sparse.csr_array, Floats, Integers]:
        """Return rows of interval t, their limits, and which measures they are of: those that a step can come to.

        low·level − δq ≤ q, −δx ≤ x and ±(φ + δφ) ≤ imbalance, with q, x and φ those of the episode. Above a band the
        level is high/q, a convex function, which lies above its tangent where m = max(q, high)::

            m²/high·level + δq ≤ 2 m − q.

        Args:
            t: the interval.
            levels: around which products with contents are taken, shape (services,).
            end: what the interval ends with, shape (rows of Jacobians,).
            response: of that to a unit of every action so far, shape (rows of Jacobians, actions).
            furthest: most that each of these changes, shape (actions,).

        Returns:
            Shapes (rows, actions + services + 1), of actions, levels and the imbalance; (rows,); (rows,).
        """
        services = len(self.low)
        table, limit, own = -self.by_stage @ response, self.by_stage @ end, np.zeros((len(self.table), services + 1))
        own[np.arange(services), np.arange(services)] = self.low[:, t]
        last = len(table) - 2 * self.is_absolute
        for row, s in zip(range(last - len(self.ends), last), self.ends, strict=True):
            high, quantity = self.high[s, t], -limit[row]
            most = max(quantity, high)
            limit[row], own[row, s] = 2.0 * most - quantity, most**2 / high
        for content in self.contents:
            s = content.service
            table[s], limit[s], own[s, s] = content.row(t, levels[s], end, response)
        is_near = abs(table) @ furthest > limit - own.sum(axis=1)
        if self.is_absolute:
            own[-2:, -1], is_near[-2:] = -1.0, True
        near = np.flatnonzero(is_near)
        return sparse.csr_array(np.concatenate([table, own], axis=1)[near]), limit[near], near
