"""The variables of the linear program, and the sparse matrices of its rows over them."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from copy import copy
from itertools import product
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.network import Floats, Integers, Network

T = TypeVar("T")
RowParts = tuple[Any, Any, Any]
"""Rows over their interval, over the one before, and what scheduled arcs loosen them by, all sparse."""
KEYS = 6
"""Whole numbers that say where a row comes."""
MOST_ENTRIES = 2048
"""Of a cache, which is emptied then."""
NOTHING: Integers = np.zeros(0, dtype=np.intp)
NOW, BEFORE, LOOSER = range(3)
"""What rows have entries of: their interval, the one before, and what scheduled arcs are asked for."""


class IntervalCache:
    """What follows from the ranges of an interval alone, for the programs of networks that are alike in some of them.

    What a key stands for never depends on what was asked for before.
    """

    def __init__(self) -> None:
        """Begin with nothing."""
        self._values: dict[Hashable, Any] = {}

    def value(self, key: Hashable, make: Callable[[], T]) -> T:
        """Return what ``make`` makes, which is not called where the key is known."""
        if key not in self._values:
            if len(self._values) >= MOST_ENTRIES:
                self._values.clear()
            self._values[key] = make()
        value: T = self._values[key]
        return value


class Layout:
    """Where the variables of one interval lie: the column of the first of each kind, the others follow by position.

    For each piece X_i, F_i and Z_i for i = 0 … d, then the stocks at its end; after the last piece, the levels, the
    imbalance and the free valves. Of a node that stores nothing X_i is its throughput, and there is no stock at the
    end. Z_i = v·X_i is what the valve of a node lets through to several outflows. Moments are counted through all
    pieces. What controls are away from their neutral values, and excesses, come last, if something is charged for them.

    Attributes:
        network: whose variables they are.
        pieces: equal parts of an interval.
        coarse: whether pieces are longer than the substeps of the simulator, within which scheduled flows are constant.
        has_end_flows: whether throughputs and flows at the end of pieces, under the controls of their interval, are
            variables too, for the rows of quasi-steady stocks.
        degree: d.
        valves: nodes that have a Z.
        free_valves: nodes of these with scheduled outflows, on which the valve acts as well; v is then a variable.
        moments: all Bernstein indices of an interval, piece after piece.
        moment_column: the same as an array of shape (moments, 1), to be laid against nodes or arcs.
        length: of a piece, δ.
        portion: length of a piece over d + 1, the integral of each test polynomial.
        stock: first of the weighted mean stocks X, then throughputs, of each moment, shape (moments,).
        flow: first of the weighted mean flows F, likewise.
        valve: first of Z, likewise.
        end: first of the stocks at the end of each piece, shape (pieces,).
        end_flow: first of the flows at the end of each piece, which stand behind the throughputs, likewise.
        last: the stocks at the end of the interval.
        steady_nodes: nodes without stock of whose throughput the constant part A is a variable.
        steady_arcs: their outflows, and sources that are constant in part, of whose flow that part a is one too.
        steady: first of A, which a follows.
        level: first of the service levels.
        imbalance: the variable that is at least |Δ·σ_env·f̄|; counted only with ``net_zero = "abs"``.
        free_valve: first of the valves v themselves.
        charged_controls: agents that pay for the effort of their controls.
        effort: first of what these are away from their neutral values.
        excess: first of the excesses, which follow them; see ``Ledger``.
        size: variables of an interval.
    """

    def __init__(
        self,
        network: Network,
        pieces: int,
        degree: int,
        valves: Integers,
        free_valves: Integers,
        *,
        coarse: bool,
        has_end_flows: bool = False,
        charged_controls: tuple[str, ...] = (),
        excesses: int = 0,
    ) -> None:
        """Lay the variables out; arguments are the attributes of the same names, or count them."""
        self.network, self.pieces, self.degree = network, pieces, degree
        self.charged_controls, self._excesses = charged_controls, excesses
        self.valves, self.free_valves = valves, free_valves
        self.coarse, self.has_end_flows = coarse, has_end_flows
        self.moments = range(pieces * (degree + 1))
        self.moment_column = np.arange(len(self.moments))[:, None]
        self.length = network.episode.control_interval / pieces
        self.portion = network.episode.control_interval / len(self.moments)
        # a piece has d + 1 blocks of X, F and Z, then what is about its end
        nodes, arcs = len(network.nodes), len(network.arcs)
        block = nodes + arcs + len(valves)
        piece_size = (degree + 1) * block + (nodes + arcs if has_end_flows else len(network.stores))
        piece, i = np.divmod(np.arange(len(self.moments)), degree + 1)
        self.stock: Integers = piece * piece_size + i * block
        self.flow = self.stock + nodes
        self.valve = self.flow + arcs
        self.end = np.arange(pieces) * piece_size + (degree + 1) * block
        self.end_flow = self.end + nodes
        self.last = slice(int(self.end[-1]), int(self.end[-1]) + len(network.stores))
        self.steady = pieces * piece_size
        self._lay_out_interval(NOTHING, NOTHING)

    def _lay_out_interval(self, steady_nodes: Integers, steady_arcs: Integers) -> None:
        self.steady_nodes, self.steady_arcs = steady_nodes, steady_arcs
        self.level = self.steady + len(steady_nodes) + len(steady_arcs)
        self.imbalance = self.level + len(self.network.services)
        self.free_valve = self.imbalance + 1
        self.effort = self.free_valve + len(self.free_valves)
        self.excess = self.effort + len(self.charged_controls)
        self.size = self.excess + self._excesses

    def with_constant_parts(self, nodes: Integers, arcs: Integers) -> Layout:
        """Return the layout in which constant parts of some throughputs and flows are variables too."""
        layout = copy(self)
        layout._lay_out_interval(nodes, arcs)
        return layout

    def steady_column(self, arcs: ArrayLike) -> Integers:
        """Return the column of a of some of ``steady_arcs``."""
        column: Integers = self.steady + len(self.steady_nodes) + np.searchsorted(self.steady_arcs, arcs)
        return column

    @property
    def key(self) -> Hashable:
        """What is the same in layouts that are alike, of one network."""
        sizes = self.size, self.pieces, self.degree, self.length, self.coarse, self.has_end_flows
        return (*sizes, self.valves.tobytes(), self.free_valves.tobytes())

    def with_levels(self, rows: Any, service_low: Floats) -> Any:
        """Return rows of an interval with other bands of services, whose lower ends stand at the levels."""
        service, data = rows.indices - self.level, rows.data.copy()
        is_level = (service >= 0) & (service < len(service_low))
        data[is_level] = service_low[service[is_level]]
        return sparse.csr_array((data, rows.indices, rows.indptr), shape=rows.shape)

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

    def put(self, rows: Integers, columns: ArrayLike, values: ArrayLike, *, part: int = NOW) -> None:
        """Put values into columns of the interval, or of another ``part``; entries at one place are added."""
        entries = np.broadcast_arrays(rows, np.asarray(columns, dtype=np.intp), np.asarray(values, dtype=float))
        self._entries[part].append((entries[0].ravel(), entries[1].ravel(), entries[2].ravel()))

    def loosen(self, rows: Integers, arcs: ArrayLike, values: ArrayLike) -> None:
        """Allow rows so much more per unit of the most that scheduled arcs are asked for, where they may be cut."""
        self.put(rows, arcs, values, part=LOOSER)

    def at_start(self, rows: Integers, piece: ArrayLike, node: ArrayLike, values: ArrayLike) -> None:
        """Put values at the stocks of nodes at the start of pieces, the first of which is in the interval before."""
        parts = [np.ravel(part) for part in np.broadcast_arrays(rows, piece, node, values)]
        for part, inside in ((NOW, parts[1] > 0), (BEFORE, parts[1] == 0)):
            row, start, stock, value = (values[inside] for values in parts)
            # piece 0 begins where the last piece of the interval before ends: end[0 − 1] there
            self.put(row, self.layout.end[start - 1] + stock, value, part=part)

    def limit(self, rows: Integers, values: ArrayLike) -> None:
        """Set the right-hand sides of rows; those of others are 0."""
        self._limits.append((rows, np.broadcast_to(values, rows.shape)))

    def limits(self) -> Floats:
        """Return the right-hand sides in the order of the keys."""
        limits = np.zeros(self._count)
        for rows, values in self._limits:
            limits[rows] = values
        return limits[self._order()]

    def matrices(self) -> RowParts:
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
        self._links: dict[int, RowParts] = {}
        self._alone: dict[int, RowParts] = {}
        self._cache: dict[bytes, tuple[Any, Any]] = {}

    def add(self, kind: int, links: RowParts, alone: RowParts) -> None:
        """Take the rows of a kind of interval: those that link it to the one before, and the others."""
        self._links[kind], self._alone[kind] = links, alone

    def at_start(self, kind: int) -> Any:
        """Return what the linked rows of a kind of interval have of the stocks at its start, (rows, stores), sparse."""
        return self._links[kind][BEFORE][:, self._layout.last]

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
            matrix = self._over(kinds, self._layout.size, (NOW, BEFORE))
            self._cache[key] = matrix, self._over(kinds, cut.shape[1], (LOOSER,))
        # there is no interval before the first: its entries meet known stocks and go to the right-hand side
        layout, (matrix, loosen), before = self._layout, self._cache[key], self._links[int(kinds[0])][BEFORE]
        first = np.zeros(layout.size)
        first[layout.last] = initial
        limits = loosen @ cut.ravel()
        limits[: before.shape[0]] -= before @ first
        return matrix, limits

    def _over(self, kinds: Integers, size: int, parts: tuple[int, ...]) -> Any:
        """Lay some parts of the rows over intervals of ``size`` columns each."""
        entries, first = [], 0
        for blocks in (self._links, self._alone):
            # they stand one interval after the other, whatever kind each is of
            tops = first + np.cumsum([0, *(blocks[kind][NOW].shape[0] for kind in kinds.tolist())])
            first = int(tops[-1])
            for part, kind in product(parts, np.unique(kinds).tolist()):
                shift = int(part == BEFORE)
                steps = np.flatnonzero(kinds == kind)
                steps, block = steps[steps >= shift][:, None], blocks[kind][part].tocoo()
                rows, columns = tops[steps] + block.row, size * (steps - shift) + block.col
                entries.append((rows.ravel(), columns.ravel(), np.tile(block.data, len(steps))))
        rows, columns, values = (np.concatenate(part) for part in zip(*entries, strict=True))
        return sparse.csr_array((values, (rows, columns)), shape=(first, size * len(kinds)))
