"""Every reason why a network cannot be simulated, so that a definition is mended in one go."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Iterator, Mapping

import numpy as np

from cirl_marl.errors import CirlError, unknown
from cirl_marl.network.declared import bound_problems, default_of
from cirl_marl.network.elements import MAX_STEPS, TAKEN, Arc, Compartment, Control, ControlKind, Law, Node
from cirl_marl.network.model import CompartmentModel, Outflowing, Releasing, Vehicle, model_faults
from cirl_marl.network.parts import Parts
from cirl_marl.network.series import Series, extremes
from cirl_marl.network.splits import splits, trap_problems
from cirl_marl.network.uncertainty import uncertainty_problems
from cirl_marl.network.units import factor
from cirl_marl.network.validate_lifetimes import lifetime_problems
from cirl_marl.network.validate_settings import (
    calendar_problems,
    is_whole,
    repeated,
    service_problems,
    setting_problems,
)
from cirl_marl.network.validate_storage import series_problems, share_problems, storage_problems
from cirl_marl.network.validate_supply import supply_problems

IDENTIFIER = r"^[a-z][a-z0-9_]*$"
"""How compartments and services may be called; their names are keys of definition files and names of files."""

OWN = tuple(dict.fromkeys(name for taken in TAKEN.values() for name in taken))
"""Fields of arcs that only some laws take."""


SIDES = ("low", "neutral", "high")


def problems(network: Parts) -> Iterator[str]:
    """Yield every reason why ``network`` cannot be simulated."""
    if not re.fullmatch(IDENTIFIER, network.name):
        yield f"name '{network.name}': begins with a letter and has lower-case letters, digits and underscores only"
    for key, unit, base in (("mass", network.mass_unit, "kg"), ("time", network.time_unit, "s")):
        try:
            factor(unit, base)
        except CirlError as error:
            yield f"units.{key}: {error}"
    if not network.nodes:
        yield "nodes: a network needs at least one"
    kinds = [(c.id, type(c.model)) for c in (*network.nodes, *network.arcs) if c.model is not None]
    timeless = [*bound_problems(network.episode), *calendar_problems(network)] or [*series_problems(network)]
    yield from timeless
    if timeless:
        return  # without a clock, or with such series, there are no values to look at
    strange = [f"'{id_}': model {kind.__name__}: {fault}" for id_, kind in kinds for fault in model_faults(kind)]
    yield from strange
    if strange:
        return  # such models cannot be asked for more
    yield from _name_problems([*(("node", n.id) for n in network.nodes), *(("arc", a.id) for a in network.arcs)])
    yield from _name_problems([("service", service.id) for service in network.services])
    nodes = {node.id: node for node in network.nodes}
    everyone = {c.id: c for c in (*network.nodes, *network.arcs)}
    outflows: dict[str, list[Arc]] = {}
    inflows: dict[str, list[Arc]] = {}
    for arc in network.arcs:
        outflows.setdefault(arc.donor, []).append(arc)
        inflows.setdefault(arc.recipient, []).append(arc)
    for node in network.nodes:
        yield from _node_problems(network, node)
        yield from storage_problems(node, outflows.get(node.id, ()))
        yield from lifetime_problems(network, node, [*inflows.get(node.id, ()), *outflows.get(node.id, ())])
    lawful = True
    for arc in network.arcs:
        found = list(_arc_problems(network, arc, nodes, everyone))
        yield from found
        lawful = lawful and not found
    for node in network.nodes:
        controlled = [arc for arc in outflows.get(node.id, ()) if arc.law is Law.CONTROLLED]
        if node.control and node.control.kind is ControlKind.FLOW and len(controlled) != 1:
            yield f"node '{node.id}': control.kind 'flow' needs one controlled outflow, it has {len(controlled)}"
        for arc in controlled:
            setting = sum(c.control is not None and c.control.kind is ControlKind.FLOW for c in (node, arc))
            if setting != 1:
                where = f"on the arc or on its donor '{node.id}'; it has {setting}"
                yield f"arc '{arc.id}': a controlled flow needs one control of kind 'flow', {where}"
    if lawful:
        divided = splits(network)
        crooked = [problem for each in divided for problem in each.problems()]
        yield from crooked or trap_problems(network, divided)
    yield from _port_problems(network)
    yield from service_problems(network)
    yield from supply_problems(network)
    yield from setting_problems(network)
    yield from uncertainty_problems(network)
    acting = dict.fromkeys(c.id for c in (*network.nodes, *network.arcs) if c.control is not None)
    for agent in network.acting:
        if agent in everyone and agent not in acting:
            yield f"agents: '{agent}' has no control, so that it cannot act"
        elif agent not in acting:
            yield f"agents: {unknown('agent', agent, acting)}"
    yield from repeated("agents", network.acting)


def _port_problems(network: Parts) -> Iterator[str]:
    """Yield ports of models that have two arcs, or none."""
    carrying: dict[tuple[str, str], str] = {}
    for arc in network.arcs:
        if arc.law is Law.BATCH and arc.by:
            first = carrying.setdefault((arc.by, arc.port), arc.id)
            if first != arc.id:
                yield f"arc '{arc.id}': port '{arc.port}' of '{arc.by}' has the arc '{first}' already"
    for node in network.nodes:
        for port in node.model.ports if isinstance(node.model, Releasing) else ():
            if (node.id, port) not in carrying:
                remedy = f"give it an arc of law 'batch' with by = '{node.id}' and port = '{port}'"
                yield f"node '{node.id}': what its model releases to port '{port}' would stay; {remedy}"


def _name_problems(named: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield ids that are none, and those used twice, of what shares one set of names, given as (kind, id)."""
    kinds: dict[str, list[str]] = {}
    for kind, id_ in named:
        kinds.setdefault(id_, []).append(kind)
    for id_, users in kinds.items():
        who = f"{' and '.join(dict.fromkeys(users))} '{id_}'"
        if not re.fullmatch(IDENTIFIER, id_):
            yield f"{who}: an id begins with a letter and has lower-case letters, digits and underscores only"
        if len(users) > 1:
            shared = "; nodes and arcs share one set of names" if len(set(users)) > 1 else ""
            yield f"{who}: the id is used twice{shared}"


