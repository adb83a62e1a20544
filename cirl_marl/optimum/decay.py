"""How fast stocks can fall: rows of theorem 2 of docs/bound.md.

Within a piece ẋ ≥ −k x − U, with k the greatest rate of the proportional exits and U the scheduled outflow less the
scheduled inflow, so y(s) = e^{ks} (x(s) + U (1 − e^{−ks})/k) never falls. Weighted with B_i(s) e^{−ks} its means rise
with i::

    x_start ≤ X̃_0/ω_0 ≤ … ≤ X̃_d/ω_d ≤ x̃_end/e^{−kδ},    X̃_i = X_i + U η_i,

with ω_i the mean of e^{−ks} and η_i that of (1 − e^{−ks})/k, weighted with B_i. Controls are constant within a piece,
so (w − w̲)·x and (w̄ − w)·x obey the same, with the scheduled outflow times the range of w.

Of how much is left of what enters, these tell most if it enters at the start or the end of a piece. Where pieces are
merged, other sums of moments tell as much of what enters halfway (``contact_weights``). Without them seed 110 of the
cycles with lifetimes of ``benchmarks.yearly`` is bounded 2.3 % higher at degree 1, 0.5 % at degree 2.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse, special

from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.admissible import IntervalRanges
from cirl_marl.optimum.matrices import ProgramRows
from cirl_marl.optimum.quasi_steady import FAST


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
    if layout.coarse:
        chains.write_contacts(nodes[ranges.exits[1, nodes] * layout.length < FAST])
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
        i, self.turnovers = np.arange(d + 1), rate * layout.length
        turnover = self.turnovers[:, None]
        self.means = np.concatenate([_decay_means(self.turnovers, d), np.exp(-turnover)], axis=1)
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

    def write_contacts(self, nodes: Integers) -> None:
        """Write the sums of moments that tell most of what enters halfway through a piece."""
        layout, rows, d = self.layout, self.rows, self.layout.degree
        piece, moment = np.arange(layout.pieces)[:, None], self.first[:, None]
        for i in range(d):
            weights, start, end = contact_weights(self.turnovers[nodes], d, i)
            row = rows.add(1, nodes, piece, -2, i)
            for j in range(d + 1):
                rows.put(row, layout.stock[moment + j] + nodes, weights[:, j])
            rows.put(row, layout.end[piece] + nodes, -end)
            rows.at_start(row, piece, nodes, start)
            delay = (weights * self.delays[nodes, :-1]).sum(axis=1) - end * self.delays[nodes, -1]
            self._put_schedules(row, self.net_outflow[nodes], delay)

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


def contact_weights(turnovers: Floats, degree: int, i: int) -> tuple[Floats, Floats, Floats]:
    """Return c, a and b of Σ c_j X_j + a x_start ≤ b x_end, for stocks of which at most so much leaves in a piece.

    With r = (d + 1) Σ c_j B_j, on a piece of length 1, G(t) = ∫_t^1 r e^{−ks} ds and y = e^{ks} x, which never falls::

        Σ c_j X_j = ∫ r x ds = G(0) y(0) + ∫ G dy ≤ G(0) y(0) + max G·(y(1) − y(0))

    Here e^{kt} (max G − G(t)) is how far e^{kt} is from a polynomial that touches it i times at 0, twice at
    τ = (i + 1)/(d + 1) and d − 1 − i times at 1, so that no row says more of what enters at τ.
    """
    tau, rest, at_start, at_end = (i + 1) / (degree + 1), (degree - i) / (degree + 1), i > 0, i < degree - 1
    on_first = _on_first_part(tau, degree)
    before = tau * _decay_means(tau * turnovers, degree) @ on_first
    after = rest * _decay_means(rest * turnovers, degree) @ _on_first_part(rest, degree)[::-1, ::-1]  # times e^{kτ}
    # r is 0 at τ, and G there is what it is at 0 and at 1, if these are touched; there r has so many zeros less one
    conditions = [np.broadcast_to(on_first[-1], before.shape), *[before] * at_start, *[after] * at_end]
    free = slice(max(i - 1, 0), degree + 1 - max(degree - 2 - i, 0))
    weights = np.zeros_like(before)
    weights[:, free] = np.linalg.svd(np.stack(conditions, axis=1)[:, :, free])[2][:, -1]
    # G is greatest at τ if r is negative right before it
    weights *= np.sign(weights[:, [free.start]]) * (1.0 if at_start else -1.0)
    start = -(weights * before).sum(axis=1) * (not at_start)
    end = np.exp(rest * turnovers) * (weights * after).sum(axis=1) * (not at_end)
    return weights, start, end


def _decay_means(turnovers: Floats, degree: int) -> Floats:
    """Return ω_0 … ω_d, the means of e^{−ks} under B_0 … B_d, of each turnover kδ."""
    means: Floats = special.hyp1f1(np.arange(degree + 1) + 1, degree + 2, -turnovers[:, None])
    return means


def _on_first_part(tau: float, degree: int) -> Floats:
    """Return what B_0 … B_d are on [0, τ], as sums of the same polynomials there, shape (their sums, d + 1)."""
    j = np.arange(degree + 1)
    parts: Floats = special.binom(j[:, None], j) * tau**j * (1.0 - tau) ** np.maximum(j[:, None] - j, 0)
    return parts
