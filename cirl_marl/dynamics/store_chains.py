"""Chains of stores, as lifetimes are written: what moves along them needs neither a gather nor a sparse sum."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from cirl_marl.dynamics.static_elimination import SparseRow
from cirl_marl.network import Floats, Integers
from cirl_marl.network.rowsum import spans


class StoreChains:
    """Stores each of which only the store in the row before flows into, if any store does.

    But for what nodes without stock send there, ẋ_i = f_{i−1} − f_i with f_i = r_i·x_i: two operations over all rows
    of a run. A sum of two is the same to the bit in whatever order.

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
        sources: dict[int, SparseRow] = {}
        for source, parts in gives.items():
            for end, part in parts.items():
                sources.setdefault(end - first, {})[source] = part
        flow_of: dict[int, int] = {}
        heads: list[int] = []
        for row, k in sorted(zip(drivers, range(len(drivers)), strict=True)):
            into, before = sources.get(row, {}), flow_of.get(row - 1)
            if into == {flows[k]: -1.0}:
                heads.append(row)
            elif before is None or into != {flows[before]: 1.0, flows[k]: -1.0}:
                continue
            flow_of[row] = k
            for source in into:
                del gives[source][first + row]
        for k in flow_of.values():
            if not gives[flows[k]]:
                del gives[flows[k]]
        rows: Integers = np.array([*flow_of], dtype=np.intp)
        self.flows: Integers = np.array([*flow_of.values()], dtype=np.intp)
        pieces = np.split(rows, np.flatnonzero(np.diff(rows) > 1) + 1) if len(rows) else []
        self.runs = [slice(int(piece[0]), int(piece[-1]) + 1) for piece in pieces]
        self._parts = spans(map(len, pieces))
        self._heads, self._head_flows = _places(np.array(heads, dtype=np.intp)), _places(np.searchsorted(rows, heads))

    def changes(self, masses: Floats, rates: Floats, change: Floats) -> Callable[[], None]:
        """Return what writes what the stores change by, as often as it is called.

        Args:
            masses: of all stores, shape (masses, B).
            rates: r of ``flows``, shape (flows, B).
            change: for ẋ, shape (masses, B); rows of other stores stay as they are.
        """
        flow = np.empty_like(rates)
        runs = [
            (masses[run], rates[part], flow[part], flow[part][:-1], flow[part][1:], change[run][1:])
            for run, part in zip(self.runs, self._parts, strict=True)
        ]

        def write() -> None:
            for stock, rate, moved, before, after, difference in runs:
                np.multiply(stock, rate, moved)
                np.subtract(before, after, difference)
            if runs:
                change[self._heads] = 0.0 - flow[self._head_flows]

        return write


def _places(places: Integers) -> Integers | slice:
    """Return places as a slice, which is looked up sooner, if they are evenly spaced."""
    steps = set(np.diff(places).tolist())
    return slice(int(places[0]), int(places[-1]) + 1, steps.pop()) if len(steps) == 1 else places
