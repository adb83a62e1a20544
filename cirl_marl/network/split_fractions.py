"""How arcs of law ``share`` divide what leaves their donor, and where such splits could keep mass for ever.

Controlled arcs k of a donor ask for shares a_k in [low_k, high_k]; the others keep their proportions π in what is left.
Shares that ask for more than there is are cut towards their lower bounds, all by the same factor::

    s_k = low_k + (a_k − low_k)·min(1, (1 − Σ low)/Σ(a − low)),    s_j = π_j·(1 − Σ s_k)

so that they sum to 1 and low_k ≤ s_k ≤ high_k, always. An order from a node that stores nothing takes any share, as
much as it is of what passes there in an interval (``dynamics.orders``).
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray

from cirl_marl.network.declarations import with_field_docs
from cirl_marl.network.elements import Arc, Control, ControlKind, Law
from cirl_marl.network.rowsum import Floats, Integers, single_column
from cirl_marl.network.series import Series
from cirl_marl.network.specification import Specification

ROUNDING = 1e-12
"""By how much lowest shares may exceed 1 together, as sums of decimals round."""
LEAST = 1e-9
"""Share that has to leave a loop in each round at the least; a smaller one is taken for a rounding of none."""
ANY_SHARE = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.0, high=1.0)
"""What an order takes of what passes a node that stores nothing."""
SUMS = 1e-6
"""Distance from 1 at which given shares count as summing to it; they are then scaled to do so."""


@with_field_docs
@dataclass(frozen=True)
class Split:
    """The arcs that share what leaves one node; where nothing changes its tables are views of one column."""

    donor: Annotated[str, "the node"]
    controlled_arcs: Annotated[tuple[int, ...], "arcs whose shares controls set, by position"]
    other_arcs: Annotated[tuple[int, ...], "arcs that share what is left"]
    bounds: Annotated[Floats, "low, neutral and high share of each controlled arc, shape (3, controlled, horizon)"]
    stated_shares: Annotated[
        Floats, "share of each other arc under neutral control, NaN for the rest, shape (others, horizon)"
    ]

    @cached_property
    def proportions(self) -> Floats:
        """Return π of the other arcs, which sum to 1, shape (others, horizon)."""
        bounds, shares = single_column(self.bounds), single_column(self.stated_shares)
        return np.broadcast_to(proportions(shares, 1.0 - bounds[1].sum(axis=0)), self.stated_shares.shape)

    @cached_property
    def table(self) -> Floats:
        """Return what there is to know of each interval, one column if nothing changes, shape (numbers, intervals)."""
        bounds, proportions = single_column(self.bounds), single_column(self.proportions)
        return np.concatenate([bounds.reshape(-1, bounds.shape[-1]), proportions])

    def without(self, orders: Collection[int]) -> Split:
        """Return the split without the arcs that order."""
        places = [n for n, k in enumerate(self.controlled_arcs) if k not in orders]
        arcs, bounds = tuple(self.controlled_arcs[n] for n in places), single_column(self.bounds)[:, places]
        shape = (3, len(places), self.bounds.shape[-1])
        return replace(self, controlled_arcs=arcs, bounds=np.broadcast_to(bounds, shape))

    def least(self, leaves: NDArray[np.bool_], steps: Integers) -> Floats:
        """Return the least that some of the arcs get together in some intervals, shape (intervals,).

        Args:
            leaves: which arcs, the controlled ones first, shape (arcs, intervals).
            steps: the intervals.
        """
        out, free = leaves[: len(self.controlled_arcs)], leaves[len(self.controlled_arcs) :]
        low, _, high = self.bounds[:, :, steps]
        certain = np.where(out, low, 0.0).sum(axis=0)
        # the arcs that stay take their highest shares first
        room = np.maximum(0.0, 1.0 - certain - np.where(out, 0.0, high).sum(axis=0))
        return np.asarray(certain + room * np.where(free, self.proportions[:, steps], 0.0).sum(axis=0))

    def problems(self) -> Iterator[str]:
        """Yield why these are no shares of a whole in some interval."""
        low, neutral, _ = single_column(self.bounds).sum(axis=1)
        stated_sum = np.nansum(single_column(self.stated_shares), axis=0)
        rests = int(np.isnan(self.stated_shares[:, 0]).sum())
        subject = f"node '{self.donor}'"
        if not self.other_arcs:
            remedy = "an arc of law 'share' without a control has to take the rest"
            yield f"{subject}: controls or orders set all that leaves it; {remedy}"
        elif rests > 1:
            yield f"{subject}: {rests} arcs of law 'share' state no share; only one can take the rest"
        elif (low > 1 + ROUNDING).any():
            yield f"{subject}: the lowest shares of its arcs sum to {low.max():g}, more than 1"
        elif rests and (neutral + stated_sum > 1 + SUMS).any():
            most = (neutral + stated_sum).max()
            yield f"{subject}: the shares of its arcs sum to {most:g}, more than 1, though one takes the rest"
        elif not rests and (abs(neutral + stated_sum - 1) > SUMS).any():
            worst = (neutral + stated_sum)[abs(neutral + stated_sum - 1).argmax()]
            remedy = "one may be left out and takes the rest"
            yield f"{subject}: the shares of its arcs sum to {worst:g}, not to 1; {remedy}"
        elif not rests and (stated_sum == 0).any():
            yield f"{subject}: nothing is left for the shares without control; leave one out, and it takes the rest"


def proportions(shares: Floats, remainder: Floats) -> Floats:
    """Return π of arcs without control, which sum to 1, shape (arcs, …).

    Args:
        shares: their shares, NaN for the one that takes the rest, shape (arcs, …).
        remainder: what neutral control leaves to them, shape (…).
    """
    rest = np.isnan(shares)
    weights = np.where(rest, np.maximum(remainder - np.nansum(shares, axis=0), 0.0), shares)
    total = weights.sum(axis=0)
    # where neutral control leaves nothing to them, the one of the rest takes what there may be
    weights = np.where(total > 0, weights, rest)
    return np.asarray(weights / weights.sum(axis=0))


def share_ranges(split: Split, wishes: Floats) -> Floats:
    """Return the lowest and highest share of each arc, first of those with a control, shape (2, arcs, steps).

    A share rises with what its own arc asks for and falls with what the others do.

    Args:
        split: the arcs.
        wishes: least and most that each control asks for, shape (2, controlled, steps).
    """
    low = split.bounds[0]
    room = np.maximum(1.0 - low.sum(axis=0), 0.0)
    over = np.maximum(wishes - low, 0.0)
    # against the least of one arc stands the most of all others, and the other way round
    rivals = (over.sum(axis=1, keepdims=True) - over)[::-1]
    total = over + rivals
    cut = np.divide(room, total, out=np.ones_like(total), where=total > room)
    rest = room - np.minimum(over.sum(axis=1), room)[::-1]
    return np.concatenate([low + over * cut, rest[:, None] * split.proportions], axis=1)


def is_order(arc: Arc, stockless: Collection[str]) -> bool:
    """Return whether an arc orders from one of the nodes that store nothing: a flow, whatever enters them."""
    return arc.donor in stockless and arc.law in (Law.CONTROLLED, Law.EXOGENOUS)


def splits(network: Specification) -> list[Split]:
    """Return the splits of a network, in the order of their nodes."""
    arcs: dict[str, list[int]] = {}
    stockless = {node.id for node in network.nodes if not node.stores}
    for k, arc in enumerate(network.arcs):
        if arc.law is Law.SHARE or is_order(arc, stockless):
            arcs.setdefault(arc.donor, []).append(k)
    horizon = network.episode.horizon
    divisions = []
    for node in network.nodes:
        exits = [(k, network.arcs[k]) for k in arcs.get(node.id, ())]
        if exits:
            controlled_exits = {
                k: arc.control for k, arc in exits if arc.control is not None and arc.control.kind is ControlKind.SHARE
            }
            controlled_exits |= {k: ANY_SHARE for k, arc in exits if arc.law is not Law.SHARE}
            controls = controlled_exits.values()
            free = [(k, arc.share) for k, arc in exits if k not in controlled_exits]
            sides: list[list[Any]] = [[getattr(c, side) for c in controls] for side in ("low", "neutral", "high")]
            shares: list[Any] = [np.nan if share is None else share for _, share in free]
            values = [*(value for side in sides for value in side), *shares]
            columns = 1
            if any(isinstance(value, Series) for value in values):
                columns = horizon
                sides = [list(map(network.interval_means, side)) for side in sides]
                shares = list(map(network.interval_means, shares))
            bounds = np.array(sides, dtype=float).reshape(3, -1, columns)
            stated = np.array(shares, dtype=float).reshape(-1, columns)
            split = Split(
                donor=node.id,
                controlled_arcs=tuple(controlled_exits),
                other_arcs=tuple(k for k, _ in free),
                bounds=np.broadcast_to(bounds, (3, len(controls), horizon)),
                stated_shares=np.broadcast_to(stated, (len(free), horizon)),
            )
            divisions.append(split)
    return divisions


def trap_problems(network: Specification, divisions: Sequence[Split]) -> Iterator[str]:
    """Yield a loop of nodes without stock that could keep mass for ever, in the first interval in which there is one.

    Of all such nodes those are removed whose least share leaving the set is positive, again and again; mass leaves
    what is removed sooner or later, whatever the controls. What remains can pass mass round within itself.
    """
    stockless = {node.id for node in network.nodes if not node.stores}
    by_donor = {split.donor: split for split in divisions if split.donor in stockless}
    tables = [split.table for split in by_donor.values()]
    if not tables:
        return
    width = max(table.shape[1] for table in tables)
    columns = np.concatenate([np.broadcast_to(table, (len(table), width)) for table in tables])
    steps = np.unique(columns, axis=1, return_index=True)[1]
    traps_mass = _trapping_nodes(network, by_donor, steps)
    if traps_mass.any():
        first = int(traps_mass.any(axis=0).argmax())
        trap = {node for node, traps in zip(by_donor, traps_mass[:, first], strict=True) if traps}
        loop = _loop(network, by_donor, trap)
        interval = "" if (columns == columns[:, :1]).all() else f" in interval {steps[first]}"
        yield (
            f"nodes {', '.join(loop)} store nothing and can pass all they get round in a loop{interval}: the arcs that "
            f"leave it need a share, or a lowest share, above {LEAST:g}, or one of the nodes a stock"
        )


def _trapping_nodes(network: Specification, by_donor: dict[str, Split], steps: Integers) -> NDArray[np.bool_]:
    """Return the largest set of nodes without stock that can keep all they get, by interval, (nodes, intervals)."""
    row = {donor: i for i, donor in enumerate(by_donor)}
    # a last row stands for all nodes with a stock, which trap nothing
    traps_mass = np.ones((len(row) + 1, len(steps)), dtype=bool)
    traps_mass[-1] = False
    ends, donors = {}, defaultdict(set)
    for donor, split in by_donor.items():
        ends[donor] = [row.get(network.arcs[k].recipient, -1) for k in (*split.controlled_arcs, *split.other_arcs)]
        for end in ends[donor]:
            donors[end].add(donor)
    queue = sorted(by_donor)
    while queue:
        donor = queue.pop()
        i = row[donor]
        if traps_mass[i].any():
            still_traps = traps_mass[i] & (by_donor[donor].least(~traps_mass[ends[donor]], steps) <= LEAST)
            if (still_traps != traps_mass[i]).any():
                traps_mass[i] = still_traps
                queue += sorted(donors[i])
    return traps_mass[:-1]


def _loop(network: Specification, by_donor: dict[str, Split], trap: set[str]) -> list[str]:
    """Return nodes of ``trap`` in the order in which mass passes round them."""
    path = [min(trap)]
    while True:
        split = by_donor[path[-1]]
        recipients = [network.arcs[k].recipient for k in (*split.controlled_arcs, *split.other_arcs)]
        successor = next(node for node in recipients if node in trap)
        if successor in path:
            return path[path.index(successor) :]
        path.append(successor)
