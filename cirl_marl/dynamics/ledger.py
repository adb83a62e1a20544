"""What an interval costs, emits or needs: amounts on accounts, read off mean flows, stocks and controls.

An interval of length h books a·f̄·h for each mass that flows along an arc, or enters a node, and b·(x + x')/2·h for
what a node holds, x and x' being its stock at the start and at the end. Both are linear in flows and stocks, so that
programs bound them exactly. For a control u that is not at its neutral value n it books e·|u − n|·h, which is convex
(``optimum.effort``), and so is an *excess*, what a rate in pieces adds for all beyond an amount (``optimum.excess``).
Nothing that is booked changes what moves.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import count

import numpy as np

from cirl_marl.dynamics.uncertain_factors import RowFactors
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import Rates, declarations
from cirl_marl.network.elements import Rate
from cirl_marl.network.piecewise import PiecewiseRate
from cirl_marl.network.rowsum import RowSum
from cirl_marl.network.series import Series
from cirl_marl.network.units import factor


class Ledger:
    """The entries of the accounts of a network: one for each rate that a compartment states, or each piece of one.

    Attributes:
        accounts: ids of the accounts.
        regions: that entries are of, of networks of copies.
        compartments: id of the compartment that each entry is of.
        account: position of the account of each entry, shape (entries,).
        discount: by which amounts of each interval are multiplied in totals, shape (accounts, horizon).
        has_efforts: whether anything is booked for controls.
        excesses: entries that count but what is more than an amount, shape (excesses,).
        amounts: up to which these count nothing: mass/time, mass or in the unit of a control, shape (excesses, 1).
    """

    def __init__(self, network: Network, ranges: Mapping[str, tuple[float, float]] | None = None) -> None:
        """Find them; ``ranges`` are of all factors on numbers that are not certain, None if there are none."""
        self._network, numbers = network, {path: row for row, path in enumerate(ranges or ())}
        self.accounts = tuple(account.id for account in network.accounts)
        self._interval = network.episode.control_interval
        inflows: list[list[int]] = [[] for _ in network.nodes]
        for k, recipient in enumerate(network.recipients.tolist() if self.accounts else ()):
            inflows[recipient].append(k)
        arcs, stores, entries = len(network.arcs), len(network.stores), []
        groups = (("nodes", network.nodes), ("arcs", network.arcs)) if self.accounts else ()
        for kind, parts in groups:
            for i, part in enumerate(parts):
                for name, declaration in declarations(type(part)).items():
                    if not isinstance(declaration, Rates) or declaration.of != "account":
                        continue
                    subjects = {"mass": inflows[i] if kind == "nodes" else [i], "stock": [arcs + i]}
                    if declaration.per == "control" and part.control is not None:
                        rows = network.control_rows[part.id]
                        subjects["control"] = [arcs + stores + row for row in range(rows.start, rows.stop)]
                    for account, rate in getattr(part, name):
                        path, place = f"{kind}.{part.id}.{name}.{account}", self.accounts.index(account)
                        for amount, piece in _pieces(network, rate):
                            entry = part.id, place, subjects[declaration.per], piece, numbers.get(path), amount
                            entries.append(entry)
        self.compartments = tuple(entry[0] for entry in entries)
        self.account: Integers = np.array([entry[1] for entry in entries], dtype=np.intp)
        places = [(row, column) for row, entry in enumerate(entries) for column in entry[2]]
        rows_of_entries, columns = self._places = np.array(places, dtype=np.intp).reshape(-1, 2).T
        self.has_efforts = bool((columns >= arcs + stores).any())
        self.excesses: Integers = np.array([row for row, entry in enumerate(entries) if entry[5]], dtype=np.intp)
        self.amounts: Floats = np.array([entries[row][5] for row in self.excesses.tolist()]).reshape(-1, 1)
        controls = network.control_bounds.shape[1] if self.has_efforts else 0
        self._charged = RowSum(rows_of_entries, columns, 1.0, (len(entries), arcs + stores + controls))
        self._by_account = RowSum(self.account, range(len(entries)), 1.0, (len(self.accounts), len(entries)))
        regions = [network.region_of(compartment) for compartment in self.compartments]
        self.regions = tuple(sorted({*regions} - {""}))
        of_regions: Integers = np.flatnonzero([bool(region) for region in regions])
        ranks = np.array([self.regions.index(region) for region in regions if region], dtype=np.intp)
        shape = len(self.regions) * len(self.accounts), len(entries)
        cells = ranks * len(self.accounts) + self.account[of_regions]
        self._by_region = RowSum(cells, of_regions, 1.0, shape)
        horizon = network.episode.horizon
        rates = [entry[3] for entry in entries]
        table = np.array(rates).reshape(len(entries), horizon)
        constant = all(rate.strides[-1] == 0 for rate in rates)
        self._rates = table[:, :1] if constant else table
        self._factors = RowFactors({row: entry[4] for row, entry in enumerate(entries) if entry[4] is not None})
        middle = (np.arange(horizon) + 0.5) * self._interval * factor(network.time_unit, "year")
        growth = np.array([1.0 + account.discount for account in network.accounts]).reshape(-1, 1)
        self.discount: Floats = growth**-middle

    def entries(
        self,
        flow: Floats,
        before: Floats,
        after: Floats,
        deviation: Floats | None,
        step: Integers,
        factors: Floats | None = None,
    ) -> Floats:
        """Return the amount of each entry in the interval ``step`` of each copy, not discounted, shape (entries, B).

        Args:
            flow: mean flows, shape (arcs, B), mass/time.
            before: stocks at the start, shape (stores, B), mass.
            after: stocks at the end, likewise.
            deviation: of the controls from their neutral values, shape (controls, B); None without ``has_efforts``.
            step: the interval, shape (B,).
            factors: those on numbers that are not certain, shape (numbers, B).
        """
        rates = self._factors(self._rates_in(step), factors)
        return self._amounts(flow, (before + after) / 2, deviation) * rates * self._interval

    def _amounts(self, flow: Floats, stock: Floats, deviation: Floats | None) -> Floats:
        """Return what each entry is charged for, shape (entries, B)."""
        subjects = self._subjects(flow, stock, deviation)
        if len(self.excesses):
            subjects[self.excesses] = np.maximum(subjects[self.excesses] - self.amounts, 0.0)
        return subjects

    def _subjects(self, flow: Floats, stock: Floats, deviation: Floats | None) -> Floats:
        """Return what each entry is of, whole even of excesses, shape (entries, B)."""
        return self._charged(np.concatenate([flow, stock] if deviation is None else [flow, stock, abs(deviation)]))

    def _rates_in(self, step: Integers) -> Floats:
        """Return the rate of each entry in the interval ``step`` of each copy, as it is stated."""
        return self._rates if self._rates.shape[1] == 1 else self._rates.take(step, axis=1)

    def pull_back(
        self,
        adjoint: Floats,
        flow: Floats,
        stock: Floats,
        deviation: Floats | None,
        step: Integers,
        factors: Floats | None,
        factor_adjoint: Floats | None,
    ) -> tuple[Floats, Floats, Floats | None]:
        """Return derivatives by mean flows, mean stocks and controls of those by discounted amounts, (accounts, B).

        That of a distance is 0 where a control is neutral, that of an excess 0 where it begins. Those by the factors on
        rates are added to ``factor_adjoint``.
        """
        rates = self._rates_in(step)
        per_entry = (adjoint * self.discount.take(step, axis=1)).take(self.account, axis=0) * self._interval
        if factors is not None and factor_adjoint is not None:
            table = np.broadcast_to(rates, per_entry.shape) * self._amounts(flow, stock, deviation)
            self._factors.pull_back(table, per_entry, factor_adjoint)
        by_subject = per_entry * self._factors(rates, factors)
        if len(self.excesses):
            by_subject[self.excesses] *= self._subjects(flow, stock, deviation)[self.excesses] > self.amounts
        by_charged = self._charged.transpose()(by_subject)
        by_flow, by_stock, by_distance = np.split(by_charged, [len(flow), len(flow) + len(stock)])
        return by_flow, by_stock, None if deviation is None else by_distance * np.sign(deviation)

    def sums(self, entries: Floats) -> Floats:
        """Return the amount on each account, shape (accounts, B), of those of entries."""
        return self._by_account(entries)

    def regional_sums(self, entries: Floats) -> Floats:
        """Return what each region books on each account, shape (regions, accounts, B), of amounts of entries."""
        return self._by_region(entries).reshape(len(self.regions), len(self.accounts), entries.shape[1])

    def rates(self, *, with_discount: bool = True) -> tuple[Floats, Floats, Floats]:
        """Return what totals have of mean flows, of mean stocks, and of convex parts in each interval.

        Shapes are (accounts, horizon, arcs), (accounts, horizon, stores) and (accounts, horizon, controls + excesses),
        in amounts per mass/time, per mass, and per unit of the distance of a control, or of an excess; without
        ``has_efforts`` there are no controls.
        """
        horizon, arcs = self.discount.shape[1], len(self._network.arcs)
        stocks = slice(arcs, arcs + len(self._network.stores))
        width = self._charged.shape[1]
        table = np.zeros((len(self.accounts), horizon, width + len(self.excesses)))
        rates = np.broadcast_to(self._rates, (len(self._rates), horizon))
        is_whole = ~np.isin(self._places[0], self.excesses)
        places = [*self._places[:, is_whole].T.tolist(), *zip(self.excesses.tolist(), count(width), strict=False)]
        for row, column in places:
            table[self.account[row], :, column] += rates[row]
        table *= ((self.discount if with_discount else np.ones_like(self.discount)) * self._interval)[:, :, None]
        return table[..., :arcs], table[..., stocks], table[..., stocks.stop :]

    @property
    def excess_subjects(self) -> tuple[Floats, Floats, Floats]:
        """What each excess is of: shapes (excesses, arcs), (excesses, stores) and (excesses, controls)."""
        rows, columns = self._places[:, np.isin(self._places[0], self.excesses)]
        table = np.zeros((len(self.excesses), self._charged.shape[1]))
        table[np.searchsorted(self.excesses, rows), columns] = 1.0
        arcs = len(self._network.arcs)
        by_flow, by_stock, by_control = np.split(table, [arcs, arcs + len(self._network.stores)], axis=1)
        return by_flow, by_stock, by_control

    def convex_parts(self, flow: Floats, stock: Floats, deviation: Floats | None) -> Floats:
        """Return distances of controls, if there are efforts, and excesses, shape (controls + excesses, B)."""
        excess = self._amounts(flow, stock, deviation)[self.excesses]
        return excess if deviation is None else np.concatenate([abs(deviation), excess])


def _pieces(network: Network, rate: Rate) -> Iterator[tuple[float, Floats]]:
    """Give the amount beyond which each piece of a rate counts, and what it adds in each interval, shape (horizon,)."""
    if not isinstance(rate, PiecewiseRate):
        yield 0.0, network.interval_means(rate)
        return
    for amount, step in zip((0.0, *rate.to), (rate.rates[0], *rate.rises), strict=True):
        if isinstance(rate.factor, Series):
            yield amount, step * network.interval_means(rate.factor)
        else:
            yield amount, network.interval_means(step * rate.factor)
