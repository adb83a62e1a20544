"""What sources give whose contents change in time: each component in the part that is stated for the interval.

Of an order f such a source gives f_c = f·c_c(t) of each component c. Each is a reserve of its own, of a store for each,
and all are cut alike where one is short.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cirl_marl.dynamics.uncertain_factors import RowFactors
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.substances import CONTENT, changing_sources, contents
from cirl_marl.network.uncertainty import numbers_of


class SourceContents:
    """The scheduled flows of sources whose contents change in time, or are disturbed.

    Attributes:
        arcs: of each component, shape (components, arcs).
        donors: the sources of each component, shape (components, sources).
        varies: whether contents depend on the interval.
    """

    def __init__(self, network: Network, staged_network: Network, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Find them in ``network``, which ``staged_network`` is as the simulator has it; ``ranges`` of all factors."""
        donors, substances = {arc.donor for arc in network.arcs}, [substance.id for substance in network.substances]
        sources = [node for node in changing_sources(network) if node.id in donors]
        place = {node.id: i for i, node in enumerate(sources)}
        arcs = [arc for arc in network.arcs if arc.donor in place]
        self._source: Integers = np.array([place[arc.donor] for arc in arcs], dtype=np.intp)
        shape = (-1, 1 + len(substances))
        copies = staged_network.components_of
        arc_rows = [staged_network.arc_index[id_] for arc in arcs for id_ in copies(arc.id)]
        node_rows = [staged_network.node_index[id_] for node in sources for id_ in copies(node.id)]
        self.arcs: Integers = np.array(arc_rows, dtype=np.intp).reshape(shape).T
        self.donors: Integers = np.array(node_rows, dtype=np.intp).reshape(shape).T
        tables = [contents(network, node, network.interval_means)[1:] for node in sources]
        table = np.array(tables).reshape(len(sources), len(substances), network.episode.horizon).swapaxes(0, 1)
        self.varies = bool((table != table[:, :, :1]).any())
        self._table = table if self.varies else table[:, :, :1]
        numbers = [numbers_of(ranges, "nodes", f"{CONTENT}{id_}") for id_ in substances]
        rows = {
            part * len(sources) + i: numbers_[node.id]
            for part, numbers_ in enumerate(numbers)
            for i, node in enumerate(sources)
            if node.id in numbers_
        }
        self._factors = RowFactors(rows)

    def __bool__(self) -> bool:
        """Whether there are any."""
        return bool(self.arcs.size)

    def share_out(self, rate: Floats, step: Integers | None, factors: Floats | None) -> None:
        """Multiply, in place, the orders f in the rates of all components, shape (arcs, B), by c_c(t)."""
        rate[self.arcs] *= self._contents(step, factors)[:, self._source]

    def pull_back(
        self, rate: Floats, step: Integers, factors: Floats | None, adjoint: Floats, factor_adjoint: Floats | None
    ) -> None:
        """Turn, in place, the adjoint of what ``share_out`` returned for ``rate`` into that of orders and factors."""
        load = adjoint[self.arcs]
        adjoint[self.arcs] = load * self._contents(step, factors)[:, self._source]
        if factor_adjoint is None:
            return
        by_content = np.zeros((*self.donors.shape, rate.shape[1]))
        np.add.at(by_content.swapaxes(0, 1), self._source, (load * rate[self.arcs]).swapaxes(0, 1))
        by_part = (by_content[1:] - by_content[:1]).reshape(-1, rate.shape[1])
        table = np.broadcast_to(self._parts(step), by_part.shape)
        self._factors.pull_back(table, by_part, factor_adjoint)

    def _parts(self, step: Integers | None) -> Floats:
        """Return what is stated of substances in an interval of each copy, shape (substances · sources, 1 or B)."""
        table = self._table.reshape(-1, self._table.shape[2])
        return table.take(step, axis=1) if step is not None and self.varies else table[:, :1]

    def _contents(self, step: Integers | None, factors: Floats | None) -> Floats:
        """Return the part of each component, shape (components, sources, 1 or B)."""
        parts = self._factors(self._parts(step), factors).reshape(*self._table.shape[:2], -1)
        return np.concatenate([np.maximum(1.0 - parts.sum(axis=0, keepdims=True), 0.0), parts])
