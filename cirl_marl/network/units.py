"""Units of definition files, through pint."""

from __future__ import annotations

import re
import tokenize
from functools import cache
from typing import TYPE_CHECKING

from cirl_marl.errors import CirlError

if TYPE_CHECKING:
    import pint


@cache
def _registry() -> pint.UnitRegistry[float]:
    """Return pint's registry in which ``kt`` is the kilotonne, which pint alone reads as the knot, and ``t CO2e``."""
    import pint  # takes longer to import than most commands run

    registry: pint.UnitRegistry[float] = pint.UnitRegistry(on_redefinition="ignore", cache_folder=None)
    registry.define("kilotonne = 1000 * tonne = kt")
    registry.define("CO2e = [greenhouse_effect]")
    return registry


def _ambiguity(symbol: str) -> str | None:
    """Return what to write instead of a symbol that many read as another mass than pint does; None for any other.

    Pint reads ``ton`` as the short ton, with whatever prefix, and ``mt`` as the millitonne.
    """
    if symbol == "mt":
        return "t (metric tonne), or Mt (megatonne)"
    registry = _registry()
    for prefix, name, _ in registry.parse_unit_name(symbol):
        if name == "ton" and "short_ton" not in symbol:
            if prefix == "milli":
                return "t (metric tonne), or Mt (megatonne)"
            tonne = registry.get_symbol(f"{prefix}tonne")
            return f"{tonne} ({prefix}tonne), or {prefix}short_ton, or {prefix}long_ton"
    return None


MISSPELT = {"y": "year", "T": "t (tonne)", "MT": "Mt (megatonne)"} | dict.fromkeys(["kT", "Kt", "KT"], "kt (kilotonne)")
MISSPELT |= {"pct": "%", "ppmw": "ppm", "ppb": "mg/t"}
MISSPELT |= dict.fromkeys(["wt", "mass", "weight"], "nothing, as in '%' or 'ppm': parts are of the mass")
"""Symbols that are written for a unit, and are none or another: pint reads ``mass`` as an angle, ``pct`` as a mass."""


CURRENCY = re.compile(r"[kMG]?([A-Z]{3})(_(?:18|19|20)\d\d)?")
"""A currency, with a prefix and the year of its prices, such as ``MEUR_2023``."""
CURRENCY_VARIANT = re.compile(r"[A-Za-z]{0,2}([A-Za-z]{3})_?((?:18|19|20)\d\d)")
"""How a currency and year are written otherwise; ``TEUR_2023`` are thousands for some, and trillions for pint."""
EMISSION = re.compile(r"(|kg|g|[kMG]?t)_?(?i:CO2)_?(?i:e|eq|equiv)?")
"""How equivalents of carbon dioxide are written, with a mass before them or not."""
LONGEST = 100
"""Characters of the longest unit."""
POWER = r"(\*\*|\^)"


def _check_form(unit: str) -> None:
    """Refuse what no unit needs before it is computed with, such as powers of powers, which take for ever."""
    powers = len(re.findall(POWER, unit))
    fault = None
    if not unit.isprintable():
        fault = f"{unit[:LONGEST]!r} has characters that cannot be printed"
    elif len(unit) > LONGEST:
        fault = f"it has {len(unit)} characters, and {LONGEST} are enough"
    elif re.search(rf"(?<![^\W\d])\b[\d.]+\s*\)*\s*{POWER}|{POWER}[^*^]*\)\s*{POWER}", unit) or powers > 9:
        fault = "powers are those of units, as in m**3"
    elif re.search(rf"{POWER}\s*[-+(\s]*\d{{3}}|\d{{16}}", unit):
        fault = "it has a number too long for a unit"
    if fault is not None:
        raise CirlError(f"unit '{unit[:LONGEST]}': {fault}; write units as in kg, t/day, 1/day or m**3")


def _define_currency(unit: str, symbol: str) -> None:
    """Let pint know a currency of some year, a dimension of its own, as no factor that it knows leads to another."""
    currency, registry = CURRENCY.fullmatch(symbol), _registry()
    variant = CURRENCY_VARIANT.fullmatch(symbol)
    if currency is None and variant is not None:
        remedy = f"{variant[1].upper()}_{variant[2]}, or with k, M or G before it"
        raise CirlError(f"unit '{unit}': for '{symbol}' write {remedy}")
    if currency is None or symbol in registry:
        return
    code, year = currency.groups()
    if year is None:
        remedy = f"if it is a currency, give the year of its prices, as in {symbol}_2023"
        raise CirlError(f"unit '{unit}': '{symbol}' is unknown; {remedy}")
    registry.define(f"{code}{year} = [{code}{year}]")


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
    _check_form(unit)
    for symbol in re.findall(r"[^\W\d]\w*", unit):
        instead = _ambiguity(symbol)
        if instead is not None:
            raise CirlError(f"unit '{unit}': '{symbol}' is read in several ways; write {instead}")
        if symbol in MISSPELT:
            raise CirlError(f"unit '{unit}': for '{symbol}' write {MISSPELT[symbol]}")
        emission = EMISSION.fullmatch(symbol)
        if emission is not None and symbol != "CO2e":
            raise CirlError(f"unit '{unit}': for '{symbol}' write {f'{emission[1]} CO2e'.strip()}")
        _define_currency(unit, symbol)
    if unit.strip() == "-" or not target.strip():
        raise CirlError(f"unit '{unit}': write '1' for a number without unit")
    registry = _registry()
    import pint

    # what pint raises for texts that are no units
    unreadable = (pint.errors.PintError, ArithmeticError, AssertionError, AttributeError, RecursionError, TypeError)
    try:
        zero, scale = (float(registry.Quantity(value, unit).to(target).magnitude) for value in (0.0, 1.0))
    except pint.errors.DimensionalityError as error:
        raise CirlError(f"unit '{unit}' is inconsistent: a quantity in '{target}' is needed ({error})") from error
    except (*unreadable, ValueError, tokenize.TokenError) as error:
        form = "write units as in kg, t/day, 1/day or m**3"
        has_reason = isinstance(error, pint.errors.UndefinedUnitError | ArithmeticError)
        fault = str(error) if has_reason else "it is no product of units and their powers"
        raise CirlError(f"unit '{unit}' cannot be read: {fault}; {form}") from error
    if zero != 0.0:
        raise CirlError(f"unit '{unit}': its zero is another than that of '{target}'; give numbers in '{target}'")
    return scale
