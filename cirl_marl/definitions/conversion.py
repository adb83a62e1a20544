"""From a validated definition document to a network in its own units."""

from __future__ import annotations

import math
from dataclasses import replace
from decimal import Decimal
from typing import Any

import numpy as np

from cirl_marl.compartments import CompartmentModel, model_class
from cirl_marl.definitions.code_permission import refusal
from cirl_marl.definitions.data_files import DataFiles
from cirl_marl.definitions.error_messages import parameter_mistakes
from cirl_marl.definitions.quantities import AmountColumn, AmountSeries, PiecesTable, QuantityTable, Range, RecordColumn
from cirl_marl.definitions.schema import Batches, ModelTable, NetworkTable
from cirl_marl.definitions.series_tables import Clock, column_value, inline_series
from cirl_marl.errors import CirlError, NetworkError, unknown_name
from cirl_marl.network import Network, elements
from cirl_marl.network.declarations import Declaration, Numbers, Quantity, Rates, Subtable, declarations
from cirl_marl.network.disturbances import KINDS, Correlation, DisturbanceEffect
from cirl_marl.network.elements import LAW_FIELDS, Arc, Control, ControlKind, Law, Node
from cirl_marl.network.piecewise import PiecewiseRate
from cirl_marl.network.series import Series, Value, extremes, product
from cirl_marl.network.uncertainty import Spread
from cirl_marl.network.units import factor

FLOW_KEYS = ("rate", "flow", "batches")
"""Keys of which a law needs one, if it takes any of them."""
LISTS = {"services": elements.Service, "accounts": elements.Account, "substances": elements.Substance}
"""Parts of a network that have ids, beside its compartments."""
SETTINGS = {"episode": elements.Episode, "objective": elements.Objective, "observation": elements.Observation}
SUBRECORDS = {"lifetime": elements.Lifetime, "rule": elements.FeedbackRule}
"""What tables within those of compartments become that need nothing else."""
CONSTANT = "cannot change in time; fix the time, too, in 'where', and leave no column of times"
UNCERTAINTY = ("deviation", "range", "distribution", "disturbed_by", "disturbed_as")
"""Keys that say how a quantity is not certain."""
REGION = "{region}"
"""What stands for the text of the region in the title and in ``where``."""

HINTS = {
    "rate": "a rate, 1/time, is the flow divided by the stock of its donor (law 'recipient': of its recipient); "
    "a flow that is known is law = \"exogenous\" with 'flow'",
    "steps": "the horizon counts control intervals (steps), which have unit '1'",
}
"""What else to say where a unit does not fit, by kind of quantity."""


