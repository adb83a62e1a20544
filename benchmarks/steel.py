"""The data of ``envs/steel.toml``, and what was measured with it; ``docs/data.md`` has the sources.

python -m benchmarks.steel          # writes envs/steel.csv, steel_history, _regions, _demand and _copper anew
python -m benchmarks.steel --plans  # kept bounds and plans of every country (benchmarks.best_plans), in docs/cycles.md
"""

from __future__ import annotations

import argparse
import csv
import shutil
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import numpy as np
from scipy.interpolate import PchipInterpolator

from benchmarks.best_plans import read_plan, replayed
from benchmarks.document import write_sections
from benchmarks.plans import DOCUMENT as CYCLES
from benchmarks.steel_calibration import Posterior, calibrate, inflow_of
from cirl_marl import MultiAgentVectorEnv, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import episode_start
from cirl_marl.importing.definition import identifiers, shares_of
from cirl_marl.importing.flow_table import FlowTable, read_flows
from cirl_marl.network import Floats, Network
from cirl_marl.optimum import gap
from cirl_marl.records.files import write_table

ROOT = Path(__file__).parent.parent
TABLE = ROOT / "benchmarks" / "data" / "steel_flows_2000_2024.csv"
POPULATION = ROOT / "benchmarks" / "data" / "population.csv"
PRODUCTION = ROOT / "benchmarks" / "data" / "steel_production_1900_2016.csv"
ENVS, DOCUMENT = ROOT / "envs", ROOT / "docs" / "data.md"
YEARS = range(2000, 2025)
RECENT = slice(20, 25)
"""2020 to 2024, whose mean stands for today."""
FUTURE = range(2025, 2051)
FIRST, JOINED = slice(0, 3), slice(98, 101)
"""2000 to 2002 of what goes into use, and 1998 to 2000 of production since 1900: what joins the two."""
SECTORS = {
    "vehicles": (0.22, 20.0),
    "machinery": (0.13, 30.0),
    "construction": (0.43, 75.0),
    "other_products": (0.22, 15.0),
}
"""Share of what goes into use, and mean life in years."""
BEST_COLLECTION = 0.88
"""Recovery of discards in 2050, the four sectors weighted by what goes into use."""

