"""What is wrong with arcs that make up for a service."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

from cirl_marl.errors import unknown
from cirl_marl.network.elements import Arc, ControlKind, Law, Service
from cirl_marl.network.parts import Parts
from cirl_marl.network.splits import SUMS


def supply_problems(network: Parts) -> Iterator[str]:
    """Yield why arcs cannot make up for what a service lacks."""
    services = {service.id: service for service in network.services}
    supplying: dict[str, list[Arc]] = {}
    passing: dict[str, list[Arc]] = {node.id: [] for node in network.nodes if not node.stores}
    for arc in network.arcs:
        passing.get(arc.donor, []).append(arc)
    for arc in network.arcs:
        where, kind = f"arc '{arc.id}'", arc.control.kind if arc.control else None
        if not arc.makes_up_for:
            if arc.weight is not None:
                yield f"{where}: weight: it makes up for no service; leave it out"
        elif arc.makes_up_for not in services:
            yield f"{where}: makes_up_for: {unknown('service', arc.makes_up_for, services)}"
        elif arc.law is not Law.CONTROLLED or kind is not ControlKind.FLOW:
            yield f"{where}: makes_up_for needs law 'controlled' and a control of kind 'flow' of its own"
        else:
            supplying.setdefault(arc.makes_up_for, []).append(arc)
            yield from _reach_problems(passing, arc, services[arc.makes_up_for])
    for service, arcs in supplying.items():
        weights = [arc.weight for arc in arcs]
        ids = ", ".join(arc.id for arc in arcs)
        if len(arcs) > 1 and None in weights:
            yield f"service '{service}': {ids} make up for it; each needs a weight, and they sum to 1"
        elif len(arcs) > 1 or weights != [None]:
            total = math.fsum(weight or 0.0 for weight in weights)
            if abs(total - 1) > SUMS:
                yield f"service '{service}': the weights of {ids}, which make up for it, sum to {total:g}, not to 1"


def _reach_problems(passing: Mapping[str, Sequence[Arc]], arc: Arc, service: Service) -> Iterator[str]:
    """Yield it if what an arc carries does not reach a service at once, past the outflows of nodes without stock."""
    where = f"arc '{arc.id}': makes_up_for '{service.id}'"
    if service.quantity == "measure":
        yield f"{where}: it asks for a measure of a model, which no flow makes up for at once"
        return
    reached, waiting = {arc.recipient}, [arc.recipient]
    flows = {arc.id}
    while waiting:
        node = waiting.pop()
        if node in passing:
            out = passing[node]
            flows |= {each.id for each in out}
            new = {each.recipient for each in out} - reached
            reached |= new
            waiting += sorted(new)
    known = (
        flows if service.quantity == "flow" else reached if service.quantity == "stock" else reached & passing.keys()
    )
    if known.isdisjoint(service.providers):
        between = "only nodes that store nothing may lie between them"
        yield f"{where}: what it carries does not reach '{service.provider}' at once; {between}"
