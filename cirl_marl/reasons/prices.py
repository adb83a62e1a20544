"""Shadow prices: what a little more of a stock, of demand or of room to act is worth in λ̄, read off a certificate."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.elements import Arc, Node
from cirl_marl.network.series import in_intervals
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.bounds import Bound, bound, highest_service
from cirl_marl.optimum.options import by_stage
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.sensitivity import changes, resting_on_rows
from cirl_marl.optimum.stock_values import stock_values

PERCENT = 0.01
DIFFERENCE = 1e-5
"""Relative step of difference quotients of a program's numbers; none of them is solved again."""
WITHIN_REACH = 0.99
"""Part of the highest service that can be had which is demanded where nobody says what is."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ShadowPrices:
    """What a little more of something changes in the best λ̄, by the interval in which there is more of it.

    All are slopes at the optimum of the linear program. The best λ̄ is concave in stocks and demands, so that no plan
    gains more than the price says from any amount.

    Attributes:
        bound: the best λ̄ that they are about.
        stock: rise of λ̄ for a unit of mass more, new, in each stock at the start of each interval, shape
            (steps, stores), 1.
        demand: rise of λ̄ for a unit more in the lower end of the band of each service in each interval, shape
            (steps, services), mass per unit of that.
        level: rise of λ̄ per unit of the mean level that is demanded of each service, shape (services,), mass.
        room: rise of λ̄ if the lower or the upper bound of the control of each agent is moved outwards by one per cent
            of itself, shape (2, steps, agents), mass; over all intervals their sum.
    """

    bound: Bound
    stock: Floats
    demand: Floats
    level: Floats
    room: Floats

    @property
    def network(self) -> Network:
        """The network that they are about."""
        return self.bound.network


def shadow_prices(
    network: str | Path | Network,
    initial: ArrayLike | None = None,
    *,
    min_service: ArrayLike | None = None,
    agents: Sequence[str] | None = None,
    scenario: str | None = None,
    progress: Callable[[float], None] = lambda share: None,
) -> ShadowPrices:
    """Return what a little more of each stock, each demand and each control bound is worth in λ̄.

    With V the optimum of the program of ``bound`` and y, μ its multipliers, dV/dθ is minus the derivative of the
    Lagrangian in θ, as long as V has one. Where V has a kink, a little less may be worth more.

    Args:
        network: catalogue name, path of a definition file, or a network.
        initial: stocks at the start, as for ``bound``.
        min_service: mean level demanded of every service, or of each; None: 99 % of the highest that all can have.
        agents: who acts; None is the network's own choice.
        scenario: of the definition.
        progress: called with the share that is done.

    Raises:
        NoCertificate: for a network for which no bound is proved; the message says why.
        CirlError: for input that cannot be used, or a service out of reach.

    References: Boyd and Vandenberghe 2004, Convex Optimization, section 5.6.
    """
    network = load_network(network, scenario=scenario)
    if min_service is None and network.services:
        min_service = WITHIN_REACH * highest_service(network)
    best = bound(network, initial, min_service=min_service, agents=agents)
    progress(0.3)
    admissible = Admissible.of(network, agents)
    programs = Programs(admissible, best.degree, None)
    best = resting_on_rows(best, admissible)
    steps, services = network.episode.horizon, len(network.services)
    demand, room = np.zeros((steps, services)), np.zeros((2, steps, len(best.agents)))
    shares = iter(np.linspace(0.5, 1.0, services + 2 * len(best.agents) + 1).tolist())
    progress(next(shares))
    for s in range(services):
        step = DIFFERENCE * max(float(admissible.service_low[:, s].max()), 1.0)
        demand_rows = admissible.service_low.copy()
        demand_rows[:, s] += step
        demand[:, s] = _slope(best, admissible, replace(admissible, service_low=demand_rows)) / step
        progress(next(shares))
    for a, agent in enumerate(best.agents):
        for side in range(2):
            room[side, :, a] = _worth_of_room(best, admissible, agent, side)
            progress(next(shares))
    # the last rows of the program hold each service to its level
    demands = 0 if best.min_service is None else services
    last = best.certificate.under[len(best.certificate.under) - services :]
    level = np.minimum(last, 0.0) if best.min_service is not None else np.zeros(services)
    stock = stock_values(programs, best.problem, best.certificate, demands=demands)
    return ShadowPrices(bound=best, stock=stock, demand=demand, level=level, room=room)


def _slope(best: Bound, admissible: Admissible, variant: Admissible) -> Floats:
    """Return the rise of λ̄ by interval with the program of a variant of what is admissible."""
    # a source without a known reserve starts with all that may be asked of it
    before, after = (
        by_stage(network, admissible.lifetimes.state_layout, network.initial.mean(axis=0))
        for network in (best.network, variant.lifetimes.network)
    )
    initial = best.initial + after - before
    program = Programs(variant, best.degree, None).program(initial, best.min_service)
    return changes(best, admissible, program)


def _worth_of_room(best: Bound, admissible: Admissible, agent: str, side: int) -> Floats:
    """Return the rise of λ̄ by interval for a bound that is moved outwards by one per cent, shape (steps,)."""
    network = admissible.lifetimes.network
    values = network.control_bounds[2 * side, network.control_rows[agent].start]
    if not values.any():
        return np.zeros(len(values))
    outwards = (-1.0, 1.0)[side] * np.sign(values)
    # a share of 1 cannot grow, and a faster flow may take another number of pieces: then the slope inwards
    for sign in (1.0, -1.0):
        try:
            variant = with_bound(network, agent, side, values * (1 + sign * outwards * DIFFERENCE))
            rise = _slope(best, admissible, Admissible.of(variant, best.agents))
        except (CirlError, ValueError):
            continue
        return rise * sign * PERCENT / DIFFERENCE
    raise CirlError(f"network '{network.name}': no other bound of the control of '{agent}' makes a like program")


def with_bound(network: Network, agent: str, side: int, values: Floats) -> Network:
    """Return the network with other values of a control's lower (0) or upper (1) bound in each interval.

    The neutral value follows where it would lie outside.

    Raises:
        NetworkError: if the control cannot have them.
    """
    compartment = network.compartments[agent]
    assert isinstance(compartment, Arc | Node) and compartment.control is not None
    bounds = network.control_bounds[:, network.control_rows[agent].start].copy()
    bounds[2 * side] = values
    bounds[1] = np.clip(bounds[1], bounds[0], bounds[2])
    interval = network.episode.control_interval
    low, neutral, high = (in_intervals(series, interval) for series in bounds)
    control = replace(compartment.control, low=low, neutral=neutral, high=high)
    variant = replace(compartment, control=control)
    nodes = tuple(variant if node.id == agent else node for node in network.nodes)
    arcs = tuple(variant if arc.id == agent else arc for arc in network.arcs)
    return network.variant(nodes=nodes, arcs=arcs)
