"""A page of reference for each package of the library, which mkdocstrings fills from the docstrings."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import cirl_marl
from docs.site.markdown import ROOT, GeneratedPage, table

PACKAGE = "cirl_marl"


def api_pages() -> Iterator[GeneratedPage]:
    """Yield the page of what ``import cirl_marl`` offers, then one for each package."""
    offered = table(("name", "what it is"), map(_offered, cirl_marl.__all__))
    said = f"What `import {PACKAGE}` offers; its packages are described one by one."
    yield GeneratedPage(f"api/{PACKAGE}.md", PACKAGE, f"# {PACKAGE}\n\n{said}\n\n{offered}\n")
    for path in sorted((ROOT / PACKAGE).glob("[!_]*")):
        name = f"{PACKAGE}.{path.stem}"
        if path.suffix == ".py":
            yield GeneratedPage(f"api/{name}.md", name, f"# {name}\n\n::: {name}\n")
        elif (path / "__init__.py").is_file():
            face = ast.get_docstring(ast.parse((path / "__init__.py").read_text(encoding="utf-8")))
            blocks = [f"# {name}", str(face).replace("``", "`")]
            blocks += [f"## {name}.{each}\n\n::: {name}.{each}" for each in _modules(path)]
            yield GeneratedPage(f"api/{name}.md", name, "\n\n".join(blocks) + "\n")


def _offered(name: str) -> tuple[str, str]:
    """Return a name with a link to where it is described, and the first line of its docstring."""
    found = getattr(cirl_marl, name)
    said = str(inspect.getdoc(found)).partition("\n")[0].replace("``", "`")
    return f"[`{name}`][{found.__module__}.{found.__qualname__}]", said


def _modules(folder: Path) -> list[str]:
    """Return the modules of a package, by dotted name within it."""
    files = sorted(path.relative_to(folder).with_suffix("") for path in folder.rglob("*.py"))
    return [".".join(path.parts) for path in files if not path.name.startswith("_")]