EXOGENOUS = {
    "mining": [("Mining", "Market of iron ore")],
    "ore_imports": [("Imports of iron ore", "Market of iron ore")],
    "pig_iron_imports": [("Imports of pig iron", "Market of pig iron")],
    "dri_imports": [("Imports of direct reduced iron", "Market of direct reduced iron")],
    "scrap_imports": [("Imports of scrap steel", "Market of scrap steel")],
    "semis_imports": [("Imports of ingots and semis", "Market of ingots and semis")],
    "long_imports": [("Imports of long products", "Market of long products")],
    "flat_imports": [("Imports of flat products", "Market of flat products")],
    "goods_imports": [("Imports of end-use goods", "Market of end-use goods")],
    "old_scrap": [("Use phase", "Preparation of scrap steel")],
    "into_use": [("Market of end-use goods", "Use phase")],
}
"""Columns of flows, and the pair of processes of each."""
SPLITS = {
    "Market of iron ore": {
        "ore_to_pig_iron": "Production of pig iron",
        "ore_to_dri": "Production of direct reduced iron",
        "ore_exports": "Exports of iron ore",
    },
    "Production of pig iron": {"pig_iron_made": "Market of pig iron", "pig_iron_losses": "Losses"},
    "Production of direct reduced iron": {"dri_made": "Market of direct reduced iron", "dri_losses": "Losses"},
    "Market of pig iron": {
        "pig_iron_to_bof": "BOF steelmaking",
        "pig_iron_to_eaf": "EAF steelmaking",
        "pig_iron_exports": "Exports of pig iron",
    },
    "Market of direct reduced iron": {"dri_to_eaf": "EAF steelmaking", "dri_exports": "Exports of direct reduced iron"},
    "Preparation of scrap steel": {"scrap_prepared": "Market of scrap steel", "scrap_losses": "Losses"},
    "Market of scrap steel": {
        "scrap_to_eaf": "EAF steelmaking",
        "scrap_to_bof": "BOF steelmaking",
        "scrap_exports": "Exports of scrap steel",
    },
    "BOF steelmaking": {"bof_steel": "Production of ingots and semis", "bof_losses": "Losses"},
    "EAF steelmaking": {"eaf_steel": "Production of ingots and semis", "eaf_losses": "Losses"},
    "Production of ingots and semis": {"cast": "Market of ingots and semis"},
    "Market of ingots and semis": {
        "semis_to_flat": "Production of flat products",
        "semis_to_long": "Production of long products",
        "semis_exports": "Exports of ingots and semis",
    },
    "Production of long products": {
        "long_rolled": "Market of long products",
        "long_scrap": "Preparation of scrap steel",
    },
    "Production of flat products": {
        "flat_rolled": "Market of flat products",
        "flat_scrap": "Preparation of scrap steel",
    },
    "Market of long products": {
        "long_to_goods": "Production of end-use goods",
        "long_exports": "Exports of long products",
    },
    "Market of flat products": {
        "flat_to_goods": "Production of end-use goods",
        "flat_exports": "Exports of flat products",
    },
    "Production of end-use goods": {
        "goods_made": "Market of end-use goods",
        "goods_scrap": "Preparation of scrap steel",
    },
    "Market of end-use goods": {"goods_to_use": "Use phase", "goods_exports": "Exports of end-use goods"},
}
"""What shares out what enters each process: columns, and where each leads; the first takes the rest."""
HALVED = ("scrap_losses", "bof_losses", "eaf_losses", "long_scrap", "flat_scrap", "goods_scrap")
"""Shares that can be halved."""
RANGES = {"scrap_to_bof": (0.5, 1.5), "scrap_exports": (0.0, 1.25)}
"""Shares that agents set, as factors on those of today."""
RICHER = (1.0, 7.0, 20.0)
"""Copper of long products, as a multiple of that of flat ones: melts alike; melts of electric furnaces; at the most."""
EXPORTS = {"semis_exports": "semis_imports", "long_exports": "long_imports"} | {
    "flat_exports": "flat_imports",
    "goods_exports": "goods_imports",
}
"""Steel that is sold abroad, and what is bought of the same."""
EXPORTED = (0.75, 1.5)
"""The shares of it that agents set, as factors on those of as usual."""


WIDTH = 1e-3
"""Least width of a range: an agent has something to set everywhere."""


@dataclass(frozen=True, slots=True)
class Country:
    """Flows of a country in 2000-2024, kt/a, by column."""

    name: str
    flows: Mapping[str, Floats]
    production: Annotated[Floats, "iron and steel that was made, 1900-2016, kt/a"]

    @property
    def earlier_use(self) -> Floats:
        """What went into use in 1900-1999, kt/a, in proportion to what was made."""
        used: Floats = (
            self.production[: JOINED.stop - 1] * self.flows["into_use"][FIRST].mean() / self.production[JOINED].mean()
        )
        return used

    @property
    def primary(self) -> Floats:
        """Iron for the country's own furnaces that leaves a reservoir, by arc, mean of today, kt/a.

        Raw iron that is exported is taken from what is mined, then from what is imported.
        """
        found = np.array([self.flows[each][RECENT].mean() for each in PRIMARY])
        exported = sum(self.flows[each][RECENT].mean() for each in RAW_EXPORTS)
        return np.diff(np.maximum(np.concatenate([[0.0], np.cumsum(found)]) - exported, 0.0))


RAW_EXPORTS = ("ore_exports",)
"""Exported ore counts where iron is made of it, so that there is none in the future."""
PRIMARY = ("mining", "ore_imports", "pig_iron_imports", "dri_imports")
IMPORTS = ("scrap_imports", "semis_imports", "long_imports", "flat_imports", "goods_imports")
"""What is imported beside primary iron: as much of what goes into use as today."""


