"""From a ``Network`` built in Python to the text of a definition file."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import math
from collections.abc import Iterator
from typing import Any

from cirl_marl.compartments import kind_of
from cirl_marl.errors import NetworkError
from cirl_marl.network import Network
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Law, Node

SOURCE = "network built in Python"


def definition_of(network: Network) -> str:
    """Return a TOML definition that reads back as ``network``, its numbers equal to the last bit.

    Raises:
        NetworkError: if a model has parameters other than numbers and its form.
    """
    return "\n".join(_lines(network)) + "\n"


def fingerprint(network: Network) -> str:
    """Return a hash of the network under its scenario, of its definition with every default, its name as the title."""
    return hashlib.sha256(definition_of(dataclasses.replace(network, title=network.name)).encode()).hexdigest()


def _lines(network: Network) -> Iterator[str]:
    mass, time = network.mass_unit, network.time_unit
    episode, objective = network.episode, network.objective
    yield f"name = {_text(network.name)}"
    yield f"title = {_text(network.title)}"
    yield 'material = "not stated"'
    yield f"agents = {_list(network.acting)}"
    if not network.arcs:
        yield "arcs = {}"
    yield f"[units]\nmass = {_text(mass)}\ntime = {_text(time)}"
    yield f"[scales]\nstock = {_quantity(1.0, mass)}\nflow = {_quantity(1.0, _flow(network))}"
    yield f"[episode]\nsolver = {_text(episode.solver)}"
    yield f"control_interval = {_quantity(episode.control_interval, time)}"
    yield f"horizon = {_quantity(episode.horizon, '1')}"
    if episode.solver_step is not None:
        yield f"solver_step = {_quantity(episode.solver_step, time)}"
    yield f"[objective]\nnet_zero = {_text(objective.net_zero)}\nreward = {_text(objective.reward)}"
    yield f"reference_interval = {_quantity(objective.reference_interval, time)}"
    yield f"circularity_scale = {_quantity(objective.circularity_scale, mass)}"
    yield f"circularity_weight = {_quantity(objective.circularity_weight, '1')}"
    yield f"tracked = {_list(objective.tracked)}"
    if objective.criticality is not None:
        yield f"criticality = {_quantity(objective.criticality, '1')}"
    yield f"[observation]\nmode = {_text(network.observation.mode)}\nnodes = {_list(network.observation.nodes)}"
    for node in network.nodes:
        yield from _node(network, node)
    for arc in network.arcs:
        yield from _arc(network, arc)
    for service in network.services:
        unit = {"stock": mass, "measure": "1"}.get(service.quantity, _flow(network))
        yield f"[services.{service.id}]\nprovider = {_text(service.provider)}\nquantity = {_text(service.quantity)}"
        yield f"owed_by = {_list(service.owed_by)}\nmeasure = {_text(service.measure)}"
        yield f"low = {_quantity(service.low, unit)}\nweight = {_quantity(service.weight, '1')}"
        if math.isfinite(service.high):
            yield f"high = {_quantity(service.high, unit)}"


def _node(network: Network, node: Node) -> Iterator[str]:
    low, high = node.initial
    unit = _text(network.mass_unit)
    yield f"[nodes.{node.id}]\nrole = {_text(node.role.value)}"
    yield f"initial = {{ low = {float(low)!r}, high = {float(high)!r}, unit = {unit}, source = {_text(SOURCE)} }}"
    yield from _common(network, node, network.mass_unit)


def _arc(network: Network, arc: Arc) -> Iterator[str]:
    flow = _flow(network)
    yield f"[arcs.{arc.id}]\nfrom = {_text(arc.donor)}\nto = {_text(arc.recipient)}\nlaw = {_text(arc.law.value)}"
    yield f"pollutant = {json.dumps(arc.pollutant)}"
    if arc.law is Law.COMPARTMENT:
        yield f"by = {_text(arc.by)}\nrate = {_quantity(arc.rate, _flow(network))}"
    elif arc.law is Law.BATCH:
        yield from _batch(network, arc)
    elif arc.law in (Law.DONOR, Law.RECIPIENT):
        yield f"rate = {_quantity(arc.rate, f'1/({network.time_unit})')}"
    elif arc.law is Law.EXOGENOUS and not arc.times:
        yield f"flow = {_quantity(arc.flow[0], flow)}"
    elif arc.law is Law.EXOGENOUS:
        times, values = list(map(float, arc.times)), list(map(float, arc.flow))
        yield (
            f"series = {{ times = {times!r}, time_unit = {_text(network.time_unit)}, values = {values!r}, "
            f"unit = {_text(flow)}, source = {_text(SOURCE)} }}"
        )
    yield from _common(network, arc, network.mass_unit if arc.law is Law.BATCH else flow)


def _batch(network: Network, arc: Arc) -> Iterator[str]:
    if arc.by:
        yield f"by = {_text(arc.by)}\nport = {_text(arc.port)}\nrate = {_quantity(arc.rate, network.mass_unit)}"
    else:
        times, masses = [float(time) for time, _ in arc.batches], [float(mass) for _, mass in arc.batches]
        yield (
            f"batches = {{ times = {times!r}, time_unit = {_text(network.time_unit)}, masses = {masses!r}, "
            f"unit = {_text(network.mass_unit)}, source = {_text(SOURCE)} }}"
        )
    if arc.delay:
        yield f"delay = {_quantity(arc.delay, network.time_unit)}"


def _common(network: Network, compartment: Compartment, unit: str) -> Iterator[str]:
    yield f"scale = {_quantity(compartment.scale, unit)}"
    if compartment.set_point is not None:
        yield f"set_point = {_quantity(compartment.set_point, unit)}"
    if compartment.model is not None:
        yield f"model = {_model(compartment)}"
    if compartment.control is not None:
        yield f"control = {_control(network, compartment)}"


def _control(network: Network, compartment: Compartment) -> str:
    control = compartment.control
    assert control is not None
    unit = _flow(network) if control.kind is ControlKind.FLOW else "1"
    if control.kind is ControlKind.INPUT and compartment.model is not None:
        unit = compartment.model.input_unit or "1"
    return (
        f"{{ kind = {_text(control.kind.value)}, low = {float(control.low)!r}, neutral = {float(control.neutral)!r}, "
        f"high = {float(control.high)!r}, unit = {_text(unit)}, source = {_text(SOURCE)} }}"
    )


def _model(compartment: Compartment) -> str:
    model: Any = compartment.model
    values = {each.name: getattr(model, each.name) for each in dataclasses.fields(model)}
    same = [each.name for each in dataclasses.fields(model) if _is_default(each, values[each.name])]
    form = f"form = {_text(values.pop('form'))}, " if "form" in values else ""
    for name, value in values.items():
        if not isinstance(value, int | float) and name not in same:
            problem = f"parameter '{name}' of its model '{model.kind}' is no number, which a definition cannot say"
            raise NetworkError(f"compartment '{compartment.id}'", [problem])
    numbers = {name: value for name, value in values.items() if isinstance(value, int | float)}
    parameters = ", ".join(
        f"{name} = {str(value).lower() if isinstance(value, bool) else repr(float(value))}"
        for name, value in numbers.items()
    )
    initial = ", ".join(
        f"{name} = {{ low = {float(low)!r}, high = {float(high)!r}, source = {_text(SOURCE)} }}"
        for name, (low, high) in zip(model.ranged_states, compartment.inner, strict=True)
    )
    scale = _quantity(compartment.reward_scale, "1")
    return (
        f"{{ kind = {_text(kind_of(model))}, {form}parameters = {{ {parameters} }}, source = {_text(SOURCE)}, "
        f"initial = {{ {initial} }}, reward_scale = {scale} }}"
    )


def _is_default(field: dataclasses.Field[Any], value: object) -> bool:
    if field.default_factory is not dataclasses.MISSING:
        return bool(field.default_factory() == value)
    return bool(field.default == value)


def _flow(network: Network) -> str:
    return f"({network.mass_unit})/({network.time_unit})"


def _quantity(value: float, unit: str) -> str:
    return f"{{ value = {float(value)!r}, unit = {_text(unit)}, source = {_text(SOURCE)} }}"


def _list(names: tuple[str, ...]) -> str:
    return json.dumps(list(names))


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False)
