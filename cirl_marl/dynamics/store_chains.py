"""Chains of stores, as lifetimes are written: what moves along them needs neither a gather nor a sparse sum."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cirl_marl.dynamics.static_elimination import SparseRow
from cirl_marl.network import Floats, Integers
from cirl_marl.network.rowsum import spans

SHORT = 8
"""Least number of rows in a run: of fewer the calls take longer than what they save in some hundreds of copies."""


class StoreChains:
    """Stores in rows one after the other, most of which get what leaves the store in the row before.

    Of such flows f_i = r_i·x_i a run of stores changes by ẋ_i = f_{i−1} − f_i: two operations over all its rows. What
    else a store gets or gives comes on top.

    Attributes:
        runs: rows of the stores.
        flows: their flows among all that vary from copy to copy, in the order of the rows.
    """

    def __init__(self, gives: dict[int, SparseRow], drivers: Sequence[int], flows: Sequence[int], first: int) -> None:
        """Find the chains, and take out of ``gives`` what moves along them.

        Args:
            gives: what masses and flows send to stores and nodes without stock, by the names of all of them.
            drivers: row of the store that drives each of the flows.
            flows: their names.
            first: name of the first store as an end; the others follow.
        """
        flow_of: dict[int, int] = {}
        for k, row in enumerate(drivers):
            parts = gives[flows[k]]
            goes_on = parts.get(first + row + 1) == 1.0
            if parts.get(first + row) == -1.0 and (goes_on or row not in flow_of):
                flow_of[row] = k
        all_rows: Integers = np.array(sorted(flow_of), dtype=np.intp)
        pieces = np.split(all_rows, np.flatnonzero(np.diff(all_rows) > 1) + 1)
        pieces = [piece for piece in pieces if len(piece) >= SHORT]
        self.runs = [slice(int(piece[0]), int(piece[-1]) + 1) for piece in pieces]
        self._parts = spans(map(len, pieces))
        rows: Integers = np.concatenate([all_rows[:0], *pieces])
        self.flows: Integers = np.array([flow_of[row] for row in rows.tolist()], dtype=np.intp)
        self._heads: list[Integers | slice] = []
        for piece in pieces:
            heads: list[int] = []
            before: SparseRow = {}
            for place, row in enumerate(piece.tolist()):
                if before.get(first + row) == 1.0:
                    del before[first + row]
                else:
                    heads.append(place)
                before = gives[flows[flow_of[row]]]
                del before[first + row]
            self._heads.append(_places(np.array(heads, dtype=np.intp)))
        for k in self.flows.tolist():
            if not gives[flows[k]]:
                del gives[flows[k]]

    def changes(self, masses: Floats, rates: Floats, change: Floats) -> Callable[[], None]:
        """Return what writes what the stores change by, as often as it is called.

        Args:
            masses: of all stores, shape (masses, B).
            rates: r of ``flows``, shape (flows, B).
            change: for ẋ, shape (masses, B); rows of other stores stay as they are.
        """
        multiply, subtract = np.multiply, np.subtract
        # one array for the flows of all runs stays in a cache
        flow = np.empty_like(rates[: max((run.stop - run.start for run in self.runs), default=0)])
        runs = []
        for run, part, heads in zip(self.runs, self._parts, self._heads, strict=True):
            moved, result = flow[: run.stop - run.start], change[run]
            views = (moved[heads], result[heads]) if isinstance(heads, slice) else None
            runs.append((masses[run], rates[part], moved, moved[:-1], moved[1:], result, result[1:], heads, views))

        def write() -> None:
            for stock, rate, moved, before, after, result, difference, heads, views in runs:
                multiply(stock, rate, moved)
                subtract(before, after, difference)
                if views is None:
                    result[heads] = 0.0 - moved[heads]
                else:
                    subtract(0.0, *views)

        return write


def _places(places: Integers) -> Integers | slice:
    """Return places as a slice, which is a view, if they are evenly spaced."""
    steps = set(np.diff(places).tolist())
    return places if len(steps) > 1 or not len(places) else slice(places[0], places[-1] + 1, *(steps or (1,)))
