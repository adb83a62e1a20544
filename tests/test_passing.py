"""Nodes that store nothing, and shares: throughputs, what shares may be, loops that keep mass, sources without end."""

from __future__ import annotations

import tracemalloc
from dataclasses import replace
from fractions import Fraction
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from small_networks import NO_STATES

from cirl_marl import (
    Arc,
    CirlError,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    Role,
    Series,
    Service,
    parallel_env,
)
from cirl_marl.controllers import Constant
from cirl_marl.controllers.lint import lint_warnings
from cirl_marl.controllers.rollout import rollout
from cirl_marl.dynamics.integrator import Dynamics
from cirl_marl.dynamics.visit_bounds import VisitBounds
from cirl_marl.network.split_fractions import splits

FEED = Arc(id="feed", donor="mine", recipient="m0", law=Law.EXOGENOUS, flow=7.0)
MINE, USE = Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR), Node(id="use", initial=(0.0, 0.0))


def share(donor: str, recipient: str, value: float | Series | Control | None = None, id_: str = "") -> Arc:
    """Return an arc with a given, a controlled or the remaining share."""
    control = value if isinstance(value, Control) else None
    given_ = None if isinstance(value, Control) else value
    name = id_ or f"{donor}_{recipient}"
    return Arc(id=name, donor=donor, recipient=recipient, law=Law.SHARE, share=given_, control=control)


def asking(low: float, neutral: float, high: float) -> Control:
    """Return a control of a share."""
    return Control(kind=ControlKind.SHARE, low=low, neutral=neutral, high=high)


def markets(count: int, arcs: list[Arc], **options: Any) -> Network:
    """Return ``count`` nodes without stock between a mine and use, fed at 7 a day."""
    passing = tuple(Node(id=f"m{i}", stores=False) for i in range(count))
    return Network(name="markets", nodes=(MINE, *passing, USE), arcs=(FEED, *arcs), **options)


