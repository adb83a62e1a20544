"""Tables of flows and stocks, long or as a matrix of processes, in CSV files and workbooks."""

from __future__ import annotations

import csv
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated
from zipfile import BadZipFile

from cirl_marl.errors import CirlError, unknown
from cirl_marl.network.declarations import with_field_docs
from cirl_marl.network.units import factor

NAMES: Mapping[str, tuple[str, ...]] = {
    "source": ("source", "from", "origin"),
    "target": ("target", "to", "destination"),
    "year": ("year", "time"),
    "value": ("value", "flow", "amount", "mass"),
    "unit": ("unit", "units"),
    "type": ("type", "good", "material"),
    "region": ("region", "country"),
    "uncertainty": ("uncertainty", "deviation"),
    "process": ("process", "node", "stock of"),
}
"""What columns may be called, whatever the case."""
WORKBOOKS = (".xlsx", ".xlsm")


@dataclass(frozen=True, order=True, slots=True)
class Connection:
    """What a flow is: from which process to which, and of what type if the table says so."""

    source: str
    target: str
    type: str = ""

    def __str__(self) -> str:
        """Name it as in a message."""
        return f"'{self.source}' to '{self.target}'" + (f", {self.type}" if self.type else "")


@with_field_docs
@dataclass(frozen=True, slots=True)
class FlowTable:
    """Flows by region, year and pair; what is not in ``flows`` is 0."""

    name: Annotated[str, "the file"]
    unit: Annotated[str, "mass/time"]
    flows: Annotated[Mapping[tuple[str, int, Connection], float], "by region (empty without regions), year and pair"]
    deviations: Annotated[Mapping[tuple[str, int, Connection], float], "standard deviations, of those that state one"]

    @property
    def regions(self) -> tuple[str, ...]:
        """Regions, in the order of the file."""
        return tuple(dict.fromkeys(region for region, _, _ in self.flows))

    @property
    def years(self) -> tuple[int, ...]:
        """First to last year."""
        years = [year for _, year, _ in self.flows]
        return tuple(range(min(years), max(years) + 1))

    @property
    def pairs(self) -> tuple[Connection, ...]:
        """Pairs, in the order of the file."""
        return tuple(dict.fromkeys(pair for _, _, pair in self.flows))

    def of(self, regions: Sequence[str]) -> FlowTable:
        """Return the part of some regions.

        Raises:
            CirlError: for one that is not there; names the nearest.
        """
        for region in regions:
            if region not in self.regions:
                raise CirlError(f"{self.name}: {unknown('region', region, self.regions)}")
        kept = {key: value for key, value in self.flows.items() if key[0] in regions}
        return replace(self, flows=kept)


@dataclass(slots=True)
class _Grid:
    """The cells of a file or a sheet, as texts, with the line of each row."""

    name: str
    header: list[str]
    rows: list[tuple[int, list[str]]]
    places: dict[str, int] = field(init=False)

    def __post_init__(self) -> None:
        plain = [each.strip().lower() for each in self.header]
        self.places = {}
        for key, names in NAMES.items():
            found = [i for i, each in enumerate(plain) if each in names]
            if len(found) > 1:
                both = " and ".join(f"'{self.header[i]}'" for i in found[:2])
                raise CirlError(f"{self.name}, line 1: {both} both mean {key}; rename one")
            if found:
                self.places[key] = found[0]

    def at(self, row: Sequence[str], key: str) -> str:
        """Return a cell; nothing if there is no such column."""
        return row[self.places[key]].strip() if key in self.places else ""

    def number(self, line: int, text: str, column: str, *, least: float = 0.0) -> float:
        """Return a number of a cell.

        Raises:
            CirlError: naming file, line, column and text, if it is none or below ``least``.
        """
        told = f"{self.name}, line {line}, column '{column}'"
        try:
            value = float(text.replace("_", "?"))
        except ValueError:
            value = math.nan
        if not math.isfinite(value):
            raise CirlError(f"{told}: '{text}' is no number; write one as in 1234.5, or leave out the row")
        if value < least:
            turned = "; a flow runs from source to target: swap them" if least == 0.0 else ""
            raise CirlError(f"{told}: {text} is negative{turned}")
        return value

    def year(self, line: int, text: str) -> int:
        value = self.number(line, text, self.header[self.places["year"]], least=-math.inf)
        if value != round(value):
            raise CirlError(f"{self.name}, line {line}: '{text}' is no whole year")
        return int(value)


