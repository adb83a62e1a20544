"""What is wrong with the substances of a network, and with what is said of them."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from cirl_marl.errors import unknown_name, unknown_names
from cirl_marl.network.declarations import bound_problems
from cirl_marl.network.elements import Arc, ControlKind, Law, Node
from cirl_marl.network.initial_ages import content_edges
from cirl_marl.network.series import Series, extremes, means
from cirl_marl.network.specification import Specification
from cirl_marl.network.split_fractions import SUMS
from cirl_marl.network.substances import REMAINDER, changing_sources
from cirl_marl.network.validation.settings import repetitions


def substance_problems(network: Specification) -> Iterator[str]:
    """Yield every mistake in the substances of ``network``, but for sums of shares."""
    substances = [substance.id for substance in network.substances]
    if REMAINDER in substances:
        yield f"substance '{REMAINDER}': the id is that of what is no substance; choose another"
    for substance in network.substances:
        yield from bound_problems(substance, f"substance '{substance.id}': ")
    for node in network.nodes:
        if node.content:
            yield from _content_problems(network, node, substances)
    for source in changing_sources(network):
        if source.stores:
            yield from _source_problems(network, source)
    for arc in network.arcs:
        yield from _transfer_problems(arc, substances)
    yield from _service_problems(network, substances)
    if substances:
        yield from _motion_problems(network)
        stated = {id_ for node in network.nodes for id_ in dict(node.content)}
        for id_ in substances:
            if id_ not in stated:
                yield f"substance '{id_}': no node has any of it; give the content of stocks, such as that of a source"


def _content_problems(network: Specification, node: Node, substances: list[str]) -> Iterator[str]:
    subject = f"node '{node.id}': content"
    yield from unknown_names("substance", dict(node.content), substances, f"{subject}: ")
    if not node.stores:
        yield f"{subject}: it stores nothing, and what it hands on has the content of what enters it"
    series = [part for part in dict(node.content).values() if isinstance(part, Series)]
    edges = content_edges(network, node)
    parts = [means(part, edges) for part in dict(node.content).values()]
    total = float(np.max(sum(parts)))
    if total > 1 + SUMS and max(float(part.max()) for part in parts) <= 1:  # else that is the fault
        yield f"{subject}: its substances sum to {total:g} of its mass, more than 1"
    if node.history is not None:
        late = [part for part in series if part.times[0] > node.history.times[0]]
        if late:
            yield f"{subject}: series begins at {late[0].times[0]:g}, after the history at {node.history.times[0]:g}"


def _source_problems(network: Specification, node: Node) -> Iterator[str]:
    """Yield why the contents of a stock cannot change in time, whatever flows."""
    subject = f"node '{node.id}': content"
    remedy = "a stock mixes what enters it; only what a source gives, or what a history was, may change in time"
    for arc in network.arcs:
        if arc.recipient == node.id:
            yield f"{subject}: arc '{arc.id}' enters it: {remedy}"
        elif arc.donor == node.id and arc.law not in (Law.CONTROLLED, Law.EXOGENOUS):
            yield f"{subject}: arc '{arc.id}' leaves it by law '{arc.law}': {remedy}, by schedule"


def _transfer_problems(arc: Arc, substances: list[str]) -> Iterator[str]:
    subject, control = f"arc '{arc.id}'", arc.control
    controlled = () if control is None else control.substances
    if arc.transfer and arc.law is not Law.SHARE:
        yield f"{subject}: transfer: law '{arc.law}' takes none; substances are separated by arcs of law 'share'"
    for key, ids in (("transfer", dict(arc.transfer)), ("control.substances", controlled)):
        yield from unknown_names("substance", ids, substances, f"{subject}: {key}: ")
    yield from repetitions(f"{subject}: control.substances", controlled)
    for id_ in dict(arc.transfer):
        if id_ in controlled:
            yield f"{subject}: transfer.{id_}: its control sets it; leave it out"
    if controlled and control is not None and control.kind is not ControlKind.TRANSFER:
        yield f"{subject}: control.substances: kind '{control.kind}' takes none; kind 'transfer' sets their share"


def _service_problems(network: Specification, substances: list[str]) -> Iterator[str]:
    makes_up, arcs = {arc.makes_up_for for arc in network.arcs}, {arc.id for arc in network.arcs}
    for service in network.services:
        subject = f"service '{service.id}': substance"
        if not service.substance:
            continue
        if service.substance not in substances:
            yield f"{subject}: {unknown_name('substance', service.substance, substances)}"
        if service.quantity == "measure":
            yield f"{subject}: a measure of a model has no content; ask for that of a stock or flow"
        on_the_way = [id_ for id_ in service.providers if service.quantity == "stock" and id_ in arcs]
        if on_the_way:
            yield f"{subject}: no content is measured of what is on the way along '{on_the_way[0]}'; ask for its flow's"
        for end, part in (("low", service.low), ("high", service.high)):
            most = extremes(part)[1]
            if 1 < most < math.inf:
                yield f"{subject}: {end} {most:g} is more than 1, all there is; say '%' or 'ppm' in its unit"
        if service.id in makes_up:
            yield f"{subject}: no flow makes up for a content; leave out makes_up_for"


def _motion_problems(network: Specification) -> Iterator[str]:
    """Yield what moves otherwise than substances can be followed."""
    solver = network.episode.solver
    if solver != "exact":
        yield f"substances: solver '{solver}' does not follow them; leave out solver and solver_step"
    for compartment in (*network.nodes, *network.arcs):
        if compartment.model is not None:
            kind = type(compartment).__name__.lower()
            yield f"{kind} '{compartment.id}': model: inner physics does not follow substances"
    for arc in network.arcs:
        if arc.law in (Law.RECIPIENT, Law.COMPARTMENT):
            yield f"arc '{arc.id}': law '{arc.law}' does not follow substances; take 'donor', 'share' or a schedule"
