"""The bound against simulated episodes and closed forms, its certificate against arbitrary multipliers, its limits."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from conftest import random_network
from hypothesis import example, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import sparse
from small_networks import plain_networks

from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlError,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Role,
    Service,
    load_network,
)
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.network.elements import FIXED_LIFETIME
from cirl_marl.network.series import Series
from cirl_marl.optimum import (
    Bound,
    Certificate,
    NoCertificate,
    Plan,
    bound,
    bounds,
    envelope,
    improve_plan,
    program,
    reach,
    simulate_plan,
)
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.certificate import verify
from cirl_marl.optimum.options import starting_stocks
from cirl_marl.optimum.program import Programs
from cirl_marl.optimum.reach import ComparisonSystem
from cirl_marl.optimum.solver import solve
from cirl_marl.optimum.vintages import Lifetimes

Floats = NDArray[np.float64]
COPIES = 48


def certifiable(network: Network, interval: float, pulls: bool) -> Network:
    """Return the network without batches, and without pulls of recipients if so asked, with a moderate interval."""
    replaced = {Law.BATCH} if pulls else {Law.BATCH, Law.RECIPIENT}
    arcs = [
        replace(arc, law=Law.DONOR, rate=0.3 if arc.law is Law.BATCH else arc.rate, batches=(), delay=0.0)
        if arc.law in replaced
        else arc
        for arc in network.arcs
    ]
    longer = network.episode.control_interval
    shorter = min(interval, longer)  # which its series cover
    episode = replace(network.episode, control_interval=shorter, solver="exact", solver_step=None)
    nodes = []
    for node in network.nodes:
        if node.lifetime is not None and node.lifetime.distribution == FIXED_LIFETIME:
            node = replace(node, lifetime=replace(node.lifetime, mean=round(node.lifetime.mean / longer) * shorter))
        nodes.append(node)
    return replace(network, nodes=tuple(nodes), arcs=tuple(arcs), episode=episode)


def bounded(network: Network, interval: float, service_weight: float | None = None) -> Bound:
    """Bound the network; without the pulls of recipients if they rule a certificate out."""
    start = network.initial[1].copy()
    try:
        return bound(certifiable(network, interval, pulls=True), start, service_weight=service_weight)
    except NoCertificate:
        return bound(certifiable(network, interval, pulls=False), start, service_weight=service_weight)


def started(network: Network, stocks: Floats) -> Network:
    """Return the network with stocks from which alone it starts."""
    stores = [replace(node, initial=(x, x)) for node, x in zip(network.stores, stocks.tolist(), strict=True)]
    return replace(network, nodes=(*stores, *network.nodes[len(stores) :]))


def pinned(found: Bound) -> Network:
    """Return the network with the start of a bound as the only one."""
    return started(found.network, found.stock[0])


def episodes(network: Network, seed: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return λ̄, service, levels and highest stocks of episodes under extreme, uniform, constant and neutral actions.

    The first copies hold extremes that change from step to step, the next uniform actions, the next constant extremes;
    the last is neutral.
    """
    env = MultiAgentVectorEnv(network, num_envs=COPIES)
    env.reset(seed=0)
    rng = np.random.default_rng(seed)
    entries = len(env.stack(env.neutral_action))
    constant = rng.choice([-1.0, 1.0], (entries, COPIES))
    circularity, service = np.zeros((2, COPIES))
    highest = env.rows.stocks(env.physical.stock).copy()
    for _ in range(network.episode.horizon):
        actions = rng.choice([-1.0, 1.0], (entries, COPIES))
        actions[:, 12:24] = rng.uniform(-1, 1, (entries, 12))
        actions[:, 24:] = constant[:, 24:]
        actions[:, -1] = np.concatenate([np.zeros(0), *(each[0] for each in env.neutral_action.values())])
        outcome = env.advance(actions)
        circularity += outcome.circularity_mean / network.episode.horizon
        service += outcome.service_level / network.episode.horizon
        highest = np.maximum(highest, env.rows.stocks(env.physical.stock))
    return circularity, service, env.physical.service.T / network.episode.horizon, highest.max(axis=1)


def test_presolve_is_not_believed(make_network: Callable[[int, int, int], Network]) -> None:
    """HiGHS's presolve calls the program of this network infeasible; neutral control solves it."""
    network = certifiable(make_network(431, 9, 8), 0.03125, pulls=True)
    start = network.initial[1].copy()
    found = bound(network, start)
    assert found.verify().bound == found.objective


