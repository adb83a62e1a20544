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

from cirl_marl.dynamics.detours import Parts, contracted, woven
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.routing import Routes
from cirl_marl.network import Floats
from cirl_marl.network.rowsum import spans


class Shortcut:
    """The mean of the state over a substep, in networks with nodes that store nothing."""

    def __init__(self, laws: FlowLaws, factors: Sequence[float]) -> None:
        """Compile the sums; ``factors`` are those of the derivatives in the series, from the innermost."""
        self._factors = factors
        routing, detours, masses = laws.routing, laws.routing.detours, laws.rows.masses
        nodes, stores = routing.nodes, laws.rows.nodes.stop
        outer = np.flatnonzero(laws.network.donors < stores)
        self._varying = outer[~laws.fixed[outer]]
        self._drivers = laws.driver[self._varying]
        place = {i: n for n, i in enumerate(detours.kept)}
        sent = [k for k, i in enumerate(routing.donors.tolist()) if i in place and not routing.fixed[k]]
        self._sent = np.array(sent, dtype=np.intp)
        self._senders = np.array([place[int(routing.donors[k])] for k in sent], dtype=np.intp)

        # names of sources and ends: nodes without stock and what stocks get as in ``detours``, then the others
        stock, flow = nodes + stores, nodes + stores + masses
        share = flow + len(self._varying)
        rates = laws.rate(laws.neutral[:, :1])[:, 0]
        gives: dict[int, Parts] = {name: {} for name in range(stock, share)}
        number = {int(k): flow + n for n, k in enumerate(self._varying)}
        for k in outer.tolist():
            source, weight = (number[k], 1.0) if k in number else (stock + int(laws.driver[k]), float(rates[k]))
            donor, recipient = int(laws.network.donors[k]), int(laws.network.recipients[k])
            for end, signed in ((donor, -weight), (recipient, weight)):
                name = end - stores if end >= stores else nodes + end
                gives[source][name] = gives[source].get(name, 0.0) + signed
        gives |= {i: dict(parts) for i, parts in zip(detours.order, detours.out, strict=True)}
        before = contracted(gives, detours.order)

        passes: dict[int, Parts] = {i: {} for i in detours.kept} | {share + n: {} for n in range(len(sent))}
        columns = {k: n for n, k in enumerate(sent)}
        for k, (i, end) in enumerate(zip(routing.donors.tolist(), routing.ends.tolist(), strict=True)):
            if i in place and end not in place:
                source, weight = (share + columns[k], 1.0) if k in columns else (i, float(rates[routing.arcs[k]]))
                passes[source][end] = passes[source].get(end, 0.0) + weight
        for i, parts in zip(detours.order, detours.out, strict=True):  # what comes to kept nodes is in theirs already
            passes[i] = {end: part for end, part in parts.items() if end not in place}
        after = contracted(passes, detours.order)

        names = [range(stock, flow), range(flow, share), before, detours.kept, range(share, share + len(sent)), after]
        parts = spans(map(len, (*names, range(masses))))
        self._x, self._flows, hubs, self._kept, self._sending, _, self._change = parts
        self._rest = slice(hubs.start, self._change.stop)
        size, ends = self._change.stop, {nodes + s: self._change.start + s for s in range(stores)}
        rows = [
            dict(zip(group, range(part.start, part.stop), strict=True))
            for group, part in zip(names, parts, strict=False)
        ]
        self._gathered = woven(gives, rows[0] | rows[1] | rows[2] | rows[3] | ends, size)
        self._spread = woven(passes, rows[3] | rows[4] | rows[5] | ends, size)

    def mean(self, stock: Floats, routes: Routes, rate: Floats) -> Floats:
        """Return the mean of the masses over the substep for constant ``rate``, shape (masses, B)."""
        rates, shares = rate.take(self._varying, 0), routes.shares.take(self._sent, 0)
        work = np.empty((self._change.stop, stock.shape[1]))
        mean, flows, kept = work[self._x], work[self._flows], work[self._kept]
        sending, change, rest = work[self._sending], work[self._change], work[self._rest]
        mean[...] = stock
        for factor in self._factors:
            np.multiply(mean.take(self._drivers, 0), rates, out=flows)
            rest.fill(0.0)
            self._gathered.substitute(work)
            routes.kept.throughput(kept)
            np.multiply(kept.take(self._senders, 0), shares, out=sending)
            self._spread.substitute(work)
            change *= factor
            np.add(stock, change, out=mean)
        return mean
