"""Rows over all that ever entered a lifetime, written by what later intervals see of it: few variables, short rows.

A row H e ≤ … over what enters in all intervals so far has an entry for each of their moments. But kernels of lifetimes
are smooth: what intervals after t see of the inflow until then are few of its combinations z_t. With u the inflow in
shares of its box::

    z_t = A_t z_{t−1} + B_t u_t,    H_t u = C_t z_{t−1} + D_t u_t.

The columns of V_t, z_t = V_tᵀ u, are the singular vectors of what rows after t have of the columns until t; those with
singular values below ``NEGLIGIBLE`` are left out. The multipliers of the rows are those of the program as it is, of
which the certificate is computed: what is left out makes no bound wrong.

Reference: P. Dewilde, A.-J. van der Veen, Time-Varying Systems and Computations, Springer 1998 (realisation).
"""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from scipy import sparse

from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record

NEGLIGIBLE = 1e-7
"""Singular values that are left out, of rows whose largest term is 1 where all variables are at the ends of boxes."""
MANY_ENTRIES = 50_000
"""Entries of the rows of a lifetime, below which they stay as they are."""
SHORTER = 0.3
"""Part of these entries that there may be in the other form; more variables may cost as much as they save. With 0.6
seed 99 of the cycles with lifetimes of ``benchmarks.yearly`` takes 83 s in place of 70 (degree 1, ``tight``)."""


@positional_record
class History:
    """Rows G v = (beside + kernel·inflow) v of a program."""

    interval: Annotated[Integers, "of each row, which sees what entered until its end, shape (rows,)"]
    beside: Annotated[Any, "sparse, shape (rows, variables)"]
    kernel: Annotated[Any, "H, sparse, shape (rows, moments of all intervals)"]
    inflow: Annotated[Any, "what enters, of the variables; not negative; sparse, shape (moments, variables)"]

    @property
    def matrix(self) -> Any:
        """The rows over the variables, sparse."""
        return sparse.csr_array(self.beside + self.kernel @ self.inflow)

    @property
    def entries(self) -> float:
        """How many entries the matrix has, about."""
        return float(self.kernel.nnz * self.inflow.nnz / self.inflow.shape[0])

    def is_in(self, matrix: Any, rows: slice) -> bool:
        """Whether these rows of a matrix are still these, and not those of another program that was made of it."""
        return bool(matrix.shape[1] == self.beside.shape[1] and (matrix[rows] != self.matrix).nnz == 0)

    def short_form(self, size: Floats, intervals: int) -> ShortRows | None:
        """Return the rows in the other form if that is much shorter, else None.

        Args:
            size: of each variable, the largest that it will be.
            intervals: of the program.
        """
        box = self.inflow @ size
        box[box == 0] = 1.0
        kernel = self.kernel.toarray() * box
        beside = (abs(self.beside) @ sparse.diags_array(size)).max(axis=1).toarray().ravel()
        largest = np.maximum(np.abs(kernel).max(axis=1), beside)
        largest[largest == 0] = 1.0
        kernel /= largest[:, None]
        moments, views = len(box) // intervals, _views_from_later(kernel, self.interval, intervals)
        ends = np.cumsum([0, *(vectors.shape[1] for vectors in views)])
        if not ends[-1]:  # no row looks back
            return None
        motion = sparse.lil_array((ends[-1], len(box) + ends[-1]))
        rows = sparse.lil_array((len(kernel), len(box) + ends[-1]))
        motion.setdiag(-1.0, len(box))
        ranges = list[Floats]()  # what states are of the moments: nearly ``views``, as little is left out
        for t, vectors in enumerate(views):
            lines, state = np.flatnonzero(self.interval == t), slice(ends[t], ends[t + 1])
            block, before = slice(t * moments, (t + 1) * moments), slice(t * moments)
            rows[lines, block], motion[state, block] = kernel[lines, block], vectors[block].T
            if t:
                last_state = slice(len(box) + ends[t - 1], len(box) + ends[t])
                rows[lines, last_state] = kernel[lines, before] @ views[t - 1]
                motion[state, last_state] = transition = vectors[before].T @ views[t - 1]
                ranges.append(np.concatenate([ranges[-1] @ transition.T, vectors[block]]))
            else:
                ranges.append(vectors)
        form = ShortRows(
            shares=sparse.csr_array(sparse.diags_array(1.0 / box) @ self.inflow),
            motion=sparse.csr_array(motion),
            rows=sparse.csr_array(sparse.diags_array(largest) @ rows),
            low=np.concatenate([np.zeros(len(box)), *(np.minimum(part, 0.0).sum(axis=0) for part in ranges)]),
            high=np.concatenate([np.ones(len(box)), *(np.maximum(part, 0.0).sum(axis=0) for part in ranges)]),
        )
        return form if form.motion.nnz + form.rows.nnz <= SHORTER * self.entries else None


@positional_record
class ShortRows:
    """Rows over u and z, which are variables too."""

    shares: Annotated[Any, "u of the variables, sparse, shape (moments, variables)"]
    motion: Annotated[Any, "A z + B u − z = 0, sparse, shape (states, moments + states)"]
    rows: Annotated[Any, "C z + D u, sparse, shape (rows, moments + states)"]
    low: Annotated[Floats, "least of u and z"]
    high: Annotated[Floats, "greatest"]


def _views_from_later(kernel: Floats, interval: Integers, intervals: int) -> list[Floats]:
    """Return V_t for each interval: what rows after it see of the columns until then, shape (columns, states)."""
    moments = kernel.shape[1] // intervals
    views, later = list[Floats](), np.zeros((0, kernel.shape[1]))
    for t in reversed(range(intervals)):
        columns = (t + 1) * moments
        rows = np.concatenate([kernel[interval == t + 1, :columns], later[:, :columns]])
        _, values, vectors = np.linalg.svd(rows, full_matrices=False)
        count = int((values > NEGLIGIBLE).sum())
        later = values[:count, None] * vectors[:count]
        views.insert(0, vectors[:count].T)
    return views
