"""Numbers that nobody knows exactly: what is drawn, bands of episodes, and which number causes them."""

from __future__ import annotations

import csv
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import assume, given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats
from typer.testing import CliRunner

from cirl_marl import (
    Arc,
    CirlError,
    Constant,
    Control,
    ControlError,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    NetworkError,
    Node,
    Role,
    RunError,
    Series,
    load_network,
    parallel_env,
    single_agent_env,
)
from cirl_marl.cli import app
from cirl_marl.controllers import Neutral
from cirl_marl.controllers.rollout import rollout
from cirl_marl.definitions.reader import write_network
from cirl_marl.dynamics.laws import FlowLaws
from cirl_marl.environments.state import Outcome
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.sampling import rbd_fast, sample_episodes, sensitivities
from cirl_marl.learners.interface import train
from cirl_marl.network.uncertainty import DISTRIBUTIONS, Spread, draw_network
from cirl_marl.optimum import bound

Floats = NDArray[np.floating]
EXAMPLE = Path(__file__).parent.parent / "examples" / "metal_cycle.toml"


def line(uncertain: dict[str, Spread], **rates: Any) -> Network:
    """Return a mine, whose ore is shared out between a dump and a store that leaks."""
    flow = {"flow": 10.0, "dumped": 0.2, "leak": 0.1} | rates
    return Network(
        name="line",
        nodes=(
            Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(1e4, 1e4)),
            Node(id="mill", stores=False),
            Node(id="store", initial=(50.0, 50.0)),
            Node(id="dump", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="dig", donor="mine", recipient="mill", law=Law.EXOGENOUS, flow=flow["flow"]),
            Arc(id="tails", donor="mill", recipient="dump", law=Law.SHARE, share=flow["dumped"]),
            Arc(id="metal", donor="mill", recipient="store", law=Law.SHARE, share=flow.get("kept")),
            Arc(id="leak", donor="store", recipient="dump", rate=flow["leak"]),
        ),
        episode=Episode(horizon=4),
        uncertain=uncertain,
    )


@pytest.mark.parametrize(
    ("spread", "law"),
    [
        (Spread(deviation=0.2), stats.truncnorm(-4, 4, 1.0, 0.2)),
        (Spread(deviation=0.5, low=0.5, high=2.0), stats.truncnorm(-1, 2, 1.0, 0.5)),
        (Spread(low=0.7, high=1.1, distribution="uniform"), stats.uniform(0.7, 0.4)),
        (
            Spread(deviation=0.3, distribution="lognormal"),
            stats.lognorm(np.sqrt(np.log(1.09)), scale=1 / np.sqrt(1.09)),
        ),
        (Spread(deviation=0.6, distribution="gamma"), stats.gamma(1 / 0.36, scale=0.36)),
    ],
)
def test_draws_follow_their_distribution(spread: Spread, law: Any) -> None:
    """That of SciPy, cut to the range."""
    draws = spread.at(np.random.default_rng(0).random(4000))
    assert stats.kstest(draws, law.cdf).pvalue > 1e-3
    assert spread.low <= spread.ends[0] <= draws.min() and draws.max() <= spread.ends[1] <= spread.high
    assert law.cdf(spread.ends[0]) < 1e-4 and law.cdf(spread.ends[1]) > 1 - 1e-4
    np.testing.assert_array_equal(spread.ends, spread.at(np.array([0.0, 1.0])))


def test_a_draw_is_the_network_with_other_numbers() -> None:
    """Numbers are multiplied, series at all times; the rest of a split makes room; the network itself stays."""
    twice = Spread(low=1.0, high=2.0, distribution="uniform")
    flow = Series(times=(0.0, 2.0), values=(10.0, 4.0))
    network = line({"arcs.dig.flow": twice, "arcs.leak.rate": twice, "arcs.tails.share": twice}, flow=flow)
    found = draw_network(network, [2.0, 1.5, 2.0])
    dig, tails, metal, leak = found.arcs
    assert dig.flow == replace(flow, values=(20.0, 8.0)) and leak.rate == pytest.approx(0.15)
    assert tails.share == pytest.approx(0.4) and metal.share is None
    assert not found.uncertain and network.arcs[0].flow == flow
    run = rollout(MultiAgentVectorEnv(found, num_envs=1), Neutral())
    np.testing.assert_allclose(run.flow[:, 1], 0.4 * np.array([20.0, 20.0, 8.0, 8.0]))


