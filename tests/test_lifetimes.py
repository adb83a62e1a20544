"""Lifetimes: discards against an independent cohort model, delays, starts, stretches, and what is refused."""

from __future__ import annotations

import csv
import logging
from dataclasses import replace
from pathlib import Path
from typing import Any

import flodym
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import optimize, special

from cirl_marl import (
    Arc,
    Control,
    ControlError,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    NetworkError,
    Node,
    Role,
    Series,
    load_network,
)
from cirl_marl.controllers import Constant, Neutral
from cirl_marl.controllers.lint import lint_warnings
from cirl_marl.controllers.pyramids import pyramids
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.reader import write_network
from cirl_marl.dynamics.stages import staged_network
from cirl_marl.evaluation.simulations import simulate
from cirl_marl.network import Network
from cirl_marl.network.elements import Lifetime
from cirl_marl.network.initial_ages import age_shares, remaining_history
from cirl_marl.network.lifetimes import chain_of
from cirl_marl.report.terminal import law_text, nodes_table
from cirl_marl.report.trajectory import write_trajectory

Floats = NDArray[np.floating]
YEARS, MEAN = 100, 25.0
INFLOW = 10 * 1.03 ** np.arange(YEARS)
INFLOW[40] *= 0.8
NO_ACTION = np.zeros((0, 1))


def town(
    lifetime: Lifetime, inflow: Floats = INFLOW, *, initial: float | None = 0.0, interval: float = 1.0, **node: Any
) -> Network:
    """Return a network in which products are bought, used and thrown away."""
    times = tuple((interval * np.arange(len(inflow))).tolist())
    stock = None if initial is None else (initial, initial)
    return Network(
        name="town",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR),
            Node(id="use", lifetime=lifetime, initial=stock, **node),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(
                id="buy",
                donor="mine",
                recipient="use",
                law=Law.EXOGENOUS,
                flow=Series(times=times, values=tuple(inflow.tolist())),
            ),
            Arc(id="discard", donor="use", recipient="dump", law=Law.SHARE),
        ),
        episode=Episode(control_interval=interval, horizon=len(inflow)),
        mass_unit="kt",
        time_unit="year",
    )


def lived(network: Network, action: float | None = None) -> tuple[Floats, Floats]:
    """Return the discards in each interval and the stock in use at its end."""
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    discards, stocks = [], []
    for _ in range(network.episode.horizon):
        outcome = env.advance(NO_ACTION if action is None else np.full((1, 1), action))
        discards.append(outcome.flow[network.arc_index["discard"], 0])
        stocks.append(env.rows.stocks(env.physical.stock)[network.node_index["use"], 0])
    return np.array(discards), np.array(stocks)


def cohorts(distribution: str, deviation: float) -> tuple[Floats, Floats]:
    """Return discards and stocks by flodym, which follows every year's products by their survival function."""
    logging.getLogger().setLevel(logging.ERROR)
    time = flodym.Dimension(name="time", letter="t", items=list(range(YEARS)), dtype=int)
    dims = flodym.DimensionSet(dim_list=[time])
    if distribution == "weibull":
        ratio = (deviation / MEAN) ** 2

        def excess(shape: float) -> float:
            return float(np.expm1(special.gammaln(1 + 2 / shape) - 2 * special.gammaln(1 + 1 / shape)) - ratio)

        shape = optimize.brentq(excess, 0.1, 100)
        scale = MEAN / special.gamma(1 + 1 / shape)
        model: Any = flodym.WeibullLifetime(dims=dims, weibull_shape=shape, weibull_scale=scale, n_pts_per_interval=10)
    else:
        kinds = {"normal": "NormalLifetime", "folded_normal": "FoldedNormalLifetime", "lognormal": "LogNormalLifetime"}
        model = getattr(flodym, kinds[distribution])(dims=dims, mean=MEAN, std=deviation, n_pts_per_interval=10)
    found: Any = flodym.InflowDrivenDSM(dims=dims, lifetime_model=model, time_letter="t")
    found.inflow.values[...] = INFLOW
    found.compute()
    return found.outflow.values, found.stock.values


