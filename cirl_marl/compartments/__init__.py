"""Compartment models: one module per kind. Whatever module lies here is found; there is no list to keep."""

from __future__ import annotations

import importlib
import pkgutil
from functools import cache
from inspect import isabstract
from typing import Any

from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.network.compartment_model import (
    CompartmentModel,
    ContinuousModel,
    DiscreteTimeModel,
    GoalTask,
    MeasuringModel,
    OutflowModel,
    OwnStepModel,
    ReleasingModel,
    RewardState,
    Task,
    Vehicle,
    model_faults,
)

__all__ = [
    "CompartmentModel",
    "ContinuousModel",
    "DiscreteTimeModel",
    "GoalTask",
    "MeasuringModel",
    "OutflowModel",
    "OwnStepModel",
    "ReleasingModel",
    "RewardState",
    "Task",
    "Vehicle",
    "kind_of",
    "model_class",
    "models",
]

ROBOTS = f"{__name__}.robots"


@cache
def _models_of(package: str) -> dict[str, type[Any]]:
    """Import every module of a package, but not its subpackages, which may be heavy, and collect its models."""
    kinds: dict[str, type[Any]] = {}
    for module_info in pkgutil.iter_modules(importlib.import_module(package).__path__):
        if module_info.ispkg:
            continue
        module = importlib.import_module(f"{package}.{module_info.name}")
        for member in vars(module).values():
            if not isinstance(member, type) or member.__module__ != module.__name__:
                continue
            if not issubclass(member, CompartmentModel) or isabstract(member):
                continue
            kind = member.kind
            if kind in kinds:
                raise CirlError(f"{module.__name__}: kind '{kind}' is taken by {kinds[kind].__module__}.")
            kinds[kind] = member
    return kinds


def models() -> dict[str, type[Any]]:
    """Return every compartment model by its kind; robots import MuJoCo.

    >>> "transport_truck" in models()
    True
    """
    return dict(sorted((_models_of(__name__) | _models_of(ROBOTS)).items()))


def model_class(kind: str) -> type[Any]:
    """Return the model of that kind; MuJoCo is imported only for a kind that is not among the others.

    A model of your own is named by where it is, ``package.module:Class``.

    Raises:
        CirlError: if there is none; the message names the nearest match.

    >>> model_class("digester").time_unit
    'day'
    >>> model_class("cirl_marl.compartments.digester:Digester") is model_class("digester")
    True
    """
    if ":" in kind:
        return _elsewhere(kind)
    light = _models_of(__name__)
    if kind in light:
        return light[kind]
    try:
        return _models_of(ROBOTS)[kind]
    except KeyError:
        raise CirlError(unknown_name("compartment kind", kind, models())) from None


def kind_of(model: CompartmentModel) -> str:
    """Return the name by which definitions call the class of ``model``: its kind, or where it is if it is your own."""
    model_type, kind = type(model), model.kind
    built_in = _models_of(__name__).get(kind) or _models_of(ROBOTS).get(kind)
    return kind if built_in is model_type else f"{model_type.__module__}:{model_type.__qualname__}"


def _elsewhere(place: str) -> type[Any]:
    module, _, name = place.partition(":")
    if not all(part.isidentifier() for part in (*module.split("."), name)):
        raise CirlError(f"compartment kind '{place}': write where the class is, as 'package.module:Class'")
    try:
        model_class_ = getattr(importlib.import_module(module), name)
    except (ImportError, AttributeError) as error:
        is_absent = isinstance(error, ModuleNotFoundError) and error.name == module.split(".")[0]
        remedy = "; install it, or run with PYTHONPATH pointing to the folder that it lies in" if is_absent else ""
        raise CirlError(f"compartment kind '{place}': {error}{remedy}") from error
    except (Exception, SystemExit) as error:
        raise CirlError(f"compartment kind '{place}': importing it failed: {type(error).__name__}: {error}") from error
    if not isinstance(model_class_, type):
        raise CirlError(f"compartment kind '{place}': is no class of compartment models, but {model_class_!r}")
    if faults := list(model_faults(model_class_)):
        raise CirlError(f"compartment kind '{place}': is no class of compartment models: {'; '.join(faults)}")
    return model_class_
