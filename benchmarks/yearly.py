"""How often the planner closes the gap on generated cycles of a material with yearly decisions (``make planner``).

A cycle has 1 to 5 regions. In each, a mine is dug by order, a market without stock shares metal out to products in use,
waste is gathered from these, recycled or lost, and goes round: residence times from a week to a century, some furnaces
and dumps of waste with stock and some without, trade between markets, numbers that change with the years.

With ``--family lifetimes`` there are more products, and one to thirty of these live for times of all kinds, some
of which agents prolong; some services are made up for from a mine, by agents or as usual.

For each network the command bounds λ̄ with every service met at 95 %, verifies the certificate, and improves the plan
until it keeps the services and comes within 1 % of the bound, or a minute has passed. Seeds are taken in an order drawn
once, so that those done so far are a fair sample; ``--kept FILE`` remembers them, and goes on where it was stopped.
"""

from __future__ import annotations

import json
import multiprocessing
import resource
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass, field
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.console import Console
from rich.progress import Progress
from rich.table import Table

from cirl_marl import (
    Arc,
    CirlError,
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
from cirl_marl.errors import unknown_name
from cirl_marl.network.elements import Lifetime
from cirl_marl.optimum import close_gap

WEEK = 1 / 52
DURABLE = 4.0
"""Life in years from which on a stock in use is what is needed; of what is used up sooner it is the supply."""
SEEDS = 200
LIMIT = 60.0
"""Seconds of processor time for each network."""
STOPPED = 90
"""Seconds of processor time after which it is given up, in the middle of a program."""
SERVICE = 0.95
"""Mean level demanded of each service."""
GAP = 0.01
"""Of the bound, within which a plan counts as close."""


@dataclass(frozen=True)
class Family:
    """What networks are drawn from.

    Attributes:
        years: fewest and most of an episode.
        regions: fewest and most.
        products: fewest and most of a region.
        lifetimes: fewest and most in all, as far as there are products; the others leave in proportion to their stock.
        prolonged: how often agents prolong a lifetime.
        supplied: how often a service of a stock in use is made up for.
        idle: how often nobody acts on such a supply.
    """

    years: tuple[int, int] = (10, 40)
    regions: tuple[int, int] = (1, 5)
    products: tuple[int, int] = (1, 5)
    lifetimes: tuple[int, int] = (0, 0)
    prolonged: float = 0.0
    supplied: float = 0.0
    idle: float = 0.0


RATES = Family()
"""Cycles without lifetimes."""
LIFETIMES = Family(years=(10, 50), products=(1, 8), lifetimes=(1, 30), prolonged=0.05, supplied=0.3, idle=0.3)
"""Cycles with them."""
REGIONAL = Family(years=(40, 40), regions=(4, 4), products=(2, 2), lifetimes=(8, 8), supplied=0.3)
"""Four regions with two products each."""
LARGE = Family(years=(50, 50), regions=(7, 7), products=(4, 6), lifetimes=(30, 30), supplied=0.3)
"""Seven regions, and thirty lifetimes."""
FAMILIES = {"rates": RATES, "lifetimes": LIFETIMES, "regional": REGIONAL, "large": LARGE}
KINDS = {
    "normal": (0.2, 0.5),
    "folded_normal": (0.2, 0.5),
    "lognormal": (0.2, 0.7),
    "weibull": (0.25, 0.7),
    "gamma": (0.25, 0.7),
    "exponential": (1.0, 1.0),
    "fixed": (0.0, 0.0),
}
"""Least and greatest deviation of each kind of lifetime, in parts of its mean."""


@dataclass(frozen=True)
class Outcome:
    """What became of one network.

    Attributes:
        seed: of the network.
        nodes: how many it has.
        years: of an episode.
        proved: the bound on λ̄, in shares of the scale of circularity; the lowest of those proved.
        gap: of the best plan that keeps the services; NaN without one.
        degree: at which the bound was proved.
        seconds: of processor time that it took.
        reason: why it does not count as closed; empty if it does.
    """

    seed: int
    nodes: int
    years: int
    proved: float = np.nan
    gap: float = np.nan
    degree: int = 0
    seconds: float = 0.0
    reason: str = ""


def planned(seed: int, family: Family = RATES) -> Outcome:
    """Bound the network of a seed, and improve its plan while there is time."""
    start = time.process_time()
    network = yearly_network(seed, family)
    size = len(network.nodes), network.episode.horizon
    level = SERVICE if network.services else None
    try:
        closure = close_gap(network, within=GAP, seconds=LIMIT, min_service=level)
    except CirlError as missing:
        return Outcome(seed, *size, seconds=time.process_time() - start, reason=str(missing))
    seconds, solution, reason = time.process_time() - start, closure.bound, ""
    if solution.verify().bound != solution.objective:
        reason = "the certificate does not prove the bound"
    elif np.isnan(closure.gap):
        reason = "the plan misses services"
    elif closure.gap > GAP:
        reason = f"a gap of {closure.gap:.2%}"
    elif seconds > LIMIT:
        reason = f"{seconds:.0f} s"
    highest = solution.objective / network.objective.circularity_scale
    return Outcome(seed, *size, highest, closure.gap, solution.degree, seconds, reason)


def planned_apart(seed: int, family: Family) -> Outcome:
    """Plan the network of a seed in a process of its own, which may not use more than ``STOPPED`` seconds."""
    receiver, sender = multiprocessing.Pipe(duplex=False)
    process = multiprocessing.get_context("fork").Process(target=_planned_into, args=(sender, seed, family))
    process.start()
    sender.close()
    try:
        return receiver.recv()  # type: ignore[no-any-return]
    except EOFError:
        network = yearly_network(seed, family)
        reason = f"not ended in {STOPPED} s"
        return Outcome(seed, len(network.nodes), int(network.episode.horizon), seconds=float(STOPPED), reason=reason)
    finally:
        process.join()


def _planned_into(sender: Connection, seed: int, family: Family) -> None:
    used = int(resource.getrusage(resource.RUSAGE_SELF).ru_utime)
    resource.setrlimit(resource.RLIMIT_CPU, (used + STOPPED, used + STOPPED))
    sender.send(planned(seed, family))


def yearly_network(seed: int, family: Family = RATES) -> Network:
    """Return the network of a seed: 5 to 60 nodes without lifetimes, up to 90 with them."""
    rng, lives = np.random.default_rng(seed), np.random.default_rng((seed, 1))
    years = int(rng.integers(*family.years, endpoint=True))
    cycle = _Cycle(family, rng, lives, years, int(lives.integers(*family.lifetimes, endpoint=True)))
    regions = int(rng.integers(*family.regions, endpoint=True))
    for region in range(regions):
        cycle.region(region, regions)
    idle = {arc.id for arc in cycle.arcs if arc.makes_up_for and lives.random() < family.idle}
    parts = (*cycle.nodes, *cycle.arcs)
    return Network(
        name=f"yearly_{seed}",
        nodes=tuple(cycle.nodes),
        arcs=tuple(cycle.arcs),
        services=tuple(cycle.services),
        episode=Episode(control_interval=1.0, horizon=years),
        objective=Objective(circularity_scale=cycle.demand),
        default_agents=tuple(part.id for part in parts if part.control is not None and part.id not in idle),
        mass_unit="kt",
        time_unit="year",
    )


@dataclass
class _Cycle:
    """The parts drawn so far.

    Attributes:
        family: from which they are drawn.
        rng: of the draws.
        lives: of those of lifetimes and supplies, apart, so that a network without them is the same in all families.
        years: of an episode.
        lifetimes: that are still to be drawn.
        demand: metal that all regions take up in a year, kt.
    """

    family: Family
    rng: np.random.Generator
    lives: np.random.Generator
    years: int
    lifetimes: int
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
        products = int(rng.integers(*self.family.products, endpoint=True))
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
                    f"{name}_to_{p}", f"{name}_market", f"{name}_use_{p}", self._changing(rest * weights[p], 1.0), False
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
        rate = self._changing(1.0 / life) if rng.random() < 0.3 else 1.0 / life
        if self.lifetimes:
            life = self._lifetime(node, flow)
        else:
            self.nodes.append(Node(id=node, initial=(flow * life,) * 2, rate=rate, scale=flow * life))
        stock = flow * life
        self._share(f"{node}_loss", node, f"{name}_tip", float(rng.uniform(0.05, 0.3)), bool(rng.integers(2)))
        self.arcs.append(Arc(id=f"{node}_end", donor=node, recipient=f"{name}_waste", law=Law.SHARE))
        if rng.random() < 0.6 or p == 0:
            growth = float(rng.uniform(-0.01, 0.02))
            durable = life >= DURABLE
            needed = 0.9 * (stock if durable else flow)
            ends = (needed, needed * (1 + growth) ** self.years)
            low: float | Series = needed
            if rng.random() < 0.7:
                low = Series(times=(0.0, float(self.years)), values=ends, interpolation="linear")
            provider, quantity = (node, "stock") if durable else (f"{name}_to_{p}", "flow")
            self.services.append(Service(id=f"{node}_needed", provider=provider, quantity=quantity, low=low))
            if durable and self.lives.random() < self.family.supplied:
                control = Control(
                    kind=ControlKind.FLOW, low=0.0, neutral=0.0, high=float(self.lives.uniform(0.3, 1.5) * flow)
                )
                self.arcs.append(
                    Arc(
                        id=f"{node}_supply",
                        donor=f"{name}_mine",
                        recipient=node,
                        law=Law.CONTROLLED,
                        control=control,
                        makes_up_for=f"{node}_needed",
                        scale=flow,
                    )
                )

    def _lifetime(self, node: str, flow: float) -> float:
        """Draw a product that has grown by a rate and lives for a time; return the mean of this."""
        lives, kind = self.lives, str(self.lives.choice(list(KINDS)))
        mean, deviation = float(10 ** lives.uniform(0.2, 1.8)), float(lives.uniform(*KINDS[kind]))
        mean = float(round(mean)) if kind == "fixed" else mean
        control, stretch = None, 1.0 if kind == "fixed" or lives.random() > 0.2 else self._changing(1.0, rng=lives)
        if kind != "fixed" and lives.random() < self.family.prolonged:
            control = Control(kind=ControlKind.STRETCH, low=0.9, neutral=1.0, high=1.25)
        self.lifetimes -= 1
        self.nodes.append(
            Node(
                id=node,
                initial=(flow * mean,) * 2,
                lifetime=Lifetime(mean=mean, deviation=deviation * mean or None, distribution=kind),
                growth=float(lives.uniform(-0.01, 0.03)),
                stretch=stretch,
                control=control,
                scale=flow * mean,
            )
        )
        return mean

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

    def _changing(self, value: float, most: float = 1.2, rng: np.random.Generator | None = None) -> Series:
        """Return a value that comes to 80 % or more of what it begins with, and at most to ``most``."""
        times = (0.0, self.years / 2, float(self.years))
        ends = value * np.array([1.0, *(rng or self.rng).uniform(0.8, most, 2)])
        return Series(times=times, values=tuple(ends.tolist()), interpolation="linear")


def main(
    seeds: Annotated[int, typer.Option(help="How many networks, from the first seed on.")] = SEEDS,
    first: Annotated[int, typer.Option(help="First seed.")] = 0,
    jobs: Annotated[int, typer.Option(help="Networks planned side by side.")] = 1,
    family: Annotated[str, typer.Option(help=f"What they are drawn from: {', '.join(FAMILIES)}.")] = "rates",
    kept: Annotated[
        Path | None, typer.Option(help="File with a line for each network done; they are not run again.")
    ] = None,
) -> None:
    """Plan generated networks, and tell which gaps do not close."""
    console = Console(width=None if sys.stdout.isatty() else 120)
    if (drawn_from := FAMILIES.get(family)) is None:
        raise typer.BadParameter(f"--family: {unknown_name('family', family, FAMILIES)}")
    lines = kept.read_text().splitlines() if kept is not None and kept.exists() else []
    outcomes = [Outcome(**json.loads(line)) for line in lines]
    order = np.random.default_rng(seeds).permutation(np.arange(first, first + seeds)).tolist()
    left = [seed for seed in order if seed not in {each.seed for each in outcomes}]
    with ThreadPoolExecutor(jobs) as pool, Progress(console=console) as progress:
        task = progress.add_task("networks", total=seeds, completed=len(outcomes))
        for outcome in pool.map(partial(planned_apart, family=drawn_from), left):
            outcomes.append(outcome)
            if kept is not None:
                with kept.open("a") as file:
                    file.write(json.dumps(asdict(outcome)) + "\n")
            closed = sum(not each.reason for each in outcomes)
            progress.update(task, advance=1, description=f"{closed} of {len(outcomes)} closed")
            if outcome.reason:
                console.print(f"{outcome.seed}: {outcome.reason}")
    _show(outcomes, console)


def _show(outcomes: list[Outcome], console: Console) -> None:
    gaps, times = (np.array([getattr(each, name) for each in outcomes]) for name in ("gap", "seconds"))
    table = Table("networks", "closed", "median gap", "largest gap", "median s", "largest s")
    closed = sum(not each.reason for each in outcomes)
    shown = [f"{np.nanmedian(gaps):.2%}", f"{np.nanmax(gaps):.2%}", f"{np.median(times):.1f}", f"{times.max():.1f}"]
    table.add_row(str(len(outcomes)), str(closed), *shown)
    console.print(table)
    rest = Table("seed", "nodes", "years", "bound/scale", "gap", "degree", "s", "reason")
    for each in outcomes:
        if each.reason:
            figures = [f"{each.proved:.4f}", f"{each.gap:.2%}", str(each.degree), f"{each.seconds:.0f}"]
            rest.add_row(str(each.seed), str(each.nodes), str(each.years), *figures, each.reason)
    console.print(rest)


if __name__ == "__main__":
    typer.run(main)
