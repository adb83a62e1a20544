"""The mass of each substance in stocks, throughputs and flows, as observations and services measure it."""

from __future__ import annotations

import numpy as np

from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.network import Floats, Network


class SubstanceMasses:
    """Measures substances in the rows of ``Signals.substances``: of each in turn stocks, throughputs, then flows."""

    def __init__(self, network: Network, rows: StateLayout) -> None:
        """Measure those of ``network``; ``rows`` are of its masses."""
        self._network, self._rows, self._count = network, rows, len(network.substances)

    def __call__(self, masses: Floats, flow: Floats) -> Floats:
        """Return the masses, shape (substances · compartments, B).

        Args:
            masses: of the simulator, shape (masses, B).
            flow: mean flow of each substance, shape (substances · arcs, B), mass/time.
        """
        shape = (self._count, -1, masses.shape[1])
        if not self._count:
            return flow[:0]
        stocks, flows = (part.reshape(shape) for part in (self._rows.substances(masses), flow))
        through = self._network.throughput(np.moveaxis(flows, 0, 1)).swapaxes(0, 1)
        return np.concatenate([stocks, through, flows], axis=1).reshape(-1, shape[2])

    def pull_back(self, adjoint: Floats) -> tuple[Floats, Floats]:
        """Return derivatives by the masses of substances in stocks and by their flows, given those by what is measured.

        Shapes are (substances · stores, B) and (substances · arcs, B).
        """
        network, batch = self._network, adjoint.shape[1]
        stores, nodes = len(network.stores), len(network.nodes)
        parts = adjoint.reshape(self._count, nodes + len(network.arcs), batch)
        flows = parts[:, nodes:].copy()
        for part, flow in zip(parts, flows, strict=True):
            flow += network.throughput_adjoint(part[stores:nodes])
        return parts[:, :stores].reshape(-1, batch), flows.reshape(-1, batch)
