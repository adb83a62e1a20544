"""What is wrong with single nodes and arcs of a network: laws, batches, controls and models."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

import numpy as np

from cirl_marl.errors import CirlError, unknown_name, unknown_names
from cirl_marl.network.compartment_model import CompartmentModel, OutflowModel, ReleasingModel, Vehicle
from cirl_marl.network.declarations import LARGEST, SMALLEST, bound_problems, default_of
from cirl_marl.network.elements import (
    LAW_FIELDS,
    MAX_STEPS,
    Arc,
    Compartment,
    Control,
    ControlKind,
    FeedbackRule,
    Law,
    Node,
)
from cirl_marl.network.series import Series, extremes
from cirl_marl.network.specification import Specification
from cirl_marl.network.units import factor
from cirl_marl.network.validation.settings import is_whole
from cirl_marl.network.validation.stocks import share_problems

SPECIAL_FIELDS = tuple(dict.fromkeys(name for names in LAW_FIELDS.values() for name in names))
"""Fields of arcs that only some laws take."""
SIDES = ("low", "neutral", "high")


def node_problems(network: Specification, node: Node) -> Iterator[str]:
    """Yield every mistake in a node, but for its stock and lifetime."""
    low, high = node.initial or (0.0, 0.0)
    if not -LARGEST <= low <= high <= LARGEST:
        yield f"node '{node.id}': initial range [{low}, {high}] is empty or not finite, or beyond {LARGEST:g}"
    elif low < 0 and network.episode.solver != "euler":
        yield f"node '{node.id}': initial stock {low} is negative"
    yield from _common_problems(f"node '{node.id}'", node, network)


def arc_problems(
    network: Specification, arc: Arc, nodes: Mapping[str, Node], compartments: Mapping[str, Compartment]
) -> Iterator[str]:
    """Yield every mistake in an arc."""
    subject = f"arc '{arc.id}'"
    for end, node in (("from", arc.donor), ("to", arc.recipient)):
        if node not in nodes:
            yield f"{subject}: {end}: {unknown_name('node', node, nodes)}"
    if arc.donor == arc.recipient:
        yield f"{subject}: a cycle of zero delay: it returns to its own donor '{arc.donor}' without passing a stock"
    for name in SPECIAL_FIELDS:
        number = getattr(arc, name)
        if name not in LAW_FIELDS[arc.law] and number != default_of(Arc, name):
            fields = ", ".join(LAW_FIELDS[arc.law]) or "none of these"
            yield f"{subject}: {name} = {number!r}: law '{arc.law}' takes {fields}"
    if arc.law is Law.COMPARTMENT:
        ends = (arc.donor, arc.recipient, arc.id)
        sources = [end for end in ends if end in compartments and isinstance(compartments[end].model, OutflowModel)]
        if arc.by not in sources:
            yield f"{subject}: by: {unknown_name('compartment at this arc whose model gives a flow', arc.by, sources)}"
    if arc.law is Law.BATCH and isinstance(arc.rate, Series):
        yield f"{subject}: rate: the mass of a unit cannot change in time"
    elif arc.law is Law.BATCH:
        yield from _batch_problems(subject, arc, network, nodes)
    if arc.law in (Law.DONOR, Law.RECIPIENT, Law.COMPARTMENT) and arc.rate == 0:  # a series may have stood still
        yield f"{subject}: law '{arc.law}' needs a positive rate"
    yield from share_problems(subject, arc, nodes)
    if arc.capacity_node or arc.capacity_rate:
        yield from _capacity_problems(subject, arc, nodes)
    if arc.control and arc.control.kind is ControlKind.FLOW and arc.law is not Law.CONTROLLED:
        yield f"{subject}: control.kind 'flow' needs law 'controlled', not '{arc.law}'"
    if arc.control and arc.control.kind is ControlKind.RATE and arc.law is Law.CONTROLLED:
        yield f"{subject}: law 'controlled' needs control.kind 'flow', not 'rate'"
    yield from _common_problems(subject, arc, network)


def _capacity_problems(subject: str, arc: Arc, nodes: Mapping[str, Node]) -> Iterator[str]:
    """Yield why a stock cannot limit what an arc carries."""
    holders = [node.id for node in nodes.values() if node.stores]
    if not arc.capacity_node:
        yield f"{subject}: capacity_rate: no stock limits it; name its node, capacity_node"
    elif arc.capacity_node not in holders:
        yield f"{subject}: capacity_node: {unknown_name('node with a stock', arc.capacity_node, holders)}"
    if arc.capacity_node and extremes(arc.capacity_rate)[1] == 0:
        yield f"{subject}: capacity_node: it needs a capacity_rate above 0, the flow that a unit of the stock can carry"
    if arc.law is not Law.CONTROLLED:
        reason = "what a proportion of a stock may carry would not be linear in stocks"
        if arc.law is Law.BATCH:
            reason = "a batch leaves at once, and no flow could be held below a capacity"
        yield f"{subject}: capacity_node needs law 'controlled', not '{arc.law}': {reason}"
    elif arc.makes_up_for:
        yield f"{subject}: capacity_node: what makes up for a service has the bounds of its control; leave out one"


def _batch_problems(subject: str, arc: Arc, network: Specification, nodes: Mapping[str, Node]) -> Iterator[str]:
    interval = network.episode.control_interval
    vehicle = _has_vehicle(arc)
    if vehicle == (arc.delay != 0):
        yield f"{subject}: law 'batch' needs a delay or a vehicle as its model, and not both"
    if vehicle and not arc.by:
        yield f"{subject}: a vehicle carries what a compartment releases: it needs 'by', not a schedule"
    if arc.by and arc.batches:
        yield f"{subject}: law 'batch' takes 'by' or a schedule of batches, not both"
    if not arc.by and (arc.rate or arc.port):
        yield f"{subject}: a schedule of batches takes no rate and no port"
    times = [time for time, _ in arc.batches]
    if any(not 0 <= value <= LARGEST for pair in arc.batches for value in pair):
        yield f"{subject}: times and masses of batches {arc.batches} must lie in [0, {LARGEST:g}]"
        return
    if math.isfinite(interval) and interval > 0:  # anything else is a problem of its own
        for label, time in [("delay", arc.delay), *(("batch at", time) for time in times)]:
            if time < 0:
                yield f"{subject}: {label} {time:g} must not be negative"
            elif label == "delay" and time / interval > MAX_STEPS:
                long = f"{time / interval:.6g} control intervals of {interval:g} {network.time_unit}"
                excess = f"{long}, more than {MAX_STEPS:,}. Is it in the wrong unit?"
                yield f"{subject}: delay {time:g} {network.time_unit} is {excess}"
            elif not is_whole(time / interval) or (0 < time < interval / 2):
                yield f"{subject}: {label} {time:g} is not a whole number of control intervals of {interval:g}"
    if arc.set_point is not None:
        yield f"{subject}: law 'batch' takes no set_point"
    if arc.control is not None and arc.control.kind is ControlKind.RATE:
        yield f"{subject}: law 'batch' takes no control of kind 'rate'"
    donor = nodes.get(arc.donor)
    if arc.by and donor is not None:
        ports = donor.model.ports if isinstance(donor.model, ReleasingModel) else ()
        if arc.by != donor.id or not ports:
            yield f"{subject}: by: batches are released by the model of the donor '{donor.id}', which has ports {ports}"
        elif arc.port not in ports:
            yield f"{subject}: {unknown_name('port', arc.port, ports)}"
        if extremes(arc.rate)[0] <= 0:
            yield f"{subject}: law 'batch' with 'by' needs a positive rate, the mass per unit released"
        else:
            yield from _unit_problems(subject, arc, network.mass_unit, donor)


def _unit_problems(subject: str, arc: Arc, mass_unit: str, donor: Node) -> Iterator[str]:
    """Yield it if a model that knows the mass of what it releases knows another than its arc."""
    unit_kg = donor.model.unit_kg if isinstance(donor.model, ReleasingModel) else None
    try:
        carried_kg = extremes(arc.rate)[0] * factor(mass_unit, "kg")
    except CirlError:
        return  # a problem of its own
    if unit_kg is not None and not math.isclose(carried_kg, unit_kg):
        yield f"{subject}: rate: {carried_kg:g} kg a unit, but '{donor.id}' releases units of {unit_kg:g} kg"


def _has_vehicle(arc: Arc) -> bool:
    return arc.law is Law.BATCH and isinstance(arc.model, Vehicle)


def _common_problems(subject: str, compartment: Compartment, network: Specification) -> Iterator[str]:
    yield from bound_problems(compartment, f"{subject}: ")
    states = compartment.model.ranged_states if compartment.model is not None else ()
    if len(compartment.inner) != len(states):
        yield f"{subject}: {len(compartment.inner)} initial ranges for the inner states {list(states)}"
    for low, high in compartment.inner:
        if not -LARGEST <= low <= high <= LARGEST:
            fault = f"is empty or not finite, or beyond {LARGEST:g}"
            yield f"{subject}: initial range [{low}, {high}] of an inner state {fault}"
    if compartment.model is not None:
        yield from _model_problems(subject, compartment, compartment.model)
    if compartment.control is not None:
        yield from _control_problems(subject, compartment, compartment.control, network)
    if compartment.rule is not None:
        yield from _rule_problems(f"{subject}: rule", compartment, compartment.rule, network)


def _rule_problems(subject: str, compartment: Compartment, rule: FeedbackRule, network: Specification) -> Iterator[str]:
    if compartment.control is None or compartment.control.kind is ControlKind.INPUT:
        yield f"{subject}: needs a control that is no input of a model"
    yield from bound_problems(rule, f"{subject}: ")
    aims = [node.id for node in network.nodes if node.stores and node.set_point]
    aims += [service.id for service in network.services]
    disturbing = {disturbed.by for disturbed in network.disturbed.values()}
    names = [name for name in network.disturbances if name in disturbing]
    for key, options, what in (("follows", names, "disturbance that disturbs something"), ("watches", aims, "aim")):
        yield from unknown_names(what, getattr(rule, key), options, f"{subject}.{key}: ")
    if len(rule.gains) != len(rule.watches):
        yield f"{subject}: needs a gain for each of what it watches, got {len(rule.gains)} for {len(rule.watches)}"


def _control_problems(
    subject: str, compartment: Compartment, control: Control, network: Specification
) -> Iterator[str]:
    if control.kind is ControlKind.INPUT and not (compartment.model and compartment.model.input_names):
        yield f"{subject}: control.kind 'input' needs a model with inputs"
    unit = f" {network.mass_unit}/{network.time_unit}" if control.kind is ControlKind.FLOW else ""
    low, neutral, high = (
        np.array(network.interval_means(bound)) for bound in (control.low, control.neutral, control.high)
    )
    sizes = np.abs([low, neutral, high])
    if not ((sizes == 0) | (sizes >= SMALLEST) & (sizes <= LARGEST)).all():
        yield f"{subject}: control bounds must be 0, or between {SMALLEST:g} and {LARGEST:g} in size"
    elif not ((low <= neutral) & (neutral <= high)).all() or control.low == control.high:
        worst = int(np.argmax((low > neutral) | (neutral > high)))
        bounds = f"{low[worst]:g}, {neutral[worst]:g}, {high[worst]:g}{unit}"
        interval = f" in interval {worst}" if any(isinstance(getattr(control, side), Series) for side in SIDES) else ""
        yield f"{subject}: control needs low <= neutral <= high and low < high, got {bounds}{interval}"
    elif control.kind is ControlKind.FLOW and low.min() < 0 and network.episode.solver != "euler":
        yield f"{subject}: control.low {low.min():g}{unit} would reverse the flow; use a second arc"
    elif control.kind is ControlKind.RATE and low.min() < 0:
        yield f"{subject}: control.low {low.min():g} is negative; a valve cannot reverse a flow"
    elif control.kind is ControlKind.STRETCH and low.min() <= 0:
        yield f"{subject}: control.low {low.min():g}: a stretch is above 0"
    elif control.kind in (ControlKind.SHARE, ControlKind.TRANSFER) and (low.min() < 0 or high.max() > 1):
        yield f"{subject}: control: shares lie in [0, 1], got [{low.min():g}, {high.max():g}]"
    if control.kind in (ControlKind.SHARE, ControlKind.TRANSFER) and not isinstance(compartment, Arc):
        yield f"{subject}: control.kind '{control.kind}' belongs on an arc of law 'share'"
    if control.kind is ControlKind.STRETCH and not isinstance(compartment, Node):
        yield f"{subject}: control.kind 'stretch' belongs on a node with a lifetime"


def _model_problems(subject: str, compartment: Compartment, model: CompartmentModel) -> Iterator[str]:
    """Yield what a model asks for that it is not given, and starts and controls beyond what its equations hold for."""
    subject, control, inputs = f"{subject}: model '{model.kind}'", compartment.control, model.input_names
    if inputs and (control is None or control.kind is not ControlKind.INPUT):
        range_ = control.kind if control else "none"
        yield f"{subject} needs a control of kind 'input' for {', '.join(inputs)}, not {range_}"
    vehicle_quantities = ("load_kg",) if isinstance(compartment, Arc) and _has_vehicle(compartment) else ()
    quantities = ("stock_kg",) if isinstance(compartment, Node) else vehicle_quantities
    yield from unknown_names(
        "quantity told to this model", model.context_names, quantities, f"{subject}: context_names: "
    )
    states = model.ranged_states
    ranges = dict(zip(states, compartment.inner, strict=True)) if len(states) == len(compartment.inner) else {}
    if control is not None:
        ranges |= dict.fromkeys(inputs, (extremes(control.low)[0], extremes(control.high)[1]))
    for name, (low, high) in model.bounds.items():
        if name in ranges and not (low <= ranges[name][0] and ranges[name][1] <= high):
            range_ = f"[{ranges[name][0]:g}, {ranges[name][1]:g}]"
            yield f"{subject} holds for {name} in [{low:g}, {high:g}], not for {range_}"


def port_problems(network: Specification) -> Iterator[str]:
    """Yield ports of models that have two arcs, or none."""
    arc_of_port: dict[tuple[str, str], str] = {}
    for arc in network.arcs:
        if arc.law is Law.BATCH and arc.by:
            first = arc_of_port.setdefault((arc.by, arc.port), arc.id)
            if first != arc.id:
                yield f"arc '{arc.id}': port '{arc.port}' of '{arc.by}' has the arc '{first}' already"
    for node in network.nodes:
        for port in node.model.ports if isinstance(node.model, ReleasingModel) else ():
            if (node.id, port) not in arc_of_port:
                remedy = f"give it an arc of law 'batch' with by = '{node.id}' and port = '{port}'"
                yield f"node '{node.id}': what its model releases to port '{port}' would stay; {remedy}"