def test_shares_stay_shares() -> None:
    """Where all are stated they are divided by their sum; where one takes the rest it is never less than none."""
    wide = Spread(low=0.1, high=9.0, distribution="uniform")
    stated = draw_network(line({"arcs.tails.share": wide}, kept=0.8), [9.0])
    assert stated.arcs[1].share == pytest.approx(1.8 / 2.6) and stated.arcs[2].share == pytest.approx(0.8 / 2.6)
    little = draw_network(line({"arcs.tails.share": wide}, kept=0.8), [0.1])
    assert little.arcs[1].share == pytest.approx(0.02 / 0.82) and little.arcs[2].share == pytest.approx(0.8 / 0.82)
    rest = draw_network(line({"arcs.tails.share": wide}), [9.0])
    assert rest.arcs[1].share == pytest.approx(1.0)
    assert draw_network(line({"arcs.tails.share": wide}), [0.1]).arcs[1].share == pytest.approx(0.02)


def test_samples_are_single_simulations() -> None:
    """Of what was drawn; more samples add to those before."""
    uncertain = {"arcs.dig.flow": Spread(deviation=0.1), "arcs.leak.rate": Spread(deviation=0.2)}
    network = line(uncertain)
    found, more = sample_episodes(network, samples=3, seed=4), sample_episodes(network, samples=5, seed=4)
    np.testing.assert_array_equal(more.rollout.circularity_mean[:3], found.rollout.circularity_mean)
    for i, (dug, leaked) in enumerate(found.factors.tolist()):
        run = rollout(MultiAgentVectorEnv(line({}, flow=10.0 * dug, leak=0.1 * leaked), num_envs=1), Neutral())
        np.testing.assert_allclose(found.rollout.stock[i], run.stock, rtol=1e-12)
        np.testing.assert_allclose(found.rollout.flow[i], run.flow, rtol=1e-12)
        np.testing.assert_allclose(found.rollout.circularity_mean[i], run.circularity_mean[0], rtol=1e-12)
    assert not np.array_equal(sample_episodes(network, samples=3, seed=5).factors, found.factors)


def test_causes_are_the_shares_of_the_variance() -> None:
    """λ̄ = −(dug + leaked): of two flows in a sum each causes its part, in closed form; what has no part, none."""
    uncertain = {
        "arcs.dig.flow": Spread(deviation=0.1),
        "arcs.leak.rate": Spread(deviation=0.4),
        "nodes.other.rate": Spread(deviation=0.4),
    }
    network = line({})
    other = Node(id="other", initial=(5.0, 5.0), rate=0.2)
    apart = Arc(id="apart", donor="other", recipient="store", law=Law.SHARE)
    network = replace(
        network, nodes=(*network.nodes, other), arcs=(*network.arcs, apart), uncertain=uncertain
    ).with_options(episode={"horizon": 1})
    found = sample_episodes(network, samples=300)
    (causes,) = sensitivities(found)
    parts = []
    for k in range(2):
        factors = np.ones((2, 3))
        factors[:, k] += np.array([-1, 1]) * (0.1, 0.4)[k]
        low, high = (
            rollout(
                MultiAgentVectorEnv(draw_network(network, each.tolist()), num_envs=1), Neutral()
            ).episode_circularity[0]
            for each in factors
        )
        parts.append(((high - low) / 2) ** 2)
    expected = np.array([*parts, 0.0]) / sum(parts)
    np.testing.assert_allclose(causes.shares, expected, atol=0.15)
    assert (np.abs(causes.shares - expected) < 2.5 * causes.margins + 0.02).all()


