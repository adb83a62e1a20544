"""What a stock holds of what enters it: rows of theorem 2 of docs/bound.md, beside those of ``decay``.

Let at least k̲ and at most k̄ of a stock leave per time in proportion, by constant rates, beside other outflows o, and u
enter. As x ≥ 0, x lies between the solutions of ẋ = u − o − k x for k̄ and for k̲, which are linear in what was there
and in what enters since. Weighted with B_i these are kernels of u and o that polynomials of degree d enclose, c̲_ij and
c̄_ij being their Bernstein coefficients, and as u and o are not negative ::

    ω̲_i x_start + δ Σ_j (c̲_ij U_j − c̄_ij O_j) ≤ X_i ≤ ω̄_i x_start + δ Σ_j (c̄_ij U_j − c̲_ij O_j),

the left side for k̄, the right one for k̲, and ω_i the mean of e^{−ks}.
"""

from __future__ import annotations

import numpy as np

from cirl_marl.optimum.admissible import IntervalRanges
from cirl_marl.optimum.kernels import stock_response
from cirl_marl.optimum.matrices import ProgramRows

LEAST_TURNOVER, MOST_TURNOVER = 0.25, 256.0
"""Most that leaves of a stock in a piece, in parts of it, from which on it has rows, and up to which. Theorem 2 leaves
the means of slower ones little room: rows from 0.05 on bounded seeds 98, 104 and 110 of the cycles with lifetimes of
``benchmarks.yearly`` 2e-5 lower at most. Faster ones are what enters, divided by k."""


def response_rows(ranges: IntervalRanges, rows: ProgramRows) -> None:
    """Add them on an interval, each at most 0; keys (4, store, piece, i, side)."""
    network, layout = ranges.network, rows.layout
    stores = len(network.stores)
    exits = np.where(ranges.leaves_lifetime, ranges.rate, 0.0)
    lives = np.stack([np.bincount(network.donors, rate, len(network.nodes)) for rate in exits])
    turnover = np.maximum(ranges.exits - lives, 0.0)[:, :stores] * layout.length
    own = ranges.proportional & (ranges.driver == network.donors)
    piece = np.arange(layout.pieces)[:, None]
    moment = np.arange(layout.degree + 1)
    for store in np.flatnonzero((turnover[1] >= LEAST_TURNOVER) & (turnover[1] <= MOST_TURNOVER)).tolist():
        inflows = np.flatnonzero(network.recipients == store)
        others = np.flatnonzero((network.donors == store) & ~own)
        for side, sign in ((0, 1.0), (1, -1.0)):
            means, low, high = stock_response(float(turnover[side, store]), layout.degree)
            of_inflow, of_others = (high, low) if side == 0 else (low, high)
            row = rows.add(4, store, piece, moment, side)
            at = piece * (layout.degree + 1) + moment
            rows.put(row, layout.stock[at] + store, sign)
            rows.at_start(row, piece, store, -sign * means)
            for arcs, weight in ((inflows, -sign * of_inflow), (others, sign * of_others)):
                columns = layout.flow[at][:, None, :, None] + arcs
                rows.put(row[..., None, None], columns, layout.length * weight[..., None])
