"""Disturbances: processes in time that nobody foresees and no action changes, by which quantities are disturbed.

The value ξ_t holds in control interval t. It is drawn at its start, from the *state* of its process alone: the latent
value of a Gaussian process, the regime of a chain, the place in a record. Every process is bounded: of Gaussian ones
what comes out is clipped, never what goes on, so that their moments and conditional means have closed forms.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any

import numpy as np
from scipy.sparse import csgraph

from cirl_marl.errors import unknown_name, unknown_names
from cirl_marl.network.declarations import (
    CheckedRecord,
    Declaration,
    Numbers,
    Positive,
    Quantity,
    Word,
    bound_problems,
    frozen_record,
)
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.specification import Specification

WIDE = 4.0
"""Deviations from its mean at which a Gaussian process is clipped that states no bounds."""
OBSERVED = ("now", "none")
FURTHEST = 1000
"""Most intervals of a delay, or of a forecast."""
ROUND_OFF = 1e-9
"""Distance from 1 of sums of probabilities, and from 0 of eigenvalues, that counts as rounding."""


def _number(meaning: str, **options: Any) -> Quantity:
    """Declare a number in the unit of the disturbance, which is converted where it disturbs something."""
    return Quantity(meaning, of="own", unit_of_table=True, **options)


@frozen_record
class Disturbance(CheckedRecord):
    """What all kinds have in common: their unit, and who sees them."""

    unit: Annotated[str, Declaration("unit of its values; '1' of a factor")] = "1"
    observed: Annotated[
        str, Word("``now``: agents see the value of the coming interval; ``none``: it is hidden", of=OBSERVED)
    ] = "now"
    delayed: Annotated[int, Declaration("how many intervals ago the value was that agents see")] = 0
    forecast: Annotated[int, Declaration("of how many further intervals agents see the conditional means")] = 0
    observed_by: Annotated[tuple[str, ...], Declaration("who sees it; empty means all agents")] = ()
    common: Annotated[
        bool, Declaration("in a definition that is copied, whether all copies share it; else each has one of its own")
    ] = False

    @property
    def kind(self) -> str:
        """What definition files call its kind."""
        return next(kind for kind, record in KINDS.items() if type(self) is record)

    @property
    def ends(self) -> tuple[float, float]:
        """Lowest and highest value."""
        raise NotImplementedError

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with its numbers, which lie in their bounds."""
        yield from ()


@frozen_record
class Gaussian(Disturbance):
    """A process y_t = a_t + b·z_t of a latent Gaussian z_t; its value is y_t, or e^(y_t), clipped to its bounds.

    z_{t+1} = φ z_t + s ε_t with independent standard normal ε_t.
    """

    deviation: Annotated[
        float, _number("b, standard deviation of y, in the unit or, of a logarithm, relative", positive=True)
    ]
    logarithm: Annotated[bool, Declaration("whether y is the logarithm of the value")] = False
    low: Annotated[float | None, _number("lowest value; None: four deviations below the mean")] = None
    high: Annotated[float | None, _number("highest value; None: four deviations above the mean")] = None

    @property
    def memory(self) -> tuple[float, float]:
        """Return φ and s."""
        raise NotImplementedError

    @property
    def first(self) -> tuple[float, float]:
        """Mean and standard deviation of z_0."""
        return 0.0, 1.0

    def offsets(self, steps: int, interval: float) -> Floats:
        """Return a_t at the start of intervals of some length, shape (steps,)."""
        raise NotImplementedError

    def _ends(self, lowest: float, highest: float) -> tuple[float, float]:
        """Return the bounds, those that are not stated from the lowest and the highest a_t."""
        ends = (lowest - WIDE * self.deviation, highest + WIDE * self.deviation)
        least, most = map(math.exp, ends) if self.logarithm else ends
        return (least if self.low is None else self.low, most if self.high is None else self.high)

    def problems(self) -> Iterator[str]:
        """See ``Disturbance.problems``."""
        low, high = self.ends
        if not low < high:
            yield f"low {low:g} must lie below high {high:g}"
        elif self.logarithm and high <= 0:
            yield f"high {high:g}: a logarithm has positive values only"


