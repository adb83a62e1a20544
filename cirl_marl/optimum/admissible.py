"""What the acting agents can do to each flow, and for which networks that is all there is."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from cirl_marl.dynamics.laws import LAWS, FlowLaws
from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.environments.actuators import Actuators
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Law, Node
from cirl_marl.network.split_fractions import Split, splits
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.vintages import Lifetimes


class NoCertificate(CirlError):
    """A network for which no upper bound is proved; the message says why."""


@dataclass(frozen=True, kw_only=True)
class Admissible:
    """The ranges of the factors of every flow, f_k = v·w_k·a_k·y_p for driven flows, u_k·v for scheduled ones.

    y_p is a stock or, of what leaves a node that stores nothing, its throughput; v is the valve of the donor and w_k or
    u_k the arc's own control or share. Each factor is a single value if nobody acts on it, and may differ from interval
    to interval.

    Attributes:
        network: whose flows they are, with lifetimes as the program sees them.
        lifetimes: how that stands for the network that was given.
        agents: who acts.
        driver: node p that drives each arc; −1 for scheduled flows, shape (arcs,).
        base: a_k, 1/time (1 for what a node passes on), or the mean of the schedule over each interval, mass/time (1
            if a control sets the flow), shape (steps, arcs).
        own: lowest and highest w_k or u_k, shape (2, steps, arcs).
        valve: lowest and highest v of each node, shape (2, steps, nodes).
        neutral_own: w_k or u_k while nobody acts, shape (steps, arcs).
        neutral_valve: v while nobody acts, shape (steps, nodes).
        served: lower end of the band of each service, shape (steps, services).
        splits: the arcs that share what leaves a node.
    """

    network: Network
    lifetimes: Lifetimes
    agents: tuple[str, ...]
    driver: Integers
    base: Floats
    own: Floats
    valve: Floats
    neutral_own: Floats
    neutral_valve: Floats
    served: Floats
    splits: tuple[Split, ...]

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
        acting = Actuators(FlowLaws(network), agents, 1).agents
        lifetimes = Lifetimes(network, acting)
        network = lifetimes.planned
        laws, divided = FlowLaws(network), tuple(splits(network))
        steps = network.episode.horizon
        # lowest, neutral and highest
        own, valve = np.ones((3, steps, len(network.arcs))), np.ones((3, steps, len(network.nodes)))
        for i, node in enumerate(network.nodes):
            if node.control is not None and node.control.kind is ControlKind.RATE:
                valve[:, :, i] = _range(network, node, acting)
        if isinstance(network, StagedNetwork):
            for store, id_ in network.valves.items():
                if network.compartments[id_].control is not None:
                    stretch = _range(network, network.compartments[id_], acting)
                    valve[:, :, network.node_index[store]] = 1.0 / stretch[::-1]
        own[0][:, lifetimes.leaving] = 0.0  # what leaves at the end of a life may be nothing
        for k, arc in enumerate(network.arcs):
            setter = _setter(network, arc)
            if setter is not None:
                own[:, :, k] = _range(network, setter, acting)
        for split in divided:
            arcs = [*split.controlled_arcs, *split.other_arcs]
            asked = own[:, :, list(split.controlled_arcs)].transpose(0, 2, 1)
            (low, high), (neutral, _) = shares(split, asked[[0, 2]]), shares(split, asked[[1, 1]])
            own[:, :, arcs] = np.stack([low.T, neutral.T, high.T])
        share = np.array([arc.law is Law.SHARE for arc in network.arcs], dtype=bool)
        base = [network.interval_means(LAWS[arc.law].coefficient(arc, network)) for arc in network.arcs]
        served = [network.interval_means(service.low) for service in network.services]
        return cls(
            network=network,
            lifetimes=lifetimes,
            agents=acting,
            driver=np.where(laws.is_scheduled, -1, np.where(share, network.donors, laws.driver)),
            base=np.array(base, dtype=float).reshape(-1, steps).T,
            own=own[::2],
            valve=valve[::2],
            neutral_own=own[1],
            neutral_valve=valve[1],
            served=np.array(served, dtype=float).reshape(-1, steps).T,
            splits=divided,
        )

    @property
    def scheduled(self) -> NDArray[np.bool_]:
        """Arcs that flow by schedule, as far as their donor holds enough, shape (arcs,)."""
        return self.driver < 0

    @cached_property
    def lived(self) -> NDArray[np.bool_]:
        """Arcs through which comes what has lived, whatever its stock, shape (arcs,)."""
        found = np.zeros(len(self.network.arcs), dtype=bool)
        found[self.lifetimes.leaving] = True
        return found

    @cached_property
    def factor(self) -> Floats:
        """Lowest and highest v·w_k or v·u_k, shape (2, steps, arcs)."""
        return self.own * self.valve[:, :, self.network.donors]

    @cached_property
    def neutral_rate(self) -> Floats:
        """v·w_k·a_k or u_k·v while nobody acts, shape (steps, arcs)."""
        return self.neutral_own * self.base * self.neutral_valve[:, self.network.donors]

    @cached_property
    def kinds(self) -> Integers:
        """For each interval the first that is like it but for what flows by schedule, shape (steps,)."""
        driven = ~self.scheduled
        parts = [*self.own[:, :, driven], self.base[:, driven], *self.valve, self.neutral_rate[:, driven], self.served]
        parts += [split.proportions.T for split in self.splits]
        _, first, kind = np.unique(np.concatenate(parts, axis=1), axis=0, return_index=True, return_inverse=True)
        kinds: Integers = first[kind.ravel()]
        return kinds

    def rate(self, step: int) -> Floats:
        """Return the lowest and highest coefficient of each arc in one interval, shape (2, arcs).

        1/time for stock-driven arcs, a share for what a node passes on, mass/time for scheduled arcs.
        """
        rate: Floats = self.factor[:, step] * self.base[step]
        return rate

    def released(self, step: int) -> Floats:
        """Return the lowest and highest rate at which each stock is released to be shared out, shape (2, nodes)."""
        released = np.zeros((2, len(self.network.nodes)))
        for split in self.splits:
            i = self.network.node_index[split.donor]
            released[:, i] = self.valve[:, step, i] * self.base[step, split.other_arcs[0]]
        return released

    def exits(self, step: int) -> Floats:
        """Return the lowest and highest rate at which each stock leaves in proportion to itself, shape (2, nodes)."""
        donors, nodes = self.network.donors, len(self.network.nodes)
        rates = self.rate(step) * ((self.driver == donors) & ~self.shared)
        return np.array([np.bincount(donors, each, nodes) for each in rates], dtype=float) + self.released(step)

    @cached_property
    def shared(self) -> NDArray[np.bool_]:
        """Arcs that share what leaves their donor, shape (arcs,)."""
        return np.array([arc.law is Law.SHARE for arc in self.network.arcs], dtype=bool)

    def divided(self, step: int) -> list[Split]:
        """Return the splits in which some share can be chosen in an interval."""
        free = self.own[0, step] < self.own[1, step]
        return [split for split in self.splits if free[[*split.controlled_arcs, *split.other_arcs]].any()]


def shares(split: Split, asked: Floats) -> Floats:
    """Return the lowest and highest share of each arc, first of those with a control, shape (2, arcs, steps).

    A share rises with what its own arc asks for and falls with what the others do.

    Args:
        split: the arcs.
        asked: least and most that each control asks for, shape (2, controlled, steps).
    """
    low = split.bounds[0]
    room = np.maximum(1.0 - low.sum(axis=0), 0.0)
    over = np.maximum(asked - low, 0.0)
    others = (over.sum(axis=1, keepdims=True) - over)[::-1]
    wanted = over + others
    kept = np.divide(room, wanted, out=np.ones_like(wanted), where=wanted > room)
    left = room - np.minimum(over.sum(axis=1), room)[::-1]
    return np.concatenate([low + over * kept, left[:, None] * split.proportions], axis=1)


def _range(network: Network, compartment: Compartment, acting: Sequence[str]) -> Floats:
    """Return the lowest, neutral and highest value of a control, shape (3, steps)."""
    bounds = network.control_bounds[:, network.control_rows[compartment.id].start]
    # what is supplied while nobody acts depends on the state: all that may be is allowed
    supplies = isinstance(compartment, Arc) and bool(compartment.makes_up_for)
    return bounds if compartment.id in acting or supplies else bounds[[1, 1, 1]]


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


def normalised_actions(
    admissible: Admissible, layout: Layout, planned: Floats, intervals: range | None = None
) -> Floats:
    """Return the actions whose constant factors give the planned mean flows at the planned mean stocks.

    v = Z̄/X̄ where a node has several outflows, else what its outflow asks with its own control neutral; then
    w_k = f̄_k/(a_k·v·X̄_p) and u_k = f̄_k/v, each clipped to its range. A share is such a w_k, of what is released. A
    stretch is 1/v, v being that of all stages together.

    Args:
        admissible: ranges of the factors.
        layout: of the variables.
        planned: variables of each interval, shape (steps, size).
        intervals: of the episode, whose first were planned; None is all of them.

    Returns:
        Actions in [−1, 1], in the order of ``MultiAgentVectorEnv.stack``, shape (steps, entries).
    """
    network, first = admissible.network, 0 if intervals is None else intervals.start
    during = slice(first, first + len(planned))
    own_range, valve_range, base = admissible.own[:, during], admissible.valve[:, during], admissible.base[during]
    stock, flow, through = layout.means(planned)
    neutral, valve = admissible.neutral_own[during], admissible.neutral_valve[during].copy()
    by_donor = admissible.driver == network.donors
    for k in np.flatnonzero(by_donor):
        donor = int(network.donors[k])
        if donor not in layout.valves and (valve_range[0, :, donor] < valve_range[1, :, donor]).any():
            unit = base[:, k] * neutral[:, k] * stock[:, donor]
            valve[:, donor] = _ratio(flow[:, k], unit, valve[:, donor])
    for z, node in enumerate(layout.valves):
        valve[:, node] = _ratio(through[:, z], stock[:, node], valve[:, node])
    if isinstance(network, StagedNetwork):
        for node in dict.fromkeys(network.valves.values()):
            arcs = [k for k in np.flatnonzero(by_donor) if network.valves.get(network.arcs[k].donor) == node]
            unit, place = base[:, arcs] * stock[:, network.donors[arcs]], network.node_index[node]
            valve[:, place] = _ratio(flow[:, arcs].sum(axis=1), unit.sum(axis=1), valve[:, place])
    # what is left of f̄_k after the valve is the arc's own factor, w_k = f̄_k/(a_k·v·X̄_p)
    valve = np.clip(valve, *valve_range)
    driving = np.where(admissible.scheduled, 1.0, stock[:, admissible.driver])
    own = _ratio(flow, base * driving * valve[:, network.donors], neutral)
    return _entries(admissible, valve, np.clip(own, *own_range), during)


def _entries(admissible: Admissible, valve: Floats, own: Floats, during: slice) -> Floats:
    network, steps = admissible.network, np.arange(during.start, during.stop)
    actuators = Actuators(FlowLaws(admissible.lifetimes.network), admissible.agents or None, len(steps))
    actions = np.zeros((len(steps), len(actuators.acting)))
    for agent, entries in actuators.entries.items():
        control = network.compartments[agent].control
        assert control is not None
        if agent in network.arc_index:
            values = own[:, network.arc_index[agent]]
        elif control.kind is ControlKind.RATE:
            values = valve[:, network.node_index[agent]]
        elif control.kind is ControlKind.STRETCH:
            values = 1.0 / valve[:, network.node_index[agent]]
        else:
            node = network.node_index[agent]
            sets = next(k for k in np.flatnonzero(network.donors == node) if network.arcs[k].law is Law.CONTROLLED)
            values = own[:, sets]
        actions[:, entries] = actuators.normalise(agent, values[None], steps).T
    return actions


def _ratio(amount: Floats, unit: Floats, otherwise: Floats) -> Floats:
    return np.divide(amount, unit, out=otherwise.copy(), where=unit > 1e-12 * np.abs(amount))
