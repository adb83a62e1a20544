"""What leaves a chain of stages, weighted with Bernstein polynomials: kernels, and polynomials that enclose them.

Theorem 4 of docs/bound.md has the notation; here a piece has length 1, and σ = 1 − τ is the time that is left of it.
"""

from __future__ import annotations

import math
from functools import cache, cached_property, lru_cache

import numpy as np
from scipy import special
from scipy.linalg import expm

from cirl_marl.network import Floats
from cirl_marl.network.lifetimes import Chain

TERMS = 26
"""Degree to which kernels are expanded; what is left out is below 1e-13 of them."""
MARGIN = 1e-12
"""Widening of every enclosure, relative to the largest value of its kernel, for rounding errors, which are smaller."""


class Kernel:
    """What leaves a chain in pieces of equal length, of what is there and of what enters.

    Attributes:
        start_outflow: of what is there in each stage, shape (pieces, d + 1, stages), 1/time.
        low: c̲ of each piece and moment, by those of what enters, shape (pieces, d + 1, pieces, d + 1).
        high: c̄, likewise; both with w_0. Of degree 0 they are the same, of an inflow that is even within pieces.
        start_survivors: what is left at the end of each piece of what is there in each stage, shape (pieces, stages).
        survivors_low: of what entered, below, by the means of what enters, shape (pieces, pieces, d + 1), time.
        survivors_high: above, likewise.
    """

    def __init__(self, chain: Chain, rate: Floats, length: float, degree: int) -> None:
        """Compute it for a rate μ in each piece, shape (pieces,), 1/time."""
        pieces, stages, moments = len(rate), chain.stages, degree + 1
        shape = (pieces, moments, pieces, moments)
        self.start_outflow, self.low, self.high = np.zeros((pieces, moments, stages)), np.zeros(shape), np.zeros(shape)
        self.start_survivors = np.zeros((pieces, stages))
        self.survivors_low, self.survivors_high = np.zeros((2, pieces, pieces, moments))
        unit = chain.matrix / chain.rate
        motions = {mu: _Motion(unit, mu * length, chain.inflow_shares, degree) for mu in np.unique(rate).tolist()}
        parts = self._parts = [motions[mu] for mu in rate.tolist()]
        self._length = length
        later_outflow, transfer = np.empty((0, moments, stages)), np.eye(stages)
        for p, motion in enumerate(parts):
            self.start_outflow[p] = motion.outflow @ transfer / length
            transfer = motion.whole @ transfer
            self.start_survivors[p] = transfer.sum(axis=0)
        survivors = np.empty((0, stages))
        for q in reversed(range(pieces)):
            # of what is there at the end of piece q, what leaves in each later one
            if q + 1 < pieces:
                later_outflow = np.concatenate([parts[q + 1].outflow[None], later_outflow @ parts[q + 1].whole])
            later_bounds = parts[q].later.bounds(later_outflow.reshape(-1, stages) / moments)
            for target, bounds in ((slice(q, q + 1), parts[q].own_bounds), (slice(q + 1, pieces), later_bounds)):
                low, high = (bound.reshape(-1, moments, moments) for bound in bounds)
                self.low[target, :, q], self.high[target, :, q] = low, high
            # of what is there at the end of piece q, what is left at the ends of this and the later ones
            survivors = np.concatenate([np.ones((1, stages)), survivors])
            bounds = parts[q].later.bounds(survivors * length / moments)
            self.survivors_low[q:, q], self.survivors_high[q:, q] = (bound[:, 0] for bound in bounds)
            survivors = survivors @ parts[q].whole
        at_once = chain.weights[0] * np.eye(pieces * moments).reshape(shape)
        self.low += at_once
        self.high += at_once

    @cached_property
    def least(self) -> tuple[Floats, list[Floats]]:
        """The least that leaves at any time of each piece.

        Of what enters, by its moments, but for w_0, shape (pieces, pieces, d + 1); and of what is there, the least
        product of a matrix (some, stages) with it in each piece, 1/time.
        """
        pieces, _, _, moments = self.low.shape
        parts, least = self._parts, np.zeros((pieces, pieces, moments))
        is_even = all(part is parts[0] for part in parts)
        later: list[Floats] = []  # of what is there at the end of a piece, what leaves in the later ones
        for q in reversed(range(-1, pieces)):
            if q + 1 < pieces:
                later = [parts[q + 1].outflows, *(rows @ parts[q + 1].whole for rows in later)]
            if q < 0 or (is_even and q > 0) or not later:
                continue
            low = parts[q].later.bounds(np.concatenate(later) / moments)[0][:, 0]
            ends = np.cumsum([len(rows) for rows in later])[:-1]
            least[q + 1 :, q] = [part.min(axis=0) for part in np.split(low, ends)]
        for q in range(1, pieces if is_even else 0):
            least[q:, q] = least[: pieces - q, 0]
        return least, [rows / self._length for rows in later]

    @property
    def looseness(self) -> float:
        """How far bounds of what leaves in the last piece are apart, relative to it, where as much enters always."""
        low, high = (bound[-1].sum(axis=(1, 2)) for bound in (self.low, self.high))
        return float(((high - low) / high).max())