class Converter:
    """Converts one validated document to the network's units, collecting what does not fit."""

    def __init__(self, table: NetworkTable, files: DataFiles, region: str = "") -> None:
        """Take the document, the files that it names and the region meant; ``network`` converts it."""
        self.table, self.files, self.region = table, files, region
        self.mistakes: list[str] = []
        self.data_files: set[str] = set()
        self.uncertain: dict[str, Spread] = {}
        self.disturbed: dict[str, DisturbanceEffect] = {}
        self._file_errors: set[str] = set()
        mass, time = table.units.mass, table.units.time
        self.targets = {"mass": mass, "time": time, "rate": f"1/({time})", "flow": f"({mass})/({time})", "steps": "1"}
        self.factors: dict[tuple[str, str], float] = {}
        self.scales: dict[str, Any] = {}
        episode: Any = table.episode
        self.clock = Clock(episode.start, time)

    def network(self, **fields: Any) -> Network:
        """Return the network with fields that are ``fields`` besides.

        Raises:
            NetworkError: with every inconsistent unit and unusable column, or else every fault of the network.
        """
        table = self.table
        units = [("units.mass", table.units.mass, "kg"), ("units.time", table.units.time, "s")]
        accounts: Any = table.accounts
        units += [(f"accounts.{id_}.unit", part.unit, part.unit) for id_, part in accounts.items()]
        for path, unit, base in units:
            try:
                factor(unit, base)
            except CirlError as error:
                raise NetworkError(table.name, [f"{path}: {error}"]) from None
        for key, kind, scale in (("stock", "mass", table.scales.stock), ("flow", "flow", table.scales.flow)):
            self.scales[kind] = self._number(scale, kind, f"scales.{key}")
            if self.scales[kind] <= 0:
                self.mistakes.append(f"scales.{key}: {self.scales[kind]} must be positive")
        parts: dict[str, Any] = {
            "nodes": tuple(self._compartment(Node, id_, node, f"nodes.{id_}") for id_, node in table.nodes.items()),
            "arcs": tuple(self._compartment(Arc, id_, arc, f"arcs.{id_}") for id_, arc in table.arcs.items()),
        }
        for key, record in LISTS.items():
            entries = getattr(table, key).items()
            parts[key] = tuple(self._part(record, part, f"{key}.{id_}", id=id_) for id_, part in entries)
        parts |= {key: self._part(record, getattr(table, key), key) for key, record in SETTINGS.items()}
        parts["disturbances"] = {
            name: self._part(KINDS[entry.kind], entry, f"disturbances.{name}")
            for name, entry in table.disturbances.items()
        }
        if table.disturbance_correlation is not None:
            correlation = self._part(Correlation, table.disturbance_correlation, "disturbance_correlation")
            parts["correlation"] = correlation
        title, material = (self._with_region(getattr(table, key), key) for key in ("title", "material"))
        if self.mistakes:
            raise NetworkError(table.name, self.mistakes)
        return Network(
            name="_".join([table.name, *([self.region] if self.region else [])]),
            title=title,
            material=material,
            references=tuple(table.references),
            mass_unit=table.units.mass,
            time_unit=table.units.time,
            region=self.region,
            data_sha256={name: self.files.sha256(name) for name in sorted({*self.data_files, *self.files.plain_files})},
            default_agents=tuple(table.agents),
            uncertain=self.uncertain,
            disturbed=self.disturbed,
            **parts,
            **fields,
        )

    def _part(self, record: type[Any], table: Any, path: str, **fields: Any) -> Any:
        """Return a part of the network: ``fields`` fields, those that its table gives, and defaults for the others."""
        for name, declaration in declarations(record).items():
            entry = getattr(table, name, None)
            if name not in fields and entry is not None:
                fields[name] = self._read(declaration, entry, table, f"{path}.{declaration.key or name}")
        try:
            return record(**fields)
        except NetworkError as error:
            # what could not be read stands in ``fields`` as a number, so that a fault may only follow from that
            problems = self.mistakes or [f"{path}: {problem}" for problem in error.problems]
            raise NetworkError(self.table.name, problems) from None

    def _read(self, declaration: Declaration, entry: Any, table: Any, path: str) -> Any:
        """Return what a declared field is in Python."""
        if isinstance(declaration, Quantity):
            kind = declaration.kind(table)
            if declaration.unit_of_table:
                return entry * self._factor(table.unit, kind, path)
            value: Any = None if entry == declaration.none_word else self._value(entry, kind, path)
            if isinstance(value, Series) and not declaration.varies:
                self.mistakes.append(f"{path}: {CONSTANT}")
                return 1
            if kind != "steps":
                return value
            if value != int(value):
                self.mistakes.append(f"{path}: {value} must be a whole number of control intervals")
            return int(value)
        if isinstance(declaration, Rates):
            return {id_: self._named_value(declaration, id_, value, path) for id_, value in entry.items()}
        if isinstance(declaration, Subtable) and declaration.of in SUBRECORDS:
            return self._part(SUBRECORDS[declaration.of], entry, path)
        if isinstance(entry, Range):
            assert isinstance(declaration, Numbers)
            scale = self._factor(entry.unit, declaration.of, path)
            return entry.low * scale, entry.high * scale
        if isinstance(declaration, Numbers) and declaration.table_form == "range":
            stock = self._number(entry, declaration.of, path)
            return stock, stock
        if isinstance(entry, Batches):
            return self._batches(entry, path)
        if isinstance(entry, RecordColumn):
            return self._record(entry, path)
        if isinstance(declaration, Numbers) and declaration.table_form == "matrix":
            return tuple(map(tuple, entry))
        return tuple(entry) if isinstance(entry, list) else entry

    def _named_value(
        self, declaration: Rates, id_: str, entry: Any, path: str, control_unit: str = "1"
    ) -> elements.Rate:
        """Return what is charged on an account, or a part of a substance."""
        tables: Any = getattr(self.table, f"{declaration.of}s")
        if id_ not in tables:
            self.mistakes.append(f"{path}: {unknown_name(declaration.of, id_, tables)}")
            return 0.0
        path, units = f"{path}.{id_}", self.table.units
        if declaration.of == "substance":
            return self._value(entry, "1", path)
        unit = declaration.unit(tables[id_].unit, units.mass, units.time, control_unit)
        if isinstance(entry, PiecesTable):
            return self._pieces(entry, unit, declaration.unit_of_subject(units.mass, units.time, control_unit), path)
        return self._value(entry, unit, path)

    def _pieces(self, entry: PiecesTable, kind: str, subject: str, path: str) -> PiecewiseRate:
        """Return a rate in pieces, and of what, in units ``kind`` and ``subject``."""
        name = self._unit_of_product(entry, path)
        unit, unit_of_amounts = self._factor(name, kind, path), self._factor(entry.to_unit, subject, f"{path}.to_unit")
        rates, to = (
            tuple(number * by for number in numbers)
            for numbers, by in ((entry.values, unit), (entry.to, unit_of_amounts))
        )
        self._spread(entry, float(np.mean(rates or 0.0)), unit, path)
        self._disturb(entry, name, kind, path)
        if entry.multiplied_by is None:
            return PiecewiseRate(to=to, rates=rates)
        return PiecewiseRate(
            to=to, rates=rates, factor=self._in_time(entry.multiplied_by, 1.0, f"{path}.multiplied_by")
        )

    def _record(self, entry: RecordColumn, path: str) -> tuple[float, ...]:
        texts = {key: self._with_region(text, f"{path}.where.{key}") for key, text in entry.where.items()}
        try:
            column = self.files.column(entry.file, entry.column, texts, entry.times)
        except CirlError as error:
            self.mistakes.append(f"{path}: {error}")
            return ()
        self.data_files.add(entry.file)
        return tuple(column.values)

    def _compartment(self, record: type[Node] | type[Arc], id_: str, table: Any, path: str) -> Any:
        """Return a node or an arc, whose control depends on its model, with the scale of all that state none."""
        fields = {"id": id_, **self._model(table.model, f"{path}.model")}
        model = fields.get("model")
        fields |= {"model": model, "control": self._control(table.control, model, path)}
        unit = "1" if table.control is None else self._control_unit(table.control, model) or "1"
        effort = table.effort.items()
        fields["effort"] = {
            id_: self._named_value(elements.EFFORT, id_, value, f"{path}.effort", unit) for id_, value in effort
        }
        if record is Arc:
            self._check_law(table, path)
        if table.scale is None:
            scale = declarations(record)["scale"]
            assert isinstance(scale, Quantity)
            fields["scale"] = self.scales[scale.kind(table)]
        return self._part(record, table, path, **fields)

    def _check_law(self, arc: Any, path: str) -> None:
        """Note an arc that lacks what its law needs, or gives what only others take."""
        keys = [key for key in FLOW_KEYS if getattr(arc, key) is not None]
        options = [key for key in FLOW_KEYS if key in LAW_FIELDS[Law(arc.law)]]
        if len(keys) != min(1, len(options)) or not set(keys) <= set(options):
            demand = " or ".join(options) or f"none of {', '.join(FLOW_KEYS)}"
            self.mistakes.append(f"{path}: law '{arc.law}' needs {demand}, got {keys or 'none'}")
        if arc.share is not None and Law(arc.law) is not Law.SHARE:
            self.mistakes.append(f"{path}.share: law '{arc.law}' takes none; shares need law = \"share\"")

    def _batches(self, table: Batches, path: str) -> tuple[tuple[float, float], ...]:
        if len(table.times) != len(table.masses):
            self.mistakes.append(f"{path}: {len(table.times)} times and {len(table.masses)} masses")
            return ()
        clock = self._factor(table.time_unit, "time", f"{path}.time_unit")
        unit = self._factor(table.unit, "mass", f"{path}.unit")
        return tuple((time * clock, mass * unit) for time, mass in zip(table.times, table.masses, strict=True))

    def _model(self, table: ModelTable | None, path: str) -> dict[str, Any]:
        """Return the model of a compartment and the initial ranges of its inner states, as keywords."""
        if table is None:
            return {}
        form = {} if table.form is None else {"form": table.form}
        if (refusal_ := refusal(table.kind)) is not None:
            self.mistakes.append(f"{path}: {refusal_}")
            return {}
        try:
            kind = model_class(table.kind)
            if mistakes := list(parameter_mistakes(kind, table.parameters, form)):
                self.mistakes += (f"{path}: {mistake}" for mistake in mistakes)
                return {}
            model = kind(**table.parameters | form)
        except CirlError as error:
            self.mistakes.append(f"{path}: {error}")
            return {}
        except (ArithmeticError, TypeError, ValueError) as error:
            self.mistakes.append(f"{path}: '{table.kind}' refuses its parameters: {type(error).__name__}: {error}")
            return {}
        with_range = model.ranged_states
        for name in (*table.initial, *with_range):
            if name not in with_range or name not in table.initial:
                options = [state for state in with_range if state not in table.initial]
                fault = f"'{name}' is missing" if name in with_range else unknown_name("inner state", name, options)
                self.mistakes.append(f"{path}.initial: {fault}")
        ranges = [table.initial[name] for name in with_range if name in table.initial]
        fields: dict[str, Any] = {"model": model, "inner": tuple((span.low, span.high) for span in ranges)}
        if table.reward_scale is not None:
            fields["reward_scale"] = self._value(table.reward_scale, "1", f"{path}.reward_scale")
        return fields

    def _control(self, control: Any, model: CompartmentModel | None, path: str) -> Control | None:
        path = f"{path}.control"
        if control is None:
            return None
        target = self._control_unit(control, model)
        if target is None and model is not None and control.unit != "1":
            remedy = "give its class one, or write unit = '1' and the numbers as the model takes them"
            fault = f"unit '{control.unit}': model '{model.kind}' states no input_unit to convert to"
            self.mistakes.append(f"{path}: {fault}; {remedy}")
            return None
        unit = self._factor(control.unit, target or "1", path)
        ends = ("low", "neutral", "high")
        sides = {side: self._in_time(getattr(control, side), unit, f"{path}.{side}") for side in ends}
        self._disturb(control, control.unit, target or "1", f"{path}.high")
        result = Control(kind=control.kind, **sides, substances=tuple(control.substances))
        self._spread(control, result.nominal, unit, path)
        most = extremes(result.nominal)[1]
        if (
            control.kind in (ControlKind.SHARE, ControlKind.TRANSFER)
            and control.range is None
            and path in self.uncertain
            and most > 0
        ):
            self.uncertain[path] = replace(self.uncertain[path], high=1 / most)  # no share is more than 1
        return result

    def _control_unit(self, control: Any, model: CompartmentModel | None) -> str | None:
        """Return the unit that values of a control are converted to; None if its model states none."""
        native_unit = control.unit if model is None else model.input_unit
        return {ControlKind.FLOW: self.targets["flow"], ControlKind.INPUT: native_unit}.get(control.kind, "1")

    def _number(self, quantity: Any, kind: str, path: str) -> float:
        value = self._value(quantity, kind, path)
        if isinstance(value, Series):
            self.mistakes.append(f"{path}: {CONSTANT}")
            return 1.0
        return value

    def _unit_of_product(self, quantity: Any, path: str) -> str:
        """Return the unit of a quantity times what it is multiplied by, if by anything."""
        multiplier = quantity.multiplied_by
        if multiplier is None:
            return str(quantity.unit)
        for key in UNCERTAINTY:
            if getattr(multiplier, key) is not None:
                self.mistakes.append(f"{path}.multiplied_by.{key}: belongs beside it, to the product")
        if multiplier.multiplied_by is not None:
            fault = "a quantity has one factor; multiply the others"
            self.mistakes.append(f"{path}.multiplied_by.multiplied_by: {fault}")
        return f"({quantity.unit})*({multiplier.unit})"

    def _value(self, quantity: Any, kind: str, path: str) -> Value:
        multiplier, name = quantity.multiplied_by, self._unit_of_product(quantity, path)
        unit = self._factor(name, kind, path)
        value = self._in_time(quantity, unit, path)
        self._spread(quantity, value, unit, path)
        self._disturb(quantity, name, kind, path)
        if multiplier is None:
            return value
        return product(value, self._in_time(multiplier, 1.0, f"{path}.multiplied_by"))

    def _spread(self, quantity: Any, value: Value, unit: float, path: str) -> None:
        """Note how a quantity spreads, if it does."""
        deviation, span = quantity.deviation, quantity.range
        relative = float(Decimal(deviation.rstrip("% ")) / 100) if isinstance(deviation, str) else None
        if deviation is None and span is None:
            if quantity.distribution is not None:
                self.mistakes.append(f"{path}.distribution: '{quantity.distribution}' needs a deviation or a range")
            return
        middle = float(np.mean(value.values)) if isinstance(value, Series) else float(value)
        if deviation is not None and relative is None:
            relative = deviation * unit / abs(middle) if middle else 0.0
        if middle == 0 or (relative is not None and relative <= 0):
            fault = f"deviation {deviation}" if middle else "the number is 0"
            self.mistakes.append(f"{path}: {fault}: what spreads must not be 0, and its deviation must be positive")
            return
        first, last = (0.0, math.inf) if span is None else (float(end * unit / middle) for end in span)
        low, high = (last, first) if middle < 0 and span is not None else (first, last)  # a revenue is a negative rate
        if low >= high or not low <= 1 <= high:
            demand = "contain the number" if low < high else "have its lower end first"
            self.mistakes.append(f"{path}.range: {list(span or ())} must {demand}, {middle / unit:g}")
            return
        if low < 0:
            self.mistakes.append(f"{path}.range: {list(span or ())} must not cross 0: a number keeps its sign")
            return
        kind = quantity.distribution or ("uniform" if deviation is None else "normal")
        self.uncertain[path] = Spread(deviation=relative, low=low, high=high, distribution=kind)

    def _disturb(self, quantity: Any, unit: str, kind: str, path: str) -> None:
        """Note what disturbs a quantity, if anything does."""
        name = quantity.disturbed_by
        if name is None:
            if quantity.disturbed_as is not None:
                fault = f"'{quantity.disturbed_as}' needs disturbed_by, a disturbance"
                self.mistakes.append(f"{path}.disturbed_as: {fault}")
            return
        adds, scale, own = quantity.disturbed_as == "summand", 1.0, self.table.disturbances.get(name)
        if adds and own is not None:
            scale = self._factor(own.unit, kind, f"{path}.disturbed_by: '{name}', which is added")
        elif own is not None and own.unit != "1":
            remedy = f"a factor has unit '1'; or write disturbed_as = \"summand\", which adds it to the {unit}"
            self.mistakes.append(f"{path}.disturbed_by: '{name}' has unit '{own.unit}': {remedy}")
        self.disturbed[path] = DisturbanceEffect(by=name, adds=adds, scale=scale)

    def _in_time(self, entry: float | QuantityTable | AmountSeries | AmountColumn, unit: float, path: str) -> Value:
        """Return a number, or one that changes in time, in the network's units, of which its own is ``unit``."""
        if isinstance(entry, QuantityTable):
            return entry.value * unit
        if not isinstance(entry, AmountSeries | AmountColumn):
            return entry * unit
        try:
            if isinstance(entry, AmountSeries):
                return inline_series(entry, unit, self.clock)
            texts = {key: self._with_region(text, f"{path}.where.{key}") for key, text in entry.where.items()}
            column = column_value(entry, texts, self.files, unit, self.clock)
        except CirlError as error:
            if str(error) not in self._file_errors or isinstance(entry, AmountSeries):
                self.mistakes.append(f"{path}: {error}")
            self._file_errors.add(str(error))  # a file that cannot be read is told once, not for each of its columns
            return math.nan
        self.data_files.add(entry.file)
        return column

    def _with_region(self, text: str, path: str) -> str:
        if REGION in text and not self.region:
            self.mistakes.append(f"{path}: '{text}': a definition without [regions] has no {REGION}")
        return text.replace(REGION, self.table.regions.get(self.region, ""))

    def _factor(self, unit: str, kind: str, path: str) -> float:
        """Return what converts ``unit`` to the network's unit of a kind, or to the unit ``kind`` if it is none."""
        if kind == "own":
            return 1.0
        if (unit, kind) not in self.factors:
            try:
                self.factors[unit, kind] = factor(unit, self.targets.get(kind, kind))
            except CirlError as error:
                self.mistakes.append(f"{path}: {error}" + (f"; {HINTS[kind]}" if kind in HINTS else ""))
                return 1.0
        return self.factors[unit, kind]
