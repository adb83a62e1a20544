"""What stocks are worth at the start of each interval, from the multipliers of a program."""

from __future__ import annotations

import numpy as np

from cirl_marl.network import Floats
from cirl_marl.optimum.certificate import Certificate
from cirl_marl.optimum.program import Program, Programs


def stock_values(programs: Programs, problem: Program, certificate: Certificate, *, demands: int = 0) -> Floats:
    """Return how much the objective rises for a unit of mass more in a stock, new at the start of intervals.

    Of a node with a lifetime it is new as well: it leaves as what has just entered does. What more of a stock changes
    in boxes, in the envelopes of products and in what orders deliver at least is left out.

    Args:
        programs: what the program was made by, or made alike.
        problem: the program of a whole episode.
        certificate: its multipliers; what rests on boxes is left out.
        demands: last rows of G, to which services are held.

    Returns:
        Shape (steps, stores), 1.
    """
    lifetimes, y, mu = programs.admissible.lifetimes, certificate.equal, np.minimum(certificate.under, 0.0)
    plan_network, steps = problem.layout.network, programs.admissible.network.episode.horizon
    worth, tops = np.empty((steps, len(plan_network.stores))), [0, 0]
    for step in range(steps):
        # a stock s at the start stands on the left as B s, so a unit more lowers the right-hand side by B
        blocks = programs.rows_at_start(step)
        worth[step] = sum(
            block.T @ multipliers[top : top + block.shape[0]]
            for block, multipliers, top in zip(blocks, (y, mu), tops, strict=True)
        )
        tops = [top + block.shape[0] for top, block in zip(tops, blocks, strict=True)]
    last = len(mu) - demands
    for whole in reversed(lifetimes.whole):
        limits = lifetimes.of_new(whole, problem.layout)
        rows = limits.shape[1]
        worth[:, plan_network.node_index[whole.node.id]] -= limits @ mu[last - rows : last]
        last -= rows
    return worth[:, : len(lifetimes.network.stores)]
