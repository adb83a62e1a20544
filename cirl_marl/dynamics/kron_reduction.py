"""What stocks get at once through nodes that store nothing, without the flows in between.

Inside the exact solver's series only ẋ matters. It follows from x in four steps, each over all copies: the flows whose
rates differ from copy to copy; what of them and of the others comes to stocks and to kept nodes (``routing``), a sum
with constant weights; the throughputs of the kept nodes; and what of these comes to stocks, with constant weights but
for the shares that differ. The sums with constant weights go through as few nodes as they can: where the ways past one
are no more than the ways to it and from it, they lead past it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.routing import IntervalRoutes, Routing
from cirl_marl.dynamics.static_elimination import SparseRow, contract_hubs, square_matrix
from cirl_marl.network import Floats, Integers
from cirl_marl.network.rowsum import spans


class KronReduction:
    """The mean of the state over a substep, in networks with nodes that store nothing.

    The rows of one array are worked through from the first to the last: masses, flows that differ from copy to copy,
    constant nodes on the way, throughputs of the kept nodes, shares of these that differ, constant nodes on the way
    again, and what masses change by.
    """

    def __init__(self, laws: FlowLaws, factors: Sequence[float]) -> None:
        """Compile the sums; ``factors`` are those of the derivatives in the series, from the innermost."""
        self._factors = factors
        routing, nodes, masses = laws.routing, laws.routing.nodes, laws.rows.masses
        outer = laws.staged_network.donors < laws.rows.nodes.stop
        place = {i: n for n, i in enumerate(routing.detours.kept_nodes)}
        self._flowing = np.flatnonzero(outer & ~laws.is_fixed)
        self._drivers = laws.driver[self._flowing]
        donors = routing.donors.tolist()
        sent = [k for k, same in enumerate(routing.is_fixed) if donors[k] in place and not same]
        self._sent = routing.arcs[sent]
        self._senders = np.array([place[donors[k]] for k in sent], dtype=np.intp)

        # nodes have the names that they have in ``detours``, and so has what stocks, the first of the masses, get
        mass, flow, share, end = np.cumsum([nodes + masses, masses, len(self._flowing), len(sent)]).tolist()
        rates = laws.rate(laws.neutral[:, :1])[:, 0]
        gathered = _inflow_rows(laws, rates, range(mass, flow), range(flow, share), self._flowing)
        before = contract_hubs(gathered, routing.detours.order)
        spread = _outflow_rows(routing, rates, range(share, end), sent)
        after = contract_hubs(spread, routing.detours.order)
        names: list[Sequence[int]] = [range(mass, flow), range(flow, share), before, routing.detours.kept_nodes]
        names += [range(share, end), after, range(nodes, nodes + masses)]
        parts = spans(map(len, names))
        self._masses, self._flows, hubs, self._kept, self._sending, _, self._change = parts
        self._rest, size = slice(hubs.start, self._change.stop), self._change.stop
        rows = [
            dict(zip(each, range(part.start, part.stop), strict=True)) for each, part in zip(names, parts, strict=True)
        ]
        self._gathered = square_matrix(gathered, rows[0] | rows[1] | rows[2] | rows[3] | rows[6], size)
        self._spread = square_matrix(spread, rows[3] | rows[4] | rows[5] | rows[6], size)

    def mean(self, stock: Floats, routes: IntervalRoutes, rate: Floats) -> Floats:
        """Return the mean of the masses over the substep for constant ``rate``, shape (masses, B)."""
        rates, shares = rate.take(self._flowing, 0), routes.rate.take(self._sent, 0)
        work: Floats = np.empty((self._change.stop, stock.shape[1]))
        mean: Floats = work[self._masses]
        flows, kept = work[self._flows], work[self._kept]
        sending, change, rest = work[self._sending], work[self._change], work[self._rest]
        mean[...] = stock
        for factor in self._factors:
            np.multiply(mean.take(self._drivers, 0), rates, out=flows)
            rest.fill(0.0)
            self._gathered.substitute(work)
            routes.kept_nodes.throughput(kept)
            np.multiply(kept.take(self._senders, 0), shares, out=sending)
            self._spread.substitute(work)
            change *= factor
            np.add(stock, change, out=mean)
        return mean


def _inflow_rows(
    laws: FlowLaws, rates: Floats, masses: Sequence[int], flows: Sequence[int], flowing: Integers
) -> dict[int, SparseRow]:
    """Return what masses and ``flowing`` arcs send to stocks, and past constant nodes to stocks and kept nodes."""
    detours, stores, nodes = laws.routing.detours, laws.rows.nodes.stop, laws.routing.nodes
    number = dict(zip(flowing.tolist(), flows, strict=True))
    gives: dict[int, SparseRow] = {name: {} for name in (*masses, *flows)}
    for k in np.flatnonzero(laws.staged_network.donors < stores).tolist():
        source, rate = (number[k], 1.0) if k in number else (masses[laws.driver[k]], float(rates[k]))
        for end, part in ((laws.staged_network.donors[k], -rate), (laws.staged_network.recipients[k], rate)):
            name = int(end) - stores if end >= stores else nodes + int(end)
            gives[source][name] = gives[source].get(name, 0.0) + part
    return gives | {i: dict(parts) for i, parts in zip(detours.order, detours.out, strict=True)}


def _outflow_rows(routing: Routing, rates: Floats, shares: Sequence[int], sent: Sequence[int]) -> dict[int, SparseRow]:
    """Return what kept nodes, and the arcs ``sent`` of theirs, send to stocks.

    What comes back to kept nodes is left out: it is in their throughputs already.
    """
    kept, number = set(routing.detours.kept_nodes), dict(zip(sent, shares, strict=True))
    gives: dict[int, SparseRow] = {name: {} for name in (*kept, *shares)}
    for k, (i, end) in enumerate(zip(routing.donors.tolist(), routing.ends.tolist(), strict=True)):
        if i in kept and end not in kept:
            source, part = (number[k], 1.0) if k in number else (i, float(rates[routing.arcs[k]]))
            gives[source][end] = gives[source].get(end, 0.0) + part
    for i, parts in zip(routing.detours.order, routing.detours.out, strict=True):
        gives[i] = {end: part for end, part in parts.items() if end not in kept}
    return gives
