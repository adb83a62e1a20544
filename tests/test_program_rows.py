"""Every row and box of the program holds for every simulated episode, and its objective is the episode's.

The values that an episode gives the variables come from ``exact_episode``, an oracle of its own; it is held against the
simulator in each test. A row that is too tight for one of these episodes would make the bound wrong.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pytest
from exact_episode import (
    SCHEDULED,
    Controls,
    Interval,
    control_of,
    imbalance,
    intervals,
    mean_of,
    means,
    share_of,
    valve_of,
)
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.special import exprel
from small_networks import cycle, plain_networks

from benchmarks.yearly import RATES, yearly_network
from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Objective,
    Role,
    Service,
)
from cirl_marl.network.elements import FIXED_LIFETIME
from cirl_marl.network.series import Series
from cirl_marl.network.split_fractions import splits
from cirl_marl.optimum import NoCertificate, bound
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.kernels import stock_response
from cirl_marl.optimum.matrices import Layout
from cirl_marl.optimum.program import Program, Programs
from cirl_marl.optimum.quasi_steady import cut_responses
from cirl_marl.optimum.solver import solve

Floats = NDArray[np.float64]
RELATIVE = 1e-9
"""Tolerance relative to the magnitude of a row or box: the program's own widening of what is computed in floats."""
ROUND_OFF = 1e-12
"""Tolerance relative to the mass in the network, as the simulator rounds relative to it."""


@dataclass(frozen=True, slots=True)
class Played:
    """An episode and what the program needs to know of it.

    Attributes:
        network: with its one start.
        agents: who acted.
        start: stocks at the start.
        intervals: what happened.
        circularity: λ̄ in the simulator.
        levels: mean level of each service in the simulator, shape (services,).
    """

    network: Network
    agents: tuple[str, ...]
    start: Floats
    intervals: list[Interval]
    circularity: float
    levels: Floats

    @property
    def service(self) -> float:
        """Mean level of the services; 1 without any."""
        return float(self.levels.mean()) if self.levels.size else 1.0

    @property
    def cut(self) -> bool:
        """Whether a donor ran short of what was scheduled."""
        return any(piece.cut for each in self.intervals for piece in each.pieces)


def scaled(value: float | Series, factor: float) -> float | Series:
    """Return a number that may change in time, times a factor."""
    if isinstance(value, Series):
        return replace(value, values=tuple(factor * each for each in value.values))
    return factor * value


def certifiable(network: Network, interval: float, pulls: bool) -> Network:
    """Return the network without batches, which become constant demands, and with the exact solver."""
    arcs = []
    for arc in network.arcs:
        if arc.law is Law.BATCH:
            arc = replace(arc, law=Law.EXOGENOUS, flow=80.0, batches=(), delay=0.0)
        elif arc.law is Law.RECIPIENT:
            law = Law.RECIPIENT if pulls else Law.DONOR
            arc = replace(arc, law=law, rate=scaled(arc.rate, 0.02 if pulls else 1.0))
        arcs.append(arc)
    nodes = [replace(node, initial=node.initial and (node.initial[1],) * 2) for node in network.nodes]
    shorter = min(interval, network.episode.control_interval)  # which its series cover
    for i, node in enumerate(nodes):
        if node.lifetime is not None and node.lifetime.distribution == FIXED_LIFETIME:  # of so many intervals
            mean = node.lifetime.mean * shorter / network.episode.control_interval
            nodes[i] = replace(node, lifetime=replace(node.lifetime, mean=mean))
    episode = replace(network.episode, control_interval=shorter, solver="exact", solver_step=None)
    return replace(network, nodes=tuple(nodes), arcs=tuple(arcs), episode=episode)


def bounds_of(network: Network, agent: str) -> tuple[float | Series, float | Series]:
    """Return the ends of the range of an agent's control."""
    control = control_of(network, agent)
    return control.low, control.high


def play(
    network: Network,
    rng: np.random.Generator,
    style: str,
    agents: Sequence[str] | None = None,
    fixed: Mapping[str, float] | None = None,
) -> Played:
    """Return an episode with controls drawn for each interval, at the ends of their ranges or anywhere in them.

    Args:
        network: with one start.
        rng: of the actions.
        style: ``inside``, ``ends``, or mostly ``low`` or ``high``.
        agents: who acts; None is the network's own choice.
        fixed: actions of some agents that are not drawn.

    Raises:
        AssertionError: if the oracle and the simulator disagree.
    """
    env = MultiAgentVectorEnv(network, num_envs=1, agents=agents)
    env.reset(seed=0)
    start = env.physical.stock[: len(network.stores), 0].copy()
    held: list[Controls] = []
    circularity = 0.0
    for step in range(network.episode.horizon):
        action = rng.uniform(-1, 1, len(env.agents))
        if style != "inside":
            action = np.where(rng.random(len(action)) < {"low": 0.9, "high": 0.1, "ends": 0.5}[style], -1.0, 1.0)
        action = np.array([(fixed or {}).get(agent, each) for agent, each in zip(env.agents, action, strict=True)])
        values = {each: mean_of(network, control_of(network, each).neutral, step) for each in network.controllable}
        for agent, chosen in zip(env.agents, action.tolist(), strict=True):
            low, high = (mean_of(network, end, step) for end in bounds_of(network, agent))
            values[agent] = low + (chosen + 1) / 2 * (high - low)
        held.append(values)
        outcome = env.advance(action[:, None])
        circularity += float(outcome.circularity_mean[0]) / network.episode.horizon
    happened = list(intervals(network, start, held, env.dynamics.substeps))
    mass, delta = start.sum(), network.objective.reference_interval
    end = env.physical.stock[: len(network.stores), 0]
    np.testing.assert_allclose(happened[-1].pieces[-1].end, end, rtol=1e-9, atol=1e-11 * mass)
    size = delta * max(float(each.flow.sum()) for each in happened)
    assert abs(circularity - np.mean([each.circularity for each in happened])) <= 1e-10 * size + 1e-12 * mass
    levels = env.physical.service[:, 0] / network.episode.horizon
    np.testing.assert_allclose(levels, np.mean([each.levels for each in happened], axis=0), atol=1e-6)
    return Played(network, env.agents, start, happened, circularity, levels)


