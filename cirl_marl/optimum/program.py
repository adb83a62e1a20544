"""The linear program that relaxes an episode: its variables, matrices and bounds (docs/bound.md).

Every piece is tested with the Bernstein polynomials B_0 … B_d of degree d: X_i and F_i are the means of stocks and
flows weighted with B_i. Integration by parts and the flow laws hold for them exactly, whatever the controls do.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy import sparse

from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.network import Floats, Integers
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.constraints import (
    balances,
    constant_schedules,
    delivery_limits,
    flow_laws,
    held_controls,
    idle_supplies,
    throughputs,
    valve_envelopes,
)
from cirl_marl.optimum.matrices import ChainedRows, Layout, ProgramRows
from cirl_marl.optimum.quasi_steady import decay_rows, end_laws, has_fast_stocks, quasi_steady_rows
from cirl_marl.optimum.reach import ComparisonSystem, DelayLine, Reach
from cirl_marl.optimum.vintages import Lifetimes

LARGE = 30_000
"""Variables beyond which the substeps of an interval are merged, into one piece or, from degree 3 on, d − 1."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LinearProgram:
    """Minimise cᵀv subject to A v = b, G v ≤ g, l ≤ v ≤ u.

    Attributes:
        cost: c.
        equal: A, sparse.
        equal_to: b.
        under: G, sparse.
        under_to: g.
        low: l.
        high: u.
    """

    cost: Floats
    equal: Any
    equal_to: Floats
    under: Any
    under_to: Floats
    low: Floats
    high: Floats


@dataclass(frozen=True, slots=True, kw_only=True)
class Program(LinearProgram):
    """The program of an episode, or a part of it, with finite bounds l and u; v has shape (steps · layout.size,).

    Attributes:
        layout: what v is.
        constant: what no plan changes; the objective to maximise is −cᵀv + ``constant``.
    """

    layout: Layout
    constant: float

    def interval_of_rows(self, matrix: Any) -> Integers:
        """Return the last interval whose variables each row of A or G is about, shape (rows,)."""
        return np.maximum.reduceat(matrix.indices, matrix.indptr[:-1]) // self.layout.size


