"""What leaves at the end of uncontrolled lifetimes, from what entered and when: rows without stages.

What leaves a chain of stages is linear in what has entered it, u, and in what it held at the start. Weighted with B_i
over a piece p it is ::

    L_i = known_i + w_0 U_i + (d + 1)/δ · Σ_q ∫_q k_pi(τ) u(τ) dτ,    k_pi(τ) = ∫_p B_i(t) μ e_Kᵀ Φ(t, τ) E dt,

over the pieces q up to p, with Φ the motion of the stages and E how an inflow enters them. Each k is smooth on a piece
and not negative. Polynomials of degree d enclose it there, c̲_j and c̄_j being their Bernstein coefficients, and as u is
not negative, neither are any of the means in

    known_i + w_0 U_i + Σ_q Σ_j c̲_j U_qj ≤ L_i ≤ known_i + w_0 U_i + Σ_q Σ_j c̄_j U_qj

(theorem 4 of docs/bound.md). What leaves a fixed lifetime is the mean inflow of one interval, or known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from scipy import sparse

from cirl_marl.dynamics.laws import ArcRates
from cirl_marl.dynamics.stages import StagedNetwork, simulated_network, staged_network
from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Node
from cirl_marl.optimum.kernels import Kernel, released
from cirl_marl.optimum.matrices import Layout

LOOSE = 2e-4
"""Distance of the bounds of what leaves, relative to it, above which intervals have more pieces."""


@dataclass(frozen=True, slots=True)
class PassiveLifetime:
    """A lifetime that nobody controls.

    Attributes:
        node: whose it is.
        rows: of its stages, or slots, among the stocks of the simulator.
        leaving: the arc of the planned network through which what has lived goes.
        entering: its arcs through which something enters.
        rate: μ in each interval, shape (steps,), 1/time; empty for a fixed one.
        at_once: w_0, part of what enters that leaves at once.
        reached_node: the node, or its last stage, among the nodes of ``reached``.
        reached_entry: where what enters is among them; the node itself of a fixed one.
        reached_arc: ``leaving`` among its arcs.
    """

    node: Node
    rows: Integers
    leaving: int
    entering: Integers
    rate: Floats
    at_once: float
    reached_node: int
    reached_entry: int
    reached_arc: int

    def slots(self, initial: Floats) -> Floats:
        """Return what is in the slots of a fixed lifetime, first what comes out first, of all stocks, mass."""
        held = initial[self.rows]
        # what rounding left of what came out before comes with the oldest
        return np.concatenate([[held[-2] + held[-1]], held[-3::-1]])


class Lifetimes:
    """A network as its program sees it: controlled lifetimes as chains, the others whole.

    Attributes:
        network: as it is given.
        planned: as the program has it.
        reached: as stocks are bounded, all lifetimes but fixed ones being chains.
        passive: the lifetimes that nobody controls.
    """

    def __init__(self, network: Network, acting: Sequence[str]) -> None:
        """Compile the lifetimes of ``network`` while ``acting`` act."""
        self.network = network
        living = [node for node in network.stores if node.lifetime is not None]
        whole = [node for node in living if not (node.id in acting and node.control is not None)]
        fixed = [node.id for node in whole if node.lifetime is not None and node.lifetime.chain is None]
        self.planned: Network = staged_network(network, {node.id for node in whole}) if living else network
        self.reached: Network = staged_network(network, fixed) if living else network
        self._written = simulated_network(network)
        rows = StateLayout(self._written)
        self.stocks = rows.nodes.stop
        neutral = network.control_bounds[1]
        self.passive: list[PassiveLifetime] = []
        for node in whole:
            assert node.lifetime is not None and isinstance(self.planned, StagedNetwork)
            place, chain, planned = network.node_index[node.id], node.lifetime.chain, self.planned
            rate = np.zeros(0)
            if chain is not None:
                rate = chain.rate / node.lifetime.mean / network.interval_means(node.stretch)
                if node.control is not None:
                    rate = rate / neutral[network.control_rows[node.id].start]
            self.passive.append(
                PassiveLifetime(
                    node=node,
                    rows=rows.stages.get(place, np.array([place])),
                    leaving=planned.arc_index[planned.release_arcs[node.id]],
                    entering=np.flatnonzero(planned.recipients == planned.node_index[node.id]),
                    rate=rate,
                    at_once=0.0 if chain is None else chain.weights[0],
                    reached_entry=self.reached.node_index[node.id if chain is None else f"{node.id}.entry"],
                    reached_node=self.reached.node_index[node.id],
                    reached_arc=self.reached.arc_index[planned.release_arcs[node.id]],
                )
            )
        self._known: dict[tuple[str, bytes, int], Kernel] = {}

    @cached_property
    def leaving(self) -> Integers:
        """Arcs of the planned network that come out of lifetimes that nobody controls."""
        return np.array([each.leaving for each in self.passive], dtype=np.intp)

    def pieces(self, degree: int, most: int) -> int:
        """Return the pieces of an interval, at most ``most``, in which stocks turn over once and kernels are smooth."""
        interval = self.network.episode.control_interval
        turnover = ArcRates(self.planned).turnover
        driven = [each for each in self.passive if len(each.rate)]
        for each in driven:
            turnover[self.planned.donors[each.leaving]] = 0.0
        pieces = max(1, math.ceil(interval * float(turnover.max(initial=0.0)) - 1e-9))
        for each in driven:
            while pieces < most and self._looseness(each, pieces, degree) > LOOSE:
                pieces += 1
        return min(pieces, most)

    def _looseness(self, each: PassiveLifetime, pieces: int, degree: int) -> float:
        """Return how far bounds of what leaves are apart, relative to it, where as much enters all the time."""
        assert each.node.lifetime is not None and each.node.lifetime.chain is not None
        count = pieces * self.network.episode.horizon
        rate = np.full(count, each.rate.max())
        kernel = Kernel(each.node.lifetime.chain, rate, self.network.episode.control_interval / pieces, degree)
        low, high = (bound[-1].sum(axis=(1, 2)) for bound in (kernel.low, kernel.high))
        return float(((high - low) / high).max())

    @cached_property
    def start_planned(self) -> Any:
        """What the stores of the planned network hold of the stocks of the simulator, shape (stores, stocks)."""
        return _sums(self._written, self.planned)[: len(self.planned.stores), : self.stocks]

    @cached_property
    def start_reached(self) -> Any:
        """What the stores of ``reached`` hold of them, shape (stores, stocks)."""
        return _sums(self._written, self.reached)[: len(self.reached.stores), : self.stocks]

    @cached_property
    def nodes_reached(self) -> Any:
        """What the nodes of the planned network are of those of ``reached``, shape (nodes, nodes)."""
        return _sums(self.reached, self.planned)

    @cached_property
    def arcs_reached(self) -> Integers:
        """Arcs of ``reached`` that are those of the planned network, shape (arcs,)."""
        return np.array([self.reached.arc_index[arc.id] for arc in self.planned.arcs], dtype=np.intp)

    @cached_property
    def totals(self) -> Any:
        """What the stocks of the network are of those of the planned one, shape (stores, stores)."""
        return _sums(self.planned, self.network)[: len(self.network.stores), : len(self.planned.stores)]

    def rows(self, layout: Layout, initial: Floats, intervals: range) -> tuple[Any, Floats]:
        """Return the rows G v ≤ g of all lifetimes that nobody controls, and g.

        Args:
            layout: of the variables of the planned network.
            initial: stocks of the simulator at the start, shape (stocks,), mass.
            intervals: of the episode, one after the other.
        """
        blocks: list[Any] = [sparse.csr_array((0, layout.size * len(intervals)))]
        limits = [np.zeros(0)]
        for each in self.passive:
            write = self._of_line if each.node.lifetime is None or not len(each.rate) else self._of_chain
            matrix, to = write(each, layout, initial, intervals)
            blocks.append(matrix)
            limits.append(to)
        return sparse.vstack(blocks, format="csr"), np.concatenate(limits)

    def of_new(self, each: PassiveLifetime, layout: Layout) -> Floats:
        """Return what leaves of a unit of mass that is new in a stock at the start of each interval of an episode.

        In a fixed lifetime it counts as what entered in the interval before.

        Returns:
            Its means by moment, in the order of the first half of the lifetime's rows, 1/time, shape
            (steps, steps · moments).
        """
        steps, moments = self.network.episode.horizon, len(layout.moments)
        lifetime = each.node.lifetime
        assert lifetime is not None
        if not len(each.rate):
            delay = len(each.rows) - 1
            out = np.kron(np.eye(steps, k=delay - 1), np.ones((1, moments)))
            return np.asarray(out / self.network.episode.control_interval, dtype=float)
        assert lifetime.chain is not None
        found = released(lifetime.chain, np.repeat(each.rate, layout.pieces), layout.length, layout.degree)
        return found[:: layout.pieces].reshape(steps, -1)

    def _of_chain(self, each: PassiveLifetime, layout: Layout, initial: Floats, intervals: range) -> tuple[Any, Floats]:
        assert each.node.lifetime is not None and each.node.lifetime.chain is not None
        during = each.rate[intervals.start : intervals.stop]
        key = (each.node.id, during.tobytes(), layout.pieces)
        if key not in self._known:
            chain = each.node.lifetime.chain
            self._known[key] = Kernel(chain, np.repeat(during, layout.pieces), layout.length, layout.degree)
        kernel = self._known[key]
        known = (kernel.known @ initial[each.rows]).ravel()
        leaving, entering = _columns(each, layout, len(intervals))
        out = _picked(leaving[:, None], layout.size * len(intervals))
        into = _picked(entering, layout.size * len(intervals))
        count = len(leaving)
        low, high = (sparse.csr_array(bound.reshape(count, count)) for bound in (kernel.low, kernel.high))
        return sparse.vstack([out - high @ into, low @ into - out], format="csr"), np.concatenate([known, -known])

    def _of_line(self, each: PassiveLifetime, layout: Layout, initial: Floats, intervals: range) -> tuple[Any, Floats]:
        slots = each.slots(initial)
        steps, moments, delay = len(intervals), len(layout.moments), len(slots)
        leaving, entering = _columns(each, layout, steps)
        known = np.zeros((steps, moments))
        known[:delay] = slots[:steps, None] / self.network.episode.control_interval
        out = _picked(leaving[:, None], layout.size * steps)
        into = _picked(entering, layout.size * steps)
        shifted = sparse.eye_array(steps, k=-delay) if delay < steps else sparse.csr_array((steps, steps))
        earlier = sparse.kron(shifted, np.full((moments, moments), 1.0 / moments))
        matrix = out - sparse.csr_array(earlier) @ into
        return sparse.vstack([matrix, -matrix], format="csr"), np.concatenate([known.ravel(), -known.ravel()])


def _columns(each: PassiveLifetime, layout: Layout, steps: int) -> tuple[Integers, Integers]:
    """Return the columns of what leaves, shape (moments of all,), and of what enters, shape (moments of all, arcs)."""
    moments = layout.flow
    first = (layout.size * np.arange(steps)[:, None] + moments).ravel()
    return first + each.leaving, first[:, None] + each.entering


def _picked(columns: Integers, width: int) -> Any:
    """Return the matrix that adds up columns, of shape (rows, some)."""
    rows = np.repeat(np.arange(len(columns)), columns.shape[1])
    return sparse.csr_array((np.ones(columns.size), (rows, columns.ravel())), shape=(len(columns), width))


def _sums(given: Network, wanted: Network) -> Any:
    """Return what the nodes of one writing of a network are of those of another that is written out further."""
    stages = given.stages if isinstance(given, StagedNetwork) else {}
    whole = wanted.stages if isinstance(wanted, StagedNetwork) else {}
    found = sparse.lil_array((len(wanted.nodes), len(given.nodes)))
    for i, node in enumerate(wanted.nodes):
        for part in (node.id,) if len(whole.get(node.id, ())) > 1 else stages.get(node.id, (node.id,)):
            found[i, given.node_index[part]] = 1.0
    return sparse.csr_array(found)
