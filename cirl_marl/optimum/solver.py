"""HiGHS, which solves the linear programs; later ones may start from the basis of an earlier one.

References: Huangfu and Hall 2018, Mathematical Programming Computation 10, 119 (HiGHS).
"""

from __future__ import annotations

from dataclasses import dataclass

import highspy
import numpy as np
from scipy import sparse

from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.certificate import Certificate
from cirl_marl.optimum.program import Program

STATUS = tuple(highspy.HighsBasisStatus(i) for i in range(len(highspy.HighsBasisStatus.__members__)))
"""HiGHS's basis statuses by their numbers."""


WARM_ITERATIONS = 2000
"""Simplex iterations from a given basis after which interior points, which need none, are the faster way."""
NO_PLAN = (highspy.HighsModelStatus.kInfeasible, highspy.HighsModelStatus.kUnboundedOrInfeasible)
"""As every variable is bounded, the latter means the former."""


class Infeasible(CirlError):
    """A program without solution."""


@dataclass(frozen=True, slots=True)
class Basis:
    """Which variables and rows are basic, and at which bound the others are; HiGHS completes one that is too small.

    Attributes:
        columns: status of each variable, as HiGHS counts them, shape (columns,).
        rows: status of each row of A, then of G, shape (rows,).
    """

    columns: Integers
    rows: Integers

    def without_first(self, problem: Program, intervals: int) -> Basis:
        """Return what is left of the basis of ``problem`` for the program without its first ``intervals``."""
        rows = np.concatenate([problem.interval_of_rows(matrix) for matrix in (problem.equal, problem.under)])
        return Basis(self.columns[intervals * problem.layout.size :], self.rows[rows >= intervals])


@dataclass(frozen=True, slots=True)
class Solution:
    """An optimum.

    Attributes:
        plan: the variables v.
        certificate: the multipliers.
        basis: from which a similar program may start.
    """

    plan: Floats
    certificate: Certificate
    basis: Basis


def solve(problem: Program, basis: Basis | None = None, *, what: str = "the program") -> Solution:
    """Minimise cᵀv over the program.

    Without a basis interior points and crossover find one; from a basis the dual simplex method goes on.

    Args:
        problem: the program.
        basis: from which to start.
        what: is solved, for the message of an error.

    Raises:
        Infeasible: if there is no solution.
        CirlError: if HiGHS fails for another reason; names the network, what was not solved, and HiGHS's status.
    """
    scale = float(np.abs(problem.cost).max(initial=0.0)) or 1.0  # the solver's tolerances are absolute
    highs = highspy.Highs()  # type: ignore[no-untyped-call]
    highs.setOptionValue("output_flag", False)
    highs.setOptionValue("solver", "ipm" if basis is None else "simplex")
    highs.passModel(_model(problem, scale))
    if basis is not None:
        highs.setBasis(_highs_basis(basis))
        highs.setOptionValue("simplex_iteration_limit", WARM_ITERATIONS)
    highs.run()
    if basis is not None and highs.getModelStatus() not in (highspy.HighsModelStatus.kOptimal, *NO_PLAN):
        return solve(problem, what=what)
    if basis is None and highs.getModelStatus() != highspy.HighsModelStatus.kOptimal:
        highs.setOptionValue("solver", "simplex")  # slower and steadier
        highs.setOptionValue("presolve", "off")  # its own tolerance is too small for rows that fix a stock twice over
        highs.clearSolver()
        highs.run()
    status = highs.getModelStatus()
    name = problem.layout.network.name
    if status in NO_PLAN:
        raise Infeasible(f"network '{name}': HiGHS finds that nothing satisfies {what}")
    if status != highspy.HighsModelStatus.kOptimal:
        raise CirlError(f"network '{name}': HiGHS did not solve {what}: {highs.modelStatusToString(status)}")
    found, final = highs.getSolution(), highs.getBasis()
    rows = np.array(found.row_dual) * scale
    equal = len(problem.equal_to)
    return Solution(
        plan=np.array(found.col_value),
        certificate=Certificate(equal=rows[:equal], under=rows[equal:]),
        basis=Basis(
            np.array([int(each) for each in final.col_status], dtype=np.intp),
            np.array([int(each) for each in final.row_status], dtype=np.intp),
        ),
    )


def _model(problem: Program, scale: float) -> highspy.HighsLp:
    rows = sparse.vstack([problem.equal, problem.under], format="csr")
    model = highspy.HighsLp()
    model.num_row_, model.num_col_ = rows.shape
    model.col_cost_ = problem.cost / scale
    model.col_lower_, model.col_upper_ = problem.low, problem.high
    model.row_lower_ = np.concatenate([problem.equal_to, np.full(len(problem.under_to), -np.inf)])
    model.row_upper_ = np.concatenate([problem.equal_to, problem.under_to])
    matrix = model.a_matrix_
    matrix.format_ = highspy.MatrixFormat.kRowwise
    matrix.num_row_, matrix.num_col_ = rows.shape
    matrix.start_, matrix.index_, matrix.value_ = rows.indptr, rows.indices, rows.data
    return model


def _highs_basis(basis: Basis) -> highspy.HighsBasis:
    result = highspy.HighsBasis()
    result.col_status = [STATUS[each] for each in basis.columns.tolist()]
    result.row_status = [STATUS[each] for each in basis.rows.tolist()]
    result.alien = True
    result.valid = True
    return result
