"""Episodes in the format of the Integrated Assessment Modeling Consortium, which pyam and scenario databases use.

A row is a model, a scenario, a region, a variable and a unit, with a column for each year. Variables are
``Circularity``, ``Service Level|SERVICE``, ``Stock|NODE`` at the end of a year, ``Flow|ARC``, ``Content|SUBSTANCE|
COMPARTMENT``, a part of its mass, and ``ACCOUNT`` with its parts ``ACCOUNT|COMPARTMENT``, not discounted. Compartments
of copies stand under their region by the names there.

References: Huppmann et al. 2021, pyam: Analysis and visualisation of integrated assessment and macro-energy scenarios.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np

from cirl_marl.controllers.episode_quantities import EpisodeQuantity, QuantityKind, episode_quantities
from cirl_marl.controllers.rollout import Rollout
from cirl_marl.definitions.data_files import CsvRows, number_in
from cirl_marl.dynamics.ledger import Ledger
from cirl_marl.errors import CirlError, instance_of, unknown_name
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import elapsed_time, in_years, year
from cirl_marl.network.declarations import positional_record
from cirl_marl.records.files import read_content, write_table
from cirl_marl.records.machine import versions

WORLD = "World"
"""The region of what is of no copy and no region."""
VARIABLES: Mapping[QuantityKind, str] = {
    "circularity": "Circularity",
    "service": "Service Level|{}",
    "stock": "Stock|{}",
    "flow": "Flow|{}",
    "content": "Content|{substance}|{}",
}
OF_NETWORK = ("circularity", "service")
"""Kinds of quantities that are of no compartment."""
NAMES = ("Model", "Scenario", "Region", "Variable", "Unit")
YearlyRow = tuple[list[str], Callable[[Rollout], Floats]]
"""The first columns of a row, and what its values are of an episode, shape (steps,)."""


def write_iamc(path: str | Path, simulations: Sequence[Simulation]) -> Path:
    """Write episodes as a CSV file in the IAMC format, and return its path.

    Raises:
        CirlError: what ``iamc_years`` raises.
    """
    episodes = [instance_of(Simulation, "each of simulations", simulation) for simulation in simulations]
    years = iamc_years([(simulation.network, simulation.control) for simulation in episodes])
    rows = [
        [*names, *values(simulation.rollout).tolist()]
        for simulation in episodes
        for names, values in _series(simulation.network, simulation.control)
    ]
    return write_table(Path(path), [*NAMES, *map(str, years)], rows)


def iamc_years(episodes: Sequence[tuple[Network, str]]) -> range:
    """Return the years of episodes, of which networks and names of controls are known, or say why no file holds them.

    Raises:
        CirlError: for a network whose intervals are no calendar years, no episodes or those of different years, or two
            rows of the same names.
    """
    if not episodes:
        raise CirlError("IAMC: give at least one episode")
    first, *others = (_years(network) for network, _ in episodes)
    if any(other != first for other in others):
        raise CirlError("IAMC: the episodes are of different years; write a file for each")
    rows = [tuple(names[:4]) for network, control in episodes for names, _ in _series(network, control)]
    for names, times in Counter(rows).items():
        if times > 1:
            raise CirlError(f"IAMC: {', '.join(names)} would come {times} times; give other titles")
    return first


@positional_record
class YearlyValues:
    """A row of a file in the IAMC format."""

    model: Annotated[str, "that made it"]
    scenario: Annotated[str, "of the model"]
    region: Annotated[str, "that it is about"]
    variable: Annotated[str, "with its parts after bars"]
    unit: Annotated[str, "of its values"]
    values: Annotated[Mapping[int, float], "by year; what is left empty is missing"]


def read_iamc(path: str | Path) -> list[YearlyValues]:
    """Read a CSV file in the IAMC format, with a column for each year.

    Raises:
        CirlError: for a missing column, one that is no year, a cell that is no number, or a row that comes twice; names
            the file and the line.
    """
    if not Path(path).is_file():
        raise CirlError(f"{path}: no such file")
    rows = CsvRows(str(path), read_content(Path(path)))
    header = [cell.strip() for cell in rows[0]]
    columns = {cell.lower(): place for place, cell in enumerate(header)}
    for name in NAMES:
        if name.lower() not in columns:
            raise CirlError(f"{path}: {unknown_name('column', name, header)}")
    places = [columns[name.lower()] for name in NAMES]
    years = {place: cell for place, cell in enumerate(header) if place not in places}
    if wrong := [cell for cell in years.values() if not (cell.isdecimal() and len(cell) == 4)]:
        raise CirlError(f"{path}: column '{wrong[0]}' is no year, such as 2030, and none of {', '.join(NAMES)}")
    if len({*years.values()}) < len(years):
        twice = next(year_ for year_, times in Counter(years.values()).items() if times > 1)
        raise CirlError(f"{path}: column '{twice}' comes a second time")
    table: dict[tuple[str, ...], YearlyValues] = {}
    for line, cells in zip(rows.lines[1:], rows[1:], strict=True):
        if not any(cell.strip() for cell in cells):
            continue
        values = {int(year_): number_in(cells[place]) for place, year_ in years.items() if cells[place].strip()}
        if not all(map(math.isfinite, values.values())):
            at = next(year_ for year_, value in values.items() if not math.isfinite(value))
            raise CirlError(f"{path}, line {line}: the value of {at} is no finite number")
        model, scenario, region, variable, unit = (cells[place] for place in places)
        if (names := (model, scenario, region, variable)) in table:
            raise CirlError(f"{path}, line {line}: {', '.join(names)} comes a second time")
        table[names] = YearlyValues(*names, unit, values)
    return [*table.values()]


def _years(network: Network) -> range:
    """Return the calendar year of each interval."""
    episode = network.episode
    begins = None if episode.start is None else year(episode.start)
    if begins is None or begins % 1 or not in_years(network.time_unit):
        remedy = "give [episode] a start at the turn of a year, such as 2025, and count time in years"
        raise CirlError(f"network '{network.name}': IAMC has calendar years; {remedy}")
    if abs(episode.control_interval / elapsed_time(begins + 1, begins, network.time_unit) - 1) > 1e-9:
        interval = f"{episode.control_interval:g} {network.time_unit}"
        raise CirlError(f"network '{network.name}': IAMC has a value a year; its control interval is {interval}")
    return range(int(begins), int(begins) + episode.horizon)


def _series(network: Network, control: str) -> Iterator[YearlyRow]:
    """Give the rows of an episode."""
    ledger = Ledger(network.with_options(episode={"horizon": 1}))  # entries are the same in every interval
    case = f"cirl_marl {versions()['cirl-marl']}", f"{network.name} {network.scenario_name} {control}"
    own = network.region or WORLD
    scale = elapsed_time(2001, 2000, network.time_unit)

    def place(id_: str) -> tuple[str, str]:
        """Return the region of a compartment, and its name there."""
        name = network.counterpart(id_)
        return (own, id_) if name is None else (network.region_of(id_), name)

    def of_quantity(quantity: EpisodeQuantity, factor: float = 1.0) -> Callable[[Rollout], Floats]:
        return lambda run: quantity.values(run)[0] * factor

    def of_entries(entries: list[int]) -> Callable[[Rollout], Floats]:
        return lambda run: np.asarray(run.entries[:, entries].sum(axis=1))

    for quantity in episode_quantities(network, *VARIABLES):
        region, name = (own, quantity.of) if quantity.kind in OF_NETWORK else place(quantity.of)
        variable, is_flow = VARIABLES[quantity.kind].format(name, substance=quantity.substance), quantity.kind == "flow"
        unit, factor = (f"{network.mass_unit}/yr", scale) if is_flow else (quantity.unit, 1.0)
        yield [*case, region, variable, unit], of_quantity(quantity, factor)
    for total, account in zip(episode_quantities(network, "account"), network.accounts, strict=True):
        title, unit = account.title or account.id, f"{account.unit}/yr"
        yield [*case, own, title, unit], of_quantity(total)
        parts: dict[tuple[str, str], list[int]] = {}
        for entry in np.flatnonzero(ledger.account == total.place).tolist():
            parts.setdefault(place(ledger.compartments[entry]), []).append(entry)
        for (region, name), rows in parts.items():
            yield [*case, region, f"{title}|{name}", unit], of_entries(rows)
