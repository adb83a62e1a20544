"""The disturbances of a network at work: paths from random streams, their values, and what is to be expected."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated

import numpy as np
from scipy import special

from cirl_marl.network.declarations import positional_record
from cirl_marl.network.disturbances import BlockBootstrap, Disturbance, Gaussian, Markov
from cirl_marl.network.rowsum import Floats, Integers, RowSum
from cirl_marl.network.specification import Specification

STREAM = 1
"""Which child of a seed's sequence drives disturbances; starts are drawn from the seed itself."""


def disturbance_stream(seed: int | None) -> np.random.Generator:
    """Return the random stream of the disturbances of a copy with a seed; None: from the operating system."""
    return np.random.default_rng(np.random.SeedSequence(seed, spawn_key=(STREAM,)))


def interval_of(paths: Floats, step: Integers) -> Floats:
    """Return what paths, shape (intervals, names, B), are in an interval of each copy, shape (names, B)."""
    if not len(paths):
        return np.empty((0, len(step)))
    first = step.item(0)
    if (step == first).all():  # as it is, but for copies that were put together
        same: Floats = paths[first]
        return same
    return np.ascontiguousarray(paths[step, :, np.arange(len(step))].T)


def no_paths() -> Floats:
    """Return the paths of no disturbances, in as many copies as there may be."""
    return np.empty((0, 0, 1))


@positional_record
class Paths:
    """What disturbances were in episodes, from interval 0 up to the one after the last."""

    states: Annotated[Floats, "states of the processes, shape (steps + 1, names, B): latent value, regime or place"]
    values: Annotated[Floats, "ξ, likewise"]


