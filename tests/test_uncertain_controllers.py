"""Controllers where something happens that nobody foresees: against a dynamic program, the bound, and each other."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from disturbed_line import EVERYWHERE, line
from numpy.typing import ArrayLike, NDArray
from small_networks import KINDS
from test_mpc import ORDER, in_use
from test_optimum import certifiable
from test_uncertain_bound import DEMAND, Paths, best_stockist, stockist, works

from cirl_marl import CirlError, MultiAgentVectorEnv, Network, NetworkError, bound, compare, gradient
from cirl_marl.controllers import Controller
from cirl_marl.controllers.rollout import first_seed, rollout
from cirl_marl.evaluation import calibration
from cirl_marl.evaluation.calibration import calibrate
from cirl_marl.network.disturbances import DisturbanceEffect, Markov
from cirl_marl.network.elements import FeedbackRule
from cirl_marl.network.processes import DisturbanceProcesses
from cirl_marl.network.uncertainty import Spread, expected_network
from cirl_marl.optimum import NoCertificate, Sampling, blind, futures, simulate_plan
from cirl_marl.optimum.admissible import Admissible
from cirl_marl.optimum.blind import BestConstant, BestSchedule, Replay
from cirl_marl.optimum.futures import future_noise
from cirl_marl.optimum.mpc import MPC
from cirl_marl.optimum.registry import named_controller
from cirl_marl.optimum.schedule_ascent import ScheduleAscent, improve_schedule
from cirl_marl.optimum.window_planner import Future
from cirl_marl.report.tradeoffs import comparison_notes, summary_of

Floats = NDArray[np.float64]


class Foreseeing(Controller):
    """Tries all ways to the future that lead through what controllers are given."""

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Begin, and look."""
        self.env, self.seed, self.seen = env, seed, list[Floats]()
        copies = range(env.num_envs)
        self.seen.append(env.network.processes.sample([seed + i for i in copies]).values)
        other = MultiAgentVectorEnv(env.network, num_envs=env.num_envs)
        other.reset(seed=seed)
        self.seen.append(other.physical.disturbances.copy())

    def act(self, observations: Any) -> Any:
        """Stay neutral, and look."""
        env = self.env
        neutral = env.neutral_action
        if int(env.physical.step[0]) == 0:
            self.seen += [env.physical.disturbances.copy(), env.physical.processes.copy()]
            ahead = MultiAgentVectorEnv(env.network, num_envs=env.num_envs)
            ahead.restore(env.snapshot())
            self.seen.append(ahead.physical.disturbances.copy())
            env.reset()
            self.seen.append(env.physical.disturbances.copy())
        return neutral


def test_nothing_of_the_future_is_to_be_seen() -> None:
    """Neither in the state that a controller is shown, nor by its seed, a snapshot, or by starting again."""
    network = replace(works(5), disturbances={"outage": replace(KINDS["price"], low=0.1, high=9.0)})
    env, spy = MultiAgentVectorEnv(network, num_envs=64), Foreseeing()
    run = rollout(env, spy, seed=first_seed(3))
    truth = np.moveaxis(run.disturbances, 0, 2)
    for values in spy.seen:
        assert not np.isin(values[1:], truth[1:]).any()
    np.testing.assert_array_equal(spy.seen[2][0], truth[0])  # what is, is seen
    assert np.isnan(spy.seen[2][1:]).all() and np.isnan(spy.seen[3][1:]).all()


def test_what_follows_on_a_state_is_drawn_from_it() -> None:
    """Means of continuations are conditional means; the first is the present; as a path goes on from its own states."""
    network = line(EVERYWHERE)
    processes: DisturbanceProcesses = network.processes
    states, count = processes.sample(range(3)).states[2, :, [1]].T, 20_000
    noise = future_noise(2, 3, len(states), count)
    np.testing.assert_array_equal(noise[..., 1::2], -noise[..., ::2])  # antithetic
    paths = processes.continuations(np.repeat(states, count, axis=1), 2, noise)
    np.testing.assert_array_equal(paths.values[0], np.repeat(processes.values(states, 2), count, axis=1))
    means, deviation = processes.conditional_means(states, 2, 3)[..., 0], paths.values[1:].std(axis=2)
    assert (np.abs(paths.values[1:].mean(axis=2) - means) < 4 * deviation / np.sqrt(count / 2) + 1e-12).all()


