"""How far a stock that idle arcs make up for may fall short: rows of theorem 7 of docs/bound.md.

While nobody acts on them, arcs that make up for a service supply the most that they can before it falls short. So its
stock q at the end of an interval, of which D is demanded, and the flow u of any of these arcs obey ::

    D − q ≤ L·(u − low)/(high − low),

L being the most that can lack while they supply the most: D at most. Less of a stock that they enter straight, as it
has at the start what was demanded then, or what was left while they supplied the most. Of a stock that falls by k,

    q̲_t = e^{−kh} min(D_{t−1}, q̲_{t−1}) + (1 − e^{−kh})/k·Σ high,    L_t = max(0, D_t − q̲_t).

Of a lifetime q̲_t is the least of what its inflow U ≥ 0 may leave, a linear program over that alone, with σ̲ and σ̄ the
enclosed shares of it that are left (``kernels``) ::

    min Σ σ̲_t U    subject to    start_r + Σ σ̄_r U ≥ min(D_r, q̲_r)    for all r < t.

Any multipliers of its rows prove a value, as all inflows are bounded.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import optimize, special

from cirl_marl.dynamics.supply import NOTABLE
from cirl_marl.network import Floats, Integers
from cirl_marl.network.elements import Service
from cirl_marl.optimum.admissible import Admissible
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

    Nothing is said of arcs on which a valve acts too, of contents, of intervals in which a donor may run dry, and of
    routes through which little of the supply may arrive. What the simulator may miss of a demand without a warning,
    NOTABLE of it, is allowed for.
    """
    network, layout = admissible.network, rows.layout
    if admissible.mixtures is not None:
        return
    period, t = slice(intervals.start, intervals.stop), np.arange(len(intervals))
    low, high = admissible.setting[:, period]
    has_valve = (admissible.valve != 1.0).any(axis=(0, 1))
    for s, service in enumerate(network.services):
        if service.quantity != "stock" or service.substance:
            continue
        arcs = _idle_arcs(admissible, service)
        if not len(arcs):
            continue
        stocks = np.array([network.node_index[node] for node in service.providers])
        is_known = reach.uncut[:, arcs].all(axis=1) & ~has_valve[network.donors[arcs]].any()
        holds = np.asarray(is_known, dtype=bool) & _arrives(admissible, system, arcs, stocks, intervals)
        demand = admissible.service_low[period, s]
        most = _largest_shortage(admissible, reach, initial, intervals, arcs, stocks, demand)
        room = high[:, arcs] - low[:, arcs]
        for k, width in zip(arcs.tolist(), room.T, strict=True):
            is_free = holds & (width > 0)
            slope = np.divide(most, width, out=np.zeros_like(most), where=is_free)
            row = rows.add(8, t, k)
            rows.put(row[:, None], t[:, None] * layout.size + layout.end[-1] + stocks, -1.0 * is_free[:, None])
            columns = t[:, None] * layout.size + layout.flow + k
            rows.put(row[:, None], columns, -slope[:, None] / len(layout.moments))
            allowance = NOTABLE * (demand + slope * room.sum(axis=1))
            rows.limit(row, np.where(is_free, allowance - demand - slope * low[:, k], 0.0))


def _idle_arcs(admissible: Admissible, service: Service) -> Integers:
    """Return the arcs that supply a service while nobody acts on them."""
    network = admissible.network
    arcs = [
        k
        for k, arc in enumerate(network.arcs)
        if arc.makes_up_for == service.id and arc.weight != 0.0 and network.original(arc.id) not in admissible.agents
    ]
    return np.array(arcs, dtype=np.intp)


