"""HiGHS, which solves the linear programs; later ones may start from the basis of an earlier one.

References: Huangfu and Hall 2018, Mathematical Programming Computation 10, 119 (HiGHS).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Annotated

import highspy
import numpy as np
from scipy import sparse

from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.admissible import NoCertificate
from cirl_marl.optimum.certificate import Certificate, verify
from cirl_marl.optimum.histories import MANY_ENTRIES
from cirl_marl.optimum.interruption import run_until_interrupt
from cirl_marl.optimum.program import LinearProgram, Program

WARM_ITERATIONS = 2000
"""Simplex iterations from a given basis after which interior points, which need none, are the faster way."""
PRIMAL, DEVEX = 4, 1
"""HiGHS's numbers of the primal simplex method, and of the weights of edges by Devex (Forrest and Goldfarb 1992)."""
NO_PLAN = (highspy.HighsModelStatus.kInfeasible, highspy.HighsModelStatus.kUnboundedOrInfeasible)
"""As every variable is bounded, the latter means the former."""
HighsOptions = Mapping[str, str | float]
CLEANUP_ITERATIONS = 2000
"""Simplex iterations after interior points. Where these stop short, HiGHS goes on by simplex, without end in programs
of 25 000 variables; after a crossover it takes a few."""
PARALLEL_RULE = 1 << 13
"""HiGHS's number of the rule of presolve that merges parallel rows and columns. Undone without a basis it leaves
multipliers that may be wrong by orders of magnitude; without the rule none of 58 programs of generated cycles had such.
"""
SETTINGS: tuple[HighsOptions, ...] = (
    {"solver": "ipx", "simplex_iteration_limit": CLEANUP_ITERATIONS},
    {"solver": "ipx", "run_crossover": "off", "presolve_rule_off": PARALLEL_RULE},
    {"solver": "ipx", "run_crossover": "off", "presolve": "off"},
    {"solver": "simplex", "presolve": "off"},
)
"""Tried in turn, from nothing, until the certificate of an answer says that it is good.

Crossover, which finds a basis for later programs, and presolve fail now and then: where residence times are a fraction
of a control interval, rows fix a stock several times over, and multipliers of merged rows go wrong. Interior points
without them do not, and leave no basis.
"""
INTERIOR_SETTINGS: tuple[HighsOptions, ...] = ({**SETTINGS[1], "kkt_tolerance": 1e-6}, *SETTINGS)
"""What is tried for a program of which multipliers have to prove something, from PROOF_PROGRAM variables on."""
PROOF_PROGRAM, MERGED_PROOF = 18_000, 12_000
"""Variables from which on a proof is by interior points alone, the latter where pieces are merged.

Crossover ends for the 17 885 of copper_world, and for the 17 687 of seed 172 of the cycles with lifetimes, 7 s in all.
Rows about the ends of merged pieces hold fast stocks several times over, and it is slower: for 15 064 (seed 6, degree
2) 15.7 s in all, where interior points prove as much in 6.8; for 17 388 (seeds 158 and 199) HiGHS gives up after 19.
"""
EXTRA = "highspy_extras"
"""Package that brings HiPO."""
LARGE_PROGRAM = 100_000
"""Variables from which on a program is large: crossover may then take hours."""
BASIS_PROGRAM = 25_000
"""Variables from which on a plan, which proves nothing, is so made too. In windows of steel_world, 35 231, they take
11 s, crossover up to 37 s more; 7600 simplex iterations from a near basis do not end in 13 s, those from nothing end
after 45 s without an answer."""
PLANNED = (highspy.HighsModelStatus.kOptimal, highspy.HighsModelStatus.kUnknown)
"""How HiGHS ends with a plan. The latter is of multipliers that go wrong where presolve is undone without crossover."""
LARGE_SETTINGS: tuple[HighsOptions, ...] = (
    {"solver": "hipo", "hipo_system": "augmented", "run_crossover": "off", "kkt_tolerance": 1e-5},
    {"solver": "ipx", "run_crossover": "off", "time_limit": 3600.0},
)
"""What is tried for it. HiPO, in a package of its own, factorises where the other interior points (IPX) look for a
basis. Below that tolerance it stagnates, and goes on as IPX does. Normal equations would take a hundred times the
operations of the augmented system for steel_world; HiPO needs 4 of 100 s to find that out.
"""
ROUGH_SETTINGS: HighsOptions = {**LARGE_SETTINGS[0], "kkt_tolerance": 5e-3}
"""Tried first where prices are all that is asked for, or plans that are tried out: HiPO comes as far, where it may then
go on as IPX for minutes."""
HIPO_PROGRAM = 50_000
"""Variables from which on HiPO is tried first for a program that proves nothing, though it is not large. Plans of
steel_world have programs of 78,780, for which it needs 12 s."""
MIDDLING_SETTINGS: tuple[HighsOptions, ...] = (ROUGH_SETTINGS, SETTINGS[1])
"""What is tried for these."""
FEASIBLE = 1e-6
"""Largest amount by which the rows of a plan may be missed, relative to their largest term."""
OPTIMAL = 1e-5
"""Relative distance of a plan from its certificate, up to which nothing else is tried."""
NEAR = 2e-3
"""The same for a large program."""
FAIR = 1e-4
"""The same of interior points alone."""
USABLE = 1e-2
"""The same for the best answer of all, beyond which there is no bound."""


