"""How often mass can pass through nodes that store nothing, whatever the shares: a Markov decision process.

The greatest shares of a donor sum to more than 1, so a matrix of them may let mass multiply. What one split can do at
most for the values V of its recipients is a fractional knapsack, and the greatest number of passes solves
v = 1 + max_s P(s) v, by policy iteration (Howard 1960).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from cirl_marl.errors import NetworkError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.splits import Split, splits

MOST_ROUNDS = 100
"""Policies that are tried; a handful is enough."""
SLACK = 1e-8
"""Relative widening that makes up for what the solution of the linear systems leaves open."""


class Passes:
    """The splits of nodes that store nothing, as choices.

    Attributes:
        kinds: intervals of which one stands for all in which shares have the same ranges.
    """

    def __init__(self, network: Network) -> None:
        """Compile the splits of ``network``."""
        stores, self._network = len(network.stores), network
        self._nodes = len(network.nodes) - stores
        found = [(network.node_index[split.donor] - stores, split) for split in splits(network)]
        self._splits: list[tuple[int, Split, Integers]] = [
            (i, split, network.recipients[[*split.controlled, *split.others]] - stores) for i, split in found if i >= 0
        ]
        tables = [table for _, split, _ in self._splits if (table := split.table).shape[1] > 1]
        self.kinds: Sequence[int] = [0]
        if tables:
            self.kinds = np.unique(np.concatenate(tables), axis=1, return_index=True)[1].tolist()

    def best(self, values: Floats, step: int) -> Floats:
        """Return max_s Σ_j s_ij V_j of each node i in one interval, V being 0 at stocks; shapes (nodes, n)."""
        found = np.empty_like(values)
        for i, split, ends in self._splits:
            found[i] = (self._chosen(split, ends, values, step) * _valued(values, ends)).sum(axis=0)
        return found

    def total(self, step: int) -> Floats:
        """Return the most passes in all of mass that enters each node, in one interval, shape (nodes,)."""
        passes = np.ones(self._nodes)
        for _ in range(MOST_ROUNDS):
            entries = [
                (i, int(j), share)
                for i, split, ends in self._splits
                for j, share in zip(ends, self._chosen(split, ends, passes[:, None], step)[:, 0], strict=True)
                if j >= 0
            ]
            rows, columns, shares = zip(*entries, strict=True) if entries else ((), (), ())
            kept = sparse.csc_array((shares, (rows, columns)), shape=(self._nodes, self._nodes))
            try:
                better = splu(sparse.eye_array(self._nodes, format="csc") - kept).solve(np.ones(self._nodes))
            except RuntimeError:  # singular: so little leaves a loop that nothing is left of it in a sum with 1
                break
            if (better <= passes * (1 + SLACK / 10)).all():
                passes = np.maximum(better, passes)
                # v ≥ 1 + max_s P(s) v is all that is needed: make up for what the solution leaves open
                short = float((passes - self.best(passes[:, None], step)[:, 0]).min(initial=1.0))
                if short > 0:
                    most: Floats = passes * (1 + SLACK) / min(short, 1.0)
                    return most
            if not np.isfinite(better).all() or better.min() < 1.0:
                break
            passes = np.maximum(better, passes)
        raise NetworkError(
            f"network '{self._network.name}'",
            ["nodes that store nothing pass mass round so often that it cannot be told how much goes through them"],
        )

    def _chosen(self, split: Split, ends: Integers, values: Floats, step: int) -> Floats:
        """Return the shares that are best for ``values``, first of controlled arcs, shape (arcs of the split, n)."""
        low, _, high = split.bounds[:, :, step, None]
        gains, others = np.split(_valued(values, ends), [len(split.controlled)])
        proportions = split.proportions[:, step, None]
        # what is left to the arcs without control counts as one choice without bounds, of their mean value
        gains = np.concatenate([gains, (others * proportions).sum(axis=0, keepdims=True)])
        room = np.concatenate([np.broadcast_to(high - low, (len(low), values.shape[1])), np.ones((1, values.shape[1]))])
        order = np.argsort(-gains, axis=0, kind="stable")
        sorted_room = np.take_along_axis(room, order, axis=0)
        before = np.cumsum(sorted_room, axis=0) - sorted_room
        taken = np.empty_like(room)
        np.put_along_axis(taken, order, np.clip(1.0 - low.sum() - before, 0.0, sorted_room), axis=0)
        return np.concatenate([low + taken[:-1], proportions * taken[-1]])


def _valued(values: Floats, ends: Integers) -> Floats:
    """Return the values at the ends of arcs, 0 at stocks, shape (arcs, n)."""
    return np.where(ends[:, None] >= 0, values[np.maximum(ends, 0)], 0.0)
