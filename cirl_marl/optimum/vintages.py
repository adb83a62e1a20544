"""What leaves at the end of lifetimes, from what entered and when: rows without stages.

What leaves a chain of stages is linear in what has entered it, u, and in what it held at the start. Weighted with B_i
over a piece p it is ::

    L_i = known_i + w_0 U_i + (d + 1)/δ · Σ_q ∫_q k_pi(τ) u(τ) dτ,    k_pi(τ) = ∫_p B_i(t) μ e_Kᵀ Φ(t, τ) E dt,

over the pieces q up to p, with Φ the motion of the stages and E how an inflow enters them. Each k is smooth on a piece
and not negative. Polynomials of degree d enclose it there, c̲_j and c̄_j being their Bernstein coefficients, and as u is
not negative, neither are any of the means in

    known_i + w_0 U_i + Σ_q Σ_j c̲_j U_qj ≤ L_i ≤ known_i + w_0 U_i + Σ_q Σ_j c̄_j U_qj

(theorem 4 of docs/bound.md). What leaves a fixed lifetime is the mean inflow of one interval, or known. Rows of
lifetimes that an agent stretches: ``stretched``. One of a single stage is a stock that leaves in proportion to itself:
laws of flows hold it exactly, in any pieces, which a kernel that jumps where τ = t does not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from itertools import product
from typing import Annotated, Any

import numpy as np
from scipy import sparse

from cirl_marl.dynamics.components import ComponentNetwork, component_network, copy_id, simulated_network
from cirl_marl.dynamics.laws import ArcRates
from cirl_marl.dynamics.stages import StagedNetwork, staged_network
from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Lifetime, Node
from cirl_marl.network.lifetimes import Chain
from cirl_marl.network.substances import follows_contents
from cirl_marl.optimum.histories import History
from cirl_marl.optimum.kernels import Kernel, unit_outflow
from cirl_marl.optimum.matrices import IntervalCache, Layout
from cirl_marl.optimum.stretched import StretchedRows, planned_turnovers

LOOSE, ROUGH = 2e-4, 0.1
"""Distance of the bounds of what leaves, relative to it, above which intervals have more pieces; ROUGH at degree 1.

