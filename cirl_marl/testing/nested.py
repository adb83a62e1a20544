"""Values nested in dicts and tuples: whether they lie in a space, share memory, or differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Any

import numpy as np
from gymnasium import spaces


class ConformanceError(AssertionError):
    """An environment breaks the contract; the message names agent, step and value."""


def check_member(space: spaces.Space[Any], value: Any, where: str) -> None:
    """Require that ``value`` lies in ``space``, with exactly its dtype and shape, part by part."""
    if isinstance(space, spaces.Dict):
        require(isinstance(value, Mapping), f"{where}: {value!r} is not a mapping")
        require(set(value) == set(space.spaces), f"{where}: keys {list(value)}, expected {list(space.spaces)}")
        for key, part in space.spaces.items():
            check_member(part, value[key], f"{where}[{key!r}]")
        return
    if isinstance(space, spaces.Tuple):
        fits = isinstance(value, tuple) and len(value) == len(space.spaces)
        require(fits, f"{where}: {value!r} does not fit {space}")
        for i, part in enumerate(space.spaces):
            check_member(part, value[i], f"{where}[{i}]")
        return
    if isinstance(space, spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary):
        require(isinstance(value, np.ndarray), f"{where}: a {type(value).__name__}, not an array")
        require(value.shape == space.shape, f"{where}: shape {value.shape}, expected {space.shape}")
        require(value.dtype == space.dtype, f"{where}: dtype {value.dtype}, expected {space.dtype}")
    if isinstance(space, spaces.Box):
        wrong = ~((value >= space.low) & (value <= space.high))
        if wrong.any():
            entry = tuple(int(i) for i in np.argwhere(wrong)[0])
            bounds = f"[{space.low[entry]}, {space.high[entry]}]"
            raise ConformanceError(f"{where}: entry {entry} is {value[entry]}, outside {bounds}")
    if not space.contains(value):
        raise ConformanceError(f"{where}: {value!r} is not in {space}")


def check_memory(observations: Mapping[Any, Any], where: str) -> None:
    """Require that no two agents see the same memory."""
    arrays = [(agent, leaf) for agent, seen in observations.items() for leaf in _leaves(seen)]
    for (one, mine), (other, theirs) in combinations(arrays, 2):
        if one != other and np.may_share_memory(mine, theirs):
            apart = not np.shares_memory(mine, theirs)
            require(apart, f"{where}: agents {one!r} and {other!r} share an observation's memory")


def _leaves(value: Any) -> Iterator[np.ndarray[Any, Any]]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, Mapping | tuple | list):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _leaves(part)


def same_or_raise(one: Any, other: Any, message: str) -> None:
    """Require that two nested values are equal bit for bit."""
    for path, a, b in _differences(one, other, ""):
        raise ConformanceError(f"{message}: at {path or 'the value itself'}, {a!r} and {b!r}")


def _differences(one: Any, other: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield where two nested values differ, arrays and numbers compared bit for bit."""
    if isinstance(one, Mapping) and isinstance(other, Mapping) and set(one) == set(other):
        for key in one:
            yield from _differences(one[key], other[key], f"{path}[{key!r}]")
    elif isinstance(one, list | tuple) and type(one) is type(other) and len(one) == len(other):
        for i, (a, b) in enumerate(zip(one, other, strict=True)):
            yield from _differences(a, b, f"{path}[{i}]")
    elif isinstance(one, np.ndarray | np.generic | float) and type(one) is type(other):
        a, b = np.asarray(one), np.asarray(other)
        same = a.dtype == b.dtype and a.shape == b.shape
        if not same or (a.tobytes() != b.tobytes() if not a.dtype.hasobject else not np.array_equal(a, b)):
            yield path, one, other
    elif type(one) is not type(other) or (_comparable(one) and not bool(one == other)):
        yield path, one, other


def _comparable(value: Any) -> bool:
    """Whether the type says what equality means; identity of plain objects says nothing about bits."""
    return getattr(type(value), "__eq__", None) is not getattr(object, "__eq__", None)


def require(condition: bool, message: str) -> None:
    """Raise unless ``condition`` holds."""
    if not condition:
        raise ConformanceError(message)
