"""The shares of what leaves a node, from what its agents ask for (``network.splits`` has the rule)."""

from __future__ import annotations

import numpy as np

from cirl_marl.network import Floats, Integers, Network, RowSum
from cirl_marl.network.rowsum import narrowed
from cirl_marl.network.splits import splits


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

    def __init__(self, network: Network) -> None:
        """Compile the splits of ``network``."""
        every = splits(network)
        tables = [(narrowed(split.bounds), narrowed(split.proportions)) for split in every]
        self.changing = any(table.shape[-1] > 1 for pair in tables for table in pair)
        columns = network.episode.horizon if self.changing else 1
        steady = [
            not s.controlled and (shares == shares[:, :1]).all() for s, (_, shares) in zip(every, tables, strict=True)
        ]
        found = [split for split, same in zip(every, steady, strict=True) if not same]
        controlled = [(d, k) for d, split in enumerate(found) for k in split.controlled]
        others = [(d, k) for d, split in enumerate(found) for k in split.others]
        rest = [
            (k, share)
            for split, same in zip(every, steady, strict=True)
            if same
            for k, share in zip(split.others, split.proportions[:, 0].tolist(), strict=True)
        ]
        self.varying: Integers = np.array([k for _, k in (*controlled, *others)], dtype=np.intp)
        self.constant: Integers = np.array([k for k, _ in rest], dtype=np.intp)
        self.values: Floats = np.array([share for _, share in rest]).reshape(-1, 1)
        self.arcs: Integers = np.concatenate([self.varying, self.constant])
        self.leading: Integers = np.array([split.others[0] for split in every], dtype=np.intp)
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
        highest = np.concatenate([high, self._proportions * self._room[self._of_others]]).max(axis=1)
        self.highest = np.concatenate([highest, self.values[:, 0]])

    def __call__(self, controls: Floats, step: Integers | None) -> Floats:
        """Return the shares of ``varying``, shape (shares, B); arguments are those of ``FlowLaws.rate``."""
        low, room, proportions = self._low, self._room, self._proportions
        if self.changing:
            # without a step the first interval stands for all
            chosen = np.zeros(1, dtype=np.intp) if step is None else step
            low, room, proportions = (table.take(chosen, axis=1) for table in (low, room, proportions))
        shares = controls.take(self._rows, axis=0)
        shares -= low
        np.maximum(shares, 0.0, out=shares)  # rounding may ask for a little less than the lowest
        asked = self._total(shares)
        shares *= np.divide(room, asked, out=np.ones_like(asked), where=asked > room).take(self._of, 0)
        shares += low
        left = np.maximum(1.0 - self._total(shares), 0.0).take(self._of_others, 0)
        left *= proportions
        return np.concatenate([shares, left])