def variables(layout: Layout, happened: Sequence[Interval]) -> Floats:
    """Return v of an episode: for each piece X_i, F_i, Z_i and the stocks at its end; levels, imbalance, valves."""
    network = layout.network
    names = [node.id for node in network.nodes]
    entering = np.zeros((len(network.arcs), len(network.nodes)))
    entering[np.arange(len(network.arcs)), network.recipients] = 1.0
    entering = entering[:, len(network.stores) :]
    found: list[Floats] = []
    for step, each in enumerate(happened):
        valve = np.array([valve_of(network, name, each.controls) for name in names])
        together = len(each.pieces) // layout.pieces
        for first in range(0, len(each.pieces), together):
            merged = each.pieces[first : first + together]
            for stock, flow in zip(*means(merged, layout.degree), strict=True):
                stock = np.append(stock, flow @ entering)  # what passes through nodes that store nothing
                found += [stock, flow, (valve * stock)[layout.valves]]
            found.append(merged[-1].end)
            if layout.has_end_flows:
                found += [merged[-1].end_flow @ entering, merged[-1].end_flow]
        parts = [each.pieces[first : first + together] for first in range(0, len(each.pieces), together)]
        flow = np.concatenate([means(part, layout.degree)[1] for part in parts])
        refilled = np.isin(network.donors, network.recipients) & (len(each.pieces) > 1)
        in_part = np.isin(np.arange(len(network.arcs)), layout.steady_arcs)
        steady = np.where(refilled, np.where(in_part, flow.min(axis=0), 0.0), flow[0])
        found += constant_parts(layout, each.controls, step, steady)
        found += [each.levels, np.array([imbalance(network, each.flow)]), valve[layout.free_valves]]
    return np.concatenate(found)


def constant_parts(layout: Layout, controls: Controls, step: int, flow: Floats) -> list[Floats]:
    """Return what of throughputs, and of what nodes without stock hand on, comes from given scheduled flows."""
    network, scheduled = layout.network, np.array([arc.law in SCHEDULED for arc in layout.network.arcs], dtype=bool)
    stores, nodes = len(network.stores), len(network.nodes)
    shares = np.zeros(len(network.arcs))
    through = np.flatnonzero(network.donors >= stores)
    shares[through] = [share_of(network, network.arcs[k], controls, step) for k in through]
    handed_on = np.zeros((nodes, nodes))
    np.add.at(handed_on, (network.recipients[through], network.donors[through]), shares[through])
    entering = np.bincount(network.recipients[scheduled], flow[scheduled], nodes)
    entering[:stores] = 0.0
    constant = np.linalg.solve(np.eye(nodes) - handed_on, entering)
    arcs = layout.steady_arcs
    handed = np.where(network.donors[arcs] >= stores, shares[arcs] * constant[network.donors[arcs]], flow[arcs])
    return [constant[layout.steady_nodes], handed]


def assert_satisfies(problem: Program, v: Floats, mass: float) -> None:
    """A v = b, G v ≤ g, l ≤ v ≤ u, each to a tolerance relative to its own terms."""
    for matrix, to, both in ((problem.equal, problem.equal_to, True), (problem.under, problem.under_to, False)):
        size = abs(matrix) @ np.abs(v) + np.abs(to)
        largest = np.asarray(abs(matrix).max(axis=1).todense()).ravel() if matrix.shape[0] else np.zeros(0)
        excess = matrix @ v - to
        excess = np.abs(excess) if both else excess
        wrong = excess > RELATIVE * size + ROUND_OFF * mass * largest
        row = int(wrong.argmax()) if wrong.any() else -1
        assert not wrong.any(), f"{'A' if both else 'G'}, row {row} of {len(to)}: off by {excess[row]}, of {size[row]}"
    slack = RELATIVE * np.maximum(np.abs(problem.low), np.abs(problem.high)) + ROUND_OFF * mass
    for wrong, of in ((v < problem.low - slack, "l"), (v > problem.high + slack, "u")):
        column = int(wrong.argmax())
        place = divmod(column, problem.layout.size)
        assert not wrong.any(), f"{of}: variable {place} is {v[column]}, out of its box"


def assert_holds(played: Played, degree: int, weight: float | None = None, merged: bool = False) -> None:
    """All rows hold for the episode and for its second half, and the objective is the simulator's.

    Raises:
        NoCertificate: if recipients may empty their donors from the start.
    """
    for steady_parts in (False, True):
        admissible = Admissible.of(played.network, played.agents or None)
        programs = Programs(admissible, degree, weight, merge_pieces=merged, steady_parts=steady_parts)
        assert_rows_hold(played, programs, weight)