@pytest.mark.sample(3)
@pytest.mark.parametrize("ratio", [0.1, 0.2, 0.3, 0.45, 0.7])
@pytest.mark.parametrize("distribution", ["normal", "folded_normal", "lognormal", "weibull"])
def test_discards_are_those_of_cohorts(distribution: str, ratio: float) -> None:
    """Inflow grows by 3 % a year with one dip of 20 %, over 100 years: within 0.2 % of the peak, of narrow ones 1 %."""
    lifetime = Lifetime(mean=MEAN, deviation=ratio * MEAN, distribution=distribution)
    discards, stock = lived(town(lifetime))
    expected, in_use = cohorts(distribution, ratio * MEAN)
    close = 2e-3 if ratio > 0.1 else 1e-2
    np.testing.assert_allclose(discards, expected, rtol=0, atol=close * expected.max())
    np.testing.assert_allclose(stock, in_use, rtol=0, atol=close * in_use.max())


@pytest.mark.parametrize(
    ("distribution", "deviation"), [("normal", 0.3), ("weibull", 0.5), ("gamma", 0.6), ("exponential", 1.0)]
)
def test_what_is_left_of_a_pulse_is_its_survival(distribution: str, deviation: float) -> None:
    """Also of lifetimes shorter than the interval, for which the solver takes shorter steps."""
    for mean in (0.4, 6.0):
        lifetime = Lifetime(mean=mean, deviation=deviation * mean, distribution=distribution)
        assert lifetime.chain is not None
        fast = town(lifetime, np.append(1e9, np.zeros(9)), interval=0.02 * mean)
        # what enters in a short interval has on average the age of its middle
        ages = 0.02 * (np.arange(10) + 0.5)
        np.testing.assert_allclose(
            lived(fast)[1] / (0.02 * mean * 1e9), lifetime.chain.survival(ages), rtol=0, atol=2e-4
        )


def test_exponential_lifetime_is_a_rate() -> None:
    """A single stage: to the last digits what a node with a rate does."""
    one = town(Lifetime(mean=8.0, distribution="exponential"), initial=50.0)
    plain = replace(one, nodes=tuple(replace(n, lifetime=None, rate=1 / 8) if n.lifetime else n for n in one.nodes))
    for mine, other in zip(lived(one), lived(plain), strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-13)


@pytest.mark.parametrize("delay", [1, 3, 12])
def test_fixed_lifetime_is_a_delay(delay: int) -> None:
    """What enters in an interval leaves evenly in the one that is as many intervals later; half-years count, too."""
    discards, stock = lived(town(Lifetime(mean=delay * 0.5, distribution="fixed"), INFLOW[:30], interval=0.5))
    expected = np.concatenate([np.zeros(delay), INFLOW[: 30 - delay]])
    np.testing.assert_allclose(discards, expected, rtol=1e-10, atol=1e-10)
    np.testing.assert_allclose(stock, 0.5 * np.cumsum(INFLOW[:30] - expected), rtol=1e-10)


def test_slots_lose_nothing() -> None:
    """Not even what rounding keeps from coming out in its interval, which comes with what is next."""
    network = town(Lifetime(mean=1.0, distribution="fixed"), np.full(300, 7.3))
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    before = env.physical.stock[:-1].sum()
    for _ in range(300):
        env.advance(NO_ACTION)
    assert env.physical.stock[:-1].sum() == pytest.approx(before, rel=3e-14)


LIVES = [
    Lifetime(mean=9.0, deviation=3.0, distribution="weibull"),
    Lifetime(mean=7.0, distribution="fixed"),
    Lifetime(mean=5.0, deviation=3.0, distribution="normal"),
]


