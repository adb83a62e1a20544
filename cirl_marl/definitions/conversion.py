"""From a validated definition document to a network in its own units."""

from __future__ import annotations

import math
from typing import Any

from cirl_marl.compartments import CompartmentModel, model_class
from cirl_marl.definitions.mistakes import parameter_mistakes
from cirl_marl.definitions.schema import (
    ArcTable,
    Batches,
    ControlTable,
    ModelTable,
    NetworkTable,
    NodeTable,
    Quantity,
    ServiceTable,
)
from cirl_marl.errors import CirlError, NetworkError, unknown
from cirl_marl.network import Network
from cirl_marl.network.elements import (
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
from cirl_marl.network.units import factor

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

HINTS = {
    "rate": "a rate, 1/time, is the flow divided by the stock of its donor (law 'recipient': of its recipient); "
    "a flow that is known is law = \"exogenous\" with 'flow'",
    "steps": "the horizon counts control intervals (steps), which have unit '1'",
}
"""What else to say where a unit does not fit, by kind of quantity."""


class Converter:
    """Converts one validated document to the network's units, collecting what does not fit."""

    def __init__(self, table: NetworkTable) -> None:
        """Take the document; ``network`` converts it."""
        self.table = table
        self.mistakes: list[str] = []
        mass, time = table.units.mass, table.units.time
        self.targets = {"mass": mass, "time": time, "rate": f"1/({time})", "flow": f"({mass})/({time})", "steps": "1"}
        self.factors: dict[tuple[str, str], float] = {}
        self.scales: dict[str, float] = {}

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
        for key, kind, scale in (("stock", "mass", table.scales.stock), ("flow", "flow", table.scales.flow)):
            self.scales[kind] = self._value(scale, kind, f"scales.{key}")
            if self.scales[kind] <= 0:
                self.mistakes.append(f"scales.{key}: {scale.value} must be positive")
        nodes = tuple(self._node(id_, node) for id_, node in table.nodes.items())
        arcs = tuple(self._arc(id_, arc) for id_, arc in table.arcs.items())
        services = tuple(self._service(id_, service) for id_, service in table.services.items())
        horizon = self._value(episode.horizon, "steps", "episode.horizon")
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
            scale=self._scale(node.scale, "mass", where),
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
        model = self._model(arc.model, f"{where}.model")
        rate_kind = {Law.COMPARTMENT: "flow", Law.BATCH: "mass"}.get(arc.law, "rate")
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
            scale=self._scale(arc.scale, "mass" if arc.law is Law.BATCH else "flow", where),
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
        mistakes = list(parameter_mistakes(kind, table.parameters, form))
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
        ranged = model.ranged_states
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
        target = {
            ControlKind.RATE: "1",
            ControlKind.FLOW: "flow",
            ControlKind.INPUT: control.unit if model is None else model.input_unit,
        }[control.kind]
        if target is None and model is not None and control.unit != "1":
            self.mistakes.append(
                f"{where}: unit '{control.unit}': model '{model.kind}' states no input_unit to convert to; "
                f"give its class one, or write unit = '1' and the numbers as the model takes them"
            )
            return None
        unit = self._factor(control.unit, target or "1", where)
        return Control(
            kind=control.kind,
            low=control.low * unit,
            high=control.high * unit,
            neutral=control.neutral * unit,
        )

    def _scale(self, own: Quantity | None, kind: str, where: str) -> float:
        """Return a compartment's own reference value, or that of all that state none."""
        return self.scales[kind] if own is None else self._value(own, kind, f"{where}.scale")

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
                self.mistakes.append(f"{where}: {error}" + (f"; {HINTS[kind]}" if kind in HINTS else ""))
                return 1.0
        return self.factors[unit, kind]
