"""Episodes in the format of the Integrated Assessment Modeling Consortium, which pyam and scenario databases read.

A row is a model, a scenario, a region, a variable and a unit, with a column for each year. Variables are
``Circularity``, ``Service Level|SERVICE``, ``Stock|NODE`` at the end of a year, ``Flow|ARC``, and ``ACCOUNT`` with its
parts ``ACCOUNT|COMPARTMENT``, not discounted. Compartments of copies stand under their region by the names there.

References: Huppmann et al. 2021, pyam: Analysis and visualisation of integrated assessment and macro-energy scenarios.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

from cirl_marl.errors import CirlError
from cirl_marl.evaluation.simulations import Simulation
from cirl_marl.network import Floats, Network
from cirl_marl.network.calendar import elapsed_time, in_years, year
from cirl_marl.network.elements import Arc
from cirl_marl.records.files import write_atomically, write_table
from cirl_marl.records.machine import versions

WORLD = "World"
"""The region of what is of no copy and no region."""
NAMES = ("Model", "Scenario", "Region", "Variable", "Unit")


def write_iamc(path: str | Path, simulations: Sequence[Simulation]) -> Path:
    """Write episodes as a CSV file in the IAMC format, and return its path.

    Raises:
        CirlError: for a network whose intervals are no calendar years, or episodes of different years.
    """
    years = [_years(simulation.network) for simulation in simulations]
    if any(other != years[0] for other in years):
        raise CirlError("IAMC: the episodes are of different years; write a file for each")
    rows = [[*names, *values.tolist()] for simulation in simulations for names, values in _series(simulation)]
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    write_atomically(path, lambda draft: write_table(draft, [*NAMES, *map(str, years[0])], rows))
    return path


def _years(network: Network) -> list[int]:
    """Return the calendar year of each interval."""
    episode = network.episode
    begins = None if episode.start is None else year(episode.start)
    if begins is None or begins % 1 or not in_years(network.time_unit):
        raise CirlError(f"network '{network.name}': IAMC has calendar years; give [episode] a start, such as 2025")
    if abs(episode.control_interval / elapsed_time(begins + 1, begins, network.time_unit) - 1) > 1e-9:
        interval = f"{episode.control_interval:g} {network.time_unit}"
        raise CirlError(f"network '{network.name}': IAMC has a value a year; its control interval is {interval}")
    return [int(begins) + t for t in range(episode.horizon)]


def _series(simulation: Simulation) -> Iterator[tuple[list[str], Floats]]:
    """Give the first columns of each row, and its values, shape (steps,)."""
    network, run, ledger = simulation.network, simulation.rollout, simulation.env.ledger
    model, mass = f"cirl_marl {versions()['cirl-marl']}", network.mass_unit
    scenario = f"{network.scenario_name} {simulation.control}"
    own = network.region or WORLD
    scale = elapsed_time(2001, 2000, network.time_unit)
    regions = {node: region for region, nodes in network.copies.items() for node in nodes}

    def row(region: str, variable: str, unit: str) -> list[str]:
        return [model, scenario, region, variable, unit]

    def place(id_: str) -> tuple[str, str]:
        """Return the region of a compartment, and its name there."""
        part, name = network.compartments[id_], network.counterpart(id_)
        ends = (part.donor, part.recipient) if isinstance(part, Arc) else (id_,)
        copied = next((regions[end] for end in ends if end in regions), own)
        return (own, id_) if name is None else (copied, name)

    yield row(own, "Circularity", mass), run.circularity_mean[0]
    for s, service in enumerate(network.services):
        yield row(own, f"Service Level|{service.id}", "1"), run.levels[0, s]
    for i, node in enumerate(network.stores):
        region, name = place(node.id)
        yield row(region, f"Stock|{name}", mass), run.stock[:, i]
    for k, arc in enumerate(network.arcs):
        region, name = place(arc.id)
        yield row(region, f"Flow|{name}", f"{mass}/yr"), run.flow[:, k] * scale
    for a, account in enumerate(network.accounts):
        title, unit = account.title or account.id, f"{account.unit}/yr"
        yield row(own, title, unit), run.bookings[0, a]
        parts: dict[tuple[str, str], Floats] = {}
        for entry in range(len(ledger.compartments)):
            if ledger.account[entry] == a:
                at, amounts = place(ledger.compartments[entry]), run.entries[:, entry]
                parts[at] = parts[at] + amounts if at in parts else amounts
        for (region, name), amounts in parts.items():
            yield row(region, f"{title}|{name}", unit), amounts
