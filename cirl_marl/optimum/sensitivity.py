"""What a little more of something changes in the optimum of a program, from its multipliers, without another solution.

With the Lagrangian of the program at its optimum v, y, μ, d = c − Aᵀy − Gᵀμ ::

    L = cᵀv + yᵀ(b − A v) + μᵀ(g − G v) + d₊ᵀ(l − v) + d₋ᵀ(u − v),

the least cost of a program whose numbers are a little different differs, to first order, by the difference of L at the
same v, y, μ and d. Each row and each variable belongs to an interval, and so does its part of the difference. Where the
optimum has a kink, a little less may be worth more than a little more; then any of the slopes in between is found.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.program import Program
from cirl_marl.optimum.solver import solve

WIDER = 10.0
"""Factor by which boxes are widened that follow from the start, so that no multiplier rests on them."""


def resting_on_rows(bound: Bound, admissible: Admissible) -> Bound:
    """Return a bound with boxes so wide that its multipliers rest on rows wherever they can.

    Boxes of stocks and of what these drive follow from the start and from all that may happen. An optimum that lies on
    one lies on rows as well, as a rule, and either may have the multiplier; more of a stock moves both. Where no rows
    hold it the objective rises a little; it is a bound all the same.
    """
    wider = with_wide_boxes(bound.problem, admissible)
    solution = solve(wider, bound.basis, label="the program of the shadow prices")
    return replace(bound, problem=wider, solution=solution.plan, certificate=solution.certificate, basis=solution.basis)


def with_wide_boxes(problem: Program, admissible: Admissible) -> Program:
    """Return a program in which boxes that follow from the start hold nothing."""
    free = _start_dependent(admissible, problem.layout)
    high = problem.high.reshape(-1, problem.layout.size).copy()
    largest = high.max(axis=0)
    # a stock that nothing reaches has a box of 0, which no factor widens
    largest[free & (largest == 0)] = high.max()
    high[:, free] = WIDER * np.maximum(high, largest)[:, free]
    return replace(problem, high=high.ravel())


def _start_dependent(admissible: Admissible, layout: Layout) -> NDArray[np.bool_]:
    """Return which variables of an interval have boxes that follow from the start, shape (size,)."""
    follows, by_stock = np.zeros(layout.size, dtype=bool), ~admissible.by_schedule
    nodes, arcs = len(layout.network.nodes), len(layout.network.arcs)
    for i in layout.moments:
        follows[layout.stock[i] : layout.flow[i]] = True
        follows[layout.flow[i] : layout.valve[i]] = by_stock
        follows[layout.valve[i] :][: len(layout.valves)] = True
    for piece in range(layout.pieces):
        follows[layout.end[piece] :][: len(layout.network.stores)] = True
        if layout.has_end_flows:
            follows[layout.end[piece] :][:nodes] = True
            follows[layout.end_flow[piece] :][:arcs] = by_stock
    follows[layout.steady : layout.level] = True
    follows[layout.imbalance] = True
    return follows


def changes(bound: Bound, admissible: Admissible, variant: Program) -> Floats:
    """Return how much the objective of a bound rises, to first order, with the numbers of another program.

    Args:
        bound: the bound, resting on rows.
        admissible: of its network.
        variant: a program with the same rows and variables.

    Returns:
        The parts of it by interval, shape (steps,). What changes in one interval may make room in later ones, and these
        parts are theirs.

    Raises:
        ValueError: if the rows or variables differ.
    """
    problem, v, layout = bound.problem, bound.solution, bound.problem.layout
    y, mu = bound.certificate.equal, np.minimum(bound.certificate.under, 0.0)
    pairs = ((problem.equal, variant.equal), (problem.under, variant.under))
    if any(rows.shape != variant_rows.shape for rows, variant_rows in pairs) or layout.size != variant.layout.size:
        raise ValueError("the programs differ in their rows or variables")
    reduced_cost = problem.cost - problem.equal.T @ y - problem.under.T @ mu
    least, most = np.maximum(reduced_cost, 0.0), np.minimum(reduced_cost, 0.0)
    steps = len(v) // layout.size
    # boxes that follow from the start are as wide as they were made: their change counts for nothing
    wider = np.where(np.tile(_start_dependent(admissible, layout), steps), 0.0, variant.high - problem.high)
    cost = (variant.cost - problem.cost) * v + least * (variant.low - problem.low) + most * wider
    by_interval = cost.reshape(steps, -1).sum(axis=1)
    rights = (variant.equal_to - problem.equal_to, variant.under_to - problem.under_to)
    for (rows, variant_rows), multipliers, right in zip(pairs, (y, mu), rights, strict=True):
        parts = multipliers * (right - (variant_rows @ v - rows @ v))
        by_interval += np.bincount(problem.interval_of_rows(rows), parts, steps)
    rise: Floats = variant.constant - problem.constant - by_interval
    return rise