@pytest.mark.parametrize("lifetime", LIVES)
def test_history_is_what_was_simulated_before(lifetime: Lifetime) -> None:
    """An episode that begins where another one ended, told only what had entered until then, goes on as it did."""
    whole, stocks = lived(town(lifetime, INFLOW[:60]))
    history = Series(times=tuple(range(-30, 0)), values=tuple(INFLOW[:30]))
    late = town(lifetime, INFLOW[30:60], initial=None, history=history)
    assert late.initial[0, late.node_index["use"]] == pytest.approx(stocks[29], rel=1e-9)
    discards, after = lived(late)
    np.testing.assert_allclose(discards, whole[30:], rtol=1e-8)
    np.testing.assert_allclose(after, stocks[30:], rtol=1e-8)


@pytest.mark.parametrize("deviation", [0.11, 0.12, 0.16, 0.17, 0.18, 0.19, 0.2, 0.21])
@pytest.mark.sample(3)
def test_no_stage_of_what_has_shrunk_is_negative(deviation: float) -> None:
    """A shrinking inflow makes the solver change rows: round-off, of either sign, of stages that nothing enters."""
    chain = Lifetime(mean=1.0, deviation=deviation, distribution="normal").chain
    assert chain is not None
    for growth in (-0.05, -0.1, -0.3):
        stages = chain.growing_stock(growth)
        assert 0.0 <= stages.min() < stages.max()


@pytest.mark.parametrize("lifetime", LIVES)
@pytest.mark.parametrize("growth", [0.05, 0.0, -0.02])
def test_what_has_grown_goes_on_growing(lifetime: Lifetime, growth: float) -> None:
    """Stock, discards and inflow keep their proportions; a history with growth is as long as one that goes far back."""
    grown = np.exp(growth * (np.arange(600) - 560))
    history = Series(times=tuple(range(-560, 0)), values=tuple(grown[:560]))
    short = Series(times=tuple(range(-4, 0)), values=tuple(grown[556:560]))
    for initial, kept in (
        (None, {"history": history}),
        (None, {"history": short, "growth": growth}),
        (80.0, {"growth": growth}),
    ):
        discards, stock = lived(town(lifetime, grown[560:], initial=initial, **kept))
        # the inflow of a year is the same all year, that of the start's growth is not
        if initial is None:
            np.testing.assert_allclose(stock / grown[560:], stock[0] / grown[560], rtol=3e-3)
            np.testing.assert_allclose(discards / grown[560:], discards[0] / grown[560], rtol=3e-3)
        else:
            env = MultiAgentVectorEnv(town(lifetime, grown[560:], initial=80.0, **kept), num_envs=1)
            env.reset(seed=0)
            parts = env.physical.stock[env.rows.stages[1], 0]
            long = remaining_history(town(lifetime, grown[560:], history=history).nodes[1], 1.0)
            np.testing.assert_allclose(parts / parts.sum(), long / long.sum(), atol=2e-3)


@pytest.mark.parametrize("stretch", [1.4, 0.7])
@pytest.mark.parametrize("growth", [None, 0.03])
def test_a_stretch_of_history_and_episode_is_a_longer_lifetime(stretch: float, growth: float | None) -> None:
    """Of stocks, discards, ages and pyramids; a stretch from the start on leaves the ages that there are."""
    past = Series(times=tuple(range(-30, 0)), values=tuple(np.linspace(1.0, 4.0, 30).tolist()))
    kept: dict[str, Any] = {"history": past, "growth": growth}
    plain = Lifetime(mean=9.0, deviation=3.0)
    longer = Lifetime(mean=9.0 * stretch, deviation=3.0 * stretch)
    inflow = INFLOW[:20]
    stretched = town(plain, inflow, initial=None, stretch=stretch, history_stretch=stretch, **kept)
    native = town(longer, inflow, initial=None, **kept)
    for ours, theirs in zip(lived(stretched), lived(native), strict=True):
        np.testing.assert_allclose(ours, theirs, rtol=1e-9)
    (ours_,), (theirs_,) = (pyramids(each.network, each.rollout) for each in map(simulate, (stretched, native)))
    np.testing.assert_allclose(ours_.mean_age, theirs_.mean_age, rtol=1e-4)
    use, other = (network.nodes[network.node_index["use"]] for network in (stretched, native))
    grown, longer_grown = (age_shares(replace(node, history=None, growth=0.05), 1.0) for node in (use, other))
    np.testing.assert_allclose(grown, longer_grown, rtol=1e-9)
    later = town(plain, inflow, initial=None, stretch=stretch, **kept)
    np.testing.assert_array_equal(later.initial, town(plain, inflow, initial=None, **kept).initial)