@pytest.mark.medium
@given(
    network=st.from_type(Network),
    interval=st.floats(0.02, 0.4),
    seed=st.integers(0, 1000),
    weight=st.sampled_from([None, 0.3, 3.0]),
)
def test_no_episode_exceeds_the_bound(network: Network, interval: float, seed: int, weight: float | None) -> None:
    """λ̄, or λ̄/scale + w·service, of every simulated episode is at most the bound."""
    found = bounded(network, interval, weight)
    circularity, service, _, _ = episodes(pinned(found), seed)
    objective = circularity
    if weight is not None:
        objective = circularity / network.objective.circularity_scale + weight * service
    mass = found.initial.sum() * network.objective.reference_interval  # the simulator rounds relative to all the mass
    slack = 1e-9 * (abs(found.objective) + np.abs(objective).max()) + 1e-12 * mass
    assert objective.max() <= found.objective + slack
    run = simulate_plan(found)
    assert found.gap(run.episode_circularity, run.episode_service).min() * abs(found.objective) >= -slack or (
        found.objective == 0 and run.episode_circularity.max() <= slack
    )


@pytest.mark.medium
@given(network=st.from_type(Network), interval=st.floats(0.02, 0.4), seed=st.integers(0, 1000))
def test_no_episode_with_the_service_exceeds_its_bound(network: Network, interval: float, seed: int) -> None:
    """Episodes that keep each service at a mean level of its own have at most the λ̄ that the bound allows for these."""
    network = certifiable(network, interval, pulls=False)
    start = network.initial[1].copy()
    single = started(network, network.initial[1])
    circularity, service, levels, _ = episodes(single, seed)
    mass = sum(start) * network.objective.reference_interval
    for demanded in (levels[circularity.argmax()], levels[service.argmax()]):
        least = demanded * (1 - 1e-6)  # the most that can be had would be within the solver's tolerance of none
        found = bound(network, start, min_service=least)
        best = circularity[(levels >= demanded).all(axis=1)].max()
        assert best <= found.objective + 1e-9 * (abs(found.objective) + np.abs(circularity).max()) + 1e-12 * mass


@given(network=plain_networks, interval=st.floats(0.02, 0.4), seed=st.integers(0, 1000))
def test_reach(network: Network, interval: float, seed: int) -> None:
    """No simulated stock leaves its bounds, and of scheduled flows that part is delivered that is said to be."""
    network = certifiable(network, interval, pulls=False)
    free = [replace(arc, capacity_node="", capacity_rate=0.0) for arc in network.arcs]
    single = started(replace(network, arcs=tuple(free)), network.initial[1])
    admissible = Admissible.of(single)
    reached = ComparisonSystem(admissible).reach(
        starting_stocks(admissible.lifetimes, None), range(single.episode.horizon)
    )
    *_, highest = episodes(single, seed)
    assert (highest <= reached.upper[:, : len(highest)].max(axis=0) * (1 + 1e-9) + 1e-12).all()
    run = rollout(MultiAgentVectorEnv(single, num_envs=1), Neutral())
    dynamics = FlowLaws(single)
    steps = np.arange(single.episode.horizon)
    asked = dynamics.rate(np.repeat(dynamics.neutral[:, :1], len(steps), axis=1), steps).T
    sure = reached.uncut & dynamics.is_scheduled
    np.testing.assert_allclose(run.flow[sure], asked[sure], rtol=1e-9)
    least = (asked * reached.delivered)[:, dynamics.is_scheduled]
    assert (run.flow[:, dynamics.is_scheduled] >= least * (1 - 1e-9)).all()


@given(network=plain_networks)
def test_ranges_are_those_of_the_flow_laws(network: Network) -> None:
    """With every compartment acting, the highest coefficients are the laws' own, or less if they change in time."""
    network = certifiable(network, 0.3, pulls=True)
    admissible = Admissible.of(network, None)
    highest = admissible.rate[1].max(axis=0)
    most = FlowLaws(network).max_rate
    assert (highest <= most * (1 + 1e-12)).all()
    touched = [bool({arc.id, arc.donor} & {*network.time_dependent}) for arc in network.arcs]
    same = ~admissible.share_arcs & ~np.array(touched, dtype=bool)
    np.testing.assert_allclose(highest[same], most[same], rtol=1e-12)


def small(nodes: list[Node], arcs: list[Arc], services: list[Service] | None = None, horizon: int = 8) -> Network:
    """Return a network with intervals of 0.5 and Δ = 1."""
    return Network(
        name="small",
        nodes=tuple(nodes),
        arcs=tuple(arcs),
        services=tuple(services or ()),
        episode=Episode(control_interval=0.5, horizon=horizon),
    )


