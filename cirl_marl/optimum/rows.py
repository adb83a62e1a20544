"""Rows of the linear program: written many at a time for one interval, and laid out for one interval after another."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.layout import Layout

KEYS = 5
"""Whole numbers that say where a row comes."""


class ProgramRows:
    """Rows over the variables of an interval, or of several, and over those of the interval before.

    Each row has a key; the rows of the matrices come in the order of their keys, in whatever order they were added.
    """

    def __init__(self, layout: Layout, intervals: int = 1) -> None:
        """Begin without rows."""
        self.layout = layout
        self._width, self._arcs = layout.size * intervals, len(layout.network.arcs)
        self._keys: list[Integers] = []
        self._count = 0
        self._entries: tuple[list[tuple[Any, Any, Any]], ...] = ([], [], [])

    def add(self, *keys: ArrayLike) -> Integers:
        """Add rows with these keys, broadcast against each other, and return their numbers in the same shape."""
        parts = np.broadcast_arrays(*(np.asarray(key, dtype=np.intp) for key in keys))
        padded = np.zeros((KEYS, parts[0].size), dtype=np.intp)
        for place, part in enumerate(parts):
            padded[place] = part.ravel()
        self._keys.append(padded)
        numbers = np.arange(self._count, self._count + parts[0].size)
        self._count += parts[0].size
        return numbers.reshape(parts[0].shape)

    def put(self, rows: Integers, columns: ArrayLike, values: ArrayLike, *, before: bool = False) -> None:
        """Put values into columns of the interval, or of the one before; entries at one place are added."""
        self._put(before, rows, columns, values)

    def loosen(self, rows: Integers, arcs: ArrayLike, values: ArrayLike) -> None:
        """Allow rows so much more per unit of the most that scheduled arcs are asked for, where they may be cut."""
        self._put(2, rows, arcs, values)

    def _put(self, part: int, rows: Integers, columns: ArrayLike, values: ArrayLike) -> None:
        entries = np.broadcast_arrays(rows, np.asarray(columns, dtype=np.intp), np.asarray(values, dtype=float))
        self._entries[part].append((entries[0].ravel(), entries[1].ravel(), entries[2].ravel()))

    def at_start(self, rows: Integers, piece: ArrayLike, node: ArrayLike, values: ArrayLike) -> None:
        """Put values at the stocks of nodes at the start of pieces, the first of which is in the interval before."""
        layout = self.layout
        parts = [np.ravel(part) for part in np.broadcast_arrays(rows, piece, node, values)]
        for before, where in ((False, parts[1] > 0), (True, parts[1] == 0)):
            row, start, stock, value = (part[where] for part in parts)
            self.put(row, layout.end(start - 1) + stock, value, before=before)

    def in_order(self, values: Sequence[Floats]) -> Floats:
        """Return what was listed as rows were added, in the order of their keys."""
        ordered: Floats = np.concatenate([np.zeros(0), *values])[self._order()]
        return ordered

    def matrices(self) -> tuple[Any, Any, Any]:
        """Return the rows over the intervals and over the one before, and what arcs loosen them by, all sparse."""
        place = np.empty(self._count, dtype=np.intp)
        place[self._order()] = np.arange(self._count)
        found = []
        for entries, width in zip(self._entries, (self._width, self._width, self._arcs), strict=True):
            parts = zip(*entries, strict=True) if entries else ([np.zeros(0, dtype=np.intp)],) * 3
            rows, columns, values = (np.concatenate(part) for part in parts)
            found.append(sparse.csr_array((values, (place[rows], columns)), shape=(self._count, width)))
        return found[0], found[1], found[2]

    def _order(self) -> Integers:
        keys = np.concatenate([np.zeros((KEYS, 0), dtype=np.intp), *self._keys], axis=1)
        return np.lexsort(keys[::-1])


class Chained:
    """Rows that come in every interval, some of which link it to the interval before.

    Intervals of the same kind, in which the network is the same, have the same rows; they are written once.
    """

    def __init__(self, layout: Layout) -> None:
        """Begin without rows."""
        self._layout = layout
        self._now: dict[int, Any] = {}
        self._before: dict[int, Any] = {}
        self._alone: dict[int, Any] = {}
        self._looser: tuple[dict[int, Any], dict[int, Any]] = ({}, {})
        self._known: dict[bytes, tuple[Any, Any]] = {}

    def add(self, kind: int, linked: ProgramRows, alone: ProgramRows) -> None:
        """Take the rows of a kind of interval: those that link it to the one before, and the others."""
        self._now[kind], self._before[kind], self._looser[0][kind] = linked.matrices()
        self._now[kind].eliminate_zeros()
        self._before[kind].eliminate_zeros()
        self._alone[kind], _, self._looser[1][kind] = alone.matrices()

    def at_start(self, kind: int) -> Any:
        """Return what the linked rows of a kind of interval have of the stocks at its start, (rows, stores), sparse."""
        return self._before[kind][:, self._layout.last]

    def over(self, kinds: Integers, initial: Floats, cut: Floats) -> tuple[Any, Floats]:
        """Return the matrix over intervals of some kinds, and the right-hand side.

        The linked rows of one interval after the other come first, then the others of each.

        Args:
            kinds: of the intervals.
            initial: stocks at the start.
            cut: most that is asked of scheduled arcs that may be cut, 0 for others, shape (intervals, arcs).
        """
        key = kinds.tobytes()
        if key not in self._known:
            links, size = ((self._now, 0), (self._before, 1)), self._layout.size
            looser = ((self._looser[0], 0),), ((self._looser[1], 0),)
            matrix = self._over(kinds, size, links, ((self._alone, 0),))
            self._known[key] = matrix, self._over(kinds, cut.shape[1], *looser)
        # there is no interval before the first: its entries meet known stocks and go to the right-hand side
        layout, (matrix, loosen), before = self._layout, self._known[key], self._before[int(kinds[0])]
        first = np.zeros(layout.size)
        first[layout.last] = initial
        to = loosen @ cut.ravel()
        to[: before.shape[0]] -= before @ first
        return matrix, to

    def _over(self, kinds: Integers, size: int, *groups: tuple[tuple[dict[int, Any], int], ...]) -> Any:
        """Lay blocks over intervals of ``size`` columns each, so many intervals before that of their rows."""
        entries, first = [], 0
        for group in groups:
            tops = first + np.cumsum([0, *(group[0][0][kind].shape[0] for kind in kinds.tolist())])
            first = int(tops[-1])
            for blocks, shift in group:
                for kind in np.unique(kinds).tolist():
                    when = np.flatnonzero(kinds == kind)
                    when, block = when[when >= shift][:, None], blocks[kind].tocoo()
                    rows, columns = tops[when] + block.row, size * (when - shift) + block.col
                    entries.append((rows.ravel(), columns.ravel(), np.tile(block.data, len(when))))
        rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
        return sparse.csr_array((values, (rows, columns)), shape=(first, size * len(kinds)))
