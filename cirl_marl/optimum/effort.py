"""What controls are away from their neutral values, in a program: variables that are never more than it.

A flow F = c·o·a·y follows from a control c, what else scales it, o ∈ [o̲, ō], a number a and what drives it, y, at most
ȳ (1 of a flow by schedule). While c is held, the distance z = |c − n| from its neutral value n obeys

    F − n·ō·a·y ≤ (c − n)·ō·a·y ≤ z·ō·a·ȳ,        n·o̲·a·y − F ≤ (n − c)·o̲·a·y ≤ z·o̲·a·ȳ

for all weighted means of F and y. The rows are exact where y = ȳ, as by schedule, and o is one value; else z counts at
least the part y/ȳ. A flow that may be less than its control asks for has no row of the second kind: one that its donor
or a capacity cuts, or a share beside others that together may ask for more than 1. Factors on lifetimes have none,
nor have orders from nodes that store nothing.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from cirl_marl.network import Floats
from cirl_marl.network.elements import ControlKind, Node
from cirl_marl.optimum.admissible import Admissible, control_range, setter
from cirl_marl.optimum.matrices import ProgramRows
from cirl_marl.optimum.reach import Reach


def charged_controls(admissible: Admissible) -> tuple[str, ...]:
    """Return who acts and pays for the effort of its control."""
    compartments = admissible.lifetimes.network.compartments
    return tuple(agent for agent in admissible.agents if compartments[agent].effort)


def largest_distances(admissible: Admissible, agents: tuple[str, ...]) -> Floats:
    """Return how far controls may be away from their neutral values, shape (steps, agents)."""
    network = admissible.lifetimes.network
    low, neutral, high = network.control_bounds[:, [network.control_rows[agent].start for agent in agents]]
    distances: Floats = np.maximum(high - neutral, neutral - low).T
    return distances


def effort_rows(admissible: Admissible, reach: Reach, intervals: range, rows: ProgramRows) -> None:
    """Add two rows of each control for each flow that follows from it; keys (5, interval, arc, moment, agent, side).

    Of a flow by schedule all components count together.
    """
    layout, network, period = rows.layout, admissible.network, slice(intervals.start, intervals.stop)
    t, moments = np.arange(len(intervals))[:, None], np.arange(len(layout.moments))
    flow, stock = t * layout.size + layout.flow, t * layout.size + layout.stock
    for agent, k, factors, is_exact in _factors(admissible, reach, layout.charged_controls, period):
        neutral = network.control_bounds[1, network.control_rows[agent].start, period][:, None]
        by_schedule, driver = bool(admissible.by_schedule[k]), int(admissible.driver[k])
        arcs = network.components_of(network.arcs[k].id) if by_schedule else (network.arcs[k].id,)
        place = layout.charged_controls.index(agent)
        for side, sign, factor in ((0, 1.0, factors[1]), (1, -1.0, factors[0])):
            row, scale = rows.add(5, t, k, moments, place, side), factor[:, None] * admissible.base[period, [k]]
            most, room = scale, sign * neutral * scale
            for arc in arcs:
                rows.put(row, flow + network.arc_index[arc], sign)
            if not by_schedule:
                rows.put(row, stock + driver, -room)
                most, room = scale * reach.upper[:, [driver]], 0.0 * scale
            rows.put(row, t * layout.size + layout.effort + place, -most)
            if side == 1:
                room = room + np.where(is_exact[:, None], 0.0, neutral * most)
            rows.limit(row, room)


def _factors(
    admissible: Admissible, reach: Reach, agents: tuple[str, ...], period: slice
) -> Iterator[tuple[str, int, Floats, NDArray[np.bool_]]]:
    """Give each of some agents with each arc of whose flow its control is a factor, of components counted together one.

    With them come the lowest and highest product of what else scales the flow, shape (2, steps), and in which intervals
    it is all that the control asks for, shape (steps,).
    """
    network, is_cut = admissible.network, _cut_shares(admissible, period)
    for k, arc in enumerate(network.arcs if agents else ()):
        by_schedule = bool(admissible.by_schedule[k])
        if (
            k in admissible.lifetimes.exit_arcs
            or k in network.orders
            or (by_schedule and network.original(arc.id) != arc.id)
        ):
            continue
        parts = [network.arc_index[id_] for id_ in network.components_of(arc.id)] if by_schedule else [k]
        is_exact = np.asarray(reach.uncut[:, parts].all(axis=1) if by_schedule else ~is_cut[:, k])
        is_exact &= not arc.capacity_node
        donor, actor = network.nodes[network.donors[k]], setter(network, arc)
        if actor is not None and (agent := network.original(actor.id)) in agents:
            yield agent, k, admissible.valve[:, period, network.donors[k]], is_exact
        if _is_valve(donor) and (agent := network.original(donor.id)) in agents:
            factors = admissible.setting[:, period, k]
            if by_schedule and actor is not None:  # of all components
                factors = control_range(network, actor, admissible.agents)[::2, period]
            elif by_schedule:
                factors = np.ones_like(factors)
            yield agent, k, factors, is_exact


def _is_valve(node: Node) -> bool:
    return node.control is not None and node.control.kind is ControlKind.RATE


def _cut_shares(admissible: Admissible, period: slice) -> NDArray[np.bool_]:
    """Return which arcs may get less than the share that is asked for, shape (steps, arcs)."""
    network = admissible.network
    is_cut = np.zeros((network.episode.horizon, len(network.arcs)), dtype=bool)
    for split in (split.without(network.orders) for split in admissible.splits):
        ranges = [control_range(network, network.arcs[k], admissible.agents) for k in split.controlled_arcs]
        if ranges:
            is_cut[:, list(split.controlled_arcs)] = (np.sum(ranges, axis=0)[2] > 1.0)[:, None]
    return is_cut[period]
