"""Nodes that store nothing, and arcs that share what leaves a node: ranges of shares, and rows of the program."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cirl_marl.network import Floats, Integers
from cirl_marl.network.splits import Split
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout
from cirl_marl.optimum.rows import ProgramRows


def passing(admissible: Admissible, layout: Layout, step: int, rows: ProgramRows) -> None:
    """Add what holds of shares in an interval, each 0; keys (2, moment, what, which).

    What enters a node that stores nothing is its throughput Q, and so is what leaves it. The shares of what a stock
    releases sum to the release. Arcs without control keep their proportions. Where all shares are given, the flow laws
    say it already.
    """
    network, moment = admissible.network, layout.moment_column
    stores, nodes, arcs = len(network.stores), len(network.nodes), np.arange(len(network.arcs))
    row = np.full((len(layout.moments), nodes), -1)
    row[:, stores:] = rows.add(2, moment, 0, np.arange(stores, nodes))
    entering = network.recipients >= stores
    rows.put(row[:, network.recipients[entering]], layout.flow(moment) + arcs[entering], 1.0)
    rows.put(row[:, stores:], layout.stock(moment) + np.arange(stores, nodes), -1.0)
    for split in admissible.divided(step):
        donor = network.node_index[split.donor]
        out = np.array([*split.controlled, *split.others])
        total = rows.add(2, moment, 1, donor)
        rows.put(total, layout.flow(moment) + out, 1.0)
        rows.put(total, *_released(admissible, layout, step, donor, int(out[0])))
        lead, followers, ratio = leader(split, step)
        kept = rows.add(2, moment, 2, followers)
        rows.put(kept, layout.flow(moment) + followers, 1.0)
        rows.put(kept, layout.flow(moment) + lead, -ratio)


def _released(admissible: Admissible, layout: Layout, step: int, donor: int, arc: int) -> tuple[Integers, float]:
    """Return the columns, shape (moments, 1), of what is released, and minus the factor of it, of a donor's shares."""
    release = -float(admissible.base[step, arc])
    place = np.flatnonzero(layout.valves == donor)
    if len(place):
        return layout.valve(layout.moment_column) + place, release
    return layout.stock(layout.moment_column) + donor, release * float(admissible.valve[0, step, donor])


def leader(split: Split, step: int) -> tuple[int, Integers, Floats]:
    """Return the greatest of the arcs without control, the others of them, and these as parts of the greatest."""
    proportions = split.proportions[:, step]
    first = int(proportions.argmax())
    rest = np.arange(len(proportions)) != first
    return split.others[first], np.array(split.others, dtype=np.intp)[rest], proportions[rest] / proportions[first]


def followers(admissible: Admissible, step: int) -> Integers:
    """Return the arcs whose flows follow from one with which they share what others leave."""
    found: Sequence[Integers] = [leader(split, step)[1] for split in admissible.divided(step)]
    return np.concatenate([np.zeros(0, dtype=np.intp), *found])
