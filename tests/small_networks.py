"""Networks of a few nodes with given stocks, and what becomes of these under neutral control."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from hypothesis import assume
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks.variants import without_substances
from cirl_marl import (
    Account,
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    Network,
    NetworkError,
    Node,
    PiecewiseRate,
    Role,
    Series,
    Service,
    Substance,
    load_network,
)
from cirl_marl.definitions.catalogue import families
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.network.disturbances import (
    AutoRegression,
    BlockBootstrap,
    Correlation,
    DisturbanceEffect,
    Markov,
    RandomWalk,
    Seasonal,
)
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.series import Value, extremes
from cirl_marl.network.uncertainty import CAPACITY, Spread

Floats = NDArray[np.float64]


def small(
    nodes: dict[str, float],
    arcs: list[Arc],
    *,
    interval: float = 1.0,
    horizon: int = 5,
    solver: str = "exact",
) -> Network:
    """Return a network with given initial stocks."""
    return Network(
        name="small",
        nodes=tuple(Node(id=name, initial=(stock, stock)) for name, stock in nodes.items()),
        arcs=tuple(arcs),
        episode=Episode(
            control_interval=interval,
            horizon=horizon,
            solver=solver,
            solver_step=None if solver == "exact" else interval,
        ),
    )


ACCOUNTS = (Account(id="cost", unit="EUR_2023", discount=0.04), Account(id="emissions", unit="t CO2e"))


def booked(network: Network, seed: int, *, credits: bool = True, efforts: bool = True) -> Network:
    """Return a network whose compartments book random amounts, some of which change in time."""
    rng = np.random.default_rng([seed, 7])
    length = network.episode.control_interval * network.episode.horizon

    def rates() -> dict[str, float | Series]:
        chosen: dict[str, float | Series] = {}
        for account in ("cost", "emissions"):
            value = float(rng.normal() if credits else abs(rng.normal()))
            if rng.random() < 0.6:
                step = Series(times=(0.0, length / 3), values=(value, 2 * value))
                chosen[account] = step if rng.random() < 0.3 else value
        return chosen

    nodes = tuple(replace(n, accounts=rates(), holding=rates() if n.stores else {}) for n in network.nodes)
    arcs = tuple(replace(a, accounts=rates()) for a in network.arcs)
    if efforts:
        nodes, arcs = (tuple(_with_effort(part, rng) for part in parts) for parts in (nodes, arcs))
    return replace(network, nodes=nodes, arcs=arcs, accounts=ACCOUNTS, scenarios={})


def _with_effort(part: Any, rng: np.random.Generator) -> Any:
    """Return a node or an arc whose control, if it has one that is ever neutral, costs a random effort or none."""
    rate = float(10 * abs(rng.normal()))
    if part.control is None or (isinstance(part, Arc) and part.makes_up_for) or rng.random() < 0.3:
        return part
    return replace(part, effort={"cost": rate, **({"emissions": 0.1 * rate} if rng.random() < 0.5 else {})})


def with_lambda(network: Network) -> Network:
    """Return a network with an account of what moves finite-time sustainably: −λ̄·T/Δ if nothing is absolute."""
    signs = zip(network.arcs, network.sustainability.tolist(), strict=True)
    arcs = tuple(replace(arc, accounts={"moved": sign}) for arc, sign in signs)
    return replace(network, arcs=arcs, accounts=(Account(id="moved", unit=network.mass_unit),), scenarios={})


def city() -> Network:
    """Return the paper cycle of a city in which recycled fibre is cheaper than virgin one, and emits more."""
    network = load_network("paper_city")
    costs = {"virgin_fibre": 600.0, "collection": 40.0, "feed": 90.0, "bales_to_mill": 15.0}
    emissions = {"virgin_fibre": 0.2, "feed": 0.6, "bales_to_mill": 0.5}
    arcs = tuple(
        replace(
            arc,
            accounts={
                **({"cost": costs[arc.id]} if arc.id in costs else {}),
                **({"emissions": emissions[arc.id]} if arc.id in emissions else {}),
            },
        )
        for arc in network.arcs
    )
    nodes = tuple(replace(n, holding={"cost": 0.5}) if n.id in ("hall", "bales") else n for n in network.nodes)
    parts: dict[str, Any] = {"arcs": arcs, "nodes": nodes, "services": network.services[:1], "accounts": ACCOUNTS}
    return replace(network, name="city", scenarios={}, **parts)


NO_STATES = np.empty((0, 1))


def neutral_rate(dynamics: Dynamics, step: int = 0) -> Floats:
    """Return the rates under neutral control."""
    return dynamics.rate(dynamics.neutral[:, [step]], np.array([step]))


def start(network: Network) -> Floats:
    """Return the upper initial stocks with the unit row, one column."""
    return np.append(network.initial[1], 1.0)[:, None]


def constant(value: Value | None) -> float:
    """Return a number of a network that does not change in time."""
    assert isinstance(value, float)
    return value


def advanced(network: Network, steps: int = 1) -> Floats:
    """Return the stocks after ``steps`` intervals of neutral control, shape (stores,)."""
    if steps > network.episode.horizon:
        network = network.with_options(episode={"horizon": steps})
    dynamics, stock = Dynamics(network), start(network)
    for step in range(steps):
        stock = dynamics.advance(stock, NO_STATES, dynamics.neutral[:, [step]], np.array([step])).stock
    return stock[:-1, 0]


def cycle(interval: float = 1.0, hoarded: float = 40.0) -> Network:
    """Return a cycle whose plants hold metal for weeks, with strong loops of markets and a hoard that may run empty."""

    def share(name: str, donor: str, recipient: str, low: float, high: float) -> Arc:
        control = Control(kind=ControlKind.SHARE, low=low, neutral=low + 0.1 * (high - low), high=high)
        return Arc(id=name, donor=donor, recipient=recipient, law=Law.SHARE, control=control)

    def order(name: str, donor: str, recipient: str, high: float) -> Arc:
        control = Control(kind=ControlKind.FLOW, low=0.1 * high, neutral=0.5 * high, high=high)
        return Arc(id=name, donor=donor, recipient=recipient, law=Law.CONTROLLED, control=control)

    def rest(name: str, donor: str, recipient: str, given: float | Series | None = None) -> Arc:
        return Arc(id=name, donor=donor, recipient=recipient, law=Law.SHARE, share=given)

    valve = Control(kind=ControlKind.RATE, low=0.5, neutral=1.0, high=1.5)
    changing = Series(times=(0.0, 4.0), values=(0.1, 0.3), interpolation="linear")
    nodes = (
        Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR),
        Node(id="market", stores=False),
        Node(id="use", initial=(100.0, 100.0), rate=0.3, control=valve),
        Node(id="cans", initial=(20.0, 20.0), rate=2.5),
        Node(id="trade", stores=False),
        Node(id="waste", initial=(3.0, 3.0), rate=18.0),
        Node(id="plant", initial=(1.0, 1.0), rate=24.0),
        Node(id="hoard", initial=(hoarded, hoarded)),
        Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
    )
    arcs = (
        order("mining", "mine", "market", 20.0),
        share("to_cans", "market", "cans", 0.1, 0.7),
        share("abroad", "market", "trade", 0.05, 0.9),
        rest("to_use", "market", "use"),
        share("back", "trade", "market", 0.3, 0.95),
        rest("lost", "trade", "tip"),
        rest("cans_waste", "cans", "waste"),
        rest("use_loss", "use", "tip", changing),
        rest("use_waste", "use", "waste"),
        share("recycling", "waste", "plant", 0.2, 0.8),
        share("hoarding", "waste", "hoard", 0.0, 0.5),
        rest("dumping", "waste", "tip", 0.2),
        rest("burning", "waste", "tip"),
        rest("slag", "plant", "tip", 0.1),
        rest("metal", "plant", "market"),
        order("release", "hoard", "plant", 30.0),
    )
    services = (
        Service(id="housed", provider="use", quantity="stock", low=90.0),
        Service(id="traded", provider="trade", quantity="outflow", low=Series(times=(0.0, 2.0), values=(5.0, 9.0))),
    )
    episode = Episode(control_interval=interval, horizon=4)
    return Network(name="cycle", nodes=nodes, arcs=arcs, services=services, episode=episode)


def mill(seed: int) -> Network:
    """Return ore and two kinds of scrap, one of them sorted, of which products with little copper are made at a cost.

    In half of the networks these have a lifetime.
    """
    rng = np.random.default_rng(seed)
    cost = iter(rng.uniform(0.2, 3.0, 4).tolist())
    high = float(rng.uniform(6, 12))
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=2.0, high=high)
    sorting = Control(
        kind=ControlKind.TRANSFER, low=0.1, neutral=0.1, high=float(rng.uniform(0.3, 0.8)), substances=("copper",)
    )
    scrap = [
        Node(id=name, initial=(200.0, 200.0), content={"copper": float(rng.uniform(0.01, 0.06))})
        for name in ("cars", "cans")
    ]
    use: dict[str, Any] = {"rate": 0.2}
    if rng.random() < 0.5:
        use = {"lifetime": Lifetime(mean=6.0, deviation=2.0, distribution="normal")}
    nodes = (
        Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR, initial=(200.0, 200.0)),
        *scrap,
        Node(id="sorter", stores=False),
        Node(id="melt", stores=False),
        Node(id="use", initial=(30.0, 30.0), content={"copper": 0.01}, **use),
        Node(id="landfill", role=Role.LANDFILL),
    )
    flows = {"ore": "melt", "cars": "sorter", "cans": "melt"}
    orders = (
        Arc(
            id=f"{donor}_in",
            donor=donor,
            recipient=to,
            law=Law.CONTROLLED,
            control=order,
            accounts={"cost": next(cost)},
        )
        for donor, to in flows.items()
    )
    arcs = (
        *orders,
        Arc(id="sorted", donor="sorter", recipient="melt", law=Law.SHARE),
        Arc(
            id="rejects",
            donor="sorter",
            recipient="landfill",
            law=Law.SHARE,
            share=0.05,
            control=sorting,
            accounts={"cost": next(cost)},
        ),
        Arc(id="made", donor="melt", recipient="use", law=Law.SHARE),
        Arc(id="left", donor="use", recipient="landfill", law=Law.SHARE),
    )
    products = Service(id="products", provider="made", quantity="flow", low=float(rng.uniform(5, 12)))
    clean = replace(products, id="clean", substance="copper", low=0.0, high=float(rng.uniform(0.005, 0.03)))
    return Network(
        name="mill",
        nodes=nodes,
        arcs=arcs,
        services=(products, clean),
        substances=(Substance(id="copper", scale=0.01),),
        accounts=(Account(id="cost", unit="EUR_2023"),),
        mass_unit="t",
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=4),
    )


def without_lifetimes(network: Network) -> Network:
    """Return the network with a rate and a valve wherever it has a lifetime and a stretch."""
    nodes = []
    for node in network.nodes:
        if node.lifetime is not None:
            control = None if node.control is None else replace(node.control, kind=ControlKind.RATE)
            initial = node.initial or (0.0, 100.0)
            plain: dict[str, Any] = {
                "lifetime": None,
                "stretch": 1.0,
                "history": None,
                "growth": None,
                "rate": 1 / node.lifetime.mean,
            }
            content = {name: extremes(part)[1] / 2 for name, part in dict(node.content).items()}
            node = replace(node, control=control, initial=initial, content=content, **plain)
        nodes.append(node)
    return replace(network, nodes=tuple(nodes))


plain_networks = st.from_type(Network).map(without_lifetimes).map(without_substances)
"""Networks of which every node with a stock is one row of the simulator."""


LARGE = ("steel_world",)
"""Networks of hundreds of agents, which have tests of their own; what these cost with all others is too much."""
ALIKE = ("aluminium_world",)
"""Made like ``copper_world``, with other numbers, which ``test_world_cycles.py`` asserts."""
ONE_OF_EACH = [names[0] for names in families().values() if names[0] not in (*LARGE, *ALIKE)]
"""A network of each other definition of the catalogue."""
PLAYED = [
    (name, scenario)
    for name in ONE_OF_EACH
    for scenario in ("default", *load_network(name).scenarios)
    if load_network(name, scenario=scenario).agents
]
"""Their scenarios in which somebody acts."""


KINDS: Mapping[str, Any] = {
    "price": AutoRegression(deviation=0.3, persistence=0.8, logarithm=True, low=0.6, high=1.5, forecast=2),
    "ore": AutoRegression(deviation=0.2, persistence=-0.5, low=0.8, high=1.1, start=1.05, delayed=2),
    "walk": RandomWalk(deviation=0.1, drift=0.02, low=0.7, high=1.3),
    "climb": RandomWalk(deviation=0.1, low=0.7, high=1.3, start=1.2, logarithm=True),
    "outage": Markov(values=(1.0, 0.4, 0.7), matrix=((0.8, 0.15, 0.05), (0.5, 0.5, 0.0), (0.3, 0.0, 0.7))),
    "stop": Markov(values=(1.0, 0.5), lengths=(8.0, 2.0), start=2),
    "season": Seasonal(profile=(1.0, 1.2, 0.9), period=4.0, deviation=0.1, persistence=0.6, observed="none"),
    "harvest": Seasonal(profile=(0.8, 1.2), period=3.0, deviation=0.2, logarithm=True),
    "record": BlockBootstrap(values=(1.0, 0.8, 1.2, 1.1, 0.9), block=2.5),
}
CORRELATION = Correlation(names=("price", "walk", "season"), matrix=((1, 0.8, -0.3), (0.8, 1, 0.0), (-0.3, 0.0, 1)))


@st.composite
def disturbed_networks(draw: st.DrawFn) -> Network:
    """Draw networks with numbers of every kind that are disturbed, and some that are uncertain, too."""
    network = draw(st.from_type(Network))
    paths = [f"arcs.{arc.id}.{name}" for arc in network.arcs for name in ("rate", "flow", "share", "capacity_rate")]
    paths += [f"nodes.{node.id}.{name}" for node in network.nodes for name in ("rate", "stretch")]
    paths += [f"{kind}.{part.id}.{CAPACITY}" for kind in ("nodes", "arcs") for part in getattr(network, kind)]
    paths += [f"services.{service.id}.{end}" for service in network.services for end in ("low", "high")]
    names = {name: kind for name, kind in KINDS.items() if kind.ends[0] > 0}
    names |= {"more": AutoRegression(mean=0.0, deviation=1e-3, persistence=0.5)}
    spread = Spread(low=0.8, high=1.1, distribution="uniform")
    network = replace(network, disturbances=names, correlation=CORRELATION, scenarios={})
    for path in draw(st.lists(st.sampled_from(paths), unique=True, min_size=1, max_size=8)):
        by, adds = draw(st.sampled_from([*KINDS])), draw(st.booleans())
        disturbed = DisturbanceEffect(by="more" if adds else by, adds=adds)
        uncertain = {path: spread} if draw(st.booleans()) else {}
        try:
            network = replace(
                network,
                disturbed={**network.disturbed, path: disturbed},
                uncertain={**network.uncertain, **uncertain},
            )
        except NetworkError:
            pass  # this number is not stated, or may become 0
    assume(network.disturbed)
    step = network.episode.solver_step  # the fastest draws need a shorter one
    interval = network.episode.control_interval
    return network.with_options(episode={} if step is None else {"solver_step": interval / round(3 * interval / step)})


def in_pieces(network: Network, seed: int) -> Network:
    """Return a network some of whose certain rates on accounts rise with what is charged for, in two or three pieces.

    What flows, is held, or is away from neutral may be below, between and beyond the amounts at which they do.
    """
    rng = np.random.default_rng([seed, 11])

    def pieces(rate: float, scale: float) -> PiecewiseRate | float:
        if rng.random() < 0.3:
            return rate
        count = int(rng.integers(1, 3))
        to, rises = np.cumsum(scale * rng.uniform(0.05, 1.0, count)), np.cumsum(abs(rng.normal(size=count)) + 0.01)
        course = Series(times=(0.0, network.episode.control_interval), values=(1.0, 0.5))
        rates = (rate, *(rate + abs(rate) * rises + rises).tolist())
        return PiecewiseRate(to=tuple(to.tolist()), rates=rates, factor=course if rng.random() < 0.3 else 1.0)

    def rising(part: Any) -> Any:
        held = (part.initial[1] if isinstance(part, Node) and part.initial else 0.0) or part.scale
        width = 1.0
        if part.control is not None:
            width = extremes(part.control.high)[1] - extremes(part.control.low)[0] or 1.0
        scales = {"accounts": part.scale, "holding": held, "effort": width}
        fields = {
            name: {a: r if isinstance(r, Series) else pieces(r, scale) for a, r in dict(getattr(part, name)).items()}
            for name, scale in scales.items()
            if hasattr(part, name)
        }
        return replace(part, **fields)

    return replace(network, nodes=tuple(map(rising, network.nodes)), arcs=tuple(map(rising, network.arcs)))
