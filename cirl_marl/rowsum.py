"""Weighted row sums over a batch, the one sparse operation of the library."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse

# The kernel behind scipy's ``csr_array @ dense``. For the small matrices here
# the operator spends most of its time on dispatch and on a fresh result; the kernel adds to an array already there.
from scipy.sparse._sparsetools import csr_matvecs

Floats = NDArray[np.float64]


class RowSum:
    """A sparse matrix W that maps arrays of shape (columns, B) to (rows, B): y_i = Σ_k W_ik x_k.

    Each row is summed in the order of its columns, one batch column like another, so the bits of a column do not depend
    on the batch it is in; BLAS does not promise that.
    """

    def __init__(self, rows: ArrayLike, columns: ArrayLike, weights: ArrayLike, shape: tuple[int, int]) -> None:
        """Build W from its entries; entries at the same place are added."""
        matrix = sparse.csr_array((weights, (rows, columns)), shape=shape, dtype=np.float64)
        matrix.sort_indices()
        self.shape = shape
        self._rows = matrix.indptr
        self._columns = matrix.indices
        self._weights: Floats = matrix.data

    def __call__(self, values: Floats) -> Floats:
        """Return W x for x of shape (columns, B)."""
        result = np.zeros((self.shape[0], values.shape[1]))
        return self.add_to(result, values)

    def add_to(self, result: Floats, values: Floats) -> Floats:
        """Add W x to ``result``, shape (rows, B), in place, and return it; both arrays are C-contiguous."""
        rows, columns = self.shape
        csr_matvecs(
            rows,
            columns,
            values.shape[1],
            self._rows,
            self._columns,
            self._weights,
            values.reshape(-1),
            result.reshape(-1, copy=False),
        )
        return result

    def scaled(self, factor: float) -> RowSum:
        """Return factor·W."""
        other = object.__new__(RowSum)
        other.shape, other._rows, other._columns = self.shape, self._rows, self._columns
        other._weights = self._weights * factor
        return other

    def column_sums(self) -> Floats:
        """Return Σ_i W_ik for each column k."""
        sums: Floats = np.bincount(self._columns, weights=self._weights, minlength=self.shape[1]).astype(float)
        return sums

    def chosen(self, rows: list[int]) -> RowSum:
        """Return the matrix of the given rows of W."""
        matrix = sparse.csr_array((self._weights, self._columns, self._rows), shape=self.shape)[rows].tocoo()
        return RowSum(matrix.row, matrix.col, matrix.data, (len(rows), self.shape[1]))
