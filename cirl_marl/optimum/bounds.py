"""Upper bounds of the circularity that any actions can reach in an episode, for one start or many, and their plans."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, overload

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.environments.actuators import planned_deviation
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import frozen_record, positional_record
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum.admissible import Admissible, normalised_actions
from cirl_marl.optimum.aims import NO_AIMS, Aim, Aims, account_rows, aims_of, budget_texts
from cirl_marl.optimum.certificate import Certificate, Verification, verify
from cirl_marl.optimum.draw_proofs import Sampling
from cirl_marl.optimum.options import (
    DEGREE,
    by_stage,
    check_options,
    check_service,
    demanded_levels,
    levels_text,
    starting_stocks,
)
from cirl_marl.optimum.program import Program, Programs, circularity_weights
from cirl_marl.optimum.solver import FEASIBLE, Basis, Infeasible, solve
from cirl_marl.optimum.uncertain_bound import UncertainBound, uncertain_bound

SAME = 1e-12
"""Relative difference of starts, and of levels, that are the same but for rounding."""


def relative(difference: ArrayLike, reference: ArrayLike) -> Floats:
    """Return ``difference``/|``reference``| in the broadcast shape, NaN where the reference is 0."""
    top, bottom = np.broadcast_arrays(np.asarray(difference, dtype=float), np.asarray(reference, dtype=float))
    ratio: Floats = np.divide(top, np.abs(bottom), out=np.full(top.shape, np.nan), where=bottom != 0)
    return ratio


def gap(bound: ArrayLike, value: ArrayLike) -> Floats:
    """Return (bound − achieved)/|bound| in the broadcast shape, NaN where the bound is 0.

    >>> float(gap(-10.0, -12.0))
    0.2
    """
    return relative(np.subtract(bound, value), bound)


@frozen_record
class Bound:
    """An upper bound of an objective for one start, its certificate, and the plan that suggests itself."""

    network: Annotated[Network, "the network, under the scenario and horizon that the bound is for"]
    agents: Annotated[tuple[str, ...], "who acts; the others are neutral"]
    initial: Annotated[Floats, "stocks at the start as the simulator has them, with a lifetime by stage, mass"]
    objective: Annotated[
        float,
        "the bound, proved by ``verify()``: of λ̄, mass, with a service weight of λ̄/scale + w·service, or of what else "
        "is aimed at, such as minus the total of an account, or the level of a service",
    ]
    value: Annotated[float, "the bound on λ̄, or with another objective λ̄ of the plan, mass"]
    service: Annotated[float, "mean service level of the plan"]
    levels: Annotated[Floats, "mean level of each service under the plan, shape (services,)"]
    service_weight: Annotated[float | None, "w; None if the objective is λ̄"]
    min_service: Annotated[Floats | None, "mean level demanded of each service, shape (services,); None for none"]
    aims: Annotated[Aims, "what is weighed in place of λ̄, and budgets of accounts"]
    accounts: Annotated[Floats, "totals of the accounts under the plan, shape (accounts,)"]
    degree: Annotated[int, "degree of the test polynomials"]
    tight: Annotated[bool, "whether flows that may vary have constant parts"]
    circularity: Annotated[Floats, "mean of λ over each interval under the plan, shape (steps,), mass"]
    stock: Annotated[Floats, "planned stocks at the start and after each interval, shape (steps + 1, stores), mass"]
    flow: Annotated[Floats, "planned mean flows, shape (steps, arcs), mass/time"]
    actions: Annotated[Floats, "normalised actions that come closest to the plan, shape (steps, entries)"]
    problem: Annotated[Program, "the linear program"]
    solution: Annotated[Floats, "its variables under the plan"]
    certificate: Annotated[Certificate, "the multipliers"]
    basis: Annotated[Basis | None, "from which the program of another start may be solved; None if solved without"]

    def __str__(self) -> str:
        """Say what is proved, in one line."""
        mass, demand = self.network.mass_unit, ""
        if self.min_service is not None and self.network.services:
            demand = f", service level at least {levels_text(self.network, self.min_service)}"
        demand += "".join(f", {text}" for text, _ in budget_texts(self.network, self.aims))
        statement = self.aims.statement(self.network, self.objective, 6) + demand
        if self.service_weight is not None:
            statement = f"λ̄/scale + {self.service_weight:g}·service ≤ {self.objective:.6g}"
        plan = f"λ̄ = {float(self.circularity.mean()):.6g} {mass} and serves {self.service:.4f}"
        subject = f"bound of {self.network.name} over {self.network.episode.horizon} steps"
        # of supplies that nobody acts on the program knows bounds, and when stocks may fall short
        agents = self.agents or self.network.agents
        idle = [arc.id for arc in self.network.arcs if arc.makes_up_for and arc.id not in agents]
        caveat = f"; {', '.join(idle)} may supply more or less in it than in the simulator" if idle else ""
        return f"{subject}: {statement}; its plan promises {plan}{caveat}"

    @property
    def budget_prices(self) -> dict[str, float]:
        """What the objective gains, to first order, from one unit more of each budget, by account, or account and year.

        With a budget of emissions it is the price of carbon: in money where an account of money is kept low, in mass of
        λ̄ where that is the objective. At a kink it is one of the slopes in between.
        """
        last = len(self.certificate.under) - (0 if self.min_service is None else len(self.network.services))
        multipliers = self.certificate.under[last - len(self.aims.budgets) : last]
        names = [budget.name for budget in self.aims.budgets]
        return dict(zip(names, np.maximum(-multipliers, 0.0).tolist(), strict=True))

    def verify(self) -> Verification:
        """Compute the bound again from the program's matrices and the multipliers, without the solver."""
        return verify(self.problem, self.certificate, self.solution)

    def at(self, initial: ArrayLike | None = None, min_service: ArrayLike | None = None) -> Floats:
        """Return what the same multipliers prove for other starts and other demanded service levels.

        The program of another start has the same rows and variables, and any multipliers prove a bound, so none of them
        has to be solved. The further from the start solved for, the weaker the bound may be.

        Args:
            initial: stocks at the start, shape (..., stores), or by stage, mass; None is the bound's own.
            min_service: demanded mean levels in [0, 1], of each service, shape (..., services), or one for all of them,
                a number or shape (..., 1); None is the bound's own.

        Returns:
            Bounds of the objective, in the broadcast shape (...).

        Raises:
            NoCertificate: if recipients may empty their donors from one of the starts.
            CirlError: for a shape, stock or level that cannot be used, or a level if the bound demands none.
        """
        return Envelope((self,)).at(initial, min_service)

    def gap(self, circularity: ArrayLike, service: ArrayLike = 1.0) -> Floats:
        """Return (bound − achieved)/|bound| of episodes with λ̄ ``circularity`` and mean level ``service``.

        Service counts in a weighted objective only. NaN if the bound is 0.
        """
        value = np.asarray(circularity, dtype=float)
        if self.service_weight is not None:
            scale = self.network.objective.circularity_scale
            value = value / scale + self.service_weight * np.asarray(service, dtype=float)
        return gap(self.objective, value)


