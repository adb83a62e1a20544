"""From tables of flows to networks: what is read, what balances, what comes back."""

from __future__ import annotations

import csv
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from openpyxl import Workbook
from scipy.optimize import lsq_linear, minimize
from scipy.stats import chi2, kstest
from typer.testing import CliRunner

from cirl_marl import CirlError, MultiAgentVectorEnv, load_network
from cirl_marl.cli import app
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import episode_start
from cirl_marl.importing.assembly import ImportReport, import_flows
from cirl_marl.importing.balances import Change, Processes, ProcessKind, Reconciliation, _closest
from cirl_marl.importing.definition import identifiers, shares_of
from cirl_marl.importing.flow_table import Connection, FlowTable, read_flows, read_stocks
from cirl_marl.network.elements import Role

Row = Sequence[object]
HEADER = ["source", "target", "type", "region", "year", "value", "unit"]
ROLES = {"nonrenewable_reservoir": ["Ore*"], "landfill": ["Dump*"]}


def table(path: Path, rows: Sequence[Row], header: Sequence[str] = HEADER) -> Path:
    """Write a CSV file."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([header, *rows])
    return path


def cycle(years: int = 3, region: str = "", scale: float = 1.0) -> list[list[object]]:
    """Return a metal that is dug, made, used, and partly comes back; all but the use balances."""
    rows: list[list[object]] = []
    for y in range(years):
        dug, back = scale * (10.0 + y), scale * (4.0 - y)
        made = dug + back
        for source, target, kind, value in (
            ("Ore body", "Smelter", "", dug),
            ("Old scrap", "Smelter", "", back),
            ("Smelter", "Works", "", 0.9 * made),
            ("Works", "Dumps", "sludge", 0.15 * 0.9 * made),
            ("Smelter", "Dumps", "slag", 0.1 * made),
            ("Works", "Use", "", 0.8 * 0.9 * made),
            ("Works", "Smelter", "", 0.0),
            ("Works", "Dumps", "dust", 0.05 * 0.9 * made),
            ("Use", "Old scrap", "", back),
        ):
            rows.append([source, target, kind, region, 2000 + y, value, "kt/year"])
    return rows


def simulated(path: Path | str) -> dict[tuple[str, int], float]:
    """Return the flows of a network without agents, by arc and year."""
    network = load_network(path)
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env)
    run = begun.play(env, Neutral())
    start = network.episode.start
    assert isinstance(start, int | float)
    return {
        (arc.id, int(start) + y): float(run.flow[y, k])
        for k, arc in enumerate(network.arcs)
        for y in range(len(run.flow))
    }


def test_a_table_becomes_the_network_that_an_engineer_would_write(tmp_path: Path) -> None:
    """Sources, sinks, stores and what passes; roles, titles, shares, series; flows come back."""
    flows = table(tmp_path / "flows.csv", [row for row in cycle() if row[5]])
    found = import_flows(flows, tmp_path / "metal.toml", roles=ROLES, title="A metal", source="made up, CC0")
    assert found.processes.of(ProcessKind.STORE) == ("Use",) == found.processes.inferred_stores
    assert found.processes.of(ProcessKind.TRANSIT) == ("Smelter", "Old scrap", "Works")
    assert found.largest_error < 1e-9
    network = load_network(tmp_path / "metal.toml")
    nodes = {node.id: node for node in network.nodes}
    assert nodes["ore_body"].role is Role.NONRENEWABLE_RESERVOIR and nodes["ore_body"].title == "Ore body"
    assert nodes["dumps"].role is Role.LANDFILL and not nodes["works"].stores and nodes["use"].stores
    assert network.title == "A metal" and network.references == ("made up, CC0",)
    assert (network.episode.start, network.episode.horizon, network.mass_unit) == (2000, 3, "kt")
    back = simulated(tmp_path / "metal.toml")
    assert back["works_to_dumps_sludge", 2002] == pytest.approx(0.15 * 0.9 * 14)
    assert back["smelter_to_works", 2001] == pytest.approx(0.9 * 14)
    check = CliRunner().invoke(app, ["check", str(tmp_path / "metal.toml")])
    assert check.exit_code == 0, check.output


@st.composite
def tables(draw: st.DrawFn) -> list[list[object]]:
    """Draw flows of several years and regions through processes that balance, in loops too, and come and go."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    size, years, regions = (
        int(rng.integers(1, 6)),
        int(rng.integers(1, 4)),
        draw(st.sampled_from([("",), ("A", "B b")])),
    )
    rows: list[list[object]] = []
    for region in regions:
        for year in range(years):
            # shares among processes, of which at least a tenth goes to the dump
            shares = rng.random((size, size + 1)) * (rng.random((size, size + 1)) < 0.6)
            shares[:, size] += 0.1
            np.fill_diagonal(shares, 0.0)
            shares /= shares.sum(axis=1, keepdims=True)
            entering = rng.random(size) * (rng.random(size) < 0.7) * 10 ** rng.uniform(0, 4)
            entering[0] += 1.0
            through = np.linalg.solve(np.eye(size) - shares[:, :size].T, entering)
            flows = through[:, None] * shares
            rows += [["Ore", f"P{i}", "", region, 1990 + year, entering[i], "t/year"] for i in range(size)]
            for i, j in np.argwhere(flows > 0).tolist():
                rows.append([f"P{i}", "Dump" if j == size else f"P{j}", "", region, 1990 + year, flows[i, j], "t/year"])
    return [row for row in rows if float(str(row[5])) > 0]


