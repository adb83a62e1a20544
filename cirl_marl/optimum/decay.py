"""How fast stocks can fall: rows of theorem 2 of docs/bound.md.

Within a piece ẋ ≥ −k x − U, with k the greatest rate of the proportional exits and U the scheduled outflow less the
scheduled inflow, so y(s) = e^{ks} (x(s) + U (1 − e^{−ks})/k) never falls. Weighted with B_i(s) e^{−ks} its means rise
with i::

    x_start ≤ X̃_0/ω_0 ≤ … ≤ X̃_d/ω_d ≤ x̃_end/e^{−kδ},    X̃_i = X_i + U η_i,

with ω_i the mean of e^{−ks} and η_i that of (1 − e^{−ks})/k, weighted with B_i. Controls are constant within a piece,
so (w − w̲)·x and (w̄ − w)·x obey the same, with the scheduled outflow times the range of w.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse, special

from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.admissible import IntervalRanges
from cirl_marl.optimum.matrices import ProgramRows


def decay_rows(ranges: IntervalRanges, rows: ProgramRows) -> None:
    """Add the rows of theorem 2 on an interval, each at most 0; their keys are (1, node, piece, quantity, i)."""
    network, layout, driver = ranges.network, rows.layout, ranges.driver
    # what recipients pull may make a stock fall faster than in proportion to it
    pull_donors = network.donors[~ranges.by_schedule & (driver != network.donors)]
    nodes = np.setdiff1d(driver[~ranges.by_schedule], pull_donors)
    nodes = nodes[nodes < len(network.stores)]
    if not len(nodes):
        return
    chains = _DecayChains(ranges, rows)
    chains.write_stocks(nodes)
    position = np.full(len(network.nodes), -1)
    position[layout.valves] = np.arange(len(layout.valves))
    through = np.intersect1d(layout.valves, nodes)
    column = layout.valve[0] + position[through]
    chains.write_factors(through, 0 * through, column, through, ranges.valve[:, through], 1.0)
    arcs = np.setdiff1d(np.flatnonzero(np.isin(driver, nodes) & ranges.proportional), ranges.followers)
    driver = driver[arcs]
    # behind a valve that several outflows share the driver is Z, else X
    behind = (position[driver] >= 0) & (network.donors[arcs] == driver)
    chains.write_factors(
        driver,
        1 + arcs,
        layout.flow[0] + arcs,
        np.where(behind, layout.valve[0] + position[driver], driver),
        np.where(behind, ranges.setting[:, arcs] * ranges.base[arcs], ranges.rate[:, arcs]),
        np.where(behind, ranges.valve[1, driver], 1.0),
    )


class _DecayChains:
    """Writes that weighted means of something which falls at most like e^{−ks}, but for U, rise with i.

    ``means`` are ω_0 … ω_d, e^{−kδ} of each node and ``delays`` η_0 … η_d, (1 − e^{−kδ})/k;
    ω_i = ₁F₁(i + 1; d + 2; −kδ).
    """

    def __init__(self, ranges: IntervalRanges, rows: ProgramRows) -> None:
        layout = rows.layout
        rate, d = ranges.exits[1], layout.degree
        i, turnover = np.arange(d + 1), (rate * layout.length)[:, None]
        self.means = np.concatenate([special.hyp1f1(i + 1, d + 2, -turnover), np.exp(-turnover)], axis=1)
        # where this cancels, the mean of s − ks²/2; what follows is below round-off
        first, second = np.append((i + 1) / (d + 2), 1.0), np.append((i + 1) * (i + 2) / ((d + 2) * (d + 3)), 1.0)
        slow = (first - turnover * second / 2) * layout.length
        self.delays = np.divide(1.0 - self.means, rate[:, None], out=slow, where=turnover >= 1e-6)
        self.layout, self.rows = layout, rows
        self.first = np.arange(layout.pieces) * (d + 1)  # moment of each piece
        network, arcs, shape = ranges.network, np.flatnonzero(ranges.by_schedule), (len(rate), len(ranges.driver))
        self.outflow = sparse.csr_array((np.ones(len(arcs)), (network.donors[arcs], arcs)), shape=shape)
        # of what enters a lifetime a part may leave at once
        into = np.setdiff1d(arcs, np.flatnonzero(np.isin(network.recipients, network.donors[ranges.leaves_lifetime])))
        inflow = sparse.csr_array((np.ones(len(into)), (network.recipients[into], into)), shape=shape)
        self.net_outflow = self.outflow - inflow

    def write_stocks(self, nodes: Integers) -> None:
        """Write the chain of each stock from the start of a piece to its end."""
        layout, rows, d = self.layout, self.rows, self.layout.degree
        piece, moment = np.arange(layout.pieces)[:, None], self.first[:, None]
        means, delays = self.means[nodes], self.delays[nodes]
        start = rows.add(1, nodes, piece, -1)
        rows.at_start(start, piece, nodes, means[:, 0])
        rows.put(start, layout.stock[moment] + nodes, -1.0)
        self._put_schedules(start, self.net_outflow[nodes], -delays[:, 0])
        self._write_steps(nodes, -1, [(nodes, 1.0)], self.net_outflow[nodes])
        end = rows.add(1, nodes, piece, -1, d + 1)
        ratio = means[:, d + 1] / means[:, d]  # (X_d + U η_d)/ω_d ≤ (x_end + U η_end)/e^{−kδ}, times e^{−kδ}
        rows.put(end, layout.stock[moment + d] + nodes, ratio)
        rows.put(end, layout.end[piece] + nodes, -1.0)
        self._put_schedules(end, self.net_outflow[nodes], ratio * delays[:, d] - delays[:, d + 1])

    def write_factors(
        self, nodes: Integers, quantity: Integers, column: Integers, driver: Integers, factor: Floats, scale: Any
    ) -> None:
        """Write the chains of (w − w̲)·x and (w̄ − w)·x, with w in ``factor`` and w·x and x in given columns.

        Args:
            nodes: whose stocks x are, times ``scale`` at the most.
            quantity: keys of the factors of each node, in their order.
            column: of w·x in the first moment.
            driver: of x.
            factor: w̲ and w̄, shape (2, …).
            scale: largest factor of the stock itself that is in x.
        """
        free = factor[0] < factor[1]
        nodes, quantity, column, driver = (part[free] for part in (nodes, quantity, column, driver))
        low, high = factor[:, free]
        spread = (high - low) * np.broadcast_to(scale, free.shape)[free]
        outflow = sparse.diags_array(spread) @ self.outflow[nodes]
        self._write_steps(nodes, 2 * quantity, [(column, 1.0), (driver, -low)], outflow)
        self._write_steps(nodes, 2 * quantity + 1, [(column, -1.0), (driver, high)], outflow)

    def _write_steps(
        self, nodes: Integers, quantity: int | Integers, terms: list[tuple[Integers, Any]], outflow: Any
    ) -> None:
        """Write ω_{i+1}/ω_i·q_i − q_{i+1} − U·(…) ≤ 0 for q a sum of columns of a moment, each with a weight."""
        layout, rows = self.layout, self.rows
        piece, moment = np.arange(layout.pieces)[:, None], self.first[:, None]
        means, delays = self.means[nodes], self.delays[nodes]
        for i in range(layout.degree):
            # (q_i + U η_i)/ω_i ≤ (q_{i+1} + U η_{i+1})/ω_{i+1}, times ω_{i+1}
            ratio = means[:, i + 1] / means[:, i]
            row = rows.add(1, nodes, piece, quantity, i + 1)
            for column, weight in terms:
                rows.put(row, layout.stock[moment + i] + column, ratio * weight)
                rows.put(row, layout.stock[moment + i + 1] + column, -weight)
            self._put_schedules(row, outflow, ratio * delays[:, i] - delays[:, i + 1])

    def _put_schedules(self, row: Integers, outflow: Any, weight: Floats) -> None:
        """Put a weight, at most 0, times U into rows of shape (pieces, nodes), with U = ``outflow``·flows.

        In coarse pieces what is asked in the interval stands for it; a flow that may be cut is below it at times.
        """
        schedules = sparse.coo_array(outflow)
        place, arcs = schedules.row, schedules.col
        values = weight[place] * schedules.data
        moment = 0 * self.first if self.layout.coarse else self.first
        self.rows.put(row[:, place], self.layout.flow[moment[:, None]] + arcs, values)
        if self.layout.coarse:
            self.rows.loosen(row[:, place], arcs, np.abs(values))
