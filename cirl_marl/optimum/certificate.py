"""The dual certificate: multipliers from which anyone can compute an upper bound, whoever found them."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cirl_marl.errors import CirlError
from cirl_marl.network import Floats
from cirl_marl.optimum.program import Program

EPSILON = float(np.finfo(float).eps)


@dataclass(frozen=True, slots=True, kw_only=True)
class Verification:
    """What a certificate proves.

    Attributes:
        bound: upper bound of the objective for all plans, rounding errors included.
        objective: objective of the plan that came with it; ``bound − objective`` is what the solver left open.
        infeasibility: largest amount by which a multiplier of an inequality had the wrong sign; it was set to zero.
        charged: part of the bound due to reduced costs of less than 1e-6 of the largest cost, the solver's tolerance.
        rounding: allowance for rounding errors, included in the bound.
    """

    bound: float
    objective: float
    infeasibility: float
    small_costs: float
    rounding: float


@dataclass(frozen=True, slots=True, kw_only=True)
class Certificate:
    """Multipliers of the rows of a program.

    Attributes:
        equal: of A v = b, any sign, shape (rows of A,).
        under: of G v ≤ g, at most 0, shape (rows of G,).
    """

    equal: Floats
    under: Floats


def verify(problem: Program, certificate: Certificate, plan: Floats) -> Verification:
    """Compute the bound that the multipliers prove, without a solver.

    For every v that satisfies the program and any y and μ ≤ 0::

        cᵀv ≥ bᵀy + gᵀμ + dᵀv ≥ bᵀy + gᵀμ + Σ_j min(d_j l_j, d_j u_j),    d = c − Aᵀy − Gᵀμ

    since A v = b, μᵀG v ≥ μᵀg and l ≤ v ≤ u. No property of y and μ is taken on trust: those that are not optimal, or
    do not solve the dual, make a weaker bound, never a wrong one. The sums are rounded once (``math.fsum``); the
    rounding errors of d are bounded term by term and charged against the bounds of the variables.

    Args:
        problem: the program.
        certificate: the multipliers.
        plan: v of the plan, for its objective.

    Raises:
        CirlError: for a multiplier that is not finite; names its row.
    """
    bound, rounding, reduced_cost, columns = _dual_bound(problem, certificate)
    small = np.abs(reduced_cost) < 1e-6 * np.abs(problem.cost).max(initial=0.0)
    return Verification(
        bound=bound,
        objective=problem.constant - math.fsum(problem.cost * plan),
        infeasibility=float(np.maximum(certificate.under, 0.0).max(initial=0.0)),
        small_costs=-math.fsum(columns[small]),
        rounding=rounding,
    )


def dual_bound(problem: Program, certificate: Certificate) -> float:
    """Return the bound of ``verified`` alone."""
    return _dual_bound(problem, certificate)[0]


def _dual_bound(problem: Program, certificate: Certificate) -> tuple[float, float, Floats, Floats]:
    """Return the bound, the allowance for rounding in it, d, and min(d_j l_j, d_j u_j)."""
    for rows, multipliers in (("A", certificate.equal), ("G", certificate.under)):
        if not np.isfinite(multipliers).all():
            row = int(np.flatnonzero(~np.isfinite(multipliers))[0])
            raise CirlError(f"certificate: the multiplier of row {row} of {rows} is {multipliers[row]}")
    y, mu = certificate.equal, np.minimum(certificate.under, 0.0)
    reduced_cost = problem.cost - problem.equal.T @ y - problem.under.T @ mu
    size = np.abs(problem.cost) + abs(problem.equal).T @ np.abs(y) + abs(problem.under).T @ np.abs(mu)
    terms_per_column = np.diff(problem.equal.tocsc().indptr) + np.diff(problem.under.tocsc().indptr) + 4
    reach = np.maximum(np.abs(problem.low), np.abs(problem.high))
    columns = np.minimum(reduced_cost * problem.low, reduced_cost * problem.high)
    terms = np.concatenate([problem.equal_to * y, problem.under_to * mu, columns])
    # twice what the errors can be, which leaves room for the errors of these two sums
    rounding = 2 * EPSILON * (float(terms_per_column * size @ reach) + 4 * float(np.abs(terms).sum()))
    return problem.constant - math.fsum(terms) + rounding, rounding, reduced_cost, columns