class DisturbanceProcesses:
    """The disturbances that disturb something, in the order in which they are declared.

    Arrays have a row for each of ``names`` and a column for each copy. The state of a process is a number: z_t of a
    Gaussian one, else the regime, or the place in the record, counted from zero. All that can be known of the values to
    come follows from the states and the index of the interval.

    Attributes:
        names: of these disturbances.
        disturbances: they themselves.
        low: lowest value of each, shape (names,).
        high: highest value.
        state_names: what the state of each is.
    """

    def __init__(self, network: Specification) -> None:
        """Compile those of ``network``."""
        active = {disturbed.by for disturbed in network.disturbed.values()}
        self.names = tuple(name for name in network.disturbances if name in active)
        self.disturbances: tuple[Disturbance, ...] = tuple(network.disturbances[name] for name in self.names)
        self._steps = network.episode.horizon + 1
        ends = np.array([disturbance.ends for disturbance in self.disturbances]).reshape(-1, 2)
        self.low, self.high = ends[:, 0], ends[:, 1]
        kinds = [
            "latent" if isinstance(part, Gaussian) else "regime" if isinstance(part, Markov) else "place"
            for part in self.disturbances
        ]
        self.state_names = tuple(f"{name}.{word}" for name, word in zip(self.names, kinds, strict=True))
        gaussian = {n: part for n, part in enumerate(self.disturbances) if isinstance(part, Gaussian)}
        self._rows: Integers = np.array([*gaussian], dtype=np.intp)
        self._memory, self._innovation = np.array([p.memory for p in gaussian.values()]).reshape(-1, 2).T[..., None]
        self._start, start_deviation = np.array([p.first for p in gaussian.values()]).reshape(-1, 2).T[..., None]
        self._deviation = np.array([[p.deviation] for p in gaussian.values()]).reshape(-1, 1)
        self._is_log = np.array([p.logarithm for p in gaussian.values()], dtype=bool)
        self._interval, self._gaussian = network.episode.control_interval, tuple(gaussian.values())
        self._offsets = np.empty((0, len(gaussian), 1))
        correlation = np.eye(len(gaussian))
        if network.correlation is not None:
            place = {self.names[n]: i for i, n in enumerate(gaussian)}
            known = [(place[name], j) for j, name in enumerate(network.correlation.names) if name in place]
            for i, k in known:
                for j, m in known:
                    correlation[i, j] = network.correlation.matrix[k][m]
        self._mix = _root(correlation)
        # of what has always gone on, cov(z_i, z_j) = C_ij s_i s_j / (1 − φ_i φ_j); what starts somewhere has none
        memory, noise = self._memory[:, 0], self._innovation[:, 0] * (start_deviation[:, 0] > 0)
        decay = 1.0 - np.outer(memory, memory)
        covariance = np.divide(
            correlation * np.outer(noise, noise), decay, out=np.zeros_like(correlation), where=decay > 0
        )
        self._start_mix, self._start_variance = _root(covariance), np.diag(covariance)[:, None].copy()
        self._others = [
            (n, _Chain(part) if isinstance(part, Markov) else _Record(part))
            for n, part in enumerate(self.disturbances)
            if isinstance(part, Markov | BlockBootstrap)
        ]

    def sample(self, seeds: Iterable[int]) -> Paths:
        """Return the paths that copies of an environment with these seeds meet in their first episode."""
        return self.paths([disturbance_stream(seed) for seed in seeds])

    def paths(self, streams: Sequence[np.random.Generator]) -> Paths:
        """Draw the paths of an episode in copies that have a stream each, and nothing else from it."""
        steps, count = self._steps, len(self.names)
        if not count:
            return Paths(no_paths(), no_paths())
        drawn = np.empty((len(streams), steps, count))
        for row, stream in zip(drawn, streams, strict=True):
            stream.standard_normal(out=row)
        noise = np.ascontiguousarray(drawn.transpose(1, 2, 0))
        states = np.empty_like(noise)
        if len(self._rows):
            states[0, self._rows] = self._start + self._start_mix(noise[0, self._rows])
        for n, process in self._others:
            states[0, n] = process.first(noise[0, n])
        return self._go_on_from(states, noise, 0)

    def continuations(self, states: Floats, step: int, noise: Floats) -> Paths:
        """Return what may follow on some states, the first of the paths.

        Args:
            states: of the processes in interval ``step``, shape (names, B).
            step: the interval.
            noise: independent standard normal numbers of the intervals after it, shape (ahead, names, B).
        """
        paths, noise = np.empty((len(noise) + 1, *states.shape)), np.concatenate([np.zeros_like(states)[None], noise])
        paths[0] = states
        return self._go_on_from(paths, noise, step)

    def _go_on_from(self, states: Floats, noise: Floats, step: int) -> Paths:
        """Fill in the states after the first, shape (steps, names, B), which follow from the ``noise`` of each."""
        steps = len(states)
        if len(self._rows):
            latent = states[0, self._rows]
            for t in range(1, steps):
                latent = self._memory * latent + self._innovation * self._mix(noise[t, self._rows])
                states[t, self._rows] = latent
        for n, process in self._others:
            process.follow(noise[:, n], states[:, n])
        return Paths(states, self._values(states, self._offset_table(step + steps)[step:]))

    def values(self, states: Floats, step: int) -> Floats:
        """Return ξ of an interval whose states are these, shape (names, B)."""
        values: Floats = self._values(states[None], self._offset_table(step + 1)[step:])[0]
        return values

    def _values(self, states: Floats, offsets: Floats) -> Floats:
        """Return the values of states, shape (steps, names, B); ``offsets`` are a_t, (steps, Gaussian processes, 1)."""
        values = np.empty_like(states)
        for i, n in enumerate(self._rows):
            latent = states[:, n].copy()
            latent *= self._deviation[i]
            latent += offsets[:, i]
            if self._is_log[i]:
                np.exp(latent, out=latent)
            values[:, n] = np.clip(latent, self.low[n], self.high[n], out=latent)
        for n, process in self._others:
            values[:, n] = process.values.take(states[:, n].astype(np.intp))
        return values

    def conditional_means(self, states: Floats, step: int, ahead: int) -> Floats:
        """Return E[ξ_{t+k} | F_t] for k = 1 … ``ahead``, exactly, shape (ahead, names, B).

        Args:
            states: of the processes in interval t, shape (names, B), which is all of F_t that matters.
            step: t.
            ahead: how many intervals ahead.
        """
        means = np.empty((ahead, *states.shape))
        latent, variance = states[self._rows], np.zeros((len(self._rows), 1))
        for k in range(1, ahead + 1):
            latent, variance = self._go_on(latent, variance)
            means[k - 1, self._rows] = self._gaussian_means(latent, variance, step + k)
        for n, process in self._others:
            places = states[n].astype(np.intp)
            for k, table in enumerate(process.expectations(ahead)[1:]):
                means[k, n] = table[places]
        return means

    def prior_means(self, steps: int) -> Floats:
        """Return E[ξ_t] for t = 0 … ``steps`` − 1 before anything is known, exactly, shape (steps, names)."""
        means = np.empty((steps, len(self.names), 1))
        latent, variance = self._start, self._start_variance
        for t in range(steps):
            means[t, self._rows] = self._gaussian_means(latent, variance, t)
            latent, variance = self._go_on(latent, variance)
        for n, process in self._others:
            means[:, n, 0] = [process.first_shares @ table for table in process.expectations(steps - 1)]
        return means[..., 0]

    def _go_on(self, latent: Floats, variance: Floats) -> tuple[Floats, Floats]:
        """Return mean and variance of z an interval later."""
        return self._memory * latent, self._memory**2 * variance + self._innovation**2

    def _gaussian_means(self, latent: Floats, variance: Floats, step: int) -> Floats:
        """Return the means of the values of Gaussian processes whose z has these means and variances."""
        if not len(self._rows):
            return latent
        middle = self._offset_table(step + 1)[step] + self._deviation * latent
        deviation = self._deviation * np.sqrt(variance)
        bounds = self.low[self._rows, None], self.high[self._rows, None]
        means = np.empty(middle.shape)
        for is_log in (False, True):
            rows = self._is_log == is_log
            of = (np.broadcast_to(table, middle.shape)[rows] for table in (middle, deviation, *bounds))
            means[rows] = _clipped_means(*of, is_log=is_log)
        return means

    def _offset_table(self, steps: int) -> Floats:
        """Return a_t of the first intervals, shape (steps, Gaussian processes, 1)."""
        if steps > len(self._offsets):
            offsets = [part.offsets(2 * steps, self._interval) for part in self._gaussian]
            self._offsets = np.array(offsets).reshape(len(offsets), 2 * steps).T[..., None]
        return self._offsets[:steps]


