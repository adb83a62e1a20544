"""Tables of flows and stocks, long or as a matrix of processes, in CSV files and workbooks."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from operator import itemgetter
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np

from cirl_marl.definitions.data_files import no_collection, number_in
from cirl_marl.errors import CirlError, check_names, first_lines
from cirl_marl.importing.grids import Grid, GridPart, Memo, is_year, plain_text, read_grids
from cirl_marl.importing.substance_flows import SubstanceFlows, SubstanceRows, amount_scale
from cirl_marl.network import Floats, Integers
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.units import factor

LAST_YEAR = 9999
LONG = {"source", "target", "year", "value", "unit"}
"""Columns of which a long table has most, should the name of one be misspelt."""
ROUNDING = 1e-9
"""By how much a part of a stock may be more than 1, as amounts round."""


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
    """Flows by region, year and pair; what is not in the table is 0."""

    name: Annotated[str, "the file"]
    unit: Annotated[str, "mass/time"]
    regions: Annotated[tuple[str, ...], "in the order of the file; one empty text if there are none"]
    pairs: Annotated[tuple[Connection, ...], "in the order of the file"]
    places: Annotated[Integers, "region and pair, counted, with the year between them, shape (3, flows)"]
    values: Annotated[Floats, "the flows, shape (flows,), mass/time"]
    deviations: Annotated[Floats, "standard deviations, NaN where none is stated, shape (flows,), mass/time"]
    substances: Annotated[SubstanceFlows | None, "what is in the flows; None if the table does not say"] = None

    @property
    def years(self) -> tuple[int, ...]:
        """First to last year."""
        return tuple(range(int(self.places[1].min()), int(self.places[1].max()) + 1))

    @property
    def flows(self) -> dict[tuple[str, int, Connection], float]:
        """The flows by region, year and pair."""
        cells = zip(*self.places.tolist(), self.values.tolist(), strict=True)
        return {(self.regions[region], year, self.pairs[pair]): value for region, year, pair, value in cells}

    def grid(self, values: Floats, fallback: float = 0.0) -> Floats:
        """Return ``values`` of flows with ``fallback`` for what is not in the table, shape (regions, years, pairs)."""
        grid = np.full((len(self.regions), len(self.years), len(self.pairs)), fallback)
        grid[self.cells] = values
        return grid

    @property
    def cells(self) -> tuple[Integers, ...]:
        """Where flows are in a grid."""
        return self.places[0], self.places[1] - self.places[1].min(), self.places[2]

    def of(self, regions: Sequence[str]) -> FlowTable:
        """Return the part of some regions.

        Raises:
            CirlError: for one that is not there; names the nearest.
        """
        regions = list(map(plain_text, regions))
        check_names("region", regions, self.regions, f"{self.name}: ")
        kept = np.isin(self.places[0], [i for i, region in enumerate(self.regions) if region in regions])
        places = self.places[:, kept]
        orders = [_order_of_appearance(numbers) for numbers in (places[0], places[2])]
        places[0], places[2] = (places_ for _, places_ in orders)
        names = [self.regions[i] for i in orders[0][0]], [self.pairs[i] for i in orders[1][0]]
        substances, first = self.substances, self.years[0]
        if substances is not None and places.size:
            years = slice(int(places[1].min()) - first, int(places[1].max()) - first + 1)
            substances = substances.part(orders[0][0], years, orders[1][0]).non_zero()
        return replace(
            self,
            regions=tuple(names[0]),
            pairs=tuple(names[1]),
            places=places,
            values=self.values[kept],
            deviations=self.deviations[kept],
            substances=substances,
        )


def _order_of_appearance(numbers: Integers) -> tuple[Integers, Integers]:
    """Return the different ``numbers`` in the order in which they come, and the place of each in that."""
    different, first, place = np.unique(numbers, return_index=True, return_inverse=True)
    order = np.argsort(first)
    return different[order], np.argsort(order)[place]


@no_collection()
def read_flows(path: Path, *, sheet: str | None = None, unit: str | None = None, year: int | None = None) -> FlowTable:
    """Read a table of flows.

    A long table has the columns source, target, year, value and unit, and may have type, region and uncertainty (a
    standard deviation in the same unit, or in percent, as ``5 %``). With a column substance, rows that name one say how
    much of it is in a flow, as a part or an amount. Instead of value and unit there may be one column
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
    regions: dict[str, int] = {}
    pairs: dict[Connection, int] = {}
    parts: list[_Entries] = []
    units: dict[str, str] = {}
    substances = SubstanceRows()
    if year is not None and not 1 <= year <= LAST_YEAR:
        raise CirlError(f"--year {year}: is no year from 1 to {LAST_YEAR}")
    for grid in read_grids(path, sheet):
        long = {"source", "target"} <= grid.places.keys() or len(LONG & grid.places.keys()) > 2
        of_grid = _long(grid, year, regions, pairs, substances) if long else None
        for entries in of_grid or _matrix(grid, year, regions, pairs):
            parts.append(entries)
            for unit_of_row, line in entries.units.items():
                units.setdefault(unit_of_row, f"{grid.name}, line {line}")
    if not any(part.places.size for part in parts):
        raise CirlError(f"{path}: has no flows")
    table = FlowTable(
        path.name,
        "",
        tuple(regions),
        tuple(pairs),
        np.concatenate([part.places for part in parts], axis=1),
        np.concatenate([part.values for part in parts]),
        np.concatenate([part.deviations for part in parts]),
    )
    _check_names(table, parts)
    _check_repetitions(table, parts)
    _check_years(table)
    unit = _unit(path, units, unit)
    table = _per_year(replace(table, unit=unit))
    if not substances.entries:
        return table
    labels, stated_flows = list(map(str, table.pairs)), table.grid(table.values, np.nan)
    found = substances.flows(stated_flows, table.years[0], table.unit, unit, table.regions, labels)
    for place, name in enumerate(found.names):
        if not found.amounts[place].any():
            raise CirlError(f"{path}: no flow has any {name}; leave its rows out, or correct them")
    return replace(table, substances=found)


