"""What a plan may be meant to do: the parts of λ, services and set-points, as linear functions of an episode.

All are higher the better, and means over the intervals of an episode. Where a term bends, as a squared distance to a
set-point does, its tangent at a plan stands for it. The terms are concave, so that a plan which is best for weighted
terms is best for their tangents too, and no plan gains more than the tangents say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from cirl_marl.drawing.style import readable
from cirl_marl.errors import CirlError, unknown
from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Arc, Node, Role
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.vintages import Lifetimes

KINDS = ("circularity", "services", "set-points")
CIRCULARITY_PARTS = {
    Role.NONRENEWABLE_RESERVOIR: "taken from reservoirs",
    Role.LANDFILL: "put into landfills",
    Role.INCINERATOR: "burnt",
    Role.ENVIRONMENT: "released to the environment",
}
"""Parts of λ, by the role of a node at one end of an arc that counts."""


@dataclass(frozen=True, slots=True)
class PlannedEpisode:
    """What became of a network in one episode.

    Attributes:
        name: of the file or run that it is from.
        initial: stocks at the start as the simulator has them, mass.
        stock: at the end of each interval, shape (steps, stores), mass.
        flow: means over the intervals, shape (steps, arcs), mass/time.
    """

    name: str
    initial: Floats
    stock: Floats
    flow: Floats


@dataclass(frozen=True, slots=True)
class LinearFunctional:
    """Weights of what is measured in an episode; None where nothing of a kind counts.

    Attributes:
        flow: of mean flows, shape (steps, arcs).
        stock: of stocks at the ends, shape (steps, stores).
        through: of what passes through nodes that store nothing, shape (steps, nodes − stores).
        level: of the levels of services, shape (steps, services).
        imbalance: of |net flow through the environment|·Δ, shape (steps,).
    """

    flow: Floats | None = None
    stock: Floats | None = None
    through: Floats | None = None
    level: Floats | None = None
    imbalance: Floats | None = None

    def of(self, network: Network, course: PlannedEpisode) -> float:
        """Return what it is in an episode."""
        net = np.abs(course.flow @ network.circularity_weights[1])
        measured = (
            course.flow,
            course.stock,
            network.throughput(course.flow.T).T,
            service_levels(network, course),
            net,
        )
        weights = (self.flow, self.stock, self.through, self.level, self.imbalance)
        return float(sum((w * m).sum() for w, m in zip(weights, measured, strict=True) if w is not None))

    def columns(self, layout: Layout, lifetimes: Lifetimes, steps: int) -> Floats:
        """Return its weights on the variables of a program, shape (steps · size,)."""
        found = np.zeros((steps, layout.size))
        count, stores = len(layout.moments), len(layout.network.stores)
        for moment in layout.moments:
            if self.flow is not None:
                found[:, layout.flow(moment) :][:, : self.flow.shape[1]] += self.flow / count
            if self.through is not None:
                found[:, layout.stock(moment) + stores :][:, : self.through.shape[1]] += self.through / count
        if self.stock is not None:
            found[:, layout.last] += self.stock @ lifetimes.totals
        if self.level is not None:
            found[:, layout.level : layout.imbalance] += self.level
        if self.imbalance is not None:
            found[:, layout.imbalance] += self.imbalance
        return found.ravel()


@dataclass(frozen=True, slots=True)
class ObjectiveTerm:
    """One thing that a plan may be meant to do.

    Attributes:
        name: what it is called.
        kind: one of KINDS.
        unit: of the term itself.
        about: of a service or set-point, whose.
        roles: of a part of λ, the arcs that count in it, shape (arcs,).
    """

    name: str
    kind: str
    unit: str
    about: str = ""
    roles: Floats = field(default_factory=lambda: np.zeros(0))

    def tangent(self, network: Network, course: PlannedEpisode) -> LinearFunctional:
        """Return the term, or its tangent at an episode."""
        steps = network.episode.horizon
        if self.kind == "services":
            level = np.zeros((steps, len(network.services)))
            level[:, [each.id for each in network.services].index(self.about)] = 1.0 / steps
            return LinearFunctional(level=level)
        if self.kind == "circularity":
            if not self.roles.any():
                return LinearFunctional(imbalance=np.full(steps, -1.0 / steps))
            return LinearFunctional(flow=np.tile(self.roles / steps, (steps, 1)))
        compartment = network.compartments[self.about]
        assert compartment.set_point is not None
        slope = -2.0 / (compartment.scale**2 * steps)
        if isinstance(compartment, Arc):
            place, values = network.arc_index[self.about], course.flow
            weights = np.zeros_like(course.flow)
            weights[:, place] = slope * (values[:, place] - compartment.set_point)
            return LinearFunctional(flow=weights)
        place, stores = network.node_index[self.about], len(network.stores)
        if isinstance(compartment, Node) and compartment.stores:
            weights = np.zeros_like(course.stock)
            weights[:, place] = slope * (course.stock[:, place] - compartment.set_point)
            return LinearFunctional(stock=weights)
        through = network.throughput(course.flow.T).T
        weights = np.zeros_like(through)
        weights[:, place - stores] = slope * (through[:, place - stores] - compartment.set_point)
        return LinearFunctional(through=weights)


def objective_terms(network: Network, kinds: Sequence[str] = KINDS) -> list[ObjectiveTerm]:
    """Return what a plan of a network may be meant to do.

    - *circularity*: each part of λ, −Δ times what it counts, mass: taken from reservoirs, put into landfills, …
    - *services*: the mean level of each service; of its band the lower end.
    - *set-points*: −((q − set-point)/scale)² of each compartment that has one, as in its local reward.

    Raises:
        CirlError: for an unknown kind, or if there are not two terms to weigh.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise CirlError(f"terms: {unknown('kind', kind, KINDS)}")
    found: list[ObjectiveTerm] = []
    if "circularity" in kinds:
        parts: dict[str, Floats] = {}
        signed = network.circularity_weights.sum(axis=0)
        if network.objective.net_zero == "abs":
            signed = network.circularity_weights[0]
        for k in np.flatnonzero(signed):
            parts.setdefault(_part(network, int(k)), np.zeros(len(network.arcs)))[k] = signed[k]
        found += [ObjectiveTerm(name, "circularity", network.mass_unit, roles=roles) for name, roles in parts.items()]
        if network.objective.net_zero == "abs" and network.circularity_weights[1].any():
            found.append(ObjectiveTerm("net flow through the environment", "circularity", network.mass_unit))
    if "services" in kinds:
        found += [ObjectiveTerm(s.title or readable(s.id), "services", "1", about=s.id) for s in network.services]
    if "set-points" in kinds:
        tracked = network.objective.tracked or tuple(
            each.id for each in network.compartments.values() if each.set_point is not None
        )
        found += [
            ObjectiveTerm(f"set-point of {network.compartments[each].label}", "set-points", "1", about=each)
            for each in tracked
        ]
    if len(found) < 2:
        raise CirlError(
            f"network '{network.name}': there is nothing to weigh: of {', '.join(kinds)} it has {len(found)} term"
        )
    return found


def _part(network: Network, arc: int) -> str:
    ends = (network.arcs[arc].donor, network.arcs[arc].recipient)
    roles = [network.nodes[network.node_index[end]].role for end in ends]
    return CIRCULARITY_PARTS[
        next(role for role in CIRCULARITY_PARTS if role in (roles if network.sustainability[arc] > 0 else roles[::-1]))
    ]


def service_levels(network: Network, course: PlannedEpisode) -> Floats:
    """Return the level min(1, q/low) of each service in each interval, shape (steps, services)."""
    found = np.ones((len(course.flow), len(network.services)))
    for s, service in enumerate(network.services):
        low = network.interval_means(service.low)
        if service.quantity == "stock":
            measured = course.stock[:, [network.node_index[each] for each in service.providers]].sum(axis=1)
        else:
            measured = course.flow[:, network.service_arcs(service)].sum(axis=1)
        found[:, s] = np.minimum(1.0, np.divide(measured, low, out=np.ones_like(measured), where=low > 0))
    return found
