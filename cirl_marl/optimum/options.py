"""What a bound is asked for, checked: the stocks at the start, the demanded service levels, and the options."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.outcome import NOTABLE
from cirl_marl.dynamics.state_layout import StateLayout
from cirl_marl.errors import CirlError, unknown_name, whole_number
from cirl_marl.network import Floats, Network
from cirl_marl.network.series import product
from cirl_marl.optimum.vintages import Lifetimes

DEGREE = 2
"""Degree of the test polynomials; docs/plans.md has the gap against it."""


def starting_stocks(lifetimes: Lifetimes, initial: Mapping[str, float] | ArrayLike | None) -> Floats:
    """Return the stocks that ``initial`` describes (see ``bound``), as the simulator has them, mass.

    Those of nodes with a lifetime are spread over its stages by history or growth, unless they are given by stage.

    Raises:
        CirlError: for an unknown node, a wrong shape, or a stock that is negative or not finite.
    """
    network = lifetimes.network
    start: Floats = network.initial.mean(axis=0)
    stores = {node.id: i for i, node in enumerate(network.stores)}
    if isinstance(initial, Mapping):
        for node, stock in initial.items():
            if node not in stores:
                raise CirlError(f"initial: {unknown_name('node', node, stores)}")
            start[stores[node]] = stock
    elif initial is not None:
        start = np.asarray(initial, dtype=float)
        if start.ndim != 1:
            raise CirlError(f"initial has shape {start.shape}, expected {(len(stores),)}")
    return by_stage(network, lifetimes.state_layout, start)


def check_options(service_weight: float | None, min_service: ArrayLike | None, degree: int) -> None:
    """Refuse options of ``bound`` that cannot be used.

    Raises:
        CirlError: naming the option and its value.
    """
    if service_weight is not None and min_service is not None:
        raise CirlError("service_weight and min_service are two ways to ask for service: give one of them")
    if service_weight is not None and not 0 <= service_weight < math.inf:
        raise CirlError(f"service_weight {service_weight!r} must be finite and not negative")
    if min_service is not None:
        check_service(min_service)
    whole_number("degree", degree, 1)


def by_stage(network: Network, state_layout: StateLayout, stocks: ArrayLike) -> Floats:
    """Return stocks of nodes, shape (..., stores), as the simulator has them, those with a lifetime by stage.

    What is given by stage already stays as it is; the others are spread by history or growth.

    Raises:
        CirlError: for another shape, or a stock that no episode can start from, negative or not finite.
    """
    masses, count, rows = np.asarray(stocks, dtype=float), len(network.stores), state_layout.nodes.stop
    if masses.shape[-1:] not in ((rows,), (count,)):
        raise CirlError(f"initial has shape {masses.shape}, expected (..., {count})")
    staged_masses = np.zeros((*masses.shape[:-1], rows))
    staged_masses[..., : masses.shape[-1]] = masses
    if masses.shape[-1] != rows:
        for i, stages in state_layout.stages.items():
            shares = network.start_shares(network.stores[i])
            staged_masses[..., stages] = masses[..., i, None] * shares
    wrong = np.argwhere(~((staged_masses >= 0) & (staged_masses < math.inf)))
    if len(wrong):
        stock, name = staged_masses[tuple(wrong[0])], state_layout.start_names[wrong[0, -1]]
        raise CirlError(f"initial: the stock of '{name}' is {stock}; it must be finite and not negative")
    return staged_masses


def check_service(min_service: ArrayLike) -> None:
    """Refuse mean service levels outside [0, 1].

    Raises:
        CirlError: naming the first of them.
    """
    for level in np.ravel(min_service).tolist():
        is_number = isinstance(level, int | float)
        if not is_number or not 0 <= level <= 1:
            form = "" if is_number else ", a number for all services or a list with one for each"
            raise CirlError(f"min_service {level!r} must lie in [0, 1]{form}")


def demanded_levels(network: Network, min_service: ArrayLike, episodes: tuple[int, ...] = ()) -> Floats:
    """Return the demanded mean level of each service, shape (*episodes, services); a number is for every service.

    Raises:
        CirlError: for a shape that cannot be broadcast to it.
    """
    return network.by_service("min_service", min_service, "a level", episodes)


def levels_text(network: Network, levels: Floats) -> str:
    """Say levels of the services, shape (services,): a single number if they are all the same."""
    if len(set(levels.tolist())) == 1:
        return f"{levels[0]:g}"
    return ", ".join(f"{level:g} of '{service.id}'" for level, service in zip(levels, network.services, strict=True))


def lack_texts(network: Network, demand: Floats, levels: Floats) -> list[str]:
    """Say of which services levels are notably less than is demanded, shape (services,) each."""
    lacks = zip(network.services, (demand - levels).tolist(), strict=True)
    return [f"{lack:.4f} less of '{service.id}'" for service, lack in lacks if lack > NOTABLE]


def check_margin(margin: ArrayLike, name: str = "margin") -> None:
    """Refuse margins, which an option ``name`` has, that are not positive and finite.

    Raises:
        CirlError: naming the first of them.
    """
    for number in np.ravel(margin).tolist():
        if not isinstance(number, int | float) or not 0 < number < math.inf:
            raise CirlError(f"{name} {number!r} must be positive and finite")


def with_margin(network: Network, margin: ArrayLike) -> Network:
    """Return a certain network whose services want ``margin`` times as much, and limits of contents as much less.

    Raises:
        CirlError: for another number of margins than services.
    """
    margins = network.by_service("margin", margin, "a margin")
    if (margins == 1.0).all():
        return network
    services = (
        replace(s, low=product(s.low, factor), high=product(s.high, 1.0 / factor if s.substance else factor))
        for s, factor in zip(network.services, margins.tolist(), strict=True)
    )
    return network.variant(services=tuple(services))