def _per_year(table: FlowTable) -> FlowTable:
    """Return the table in masses per year."""
    unit = f"{table.unit.rpartition('/')[0]}/year"
    scale = factor(table.unit, unit)
    return replace(table, values=table.values * scale, deviations=table.deviations * scale, unit=unit)


def _check_repetitions(table: FlowTable, parts: Sequence[_Entries]) -> None:
    """Refuse flows that stand in a table twice; a ``CirlError`` names them."""
    region, year, pair = table.places
    numbers = (region * (LAST_YEAR + 1) + year) * len(table.pairs) + pair
    ordered = np.sort(numbers)
    if (ordered[1:] > ordered[:-1]).all():
        return
    _, first, place = np.unique(numbers, return_index=True, return_inverse=True)
    positions, faults = _positions(parts), []
    for later in np.flatnonzero(first[place] < np.arange(len(numbers))).tolist():
        owner = table.regions[region[later]]
        flow = f"{table.pairs[pair[later]]} in {year[later]}{f' in {owner}' if owner else ''}"
        fault = f"{flow} stands in line {positions[first[place[later]]][1]} too; leave one out, or give them types"
        faults.append("{}, line {}: {}".format(*positions[later], fault))
    raise CirlError("\n".join(first_lines(faults)))


def _positions(parts: Sequence[_Entries]) -> list[tuple[str, int]]:
    """Return the sheet and the line of each flow."""
    return [(part.name, line) for part in parts for line in part.lines]


