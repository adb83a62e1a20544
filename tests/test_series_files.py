"""Series in definition files: their forms, units and times, and what a mistake in one says."""

from __future__ import annotations

import json
import re
import tomllib
from pathlib import Path

import jsonschema
import pytest
from series_definition import CONSTANT, HALF, SOURCE, column, definition, written

from cirl_marl import DefinitionError, Series, load_network
from cirl_marl.network import Network
from cirl_marl.network.split_fractions import splits
from docs.site.schemas import network_schema

SHARED = f'control = {{ kind = "share", low = 0.1, neutral = 0.5, high = 0.9, unit = "1", {SOURCE} }}'


def inline(keys: str) -> str:
    """Return a flow in mt a year with these keys."""
    return f'{{ {keys}, unit = "Mt/year", {SOURCE} }}'


def read(folder: Path, text: str) -> Network:
    """Read a definition that lies beside its data; editors, too, must take it."""
    document = json.loads(json.dumps(tomllib.loads(text), default=str))
    jsonschema.validate(document, network_schema())
    return load_network(written(folder, text))


def refused(folder: Path, text: str) -> str:
    """Return what reading a definition says, each line of which names the file."""
    path = written(folder, text)
    with pytest.raises(DefinitionError) as raised:
        load_network(path)
    assert all(line.startswith(f"{path}: ") for line in str(raised.value).splitlines())
    return str(raised.value)


@pytest.mark.parametrize(
    ("flow", "start", "expected"),
    [
        (
            inline('times = [0, 24], values = [1, 2], time_unit = "month"'),
            "",
            Series(times=(0.0, 2.0), values=(1e3, 2e3)),
        ),
        (inline("times = [1990, 2000.5], values = [1, 2]"), "2000", Series(times=(-10.0, 0.5), values=(1e3, 2e3))),
        (
            inline('times = [0, 1], values = [1, 2], time_unit = "year"'),
            "2000",
            Series(times=(0.0, 1.0), values=(1e3, 2e3)),
        ),
        (
            inline("times = [2000-01-01, 2001-01-01], values = [1, 2]"),
            "2000",
            Series(times=(0.0, 1.0), values=(1e3, 2e3)),
        ),
        (
            inline('times = [2000, 2004], values = [1, 2], interpolation = "linear"'),
            "2000",
            Series(times=(0.0, 4.0), values=(1e3, 2e3), interpolation="linear"),
        ),
        (
            inline("times = [2000, 2001], values = [1, 2], until = 2004"),
            "2000",
            Series(times=(0.0, 1.0), values=(1e3, 2e3), until=4.0),
        ),
        (column(), "2000", Series(times=(0.0, 1.0, 2.0, 3.0), values=(10.0, 20.0, 30.0, 40.0), until=4.0)),
        (
            column('where = { country = "Japan" }, time_unit = "year", times = "kt"', name="year"),
            "",
            "begins at 10, after the episode",
        ),
        (column('where = { country = "China", year = "2002" }'), "", 3.0),
        (CONSTANT, "", 10.0),
    ],
)
@pytest.mark.sample(4)
def test_forms_of_a_flow(tmp_path: Path, flow: str, start: str, expected: Series | float | str) -> None:
    """In the file's units, on a clock of its own or on the calendar, in the file or in one beside it."""
    text = definition(flow, start=start)
    if isinstance(expected, str):
        assert expected in refused(tmp_path, text)
    else:
        assert read(tmp_path, text).arcs[0].flow == expected


def test_times_of_a_network_in_days(tmp_path: Path) -> None:
    """Dates are counted in days; years are of 365.25 days."""
    flow = inline("times = [2020-02-28, 2020-03-01], values = [1, 2]")
    text = definition(flow, start="2020-02-28").replace('time = "year"', 'time = "day"')
    assert read(tmp_path, text).arcs[0].flow == Series(times=(0.0, 2.0), values=(1e3 / 365.25, 2e3 / 365.25))
    years = text.replace("[2020-02-28, 2020-03-01]", "[2020, 2021]").replace("start = 2020-02-28", "start = 2020")
    found = read(tmp_path, years).arcs[0].flow
    assert isinstance(found, Series)
    assert found.times == (0.0, 365.25)