def test_files_state_it(tmp_path: Path) -> None:
    """Deviation and range in the unit of the number; written, they read back the same."""
    network = load_network(EXAMPLE).scenario("business_as_usual")
    assert set(network.uncertain) == {"arcs.dross.share", "nodes.use.stretch", "services.supply.low"}
    assert network.uncertain["arcs.dross.share"] == Spread(low=0.5, high=1.5, distribution="uniform")
    assert network.uncertain["services.supply.low"].deviation == pytest.approx(0.05)
    relative = load_network("steel_japan").uncertain
    assert relative["nodes.vehicles.stretch"] == Spread(deviation=0.1)
    assert relative["services.steel_in_use.low"].deviation == pytest.approx(0.05)
    write_network(network, tmp_path / "again.toml")
    again = load_network(str(tmp_path / "again.toml"))
    for where, spread in network.uncertain.items():
        other = again.uncertain[where]
        assert (other.low, other.deviation) == pytest.approx((spread.low, spread.deviation))
    first, second = (sample_episodes(part, samples=2).rollout for part in (again, network))
    np.testing.assert_allclose(first.circularity_mean, second.circularity_mean)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("range = [1.5, 0.5]", r"arcs.dross.share.range: \[1.5, 0.5\] must have its lower end first, 1"),
        ("range = [1.2, 1.5]", r"range: \[1.2, 1.5\] must contain the number, 1"),
        ("range = [-0.5, 1.5]", r"range: \[-0.5, 1.5\] must not cross 0: a number keeps its sign"),
        (
            "deviation = -1",
            r"arcs.dross.share: deviation -1: what spreads must not be 0, and its deviation must be positive",
        ),
        ('distribution = "normal"', r"arcs.dross.share.distribution: 'normal' needs a deviation or a range"),
        ('range = [0.5, 1.5], distribution = "norml"', r"Did you mean 'normal'"),
        ('range = [0.5, 1.5], distribution = "normal"', r"distribution 'normal' needs a deviation"),
    ],
)
def test_what_cannot_spread_is_refused(written: str, said: str, tmp_path: Path) -> None:
    """With its path, what is wrong and what to do."""
    text = EXAMPLE.read_text().replace("range = [0.5, 1.5]", written)
    (tmp_path / "metal_cycle.csv").write_text(EXAMPLE.with_suffix(".csv").read_text())
    (tmp_path / "metal_cycle.toml").write_text(text)
    with pytest.raises(NetworkError, match=said):
        load_network(str(tmp_path / "metal_cycle.toml"))


@pytest.mark.parametrize(
    ("where", "said"),
    [
        (
            "arcs.dig.flw",
            r"unknown number of arcs that can be uncertain or disturbed 'flw'\. Did you mean 'flow'\? Known: rate",
        ),
        ("arcs.dig.control", r"'control' is not given"),
        ("arcs.dg.flow", r"unknown arc 'dg'. Did you mean 'dig'"),
        ("episode.horizon", r"only numbers of nodes, arcs, services can be uncertain"),
        ("arcs.metal.share", r"'share' is not given"),
        ("arcs.dig.rate", r"it is 0, and so is every draw"),
        ("nodes.store.stretch", r"only a lifetime with a deviation can be stretched"),
    ],
)
def test_paths_are_checked(where: str, said: str) -> None:
    """Of networks made in Python."""
    with pytest.raises(NetworkError, match=said):
        line({where: Spread(deviation=0.1)})


@st.composite
def uncertain_networks(draw: st.DrawFn) -> Network:
    """Draw networks with numbers of every kind that are uncertain."""
    network = draw(st.from_type(Network))
    paths = [f"arcs.{each.id}.{name}" for each in network.arcs for name in ("rate", "flow", "share")]
    paths += [f"nodes.{each.id}.{name}" for each in network.nodes for name in ("rate", "stretch")]
    parts = [*(("nodes", each) for each in network.nodes), *(("arcs", each) for each in network.arcs)]
    paths += [f"{kind}.{each.id}.control" for kind, each in parts if each.control is not None]
    paths += [f"services.{each.id}.{end}" for each in network.services for end in ("low", "high")]
    uncertain: Mapping[str, Spread] = {}
    for where in draw(st.lists(st.sampled_from(paths), unique=True, min_size=1, max_size=12)):
        kind = draw(st.sampled_from(DISTRIBUTIONS))
        spread = Spread(low=0.6, high=1.1, distribution=kind, deviation=None if kind == "uniform" else 0.3)
        try:
            uncertain = replace(network, uncertain={**uncertain, where: spread}).uncertain
        except NetworkError:
            pass  # this number is not stated, or 0
    assume(uncertain)
    step = network.episode.solver_step  # the fastest draws need a shorter one
    episode = (
        {}
        if step is None
        else {"solver_step": network.episode.control_interval / round(2 * network.episode.control_interval / step)}
    )
    return replace(network, uncertain=uncertain).with_options(episode=episode)


def randomly(env: MultiAgentVectorEnv, steps: int, seed: int) -> Iterator[Outcome]:
    """Act at random in a copy of an environment that has been reset."""
    rng = np.random.default_rng(seed)
    entries = sum(space.shape[0] for space in env.action_spaces.values())
    for _ in range(min(steps, env.network.episode.horizon)):
        yield env.advance(np.repeat(rng.uniform(-1, 1, (entries, 1)), env.num_envs, axis=1))


