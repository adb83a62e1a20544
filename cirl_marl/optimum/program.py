"""The linear program that relaxes an episode: its variables, matrices and bounds (docs/bound.md).

Every piece is tested with the Bernstein polynomials B_0 … B_d of degree d: X_i and F_i are the means of stocks and
flows weighted with B_i. Integration by parts and the flow laws hold for them exactly, whatever the controls do.
"""

from __future__ import annotations

import math
from functools import partial
from typing import Annotated, Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import frozen_record
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.aims import Aims, account_rows, over
from cirl_marl.optimum.constraints import (
    balances,
    capacity_limits,
    constant_schedules,
    delivery_limits,
    flow_laws,
    held_controls,
    idle_supplies,
    late_deliveries,
    least_deliveries,
    mean_stocks,
    order_rows,
    service_levels,
    throughputs,
    valve_envelopes,
)
from cirl_marl.optimum.content_ranges import check_contents
from cirl_marl.optimum.decay import decay_rows
from cirl_marl.optimum.effort import charged_controls, effort_rows, largest_distances
from cirl_marl.optimum.excess import excess_rows
from cirl_marl.optimum.histories import History
from cirl_marl.optimum.matrices import BEFORE, NOW, ChainedRows, IntervalCache, Layout, ProgramRows, RowParts
from cirl_marl.optimum.mixtures import content_rows, mixture_rows
from cirl_marl.optimum.quasi_steady import end_laws, has_fast_stocks, quasi_steady_rows
from cirl_marl.optimum.reach import ComparisonSystem, Reach
from cirl_marl.optimum.responses import response_rows
from cirl_marl.optimum.shortages import shortage_rows
from cirl_marl.optimum.transit import ConstantShares, Transit, steady_rows
from cirl_marl.optimum.vintages import Lifetimes

LARGE, MERGED = 30_000, 1 / 3
"""Variables beyond which the substeps of an interval are merged, into so few pieces that there are that part of these.

Interior points need 5 s for 13 500 variables of a generated cycle, 104 s for 33 264 (seed 40, degrees 2 and 3).
There is at least one piece, or from degree 3 on d − 1. If there are more variables even so, theorem 6 is not used.
"""
LARGE_KERNELS = 1_000_000
"""Entries of the rows of lifetimes, which grow with the square of the pieces, beyond which there are only so many."""


@frozen_record
class LinearProgram:
    """Minimise cᵀv subject to A v = b, G v ≤ g, l ≤ v ≤ u."""

    cost: Annotated[Floats, "c"]
    equal: Annotated[Any, "A, sparse"]
    equal_to: Annotated[Floats, "b"]
    under: Annotated[Any, "G, sparse"]
    under_to: Annotated[Floats, "g"]
    low: Annotated[Floats, "l"]
    high: Annotated[Floats, "u"]


@frozen_record
class Program(LinearProgram):
    """The program of an episode, or a part of it, with finite bounds l and u; v has shape (steps · layout.size,)."""

    layout: Annotated[Layout, "what v is"]
    constant: Annotated[float, "what no plan changes; the objective to maximise is −cᵀv + ``constant``"]
    system: Annotated[ComparisonSystem, "which bounds stocks; other programs of the network may have it too"]
    histories: Annotated[tuple[tuple[int, History], ...], "rows of G over all that entered, and the first of them"]

    def interval_of_rows(self, matrix: Any) -> Integers:
        """Return the last interval whose variables each row of A or G is about, shape (rows,)."""
        return np.maximum.reduceat(matrix.indices, matrix.indptr[:-1]) // self.layout.size


