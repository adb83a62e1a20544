"""What a scenario changes in a definition: tables laid over those of the default one, and what is left out first."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

from cirl_marl.errors import unknown_name

COMMON_KEYS = ("name", "regions", "scenarios")
"""What is the same in every scenario."""
WHOLE = {"nodes": ("role",), "arcs": ("from", "to"), "services": ("provider",)}
"""What a table must say to be a new node, arc or service rather than a change of one."""


def overlay(base: Mapping[str, Any], override: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the tables of ``override`` laid over it, key by key, where they do not take its place."""
    result = {key: value for key, value in base.items() if key != "scenarios"}
    for key, value in override.items():
        old = result.get(key)
        if isinstance(old, Mapping) and isinstance(value, Mapping) and not _takes_its_place(value, old):
            result[key] = overlay(old, value)
        else:
            result[key] = value
    return result


def _takes_its_place(new: Mapping[str, Any], old: Mapping[str, Any]) -> bool:
    """Whether a scenario's table replaces the old one whole: a quantity, or a model or control of another kind.

    One that only says what disturbs a quantity leaves the quantity as it is.
    """
    kind = old.get("kind")
    if isinstance(kind, str):
        return bool(new.get("kind", kind) != kind)
    if new.keys() <= {"disturbed_by", "disturbed_as"}:
        return False
    return any(isinstance(old.get(key), str | list) for key in ("source", "file", "times"))


def without_paths(document: Mapping[str, Any], override: Mapping[str, Any]) -> dict[str, Any]:
    """Return a copy of ``document`` less the tables at the dotted paths in ``override["without"]``, which exist."""
    remainder = dict(document)
    for path in override.get("without", []):
        *parents, last = path.split(".")
        table = remainder
        for key in parents:
            table[key] = dict(table[key])
            table = table[key]
        del table[last]
    return remainder


def path_mistakes(document: Mapping[str, Any], paths: Any, prefix: str) -> Iterator[str]:
    """Yield what is wrong with the dotted paths of a scenario's ``without``."""
    if not isinstance(paths, list) or not all(isinstance(path, str) for path in paths):
        yield f"{prefix}without: must be a list of dotted paths, such as ['nodes.digester.model']"
        return
    if len(set(paths)) != len(paths):
        yield f"{prefix}without: names a path twice"
    for path in paths:
        if path.partition(".")[0] in COMMON_KEYS:
            yield f"{prefix}without: '{path}': a scenario cannot set it"
        for parent in paths:
            if path.startswith(f"{parent}."):
                yield f"{prefix}without: '{path}' lies in '{parent}', which goes as a whole"
        table: Any = document
        for key in path.split("."):
            if not isinstance(table, Mapping) or key not in table:
                options = list(table) if isinstance(table, Mapping) else []
                yield f"{prefix}without: '{path}': {unknown_name('key', key, options)}"
                break
            table = table[key]


def stranger_mistakes(document: Mapping[str, Any], override: Mapping[str, Any], prefix: str) -> Iterator[str]:
    """Yield the nodes, arcs and services that a scenario changes but ``document`` does not have."""
    tables = [table.get("arcs", {}) for table in (document, override)]
    arcs = [arc for table in tables if isinstance(table, Mapping) for arc in table.values() if isinstance(arc, Mapping)]
    ends = [arc.get(end) for arc in arcs for end in ("from", "to")]
    for part, keys in WHOLE.items():
        names, changes = document.get(part, {}), override.get(part, {})
        if not isinstance(changes, Mapping) or not isinstance(names, Mapping):
            yield f"{prefix}{part}: must be a table"
            continue
        for name, change in changes.items():
            if name in names:
                continue
            if not isinstance(change, Mapping):
                yield f"{prefix}{part}.{name}: must be a table"
            elif not all(key in change for key in keys) or (part == "nodes" and name not in ends):
                needs = " and ".join((*keys, *(["an arc"] if part == "nodes" else [])))
                yield f"{prefix}{part}: {unknown_name(part[:-1], name, names)} A new one needs {needs}."