def unit_outflow(chain: Chain, rate: Floats, length: float, degree: int) -> tuple[Floats, Floats]:
    """Return what leaves, and what is left, of a unit of mass that has just entered a chain, and has stayed.

    Args:
        chain: the stages; what leaves at once, w_0, is not of it.
        rate: μ in each piece, shape (pieces,), 1/time.
        length: of a piece.
        degree: d.

    Returns:
        Means weighted with B_i over each piece p of what entered at the start of piece q, 1/time, shape
        (q, p, d + 1), and what is left of it at the end of p, shape (q, p); 0 before.
    """
    parts = {mu: bernstein_means(chain.matrix / chain.rate * mu * length, degree) for mu in np.unique(rate).tolist()}
    outflow, survivors = np.zeros((len(rate), len(rate), degree + 1)), np.zeros((len(rate), len(rate)))
    stock = np.zeros((chain.stages, len(rate)))
    for p, mu in enumerate(rate.tolist()):
        means, whole = parts[mu]
        stock[:, p] = chain.inflow_shares / chain.inflow_shares.sum()
        outflow[:, p] = (mu * means[:, -1] @ stock).T
        stock = whole @ stock
        survivors[:, p] = stock.sum(axis=0)
    return outflow, survivors


class _Motion:
    """The motion of stages in a piece in which they have passed on μδ times what they hold.

    Attributes:
        whole: e^(Aδ), shape (stages, stages).
        outflow: what leaves, weighted with B_i and times (d + 1), of what is there at its start, shape (d + 1, stages).
        later: of what enters in the piece, where it is at its end.
        own_bounds: enclosure of what leaves in the piece of what enters in it, shape (d + 1, d + 1) each.
    """

    def __init__(self, unit: Floats, turnover: float, inflow_shares: Floats, degree: int) -> None:
        stages, matrix = len(unit), unit * turnover
        means, self.whole = bernstein_means(matrix, degree)
        self.outflow = turnover * means[:, -1]
        self._matrix, self._turnover = matrix, turnover
        self.later = _Smooth(matrix, inflow_shares[:, None], degree)
        self.own_bounds = _own_bounds(matrix, inflow_shares, turnover * np.eye(stages)[[-1]], degree)

    @cached_property
    def outflows(self) -> Floats:
        """What leaves of what is there at its start: at any time between the least and the greatest row."""
        last = self._turnover * np.eye(len(self._matrix))[-1:]
        return np.concatenate([part[:, 0].T for part in _series(self._matrix.T, last.T)])


@lru_cache(maxsize=2**14)
def stock_response(turnover: float, degree: int) -> tuple[Floats, Floats, Floats]:
    """Return what a stock, of which a constant part leaves, holds of what is there at the start of a piece and enters.

    Args:
        turnover: z, so that x' = u − z x in a piece of length 1.
        degree: d.

    Returns:
        The means of e^(−zs) under B_i, shape (d + 1,), and c̲ and c̄, shape (d + 1, d + 1) each: of the means U_j of an
        inflow that is not negative, Σ_j c̲_ij U_j ≤ X_i ≤ Σ_j c̄_ij U_j if nothing is there at the start.
    """
    low, high = _own_bounds(np.array([[-turnover]]), np.ones(1), np.ones((1, 1)), degree)
    return special.hyp1f1(np.arange(degree + 1) + 1, degree + 2, -turnover), low[0], high[0]


def _own_bounds(matrix: Floats, inflow_shares: Floats, rows: Floats, degree: int) -> tuple[Floats, Floats]:
    """Enclose combinations of stages, weighted with B_i, of what enters them in the piece, (rows, d + 1, d + 1) each.

    y' = A y + E ψ_0, ψ_l' = ψ_(l+1): with ψ_0 the polynomial, read from the end of the piece.
    """
    stages = len(matrix)
    block_matrix = np.zeros((stages + degree + 1,) * 2)
    block_matrix[:stages, :stages], block_matrix[:stages, stages] = matrix, inflow_shares
    block_matrix[stages:, stages:] = np.eye(degree + 1, k=1)
    start = np.zeros((stages + degree + 1, degree + 1))
    start[stages:] = np.stack([_derivatives(degree, degree - i) for i in range(degree + 1)], axis=1)
    return _Smooth(block_matrix, start, degree).bounds(np.pad(rows, ((0, 0), (0, degree + 1))))


