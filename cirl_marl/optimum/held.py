"""Linear systems ẋ = M x + c with constant c, solved over a substep, small or large."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import linalg, sparse

from cirl_marl.network import Floats

DENSE = 256
"""Rows of the largest system whose solution is kept as matrices."""
NEGLECTED = 1e-17
"""Sum of the terms of the series that are left out, relative to the change that the first term makes."""


class Held:
    """x after a substep h, e^{Mh} x + ∫ e^{Ms} c ds, of a sparse matrix M.

    Of a small system both matrices are kept. Of a large one they would be full, so the series
    x + h Σ_k (Mh)^k/(k + 1)! (M x + c) is summed. With μ = ‖Mh‖₁ the terms from K on are, in the 1-norm, at most
    μ^K/(K + 1)!·1/(1 − μ/(K + 2)) of the first, since each is at most μ/(K + 2) of the one before.
    """

    def __init__(self, matrix: Any, interval: float) -> None:
        """Take M, in coordinates, 1/time, and h."""
        self._size, self._interval = matrix.shape[0], interval
        self._neglected = 0.0
        if self._size <= DENSE:
            # exp of [[M, I], [0, 0]]·h has both in its upper blocks (Van Loan 1978)
            extended = np.zeros((2 * self._size, 2 * self._size))
            extended[: self._size, : self._size], extended[: self._size, self._size :] = (
                matrix.toarray(),
                np.eye(self._size),
            )
            solved = linalg.expm(extended * interval)
            self._solution, self._response = solved[: self._size, : self._size], solved[: self._size, self._size :]
            return
        self._matrix = sparse.csr_array(matrix)
        norm = float(abs(self._matrix).sum(axis=0).max(initial=0.0)) * interval
        self._terms, term = 1, norm / 2  # the first term that is left out, relative to the first
        while norm >= self._terms + 2 or term / (1 - norm / (self._terms + 2)) > NEGLECTED:
            self._terms += 1
            term *= norm / (self._terms + 1)
        self._neglected = term / (1 - norm / (self._terms + 2))

    def __call__(self, state: Floats, constant: Floats) -> tuple[Floats, float]:
        """Return x after the substep, from ``state`` and with c = ``constant``, and how far off it may be at most."""
        if self._size <= DENSE:
            return self._solution @ state + self._response @ constant, 0.0
        term = self._interval * (self._matrix @ state + constant)
        missed = self._neglected * float(np.abs(term).sum())
        after = state + term
        for k in range(1, self._terms):
            term = self._matrix @ term * (self._interval / (k + 1))
            after += term
        return after, missed
