"""One definition and one data file for several networks."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
import typer
from series_definition import column, definition, written

import cirl_marl
from cirl_marl import CirlError, DefinitionError, Series, load_network, networks
from cirl_marl.cli.networks import check, list_networks, show
from cirl_marl.definitions import catalogue
from cirl_marl.definitions.reader import Definition, write_network

REGIONS = '[regions]\njapan = "Japan"\nchina = "China"\nspain = "Spain"\n'
FLOW = column('where = { country = "{region}" }')
SCENARIO = f"[scenarios.more.arcs.ore]\nflow = {FLOW.replace('kt/year', 'Mt/year')}\n"
TEXT = definition(FLOW, start="2000", more=REGIONS + SCENARIO).replace('"Ores"', '"Ores of {region}"')


def values(network: cirl_marl.Network) -> tuple[float, ...]:
    """Return the values of the flow of ore."""
    flow = network.arcs[0].flow
    assert isinstance(flow, Series)
    return flow.values


@pytest.fixture
def own_catalogue(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Return a folder that stands for the catalogue, with ores.toml and copper_net.toml."""
    folder = tmp_path / "envs"
    folder.mkdir()
    shutil.copy(catalogue.folder("envs") / "copper_net.toml", folder)
    written(folder, TEXT)
    monkeypatch.setattr(catalogue, "folder", lambda kind: folder)
    return folder


def test_a_region_is_a_network(tmp_path: Path) -> None:
    """With its name, title and data; scenarios hold in it."""
    path = written(tmp_path, TEXT)
    for region, title, first in (("japan", "Ores of Japan", 10.0), ("china", "Ores of China", 1.0)):
        network = load_network(f"{path}:{region}")
        assert (network.name, network.title, network.region) == (f"ores_{region}", title, region)
        assert values(network)[0] == first
        more = load_network(f"{path}:{region}", scenario="more")
        assert more is network.scenario("more")
        assert values(more)[0] == 1e3 * first
        assert more.address == f"{path}:{region}"
        assert load_network(network.address) is network
        write_network(network, tmp_path / "written.toml")
        assert load_network(tmp_path / "written.toml") == network


def test_the_only_region_need_not_be_named(tmp_path: Path) -> None:
    """A table of one region becomes a definition that has one, which is the network."""
    path = written(tmp_path, TEXT.replace(REGIONS, '[regions]\njapan = "Japan"\n'))
    assert load_network(path) == load_network(f"{path}:japan")


def test_only_the_region_asked_for_is_built(tmp_path: Path) -> None:
    """Spain has no rows, which nobody notices who does not ask for it."""
    path = written(tmp_path, TEXT)
    definition_ = Definition(path)
    definition_.network(region="japan")
    assert list(definition_._networks) == [("default", "japan")]
    with pytest.raises(DefinitionError, match=r"arcs\.ore\.flow: .*unknown country 'Spain'. Did you mean 'Japan'\?"):
        load_network(f"{path}:spain")


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ("", "which region? Known: japan, china, spain. Write it after a colon, as in ores.toml:japan"),
        (":jpan", "unknown region 'jpan'. Did you mean 'japan'? Known: japan, china, spain."),
        (":", "which region? Known: japan, china, spain. Write it after a colon, as in ores.toml:japan"),
    ],
)
def test_without_a_region_those_there_are_are_named(tmp_path: Path, asked: str, said: str) -> None:
    """And with an unknown one the nearest."""
    path = written(tmp_path, TEXT)
    with pytest.raises(DefinitionError) as raised:
        load_network(f"{path}{asked}")
    assert str(raised.value) == f"{path}: {said}"


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        (REGIONS, "", "arcs.ore.flow.where.country: '{region}': a definition without [regions] has no {region}"),
        (REGIONS, "", "title: 'Ores of {region}': a definition without [regions] has no {region}"),
        ('"Japan"', "3", "regions.japan: must be a text, got 3"),
        ("china", "China", "regions.China: begins with a letter and has lower-case letters, digits and _ only"),
        (
            SCENARIO,
            '[scenarios.more]\nwithout = ["regions.japan"]',
            "without: 'regions.japan': a scenario cannot set it",
        ),
        (SCENARIO, '[scenarios.more.regions]\nitaly = "Italy"', "scenarios.more.regions: a scenario cannot set it"),
    ],
)
def test_mistakes_with_regions(tmp_path: Path, old: str, new: str, said: str) -> None:
    """A text for each, which only stands where one is meant."""
    path = written(tmp_path, TEXT.replace(old, new))
    with pytest.raises(DefinitionError) as raised:
        Definition(path).check("japan" if "[regions]" in path.read_text() else "")
    assert said in str(raised.value)


