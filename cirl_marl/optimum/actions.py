"""The actions that come closest to planned flows."""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.environments.actuators import Actuators
from cirl_marl.network import Floats
from cirl_marl.network.elements import ControlKind, Law
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.layout import Layout


def normalised_actions(
    admissible: Admissible, layout: Layout, planned: Floats, intervals: range | None = None
) -> Floats:
    """Return the actions whose constant factors give the planned mean flows at the planned mean stocks.

    v = Z̄/X̄ where a node has several outflows, else what its outflow asks with its own control neutral; then
    w_k = f̄_k/(a_k·v·X̄_p) and u_k = f̄_k/v, each clipped to its range. A share is such a w_k, of what is released. A
    stretch is 1/v, v being that of all stages together.

    Args:
        admissible: ranges of the factors.
        layout: of the variables.
        planned: variables of each interval, shape (steps, size).
        intervals: of the episode, whose first were planned; None is all of them.

    Returns:
        Actions in [−1, 1], in the order of ``MultiAgentVectorEnv.stack``, shape (steps, entries).
    """
    network, first = admissible.network, 0 if intervals is None else intervals.start
    during = slice(first, first + len(planned))
    own_range, valve_range, base = admissible.own[:, during], admissible.valve[:, during], admissible.base[during]
    stock, flow, through = layout.means(planned)
    neutral, valve = admissible.neutral_own[during], admissible.neutral_valve[during].copy()
    by_donor = admissible.driver == network.donors
    for k in np.flatnonzero(by_donor):
        donor = int(network.donors[k])
        if donor not in layout.valves and (valve_range[0, :, donor] < valve_range[1, :, donor]).any():
            unit = base[:, k] * neutral[:, k] * stock[:, donor]
            valve[:, donor] = _ratio(flow[:, k], unit, valve[:, donor])
    for z, node in enumerate(layout.valves):
        valve[:, node] = _ratio(through[:, z], stock[:, node], valve[:, node])
    if isinstance(network, StagedNetwork):
        for node in dict.fromkeys(network.valves.values()):
            arcs = [k for k in np.flatnonzero(by_donor) if network.valves.get(network.arcs[k].donor) == node]
            unit, place = base[:, arcs] * stock[:, network.donors[arcs]], network.node_index[node]
            valve[:, place] = _ratio(flow[:, arcs].sum(axis=1), unit.sum(axis=1), valve[:, place])
    # what is left of f̄_k after the valve is the arc's own factor, w_k = f̄_k/(a_k·v·X̄_p)
    valve = np.clip(valve, *valve_range)
    driving = np.where(admissible.scheduled, 1.0, stock[:, admissible.driver])
    own = _ratio(flow, base * driving * valve[:, network.donors], neutral)
    return _entries(admissible, valve, np.clip(own, *own_range), during)


def _entries(admissible: Admissible, valve: Floats, own: Floats, during: slice) -> Floats:
    network, steps = admissible.network, np.arange(during.start, during.stop)
    actuators = Actuators(FlowLaws(admissible.lifetimes.network), admissible.agents or None, len(steps))
    actions = np.zeros((len(steps), len(actuators.acting)))
    for agent, entries in actuators.entries.items():
        control = network.compartments[agent].control
        assert control is not None
        if agent in network.arc_index:
            values = own[:, network.arc_index[agent]]
        elif control.kind is ControlKind.RATE:
            values = valve[:, network.node_index[agent]]
        elif control.kind is ControlKind.STRETCH:
            values = 1.0 / valve[:, network.node_index[agent]]
        else:
            node = network.node_index[agent]
            sets = next(k for k in np.flatnonzero(network.donors == node) if network.arcs[k].law is Law.CONTROLLED)
            values = own[:, sets]
        actions[:, entries] = actuators.normalised(agent, values[None], steps).T
    return actions


def _ratio(amount: Floats, unit: Floats, otherwise: Floats) -> Floats:
    return np.divide(amount, unit, out=otherwise.copy(), where=unit > 1e-12 * np.abs(amount))