def test_bounds_of_a_control_take_its_unit(tmp_path: Path) -> None:
    """A number, a series and a column, all in the unit of the control."""
    low = 'low = { times = [0, 1], values = [10, 20], time_unit = "year" }'
    neutral = 'neutral = { file = "ores.csv", column = "kt", where = { country = "Japan" } }'
    sold = SHARED.replace("low = 0.1", low).replace("neutral = 0.5", neutral).replace('"1"', '"percent"')
    control = read(tmp_path, definition(start="2000", sold=sold.replace("high = 0.9", "high = 90"))).arcs[1].control
    assert control is not None
    assert control.low == Series(times=(0.0, 1.0), values=(0.1, 0.2))
    assert control.neutral == Series(times=(0.0, 1.0, 2.0, 3.0), values=(0.1, 0.2, 0.3, 0.4), until=4.0)
    assert control.high == pytest.approx(0.9)


def test_the_rest_of_a_share(tmp_path: Path) -> None:
    """Is said or left out; nothing else may stand there, and only shares take it."""
    text = definition()
    assert read(tmp_path, text).arcs[2].share is None
    assert read(tmp_path, text.replace('share = "rest"', "")) == read(tmp_path, text)
    wrong = refused(tmp_path, text.replace('"rest"', '"rst"'))
    assert "arcs.lost.share: unknown value 'rst'. Did you mean 'rest'? Known: rest." in wrong
    wrong = refused(tmp_path, text.replace(HALF, "share = 0.5"))
    assert "arcs.sold.share: must be a table { value = …, unit = …, source = … }, got 0.5" in wrong
    wrong = refused(tmp_path, definition('"rest"'))
    assert "arcs.ore.flow: must be a table { value = …, unit = …, source = … }, got 'rest'" in wrong
    flow = f"flow = {CONSTANT}"
    for share in ('"rest"', HALF.removeprefix("share = ")):
        wrong = refused(tmp_path, text.replace(flow, f"{flow}\nshare = {share}"))
        assert "arcs.ore.share: law 'exogenous' takes none; shares need law = \"share\"" in wrong


@pytest.mark.parametrize(
    ("flow", "start", "said"),
    [
        (inline("times = [0], value = [1]"), "2000", ["flow.values: missing", "unknown key 'value'. Did you mean 'v"]),
        (
            inline("times = [0], values = [true]"),
            "2000",
            ["arcs.ore.flow.values, entry 1: ", "must be a number, got True"],
        ),
        (
            inline('times = ["2000"], values = [1]'),
            "2000",
            ["times, entry 1: must be a number, such as the year 2000"],
        ),
        (
            inline("times = [2000-01-01T00:00:00], values = [1]"),
            "2000",
            ["times, entry 1: must be a number, such as"],
        ),
        (
            inline('times = [0], values = [1], interpolation = "linaer"'),
            "2000",
            ["flow.interpolation: unknown value 'linaer'. Did you mean 'linear'? Known: step, linear."],
        ),
        (
            inline("times = [2000], values = [1]"),
            "",
            ["arcs.ore.flow: times are years or dates only if the episode has a start; give a time_unit"],
        ),
        (
            inline('times = [2000-01-01], values = [1], time_unit = "year"'),
            "2000",
            ["arcs.ore.flow: 2000-01-01 is a date, which takes no time_unit; leave it out"],
        ),
        (inline('times = [0], values = [1], time_unit = "kg"'), "", ["arcs.ore.flow: unit 'kg' is inconsistent"]),
        (inline('times = [0, 1], values = [1], time_unit = "year"'), "", ["'ore': flow: series has 2 times and 1"]),
        (inline("times = [2001], values = [1]"), "2000", ["series begins at 1 (2001), after the episode does"]),
        (
            inline('times = [2000, 2002], values = [1, 2], interpolation = "linear"'),
            "2000",
            ["arc 'ore': flow: series ends at 2 (2002), but the episode at 4 (2004); give what is missing"],
        ),
        (CONSTANT.replace("year", "kg"), "", ["arcs.ore.flow: unit 'kt/kg' is inconsistent"]),
    ],
)
def test_a_mistake_in_a_series_is_named(tmp_path: Path, flow: str, start: str, said: list[str]) -> None:
    """By key and value, with what to do."""
    message = refused(tmp_path, definition(flow, start=start))
    for fragment in said:
        assert fragment in message


