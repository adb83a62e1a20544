"""Which row is what in the arrays of a network's motion; nobody else computes row numbers.

Masses are kept as one array: the stocks of the nodes that have one, the masses of batch arcs, then the *unit row*,
which is 1 and drives scheduled flows; the outputs of models follow it where flows are computed. Inner states are a
second array.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np

from cirl_marl.dynamics.components import ComponentNetwork
from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Law, Role
from cirl_marl.network.rowsum import RowSum, spans
from cirl_marl.network.series import extremes
from cirl_marl.network.substances import REMAINDER


@positional_record
class BatchLine:
    """One batch arc and its rows."""

    id: Annotated[str, "the arc"]
    by: Annotated[str, "compartment whose model releases batches; empty for a schedule"]
    port: Annotated[str, "what it releases into this arc"]
    unit: Annotated[float, "mass per unit released"]
    donor: Annotated[int, "row of the node that gives"]
    recipient: Annotated[int, "row of the node that receives"]
    collection_row: Annotated[int, "row of the batch that is being put together"]
    packed_row: Annotated[int | None, "row of complete batches that wait for the vehicle; None without a vehicle"]
    first: Annotated[int, "first row of the slots, or the row of what is aboard"]
    slots: Annotated[int, "number of slots; 0 with a vehicle"]
    leaves: Annotated[float, "weight with which mass that leaves the donor counts in m_fb"]
    arrives: Annotated[float, "weight with which mass that reaches the recipient counts in m_fb"]
    part: Annotated[int, "part of m_fb in which it counts, 1 if the arc touches the environment, else 0"]

    @property
    def rows(self) -> range:
        """All rows of the arc."""
        return range(self.collection_row, self.first + max(self.slots, 1))


class StateLayout:
    """The rows of masses and inner states of a network, and their names.

    Attributes:
        nodes: rows of the stocks, those of nodes with a lifetime by stage.
        stages: rows of each node that has several, by the position of the node: of each component in turn the stages
            of its lifetime, if it has one.
        components: what is no substance, and the substances.
        batches: rows of the masses of batch arcs.
        unit: the unit row; the rows before it hold all the mass there is.
        masses: number of rows of the masses, the unit row included.
        batch_names: ``arc.row`` of each batch row.
        mass_names: stocks, batch rows and the unit.
        lines: the batch arcs, in their order among the arcs.
        aboard: row of what the vehicle of an arc carries, by the arc's id.
        owners: compartments with a model, in network order.
        states: rows of each owner's inner states.
        state_names: ``compartment.state`` of each inner state.
        start_names: nodes with a stock, ``node.stage_i`` of those with a lifetime, in a network with substances
            followed by ``.remainder`` or ``.substance``, then inner states: what an episode starts from, and plans and
            snapshots are compared by.
        outputs: row of each owner's output, past the unit row.
        donors: row of each arc's donor, the unit row for one that stores nothing, shape (arcs,).
    """

    def __init__(self, network: Network) -> None:
        """Lay out the rows of ``network``, which has its lifetimes as stages if it has any."""
        nodes = len(network.stores)
        stages_of: Mapping[str, tuple[str, ...]] = {}
        self.stages: dict[int, Integers] = {}
        self.components = 1
        if isinstance(network, StagedNetwork):
            stages_of = {node: stages for node, stages in network.stages.items() if len(stages) > 1}
            index = network.node_index
            self.stages = {index[node]: network.node_index_of(stages) for node, stages in stages_of.items()}
            if isinstance(network, ComponentNetwork):
                self.components = 1 + len(network.substances)
                self.stages = self._rows_of_components(nodes // self.components)
        self._totals = _totals(nodes, self.stages) if self.stages else None
        self._substances = self._substance_sums(nodes)
        names: list[str] = []
        self.lines = tuple(
            _line(network, k, nodes, names) for k, arc in enumerate(network.arcs) if arc.law is Law.BATCH
        )
        self.batch_names = tuple(names)
        self.nodes, self.batches = slice(0, nodes), slice(nodes, nodes + len(names))
        self.unit = self.batches.stop
        self.masses = self.unit + 1
        self.mass_names = (*(f"stock of node '{node.id}'" for node in network.stores), *names, "unit")
        self.aboard = {line.id: line.first for line in self.lines if not line.slots}
        models = {c.id: c.model for c in network.compartments.values() if c.model is not None}
        self.owners = tuple(models)
        self.state_names = tuple(f"{owner}.{name}" for owner, model in models.items() for name in model.state_names)
        last = {node: f"{node}.stage_{len(stages)}" for node, stages in stages_of.items()}
        stores = [last.get(node.id, node.id) for node in network.stores]
        if isinstance(network, ComponentNetwork):
            base = stores[: nodes // self.components]
            components = (REMAINDER, *(substance.id for substance in network.substances))
            stores = [f"{name}.{component}" for component in components for name in base]
        self.start_names = (*stores, *self.state_names)
        self.states = dict(zip(models, spans(len(model.state_names) for model in models.values()), strict=True))
        self.outputs = {owner: self.masses + i for i, owner in enumerate(self.owners)}
        # a node without stock has no row: what is asked of its row is asked of the unit row, which is never short
        self.donors = np.where(network.donors < nodes, network.donors, self.unit)

    def stocks(self, masses: Floats) -> Floats:
        """Return the stock of each node that has one, shape (stores, B), of masses or of their first rows."""
        return masses[self.nodes] if self._totals is None else self._totals(masses[self.nodes])

    def substances(self, masses: Floats) -> Floats:
        """Return the mass of each substance in each node with a stock, shape (substances · stores, B)."""
        return self._substances(masses[self.nodes])

    def _rows_of_components(self, stores: int) -> dict[int, Integers]:
        """Return the rows of each node, of each of whose components there are so many ``stores``."""
        singles = stores - sum(len(rows) - 1 for i, rows in self.stages.items() if i < stores)
        first = stores * np.arange(self.components)[:, None]
        return {i: (first + self.stages.get(i, np.array([i]))).ravel() for i in range(singles)}

    def _substance_sums(self, rows: int) -> RowSum:
        """Return the sums of the rows of each node, of one substance after the other."""
        entries = [
            (part * len(self.stages) + i, int(row))
            for i, rows_ in enumerate(self.stages.values() if self.components > 1 else ())
            for part, of_part in enumerate(np.split(rows_, self.components)[1:])
            for row in of_part
        ]
        places, columns = np.array(entries, dtype=np.intp).reshape(-1, 2).T
        return RowSum(places, columns, 1.0, ((self.components - 1) * len(self.stages), rows))

    def masses_adjoint(self, stocks_adjoint: Floats, substances_adjoint: Floats | None = None) -> Floats:
        """Return derivatives by the masses, shape (masses, B), of those by ``stocks`` and by ``substances``, if any."""
        masses = np.zeros((self.masses, stocks_adjoint.shape[1]))
        masses[self.nodes] = stocks_adjoint if self._totals is None else self._totals.transpose()(stocks_adjoint)
        if substances_adjoint is not None:
            self._substances.transpose().add_to(masses[self.nodes], substances_adjoint)
        return masses

    def start_of(self, masses: Floats, inner: Floats) -> Floats:
        """Return the rows of ``start_names``, shape (rows, B)."""
        return np.concatenate([masses[self.nodes], inner])

    def split(self, start: Floats) -> tuple[Floats, Floats]:
        """Return stocks, those with a lifetime by stage, and inner states of what ``start_of`` returned."""
        return start[self.nodes], np.ascontiguousarray(start[self.nodes.stop :])


def _totals(rows: int, stages: Mapping[int, Integers]) -> RowSum:
    """Return the sum of the stages of each node, from the rows of all stocks."""
    single_rows = np.arange(rows - sum(len(rows_) - 1 for rows_ in stages.values()))
    parts = {**{int(i): np.array([i]) for i in single_rows}, **stages}
    places = np.concatenate([np.full(len(rows_), i) for i, rows_ in parts.items()])
    return RowSum(places, np.concatenate([*parts.values()]), 1.0, (len(single_rows), rows))


def _line(network: Network, k: int, nodes: int, names: list[str]) -> BatchLine:
    """Lay out the rows of one batch arc after the nodes and those that have ``names``, and name them."""
    arc = network.arcs[k]
    start = nodes + len(names)
    slots = round(arc.delay / network.episode.control_interval)
    tail = [f"slot_{i}" for i in range(slots)] if slots else ["packed", "aboard"]
    names += (f"{arc.id}.{name}" for name in ("collecting", *tail))
    sign = float(network.sustainability[k])
    donor = network.nodes[network.node_index[arc.donor]]
    early = donor.role in (Role.NONRENEWABLE_RESERVOIR, Role.ENVIRONMENT)
    return BatchLine(
        id=arc.id,
        by=arc.by,
        port=arc.port,
        unit=extremes(arc.rate)[0],
        donor=network.node_index[arc.donor],
        recipient=network.node_index[arc.recipient],
        collection_row=start,
        packed_row=None if slots else start + 1,
        first=start + (1 if slots else 2),
        slots=slots,
        leaves=sign if early else 0.0,
        arrives=0.0 if early else sign,
        part=int(network.environmental[k]),
    )
