"""Mistakes in definition files, in the words of the file: line or key, value, nearest valid name."""

from __future__ import annotations

import inspect
import re
import tomllib
import typing
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel, ValidationError

from cirl_marl.definitions.quantities import forms
from cirl_marl.errors import unknown_name

REQUIREMENTS = {
    "bool_type": "must be true or false",
    "dict_type": "must be a table",
    "finite_number": "must be a finite number",
    "float_type": "must be a number",
    "greater_than": "must be more than {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "int_type": "must be a whole number",
    "less_than": "must be less than {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "list_type": "must be a list",
    "string_type": "must be a text",
    "tuple_type": "must be a list",
}
"""What a value must be, by the kind of pydantic's error; what stands in braces is from its context."""
BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
"""Kinds of the parameters that a definition can give."""


def toml_mistake(error: tomllib.TOMLDecodeError, text: str) -> str:
    """Say where ``text`` is not valid TOML, and what to write if it is for a bare word."""
    place = re.search(r"line (\d+), column (\d+)", str(error))
    if place is None:
        return f"not valid TOML: {error}"
    line, column = text.split("\n")[int(place[1]) - 1], int(place[2]) - 1
    if comma := re.search(r"=\s*(-?\d+,\d+)\W*$", line[: column + 1]):
        return f"not valid TOML: {error}: {comma[1]}; write {comma[1].replace(',', '.')}"
    word = _bare_word(str(error), line, column)
    if word.lower() in ("true", "false"):
        return f"not valid TOML: {error}: {word}; write {word.lower()}"
    return f"not valid TOML: {error}" + (f': {word}; text needs quotes, "{word}"' if word else "")


def _bare_word(error: str, line: str, column: int) -> str:
    """Return the words without quotes that stand as a value where reading failed; empty if there are none.

    A word that begins with a digit, such as 1/day, fails only where the number in it ends.
    """
    if not error.startswith(("Invalid value", "Expected newline", "Unclosed")):
        return ""
    start = column if error.startswith("Invalid value") else line.rfind("=", 0, column) + 1
    words = re.compile(r"[^][{}\"'#,=]*+(?!=)").match(line, start)
    word = words[0].strip() if words is not None and words.end() > column else ""
    return word if re.search(r"[^\W\d]", word) else ""


MISPLACED: dict[tuple[str, ...], str] = {
    ("arcs", "series"): "write flow = { times = […], values = […], time_unit = …, unit = …, source = … }",
    ("arcs", "content"): "a flow, or a batch, has the content of its donor when it leaves; state that of a node",
    ("nodes", "transfer"): "state the transfer of the arcs that leave it",
}
"""What to write instead of keys of a node or an arc, which has none of that name."""


def validation_mistakes(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """Say each pydantic error in the words of the file: key, value, nearest valid name."""
    return [_mistake(dict(item), model) for item in error.errors()]


def _mistake(item: Mapping[str, Any], model: type[BaseModel]) -> str:
    parts = [part for part in item["loc"] if part != "[key]"]
    location = [str(part) for part in parts]
    keys = [part for part in parts if not str(part).startswith("<")]
    path = "".join(f", entry {key + 1}" if isinstance(key, int) else f".{key}" for key in keys).lstrip(".,") or "file"
    if item["type"] == "extra_forbidden" and tuple(location[-3::2]) in MISPLACED:
        return f"{path}: {MISPLACED[tuple(location[-3::2])]}"
    if item["type"] == "extra_forbidden" and location[-1] in ("disturbed_by", "disturbed_as"):
        numbers = "rates, flows, shares, capacities (of a control), stretches (of lifetimes) and bands"
        return f"{path}: only {numbers} can be disturbed"
    if item["type"] == "extra_forbidden":
        parent = _model_at(model, location[:-1])
        options = [f.alias or name for name, f in parent.model_fields.items()] if parent else []
        return f"{path}: {unknown_name('key', location[-1], options)}"
    if item["type"] in ("enum", "literal_error"):
        options = choices(str(item["ctx"]["expected"]))
        return f"{path}: {unknown_name('value', item['input'], options)}"
    if item["type"] == "missing":
        return f"{path}: missing"
    if item["type"] in ("model_type", "model_attributes_type"):
        table = _model_at(model, location)
        names = {f.alias or name: f.is_required() for name, f in table.model_fields.items()} if table else {}
        keys = [name for name, is_required in names.items() if is_required] or [*names][:1]
        return f"{path}: must be a table {{ {', '.join(f'{key} = …' for key in keys)} }}, got {item['input']!r}"
    if item["type"] == "string_pattern_mismatch":
        return f"{path}: begins with a letter and has lower-case letters, digits and _ only, got {item['input']!r}"
    message = str(item["msg"]).removeprefix("Value error, ").replace("Input should be", "must be")
    requirement = REQUIREMENTS.get(item["type"], message).format_map(item.get("ctx", {}))
    return f"{path}: {requirement}, got {item['input']!r}"


def choices(sentence: str) -> list[str]:
    """Return the valid values that pydantic lists in a message."""
    return [part.strip(" '") for part in sentence.replace(" or ", ", ").split(",")]


def _model_at(model: type[BaseModel], location: list[str]) -> type[BaseModel] | None:
    """Return the model of the table at ``location``."""
    current: Any = model
    for part in location:
        if part.startswith("<"):
            current = forms(current)[part]
        elif isinstance(current, type) and issubclass(current, BaseModel):
            fields = {f.alias or name: f.annotation for name, f in current.model_fields.items()}
            current = fields.get(part)
        else:
            current = typing.get_args(current)[-1]
        if type(None) in typing.get_args(current):
            current = next(arg for arg in typing.get_args(current) if arg is not type(None))
    return current if isinstance(current, type) and issubclass(current, BaseModel) else None


def parameter_mistakes(
    kind: type[Any], parameters: Mapping[str, bool | float], form: Mapping[str, str]
) -> Iterator[str]:
    """Yield what a model does not take, what it needs besides, and numbers and truth values that are none."""
    accepts = {name: spec for name, spec in inspect.signature(kind).parameters.items() if spec.kind in BY_NAME}
    for name in (*parameters, *form):
        if name not in accepts:
            yield unknown_name("parameter", name, accepts)
    for name, parameter in accepts.items():
        if parameter.default is parameter.empty and name not in {*parameters, *form}:
            yield f"{name}: missing" if name == "form" else f"parameters.{name}: missing"
        elif name in parameters:
            yield from _type_mistakes(parameter, parameters[name])


def _type_mistakes(parameter: inspect.Parameter, value: bool | float) -> Iterator[str]:
    """Yield it if a value is not of a parameter's kind: true or false, or, unless another default is seen, a number."""
    default = parameter.default
    if default is not parameter.empty and not isinstance(default, int | float):
        yield f"parameters.{parameter.name}: is no number, so that a definition cannot give it"
        return
    truth = isinstance(default, bool) or (default is parameter.empty and parameter.annotation in (bool, "bool"))
    if truth != isinstance(value, bool):
        needs = "true or false" if truth else "a number"
        yield f"parameters.{parameter.name}: needs {needs}, got {value!r}"