def certain_process(network: Network) -> Network:
    """Return the network, all arcs' rates disturbed by a chain that has only one value."""
    chain = Markov(values=(1.0, 1.0), lengths=(2.0, 3.0))
    found = replace(network, disturbances={"nothing": chain}, scenarios={})
    for arc in network.arcs:
        try:
            effect = DisturbanceEffect(by="nothing")
            found = replace(found, disturbed={**found.disturbed, f"arcs.{arc.id}.rate": effect})
        except NetworkError:
            continue
    return found


@pytest.mark.slow
def test_without_noise_all_plans_are_one(make_network: Callable[..., Network]) -> None:
    """Where a process never changes, MPC, with conditional means or futures, is nearly that of the network without.

    What is certain goes on as it planned where that does better.
    """
    compared = 0
    for seed in range(9):
        network = certifiable(make_network(seed, 5, 8), 0.5, False).with_options(episode={"horizon": 3})
        disturbed = certain_process(network)
        if not network.agents or not disturbed.disturbed:
            continue
        runs = []
        for case, count in ((network, None), (disturbed, None), (disturbed, 1), (disturbed, 2)):
            env = MultiAgentVectorEnv(case, num_envs=1)
            controller = MPC(horizon=3, replan=1, service_weight=1000.0, futures=count)
            try:
                runs.append(rollout(env, controller, seed=first_seed(1)))
            except NoCertificate:
                break
        if len(runs) < 4:
            continue
        compared += 1
        scale = network.objective.circularity_scale
        merit = [run.episode_circularity / scale + 1000.0 * run.episode_service for run in runs]
        np.testing.assert_allclose(merit[2], merit[1], rtol=1e-7, atol=1e-7)
        np.testing.assert_allclose(merit[1], merit[0], rtol=1e-3)
        assert (merit[0] >= merit[1] - 1e-7 * np.abs(merit[1])).all()
        np.testing.assert_allclose(merit[3], merit[0], rtol=0.01)  # another vertex of the same optimum
    assert compared >= 4


def seasonal() -> Network:
    """Return a stock in use that decays within two intervals and is wanted much or little, for some time."""
    network = in_use(5.0, 3)
    extraction, loss = network.arcs
    control = replace(ORDER, high=40.0)
    return replace(
        network,
        arcs=(replace(extraction, control=control), replace(loss, rate=1.5)),
        disturbances={"season": Markov(values=(0.5, 1.5), matrix=((0.7, 0.3), (0.3, 0.7)))},
        disturbed={"services.served.low": DisturbanceEffect(by="season")},
    )


@pytest.mark.slow
def test_feedback_is_between_the_blind_and_the_best() -> None:
    """Of expectations over all paths none exceeds the best policy's; scenario MPC is near it, and blind ones are not.

    The best is the extensive form of all paths at once.
    """
    network = seasonal()
    paths = Paths.of(network, 3)
    best, _, multipliers = paths.best(DEMAND)
    price = float(multipliers[0])
    weight = price / network.objective.circularity_scale
    drawn = network.processes.sample(range(first_seed(0), first_seed(0) + 100)).states[:3, 0].T
    seeds = [first_seed(0) + int((drawn == path).all(axis=1).argmax()) for path in paths.regimes]
    policies: dict[str, Controller] = {
        "scenario": MPC(service_weight=weight, horizon=3, futures=2, degree=2),
        "schedule": BestSchedule(service_weight=weight),
        "constant": BestConstant(service_weight=weight),
    }
    merits = {}
    for name, policy in policies.items():
        env = MultiAgentVectorEnv(network, num_envs=1)
        if isinstance(policy, BestConstant):  # nothing of it follows from the path
            env.reset(seed=1)
            policy.start(env, 0)
            policy = Replay(policy.actions)
        runs = [rollout(env, policy, seed=seed) for seed in seeds]
        np.testing.assert_array_equal([run.disturbances[0, :, 0] > 1 for run in runs], paths.regimes == 1)
        merit = [float(run.episode_circularity[0] + price * (run.episode_levels[0, 0] - DEMAND)) for run in runs]
        merits[name] = float(paths.chance @ merit)
    assert max(merits.values()) <= best + 1e-6 * abs(best), (merits, best)
    assert merits["scenario"] > best + 0.02 * best
    assert merits["schedule"] < merits["scenario"] - 0.02 * abs(best)
    assert merits["constant"] <= merits["schedule"] + 1e-3 * abs(best)