@positional_record
class Envelope:
    """Bounds of one objective, solved for different starts; at any start the least of what they prove holds."""

    members: Annotated[tuple[Bound, ...], "the bounds, of the same network, agents, objective and degree"]

    def at(self, initial: ArrayLike | None = None, min_service: ArrayLike | None = None) -> Floats:
        """Return the least of the bounds that the members prove; see ``Bound.at``, whose defaults are the first's."""
        first = self.members[0]
        admissible = Admissible.of(first.network, first.agents or None)
        layout = admissible.lifetimes.state_layout
        starts = by_stage(first.network, layout, first.initial if initial is None else initial)
        demand = first.min_service
        if min_service is not None:
            if demand is None:
                raise CirlError("min_service: this bound demands no service; solve it with min_service")
            check_service(min_service)
            demand = demanded_levels(first.network, min_service, np.shape(min_service)[:-1])
        shape = np.broadcast_shapes(starts.shape[:-1], () if demand is None else demand.shape[:-1])
        weight, system = first.service_weight, first.problem.system
        programs = Programs(admissible, first.degree, weight, steady_parts=first.tight, system=system)
        starts = np.broadcast_to(starts, (*shape, len(first.initial)))
        levels = None if demand is None else np.broadcast_to(demand, (*shape, demand.shape[-1]))
        bounds = np.empty(shape)
        for i in np.ndindex(shape):
            problem = programs.program(starts[i], None if levels is None else levels[i], aims=first.aims)
            bounds[i] = min(verify(problem, member.certificate, member.solution).bound for member in self.members)
        return bounds


