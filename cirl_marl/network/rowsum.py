"""Weighted row sums over a batch, the one sparse operation of the library, and what their rounding leaves to spend."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from copy import copy
from functools import cache, partial
from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

# The kernels behind scipy's ``csc_array @ dense``. For the small matrices here the operator spends most of its time on
# dispatch and on a fresh result; the kernels add to an array that is already there. Columns of an incidence matrix have
# two entries each, which suits processors better than rows of random length.
from scipy.sparse._sparsetools import csc_matvec, csc_matvecs, csr_matvec, csr_matvecs

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

NEGLIGIBLE = 1e-290
"""Stock that gives nothing away: emptied again and again it would become subnormal, which does not round well."""


def spans(sizes: Iterable[int]) -> list[slice]:
    """Return the rows of parts of given sizes, one after the other.

    >>> spans([2, 1])
    [slice(0, 2, None), slice(2, 3, None)]
    """
    return [slice(first, last) for first, last in pairwise(np.cumsum([0, *sizes]).tolist())]


def single_column(table: Floats) -> Floats:
    """Return the one column of a table over intervals that was broadcast to all of them; others as they are."""
    return table[..., :1] if table.strides[-1] == 0 else table


def disposable(stock: Floats, parts: int) -> Floats:
    """Return the mass that a stock can give away in so many parts without their rounding overdrawing it."""
    return np.where(stock > NEGLIGIBLE, stock * (1.0 - max(1e-12, 4.0 * np.finfo(float).eps * parts)), 0.0)


class Triangle:
    """Where the entries of a strictly lower triangular matrix stand; the numbers are given in each use, for each copy.

    The rows are gone through in their order, and in a row the entries as they were given. All copies are worked on in
    one call, as diagonal blocks of one matrix: so many short rows that wait for each other would take longer to call
    for.
    """

    def __init__(self, rows: Integers, columns: Integers, size: int) -> None:
        """Take the places of the entries in so many rows."""
        self._order = np.argsort(rows, kind="stable")
        self._columns = columns[self._order]
        self._counts: Integers = np.bincount(rows, minlength=size)
        self._blocks: dict[int, tuple[Integers, Integers, Integers]] = {}

    def arrange(self, numbers: Floats) -> Floats:
        """Return the numbers of the entries, shape (entries, B), as ``substitute`` takes them."""
        return numbers.reshape(-1).take(self._block(numbers.shape[1])[2])

    def substitute(self, numbers: Floats, values: Floats, batch: int, first: int = 0, last: int | None = None) -> None:
        """Replace rows of ``values``, shape (rows, B·n), by those of (I − W)⁻¹ values, as ``RowSum.substitute`` does.

        Args:
            numbers: of the entries, arranged.
            values: a C-contiguous array, n columns for each copy.
            batch: B.
            first: the first row that is replaced; those before it hold what they should already.
            last: the row after the last one.
        """
        self.substitution(numbers, values, batch, first, last)()

    def substitution(
        self, numbers: Floats, values: Floats, batch: int, first: int = 0, last: int | None = None
    ) -> Callable[[], object]:
        """Return what does as ``substitute``, as often as it is called."""
        starts, columns, _ = self._block(batch)
        rows = slice(first * batch, (len(self._counts) if last is None else last) * batch)
        starts, flat, each = starts[rows.start : rows.stop + 1], values.reshape(-1), values.shape[1] // batch
        result, size = flat[rows.start * each : rows.stop * each], len(self._counts) * batch
        kernel, counts = (csr_matvec, ()) if each == 1 else (csr_matvecs, (each,))
        return partial(kernel, rows.stop - rows.start, size, *counts, starts, columns, numbers, flat, result)

    def _block(self, batch: int) -> tuple[Integers, Integers, Integers]:
        """Return where each row of each copy begins, the columns of its entries, and where their numbers are."""
        if batch not in self._blocks:
            counts = self._counts.repeat(batch)
            copies = np.tile(np.arange(batch, dtype=np.intp), len(self._counts)).repeat(counts)
            starts = np.append(0, np.cumsum(counts))
            firsts = (np.cumsum(self._counts) - self._counts).repeat(batch)
            entries = np.arange(starts[-1]) - (starts[:-1] - firsts).repeat(counts)
            block = starts, self._columns[entries] * batch + copies, self._order[entries] * batch + copies
            narrow = np.int32 if max(starts[-1], len(counts)) < 2**31 else np.intp
            self._blocks[batch] = block[0].astype(narrow), block[1].astype(narrow), block[2]
        return self._blocks[batch]


@cache
def kernels_round_products() -> bool:
    """Whether the kernels round a product before they add it, as arrays do; on some processors they do not."""
    factor, total, starts, column = np.full(2, 1.0 + 2.0**-30), np.full(4, -(1.0 + 2.0**-29)), [0, 1], [0]
    csr_matvec(1, 1, np.array(starts), np.array(column), factor[:1], factor[:1], total[:1])
    csr_matvecs(1, 1, 2, np.array(starts), np.array(column), factor[:1], factor, total[2:])
    return not total[[0, 2, 3]].any()


class RowSum:
    """A sparse matrix W that maps arrays of shape (columns, B) to (rows, B): y_i = Σ_k W_ik x_k.

    Each row is summed in the order of its columns, one batch column like another, so the bits of a column do not depend
    on the batch it is in; BLAS does not promise that.
    """

    def __init__(self, rows: ArrayLike, columns: ArrayLike, weights: ArrayLike, shape: tuple[int, int]) -> None:
        """Build W from its entries, or from places that share one weight; entries at the same place are added."""
        weights = np.broadcast_to(np.asarray(weights, dtype=np.float64), np.shape(rows))
        matrix = sparse.csc_array((weights, (rows, columns)), shape=shape, dtype=np.float64)
        matrix.sort_indices()
        self.shape, self._starts, self._rows = shape, matrix.indptr, matrix.indices
        self._weights: Floats = matrix.data
        self._transposes: dict[bool, RowSum] = {}
        self._kernels: dict[int, Callable[[Floats, Floats], object]] = {}

    def kernel(self, batch: int) -> Callable[[Floats, Floats], object]:
        """Return what adds W x to y in place, ``kernel(x, y)``, for C-contiguous arrays of so many columns."""
        if batch not in self._kernels:
            entries = self._starts, self._rows, self._weights
            kernel, columns = (csc_matvec, ()) if batch == 1 else (csc_matvecs, (batch,))
            self._kernels[batch] = partial(kernel, *self.shape, *columns, *entries)
        return self._kernels[batch]

    def __call__(self, values: Floats) -> Floats:
        """Return W x for x of shape (columns, B)."""
        return self.add_to(np.zeros((self.shape[0], values.shape[1])), values)

    def add_to(self, result: Floats, values: Floats) -> Floats:
        """Add W x to ``result``, shape (rows, B), in place, and return it; both arrays are C-contiguous."""
        self.kernel(values.shape[1])(values, result)
        return result

    def substitute(self, values: Floats) -> Floats:
        """Replace ``values``, shape (rows, B), by (I − W)⁻¹ values, for W square and strictly lower triangular.

        The kernels go through the columns in their order and add as they go: when it is a row's turn to be passed on,
        all that the rows before it pass to it has been added.
        """
        return self.add_to(values, values)

    def scaled_by(self, factor: float) -> RowSum:
        """Return factor·W."""
        matrix = copy(self)
        matrix._weights, matrix._transposes, matrix._kernels = self._weights * factor, {}, {}
        return matrix

    def transpose(self, *, reverse: bool = False) -> RowSum:
        """Return Wᵀ; with ``reverse`` rows and columns in the opposite order, so that it can ``substitute`` again."""
        if reverse not in self._transposes:
            columns, rows = np.repeat(np.arange(self.shape[1]), np.diff(self._starts)), self._rows
            if reverse:
                columns, rows = self.shape[1] - 1 - columns, self.shape[0] - 1 - rows
            self._transposes[reverse] = RowSum(columns, rows, self._weights, self.shape[::-1])
        return self._transposes[reverse]

    def column_sums(self) -> Floats:
        """Return Σ_i W_ik for each column k."""
        sums: Floats = np.add.reduceat(np.append(self._weights, 0.0), self._starts[:-1])
        return np.where(np.diff(self._starts) > 0, sums, 0.0)

    def select_rows(self, rows: list[int]) -> RowSum:
        """Return the matrix of the given rows of W."""
        matrix = sparse.csc_array((self._weights, self._rows, self._starts), shape=self.shape)[rows].tocoo()
        return RowSum(matrix.row, matrix.col, matrix.data, (len(rows), self.shape[1]))
