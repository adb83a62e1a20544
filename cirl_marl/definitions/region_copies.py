"""A definition made of copies of another one, one for each of its regions, and of what joins them."""

from __future__ import annotations

import copy
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import ValidationError

from cirl_marl.definitions.error_messages import validation_mistakes
from cirl_marl.definitions.overrides import overlay, path_mistakes, without_paths
from cirl_marl.definitions.schema import CopiesTable
from cirl_marl.errors import NetworkError, unknown
from cirl_marl.network.declarations import Kinds, Quantity, declarations
from cirl_marl.network.elements import Arc, Node

REGION = "{region}"
"""What stands for the text of a region in the tables of its copy."""
NAME_KEYS: Mapping[str, tuple[str, ...]] = {
    "nodes": (),
    "arcs": ("from", "to", "by", "makes_up_for"),
    "services": ("provider", "also", "owed_by"),
}
"""The tables that are copied, and their keys that name nodes, arcs or services."""
COMPARTMENTS = {"nodes": Node, "arcs": Arc}
Document = Mapping[str, Any]


def copied_file(document: Document) -> str:
    """Return the file of which a document has copies.

    Raises:
        NetworkError: naming the keys of its table ``[copies]`` that are wrong.
    """
    return str(_table(document["copies"], "copies").of)


def compose_copies(
    document: Document, copied: Document, scenario: str
) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
    """Return ``document`` under a scenario with the copies of ``copied`` in it, and the nodes of each by region.

    A copy is what the copied file says, then what ``[copies]`` changes, then what the scenario of the same name changes
    in the copied file, then what ``[scenarios.….copies]`` changes. The scenario's other tables are left to the caller.

    Raises:
        NetworkError: naming the key of each mistake.
    """
    table = _table(document["copies"], "copies")
    known = copied.get("regions")
    if not isinstance(known, Mapping) or not known or "copies" in copied:
        told = "has copies itself" if "copies" in copied else "has no [regions], and a copy is of a region"
        raise NetworkError(table.of, [f"copies.of: '{table.of}' {told}"])
    pattern = _pattern(document, copied, scenario)
    merged = {key: copy.deepcopy(value) for key, value in document.items() if key != "scenarios"}
    mistakes = [f"copies.regions: {unknown('region', each, known)}" for each in table.regions if each not in known]
    nodes: dict[str, tuple[str, ...]] = {}
    for region in [] if mistakes else table.regions or known:
        made = _copy(pattern, region, str(known[region]))
        for part in NAME_KEYS:
            own, more = merged.setdefault(part, {}), made.get(part, {})
            mistakes += [f"{part}.{id_}: a copy of '{table.of}' has the same name" for id_ in more if id_ in own]
            own.update(more)
        merged["agents"] = [*merged.get("agents", []), *made["agents"]]
        nodes[region] = tuple(made["nodes"])
    if mistakes:
        raise NetworkError(table.of, mistakes)
    return merged, nodes


def _table(given: Any, where: str) -> Any:
    """Return the table at ``where``; that of a scenario has neither ``of`` nor ``regions``."""
    try:
        return CopiesTable.model_validate(given)
    except ValidationError as error:
        raise NetworkError("copies", [f"{where}.{each}" for each in validation_mistakes(error, CopiesTable)]) from None


def _pattern(document: Document, copied: Document, scenario: str) -> dict[str, Any]:
    """Return what is copied, under a scenario."""
    of = document["copies"]["of"]
    changes = [("copies.", {key: value for key, value in document["copies"].items() if key not in ("of", "regions")})]
    changes.append((f"{of}: scenarios.{scenario}.", copied.get("scenarios", {}).get(scenario, {})))
    own = document.get("scenarios", {}).get(scenario, {}).get("copies", {})
    told = [f"scenarios.{scenario}.copies.{key}: a scenario cannot set it" for key in ("of", "regions") if key in own]
    if told:
        raise NetworkError(of, told)
    _table({"of": of, **own}, f"scenarios.{scenario}.copies")
    changes.append((f"scenarios.{scenario}.copies.", own))
    pattern, gone = dict(copied), set[str]()
    for where, change in changes:
        still = {key: _still(value, key, gone) for key, value in change.items() if key != "without"}
        paths = [path for path in change.get("without", []) if not _in(path, gone)]
        mistakes = [*path_mistakes(pattern, paths, where), *_strangers(pattern, still, where)]
        if mistakes:
            raise NetworkError(of, mistakes)
        pattern = overlay(without_paths(pattern, {"without": paths}), still)
        gone |= set(paths)
    return pattern


def _in(path: str, gone: set[str]) -> bool:
    return any(path == each or path.startswith(f"{each}.") for each in gone)


def _still(value: Any, key: str, gone: set[str]) -> Any:
    """Return a table of changes less what has gone before."""
    return {id_: each for id_, each in value.items() if f"{key}.{id_}" not in gone} if key in NAME_KEYS else value


def _strangers(pattern: Document, change: Document, where: str) -> Iterator[str]:
    for part in NAME_KEYS:
        for id_ in change.get(part, {}):
            if id_ not in pattern.get(part, {}):
                yield f"{where}{part}: {unknown(part[:-1], id_, pattern.get(part, {}))}"


def _copy(pattern: Document, region: str, text: str) -> dict[str, Any]:
    """Return nodes, arcs, services and agents of a region's copy, whose names begin with the region."""
    ids = {id_ for part in NAME_KEYS for id_ in pattern.get(part, {})}

    def named(value: Any) -> Any:
        if isinstance(value, list):
            return [named(each) for each in value]
        return f"{region}_{value}" if value in ids else value

    made: dict[str, Any] = {"agents": named(pattern.get("agents", []))}
    for part, keys in NAME_KEYS.items():
        made[part] = {}
        for id_, table in pattern.get(part, {}).items():
            own = _with_region(table, text)
            own |= {key: named(own[key]) for key in keys if key in own}
            own["title"] = f"{text}: {own.get('title', id_)}"
            if part in COMPARTMENTS and "scale" not in own:
                own["scale"] = _with_region(pattern["scales"][_scale(COMPARTMENTS[part], own)], text)
            made[part][f"{region}_{id_}"] = own
    return made


def _with_region(value: Any, text: str) -> Any:
    """Return a copy of a table with the text of the region in its place."""
    if isinstance(value, Mapping):
        return {key: _with_region(each, text) for key, each in value.items()}
    if isinstance(value, list):
        return [_with_region(each, text) for each in value]
    return value.replace(REGION, text) if isinstance(value, str) else value


def _scale(made: type[Any], table: Document) -> str:
    """Return which of ``[scales]`` holds for a compartment that states none: ``stock`` or ``flow``."""
    declared = declarations(made)["scale"]
    assert isinstance(declared, Quantity) and isinstance(declared.of, Kinds)
    kinds = declared.of
    default = made.__dataclass_fields__[kinds.by].default
    return "stock" if kinds.of.get(table.get(kinds.by, default), kinds.otherwise) == "mass" else "flow"
