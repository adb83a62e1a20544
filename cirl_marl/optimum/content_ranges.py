"""Which contents flows can have, for programs that move the components of a material one beside the other."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.substances import contents

SETTLED, ROUNDS = 1e-12, 1000
"""Change of a range in a round that counts as none, and rounds after which what still changes may be anything."""


@positional_record
class Mixtures:
    """The flows of a network as sums of those of its components, and what these can be of them."""

    arcs: Annotated[Integers, "of the planned network, shape (components, arcs)"]
    content: Annotated[Floats, "least and greatest part of each component, shape (2, components, arcs)"]
    scheduled: Annotated[Integers, "which of the arcs flow by schedule"]
    asked: Annotated[Floats, "least and most asked of the whole of these, shape (2, steps, scheduled), mass/time"]

    @property
    def varies(self) -> NDArray[np.bool_]:
        """Whether the content of each flow may change, shape (arcs,)."""
        return np.asarray((self.content[0] < self.content[1]).any(axis=0))


def content_ranges(network: Network, shares: Floats) -> Floats:
    """Return what part of each flow each component may be, at any time and whatever agents do.

    Stocks begin with their content and mix what enters; what a node hands on in shares that differ by component has
    s_c·x_c of Σ s·x. The ranges are the least that contain the start and reproduce themselves.

    Args:
        network: whose nodes have the contents.
        shares: least and greatest share of each arc of law ``share``, 1 of others, by component, of any interval, shape
            (2, components, arcs).

    Returns:
        Least and greatest part, shape (2, components, arcs); from 1 to 0 where nothing ever flows.
    """
    count = 1 + len(network.substances)
    ranges = np.tile([[[1.0]], [[0.0]]], (1, count, len(network.nodes)))
    for i, node in enumerate(network.stores):
        if network.initial[1, i] > 0:
            ranges[:, :, i] = contents(network, node)
    for done in range(ROUNDS + len(network.nodes)):
        flows = _handed_on(ranges[:, :, network.donors], shares)
        wider = ranges.copy()
        np.minimum.at(wider[0].T, network.recipients, flows[0].T)
        np.maximum.at(wider[1].T, network.recipients, flows[1].T)
        changed = np.abs(wider - ranges).max(axis=(0, 1)) > SETTLED
        ranges = wider
        if not changed.any():
            break
        if done >= ROUNDS:
            ranges[0][:, changed], ranges[1][:, changed] = 0.0, 1.0
    changes = ranges[0] != ranges[1]
    margin = np.array([-1e-9, 1e-9])[:, None, None] * changes  # of rounding, and what was too little to have settled
    flows = _handed_on((ranges + margin).clip(0.0, 1.0)[:, :, network.donors], shares)
    return flows


def _handed_on(content: Floats, shares: Floats) -> Floats:
    """Return the ranges of contents of flows, of those of their donors and the shares of each component."""
    (low, high), (least, most) = content, shares
    separated = (shares != shares[:, :1]).any(axis=(0, 1)) & (low <= high).all(axis=0)
    result = content.copy()
    for side, part, own, others in ((0, low, least, most.max(axis=0)), (1, high, most, least.min(axis=0))):
        gain, rest = own * part, (1.0 - part) * others
        edge = np.divide(gain, gain + rest, out=np.full_like(gain, float(side)), where=gain + rest > 0)
        result[side][:, separated] = edge[:, separated]
    return result