class Programs:
    """The programs of a network for every start, demanded service and part of an episode.

    Attributes:
        admissible: ranges of the flows.
        layout: of the variables of an interval.
        system: which bounds the stocks.
        steady_parts: whether what is constant of flows that may vary has variables, and stocks rows of responses.
    """

    def __init__(
        self,
        admissible: Admissible,
        degree: int,
        service_weight: float | None,
        *,
        merge_pieces: bool | None = None,
        large: int | None = None,
        loose: float | None = None,
        constant_shares: bool = True,
        steady_parts: bool = False,
        system: ComparisonSystem | None = None,
        intervals: range | None = None,
        layout: Layout | None = None,
        cache: IntervalCache | None = None,
    ) -> None:
        """Write down what does not depend on the start.

        Args:
            admissible: ranges of the flows.
            degree: d of the test polynomials. With 0 stocks and flows are plain means, of inflows that are even within
                pieces and controls that are constant in an interval to first order: the program makes better plans and
                bounds nothing.
            service_weight: w of λ̄/circularity_scale + w·service; None if λ̄ is maximised.
            merge_pieces: whether an interval has fewer pieces than the simulator has substeps; None: if the program
                were large otherwise.
            large: variables beyond which it is; None: ``LARGE``.
            loose: how far bounds of what leaves lifetimes may be apart (``Lifetimes.pieces``).
            constant_shares: whether shares of what passes nodes without stock are constant within an interval, unless
                the degree is 0, the program large or its layout given.
            steady_parts: whether what is constant of flows that may vary has variables for these, and stocks have rows
                of what they hold of what enters: tighter, and slower.
            system: of a program of the same network and agents, whatever their services demand.
            intervals: that programs will be of; None: of all.
            layout: of another program of the network, whatever its numbers; None: what its own ask for.
            cache: of programs of other numbers in the same network, with the same agents.
        """
        self.admissible, self.steady_parts, lifetimes = admissible, steady_parts, admissible.lifetimes
        has_lifetimes = lifetimes.plan_network is not lifetimes.reach_network
        if system is None:
            chain_form = admissible
            if has_lifetimes:
                chain_form = Admissible.of(lifetimes.reach_network, admissible.agents, admissible.mixtures)
            system = ComparisonSystem(chain_form, cache)
        self.system = system
        constant_shares = constant_shares and degree > 0 and layout is None
        self._transit: Transit | None = None
        self._ledger = Ledger(lifetimes.network)
        excesses = len(self._ledger.excesses)
        self.layout = layout = layout or _layout(
            admissible, system.substeps, merge_pieces, degree, large, excesses, loose
        )
        if constant_shares and layout.size * len(admissible.kinds) <= LARGE:
            transit = Transit(admissible, system.substeps, steady_parts=steady_parts)
            if len(transit.splits):
                arcs = np.union1d(transit.arcs, transit.partly_steady)
                self._transit, self.layout = transit, layout.with_constant_parts(transit.nodes, arcs)
                layout = self.layout
        needs_own = has_lifetimes and (layout.has_end_flows or self._transit is not None)
        own_system = ComparisonSystem(admissible, cache) if needs_own else system
        self._equal, self._under = ChainedRows(layout), ChainedRows(layout)
        period = slice(None) if intervals is None else slice(intervals.start, intervals.stop)
        for kind in np.unique(admissible.kinds[period]).tolist():
            rows = partial(self._interval_rows, kind, own_system)
            if cache is None:
                equal_links, equal, under_links, under = rows()
            else:
                key = ("rows", layout.key, steady_parts, admissible.key(kind))
                equal_links, equal, under_links, (now, before, looser) = cache.value(key, rows)
                under = layout.with_levels(now, admissible.service_low[kind]), before, looser
            self._equal.add(kind, equal_links, equal)
            self._under.add(kind, under_links, under)
        self._weights, self._constant = objective(layout, service_weight)

    def _interval_rows(self, kind: int, own_system: ComparisonSystem) -> tuple[RowParts, RowParts, RowParts, RowParts]:
        """Return the rows of A of a kind of interval that link it to the one before, the others, and those of G."""
        layout, ranges = self.layout, self.admissible.ranges[kind]
        equal_links, equal, under_links, under = (ProgramRows(layout) for _ in range(4))
        balances(equal_links)
        constant_schedules(ranges, equal, under, across=self._transit is not None)
        if layout.coarse and self.admissible.mixtures is None:
            late_deliveries(ranges, under)
        flow_laws(ranges, equal, under)
        throughputs(ranges, equal)
        delivery_limits(ranges, under_links)
        capacity_limits(ranges, under_links)
        service_levels(ranges, under)
        if layout.degree:
            decay_rows(ranges, under_links)
            if self.steady_parts:
                response_rows(ranges, under_links)
        else:
            mean_stocks(ranges, equal_links)
            held_arcs = np.flatnonzero(ranges.proportional & (ranges.rate[0] < ranges.rate[1]))
            held_controls(ranges.driver, held_arcs, ranges.neutral_rate[None], ranges.neutral_valve[None], equal)
        if layout.has_end_flows:
            end_laws(ranges, equal, under)
            quasi_steady_rows(ranges, own_system.of_interval(kind), under_links)
        if self._transit is not None:
            steady_rows(self._transit, ranges, equal, under)
            ConstantShares(self._transit, ranges, own_system.of_interval(kind), under_links).write()
        links = equal_links.matrices(), under_links.matrices()
        for matrices in links:
            for part in (NOW, BEFORE):
                matrices[part].eliminate_zeros()
        return links[0], equal.matrices(), links[1], under.matrices()

    def rows_at_start(self, interval: int) -> tuple[Any, Any]:
        """Return what the linked rows of A and of G have of the stocks at the start of an interval, (rows, stores)."""
        kind = int(self.admissible.kinds[interval])
        return self._equal.at_start(kind), self._under.at_start(kind)

    def program(
        self,
        initial: Floats,
        min_service: ArrayLike | None = None,
        intervals: range | None = None,
        aims: Aims | None = None,
    ) -> Program:
        """Return the program from ``initial`` that gives each service the mean level demanded of it.

        Args:
            initial: stocks at the start, those with a lifetime by stage, as the simulator has them, mass.
            min_service: least mean level of every service, or of each, shape (services,), to which the last rows of G
                hold it; None if nothing is demanded.
            intervals: of the episode, one after the other; None is all of them.
            aims: what is weighed in place of the objective, and budgets, whose rows come before those of services;
                None: neither.

        Raises:
            NoCertificate: if recipients may pull more from a node than it holds.
            CirlError: for contents that the network never has.
        """
        layout, admissible, network = self.layout, self.admissible, self.admissible.network
        intervals = range(network.episode.horizon) if intervals is None else intervals
        steps, period, lifetimes = len(intervals), slice(intervals.start, intervals.stop), admissible.lifetimes
        if admissible.mixtures is not None:
            check_contents(lifetimes.network, admissible.mixtures, lifetimes.state_layout, initial)
        reach, lifetime_flow = possible_range(lifetimes, self.system, initial, intervals)
        changes, mixtures = ~reach.uncut, admissible.mixtures
        if mixtures is not None:
            changes[:, mixtures.arcs[:, mixtures.varies & ~mixtures.has_grade].ravel()] = True  # as if they were cut
        cut = np.where(admissible.by_schedule & changes, admissible.rate[1, period], 0.0)
        start, kinds = lifetimes.start_planned @ initial, admissible.kinds[period]
        equal, equal_to = self._equal.over(kinds, start, cut)
        under, under_to = self._under.over(kinds, start, cut)
        rows = ProgramRows(layout, steps)
        valve_envelopes(admissible, reach, intervals, rows)
        idle_supplies(admissible, reach, intervals, rows)
        shortage_rows(admissible, self.system, reach, initial, intervals, rows)
        least_deliveries(admissible, reach, intervals, rows)
        order_rows(admissible, reach, intervals, rows)
        low, high = _box(admissible, reach, lifetime_flow, layout, period)
        if mixtures is not None:
            mixture_rows(admissible, reach, intervals, rows)
            content_rows(admissible, high.reshape(steps, -1), intervals, rows)
        effort_rows(admissible, reach, intervals, rows)
        excess_rows(lifetimes, self._ledger, initial, high.reshape(steps, -1), rows)
        from_start = rows.matrices()[0]
        from_start.eliminate_zeros()
        of_lifetimes, lifetime_limits = lifetimes.rows(layout, initial, intervals)
        blocks, limits, histories = [under, from_start], [under_to, rows.limits(), lifetime_limits], []
        for block in of_lifetimes:
            if isinstance(block, History):
                histories.append((sum(part.shape[0] for part in blocks), block))
            blocks.append(block.matrix if isinstance(block, History) else block)
        cost, constant = np.tile(-self._weights / steps, steps), self._constant
        if aims is not None and not aims.is_circular:
            rates = over(self._ledger.rates(), intervals)
            totals, beside = account_rows(lifetimes, layout, initial, rates)
            cost, constant = -aims.objective(-cost, totals.toarray()), float(aims.objective(constant, beside))
            for service, weight in aims.levels.items():
                cost[layout.level + service :: layout.size] -= weight / steps
        if aims is not None and aims.budgets:
            rates = over(aims.rates(lifetimes.network), intervals)
            totals, beside = account_rows(lifetimes, layout, initial, rates)
            blocks.append(totals)
            limits.append(aims.limits - beside)
        if min_service is not None:
            services = len(network.services)
            levels = sparse.eye_array(services, layout.size, k=layout.level)
            blocks.append(sparse.kron(np.full((1, steps), -1.0 / steps), levels, format="csr"))
            limits.append(-np.broadcast_to(min_service, services))
        return Program(
            layout=layout,
            cost=cost,
            constant=constant,
            system=self.system,
            equal=equal,
            equal_to=equal_to,
            under=sparse.vstack(blocks, format="csr"),
            under_to=np.concatenate(limits),
            low=low,
            high=high,
            histories=tuple(histories),
        )