class _Smooth:
    """f(τ) = v e^(M(1 − τ)) z on [0, 1], for many v and z."""

    def __init__(self, matrix: Floats, start: Floats, degree: int) -> None:
        """Expand e^(Mσ) z for the columns z of ``start``; of degree 0 take its mean."""
        self._margin = MARGIN if degree else 0.0
        if degree == 0:
            self._near, self._rest = (bernstein_means(matrix, 0)[0][0] @ start)[:, :, None], np.zeros((*start.shape, 1))
            return
        nodes = (1 - np.cos(np.pi * (2 * np.arange(degree + 1) + 1) / (2 * degree + 2))) / 2
        polynomials = [math.comb(degree, j) * nodes**j * (1 - nodes) ** (degree - j) for j in range(degree + 1)]
        bernstein = np.stack(polynomials, axis=1)
        values = np.stack([expm(matrix * node) @ start for node in nodes], axis=2)
        self._near = values @ np.linalg.inv(bernstein).T  # coefficients of B_j(σ) that interpolate, shape (n, z, d + 1)
        parts = _series(matrix, start)
        pieces = [part - self._near @ _within(degree, place, len(parts)) for place, part in enumerate(parts)]
        self._rest = np.concatenate(pieces, axis=2)

    def bounds(self, rows: Floats) -> tuple[Floats, Floats]:
        """Return the coefficients of B_j(τ) below and above f, shape (v, z, d + 1) each."""
        near = np.einsum("vn,nzj->vzj", rows, self._near, optimize=True)
        rest = np.einsum("vn,nzj->vzj", rows, self._rest, optimize=True)
        margin = self._margin * np.abs(near).max(axis=2, initial=0.0, keepdims=True)
        low = near + rest.min(axis=2, initial=0.0, keepdims=True) - margin
        high = near + rest.max(axis=2, initial=0.0, keepdims=True) + margin
        return low[:, :, ::-1], high[:, :, ::-1]


def _series(matrix: Floats, start: Floats) -> list[Floats]:
    """Return e^(Mσ) z on equal parts of [0, 1], as coefficients of B_m of degree ``TERMS``, shape (n, z, TERMS + 1)."""
    count = max(1, math.ceil(float(np.abs(matrix).sum(axis=0).max(initial=0.0)) / 2))
    step, at, parts = expm(matrix / count), start, []
    for _ in range(count):
        term, powers = at, []
        for m in range(TERMS + 1):
            powers.append(term)
            term = matrix @ term / (count * (m + 1))
        parts.append(np.stack(powers, axis=2) @ _to_bernstein(TERMS))
        at = step @ at
    return parts


def bernstein_means(matrix: Floats, degree: int, length: float = 1.0) -> tuple[Floats, Floats]:
    """Return the means of e^{Ms} under B_0 … B_d, and e^{Mδ}, shape (d + 1, n, n) and (n, n).

    The first row of exp of the blocks [[M, I, 0, …], [0, 0, I, …], …]·δ has e^{Mδ}, then, for m = 0 … d, the integrals
    of e^{Ms}(δ − s)^m/m! (Van Loan 1978); B_i is a sum of powers of 1 − s/δ.
    """
    n = len(matrix)
    blocks = np.kron(np.eye(degree + 2, k=1), np.eye(n))
    blocks[:n, :n] = matrix
    first = expm(blocks * length)[:n].reshape(n, degree + 2, n).transpose(1, 0, 2)
    powers = [first[m + 1] * math.factorial(m) / length**m for m in range(degree + 1)]
    means = [
        sum(math.comb(i, j) * (-1) ** j * powers[degree - i + j] for j in range(i + 1))
        * (math.comb(degree, i) * (degree + 1) / length)
        for i in range(degree + 1)
    ]
    return np.array(means), first[0]


def _derivatives(degree: int, j: int) -> Floats:
    """Return the derivatives of B_j at 0, of order 0 … d."""
    power = np.polynomial.polynomial.polypow([1.0, -1.0], degree - j)
    coefficients = np.concatenate([np.zeros(j), math.comb(degree, j) * power])
    derivatives: Floats = coefficients * np.array([math.factorial(order) for order in range(degree + 1)])
    return derivatives


@cache
def _to_bernstein(degree: int) -> Floats:
    """Return what turns coefficients of powers into those of B_j, shape (d + 1, d + 1)."""
    orders = range(degree + 1)
    return np.array([[math.comb(j, m) / math.comb(degree, m) for j in orders] for m in orders])


@cache
def _within(degree: int, part: int, count: int) -> Floats:
    """Return what turns coefficients of B_j on [0, 1] into those of degree ``TERMS`` on one of equal parts of it."""
    powers_of = np.zeros((degree + 1, TERMS + 1))
    inside = np.polynomial.Polynomial([part / count, 1 / count])
    for j in range(degree + 1):
        powers = np.polynomial.Polynomial(_derivatives(degree, j) / [math.factorial(m) for m in range(degree + 1)])
        powers_of[j, : degree + 1] = np.resize(np.append(powers(inside).coef, np.zeros(degree + 1)), degree + 1)
    return powers_of @ _to_bernstein(TERMS)