def assert_rows_hold(played: Played, programs: Programs, weight: float | None) -> None:
    """Do what ``assert_holds`` does, for one way to write the rows."""
    network, steps = played.network, played.network.episode.horizon
    layout, mass = programs.layout, float(played.start.sum())
    if len(played.intervals[0].pieces) % layout.pieces:
        return  # the oracle's means are over whole substeps
    v = variables(layout, played.intervals)
    problem = programs.program(played.start, played.levels)
    assert_satisfies(problem, v, mass)
    for s in range(len(network.services)):  # each row holds its own service, and is met by no less than its level
        above = np.where(np.arange(len(played.levels)) == s, played.levels + 1e-5, 0.0)
        missed = programs.program(played.start, above)
        short = missed.under @ v - missed.under_to
        assert np.flatnonzero(short[len(short) - len(above) :] > 5e-6).tolist() == [s]
    objective = played.circularity
    if weight is not None:
        objective = objective / network.objective.circularity_scale + weight * played.service
    found = problem.constant - float(problem.cost @ v)
    slack = 1e-9 * float(np.abs(problem.cost) @ np.abs(v)) + 1e-13 * mass  # flows that cancel leave what rounding does
    assert abs(found - objective) <= slack + 1e-6 * (weight or 0.0)
    half = steps // 2
    if half:
        levels = np.mean([each.levels for each in played.intervals[half:]], axis=0)
        later = programs.program(played.intervals[half - 1].pieces[-1].end, levels, range(half, steps))
        assert_satisfies(later, v[half * layout.size :], mass)


@given(
    network=plain_networks,
    interval=st.floats(0.02, 3.0),
    pulls=st.booleans(),
    seed=st.integers(0, 1000),
    style=st.sampled_from(["inside", "ends", "low", "high"]),
    degree=st.integers(1, 3),
    weight=st.sampled_from([None, 0.7]),
    merged=st.booleans(),
)
def test_random_networks(
    network: Network,
    interval: float,
    pulls: bool,
    seed: int,
    style: str,
    degree: int,
    weight: float | None,
    merged: bool,
) -> None:
    """Random networks with orders, valves, shares, series and pulls, under random admissible controls."""
    network = certifiable(network, interval, pulls)
    rng = np.random.default_rng(seed)
    agents = [agent for agent in network.agents if rng.random() < 0.8] or None
    try:
        Programs(Admissible.of(network, agents), 1, None).program(network.initial[1])
    except NoCertificate:
        assume(False)
    assert_holds(play(network, rng, style, agents), degree, weight, merged)


@pytest.mark.slow
def test_the_random_networks_reach_what_matters(make_network: Callable[[int, int, int], Network]) -> None:
    """Among thirty of them are cut flows, valves on scheduled flows, series, several substeps, |net flow|, service."""
    met = dict.fromkeys(
        ("cut", "valve", "series", "shares", "passing", "changing", "substeps", "abs", "service", "limited"), 0
    )
    for seed in range(30):
        network = certifiable(make_network(seed, 3 + seed % 6, 4 + seed % 9), 0.3, pulls=False)
        rng = np.random.default_rng(seed)
        played = play(network, rng, ["inside", "ends", "low", "high"][seed % 4])
        assert_holds(played, 1 + seed % 2, [None, 0.7][seed % 2])
        layout = Programs(Admissible.of(network), 1, None).layout
        met["cut"] += played.cut
        met["valve"] += len(layout.free_valves) > 0
        met["series"] += any(isinstance(arc.flow, Series) for arc in network.arcs)
        met["shares"] += any(split.controlled_arcs for split in splits(network))
        met["passing"] += len(network.stores) < len(network.nodes)
        met["changing"] += len(np.unique(Admissible.of(network).kinds)) > 1
        met["substeps"] += layout.pieces > 1
        met["limited"] += any(arc.capacity_node for arc in network.arcs)
        met["abs"] += network.objective.net_zero == "abs" and any(imbalance(network, e.flow) for e in played.intervals)
        met["service"] += 0 < played.service < 1
    assert min(met.values()) >= 5, met


def rate_control(low: float, high: float) -> Control:
    """Return a valve that is neutral in the middle."""
    return Control(kind=ControlKind.RATE, low=low, high=high, neutral=(low + high) / 2)


def order(name: str, donor: str, recipient: str, high: float) -> Arc:
    """Return an arc whose flow is set between a tenth of ``high`` and ``high``."""
    control = Control(kind=ControlKind.FLOW, low=0.1 * high, high=high, neutral=0.5 * high)
    return Arc(id=name, donor=donor, recipient=recipient, law=Law.CONTROLLED, control=control)


