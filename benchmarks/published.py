"""Cycles of the world against what is published of single years: tables of docs/data.md and docs/accounts.md.

python -m benchmarks.published
"""

from __future__ import annotations

import fnmatch
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from benchmarks.document import markdown_table, write_sections
from benchmarks.japan_costs import amount_range
from benchmarks.steel import DOCUMENT
from cirl_marl import CirlError, MultiAgentVectorEnv, load_network, simulate
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.errors import unknown_name
from cirl_marl.evaluation.simulations import Simulation

ACCOUNTS = Path(__file__).parent.parent / "docs" / "accounts.md"


@dataclass(frozen=True, slots=True)
class Figure:
    """What is published of a flow."""

    network: str
    name: str
    arcs: Annotated[tuple[str, ...], "whose sum it is, less those after a -; * stands for anything"]
    values: Annotated[Mapping[int, float], "Mt/a by year"]
    source: str
    difference: Annotated[str, "why the model has another"]


FIGURES = (
    Figure(
        "copper_world",
        "mined",
        ("mining",),
        {2015: 19.1, 2019: 20.5, 2022: 21.9},
        "ICSG, World Copper Factbook 2020, 2023",
        "use and scrap are those of Fraunhofer ISI, whose balance needs more ore than is mined",
    ),
    Figure(
        "aluminium_world",
        "primary",
        ("mining",),
        {2019: 63.7, 2022: 68.5},
        "IAI, Primary Aluminium Production",
        "alloying metal counts here",
    ),
    Figure(
        "aluminium_world",
        "old scrap",
        ("*_collected",),
        {2019: 20.0},
        "IAI, press release of 25 May 2021",
        "before losses in remelting",
    ),
    Figure(
        "plastics_world",
        "into use",
        ("into_use",),
        {2020: 450.0},
        "OECD 2022 and 2023: 460 in 2019, 2.2 % less in 2020",
        "the OECD's baseline on a straight line, without the pandemic",
    ),
    Figure(
        "plastics_world",
        "made, without fibres",
        ("virgin", "recycled", "-to_textiles"),
        {2022: 400.3},
        "Plastics Europe, Plastics: the fast Facts 2023",
        "likewise, and other polymers are counted",
    ),
)


@dataclass(frozen=True, slots=True)
class Amount:
    """What is published of an account."""

    network: str
    account: str
    unit: Annotated[str, "of the amount, or of thousands of it for a unit of mass that flows"]
    value: float
    source: str
    arcs: Annotated[tuple[str, ...], "flows for whose sum it is; () for the amount of a year"] = ()


CAST = ("*bof_steel", "*eaf_steel")
AMOUNTS = (
    Amount("steel_world", "emissions", "t CO2e/t cast", 1.91, "worldsteel, 2022, a tonne of steel", CAST),
    Amount("steel_world", "energy", "GJ/t cast", 20.99, "worldsteel, 2022, likewise", CAST),
    Amount("steel_japan", "emissions", "Mt CO2e", 159.5, "JISF, fiscal 2023: 153 Mt of 96 % of the industry"),
    Amount("aluminium_world", "emissions", "Mt CO2e", 1110.0, "IAI, with rolling"),
    Amount("aluminium_world", "energy", "PJ", 4356.0, "IAI: smelters 2021, refineries 2024"),
    Amount("copper_world", "emissions", "Mt CO2e", 97.0, "ICA, refined copper, 2018"),
    Amount("plastics_world", "emissions", "Mt CO2e", 1798.0, "OECD 2022, of 2019"),
)


def first_year(amount: Amount) -> tuple[float, float, float]:
    """Return what the model has of an account in its first year, as it is published, and at the ends of its factors."""
    env = MultiAgentVectorEnv(amount.network, num_envs=1, horizon=1)
    run, accounts = rollout(env, Neutral()), [account.id for account in env.network.accounts]
    total = float(run.bookings[0, accounts.index(amount.account), 0])
    low = high = 0.0
    if "factor_ranges" in load_network(amount.network).scenarios:
        uncertain = load_network(amount.network, scenario="factor_ranges")
        low, high = amount_range(uncertain, run.flow[0] * env.network.episode.control_interval, amount.account)
    names = [arc.id for arc in env.network.arcs]
    chosen = {name for pattern in amount.arcs for name in fnmatch.filter(names, pattern)}
    scale = 1e3 / float(run.flow[0, [name in chosen for name in names]].sum()) if chosen else 1.0
    return total * scale, (total + low) * scale, (total + high) * scale


def amounts() -> Iterator[tuple[str, ...]]:
    """Yield the rows of the table of accounts."""
    for amount in AMOUNTS:
        here, low, high = first_year(amount)
        digits = 2 if amount.arcs else 0
        ends = f", {low:.{digits}f} to {high:.{digits}f}" if low < high else ""
        off = f"{here / amount.value - 1:+.0%}"
        numbers = (f"{here:.{digits}f} {amount.unit}{ends}", f"{amount.value:.{digits}f}", off)
        yield f"`{amount.network}`", amount.account, *numbers, amount.source


def modelled(figure: Figure, simulation: Simulation, year: int) -> float:
    """Return the model's value of a year, Mt/a.

    Raises:
        CirlError: if a name stands for no arc.
    """
    network, total = simulation.network, 0.0
    first = int(str(network.episode.start)[:4])
    flow = dict(zip((arc.id for arc in network.arcs), simulation.rollout.flow[year - first].tolist(), strict=True))
    for name in figure.arcs:
        chosen = fnmatch.filter(flow, name.removeprefix("-"))
        if not chosen:
            raise CirlError(f"{figure.network}: {unknown_name('arc', name, flow)}")
        total += (-1.0 if name.startswith("-") else 1.0) * sum(flow[arc] for arc in chosen)
    return total


def lines() -> Iterator[str]:
    """Yield the table."""
    yield "| cycle | what | year | published, Mt/a | here, Mt/a | off | source | difference |"
    yield "|-|-|-|-|-|-|-|-|"
    simulations = {name: simulate(name) for name in dict.fromkeys(figure.network for figure in FIGURES)}
    for figure in FIGURES:
        for year, value in figure.values.items():
            ours = modelled(figure, simulations[figure.network], year)
            off = f"{value:.1f} | {ours:.1f} | {ours / value - 1:+.0%}"
            yield f"| `{figure.network}` | {figure.name} | {year} | {off} | {figure.source} | {figure.difference} |"


if __name__ == "__main__":
    write_sections(DOCUMENT, {"published": "\n".join(lines())})
    header = ("network", "account", "first year", "published", "off", "source")
    write_sections(ACCOUNTS, {"amounts": markdown_table(header, amounts())})