def test_stretch_is_a_slower_clock() -> None:
    """Of what nothing is added to, as much is left after θ·t as without a stretch after t; by series and by control."""
    lifetime, none = Lifetime(mean=9.0, deviation=3.0, distribution="lognormal"), np.zeros(24)
    plain = lived(town(lifetime, none, initial=40.0))[1]
    stretched = town(lifetime, none, initial=40.0, stretch=2.0)
    np.testing.assert_allclose(lived(stretched)[1][1::2], plain[:12], rtol=1e-9)
    series = Series(times=(0.0, 4.0), values=(1.0, 2.0))
    late = lived(town(lifetime, none, initial=40.0, stretch=series))[1]
    np.testing.assert_allclose(late[:4], plain[:4], rtol=1e-9)
    np.testing.assert_allclose(late[5::2], plain[4:14], rtol=1e-9)
    control = Control(kind=ControlKind.STRETCH, low=0.5, neutral=1.0, high=2.0)
    acting = town(lifetime, none, initial=40.0, control=control)
    np.testing.assert_allclose(lived(acting, 1.0)[1][1::2], plain[:12], rtol=1e-9)
    np.testing.assert_allclose(lived(acting, -1.0)[1][:11], plain[1:23:2], rtol=1e-9)
    np.testing.assert_allclose(lived(acting, -1 / 3)[1], plain, rtol=1e-9)


def test_stages_belong_to_their_node() -> None:
    """Agents see the whole stock; a start is given for the node, or stage by stage, and a snapshot holds stages."""
    control = Control(kind=ControlKind.STRETCH, low=1.0, neutral=1.0, high=2.0)
    network = town(LIVES[0], initial=40.0, control=control, set_point=30.0)
    env = MultiAgentVectorEnv(network, num_envs=2, observe="local")
    seen = env.reset(seed=0)
    assert seen["use"][0, env.observation_names["use"].index("stock of use")] == pytest.approx(40.0)
    assert env.observation_spaces["use"].contains(seen["use"][0])
    stages = [name for name in env.state_names if name.startswith("use.")]
    assert (
        stages == [f"use.stage_{i}" for i in (*range(1, len(stages)),)] + [f"use.stage_{len(stages)}"]
        or len(stages) > 1
    )
    state = dict(zip(env.state_names, env.state()[0], strict=False))
    assert sum(state[name] for name in stages) == pytest.approx(40.0)
    env.reset(seed=0, options={"initial_state": {"use": 20.0}})
    half = dict(zip(env.state_names, env.state()[0], strict=False))
    assert {name: half[name] / state[name] for name in stages} == pytest.approx(dict.fromkeys(stages, 0.5))
    env.reset(seed=0, options={"initial_state": {**dict.fromkeys(stages, 0.0), stages[1]: 7.0}})
    env.advance(np.zeros((1, 2)))
    kept = env.snapshot()
    first = [env.advance(np.zeros((1, 2))).flow for _ in range(3)]
    env.restore(kept)
    np.testing.assert_array_equal([env.advance(np.zeros((1, 2))).flow for _ in range(3)], first)
    env.reset(seed=0, options={"initial_state": {stages[1]: 7.0}})  # the other stages are empty then
    assert env.rows.stocks(env.physical.stock)[1, 0] == pytest.approx(7.0)
    for start, said in (
        ({"use": 1e9}, "covers"),
        ({stages[0]: 1e9}, "covers"),
        ({"use": 1.0, stages[2]: 1.0}, "give the stock, or its stages, not both"),
        ({"use.stage_99": 1.0}, "unknown node or inner state 'use.stage_99'"),
    ):
        with pytest.raises(ControlError, match=said):
            env.reset(options={"initial_state": start})


