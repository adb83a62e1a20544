"""What passes through nodes that store nothing, at the least and at the most, whatever shares are chosen."""

from __future__ import annotations

from typing import Any

import numpy as np
from scipy import sparse
from scipy.sparse.linalg import splu

from cirl_marl.dynamics.passes import Passes
from cirl_marl.network import Floats
from cirl_marl.optimum.admissible import Admissible

ROUNDING = 1e-9
"""Relative widening of every bound; rounding errors are far smaller."""
SETTLED = 1e-3
"""Relative fall of an upper bound in a round below which no further is made."""
ROUNDS = 1000
"""Most such rounds."""


class RouteBounds:
    """Bounds of what leaves such nodes in one interval, per mass that enters them.

    With the least shares P̲ among these nodes and R̲ into stocks, at least (I − P̲)⁻¹ R̲ arrives. The greatest number of
    visits V_ij to node j by what enters i solves V = I + max_s P(s) V, a Markov decision process; from a V that is too
    large this iteration falls towards it, so any iterate bounds it. What enters i reaches a stock in a share of at most
    V_i R̄, and of at most 1.

    Attributes:
        longest: most visits of all nodes together, at least 1.
        visits: V, shape (nodes, nodes).
    """

    def __init__(self, admissible: Admissible, passes: Passes, step: int, wider: RouteBounds | None = None) -> None:
        """Take the ranges of shares in interval ``step``; the visits of ``wider`` ranges are where to begin from."""
        network = admissible.network
        stores, nodes = len(network.stores), len(network.nodes)
        self._stores, inner = stores, nodes - stores
        arcs = np.flatnonzero(network.donors >= stores)
        places = (network.donors[arcs] - stores, network.recipients[arcs])
        low, high = (sparse.csc_array((rate, places), shape=(inner, nodes)) for rate in admissible.rate(step)[:, arcs])
        total = passes.total(step)
        arrives = _least(low[:, stores:], low[:, :stores].toarray(), total)
        self.longest = float(total.max(initial=1.0))
        visits, fewer = np.repeat(total[:, None], inner, axis=1), np.empty(0)
        if wider is not None:
            fewer = np.eye(inner) + passes.best(wider.visits, step)
            if (fewer <= wider.visits * (1 + ROUNDING)).all():  # a bound: V ≥ I + max_s P(s) V
                visits = np.minimum(visits, wider.visits * (1 + ROUNDING))
        for _ in range(ROUNDS if inner else 0):
            fewer = np.minimum(visits, np.eye(inner) + passes.best(visits, step))
            fallen = (visits - fewer).max()
            visits = fewer
            if fallen <= SETTLED * visits.max():
                break
        most = np.minimum(visits @ high[:, :stores].toarray(), 1.0)
        self._least = sparse.csr_array(arrives.T * (1 - ROUNDING))
        self._most = sparse.csr_array(most.T * (1 + ROUNDING))
        self.visits: Floats = visits
        self._visits = sparse.csr_array(visits.T * (1 + ROUNDING))

    def least(self, entering: Any) -> Any:
        """Return the least that stocks get of what enters nodes, shape (nodes, …) → (stores, …)."""
        return entering[: self._stores] + self._least @ entering[self._stores :]

    def most(self, entering: Any) -> Any:
        """Return the most that stocks get, likewise."""
        return entering[: self._stores] + self._most @ entering[self._stores :]

    def through(self, entering: Any) -> Any:
        """Return the most that passes through the nodes that store nothing, given what enters these from elsewhere."""
        return self._visits @ entering


def _least(passed: Any, arriving: Floats, visits: Floats) -> Floats:
    """Return a lower bound of A = (I − P̲)⁻¹ R̲ that is as near as its equation can be solved.

    No inverse of I − P̲ has a negative entry, so what exceeds R̲ + P̲ A by at most η is too large by at most η visits.

    Args:
        passed: P̲, sparse, shape (nodes, nodes).
        arriving: R̲, shape (nodes, stores).
        visits: most visits of all nodes together by what enters each, shape (nodes,).
    """
    if not len(visits):
        return arriving
    found = splu(sparse.eye_array(len(visits), format="csc") - passed).solve(arriving)
    above = max(float((found - arriving - passed @ found).max(initial=0.0)), 0.0) + 8 * float(np.finfo(float).eps)
    least: Floats = np.maximum(found - above * visits[:, None], 0.0)
    return least
