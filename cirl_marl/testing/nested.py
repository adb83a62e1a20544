"""Values nested in dicts and tuples: whether they lie in a space, share memory, or differ."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from itertools import combinations
from typing import Any

import numpy as np
from gymnasium import spaces


class ConformanceError(AssertionError):
    """An environment breaks the contract; the message names agent, step and value."""


def check_member(space: spaces.Space[Any], value: Any, label: str) -> None:
    """Require that ``value`` lies in ``space``, with exactly its dtype and shape, part by part."""
    if isinstance(space, spaces.Dict):
        require(isinstance(value, Mapping), f"{label}: {value!r} is not a mapping")
        require(set(value) == set(space.spaces), f"{label}: keys {list(value)}, expected {list(space.spaces)}")
        for key, part in space.spaces.items():
            check_member(part, value[key], f"{label}[{key!r}]")
        return
    if isinstance(space, spaces.Tuple):
        fits = isinstance(value, tuple) and len(value) == len(space.spaces)
        require(fits, f"{label}: {value!r} does not fit {space}")
        for i, part in enumerate(space.spaces):
            check_member(part, value[i], f"{label}[{i}]")
        return
    if isinstance(space, spaces.Box | spaces.MultiDiscrete | spaces.MultiBinary):
        require(isinstance(value, np.ndarray), f"{label}: a {type(value).__name__}, not an array")
        require(value.shape == space.shape, f"{label}: shape {value.shape}, expected {space.shape}")
        require(value.dtype == space.dtype, f"{label}: dtype {value.dtype}, expected {space.dtype}")
    if isinstance(space, spaces.Box):
        wrong = ~((value >= space.low) & (value <= space.high))
        if wrong.any():
            entry = tuple(int(i) for i in np.argwhere(wrong)[0])
            bounds = f"[{space.low[entry]}, {space.high[entry]}]"
            raise ConformanceError(f"{label}: entry {entry} is {value[entry]}, outside {bounds}")
    if not space.contains(value):
        raise ConformanceError(f"{label}: {value!r} is not in {space}")


def check_memory(observations: Mapping[Any, Any], label: str) -> None:
    """Require that no two agents see the same memory."""
    arrays = [(agent, leaf) for agent, observation in observations.items() for leaf in _leaves(observation)]
    for (agent_a, array_a), (agent_b, array_b) in combinations(arrays, 2):
        if agent_a != agent_b and np.may_share_memory(array_a, array_b):
            apart = not np.shares_memory(array_a, array_b)
            require(apart, f"{label}: agents {agent_a!r} and {agent_b!r} share an observation's memory")


def _leaves(value: Any) -> Iterator[np.ndarray[Any, Any]]:
    if isinstance(value, np.ndarray):
        yield value
    elif isinstance(value, Mapping | tuple | list):
        for part in value.values() if isinstance(value, Mapping) else value:
            yield from _leaves(part)


def same_or_raise(first: Any, second: Any, message: str) -> None:
    """Require that two nested values are equal bit for bit."""
    for path, a, b in _differences(first, second, ""):
        raise ConformanceError(f"{message}: at {path or 'the value itself'}, {a!r} and {b!r}")


def _differences(first: Any, second: Any, path: str) -> Iterator[tuple[str, Any, Any]]:
    """Yield where two nested values differ, arrays and numbers compared bit for bit."""
    if isinstance(first, Mapping) and isinstance(second, Mapping) and set(first) == set(second):
        for key in first:
            yield from _differences(first[key], second[key], f"{path}[{key!r}]")
    elif isinstance(first, list | tuple) and type(first) is type(second) and len(first) == len(second):
        for i, (a, b) in enumerate(zip(first, second, strict=True)):
            yield from _differences(a, b, f"{path}[{i}]")
    elif isinstance(first, np.ndarray | np.generic | float) and type(first) is type(second):
        a, b = np.asarray(first), np.asarray(second)
        alike = a.dtype == b.dtype and a.shape == b.shape
        if not alike or (a.tobytes() != b.tobytes() if not a.dtype.hasobject else not np.array_equal(a, b)):
            yield path, first, second
    elif type(first) is not type(second) or (_comparable(first) and not bool(first == second)):
        yield path, first, second


def _comparable(value: Any) -> bool:
    """Whether the type says what equality means; identity of plain objects says nothing about bits."""
    return getattr(type(value), "__eq__", None) is not getattr(object, "__eq__", None)


def require(condition: bool, message: str) -> None:
    """Raise unless ``condition`` holds."""
    if not condition:
        raise ConformanceError(message)
