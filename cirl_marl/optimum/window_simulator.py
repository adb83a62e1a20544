"""Some intervals of one copy of a network under planned actions, and what its services read off them."""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.supply import Supply
from cirl_marl.environments.actuators import Actuators
from cirl_marl.network import Floats, Network


class WindowSimulator:
    """The exact motion of one copy of a network under planned actions."""

    def __init__(self, dynamics: Dynamics, agents: tuple[str, ...]) -> None:
        """Compile what ``agents`` do, who act."""
        self._dynamics, self._supply = dynamics, Supply(dynamics)
        self._actuators = Actuators(dynamics.network, agents or None, 1)
        self._idle = self._supply.idle(self._actuators.agents)

    def run(self, stock: Floats, actions: Floats, first: int = 0) -> tuple[Floats, Floats]:
        """Return the stocks at the start and after each interval, and the mean flows in each.

        Args:
            stock: at the start, by stage, shape (rows,).
            actions: normalised, shape (intervals, entries).
            first: interval of the episode that they begin in.

        Returns:
            Stocks, shape (intervals + 1, rows), mass, and flows, of all and then of each substance, shape (intervals,
            components · arcs), mass/time.
        """
        dynamics, inner = self._dynamics, np.empty((0, 1))
        masses, stocks, flows = dynamics.extend(stock[:, None]), [stock], []
        for step, action in enumerate(actions, first):
            interval = np.array([step])
            controls = self._actuators.controls(action[:, None], interval)
            done = self._supply.advance(masses, inner, controls, interval, self._idle)[1]
            masses = done.stock
            stocks.append(masses[dynamics.rows.nodes, 0])
            mass = np.concatenate([done.moved_mass[:, 0], done.moved_substances[:, 0]])
            flows.append(mass / dynamics.network.episode.control_interval)
        return np.array(stocks), np.array(flows)


def service_measures(network: Network, dynamics: Dynamics) -> tuple[Floats, Floats]:
    """Return what each service measures, of a content the mass of its substance, and of a content the whole mass.

    Both read stocks by stage, mean flows and those of each substance, shape (services, stocks + components · arcs); a
    service that is no content has no whole.
    """
    rows, arcs, names = dynamics.rows, len(network.arcs), ["", *(substance.id for substance in network.substances)]
    part, whole = np.zeros((2, len(network.services), rows.nodes.stop + rows.components * arcs))
    for s, service in enumerate(network.services):
        number = names.index(service.substance)
        if service.quantity == "stock":
            for place in (network.node_index[node] for node in service.providers):
                stages = rows.stages.get(place, np.array([place]))
                part[s, stages.reshape(rows.components, -1)[number] if number else stages] = 1.0
                whole[s, stages] = 1.0
        else:
            columns = rows.nodes.stop + network.service_arcs(service)
            part[s, columns + number * arcs] = whole[s, columns] = 1.0
        if not number:
            whole[s] = 0.0
    return part, whole
