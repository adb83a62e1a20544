"""Rows of texts, of a CSV file or of a sheet, by what their columns mean: some thousands at a time."""

from __future__ import annotations

import itertools
import math
import unicodedata
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import TypeVar

import numpy as np

from cirl_marl.definitions.data_files import Block, csv_blocks, number_in
from cirl_marl.errors import CirlError, check_names, first_lines
from cirl_marl.importing.workbooks import read_sheets
from cirl_marl.network import Floats
from cirl_marl.network.declarations import LARGEST, SMALLEST
from cirl_marl.records.files import read_content

K = TypeVar("K")
V = TypeVar("V")
NAMES: Mapping[str, tuple[str, ...]] = {
    "source": ("source", "from", "origin"),
    "target": ("target", "to", "destination"),
    "year": ("year", "time"),
    "value": ("value", "flow", "amount", "mass"),
    "unit": ("unit", "units"),
    "type": ("type", "good", "material"),
    "region": ("region", "country"),
    "uncertainty": ("uncertainty", "deviation"),
    "substance": ("substance", "element"),
    "process": ("process", "node", "stock of"),
}
"""What columns may be called, whatever the case."""
WORKBOOKS = (".xlsx", ".xlsm")
MOST_FAULTS = 1000
"""Rows with a fault after which reading ends."""


@dataclass(frozen=True, slots=True)
class GridPart:
    """Some rows of a grid, and the numbers of the lines on which they end."""

    grid: Grid
    lines: Sequence[int]
    rows: Sequence[Sequence[str]]

    def of(self, key: str) -> list[str]:
        """Return the texts of a column; empty ones if there is no such column."""
        if key not in self.grid.places:
            return [""] * len(self.rows)
        return list(map(itemgetter(self.grid.places[key]), self.rows))

    def rows_in(self, mask: Sequence[bool]) -> GridPart:
        """Return the rows of a mask."""
        places = [i for i, is_in in enumerate(mask) if is_in]
        return GridPart(self.grid, [self.lines[i] for i in places], [self.rows[i] for i in places])

    def convert(self, texts: Sequence[K], values: Memo[K, V]) -> list[V]:
        """Return what the texts of each row mean; of one that means nothing the fallback, and its fault is noted."""
        try:
            return list(map(values.__getitem__, texts))
        except CirlError:
            return [self._meaning(line, text, values) for line, text in zip(self.lines, texts, strict=True)]

    def _meaning(self, line: int, text: K, values: Memo[K, V]) -> V:
        try:
            return values[text]
        except CirlError as error:
            self.grid.note_fault(line, str(error))
            return values.fallback

    def numbers(self, column: int, texts: Sequence[str]) -> Floats:
        """Return the numbers of a column, shape (rows,); 0 for what is none, or negative, and that fault is noted."""
        try:
            values = list(map(float if "_" not in "".join(texts) else number_in, texts))
        except ValueError:
            values = list(map(number_in, texts))
        array = np.array(values, dtype=float)
        is_good = (array == 0.0) | ((array >= SMALLEST) & (array <= LARGEST))
        for i in np.flatnonzero(~is_good).tolist():
            fault = f"{texts[i]} must be 0, or between {SMALLEST:g} and {LARGEST:g} in size"
            if not math.isfinite(values[i]):
                fault = f"'{texts[i]}' is no number; write one as in 1234.5, or leave out the row"
            elif values[i] < 0.0:
                is_flow = "process" not in self.grid.places and column != self.grid.places.get("uncertainty")
                fault = f"{texts[i]} is negative" + is_flow * "; a flow runs from source to target: swap them"
            self.grid.note_fault(self.lines[i], fault, column)
        return np.where(is_good, array, 0.0)


class Memo(dict[K, V]):
    """What texts mean, found once for each; ``fallback`` stands for what means nothing until that is told."""

    def __init__(self, meaning: Callable[[K], V], fallback: V) -> None:
        """Let ``meaning`` find it."""
        super().__init__()
        self._meaning, self.fallback = meaning, fallback

    def __missing__(self, key: K) -> V:
        """Find what a text means."""
        value = self[key] = self._meaning(key)
        return value


