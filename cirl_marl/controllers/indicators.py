"""Indicators of material flow analysis beside λ: where what leaves use ends, and where what enters it was before.

In-use stocks are the nodes with a lifetime, or without any those whose stock is a service. What leaves them is followed
through all other nodes, each of which hands on what it gets in the proportions of the episode, until it is in use
again, lost (in a landfill, an incinerator or the environment), elsewhere (where nothing leaves), or kept in a store.
With P_ij = f_ij/max(inflow_i, outflow_i) of the mean flows f, the shares that end in each are (I − P)⁻¹ R; backwards,
of what enters use, the same with f transposed. T. E. Graedel et al. 2011, What do we know about metal recycling rates?,
Journal of Industrial Ecology 15(3), define the rates.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import spsolve

from cirl_marl.errors import instance_of
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Role

LOST = (Role.LANDFILL, Role.INCINERATOR, Role.ENVIRONMENT)


@positional_record
class Indicators:
    """What becomes of products; shares are of an episode."""

    recycling_rate: Annotated[float, "end-of-life recycling rate: part of what leaves use that is not lost"]
    recycled_content: Annotated[float, "part of what enters use that was in use before"]
    primary_content: Annotated[float, "part of what enters use that comes from reservoirs"]
    losses: Annotated[float, "what leaves use and is lost, mass/time"]

    def text(self, network: Network) -> str:
        """Say them in a line."""
        unit = f"{network.mass_unit}/{network.time_unit}"
        return (
            f"end-of-life recycling rate {self.recycling_rate:.1%}, recycled content {self.recycled_content:.1%}, "
            f"primary content {self.primary_content:.1%}, losses after use {self.losses:.4g} {unit}"
        )


def indicators(network: Network, flow: Annotated[Floats, "shape (arcs,), mass/time"]) -> Indicators | None:
    """Return the indicators of mean flows; None if nothing is in use, or nothing enters or leaves it."""
    use = _in_use(instance_of(Network, "network", network))
    count, roles = len(network.nodes), [node.role for node in network.nodes]
    flows = sparse.csr_array((flow, (network.donors, network.recipients)), shape=(count, count))
    lost = np.array([role in LOST for role in roles])
    primary = np.array([role is Role.NONRENEWABLE_RESERVOIR for role in roles])
    left, entered = float(flows[use].sum()), float(flows[:, use].sum())
    if left <= 0 or entered <= 0:
        return None
    ends = _shares(flows, use, [lost])
    origins = _shares(sparse.csr_array(flows.T), use, [use, primary])
    return Indicators(1.0 - float(ends[0]), float(origins[0]), float(origins[1]), float(ends[0]) * left)


def _in_use(network: Network) -> NDArray[np.bool_]:
    """Return whether each node is in use, shape (nodes,)."""
    lifetimes = np.array([node.lifetime is not None for node in network.nodes])
    if lifetimes.any():
        return lifetimes
    served = np.zeros(len(network.nodes), dtype=bool)
    for service in network.services:
        if service.quantity == "stock":
            providers = (service.provider, *service.also)
            served[[network.node_index[each] for each in providers if each in network.node_index]] = True
    return served


def _shares(flows: sparse.csr_array, use: NDArray[np.bool_], ends: list[NDArray[np.bool_]]) -> Floats:
    """Return the part of what leaves use that arrives in each group of ends, shape (groups,)."""
    inflow, outflow = np.asarray(flows.sum(axis=0)), np.asarray(flows.sum(axis=1))
    passing = ~use & (outflow > 0) & (inflow > 0) & ~np.any(ends, axis=0)
    through = sparse.diags_array(1.0 / np.maximum(inflow, outflow)[passing]) @ flows[passing]
    arriving = np.stack([np.asarray(through[:, end].sum(axis=1)) for end in ends], axis=1)
    system = sparse.eye_array(int(passing.sum())) - through[:, passing]
    absorbed = spsolve(sparse.csc_array(system), arriving).reshape(arriving.shape) if passing.any() else arriving
    first = np.asarray(flows[use].sum(axis=0))
    direct = np.array([first[end].sum() for end in ends])
    found: Floats = (direct + first[passing] @ absorbed) / first.sum()
    return found
