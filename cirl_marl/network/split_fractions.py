"""How arcs of law ``share`` divide what leaves their donor, and where such splits could keep mass for ever.

Controlled arcs k of a donor ask for shares a_k in [low_k, high_k]; the others keep their proportions π in what is left.
Shares that ask for more than there is are cut towards their lower bounds, all by the same factor::

    s_k = low_k + (a_k − low_k)·min(1, (1 − Σ low)/Σ(a − low)),    s_j = π_j·(1 − Σ s_k)

so that they sum to 1 and low_k ≤ s_k ≤ high_k, always.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cirl_marl.network.declarations import with_field_docs
from cirl_marl.network.elements import Law
from cirl_marl.network.rowsum import Floats, single_column
from cirl_marl.network.series import Series
from cirl_marl.network.specification import Specification

ROUNDING = 1e-12
"""By how much lowest shares may exceed 1 together, as sums of decimals round."""
LEAST = 1e-9
"""Share that has to leave a loop in each round at the least; a smaller one is taken for a rounding of none."""
SUMS = 1e-6
"""Distance from 1 at which given shares count as summing to it; they are then scaled to do so."""


@with_field_docs
@dataclass(frozen=True, slots=True)
class Split:
    """The arcs that share what leaves one node; where nothing changes its tables are views of one column."""

    donor: Annotated[str, "the node"]
    controlled_arcs: Annotated[tuple[int, ...], "arcs whose shares controls set, by position"]
    other_arcs: Annotated[tuple[int, ...], "arcs that share what is left"]
    bounds: Annotated[Floats, "low, neutral and high share of each controlled arc, shape (3, controlled, horizon)"]
    stated_shares: Annotated[
        Floats, "share of each other arc under neutral control, NaN for the rest, shape (others, horizon)"
    ]

    @property
    def proportions(self) -> Floats:
        """Return π of the other arcs, which sum to 1, shape (others, horizon)."""
        bounds, given = single_column(self.bounds), single_column(self.stated_shares)
        return np.broadcast_to(proportions(given, 1.0 - bounds[1].sum(axis=0)), self.stated_shares.shape)

    @property
    def table(self) -> Floats:
        """Return what there is to know of each interval, one column if nothing changes, shape (numbers, intervals)."""
        bounds, proportions = single_column(self.bounds), single_column(self.proportions)
        return np.concatenate([bounds.reshape(-1, bounds.shape[-1]), proportions])

    def least(self, leaving: Sequence[bool], step: int) -> float:
        """Return the least that the arcs ``leaving``, one truth value for each arc, get together in an interval."""
        flags = np.asarray(leaving, dtype=bool)
        out, other = flags[: len(self.controlled_arcs)], flags[len(self.controlled_arcs) :]
        low, _, high = self.bounds[:, :, step]
        sure = float(low[out].sum())
        left = max(0.0, 1.0 - sure - float(high[~out].sum()))
        parts = proportions(self.stated_shares[:, step], 1.0 - self.bounds[1, :, step].sum(axis=0))
        return sure + left * float(parts[other].sum())

    def problems(self) -> Iterator[str]:
        """Yield why these are no shares of a whole in some interval."""
        low, neutral, _ = single_column(self.bounds).sum(axis=1)
        given = np.nansum(single_column(self.stated_shares), axis=0)
        rests = int(np.isnan(self.stated_shares[:, 0]).sum())
        where = f"node '{self.donor}'"
        if not self.other_arcs:
            yield f"{where}: all its shares have controls; one arc without a control has to take what they leave"
        elif rests > 1:
            yield f"{where}: {rests} arcs of law 'share' state no share; only one can take the rest"
        elif (low > 1 + ROUNDING).any():
            yield f"{where}: the lowest shares of its arcs sum to {low.max():g}, more than 1"
        elif rests and (neutral + given > 1 + SUMS).any():
            most = (neutral + given).max()
            yield f"{where}: the shares of its arcs sum to {most:g}, more than 1, though one takes the rest"
        elif not rests and (abs(neutral + given - 1) > SUMS).any():
            worst = (neutral + given)[abs(neutral + given - 1).argmax()]
            yield f"{where}: the shares of its arcs sum to {worst:g}, not to 1; one may be left out and takes the rest"
        elif not rests and (given == 0).any():
            yield f"{where}: nothing is left for the shares without control; leave one out, and it takes the rest"


def proportions(given: Floats, left: Floats) -> Floats:
    """Return π of arcs without control, which sum to 1, shape (arcs, …).

    Args:
        given: their shares, NaN for the one that takes the rest, shape (arcs, …).
        left: what neutral control leaves to them, shape (…).
    """
    rest = np.isnan(given)
    weights = np.where(rest, np.maximum(left - np.nansum(given, axis=0), 0.0), given)
    total = weights.sum(axis=0)
    # where neutral control leaves nothing to them, the one of the rest takes what there may be
    weights = np.where(total > 0, weights, rest)
    found: Floats = weights / weights.sum(axis=0)
    return found


def splits(network: Specification) -> list[Split]:
    """Return the splits of a network, in the order of their nodes."""
    arcs: dict[str, list[int]] = {}
    for k, arc in enumerate(network.arcs):
        if arc.law is Law.SHARE:
            arcs.setdefault(arc.donor, []).append(k)
    horizon = network.episode.horizon
    found = []
    for node in network.nodes:
        mine = [(k, network.arcs[k]) for k in arcs.get(node.id, ())]
        if mine:
            controls = [arc.control for _, arc in mine if arc.control is not None]
            others = [(k, arc.share) for k, arc in mine if arc.control is None]
            sides = [[getattr(c, side) for c in controls] for side in ("low", "neutral", "high")]
            shares = [np.nan if share is None else share for _, share in others]
            values = [*(value for side in sides for value in side), *shares]
            columns = horizon if any(isinstance(value, Series) for value in values) else 1
            bounds = [[network.interval_means(value)[:columns] for value in side] for side in sides]
            given = [network.interval_means(share)[:columns] for share in shares]
            found.append(
                Split(
                    donor=node.id,
                    controlled_arcs=tuple(k for k, arc in mine if arc.control is not None),
                    other_arcs=tuple(k for k, _ in others),
                    bounds=np.broadcast_to(
                        np.array(bounds, dtype=float).reshape(3, -1, columns), (3, len(controls), horizon)
                    ),
                    stated_shares=np.broadcast_to(
                        np.array(given, dtype=float).reshape(-1, columns), (len(others), horizon)
                    ),
                )
            )
    return found


def trap_problems(network: Specification, divided: Sequence[Split]) -> Iterator[str]:
    """Yield a loop of nodes without stock that could keep mass for ever, in the first interval in which there is one.

    Of all such nodes those are removed whose least share leaving the set is positive, again and again; mass leaves
    what is removed sooner or later, whatever the controls. What remains can pass mass round within itself.
    """
    passing = {node.id for node in network.nodes if not node.stores}
    by_donor = {each.donor: each for each in divided if each.donor in passing}
    tables = [each.table for each in by_donor.values()]
    width = max((table.shape[1] for table in tables), default=1)
    columns = np.concatenate([np.empty((0, width)), *(np.broadcast_to(t, (len(t), width)) for t in tables)])
    for step in np.unique(columns, axis=1, return_index=True)[1].tolist() if len(columns) else ():
        if trapped := _trapping_nodes(network, by_donor, step):
            loop = _loop(network, by_donor, trapped)
            when = "" if (columns == columns[:, :1]).all() else f" in interval {step}"
            yield (
                f"nodes {', '.join(loop)} store nothing and can pass all they get round in a loop{when}: the arcs that "
                f"leave it need a share, or a lowest share, above {LEAST:g}, or one of the nodes a stock"
            )
            return


def _trapping_nodes(network: Specification, by_donor: dict[str, Split], step: int) -> set[str]:
    """Return the largest set of nodes without stock that can keep all they get, in one interval."""
    held = set(by_donor)
    feeding: dict[str, set[str]] = {}
    for donor, split in by_donor.items():
        for k in (*split.controlled_arcs, *split.other_arcs):
            feeding.setdefault(network.arcs[k].recipient, set()).add(donor)
    waiting = sorted(held)
    while waiting:
        node = waiting.pop()
        if node in held:
            split = by_donor[node]
            leaving = [network.arcs[k].recipient not in held for k in (*split.controlled_arcs, *split.other_arcs)]
            if split.least(leaving, step) > LEAST:
                held.discard(node)
                waiting += sorted(feeding.get(node, set()) & held)
    return held


def _loop(network: Specification, by_donor: dict[str, Split], trapped: set[str]) -> list[str]:
    """Return nodes of ``trapped`` in the order in which mass passes round them."""
    path = [min(trapped)]
    while True:
        split = by_donor[path[-1]]
        recipients = [network.arcs[k].recipient for k in (*split.controlled_arcs, *split.other_arcs)]
        following = next(each for each in recipients if each in trapped)
        if following in path:
            return path[path.index(following) :]
        path.append(following)
