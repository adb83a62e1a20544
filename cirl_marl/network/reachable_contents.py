"""Which contents stocks and flows can have at any time, whatever agents do."""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from cirl_marl.network.rowsum import Floats, Integers
from cirl_marl.network.substances import changing_sources, separates

SETTLED, ROUNDS = 1e-12, 1000
"""Change of a range in a round that counts as none, and rounds after which what still changes may be anything."""
ROUND_OFF = 1e-9
"""By how much shares of a whole may miss it, as sums round."""


def reachable_contents(network: Any, starts: Floats, shares: Floats) -> tuple[Floats, Floats]:
    """Return what part of each stock and of each flow each component may be at any time.

    Stocks begin with their content and mix what enters; what a node hands on in shares that differ by component has
    s_c·x_c of Σ s·x. The ranges are the least that contain ``starts`` and reproduce themselves. Where material goes
    round past nodes without stock, in shares that never change, s_c is how often it passes a node in all.

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
    entries, passed, visits = _loop_visits(network, shares)
    plain = np.flatnonzero(~np.isin(network.recipients, passed))
    ends = np.concatenate([network.recipients[plain], passed])
    for done in range(ROUNDS + len(network.nodes)):
        flows = _handed_on(ranges[:, :, network.donors], shares, is_separate)
        looped = _handed_on(flows[:, :, entries], np.stack([visits, visits]), np.ones(len(entries), dtype=bool))
        wider, flows = ranges.copy(), np.concatenate([flows[:, :, plain], looped], axis=2)
        np.minimum.at(wider[0].T, ends, flows[0].T)
        np.maximum.at(wider[1].T, ends, flows[1].T)
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


def _loop_visits(network: Any, shares: Floats) -> tuple[Integers, Integers, Floats]:
    """Return how often each component of what enters a loop of nodes without stock passes each of its nodes.

    Only loops that separate, and of certain shares, are among them.

    Returns:
        Arcs that enter, and nodes that are passed, shape (ways,) each, and visits, shape (components, ways).
    """
    stores, least = len(network.stores), shares[0]
    totals = np.zeros((len(least), len(network.nodes)))
    np.add.at(totals.T, network.donors, least.T)
    # least shares sum to 1 only where they are all there is
    inside = (abs(totals - 1.0) < ROUND_OFF).all(axis=0) & (np.arange(len(network.nodes)) >= stores)
    is_within = inside[network.donors] & inside[network.recipients]
    graph = nx.DiGraph(zip(network.donors[is_within].tolist(), network.recipients[is_within].tolist(), strict=True))
    ways: list[tuple[Integers, Integers, Floats]] = [(np.empty(0, np.intp), np.empty(0, np.intp), least[:, :0])]
    for loop in nx.strongly_connected_components(graph):
        nodes = np.array(sorted(loop), dtype=np.intp)
        leaves, comes = np.isin(network.donors, nodes), np.isin(network.recipients, nodes)
        stays = leaves & comes
        if (least[:, stays] == least[:1, stays]).all():
            continue  # to mix what has one content is exact
        passes = np.zeros((len(least), len(nodes) ** 2))
        givers, getters = (np.searchsorted(nodes, side[stays]) for side in (network.donors, network.recipients))
        np.add.at(passes.T, givers * len(nodes) + getters, least[:, stays].T)
        visits = np.linalg.inv(np.eye(len(nodes)) - passes.reshape(-1, len(nodes), len(nodes))).clip(0.0)
        arcs = np.flatnonzero(comes & ~leaves)
        starts = np.searchsorted(nodes, network.recipients[arcs])
        ways.append((arcs.repeat(len(nodes)), np.tile(nodes, len(arcs)), visits[:, starts].reshape(len(least), -1)))
    arcs, ends, visits = (np.concatenate(parts, axis=-1) for parts in zip(*ways, strict=True))
    return arcs, ends, visits


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
