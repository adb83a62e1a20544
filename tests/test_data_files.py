"""Data files beside a definition: what a mistake in one says, how often one is read, and how one travels."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import os
import random
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from series_definition import CSV, column, definition, written

from cirl_marl import CirlError, DefinitionError, RunError, Series, load_network
from cirl_marl.definitions import data_files
from cirl_marl.definitions.reader import Definition
from cirl_marl.evaluation.figures import provenance
from cirl_marl.learners.interface import train
from cirl_marl.learners.recipe import Recipe
from cirl_marl.learners.run_directory import RunDirectory

JAPAN = 'where = { country = "Japan" }'
IN_JAPAN = "ores.csv, column 'kt', where country = 'Japan'"


@pytest.mark.parametrize(
    ("flow", "csv", "said"),
    [
        (
            column(file="ore.csv"),
            CSV,
            "file 'ore.csv': is not there; unknown file in FOLDER 'ore.csv'. Did you mean 'ores.csv'? Known: ores.csv.",
        ),
        (
            column(file="../ores.csv"),
            CSV,
            "file '../ores.csv': must lie in FOLDER, the folder of the definition, or below it",
        ),
        (
            column(file="/etc/hosts"),
            CSV,
            "file '/etc/hosts': must lie in FOLDER, the folder of the definition, or below it",
        ),
        (
            column(name="mt"),
            CSV,
            "file 'ores.csv': unknown column 'mt'. Did you mean 'kt'? Known: country, year, kt, note.",
        ),
        (
            column('where = { county = "Japan" }'),
            CSV,
            "file 'ores.csv': unknown column 'county'. Did you mean 'country'? Known: country, year, kt, note.",
        ),
        (
            column(f'{JAPAN}, times = "yaer"'),
            CSV,
            "file 'ores.csv': unknown column 'yaer'. Did you mean 'year'? Known: country, year, kt, note.",
        ),
        (
            column('where = { country = "Japn" }'),
            CSV,
            "file 'ores.csv': no row matches 'where': "
            "unknown country 'Japn'. Did you mean 'Japan'? Known: China, Japan.",
        ),
        (
            column('where = { country = "China", year = "2001" }'),
            CSV,
            "file 'ores.csv': no row matches 'where' with country = 'China': "
            "unknown year '2001'. Did you mean '2002'? Known: 2000, 2002.",
        ),
        (
            column(""),
            CSV,
            "file 'ores.csv', line 6, column 'year': '2000' stands in line 2 too; "
            "fix more columns in 'where', or leave one row out",
        ),
        (
            column(JAPAN),
            CSV.replace("2001", "1999"),
            "file 'ores.csv', line 3, column 'year': '1999' comes after a later time; sort the rows by 'year'",
        ),
        (
            column(JAPAN),
            CSV.replace("30,", "n/a,"),
            "file 'ores.csv', line 4, column 'kt': 'n/a' is no number; write one as in 1234.5",
        ),
        (
            column(JAPAN),
            CSV.replace("30,", "1_000,"),
            "file 'ores.csv', line 4, column 'kt': '1_000' is no number; write one as in 1234.5",
        ),
        (
            column(JAPAN),
            CSV.replace("30,", '"3,5",'),
            "file 'ores.csv', line 4, column 'kt': '3,5' is no number; write one as in 1234.5",
        ),
        (
            column(JAPAN),
            CSV.replace("30,", "inf,"),
            "file 'ores.csv', line 4, column 'kt': 'inf' is no number; write one as in 1234.5",
        ),
        (
            column(JAPAN),
            CSV.replace("30,", " ,"),
            "file 'ores.csv', line 4, column 'kt': ' ' is empty; write a number, or 0",
        ),
        (
            column(JAPAN),
            CSV.replace("2001", "two"),
            "file 'ores.csv', line 3, column 'year': 'two' is no number; write one as in 1234.5",
        ),
        (
            column(JAPAN),
            CSV.replace("2000", "2000-01-01"),
            "file 'ores.csv', line 3, column 'year': '2001' is no date such as 2020-03-01, as others are",
        ),
        (
            column(JAPAN),
            CSV.replace("year", "when"),
            f"{IN_JAPAN}: lines 2 and 3 both match; "
            "fix more columns in 'where', or name the column of times in 'times'",
        ),
        (
            column(JAPAN),
            CSV.replace("20,b", "20"),
            "file 'ores.csv', line 3: 3 cells in 4 columns",
        ),
        (column(JAPAN), "", "file 'ores.csv': is empty; its first line names the columns"),
        (column(""), "country,year,kt\n", "file 'ores.csv': has no rows"),
        (column(JAPAN), CSV.replace("note", "kt"), "file 'ores.csv', line 1: names the column 'kt' twice"),
        (column(JAPAN), CSV + '"open', "file 'ores.csv': is no CSV file in UTF-8: unexpected end of data"),
    ],
)
def test_a_mistake_in_a_data_file_is_named(tmp_path: Path, flow: str, csv: str, said: str) -> None:
    """By file, line, column and value, with what to do; nothing is written."""
    path = written(tmp_path, definition(flow, start="2000"), csv)
    with pytest.raises(DefinitionError) as raised:
        load_network(path)
    assert str(raised.value) == f"{path}: arcs.ore.flow: {said.replace('FOLDER', str(tmp_path))}"
    assert sorted(each.name for each in tmp_path.iterdir()) == ["ores.csv", "ores.toml"]


@pytest.mark.parametrize(
    ("flow", "horizon", "said"),
    [
        (column(JAPAN), 5, f"series ends at 4 (2004), but the episode at 5 (2005); give what is missing, or a shorter "
                           f"horizon ({IN_JAPAN})"),
        (column(f'{JAPAN}, interpolation = "linear"'), 4, "series ends at 3 (2003), but the episode at 4 (2004); give "
                                                          f"what is missing, or a shorter horizon ({IN_JAPAN})"),
    ],
)  # fmt: skip
def test_a_file_covers_the_episode(tmp_path: Path, flow: str, horizon: int, said: str) -> None:
    """Its last step holds as long as the one before it, its last line to where it ends."""
    text = definition(flow, start="2000")
    shorter = text.replace("horizon = { value = 4", f"horizon = {{ value = {horizon - 1}")
    load_network(written(tmp_path, shorter))
    (tmp_path / "long").mkdir()
    path = written(tmp_path / "long", text.replace("horizon = { value = 4", f"horizon = {{ value = {horizon}"))
    with pytest.raises(DefinitionError) as raised:
        load_network(path)
    assert str(raised.value) == f"{path}: arc 'ore': flow: {said}"


def test_bytes_that_are_no_text(tmp_path: Path) -> None:
    """Are refused; a byte order mark, as spreadsheets write it, is none of the header."""
    path = written(tmp_path, definition(column(), start="2000"))
    (tmp_path / "ores.csv").write_bytes(CSV.replace("Japan", "Japón").encode("latin-1"))
    with pytest.raises(DefinitionError, match=r"file 'ores\.csv': is no CSV file in UTF-8: .*can't decode byte"):
        load_network(path)
    (tmp_path / "ores.csv").write_bytes(CSV.encode("utf-8-sig"))
    assert isinstance(load_network(path).arcs[0].flow, Series)


def test_a_link_may_not_lead_out(tmp_path: Path) -> None:
    """Of the folder of the definition; within it, it may, and the folder itself may be a link."""
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "own").mkdir()
    path = written(tmp_path / "own", definition(column(file="data/link.csv"), start="2000"))
    (tmp_path / "elsewhere" / "ores.csv").write_text(CSV)
    (tmp_path / "own" / "data").mkdir()
    link = tmp_path / "own" / "data" / "link.csv"
    link.symlink_to(tmp_path / "elsewhere" / "ores.csv")
    with pytest.raises(DefinitionError, match=r"file 'data/link\.csv': must lie in .*own, the folder of the def"):
        load_network(path)
    link.unlink()
    link.symlink_to(tmp_path / "own" / "ores.csv")
    (tmp_path / "name").symlink_to(tmp_path / "own")
    assert load_network(tmp_path / "name" / "ores.toml") == load_network(path)


def test_a_broken_file_is_told_once(tmp_path: Path) -> None:
    """Not for each arc that takes a column of it."""
    arcs = "".join(f'[arcs.x{i}]\nfrom = "mine"\nto = "use"\nlaw = "exogenous"\nflow = {column()}\n' for i in range(5))
    path = written(tmp_path, definition(column(), start="2000", more=arcs), csv="")
    with pytest.raises(DefinitionError) as raised:
        load_network(path)
    assert len(raised.value.problems) == 1


def test_files_are_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For all arcs, scenarios and regions of a definition; an edit of one is noticed."""
    read: list[str] = []
    table = data_files._Table

    class Counted(table):  # type: ignore[misc, valid-type]
        def __init__(self, name: str, content: bytes) -> None:
            read.append(name)
            super().__init__(name, content)

    monkeypatch.setattr(data_files, "_Table", Counted)
    arcs = "".join(f'[arcs.x{i}]\nfrom = "mine"\nto = "use"\nlaw = "exogenous"\nflow = {column()}\n' for i in range(5))
    regions = '[regions]\njapan = "Japan"\nchina = "China"\n[scenarios.other]\ntitle = "Other"\n'
    path = written(tmp_path, definition(column(), start="2000", more=arcs + regions))
    for region in ("japan", "china", "japan"):
        network = load_network(f"{path}:{region}")
        assert network.scenario("other").title == "Other"
    assert read == ["ores.csv"]
    (tmp_path / "ores.csv").write_text(CSV.replace("10", "11"))
    os.utime(tmp_path / "ores.csv", ns=(1, 1))
    edited = load_network(f"{path}:japan").arcs[0].flow
    assert isinstance(edited, Series)
    assert edited.values[0] == 11.0
    assert edited.origin == IN_JAPAN


