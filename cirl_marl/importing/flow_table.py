"""Tables of flows and stocks, long or as a matrix of processes, in CSV files and workbooks."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from operator import itemgetter
from pathlib import Path
from typing import Annotated, NamedTuple

from cirl_marl.definitions.data_files import no_collection, number_in
from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.importing.grids import Grid, GridPart, Memo, is_year, read_grids
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.units import factor

LAST_YEAR = 9999


class Connection(NamedTuple):
    """What a flow is: from which process to which, and of what type if the table says so."""

    source: str
    target: str
    type: str = ""

    def __str__(self) -> str:
        """Name it as in a message."""
        return f"'{self.source}' to '{self.target}'" + (f", {self.type}" if self.type else "")


Key = tuple[str, int, Connection]
"""Region, empty where there are none, year, and what the flow is."""


@positional_record
class FlowTable:
    """Flows by region, year and pair; what is not in ``flows`` is 0."""

    name: Annotated[str, "the file"]
    unit: Annotated[str, "mass/time"]
    flows: Annotated[Mapping[Key, float], "by region (empty without regions), year and pair"]
    deviations: Annotated[Mapping[Key, float], "standard deviations, of those that state one"]

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
            if region not in (present := self.regions):
                raise CirlError(f"{self.name}: {unknown_name('region', region, present)}")
        selection = {key: value for key, value in self.flows.items() if key[0] in regions}
        return replace(self, flows=selection)


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
    with no_collection():
        return _read_flows(path, sheet, unit, year)


def _read_flows(path: Path, sheet: str | None, default_unit: str | None, default_year: int | None) -> FlowTable:
    flows: dict[Key, float] = {}
    keys: list[Key] = []
    places: list[tuple[str, Sequence[int]]] = []
    deviations: dict[Key, float] = {}
    units: dict[str, str] = {}
    present: dict[tuple[str, int], None] = {}
    for grid in read_grids(path, sheet):
        long = {"source", "target"} <= grid.places.keys()
        for entries in _long(grid, default_year) if long else _matrix(grid, default_year):
            flows.update(zip(entries.keys, entries.values, strict=True))
            keys += entries.keys
            present |= dict.fromkeys(map(itemgetter(0, 1), entries.keys))
            places.append((grid.name, entries.lines))
            deviations |= entries.deviations
            for unit_of_row, line in entries.units.items():
                units.setdefault(unit_of_row, f"{grid.name}, line {line}")
            if len(flows) < len(keys):
                raise CirlError(_repetition(keys, places))
    if not flows:
        raise CirlError(f"{path}: has no flows")
    _check_years(path.name, present)
    return FlowTable(path.name, _unit(path, units, default_unit), flows, deviations)


def _repetition(keys: Sequence[Key], places: Sequence[tuple[str, Sequence[int]]]) -> str:
    """Say which flow stands in a table twice."""
    line_of: dict[Key, int] = {}
    positions = ((name, line) for name, lines in places for line in lines)
    for (region, year, pair), (name, line) in zip(keys, positions, strict=True):
        if (earlier := line_of.setdefault((region, year, pair), line)) != line:
            flow = f"{pair} in {year}{f' in {region}' if region else ''}"
            return f"{name}, line {line}: {flow} stands in line {earlier} too; leave one out, or give them types"
    raise AssertionError("no flow stands there twice")


def read_stocks(path: Path, unit: str) -> dict[tuple[str, str, int], float]:
    """Return stocks by region, process and year, in a unit of mass.

    The table is long, with the columns process, year, value and unit, and may have region.

    Raises:
        CirlError: naming file, line, column and value, with what to do.
    """
    stocks: dict[tuple[str, str, int], float] = {}
    for grid in read_grids(path, None):
        grid.require(("process", "year", "value", "unit"))
        factors = Memo[str, float](lambda text: factor(text.strip(), unit))
        for part in grid.parts():
            years = part.convert(part.of("year"), Memo(_year))
            values, scales = (
                part.numbers(grid.places["value"], part.of("value")),
                part.convert(part.of("unit"), factors),
            )
            cells = zip(part.of("region"), part.of("process"), years, part.lines, values, scales, strict=True)
            for region, process, year, line, value, scale in cells:
                key = region.strip(), process.strip(), year
                if key in stocks:
                    raise CirlError(f"{grid.name}, line {line}: a stock of '{key[1]}' in {year} stands there already")
                stocks[key] = value * scale
    return stocks


@dataclass(frozen=True, slots=True)
class _Entries:
    """Flows of some rows: their lines, keys and values, the first line of each unit, and deviations that are stated."""

    lines: Sequence[int]
    keys: list[Key]
    values: list[float]
    units: Mapping[str, int]
    deviations: Mapping[Key, float]


def _long(grid: Grid, default_year: int | None) -> Iterator[_Entries]:
    """Yield the flows of a long table."""
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
        grid.require(("year",))
    ends = itemgetter(*(grid.places[key] for key in ("source", "target", "type") if key in grid.places))
    pairs, years, regions = Memo(_connection), Memo(_year), Memo[str, str](str.strip)
    for part in grid.parts():
        year_of_row: Iterable[int] = itertools.repeat(default_year or 0, len(part.rows))
        if "year" in grid.places:
            year_of_row = part.convert(part.of("year"), years)
        region_of_row = part.convert(part.of("region"), regions)
        keys = list(zip(region_of_row, year_of_row, part.convert(list(map(ends, part.rows)), pairs), strict=True))
        values = part.numbers(grid.places["value"], part.of("value"))
        texts = part.of("unit")
        units = {unit or text.strip(): part.lines[texts.index(text)] for text in dict.fromkeys(texts)}
        yield _Entries(part.lines, keys, values, units, dict(_deviations(part, keys, values)))


def _connection(cells: tuple[str, ...]) -> Connection:
    """Return the flow that the cells of a row name."""
    pair = Connection(*map(str.strip, cells))
    if not pair.source or not pair.target:
        raise CirlError("a flow needs a source and a target")
    if pair.source == pair.target:
        raise CirlError(f"{pair}: a flow needs two processes")
    return pair


def _year(text: str) -> int:
    """Return the year that a cell says."""
    value = number_in(text)
    if not (1 <= value <= LAST_YEAR and value == round(value)):
        raise CirlError(f"'{text.strip()}' is no whole year")
    return int(value)


def _deviations(part: GridPart, keys: Sequence[Key], values: Sequence[float]) -> Iterator[tuple[Key, float]]:
    """Yield the standard deviations that rows state, by their keys."""
    column = part.grid.places.get("uncertainty")
    if column is not None:
        texts = [row[column].strip() for row in part.rows]
        stated = [i for i, text in enumerate(texts) if text]
        rows = GridPart(part.grid, [part.lines[i] for i in stated], [part.rows[i] for i in stated])
        deviations = rows.numbers(column, [texts[i].rstrip("% ") for i in stated])
        for i, deviation in zip(stated, deviations, strict=True):
            yield keys[i], deviation * (values[i] / 100 if texts[i].endswith("%") else 1.0)


def _matrix(grid: Grid, default_year: int | None) -> Iterator[_Entries]:
    """Yield the flows of a matrix of processes, which state no unit and no deviation."""
    sheet_name = grid.name.rpartition(", sheet '")[2].rstrip("'")
    year = int(sheet_name) if is_year(sheet_name) else default_year
    if year is None:
        raise CirlError(
            f"{grid.name}: is a matrix of processes, as it has no columns 'source' and 'target'; of which year? Give "
            "--year, or name its sheet by it"
        )
    targets = [title.strip() for title in grid.header[1:]]
    for target, count in Counter(targets).items():
        if not target or count > 1:
            problem = f"names '{target}' twice" if target else "has a column without a name"
            raise CirlError(f"{grid.name}, line 1: {problem}; each column is a process that receives")
    pairs = Memo(_connection)
    for part in grid.parts():
        columns = [[row[k].strip() or "0" for row in part.rows] for k in range(1, len(grid.header))]
        numbers = [part.numbers(k, texts) for k, texts in enumerate(columns, 1)]
        lines, ends, values = [], [], []
        for line, row, row_values in zip(part.lines, part.rows, zip(*numbers, strict=True), strict=True):
            for target, value in zip(targets, row_values, strict=True):
                if value > 0:
                    lines.append(line)
                    ends.append((row[0], target))
                    values.append(value)
        keys = [("", year, pair) for pair in GridPart(grid, lines, part.rows).convert(ends, pairs)]
        yield _Entries(lines, keys, values, {"": lines[0]} if lines else {}, {})


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


def _check_years(name: str, present: Mapping[tuple[str, int], None]) -> None:
    """Refuse a region without any flow in a year between the first and the last."""
    years = [year for _, year in present]
    for region in dict.fromkeys(region for region, _ in present):
        gaps = [year for year in range(min(years), max(years) + 1) if (region, year) not in present]
        if gaps:
            owner = f"region '{region}'" if region else "the table"
            listing = ", ".join(map(str, gaps[:5])) + (", …" if len(gaps) > 5 else "")
            remedy = "a flow that is not in the table is 0, but a year without any is missing. Add it, or leave it out"
            raise CirlError(f"{name}: {owner} has no flow in {listing}: {remedy} everywhere")