@frozen_record
class AutoRegression(Gaussian):
    """Mean reversion: y_t has a mean and a standard deviation, and forgets what it was, a share 1 − φ an interval."""

    mean: Annotated[float, _number("mean of the value, before it is clipped")] = 1.0
    persistence: Annotated[
        float, _number("φ, correlation of y in successive control intervals, below 1 in size", low=-1.0, high=1.0)
    ]
    start: Annotated[float | None, _number("value of the first interval; None: drawn as at any other time")] = None

    @property
    def memory(self) -> tuple[float, float]:
        """See ``Gaussian.memory``."""
        return self.persistence, math.sqrt(1.0 - self.persistence**2)

    @property
    def first(self) -> tuple[float, float]:
        """See ``Gaussian.first``."""
        if self.start is None:
            return 0.0, 1.0
        start = math.log(self.start) if self.logarithm else self.start
        return (start - self._middle) / self.deviation, 0.0

    @property
    def _middle(self) -> float:
        return math.log(self.mean) - self.deviation**2 / 2 if self.logarithm else self.mean

    def offsets(self, steps: int, interval: float) -> Floats:
        """See ``Gaussian.offsets``."""
        return np.full(steps, self._middle)

    @property
    def ends(self) -> tuple[float, float]:
        """See ``Disturbance.ends``."""
        return self._ends(self._middle, self._middle)

    def problems(self) -> Iterator[str]:
        """See ``Disturbance.problems``."""
        if abs(self.persistence) >= 1:
            yield f"persistence {self.persistence:g} must lie between -1 and 1; random_walk forgets nothing"
        elif self.logarithm and min(self.mean, self.mean if self.start is None else self.start) <= 0:
            yield "mean and start of a logarithm must be positive"
        else:
            yield from Gaussian.problems(self)


@frozen_record
class RandomWalk(Gaussian):
    """A walk from a known start: y_t has independent steps; at its bounds the value stays while the walk is beyond."""

    start: Annotated[float, _number("value of the first interval")] = 1.0
    drift: Annotated[float, _number("mean of a step of y; its standard deviation is ``deviation``")] = 0.0
    low: Annotated[float, _number("lowest value")]
    high: Annotated[float, _number("highest value")]

    @property
    def memory(self) -> tuple[float, float]:
        """See ``Gaussian.memory``."""
        return 1.0, 1.0

    @property
    def first(self) -> tuple[float, float]:
        """See ``Gaussian.first``."""
        return 0.0, 0.0

    def offsets(self, steps: int, interval: float) -> Floats:
        """See ``Gaussian.offsets``."""
        start = math.log(self.start) if self.logarithm else self.start
        return np.asarray(start + self.drift * np.arange(steps))

    @property
    def ends(self) -> tuple[float, float]:
        """See ``Disturbance.ends``."""
        return self.low, self.high

    def problems(self) -> Iterator[str]:
        """See ``Disturbance.problems``."""
        yield from Gaussian.problems(self)
        if not self.low <= self.start <= self.high or (self.logarithm and self.start <= 0):
            yield f"start {self.start:g} must lie in [{self.low:g}, {self.high:g}], of a logarithm above 0"


@frozen_record
class Seasonal(Gaussian):
    """A season that comes again, with noise that reverts to it: added, or of a logarithm as a factor of mean 1."""

    profile: Annotated[
        tuple[float, ...],
        Numbers(
            "values in equal parts of the period, from the start of the episode on",
            "(value, …)",
            table_form="list",
        ),
    ]
    period: Annotated[float, Positive("time after which the season comes again", of="time")]
    persistence: Annotated[float, _number("φ of the noise, as of ``ar1``", low=-1.0, high=1.0)] = 0.0

    @property
    def memory(self) -> tuple[float, float]:
        """See ``Gaussian.memory``."""
        return self.persistence, math.sqrt(1.0 - self.persistence**2)

    def offsets(self, steps: int, interval: float) -> Floats:
        """See ``Gaussian.offsets``; a season is its mean over each interval."""
        edges = np.arange(steps + 1) * (interval / self.period * len(self.profile))
        # integral of the profile, repeated for ever, up to each edge
        total = np.concatenate([[0.0], np.cumsum(self.profile)])
        rounds, parts = np.divmod(edges, len(self.profile))
        integral = rounds * total[-1] + np.interp(parts, np.arange(len(total)), total)
        season: Floats = np.diff(integral) / np.diff(edges)
        return np.asarray(np.log(season) - self.deviation**2 / 2) if self.logarithm else season

    @property
    def ends(self) -> tuple[float, float]:
        """See ``Disturbance.ends``."""
        ends = min(self.profile), max(self.profile)
        if self.logarithm:
            ends = (math.log(ends[0]) - self.deviation**2 / 2, math.log(ends[1]) - self.deviation**2 / 2)
        return self._ends(*ends)

    def problems(self) -> Iterator[str]:
        """See ``Disturbance.problems``."""
        if not self.profile:
            yield "profile: needs at least one value"
        elif abs(self.persistence) >= 1:
            yield f"persistence {self.persistence:g} must lie between -1 and 1"
        elif self.logarithm and min(self.profile) <= 0:
            yield f"profile: {min(self.profile):g}: of a logarithm all values are positive"
        else:
            yield from Gaussian.problems(self)


