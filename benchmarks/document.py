"""Documents with measured tables: each is a section between marks and is written anew; the prose around it stays."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import cirl_marl
from cirl_marl.errors import CirlError
from cirl_marl.records.files import write_atomically
from cirl_marl.records.machine import versions


def write_sections(document: Path, sections: Mapping[str, str]) -> None:
    """Put each section between its marks, ``<!-- name -->`` and ``<!-- /name -->``, all of them or none.

    Raises:
        CirlError: if the document lacks a mark.
    """
    text = document.read_text(encoding="utf-8")
    for name, section in sections.items():
        before, _, after = _parts(document, text, name)
        text = f"{before}\n{wrapped(section)}\n{after}"
    write_atomically(document, lambda path: path.write_text(text, encoding="utf-8"))


def _parts(document: Path, text: str, name: str) -> tuple[str, str, str]:
    """Return what stands up to the first mark of a section, between its marks, and from the last on."""
    start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
    if start not in text or end not in text:
        raise CirlError(f"{document}: has no marks {start} and {end}")
    before, rest = text.split(start, 1)
    section, after = rest.split(end, 1)
    return before + start, section, end + after


def wrapped(text: str) -> str:
    """Return a document whose lines end before column 120, but for tables and headings."""
    lines = []
    for line in text.split("\n"):
        indent = "  " if line.startswith(("- ", "  ")) else ""
        plain = len(line) <= 120 or line.startswith(("|", "#"))
        fill = textwrap.fill(line, 120, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
        lines.append(line if plain else fill)
    return "\n".join(lines)


def markdown_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table in Markdown.

    >>> print(markdown_table(("a", "b"), [("1", "2")]))
    | a | b |
    |-|-|
    | 1 | 2 |
    """
    lines = ("| " + " | ".join(cells) + " |" for cells in (columns, *rows))
    head, *body = lines
    return "\n".join([head, "|" + "-|" * len(columns), *body])


def table_rows(document: Path, section: str) -> list[list[str]]:
    """Return the cells of the table of a section, without its headings; none if it has no table.

    Raises:
        CirlError: if the document lacks a mark.
    """
    _, text, _ = _parts(document, document.read_text(encoding="utf-8"), section)
    lines = [line for line in text.splitlines() if line.startswith("|")]
    return [line.removeprefix("| ").removesuffix(" |").split(" | ") for line in lines[2:]]


def measured_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table in Markdown, and below it what it was made with."""
    return f"{markdown_table(columns, rows)}\n\n{made_with()}"


def made_with() -> str:
    """Return a line with the versions that figures depend on."""
    found = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"Made with cirl-marl {cirl_marl.__version__}: {found}."
