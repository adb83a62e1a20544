"""Disturbances estimated from tables: known ones are found again within their errors, and bad tables are named."""

from __future__ import annotations

import csv
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal, stats
from small_networks import small
from typer.testing import CliRunner

from cirl_marl import CirlError, fit_disturbances, load_network, write_network
from cirl_marl.cli import app
from cirl_marl.importing.autoregression import Autoregression, autoregression
from cirl_marl.network.disturbances import AutoRegression, BlockBootstrap, Markov, Seasonal

Floats = NDArray[np.float64]


def reverting(persistence: float, noise: Floats) -> Floats:
    """Return z with z_{t+1} = φ z_t + √(1 − φ²) ε_t along the last axis, stationary from the start."""
    scaled = noise * np.sqrt(1 - persistence**2)
    scaled[..., 0] = noise[..., 0]
    return np.asarray(signal.lfilter([1.0], [1.0, -persistence], scaled))


def write(path: Path, columns: Mapping[str, Sequence[object] | Floats], times: Sequence[object] = ()) -> Path:
    """Write columns of a table, years from 1950 on if there are no other times."""
    rows = zip(times or range(1950, 1950 + len(next(iter(columns.values())))), *columns.values(), strict=True)
    with path.open("w", newline="") as file:
        csv.writer(file).writerows([("year", *columns), *rows])
    return path


@pytest.mark.parametrize(("count", "persistence"), [(120, 0.6), (200, 0.85), (120, -0.4)])
@pytest.mark.sample(1)
def test_noise_around_a_trend_is_found_within_its_errors(count: int, persistence: float) -> None:
    """Of many series: right on average, and two errors hold the truth some 95, of deviations 87 times in 100."""
    deviation, slope = 0.3, 0.01
    noise = np.random.default_rng(0).standard_normal((300, count))
    time = np.arange(count) - (count - 1) / 2
    series = 2.0 + slope * time + deviation * reverting(persistence, noise)
    design = np.column_stack([np.ones(count), time])
    estimates = [autoregression(row, design) for row in series]
    truth = {"persistence": persistence, "deviation": deviation}
    for name, value in truth.items():
        found = np.array([getattr(estimate, name) for estimate in estimates])
        errors = np.array([getattr(estimate, f"{name}_error") for estimate in estimates])
        assert 0.86 < np.mean(np.abs(found - value) < 1.96 * errors) < 0.99
        assert abs(found.mean() - value) < 0.03 * abs(value) + 3 * found.std() / np.sqrt(300)
        assert np.median(errors) == pytest.approx(found.std(), rel=0.25)
    slopes = np.array([(e.coefficients[1], e.coefficient_errors[1]) for e in estimates])
    assert 0.87 < np.mean(np.abs(slopes[:, 0] - slope) < 1.96 * slopes[:, 1]) < 0.98


@pytest.mark.parametrize(("count", "persistence"), [(25, 0.8), (25, 0.3), (60, 0.8)])
@pytest.mark.medium
@pytest.mark.sample(1)
def test_intervals_of_deviations_hold_in_short_series(count: int, persistence: float) -> None:
    """Of many series around a trend, all but some 5 in 100 hold the truth, which standard errors do not."""
    rng, found = np.random.default_rng(11), list[Autoregression]()
    design = np.column_stack([np.ones(count), np.arange(float(count))])
    while len(found) < 250:
        try:
            found.append(autoregression(reverting(persistence, rng.normal(size=count)), design))
        except CirlError:  # looks like a random walk
            continue
    low, high = np.array([estimate.deviation_interval for estimate in found]).T
    assert 0.91 < np.mean((low < 1) & (high > 1)) < 0.99
    best = np.array([estimate.deviation for estimate in found])
    assert (low < best).all() and (best < high).all() and np.mean(high / best > best / low) > 0.9


def test_the_likelihood_is_that_of_what_the_regression_leaves() -> None:
    """Its maximum is where that of contrasts is, a normal distribution with the covariance of the noise."""
    count = 40
    rng = np.random.default_rng(3)
    design = np.column_stack([np.ones(count), np.arange(count), rng.normal(size=count)])
    series = reverting(0.7, rng.standard_normal(count)) + design @ [1.0, 0.1, 2.0]
    contrasts = np.linalg.svd(design)[0][:, 3:].T  # orthogonal to the regressors
    estimate = autoregression(series, design)
    lags = np.abs(np.subtract.outer(np.arange(count), np.arange(count)))

    def likelihood(persistence: float, deviation: float) -> float:
        covariance = contrasts @ (deviation**2 * persistence**lags) @ contrasts.T
        return float(stats.multivariate_normal.logpdf(contrasts @ series, cov=covariance))

    best = likelihood(estimate.persistence, estimate.deviation)
    for change in (1e-3, -1e-3):
        assert likelihood(estimate.persistence + change, estimate.deviation) < best
        assert likelihood(estimate.persistence, estimate.deviation + change) < best
    weights = np.linalg.inv(estimate.deviation**2 * estimate.persistence**lags)
    normal = design.T @ weights @ design
    np.testing.assert_allclose(estimate.coefficients, np.linalg.solve(normal, design.T @ weights @ series))
    np.testing.assert_allclose(estimate.coefficient_errors, np.sqrt(np.diag(np.linalg.inv(normal))), rtol=1e-6)


