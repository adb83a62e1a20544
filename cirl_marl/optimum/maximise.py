"""The best circularity that any admissible actions can reach over an episode: the programs and their solution."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.dynamics.rows import Rows
from cirl_marl.dynamics.stages import inside
from cirl_marl.errors import CirlError, unknown
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.actions import normalised_actions
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.bounds import (
    Bound,
    Envelope,
    by_stage,
    check_service,
    check_stocks,
    demanded_levels,
    said_levels,
)
from cirl_marl.optimum.certificate import verified
from cirl_marl.optimum.objective import circularity_weights
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.optimum.solver import FEASIBLE, Basis, Infeasible, solve

DEGREE = 2
"""Degree of the test polynomials; docs/bound.md has the gap against it."""


def bound(
    network: str | Path | Network,
    initial: Mapping[str, float] | ArrayLike | None = None,
    *,
    service_weight: float | None = None,
    min_service: ArrayLike | None = None,
    agents: Sequence[str] | None = None,
    scenario: str | None = None,
    horizon: int | None = None,
    degree: int = DEGREE,
    near: Bound | None = None,
) -> Bound:
    """Bound what any admissible actions can reach over one episode in the simulator.

    Without options the bound is on λ̄; with ``min_service`` on λ̄ of episodes in which each service has at least that
    mean level; with ``service_weight`` w on λ̄/circularity_scale + w·(mean level of the services). It holds for open and
    closed loops, whatever they know, and for the simulator as it is: exact zero-order hold, flows cut to what their
    donors hold (docs/bound.md). Of a service with a finite upper end of its band the lower end alone counts, so the
    bound holds but may be loose.

    Args:
        network: catalogue name, path of a definition file, or a network.
        initial: stocks at the start: node → stock, the rest in the middle of their ranges; or shape (stores,). None:
            all in the middle.
        service_weight: w ≥ 0; excludes ``min_service``.
        min_service: in [0, 1], for every service, or one for each, shape (services,).
        agents: who acts; None is the network's own choice.
        scenario: scenario of the definition; None is the default.
        horizon: decisions per episode; None takes the definition's.
        degree: degree of the test polynomials, 1 or more; higher is tighter and slower.
        near: a bound of a similar program, from whose solution this one is reached sooner: another start or level.

    Raises:
        NoCertificate: for a network whose flows are not linear laws: inner physics, batches, inexact solvers.
        CirlError: for input that cannot be used, a service that no plan reaches (or only just, by less than the
            solver's tolerance of 1e-7), or a solver that fails.
    """
    check_options(service_weight, min_service, degree)
    admissible = Admissible.of(_found(network, scenario, horizon), agents)
    start = starting_stocks(admissible.lifetimes.network, initial)
    levels = None if min_service is None else demanded_levels(admissible.network, min_service)
    basis = None if near is None else near.basis
    return _bounded(Programs(admissible, degree, service_weight), start, service_weight, levels, basis)


def envelope(
    network: str | Path | Network,
    initial: ArrayLike,
    *,
    solves: int = 3,
    service_weight: float | None = None,
    min_service: ArrayLike | None = None,
    agents: Sequence[str] | None = None,
    scenario: str | None = None,
    horizon: int | None = None,
    degree: int = DEGREE,
    near: Bound | None = None,
    progress: Callable[[int], None] = lambda solved: None,
) -> Envelope:
    """Bound the objective from many starts with a few solutions.

    The first is for the mean of the starts, each further one for the start where those before prove least: the best
    objective is a nearly concave function of the start, so what is proved from elsewhere is weakest where it is worst.

    Arguments and errors are those of ``bound``, but for ``initial``, stocks of shape (episodes, stores), mass;
    ``min_service``, of each service in each episode, shape (episodes, services), or what can be broadcast to it, such
    as (episodes, 1); ``solves``, how many programs to solve, at most 1 + episodes; and ``progress``, called with the
    number of those that are solved.
    """
    if not isinstance(solves, int | np.integer) or isinstance(solves, bool) or solves < 1:
        raise CirlError(f"solves must be a whole number of at least 1, got {solves!r}")
    admissible = Admissible.of(_found(network, scenario, horizon), agents)
    network_, nodes = admissible.lifetimes.network, len(admissible.lifetimes.network.stores)
    if np.ndim(initial) != 2 or not len(np.asarray(initial)):
        raise CirlError(f"initial has shape {np.shape(initial)}, expected (episodes, {nodes})")
    starts = by_stage(network_, initial)
    check_options(service_weight, min_service, degree)
    levels = None if min_service is None else demanded_levels(admissible.network, min_service, (len(starts),))
    programs = Programs(admissible, degree, service_weight)

    names = Rows(inside(network_)).start_names

    def solved(start: Floats, demanded: Floats | None, basis: Basis | None) -> Bound:
        check_stocks(names, start)
        return _bounded(programs, start, service_weight, demanded, basis)

    basis = None if near is None else near.basis
    first = solved(starts.mean(axis=0), None if levels is None else levels.mean(axis=0), basis)
    progress(1)
    found, open_ = Envelope((first,)), np.ones(len(starts), dtype=bool)
    for count in range(min(solves - 1, len(starts))):
        worst = int(np.where(open_, found.at(starts, levels), np.inf).argmin())
        open_[worst] = False
        demanded = None if levels is None else levels[worst]
        found = Envelope((*found.members, solved(starts[worst], demanded, first.basis)))
        progress(count + 2)
    return found


def starting_stocks(network: Network, initial: Mapping[str, float] | ArrayLike | None) -> Floats:
    """Return the stocks that ``initial`` describes (see ``bound``), as the simulator has them, mass.

    Those of nodes with a lifetime are spread over its stages by history or growth, unless they are given by stage.

    Raises:
        CirlError: for an unknown node, a wrong shape, or a stock that is negative or not finite.
    """
    start: Floats = network.initial.mean(axis=0)
    stores = {node.id: i for i, node in enumerate(network.stores)}
    if isinstance(initial, Mapping):
        for node, stock in initial.items():
            if node not in stores:
                raise CirlError(f"initial: {unknown('node', node, stores)}")
            start[stores[node]] = stock
    elif initial is not None:
        start = np.asarray(initial, dtype=float)
        if start.ndim != 1:
            raise CirlError(f"initial has shape {start.shape}, expected {(len(stores),)}")
    start = by_stage(network, start)
    check_stocks(Rows(inside(network)).start_names, start)
    return start


def highest_service(network: Network) -> float:
    """Return the highest mean level that all services can have in one episode, from the middle of the initial ranges.

    Raises:
        NoCertificate: for a network whose flows are not linear laws.
    """
    programs = Programs(Admissible.of(network, None), DEGREE, None)
    return 1.0 - _least_cut(programs.program(starting_stocks(network, None), 1.0), range(len(network.services)))


def check_options(service_weight: float | None, min_service: ArrayLike | None, degree: int) -> None:
    """Refuse options of ``bound`` that cannot be used.

    Raises:
        CirlError: naming the option and its value.
    """
    if service_weight is not None and min_service is not None:
        raise CirlError("service_weight and min_service are two ways to ask for service: give one of them")
    if service_weight is not None and not 0 <= service_weight < math.inf:
        raise CirlError(f"service_weight {service_weight!r} must be finite and not negative")
    if min_service is not None:
        check_service(min_service)
    if not isinstance(degree, int | np.integer) or isinstance(degree, bool) or degree < 1:
        raise CirlError(f"degree must be a whole number of at least 1, got {degree!r}")


def _found(network: str | Path | Network, scenario: str | None, horizon: int | None) -> Network:
    found = load_network(network) if isinstance(network, str | Path) else network
    found = found.scenario(scenario)
    return found if horizon is None else found.with_options(episode={"horizon": horizon})


def _bounded(
    programs: Programs,
    start: Floats,
    service_weight: float | None,
    min_service: Floats | None,
    basis: Basis | None = None,
) -> Bound:
    admissible, layout = programs.admissible, programs.layout
    problem = programs.program(start, min_service)
    what = "the program of the bound" + _asked(admissible.network, service_weight, min_service)
    try:
        solution = solve(problem, basis, what=what)
    except Infeasible:
        raise CirlError(_unreachable(problem, min_service)) from None
    proof = verified(problem, solution.certificate, solution.plan)
    planned = solution.plan.reshape(-1, layout.size)
    circularity = planned @ circularity_weights(layout)
    levels = planned[:, layout.level : layout.imbalance]
    lifetimes = admissible.lifetimes
    stocks = np.concatenate([(lifetimes.start_planned @ start)[None], planned[:, layout.last]])
    return Bound(
        network=lifetimes.network,
        agents=admissible.agents,
        initial=start,
        objective=proof.bound,
        value=proof.bound if service_weight is None else float(circularity.mean()),
        service=float(levels.mean()) if levels.size else 1.0,
        levels=levels.mean(axis=0),
        service_weight=service_weight,
        min_service=min_service,
        degree=layout.degree,
        circularity=circularity,
        stock=stocks @ lifetimes.totals.T,
        flow=layout.means(planned)[1][:, : len(lifetimes.network.arcs)],
        actions=normalised_actions(admissible, layout, planned),
        problem=problem,
        solution=solution.plan,
        certificate=solution.certificate,
        basis=solution.basis,
    )


def _asked(network: Network, service_weight: float | None, min_service: Floats | None) -> str:
    if min_service is not None and network.services:
        return f" with a mean service level of {said_levels(network, min_service)}"
    return "" if service_weight is None else f" with a service weight of {service_weight:.6g}"


def _unreachable(problem: Program, min_service: Floats | None) -> str:
    """Say what is wrong with a program without solution: the services out of reach, with the highest level of each."""
    network = problem.layout.network
    if min_service is None or not network.services:
        return f"network '{network.name}': HiGHS calls the program infeasible, though neutral control solves it"
    everyone, when = range(len(network.services)), ""
    cuts = {s: _least_cut(problem, [s]) for s in everyone}
    lacking = {s: cut for s, cut in cuts.items() if cut > FEASIBLE}
    if not lacking:
        lacking, when = dict.fromkeys(everyone, _least_cut(problem, everyone)), " at the same time"
    said = [
        f"{min_service[s]:g} of '{network.services[s].id}' (at most {min_service[s] - cut:.6g})"
        for s, cut in lacking.items()
    ]
    return f"network '{network.name}': no actions reach a mean service level of {', '.join(said)}{when}"


def _least_cut(problem: Program, services: Sequence[int]) -> float:
    """Return the least number by which the levels demanded of ``services``, of no others, are lowered within reach."""
    first = len(problem.under_to) - len(problem.layout.network.services)
    rows = [*range(first), *(first + s for s in services)]
    # minimise t, one more variable, with mean level + t ≥ demanded level
    lowered = sparse.csr_array((np.arange(len(rows)) >= first)[:, None] * -1.0)
    cut = replace(
        problem,
        cost=np.append(np.zeros_like(problem.cost), 1.0),
        constant=0.0,
        equal=sparse.hstack([problem.equal, sparse.csr_array((len(problem.equal_to), 1))], format="csr"),
        under=sparse.hstack([problem.under[rows], lowered], format="csr"),
        under_to=problem.under_to[rows],
        low=np.append(problem.low, 0.0),
        high=np.append(problem.high, 1.0),
    )
    return float(solve(cut, what="the program of the highest service level").plan[-1])