def works(
    stock: float = 12.0,
    *,
    valve: tuple[float, float] | None = None,
    asked: float = 60.0,
    interval: float = 0.8,
    net_zero: str = "abs",
) -> Network:
    """Return a store that runs empty, with a free exit, an order and a series; and what becomes of it.

    In an interval of 0.8 there are several substeps, in one of 0.35 a single one.

    Args:
        stock: in the store at the start.
        valve: range of the valve on all that leaves the store; None for none.
        asked: most that can be ordered from it.
        interval: between two decisions.
        net_zero: of the objective.
    """
    nodes = (
        Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(9000.0, 9000.0), control=rate_control(0.5, 1.5)),
        Node(id="store", initial=(stock, stock), control=None if valve is None else rate_control(*valve)),
        Node(id="use", initial=(30.0, 30.0), control=rate_control(0.2, 1.0)),
        Node(id="sort", initial=(5.0, 5.0), control=rate_control(0.4, 1.2)),
        Node(id="air", role=Role.ENVIRONMENT, initial=(40.0, 40.0)),
        Node(id="tip", role=Role.LANDFILL),
    )
    arcs = (
        order("mining", "mine", "store", 20.0),
        Arc(id="free", donor="store", recipient="use", rate=1.2, control=rate_control(0.1, 1.6)),
        order("supply", "store", "use", asked),
        Arc(
            id="demand",
            donor="store",
            recipient="use",
            law=Law.EXOGENOUS,
            flow=Series(times=(0.0, 0.5, 1.3), values=(10.0, 25.0, 3.0)),
            control=rate_control(0.5, 1.0),
        ),
        Arc(id="loss", donor="use", recipient="sort", rate=0.5),
        Arc(id="waste", donor="sort", recipient="tip", rate=0.8),
        Arc(id="leak", donor="mine", recipient="tip", rate=0.02),
        Arc(id="pull", donor="mine", recipient="use", law=Law.RECIPIENT, rate=0.05),
        Arc(id="emission", donor="use", recipient="air", rate=0.9, control=rate_control(0.3, 1.0)),
        Arc(id="repair", donor="use", recipient="store", law=Law.EXOGENOUS, flow=2.0),
        order("capture", "air", "use", 9.0),
    )
    services = (
        Service(id="held", provider="use", quantity="stock", low=40.0, high=60.0),
        Service(id="sent", provider="store", quantity="outflow", low=30.0),
        Service(id="met", provider="demand", quantity="flow", low=10.0),
    )
    return Network(
        name="works",
        nodes=nodes,
        arcs=arcs,
        services=services,
        episode=Episode(control_interval=interval, horizon=4),
        objective=Objective(reference_interval=1.3, net_zero=net_zero, circularity_scale=20.0),
    )


DRAINING = {"free": 1.0, "supply": 1.0, "demand": 1.0, "store": 1.0, "mining": -1.0, "mine": -1.0}
"""Actions that leave least in the store."""
MIXED = {"free": -1.0, "supply": 1.0, "demand": -1.0, "store": 1.0, "mining": -1.0}
"""One order at its most, another at its least, and a cut that is shared by both."""


@pytest.mark.sample(4)
@pytest.mark.parametrize("style", ["inside", "ends", "low", "high", "draining", "mixed"])
@pytest.mark.parametrize("valve", [None, (0.3, 1.4), (0.0, 1.0)])
@pytest.mark.parametrize(("stock", "asked"), [(12.0, 60.0), (0.0, 60.0), (700.0, 5.0)])
@pytest.mark.parametrize("interval", [0.8, 0.35])
def test_a_store_that_runs_empty(
    interval: float, stock: float, asked: float, valve: tuple[float, float] | None, style: str
) -> None:
    """A store that runs empty, or never, with exits in proportion and by schedule, behind a valve or not."""
    network = works(stock, valve=valve, asked=asked, interval=interval)
    rng = np.random.default_rng(7)
    fixed = {"draining": DRAINING, "mixed": MIXED}.get(style, {})
    cut = False
    for degree, weight in ((1, None), (2, 0.4)):
        played = play(network, rng, "ends" if fixed else style, fixed=fixed)
        assert_holds(played, degree, weight)
        cut |= played.cut
    assert cut or stock == 700.0 or style == "low"
    programs = Programs(Admissible.of(network), 1, None)
    layout, supply = programs.layout, network.arc_index["supply"]
    least = programs.program(network.initial[1]).low[layout.flow[0] + supply]
    some = stock == 700.0 or (stock > 0 and layout.pieces == 1)  # all, or of what there is at first
    assert (least > 0) == (some and (valve is None or valve[0] > 0))
    assert (network.node_index["store"] in layout.free_valves) == (valve is not None)
    assert (layout.pieces > 1) == (interval == 0.8)


def test_a_stock_that_gathers_all_there_is() -> None:
    """What two nodes held ends in a third, more than the largest had at first; its bound must allow that."""
    nodes = (*(Node(id=name, initial=(50.0, 50.0)) for name in "ab"), Node(id="c", initial=(10.0, 10.0)))
    arcs = tuple(Arc(id=f"{name}c", donor=name, recipient="c", rate=3.0) for name in "ab")
    agent = Arc(id="back", donor="c", recipient="a", rate=0.01, control=rate_control(0.0, 1.0))
    network = Network(name="funnel", nodes=nodes, arcs=(*arcs, agent), episode=Episode(control_interval=0.3, horizon=6))
    played = play(network, np.random.default_rng(0), "low")
    assert played.intervals[-1].pieces[-1].end[2] > 100.0
    assert_holds(played, 2)