@frozen_record
class Markov(Disturbance):
    """A chain of regimes, each with a value, such as a plant that runs or stands still."""

    values: Annotated[tuple[float, ...], Numbers("value in each regime", "(value, …)", table_form="list")]
    matrix: Annotated[
        tuple[tuple[float, ...], ...],
        Numbers(
            "a row for each regime: probabilities of the regimes of the next interval",
            "((probability, …), …)",
            (None, None),
            table_form="matrix",
        ),
    ] = ()
    lengths: Annotated[
        tuple[float, ...],
        Numbers(
            "instead: mean number of intervals for which each regime lasts; all others are then as probable",
            "(intervals, …)",
            table_form="list",
        ),
    ] = ()
    start: Annotated[
        int | None, Declaration("regime of the first interval, counted from one; None: drawn as at any other time")
    ] = None

    @property
    def transitions(self) -> Floats:
        """P, shape (regimes, regimes): probability of each regime after each."""
        if self.matrix:
            return np.array(self.matrix)
        leave, regimes = 1.0 / np.array(self.lengths), len(self.lengths)
        matrix = np.tile((leave / (regimes - 1))[:, None], regimes)
        np.fill_diagonal(matrix, 1.0 - leave)
        return matrix

    @property
    def stationary(self) -> Floats:
        """π = π P, shape (regimes,)."""
        regimes = len(self.values)
        equations = np.vstack([self.transitions.T - np.eye(regimes), np.ones(regimes)])
        solution: Floats = np.linalg.lstsq(equations, np.append(np.zeros(regimes), 1.0), rcond=None)[0]
        return np.clip(solution, 0.0, 1.0)

    @property
    def ends(self) -> tuple[float, float]:
        """See ``Disturbance.ends``."""
        return min(self.values), max(self.values)

    def problems(self) -> Iterator[str]:
        """See ``Disturbance.problems``."""
        regimes = len(self.values)
        if regimes < 2:
            yield f"values: a chain has at least two regimes, got {regimes}"
        elif bool(self.matrix) == bool(self.lengths):
            yield "give either the matrix or the lengths of its regimes"
        elif self.matrix and {len(self.matrix), *map(len, self.matrix)} != {regimes}:
            yield f"matrix: needs {regimes} rows of {regimes} probabilities, as there are {regimes} values"
        elif self.lengths and not (len(self.lengths) == regimes and all(1 <= n < math.inf for n in self.lengths)):
            yield f"lengths: needs {regimes} numbers of intervals, at least 1 each, got {list(self.lengths)}"
        elif self.start is not None and not 1 <= self.start <= regimes:
            yield f"start {self.start}: must be one of the regimes 1 to {regimes}"
        else:
            yield from self._chain_problems()

    def _chain_problems(self) -> Iterator[str]:
        matrix = self.transitions
        for i, row in enumerate(matrix, 1):
            if (row < 0).any() or abs(row.sum() - 1.0) > ROUND_OFF:
                yield f"matrix, row {i}: probabilities are not negative and sum to 1, got {row.tolist()}"
                return
        count, of = csgraph.connected_components(matrix > 0, connection="strong")
        if count > 1:
            leaves = [(matrix[of == part] > 0)[:, of != part].any() for part in range(count)]
            final = np.flatnonzero(of == leaves.index(False)) + 1
            others = np.flatnonzero(of != leaves.index(False)) + 1
            yield f"matrix: a chain in regime {final[0]} never returns to regime {others[0]}; let it, if rarely"


@frozen_record
class BlockBootstrap(Disturbance):
    """Blocks of a record, which begin anywhere in it, of random length: the stationary bootstrap.

    With probability 1/block the next value begins a block, at a place drawn evenly; else it is the next of the record,
    which begins again after its end.

    References: Politis and Romano 1994, The Stationary Bootstrap.
    """

    values: Annotated[
        tuple[float, ...],
        Numbers("the record, a value for each control interval", "(value, …)", table_form="record"),
    ]
    block: Annotated[float, _number("mean number of intervals of a block", low=1.0)]

    @property
    def ends(self) -> tuple[float, float]:
        """See ``Disturbance.ends``."""
        return min(self.values), max(self.values)

    def problems(self) -> Iterator[str]:
        """See ``Disturbance.problems``."""
        if len(self.values) < 2:
            yield f"values: a record has at least two values, got {len(self.values)}"


