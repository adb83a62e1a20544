"""From a validated definition document to a network in its own units."""

from __future__ import annotations

import inspect
import math
from collections.abc import Iterator, Mapping
from typing import Any

from cirl_marl.compartments import CompartmentModel, model_class
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
    ranged_states,
)
from cirl_marl.errors import CirlError, NetworkError, unknown
from cirl_marl.network import Network
from cirl_marl.schema import (
    ArcTable,
    Batches,
    ControlTable,
    ModelTable,
    NetworkTable,
    NodeTable,
    Quantity,
    ServiceTable,
)
from cirl_marl.units import factor

GIVEN = ("rate", "flow", "series", "batches")
NEEDED = {
    Law.DONOR: ("rate",),
    Law.RECIPIENT: ("rate",),
    Law.CONTROLLED: ("",),
    Law.EXOGENOUS: ("flow", "series"),
    Law.COMPARTMENT: ("rate",),
    Law.BATCH: ("rate", "batches"),
}
"""What each law needs, one of the given."""

BY_NAME = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
"""Kinds of the parameters that a definition can give."""


class Converter:
    """Converts one validated document to the network's units, collecting what does not fit."""

    def __init__(self, table: NetworkTable) -> None:
        """Take the document; ``network`` converts it."""
        self.table = table
        self.mistakes: list[str] = []
        mass, time = table.units.mass, table.units.time
        self.targets = {"mass": mass, "time": time, "rate": f"1/({time})", "flow": f"({mass})/({time})", "1": "1"}
        self.factors: dict[tuple[str, str], float] = {}

    def network(self, scenario: str) -> Network:
        """Return the network.

        Raises:
            NetworkError: with every inconsistent unit and every fault of the network.
        """
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
                criticality=self._optional(objective.criticality, "1", "objective.criticality"),
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
        model = self._model(node.model, f"{where}.model")
        return Node(
            id=id_,
            role=node.role,
            initial=(node.initial.low * scale, node.initial.high * scale),
            set_point=self._optional(node.set_point, "mass", f"{where}.set_point"),
            scale=self._value(node.scale or self.table.scales.stock, "mass", f"{where}.scale"),
            control=self._control(node.control, model.get("model"), f"{where}.control"),
            **model,
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
        batches: tuple[tuple[float, float], ...] = ()
        if arc.batches is not None:
            batches = self._batches(arc.batches, f"{where}.batches")
        batch = arc.law is Law.BATCH
        model = self._model(arc.model, f"{where}.model")
        rate_kind = {Law.COMPARTMENT: "flow", Law.BATCH: "mass"}.get(arc.law, "rate")
        default = self.table.scales.stock if batch else self.table.scales.flow
        return Arc(
            id=id_,
            donor=arc.from_,
            recipient=arc.to,
            law=arc.law,
            rate=self._optional(arc.rate, rate_kind, f"{where}.rate") or 0.0,
            by=arc.by,
            port=arc.port,
            batches=batches,
            delay=self._optional(arc.delay, "time", f"{where}.delay") or 0.0,
            flow=flow,
            times=times,
            set_point=self._optional(arc.set_point, "flow", f"{where}.set_point"),
            scale=self._value(arc.scale or default, "mass" if batch else "flow", f"{where}.scale"),
            pollutant=arc.pollutant,
            control=self._control(arc.control, model.get("model"), f"{where}.control"),
            **model,
        )

    def _check_law(self, arc: ArcTable, where: str) -> None:
        given = [key for key in GIVEN if getattr(arc, key) is not None]
        if given not in ([key] if key else [] for key in NEEDED[arc.law]):
            needed = " or ".join(key for key in NEEDED[arc.law] if key) or f"none of {', '.join(GIVEN)}"
            self.mistakes.append(f"{where}: law '{arc.law}' needs {needed}, got {given or 'none'}")

    def _batches(self, table: Batches, where: str) -> tuple[tuple[float, float], ...]:
        if len(table.times) != len(table.masses):
            self.mistakes.append(f"{where}: {len(table.times)} times and {len(table.masses)} masses")
            return ()
        clock = self._factor(table.time_unit, "time", f"{where}.time_unit")
        unit = self._factor(table.unit, "mass", f"{where}.unit")
        return tuple((time * clock, mass * unit) for time, mass in zip(table.times, table.masses, strict=True))

    def _service(self, id_: str, service: ServiceTable) -> Service:
        where = f"services.{id_}"
        kind = {"stock": "mass", "measure": "1"}.get(service.quantity, "flow")
        high = self._optional(service.high, kind, f"{where}.high")
        return Service(
            id=id_,
            provider=service.provider,
            quantity=service.quantity,
            low=self._value(service.low, kind, f"{where}.low"),
            weight=self._value(service.weight, "1", f"{where}.weight"),
            owed_by=tuple(service.owed_by),
            measure=service.measure,
            high=math.inf if high is None else high,
        )

    def _model(self, table: ModelTable | None, where: str) -> dict[str, Any]:
        """Return the model of a compartment and the initial ranges of its inner states, as keywords."""
        if table is None:
            return {}
        try:
            kind = model_class(table.kind)
        except CirlError as error:
            self.mistakes.append(f"{where}: {error}")
            return {}
        form = {} if table.form is None else {"form": table.form}
        mistakes = list(_parameter_mistakes(kind, table.parameters, form))
        self.mistakes += (f"{where}: {mistake}" for mistake in mistakes)
        if mistakes:
            return {}
        try:
            model = kind(**table.parameters | form)
        except CirlError as error:
            self.mistakes.append(f"{where}: {error}")
            return {}
        except (ArithmeticError, TypeError, ValueError) as error:
            self.mistakes.append(f"{where}: '{table.kind}' refuses its parameters: {type(error).__name__}: {error}")
            return {}
        ranged = ranged_states(model)
        for name in (*table.initial, *ranged):
            if name not in ranged or name not in table.initial:
                missing = [state for state in ranged if state not in table.initial]
                told = f"'{name}' is missing" if name in ranged else unknown("inner state", name, missing)
                self.mistakes.append(f"{where}.initial: {told}")
        ranges = [table.initial[name] for name in ranged if name in table.initial]
        scale = self._optional(table.reward_scale, "1", f"{where}.reward_scale")
        return {
            "model": model,
            "inner": tuple((span.low, span.high) for span in ranges),
            "reward_scale": 1.0 if scale is None else scale,
        }

    def _control(self, control: ControlTable | None, model: CompartmentModel | None, where: str) -> Control | None:
        if control is None:
            return None
        target = "flow" if control.kind is ControlKind.FLOW else "1"
        if control.kind is ControlKind.INPUT:
            target = getattr(model, "input_unit", control.unit)
        unit = self._factor(control.unit, target, where)
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
        """Return what converts ``unit`` to the network's unit of a kind, or to the unit ``kind`` if it is none."""
        if (unit, kind) not in self.factors:
            try:
                self.factors[unit, kind] = factor(unit, self.targets.get(kind, kind))
            except CirlError as error:
                self.mistakes.append(f"{where}: {error}")
                return 1.0
        return self.factors[unit, kind]


def _parameter_mistakes(
    kind: type[Any], parameters: Mapping[str, bool | float], form: Mapping[str, str]
) -> Iterator[str]:
    """Yield what a model does not take, what it needs besides, and numbers and truth values that are none."""
    known = {name: each for name, each in inspect.signature(kind).parameters.items() if each.kind in BY_NAME}
    for name in (*parameters, *form):
        if name not in known:
            yield unknown("parameter", name, known)
    for name, parameter in known.items():
        if parameter.default is parameter.empty and name not in {*parameters, *form}:
            yield f"{name}: missing" if name == "form" else f"parameters.{name}: missing"
        elif name in parameters:
            yield from _type_mistakes(parameter, parameters[name])


def _type_mistakes(parameter: inspect.Parameter, value: bool | float) -> Iterator[str]:
    """Yield it if a value is not of a parameter's kind: true or false, or, unless another default is seen, a number."""
    default = parameter.default
    if default is not parameter.empty and not isinstance(default, int | float):
        yield f"parameters.{parameter.name}: is no number, so that a definition cannot give it"
        return
    truth = isinstance(default, bool) or (default is parameter.empty and parameter.annotation in (bool, "bool"))
    if truth != isinstance(value, bool):
        needs = "true or false" if truth else "a number"
        yield f"parameters.{parameter.name}: needs {needs}, got {value!r}"