@pytest.mark.parametrize(
    ("stock", "feed", "asked", "cut"),
    [(10.0, 0.0, 8.0, True), (10.0, 0.0, 6.0, False), (0.0, 10.0, 1.0, True)],
    ids=["held", "deliverable", "later"],
)
def test_a_demand_without_a_choice(stock: float, feed: float, asked: float, cut: bool) -> None:
    """A demand that nobody sets is what is asked where the program says so, in every substep.

    Beside an exit of 0.8 per substep a store of 10 delivers 10·0.8/(e^0.8 − 1) = 6.5, though it holds 10.
    """
    nodes = (
        Node(id="ample", role=Role.ENVIRONMENT, initial=(500.0, 500.0), control=rate_control(0.9, 1.0)),
        Node(id="store", initial=(stock, stock)),
        Node(id="use", initial=(1.0, 1.0)),
        Node(id="end"),
    )
    arcs = (
        Arc(id="feed", donor="ample", recipient="store", law=Law.EXOGENOUS, flow=feed),
        Arc(id="exit", donor="store", recipient="end", rate=0.8),
        Arc(id="demand", donor="store", recipient="use", law=Law.EXOGENOUS, flow=asked),
        Arc(id="through", donor="use", recipient="end", rate=1.0),
    )
    for interval in (1.0, 3.0):
        episode = Episode(control_interval=interval, horizon=2)
        objective = Objective(reference_interval=1.3, net_zero="abs")
        network = Network(name="shop", nodes=nodes, arcs=arcs, episode=episode, objective=objective)
        played = play(network, np.random.default_rng(0), "high")
        first = played.intervals[0].pieces[0]
        assert first.cut == cut
        assert_holds(played, 1)


def test_pulls_are_bounded_with_the_most_that_may_pull() -> None:
    """A node that may be filled pulls more than it now could: without proof that its donor bears it, none is given."""
    nodes = (
        Node(id="reserve", initial=(5.0, 5.0)),
        Node(id="use", initial=(1.0, 1.0)),
        Node(id="ample", initial=(500.0, 500.0)),
    )
    arcs = (
        Arc(id="pull", donor="reserve", recipient="use", law=Law.RECIPIENT, rate=0.5),
        order("feed", "ample", "use", 100.0),
    )
    network = Network(name="pulled", nodes=nodes, arcs=arcs, episode=Episode(control_interval=0.5, horizon=1))
    with pytest.raises(NoCertificate, match="more from node 'reserve' than it holds"):
        Programs(Admissible.of(network), 1, None).program(np.array([5.0, 1.0, 500.0]))


@pytest.mark.parametrize(("agents", "least"), [(["mine"], 0.3), (["mining"], 0.6), (["mine", "mining"], 0.2)])
def test_who_does_not_act_is_neutral(agents: list[str], least: float) -> None:
    """The least that can be mined is v·w·a·x with the neutral factor of whoever does not act, not with its least."""
    mine = Control(kind=ControlKind.RATE, low=0.25, neutral=0.75, high=1.0)
    mining = Control(kind=ControlKind.RATE, low=0.8, neutral=1.2, high=2.0)
    network = Network(
        name="mine",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0), control=mine),
            Node(id="use"),
        ),
        arcs=(Arc(id="mining", donor="mine", recipient="use", rate=1.0, control=mining),),
        episode=Episode(control_interval=0.5, horizon=3),
    )
    found = bound(network, agents=agents, degree=4).objective
    assert found == pytest.approx(100 * math.expm1(-1.5 * least) / 1.5, rel=1e-6)


def test_the_most_that_is_delivered() -> None:
    """The program allows just what the simulator delivers with the free exit at its least and all of the store ordered.

    With z = a·δ it is x_0·z/(e^z − 1); a greater z, that of the greatest exit, would allow less.
    """
    network = works().with_options(episode={"control_interval": 0.4, "horizon": 1})
    start = network.initial[1].copy()
    lowest = {each: mean_of(network, control_of(network, each).low, 0) for each in network.controllable}
    (happened,) = intervals(network, start, [{**lowest, "supply": 60.0}], 1)
    ordered = [network.arc_index["supply"], network.arc_index["demand"]]
    z = 1.2 * 0.1 * 0.4
    assert happened.pieces[0].cut
    delivered = happened.flow[ordered].sum()
    assert delivered * 0.4 == pytest.approx(12.0 * z / math.expm1(z), rel=1e-12)
    problem = Programs(Admissible.of(network), 1, None).program(start)
    cost = np.zeros_like(problem.cost)
    cost[problem.layout.flow[0] + np.array(ordered)] = -1.0
    most = -float(cost @ solve(replace(problem, cost=cost)).plan)
    assert most == pytest.approx(delivered, rel=1e-7)


@pytest.mark.sample(2)
@pytest.mark.parametrize("style", ["inside", "ends", "low", "high"])
@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("hoarded", [40.0, 0.0, 500.0])
def test_fast_stocks_and_strong_loops(hoarded: float, merged: bool, style: str) -> None:
    """Shares that could multiply mass, plants that settle within an interval, and schedules that are cut."""
    rng = np.random.default_rng(3)
    for degree in (1, 3):
        played = play(cycle(hoarded=hoarded), rng, style)
        assert_holds(played, degree, None, merged)
    layout = Programs(Admissible.of(played.network), 1, None, merge_pieces=merged).layout
    assert layout.pieces == (1 if merged else 24)


@pytest.mark.slow
def test_merged_pieces_are_as_tight() -> None:
    """One piece for an interval of 24 substeps proves nearly what 24 pieces prove, with a tenth of the variables."""
    admissible = Admissible.of(cycle(hoarded=500.0))
    start = admissible.network.initial.mean(axis=0)
    fine, merged = (Programs(admissible, 1, None, merge_pieces=each).program(start, 0.8) for each in (False, True))
    proved = [-float(problem.cost @ solve(problem).plan) for problem in (fine, merged)]
    assert len(merged.cost) < 0.1 * len(fine.cost)
    assert proved[1] == pytest.approx(proved[0], rel=0.05)


