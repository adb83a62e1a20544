"""Every reason why a network cannot be simulated, so that a definition is mended in one go."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator

from cirl_marl.errors import CirlError, unknown_name
from cirl_marl.network.compartment_model import model_faults
from cirl_marl.network.declarations import bound_problems
from cirl_marl.network.disturbances import disturbance_problems
from cirl_marl.network.elements import IDENTIFIER, Arc, ControlKind, Law
from cirl_marl.network.specification import Specification
from cirl_marl.network.split_fractions import splits, trap_problems
from cirl_marl.network.substances import separation_problems
from cirl_marl.network.uncertainty import uncertainty_problems
from cirl_marl.network.units import factor
from cirl_marl.network.validation.accounts import account_problems
from cirl_marl.network.validation.compartments import arc_problems, node_problems, port_problems
from cirl_marl.network.validation.contents import substance_problems
from cirl_marl.network.validation.services import service_problems, supply_problems
from cirl_marl.network.validation.settings import calendar_problems, repetitions, setting_problems
from cirl_marl.network.validation.stocks import lifetime_problems, series_problems, storage_problems


def problems(network: Specification) -> Iterator[str]:
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
    yield from _name_problems([("account", account.id) for account in network.accounts])
    yield from account_problems(network)
    yield from _name_problems([("substance", substance.id) for substance in network.substances])
    strange = [*substance_problems(network)]
    yield from strange
    nodes = {node.id: node for node in network.nodes}
    compartments = {c.id: c for c in (*network.nodes, *network.arcs)}
    outflows: dict[str, list[Arc]] = {}
    inflows: dict[str, list[Arc]] = {}
    for arc in network.arcs:
        outflows.setdefault(arc.donor, []).append(arc)
        inflows.setdefault(arc.recipient, []).append(arc)
    for node in network.nodes:
        yield from node_problems(network, node)
        yield from storage_problems(network, node, outflows.get(node.id, ()))
        yield from lifetime_problems(network, node, [*inflows.get(node.id, ()), *outflows.get(node.id, ())])
    lawful = not strange
    for arc in network.arcs:
        faults = list(arc_problems(network, arc, nodes, compartments))
        yield from faults
        lawful = lawful and not faults
    for node in network.nodes:
        controlled_exits = [arc for arc in outflows.get(node.id, ()) if arc.law is Law.CONTROLLED]
        if node.control and node.control.kind is ControlKind.FLOW and len(controlled_exits) != 1:
            yield f"node '{node.id}': control.kind 'flow' needs one controlled outflow, it has {len(controlled_exits)}"
        for arc in controlled_exits:
            setting = sum(c.control is not None and c.control.kind is ControlKind.FLOW for c in (node, arc))
            if setting != 1:
                places = f"on the arc or on its donor '{node.id}'; it has {setting}"
                yield f"arc '{arc.id}': a controlled flow needs one control of kind 'flow', {places}"
    if lawful:
        divisions = splits(network)
        faults_of_splits = [problem for split in divisions for problem in split.problems()]
        yield from faults_of_splits or [*trap_problems(network, divisions), *separation_problems(network)]
    yield from port_problems(network)
    yield from service_problems(network)
    yield from supply_problems(network)
    yield from setting_problems(network)
    faults = [*_name_problems([("disturbance", name) for name in network.disturbances]), *disturbance_problems(network)]
    yield from faults or uncertainty_problems(network)
    actuators = dict.fromkeys(c.id for c in (*network.nodes, *network.arcs) if c.control is not None)
    for agent in network.default_agents:
        if agent in compartments and agent not in actuators:
            yield f"agents: '{agent}' has no control, so that it cannot act"
        elif agent not in actuators:
            yield f"agents: {unknown_name('agent', agent, actuators)}"
    yield from repetitions("agents", network.default_agents)


def _name_problems(kinds_and_ids: Iterable[tuple[str, str]]) -> Iterator[str]:
    """Yield ids that are none, and those used twice, of what shares one set of names, given as (kind, id)."""
    kinds: dict[str, list[str]] = {}
    for kind, id_ in kinds_and_ids:
        kinds.setdefault(id_, []).append(kind)
    for id_, users in kinds.items():
        subject = f"{' and '.join(dict.fromkeys(users))} '{id_}'"
        if not re.fullmatch(IDENTIFIER, id_):
            yield f"{subject}: an id begins with a letter and has lower-case letters, digits and underscores only"
        if len(users) > 1:
            explanation = "; nodes and arcs share one set of names" if len(set(users)) > 1 else ""
            yield f"{subject}: the id is used twice{explanation}"
