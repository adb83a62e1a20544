"""Constraints of the linear program on stocks and flows: balances, flow laws, shares, schedules, idle supplies."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence
from typing import Any

import numpy as np

from cirl_marl.network import Floats, Integers
from cirl_marl.network.split_fractions import Split
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.matrices import Layout, ProgramRows
from cirl_marl.optimum.reach import Reach


def balances(layout: Layout, rows: ProgramRows) -> None:
    """Add Y_i − Y_{i−1} − δ/(d + 1)·S F_i, which is 0, for i = 0 … d (theorem 1); keys (moment, node).

    Y_i = ((d − i) X_i + (i + 1) X_{i+1})/(d + 1) are the means weighted with the polynomials of degree d − 1;
    Y_{−1} and Y_d are the stocks at the two ends of the piece, δ its length.
    """
    network, d = layout.network, layout.degree
    moment, node = layout.moment_column, np.arange(len(network.stores))
    row = rows.add(moment, node)
    for side, sign in ((network.donors, 1.0), (network.recipients, -1.0)):
        arcs = np.flatnonzero(side < len(node))
        rows.put(row[:, side[arcs]], layout.flow(moment) + arcs, sign * layout.portion)
    for j in layout.moments:
        piece, i = divmod(j, d + 1)
        if i < d:  # Y_i
            rows.put(row[j], layout.stock(j) + node, (d - i) / (d + 1))
            rows.put(row[j], layout.stock(j + 1) + node, (i + 1) / (d + 1))
        else:
            rows.put(row[j], layout.end(piece) + node, 1.0)
        if i > 0:  # − Y_{i−1}
            rows.put(row[j], layout.stock(j - 1) + node, -(d - i + 1) / (d + 1))
            rows.put(row[j], layout.stock(j) + node, -i / (d + 1))
        else:
            rows.at_start(row[j], piece, node, -1.0)


def flow_laws(admissible: Admissible, layout: Layout, step: int, equal: ProgramRows, under: ProgramRows) -> None:
    """Add the flow laws of an interval: rows that are 0 and rows at most 0; keys (0, moment, what, which, side)."""
    network, moment = admissible.network, layout.moment_column

    def hold(what: int, which: Integers, column: Integers, driver: Integers, factor: Floats) -> None:
        """Hold low·driver ≤ column ≤ high·driver, with columns of shape (moments, which)."""
        low, high = factor
        given = low == high
        row = equal.add(0, moment, what, which[given])
        equal.put(row, column[:, given], 1.0)
        equal.put(row, driver[:, given], -low[given])
        for side, sign, bound in ((0, 1.0, high), (1, -1.0, low)):
            row = under.add(0, moment, what, which[~given], side)
            under.put(row, column[:, ~given], sign)
            under.put(row, driver[:, ~given], -sign * bound[~given])

    valves, driven = layout.valves, ~admissible.scheduled & ~admissible.lived
    arcs = np.setdiff1d(np.flatnonzero(driven), followers(admissible, step))
    place = np.arange(len(valves))
    hold(1, place, layout.valve(moment) + place, layout.stock(moment) + valves, admissible.valve[:, step, valves])
    # behind a valve that several outflows share F_i = w·a·Z_i with Z_i = v·X_i; else F_i = v·w·a·X_i
    driver = admissible.driver[arcs]
    through = (network.donors[arcs] == driver) & np.isin(driver, valves)
    factor = np.where(through, admissible.own[:, step, arcs], admissible.factor[:, step, arcs])
    behind = layout.valve(moment) + np.searchsorted(valves, driver)
    column = np.where(through, behind, layout.stock(moment) + driver)
    hold(2, arcs, layout.flow(moment) + arcs, column, factor * admissible.base[step, arcs])


def held_controls(admissible: Admissible, layout: Layout, step: int, rows: ProgramRows) -> None:
    """Add F_i − F_{i−1} − r (X_i − X_{i−1}), r = v·w·a at neutral, and the same for Z; keys (1, moment, what, which).

    For a constant factor r' it is (r' − r)(X_i − X_{i−1}), a product of two differences, here held at 0.
    """
    moment = layout.moment_column[1:]
    free = ~admissible.scheduled & ~admissible.lived & (admissible.factor[0, step] < admissible.factor[1, step])
    arcs, valves = np.flatnonzero(free), np.arange(len(layout.valves))
    opened = admissible.neutral_valve[step, layout.valves]
    parts = (
        (0, arcs, layout.flow, arcs, admissible.driver[arcs], admissible.neutral_rate[step, arcs]),
        (1, valves, layout.valve, valves, layout.valves, opened),
    )
    for what, which, first, place, driver, rate in parts:
        row = rows.add(1, moment, what, which)
        for at, sign in ((moment, 1.0), (moment - 1, -1.0)):
            rows.put(row, first(at) + place, sign)
            rows.put(row, layout.stock(at) + driver, -sign * rate)


def throughputs(admissible: Admissible, layout: Layout, step: int, rows: ProgramRows) -> None:
    """Add what holds of shares in an interval, each 0; keys (2, moment, what, which).

    What enters a node that stores nothing is its throughput Q, and so is what leaves it. The shares of what a stock
    releases sum to the release. Arcs without control keep their proportions. Where all shares are given, the flow laws
    say it already.
    """
    network, moment = admissible.network, layout.moment_column
    stores, nodes, arcs = len(network.stores), len(network.nodes), np.arange(len(network.arcs))
    row = np.full((len(layout.moments), nodes), -1)
    row[:, stores:] = rows.add(2, moment, 0, np.arange(stores, nodes))
    entering = network.recipients >= stores
    rows.put(row[:, network.recipients[entering]], layout.flow(moment) + arcs[entering], 1.0)
    rows.put(row[:, stores:], layout.stock(moment) + np.arange(stores, nodes), -1.0)
    for split in admissible.divided(step):
        donor = network.node_index[split.donor]
        out = np.array([*split.controlled_arcs, *split.other_arcs])
        total = rows.add(2, moment, 1, donor)
        rows.put(total, layout.flow(moment) + out, 1.0)
        rows.put(total, *_released(admissible, layout, step, donor, int(out[0])))
        lead, followers, ratio = leader(split, step)
        kept = rows.add(2, moment, 2, followers)
        rows.put(kept, layout.flow(moment) + followers, 1.0)
        rows.put(kept, layout.flow(moment) + lead, -ratio)


def _released(admissible: Admissible, layout: Layout, step: int, donor: int, arc: int) -> tuple[Integers, float]:
    """Return the columns, shape (moments, 1), of what is released, and minus the factor of it, of a donor's shares."""
    release = -float(admissible.base[step, arc])
    place = np.flatnonzero(layout.valves == donor)
    if len(place):
        return layout.valve(layout.moment_column) + place, release
    return layout.stock(layout.moment_column) + donor, release * float(admissible.valve[0, step, donor])