def test_columns_that_vary_together_and_their_definition(tmp_path: Path) -> None:
    """Factors around a trend of percents; correlations of what drives them; what is printed is read back."""
    root = np.linalg.cholesky([[1.0, 0.6], [0.6, 1.0]])
    noise = np.random.default_rng(5).standard_normal((400, 2)) @ root.T
    years = np.arange(400)
    price = 80 * np.exp(0.01 * years + 0.3 * reverting(0.8, noise[:, 0].copy()))
    demand = 20 * np.exp(-0.005 * years + 0.1 * reverting(0.5, noise[:, 1].copy()))
    table = write(tmp_path / "prices.csv", {"Copper price": price, "demand": demand})
    fits = fit_disturbances(table, ["Copper price", "demand"], source="made up")
    assert [*fits.disturbances] == ["copper_price", "demand"]
    for name, truth in (("copper_price", (0.3, 0.8)), ("demand", (0.1, 0.5))):
        found, errors = fits.disturbances[name], fits.errors[name]
        assert isinstance(found, AutoRegression) and found.logarithm and found.mean == 1.0 and found.unit == "1"
        for value, field in zip(truth, ("deviation", "persistence"), strict=True):
            assert abs(getattr(found, field) - value) < 2.5 * float(np.max(errors[field]))
    assert fits.trends["demand"][0] == pytest.approx(-0.005, abs=2.5 * fits.trends["demand"][1])
    assert fits.correlation is not None
    assert abs(fits.correlation.matrix[0][1] - 0.6) < 2.5 * fits.correlation_errors[0, 1] < 0.1
    path = tmp_path / "line.toml"
    write_network(small({"store": 1.0}, []), path)
    command = ["fit", str(table), "--column", "Copper price", "--column", "demand"]
    shown = CliRunner().invoke(app, command)
    assert shown.exit_code == 0, shown.output
    assert "demand: 400 rows, 1950 to 2349; its trend, which is left out, is -0.4" in shown.stderr
    hazards = CliRunner().invoke(app, [*command, "--kind", "resampled", "--scenario", "hazards"])
    other, text = tmp_path / "other.toml", path.read_text()
    path.write_text(f"{text}\n{shown.stdout}")
    other.write_text(f"{text}\n{hazards.stdout}")
    network = load_network(path)
    assert network.disturbances == fits.disturbances and network.correlation == fits.correlation
    record = load_network(other, scenario="hazards").disturbances["demand"]
    assert isinstance(record, BlockBootstrap) and np.std(record.values) == pytest.approx(0.1, abs=0.03)
    text = tomllib.loads(fits.tables())["disturbances"]["demand"]["source"]
    assert text.startswith("cirl fit prices.csv --column 'Copper price' --column demand (made up); 400 rows, 1950 to")
    assert f"persistence ± {fits.errors['demand']['persistence']:.2g}" in text
    assert text.endswith("95 % of deviation: {:.2g} to {:.2g}".format(*fits.intervals["demand"]))
    estimate = autoregression(np.log(demand), np.column_stack([np.ones(400), years - years.mean()]))
    assert fits.intervals["demand"] == pytest.approx(estimate.deviation_interval, rel=1e-6)


