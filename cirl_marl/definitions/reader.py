"""From a TOML definition to a ``Network``, naming every mistake by file and key."""

from __future__ import annotations

import copy
import difflib
import math
import re
import tomllib
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from cirl_marl.definitions.conversion import Converter
from cirl_marl.definitions.data_files import DataFiles
from cirl_marl.definitions.error_messages import choices, toml_mistake, validation_mistakes
from cirl_marl.definitions.overrides import COMMON_KEYS, overlay, path_mistakes, stranger_mistakes, without_paths
from cirl_marl.definitions.region_copies import compose_copies, copied_file
from cirl_marl.definitions.schema import NetworkTable
from cirl_marl.errors import CirlError, DefinitionError, NetworkError, instance_of, unknown_name
from cirl_marl.network import Network
from cirl_marl.records.files import read_content, sha256_of, write_atomically

DEFAULT = "default"
"""The scenario that stands outside ``[scenarios]``."""
LARGEST = 64 * 2**20
"""Bytes of the largest definition that is read."""
DEEPEST = 50
"""Tables within tables, more than any definition has."""
DIGITS = "more than 18 are not possible"


class Definition:
    """A definition file; each scenario of it, in each region, is built when it is asked for.

    Attributes:
        path: of the file.
        names: of the scenarios, ``default`` first.
        regions: by id the texts of the regions, each of which is a network of its own; empty if it is one network.
        files: the data files that it names.
        sha256: hash of the file.
    """

    def __init__(self, path: Path) -> None:
        """Read the file; no network is built yet.

        Raises:
            DefinitionError: if it is no TOML, or its scenarios or regions are no tables.
        """
        self.path, self.files = path, DataFiles(path.parent)
        self._document = read_toml(path)
        self.sha256 = sha256_of(path)
        overrides = self._document.get("scenarios", {})
        if not isinstance(overrides, dict) or not all(isinstance(scenario, dict) for scenario in overrides.values()):
            raise DefinitionError(str(path), ["scenarios: must be tables, as in [scenarios.paper]"])
        if DEFAULT in overrides:
            fault = "the default scenario is what stands outside [scenarios]"
            raise DefinitionError(str(path), [f"scenarios.default: {fault}"])
        self._overrides = {DEFAULT: {}, **overrides}
        self.names = tuple(self._overrides)
        self.regions = self._document.get("regions", {})
        if not isinstance(self.regions, dict):
            raise DefinitionError(str(path), ['regions: must be a table of texts, as japan = "Japan"'])
        self._networks: dict[tuple[str, str], Network] = {}

    def network(self, name: str = DEFAULT, region: str = "") -> Network:
        """Return the network under a scenario; the others hang on it, and are built when they are asked for.

        Raises:
            DefinitionError: with every mistake in what the scenario is made of; nothing is returned half-read. If
                there is no such region, with those there are.
        """
        if not region and len(self.regions) == 1:
            (region,) = self.regions
        if region not in (self.regions or [""]):
            example = f"as in {self.path.name}:{next(iter(self.regions), 'japan')}"
            fault = f"which region? Known: {', '.join(self.regions)}. Write it after a colon, {example}"
            fault = unknown_name("region", region, self.regions) if region else fault
            raise DefinitionError(str(self.path), [fault])
        fields: dict[str, Any] = {"scenario_name": name, "scenarios": _OtherScenarios(self, name, region)}
        if (name, region) not in self._networks and name != DEFAULT and not self._changes(name):
            self._networks[name, region] = replace(self.network(DEFAULT, region), **fields)
        if (name, region) not in self._networks:
            override, prefix = self._overrides[name], "" if name == DEFAULT else f"scenarios.{name}."
            document, copies = self._whole(name)
            mistakes = [
                *path_mistakes(document, override.get("without", []), prefix),
                *stranger_mistakes(document, override, prefix),
                *(f"{prefix}{key}: a scenario cannot set it" for key in COMMON_KEYS if key in override),
            ]
            if mistakes:
                raise DefinitionError(str(self.path), mistakes)
            fields |= {"copies": copies, "source": self.path, "source_sha256": self.sha256}
            try:
                self._networks[name, region] = _build(self._under(name, document), (self.files, region), **fields)
            except NetworkError as error:
                raise DefinitionError(str(self.path), [prefix + problem for problem in error.problems]) from None
        return self._networks[name, region]

    def document(self, name: str = DEFAULT) -> dict[str, Any]:
        """Return what the file says under a scenario whose paths are those of the file, copies written out."""
        return self._under(name, self._whole(name)[0])

    def _under(self, name: str, document: dict[str, Any]) -> dict[str, Any]:
        """Return a document with what a scenario leaves out and changes."""
        override = self._overrides[name]
        changes = {key: value for key, value in override.items() if key not in ("without", "copies")}
        return overlay(without_paths(document, override), changes)

    def _changes(self, name: str) -> bool:
        """Whether a scenario may differ from the default one."""
        return bool(self._overrides[name]) or "copies" in self._document

    def _whole(self, name: str) -> tuple[dict[str, Any], dict[str, tuple[str, ...]]]:
        """Return the document, under a scenario with the copies that it asks for, and the nodes of each of these."""
        if "copies" not in self._document:
            return self._document, {}
        try:
            pattern = read_toml(self.files.plain_file(copied_file(self._document)))
            return compose_copies(self._document, pattern, name)
        except NetworkError as error:
            raise DefinitionError(str(self.path), error.problems) from None
        except CirlError as error:
            raise DefinitionError(str(self.path), [f"copies.of: {error}"]) from None

    def check(self, region: str = "") -> None:
        """Build every scenario.

        Raises:
            DefinitionError: with every mistake in the file.
        """
        mistakes: list[str] = []
        for name in self.names:
            try:
                self.network(name, region)
            except DefinitionError as error:
                mistakes += error.problems
                if name == DEFAULT:
                    break  # the scenarios would only repeat these
        if mistakes:
            raise DefinitionError(str(self.path), mistakes)


