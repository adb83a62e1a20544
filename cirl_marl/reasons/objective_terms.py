"""What a plan may be meant to do: the parts of λ, services and set-points, as linear functions of an episode.

All are higher the better, and means over the intervals of an episode. Where a term bends, as a squared distance to a
set-point does, its tangent at a plan stands for it. The terms are concave, so that a plan which is best for weighted
terms is best for their tangents too, and no plan gains more than the tangents say.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field
from typing import Annotated

import numpy as np

from cirl_marl.drawing.style import readable
from cirl_marl.errors import CirlError, check_names
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Arc, Node, Role
from cirl_marl.network.rowsum import NEGLIGIBLE
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


@positional_record
class PlannedEpisode:
    """What became of a network in one episode."""

    name: Annotated[str, "of the file or run that it is from"]
    initial: Annotated[Floats, "stocks at the start as the simulator has them, mass"]
    stock: Annotated[Floats, "at the end of each interval, shape (steps, stores), mass"]
    flow: Annotated[Floats, "means over the intervals, shape (steps, arcs), mass/time"]
    contents: Annotated[
        Floats, "of each substance in nodes at those ends, then in flows, shape (steps, substances, compartments)"
    ] = field(default_factory=lambda: np.zeros((0, 0, 0)))


@positional_record
class LinearFunctional:
    """Weights of what is measured in an episode; None where nothing of a kind counts."""

    flow: Annotated[Floats | None, "of mean flows, shape (steps, arcs)"] = None
    stock: Annotated[Floats | None, "of stocks at the ends, shape (steps, stores)"] = None
    through: Annotated[
        Floats | None,
        "of what passes through nodes that store nothing, shape (steps, nodes − stores)",
    ] = None
    level: Annotated[Floats | None, "of the levels of services, shape (steps, services)"] = None
    imbalance: Annotated[Floats | None, "of |net flow through the environment|·Δ, shape (steps,)"] = None

    def of(self, network: Network, episode: PlannedEpisode) -> float:
        """Return what it is in an episode."""
        net = np.abs(episode.flow @ network.circularity_weights[1])
        through, level = network.throughput(episode.flow.T).T, service_levels(network, episode)
        pairs = (
            (self.flow, episode.flow),
            (self.stock, episode.stock),
            (self.through, through),
            (self.level, level),
            (self.imbalance, net),
        )
        return float(sum((weights * values).sum() for weights, values in pairs if weights is not None))

    def columns(self, layout: Layout, lifetimes: Lifetimes, steps: int) -> Floats:
        """Return its weights on the variables of a program, shape (steps · size,)."""
        weights = np.zeros((steps, layout.size))
        count, stores = len(layout.moments), len(lifetimes.network.stores)
        nodes, arcs = len(layout.network.nodes), len(layout.network.arcs)
        for stock, flow in zip(layout.stock.tolist(), layout.flow.tolist(), strict=True):
            if self.flow is not None:
                weights[:, flow : flow + arcs] += self.flow @ lifetimes.arc_sums / count
            if self.through is not None:
                weights[:, stock : stock + nodes] += self.through @ lifetimes.sums[stores:] / count
        if self.stock is not None:
            weights[:, layout.last] += self.stock @ lifetimes.totals
        if self.level is not None:
            weights[:, layout.level : layout.imbalance] += self.level
        if self.imbalance is not None:
            weights[:, layout.imbalance] += self.imbalance
        return weights.ravel()


@positional_record
class ObjectiveTerm:
    """One thing that a plan may be meant to do."""

    name: Annotated[str, "what it is called"]
    kind: Annotated[str, "one of KINDS"]
    unit: Annotated[str, "of the term itself"]
    about: Annotated[str, "of a service or set-point, whose"] = ""
    roles: Annotated[
        Floats,
        "of a part of λ, the arcs that count in it, shape (arcs,)",
    ] = field(default_factory=lambda: np.zeros(0))

    def tangent(self, network: Network, episode: PlannedEpisode) -> LinearFunctional:
        """Return the term, or its tangent at an episode."""
        steps = network.episode.horizon
        if self.kind == "services":
            level = np.zeros((steps, len(network.services)))
            level[:, [service.id for service in network.services].index(self.about)] = 1.0 / steps
            return LinearFunctional(level=level)
        if self.kind == "circularity":
            if not self.roles.any():
                return LinearFunctional(imbalance=np.full(steps, -1.0 / steps))
            return LinearFunctional(flow=np.tile(self.roles / steps, (steps, 1)))
        compartment = network.compartments[self.about]
        assert compartment.set_point is not None
        if isinstance(compartment, Arc):
            quantity, values, column = "flow", episode.flow, network.arc_index[self.about]
        elif isinstance(compartment, Node) and compartment.stores:
            quantity, values, column = "stock", episode.stock, network.node_index[self.about]
        else:
            values = network.throughput(episode.flow.T).T
            quantity, column = "through", network.node_index[self.about] - len(network.stores)
        # d/dq of -((q - set-point)/scale)², as a mean over the intervals
        weights, slope = np.zeros_like(values), -2.0 / (compartment.scale**2 * steps)
        weights[:, column] = slope * (values[:, column] - compartment.set_point)
        return LinearFunctional(**{quantity: weights})


def objective_terms(network: Network, kinds: Sequence[str] = KINDS) -> list[ObjectiveTerm]:
    """Return what a plan of a network may be meant to do.

    - *circularity*: each part of λ, −Δ times what it counts, mass: taken from reservoirs, put into landfills, …
    - *services*: the mean level of each service; of its band the lower end, unless it is of a content.
    - *set-points*: −((q − set-point)/scale)² of each compartment that has one, as in its local reward.

    Raises:
        CirlError: for an unknown kind, or if there are not two terms to weigh.
    """
    check_names("kind", kinds, KINDS, "terms: ")
    weighable: list[ObjectiveTerm] = []
    if "circularity" in kinds:
        parts: dict[str, Floats] = {}
        absolute = network.objective.net_zero == "abs"
        weights = network.circularity_weights[0] if absolute else network.circularity_weights.sum(axis=0)
        for k in np.flatnonzero(weights).tolist():
            parts.setdefault(circularity_part(network, k), np.zeros(len(network.arcs)))[k] = weights[k]
        weighable += [
            ObjectiveTerm(name, "circularity", network.mass_unit, roles=roles) for name, roles in parts.items()
        ]
        if absolute and network.circularity_weights[1].any():
            weighable.append(ObjectiveTerm("net flow through the environment", "circularity", network.mass_unit))
    if "services" in kinds:
        for service in network.services:
            name = service.title or readable(service.id)
            weighable.append(ObjectiveTerm(name, "services", "1", about=service.id))
    if "set-points" in kinds:
        compartments = network.compartments
        with_set_point = [id_ for id_, compartment in compartments.items() if compartment.set_point is not None]
        for id_ in network.objective.tracked or with_set_point:
            weighable.append(ObjectiveTerm(f"set-point of {compartments[id_].label}", "set-points", "1", about=id_))
    if len(weighable) < 2:
        raise CirlError(
            f"network '{network.name}': there is nothing to weigh: of {', '.join(kinds)} it has {len(weighable)} term"
        )
    return weighable


def circularity_part(network: Network, arc: int) -> str:
    """Return which part of λ an arc counts in, by the first of the roles of ``CIRCULARITY_PARTS`` at its ends."""
    roles = [network.nodes[ends[arc]].role for ends in (network.donors, network.recipients)]
    return next(CIRCULARITY_PARTS[role] for role in CIRCULARITY_PARTS if role in roles)


def service_levels(network: Network, episode: PlannedEpisode) -> Floats:
    """Return the level of each service in each interval, shape (steps, services).

    It is min(1, q/low), of a content min(1, q/low, high/q).
    """
    levels, names = np.ones((len(episode.flow), len(network.services))), [part.id for part in network.substances]
    for s, service in enumerate(network.services):
        low = network.interval_means(service.low)
        if service.quantity == "stock":
            places = np.array([network.node_index[node] for node in service.providers])
            masses, first = episode.stock[:, places], 0
        else:
            places = np.array(network.service_arcs(service))
            masses, first = episode.flow[:, places], len(network.nodes)
        quantity, is_some = masses.sum(axis=1), np.ones(len(masses), dtype=bool)
        if service.substance:
            part = (masses * episode.contents[:, names.index(service.substance), first + places]).sum(axis=1)
            is_some = quantity > NEGLIGIBLE
            quantity = np.divide(part, quantity, out=np.zeros_like(part), where=is_some)
            high = network.interval_means(service.high)
            levels[:, s] = np.divide(high, quantity, out=np.ones_like(part), where=quantity > high)
        enough = np.divide(quantity, low, out=np.ones_like(quantity), where=(low > 0) & is_some)
        levels[:, s] = np.minimum(levels[:, s], enough)
    return levels
