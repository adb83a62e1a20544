"""The adjoint of rates: what a functional of them changes by with controls, shares and what is uncertain.

The rate of an arc is a product of its base, its control, that of its donor, its share and what is drawn of it; the
derivative by each is the product of the others. Shares follow from controls by ``Shares``.
"""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.network import Floats, Integers
from cirl_marl.network.rowsum import RowSum


class RateAdjoint:
    """Derivatives of ``FlowLaws.rate``."""

    def __init__(self, laws: FlowLaws) -> None:
        """Compile the adjoint of the rates of ``laws``."""
        self._laws, shares, factors = laws, laws.shares, laws.flow_factors
        drawn: Integers = np.empty(0, dtype=np.intp) if factors is None else factors.arcs
        self._arcs = np.unique(np.concatenate([laws.controlled_arcs, shares.varying_arcs, drawn]))
        place = np.full(len(laws.staged_network.arcs), -1, dtype=np.intp)
        place[self._arcs] = np.arange(len(self._arcs))
        self._share_places, self._drawn_places = place[shares.varying_arcs], place[drawn]
        self._own, self._donor = laws.own_control[self._arcs], laws.donor_control[self._arcs]
        columns, shape = np.arange(2 * len(self._arcs)), (len(laws.neutral) + 1, 2 * len(self._arcs))
        self._by_control = RowSum(np.concatenate([self._own, self._donor]), columns, 1.0, shape)

    def pull_back(
        self, controls: Floats, step: Integers, factors: Floats | None, adjoint: Floats
    ) -> tuple[Floats, Floats | None]:
        """Return derivatives by controls and by factors, in their shapes, of those by the rates, shape (arcs, B)."""
        laws, arcs, batch = self._laws, self._arcs, controls.shape[1]
        inputs = laws.control_multipliers(controls)
        inputs = np.concatenate([inputs, np.ones((1, batch))])
        own, donor = inputs.take(self._own, 0), inputs.take(self._donor, 0)
        share, drawn = np.ones((2, len(arcs), batch))
        if len(self._share_places):
            share[self._share_places] = laws.shares(controls, step, factors)
        if factors is not None and laws.flow_factors is not None:
            drawn[self._drawn_places] = laws.flow_factors.multipliers(factors)
        weight = adjoint.take(arcs, 0) * laws.constant_rate(step).take(arcs, 0)
        by_own, by_donor = weight * donor * share * drawn, weight * own * share * drawn
        control_adjoint = self._by_control(np.concatenate([by_own, by_donor]))[:-1]
        stretches = laws.stretch_rows
        control_adjoint[stretches] *= -(inputs[stretches] ** 2)
        factor_adjoint = None if factors is None else np.zeros_like(factors)
        if len(self._share_places):
            by_share = (weight * own * donor * drawn)[self._share_places]
            laws.shares.pull_back(controls, step, factors, by_share, control_adjoint, factor_adjoint)
        if factors is not None and factor_adjoint is not None and laws.flow_factors is not None:
            by_drawn = (weight * own * donor * share)[self._drawn_places]
            laws.flow_factors.pull_back(factors, by_drawn, factor_adjoint)
        return control_adjoint, factor_adjoint

    def pull_back_bounds(self, step: Integers, factors: Floats, adjoint: Floats, factor_adjoint: Floats) -> None:
        """Add to the adjoint of the factors what the bounds of controls and their neutral values bring.

        ``adjoint`` is of low, neutral and high values, shape (3, controls, B). A neutral value that is just as large as
        its capacity counts as itself.
        """
        laws, (low, neutral, high) = self._laws, adjoint
        tables = [table.take(step, 1) for table in (laws.control_low, laws.neutral, laws.control_high)]
        if laws.flow_factors is not None and len(laws.flow_factors.capacity.rows):
            capacity = laws.flow_factors.capacity
            is_cut = laws.control_factors(tables[1], factors) > laws.capacity_in(step, factors)
            high, neutral = high + neutral * is_cut, neutral * ~is_cut
            capacity.pull_back(laws.control_factors(tables[2], factors), high, factor_adjoint)
            high = capacity(high, factors)
        for table, part in zip(tables, (low, neutral, high), strict=True):
            laws.control_factors.pull_back(table, factors, part, factor_adjoint)
