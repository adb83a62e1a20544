"""Disturbances of a definition from what was measured: columns of a table, and what varies around their trends."""

from __future__ import annotations

import math
import shlex
from collections.abc import Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import tomlkit

from cirl_marl.definitions.data_files import DataFiles, number_in
from cirl_marl.errors import CirlError, check_names
from cirl_marl.importing.definition import identifier
from cirl_marl.importing.process_estimates import (
    DIGITS,
    NOISE_KINDS,
    Errors,
    Estimate,
    FitOptions,
    estimated_chain,
    series_noise,
    time_text,
)
from cirl_marl.network.calendar import YearOrDate
from cirl_marl.network.declarations import Quantity, declarations, default_of, positional_record
from cirl_marl.network.disturbances import Correlation, Disturbance, Gaussian
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.units import factor

KINDS = (*NOISE_KINDS, "markov")
"""Kinds of disturbances that can be estimated."""
TRENDS = ("linear", "none")


@positional_record
class DisturbanceFits:
    """Disturbances that were estimated from a table."""

    disturbances: Annotated[Mapping[str, Disturbance], "by name"]
    errors: Annotated[Mapping[str, Errors], "standard errors of their numbers, by name and field"]
    intervals: Annotated[Mapping[str, tuple[float, float]], "95 % intervals of deviations, by name; none of chains"]
    trends: Annotated[Mapping[str, tuple[float, float]], "change a row, relative or in the unit, with its error"]
    correlation: Annotated[Correlation | None, "of what drives them, if there are several"]
    correlation_errors: Annotated[Floats, "standard errors of its entries; no rows without it"]
    rows: Annotated[str, "how many, and when"]
    time_unit: Annotated[str, "unit of the times"]
    source: Annotated[str, "the command that repeats the fit, and where the table comes from"]

    def tables(self, scenario: str = "") -> str:
        """Return the tables of a definition, or of a scenario of it, whose sources are the command with the errors."""
        prefix, tables = f"scenarios.{scenario}." if scenario else "", []
        for name, disturbance in self.disturbances.items():
            errors = ", ".join(f"{field} ± {_error_text(error)}" for field, error in self.errors[name].items())
            if name in self.intervals:
                low, high = self.intervals[name]
                errors += f"; 95 % of deviation: {low:.2g} to {high:.2g}"
            source = f"{self.source}; {self.rows}; {errors}"
            entries = {"kind": disturbance.kind, **self._entries(disturbance), "unit": disturbance.unit}
            tables.append(_table(f"{prefix}disturbances.{name}", {**entries, "source": source}))
        if self.correlation is not None:
            source = f"{self.source}; {self.rows}; entries ± {_error_text(float(self.correlation_errors.max()))}"
            entries = {**self._entries(self.correlation), "source": source}
            tables.append(_table(f"{prefix}disturbance_correlation", entries))
        return "\n".join(tables)

    def _entries(self, part: Any) -> dict[str, Any]:
        """Return the keys of what is not as it is by default."""
        entries: dict[str, Any] = {}
        for name, declaration in declarations(type(part)).items():
            value = getattr(part, name)
            if isinstance(declaration, Quantity) and declaration.of == "time":
                entries[name] = tomlkit.inline_table()
                entries[name] |= {"value": value, "unit": self.time_unit, "source": self.source}
            elif value != default_of(type(part), name):
                entries[name] = value
        return entries