def _check_names(table: FlowTable, parts: Sequence[_Entries]) -> None:
    """Refuse processes that differ in the case of letters alone, and rows that lack a region where others have one."""
    names: dict[str, str] = {}
    for name in (end for pair in table.pairs for end in (pair.source, pair.target)):
        if (first_name := names.setdefault(name.casefold(), name)) != name:
            raise CirlError(f"{table.name}: '{first_name}' and '{name}' differ in case alone; write them alike")
    if "" in table.regions and len(table.regions) > 1:
        first = int(np.flatnonzero(table.places[0] == table.regions.index(""))[0])
        raise CirlError("{}, line {}: states no region, as others do".format(*_positions(parts)[first]))


StockKey = tuple[str, str, int]
"""Region, process and year of a stock."""


def read_stocks(path: Path, unit: str) -> tuple[dict[StockKey, float], dict[str, dict[StockKey, float]]]:
    """Return stocks by region, process and year, in a unit of mass, and what part of them each substance is.

    The table is long, with the columns process, year, value and unit, and may have region and substance; of a substance
    it has an amount, or the part that it is of the stock.

    Raises:
        CirlError: naming file, line, column and value, with what to do.
    """
    stocks: dict[StockKey, float] = {}
    contents: dict[str, dict[StockKey, float]] = {}
    parts: list[GridPart] = []
    for grid in read_grids(path, None):
        grid.require(("process", "year", "value", "unit"))
        factors = Memo[str, float](lambda text: factor(text.strip(), unit), 1.0)
        for part in grid.parts():
            is_whole = [not name.strip() for name in part.of("substance")]
            parts.append(part.rows_in(np.logical_not(is_whole).tolist()))
            wholes = part.rows_in(is_whole)
            scales = wholes.convert(wholes.of("unit"), factors)
            for (key, line, value), scale in zip(_stock_rows(wholes), scales, strict=True):
                if key in stocks:
                    grid.note_fault(line, f"a stock of '{key[1]}' in {key[2]} stands there already")
                stocks[key] = value * scale
    for part in parts:
        rows = zip(_stock_rows(part), part.of("substance"), part.of("unit"), strict=True)
        for (key, line, value), name, text in rows:
            content = contents.setdefault(plain_text(name), {})
            try:
                if key in content:
                    raise CirlError(f"{plain_text(name)} of '{key[1]}' in {key[2]} stands there already")
                if key not in stocks:
                    raise CirlError(f"no row says what '{key[1]}' holds in {key[2]} in all; give it")
                content[key] = _part_of_stock(value, text.strip(), unit, stocks[key])
                if content[key] > 1:
                    fault = f"{content[key]:.4g} of '{key[1]}' is {plain_text(name)}"
                    raise CirlError(f"{fault}; it must be in [0, 1], in all of {stocks[key]:g} {unit}")
            except CirlError as error:
                part.grid.note_fault(line, str(error))
        part.grid.check()
    return stocks, contents


def _part_of_stock(value: float, text: str, unit: str, stock: float) -> float:
    """Return what part of a stock an amount of a substance is, or the part that is stated; 1 up to rounding is 1.

    Raises:
        CirlError: for a unit of neither.
    """
    if not text:
        raise CirlError(f"no unit; of a substance give a part, as in %, or an amount in {unit}")
    scale, is_part = amount_scale(text, unit)
    part = value * scale
    if not is_part:
        if part and not stock:
            raise CirlError(f"{part:g} {unit} of a stock of 0")
        part = part / stock if stock else 0.0
    return min(part, 1.0) if part <= 1 + ROUNDING else part


def _stock_rows(part: GridPart) -> Iterator[tuple[StockKey, int, float]]:
    """Yield region, process and year of each row, its line and value."""
    years = part.convert(part.of("year"), Memo(_year, 0))
    values = part.numbers(part.grid.places["value"], part.of("value")).tolist()
    for region, process, year, line, value in zip(
        part.of("region"), part.of("process"), years, part.lines, values, strict=True
    ):
        yield (plain_text(region), plain_text(process), year), line, value