@settings(max_examples=15)
@given(tables())
def test_every_flow_comes_back(tmp_path_factory: pytest.TempPathFactory, rows: list[list[object]]) -> None:
    """Of any table that balances, in every region and year."""
    folder = tmp_path_factory.mktemp("import")
    found = import_flows(table(folder / "flows.csv", rows), folder / "net.toml", roles=ROLES)
    largest = max(float(str(row[5])) for row in rows)
    assert found.largest_error <= 1e-9 * largest
    ids = identifiers(found.processes.names)
    for region, id_ in {"": "", "A": "a", "B b": "b_b"}.items():
        own = [row for row in rows if row[3] == region]
        if own:
            back = simulated(f"{folder / 'net.toml'}:{id_}" if id_ else folder / "net.toml")
            for source, target, _, _, year, value, _ in own:
                arc = f"{ids[str(source)]}_to_{ids[str(target)]}"
                assert back[arc, int(str(year))] == pytest.approx(float(str(value)), rel=1e-6, abs=1e-9 * largest)
            assert sum(back.values()) == pytest.approx(sum(float(str(row[5])) for row in own))


def test_a_workbook_is_the_same(tmp_path: Path) -> None:
    """As a long table, or as a matrix on a sheet for each year."""
    rows = [row for row in cycle() if row[2] == "" and row[5]]
    rows += [["Smelter", "Dumps", "", "", y, 0.1 * 14, "kt/year"] for y in (2000, 2001, 2002)]
    rows += [["Works", "Dumps", "", "", y, 0.2 * 0.9 * 14, "kt/year"] for y in (2000, 2001, 2002)]
    long, matrix = Workbook(), Workbook()
    assert long.active is not None and matrix.active is not None
    long.active.append(HEADER)
    for row in rows:
        long.active.append(list(row))
    long.save(tmp_path / "long.xlsx")
    targets = list(dict.fromkeys(str(row[1]) for row in rows))
    for year in (2000, 2001, 2002):
        sheet = matrix.create_sheet(str(year))
        sheet.append(["from \\ to", *targets])
        for source in dict.fromkeys(str(row[0]) for row in rows):
            found = {str(row[1]): row[5] for row in rows if row[0] == source and row[4] == year}
            sheet.append([source, *(found.get(target) for target in targets)])
    matrix.active.append(["notes"])
    matrix.save(tmp_path / "matrix.xlsx")
    expected = read_flows(table(tmp_path / "long.csv", rows)).flows
    assert dict(read_flows(tmp_path / "long.xlsx").flows) == pytest.approx(dict(expected))
    assert dict(read_flows(tmp_path / "matrix.xlsx", unit="kt").flows) == pytest.approx(dict(expected))
    assert read_flows(tmp_path / "matrix.xlsx", unit="kt").unit == "kt/year"
    one = read_flows(tmp_path / "matrix.xlsx", sheet="2001", unit="kt/year")
    assert one.years == (2001,)