@pytest.mark.slow
def test_who_sees_late_plans_for_what_follows_from_what_it_saw() -> None:
    """Conditional means given the states of earlier intervals; before these there is nothing to act on."""
    network = works(6)
    env = MultiAgentVectorEnv(network, num_envs=16)
    first = {}
    for delay in (0, 1, 6):
        env.reset(seed=first_seed(0))
        controller = MPC(min_service=0.8, delay=delay)
        controller.start(env, 0)
        first[delay] = env.stack(controller.act({}))
    assert np.ptp(first[0], axis=1).max() > 0.01
    assert np.ptp(first[1], axis=1).max() == 0.0
    np.testing.assert_array_equal(first[1], first[6])
    processes, states = network.processes, env.physical.processes[1]
    future = Future(Admissible.of(expected_network(network), None), 1, None)
    for step, delay in ((1, 0), (2, 1), (4, 3)):
        late = futures.DrawnFutures(env, future, 1, None, None, delay)
        expected = processes.conditional_means(states, 1, delay + 2)
        seen = np.concatenate([processes.values(states, 1)[None], expected])[delay:]
        np.testing.assert_allclose(late._means(range(16), step, 3), seen)
    with pytest.raises(CirlError, match="delay 1: goes with plans for conditional means"):
        MPC(futures=2, delay=1)
    with pytest.raises(CirlError, match="delay must be a whole number"):
        MPC(delay=-1)


@pytest.mark.slow
def test_what_is_sold_is_not_held_back_in_plans() -> None:
    """Of a store that sells what it holds, scenario MPC orders as the best policy does; plans cannot ration sales."""
    network, price = stockist(5), 1.7
    paths, best = Paths.of(network), best_stockist(network, price)
    drawn = network.processes.sample(range(first_seed(0), first_seed(0) + 800)).states[:5, 0].T
    merits, env = list[float](), MultiAgentVectorEnv(network, num_envs=1)
    for path in paths.regimes:
        seed = first_seed(0) + int((drawn == path).all(axis=1).argmax())
        run = rollout(env, MPC(service_weight=price / network.objective.circularity_scale, futures=2), seed=seed)
        np.testing.assert_array_equal(run.disturbances[0, :, 0] > 1, path == 1)
        merits.append(float(run.episode_circularity[0] + price * run.episode_levels[0, 0]))
    assert best - 1e-3 <= paths.chance @ np.array(merits) <= best + 1e-6


def test_batches_do_as_they_do_alone_and_seeds_reproduce() -> None:
    """Copy i of a batch acts as a lone episode of seed + i; the second time is as the first."""
    for controller in (MPC(min_service=0.9), MPC(min_service=0.9, futures=2)):
        runs = [
            rollout(MultiAgentVectorEnv(works(2), num_envs=copies), controller, seed=first_seed(2) + first)
            for copies, first in ((2, 0), (2, 0), (1, 1))
        ]
        np.testing.assert_array_equal(runs[0].circularity, runs[1].circularity)
        np.testing.assert_allclose(runs[0].circularity[1], runs[2].circularity[0], rtol=1e-9)


@pytest.mark.slow
def test_the_best_schedule_is_near_the_bound_where_nothing_is_drawn() -> None:
    """Within 1 %, at the service demanded."""
    chain = Markov(values=(1.0, 1.0), lengths=(2.0, 3.0))
    certain = works(8, chain)
    plain = replace(certain, disturbances={}, disturbed={})
    proof = bound(plain, min_service=0.9, degree=4)
    run = rollout(MultiAgentVectorEnv(certain, num_envs=1), BestSchedule(min_service=0.9, draws=2))
    assert run.episode_levels[0, 0] > 0.9 - 1e-3
    assert proof.gap(run.episode_circularity)[0] < 0.01
    assert simulate_plan(proof).episode_circularity[0] <= proof.objective


@pytest.mark.slow
def test_blind_actions_do_not_look() -> None:
    """They are the same in all copies; a constant is the same in all intervals."""
    env = MultiAgentVectorEnv(works(4), num_envs=5)
    for policy in (BestConstant(min_service=0.8, draws=4), BestSchedule(min_service=0.8, draws=4)):
        env.reset(seed=1)
        policy.start(env, 0)
        first = env.stack(policy.act({}))
        assert (first == first[:, :1]).all()
        np.testing.assert_array_equal(first[:, 0], policy.actions[0])
        assert isinstance(policy, BestSchedule) or len(np.unique(policy.actions, axis=0)) == 1