@positional_record
class _Entries:
    """Flows of some rows."""

    name: Annotated[str, "of the grid"]
    lines: Annotated[Sequence[int], "of each flow"]
    places: Annotated[Integers, "region and pair, counted, with the year between them, shape (3, flows)"]
    values: Annotated[Floats, "shape (flows,)"]
    deviations: Annotated[Floats, "NaN where none is stated, shape (flows,)"]
    units: Annotated[Mapping[str, int], "the first line of each"]


def _long(
    grid: Grid,
    default_year: int | None,
    regions: dict[str, int],
    pairs: dict[Connection, int],
    substances: SubstanceRows,
) -> Iterator[_Entries]:
    """Yield the flows of a long table, and count the regions and pairs that are new; ``substances`` take their rows."""
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
    grid.require(("source", "target"))
    if default_year is None:
        grid.require(("year",), ", or --year")
    elif "year" in grid.places:
        raise CirlError(f"--year {default_year}: {grid.name} has a column of years; leave out one of them")
    ends = itemgetter(*(grid.places[key] for key in ("source", "target", "type") if key in grid.places))
    pair_numbers = Memo[tuple[str, ...], int](lambda cells: pairs.setdefault(_connection(cells), len(pairs)), 0)
    region_numbers = Memo[str, int](lambda text: regions.setdefault(plain_text(text), len(regions)), 0)
    years = Memo(_year, 0)

    def numbers(part: GridPart) -> tuple[Integers, Floats, Floats]:
        """Return places, values and deviations of rows."""
        year_of_row = [default_year or 0] * len(part.rows)
        if "year" in grid.places:
            year_of_row = part.convert(part.of("year"), years)
        region_of_row = part.convert(part.of("region"), region_numbers)
        pair_of_row = part.convert(list(map(ends, part.rows)), pair_numbers)
        values = part.numbers(grid.places["value"], part.of("value"))
        places = np.array([region_of_row, year_of_row, pair_of_row], dtype=np.intp)
        return places, values, _deviations(part, values)

    for part in grid.parts():
        is_of_substance = [bool(text.strip()) for text in part.of("substance")]
        if any(is_of_substance):
            in_flows = part.rows_in(is_of_substance)
            substances.take(in_flows, unit, *numbers(in_flows))
            part = part.rows_in([not is_of for is_of in is_of_substance])
        texts = part.of("unit")
        units = {unit or text.strip(): part.lines[texts.index(text)] for text in dict.fromkeys(texts)}
        yield _Entries(grid.name, part.lines, *numbers(part), units)


def _connection(cells: tuple[str, ...]) -> Connection:
    """Return the flow that the cells of a row name."""
    pair = Connection(*map(plain_text, cells))
    if not pair.source or not pair.target:
        raise CirlError("a flow needs a source and a target; of merged cells only the first has a text")
    if pair.source == pair.target:
        raise CirlError(f"{pair}: a flow needs two processes")
    return pair


def _year(text: str) -> int:
    """Return the year that a cell says."""
    value = number_in(text)
    if not (1 <= value <= LAST_YEAR and value == round(value)):
        raise CirlError(f"'{text.strip()}' is no whole year")
    return int(value)


def _deviations(part: GridPart, values: Floats) -> Floats:
    """Return the standard deviations that rows state, NaN where they state none, shape (rows,)."""
    deviations, column = np.full(len(values), np.nan), part.grid.places.get("uncertainty")
    if column is None:
        return deviations
    texts = [row[column].strip() for row in part.rows]
    stated = [i for i, text in enumerate(texts) if text]
    rows = GridPart(part.grid, [part.lines[i] for i in stated], [part.rows[i] for i in stated])
    scale = np.array([values[i] / 100 if texts[i].endswith("%") else 1.0 for i in stated])
    deviations[stated] = rows.numbers(column, [texts[i].rstrip("% ") for i in stated]) * scale
    return deviations


