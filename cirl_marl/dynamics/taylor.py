"""The exact solver's series: ẋ = S f(x) for constant rates, over one substep."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np

from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.routing import IntervalRoutes, Routing
from cirl_marl.dynamics.static_elimination import SparseRow, contract_hubs, square_matrix
from cirl_marl.dynamics.store_chains import MANY, StoreChains
from cirl_marl.network import Floats, Integers, RowSum
from cirl_marl.network.elements import Law
from cirl_marl.network.rowsum import spans

TRUNCATION = 1e-13
"""Bound on the first neglected term of the series, relative to the mass in the network."""


class Taylor:
    """Sums the Taylor series in Horner form for the mean of the state, ȳ = x + (h/2)·ẋ(x + (h/3)·ẋ(x + …)).

    A node turns over at most its stock in a substep, so the series is free of cancellation; it is cut where the
    neglected term is below ``TRUNCATION``.

    Attributes:
        terms: terms of the series.
        driver: row of ``drivers`` by which each arc flows, shape (arcs,).
        horner: S times the length that counts in each of them, from the innermost.
        pulls: whether a recipient may ask for more than there is.
    """

    def __init__(self, laws: FlowLaws, substep: float) -> None:
        """Find how many terms substeps of this length take."""
        self._laws, self._substep = laws, substep
        self.terms = self._number()
        # Horner from the innermost term: h/K, …, h/3, h/2
        self._factors = [substep / k for k in range(self.terms, 1, -1)]
        self.pulls = any(arc.law is Law.RECIPIENT for arc in laws.staged_network.arcs)
        self.horner = [laws.incidence.scaled_by(factor) for factor in self._factors]
        self._shortcut = KronReduction(laws) if laws.routing.nodes else None
        network, routing, stores = laws.staged_network, laws.routing, laws.rows.nodes.stop
        # throughputs stand below the masses, and drive what leaves nodes without stock
        self.driver = laws.driver.copy()
        self.driver[routing.arcs] = laws.rows.masses + routing.throughput_rows
        self._inflows = np.flatnonzero((network.donors < stores) & (network.recipients >= stores))
        entry_places = routing.places[network.recipients[self._inflows] - stores]
        self._into = RowSum(entry_places, range(len(entry_places)), 1.0, (routing.nodes, len(entry_places)))

    def _number(self) -> int:
        """Smallest K ≥ 2 for which the first neglected term of the mean, ‖|A|^K‖₁·h^K/(K + 1)!, is ≤ TRUNCATION.

        A, entry by entry, is largest in absolute value with every control at its upper bound, so that bound serves all.
        What is split, or enters a node that stores nothing, is taken to go where it drives most.
        """
        laws, stores = self._laws, self._laws.rows.nodes.stop
        donors = laws.staged_network.donors[laws.driven_arcs]
        reach, term, k = np.ones(stores), 1.0, 0
        while term > TRUNCATION or k < 2:
            k += 1
            # one factor |A| of ‖|A|^k‖₁, by its columns: what leaves a stock counts at its donor and at its recipient
            ends = np.append(reach, reach.max(initial=0.0))[laws.driven_to]
            transfers = laws.driven_rate * (reach[donors] + ends) * self._substep
            reach = np.bincount(laws.driver[laws.driven_arcs], weights=transfers, minlength=stores) / (k + 1)
            term = float(reach.max(initial=0.0))
        return k

    def moved_mass(
        self,
        stock: Floats,
        routes: IntervalRoutes | None,
        terms: int | None,
        rate: Floats,
        imposed_flow: Floats | None = None,
    ) -> Floats:
        """Return h·r∘ȳ[driver], ȳ the exact mean of the state over the substep, shape (arcs, B).

        It is rough if not all ``terms`` of the series are to be summed.
        Flows given in ``imposed_flow``, shape (arcs, B), hold whatever the state; NaN where the flow law does.
        """
        if self._shortcut is not None and routes is not None and imposed_flow is None:
            mean = self._shortcut.series(stock, routes, self._factors[-(terms or self.terms) :], rate)
            transfer = self.flow(mean, routes, rate)
        else:
            transfer = self._mean_flow(stock, routes, terms, rate, imposed_flow)
        transfer *= self._substep
        if self.pulls:
            np.maximum(transfer, 0.0, out=transfer)  # the mean of an overdrawn stock may be negative
        return transfer

    def end(self, stock: Floats, routes: IntervalRoutes | None, terms: int, rate: Floats) -> Floats:
        """Return the masses at the substep's end by so many ``terms``, x + h·ẋ(ȳ), shape (masses, B), without flows."""
        if self._shortcut is None or routes is None:
            return self._laws.incidence.add_to(stock.copy(), self.moved_mass(stock, routes, terms, rate))
        return self._shortcut.series(stock, routes, [*self._factors[-terms:], self._substep], rate)

    def flow(self, masses: Floats, routes: IntervalRoutes | None, rate: Floats) -> Floats:
        """Return the flows at ``masses``, those that are passed on too, shape (arcs, B)."""
        if routes is None:
            return self._laws.flow(masses, rate)
        flow: Floats = self.drivers(masses, routes, rate).take(self.driver, 0)
        flow *= rate
        return flow

    def drivers(self, masses: Floats, routes: IntervalRoutes | None, rate: Floats) -> Floats:
        """Return the masses, and below them what passes through nodes without stock: what drives each arc."""
        if routes is None:
            return masses
        inflow = masses.take(self._laws.driver[self._inflows], 0)
        inflow *= rate.take(self._inflows, 0)
        return np.concatenate([masses, self._laws.routing.throughputs(self._into(inflow), routes)])

    def _mean_flow(
        self,
        stock: Floats,
        routes: IntervalRoutes | None,
        terms: int | None,
        rate: Floats,
        imposed_flow: Floats | None,
    ) -> Floats:
        """Return r∘ȳ[driver], with the flows of all arcs in each term."""
        laws, flow, mean = self._laws, np.empty_like(rate), stock.copy()
        for incidence in (*self.horner[-(terms or self.terms) :], None):
            mean.take(laws.driver, axis=0, out=flow, mode="clip")
            flow *= rate
            if imposed_flow is not None:
                np.copyto(flow, imposed_flow, where=~np.isnan(imposed_flow))
            if routes is not None:
                laws.routing.pass_on(flow, routes)
            if incidence is not None:
                mean[...] = stock
                incidence.add_to(mean, flow)
        return flow


