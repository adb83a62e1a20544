"""Nested values in two files that nobody can hide code in: ``NAME.json``, and ``NAME.safetensors`` for its arrays."""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors import SafetensorError
from safetensors.numpy import load_file, save_file

from cirl_marl.errors import RunError

KIND = "__kind__"
"""Key that says what a table stands for, if it is no table."""
UNREADABLE = (OSError, ValueError, KeyError, IndexError, TypeError, AttributeError, RecursionError, SafetensorError)
"""What damaged files, or those of something else, raise."""


def write_tree(folder: Path, name: str, value: Any) -> None:
    """Write tables, lists, tuples, numbers, texts, arrays and tensors, nested at will.

    Raises:
        TypeError: for anything else.
    """
    arrays: dict[str, np.ndarray[Any, Any]] = {}
    told = json.dumps(_told(value, arrays, ()))
    save_file(arrays, folder / f"{name}.safetensors")
    (folder / f"{name}.json").write_text(told + "\n")


def read_tree(folder: Path, name: str) -> Any:
    """Return what ``write_tree`` wrote; a ``RunError`` names a file that is missing or says something else."""
    path = folder / f"{name}.safetensors"
    try:
        arrays = load_file(path)
        path = folder / f"{name}.json"
        return _meant(json.loads(path.read_text()), arrays)
    except UNREADABLE as error:
        raise RunError(f"{path}: cannot be read: {error}") from error


def is_plain(value: object) -> bool:
    """Return whether a value can be written; tensors only if nothing is learnt about them."""
    if isinstance(value, torch.Tensor):
        return not value.requires_grad
    if isinstance(value, Mapping):
        return all(isinstance(key, str) and is_plain(each) for key, each in value.items())
    if isinstance(value, deque | tuple | list):
        return all(map(is_plain, value))
    return value is None or isinstance(value, bool | int | float | str | np.generic | np.ndarray)


def _told(value: Any, arrays: dict[str, np.ndarray[Any, Any]], path: tuple[object, ...]) -> Any:
    """Return what stands for a value in JSON; arrays are gathered by the names on their paths."""
    if isinstance(value, torch.Tensor):
        return {KIND: "tensor", "is": _told(value.detach().cpu().numpy(), arrays, path)}
    if isinstance(value, np.ndarray):
        key = ".".join(map(str, path))
        key = f"{key}#{len(arrays)}" if key in arrays else key
        arrays[key] = np.array(value, order="C")
        return {KIND: "array", "is": key}
    if isinstance(value, Mapping):
        if all(isinstance(key, str) and key != KIND for key in value):
            return {key: _told(each, arrays, (*path, key)) for key, each in value.items()}
        told = [[_told(key, arrays, path), _told(each, arrays, (*path, key))] for key, each in value.items()]
        return {KIND: "table", "is": told}
    if isinstance(value, tuple | list | deque):
        items = [_told(each, arrays, (*path, place)) for place, each in enumerate(value)]
        return {KIND: "tuple", "is": items} if isinstance(value, tuple) else items
    if isinstance(value, np.generic):
        return value.item()
    if value is None or isinstance(value, bool | int | float | str):
        return value
    raise TypeError(f"a {type(value).__name__} cannot be kept")


def _meant(told: Any, arrays: Mapping[str, np.ndarray[Any, Any]]) -> Any:
    if isinstance(told, list):
        return [_meant(each, arrays) for each in told]
    if not isinstance(told, dict):
        return told
    if KIND not in told:
        return {key: _meant(each, arrays) for key, each in told.items()}
    inside = told["is"]
    match told[KIND]:
        case "array":
            return np.array(arrays[inside])  # its own, to be written to
        case "tensor":
            return torch.from_numpy(_meant(inside, arrays))
        case "table":
            return {_meant(key, arrays): _meant(each, arrays) for key, each in inside}
        case "tuple":
            return tuple(_meant(each, arrays) for each in inside)
    raise ValueError(f"unknown kind {told[KIND]!r}")
