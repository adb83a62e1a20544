"""What the acting agents can do to each flow, the networks for which that is all, and the actions for planned flows."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from cirl_marl.dynamics.components import ComponentNetwork, copy_id
from cirl_marl.dynamics.laws import LAWS
from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.environments.actuators import Actuators
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record, with_field_docs
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Law, Node
from cirl_marl.network.split_fractions import Split, share_ranges
from cirl_marl.optimum.content_ranges import Mixtures, content_ranges, source_grades
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.vintages import Lifetimes


class NoCertificate(CirlError):
    """A network for which no upper bound is proved; the message says why."""


@positional_record
class FreeSplit:
    """A split of what leaves a node in which some share can be chosen."""

    donor: Annotated[int, "the node"]
    arcs: Annotated[Integers, "those with a control, then the others, which keep their proportions"]
    leader: Annotated[int, "of the others the greatest"]
    followers: Annotated[Integers, "the rest of them"]
    ratio: Annotated[Floats, "these as parts of the leader"]

    @classmethod
    def of(cls, split: Split, donor: int, step: int) -> FreeSplit:
        """Read it off a split in one interval."""
        proportions, free_arcs = split.proportions[:, step], np.array(split.other_arcs, dtype=np.intp)
        first = int(proportions.argmax())
        rest = np.arange(len(proportions)) != first
        arcs = np.array([*split.controlled_arcs, *split.other_arcs])
        return cls(donor, arcs, split.other_arcs[first], free_arcs[rest], proportions[rest] / proportions[first])


@with_field_docs
@dataclass(frozen=True, kw_only=True)
class Admissible:
    """The ranges of the factors of every flow, f_k = v·w_k·a_k·y_p for driven flows, u_k·v for scheduled ones.

    y_p is a stock or, of what leaves a node that stores nothing, its throughput; v is the valve of the donor and w_k or
    u_k the arc's own control or share. Each factor is a single value if nobody acts on it, and may differ from interval
    to interval.
    """

    network: Annotated[Network, "whose flows they are, with lifetimes as the program sees them"]
    lifetimes: Annotated[Lifetimes, "how that stands for the network that was given"]
    actuators: Annotated[Actuators, "who acts, and by which controls"]
    driver: Annotated[Integers, "node p that drives each arc; −1 for scheduled flows, shape (arcs,)"]
    base: Annotated[
        Floats,
        "a_k, 1/time (1 for what a node passes on), or the mean of the schedule over each interval, mass/time (1 if a "
        "control sets the flow), shape (steps, arcs)",
    ]
    setting: Annotated[Floats, "lowest and highest w_k or u_k, shape (2, steps, arcs)"]
    valve: Annotated[Floats, "lowest and highest v of each node, shape (2, steps, nodes)"]
    neutral_setting: Annotated[Floats, "w_k or u_k while nobody acts, shape (steps, arcs)"]
    neutral_valve: Annotated[Floats, "v while nobody acts, shape (steps, nodes)"]
    service_low: Annotated[Floats, "lower end of the band of each service, shape (steps, services)"]
    splits: Annotated[tuple[Split, ...], "the arcs that share what leaves a node"]
    order_range: Annotated[
        Floats, "least and most that ``network.orders`` ask for, mass/time, shape (2, steps, orders)"
    ]
    capacity_arcs: Annotated[Integers, "arcs that the stock of another node limits"]
    capacity_rate: Annotated[Floats, "flow that a unit of it can carry, shape (steps, limited arcs), 1/time"]
    mixtures: Annotated[Mixtures | None, "scheduled flows of components; None if contents are not followed"]

    @classmethod
    def of(
        cls,
        network: Network,
        agents: Sequence[str] | None = None,
        like: Mixtures | None = None,
        present: Floats | None = None,
    ) -> Admissible:
        """Read the ranges off ``network`` while ``agents`` act and the others are neutral.

        One that is written by components already has the contents of another, which it is ``like``. Programs may start
        from stocks of ``present`` contents too; see ``content_ranges``.

        Raises:
            NoCertificate: for inner physics, batches, or a solver that is not exact.
            CirlError: for an unknown agent.
        """
        reasons = list(_exclusions(network))
        if reasons:
            name = f"network '{network.name}', scenario '{network.scenario_name}'"
            raise NoCertificate(f"{name}: no bound is proved: {'; '.join(reasons)}")
        actuators = Actuators(network, agents, 1)
        agents = actuators.agents
        lifetimes = Lifetimes(network, agents)
        network = lifetimes.plan_network
        steps = network.episode.horizon
        # lowest, neutral and highest
        setting, valve = np.ones((3, steps, len(network.arcs))), np.ones((3, steps, len(network.nodes)))
        for i, node in enumerate(network.nodes):
            if node.control is not None and node.control.kind is ControlKind.RATE:
                valve[:, :, i] = control_range(network, node, agents)
        if isinstance(network, StagedNetwork):
            for store, id_ in network.valves.items():
                if network.compartments[id_].control is not None:
                    stretch = control_range(network, network.compartments[id_], agents)
                    valve[:, :, network.node_index[store]] = 1.0 / stretch[::-1]
        # what leaves at the end of a life may be nothing
        setting[0][:, lifetimes.exit_arcs], setting[2][:, lifetimes.exit_arcs] = 0.0, lifetimes.most_factor
        for k, arc in enumerate(network.arcs):
            compartment = setter(network, arc)
            if compartment is not None:
                setting[:, :, k] = control_range(network, compartment, agents)
        has_capacity = np.array([bool(arc.capacity_node) for arc in network.arcs], dtype=bool)
        setting[0][:, has_capacity] = 0.0  # as long as nothing is built they carry nothing
        with_capacity = [arc for arc in network.arcs if arc.capacity_node and network.original(arc.id) == arc.id]
        capacity_arcs = np.array([network.arc_index[arc.id] for arc in with_capacity], dtype=np.intp)
        split_arcs, orders = network.splits, [*network.orders]
        coefficients = [network.interval_means(LAWS[arc.law].coefficient(arc, network)) for arc in network.arcs]
        base = np.array(coefficients, dtype=float).reshape(-1, steps).T.copy()
        order_range = setting[::2, :, orders] * base[:, orders]
        setting[:, :, orders], base[:, orders] = np.array([0.0, 0.5, 1.0])[:, None, None], 1.0
        for split in split_arcs:
            arcs = [*split.controlled_arcs, *split.other_arcs]
            wishes = setting[:, :, list(split.controlled_arcs)].transpose(0, 2, 1)
            (low, high), (neutral, _) = share_ranges(split, wishes[[0, 2]]), share_ranges(split, wishes[[1, 1]])
            setting[:, :, arcs] = np.stack([low.T, neutral.T, high.T])
        driver = np.where([arc.law is Law.RECIPIENT for arc in network.arcs], network.recipients, network.donors)
        driver[np.array([LAWS[arc.law].is_scheduled for arc in network.arcs], dtype=bool)] = -1
        driver[orders] = network.donors[orders]
        mixtures = None
        if isinstance(network, ComponentNetwork):
            mixtures = _mixtures(lifetimes, setting, valve, base, like, present)
        service_low = [network.interval_means(service.low) for service in network.services]
        return cls(
            network=network,
            lifetimes=lifetimes,
            actuators=actuators,
            driver=driver,
            base=base,
            setting=setting[::2],
            valve=valve[::2],
            neutral_setting=setting[1],
            neutral_valve=valve[1],
            service_low=np.array(service_low, dtype=float).reshape(-1, steps).T,
            splits=split_arcs,
            order_range=order_range,
            capacity_arcs=capacity_arcs,
            capacity_rate=np.array([network.interval_means(arc.capacity_rate) for arc in with_capacity], dtype=float)
            .reshape(-1, steps)
            .T,
            mixtures=mixtures,
        )

    @property
    def agents(self) -> tuple[str, ...]:
        """Who acts."""
        return self.actuators.agents

    @property
    def by_schedule(self) -> NDArray[np.bool_]:
        """Arcs that flow by schedule, as far as their donor holds enough, shape (arcs,)."""
        return self.driver < 0

    @cached_property
    def share_arcs(self) -> NDArray[np.bool_]:
        """Arcs that share what leaves their donor, shape (arcs,)."""
        return np.array([arc.law is Law.SHARE for arc in self.network.arcs], dtype=bool)

    @cached_property
    def rate(self) -> Floats:
        """Lowest and highest coefficient of each arc, shape (2, steps, arcs).

        1/time for stock-driven arcs, a share for what a node passes on, mass/time for scheduled ones.
        """
        return self.setting * self.valve[:, :, self.network.donors] * self.base

    @cached_property
    def neutral_rate(self) -> Floats:
        """v·w_k·a_k or u_k·v while nobody acts, shape (steps, arcs)."""
        return self.neutral_setting * self.base * self.neutral_valve[:, self.network.donors]

    @cached_property
    def kinds(self) -> Integers:
        """For each interval the first that is like it but for what flows by schedule, shape (steps,)."""
        parts = [self._by_interval, self.service_low]
        _, first, kind = np.unique(np.concatenate(parts, axis=1), axis=0, return_index=True, return_inverse=True)
        kinds: Integers = first[kind.ravel()]
        return kinds

    @cached_property
    def _by_interval(self) -> Floats:
        """All that rows of an interval follow from, but for bands of services, shape (steps, numbers)."""
        stock_driven = ~self.by_schedule
        parts = [
            *self.setting[:, :, stock_driven],
            self.base[:, stock_driven],
            *self.valve,
            self.neutral_rate[:, stock_driven],
            *(split.proportions.T for split in self.splits),
            self.capacity_rate,
        ]
        return np.concatenate(parts, axis=1)

    def key(self, interval: int) -> bytes:
        """Return what is the same in intervals that have the same rows, but for the bands of services."""
        return bytes(self._by_interval[interval])

    @cached_property
    def ranges(self) -> dict[int, IntervalRanges]:
        """The ranges in the intervals of each kind, read off when they are asked for."""
        return _RangesByKind(self)


class _RangesByKind(dict[int, "IntervalRanges"]):
    """The ranges of each kind of interval."""

    def __init__(self, admissible: Admissible) -> None:
        self._admissible = admissible

    def __missing__(self, kind: int) -> IntervalRanges:
        ranges = self[kind] = IntervalRanges(self._admissible, kind)
        return ranges


class IntervalRanges:
    """The ranges of the flows in the intervals of one kind: what ``Admissible`` has of them, and what follows from it.

    Attributes:
        proportional: arcs whose flow is a rate times what drives it: no schedule, no lifetime, shape (arcs,).
        leaves_lifetime: arcs that carry what has lived, likewise.
        release: rate at which each stock is released to be shared out, lowest and highest, 1/time, shape (2, nodes).
        exits: rate at which each stock leaves in proportion to itself, likewise.
        free_splits: the splits in which some share can be chosen.
        capacity_arcs: arcs that the stock of another node limits.
        capacity_rate: flow that a unit of it can carry, shape (limited arcs,), 1/time.
        totals: what stocks of the network are of those of the planned one, shape (stores, stores).
        followers: arcs whose flows follow from one with which they share what others leave.
    """

    def __init__(self, admissible: Admissible, step: int) -> None:
        """Take those of one interval."""
        network = self.network = admissible.network
        self.by_schedule, self.share_arcs = admissible.by_schedule, admissible.share_arcs
        self.setting, self.valve = admissible.setting[:, step], admissible.valve[:, step]
        self.rate, self.base = admissible.rate[:, step], admissible.base[step]
        self.neutral_rate, self.neutral_valve = admissible.neutral_rate[step], admissible.neutral_valve[step]
        self.driver, self.service_low = admissible.driver, admissible.service_low[step]
        self.capacity_arcs, self.capacity_rate = admissible.capacity_arcs, admissible.capacity_rate[step]
        self.totals = admissible.lifetimes.totals
        self.leaves_lifetime = np.isin(np.arange(len(network.arcs)), admissible.lifetimes.exit_arcs)
        self.proportional = ~self.by_schedule & ~self.leaves_lifetime
        self.release = np.zeros((2, len(network.nodes)))
        self.free_splits = []
        for split in admissible.splits:
            donor, arcs = network.node_index[split.donor], [*split.controlled_arcs, *split.other_arcs]
            self.release[:, donor] = self.valve[:, donor] * self.base[split.other_arcs[0]]
            if (self.setting[0] < self.setting[1])[arcs].any():
                self.free_splits.append(FreeSplit.of(split, donor, step))
        self.followers = np.concatenate([np.zeros(0, dtype=np.intp), *(split.followers for split in self.free_splits)])
        # shares of a release do not leave one by one: the release as a whole does
        single = self.rate * ((self.driver == network.donors) & ~self.share_arcs)
        outflow = [np.bincount(network.donors, bound, len(network.nodes)) for bound in single]
        self.exits = np.array(outflow, dtype=float) + self.release


def _mixtures(
    lifetimes: Lifetimes,
    setting: Floats,
    valve: Floats,
    base: Floats,
    like: Mixtures | None,
    present: Floats | None,
) -> Mixtures:
    """Return the scheduled flows of components, and give those of each the part of ``setting`` that it can have."""
    network, plan_network = lifetimes.network, lifetimes.plan_network
    # written by components it has the same arcs first, then those within lifetimes, then copies
    whole_arcs = network.arcs if like is None else network.arcs[: like.arcs.shape[1]]
    arcs = np.array([[plan_network.arc_index[id_] for id_ in plan_network.components_of(k.id)] for k in whole_arcs])
    arcs = arcs.astype(np.intp).reshape(-1, 1 + len(network.substances)).T
    if like is not None:
        content, stocks, grade = like.content, like.stocks, like.grade
    else:
        shares, by_share = np.ones((2, *arcs.shape)), [arc.law is Law.SHARE for arc in whole_arcs]
        shares[0][:, by_share] = setting[0].min(axis=0)[arcs[:, by_share]]
        shares[1][:, by_share] = setting[2].max(axis=0)[arcs[:, by_share]]
        content, stocks = content_ranges(network, shares, present)
        grade = source_grades(network, network.arcs)
    scheduled = np.flatnonzero([LAWS[arc.law].is_scheduled for arc in whole_arcs])
    orders = (setting * valve[:, :, plan_network.donors] * base)[::2][:, :, arcs[0, scheduled]]
    parts = content.transpose(1, 0, 2)[:, :, scheduled]
    for (low, high), of_component, part in zip(parts, arcs[:, scheduled], grade[..., scheduled], strict=True):
        ranges = np.stack([low, (low + high) / 2, high])[:, None]
        setting[:, :, of_component] *= np.where(np.isnan(part), ranges, part)
    return Mixtures(arcs, content, grade, stocks, scheduled, orders)


def _sets_transfer(arc: Arc) -> bool:
    return arc.control is not None and arc.control.kind is ControlKind.TRANSFER


def control_range(network: Network, compartment: Compartment, agents: Sequence[str]) -> Floats:
    """Return the lowest, neutral and highest value of a control, shape (3, steps)."""
    bounds = network.control_bounds[:, network.control_rows[compartment.id].start]
    # what is supplied while nobody acts depends on the state: all that may be is allowed
    supplies = isinstance(compartment, Arc) and bool(compartment.makes_up_for)
    return bounds if network.original(compartment.id) in agents or supplies else bounds[[1, 1, 1]]


def setter(network: Network, arc: Arc) -> Arc | Node | None:
    """Return the compartment whose control is the arc's own factor; the valve of its donor is none."""
    donor = network.nodes[network.node_index[arc.donor]]
    if arc.law is Law.CONTROLLED and donor.control is not None and donor.control.kind is ControlKind.FLOW:
        return donor
    return arc if arc.control is not None and not _sets_transfer(arc) else None


