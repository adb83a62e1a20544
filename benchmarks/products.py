"""A cycle of a metal in products that live for different times: what bounds and plans of lifetimes are measured on.

``python -m benchmarks.products`` bounds, plans and improves it; ``--controlled`` lets agents prolong the lifetimes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Annotated

import numpy as np
import typer
from rich.console import Console

from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    Network,
    Node,
    Objective,
    Role,
    Series,
    Service,
)
from cirl_marl.network.elements import Lifetime
from cirl_marl.optimum import bound, improve_plan, simulate_plan

PRODUCTS = {
    "buildings": (45.0, 15.0, "weibull", 0.45),
    "machines": (20.0, 6.0, "normal", 0.2),
    "cars": (14.0, 5.0, "lognormal", 0.25),
    "packaging": (1.0, None, "fixed", 0.1),
}
"""Mean lifetime and deviation, years, distribution, and share of all new products."""
BEGIN, GROWTH = 100.0, 0.02
"""New products in the first year, Mt, and their growth before it, 1/year."""


def product_cycle(years: int = 26, *, controlled: bool = False) -> Network:
    """Return the network: 30 nodes, four products, agents for ore, collection and sorting, and for lifetimes."""
    nodes = [
        Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR),
        Node(id="scrap", initial=(10.0, 10.0), rate=6.0),
        Node(id="landfill", role=Role.LANDFILL, initial=(0.0, 0.0)),
        Node(id="slag", role=Role.LANDFILL, initial=(0.0, 0.0)),
        *(Node(id=each, stores=False) for each in ("smelter", "furnace", "casting", "rolling", "fabrication", "dust")),
    ]
    arcs = [
        Arc(id="mining", donor="ore", recipient="smelter", law=Law.CONTROLLED, control=_flow(0.0, 60.0, 160.0)),
        _share("smelting", "smelter", "casting", 0.97),
        _share("smelter_slag", "smelter", "slag"),
        _share("melting", "scrap", "furnace"),
        _share("recycling", "furnace", "casting", 0.95),
        _share("furnace_dust", "furnace", "dust"),
        _share("dust_to_slag", "dust", "slag", 0.8),
        _share("dust_to_casting", "dust", "casting"),
        _share("to_rolling", "casting", "rolling", 0.98),
        _share("casting_scrap", "casting", "scrap"),
        _share("to_fabrication", "rolling", "fabrication", 0.96),
        _share("rolling_scrap", "rolling", "scrap"),
    ]
    services = []
    for product, (mean, deviation, distribution, part) in PRODUCTS.items():
        lifetime = Lifetime(mean=mean, deviation=deviation, distribution=distribution)
        begins = -np.arange(round(4 * mean), 0, -1.0)
        history = Series(times=tuple(begins), values=tuple(part * BEGIN * np.exp(GROWTH * begins)))
        stretch = Control(kind=ControlKind.STRETCH, low=0.9, neutral=1.0, high=1.25)
        prolonged = controlled and distribution != "fixed"
        nodes += [
            Node(id=f"market_of_{product}", stores=False),
            Node(id=product, lifetime=lifetime, history=history, control=stretch if prolonged else None),
            *(Node(id=f"{each}_{product}", stores=False) for each in ("old", "shredded", "sorted")),
        ]
        arcs += [
            _share(f"fabrication_of_{product}", "fabrication", f"market_of_{product}", 0.85 * part),
            _share(f"purchase_of_{product}", f"market_of_{product}", product),
            _share(f"end_of_{product}", product, f"old_{product}"),
            _share(f"collection_of_{product}", f"old_{product}", f"shredded_{product}", (0.3, 0.5, 0.9)),
            _share(f"loss_of_{product}", f"old_{product}", "landfill"),
            _share(f"shredding_of_{product}", f"shredded_{product}", f"sorted_{product}", 0.95),
            _share(f"fluff_of_{product}", f"shredded_{product}", "landfill"),
            _share(f"sorting_of_{product}", f"sorted_{product}", "scrap", (0.4, 0.6, 0.95)),
            _share(f"rest_of_{product}", f"sorted_{product}", "landfill"),
        ]
        in_use = part * BEGIN * 0.85 * mean
        demand = Series(times=(0.0, float(years)), values=(0.8 * in_use, 1.1 * in_use), interpolation="linear")
        services.append(Service(id=f"use_of_{product}", provider=product, quantity="stock", low=demand))
    arcs.append(_share("fabrication_scrap", "fabrication", "scrap"))
    return Network(
        name="products",
        nodes=tuple(nodes),
        arcs=tuple(arcs),
        services=tuple(services),
        episode=Episode(control_interval=1.0, horizon=years),
        objective=Objective(circularity_scale=100.0, reference_interval=1.0),
        mass_unit="Mt",
        time_unit="year",
    )


def _flow(low: float, neutral: float, high: float) -> Control:
    return Control(kind=ControlKind.FLOW, low=low, neutral=neutral, high=high)


def _share(id_: str, donor: str, recipient: str, share: float | tuple[float, float, float] | None = None) -> Arc:
    control = None
    if isinstance(share, tuple):
        control, share = Control(kind=ControlKind.SHARE, low=share[0], neutral=share[1], high=share[2]), None
    return Arc(id=id_, donor=donor, recipient=recipient, law=Law.SHARE, share=share, control=control)


def measured(network: Network, min_service: float) -> Iterator[str]:
    """Yield what was done, what came of it, and the seconds until then."""
    began = time.perf_counter()

    def said(what: str) -> str:
        return f"{what}, {time.perf_counter() - began:.1f} s"

    found = bound(network, min_service=min_service)
    yield said(f"bound: λ̄ ≤ {found.objective:.5g} Mt, {len(found.problem.cost):,} variables")
    yield said(f"certificate: {found.verify().bound:.6g} Mt")
    run = simulate_plan(improve_plan(found))
    level = float(run.episode_levels[0].min(initial=1.0))
    gap = float(found.gap(run.episode_circularity)[0])
    yield said(f"plan: λ̄ = {run.episode_circularity[0]:.5g} Mt, least service {level:.4f}, gap {gap:.2%}")


def main(
    years: Annotated[int, typer.Option(min=2, help="Control intervals.")] = 26,
    controlled: Annotated[bool, typer.Option("--controlled", help="Whether agents prolong lifetimes.")] = False,
    min_service: Annotated[float, typer.Option(min=0, max=1, help="Level that every service must have.")] = 0.95,
) -> None:
    """Bound, plan and improve the cycle."""
    console = Console()
    network = product_cycle(years, controlled=controlled)
    size = f"{len(network.nodes)} nodes, {len(network.arcs)} arcs, {len(network.agents)} agents"
    console.print(f"{size}, {years} years")
    for said in measured(network, min_service):
        console.print(said)


if __name__ == "__main__":
    typer.run(main)
