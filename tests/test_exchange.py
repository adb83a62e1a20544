"""Episodes in files of others: years of the IAMC format, data packages, and what neither holds."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np
import pytest
from conftest import random_network
from small_networks import ACCOUNTS, city
from typer.testing import CliRunner

from cirl_marl import (
    Account,
    CirlError,
    Substance,
    load_network,
    simulate,
    write_network,
)
from cirl_marl.cli import app
from cirl_marl.controllers.episode_quantities import QuantityKind, episode_quantities
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.report.data_package import read_package, write_package
from cirl_marl.report.iamc import read_iamc, write_iamc
from cirl_marl.report.report_page import page_of_alternatives

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.mark.slow
def test_years_go_to_the_format_of_scenario_databases(tmp_path: Path) -> None:
    """Every stock, flow and amount stands there to the last digit, under its region; parts add up to the account."""
    world, japan = simulate("steel_world", steps=2), simulate("steel_japan", steps=2)
    with write_iamc(tmp_path / "iamc.csv", [world, japan]).open(encoding="utf-8") as lines:
        rows = list(csv.DictReader(lines))
    keys = [(row["Scenario"], row["Region"], row["Variable"]) for row in rows]
    assert len(set(keys[: -_size(japan)])) == len(keys) - _size(japan)
    table = {(row["Region"], row["Variable"]): row for row in rows[: -_size(japan)]}
    network, run = world.network, world.rollout
    made = table["japan", "Flow|pig_iron_made"]
    assert made["Unit"] == "kt/yr" and made["Model"].startswith("cirl_marl ")
    assert [float(made[year]) for year in ("2025", "2026")] == run.flow[
        :, network.arc_index["japan_pig_iron_made"]
    ].tolist()
    total = [float(table["World", "Greenhouse gases"][year]) for year in ("2025", "2026")]
    parts = [row for (_, variable), row in table.items() if variable.startswith("Greenhouse gases|")]
    assert {row["Region"] for row in parts} >= {"japan", "china"}
    np.testing.assert_allclose([sum(float(row[year]) for row in parts) for year in ("2025", "2026")], total, rtol=1e-9)
    assert rows[-1]["Region"] == "japan" and total == run.bookings[0, 0].tolist()
    with pytest.raises(CirlError, match="IAMC has calendar years; give"):
        write_iamc(tmp_path / "no.csv", [simulate(city(), steps=2)])
    with pytest.raises(CirlError, match="Circularity would come 2 times; give other titles"):
        write_iamc(tmp_path / "no.csv", [japan, japan])
    with pytest.raises(CirlError, match="give at least one episode"):
        write_iamc(tmp_path / "no.csv", [])
    with pytest.raises(CirlError, match="no such file"):
        read_iamc(tmp_path / "no.csv")
    with pytest.raises(CirlError, match="different years"):
        write_iamc(tmp_path / "no.csv", [japan, simulate("steel_japan", steps=3)])


def test_years_come_back_from_files_of_scenario_databases(tmp_path: Path) -> None:
    """What was written, to the last digit; empty cells are missing; what is wrong is named with its line."""
    japan = simulate("steel_japan", steps=3)
    path = write_iamc(tmp_path / "iamc.csv", [japan])
    rows = {row.variable: row for row in read_iamc(path)}
    assert len(rows) == _size(japan)
    pig_iron = rows["Flow|pig_iron_made"]
    flow = japan.rollout.flow[:, japan.network.arc_index["pig_iron_made"]]
    assert pig_iron.values == dict(zip((2025, 2026, 2027), flow.tolist(), strict=True)) and pig_iron.unit == "kt/yr"
    head = "Model,Scenario,Region,Variable,Unit,2025,2030\n"
    path.write_text(f"{head}m,s,World,Primary Energy,EJ/yr,,3.5\n")
    assert [dict(row.values) for row in read_iamc(path)] == [{2030: 3.5}]
    for text, message in (
        (head.replace("Unit", "Units"), "unknown column 'Unit'. Did you mean 'Units'"),
        (head.replace("2030", "notes"), "column 'notes' is no year"),
        (head.replace("2030", "2025"), "column '2025' comes a second time"),
        (f"{head}m,s,World,Steel,t,1,many\n", "line 2: the value of 2030 is no finite number"),
        (f"{head}m,s,World,Steel,t,1,2\nm,s,World,Steel,kt,1,2\n", "line 3: m, s, World, Steel comes a second time"),
    ):
        path.write_text(text)
        with pytest.raises(CirlError, match=message):
            read_iamc(path)


@pytest.mark.parametrize("name", ["city", "copper_net", "steel_japan", "steel_japan.copper"])
def test_a_data_package_has_a_network_and_its_episode(tmp_path: Path, name: str) -> None:
    """All numbers come back as they were, with a network that moves in the same way."""
    name, _, scenario = name.partition(".")
    network = load_network(name, scenario=scenario or None) if name != "city" else city()
    network = network.with_options(episode={"horizon": 5})
    if network.substances:
        nodes = (replace(n, content={**dict(n.content), "tin": 1e-4}) if n.history else n for n in network.nodes)
        network = replace(network, nodes=tuple(nodes), substances=(*network.substances, Substance(id="tin")))
    done = simulate(network, steps=5)
    descriptor = json.loads(write_package(tmp_path / "package", done).read_text(encoding="utf-8"))
    assert {part["name"] for part in descriptor["resources"]} >= {"nodes", "arcs", "stocks", "flows", "accounts"}
    back, run = read_package(tmp_path / "package"), done.rollout
    assert (back.scenario, back.control) == (scenario or "default", "neutral")
    np.testing.assert_array_equal(back.contents, run.contents)
    assert len(network.substances) == 2 * (scenario == "copper")
    np.testing.assert_array_equal(back.stock, np.concatenate([run.start[None], run.stock]))
    np.testing.assert_array_equal(back.flow, run.flow)
    np.testing.assert_array_equal(back.levels, run.levels[0].T)
    np.testing.assert_array_equal(back.circularity, run.circularity_mean[0])
    np.testing.assert_allclose(back.bookings, run.bookings[0].T, rtol=1e-12)
    again = simulate(back.network, steps=5).rollout
    np.testing.assert_allclose(again.flow, run.flow, rtol=1e-9, atol=1e-9 * np.abs(run.flow).max())
    with pytest.raises(CirlError, match="package: exists; a data package is a folder of its own"):
        write_package(tmp_path / "package", done)


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("flows.csv", "0,feed,", "0,fed,", "flows.csv, line .*: unknown arc 'fed'.*Did you mean 'feed'"),
        ("flows.csv", "interval,arc,flow", "interval,arc,floww", "unknown column 'flow'.*Did you mean 'floww'"),
        ("stocks.csv", "2,hall,", "7,hall,", "interval '7' is none of 0 to 2"),
        ("stocks.csv", "2,hall,", "2,hall,x", "stock 'x.*' is no finite number"),
        ("circularity.csv", "1,", "0,", "line 3: circularity of the network comes a second time"),
        ("flows.csv", "1,feed,", "0,feed,", "flows.csv, line .*: flow of feed comes a second time"),
        ("stocks.csv", "2,hall,", "2,hall,1\n2,bales,", "stocks.csv, line .*: stock of bales comes a second time"),
        ("datapackage.json", '"name": "services"', '"name": "service"', "unknown table 'services'.*'service'"),
        ("datapackage.json", '"resources"', '"resource"', "unknown table 'stocks'"),
    ],
)
def test_data_packages_that_say_something_else_are_refused(
    tmp_path: Path, file: str, old: str, new: str, message: str
) -> None:
    """With the file, the line, and the nearest valid name."""
    write_package(tmp_path / "package", simulate(city(), steps=2))
    path = tmp_path / "package" / file
    text = path.read_text(encoding="utf-8")
    assert old in text
    path.write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(CirlError, match=message):
        read_package(tmp_path / "package")


def test_what_nobody_books_comes_back_as_nothing(tmp_path: Path) -> None:
    """And a table that is not there is named."""
    network = replace(city(), accounts=(*ACCOUNTS, Account(id="idle", unit="t")))
    write_package(tmp_path / "package", simulate(network, steps=2))
    back = read_package(tmp_path / "package")
    assert not back.bookings[:, 2].any() and back.bookings[:, :2].all()
    (tmp_path / "package" / "flows.csv").unlink()
    with pytest.raises(CirlError, match=r"flows\.csv: no such file"):
        read_package(tmp_path / "package")


def test_contents_stand_in_iamc_files(tmp_path: Path) -> None:
    """Of stocks and flows, as parts of their mass."""
    japan = simulate("steel_japan", scenario="copper", steps=2)
    rows = {row.variable: row for row in read_iamc(write_iamc(tmp_path / "iamc.csv", [japan]))}
    content = japan.rollout.contents[:, 0, [*japan.network.compartments].index("eaf_steel")]
    assert rows["Content|copper|eaf_steel"].unit == "1" and content.min() > 0.002
    assert [*rows["Content|copper|eaf_steel"].values.values()] == content.tolist()


def test_the_command_writes_a_data_package(tmp_path: Path) -> None:
    """Of one episode; of several it says what to give."""
    package = ["simulate", "paper_city", "--steps", "3", "--out", str(tmp_path), "--package", str(tmp_path / "data")]
    done = CliRunner().invoke(app, package)
    assert done.exit_code == 0 and "datapackage.json" in done.output
    assert len(read_package(tmp_path / "data").flow) == 3
    several = ["--control", "neutral", "--control", "random"]
    for more, message in ((several, "holds one episode"), (["--samples", "2"], "go without --samples")):
        refused = CliRunner().invoke(app, [*package, *more])
        assert isinstance(refused.exception, CirlError) and message in str(refused.exception)


def test_what_no_file_holds_is_refused_before_anything_is_simulated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Names of files, years and titles are known before an episode is."""
    monkeypatch.setattr("cirl_marl.controllers.rollout.rollout", None)
    (tmp_path / "file").touch()
    iamc, japan, twice = str(tmp_path / "iamc.csv"), ["steel_japan"], tmp_path / "twice.toml"
    network = load_network("steel_japan")
    write_network(
        replace(network, accounts=(replace(network.accounts[0], title="Circularity"), *network.accounts[1:])), twice
    )
    for arguments, message in (
        ([*japan, "--iamc", "iamc.xlsx"], "--iamc iamc.xlsx: needs the name of a .csv file"),
        ([*japan, "--iamc", str(tmp_path / "file" / "iamc.csv")], "file is a file, not a folder"),
        (["paper_city", "--iamc", iamc], "IAMC has calendar years; give [episode] a start at the turn of a year"),
        ([str(twice), "--iamc", iamc], "Circularity would come 2 times; give other titles"),
        ([*japan, "--package", str(tmp_path / "file" / "data")], "file is a file, not a folder"),
        ([*japan, "--iamc", "new.csv", "--out", "new.csv"], "--iamc new.csv: is the folder of --out; give another"),
    ):
        refused = CliRunner().invoke(app, ["simulate", "--out", str(tmp_path), *arguments])
        assert isinstance(refused.exception, CirlError) and message in str(refused.exception)
    assert {path.name for path in tmp_path.iterdir()} == {"file", "twice.toml"}
    (tmp_path / "plan.xlsx").mkdir()
    planned = ["plan", "copper_net", "--control", "neutral", "--out", str(tmp_path / "plan.csv")]
    with pytest.raises(CirlError, match=r"--out .*plan\.csv: .*plan\.xlsx is a folder, not a file"):
        CliRunner().invoke(app, planned, catch_exceptions=False)
    assert {path.name for path in tmp_path.iterdir()} == {"file", "twice.toml", "plan.xlsx"}


