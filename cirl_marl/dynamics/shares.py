"""The shares of what leaves a node, from what its agents ask for (``network.splits`` has the rule)."""

from __future__ import annotations

import numpy as np

from cirl_marl.network import Floats, Integers, Network, RowSum
from cirl_marl.network.splits import splits


class Shares:
    """The shares of all arcs of law ``share``.

    Attributes:
        arcs: those arcs; first those that have a control, then the others.
        highest: greatest share that each can get in any interval, shape (shares,).
        leading: one of the arcs of each split, shape (splits,).
        controlled: whether any of them has a control.
        changing: whether a share may differ from interval to interval though controls are the same.
    """

    def __init__(self, network: Network) -> None:
        """Compile the splits of ``network``."""
        found, horizon = splits(network), network.episode.horizon
        controlled = [(d, k) for d, split in enumerate(found) for k in split.controlled]
        others = [(d, k) for d, split in enumerate(found) for k in split.others]
        self.arcs: Integers = np.array([k for _, k in (*controlled, *others)], dtype=np.intp)
        self.controlled = bool(controlled)
        self.leading: Integers = np.array([split.others[0] for split in found], dtype=np.intp)
        self._rows: Integers = np.array(
            [network.control_rows[network.arcs[k].id].start for _, k in controlled], dtype=np.intp
        )
        self._of: Integers = np.array([d for d, _ in controlled], dtype=np.intp)
        self._of_others: Integers = np.array([d for d, _ in others], dtype=np.intp)
        self._total = RowSum(self._of, np.arange(len(controlled)), 1.0, (len(found), len(controlled)))
        bounds = [split.bounds for split in found]
        low, _, high = np.concatenate(bounds, axis=1) if bounds else np.empty((3, 0, horizon))
        proportions = np.concatenate([np.empty((0, horizon)), *(split.proportions for split in found)])
        low = np.ascontiguousarray(low)
        room = np.maximum(1.0 - self._total(low), 0.0)
        self.highest = np.concatenate([high, proportions * room[self._of_others]]).max(axis=1)
        tables = (low, room, proportions)
        self.changing = any(bool((table != table[:, :1]).any()) for table in tables)
        self._low, self._room, self._proportions = tables if self.changing else (each[:, :1] for each in tables)

    def __call__(self, controls: Floats, step: Integers | None) -> Floats:
        """Return the shares of ``arcs``, shape (shares, B); arguments are those of ``FlowLaws.rate``."""
        low, room, proportions = self._low, self._room, self._proportions
        if self.changing and step is not None:
            low, room, proportions = (table.take(step, axis=1) for table in (low, room, proportions))
        shares = controls.take(self._rows, axis=0)
        shares -= low
        np.maximum(shares, 0.0, out=shares)  # rounding may ask for a little less than the lowest
        asked = self._total(shares)
        shares *= np.divide(room, asked, out=np.ones_like(asked), where=asked > room).take(self._of, 0)
        shares += low
        left = np.maximum(1.0 - self._total(shares), 0.0).take(self._of_others, 0)
        left *= proportions
        return np.concatenate([shares, left])
