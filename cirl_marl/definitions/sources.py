"""Where the numbers of a network come from: what its definition file says of each, compartment by compartment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Annotated, Any

from cirl_marl.definitions.reading import Definition
from cirl_marl.errors import DefinitionError
from cirl_marl.network import Network
from cirl_marl.network.declared import itemised

TABLES = ("nodes", "arcs", "services")


@itemised
@dataclass(frozen=True, slots=True)
class Stated:
    """A number as its definition states it."""

    key: Annotated[str, "dotted path within the compartment or service, such as ``rate`` or ``control``"]
    value: Annotated[str, "what is stated, with its unit; empty for a series or a column of a file"]
    source: Annotated[str, "where it comes from"]


def stated(network: Network) -> Mapping[str, Mapping[str, tuple[Stated, ...]]]:
    """Return what the definition of ``network`` states, by table (``nodes``, ``arcs``, ``services``) and id.

    It is empty for a network that was built in Python.

    Raises:
        DefinitionError: if the file has changed since the network was read from it.
    """
    if network.source is None:
        return {table: {} for table in TABLES}
    definition = Definition(network.source)
    if definition.sha256 != network.source_sha256:
        raise DefinitionError(str(network.source), ["has changed since it was read; what it says of sources is of now"])
    document = definition.document(network.scenario_name)
    return {
        table: {id_: tuple(_stated(each, "", network.region)) for id_, each in document.get(table, {}).items()}
        for table in TABLES
    }


def _stated(value: Any, key: str, region: str) -> Iterator[Stated]:
    if not isinstance(value, Mapping):
        return
    if isinstance(source := value.get("source"), str):
        yield Stated(key, _said(value), source)
    for name, each in value.items():
        yield from _stated(each, f"{key}.{name}".lstrip("."), region)


def _said(value: Mapping[str, Any]) -> str:
    """Say a quantity, a range or the span of a control."""
    numbers = [value[name] for name in ("value", "low", "neutral", "high") if isinstance(value.get(name), int | float)]
    if not numbers:
        return ""
    unit = value.get("unit", "")
    return " – ".join(f"{each:g}" for each in numbers) + (f" {unit}" if unit not in ("", "1") else "")
