"""Estimates of each kind of disturbance from one series, with standard errors."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from cirl_marl.definitions.data_files import Column
from cirl_marl.errors import CirlError
from cirl_marl.importing.autoregression import Autoregression, autoregression
from cirl_marl.network.calendar import YearOrDate
from cirl_marl.network.disturbances import AutoRegression, BlockBootstrap, Disturbance, Markov, Seasonal
from cirl_marl.network.rowsum import Floats

FEWEST = 10
"""Fewest rows beyond those that the trend and the seasons use up."""
MOST_REGIMES = 10
"""Most different values of a series that is taken for a chain."""
ROUNDS = 5
"""Rounds in which a regression settles whose rows are divided by the trend that it gives."""
DIGITS = 5
"""Significant digits of what is written."""
Errors = Mapping[str, float | tuple[float, ...]]


class FitOptions(NamedTuple):
    """What is estimated, and how; ``fit_disturbances`` says what each means."""

    kind: str = "ar1"
    logarithm: bool = True
    trend: str = "linear"
    unit: str = ""
    interval: str = ""
    seasons: int = 0

    @property
    def relative(self) -> bool:
        """Whether the series itself is divided by its trend."""
        return not self.logarithm and not self.unit


class Noise(NamedTuple):
    """A series without its trend and seasons."""

    estimate: Autoregression
    seasons: Floats
    """Of the logarithm, or relative to their mean, or in the unit, with a mean of 0 or 1; shape (seasons,)."""
    season_errors: Floats
    trend: tuple[float, float]
    """Change a row, relative or in the unit, and its error."""


class Estimate(NamedTuple):
    """A disturbance with the standard errors of its numbers, by field."""

    disturbance: Disturbance
    errors: Errors
    interval: tuple[float, float] | None = None
    """95 % interval of the deviation, if there is one, which is wider above in short series."""


def series_noise(column: Column, options: FitOptions) -> Noise:
    """Return what a column varies around its trend and seasons.

    A factor is of the series divided by its trend, so that regressors are divided by it, too, in a few rounds.

    Raises:
        CirlError: for a short or constant series, a value without logarithm, or noise that does not revert.
    """
    values, count, seasons = np.array(column.values), len(column.values), max(1, options.seasons)
    least = float(values.min())
    if not options.unit and (least < 0 or (options.logarithm and least == 0)):
        at = "" if column.times is None else f" at {time_text(column.times[int(values.argmin())])}"
        fault = "has no logarithm" if options.logarithm else "is no positive factor of a trend"
        remedy = ", or fit the values themselves (--plain)" if least == 0 else ""
        raise CirlError(f"{least:g}{at} {fault}; give a unit (--unit), so that noise is added{remedy}")
    regressors = [np.arange(count) % seasons == i for i in range(seasons)]
    if options.trend == "linear":
        regressors.append(np.arange(count) - (count - 1) / 2)
    fewest = max(FEWEST + len(regressors), 2 * options.seasons)
    if count < fewest:
        raise CirlError(f"{count} rows are too few; at least {fewest} are needed")
    design, series = np.column_stack(regressors).astype(float), np.log(values) if options.logarithm else values
    rest = series - design @ np.linalg.lstsq(design, series, rcond=None)[0]
    if np.ptp(rest) <= 1e-9 * np.abs(series).max():
        raise CirlError("does not vary around its trend")
    estimate = autoregression(series, design)
    for _ in range(ROUNDS if options.relative else 0):
        trend = design @ estimate.coefficients
        if trend.min() <= 0:
            remedy = "give a unit (--unit), so that noise is added"
            raise CirlError(f"its trend is {trend.min():.3g} at its lowest, of which there is no factor; {remedy}")
        estimate = autoregression(series / trend, design / trend[:, None])
    levels, errors = estimate.coefficients[:seasons], estimate.coefficient_errors[:seasons]
    slope = np.array([estimate.coefficients[-1], estimate.coefficient_errors[-1]]) * (options.trend == "linear")
    if options.logarithm:
        profile = np.exp(levels) / np.exp(levels).mean()
        return Noise(estimate, profile, errors * profile, tuple(slope.tolist()))
    if options.unit:
        return Noise(estimate, levels - levels.mean(), errors, tuple(slope.tolist()))
    level = levels.mean()
    return Noise(estimate, levels / level, errors / level, tuple((slope / level).tolist()))


def _persistence(noise: Noise, rows: float) -> tuple[float, float]:
    """Return φ of a control interval that is so many rows long, with its error."""
    phi, error = noise.estimate.persistence, noise.estimate.persistence_error
    if rows == 1.0:
        return phi, error
    if phi <= 0:
        raise CirlError(f"persistence {phi:.3g} is that of rows alone; leave out the interval")
    return phi**rows, error * rows * phi ** (rows - 1.0)


def _gaussian(noise: Noise, options: FitOptions, rows: float) -> tuple[dict[str, Any], Errors]:
    """Return the fields that reverting noise has, and their errors."""
    phi, error = _persistence(noise, rows)
    fields: dict[str, Any] = {"deviation": in_digits(noise.estimate.deviation), "persistence": in_digits(phi)}
    fields |= {"logarithm": options.logarithm, "unit": options.unit or "1"}
    return fields, {"deviation": noise.estimate.deviation_error, "persistence": error}


def _positive(process: Any, options: FitOptions) -> Any:
    """Return a process of which no factor is negative."""
    return process if options.unit or process.ends[0] >= 0 else replace(process, low=0.0)


def _ar1(noise: Noise, options: FitOptions, rows: float, _: float) -> Estimate:
    fields, errors = _gaussian(noise, options, rows)
    return Estimate(
        _positive(AutoRegression(mean=0.0 if options.unit else 1.0, **fields), options),
        errors,
        noise.estimate.deviation_interval,
    )


def _seasonal(noise: Noise, options: FitOptions, rows: float, spacing: float) -> Estimate:
    fields, errors = _gaussian(noise, options, rows)
    profile = tuple(map(in_digits, noise.seasons.tolist()))
    process = Seasonal(profile=profile, period=options.seasons * spacing, **fields)
    return Estimate(
        _positive(process, options),
        {**errors, "profile": tuple(noise.season_errors.tolist())},
        noise.estimate.deviation_interval,
    )


def _record(noise: Noise, options: FitOptions, rows: float, _: float) -> Estimate:
    if rows != 1.0:
        raise CirlError("a record has a row for each control interval; leave out the interval")
    residuals, phi = noise.estimate.residuals, noise.estimate.persistence
    if options.unit:
        record = residuals - residuals.mean()
    else:
        factors = np.exp(residuals) if options.logarithm else np.maximum(1.0 + residuals, 0.0)
        record = factors / factors.mean()
    block = max(1.0, len(record) ** (1 / 3) * (2 * abs(phi) / (1 - phi**2)) ** (2 / 3))
    # the derivative of ln block by φ is ⅔ (1 + φ²)/(φ (1 − φ²))
    slope = block * 2 / 3 * (1 + phi**2) / (abs(phi) * (1 - phi**2)) if block > 1 else 0.0
    process = BlockBootstrap(
        values=tuple(map(in_digits, record.tolist())), block=in_digits(block), unit=options.unit or "1"
    )
    errors = {"block": slope * noise.estimate.persistence_error}
    return Estimate(process, errors | {"deviation": noise.estimate.deviation_error}, noise.estimate.deviation_interval)


NOISE_KINDS: Mapping[str, Callable[[Noise, FitOptions, float, float], Estimate]] = {
    "ar1": _ar1,
    "resampled": _record,
    "seasonal": _seasonal,
}
"""Estimators of what is noise around a trend, by the kind that they estimate: from the noise, the options, the rows of
a control interval and the time between two rows."""


def estimated_chain(series: Floats, options: FitOptions, rows: float) -> Estimate:
    """Return the chain of the values of a series, with binomial errors of its counted transitions.

    Raises:
        CirlError: for too many different values, or one that is never left.
    """
    values, regimes = np.unique(series, return_inverse=True)
    if not 2 <= len(values) <= MOST_REGIMES:
        raise CirlError(f"{len(values)} different values: a chain has 2 to {MOST_REGIMES} regimes")
    if len(series) < FEWEST:
        raise CirlError(f"{len(series)} rows are too few; at least {FEWEST} are needed")
    counts = np.zeros((len(values), len(values)))
    np.add.at(counts, (regimes[:-1], regimes[1:]), 1.0)
    visits = counts.sum(axis=1)
    if (absorbing := visits == np.diag(counts)).any():
        raise CirlError(f"value {values[absorbing][0]:g} is never left, so that nothing says how long it lasts")
    shares = counts / visits[:, None]
    errors = np.sqrt(shares * (1.0 - shares) / visits[:, None])
    fields: dict[str, Any] = {"values": tuple(map(in_digits, values.tolist())), "unit": options.unit or "1"}
    if len(values) > 2:
        if rows != 1.0:
            raise CirlError("only of two regimes follows what they do in other intervals; leave out the interval")
        return Estimate(Markov(matrix=_matrix(shares), **fields), {"matrix": float(errors.max())})
    leave, memory = np.array([shares[0, 1], shares[1, 0]]), 1.0 - shares[0, 1] - shares[1, 0]
    if rows != 1.0 and memory <= 0:
        raise CirlError(f"its regimes alternate (1 − p − q = {memory:.3g}); leave out the interval")
    # what is remembered after a time is a power of it, and the stationary shares stay
    lengths = leave.sum() / leave / (1.0 - memory**rows) if rows != 1.0 else 1.0 / leave
    spreads = lengths * np.array([errors[0, 1], errors[1, 0]]) / leave
    chain = Markov(lengths=tuple(map(in_digits, np.maximum(lengths, 1.0).tolist())), **fields)
    return Estimate(chain, {"lengths": tuple(spreads.tolist())})


def _matrix(shares: Floats) -> tuple[tuple[float, ...], ...]:
    """Return probabilities in few digits whose rows still sum to 1."""
    table = shares.round(DIGITS)
    table[np.arange(len(table)), table.argmax(axis=1)] += 1.0 - table.sum(axis=1)
    return tuple(tuple(row) for row in table.round(DIGITS).tolist())


def time_text(moment: YearOrDate) -> str:
    """Return a time of a row as a table has it."""
    return f"{moment:.10g}" if isinstance(moment, float) else str(moment)


def in_digits(number: float) -> float:
    """Return a number in as many digits as are written."""
    return float(f"{number:.{DIGITS}g}")