@given(uncertain_networks(), st.integers(0, 99))
def test_each_copy_is_the_network_with_what_it_drew(network: Network, seed: int) -> None:
    """Simulated alone, with numbers that are certain; a copy of a batch is a lone environment, to the bit."""
    env = MultiAgentVectorEnv(network, num_envs=2, uncertain=True, reward="mixed_difference")
    env.reset(seed=seed)
    start, factors = env.physical.stock[env.rows.nodes], env.physical.factors
    lone = MultiAgentVectorEnv(network, num_envs=1, uncertain=True, reward="mixed_difference")
    lone.reset(seed=seed + 1)
    others = [
        MultiAgentVectorEnv(draw_network(network, factors[:, i].tolist()), num_envs=1, reward="mixed_difference")
        for i in (0, 1)
    ]
    names = env.rows.start_names
    # what is cut follows the substeps, of which the fastest draws need most
    assume(all(other.dynamics.substeps == env.dynamics.substeps for other in others))
    for i, other in enumerate(others):
        other.reset(seed=0, options={"initial_state": dict(zip(names, start[:, i].tolist(), strict=True))})
        np.testing.assert_allclose(other.physical.flow[:, 0], env.physical.flow[:, i], rtol=1e-9, atol=1e-9)
    for outcome, alone, *certain in zip(*(randomly(each, 4, seed) for each in (env, lone, *others)), strict=True):
        np.testing.assert_array_equal(outcome.observation[:, 1], alone.observation[:, 0])
        np.testing.assert_array_equal(outcome.reward[:, 1], alone.reward[:, 0])
        for i, other in enumerate(certain):
            for what in ("flow", "circularity_mean", "levels", "reward", "local"):
                ours, theirs = getattr(outcome, what)[..., i], getattr(other, what)[..., 0]
                np.testing.assert_allclose(ours, theirs, rtol=1e-8, atol=1e-8, err_msg=what)


def test_supplies_make_up_for_what_was_drawn() -> None:
    """Business as usual meets the demand of the draw, with what the others do."""
    network = load_network(EXAMPLE).scenario("business_as_usual")
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True, reward="difference")
    run = rollout(env, Neutral(), seed=2)
    for i in range(3):
        other = MultiAgentVectorEnv(
            draw_network(network, env.physical.factors[:, i].tolist()), num_envs=3, reward="difference"
        )
        alone = rollout(other, Neutral(), seed=2)
        # what is missing is found to 1e-9 of the demand, in steps of its own in each of the two
        np.testing.assert_allclose(run.circularity_mean[i], alone.circularity_mean[i], rtol=1e-8)
        np.testing.assert_allclose(run.levels[i], alone.levels[i], rtol=1e-8)
        np.testing.assert_allclose(run.returns[:, i], alone.returns[:, i], atol=1e-8)
    assert np.ptp(run.episode_circularity) > 1


def test_draws_differ_and_last_an_episode() -> None:
    """From each copy's own stream, in every info and in the snapshot; starts are those of the certain environment."""
    network = load_network(EXAMPLE).scenario("business_as_usual").with_options(episode={"horizon": 3})
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    env.reset(seed=5)
    certain = MultiAgentVectorEnv(network, num_envs=3)
    certain.reset(seed=5)
    np.testing.assert_array_equal(env.physical.stock, certain.physical.stock)
    first = env.physical.factors.copy()
    assert len(np.unique(first[0])) == 3 and (first[0] >= 0.5).all() and (first[0] <= 1.5).all()
    saved = env.snapshot()
    seen = []
    for _ in range(3):
        *_, infos = env.step(env.neutral_action)
        for info in infos.values():
            np.testing.assert_array_equal(info["drawn"], first.T)
        seen.append(env.physical.stock.copy())
    second = env.physical.factors.copy()
    assert (second != first).all()
    env.restore(saved)
    np.testing.assert_array_equal(env.physical.factors, first)
    for stock in seen:
        env.step(env.neutral_action)
        np.testing.assert_array_equal(env.physical.stock, stock)
    np.testing.assert_array_equal(env.physical.factors, second)
    with pytest.raises(ControlError, match=r"3 copies, agents .*, uncertain; this is"):
        certain.restore(saved)
    assert "drawn" not in certain.step(certain.neutral_action)[-1][certain.agents[0]]
    with pytest.raises(CirlError, match="nothing is uncertain; give a number a deviation"):
        MultiAgentVectorEnv("copper_net", uncertain=True)


