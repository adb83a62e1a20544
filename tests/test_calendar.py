"""Years and dates: from elapsed time and back, in infos, tables and pictures."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from datetime import date
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from matplotlib.figure import Figure
from series_definition import column, definition, written

from cirl_marl import Episode, Network, NetworkError, Node, load_network, parallel_env, vector_env
from cirl_marl import simulate as simulated
from cirl_marl.cli.episodes import plan, simulate
from cirl_marl.network.calendar import YearOrDate, elapsed_time, labels, year, years
from cirl_marl.report import curves

SOLD = 'control = { kind = "share", low = 0.1, neutral = 0.5, high = 0.9, unit = "1", source = "x" }'


def network(start: YearOrDate | None, unit: str, interval: float = 1.0) -> Network:
    """Return a network with this clock."""
    episode = Episode(control_interval=interval, horizon=4, start=start)
    return Network(name="x", nodes=(Node(id="a", initial=(1, 1)),), arcs=(), time_unit=unit, episode=episode)


@pytest.mark.parametrize(
    ("start", "unit", "interval", "header", "expected"),
    [
        (2000, "year", 1.0, "year", ["2000", "2001", "2002"]),
        (1999.5, "year", 0.25, "year", ["1999.5", "1999.75", "2000"]),
        (date(2000, 1, 1), "year", 5.0, "year", ["2000", "2005", "2010"]),
        (2000, "month", 3.0, "year", ["2000", "2000.25", "2000.5"]),
        (2000, "day", 1.0, "date", ["2000-01-01", "2000-01-02", "2000-01-03"]),
        (date(2020, 2, 28), "day", 1.0, "date", ["2020-02-28", "2020-02-29", "2020-03-01"]),
        (date(2020, 2, 28), "week", 1.0, "date", ["2020-02-28", "2020-03-06", "2020-03-13"]),
        (date(2020, 2, 28), "hour", 18.0, "date", ["2020-02-28 00:00", "2020-02-28 18:00", "2020-02-29 12:00"]),
        (2000.5, "day", 1.0, "date", ["2000-07-01 15:00", "2000-07-02 15:00", "2000-07-03 15:00"]),
    ],
)
def test_labels(start: YearOrDate, unit: str, interval: float, header: str, expected: list[str]) -> None:
    """Years for units of a month or more, dates for others, with the hour where it is not midnight."""
    assert labels(network(start, unit), np.arange(3) * interval) == ([header], [expected])
    assert labels(network(None, unit), np.arange(3) * interval) == ([], [])


@given(
    begins=st.dates(date(1900, 1, 1), date(2100, 1, 1)),
    then=st.dates(date(1900, 1, 1), date(2100, 1, 1)),
    unit=st.sampled_from(["day", "week", "hour"]),
)
def test_there_and_back(begins: date, then: date, unit: str) -> None:
    """A date is read as the time that is called by that date."""
    assert labels(network(begins, unit), elapsed_time(then, begins, unit))[1][0] == [then.isoformat()]


@given(st.floats(1900, 2100), st.floats(1900, 2100), st.sampled_from(["year", "month", "day", "s"]))
def test_years_there_and_back(begins: float, then: float, unit: str) -> None:
    """Likewise years, whatever the unit."""
    assert years(network(begins, unit), elapsed_time(then, begins, unit)) == pytest.approx(then, abs=1e-9)


def test_years_of_dates() -> None:
    """Increase, begin with the whole number on New Year's Day, and stay within it."""
    days = [date.fromordinal(day) for day in range(date(2019, 1, 1).toordinal(), date(2022, 1, 1).toordinal())]
    found = [year(day) for day in days]
    assert found == sorted(set(found))
    assert [int(each) for each in found] == [day.year for day in days]
    assert year(date(2020, 1, 1)) == 2020.0


@pytest.mark.parametrize("start", [True, 0, float("nan"), 10_000, "2000", date(9999, 1, 1)])
def test_what_is_no_start(start: object) -> None:
    """Is refused with what would be one."""
    with pytest.raises(NetworkError, match=r"episode: start must be a calendar year such as 2000 or 2000\.5, or a da"):
        Episode(start=start)  # type: ignore[arg-type]


def test_an_episode_ends_on_the_calendar() -> None:
    """Or its clock is in the wrong unit."""
    with pytest.raises(NetworkError, match=r"episode: it ends in the year 12000, after the calendar; is control_in"):
        network(2000, "year", interval=2500.0)


