"""A name means one thing, and says it: no two modules or classes share a name, none is a pronoun or a participle."""

from __future__ import annotations

import ast
import importlib
import re
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

import pytest
from imports import PACKAGE, modules
from names import fillers

CHECKOUT = Path(__file__).parent.parent
SHARE = 0.01
"""Most bindings that may be pronouns or participles."""
SIGNATURES = {
    "DigesterPublished": "of two words: the digester as published",
    "WasteSorting": "of two words, a task of the paper and the name of its environment",
    "pretrained": "the word of the field for policies that come with a library (torchvision, Hugging Face)",
    "Trained": "the controller of a trained run, next to ``train`` in the public interface",
}
"""Names in signatures that look like pronouns or participles, with the reason why they stay."""


def imported(text: str, module: str | None = None) -> set[str]:
    """Return what a file imports, of ``module`` or of any, by the name that it has there."""
    names: set[str] = set()
    for statement in ast.walk(ast.parse(text)):
        if isinstance(statement, ast.ImportFrom) and module in (None, statement.module):
            names |= {alias.asname or alias.name for alias in statement.names}
        elif isinstance(statement, ast.Import) and module is None:
            names |= {alias.asname or alias.name for alias in statement.names}
    return names


def types_of(text: str) -> Iterator[str]:
    """Yield the public classes and type aliases that a file defines at its top."""
    for statement in ast.parse(text).body:
        name = ""
        if isinstance(statement, ast.ClassDef):
            name = statement.name
        elif isinstance(statement, ast.Assign) and isinstance(statement.targets[0], ast.Name):
            name = statement.targets[0].id
        elif isinstance(statement, ast.AnnAssign):
            name = ast.unparse(statement.target)
        if name[:1].isupper() and not name.isupper():
            yield name


def shared(texts: Iterable[tuple[str, str]]) -> dict[str, list[str]]:
    """Return the type names that several files define, with the files."""
    homes = defaultdict(list)
    for module, text in texts:
        for name in types_of(text):
            homes[name].append(module)
    return {name: found for name, found in homes.items() if len(found) > 1}


def hidden(module: str, path: Path) -> set[str]:
    """Return the names that a package gives to something else than its module of that name."""
    face, text = importlib.import_module(module), path.read_text(encoding="utf-8")
    beside = {file.stem for file in path.parent.glob("*.py")} | {
        file.parent.name for file in path.parent.glob("*/__init__.py")
    }
    offers = imported(text) | set(getattr(face, "__all__", ()))
    return {
        name
        for name in (offers & beside) - imported(text, module)
        if name in getattr(face, "__all__", ()) or not isinstance(getattr(face, name), ModuleType)
    }


def test_no_face_hides_a_module() -> None:
    """What a package offers under the name of one of its modules is that module, and no function or class."""
    faces = {module: path for module, path in modules(CHECKOUT).items() if path.name == "__init__.py"}
    assert len(importlib.import_module(PACKAGE).__all__) > 50
    assert {module: names for module, path in faces.items() if (names := hidden(module, path))} == {}


def test_one_module_per_file_name() -> None:
    """No two modules of the package have the same name, in whatever sub-packages they are."""
    homes = defaultdict(list)
    for path in modules(CHECKOUT).values():
        if path.name != "__init__.py":
            homes[path.name].append(str(path.relative_to(CHECKOUT)))
    assert len(homes) > 100
    assert {name: places for name, places in homes.items() if len(places) > 1} == {}


def test_names_say_what_things_are() -> None:
    """At most one in a hundred names is a pronoun or a participle, and none in a signature."""
    count, places = fillers(CHECKOUT / PACKAGE)
    assert count > 10_000 and len(places) <= SHARE * count
    signatures = {name: f"{path}:{line}" for name, path, line, header in places if header}
    assert {name: place for name, place in signatures.items() if name not in SIGNATURES} == {}
    assert set(SIGNATURES) <= set(signatures)  # else the exception is none any longer


def test_one_type_per_name() -> None:
    """No public class or type alias has a namesake in another module."""
    texts = ((module, path.read_text(encoding="utf-8")) for module, path in modules(CHECKOUT).items())
    assert not shared(texts)


def test_namesakes_are_found() -> None:
    """Classes and aliases of every spelling count; constants and private names do not."""
    texts = [
        ("a", "class Row: ...\nWIDTH = 1\n_Hidden = int\n"),
        ("b", "Row = list[int]\nWIDTH = 2\n_Hidden = float\nProgress: TypeAlias = int\n"),
        ("c", "Progress = float\n"),
    ]
    assert shared(texts) == {"Row": ["a", "b"], "Progress": ["b", "c"]}
    assert imported("from a.b import c as d\nimport e") == {"d", "e"}
    assert imported("from a.b import c as d\nimport e\nfrom f import g", "a.b") == {"d"}


def test_hidden_modules_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A function with a module's name hides it, wherever it comes from and even if ``__all__`` is computed."""
    monkeypatch.syspath_prepend(tmp_path)
    for package, text in {
        "hiding_by_import": "from os.path import join as part",
        "hiding_by_name": "__all__ = sorted({'part'})",
        "hiding_none": "from hiding_none import part\n__all__ = ['part']",
    }.items():
        (tmp_path / package).mkdir()
        (tmp_path / package / "__init__.py").write_text(text)
        (tmp_path / package / "part.py").write_text("")
        assert hidden(package, tmp_path / package / "__init__.py") == (set() if package == "hiding_none" else {"part"})


def test_docstrings_name_attributes_that_there_are() -> None:
    """What a class says of its attributes is of those that its module gives it, and not of what they once were."""
    for path in (CHECKOUT / PACKAGE).rglob("*.py"):
        text = path.read_text(encoding="utf-8")
        for class_ in (node for node in ast.walk(ast.parse(text)) if isinstance(node, ast.ClassDef)):
            _, _, section = (ast.get_docstring(class_) or "").partition("Attributes:\n")
            for name in re.findall(r"^    (\w+):", section.split("\n\n")[0], re.M):
                found = re.search(rf"self\.{name}\b|^    (?:def )?{name}\b", text, re.M)
                assert found, f"{path.name}: {class_.name} has no attribute '{name}'"