def moved(network: Network, action: float | None = None) -> dict[str, float]:
    """Return the mean flows of the first interval, under neutral control or with all controls at one action."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    actions = env.neutral_action if action is None else {a: np.full((1, 1), action) for a in env.agents}
    outcome = env.advance(env.stack(actions) if env.agents else np.empty((0, 1)))
    return dict(zip(network.arc_index, outcome.flow[:, 0].tolist(), strict=True))


def random_markets(seed: int, count: int, leak: float) -> Network:
    """Return a network in which all nodes without stock pass to all, and each leaks about ``leak``."""
    rng = np.random.default_rng(seed)
    arcs = []
    for i in range(count):
        parts = rng.dirichlet(np.ones(count)) * (1.0 - leak)
        arcs += [share(f"m{i}", f"m{j}", float(parts[j])) for j in range(count) if j != i]
        arcs.append(share(f"m{i}", "use"))
    return markets(count, arcs)


@given(seed=st.integers(0, 2**31), count=st.integers(1, 6), exponent=st.integers(0, 8))
def test_throughputs_are_accurate_however_much_goes_round(seed: int, count: int, exponent: int) -> None:
    """Against elimination in fractions, of the very shares that the simulator has: a few roundings, no cancellation."""
    network = random_markets(seed, count, 10.0**-exponent)
    dynamics = Dynamics(network)
    rate = dynamics.rate(np.empty((0, 1)), np.array([0]))[:, 0]
    # a pivot is the sum of the other shares, as they sum to 1 but for rounding: (Σ_j P_ij) q_i − Σ_j P_ji q_j = b_i
    matrix = [[Fraction(0)] * (count + 1) for _ in range(count)]
    matrix[0][count] = Fraction(7)
    for k, arc in enumerate(network.arcs[1:], start=1):
        donor, part = int(arc.donor[1:]), Fraction(float(rate[k]))
        matrix[donor][donor] += part
        if arc.recipient != "use":
            matrix[int(arc.recipient[1:])][donor] -= part
    for i in range(count):
        for j in range(count):
            if j != i:
                factor = matrix[j][i] / matrix[i][i]
                matrix[j] = [a - factor * b for a, b in zip(matrix[j], matrix[i], strict=True)]
    exact = [float(matrix[i][count] / matrix[i][i]) for i in range(count)]
    flow = dynamics.advance(dynamics.extend(network.initial[1][:, None]), NO_STATES, np.empty((0, 1)), np.array([0]))
    np.testing.assert_allclose(network.throughput(flow.moved_mass)[:, 0], exact, rtol=1e-12)


@given(seed=st.integers(0, 2**31), count=st.integers(1, 40))
@settings(max_examples=10)
def test_what_enters_leaves(seed: int, count: int) -> None:
    """Sparse loops of many nodes: inflow is outflow at each, and all that was fed is in use."""
    rng = np.random.default_rng(seed)
    arcs = [share(f"m{i}", "use") for i in range(count)]
    for k in range(2 * count):
        i, j = rng.integers(count, size=2)
        if i != j:
            arcs.append(share(f"m{i}", f"m{j}", float(rng.uniform(0, 0.1)), f"pass_{k}"))
    network = markets(count, arcs)
    env = MultiAgentVectorEnv(network, num_envs=3)
    env.reset(seed=seed)
    outcome = env.advance(np.empty((0, 3)))
    entering = np.zeros((len(network.nodes), 3))
    np.add.at(entering, network.recipients, outcome.flow)
    np.testing.assert_allclose(
        entering[len(network.stores) :], network.throughput(outcome.flow), rtol=1e-13, atol=1e-15
    )
    np.testing.assert_allclose(env.physical.stock[network.node_index["use"]], 7.0, rtol=1e-13)


@given(data=st.data())
def test_shares_follow_the_rule(data: st.DataObject) -> None:
    """Within their bounds, summing to 1, as asked where that can be had, else cut by one factor; proportions hold."""
    number = st.just(0.0) | st.floats(1e-9, 1.0)  # a bound is 0 or at least 1e-50
    lows = [data.draw(number) / 4 for _ in range(data.draw(st.integers(1, 4)))]
    highs = [low + (1 - low) * data.draw(st.floats(0.01, 1.0)) for low in lows]
    given_ = [data.draw(st.floats(0.01, 1.0)) * (1 - sum(lows)) / 4 for _ in range(3)]
    controls = [asking(low, low, high) for low, high in zip(lows, highs, strict=True)]
    arcs = [share("m0", "use", each, f"c{k}") for k, each in enumerate(controls)]
    arcs += [share("m0", "use", each, f"g{k}") for k, each in enumerate(given_)]
    network = markets(1, [*arcs, share("m0", "use", id_="rest")])
    asked = np.array([low + (high - low) * data.draw(number) for low, high in zip(lows, highs, strict=True)])
    rate = dict(zip(network.arc_index, Dynamics(network).rate(asked[:, None])[:, 0], strict=True))
    got = np.array([rate[f"c{k}"] for k in range(len(lows))])
    excess = asked.sum() > 1
    factor = (1 - sum(lows)) / (asked - lows).sum() if excess else 1.0
    np.testing.assert_allclose(got, lows + (asked - lows) * factor, rtol=1e-12, atol=1e-15)
    assert (got >= np.array(lows) * (1 - 1e-12)).all()
    assert (got <= np.array(highs) * (1 + 1e-12)).all()
    others = np.array([rate["g0"], rate["g1"], rate["g2"], rate["rest"]])
    neutral = np.array([*given_, 1 - sum(lows) - sum(given_)])
    np.testing.assert_allclose(others, neutral / neutral.sum() * max(0.0, 1 - got.sum()), rtol=1e-12, atol=1e-15)
    assert got.sum() + others.sum() == pytest.approx(1.0, abs=1e-14)


@given(seed=st.integers(0, 2**31), count=st.integers(1, 4))
@settings(max_examples=15)
def test_passes_are_the_most_there_can_be(seed: int, count: int) -> None:
    """Against all ends of all splits, tried one by one: the greatest number of passes through any market."""
    rng = np.random.default_rng(seed)
    arcs = []
    for i in range(count):
        others = [j for j in range(count) if j != i]
        for j in others[:2]:
            low, neutral, high = np.sort(rng.uniform(0.0, 0.45, 3)).tolist()
            arcs.append(share(f"m{i}", f"m{j}", asking(low, neutral, high), f"c{i}_{j}"))
        arcs.append(share(f"m{i}", "use"))
    network = markets(count, arcs)
    most = np.zeros(count)
    for corner in product((0, 2), repeat=sum(arc.control is not None for arc in arcs)):
        ends, kept = iter(corner), np.zeros((count, count))
        for split in splits(network):
            for row, k in enumerate(split.controlled_arcs):
                kept[int(split.donor[1:]), int(network.arcs[k].recipient[1:])] = split.bounds[next(ends), row, 0]
        most = np.maximum(most, np.linalg.solve(np.eye(count) - kept, np.ones(count)))
    np.testing.assert_allclose(VisitBounds(network, splits(network)).total(0), most, rtol=1e-7)


def test_a_source_without_a_known_reserve_starts_with_what_may_be_asked() -> None:
    """With every control at its highest nothing is cut, and a trace is left; a longer episode starts with more."""
    valve = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=1.5)
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=1.0, high=Series(times=(0.0, 2.0), values=(2.0, 4.0)))
    arcs = (
        Arc(id="known", donor="mine", recipient="use", law=Law.EXOGENOUS, flow=Series(times=(0.0, 1.0), values=(3, 5))),
        Arc(id="asked", donor="mine", recipient="use", law=Law.CONTROLLED, control=order),
    )
    network = Network(name="endless", nodes=(replace(MINE, control=valve), USE), arcs=arcs, episode=Episode(horizon=4))
    asked = 1.5 * (3 + 5 + 5 + 5 + 2 + 2 + 4 + 4)
    np.testing.assert_allclose(network.initial[:, 0], asked, rtol=2e-6)
    run = rollout(MultiAgentVectorEnv(network, num_envs=1), Constant({"mine": 1.0, "asked": 1.0}))
    np.testing.assert_allclose(run.shortage, 0.0)
    np.testing.assert_allclose(run.stock[-1], [1e-6 * asked, asked], rtol=1e-3)
    longer = network.with_options(episode={"horizon": 6})
    assert longer.initial[1, 0] == pytest.approx(asked + 2 * 1.5 * (5 + 4), rel=2e-6)


def test_a_market_is_seen_scored_and_left_out_of_the_state() -> None:
    """Its throughput stands where a stock would; state and starts are of stocks alone."""
    service = Service(id="trade", provider="m0", quantity="outflow", low=14.0)
    network = markets(
        1,
        [share("m0", "use", asking(0.0, 0.5, 1.0)), share("m0", "mine")],
        services=(service,),
    )
    network = replace(network, nodes=(*network.stores, replace(network.nodes[2], set_point=5.0, scale=2.0)))
    env = parallel_env(network, observe="full")
    env.reset(seed=0)
    seen, _, _, _, infos = env.step({"m0_use": np.array([1.0])})
    assert seen["m0_use"][env.observation_names["m0_use"].index("throughput of m0")] == pytest.approx(3.5)
    assert infos["m0_use"]["service_level"] == pytest.approx(0.5)
    assert env.batch.local_rewards()["m0"][0] == pytest.approx(-(((7 - 5) / 2) ** 2) - 0.5)
    assert env.state_names == ("mine", "use")
    with pytest.raises(CirlError, match=r"unknown node or inner state 'm0'"):
        env.reset(options={"initial_state": {"m0": 3.0}})


def test_series_of_shares_demands_and_bounds() -> None:
    """Each interval has the mean of its own: shares given, the neutral and the highest share, the demand."""
    ramp = Series(times=(0.0, 4.0), values=(0.1, 0.5), interpolation="linear")
    steps = Series(times=(0.0, 2.0), values=(0.2, 0.6))
    control = Control(kind=ControlKind.SHARE, low=0.0, neutral=ramp, high=Series(times=(0.0,), values=(0.7,)))
    arcs = [share("m0", "use", control, "a"), share("m0", "use", steps, "b"), share("m0", "mine", None, "rest")]
    with pytest.raises(NetworkError, match=r"sum to 1\.05, more than 1, though one takes the rest"):
        markets(1, arcs, episode=Episode(horizon=4))
    arcs[1] = share("m0", "use", Series(times=(0.0, 2.0), values=(0.2, 0.4)), "b")
    service = Service(id="fed", provider="a", quantity="flow", low=Series(times=(0.0, 4.0), values=(1.0, 9.0)))
    network = markets(1, arcs, episode=Episode(horizon=4), services=(service,))
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    for step, neutral in enumerate((0.15, 0.25, 0.35, 0.45)):
        outcome = env.advance(env.stack(env.neutral_action))
        expected = 7 * np.array([neutral, (0.2, 0.4)[step > 1], 1 - neutral - (0.2, 0.4)[step > 1]])
        np.testing.assert_allclose(outcome.flow[1:, 0], expected, rtol=1e-12)
        assert outcome.service_level[0] == pytest.approx(min(1.0, 7 * neutral))


def test_what_never_changes_takes_one_column() -> None:
    """A million intervals, an agent that acts and one that does not: no table of numbers that are all the same."""
    arcs = [share("m0", "use", asking(0.0, 0.5, 1.0)), share("m0", "mine", 0.2)]
    arcs += [share("m0", "m1", asking(0.0, 0.1, 0.3)), share("m0", "m2"), share("m1", "use"), share("m2", "use")]
    network = markets(3, arcs, episode=Episode(horizon=1_000_000))
    tracemalloc.start()
    try:
        env = MultiAgentVectorEnv(network, num_envs=2, agents=["m0_m1"])
        env.reset(seed=0)
        tracemalloc.reset_peak()
        env.advance(env.stack(env.neutral_action))
        env.local_rewards()
        held, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert held < peak < 2_000_000  # a column of a million numbers takes 8 MB


LOOP = [share("m0", "m1", asking(0.0, 0.5, 1.0)), share("m0", "use"), share("m1", "m0")]


@pytest.mark.parametrize(
    ("count", "arcs", "said"),
    [
        (2, LOOP, "nodes m0, m1 store nothing and can pass all they get round in a loop: the arcs that leave it need"),
        (1, [share("m0", "use", asking(0.6, 0.6, 0.7), "a"), share("m0", "use", asking(0.5, 0.5, 0.6), "b"),
             share("m0", "use")], r"node 'm0': the lowest shares of its arcs sum to 1.1, more than 1"),
        (1, [share("m0", "use", asking(0.2, 0.6, 0.7))], "controls or orders set all that leaves it; an arc"),
        (1, [share("m0", "use", 0.4, "a"), share("m0", "use", 0.5, "b")], "sum to 0.9, not to 1; one may be left out"),
        (1, [share("m0", "use", None, "a"), share("m0", "use", None, "b")], "2 arcs of law 'share' state no share"),
        (1, [share("m0", "use", 1.4)], r"arc 'm0_use': share 1.4 must lie in \[0, 1\]"),
        (1, [], "node 'm0': it stores nothing and no arc leaves it, so that what enters has nowhere to go"),
        (1, [Arc(id="out", donor="m0", recipient="use", rate=0.1)], "arc 'out': law 'donor': its donor 'm0' stores"),
        (1, [share("m0", "use"), Arc(id="ship", donor="use", recipient="m0", law=Law.BATCH, delay=1.0)],
         "arc 'ship': law 'batch' needs a stock at both ends; 'm0' stores nothing"),
        (1, [share("m0", "use"), Arc(id="pull", donor="use", recipient="m0", law=Law.RECIPIENT, rate=0.1)],
         "arc 'pull': law 'recipient' needs a stock at both ends; 'm0' stores nothing"),
        (1, [replace(share("m0", "use"), control=Control(kind=ControlKind.RATE, low=0, neutral=1, high=2))],
         "arc 'm0_use': law 'share' needs control.kind 'share', not 'rate'; a valve on 'm0' acts on all that it"),
        (1, [share("m0", "use"), replace(FEED, id="more", control=asking(0, 0, 1))],
         "arc 'more': control.kind 'share' needs law 'share', not 'exogenous'"),
        (1, [share("m0", "use"), replace(share("m0", "mine", asking(0, 0, 1)), share=0.3)],
         "arc 'm0_mine': share: its control sets it; leave it out"),
        (1, [share("m0", "use"), share("m0", "mine", asking(-0.5, 0, 1.5))], r"lie in \[0, 1\], got \[-0.5, 1.5\]"),
        (1, [share("m0", "use"), share("use", "mine")],
         "node 'use': rate = 0.0: arc 'use_mine' shares what it releases; give the node a rate, 1/time, a life"),
    ],
)  # fmt: skip
def test_what_cannot_pass_is_refused(count: int, arcs: list[Arc], said: str) -> None:
    """Each with the node or arc, the value, and what to do."""
    with pytest.raises(NetworkError, match=said):
        markets(count, arcs)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"initial": (1.0, 1.0)}, "initial: it stores nothing, so that it has none"),
        ({"rate": 0.5}, "rate: it stores nothing, so that it has none"),
        ({"control": Control(kind=ControlKind.RATE, low=0, neutral=1, high=2)}, "control: it stores nothing, so that"),
        ({"role": Role.LANDFILL}, "role 'landfill': a node that stores nothing is of the technosphere"),
    ],
)
def test_what_a_node_without_stock_cannot_have(changes: dict[str, Any], said: str) -> None:
    """A start, a release, a valve, and a role whose stocks count."""
    network = markets(1, [share("m0", "use")])
    with pytest.raises(NetworkError, match=f"node 'm0': {said}"):
        replace(network, nodes=tuple(replace(n, **changes) if n.id == "m0" else n for n in network.nodes))


def test_a_loop_that_keeps_mass_in_one_interval_only() -> None:
    """The message says which: where the share that leaves the loop is 0."""
    leaving = Series(times=(0.0, 2.0, 3.0), values=(0.1, 0.0, 0.1))
    arcs = [share("m0", "use", leaving), share("m0", "m1"), share("m1", "m0")]
    with pytest.raises(NetworkError, match=r"round in a loop in interval 2: "):
        markets(2, arcs, episode=Episode(horizon=4))
    assert moved(markets(2, [share("m0", "use", 0.1), *arcs[1:]]))["m0_m1"] == pytest.approx(63.0)


def test_a_market_that_gets_nothing_is_remarked_on() -> None:
    """It passes nothing, which is seldom meant; one that is fed is silent."""
    network = markets(2, [share("m0", "use"), share("m1", "use")])
    said = "node 'm1': it stores nothing and nothing enters it, so that nothing ever leaves it"
    assert [remark for remark in lint_warnings(network) if "stores nothing" in remark] == [said]


@pytest.mark.parametrize("highs", [(0.7, 0.1, 0.2), (0.7, 0.2, 0.1), (0.7, 0.2, 0.1 - 1e-16), (0.7, 0.2, 0.1 - 1e-10)])
def test_a_leak_that_is_a_rounding_is_none(highs: tuple[float, ...]) -> None:
    """Whatever the order in which shares are summed: nothing leaves the loop when they are at their highest."""
    arcs = [share("m0", "m1", asking(0.0, 0.0, high), f"c{k}") for k, high in enumerate(highs)]
    with pytest.raises(NetworkError, match="can pass all they get round in a loop"):
        markets(2, [*arcs, share("m0", "use"), share("m1", "m0")])


def test_loops_in_loops_have_a_bound_or_a_message() -> None:
    """A way out of 1e-6 taken again and again is bounded rigorously; what no number can hold is said."""

    def nested(depth: int) -> Network:
        arcs = [share(f"m{i}", f"m{i + 1}" if i + 1 < depth else "use", 1e-6, f"out{i}") for i in range(depth)]
        back = [share(f"m{i}", f"m{max(i - 1, 0)}" if i else f"m{depth}", None, f"back{i}") for i in range(depth)]
        return markets(depth + 1, [*arcs, *back, share(f"m{depth}", "m0")])

    network = nested(1)
    total = VisitBounds(network, splits(network)).total(0)
    assert (total >= 1.0 + VisitBounds(network, splits(network)).best(total[:, None], 0)[:, 0]).all()
    np.testing.assert_allclose(total[0], 2e6, rtol=1e-3)
    with pytest.raises(NetworkError, match="pass mass round so often that it cannot be told"):
        VisitBounds(nested(5), splits(nested(5))).total(0)


def test_a_control_that_sets_a_flow_is_no_valve_on_the_others() -> None:
    """The reserve of a source is what its own control and its exogenous outflows ask for together."""
    order = Control(kind=ControlKind.FLOW, low=0.0, neutral=0.25, high=0.5)
    arcs = (
        Arc(id="asked", donor="mine", recipient="use", law=Law.CONTROLLED),
        Arc(id="known", donor="mine", recipient="use", law=Law.EXOGENOUS, flow=10.0),
    )
    network = Network(name="two", nodes=(replace(MINE, control=order), USE), arcs=arcs, episode=Episode(horizon=10))
    assert network.initial[1, 0] == pytest.approx(105.0, rel=2e-6)


def test_a_stock_of_a_market_is_no_service() -> None:
    """The message says what to ask for instead."""
    with pytest.raises(NetworkError, match="provider: 'm0' stores nothing; ask for its outflow"):
        markets(1, [share("m0", "use")], services=(Service(id="s", provider="m0", quantity="stock", low=1.0),))
