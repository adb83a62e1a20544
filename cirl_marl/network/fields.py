"""What the parts of a network take: words of an enumeration, numbers of a shape."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from numbers import Real
from typing import TypeVar

import numpy as np

from cirl_marl.errors import NetworkError, unknown

Choice = TypeVar("Choice", bound=StrEnum)


def choice(owner: str, what: str, kinds: type[Choice], value: str) -> Choice:
    """Return the member that a value is, or spells.

    Raises:
        NetworkError: if it is none; names the nearest.
    """
    try:
        return kinds(value)
    except ValueError:
        raise NetworkError(owner, [unknown(what, value, kinds)]) from None


NUMBERS: dict[str, tuple[str, tuple[int | None, ...]]] = {
    "initial": ("(low, high)", (2,)),
    "inner": ("((low, high), …), one pair for each inner state", (None, 2)),
    "batches": ("((time, mass), …)", (None, 2)),
    "flow": ("(value, …)", (None,)),
    "times": ("(time, …)", (None,)),
    **dict.fromkeys(
        ("set_point", "scale", "reward_scale", "rate", "delay", "low", "neutral", "high"), ("a number", ())
    ),
}
"""Fields of compartments and controls that hold numbers: how they are given, and their shape, None being any length."""


def check_numbers(owner: str, part: object) -> None:
    """Raise a ``NetworkError`` for fields without their numbers, with what to write for a single number or pair."""
    faults = []
    for name, (form, shape) in NUMBERS.items():
        value = getattr(part, name, None)
        if not hasattr(part, name) or (name == "set_point" and value is None) or _fits(value, shape):
            continue
        instead = (f"; write {each!r}" for each in ((value,), (value, value)) if _fits(each, shape))
        faults.append(f"{name} must be {form}, got {value!r}{next(instead, '')}")
    if faults:
        raise NetworkError(owner, faults)


def _fits(value: object, shape: tuple[int | None, ...]) -> bool:
    if not shape:
        return isinstance(value, Real)
    if not isinstance(value, Sequence | np.ndarray) or shape[0] not in (None, len(value)):
        return False
    return all(_fits(each, shape[1:]) for each in value)
