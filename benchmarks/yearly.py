"""Generated cycles of a material with yearly decisions, as real economies have them.

A cycle has 1 to 5 regions. In each, a mine is dug by order, a market without stock shares metal out to products in use,
waste is gathered from these, recycled or lost, and goes round: residence times from a week to a century, some furnaces
and markets with stock and some without, trade between markets, numbers that change with the years.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cirl_marl import Arc, Control, ControlKind, Episode, Law, Network, Node, Objective, Role, Series, Service

WEEK = 1 / 52
SEEDS = 200


def yearly_network(seed: int) -> Network:
    """Return the network of a seed: 10 to 40 years, 5 to 60 nodes."""
    rng = np.random.default_rng(seed)
    years = int(rng.integers(10, 41))
    cycle = _Cycle(rng, years)
    regions = int(rng.integers(1, 6))
    for region in range(regions):
        cycle.region(region, regions)
    return Network(
        name=f"yearly_{seed}",
        nodes=tuple(cycle.nodes),
        arcs=tuple(cycle.arcs),
        services=tuple(cycle.services),
        episode=Episode(control_interval=1.0, horizon=years),
        objective=Objective(circularity_scale=cycle.demand),
        mass_unit="kt",
        time_unit="year",
    )


@dataclass
class _Cycle:
    """The parts drawn so far.

    Attributes:
        rng: of the draws.
        years: of an episode.
        demand: metal that all regions take up in a year, kt.
    """

    rng: np.random.Generator
    years: int
    nodes: list[Node] = field(default_factory=list)
    arcs: list[Arc] = field(default_factory=list)
    services: list[Service] = field(default_factory=list)
    demand: float = 0.0

    def region(self, region: int, regions: int) -> None:
        """Draw the nodes and arcs of a region; those of the next one are known by name."""
        rng, size = self.rng, float(10 ** self.rng.uniform(1, 3))
        self.demand += size
        name = f"r{region}"
        abroad = f"r{(region + 1) % regions}"
        self._mine(name, size)
        products = int(rng.integers(1, 6))
        weights = rng.dirichlet(np.full(products, 3.0))
        self._furnace(f"{name}_smelter", size, f"{name}_market")
        self._node(f"{name}_market", None)
        lives = 10 ** rng.uniform(0, 2, products)
        if rng.random() < 0.3:
            lives[0] = 10 ** rng.uniform(np.log10(WEEK), 0)  # packaging
        for p, (weight, life) in enumerate(zip(weights.tolist(), lives.tolist(), strict=True)):
            self._product(name, p, size * weight, weight, life)
        trade = float(rng.uniform(0.01, 0.2)) if regions > 1 else 0.0
        rest = 1.0 - trade
        for p in range(1, products):
            if rng.random() < 0.5:
                self._share(f"{name}_to_{p}", f"{name}_market", f"{name}_use_{p}", rest * weights[p], True)
            else:
                self._share(
                    f"{name}_to_{p}", f"{name}_market", f"{name}_use_{p}", self._changing(rest * weights[p]), False
                )
        self.arcs.append(Arc(id=f"{name}_to_0", donor=f"{name}_market", recipient=f"{name}_use_0", law=Law.SHARE))
        if trade:
            self._share(f"{name}_export", f"{name}_market", f"{abroad}_market", trade, bool(rng.integers(2)))
        self._waste(name, abroad if regions > 1 and rng.random() < 0.5 else "", size)

    def _mine(self, name: str, size: float) -> None:
        reserve = size * float(self.rng.uniform(60, 200))
        known = self.rng.random() < 0.7
        self.nodes.append(
            Node(
                id=f"{name}_mine",
                role=Role.NONRENEWABLE_RESERVOIR,
                initial=(reserve, reserve) if known else None,
                scale=reserve,
            )
        )
        control = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.6 * size, high=2.0 * size)
        self.arcs.append(
            Arc(
                id=f"{name}_mining",
                donor=f"{name}_mine",
                recipient=f"{name}_smelter",
                law=Law.CONTROLLED,
                control=control,
                scale=size,
            )
        )

    def _furnace(self, node: str, size: float, to: str) -> None:
        """Draw what passes metal on with a loss, within weeks or at once."""
        loss, tip = float(self.rng.uniform(0.01, 0.1)), node.split("_")[0] + "_tip"
        residence = float(10 ** self.rng.uniform(np.log10(WEEK), 0)) if self.rng.random() < 0.4 else None
        self._node(node, residence, size)
        self._share(f"{node}_loss", node, tip, loss, False)
        self.arcs.append(Arc(id=f"{node}_out", donor=node, recipient=to, law=Law.SHARE))

    def _product(self, name: str, p: int, flow: float, weight: float, life: float) -> None:
        """Draw a product in use, in balance at first, of which a service asks for about as much as there is."""
        rng, node = self.rng, f"{name}_use_{p}"
        stock = flow * life
        rate = self._changing(1.0 / life) if rng.random() < 0.3 else 1.0 / life
        self.nodes.append(Node(id=node, initial=(stock, stock), rate=rate, scale=stock))
        self._share(f"{node}_loss", node, f"{name}_tip", float(rng.uniform(0.05, 0.3)), bool(rng.integers(2)))
        self.arcs.append(Arc(id=f"{node}_end", donor=node, recipient=f"{name}_waste", law=Law.SHARE))
        if rng.random() < 0.6 or p == 0:
            growth = float(rng.uniform(-0.01, 0.02))
            ends = (0.9 * stock, 0.9 * stock * (1 + growth) ** self.years)
            low: float | Series = ends[0]
            if rng.random() < 0.7:
                low = Series(times=(0.0, float(self.years)), values=ends, interpolation="linear")
            self.services.append(Service(id=f"{node}_needed", provider=node, quantity="stock", low=low))

    def _waste(self, name: str, abroad: str, size: float) -> None:
        """Draw what becomes of waste: recycled, exported, hoarded or lost."""
        rng, waste = self.rng, f"{name}_waste"
        self._node(waste, float(10 ** rng.uniform(np.log10(WEEK), 0.3)) if rng.random() < 0.4 else None, size)
        self._furnace(f"{name}_recycler", size, f"{name}_market")
        self._share(f"{name}_recycling", waste, f"{name}_recycler", float(rng.uniform(0.3, 0.6)), True)
        if abroad:
            self._share(f"{name}_scrap_export", waste, f"{abroad}_waste", float(rng.uniform(0.01, 0.1)), False)
        if rng.random() < 0.3:
            hoard = f"{name}_hoard"
            self._share(f"{name}_hoarding", waste, hoard, float(rng.uniform(0.02, 0.1)), bool(rng.integers(2)))
            self.nodes.append(Node(id=hoard, initial=(size, size), scale=size))
            control = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.05 * size, high=0.3 * size)
            self.arcs.append(
                Arc(
                    id=f"{name}_release",
                    donor=hoard,
                    recipient=f"{name}_recycler",
                    law=Law.CONTROLLED,
                    control=control,
                    scale=size,
                )
            )
        self.arcs.append(Arc(id=f"{name}_dumping", donor=waste, recipient=f"{name}_tip", law=Law.SHARE))
        self.nodes.append(Node(id=f"{name}_tip", role=Role.LANDFILL, initial=(size, size), scale=size))
        if rng.random() < 0.3:
            control = Control(kind=ControlKind.RATE, low=0.0, neutral=0.0, high=1.0)
            rate = float(10 ** rng.uniform(-2.5, -1.3))
            self.arcs.append(
                Arc(
                    id=f"{name}_urban_mining",
                    donor=f"{name}_tip",
                    recipient=waste,
                    rate=rate,
                    control=control,
                    scale=size,
                )
            )

    def _node(self, name: str, residence: float | None, size: float = 1.0) -> None:
        """Add a node whose outflows are shares: without stock, or with one that holds metal for so long."""
        if residence is None:
            self.nodes.append(Node(id=name, stores=False, scale=max(size, 1.0)))
        else:
            held = size * residence
            self.nodes.append(Node(id=name, initial=(held, held), rate=1.0 / residence, scale=held))

    def _share(self, name: str, donor: str, recipient: str, share: float | Series, controlled: bool) -> None:
        if controlled and isinstance(share, float):
            control = Control(kind=ControlKind.SHARE, low=0.3 * share, neutral=share, high=min(1.0, 1.7 * share))
            self.arcs.append(Arc(id=name, donor=donor, recipient=recipient, law=Law.SHARE, control=control))
        else:
            self.arcs.append(Arc(id=name, donor=donor, recipient=recipient, law=Law.SHARE, share=share))

    def _changing(self, value: float) -> Series:
        """Return a value that ends at 80 to 120 % of what it begins with."""
        times = (0.0, self.years / 2, float(self.years))
        ends = value * np.array([1.0, *self.rng.uniform(0.8, 1.2, 2)])
        return Series(times=times, values=tuple(ends.tolist()), interpolation="linear")
