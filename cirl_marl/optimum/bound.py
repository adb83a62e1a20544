"""The best circularity that any admissible actions can reach over an episode, with its proof and a plan."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize

from cirl_marl.catalogue import load_network
from cirl_marl.errors import CirlError, unknown
from cirl_marl.network import Floats, Network
from cirl_marl.optimum.actions import normalised_actions
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import Certificate, Verification, verified
from cirl_marl.optimum.objective import circularity_weights
from cirl_marl.optimum.program import Program, program
from cirl_marl.optimum.reach import reach

DEGREE = 2
"""Degree of the test polynomials; docs/bound.md has the gap against it."""

INFEASIBLE = 2
"""Status that scipy's linprog returns for a program without solution."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Bound:
    """An upper bound of an objective for one start, its certificate, and the plan that suggests itself.

    Attributes:
        network: the network, under the scenario and horizon that the bound is for.
        agents: who acts; the others are neutral.
        initial: stocks at the start, shape (nodes,), mass.
        objective: the bound, proved by ``verify()``: of λ̄ (mass), or of λ̄/scale + w·service with a service weight.
        value: the bound on λ̄, or with a service weight λ̄ of the plan, mass.
        service: mean service level of the plan.
        service_weight: w; None if the objective is λ̄.
        min_service: mean service level demanded; None for none.
        degree: degree of the test polynomials.
        circularity: mean of λ over each interval under the plan, shape (steps,), mass.
        stock: planned stocks at the start and after each interval, shape (steps + 1, nodes), mass.
        flow: planned mean flows, shape (steps, arcs), mass/time.
        actions: normalised actions that come closest to the plan, shape (steps, entries).
        problem: the linear program.
        solution: its variables under the plan.
        certificate: the multipliers.
    """

    network: Network
    agents: tuple[str, ...]
    initial: Floats
    objective: float
    value: float
    service: float
    service_weight: float | None
    min_service: float | None
    degree: int
    circularity: Floats
    stock: Floats
    flow: Floats
    actions: Floats
    problem: Program
    solution: Floats
    certificate: Certificate

    def verify(self) -> Verification:
        """Compute the bound again from the program's matrices and the multipliers, without the solver."""
        return verified(self.problem, self.certificate, self.solution)

    def gap(self, circularity: ArrayLike, service: ArrayLike = 1.0) -> Floats:
        """Return (bound − achieved)/|bound| of episodes with λ̄ ``circularity`` and mean level ``service``.

        Service counts in a weighted objective only. NaN if the bound is 0.
        """
        achieved = np.asarray(circularity, dtype=float)
        if self.service_weight is not None:
            scale = self.network.objective.circularity_scale
            achieved = achieved / scale + self.service_weight * np.asarray(service, dtype=float)
        difference = np.asarray(self.objective - achieved)
        return difference / abs(self.objective) if self.objective else np.full_like(difference, np.nan)


def bound(
    network: str | Path | Network,
    initial: Mapping[str, float] | ArrayLike | None = None,
    *,
    service_weight: float | None = None,
    min_service: float | None = None,
    agents: Sequence[str] | None = None,
    scenario: str | None = None,
    horizon: int | None = None,
    degree: int = DEGREE,
) -> Bound:
    """Bound what any admissible actions can reach over one episode in the simulator.

    Without options the bound is on λ̄; with ``min_service`` on λ̄ of episodes with at least that mean service level; with
    ``service_weight`` w on λ̄/circularity_scale + w·(mean service level). It holds for open and closed loops, whatever
    they know, and for the simulator as it is: exact zero-order hold, flows cut to what their donors hold
    (docs/bound.md). Of a service with a finite upper end of its band the lower end alone counts, so the bound holds but
    may be loose.

    Args:
        network: catalogue name, path of a definition file, or a network.
        initial: stocks at the start: node → stock, the rest in the middle of their ranges; or shape (nodes,). None: all
            in the middle.
        service_weight: w ≥ 0; excludes ``min_service``.
        min_service: in [0, 1].
        agents: who acts; None is the network's own choice.
        scenario: scenario of the definition; None is the default.
        horizon: decisions per episode; None takes the definition's.
        degree: degree of the test polynomials, 1 or more; higher is tighter and slower.

    Raises:
        NoCertificate: for a network whose flows are not linear laws: inner physics, batches, inexact solvers.
        CirlError: for input that cannot be used, a service that no plan reaches, or a solver that fails.
    """
    found = load_network(network) if isinstance(network, str | Path) else network
    found = found.scenario(scenario)
    if horizon is not None:
        found = found.with_options(episode={"horizon": horizon})
    _check_options(service_weight, min_service, degree)
    admissible = Admissible.of(found, agents)
    start = starting_stocks(found, initial)
    problem = program(
        admissible,
        reach(admissible, start),
        start,
        degree,
        service_weight=service_weight,
        min_service=min_service,
    )
    try:
        solution, certificate = _solved(problem)
    except _Infeasible:
        raise CirlError(_unreachable(admissible, start, problem, min_service)) from None
    proof = verified(problem, certificate, solution)
    planned = solution.reshape(found.episode.horizon, problem.layout.size)
    layout = problem.layout
    weights = circularity_weights(layout)
    circularity = planned @ weights * len(planned)
    levels = planned[:, layout.level : layout.imbalance]
    return Bound(
        network=found,
        agents=admissible.agents,
        initial=start,
        objective=proof.bound,
        value=proof.bound if service_weight is None else float(circularity.mean()),
        service=float(levels.mean()) if levels.size else 1.0,
        service_weight=service_weight,
        min_service=min_service,
        degree=degree,
        circularity=circularity,
        stock=np.concatenate([start[None], planned[:, layout.end(-1) : layout.level]]),
        flow=layout.means(planned)[1],
        actions=normalised_actions(admissible, layout, planned),
        problem=problem,
        solution=solution,
        certificate=certificate,
    )


