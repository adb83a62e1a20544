"""Which contents flows can have, for programs that move the components of a material one beside the other."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Arc
from cirl_marl.network.initial_ages import content_edges
from cirl_marl.network.reachable_contents import reachable_contents
from cirl_marl.network.series import means
from cirl_marl.network.substances import changing_sources, contents

ROUND_OFF = 1e-9
"""Part of all stocks that one of them may have too much or too little of a component, as simulators round."""


@positional_record
class Mixtures:
    """The flows of a network as sums of those of its components, and what these can be of them."""

    arcs: Annotated[Integers, "of the planned network, shape (components, arcs)"]
    content: Annotated[Floats, "least and greatest part of each component, shape (2, components, arcs)"]
    grade: Annotated[Floats, "part that changing sources give, else NaN, shape (components, steps, arcs)"]
    stocks: Annotated[Floats, "likewise of the stocks, shape (2, components, stores)"]
    scheduled: Annotated[Integers, "which of the arcs flow by schedule"]
    orders: Annotated[Floats, "least and most asked of the whole of these, shape (2, steps, scheduled), mass/time"]

    @property
    def varies(self) -> NDArray[np.bool_]:
        """Whether the content of each flow may change, shape (arcs,)."""
        return np.asarray((self.content[0] < self.content[1]).any(axis=0))

    @property
    def has_grade(self) -> NDArray[np.bool_]:
        """Whether each flow has a content that is known for each interval, as a changing source gives it, (arcs,)."""
        return np.asarray(~np.isnan(self.grade[0, 0]))

    def parts(self, arc: int, period: slice) -> Floats:
        """Return the least and greatest part of each component in a flow, (2, components, steps of the period or 1)."""
        grade = self.grade[:, period, arc]
        return np.stack([grade, grade]) if self.has_grade[arc] else self.content[:, :, arc, None]


def content_ranges(network: Network, shares: Floats, present: Floats | None = None) -> tuple[Floats, Floats]:
    """Return what part of each flow, and of each stock, each component may be at any time, whatever agents do.

    They begin with all that a start, a history or a changing source has; see ``reachable_contents``.

    Args:
        network: whose nodes have the contents.
        shares: least and greatest share of each arc of law ``share``, 1 of others, by component, of any interval, shape
            (2, components, arcs).
        present: least and greatest part of each component in stocks that programs may start from beside those of the
            network, shape (2, components, stores); None for none.

    Returns:
        Least and greatest part, shapes (2, components, arcs) and (2, components, stores); from 1 to 0 of flows that
        there never are.
    """
    starts = np.empty((2, 1 + len(network.substances), len(network.stores)))
    for i, node in enumerate(network.stores):
        parts = contents(network, node, partial(means, edges=content_edges(network, node)))
        starts[:, :, i] = parts.min(axis=1), parts.max(axis=1)
    if present is not None:
        starts = np.stack([np.minimum(starts[0], present[0]), np.maximum(starts[1], present[1])])
    stocks, flows = reachable_contents(network, starts, shares, set())
    return flows, stocks


def present_contents(rows: StateLayout, stock: Floats) -> Floats:
    """Return the least and the greatest part of each component in stocks of some copies, by stage, shape (rows, B).

    The shape is (2, components, stores); parts are from 1 to 0 where there is nothing.
    """
    parts = np.tile([[[1.0]], [[0.0]]], (1, rows.components, len(rows.stages)))
    for i, stages in rows.stages.items():
        masses = stock[stages.reshape(rows.components, -1)].reshape(rows.components, -1)
        whole = masses.sum(axis=0)
        masses = masses[:, whole > 0] / whole[whole > 0]
        parts[:, :, i] = masses.min(axis=1, initial=1.0), masses.max(axis=1, initial=0.0)
    return parts


def source_grades(network: Network, arcs: Sequence[Arc]) -> Floats:
    """Return the part of each component that arcs get of changing sources, else NaN, (components, steps, arcs)."""
    grade = np.full((1 + len(network.substances), network.episode.horizon, len(arcs)), np.nan)
    for source in changing_sources(network):
        parts = contents(network, source, network.interval_means)
        grade[:, :, [arc.donor == source.id for arc in arcs]] = parts[..., None]
    return grade


def check_contents(network: Network, mixtures: Mixtures, rows: StateLayout, initial: Floats) -> None:
    """Refuse stocks at the start whose contents are none that programs allow for.

    Args:
        network: whose stocks they are.
        mixtures: what programs allow for.
        rows: which stock of the simulator is what.
        initial: stocks of the simulator, shape (stocks,), mass.

    Raises:
        CirlError: naming the node, the substance and what it may be of the stock.
    """
    names = [substance.id for substance in network.substances]
    for i, node in enumerate(network.stores):
        masses = initial[rows.stages[i].reshape(1 + len(names), -1)]
        whole = masses.sum(axis=0)
        for name, mass, low, high in zip(names, masses[1:], *mixtures.stocks[:, 1:, i], strict=True):
            off = np.maximum(low * whole - mass, mass - high * whole)
            worst = int(off.argmax())
            if off[worst] > ROUND_OFF * initial.sum():
                fault = f"by its content, and by what enters it, {low:.4g} to {high:.4g} may be"
                raise CirlError(f"initial: {mass[worst] / whole[worst]:.4g} of '{node.id}' is {name}; {fault}")
