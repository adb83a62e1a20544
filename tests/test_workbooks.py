"""Workbooks of strangers: they unpack within bounds, declare no entities, lead nowhere, and say what was computed."""

from __future__ import annotations

import os
import re
import struct
import time
import tracemalloc
import zipfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from openpyxl import Workbook

from cirl_marl import CirlError
from cirl_marl.importing import workbooks
from cirl_marl.importing.flow_table import read_flows

ROWS = [["source", "target", "year", "value", "unit"], ["Ore", "Works", 2000, 3.5, "kt/year"]]
SHEET = "xl/worksheets/sheet1.xml"


@pytest.fixture
def book(tmp_path: Path) -> Path:
    """Return a workbook with one flow."""
    workbook = Workbook()
    assert workbook.active is not None
    for row in ROWS:
        workbook.active.append(row)
    workbook.save(path := tmp_path / "flows.xlsx")
    assert sum(read_flows(path).flows.values()) == 3.5
    return path


def rewritten(book: Path, change: Callable[[str], str | bytes], part: str = SHEET) -> Path:
    """Write a part of a workbook anew."""
    with zipfile.ZipFile(book) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    changed = change(contents.get(part, b"").decode())
    contents[part] = changed if isinstance(changed, bytes) else changed.encode()
    with zipfile.ZipFile(book, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in contents.items():
            archive.writestr(name, content)
    return book


def laughs(text: str) -> str:
    """Declare entities that grow."""
    entities = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10 if i else "x" * 10}">' for i in range(10))
    return f"<!DOCTYPE worksheet [{entities}]>" + text.replace("Ore", "&e9;")


def outside(path: Path) -> Callable[[str], str]:
    """Return what declares an entity that is a file."""
    return lambda text: f'<!DOCTYPE worksheet [<!ENTITY e SYSTEM "file://{path}">]>' + text.replace("Ore", "&e;")


def in_utf_16(change: Callable[[str], str]) -> Callable[[str], bytes]:
    """Return a change, in an encoding in which no search for letters finds it."""
    start = '<?xml version="1.0" encoding="UTF-16"?>'
    return lambda text: (start + change(re.sub(r"<\?xml.*?\?>", "", text))).encode("utf-16")


def wide(text: str) -> str:
    """Put a cell in the last column of many rows."""
    rows = "".join(f'<row r="{i}"><c r="ZZZ{i}" t="n"><v>1</v></c></row>' for i in range(3, 1200))
    return text.replace("</sheetData>", f"{rows}</sheetData>")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (laughs, "declares a document type"),
        (outside(Path("/etc/passwd")), "declares a document type"),
        (in_utf_16(laughs), "declares a document type"),
        (lambda text: "<!--" + "x" * 2 * workbooks.PROLOG + "-->" + text, "does not begin"),
        (lambda text: text + " " * (workbooks.UNPACKED + 1), r"unpacks to \d+ MB, and at most"),
        (lambda text: text.replace('<row r="2"', '<row r="99999999999"'), r"more than \d+ rows"),
        (wide, "million cells"),
        (lambda text: text.replace("<v>3.5</v>", f"<v>{'9' * 5000}</v>"), "is no workbook that can be read"),
        (lambda text: text[: len(text) // 2], "is no workbook that can be read"),
        (lambda text: "", "is no workbook that can be read"),
    ],
)  # fmt: skip
def test_hostile_sheets_are_refused(
    change: Callable[[str], str], said: str, book: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In a line, soon, and in little memory."""
    monkeypatch.setattr(workbooks, "CELLS", 10**6)
    monkeypatch.setattr(workbooks, "ROWS", 2**16)
    rewritten(book, change)
    began = time.process_time()
    tracemalloc.start()
    try:
        with pytest.raises(CirlError, match=said) as refused:
            read_flows(book)
        _, most = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert "\n" not in str(refused.value) and "root:" not in str(refused.value)
    assert most < 10**8 and time.process_time() - began < 20.0


def test_what_a_sheet_says_of_its_size_is_not_asked(book: Path) -> None:
    """Neither a million of columns nor a single cell."""
    for reference in ("A1:XFD1048576", "A1", "XFD1048576", "C3:A1"):
        rewritten(book, partial(re.sub, '<dimension ref="[^"]*"', f'<dimension ref="{reference}"'))
        assert sum(read_flows(book).flows.values()) == 3.5


def formulas(path: Path, *, computed: bool) -> Path:
    """Write a matrix with formulas, two of them blank; a spreadsheet program keeps what they came to."""
    workbook = Workbook()
    assert workbook.active is not None
    workbook.active.title = "2000"
    workbook.active.append(["", "Works", "Dump"])
    workbook.active.append(["Ore", "=1+2", '=IF(1,"",1)'])
    workbook.active.append(["Works", None, "=B2-1"])
    workbook.save(path)
    if computed:
        values = {"1+2": "3", "B2-1": "2"}
        rewritten(
            path,
            lambda text: re.sub(
                r"<f>(.*?)</f><v ?/?>(</v>)?", lambda f: f"<f>{f[1]}</f><v>{values.get(f[1], '')}</v>", text
            ),
        )
    return path


def test_formulas_stand_for_what_they_came_to(tmp_path: Path) -> None:
    """One that nobody has computed is no flow of 0."""
    table = read_flows(formulas(tmp_path / "computed.xlsx", computed=True), unit="kt")
    assert sorted(table.flows.values()) == [2.0, 3.0]
    with pytest.raises(CirlError, match=r"sheet '2000', line 2, column 2: =1\+2 has no value yet; open it in a spread"):
        read_flows(formulas(tmp_path / "written.xlsx", computed=False), unit="kt")


def test_other_files_are_not_read(book: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A link to another workbook is none to what is read, and nobody connects to anything."""
    import socket

    monkeypatch.setattr(socket.socket, "connect", lambda *_: pytest.fail("connects"))
    link = '<externalLink xmlns="http://schemas.openxmlformats.org/spreadsheetml/2006/main"/>'
    rewritten(book, lambda _: link, "xl/externalLinks/externalLink1.xml")
    rewritten(
        book,
        lambda _: (
            '<Relationships xmlns="http://schemas.openxmlformats.org/package/2006/relationships"><Relationship '
            'Id="rId1" Type="http://schemas.openxmlformats.org/officeDocument/2006/relationships/externalLinkPath" '
            'Target="http://127.0.0.1:9/other.xlsx" TargetMode="External"/></Relationships>'
        ),
        "xl/externalLinks/_rels/externalLink1.xml.rels",
    )
    assert sum(read_flows(book).flows.values()) == 3.5


def test_an_archive_within_bounds_by_its_own_word(book: Path) -> None:
    """A part that says it is small, and is not, ends where it said."""
    rewritten(book, lambda text: text + " " * 10**7)
    content = bytearray(book.read_bytes())
    for entry in re.finditer(rb"PK\x01\x02", bytes(content)):
        name = entry.start() + 46
        if content[name : name + len(SHEET)] == SHEET.encode():
            content[entry.start() + 24 : entry.start() + 28] = struct.pack("<I", 100)
    book.write_bytes(content)
    with pytest.raises(CirlError, match="is no workbook that can be read"):
        read_flows(book)


def test_files_that_never_end(tmp_path: Path) -> None:
    """A pipe or a device in the place of a table is refused at once."""
    os.mkfifo(pipe := tmp_path / "flows.csv")
    for path in (pipe, Path("/dev/zero"), tmp_path):
        with pytest.raises(CirlError, match="no regular file"):
            read_flows(path)