def stocked(name: str, stock: float, role: Role = Role.TECHNOSPHERE, control: Control | None = None) -> Node:
    """Return a node with one initial stock."""
    return Node(id=name, role=role, initial=(stock, stock), control=control)


def order(name: str, donor: str, recipient: str, most: float) -> Arc:
    """Return an arc whose flow is set between 0 and ``most``."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=most, high=most)
    return Arc(id=name, donor=donor, recipient=recipient, law=Law.CONTROLLED, control=control)


def valve(low: float, high: float) -> Control:
    """Return a valve that is neutral at ``high``."""
    return Control(kind=ControlKind.RATE, low=low, neutral=high, high=high)


RESERVE = stocked("reserve", 100.0, Role.NONRENEWABLE_RESERVOIR)
USE = stocked("use", 10.0)
TIP = stocked("tip", 0.0, Role.LANDFILL)


def test_single_valve() -> None:
    """Extraction a·w·x from a reserve is least at the lowest w: λ̄ = −x_0 (1 − e^{−a w̲ T})/T."""
    arc = Arc(id="extraction", donor="reserve", recipient="use", rate=0.4, control=valve(0.5, 2.0))
    found = bound(small([RESERVE, USE], [arc]), degree=4)
    expected = -100 * (1 - math.exp(-0.4 * 0.5 * 4)) / 4
    assert found.objective == pytest.approx(expected, rel=1e-7)
    assert simulate_plan(found).episode_circularity[0] == pytest.approx(expected, rel=1e-7)
    np.testing.assert_allclose(found.actions, -1.0, atol=1e-6)


def test_two_valves_in_series_multiply() -> None:
    """A valve on the node and one on its outflow let through at least the product of their lowest values."""
    arc = Arc(id="extraction", donor="reserve", recipient="use", rate=0.4, control=valve(0.5, 2.0))
    reserve = replace(RESERVE, control=valve(0.6, 1.0))
    found = bound(small([reserve, USE], [arc]), degree=4)
    assert found.objective == pytest.approx(-100 * (1 - math.exp(-0.4 * 0.3 * 4)) / 4, rel=1e-7)


def test_capture_is_limited_by_its_capacity() -> None:
    """Removal from an ample environment counts in favour: λ̄ = Δ u."""
    air = stocked("air", 1000.0, Role.ENVIRONMENT)
    found = bound(small([air, USE], [order("capture", "air", "use", 7.0)]))
    assert found.objective == pytest.approx(7.0, rel=1e-9)
    assert simulate_plan(found).episode_circularity[0] == pytest.approx(7.0, rel=1e-9)


def test_capture_is_limited_by_what_there_is() -> None:
    """No more than the stock can be removed: λ̄ = Δ x_0/T, whatever the capacity."""
    air = stocked("air", 6.0, Role.ENVIRONMENT)
    found = bound(small([air, USE], [order("capture", "air", "use", 7.0)]))
    assert found.objective == pytest.approx(6.0 / 4, rel=1e-9)


def test_service_costs_its_throughput() -> None:
    """A stock x in use that decays at the rate a needs U = a·x mined and loses as much: λ̄ = −2·a·x."""
    arcs = [order("extraction", "reserve", "use", 9.0), Arc(id="loss", donor="use", recipient="tip", rate=0.3)]
    service = Service(id="served", provider="use", quantity="stock", low=10.0)
    network = small([RESERVE, USE, TIP], arcs, [service])
    found = bound(network, min_service=1.0, degree=4)
    assert found.objective == pytest.approx(-6.0, rel=1e-5)
    run = simulate_plan(found)
    assert run.episode_circularity[0] == pytest.approx(-6.0, rel=1e-5)
    assert run.episode_service[0] == pytest.approx(1.0, abs=1e-6)
    # one unit of weight on service is worth less than what service costs, a hundred is worth more
    assert bound(network, service_weight=0.0).objective == pytest.approx(bound(network).objective)
    assert bound(network, service_weight=100.0).service == pytest.approx(1.0, abs=1e-6)


def test_net_zero_by_absolute_value() -> None:
    """With ``abs`` removing more than is emitted does not pay: λ̄ = 0 where ``signed`` would give u − e."""
    air = stocked("air", 1000.0, Role.ENVIRONMENT)
    emission = Arc(id="emission", donor="use", recipient="air", law=Law.EXOGENOUS, flow=3.0)
    network = small([air, stocked("use", 100.0)], [emission, order("capture", "air", "use", 7.0)])
    assert bound(network).objective == pytest.approx(4.0, rel=1e-9)
    absolute = bound(network.with_options(objective={"net_zero": "abs"}))
    assert absolute.objective == pytest.approx(0.0, abs=1e-8)
    assert simulate_plan(absolute).episode_circularity[0] == pytest.approx(0.0, abs=1e-6)


def test_exogenous_series_is_exact() -> None:
    """A demand that the reserve can meet is met: λ̄ = −Δ·mean of the series."""
    arc = Arc(
        id="demand",
        donor="reserve",
        recipient="use",
        law=Law.EXOGENOUS,
        flow=Series(times=(0.0, 1.2, 3.0), values=(1.0, 4.0, 2.0)),
    )
    found = bound(small([RESERVE, USE], [arc]), agents=None)
    assert found.objective == pytest.approx(-(1.2 * 1 + 1.8 * 4 + 1 * 2) / 4, rel=1e-9)


def test_exogenous_series_that_is_cut_still_bounds() -> None:
    """A demand above what the reserve holds moves all there is at most, and the bound claims no more than none."""
    arc = Arc(id="demand", donor="reserve", recipient="use", law=Law.EXOGENOUS, flow=80.0)
    found = bound(small([RESERVE, USE], [arc]))
    run = rollout(MultiAgentVectorEnv(small([RESERVE, USE], [arc]), num_envs=1), Neutral())
    assert run.episode_circularity[0] == pytest.approx(-100 / 4, rel=1e-9)
    assert run.episode_circularity[0] <= found.objective <= 0


@pytest.mark.parametrize("rate", [1e-6, 9e-4, 0.4, 30.0])
def test_programs_of_means_are_exact_where_inflows_are_even(rate: float) -> None:
    """They have the mean flows and the stocks of the simulator, however fast a stock is left."""
    supply = Arc(id="supply", donor="reserve", recipient="use", law=Law.EXOGENOUS, flow=3.0)
    network = small([RESERVE, USE, TIP], [supply, Arc(id="loss", donor="use", recipient="tip", rate=rate)])
    programs = Programs(admissible := Admissible.of(network), 0, None)
    problem, layout = programs.program(starting_stocks(admissible.lifetimes, None)), programs.layout
    plan = solve(problem).plan.reshape(-1, layout.size)
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral())
    np.testing.assert_allclose(layout.means(plan)[1], run.flow, rtol=1e-7)
    np.testing.assert_allclose(plan[:, layout.last], run.stock, rtol=1e-7)


def test_programs_of_means_hold_controls_from_piece_to_piece(monkeypatch: pytest.MonkeyPatch) -> None:
    """To first order, near neutral values; of large ones pieces are merged, and there is nothing at their ends."""
    supply = Arc(id="supply", donor="reserve", recipient="use", law=Law.EXOGENOUS, flow=3.0)
    loss = Arc(id="loss", donor="use", recipient="tip", rate=30.0, control=valve(0.5, 2.0))
    admissible = Admissible.of(network := small([RESERVE, USE, TIP], [supply, loss]))
    programs = Programs(admissible, 0, None)
    layout, starts = programs.layout, starting_stocks(admissible.lifetimes, None)
    plan = solve(programs.program(starts)).plan.reshape(-1, layout.size)
    flow = plan[:, layout.flow + network.arc_index["loss"]]
    stock = plan[:, layout.stock + network.node_index["use"]]
    assert layout.pieces > 2 and np.ptp(stock[0]) > 0.1
    np.testing.assert_allclose(np.diff(flow, axis=1), 60.0 * np.diff(stock, axis=1), atol=1e-6 * flow.max())
    monkeypatch.setattr(program, "LARGE", 0)
    merged = Programs(admissible, 0, None).layout
    assert merged.pieces == 1 and merged.coarse and not merged.has_end_flows
    assert Programs(admissible, 1, None).layout.has_end_flows


def test_gap_falls_with_the_degree() -> None:
    """Where nothing can be chosen the bound tends to what happens, by a factor of three per degree and more."""
    arcs = [
        Arc(id="extraction", donor="reserve", recipient="use", rate=0.4),
        Arc(id="loss", donor="use", recipient="tip", rate=1.3),
    ]
    network = small([RESERVE, USE, TIP], arcs)
    happens = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral()).episode_circularity[0]
    gaps = [bound(network, degree=d).objective - happens for d in (1, 2, 3, 4)]
    assert min(gaps) > -1e-9
    assert all(later < earlier / 3 for earlier, later in pairwise(gaps)), gaps
    assert gaps[-1] < 1e-5 * abs(happens)


@given(
    network=st.from_type(Network),
    seed=st.integers(0, 1000),
    size=st.sampled_from([0.0, 0.1, 10.0]),
)
@example(network=random_network(4511, 2, 17), seed=0, size=0.0)  # whose plan lies outside its boxes by 1.5e-8
def test_any_multipliers_prove_a_bound(network: Network, seed: int, size: float) -> None:
    """Multipliers that are perturbed, or none at all, prove a weaker bound than the solver's, never a smaller one."""
    found = bounded(network, 0.2)
    proof = found.verify()
    assert proof.bound == found.objective
    mass = found.initial.sum() * network.objective.reference_interval
    scale = 1 + abs(proof.bound) + 0.1 * mass  # the solver's tolerance is relative to the rows
    assert proof.bound - proof.objective == pytest.approx(0.0, abs=1e-5 * scale)
    rng = np.random.default_rng(seed)
    equal, under = found.certificate.equal, found.certificate.under
    other = Certificate(
        equal=size * equal + rng.normal(size=len(equal)) * size, under=size * under + rng.normal(size=len(under)) * size
    )
    weaker = verify(found.problem, other, found.solution)
    assert weaker.bound >= proof.objective - 1e-5 * scale  # its plan may lie outside its boxes by as little
    assert weaker.infeasibility == pytest.approx(max(0.0, other.under.max(initial=0.0)))


