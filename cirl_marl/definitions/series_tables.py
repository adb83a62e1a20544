"""From the tables and columns of a definition to series in the units of the network."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date
from functools import lru_cache

from cirl_marl.definitions.data_files import DataFiles
from cirl_marl.definitions.quantities import AmountColumn, AmountSeries
from cirl_marl.errors import CirlError
from cirl_marl.network.calendar import YearOrDate, elapsed_time
from cirl_marl.network.series import Series, Value
from cirl_marl.network.units import factor


@dataclass(frozen=True, slots=True)
class Clock:
    """What times of a definition count from: the ``start`` of its episode, if it has one, in the network's ``unit``."""

    start: YearOrDate | None
    unit: str

    def times(self, moments: tuple[YearOrDate, ...], time_unit: str | None) -> tuple[float, ...]:
        """Return times since the start; given as such in ``time_unit``, or without it as years or dates."""
        if time_unit is not None:
            tick = factor(time_unit, self.unit)
            dates = [moment for moment in moments if isinstance(moment, date)]
            if dates:
                raise CirlError(f"{dates[0]} is a date, which takes no time_unit; leave it out")
            return tuple(moment * tick for moment in moments if not isinstance(moment, date))
        if self.start is None:
            remedy = "give a time_unit, in which times count from the start, or the start of the [episode]"
            raise CirlError(f"times are years or dates only if the episode has a start; {remedy}")
        return _elapsed_times(moments, self.start, self.unit)


@lru_cache(maxsize=1024)  # columns share their times
def _elapsed_times(moments: tuple[YearOrDate, ...], start: YearOrDate, unit: str) -> tuple[float, ...]:
    return tuple(elapsed_time(moment, start, unit) for moment in moments)


def inline_series(table: AmountSeries, unit: float, clock: Clock) -> Series:
    """Return a series written in the definition; ``unit`` is that of its values."""
    times, values = clock.times(tuple(table.times), table.time_unit), tuple(value * unit for value in table.values)
    until = None if table.until is None else clock.times((table.until,), table.time_unit)[0]
    return Series(times=times, values=values, interpolation=table.interpolation, until=until)


def column_value(
    table: AmountColumn, conditions: Mapping[str, str], files: DataFiles, unit: float, clock: Clock
) -> Value:
    """Return what a column of a file holds in the rows ``conditions`` its other columns have these texts.

    The last of several steps is known as long as the one before it holds; a single one for a year or a ``time_unit``.
    """
    words = (table.file, table.column, table.times, table.time_unit, table.interpolation)
    key = (*words, *conditions.items(), unit, clock)
    if key not in files.read_values:
        files.read_values[key] = _column_value(table, conditions, files, unit, clock)
    value: Value = files.read_values[key]
    return value


def _column_value(
    table: AmountColumn, conditions: Mapping[str, str], files: DataFiles, unit: float, clock: Clock
) -> Value:
    column = files.column(table.file, table.column, conditions, table.times)
    values = tuple(value * unit for value in column.values)
    if column.times is None:
        return values[0]
    times = clock.times(tuple(column.times), table.time_unit)
    last = times[-1] - times[-2] if len(times) > 1 else factor(table.time_unit or "year", clock.unit)
    until = times[-1] + last if table.interpolation == "step" else None
    return Series(times=times, values=values, interpolation=table.interpolation, until=until, origin=column.origin)
