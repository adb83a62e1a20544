"""Some intervals of one copy of a network under planned actions, and what its services read off them."""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.supply import Supply
from cirl_marl.environments.actuators import Actuators
from cirl_marl.network import Floats, Network


class WindowSimulator:
    """The exact motion of one copy of a network under planned actions.

    Attributes:
        dynamics: of the network.
    """

    def __init__(self, network: Network, agents: tuple[str, ...]) -> None:
        """Compile the network for ``agents``, who act."""
        self.dynamics = Dynamics(network)
        self._actuators, self._supply = Actuators(network, agents or None, 1), Supply(self.dynamics)
        self._idle = self._supply.idle(self._actuators.agents)

    def run(self, stock: Floats, actions: Floats, first: int = 0) -> tuple[Floats, Floats]:
        """Return the stocks at the start and after each interval, and the mean flows in each.

        Args:
            stock: at the start, by stage, shape (rows,).
            actions: normalised, shape (intervals, entries).
            first: interval of the episode that they begin in.

        Returns:
            Stocks, shape (intervals + 1, rows), mass, and flows, shape (intervals, arcs), mass/time.
        """
        dynamics, inner = self.dynamics, np.empty((0, 1))
        masses, stocks, flows = dynamics.extend(stock[:, None]), [stock], []
        for step, action in enumerate(actions, first):
            interval = np.array([step])
            controls = self._actuators.controls(action[:, None], interval)
            done = self._supply.advance(masses, inner, controls, interval, self._idle)[1]
            masses = done.stock
            stocks.append(masses[dynamics.rows.nodes, 0])
            flows.append(done.moved_mass[:, 0] / dynamics.network.episode.control_interval)
        return np.array(stocks), np.array(flows)


def service_measures(network: Network, dynamics: Dynamics) -> Floats:
    """Return what each service reads off stocks and mean flows, shape (services, stocks + arcs)."""
    nodes = dynamics.rows.nodes.stop
    measure = np.zeros((len(network.services), nodes + len(network.arcs)))
    for s, service in enumerate(network.services):
        if service.quantity == "stock":
            for place in (network.node_index[node] for node in service.providers):
                measure[s, dynamics.rows.stages.get(place, place)] = 1.0
        else:
            measure[s, nodes + network.service_arcs(service)] = 1.0
    return measure
