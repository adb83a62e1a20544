"""Plans before and after the second program that makes them smooth, as the table of ``docs/plans.md``.

python -m benchmarks.smooth    # some minutes; --pictures FOLDER draws the levers before and after
"""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from benchmarks.document import write_sections
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
    bound,
    improve_plan,
    load_network,
    plan,
    smooth_plan,
)
from cirl_marl.controllers.schedule import Schedule
from cirl_marl.network.elements import Lifetime
from cirl_marl.optimum import Plan
from cirl_marl.report.decisions import levers, save_decisions

DOCUMENT = Path(__file__).parent.parent / "docs" / "plans.md"
CYCLES = ("copper_world", "steel_japan", "aluminium_world")


PRODUCTS = {"buildings": (40.0, 14.0, "weibull"), "machines": (18.0, 6.0, "normal"), "cars": (13.0, 4.0, "lognormal")}
"""Mean lifetime and deviation, years, and distribution."""


def warehouse_cycle(years: int = 26) -> Network:
    """Return a cycle of a metal in which every product is ordered from one warehouse, and two sources fill that.

    Each of three products has a lifetime and a share that is collected. Shares split what is melted.
    """
    nodes = [
        Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR),
        Node(id="abroad", role=Role.NONRENEWABLE_RESERVOIR),
        Node(id="warehouse", initial=(30.0, 30.0)),
        Node(id="landfill", role=Role.LANDFILL, initial=(0.0, 0.0)),
    ]
    arcs = [
        _order("mining", "ore", "warehouse", 12.0, 40.0),
        _order("imports", "abroad", "warehouse", 6.0, 40.0),
        _share("melting", "scrap", "warehouse", 0.95),
        _share("slag", "scrap", "landfill"),
    ]
    services = []
    for product, (mean, deviation, distribution) in PRODUCTS.items():
        begins = -np.arange(round(4 * mean), 0, -1.0)
        lifetime = Lifetime(mean=mean, deviation=deviation, distribution=distribution)
        history = Series(times=tuple(begins), values=tuple(10.0 * np.exp(0.01 * begins)))
        nodes.append(Node(id=product, lifetime=lifetime, history=history))
        collection = Control(kind=ControlKind.SHARE, low=0.4, neutral=0.6, high=0.9)
        arcs += [
            _order(f"orders_of_{product}", "warehouse", product, 11.0, 30.0),
            _share(f"end_of_{product}", product, f"old_{product}"),
            replace(_share(f"collection_of_{product}", f"old_{product}", "scrap"), control=collection),
            _share(f"loss_of_{product}", f"old_{product}", "landfill"),
        ]
        in_use = 8.0 * mean
        demand = Series(times=(0.0, float(years)), values=(0.9 * in_use, 1.15 * in_use), interpolation="linear")
        services.append(Service(id=f"use_of_{product}", provider=product, quantity="stock", low=demand))
    passing = [Node(id=name, stores=False) for name in ("scrap", *(f"old_{product}" for product in PRODUCTS))]
    return Network(
        name="warehouse",
        nodes=(*nodes, *passing),
        arcs=tuple(arcs),
        services=tuple(services),
        episode=Episode(control_interval=1.0, horizon=years),
        objective=Objective(circularity_scale=10.0, reference_interval=1.0),
        mass_unit="Mt",
        time_unit="year",
    )


def _order(id_: str, donor: str, recipient: str, neutral: float, high: float) -> Arc:
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=neutral, high=high)
    return Arc(id=id_, donor=donor, recipient=recipient, law=Law.CONTROLLED, control=control)


def _share(id_: str, donor: str, recipient: str, share: float | None = None) -> Arc:
    return Arc(id=id_, donor=donor, recipient=recipient, law=Law.SHARE, share=share)


def table(networks: Sequence[Network], pictures: Path | None) -> Iterator[str]:
    """Yield a row for each network: λ̄, services and changes of its plan at full service, before and after."""
    yield (
        "| network | λ̄: before, after | least service: before, after | changes: before, after | "
        "from as usual: before, after | CPU s: bound and plan, smooth |"
    )
    yield "|-|-|-|-|-|-|"
    for network in networks:
        begun = time.process_time()
        before = improve_plan(bound(network, min_service=1.0))
        done = time.process_time()
        after = smooth_plan(before)
        seconds = f"{done - begun:.0f}, {time.process_time() - done:.0f}"
        cases = {name: plan(network, Plan(case)) for name, case in (("before", before), ("after", after))}
        cells = [", ".join(figures) for figures in zip(*map(_figures, cases.values()), strict=True)]
        yield f"| `{network.name}` | {' | '.join(cells)} | {seconds} |"
        if pictures is not None:
            for name, schedule in cases.items():
                save_decisions(pictures / f"{network.name}_{name}.png", schedule, title=f"{network.name}, {name}")


def _figures(schedule: Schedule) -> Iterator[str]:
    """Yield λ̄, the least service, the sum of changes, and the mean distance from business as usual."""
    run, settings = schedule.rollout, levers(schedule)
    yield f"{run.episode_circularity[0]:.6g}"
    yield f"{run.least_service[0]:.5f}"
    yield f"{sum(float(np.abs(np.diff(lever.plan)).sum()) / lever.width for lever in settings if lever.width):.2f}"
    yield f"{sum(lever.change for lever in settings):.2f}"


def main(
    pictures: Annotated[Path | None, typer.Option(help="Folder for pictures of the levers, before and after.")] = None,
) -> None:
    """Write the table."""
    networks = [*map(load_network, CYCLES), warehouse_cycle()]
    write_sections(DOCUMENT, {"smooth": "\n".join(table(networks, pictures))})


if __name__ == "__main__":
    typer.run(main)
