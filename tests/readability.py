"""How much a newcomer is asked to read: ``python tests/readability.py [CHECKOUT]``.

It prints words page by page, lines of the package, adapters apart, and which share of its names are no terms.

Counted are the words of every document that is written by hand, as ``wc -w`` counts them: code blocks, commands and
tables that somebody typed included. Not counted is what a program writes: ``docs/format.md``, the tables of
``docs/paper_tables.md``, and what stands between marks ``<!-- name -->`` and ``<!-- /name -->``.
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from names import fillers

ROOT = Path(__file__).parent.parent
FILES = ("README.md", "CONTRIBUTING.md", "CHANGELOG.md", "docs/*.md", "[a-z]*/README.md")
"""The documents of a checkout."""
GENERATED = ("docs/format.md",)
PAGE = 1500
"""Most words of a page, which answers one question."""
ALL = 24_000
"""Most words in all: half of the 41 713 that the documents once had, and what has come since about other questions."""


def documents(root: Path = ROOT) -> list[Path]:
    """Return the documents of a checkout that are at least partly written by hand."""
    paths = [path for pattern in FILES for path in sorted(root.glob(pattern))]
    return [path for path in paths if str(path.relative_to(root)) not in GENERATED]


def handwritten(path: Path) -> str:
    """Return the text of a document without what programs write into it."""
    text = path.read_text(encoding="utf-8")
    if path.name == "paper_tables.md":  # an introduction, and a comment on the tables
        introduction = text.split("\n## In short")[0]
        comment = text.split("\n## What the tables say")[1].split("\n## ")[0]
        text = introduction + comment
    return re.sub(r"^<!-- (\w+) -->$.*?^<!-- /\1 -->$", "", text, flags=re.M | re.S)


def words(root: Path = ROOT) -> dict[str, int]:
    """Return how many words of each document are written by hand."""
    return {str(path.relative_to(root)): len(handwritten(path).split()) for path in documents(root)}


def lines(root: Path = ROOT) -> dict[bool, int]:
    """Return how many lines the package has: under True those of its adapters, under False all others."""
    counts = {True: 0, False: 0}
    for path in (root / "cirl_marl").rglob("*.py"):
        counts["adapters" in path.parts] += len(path.read_text(encoding="utf-8").splitlines())
    return counts


def main() -> None:
    """Print words by page, longest first, and their sum; then lines and names."""
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT
    counts = words(root)
    for name, count in sorted(counts.items(), key=lambda pair: -pair[1]):
        sys.stdout.write(f"{count:7,}  {name}\n")
    sys.stdout.write(f"{sum(counts.values()):7,}  words in {len(counts)} documents\n")
    code, (bindings, places) = lines(root), fillers(root / "cirl_marl")
    share = len(places) / bindings
    sys.stdout.write(f"{code[False]:7,}  lines of cirl_marl, and {code[True]:,} of its adapters\n")
    sys.stdout.write(f"{len(places):7,}  of {bindings:,} names ({share:.2%}) pronouns or participles\n")


if __name__ == "__main__":
    main()