Pieces that are tight to LOOSE are three times as many at degree 1, and cost more than degree 2 for less: when something
leaves within an interval matters little, as what has not left is still there. Seed 150 of the cycles with lifetimes of
``benchmarks.yearly`` is bounded 0.04 % higher with 2 pieces in place of 4, in 6 CPU s in place of 28; plastics_world
0.02 % even with 1 in place of 6, in 2 in place of 34.
"""
FAR = 2.5e-3
"""The same, above which what is left is bounded too: where there are no more pieces, and lives are short."""
MOST_PIECES = 64
"""Of two mean lives, over which this is looked at: where they have more, a piece is short against a life."""


@positional_record
class WholeLifetime:
    """A lifetime as the program has it."""

    node: Annotated[Node, "whose it is"]
    rows: Annotated[
        Integers, "of its stages, or slots, among the stocks of the simulator, shape (components that it has, stages)"
    ]
    exit_arc: Annotated[int, "the arc of the planned network through which what has lived goes"]
    inflow_arcs: Annotated[Integers, "its arcs through which something enters"]
    rate: Annotated[Floats, "μ in each interval, shape (steps,), 1/time; empty for a fixed one"]
    factor: Annotated[Floats, "least and most that an agent multiplies it with, shape (2, steps); empty if nobody does"]
    reached_node: Annotated[int, "the node, or its last stage, among the nodes of ``reached``"]
    reached_entry: Annotated[int, "where what enters is among them; the node itself of a fixed one"]
    reached_arc: Annotated[int, "``leaving`` among its arcs"]

    @property
    def chain(self) -> Chain:
        """Its stages, if it is not fixed."""
        assert self.node.lifetime is not None and self.node.lifetime.chain is not None
        return self.node.lifetime.chain

    def masses(self, initial: Floats) -> Floats:
        """Return what is in its stages, or slots, of all stocks of the simulator, mass."""
        masses: Floats = initial[self.rows].sum(axis=0)
        return masses

    def slots(self, initial: Floats) -> Floats:
        """Return what is in the slots of a fixed lifetime, first what comes out first, of all stocks, mass."""
        masses = self.masses(initial)
        # what rounding left of what came out before comes with the oldest
        return np.concatenate([[masses[-2] + masses[-1]], masses[-3::-1]])

    def most_out(self, slots: Floats, step: int, inflow: Floats) -> float:
        """Return the most that comes out of a fixed one in an interval, given the ``inflow`` in those before, mass."""
        return float(slots[step] if step < len(slots) else inflow[step - len(slots), self.reached_node])


class Lifetimes:
    """A network as its program sees it, with its lifetimes whole.

    Attributes:
        network: as it is given.
        simulator_network: as the simulator has it.
        state_layout: which row of its stocks is what.
        plan_network: as the program has it; where contents matter, with a copy for each substance.
        reach_network: as stocks are bounded, all lifetimes but fixed ones being chains.
        whole: the lifetimes that are no plain stocks, of each component its own if the program has components.
        exit_arcs: arcs of the planned network that come out of these.
        most_factor: most that multiplies what comes out of each, shape (steps, lifetimes).
        start_planned: what the stores of the planned network hold of the stocks of the simulator, (stores, stocks).
        start_reached: what the stores of ``reach_network`` hold of them, likewise.
        nodes_reached: what the nodes of the planned network are of those of ``reach_network``, shape (nodes, nodes).
        arcs_reached: arcs of ``reach_network`` that are those of the planned network, shape (arcs,).
        cache: kernels of their rows, which do for other networks whose lifetimes are alike.
        sums: what the nodes of the network are of those of the planned one, shape (nodes, nodes).
        totals: the part of it of stocks, shape (stores, stores).
        arc_sums: what the arcs of the network are of those of the planned one, shape (arcs, arcs).
    """

    def __init__(self, network: Network, agents: Sequence[str]) -> None:
        """Compile the lifetimes of ``network`` while ``agents`` act."""
        self.network = self.plan_network = self.reach_network = network
        self.simulator_network = simulated_network(network)
        self.state_layout = StateLayout(self.simulator_network)
        self.whole: list[WholeLifetime] = []
        self.cache = IntervalCache()
        with_lifetime = [node for node in network.stores if node.lifetime is not None]
        # what several stocks lack together is less loose of lifetimes (``shortages``)
        together = {id_ for service in network.services if len(service.providers) > 1 for id_ in service.providers}
        nodes = [node for node in with_lifetime if node.id in together or not _is_stock(node.lifetime)]
        separate = follows_contents(network) and not isinstance(network, ComponentNetwork)
        if with_lifetime or separate:
            fixed_nodes = [node.id for node in nodes if node.lifetime is not None and node.lifetime.chain is None]
            plain = {node.id for node in with_lifetime} - (lives := {node.id for node in nodes})
            plan, reach = (staged_network(network, whole, plain=plain) for whole in (lives, fixed_nodes))
            if separate:
                plan, reach = component_network(plan), component_network(reach)
            self.plan_network, self.reach_network = plan, reach if nodes else plan
        substances = ("", *(substance.id for substance in network.substances)) if separate else ("",)
        for node, (component, substance) in product(nodes, enumerate(substances)):
            self.whole.append(self._whole(node, substance, component if separate else None, agents))
        self.exit_arcs = np.array([lifetime.exit_arc for lifetime in self.whole], dtype=np.intp)
        self.most_factor = np.ones((network.episode.horizon, len(self.whole)))
        for place, lifetime in enumerate(self.whole):
            if lifetime.factor.size:
                self.most_factor[:, place] = lifetime.factor[1]
        stocks = self.state_layout.nodes.stop
        plan_network, reach_network = self.plan_network, self.reach_network
        self.start_planned = _sums(self.simulator_network, plan_network)[: len(plan_network.stores), :stocks]
        self.start_reached = _sums(self.simulator_network, reach_network)[: len(reach_network.stores), :stocks]
        self.nodes_reached = _sums(reach_network, plan_network)
        self.arcs_reached = np.array([reach_network.arc_index[arc.id] for arc in plan_network.arcs], dtype=np.intp)
        self.sums = _sums(plan_network, network)
        self.totals = self.sums[: len(network.stores), : len(plan_network.stores)]
        originals = [plan_network.original(arc.id) for arc in plan_network.arcs]
        places = [(network.arc_index[id_], k) for k, id_ in enumerate(originals) if id_ in network.arc_index]
        rows, columns = np.array(places, dtype=np.intp).reshape(-1, 2).T
        shape = (len(network.arcs), len(plan_network.arcs))
        self.arc_sums = sparse.csr_array((np.ones(len(rows)), (rows, columns)), shape=shape)

    def _whole(self, node: Node, substance: str, component: int | None, agents: Sequence[str]) -> WholeLifetime:
        """Return the lifetime of a node, or, of a network that is planned by components, that of one of them there."""
        network, plan_network, reach_network = self.network, self.plan_network, self.reach_network
        assert isinstance(plan_network, StagedNetwork) and node.lifetime is not None
        place, chain, rate, factor = network.node_index[node.id], node.lifetime.chain, np.zeros(0), np.zeros((2, 0))
        if chain is not None:
            rate = chain.rate / node.lifetime.mean / network.interval_means(node.stretch)
            if node.control is not None:
                high, neutral, low = 1.0 / network.control_bounds[:, network.control_rows[node.id].start]
                if node.id in agents:
                    factor = np.stack([low, high])
                else:
                    rate = rate * neutral
        rows = self.state_layout.stages.get(place, np.array([place])).reshape(self.state_layout.components, -1)

        def name(id_: str) -> str:
            return copy_id(id_, substance) if substance else id_

        own, exit_arc = name(node.id), plan_network.release_arcs[name(node.id)]
        return WholeLifetime(
            node=replace(node, id=own),
            rows=rows if component is None else rows[[component]],
            exit_arc=plan_network.arc_index[exit_arc],
            inflow_arcs=np.flatnonzero(plan_network.recipients == plan_network.node_index[own]),
            rate=rate,
            factor=factor,
            reached_entry=reach_network.node_index[own if chain is None else name(f"{node.id}.entry")],
            reached_node=reach_network.node_index[own],
            reached_arc=reach_network.arc_index[exit_arc],
        )

    def pieces(self, degree: int, most: int, loose: float | None = None) -> int:
        """Return the pieces of an interval, at most ``most``, in which stocks turn over once and kernels are smooth.

        Bounds of what leaves are at most ``loose`` apart; None: LOOSE, or ROUGH at degree 1.
        """
        loose = (ROUGH if degree == 1 else LOOSE) if loose is None else loose
        interval, turnover = self.network.episode.control_interval, ArcRates(self.plan_network).turnover
        chains = [lifetime for lifetime in self.whole if len(lifetime.rate)]
        for lifetime in chains:
            turnover[self.plan_network.donors[lifetime.exit_arc]] = 0.0
        pieces = max(1, math.ceil(interval * float(turnover.max(initial=0.0)) - 1e-9))
        for lifetime in chains:
            while not lifetime.factor.size and pieces < most:
                count = pieces * self.network.episode.horizon
                if self._looseness(lifetime, lifetime.rate.max(), count, interval / pieces, degree) <= loose:
                    break
                pieces += 1
        return min(pieces, most)

    def _looseness(self, lifetime: WholeLifetime, rate: float, count: int, length: float, degree: int) -> float:
        """Return how far bounds of what leaves are apart, relative to it, where as much enters in so many pieces."""
        key = ("looseness", lifetime.node.id, float(rate), count, length, degree)
        rates = np.full(count, rate)
        return self.cache.value(key, lambda: Kernel(lifetime.chain, rates, length, degree).looseness)

    def entries(self, layout: Layout) -> int:
        """Return how many entries the rows of an episode have, about."""
        moments = self.network.episode.horizon * len(layout.moments)
        return moments**2 * sum(len(whole.inflow_arcs) for whole in self.whole if len(whole.rate))

    def rows(self, layout: Layout, initial: Floats, intervals: range) -> tuple[list[Any | History], Floats]:
        """Return the rows G v ≤ g of all lifetimes, one block after the other, and g.

        Args:
            layout: of the variables of the planned network.
            initial: stocks of the simulator at the start, shape (stocks,), mass.
            intervals: of the episode, one after the other.
        """
        blocks: list[Any | History] = []
        limits = [np.zeros(0)]
        first = (layout.size * np.arange(len(intervals))[:, None] + layout.flow).ravel()[:, None]
        ends = (layout.size * np.arange(len(intervals))[:, None] + layout.end).ravel()[:, None]
        width = layout.size * len(intervals)
        for lifetime in self.whole:
            outflow = _column_sums(first + lifetime.exit_arc, width)
            inflow = _column_sums(first + lifetime.inflow_arcs, width)
            if has_steady := len(lifetime.rate) > 0 and lifetime.exit_arc in layout.steady_arcs:
                column = np.arange(len(intervals))[:, None] * layout.size + layout.steady_column(lifetime.exit_arc)
                steady = _column_sums(column, width)
            if lifetime.factor.size:
                stretch, node = self._stretch_rows(lifetime, layout, intervals), lifetime.node.id
                stock = _column_sums(ends + self.plan_network.node_index[node], width)
                blocks.append(stretch.matrix(stock, outflow, inflow))
                limits.append(stretch.limits(lifetime.masses(initial)))
                if has_steady:
                    (least, least_start), (most, most_start) = stretch.outflow_bounds(inflow, lifetime.masses(initial))
                    by_moment = sparse.kron(sparse.eye_array(len(intervals)), np.ones((len(layout.moments), 1)))
                    later = outflow - lifetime.chain.weights[0] * inflow
                    blocks += [least - steady, by_moment @ steady - later, later - by_moment @ most]
                    limits += [-least_start, np.zeros(len(first)), by_moment @ most_start]
                continue
            # L − c̄ U ≤ from_start and c̲ U − L ≤ −from_start, in the columns of what leaves and of what enters
            write = self._chain_kernels if len(lifetime.rate) else self._line_kernels
            low, high, from_start = write(lifetime, layout, initial, intervals)
            beside, kernels = [outflow, -outflow], [-high, low]
            limits += [from_start, -from_start]
            if has_steady:
                least, of_start = self._kernel(lifetime, layout, intervals).least
                masses = lifetime.masses(initial)
                start = np.array([(rows @ masses).min() for rows in of_start])
                beside.append(-steady)
                kernels.append(sparse.csr_array(least.reshape(len(intervals), layout.pieces, -1).min(axis=1)))
                limits.append(-start.reshape(len(intervals), -1).min(axis=1))
            if self._bounds_stock(lifetime, layout):
                stock = _column_sums(ends + self.plan_network.node_index[lifetime.node.id], width)
                kernel = self._kernel(lifetime, layout, intervals)
                low, high = (bound.reshape(len(ends), -1) for bound in (kernel.survivors_low, kernel.survivors_high))
                survivors = kernel.start_survivors @ lifetime.masses(initial)
                beside += [stock, -stock]
                kernels += [sparse.csr_array(-high), sparse.csr_array(low)]
                limits += [survivors, -survivors]
            interval = [np.arange(part.shape[0]) * len(intervals) // part.shape[0] for part in beside]
            kernel = sparse.vstack(kernels, format="csr")
            blocks.append(History(np.concatenate(interval), sparse.vstack(beside), kernel, inflow))
        return blocks, np.concatenate(limits)

    def of_new(self, lifetime: WholeLifetime, layout: Layout) -> Floats:
        """Return what a unit of mass that is new in a stock at the start of each interval adds to the limits of rows.

        In a fixed lifetime it counts as what entered in the interval before.

        Returns:
            Shape (steps, rows of the lifetime).
        """
        steps, moments = self.network.episode.horizon, len(layout.moments)
        if lifetime.factor.size:
            return self._stretch_new(lifetime, layout)
        if len(lifetime.rate):
            rate = np.repeat(lifetime.rate, layout.pieces)
            outflow, survivors = (
                part[:: layout.pieces].reshape(steps, -1)
                for part in unit_outflow(lifetime.chain, rate, layout.length, layout.degree)
            )
        else:
            delay = lifetime.rows.shape[1] - 1
            shares = np.kron(np.eye(steps, k=delay - 1), np.ones((1, moments)))
            outflow = np.asarray(shares / self.network.episode.control_interval, dtype=float)
        ends = [survivors, -survivors] if self._bounds_stock(lifetime, layout) else []
        return np.concatenate([outflow, -outflow, *ends], axis=1)

    def planned_stretches(self, layout: Layout, plan: Floats, initial: Floats, intervals: range) -> dict[str, Floats]:
        """Return the stretches of a plan, by agent: those that leave its stocks at the end of each interval.

        Args:
            layout: of the variables.
            plan: variables of each interval, shape (steps, size).
            initial: stocks of the simulator at the start, shape (stocks,), mass.
            intervals: that were planned.
        """
        period, stretches = slice(intervals.start, intervals.stop), {}
        flow, interval = layout.means(plan)[1], self.network.episode.control_interval
        for lifetime in self.whole:
            if lifetime.factor.size:
                once = lifetime.rate[period] * interval
                entered = flow[:, lifetime.inflow_arcs].sum(axis=1) * interval
                stock = plan[:, layout.last][:, self.plan_network.node_index[lifetime.node.id]]
                turnover, masses = once * lifetime.factor[:, period], lifetime.masses(initial)
                stretches[lifetime.node.id] = once / planned_turnovers(lifetime.chain, turnover, masses, entered, stock)
        return stretches

    def _stretch_new(self, lifetime: WholeLifetime, layout: Layout) -> Floats:
        """Return ``of_new`` of a lifetime that is stretched."""
        steps, new = self.network.episode.horizon, lifetime.chain.inflow_shares / lifetime.chain.inflow_shares.sum()
        parts = np.array([layout.pieces, layout.pieces, 1, 1])
        added = np.zeros((steps, steps * int(parts.sum())))
        for step in range(steps):
            later = self._stretch_rows(lifetime, layout, range(step, steps)).limits(new)
            starts, counts = np.cumsum([0, *parts[:-1]]) * steps, (steps - step) * parts
            # of each family the rows of earlier intervals come first
            rows = [np.arange(top + step * part, top + steps * part) for top, part in zip(starts, parts, strict=True)]
            assert len(later) == counts.sum()
            added[step, np.concatenate(rows)] = later
        return added

    def _stretch_rows(self, lifetime: WholeLifetime, layout: Layout, intervals: range) -> StretchedRows:
        period = slice(intervals.start, intervals.stop)
        rate, factor = lifetime.rate[period], lifetime.factor[:, period]
        key = ("stretched", lifetime.node.id, (rate * factor).tobytes(), layout.pieces, layout.degree)
        return self.cache.value(key, lambda: StretchedRows(lifetime.chain, rate, factor, layout))

    def _chain_kernels(
        self, lifetime: WholeLifetime, layout: Layout, initial: Floats, intervals: range
    ) -> tuple[Any, Any, Floats]:
        """Return c̲ and c̄ of what leaves a chain, sparse, and what leaves of what is there at the start."""
        kernel, count = self._kernel(lifetime, layout, intervals), len(intervals) * len(layout.moments)
        low, high = (sparse.csr_array(bound.reshape(count, count)) for bound in (kernel.low, kernel.high))
        return low, high, (kernel.start_outflow @ lifetime.masses(initial)).ravel()

    def _kernel(self, lifetime: WholeLifetime, layout: Layout, intervals: range) -> Kernel:
        rate = lifetime.rate[intervals.start : intervals.stop]
        key = ("kernel", lifetime.node.id, rate.tobytes(), layout.pieces, layout.degree)
        by_piece = np.repeat(rate, layout.pieces)
        return self.cache.value(key, lambda: Kernel(lifetime.chain, by_piece, layout.length, layout.degree))

    def _bounds_stock(self, lifetime: WholeLifetime, layout: Layout) -> bool:
        """Whether bounds of what leaves are so far apart that what is left is bounded too.

        A life that is neither stretched nor cut decides, so that rows are the same however long lives turn out.
        """
        if not len(lifetime.rate):
            return False
        assert lifetime.node.lifetime is not None
        mean, length = lifetime.node.lifetime.mean, layout.length
        count = min(MOST_PIECES, math.ceil(2 * mean / length))
        return self._looseness(lifetime, lifetime.chain.rate / mean, count, length, layout.degree) > FAR

    def _line_kernels(
        self, lifetime: WholeLifetime, layout: Layout, initial: Floats, intervals: range
    ) -> tuple[Any, Any, Floats]:
        """Return the same of a fixed lifetime, out of which comes the mean inflow of one interval."""
        slots = lifetime.slots(initial)
        steps, moments, delay = len(intervals), len(layout.moments), len(slots)
        from_start = np.zeros((steps, moments))
        from_start[:delay] = slots[:steps, None] / self.network.episode.control_interval
        shift = sparse.eye_array(steps, k=-delay) if delay < steps else sparse.csr_array((steps, steps))
        kernel = sparse.csr_array(sparse.kron(shift, np.full((moments, moments), 1.0 / moments)))
        return kernel, kernel, from_start.ravel()


def _is_stock(lifetime: Lifetime | None) -> bool:
    """Whether a life is that of a stock that leaves in proportion to itself: one stage, into which all enters."""
    chain = None if lifetime is None else lifetime.chain
    return chain is not None and chain.stages == 1 and chain.weights[0] == 0


def _column_sums(columns: Integers, width: int) -> Any:
    """Return the matrix of ``width`` columns that adds up those given for each row, shape (rows, some)."""
    rows = np.repeat(np.arange(len(columns)), columns.shape[1])
    return sparse.csr_array((np.ones(columns.size), (rows, columns.ravel())), shape=(len(columns), width))


def _sums(fine: Network, coarse: Network) -> Any:
    """Return what the nodes of one writing of a network are of those of another that is written out further."""
    stages = fine.stages if isinstance(fine, StagedNetwork) else {}
    components: dict[str, list[str]] = {}
    for node in fine.nodes:
        own = node.id if isinstance(coarse, ComponentNetwork) else fine.original(node.id)
        components.setdefault(own, []).append(node.id)
    whole = coarse.stages if isinstance(coarse, StagedNetwork) else {}
    sums = sparse.lil_array((len(coarse.nodes), len(fine.nodes)))
    for i, node in enumerate(coarse.nodes):
        for part in (node.id,) if len(whole.get(node.id, ())) > 1 else stages.get(node.id, (node.id,)):
            for component in components[part]:
                sums[i, fine.node_index[component]] = 1.0
    return sparse.csr_array(sums)