def fit_disturbances(
    table: str | Path,
    columns: Sequence[str],
    *,
    kind: str = "ar1",
    logarithm: bool = True,
    trend: str = "linear",
    unit: str = "",
    interval: str = "",
    seasons: int = 0,
    rows: Mapping[str, str] | None = None,
    times: str | None = None,
    source: str = "",
) -> DisturbanceFits:
    """Estimate disturbances from columns of a table, one of each, and their correlations if they are Gaussian.

    The trend is estimated with the noise around it, and left out: what is found disturbs a number that has the trend
    already. Without ``unit`` it is a factor of mean 1, relative to the trend; with one a summand of mean 0. Persistence
    and deviation of ``ar1`` and ``seasonal`` are those of the restricted likelihood (``autoregression``); what is
    ``resampled`` is the record of residuals, in blocks of a mean length n^⅓·(2φ/(1 − φ²))^⅔, with which the variance of
    a mean is met best; the regimes of ``markov`` are the values of the series, and their transitions are counted.

    Args:
        table: a CSV file in UTF-8, with a row for each time.
        columns: with the series; disturbances are called by them, in lower case with '_' between words.
        kind: ``ar1``, ``resampled``, ``seasonal`` or ``markov``.
        logarithm: whether the noise is that of the logarithm, so that a factor stays positive; not of summands.
        trend: ``linear`` in time (of the logarithm: so many percent a row), or ``none``.
        unit: of a summand, such as ``kt/year``: that of the columns.
        interval: control interval of the network, such as ``0.25 day``; default: the time between two rows. Another
            one has the persistence φ^(interval/spacing); a chain of two regimes likewise.
        seasons: rows after which the season comes again, for ``seasonal``; the first row begins it.
        rows: texts by which rows are chosen, by column.
        times: the column of times, evenly spaced: dates, or numbers in the unit by which it is called; default: year.
        source: where the table comes from.

    Raises:
        CirlError: naming file, column and time: of gaps, short or constant series, values without logarithm, noise that
            does not revert to its trend, or an option that does not fit.

    References: Politis and White 2004, Automatic block-length selection for the dependent bootstrap.
    """
    path, options = Path(table), FitOptions(kind, logarithm and not unit, trend, unit, interval, seasons)
    _check_options(options, columns)
    files, conditions = DataFiles(path.parent), rows or {}
    series = {column: files.column(path.name, column, conditions, times) for column in columns}
    moments = series[columns[0]].times or ()
    spacing, time_unit = _spacing(path.name, moments, times or "year")
    length = _length_in_rows(interval, spacing, time_unit)
    estimates: dict[str, Estimate] = {}
    noises = {}
    for column, entries in series.items():
        name = identifier(column, "series")
        if name in estimates:
            raise CirlError(f"{path.name}: two columns would give a disturbance called '{name}'")
        try:
            if kind == "markov":
                estimates[name] = estimated_chain(np.array(entries.values), options, length)
            else:
                noises[name] = series_noise(entries, options)
                estimates[name] = NOISE_KINDS[kind](noises[name], options, length, spacing)
        except CirlError as error:
            raise CirlError(f"{path.name}, column '{column}': {error}") from None
    correlation, uncertainty = None, np.empty((0, 0))
    if len(estimates) > 1 and all(isinstance(part.disturbance, Gaussian) for part in estimates.values()):
        matrix = np.corrcoef([noise.estimate.innovations for noise in noises.values()])
        uncertainty = (1.0 - matrix**2) / np.sqrt(len(moments) - 1)
        correlation = Correlation(names=tuple(estimates), matrix=tuple(map(tuple, matrix.round(DIGITS).tolist())))
    command = _command(path, columns, options, conditions, times)
    return DisturbanceFits(
        disturbances={name: part.disturbance for name, part in estimates.items()},
        errors={name: part.errors for name, part in estimates.items()},
        intervals={name: part.interval for name, part in estimates.items() if part.interval is not None},
        trends={name: noise.trend for name, noise in noises.items()},
        correlation=correlation,
        correlation_errors=uncertainty,
        rows=f"{len(moments)} rows, {time_text(moments[0])} to {time_text(moments[-1])}",
        time_unit=time_unit,
        source=f"{command} ({source})" if source else command,
    )


def _check_options(options: FitOptions, columns: Sequence[str]) -> None:
    for label, word, words in (("kind to fit", options.kind, KINDS), ("trend", options.trend, TRENDS)):
        check_names(label, [word], words)
    if not columns:
        raise CirlError("fit: which column?")
    if (options.kind == "seasonal") != (options.seasons > 1):
        raise CirlError(f"seasons {options.seasons}: kind 'seasonal' needs at least 2, the others none")


def _spacing(name: str, times: Sequence[YearOrDate], unit: str) -> tuple[float, str]:
    """Return the time between two rows and its unit; a ``CirlError`` names the first gap."""
    if len(times) < 2:
        raise CirlError(f"{name}: {len(times)} rows with times are no series")
    days = [moment for moment in times if isinstance(moment, date)]
    if days and len({moment.day for moment in days}) == 1:
        unit, moments = "month", np.array([12.0 * moment.year + moment.month for moment in days])
    elif days:
        unit, moments = "day", np.array([float(moment.toordinal()) for moment in days])
    else:
        moments = np.array(times, dtype=float)
    steps = np.diff(moments)
    step = float(np.median(steps))
    if len(uneven := np.flatnonzero(np.abs(steps - step) > 1e-6 * step)):
        i = int(uneven[0])
        fault = f"from {time_text(times[i])} to {time_text(times[i + 1])} it is {steps[i]:g} {unit}, elsewhere {step:g}"
        raise CirlError(f"{name}: rows must be evenly spaced in time: {fault}; fill the gap, or fit a part of the rows")
    return step, unit


def _length_in_rows(interval: str, spacing: float, unit: str) -> float:
    """Return how many rows a control interval is long."""
    if not interval:
        return 1.0
    length, _, name = interval.strip().partition(" ")
    try:
        rows, reason = number_in(length) * factor(name or "1", unit) / spacing, ""
    except CirlError as error:
        rows, reason = 0.0, f"; {error}"
    if not 0 < rows < math.inf:
        raise CirlError(f"interval '{interval}': write a number and a unit of time, such as '0.25 day'{reason}")
    return rows


def _error_text(error: float | tuple[float, ...]) -> str:
    return "/".join(f"{part:.2g}" for part in (error if isinstance(error, tuple) else (error,)))


def _table(header: str, entries: Mapping[str, Any]) -> str:
    """Return a table with a line for each key."""
    lines = (f"{key} = {tomlkit.item(value).as_string()}\n" for key, value in entries.items())
    return f"[{header}]\n{''.join(lines)}"


def _command(
    path: Path, columns: Sequence[str], options: FitOptions, conditions: Mapping[str, str], times: str | None
) -> str:
    """Return the command that repeats a fit."""
    words = ["cirl", "fit", path.name if path.is_absolute() else path.as_posix()]
    words += (word for column in columns for word in ("--column", column))
    words += (word for key, text in conditions.items() for word in ("--where", f"{key}={text}"))
    for key, value, default in zip(FitOptions._fields, options, FitOptions(), strict=True):
        if key != "logarithm" and value != default:
            words += [f"--{key}", str(value)]
    words += ["--plain"] if options.relative and options.kind != "markov" else []
    words += [] if times is None else ["--times", times]
    return shlex.join(words)
