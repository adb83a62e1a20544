"""Constraints of the linear program: balances, flow laws, shares, schedules, services, valves and idle supplies.

Each function writes the rows of one family for an interval, or those that depend on the start for a whole episode.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Iterator

import numpy as np

from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import Service
from cirl_marl.optimum.admissible import Admissible, IntervalRanges
from cirl_marl.optimum.matrices import ProgramRows
from cirl_marl.optimum.reach import Reach

SMALL_TURNOVER = 1e-3
"""Turnover in a piece below which a series of it is closer than the formula."""


def balances(rows: ProgramRows) -> None:
    """Add Y_i − Y_{i−1} − δ/(d + 1)·S F_i, which is 0, for i = 0 … d (theorem 1); keys (moment, node).

    Y_i = ((d − i) X_i + (i + 1) X_{i+1})/(d + 1) are the means weighted with the polynomials of degree d − 1;
    Y_{−1} and Y_d are the stocks at the two ends of the piece, δ its length.
    """
    layout, network, d = rows.layout, rows.layout.network, rows.layout.degree
    moment, node = layout.moment_column, np.arange(len(network.stores))
    row = rows.add(moment, node)
    for side, sign in ((network.donors, 1.0), (network.recipients, -1.0)):
        arcs = np.flatnonzero(side < len(node))
        rows.put(row[:, side[arcs]], layout.flow[moment] + arcs, sign * layout.portion)
    for j in layout.moments:
        piece, i = divmod(j, d + 1)
        if i < d:  # Y_i
            rows.put(row[j], layout.stock[j] + node, (d - i) / (d + 1))
            rows.put(row[j], layout.stock[j + 1] + node, (i + 1) / (d + 1))
        else:
            rows.put(row[j], layout.end[piece] + node, 1.0)
        if i > 0:  # − Y_{i−1}
            rows.put(row[j], layout.stock[j - 1] + node, -(d - i + 1) / (d + 1))
            rows.put(row[j], layout.stock[j] + node, -i / (d + 1))
        else:
            rows.at_start(row[j], piece, node, -1.0)


def flow_laws(ranges: IntervalRanges, equal: ProgramRows, under: ProgramRows) -> None:
    """Add the flow laws of an interval: rows that are 0 and rows at most 0; keys (0, moment, family, index, side)."""
    network, layout = ranges.network, equal.layout
    moment, valves = layout.moment_column, layout.valves

    def hold(family: int, index: Integers, column: Integers, driver: Integers, factor: Floats) -> None:
        """Hold low·driver ≤ column ≤ high·driver, with columns of shape (moments, index)."""
        low, high = factor
        exact = low == high
        row = equal.add(0, moment, family, index[exact])
        equal.put(row, column[:, exact], 1.0)
        equal.put(row, driver[:, exact], -low[exact])
        for side, sign, bound in ((0, 1.0, high), (1, -1.0, low)):
            row = under.add(0, moment, family, index[~exact], side)
            under.put(row, column[:, ~exact], sign)
            under.put(row, driver[:, ~exact], -sign * bound[~exact])

    place = np.arange(len(valves))
    hold(1, place, layout.valve[moment] + place, layout.stock[moment] + valves, ranges.valve[:, valves])
    # behind a valve that several outflows share F_i = w·a·Z_i with Z_i = v·X_i; else F_i = v·w·a·X_i
    arcs = np.setdiff1d(np.flatnonzero(ranges.proportional), ranges.followers)
    driver = ranges.driver[arcs]
    through = (network.donors[arcs] == driver) & np.isin(driver, valves)
    factor = np.where(through, ranges.setting[:, arcs] * ranges.base[arcs], ranges.rate[:, arcs])
    behind = layout.valve[moment] + np.searchsorted(valves, driver)
    column = np.where(through, behind, layout.stock[moment] + driver)
    hold(2, arcs, layout.flow[moment] + arcs, column, factor)


def mean_stocks(ranges: IntervalRanges, rows: ProgramRows) -> None:
    """Add X − θ x_start − (1 − θ) x_end, which is 0, for plain means of stocks; keys (piece, node, 1).

    If inflow is even in a piece and z = a·δ of the stock leaves in proportion, x − x_∞ falls like e^{−zs}, so that this
    holds with θ = 1/z − 1/(e^z − 1), which is 1/2 for z = 0. Here a is neutral.
    """
    layout, stores = rows.layout, np.arange(len(rows.layout.network.stores))
    exits = np.flatnonzero(ranges.proportional & (ranges.driver < len(stores)))
    turnover = np.bincount(ranges.driver[exits], ranges.neutral_rate[exits], len(stores)) * layout.length
    formula = turnover > SMALL_TURNOVER
    z = np.where(formula, turnover, 1.0)
    at_start = np.where(formula, 1.0 / z - 1.0 / np.expm1(z), 0.5 - turnover / 12.0)
    piece = np.arange(layout.pieces)[:, None]
    row = rows.add(piece, stores, 1)
    rows.put(row, layout.stock[piece] + stores, 1.0)
    rows.put(row, layout.end[piece] + stores, at_start - 1.0)
    rows.at_start(row, piece, stores, -at_start)


def held_controls(driver: Integers, arcs: Integers, rate: Floats, valve: Floats, rows: ProgramRows) -> None:
    """Add F_i − F_{i−1} − r (X_i − X_{i−1}), and the same for Z; keys (1, moment, family, index, interval).

    For a constant factor r' it is (r' − r)(X_i − X_{i−1}), a product of two differences, here held at 0.

    Args:
        driver: node that drives each arc.
        arcs: those to be held.
        rate: r = v·w·a near which they are expected, shape (intervals, arcs).
        valve: the same of the valve of each node, shape (intervals, nodes).
        rows: over these intervals.
    """
    layout, moment, valves = rows.layout, rows.layout.moment_column[1:], rows.layout.valves
    t, place = np.arange(len(rate))[:, None, None], np.arange(len(valves))
    families = (
        (0, arcs, layout.flow, arcs, driver[arcs], rate[:, None, arcs]),
        (1, place, layout.valve, place, valves, valve[:, None, valves]),
    )
    for family, index, first, offset, node, factor in families:
        row = rows.add(1, moment, family, index, t)
        for at, sign in ((moment, 1.0), (moment - 1, -1.0)):
            rows.put(row, t * layout.size + first[at] + offset, sign)
            rows.put(row, t * layout.size + layout.stock[at] + node, -sign * factor)


def throughputs(ranges: IntervalRanges, rows: ProgramRows) -> None:
    """Add what holds of throughputs and shares in an interval, each 0; keys (2, moment, family, index).

    What enters a node that stores nothing is its throughput Q, and so is what leaves it. The shares of what a stock
    releases sum to the release. Arcs without control keep their proportions. Where all shares are given, the flow laws
    say it already.
    """
    network, layout, moment = ranges.network, rows.layout, rows.layout.moment_column
    stores, nodes, arcs = len(network.stores), len(network.nodes), np.arange(len(network.arcs))
    row = np.full((len(layout.moments), nodes), -1)
    row[:, stores:] = rows.add(2, moment, 0, np.arange(stores, nodes))
    inflows = network.recipients >= stores
    rows.put(row[:, network.recipients[inflows]], layout.flow[moment] + arcs[inflows], 1.0)
    rows.put(row[:, stores:], layout.stock[moment] + np.arange(stores, nodes), -1.0)
    for split in ranges.free_splits:
        total = rows.add(2, moment, 1, split.donor)
        rows.put(total, layout.flow[moment] + split.arcs, 1.0)
        release, place = -float(ranges.base[split.arcs[0]]), np.flatnonzero(layout.valves == split.donor)
        if len(place):
            rows.put(total, layout.valve[moment] + place, release)
        else:
            rows.put(total, layout.stock[moment] + split.donor, release * float(ranges.valve[0, split.donor]))
        row_of_follower = rows.add(2, moment, 2, split.followers)
        rows.put(row_of_follower, layout.flow[moment] + split.followers, 1.0)
        rows.put(row_of_follower, layout.flow[moment] + split.leader, -split.ratio)


def delivery_limits(ranges: IntervalRanges, rows: ProgramRows) -> None:
    """Add U·δ − x_start·z/(e^z − 1), at most 0, for the scheduled outflow U of each node; keys (0, piece, node).

    This is how the simulator cuts scheduled flows, with z = a·δ for the proportional exits of rate a; the least a gives
    the most. What flows in during the piece is not available to them. Of coarse pieces nothing is said.
    """
    layout = rows.layout
    if layout.coarse:
        return
    turnover = ranges.exits[0] * layout.length
    share = np.divide(turnover, np.expm1(turnover), out=np.ones(len(turnover)), where=turnover > 1e-9)
    arcs = np.flatnonzero(ranges.by_schedule)
    nodes, place = np.unique(ranges.network.donors[arcs], return_inverse=True)
    piece = np.arange(layout.pieces)[:, None]
    row = rows.add(0, piece, nodes)
    rows.put(row[:, place], layout.flow[piece * (layout.degree + 1)] + arcs, 1.0)
    rows.at_start(row, piece, nodes, -share[nodes] / layout.length)


def capacity_limits(ranges: IntervalRanges, rows: ProgramRows) -> None:
    """Add F_i − c·x_start, at most 0, for flows that a stock limits; keys (5, arc, moment).

    x_start is what the stock is at the start of the interval, a node with a lifetime, or components, as a whole.
    """
    layout, network = rows.layout, ranges.network
    for k, rate in zip(ranges.capacity_arcs.tolist(), ranges.capacity_rate.tolist(), strict=True):
        arc = network.arcs[k]
        parts = ranges.totals[[network.node_index[arc.capacity_node]]].toarray()[0]
        row, stores = rows.add(5, k, layout.moments), np.flatnonzero(parts)
        for component in network.components_of(arc.id):
            rows.put(row, layout.flow + network.arc_index[component], 1.0)
        rows.at_start(row[:, None], 0, stores, -rate * parts[stores])


def constant_schedules(ranges: IntervalRanges, equal: ProgramRows, under: ProgramRows, across: bool) -> None:
    """Add that a scheduled flow is constant in its piece, F_i = F_0; keys (0, moment, 0, arc, side).

    If pieces are coarse, or where it is asked for ``across`` pieces, a flow that nothing can cut is constant in the
    interval.
    """
    layout, arcs = equal.layout, np.flatnonzero(ranges.by_schedule)
    moment = layout.moment_column
    if across and not layout.coarse:
        starts = moment[layout.degree + 1 :: layout.degree + 1]
        _hold_schedules(under, arcs, starts, 0 * starts)
    first = 0 * moment if layout.coarse else moment - moment % (layout.degree + 1)
    later = (moment > first).ravel()
    if layout.coarse:
        _hold_schedules(under, arcs, moment[later], first[later])
        return
    row = equal.add(0, moment[later], 0, arcs, 0)
    equal.put(row, layout.flow[moment[later]] + arcs, 1.0)
    equal.put(row, layout.flow[first[later]] + arcs, -1.0)


def late_deliveries(ranges: IntervalRanges, rows: ProgramRows) -> None:
    """Add that schedules deliver late only what enters late, t/T·G(T) − G(t) − t/T·H, at most 0; keys (7, moment, arc).

    G(t) is delivered until t, and H enters the donor in the interval of length T. If all that is asked was delivered
    until t, G(t) ≥ t/T·G(T). Else the donor was empty once, and what comes later has entered since: G(T) − G(t) ≤ H.
    In the means weighted with the polynomials of degree d − 1, G(t) is δ/(d + 1)·Σ F_i over the moments until then.
    """
    network, layout = ranges.network, rows.layout
    has_lifetime, count = np.isin(network.donors, network.donors[ranges.leaves_lifetime]), len(layout.moments)
    arcs = np.flatnonzero(ranges.by_schedule & ~has_lifetime)
    inflows = [np.flatnonzero(network.recipients == donor) for donor in network.donors[arcs].tolist()]
    for moment in layout.moments[:-1]:
        share = (moment + 1) / count
        row = rows.add(7, moment, arcs)
        rows.put(row[None], layout.flow[:, None] + arcs, share - (layout.moment_column <= moment))
        for k, into in zip(row, inflows, strict=True):
            rows.put(k, layout.flow[:, None] + into, -share)


def _hold_schedules(rows: ProgramRows, arcs: Integers, moment: Integers, first: Integers) -> None:
    """Add that scheduled flows in some moments are those of others, but for what is cut."""
    for side, sign in ((0, 1.0), (1, -1.0)):
        row = rows.add(0, moment, 0, arcs, side)
        rows.put(row, rows.layout.flow[moment] + arcs, sign)
        rows.put(row, rows.layout.flow[first] + arcs, -sign)
        rows.loosen(row, arcs, 1.0)


def service_levels(ranges: IntervalRanges, rows: ProgramRows) -> None:
    """Add low·level − q ≤ 0 for each service and ±Δ·σ_env·f̄ − imbalance ≤ 0; their keys are (1, …).

    The level is at most min(1, q/low): a finite upper end of the band could only lower it further. Contents are with
    the components (``mixtures``).
    """
    layout, network, count = rows.layout, ranges.network, len(rows.layout.moments)
    for s, service in enumerate(network.services):
        if service.substance:
            continue
        row = rows.add(1, s)
        rows.put(row, layout.level + s, ranges.service_low[s])  # level ≤ q/low; level ≤ 1 is a box
        for at_end, column in service_columns(network, service):
            if at_end:
                rows.put(row, layout.end[-1] + column, -1.0)
            else:
                rows.put(row, layout.flow[layout.moment_column] + column, -1.0 / count)
    weights = -network.circularity_weights[1]
    arcs = np.flatnonzero(weights)
    pair = rows.add(1, len(network.services), [0, 1])
    for row, sign in zip(pair, (1.0, -1.0), strict=True):
        rows.put(row, layout.flow[layout.moment_column] + arcs, sign * weights[arcs] / count)
    rows.put(pair, layout.imbalance, -1.0)


def service_columns(network: Network, service: Service, component: int | None = None) -> Iterator[tuple[bool, int]]:
    """Yield whether a service reads a stock, at the end, or a flow, and its place, of all components or of one."""
    stages = network.stages if isinstance(network, StagedNetwork) else {}
    selected = slice(None) if component is None else slice(component, component + 1)
    if service.quantity == "stock":
        for node in (part for id_ in service.providers for part in network.components_of(id_)[selected]):
            yield from ((True, network.node_index[store]) for store in stages.get(node, (node,)))
        return
    arcs = [network.arcs[k].id for k in network.service_arcs(service)]
    for arc in (part for id_ in arcs if network.original(id_) == id_ for part in network.components_of(id_)[selected]):
        yield False, network.arc_index[arc]


def valve_envelopes(admissible: Admissible, reach: Reach, intervals: range, rows: ProgramRows) -> None:
    """Add the rows of valves that act on stock-driven and on scheduled outflows, over all intervals; keys (0, …).

    A scheduled flow is at most ū·v. With v ≤ v̄ and X ≤ x̄, (v̄ − v)(x̄ − X) ≥ 0 gives v̄ X + x̄ v − Z ≤ v̄ x̄, and
    (v − v̲)(x̄ − X) ≥ 0 gives Z − v̲ X − x̄ v ≤ −v̲ x̄ (McCormick 1976).
    """
    network, layout, nodes = admissible.network, rows.layout, rows.layout.free_valves
    period = slice(intervals.start, intervals.stop)
    t = np.arange(len(intervals))[:, None]
    valve = layout.free_valve + np.arange(len(nodes))
    place, most = np.searchsorted(layout.valves, nodes), reach.upper[:, nodes]
    low, high = admissible.valve[:, period, nodes]
    for i in layout.moments:
        for side, (x, z, v, limit) in enumerate(((high, -1.0, most, high * most), (-low, 1.0, -most, -low * most))):
            row = rows.add(0, t, nodes, 0, i, side)
            rows.put(row, t * layout.size + layout.stock[i] + nodes, x)
            rows.put(row, t * layout.size + layout.valve[i] + place, z)
            rows.put(row, t * layout.size + valve, v)
            rows.limit(row, limit)
    arcs = np.flatnonzero(admissible.by_schedule & np.isin(network.donors, nodes))
    donors = network.donors[arcs]
    capacity = admissible.setting[1, period, arcs].T * admissible.base[period, arcs]
    for piece in range(layout.pieces):
        row = rows.add(0, t, donors, 1 + arcs, piece)
        rows.put(row, t * layout.size + layout.flow[piece * (layout.degree + 1)] + arcs, 1.0)
        rows.put(row, t * layout.size + valve[np.searchsorted(nodes, donors)], -capacity)


def idle_supplies(admissible: Admissible, reach: Reach, intervals: range, rows: ProgramRows) -> None:
    """Add the rows of arcs that make up for the same service while nobody acts on them; keys (1, …).

    They are asked for u_k = min(low_k + w_k V, high_k) with one V ≥ 0. Let r be the one that is the last to come to its
    bound, so that V = (u_r − low_r)/w_r. As u_k is concave in V, it lies below its tangent at 0 and above its chord:

        u_k − low_k ≤ w_k/w_r·(u_r − low_r),    u_k − low_k ≥ (high_k − low_k)/(high_r − low_r)·(u_r − low_r).

    Where a donor may deliver less than it is asked for, there is room for all that may be asked.
    """
    period, layout = slice(intervals.start, intervals.stop), rows.layout
    starts = [layout.flow[piece * (layout.degree + 1)] for piece in range(layout.pieces)]
    starts += [layout.end_flow[piece] for piece in range(layout.pieces)] if layout.has_end_flows else []
    low, high = admissible.setting[:, period]
    shortage = np.where(reach.uncut, 0.0, high)
    t = np.arange(len(intervals))[:, None]
    for arcs, weight in idle_groups(admissible):
        room = np.where(weight > 0, (high - low)[:, arcs], 0.0)  # of weight 0 never more than the least
        latest = np.divide(room, weight, out=np.full_like(room, -1.0), where=weight > 0)
        place = latest.argmax(axis=1)[:, None]
        last, chord = arcs[place], np.zeros_like(room)
        np.divide(room, room[t, place], out=chord, where=room[t, place] > 0)
        tangent = np.broadcast_to(weight / weight[place], room.shape)
        for at, start in enumerate(starts):
            for side, sign, slope in ((0, 1.0, tangent), (1, -1.0, chord)):
                row = rows.add(1, t, arcs, at, side)
                rows.put(row, t * layout.size + start + arcs, sign)
                rows.put(row, t * layout.size + start + last, -sign * slope)
                allowance = slope * shortage[t, last] if side == 0 else shortage[:, arcs]
                rows.limit(row, sign * (low[:, arcs] - slope * low[t, last]) + allowance)


def least_deliveries(admissible: Admissible, reach: Reach, intervals: range, rows: ProgramRows) -> None:
    """Add c·u·x_start − U, at most 0, of what is asked of a stock at least by schedule, u; keys (2, …).

    A donor delivers min(1, x_start·s/u_all) of it, concave in x_start, and so at least its chord c·x_start from 0. Of
    the stocks at the very start, which are known, and of coarse pieces nothing is said. Where nothing can be cut the
    row is −U ≤ 0, so that multipliers of one start are those of another.
    """
    layout, donors = rows.layout, rows.layout.network.donors
    if layout.coarse:
        return
    least = admissible.rate[0, intervals.start : intervals.stop]
    in_stages = np.isin(donors, [layout.network.node_index[whole.node.id] for whole in admissible.lifetimes.whole])
    is_stock = donors < len(layout.network.stores)
    steps, arcs = np.nonzero(admissible.by_schedule & (least > 0) & is_stock & ~in_stages)
    for piece in range(layout.pieces):
        has_start = steps > 0 if piece == 0 else np.ones(len(steps), dtype=bool)
        t, k = steps[has_start], arcs[has_start]
        start = t * layout.size + layout.end[piece - 1] - (layout.size if piece == 0 else 0)
        row, may_be_cut = rows.add(2, t, k, piece), np.where(reach.uncut[t, k], 0.0, 1.0)
        rows.put(row, start + donors[k], may_be_cut * least[t, k] * reach.chord[t, k])
        rows.put(row, t * layout.size + layout.flow[piece * (layout.degree + 1)] + k, -1.0)


def order_rows(admissible: Admissible, reach: Reach, intervals: range, rows: ProgramRows) -> None:
    """Add the rows of orders from nodes that store nothing; keys (6, step, node or arc, family).

    Of mean throughputs q at most q̄, orders D_e in [D̲_e, D̄_e] get f_e = D_e·min(1, q/ΣD), so that

        f_e ≤ D̄_e,    D̲_r f_e ≤ D̄_e f_r,    D̲_e f_r ≤ D̄_r f_e,    min(1, ΣD̲/q̄)·q ≤ Σf,

    r being the order that is free the least, and the last as min(q, ΣD̲) is concave in q and lies above its chord.
    """
    network, layout, period = admissible.network, rows.layout, slice(intervals.start, intervals.stop)
    orders, mean, t = np.array(network.orders, dtype=np.intp), 1.0 / len(layout.moments), np.arange(len(intervals))
    t, (low, high) = t[:, None], admissible.order_range[:, period]
    markets, of = np.unique(network.donors[orders], return_inverse=True)
    flow, through = ((t * layout.size + column)[..., None] for column in (layout.flow, layout.stock))
    total, most = np.zeros((len(intervals), len(markets))), reach.upper[:, markets]
    np.add.at(total.T, of, low.T)
    part = np.divide(total, most, out=np.ones_like(most), where=most > total)
    least, limit = rows.add(6, t, markets, 0), rows.add(6, t, orders, 1)
    rows.put(least[:, None], through + markets, mean * part[:, None])
    rows.put(least[:, None, of], flow + orders, -mean)
    rows.put(limit[:, None], flow + orders, mean)
    rows.limit(limit, high)
    freedom = np.divide(high - low, high, out=np.zeros_like(high), where=high > 0).max(axis=0, initial=0.0)
    ranked = np.lexsort((freedom, of))
    firsts = ranked[np.searchsorted(of[ranked], np.arange(len(markets)))][of]
    partners = np.flatnonzero(firsts != np.arange(len(orders)))
    for family, (one, two) in enumerate(((partners, firsts[partners]), (firsts[partners], partners)), start=2):
        pair = rows.add(6, t, orders[partners], family)
        rows.put(pair[:, None], flow + orders[one], mean * low[:, None, two])
        rows.put(pair[:, None], flow + orders[two], -mean * high[:, None, one])


def idle_groups(admissible: Admissible) -> list[tuple[Integers, Floats]]:
    """Return the idle arcs of each service that several make up for, with their weights w.

    Each component has arcs of its own, which carry the part of w that they have of what is supplied. Left out are those
    of which the valve of a donor acts as well, and those of which this part may change.
    """
    network, mixtures = admissible.network, admissible.mixtures
    weights = np.array([1.0 if arc.weight is None else arc.weight for arc in network.arcs])
    component, varies = np.zeros((2, len(network.arcs)), dtype=np.intp)
    if mixtures is not None:
        component[mixtures.arcs] = np.arange(len(mixtures.arcs))[:, None]
        varies[mixtures.arcs] = mixtures.varies
        weights[mixtures.arcs] *= mixtures.content[0]
    groups = defaultdict[tuple[str, int], list[int]](list)
    for k, arc in enumerate(network.arcs):
        if arc.makes_up_for and network.original(arc.id) not in admissible.agents:
            groups[arc.makes_up_for, int(component[k])].append(k)
    valves = admissible.valve[:, :, network.donors]
    return [
        (np.array(arcs), weights[arcs])
        for arcs in groups.values()
        if len(arcs) > 1 and weights[arcs].any() and not varies[arcs].any() and (valves[:, :, arcs] == 1.0).all()
    ]
