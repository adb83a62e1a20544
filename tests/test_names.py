"""A name means one thing: no face hides a module, and no two classes share a name."""

from __future__ import annotations

import ast
import importlib
from collections import defaultdict
from collections.abc import Iterable, Iterator
from pathlib import Path
from types import ModuleType

from imports import modules

CHECKOUT = Path(__file__).parent.parent


def exported(text: str) -> set[str]:
    """Return what a file imports or lists in ``__all__``, by the name that it has there."""
    names: set[str] = set()
    for statement in ast.walk(ast.parse(text)):
        if isinstance(statement, ast.ImportFrom | ast.Import):
            names |= {alias.asname or alias.name for alias in statement.names}
        elif isinstance(statement, ast.Assign) and "__all__" in {ast.unparse(target) for target in statement.targets}:
            names |= set(ast.literal_eval(statement.value))
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


def test_no_face_hides_a_module() -> None:
    """What a package offers under the name of one of its modules is that module."""
    for module, path in modules(CHECKOUT).items():
        if path.name != "__init__.py":
            continue
        beside = {other.stem for other in path.parent.glob("*.py")} | {
            other.parent.name for other in path.parent.glob("*/__init__.py")
        }
        face = importlib.import_module(module)
        for name in exported(path.read_text(encoding="utf-8")) & beside:
            assert isinstance(getattr(face, name), ModuleType), f"{module}.{name} is not its module {name}"


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
    assert exported("from a.b import c as d\n__all__ = ['e']") == {"d", "e"}