def countries(table: FlowTable) -> list[Country]:
    """Return the flows of all countries between processes; what differs in type alone is added."""
    pairs = dict(EXOGENOUS)
    pairs |= {arc: [(donor, end)] for donor, arcs in SPLITS.items() for arc, end in arcs.items()}
    summed: dict[tuple[str, str, str], Floats] = {}
    for (region, year, pair), value in table.flows.items():
        series = summed.setdefault((region, pair.source, pair.target), np.zeros(len(YEARS)))
        series[year - YEARS[0]] += value
    known = {ends for each in pairs.values() for ends in each}
    missing = {(source, target) for _, source, target in summed} - known
    if missing:
        raise SystemExit(f"no arc stands for {sorted(missing)}")
    nothing, made = np.zeros(len(YEARS)), production()
    return [
        Country(
            region,
            {arc: sum((summed.get((region, *ends), nothing) for ends in each), nothing) for arc, each in pairs.items()},
            made[region],
        )
        for region in sorted(table.regions)
    ]


def production() -> dict[str, Floats]:
    """Return the iron and steel that each country made in 1900-2016, kt/a."""
    made: dict[str, list[float]] = {}
    with PRODUCTION.open(encoding="utf-8", newline="") as file:
        for line in csv.DictReader(file):
            made.setdefault(line["region"], []).append(float(line["kt"]))
    return {region: np.array(values) for region, values in made.items()}


def shares(country: Country, pooled: Mapping[str, Floats]) -> dict[str, Floats]:
    """Return the share of each arc in what leaves its process, 2000-2024, then that of today."""
    found: dict[str, Floats] = {}
    for arcs in SPLITS.values():
        flows = np.array([country.flows[arc] for arc in arcs]).T
        today = flows[RECENT].sum(axis=0)
        everywhere = np.array([pooled[arc].sum() for arc in arcs])
        staying = np.array([arc not in RAW_EXPORTS for arc in arcs])
        today = today * staying if (today * staying).sum() > 0 else everywhere * staying
        own = shares_of(flows[None])[0] if flows.any() else np.tile(everywhere / everywhere.sum(), (len(YEARS), 1))
        for arc, column in zip(arcs, np.vstack([own, today / today.sum()]).T, strict=True):
            found[arc] = column
    return found


def today(country: Country, pooled: Mapping[str, Floats]) -> dict[str, float]:
    """Return what stands for today, by column: shares, and flows of 2020-2024."""
    found = {arc: float(values[-1]) for arc, values in shares(country, pooled).items()}
    return found | {arc: float(country.flows[arc][RECENT].mean()) for arc in EXOGENOUS}


def calibrated(country: Country, years: slice = slice(0, 25), recent: slice = RECENT) -> Posterior:
    """Return what old scrap of some years says of stocks, lifetimes and collection."""
    return calibrate(
        country.earlier_use, country.flows["into_use"], country.flows["old_scrap"], SECTORS, years=years, recent=recent
    )


def populations() -> dict[str, dict[int, float]]:
    """Return the people of each country by year, as the United Nations project them."""
    people: dict[str, dict[int, float]] = {}
    with POPULATION.open(encoding="utf-8", newline="") as file:
        for line in csv.DictReader(file):
            people.setdefault(line["region"], {})[int(line["year"])] = 1e3 * float(line["thousands"])
    return people


