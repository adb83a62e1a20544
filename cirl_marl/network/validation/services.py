"""What is wrong with the services of a network, and with arcs that make up for them."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from cirl_marl.errors import unknown_name, unknown_names
from cirl_marl.network.compartment_model import MeasuringModel
from cirl_marl.network.declarations import bound_problems
from cirl_marl.network.elements import Arc, Compartment, ControlKind, Law, Node, Service
from cirl_marl.network.series import extremes
from cirl_marl.network.specification import Specification
from cirl_marl.network.split_fractions import LEAST, SUMS
from cirl_marl.network.validation.settings import repetitions


def service_problems(network: Specification) -> Iterator[str]:
    """Yield every mistake in the services of ``network``."""
    compartments = {c.id: c for c in (*network.nodes, *network.arcs)}
    providers = _providers(network)
    for service in network.services:
        yield from _service_problems(network, service, compartments, providers)
        yield from _outflow_problems(service, network.arcs)


def _providers(network: Specification) -> dict[str, dict[str, None]]:
    """Return the compartments that may provide a service of each quantity."""
    nodes, compartments = network.nodes, (*network.nodes, *network.arcs)
    candidates = {
        "flow": [arc.id for arc in network.arcs],
        "stock": [
            *(node.id for node in nodes if node.stores),
            *(arc.id for arc in network.arcs if arc.law is Law.BATCH),
        ],
        "measure": [c.id for c in compartments if isinstance(c.model, MeasuringModel)],
        "outflow": [node.id for node in nodes],
    }
    return {quantity: dict.fromkeys(ids) for quantity, ids in candidates.items()}


def _service_problems(
    network: Specification,
    service: Service,
    compartments: Mapping[str, Compartment],
    providers: Mapping[str, Mapping[str, None]],
) -> Iterator[str]:
    subject = f"service '{service.id}'"
    yield from bound_problems(service, f"{subject}: ")
    options = providers.get(service.quantity, providers["outflow"])
    if service.provider in options and service.quantity == "measure":
        model = compartments[service.provider].model
        if isinstance(model, MeasuringModel) and service.measure not in model.measure_names:
            yield f"{subject}: {unknown_name('measure', service.measure, model.measure_names)}"
    for place, id_ in enumerate(service.providers):
        key, provider = "also" if place else "provider", compartments.get(id_)
        if isinstance(provider, Node) and not provider.stores and service.quantity == "stock":
            yield f"{subject}: {key}: '{provider.id}' stores nothing; ask for its outflow"
        elif id_ not in options:
            kind = {"flow": "arc", "measure": "compartment that measures"}.get(service.quantity, "node")
            yield f"{subject}: {key}: {unknown_name(kind, id_, options)}"
    yield from repetitions(f"{subject}: also", service.providers)
    if service.also and service.quantity == "measure":
        yield f"{subject}: also: measures of several compartments do not add up; give each a service"
    if service.measure and service.quantity != "measure":
        yield f"{subject}: measure '{service.measure}': quantity '{service.quantity}' takes none"
    yield from repetitions(f"{subject}: owed_by", service.owed_by)
    yield from unknown_names("compartment", service.owed_by, compartments, f"{subject}: owed_by: ")
    low, high = (np.array(network.interval_means(id_)) for id_ in (service.low, service.high))
    if extremes(service.low)[0] < 0:
        yield f"{subject}: low {extremes(service.low)[0]:g} must not be negative"
    elif not ((low >= 0) & (low <= high) & (high > 0)).all():
        worst = int(np.argmin((low >= 0) & (low <= high) & (high > 0)))
        yield f"{subject}: the band [{low[worst]}, {high[worst]}] must not be negative or empty"
    elif (low == 0).all() and np.isinf(high).all() and not network.is_variant:
        yield f"{subject}: the band from 0 without an upper end asks for nothing"


def _outflow_problems(service: Service, arcs: tuple[Arc, ...]) -> Iterator[str]:
    """Yield batches among the outflows that a service adds up: they count on arrival, not when they leave."""
    batches = [arc.id for arc in arcs if arc.law is Law.BATCH and arc.donor in service.providers]
    if service.quantity == "outflow" and batches:
        donors = ", ".join(service.providers)
        yield (
            f"service '{service.id}': quantity 'outflow': '{donors}' gives batches to {', '.join(batches)}, "
            "which count on arrival; ask for the 'flow' of that arc (what arrives) or its 'stock' (what is on the way)"
        )


def supply_problems(network: Specification) -> Iterator[str]:
    """Yield why arcs cannot make up for what a service lacks."""
    services = {service.id: service for service in network.services}
    suppliers: dict[str, list[Arc]] = {}
    stockless_exits: dict[str, list[Arc]] = {node.id: [] for node in network.nodes if not node.stores}
    for arc in network.arcs:
        # supplies follow what is no substance
        if arc.law not in (Law.SHARE, Law.DONOR):
            continue  # what is ordered is no more for what arrives more
        if not network.substances or arc.control is not None or arc.share is None or extremes(arc.share)[1] > LEAST:
            stockless_exits.get(arc.donor, []).append(arc)
    for arc in network.arcs:
        subject, kind = f"arc '{arc.id}'", arc.control.kind if arc.control else None
        if not arc.makes_up_for:
            if arc.weight is not None:
                yield f"{subject}: weight: it makes up for no service; leave it out"
        elif arc.makes_up_for not in services:
            yield f"{subject}: makes_up_for: {unknown_name('service', arc.makes_up_for, services)}"
        elif arc.law is not Law.CONTROLLED or kind is not ControlKind.FLOW:
            yield f"{subject}: makes_up_for needs law 'controlled' and a control of kind 'flow' of its own"
        else:
            suppliers.setdefault(arc.makes_up_for, []).append(arc)
            yield from _reach_problems(stockless_exits, arc, services[arc.makes_up_for])
    for service, arcs in suppliers.items():
        weights = [arc.weight for arc in arcs]
        ids = ", ".join(arc.id for arc in arcs)
        if len(arcs) > 1 and None in weights:
            yield f"service '{service}': {ids} make up for it; each needs a weight, and they sum to 1"
        elif len(arcs) > 1 or weights != [None]:
            total = math.fsum(weight or 0.0 for weight in weights)
            if abs(total - 1) > SUMS:
                yield f"service '{service}': the weights of {ids}, which make up for it, sum to {total:g}, not to 1"


def _reach_problems(stockless_exits: Mapping[str, Sequence[Arc]], arc: Arc, service: Service) -> Iterator[str]:
    """Yield it if what an arc carries does not reach a service at once, past the outflows of nodes without stock."""
    subject = f"arc '{arc.id}': makes_up_for '{service.id}'"
    if service.quantity == "measure":
        yield f"{subject}: it asks for a measure of a model, which no flow makes up for at once"
        return
    providers = set(service.providers)
    if service.quantity == "outflow":
        providers &= stockless_exits.keys()
    is_flow, nodes = service.quantity == "flow", {arc.recipient}
    is_reached = arc.id in providers if is_flow else arc.recipient in providers
    queue = deque(nodes)
    while queue and not is_reached:
        exits = stockless_exits.get(queue.popleft(), ())
        new = {exit_.recipient for exit_ in exits} - nodes
        is_reached = not providers.isdisjoint([exit_.id for exit_ in exits] if is_flow else new)
        nodes |= new
        queue += new
    if not is_reached:
        between = "only shares of nodes that store nothing may lie between"
        yield f"{subject}: what it carries does not reach '{service.provider}' at once; {between}"
