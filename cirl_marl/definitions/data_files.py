"""Columns of CSV files that stand beside a definition: numbers, and series of them."""

from __future__ import annotations

import csv
import gc
import hashlib
import io
import itertools
import math
import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any, TypeVar, overload

from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.network.calendar import YearOrDate
from cirl_marl.records.files import LARGEST, read_content, sha256_of

T = TypeVar("T")
CsvRow = str | list[str]
"""The cells of a row, or its line, in which commas separate them."""
Block = tuple[Sequence[int], list[list[str]]]
"""Rows of a table, with the numbers of the lines on which they end."""
BLOCK = 2048
"""Rows of a block."""
CHARACTERS = 2**16
"""Characters of a block, up to the end of a line."""
BREAK = re.compile("\r\n?|\n")
"""What ends a line, inside of a cell too."""
YEAR = "year"
"""The column of times, if a file has one of this name and nothing else is said."""


@dataclass(frozen=True, slots=True)
class Column:
    """Numbers of a column, with the times of the rows as the file has them; a single number without times if None."""

    times: Sequence[YearOrDate] | None
    values: Sequence[float]
    origin: str


@contextmanager
def no_collection() -> Iterator[None]:
    """Read without looking for garbage meanwhile: of a million rows none is part of a cycle, and looking takes long."""
    was_enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if was_enabled:
            gc.enable()


def csv_blocks(subject: str, content: bytes) -> Iterator[Block]:
    """Yield the rows of a CSV file that are not empty, some thousands at a time; a ``CirlError`` if it is none."""
    for lines, rows in _blocks(subject, content):
        yield lines, [row.split(",") if isinstance(row, str) else row for row in rows]


def _blocks(subject: str, content: bytes) -> Iterator[tuple[Sequence[int], Sequence[CsvRow]]]:
    """Yield the same rows, those of a file without quotes as the texts of their lines."""
    if b"\0" in content:
        raise CirlError(f"{subject}: is no CSV file in UTF-8: it has zero bytes, as UTF-16 has; save it in UTF-8")
    blocks: Iterator[tuple[Sequence[int], Sequence[CsvRow]]]
    blocks = _quoted_blocks(content) if b'"' in content else _plain_blocks(content)
    try:
        for lines, rows in blocks:
            if not all(rows):
                lines = [number for number, row in zip(lines, rows, strict=True) if row]
                rows = [row for row in rows if row]
            yield lines, rows
    except (UnicodeDecodeError, csv.Error) as error:
        remedy = "; save it in UTF-8" if isinstance(error, UnicodeDecodeError) else ""
        raise CirlError(f"{subject}: is no CSV file in UTF-8: {error}{remedy}") from error


def _plain_blocks(content: bytes) -> Iterator[tuple[Sequence[int], Sequence[CsvRow]]]:
    """Yield the lines of a file without quotes, in which every comma separates cells and every line is a row."""
    stream, line = io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig"), 1
    while text := stream.read(CHARACTERS):
        texts = (text + stream.readline()).removesuffix("\n").split("\n")
        yield range(line, line + len(texts)), texts
        line += len(texts)


def _quoted_blocks(content: bytes) -> Iterator[Block]:
    """Yield the rows of a file with quotes, in which cells may have commas and end lines."""
    reader = csv.reader(io.TextIOWrapper(io.BytesIO(content), encoding="utf-8-sig", newline=""), strict=True)
    line = 0
    while rows := list(itertools.islice(reader, BLOCK)):
        lines: Sequence[int] = range(line + 1, reader.line_num + 1)
        line = reader.line_num
        if len(lines) > len(rows):
            ends = itertools.accumulate(1 + sum(len(BREAK.findall(cell)) for cell in row) for row in rows)
            lines = [lines[end - 1] for end in ends]
        yield lines, rows


class CsvRows(Sequence[list[str]]):
    """The rows of a CSV file that are not empty; those of a file without quotes are texts until they are asked for.

    Attributes:
        lines: on which they end.
    """

    def __init__(self, subject: str, content: bytes) -> None:
        """Read them.

        Raises:
            CirlError: if it is no CSV file, there are no rows, or one is not as long as the first.
        """
        self.lines: list[int] = []
        self._rows: list[CsvRow] = []
        width = 0
        with no_collection():
            for lines, rows in _blocks(subject, content):
                width = width or _width(rows[0])
                check_lengths(subject, lines, rows, width)
                self.lines += lines
                self._rows += rows
        if not width:
            raise CirlError(f"{subject}: is empty; its first line names the columns")

    def __len__(self) -> int:
        """Count them, the header too."""
        return len(self._rows)

    @overload
    def __getitem__(self, i: int) -> list[str]: ...

    @overload
    def __getitem__(self, i: slice) -> list[list[str]]: ...

    def __getitem__(self, i: int | slice) -> list[str] | list[list[str]]:
        """Return the cells of a row, or of several."""
        if isinstance(i, slice):
            return [self[place] for place in range(*i.indices(len(self)))]
        row = self._rows[i]
        if isinstance(row, str):
            self._rows[i] = row = row.split(",")
        return row

    def columns(self, places: Sequence[int]) -> Iterator[tuple[str, ...]]:
        """Yield the cells of some columns of the rows below the header."""
        last = max(places, default=0) + 1
        for row in itertools.islice(self._rows, 1, None):
            cells = row.split(",", last) if isinstance(row, str) else row
            yield tuple([cells[place] for place in places])


