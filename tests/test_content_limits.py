"""Limits of contents that nothing can keep, and the ranges of contents by which they are told."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from scipy.linalg import expm
from test_changing_contents import NOISE, mine
from test_substances import COPPER, sorter, sorting_line, substances_networks

from cirl_marl import (
    MPC,
    Arc,
    CirlError,
    Control,
    ControlKind,
    DefinitionError,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    Role,
    Service,
    Substance,
    bound,
    load_network,
    simulate_plan,
)
from cirl_marl.controllers.rollout import episode_start
from cirl_marl.definitions.writer import definition_of
from cirl_marl.network.disturbances import DisturbanceEffect
from cirl_marl.network.reachable_contents import reachable_contents
from cirl_marl.network.series import Series
from cirl_marl.network.uncertainty import Spread, factor_ranges, network_of_intervals
from cirl_marl.network.validation import content_limits
from cirl_marl.optimum.options import with_margin
from cirl_marl.reasons.prices import with_bound
from cirl_marl.suite.tasks import variant_of

SPREAD = Spread(low=0.5, high=1.2, distribution="uniform")


def with_limit(network: Network, high: float | Series, **changes: Any) -> Network:
    """Return a network that is checked, whose last service has this limit."""
    *demands, last = network.services
    return replace(
        network, services=(*demands, replace(last, low=0.0, high=high)), is_variant=False, scenarios={}, **changes
    )


def uncertain_network(network: Network, seed: int) -> Network:
    """Return a network of which contents, transfers and shares are drawn, as far as they can be."""
    paths = [f"nodes.{node.id}.content.{name}" for node in network.nodes for name in dict(node.content)]
    paths += [f"arcs.{arc.id}.transfer.{name}" for arc in network.arcs for name in dict(arc.transfer)]
    paths += [f"arcs.{arc.id}.{name}" for arc in network.arcs for name in ("share", "control")]
    for path in np.random.default_rng(seed).permutation(paths)[:5].tolist():
        try:
            network = network.variant(uncertain={**network.uncertain, path: SPREAD})
        except NetworkError:
            continue  # nothing is stated there, or some draws are no shares
    return network


@given(network=substances_networks, seed=st.integers(0, 1000), is_drawn=st.booleans())
def test_no_episode_leaves_the_ranges(network: Network, seed: int, is_drawn: bool) -> None:
    """Whatever random actions do and draws bring, contents of stocks and flows lie in what limits are held against."""
    network = uncertain_network(network, seed) if is_drawn else network
    starts = content_limits._starts(network, factor_ranges(network, with_draws=True))
    ranges = reachable_contents(network, starts, content_limits._shares(network), set())
    env = MultiAgentVectorEnv(network, num_envs=4, uncertain=bool(network.uncertain))
    env.reset(seed=seed)
    rng, count, stores = np.random.default_rng(seed), len(network.substances), len(network.stores)
    for _ in range(network.episode.horizon):
        env.advance(rng.choice([-1.0, 0.0, 1.0], (len(env.actuators.control_rows), 4)))
        stock = env.physical.stock
        held = env.rows.stocks(stock)[:stores], env.rows.substances(stock).reshape(count, -1, 4)[:, :stores]
        moved = env.physical.flow, env.physical.substances.reshape(count, -1, 4)
        for (whole, parts), (low, high) in zip((held, moved), ranges, strict=True):
            margin = 1e-9 * whole + 1e-14 * stock.sum()
            assert (parts >= low[1:, :, None] * whole - margin).all()
            assert (parts <= high[1:, :, None] * whole + margin).all()


@given(seed=st.integers(0, 1000))
def test_shares_of_components_lead_to_contents_within_the_ranges(seed: int) -> None:
    """What a node hands on has s_c·x_c of Σ s·x: with three components of certain contents and shares in ranges."""
    network, rng = sorting_line(), np.random.default_rng(seed)
    contents, shares = rng.dirichlet(np.ones(3)), rng.uniform(0.01, 1.0, 3)
    starts = np.tile([[[1.0]], [[0.0]]], (1, 3, len(network.stores)))
    starts[:, :, 0] = contents
    bounds = np.ones((2, 3, len(network.arcs)))
    rejects = network.arc_index["rejects"]
    bounds[:, :, rejects] = shares * rng.uniform(0.5, 1.0, 3), np.minimum(shares * rng.uniform(1.0, 2.0, 3), 1.0)
    low, high = reachable_contents(network, starts, bounds, set())[1][:, :, rejects]
    exact = contents * shares / (contents @ shares)
    assert (low <= exact).all() and (exact <= high).all()


@pytest.mark.parametrize(("controlled", "transfer"), [(False, 0.8), (True, 0.9)])
def test_limits_that_no_sorting_keeps_are_refused(controlled: bool, transfer: float) -> None:
    """Of 2 % copper at most that share is rejected: the rest has 0.45 or 0.23 %, the lowest limit, which is told."""
    network = sorting_line(transfer=0.8, controlled=controlled)
    passing = (1 - transfer) * 0.02
    least = passing / (passing + 0.9 * 0.98)
    with pytest.raises(
        NetworkError, match=r"service 'purity': high 0.002: at least .* in 'recovery' is copper"
    ) as error:
        with_limit(network, 0.002)
    offer = float(re.findall(r"the lowest limit that can be kept is (\S+)$", str(error.value))[0])
    assert least <= offer < least * 1.001
    assert with_limit(network, offer) and with_limit(network, least)
    with pytest.raises(NetworkError, match="whatever is done"):
        with_limit(network, least * (1 - 1e-8))


def test_grades_that_nothing_has_are_refused() -> None:
    """The richest stock has 4 %, which is told; a limit between the poorest and the richest can be kept."""
    assert sorter(low=0.01, high=0.02) and sorter(low=0.04)
    with pytest.raises(NetworkError, match=r"low 0.05: at most 0.04 .*; the highest grade that can be had is 0.04$"):
        sorter(low=0.05)
    with pytest.raises(NetworkError, match=r"low 0.05: at most 0.04"):
        sorter(low=Series(times=(0.0, 2.0), values=(0.01, 0.05)))


def test_what_there_is_dilutes_and_an_empty_stock_does_not() -> None:
    """Ore of 3 % in place of pure ore leaves only what the first product has, if there is any."""
    network = sorter(low=0.0, high=0.02)
    ore, scrap, use, *rest = network.nodes
    nodes = (replace(ore, content={"copper": 0.03}), scrap, use, *rest)
    with pytest.raises(NetworkError, match=r"service 'clean': high 0.02: at least 0.03 of what is in 'made' is copper"):
        with_limit(network, 0.02, nodes=nodes)
    in_use = replace(network.services[1], provider="use", quantity="stock", high=0.01)
    services = (network.services[0], in_use)
    assert replace(network, nodes=nodes, services=services)
    empty = (*nodes[:2], replace(use, initial=(0.0, 0.0), content={}), *rest)
    with pytest.raises(NetworkError, match=r"high 0.01: at least 0.03 of what is in 'use' is copper"):
        replace(network, nodes=empty, services=services)
    bare = (*(replace(node, initial=(0.0, 0.0)) for node in nodes[:2]), *empty[2:])
    assert replace(network, nodes=bare, services=services)  # nothing ever flows
    sum_of_both = replace(in_use, also=("scrap",))
    with pytest.raises(NetworkError, match="of what is in 'use, scrap' is copper"):
        replace(network, nodes=empty, services=(sum_of_both,))


def test_a_loop_that_separates_again_and_again_keeps_every_limit() -> None:
    """What comes back is sorted anew, and gets as pure as one likes; not where nothing is separated.

    Of a component of which a part p is rejected, use and what is recovered obey ẋ = −k·x + y, ẏ = (1 − p)·k·x − y.
    """
    network = sorting_line(transfer=0.8)
    again = Arc(id="again", donor="recovered", recipient="use", law=Law.DONOR, rate=1.0)
    arcs = (network.arcs[0], replace(network.arcs[1], recipient="recovered"), network.arcs[2], again)
    nodes = (*network.nodes, Node(id="recovered", initial=(0.0, 0.0)))
    looped = with_limit(network, 1e-6, nodes=nodes, arcs=arcs).with_options(episode={"horizon": 40})
    run = MultiAgentVectorEnv(looped, num_envs=1)
    run.reset(seed=0)
    for _ in range(40):
        outcome = run.advance(np.empty((0, 1)))
    assert outcome.levels[0, 0] == 1.0
    rate, ends = np.log(2), []
    for start, part in ((98.0, 0.1), (2.0, 0.8)):
        ends.append(expm(40 * np.array([[-rate, 1.0], [(1 - part) * rate, -1.0]]))[:, 0] * start)
    rows, stock = [looped.node_index[id_] for id_ in ("use", "recovered")], run.physical.stock
    np.testing.assert_allclose(run.rows.stocks(stock)[rows, 0], sum(ends), rtol=1e-10)
    np.testing.assert_allclose(run.rows.substances(stock)[rows, 0], ends[1], rtol=1e-10)
    plain = tuple(replace(arc, transfer={}) for arc in arcs)
    with pytest.raises(NetworkError, match=r"the lowest limit that can be kept is 0.02$"):
        with_limit(network, 1e-6, nodes=nodes, arcs=plain)


def sorting_loop(seed: int, mines: int, *, controlled: bool = False) -> Network:
    """Return mines of different contents, and sorters without stock that pass material round and on to use."""
    rng, count = np.random.default_rng(seed), int(np.random.default_rng(seed).integers(1, 4))
    nodes = [Node(id=f"sorter_{i}", stores=False) for i in range(count)]
    nodes += [Node(id="use", initial=(0.0, 0.0)), Node(id="waste", initial=(0.0, 0.0), role=Role.LANDFILL)]
    arcs = []
    for i in range(mines):
        start, share = float(rng.uniform(1, 9)), float(rng.uniform(0.01, 0.3))
        nodes.append(Node(id=f"mine_{i}", initial=(start, start), content={"copper": share}))
        entry = f"sorter_{rng.integers(count)}"
        arcs.append(Arc(id=f"mined_{i}", donor=f"mine_{i}", recipient=entry, rate=float(rng.uniform(0.1, 0.5))))
    for i in range(count):
        shares, parts = rng.dirichlet(np.ones(count + 2), 2).tolist()
        ends = {f"on_{i}_{j}": f"sorter_{j}" for j in range(count) if i != j} | {f"rejects_{i}": "waste"}
        for (id_, end), share, part in zip(ends.items(), shares, parts, strict=False):
            arc = Arc(id=id_, donor=f"sorter_{i}", recipient=end, law=Law.SHARE, share=share, transfer={"copper": part})
            if controlled and (id_ == "rejects_0" or rng.random() < 0.5):
                control = Control(kind=ControlKind.TRANSFER, low=0.0, neutral=part, high=part, substances=("copper",))
                arc = replace(arc, transfer={}, control=control)
            arcs.append(arc)
        arcs.append(Arc(id=f"made_{i}", donor=f"sorter_{i}", recipient="use", law=Law.SHARE))
    episode = Episode(horizon=3)
    return Network(
        name="loop", nodes=tuple(nodes), arcs=tuple(arcs), substances=(Substance(id="copper"),), episode=episode
    )


@given(seed=st.integers(0, 2**31), mines=st.integers(1, 3), controlled=st.booleans())
@settings(max_examples=40)
def test_loops_without_stock_purify_as_far_as_they_do(seed: int, mines: int, controlled: bool) -> None:
    """Contents of all flows lie in their ranges; of one mine they are these, and limits below them are refused."""
    network, rng = sorting_loop(seed, mines, controlled=controlled), np.random.default_rng(seed)
    starts = content_limits._starts(network, {})
    low, high = (side[1] for side in reachable_contents(network, starts, content_limits._shares(network), set())[1])
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    for _ in range(network.episode.horizon):
        env.advance(rng.choice([-1.0, 0.0, 1.0], (len(env.actuators.control_rows), 1)))
        content = env.physical.substances[:, 0] / env.physical.flow[:, 0]
        assert (content >= low - 1e-8).all() and (content <= high + 1e-8).all()
    if mines > 1:  # of one content, which mixing alone does not change, not even by rounding
        nodes = [replace(node, content=dict.fromkeys(dict(node.content), 0.1)) for node in network.nodes]
        arcs = [replace(arc, transfer={}, control=None) for arc in network.arcs]
        mixing = replace(network, nodes=tuple(nodes), arcs=tuple(arcs))
        starts, shares = content_limits._starts(mixing, {}), content_limits._shares(mixing)
        assert (reachable_contents(mixing, starts, shares, set())[1][:, 1] == 0.1).all()
    if mines > 1 or controlled:
        return
    np.testing.assert_allclose(low, content, rtol=0, atol=1e-8)
    np.testing.assert_allclose(high, content, rtol=0, atol=1e-8)
    made = network.arc_index["made_0"]
    limits = [
        Service(id="pure", provider="made_0", quantity="flow", substance="copper", low=0.0, high=content[made] * part)
        for part in (1.001, 0.999)
    ]
    assert replace(network, services=(limits[0],))
    with pytest.raises(NetworkError, match="of what is in 'made_0' is copper, whatever is done"):
        replace(network, services=(limits[1],))
    drawn = {"arcs.rejects_0.transfer.copper": Spread(low=0.5, high=1.0, distribution="uniform")}
    assert replace(network, services=(limits[1],), uncertain=drawn)


@pytest.mark.slow
@given(seed=st.integers(0, 2**31), kind=st.sampled_from(["transfer", "share", "uncertain"]))
@example(seed=1004, kind="share")  # the most has not settled after many rounds, the least has
@settings(max_examples=30)
def test_loops_that_agents_or_draws_change_have_limits(seed: int, kind: str) -> None:
    """The first sorter rejects parts p of copper and q of all else, and the second sends a share s back.

    Copper passes that (1 − p)/(1 − (1 − p)·s) times, all else likewise, each as seldom or as often as shares allow;
    where the first only enriches copper, nothing is purer than what passes it once.
    """
    rng = np.random.default_rng(seed)
    content, part, other, back = rng.uniform(0.05, 0.9, 4)
    copper = {"copper": float(part)}
    control = Control(kind=ControlKind.TRANSFER, low=0.0, neutral=0.1 * part, high=part, substances=("copper",))
    rejects = Arc(id="rejects", donor="first", recipient="waste", law=Law.SHARE, share=other, transfer=copper)
    again = Arc(id="again", donor="second", recipient="first", law=Law.SHARE, share=back)
    if kind == "transfer":
        rejects = replace(rejects, transfer={}, control=control)
    elif kind == "share":
        again = replace(again, control=Control(kind=ControlKind.SHARE, low=0.0, neutral=0.0, high=back), share=None)
    arcs = [
        Arc(id="mined", donor="mine", recipient="first", rate=0.3),
        *(rejects, Arc(id="on", donor="first", recipient="second", law=Law.SHARE)),
        *(again, Arc(id="made", donor="second", recipient="use", law=Law.SHARE)),
    ]
    nodes = [Node(id="mine", initial=(9.0, 9.0), content={"copper": float(content)})]
    nodes += [Node(id="use", initial=(0.0, 0.0)), Node(id="waste", initial=(0.0, 0.0), role=Role.LANDFILL)]
    nodes += [Node(id=id_, stores=False) for id_ in ("first", "second")]
    copper_alone, episode = (Substance(id="copper"),), Episode(horizon=2)
    network = Network(name="two", nodes=tuple(nodes), arcs=tuple(arcs), substances=copper_alone, episode=episode)
    if kind == "uncertain":  # of what is drawn B may send all back
        network = replace(network, uncertain={"arcs.again.share": Spread(low=0.9, high=1.0, distribution="uniform")})
    returns = {"transfer": (back, back), "share": (0.0, back), "uncertain": (0.0, 1.0)}[kind]
    least = max(
        (passed := content * (1 - part) / (1 - (1 - part) * few))
        / (passed + (1 - content) * (1 - other) / (1 - (1 - other) * many))
        for few, many in ((returns, (0.0, 0.0)) if part < other else (returns,))
    )

    env = MultiAgentVectorEnv(network, num_envs=2, uncertain=kind == "uncertain")
    env.reset(seed=seed)
    env.advance(np.tile([-1.0, 1.0], (len(env.actuators.control_rows), 1)))
    made = network.arc_index["made"]
    reached = env.physical.substances[made] / env.physical.flow[made]
    assert (reached >= least * (1 - 1e-8)).all()
    if kind == "transfer":
        np.testing.assert_allclose(reached[1], least, rtol=1e-8)
    limit = Service(id="pure", provider="made", quantity="flow", substance="copper", low=0.0, high=1.001 * least)
    assert replace(network, services=(limit,))
    with pytest.raises(NetworkError, match="of what is in 'made' is copper, whatever is done"):
        replace(network, services=(replace(limit, high=0.999 * least),))


@pytest.mark.parametrize("count", [10, 100, pytest.param(1000, marks=pytest.mark.slow)])
@pytest.mark.parametrize("quantity", ["flow", "stock"])
def test_loops_of_any_size_have_limits(count: int, quantity: str) -> None:
    """Of copper P passes all sorters and of all else Q, b goes back: c·P·(1 − b)/(1 − P·b) is left, likewise of Q."""
    kept, other, back, content = 0.2, 0.9, 0.3, 0.05
    reject, share = 1.0 - kept ** (1 / count), 1.0 - other ** (1 / count)
    control = Control(kind=ControlKind.TRANSFER, low=0.0, neutral=0.5 * reject, high=reject, substances=("copper",))
    nodes = [Node(id="mine", initial=(9.0, 9.0), content={"copper": content})]
    nodes += [Node(id=id_, initial=(0.0, 0.0), role=Role.LANDFILL) for id_ in ("use", "waste")]
    nodes += [Node(id=f"sorter_{i}", stores=False) for i in range(count)]
    arcs = [Arc(id="mined", donor="mine", recipient="sorter_0", rate=0.3)]
    for i in range(count - 1):
        set_by: dict[str, Any] = {"control": control} if i % 2 else {"transfer": {"copper": reject}}
        ends: dict[str, Any] = {"donor": f"sorter_{i}", "law": Law.SHARE}
        arcs.append(Arc(id=f"rejects_{i}", recipient="waste", share=share, **ends, **set_by))
        arcs.append(Arc(id=f"on_{i}", recipient=f"sorter_{i + 1}", **ends))
    ends = {"donor": f"sorter_{count - 1}", "law": Law.SHARE}
    arcs.append(Arc(id="rejects", recipient="waste", share=share, transfer={"copper": reject}, **ends))
    again = {"copper": back * (1.0 - reject)}
    arcs.append(Arc(id="again", recipient="sorter_0", share=back * (1.0 - share), transfer=again, **ends))
    arcs.append(Arc(id="made", recipient="use", **ends))
    passed, rest = (c * p * (1 - back) / (1 - p * back) for c, p in ((content, kept), (1 - content, other)))
    least = passed / (passed + rest)
    provider = "made" if quantity == "flow" else "use"
    limit = Service(id="pure", provider=provider, quantity=quantity, substance="copper", high=least * (1 + 1e-6))
    parts: dict[str, Any] = {
        "nodes": tuple(nodes),
        "arcs": tuple(arcs),
        "substances": COPPER,
        "episode": Episode(horizon=1),
    }
    network = Network(name="ring", services=(limit,), **parts)
    with pytest.raises(NetworkError, match="is copper, whatever is done"):
        replace(network, services=(replace(limit, high=least * (1 - 1e-6)),))
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    assert env.advance(np.ones((len(env.actuators.control_rows), 1))).levels[0, 0] == pytest.approx(1.0, abs=1e-9)


def test_limits_and_contents_that_change_are_those_of_some_time() -> None:
    """A limit has to be within reach at each time, of the contents of all times."""
    falling = Series(times=(0.0, 3.0), values=(0.2, 0.1))
    lowest = 0.2 * 0.1 / (0.2 * 0.1 + 0.95 * 0.88 + 0.95 * 0.02)
    network = mine(copper=falling)
    assert with_limit(network, lowest * 1.0001)
    strict = Series(times=(0.0, 2.0), values=(0.1, lowest * 0.99))
    with pytest.raises(NetworkError, match=f"high {lowest * 0.99:g}: at least"):
        with_limit(network, strict)


@pytest.mark.parametrize("key", ["uncertain", "disturbed"])
def test_draws_that_could_keep_a_limit_are_enough(key: str) -> None:
    """Neither they nor others are refused then, nor what episodes draw."""
    network, path = mine(copper=0.1), "nodes.ore.content.copper"
    lowest = 0.02 / (0.02 + 0.95 * 0.88 + 0.95 * 0.02)
    with pytest.raises(NetworkError, match="whatever is done"):
        with_limit(network, 0.8 * lowest)
    effect = {key: {path: SPREAD if key == "uncertain" else DisturbanceEffect(by="noise")}}
    noise = {} if key == "uncertain" else {"disturbances": {"noise": NOISE}}
    unsure = with_limit(network, 0.8 * lowest, **effect, **noise)
    env = MultiAgentVectorEnv(unsure, num_envs=8, uncertain=key == "uncertain")
    env.reset(seed=0)
    assert [env.certain_network(copy).services for copy in range(8)] == [unsure.services] * 8
    with pytest.raises(NetworkError, match="whatever is done"):
        with_limit(network, 0.3 * lowest, **effect, **noise)


def test_transfers_and_limits_that_are_drawn_may_be_any_and_the_most_generous() -> None:
    """Nothing is refused of a split some share of which is drawn; of a limit its highest draw counts."""
    network, path = sorting_line(transfer=0.5), "arcs.rejects.transfer.copper"
    assert with_limit(network, 1e-5, uncertain={path: SPREAD})
    rich = replace(network.services[0], provider="rejects", low=0.5, high=1.0)
    assert replace(network, services=(rich,), uncertain={path: SPREAD}, is_variant=False)
    with pytest.raises(NetworkError, match=r"at most 0.09259 of what is in 'rejects'"):  # 0.01 of 0.01 + 0.098
        replace(network, services=(rich,), is_variant=False)
    substances = (*network.substances, Substance(id="tin"))
    nodes = (replace(network.nodes[0], content={"copper": 0.02, "tin": 0.98}), *network.nodes[1:])
    arcs = (*network.arcs[:2], replace(network.arcs[2], transfer={"copper": 0.5, "tin": 0.05}))
    with pytest.raises(NetworkError, match=r"at most 0.1695 of what is in 'rejects'"):  # 0.01 of 0.01 + 0.049
        replace(network, nodes=nodes, arcs=arcs, substances=substances, services=(rich,), is_variant=False)
    least = 0.01 / (0.01 + 0.9 * 0.98)
    spread = {"services.purity.high": SPREAD}
    assert with_limit(network, least / 1.19, uncertain=spread)
    with pytest.raises(NetworkError, match="whatever is done"):
        with_limit(network, least / 1.21, uncertain=spread)


def test_files_name_limits_out_of_reach(tmp_path: Path) -> None:
    """And the scenario in which they are."""
    path = tmp_path / "sorter.toml"
    poor = '\n[scenarios.poor.nodes.ore]\ncontent.copper = { value = 3, unit = "%", source = "s" }\n'
    path.write_text(definition_of(sorter(low=0.0, high=0.02)) + poor)
    with pytest.raises(DefinitionError) as error:
        load_network(path, scenario="poor")
    assert str(error.value).startswith(f"{path}: scenarios.poor.service 'clean': high 0.02: at least 0.03 of")


def test_what_is_derived_is_not_checked_again() -> None:
    """Other options, margins and starts of plans leave a limit where it is."""
    network = sorting_line(transfer=0.8)
    least = 0.004 / (0.004 + 0.9 * 0.98)
    network = with_limit(network, least)
    assert not network.is_variant and network.with_options(episode={"horizon": 2}).is_variant
    assert with_margin(network, 1.1).services[-1].high == pytest.approx(least / 1.1)
    run = simulate_plan(bound(with_margin(network, 1.1), degree=1))
    assert run.episode_levels[0, 0] == pytest.approx(1 / 1.1, rel=1e-9)
    controlled = with_limit(sorting_line(controlled=True), 0.01)
    assert not controlled.is_variant and with_bound(controlled, "rejects", 1, np.array([0.5])).is_variant
    assert variant_of(controlled, 1).is_variant
    late = with_limit(mine(copper=Series(times=(0.0, 3.0), values=(0.2, 0.1))), 0.03)
    assert network_of_intervals(late, np.array([0, 1])).services == late.services


def test_a_plan_from_an_empty_stock_is_simulated() -> None:
    """What would have diluted is not there, so that the limit is out of reach of that start alone."""
    network = sorter(low=0.0, high=0.01)
    ore, scrap, use, *rest = network.nodes
    nodes = (replace(ore, content={"copper": 0.03}), scrap, replace(use, initial=(0.0, 10.0), content={}), *rest)
    clean = Service(id="clean", provider="use", quantity="stock", substance="copper", low=0.0, high=0.01)
    network = replace(network, nodes=nodes, services=(clean,))
    run = simulate_plan(bound(network, initial={"ore": 500.0, "scrap": 100.0, "use": 0.0}, degree=1))
    assert 0 < run.episode_levels[0, 0] <= 1


@pytest.mark.parametrize("horizon", [pytest.param(None, marks=pytest.mark.slow), 1])
@pytest.mark.slow
def test_mpc_tells_what_is_out_of_reach(horizon: int | None) -> None:
    """Ore is too scarce to dilute so many products, which no single content tells."""
    network = sorter(low=0.0, high=0.01)
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=2.0)
    arcs = tuple(replace(arc, control=control) if arc.id == "mined" else arc for arc in network.arcs)
    network = replace(network, arcs=arcs).with_options(episode={"horizon": 2})
    with pytest.raises(CirlError, match=r"no actions reach a mean service level of 1 of 'products'"):
        bound(network, min_service=1.0)
    for demand, is_reached in ((1.0, False), (0.5, True)):
        controller, env = MPC(horizon=horizon, min_service=demand), MultiAgentVectorEnv(network, num_envs=1)
        episode_start(env).play(env, controller)
        assert ("no plan was found that keeps services; this one has" in controller.note) != is_reached