@given(
    turnover=st.floats(0.0, 40.0),
    degree=st.integers(1, 3),
    inflow=st.lists(st.floats(0.0, 1.0), min_size=1, max_size=12),
)
def test_a_stock_holds_what_enters_it(turnover: float, degree: int, inflow: list[float]) -> None:
    """Of any inflow its means are enclosed, nearly so of an even one into a slow stock: with x' = u − z x, in steps."""
    means, low, high = stock_response(turnover, degree)
    steps = 120
    time, entering = (np.arange(steps) + 0.5) / steps, np.resize(np.repeat(inflow, steps // len(inflow)), steps)
    weights = np.array([math.comb(degree, i) * time**i * (1 - time) ** (degree - i) for i in range(degree + 1)])
    held, stock, of_start = 0.0, np.empty(steps), np.exp(-turnover * time)
    decay, gain = math.exp(-turnover / steps), float(exprel(-turnover / steps)) / steps
    for k, u in enumerate(entering.tolist()):
        later = decay * held + gain * u
        stock[k], held = (held + later) / 2, later
    of_stock, of_inflow, known = ((degree + 1) * weights @ each / steps for each in (stock, entering, of_start))
    rounding = 3e-3 + 1e-3 * turnover
    np.testing.assert_allclose(means, known, atol=rounding)
    assert (low @ of_inflow <= of_stock + rounding).all() and (of_stock <= high @ of_inflow + rounding).all()
    even = np.ones(degree + 1)
    assert ((high - low) @ even <= 0.5 / degree).all()


def two_yards(*others: Node) -> Network:
    """Return a cycle with a furnace that melts what is collected in days, beside which others lose what they hold."""
    share = Control(kind=ControlKind.SHARE, low=0.2, neutral=0.5, high=0.9)
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=4.0)
    return Network(
        name="yards",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(500.0, 500.0)),
            Node(id="market", stores=False),
            Node(id="use", initial=(20.0, 20.0)),
            Node(id="waste", stores=False),
            Node(id="furnace", initial=(0.1, 0.1)),
            *others,
            Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="mining", donor="mine", recipient="market", law=Law.CONTROLLED, control=order),
            Arc(id="made", donor="market", recipient="use", law=Law.SHARE),
            Arc(id="old", donor="use", recipient="waste", rate=0.1),
            Arc(id="collected", donor="waste", recipient="furnace", law=Law.SHARE, control=share),
            Arc(id="lost", donor="waste", recipient="tip", law=Law.SHARE),
            Arc(id="melted", donor="furnace", recipient="market", rate=15.0),
            *(Arc(id=f"{node.id}_gone", donor=node.id, recipient="tip", rate=1.9) for node in others),
        ),
        services=(Service(id="in_use", provider="use", quantity="stock", low=20.0),),
        time_unit="year",
        episode=Episode(control_interval=1.0, horizon=6),
    )


def test_what_is_elsewhere_does_not_loosen_a_bound() -> None:
    """A stock that empties within a year, in a network with a furnace that follows only slow ones."""
    proved = []
    for others in ((), (Node(id="heap", initial=(1e-6, 1e-6)),)):
        programs = Programs(Admissible.of(two_yards(*others)), 1, None, merge_pieces=True)
        problem = programs.program(programs.admissible.network.initial.mean(axis=0), 0.9)
        proved.append(-float(problem.cost @ solve(problem).plan))
    assert proved[1] == pytest.approx(proved[0], rel=1e-5)


@pytest.mark.parametrize("rate", [0.7, 8.0])
def test_a_furnace_that_is_fed_by_schedule_is_known(rate: float) -> None:
    """With x' = u − k·x there is no choice: what is there at the end of a merged piece is u/k + (x_0 − u/k)·e^{−k}."""
    network = Network(
        name="smelter",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(500.0, 500.0)),
            Node(id="furnace", initial=(2.0, 2.0)),
            Node(id="tip", role=Role.LANDFILL, initial=(1.0, 1.0)),
        ),
        arcs=(
            Arc(id="mining", donor="mine", recipient="furnace", law=Law.EXOGENOUS, flow=4.0),
            Arc(id="slag", donor="furnace", recipient="tip", rate=rate),
        ),
        episode=Episode(control_interval=1.0, horizon=1),
    )
    programs = Programs(Admissible.of(network), 2, None, merge_pieces=True)
    problem, last = programs.program(network.initial[1]), programs.layout.last.start + network.node_index["furnace"]
    for sign in (1.0, -1.0):
        cost = np.zeros_like(problem.cost)
        cost[last] = sign
        end = float(solve(replace(problem, cost=cost)).plan[last])
        assert end == pytest.approx(4.0 / rate + (2.0 - 4.0 / rate) * math.exp(-rate), rel=1e-6)


@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("leak", [1e-9, 9e-7, 1.1e-6])
def test_a_pile_that_hardly_leaks_is_fed_by_schedule(leak: float, merged: bool) -> None:
    """Of what enters a part is lost that is far below the rest, and far above round-off."""
    network = Network(
        name="pile",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(500.0, 500.0)),
            Node(id="pile", initial=(1e-3, 1e-3)),
            Node(id="river", initial=(1.0, 1.0)),
        ),
        arcs=(
            Arc(id="dumping", donor="mine", recipient="pile", law=Law.EXOGENOUS, flow=100.0),
            Arc(id="leak", donor="pile", recipient="river", rate=leak),
        ),
        episode=Episode(control_interval=1.0, horizon=2),
    )
    for degree in (1, 2, 3):
        assert_holds(play(network, np.random.default_rng(degree), "inside"), degree, None, merged)


