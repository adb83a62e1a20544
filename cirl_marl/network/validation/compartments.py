"""What is wrong with single nodes and arcs of a network: laws, batches, controls and models."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from cirl_marl.errors import CirlError, unknown
from cirl_marl.network.compartment_model import CompartmentModel, OutflowModel, ReleasingModel, Vehicle
from cirl_marl.network.declarations import bound_problems, default_of
from cirl_marl.network.elements import LAW_FIELDS, MAX_STEPS, Arc, Compartment, Control, ControlKind, Law, Node
from cirl_marl.network.series import Series, extremes
from cirl_marl.network.specification import Specification
from cirl_marl.network.units import factor
from cirl_marl.network.validation.settings import is_whole
from cirl_marl.network.validation.stocks import share_problems

OWN = tuple(dict.fromkeys(name for taken in LAW_FIELDS.values() for name in taken))
"""Fields of arcs that only some laws take."""
SIDES = ("low", "neutral", "high")


def node_problems(network: Specification, node: Node) -> Iterator[str]:
    """Yield every mistake in a node, but for its stock and lifetime."""
    low, high = node.initial or (0.0, 0.0)
    if not (math.isfinite(low) and math.isfinite(high)) or low > high:
        yield f"node '{node.id}': initial range [{low}, {high}] is empty or not finite"
    elif low < 0 and network.episode.solver != "euler":
        yield f"node '{node.id}': initial stock {low} is negative"
    yield from _common_problems(f"node '{node.id}'", node, network)


def arc_problems(
    network: Specification, arc: Arc, nodes: Mapping[str, Node], everyone: Mapping[str, Compartment]
) -> Iterator[str]:
    """Yield every mistake in an arc."""
    where = f"arc '{arc.id}'"
    for end, node in (("from", arc.donor), ("to", arc.recipient)):
        if node not in nodes:
            yield f"{where}: {end}: {unknown('node', node, nodes)}"
    if arc.donor == arc.recipient:
        yield f"{where}: a cycle of zero delay: it returns to its own donor '{arc.donor}' without passing a stock"
    for name in OWN:
        given = getattr(arc, name)
        if name not in LAW_FIELDS[arc.law] and given != default_of(Arc, name):
            taken = ", ".join(LAW_FIELDS[arc.law]) or "none of these"
            yield f"{where}: {name} = {given!r}: law '{arc.law}' takes {taken}"
    if arc.law is Law.COMPARTMENT:
        ends = (arc.donor, arc.recipient, arc.id)
        giving = [end for end in ends if end in everyone and isinstance(everyone[end].model, OutflowModel)]
        if arc.by not in giving:
            yield f"{where}: by: {unknown('compartment at this arc whose model gives a flow', arc.by, giving)}"
    if arc.law is Law.BATCH and isinstance(arc.rate, Series):
        yield f"{where}: rate: the mass of a unit cannot change in time"
    elif arc.law is Law.BATCH:
        yield from _batch_problems(where, arc, network, nodes)
    if arc.law in (Law.DONOR, Law.RECIPIENT, Law.COMPARTMENT) and extremes(arc.rate)[1] == 0:
        yield f"{where}: law '{arc.law}' needs a positive rate"
    yield from share_problems(where, arc, nodes)
    if arc.control and arc.control.kind is ControlKind.FLOW and arc.law is not Law.CONTROLLED:
        yield f"{where}: control.kind 'flow' needs law 'controlled', not '{arc.law}'"
    if arc.control and arc.control.kind is ControlKind.RATE and arc.law is Law.CONTROLLED:
        yield f"{where}: law 'controlled' needs control.kind 'flow', not 'rate'"
    yield from _common_problems(where, arc, network)


def _batch_problems(where: str, arc: Arc, network: Specification, nodes: Mapping[str, Node]) -> Iterator[str]:
    interval = network.episode.control_interval
    vehicle = _has_vehicle(arc)
    if vehicle == (arc.delay != 0):
        yield f"{where}: law 'batch' needs a delay or a vehicle as its model, and not both"
    if vehicle and not arc.by:
        yield f"{where}: a vehicle carries what a compartment releases: it needs 'by', not a schedule"
    if arc.by and arc.batches:
        yield f"{where}: law 'batch' takes 'by' or a schedule of batches, not both"
    if not arc.by and (arc.rate or arc.port):
        yield f"{where}: a schedule of batches takes no rate and no port"
    times = [time for time, _ in arc.batches]
    if any(not (math.isfinite(value) and value >= 0) for pair in arc.batches for value in pair):
        yield f"{where}: times and masses of batches {arc.batches} must be finite and not negative"
        return
    if math.isfinite(interval) and interval > 0:  # anything else is a problem of its own
        for what, time in [("delay", arc.delay), *(("batch at", time) for time in times)]:
            if time < 0:
                yield f"{where}: {what} {time:g} must not be negative"
            elif what == "delay" and time / interval > MAX_STEPS:
                long = f"{time / interval:.6g} control intervals of {interval:g} {network.time_unit}"
                excess = f"{long}, more than {MAX_STEPS:,}. Is it in the wrong unit?"
                yield f"{where}: delay {time:g} {network.time_unit} is {excess}"
            elif not is_whole(time / interval) or (0 < time < interval / 2):
                yield f"{where}: {what} {time:g} is not a whole number of control intervals of {interval:g}"
    if arc.set_point is not None:
        yield f"{where}: law 'batch' takes no set_point"
    if arc.control is not None and arc.control.kind is ControlKind.RATE:
        yield f"{where}: law 'batch' takes no control of kind 'rate'"
    donor = nodes.get(arc.donor)
    if arc.by and donor is not None:
        ports = donor.model.ports if isinstance(donor.model, ReleasingModel) else ()
        if arc.by != donor.id or not ports:
            yield f"{where}: by: batches are released by the model of the donor '{donor.id}', which has ports {ports}"
        elif arc.port not in ports:
            yield f"{where}: {unknown('port', arc.port, ports)}"
        if extremes(arc.rate)[0] <= 0:
            yield f"{where}: law 'batch' with 'by' needs a positive rate, the mass per unit released"
        else:
            yield from _unit_problems(where, arc, network.mass_unit, donor)


def _unit_problems(where: str, arc: Arc, mass_unit: str, donor: Node) -> Iterator[str]:
    """Yield it if a model that knows the mass of what it releases knows another than its arc."""
    unit_kg = donor.model.unit_kg if isinstance(donor.model, ReleasingModel) else None
    try:
        carried_kg = extremes(arc.rate)[0] * factor(mass_unit, "kg")
    except CirlError:
        return  # a problem of its own
    if unit_kg is not None and not math.isclose(carried_kg, unit_kg):
        yield f"{where}: rate: {carried_kg:g} kg a unit, but '{donor.id}' releases units of {unit_kg:g} kg"


def _has_vehicle(arc: Arc) -> bool:
    return arc.law is Law.BATCH and isinstance(arc.model, Vehicle)


def _common_problems(where: str, compartment: Compartment, network: Specification) -> Iterator[str]:
    yield from bound_problems(compartment, f"{where}: ")
    states = compartment.model.ranged_states if compartment.model is not None else ()
    if len(compartment.inner) != len(states):
        yield f"{where}: {len(compartment.inner)} initial ranges for the inner states {list(states)}"
    for low, high in compartment.inner:
        if not (math.isfinite(low) and math.isfinite(high)) or low > high:
            yield f"{where}: initial range [{low}, {high}] of an inner state is empty or not finite"
    if compartment.model is not None:
        yield from _model_problems(where, compartment, compartment.model)
    if compartment.control is not None:
        yield from _control_problems(where, compartment, compartment.control, network)


def _control_problems(where: str, compartment: Compartment, control: Control, network: Specification) -> Iterator[str]:
    if control.kind is ControlKind.INPUT and not (compartment.model and compartment.model.input_names):
        yield f"{where}: control.kind 'input' needs a model with inputs"
    unit = f" {network.mass_unit}/{network.time_unit}" if control.kind is ControlKind.FLOW else ""
    low, neutral, high = (
        np.array(network.interval_means(each)) for each in (control.low, control.neutral, control.high)
    )
    if not np.isfinite([low, neutral, high]).all():
        yield f"{where}: control bounds must be finite"
    elif not ((low <= neutral) & (neutral <= high)).all() or control.low == control.high:
        worst = int(np.argmax((low > neutral) | (neutral > high)))
        given = f"{low[worst]:g}, {neutral[worst]:g}, {high[worst]:g}{unit}"
        when = f" in interval {worst}" if any(isinstance(getattr(control, side), Series) for side in SIDES) else ""
        yield f"{where}: control needs low <= neutral <= high and low < high, got {given}{when}"
    elif control.kind is ControlKind.FLOW and low.min() < 0 and network.episode.solver != "euler":
        yield f"{where}: control.low {low.min():g}{unit} would reverse the flow; use a second arc"
    elif control.kind is ControlKind.RATE and low.min() < 0:
        yield f"{where}: control.low {low.min():g} is negative; a valve cannot reverse a flow"
    elif control.kind is ControlKind.STRETCH and low.min() <= 0:
        yield f"{where}: control.low {low.min():g}: a stretch is above 0"
    elif control.kind is ControlKind.SHARE and (low.min() < 0 or high.max() > 1):
        yield f"{where}: control: shares lie in [0, 1], got [{low.min():g}, {high.max():g}]"
    if control.kind is ControlKind.SHARE and not isinstance(compartment, Arc):
        yield f"{where}: control.kind 'share' belongs on an arc of law 'share'"
    if control.kind is ControlKind.STRETCH and not isinstance(compartment, Node):
        yield f"{where}: control.kind 'stretch' belongs on a node with a lifetime"


def _model_problems(where: str, compartment: Compartment, model: CompartmentModel) -> Iterator[str]:
    """Yield what a model asks for that it is not given, and starts and controls beyond what its equations hold for."""
    where, control, inputs = f"{where}: model '{model.kind}'", compartment.control, model.input_names
    if inputs and (control is None or control.kind is not ControlKind.INPUT):
        given = control.kind if control else "none"
        yield f"{where} needs a control of kind 'input' for {', '.join(inputs)}, not {given}"
    carried = ("load_kg",) if isinstance(compartment, Arc) and _has_vehicle(compartment) else ()
    told = ("stock_kg",) if isinstance(compartment, Node) else carried
    for name in model.context_names:
        if name not in told:
            yield f"{where}: context_names: {unknown('quantity told to this model', name, told)}"
    states = model.ranged_states
    ranges = dict(zip(states, compartment.inner, strict=True)) if len(states) == len(compartment.inner) else {}
    if control is not None:
        ranges |= dict.fromkeys(inputs, (extremes(control.low)[0], extremes(control.high)[1]))
    for name, (low, high) in model.bounds.items():
        if name in ranges and not (low <= ranges[name][0] and ranges[name][1] <= high):
            given = f"[{ranges[name][0]:g}, {ranges[name][1]:g}]"
            yield f"{where} holds for {name} in [{low:g}, {high:g}], not for {given}"


def port_problems(network: Specification) -> Iterator[str]:
    """Yield ports of models that have two arcs, or none."""
    carrying: dict[tuple[str, str], str] = {}
    for arc in network.arcs:
        if arc.law is Law.BATCH and arc.by:
            first = carrying.setdefault((arc.by, arc.port), arc.id)
            if first != arc.id:
                yield f"arc '{arc.id}': port '{arc.port}' of '{arc.by}' has the arc '{first}' already"
    for node in network.nodes:
        for port in node.model.ports if isinstance(node.model, ReleasingModel) else ():
            if (node.id, port) not in carrying:
                remedy = f"give it an arc of law 'batch' with by = '{node.id}' and port = '{port}'"
                yield f"node '{node.id}': what its model releases to port '{port}' would stay; {remedy}"