def test_every_view_draws() -> None:
    """PettingZoo and Gymnasium environments with the same seed draw the same."""
    network = load_network(EXAMPLE).scenario("business_as_usual")
    parallel = parallel_env(network, uncertain=True)
    _, infos = parallel.reset(seed=3)
    told = infos[parallel.agents[0]]["drawn"].copy()
    infos[parallel.agents[0]]["drawn"] *= 3.0  # whoever normalises in place changes no physics
    *_, infos = parallel.step({agent: space.sample() for agent, space in parallel.action_spaces.items()})
    np.testing.assert_array_equal(infos[parallel.agents[0]]["drawn"], told)
    single = single_agent_env(network, agent=parallel.agents[0], uncertain=True)
    np.testing.assert_array_equal(single.reset(seed=3)[1]["drawn"], told)
    np.testing.assert_array_equal(single.step(single.action_space.sample())[-1]["drawn"], told)
    check_env(single, skip_render_check=True)


def rates_of_draws(network: Network) -> tuple[Floats, Floats, Floats]:
    """Return draws from one end of the ranges to the other, r under them, shape (arcs, draws), and the bound of r."""
    laws, draws = FlowLaws(network, uncertain=True), np.linspace(0, 1, 50)
    factors = np.array([spread.at(draws) for spread in network.uncertain.values()])
    low, _, high = network.control_bounds[:, :, :1]
    controls = np.where(draws < 0.5, low, high)
    return factors, laws.rate(controls, np.zeros(50, dtype=np.intp), factors), laws.max_rate


def test_levels_and_neutral_actions_are_of_what_was_drawn() -> None:
    """Both ends of a band; what is observed again is what was observed; a supply that acts as if it did not."""
    network = load_network(EXAMPLE).scenario("business_as_usual").with_options(episode={"horizon": 4})
    service = replace(network.services[0], high=900.0)
    uncertain = {**network.uncertain, "services.supply.high": Spread(low=0.98, high=1.5, distribution="uniform")}
    network = replace(network, services=(replace(service, low=700.0),), uncertain=uncertain)
    env = MultiAgentVectorEnv(network, num_envs=8, uncertain=True, observe="full", agents=["smelting", "old_scrap"])
    env.reset(seed=0, options={"initial_state": {"use": np.linspace(600.0, 1100.0, 8)}})
    idle = MultiAgentVectorEnv(network, num_envs=8, uncertain=True, agents=["old_scrap"])
    idle.reset(seed=0, options={"initial_state": {"use": np.linspace(600.0, 1100.0, 8)}})
    rows = [tuple(network.uncertain).index(f"services.supply.{end}") for end in ("low", "high")]
    low, high = np.array([[700.0], [900.0]]) * env.physical.factors[rows]
    for _ in range(3):
        outcome = env.advance(env.stack(env.neutral_action))
        idle.advance(idle.stack(idle.neutral_action))
        np.testing.assert_allclose(env.physical.stock, idle.physical.stock, rtol=1e-9)
        use = env.rows.stocks(env.physical.stock)[network.node_index["use"]]
        np.testing.assert_allclose(outcome.levels[0], np.minimum(1.0, np.minimum(use / low, high / use)))
        for agent, seen in env.observations().items():
            np.testing.assert_array_equal(seen, env.by_agent(outcome.observation)[agent])


def test_no_draw_exceeds_what_arrays_are_made_for() -> None:
    """Rates, substeps and reserves come from the ends of the ranges: no rate exceeds its bound, no source runs out."""
    wide = Spread(low=0.2, high=5.0, distribution="uniform")
    example = load_network(EXAMPLE).scenario("lifetimes")
    stated = line({"arcs.tails.share": Spread(low=0.5, high=2.0, distribution="uniform")}, kept=0.8)
    for each in (stated, replace(example, uncertain={"nodes.use.stretch": Spread(low=0.5, high=1.5, deviation=1.0)})):
        _, rates, bounds = rates_of_draws(each)
        assert (rates <= bounds[:, None] * (1 + 1e-12)).all()
    np.testing.assert_allclose(rates_of_draws(stated)[1].max(axis=1), [10.0, 1 / 3, 0.8 / 0.9, 0.1], rtol=1e-12)
    np.testing.assert_allclose(rates_of_draws(stated)[2], [10.0, 1 / 3, 0.8 / 0.9, 0.1], rtol=1e-12)
    network = line({"arcs.dig.flow": wide, "arcs.leak.rate": wide, "arcs.tails.share": wide}, leak=0.3)
    mine = Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR)
    network = replace(network, nodes=tuple(mine if each.id == "mine" else each for each in network.nodes))
    factors, rates, bounds = rates_of_draws(network)
    np.testing.assert_allclose(rates.max(axis=1), bounds, rtol=1e-12)
    assert MultiAgentVectorEnv(network, num_envs=1, uncertain=True).dynamics.substeps == 2
    (mine_,) = (i for i, node in enumerate(network.stores) if node.id == "mine")
    assert network.initial[0, mine_] == pytest.approx(10.0 * 5.0 * 4)
    np.testing.assert_array_equal(draw_network(network, factors[:, 7].tolist()).initial, network.initial)