def read_flows(path: Path, *, sheet: str | None = None, unit: str | None = None, year: int | None = None) -> FlowTable:
    """Read a table of flows.

    A long table has the columns source, target, year, value and unit, and may have type, region and uncertainty (a
    standard deviation in the same unit, or in percent, as ``5 %``). Instead of value and unit there may be one column
    that is named by its unit, as ``kt_per_year``. Any other table is a matrix: its first column names the sources, its
    first line the targets. The sheets of a workbook that are named by years are one matrix each.

    Args:
        path: a CSV file in UTF-8, or a workbook.
        sheet: of the workbook; None: the first, or all that are named by years.
        unit: of the values, where the table does not say it.
        year: of a matrix that is not on a sheet of its own.

    Raises:
        CirlError: naming file, line, column and value, with what to do.
    """
    grids = list(_grids(path, sheet))
    flows: dict[tuple[str, int, Connection], float] = {}
    lines: dict[tuple[str, int, Connection], str] = {}
    deviations: dict[tuple[str, int, Connection], float] = {}
    units: dict[str, str] = {}
    for grid in grids:
        long = {"source", "target"} <= grid.places.keys()
        for line, key, value, said, deviation in _long(grid, year) if long else _matrix(grid, year):
            where = f"{grid.name}, line {line}"
            if key in flows:
                both = f"{key[2]} in {key[1]}{f' in {key[0]}' if key[0] else ''}"
                raise CirlError(f"{where}: {both} stands in {lines[key]} too; leave one out, or give them types")
            if key[2].source == key[2].target:
                raise CirlError(f"{where}: {key[2]}: a flow needs two processes")
            flows[key], lines[key] = value, f"line {line}"
            units.setdefault(said, where)
            if deviation is not None:
                deviations[key] = deviation
    if not flows:
        raise CirlError(f"{path}: has no flows")
    found = FlowTable(path.name, _unit(path, units, unit), flows, deviations)
    _check_years(found)
    return found


def read_stocks(path: Path, unit: str) -> dict[tuple[str, str, int], float]:
    """Return stocks by region, process and year, in a unit of mass.

    The table is long, with the columns process, year, value and unit, and may have region.

    Raises:
        CirlError: naming file, line, column and value, with what to do.
    """
    stocks: dict[tuple[str, str, int], float] = {}
    for grid in _grids(path, None):
        _needs(grid, ("process", "year", "value", "unit"))
        for line, row in grid.rows:
            key = (grid.at(row, "region"), grid.at(row, "process"), grid.year(line, grid.at(row, "year")))
            if key in stocks:
                raise CirlError(f"{grid.name}, line {line}: a stock of '{key[1]}' in {key[2]} stands there already")
            value = grid.number(line, grid.at(row, "value"), grid.header[grid.places["value"]])
            stocks[key] = value * _factor(f"{grid.name}, line {line}", grid.at(row, "unit"), unit)
    return stocks


_Entry = tuple[int, tuple[str, int, Connection], float, str, float | None]


def _long(grid: _Grid, given: int | None) -> Iterator[_Entry]:
    """Yield line, key, value, unit and deviation of each row of a long table."""
    unit = ""
    if "value" not in grid.places:
        known = set(grid.places.values())
        named = [i for i, each in enumerate(grid.header) if i not in known and "_per_" in each.lower()]
        if len(named) != 1:
            raise CirlError(
                f"{grid.name}, line 1: no column of values; call it 'value', or by its unit, as 'kt_per_year'"
            )
        grid.places["value"] = named[0]
        unit = grid.header[named[0]].strip().lower().replace("_per_", "/")
    if given is None:
        _needs(grid, ("year",))
    for line, row in grid.rows:
        pair = Connection(grid.at(row, "source"), grid.at(row, "target"), grid.at(row, "type"))
        if not pair.source or not pair.target:
            raise CirlError(f"{grid.name}, line {line}: a flow needs a source and a target")
        year = given if "year" not in grid.places else grid.year(line, grid.at(row, "year"))
        assert year is not None
        value = grid.number(line, grid.at(row, "value"), grid.header[grid.places["value"]])
        deviation = None
        if told := grid.at(row, "uncertainty"):
            column = grid.header[grid.places["uncertainty"]]
            relative = told.endswith("%")
            deviation = grid.number(line, told.rstrip("% "), column) * (value / 100 if relative else 1.0)
        yield line, (grid.at(row, "region"), year, pair), value, unit or grid.at(row, "unit"), deviation


