"""Rows of the program about scheduled flows: what their donors can deliver, and the valves that act on them."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse

from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout, Link, MatrixRow, matrix_of, start_of
from cirl_marl.optimum.reach import Reach


def deliveries(admissible: Admissible, layout: Layout) -> list[Link]:
    """Return U·δ − x_start·z/(e^z − 1), which is at most 0, for the scheduled outflow U of each node in each piece.

    This is how the simulator cuts scheduled flows, with z = a·δ for the proportional exits of rate a; the least a gives
    the most. What flows in during the piece is not available to them.
    """
    network = admissible.network
    by_donor = admissible.driver == network.donors
    least = np.bincount(network.donors, weights=admissible.rate(0)[0] * by_donor, minlength=len(network.nodes))
    turned_over = least * layout.length
    # U·δ ≤ x_start·z/(e^z − 1); the factor falls with z, so the least rate of the exits gives the weakest, valid row
    share = np.divide(turned_over, np.expm1(turned_over), out=np.ones(len(least)), where=turned_over > 1e-9)
    links: list[Link] = []
    for piece in range(layout.pieces):
        first = layout.flow(piece * (layout.degree + 1))
        for node in np.unique(network.donors[admissible.scheduled]):
            orders = np.flatnonzero((network.donors == node) & admissible.scheduled)
            now, before = start_of(layout, piece, int(node), -float(share[node]) / (layout.length))
            links.append(([*((first + int(k), 1.0) for k in orders), *now], before))
    return links


def openings(admissible: Admissible, reached: Reach, layout: Layout, intervals: range) -> tuple[Any, Floats]:
    """Return the rows, and their right-hand sides, of valves that act on stock-driven and on scheduled outflows.

    A scheduled flow is at most ū·v. With v ≤ v̄ and X ≤ x̄, (v̄ − v)(x̄ − X) ≥ 0 gives v̄ X + x̄ v − Z ≤ v̄ x̄, and
    (v − v̲)(x̄ − X) ≥ 0 gives Z − v̲ X − x̄ v ≤ −v̲ x̄ (McCormick 1976).
    """
    network, steps = admissible.network, len(intervals)
    fixed: list[MatrixRow] = []
    columns: list[int] = []
    weights, limits = [np.zeros((steps, 0))], [np.zeros((steps, 0))]

    def hold(row: MatrixRow, opening: int, weight: Floats, to: Floats) -> None:
        """Hold row + weight_t·v ≤ to_t in each interval t."""
        fixed.append(row)
        columns.append(opening)
        weights.append(weight[:, None])
        limits.append(to[:, None])

    for place, node in enumerate(layout.openings):
        opening, z = layout.opening + place, int(np.flatnonzero(layout.valves == node)[0])
        low, high = admissible.valve[:, node]
        most = reached.upper[:, node]
        for i in layout.moments:
            stock, through = layout.stock(i) + int(node), layout.valve(i) + z
            hold([(stock, high), (through, -1.0)], opening, most, high * most)
            hold([(through, 1.0), (stock, -low)], opening, -most, -low * most)
        for k in np.flatnonzero(admissible.scheduled & (network.donors == node)):
            capacity = admissible.own[1, k] * admissible.base[intervals.start : intervals.stop, k]
            for piece in range(layout.pieces):
                flow = layout.flow(piece * (layout.degree + 1)) + int(k)
                hold([(flow, 1.0)], opening, -capacity, np.zeros(steps))
    # x̄ and ū differ from interval to interval: the entries of v are laid in one by one, row (t, r), column of v in t
    varying = np.concatenate(weights, axis=1)
    entries = layout.size * np.arange(steps)[:, None] + np.array(columns, dtype=np.intp)
    shape = (varying.size, steps * layout.size)
    moving = sparse.csr_array((varying.ravel(), (np.arange(varying.size), entries.ravel())), shape=shape)
    return sparse.kron(sparse.eye_array(steps), matrix_of(fixed, layout), format="csr") + moving, np.concatenate(
        limits, axis=1
    ).ravel()
