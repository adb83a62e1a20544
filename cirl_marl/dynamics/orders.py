"""Orders from nodes that store nothing, and what takes the rest of what passes there.

Of a throughput with the mean q over an interval, orders D_e of D together get ::

    f_e = D_e · min(1, q/D),    others share max(0, q − D)

as means over the interval: pro rata of what is ordered where that is more than there is. In the interval they are
constant shares of the throughput, D_e/max(D, q), so that its motion stays linear and nothing is ever negative.

With b what enters from stocks and outside, o = min(q, D) what orders get of each node and z = q − o the rest, ::

    q = b + Aᵀ o + Bᵀ z,    o ≤ D,  z ≥ 0,  (D − o) z = 0,

A and B being shares of orders and of the rest. As all of it leaves sooner or later, I − A and I − B are M-matrices,
and so is any choice of their rows: there is one solution, to which complementary pivots lead (``clear``). b changes
with q only by what comes back from stocks within the interval, which is simulated until it agrees (``settle``).

References: Eisenberg and Noe 2001, Management Science 47, 236; Cottle, Pang and Stone 2009, The Linear
Complementarity Problem.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated

import numpy as np

from cirl_marl.dynamics.krylov import Acceleration
from cirl_marl.dynamics.routing import IntervalRoutes, Routing
from cirl_marl.network import Floats, Integers, Network, RowSum
from cirl_marl.network.compartment_model import Bools
from cirl_marl.network.declarations import positional_record

ROUNDS, CLOSE, ROUNDING = 100, 1e-12, 1e-14
"""Most intervals that are simulated; how near q must be to what it leads to, relative to it, and to the largest q,
within which it is also as much as is ordered."""
BLOCKS, PIVOTS = 20, 20
"""Changes of which nodes have enough, all at once, then one by one: most of them, the latter for each node."""


@positional_record
class Regime:
    """Which markets have enough for all that is ordered."""

    has_enough: Annotated[Bools, "whether each does, shape (markets, B)"]
    routes: Annotated[IntervalRoutes, "past those that do the rest goes on, past others what is ordered"]

    def of_copies(self, copies: Integers) -> Regime:
        """Return that of some copies."""
        return Regime(self.has_enough[:, copies], self.routes.of_copies(copies))


class Orders:
    """The orders of a network from nodes that store nothing.

    Attributes:
        arcs: whose flows are ordered, shape (orders,).
        markets: nodes without stock that they leave, shape (markets,).
        rest_arcs: those that share what these have left, shape (others,).
        inflows: arcs that enter nodes without stock from stocks and outside.
    """

    def __init__(self, network: Network, routing: Routing) -> None:
        """Take the orders of ``network``, whose nodes without stock ``routing`` is of."""
        stores, self._routing, arcs = len(network.stores), routing, np.array(network.orders, dtype=np.intp)
        self.arcs: Integers = arcs
        self.markets, first, self._of = np.unique(network.donors[arcs], return_index=True, return_inverse=True)
        exits = np.flatnonzero(np.isin(network.donors, self.markets))
        self.rest_arcs: Integers = np.setdiff1d(exits, arcs)
        self._of_rest = np.searchsorted(self.markets, network.donors[self.rest_arcs])
        self._names = [network.nodes[market].id for market in self.markets.tolist()]
        self._sum = RowSum(self._of, range(len(arcs)), 1.0, (len(self.markets), len(arcs)))
        self._rest_sum = RowSum(
            self._of_rest, range(len(self.rest_arcs)), 1.0, (len(self.markets), len(self.rest_arcs))
        )
        self._outflows = RowSum(
            np.searchsorted(self.markets, network.donors[exits]), exits, 1.0, (len(self.markets), len(network.arcs))
        )
        self.inflows = np.flatnonzero((network.donors < stores) & (network.recipients >= stores))
        entries = np.concatenate([self.inflows, arcs[network.recipients[arcs] >= stores]])
        places = routing.places[network.recipients[entries] - stores] if routing.nodes else entries
        self._entries = RowSum(places, entries, 1.0, (routing.nodes, len(network.arcs)))
        self._places = routing.places[self.markets - stores]
        self._rows = routing.throughput_rows[np.searchsorted(routing.arcs, arcs[first])]

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(len(self.arcs))

    def shares(self, rate: Floats, through: Floats) -> Floats:
        """Return rates, shape (arcs, B), in which orders and the rest are shares of ``through``, shape (markets, B)."""
        demand, result = rate.take(self.arcs, 0), rate.copy()
        total = self._sum(demand)
        part = _inverse(np.maximum(total, through))
        result[self.arcs] = demand * part.take(self._of, 0)
        result[self.rest_arcs] *= np.maximum(1.0 - total * part, 0.0).take(self._of_rest, 0)
        return result

    def further_shares(self, rate: Floats) -> Floats:
        """Return rates as ``shares`` does, of what arrives more where all have what they order."""
        return self.shares(rate, np.full((len(self.markets), 1), np.inf)) if self else rate

    def settle(
        self, rate: Floats, flow: Floats, simulate: Callable[[Integers, Floats], Floats]
    ) -> tuple[Floats, Floats]:
        """Return rates with shares of q, shape (arcs, B), and q, shape (markets, B), by simulating the interval.

        Args:
            rate: of all arcs, of orders what is ordered, shape (arcs, B).
            flow: of the other arcs at the start, likewise.
            simulate: ``(copies, rates) → flows``, means over the interval of some copies, shape (arcs, copies); for
                each copy it is called last with the rates that are returned.

        Raises:
            ArithmeticError: if that comes to no end; names the node.
        """
        through, regime = self.clear(rate, flow)
        result, accelerate, copies = self.shares(rate, through), Acceleration(), np.arange(rate.shape[1])
        for _ in range(ROUNDS):
            rates, now = rate.take(copies, axis=1), through.take(copies, axis=1)
            ahead, regime = self.clear(rates, simulate(copies, result.take(copies, axis=1)), regime)
            far = np.abs(ahead - now) > CLOSE * ahead + ROUNDING * ahead.max(axis=0)
            is_far = far.any(axis=0)
            if not is_far.any():
                return result, through
            # copy by copy in memory, so that sums have the same order whatever the batch
            points, steps = (np.ascontiguousarray(array.T) for array in (now, ahead - now))
            now, copies = np.maximum(accelerate(points, steps), 0.0).T[:, is_far], copies[is_far]
            if not is_far.all():
                accelerate.select(is_far)
                regime = regime.of_copies(np.flatnonzero(is_far))
            through[:, copies], result[:, copies] = now, self.shares(rates[:, is_far], now)
        name = self._names[int(far.any(axis=1).argmax())]
        raise ArithmeticError(f"orders from node '{name}' are not settled after {ROUNDS} simulations of an interval")

    def clear(self, rate: Floats, inflow: Floats, regime: Regime | None = None) -> tuple[Floats, Regime]:
        """Return q of the markets, shape (markets, B), by block principal pivots, then by single ones (Murty 1974).

        Args:
            rate: of all arcs, of orders what is ordered, shape (arcs, B).
            inflow: mean flows of the arcs, of which ``inflows`` count, likewise.
            regime: where to begin from; None: all have enough.

        Raises:
            ArithmeticError: if pivots come to no end; names the node.
        """
        total, entry_flow = self._sum(rate.take(self.arcs, 0)), np.zeros_like(rate)
        entry_flow[self.inflows] = inflow[self.inflows]
        regime = regime or self._regime(rate, np.ones(total.shape, dtype=bool))
        for pivot in range(BLOCKS + PIVOTS * len(self.markets)):
            has_enough = regime.has_enough
            result = self._throughputs(rate, total, entry_flow, regime)
            lack = (total - result) * np.where(has_enough, 1.0, -1.0)
            # where nothing is ordered there is enough, whatever others still lack
            is_wrong = (lack > ROUNDING * (total + np.abs(result).max(axis=0))) & (total > 0)
            if not is_wrong.any():
                return np.maximum(result, 0.0), regime
            if pivot >= BLOCKS:
                is_wrong &= np.cumsum(is_wrong, axis=0) == 1
            regime = self._regime(rate, has_enough ^ is_wrong)
        raise ArithmeticError(f"orders from node '{self._names[int(is_wrong.any(axis=1).argmax())]}' are not cleared")

    def pull_back(self, rate: Floats, through: Floats, adjoint: Floats) -> tuple[Floats, Floats]:
        """Return derivatives by the rates that ``shares`` took, and by q, of those by what it returned.

        Where q is just as much as is ordered it counts as less.
        """
        demand, by_share, result = rate.take(self.arcs, 0), adjoint.take(self.arcs, 0), adjoint.copy()
        total = self._sum(demand)
        part, has_enough = _inverse(np.maximum(total, through)), through > total
        of_orders = self._sum(by_share * demand)
        of_rest = self._rest_sum(adjoint.take(self.rest_arcs, 0) * rate.take(self.rest_arcs, 0))
        by_total = -part * np.where(has_enough, of_rest, of_orders * part)
        result[self.arcs] = by_share * part.take(self._of, 0) + by_total.take(self._of, 0)
        result[self.rest_arcs] *= np.maximum(1.0 - total * part, 0.0).take(self._of_rest, 0)
        return result, np.where(has_enough, (total * of_rest - of_orders) * part**2, 0.0)

    def worth_of_moved(self, worth: Floats) -> Floats:
        """Return what mass moved along arcs is worth, shape (arcs, B), if what passes markets is worth so much."""
        return self._outflows.transpose()(worth)

    def _regime(self, rate: Floats, has_enough: Bools) -> Regime:
        """Return what markets pass on if those that have enough serve all that is ordered and others have no rest."""
        demand, shares = rate.take(self.arcs, 0), rate.copy()
        part = np.where(has_enough, 0.0, _inverse(self._sum(demand)))
        shares[self.arcs] = demand * part.take(self._of, 0)
        shares[self.rest_arcs] *= has_enough.take(self._of_rest, 0)
        routes = self._routing.routes(shares)
        assert routes is not None
        return Regime(has_enough, routes)

    def _throughputs(self, rate: Floats, total: Floats, entry_flow: Floats, regime: Regime) -> Floats:
        """Return q that follows from what enters; of markets that have enough it may be less than is ordered."""
        flow, delivery = entry_flow.copy(), np.where(regime.has_enough, total, 0.0)
        flow[self.arcs] = np.where(regime.has_enough.take(self._of, 0), rate.take(self.arcs, 0), 0.0)
        through = self._entries(flow)
        through[self._places] -= delivery
        return np.asarray(self._routing.throughputs(through, regime.routes)[self._rows] + delivery)


def _inverse(values: Floats) -> Floats:
    """Return 1/v, 0 where v = 0."""
    return np.divide(1.0, values, out=np.zeros_like(values), where=values > 0)
