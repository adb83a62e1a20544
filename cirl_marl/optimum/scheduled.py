"""Rows of the program about scheduled flows: what their donors can deliver, and the valves that act on them."""

from __future__ import annotations

from typing import Any

import numpy as np

from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout
from cirl_marl.optimum.reach import Reach
from cirl_marl.optimum.rows import ProgramRows


def deliveries(admissible: Admissible, layout: Layout, step: int, rows: ProgramRows) -> None:
    """Add U·δ − x_start·z/(e^z − 1), at most 0, for the scheduled outflow U of each node; keys (0, piece, node).

    This is how the simulator cuts scheduled flows, with z = a·δ for the proportional exits of rate a; the least a gives
    the most. What flows in during the piece is not available to them. Of coarse pieces nothing is said.
    """
    if layout.coarse:
        return
    network = admissible.network
    turned_over = admissible.exits(step)[0] * layout.length
    # U·δ ≤ x_start·z/(e^z − 1); the factor falls with z, so the least rate of the exits gives the weakest, valid row
    share = np.divide(turned_over, np.expm1(turned_over), out=np.ones(len(turned_over)), where=turned_over > 1e-9)
    arcs = np.flatnonzero(admissible.scheduled)
    nodes, place = np.unique(network.donors[arcs], return_inverse=True)
    piece = np.arange(layout.pieces)[:, None]
    row = rows.add(0, piece, nodes)
    rows.put(row[:, place], layout.flow(piece * (layout.degree + 1)) + arcs, 1.0)
    rows.at_start(row, piece, nodes, -share[nodes] / layout.length)


def orders(admissible: Admissible, layout: Layout, equal: ProgramRows, under: ProgramRows) -> None:
    """Add that a scheduled flow is constant in its piece, F_i = F_0; keys (0, moment, 0, arc, side).

    If pieces are coarse, a flow that nothing can cut is constant in the interval.
    """
    moment, arcs = layout.moment_column, np.flatnonzero(admissible.scheduled)
    first = 0 * moment if layout.coarse else moment - moment % (layout.degree + 1)
    later = (moment > first).ravel()
    for rows, side, sign in ((under, 0, 1.0), (under, 1, -1.0)) if layout.coarse else ((equal, 0, 1.0),):
        row = rows.add(0, moment[later], 0, arcs, side)
        rows.put(row, layout.flow(moment[later]) + arcs, sign)
        rows.put(row, layout.flow(first[later]) + arcs, -sign)
        if layout.coarse:
            rows.loosen(row, arcs, 1.0)


def openings(admissible: Admissible, reached: Reach, layout: Layout, intervals: range) -> tuple[Any, Floats]:
    """Return the rows, and their right-hand sides, of valves that act on stock-driven and on scheduled outflows.

    A scheduled flow is at most ū·v. With v ≤ v̄ and X ≤ x̄, (v̄ − v)(x̄ − X) ≥ 0 gives v̄ X + x̄ v − Z ≤ v̄ x̄, and
    (v − v̲)(x̄ − X) ≥ 0 gives Z − v̲ X − x̄ v ≤ −v̲ x̄ (McCormick 1976).
    """
    network, steps = admissible.network, len(intervals)
    when = slice(intervals.start, intervals.stop)
    t = np.arange(steps)[:, None]
    rows = ProgramRows(layout, steps)
    limits: list[Floats] = []
    nodes, opening = layout.openings, layout.opening + np.arange(len(layout.openings))
    through, most = np.searchsorted(layout.valves, nodes), reached.upper[:, nodes]
    low, high = admissible.valve[:, when, nodes]
    for i in layout.moments:
        for side, (x, z, v, to) in enumerate(((high, -1.0, most, high * most), (-low, 1.0, -most, -low * most))):
            row = rows.add(t, nodes, 0, i, side)
            rows.put(row, t * layout.size + layout.stock(i) + nodes, x)
            rows.put(row, t * layout.size + layout.valve(i) + through, z)
            rows.put(row, t * layout.size + opening, v)
            limits.append(to.ravel())
    arcs = np.flatnonzero(admissible.scheduled & np.isin(network.donors, nodes))
    donors = network.donors[arcs]
    capacity = admissible.own[1, when, arcs].T * admissible.base[when, arcs]
    for piece in range(layout.pieces):
        row = rows.add(t, donors, 1 + arcs, piece)
        rows.put(row, t * layout.size + layout.flow(piece * (layout.degree + 1)) + arcs, 1.0)
        rows.put(row, t * layout.size + opening[np.searchsorted(nodes, donors)], -capacity)
        limits.append(np.zeros(row.size))
    opened = rows.matrices()[0]
    opened.eliminate_zeros()
    return opened, rows.in_order(limits)
