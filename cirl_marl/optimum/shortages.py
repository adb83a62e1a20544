"""How far a stock that idle arcs make up for may fall short: rows of theorem 7 of docs/bound.md.

While nobody acts on them, arcs that make up for a service supply the most that they can before it falls short. So its
stock q at the end of an interval, of which D is demanded, and the flow u of any of these arcs obey ::

    D − q ≤ L·(u − low)/(high − low),

L being the most that can lack while they supply the most: D at most. Less where a part r of that arrives at least, as
there is at the start what was demanded then, or what was left while they supplied the most. Of stocks that fall by at
most k,

    q̲_t = e^{−kh} min(D_{t−1}, q̲_{t−1}) + (1 − e^{−kh})/k·Σ r high,    L_t = max(0, D_t − q̲_t).

Of lifetimes q̲_t is the least of what their inflows U ≥ 0 may leave, a linear program over these alone, with σ̲ and σ̄
the enclosed shares of them that are left (``kernels``) ::

    min Σ σ̲_t U    subject to    start_r + Σ σ̄_r U ≥ min(D_r, q̲_r)    for all r < t.

Any multipliers of its rows prove a value, as all inflows are bounded.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial
from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from cirl_marl.dynamics.supply import NOTABLE
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Service
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.constraints import service_columns
from cirl_marl.optimum.kernels import Kernel
from cirl_marl.optimum.matrices import ProgramRows
from cirl_marl.optimum.reach import ComparisonSystem, Reach
from cirl_marl.optimum.vintages import WholeLifetime

ARRIVAL = 1e-6
"""Least part of a supply that has to arrive, so that the simulator finds how much of it is needed."""
KERNEL_DEGREE = 2
"""Of the kernels that enclose what is left of a lifetime."""
ROUND_OFF = 1e-9
"""Part of a demand by which the least stock is lowered for rounding errors, which are far smaller."""


def shortage_rows(
    admissible: Admissible,
    system: ComparisonSystem,
    reach: Reach,
    initial: Floats,
    intervals: range,
    rows: ProgramRows,
) -> None:
    """Add D − q − L·(u − low)/(high − low), at most 0, of idle arcs that make up for stocks; keys (8, step, arc).

    Nothing is said of arcs on which a valve acts too, of intervals in which a donor may run dry, and of
    routes through which little of the supply may arrive. What the simulator may miss of a demand without a warning,
    NOTABLE of it, is allowed for.
    """
    network, layout = admissible.network, rows.layout
    period, t = slice(intervals.start, intervals.stop), np.arange(len(intervals))
    has_valve = (admissible.valve != 1.0).any(axis=(0, 1))
    for s, service in enumerate(network.services):
        if service.quantity != "stock" or service.substance:
            continue
        supply = _Supply.of(admissible, system, service, intervals)
        if supply is None:
            continue
        present = supply.arcs[supply.is_present]
        is_known = reach.uncut[:, present].all(axis=1) & ~has_valve[network.donors[present]].any()
        holds = np.asarray(is_known, dtype=bool) & supply.arrives
        demand, (low, high) = admissible.service_low[period, s], supply.orders
        most = _largest_shortage(admissible, supply, reach, initial, intervals, demand)
        room = high - low
        for k, first in enumerate(supply.arcs[0].tolist()):
            is_free = holds & (room[:, k] > 0)
            slope = np.divide(most, room[:, k], out=np.zeros_like(most), where=is_free)
            row = rows.add(8, t, first)
            columns = t[:, None] * layout.size + layout.end[-1] + supply.stocks
            rows.put(row[:, None], columns, -1.0 * is_free[:, None])
            for component in supply.arcs[:, k].tolist():
                columns = t[:, None] * layout.size + layout.flow + component
                rows.put(row[:, None], columns, -slope[:, None] / len(layout.moments))
            allowance = NOTABLE * (demand + slope * room.sum(axis=1))
            rows.limit(row, np.where(is_free, allowance - demand - slope * low[:, k], 0.0))


@positional_record
class _Supply:
    """Idle arcs that make up for a service, and where what they bring arrives."""

    stocks: Annotated[Integers, "of the service, of each component its own, shape (stocks,)"]
    arcs: Annotated[Integers, "of each component, shape (components, arcs)"]
    is_present: Annotated[NDArray[np.bool_], "whether there may be something of it, likewise"]
    orders: Annotated[Floats, "least and most that is asked of the whole of each, shape (2, steps, arcs), mass/time"]
    arrivals: Annotated[Floats, "least part of each that arrives, shape (steps, stocks, components, arcs)"]

    @classmethod
    def of(cls, admissible: Admissible, system: ComparisonSystem, service: Service, intervals: range) -> _Supply | None:
        """Return the arcs that supply a service while nobody acts on them; None if there are none."""
        network, lifetimes, mixtures = admissible.network, admissible.lifetimes, admissible.mixtures
        idle = [
            k
            for k, arc in enumerate(network.arcs)
            if arc.makes_up_for == service.id
            and arc.weight != 0.0
            and network.original(arc.id) == arc.id
            and arc.id not in admissible.agents
        ]
        if not idle:
            return None
        period, steps = slice(intervals.start, intervals.stop), len(intervals)
        if mixtures is None:
            arcs = np.array([idle])
            is_present, limits = np.ones_like(arcs, dtype=bool), admissible.setting[:, period][:, :, idle]
        else:
            whole = [mixtures.arcs[0].tolist().index(k) for k in idle]
            arcs, is_present = mixtures.arcs[:, whole], mixtures.content[1][:, whole] > 0
            limits = mixtures.orders[:, period][:, :, np.searchsorted(mixtures.scheduled, whole)]
        stocks = np.array([column for _, column in service_columns(network, service)])
        reached, places = lifetimes.reach_network, np.arange(arcs.size)
        inflow = np.zeros((len(reached.nodes), arcs.size))
        inflow[reached.recipients[lifetimes.arcs_reached[arcs.ravel()]], places] = 1.0
        parts = lifetimes.nodes_reached[stocks].toarray()[:, : len(reached.stores)]
        kinds = admissible.kinds[period].tolist()
        by_kind = {kind: parts @ system.of_interval(kind).routes.least(inflow) for kind in set(kinds)}
        arrivals = np.array([by_kind[kind] for kind in kinds]).reshape(steps, len(stocks), *arcs.shape)
        return cls(stocks, arcs, is_present, limits, arrivals)

    @property
    def arrives(self) -> NDArray[np.bool_]:
        """Whether in each interval enough of each arrives for the simulator to find how much is needed, (steps,)."""
        enough = (self.arrivals.sum(axis=1) > ARRIVAL) | ~self.is_present
        return np.asarray(enough.all(axis=(1, 2)))

    def least(self, weights: Floats) -> Floats:
        """Return the least sum of what arrives at each stock times its weight, shape (steps, stocks) → (steps,)."""
        by_component = np.einsum("ts,tsca->tca", weights, self.arrivals)
        by_arc = np.where(self.is_present, by_component, np.inf).min(axis=1)
        return np.asarray((self.orders[1] * by_arc).sum(axis=1))


def _largest_shortage(
    admissible: Admissible, supply: _Supply, reach: Reach, initial: Floats, intervals: range, demand: Floats
) -> Floats:
    """Return L in each interval, shape (steps,), mass."""
    network = admissible.network
    by_stock = {network.node_index[lifetime.node.id]: lifetime for lifetime in admissible.lifetimes.whole}
    lives = [by_stock[stock] for stock in supply.stocks.tolist() if stock in by_stock]
    if not lives:
        least = _least_of_stocks(admissible, initial, intervals, supply, demand)
    elif len(lives) < len(supply.stocks) or any(life.factor.size or not len(life.rate) for life in lives):
        return demand
    else:
        least = _least_of_lifetimes(admissible, lives, reach, initial, intervals, supply, demand)
    return np.clip(demand * (1.0 + ROUND_OFF) - least, 0.0, demand)


def _least_of_stocks(
    admissible: Admissible, initial: Floats, intervals: range, supply: _Supply, demand: Floats
) -> Floats:
    """Return q̲ of stocks that leave in proportion to themselves; 0 of others."""
    network, least = admissible.network, np.zeros(len(demand))
    leaving = np.isin(network.donors, supply.stocks)
    if (admissible.driver[leaving] != network.donors[leaving]).any():
        return least
    before = float((admissible.lifetimes.start_planned @ initial)[supply.stocks].sum())
    interval = network.episode.control_interval
    kinds = admissible.kinds[intervals.start : intervals.stop].tolist()
    turnover = np.array([float(admissible.ranges[kind].exits[1, supply.stocks].max()) for kind in kinds]) * interval
    weights = np.repeat(interval * special.exprel(-turnover)[:, None], len(supply.stocks), axis=1)
    for t, arrival in enumerate(supply.least(weights)):
        least[t] = np.exp(-turnover[t]) * before + arrival
        before = min(demand[t], least[t])
    return least


def _least_of_lifetimes(
    admissible: Admissible,
    lives: Sequence[WholeLifetime],
    reach: Reach,
    initial: Floats,
    intervals: range,
    supply: _Supply,
    demand: Floats,
) -> Floats:
    """Return q̲ of the sum of lifetimes that nobody stretches."""
    network, period = admissible.network, slice(intervals.start, intervals.stop)
    steps, interval, moments = len(intervals), network.episode.control_interval, KERNEL_DEGREE + 1
    start, now = np.zeros(steps), np.zeros((steps, len(lives)))
    # of what drives inflows: which parts are left later, least and greatest, and the most that it is
    left, most = dict[tuple[bool, int], Floats](), dict[tuple[bool, int], Floats]()
    low, high = admissible.rate[:, period]
    for place, life in enumerate(lives):
        rate = life.rate[period]
        key = ("shortages", network.original(life.node.id), rate.tobytes())
        kernel = admissible.lifetimes.cache.value(key, partial(Kernel, life.chain, rate, interval, KERNEL_DEGREE))
        start += kernel.start_survivors @ life.masses(initial)
        survivors = np.stack([kernel.survivors_low, kernel.survivors_high]).reshape(2, steps, steps, moments)
        now[:, place] = np.diagonal(survivors[0].sum(axis=2))
        for arc in life.inflow_arcs.tolist():
            driver = int(admissible.driver[arc])
            is_exact = not admissible.by_schedule[arc] and bool((low[:, arc] == high[:, arc]).all())
            source = (is_exact, driver if is_exact else arc)
            part = low[:, arc] if is_exact else np.ones(steps)
            left[source] = left.get(source, 0.0) + survivors * part[:, None]
            driven = np.ones(steps) if admissible.by_schedule[arc] else reach.upper[:, driver]
            most[source] = driven if is_exact else high[:, arc] * driven
    if not left:
        return start
    shares = np.concatenate([*left.values()], axis=3)
    highest = np.repeat(np.stack([*most.values()], axis=1), moments, axis=1)
    least, floor, arrival = np.zeros(steps), np.zeros(steps), supply.least(now)
    for t in range(steps):
        rows = shares[1, :t, :t].reshape(t, highest[:t].size)
        earlier = _least_sum(shares[0, t, :t].ravel(), rows, (floor - start)[:t], highest[:t].ravel())
        least[t] = start[t] + earlier + arrival[t]
        floor[t] = min(demand[t], least[t])
    return least


def _least_sum(cost: Floats, rows: Floats, limits: Floats, most: Floats) -> float:
    """Return what multipliers prove of the least cᵀU with A U ≥ b and 0 ≤ U ≤ Ū; 0, if none are found, as c ≥ 0."""
    if not len(cost):
        return 0.0
    solution = optimize.linprog(cost, A_ub=-rows, b_ub=-limits, method="highs")
    if solution.status != 0:
        return 0.0
    multipliers = np.maximum(-solution.ineqlin.marginals, 0.0)
    return max(0.0, float(multipliers @ limits + np.minimum(cost - multipliers @ rows, 0.0) @ most))