def collecting(spread: Spread, *, low: float = 0.2, high: float = 0.9, **more: Spread) -> Network:
    """Return a collection whose share is set and uncertain, between a heap of discards and what is lost."""
    share = Control(kind=ControlKind.SHARE, low=low, neutral=0.6, high=high)
    return Network(
        name="collecting",
        nodes=(
            Node(id="use", initial=(100.0, 100.0), rate=0.2),
            Node(id="sorting", stores=False),
            Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
        ),
        arcs=(
            Arc(id="discarded", donor="use", recipient="sorting", law=Law.SHARE),
            Arc(id="collected", donor="sorting", recipient="use", law=Law.SHARE, control=share),
            Arc(id="lost", donor="sorting", recipient="tip", law=Law.SHARE, share=0.3),
            Arc(id="burnt", donor="sorting", recipient="tip", law=Law.SHARE, share=0.1),
        ),
        episode=Episode(horizon=5),
        uncertain={"arcs.collected.control": spread, **more},
    )


def test_a_lever_is_as_it_was_drawn() -> None:
    """Actions span what was drawn, a share at most 1; the others keep their proportions; mass stays."""
    network = collecting(Spread(low=0.5, high=1.5, distribution="uniform"))
    env = MultiAgentVectorEnv(network, num_envs=50, uncertain=True, agents=["collected"])
    for action, stated in ((-1.0, 0.2), (1.0, 0.9), (None, 0.6), (0.25, None)):
        env.reset(seed=3)
        factor = env.physical.factors[0]
        low, high = (np.minimum(1.0, end * factor) for end in (0.2, 0.9))
        expected = low + 0.625 * (high - low) if stated is None else np.minimum(1.0, stated * factor)
        chosen = env.neutral_action if action is None else {"collected": np.full((50, 1), action)}
        outcome = env.advance(env.stack(chosen))
        np.testing.assert_allclose(env.controls[0], expected, rtol=1e-12)
        discarded, collected, lost, burnt = outcome.flow
        np.testing.assert_allclose(collected, expected * discarded, rtol=1e-9)
        np.testing.assert_allclose(lost, 3 * burnt, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(env.physical.stock[:2].sum(axis=0), 100.0, rtol=1e-12)
        for i, network_ in ((k, env.certain_network(k)) for k in (0, 7)):
            control = network_.compartments["collected"].control
            assert control is not None
            assert (control.low, control.high) == pytest.approx((low[i], high[i]), rel=1e-12)
    assert (factor > 1 / 0.9).any() and len(np.unique(factor)) == 50
    env.reset(seed=3)
    values = np.stack([0.5 * env.physical.factors[0]])
    back = env.advance(env.stack({"collected": env.normalise("collected", values)}))
    np.testing.assert_allclose(env.controls, values, rtol=1e-12)
    assert (back.flow >= 0).all()


def test_the_bound_of_a_draw_is_of_its_lever() -> None:
    """No action does better than the draw's own bound, which the largest share comes up to."""
    network = collecting(Spread(deviation=0.1), high=0.7)
    env = MultiAgentVectorEnv(network, num_envs=4, uncertain=True)
    run = rollout(env, Constant({"collected": 1.0}), seed=1)
    for copy, reached in enumerate(run.episode_circularity):
        limit = bound(env.certain_network(copy))
        assert reached <= limit.objective + 1e-7
        assert limit.gap(reached) < 0.02
        assert limit.verify().bound == pytest.approx(limit.objective)
    assert np.ptp(run.episode_circularity) > 0.01 * abs(run.episode_circularity.mean())


@pytest.mark.parametrize(
    ("spread", "said"),
    [
        (Spread(low=0.5, high=1.9, distribution="uniform"), r"some draws of its neutral shares sum to 1.14, more than"),
        (Spread(low=1.1, high=1.2, distribution="uniform"), "does not contain the number itself"),
    ],
)
def test_levers_that_cannot_be_drawn(spread: Spread, said: str) -> None:
    """Neutral shares stay shares of a whole."""
    with pytest.raises(NetworkError, match=said):
        collecting(spread)


def test_draws_of_a_lever_trap_no_mass() -> None:
    """A loop without stock needs a way out whatever is drawn."""
    network = collecting(Spread(low=0.9, high=1.05, distribution="uniform"))
    nodes = tuple(
        replace(node, stores=False, rate=0.0, initial=None) if node.id == "use" else node for node in network.nodes
    )
    source = Node(id="source", initial=(10.0, 10.0), rate=0.1)
    arcs = (Arc(id="fed", donor="source", recipient="use", law=Law.SHARE), *network.arcs)
    replace(network, nodes=(source, *nodes), arcs=arcs)
    wide = {"arcs.collected.control": Spread(low=0.9, high=1.2, distribution="uniform")}
    with pytest.raises(NetworkError, match="store nothing and can pass all they get round in a loop"):
        replace(network, nodes=(source, *nodes), arcs=arcs, uncertain=wide)


def test_files_state_how_levers_spread(tmp_path: Path) -> None:
    """Deviation and range are of the neutral value; a share is at most 1; written files say the same."""
    text = EXAMPLE.read_text().replace('kind = "share"', 'kind = "share", deviation = 0.1')
    (tmp_path / "metal_cycle.csv").write_text(EXAMPLE.with_suffix(".csv").read_text())
    (tmp_path / "levers.toml").write_text(text)
    network = load_network(tmp_path / "levers.toml")
    (path,) = (path for path in network.uncertain if path.endswith("control"))
    assert network.uncertain[path].deviation == pytest.approx(0.2) and network.uncertain[path].high == pytest.approx(
        2.0
    )
    write_network(network, tmp_path / "again.toml")
    assert load_network(tmp_path / "again.toml").uncertain[path] == network.uncertain[path]
    (tmp_path / "levers.toml").write_text(text.replace("deviation = 0.1", "range = [0.55, 0.7]"))
    with pytest.raises(CirlError, match=r"arcs.old_scrap.control.range: \[0.55, 0.7\] must contain the number, 0.5"):
        load_network(tmp_path / "levers.toml")


def test_reserves_cover_what_levers_may_ask_for() -> None:
    """A source without a known reserve starts with what the largest draw of its flow can take."""
    control = Control(kind=ControlKind.FLOW, low=0.0, neutral=5.0, high=10.0)
    network = Network(
        name="digging",
        nodes=(Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR), Node(id="store", initial=(0.0, 0.0))),
        arcs=(Arc(id="dig", donor="mine", recipient="store", law=Law.CONTROLLED, control=control),),
        episode=Episode(horizon=3),
        uncertain={"arcs.dig.control": Spread(low=0.5, high=1.4, distribution="uniform")},
    )
    assert network.initial[0, 0] == pytest.approx(3 * 10 * 1.4, rel=1e-5)
    env = MultiAgentVectorEnv(network, num_envs=20, uncertain=True)
    rollout(env, Constant({"dig": 1.0}), seed=0)
    np.testing.assert_allclose(env.physical.stock[1], 30.0 * env.physical.factors[0], rtol=1e-9)


