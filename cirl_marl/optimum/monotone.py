"""How fast a stock can fall: inequalities between its weighted means, and between those of the flows it drives.

Within a piece ẋ ≥ −k x − U, with k the greatest rate of the proportional exits and U the scheduled outflow, so
y(s) = e^{ks} (x(s) + U (1 − e^{−ks})/k) never falls. Weighted with B_i(s) e^{−ks} its means rise with i (theorem 2 of
docs/bound.md)::

    x_start ≤ X̃_0/ω_0 ≤ … ≤ X̃_d/ω_d ≤ x̃_end/e^{−kδ},    X̃_i = X_i + U η_i,

with ω_i the mean of e^{−ks} and η_i that of (1 − e^{−ks})/k, weighted with B_i. Controls are constant within a piece,
so (w − w̲)·x and (w̄ − w)·x obey the same, with U times the range of w.
"""

from __future__ import annotations

import numpy as np
from scipy import special

from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout, Link, MatrixRow, start_of


def falls(admissible: Admissible, layout: Layout) -> list[Link]:
    """Return the rows, each at most 0, on this interval's variables and on those of the one before."""
    network = admissible.network
    by_donor = admissible.driver == network.donors
    rates = admissible.rate(0)[1] * by_donor
    fastest = np.bincount(network.donors, weights=rates, minlength=len(network.nodes))
    pulled = set(network.donors[~admissible.scheduled & ~by_donor].tolist())
    links: list[Link] = []
    for node in sorted(set(admissible.driver[~admissible.scheduled].tolist()) - pulled):
        means, delays = _decay(float(fastest[node]), layout.length, layout.degree)
        orders = np.flatnonzero(admissible.scheduled & (network.donors == node))
        for piece in range(layout.pieces):
            chain = _Chain(layout, piece, means, delays, [int(k) for k in orders])
            links.extend(chain.of_stock(node))
            for row, spread in _driven(admissible, layout, node):
                links.extend((between, []) for between in chain.between(row, spread))
    return links


def _decay(rate: float, length: float, degree: int) -> tuple[Floats, Floats]:
    """Return ω_0 … ω_d, e^{−kδ} and η_0 … η_d, (1 − e^{−kδ})/k; ω_i = ₁F₁(i + 1; d + 2; −kδ)."""
    i = np.arange(degree + 1)
    turned_over = rate * length
    means = np.append(special.hyp1f1(i + 1, degree + 2, -turned_over), np.exp(-turned_over))
    if turned_over < 1e-6:  # x + U·s in place of x + U (1 − e^{−ks})/k serves for every k ≥ 0, and is a little weaker
        return means, np.append((i + 1) / (degree + 2), 1.0) * length
    return means, (1.0 - means) / rate


def _driven(admissible: Admissible, layout: Layout, node: int) -> list[tuple[list[tuple[int, float]], float]]:
    """Return (w − w̲)·x and (w̄ − w)·x for each factor w of ``node``'s stock that is free, and the largest w̄ − w̲.

    Each is a list of (offset from the first of the moment's variables, weight).
    """
    network = admissible.network
    stock, valve = layout.stock(0) + node, admissible.valve[:, node]
    found: list[tuple[list[tuple[int, float]], float]] = []

    def add(column: int, driver: int, low: float, high: float, scale: float) -> None:
        if low < high:
            found.append(([(column, 1.0), (driver, -low)], (high - low) * scale))
            found.append(([(column, -1.0), (driver, high)], (high - low) * scale))

    through = np.flatnonzero(layout.valves == node)
    for z in through:
        add(layout.valve(0) + int(z), stock, valve[0], valve[1], 1.0)
    for k in np.flatnonzero(admissible.driver == node):
        via = len(through) > 0 and network.donors[k] == node
        factor = (admissible.own if via else admissible.factor)[:, k] * admissible.base[0, k]
        driver = layout.valve(0) + int(through[0]) if via else stock
        add(layout.flow(0) + int(k), driver, factor[0], factor[1], valve[1] if via else 1.0)
    return found


class _Chain:
    """Writes that weighted means of something which falls at most like e^{−ks}, but for U, rise with i."""

    def __init__(self, layout: Layout, piece: int, means: Floats, delays: Floats, orders: list[int]) -> None:
        self.layout, self.piece, self.orders = layout, piece, orders
        self.means, self.delays = means, delays
        self.first = piece * (layout.degree + 1)

    def of_stock(self, node: int) -> list[Link]:
        """Return the chain of a stock from the start of the piece to its end."""
        layout = self.layout
        start, before = start_of(layout, self.piece, node, self.means[0])
        now = [*start, (layout.stock(self.first) + node, -1.0), *self._orders(-self.delays[0])]
        links: list[Link] = [(now, before)]
        links.extend((row, []) for row in self.between([(layout.stock(0) + node, 1.0)], 1.0))
        d = layout.degree
        ratio = self.means[d + 1] / self.means[d]  # (X_d + U η_d)/ω_d ≤ (x_end + U η_end)/e^{−kδ}, times e^{−kδ}
        end: MatrixRow = [(layout.stock(self.first + d) + node, ratio), (layout.end(self.piece) + node, -1.0)]
        links.append(([*end, *self._orders(ratio * self.delays[d] - self.delays[d + 1])], []))
        return links

    def between(self, row: list[tuple[int, float]], spread: float) -> list[MatrixRow]:
        """Return ω_{i+1}/ω_i·q_i − q_{i+1} − spread·U·(…) for the combination q that ``row`` describes."""
        rows: list[MatrixRow] = []
        for i in range(self.layout.degree):
            # (q_i + U η_i)/ω_i ≤ (q_{i+1} + U η_{i+1})/ω_{i+1}, times ω_{i+1}
            ratio = self.means[i + 1] / self.means[i]
            here, there = (self.layout.stock(self.first + i + step) for step in (0, 1))
            terms = [(here + column, ratio * weight) for column, weight in row]
            terms += [(there + column, -weight) for column, weight in row]
            rows.append([*terms, *self._orders(spread * (ratio * self.delays[i] - self.delays[i + 1]))])
        return rows

    def _orders(self, weight: float) -> MatrixRow:
        return [(self.layout.flow(self.first) + k, weight) for k in self.orders]
