"""Limits of contents that nothing can keep, of networks that are right otherwise."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import networkx as nx
import numpy as np

from cirl_marl.network.elements import Service
from cirl_marl.network.initial_ages import content_edges
from cirl_marl.network.reachable_contents import network_digraph, reachable_contents
from cirl_marl.network.rowsum import Floats
from cirl_marl.network.series import extremes, means
from cirl_marl.network.split_fractions import share_ranges, splits
from cirl_marl.network.substances import CONTENT, network_of_substance
from cirl_marl.network.uncertainty import CERTAIN, factor_ranges

ROUND_OFF = 1e-9
"""Part of a limit by which contents may miss it, as sums round."""
DIGITS = 4
"""Of the limits that messages offer."""


def limit_problems(network: Any) -> Iterator[str]:
    """Yield limits and grades that no content keeps which can be in what they are of, whatever is done or drawn."""
    if not any(service.substance for service in network.services):
        return
    factors = factor_ranges(network, with_draws=True)
    starts, names = _starts(network, factors), [substance.id for substance in network.substances]
    subjects = {node for service in network.services for node in _doubtful_nodes(network, service, names, starts)}
    stocks, flows = reachable_contents(network, starts, _shares(network), subjects)
    for service in network.services:
        if not service.substance:
            continue
        row = 1 + names.index(service.substance)
        if service.quantity == "stock":
            low, high = stocks[:, row, [network.node_index[id_] for id_ in service.providers]]
        else:
            low, high = flows[:, row, network.service_arcs(service)]
        least, most = low.min(initial=1.0), high.max(initial=0.0)
        if least <= most:  # else nothing is ever there
            ends = [factors.get(f"services.{service.id}.{end}", CERTAIN)[end == "high"] for end in ("low", "high")]
            grade = float((network.interval_means(service.low) * ends[0]).max())
            limit = float((network.interval_means(service.high) * ends[1]).min())
            yield from _service_problems(service, grade, limit, least, most)


def _doubtful_nodes(network: Any, service: Service, names: list[str], starts: Floats) -> set[int]:
    """Return the nodes that a service is of, none if what they come from has the least and the most that is asked."""
    if not service.substance:
        return set()
    if service.quantity == "stock":
        subjects = {network.node_index[id_] for id_ in service.providers}
    else:
        subjects = set(network.donors[network.service_arcs(service)].tolist())
    graph, row = network_digraph(network), 1 + names.index(service.substance)
    origins = subjects.union(*(nx.ancestors(graph, node) for node in subjects)) & set(range(len(network.stores)))
    least, most = starts[0, row, [*origins]].min(initial=1.0), starts[1, row, [*origins]].max(initial=0.0)
    is_sure = least == 0.0 and (most == 1.0 or extremes(service.low)[1] == 0.0)
    return set() if is_sure else subjects


def _service_problems(service: Service, grade: float, limit: float, least: float, most: float) -> Iterator[str]:
    subject, holder = f"service '{service.id}'", f"'{', '.join(service.providers)}'"
    if limit < least * (1 - ROUND_OFF):
        fault = f"at least {least:.{DIGITS}g} of what is in {holder} is {service.substance}, whatever is done"
        yield f"{subject}: high {limit:g}: {fault}; the lowest limit that can be kept is {_decimal(least, math.ceil)}"
    if grade > most * (1 + ROUND_OFF):
        fault = f"at most {most:.{DIGITS}g} of what is in {holder} is {service.substance}, whatever is done"
        yield f"{subject}: low {grade:g}: {fault}; the highest grade that can be had is {_decimal(most, math.floor)}"


def _starts(network: Any, factors: Mapping[str, tuple[float, float]]) -> Floats:
    """Return the least and greatest part of each component in what there is at the start, or in what sources give.

    The shape is (2, components, stores); what is no substance may be any part.
    """
    starts = np.tile([[[1.0]], [[0.0]]], (1, 1 + len(network.substances), len(network.stores)))
    for i in np.flatnonzero(network.initial[1] > 0).tolist():
        node, edges = network.stores[i], content_edges(network, network.stores[i])
        starts[:, 0, i] = 0.0, 1.0
        for row, substance in enumerate(network.substances, start=1):
            parts = means(dict(node.content).get(substance.id, 0.0), edges)
            low, high = factors.get(f"nodes.{node.id}.{CONTENT}{substance.id}", CERTAIN)
            starts[:, row, i] = parts.min() * low, min(parts.max() * high, 1.0)
    return starts


def _shares(network: Any) -> Floats:
    """Return the least and greatest share of each arc of law ``share``, 1 of others, shape (2, components, arcs).

    Of what leaves a node of which some share is not certain they may be any.
    """
    uncertain = {path.split(".")[1] for path in (*network.uncertain, *network.disturbed) if path.startswith("arcs.")}
    shares = np.ones((2, 1 + len(network.substances), len(network.arcs)))
    divisions = [network.splits, *(splits(network_of_substance(network, part.id)) for part in network.substances)]
    for row, division in enumerate(divisions):
        for split in division:
            arcs = [*split.controlled_arcs, *split.other_arcs]
            least, most = share_ranges(split, split.bounds[[0, 2]])
            is_certain = uncertain.isdisjoint(network.arcs[k].id for k in arcs)
            shares[0, row, arcs] = least.min(axis=1) if is_certain else 0.0
            shares[1, row, arcs] = most.max(axis=1) if is_certain else 1.0
    return shares


def _decimal(part: float, towards: Callable[[float], int]) -> str:
    """Say a part of the mass with few digits, rounded up or down."""
    unit = 10.0 ** (math.floor(math.log10(part)) + 1 - DIGITS) if part > 0 else 1.0
    return f"{towards(part / unit) * unit:.{DIGITS}g}"