class KronReduction:
    """The series of a substep, in networks with nodes that store nothing, without the flows in between.

    Only ẋ matters inside the series. It follows from x in four steps, each over all copies: the flows whose rates
    differ from copy to copy; what of them and of the others comes to stocks and to kept nodes (``routing``), a sum with
    constant weights; the throughputs of the kept nodes; and what of these comes to stocks, with constant weights but
    for the shares that differ. The sums with constant weights go through as few nodes as they can: where the ways past
    one are no more than the ways to it and from it, they lead past it.

    The rows of one array are worked through from the first to the last: masses, flows that differ from copy to copy,
    constant nodes on the way, what enters and what passes the kept nodes as they are eliminated, their throughputs,
    shares of these that differ, constant nodes on the way again, and what masses change by.
    """

    def __init__(self, laws: FlowLaws) -> None:
        """Compile the sums."""
        routing, nodes, masses = laws.routing, laws.routing.nodes, laws.rows.masses
        outer = laws.staged_network.donors < laws.rows.nodes.stop
        place = {i: n for n, i in enumerate(routing.detours.kept_nodes)}
        varying_flows = np.flatnonzero(outer & ~laws.is_fixed)
        donors = routing.donors.tolist()
        varying_exits = [k for k, is_same in enumerate(routing.is_fixed) if donors[k] in place and not is_same]
        self._varying_arcs = routing.arcs[varying_exits]
        kept_nodes, order = routing.detours.kept_nodes, routing.detours.elimination.factors[0]
        # of throughputs, which stand from the last node that is eliminated to the first
        row_of = 2 * len(order) - 1 - np.argsort(order)
        senders = [*range(len(order)), *(place[donors[k]] for k in varying_exits)]
        self._senders: Integers = row_of[np.array(senders, dtype=np.intp)]

        # nodes have the names that they have in ``detours``, and so has what stocks, the first of the masses, get
        mass, flow, share, end = np.cumsum([nodes + masses, masses, len(varying_flows), len(varying_exits)]).tolist()
        rates = laws.rate(laws.neutral[:, :1])[:, 0]
        inflow_rows = _inflow_rows(laws, rates, range(mass, flow), range(flow, share), varying_flows)
        before = contract_hubs(inflow_rows, routing.detours.order)
        drivers, all_flows = laws.driver[varying_flows], range(flow, share)
        self._chains = StoreChains(inflow_rows, drivers.tolist(), all_flows, nodes)
        flow_names = [*self._chains.moves, *(k for k in all_flows if k in inflow_rows and k not in self._chains.moves)]
        flow_places = np.array(flow_names, dtype=np.intp) - flow
        self._varying_flows, self._drivers = varying_flows[flow_places], drivers[flow_places]
        spread = _outflow_rows(routing, rates, range(share, end), varying_exits)
        after = contract_hubs(spread, routing.detours.order)
        inflows = [kept_nodes[i] for i in order]
        names: list[Sequence[int]] = [range(mass, flow), flow_names, before, inflows, inflows[::-1], kept_nodes]
        names += [range(share, end), after, range(nodes, nodes + masses)]
        parts = spans(map(len, names))
        self._masses, self._flows, hubs, kept_inflows, passed, kept_rows, self._varying_rows, _, self._change = parts
        self._passing = slice(kept_inflows.start, passed.stop)
        self._sent_rows = slice(kept_rows.start, self._varying_rows.stop)
        size, first = self._change.stop, self._change.start
        # nothing enters batch rows and the unit row, which stand after the stores
        starts = [hubs.start, *(first + run.stop for run in self._chains.runs)]
        stops = [*(first + run.start for run in self._chains.runs), first + laws.rows.nodes.stop]
        self._sums = [slice(start, stop) for start, stop in zip(starts, stops, strict=True) if start < stop]
        self._all_sums = [slice(starts[0], stops[-1])]
        rows = [
            dict(zip(columns, range(part.start, part.stop), strict=True))
            for columns, part in zip(names, parts, strict=True)
        ]
        self._inflow_matrix = square_matrix(inflow_rows, rows[0] | rows[1] | rows[2] | rows[3] | rows[8], size)
        self._chain_matrix = square_matrix(self._chains.moves, rows[1] | rows[8], size)
        self._spread = square_matrix(spread, rows[5] | rows[6] | rows[7] | rows[8], size)

    def series(self, stock: Floats, routes: IntervalRoutes, factors: Sequence[float], rate: Floats) -> Floats:
        """Return x + a·ẋ(x + b·ẋ(x + …)) for constant ``rate``, shape (masses, B).

        Args:
            stock: x, shape (masses, B).
            routes: by the shares of the interval.
            factors: …, b, a, from the innermost.
            rate: shape (arcs, B).
        """
        batch, chains = stock.shape[1], self._chains
        rates, shares = rate.take(self._varying_flows, 0), routes.rate.take(self._varying_arcs, 0)
        work: Floats = np.zeros((self._change.stop, batch))
        mean: Floats = work[self._masses]
        flows, passing, sent_rows = work[self._flows], work[self._passing], work[self._sent_rows]
        varying_rows, change = work[self._varying_rows], work[self._change]
        # what is called in each term is looked up once, as a call of few copies takes longer than what it does
        take, send, multiply = mean.take, passing.take, np.multiply
        enter, spread = (matrix.kernel(batch) for matrix in (self._inflow_matrix, self._spread))
        drivers, sum_rows = self._drivers, self._all_sums
        moves: list[Callable[[], object]] = []
        if chains.runs and batch >= MANY:
            count, sum_rows = len(chains.flows), self._sums
            moves.append(chains.changes(mean, rates[:count], flows[:count], change))
            drivers, flows, rates = drivers[count:], flows[count:], rates[count:]
        elif chains.runs:
            moves.append(partial(self._chain_matrix.kernel(batch), work, work))
        sums = [work[rows] for rows in sum_rows]
        passes = routes.kept_nodes.passes(passing)
        mean[...] = stock
        for factor in factors:
            take(drivers, 0, flows, "clip")  # "raise" would copy
            multiply(flows, rates, flows)
            for rows in sums:
                rows.fill(0.0)
            for move in moves:
                move()
            enter(work, work)
            for pass_on in passes:
                pass_on()
            send(self._senders, 0, sent_rows, "clip")
            multiply(varying_rows, shares, varying_rows)
            spread(work, work)
            multiply(change, factor, change)
            np.add(stock, change, mean)
        return mean


