"""Tables of flows and stocks, long or as a matrix of processes, in CSV files and workbooks."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, NamedTuple
from zipfile import BadZipFile

from cirl_marl.definitions.data_files import Line, csv_lines, even_lines, number_in
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.network.declarations import positional_record
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


class Connection(NamedTuple):
    """What a flow is: from which process to which, and of what type if the table says so."""

    source: str
    target: str
    type: str = ""

    def __str__(self) -> str:
        """Name it as in a message."""
        return f"'{self.source}' to '{self.target}'" + (f", {self.type}" if self.type else "")


@positional_record
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
                raise CirlError(f"{self.name}: {unknown_name('region', region, self.regions)}")
        selection = {key: value for key, value in self.flows.items() if key[0] in regions}
        return replace(self, flows=selection)


@dataclass(slots=True)
class _Grid:
    """The cells of a file or a sheet, as texts, with the line of each row."""

    name: str
    header: list[str]
    rows: list[Line]
    places: dict[str, int] = field(init=False)
    years: dict[str, int] = field(init=False, default_factory=dict)

    def __post_init__(self) -> None:
        plain = [title.strip().lower() for title in self.header]
        self.places = {}
        for key, names in NAMES.items():
            columns = [i for i, title in enumerate(plain) if title in names]
            if len(columns) > 1:
                titles = " and ".join(f"'{self.header[i]}'" for i in columns[:2])
                raise CirlError(f"{self.name}, line 1: {titles} both mean {key}; rename one")
            if columns:
                self.places[key] = columns[0]

    def at(self, row: Sequence[str], key: str) -> str:
        """Return a cell; nothing if there is no such column."""
        return row[self.places[key]].strip() if key in self.places else ""

    def number(self, line: int, text: str, column: str, *, least: float = 0.0) -> float:
        """Return a number of a cell.

        Raises:
            CirlError: naming file, line, column and text, if it is none or below ``least``.
        """
        value = number_in(text)
        if least <= value < math.inf:
            return value
        label = f"{self.name}, line {line}, column '{column}'"
        if not math.isfinite(value):
            raise CirlError(f"{label}: '{text}' is no number; write one as in 1234.5, or leave out the row")
        hint = "; a flow runs from source to target: swap them" if least == 0.0 else ""
        raise CirlError(f"{label}: {text} is negative{hint}")

    def year(self, line: int, text: str) -> int:
        if text not in self.years:
            value = self.number(line, text, self.header[self.places["year"]], least=-math.inf)
            if value != round(value):
                raise CirlError(f"{self.name}, line {line}: '{text}' is no whole year")
            self.years[text] = int(value)
        return self.years[text]


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
    lines: dict[tuple[str, int, Connection], int] = {}
    deviations: dict[tuple[str, int, Connection], float] = {}
    units: dict[str, str] = {}
    for grid in grids:
        long = {"source", "target"} <= grid.places.keys()
        for line, key, value, unit_of_row, deviation in _long(grid, year) if long else _matrix(grid, year):
            if key in flows:
                flow_text = f"{key[2]} in {key[1]}{f' in {key[0]}' if key[0] else ''}"
                fault = f"{flow_text} stands in line {lines[key]} too; leave one out, or give them types"
                raise CirlError(f"{grid.name}, line {line}: {fault}")
            if key[2].source == key[2].target:
                raise CirlError(f"{grid.name}, line {line}: {key[2]}: a flow needs two processes")
            flows[key], lines[key] = value, line
            if unit_of_row not in units:
                units[unit_of_row] = f"{grid.name}, line {line}"
            if deviation is not None:
                deviations[key] = deviation
    if not flows:
        raise CirlError(f"{path}: has no flows")
    table = FlowTable(path.name, _unit(path, units, unit), flows, deviations)
    _check_years(table)
    return table


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


def _long(grid: _Grid, default_year: int | None) -> Iterator[_Entry]:
    """Yield line, key, value, unit and deviation of each row of a long table."""
    unit = ""
    if "value" not in grid.places:
        used_columns = set(grid.places.values())
        unit_columns = [i for i, title in enumerate(grid.header) if i not in used_columns and "_per_" in title.lower()]
        if len(unit_columns) != 1:
            raise CirlError(
                f"{grid.name}, line 1: no column of values; call it 'value', or by its unit, as 'kt_per_year'"
            )
        grid.places["value"] = unit_columns[0]
        unit = grid.header[unit_columns[0]].strip().lower().replace("_per_", "/")
    if default_year is None:
        _needs(grid, ("year",))
    columns = [grid.places.get(key) for key in ("source", "target", "type", "region", "year", "value")]
    for line, row in grid.rows:
        cells = ["" if column is None else row[column].strip() for column in columns]
        source, target, type_, region, year_text, value_text = cells
        pair = Connection(source, target, type_)
        if not pair.source or not pair.target:
            raise CirlError(f"{grid.name}, line {line}: a flow needs a source and a target")
        year = default_year if columns[4] is None else grid.year(line, year_text)
        assert year is not None
        value = grid.number(line, value_text, grid.header[grid.places["value"]])
        deviation = None
        if uncertainty := grid.at(row, "uncertainty"):
            column = grid.header[grid.places["uncertainty"]]
            relative = uncertainty.endswith("%")
            deviation = grid.number(line, uncertainty.rstrip("% "), column) * (value / 100 if relative else 1.0)
        yield line, (region, year, pair), value, unit or grid.at(row, "unit"), deviation


def _matrix(grid: _Grid, default_year: int | None) -> Iterator[_Entry]:
    """Yield line, key, value, no unit and no deviation of each cell of a matrix of processes."""
    sheet_name = grid.name.rpartition(", sheet '")[2].rstrip("'")
    year = int(sheet_name) if _is_year(sheet_name) else default_year
    if year is None:
        raise CirlError(
            f"{grid.name}: is a matrix of processes, as it has no columns 'source' and 'target'; of which year? Give "
            "--year, or name its sheet by it"
        )
    targets = [title.strip() for title in grid.header[1:]]
    for target in targets:
        if not target or targets.count(target) > 1:
            problem = f"names '{target}' twice" if target else "has a column without a name"
            raise CirlError(f"{grid.name}, line 1: {problem}; each column is a process that receives")
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
            need = f"column '{key}'; it has {', '.join(filter(None, grid.header)) or 'none'}"
            raise CirlError(f"{grid.name}, line 1: needs a {need}. Separate columns with commas.")


def _unit(path: Path, units: Mapping[str, str], default_unit: str | None) -> str:
    """Return the unit of all flows, mass/time."""
    stated_units = [unit for unit in units if unit]
    if len(stated_units) > 1:
        first, second = stated_units[:2]
        raise CirlError(f"{units[second]}: unit '{second}', but '{first}' in {units[first]}; give all in one unit")
    if stated_units and "" in units:
        raise CirlError(f"{units['']}: states no unit, as others do; write '{stated_units[0]}' if that is it")
    if not stated_units and default_unit is None:
        raise CirlError(f"{path}: states no unit; give one with --unit, such as kt/year")
    unit = stated_units[0] if stated_units else str(default_unit)
    try:
        factor(unit, "kg/year")
        return unit
    except CirlError:
        # yearly masses are flows
        _factor(str(path), unit, "kg")
        return f"{unit}/year"


def _factor(place: str, unit: str, target: str) -> float:
    try:
        return factor(unit, target)
    except CirlError as error:
        raise CirlError(f"{place}: {error}") from error


def _check_years(table: FlowTable) -> None:
    """Refuse a region without any flow in a year between the first and the last."""
    with_flows = {(region, year) for region, year, _ in table.flows}
    for region in table.regions:
        gaps = [year for year in table.years if (region, year) not in with_flows]
        if gaps:
            owner = f"region '{region}'" if region else "the table"
            listing = ", ".join(map(str, gaps[:5])) + (", …" if len(gaps) > 5 else "")
            remedy = "a flow that is not in the table is 0, but a year without any is missing. Add it, or leave it out"
            raise CirlError(f"{table.name}: {owner} has no flow in {listing}: {remedy} everywhere")


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
        content = path.read_bytes()
    except OSError as error:
        raise CirlError(f"{path}: cannot be read: {error}") from error
    yield _grid(path.name, csv_lines(str(path), content))


def _sheets(path: Path, sheet: str | None) -> Iterator[_Grid]:
    try:
        from openpyxl import load_workbook
        from openpyxl.utils.exceptions import InvalidFileException
    except ImportError:
        raise CirlError(f"{path}: to read workbooks: pip install 'cirl-marl[excel]', or save it as CSV") from None
    try:
        book = load_workbook(path, read_only=True, data_only=True)
    except (OSError, InvalidFileException, BadZipFile, KeyError, ValueError) as error:
        raise CirlError(f"{path}: is no workbook that can be read: {error}") from error
    try:
        if sheet is not None and sheet not in book.sheetnames:
            raise CirlError(f"{path}: {unknown_name('sheet', sheet, book.sheetnames)}")
        years = [text for text in book.sheetnames if _is_year(text)]
        for name in [sheet] if sheet is not None else years or book.sheetnames[:1]:
            rows = enumerate(book[name].iter_rows(values_only=True), start=1)
            texts = [(line, ["" if cell is None else str(cell) for cell in row]) for line, row in rows]
            yield _grid(f"{path.name}, sheet '{name}'", texts)
    finally:
        book.close()


def _grid(name: str, lines: Sequence[Line]) -> _Grid:
    """Return the table of a file or a sheet, without lines of blanks."""
    (_, header), *rows = even_lines(name, [line for line in lines if any(cell.strip() for cell in line[1])])
    return _Grid(name, header, rows)


def _is_year(text: str) -> bool:
    return len(text) == 4 and text.isdigit()
