"""From a TOML definition to a ``Network``, naming every mistake by file and key."""

from __future__ import annotations

import copy
import difflib
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ValidationError

from cirl_marl.elements import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    Node,
    Objective,
    Observation,
    Service,
)
from cirl_marl.errors import CirlError, DefinitionError, NetworkError, unknown
from cirl_marl.network import Network
from cirl_marl.schema import ArcTable, ControlTable, NetworkTable, NodeTable, Quantity, ServiceTable
from cirl_marl.units import factor


def read_network(path: Path) -> Network:
    """Read a definition file; the other scenarios hang on the returned default network.

    Raises:
        DefinitionError: with every mistake in the file; nothing is returned half-read.
    """
    document = read_toml(path)
    overrides = document.get("scenarios", {})
    if not isinstance(overrides, dict) or not all(isinstance(o, dict) for o in overrides.values()):
        raise DefinitionError(str(path), ["scenarios: must be tables, as in [scenarios.paper]"])
    mistakes: list[str] = []
    networks: dict[str, Network] = {}
    for name, override in {"default": {}, **overrides}.items():
        where = "" if name == "default" else f"scenarios.{name}."
        strangers = list(_strangers(document, override, where))
        mistakes += strangers
        if strangers:
            continue
        try:
            networks[name] = _build(_merge(document, override), name)
        except NetworkError as error:
            mistakes += [where + problem for problem in error.problems]
            if name == "default":
                break  # the scenarios would only repeat these
    if mistakes:
        raise DefinitionError(str(path), mistakes)
    for network in networks.values():
        others = {name: other for name, other in networks.items() if other is not network}
        object.__setattr__(network, "scenarios", others)
        object.__setattr__(network, "source", path)
    return networks["default"]


