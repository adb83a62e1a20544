"""Numbers that change in time, and what they are in each control interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import field, replace
from itertools import pairwise
from typing import Annotated, Any, Literal

import numpy as np

from cirl_marl.network.declarations import (
    LARGEST,
    SMALLEST,
    CheckedRecord,
    Declaration,
    Numbers,
    Quantity,
    TimeDependent,
    Word,
    frozen_record,
)
from cirl_marl.network.rowsum import Floats


@frozen_record
class Series(CheckedRecord, TimeDependent):
    """A number that changes in time; within a control interval its mean over the interval holds."""

    times: Annotated[
        tuple[float, ...],
        Numbers("when each value holds, from the start of the episode, time; the first not after it", "(time, …)"),
    ]
    values: Annotated[tuple[float, ...], Numbers("one for each time, in the unit of the quantity", "(value, …)")]
    interpolation: Annotated[
        str,
        Word(
            "``step``: a value holds until the next one; ``linear``: straight lines between them", of=("step", "linear")
        ),
    ] = "step"
    until: Annotated[
        float | None,
        Quantity(
            "time up to which the last value is known to hold; None: for good (``step``), or no longer", of="time"
        ),
    ] = None
    factor: Annotated[Any, Declaration("another series, not negative, by which it is multiplied at all times")] = None
    origin: Annotated[str, Declaration("where it was read from, for messages")] = field(default="", compare=False)

    @property
    def extremes(self) -> tuple[float, float]:
        """Bounds of its values, which it reaches if it has no factor."""
        low, high = min(self.values), max(self.values)
        if self.factor is None:
            return low, high
        corners = [end * bound for end in (low, high) for bound in self.factor.extremes]
        return min(corners), max(corners)

    def time_of(self, extreme: float) -> float:
        """Return when it first comes closest to a value, as it does to its ``extremes``."""
        return min(self.times, key=lambda time: abs(float(self.limits(np.array([time]), "right")[0]) - extreme))

    def __format__(self, spec: str) -> str:
        """Say its lowest and its highest value."""
        low, high = self.extremes
        return f"{low:{spec}} … {high:{spec}}"

    @property
    def end(self) -> float:
        """Time up to which it is known."""
        if self.until is not None:
            return self.until
        return math.inf if self.interpolation == "step" else self.times[-1]

    def problems(self) -> Iterator[str]:
        """Yield what is wrong with times and values, whatever the episode."""
        if not self.times or len(self.times) != len(self.values):
            yield f"series has {len(self.times)} times and {len(self.values)} values: one for each"
            return
        for before, after in pairwise(self.times):
            if not before < after < math.inf:
                yield f"series: times must increase and be finite, but {after:g} follows {before:g}"
                return
        if not all(map(math.isfinite, (self.times[0], *self.values))):
            yield "series: times and values must be finite"
        elif largest := [x for x in (*self.times, *self.values) if abs(x) > LARGEST]:
            yield f"series: times and values must be at most {LARGEST:g} in size, but {largest[0]:g} stands there"
        elif any(after - before < SMALLEST for before, after in pairwise(self.times)):
            yield f"series: times must be at least {SMALLEST:g} apart"
        elif self.until is not None and not self.until >= self.times[-1]:
            yield f"series: until {self.until:g} lies before its last time, {self.times[-1]:g}"
        if self.factor is not None:
            mistakes = list(self.factor.problems())
            if not mistakes and min(self.factor.values) < 0:
                mistakes = [f"series: {min(self.factor.values):g} is negative"]
            yield from (f"multiplied_by: {mistake}" for mistake in mistakes)

    def coverage_problem(self, length: float, format_time: Callable[[float], str] = "{:g}".format) -> str:
        """Return what is missing of an episode of some length; nothing if the series covers it.

        ``format_time`` puts times into words.
        """
        slack = 1e-9 * max(length, 1.0)
        if self.times[0] > slack:
            early = f"series begins at {format_time(self.times[0])}, after the episode does; it needs"
            return f"{early} a value for {format_time(0.0)}, unless its times are of another unit or calendar years"
        if self.end < length - slack:
            fault = f"series ends at {format_time(self.end)}, but the episode at {format_time(length)}"
            return f"{fault}; give what is missing, or a shorter horizon"
        fault_of_factor = "" if self.factor is None else self.factor.coverage_problem(length, format_time)
        return fault_of_factor and f"multiplied_by: {fault_of_factor}"

    def history_problem(self, format_time: Callable[[float], str] = "{:g}".format) -> str:
        """Return why it does not tell what was before time 0; nothing if it does."""
        if self.times[0] >= 0:
            return f"series begins at {format_time(self.times[0])}, not before the episode does"
        if self.end < 0:
            early = f"series ends at {format_time(self.end)}, before the episode begins at {format_time(0.0)}"
            return f"{early}; give what is missing"
        if self.factor is None:
            return ""
        if self.factor.times[0] > self.times[0]:
            late = f"series begins at {format_time(self.factor.times[0])}"
            return (
                f"multiplied_by: {late}, after what it multiplies at {format_time(self.times[0])}; give what is missing"
            )
        fault_of_factor = self.factor.history_problem(format_time)
        return fault_of_factor and f"multiplied_by: {fault_of_factor}"

    def means(self, edges: Floats) -> Floats:
        """Return the mean over each interval between ``edges``, shape (len(edges) − 1,)."""
        if self.factor is not None:
            return self._means_of_product(edges)
        times, values, slopes = self._lines()
        lengths = np.diff(times)
        total = np.concatenate([[0.0], np.cumsum(values[:-1] * lengths + slopes[:-1] * lengths**2 / 2)])
        index = np.maximum(np.searchsorted(times, edges, side="right") - 1, 0)
        within = edges - times[index]
        integral = total[index] + values[index] * within + slopes[index] * within**2 / 2
        # differences of a sum round: what holds throughout is its own mean, and no mean leaves the values it is of
        begins, ends = self.limits(edges[:-1], "right"), self.limits(edges[1:], "left")
        lowest, highest = np.minimum(begins, ends), np.maximum(begins, ends)
        of = np.searchsorted(edges, times, side="right") - 1
        inside = (of >= 0) & (of < len(lowest))
        np.minimum.at(lowest, of[inside], values[inside])
        np.maximum.at(highest, of[inside], values[inside])
        return np.clip(np.diff(integral) / np.diff(edges), lowest, highest)

    def limits(self, times: Floats, side: Literal["left", "right"]) -> Floats:
        """Return the values until some times (``left``), or from them on (``right``), shape (times,)."""
        points, values, slopes = self._lines()
        index = np.maximum(np.searchsorted(points, times, side=side) - 1, 0)
        return values[index] + slopes[index] * (times - points[index])

    def _lines(self) -> tuple[Floats, Floats, Floats]:
        """Return times, values and slopes from each time on."""
        times, values = np.array(self.times), np.array(self.values)
        slopes = np.zeros(len(times))
        if self.interpolation == "linear":
            slopes[:-1] = np.diff(values) / np.diff(times)
        return times, values, slopes

    def _means_of_product(self, edges: Floats) -> Floats:
        """Return the means of the product, by Simpson's rule between all times, where both are straight lines."""
        factors = [replace(self, factor=None), self.factor]
        instants = np.array([*self.times, *self.factor.times])
        points = np.union1d(edges, instants[(instants > edges[0]) & (instants < edges[-1])])
        begins = np.array([series.limits(points[:-1], "right") for series in factors])
        ends = np.array([series.limits(points[1:], "left") for series in factors])
        middle = (begins + ends) / 2
        part = (begins.prod(axis=0) + 4 * middle.prod(axis=0) + ends.prod(axis=0)) / 6 * np.diff(points)
        first = np.searchsorted(points, edges[:-1])
        return np.add.reduceat(part, first) / np.diff(edges)


Value = float | Series
"""What may change in time."""


def series_of(values: Floats, interval: float) -> Series:
    """Return the series that has these values in control intervals of some length."""
    return Series(times=tuple((interval * np.arange(len(values))).tolist()), values=tuple(values.tolist()))


def in_intervals(values: Floats, interval: float) -> Value:
    """Return what has these values in control intervals of some length; a number if they are all the same."""
    return float(values[0]) if (values == values[0]).all() else series_of(values, interval)


def means(value: Value, edges: Floats) -> Floats:
    """Return the mean of a value over each interval between ``edges``, shape (len(edges) − 1,)."""
    return value.means(edges) if isinstance(value, Series) else np.full(len(edges) - 1, float(value))


def extremes(value: Value) -> tuple[float, float]:
    """Return the lowest and the highest value."""
    return value.extremes if isinstance(value, Series) else (value, value)


def product(value: Value, factor_: Value) -> Value:
    """Return a number or series times another."""
    if isinstance(value, Series):
        if isinstance(factor_, Series):
            return replace(value, factor=factor_)
        return replace(value, values=tuple(number * factor_ for number in value.values))
    if isinstance(factor_, Series):
        return replace(factor_, values=tuple(value * number for number in factor_.values))
    return value * factor_