def test_factors_and_summands_of_the_values_themselves(tmp_path: Path) -> None:
    """A factor varies in proportion to its trend; a summand by as much at all times."""
    years = np.arange(300)
    noise = reverting(0.7, np.random.default_rng(2).standard_normal(300))
    level = 10 + 0.2 * years
    table = write(tmp_path / "t.csv", {"relative": level * (1 + 0.15 * noise), "absolute": level + 4 * noise - 50})
    (factor,) = fit_disturbances(table, ["relative"], logarithm=False).disturbances.values()
    added = fit_disturbances(table, ["absolute"], unit="kt/year")
    (summand,) = added.disturbances.values()
    assert isinstance(factor, AutoRegression) and isinstance(summand, AutoRegression)
    assert (factor.mean, factor.unit, summand.mean, summand.unit) == (1.0, "1", 0.0, "kt/year")
    assert factor.deviation == pytest.approx(0.15, rel=0.2) and summand.deviation == pytest.approx(4.0, rel=0.2)
    assert factor.persistence == pytest.approx(0.7, abs=0.1) == summand.persistence
    assert added.trends["absolute"][0] == pytest.approx(0.2, abs=0.03)
    halves = fit_disturbances(table, ["relative"], logarithm=False, interval="6 month")
    half, ends = halves.disturbances["relative"], [factor.persistence + e for e in (-1e-3, 1e-3)]
    slope = np.diff(np.sqrt(ends))[0] / 2e-3
    whole = fit_disturbances(table, ["relative"], logarithm=False).errors["relative"]["persistence"]
    assert halves.errors["relative"]["persistence"] == pytest.approx(slope * np.max(whole), rel=1e-4)
    assert isinstance(half, AutoRegression) and half.persistence == pytest.approx(factor.persistence**0.5, abs=1e-4)
    wild = write(tmp_path / "w.csv", {"x": np.abs(1 + 0.6 * noise)})
    assert fit_disturbances(wild, ["x"], logarithm=False).disturbances["x"].ends[0] == 0.0


def test_residuals_are_resampled_in_blocks(tmp_path: Path) -> None:
    """The record is what varies, with a mean of 1; blocks are longer the longer it remembers."""
    noise = reverting(0.8, np.random.default_rng(7).standard_normal(500))
    table = write(tmp_path / "t.csv", {"x": np.exp(0.02 * np.arange(500) + 0.2 * noise)})
    fits = fit_disturbances(table, ["x"], kind="resampled")
    record = fits.disturbances["x"]
    assert isinstance(record, BlockBootstrap)
    values = np.array(record.values)
    assert values.mean() == pytest.approx(1.0, abs=1e-5)
    np.testing.assert_allclose(np.log(values) - np.log(values).mean(), 0.2 * (noise - noise.mean()), atol=0.1)
    error = fits.errors["x"]["block"]
    assert isinstance(error, float) and abs(record.block - 500 ** (1 / 3) * (1.6 / 0.36) ** (2 / 3)) < 2.5 * error
    short = write(tmp_path / "s.csv", {"x": np.random.default_rng(1).uniform(1, 2, 100)})
    (white,) = fit_disturbances(short, ["x"], kind="resampled").disturbances.values()
    assert isinstance(white, BlockBootstrap) and white.block < 4


def test_seasons_are_found_within_their_errors(tmp_path: Path) -> None:
    """Of monthly factors, in the mean of their logarithms, with the noise that reverts to them."""
    profile, found, errors = np.array([0.7, 1.3, 1.1, 0.9]), [], []
    times = [f"{2000 + i // 4}-{1 + 3 * (i % 4):02}-01" for i in range(240)]
    for seed in range(40):
        noise = reverting(0.5, np.random.default_rng(seed).standard_normal(240))
        table = write(tmp_path / "t.csv", {"x": np.tile(profile, 60) * np.exp(0.2 * noise)}, times)
        fits = fit_disturbances(table, ["x"], kind="seasonal", seasons=4)
        season = fits.disturbances["x"]
        assert isinstance(season, Seasonal) and season.period == 12.0 and fits.time_unit == "month"
        found.append(season.profile)
        errors.append(fits.errors["x"]["profile"])
        assert season.deviation == pytest.approx(0.2, abs=0.04)
    assert 0.85 < np.mean(np.abs(np.array(found) - profile) < 1.96 * np.array(errors)) <= 1.0
    assert 'period = {value = 12.0, unit = "month", source = "cirl fit' in fits.tables()


def test_regimes_are_counted(tmp_path: Path) -> None:
    """Mean lengths within their errors; in other intervals the stationary shares stay; three regimes have a matrix."""
    chain = Markov(values=(0.2, 1.0), lengths=(4.0, 12.0))
    covered = []
    for seed in range(60):
        rng, regime, series = np.random.default_rng(seed), 1, []
        for _ in range(600):
            regime = int(rng.choice(2, p=chain.transitions[regime]))
            series.append(chain.values[regime])
        table = write(tmp_path / "t.csv", {"runs": series})
        fits = fit_disturbances(table, ["runs"], kind="markov")
        found, errors = fits.disturbances["runs"], fits.errors["runs"]["lengths"]
        assert isinstance(found, Markov) and found.values == chain.values
        covered.append(np.abs(np.subtract(found.lengths, chain.lengths)) < 1.96 * np.array(errors))
    assert np.mean(covered) > 0.87
    (half,) = fit_disturbances(table, ["runs"], kind="markov", interval="0.5 year").disturbances.values()
    (whole,) = fit_disturbances(table, ["runs"], kind="markov").disturbances.values()
    assert isinstance(half, Markov) and isinstance(whole, Markov)
    np.testing.assert_allclose(half.transitions @ half.transitions, whole.transitions, atol=1e-4)
    table = write(tmp_path / "three.csv", {"runs": [0, 1, 2, 2, 1, 0, 0, 1, 1, 0, 2, 1]})
    (three,) = fit_disturbances(table, ["runs"], kind="markov").disturbances.values()
    assert isinstance(three, Markov) and not list(three.problems())
    np.testing.assert_allclose(
        three.matrix, [[1 / 4, 1 / 2, 1 / 4], [1 / 2, 1 / 4, 1 / 4], [0, 2 / 3, 1 / 3]], atol=1e-5
    )


