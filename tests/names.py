"""Which names of a package are pronouns or participles, by file; as a script it prints shares and the words.

    python tests/names.py [FOLDER …]

A *binding* is a place where a name is given: an assignment, a loop, a parameter, a function, a class, an attribute
that is stored. Underscores around a name are not part of it. Names of several words do not count: they say what they
mean.
"""

from __future__ import annotations

import ast
import re
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

PRONOUNS = frozenset(
    (
        "each every everyone everybody everything other others another one ones it its this that these those "
        "them they he she we us you me who whose whom which what whatever any anyone anything all some "
        "someone something none nobody nothing both either neither same such own ours theirs yours mine many "
        "few several here there where when how why"
    ).split()
)
IRREGULAR = frozenset(
    (
        "found told said known given asked taken made kept left held seen shown done gone begun chosen "
        "written drawn meant grown lost met paid sent spent got gotten built brought bought caught fed felt "
        "fought forgotten frozen heard hidden laid led lent lain born borne broken driven eaten fallen flown "
        "forbidden risen sold sought spoken stolen sworn taught thought thrown torn understood woken worn "
        "woven won wound stood struck stuck swept swung unmet undone unknown unseen withheld withdrawn been "
        "had become come overcome proven sawn sewn shaken shut sunk sung slept swum dealt dug bent bitten "
        "blown bred cast clung crept hung hurt knelt leant learnt lit mown overrun rid ridden rung shed shone "
        "shot shrunk slain slid slung sown sped spelt spilt spun sprung stung strewn striven swollen wept "
        "wrung awoken beaten burnt chidden outdone overdone overseen redone rewritten unsaid untold upheld"
    ).split()
)
# verbs, nouns and terms of the field that end as participles do
NO_PARTICIPLES = frozenset(
    (
        "seed speed need needs feed bed breed embed exceed proceed succeed red shed sled weed deed indeed "
        "truncated terminated string ring thing things king spring training padding rounding timing setting "
        "spacing heading mapping encoding scoring pricing sampling scaling mixing recycling drawing ordering "
        "indexing logging rendering warning sing bring routing testing importing pickling processing swing "
        "wing evening morning ceiling bearing lighting housing meaning reading writing finding embedding"
    ).split()
)
TERMS = frozenset({"done", "dones"})
"""Participles that Gymnasium and Stable-Baselines3 made names of arrays."""


def bindings(tree: ast.AST) -> Iterator[tuple[str, int, bool]]:
    """Yield every name that a syntax tree binds, with its line and whether it stands in a signature."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store):
            yield node.id, node.lineno, False
        elif isinstance(node, ast.Attribute) and isinstance(node.ctx, ast.Store):
            yield node.attr, node.lineno, False
        elif isinstance(node, ast.arg):
            yield node.arg, node.lineno, True
        elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            yield node.name, node.lineno, True


def is_filler(name: str) -> bool:
    """Return whether a name is a single pronoun or participle.

    >>> [name for name in ("found", "_each", "scaled", "seed", "found_plan", "stock") if is_filler(name)]
    ['found', '_each', 'scaled']
    """
    word = name.strip("_").lower()
    if name.startswith("__") or word in NO_PARTICIPLES | TERMS:
        return False
    return word in PRONOUNS | IRREGULAR or bool(re.fullmatch(r"[a-z]{2,}(ed|ing)", word))


def fillers(folder: Path) -> tuple[int, list[tuple[str, Path, int, bool]]]:
    """Return how many bindings the modules of a folder have, and the fillers among them: name, file, line, header."""
    count, places = 0, []
    for path in sorted(folder.rglob("*.py")):
        for name, line, header in bindings(ast.parse(path.read_text(encoding="utf-8"))):
            count += 1
            if is_filler(name):
                places.append((name, path, line, header))
    return count, places


def main() -> None:
    """Print the share of fillers in each folder, and the words."""
    for folder in map(Path, sys.argv[1:] or ["cirl_marl"]):
        count, places = fillers(folder)
        headers = sum(header for *_, header in places)
        words = ", ".join(f"{word} {n}" for word, n in Counter(name for name, *_ in places).most_common(60))
        share = len(places) / max(count, 1)
        sys.stdout.write(f"{folder}: {len(places)} of {count} bindings ({share:.2%}), {headers} in headers: {words}\n")


if __name__ == "__main__":
    main()
