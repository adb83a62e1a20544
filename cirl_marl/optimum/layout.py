"""Where the variables of the linear program lie."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeVar

import numpy as np

from cirl_marl.network import Floats, Integers, Network

Place = TypeVar("Place", int, Integers)


@dataclass(frozen=True)
class Layout:
    """Where the variables of one interval lie.

    For each piece X_i, F_i and Z_i for i = 0 … d, then the stocks at its end; after the last piece, the levels, the
    imbalance and the valves. Of a node that stores nothing X_i is its throughput, and there is no stock at the end. At
    the end of merged pieces are throughputs and flows, too, under the controls of their interval.
    Z_i = v·X_i is what the valve of a node lets through to several outflows. Moments are counted through all pieces.

    Attributes:
        network: whose variables they are.
        pieces: equal parts of an interval.
        coarse: whether pieces are longer than the substeps of the simulator, within which scheduled flows are constant.
        merged: whether they are, and stand for all that happens in them.
        degree: d.
        valves: nodes that have a Z.
        openings: nodes of these with scheduled outflows, on which the valve acts as well; v is then a variable.
    """

    network: Network
    pieces: int
    coarse: bool
    merged: bool
    degree: int
    valves: Integers
    openings: Integers

    @cached_property
    def moments(self) -> range:
        """All Bernstein indices of an interval, piece after piece."""
        return range(self.pieces * (self.degree + 1))

    @cached_property
    def moment_column(self) -> Integers:
        """The same as an array of shape (moments, 1), to be laid against nodes or arcs."""
        return np.arange(len(self.moments))[:, None]

    @cached_property
    def piece(self) -> int:
        """Variables of a piece."""
        means = len(self.network.nodes) + len(self.network.arcs) + len(self.valves)
        return (self.degree + 1) * means + self._ends

    @cached_property
    def _ends(self) -> int:
        """Variables about the end of a piece."""
        return len(self.network.nodes) + len(self.network.arcs) if self.merged else len(self.network.stores)

    @property
    def length(self) -> float:
        """Length of a piece, δ."""
        return self.network.episode.control_interval / self.pieces

    @property
    def portion(self) -> float:
        """Length of a piece over d + 1, the integral of each test polynomial."""
        return self.network.episode.control_interval / len(self.moments)

    def stock(self, moment: Place) -> Place:
        """Return the first of the weighted mean stocks X, then throughputs."""
        # each piece: d + 1 blocks of (X, F, Z), equally long, then the stocks at its end
        piece, i = divmod(moment, self.degree + 1)
        return piece * self.piece + i * ((self.piece - self._ends) // (self.degree + 1))

    def flow(self, moment: Place) -> Place:
        """Return the first of the weighted mean flows F."""
        return self.stock(moment) + len(self.network.nodes)

    def valve(self, moment: Place) -> Place:
        """Return the first of Z."""
        return self.flow(moment) + len(self.network.arcs)

    def end(self, piece: Place) -> Place:
        """Return the first of the stocks at the end of a piece; −1 is the last."""
        return (piece % self.pieces + 1) * self.piece - self._ends

    @property
    def last(self) -> slice:
        """The stocks at the end of the interval."""
        return slice(self.end(-1), self.end(-1) + len(self.network.stores))

    def end_flow(self, piece: Place) -> Place:
        """Return the first of the flows at the end of a merged piece, which stand behind the throughputs."""
        return self.end(piece) + len(self.network.nodes)

    @property
    def level(self) -> int:
        """The first of the service levels."""
        return self.pieces * self.piece

    @property
    def imbalance(self) -> int:
        """The variable that is at least |Δ·σ_env·f̄|; counted only with ``net_zero = "abs"``."""
        return self.level + len(self.network.services)

    @property
    def opening(self) -> int:
        """The first of the valves v themselves."""
        return self.imbalance + 1

    @property
    def size(self) -> int:
        """Variables of an interval."""
        return self.opening + len(self.openings)

    def means(self, planned: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the plain means of X, F and Z over each interval, shape (steps, nodes | arcs | valves)."""
        counts = (len(self.network.nodes), len(self.network.arcs), len(self.valves))
        parts = []
        for first, count in zip((self.stock, self.flow, self.valve), counts, strict=True):
            parts.append(np.mean([planned[:, first(j) : first(j) + count] for j in self.moments], axis=0))
        return parts[0], parts[1], parts[2]