def leader(split: Split, step: int) -> tuple[int, Integers, Floats]:
    """Return the greatest of the arcs without control, the others of them, and these as parts of the greatest."""
    proportions = split.proportions[:, step]
    first = int(proportions.argmax())
    rest = np.arange(len(proportions)) != first
    return (
        split.other_arcs[first],
        np.array(split.other_arcs, dtype=np.intp)[rest],
        proportions[rest] / proportions[first],
    )


def followers(admissible: Admissible, step: int) -> Integers:
    """Return the arcs whose flows follow from one with which they share what others leave."""
    found: Sequence[Integers] = [leader(split, step)[1] for split in admissible.divided(step)]
    return np.concatenate([np.zeros(0, dtype=np.intp), *found])


def delivery_limits(admissible: Admissible, layout: Layout, step: int, rows: ProgramRows) -> None:
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


def constant_schedules(admissible: Admissible, layout: Layout, equal: ProgramRows, under: ProgramRows) -> None:
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


def valve_envelopes(admissible: Admissible, reached: Reach, layout: Layout, intervals: range) -> tuple[Any, Floats]:
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


def idle_supplies(admissible: Admissible, reached: Reach, layout: Layout, intervals: range) -> tuple[Any, Floats]:
    """Return the rows, and their right-hand sides, of arcs that make up for the same service while nobody acts on them.

    They are asked for u_k = min(low_k + w_k V, high_k) with one V ≥ 0. Let r be the one that is the last to come to its
    bound, so that V = (u_r − low_r)/w_r. As u_k is concave in V, it lies below its tangent at 0 and above its chord:

        u_k − low_k ≤ w_k/w_r·(u_r − low_r),    u_k − low_k ≥ (high_k − low_k)/(high_r − low_r)·(u_r − low_r).

    Where a donor may deliver less than it is asked for, there is room for all that may be asked.
    """
    when = slice(intervals.start, intervals.stop)
    rows, limits = ProgramRows(layout, len(intervals)), list[Floats]()
    starts = [layout.flow(piece * (layout.degree + 1)) for piece in range(layout.pieces)]
    starts += [layout.end_flow(piece) for piece in range(layout.pieces)] if layout.merged else []
    low, high = admissible.own[:, when]
    missed = np.where(reached.uncut, 0.0, high)
    t = np.arange(len(intervals))[:, None]
    for arcs in _together(admissible):
        weight = np.array([_weight(admissible, k) for k in arcs])
        room = np.where(weight > 0, (high - low)[:, arcs], 0.0)  # of weight 0 never more than the least
        lasts = np.divide(room, weight, out=np.full_like(room, -1.0), where=weight > 0)
        place = lasts.argmax(axis=1)[:, None]
        last, chord = np.array(arcs)[place], np.zeros_like(room)
        np.divide(room, room[t, place], out=chord, where=room[t, place] > 0)
        tangent = np.broadcast_to(weight / weight[place], room.shape)
        for at, start in enumerate(starts):
            for side, sign, slope in ((0, 1.0, tangent), (1, -1.0, chord)):
                row = rows.add(t, arcs, at, side)
                rows.put(row, t * layout.size + start + arcs, sign)
                rows.put(row, t * layout.size + start + last, -sign * slope)
                room_left = slope * missed[t, last] if side == 0 else missed[:, arcs]
                limits.append((sign * (low[:, arcs] - slope * low[t, last]) + room_left).ravel())
    supplied = rows.matrices()[0]
    supplied.eliminate_zeros()
    return supplied, rows.in_order(limits)


def _together(admissible: Admissible) -> list[list[int]]:
    """Return the idle arcs of each service that several make up for, but where a valve of a donor acts as well."""
    network, found = admissible.network, defaultdict[str, list[int]](list)
    for k, arc in enumerate(network.arcs):
        if arc.makes_up_for and arc.id not in admissible.agents:
            found[arc.makes_up_for].append(k)
    valves = admissible.valve[:, :, network.donors]
    return [
        arcs
        for arcs in found.values()
        if len(arcs) > 1 and any(_weight(admissible, k) for k in arcs) and (valves[:, :, arcs] == 1.0).all()
    ]


def _weight(admissible: Admissible, arc: int) -> float:
    weight = admissible.network.arcs[arc].weight
    return 1.0 if weight is None else weight