class Infeasible(CirlError):
    """A program without solution."""


class SolverFailure(NoCertificate):
    """A program that HiGHS does not solve, whatever is tried; the message says which, and how it ended."""


@positional_record
class Basis:
    """Which variables and rows are basic, and at which bound the others are; HiGHS completes one that is too small."""

    columns: Annotated[Integers, "status of each variable, as HiGHS counts them, shape (columns,)"]
    rows: Annotated[Integers, "status of each row of A, then of G, shape (rows,)"]

    def without_first(self, problem: Program, intervals: int) -> Basis:
        """Return what is left of the basis of ``problem`` for the program without its first ``intervals``."""
        rows = np.concatenate([problem.interval_of_rows(matrix) for matrix in (problem.equal, problem.under)])
        return Basis(self.columns[intervals * problem.layout.size :], self.rows[rows >= intervals])


@positional_record
class Solution:
    """An optimum."""

    plan: Annotated[Floats, "the variables v"]
    certificate: Annotated[Certificate, "the multipliers"]
    basis: Annotated[Basis | None, "from which a similar program may start; None if it was found without"]


def solve(
    problem: Program,
    basis: Basis | None = None,
    *,
    label: str = "the program",
    certify: bool = True,
    same_rows: bool = False,
    is_near: bool = False,
    is_rough: bool = False,
) -> Solution:
    """Minimise cᵀv over the program.

    From a basis the dual simplex method goes on, or the primal one, which is faster if the cost alone differs; else
    ``SETTINGS`` are tried in turn. What counts is not what HiGHS says of its answer but what its multipliers prove: any
    multipliers are a certificate, good ones a tight one.

    Args:
        problem: the program.
        basis: from which to start.
        label: is solved, for the message of an error.
        same_rows: whether ``basis`` is of a program that differs in the cost alone.
        is_near: whether a few iterations from ``basis`` do. Then edges are weighted by reference frameworks (Devex),
            which begin at 1; steepest edges begin with as many solutions as there are rows.
        is_rough: whether an answer to half a percent is enough for a large program.
        certify: whether multipliers must prove the answer good; else what HiGHS calls optimal is taken at its word,
            and of other answers that satisfy the rows the best.

    Raises:
        Infeasible: if there is no solution.
        SolverFailure: if HiGHS finds no usable answer; names the network, what was not solved, and HiGHS's status.
    """
    name, answer, best, status, is_refused = problem.layout.network.name, None, math.inf, "", False
    is_large = len(problem.cost) >= LARGE_PROGRAM
    is_middling = not (certify or is_large) and len(problem.cost) >= BASIS_PROGRAM
    basis = None if is_middling else basis
    attempts: Sequence[HighsOptions] = SETTINGS
    if is_middling:
        attempts = MIDDLING_SETTINGS if len(problem.cost) >= HIPO_PROGRAM else SETTINGS[1:2]
    elif is_large:
        attempts = (ROUGH_SETTINGS, *LARGE_SETTINGS) if is_rough else LARGE_SETTINGS
    elif certify and len(problem.cost) >= (MERGED_PROOF if problem.layout.has_end_flows else PROOF_PROGRAM):
        attempts = INTERIOR_SETTINGS
    if not find_spec(EXTRA):  # HiGHS would take another solver for HiPO
        attempts = [settings for settings in attempts if settings["solver"] != "hipo"]
    # the multipliers of a rough answer are all that is asked for
    needs_plan = is_middling or (is_large and not is_rough)
    size = np.maximum(np.abs(problem.low), np.abs(problem.high))
    short_form = None if basis is not None else _with_short_rows(problem, size)
    program = _ScaledProgram(*(short_form or (problem, size)))
    without_presolve = False
    for settings in (None, *attempts) if basis is not None else attempts:
        has_presolve = settings is not None and settings.get("presolve") != "off"
        if without_presolve and has_presolve:
            continue
        highs = program.run(settings, basis if settings is None else None, primal=same_rows, is_near=is_near)
        model_status = highs.getModelStatus()
        status, is_refused = highs.modelStatusToString(model_status), model_status in NO_PLAN
        if is_refused and settings is not None and not certify:
            if not has_presolve:
                break
            without_presolve = True
        if not program.is_feasible(highs):
            continue
        solution = program.solution(highs)
        if short_form is not None:
            solution = _without_states(problem, solution)
        if not certify and model_status in (PLANNED if needs_plan else PLANNED[:1]):
            return solution
        distance = program.distance(problem, solution)
        if distance < best:
            answer, best = solution, distance
        # interior points alone stop a little away, and others of them take longer to come no closer
        is_interior = settings is not None and settings.get("run_crossover") == "off"
        if best <= (NEAR if is_large else FAIR if is_interior else OPTIMAL):
            break
    # presolve errs now and then, so settings without it have the last word
    if answer is None and is_refused:
        raise Infeasible(f"network '{name}': HiGHS finds that nothing satisfies {label}")
    if answer is None or (certify and best > USABLE):
        lacks_hipo = is_large and not find_spec(EXTRA)
        advice = f"; of {len(problem.cost):,} variables HiPO may: pip install 'cirl-marl[large]'" if lacks_hipo else ""
        raise SolverFailure(f"network '{name}': HiGHS did not solve {label}: {status}{advice}")
    return answer


