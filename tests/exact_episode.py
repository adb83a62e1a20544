"""An episode of the exact simulator, computed a second time from matrix exponentials and Gauss-Legendre quadrature.

Nothing here is taken from the solver or from the linear program: the laws are read off the network, the trajectory
within a substep is that of ẋ = M x + U, and its weighted means are integrals of it. Used to hold the rows and boxes of
the program against what an episode does.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg

from cirl_marl import Arc, Control, ControlKind, Law, Network
from cirl_marl.network.series import Series

Floats = NDArray[np.float64]
Controls = Mapping[str, float]
POINTS, WEIGHTS = (0.5 * np.polynomial.legendre.leggauss(14)[0] + 0.5, 0.5 * np.polynomial.legendre.leggauss(14)[1])
"""Nodes and weights on [0, 1]; no node turns over more than its stock in a substep, so 14 points leave round-off."""
SCHEDULED = (Law.CONTROLLED, Law.EXOGENOUS)


@dataclass(frozen=True, slots=True)
class Piece:
    """One substep.

    Attributes:
        stock: at the quadrature points, shape (points, stores).
        flow: at the quadrature points, shape (points, arcs).
        end: stocks at its end, shape (stores,).
        end_flow: flows at its end, shape (arcs,).
        cut: whether a scheduled flow was cut to what its donor held.
    """

    stock: Floats
    flow: Floats
    end: Floats
    end_flow: Floats
    cut: bool


def means(pieces: Sequence[Piece], degree: int) -> tuple[Floats, Floats]:
    """Return stocks and flows weighted with the Bernstein polynomials over pieces, (degree + 1, stores | arcs)."""
    i = np.arange(degree + 1)[:, None]
    binomial = np.array([[math.comb(degree, int(each))] for each in i[:, 0]])
    points = np.concatenate([(POINTS + place) / len(pieces) for place in range(len(pieces))])
    weights = np.tile(WEIGHTS, len(pieces)) / len(pieces)
    density = (degree + 1) * binomial * points**i * (1 - points) ** (degree - i) * weights
    stock, flow = (np.concatenate([getattr(each, name) for each in pieces]) for name in ("stock", "flow"))
    return density @ stock, density @ flow


@dataclass(frozen=True, slots=True)
class Interval:
    """One control interval.

    Attributes:
        controls: the value of every control, by compartment.
        pieces: its substeps.
        flow: mean flows, shape (arcs,).
        levels: of the services, shape (services,).
        circularity: λ of the mean flows.
    """

    controls: Controls
    pieces: tuple[Piece, ...]
    flow: Floats
    levels: Floats
    circularity: float


def control_of(network: Network, compartment: str) -> Control:
    """Return the control of a compartment that has one."""
    control = network.compartments[compartment].control
    assert control is not None
    return control


def valve_of(network: Network, node: str, controls: Controls) -> float:
    """Return the factor with which a node's valve acts on all that leaves it; 1 if it has none."""
    control = network.compartments[node].control
    return controls[node] if control is not None and control.kind is ControlKind.RATE else 1.0


def mean_of(network: Network, value: float | Series, step: int) -> float:
    """Return the mean over an interval of what may be a series, by the trapezoids between its corners."""
    if not isinstance(value, Series):
        return value
    h = network.episode.control_interval
    start, end = step * h, (step + 1) * h
    if value.interpolation == "step":
        edges = [*value.times[1:], math.inf]
        overlap = [max(0.0, min(end, b) - max(start, a)) for a, b in zip(value.times, edges, strict=True)]
        return sum(each * length for each, length in zip(value.values, overlap, strict=True)) / (end - start)
    corners = [start, *(t for t in value.times if start < t < end), end]
    return float(np.trapezoid(np.interp(corners, value.times, value.values), corners)) / (end - start)


def share_of(network: Network, arc: Arc, controls: Controls, step: int) -> float:
    """Return the share of an arc in what leaves its donor."""
    split = [each for each in network.arcs if each.donor == arc.donor and each.law is Law.SHARE]
    bounds = {each.id: control_of(network, each.id) for each in split if each.control is not None}
    low = {name: mean_of(network, control.low, step) for name, control in bounds.items()}
    over = {name: controls[name] - low[name] for name in bounds}
    room = 1 - sum(low.values())
    cut = min(1.0, room / sum(over.values())) if sum(over.values()) > 0 else 1.0
    if arc.id in bounds:
        return low[arc.id] + over[arc.id] * cut
    neutral = sum(mean_of(network, control.neutral, step) for control in bounds.values())
    given = {each.id: mean_of(network, each.share, step) for each in split if each.share is not None}
    rest = max(1 - neutral - sum(given.values()), 0.0)
    weights = {each.id: given.get(each.id, rest) for each in split if each.control is None}
    total = sum(weights.values())
    proportion = weights[arc.id] / total if total > 0 else float(arc.share is None)
    return proportion * (1 - sum(low.values()) - cut * sum(over.values()))