def test_hashes_stand_beside_that_of_the_definition(tmp_path: Path) -> None:
    """Of the files that this scenario was read from, in the network and in the provenance of results."""
    more = '[scenarios.fixed.arcs.ore]\nflow = { value = 1, unit = "kt/year", source = "x" }\n'
    path = written(tmp_path, definition(column(), start="2000", more=more))
    network = load_network(path)
    sha256 = hashlib.sha256(CSV.encode()).hexdigest()
    assert dict(network.data_sha256) == {"ores.csv": sha256}
    assert dict(network.scenario("fixed").data_sha256) == {}
    assert provenance(network)["network"]["data_sha256"] == {"ores.csv": sha256}
    assert replace(network, data_sha256={}) == network


def moved(tmp_path: Path, recipe: Recipe, scenario: str) -> Path:
    """Return a short training with a data file in a folder of its own, which is gone."""
    own = tmp_path / "own"
    (own / "data").mkdir(parents=True)
    sold = 'control = { kind = "share", low = 0.1, neutral = 0.5, high = 0.9, unit = "1", source = "x" }'
    regions = '[regions]\njapan = "Japan"\nchina = "China"\n'
    flow = column('where = { country = "{region}" }', file="data/ores.csv")
    more = regions + '[scenarios.fixed.arcs.ore]\nflow = { value = 1, unit = "kt/year", source = "x" }\n'
    path = written(own, definition(flow, start="2000", sold=sold, more=more), csv=None)
    (own / "data" / "ores.csv").write_text(CSV)
    train(f"{path}:japan", recipe, directory=tmp_path / "run", scenario=scenario)
    shutil.rmtree(own)
    return tmp_path / "run"