def _with_short_rows(problem: Program, size: Floats) -> tuple[LinearProgram, Floats] | None:
    """Return a program with short rows for what entered lifetimes, and the size of its variables; None without any.

    Its variables come after those of ``problem``, its rows of A too; its rows of G stand where they stood.
    """
    stays, shares, links = np.ones(len(problem.under_to), dtype=bool), [], []
    beside, over_states, ends = [], [], list[tuple[Floats, Floats]]()
    for first, history in problem.histories:
        rows = slice(first, first + len(history.interval))
        if history.entries < MANY_ENTRIES or not history.is_in(problem.under, rows):
            continue
        short = history.short_form(size, len(size) // problem.layout.size)
        if short is None:
            continue
        stays[rows] = False
        place = sparse.eye_array(len(stays), len(history.interval), k=-first)
        moments, states = len(short.shares.indptr) - 1, short.motion.shape[0]
        shares += [short.shares, sparse.csr_array((states, len(size)))]
        links.append(sparse.vstack([-sparse.eye_array(moments, moments + states), short.motion]))
        beside.append(place @ history.beside)
        over_states.append(place @ short.rows)
        ends.append((short.low, short.high))
    if not ends:
        return None
    low, high = (np.concatenate(values) for values in zip(*ends, strict=True))
    places, shape = np.flatnonzero(stays), (len(stays),) * 2
    rest = sparse.csr_array((np.ones(len(places)), (places, places)), shape=shape) @ problem.under
    before = sparse.csr_array((len(problem.equal_to), len(low)))
    equal = [[sparse.vstack([problem.equal, *shares]), sparse.vstack([before, sparse.block_diag(links)])]]
    program = LinearProgram(
        cost=np.append(problem.cost, np.zeros(len(low))),
        equal=sparse.block_array(equal, format="csr"),
        equal_to=np.append(problem.equal_to, np.zeros(sum(link.shape[0] for link in links))),
        under=sparse.hstack([rest + sum(beside), *over_states], format="csr"),
        under_to=problem.under_to,
        low=np.append(problem.low, low),
        high=np.append(problem.high, high),
    )
    return program, np.concatenate([size, np.maximum(np.abs(low), np.abs(high))])


def _without_states(problem: Program, solution: Solution) -> Solution:
    """Return what is of ``problem`` in a solution of the same with short rows; it has no basis."""
    equal, under = solution.certificate.equal[: len(problem.equal_to)], solution.certificate.under
    return Solution(solution.plan[: len(problem.cost)], Certificate(equal=equal, under=under), None)


def best_values(problem: LinearProgram, size: Floats) -> Floats | None:
    """Return values that minimise a program near enough, for those who try them out; None if nothing is found.

    Args:
        problem: the program.
        size: of each variable, such as the largest that it will be.
    """
    program = _ScaledProgram(problem, size)
    for settings in SETTINGS:
        highs = program.run(settings, None)
        if program.is_feasible(highs):
            return program.solution(highs).plan
    return None


class _ScaledProgram:
    """A program in its own measures: every variable a share of the box that it lies in, every row of its largest term.

    So the units of mass and time of a network, and stocks that differ by orders of magnitude, make no difference to the
    solver, whose tolerances are absolute. With v = D v', R A D v' = R b; multipliers of the rows are R·y'·scale(c).
    """

    def __init__(self, problem: LinearProgram, size: Floats) -> None:
        self.problem = problem
        self._size = np.where(size > 0, size, 1.0)
        rows = sparse.vstack([problem.equal, problem.under], format="csr") @ sparse.diags_array(self._size)
        largest = abs(rows).max(axis=1).toarray().ravel()
        self._row = 1.0 / np.where(largest > 0, largest, 1.0)
        self._rows = sparse.csr_array(sparse.diags_array(self._row) @ rows)
        cost = problem.cost * self._size
        self._scale = float(np.abs(cost).max(initial=0.0)) or 1.0
        self._cost = cost / self._scale
        self._equal = len(problem.equal_to)
        self._to = np.concatenate([problem.equal_to, problem.under_to]) * self._row

    def run(
        self, settings: HighsOptions | None, basis: Basis | None, *, primal: bool = False, is_near: bool = False
    ) -> highspy.Highs:
        """Return HiGHS after a run with ``settings``, or of the dual or ``primal`` simplex method from ``basis``."""
        highs = highspy.Highs()  # type: ignore[no-untyped-call]
        highs.setOptionValue("output_flag", False)
        for option, value in (settings or {"solver": "simplex"}).items():
            highs.setOptionValue(option, value)
        highs.passModel(self._model())
        if basis is not None:
            first = highspy.HighsBasis()
            first.col_status = [highspy.HighsBasisStatus(status) for status in basis.columns.tolist()]
            first.row_status = [highspy.HighsBasisStatus(status) for status in basis.rows.tolist()]
            first.alien = first.valid = True
            highs.setBasis(first)
            if primal:
                highs.setOptionValue("simplex_strategy", PRIMAL)
            if is_near:
                highs.setOptionValue("simplex_dual_edge_weight_strategy", DEVEX)
            highs.setOptionValue("simplex_iteration_limit", WARM_ITERATIONS)
        run_until_interrupt(highs, len(self._size))
        return highs

    def _model(self) -> highspy.HighsLp:
        problem, model = self.problem, highspy.HighsLp()
        model.num_row_, model.num_col_ = self._rows.shape
        model.col_cost_ = self._cost
        model.col_lower_, model.col_upper_ = problem.low / self._size, problem.high / self._size
        model.row_lower_ = np.where(np.arange(len(self._to)) < self._equal, self._to, -np.inf)
        model.row_upper_ = self._to
        matrix = model.a_matrix_
        matrix.format_ = highspy.MatrixFormat.kRowwise
        matrix.num_row_, matrix.num_col_ = self._rows.shape
        matrix.start_, matrix.index_, matrix.value_ = self._rows.indptr, self._rows.indices, self._rows.data
        return model

    def is_feasible(self, highs: highspy.Highs) -> bool:
        """Whether HiGHS has values that satisfy every row and box, whatever it says of them."""
        values = np.array(highs.getSolution().col_value)
        if values.shape != self._size.shape or not np.isfinite(values).all():
            return False
        violation = self._rows @ values - self._to
        violation[: self._equal] = np.abs(violation[: self._equal])
        outside = np.maximum(self.problem.low / self._size - values, values - self.problem.high / self._size)
        return bool(max(violation.max(initial=0.0), outside.max(initial=0.0)) <= FEASIBLE)

    def solution(self, highs: highspy.Highs) -> Solution:
        """Return what HiGHS found, in the units of the network; of a run that failed there is no basis."""
        values, final, basis = highs.getSolution(), highs.getBasis(), None
        multipliers = np.array(values.row_dual) * self._row * self._scale
        if final.valid and highs.getModelStatus() == highspy.HighsModelStatus.kOptimal:
            statuses = (final.col_status, final.row_status)
            basis = Basis(*(np.array([int(status) for status in part], dtype=np.intp) for part in statuses))
        return Solution(
            plan=np.array(values.col_value) * self._size,
            certificate=Certificate(equal=multipliers[: self._equal], under=multipliers[self._equal :]),
            basis=basis,
        )

    def distance(self, problem: Program, solution: Solution) -> float:
        """Return how far the multipliers leave the plan from the bound that they prove, relative to the bound."""
        if not np.isfinite(solution.certificate.equal).all() or not np.isfinite(solution.certificate.under).all():
            return math.inf
        proof = verify(problem, solution.certificate, solution.plan)
        # an objective near 0 is measured by the solver's tolerance on its largest term
        return abs(proof.bound - proof.objective) / max(abs(proof.bound), self._scale * FEASIBLE / OPTIMAL)