@pytest.mark.slow
def test_an_episode_is_held_against_what_it_drew(tmp_path: Path) -> None:
    """Everyone meets the same draws; the bound is that of a network with these numbers, for the service delivered."""
    network = load_network(EXAMPLE).with_options(episode={"horizon": 4})
    found = compare((), ("neutral", "optimum"), network=network, episodes=3, uncertain=True)
    env = MultiAgentVectorEnv(network, num_envs=3, uncertain=True)
    env.reset(seed=found.first_seed)
    starts, factors = env.physical.stock[env.rows.nodes], env.physical.factors
    assert np.ptp(factors[0]) > 0.1
    for entry in found.entries:
        assert entry.bound is not None
        for i in range(3):
            certain, levels = draw_network(network, factors[:, i].tolist()), entry.rollout.episode_levels[i]
            least, most = (bound(certain, starts[:, i], min_service=levels - cut).objective for cut in (1e-7, 2e-4))
            assert least - 1e-6 <= entry.bound[i] <= most
            assert entry.bound[i] >= entry.circularity[i]
    certain = compare((), ("neutral",), network=network, episodes=3)
    assert certain.baseline.envelope is not None
    assert (certain.entries[0].circularity != found.entries[0].circularity).all()
    run = train(network, "independent_ars", steps=128, envs=2, uncertain=True, directory=tmp_path / "run").run
    assert run is not None and run.make_env(1).uncertain
    assert compare([run], network=network, episodes=2, bounds=False).entries[0].circularity.shape == (2,)
    certain_run = train(network, "independent_ars", steps=128, envs=2, directory=tmp_path / "certain").run
    assert certain_run is not None
    with pytest.raises(RunError, match=r"uncertain numbers not drawn, there drawn; say which with uncertain"):
        compare([run, certain_run], episodes=2, bounds=False)
    for asked, draws in ((None, True), (False, False)):
        neutral = compare([run], episodes=2, bounds=False, uncertain=asked).entries[1]
        same = rollout(MultiAgentVectorEnv(network, num_envs=2, uncertain=draws), Neutral(), seed=found.first_seed)
        np.testing.assert_array_equal(neutral.circularity, same.episode_circularity)