def test_files_hold_lifetimes(tmp_path: Path) -> None:
    """What is written reads back as the same network, with the same bits."""
    history = Series(times=(-8.0, -3.0), values=(4.0, 6.0))
    for lifetime in LIVES:
        network = town(lifetime, INFLOW[:5], initial=None, history=history, growth=0.01)
        write_network(network, tmp_path / "town.toml")
        again = load_network(str(tmp_path / "town.toml"))
        assert again.nodes == network.nodes
        np.testing.assert_array_equal(lived(again), lived(network))


@pytest.mark.sample(3)
@pytest.mark.parametrize("distribution", ["normal", "weibull", "lognormal"])
@pytest.mark.parametrize("deviation", [0.03, 0.1, 0.4])
def test_the_error_of_a_chain_is_what_it_says(distribution: str, deviation: float) -> None:
    """Compared at ages between those that it was fitted at."""
    from cirl_marl.network.lifetimes import SURVIVALS

    chain, ages = chain_of(distribution, deviation), np.linspace(0.0, 3.0, 1234)
    far = np.abs(chain.survival(ages) - SURVIVALS[distribution](deviation)(ages)).max()
    assert far <= 1.05 * chain.error + 1e-4
    assert chain.error < (0.3 if deviation < 0.1 else 0.05)
    assert sum(chain.weights) == pytest.approx(1.0) and min(chain.weights) >= 0


BUY, DISCARD = town(LIVES[0]).arcs


@pytest.mark.parametrize("stretch", [1.0, Series(times=(0.0, 5.0), values=(1.0, 1.5))])
@pytest.mark.parametrize("lifetime", LIVES)
def test_ages_are_those_of_cohorts(lifetime: Lifetime, stretch: float | Series) -> None:
    """Together they are the stock; what enters is young, what is not replaced grows a year older each year."""
    changing: dict[str, Any] = {} if lifetime.distribution == "fixed" else {"stretch": stretch}
    history = Series(times=tuple(range(-40, 0)), values=tuple(INFLOW[:40]))
    network = town(lifetime, np.append(INFLOW[40:60], np.zeros(4)), initial=None, history=history, **changing)
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=0)
    start = env.rows.stocks(env.physical.stock)[:, 0].copy()
    run = rollout(env, Neutral())
    (found,) = pyramids(network, run)
    place = network.node_index["use"]
    whole = np.append(start[place], run.stock[:, place])
    np.testing.assert_allclose(found.mass.sum(axis=1), whole, rtol=2e-4)
    np.testing.assert_allclose(found.mass[1:21, 0], INFLOW[40:60], rtol=0.1)  # few live for less than a year
    assert (found.mass[22:, :2] < 1e-9).all()
    aged = found.mass[21, :-1] - found.mass[22, 1:]
    assert (aged[:-1] >= -1e-12).all()
    assert found.mean_age[23] > found.mean_age[20]
    if lifetime.distribution == "fixed":
        np.testing.assert_allclose(found.mass[20], INFLOW[59:52:-1])


@given(network=st.from_type(Network))
def test_stages_count_as_their_node(network: Network) -> None:
    """In λ, whatever its role: what moves within a node counts nothing, what enters and leaves it as it did."""
    written, arcs = staged_network(network), len(network.arcs)
    np.testing.assert_array_equal(written.sustainability[:arcs], network.sustainability)
    np.testing.assert_array_equal(written.environmental[:arcs], network.environmental)
    assert not written.sustainability[arcs:].any() and not written.environmental[arcs:].any()


def test_shorter_lives_are_within_what_is_observed() -> None:
    """Flows that a stretch below 1 makes larger lie in the space, and are solved with as many steps as they need."""
    control = Control(kind=ControlKind.STRETCH, low=0.05, neutral=1.0, high=2.0)
    network = town(LIVES[0], np.full(6, 5.0), initial=45.0, control=control)
    env = MultiAgentVectorEnv(network, num_envs=1, observe="full")
    seen = env.reset(seed=0)
    for _ in range(5):
        assert env.observation_spaces["use"].contains(seen["use"][0])
        seen = env.step({"use": np.array([[-1.0]])})[0]
    short = replace(network.nodes[1], control=None, lifetime=replace(LIVES[0], mean=0.45, deviation=0.15))
    other = replace(network, nodes=(network.nodes[0], short, network.nodes[2]))
    assert env.dynamics.substeps == MultiAgentVectorEnv(other, num_envs=1).dynamics.substeps


