"""What is proved about the best circularity, for one start or for many, and the plan that suggests itself."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.dynamics.rows import Rows
from cirl_marl.dynamics.stages import inside
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.ages import spread
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import Certificate, Verification, proved, verified
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.optimum.solver import Basis


def relative(difference: ArrayLike, reference: ArrayLike) -> Floats:
    """Return ``difference``/|``reference``| in the broadcast shape, NaN where the reference is 0."""
    top, bottom = np.broadcast_arrays(np.asarray(difference, dtype=float), np.asarray(reference, dtype=float))
    ratio: Floats = np.divide(top, np.abs(bottom), out=np.full(top.shape, np.nan), where=bottom != 0)
    return ratio


def gap(bound: ArrayLike, achieved: ArrayLike) -> Floats:
    """Return (bound − achieved)/|bound| in the broadcast shape, NaN where the bound is 0.

    >>> float(gap(-10.0, -12.0))
    0.2
    """
    return relative(np.subtract(bound, achieved), bound)


@dataclass(frozen=True, slots=True, kw_only=True)
class Bound:
    """An upper bound of an objective for one start, its certificate, and the plan that suggests itself.

    Attributes:
        network: the network, under the scenario and horizon that the bound is for.
        agents: who acts; the others are neutral.
        initial: stocks at the start as the simulator has them, by stage where there is a lifetime, mass.
        objective: the bound, proved by ``verify()``: of λ̄ (mass), or of λ̄/scale + w·service with a service weight.
        value: the bound on λ̄, or with a service weight λ̄ of the plan, mass.
        service: mean service level of the plan.
        levels: mean level of each service under the plan, shape (services,).
        service_weight: w; None if the objective is λ̄.
        min_service: mean level demanded of each service, shape (services,); None for none.
        degree: degree of the test polynomials.
        circularity: mean of λ over each interval under the plan, shape (steps,), mass.
        stock: planned stocks at the start and after each interval, shape (steps + 1, stores), mass.
        flow: planned mean flows, shape (steps, arcs), mass/time.
        actions: normalised actions that come closest to the plan, shape (steps, entries).
        problem: the linear program.
        solution: its variables under the plan.
        certificate: the multipliers.
        basis: from which the program of another start may be solved; None if it was solved without.
    """

    network: Network
    agents: tuple[str, ...]
    initial: Floats
    objective: float
    value: float
    service: float
    levels: Floats
    service_weight: float | None
    min_service: Floats | None
    degree: int
    circularity: Floats
    stock: Floats
    flow: Floats
    actions: Floats
    problem: Program
    solution: Floats
    certificate: Certificate
    basis: Basis | None

    def __str__(self) -> str:
        """Say what is proved, in one line."""
        mass, demand = self.network.mass_unit, ""
        if self.min_service is not None and self.network.services:
            demand = f", service level at least {said_levels(self.network, self.min_service)}"
        what = f"λ̄ ≤ {self.objective:.6g} {mass}{demand}"
        if self.service_weight is not None:
            what = f"λ̄/scale + {self.service_weight:g}·service ≤ {self.objective:.6g}"
        promised = f"λ̄ = {float(self.circularity.mean()):.6g} {mass} and serves {self.service:.4f}"
        where = f"bound of {self.network.name} over {self.network.episode.horizon} steps"
        return f"{where}: {what}; its plan promises {promised}{self._idle}"

    @property
    def _idle(self) -> str:
        """Say which supplies nobody acts on, of which the program knows the bounds alone."""
        acting = self.agents or self.network.agents
        idle = [arc.id for arc in self.network.arcs if arc.makes_up_for and arc.id not in acting]
        return f"; {', '.join(idle)} may supply any amount within bounds in it" if idle else ""

    def verify(self) -> Verification:
        """Compute the bound again from the program's matrices and the multipliers, without the solver."""
        return verified(self.problem, self.certificate, self.solution)

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
        achieved = np.asarray(circularity, dtype=float)
        if self.service_weight is not None:
            scale = self.network.objective.circularity_scale
            achieved = achieved / scale + self.service_weight * np.asarray(service, dtype=float)
        return gap(self.objective, achieved)