class Programs:
    """The programs of a network for every start, demanded service and part of an episode.

    Attributes:
        admissible: ranges of the flows.
        layout: of the variables of an interval.
    """

    def __init__(
        self,
        admissible: Admissible,
        degree: int,
        service_weight: float | None,
        *,
        hold_controls: bool = False,
        merge_pieces: bool | None = None,
    ) -> None:
        """Write down what does not depend on the start.

        Args:
            admissible: ranges of the flows.
            degree: d of the test polynomials.
            service_weight: w of λ̄/circularity_scale + w·service; None if λ̄ is maximised.
            hold_controls: whether controls are constant within an interval to first order; the program then makes
                better plans and bounds nothing.
            merge_pieces: whether an interval has fewer pieces than the simulator has substeps; None: if the program
                were large otherwise.
        """
        self.admissible = admissible
        lifetimes = admissible.lifetimes
        living = lifetimes.planned is not lifetimes.reached
        self._system = ComparisonSystem(Admissible.of(lifetimes.reached, admissible.agents) if living else admissible)
        self.layout = layout = _layout(admissible, self._system.substeps, merge_pieces, degree)
        fading = ComparisonSystem(admissible) if living and layout.merged else self._system
        self._equal, self._under = ChainedRows(layout), ChainedRows(layout)
        for kind in np.unique(admissible.kinds).tolist():
            linked_equal, equal, linked_under, under = (ProgramRows(layout) for _ in range(4))
            balances(layout, linked_equal)
            constant_schedules(admissible, layout, equal, under)
            flow_laws(admissible, layout, kind, equal, under)
            throughputs(admissible, layout, kind, equal)
            if hold_controls:
                held_controls(admissible, layout, kind, equal)
            delivery_limits(admissible, layout, kind, linked_under)
            decay_rows(admissible, layout, kind, linked_under)
            if layout.merged:
                end_laws(admissible, layout, kind, equal, under)
                quasi_steady_rows(admissible, layout, kind, fading.of_kind(kind), linked_under)
            measures(layout, admissible.served[kind], under)
            self._equal.add(kind, linked_equal, equal)
            self._under.add(kind, linked_under, under)
        self._weights, self._constant = objective(layout, service_weight)

    def at_start(self, interval: int) -> tuple[Any, Any]:
        """Return what the linked rows of A and of G have of the stocks at the start of an interval, (rows, stores)."""
        kind = int(self.admissible.kinds[interval])
        return self._equal.at_start(kind), self._under.at_start(kind)

    def program(self, initial: Floats, min_service: ArrayLike | None = None, intervals: range | None = None) -> Program:
        """Return the program from ``initial`` that gives each service the mean level demanded of it.

        Args:
            initial: stocks at the start, those with a lifetime by stage, as the simulator has them, mass.
            min_service: least mean level of every service, or of each, shape (services,), to which the last rows of G
                hold it; None if nothing is demanded.
            intervals: of the episode, one after the other; None is all of them.

        Raises:
            NoCertificate: if recipients may pull more from a node than it holds.
        """
        layout, network = self.layout, self.admissible.network
        when = range(network.episode.horizon) if intervals is None else intervals
        steps, kinds, lifetimes = len(when), self.admissible.kinds[when.start : when.stop], self.admissible.lifetimes
        reached, leaving = _reached(lifetimes, self._system, initial, when)
        asked = self.admissible.factor[1] * self.admissible.base
        cut = np.where(self.admissible.scheduled & ~reached.uncut, asked[when.start : when.stop], 0.0)
        start = lifetimes.start_planned @ initial
        equal, equal_to = self._equal.over(kinds, start, cut)
        under, under_to = self._under.over(kinds, start, cut)
        opened, opened_to = valve_envelopes(self.admissible, reached, layout, when)
        supplied, supplied_to = idle_supplies(self.admissible, reached, layout, when)
        lived, lived_to = lifetimes.rows(layout, initial, when)
        blocks, limits = [under, opened, supplied, lived], [under_to, opened_to, supplied_to, lived_to]
        if min_service is not None:
            services = len(network.services)
            levels = sparse.eye_array(services, layout.size, k=layout.level)
            blocks.append(sparse.kron(np.full((1, steps), -1.0 / steps), levels, format="csr"))
            limits.append(-np.broadcast_to(min_service, services))
        low, high = _box(self.admissible, reached, leaving, layout, when)
        return Program(
            layout=layout,
            cost=np.tile(-self._weights / steps, steps),
            constant=self._constant,
            equal=equal,
            equal_to=equal_to,
            under=sparse.vstack(blocks, format="csr"),
            under_to=np.concatenate(limits),
            low=low,
            high=high,
        )


def _reached(lifetimes: Lifetimes, system: ComparisonSystem, initial: Floats, intervals: range) -> tuple[Reach, Floats]:
    """Return what the planned network can reach, and the most that leaves lifetimes, shape (steps, lifetimes)."""
    delayed = [
        DelayLine(each.reached_arc, each.reached_node, each.slots(initial), lifetimes.network.episode.control_interval)
        for each in lifetimes.lived
        if not len(each.rate)
    ]
    slots = {each.arc: each for each in delayed}
    found = system.reach(lifetimes.start_reached @ initial, intervals, delayed)
    most = [
        each.rate[intervals.start : intervals.stop] * found.upper[:, each.reached_node]
        + each.at_once * found.upper[:, each.reached_entry]
        if len(each.rate)
        else np.array([slots[each.reached_arc].most(t, found.entered) for t in range(len(intervals))])
        for each in lifetimes.lived
    ]
    upper = found.upper @ lifetimes.nodes_reached.T
    leaving = np.array(most).reshape(len(most), len(intervals)).T
    return Reach(upper, found.uncut[:, lifetimes.arcs_reached], found.entered), leaving


def _layout(admissible: Admissible, substeps: int, merged: bool | None, degree: int) -> Layout:
    network = admissible.network
    nodes = len(network.nodes)
    pieces = admissible.lifetimes.pieces(degree, substeps) if admissible.lifetimes.lived else substeps
    exits = np.bincount(network.donors[admissible.driver == network.donors], minlength=nodes)
    constant_schedules = np.bincount(network.donors[admissible.scheduled], minlength=nodes)
    movable = (admissible.valve[0] < admissible.valve[1]).any(axis=0)
    valve_envelopes = np.flatnonzero(movable & (exits > 0) & (constant_schedules > 0))
    valves = np.flatnonzero(movable & ((exits > 1) | (exits > 0) & (constant_schedules > 0)))
    fine = Layout(network, pieces, pieces < substeps, False, degree, valves, valve_envelopes)
    few = max(1, degree - 1)
    if pieces > few and (fine.size * network.episode.horizon > LARGE if merged is None else merged):
        coarse = replace(fine, pieces=few, coarse=True)
        return replace(coarse, merged=True) if merged or has_fast_stocks(admissible, coarse.length) else coarse
    return fine


