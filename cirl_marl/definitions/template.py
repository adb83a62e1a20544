"""A first definition, from five numbers: a material that is made, used for years, discarded, and recycled in part."""

from __future__ import annotations

import re
import sys
import tempfile
from pathlib import Path
from typing import Annotated

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.errors import CirlError
from cirl_marl.network.declarations import frozen_record
from cirl_marl.records.files import write_atomically

TEMPLATE = Path(__file__).with_name("first_cycle.template")


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

    def __post_init__(self) -> None:
        """Raise a ``CirlError`` for numbers that cannot be meant."""
        for name, (low, high, demand) in BOUNDS.items():
            if not low <= getattr(self, name) <= high:
                raise CirlError(f"{name.replace('_', '-')} {getattr(self, name)}: {demand}")
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
        load_network(trial)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda temporary: temporary.write_text(text, encoding="utf-8"))


def _text(cycle: FirstCycle, path: Path) -> str:
    end = cycle.start + cycle.years
    times = sorted({*range(cycle.start, end, 5), end})
    flow = cycle.in_use / cycle.lifetime
    half_year = (1 + cycle.growth / 100) ** 0.5  # a year's demand is met by what is in use when it ends
    values = [cycle.in_use * half_year * (1 + cycle.growth / 100) ** (year - cycle.start) for year in times]
    return TEMPLATE.read_text(encoding="utf-8").format(
        title=f"{cycle.material[:1].upper()}{cycle.material[1:]}, {cycle.start} to {end}",
        file=path.name,
        name=re.sub(r"\W+", "_", path.stem).strip("_") or "network",
        material=cycle.material,
        mass=cycle.mass,
        in_use=cycle.in_use,
        lifetime=cycle.lifetime,
        deviation=0.3 * cycle.lifetime,
        growth=cycle.growth,
        flow=flow,
        most=10 * flow,
        start=cycle.start,
        end=end,
        years=cycle.years,
        recycled=cycle.recycled,
        best=max(cycle.recycled, 0.9),
        times=times,
        values=[float(f"{value:.6g}") for value in values],
    )
