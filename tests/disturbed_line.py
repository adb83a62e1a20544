"""Two small networks to be disturbed: a mine whose ore is shared out, and a mine with a furnace."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from small_networks import KINDS

from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    Network,
    Node,
    Role,
    Service,
)
from cirl_marl.network.disturbances import (
    Disturbance,
    DisturbanceEffect,
)


def line(disturbed: Mapping[str, DisturbanceEffect], names: Mapping[str, Disturbance] = KINDS, **more: Any) -> Network:
    """Return a mine, whose ore is shared out between a dump and a store that leaks and is to be kept full."""
    return Network(
        name="line",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="mill", stores=False),
            Node(id="store", initial=(40.0, 60.0)),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="dig", donor="mine", recipient="mill", law=Law.EXOGENOUS, flow=10.0),
            Arc(id="tails", donor="mill", recipient="dump", law=Law.SHARE, share=0.2),
            Arc(id="metal", donor="mill", recipient="store", law=Law.SHARE),
            Arc(id="leak", donor="store", recipient="dump", rate=0.1),
        ),
        services=(Service(id="metal_kept", provider="store", quantity="stock", low=50.0),),
        disturbances=names,
        disturbed=disturbed,
        **{"episode": Episode(horizon=6), **more},
    )


PLACES = ("arcs.dig.flow", "arcs.tails.share", "arcs.leak.rate", "services.metal_kept.low")
EVERYWHERE = dict(
    zip(PLACES, map(lambda name: DisturbanceEffect(by=name), ("price", "season", "outage", "record")), strict=True)
)


def works(neutral: float = 6.0, **more: Any) -> Network:
    """Return a mine whose output is ordered within a capacity, and a furnace with a valve."""
    order = Control(kind=ControlKind.FLOW, low=1.0, neutral=neutral, high=8.0)
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=1.0)
    return Network(
        name="works",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="furnace", initial=(30.0, 30.0), control=valve),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="dig", donor="mine", recipient="furnace", law=Law.CONTROLLED, control=order, **more),
            Arc(id="melt", donor="furnace", recipient="dump", rate=0.2),
        ),
        services=(Service(id="molten", provider="furnace", quantity="stock", low=40.0),),
        episode=Episode(horizon=8),
    )
