"""The exact solver's series: ẋ = S f(x) for constant rates, over one substep."""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.kron_reduction import KronReduction
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.routing import IntervalRoutes
from cirl_marl.network import Floats, RowSum
from cirl_marl.network.elements import Law

TRUNCATION = 1e-13
"""Bound on the first neglected term of the series, relative to the mass in the network."""


class Taylor:
    """Sums the Taylor series in Horner form for the mean of the state, ȳ = x + (h/2)·ẋ(x + (h/3)·ẋ(x + …)).

    A node turns over at most its stock in a substep, so the series is free of cancellation; it is cut where the
    neglected term is below ``TRUNCATION``.

    Attributes:
        terms: terms of the series.
    """

    def __init__(self, laws: FlowLaws, substep: float) -> None:
        """Find how many terms substeps of this length take."""
        self._laws, self._substep = laws, substep
        self.terms = self._number()
        # Horner from the innermost term: h/K, …, h/3, h/2
        factors = [substep / k for k in range(self.terms, 1, -1)]
        self._pulls = any(arc.law is Law.RECIPIENT for arc in laws.staged_network.arcs)
        self._horner = [laws.incidence.scaled_by(factor) for factor in factors]
        self._shortcut = KronReduction(laws, factors) if laws.routing.nodes else None
        network, routing, stores = laws.staged_network, laws.routing, laws.rows.nodes.stop
        # throughputs stand below the masses, and drive what leaves nodes without stock
        self._driver = laws.driver.copy()
        self._driver[routing.arcs] = laws.rows.masses + routing.throughput_rows
        self._inflows = np.flatnonzero((network.donors < stores) & (network.recipients >= stores))
        entry_places = routing.places[network.recipients[self._inflows] - stores]
        self._into = RowSum(entry_places, range(len(entry_places)), 1.0, (routing.nodes, len(entry_places)))

    def _number(self) -> int:
        """Smallest K ≥ 2 for which the first neglected term of the mean, ‖|A|^K‖₁·h^K/(K + 1)!, is ≤ TRUNCATION.

        A, entry by entry, is largest in absolute value with every control at its upper bound, so that bound serves all.
        What is split, or enters a node that stores nothing, is taken to go where it drives most.
        """
        laws, stores = self._laws, self._laws.rows.nodes.stop
        donors = laws.staged_network.donors[laws.driven_arcs]
        reach, term, k = np.ones(stores), 1.0, 0
        while term > TRUNCATION or k < 2:
            k += 1
            # one factor |A| of ‖|A|^k‖₁, by its columns: what leaves a stock counts at its donor and at its recipient
            ends = np.append(reach, reach.max(initial=0.0))[laws.driven_to]
            transfers = laws.driven_rate * (reach[donors] + ends) * self._substep
            reach = np.bincount(laws.driver[laws.driven_arcs], weights=transfers, minlength=stores) / (k + 1)
            term = float(reach.max(initial=0.0))
        return k

    def moved_mass(
        self, stock: Floats, routes: IntervalRoutes | None, rate: Floats, imposed_flow: Floats | None = None
    ) -> Floats:
        """Return h·r∘ȳ[driver], ȳ the exact mean of the state over the substep, shape (arcs, B).

        Flows given in ``imposed_flow``, shape (arcs, B), hold whatever the state; NaN where the flow law does.
        """
        if self._shortcut is not None and routes is not None and imposed_flow is None:
            transfer = self.flow(self._shortcut.mean(stock, routes, rate), routes, rate)
        else:
            transfer = self._mean_flow(stock, routes, rate, imposed_flow)
        transfer *= self._substep
        if self._pulls:
            np.maximum(transfer, 0.0, out=transfer)  # the mean of an overdrawn stock may be negative
        return transfer

    def flow(self, masses: Floats, routes: IntervalRoutes | None, rate: Floats) -> Floats:
        """Return the flows at ``masses``, those that are passed on too, shape (arcs, B)."""
        laws = self._laws
        if routes is None:
            return laws.flow(masses, rate)
        inflow = masses.take(laws.driver[self._inflows], 0)
        inflow *= rate.take(self._inflows, 0)
        through = laws.routing.throughputs(self._into(inflow), routes)
        flow: Floats = np.concatenate([masses, through]).take(self._driver, 0)
        flow *= rate
        return flow

    def _mean_flow(
        self, stock: Floats, routes: IntervalRoutes | None, rate: Floats, imposed_flow: Floats | None
    ) -> Floats:
        """Return r∘ȳ[driver], with the flows of all arcs in each term."""
        laws, flow, mean = self._laws, np.empty_like(rate), stock.copy()
        for incidence in (*self._horner, None):
            mean.take(laws.driver, axis=0, out=flow, mode="clip")
            flow *= rate
            if imposed_flow is not None:
                np.copyto(flow, imposed_flow, where=~np.isnan(imposed_flow))
            if routes is not None:
                laws.routing.pass_on(flow, routes)
            if incidence is not None:
                mean[...] = stock
                incidence.add_to(mean, flow)
        return flow