def test_bands_stay_bands() -> None:
    """Whatever is drawn of their ends."""
    network = load_network(EXAMPLE)
    service = replace(network.services[0], low=900.0, high=1000.0)
    near = {"services.supply.low": Spread(low=0.9, high=1.12, distribution="uniform")}
    with pytest.raises(NetworkError, match=r"services.supply.low: some draws turn the band upside down"):
        replace(network, services=(service,), uncertain=near, scenarios={})
    apart = {"services.supply.low": Spread(low=0.9, high=1.1, distribution="uniform")}
    assert replace(network, services=(service,), uncertain=apart, scenarios={}).uncertain == apart


def test_the_command_writes_bands_and_causes(tmp_path: Path) -> None:
    """Quantiles in order, those of the draws; nothing is written of what is refused."""
    run = CliRunner().invoke(app, ["simulate", str(EXAMPLE), "--samples", "80", "--steps", "3", "--out", str(tmp_path)])
    assert run.exit_code == 0, run.output
    files = sorted(path.name for path in tmp_path.iterdir())
    assert files == [f"metal_cycle_neutral_{each}" for each in ("bands.csv", "bands.png", "causes.csv", "draws.csv")]
    with (tmp_path / "metal_cycle_neutral_bands.csv").open(newline="") as file:
        bands = list(csv.DictReader(file))
    assert len(bands) == 3 * (1 + 1 + 3 + 8)
    for row in bands:
        quantiles = [float(row[f"quantile {each}"]) for each in ("0.025", "0.25", "0.5", "0.75", "0.975")]
        assert quantiles == sorted(quantiles)
    with (tmp_path / "metal_cycle_neutral_causes.csv").open(newline="") as file:
        (first, *_) = list(csv.DictReader(file))
    assert first["number"] == "arcs.dross.share" and float(first["share of λ̄"]) > 0.8
    (line,) = [line for line in run.output.splitlines() if line.startswith("λ̄: ")]
    median, low, high, mean = map(float, re.findall(r"-?\d[\d.e+-]*(?=[ ,\]])", line.replace("95 % of", "")))
    assert low < median < high and "median" in line.split(",")[0] and line.index("95 %") < line.index("; mean")
    with (tmp_path / "metal_cycle_neutral_draws.csv").open(newline="") as file:
        found = [float(row["mean circularity (Mt)"]) for row in csv.DictReader(file)]
    np.testing.assert_allclose([low, median, high], np.quantile(found, (0.025, 0.5, 0.975)), rtol=1e-4)
    assert mean == pytest.approx(np.mean(found), rel=1e-4)
    for arguments, said in (
        (["copper_net", "--samples", "80"], "nothing is uncertain"),
        (
            [str(EXAMPLE), "--samples", "80", "--control", "neutral", "--control", "random"],
            "one scenario and one control",
        ),
    ):
        refused = CliRunner().invoke(app, ["simulate", *arguments, "--out", str(tmp_path / "other")])
        assert refused.exit_code != 0 and said in str(refused.exception)
    assert not (tmp_path / "other").exists()
    with pytest.raises(CirlError, match="too few to tell"):
        sensitivities(sample_episodes(load_network(EXAMPLE).with_options(episode={"horizon": 2}), samples=3))


def test_a_missing_library_is_named_before_the_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Shares of the spread need an extra."""
    monkeypatch.setitem(sys.modules, "SALib.analyze.rbd_fast", None)
    with pytest.raises(CirlError, match=r"pip install 'cirl-marl\[sensitivity\]'"):
        rbd_fast()