@pytest.mark.medium
@settings(max_examples=settings().max_examples // 3)
@given(network=st.from_type(Network), seed=st.integers(0, 1000), weight=st.sampled_from([None, 0.3]))
def test_multipliers_of_one_start_bound_another(network: Network, seed: int, weight: float | None) -> None:
    """``at`` is the bound itself at its own start, and nowhere less than what is solved there."""
    network = certifiable(network, 0.2, pulls=False)
    found = bound(network, service_weight=weight)
    own = found.at()
    assert own.shape == () and own == found.objective
    rng = np.random.default_rng(seed)
    starts = np.array([rng.uniform(*network.initial) for _ in range(2)])
    starts[1] *= rng.integers(2)
    proved = found.at(starts)
    solved = np.array([bound(network, start, service_weight=weight).objective for start in starts])
    mass = starts.sum(axis=1).max() * network.objective.reference_interval
    slack = 1e-6 * np.abs(solved).max() + 1e-7 * mass  # of the solver, whose tolerance is 1e-7 of the scaled rows
    assert (proved >= solved - slack).all()
    together = envelope(network, starts, service_weight=weight)
    assert (together.at(starts) >= solved - slack).all()
    assert (together.at(starts) <= solved + slack).all()  # each start was solved


def test_multipliers_bound_starts_from_which_orders_are_cut() -> None:
    """A program has the same rows, whether a store can run short or never does; and those of one start prove others."""

    def flow(low: float, high: float) -> Control:
        return Control(kind=ControlKind.FLOW, low=low, neutral=low, high=high)

    arcs = [
        Arc(id="sell", donor="store", recipient="tip", law=Law.CONTROLLED, control=flow(8.0, 9.0)),
        Arc(id="make", donor="mine", recipient="store", law=Law.CONTROLLED, control=flow(0.0, 4.0)),
    ]
    nodes = (
        Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(900.0, 900.0)),
        Node(id="store", initial=(5.0, 300.0)),
        Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
    )
    network = Network(name="shop", nodes=nodes, arcs=tuple(arcs), episode=Episode(control_interval=1.0, horizon=4))
    starts = np.array([[900.0, 5.0, 0.0], [900.0, 20.0, 0.0], [900.0, 300.0, 0.0]])
    solved = np.array([bound(network, start).objective for start in starts])
    assert np.ptp(solved) > 1.0
    for start in starts:
        proved = bound(network, start).at(starts)
        assert (proved >= solved - 1e-6).all()


