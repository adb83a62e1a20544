"""Compartment models: one module per kind. Whatever module lies here is found; there is no list to keep."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache

from cirl_marl.compartments.model import CompartmentModel, PaperScenario, RewardState
from cirl_marl.errors import CirlError, unknown

__all__ = ["CompartmentModel", "PaperScenario", "RewardState", "model_class", "models"]


@cache
def _found() -> dict[str, type[CompartmentModel]]:
    """Import every module of this package (not its subpackages, which may be heavy) and collect its models."""
    found: dict[str, type[CompartmentModel]] = {}
    for module_info in pkgutil.iter_modules(__path__):
        if module_info.ispkg:
            continue
        module = importlib.import_module(f"{__name__}.{module_info.name}")
        for member in vars(module).values():
            if not isinstance(member, type) or member.__module__ != module.__name__:
                continue
            kind = getattr(member, "kind", None)
            if not isinstance(kind, str):
                continue
            if kind in found:
                raise CirlError(f"{module.__name__}: kind '{kind}' is taken by {found[kind].__module__}.")
            found[kind] = member
    return dict(sorted(found.items()))


def models() -> dict[str, type[CompartmentModel]]:
    """Return every compartment model by its kind.

    >>> "transport_truck" in models()
    True
    """
    return dict(_found())


def model_class(kind: str) -> type[CompartmentModel]:
    """Return the model of that kind.

    Raises:
        CirlError: if there is none; the message names the nearest match.

    >>> model_class("digester").time_unit
    'day'
    """
    try:
        return _found()[kind]
    except KeyError:
        raise CirlError(unknown("compartment kind", kind, _found())) from None
