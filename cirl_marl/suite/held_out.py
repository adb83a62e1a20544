"""Held-out variants of a network: other rates, demands and starts, drawn by a seed of their own."""

from __future__ import annotations

import zlib
from dataclasses import replace
from typing import Any

import numpy as np

from cirl_marl.network import Network
from cirl_marl.network.series import Series

VARIANTS = (1, 2, 3)
SPREAD = 0.05
"""Numbers are multiplied by factors that are uniform within 1 ± SPREAD."""


def variant_of(network: Network, variant: int) -> Network:
    """Return a network whose rates (of arcs and nodes), demands and initial ranges are multiplied by random factors.

    Both ends of a band or a range have one factor. The factors depend on network, scenario and variant alone.
    """
    key = zlib.crc32(f"{network.name}.{network.scenario_name}".encode())
    generator = np.random.default_rng([key, variant])

    def factor() -> float:
        return float(generator.uniform(1.0 - SPREAD, 1.0 + SPREAD))

    def with_factor(part: Any, *names: str) -> Any:
        by = factor()  # drawn whether it is used or not, so that parts keep theirs
        return replace(part, **{name: times(getattr(part, name), by) for name in names if getattr(part, name)})

    nodes = tuple(with_factor(with_factor(node, "rate"), "initial") for node in network.nodes)
    arcs = tuple(with_factor(arc, "rate") for arc in network.arcs)
    services = tuple(with_factor(service, "low", "high") for service in network.services)
    return network.variant(nodes=nodes, arcs=arcs, services=services)


def times(value: Any, factor: float) -> Any:
    """Return a number, a series or both ends of a range times a factor."""
    if isinstance(value, Series):
        return replace(value, values=tuple(factor * part for part in value.values))
    return tuple(factor * end for end in value) if isinstance(value, tuple) else factor * value
