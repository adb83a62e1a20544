"""Chains of stores, as lifetimes are written: what moves along them needs neither a gather nor a sparse sum."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cirl_marl.dynamics.static_elimination import SparseRow
from cirl_marl.network import Floats, Integers
from cirl_marl.network.rowsum import spans

SHORT, MANY = 8, 16
"""Least number of rows in a run, and of copies: of fewer the calls take longer than what they save."""


class StoreChains:
    """Stores in rows one after the other, most of which get what leaves the store in the row before.

    Of such flows f_i = r_i·x_i a run of stores changes by ẋ_i = f_{i−1} − f_i: two operations over all its rows. What
    else a store gets or gives comes on top. A sum of two is the same to the bit in whatever order.

    Attributes:
        runs: rows of the stores.
        flows: their flows among all that vary from copy to copy, in the order of the rows.
        moves: what each of these, by name, moves along the chains.
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
        self.moves: dict[int, SparseRow] = {flows[k]: {} for k in self.flows.tolist()}
        heads: list[int] = []
        for piece in pieces:
            before = -1
            for row in piece.tolist():
                name = flows[flow_of[row]]
                if gives.get(before, {}).get(first + row) == 1.0:
                    self.moves[before][first + row] = gives[before].pop(first + row)
                else:
                    heads.append(row)
                self.moves[name][first + row] = gives[name].pop(first + row)
                before = name
        for name in self.moves:
            if not gives[name]:
                del gives[name]
        self._heads, self._head_flows = _places(np.array(heads, dtype=np.intp)), _places(np.searchsorted(rows, heads))

    def changes(self, masses: Floats, rates: Floats, flow: Floats, change: Floats) -> Callable[[], None]:
        """Return what writes what the stores change by, as often as it is called.

        Args:
            masses: of all stores, shape (masses, B).
            rates: r of ``flows``, shape (flows, B).
            flow: for what they carry, likewise.
            change: for ẋ, shape (masses, B); rows of other stores stay as they are.
        """
        multiply, subtract = np.multiply, np.subtract
        runs = [
            (masses[run], rates[part], flow[part], flow[part][:-1], flow[part][1:], change[run][1:])
            for run, part in zip(self.runs, self._parts, strict=True)
        ]
        head_flow, head_change = flow[self._head_flows], change[self._heads]
        are_views = isinstance(self._heads, slice) and isinstance(self._head_flows, slice)

        def write() -> None:
            for stock, rate, moved, before, after, difference in runs:
                multiply(stock, rate, moved)
                subtract(before, after, difference)
            if are_views:
                subtract(0.0, head_flow, head_change)
            else:
                change[self._heads] = 0.0 - flow[self._head_flows]

        return write


def _places(places: Integers) -> Integers | slice:
    """Return places as a slice, which is a view, if they are evenly spaced."""
    steps = set(np.diff(places).tolist())
    return places if len(steps) > 1 or not len(places) else slice(places[0], places[-1] + 1, *(steps or (1,)))