def test_infos_have_the_year_at_the_end_of_the_step(tmp_path: Path) -> None:
    """In every view and copy, also where another episode has begun within the step; only with a start."""
    path = written(tmp_path, definition(column(), start="2000.5", sold=SOLD).replace("value = 4", "value = 3"))
    env = parallel_env(path)
    env.reset(seed=0)
    seen = [env.step({"sold": [0.0]})[-1]["sold"]["year"] for _ in range(3)]
    assert seen == [2001.5, 2002.5, 2003.5]
    assert all(type(each) is float for each in seen)
    batch = vector_env(path, num_envs=2)
    batch.reset(seed=0)
    for expected in (*seen, seen[0]):
        infos = batch.step({"sold": np.zeros((2, 1))})[-1]
        np.testing.assert_array_equal(infos["sold"]["year"], [expected] * 2)
    other = parallel_env(written(tmp_path, definition(sold=SOLD)))
    other.reset(seed=0)
    assert "year" not in other.step({"sold": [0.0]})[-1]["sold"]


def rows(path: Path, columns: Sequence[str]) -> list[list[str]]:
    """Return these columns of a CSV file."""
    with path.open(newline="") as file:
        return [[row[name] for name in columns] for row in csv.DictReader(file)]


@pytest.mark.parametrize(
    ("unit", "start", "header", "dates"),
    [
        ("year", "2000", "year", ["2000", "2001", "2002", "2003", "2004"]),
        ("day", "2020-02-28", "date", ["2020-02-28", "2020-02-29", "2020-03-01", "2020-03-02", "2020-03-03"]),
    ],
)
@pytest.mark.sample(1)
def test_tables_have_years_or_dates(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, unit: str, start: str, header: str, dates: list[str]
) -> None:
    """Of the end of an interval in a simulation, whose first row is the start; of its beginning in a plan."""
    monkeypatch.chdir(tmp_path)
    text = definition(start=start, sold=SOLD)
    text = text.replace('time = "year"', f'time = "{unit}"').replace('1, unit = "year"', f'1, unit = "{unit}"')
    path = written(tmp_path, text)
    simulate(str(path), out=tmp_path)
    found = rows(tmp_path / "ores_neutral.csv", [f"time ({unit})", f"{header} at the end"])
    assert found == [[f"{float(i)}", each] for i, each in enumerate(dates)]
    plan(str(path), control="neutral", out=tmp_path / "plan.csv")
    begins = [[f"{i}", f"{i + 1}", each] for i, each in enumerate(dates[:-1])]
    assert rows(tmp_path / "plan.csv", [f"from ({unit})", f"to ({unit})", f"{header} at the start"]) == begins
    written(tmp_path, definition(sold=SOLD))
    simulate(str(path), out=tmp_path)
    assert "year at the end" not in (tmp_path / "ores_neutral.csv").read_text().splitlines()[0].split(",")


def test_axes_show_years(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """From the start of the episode to its end; without a start the time that has elapsed."""
    figures: list[Figure] = []
    monkeypatch.setattr(curves, "save", lambda figure, path: figures.append(figure))
    for start, label, ends in ((2000, "year", (2000.0, 2003.0)), (None, "time / year", (0.0, 3.0))):
        simulation, time = simulated(network(start, "year"), steps=3), np.arange(1.0, 4.0)
        curves.save_trajectory(tmp_path / "x.png", simulation)
        axes = figures[-1].axes[-1]
        assert axes.get_xlabel() == label
        assert axes.get_xlim() == ends
        means = np.asarray(figures[-1].axes[2].lines[0].get_xdata(), dtype=np.float64)
        np.testing.assert_allclose(means, ends[0] + time - 0.5)  # in the middle of their intervals
        curves.save_circularity(tmp_path / "x.png", simulation.network, {"neutral": simulation.rollout})
        assert figures[-1].axes[-1].get_xlabel() == label
        assert figures[-1].axes[-1].get_xlim() == (ends[0] + 0.5, ends[1] - 0.5)  # means stand in the middle


def test_a_network_keeps_its_start(tmp_path: Path) -> None:
    """A date stays one."""
    assert load_network(written(tmp_path, definition(start="2020-02-28"))).episode.start == date(2020, 2, 28)