def test_a_stretch_that_agents_set_makes_stocks_older() -> None:
    """The pyramid follows what they did."""
    control = Control(kind=ControlKind.STRETCH, low=0.5, neutral=1.0, high=2.0)
    network = town(LIVES[0], np.full(30, 5.0), initial=45.0, control=control)
    env, means = MultiAgentVectorEnv(network, num_envs=1), []
    for action in (-1.0, -1 / 3, 1.0):
        run = rollout(env, Constant({"use": action}))
        (found,) = pyramids(network, run)
        np.testing.assert_allclose(found.mass.sum(axis=1)[1:], run.stock[:, 1], rtol=5e-5)
        means.append(found.mean_age[-1])
    np.testing.assert_allclose(np.array(means) / means[1], [0.5, 1.0, 2.0], rtol=0.02)


def test_an_episode_is_written_with_its_ages(tmp_path: Path) -> None:
    """Mean ages in the table, masses by age in a second one, and a picture."""
    env = MultiAgentVectorEnv(town(LIVES[0], INFLOW[:5], initial=30.0), num_envs=1)
    files = write_trajectory(tmp_path, "town", simulate(env.network), "a town")
    assert [path.name for path in files] == ["town.csv", "town.png", "town_ages.csv", "town_ages.png"]
    with files[0].open(newline="") as file:
        rows = list(csv.DictReader(file))
    with files[2].open(newline="") as file:
        masses = list(csv.DictReader(file))
    for row in rows:
        now = [each for each in masses if each["time (year)"] == row["time (year)"]]
        total = sum(float(each["stock (kt)"]) for each in now)
        assert total == pytest.approx(float(row["stock of use (kt)"]), rel=1e-3)
        middles = [(float(each["from the age of (year)"]) + float(each["to the age of (year)"])) / 2 for each in now]
        weighted = sum(age * float(each["stock (kt)"]) for age, each in zip(middles, now, strict=True))
        assert weighted / total == pytest.approx(float(row["mean age of use (year)"]), rel=1e-9)


def test_the_oldest_stay_in_their_class() -> None:
    """Of what nothing is added to, all that is left is old, and none of it is lost from the pyramid."""
    network = town(LIVES[0], np.zeros(16), initial=40.0)
    env = MultiAgentVectorEnv(network, num_envs=1)
    run = rollout(env, Neutral())
    (found,) = pyramids(network, run)
    np.testing.assert_allclose(found.mass.sum(axis=1)[1:], run.stock[:, 1], rtol=1e-2)
    assert run.stock[-1, 1] < 0.1 and found.mean_age[-1] > 15


def test_lifetimes_are_shown() -> None:
    """In the law of what leaves, and as the stock at the start that a history leaves."""
    network = town(LIVES[0], INFLOW[:3], initial=None, history=Series(times=(-9.0,), values=(2.0,)))
    assert law_text(network, network.arcs[1]) == "rest of what a weibull lifetime of 9 ± 3 in use lets go"
    table = nodes_table(network, network.initial[0])
    assert list(table.columns[2].cells)[1] == "left of its history"
    assert law_text(town(LIVES[1]), network.arcs[1]) == "rest of what a fixed lifetime of 7 in use lets go"


def test_narrow_lifetimes_are_remarked_on() -> None:
    """With the error of their chain; others are not."""
    narrow = Lifetime(mean=20.0, deviation=1.0, distribution="normal")
    (said,) = [each for each in lint_warnings(town(narrow, initial=1.0)) if "lifetime" in each]
    assert narrow.chain is not None and f"within {narrow.chain.error:.1%}" in said and "20 ± 1 year" in said
    assert not [each for each in lint_warnings(town(LIVES[0], initial=1.0)) if "lifetime" in each]


