"""How often mass can pass through nodes that store nothing, whatever the shares: a Markov decision process.

The greatest shares of a donor sum to more than 1, so a matrix of them may let mass multiply. What one split can do at
most for the values V of its recipients is a fractional knapsack, and the greatest number of passes solves
v = 1 + max_s P(s) v, by policy iteration (Howard 1960).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Annotated

import numpy as np
from scipy import sparse

from cirl_marl.errors import NetworkError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.split_fractions import Split

MOST_ROUNDS = 100
"""Policies that are tried; a handful is enough."""
SLACK = 1e-8
"""Relative widening that makes up for what the solution of the linear systems leaves open."""


@positional_record
class _Alike:
    """Splits of as many controlled arcs and as many others, whose choices are made together."""

    donors: Annotated[Integers, "the nodes, shape (splits,)"]
    ends: Annotated[Integers, "what the arcs enter, the controlled ones first, -1 at stocks, (splits, arcs)"]
    low: Annotated[Floats, "least shares of the controlled arcs, shape (splits, controlled, horizon)"]
    high: Annotated[Floats, "and the greatest"]
    proportions: Annotated[Floats, "of the other arcs in what is left, shape (splits, others, horizon)"]

    @classmethod
    def of(cls, members: Sequence[tuple[int, Split, Integers]]) -> _Alike:
        """Stack splits, each with its node and what its arcs enter."""
        nodes, alike, ends = zip(*members, strict=True)
        bounds = np.stack([split.bounds for split in alike])
        proportions = np.stack([split.proportions for split in alike])
        return cls(
            np.array(nodes, dtype=np.intp), np.maximum(np.stack(ends), -1), bounds[:, 0], bounds[:, 2], proportions
        )

    def end_values(self, values: Floats) -> Floats:
        """Return the values at the ends of the arcs, (splits, arcs, n); those of stocks are the last of ``values``."""
        return values[self.ends]

    def best_shares(self, values: Floats, step: int) -> Floats:
        """Return the shares that are best for ``values`` in one interval, shape (splits, arcs, n), or n = 1 for all."""
        count = self.low.shape[1] + 1
        if count > 2:
            return self._shares(np.argsort(-self._choices(values, step), axis=1, kind="stable"), step)
        # one or two choices have an order or two, whatever the values
        order = np.arange(count)[None, :, None]
        shares = self._shares(order, step)
        if count == 2:
            choices = self._choices(values, step)
            shares = np.where(choices[:, :1] >= choices[:, 1:], shares, self._shares(order[:, ::-1], step))
        return shares

    def _choices(self, values: Floats, step: int) -> Floats:
        """Return the gains of controlled arcs, and the mean one of the others, which are one choice without bounds."""
        chosen, rest_gains = np.split(self.end_values(values), [self.low.shape[1]], axis=1)
        rest = (rest_gains * self.proportions[:, :, step, None]).sum(axis=1, keepdims=True)
        return np.concatenate([chosen, rest], axis=1)

    def _shares(self, order: Integers, step: int) -> Floats:
        """Return the shares if choices get all the room that they have one after the other: a fractional knapsack."""
        low, high, proportions = (table[:, :, step, None] for table in (self.low, self.high, self.proportions))
        order = np.broadcast_to(order, (len(low), *order.shape[1:]))
        room = np.ones(order.shape)
        room[:, :-1] = high - low
        sorted_room = np.take_along_axis(room, order, axis=1)
        before = np.cumsum(sorted_room, axis=1) - sorted_room
        allotment = np.empty_like(room)
        remainder = 1.0 - low.sum(axis=1, keepdims=True)
        np.put_along_axis(allotment, order, np.clip(remainder - before, 0.0, sorted_room), axis=1)
        return np.concatenate([low + allotment[:, :-1], proportions * allotment[:, -1:]], axis=1)


class VisitBounds:
    """The splits of nodes that store nothing, as choices.

    Attributes:
        kinds: intervals of which one stands for all in which shares have the same ranges.
    """

    def __init__(self, network: Network, network_splits: Sequence[Split]) -> None:
        """Compile the splits of ``network`` (``split_fractions.splits``)."""
        stores, self._network = len(network.stores), network
        self._nodes = len(network.nodes) - stores
        node_splits = [(network.node_index[split.donor] - stores, split) for split in network_splits]
        alike: dict[tuple[int, int], list[tuple[int, Split, Integers]]] = {}
        for i, split in node_splits:
            if i >= 0:
                ends = network.recipients[[*split.controlled_arcs, *split.other_arcs]] - stores
                alike.setdefault((len(split.controlled_arcs), len(split.other_arcs)), []).append((i, split, ends))
        self._splits = [_Alike.of(members) for members in alike.values()]
        tables = [table for i, split in node_splits if i >= 0 and (table := split.table).shape[1] > 1]
        self.kinds: Sequence[int] = [0]
        if tables:
            self.kinds = np.unique(np.concatenate(tables), axis=1, return_index=True)[1].tolist()

    def best(self, values: Floats, step: int) -> Floats:
        """Return max_s Σ_j s_ij V_j of each node i in one interval, V being 0 at stocks; shapes (nodes, n)."""
        best_values, values = np.empty_like(values), _with_stocks(values)
        for group in self._splits:
            shares = group.best_shares(values, step)
            best_values[group.donors] = (shares * group.end_values(values)).sum(axis=1)
        return best_values

    def total(self, step: int) -> Floats:
        """Return the most passes in all of mass that enters each node, in one interval, shape (nodes,)."""
        from scipy.sparse.linalg import splu

        passes = np.ones(self._nodes)
        for _ in range(MOST_ROUNDS):
            matrix = self._among(passes, step)
            try:
                better = splu(sparse.eye_array(self._nodes, format="csc") - matrix).solve(np.ones(self._nodes))
            except RuntimeError:  # singular: so little leaves a loop that nothing is left of it in a sum with 1
                break
            if (better <= passes * (1 + SLACK / 10)).all():
                passes = np.maximum(better, passes)
                # v ≥ 1 + max_s P(s) v is all that is needed: make up for what the solution leaves open
                short = float((passes - self.best(passes[:, None], step)[:, 0]).min(initial=1.0))
                if short > 0:
                    most: Floats = passes * (1 + SLACK) / min(short, 1.0)
                    return most
            if not np.isfinite(better).all() or better.min() < 1.0 - SLACK:  # rounding leaves a little less than 1
                break
            passes = np.maximum(better, passes)
        raise NetworkError(
            f"network '{self._network.name}'",
            ["nodes that store nothing pass mass round so often that it cannot be told how much goes through them"],
        )

    def _among(self, values: Floats, step: int) -> sparse.csc_array:
        """Return the shares that are best for ``values``, shape (nodes,), of what goes on to nodes without stock."""
        rows, columns, shares = (np.concatenate(parts) for parts in zip(*self._entries(values, step), strict=True))
        on = columns >= 0
        return sparse.csc_array((shares[on], (rows[on], columns[on])), shape=(self._nodes, self._nodes))

    def _entries(self, values: Floats, step: int) -> Iterator[tuple[Integers, Integers, Floats]]:
        yield np.empty(0, dtype=np.intp), np.empty(0, dtype=np.intp), np.empty(0)
        for group in self._splits:
            shares = group.best_shares(_with_stocks(values[:, None]), step)
            yield np.repeat(group.donors, group.ends.shape[1]), group.ends.ravel(), shares.ravel()


def _with_stocks(values: Floats) -> Floats:
    """Return the values of nodes and, in a last row, those of stocks, which are 0."""
    return np.append(values, np.zeros((1, values.shape[1])), axis=0)