def _inflow_rows(
    laws: FlowLaws, rates: Floats, masses: Sequence[int], flows: Sequence[int], varying_flows: Integers
) -> dict[int, SparseRow]:
    """Return what masses and ``varying_flows`` send to stocks, and past constant nodes to stocks and kept nodes."""
    detours, stores, nodes = laws.routing.detours, laws.rows.nodes.stop, laws.routing.nodes
    number = dict(zip(varying_flows.tolist(), flows, strict=True))
    gives: dict[int, SparseRow] = {name: {} for name in (*masses, *flows)}
    for k in np.flatnonzero(laws.staged_network.donors < stores).tolist():
        source, rate = (number[k], 1.0) if k in number else (masses[laws.driver[k]], float(rates[k]))
        for end, part in ((laws.staged_network.donors[k], -rate), (laws.staged_network.recipients[k], rate)):
            name = int(end) - stores if end >= stores else nodes + int(end)
            gives[source][name] = gives[source].get(name, 0.0) + part
    return gives | {i: dict(parts) for i, parts in zip(detours.order, detours.out, strict=True)}


def _outflow_rows(
    routing: Routing, rates: Floats, shares: Sequence[int], varying_exits: Sequence[int]
) -> dict[int, SparseRow]:
    """Return what kept nodes, and the arcs ``varying_exits`` of theirs, send to stocks.

    What comes back to kept nodes is left out: it is in their throughputs already.
    """
    remaining_nodes, number = set(routing.detours.kept_nodes), dict(zip(varying_exits, shares, strict=True))
    gives: dict[int, SparseRow] = {name: {} for name in (*remaining_nodes, *shares)}
    for k, (i, end) in enumerate(zip(routing.donors.tolist(), routing.ends.tolist(), strict=True)):
        if i in remaining_nodes and end not in remaining_nodes:
            source, part = (number[k], 1.0) if k in number else (i, float(rates[routing.arcs[k]]))
            gives[source][end] = gives[source].get(end, 0.0) + part
    for i, parts in zip(routing.detours.order, routing.detours.out, strict=True):
        gives[i] = {end: part for end, part in parts.items() if end not in remaining_nodes}
    return gives