def test_multipliers_of_one_level_bound_another() -> None:
    """A bound for one demanded service proves one for each other: an affine function of the level, never too small."""
    found = bound("carbo_net", min_service=0.9, horizon=12, degree=1)
    levels = np.array([0.7, 0.8, 0.9, 0.95])
    proved = found.at(None, levels[:, None])
    assert proved[2] == found.objective
    np.testing.assert_allclose(np.diff(proved[:3]), np.diff(proved[:3])[0], rtol=1e-6)
    solved = [bound("carbo_net", min_service=level, horizon=12, degree=1).objective for level in levels.tolist()]
    assert (proved >= np.array(solved) - 1e-6).all()
    starts = np.tile(found.initial, (4, 1))
    np.testing.assert_array_equal(found.at(starts, np.repeat(levels[:, None], 2, axis=1)), proved)
    assert found.at(starts[:, None], levels[:, None]).shape == (4, 4)


@pytest.mark.slow
def test_few_solutions_bound_many_starts() -> None:
    """Ten days of copper from 12 drawn starts: three solutions prove within 1 % of what twelve do."""
    env = MultiAgentVectorEnv("copper_net", num_envs=12, horizon=40)
    env.reset(seed=0)
    starts = env.physical.stock[: len(env.network.nodes)].T
    found = envelope("copper_net", starts, min_service=0.9, horizon=40, degree=1)
    assert len(found.members) == 3
    solved = [bound("copper_net", start, min_service=0.9, horizon=40, degree=1).objective for start in starts]
    proved = found.at(starts)
    assert (proved >= np.array(solved) - 1e-6).all()
    np.testing.assert_allclose(proved, solved, rtol=0.01)