@pytest.mark.parametrize("scenario", ["default", "fixed"])
def test_a_run_keeps_its_data_files(tmp_path: Path, ppo_recipe: Recipe, scenario: str) -> None:
    """It opens when the folder of the definition is gone; files that are other ones are refused."""
    directory = moved(tmp_path, ppo_recipe, scenario)
    run = RunDirectory(directory)
    network = run.make_env(1).network
    assert (network.name, network.scenario_name, network.region) == ("ores_japan", scenario, "japan")
    flow = Series(times=(0.0, 1.0, 2.0, 3.0), values=(10.0, 20.0, 30.0, 40.0), until=4.0)
    assert network.arcs[0].flow == (flow if scenario == "default" else 1.0)
    sha256 = hashlib.sha256(CSV.encode()).hexdigest()
    config = json.loads((directory / "config.json").read_text())
    assert (config["region"], config["data_sha256"]) == ("japan", {"data/ores.csv": sha256})
    (kept,) = provenance(network, [run])["runs"]
    assert kept["data_sha256"] == {"data/ores.csv": sha256}
    assert kept["network_sha256"] == hashlib.sha256((directory / "network/network.toml").read_bytes()).hexdigest()
    file = directory / "network" / "data" / "ores.csv"
    file.write_text(CSV.replace("10", "11"))
    other = hashlib.sha256(file.read_bytes()).hexdigest()
    said = f"{file}: is not the file of this training, whose SHA-256 was {sha256}; it is {other}"
    with pytest.raises(RunError) as raised:
        run.network()
    assert str(raised.value) == said
    file.unlink()
    with pytest.raises(RunError, match=r"ores\.csv: missing; the run directory is incomplete"):
        run.network()


