"""Validation errors in the words of the file: key, value, nearest valid name."""

from __future__ import annotations

import types
import typing
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from cirl_marl.errors import unknown


def mistakes_of(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """Say each pydantic error in the words of the file: key, value, nearest valid name."""
    return [_mistake(dict(item), model) for item in error.errors()]


def _mistake(item: Mapping[str, Any], model: type[BaseModel]) -> str:
    location = [str(part) for part in item["loc"] if part != "[key]"]
    path = ".".join(location) or "file"
    if item["type"] == "extra_forbidden":
        parent = _model_at(model, location[:-1])
        known = [f.alias or name for name, f in parent.model_fields.items()] if parent else []
        return f"{path}: {unknown('key', location[-1], known)}"
    if item["type"] in ("enum", "literal_error"):
        known = choices(str(item["ctx"]["expected"]))
        return f"{path}: {unknown('value', item['input'], known)}"
    if item["type"] == "missing":
        return f"{path}: missing"
    if item["type"] in ("model_type", "model_attributes_type"):
        wanted = _model_at(model, location)
        keys = [f.alias or name for name, f in wanted.model_fields.items() if f.is_required()] if wanted else []
        return f"{path}: must be a table {{ {', '.join(f'{key} = …' for key in keys)} }}, got {item['input']!r}"
    if item["type"] == "string_pattern_mismatch":
        return f"{path}: begins with a letter and has lower-case letters, digits and _ only, got {item['input']!r}"
    return f"{path}: {item['msg']}, got {item['input']!r}"


def choices(expected: str) -> list[str]:
    """Return the valid values that pydantic lists in a message."""
    return [part.strip(" '") for part in expected.replace(" or ", ", ").split(",")]


def _model_at(model: type[BaseModel], location: list[str]) -> type[BaseModel] | None:
    """Return the model of the table at ``location``."""
    current: Any = model
    for part in location:
        if isinstance(current, type) and issubclass(current, BaseModel):
            fields = {f.alias or name: f.annotation for name, f in current.model_fields.items()}
            current = fields.get(part)
        else:
            current = typing.get_args(current)[-1]
        if isinstance(current, types.UnionType):
            current = next(arg for arg in typing.get_args(current) if arg is not type(None))
    return current if isinstance(current, type) and issubclass(current, BaseModel) else None
