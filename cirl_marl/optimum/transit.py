"""Shares of what passes nodes without stock are constant in an interval: rows of theorem 6 of docs/bound.md.

A node without stock hands on Q = A + B: A is what orders, schedules and fixed lifetimes send there past nodes without
stock, constant in an interval, and B follows from stocks. Of a share s it is a = s·A and b = s·B. As s is constant ::

    (s − s̲)·B = b − s̲ B    and    (s̄ − s)·B = s̄ B − b

are sums of stocks with constant factors. Where the stocks that B follows from fall at most like e^{−κt}, so do these,
and their means under the test polynomials rise with i when divided by those of e^{−κt} (theorem 2). Past fast stocks,
what these held at the start of the interval is allowed for (theorem 3). What may fall otherwise is allowed for as it
flows: by schedule from a stock that is refilled, out of lifetimes with fast stages, or through lifetimes at once.

Of such flows, and of all that leaves lifetimes, A may have a part a_k too, at most what flows at any time of the
interval (``partly_steady``). An order from a refilled stock is all of it, unless it may be cut; of what entered a
lifetime, and of what was there, the least that leaves at any time.
"""

from __future__ import annotations

from functools import cached_property
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import special

from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.admissible import Admissible, IntervalRanges
from cirl_marl.optimum.kernels import bernstein_means
from cirl_marl.optimum.matrices import Layout, ProgramRows
from cirl_marl.optimum.quasi_steady import ROUND_OFF, WIDER, cut_responses
from cirl_marl.optimum.reach import Linear

Mask = NDArray[np.bool_]
FAST = (np.inf, 2.0, 8.0)
"""Turnovers in an interval from which on a stock counts as fast; there are rows for each choice."""


@positional_record
class Sources:
    """What a node without stock gets its throughput from, past others and past fast stocks."""

    slow: Annotated[Integers, "stocks that are not fast, from which it follows"]
    fast: Annotated[Integers, "fast stocks"]
    dry: Annotated[
        tuple[Integers, Integers],
        "arcs by schedule that are constant until their donors run dry, from which something comes past nodes without "
        "stock, and past fast stocks",
    ]
    varying: Annotated[tuple[Integers, Integers], "places of flows that may fall otherwise, likewise"]
    is_regular: Annotated[bool, "whether all else follows from stocks that fall no faster than they release"]


