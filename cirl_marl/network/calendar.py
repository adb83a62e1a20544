"""From elapsed time to the calendar and back, for networks that begin on it.

A year is 365.25 days, as it is for units. Networks whose unit of time is a month or longer count in years: a time t is
the year start + t. All others count in days: a time t is the date start + t.
"""

from __future__ import annotations

from datetime import date, datetime, timedelta

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.network.rowsum import Floats
from cirl_marl.network.specification import Specification
from cirl_marl.network.units import factor

YearOrDate = float | date
"""A calendar year such as 2000 or 2000.5, or a date."""

YEAR = 365.25
"""Days of a year."""
LAST_YEAR = 9999


def in_years(unit: str) -> bool:
    """Whether networks whose unit of time is ``unit`` count in years."""
    return factor(unit, "day") > 28


def year(moment: YearOrDate) -> float:
    """Return a moment as a calendar year with its fraction.

    >>> year(date(2020, 7, 1)) == 2020 + 182 / 365.25
    True
    """
    if isinstance(moment, date):
        return moment.year + (moment - date(moment.year, 1, 1)).days / YEAR
    return float(moment)


def elapsed_time(moment: YearOrDate, start: YearOrDate, unit: str) -> float:
    """Return the time from ``start`` to ``moment``, in ``unit``; negative if it lies before.

    >>> elapsed_time(2001.5, 2000, "year"), elapsed_time(date(2020, 3, 1), 2020, "day")
    (1.5, 60.0)
    """
    if isinstance(moment, date) and not in_years(unit):
        return (_clock(moment) - _clock(start)) / timedelta(days=1) * factor("day", unit)
    return (year(moment) - year(start)) * factor("year", unit)


def years(network: Specification, time: ArrayLike) -> Floats:
    """Return times since the start of an episode as calendar years; the network must have a start."""
    start = network.episode.start
    assert start is not None
    return year(start) + np.asarray(time, dtype=np.float64) * factor(network.time_unit, "year")


def labels(network: Specification, time: ArrayLike) -> tuple[list[str], list[list[str]]]:
    """Return the headers and the columns of a table for times on the calendar: one each, or none without a start."""
    start = network.episode.start
    if start is None:
        return [], []
    if in_years(network.time_unit):
        return ["year"], [[f"{moment:.10g}" for moment in np.atleast_1d(years(network, time)).tolist()]]
    seconds = np.atleast_1d(time) * factor(network.time_unit, "s")
    dates = [_clock(start) + timedelta(seconds=round(moment)) for moment in seconds.tolist()]
    whole = all(moment.time() == moment.min.time() for moment in dates)
    return ["date"], [[moment.isoformat(" ", "minutes")[: 10 if whole else None] for moment in dates]]


def time_columns(network: Specification, times: Floats) -> tuple[list[str], list[list[object]]]:
    """Return header and cells of the first columns of tables over time: the time, and the year or date if there is one.

    ``times`` are ends of intervals; there is a row of cells for each.
    """
    calendar, dates = labels(network, times)
    header = [f"time ({network.time_unit})", *(f"{name} at the end" for name in calendar)]
    return header, [list(row) for row in zip(times.tolist(), *dates, strict=True)]


def _clock(moment: YearOrDate) -> datetime:
    """Return a moment on a clock without zones; the fraction of a year is one of 365.25 days."""
    if isinstance(moment, date):
        return datetime(moment.year, moment.month, moment.day)
    return datetime(int(moment), 1, 1) + timedelta(days=(moment % 1) * YEAR)
