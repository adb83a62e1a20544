"""Which contents stocks and flows can have at any time, whatever agents do."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.network.rowsum import Floats
from cirl_marl.network.substances import changing_sources, separates

SETTLED, ROUNDS = 1e-12, 1000
"""Change of a range in a round that counts as none, and rounds after which what still changes may be anything."""


def reachable_contents(network: Any, starts: Floats, shares: Floats) -> tuple[Floats, Floats]:
    """Return what part of each stock and of each flow each component may be at any time.

    Stocks begin with their content and mix what enters; what a node hands on in shares that differ by component has
    s_c·x_c of Σ s·x. The ranges are the least that contain ``starts`` and reproduce themselves.

    Args:
        network: whose nodes mix and separate.
        starts: least and greatest part of each component in stocks at the start, or in what sources give, shape (2,
            components, stores); from 1 to 0 where there is nothing.
        shares: least and greatest share of each arc of law ``share``, 1 of others, by component, of any interval, shape
            (2, components, arcs).

    Returns:
        Least and greatest part, shapes (2, components, stores) and (2, components, arcs); from 1 to 0 of what there
        never is, from 0 to 1 of stocks of changing sources.
    """
    is_separate = np.zeros(len(network.arcs), dtype=bool)
    for split in network.splits:
        is_separate[[*split.controlled_arcs, *split.other_arcs]] = separates(network, split)
    ranges = np.tile([[[1.0]], [[0.0]]], (1, starts.shape[1], len(network.nodes)))
    ranges[:, :, : len(network.stores)] = starts
    for done in range(ROUNDS + len(network.nodes)):
        flows = _handed_on(ranges[:, :, network.donors], shares, is_separate)
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
    ranges = (ranges + margin).clip(0.0, 1.0)
    flows = _handed_on(ranges[:, :, network.donors], shares, is_separate)
    stocks = ranges[:, :, : len(network.stores)].copy()
    stocks[..., [network.node_index[source.id] for source in changing_sources(network)]] = [[[0.0]], [[1.0]]]
    return stocks, flows


def _handed_on(content: Floats, shares: Floats, is_separate: NDArray[np.bool_]) -> Floats:
    """Return the ranges of contents of flows, of those of their donors and the shares of each component."""
    (low, high), (least, most) = content, shares
    is_separate = is_separate & (low <= high).all(axis=0)
    result = content.copy()
    other_most = np.stack([np.delete(most, row, axis=0).max(axis=0) for row in range(len(most))])
    other_least = np.stack([np.delete(least, row, axis=0).min(axis=0) for row in range(len(least))])
    for side, part, own, others in ((0, low, least, other_most), (1, high, most, other_least)):
        gain, rest = own * part, (1.0 - part) * others
        edge = np.divide(gain, gain + rest, out=np.full_like(gain, float(side)), where=gain + rest > 0)
        result[side][:, is_separate] = edge[:, is_separate]
    return result
