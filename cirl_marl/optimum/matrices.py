"""The variables of the linear program, and the sparse matrices of its rows over them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.network import Floats, Integers, Network

KEYS = 6
"""Whole numbers that say where a row comes."""


@dataclass(frozen=True)
class Layout:
    """Where the variables of one interval lie: the column of the first of each kind, the others follow by position.

    For each piece X_i, F_i and Z_i for i = 0 … d, then the stocks at its end; after the last piece, the levels, the
    imbalance and the free valves. Of a node that stores nothing X_i is its throughput, and there is no stock at the
    end. Z_i = v·X_i is what the valve of a node lets through to several outflows. Moments are counted through all
    pieces.

    Attributes:
        network: whose variables they are.
        pieces: equal parts of an interval.
        coarse: whether pieces are longer than the substeps of the simulator, within which scheduled flows are constant.
        has_end_flows: whether throughputs and flows at the end of pieces, under the controls of their interval, are
            variables too, for the rows of quasi-steady stocks.
        degree: d.
        valves: nodes that have a Z.
        free_valves: nodes of these with scheduled outflows, on which the valve acts as well; v is then a variable.
    """

    network: Network
    pieces: int
    coarse: bool
    has_end_flows: bool
    degree: int
    valves: Integers
    free_valves: Integers

    @cached_property
    def moments(self) -> range:
        """All Bernstein indices of an interval, piece after piece."""
        return range(self.pieces * (self.degree + 1))

    @cached_property
    def moment_column(self) -> Integers:
        """The same as an array of shape (moments, 1), to be laid against nodes or arcs."""
        return np.arange(len(self.moments))[:, None]

    @property
    def length(self) -> float:
        """Length of a piece, δ."""
        return self.network.episode.control_interval / self.pieces

    @property
    def portion(self) -> float:
        """Length of a piece over d + 1, the integral of each test polynomial."""
        return self.network.episode.control_interval / len(self.moments)

    @cached_property
    def _block(self) -> int:
        """Variables of a moment: X, F and Z."""
        return len(self.network.nodes) + len(self.network.arcs) + len(self.valves)

    @cached_property
    def _piece(self) -> int:
        """Variables of a piece: d + 1 blocks, then those about its end."""
        ends = len(self.network.nodes) + len(self.network.arcs) if self.has_end_flows else len(self.network.stores)
        return (self.degree + 1) * self._block + ends

    @cached_property
    def stock(self) -> Integers:
        """First of the weighted mean stocks X, then throughputs, of each moment, shape (moments,)."""
        piece, i = np.divmod(np.arange(len(self.moments)), self.degree + 1)
        columns: Integers = piece * self._piece + i * self._block
        return columns

    @cached_property
    def flow(self) -> Integers:
        """First of the weighted mean flows F of each moment, shape (moments,)."""
        return self.stock + len(self.network.nodes)

    @cached_property
    def valve(self) -> Integers:
        """First of Z of each moment, shape (moments,)."""
        return self.flow + len(self.network.arcs)

    @cached_property
    def end(self) -> Integers:
        """First of the stocks at the end of each piece, shape (pieces,)."""
        return np.arange(self.pieces) * self._piece + (self.degree + 1) * self._block

    @cached_property
    def end_flow(self) -> Integers:
        """First of the flows at the end of each piece, which stand behind the throughputs, shape (pieces,)."""
        return self.end + len(self.network.nodes)

    @cached_property
    def last(self) -> slice:
        """The stocks at the end of the interval."""
        return slice(int(self.end[-1]), int(self.end[-1]) + len(self.network.stores))

    @property
    def level(self) -> int:
        """The first of the service levels."""
        return self.pieces * self._piece

    @property
    def imbalance(self) -> int:
        """The variable that is at least |Δ·σ_env·f̄|; counted only with ``net_zero = "abs"``."""
        return self.level + len(self.network.services)

    @property
    def free_valve(self) -> int:
        """The first of the valves v themselves."""
        return self.imbalance + 1

    @property
    def size(self) -> int:
        """Variables of an interval."""
        return self.free_valve + len(self.free_valves)

    def means(self, plan: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the plain means of X, F and Z over each interval, shape (steps, nodes | arcs | valves)."""
        counts = (len(self.network.nodes), len(self.network.arcs), len(self.valves))
        stock, flow, through = (
            np.mean([plan[:, column : column + count] for column in columns.tolist()], axis=0)
            for columns, count in zip((self.stock, self.flow, self.valve), counts, strict=True)
        )
        return stock, flow, through


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
        self._limits: list[tuple[Integers, Floats]] = []

    def add(self, *keys: ArrayLike) -> Integers:
        """Add rows with these keys, broadcast against each other, and return their numbers in the same shape."""
        parts = np.broadcast_arrays(*(np.asarray(key, dtype=np.intp) for key in keys))
        table = np.zeros((KEYS, parts[0].size), dtype=np.intp)
        for place, part in enumerate(parts):
            table[place] = part.ravel()
        self._keys.append(table)
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
        parts = [np.ravel(part) for part in np.broadcast_arrays(rows, piece, node, values)]
        for before, inside in ((False, parts[1] > 0), (True, parts[1] == 0)):
            row, start, stock, value = (part[inside] for part in parts)
            # piece 0 begins where the last piece of the interval before ends: end[0 − 1] there
            self.put(row, self.layout.end[start - 1] + stock, value, before=before)

    def limit(self, rows: Integers, values: ArrayLike) -> None:
        """Set the right-hand sides of rows; those of others are 0."""
        self._limits.append((rows, np.broadcast_to(values, rows.shape)))

    def limits(self) -> Floats:
        """Return the right-hand sides in the order of the keys."""
        limits = np.zeros(self._count)
        for rows, values in self._limits:
            limits[rows] = values
        return limits[self._order()]

    def matrices(self) -> tuple[Any, Any, Any]:
        """Return the rows over the intervals and over the one before, and what arcs loosen them by, all sparse."""
        place = np.empty(self._count, dtype=np.intp)
        place[self._order()] = np.arange(self._count)
        blocks = []
        for entries, width in zip(self._entries, (self._width, self._width, self._arcs), strict=True):
            parts = zip(*entries, strict=True) if entries else ([np.zeros(0, dtype=np.intp)],) * 3
            rows, columns, values = (np.concatenate(part) for part in parts)
            blocks.append(sparse.csr_array((values, (place[rows], columns)), shape=(self._count, width)))
        return blocks[0], blocks[1], blocks[2]

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
        self._cache: dict[bytes, tuple[Any, Any]] = {}

    def add(self, kind: int, links: ProgramRows, alone: ProgramRows) -> None:
        """Take the rows of a kind of interval: those that link it to the one before, and the others."""
        self._now[kind], self._before[kind], self._looser[0][kind] = links.matrices()
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
        if key not in self._cache:
            links, size = ((self._now, 0), (self._before, 1)), self._layout.size
            looser = ((self._looser[0], 0),), ((self._looser[1], 0),)
            matrix = self._over(kinds, size, links, ((self._alone, 0),))
            self._cache[key] = matrix, self._over(kinds, cut.shape[1], *looser)
        # there is no interval before the first: its entries meet known stocks and go to the right-hand side
        layout, (matrix, loosen), before = self._layout, self._cache[key], self._before[int(kinds[0])]
        first = np.zeros(layout.size)
        first[layout.last] = initial
        limits = loosen @ cut.ravel()
        limits[: before.shape[0]] -= before @ first
        return matrix, limits

    def _over(self, kinds: Integers, size: int, *groups: tuple[tuple[dict[int, Any], int], ...]) -> Any:
        """Lay blocks over intervals of ``size`` columns each, so many intervals before that of their rows."""
        entries, first = [], 0
        for group in groups:
            # the rows of a group stand one interval after the other, whatever kind each is of
            tops = first + np.cumsum([0, *(group[0][0][kind].shape[0] for kind in kinds.tolist())])
            first = int(tops[-1])
            for blocks, shift in group:
                for kind in np.unique(kinds).tolist():
                    steps = np.flatnonzero(kinds == kind)
                    steps, block = steps[steps >= shift][:, None], blocks[kind].tocoo()
                    rows, columns = tops[steps] + block.row, size * (steps - shift) + block.col
                    entries.append((rows.ravel(), columns.ravel(), np.tile(block.data, len(steps))))
        rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
        return sparse.csr_array((values, (rows, columns)), shape=(first, size * len(kinds)))