def test_the_command_writes_years_of_scenarios_and_controls(tmp_path: Path) -> None:
    """Of as many steps as are asked for, which scenarios may differ in otherwise."""
    path, controls = tmp_path / "iamc.csv", ["--control", "neutral", "--control", "random"]
    options = ["--steps", "2", "--out", str(tmp_path), "--iamc", str(path)]
    done = CliRunner().invoke(app, ["simulate", "steel_japan", *controls, *options])
    assert done.exit_code == 0, done.output
    rows = read_iamc(path)
    assert {row.scenario for row in rows} == {"steel_japan default neutral", "steel_japan default random"}
    assert {tuple(row.values) for row in rows} == {(2025, 2026)}
    file = tmp_path / "japan.toml"
    write_network(load_network("steel_japan"), file)
    short = '\n[scenarios.short.episode]\nhorizon = { value = 3, unit = "1", source = "chosen" }\n'
    file.write_text(file.read_text(encoding="utf-8") + short, encoding="utf-8")
    done = CliRunner().invoke(app, ["simulate", str(file), "--scenario", "default", "--scenario", "short", *options])
    assert done.exit_code == 0, done.output
    assert {row.scenario for row in read_iamc(path)} == {"steel_japan default neutral", "steel_japan short neutral"}


def _size(simulation: Simulation) -> int:
    network = simulation.network
    parts = {(simulation.env.ledger.account[e], c) for e, c in enumerate(simulation.env.ledger.compartments)}
    figures = 1 + len(network.services) + len(network.stores) + len(network.arcs)
    return figures + len(network.accounts) + len(parts)


