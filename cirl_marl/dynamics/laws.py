"""The flow laws of a network, compiled to arrays.

Every law is one product, ``f_k = r_k · y[driver_k]``. The driver is the stock of the donor or of the recipient (r in
1/time), the constant 1 for scheduled flows (r in mass/time), or the output of a compartment's model (r in mass/time per
unit of output). All of these are rows of one array (``rows.Rows``). Batch arcs carry no continuous flow.

Arrays are compartment-major, shape (compartments, batch), contiguous along the batch. Gather, multiply and sparse
segment sum treat each column alike, so a column's bits do not depend on the batch it is in.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from operator import attrgetter
from typing import Annotated

import numpy as np

from cirl_marl.dynamics.rows import Rows
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declared import itemised
from cirl_marl.network.elements import Arc, ControlKind, Law
from cirl_marl.network.rowsum import RowSum


@itemised
@dataclass(frozen=True, slots=True)
class FlowLaw:
    """One law, f = r·y[driver]."""

    driver: Annotated[Callable[[Arc, Network, Rows], int], "row whose value the flow is proportional to"]
    coefficient: Annotated[Callable[[Arc], float], "r with every control at 1"] = attrgetter("rate")
    scheduled: Annotated[bool, "whether it asks for a flow, which is cut to what the donor can deliver"] = False


def _unit(arc: Arc, network: Network, rows: Rows) -> int:
    return rows.unit


LAWS: Mapping[Law, FlowLaw] = {
    Law.DONOR: FlowLaw(lambda arc, network, _: network.node_index[arc.donor]),  # a·x_donor
    Law.RECIPIENT: FlowLaw(lambda arc, network, _: network.node_index[arc.recipient]),  # a·x_recipient
    Law.COMPARTMENT: FlowLaw(lambda arc, _, rows: rows.outputs[arc.by]),  # a·y, y the output of a model
    Law.CONTROLLED: FlowLaw(_unit, lambda _: 1.0, scheduled=True),  # u, which the control sets
    # e(t); of a series r is the mean over the interval, which ``FlowLaws.rate`` multiplies in
    Law.EXOGENOUS: FlowLaw(_unit, lambda arc: 1.0 if arc.times else arc.flow[0], scheduled=True),
    Law.BATCH: FlowLaw(_unit, lambda _: 0.0),  # nothing flows: what moves in batches moves at once
}


class FlowLaws:
    """Drivers, rates and controls of every arc.

    Attributes:
        network: whose laws they are.
        rows: which row of the masses is what.
        incidence: S with empty rows for batches and unit, shape (masses, arcs).
        driver: row of the extended stocks that drives each arc, shape (arcs,).
        scheduled: arcs that flow by schedule, shape (arcs,).
        control_low: lower bounds of the controls, in the rows of ``network.control_rows``.
        control_high: upper bounds.
        neutral: values while nobody acts.
        max_rate: r of each arc with every control at its upper bound, shape (arcs,).
    """

    def __init__(self, network: Network) -> None:
        """Compile ``network``."""
        self.network = network
        arcs = len(network.arcs)
        self.rows = rows = Rows(network)
        ends, twice = np.concatenate([network.donors, network.recipients]), np.tile(np.arange(arcs), 2)
        self.incidence = RowSum(ends, twice, np.repeat([-1.0, 1.0], arcs), (rows.masses, arcs))
        laws = [LAWS[arc.law] for arc in network.arcs]
        self.scheduled = np.array([law.scheduled for law in laws], dtype=bool)
        drivers = [law.driver(arc, network, rows) for law, arc in zip(laws, network.arcs, strict=True)]
        self.driver: Integers = np.array(drivers, dtype=np.intp)
        base = [law.coefficient(arc) for law, arc in zip(laws, network.arcs, strict=True)]
        self._base: Floats = np.array(base, dtype=float).reshape(-1, 1)
        self._compile_controls()
        self._series_arcs: Integers = np.flatnonzero([bool(arc.times) for arc in network.arcs])
        self._series = np.array([_interval_means(network.arcs[k], network) for k in self._series_arcs])
        self._series = self._series.reshape(len(self._series_arcs), network.episode.horizon)
        self.max_rate: Floats = self.rate(self.control_high[:, None])[:, 0]
        if len(self._series_arcs):
            self.max_rate[self._series_arcs] *= self._series.max(axis=1)

    def rate(self, controls: Floats, step: Integers | None = None) -> Floats:
        """Return r of each arc, shape (arcs, B): 1/time for stock-driven arcs, mass/time for scheduled ones.

        Args:
            controls: physical values in the rows of ``network.control_rows``, shape (controls, B).
            step: index of the control interval in each copy, shape (B,); without it time series count as 1.
        """
        if self._partial:  # some arc lacks a control: let a row of ones stand in for it
            controls = np.concatenate([controls, np.ones((1, controls.shape[1]))])
        rate: Floats = controls.take(self._own_control, axis=0)
        rate *= self._base
        rate *= controls.take(self._donor_control, axis=0)
        if step is not None and len(self._series_arcs):
            rate[self._series_arcs] *= self._series[:, step]
        return rate

    def flow(self, stock: Floats, rate: Floats) -> Floats:
        """Return the instantaneous flows f = r ∘ y[driver], shape (arcs, B), mass/time."""
        flow: Floats = stock.take(self.driver, axis=0)
        flow *= rate
        return flow

    def extend(self, stock: Floats) -> Floats:
        """Append empty batch rows and the unit row to stocks of shape (nodes, B)."""
        batch = stock.shape[1]
        return np.concatenate([stock, np.zeros((len(self.rows.batch_names), batch)), np.ones((1, batch))])

    def _compile_controls(self) -> None:
        """Find for each arc the rows of the control array that act on it; the row past the last is 1."""
        network = self.network
        acting = [network.compartments[id_] for id_ in network.controllable]
        controls = [c.control for c in acting for _ in range(c.actions) if c.control is not None]
        scaling = [c.id for c in acting if c.control is not None and c.control.kind is not ControlKind.INPUT]
        position = {id_: network.control_rows[id_].start for id_ in scaling}
        none = len(controls)
        self.control_low: Floats = np.array([c.low for c in controls], dtype=float)
        self.control_high: Floats = np.array([c.high for c in controls], dtype=float)
        self.neutral: Floats = np.array([c.neutral for c in controls], dtype=float)

        def acting_on(arc: Arc) -> tuple[int, int]:
            donor = network.compartments[arc.donor]
            own, valve = position.get(arc.id, none), position.get(arc.donor, none)
            if donor.control is not None and donor.control.kind is ControlKind.FLOW:
                return (valve, none) if arc.law is Law.CONTROLLED else (own, none)
            return own, valve

        rows = np.array([acting_on(arc) for arc in network.arcs], dtype=np.intp).reshape(-1, 2)
        self._own_control, self._donor_control = rows[:, 0].copy(), rows[:, 1].copy()
        self._partial = bool((rows == none).any())


def _interval_means(arc: Arc, network: Network) -> Floats:
    """Mean of a step function over each control interval; the last value holds on."""
    edges = np.arange(network.episode.horizon + 1) * network.episode.control_interval
    times, values = np.array(arc.times), np.array(arc.flow)
    total = np.concatenate([[0.0], np.cumsum(values[:-1] * np.diff(times))])
    index = np.searchsorted(times, edges, side="right") - 1
    means: Floats = np.diff(total[index] + values[index] * (edges - times[index])) / np.diff(edges)
    return means