@pytest.mark.slow
def test_blind_ones_begin_with_what_others_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """The same margin is the same schedule, another margin a short ascent, another network a new search."""
    ascents: list[int] = []

    def counted(env: MultiAgentVectorEnv, actions: Floats, **options: Any) -> ScheduleAscent:
        ascents.append(options["updates"])
        return improve_schedule(env, actions, **options)

    monkeypatch.setattr(blind, "improve_schedule", counted)
    first = BestSchedule(min_service=0.8, draws=8)
    env = MultiAgentVectorEnv(works(6), num_envs=1)

    def made(controller: BestSchedule, env: MultiAgentVectorEnv) -> tuple[Floats, list[int]]:
        ascents.clear()
        env.reset(seed=1)
        controller.start(env, 0)
        return controller.actions, list(ascents)

    actions, updates = made(first, env)
    assert updates.count(blind.UPDATES) == 2  # from the constant, and from a plan
    more, updates = made(first.with_margin(1.2), env)
    assert updates == [blind.UPDATES // blind.FEWER]
    again, updates = made(first.with_margin(1.2), env)
    assert updates == [] and again is more
    count = blind.MORE_DRAWS * 8
    draws, levels = MultiAgentVectorEnv(works(6), num_envs=count), []
    for schedule in (actions, more):
        draws.reset(seed=list(range(blind.FIRST_DRAW, blind.FIRST_DRAW + count)))
        levels.append(gradient(draws, schedule).levels.mean())
    assert levels[0] >= 0.8 - blind.SHORTFALL and levels[1] >= 1 - 0.2 / 1.2 - blind.SHORTFALL
    assert blind.UPDATES in made(first, MultiAgentVectorEnv(works(5), num_envs=1))[1]


class Shifted(Controller):
    """Delivers a level that grows with its margin: a constant order of the stockist."""

    def __init__(self, margin: float = 1.0) -> None:
        """Take the margin."""
        self._margin = margin

    def start(self, env: MultiAgentVectorEnv, seed: int) -> None:
        """Order as much."""
        self._replay = Replay(np.full((1, 1), min(1.0, self._margin - 1.0)))
        self._replay.start(env, seed)

    def act(self, observations: Any) -> Any:
        """Order the same again."""
        return self._replay.act(observations)


def test_margins_are_set_on_draws_of_their_own() -> None:
    """The level comes within half of what is allowed; what cannot be had is told, and too few draws are refused."""

    def env(copies: int) -> MultiAgentVectorEnv:
        return MultiAgentVectorEnv(stockist(5), num_envs=copies)

    levels = {m: rollout(env(40), Shifted(m), seed=calibration.FIRST_DRAW).episode_levels.mean() for m in (1.0, 1.2)}
    demand = np.array([0.3 * levels[1.0] + 0.7 * levels[1.2]])
    result = calibrate(env, Shifted, demand, 40)
    again = rollout(env(40), Shifted(float(np.max(result.margin))), seed=calibration.FIRST_DRAW)
    assert abs(result.excess) <= calibration.CLOSE / 2
    assert again.episode_levels.mean() - demand[0] == pytest.approx(result.excess)
    assert calibrate(env, lambda margin: Shifted(1.0), np.ones(1), 10).excess < -0.05
    with pytest.raises(CirlError, match="tune 3: too few draws"):
        calibrate(env, Shifted, demand, 3)
    assert calibrate(env, Shifted, float(demand[0]), 40) == result
    for level, message in ((np.nan, "min_service nan must lie in"), ([0.9, 0.9], r"shape \(2,\), expected \(1,\)")):
        with pytest.raises(CirlError, match=message):
            calibrate(env, Shifted, level, 10)
    for draws, message in ((10.5, "tune must be a whole number"), (10**7, "more draws than seeds set apart")):
        with pytest.raises(CirlError, match=message):
            calibrate(env, Shifted, demand, draws)  # type: ignore[arg-type]


def two_stockists() -> Network:
    """Return two stores that sell from one mine, each by orders of its own, to a demand of its own."""
    one, shop = stockist(8), ("north", "south")
    (mine, *nodes), (order, demand), (served,) = one.nodes, one.arcs, one.services
    rule = FeedbackRule(watches=("",), gains=(1.0,))
    return replace(
        one,
        nodes=(mine, *(replace(node, id=f"{node.id}_{at}") for node in nodes for at in shop)),
        arcs=tuple(
            arc
            for at in shop
            for arc in (
                replace(
                    order, id=f"order_{at}", recipient=f"store_{at}", rule=replace(rule, watches=(f"served_{at}",))
                ),
                replace(demand, id=f"demand_{at}", donor=f"store_{at}", recipient=f"use_{at}"),
            )
        ),
        services=tuple(replace(served, id=f"served_{at}", provider=f"demand_{at}") for at in shop),
        disturbances={at: one.disturbances["custom"] for at in shop},
        disturbed={
            path: DisturbanceEffect(by=at)
            for at in shop
            for path in (f"arcs.demand_{at}.flow", f"services.served_{at}.low")
        },
    )


@pytest.mark.parametrize("seed", range(6))
def test_each_service_has_the_margin_that_delivers_it(seed: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where one service takes a little from the others; what all that is done for it leaves over is told apart."""
    rng = np.random.default_rng(seed)
    count, tried = int(rng.integers(2, 5)), list[Floats]()
    slopes, base = np.diag(rng.uniform(0.02, 0.1, count)), rng.uniform(0.97, 0.999, count)
    slopes -= rng.uniform(0.0, 0.2, (count, count)) * slopes.diagonal().min() * (1 - np.eye(count)) / count
    is_anyway = rng.random(count) < 0.3  # delivered, whatever is charged for it
    slopes[is_anyway], base[is_anyway] = 0.0, 1.0

    def levels(margin: ArrayLike) -> Floats:
        excess: Floats = base + slopes @ np.log(np.broadcast_to(margin, count))
        return excess

    def played(env: MultiAgentVectorEnv, margin: Any, seed: int) -> Any:
        tried.append(np.broadcast_to(margin, count))
        noise = np.linspace(-0.3, 0.3, env.num_envs)[:, None]
        accounts = np.zeros((env.num_envs, 2))
        return SimpleNamespace(episode_levels=levels(margin) + noise, accounts=accounts, bookings=accounts[:, :, None])

    monkeypatch.setattr(calibration, "rollout", played)
    one = stockist(5)
    further = (replace(one.services[0], id=f"served_{i}") for i in range(1, count))
    network = replace(one, services=(*one.services, *further))
    made: dict[str, Any] = {"env": lambda copies: MultiAgentVectorEnv(network, num_envs=copies)}
    result = calibrate(**made, controller=lambda margin: margin, demand=0.99, draws=10)
    excess = levels(result.margin) - 0.99
    assert result.excess == pytest.approx(excess.min()) and len(tried) <= calibration.TRIES
    assert (np.abs(excess[~is_anyway]) <= calibration.CLOSE / 2).all()
    assert (excess[is_anyway] > 0.009).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mpc", "best_schedule", "scripted"])
def test_a_margin_is_of_every_service_or_of_each(name: str) -> None:
    """The same for all is one; a service that is worth more is delivered more; another number of them is refused."""
    options: dict[str, Any] = {} if name == "scripted" else {"min_service": 0.8}
    network = two_stockists()
    env = MultiAgentVectorEnv(network, num_envs=6)

    def made(margin: ArrayLike) -> Floats:
        controller = named_controller(name, margin=margin, **options)
        levels: Floats = rollout(env, controller, seed=3).episode_levels.mean(axis=0)
        return levels

    both = made(1.1)
    np.testing.assert_array_equal(made([1.1, 1.1]), both)
    first, second = made([2.0, 0.7]), made([0.7, 2.0])
    assert first[0] > second[0] and second[1] > first[1]
    with pytest.raises(CirlError, match=r"margin has shape \(3,\), expected \(2,\): a margin for each service"):
        made([1.0, 1.0, 1.0])
    with pytest.raises(CirlError, match=r"margin -1\.0 must be positive and finite"):
        named_controller(name, margin=[1.0, -1.0], **options)


@pytest.mark.slow
def test_all_are_compared_by_the_bound(monkeypatch: pytest.MonkeyPatch) -> None:
    """All controllers by name, against the bound on common draws; rows that miss their service are named."""
    monkeypatch.setattr(calibration, "TRIES", 1)
    monkeypatch.setattr(BestConstant, "iterations", 2)
    monkeypatch.setattr(BestSchedule, "iterations", 2)
    found = bound(works(2), min_service=0.8, degree=1, uncertain=Sampling(draws=10, fit_draws=4))
    names = ("scenario_mpc", "price_policy", "best_constant")
    comparison = compare(
        (), names, network=found.network, min_service=0.8, bounds=False, uncertain_bound=found, tune=10, futures=2
    )
    assert comparison.figures[-2:] == ("expected_gap", "foresight_gap")
    gaps = {row.name: row.figure("expected_gap") for row in comparison.rows}
    for row in comparison.rows:
        (entry,), gap = row.entries, gaps[row.name]
        assert gap is not None and gap.high > -1e-6
        assert (entry.calibration is None) == (row.name == "neutral")
        assert entry.milliseconds > (1.0 if row.name.endswith(("mpc", "policy")) else 0.0)
        excess = float(entry.rollout.episode_levels.mean() - 0.8)
        assert (row.name in comparison.misses()) == (abs(excess) > calibration.CLOSE and entry.calibration is not None)
    (note,) = (note for note in comparison_notes(comparison) if note.startswith("processor time of a decision"))
    noticeable = {row.name for row in comparison.rows if row.entries[0].milliseconds >= 1}
    assert {"scenario_mpc", "price_policy"} <= noticeable == {name for name in gaps if f"{name} " in note}
    assert any(note.startswith("prices on what is new, in place of") for note in comparison_notes(comparison))
    assert summary_of(comparison)["uncertain_bound"] == found.as_dict()
    with pytest.raises(CirlError, match="tune: give min_service"):
        compare((), names[:1], network=found.network, bounds=False, tune=10)


@pytest.mark.slow
def test_a_bound_goes_with_its_own_episodes() -> None:
    """It says what is demanded and drawn; of another process, number or demand it is refused, of another sight not."""
    numbers = {"arcs.lose.rate": Spread(low=0.5, high=1.5, distribution="uniform")}
    network = replace(works(2), uncertain=numbers)
    found = bound(network, min_service=0.8, degree=1, uncertain=Sampling(draws=10, fit_draws=4))
    (process,) = network.disturbances.values()
    unseen = replace(network, disturbances={"outage": replace(process, observed="none")})
    (entry,) = compare((), ("neutral",), network=unseen, bounds=False, uncertain_bound=found).entries
    assert entry.expected_gap is not None
    planned = compare((), ("mpc",), network=network, bounds=False, uncertain_bound=found)
    assert planned.demand is not None and planned.demand.tolist() == [0.8]
    others: list[tuple[Network, dict[str, Any], str]] = [
        (replace(network, disturbances={"outage": replace(process, values=(1.0, 0.2))}), {}, "the definition of"),
        (replace(network, uncertain={"arcs.lose.rate": replace(numbers["arcs.lose.rate"], high=2.0)}), {}, "lose.rate"),
        (network, {"min_service": 0.9}, "service of 0.9 demanded, not 0.8"),
        (network, {"uncertain": False}, "uncertain numbers not drawn, there drawn"),
        (network, {"episodes": 4}, r"leave out episodes \(4\)"),
        (network, {"futures": 3}, "futures 3: only scenario_mpc plans for them"),
    ]
    for other, options, message in others:
        with pytest.raises(CirlError, match=message):
            compare((), ("neutral",), network=other, bounds=False, uncertain_bound=found, **options)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: named_controller("best_constnt"), "Did you mean 'best_constant'"),
        (lambda: named_controller("price_policy"), r"needs the prices of bound\(…, uncertain=True\)"),
        (lambda: named_controller("neutral", margin=1.1), "a margin goes with scripted, mpc"),
        (lambda: named_controller("mpc", futures=4), "futures go with scenario_mpc"),
        (lambda: MPC(futures=0), "futures must be a whole number of at least 1, got 0"),
        (lambda: MPC(futures=4, replan=2), "only the first decision is carried out"),
        (lambda: MPC(margin=0.0), "margin 0.0 must be positive"),
        (lambda: MPC(reserve=0.0), "reserve 0.0 must be positive"),
        (
            lambda: rollout(MultiAgentVectorEnv(in_use(), num_envs=1), MPC(reserve=1.1), seed=0),
            "reserve 1.1: nothing is disturbed in",
        ),
        (lambda: BestConstant(draws=1), "draws 1: too few"),
    ],
)
def test_bad_input(make: Callable[[], Controller], message: str) -> None:
    """Errors name the option, its value and what may have been meant."""
    with pytest.raises(CirlError, match=message):
        make()


def test_programs_of_too_many_futures_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """With their size, before they are solved."""
    monkeypatch.setattr(futures, "MOST_VARIABLES", 100)
    message = r"the program of 32 futures of 3 intervals has [\d,]+ variables, more than 100"
    with pytest.raises(CirlError, match=message):
        rollout(MultiAgentVectorEnv(works(3), num_envs=1), MPC(min_service=0.5, futures=32))
