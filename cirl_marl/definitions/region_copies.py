"""A definition made of copies of another one, one for each of its regions, and of what joins them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pydantic import BaseModel, ValidationError

from cirl_marl.definitions.error_messages import validation_mistakes
from cirl_marl.definitions.overrides import overlay, path_mistakes, stranger_mistakes, without_paths
from cirl_marl.definitions.schema import CopiesTable, CorrelationTable
from cirl_marl.errors import NetworkError, unknown_name
from cirl_marl.network.declarations import Kinds, Quantity, declarations
from cirl_marl.network.elements import Arc, Node

REGION = "{region}"
"""What stands for the text of a region in the tables of its copy."""
NAME_KEYS: Mapping[str, tuple[str, ...]] = {
    "nodes": (),
    "arcs": ("from", "to", "by", "makes_up_for", "capacity_node"),
    "services": ("provider", "also", "owed_by"),
    "disturbances": ("observed_by",),
}
"""The tables that are copied, and their keys that name nodes, arcs or services."""
RULE_KEYS = ("follows", "watches")
"""Keys of a rule, likewise."""
COMPARTMENTS = {"nodes": Node, "arcs": Arc}
Document = Mapping[str, Any]


def copied_file(document: Document) -> str:
    """Return the file of which a document has copies.

    Raises:
        NetworkError: naming the keys of its table ``[copies]`` that are wrong.
    """
    return str(_table(document["copies"], "copies").of)


def compose_copies(
    document: Document, original: Document, scenario: str
) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
    """Return ``document`` under a scenario with the copies of ``original`` in it, and the nodes of each by region.

    A copy is what the copied file says, then what ``[copies]`` changes, then what the scenario of the same name changes
    in the copied file, then what ``[scenarios.….copies]`` changes. The scenario's other tables are left to the caller.

    Raises:
        NetworkError: naming the key of each mistake.
    """
    table = _table(document["copies"], "copies")
    texts = original.get("regions")
    if not isinstance(texts, Mapping) or not texts or "copies" in original:
        fault = "has copies itself" if "copies" in original else "has no [regions], and a copy is of a region"
        raise NetworkError(table.of, [f"copies.of: '{table.of}' {fault}"])
    forms = [f"{part}: must be a table" for part in NAME_KEYS if not isinstance(document.get(part, {}), Mapping)]
    if not isinstance(document.get("agents", []), list):
        forms.append("agents: must be a list of names")
    if forms:
        raise NetworkError(table.of, forms)
    pattern = _pattern(document, original, scenario)
    document_ = {k: dict(v) if isinstance(v, Mapping) else v for k, v in document.items() if k != "scenarios"}
    mistakes = [f"copies.regions: {unknown_name('region', id_, texts)}" for id_ in table.regions if id_ not in texts]
    nodes: dict[str, tuple[str, ...]] = {}
    regions = [] if mistakes else table.regions or [*texts]
    if regions:
        _add_common(document_, pattern, regions)
    for region in regions:
        copy = _copy(pattern, region, str(texts[region]))
        for part in NAME_KEYS:
            entries, more = document_.setdefault(part, {}), copy.get(part, {})
            mistakes += [f"{part}.{id_}: a copy of '{table.of}' has the same name" for id_ in more if id_ in entries]
            entries.update(more)
        document_["agents"] = [*document_.get("agents", []), *copy["agents"]]
        nodes[region] = tuple(copy["nodes"])
    if mistakes:
        raise NetworkError(table.of, mistakes)
    return document_, nodes


def _table(entries: Any, path: str, kind: type[BaseModel] = CopiesTable) -> Any:
    """Return the table at ``path``, as a ``kind`` of table; that of a scenario has neither ``of`` nor ``regions``."""
    try:
        return kind.model_validate(entries)
    except ValidationError as error:
        raise NetworkError("copies", [f"{path}.{mistake}" for mistake in validation_mistakes(error, kind)]) from None


def _pattern(document: Document, original: Document, scenario: str) -> dict[str, Any]:
    of = document["copies"]["of"]
    changes = [("copies.", {key: value for key, value in document["copies"].items() if key not in ("of", "regions")})]
    changes.append((f"{of}: scenarios.{scenario}.", original.get("scenarios", {}).get(scenario, {})))
    changes_here = document.get("scenarios", {}).get(scenario, {}).get("copies", {})
    if keys := [key for key in ("of", "regions") if key in changes_here]:
        raise NetworkError(of, [f"scenarios.{scenario}.copies.{key}: a scenario cannot set it" for key in keys])
    _table({"of": of, **changes_here}, f"scenarios.{scenario}.copies")
    changes.append((f"scenarios.{scenario}.copies.", changes_here))
    pattern, removals = dict(original), set[str]()
    for prefix, change in changes:
        still = {key: _still(value, key, removals) for key, value in change.items() if key != "without"}
        before = tuple(f"{removal}." for removal in removals)
        paths = [path for path in change.get("without", []) if not f"{path}.".startswith(before)]
        mistakes = [*path_mistakes(pattern, paths, prefix), *stranger_mistakes(pattern, still, prefix)]
        if mistakes:
            raise NetworkError(of, mistakes)
        pattern = overlay(without_paths(pattern, {"without": paths}), still)
        removals |= set(paths)
    return pattern


def _still(value: Any, key: str, removals: set[str]) -> Any:
    """Return a table of changes less what has gone before."""
    return {id_: table for id_, table in value.items() if f"{key}.{id_}" not in removals} if key in NAME_KEYS else value


def _add_common(document: dict[str, Any], pattern: dict[str, Any], regions: Sequence[str]) -> None:
    """Move what regions share, such as accounts, to ``document``, and write out what correlates disturbances."""
    for key in ("accounts", "substances"):
        if key in pattern:
            document[key] = {**pattern[key], **document.get(key, {})}
    own = pattern.get("disturbances", {})
    common = {name: part for name, part in own.items() if isinstance(part, Mapping) and part.get("common") is True}
    if own:
        pattern["disturbances"] = {name: part for name, part in own.items() if name not in common}
        document["disturbances"] = {**common, **document.get("disturbances", {})}
    if (entries := pattern.pop("disturbance_correlation", None)) is None:
        return
    table: Any = _table(entries, "disturbance_correlation", CorrelationTable)
    count, between = len(table.names), 0.0 if table.regions is None else table.regions.value
    if len(table.matrix) != count or {*map(len, table.matrix)} != {count} or "disturbance_correlation" in document:
        fault = f"needs a matrix of {count} rows of {count} numbers"
        place = "stands there or in the definition copied, not both"
        raise NetworkError("copies", [f"disturbance_correlation: {fault}, and {place}"])
    places = [(region, i) for region in regions for i in range(count) if table.names[i] not in common]
    places += [("", i) for i in range(count) if table.names[i] in common]
    document["disturbance_correlation"] = {
        "names": [f"{region}_{table.names[i]}".lstrip("_") for region, i in places],
        "matrix": [
            [table.matrix[i][j] * (1.0 if a == b or not a or not b else between) for b, j in places] for a, i in places
        ],
        "source": table.source,
    }


def _copy(pattern: Document, region: str, text: str) -> dict[str, Any]:
    """Return nodes, arcs, services and agents of a region's copy, whose names begin with the region."""
    ids = {id_ for part in NAME_KEYS for id_ in pattern.get(part, {})}

    def rename(value: Any) -> Any:
        if isinstance(value, list):
            return [rename(name) for name in value]
        return f"{region}_{value}" if value in ids else value

    copy: dict[str, Any] = {"agents": rename(pattern.get("agents", []))}
    for part, keys in NAME_KEYS.items():
        copy[part] = {}
        for id_, table in pattern.get(part, {}).items():
            entries = _with_disturbances(_with_region(table, text), region, pattern.get("disturbances", {}))
            entries |= {key: rename(entries[key]) for key in keys if key in entries}
            if isinstance(rule := entries.get("rule"), Mapping):
                entries["rule"] = {**rule, **{key: rename(rule[key]) for key in RULE_KEYS if key in rule}}
            if part != "disturbances":
                entries["title"] = f"{text}: {entries.get('title', id_)}"
            if part in COMPARTMENTS and "scale" not in entries:
                entries["scale"] = _with_region(pattern["scales"][_scale(COMPARTMENTS[part], entries)], text)
            copy[part][f"{region}_{id_}"] = entries
    return copy


def _with_disturbances(value: Any, region: str, disturbances: Document) -> Any:
    """Return a copy of a table whose quantities are disturbed by what the region has of these ``disturbances``."""
    if not isinstance(value, Mapping):
        return value
    table = {key: _with_disturbances(entry, region, disturbances) for key, entry in value.items()}
    if table.get("disturbed_by") in disturbances:
        table["disturbed_by"] = f"{region}_{table['disturbed_by']}"
    return table


def _with_region(value: Any, text: str) -> Any:
    if isinstance(value, Mapping):
        return {key: _with_region(entry, text) for key, entry in value.items()}
    if isinstance(value, list):
        return [_with_region(entry, text) for entry in value]
    return value.replace(REGION, text) if isinstance(value, str) else value


def _scale(record: type[Any], table: Document) -> str:
    """Return which of ``[scales]`` holds for a compartment that states none: ``stock`` or ``flow``."""
    declaration = declarations(record)["scale"]
    assert isinstance(declaration, Quantity) and isinstance(declaration.of, Kinds)
    kinds = declaration.of
    default = record.__dataclass_fields__[kinds.by].default
    return "stock" if kinds.of.get(table.get(kinds.by, default), kinds.otherwise) == "mass" else "flow"
