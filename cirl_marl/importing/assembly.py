"""Import a table of flows: read, classify, reconcile, write, and check that the network gives the table back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Annotated

import numpy as np

from cirl_marl.controllers.basic import Neutral
from cirl_marl.controllers.rollout import Rollout, episode_start
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, check_names, first_lines, unknown_name
from cirl_marl.importing.balances import Change, Processes, ProcessKind, Reconciliation, Residual
from cirl_marl.importing.definition import DefinitionWriter, ImportedFiles, identifiers
from cirl_marl.importing.flow_table import FlowTable, StockKey, read_flows, read_stocks
from cirl_marl.importing.grids import plain_text
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import Role
from cirl_marl.records.files import publish_folder, write_table

TABLES = ("", "_regions", "_changes")
"""What the names of tables beside a definition end with."""
NOTICEABLE = 1e-6
"""Part of the largest flow of a region below which the content of a flow does not count."""
WRONG = 1e-5
"""Part of the largest flow of a region by which a simulated flow may miss the table."""

StockContents = Mapping[str, Mapping[StockKey, float]]
"""What part of stocks each substance is, by its name."""

Ask = Callable[[str, ProcessKind], Role]
"""Returns the role of a source or a sink."""


@positional_record
class ImportReport:
    """What an import found and wrote."""

    processes: Annotated[Processes, "what each process is, of the flows as they were reconciled"]
    roles: Annotated[Mapping[str, Role], "of sources, sinks and stores"]
    reconciliation: Annotated[Reconciliation | None, "how flows were adjusted; None if they balanced"]
    stock_mistakes: Annotated[Mapping[str, float], "by store how far its stocks and flows are apart at most, mass"]
    largest_error: Annotated[float, "largest difference between a simulated flow and the table, mass/time"]
    content_error: Annotated[float, "largest difference between a simulated content and the tables, as stores mix"]
    files: Annotated[tuple[Path, ...], "what was written, the definition first"]

    @property
    def table(self) -> FlowTable:
        """The flows, as they were reconciled."""
        return self.processes.table

    @property
    def changes(self) -> tuple[Change, ...]:
        """Flows that were adjusted."""
        return () if self.reconciliation is None else self.reconciliation.changes


def import_flows(
    flows: str | Path,
    out: str | Path,
    stocks: str | Path | None = None,
    *,
    roles: Mapping[str, Sequence[str]],
    stores: Sequence[str] = (),
    regions: Sequence[str] = (),
    ask: Ask | None = None,
    reconcile: bool = False,
    sheet: str | None = None,
    unit: str | None = None,
    year: int | None = None,
    title: str = "",
    source: str = "",
    progress: Callable[[float], None] = lambda share: None,
) -> ImportReport:
    """Write the definition of the network that a table of flows describes, and its data beside it; all or nothing.

    Args:
        flows: the table, see ``read_flows``.
        out: the definition file to write; it must not exist.
        stocks: a table of stocks, at the ends of years; see ``read_stocks``.
        roles: by role (see ``Role``) the processes that have it; ``*`` stands for any text.
        stores: processes that hold a stock, likewise.
        regions: those to take; none means all.
        ask: gives the role of a source or sink that ``roles`` do not name; None: that is an error.
        reconcile: whether to adjust flows so that every process without stock balances.
        sheet: as ``read_flows`` takes it.
        unit: likewise.
        year: likewise.
        title: in words; the name of the file if empty.
        source: where the numbers come from; the name of the table if empty.
        progress: called with the share that is done.

    Raises:
        CirlError: naming file, line and value, or what does not balance, with what to do; nothing is written.
    """
    flows, out, stocks = Path(flows), Path(out), None if stocks is None else Path(stocks)
    if out.suffix != ".toml":
        raise CirlError(f"--out {out}: needs the name of a .toml file")
    name = identifiers([out.stem])[out.stem]
    if name != out.stem:
        raise CirlError(f"--out {out}: the name of a network has lower case letters, digits and _, as {name}.toml")
    for path in (out, *(out.with_name(f"{name}{end}.csv") for end in TABLES)):
        if path.exists():  # the table of flows itself, perhaps
            fault = f"{path.name} exists, and may have been changed by hand"
            raise CirlError(f"--out {out}: {fault}; choose another name, or remove it")
    table = read_flows(flows, sheet=sheet, unit=unit, year=year)
    if regions:
        table = table.of(regions)
    known_stocks, contents = ({}, {}) if stocks is None else read_stocks(stocks, table.unit.rpartition("/")[0])
    substances = () if table.substances is None else table.substances.names
    check_names("substance", contents, substances, "stocks: ")
    holders = _matching_processes(table, [*stores, *_stock_processes(table, known_stocks)], "store")
    processes = Processes(table, holders).mix_substances()
    _check_stores(processes, stores)
    _check_first_stocks(processes, known_stocks)
    _check_stock_contents(stocks, processes, contents)
    reconciliation: Reconciliation | None = None
    residuals = processes.residuals
    if not reconcile:
        processes.check_contents()
        if residuals:
            raise CirlError(_imbalance_message(table, residuals))
    elif residuals:
        processes, reconciliation = processes.reconcile()
        processes = processes.mix_substances()
    if reconcile and table.substances is not None:
        processes, of_substances = processes.reconcile_substances()
        reconciliation = of_substances if reconciliation is None else reconciliation + of_substances
    role_of = _roles(processes, roles, ask)
    writer = DefinitionWriter(
        processes=processes,
        roles=role_of,
        stocks=known_stocks,
        stock_contents=contents,
        name=name,
        title=title or name,
        source=(source or f"imported from {flows.name}") + ("" if reconciliation is None else ", reconciled"),
    )
    definition = writer.files()
    changes = () if reconciliation is None else reconciliation.changes
    with publish_folder(out.parent, last=out.name) as partial:
        files = _write(partial, out.name, name, definition, changes)
        try:
            error, content_error = _largest_errors(partial / out.name, processes, contents, definition, progress)
        except CirlError as failure:
            raise CirlError(str(failure).replace(str(partial), str(out.parent))) from failure
    mistakes = processes.stock_mistakes(known_stocks)
    paths = tuple(out.parent / file for file in files)
    return ImportReport(processes, role_of, reconciliation, mistakes, error, content_error, paths)


def _check_stores(processes: Processes, names: Sequence[str]) -> None:
    """Raise a ``CirlError`` for a process that is named as a store though the table makes it a source or a sink."""
    for name in names:
        kind = processes.kinds.get(name)
        if kind in (ProcessKind.SOURCE, ProcessKind.SINK):
            reason = "nothing enters it, so that it is a source" if kind is ProcessKind.SOURCE else "nothing leaves it"
            if kind is ProcessKind.SINK:
                reason += ", so that it is a sink, whose stock is what has entered"
            options = "--reservoir, --environment or --outside"
            options = options if kind is ProcessKind.SOURCE else f"--landfill, --incinerator, {options[13:]}"
            raise CirlError(f"--store {name}: in the table {reason}; say what it is with {options}")


def _matching_processes(table: FlowTable, patterns: Sequence[str], label: str) -> list[str]:
    """Return the processes that names or patterns stand for; a ``CirlError`` for one that stands for none."""
    names = list(dict.fromkeys(end for pair in table.pairs for end in (pair.source, pair.target)))
    processes: list[str] = []
    for pattern in map(plain_text, patterns):
        matches = [name for name in names if fnmatchcase(name, pattern)]
        if not matches:
            raise CirlError(f"{table.name}: {label}: {unknown_name('process', pattern, names)}")
        processes += matches
    return list(dict.fromkeys(processes))


def _check_stock_contents(path: Path | None, processes: Processes, contents: StockContents) -> None:
    """Refuse contents of stocks that flows alone decide, and of years that are not those of the flows.

    Raises:
        CirlError: naming the table, the substance and the process.
    """
    remedies = {
        ProcessKind.SOURCE: "is a source, and has what leaves it; give the content of its flows",
        ProcessKind.SINK: "is a sink, and is empty at the start; leave it out",
    }
    before, last = processes.table.years[0] - 1, processes.table.years[-1]
    for substance, parts in contents.items():
        for (_, process, year), part in parts.items():
            subject = f"{path}: {part:.4g} of '{process}' in {year} is {substance}, but"
            if remedy := remedies.get(processes.kinds[process]):
                raise CirlError(f"{subject} it {remedy}")
            if not before <= year <= last:
                years = f"the start, the end of {before}, and ends of years to {last}"
                raise CirlError(f"{subject} contents of stocks are of {years}; leave it out")


def _check_first_stocks(processes: Processes, stocks: Mapping[StockKey, float]) -> None:
    """Refuse stocks of processes of which none is that at the start, as they would start with another.

    Raises:
        CirlError: naming the first of them.
    """
    before, kinds = processes.table.years[0] - 1, (ProcessKind.STORE, ProcessKind.SOURCE)
    at_start = {process for _, process, year in stocks if year == before}
    for _, process, year in stocks:
        if process not in at_start and processes.kinds[process] in kinds:
            fault = f"'{process}' has one of {year} and none of {before}, with which it starts"
            raise CirlError(f"stocks: {fault}; give it: stocks are those at ends of years")


def _stock_processes(table: FlowTable, stocks: Mapping[tuple[str, str, int], float]) -> list[str]:
    check_names("region", (region for region, _, _ in stocks), table.regions, "stocks: ")
    return list(dict.fromkeys(process for _, process, _ in stocks))


def _roles(processes: Processes, roles: Mapping[str, Sequence[str]], ask: Ask | None) -> dict[str, Role]:
    """Return the roles of processes; sources and sinks all have one."""
    table, role_of = processes.table, dict[str, Role]()
    for role, patterns in roles.items():
        for name in _matching_processes(table, patterns, role):
            if role_of.setdefault(name, Role(role)) is not Role(role):
                raise CirlError(f"'{name}' is given two roles, {role_of[name].value} and {role}; leave one out")
            if processes.kinds[name] is ProcessKind.TRANSIT and Role(role) is not Role.TECHNOSPHERE:
                raise CirlError(f"'{name}' is given the role {role}, but what enters it leaves it; it has none")
    unclear = [name for name in processes.of(ProcessKind.SOURCE, ProcessKind.SINK) if name not in role_of]
    if unclear and ask is None:
        labels = "; ".join(f"'{name}' ({processes.kinds[name].value})" for name in unclear)
        choices = "--reservoir, --landfill, --incinerator, --environment, or --outside (trade, other economies)"
        raise CirlError(f"{table.name}: what is {labels}? Say so by {choices}, such as --outside 'Imports of *'")
    for name in unclear:
        assert ask is not None
        role_of[name] = ask(name, processes.kinds[name])
    return role_of


def _imbalance_message(table: FlowTable, residuals: Sequence[Residual]) -> str:
    """Say what does not balance."""
    names = dict.fromkeys(residual.process for residual in residuals)
    lines = [f"  {line}" for line in first_lines(list(map(str, residuals)))]
    remedy = "Name those that hold a stock with --store, or adjust the flows with --reconcile"
    count = "1 process does" if len(names) == 1 else f"{len(names)} processes do"
    headline = f"{table.name}: {count} not balance ({table.unit}); the largest residuals are"
    return "\n".join([headline, *lines, f"{remedy}; nothing was written."])


def _write(folder: Path, file: str, name: str, definition: ImportedFiles, changes: Sequence[Change]) -> list[str]:
    """Write the files and return their names."""
    header = ["region", "year", "source", "target", "type", "before", "after", "deviation", "in deviations"]
    of_substances = any(change.substance for change in changes)
    header += ["substance"] * of_substances
    change_rows = [
        [c.region, c.year, *c.pair, c.before, c.after, c.deviation, c.in_deviations, *[c.substance] * of_substances]
        for c in sorted(changes, key=lambda change: -abs(change.after - change.before))
    ]
    tables: list[list[list[object]]] = [
        definition.data,
        definition.regions,
        [[*header], *change_rows] if changes else [],
    ]
    (folder / file).write_text(definition.text, encoding="utf-8")
    non_empty = {f"{name}{end}.csv": rows for end, rows in zip(TABLES, tables, strict=True) if rows}
    for table, rows in non_empty.items():
        write_table(folder / table, list(map(str, rows[0])), rows[1:])
    return [file, *non_empty]


def _largest_errors(
    path: Path,
    processes: Processes,
    stock_contents: StockContents,
    definition: ImportedFiles,
    progress: Callable[[float], None],
) -> tuple[float, float]:
    """Simulate every region without agents, and return how far a flow, and a content, is from the tables.

    Raises:
        CirlError: for a flow that the network does not give back, or without stores a content.
    """
    table, worst, worst_content = processes.table, 0.0, 0.0
    ids = identifiers(table.regions) if table.regions != ("",) else {"": ""}
    flows = table.grid(table.values)
    for done, (region, id_) in enumerate(ids.items()):
        network = load_network(f"{path}:{id_}" if id_ else path)
        env = MultiAgentVectorEnv(network, num_envs=1)
        run = episode_start(env).play(env, Neutral())
        table_flows = flows[done]
        order = [network.arc_index[arc] for arc in definition.arcs.values()]
        errors = np.abs(run.flow[:, order] - table_flows)
        if errors.max() > WRONG * table_flows.max():
            y, k = np.unravel_index(int(errors.argmax()), errors.shape)
            pair = [*definition.arcs][int(k)]
            value = run.flow[y, order[int(k)]]
            label = f"{table.years[int(y)]}{f' in {region}' if region else ''}"
            contents = run.contents[y][:, len(network.nodes) + np.array(order)]
            cause = _mixed_store(processes, contents, (done, int(y)))
            raise CirlError(
                f"{table.name}: the network does not give back {pair} in {label}: {value:g}, not {table_flows[y, k]:g} "
                f"{table.unit}; {cause or 'a store may run empty: give stocks'}"
            )
        worst = max(worst, float(errors.max()))
        if table.substances is not None:
            places = len(network.nodes) + np.array(order)
            amounts = run.contents[:, :, places].swapaxes(0, 1) * run.flow[:, order]
            errors = np.abs(amounts - table.substances.amounts[:, done])
            flows_of_year = np.maximum(table_flows, NOTICEABLE * table_flows.max())
            s, y, k = np.unravel_index(int((errors / flows_of_year).argmax()), errors.shape)
            of_stocks = _content_errors(network, run, processes, stock_contents, region)
            worst_content = max(worst_content, float((errors / flows_of_year)[s, y, k]), *of_stocks)
            sizes = table.substances.amounts[:, done].max(axis=(1, 2), keepdims=True)
            if (errors > WRONG * sizes).any() and not processes.of(ProcessKind.STORE):
                flow = f"{table.substances.names[s]} of {[*definition.arcs][k]} in {table.years[y]}"
                raise CirlError(f"{table.name}: the network does not give back {flow}; does it balance?")
        progress((done + 1) / len(ids))
    return worst, worst_content


def _mixed_store(processes: Processes, contents: Floats, place: tuple[int, int]) -> str:
    """Say which store does not give what the table has, as it mixes all that it holds; empty if none is far off.

    Args:
        processes: of all regions and years.
        contents: parts of substances in its flows, as simulated, shape (substances, pairs).
        place: region and year.
    """
    if (table := processes.table).substances is None:
        return ""
    stores, flow = processes.of(ProcessKind.STORE), table.grid(table.values)[place]
    leaves = np.array([pair.source in stores for pair in table.pairs]) & (flow > 0)
    parts = np.divide(table.substances.amounts[:, *place], flow, out=np.zeros_like(contents), where=flow > 0)
    errors = np.abs(contents - parts) * leaves
    s, k = np.unravel_index(int(errors.argmax()), errors.shape)
    if errors[s, k] <= WRONG * parts[s].max():
        return ""
    fault = f"of {table.pairs[int(k)]} {contents[s, k]:.3g} is {table.substances.names[int(s)]}, not {parts[s, k]:.3g}"
    return f"{fault}: a store mixes what it holds; say what is in all that leaves it, or in its stocks"


def _content_errors(
    network: Network, run: Rollout, processes: Processes, contents: StockContents, region: str
) -> Iterator[float]:
    """Yield how far stocks of a region are, at the ends of years, from the contents that a table has."""
    table, nodes = processes.table, identifiers(processes.names)
    assert table.substances is not None
    for s, substance in enumerate(table.substances.names):
        for (region_of_stock, process, year), part in contents.get(substance, {}).items():
            if region_of_stock == region and year in table.years:
                place = table.years.index(year), s, network.node_index[nodes[process]]
                yield abs(float(run.contents[place]) - part)