def starting_stocks(network: Network, initial: Mapping[str, float] | ArrayLike | None) -> Floats:
    """Return the stocks that ``initial`` describes (see ``bound``), shape (nodes,), mass.

    Raises:
        CirlError: for an unknown node, a wrong shape, or a stock that is negative or not finite.
    """
    start = np.array([sum(node.initial) / 2 for node in network.nodes])
    if isinstance(initial, Mapping):
        for node, stock in initial.items():
            if node not in network.node_index:
                raise CirlError(f"initial: {unknown('node', node, network.node_index)}")
            start[network.node_index[node]] = stock
    elif initial is not None:
        given = np.asarray(initial, dtype=float)
        if given.shape != start.shape:
            raise CirlError(f"initial has shape {given.shape}, expected {start.shape}")
        start = given.copy()
    for node, stock in zip(network.node_index, start, strict=True):
        if not 0 <= stock < math.inf:
            raise CirlError(f"initial: the stock of '{node}' is {stock}; it must be finite and not negative")
    return start


class _Infeasible(Exception):
    """The program has no solution."""


def _solved(problem: Program) -> tuple[Floats, Certificate]:
    """Return the solution and the multipliers that HiGHS finds.

    Raises:
        _Infeasible: if there is no solution.
        CirlError: if the solver fails for another reason.
    """
    scale = float(np.abs(problem.cost).max(initial=0.0)) or 1.0  # the solver's tolerances are absolute
    for method in ("highs-ipm", "highs-ds"):  # interior points are several times faster, simplex is the steadier
        found = optimize.linprog(
            problem.cost / scale,
            A_ub=problem.under,
            b_ub=problem.under_to,
            A_eq=problem.equal,
            b_eq=problem.equal_to,
            bounds=np.stack([problem.low, problem.high], axis=1),
            method=method,
        )
        if found.status == 0:
            multipliers = (found.eqlin.marginals * scale, found.ineqlin.marginals * scale)
            return found.x, Certificate(equal=multipliers[0], under=multipliers[1])
    if found.status == INFEASIBLE:
        raise _Infeasible
    raise CirlError(f"network '{problem.layout.network.name}': HiGHS found no optimum: {found.message}")


def _unreachable(admissible: Admissible, start: Floats, problem: Program, min_service: float | None) -> str:
    """Say what is wrong with a program without solution: the service demanded, with the highest that can be had."""
    network, layout = admissible.network, problem.layout
    if min_service is None:
        return f"network '{network.name}': HiGHS calls the program infeasible, though neutral control solves it"
    rows = len(problem.under_to) - 1
    cost = np.zeros((network.episode.horizon, layout.size))
    cost[:, layout.level : layout.imbalance] = -1.0 / cost[:, layout.level : layout.imbalance].size
    most = replace(
        problem, cost=cost.ravel(), constant=0.0, under=problem.under[:rows], under_to=problem.under_to[:rows]
    )
    solution, certificate = _solved(most)
    highest = verified(most, certificate, solution).bound
    return f"network '{network.name}': no actions reach a mean service level of {min_service}; at most {highest:.6g}"


def _check_options(service_weight: float | None, min_service: float | None, degree: int) -> None:
    if service_weight is not None and min_service is not None:
        raise CirlError("service_weight and min_service are two ways to ask for service: give one of them")
    if service_weight is not None and not 0 <= service_weight < math.inf:
        raise CirlError(f"service_weight {service_weight!r} must be finite and not negative")
    if min_service is not None and not 0 <= min_service <= 1:
        raise CirlError(f"min_service {min_service!r} must lie in [0, 1]")
    if not isinstance(degree, int | np.integer) or isinstance(degree, bool) or degree < 1:
        raise CirlError(f"degree must be a whole number of at least 1, got {degree!r}")