ENDED, LATE = Series(times=(-5.0,), values=(1.0,), until=-2.0), Series(times=(1.0,), values=(1.0,))
OTHER = Arc(id="other", donor="use", recipient="dump", rate=0.1)


@pytest.mark.parametrize(
    ("use", "arcs", "said"),
    [
        ({"deviation": 0.0}, (), r"lifetime.deviation 0.0 must be positive"),
        ({"mean": -1.0}, (), r"lifetime.mean -1.0 must be positive"),
        ({"deviation": None}, (), r"lifetime.deviation: missing; a weibull lifetime needs one"),
        ({"deviation": 0.01}, (), r"deviation 0.01 is 0.00111 of the mean; .*take distribution = 'fixed'"),
        ({"deviation": 90.0}, (), r"is 10 of the mean; .*is it in the unit of the mean"),
        ({"distribution": "fixed", "deviation": None, "mean": 1.5}, (), r"whole number, .* of control intervals of 1"),
        ({"distribution": "fixed"}, (), r"lifetime.deviation 3: a fixed lifetime has none"),
        ({"distribution": "exponential"}, (), r"deviation 3: that of an exponential lifetime is its mean"),
        ({"node": {"stores": False, "initial": None}}, (), r"node 'use': lifetime: it stores nothing"),
        ({"node": {"rate": 0.1}}, (), r"so that there is no rate"),
        ({"node": {"control": Control(kind=ControlKind.RATE, low=0, neutral=1, high=1)}}, (), r"controlled by kind"),
        ({"node": {"control": Control(kind=ControlKind.STRETCH, low=0, neutral=1, high=2)}}, (), r"stretch is above"),
        ({"node": {"control": Control(kind=ControlKind.STRETCH, low=1e-320, neutral=1, high=2)}}, (), r"must be 0, or"),
        ({"node": {"history": ENDED}}, (), r"series ends at -2, bef"),
        ({"node": {"history": LATE}}, (), r"series begins at 1, not"),
        ({"node": {"history": Series(times=(-5.0,), values=(0.0,))}}, (), r"history: nothing is left of it"),
        ({"node": {"growth": -30.0}}, (), r"growth -30: in a lifetime of 9 .*; is it in percent"),
        ({"node": {"growth": -2.0}, "distribution": "fixed", "deviation": None, "mean": 60.0}, (), r"is it in percent"),
        ({"node": {"growth": -3.0}}, (), r"growth -3: no stock has a lifetime of 9 and shrinks so fast"),
        ({"node": {"lifetime": None, "rate": 0.1, "stretch": 2.0}}, (), r"stretch: it has no lifetime"),
        ({"node": {"lifetime": None, "rate": 0.1, "history_stretch": 2.0}}, (), r"history_stretch: it has no lifetime"),
        (
            {"distribution": "fixed", "deviation": None, "node": {"history_stretch": 2.0}},
            (),
            r"stretch: a fixed lifetime has none",
        ),
        ({"node": {"initial": None}}, (), r"initial: missing"),
        ({}, (BUY, DISCARD, OTHER), r"arc 'other': law 'donor': its donor 'use' has a lifetime"),
        ({}, (BUY,), r"lifetime: no arc leaves it"),
        ({}, (replace(BUY, law=Law.RECIPIENT, flow=0.0, rate=1.0), DISCARD), r"law 'recipient': it cannot enter 'use'"),
    ],
)  # fmt: skip
def test_what_cannot_live_is_refused(use: dict[str, Any], arcs: tuple[Arc, ...], said: str) -> None:
    """Each with the node or arc, the value, and what to do."""
    network = town(LIVES[0])
    node = {"lifetime": replace(LIVES[0], **{k: v for k, v in use.items() if k != "node"}), **use.get("node", {})}
    nodes = tuple(replace(each, **node) if each.id == "use" else each for each in network.nodes)
    with pytest.raises(NetworkError, match=said):
        replace(network, nodes=nodes, arcs=arcs or network.arcs)