@overload
def bound(
    network: str | Path | Network,
    initial: Mapping[str, float] | ArrayLike | None = None,
    *,
    service_weight: float | None = None,
    min_service: ArrayLike | None = None,
    aim: Aim = CIRCULARITY,
    at_most: Mapping[str, float] | None = None,
    agents: Sequence[str] | None = None,
    scenario: str | None = None,
    horizon: int | None = None,
    degree: int = DEGREE,
    tight: bool = False,
    near: Bound | None = None,
    uncertain: Literal[False] = False,
) -> Bound: ...


@overload
def bound(
    network: str | Path | Network,
    initial: Mapping[str, float] | ArrayLike | None = None,
    *,
    min_service: ArrayLike | None = None,
    at_most: Mapping[str, float] | None = None,
    agents: Sequence[str] | None = None,
    scenario: str | None = None,
    horizon: int | None = None,
    degree: int = DEGREE,
    uncertain: Literal[True] | Sampling,
    progress: Callable[[float], None] = lambda share: None,
) -> UncertainBound: ...


def bound(
    network: str | Path | Network,
    initial: Mapping[str, float] | ArrayLike | None = None,
    *,
    service_weight: float | None = None,
    min_service: ArrayLike | None = None,
    aim: Aim = CIRCULARITY,
    at_most: Mapping[str, float] | None = None,
    agents: Sequence[str] | None = None,
    scenario: str | None = None,
    horizon: int | None = None,
    degree: int = DEGREE,
    tight: bool = False,
    near: Bound | None = None,
    uncertain: bool | Sampling = False,
    progress: Callable[[float], None] = lambda share: None,
) -> Bound | UncertainBound:
    """Bound what any admissible actions can reach over one episode in the simulator.

    Without options the bound is on λ̄; with ``min_service`` on λ̄ of episodes in which each service has at least that
    mean level; with ``service_weight`` w on λ̄/circularity_scale + w·(mean level of the services). It holds for open and
    closed loops, whatever they know, and for the simulator as it is: exact zero-order hold, flows cut to what their
    donors hold (docs/bound.md). Of a service with a finite upper end of its band the lower end alone counts, so the
    bound holds but may be loose.

    With ``uncertain`` it is on the mean of λ̄ over all that may happen, of policies that do not know the future, and
    ``min_service`` and ``at_most`` on the expected levels and amounts.

    Args:
        network: catalogue name, path of a definition file, or a network.
        initial: stocks at the start: node → stock, the rest in the middle of their ranges; or shape (stores,). None:
            all in the middle, or with ``uncertain`` drawn as episodes draw them.
        service_weight: w ≥ 0; excludes ``min_service``.
        min_service: in [0, 1], for every service, or one for each, shape (services,).
        aim: ``circularity``; the account whose total is kept as low as can be, the bound being on minus that; the
            service whose mean level is kept as high; or the weights of λ̄, of minus the totals of accounts and of the
            levels of services, by name.
        at_most: budgets: the highest total of accounts, by id, in their units; with ``/year`` after the id the highest
            amount of each year, not discounted.
        agents: who acts; None is the network's own choice.
        scenario: scenario of the definition; None is the default.
        horizon: decisions per episode; None takes the definition's.
        degree: degree of the test polynomials, 1 or more; higher is tighter and slower.
        tight: whether flows that may vary within an interval, such as what leaves lifetimes, have constant parts, so
            that shares of them cannot change, and stocks hold of what enters them what they must: tighter, mostly where
            there are lifetimes or fast stocks, and somewhat slower.
        near: a bound of a similar program, from whose solution this one is reached sooner: another start or level. Of
            the same network with another degree what it can reach is taken over.
        uncertain: whether disturbances and uncertain numbers are drawn, and how if not by default; excludes
            ``service_weight``, ``near``, ``tight`` and ``aim``.
        progress: with ``uncertain``, which takes minutes, called with the share that is done.

    Raises:
        NoCertificate: for a network whose flows are not linear laws: inner physics, batches, inexact solvers.
        CirlError: for input that cannot be used, a service that no plan reaches (or only just, by less than the
            solver's tolerance of 1e-7), a solver that fails, or with ``uncertain`` too few draws, a program of a draw
            that is too large, or a network without anything to draw.
    """
    check_options(service_weight, min_service, degree)
    definition = _episode_network(network, scenario, horizon)
    if not isinstance(uncertain, bool | np.bool_ | Sampling):
        raise CirlError(f"uncertain must be True, False or a Sampling, got {uncertain!r}")
    if isinstance(uncertain, Sampling) or uncertain:
        if service_weight is not None or near is not None or tight or aim != CIRCULARITY:
            options = "service_weight, near, tight and aim"
            raise CirlError(f"uncertain: {options} go with a certain future; demand min_service")
        levels = None if min_service is None else demanded_levels(definition, min_service)
        sampling, aims = uncertain if isinstance(uncertain, Sampling) else Sampling(), aims_of(definition, aim, at_most)
        return uncertain_bound(definition, agents, initial, levels, degree, sampling, aims, progress)
    aims = aims_of(definition, aim, at_most, with_services=True)
    if service_weight is not None and not aims.is_circular:
        raise CirlError(f"service_weight goes with the aim '{CIRCULARITY}', not with {aim!r}; demand min_service")
    admissible = Admissible.of(definition, agents)
    start = starting_stocks(admissible.lifetimes, initial)
    levels = None if min_service is None else demanded_levels(admissible.network, min_service)
    basis = system = None
    if near is not None and (near.degree, near.tight) == (degree, tight):
        basis = near.basis
    if near is not None and (near.network, near.agents) == (admissible.lifetimes.network, admissible.agents):
        system = near.problem.system
    programs = Programs(admissible, degree, service_weight, steady_parts=tight, system=system)
    return _solve_bound(programs, start, service_weight, levels, basis, aims)


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
    progress: Callable[[int], None] = lambda solves: None,
) -> Envelope:
    """Bound the objective from many starts with a few solutions.

    The first is for the mean of the starts, each further one for the start where those before prove least: the best
    objective is a nearly concave function of the start, so what is proved from elsewhere is weakest where it is worst.
    Episodes that are all alike need the first alone.

    Arguments and errors are those of ``bound``, but for ``initial``, stocks of shape (episodes, stores), mass;
    ``min_service``, of each service in each episode, shape (episodes, services), or what can be broadcast to it, such
    as (episodes, 1); ``solves``, how many programs to solve, at most 1 + episodes; and ``progress``, called with the
    number of those that are solved.
    """
    whole_number("solves", solves, 1)
    admissible = Admissible.of(_episode_network(network, scenario, horizon), agents)
    lifetimes = admissible.lifetimes
    if np.ndim(initial) != 2 or not len(np.asarray(initial)):
        raise CirlError(f"initial has shape {np.shape(initial)}, expected (episodes, {len(lifetimes.network.stores)})")
    starts = by_stage(lifetimes.network, lifetimes.state_layout, initial)
    check_options(service_weight, min_service, degree)
    levels = None if min_service is None else demanded_levels(admissible.network, min_service, (len(starts),))
    programs = Programs(admissible, degree, service_weight)

    demand, basis = None if levels is None else levels.mean(axis=0), None if near is None else near.basis
    first = _solve_bound(programs, starts.mean(axis=0), service_weight, demand, basis)
    progress(1)
    bounds, candidates = Envelope((first,)), np.ones(len(starts), dtype=bool)
    if _are_alike(starts) and (levels is None or _are_alike(levels)):
        return bounds
    for count in range(min(solves - 1, len(starts))):
        worst = int(np.where(candidates, bounds.at(starts, levels), np.inf).argmin())
        candidates[worst] = False
        demand = None if levels is None else levels[worst]
        member = _solve_bound(programs, starts[worst], service_weight, demand, first.basis)
        bounds = Envelope((*bounds.members, member))
        progress(count + 2)
    return bounds