@pytest.mark.parametrize(
    ("start", "said"),
    [
        (
            "true",
            "episode.start: must be a number, such as the year 2000 or 2000.5, or a date, as 2020-03-01, got True",
        ),
        ('"2000"', "episode.start: must be a number, such as the year 2000 or 2000.5, or a date"),
        ("0", "episode: start must be a calendar year such as 2000 or 2000.5, or a date, got 0"),
        ("9997", "episode: it ends in the year 10001, after the calendar; is control_interval in another unit?"),
    ],
)
def test_a_mistake_in_the_start_is_named(tmp_path: Path, start: str, said: str) -> None:
    """No calendar has it."""
    assert said in refused(tmp_path, definition(start=start))


def test_the_old_key_of_a_series(tmp_path: Path) -> None:
    """Says what to write now, and nothing besides."""
    flow = inline('times = [0], values = [1], time_unit = "year"')
    old = definition(flow).replace(f"flow = {flow}", f"series = {flow}")
    assert "series = " in old
    now = "write flow = { times = […], values = […], time_unit = …, unit = …, source = … }"
    assert refused(tmp_path, old) == f"{tmp_path / 'ores.toml'}: arcs.ore.series: {now}"


def test_a_scenario_replaces_a_series_whole(tmp_path: Path) -> None:
    """And so a bound of a control, which has no source of its own."""
    low = 'low = { times = [0, 1], values = [10, 20], time_unit = "year" }'
    sold = f'control = {{ kind = "share", {low}, neutral = 50, high = 90, unit = "percent", {SOURCE} }}'
    more = f"""
[scenarios.other.arcs.ore]
flow = {inline('times = [0], values = [7], time_unit = "year"')}
[scenarios.other.arcs.sold.control]
low = {{ file = "ores.csv", column = "kt", where = {{ country = "China", year = "2000" }} }}
"""
    network = read(tmp_path, definition(column(), start="2000", sold=sold, more=more))
    other = network.scenario("other")
    assert other.arcs[0].flow == Series(times=(0.0,), values=(7e3,))
    before, after = network.arcs[1].control, other.arcs[1].control
    assert before is not None and after is not None
    assert isinstance(before.low, Series)
    assert after.low == pytest.approx(0.01)
    assert dict(network.data_sha256) == dict(other.data_sha256) != {}


def test_shares_of_the_guide(tmp_path: Path) -> None:
    """The split that docs/yearly_networks.md works out."""
    guide = (Path(__file__).parent.parent / "docs" / "yearly_networks.md").read_text(encoding="utf-8")
    section = guide.split("## Shares")[1].split("\n## ")[0]
    lines = re.findall(r"^    (.*)$", section, re.M)
    *arcs, control = lines
    assert control.startswith('control = { kind = "share"')
    nodes = "".join(f'[nodes.{name}]\nrole = "technosphere"\nstores = false\n' for name in ("smelter", "abroad"))
    nodes = nodes.replace("stores = false", f'initial = {{ low = 0, high = 0, unit = "kt", {SOURCE} }}')
    text = definition().split("[arcs.sold]")[0].replace("nodes.dump", "nodes.landfill") + nodes + "\n".join(arcs)
    (split,) = splits(read(tmp_path, text))
    assert split.proportions[:, 0] == pytest.approx([0.12, 0.05, 0.83])
    share = next(line for line in arcs if line.startswith("share = { value = 0.12"))
    (split,) = splits(read(tmp_path, text.replace(share, control)))
    assert 0.6 * split.proportions[:, 0] == pytest.approx([0.034, 0.566], abs=5e-4)