class Transit:
    """The nodes without stock at which somebody may choose a share, and those that lead there from what is constant.

    Attributes:
        splits: nodes at which somebody may choose a share, in some interval.
        constant: arcs whose flow is constant in an interval, unless a donor without inflow runs dry, shape (arcs,).
        nodes: nodes through which something constant comes to a split, and splits.
        arcs: their outflows.
        partly_steady: arcs of whose flow a part is constant, if that is asked for.
        lives: nodes with a lifetime that is spread.
        varying_flow: arcs whose flows may fall by themselves, at once.
        varying_entry: nodes at which a part of each enters what passes on.
        varying_part: how much.
    """

    def __init__(self, admissible: Admissible, substeps: int, *, steady_parts: bool) -> None:
        """Find them in the network of ``admissible``, which the simulator advances by ``substeps`` an interval.

        Flows that may vary have constant parts if ``steady_parts``.
        """
        network = self._network = admissible.network
        self._admissible, stores = admissible, len(network.stores)
        kinds = np.unique(admissible.kinds).tolist()
        donors = {split.donor for kind in kinds for split in admissible.ranges[kind].free_splits}
        self.splits = np.array(sorted(donor for donor in donors if donor >= stores), dtype=np.intp)
        arcs, whole = np.arange(len(network.arcs)), admissible.lifetimes.whole
        lines = np.isin(arcs, [lifetime.exit_arc for lifetime in whole if not len(lifetime.rate)])
        self._stock_driven = ~admissible.by_schedule & ~lines
        refilled = admissible.by_schedule & ~lines & np.isin(network.donors, network.recipients)
        self.constant = (admissible.by_schedule | lines) & ~(refilled & (substeps > 1))
        self._dry = admissible.by_schedule & ~lines & ~refilled
        nodes = np.arange(len(network.nodes))
        chains = [lifetime for lifetime in whole if len(lifetime.rate)]
        exits = np.array([chain.exit_arc for chain in chains], dtype=np.intp)
        varying_orders = np.flatnonzero(refilled & ~self.constant)
        self.partly_steady = np.union1d(exits, varying_orders) if steady_parts else np.zeros(0, dtype=np.intp)
        constant_recipients = network.recipients[self.constant | np.isin(arcs, self.partly_steady)]
        entered = np.isin(nodes, constant_recipients) & (nodes >= stores)
        leads = self._spread(np.isin(nodes, self.splits), nodes >= stores, against=True)
        self.nodes = np.flatnonzero(self._spread(entered, nodes >= stores) & leads)
        self.arcs = np.flatnonzero(np.isin(network.donors, self.nodes))
        self.lives = network.donors[exits]
        whole_flow = [] if steady_parts else chains
        at_once = [(k, life.exit_arc, life.chain.weights[0]) for life in whole_flow for k in life.inflow_arcs.tolist()]
        # flows that may fall by themselves: which, where a part of it enters, and the part
        varies = [(arc, arc, 1.0) for arc in varying_orders.tolist()]
        varies += [(arc, arc, 1.0) for arc in exits.tolist()] + [term for term in at_once if term[2] > 0]
        flow, entry, part = zip(*varies, strict=True) if varies else ((), (), ())
        self.varying_flow = np.array(flow, dtype=np.intp)
        # past fast stocks an order counts by what may be cut of it
        self._is_order = np.isin(arcs, np.setdiff1d(varying_orders, self.partly_steady))
        self.varying_entry = network.recipients[np.array(entry, dtype=np.intp)]
        self.varying_part = np.array(part, dtype=float)
        first = len(varies) - len(exits) - sum(term[2] > 0 for term in at_once)
        self._exits = slice(first, first + len(exits))
        self._passes_by_order = (np.arange(len(varies)) < first) & self._is_order[self.varying_flow]
        self._sources: dict[bytes, list[Sources]] = {}

    def _spread(self, start: Mask, hands_on: Mask, *, against: bool = False) -> Mask:
        """Return the nodes of ``hands_on`` that are reached from some of them along or against stock-driven arcs."""
        tail, head = self._network.donors[self._stock_driven], self._network.recipients[self._stock_driven]
        tail, head = (head, tail) if against else (tail, head)
        reached, count = start & hands_on, -1
        while count != (count := int(reached.sum())):
            np.logical_or.at(reached, head, reached[tail])
            reached &= hands_on
        return reached

    @cached_property
    def _irregular(self) -> tuple[Mask, Mask]:
        """Stocks that may fall faster than they release, and arcs whose flow does not follow from its donor's stock."""
        admissible, network = self._admissible, self._network
        arcs = ~admissible.by_schedule & (admissible.driver != network.donors)
        return np.isin(np.arange(len(network.nodes)), network.donors[arcs | admissible.by_schedule]), arcs

    def sources(self, fast: Mask) -> list[Sources]:
        """Return those of each split, where ``fast`` says of each store whether it, or its lifetime, is fast."""
        if (key := fast.tobytes()) not in self._sources:
            self._sources[key] = [self._sources_of(int(node), fast) for node in self.splits]
        return self._sources[key]

    def _sources_of(self, split: int, fast: Mask) -> Sources:
        network, nodes, stores = self._network, np.arange(len(self._network.nodes)), len(fast)
        lives = np.isin(nodes, self.lives)
        hands_on = np.append(fast, np.ones(len(nodes) - stores, dtype=bool)) & ~lives
        passed = self._spread(nodes == split, hands_on, against=True)
        into = passed[network.recipients] & self._stock_driven
        varies_life = np.append(fast, np.zeros(len(nodes) - stores, dtype=bool)) & lives
        varies_life |= lives & np.isin(nodes, network.donors[self.partly_steady])
        slow = np.isin(nodes, network.donors[into]) & ~hands_on & ~varies_life
        fast_nodes = passed & (nodes < stores)
        direct = self._spread(nodes == split, nodes >= stores, against=True)
        behind = self._spread(fast_nodes, hands_on, against=True)
        varies = np.ones(len(self.varying_flow), dtype=bool)
        varies[self._exits] = varies_life[self.lives]
        stocks, arcs = self._irregular
        return Sources(
            np.flatnonzero(slow),
            np.flatnonzero(fast_nodes),
            (
                np.flatnonzero(direct[network.recipients] & self._dry),
                np.flatnonzero(behind[network.recipients] & (self._dry | self._is_order)),
            ),
            (
                np.flatnonzero(direct[self.varying_entry] & varies),
                np.flatnonzero(behind[self.varying_entry] & varies & ~self._passes_by_order),
            ),
            not (arcs & into).any() and not (stocks & (slow | fast_nodes)).any(),
        )


