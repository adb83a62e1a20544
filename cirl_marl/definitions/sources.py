"""Where the numbers of a network come from: what its definition file says of each, compartment by compartment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Annotated, Any

from cirl_marl.definitions.reader import Definition
from cirl_marl.errors import DefinitionError
from cirl_marl.network import Network
from cirl_marl.network.declarations import positional_record

TABLES = ("nodes", "arcs", "services")
SETTINGS = ("scales", "episode", "objective")
ENDS = ("value", "low", "neutral", "high")
"""What a quantity, a range and the span of a control consist of."""


@positional_record
class StatedNumber:
    """A number as its definition states it."""

    key: Annotated[str, "dotted path within the compartment, service or file, such as ``rate`` or ``control``"]
    value: Annotated[str, "what is stated, with its unit; of a series its ends, of a column its name and file"]
    source: Annotated[str, "where it comes from"]


def stated_numbers(network: Network) -> Mapping[str, Mapping[str, tuple[StatedNumber, ...]]]:
    """Return what the definition of ``network`` states, by table (``nodes``, ``arcs``, ``services``) and id.

    It is empty for a network that was built in Python.

    Raises:
        DefinitionError: if the file has changed since the network was read from it.
    """
    document = _document(network)
    parts = {table: document.get(table, {}).items() for table in TABLES}
    return {table: {id_: tuple(_numbers_in(part, "")) for id_, part in rows} for table, rows in parts.items()}


def stated_settings(network: Network) -> tuple[StatedNumber, ...]:
    """Return what the definition of ``network`` states of scales, episode and objective; see ``stated``."""
    document = _document(network)
    return tuple(number for table in SETTINGS for number in _numbers_in(document.get(table), table))


def _document(network: Network) -> Mapping[str, Any]:
    if network.source is None:
        return {}
    definition = Definition(network.source)
    if definition.sha256 != network.source_sha256:
        raise DefinitionError(str(network.source), ["has changed since it was read; what it says of sources is of now"])
    return definition.document(network.scenario_name)


def _numbers_in(value: Any, key: str) -> Iterator[StatedNumber]:
    if not isinstance(value, Mapping):
        return
    if isinstance(source := value.get("source"), str):
        yield StatedNumber(key, _in_words(value), source)
    for name, entry in value.items():
        yield from _numbers_in(entry, f"{key}.{name}".lstrip("."))


def _in_words(value: Mapping[str, Any]) -> str:
    """Say a quantity, a range, the span of a control, a lifetime, a series, a column of a file, or a model."""
    ends = [value[name] for name in ENDS if name in value] or [value]
    words = " – ".join(map(_end, ends))
    if "mean" in value:
        words = f"{value['distribution'].replace('_', ' ')} {value['mean']:g}"
    unit = value.get("unit", "")
    words += f" {unit}" if words and unit not in ("", "1") else ""
    if (spread := value.get("deviation")) is not None:
        words += f" ± {spread if isinstance(spread, str) else f'{spread:g}'}"
    times = [end["times"] for end in ends if isinstance(end, Mapping) and "times" in end]
    return f"{words} ({times[-1][0]} to {times[-1][-1]})" if times else words


def _end(value: Any) -> str:
    """Say a number, or what stands for one that changes in time."""
    if isinstance(value, int | float):
        return f"{value:g}"
    if not isinstance(value, Mapping):
        return str(value)
    if "file" in value:
        return f"{value['column']} of {value['file']}"
    if values := value.get("values", value.get("masses")):
        return f"{values[0]:g} … {values[-1]:g}"
    return str(value.get("kind", ""))
