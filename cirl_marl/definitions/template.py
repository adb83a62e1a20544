"""A first definition, from five numbers: a material that is made, used for years, discarded, and recycled in part.

Several products have demands of their own: what is recycled is shared out to them, and behind that market the deposit
delivers to each what it lacks (docs/yearly_networks.md).
"""

from __future__ import annotations

import re
import sys
import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import field
from pathlib import Path
from typing import Annotated, Any

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.errors import CirlError, DefinitionError, NetworkError
from cirl_marl.network.declarations import frozen_record
from cirl_marl.network.elements import IDENTIFIER
from cirl_marl.records.files import write_atomically

TEMPLATE = Path(__file__).with_name("first_cycle.template")


MARK = "%%\n"


@frozen_record
class FirstCycle:
    """What a first definition is made of."""

    material: Annotated[str, "what flows, in words"]
    mass: Annotated[str, "unit of mass, such as ``kt``"]
    in_use: Annotated[float, "mass that is in use at the start"]
    lifetime: Annotated[float, "mean years that it stays in use"]
    recycled: Annotated[float, "share of the discards that is recycled today"]
    growth: Annotated[float, "of what is in use, in percent a year"] = 0.0
    start: Annotated[int, "first year"] = 2025
    years: Annotated[int, "that the episode lasts"] = 25
    products: Annotated[
        Mapping[str, tuple[float, float]], "mass in use and mean lifetime of each, by id; empty for one without a name"
    ] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Raise a ``CirlError`` for numbers that cannot be meant."""
        for name, (low, high, demand) in BOUNDS.items():
            if not low <= getattr(self, name) <= high:
                raise CirlError(f"{name.replace('_', '-')} {getattr(self, name)}: {demand}")
        for name, numbers in self.products.items():
            if not re.fullmatch(IDENTIFIER, name):
                raise CirlError(f"product '{name}': begins with a letter and has lower-case letters, digits and _ only")
            for key, number in zip(("in_use", "lifetime"), numbers, strict=True):
                low, high, demand = BOUNDS[key]
                if not low <= number <= high:
                    raise CirlError(f"product '{name}': {key.replace('_', '-')} {number}: {demand}")
        if not re.sub(r"\W", "", self.material) or any(mark in self.material for mark in '"\\\n{}'):
            raise CirlError(f"material {self.material!r}: needs letters, without quotes and braces")
        if any(mark in self.mass for mark in '"\\\n'):
            raise CirlError(f"mass {self.mass!r}: is no unit")


BOUNDS = {
    "in_use": (sys.float_info.min, sys.float_info.max, "a mass above 0"),
    "lifetime": (1, sys.float_info.max, "years, at least 1"),
    "recycled": (0, 1, "a share from 0 to 1"),
    "growth": (-20, 20, "percent a year, from -20 to 20"),
    "years": (1, 500, "a number of years from 1 to 500"),
}
"""Lowest and highest value of each number, and what it must be."""


def write_first(cycle: FirstCycle, path: Path) -> None:
    """Write the definition, which checks, to a new file.

    Raises:
        CirlError: if the file is there already, is no ``.toml`` file, or a unit is none of mass.
    """
    if path.suffix != ".toml":
        raise CirlError(f"{path}: needs the name of a .toml file")
    if path.exists():
        raise CirlError(f"{path}: is there already; choose another name")
    text = _text(cycle, path)
    with tempfile.TemporaryDirectory() as folder:
        trial = Path(folder) / path.name
        trial.write_text(text, encoding="utf-8")
        try:
            load_network(trial)
        except NetworkError as error:
            raise DefinitionError(str(path), error.problems) from error
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _text(cycle: FirstCycle, path: Path) -> str:
    """Return the definition; between marks in the template stands what there is of each product."""
    end, products = cycle.start + cycle.years, list(_products(cycle))
    common: dict[str, Any] = {
        "title": f"{cycle.material[:1].upper()}{cycle.material[1:]}, {cycle.start} to {end}",
        "file": path.name,
        "name": re.sub(r"\W+", "_", path.stem).strip("_") or "network",
        "material": cycle.material,
        "mass": cycle.mass,
        "growth": cycle.growth,
        "in_use": sum(product["in_use"] for product in products),
        "flow": sum(product["flow"] for product in products),
        "start": cycle.start,
        "end": end,
        "years": cycle.years,
        "recycled": cycle.recycled,
        "recycled_to": "market" if cycle.products else "production",
        "best": max(cycle.recycled, 0.9),
    }
    parts = TEMPLATE.read_text(encoding="utf-8").split(MARK)
    text = "".join(
        "".join(part.format(**common | product) for product in products) if place % 2 else part.format(**common)
        for place, part in enumerate(parts)
    )
    return (text + _market(products, common["flow"]) if cycle.products else text).rstrip("\n") + "\n"


def _products(cycle: FirstCycle) -> Iterator[dict[str, Any]]:
    """Yield what the template says of each product."""
    end = cycle.start + cycle.years
    times = sorted({*range(cycle.start, end, 5), end})
    half_year = (1 + cycle.growth / 100) ** 0.5  # a year's demand is met by what is in use when it ends
    for name, (in_use, lifetime) in (cycle.products or {"": (cycle.in_use, cycle.lifetime)}).items():
        words = name.replace("_", " ")
        values = [in_use * half_year * (1 + cycle.growth / 100) ** (year - cycle.start) for year in times]
        yield {
            "suffix": f"_{name}" if name else "",
            "of": f": {words}" if name else "",
            "label": words.capitalize() or "In use",
            "in_use": in_use,
            "lifetime": lifetime,
            "deviation": 0.3 * lifetime,
            "flow": in_use / lifetime,
            "most": 10 * in_use / lifetime,
            "times": times,
            "values": [float(f"{value:.6g}") for value in values],
        }


def _market(products: list[dict[str, Any]], flow: float) -> str:
    """Return the market that shares out what is recycled, in proportion to what goes into each use."""
    market = "[nodes.market]                # shares out what is recycled; extraction makes up behind it\n"
    market += 'title = "Market"\nrole = "technosphere"\nstores = false\n'
    for product in products:
        part, suffix = product["flow"] / flow, product["suffix"]
        share = f'{{ value = {part:.6g}, unit = "1", source = "part of what goes into use" }}'
        share = '"rest"' if product is products[-1] else share
        market += f'\n[arcs.recycled{suffix}]\nfrom = "market"\nto = "production{suffix}"\n'
        market += f'law = "share"\nshare = {share}\n'
    return market
