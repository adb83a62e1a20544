"""Factors on numbers that are not certain, and what they act on: flows of arcs, or rows of a table such as bands.

Factors have shape (numbers, B): every copy has its own. They are what an episode drew, times or plus what disturbs it
in the interval.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cirl_marl.dynamics.stages import StagedNetwork
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.elements import ControlKind, Law
from cirl_marl.network.processes import interval_of
from cirl_marl.network.uncertainty import CAPACITY, factor_ranges, numbers_of, stated_means


class IntervalFactors:
    """Factors on all numbers that are not certain.

    Attributes:
        ranges: lowest and highest factor by path; the rows of factors.
    """

    def __init__(self, network: Network, *, uncertain: bool) -> None:
        """Take the disturbed numbers of a network, and with ``uncertain`` those that episodes draw."""
        self.ranges = factor_ranges(network, with_draws=uncertain)
        self._draws = len(network.uncertain) if uncertain else 0
        rows = {path: row for row, path in enumerate(self.ranges)}
        index = network.processes.names.index
        self._times: list[tuple[int, int]] = []
        self._added: list[tuple[int, int, Floats]] = []
        for path, disturbed in network.disturbed.items():
            if disturbed.adds:
                self._added.append((rows[path], index(disturbed.by), disturbed.scale / stated_means(network, path)))
            else:
                self._times.append((rows[path], index(disturbed.by)))
        only_times = not self._draws and not self._added
        names: Integers = np.array([name for _, name in self._times], dtype=np.intp)
        self._alone = names if only_times else None
        self._last = network.episode.horizon - 1

    def __call__(self, draws: Floats, values: Floats, step: Integers) -> Floats | None:
        """Return the factors in an interval of each copy, shape (numbers, B); None if everything is certain.

        Args:
            draws: of the episode, shape (numbers drawn, B).
            values: ξ in all intervals, shape (intervals, names, B).
            step: the interval in each copy, shape (B,).
        """
        if not self.ranges:
            return None
        if not self._times and not self._added:
            return draws
        now = interval_of(values, step)
        if self._alone is not None:
            return now.take(self._alone, axis=0)
        factors = np.ones((len(self.ranges), len(step)))
        factors[: self._draws] = draws
        for row, name in self._times:
            factors[row] *= now[name]
        for row, name, part in self._added:
            factors[row] += now[name] * part.take(np.minimum(step, self._last))
        return factors

    def pull_back(self, draws: Floats, values: Floats, step: Integers, adjoint: Floats, path_adjoint: Floats) -> Floats:
        """Return derivatives by the draws of those by the factors, and add those by the values to ``path_adjoint``."""
        now, copies, factors = interval_of(values, step), np.arange(len(step)), np.ones_like(adjoint)
        factors[: self._draws] = draws
        by_draw = adjoint.copy()
        for row, name in self._times:
            path_adjoint[step, name, copies] += adjoint[row] * factors[row]
            by_draw[row] *= now[name]
        for row, name, part in self._added:
            path_adjoint[step, name, copies] += adjoint[row] * part.take(np.minimum(step, self._last))
        return by_draw[: self._draws]


class RowFactors:
    """Rows of a table that uncertain numbers multiply.

    Attributes:
        rows: those rows.
    """

    def __init__(self, numbers: Mapping[int, int]) -> None:
        """Let rows of a table be multiplied by rows of the factors."""
        self.rows: Integers = np.array([*numbers], dtype=np.intp)
        self._numbers: Integers = np.array([*numbers.values()], dtype=np.intp)

    def __call__(self, table: Floats, factors: Floats | None) -> Floats:
        """Return a table of shape (rows, 1 or B) times what was drawn."""
        if factors is None or not len(self.rows):
            return table
        product = np.repeat(table, factors.shape[1] // table.shape[1], axis=1)
        product[self.rows] *= factors.take(self._numbers, axis=0)
        return product

    def pull_back(self, table: Floats, adjoint: Floats, factor_adjoint: Floats) -> None:
        """Add to the adjoint of the factors what that of ``table`` times them, shape (rows, B), brings."""
        np.add.at(factor_adjoint, self._numbers, adjoint[self.rows] * table[self.rows])


def capacity_numbers(network: Network, ranges: Mapping[str, tuple[float, float]]) -> dict[int, int]:
    """Return the rows of controls whose upper bounds are disturbed, with the rows of their factors."""
    numbers = {**numbers_of(ranges, "nodes", CAPACITY), **numbers_of(ranges, "arcs", CAPACITY)}
    return {network.control_rows[id_].start: number for id_, number in numbers.items()}


class ControlFactors:
    """Controls of which uncertain numbers multiply the bounds and the neutral value; a share is at most 1."""

    def __init__(
        self, network: Network, ranges: Mapping[str, tuple[float, float]], rows: Integers | None = None
    ) -> None:
        """Take a table of ``rows`` of ``network.control_rows``, None being all; ``ranges`` are of all factors."""
        number_of = {**numbers_of(ranges, "nodes", "control"), **numbers_of(ranges, "arcs", "control")}
        owner = [id_ for id_ in network.controllable for _ in range(network.compartments[id_].actions)]
        table_rows = range(len(owner)) if rows is None else rows.tolist()
        numbers = {place: number_of[owner[row]] for place, row in enumerate(table_rows) if owner[row] in number_of}
        controls = {place: network.compartments[owner[row]].control for place, row in enumerate(table_rows)}
        shares = (ControlKind.SHARE, ControlKind.TRANSFER)
        is_share = [place for place in numbers if (c := controls[place]) and c.kind in shares]
        self._factors, self._shares = RowFactors(numbers), np.array(is_share, dtype=np.intp)
        self._ends = np.array([*ranges.values()], dtype=float).reshape(-1, 2).T

    @property
    def is_active(self) -> bool:
        """Whether any of them is uncertain."""
        return bool(len(self._factors.rows))

    def __call__(self, table: Floats, factors: Floats | None) -> Floats:
        """Return a table of controls, shape (rows, 1 or B), as they were drawn."""
        drawn = self._factors(table, factors)
        if drawn is not table and len(self._shares):
            drawn[self._shares] = np.minimum(drawn[self._shares], 1.0)
        return drawn

    def pull_back(self, table: Floats, factors: Floats, adjoint: Floats, factor_adjoint: Floats) -> None:
        """Add to the adjoint of the factors what that of controls as they were drawn, shape (rows, B), brings."""
        if len(self._shares):
            adjoint = adjoint.copy()
            adjoint[self._shares] *= self._factors(table, factors)[self._shares] <= 1.0
        self._factors.pull_back(table, adjoint, factor_adjoint)

    def extreme(self, table: Floats, end: int) -> Floats:
        """Return a table of controls under the lowest (0) or the highest (1) factors."""
        return self(table, np.repeat(self._ends[end][:, None], table.shape[1], axis=1))


class FlowFactors:
    """The arcs whose flow laws uncertain numbers multiply; shares are not among them (``shares``).

    Attributes:
        arcs: those arcs.
        highest: greatest factor on each, shape (arcs,).
        capacity: of controls whose upper bounds are disturbed.
        highest_capacity: greatest factor on each of these, shape (controls, 1).
        controls: those that are uncertain.
    """

    def __init__(self, network: Network, ranges: Mapping[str, tuple[float, float]]) -> None:
        """Find them in ``network``, which has its lifetimes as stages if it has any; ``ranges`` are of all factors."""
        self.controls = ControlFactors(network, ranges)
        valves = network.valves if isinstance(network, StagedNetwork) else {}
        rates, flows = numbers_of(ranges, "arcs", "rate"), numbers_of(ranges, "arcs", "flow")
        releases, stretches = numbers_of(ranges, "nodes", "rate"), numbers_of(ranges, "nodes", "stretch")
        entries: list[tuple[int, int, bool]] = []
        for k, arc in enumerate(network.arcs):
            if arc.donor in valves:
                number = stretches.get(valves[arc.donor])
            elif arc.law is Law.SHARE:
                number = releases.get(network.original(arc.donor))
            else:
                number = (flows if arc.law is Law.EXOGENOUS else rates).get(network.original(arc.id))
            if number is not None:
                entries.append((k, number, arc.donor in valves))
        self.arcs: Integers = np.array([k for k, _, _ in entries], dtype=np.intp)
        self._numbers: Integers = np.array([number for _, number, _ in entries], dtype=np.intp)
        self._inverse_rows: Integers = np.flatnonzero([inverse for _, _, inverse in entries])
        ends = [*ranges.values()]
        extremes = [1 / ends[number][0] if inverse else ends[number][1] for _, number, inverse in entries]
        self.highest: Floats = np.array(extremes, dtype=float)
        capacities = capacity_numbers(network, ranges)
        self.capacity = RowFactors(capacities)
        self.highest_capacity = np.array([ends[number][1] for number in capacities.values()]).reshape(-1, 1)

    def multiply(self, rate: Floats, factors: Floats) -> None:
        """Multiply what was drawn into the rates of arcs, shape (arcs, B), in place."""
        if len(self.arcs):
            rate[self.arcs] *= self.multipliers(factors)

    def multipliers(self, factors: Floats) -> Floats:
        """Return by what each of ``arcs`` is multiplied: a stretch divides."""
        multipliers = factors.take(self._numbers, axis=0)
        multipliers[self._inverse_rows] = 1.0 / multipliers[self._inverse_rows]
        return multipliers

    def pull_back(self, factors: Floats, adjoint: Floats, factor_adjoint: Floats) -> None:
        """Add to the adjoint of the factors what that of the ``multipliers`` brings, which is used up."""
        adjoint[self._inverse_rows] *= -(self.multipliers(factors)[self._inverse_rows] ** 2)
        np.add.at(factor_adjoint, self._numbers, adjoint)