class _OtherScenarios(Mapping[str, Network]):
    """The scenarios of a definition but one, in a region."""

    def __init__(self, definition: Definition, scenario: str, region: str) -> None:
        self._definition, self._scenario, self._region = definition, scenario, region

    def __getitem__(self, name: str) -> Network:
        if name not in set(self):
            raise KeyError(name)
        return self._definition.network(name, self._region)

    def __iter__(self) -> Iterator[str]:
        return (name for name in self._definition.names if name != self._scenario)

    def __len__(self) -> int:
        return len(self._definition.names) - 1


def write_network(network: Network, path: str | Path) -> None:
    """Write a network built in Python as a definition file; its other scenarios are not written."""
    from cirl_marl.definitions.writer import definition_of

    text = definition_of(instance_of(Network, "network", network))
    write_atomically(Path(path), lambda partial: partial.write_text(text, encoding="utf-8"))


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file; a ``DefinitionError`` says if it is missing, unreadable or not TOML, with line and column."""
    try:
        if path.stat().st_size > LARGEST:
            raise DefinitionError(str(path), [f"has more than {LARGEST >> 20} MiB; keep long tables in CSV files"])
        text = read_content(path).decode("utf-8-sig").replace("\r\n", "\n").replace("\r", "\n")
    except FileNotFoundError:
        raise DefinitionError(str(path), ["no such file"]) from None
    except (OSError, UnicodeDecodeError) as error:
        raise DefinitionError(str(path), [f"cannot be read: {error}"]) from error
    try:
        document = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise DefinitionError(str(path), [toml_mistake(error, text)]) from error
    except RecursionError:
        raise DefinitionError(str(path), ["tables or lists are nested too deeply"]) from None
    except ValueError:  # Python reads no integer of thousands of digits
        lines = (number for number, line in enumerate(text.split("\n"), 1) if re.search(r"[0-9_]{4000}", line))
        place = f"line {next(lines, '?')}"
        raise DefinitionError(str(path), [f"{place}: is an integer of thousands of digits; {DIGITS}"]) from None
    if mistakes := list(_impossible(document)):
        raise DefinitionError(str(path), mistakes)
    return document


def _impossible(document: Mapping[str, Any]) -> Iterator[str]:
    """Yield where integers are that no TOML file may hold, or where tables are nested too deeply to mean anything."""
    entries: list[tuple[str, int, Any]] = [("", 0, document)]
    while entries:
        path, depth, value = entries.pop()
        if isinstance(value, dict | list):
            if depth > DEEPEST:
                yield f"{path[:100]}…: tables or lists are nested too deeply"
                return
            parts = value.items() if isinstance(value, dict) else enumerate(value)
            entries += [(f"{path}.{key}".lstrip("."), depth + 1, entry) for key, entry in parts]
        elif isinstance(value, int) and not -(2**63) <= value < 2**63:
            yield f"{path}: is an integer of {math.floor(value.bit_length() * math.log10(2))} digits; {DIGITS}"


def _build(document: Mapping[str, Any], beside: tuple[DataFiles, str], **fields: Any) -> Network:
    """Return the network of a document, of the files and the region ``beside`` it, and of fields ``fields`` besides."""
    name = str(document.get("name", "?"))
    try:
        table = NetworkTable.model_validate(document)
    except ValidationError as error:
        mistakes = validation_mistakes(error, NetworkTable)
        raise NetworkError(name, [*mistakes, *_further_mistakes(document, error, beside, fields)]) from None
    return Converter(table, *beside).network(**fields)


def _further_mistakes(
    document: Mapping[str, Any], error: ValidationError, beside: tuple[DataFiles, str], fields: Mapping[str, Any]
) -> list[str]:
    """Look for mistakes behind the given ones, with misspelt values mended and unknown keys left out."""
    corrected_document, guesses = copy.deepcopy(dict(document)), list[str]()
    for item in error.errors():
        *path, last = [part for part in item["loc"] if part != "[key]" and not str(part).startswith("<")]
        table: Any = corrected_document
        for part in path:
            table = table[part]
        if item["type"] == "extra_forbidden" and last == "series":
            table["flow"] = table.pop(last)  # as it was written when arcs had this key
        elif item["type"] == "extra_forbidden":
            del table[last]
        elif item["type"] in ("enum", "literal_error"):
            valid = choices(str(item["ctx"]["expected"]))
            guesses.append(".".join(map(str, path)))
            table[last] = next(iter(difflib.get_close_matches(str(item["input"]), valid, n=1)), valid[0])
        else:
            return []
    try:
        _build(corrected_document, beside, **fields)
    except NetworkError as further:
        # what is wrong where a word was mended may be wrong with the guess alone
        return [fault for fault in further.problems if fault.partition(": ")[0] not in guesses]
    return []
