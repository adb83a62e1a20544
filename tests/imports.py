"""Who imports whom in a checkout, read from the syntax trees; as a script it draws the floors of the house.

    python tests/imports.py [CHECKOUT]

Every import counts, those inside functions, under ``TYPE_CHECKING`` and in stubs too. A *room* is a sub-package of
``cirl_marl`` or a module at its top; a room stands one floor above the highest of those that it imports.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path

import networkx as nx

PACKAGE = "cirl_marl"


def modules(checkout: Path) -> dict[str, Path]:
    """Return the file of every module of the package, by dotted name."""
    files = {}
    for path in sorted((checkout / PACKAGE).rglob("*.py")):
        parts = path.relative_to(checkout).with_suffix("").parts
        files[".".join(parts[:-1] if parts[-1] == "__init__" else parts)] = path
    return files


def imported(text: str, known: Iterable[str]) -> set[str]:
    """Return the modules of the package that a file imports, wherever in it; a name counts as its module's."""
    everyone, found = set(known), set()
    for statement in ast.walk(ast.parse(text)):
        if isinstance(statement, ast.ImportFrom):
            if statement.level:
                raise ValueError("relative imports are not read: name the package")
            named = [f"{statement.module}.{alias.name}" for alias in statement.names]
            found |= {name if name in everyone else str(statement.module) for name in named}
        elif isinstance(statement, ast.Import):
            found |= {alias.name for alias in statement.names}
    return found & everyone


def arrows(files: Mapping[str, Path]) -> nx.DiGraph:
    """Return the digraph of modules, an edge from each to those that it imports."""
    graph = nx.DiGraph()
    graph.add_nodes_from(files)
    for module, path in files.items():
        for file in filter(Path.is_file, (path, path.with_suffix(".pyi"))):
            graph.add_edges_from((module, other) for other in imported(file.read_text(encoding="utf-8"), files))
    return graph


def circles(graph: nx.DiGraph) -> list[list[str]]:
    """Return the sets of modules that import each other in a loop."""
    loops = [sorted(part) for part in nx.strongly_connected_components(graph) if len(part) > 1]
    return sorted(loops + [[each] for each in nx.nodes_with_selfloops(graph)])


def room_of(module: str) -> str:
    """Return the sub-package or top module that a module belongs to; the package's own face is ``__init__``."""
    return [*module.split("."), "__init__"][1]


def rooms(graph: nx.DiGraph) -> nx.DiGraph:
    """Return the digraph of rooms."""
    house = nx.DiGraph()
    house.add_nodes_from(room_of(module) for module in graph)
    house.add_edges_from((room_of(a), room_of(b)) for a, b in graph.edges if room_of(a) != room_of(b))
    return house


def floors(house: nx.DiGraph) -> dict[str, int]:
    """Return the floor of each room, 1 for the ground; rooms in a circle share theirs."""
    whole = nx.condensation(house)
    level: dict[int, int] = {}
    for part in reversed(list(nx.topological_sort(whole))):
        level[part] = 1 + max((level[other] for other in whole.successors(part)), default=0)
    return {room: level[part] for room, part in whole.graph["mapping"].items()}


def drawing(checkout: Path) -> Iterator[str]:
    """Yield the house from the top floor down: each room with its lines and what it imports; then the circles."""
    files = modules(checkout)
    graph = arrows(files)
    house = rooms(graph)
    lines: dict[str, int] = {}
    for module, path in files.items():
        lines[room_of(module)] = lines.get(room_of(module), 0) + len(path.read_text(encoding="utf-8").splitlines())
    level = floors(house)
    for floor in range(max(level.values()), 0, -1):
        for room in sorted(room for room in level if level[room] == floor):
            below = ", ".join(sorted(house.successors(room), key=lambda other: (-level[other], other)))
            yield f"{floor:3}  {room} ({lines[room]:,})" + (f" <- {below}" if below else "")
    yield f"{len(house)} rooms, {max(level.values())} floors, {sum(lines.values()):,} lines"
    loops = circles(graph)
    yield "circles of modules: " + ("; ".join(" <-> ".join(loop) for loop in loops) or "none")
    loops = circles(house)
    yield "circles of rooms: " + ("; ".join(" <-> ".join(loop) for loop in loops) or "none")


if __name__ == "__main__":
    sys.stdout.write("\n".join(drawing(Path(*sys.argv[1:]))) + "\n")
