"""Nodes without stock eliminated once and in each copy: the same throughputs, whoever is kept, and the same stocks."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from fractions import Fraction
from typing import Any
from unittest.mock import patch

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from benchmarks.generated import market_network, yearly_network
from cirl_marl import Arc, Control, ControlKind, Episode, Law, MultiAgentVectorEnv, Network, Node, Role, Series, Service
from cirl_marl.dynamics.arrivals import Arrivals
from cirl_marl.dynamics.elimination import visits
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.static_elimination import SparseRow, StaticElimination, contract_hubs, square_matrix
from cirl_marl.dynamics.store_chains import MANY, SHORT, StoreChains
from cirl_marl.errors import NetworkError
from cirl_marl.network import RowSum
from cirl_marl.network.elements import Lifetime, Substance

Floats = NDArray[np.float64]


def cycle(seed: int, stores: int, passing: int, leak: float = 0.1, **episode: Any) -> Network:
    """Return stocks and markets that pass to each other at random; a third of the markets have shares that change."""
    rng = np.random.default_rng(seed)
    nodes = [Node(id=f"s{i}", initial=(1.0, 90.0), rate=float(rng.uniform(0.02, 1.0))) for i in range(stores)]
    nodes += [Node(id=f"m{i}", stores=False) for i in range(passing)]
    names = [node.id for node in nodes]
    nodes.append(Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR))
    arcs = [Arc(id="feed", donor="mine", recipient=names[-1], law=Law.EXOGENOUS, flow=7.0)]
    arcs.append(Arc(id="ship", donor="s0", recipient="s1", law=Law.BATCH, batches=((0.0, 0.5),), delay=1.0))
    for donor in names:
        ends = [str(end) for end in rng.permutation([name for name in names if name != donor])[: rng.integers(1, 5)]]
        parts = (rng.dirichlet(np.ones(len(ends))) * (1 - leak)).tolist()
        parts[-1] *= float(rng.integers(2))
        changes = rng.integers(6) if len(ends) > 1 else 6
        for k, (end, part) in enumerate(zip(ends, parts, strict=True)):
            options: dict[str, Any] = {"share": part}
            if changes == 0 and k == 0:
                options = {"control": Control(kind=ControlKind.SHARE, low=part / 2, neutral=part, high=part)}
            elif changes == 1 and k == 0:
                options = {"share": Series(times=(0.0, 1.0), values=(part, part / 3))}
            arcs.append(Arc(id=f"{donor}_{end}", donor=donor, recipient=end, law=Law.SHARE, **options))
        rest = str(rng.choice([name for name in names[:stores] if name != donor]))
        arcs.append(Arc(id=f"{donor}_rest", donor=donor, recipient=rest, law=Law.SHARE))
    return Network(name="cycle", nodes=tuple(nodes), arcs=tuple(arcs), episode=Episode(horizon=3, **episode))


def keeping(kept: Iterable[int]) -> Any:
    """Return what makes networks keep these nodes, constant or not, and all others that can be eliminated be so."""
    eliminate, kept = StaticElimination._eliminate, set(kept)

    def chosen(self: StaticElimination, constant: set[int]) -> None:
        with patch("cirl_marl.dynamics.static_elimination.THRIFT", np.inf):
            eliminate(self, constant - kept)

    return patch.object(StaticElimination, "_eliminate", chosen)


def played(
    network: Network, seed: int, *, short: bool = True, kept: Iterable[int] | None = None, copies: int = 2
) -> list[Floats]:
    """Return flows and stocks of an episode of random actions in some copies."""
    if kept is None:
        env = MultiAgentVectorEnv(network, num_envs=copies)
    else:
        with keeping(kept):
            env = MultiAgentVectorEnv(network, num_envs=copies)
    if not short:
        assert env.dynamics.taylor is not None
        env.dynamics.taylor._shortcut = None
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    found = []
    for _ in range(network.episode.horizon):
        outcome = env.advance(rng.uniform(-1, 1, (len(env.agents), copies)))
        found += [outcome.flow, env.physical.stock]
    return found


@given(seed=st.integers(0, 2**31), stores=st.integers(2, 6), passing=st.integers(1, 25), part=st.floats(0, 1))
@settings(max_examples=25)
def test_whoever_is_kept(seed: int, stores: int, passing: int, part: float) -> None:
    """Everything kept and every flow computed in every term, against some kept, and what the library chooses."""
    network = cycle(seed, stores, passing)
    expected = played(network, seed, short=False, kept=range(passing))
    some = np.flatnonzero(np.random.default_rng(seed).random(passing) < part).tolist()
    for found in (played(network, seed), played(network, seed, kept=some), played(network, seed, kept=())):
        for ours, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-13 * np.abs(theirs).max())


@given(seed=st.integers(0, 2**31))
@settings(max_examples=5)
def test_explicit_solvers_take_the_same_detours(seed: int) -> None:
    """rk4 passes flows on in each stage."""
    network = cycle(seed, 3, 12, solver="rk4", solver_step=0.5)
    for ours, theirs in zip(played(network, seed), played(network, seed, kept=range(12)), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-13, atol=1e-13 * np.abs(theirs).max())


@given(seed=st.integers(0, 2**31), passing=st.integers(1, 8), exponent=st.integers(1, 14))
def test_throughputs_past_detours_are_accurate(seed: int, passing: int, exponent: int) -> None:
    """Against fractions, of the very shares that the simulator has, however small the leak and whoever is kept."""
    rng = np.random.default_rng(seed)
    try:
        network = cycle(seed, 2, passing, leak=10.0**-exponent)
    except NetworkError:  # rounding can leave a loop without a leak, which is refused
        reject()
    with keeping(np.flatnonzero(rng.random(passing) < 0.3).tolist()):
        dynamics = Dynamics(network)
    low, high = dynamics.control_low[:, :1], dynamics.control_high[:, :1]
    rate = dynamics.rate(low + (high - low) * rng.random(low.shape), np.array([0]))
    stores = len(network.stores)
    matrix = [[Fraction(0)] * (passing + 1) for _ in range(passing)]
    flow = np.zeros_like(rate)
    for k, (i, j) in enumerate(zip(network.donors - stores, network.recipients - stores, strict=True)):
        part = Fraction(float(rate[k, 0]))
        if i < 0 and j >= 0:
            flow[k] = 1.0
            matrix[j][passing] += 1
        elif i >= 0:
            matrix[i][i] += part
            if j >= 0:
                matrix[j][i] -= part
    for i in range(passing):
        for j in range(passing):
            if j != i:
                factor = matrix[j][i] / matrix[i][i]
                matrix[j] = [a - factor * b for a, b in zip(matrix[j], matrix[i], strict=True)]
    exact = [float(matrix[i][passing] / matrix[i][i]) for i in range(passing)]
    routes = dynamics.routing.routes(rate)
    assert routes is not None
    dynamics.routing.pass_on(flow, routes)
    np.testing.assert_allclose(network.throughput(flow)[:, 0], exact, rtol=1e-12)


def crowds(least: int) -> Any:
    """Return what lets as few nodes as ``least`` be a core, however few of them pass to each other."""
    return patch.multiple("cirl_marl.dynamics.elimination", CORE=least, CROWDED=0.0)


@given(seed=st.integers(0, 2**31), passing=st.integers(1, 25), least=st.integers(1, 12))
@settings(max_examples=15)
def test_a_core_is_passed_as_its_nodes_are_one_by_one(seed: int, passing: int, least: int) -> None:
    """Inverted at once or eliminated in rounds, after rounds or without; two copies or each alone, to the bit."""
    network = cycle(seed, 3, passing)
    with crowds(least):
        env = MultiAgentVectorEnv(network, num_envs=2)
        kept = range(0, passing, 2)
        ours = played(network, seed), played(network, seed, kept=kept)
        lone = MultiAgentVectorEnv(network, num_envs=1)
    for found, expected in zip(ours, (played(network, seed), played(network, seed, kept=kept)), strict=True):
        for mine, theirs in zip(found, expected, strict=True):
            np.testing.assert_allclose(mine, theirs, rtol=1e-13, atol=1e-13 * np.abs(theirs).max())
    actions = np.random.default_rng(seed).uniform(-1, 1, (len(env.agents), 2))
    env.reset(seed=[4, 5])
    lone.reset(seed=[5])
    np.testing.assert_array_equal(env.advance(actions).flow[:, 1:], lone.advance(actions[:, 1:]).flow)


@given(seed=st.integers(0, 2**31), passing=st.integers(2, 25), least=st.sampled_from([3, 99]))
@settings(max_examples=15)
def test_columns_of_a_copy_are_passed_as_each_alone(seed: int, passing: int, least: int) -> None:
    """Three columns of each copy, all copies or two of them, in two calls or in rounds: to the bit."""
    rng = np.random.default_rng(seed)
    with crowds(least):
        dynamics = Dynamics(cycle(seed, 2, passing))
    low, high = dynamics.control_low[:, :1], dynamics.control_high[:, :1]
    rate = dynamics.rate(low + (high - low) * rng.random((len(low), 4)), np.zeros(4, dtype=np.intp))
    routing, entering = dynamics.routing, rng.random((passing, 4, 3))

    def passed(copies: Any, columns: Any, *, anew: bool = False) -> Floats:
        routes = routing.routes(np.ascontiguousarray(rate[:, copies]) if anew else rate)
        assert routes is not None
        routes = routes if anew else routes.of_copies(copies)
        entered = np.array(entering[:, copies, columns], order="C")  # used up
        through = routing.throughputs(entered.reshape(passing, -1), routes)
        return through.reshape(entered.shape)

    every = passed(slice(0, 4), slice(0, 3))
    for column in range(3):
        alone = passed(np.array([2]), slice(column, column + 1), anew=True)
        np.testing.assert_array_equal(every[:, 2:3, column : column + 1], alone)
    with patch("cirl_marl.dynamics.elimination.kernels_round_products", lambda: False):
        np.testing.assert_array_equal(every[:, [3, 1]], passed(np.array([3, 1]), slice(0, 3)))


@given(seed=st.integers(0, 2**31), stores=st.integers(2, 3), passing=st.integers(1, 25), least=st.sampled_from([3, 99]))
@settings(max_examples=30)
def test_what_arcs_add_at_once_is_what_comes_through(seed: int, stores: int, passing: int, least: int) -> None:
    """(I − Pᵀ)⁻¹ of a full matrix, at stocks and flows, whoever is kept or in the core; and copies are as alone."""
    rng = np.random.default_rng(seed)
    network = cycle(seed, stores, passing)
    with crowds(least), keeping(rng.permutation(passing)[: rng.integers(passing + 1)].tolist()):
        dynamics = Dynamics(network)
    inside = [arc.id for arc in network.arcs if arc.donor.startswith("m")]
    services = [Service(id=f"in_{i}", provider=f"s{i}", quantity="stock", low=1.0) for i in range(stores)]
    services.append(Service(id="both", provider="s0", also=("s1",), quantity="stock", low=1.0))
    services += [
        Service(id=arc, provider=arc, quantity="flow", low=1.0) for arc in rng.permutation(inside)[:3].tolist()
    ]
    arcs = np.flatnonzero(network.donors < len(network.stores))
    low, high = dynamics.control_low[:, :1], dynamics.control_high[:, :1]
    rate = dynamics.rate(low + (high - low) * rng.random((len(low), 3)), np.zeros(3, dtype=np.intp))
    arrivals = Arrivals(dynamics, services, arcs)
    result = arrivals(dynamics.routing.routes(rate))
    np.testing.assert_array_equal(result[:, -1:], arrivals(dynamics.routing.routes(rate[:, 2:].copy())))

    donors, recipients, first = network.donors, network.recipients, len(network.stores)
    for copy_ in range(3):
        shares = np.zeros((passing, passing))
        out = np.flatnonzero(donors >= first)
        among = out[recipients[out] >= first]
        np.add.at(shares, (recipients[among] - first, donors[among] - first), rate[among, copy_])
        visits_ = np.linalg.inv(np.eye(passing) - shares)
        for n, arc in enumerate(arcs.tolist()):
            flow = 1.0 * (np.arange(len(network.arcs)) == arc)
            if recipients[arc] >= first:
                flow[out] += visits_[donors[out] - first, recipients[arc] - first] * rate[out, copy_]
            read = []
            for service in services:
                at = [network.node_index.get(id_, -1) for id_ in service.providers]
                inflows = np.isin(recipients, at) & ~np.isin(donors, at)
                read.append(flow[inflows].sum() if service.quantity == "stock" else flow[network.arc_index[service.id]])
            np.testing.assert_allclose(result[n, min(copy_, result.shape[1] - 1)], read, rtol=1e-10, atol=1e-14)


@given(seed=st.integers(0, 2**31), count=st.integers(1, 9), exponent=st.integers(1, 14))
def test_visits_are_accurate_however_much_goes_round(seed: int, count: int, exponent: int) -> None:
    """(I − P) V = I in fractions, where V is what several copies get together, and each alone, to the bit."""
    rng = np.random.default_rng(seed)
    shares = rng.random((3, count, count)) * (rng.random((3, count, count)) < 0.7)
    shares[:, np.arange(count), np.arange(count)] = 0.0
    exits = rng.random((3, count)) * 10.0**-exponent
    found = visits(shares, exits)
    np.testing.assert_array_equal(found[1:2], visits(shares[1:2].copy(), exits[1:2].copy()))
    matrix = [[Fraction(-shares[0, i, j]) for j in range(count)] for i in range(count)]
    for i in range(count):
        matrix[i][i] = sum(map(Fraction, shares[0, i]), Fraction(exits[0, i]))
        matrix[i] += [Fraction(int(i == j)) for j in range(count)]
    for i in range(count):
        for k in range(count):
            if k != i:
                factor = matrix[k][i] / matrix[i][i]
                matrix[k] = [a - factor * b for a, b in zip(matrix[k], matrix[i], strict=True)]
    exact = [[float(matrix[i][count + j] / matrix[i][i]) for j in range(count)] for i in range(count)]
    np.testing.assert_allclose(found[0], exact, rtol=1e-12)


@pytest.mark.medium
@pytest.mark.parametrize("every", [0, 3])
def test_markets_at_random_have_a_core(every: int) -> None:
    """Hubs that pass to each other: batch = lone to the bit, and no mass is lost, whatever the agents do."""
    network = market_network(600, every=every)
    env, lone = MultiAgentVectorEnv(network, num_envs=2), MultiAgentVectorEnv(network, num_envs=1)
    assert len(env.dynamics.routing.detours.elimination.core) >= 64 or every == 0
    env.reset(seed=[4, 5])
    lone.reset(seed=[5])
    start = env.physical.stock.sum(axis=0)
    for seed in range(3):
        actions = np.random.default_rng(seed).uniform(-1, 1, (len(env.agents), 2))
        outcome = env.advance(actions)
        np.testing.assert_array_equal(outcome.flow[:, 1:], lone.advance(actions[:, 1:]).flow)
        through = np.zeros((len(network.nodes), 2))
        np.add.at(through, network.recipients, outcome.flow)
        passing = slice(len(network.stores), None)
        np.testing.assert_allclose(through[passing], network.throughput(outcome.flow), rtol=1e-12)
    np.testing.assert_allclose(env.physical.stock.sum(axis=0), start, rtol=1e-12)


@pytest.mark.slow
def test_compiled_size_is_in_proportion_to_the_network() -> None:
    """World markets that pass to every region are kept, so that the regions are not joined to each other."""
    networks = [yearly_network(regions=regions) for regions in (30, 300)]
    detours = [Dynamics(network).routing.detours for network in networks]
    entries = [sum(map(len, found.out)) + found.elimination.size for found in detours]
    arcs = [len(network.arcs) for network in networks]
    assert entries[1] / arcs[1] <= 1.1 * entries[0] / arcs[0]


@pytest.mark.parametrize("batch", [1, 2, 33])
def test_substitution(batch: int) -> None:
    """(I − W) y = x for strictly lower triangular W, in place, for one column as for many."""
    rng = np.random.default_rng(0)
    dense = np.tril(rng.uniform(-1, 1, (9, 9)), -1) * (rng.random((9, 9)) < 0.5)
    rows, columns = np.nonzero(dense)
    values = rng.normal(size=(9, batch))
    found = RowSum(rows, columns, dense[rows, columns], (9, 9)).substitute(values.copy())
    np.testing.assert_allclose(found - dense @ found, values, atol=1e-13)


@given(seed=st.integers(0, 2**31), hubs=st.integers(0, 12))
def test_contraction_keeps_what_sources_send(seed: int, hubs: int) -> None:
    """Fewer ways, the same parts from each source to each end."""
    rng = np.random.default_rng(seed)
    size = hubs + 6
    weights = np.tril(rng.random((size, size)), -1) * (rng.random((size, size)) < 0.4)
    weights[:3], weights[:, -3:] = 0.0, 0.0

    def sent(gives: Mapping[int, SparseRow]) -> Floats:
        matrix = square_matrix(gives, {i: i for i in range(size)}, size)
        return matrix.substitute(np.eye(size))[-3:, :3]

    gives = {i: {int(j): float(weights[j, i]) for j in np.flatnonzero(weights[:, i])} for i in range(size - 3)}
    expected, before = sent(gives), sum(map(len, gives.values()))
    left = contract_hubs(gives, range(3, size - 3))
    assert sum(map(len, gives.values())) <= before
    assert gives.keys() == {0, 1, 2, *left}
    np.testing.assert_allclose(sent(gives), expected, rtol=1e-13)


def test_a_cycle_of_500_nodes_keeps_few() -> None:
    """In the network that speed is measured on, the world markets and those who decide; batch = lone, mass kept."""
    network = yearly_network()
    env = MultiAgentVectorEnv(network, num_envs=3)
    passing = network.nodes[len(network.stores) :]
    assert (len(network.nodes), len(passing)) == (501, 400)
    kept = {passing[i].id for i in env.dynamics.routing.detours.kept_nodes}
    assert kept >= {arc.donor for arc in network.arcs if arc.control is not None}
    assert len(kept) <= 20
    env.reset(seed=4)
    start = env.physical.stock.sum(axis=0)
    lone = MultiAgentVectorEnv(network, num_envs=1)
    lone.reset(seed=6)
    actions = np.random.default_rng(0).uniform(-1, 1, (len(env.agents), 3))
    flow, own = env.advance(actions).flow, lone.advance(actions[:, 2:]).flow
    np.testing.assert_array_equal(flow[:, 2:], own)
    np.testing.assert_allclose(env.physical.stock.sum(axis=0), start, rtol=1e-13)


def test_a_flow_that_is_cut_in_one_copy_leaves_the_others_as_they_are() -> None:
    """Where a recipient draws more than there is, the step is taken again: the other copies equal lone ones."""
    network = cycle(1, 4, 12)
    pull = Arc(id="pull", donor="pot", recipient="s2", law=Law.RECIPIENT, rate=0.5)
    nodes = (*network.nodes, Node(id="pot", initial=(0.0, 2e3)))
    network = Network(name="pulled", nodes=nodes, arcs=(*network.arcs, pull), episode=network.episode)
    held = np.array([1e3, 1e-3, 1e3])
    env = MultiAgentVectorEnv(network, num_envs=3)
    env.reset(seed=0, options={"initial_state": {"pot": held}})
    actions = np.random.default_rng(0).uniform(-1, 1, (len(env.agents), 3))
    flow, stock = env.advance(actions).flow, env.physical.stock
    pulled = flow[network.arc_index["pull"]]
    assert pulled[1] == pytest.approx(1e-3)
    assert pulled[[0, 2]].min() > 0.1
    for i in range(3):
        lone = MultiAgentVectorEnv(network, num_envs=1)
        lone.reset(seed=i, options={"initial_state": {"pot": held[i]}})
        np.testing.assert_array_equal(lone.advance(actions[:, i : i + 1]).flow[:, 0], flow[:, i])
        np.testing.assert_array_equal(lone.physical.stock[:, 0], stock[:, i])


def chained(seed: int) -> Network:
    """Return a network of two lifetimes in a ring of markets, of which agents stretch one or both, with a substance."""
    rng = np.random.default_rng(seed)
    stretch = Control(kind=ControlKind.STRETCH, low=0.5, neutral=1.0, high=2.0)
    uses = [
        Node(
            id=f"use_{i}",
            initial=(10.0, 50.0),
            lifetime=Lifetime(mean=float(rng.uniform(4, 12)), deviation=float(rng.uniform(0.8, 3))),
            control=stretch if i == 0 or rng.random() < 0.5 else None,
            content=(("copper", 0.1),) if i else (),
        )
        for i in range(2)
    ]
    arcs = [Arc(id=f"made_{i}", donor="market", recipient=f"use_{i}", law=Law.SHARE) for i in range(2)]
    arcs[0] = replace(arcs[0], control=Control(kind=ControlKind.SHARE, low=0.1, neutral=0.3, high=0.9))
    arcs += [Arc(id=f"scrap_{i}", donor=f"use_{i}", recipient="scrap", law=Law.SHARE, share=1.0) for i in range(2)]
    arcs += [Arc(id="melt", donor="scrap", recipient="market", rate=float(rng.uniform(0.1, 0.9)))]
    arcs += [Arc(id="mined", donor="ore", recipient="market", law=Law.EXOGENOUS, flow=2.0)]
    nodes = (
        *uses,
        Node(id="scrap", initial=(5.0, 5.0)),
        Node(id="ore", role=Role.NONRENEWABLE_RESERVOIR),
        Node(id="market", stores=False),
    )
    episode = Episode(horizon=8)
    substances = (Substance(id="copper"),) if rng.random() < 0.5 else ()
    if not substances:
        nodes = tuple(replace(node, content=()) for node in nodes)
    return Network(name="chained", nodes=nodes, arcs=tuple(arcs), episode=episode, substances=substances)


@given(seed=st.integers(0, 2**31))
@settings(max_examples=8)
@pytest.mark.slow
def test_chains_of_stores_move_what_the_sparse_sum_does(seed: int) -> None:
    """Stages whose rates an agent sets move along slices of rows, all of them; without, flows are the same."""

    def none(gives: Any, drivers: Any, flows: Any, first: int) -> StoreChains:
        return StoreChains(gives, [], [], first)

    network = chained(seed)
    ours = played(network, seed, copies=MANY)
    dynamics = MultiAgentVectorEnv(network).dynamics
    assert dynamics.taylor is not None and dynamics.taylor._shortcut is not None
    chains = dynamics.taylor._shortcut._chains
    lifetimes = [node.lifetime for node in network.stores if node.lifetime is not None and node.control is not None]
    stages = [len(lifetime.chain.inflow_shares) for lifetime in lifetimes if lifetime.chain is not None]
    least = sum(count - 1 for count in stages if count > SHORT) * (1 + len(network.substances))
    assert len(chains.flows) >= least
    with patch("cirl_marl.dynamics.taylor.StoreChains", none):
        theirs = played(network, seed, copies=MANY)
    for one, other in zip(ours, theirs, strict=True):
        np.testing.assert_allclose(one, other, rtol=1e-12, atol=1e-13)


@given(seed=st.integers(0, 2**31))
@settings(max_examples=6)
@pytest.mark.slow
def test_many_copies_move_along_chains_as_few_do(seed: int) -> None:
    """To the bit: many take slices of rows, few the sparse sum."""
    network, rng = chained(seed), np.random.default_rng(seed)
    many, lone = (MultiAgentVectorEnv(network, num_envs=count) for count in (MANY, 1))
    many.reset(seed=seed)
    lone.reset(seed=seed + MANY - 1)
    for _ in range(network.episode.horizon):
        actions = rng.uniform(-1, 1, (len(many.agents), MANY))
        flow, own = many.advance(actions).flow, lone.advance(actions[:, -1:]).flow
        np.testing.assert_array_equal(flow[:, -1:], own)
        np.testing.assert_array_equal(many.physical.stock[:, -1:], lone.physical.stock)


@given(seed=st.integers(0, 2**31), stores=st.integers(1, 40), short=st.sampled_from((1, 2, 8)))
@settings(max_examples=60)
def test_chains_add_up_to_what_stores_change_by(seed: int, stores: int, short: int) -> None:
    """Whatever flows where: what chains write and what is left to the sparse sum is ẋ, and no row is written twice."""
    rng, first, copies = np.random.default_rng(seed), 1000, 3
    drivers = rng.permutation(np.append(np.arange(stores), rng.integers(0, stores, stores // 4)))
    drivers = drivers[rng.random(len(drivers)) < 0.9]
    names = 100 + np.arange(len(drivers))
    gives: dict[int, dict[int, float]] = {1: {first: 0.5}}
    for name, row in zip(names.tolist(), drivers.tolist(), strict=True):
        end = row + 1 if rng.random() < 0.8 else int(rng.integers(0, stores + 5))
        weight = 1.0 if rng.random() < 0.9 else 0.7
        gives[name] = {first + row: -1.0}
        gives[name][first + end] = gives[name].get(first + end, 0.0) + weight
    rate, mass = rng.uniform(0.1, 1, (len(drivers), copies)), rng.uniform(0, 9, (stores, copies))
    flow, extent = rate * mass[drivers], stores + 5
    whole = np.zeros((extent, copies))
    for name, parts in gives.items():
        for end, part in parts.items():
            whole[end - first] += part * (flow[name - 100] if name >= 100 else 1.0)
    leaving = [(row, name) for row, name in zip(drivers.tolist(), names.tolist(), strict=True)]
    leaving = [(row, name) for row, name in leaving if gives[name].get(first + row) == -1.0]
    going_on = {row for row, name in leaving if gives[name].get(first + row + 1) == 1.0}
    single = np.array(sorted({row for row, _ in leaving}), dtype=int)
    pieces = np.split(single, np.flatnonzero(np.diff(single) > 1) + 1)
    with patch("cirl_marl.dynamics.store_chains.SHORT", short):
        chains = StoreChains(gives, drivers.tolist(), names.tolist(), first)
    change = np.full((extent, copies), np.nan)
    rows = np.concatenate([np.arange(0), *(np.arange(run.start, run.stop) for run in chains.runs)])
    assert rows.tolist() == [row for piece in pieces if len(piece) >= short for row in piece.tolist()]
    links = {row for row, parts in zip(rows.tolist(), chains.moves.values(), strict=True) if first + row + 1 in parts}
    assert links == going_on & set(rows.tolist()) & set((rows - 1).tolist())
    np.testing.assert_array_equal(drivers[chains.flows], rows)
    chains.changes(mass, rate[chains.flows], np.empty_like(flow[chains.flows]), change)()
    np.testing.assert_array_equal(np.flatnonzero(np.isfinite(change).all(axis=1)), np.sort(rows))
    change = np.nan_to_num(change)
    moved = np.zeros_like(change)
    for name, parts in chains.moves.items():
        for end, part in parts.items():
            moved[end - first] += part * flow[name - 100]
    np.testing.assert_array_equal(moved, change)
    for name, parts in gives.items():
        assert parts or name not in chains.moves
        for end, part in parts.items():
            change[end - first] += part * (flow[name - 100] if name >= 100 else 1.0)
    np.testing.assert_allclose(change, whole, rtol=1e-12, atol=1e-12)
