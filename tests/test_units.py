"""Units of definition files."""

from __future__ import annotations

import re

import pytest

from cirl_marl import CirlError
from cirl_marl.network.units import factor


def test_kt_is_the_kilotonne() -> None:
    """Pint alone reads kt as the knot."""
    assert factor("kt", "kg") == pytest.approx(1e6)
    with pytest.raises(CirlError, match="inconsistent"):
        factor("kt", "m/s")


@pytest.mark.parametrize(
    ("unit", "instead"),
    [
        ("ton", "t (tonne), or short_ton, or long_ton"),
        ("tons/day", "t (tonne)"),
        ("ktons", "kt (kilotonne)"),
        ("kiloton", "kt (kilotonne)"),
        ("Mtons", "Mt (megatonne)"),
        ("1/Gton", "Gt (gigatonne), or gigashort_ton"),
        ("Gtons", "Gt (gigatonne)"),
        ("Tton", "Tt (teratonne)"),
        ("mton", "t (metric tonne), or Mt (megatonne)"),
        ("mt", "t (metric tonne), or Mt (megatonne)"),
    ],
)
def test_tons_are_refused_with_any_prefix(unit: str, instead: str) -> None:
    """Pint alone takes them for short tons, 9 % off, or for millitonnes; the message says what to write instead."""
    with pytest.raises(CirlError, match="is read in several ways; write " + re.escape(instead)):
        factor(unit, "kg")


@pytest.mark.parametrize(
    ("unit", "kg"),
    [
        ("tonne", 1e3),
        ("t", 1e3),
        ("metric_tons", 1e3),
        ("Gt", 1e12),
        ("kilotonne", 1e6),
        ("short_ton", 907.18474),
        ("kshort_tons", 907184.74),
        ("gigashort_ton", 907.18474e9),
        ("kilolong_ton", 1016.0469088e3),
    ],
)
def test_masses_that_say_which_ton(unit: str, kg: float) -> None:
    """Spelt out, each of them is understood."""
    assert factor(unit, "kg") == pytest.approx(kg, rel=1e-12)


@pytest.mark.parametrize(
    ("unit", "target", "said"),
    [
        ("degC", "K", "its zero is another than that of 'K'; give numbers in 'K'"),
        ("K", "degC", "its zero is another than that of 'degC'"),
        ("-", "1", "unit '-': write '1' for a number without unit"),
        ("", "", "unit '': write '1' for a number without unit"),
        ("1/day/0", "1/day", "cannot be read: .*zero.*; write units as in kg, t/day, 1/day"),
        ("1/", "1/day", "cannot be read: .*; write units as in kg, t/day, 1/day"),
        ("d-1", "1/day", "cannot be read: .*; write units as in kg, t/day, 1/day"),
        ("1/y", "1/day", "for 'y' write year"),
        ("kT", "kt", re.escape("for 'kT' write kt (kilotonne)")),
        ("T/day", "t/day", re.escape("for 'T' write t (tonne)")),
        ("TEUR_2023/t", "EUR_2023/t", "for 'TEUR_2023' write EUR_2023, or with k, M or G before it"),
        ("mEUR_2023", "EUR_2023", "for 'mEUR_2023' write EUR_2023"),
        ("EUR2015/t", "EUR_2015/t", "for 'EUR2015' write EUR_2015"),
        ("keur_2015", "EUR_2015", "for 'keur_2015' write EUR_2015"),
        ("t CO2/t", "t CO2e/t", "for 'CO2' write CO2e"),
        ("kgCO2eq/t", "t CO2e/t", "for 'kgCO2eq' write kg CO2e"),
        ("pct", "kt", "for 'pct' write %"),
        ("ppb", "1", "for 'ppb' write mg/t"),
        *((unit, "1", "write nothing, as in '%' or 'ppm'") for unit in ("wt%", "wt.-%", "mass%", "% by weight")),
    ],
)
def test_units_that_cannot_be_used_say_what_to_write(unit: str, target: str, said: str) -> None:
    """Also those that pint would convert to something else, or fail at in its own way."""
    if "_20" in target:
        factor(target, target)  # what a prefix was read of once the currency was known
    with pytest.raises(CirlError, match=said):
        factor(unit, target)


def test_temperatures_keep_their_scale() -> None:
    """Degrees are degrees, whatever their zero."""
    assert factor("degC", "degC") == 1.0
    assert factor("1/K", "1/K") == 1.0
