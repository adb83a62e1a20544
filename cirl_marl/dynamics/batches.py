"""Material that moves in whole batches: collected at the donor, in transit for a while, delivered at once.

Batch arcs are compartments that hold mass, so they have rows of their own in the stocks, between the nodes and the unit
row. An arc with a ``delay`` of n control intervals is a line of n slots, one per interval; an arc with a vehicle holds
what is aboard until the vehicle's model says that it has arrived. Batches leave on schedule, at the start of an
interval, or when the model of the compartment ``by`` has completed one, at its end::

    collecting --complete--> packed --vehicle at the donor--> aboard --arrived--> recipient
    collecting --complete--> slots, n intervals --> recipient

In a network with substances a batch has the content of its donor when it leaves: each component has rows of its own,
and leaves in the part that it has of the donor's stock.

Mass is only ever taken from one row and added to another. m_fb, the net batch mass moved finite-time sustainably, has
two parts: that not through the environment and that through it.
"""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.inner_physics import InnerPhysics
from cirl_marl.dynamics.state_layout import BatchLine, StateLayout
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Law
from cirl_marl.network.rowsum import NEGLIGIBLE, RowSum, disposable


class BatchTransport:
    """The batch arcs of a network, compiled.

    Attributes:
        arcs: position of each batch arc among the arcs, of one component after the other.
        lines: the batch arcs, of the whole.
    """

    def __init__(self, network: Network, rows: StateLayout) -> None:
        """Compile the batch arcs, whose rows are those of ``rows``."""
        self._network, self._rows = network, rows
        self.lines = rows.lines[: len(rows.lines) // rows.components]
        self.arcs = [k for k, arc in enumerate(network.arcs) if arc.law is Law.BATCH]
        self._model_lines = [line for line in self.lines if line.by]
        self._vehicles = [(i, line) for i, line in enumerate(self.lines) if not line.slots]
        self._recipients = sorted({line.recipient for line in self.lines})
        lines = rows.lines
        count, positions = len(lines), np.arange(len(lines))
        self._delivery = RowSum([line.recipient for line in lines], positions, 1.0, (rows.masses, count))
        self._arrivals = RowSum([line.part for line in lines], positions, [line.arrives for line in lines], (2, count))
        whole = len(self.lines)
        places = [(i % whole, row) for i, line in enumerate(lines) for row in line.rows]
        self._load_sum = RowSum([i for i, _ in places], [row for _, row in places], 1.0, (whole, rows.masses))
        self._slot_lines = np.flatnonzero([line.slots > 0 for line in lines])
        self._first = np.array([lines[i].first for i in self._slot_lines], dtype=np.intp)[:, None]
        self._slots = np.array([lines[i].slots for i in self._slot_lines], dtype=np.intp)[:, None]
        self._compile_schedule()

    def _compile_schedule(self) -> None:
        """Collect the masses that leave on schedule, and the donors of them."""
        network, lines = self._network, [line for line in self._rows.lines if not line.by]
        components, count = self._rows.components, len(lines)
        whole, self._stores = count // components, self._rows.nodes.stop // components
        self._schedule = np.zeros((whole, network.episode.horizon))
        for masses, line in zip(self._schedule, lines, strict=False):
            for time, mass in network.arcs[network.arc_index[line.id]].batches:
                step = round(time / network.episode.control_interval)
                if step < len(masses):
                    masses[step] += mass
        self._sent_first = np.array([line.first for line in lines], dtype=np.intp)[:, None]
        self._sent_slots = np.array([line.slots for line in lines], dtype=np.intp)[:, None]
        self._sent_donor = np.array([line.donor for line in lines], dtype=np.intp)
        self._departure = RowSum(self._sent_donor, np.arange(count), -1.0, (self._rows.masses, count))
        self._demand = RowSum(self._sent_donor[:whole], np.arange(whole), 1.0, (self._rows.masses, whole))
        parts, weights = [line.part for line in lines], [line.leaves for line in lines]
        self._departures = RowSum(parts, np.arange(count), weights, (2, count))

    def dispatch(self, stock: Floats, step: Integers) -> Floats:
        """Send off, in place, what is scheduled for the start of the interval; return its m_fb, shape (2, B).

        A donor that holds less than is scheduled sends what it has, split in proportion.
        """
        mass = self._schedule[:, step]
        if not mass.any():
            return np.zeros((2, stock.shape[1]))
        demand, donors = self._demand(mass), self._sent_donor[: len(mass)]
        if self._rows.components == 1:
            available, is_short = stock, self._departure.add_to(stock.copy(), mass) < 0
        else:
            available = self._wholes(stock)
            is_short = demand > disposable(available, len(mass))
        share = np.divide(disposable(available, len(mass)), demand, out=np.ones_like(demand), where=is_short)
        mass = mass * share.take(donors, axis=0)
        if self._rows.components > 1:
            whole = available.take(donors, axis=0)
            part = np.divide(mass, whole, out=np.zeros_like(mass), where=whole > NEGLIGIBLE)
            mass = np.tile(part, (self._rows.components, 1)) * stock.take(self._sent_donor, axis=0)
        self._departure.add_to(stock, mass)
        # the slot that is read at the end of the last interval of the delay
        stock[self._sent_first + (step - 1) % self._sent_slots, np.arange(stock.shape[1])] += mass
        return self._departures(mass)

    def _wholes(self, stock: Floats) -> Floats:
        """Return what nodes hold of all components, in the rows of the first, shape (masses, B)."""
        whole = stock.copy()
        whole[: self._stores] = stock[self._rows.nodes].reshape(-1, self._stores, stock.shape[1]).sum(axis=0)
        return whole

    def settle(self, stock: Floats, inner: Floats, step: Integers, physics: InnerPhysics) -> tuple[Floats, Floats]:
        """Deliver, release and send off, in place, what is due at the end of the interval ``step``, shape (B,).

        Vehicles turn and plants receive in ``inner``. Returned are the mass delivered by each of ``arcs``, shape (arcs,
        B), and m_fb of the interval's end, shape (2, B).
        """
        deliveries = np.empty((len(self.arcs), stock.shape[1]))
        slots, copies = self._first + step % self._slots, np.arange(stock.shape[1])
        deliveries[self._slot_lines] = stock[slots, copies]
        stock[slots, copies] = 0.0
        for i, line in self._vehicles:
            deliveries[i] = np.where(physics.arrive(line.id, inner), stock[line.first], 0.0)
            stock[line.first] -= deliveries[i]
        arrivals = self._delivery(deliveries)
        stock += arrivals
        for node in self._recipients:
            physics.receive(node, inner, arrivals[node])
        batch_mass = self._arrivals(deliveries)
        for line in self._model_lines:
            units = physics.released_units(line.by, line.port, inner)
            batch_mass[line.part] += line.leaves * self._collect(line, stock, units)
            self._send(line, stock, inner, step, physics)
        return deliveries, batch_mass

    def _collect(self, line: BatchLine, stock: Floats, units: Floats) -> Floats:
        """Move what the model of ``by`` released in this interval out of the donor."""
        mass: Floats = np.minimum(line.unit * units, stock[line.donor])
        stock[line.donor] -= mass
        stock[line.collection_row] += mass
        return mass

    def _send(self, line: BatchLine, stock: Floats, inner: Floats, step: Integers, physics: InnerPhysics) -> None:
        """Send complete batches on their way."""
        complete = np.where(physics.complete(line.by, inner), stock[line.collection_row], 0.0)
        stock[line.collection_row] -= complete
        if line.packed_row is None:
            stock[line.first + step % line.slots, np.arange(stock.shape[1])] += complete
            return
        stock[line.packed_row] += complete
        load = np.where(physics.board(line.id, inner, stock[line.packed_row] > 0.0), stock[line.packed_row], 0.0)
        stock[line.packed_row] -= load
        stock[line.first] += load

    def loads(self, stock: Floats) -> Floats:
        """Return the mass that each batch arc holds, shape (batch arcs, B)."""
        return self._load_sum(stock)