RISING = np.exp(0.1 * np.arange(30) + np.random.default_rng(0).normal(0, 0.1, 30))


@pytest.mark.parametrize(
    ("series", "options", "message"),
    [
        ([1.0, 2.0, 3.0], {}, "column 'x': 3 rows are too few; at least 12 are needed"),
        ([*RISING[:4], 0.0, *RISING[5:]], {}, r"0 at 1954 has no logarithm; .* \(--plain\)"),
        ([*RISING[:4], -2.0, *RISING[5:]], {}, "-2 at 1954 has no logarithm; give a unit"),
        ([*RISING[:4], "", *RISING[5:]], {}, "line 6, column 'x': '' is empty"),
        ([*RISING[:4], "n/a", *RISING[5:]], {}, "line 6, column 'x': 'n/a' is no number"),
        ([3.0] * 30, {}, "does not vary around its trend"),
        (np.exp(0.1 * np.arange(30)), {}, "does not vary around its trend"),
        (RISING, {"trend": "none"}, "does not revert to its mean, persistence 0.995 and beyond; random_walk"),
        (RISING, {"kind": "random_walk"}, "unknown kind to fit 'random_walk'. .*Known: ar1, resampled"),
        (RISING, {"trend": "lineal"}, "Did you mean 'linear'"),
        (RISING, {"kind": "seasonal"}, "seasons 0: kind 'seasonal' needs at least 2"),
        (RISING, {"seasons": 4}, "seasons 4: .* the others none"),
        (RISING, {"kind": "markov"}, "30 different values: a chain has 2 to 10 regimes"),
        ([1.0] * 20 + [0.0] * 5, {"kind": "markov"}, "value 0 is never left"),
        (RISING, {"kind": "resampled", "interval": "1 month"}, "a row for each control interval"),
        (RISING, {"interval": "0 year"}, "interval '0 year': write a number and a unit of time"),
        (RISING, {"interval": "3"}, "interval '3': write a number and a unit of time, .*unit '1' is inconsistent"),
        (RISING, {"times": "yer"}, "unknown column 'yer'. Did you mean 'year'"),
    ],
)
def test_tables_that_tell_nothing_are_named(
    series: Sequence[Any], options: dict[str, Any], message: str, tmp_path: Path
) -> None:
    """By file, column and time, with what to do."""
    with pytest.raises(CirlError, match=message):
        fit_disturbances(write(tmp_path / "t.csv", {"x": series}), ["x"], **options)


def test_gaps_and_rows(tmp_path: Path) -> None:
    """A year that is left out is named; long tables are read by conditions."""
    years = [*range(1950, 1960), *range(1962, 1982)]
    with pytest.raises(CirlError, match="from 1959 to 1962 it is 3 year, elsewhere 1; fill the gap"):
        fit_disturbances(write(tmp_path / "t.csv", {"x": RISING}, years), ["x"])
    with pytest.raises(CirlError, match="two columns would give a disturbance called 'x_1'"):
        fit_disturbances(write(tmp_path / "t.csv", {"x 1": RISING, "X_1": RISING}), ["x 1", "X_1"])
    columns = {"Fläche": RISING, "2°": RISING}
    assert [*fit_disturbances(write(tmp_path / "t.csv", columns), [*columns]).disturbances] == ["flache", "series_2"]
    table = tmp_path / "long.csv"
    rows = [
        (place, year, value)
        for place in ("a", "b")
        for year, value in enumerate(RISING[::-1] if place == "b" else RISING)
    ]
    with table.open("w", newline="") as file:
        csv.writer(file).writerows([("place", "day", "x"), *rows])
    command = ["fit", str(table), "--column", "x", "--times", "day", "--where"]
    shown = CliRunner().invoke(app, [*command, "place=b"])
    assert shown.exit_code == 0 and "--where place=b --times day; 30 rows, 0 to 29" in shown.stdout
    with pytest.raises(CirlError, match="--where b: needs COLUMN=TEXT"):
        CliRunner().invoke(app, [*command, "b"], catch_exceptions=False)