class _Chain:
    def __init__(self, chain: Markov) -> None:
        self.values, self._matrix = np.array(chain.values), chain.transitions
        shares = chain.stationary
        self.first_shares = shares if chain.start is None else np.eye(len(shares))[chain.start - 1]
        # a normal draw leads past so many of the others as its quantile is beyond their probabilities together
        self._bounds, self._first_bounds = (_normal_bounds(table) for table in (self._matrix, self.first_shares))

    def first(self, noise: Floats) -> Floats:
        """Return the regimes in which standard normal draws begin, shape (B,)."""
        return np.asarray((noise >= self._first_bounds[:, None]).sum(axis=0), dtype=float)

    def follow(self, noise: Floats, states: Floats) -> None:
        """Write the regimes after the first that standard normal draws give, shape (steps, B) both."""
        steps, copies = noise.shape
        # where each regime would go, shape (steps, regimes, B)
        ways = np.zeros((steps, len(self.values), copies), dtype=np.intp)
        for i, bounds in enumerate(self._bounds):
            for bound in bounds:
                ways[:, i] += noise >= bound
        regime, column = states[0].astype(np.intp), np.arange(copies)
        for t in range(1, steps):
            regime = ways[t].take(regime * copies + column)
            states[t] = regime

    def expectations(self, ahead: int) -> list[Floats]:
        """Return P^k·values for k = 0 … ``ahead``, shape (regimes,) each."""
        tables = [self.values]
        for _ in range(ahead):
            tables.append(self._matrix @ tables[-1])
        return tables


