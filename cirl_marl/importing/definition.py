"""From flows that balance to a definition file and its data, as an engineer would have written them."""

from __future__ import annotations

import json
import re
import unicodedata
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cirl_marl.errors import CirlError
from cirl_marl.importing.balances import Processes, ProcessKind
from cirl_marl.importing.flow_table import Connection
from cirl_marl.network import Floats
from cirl_marl.network.declarations import positional_record, with_field_docs
from cirl_marl.network.elements import Role

ALIKE = 1e-7
"""Part of the largest amount of a substance by which amounts may differ that count as alike, as tables are rounded."""
SMALL = 1e-300


@positional_record
class ImportedFiles:
    """The files of an imported network."""

    text: Annotated[str, "the definition"]
    data: Annotated[list[list[object]], "the data file: by region and year flows, or shares of what leaves a process"]
    regions: Annotated[
        list[list[object]], "by region reference flow and stock, and first stocks; empty without regions"
    ]
    arcs: Annotated[Mapping[Connection, str], "id of the arc of each pair"]


def identifier(text: str, kind: str = "process") -> str:
    """Return what a process is called in files: lower case, without accents, words joined by ``_``.

    ``kind`` comes first where there is no letter to begin with.

    >>> identifier("Market of Ingots & semis")
    'market_of_ingots_semis'
    """
    plain = unicodedata.normalize("NFKD", text).encode("ascii", "ignore").decode().lower()
    words = re.sub(r"[^a-z0-9]+", "_", plain).strip("_")
    return words if words[:1].isalpha() else f"{kind}_{words}".rstrip("_")


def identifiers(texts: Iterable[str]) -> dict[str, str]:
    """Return an identifier for each text, no two alike."""
    result: dict[str, str] = {}
    for text in texts:
        first = identifier(text)
        number, name = 2, first
        while name in result.values():
            number, name = number + 1, f"{first}_{number}"
        result[text] = name
    return result


def shares_of(flows: Floats) -> Floats:
    """Return the shares of outflows of a process, shape (regions, years, arcs), of flows of that shape.

    Where nothing leaves they are those of the nearest year of the region with any, the earlier of two; without any,
    those of all regions and years together.
    """
    total = flows.sum(axis=2, keepdims=True)
    overall = flows.sum(axis=(0, 1)) / flows.sum()
    shares = np.divide(flows, total, out=np.broadcast_to(overall, flows.shape).copy(), where=total > 0)
    years = np.arange(flows.shape[1])
    for region, active in enumerate(total[:, :, 0] > 0):
        if active.any():
            active_years = years[active]
            nearest = active_years[np.abs(active_years[None] - years[:, None]).argmin(axis=1)]
            shares[region] = shares[region, nearest]
    return np.asarray(shares)