KINDS: Mapping[str, type[Disturbance]] = {
    "ar1": AutoRegression,
    "random_walk": RandomWalk,
    "markov": Markov,
    "seasonal": Seasonal,
    "resampled": BlockBootstrap,
}
"""Kinds of disturbances by what definition files call them."""


@frozen_record
class DisturbanceEffect(CheckedRecord):
    """How a number is disturbed: the value of a process multiplies it, or is added to it."""

    by: Annotated[str, Declaration("name of the disturbance")]
    adds: Annotated[bool, Declaration("whether its value is added")] = False
    scale: Annotated[float, Positive("what converts the unit of the disturbance to that of the number")] = 1.0


@frozen_record
class Correlation(CheckedRecord):
    """Correlations of what drives Gaussian processes."""

    names: Annotated[tuple[str, ...], Declaration("disturbances of kinds ``ar1``, ``random_walk`` or ``seasonal``")]
    matrix: Annotated[
        tuple[tuple[float, ...], ...],
        Numbers(
            "a row for each: correlation of its ε with that of each",
            "((number, …), …)",
            (None, None),
            table_form="matrix",
        ),
    ]
    regions: Annotated[
        float,
        Quantity(
            "in a definition that is copied: correlation of a disturbance in two regions; of two different ones, times "
            "that in the matrix",
            low=0.0,
            high=1.0,
        ),
    ] = 0.0

    def problems(self, disturbances: Mapping[str, Disturbance]) -> Iterator[str]:
        """Yield what is wrong with it."""
        for name in self.names:
            if name not in disturbances:
                yield unknown_name("disturbance", name, disturbances)
            elif not isinstance(disturbances[name], Gaussian):
                kind = disturbances[name].kind
                yield f"'{name}' is of kind '{kind}'; only ar1, random_walk and seasonal can be correlated"
        count, matrix = len(self.names), self.matrix
        if count < 2:
            yield f"names: needs two disturbances or more, got {count}"
            return
        if len(set(self.names)) < count:
            yield "names: a disturbance stands there twice"
        if len(matrix) != count or any(len(row) != count for row in matrix):
            yield f"matrix: needs {count} rows of {count} numbers, as there are {count} names"
            return
        table = np.array(matrix)
        least = float(np.linalg.eigvalsh((table + table.T) / 2).min(initial=0.0))
        if (np.abs(table - table.T) > ROUND_OFF).any() or (np.abs(np.diag(table) - 1) > ROUND_OFF).any():
            yield f"matrix: is no correlation: symmetric, and 1 of each with itself, got {table.tolist()}"
        elif least < -ROUND_OFF:
            yield f"matrix: is no correlation: nothing is correlated like that (its least eigenvalue is {least:.3g})"


def disturbance_problems(network: Specification) -> Iterator[str]:
    """Yield why the disturbances of a network cannot be drawn or seen."""
    disturbances: Mapping[str, Disturbance] = network.disturbances
    compartments = [part.id for part in (*network.nodes, *network.arcs)]
    for name, disturbance in disturbances.items():
        mistakes = [*bound_problems(disturbance), *_infinite_values(disturbance)] or list(disturbance.problems())
        mistakes += _sight_problems(disturbance)
        mistakes += unknown_names("agent", disturbance.observed_by, compartments, "observed_by: ")
        yield from (f"disturbances.{name}: {mistake}" for mistake in mistakes)
    for path, disturbed in network.disturbed.items():
        if disturbed.by not in disturbances:
            yield f"{path}: disturbed_by: {unknown_name('disturbance', disturbed.by, disturbances)}"
    if network.correlation is not None:
        yield from (f"disturbance_correlation: {fault}" for fault in network.correlation.problems(disturbances))


def _infinite_values(disturbance: Disturbance) -> Iterator[str]:
    """Yield the listed values that are not finite."""
    for key in ("values", "profile"):
        listed = getattr(disturbance, key, ())
        yield from (f"{key}: value {i}, {x:g}, must be finite" for i, x in enumerate(listed, 1) if not math.isfinite(x))


def _sight_problems(disturbance: Disturbance) -> Iterator[str]:
    for key in ("delayed", "forecast"):
        if not 0 <= getattr(disturbance, key) <= FURTHEST:
            yield f"{key} {getattr(disturbance, key)}: must be a number of intervals, 0 to {FURTHEST}"
    if disturbance.observed == "none" and (disturbance.forecast or disturbance.delayed or disturbance.observed_by):
        key = "forecast" if disturbance.forecast else "delayed" if disturbance.delayed else "observed_by"
        yield f"{key}: it is hidden (observed = 'none'), so that nobody can see that of it"
    elif disturbance.forecast and disturbance.delayed:
        yield "forecast: starts from what is seen now, and what is seen is delayed; leave one of the two out"