def _arrives(
    admissible: Admissible, system: ComparisonSystem, arcs: Integers, stocks: Integers, intervals: range
) -> NDArray[np.bool_]:
    """Return whether in each interval enough of what each arc supplies arrives at the stocks, whatever the shares."""
    lifetimes, kinds = admissible.lifetimes, admissible.kinds[intervals.start : intervals.stop]
    network = lifetimes.reach_network
    inflow = np.zeros((len(network.nodes), len(arcs)))
    inflow[network.recipients[lifetimes.arcs_reached[arcs]], np.arange(len(arcs))] = 1.0
    parts = lifetimes.nodes_reached[stocks].toarray().sum(axis=0)[: len(network.stores)]
    enough = {
        kind: bool((parts @ system.of_interval(kind).routes.least(inflow) > ARRIVAL).all())
        for kind in np.unique(kinds).tolist()
    }
    return np.array([enough[kind] for kind in kinds.tolist()], dtype=bool)


def _largest_shortage(
    admissible: Admissible,
    reach: Reach,
    initial: Floats,
    intervals: range,
    arcs: Integers,
    stocks: Integers,
    demand: Floats,
) -> Floats:
    """Return L in each interval, shape (steps,), mass."""
    network, whole = admissible.network, admissible.lifetimes.whole
    straight, stock = arcs[np.isin(network.recipients[arcs], stocks)], int(stocks[0])
    if len(stocks) > 1 or not len(straight):
        return demand
    supply = admissible.setting[1, intervals.start : intervals.stop, straight].sum(axis=0)
    lifetime = next((each for each in whole if network.node_index[each.node.id] == stock), None)
    if lifetime is None:
        least = _least_of_stock(admissible, initial, intervals, stock, supply, demand)
    elif lifetime.factor.size or not len(lifetime.rate):
        return demand
    else:
        least = _least_of_lifetime(admissible, lifetime, reach, initial, intervals, supply, demand)
    return np.clip(demand * (1.0 + ROUND_OFF) - least, 0.0, demand)


def _least_of_stock(
    admissible: Admissible, initial: Floats, intervals: range, stock: int, supply: Floats, demand: Floats
) -> Floats:
    """Return q̲ of a stock that leaves in proportion to itself; 0 of another."""
    network, least = admissible.network, np.zeros(len(demand))
    leaving = network.donors == stock
    if (admissible.driver[leaving] != stock).any():
        return least
    before = float((admissible.lifetimes.start_planned @ initial)[stock])
    interval = network.episode.control_interval
    for t, kind in enumerate(admissible.kinds[intervals.start : intervals.stop].tolist()):
        turnover = float(admissible.ranges[kind].exits[1, stock]) * interval
        least[t] = np.exp(-turnover) * before + interval * special.exprel(-turnover) * supply[t]
        before = min(demand[t], least[t])
    return least


def _least_of_lifetime(
    admissible: Admissible,
    lifetime: WholeLifetime,
    reach: Reach,
    initial: Floats,
    intervals: range,
    supply: Floats,
    demand: Floats,
) -> Floats:
    """Return q̲ of a lifetime that nobody stretches."""
    network, period = admissible.network, slice(intervals.start, intervals.stop)
    rate, steps, interval = lifetime.rate[period], len(intervals), network.episode.control_interval
    key = ("shortages", lifetime.node.id, rate.tobytes())
    kernel = admissible.lifetimes.cache.value(key, lambda: Kernel(lifetime.chain, rate, interval, KERNEL_DEGREE))
    low, high = (part.reshape(steps, -1) for part in (kernel.survivors_low, kernel.survivors_high))
    start, moments = kernel.start_survivors @ lifetime.masses(initial), KERNEL_DEGREE + 1
    into = lifetime.inflow_arcs
    driven = np.where(admissible.by_schedule[into], 1.0, reach.upper[:, admissible.driver[into]])
    most = np.repeat((admissible.rate[1, period, into].T * driven).sum(axis=1), moments)
    least, floor = np.zeros(steps), np.zeros(steps)
    for t in range(steps):
        entered, now = moments * t, slice(moments * t, moments * (t + 1))
        earlier = _least_sum(low[t, :entered], high[:t, :entered], (floor - start)[:t], most[:entered])
        least[t] = start[t] + earlier + low[t, now].sum() * supply[t]
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