def _exclusions(network: Network) -> Iterator[str]:
    """Yield why the theorem does not hold for the flows of ``network``."""
    if network.episode.solver != "exact":
        yield f"solver '{network.episode.solver}' is not exact within a control interval"
    models = [c.id for c in network.compartments.values() if c.model is not None]
    if models:
        yield f"{models} have inner physics"
    batches = [arc.id for arc in network.arcs if arc.law is Law.BATCH]
    if batches:
        yield f"{batches} move batches"
    if network.disturbed:
        names = ", ".join(network.processes.names)
        yield f"nobody foresees what disturbs it ({names}); bound(…, uncertain=True) is of what to expect"


def normalised_actions(
    admissible: Admissible, layout: Layout, plan: Floats, initial: Floats, intervals: range | None = None
) -> Floats:
    """Return the actions whose constant factors give the planned mean flows at the planned mean stocks.

    v = Z̄/X̄ where a node has several outflows, else the most that its outflow or orders ask with their own controls
    neutral; then w_k = f̄_k/(a_k·v·X̄_p) and u_k = f̄_k/v, each clipped to its range. A share is such a w_k, of what is
    released. A stretch is what leaves the planned stock at the end of the interval, of a single stage it is 1/v.

    Args:
        admissible: ranges of the factors.
        layout: of the variables.
        plan: variables of each interval, shape (steps, size).
        initial: stocks of the simulator at the start, shape (stocks,), mass.
        intervals: of the episode, whose first were planned; None is all of them.

    Returns:
        Actions in [−1, 1], in the order of ``MultiAgentVectorEnv.stack``, shape (steps, entries).
    """
    network, first = admissible.network, 0 if intervals is None else intervals.start
    period = slice(first, first + len(plan))
    valve_range, base = admissible.valve[:, period], admissible.base[period]
    stock, flow, through = layout.means(plan)
    neutral, valve = admissible.neutral_setting[period], admissible.neutral_valve[period].copy()
    is_driven = admissible.by_schedule | (admissible.driver == network.donors)
    movable = np.setdiff1d(np.flatnonzero((valve_range[0] < valve_range[1]).any(axis=0)), layout.valves)
    for donor in np.intersect1d(movable, network.donors[is_driven]).tolist():
        outflows = np.flatnonzero(is_driven & (network.donors == donor))
        drivers = np.where(admissible.by_schedule[outflows], 1.0, stock[:, [donor]])
        unit = base[:, outflows] * neutral[:, outflows] * drivers
        asked = _ratio(flow[:, outflows], unit, np.repeat(valve[:, [donor]], len(outflows), axis=1))
        valve[:, donor] = asked.max(axis=1)
    for z, node in enumerate(layout.valves):
        valve[:, node] = _ratio(through[:, z], stock[:, node], valve[:, node])
    # what is left of f̄_k after the valve is the arc's own factor, w_k = f̄_k/(a_k·v·X̄_p)
    valve = np.clip(valve, *valve_range)
    driver = np.where(admissible.by_schedule, 1.0, stock[:, admissible.driver])
    setting = np.clip(_ratio(flow, base * driver * valve[:, network.donors], neutral), *admissible.setting[:, period])
    setting[:, [*network.orders]] = flow[:, [*network.orders]]
    if (mixtures := admissible.mixtures) is not None:
        first, *others = mixtures.arcs[:, mixtures.scheduled]
        setting[:, first] += sum(setting[:, arcs] for arcs in others)
    actuators, steps = admissible.actuators, np.arange(period.start, period.stop)
    stretches = admissible.lifetimes.planned_stretches(layout, plan, initial, range(period.start, period.stop))
    actions = np.zeros((len(steps), len(actuators.control_rows)))
    for agent, entries in actuators.entries.items():
        control = network.compartments[agent].control
        assert control is not None
        if agent in network.arc_index:
            # of a transfer that of the first of its substances
            id_ = copy_id(agent, control.substances[0]) if control.kind is ControlKind.TRANSFER else agent
            physical = setting[:, network.arc_index[id_]]
        elif control.kind is ControlKind.RATE:
            physical = valve[:, network.node_index[agent]]
        elif control.kind is ControlKind.STRETCH:
            node = network.node_index[agent]
            physical = stretches[agent] if agent in stretches else 1.0 / valve[:, node]
        else:
            outflows = np.flatnonzero(network.donors == network.node_index[agent])
            physical = setting[:, next(k for k in outflows if network.arcs[k].law is Law.CONTROLLED)]
        actions[:, entries] = actuators.normalise(agent, physical[None], steps).T
    return actions


def _ratio(amount: Floats, unit: Floats, fallback: Floats) -> Floats:
    return np.divide(amount, unit, out=fallback.copy(), where=unit > 1e-12 * np.abs(amount))