def _matrix(
    grid: Grid, default_year: int | None, regions: dict[str, int], pairs: dict[Connection, int]
) -> Iterator[_Entries]:
    """Yield the flows of a matrix of processes, which state no unit and no deviation, and count pairs that are new."""
    sheet_name = grid.name.rpartition(", sheet '")[2].rstrip("'")
    if is_year(sheet_name) and default_year is not None:
        raise CirlError(f"--year {default_year}: {grid.name} is named by its year; leave --year out, or give --sheet")
    year = int(sheet_name) if is_year(sheet_name) else default_year
    if year is None:
        raise CirlError(
            f"{grid.name}: is a matrix of processes, as it has no columns 'source' and 'target'; of which year? Give "
            "--year, or name its sheet by it"
        )
    targets = [plain_text(title) for title in grid.header[1:]]
    for target, count in Counter(targets).items():
        if not target or count > 1:
            problem = f"names '{target}' twice" if target else "has a column without a name"
            raise CirlError(f"{grid.name}, line 1: {problem}; each column is a process that receives")
    region = regions.setdefault("", len(regions))
    pair_numbers = Memo[tuple[str, ...], int](lambda cells: pairs.setdefault(_connection(cells), len(pairs)), 0)
    for part in grid.parts():
        columns = [[row[k].strip() or "0" for row in part.rows] for k in range(1, len(grid.header))]
        numbers = np.array([part.numbers(k, texts) for k, texts in enumerate(columns, 1)]).reshape(len(columns), -1)
        rows, receivers = (places.tolist() for places in np.nonzero(numbers.T))
        lines = [part.lines[i] for i in rows]
        ends = [(part.rows[i][0], targets[k]) for i, k in zip(rows, receivers, strict=True)]
        pair_of_flow = GridPart(grid, lines, part.rows).convert(ends, pair_numbers)
        places = np.array([[region] * len(ends), [year] * len(ends), pair_of_flow], dtype=np.intp)
        values, unstated = numbers[receivers, rows], np.full(len(ends), np.nan)
        yield _Entries(grid.name, lines, places, values, unstated, {"": lines[0]} if lines else {})


def _unit(path: Path, units: Mapping[str, str], default_unit: str | None) -> str:
    """Return the unit of all flows, mass/time."""
    stated_units = [unit for unit in units if unit]
    if len(stated_units) > 1:
        first, second = stated_units[:2]
        raise CirlError(f"{units[second]}: unit '{second}', but '{first}' in {units[first]}; give all in one unit")
    if stated_units and "" in units:
        raise CirlError(f"{units['']}: states no unit, as others do; write '{stated_units[0]}' if that is it")
    if stated_units and default_unit not in (None, stated_units[0]):
        place = units[stated_units[0]]
        raise CirlError(f"--unit {default_unit}: '{stated_units[0]}' stands in {place}; leave out one of them")
    if not stated_units and default_unit is None:
        raise CirlError(f"{path}: states no unit; give one with --unit, such as kt/year")
    unit = stated_units[0] if stated_units else str(default_unit)
    with suppress(CirlError):
        factor(unit, "kg/year")
        return unit
    try:
        factor(unit, "kg")
        return f"{unit}/year"  # yearly masses are flows
    except CirlError as error:
        raise CirlError(f"{units.get(unit, f'--unit {default_unit}')}: {error}") from error


def _check_years(table: FlowTable) -> None:
    """Refuse a region without any flow in a year between the first and the last."""
    present = np.zeros((len(table.regions), len(table.years)), dtype=bool)
    present[table.cells[:2]] = True
    for region, has_flows in zip(table.regions, present, strict=True):
        gaps = [year for year, is_present in zip(table.years, has_flows, strict=True) if not is_present]
        if gaps:
            owner = f"region '{region}'" if region else "the table"
            listing = ", ".join(map(str, gaps[:5])) + (", …" if len(gaps) > 5 else "")
            remedy = "a flow that is not in the table is 0, but a year without any is missing. Add it, or leave it out"
            raise CirlError(f"{table.name}: {owner} has no flow in {listing}: {remedy} everywhere")