@pytest.mark.parametrize(("fed", "asked"), [(0.0, 30.0), (40.0, 0.0), (10.0, 25.0), (0.0, 2000.0)])
def test_schedules_of_a_heap_in_a_merged_piece(fed: float, asked: float) -> None:
    """What schedules take from a stock that leaks, or bring, counts while it leaks; the last one empties it."""
    network = Network(
        name="heap",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(500.0, 500.0)),
            Node(id="heap", initial=(300.0, 300.0)),
            Node(id="river", initial=(1.0, 1.0)),
            Node(id="builder", initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="feed", donor="mine", recipient="heap", law=Law.EXOGENOUS, flow=fed),
            Arc(id="order", donor="heap", recipient="builder", law=Law.EXOGENOUS, flow=asked),
            Arc(id="leak", donor="heap", recipient="river", rate=0.9),
        ),
        episode=Episode(control_interval=1.0, horizon=2, solver_step=0.25),
    )
    played = play(network, np.random.default_rng(0), "inside")
    assert played.cut == (asked == 2000.0)
    for degree in (1, 2):
        assert Programs(Admissible.of(network), degree, None, merge_pieces=True).layout.pieces == 1
        assert_holds(played, degree, None, merged=True)


@pytest.mark.medium
@pytest.mark.sample(2)
@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize("seed", [2, 13, 20, 22, 523])
def test_shares_of_nodes_without_stock(seed: int, merged: bool) -> None:
    """Markets that share out what comes from mines, hoards that run dry, fast furnaces and products in use."""
    network = yearly_network(seed, replace(RATES, years=(3, 3), regions=(1, 2), products=(2, 3)))
    scarce = {"hoard": 0.02, "mine": 0.01}
    nodes = []
    for node in network.nodes:
        amount = (node.initial or (node.scale, 0.0))[0] * scarce.get(node.id.rpartition("_")[2], 1.0)
        nodes.append(replace(node, initial=(amount, amount)) if node.stores else node)
    network, rng = replace(network, nodes=tuple(nodes)), np.random.default_rng(seed)
    for style, degree in (("inside", 3), ("ends", 2)):
        played = play(network, rng, style)
        assert_holds(played, degree, None, merged)
    layout = Programs(Admissible.of(network), 1, None).layout
    nothing_constant = seed == 523  # comes to its market, all is from stocks
    assert (len(layout.steady_nodes) == 0) == (len(layout.steady_arcs) == 0) == nothing_constant


@pytest.mark.parametrize("style", ["inside", "ends", "low", "high"])
def test_shares_of_what_orders_take_away(style: str) -> None:
    """A market gets from a yard what a customer's orders leave there: that falls faster than the yard releases it."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=5.0, high=30.0)
    share = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.5, high=1.0)
    network = Network(
        name="yard",
        nodes=(
            Node(id="yard", initial=(10.0, 10.0)),
            Node(id="sale", stores=False),
            Node(id="first", initial=(1.0, 1.0)),
            Node(id="second", initial=(1.0, 1.0)),
            Node(id="customer", initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="release", donor="yard", recipient="sale", rate=0.2),
            Arc(id="to_first", donor="sale", recipient="first", law=Law.SHARE, control=share),
            Arc(id="to_second", donor="sale", recipient="second", law=Law.SHARE),
            Arc(id="order", donor="yard", recipient="customer", law=Law.CONTROLLED, control=order),
            Arc(id="again", donor="first", recipient="yard", rate=1.0),
        ),
        episode=Episode(control_interval=1.0, horizon=4),
        objective=Objective(circularity_scale=1.0),
    )
    for degree in (1, 3):
        assert_holds(play(network, np.random.default_rng(degree), style), degree)


@pytest.mark.sample(2)
@pytest.mark.parametrize("merged", [False, True])
@pytest.mark.parametrize(("past", "refilled"), [("sale", True), ("furnace", True), ("sale", False), ("furnace", False)])
def test_shares_of_what_a_hoard_has_left(past: str, refilled: bool, merged: bool) -> None:
    """A market gets what was ordered from a hoard, or less where that runs dry, at once or past a furnace."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=5.0, high=30.0)
    share = Control(kind=ControlKind.SHARE, low=0.1, neutral=0.5, high=0.9)
    network = Network(
        name="market",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(500.0, 500.0)),
            Node(id="hoard", initial=(6.0, 6.0)),
            Node(id="furnace", initial=(1.0, 1.0)),
            Node(id="yard", initial=(10.0, 10.0)),
            Node(id="first", initial=(1.0, 1.0)),
            Node(id="second", initial=(1.0, 1.0)),
            Node(id="sale", stores=False),
        ),
        arcs=(
            Arc(id="feed", donor="mine", recipient="hoard" if refilled else "yard", law=Law.EXOGENOUS, flow=4.0),
            Arc(id="order", donor="hoard", recipient=past, law=Law.CONTROLLED, control=order),
            Arc(id="melt", donor="furnace", recipient="sale", rate=12.0),
            Arc(id="release", donor="yard", recipient="sale", rate=0.2),
            Arc(id="to_first", donor="sale", recipient="first", law=Law.SHARE, control=share),
            Arc(id="to_second", donor="sale", recipient="second", law=Law.SHARE),
            Arc(id="back", donor="first", recipient="yard", rate=1.0),
        ),
        episode=Episode(control_interval=1.0, horizon=5, solver_step=0.25),
        objective=Objective(circularity_scale=1.0),
    )
    for seed, style in enumerate(("inside", "ends", "high")):
        for degree in (1, 2):
            assert_holds(play(network, np.random.default_rng(seed), style), degree, None, merged)