def _are_alike(rows: Floats) -> bool:
    return np.allclose(rows, rows[:1], rtol=SAME, atol=0.0)


def highest_service(network: Network) -> float:
    """Return the highest mean level that all services can have in one episode, from the middle of the initial ranges.

    Raises:
        NoCertificate: for a network whose flows are not linear laws.
    """
    admissible = Admissible.of(network)
    problem = Programs(admissible, DEGREE, None).program(starting_stocks(admissible.lifetimes, None), 1.0)
    return 1.0 - _least_cut(problem, range(len(network.services)))


def _episode_network(network: str | Path | Network, scenario: str | None, horizon: int | None) -> Network:
    definition = load_network(network, scenario=scenario)
    return definition if horizon is None else definition.with_options(episode={"horizon": horizon})


def _solve_bound(
    programs: Programs,
    start: Floats,
    service_weight: float | None,
    min_service: Floats | None,
    basis: Basis | None,
    aims: Aims = NO_AIMS,
) -> Bound:
    admissible, layout = programs.admissible, programs.layout
    problem = programs.program(start, min_service, aims=aims)
    request = "" if service_weight is None else f" with a service weight of {service_weight:.6g}"
    if min_service is not None and admissible.network.services:
        request = f" with a mean service level of {levels_text(admissible.network, min_service)}"
    try:
        solution = solve(problem, basis, label=f"the program of the bound{request}")
    except Infeasible:
        raise CirlError(_unreachable(problem, min_service, aims)) from None
    proof = verify(problem, solution.certificate, solution.plan)
    plan = solution.plan.reshape(-1, layout.size)
    circularity = plan @ circularity_weights(layout)
    levels = plan[:, layout.level : layout.imbalance]
    lifetimes = admissible.lifetimes
    ledger = Ledger(lifetimes.network)
    by_flow, by_stock, by_part = ledger.rates()
    totals, beside = account_rows(lifetimes, layout, start, (by_flow, by_stock, 0.0 * by_part))
    actions = normalised_actions(admissible, layout, plan, start)
    accounts = totals @ solution.plan + beside
    stock = np.concatenate([(lifetimes.start_planned @ start)[None], plan[:, layout.last]]) @ lifetimes.totals.T
    flow = layout.means(plan)[1] @ lifetimes.arc_sums.T
    if by_part.size:  # variables of convex parts are only at least as large as the program asks for
        deviation = planned_deviation(lifetimes.network, admissible.agents, actions) if ledger.has_efforts else None
        parts = ledger.convex_parts(flow.T, (stock[:-1] + stock[1:]).T / 2, deviation)
        accounts = accounts + (by_part * parts.T).sum(axis=(1, 2))
    return Bound(
        network=lifetimes.network,
        agents=admissible.agents,
        initial=start,
        objective=proof.bound,
        value=proof.bound if service_weight is None and aims.is_circular else float(circularity.mean()),
        service=float(levels.mean()) if levels.size else 1.0,
        levels=levels.mean(axis=0),
        service_weight=service_weight,
        min_service=min_service,
        aims=aims,
        accounts=accounts,
        degree=layout.degree,
        tight=programs.steady_parts,
        circularity=circularity,
        stock=stock,
        flow=flow,
        actions=actions,
        problem=problem,
        solution=solution.plan,
        certificate=solution.certificate,
        basis=solution.basis,
    )


