"""Which contents stocks and flows can have at any time, whatever agents do."""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from cirl_marl.network.rowsum import Floats, Integers
from cirl_marl.network.substances import changing_sources, separates

SETTLED, ROUNDS = 1e-12, 1000
"""Change of an end of a range in a round that counts as none, and rounds after which one that changes is let go."""
ROUND_OFF = 1e-9
"""By how much sums may round."""
MANY, POLICIES = 64, 100
"""Nodes of loops whose visits are all looked for, and policies that are tried; a handful is enough."""

Ways = tuple[Integers, Integers, Floats]
"""Arcs that enter loops, nodes that they lead past, and how often."""


def reachable_contents(network: Any, starts: Floats, shares: Floats, subjects: set[int]) -> tuple[Floats, Floats]:
    """Return what part of each stock and of each flow each component may be at any time.

    Stocks begin with their content and mix what enters; what a node hands on in shares that differ by component has
    s_c·x_c of Σ s·x. The ranges are the least that contain ``starts`` and reproduce themselves. Where material goes
    round past nodes without stock, s_c may also be how often it passes a node in all; what both allow is left. In loops
    of many nodes that is looked for where it matters to ``subjects``.

    Args:
        network: whose nodes mix and separate.
        starts: least and greatest part of each component in stocks at the start, or in what sources give, shape (2,
            components, stores); from 1 to 0 where there is nothing.
        shares: least and greatest share of each arc of law ``share``, 1 of others, by component, of any interval, shape
            (2, components, arcs).
        subjects: nodes of which, or of whose flows, contents are looked for.

    Returns:
        Least and greatest part, shapes (2, components, stores) and (2, components, arcs); from 1 to 0 of what there
        never is, from 0 to 1 of stocks of changing sources.
    """
    is_separate = np.zeros(len(network.arcs), dtype=bool)
    for split in network.splits:
        is_separate[[*split.controlled_arcs, *split.other_arcs]] = separates(network, split)
    no_ways = np.empty(0, np.intp), np.empty(0, np.intp), shares[:, :, :0]
    ranges = _settled_ranges(network, starts, shares, is_separate, no_ways)
    ways = _loop_visits(network, shares, is_separate, subjects)
    if len(ways[0]):
        with_visits = _settled_ranges(network, starts, shares, is_separate, ways)
        ranges = np.stack([np.maximum(ranges[0], with_visits[0]), np.minimum(ranges[1], with_visits[1])])
    flows = _handed_on(ranges[:, :, network.donors], shares, is_separate)
    stocks = ranges[:, :, : len(network.stores)].copy()
    stocks[..., [network.node_index[source.id] for source in changing_sources(network)]] = [[[0.0]], [[1.0]]]
    return stocks, flows


def _settled_ranges(network: Any, starts: Floats, shares: Floats, is_separate: NDArray[np.bool_], ways: Ways) -> Floats:
    """Return the ranges of nodes that reproduce themselves, shape (2, components, nodes); ``ways`` go past loops."""
    ranges = np.tile([[[1.0]], [[0.0]]], (1, starts.shape[1], len(network.nodes)))
    ranges[:, :, : len(network.stores)] = starts
    entries, passed, visits = ways
    plain = np.flatnonzero(~np.isin(network.recipients, passed))
    ends = np.concatenate([network.recipients[plain], passed])
    for done in range(ROUNDS + ranges.size):
        flows = _handed_on(ranges[:, :, network.donors], shares, is_separate)
        looped = _handed_on(flows[:, :, entries], visits, np.ones(len(entries), dtype=bool))
        wider, flows = ranges.copy(), np.concatenate([flows[:, :, plain], looped], axis=2)
        np.minimum.at(wider[0].T, ends, flows[0].T)
        np.maximum.at(wider[1].T, ends, flows[1].T)
        changed = np.abs(wider - ranges) > SETTLED
        ranges = wider
        if not changed.any():
            break
        if done >= ROUNDS:
            ranges[0][changed[0]], ranges[1][changed[1]] = 0.0, 1.0
    changes = ranges[0] != ranges[1]
    margin = np.array([-1e-9, 1e-9])[:, None, None] * changes  # of rounding, and what was too little to have settled
    within: Floats = (ranges + margin).clip(0.0, 1.0)
    return within


