"""Units of definition files, through pint."""

from __future__ import annotations

from functools import cache

import pint

from cirl_marl.errors import CirlError


@cache
def _registry() -> pint.UnitRegistry[float]:
    """Return pint's registry in which ``kt`` is the kilotonne; pint alone reads it as the knot."""
    registry: pint.UnitRegistry[float] = pint.UnitRegistry(on_redefinition="ignore", cache_folder=None)
    registry.define("kilotonne = 1000 * tonne = kt")
    return registry


def factor(unit: str, target: str) -> float:
    """Return the number by which values in ``unit`` are multiplied to be in ``target``.

    Raises:
        CirlError: if a unit is unknown, has an offset, or the two measure different things.

    >>> factor("kt/year", "kt/day") == 1 / 365.25
    True
    >>> factor("Mt", "kt")
    1000.0
    """
    registry = _registry()
    try:
        return float(registry.Quantity(1.0, unit).to(target).magnitude)
    except pint.errors.DimensionalityError as error:
        raise CirlError(f"unit '{unit}' is inconsistent: a quantity in '{target}' is needed ({error})") from error
    except (pint.errors.PintError, AttributeError, TypeError, ValueError) as error:
        raise CirlError(f"unit '{unit}' cannot be read: {error}") from error
