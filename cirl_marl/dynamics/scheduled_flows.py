"""Scheduled flows: their cuts where a donor could be overdrawn, and the components that they carry.

In a network with substances what is asked for is of the whole. It carries each component c in the part x_c/Σx that it
has of the donor's stock at the start of the substep: f_c = f·x_c/Σx.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cirl_marl.dynamics.components import ComponentNetwork
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.rowsum import NEGLIGIBLE, RowSum

KEPT = 1.0 - 1e-12
"""Part of what can be delivered that is delivered, so that rounding overdraws nothing."""


class Loads:
    """Which components scheduled flows carry.

    Attributes:
        substances: sums of the substances that donors hold, shape (donors, stores).
    """

    def __init__(
        self, network: Network, orders: Sequence[int], donors: Integers, arcs: int, stores: int, components: int
    ) -> None:
        """Take the arcs that are asked for, in copies of ``arcs`` and ``stores``, and the donors of scheduled flows."""
        part, of_orders = np.arange(components)[:, None], np.array(orders, dtype=np.intp)
        order_donors = network.donors[of_orders]
        self._arcs: Integers = (of_orders + part * arcs).ravel()
        self._orders: Integers = np.tile(of_orders, components)
        self._rows: Integers = (order_donors + part * stores).ravel()
        self._places: Integers = np.tile(np.searchsorted(donors, order_donors), components)
        wholes = np.flatnonzero(np.isin(donors, order_donors))
        rows = (donors[wholes] + part[1:] * stores).ravel()
        shape = (len(donors), stores * components)
        self.substances = RowSum(np.tile(wholes, components - 1), rows, 1.0, shape)

    def share_out(self, stock: Floats, available_stock: Floats, rate: Floats) -> Floats:
        """Return the rates, shape (arcs, B), with those of the copies of an order f, which are f·x_c/Σx."""
        content = stock.take(self._rows, axis=0) * self._per_stock(available_stock)
        rates = rate.copy()
        rates[self._arcs] = rate.take(self._orders, axis=0) * content
        return rates

    def pull_back(
        self,
        stock: Floats,
        available_stock: Floats,
        rate: Floats,
        adjoint: Floats,
        stock_adjoint: Floats,
        whole_adjoint: Floats,
    ) -> None:
        """Turn, in place, the adjoint of what ``share_out`` returned into that of orders, stocks and whole stocks."""
        per_stock = self._per_stock(available_stock)
        content, load = stock.take(self._rows, axis=0) * per_stock, adjoint.take(self._arcs, axis=0)
        by_part = load * rate.take(self._orders, axis=0) * per_stock
        np.add.at(stock_adjoint, self._rows, by_part)
        np.add.at(whole_adjoint, self._places, -by_part * content)
        adjoint[self._arcs] = 0.0
        np.add.at(adjoint, self._orders, load * content)

    def _per_stock(self, available_stock: Floats) -> Floats:
        per_stock = np.divide(
            1.0, available_stock, out=np.zeros_like(available_stock), where=available_stock > NEGLIGIBLE
        )
        return per_stock.take(self._places, axis=0)


class ScheduledFlows:
    """Cuts scheduled flows so that no donor is overdrawn.

    A donor with stock x, proportional exits a and a constant outflow U obeys ẋ ≥ −a·x − U, which stays non-negative for
    a substep h if U ≤ x·a/(e^{ah} − 1). Flows from one donor are cut by the same factor, and so are all components of
    a source whose contents change.

    Attributes:
        arcs: those whose flows it cuts.
    """

    def __init__(self, laws: FlowLaws, substep: float) -> None:
        """Find the donors of scheduled flows, and their outflows by schedule and in proportion to their stock."""
        self._substep, network = substep, laws.staged_network
        of_sources = set(laws.source_contents.arcs.ravel().tolist())
        components = 1 + len(network.substances) if isinstance(network, ComponentNetwork) else 1
        arcs, stores = len(network.arcs) // components, len(network.stores) // components
        # what comes out of slots is of the component that is in them
        lines = {network.arc_index[arc] for arc in network.lines.values()} if isinstance(network, StagedNetwork) else ()
        orders = [k for k in np.flatnonzero(laws.is_scheduled).tolist() if k < arcs or k in lines or k in of_sources]
        self.arcs: Integers = np.array(orders, dtype=np.intp)
        self._donors, place = np.unique(network.donors[self.arcs], return_inverse=True)
        self._slot: Integers = place
        slot = {int(node): i for i, node in enumerate(self._donors)}
        self._together = np.searchsorted(self._donors, laws.source_contents.donors)
        proportional = laws.driver == network.donors
        exits = [k for k, d in enumerate(network.donors) if int(d) in slot and proportional[k]]
        exit_slot = [len(slot) + slot[int(network.donors[k])] for k in exits]
        rows, columns = [*self._slot, *exit_slot], [*self.arcs, *exits]
        self._outflows = RowSum(rows, columns, 1.0, (2 * len(slot), len(network.arcs)))
        self._sum = RowSum(self._slot, np.arange(len(self.arcs)), 1.0, (len(slot), len(self.arcs)))
        self._loads = None
        if components > 1:
            orders = [k for k in orders if k not in lines and k not in of_sources]
            self._loads = Loads(network, orders, self._donors, arcs, stores, components)

    def cut(self, stock: Floats, rate: Floats) -> Floats:
        """Return the rates, shape (arcs, B), with those of scheduled flows cut; the same array if none is."""
        if not len(self.arcs):
            return rate
        available_stock = self._stocks(stock)
        rate = self._cut(available_stock, rate)
        return rate if self._loads is None else self._loads.share_out(stock, available_stock, rate)

    def _cut(self, available_stock: Floats, rate: Floats) -> Floats:
        demand, turned_over = self._demand(rate)
        if (demand <= available_stock * (1.0 - turned_over) * KEPT).all():
            return rate  # x·a/(e^{ah} − 1) ≥ x(1 − ah)/h: nothing can be overdrawn
        available = available_stock * _deliverable(turned_over) * KEPT
        factor = np.divide(available, demand, out=np.ones_like(available_stock), where=demand > available)
        factor[self._together] = factor[self._together].min(axis=0)
        rate = rate.copy()
        rate[self.arcs] *= factor.take(self._slot, axis=0)
        return rate

    def limits(self, stock: Floats, rate: Floats) -> tuple[Bools, Floats]:
        """Return which of ``arcs`` are cut, and by what each then is, per stock of its donor, shape (arcs, B)."""
        demand, turned_over = self._demand(rate)
        deliverable = _deliverable(turned_over) * KEPT
        is_cut = demand > self._stocks(stock) * deliverable
        part = np.divide(deliverable, demand, out=np.zeros_like(demand), where=is_cut)
        return is_cut.take(self._slot, axis=0), part.take(self._slot, axis=0)

    def pull_back(self, stock: Floats, rate: Floats, adjoint: Floats, stock_adjoint: Floats) -> None:
        """Turn, in place, the adjoint of the rates that ``cut`` returned into that of those it was given.

        What comes by the stocks is added to theirs. A flow that just need not be cut counts as uncut.
        """
        if not len(self.arcs):
            return
        available_stock = self._stocks(stock)
        whole_adjoint = np.zeros_like(available_stock)
        if self._loads is not None:
            orders = self._cut(available_stock, rate)
            self._loads.pull_back(stock, available_stock, orders, adjoint, stock_adjoint, whole_adjoint)
        self._pull_back_cuts(available_stock, rate, adjoint, whole_adjoint)
        stock_adjoint[self._donors] += whole_adjoint
        if self._loads is not None:
            stocks = self._loads.substances.transpose()
            stocks.add_to(stock_adjoint[: stocks.shape[0]], whole_adjoint)

    def _pull_back_cuts(self, available_stock: Floats, rate: Floats, adjoint: Floats, whole_adjoint: Floats) -> None:
        demand, turned_over = self._demand(rate)
        deliverable = _deliverable(turned_over)
        available = available_stock * deliverable * KEPT
        is_cut = demand > available
        if not is_cut.any():
            return
        ratio = np.divide(1.0, demand, out=np.zeros_like(demand), where=is_cut)
        factor, load = np.where(is_cut, available * ratio, 1.0), self._sum(adjoint[self.arcs] * rate[self.arcs])
        together = factor[self._together]
        factor[self._together] = together.min(axis=0)
        is_least = np.arange(len(together))[:, None, None] == together.argmin(axis=0)
        load[self._together] = np.where(is_least, load[self._together].sum(axis=0), 0.0)
        factor_adjoint = load * ratio
        adjoint[self.arcs] *= factor.take(self._slot, axis=0)
        whole_adjoint += factor_adjoint * deliverable * KEPT
        # d/dT of T/(e^T − 1), T what is turned over
        grown = np.expm1(turned_over)
        slope = np.divide(1.0 - deliverable * (grown + 1.0), grown, out=np.full_like(grown, -0.5), where=grown > 1e-8)
        outflows = np.concatenate(
            [-factor_adjoint * available * ratio, factor_adjoint * available_stock * slope * KEPT]
        )
        self._outflows.transpose().add_to(adjoint, outflows * self._substep)

    def _stocks(self, stock: Floats) -> Floats:
        """Return what each donor holds, all components together, shape (donors, B)."""
        stocks = stock.take(self._donors, axis=0)
        if self._loads is None:
            return stocks
        return self._loads.substances.add_to(stocks, stock[: self._loads.substances.shape[1]])

    def _demand(self, rate: Floats) -> tuple[Floats, Floats]:
        """Return what is asked of each donor by schedule, mass, and the part of its stock that it turns over."""
        outflows = self._outflows(rate)
        outflows *= self._substep
        return outflows[: len(self._donors)], outflows[len(self._donors) :]


def _deliverable(turned_over: Floats) -> Floats:
    """Return T/(e^T − 1), the part of a stock that can be sent off evenly while a part T of it is turned over."""
    return np.divide(turned_over, np.expm1(turned_over), out=np.ones_like(turned_over), where=turned_over > 1e-12)