@dataclass(slots=True)
class Calibration:
    """What is calibrated or follows from simulations, in one country."""

    level: float
    """Factor on what went into use before 2000."""
    stretch: float
    """Factor on lifetimes."""
    stock_scale: float = 1.0
    """In use at the end of 2024, kt."""
    collection: float = 0.5
    net_addition: float = 0.0
    """To what is in use, in 2025, kt."""
    exports: float = 1.0
    """Of steel, the least of what is demanded, kt/a."""
    use: Floats = field(default_factory=lambda: np.ones(len(FUTURE)))
    """What goes into use, 2025 to 2050, as a factor on 2025."""

    def demand(self, people: Mapping[int, float]) -> tuple[Floats, Floats]:
        """Return people and stock per head, t, at the end of 2025 to 2051."""
        years = np.array([*FUTURE, FUTURE.stop])
        population = PchipInterpolator([*people], [*people.values()])(np.append(years[0] - 1, years))
        # the growth per head that goes on from what goes into use today fades to none in 2050
        growth = np.log1p(self.net_addition / self.stock_scale) - np.log(population[1] / population[0])
        fading = np.cumsum(1.0 - np.minimum(years - years[0], 25) / 25)
        return population[1:], 1e3 * self.stock_scale / population[0] * np.exp(growth * fading)

    def export_shares(self, now: Mapping[str, float]) -> dict[str, Floats]:
        """Return the shares of exports of steel, 2025 to 2050, at which as much is sold abroad as in 2025.

        Imports follow use. What is rolled follows from the balances of goods, and of long and flat products.

        Args:
            now: shares and flows of today, by column.
        """
        use, sold = now["into_use"] * self.use, {arc: now[arc] for arc in EXPORTS}
        bought = {arc: now[imports] * self.use for arc, imports in EXPORTS.items()}
        rolled = {
            "long_exports": now["semis_to_long"] * (1 - now["long_scrap"]),
            "flat_exports": (1 - now["semis_to_long"]) * (1 - now["flat_scrap"]),
        }
        goods = use[0] * sold["goods_exports"] / (1 - sold["goods_exports"])
        made = (use + goods - bought["goods_exports"]) / (1 - now["goods_scrap"])
        staying = {arc: 1 - sold[arc] for arc in rolled}
        first = made[0] - sum(staying[arc] * bought[arc][0] for arc in rolled)
        first /= sum(staying[arc] * part for arc, part in rolled.items())
        products = {arc: sold[arc] * (part * first + bought[arc][0]) for arc, part in rolled.items()}
        semis = (made + sum(products[arc] - bought[arc] for arc in rolled)) / sum(rolled.values())
        totals = {arc: part * semis + bought[arc] for arc, part in rolled.items()}
        slabs = first * sold["semis_exports"] / (1 - sold["semis_exports"])
        shares = {arc: products[arc] / totals[arc] for arc in rolled}
        shares |= {"goods_exports": goods / (use + goods), "semis_exports": slabs / (semis + slabs)}
        return {arc: np.clip(shares[arc], 0.0, 1.0 - WIDTH) for arc in EXPORTS}


