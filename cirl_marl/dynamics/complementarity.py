"""Linear complementarity problems of many copies: how much is supplied to services that supplies of others also serve.

References: Cottle, Pang and Stone 2009, The Linear Complementarity Problem.
"""

from __future__ import annotations

import numpy as np

from cirl_marl.network import Floats
from cirl_marl.network.compartment_model import Bools

TINY = 1e-9
"""Part of a supply that arrives in an interval, below which it is taken for none."""
SWEEPS, CHANGES = 500, 30
"""Most Gauss-Seidel sweeps, and changes of which supplies are at their bounds."""


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
        return _gauss_seidel(slope, short, now, high, arrives).T
    solution, is_solved = _active_set(slope, short, now, high, arrives)
    if not is_solved.all():
        solution = np.where(is_solved[:, None], solution, _gauss_seidel(slope, short, now, high, arrives))
    return np.ascontiguousarray(solution.T)


def _active_set(slope: Floats, shortage: Floats, supply: Floats, most: Floats, arrives: Bools) -> tuple[Floats, Bools]:
    """Return V as ``complementary`` does, shape (B, services), and in which copies it is found.

    All supplies between their bounds are solved for together; then it is changed which these are, from those that are
    now. A copy for which that comes to no end is left to others.
    """
    target = shortage + (slope * supply[:, None]).sum(axis=2)
    at_bound = np.where(shortage > 0, supply >= most, supply <= 0)  # as if what lacks now lacked still
    free = arrives & (most > 0) & ~at_bound
    pinned_values: Floats = np.where(arrives & ~at_bound, 0.0, supply)
    solution, is_solved, unit = supply.copy(), np.zeros(len(supply), dtype=bool), np.eye(supply.shape[1])
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


def _gauss_seidel(slope: Floats, shortage: Floats, supply: Floats, most: Floats, arrives: Bools) -> Floats:
    """Return V as ``complementary`` does, shape (B, services), by projected Gauss-Seidel sweeps."""
    count, solution = shortage.shape[1], supply.copy()
    open_ = np.ones(len(shortage), dtype=bool)
    for _ in range(SWEEPS):
        before = solution.copy()
        for s in range(count):
            short = shortage[:, s] - (slope[:, s] * (solution - supply)).sum(axis=1)
            step = np.divide(short, slope[:, s, s], out=np.zeros_like(short), where=arrives[:, s])
            solution[:, s] = np.where(open_, np.clip(solution[:, s] + step, 0.0, most[:, s]), solution[:, s])
        open_ &= (np.abs(solution - before) > 1e-15 * solution).any(axis=1)
        if count == 1 or not open_.any():
            break
    return solution