def test_regions_that_are_no_table(tmp_path: Path) -> None:
    """Are refused before anything is built; a definition without regions has none to ask for."""
    path = written(tmp_path, "regions = 3\n" + TEXT.replace(REGIONS, ""))
    with pytest.raises(DefinitionError, match='regions: must be a table of texts, as japan = "Japan"'):
        load_network(f"{path}:japan")
    path = written(tmp_path, definition())
    with pytest.raises(DefinitionError, match=r"unknown region 'japan'\. Known: none"):
        load_network(f"{path}:japan")


def test_regions_stand_in_the_catalogue(own_catalogue: Path) -> None:
    """As networks of their own, for Python and the command line."""
    assert networks() == ["copper_net", "ores_china", "ores_japan", "ores_spain"]
    assert load_network("ores_japan") is load_network(own_catalogue / "ores.toml:japan")
    assert load_network("ores_china", scenario="more").title == "Ores of China"
    assert load_network("copper_net").region == ""
    with pytest.raises(CirlError, match=r"unknown network 'ores_jpan'\. Did you mean 'ores_japan'\? Known: copper_net"):
        load_network("ores_jpan")
    for wrong in ("copper_net_", "_japan", "japan", "ores_"):
        with pytest.raises(CirlError, match=f"^unknown network '{wrong}'"):
            load_network(wrong)
    with pytest.raises(CirlError, match=r"^unknown network 'ores'\. .*Known: ores_china, ores_japan, ores_spain\."):
        load_network("ores")


def test_other_files_are_not_read(own_catalogue: Path) -> None:
    """A broken one does not stand in the way of the others."""
    (own_catalogue / "other.toml").write_text("[")
    assert load_network("ores_japan").name == "ores_japan"
    assert load_network("copper_net").name == "copper_net"


def test_commands_take_regions(
    own_catalogue: Path, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Names of the catalogue, and a file of one's own with a colon."""
    written(own_catalogue, TEXT.replace('spain = "Spain"\n', ""))
    monkeypatch.chdir(tmp_path)
    for name in ("ores_japan", str(own_catalogue / "ores.toml:japan")):
        show(name)
        assert Path("ores_japan.png").is_file()
        Path("ores_japan.png").unlink()
        check([name])
        printed = " ".join(capsys.readouterr().out.split())
        assert f"{name}: 7 compartments, 0 agents, scenarios default, more: no mistakes" in printed
    list_networks()
    printed = capsys.readouterr().out
    assert "ores_* (2 regions)" in " ".join(printed.split())
    list_networks(every_region=True)
    printed = capsys.readouterr().out
    assert "ores_japan" in printed and "ores_china" in printed


def test_check_of_a_file_looks_at_every_region(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A mistake in one region shows though nobody named it, beside the others that have none."""
    path = written(tmp_path, TEXT.replace('"China"', '"Chnia"'))
    with pytest.raises(typer.Exit):
        check([str(path)])
    printed = capsys.readouterr()
    assert "Did you mean 'China'?" in " ".join(printed.err.split())
    assert f"{path}:japan: 7 compartments" in " ".join(printed.out.split())