def write_network(network: Network, path: Path) -> None:
    """Write a network built in Python as a definition file; its other scenarios are not written."""
    from cirl_marl.writing import definition_of

    path.write_text(definition_of(network), encoding="utf-8")


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file.

    Raises:
        DefinitionError: if it is missing, unreadable or not TOML (with line and column).
    """
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        raise DefinitionError(str(path), ["no such file"]) from None
    except (OSError, UnicodeDecodeError) as error:
        raise DefinitionError(str(path), [f"cannot be read: {error}"]) from error
    except tomllib.TOMLDecodeError as error:
        raise DefinitionError(str(path), [f"not valid TOML: {error}"]) from error


def mistakes_of(error: ValidationError, model: type[BaseModel]) -> list[str]:
    """Say each pydantic error in the words of the file: key, value, nearest valid name."""
    return [_mistake(dict(item), model) for item in error.errors()]


def _merge(base: Mapping[str, Any], override: Mapping[str, Any]) -> dict[str, Any]:
    """Return ``base`` with the tables of ``override`` laid over it; a quantity is replaced whole."""
    merged = {key: value for key, value in base.items() if key != "scenarios"}
    for key, value in override.items():
        old = merged.get(key)
        whole = isinstance(value, Mapping) and "source" in value
        nested = isinstance(value, Mapping) and isinstance(old, Mapping) and not whole
        merged[key] = _merge(old, value) if nested and isinstance(old, Mapping) else value
    return merged


def _strangers(document: Mapping[str, Any], override: Mapping[str, Any], where: str) -> typing.Iterator[str]:
    """Yield the compartments and services that a scenario names but the network does not have."""
    for table in ("nodes", "arcs", "services"):
        known = document.get(table, {})
        for name in override.get(table, {}):
            if name not in known:
                yield f"{where}{table}: {unknown(table[:-1], name, known)}"


def _build(document: Mapping[str, Any], scenario: str) -> Network:
    name = str(document.get("name", "?"))
    try:
        table = NetworkTable.model_validate(document)
    except ValidationError as error:
        mistakes = mistakes_of(error, NetworkTable)
        raise NetworkError(name, [*mistakes, *_further_mistakes(document, error, scenario)]) from None
    return _Converter(table).network(scenario)


def _further_mistakes(document: Mapping[str, Any], error: ValidationError, scenario: str) -> list[str]:
    """Look for mistakes behind the given ones, with misspelt values mended and unknown keys left out."""
    mended = copy.deepcopy(dict(document))
    for item in error.errors():
        *path, last = [part for part in item["loc"] if part != "[key]"]
        table: Any = mended
        for part in path:
            table = table[part]
        if item["type"] == "extra_forbidden":
            del table[last]
        elif item["type"] in ("enum", "literal_error"):
            choices = _choices(str(item["ctx"]["expected"]))
            table[last] = next(iter(difflib.get_close_matches(str(item["input"]), choices, n=1)), choices[0])
        else:
            return []
    try:
        _build(mended, scenario)
    except NetworkError as further:
        return list(further.problems)
    return []


class _Converter:
    """Converts one validated document to the network's units, collecting what does not fit."""

    def __init__(self, table: NetworkTable) -> None:
        self.table = table
        self.mistakes: list[str] = []
        mass, time = table.units.mass, table.units.time
        self.targets = {"mass": mass, "time": time, "rate": f"1/({time})", "flow": f"({mass})/({time})", "1": "1"}
        self.factors: dict[tuple[str, str], float] = {}

    def network(self, scenario: str) -> Network:
        table = self.table
        for key, unit, base in (("mass", table.units.mass, "kg"), ("time", table.units.time, "s")):
            try:
                factor(unit, base)
            except CirlError as error:
                raise NetworkError(table.name, [f"units.{key}: {error}"]) from None
        episode, objective = table.episode, table.objective
        nodes = tuple(self._node(id_, node) for id_, node in table.nodes.items())
        arcs = tuple(self._arc(id_, arc) for id_, arc in table.arcs.items())
        services = tuple(self._service(id_, service) for id_, service in table.services.items())
        horizon = self._value(episode.horizon, "1", "episode.horizon")
        if horizon != int(horizon):
            self.mistakes.append(f"episode.horizon: {horizon} must be a whole number of control intervals")
        settings: dict[str, Any] = {
            "episode": Episode(
                control_interval=self._value(episode.control_interval, "time", "episode.control_interval"),
                horizon=int(horizon),
                solver=episode.solver,
                solver_step=self._optional(episode.solver_step, "time", "episode.solver_step"),
            ),
            "objective": Objective(
                reference_interval=self._value(objective.reference_interval, "time", "objective.reference_interval"),
                net_zero=objective.net_zero,
                reward=objective.reward,
                circularity_scale=self._value(objective.circularity_scale, "mass", "objective.circularity_scale"),
                circularity_weight=self._value(objective.circularity_weight, "1", "objective.circularity_weight"),
                tracked=tuple(objective.tracked),
            ),
        }
        if self.mistakes:
            raise NetworkError(table.name, self.mistakes)
        return Network(
            name=table.name,
            title=table.title,
            mass_unit=table.units.mass,
            time_unit=table.units.time,
            scenario_name=scenario,
            nodes=nodes,
            arcs=arcs,
            services=services,
            acting=tuple(table.agents),
            observation=Observation(mode=table.observation.mode, nodes=tuple(table.observation.nodes)),
            **settings,
        )

    def _node(self, id_: str, node: NodeTable) -> Node:
        where = f"nodes.{id_}"
        scale = self._factor(node.initial.unit, "mass", f"{where}.initial")
        return Node(
            id=id_,
            role=node.role,
            initial=(node.initial.low * scale, node.initial.high * scale),
            set_point=self._optional(node.set_point, "mass", f"{where}.set_point"),
            scale=self._value(node.scale or self.table.scales.stock, "mass", f"{where}.scale"),
            control=self._control(node.control, f"{where}.control"),
        )

    def _arc(self, id_: str, arc: ArcTable) -> Arc:
        where = f"arcs.{id_}"
        self._check_law(arc, where)
        flow: tuple[float, ...] = (0.0,)
        times: tuple[float, ...] = ()
        if arc.flow is not None:
            flow = (self._value(arc.flow, "flow", f"{where}.flow"),)
        elif arc.series is not None:
            unit = self._factor(arc.series.unit, "flow", f"{where}.series")
            clock = self._factor(arc.series.time_unit, "time", f"{where}.series.time_unit")
            flow = tuple(value * unit for value in arc.series.values)
            times = tuple(time * clock for time in arc.series.times)
        return Arc(
            id=id_,
            donor=arc.from_,
            recipient=arc.to,
            law=arc.law,
            rate=self._optional(arc.rate, "rate", f"{where}.rate") or 0.0,
            flow=flow,
            times=times,
            set_point=self._optional(arc.set_point, "flow", f"{where}.set_point"),
            scale=self._value(arc.scale or self.table.scales.flow, "flow", f"{where}.scale"),
            pollutant=arc.pollutant,
            control=self._control(arc.control, f"{where}.control"),
        )

    def _check_law(self, arc: ArcTable, where: str) -> None:
        needed = {Law.DONOR: "rate", Law.RECIPIENT: "rate", Law.EXOGENOUS: "flow or series"}.get(arc.law, "")
        given = [key for key in ("rate", "flow", "series") if getattr(arc, key) is not None]
        if len(given) != (1 if needed else 0) or any(key not in needed for key in given):
            self.mistakes.append(
                f"{where}: law '{arc.law}' needs {needed or 'no rate, flow or series'}, got {given or 'none'}"
            )

    def _service(self, id_: str, service: ServiceTable) -> Service:
        where = f"services.{id_}"
        kind = "mass" if service.quantity == "stock" else "flow"
        high = self._optional(service.high, kind, f"{where}.high")
        return Service(
            id=id_,
            provider=service.provider,
            quantity=service.quantity,
            low=self._value(service.low, kind, f"{where}.low"),
            weight=self._value(service.weight, "1", f"{where}.weight"),
            owed_by=tuple(service.owed_by),
            **({} if high is None else {"high": high}),
        )

    def _control(self, control: ControlTable | None, where: str) -> Control | None:
        if control is None:
            return None
        unit = self._factor(control.unit, "flow" if control.kind is ControlKind.FLOW else "1", where)
        return Control(
            kind=control.kind,
            low=control.low * unit,
            high=control.high * unit,
            neutral=control.neutral * unit,
        )

    def _value(self, quantity: Quantity, kind: str, where: str) -> float:
        return quantity.value * self._factor(quantity.unit, kind, where)

    def _optional(self, quantity: Quantity | None, kind: str, where: str) -> float | None:
        return None if quantity is None else self._value(quantity, kind, where)

    def _factor(self, unit: str, kind: str, where: str) -> float:
        if (unit, kind) not in self.factors:
            try:
                self.factors[unit, kind] = factor(unit, self.targets[kind])
            except CirlError as error:
                self.mistakes.append(f"{where}: {error}")
                return 1.0
        return self.factors[unit, kind]