def coefficient(network: Network, arc: Arc, controls: Controls, step: int) -> float:
    """Return r of f = r·y_driver, 1/time or a share, or of f = r for scheduled arcs, mass/time, before any cut."""
    donor = network.nodes[network.node_index[arc.donor]]
    if arc.law is Law.SHARE:
        release = mean_of(network, donor.rate, step) * valve_of(network, arc.donor, controls) if donor.stores else 1.0
        return release * share_of(network, arc, controls, step)
    sets_flow = donor.control is not None and donor.control.kind is ControlKind.FLOW
    if arc.law is Law.CONTROLLED:
        own = controls[arc.donor if sets_flow else arc.id]
    else:
        own = controls[arc.id] if arc.control is not None else 1.0
        own *= mean_of(network, arc.flow if arc.law is Law.EXOGENOUS else arc.rate, step)
    return own * valve_of(network, arc.donor, controls)


def intervals(network: Network, start: Floats, controls: list[Controls], substeps: int) -> Iterator[Interval]:
    """Yield what happens in each interval from ``start``, shape (stores,), on."""
    arcs, nodes = network.arcs, len(network.stores)
    donor = [network.node_index[arc.donor] for arc in arcs]
    recipient = [network.node_index[arc.recipient] for arc in arcs]
    driver = [r if arc.law is Law.RECIPIENT else d for arc, d, r in zip(arcs, donor, recipient, strict=True)]
    every = np.arange(len(arcs))
    incidence = np.zeros((len(network.nodes), len(arcs)))
    incidence[donor, every] = -1.0
    incidence[recipient, every] = 1.0
    incidence = incidence[:nodes]
    passed_on = np.array(donor) >= nodes
    scheduled = np.array([arc.law in SCHEDULED for arc in arcs], dtype=bool)
    length = network.episode.control_interval / substeps
    stock = start.astype(float)
    for step, held in enumerate(controls):
        rate = np.array([coefficient(network, arc, held, step) for arc in arcs])
        for limited, arc in enumerate(arcs):
            if arc.capacity_node:
                limit = mean_of(network, arc.capacity_rate, step) * stock[network.node_index[arc.capacity_node]]
                rate[limited] = min(rate[limited], limit)
        law = np.zeros((len(arcs), nodes))
        for k in np.flatnonzero(~scheduled & ~passed_on):
            law[k, driver[k]] = rate[k]
        # f = law·x + order + S f, with S_kl the share of k in what l brings to its donor, which stores nothing
        routes = rate[:, None] * passed_on[:, None] * (np.array(donor)[:, None] == np.array(recipient)[None])
        passing = np.linalg.inv(np.eye(len(arcs)) - routes)
        law = passing @ law
        extended = np.zeros((2 * nodes, 2 * nodes))
        extended[:nodes, :nodes], extended[:nodes, nodes:] = incidence @ law, np.eye(nodes)
        times = np.append(POINTS, 1.0)[:, None, None] * length
        solved = linalg.expm(extended * times)[:, :nodes]
        pieces = []
        for _ in range(substeps):
            order = np.where(scheduled, rate, 0.0)
            factor = np.ones(nodes)
            for node in set(np.array(donor, dtype=int)[scheduled].tolist()):
                mine = np.array(donor) == node
                exits = sum(rate[k] for k in np.flatnonzero(mine) if arcs[k].law in (Law.DONOR, Law.SHARE)) * length
                most = stock[node] * (exits / math.expm1(exits) if exits > 1e-12 else 1.0) / length
                asked = order[mine].sum()
                factor[node] = min(1.0, most / asked) if asked > 0 else 1.0
            order = passing @ (order * np.append(factor, 1.0)[np.minimum(network.donors, nodes)])
            at = solved @ np.concatenate([stock, incidence @ order])
            flow = at @ law.T + order
            stock = at[-1]
            pieces.append(Piece(at[:-1], flow[:-1], at[-1], flow[-1], bool((factor < 1 - 1e-9).any())))
        mean = np.mean([WEIGHTS @ piece.flow for piece in pieces], axis=0)
        yield Interval(held, tuple(pieces), mean, _levels(network, stock, mean, step), _circularity(network, mean))


def imbalance(network: Network, flow: Floats) -> float:
    """Return |Δ·σ_env·f|, f over the arcs that touch the environment."""
    weights = network.sustainability * network.environmental
    return abs(float(network.objective.reference_interval * weights @ flow))


def _circularity(network: Network, flow: Floats) -> float:
    weights = network.objective.reference_interval * network.sustainability
    rest = float(weights[~network.environmental] @ flow[~network.environmental])
    through = float(weights[network.environmental] @ flow[network.environmental])
    return -rest - (abs(through) if network.objective.net_zero == "abs" else through)


def _levels(network: Network, stock: Floats, flow: Floats, step: int) -> Floats:
    levels = []
    for service in network.services:
        if service.quantity == "stock":
            q = sum(stock[network.node_index[each]] for each in service.providers)
        elif service.quantity == "flow":
            q = sum(flow[network.arc_index[each]] for each in service.providers)
        else:
            q = sum(f for f, arc in zip(flow, network.arcs, strict=True) if arc.donor in service.providers)
        low, high = (mean_of(network, end, step) for end in (service.low, service.high))
        levels.append(max(0.0, min(1.0, q / low if low > 0 else 1.0, high / q if q > high else 1.0)))
    return np.array(levels)
