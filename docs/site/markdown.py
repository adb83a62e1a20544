"""Pages and parts of them in Markdown."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from rich.table import Table

from benchmarks.document import markdown_table

ROOT = Path(__file__).parent.parent.parent
WRITTEN = (
    *(ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")),
    *sorted(ROOT.glob("docs/*.md")),
    *sorted(ROOT.glob("[a-z]*/README.md")),
    *sorted(ROOT.glob("examples/notebooks/*.md")),
)
"""The documents that are written by hand, and the notebooks, which are kept as they came out."""
MORE_OF = ("networks", "data", "compartments")
"""Documents whose sections say why a network or a model is as it is."""


@dataclass(frozen=True)
class GeneratedPage:
    """A page that code makes.

    Attributes:
        uri: where it stands on the site, such as ``networks/copper_net.md``.
        title: what the navigation calls it.
        text: in Markdown.
        files: contents of the pictures beside it, by name.
    """

    uri: str
    title: str
    text: str
    files: Mapping[str, bytes] = field(default_factory=dict)


def table(columns: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Write a table; ``|`` and line breaks in cells are kept from ending them."""
    cells = ([_cell(each) for each in row] for row in rows)
    return markdown_table([_cell(each) for each in columns], cells)


def _cell(value: object) -> str:
    text = f"{value:.5g}" if isinstance(value, float) else str(value)
    return text.replace("|", r"\|").replace("\n", " ")


def shown(found: Table) -> str:
    """Write a table that is made for the terminal."""
    rows = zip(*(column.cells for column in found.columns), strict=True)
    return table([str(column.header) for column in found.columns], rows)


def folded(summary: str, text: str) -> str:
    """Write a part that the reader opens."""
    body = "\n".join(f"    {line}" if line else "" for line in text.splitlines())
    return f'??? info "{summary}"\n\n{body}\n'


def anchor(heading: str) -> str:
    """Return the anchor that GitHub gives a heading, and the site too."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def sections(text: str) -> list[tuple[str, str]]:
    """Return the headings of a document, each with what follows it before the next one."""
    bare = re.sub(r"^```.*?^```$", "", text, flags=re.M | re.S)
    parts = re.split(r"^#+ (.*)$", bare, flags=re.M)
    return list(zip(parts[1::2], parts[2::2], strict=True))


def sections_about(name: str, file: str = "") -> list[str]:
    """Return links, from a folder of the site, to where the documents tell of a network or model.

    These are the sections that name it in their heading; if there are none, the first that names it, or its definition
    ``file``, in its text.
    """
    headed, told = [], []
    for stem in MORE_OF:
        for heading, text in sections((ROOT / "docs" / f"{stem}.md").read_text(encoding="utf-8")):
            link = f"[{stem}.md](../docs/{stem}.md#{anchor(heading)})"
            if name in re.findall(r"\w+", heading):
                headed.append(link)
            elif f"`{name}`" in text or (file and f"`envs/{file}`" in text):
                told.append(link)
    return headed or told[:1]
