"""What idle arcs supply at most in episodes that do well: an end that programs can follow exactly.

Arcs that make up for the same service are asked for u_k = min(low_k + w_k·V, high_k) with one V. A program knows the
convex hull of these alone (``constraints.idle_supplies``), in which the last arcs to come to their ends replace the
first at once. Let arc f be the first, at V_f = (high_f − low_f)/w_f. A program with the row

    objective ≥ L

proves that episodes with at least this objective have Σ_{t∈W} (u_f,t − low_f,t) ≤ c over some intervals W. Where c is
less than w_f·V_f in each of these, V < V_f there, and with low_k + w_k·V_f as the end of each arc those episodes stay
what they are, while the hull becomes a line. So a bound B of the narrower network proves max(B, L) of the network.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

import numpy as np
from scipy import sparse

from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.series import Series
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.bounds import Bound
from cirl_marl.optimum.certificate import verify
from cirl_marl.optimum.constraints import idle_groups
from cirl_marl.optimum.program import LARGE, Program, Programs, possible_range
from cirl_marl.optimum.solver import solve
from cirl_marl.optimum.vintages import LOOSE

PROOF_DEGREE = 1
"""Degree of the programs, several of which are solved; the least is enough to tell far from near."""
WINDOW = 0.5
"""What the plan supplies in the intervals of one program, relative to what has to be more than can be."""


def with_supply_limits(bound: Bound, least: float) -> Network:
    """Return the network with lower ends of idle supplies, which no episode with at least some objective exceeds.

    Ends stay where nothing is proved: of supplies whose donors may run dry, of networks with substances, and of
    programs of more than ``LARGE`` variables, several of which would be solved.

    Args:
        bound: of the network, with what is demanded of its services; its plan tells how many intervals a program has.
        least: the objective L, in the direction of ``bound.objective``.

    Raises:
        CirlError: if a solver fails.
    """
    network, admissible = bound.network, Admissible.of(bound.network, bound.agents or None)
    groups = [] if network.substances or bound.problem.cost.size > LARGE else idle_groups(admissible)
    if not groups:
        return network
    programs, intervals = Programs(admissible, PROOF_DEGREE, None, loose=LOOSE), range(network.episode.horizon)
    problem = programs.program(bound.initial, bound.min_service, aims=replace(bound.aims, budgets=()))
    reward = sparse.csr_array(problem.cost[None])
    problem = replace(
        problem,
        under=sparse.vstack([reward, problem.under], format="csr"),
        under_to=np.append(problem.constant - least, problem.under_to),
        constant=0.0,
    )
    uncut = possible_range(admissible.lifetimes, programs.system, bound.initial, intervals)[0].uncut
    layout, (low, high) = bound.problem.layout, admissible.setting
    flow = layout.means(bound.solution.reshape(-1, layout.size))[1]
    end = high.copy()
    for arcs, weight in groups:
        arcs, weight = arcs[weight > 0], weight[weight > 0]
        extent = (high - low)[:, arcs] / weight
        first = arcs[extent.argmin(axis=1)]
        bends = np.flatnonzero((extent.min(axis=1) < extent.max(axis=1)) & uncut[intervals, first])
        for window in _windows(bends, (flow - low)[intervals, first], (high - low)[intervals, first]):
            proved = _below(problem, window, first, low, (high - low)[intervals, first])
            rows = np.array(proved, dtype=np.intp)[:, None]
            end[rows, arcs] = low[rows, arcs] + weight * extent[rows.ravel()].min(axis=1, keepdims=True)
    ids = [arc.id for arc in admissible.network.arcs]
    changes = np.flatnonzero((end < high).any(axis=0)).tolist()
    return _with_ends(network, {ids[k]: end[:, k] for k in changes}) if changes else network


def _windows(intervals: Integers, supply: Floats, room: Floats) -> Iterator[list[int]]:
    """Yield parts of some intervals, one after the other, in which a plan supplies WINDOW times the room at most."""
    window: list[int] = []
    for t in intervals.tolist():
        if window and supply[[*window, t]].sum() > WINDOW * room[[*window, t]].min():
            yield window
            window = []
        window.append(t)
    if window:
        yield window


def _below(problem: Program, window: list[int], first: Integers, low: Floats, room: Floats) -> list[int]:
    """Return the intervals of a window in which the arcs that bend first are proved to stay below their ends."""
    layout, cost = problem.layout, np.zeros_like(problem.cost)
    for t in window:
        cost[t * layout.size + layout.flow + first[t]] = -1.0 / len(layout.moments)
    solution = solve(replace(problem, cost=cost), label="the program of the most that idle arcs supply")
    most = verify(replace(problem, cost=cost), solution.certificate, solution.plan).bound
    if most - low[window, first[window]].sum() < room[window].min():
        return window
    halves = (window[: len(window) // 2], window[len(window) // 2 :]) if len(window) > 1 else ()
    return [t for half in halves for t in _below(problem, half, first, low, room)]


def _with_ends(network: Network, ends: Mapping[str, Floats]) -> Network:
    """Return the network with other highest controls of some arcs, in each interval."""
    times, arcs = np.arange(network.episode.horizon) * network.episode.control_interval, list(network.arcs)
    for id_, end in ends.items():
        k, control = network.arc_index[id_], network.compartments[id_].control
        assert control is not None
        neutral = network.control_bounds[1, network.control_rows[id_].start]
        series = Series(times=tuple(times.tolist()), values=tuple(np.maximum(end, neutral).tolist()))
        arcs[k] = replace(arcs[k], control=replace(control, high=series))
    return replace(network, arcs=tuple(arcs))