def test_what_is_cut_misses_as_long_as_a_furnace_holds_it() -> None:
    """Of a flow of 1 into furnaces of rates 12 and 3 in a row, ∫ e^{−12s} ds and ∫∫ e^{−3(s−u)} 12 e^{−12u} miss."""
    names = ("first", "second")
    nodes = (*(Node(id=name, initial=(1.0, 1.0)) for name in names), Node(id="tip"), Node(id="sale", stores=False))
    arcs = (
        Arc(id="melt", donor="first", recipient="sale", rate=12.0),
        Arc(id="cast", donor="sale", recipient="second", law=Law.SHARE),
        Arc(id="slag", donor="second", recipient="tip", rate=3.0),
    )
    network = Network(name="row", nodes=nodes, arcs=arcs, episode=Episode(control_interval=0.5, horizon=1))
    programs = Programs(Admissible.of(network), 1, None)
    ranges, linear = programs.admissible.ranges[0], programs.system.of_interval(0)
    responses, arrivals = cut_responses(ranges, linear, np.arange(2))
    first, second = (-math.expm1(-rate / 2) / rate for rate in (12.0, 3.0))
    behind = (12.0 * second - 12.0 * first) / 9.0  # of 12 (e^{−3 s} − e^{−12 s})/9
    sale = network.node_index["sale"]
    assert responses[[0, 1, sale], 0] == pytest.approx([first, behind, 12.0 * first], rel=1e-8)
    assert responses[[0, 1, sale], sale] == pytest.approx([0.0, second, 1.0], rel=1e-8, abs=1e-11)
    assert arrivals[:2, 0] == pytest.approx([1.0, 12.0 * first], rel=1e-8)


def test_what_comes_late_has_entered_late() -> None:
    """A hoard of 6 that gets 4 in a year could send 10 at its end, but orders are even until it is empty."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=5.0, high=30.0)
    network = Network(
        name="hoard",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(500.0, 500.0)),
            Node(id="hoard", initial=(6.0, 6.0)),
            Node(id="tip", role=Role.LANDFILL, initial=(1.0, 1.0)),
        ),
        arcs=(
            Arc(id="feed", donor="mine", recipient="hoard", law=Law.EXOGENOUS, flow=4.0),
            Arc(id="order", donor="hoard", recipient="tip", law=Law.CONTROLLED, control=order),
        ),
        episode=Episode(control_interval=1.0, horizon=1, solver_step=0.25),
    )
    programs = Programs(Admissible.of(network), 1, None, merge_pieces=True)
    problem, layout = programs.program(network.initial[1]), programs.layout
    early, late = layout.flow[:2] + network.arc_index["order"]
    cost = np.zeros_like(problem.cost)
    cost[early], cost[late] = 1.0, -1.0
    solution = solve(replace(problem, cost=cost)).plan
    assert solution[late] - solution[early] == pytest.approx(8.0, rel=1e-6)  # half the difference: at most what enters


@pytest.mark.parametrize("refilled", [False, True])
def test_shares_are_the_same_all_year(refilled: bool) -> None:
    """A market cannot give one product what comes early and another what comes late.

    Each has a life of a year; the level of one is what it gets, of the other what it has at the end. With a share s of
    an inflow of 1 the levels are s and (1 − s)(1 − 1/e)/(1 − 1/e), which add up to 1.
    """
    share = Control(kind=ControlKind.SHARE, low=0.0, neutral=0.5, high=1.0)
    network = Network(
        name="market",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(100.0, 100.0)),
            Node(id="early", initial=(0.0, 0.0)),
            Node(id="late", initial=(0.0, 0.0)),
            Node(id="tip", role=Role.LANDFILL, initial=(1.0, 1.0)),
            Node(id="sale", stores=False),
        ),
        arcs=(
            Arc(id="mining", donor="mine", recipient="sale", law=Law.EXOGENOUS, flow=1.0),
            *([Arc(id="again", donor="tip", recipient="mine", rate=0.1)] if refilled else []),
            Arc(id="to_early", donor="sale", recipient="early", law=Law.SHARE, control=share),
            Arc(id="to_late", donor="sale", recipient="late", law=Law.SHARE),
            Arc(id="early_end", donor="early", recipient="tip", rate=1.0),
            Arc(id="late_end", donor="late", recipient="tip", rate=1.0),
        ),
        services=(
            Service(id="sold", provider="to_early", quantity="flow", low=1.0),
            Service(id="held", provider="late", quantity="stock", low=-math.expm1(-1.0)),
        ),
        episode=Episode(control_interval=1.0, horizon=1, solver_step=0.5 if refilled else None),
        objective=Objective(circularity_scale=1.0),
    )
    most = []
    for constant_shares in (True, False):
        programs = Programs(Admissible.of(network), 3, None, constant_shares=constant_shares, steady_parts=refilled)
        problem = programs.program(network.initial[1])
        cost = np.zeros_like(problem.cost)
        cost[problem.layout.level : problem.layout.imbalance] = -1.0
        most.append(-float(cost @ solve(replace(problem, cost=cost)).plan))
    assert most[0] == pytest.approx(1.0, abs=5e-3) and most[1] > 1.1