def out_of_reach(programs: Programs, start: Floats, min_service: Floats | None, aims: Aims) -> str:
    """Return which budgets or services no actions keep, with the best there is of each; nothing if some may."""
    problem = programs.program(start, min_service, aims=aims)
    try:
        solve(problem, label="the program of what is demanded")
    except Infeasible:
        return _unreachable(problem, min_service, aims)
    return ""


def _unreachable(problem: Program, min_service: Floats | None, aims: Aims) -> str:
    """Say what is wrong with a program without solution: budgets or services out of reach, with the best of each."""
    network, last = problem.layout.network, len(problem.under_to)
    last -= 0 if min_service is None else len(network.services)
    budgets = range(last - len(aims.budgets), last)
    try:
        excesses = [_least_excess(problem, row, budgets) for row in budgets]
    except Infeasible:  # services are out of reach whatever the budgets
        problem = _without_rows(problem, budgets)
        excesses = []
    if excesses:
        suffix = ""
        if max(excesses) <= 0:
            excesses, suffix = (
                [*excesses[:-1], _least_excess(problem, last - 1, [last - 1])],
                " beside the other budgets",
            )
        least = [
            f"{budget.text(network)} (at least {budget.most + excess:.6g}{suffix})"
            for budget, excess in zip(aims.budgets, excesses, strict=True)
            if excess > 0
        ]
        price = "its price would be infinite" if len(least) == 1 else "their prices would be infinite"
        return f"network '{network.name}': no actions keep the budget of {', '.join(least)}: {price}"
    return _unreached_services(problem, min_service)


