"""The shares of what leaves a node, from what its agents ask for (``network.splits`` has the rule)."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from cirl_marl.dynamics.components import ComponentNetwork, copy_id
from cirl_marl.dynamics.uncertain_factors import ControlFactors, RowFactors
from cirl_marl.network import Floats, Integers, Network, RowSum
from cirl_marl.network.elements import Law
from cirl_marl.network.rowsum import single_column
from cirl_marl.network.uncertainty import numbers_of


def _numbers_of_shares(network: Network, ranges: Mapping[str, tuple[float, float]]) -> dict[int, int]:
    """Return the rows of factors on shares, by arc; a substance has that of its transfer where one is stated."""
    numbers = numbers_of(ranges, "arcs", "share")
    of_arcs = {network.arc_index[id_]: number for id_, number in numbers.items()}
    if not isinstance(network, ComponentNetwork):
        return of_arcs
    for substance in (substance.id for substance in network.substances):
        transfers = numbers_of(ranges, "arcs", f"transfer.{substance}")
        for original in network.arcs[: len(network.arcs) // (1 + len(network.substances))]:
            factors = transfers if substance in dict(original.transfer) else numbers
            if original.law is Law.SHARE and original.id in factors:
                of_arcs[network.arc_index[copy_id(original.id, substance)]] = factors[original.id]
    return of_arcs


class Shares:
    """The shares of all arcs of law ``share``.

    Attributes:
        arcs: those arcs; first ``varying_arcs``, then ``constant_arcs``.
        varying_arcs: arcs of splits that a control or a series changes; those that have a control come first.
        constant_arcs: arcs whose share is the same in all copies and intervals.
        values: their shares, shape (constant, 1).
        highest: greatest share that each of ``arcs`` can get in any interval, shape (shares,).
        leading_arcs: one of the arcs of each split, shape (splits,).
        is_time_varying: whether a share may differ from interval to interval though controls are the same.
    """

    def __init__(self, network: Network, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Compile the splits of ``network``; those of which a share is in ``ranges``, of factors, vary."""
        number_of = _numbers_of_shares(network, ranges)
        # orders take what they take before the others share what is left
        all_splits = [split.without(network.orders) for split in network.splits]
        tables = [(single_column(split.bounds), single_column(split.proportions)) for split in all_splits]
        self.is_time_varying = any(table.shape[-1] > 1 for pair in tables for table in pair)
        columns = network.episode.horizon if self.is_time_varying else 1
        steady = [
            not s.controlled_arcs and number_of.keys().isdisjoint(s.other_arcs) and (shares == shares[:, :1]).all()
            for s, (_, shares) in zip(all_splits, tables, strict=True)
        ]
        varying_splits = [split for split, is_steady in zip(all_splits, steady, strict=True) if not is_steady]
        controlled_exits = [(d, k) for d, split in enumerate(varying_splits) for k in split.controlled_arcs]
        free_exits = [(d, k) for d, split in enumerate(varying_splits) for k in split.other_arcs]
        rest = [
            (k, share)
            for split, is_steady in zip(all_splits, steady, strict=True)
            if is_steady
            for k, share in zip(split.other_arcs, split.proportions[:, 0].tolist(), strict=True)
        ]
        self.varying_arcs: Integers = np.array([k for _, k in (*controlled_exits, *free_exits)], dtype=np.intp)
        self.constant_arcs: Integers = np.array([k for k, _ in rest], dtype=np.intp)
        self.values: Floats = np.array([share for _, share in rest]).reshape(-1, 1)
        self.arcs: Integers = np.concatenate([self.varying_arcs, self.constant_arcs])
        self.leading_arcs: Integers = np.array([split.other_arcs[0] for split in all_splits], dtype=np.intp)
        self._rows: Integers = np.array(
            [network.control_rows[network.arcs[k].id].start for _, k in controlled_exits], dtype=np.intp
        )
        self._of: Integers = np.array([d for d, _ in controlled_exits], dtype=np.intp)
        self._of_others: Integers = np.array([d for d, _ in free_exits], dtype=np.intp)
        self._total = RowSum(
            self._of, np.arange(len(controlled_exits)), 1.0, (len(varying_splits), len(controlled_exits))
        )

        def join_rows(tables: Iterable[Floats]) -> Floats:
            return np.concatenate([np.empty((0, columns)), *(table[:, :columns] for table in tables)])

        self._low, neutral, high = (join_rows(split.bounds[side] for split in varying_splits) for side in range(3))
        self._room, widest_room = np.maximum(1.0 - self._total(self._low), 0.0), None
        rows = self._rows
        self._drawn = ControlFactors(network, ranges, rows)
        if self._drawn.is_active:
            high = self._drawn.extreme(high, 1)
            widest_room = np.maximum(1.0 - self._total(self._drawn.extreme(self._low, 0)), 0.0)
        self._proportions = join_rows(split.proportions for split in varying_splits)
        stated_values = join_rows(split.stated_shares for split in varying_splits)
        self._rest, self._stated_shares = np.isnan(stated_values), np.where(np.isnan(stated_values), 0.0, stated_values)
        self._remainder = 1.0 - self._total(neutral)
        self._total_of_others = RowSum(
            self._of_others, np.arange(len(free_exits)), 1.0, (len(varying_splits), len(free_exits))
        )
        self._factors = RowFactors({n: number_of[k] for n, (_, k) in enumerate(free_exits) if k in number_of})
        proportions = self._proportions
        if number_of:
            ends = np.array([*ranges.values()]).T
            proportions = self._most(ends)
        room = self._room if widest_room is None else widest_room
        highest = np.concatenate([high, proportions * room[self._of_others]]).max(axis=1)
        self.highest = np.concatenate([highest, self.values[:, 0]])

    def __call__(self, controls: Floats, step: Integers | None, factors: Floats | None = None) -> Floats:
        """Return the shares of ``varying``, shape (shares, B); arguments are those of ``FlowLaws.rate``."""
        low, room, proportions = self._tables(step, factors)
        shares = controls.take(self._rows, axis=0)
        shares -= low
        np.maximum(shares, 0.0, out=shares)  # rounding may ask for a little less than the lowest
        demand = self._total(shares)
        # s_k = low_k + (a_k − low_k)·min(1, (1 − Σ low)/Σ(a − low)), the rule of ``split_fractions``
        shares *= np.divide(room, demand, out=np.ones_like(demand), where=demand > room).take(self._of, 0)
        shares += low
        remainder = np.maximum(1.0 - self._total(shares), 0.0).take(self._of_others, 0)
        remainder *= proportions
        return np.concatenate([shares, remainder])

    def _tables(self, step: Integers | None, factors: Floats | None) -> tuple[Floats, Floats, Floats]:
        """Return the least shares, what they leave, and π of the arcs without control."""
        low, room, proportions = (self._table_in(table, step) for table in (self._low, self._room, self._proportions))
        if factors is not None and self._drawn.is_active:
            low = self._drawn(low, factors)
            room = np.maximum(1.0 - self._total(low), 0.0)
        if factors is not None and self._factors.rows.size:
            proportions = self._drawn_proportions(step, factors)
        return low, room, proportions

    def pull_back(
        self,
        controls: Floats,
        step: Integers,
        factors: Floats | None,
        adjoint: Floats,
        control_adjoint: Floats,
        factor_adjoint: Floats | None,
    ) -> None:
        """Add to the adjoints of controls and factors what that of the shares of ``varying``, (shares, B), brings.

        What asks for just as much as there is counts as getting it.
        """
        low, room, proportions = self._tables(step, factors)
        own, others = np.split(adjoint, [len(self._rows)])
        excess = controls.take(self._rows, axis=0) - low
        is_free = excess >= 0
        excess = np.where(is_free, excess, 0.0)
        demand = self._total(excess)
        is_scarce = demand > room
        part = np.divide(room, demand, out=np.ones_like(demand), where=is_scarce)
        remainder = 1.0 - self._total(excess * part.take(self._of, 0) + low)
        # what a share gets more the arcs without control get less
        own = own - np.where(remainder > 0, self._total_of_others(others * proportions), 0.0).take(self._of, 0)
        per_room = np.divide(self._total(own * excess), demand, out=np.zeros_like(demand), where=is_scarce)
        by_excess = (own * part.take(self._of, 0) - (per_room * part).take(self._of, 0)) * is_free
        np.add.at(control_adjoint, self._rows, by_excess)
        if factors is None or factor_adjoint is None:
            return
        if self._drawn.is_active:
            by_low = own - by_excess - (per_room * (room > 0)).take(self._of, 0)
            self._drawn.pull_back(self._table_in(self._low, step), factors, by_low, factor_adjoint)
        if self._factors.rows.size:
            by_proportion = others * np.maximum(remainder, 0.0).take(self._of_others, 0)
            self._pull_back_proportions(step, factors, by_proportion, factor_adjoint)

    def _pull_back_proportions(self, step: Integers, factors: Floats, adjoint: Floats, factor_adjoint: Floats) -> None:
        """Add to the adjoint of the factors what that of π brings, shape (others, B)."""
        stated_values, remainder, rest = (
            self._table_in(table, step) for table in (self._stated_shares, self._remainder, self._rest)
        )
        proportions = self._drawn_proportions(step, factors)
        drawn = self._factors(stated_values, factors)
        leftover = np.maximum(remainder - self._total_of_others(drawn), 0.0)
        total = self._total_of_others(np.where(rest, leftover.take(self._of_others, 0), drawn))
        # π = w/Σw, with w what is left where an arc takes the rest
        mean = self._total_of_others(adjoint * proportions).take(self._of_others, 0)
        total = total.take(self._of_others, 0)
        by_weight = np.divide(adjoint - mean, total, out=np.zeros_like(adjoint), where=total > 0)
        by_leftover = np.where(leftover > 0, self._total_of_others(np.where(rest, by_weight, 0.0)), 0.0)
        by_weight = np.where(rest, 0.0, by_weight - by_leftover.take(self._of_others, 0))
        self._factors.pull_back(stated_values, by_weight, factor_adjoint)

    def _table_in(self, table: Any, step: Integers | None) -> Any:
        """Return a table of splits in an interval of each copy; without a step the first stands for all."""
        if not self.is_time_varying:
            return table
        return table.take(np.zeros(1, dtype=np.intp) if step is None else step, axis=1)

    def _drawn_proportions(self, step: Integers | None, factors: Floats) -> Floats:
        """Return π of the arcs without control, shape (others, B), for what was drawn (``splits.proportions``)."""
        stated_values, remainder, rest = (
            self._table_in(table, step) for table in (self._stated_shares, self._remainder, self._rest)
        )
        weights = self._factors(stated_values, factors)
        leftover = np.maximum(remainder - self._total_of_others(weights), 0.0)
        weights = np.where(rest, leftover.take(self._of_others, 0), weights)
        weights = np.where(self._total_of_others(weights).take(self._of_others, 0) > 0, weights, rest)
        return np.asarray(weights / self._total_of_others(weights).take(self._of_others, 0))

    def _most(self, ends: Floats) -> Floats:
        """Return the greatest π of each arc without control, shape (others, columns); ``ends`` are those of factors."""
        low, high = (
            self._factors(self._stated_shares, np.repeat(end[:, None], self._stated_shares.shape[1], axis=1))
            for end in ends
        )
        least, remainder = self._total_of_others(low).take(self._of_others, 0), self._remainder.take(self._of_others, 0)
        has_rest = self._total_of_others(np.ascontiguousarray(self._rest, dtype=float)).take(self._of_others, 0) > 0
        # where one takes the rest, the others get what they state, and more than that if they exceed the whole
        denominator = np.where(has_rest, np.maximum(remainder, least - low + high), least - low + high)
        most = np.divide(high, denominator, out=np.ones_like(high), where=denominator > 0)
        leftover = np.divide(remainder - least, remainder, out=np.ones_like(high), where=remainder > 0)
        return np.where(self._rest, np.maximum(leftover, 0.0), np.minimum(most, 1.0))