def possible_range(
    lifetimes: Lifetimes, system: ComparisonSystem, initial: Floats, intervals: range
) -> tuple[Reach, Floats]:
    """Return what the planned network can reach, and the most that leaves lifetimes, shape (steps, lifetimes)."""
    interval, steps = lifetimes.network.episode.control_interval, range(len(intervals))
    lines = [(whole, whole.slots(initial)) for whole in lifetimes.whole if not len(whole.rate)]
    reach = system.reach(lifetimes.start_reached @ initial, intervals, lines)
    period = slice(intervals.start, intervals.stop)
    most = [
        whole.rate[period] * factor * reach.upper[:, whole.reached_node]
        + whole.chain.weights[0] * reach.upper[:, whole.reached_entry]
        if len(whole.rate)
        else np.array([whole.most_out(whole.slots(initial), t, reach.inflow) for t in steps]) / interval
        for whole, factor in zip(lifetimes.whole, lifetimes.most_factor[period].T, strict=True)
    ]
    upper = reach.upper @ lifetimes.nodes_reached.T
    lifetime_flow = np.array(most).reshape(len(most), len(steps)).T
    return Reach(
        upper, reach.delivered[:, lifetimes.arcs_reached], reach.inflow, reach.chord[:, lifetimes.arcs_reached]
    ), lifetime_flow


