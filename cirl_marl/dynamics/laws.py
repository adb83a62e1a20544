"""The flow laws of a network, compiled to arrays.

Every law is one product, ``f_k = r_k · y[driver_k]``. The driver is the stock of the donor or of the recipient (r in
1/time), the constant 1 for scheduled flows (r in mass/time), or the output of a compartment's model (r in mass/time per
unit of output). All of these are rows of one array (``rows.Rows``). What leaves a node that stores nothing is its
throughput times a share r, which follows from the other flows (``routing.Routing``). Batch arcs carry no continuous
flow.

Arrays are compartment-major, shape (compartments, batch), contiguous along the batch. Gather, multiply and sparse
segment sum treat each column alike, so a column's bits do not depend on the batch it is in.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping
from typing import Annotated

import numpy as np

from cirl_marl.dynamics.components import simulated_network
from cirl_marl.dynamics.orders import Orders
from cirl_marl.dynamics.routing import Routing
from cirl_marl.dynamics.shares import Shares
from cirl_marl.dynamics.source_contents import SourceContents
from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.dynamics.uncertain_factors import ControlFactors, FlowFactors, IntervalFactors
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import MAX_STEPS, Arc, ControlKind, Law
from cirl_marl.network.rowsum import RowSum, single_column
from cirl_marl.network.series import Series, Value

FLOW = ControlKind.FLOW
MAX_TURNOVER = 1.0
"""Largest share, rate × substep, that a node may turn over in one substep of the exact solver."""
SCALING = (ControlKind.RATE, FLOW, ControlKind.STRETCH)
"""Kinds of controls that are factors of flows, a stretch by its inverse."""


@positional_record
class FlowLaw:
    """One law, f = r·y[driver]."""

    driver: Annotated[Callable[[Arc, Network, StateLayout], int], "row whose value the flow is proportional to"]
    coefficient: Annotated[Callable[[Arc, Network], Value], "r with every control and share at 1"] = (
        lambda arc, network: arc.rate
    )
    is_scheduled: Annotated[bool, "whether it asks for a flow, which is cut to what the donor can deliver"] = False


def _unit(arc: Arc, network: Network, rows: StateLayout) -> int:
    return rows.unit


def _release(arc: Arc, network: Network) -> Value:
    donor = network.nodes[network.node_index[arc.donor]]
    return donor.rate if donor.stores else 1.0


LAWS: Mapping[Law, FlowLaw] = {
    Law.DONOR: FlowLaw(lambda arc, network, _: network.node_index[arc.donor]),  # a·x_donor
    Law.RECIPIENT: FlowLaw(lambda arc, network, _: network.node_index[arc.recipient]),  # a·x_recipient
    Law.COMPARTMENT: FlowLaw(lambda arc, _, rows: rows.outputs[arc.by]),  # a·y, y the output of a model
    Law.CONTROLLED: FlowLaw(_unit, lambda arc, network: 1.0, is_scheduled=True),  # u, which the control sets
    Law.EXOGENOUS: FlowLaw(_unit, lambda arc, network: arc.flow, is_scheduled=True),  # e(t)
    Law.BATCH: FlowLaw(_unit, lambda arc, network: 0.0),  # nothing flows: what moves in batches moves at once
    # s·a·x_donor, or s·q of a donor that stores nothing
    Law.SHARE: FlowLaw(lambda arc, network, rows: int(rows.donors[network.arc_index[arc.id]]), _release),
}


class ArcRates:
    """Drivers and rates of every arc, but for shares and draws, and how fast stocks can turn over.

    Attributes:
        staged_network: whose arcs they are, with lifetimes as stages.
        rows: which row of the masses is what.
        driver: row of the extended stocks that drives each arc, shape (arcs,).
        is_scheduled: arcs that flow by schedule out of stocks, shape (arcs,).
        control_low: lower bounds of the controls in each interval, in the rows of ``network.control_rows``, shape
            (controls, horizon).
        control_high: upper bounds.
        neutral: values while nobody acts.
        max_rate: upper bound of r of each arc, shape (arcs,).
        driven_arcs: arcs that stocks drive; of those that split what a stock releases one stands for all.
        driven_to: stock that each of these fills; the number of stores where it is split or passed on.
        driven_rate: upper bound of r of each of these, of a split as a whole.
        turnover: upper bound of what each stock drives, relative to it, shape (stores,), 1/time.
    """

    def __init__(self, staged_network: Network, draws: FlowFactors | None = None) -> None:
        """Compile a network that has its lifetimes as stages if it has any; ``draws`` may raise rates."""
        self.staged_network = network = staged_network
        self.rows = rows = StateLayout(network)
        laws = [LAWS[arc.law] for arc in network.arcs]
        self.is_scheduled = np.array([law.is_scheduled for law in laws], dtype=bool)
        self.is_scheduled[[*network.orders]] = False
        drivers = [law.driver(arc, network, rows) for law, arc in zip(laws, network.arcs, strict=True)]
        self.driver: Integers = np.array(drivers, dtype=np.intp)
        base = [law.coefficient(arc, network) for law, arc in zip(laws, network.arcs, strict=True)]
        constant = [1.0 if isinstance(value, Series) else value for value in base]
        self._base: Floats = np.array(constant, dtype=float).reshape(-1, 1)
        self._compile_controls()
        # of a series r is the mean over the interval, which ``rate`` multiplies in
        series = [(k, network.interval_means(value)) for k, value in enumerate(base) if isinstance(value, Series)]
        self._series_arcs: Integers = np.array([k for k, _ in series], dtype=np.intp)
        self._series = np.array([means for _, means in series]).reshape(len(series), network.episode.horizon)
        self._bound_rates(draws)

    def _bound_rates(self, draws: FlowFactors | None) -> None:
        """Bound what arcs carry and stocks drive with every control at its upper bound."""
        widest = single_column(self.control_high).max(axis=1, keepdims=True)
        least = single_column(self.control_low).min(axis=1, keepdims=True)
        if draws is not None:
            least, widest = draws.controls.extreme(least, 0), draws.controls.extreme(widest, 1)
            widest[draws.capacity.rows] *= draws.highest_capacity
        widest[self.stretch_rows] = least[self.stretch_rows]
        self.max_rate: Floats = self._rate_without_shares(widest)[:, 0]
        if len(self._series_arcs):
            self.max_rate[self._series_arcs] *= self._series.max(axis=1)
        if draws is not None:
            self.max_rate[draws.arcs] *= draws.highest
        # the arcs of a split carry together what one of them would carry alone: the first without control counts
        stores, representatives = self.rows.nodes.stop, dict[str, int]()
        is_counted, ends = self.driver < stores, np.minimum(self.staged_network.recipients, stores)
        for k, arc in enumerate(self.staged_network.arcs):
            if arc.law is Law.SHARE:
                is_counted[k] = False
                if arc.control is None and self.driver[k] < stores:
                    representatives.setdefault(arc.donor, k)
        first = [*representatives.values()]
        is_counted[first], ends[first] = True, stores
        self.driven_arcs = np.flatnonzero(is_counted)
        self.driven_to, self.driven_rate = ends[self.driven_arcs], self.max_rate[self.driven_arcs]
        self.turnover: Floats = np.bincount(self.driver[self.driven_arcs], self.driven_rate, stores).astype(float)

    def solver_steps(self) -> int:
        """Return the solver's steps in a control interval.

        Raises:
            CirlError: for rates that it cannot follow; names the fastest node, its rate and the largest usable step.
        """
        network, episode = self.staged_network, self.staged_network.episode
        fastest = float(self.turnover.max(initial=0.0))
        if episode.solver != "euler" and len(self.turnover):
            node = re.split("[.:]", network.nodes[int(self.turnover.argmax())].id)[0]
            subject = f"network '{network.name}': node '{node}' turns over {fastest:.4g}/{network.time_unit}"
            if fastest * episode.control_interval > MAX_STEPS * MAX_TURNOVER:
                raise CirlError(
                    f"{subject}; a control interval of {episode.control_interval:g} {network.time_unit} would need "
                    f"more than {MAX_STEPS:,} solver steps. Is a rate in the wrong unit?"
                )
            step = episode.solver_step or 0.0
            if episode.solver == "rk4" and fastest * step > MAX_TURNOVER:
                raise CirlError(
                    f"{subject}; solver 'rk4' needs a solver_step of at most {MAX_TURNOVER / fastest:.4g} "
                    f"{network.time_unit}, not {step:g}"
                )
        stated = 1 if episode.solver_step is None else round(episode.control_interval / episode.solver_step)
        if episode.solver == "exact":
            return max(stated, math.ceil(fastest * episode.control_interval / MAX_TURNOVER - 1e-9))
        return stated

    def control_multipliers(self, controls: Floats) -> Floats:
        """Return by what controls multiply the rates of arcs: a stretch by its inverse."""
        if not len(self.stretch_rows):
            return controls
        controls = controls.copy()
        controls[self.stretch_rows] = 1.0 / controls[self.stretch_rows]
        return controls

    def _rate_without_shares(self, controls: Floats) -> Floats:
        """Return r, but for shares and time series."""
        controls = self.control_multipliers(controls)
        if self._partial:  # some arc lacks a control: let a row of ones stand in for it
            controls = np.concatenate([controls, np.ones((1, controls.shape[1]))])
        own_row, base, donor = self.own_control, self._base, self.donor_control
        if sparse := 2 * len(self.controlled_arcs) < len(base):
            rate = np.empty((len(base), controls.shape[1]))
            rate[...] = base
            own_row, donor = own_row[self.controlled_arcs], donor[self.controlled_arcs]
            base = base[self.controlled_arcs]
        rate_: Floats = controls.take(own_row, axis=0)
        rate_ *= base
        rate_ *= controls.take(donor, axis=0)
        if not sparse:
            return rate_
        rate[self.controlled_arcs] = rate_
        return rate

    def _compile_controls(self) -> None:
        """Find for each arc the rows of the control array that act on it; the row past the last is 1."""
        network = self.staged_network
        kinds = {c.id: c.control.kind for c in network.compartments.values() if c.control is not None}
        position = {id_: network.control_rows[id_].start for id_, kind in kinds.items() if kind in SCALING}
        stretch_rows = [position[id_] for id_, kind in kinds.items() if kind is ControlKind.STRETCH]
        self.stretch_rows: Integers = np.array(stretch_rows, dtype=np.intp)
        self.control_low, self.neutral, self.control_high = network.control_bounds
        no_row = len(self.neutral)
        valves = network.valves if isinstance(network, StagedNetwork) else {}

        def acting_on(arc: Arc) -> tuple[int, int]:
            if arc.donor in valves:
                return no_row, position.get(valves[arc.donor], no_row)
            donor = network.compartments[arc.donor]
            own_row, valve = position.get(arc.id, no_row), position.get(arc.donor, no_row)
            if donor.control is not None and donor.control.kind is FLOW:
                return (valve, no_row) if arc.law is Law.CONTROLLED else (own_row, no_row)
            return own_row, valve

        rows = np.array([acting_on(arc) for arc in network.arcs], dtype=np.intp).reshape(-1, 2)
        self.own_control, self.donor_control = rows[:, 0].copy(), rows[:, 1].copy()
        self._partial = bool((rows == no_row).any())
        self.controlled_arcs: Integers = np.flatnonzero((rows < no_row).any(axis=1))


class FlowLaws(ArcRates):
    """Drivers, rates and controls of every arc; with ``uncertain``, of copies with draws of the uncertain numbers.

    Attributes:
        factors: on numbers that are uncertain or disturbed.
        network: whose laws they are; arcs of ``staged_network`` begin with its own.
        incidence: S with empty rows for batches and unit, shape (masses, arcs).
        time_dependent: arcs whose r depends on the interval, by id.
        is_fixed: arcs whose r is the same in all copies and intervals, shape (arcs,).
        routing: what passes through nodes that store nothing.
        orders: flows out of these that are asked for.
        control_factors: which controls are as they were drawn.
        source_contents: what sources give whose contents change; not in ``rate``, which is of orders.
    """

    def __init__(self, network: Network, *, uncertain: bool = False) -> None:
        """Compile ``network``."""
        staged_network = simulated_network(network)
        self.factors = IntervalFactors(network, uncertain=uncertain)
        ranges = self.factors.ranges
        self.flow_factors = FlowFactors(staged_network, ranges) if ranges else None
        self.control_factors = ControlFactors(staged_network, ranges)
        super().__init__(staged_network, self.flow_factors)
        self.network, rows, arcs = network, self.rows, len(staged_network.arcs)
        ends = np.concatenate([staged_network.donors, staged_network.recipients])
        has_stock, arcs_twice = ends < rows.nodes.stop, np.tile(np.arange(arcs), 2)
        signs = np.repeat([-1.0, 1.0], arcs)
        self.incidence = RowSum(ends[has_stock], arcs_twice[has_stock], signs[has_stock], (rows.masses, arcs))
        self.shares = Shares(staged_network, ranges)
        self.max_rate[self.shares.arcs] *= self.shares.highest
        self.max_rate[[*staged_network.orders]] = 1.0
        self.source_contents = SourceContents(network, staged_network, ranges)
        time_arcs = [*self._series_arcs, *(self.shares.varying_arcs if self.shares.is_time_varying else ())]
        time_arcs += self.source_contents.arcs[0].tolist() if self.source_contents.varies else []
        self.time_dependent = tuple(staged_network.arcs[k].id for k in time_arcs)
        self._share_out()
        self.routing = Routing(staged_network, self.rate(self.neutral[:, :1]), self.is_fixed, ranges)
        self.orders = Orders(staged_network, self.routing)

    def _share_out(self) -> None:
        """Multiply constant shares into r, where no control comes before them, and find out which r never change."""
        shares = self.shares
        self.is_fixed = ~self.is_scheduled
        self.is_fixed[self.controlled_arcs] = False
        donors = self.staged_network.donors
        self.is_fixed[np.isin(donors, donors[[*self.staged_network.orders]])] = False
        once = ~np.isin(shares.constant_arcs, self.controlled_arcs)
        self._base[shares.constant_arcs[once]] *= shares.values[once]
        self._constant_shares = shares.constant_arcs[~once], shares.values[~once]
        self.is_fixed[self._series_arcs] = False
        self.is_fixed[shares.varying_arcs] = False
        if self.flow_factors is not None:
            self.is_fixed[self.flow_factors.arcs] = False

    def rate(self, controls: Floats, step: Integers | None = None, factors: Floats | None = None) -> Floats:
        """Return r of each arc, shape (arcs, B): 1/time for stock-driven arcs, mass/time for scheduled ones.

        Args:
            controls: physical values in the rows of ``network.control_rows``, shape (controls, B).
            step: index of the control interval in each copy, shape (B,); without it time series count as 1.
            factors: on the uncertain numbers, shape (numbers, B); None leaves them as they are stated.
        """
        rate = self._rate_without_shares(controls)
        if len(self._constant_shares[0]):
            arcs, shares = self._constant_shares
            rate[arcs] *= shares
        if len(self.shares.varying_arcs):
            rate[self.shares.varying_arcs] *= self.shares(controls, step, factors)
        if step is not None and len(self._series_arcs):
            rate[self._series_arcs] *= self._series[:, step]
        if factors is not None and self.flow_factors is not None:
            self.flow_factors.multiply(rate, factors)
        return rate

    def constant_rate(self, step: Integers) -> Floats:
        """Return what controls, varying shares and factors multiply in the rates of arcs, shape (arcs, B)."""
        rate = np.repeat(self._base, len(step), axis=1)
        arcs, shares = self._constant_shares
        rate[arcs] *= shares
        if len(self._series_arcs):
            rate[self._series_arcs] *= self._series[:, step]
        return rate

    def neutral_in(self, step: Integers, factors: Floats | None = None) -> Floats:
        """Return the controls while nobody acts, in one interval of each copy, shape (controls, B)."""
        neutral = self.control_factors(_in_interval(self.neutral, step), factors)
        if factors is None or self.flow_factors is None or not len(self.flow_factors.capacity.rows):
            return neutral
        return np.minimum(neutral, self.capacity_in(step, factors))

    def capacity_in(self, step: Integers, factors: Floats | None) -> Floats:
        """Return the upper bounds of the controls, likewise."""
        bounds = self.control_factors(_in_interval(self.control_high, step), factors)
        return bounds if self.flow_factors is None else self.flow_factors.capacity(bounds, factors)

    def flow(self, stock: Floats, rate: Floats) -> Floats:
        """Return the flows f = r ∘ y[driver], shape (arcs, B), mass/time; ``routing`` fills in what is passed on."""
        flow: Floats = stock.take(self.driver, axis=0)
        flow *= rate
        return flow

    def extend(self, stock: Floats) -> Floats:
        """Append empty batch rows and the unit row to stocks of shape (stores, B)."""
        batch = stock.shape[1]
        return np.concatenate([stock, np.zeros((len(self.rows.batch_names), batch)), np.ones((1, batch))])


def _in_interval(table: Floats, step: Integers) -> Floats:
    """Return the values of controls, shape (controls, horizon), in an interval of each copy, shape (controls, B)."""
    table = single_column(table)  # ``take`` would first write out what is broadcast
    return table.take(step, axis=1) if table.shape[1] > 1 else np.repeat(table, len(step), axis=1)
