"""What holds of the components of a material together, in programs that follow contents.

Such a program moves what is no substance and each substance as materials of their own, each with controls of its own.
What flows in proportion to a stock or a throughput then obeys its laws exactly. Beside that

- a scheduled flow W = Σ_c F_c is asked for as a whole, u̲ ≤ W ≤ ū, of which donors deliver a part;
- it has the content of its donor, which always lies in a range: c̲ W ≤ F_c ≤ c̄ W;
- of a service that demands a content of at most h, level = min(1, h·ΣW/ΣF), so that ΣF − h·ΣW = (1 − level)·ΣF where
  that is positive, and at most (1 − level) times the greatest ΣF. Of at least l likewise l·ΣW − ΣF ≤ (1 − level)·l·ΣW.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Service
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.constraints import service_columns
from cirl_marl.optimum.matrices import Layout, ProgramRows
from cirl_marl.optimum.reach import Reach

NEGLIGIBLE = 1e-8
"""Part of a flow that is as good as none: rows with such entries say nothing that solvers could resolve."""


def mixture_rows(admissible: Admissible, reach: Reach, intervals: range, rows: ProgramRows) -> None:
    """Add the rows of flows of several components, over all intervals; keys (3, family, arc, …)."""
    mixtures, layout = admissible.mixtures, rows.layout
    assert mixtures is not None
    period, t = slice(intervals.start, intervals.stop), np.arange(len(intervals))[:, None]
    moments, starts = layout.moment_column.ravel(), t * layout.size + layout.flow
    rate = admissible.rate[:, period]
    several = (mixtures.content[1] > 0).sum(axis=0) > 1
    is_free = (rate[0] < rate[1]).any(axis=0)[mixtures.arcs].any(axis=0)
    for k in np.flatnonzero(several & is_free).tolist():
        arcs, (low, high) = mixtures.arcs[:, k], mixtures.parts(k, period)
        for component, arc in enumerate(arcs.tolist()):
            for side, sign, part in ((0, 1.0, high[component]), (1, -1.0, low[component])):
                within = np.broadcast_to((NEGLIGIBLE < part) & (part < 1.0 - NEGLIGIBLE), len(t))
                row = rows.add(3, 0, k, t[within], moments, 2 * component + side)
                rows.put(row, starts[within] + arc, sign)
                _put_whole(rows, row, starts[within], arcs, -sign * np.broadcast_to(part, len(t))[within, None])
    for place, k in enumerate(mixtures.scheduled.tolist()):
        if not (several[k] and is_free[k]):
            continue
        arcs, (least, most) = mixtures.arcs[:, k], mixtures.orders[:, period, place]
        delivered = reach.delivered[:, arcs].min(axis=1)
        for side, sign, limit in ((0, 1.0, most), (1, -1.0, -least * delivered)):
            row = rows.add(3, 1, k, t, moments, side)
            _put_whole(rows, row, starts, arcs, sign)
            rows.limit(row, limit[:, None])


def _put_whole(rows: ProgramRows, row: Integers, starts: Integers, arcs: Integers, value: ArrayLike) -> None:
    for arc in arcs.tolist():
        rows.put(row, starts + arc, value)


def content_rows(admissible: Admissible, high: Floats, intervals: range, rows: ProgramRows) -> None:
    """Add the rows of services that demand contents, over all intervals; keys (4, service, interval, side).

    Args:
        admissible: of the flows.
        high: upper bound of every variable, shape (steps, size).
        intervals: of the episode.
        rows: over them.
    """
    network, layout = admissible.network, rows.layout
    period, t = slice(intervals.start, intervals.stop), np.arange(len(intervals))
    names = [substance.id for substance in network.substances]
    for s, service in enumerate(network.services):
        if not service.substance:
            continue
        own = _weights(network, layout, service, 1 + names.index(service.substance))
        whole = _weights(network, layout, service)
        columns = np.flatnonzero(whole)
        bands = admissible.service_low[period, s], network.interval_means(service.high)[period]
        for side, sign, end in ((0, -1.0, bands[0]), (1, 1.0, bands[1])):
            if side and not (end < math.inf).any():  # grades have a row even so, as others may ask for more
                continue
            finite = end < math.inf
            end = np.where(finite, end, 0.0)
            most = finite * (high @ own) if side else end * (high @ whole)
            row = rows.add(4, s, t, side)
            excess = sign * (finite[:, None] * own[columns] - end[:, None] * whole[columns])
            rows.put(row[:, None], t[:, None] * layout.size + columns, excess)
            rows.put(row, t * layout.size + layout.level + s, most)
            rows.limit(row, most)


def _weights(network: Network, layout: Layout, service: Service, component: int | None = None) -> Floats:
    """Return what a service measures of the variables of an interval, of all components or of one, shape (size,)."""
    weights = np.zeros(layout.size)
    for at_end, column in service_columns(network, service, component):
        if at_end:
            weights[layout.end[-1] + column] += 1.0
        else:
            weights[layout.flow + column] += 1.0 / len(layout.moments)
    return weights