def steady_rows(transit: Transit, ranges: IntervalRanges, equal: ProgramRows, under: ProgramRows) -> None:
    """Add what holds of the constant parts A of throughputs and a of flows; keys (4, family, index, side).

    What lifetimes have of a is in their own rows (``Lifetimes.rows``).
    """
    network, layout, nodes, arcs = ranges.network, equal.layout, transit.nodes, transit.arcs
    if not len(nodes):
        return
    node_column, arc_column = _columns(layout)
    row = np.full(len(network.nodes), -1)
    row[nodes] = equal.add(4, 0, nodes)
    equal.put(row[nodes], node_column[nodes], -1.0)
    sources = np.flatnonzero(transit.constant & np.isin(network.recipients, nodes))
    equal.put(row[network.recipients[sources]], layout.flow[0] + sources, 1.0)
    parts = transit.partly_steady[np.isin(network.recipients[transit.partly_steady], nodes)]
    equal.put(row[network.recipients[parts]], arc_column[parts], 1.0)
    orders = transit.partly_steady[ranges.by_schedule[transit.partly_steady]]
    cut = under.add(4, 4, orders)
    under.put(cut, layout.flow[0] + orders, 1.0)
    under.put(cut, arc_column[orders], -1.0)
    under.loosen(cut, orders, 1.0)
    inner = arcs[np.isin(network.recipients[arcs], nodes)]
    equal.put(row[network.recipients[inner]], arc_column[inner], 1.0)
    low, high = ranges.rate
    own = np.setdiff1d(arcs, ranges.followers)
    exact, free = own[low[own] == high[own]], own[low[own] < high[own]]
    for rows, index, side, sign, bound in (
        (equal, exact, 0, 1.0, low),
        (under, free, 0, -1.0, low),
        (under, free, 1, 1.0, high),
    ):
        share = rows.add(4, 1, index, side)
        rows.put(share, arc_column[index], sign)
        rows.put(share, node_column[network.donors[index]], -sign * bound[index])
    for split in ranges.free_splits:
        if split.donor in nodes:
            total = equal.add(4, 2, split.donor)
            equal.put(total, arc_column[split.arcs], 1.0)
            equal.put(total, node_column[split.donor], -1.0)
            follower = equal.add(4, 3, split.followers)
            equal.put(follower, arc_column[split.followers], 1.0)
            equal.put(follower, arc_column[split.leader], -split.ratio)


def _columns(layout: Layout) -> tuple[Integers, Integers]:
    """Return the columns of A of each node, and of a of each arc; −1 where there is none."""
    node, arc = np.full(len(layout.network.nodes), -1), np.full(len(layout.network.arcs), -1)
    node[layout.steady_nodes] = layout.steady + np.arange(len(layout.steady_nodes))
    arc[layout.steady_arcs] = layout.steady_column(layout.steady_arcs)
    return node, arc