def _loop_visits(network: Any, shares: Floats, is_separate: NDArray[np.bool_], subjects: set[int]) -> Ways:
    """Return how often each component of what enters a loop of nodes without stock passes its nodes.

    Only loops that separate are among them, past which nothing can go round for ever. Of more than ``MANY`` nodes those
    are looked at that are subjects, or from which what leaves the loop may come to one.

    Returns:
        Arcs that enter, and nodes that are passed, shape (ways,) each, and least and most visits, shape (2, components,
        ways).
    """
    stores = len(network.stores)
    is_within = (network.donors >= stores) & (network.recipients >= stores)
    graph = nx.DiGraph(zip(network.donors[is_within].tolist(), network.recipients[is_within].tolist(), strict=True))
    whole = network_digraph(network)
    upstream = [*subjects.union(*(nx.ancestors(whole, node) for node in subjects))]
    ways: list[Ways] = [(np.empty(0, np.intp), np.empty(0, np.intp), shares[:, :, :0])]
    for loop in nx.strongly_connected_components(graph):
        nodes = np.array(sorted(loop), dtype=np.intp)
        leaves, comes = np.isin(network.donors, nodes), np.isin(network.recipients, nodes)
        if not is_separate[leaves & comes].any():
            continue  # to mix what has one content is exact
        outlets = nodes
        if len(nodes) > MANY:
            is_way_out = leaves & ~comes & np.isin(network.recipients, upstream)
            outlets = np.union1d(network.donors[is_way_out], [*subjects & loop]).astype(np.intp)
        if not len(outlets):
            continue
        givers = np.searchsorted(nodes, network.donors[leaves])
        getters = np.where(comes, np.searchsorted(nodes, network.recipients), len(nodes))[leaves]
        targets = np.searchsorted(nodes, outlets)
        visits = [
            [_visits(part[:, leaves], givers, getters, len(nodes), targets, side) for part in shares.swapaxes(0, 1)]
            for side in (-1, 1)
        ]
        if not np.isfinite(visits).all():
            continue
        arcs = np.flatnonzero(comes & ~leaves)
        starts = np.searchsorted(nodes, network.recipients[arcs])
        totals = np.array(visits)[:, :, starts].reshape(2, len(shares[0]), -1)
        ways.append((arcs.repeat(len(outlets)), np.tile(outlets, len(arcs)), totals))
    arcs, ends, totals = (np.concatenate(parts, axis=-1) for parts in zip(*ways, strict=True))
    return arcs, ends, totals


def network_digraph(network: Any) -> Any:
    """Return the nodes, by their numbers, and which of them can give to which."""
    graph = nx.DiGraph(zip(network.donors.tolist(), network.recipients.tolist(), strict=True))
    graph.add_nodes_from(range(len(network.nodes)))
    return graph


def _visits(shares: Floats, givers: Integers, getters: Integers, count: int, targets: Integers, side: int) -> Floats:
    """Return the least (``side`` −1) or most (1) visits of targets, of what enters each node, (entries, targets).

    They are the values of a Markov decision process, one for each node that is visited, found by policy iteration.

    Args:
        shares: least and greatest share of each arc that leaves a node, shape (2, arcs).
        givers: the nodes that they leave, shape (arcs,).
        getters: those that they enter, ``count`` for others.
        count: number of nodes.
        targets: the nodes that are visited.
        side: which visits.

    References: Howard 1960.
    """
    (least, most), endless = shares, np.full((count, len(targets)), np.inf)
    remainder, values = np.ones(count), np.zeros((len(targets), count + 1))
    np.subtract.at(remainder, givers, least)
    sorted_givers = np.sort(givers)
    first, policy = np.searchsorted(sorted_givers, sorted_givers), np.full((len(targets), len(givers)), -1.0)
    rows = np.arange(len(targets))  # whose policies have not settled
    for _ in range(POLICIES):
        # each node's shares get their room in the order of what they bring: a fractional knapsack
        order = np.lexsort((-side * values[rows][:, getters], np.tile(givers, (len(rows), 1))))
        room = (most - least)[order]
        before = np.cumsum(room, axis=1) - room
        before -= before[:, first]
        parts = least[order] + (remainder[sorted_givers] - before).clip(0.0, room)
        better = np.empty_like(parts)
        np.put_along_axis(better, order, parts, axis=1)
        is_other = (better != policy[rows]).any(axis=1)
        rows = rows[is_other]
        if not len(rows):
            return values[:, :count].T.clip(0.0)
        policy[rows] = better[is_other]
        try:
            visits = _values_of(policy[rows], targets[rows], givers, getters, count)
        except RuntimeError:  # singular: what goes round for ever
            return endless
        if visits.min() < -ROUND_OFF:
            return endless
        change = np.abs(visits - values[rows, :count]).max(axis=1)
        values[rows, :count] = visits
        rows = rows[change > SETTLED * visits.max(axis=1)]
    return endless


def _values_of(policy: Floats, targets: Integers, givers: Integers, getters: Integers, count: int) -> Floats:
    """Return how often mass that enters a node passes each target, by the target's policy, shape (targets, nodes).

    Targets with the same shares, (targets, arcs), have one factorization.
    """
    from scipy.sparse.linalg import splu

    values, within = np.empty((len(targets), count)), getters < count
    groups: dict[bytes, list[int]] = {}
    for row, shares in enumerate(policy):
        groups.setdefault(shares.tobytes(), []).append(row)
    for rows in groups.values():
        routing = (policy[rows[0], within], (givers[within], getters[within]))
        left = sparse.eye_array(count, format="csc") - sparse.csc_array(routing, shape=(count, count))
        values[rows] = splu(left).solve(np.eye(count)[:, targets[rows]]).T
    return values


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