def _matrix(grid: _Grid, given: int | None) -> Iterator[_Entry]:
    """Yield line, key, value, no unit and no deviation of each cell of a matrix of processes."""
    named = grid.name.rpartition(", sheet '")[2].rstrip("'")
    year = int(named) if _is_year(named) else given
    if year is None:
        raise CirlError(
            f"{grid.name}: is a matrix of processes, as it has no columns 'source' and 'target'; of which year? Give "
            "--year, or name its sheet by it"
        )
    targets = [each.strip() for each in grid.header[1:]]
    for target in targets:
        if not target or targets.count(target) > 1:
            said = f"names '{target}' twice" if target else "has a column without a name"
            raise CirlError(f"{grid.name}, line 1: {said}; each column is a process that receives")
    for line, row in grid.rows:
        source = row[0].strip()
        for target, text in zip(targets, row[1:], strict=True):
            if text.strip():
                value = grid.number(line, text.strip(), target)
                if value > 0:
                    yield line, ("", year, Connection(source, target)), value, "", None


def _needs(grid: _Grid, keys: Sequence[str]) -> None:
    for key in keys:
        if key not in grid.places:
            told = f"column '{key}'; it has {', '.join(filter(None, grid.header)) or 'none'}"
            raise CirlError(f"{grid.name}, line 1: needs a {told}. Separate columns with commas.")


def _unit(path: Path, units: Mapping[str, str], given: str | None) -> str:
    """Return the unit of all flows, mass/time."""
    said = [unit for unit in units if unit]
    if len(said) > 1:
        first, other = said[:2]
        raise CirlError(f"{units[other]}: unit '{other}', but '{first}' in {units[first]}; give all in one unit")
    if said and "" in units:
        raise CirlError(f"{units['']}: states no unit, as others do; write '{said[0]}' if that is it")
    if not said and given is None:
        raise CirlError(f"{path}: states no unit; give one with --unit, such as kt/year")
    unit = said[0] if said else str(given)
    try:
        factor(unit, "kg/year")
        return unit
    except CirlError:
        # yearly masses are flows
        _factor(str(path), unit, "kg")
        return f"{unit}/year"


def _factor(where: str, unit: str, target: str) -> float:
    try:
        return factor(unit, target)
    except CirlError as error:
        raise CirlError(f"{where}: {error}") from error


def _check_years(table: FlowTable) -> None:
    """Refuse a region without any flow in a year between the first and the last."""
    known = {(region, year) for region, year, _ in table.flows}
    for region in table.regions:
        missing = [year for year in table.years if (region, year) not in known]
        if missing:
            whose = f"region '{region}'" if region else "the table"
            said = ", ".join(map(str, missing[:5])) + (", …" if len(missing) > 5 else "")
            remedy = "a flow that is not in the table is 0, but a year without any is missing. Add it, or leave it out"
            raise CirlError(f"{table.name}: {whose} has no flow in {said}: {remedy} everywhere")


def _grids(path: Path, sheet: str | None) -> Iterator[_Grid]:
    """Yield the tables of a file."""
    if not path.is_file():
        raise CirlError(f"{path}: no such file")
    if path.suffix.lower() in WORKBOOKS:
        yield from _sheets(path, sheet)
        return
    if sheet is not None:
        raise CirlError(f"{path}: is no workbook, so that it has no sheet '{sheet}'")
    try:
        with path.open(encoding="utf-8-sig", newline="") as file:
            reader = csv.reader(file, strict=True)
            numbered = [(reader.line_num, row) for row in reader if any(cell.strip() for cell in row)]
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise CirlError(f"{path}: is no CSV file in UTF-8: {error}") from error
    yield _grid(path.name, numbered)


def _sheets(path: Path, sheet: str | None) -> Iterator[_Grid]:
    from openpyxl import load_workbook
    from openpyxl.utils.exceptions import InvalidFileException

    try:
        book = load_workbook(path, read_only=True, data_only=True)
    except (OSError, InvalidFileException, BadZipFile, KeyError, ValueError) as error:
        raise CirlError(f"{path}: is no workbook that can be read: {error}") from error
    try:
        if sheet is not None and sheet not in book.sheetnames:
            raise CirlError(f"{path}: {unknown('sheet', sheet, book.sheetnames)}")
        years = [each for each in book.sheetnames if _is_year(each)]
        for name in [sheet] if sheet is not None else years or book.sheetnames[:1]:
            rows = enumerate(book[name].iter_rows(values_only=True), start=1)
            texts = [(line, ["" if cell is None else str(cell) for cell in row]) for line, row in rows]
            yield _grid(f"{path.name}, sheet '{name}'", [row for row in texts if any(each.strip() for each in row[1])])
    finally:
        book.close()


def _grid(name: str, numbered: Sequence[tuple[int, list[str]]]) -> _Grid:
    if not numbered:
        raise CirlError(f"{name}: is empty; its first line names the columns")
    (_, header), *rows = numbered
    for line, row in rows:
        if len(row) != len(header):
            raise CirlError(f"{name}, line {line}: {len(row)} cells in {len(header)} columns")
    return _Grid(name, header, list(rows))


def _is_year(text: str) -> bool:
    return len(text) == 4 and text.isdigit()