class Grid:
    """The cells of a file or a sheet, as texts, some thousands of rows at a time; blank rows are left out.

    Attributes:
        header: texts of the first row.
        places: columns by what they mean.
    """

    def __init__(self, name: str, blocks: Iterator[Block]) -> None:
        """Read the header; a ``CirlError`` if there is none, or if two columns mean the same."""
        self.name = name
        self._blocks = (block for block in map(_without_blanks, blocks) if block[1])
        empty: Block = (0,), [[]]
        lines, rows = next(self._blocks, empty)
        self.header = rows[0]
        self._first: Block = lines[1:], rows[1:]
        if not self.header:
            raise CirlError(f"{name}: is empty; its first line names the columns")
        if separator := next((mark for mark in ";\t|" if len(self.header) == 1 and mark in self.header[0]), ""):
            remedy = "save it with commas, and with points in numbers, or import the workbook itself"
            raise CirlError(f"{name}, line 1: its cells are separated by {separator!r}; {remedy}")
        self._faults: dict[int, str] = {}
        plain = [title.strip().lower() for title in self.header]
        self.places: dict[str, int] = {}
        for key, names in NAMES.items():
            columns = [i for i, title in enumerate(plain) if title in names]
            if len(columns) > 1:
                titles = " and ".join(f"'{self.header[i]}'" for i in columns[:2])
                raise CirlError(f"{self.name}, line 1: {titles} both mean {key}; rename one")
            if columns:
                self.places[key] = columns[0]

    def parts(self) -> Iterator[GridPart]:
        """Yield the rows below the header; in the end a ``CirlError`` names what was wrong with them."""
        width = len(self.header)
        for lines, rows in itertools.chain([self._first], self._blocks):
            part = GridPart(self, lines, rows)
            if not set(map(len, rows)) <= {width}:
                for line, row in zip(lines, rows, strict=True):
                    if len(row) != width:
                        self.note_fault(line, f"{len(row)} cells in {width} columns")
                part = part.rows_in([len(row) == width for row in rows])
            yield part
        self.check()

    def note_fault(self, line: int, fault: str, column: int | None = None) -> None:
        """Keep what is wrong with a row, the first of it; see ``check``."""
        place = "" if column is None else f", column '{self.header[column]}'"
        self._faults.setdefault(line, f"{self.name}, line {line}{place}: {fault}")
        if len(self._faults) == MOST_FAULTS:
            self.check()

    def check(self) -> None:
        """Raise a ``CirlError`` if there were faults: it names the first rows, and how many more there are."""
        if self._faults:
            raise CirlError("\n".join(first_lines([fault for _, fault in sorted(self._faults.items())])))

    def require(self, keys: Sequence[str], remedy: str = "") -> None:
        """Refuse a grid that lacks one of some columns; a ``CirlError`` names it."""
        for key in keys:
            if key not in self.places:
                columns = ", ".join(filter(None, self.header)) or "none"
                raise CirlError(f"{self.name}, line 1: needs a column '{key}'{remedy}; it has {columns}")


def _without_blanks(block: Block) -> Block:
    lines, rows = block
    if all(map(str.strip, map(itemgetter(0), rows))):
        return block
    filled = [i for i, row in enumerate(rows) if row[0].strip() or any(map(str.strip, row))]
    return [lines[i] for i in filled], [rows[i] for i in filled]


def read_grids(path: Path, sheet: str | None) -> Iterator[Grid]:
    """Yield the tables of a file."""
    if not path.exists():
        raise CirlError(f"{path}: no such file")
    try:
        content = read_content(path)
    except OSError as error:
        raise CirlError(f"{path}: cannot be read: {error}") from error
    if path.suffix.lower() in WORKBOOKS:
        for name, rows in read_sheets(path, content, lambda names: _sheet_names(path, names, sheet)):
            yield Grid(f"{path.name}, sheet '{name}'", iter([rows]))
        return
    if sheet is not None:
        raise CirlError(f"{path}: is no workbook, so that it has no sheet '{sheet}'")
    yield Grid(path.name, csv_blocks(str(path), content))


def _sheet_names(path: Path, names: Sequence[str], sheet: str | None) -> Sequence[str]:
    """Return which sheets of a workbook are read: the one that is named, those of years, or the first."""
    if sheet is None:
        return [name for name in names if is_year(name)] or names[:1]
    check_names("sheet", [sheet], names, f"{path}: ")
    return [sheet]


def plain_text(text: str) -> str:
    """Return a name in one form of each letter, with one space between words: what looks alike is alike.

    >>> plain_text(" Scho\u0308n\u00a0 und gut") == "Schön und gut"
    True
    """
    return " ".join(unicodedata.normalize("NFC", text).split())


def is_year(text: str) -> bool:
    """Return whether a sheet is named by a year."""
    return len(text) == 4 and text.isascii() and text.isdigit()
