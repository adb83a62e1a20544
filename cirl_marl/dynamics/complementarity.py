"""Linear complementarity problems of many copies: how much is supplied to services that supplies of others also serve.

References: Cottle, Pang and Stone 2009, The Linear Complementarity Problem.
"""

from __future__ import annotations

import numpy as np

from cirl_marl.network import Floats
from cirl_marl.network.compartment_model import Bools

TINY = 1e-9
"""Part of a supply that arrives in an interval, below which it is taken for none."""
CHANGES, PIVOTS = 30, 10
"""Most changes of which supplies are at their bounds, and complementary pivots for each of these bounds."""
DIGITS, ROUNDING = 10, 1e-12
"""Of ratios of pivots, which are compared, and what is taken for 0 in them."""
AT_BOUND = 1e-10
"""Part of the most within which what pivots lead to is at its bound."""


def complementary(slope: Floats, shortage: Floats, supply: Floats, most: Floats, interval: float) -> Floats:
    """Return V, shape (services, B), at which nothing lacks that can be supplied, for q linear around ``supply``.

    Each copy goes its own way, whatever the others in the batch do.

    Args:
        slope: A, shape (B, services, services).
        shortage: D − q at ``supply``, shape (services, B).
        supply: V.
        most: largest V.
        interval: length of an interval, by which a flow becomes a stock.
    """
    short, now, high = (np.ascontiguousarray(array.T) for array in (shortage, supply, most))
    # more of what does not arrive is not supplied
    arrives = np.diagonal(slope, axis1=1, axis2=2) > TINY * min(1.0, interval)
    if len(shortage) == 1:
        step = np.divide(short, slope[:, 0], out=np.zeros_like(short), where=arrives)
        return np.clip(now + step, 0.0, high).T
    solution, is_solved = _active_set(slope, short, now, high, arrives)
    for copy in np.flatnonzero(~is_solved).tolist():
        solution[copy] = _complementary_pivots(*(array[copy] for array in (slope, short, now, high, arrives)))
    return np.ascontiguousarray(solution.T)


def _active_set(slope: Floats, shortage: Floats, supply: Floats, most: Floats, arrives: Bools) -> tuple[Floats, Bools]:
    """Return V as ``complementary`` does, shape (B, services), and in which copies it is found.

    All supplies between their bounds are solved for together; then it is changed which these are, from those that are
    now. A copy for which that comes to no end is left to complementary pivots.
    """
    target = shortage + (slope * supply[:, None]).sum(axis=2)
    at_bound = np.where(shortage > 0, supply >= most, supply <= 0)  # as if what lacks now lacked still
    free = arrives & (most > 0) & ~at_bound
    solution, pinned_values = supply.copy(), supply.copy()
    is_solved, unit = np.zeros(len(supply), dtype=bool), np.eye(supply.shape[1])
    for _ in range(CHANGES):
        left = np.flatnonzero(~is_solved)
        a, b, pinned, high = (array[left] for array in (slope, target, pinned_values, most))
        is_free: Bools = free[left]
        trial = _solve(np.where(is_free[..., None], a, unit), np.where(is_free, b, pinned))
        excess = b - (a * trial[:, None]).sum(axis=2)  # what lacks still
        under, over = is_free & (trial < 0), is_free & (trial > high)
        back = ~is_free & arrives[left] & (high > 0) & np.where(pinned > 0, excess < 0, excess > 0)
        is_settled = ~(under | over | back).any(axis=1) & np.isfinite(trial).all(axis=1)
        solution[left[is_settled]], is_solved[left] = np.clip(trial, 0.0, high)[is_settled], is_settled
        if is_solved.all():
            break
        pinned_values[left] = np.where(under, 0.0, np.where(over, high, pinned))
        free[left] = (is_free & ~under & ~over) | back
    return solution, is_solved


def _solve(matrix: Floats, target: Floats) -> Floats:
    """Return the solutions of linear systems, shape (B, services); NaN where one is singular."""
    try:
        solution: Floats = np.asarray(np.linalg.solve(matrix, target[..., None])[..., 0], dtype=np.float64)
    except np.linalg.LinAlgError:
        if len(matrix) == 1:
            return np.full_like(target, np.nan)
        return np.concatenate([_solve(matrix[i : i + 1], target[i : i + 1]) for i in range(len(matrix))])
    return solution


def _complementary_pivots(slope: Floats, shortage: Floats, supply: Floats, most: Floats, arrives: Bools) -> Floats:
    """Return V of one copy as ``complementary`` does, shape (services,); shapes are without that of copies.

    There may be several, as A need not be a P-matrix: services that each other's supplies serve more than their own.
    """
    target, solution = shortage + slope @ supply, supply.copy()
    places = np.flatnonzero(arrives & (most > 0))
    if not len(places):
        return solution
    target -= np.delete(slope, places, axis=1) @ np.delete(supply, places)
    matrix, high, target = slope[np.ix_(places, places)], most[places], target[places]
    # of parts of the most, and relative to what is measured, so that pivots compare what can be compared
    scale = np.abs(target) + np.abs(matrix) @ high
    part = _lemke(matrix * high / scale[:, None], target / scale)
    solution[places] = np.where(np.abs(part - part.round()) < AT_BOUND, part.round(), part) * high
    return solution


def _lemke(matrix: Floats, target: Floats) -> Floats:
    """Return v in [0, 1] with A v ≥ b where v = 0, A v ≤ b where v = 1, and A v = b elsewhere.

    With y for what lacks where v = 1 it is w = A v + y − b, s = 1 − v, of which none is negative and vᵀw = yᵀs = 0. As
    A has no negative entry the matrix of this problem is copositive, and as v is bounded pivots lead to a solution.
    Where they lead nowhere, as A is an estimate, what they came to is returned.

    Args:
        matrix: A, shape (services, services).
        target: b, shape (services,).

    References: Lemke 1965, Management Science 11, 681.
    """
    count = len(target)
    size, unit = 2 * count, np.eye(count)
    # columns: w and s, then v and y, what all rows are lent, and the values of what is basic
    loan = 2 * size
    table = np.zeros((size, loan + 2))
    table[:, :size], table[:, loan], table[:, -1] = np.eye(size), -1.0, np.concatenate([-target, np.ones(count)])
    table[:count, size:loan] = -np.concatenate([matrix, unit], axis=1)
    table[count:, size : size + count] = unit
    # of rows that lack most the last, so that all are positive lexicographically
    basis, pivot, row = np.arange(size), loan, size - 1 - int(table[::-1, -1].round(DIGITS).argmin())
    for _ in range(PIVOTS * size if table[row, -1] < 0 else 0):
        former, basis[row] = basis[row], pivot
        table[row] /= table[row, pivot]
        remaining = np.arange(size) != row
        table[remaining] -= table[remaining, pivot, None] * table[row]
        if former == loan:
            break
        pivot = (former + size) % loan
        column = table[:, pivot]
        rows = np.flatnonzero(column > ROUNDING)
        if not len(rows):
            break
        ratios = table[rows][:, [-1, *range(size)]] / column[rows, None]
        row = int(rows[np.lexsort(ratios.round(DIGITS).T[::-1])[0]])  # so that no basis comes twice
    values = np.zeros(loan + 1)
    values[basis] = table[:, -1]
    return np.clip(values[size : size + count], 0.0, 1.0)
