"""What the parameters of a compartment model may be."""

from __future__ import annotations

import math

from cirl_marl.errors import CirlError, unknown


def check_form(form: str, known: tuple[str, ...]) -> None:
    """Raise a ``CirlError`` unless ``form`` is one of ``known``."""
    if form not in known:
        raise CirlError(unknown("form", form, known))


def check_positive(kind: str, **parameters: float) -> None:
    """Raise a ``CirlError`` that names the first parameter that is not a positive finite number."""
    for name, value in parameters.items():
        if not (math.isfinite(value) and value > 0.0):
            raise CirlError(f"{kind}: {name} = {value!r}, but it must be positive and finite.")


def check_not_negative(kind: str, **parameters: float) -> None:
    """Raise a ``CirlError`` that names the first parameter that is negative or not finite."""
    for name, value in parameters.items():
        if not (math.isfinite(value) and value >= 0.0):
            raise CirlError(f"{kind}: {name} = {value!r}, but it must be finite and not negative.")


def check_share(kind: str, **parameters: float) -> None:
    """Raise a ``CirlError`` that names the first parameter that is no share of a whole, in [0, 1]."""
    for name, value in parameters.items():
        if not 0.0 <= value <= 1.0:
            raise CirlError(f"{kind}: {name} = {value!r}, but it must lie in [0, 1].")
