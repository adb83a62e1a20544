"""What the acting agents can do to each flow, and for which networks that is all there is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.environments.actuators import Actuators
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Law, Node


class NoCertificate(CirlError):
    """A network for which no upper bound is proved; the message says why."""


@dataclass(frozen=True, kw_only=True)
class Admissible:
    """The ranges of the factors of every flow, f_k = v·w_k·a_k·x_p for stock-driven flows, u_k·v for scheduled ones.

    v is the valve of the donor and w_k or u_k the arc's own control; each is a single value if nobody acts on it. All
    may differ from interval to interval.

    Attributes:
        network: whose flows they are.
        agents: who acts.
        driver: node p whose stock drives each arc; −1 for scheduled flows, shape (arcs,).
        base: a_k, 1/time, or the mean of the schedule over each interval, mass/time (1 if a control sets the flow),
            shape (steps, arcs).
        own: lowest and highest w_k or u_k, shape (2, steps, arcs).
        valve: lowest and highest v of each node, shape (2, steps, nodes).
        neutral_rate: v·w_k·a_k or u_k·v while nobody acts, shape (steps, arcs).
        neutral_valve: v while nobody acts, shape (steps, nodes).
        served: lower end of the band of each service, shape (steps, services).
    """

    network: Network
    agents: tuple[str, ...]
    driver: Integers
    base: Floats
    own: Floats
    valve: Floats
    neutral_rate: Floats
    neutral_valve: Floats
    served: Floats

    @classmethod
    def of(cls, network: Network, agents: Sequence[str] | None = None) -> Admissible:
        """Read the ranges off ``network`` while ``agents`` act and the others are neutral.

        Raises:
            NoCertificate: for inner physics, batches, or a solver that is not exact.
            CirlError: for an unknown agent.
        """
        reasons = list(_uncertified(network))
        if reasons:
            named = f"network '{network.name}', scenario '{network.scenario_name}'"
            raise NoCertificate(f"{named}: no bound is proved: {'; '.join(reasons)}")
        laws = FlowLaws(network)
        acting = Actuators(laws, agents, 1).agents
        steps = network.episode.horizon
        own, valve = np.ones((2, steps, len(network.arcs))), np.ones((2, steps, len(network.nodes)))
        neutral_valve = np.ones((steps, len(network.nodes)))
        for i, node in enumerate(network.nodes):
            if node.control is not None and node.control.kind is ControlKind.RATE:
                valve[:, :, i], neutral_valve[:, i] = _range(node, acting), node.control.neutral
        for k, arc in enumerate(network.arcs):
            setter = _setter(network, arc)
            if setter is not None:
                own[:, :, k] = _range(setter, acting)
        return cls(
            network=network,
            agents=acting,
            driver=np.where(laws.scheduled, -1, laws.driver),
            base=laws.rate(np.ones((len(laws.neutral), steps)), np.arange(steps)).T,
            own=own,
            valve=valve,
            neutral_rate=laws.rate(np.repeat(laws.neutral[:, None], steps, axis=1), np.arange(steps)).T,
            neutral_valve=neutral_valve,
            served=np.tile([service.low for service in network.services], (steps, 1)),
        )

    @property
    def scheduled(self) -> NDArray[np.bool_]:
        """Arcs that flow by schedule, as far as their donor holds enough, shape (arcs,)."""
        return self.driver < 0

    @cached_property
    def factor(self) -> Floats:
        """Lowest and highest v·w_k or v·u_k, shape (2, steps, arcs)."""
        return self.own * self.valve[:, :, self.network.donors]

    @cached_property
    def kinds(self) -> Integers:
        """For each interval the first that is like it but for what flows by schedule, shape (steps,)."""
        driven = ~self.scheduled
        parts = (*self.own[:, :, driven], self.base[:, driven], *self.valve, self.neutral_rate[:, driven], self.served)
        _, first, kind = np.unique(np.concatenate(parts, axis=1), axis=0, return_index=True, return_inverse=True)
        return first[kind.ravel()]

    def rate(self, step: int) -> Floats:
        """Return the lowest and highest coefficient of each arc in one interval, shape (2, arcs).

        1/time for stock-driven arcs, mass/time for scheduled ones.
        """
        rate: Floats = self.factor[:, step] * self.base[step]
        return rate


def _range(compartment: Compartment, acting: Sequence[str]) -> Floats:
    """Return the lowest and highest value of a control, shape (2, 1)."""
    control = compartment.control
    assert control is not None
    ends = (control.low, control.high) if compartment.id in acting else (control.neutral, control.neutral)
    return np.array(ends)[:, None]


def _setter(network: Network, arc: Arc) -> Arc | Node | None:
    """Return the compartment whose control is the arc's own factor; the valve of its donor is none."""
    donor = network.nodes[network.node_index[arc.donor]]
    if arc.law is Law.CONTROLLED and donor.control is not None and donor.control.kind is ControlKind.FLOW:
        return donor
    return arc if arc.control is not None else None


def _uncertified(network: Network) -> Iterator[str]:
    """Yield why the theorem does not hold for the flows of ``network``."""
    if network.episode.solver != "exact":
        yield f"solver '{network.episode.solver}' is not exact within a control interval"
    modelled = [c.id for c in network.compartments.values() if c.model is not None]
    if modelled:
        yield f"{modelled} have inner physics"
    batches = [arc.id for arc in network.arcs if arc.law is Law.BATCH]
    if batches:
        yield f"{batches} move batches"
