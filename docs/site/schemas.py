"""JSON schemas of definition and recipe files, with which editors complete and check them."""

from __future__ import annotations

import json
from typing import Any

from cirl_marl.definitions.schema import NetworkTable
from cirl_marl.learners.algorithms import algorithms
from cirl_marl.learners.recipe import Recipe
from docs.site.markdown import ROOT

DIALECT = "https://json-schema.org/draft/2020-12/schema"


def write_schemas() -> None:
    """Write the schemas beside the networks and recipes of the catalogue."""
    for file, schema in (
        ("envs/network.schema.json", network_schema()),
        ("agents/recipe.schema.json", recipe_schema()),
    ):
        (ROOT / file).write_text(json.dumps(schema, indent=2, ensure_ascii=False) + "\n", encoding="utf-8")


def network_schema() -> dict[str, Any]:
    """Return the JSON schema of definition files, with which editors complete and check them.

    A scenario may give any part of a network, so in its branch nothing is required, and what it gives of a number may
    be of several forms.
    """
    schema = NetworkTable.model_json_schema(by_alias=True)
    definitions = schema["$defs"]

    def part(value: Any) -> Any:
        if isinstance(value, dict):
            return {
                "anyOf" if key == "oneOf" else key: f"{item}Part"
                if key == "$ref" and item.split("/")[-1] in tables
                else part(item)
                for key, item in value.items()
                if not (key == "required" and isinstance(item, list))
            }
        return [part(item) for item in value] if isinstance(value, list) else value

    tables = [name for name, body in definitions.items() if body.get("type") == "object"]
    parts = {f"{name}Part": part(definitions[name]) for name in tables}
    properties = {k: v for k, v in schema["properties"].items() if k not in ("scenarios", "regions", "name")}
    without = {"type": "array", "items": {"type": "string"}, "description": "what to leave out first, as dotted paths"}
    parts["Scenario"] = {
        "type": "object",
        "additionalProperties": False,
        "properties": {"without": without, **part(properties)},
    }
    definitions.update(parts)
    scenarios = schema["properties"]["scenarios"]["patternProperties"]
    scenarios.update({pattern: {"$ref": "#/$defs/Scenario"} for pattern in scenarios})
    schema["$schema"] = DIALECT
    return schema


def recipe_schema() -> dict[str, Any]:
    """Return the JSON schema of recipe files, with which editors complete and check them."""
    schema = Recipe.model_json_schema()
    for table in ("LearnerSettings", "Match"):
        schema["$defs"][table]["properties"]["algorithm"]["enum"] = list(algorithms())
    schema["$schema"] = DIALECT
    return schema
