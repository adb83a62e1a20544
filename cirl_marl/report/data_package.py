"""A network and an episode of it as a Frictionless data package: tables that say what their columns are, and a reader.

The folder has ``datapackage.json``, the definition ``network.toml``, tables of nodes and arcs, and a row for each
number of the episode: stocks at the start and after each interval, mean flows, service levels, λ, amounts on accounts,
and of each substance the content of stocks after an interval and of flows in it.

Reference: Frictionless Data, Data Package version 2 (datapackage.org).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cirl_marl.controllers.episode_quantities import QuantityKind, episode_quantities
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.definitions.data_files import CsvRows, number_in
from cirl_marl.definitions.reader import write_network
from cirl_marl.errors import CirlError, check_names, instance_of, unknown_name
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.records.files import publish_folder, read_content, read_record, write_json, write_table
from cirl_marl.records.machine import versions

PACKAGE, DEFINITION = "datapackage.json", "network.toml"
PROFILE = "https://datapackage.org/profiles/2.0/datapackage.json"
KEYS = {"stocks": ("node", "nodes"), "flows": ("arc", "arcs")}
"""Columns of tables that hold ids of another."""
TableField = tuple[str, str, str]
"""Name, type and meaning of a column."""


@positional_record
class EpisodePackage:
    """What a data package has of an episode."""

    network: Annotated[Network, "that moved"]
    scenario: Annotated[str, "under which it did"]
    control: Annotated[str, "who acted"]
    stock: Annotated[Floats, "stocks at the start and after each interval, shape (steps + 1, stores), mass"]
    flow: Annotated[Floats, "mean flows of each interval, shape (steps, arcs), mass/time"]
    levels: Annotated[Floats, "level of each service, shape (steps, services)"]
    circularity: Annotated[Floats, "mean of λ over each interval, shape (steps,), mass"]
    bookings: Annotated[Floats, "amount on each account, not discounted, shape (steps, accounts)"]
    contents: Annotated[Floats, "part of each substance in nodes and flows, shape (steps, substances, compartments)"]


def write_package(folder: str | Path, simulation: Simulation) -> Path:
    """Write the network of an episode and what came of it as a data package; return its ``datapackage.json``.

    Raises:
        CirlError: if there is something at ``folder``.
    """
    folder, network = Path(folder), instance_of(Simulation, "simulation", simulation).network
    if folder.exists():
        raise CirlError(f"{folder}: exists; a data package is a folder of its own, so give another name")
    resources = []
    folder.parent.mkdir(parents=True, exist_ok=True)
    with publish_folder(folder) as draft:
        write_network(network, draft / DEFINITION)
        for name, (fields, rows) in _tables(simulation).items():
            write_table(draft / f"{name}.csv", [field for field, _, _ in fields], rows)
            schema: dict[str, Any] = {
                "fields": [{"name": field, "type": kind, "description": meaning} for field, kind, meaning in fields]
            }
            if name in KEYS:
                field, table = KEYS[name]
                schema["foreignKeys"] = [{"fields": [field], "reference": {"resource": table, "fields": ["id"]}}]
            elif fields[0][0] == "id":
                schema["primaryKey"] = ["id"]
            form = {"type": "table", "format": "csv", "mediatype": "text/csv", "encoding": "utf-8"}
            resources.append({"name": name, "path": f"{name}.csv", **form, "schema": schema})
        resources.append({"name": "network", "path": DEFINITION, "mediatype": "application/toml"})
        package = {
            "$schema": PROFILE,
            "name": network.name.replace("_", "-").lower(),
            "title": network.title or network.name,
            "scenario": network.scenario_name,
            "control": simulation.control,
            "contributors": [{"title": f"cirl_marl {versions()['cirl-marl']}", "roles": ["creator"]}],
            "resources": resources,
        }
        write_json(draft / PACKAGE, package)
    return folder / PACKAGE


def _tables(simulation: Simulation) -> dict[str, tuple[list[TableField], Iterable[Sequence[object]]]]:
    """Return the fields and rows of each table, by name."""
    network, run, ledger = simulation.network, simulation.rollout, simulation.env.ledger
    pairs = zip(ledger.account.tolist(), ledger.compartments, strict=True)
    entries = [(network.accounts[account], compartment) for account, compartment in pairs]
    mass, interval = network.mass_unit, ("interval", "integer", "counted from 0")
    begin = ("interval", "integer", "before which it is: 0 is the start")
    head = [("id", "string", "of the network"), ("title", "string", "in pictures")]
    kinds = [("role", "string", "in the circular economy"), ("stores", "boolean", "whether it has a stock")]
    ends = [("from", "string", "node that gives"), ("to", "string", "node that receives")]
    part = ("content", "number", "part of the mass: of a stock after the interval, of a flow in it")

    def rows(kind: QuantityKind, substance: str = "") -> Iterator[list[object]]:
        """Yield interval, id and value of all quantities of a kind, stocks from the start on."""
        members = [member for member in episode_quantities(network, kind) if member.substance == substance]
        curves = (member.points(network, run)[1].tolist() for member in members)
        for t, values in enumerate(zip(*curves, strict=True)):
            yield from ([t, member.of, value] for member, value in zip(members, values, strict=True))

    account = [("account", "string", "id"), ("compartment", "string", "of it"), ("unit", "string", "of amounts")]
    return {
        "nodes": (
            [*head, *kinds],
            ([n.id, n.label, n.role.value, str(n.stores).lower()] for n in network.nodes),
        ),
        "arcs": (
            [*head, *ends, ("law", "string", "how much it carries")],
            ([a.id, a.label, a.donor, a.recipient, a.law.value] for a in network.arcs),
        ),
        "stocks": (
            [begin, ("node", "string", "id"), ("stock", "number", mass)],
            rows("stock"),
        ),
        "flows": (
            [interval, ("arc", "string", "id"), ("flow", "number", f"{mass}/{network.time_unit}, mean")],
            rows("flow"),
        ),
        "services": (
            [interval, ("service", "string", "id"), ("level", "number", "part of what is demanded")],
            rows("service"),
        ),
        "circularity": (
            [interval, ("circularity", "number", f"{mass}, mean of λ")],
            ([t, value] for t, _, value in rows("circularity")),
        ),
        "accounts": (
            [interval, *account, ("amount", "number", "not discounted")],
            ([t, a.id, id_, a.unit, row[e]] for t, row in enumerate(run.entries) for e, (a, id_) in enumerate(entries)),
        ),
        **{
            f"content_{substance.id}": (
                [interval, ("compartment", "string", "id"), part],
                rows("content", substance.id),
            )
            for substance in network.substances
        },
    }


def read_package(folder: str | Path) -> EpisodePackage:
    """Read what ``write_package`` wrote.

    Raises:
        CirlError: for a file that is missing or says something else; names the file, the row and what was expected.
    """
    folder = Path(folder)
    package = read_record(folder / PACKAGE)
    resources = package.get("resources")
    names = [part.get("name") for part in resources if isinstance(part, dict)] if isinstance(resources, list) else []
    network = load_network(folder / DEFINITION)

    def table(name: str, columns: Sequence[str], ids: Sequence[str], first: int = 0) -> Floats:
        """Return the numbers of a table by interval and the ids of a column."""
        check_names("table", [name], names, f"{folder / PACKAGE}: resources: ")
        return _numbers(folder / f"{name}.csv", columns, ids, network.episode.horizon + first)

    def ids(parts: Iterable[Any]) -> list[str]:
        return [part.id for part in parts]

    return EpisodePackage(
        network,
        str(package.get("scenario", network.scenario_name)),
        str(package.get("control", "")),
        table("stocks", ("node", "stock"), ids(network.stores), 1),
        table("flows", ("arc", "flow"), ids(network.arcs)),
        table("services", ("service", "level"), ids(network.services)),
        table("circularity", ("", "circularity"), [""])[:, 0],
        table("accounts", ("account", "amount"), ids(network.accounts)),
        np.array(
            [
                table(f"content_{s}", ("compartment", "content"), [*network.compartments])
                for s in ids(network.substances)
            ]
        )
        .reshape(len(network.substances), network.episode.horizon, len(network.compartments))
        .transpose(1, 0, 2),
    )


def _numbers(path: Path, columns: Sequence[str], ids: Sequence[str], intervals: int) -> Floats:
    """Return the numbers of a table, shape (intervals, ids); amounts on accounts are added up."""
    if not path.is_file():
        raise CirlError(f"{path}: no such file")
    adds = columns[0] == "account"
    rows = CsvRows(str(path), read_content(path))
    header, numbers = rows[0], np.full((intervals, len(ids)), 0.0 if adds else np.nan)
    check_names("column", filter(None, ("interval", *columns)), header, f"{path}: ")
    places = [header.index(column) for column in ("interval", *columns) if column]
    rank = {id_: place for place, id_ in enumerate(ids)}
    for line, cells in zip(rows.lines[1:], rows.columns(places), strict=True):
        interval, id_, cell = (cells[0], "", cells[1]) if len(cells) == 2 else cells
        number = number_in(cell)
        if not interval.isdecimal() or int(interval) >= intervals:
            raise CirlError(f"{path}, line {line}: interval {interval!r} is none of 0 to {intervals - 1}")
        if id_ not in rank:
            raise CirlError(f"{path}, line {line}: {unknown_name(columns[0], id_, ids)}")
        if not np.isfinite(number):
            raise CirlError(f"{path}, line {line}: {columns[1]} {cell!r} is no finite number")
        place = int(interval), rank[id_]
        if not adds and not np.isnan(numbers[place]):
            raise CirlError(f"{path}, line {line}: {columns[1]} of {id_ or 'the network'} comes a second time")
        numbers[place] = numbers[place] + number if adds else number
    if np.isnan(numbers).any():
        interval, place = np.argwhere(np.isnan(numbers))[0]
        raise CirlError(f"{path}: no {columns[1]} of {ids[place] or 'the network'} in interval {interval}")
    return numbers