@pytest.mark.parametrize("seed", range(3))
def test_tables_and_pages_have_every_quantity(seed: int) -> None:
    """Each stands once in the table of its episode, with the values of the rollout; what disturbs and contents too."""
    networks = random_network(seed, 6, 12, lifetimes=True), city(), load_network(EXAMPLES / "copper_in_steel.toml")
    weather = load_network("carbo_net", scenario="weather")
    for case in (*networks, weather):
        simulation = simulate(case, "random", seed=seed, steps=min(3, case.episode.horizon))
        network, steps = simulation.network, simulation.network.episode.horizon
        header, (first, *rows) = simulation.table()
        columns, run = dict(zip(header, zip(*rows, strict=True), strict=True)), simulation.rollout
        assert len(columns) == len(header)
        quantities = episode_quantities(network)
        assert len({(part.kind, part.of, part.substance) for part in quantities}) == len(quantities)
        for part in quantities:
            times, curve = part.points(network, run)
            ends = network.episode.control_interval * np.arange(1, steps + 1)
            moments = [0.0, *ends] if part.kind == "stock" else ends - network.episode.control_interval / 2
            assert len(times) == len(curve)
            np.testing.assert_allclose(times, moments)
            if part.kind != "service":  # of which the table has the mean
                np.testing.assert_array_equal(columns[part.heading], part.values(run)[0])
            if part.kind == "stock":
                assert first[header.index(part.heading)] == curve[0] == run.start[part.place]
        parts = {kind: [p.values(run)[0] for p in quantities if p.kind == kind] for kind in get_args(QuantityKind)}
        np.testing.assert_array_equal(np.reshape(parts["service"], run.levels[0].shape), run.levels[0])
        for kind, values in (("flow", run.flow), ("disturbance", run.disturbances[0])):
            np.testing.assert_array_equal(np.reshape(parts[kind], values.T.shape), values.T)
        np.testing.assert_array_equal(np.reshape(parts["content"], (-1, steps)), run.contents.reshape(steps, -1).T)
        band = page_of_alternatives([simulation]).episodes[0].bands
        for kind, bands in band.items():
            np.testing.assert_array_equal(
                np.reshape([b.value for b in bands], (-1, steps)), np.reshape(parts[kind], (-1, steps))
            )
