"""Lifetimes that an agent stretches, from what entered and when: rows without stages, and the stretches of a plan.

Stages pass on in proportion to μ·v, v being what the agent sets and θ = ∫ μ v dt how much they turn over. Of what
entered at τ the share S(θ(t) − θ(τ)) is left, and θ lies between what the least and the greatest v make of it. As S
falls, so does what is left at the end of a piece lie between what is left with these (theorem 5 of docs/bound.md),

    Σ σ̲_qj U_qj + known ≤ N ≤ Σ σ̄_qj U_qj + known,

and of what entered in an interval q what leaves in a later one p is at most the largest S(θ) − S(θ + μ v̄ h), and at
least the smallest S(θ) − S(θ + μ v̲ h), for turnovers θ that are possible from the one to the other.

When in p it leaves is free so far, so that shares of it may seem to change within p. But at any time v μ g(θ) leaves, g
being what is in the last stage, beside the part w_0 that leaves as it enters: v̲ μ min g at least, and v̄ μ max g at
most, over the θ of p. As no stage empties faster than by what it passes on, g e^θ never falls, which bounds g between
the ends of cells. The least is the constant part of such a life (theorem 6).
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy import sparse, special

from cirl_marl.network import Floats
from cirl_marl.network.lifetimes import Chain
from cirl_marl.optimum.kernels import Kernel
from cirl_marl.optimum.matrices import Layout

CELL = 0.02
"""Turnover of a cell, at the ends of which survival is computed; between them it is enclosed, as it falls."""
TAIL = 12.0
"""Standard deviations of what is left beyond which nothing is."""
WIDER = 1.0 + 1e-9
"""Factor by which what may leave is widened for rounding errors, which are far smaller."""
HALVINGS = 40
"""Of the range of a factor, until it is that of a plan."""


class StretchedRows:
    """The rows of a lifetime over some intervals: of the stock at the end of each piece, and of what leaves in each.

    There are four families: the most and the least stock, the most and the least that leaves.
    """

    def __init__(self, chain: Chain, rate: Floats, factor: Floats, layout: Layout) -> None:
        """Take μ and the least and most that multiplies it, shape (steps,) and (2, steps)."""
        self._layout, self._steps = layout, len(rate)
        by_piece = np.repeat(rate * factor, layout.pieces, axis=1)
        self._kernels = [Kernel(chain, each, layout.length, layout.degree) for each in by_piece]
        self._windows = _Windows(rate, factor, layout.network.episode.control_interval)
        self._low, self._high = _interval_bounds(chain, self._windows)
        self._chain, self._rate = chain, rate * factor

    def matrix(self, stock: Any, outflow: Any, inflow: Any) -> Any:
        """Return the rows.

        Args:
            stock: what picks the stock at the end of each piece, sparse, shape (pieces, variables).
            outflow: what picks the means of what leaves, by moment, sparse, shape (moments, variables).
            inflow: likewise of what enters.
        """
        layout, (longest, shortest) = self._layout, self._kernels
        sums = sparse.kron(sparse.eye_array(self._steps), np.full((1, len(layout.moments)), layout.portion))
        left, entered = sums @ outflow, sums @ inflow
        rows = [
            stock - _by_moment(longest.survivors_high) @ inflow,
            _by_moment(shortest.survivors_low) @ inflow - stock,
            left - sparse.csr_array(self._high) @ entered,
            sparse.csr_array(self._low) @ entered - left,
        ]
        return sparse.vstack(rows, format="csr")

    def outflow_bounds(self, inflow: Any, masses: Floats) -> tuple[tuple[Any, Floats], tuple[Any, Floats]]:
        """Return what leaves at any time of each interval at least and at most, beside what leaves as it enters.

        Args:
            inflow: as in ``matrix``.
            masses: in the stages at the start.

        Returns:
            Of each what it is of the variables, sparse, shape (steps, variables), and of what was there at the start.
        """
        windows, last = self._windows, _last_stage_bounds(masses)
        span = zip(windows.before[0], windows.before[1] + windows.in_interval[1], strict=True)
        of_start = self._rate * np.array([last(*ends) for ends in span]).T
        portion = np.full((1, len(self._layout.moments)), self._layout.portion)
        least, most = (sparse.kron(sparse.csr_array(part), portion) @ inflow for part in self._of_entered)
        return (least, of_start[0]), (most, of_start[1])

    @cached_property
    def _of_entered(self) -> Floats:
        """What leaves so in interval p of a unit of mass that enters in q, shape (2, steps, steps)."""
        windows, last = self._windows, _last_stage_bounds(self._chain.inflow_shares)
        bounds = np.zeros((2, self._steps, self._steps))
        for p in range(self._steps):
            turnover = float(windows.in_interval[1, p])
            bounds[1, p, p] = last(0.0, turnover)[1]
            for q in range(p):
                shortest, longest = windows.between[:, p, q].tolist()
                bounds[:, p, q] = last(shortest, longest + turnover)
        return self._rate[:, :, None] * bounds

    def limits(self, masses: Floats) -> Floats:
        """Return the limits of the rows from masses in the stages."""
        most, least = (kernel.start_survivors @ masses for kernel in self._kernels)
        low, high = _start_bounds(masses, self._windows)
        return np.concatenate([most, -least, high, -low])


def _by_moment(bound: Floats) -> Any:
    """Return bounds of what is left at the end of each piece as a matrix of the moments that entered, sparse."""
    return sparse.csr_array(bound.reshape(len(bound), -1))


class _Windows:
    """How much stages can turn over: between intervals, and in each.

    Attributes:
        in_interval: least and most in each interval, shape (2, steps).
        between: least and most from some time in interval q to the start of interval p > q, shape (2, p, q).
        before: least and most from the start to that of each interval, shape (2, steps).
    """

    def __init__(self, rate: Floats, factor: Floats, interval: float) -> None:
        """Take μ and the least and most that multiplies it, shape (steps,) and (2, steps)."""
        self.in_interval = rate * factor * interval
        total = np.concatenate([np.zeros((2, 1)), np.cumsum(self.in_interval, axis=1)], axis=1)
        self.before = total[:, :-1]
        self.between = np.stack([total[0, :-1, None] - total[0, None, 1:], total[1, :-1, None] - total[1, None, :-1]])


class _DiscardBounds:
    """Bounds of what leaves in an interval of masses by the stages that they have to go."""

    def __init__(self, survivors: Floats, turnover: Floats) -> None:
        """Take what is left at the ends of cells, falling to 0, and the least and most turnover of the interval."""
        least, most = int(np.floor(turnover[0] / CELL)), int(np.ceil(turnover[1] / CELL))
        after, cells = np.append(survivors, np.zeros(most + 2)), np.arange(len(survivors))
        self._most = after[cells] - after[cells + 1 + most]
        self._least = np.maximum(after[cells + 1] - after[cells + least], 0.0)

    def within(self, low: float, high: float) -> tuple[float, float]:
        """Return the least and most where they have turned over between ``low`` and ``high`` times before."""
        first = min(int(low / CELL), len(self._most) - 1)
        cells = slice(first, max(first, int(np.ceil(high / CELL))) + 1)
        return float(self._least[cells].min()) / WIDER, float(self._most[cells].max()) * WIDER


def _survivors(masses: Floats) -> Floats:
    """Return what is left at the ends of cells of masses by stage, first the one with most to go; it is 0 at last."""
    return np.append(masses @ _survival(len(masses)), 0.0)


@lru_cache(maxsize=4)
def _survival(stages: int) -> Floats:
    """Return what is left at the ends of cells of what has ``stages`` to go, or fewer, shape (stages, ends)."""
    left: Floats = special.gammaincc(np.arange(stages, 0, -1)[:, None], _cell_ends(stages))
    return left


def _cell_ends(stages: int) -> Floats:
    return np.arange(0.0, stages + TAIL * np.sqrt(stages) + 2 * TAIL, CELL)


def _last_stage_bounds(masses: Floats) -> Callable[[float, float], tuple[float, float]]:
    """Return what bounds how much of masses is in the last stage, by how often they may have turned over."""
    passed, ends = np.arange(len(masses) - 1, -1, -1)[:, None], _cell_ends(len(masses))
    in_last = np.append(masses @ np.exp(special.xlogy(passed, ends) - ends - special.gammaln(passed + 1)), 0.0)

    def within(low: float, high: float) -> tuple[float, float]:
        first = min(int(low / CELL), len(in_last) - 1)
        at_ends = in_last[first : max(first, int(np.ceil(high / CELL))) + 1]
        return float(at_ends.min()) * np.exp(-CELL) / WIDER, float(at_ends.max()) * np.exp(CELL) * WIDER

    return within


def _interval_bounds(chain: Chain, windows: _Windows) -> tuple[Floats, Floats]:
    """Return the least and most that leaves in interval p of a unit of mass that enters in q, shape (steps, steps)."""
    steps, entering = windows.in_interval.shape[1], _survivors(chain.inflow_shares)
    low, high = np.zeros((2, steps, steps))
    by_turnover: dict[bytes, _DiscardBounds] = {}
    for p in range(steps):
        turnover = windows.in_interval[:, p]
        if (key := turnover.tobytes()) not in by_turnover:
            by_turnover[key] = _DiscardBounds(entering, turnover)
        discards = by_turnover[key]
        low[p, p] = chain.weights[0] / WIDER
        cell = min(int(turnover[1] / CELL) + 1, len(entering) - 1)
        high[p, p] = (chain.weights[0] + entering[0] - entering[cell]) * WIDER
        for q in range(p):
            low[p, q], high[p, q] = discards.within(*windows.between[:, p, q].tolist())
    return low, high


def _start_bounds(masses: Floats, windows: _Windows) -> tuple[Floats, Floats]:
    """Return the least and most that leaves in each interval of what is there at the start, shape (steps,) each."""
    left = _survivors(masses)
    bounds = [
        _DiscardBounds(left, turnover).within(*before)
        for turnover, before in zip(windows.in_interval.T, windows.before.T.tolist(), strict=True)
    ]
    low, high = np.array(bounds).T
    return low, high


def planned_turnovers(chain: Chain, turnover: Floats, masses: Floats, inflow: Floats, stock: Floats) -> Floats:
    """Return the turnover of each interval that leaves a planned stock at its end, or as near as may be.

    Args:
        chain: the stages.
        turnover: least and most, shape (2, steps).
        masses: in the stages at the start.
        inflow: mass that enters in each interval, evenly, shape (steps,).
        stock: planned, shape (steps,), mass.

    Returns:
        Shape (steps,).
    """
    found = np.empty(len(stock))
    for t, (low, high) in enumerate(turnover.T.tolist()):
        for _ in range(HALVINGS if low < high else 0):
            middle = (low + high) / 2
            too_much = _after(chain, middle, masses, float(inflow[t])).sum() > stock[t]
            low, high = (middle, high) if too_much else (low, middle)
        found[t] = (low + high) / 2
        masses = _after(chain, found[t], masses, float(inflow[t]))
    return found


def _after(chain: Chain, turnover: float, masses: Floats, inflow: float) -> Floats:
    """Return what is in the stages after they have turned over so often, with an even inflow, mass."""
    passed = np.arange(chain.stages)
    stay = np.exp(passed * np.log(turnover) - turnover - special.gammaln(passed + 1))
    entered = inflow / turnover * special.gammainc(passed + 1, turnover)
    moved = np.convolve(masses, stay) + np.convolve(chain.inflow_shares, entered)
    return np.asarray(moved[: chain.stages])