def _node_problems(network: Parts, node: Node) -> Iterator[str]:
    low, high = node.initial or (0.0, 0.0)
    if not (math.isfinite(low) and math.isfinite(high)) or low > high:
        yield f"node '{node.id}': initial range [{low}, {high}] is empty or not finite"
    elif low < 0 and network.episode.solver != "euler":
        yield f"node '{node.id}': initial stock {low} is negative"
    yield from _common_problems(f"node '{node.id}'", node, network)


def _arc_problems(
    network: Parts, arc: Arc, nodes: Mapping[str, Node], everyone: Mapping[str, Compartment]
) -> Iterator[str]:
    where = f"arc '{arc.id}'"
    for end, node in (("from", arc.donor), ("to", arc.recipient)):
        if node not in nodes:
            yield f"{where}: {end}: {unknown('node', node, nodes)}"
    if arc.donor == arc.recipient:
        yield f"{where}: a cycle of zero delay: it returns to its own donor '{arc.donor}' without passing a stock"
    for name in OWN:
        given = getattr(arc, name)
        if name not in TAKEN[arc.law] and given != default_of(Arc, name):
            taken = ", ".join(TAKEN[arc.law]) or "none of these"
            yield f"{where}: {name} = {given!r}: law '{arc.law}' takes {taken}"
    if arc.law is Law.COMPARTMENT:
        ends = (arc.donor, arc.recipient, arc.id)
        giving = [end for end in ends if end in everyone and isinstance(everyone[end].model, Outflowing)]
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


def _batch_problems(where: str, arc: Arc, network: Parts, nodes: Mapping[str, Node]) -> Iterator[str]:
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
        ports = donor.model.ports if isinstance(donor.model, Releasing) else ()
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
    unit_kg = donor.model.unit_kg if isinstance(donor.model, Releasing) else None
    try:
        carried_kg = extremes(arc.rate)[0] * factor(mass_unit, "kg")
    except CirlError:
        return  # a problem of its own
    if unit_kg is not None and not math.isclose(carried_kg, unit_kg):
        yield f"{where}: rate: {carried_kg:g} kg a unit, but '{donor.id}' releases units of {unit_kg:g} kg"


def _has_vehicle(arc: Arc) -> bool:
    return arc.law is Law.BATCH and isinstance(arc.model, Vehicle)


def _common_problems(where: str, compartment: Compartment, network: Parts) -> Iterator[str]:
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


def _control_problems(where: str, compartment: Compartment, control: Control, network: Parts) -> Iterator[str]:
    if control.kind is ControlKind.INPUT and not (compartment.model and compartment.model.input_names):
        yield f"{where}: control.kind 'input' needs a model with inputs"
    unit = f" {network.mass_unit}/{network.time_unit}" if control.kind is ControlKind.FLOW else ""
    low, neutral, high = (np.array(network.held(each)) for each in (control.low, control.neutral, control.high))
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
