"""Versioned ids of environments: ``cirl_marl/NETWORK-v0``, and ``cirl_marl/NETWORK.SCENARIO-v0`` of other scenarios.

The table ``ids.json`` says what ids there are. ``python tests/environment_ids.py`` writes it, with figures of a short
episode beside each id; when these change, the version rises.
"""

from __future__ import annotations

import json
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING

from cirl_marl.errors import CirlError, unknown_name

if TYPE_CHECKING:
    from cirl_marl.network import Network

NAMESPACE = "cirl_marl/"
TABLE = Path(__file__).with_name("ids.json")


@cache
def figures() -> dict[str, list[float]]:
    """Return the table: every id, with the figures of its short episode."""
    table: dict[str, list[float]] = json.loads(TABLE.read_text(encoding="utf-8"))
    return table


@cache
def ids() -> dict[str, str]:
    """Return every id by the name of its environment, which is that of the network, or NETWORK.SCENARIO.

    >>> ids()["copper_net.paper"]
    'cirl_marl/copper_net.paper-v0'
    """
    return {name_and_version(id_)[0]: id_ for id_ in figures()}


def name_and_version(id_: str) -> tuple[str, int]:
    """Split an id into the name of the environment and its version, −1 if it has none.

    >>> name_and_version("cirl_marl/copper_net.paper-v0")
    ('copper_net.paper', 0)
    """
    name, _, version = id_.removeprefix(NAMESPACE).rpartition("-v")
    return (name, int(version)) if name and version.isdecimal() else (id_.removeprefix(NAMESPACE), -1)


def environment_name(network: Network) -> str:
    """Return what an environment of ``network`` is called, in ids and wherever else: NETWORK or NETWORK.SCENARIO."""
    return network.name if network.scenario_name == "default" else f"{network.name}.{network.scenario_name}"


def network_and_scenario(id_: str) -> tuple[str, str | None]:
    """Return the names of the network and the scenario, None being the default one, that an id stands for.

    Raises:
        CirlError: if there is no such id; of one whose numbers have changed since, it names the successor.
    """
    name, version = name_and_version(id_)
    successor = ids().get(name, "")
    if 0 <= version < name_and_version(successor)[1]:
        raise CirlError(f"environment '{id_}' is out of date, as its numbers have changed: use '{successor}'")
    if id_ != successor:
        raise CirlError(unknown_name("environment", id_, ids().values()))
    network, _, scenario = name.partition(".")
    return network, scenario or None