class Files:
    """The data files of some countries, in a folder."""

    def __init__(self, known: Mapping[str, Calibration], everyone: Sequence[Country], folder: Path = ENVS) -> None:
        """Take what stands in files.

        Args:
            known: what is calibrated or follows from simulations, by country.
            everyone: all countries, whose shares stand in where one has none of its own.
            folder: where ``steel.toml`` and its data are.
        """
        self.known, self.folder = known, folder
        self.countries = [each for each in everyone if each.name in known]
        self.pooled = {arc: np.sum([each.flows[arc] for each in everyone], axis=0) for arc in everyone[0].flows}

    def write(self) -> None:
        """Write all of them."""
        self.write_flows()
        self.write_history()
        self.write_regions()
        self.write_demand()
        self.write_copper()

    def write_flows(self) -> None:
        """Write flows and shares; from 2025 on shares are those of today, and imports follow use as usual."""
        rests = {next(iter(arcs)) for arcs in SPLITS.values()}
        columns = [*EXOGENOUS, *(arc for arcs in SPLITS.values() for arc in arcs if arc not in rests)]
        rows: list[list[object]] = []
        for country in self.countries:
            values = {arc: column[:-1] for arc, column in shares(country, self.pooled).items()}
            values |= {arc: country.flows[arc] for arc in EXOGENOUS}
            later = today(country, self.pooled)
            rows += [[country.name, year, *(_said(values[arc][y]) for arc in columns)] for y, year in enumerate(YEARS)]
            for year, factor in zip(FUTURE, self.known[country.name].use, strict=True):
                now = {arc: later[arc] * (factor if arc in IMPORTS else 1.0) for arc in columns}
                rows.append([country.name, year, *(_said(now[arc]) for arc in columns)])
        write_table(self.folder / "steel.csv", ["region", "year", *columns], rows)

    def write_history(self) -> None:
        """Write what went into use from 1900 on."""
        rows: list[list[object]] = []
        for country in self.countries:
            used = np.concatenate([self.known[country.name].level * country.earlier_use, country.flows["into_use"]])
            rows += [[country.name, year, _said(value)] for year, value in enumerate(used, YEARS.stop - len(used))]
        write_table(self.folder / "steel_history.csv", ["region", "year", "into_use"], rows)

    def write_regions(self) -> None:
        """Write what differs from country to country alone."""
        rows: list[list[object]] = []
        for country in self.countries:
            known = self.known[country.name]
            row = {name: getattr(known, name) for name in ("collection", "stock_scale", "exports", "stretch")}
            row["flow_scale"] = float(country.flows["into_use"][RECENT].mean())
            primary = country.primary
            parts = primary / primary.sum() if primary.sum() > 0 else np.eye(len(PRIMARY))[1]
            for arc, part in zip(PRIMARY, parts.tolist(), strict=True):
                row[f"{arc}_weight"] = part
                row[f"{arc}_most"] = 3 * float(country.flows[arc].max()) + 1.0
            now = today(country, self.pooled)
            for arc in HALVED:
                row |= _range(arc, now[arc] / 2, now[arc], now[arc])
            for arc, (least, most) in RANGES.items():
                row |= _range(arc, least * now[arc], now[arc], min(1.0, most * now[arc]))
            rows.append([country.name, *(_said(value) for _, value in sorted(row.items()))])
        write_table(self.folder / "steel_regions.csv", ["region", *sorted(row)], rows)

    def write_demand(self) -> None:
        """Write people, stock per head, what goes into use, what can be collected and saved, from 2025 to 2051."""
        people, years = populations(), np.array([*FUTURE, FUTURE.stop])
        rows: list[list[object]] = []
        for country in self.countries:
            known = self.known[country.name]
            population, head = known.demand(people[country.name])
            elapsed = np.minimum(years - years[0], 25)
            passed, now, rate = elapsed / 25, today(country, self.pooled), known.collection
            best = rate + passed * (max(rate, BEST_COLLECTION) - rate) + WIDTH * (rate >= BEST_COLLECTION)
            halved = [now[arc] * (1 - passed / 2) for arc in HALVED]
            exports = known.export_shares(now)
            ranges = [
                end
                for arc in EXPORTS
                for factor in (EXPORTED[0], 1.0, EXPORTED[1])
                for end in [np.minimum(factor * exports[arc] + WIDTH * (factor > 1), 1.0)]
            ]
            later = [np.append(column, column[-1]) for column in (now["into_use"] * known.use, *ranges)]
            for row in zip(years.tolist(), population, head, best, *halved, *later, strict=True):
                rows.append([country.name, row[0], *map(_said, row[1:])])
        header = ["region", "year", "population", "stock_per_head", "collection_most", *HALVED, "use"]
        header += [f"{arc}_{end}" for arc in EXPORTS for end in ("low", "neutral", "high")]
        write_table(self.folder / "steel_demand.csv", header, rows)

    def write_copper(self) -> None:
        """Write what long products get of the copper in steel, if theirs is so many times that of flat ones."""
        rows: list[list[object]] = []
        for country in self.countries:
            now = today(country, self.pooled)
            long, sold = now["semis_to_long"], float(self.known[country.name].export_shares(now)["semis_exports"].max())
            parts = [(1 - sold) * times * long / (times * long + 1 - long - sold) for times in RICHER]
            rows.append([country.name, *map(_said, parts)])
        header = ["region", *(f"to_long_{end}" for end in ("low", "neutral", "high"))]
        write_table(self.folder / "steel_copper.csv", header, rows)

    def simulated(self, country: Country, scenario: str = "default") -> tuple[dict[str, Floats], dict[str, Floats]]:
        """Return flows by arc and stocks by node of a country in which nobody acts."""
        return simulated(identifiers([country.name])[country.name], scenario, self.folder)

    def simulate(self) -> None:
        """Find what follows from simulations, and write it: stock, demand, collection, imports, exports."""
        self.write()
        for country in self.countries:
            _, stocks = self.simulated(country, "hindcast")
            self.known[country.name].stock_scale = float(sum(stocks[sector][-1] for sector in SECTORS))
        self.write()
        for country in self.countries:
            known, (flows, _) = self.known[country.name], self.simulated(country)
            discards = float(flows["old_scrap"][0] + flows["left"][0])
            known.net_addition = float(country.flows["into_use"][RECENT].mean()) - discards
            known.collection = min(1.0 - WIDTH, float(country.flows["old_scrap"][RECENT].mean()) / discards)
        self.write()
        people = populations()
        for country in self.countries:
            known = self.known[country.name]
            population, head = known.demand(people[country.name])
            used = np.concatenate([known.level * country.earlier_use, country.flows["into_use"]])
            growth = population * head / (1e3 * known.stock_scale)
            use = inflow_of(growth[: len(FUTURE)], used, SECTORS, known.stretch)
            known.use = use / use[0]
        self.write()
        for country in self.countries:
            flows, _ = self.simulated(country)
            exported = sum(flows[arc] for arc in EXPORTS)
            self.known[country.name].exports = 0.9 * float(np.min(exported))
        self.write()