@pytest.mark.parametrize(("start", "level", "members"), [(0.0, 0.0, 1), (1e-6, 0.0, 2), (0.0, 1e-4, 2)])
def test_episodes_that_are_alike_need_one_solution(start: float, level: float, members: int) -> None:
    """Those that differ in their start or in the service that is asked of them need more."""
    middle = load_network("carbo_net").initial.mean(axis=0)
    starts = middle * [[1.0], [1.0], [1.0 + start]]
    levels = [[0.3], [0.3], [0.3 + level]]
    found = envelope("carbo_net", starts, min_service=levels, solves=2, horizon=2, degree=1)
    assert len(found.members) == members


@pytest.mark.parametrize(
    ("initial", "level", "said"),
    [
        ([1.0, 2.0], None, "expected"),
        ([[-1.0] * 6], None, "not negative"),
        (None, 1.2, "must lie in"),
    ],
)
def test_bad_starts(initial: list[float] | None, level: float | None, said: str) -> None:
    """Starts and levels that cannot be used are named."""
    found = bound("carbo_net", min_service=0.5, horizon=2, degree=1)
    with pytest.raises(CirlError, match=said):
        found.at(initial, level)


def test_a_level_needs_a_bound_that_demands_one() -> None:
    """A bound without demanded service has no multiplier for it."""
    with pytest.raises(CirlError, match="demands no service"):
        bound("carbo_net", horizon=2, degree=1).at(None, 0.9)


@pytest.mark.parametrize(("starts", "solves", "said"), [([1.0], 3, "expected"), ([[1.0] * 6], 0, "solves")])
def test_bad_envelopes(starts: list[float], solves: int, said: str) -> None:
    """An envelope needs a row of stocks for each episode and at least one solution."""
    with pytest.raises(CirlError, match=said):
        envelope("carbo_net", starts, solves=solves)


@pytest.mark.medium
@pytest.mark.sample(1)
@pytest.mark.parametrize("name", ["copper_net", "carbo_net"])
def test_plan_comes_close_to_the_bound(name: str) -> None:
    """Ten days of each network: the improved plan keeps the service and 99 % of the bound; neutral control does not."""
    found = bound(name, min_service=0.99, horizon=40)
    better = improve_plan(found, rounds=8)
    run = simulate_plan(better)
    assert run.episode_service[0] > 0.99 - 1e-4
    assert 0 <= better.gap(run.episode_circularity)[0] < 0.01
    env = MultiAgentVectorEnv(pinned(found), num_envs=1)
    assert found.gap(rollout(env, Neutral()).episode_circularity)[0] > 0.3


def test_improvement_never_loses() -> None:
    """The weighted objective in the simulator does not fall, and stays below the bound."""
    found = bound("copper_net", service_weight=2.0, horizon=12)
    before, after = (simulate_plan(plan) for plan in (found, improve_plan(found, rounds=4)))
    first, second = (found.gap(run.episode_circularity, run.episode_service)[0] for run in (before, after))
    assert 0 <= second <= first