def test_a_network_changed_in_python_is_kept_with_its_series(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """Written out, it needs no file."""
    sold = 'control = { kind = "share", low = 0.1, neutral = 0.5, high = 0.9, unit = "1", source = "x" }'
    network = load_network(written(tmp_path, definition(column(), start="2000", sold=sold)))
    changed = network.with_options(objective={"circularity_weight": 0.9})
    train(changed, ppo_recipe, directory=tmp_path / "run")
    assert RunDirectory(tmp_path / "run").config.data_sha256 == {}
    assert RunDirectory(tmp_path / "run").network() == changed


def test_nothing_is_written_for_a_broken_file(tmp_path: Path, ppo_recipe: Recipe) -> None:
    """A training ends before it begins."""
    path = written(tmp_path, definition(column(), start="2000"), CSV.replace("30", "x"))
    with pytest.raises(DefinitionError, match=r"line 4, column 'kt': 'x' is no number"):
        train(path, ppo_recipe, directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_check_names_what_is_wrong_in_every_scenario(tmp_path: Path) -> None:
    """A scenario may name files of its own."""
    more = f"[scenarios.other.arcs.ore]\nflow = {column(file='no.csv')}\n"
    path = written(tmp_path, definition(column(), start="2000", more=more))
    with pytest.raises(DefinitionError, match=r"scenarios\.other\.arcs\.ore\.flow: file 'no\.csv': is not there"):
        Definition(path).check()


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("folder", "file 'folder': is no file"),
        ("x" * 300 + ".csv", "cannot be read: .* File name too long"),
        ("round.csv", r"file 'round\.csv': (is no file|cannot be read)"),
        ("ores\\u0000.csv", "cannot be read: embedded null byte"),
    ],
)
def test_what_cannot_be_read_is_no_traceback(tmp_path: Path, name: str, said: str) -> None:
    """A folder, a name that no system takes, a link in a circle."""
    (tmp_path / "folder").mkdir()
    (tmp_path / "round.csv").symlink_to("round.csv")
    path = written(tmp_path, definition(column(file=name), start="2000"))
    with pytest.raises(DefinitionError, match=rf"arcs\.ore\.flow: .*{said}"):
        load_network(path)


def test_semicolons_are_told(tmp_path: Path) -> None:
    """A file without commas has one column; the message says what separates them."""
    path = written(tmp_path, definition(column(), start="2000"), CSV.replace(",", ";"))
    with pytest.raises(DefinitionError, match=r"unknown column 'kt'.*Separate columns with commas\.$"):
        load_network(path)


def test_files_that_are_too_large_are_refused(tmp_path: Path) -> None:
    """Before they are read."""
    path = written(tmp_path, definition(column(), start="2000"))
    with (tmp_path / "ores.csv").open("ab") as file:
        file.truncate(300_000_000)
    with pytest.raises(DefinitionError, match=r"file 'ores\.csv': is larger than 200 MB"):
        load_network(path)


def test_lines_and_cells_are_those_of_csv(monkeypatch: pytest.MonkeyPatch) -> None:
    """With quotes and without, with breaks of every kind, across the ends of blocks."""
    monkeypatch.setattr(data_files, "BLOCK", 3)
    monkeypatch.setattr(data_files, "CHARACTERS", 5)
    draw = random.Random(0)
    for signs in ("a,\n", "a,\r\n", 'aé,"\r\n'):
        for _ in range(300):
            text = "".join(draw.choice(signs) for _ in range(draw.randrange(40)))
            reader = csv.reader(io.StringIO(text, newline=""), strict=True)
            try:
                expected = [(reader.line_num, row) for row in reader if row]
            except csv.Error:
                with pytest.raises(CirlError, match="is no CSV file"):
                    list(data_files.csv_blocks("x", text.encode()))
                continue
            blocks = data_files.csv_blocks("x", text.encode())
            assert [line for block in blocks for line in zip(*block, strict=True)] == expected, repr(text)