def _box(
    admissible: Admissible, reached: Reach, leaving: Floats, layout: Layout, intervals: range
) -> tuple[Floats, Floats]:
    """Return the lowest and highest value of every variable; all are finite, which makes every multiplier a bound."""
    network = admissible.network
    low, high = np.zeros((2, len(intervals), layout.size))
    scheduled = admissible.scheduled
    during = slice(intervals.start, intervals.stop)
    rates, valve = (admissible.factor * admissible.base)[:, during], admissible.valve[:, during]
    # no weighted mean exceeds the supremum: F ≤ r̄·x̄_p, and U ≤ ū; U ≥ u̲ only where nothing is ever cut
    most = rates[1] * np.where(scheduled, 1.0, reached.upper[:, admissible.driver])
    least = np.where(scheduled & reached.uncut, rates[0], 0.0)
    most[:, admissible.lifetimes.leaving] = leaving
    for i in layout.moments:
        high[:, layout.stock(i) : layout.flow(i)] = reached.upper
        high[:, layout.flow(i) : layout.valve(i)] = most
        low[:, layout.flow(i) : layout.valve(i)] = least
        high[:, layout.valve(i) :][:, : len(layout.valves)] = (reached.upper * valve[1])[:, layout.valves]
    for piece in range(layout.pieces):
        last = layout.end(piece)
        high[:, last : last + len(network.stores)] = reached.upper[:, : len(network.stores)]
        if layout.merged:
            high[:, last : last + len(network.nodes)] = reached.upper
            high[:, layout.end_flow(piece) :][:, : len(network.arcs)] = most
            low[:, layout.end_flow(piece) :][:, : len(network.arcs)] = least
    high[:, layout.level : layout.imbalance] = 1.0
    weights = network.objective.reference_interval * np.abs(network.sustainability * network.environmental)
    high[:, layout.imbalance] = most @ weights
    low[:, layout.opening :], high[:, layout.opening :] = valve[:, :, layout.openings]
    return low.ravel(), high.ravel()


def measures(layout: Layout, low: Floats, rows: ProgramRows) -> None:
    """Add low·level − q ≤ 0 for each service and ±Δ·σ_env·f̄ − imbalance ≤ 0; their keys are (1, …).

    The level is at most min(1, q/low): a finite upper end of the band could only lower it further.
    """
    network, count = layout.network, len(layout.moments)
    for s, service in enumerate(network.services):
        row = rows.add(1, s)
        rows.put(row, layout.level + s, low[s])  # level ≤ q/low; level ≤ 1 is a box
        if service.quantity == "stock":
            stages = network.stages if isinstance(network, StagedNetwork) else {}
            for store in (store for each in service.providers for store in stages.get(each, (each,))):
                rows.put(row, layout.end(-1) + network.node_index[store], -1.0)
        else:
            rows.put(row, layout.flow(layout.moment_column) + network.service_arcs(service), -1.0 / count)
    weights = -network.circularity_weights[1]
    counted = np.flatnonzero(weights)
    row = rows.add(1, len(network.services), [0, 1])
    for each, sign in zip(row, (1.0, -1.0), strict=True):
        rows.put(each, layout.flow(layout.moment_column) + counted, sign * weights[counted] / count)
    rows.put(row, layout.imbalance, -1.0)


def circularity_weights(layout: Layout) -> Floats:
    """Return the weights of the mean of λ over an interval on its variables, shape (size,), mass."""
    network = layout.network
    weights = np.zeros(layout.size)
    counted = network.circularity_weights.sum(axis=0)
    if network.objective.net_zero == "abs":
        counted = network.circularity_weights[0]
        weights[layout.imbalance] = -1.0
    for i in layout.moments:
        weights[layout.flow(i) : layout.valve(i)] = counted / len(layout.moments)
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