def _mistake(item: Mapping[str, Any], model: type[BaseModel]) -> str:
    location = [str(part) for part in item["loc"] if part != "[key]"]
    path = ".".join(location) or "file"
    if item["type"] == "extra_forbidden":
        parent = _model_at(model, location[:-1])
        known = [f.alias or name for name, f in parent.model_fields.items()] if parent else []
        return f"{path}: {unknown('key', location[-1], known)}"
    if item["type"] in ("enum", "literal_error"):
        known = _choices(str(item["ctx"]["expected"]))
        return f"{path}: {unknown('value', item['input'], known)}"
    if item["type"] == "missing":
        return f"{path}: missing"
    return f"{path}: {item['msg']}, got {item['input']!r}"


def _choices(expected: str) -> list[str]:
    return [part.strip(" '") for part in expected.replace(" or ", ", ").split(",")]


def _model_at(model: type[BaseModel], location: list[str]) -> type[BaseModel] | None:
    """Return the model of the table at ``location``."""
    current: Any = model
    for part in location:
        if isinstance(current, type) and issubclass(current, BaseModel):
            fields = {f.alias or name: f.annotation for name, f in current.model_fields.items()}
            current = fields.get(part)
        else:
            current = typing.get_args(current)[-1]
        if isinstance(current, types.UnionType):
            current = next(arg for arg in typing.get_args(current) if arg is not type(None))
    return current if isinstance(current, type) and issubclass(current, BaseModel) else None
