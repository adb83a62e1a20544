"""What is wrong with the services of a network."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping

from cirl_marl.errors import unknown
from cirl_marl.network.declared import bound_problems
from cirl_marl.network.elements import Arc, Compartment, Law, Service
from cirl_marl.network.model import Measuring
from cirl_marl.network.parts import Parts
from cirl_marl.network.validate_settings import repeated


def service_problems(network: Parts) -> Iterator[str]:
    """Yield every mistake in the services of ``network``."""
    everyone = {c.id: c for c in (*network.nodes, *network.arcs)}
    providers = _providers(network)
    for service in network.services:
        yield from _service_problems(service, everyone, providers)
        yield from _outflow_problems(service, network.arcs)


def _providers(network: Parts) -> dict[str, dict[str, None]]:
    """Return the compartments that may provide a service of each quantity."""
    nodes, everyone = network.nodes, (*network.nodes, *network.arcs)
    found = {
        "flow": [arc.id for arc in network.arcs],
        "stock": [*(node.id for node in nodes), *(arc.id for arc in network.arcs if arc.law is Law.BATCH)],
        "measure": [c.id for c in everyone if isinstance(c.model, Measuring)],
        "outflow": [node.id for node in nodes],
    }
    return {quantity: dict.fromkeys(ids) for quantity, ids in found.items()}


def _service_problems(
    service: Service, everyone: Mapping[str, Compartment], providers: Mapping[str, Mapping[str, None]]
) -> Iterator[str]:
    where = f"service '{service.id}'"
    yield from bound_problems(service, f"{where}: ")
    known = providers.get(service.quantity, providers["outflow"])
    if service.provider in known and service.quantity == "measure":
        model = everyone[service.provider].model
        if isinstance(model, Measuring) and service.measure not in model.measure_names:
            yield f"{where}: {unknown('measure', service.measure, model.measure_names)}"
    if service.provider not in known:
        kind = {"flow": "arc", "measure": "compartment that measures"}.get(service.quantity, "node")
        yield f"{where}: provider: {unknown(kind, service.provider, known)}"
    if service.measure and service.quantity != "measure":
        yield f"{where}: measure '{service.measure}': quantity '{service.quantity}' takes none"
    yield from repeated(f"{where}: owed_by", service.owed_by)
    for debtor in service.owed_by:
        if debtor not in everyone:
            yield f"{where}: owed_by: {unknown('compartment', debtor, everyone)}"
    if not 0 <= service.low <= service.high or not service.high > 0:
        yield f"{where}: the band [{service.low}, {service.high}] must not be negative or empty"
    elif service.low == 0 and math.isinf(service.high):
        yield f"{where}: the band from 0 without an upper end asks for nothing"


def _outflow_problems(service: Service, arcs: tuple[Arc, ...]) -> Iterator[str]:
    """Yield batches among the outflows that a service adds up: they count on arrival, not when they leave."""
    batches = [arc.id for arc in arcs if arc.law is Law.BATCH and arc.donor == service.provider]
    if service.quantity == "outflow" and batches:
        yield (
            f"service '{service.id}': quantity 'outflow': '{service.provider}' gives batches to {', '.join(batches)}, "
            "which count on arrival; ask for the 'flow' of that arc (what arrives) or its 'stock' (what is on the way)"
        )
