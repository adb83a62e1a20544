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
        start, end = f"<!-- {name} -->", f"<!-- /{name} -->"
        if start not in text or end not in text:
            raise CirlError(f"{document}: has no marks {start} and {end} to write between")
        before, rest = text.split(start, 1)
        text = f"{before}{start}\n{wrapped(section)}\n{end}{rest.split(end, 1)[1]}"
    write_atomically(document, lambda path: path.write_text(text, encoding="utf-8"))


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


def measured_table(columns: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Write a table in Markdown, and below it what it was made with."""
    return f"{markdown_table(columns, rows)}\n\n{made_with()}"


def made_with() -> str:
    """Return a line with the versions that figures depend on."""
    found = ", ".join(f"{name} {version}" for name, version in versions().items())
    return f"Made with cirl-marl {cirl_marl.__version__}: {found}."
