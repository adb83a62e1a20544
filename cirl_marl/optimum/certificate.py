"""The dual certificate: multipliers from which anyone can compute an upper bound, whoever found them."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np

from cirl_marl.errors import CirlError
from cirl_marl.network import Floats
from cirl_marl.network.declarations import frozen_record
from cirl_marl.optimum.program import Program

EPSILON = float(np.finfo(float).eps)


@frozen_record
class Verification:
    """What a certificate proves."""

    bound: Annotated[float, "upper bound of the objective for all plans, rounding errors included"]
    objective: Annotated[float, "that of the plan that came along; ``bound − objective`` is what the solver left open"]
    infeasibility: Annotated[float, "most by which a multiplier of an inequality had the wrong sign; it is set to 0"]
    small_costs: Annotated[float, "part of the bound due to reduced costs below 1e-6 of the largest cost"]
    rounding: Annotated[float, "allowance for rounding errors, included in the bound"]


@frozen_record
class Certificate:
    """Multipliers of the rows of a program."""

    equal: Annotated[Floats, "of A v = b, any sign, shape (rows of A,)"]
    under: Annotated[Floats, "of G v ≤ g, at most 0, shape (rows of G,)"]


def verify(problem: Program, certificate: Certificate, plan: Floats) -> Verification:
    """Compute the bound that the multipliers prove, without a solver.

    For every v that satisfies the program and any y and μ ≤ 0::

        cᵀv ≥ bᵀy + gᵀμ + dᵀv ≥ bᵀy + gᵀμ + Σ_j min(d_j l_j, d_j u_j),    d = c − Aᵀy − Gᵀμ

    since A v = b, μᵀG v ≥ μᵀg and l ≤ v ≤ u. No property of y and μ is taken on trust: those that are not optimal, or
    do not solve the dual, make a weaker bound, never a wrong one. The sums are rounded once (``math.fsum``); the
    rounding errors of d are bounded term by term and charged against the bounds of the variables. Multipliers so large
    that a sum overflows prove nothing: the bound is infinite.

    Args:
        problem: the program.
        certificate: the multipliers.
        plan: v of the plan, for its objective.

    Raises:
        CirlError: for a multiplier that is not finite, which names its row, or multipliers of another program.
    """
    pairs = (("A", certificate.equal, problem.equal), ("G", certificate.under, problem.under))
    for rows, multipliers, matrix in pairs:
        if np.shape(multipliers) != matrix.shape[:1]:
            shape = np.shape(multipliers)
            raise CirlError(f"certificate: multipliers of {rows} have shape {shape}, its rows {matrix.shape[:1]}")
        if not np.isfinite(multipliers).all():
            row = int(np.flatnonzero(~np.isfinite(multipliers))[0])
            raise CirlError(f"certificate: the multiplier of row {row} of {rows} is {multipliers[row]}")
    with np.errstate(over="ignore", invalid="ignore"):
        return _verification(problem, certificate, plan)


def _verification(problem: Program, certificate: Certificate, plan: Floats) -> Verification:
    """Return what finite multipliers of the program prove."""
    y, mu = certificate.equal, np.minimum(certificate.under, 0.0)
    reduced_cost = problem.cost - problem.equal.T @ y - problem.under.T @ mu
    size = np.abs(problem.cost) + abs(problem.equal).T @ np.abs(y) + abs(problem.under).T @ np.abs(mu)
    terms_per_column = np.diff(problem.equal.tocsc().indptr) + np.diff(problem.under.tocsc().indptr) + 4
    reach = np.maximum(np.abs(problem.low), np.abs(problem.high))
    columns = np.minimum(reduced_cost * problem.low, reduced_cost * problem.high)
    terms = np.concatenate([problem.equal_to * y, problem.under_to * mu, columns])
    # twice what the errors can be, which leaves room for the errors of these two sums
    rounding = 2 * EPSILON * (float(terms_per_column * size @ reach) + 4 * float(np.abs(terms).sum()))
    small = np.abs(reduced_cost) < 1e-6 * np.abs(problem.cost).max(initial=0.0)
    has_sum = math.isfinite(rounding)  # as it has all terms and their absolute sum
    return Verification(
        bound=problem.constant - math.fsum(terms) + rounding if has_sum else math.inf,
        objective=problem.constant - math.fsum(problem.cost * plan),
        infeasibility=float(np.maximum(certificate.under, 0.0).max(initial=0.0)),
        small_costs=-math.fsum(columns[small]) if has_sum else math.inf,
        rounding=rounding if has_sum else math.inf,
    )
