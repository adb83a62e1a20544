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


class Rows:
    """Rows over the variables of an interval, or of several, and over those of the interval before.

    Each row has a key; the rows of the matrices come in the order of their keys, in whatever order they were added.
    """

    def __init__(self, layout: Layout, intervals: int = 1) -> None:
        """Begin without rows."""
        self.layout = layout
        self._width = layout.size * intervals
        self._keys: list[Integers] = []
        self._count = 0
        self._entries: tuple[list[tuple[Any, Any, Any]], ...] = ([], [])

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
        entries = np.broadcast_arrays(rows, np.asarray(columns, dtype=np.intp), np.asarray(values, dtype=float))
        self._entries[before].append((entries[0].ravel(), entries[1].ravel(), entries[2].ravel()))

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

    def matrices(self) -> tuple[Any, Any]:
        """Return the rows over the intervals and over the one before, sparse."""
        place = np.empty(self._count, dtype=np.intp)
        place[self._order()] = np.arange(self._count)
        found = []
        for entries in self._entries:
            parts = zip(*entries, strict=True) if entries else ([np.zeros(0, dtype=np.intp)],) * 3
            rows, columns, values = (np.concatenate(part) for part in parts)
            found.append(sparse.csr_array((values, (place[rows], columns)), shape=(self._count, self._width)))
        return found[0], found[1]

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
        self._known: dict[bytes, Any] = {}

    def add(self, kind: int, linked: Rows, alone: Rows) -> None:
        """Take the rows of a kind of interval: those that link it to the one before, and the others."""
        self._now[kind], self._before[kind] = linked.matrices()
        self._now[kind].eliminate_zeros()
        self._before[kind].eliminate_zeros()
        self._alone[kind] = alone.matrices()[0]

    def over(self, kinds: Integers, initial: Floats) -> tuple[Any, Floats]:
        """Return the matrix over intervals of some kinds, and the right-hand side.

        The linked rows of one interval after the other come first, then the others of each.
        """
        key = kinds.tobytes()
        if key not in self._known:
            self._known[key] = self._over(kinds)
        # there is no interval before the first: its entries meet known stocks and go to the right-hand side
        layout, matrix, before = self._layout, self._known[key], self._before[int(kinds[0])]
        first = np.zeros(layout.size)
        first[layout.end(-1) : layout.level] = initial
        to = np.zeros(matrix.shape[0])
        to[: before.shape[0]] = -(before @ first)
        return matrix, to

    def _over(self, kinds: Integers) -> Any:
        size, entries = self._layout.size, []
        tops = np.array([0])
        for blocks, shift, below in ((self._before, 1, False), (self._now, 0, False), (self._alone, 0, True)):
            first = tops[-1] if below else 0
            tops = first + np.cumsum([0, *(blocks[kind].shape[0] for kind in kinds.tolist())])
            for kind in np.unique(kinds).tolist():
                when = np.flatnonzero(kinds == kind)
                when, block = when[when >= shift][:, None], blocks[kind].tocoo()
                rows, columns = tops[when] + block.row, size * (when - shift) + block.col
                entries.append((rows.ravel(), columns.ravel(), np.tile(block.data, len(when))))
        rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
        return sparse.csr_array((values, (rows, columns)), shape=(int(tops[-1]), size * len(kinds)))