@with_field_docs
@dataclass(kw_only=True)
class DefinitionWriter:
    """Writes the definition of a network whose neutral simulation gives back the flows of a table.

    Flows from sources and stores are series; what passes through a process without stock is shared out as it was.
    Where nothing passed, the shares are those of the nearest year with any, or of all regions together.
    """

    processes: Annotated[Processes, "of a table of flows that balance"]
    roles: Annotated[Mapping[str, Role], "of sources, sinks and stores; others belong to the technosphere"]
    stocks: Annotated[Mapping[tuple[str, str, int], float], "by region, process and year, at its end"]
    stock_contents: Annotated[
        Mapping[str, Mapping[tuple[str, str, int], float]], "what part of stocks each substance is, likewise"
    ]
    name: Annotated[str, "of the network, and of the data file"]
    title: Annotated[str, "in words"]
    source: Annotated[str, "where the numbers come from"]

    def __post_init__(self) -> None:
        """Name nodes, arcs and regions."""
        processes = self.processes
        self.table = table = processes.table
        self._mass = table.unit.rpartition("/")[0]
        self._regional = table.regions != ("",)
        self._nodes = identifiers(processes.names)
        between: dict[tuple[str, str], list[Connection]] = {}
        for pair in table.pairs:
            between.setdefault((pair.source, pair.target), []).append(pair)
        texts = {
            pair: f"{pair.source} to {pair.target}" + (f" {pair.type}" if len(group) > 1 else "")
            for group in between.values()
            for pair in group
        }
        names = identifiers(texts.values())
        self._arcs = {pair: names[texts[pair]] for pair in table.pairs}
        self._regions = identifiers(table.regions) if self._regional else {}
        self._substances: dict[str, Floats] = {}
        self._substance_names: dict[str, str] = {}
        if table.substances is not None:
            ids = identifiers(table.substances.names)
            self._substance_names = {id_: name for name, id_ in ids.items()}
            self._substances = {ids[name]: amounts for name, amounts in zip(ids, table.substances.amounts, strict=True)}
        self._separate_sources()
        self._handed_on = self._splits()

    def _separate_sources(self) -> None:
        """Give each arc a source of its own where what a source gives differs from arc to arc."""
        self._donors = {pair: self._nodes[pair.source] for pair in self.table.pairs}
        self._sources: dict[str, list[Connection]] = {}
        titles: dict[Connection, str] = {}
        for process in self.processes.of(ProcessKind.SOURCE):
            pairs = self._pairs_from(process)
            if self._is_alike(pairs):
                self._sources[self._nodes[process]] = pairs
            elif process in {name for _, name, _ in self.stocks}:
                fault = f"what leaves '{process}' differs in content, which makes it a source for each flow"
                raise CirlError(f"stocks: {fault}; leave its stock out, or give each part of it a name in both tables")
            else:
                titles |= {pair: f"{process} for {pair.target} {pair.type}".rstrip() for pair in pairs}
        ids = identifiers([*self._nodes.values(), *self._arcs.values(), *titles.values()])
        self._titles = {ids[title]: (title, pair.source) for pair, title in titles.items()}
        for pair, title in titles.items():
            self._donors[pair] = ids[title]
            self._sources[ids[title]] = [pair]

    def _pairs_from(self, process: str) -> list[Connection]:
        return [pair for pair in self.table.pairs if pair.source == process]

    def _of_pairs(self, table: Floats, pairs: Sequence[Connection]) -> Floats:
        """Return the columns of flows of some pairs, shape (regions, years, pairs)."""
        places = [k for k, pair in enumerate(self.table.pairs) if pair in pairs]
        return np.asarray(table[:, :, places])

    def _is_alike(self, pairs: Sequence[Connection]) -> bool:
        """Whether flows have the same contents at all times."""
        flows = self._of_pairs(self.processes.flows, pairs)
        for amounts in self._substances.values():
            parts = self._of_pairs(amounts, pairs)
            mean = parts.sum(axis=2, keepdims=True) * flows / flows.sum(axis=2, keepdims=True).clip(SMALL)
            if (np.abs(parts - mean) > ALIKE * amounts.max()).any():
                return False
        return True

    def _contents(self, pairs: Sequence[Connection]) -> dict[str, Floats]:
        """Return the content of flows together by substance, (regions, years); without flow that of a near year."""
        flows = self._of_pairs(self.processes.flows, pairs).sum(axis=2)
        contents = {}
        for id_, amounts in self._substances.items():
            parts = self._of_pairs(amounts, pairs).sum(axis=2)
            both = np.stack([parts, np.maximum(flows - parts, 0.0)], axis=2)
            contents[id_] = shares_of(both)[..., 0] if flows.any() else parts
        return contents

    def _splits(self) -> dict[str, Floats]:
        """Return the columns of the data file of what processes without stock hand on: shares and transfers."""
        columns: dict[str, Floats] = {}
        whole, parts = self.processes.flows, self._substances
        remainder = np.maximum(whole - sum(parts.values(), np.zeros_like(whole)), 0.0) if parts else whole
        for process in self.processes.of(ProcessKind.TRANSIT):
            pairs = self._pairs_from(process)
            rest = self._of_pairs(remainder, pairs)
            shares = shares_of(rest if rest.any() else self._of_pairs(whole, pairs))
            arcs = [self._arcs[pair] for pair in pairs]
            columns |= {arc: shares[:, :, k] for k, arc in enumerate(arcs)}
            for id_, table in parts.items():
                amounts = self._of_pairs(table, pairs)
                through = amounts.sum(axis=2, keepdims=True)
                if (np.abs(amounts - shares * through) > ALIKE * table.max()).any():
                    transfers = shares_of(amounts)
                    columns |= {f"{arc} {id_}": transfers[:, :, k] for k, arc in enumerate(arcs)}
        return columns

    def files(self) -> ImportedFiles:
        """Write everything."""
        lines = [*self._head(), *self._node_tables(), *self._arc_tables()]
        return ImportedFiles("\n".join(lines) + "\n", self._data(), self._of_regions(), self._arcs)

    def _head(self) -> Iterator[str]:
        years, unit, source = self.table.years, self.table.unit, _text(self.source)
        yield "# Made by cirl import, and yours to change: `cirl check` names mistakes."
        yield f"name = {_text(self.name)}"
        yield f"title = {_text(self.title + (' of {region}' if self._regional else ''))}"
        yield 'material = "not stated"'
        yield f"references = [{source}]"
        yield from ("", "[units]", f"mass = {_text(self._mass)}", 'time = "year"')
        if self._regional:
            yield from ("", "[regions]")
            yield from (f"{id_} = {_text(region)}" for region, id_ in self._regions.items())
        flow, stock = self._references()[0]
        yield from ("", "[scales]")
        yield f"stock = {self._scale('stock', stock, self._mass, 'the largest flow, times the years')}"
        yield f"flow = {self._scale('flow', flow, unit, 'the largest flow')}"
        for id_, amounts in self._substances.items():
            largest = float(np.max(amounts.sum(axis=(1, 2)) / self.processes.flows.sum(axis=(1, 2)))) or 1.0
            scale = f'{{ value = {largest:.2g}, unit = "1", source = "its mean content" }}'
            yield from ("", f"[substances.{id_}]", f"scale = {scale}")
        yield from ("", "[episode]", f"start = {years[0]}")
        yield 'control_interval = { value = 1, unit = "year", source = "the table has years" }'
        yield f'horizon = {{ value = {len(years)}, unit = "1", source = "{years[0]} to {years[-1]}" }}'
        yield from ("", "[objective]")
        yield 'reference_interval = { value = 1, unit = "year", source = "chosen: flows of a year" }'
        yield f"circularity_scale = {self._scale('flow', flow, self._mass, 'the largest flow, for a year')}"
        yield 'circularity_weight = { value = 0.5, unit = "1", source = "chosen" }'
        yield from ('net_zero = "signed"', 'reward = "mixed"', "", "[observation]", 'mode = "local"')

    def _references(self) -> list[tuple[float, float]]:
        """Return reference flow and stock of each region, to two digits."""
        largest = self.processes.flows.max(axis=(1, 2))
        return [
            (_round_significant(flow), _round_significant(flow * len(self.table.years))) for flow in largest.tolist()
        ]

    def _of_regions(self) -> list[list[object]]:
        """Return what differs from region to region and not from year to year, a row for each."""
        if not self._regional:
            return []
        stores = [process for process in self.processes.of(ProcessKind.STORE) if self._first_stocks(process)]
        contents = {
            f"content of {substance} in {self._nodes[store]}": content
            for store in self.processes.of(ProcessKind.STORE)
            for substance, (content, _) in self._first_contents(store).items()
        }
        rows: list[list[object]] = [
            ["region", "flow", "stock", *(f"stock of {self._nodes[store]}" for store in stores), *contents]
        ]
        for r, (region, scales) in enumerate(zip(self.table.regions, self._references(), strict=True)):
            stocks = [self._first_stocks(store)[region] for store in stores]
            rows.append([region, *scales, *stocks, *(content[r] for content in contents.values())])
        return rows

    def _scale(self, column: str, value: float, unit: str, source: str) -> str:
        if not self._regional:
            return f"{{ value = {value:g}, unit = {_text(unit)}, source = {_text(source)} }}"
        return f"{{ {self._of_region(column)}, unit = {_text(unit)}, source = {_text(source)} }}"

    def _of_region(self, column: str) -> str:
        return f'file = "{self.name}_regions.csv", column = "{column}", where = {{ region = "{{region}}" }}'

    def _node_tables(self) -> Iterator[str]:
        for id_, (title, process) in self._titles.items():
            yield from ("", f"[nodes.{id_}]", f"title = {_text(title)}")
            yield f'role = "{self.roles.get(process, Role.TECHNOSPHERE).value}"'
            yield from self._stated_contents(id_)
        for process, id_ in self._nodes.items():
            kind = self.processes.kinds[process]
            if kind is ProcessKind.SOURCE and id_ not in self._sources:
                continue  # which stands above, by arcs
            yield from ("", f"[nodes.{id_}]")
            if id_ != process:
                yield f"title = {_text(process)}"
            yield f'role = "{self.roles.get(process, Role.TECHNOSPHERE).value}"'
            if kind is ProcessKind.TRANSIT:
                yield "stores = false"
            elif kind is ProcessKind.SINK:
                since = _text(f"counted from {self.table.years[0]}")
                yield f"initial = {{ low = 0, high = 0, unit = {_text(self._mass)}, source = {since} }}"
            elif stock := self._initial(process):
                yield stock
            elif kind is ProcessKind.STORE:
                yield "# no initial stock is known: it starts with what leaves it in all these years"
            if kind is ProcessKind.SOURCE:
                yield from self._stated_contents(id_)
            elif kind is ProcessKind.STORE:
                for substance, (content, text) in self._first_contents(process).items():
                    place, source = f"value = {_short(content[0])}", _text(text)
                    if self._regional:
                        place = self._of_region(f"content of {substance} in {id_}")
                    yield f'content.{substance} = {{ {place}, unit = "1", source = {source} }}'

    def _first_contents(self, process: str) -> dict[str, tuple[Floats, str]]:
        """Return the content of a store at first by substance and region, and its source: of its stock, if known."""
        before, outflow_text = self.table.years[0] - 1, f"of what leaves it in {self.table.years[0]}"
        contents = {}
        for substance, content in self._contents(self._pairs_from(process)).items():
            of_stocks = self.stock_contents.get(self._substance_names[substance], {})
            keys = [(region, process, before) for region in self.table.regions]
            parts = [of_stocks.get(key, part) for key, part in zip(keys, content[:, 0].tolist(), strict=True)]
            texts = dict.fromkeys(self.source if key in of_stocks else outflow_text for key in keys)
            contents[substance] = np.array(parts), "; ".join(texts)
        return contents

    def _stated_contents(self, source: str) -> Iterator[str]:
        """Yield the contents of a source: numbers where they stay the same."""
        for substance, content in self._contents(self._sources[source]).items():
            if (content == content[0, 0]).all():
                value = f"value = {_short(content[0, 0])}"
                yield f'content.{substance} = {{ {value}, unit = "1", source = {_text(self.source)} }}'
            else:
                yield f"content.{substance} = {self._column(f'{source} {substance}', '1')}"

    def _initial(self, process: str) -> str:
        """Return the initial stock of a store, if it is known."""
        if not (stocks := self._first_stocks(process)):
            return ""
        unit_and_source = f"unit = {_text(self._mass)}, source = {_text(self.source)}"
        if not self._regional:
            return f"initial = {{ low = {stocks['']!r}, high = {stocks['']!r}, {unit_and_source} }}"
        return f"initial = {{ {self._of_region(f'stock of {self._nodes[process]}')}, {unit_and_source} }}"

    def _first_stocks(self, process: str) -> dict[str, float]:
        """Return the stock at the end of the year before the first by region; nothing if one is not known."""
        before = self.table.years[0] - 1
        keys = {region: (region, process, before) for region in self.table.regions}
        return {r: self.stocks[k] for r, k in keys.items()} if self.stocks.keys() >= {*keys.values()} else {}

    def _arc_tables(self) -> Iterator[str]:
        for pair, id_ in self._arcs.items():
            yield from ("", f"[arcs.{id_}]")
            if pair.type:
                yield f"title = {_text(pair.type)}"
            yield from (f'from = "{self._donors[pair]}"', f'to = "{self._nodes[pair.target]}"')
            if self.processes.kinds[pair.source] is not ProcessKind.TRANSIT:
                yield from ('law = "exogenous"', f"flow = {self._column(id_, self.table.unit)}")
            elif self._rest(pair):
                yield from ('law = "share"', 'share = "rest"')
            else:
                yield from ('law = "share"', f"share = {self._column(id_, '1')}")
                columns = {substance: f"{id_} {substance}" for substance in self._substances}
                yield from (
                    f"transfer.{substance} = {self._column(column, '1')}"
                    for substance, column in columns.items()
                    if column in self._handed_on
                )

    def _rest(self, pair: Connection) -> bool:
        """Whether the share of a pair is what the others leave: of the largest flow out of its process."""
        total = self.processes.flows.sum(axis=(0, 1))
        of = [k for k, arc in enumerate(self.table.pairs) if arc.source == pair.source]
        return self.table.pairs[max(of, key=lambda k: total[k])] == pair

    def _column(self, arc: str, unit: str) -> str:
        region = 'where = { region = "{region}" }, ' if self._regional else ""
        place = f'file = "{self.name}.csv", column = "{arc}", {region}'
        return f"{{ {place}unit = {_text(unit)}, source = {_text(self.source)} }}"

    def _data(self) -> list[list[object]]:
        """Return header and rows of the data file, in the order of regions and years."""
        table = self.table
        columns = {arc: self.processes.flows[:, :, k] for k, arc in enumerate(self._arcs.values())} | self._handed_on
        for source, pairs in self._sources.items():
            columns |= {f"{source} {substance}": content for substance, content in self._contents(pairs).items()}
        values = np.stack([*columns.values()], axis=2)
        rows: list[list[object]] = [[*(["region"] if self._regional else []), "year", *columns]]
        for region, of_region in zip(table.regions, values.tolist(), strict=True):
            for year, row in zip(table.years, of_region, strict=True):
                rows.append([*([region] if self._regional else []), year, *map(_short, row)])
        return rows


def _text(text: str) -> str:
    return json.dumps(text, ensure_ascii=False).replace("\x7f", "\\u007f")  # which TOML does not have in texts


def _short(value: float) -> str:
    """Write a number as short as it reads back to the same."""
    return repr(float(value)).removesuffix(".0")


def _round_significant(value: float) -> float:
    return float(f"{value:.2g}") or 1.0
