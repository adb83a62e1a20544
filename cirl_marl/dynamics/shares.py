"""The shares of what leaves a node, from what its agents ask for (``network.splits`` has the rule)."""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.uncertain_factors import RowFactors
from cirl_marl.network import Floats, Integers, Network, RowSum
from cirl_marl.network.rowsum import single_column
from cirl_marl.network.split_fractions import splits
from cirl_marl.network.uncertainty import numbers_of


class Shares:
    """The shares of all arcs of law ``share``.

    Attributes:
        arcs: those arcs; first ``varying``, then ``constant``.
        varying: arcs of splits that a control or a series changes; first those that have a control, then the others.
        constant: arcs whose share is the same in all copies and intervals.
        values: their shares, shape (constant, 1).
        highest: greatest share that each of ``arcs`` can get in any interval, shape (shares,).
        leading: one of the arcs of each split, shape (splits,).
        changing: whether a share may differ from interval to interval though controls are the same.
    """

    def __init__(self, network: Network, *, uncertain: bool = False) -> None:
        """Compile the splits of ``network``; with ``uncertain``, those of which a share is uncertain vary."""
        numbers = numbers_of(network, "arcs", "share") if uncertain else {}
        drawn = {network.arc_index[id_]: number for id_, number in numbers.items()}
        every = splits(network)
        tables = [(single_column(split.bounds), single_column(split.proportions)) for split in every]
        self.is_time_varying = any(table.shape[-1] > 1 for pair in tables for table in pair)
        columns = network.episode.horizon if self.is_time_varying else 1
        steady = [
            not s.controlled_arcs and drawn.keys().isdisjoint(s.other_arcs) and (shares == shares[:, :1]).all()
            for s, (_, shares) in zip(every, tables, strict=True)
        ]
        found = [split for split, same in zip(every, steady, strict=True) if not same]
        controlled = [(d, k) for d, split in enumerate(found) for k in split.controlled_arcs]
        others = [(d, k) for d, split in enumerate(found) for k in split.other_arcs]
        rest = [
            (k, share)
            for split, same in zip(every, steady, strict=True)
            if same
            for k, share in zip(split.other_arcs, split.proportions[:, 0].tolist(), strict=True)
        ]
        self.varying_arcs: Integers = np.array([k for _, k in (*controlled, *others)], dtype=np.intp)
        self.constant_arcs: Integers = np.array([k for k, _ in rest], dtype=np.intp)
        self.values: Floats = np.array([share for _, share in rest]).reshape(-1, 1)
        self.arcs: Integers = np.concatenate([self.varying_arcs, self.constant_arcs])
        self.leading_arcs: Integers = np.array([split.other_arcs[0] for split in every], dtype=np.intp)
        self._rows: Integers = np.array(
            [network.control_rows[network.arcs[k].id].start for _, k in controlled], dtype=np.intp
        )
        self._of: Integers = np.array([d for d, _ in controlled], dtype=np.intp)
        self._of_others: Integers = np.array([d for d, _ in others], dtype=np.intp)
        self._total = RowSum(self._of, np.arange(len(controlled)), 1.0, (len(found), len(controlled)))
        bounds = np.concatenate([np.empty((3, 0, columns)), *(s.bounds[..., :columns] for s in found)], axis=1)
        self._low, high = np.ascontiguousarray(bounds[0]), bounds[2]
        self._room = np.maximum(1.0 - self._total(self._low), 0.0)
        self._proportions = np.concatenate([np.empty((0, columns)), *(s.proportions[:, :columns] for s in found)])
        given = np.concatenate([np.empty((0, columns)), *(s.stated_shares[:, :columns] for s in found)])
        self._rest, self._given = np.isnan(given), np.where(np.isnan(given), 0.0, given)
        self._left = 1.0 - self._total(np.ascontiguousarray(bounds[1]))
        self._total_of_others = RowSum(self._of_others, np.arange(len(others)), 1.0, (len(found), len(others)))
        self._drawn = RowFactors({n: drawn[k] for n, (_, k) in enumerate(others) if k in drawn})
        proportions = self._proportions
        if drawn:
            ends = np.array([spread.ends for spread in network.uncertain.values()]).T
            proportions = self._most(ends)
        highest = np.concatenate([high, proportions * self._room[self._of_others]]).max(axis=1)
        self.highest = np.concatenate([highest, self.values[:, 0]])

    def __call__(self, controls: Floats, step: Integers | None, factors: Floats | None = None) -> Floats:
        """Return the shares of ``varying``, shape (shares, B); arguments are those of ``FlowLaws.rate``."""
        low, room, proportions = self._low, self._room, self._proportions
        if self.is_time_varying:
            # without a step the first interval stands for all
            chosen = np.zeros(1, dtype=np.intp) if step is None else step
            low, room, proportions = (table.take(chosen, axis=1) for table in (low, room, proportions))
        if factors is not None and self._drawn.rows.size:
            proportions = self._drawn_proportions(step, factors)
        shares = controls.take(self._rows, axis=0)
        shares -= low
        np.maximum(shares, 0.0, out=shares)  # rounding may ask for a little less than the lowest
        asked = self._total(shares)
        shares *= np.divide(room, asked, out=np.ones_like(asked), where=asked > room).take(self._of, 0)
        shares += low
        left = np.maximum(1.0 - self._total(shares), 0.0).take(self._of_others, 0)
        left *= proportions
        return np.concatenate([shares, left])

    def _drawn_proportions(self, step: Integers | None, factors: Floats) -> Floats:
        """Return π of the arcs without control, shape (others, B), for what was drawn (``splits.proportions``)."""
        given, left, rest = self._given, self._left, self._rest
        if self.is_time_varying:
            chosen = np.zeros(1, dtype=np.intp) if step is None else step
            given, left, rest = (table.take(chosen, axis=1) for table in (given, left, rest))
        weights = self._drawn(given, factors)
        remaining = np.maximum(left - self._total_of_others(weights), 0.0)
        weights = np.where(rest, remaining.take(self._of_others, 0), weights)
        weights = np.where(self._total_of_others(weights).take(self._of_others, 0) > 0, weights, rest)
        return np.asarray(weights / self._total_of_others(weights).take(self._of_others, 0))

    def _most(self, ends: Floats) -> Floats:
        """Return the greatest π of each arc without control, shape (others, columns); ``ends`` are those of factors."""
        low, high = (self._drawn(self._given, np.repeat(end[:, None], self._given.shape[1], axis=1)) for end in ends)
        least, left = self._total_of_others(low).take(self._of_others, 0), self._left.take(self._of_others, 0)
        shared = self._total_of_others(np.ascontiguousarray(self._rest, dtype=float)).take(self._of_others, 0) > 0
        # where one takes the rest, the others get what they state, and more than that if they exceed the whole
        others = np.where(shared, np.maximum(left, least - low + high), least - low + high)
        most = np.divide(high, others, out=np.ones_like(high), where=others > 0)
        remaining = np.divide(left - least, left, out=np.ones_like(high), where=left > 0)
        return np.where(self._rest, np.maximum(remaining, 0.0), np.minimum(most, 1.0))
