"""The variables of the linear program, and the sparse matrices of its rows over them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.network import Floats, Integers, Network

Place = TypeVar("Place", int, Integers)
KEYS = 5
"""Whole numbers that say where a row comes."""


@dataclass(frozen=True)
class Layout:
    """Where the variables of one interval lie.

    For each piece X_i, F_i and Z_i for i = 0 … d, then the stocks at its end; after the last piece, the levels, the
    imbalance and the valves. Of a node that stores nothing X_i is its throughput, and there is no stock at the end. At
    the end of merged pieces are throughputs and flows, too, under the controls of their interval.
    Z_i = v·X_i is what the valve of a node lets through to several outflows. Moments are counted through all pieces.

    Attributes:
        network: whose variables they are.
        pieces: equal parts of an interval.
        coarse: whether pieces are longer than the substeps of the simulator, within which scheduled flows are constant.
        merged: whether they are, and stand for all that happens in them.
        degree: d.
        valves: nodes that have a Z.
        openings: nodes of these with scheduled outflows, on which the valve acts as well; v is then a variable.
    """

    network: Network
    pieces: int
    coarse: bool
    merged: bool
    degree: int
    valves: Integers
    openings: Integers

    @cached_property
    def moments(self) -> range:
        """All Bernstein indices of an interval, piece after piece."""
        return range(self.pieces * (self.degree + 1))

    @cached_property
    def moment_column(self) -> Integers:
        """The same as an array of shape (moments, 1), to be laid against nodes or arcs."""
        return np.arange(len(self.moments))[:, None]

    @cached_property
    def piece(self) -> int:
        """Variables of a piece."""
        means = len(self.network.nodes) + len(self.network.arcs) + len(self.valves)
        return (self.degree + 1) * means + self._ends

    @cached_property
    def _ends(self) -> int:
        """Variables about the end of a piece."""
        return len(self.network.nodes) + len(self.network.arcs) if self.merged else len(self.network.stores)

    @property
    def length(self) -> float:
        """Length of a piece, δ."""
        return self.network.episode.control_interval / self.pieces

    @property
    def portion(self) -> float:
        """Length of a piece over d + 1, the integral of each test polynomial."""
        return self.network.episode.control_interval / len(self.moments)

    def stock(self, moment: Place) -> Place:
        """Return the first of the weighted mean stocks X, then throughputs."""
        # each piece: d + 1 blocks of (X, F, Z), equally long, then the stocks at its end
        piece, i = divmod(moment, self.degree + 1)
        return piece * self.piece + i * ((self.piece - self._ends) // (self.degree + 1))

    def flow(self, moment: Place) -> Place:
        """Return the first of the weighted mean flows F."""
        return self.stock(moment) + len(self.network.nodes)

    def valve(self, moment: Place) -> Place:
        """Return the first of Z."""
        return self.flow(moment) + len(self.network.arcs)

    def end(self, piece: Place) -> Place:
        """Return the first of the stocks at the end of a piece; −1 is the last."""
        return (piece % self.pieces + 1) * self.piece - self._ends

    @property
    def last(self) -> slice:
        """The stocks at the end of the interval."""
        return slice(self.end(-1), self.end(-1) + len(self.network.stores))

    def end_flow(self, piece: Place) -> Place:
        """Return the first of the flows at the end of a merged piece, which stand behind the throughputs."""
        return self.end(piece) + len(self.network.nodes)

    @property
    def level(self) -> int:
        """The first of the service levels."""
        return self.pieces * self.piece

    @property
    def imbalance(self) -> int:
        """The variable that is at least |Δ·σ_env·f̄|; counted only with ``net_zero = "abs"``."""
        return self.level + len(self.network.services)

    @property
    def opening(self) -> int:
        """The first of the valves v themselves."""
        return self.imbalance + 1

    @property
    def size(self) -> int:
        """Variables of an interval."""
        return self.opening + len(self.openings)

    def means(self, planned: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the plain means of X, F and Z over each interval, shape (steps, nodes | arcs | valves)."""
        counts = (len(self.network.nodes), len(self.network.arcs), len(self.valves))
        parts = []
        for first, count in zip((self.stock, self.flow, self.valve), counts, strict=True):
            parts.append(np.mean([planned[:, first(j) : first(j) + count] for j in self.moments], axis=0))
        return parts[0], parts[1], parts[2]


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


class ChainedRows:
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