def _without_rows(problem: Program, rows: Sequence[int]) -> Program:
    kept = np.delete(np.arange(len(problem.under_to)), np.array(rows, dtype=np.intp))
    return replace(problem, under=problem.under[kept], under_to=problem.under_to[kept])


def _least_excess(problem: Program, row: int, without: Sequence[int]) -> float:
    """Return by how much the total of a budget's row exceeds it at least, ``without`` some rows."""
    cost, label = problem.under[[row]].toarray()[0], "the program of the least total"
    least = solve(replace(_without_rows(problem, without), cost=cost, constant=0.0), label=label)
    excess = float(cost @ least.plan - problem.under_to[row])
    size = float(np.abs(cost) @ np.maximum(np.abs(problem.low), np.abs(problem.high)))
    return excess if excess > FEASIBLE * size else 0.0


def _unreached_services(problem: Program, min_service: Floats | None) -> str:
    """Say what is wrong with a program without solution: the services out of reach, with the highest level of each."""
    network = problem.layout.network
    if min_service is None or not network.services:
        return f"network '{network.name}': HiGHS calls the program infeasible, though neutral control solves it"
    services, suffix = range(len(network.services)), ""
    cuts = {s: _least_cut(problem, [s]) for s in services}
    shortfalls = {s: cut for s, cut in cuts.items() if cut > FEASIBLE}
    if not shortfalls:
        shortfalls, suffix = dict.fromkeys(services, _least_cut(problem, services)), " at the same time"
    levels = [
        f"{min_service[s]:g} of '{network.services[s].id}' (at most {min_service[s] - cut:.6g})"
        for s, cut in shortfalls.items()
    ]
    return f"network '{network.name}': no actions reach a mean service level of {', '.join(levels)}{suffix}"


def _least_cut(problem: Program, services: Sequence[int]) -> float:
    """Return the least number by which the levels demanded of ``services`` alone are lowered within reach."""
    first = len(problem.under_to) - len(problem.layout.network.services)
    rows = [*range(first), *(first + s for s in services)]
    # minimise t, one more variable, with mean level + t ≥ demanded level
    allowance = sparse.csr_array((np.arange(len(rows)) >= first)[:, None] * -1.0)
    cut = replace(
        problem,
        cost=np.append(np.zeros_like(problem.cost), 1.0),
        constant=0.0,
        equal=sparse.hstack([problem.equal, sparse.csr_array((len(problem.equal_to), 1))], format="csr"),
        under=sparse.hstack([problem.under[rows], allowance], format="csr"),
        under_to=problem.under_to[rows],
        low=np.append(problem.low, 0.0),
        high=np.append(problem.high, 1.0),
    )
    return float(solve(cut, label="the program of the highest service level").plan[-1])