def fewest_pieces(degree: int) -> int:
    """Return how few pieces of an interval are left, however many are merged."""
    return max(degree - 1, 1)


def _layout(
    admissible: Admissible,
    substeps: int,
    merge_pieces: bool | None,
    degree: int,
    large: int | None = None,
    excesses: int = 0,
    loose: float | None = None,
) -> Layout:
    network, nodes = admissible.network, len(admissible.network.nodes)
    pieces = admissible.lifetimes.pieces(degree, substeps, loose) if admissible.lifetimes.whole else substeps
    exits = np.bincount(network.donors[admissible.driver == network.donors], minlength=nodes)
    schedules = np.bincount(network.donors[admissible.by_schedule], minlength=nodes)
    movable = (admissible.valve[0] < admissible.valve[1]).any(axis=0)
    valves = np.flatnonzero(movable & ((exits > 1) | (exits > 0) & (schedules > 0)))
    free_valves = np.flatnonzero(movable & (exits > 0) & (schedules > 0))
    make = partial(Layout, network, charged_controls=charged_controls(admissible), excesses=excesses)
    fine = make(pieces, degree, valves, free_valves, coarse=pieces < substeps)
    variables, entries = fine.size * network.episode.horizon, admissible.lifetimes.entries(fine)
    fewer, large = 0.0 if merge_pieces else float(pieces), LARGE if large is None else large
    if merge_pieces is None and variables > large:
        fewer *= MERGED * large / variables
    if merge_pieces is None and entries > LARGE_KERNELS:
        fewer = min(fewer, pieces * math.sqrt(LARGE_KERNELS / entries))
    fewer_pieces = max(int(fewer), fewest_pieces(degree))
    if pieces <= fewer_pieces:
        return fine
    length = network.episode.control_interval / fewer_pieces
    has_end_flows = degree > 0 and (bool(merge_pieces) or has_fast_stocks(admissible, length))
    return make(fewer_pieces, degree, valves, free_valves, coarse=True, has_end_flows=has_end_flows)