def _width(row: CsvRow) -> int:
    return row.count(",") + 1 if isinstance(row, str) else len(row)


def check_lengths(subject: str, lines: Sequence[int], rows: Sequence[CsvRow], width: int) -> None:
    """Raise a ``CirlError`` if a row has not as many cells as there are columns."""
    if not set(map(_width, rows)) <= {width}:
        line, row = next((line, row) for line, row in zip(lines, rows, strict=True) if _width(row) != width)
        raise CirlError(f"{subject}, line {line}: {_width(row)} cells in {width} columns")


def number_in(text: str) -> float:
    """Return the number that a cell says, NaN if it says none."""
    try:
        return float(text.replace("_", "?"))
    except ValueError:
        return math.nan


class DataFiles:
    """The CSV files that one definition names, each read once.

    Attributes:
        read_values: what was made of their columns, by all that it depends on: scenarios read the same ones.
    """

    def __init__(self, folder: Path) -> None:
        """Look for files in ``folder``, that of the definition, and below it."""
        self._folder = folder.resolve()
        self._tables: dict[str, _Table] = {}
        self._plain_files: dict[str, str] = {}
        self._stamps: dict[Path, int] = {}
        self.read_values: dict[tuple[object, ...], Any] = {}

    @property
    def has_changed(self) -> bool:
        """Whether a file has changed, or is gone, since it was read."""
        return any(not path.is_file() or path.stat().st_mtime_ns != stamp for path, stamp in self._stamps.items())

    def sha256(self, name: str) -> str:
        """Return the hash of a file as it was read."""
        return self._plain_files.get(name) or self._table(name).sha256

    @property
    def plain_files(self) -> tuple[str, ...]:
        """The files that are no tables."""
        return tuple(self._plain_files)

    def plain_file(self, name: str) -> Path:
        """Return where a file is that is no table, and note its hash.

        Raises:
            CirlError: naming the file and what is wrong with it.
        """
        path = self._with_file_errors(name, self._path_of)
        self._plain_files[name] = sha256_of(path)
        return path

    def column(self, name: str, column: str, conditions: Mapping[str, str], times: str | None) -> Column:
        """Return the numbers of ``column`` in the rows whose columns have the texts of ``conditions``.

        ``times`` is the column of their times; None: ``year``, if there is such a column and ``conditions`` leave it
        free.

        Raises:
            CirlError: naming file, line, column and value, with what to do.
        """
        return self._table(name).column(column, conditions, times)

    def _table(self, name: str) -> _Table:
        return self._with_file_errors(name, self._read)

    def _with_file_errors(self, name: str, read: Callable[[str], T]) -> T:
        try:
            return read(name)
        except CirlError:
            raise
        except (OSError, RuntimeError, ValueError) as error:  # RuntimeError: links in a circle; ValueError: odd names
            raise CirlError(f"file '{name}': cannot be read: {error}") from error

    def _read(self, name: str) -> _Table:
        if name not in self._tables:
            self._tables[name] = _Table(name, read_content(self._path_of(name)))
        return self._tables[name]

    def _path_of(self, name: str) -> Path:
        """Return where a file is, which is not read again unless it is edited."""
        path, subject = self._folder / name, f"file '{name}'"
        if Path(name).is_absolute() or ".." in Path(name).parts or not path.resolve().is_relative_to(self._folder):
            raise CirlError(f"{subject}: must lie in {self._folder}, the folder of the definition, or below it")
        if not path.is_file():
            if path.exists() or path.is_symlink():
                raise CirlError(f"{subject}: is no file")
            beside = sorted(file.name for file in path.parent.glob(f"*{path.suffix or '.csv'}"))
            raise CirlError(f"{subject}: is not there; {unknown_name(f'file in {path.parent}', path.name, beside)}")
        if path.stat().st_size > LARGEST:
            raise CirlError(f"{subject}: is larger than {LARGEST // 10**6} MB; leave out rows that no 'where' chooses")
        self._stamps[path] = path.stat().st_mtime_ns
        return path