def test_each_copy_follows_its_own_plan() -> None:
    """Plans for the starts of three copies, side by side, achieve what each achieves alone."""
    env = MultiAgentVectorEnv("carbo_net", num_envs=3, horizon=6)
    env.reset(seed=5)
    starts = env.physical.stock[: len(env.network.nodes)].T
    bounds = [bound("carbo_net", start, horizon=6) for start in starts]
    together = rollout(env, Plan(bounds), seed=5).episode_circularity
    alone = [simulate_plan(each).episode_circularity[0] for each in bounds]
    np.testing.assert_allclose(together, alone, rtol=1e-12)
    assert all(each.gap(value)[()] > -1e-9 for each, value in zip(bounds, together, strict=True))


def test_plan_refuses_what_it_was_not_made_for() -> None:
    """Another network, horizon, choice of agents, start or number of copies is an error, and so is a step too many."""
    found = bound("carbo_net", horizon=3)
    for env, said in (
        (MultiAgentVectorEnv("copper_net", num_envs=1, horizon=3), "not for 'copper_net'"),
        (MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=4), "3 steps"),
        (MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=3, agents=["vehicles"]), "agents"),
        (MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=3), "it starts from"),
    ):
        with pytest.raises(ControlError, match=said):
            rollout(env, Plan(found))
    env = MultiAgentVectorEnv(pinned(found), num_envs=3)
    with pytest.raises(ControlError, match="2 plans for 3 copies"):
        rollout(env, Plan([found, found]))
    plan = Plan(replace(found, network=pinned(found)))
    rollout(env, plan)
    with pytest.raises(ControlError, match="all are done"):
        plan.act({})


@pytest.mark.parametrize(
    ("name", "scenario", "said"),
    [
        ("copper_net", "paper", "solver 'euler'"),
        ("carbo_net", "temperature", "inner physics"),
        ("net_zero", None, "inner physics"),
        ("solids_net", None, "move batches"),
        ("copper_net", "outages", r"nobody foresees what disturbs it \(.+\); bound\(…, uncertain=True\)"),
    ],
)
def test_networks_without_certificate(name: str, scenario: str | None, said: str) -> None:
    """Inner physics, batches, inexact solvers and disturbances have no certificate, and the error says which it is."""
    with pytest.raises(NoCertificate, match=said):
        bound(name, scenario=scenario)


@given(network=plain_networks, interval=st.floats(0.02, 0.4))
def test_large_networks_are_reached_by_the_same_formula(network: Network, interval: float) -> None:
    """The series that stands for matrices of nodes by nodes gives the same bounds, no closer than they are."""
    network = certifiable(network, interval, pulls=False)
    start, when = starting_stocks(Lifetimes(network, ()), None), range(network.episode.horizon)
    small = ComparisonSystem(Admissible.of(network)).reach(start, when)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reach, "DENSE", 0)
        large = ComparisonSystem(Admissible.of(network)).reach(start, when)
    np.testing.assert_allclose(large.upper, small.upper, rtol=1e-9, atol=1e-11 * start.sum())
    np.testing.assert_array_equal(large.uncut, small.uncut)


def test_the_series_is_cut_where_it_says() -> None:
    """What is left out, e^{Mh} x + ∫ e^{Ms} c ds by matrices less the sum of the series, is within its allowance."""
    rng = np.random.default_rng(1)
    matrix = sparse.random_array((40, 40), density=0.2, rng=rng) - sparse.diags_array(rng.uniform(0, 3, 40))
    state, constant = rng.uniform(0, 1, (2, 40))
    exact, _ = reach.ZeroOrderHold(matrix, 0.7)(state, constant)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reach, "DENSE", 0)
        for neglected in (1e-3, 1e-6, 1e-9):
            patch.setattr(reach, "TRUNCATION", neglected)
            found, missed = reach.ZeroOrderHold(matrix, 0.7)(state, constant)
            assert 0 < np.abs(found - exact).max() <= missed <= 40 * neglected * 10


@pytest.mark.medium
def test_a_network_of_two_thousand_nodes() -> None:
    """The program of a large network is written in seconds, and neutral control satisfies it."""
    rng = np.random.default_rng(0)
    size, degree = 2000, 1
    nodes = [
        stocked(f"n{i}", float(rng.uniform(1, 9)), control=valve(0.5, 1.0) if i % 3 else None) for i in range(size)
    ]
    ends = rng.integers(size, size=(2 * size, 2))
    arcs = [
        Arc(id=f"a{k}", donor=f"n{i}", recipient=f"n{j}", rate=0.3)
        for k, (i, j) in enumerate(ends[ends[:, 0] != ends[:, 1]].tolist())
    ]
    network = small(nodes, [*arcs, order("o", "n0", "n1", 1.0)], horizon=3)
    programs = Programs(Admissible.of(network), degree, None)
    problem = programs.program(starting_stocks(Lifetimes(network, ()), None))
    assert problem.equal.shape[1] == 3 * programs.layout.size
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), Neutral())
    ends_of = problem.high.reshape(3, -1)[:, programs.layout.last]
    assert (run.stock <= ends_of * (1 + 1e-9)).all()


