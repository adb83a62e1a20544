"""Sheets of workbooks as texts: computed values alone, within bounds."""

from __future__ import annotations

import io
import itertools
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any
from xml.parsers import expat
from zipfile import ZipFile

from cirl_marl.definitions.data_files import Block
from cirl_marl.errors import CirlError

UNPACKED = 100_000_000
"""Bytes to which the largest workbook that is read unpacks."""
CELLS = 20_000_000
"""Cells of the largest sheet that is read, counted to the last one of each row."""
ROWS = 2**20
"""Rows that a sheet can have."""
PROLOG = 2**16
"""Bytes within which the root of an XML file begins."""

SheetRow = Sequence[Any]


def read_sheets(
    path: Path, content: bytes, choose: Callable[[Sequence[str]], Sequence[str]]
) -> list[tuple[str, Block]]:
    """Return names and rows of sheets, those that ``choose`` takes of all names.

    A formula stands for the value that was computed last. Macros, links to other files and pictures are not read, and
    nothing is asked what the file says of its own size.

    Raises:
        CirlError: if openpyxl is not installed, for what is no workbook, for one that unpacks to more than is read,
            that declares entities, or whose formulas nobody has computed.
    """
    try:
        from openpyxl import load_workbook
    except ImportError:
        raise CirlError(f"{path}: to read workbooks: pip install 'cirl-marl[excel]', or save it as CSV") from None

    def rows(name: str, *, data_only: bool) -> list[SheetRow]:
        book = load_workbook(io.BytesIO(content), read_only=True, keep_links=False, data_only=data_only)
        return list(_rows(book[name]))

    try:
        _check_parts(content)
        with warnings.catch_warnings():
            warnings.filterwarnings("ignore", module="openpyxl")  # of styles and extensions, which are not read
            names = load_workbook(io.BytesIO(content), read_only=True, keep_links=False).sheetnames
            results = []
            for name in choose(names):
                values = rows(name, data_only=True)
                if any(None in row for row in values):
                    _check_formulas(f"{path}, sheet '{name}'", values, rows(name, data_only=False))
                results.append((name, _block(values)))
            return results
    except CirlError:
        raise
    except Exception as error:  # openpyxl lets through whatever damaged files make its parsers raise
        raise CirlError(f"{path}: is no workbook that can be read: {error}") from error


def _check_parts(content: bytes) -> None:
    """Refuse an archive that unpacks to too much, and XML with a document type, whose entities may grow or read."""
    with ZipFile(io.BytesIO(content)) as archive:
        if (size := sum(part.file_size for part in archive.infolist())) > UNPACKED:
            raise ValueError(f"it unpacks to {size / 1e6:.0f} MB, and at most {UNPACKED // 10**6} MB are read")
        for part in archive.infolist():
            with archive.open(part) as file:
                _check_prolog(part.filename, file.read(PROLOG))


def _check_prolog(name: str, content: bytes) -> None:
    """Refuse XML that declares a document type before its root; what is no XML is let through."""
    seen: list[str] = []
    parser = expat.ParserCreate()
    parser.StartDoctypeDeclHandler = lambda *_: seen.append("document type")
    parser.StartElementHandler = lambda *_: seen.append("root")
    try:
        parser.Parse(content)
    except expat.ExpatError:
        if not seen:
            return
    if seen[:1] != ["root"]:
        raise ValueError(f"{name} declares a document type, or does not begin")


def _rows(sheet: Any) -> Iterator[SheetRow]:
    """Yield the rows of a sheet, each to its last cell that holds something."""
    sheet.reset_dimensions()  # what the file says of them may be wrong, or absurd
    cells = 0
    for line, row in enumerate(sheet.iter_rows(min_row=1, min_col=1, values_only=True), 1):
        cells += len(row)
        if line > ROWS or cells > CELLS:
            raise ValueError(f"more than {ROWS} rows or {CELLS // 10**6} million cells in sheet '{sheet.title}'")
        end = len(row)
        while end and row[end - 1] is None:
            end -= 1
        yield row[:end]


def _check_formulas(subject: str, values: Sequence[SheetRow], formulas: Sequence[SheetRow]) -> None:
    """Refuse a sheet none of whose formulas has a value: a program wrote it, and nobody has computed it."""
    first = ""
    for line, (row, formula_row) in enumerate(zip(values, formulas, strict=True), 1):
        for column, (value, formula) in enumerate(itertools.zip_longest(row, formula_row), 1):
            if value is None and formula is not None:
                first = first or f"line {line}, column {column}: {str(formula)[:40]}"
            elif value != formula:
                return
    if first:
        raise CirlError(f"{subject}, {first} has no value yet; open it in a spreadsheet program, and save it there")


def _block(values: Sequence[SheetRow]) -> Block:
    """Return rows as texts, all as long as the longest, with the numbers of their lines."""
    width = max(map(len, values), default=0)
    texts = [["" if cell is None else str(cell) for cell in row] for row in values]
    if width * len(texts) > CELLS:
        raise ValueError(f"more than {CELLS // 10**6} million cells")
    blank = [""]
    numbered = [(line, row + blank * (width - len(row))) for line, row in enumerate(texts, 1) if row]
    return [line for line, _ in numbered], [row for _, row in numbered]
