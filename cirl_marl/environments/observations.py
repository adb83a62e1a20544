"""What each agent sees: rows picked from one table of scaled signals."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import cached_property
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.errors import CirlError, check_names
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import FIXED_LIFETIME, OBSERVE, Arc
from cirl_marl.network.processes import DisturbanceProcesses, interval_of
from cirl_marl.network.rowsum import NEGLIGIBLE, RowSum, spans


class Signals:
    """Rows of the signal table: quantities, time, countdown, service levels, set-points, disturbances.

    The quantities are stocks, throughputs of nodes without stock, flows, inner states, measures, masses on the way
    along batch arcs, and of each substance the mass in stocks, throughputs and flows. All but inner states and
    measures, and the set-points, are divided by the scale of their compartment (what a batch arc delivers in a control
    interval too), time by the horizon. The countdown, 1/(intervals left), tells the last apart, as time hardly does.
    Of substances the contents are seen, divided by the scale of the substance.

    Attributes:
        quantities: number of quantities.
        contents: rows of each substance, in nodes and in flows.
        time: row of the time.
        countdown: row of the countdown.
        rows: number of rows.
        sights: what disturbances show, the last rows.
    """

    def __init__(self, dynamics: Dynamics) -> None:
        """Lay out the signals of a network."""
        network, inner, nodes = dynamics.network, dynamics.inner, len(dynamics.network.nodes)
        arcs, lines, services = len(network.arcs), len(dynamics.batches.lines), len(network.services)
        places = nodes + arcs
        counts = (nodes, arcs, len(inner.names), len(inner.measure_names), lines, len(network.substances) * places)
        parts = spans((*counts, 1, 1, services, places))
        self.nodes, self.flows, self.states, self.measures, self.loads, self.substances, *rest = parts
        time, countdown, self.levels, self.set_points = rest
        firsts = range(self.substances.start, self.substances.stop, places)
        self.contents = [range(first, first + places) for first in firsts]
        self.stocks, self.throughputs = slice(0, len(network.stores)), slice(len(network.stores), nodes)
        self.sights = Sights(network.processes)
        self.seen = slice(self.set_points.stop, self.set_points.stop + len(self.sights.names))
        self.quantities, self.rows = self.substances.stop, self.seen.stop
        self.time, self.countdown = time.start, countdown.start
        self.inside = self.loads.stop > self.flows.stop  # whether there are quantities inside compartments


class Sights:
    """What the disturbances of a network show of themselves, each value in parts of its largest size.

    Attributes:
        names: of the rows: values of the coming interval, or of an earlier one, and conditional means of later ones.
        rows: of each disturbance, with who sees them; nobody in particular: all agents.
        low: lowest values, shape (rows, 1).
        high: highest values.
    """

    def __init__(self, processes: DisturbanceProcesses) -> None:
        """Lay out the rows of disturbances that are not hidden."""
        self._processes, names = processes, list[str]()
        self.rows: list[tuple[range, tuple[str, ...]]] = []
        self._parts: list[tuple[range, int, int, int]] = []
        self._prior = processes.prior_means(1)[0]
        size: list[tuple[float, float]] = []
        for n, (name, part) in enumerate(zip(processes.names, processes.disturbances, strict=True)):
            if part.observed == "none":
                continue
            ago = f" {part.delayed} intervals ago" if part.delayed else ""
            rows = range(len(names), len(names) + 1 + part.forecast)
            names.append(f"disturbance {name}{ago}")
            names += (f"forecast of {name} in {k} intervals" for k in range(1, part.forecast + 1))
            self.rows.append((rows, part.observed_by))
            self._parts.append((rows, n, part.delayed, part.forecast))
            size += [part.ends] * len(rows)
        self.names, ends = tuple(names), np.array(size).reshape(-1, 2)
        largest = np.abs(ends).max(axis=1, initial=np.finfo(float).tiny, keepdims=True)
        self._inverse_size, (self.low, self.high) = 1.0 / largest, (ends / largest).T[..., None]
        self._ahead = max((forecast for *_, forecast in self._parts), default=0)
        plain = not self._ahead and not any(delay for _, _, delay, _ in self._parts)
        self._at_once = np.array([n for _, n, _, _ in self._parts], dtype=np.intp) if plain else None

    def __bool__(self) -> bool:
        """Whether there is anything to be seen."""
        return bool(self.names)

    def see(self, states: Floats, values: Floats, step: Integers) -> Floats:
        """Return what is seen before an interval of each copy, shape (rows, B).

        What is delayed shows, before the first value is known, the mean with which it starts.

        Args:
            states: of the processes in all intervals, shape (intervals, names, B).
            values: likewise.
            step: the coming interval of each copy, shape (B,).
        """
        now = interval_of(values, step)
        if self._at_once is not None:
            return np.asarray(now.take(self._at_once, axis=0) * self._inverse_size)
        sight = np.empty((len(self.names), len(step)))
        for rows, n, delay, _ in self._parts:
            past = interval_of(values[:, n : n + 1], np.maximum(step - delay, 0))[0] if delay else now[n]
            sight[rows.start] = np.where(step < delay, self._prior[n], past)
        if self._ahead:
            for t in np.unique(step).tolist():
                of = step == t
                means = self._processes.conditional_means(np.ascontiguousarray(states[t][:, of]), t, self._ahead)
                for rows, n, _, forecast in self._parts:
                    sight[rows.start + 1 : rows.stop, of] = means[:forecast, n]
        sight *= self._inverse_size
        return sight

    def pull_back(self, step: Integers, adjoint: Floats, path_adjoint: Floats) -> None:
        """Add derivatives by what is seen, shape (rows, B), to those by the values, shape (intervals, names, B).

        Forecasts follow from the states of the processes, and so do not change with the values.
        """
        for rows, n, delay, _ in self._parts:
            copies = np.flatnonzero(step >= delay)
            path_adjoint[step[copies] - delay, n, copies] += (adjoint * self._inverse_size)[rows.start, copies]


class ObservationLayout:
    """Which signals each agent sees, in which order, within which bounds.

    Attributes:
        mode: what of the network is shown.
        countdown: whether the intervals left are shown, too.
        slices: rows of each agent in the stacked observation.
        names: what each entry of an agent's observation is.
        array_order: stocks and inner states in the order in which all agents observe them and nothing else; empty if
            they see other things too, or different ones.
        sights: what disturbances show.
    """

    def __init__(
        self, dynamics: Dynamics, agents: Sequence[str], mode: str | None, batch: int, countdown: bool | None = None
    ) -> None:
        """Lay out the observations of ``agents``; ``mode`` and ``countdown`` None take the network's own."""
        network = dynamics.network
        self.countdown = network.observation.countdown if countdown is None else bool(countdown)
        self.mode = mode = network.observation.mode if mode is None else mode
        check_names("observation mode", [mode], OBSERVE, "observe: ")
        if mode == "stocks" and not network.observation.nodes:
            raise CirlError(f"observe: mode 'stocks' needs a scenario that lists the nodes; '{network.name}' has none")
        for agent in agents:
            if mode == "model" and network.compartments[agent].model is None:
                raise CirlError(f"observe: mode 'model' needs a model, and '{agent}' of '{network.name}' has none")
        inner, batches = dynamics.inner, dynamics.batches
        self.signals = signals = Signals(dynamics)
        self.sights = signals.sights
        first = signals.states.start
        self._inner = {owner: [first + row for row in rows] for owner, rows in inner.observed_rows.items()}
        self._measures = inner.measure_names
        for row, name in enumerate(inner.measure_names, signals.measures.start):
            self._inner[name.split(".")[0]].append(row)
        self._load: dict[str, int] = {line.id: signals.loads.start + i for i, line in enumerate(batches.lines)}
        self._unobservable = {*range(first, signals.states.stop)}.difference(*self._inner.values())
        self._state_rows = {**network.node_index, **{name: first + i for i, name in enumerate(inner.names)}}
        self._network = network
        self._incident = _incident_arcs(network)
        names = list(self._signal_names((*inner.names, *inner.measure_names)))
        self._position = {id_: i for i, id_ in enumerate(network.compartments)}
        self._debts: dict[str, list[int]] = {}
        for row, service in enumerate(network.services, signals.levels.start):
            for debtor in service.debtors:
                self._debts.setdefault(debtor, []).append(row)
        rows = [list(dict.fromkeys(self._rows(agent, mode))) for agent in agents]
        self._index: Integers = np.array([row for of_agent in rows for row in of_agent], dtype=np.intp)
        self.slices = dict(zip(agents, spans(map(len, rows)), strict=True))
        self._dynamics, self._rows_of = dynamics, dict(zip(agents, rows, strict=True))
        self.names = {agent: tuple(names[row] for row in entries) for agent, entries in self._rows_of.items()}
        self.array_order = self._common_order(agents, mode)
        scales = np.array([c.scale for c in network.compartments.values()])
        inside = np.ones(signals.loads.start - signals.states.start)
        batch_arcs = batches.arcs[: len(batches.lines)]
        inverse_scale = 1.0 / np.concatenate([scales, inside, scales[signals.flows][batch_arcs]])
        of_substances = [1.0 / substance.scale for substance in network.substances]
        inverse_scale = np.concatenate([inverse_scale, np.repeat(of_substances, len(scales))])
        inverse_scale[signals.flows][batch_arcs] *= network.episode.control_interval
        # equal shapes are faster than a broadcast
        self._inverse_scale = np.repeat(inverse_scale[:, None], batch, axis=1)
        set_points = np.array([c.set_point or 0.0 for c in network.compartments.values()]) / scales
        self._table = np.zeros((signals.rows, batch), dtype=np.float32)
        self._table[signals.set_points] = set_points[:, None]
        self._signal_sum = RowSum(self._index, np.arange(len(self._index)), 1.0, (signals.rows, len(self._index)))

    @cached_property
    def spaces(self) -> dict[str, Box[np.float32]]:
        """Observation space of each agent; float32. Bounds of a large network take as long as its episode."""
        low, high = self._bounds(self._dynamics)
        return {agent: Box(low[rows], high[rows], dtype=np.float32) for agent, rows in self._rows_of.items()}

    def observe(
        self, quantities: Floats, time: Floats, levels: Floats, sight: Floats | None = None, table: Any = None
    ) -> NDArray[Any]:
        """Return the stacked observation, shape (entries of all agents, B).

        It follows from the quantities of ``Signals``, shape (quantities, B), the elapsed share of the episode, shape
        (B,), the service levels, shape (services, B), and what is seen of disturbances (``Sights.see``). It is written
        by way of a ``table`` of single precision, or of one like it of another.
        """
        table = self._table if table is None else table
        if self.signals.contents:
            quantities = quantities.copy()
            quantities[self.signals.substances] = self.contents(quantities)
        with np.errstate(over="ignore"):
            np.multiply(quantities, self._inverse_scale, out=table[: self.signals.quantities], casting="same_kind")
        table[self.signals.time] = time
        if self.countdown:
            table[self.signals.countdown] = 1.0 / np.maximum(self._network.episode.horizon * (1.0 - time), 1.0)
        table[self.signals.levels] = levels
        if sight is not None:
            table[self.signals.seen] = sight
        observation: NDArray[Any] = table.take(self._index, axis=0)
        return observation

    def by_agent(self, observation: NDArray[Any]) -> dict[str, NDArray[Any]]:
        """Split a stacked observation, shape (entries of all agents, B), into agent → (B, entries)."""
        return {agent: observation[rows].T for agent, rows in self.slices.items()}

    def contents(self, quantities: Floats) -> Floats:
        """Return the part of each substance in nodes and flows, 0 where there is nothing, in rows of ``substances``."""
        masses = quantities[self.signals.substances]
        whole = np.tile(quantities[: self.signals.flows.stop], (len(self.signals.contents), 1))
        return np.divide(masses, whole, out=np.zeros_like(masses), where=whole > NEGLIGIBLE)

    def double_table(self) -> Floats:
        """Return a table for ``observe`` of double precision."""
        return self._table.astype(np.float64)

    def pull_back(self, quantities: Floats, adjoint: Floats) -> tuple[Floats, Floats, Floats]:
        """Return derivatives by quantities, levels and sights of those by the observation, shape (entries, B)."""
        signals, by_signal = self.signals, self._signal_sum(adjoint)
        by_quantity = by_signal[: signals.quantities] * self._inverse_scale
        if signals.contents:
            whole = quantities[: signals.flows.stop]
            per_whole = np.divide(1.0, whole, out=np.zeros_like(whole), where=whole > NEGLIGIBLE)
            for rows in map(_slice, signals.contents):
                by_quantity[rows] *= per_whole
                by_quantity[: signals.flows.stop] -= by_quantity[rows] * quantities[rows] * per_whole
        return by_quantity, by_signal[signals.levels], by_signal[signals.seen]

    def _common_order(self, agents: Sequence[str], mode: str) -> tuple[str, ...]:
        if self.countdown:
            return ()
        if mode == "stocks":
            return self._network.observation.nodes
        if mode == "model" and len(agents) == 1 and self._state_rows.keys() >= set(self.names[agents[0]]):
            return self.names[agents[0]]
        return ()

    def row(self, compartment: str, quantity: str, measure: str = "") -> int:
        """Return the row of a compartment's ``stock``, ``flow`` or ``measure`` among the quantities."""
        if quantity == "measure":
            return int(self.signals.measures.start) + self._measures.index(f"{compartment}.{measure}")
        rows = self._load if quantity == "stock" and compartment in self._load else self._position
        return rows[compartment]

    def _rows(self, agent: str, mode: str) -> Iterator[int]:
        if mode == "stocks":
            yield from (self._state_rows[name] for name in self._network.observation.nodes)
        elif mode == "model":
            yield from self._inner[agent]
        else:
            yield from self._rows_around(agent, mode)
        if self.countdown:
            yield self.signals.countdown

    def _rows_around(self, agent: str, mode: str) -> Iterator[int]:
        network, signals = self._network, self.signals
        compartment = network.compartments[agent]
        position = self._position[agent]
        yield position
        yield from self._inner.get(agent, ())
        if agent in self._load:
            yield self._load[agent]
        is_arc, near = isinstance(compartment, Arc), [position]
        if isinstance(compartment, Arc):
            ends = filter(None, (compartment.donor, compartment.recipient, compartment.capacity_node))
            near = [network.node_index[end] for end in ends]
            yield from near
            yield from self._arrivals(near[1])
        yield from (rows[place] for rows in signals.contents for place in dict.fromkeys((position, *near)))
        arcs = [] if is_arc and mode != "neighbours" else [k for node in near for k in self._incident[node]]
        yield from (signals.flows.start + k for k in arcs)
        yield from (self._load[network.arcs[k].id] for k in arcs if network.arcs[k].id in self._load)
        if mode == "neighbours":
            yield from (node for centre in near for node in self._across(centre))
        if mode == "full":
            yield from (row for row in range(signals.quantities) if row not in self._unobservable)
        if compartment.set_point is not None:
            yield signals.set_points.start + position
        if mode == "full":
            yield from range(signals.levels.start, signals.levels.stop)
        yield from self._debts.get(agent, [])
        for rows, agents in self.sights.rows:
            if not agents or agent in agents:
                yield from (signals.seen.start + row for row in rows)
        yield signals.time

    def _arrivals(self, node: int) -> Iterator[int]:
        """Nodes into which one of fixed lifetime, such as a transport, releases: who orders ahead sees what for."""
        lifetime = self._network.nodes[node].lifetime
        if lifetime is not None and lifetime.distribution == FIXED_LIFETIME:
            yield from (
                int(self._network.recipients[k]) for k in self._incident[node] if self._network.donors[k] == node
            )

    def _across(self, node: int) -> list[int]:
        """Nodes at the other end of the arcs of ``node``."""
        ends = self._network.donors, self._network.recipients
        return [int(end[k]) for k in self._incident[node] for end in ends if end[k] != node]

    def _signal_names(self, states: Sequence[str]) -> Iterator[str]:
        network = self._network
        yield from (f"{'stock' if node.stores else 'throughput'} of {node.id}" for node in network.nodes)
        yield from (f"flow of {arc.id}" for arc in network.arcs)
        yield from states
        yield from (f"mass on {arc}" for arc in self._load)
        yield from (f"{part.id} in {id_}" for part in network.substances for id_ in network.compartments)
        yield from ("time", "countdown")
        yield from (f"service level of {service.id}" for service in network.services)
        yield from (f"set-point of {id_}" for id_ in network.compartments)
        yield from self.sights.names

    def _bounds(self, dynamics: Dynamics) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Bounds that conservation gives: no stock exceeds all the mass there is, no flow what that mass can drive."""
        network, signals = self._network, self.signals
        compartments = network.compartments.values()
        scales = np.array([c.scale for c in compartments])
        low, high = np.zeros(signals.rows), np.ones(signals.rows)
        mass_rows = slice(0, signals.flows.stop)
        low[mass_rows], high[mass_rows] = -np.inf, np.inf
        if dynamics.physical:
            mass = network.initial[1].sum()
            drive = np.where(dynamics.driver == dynamics.rows.unit, 1.0, mass)
            drive[dynamics.driver > dynamics.rows.unit] = np.inf
            flows = drive * dynamics.max_rate
            flows[dynamics.batches.arcs] = mass
            if dynamics.slots is not None:
                flows[dynamics.slots.arcs] = mass / network.episode.control_interval
            routing = dynamics.routing
            through = routing.most(flows)
            flows[routing.arcs] = through.take(routing.donors) * dynamics.max_rate[routing.arcs]
            # of each component as much may flow as all of its copies can carry
            flows = flows.reshape(dynamics.rows.components, -1).max(axis=0)
            stores = signals.throughputs.start
            through, flows = through[: len(network.nodes) - stores], flows[: len(network.arcs)]
            limits = np.concatenate([np.full(stores, mass), through, flows]) / scales
            low[mass_rows], high[mass_rows] = 0.0, limits * (1 + 1e-6) + 1e-6
        low[mass_rows.stop : signals.quantities], high[mass_rows.stop : signals.quantities] = -np.inf, np.inf
        low[signals.loads] = low[signals.substances] = 0.0
        high[signals.substances] = self._inverse_scale[signals.substances, 0] * (1 + 1e-6)
        set_points = np.abs([c.set_point or 0.0 for c in compartments]) / scales
        low[signals.set_points], high[signals.set_points] = -set_points - 1, set_points + 1
        low[signals.seen], high[signals.seen] = self.sights.low[:, 0] - 1e-6, self.sights.high[:, 0] + 1e-6
        return low.astype(np.float32), high.astype(np.float32)


def _slice(rows: range) -> slice:
    return slice(rows.start, rows.stop)


def _incident_arcs(network: Network) -> list[list[int]]:
    incident: list[list[int]] = [[] for _ in network.nodes]
    for k, (i, j) in enumerate(zip(network.donors.tolist(), network.recipients.tolist(), strict=True)):
        incident[i].append(k)
        incident[j].append(k)
        if limit := network.arcs[k].capacity_node:
            incident[network.node_index[limit]].append(k)
    return incident