class _Table:
    """One CSV file."""

    def __init__(self, name: str, content: bytes) -> None:
        self.name, self.sha256 = name, hashlib.sha256(content).hexdigest()
        self.rows = CsvRows(f"file '{name}'", content)
        self.header = self.rows[0]
        self.place = {column: i for i, column in enumerate(self.header)}
        if len(self.place) != len(self.header):
            twice = next(name_ for name_ in self.header if self.header.count(name_) > 1)
            raise CirlError(f"file '{name}', line 1: names the column '{twice}' twice")
        self._indices: dict[tuple[int, ...], dict[tuple[str, ...], list[int]]] = {}

    def column(self, column: str, conditions: Mapping[str, str], times: str | None) -> Column:
        if times is None and YEAR in self.place and YEAR not in conditions:
            times = YEAR
        for key in (column, *conditions, *([] if times is None else [times])):
            if key not in self.place:
                fault = f"file '{self.name}': {unknown_name('column', key, self.header)}"
                raise CirlError(fault + ("" if len(self.header) > 1 else " Separate columns with commas."))
        matches = self._matching_rows(conditions)
        values = [self._number(i, column) for i in matches]
        conditions_text = " and ".join(f"{key} = '{value}'" for key, value in conditions.items())
        origin = f"{self.name}, column '{column}'" + (f", where {conditions_text}" if conditions else "")
        if times is not None:
            return Column(self._times(matches, times), values, origin)
        if len(matches) > 1:
            first, second, *_ = (self.rows.lines[i] for i in matches)
            remedy = "fix more columns in 'where', or name the column of times in 'times'"
            raise CirlError(f"{origin}: lines {first} and {second} both match; {remedy}")
        return Column(None, values, origin)

    def _matching_rows(self, conditions: Mapping[str, str]) -> list[int]:
        """Return the rows that match, by an index of the columns in ``conditions``: many series name the same ones."""
        keys = tuple(self.place[column_] for column_ in conditions)
        if keys not in self._indices:
            index: dict[tuple[str, ...], list[int]] = {}
            for i, texts in enumerate(self.rows.columns(keys), 1):
                if texts in index:
                    index[texts].append(i)
                else:
                    index[texts] = [i]
            self._indices[keys] = index
        matches = self._indices[keys].get(tuple(conditions.values()))
        if not matches:
            raise CirlError(f"file '{self.name}': {self._mismatch(conditions)}")
        return matches

    def _mismatch(self, conditions: Mapping[str, str]) -> str:
        """Say which entry of ``conditions`` leaves no row, with the nearest value that would leave one."""
        rows, before = self.rows[1:], ""
        for key, value in conditions.items():
            options = dict.fromkeys(row[self.place[key]] for row in rows)
            if value not in options:
                return f"no row matches 'where'{before}: {unknown_name(key, value, sorted(options))}"
            rows = [row for row in rows if row[self.place[key]] == value]
            before += f"{' and' if before else ' with'} {key} = '{value}'"
        return "has no rows"

    def _number(self, i: int, column: str) -> float:
        line, text = self.rows.lines[i], self.rows[i][self.place[column]]
        value = number_in(text)
        if not math.isfinite(value):
            remedy = "is no number; write one as in 1234.5" if text.strip() else "is empty; write a number, or 0"
            raise CirlError(f"file '{self.name}', line {line}, column '{column}': '{text}' {remedy}")
        return value

    def _times(self, matches: Iterable[int], column: str) -> list[YearOrDate]:
        """Return the times of rows, which increase; all numbers or all dates, as the first is."""
        has_dates = _date(self.rows[next(iter(matches))][self.place[column]]) is not None
        line_of: dict[Any, int] = {}
        latest: Any = None
        for i in matches:
            line, row = self.rows.lines[i], self.rows[i]
            subject = f"file '{self.name}', line {line}, column '{column}'"
            text = row[self.place[column]]
            time: Any = _date(text) if has_dates else self._number(i, column)
            if time is None:
                raise CirlError(f"{subject}: '{text}' is no date such as 2020-03-01, as others are")
            if time in line_of:
                remedy = "fix more columns in 'where', or leave one row out"
                raise CirlError(f"{subject}: '{text}' stands in line {line_of[time]} too; {remedy}")
            if line_of and time < latest:
                raise CirlError(f"{subject}: '{text}' comes after a later time; sort the rows by '{column}'")
            line_of[time], latest = line, time
        return list(line_of)


def _date(text: str) -> date | None:
    try:
        return date.fromisoformat(text)
    except ValueError:
        return None