def _box(
    admissible: Admissible, reach: Reach, lifetime_flow: Floats, layout: Layout, period: slice
) -> tuple[Floats, Floats]:
    """Return the lowest and highest value of every variable; all are finite, which makes every multiplier a bound."""
    network, by_schedule = admissible.network, admissible.by_schedule
    stores, nodes, arcs = len(network.stores), len(network.nodes), len(network.arcs)
    low, high = np.zeros((2, len(reach.upper), layout.size))
    rate, valve = admissible.rate[:, period], admissible.valve[:, period]
    # no weighted mean exceeds the supremum: F ≤ r̄·x̄_p, and U ≤ ū; of u̲ that much is delivered
    most = rate[1] * np.where(by_schedule, 1.0, reach.upper[:, admissible.driver])
    least = np.where(by_schedule, rate[0] * reach.delivered, 0.0)
    most[:, admissible.lifetimes.exit_arcs] = lifetime_flow
    for stock, flow, through in zip(layout.stock, layout.flow, layout.valve, strict=True):
        high[:, stock:flow] = reach.upper
        high[:, flow:through], low[:, flow:through] = most, least
        high[:, through:][:, : len(layout.valves)] = (reach.upper * valve[1])[:, layout.valves]
    for end, end_flow in zip(layout.end, layout.end_flow, strict=True):
        high[:, end : end + stores] = reach.upper[:, :stores]
        if layout.has_end_flows:
            high[:, end : end + nodes] = reach.upper
            high[:, end_flow : end_flow + arcs], low[:, end_flow : end_flow + arcs] = most, least
    steady = [reach.upper[:, layout.steady_nodes], most[:, layout.steady_arcs]]
    high[:, layout.steady : layout.level] = np.concatenate(steady, axis=1)
    high[:, layout.level : layout.imbalance] = 1.0
    weights = network.objective.reference_interval * np.abs(network.sustainability * network.environmental)
    high[:, layout.imbalance] = most @ weights
    free_valves = slice(layout.free_valve, layout.effort)
    low[:, free_valves], high[:, free_valves] = valve[:, :, layout.free_valves]
    high[:, layout.effort : layout.excess] = largest_distances(admissible, layout.charged_controls)[period]
    return low.ravel(), high.ravel()


def circularity_weights(layout: Layout) -> Floats:
    """Return the weights of the mean of λ over an interval on its variables, shape (size,), mass."""
    network = layout.network
    weights = np.zeros(layout.size)
    by_arc = network.circularity_weights.sum(axis=0)
    if network.objective.net_zero == "abs":
        by_arc = network.circularity_weights[0]
        weights[layout.imbalance] = -1.0
    for flow, through in zip(layout.flow, layout.valve, strict=True):
        weights[flow:through] = by_arc / len(layout.moments)
    return weights


def objective(layout: Layout, service_weight: float | None) -> tuple[Floats, float]:
    """Return the weights of the objective on the variables of an interval, and what it has beside them."""
    network = layout.network
    weights, constant = circularity_weights(layout), 0.0
    if service_weight is not None:
        weights = weights / network.objective.circularity_scale
        if network.services:
            weights[layout.level : layout.imbalance] = service_weight / len(network.services)
        else:
            constant = service_weight
    return weights, constant
