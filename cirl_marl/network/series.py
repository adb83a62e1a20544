"""Numbers that change in time, and what they are in each control interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import field
from itertools import pairwise
from typing import Annotated

import numpy as np

from cirl_marl.network.declared import Changing, Checked, Declared, Numbers, Quantity, Word, frozen
from cirl_marl.network.rowsum import Floats


@frozen
class Series(Checked, Changing):
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
    origin: Annotated[str, Declared("where it was read from, for messages")] = field(default="", compare=False)

    def __format__(self, spec: str) -> str:
        """Say its lowest and its highest value."""
        low, high = extremes(self)
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
        elif self.until is not None and not self.until >= self.times[-1]:
            yield f"series: until {self.until:g} lies before its last time, {self.times[-1]:g}"

    def uncovered(self, length: float, said: Callable[[float], str] = "{:g}".format) -> str:
        """Return what is missing of an episode of some length; nothing if the series covers it.

        ``said`` puts times into words.
        """
        slack = 1e-9 * max(length, 1.0)
        if self.times[0] > slack:
            early = f"series begins at {said(self.times[0])}, after the episode does"
            return f"{early}; it needs a value for {said(0.0)}, unless its times are of another unit or calendar years"
        if self.end < length - slack:
            missing = f"series ends at {said(self.end)}, but the episode at {said(length)}"
            return f"{missing}; give what is missing, or a shorter horizon"
        return ""

    def unfinished(self, said: Callable[[float], str] = "{:g}".format) -> str:
        """Return why it does not tell what was before time 0; nothing if it does."""
        if self.times[0] >= 0:
            return f"series begins at {said(self.times[0])}, not before the episode does"
        if self.end < 0:
            return f"series ends at {said(self.end)}, before the episode begins at {said(0.0)}; give what is missing"
        return ""

    def means(self, edges: Floats) -> Floats:
        """Return the mean over each interval between ``edges``, shape (len(edges) − 1,)."""
        times, values = np.array(self.times), np.array(self.values)
        slopes = np.zeros(len(times))
        if self.interpolation == "linear":
            slopes[:-1] = np.diff(values) / np.diff(times)
        lengths = np.diff(times)
        total = np.concatenate([[0.0], np.cumsum(values[:-1] * lengths + slopes[:-1] * lengths**2 / 2)])
        index = np.maximum(np.searchsorted(times, edges, side="right") - 1, 0)
        within = edges - times[index]
        integral = total[index] + values[index] * within + slopes[index] * within**2 / 2
        # differences of a sum round: what holds throughout is its own mean, and no mean leaves the values it is of
        begins = values[index] + slopes[index] * within
        index = np.maximum(np.searchsorted(times, edges, side="left") - 1, 0)
        ends = values[index] + slopes[index] * (edges - times[index])
        lowest, highest = np.minimum(begins[:-1], ends[1:]), np.maximum(begins[:-1], ends[1:])
        of = np.searchsorted(edges, times, side="right") - 1
        inside = (of >= 0) & (of < len(lowest))
        np.minimum.at(lowest, of[inside], values[inside])
        np.maximum.at(highest, of[inside], values[inside])
        means: Floats = np.clip(np.diff(integral) / np.diff(edges), lowest, highest)
        return means


Value = float | Series
"""What may change in time."""


def extremes(value: Value) -> tuple[float, float]:
    """Return the lowest and the highest value."""
    return (min(value.values), max(value.values)) if isinstance(value, Series) else (value, value)
