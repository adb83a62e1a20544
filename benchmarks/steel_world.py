"""The data of ``envs/steel_world.toml``, and what was measured with it; ``docs/data.md`` has the sources.

python -m benchmarks.steel_world           # writes envs/steel_world.csv and steel_world_rest.csv anew
"""

from __future__ import annotations

import argparse
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from benchmarks import steel
from benchmarks.steel import ENVS, FUTURE, RECENT, TABLE, YEARS, Country, countries
from cirl_marl import VectorEnv, load_network
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import beginning, rollout
from cirl_marl.importing.definition import identifiers, shares_of
from cirl_marl.importing.tables import read_flows
from cirl_marl.network import Floats
from cirl_marl.records.files import write_table

GOODS = ("ore", "pig_iron", "dri", "scrap", "semis", "long", "flat", "goods")
"""What world markets trade."""
STEEL = ("semis", "long", "flat", "goods")
"""The part of it that the rest of the world wants for its own sake."""
RAW = ("ore", "pig_iron", "dri")
"""The part that counts where it is made into steel, from 2025 on, so that nothing of it is traded then."""
AT = {year: y for y, year in enumerate(YEARS)} | dict.fromkeys(FUTURE, len(YEARS))
"""Position of each year that files state."""


@dataclass(frozen=True, slots=True)
class Market:
    """What the countries trade of one good, in 25 years and as the mean of the last five, kt/a."""

    imports: Annotated[Floats, "of each country, shape (years, countries)"]
    exports: Annotated[Floats, "likewise"]

    @property
    def sold(self) -> Floats:
        """What the rest of the world sells: what the countries import beyond their exports, shape (years,)."""
        return np.maximum((self.imports - self.exports).sum(axis=1), 0.0)

    @property
    def bought(self) -> Floats:
        """What the rest of the world buys: what they export beyond their imports, shape (years,)."""
        return np.maximum((self.exports - self.imports).sum(axis=1), 0.0)

    @property
    def shares(self) -> Floats:
        """What part of all that is for sale each country buys, shape (years, countries)."""
        return shares_of(np.column_stack([self.imports, self.bought])[None])[0][:, :-1]


def markets(everyone: Sequence[Country]) -> dict[str, Market]:
    """Return the world markets, by good.

    Exports are as the network of each country gives them back, in which processes balance, as rounded ones do not.
    """
    ids = identifiers(each.name for each in everyone)
    returned = [steel.simulated(ids[each.name], "reported")[0] for each in everyone]
    found = {}
    for good in GOODS:
        imports = np.array([each.flows[f"{good}_imports"] for each in everyone]).T
        exports = np.array([each[f"{good}_exports"] for each in returned]).T
        today = [each[RECENT].mean(axis=0) * (good not in RAW) for each in (imports, exports)]
        found[good] = Market(*(np.vstack(each) for each in zip((imports, exports), today, strict=True)))
    return found


def write_trade(everyone: Sequence[Country], found: Mapping[str, Market], supply: float) -> None:
    """Write the share of each country in each world market, and what the rest of the world sells and wants there."""
    rows: list[list[object]] = []
    for n, country in enumerate(everyone):
        for year, y in AT.items():
            rows.append([country.name, year, *(_said(found[good].shares[y, n]) for good in GOODS)])
    write_table(ENVS / "steel_world.csv", ["region", "year", *GOODS], rows)
    wanted = sum(found[good].bought for good in STEEL)
    wanted[-1] = supply
    rest = [[year, *(_said(found[good].sold[y]) for good in GOODS), _said(wanted[y])] for year, y in AT.items()]
    write_table(ENVS / "steel_world_rest.csv", ["year", *GOODS, "supply"], rest)


def _said(value: float) -> str:
    return f"{float(value):.12g}"


def simulated(scenario: str) -> tuple[dict[str, Floats], dict[str, Floats]]:
    """Return flows by arc and stocks by node of a scenario in which nobody acts."""
    network = load_network(ENVS / "steel_world.toml", scenario=scenario)
    env = VectorEnv(network, num_envs=1)
    begun = beginning(env)
    run = rollout(env, Neutral(), seed=begun.seed, start=begun.given)
    flows = {arc.id: run.flow[:, k] for k, arc in enumerate(network.arcs)}
    return flows, {node.id: run.stock[:, i] for i, node in enumerate(network.stores)}


def main() -> None:
    """Write the data files."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.parse_args()
    everyone = sorted(countries(read_flows(TABLE)), key=lambda each: each.name)
    found = markets(everyone)
    write_trade(everyone, found, 1.0)
    flows, _ = simulated("default")
    write_trade(everyone, found, 0.9 * float(np.min(sum(flows[f"rest_of_world_{good}_bought"] for good in STEEL))))


if __name__ == "__main__":
    main()
