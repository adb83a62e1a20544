"""From a ``Network`` built in Python to the text of a definition file."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from datetime import date
from decimal import Decimal
from typing import Any

import numpy as np
import tomlkit

from cirl_marl.compartments import kind_of
from cirl_marl.errors import NetworkError
from cirl_marl.network import Network, declarations
from cirl_marl.network.elements import Arc, Compartment, Control, ControlKind, Law, Rate, Service
from cirl_marl.network.piecewise import PiecewiseRate
from cirl_marl.network.series import Series, Value
from cirl_marl.network.uncertainty import CAPACITY, Spread

SOURCE = "network built in Python"


def definition_of(network: Network) -> str:
    """Return a TOML definition that reads back as ``network``, its numbers equal to the last bit.

    What is as it is by default is left out, so that fields yet to come change no text.

    Raises:
        NetworkError: if a model has parameters other than numbers and its form.
    """
    return tomlkit.dumps(_toml_tables(_Writer(network).document()))


def fingerprint(network: Network) -> str:
    """Return a hash of the network under its scenario: of its definition, but for what changes no result."""
    document = _Writer(network).document() | {"title": network.name, "material": Network.material}
    document.pop("references", None)
    document.pop("accounts", None)  # what is booked changes nothing that moves
    for kind in ("nodes", "arcs", "services"):
        for part in document[kind].values():
            for key in ("title", "accounts", "effort", "holding"):
                part.pop(key, None)
    return hashlib.sha256(json.dumps(document, default=str).encode()).hexdigest()


def _toml_tables(document: dict[str, Any]) -> tomlkit.TOMLDocument:
    """Lay settings and compartments out as tables with a line for each key."""
    layout = tomlkit.document()
    for key, value in document.items():
        if key in ("nodes", "arcs", "services", "accounts", "substances", "disturbances") and value:
            layout[key] = tomlkit.table(is_super_table=True)
            for id_, part in value.items():
                layout[key][id_] = _fill_table(tomlkit.table(), part)
        else:
            layout[key] = _fill_table(tomlkit.table(), value) if isinstance(value, dict) and value else value
    return layout


def _fill_table(table: Any, entries: dict[str, Any]) -> Any:
    """Fill a TOML table; tables in it are inline."""
    for key, entry in entries.items():
        table[key] = _fill_table(tomlkit.inline_table(), entry) if isinstance(entry, dict) else entry
    return table


class _Writer:
    """Writes the parts of a network as tables, in the units of the network."""

    def __init__(self, network: Network) -> None:
        mass, time = network.mass_unit, network.time_unit
        self._network = network
        self._units = {"mass": mass, "time": time, "rate": f"1/({time})", "flow": f"({mass})/({time})"}

    def document(self) -> dict[str, Any]:
        network = self._network
        return {
            "name": network.name,
            "title": network.title,
            "material": network.material,
            **({"references": list(network.references)} if network.references else {}),
            "agents": list(network.default_agents),
            "units": {"mass": network.mass_unit, "time": network.time_unit},
            "scales": {"stock": self._quantity(1.0, "mass"), "flow": self._quantity(1.0, "flow")},
            "episode": self._part(network.episode),
            "objective": self._part(network.objective),
            "observation": self._part(network.observation),
            **{
                key: {part.id: self._part(part, f"{key}.{part.id}") for part in getattr(network, key)}
                for key in ("nodes", "arcs", "services")
            },
            **{
                key: {part.id: self._part(part) for part in parts}
                for key in ("accounts", "substances")
                if (parts := getattr(network, key))
            },
            **self._disturbances(),
        }

    def _disturbances(self) -> dict[str, Any]:
        network = self._network
        tables: dict[str, Any] = {}
        if network.disturbances:
            tables["disturbances"] = {
                name: {"kind": part.kind, **self._part(part), "unit": part.unit, "source": SOURCE}
                for name, part in network.disturbances.items()
            }
        if network.correlation is not None:
            tables["disturbance_correlation"] = {**self._part(network.correlation), "source": SOURCE}
        return tables

    def _disturbance_keys(self, path: str) -> dict[str, Any]:
        disturbed = self._network.disturbed.get(path)
        if disturbed is None:
            return {}
        return {"disturbed_by": disturbed.by, **({"disturbed_as": "summand"} if disturbed.adds else {})}

    def _part(self, part: Any, path: str = "") -> dict[str, Any]:
        """Return the table of a part, without what is as it is by default; ``path`` is its path."""
        table: dict[str, Any] = {}
        for name, declaration in declarations.declarations(type(part)).items():
            value, key = getattr(part, name), declaration.key or name
            must_write = declarations.is_required(type(part), name) or name == _stated_field(part)
            must_write = must_write or f"{path}.{name}" in {**self._network.uncertain, **self._network.disturbed}
            if not must_write and value == declarations.default_of(type(part), name):
                continue
            if isinstance(declaration, declarations.CalendarTime):
                table[key] = value if isinstance(value, date) else float(value)
            elif isinstance(declaration, declarations.Quantity) and declaration.unit_of_table:
                unit_ = self._units.get(declaration.kind(part)) or part.unit
                table |= {key: float(value), "unit": unit_, "source": SOURCE}
            elif isinstance(declaration, declarations.Rates):
                table[key] = {
                    id_: self._rate(number, f"{path}.{name}.{id_}", declaration, id_, part) for id_, number in value
                }
            elif isinstance(declaration, declarations.Quantity):
                table[key] = self._number(value, f"{path}.{name}", self._units.get(declaration.kind(part), "1"))
            elif isinstance(declaration, declarations.Numbers):
                unit = {"unit": self._units.get(declaration.of, "1"), "source": SOURCE}
                if declaration.table_form == "range":
                    table[key] = {"low": float(value[0]), "high": float(value[1]), **unit}
                elif declaration.table_form == "batches":
                    times, masses = ([float(pair[column]) for pair in value] for column in (0, 1))
                    table[key] = {"times": times, "masses": masses, "time_unit": self._units["time"], **unit}
                elif declaration.table_form in ("list", "record"):
                    table[key] = [*map(float, value)]
                elif declaration.table_form == "matrix":
                    table[key] = [[*map(float, row)] for row in value]
            elif isinstance(declaration, declarations.Subtable):
                write = {"control": self._control, "model": self._model}.get(declaration.of)
                table[key] = write(part) if write else self._part(value)
                if isinstance(value, Control):
                    table[key] |= self._disturbance_keys(f"{path}.{CAPACITY}")
                    table[key] |= _spread_keys(self._network.uncertain.get(f"{path}.control"), value.nominal)
            elif isinstance(value, tuple):
                table[key] = list(value)
            else:
                table[key] = value if isinstance(value, bool | int) else str(value)
        table.pop("reward_scale", None)  # it stands in the table of the model
        return table

    def _number(self, value: Value, path: str, unit: str) -> dict[str, Any]:
        number = self._quantity(value, "1") | {"unit": unit} | _spread_keys(self._network.uncertain.get(path), value)
        return number | self._disturbance_keys(path)

    def _rate(
        self, rate: Rate, path: str, declaration: declarations.Rates, id_: str, part: Compartment
    ) -> dict[str, Any]:
        """Return a rate on an account, or a part of a substance."""
        unit = self._named_unit(declaration, id_, part)
        if not isinstance(rate, PiecewiseRate):
            return self._number(rate, path, unit)
        of = declaration.unit_of_subject(self._units["mass"], self._units["time"], self._control_unit(part))
        amounts = {"to": [*map(float, rate.to)], "to_unit": of, "values": [*map(float, rate.rates)]}
        factor = {} if rate.factor == 1.0 else {"multiplied_by": self._quantity(rate.factor, "1")}
        spread = _spread_keys(self._network.uncertain.get(path), float(np.mean(rate.rates)))
        return {**amounts, "unit": unit, "source": SOURCE, **factor, **spread, **self._disturbance_keys(path)}

    def _named_unit(self, declaration: declarations.Rates, id_: str, part: Compartment) -> str:
        if declaration.of == "substance":
            return "1"
        units = {account.id: account.unit for account in self._network.accounts}
        return declaration.unit(units[id_], self._units["mass"], self._units["time"], self._control_unit(part))

    def _control_unit(self, part: Compartment) -> str:
        control = part.control
        if control is not None and control.kind is ControlKind.INPUT and part.model is not None:
            return part.model.input_unit or "1"
        return self._units["flow"] if control is not None and control.kind is ControlKind.FLOW else "1"

    def _control(self, part: Compartment) -> dict[str, Any]:
        control, unit = part.control, self._control_unit(part)
        assert isinstance(control, Control)
        sides = {"low": control.low, "neutral": control.neutral, "high": control.high}
        bounds = {side: self._series(at) if isinstance(at, Series) else float(at) for side, at in sides.items()}
        substances = {"substances": list(control.substances)} if control.substances else {}
        return {"kind": control.kind.value, **bounds, **substances, "unit": unit, "source": SOURCE}

    def _model(self, part: Compartment) -> dict[str, Any]:
        model: Any = part.model
        table: dict[str, Any] = {"kind": kind_of(model), "source": SOURCE, "parameters": {}}
        for parameter in dataclasses.fields(model):
            value = getattr(model, parameter.name)
            if parameter.name == "form":
                table["form"] = value
            elif isinstance(value, int | float):
                table["parameters"][parameter.name] = value if isinstance(value, bool) else float(value)
            elif value != (
                parameter.default if parameter.default_factory is dataclasses.MISSING else parameter.default_factory()
            ):
                fault = "is no number, which a definition cannot say"
                problem = f"parameter '{parameter.name}' of its model '{model.kind}' {fault}"
                raise NetworkError(f"compartment '{part.id}'", [problem])
        spans = zip(model.ranged_states, part.inner, strict=True)
        table["initial"] = {name: {"low": float(a), "high": float(b), "source": SOURCE} for name, (a, b) in spans}
        table["reward_scale"] = self._quantity(part.reward_scale, "1")
        return table

    def _quantity(self, value: Value, kind: str) -> dict[str, Any]:
        number = self._series(value) if isinstance(value, Series) else {"value": float(value)}
        return {**number, "unit": self._units.get(kind, "1"), "source": SOURCE}

    def _series(self, series: Series) -> dict[str, Any]:
        entries: dict[str, Any] = {name: list(map(float, getattr(series, name))) for name in ("times", "values")}
        if series.interpolation != "step":
            entries["interpolation"] = series.interpolation
        if series.until is not None:
            entries["until"] = float(series.until)
        if series.factor is not None:
            entries["multiplied_by"] = {**self._series(series.factor), "unit": "1", "source": SOURCE}
        return {**entries, "time_unit": self._units["time"]}


def _spread_keys(spread: Spread | None, value: Value) -> dict[str, Any]:
    if spread is None:
        return {}
    middle = float(np.mean(value.values)) if isinstance(value, Series) else value
    entries: dict[str, Any] = {"distribution": spread.distribution}
    if spread.deviation is not None:
        # in percent, so that it reads back to the last bit
        entries["deviation"] = f"{Decimal(repr(float(spread.deviation))) * 100:f} %"
    if math.isfinite(spread.high):
        entries["range"] = sorted([spread.low * middle, spread.high * middle])
    return entries


def _stated_field(part: Any) -> str:
    """Return the field that is written even where it is as by default: of an arc what its law needs."""
    if isinstance(part, Service):
        return "low"  # files of 0.1.0 have it, and fingerprints stay the same
    if not isinstance(part, Arc):
        return ""
    by_schedule = part.law is Law.BATCH and not part.by
    return "flow" if part.law is Law.EXOGENOUS else "batches" if by_schedule else ""