def test_a_workbook_needs_openpyxl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few import workbooks, so that what reads them is an extra; the message says which."""
    monkeypatch.setitem(sys.modules, "openpyxl", None)
    (tmp_path / "flows.xlsx").touch()
    with pytest.raises(CirlError, match=r"pip install 'cirl-marl\[excel\]', or save it as CSV"):
        read_flows(tmp_path / "flows.xlsx")


def test_columns_may_be_named_by_their_unit(tmp_path: Path) -> None:
    """As in published data; other names and cases are understood."""
    rows = [[row[0], row[1], row[4], row[5]] for row in cycle() if row[2] == ""]
    found = read_flows(table(tmp_path / "flows.csv", rows, ["From", "To", "Year", "kt_per_year"]))
    assert found.unit == "kt/year" and found.flows["", 2001, Connection("Smelter", "Works")] == pytest.approx(0.9 * 14)


def test_shares_are_held_where_nothing_flows() -> None:
    """Those of the nearest year, the earlier of two; of a region without any, those of all together."""
    flows = np.zeros((2, 5, 2))
    flows[0, 1], flows[0, 3] = (3.0, 1.0), (1.0, 3.0)
    shares = shares_of(flows)
    np.testing.assert_allclose(shares[0, :, 0], [0.75, 0.75, 0.75, 0.25, 0.25])
    np.testing.assert_allclose(shares[1], 0.5)


def test_stocks_are_where_a_store_begins(tmp_path: Path) -> None:
    """At the end of the year before; how far their growth is from the flows is told."""
    flows = table(tmp_path / "flows.csv", cycle())
    growth = [0.72 * 14 - (4.0 - y) for y in range(3)]
    levels = np.cumsum([50.0, *growth])
    rows = [["Use", 1999 + y, level, "kt"] for y, level in enumerate(levels)]
    rows[2][2] = float(str(rows[2][2])) + 0.5
    stocks = table(tmp_path / "stocks.csv", rows, ["process", "year", "value", "unit"])
    found = import_flows(flows, tmp_path / "metal.toml", stocks, roles=ROLES)
    assert found.stock_mistakes == {"Use": pytest.approx(0.5)} and not found.processes.inferred_stores
    network = load_network(tmp_path / "metal.toml")
    assert network.initial[:, network.node_index["use"]] == pytest.approx([50.0, 50.0])
    stocks = table(tmp_path / "late_table.csv", rows[1:], ["process", "year", "value", "unit"])
    with pytest.raises(CirlError, match="'Use' has one of 2000 and none of 1999, with which it starts; give it"):
        import_flows(flows, tmp_path / "late.toml", stocks, roles=ROLES)
    rows[0][2] = 0.5
    stocks = table(tmp_path / "few_table.csv", rows, ["process", "year", "value", "unit"])
    message = r"does not give back 'Old scrap' to 'Smelter' in 2000: .* a store may run empty"
    with pytest.raises(CirlError, match=message):
        import_flows(flows, tmp_path / "few.toml", stocks, roles=ROLES)


@pytest.mark.parametrize(
    ("name", "said"),
    [
        (
            "Dumps",
            "--store Dumps: in the table nothing leaves it, so that it is a sink.*--landfill, --incinerator, --env",
        ),
        ("Ore body", "--store Ore body: in the table nothing enters it, so that it is a source.*with --reservoir"),
    ],
)
def test_a_sink_or_source_is_no_store(name: str, said: str, tmp_path: Path) -> None:
    """It says why, and what to say instead; a pattern that fits them among others is about the others."""
    flows = table(tmp_path / "flows.csv", cycle())
    with pytest.raises(CirlError, match=said):
        import_flows(flows, tmp_path / "metal.toml", roles=ROLES, stores=[name])
    assert import_flows(flows, tmp_path / "metal.toml", roles=ROLES, stores=["U*", "Dump*"]).largest_error < 1e-9


def noisy(rows: Sequence[Row], seed: int) -> list[list[object]]:
    """Return flows with errors of some percent, and how uncertain each is."""
    rng = np.random.default_rng(seed)
    found = []
    for row in rows:
        deviation = float(rng.uniform(0.02, 0.3))
        value = float(str(row[5])) * float(np.clip(rng.normal(1, deviation), 0.2, 3))
        found.append([*row[:5], value, row[6], f"{100 * deviation} %"])
    return found


@pytest.mark.parametrize("seed", range(4))
def test_reconciled_flows_are_the_closest_that_balance(seed: int, tmp_path: Path) -> None:
    """Weighted least squares, as another solver finds them; what is changed is listed; what balances stays."""
    rows = noisy([row for row in cycle(years=2) if row[5]], seed)
    path = table(tmp_path / "flows.csv", rows, [*HEADER, "uncertainty"])
    with pytest.raises(CirlError, match=r"3 processes do not balance .*\n  '.*enter.*leave\n(.*\n)+.*--reconcile"):
        import_flows(path, tmp_path / "metal.toml", roles=ROLES, stores=["Use"])
    assert [each.name for each in tmp_path.iterdir()] == ["flows.csv"]
    found = import_flows(path, tmp_path / "metal.toml", roles=ROLES, stores=["Use"], reconcile=True)
    assert not Processes(found.table, ["Use"]).residuals
    given = read_flows(path)
    deviations = dict(zip(given.flows, given.deviations.tolist(), strict=True))
    for row in rows:
        part = float(str(row[7]).rstrip("% ")) / 100
        key = ("", int(str(row[4])), Connection(str(row[0]), str(row[1]), str(row[2])))
        assert deviations[key] == pytest.approx(part * float(str(row[5])))
    for year in given.years:
        pairs = [pair for pair in given.pairs if ("", year, pair) in given.flows]
        measured = np.array([given.flows["", year, pair] for pair in pairs])
        deviation = np.array([deviations["", year, pair] for pair in pairs])
        after = np.array([found.table.flows["", year, pair] for pair in pairs])
        balances = [
            {"type": "eq", "fun": balance_of(process, pairs)} for process in found.processes.of(ProcessKind.TRANSIT)
        ]

        def distance(x: Any, measured: Any = measured, deviation: Any = deviation) -> float:
            return float((((x - measured) / deviation) ** 2).sum())

        best = minimize(
            distance, measured, bounds=[(0, None)] * len(pairs), constraints=balances, options={"ftol": 1e-14}
        )
        assert distance(after) <= best.fun * (1 + 1e-6)
        np.testing.assert_allclose(after, best.x, rtol=1e-3, atol=1e-3)
    changed = {(each.year, each.pair) for each in found.changes}
    assert len(changed) == len(found.changes) > 0
    listed = (tmp_path / "metal_changes.csv").read_text(encoding="utf-8").splitlines()[1:]
    assert len(listed) == len(changed)
    exact = table(tmp_path / "exact_table.csv", cycle())
    assert import_flows(exact, tmp_path / "exact.toml", roles=ROLES, reconcile=True).changes == ()


def balance_of(process: str, pairs: Sequence[Connection]) -> Callable[[Any], float]:
    """Return what enters a process less what leaves it, as a function of the flows."""
    signs = np.array([(pair.target == process) * 1.0 - (pair.source == process) for pair in pairs])
    return lambda x: float(signs @ x)


def test_flows_are_closest_whatever_has_to_be_none() -> None:
    """Flows that became 0 on the way may come back: as another solver finds them, for large errors."""
    for seed in range(40):
        rng = np.random.default_rng(seed)
        balances = rng.choice([-1.0, 0.0, 1.0], size=(3, 7), p=[0.35, 0.3, 0.35])
        measured, deviation = rng.uniform(0.1, 10.0, 7), rng.uniform(0.1, 5.0, 7)
        found = _closest(measured, deviation, balances)
        assert found is not None and (found >= 0).all()
        np.testing.assert_allclose(balances @ found, 0.0, atol=1e-6)
        best = lsq_linear(
            np.vstack([np.diag(1 / deviation), 1e5 * balances]),
            np.concatenate([measured / deviation, np.zeros(3)]),
            bounds=(0, np.inf),
            tol=1e-14,
        )
        distances = [float((((x - measured) / deviation) ** 2).sum()) for x in (found, best.x)]
        assert distances[0] <= distances[1] * (1 + 1e-4) + 1e-6, seed


def test_no_flow_is_reconciled_below_none(tmp_path: Path) -> None:
    """A flow that would have to be negative becomes 0, and the others make up for it."""
    rows = [["Ore", "Works", 10.0, "1"], ["Works", "Dump", 1.0, "5"], ["Works", "Use", 30.0, "0.1"]]
    rows = [[a, b, 2000, v, "t/year", d] for a, b, v, d in rows]
    path = table(tmp_path / "flows.csv", rows, ["source", "target", "year", "value", "unit", "uncertainty"])
    found = import_flows(path, tmp_path / "net.toml", roles=ROLES | {"technosphere": ["Use"]}, reconcile=True)
    flows = {pair.target: value for (_, _, pair), value in found.table.flows.items()}
    assert flows["Dump"] == 0.0
    # of 20 that lack, each takes a part in proportion to its variance
    assert flows["Works"] == flows["Use"] == pytest.approx(10.0 + 20.0 * 1.0 / 1.01)


def bad(**changes: object) -> list[list[object]]:
    """Return the cycle with a cell of its third row changed."""
    rows = cycle()
    for column, value in changes.items():
        rows[2][HEADER.index(column)] = value
    return rows


def two_regions(missing: int) -> list[list[object]]:
    """Return two regions, of which the second lacks a year."""
    return [*cycle(region="A"), *[row for row in cycle(region="B") if row[4] != missing]]


@pytest.mark.parametrize(
    ("rows", "options", "said"),
    [
        (two_regions(2001), {}, "flows.csv: region 'B' has no flow in 2001: a flow that is not in the table is 0"),
        ([*cycle(), *cycle()[2:0:-1]], {}, "line 29: 'Smelter' to 'Works' in 2000 stands in line 4 too; leave one out"),
        (bad(value=-3.0), {}, "flows.csv, line 4, column 'value': -3.0 is negative; a flow runs from source to target"),
        (
            bad(unit="t/year"),
            {},
            "flows.csv, line 4: unit 't/year', but 'kt/year' in flows.csv, line 2; give all in one",
        ),
        (bad(unit=""), {}, "flows.csv, line 4: states no unit, as others do; write 'kt/year'"),
        ([[*row[:-1], "kg/m"] for row in cycle()], {}, "flows.csv, line 2: unit 'kg/m' is inconsistent"),
        (bad(value="\x1b[31m2"), {}, r"flows.csv, line 4, column 'value': '\x1b[31m2' is no number"),
        (bad(value="n/a"), {}, "flows.csv, line 4, column 'value': 'n/a' is no number"),
        (bad(value=""), {}, "flows.csv, line 4, column 'value': '' is no number"),
        (bad(year="2000.5"), {}, "flows.csv, line 4: '2000.5' is no whole year"),
        (bad(target=""), {}, "flows.csv, line 4: a flow needs a source and a target"),
        (bad(target="Smelter"), {}, "flows.csv, line 4: 'Smelter' to 'Smelter': a flow needs two processes"),
        (cycle(region="Japan"), {"regions": ["Japn"]}, "unknown region 'Japn'. Did you mean 'Japan'?"),
        (cycle(), {"roles": {"landfill": ["Dumps"]}}, "what is 'Ore body' (source)? Say so by --reservoir"),
        (
            cycle(),
            {"roles": ROLES | {"landfill": ["Dumpz"]}},
            "landfill: unknown process 'Dumpz'. Did you mean 'Dumps'",
        ),
        (
            cycle(),
            {"roles": ROLES | {"incinerator": ["Dumps"]}},
            "'Dumps' is given two roles, landfill and incinerator",
        ),
        (
            cycle(),
            {"roles": ROLES | {"incinerator": ["Works"]}},
            "'Works' is given the role incinerator, but what enters",
        ),
        (cycle(), {"sheet": "2001"}, "flows.csv: is no workbook, so that it has no sheet '2001'"),
        ([], {}, "flows.csv: has no flows"),
        (bad(target="SMELTER"), {}, "flows.csv: 'Smelter' and 'SMELTER' differ in case alone; write them alike"),
        (bad(region="Japan"), {}, "flows.csv, line 2: states no region, as others do"),
        (bad(value="1e51"), {}, "line 4, column 'value': 1e51 must be 0, or between 1e-50 and 1e+50 in size"),
        (cycle(), {"year": 2000}, "--year 2000: flows.csv has a column of years; leave out one of them"),
        (cycle(), {"year": 0}, "--year 0: is no year from 1 to 9999"),
        (cycle(), {"unit": "t/year"}, "--unit t/year: 'kt/year' stands in flows.csv, line 2; leave out one of them"),
    ],
)
def test_bad_tables_are_refused(rows: list[list[object]], options: dict[str, Any], said: str, tmp_path: Path) -> None:
    """With file, line, value and what to do; nothing is written."""
    path = table(tmp_path / "flows.csv", rows)
    with pytest.raises(CirlError) as refused:
        import_flows(path, tmp_path / "metal.toml", **{"roles": ROLES, **options})
    assert said in str(refused.value)
    assert [each.name for each in tmp_path.iterdir()] == ["flows.csv"]


def test_bad_files_are_refused(tmp_path: Path) -> None:
    """A sheet that is not there, a matrix of no year, no unit, a definition that exists."""
    book = Workbook()
    assert book.active is not None
    book.active.title = "Flows"
    book.active.append(["", "Works"])
    book.active.append(["Ore", 3])
    book.save(tmp_path / "book.xlsx")
    for options, said in (
        ({"sheet": "Flws"}, "unknown sheet 'Flws'. Did you mean 'Flows'"),
        ({}, "is a matrix of processes, as it has no columns 'source' and 'target'; of which year? Give --year"),
        ({"year": 2001}, "states no unit; give one with --unit, such as kt/year"),
        ({"year": 2001, "unit": "kg/m"}, "--unit kg/m: unit 'kg/m' is inconsistent"),
    ):
        with pytest.raises(CirlError) as refused:
            read_flows(tmp_path / "book.xlsx", **options)
        assert said in str(refused.value)
    (tmp_path / "odd.xlsx").write_text("no workbook")
    with pytest.raises(CirlError, match=r"odd.xlsx: is no workbook that can be read"):
        read_flows(tmp_path / "odd.xlsx")
    flows = table(tmp_path / "flows.csv", cycle())
    (tmp_path / "metal.toml").write_text("mine")
    with pytest.raises(CirlError, match=r"exists, and may have been changed by hand"):
        import_flows(flows, tmp_path / "metal.toml", roles=ROLES)
    assert (tmp_path / "metal.toml").read_text() == "mine"


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ("source;target;year;value;unit\nOre;Works;2000;1,5;t/year\n".encode("cp1252"), "separated by ';'; save it"),
        (b"source\ttarget\tyear\tvalue\tunit\n", r"separated by '\t'; save it"),
        ("source,target,year,value,unit\n".encode("utf-16-le"), "it has zero bytes, as UTF-16 has; save it in UTF-8"),
        ("source,target,year,value,unit\nErzkörper,W".encode("cp1252"), "save it in UTF-8"),
        (b"sorce,target,year,value,unit\n", "needs a column 'source'; it has sorce, target, year, value, unit"),
        (b"source,target,value,unit\n", "needs a column 'year', or --year; it has source, target, value, unit"),
    ],
)
def test_files_of_other_programs(content: bytes, said: str, tmp_path: Path) -> None:
    """What spreadsheet programs save elsewhere is told apart from tables whose columns are wrong."""
    (tmp_path / "flows.csv").write_bytes(content)
    with pytest.raises(CirlError) as refused:
        read_flows(tmp_path / "flows.csv")
    assert said in str(refused.value)


FAULTS: dict[str, Callable[[list[object]], list[object]]] = {
    "is no number": lambda row: [*row[:5], "n/a", row[6]],
    "is negative": lambda row: [*row[:5], -1, row[6]],
    "is no whole year": lambda row: [*row[:4], "?", *row[5:]],
    "a flow needs a source and a target": lambda row: [row[0], " ", *row[2:]],
    "3 cells in 7 columns": lambda row: row[:3],
    "stands in line": lambda row: row,
}
"""What can be wrong with a row, and what makes it so of a good one."""


@settings(max_examples=20)
@given(st.dictionaries(st.integers(0, 35), st.sampled_from([*FAULTS])), st.booleans())
def test_every_bad_row_is_named(
    tmp_path_factory: pytest.TempPathFactory, faults: dict[int, str], has_repetitions: bool
) -> None:
    """At once, in the order of the lines: the first ten, and how many more; repetitions, if all can be read."""
    kinds = [kind for kind in FAULTS if (kind == "stands in line") == has_repetitions]
    faults = {i: kind for i, kind in faults.items() if kind in kinds}
    rows = cycle(years=4)
    for i, kind in faults.items():
        rows = [*rows, rows[i]] if has_repetitions else [*rows[:i], FAULTS[kind](rows[i]), *rows[i + 1 :]]
    path = table(tmp_path_factory.mktemp("faults") / "flows.csv", rows)
    if not faults:
        assert len(read_flows(path).values) == len(rows)
        return
    with pytest.raises(CirlError) as refused:
        read_flows(path)
    *named, last = str(refused.value).split("\n")
    if len(faults) > 10:
        assert last == f"and {len(faults) - 10} more"
    else:
        named.append(last)
    lines = range(len(cycle(years=4)) + 2, len(rows) + 2) if has_repetitions else [i + 2 for i in sorted(faults)]
    kinds_of_lines = [kind for _, kind in sorted(faults.items())]
    assert len(named) == min(10, len(faults))
    for text, line, kind in zip(named, lines, kinds_of_lines, strict=False):
        assert text.startswith(f"flows.csv, line {line}") and kind in text


def test_reading_ends_where_nothing_is_right(tmp_path: Path) -> None:
    """After so many bad rows the rest is not looked at."""
    rows = [[*row[:5], "x", row[6]] for row in cycle(years=200)]
    with pytest.raises(CirlError) as refused:
        read_flows(table(tmp_path / "flows.csv", rows))
    assert str(refused.value).endswith("and 990 more")


def test_all_bad_rows_of_stocks_and_substances_are_named(tmp_path: Path) -> None:
    """As those of flows are."""
    rows = [["Use", y, "Cu", "3", "kt"] for y in ("1999", "2000")] + [["Use", "1999", "", "-1", "kt"]]
    path = table(tmp_path / "stocks.csv", rows, ["process", "year", "substance", "value", "unit"])
    with pytest.raises(CirlError) as refused:
        read_stocks(path, "kt")
    assert str(refused.value) == "stocks.csv, line 4, column 'value': -1 is negative"
    table(path, [*rows[:2], ["Use", "1999", "", "1", "kt"]], ["process", "year", "substance", "value", "unit"])
    with pytest.raises(CirlError) as refused:
        read_stocks(path, "kt")
    first, second = str(refused.value).split("\n")
    assert "line 2: 3 of 'Use' is Cu" in first and "line 3: no row says what 'Use' holds in 2000" in second
    flows: list[Row] = [
        ["Ore", "Works", 2000, 1, "kt/year", ""],
        *[["Ore", "Elsewhere", 2000, 1, "%", e] for e in ("Cu", "Fe")],
    ]
    path = table(tmp_path / "flows.csv", flows, ["source", "target", "year", "value", "unit", "substance"])
    with pytest.raises(CirlError) as refused:
        read_flows(path)
    assert [line.split(":")[0] for line in str(refused.value).split("\n")] == [
        "flows.csv, line 3",
        "flows.csv, line 4",
    ]


def test_names_that_look_alike_are_alike(tmp_path: Path) -> None:
    """Letters with accents in two forms, odd and doubled spaces, in tables and in options."""
    rows = [
        ["Ore", "Schmo\u0308lze\u00a0 A", "", "", 2000, 1, "t/year"],
        ["Schmölze A", "Dump", "", "", 2000, 1, "t/year"],
    ]
    found = import_flows(
        table(tmp_path / "flows.csv", rows), tmp_path / "net.toml", roles=ROLES, stores=["Schmo\u0308lze A"]
    )
    assert found.processes.of(ProcessKind.STORE) == ("Schmölze A",)


@pytest.mark.parametrize("text", ["two\nlines = 1", "a\x7fb", 'quo"te\\', "\x00"])
def test_any_title_can_be_written(text: str, tmp_path: Path) -> None:
    """Whatever characters it has, it is a title and no more."""
    import_flows(table(tmp_path / "flows.csv", cycle()), tmp_path / "metal.toml", roles=ROLES, title=text)
    assert load_network(tmp_path / "metal.toml").title == text


@pytest.mark.parametrize(("part", "is_store"), [(0.19, False), (0.21, True)])
def test_what_keeps_a_fifth_is_a_store(part: float, is_store: bool, tmp_path: Path) -> None:
    """With less it does not balance, and that is said."""
    rows = [["Ore", "Use", "", "", 2000, 1.0, "t/year"], ["Use", "Dump", "", "", 2000, 1.0 - part, "t/year"]]
    flows = read_flows(table(tmp_path / "flows.csv", rows))
    assert Processes(flows).inferred_stores == (("Use",) if is_store else ())


@pytest.mark.parametrize(("mistake", "balances"), [(0.9e-6, True), (1.1e-6, False)])
def test_tables_are_rounded(mistake: float, balances: bool, tmp_path: Path) -> None:
    """To a millionth of the largest flow nothing is out of balance."""
    rows = [["Ore", "Dump", "", "", 2000, 100.0, "t/year"], ["Ore", "Works", "", "", 2000, 1.0, "t/year"]]
    rows += [["Works", "Dump", "", "", 2000, 1.0 - 100.0 * mistake, "t/year"]]
    assert (not Processes(read_flows(table(tmp_path / "flows.csv", rows))).residuals) is balances


def test_flows_that_were_moved_far_come_first() -> None:
    """Those by more than two standard deviations."""
    changes = tuple(Change("", 2000, Connection("a", "b"), 10.0, 10.0 + by, 1.0) for by in (1.9, -2.1, 3.0))
    assert Reconciliation(changes, 1.0, 3).far == [changes[2], changes[1]]


def test_scales_are_those_of_all_years(tmp_path: Path) -> None:
    """A stock of the size of the largest flow in all years."""
    import_flows(table(tmp_path / "flows.csv", cycle(years=3)), tmp_path / "metal.toml", roles=ROLES)
    text = (tmp_path / "metal.toml").read_text()
    assert "flow = { value = 13, unit" in text and "stock = { value = 38, unit" in text


@pytest.mark.parametrize("name", ["metal.csv", "metal_changes.csv", "metal_regions.csv"])
def test_nothing_is_written_over(name: str, tmp_path: Path) -> None:
    """A table that is imported keeps its numbers, though the data of the network would be called like it."""
    path = table(tmp_path / name, cycle())
    content = path.read_bytes()
    with pytest.raises(CirlError, match=rf"metal.toml: {name} exists, and may have been changed by hand"):
        import_flows(path, tmp_path / "metal.toml", roles=ROLES)
    assert path.read_bytes() == content and [*tmp_path.iterdir()] == [path]


def test_the_command_imports(tmp_path: Path) -> None:
    """Says what became what, and how close the network comes; asks for roles only on a terminal."""
    flows = table(tmp_path / "flows.csv", [*cycle(region="A"), *cycle(region="B", scale=2.5)])
    out = tmp_path / "sub" / "metal.toml"
    arguments = ["import", str(flows), "--out", str(out), "--reservoir", "Ore*"]
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code != 0 and "what is 'Dumps' (sink)?" in str(refused.exception)
    assert not out.parent.exists()
    run = CliRunner().invoke(app, [*arguments, "--landfill", "Dumps"])
    assert run.exit_code == 0, run.output
    assert "stores: Use" in run.output and "no flow is further than" in run.output
    assert sorted(each.name for each in out.parent.iterdir()) == ["metal.csv", "metal.toml", "metal_regions.csv"]
    networks = [load_network(f"{out}:{region}") for region in ("a", "b")]
    assert networks[1].compartments["smelter"].scale == pytest.approx(
        2.5 * networks[0].compartments["smelter"].scale, rel=0.1
    )


def test_roles_can_be_asked_for(tmp_path: Path) -> None:
    """Of those that nobody named."""
    asked: list[tuple[str, ProcessKind]] = []

    def ask(name: str, kind: ProcessKind) -> Role:
        asked.append((name, kind))
        return Role.LANDFILL if kind is ProcessKind.SINK else Role.NONRENEWABLE_RESERVOIR

    found: ImportReport = import_flows(table(tmp_path / "f.csv", cycle()), tmp_path / "m.toml", roles={}, ask=ask)
    assert asked == [("Ore body", ProcessKind.SOURCE), ("Dumps", ProcessKind.SINK)]
    assert found.roles == {"Ore body": Role.NONRENEWABLE_RESERVOIR, "Dumps": Role.LANDFILL}


def test_how_plausible_an_adjustment_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """One balance of two flows: χ² = (a − b)²/(σ_a² + σ_b²) with one degree of freedom; a contradiction is said."""
    header = ["source", "target", "year", "value", "unit", "uncertainty"]
    for value, warned in (("14", False), ("40", True)):
        rows = [["Ore", "Works", 2000, "10", "t/year", "1"], ["Works", "Use", 2000, value, "t/year", "2"]]
        path, out = table(tmp_path / f"flows{value}.csv", rows, header), tmp_path / f"net{value}.toml"
        roles = {"nonrenewable_reservoir": ["Ore"], "technosphere": ["Use"]}
        found = import_flows(path, out, roles=roles, reconcile=True).reconciliation
        assert found is not None
        expected = (float(value) - 10) ** 2 / (1 + 4)
        assert found.chi_square == pytest.approx(expected) and found.degrees == 1
        assert found.p_value == pytest.approx(chi2.sf(expected, 1))
        # the changes share the difference in proportion to the variances
        moved = {change.pair.target: change.in_deviations for change in found.changes}
        assert moved["Works"] == pytest.approx((float(value) - 10) / 5) and moved["Use"] == pytest.approx(
            -2 * moved["Works"]
        )
        assert [change.pair.target for change in found.far] == (["Use", "Works"] if warned else [])
        words = ["import", str(path), "--out", str(tmp_path / f"again{value}.toml"), "--reconcile"]
        app([*words, "--reservoir", "Ore", "--outside", "Use"], standalone_mode=False)
        said = capsys.readouterr().out
        assert "degrees of freedom 1," in said and "flows adjusted: 2;" in said and "from the adjusted table" in said
        largest = max(abs(change.after - change.before) for change in found.changes)
        assert f"which is up to {largest:.2g} t/year from the original" in said
        assert ("warning: flows contradict each other" in said) is warned
        assert ("moved by more than two standard deviations: 2, 'Works' to 'Use' by 12.0" in said) is warned


def test_p_values_of_true_uncertainties_are_uniform() -> None:
    """Over tables whose flows balance and err as they state, as the definition of a p-value has it."""
    rng, p_values = np.random.default_rng(5), []
    pairs = [Connection("Ore", "A"), Connection("Ore", "B"), Connection("A", "B"), Connection("A", "Use")]
    pairs += [Connection("B", "Use"), Connection("B", "Dump"), Connection("B", "A")]
    true, deviation = (
        np.array([50.0, 40.0, 30.0, 45.0, 30.0, 15.0, 25.0]),
        np.array([2.0, 1.0, 3.0, 2.0, 1.0, 1.0, 2.0]),
    )
    for _ in range(200):
        measured = true + deviation * rng.standard_normal(7)
        places = np.array([[0] * 7, [2000] * 7, range(7)])
        table = FlowTable("t", "t/year", ("",), tuple(pairs), places, measured, deviation)
        _, found = Processes(table, ["Use"]).reconcile()
        assert found.degrees == 2
        p_values.append(found.p_value)
    assert kstest(p_values, "uniform").pvalue > 0.01