def possible_network(country: Country, everyone: Sequence[Country], level: float, stretch: float) -> Network:
    """Return the network of a country as it would be with another history before 2000 and other lifetimes."""
    with TemporaryDirectory() as folder:
        shutil.copy(ENVS / "steel.toml", folder)
        Files({country.name: Calibration(level, stretch)}, everyone, Path(folder)).simulate()
        return load_network(f"{Path(folder) / 'steel.toml'}:{identifiers([country.name])[country.name]}")


def _range(arc: str, low: float, neutral: float, high: float) -> dict[str, float]:
    return {f"{arc}_low": low, f"{arc}_neutral": neutral, f"{arc}_high": max(high, low + WIDTH)}


def _said(value: float) -> str:
    return f"{float(value):.9g}"


def simulated(region: str, scenario: str, folder: Path = ENVS) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return flows by arc and stocks by node of a scenario in which nobody acts."""
    network = load_network(f"{folder / 'steel.toml'}:{region}", scenario=scenario)
    env = MultiAgentVectorEnv(network, num_envs=1)
    begun = episode_start(env)
    run = begun.play(env, Neutral())
    flows = {arc.id: run.flow[:, k] for k, arc in enumerate(network.arcs)}
    return flows, {node.id: run.stock[:, i] for i, node in enumerate(network.stores)}


def plan_lines(everyone: Sequence[Country]) -> Iterator[str]:
    """Yield the table of bounds and plans, as they are kept."""
    yield "| country | as usual, Mt | bound, Mt | plan, Mt | gap | service |"
    yield "|-|-|-|-|-|-|"
    for name, region in identifiers(each.name for each in everyone).items():
        kept = read_plan(f"steel_{region}")
        assert kept.bound is not None
        episode = replayed(kept)
        usual, found = (float(run.episode_circularity[0]) for run in (episode.usual, episode.rollout))
        figures = " | ".join(f"{value / 1e3:.2f}" for value in (usual, kept.bound, found))
        yield f"| {name} | {figures} | {float(gap(kept.bound, found)):.2%} | {kept.min_service:.4f} |"


def main() -> None:
    """Write the data files, or the table of plans."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--table", type=Path, default=TABLE, help="the published table of flows")
    parser.add_argument("--plans", action="store_true", help="write the table of plans instead")
    asked = parser.parse_args()
    everyone = countries(read_flows(asked.table))
    if asked.plans:
        write_sections(CYCLES, {"plans": "\n".join(plan_lines(everyone))})
        return
    Files({each.name: Calibration(*calibrated(each).mode) for each in everyone}, everyone).simulate()


if __name__ == "__main__":
    main()