@dataclass(frozen=True, slots=True)
class Envelope:
    """Bounds of one objective, solved for different starts; at any start the least of what they prove holds.

    Attributes:
        members: the bounds, of the same network, agents, objective and degree.
    """

    members: tuple[Bound, ...]

    def at(self, initial: ArrayLike | None = None, min_service: ArrayLike | None = None) -> Floats:
        """Return the least of the bounds that the members prove; see ``Bound.at``, whose defaults are the first's."""
        first = self.members[0]
        starts = by_stage(first.network, first.initial if initial is None else initial)
        nodes = len(first.initial)
        demanded = _demanded(first, min_service)
        shape = np.broadcast_shapes(starts.shape[:-1], () if demanded is None else demanded.shape[:-1])
        names = Rows(inside(first.network)).start_names
        programs = Programs(Admissible.of(first.network, first.agents or None), first.degree, first.service_weight)
        starts = np.broadcast_to(starts, (*shape, nodes))
        levels = None if demanded is None else np.broadcast_to(demanded, (*shape, demanded.shape[-1]))
        found = np.empty(shape)
        for i in np.ndindex(shape):
            check_stocks(names, starts[i])
            problem = programs.program(starts[i], None if levels is None else levels[i])
            found[i] = min(proved(problem, each.certificate) for each in self.members)
        return found


def by_stage(network: Network, stocks: ArrayLike) -> Floats:
    """Return stocks of nodes, shape (..., stores), as the simulator has them, those with a lifetime by stage.

    What is given by stage already stays as it is; the others are spread by history or growth.

    Raises:
        CirlError: for another shape.
    """
    given, rows = np.asarray(stocks, dtype=float), Rows(inside(network))
    count = len(network.stores)
    if given.shape[-1:] == (rows.nodes.stop,):
        return given.copy()
    if given.shape[-1:] != (count,):
        raise CirlError(f"initial has shape {given.shape}, expected (..., {count})")
    whole = np.zeros((*given.shape[:-1], rows.nodes.stop))
    whole[..., :count] = given
    for i, stages in rows.stages.items():
        whole[..., stages] = given[..., i, None] * spread(network.stores[i], network.episode.control_interval)
    return whole


def check_stocks(names: Sequence[str], stocks: Floats) -> None:
    """Refuse stocks, as many as ``names`` begin with, that no episode can start from.

    Raises:
        CirlError: naming a stock that is negative or not finite.
    """
    for name, stock in zip(names, stocks.tolist(), strict=False):
        if not 0 <= stock < math.inf:
            raise CirlError(f"initial: the stock of '{name}' is {stock}; it must be finite and not negative")


def check_service(min_service: ArrayLike) -> None:
    """Refuse mean service levels outside [0, 1].

    Raises:
        CirlError: naming the first of them.
    """
    for level in np.ravel(min_service).tolist():
        if not 0 <= level <= 1:
            raise CirlError(f"min_service {level!r} must lie in [0, 1]")


def demanded_levels(network: Network, min_service: ArrayLike, episodes: tuple[int, ...] = ()) -> Floats:
    """Return the demanded mean level of each service, shape (*episodes, services); a number is for every service.

    Raises:
        CirlError: for a shape that cannot be broadcast to it.
    """
    shape = (*episodes, len(network.services))
    try:
        return np.broadcast_to(np.asarray(min_service, dtype=float), shape)
    except ValueError:
        ids = ", ".join(service.id for service in network.services) or "none"
        message = f"min_service has shape {np.shape(min_service)}, expected {shape}: a level for each service ({ids})"
        raise CirlError(message) from None


def said_levels(network: Network, levels: Floats) -> str:
    """Say levels of the services, shape (services,): a single number if they are all the same."""
    if len(set(levels.tolist())) == 1:
        return f"{levels[0]:g}"
    return ", ".join(f"{level:g} of '{service.id}'" for level, service in zip(levels, network.services, strict=True))


def _demanded(bound: Bound, min_service: ArrayLike | None) -> Floats | None:
    """Return the demanded levels, shape (..., services); None if there are none."""
    if min_service is None:
        return bound.min_service
    if bound.min_service is None:
        raise CirlError("min_service: this bound demands no service; solve it with min_service")
    check_service(min_service)
    return demanded_levels(bound.network, min_service, np.shape(min_service)[:-1])