def test_pull_beyond_the_stock_has_no_certificate() -> None:
    """A recipient that may empty its donor makes the solver cut flows, which is no linear law."""
    pull = Arc(id="pull", donor="reserve", recipient="use", law=Law.RECIPIENT, rate=0.5)
    assert bound(small([RESERVE, USE], [pull], horizon=2)).objective == pytest.approx(
        -10 * (math.exp(0.5) - 1), rel=1e-3
    )
    with pytest.raises(NoCertificate, match="more from node 'reserve' than it holds"):
        bound(small([RESERVE, USE], [pull], horizon=12))


def test_service_out_of_reach() -> None:
    """The error names the highest mean level that any actions reach: here 10·e^{−0.15 t} of 10 at the four ends."""
    loss = Arc(id="loss", donor="use", recipient="tip", rate=0.3)
    network = small([USE, TIP], [loss], [Service(id="served", provider="use", quantity="stock", low=10.0)], horizon=4)
    with pytest.raises(
        CirlError, match=r"no actions reach a mean service level of 0\.95 of 'served' \(at most 0\.69\d+\)$"
    ):
        bound(network, min_service=0.95, degree=4)
    highest = np.mean(np.exp(-0.15 * np.arange(1, 5)))
    assert bound(network, min_service=highest - 1e-6, degree=4).service == pytest.approx(highest, abs=1e-5)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"service_weight": 1.0, "min_service": 0.5}, "two ways"),
        ({"service_weight": -1.0}, "service_weight"),
        ({"min_service": 1.5}, "min_service"),
        ({"degree": 0}, "degree"),
        ({"initial": {"minne": 3.0}}, "Did you mean 'mine'"),
        ({"initial": {"mine": -3.0}}, "not negative"),
        ({"initial": [1.0, 2.0]}, "shape"),
        ({"agents": ["miner"]}, "unknown agent 'miner'"),
        ({"scenario": "papers"}, "unknown scenario"),
    ],
)
def test_bad_input(options: dict[str, object], said: str) -> None:
    """Options that cannot be used are named."""
    with pytest.raises(CirlError, match=said):
        bound(load_network("copper_net"), **options)  # type: ignore[call-overload]


def test_near_bound_is_where_the_solver_starts(monkeypatch: pytest.MonkeyPatch) -> None:
    """From the solution for another level, start or even network the same optimum is found and proved."""
    begun = list[Any]()

    def watch(problem: Any, basis: Any = None, **options: Any) -> Any:
        begun.append(basis)
        return solve(problem, basis, **options)

    monkeypatch.setattr(bounds, "solve", watch)
    alone = bound("carbo_net", min_service=0.95, horizon=12)
    start = alone.initial * 1.05
    for near in (bound("carbo_net", start, min_service=0.99, horizon=12), bound("copper_net", horizon=3)):
        found = bound("carbo_net", min_service=0.95, horizon=12, near=near)
        assert begun[-1] is near.basis is not None
        assert found.objective == pytest.approx(alone.objective, rel=1e-6)
        assert found.verify().bound == found.objective


def test_near_bound_of_another_degree_is_of_the_same_program() -> None:
    """What a network can reach is not found twice, and the program is the same as without; of other agents it is."""
    network = load_network("car_batteries").with_options(episode={"horizon": 4})
    near = bound(network, min_service=0.5)
    found = bound(network, min_service=0.6, degree=3, tight=True, near=near)
    alone = bound(network, min_service=0.6, degree=3, tight=True)
    assert found.problem.system is near.problem.system
    for name in ("cost", "equal", "equal_to", "under", "under_to", "low", "high"):
        mine, theirs = (getattr(each.problem, name) for each in (found, alone))
        np.testing.assert_array_equal(*(x.toarray() if sparse.issparse(x) else x for x in (mine, theirs)))
    assert found.objective == alone.objective
    few = bound(network, agents=network.default_agents[:1], near=near)
    assert few.problem.system is not near.problem.system
    assert few.objective == pytest.approx(bound(network, agents=network.default_agents[:1]).objective, rel=1e-6)
