"""Units of definition files, through pint."""

from __future__ import annotations

import re
from functools import cache

import pint

from cirl_marl.errors import CirlError

AMBIGUOUS = {
    "ton": "t (tonne), or short_ton, or long_ton",
    "tons": "t (tonne), or short_ton, or long_ton",
    "kton": "kt (kilotonne)",
    "Mton": "Mt (megatonne)",
    "mt": "t (metric tonne), or Mt (megatonne)",
    "mton": "t (metric tonne), or Mt (megatonne)",
}
"""Symbols that pint reads as short tons or as millitonnes, though many mean tonnes by them; what to write instead."""


@cache
def _registry() -> pint.UnitRegistry[float]:
    """Return pint's registry in which ``kt`` is the kilotonne; pint alone reads it as the knot."""
    registry: pint.UnitRegistry[float] = pint.UnitRegistry(on_redefinition="ignore", cache_folder=None)
    registry.define("kilotonne = 1000 * tonne = kt")
    return registry


@cache
def factor(unit: str, target: str) -> float:
    """Return the number by which values in ``unit`` are multiplied to be in ``target``.

    Raises:
        CirlError: if a unit is unknown, ambiguous, has an offset, or the two measure different things.

    >>> factor("kt/year", "kt/day") == 1 / 365.25
    True
    >>> factor("Mt", "kt")
    1000.0
    """
    for symbol in re.findall(r"[^\W\d]\w*", unit):
        if symbol in AMBIGUOUS:
            raise CirlError(f"unit '{unit}': '{symbol}' is read in several ways; write {AMBIGUOUS[symbol]}")
    registry = _registry()
    try:
        return float(registry.Quantity(1.0, unit).to(target).magnitude)
    except pint.errors.DimensionalityError as error:
        raise CirlError(f"unit '{unit}' is inconsistent: a quantity in '{target}' is needed ({error})") from error
    except (pint.errors.PintError, AttributeError, TypeError, ValueError) as error:
        raise CirlError(f"unit '{unit}' cannot be read: {error}") from error