class _Record:
    """A record of which blocks are drawn."""

    def __init__(self, record: BlockBootstrap) -> None:
        self.values, self._leave = np.array(record.values), 1.0 / record.block
        self.first_shares = np.full(len(self.values), 1.0 / len(self.values))

    def first(self, noise: Floats) -> Floats:
        """Return the places at which standard normal draws begin, shape (B,)."""
        size = len(self.values)
        return np.asarray(np.minimum(np.floor(special.ndtr(noise) * size), size - 1))

    def follow(self, noise: Floats, states: Floats) -> None:
        """Write the places after the first that standard normal draws give, shape (steps, B) both."""
        size, chance = len(self.values), special.ndtr(noise)
        # below 1/block a draw begins a block, and says where
        begins, scaled = chance < self._leave, chance * (size / self._leave)
        for t in range(1, len(chance)):
            place = np.minimum(np.floor(scaled[t]), size - 1)
            states[t] = np.where(begins[t], place, (states[t - 1] + 1) % size)

    def expectations(self, ahead: int) -> list[Floats]:
        """Return E[ξ_{t+k}] by the place in t, for k = 0 … ``ahead``, shape (places,) each."""
        stays, mean = 1.0 - self._leave, self.values.mean()
        return [stays**k * np.roll(self.values, -k) + (1.0 - stays**k) * mean for k in range(ahead + 1)]


def _normal_bounds(shares: Floats) -> Floats:
    """Return the standard normal quantiles of sums of all shares but the last, along the last axis."""
    sums = np.minimum(shares.cumsum(axis=-1)[..., :-1], 1.0)  # they may round to more than 1
    return np.asarray(special.ndtri(sums))


def _clipped_means(middle: Floats, deviation: Floats, low: Floats, high: Floats, *, is_log: bool) -> Floats:
    """Return E[clip(y, low, high)], or E[clip(e^y, low, high)], of normal y, in closed form; all of one shape."""
    with np.errstate(divide="ignore", invalid="ignore"):
        # a bound of a logarithm may be 0 or less, which clips nothing
        ends = [np.log(np.maximum(end, 0.0)) if is_log else end for end in (low, high)]
        first, last = ((end - middle) / deviation for end in ends)
        below, above = special.ndtr(first), special.ndtr(-last)
        if is_log:
            within = np.exp(middle + deviation**2 / 2) * _between(first - deviation, last - deviation)
        else:
            start, stop = (np.exp(-(end**2) / 2) / np.sqrt(2 * np.pi) for end in (first, last))
            within = middle * _between(first, last) + deviation * (start - stop)
        means = low * below + high * above + within
        certain = np.clip(np.exp(middle) if is_log else middle, low, high)
    return np.asarray(np.where(deviation > 0, np.clip(means, low, high), certain))


def _between(first: Floats, last: Floats) -> Floats:
    """Return the probability of a standard normal number between two, from the tail in which it is not lost."""
    upper = first > 0
    return np.asarray(special.ndtr(np.where(upper, -first, last)) - special.ndtr(np.where(upper, -last, first)))


def _root(covariance: Floats) -> RowSum:
    """Return the lower triangular L with L Lᵀ = ``covariance``, which may be singular (Cholesky)."""
    size = len(covariance)
    root = np.zeros((size, size))
    for j in range(size):
        rest = covariance[j:, j] - root[j:, :j] @ root[j, :j]
        if rest[0] > 1e-12 * covariance[j, j]:
            root[j:, j] = rest / np.sqrt(rest[0])
    rows, columns = np.nonzero(root)
    return RowSum(rows, columns, root[rows, columns], (size, size))