class ConstantShares:
    """Writes the rows of constant shares in a kind of interval, each at most 0; keys (3, …)."""

    def __init__(self, transit: Transit, ranges: IntervalRanges, linear: Linear, rows: ProgramRows) -> None:
        """Take what they are about."""
        self.transit, self.ranges, self.linear, self.rows = transit, ranges, linear, rows
        self.network, self.layout = ranges.network, rows.layout
        self.stores, self.interval = len(ranges.network.stores), ranges.network.episode.control_interval
        self.node_column, self.arc_column = _columns(rows.layout)
        self._responses_past: dict[bytes, Floats] = {}

    def write(self) -> None:
        """Write them."""
        splits = {split.donor: split for split in self.ranges.free_splits}
        low, high = self.ranges.rate
        for place, donor in enumerate(self.transit.splits.tolist()):
            if donor in splits:
                arcs = np.setdiff1d(splits[donor].arcs, self.ranges.followers)
                arcs = arcs[low[arcs] < high[arcs]]
                self._write_limits(place, donor, arcs)
                self._write_chains(place, donor, arcs)

    def _write_limits(self, place: int, donor: int, arcs: Integers) -> None:
        """Write s̲ B ≤ b ≤ s̄ B."""
        if self.node_column[donor] < 0:
            return
        sources = self.transit.sources(np.zeros(self.stores, dtype=bool))[place]
        moments = np.arange(len(self.layout.moments))
        rows = self._add(0, arcs, moments)
        self._put(rows, donor, arcs, moments, -1.0)
        self._allow_dry(rows, donor, arcs, sources, 1.0)

    def _add(self, choice: int, arcs: Integers, moments: Integers) -> Integers:
        """Add rows for the least and the greatest share of arcs in some moments, shape (moments, 2, arcs)."""
        return self.rows.add(3, choice, arcs, moments[:, None, None], np.arange(2)[:, None])

    def _write_chains(self, place: int, donor: int, arcs: Integers) -> None:
        """Write how fast (s − s̲)·B and (s̄ − s)·B can fall, for each choice of fast stocks."""
        least, most = self.ranges.exits[:, : self.stores]
        # what leaves a lifetime may be nothing
        least = np.where(np.isin(np.arange(self.stores), self.transit.lives), most, least)
        choices: set[bytes] = set()
        for choice, turnover in enumerate(FAST):
            sources = self.transit.sources(least * self.interval >= turnover)[place]
            key = np.concatenate([sources.fast, [-1], *sources.varying]).tobytes()
            if sources.is_regular and key not in choices:
                choices.add(key)
                self._write_chain(1 + choice, donor, arcs, sources, float(most[sources.slow].max(initial=0.0)))

    def _write_chain(self, choice: int, donor: int, arcs: Integers, sources: Sources, rate: float) -> None:
        layout, d = self.layout, self.layout.degree
        means = special.hyp1f1(np.arange(d + 1) + 1, d + 2, -rate * layout.length)
        ratio = np.append(means[1:] / means[:-1], means[0] * np.exp(-rate * layout.length) / means[-1])
        moments = np.arange(len(layout.moments) - 1)
        factor = ratio[moments % (d + 1), None, None]
        rows = self._add(choice, arcs, moments)
        self._put(rows, donor, arcs, moments, factor)
        self._put(rows, donor, arcs, moments + 1, -1.0)
        spread = np.diff(self.ranges.rate[:, arcs], axis=0)[0, :, None]
        transients = self._transients(donor, sources.fast)[moments, None, None]
        self.rows.at_start(rows[..., None], 0, sources.fast, -factor[..., None] * spread * transients)
        self._allow_dry(rows, donor, arcs, sources, 1.0 + factor)
        self._allow_varying(rows, donor, spread, sources, moments, factor[..., None])

    def _transients(self, donor: int, fast: Integers) -> Floats:
        """Return what passes a node of a unit that each fast stock held at the start, in each moment."""
        layout, pieces, before = self.layout, [], np.eye(len(fast))
        if not len(fast):
            return np.zeros((len(layout.moments), 0))
        motion = self.linear.gains[fast][:, fast].toarray() - np.diag(self.ranges.exits[0, fast])
        means, whole = bernstein_means(motion, layout.degree, layout.length)
        means, whole = (np.maximum(part, 0.0) * WIDER + ROUND_OFF for part in (means, whole))
        for _ in range(layout.pieces):
            pieces.append(means @ before)
            before = whole @ before
        flow = self.linear.pass_flow[[donor - self.stores]][:, fast].toarray()[0]
        transients: Floats = flow @ np.concatenate(pieces)
        return transients

    def _put(self, rows: Integers, donor: int, arcs: Integers, moments: Integers, weight: Floats | float) -> None:
        """Put ``weight`` times (s − s̲)·B, or (s̄ − s)·B on side 1, in some moments."""
        layout, bound, at = self.layout, self.ranges.rate[:, arcs], moments[:, None, None]
        weight = weight * np.array([[1.0], [-1.0]])
        self.rows.put(rows, layout.flow[at] + arcs, weight)
        self.rows.put(rows, layout.stock[at] + donor, -weight * bound)
        if self.node_column[donor] >= 0:
            self.rows.put(rows, self.arc_column[arcs], -weight)
            self.rows.put(rows, self.node_column[donor], weight * bound)

    def _visits(self, donor: int, entries: Integers) -> Floats:
        """Return how much of what enters some nodes without stock passes another at the most."""
        visits: Floats = self.linear.routes.visits[entries - self.stores, donor - self.stores] * WIDER
        return visits

    def _responses(self, fast: Integers) -> Floats:
        """Return the most that passes nodes of a unit of flow into each, past fast stocks."""
        if (key := fast.tobytes()) not in self._responses_past:
            self._responses_past[key] = cut_responses(self.ranges, self.linear, fast)[0]
        return self._responses_past[key]

    def _allow_dry(self, rows: Integers, donor: int, arcs: Integers, sources: Sources, factor: Floats | float) -> None:
        """Allow for what changes in schedules whose donors may run dry, ``factor`` times."""
        if self.layout.pieces == 1 and not self.layout.coarse:
            return
        direct, behind = sources.dry
        spread, recipients = (factor * np.diff(self.ranges.rate[:, arcs], axis=0))[..., None], self.network.recipients
        self.rows.loosen(rows[..., None], direct, spread * self._visits(donor, recipients[direct]))
        if len(behind):
            responses = self._responses(sources.fast)[donor, recipients[behind]]
            self.rows.loosen(rows[..., None], behind, spread * responses)

    def _allow_varying(
        self, rows: Integers, donor: int, spread: Floats, sources: Sources, moments: Integers, ratio: Floats
    ) -> None:
        """Allow for what may fall otherwise of flows: it passes at once, and past fast stocks later.

        As B_0 + … + B_i falls, the mean under B_i of what passes later is at most the sum of what enters until then in
        all moments, times what passes in all.
        """
        layout, transit, (direct, behind) = self.layout, self.transit, sources.varying
        at = moments[:, None, None, None]
        # what flows by schedule is constant in a substep
        is_substep = (not layout.coarse) & ((at + 1) % (layout.degree + 1) > 0)
        kept = np.where(is_substep & self.ranges.by_schedule[transit.varying_flow[direct]], 1.0 - ratio, 1.0)
        weight = kept * transit.varying_part[direct] * self._visits(donor, transit.varying_entry[direct])
        self.rows.put(rows[..., None], layout.flow[at] + transit.varying_flow[direct], -spread * weight)
        self._put_steady(rows, direct, spread * weight)
        if not len(behind):
            return
        share = transit.varying_part[behind] * self._responses(sources.fast)[donor, transit.varying_entry[behind]]
        for moment in moments.tolist():
            columns = layout.flow[: moment + 1, None] + transit.varying_flow[behind]
            self.rows.put(rows[moment][..., None, None], columns, -spread[..., None] * share)
            self._put_steady(rows[moment], behind, spread * share * (moment + 1))

    def _put_steady(self, rows: Integers, places: Integers, weight: Floats) -> None:
        """Put weights of the constant parts of flows that may fall otherwise, shape (..., places), into rows."""
        arcs = self.transit.varying_flow[places]
        steady = np.isin(arcs, self.transit.partly_steady)
        self.rows.put(rows[..., None], self.arc_column[arcs[steady]], weight[..., steady])
