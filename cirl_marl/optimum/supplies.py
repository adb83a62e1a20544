"""Rows of the program about idle supplies: those that make up for the same service do so in known proportions."""

from __future__ import annotations

from collections import defaultdict
from typing import Any

import numpy as np

from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout
from cirl_marl.optimum.reach import Reach
from cirl_marl.optimum.rows import ProgramRows


def supplies(admissible: Admissible, reached: Reach, layout: Layout, intervals: range) -> tuple[Any, Floats]:
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
