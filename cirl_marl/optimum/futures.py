"""What may become of a disturbed network from its present states on, in the intervals that plans are for.

The futures of all copies stand one after the other in one network, whose intervals they are: what takes the same time
for many intervals as for few is done once, and intervals that are alike have the same rows (``IntervalCache``).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.disturbances import Gaussian
from cirl_marl.network.series import in_intervals
from cirl_marl.network.uncertainty import draw_network, network_of_intervals
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.content_ranges import present_contents
from cirl_marl.optimum.window_planner import Future

SEED = 38
"""Of the noise of futures, the same in every episode."""
GRID = 32
"""Parts of the range of a Gaussian disturbance. What is to come of it is rounded to whole parts from its mean before
anything is known, unless services alone depend on it, whose bands are no reason for other rows."""
MOST_VARIABLES = 50_000
"""Variables of the largest program of several futures."""


class DrawnFutures:
    """The futures of copies of an environment: conditional means, or several that are drawn."""

    def __init__(
        self,
        env: MultiAgentVectorEnv,
        reference: Future,
        degree: int,
        service_weight: float | None,
        count: int | None,
        delay: int = 0,
        reserve: float = 1.0,
    ) -> None:
        """Prepare them.

        Args:
            env: whose copies they are of.
            reference: the episode in which all is as it is expected to be from the start.
            degree: of the test polynomials.
            service_weight: see ``Programs``.
            count: how many are drawn for each copy; None: one, of conditional means.
            delay: intervals by which the states are late from which means are conditional.
            reserve: by what the lower ends of services are multiplied after the first interval.
        """
        self._env, self._reference, self._count, self._delay = env, reference, count, delay
        self._reserve = reserve
        self._degree, self._weight = degree, service_weight
        network, processes = env.network, env.network.processes
        self._prior = processes.prior_means(network.episode.horizon)
        in_rows = {effect.by for place, effect in network.disturbed.items() if not place.startswith("services.")}
        parts = zip(processes.names, processes.disturbances, strict=True)
        self._rounded = [n for n, (name, part) in enumerate(parts) if name in in_rows and isinstance(part, Gaussian)]

    def of(self, copies: Sequence[int], intervals: range) -> list[list[Future]]:
        """Return the futures of some copies over intervals, at the start of whose first they are.

        Raises:
            CirlError: for a program of several futures that is too large.
        """
        self._check_size(intervals)
        processes, step, ahead = self._env.network.processes, intervals.start, len(intervals)
        states = self._env.physical.processes[step][:, list(copies)]
        if self._count is None:
            paths = self._means(copies, step, ahead)
        else:
            noise = np.tile(future_noise(step, ahead - 1, len(states), self._count), (1, 1, len(copies)))
            paths = processes.continuations(np.repeat(states, self._count, axis=1), step, noise).values
        paths = self._on_grid(paths, intervals)
        path = np.moveaxis(paths, 2, 0).reshape(-1, len(states))
        calendar = np.tile(np.arange(intervals.start, intervals.stop), paths.shape[2])
        stock = self._env.physical.stock[:, list(copies)]
        network = draw_network(network_of_intervals(self._network, calendar), (), path)
        future = self._future(self._with_reserve(network, calendar > intervals.start), stock)
        futures = [future.at(place, step) for place in range(0, len(path), ahead)]
        each = self._count or 1
        return [futures[first : first + each] for first in range(0, len(futures), each)]

    def _means(self, copies: Sequence[int], step: int, ahead: int) -> Floats:
        """Return what is expected from interval ``step`` on, given what is seen then, (ahead, names, copies)."""
        seen, processes = step - self._delay, self._env.network.processes
        if seen < 0:  # nothing
            return np.repeat(self._prior[step : step + ahead, :, None], len(copies), axis=2)
        states = self._env.physical.processes[seen][:, list(copies)]
        later = processes.conditional_means(states, seen, step + ahead - 1 - seen)
        return np.concatenate([processes.values(states, seen)[None], later])[self._delay :]

    @property
    def _network(self) -> Network:
        """The network, with substeps that do for all that may be."""
        dynamics, network = self._env.dynamics, self._env.network
        return network.with_options(episode={"solver_step": dynamics.substep}) if dynamics.substeps > 1 else network

    def _with_reserve(self, network: Network, is_later: NDArray[np.bool_]) -> Network:
        """Return a network that wants more of its services in later intervals, so that plans keep something back."""
        if self._reserve == 1.0:
            return network
        factor, length = np.where(is_later, self._reserve, 1.0), network.episode.control_interval
        lows = (in_intervals(network.interval_means(service.low) * factor, length) for service in network.services)
        services = tuple(replace(service, low=low) for service, low in zip(network.services, lows, strict=True))
        return network.variant(services=services)

    def _future(self, network: Network, stock: Floats) -> Future:
        """Return a course of the network from some stocks, shape (masses, B)."""
        present = present_contents(self._env.rows, stock) if network.substances else None
        admissible = Admissible.of(network, self._env.agents or None, present=present)
        return Future(admissible, self._degree, self._weight, self._reference)

    def _on_grid(self, paths: Floats, intervals: range) -> Floats:
        """Return paths over intervals, shape (intervals, names, futures), rounded after the first; see GRID."""
        processes, rows, paths = self._env.network.processes, self._rounded, paths.copy()
        low, high = processes.low[rows, None], processes.high[rows, None]
        mean = self._prior[intervals.start + 1 : intervals.stop, rows, None]
        part, later = (high - low) / GRID, paths[1:, rows]
        paths[1:, rows] = np.clip(mean + part * np.rint((later - mean) / part), low, high)
        return paths

    def _check_size(self, intervals: range) -> None:
        size = (self._count or 1) * len(intervals) * self._reference.layout.size
        if self._count is not None and size > MOST_VARIABLES:
            name, shape = self._env.network.name, f"{self._count} futures of {len(intervals)} intervals"
            raise CirlError(
                f"network '{name}': the program of {shape} has {size:,} variables, more than {MOST_VARIABLES:,}; take "
                "fewer futures or a shorter horizon"
            )


def future_noise(step: int, intervals: int, names: int, futures: int) -> Floats:
    """Return standard normal numbers for futures drawn in interval ``step``, shape (intervals, names, futures).

    The same in every episode, so that what is done follows from the state alone. Every second future has those of the
    one before with the other sign (antithetic variates).
    """
    half = np.random.default_rng([SEED, step]).standard_normal((intervals, names, (futures + 1) // 2))
    pairs = np.stack([half, -half], axis=3)
    return pairs.reshape(intervals, names, 2 * half.shape[2])[:, :, :futures]
