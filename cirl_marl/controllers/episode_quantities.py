"""The quantities of an episode, listed once: names, units, and where a rollout has their values.

Tables, files, pictures and comparisons of episodes take from here which there are, in which order, and what they are
called.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, Literal

import numpy as np

from cirl_marl.controllers.rollout import Rollout, interval_ends
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record

QuantityKind = Literal["circularity", "service", "account", "stock", "flow", "disturbance", "content"]


def _by_member(values: Floats) -> Floats:
    """Return values of one copy or of several, shape ([copies,] steps, members), as (copies, members, steps)."""
    return (values if values.ndim == 3 else values[None]).swapaxes(1, 2)


VALUES: Mapping[QuantityKind, Callable[[Rollout], Floats]] = {
    "circularity": lambda run: run.circularity_mean[:, None],
    "service": lambda run: run.levels,
    "account": lambda run: run.bookings,
    "stock": lambda run: _by_member(run.stock),
    "flow": lambda run: _by_member(run.flow),
    "disturbance": lambda run: _by_member(run.disturbances),
    "content": lambda run: _by_member(run.contents.reshape(len(run.contents), -1)),
}
"""The quantities of each kind in each interval, shape (copies, members, steps), of all copies or of the first."""

TOTALS: Mapping[QuantityKind, Callable[[Rollout], Floats]] = {
    "circularity": lambda run: run.episode_circularity[:, None],
    "service": lambda run: run.episode_levels,
    "account": lambda run: run.accounts,
    "stock": lambda run: run.final_stock[None],
    "flow": lambda run: run.mean_flow[None],
}
"""What they come to over an episode, shape (copies, members): means of λ and of levels, discounted amounts, and, as
means over the copies, stocks at the end and mean flows."""


@positional_record
class EpisodeQuantity:
    """A number that an episode has in each interval: a mean or sum over it, of stocks and contents that at its end."""

    kind: Annotated[QuantityKind, "what it is of"]
    place: Annotated[int, "among those of its kind"]
    of: Annotated[str, "id of the service, account, node, arc, disturbance or compartment; empty of λ"]
    name: Annotated[str, "what it is called"]
    unit: Annotated[str, "of its values; that of a flow is mass/time"]
    substance: Annotated[str, "whose content it is"] = ""

    @property
    def heading(self) -> str:
        """Name and unit, as columns of tables have them."""
        return f"{self.name} ({self.unit})"

    @property
    def total_name(self) -> str:
        """What λ̄, or else the mean or total over an episode is called."""
        return self.name if self.of else "λ̄"

    def values(self, run: Rollout) -> Floats:
        """Return the values in each interval, shape (copies, steps), of all copies of a rollout or of the first."""
        return VALUES[self.kind](run)[:, self.place]

    def totals(self, run: Rollout) -> Floats:
        """Return what it comes to over an episode, shape (copies,); see ``TOTALS``."""
        return TOTALS[self.kind](run)[:, self.place]

    def points(self, network: Network, run: Rollout) -> tuple[Floats, Floats]:
        """Return times and values of the first copy, (points,) each: stocks at start and ends, others mid-interval."""
        ends, values = interval_ends(network), self.values(run)[0]
        if self.kind == "stock":
            return np.append(0.0, ends), np.append(run.start[self.place], values)
        return ends - network.episode.control_interval / 2, values


def episode_quantities(network: Network, *kinds: QuantityKind) -> list[EpisodeQuantity]:
    """Return the quantities of episodes of a network, kind by kind; those of all kinds if none is named."""
    mass, flow = network.mass_unit, f"{network.mass_unit}/{network.time_unit}"
    processes = zip(network.processes.names, network.processes.disturbances, strict=True)
    members: dict[QuantityKind, Iterator[tuple[str, ...]]] = {
        "circularity": iter([("", "mean circularity", mass)]),
        "service": ((service.id, f"level of {service.id}", "1") for service in network.services),
        "account": ((account.id, account.id, account.unit) for account in network.accounts),
        "stock": ((node.id, f"stock of {node.id}", mass) for node in network.stores),
        "flow": ((arc.id, f"flow of {arc.id}", flow) for arc in network.arcs),
        "disturbance": ((name, f"disturbance {name}", process.unit) for name, process in processes),
        "content": (
            (id_, f"{substance.id} in {id_}", "1", substance.id)
            for substance in network.substances
            for id_ in network.compartments
        ),
    }
    return [
        EpisodeQuantity(kind, place, *about) for kind in kinds or members for place, about in enumerate(members[kind])
    ]
