"""The best plan found: against the proved bound, against its candidates, on every network; and what it refuses."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from numpy.typing import NDArray
from small_networks import PLAYED

from cirl_marl import Arc, CirlError, ControlError, MultiAgentVectorEnv, Network, Node, Role, load_network
from cirl_marl.controllers import Neutral, Random
from cirl_marl.controllers.rollout import EVALUATION_SEEDS, rollout
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum import Incumbent, Plan, bound, search, search_each, standard_candidates
from cirl_marl.optimum.cross_entropy import SHORTFALL_PRICE, Gaussians, knot_counts
from cirl_marl.optimum.open_loop import Optimum
from cirl_marl.optimum.planned_episodes import Population, starting_states

EVERYWHERE = PLAYED


@pytest.mark.sample(4)
@pytest.mark.parametrize(("name", "scenario"), EVERYWHERE)
@pytest.mark.medium
def test_plan_achieves_what_it_says_and_no_less_than_its_candidates(name: str, scenario: str | None) -> None:
    """In each network a lone copy that replays the plan earns the figures that it was chosen for."""
    found = search(name, scenario=scenario, horizon=6, service_weight=1.0, knots=2, population=8, iterations=2)
    network = load_network(name, scenario=scenario).with_options(episode={"horizon": 6})
    env = MultiAgentVectorEnv(expected_network(network), num_envs=1)
    run = rollout(env, Plan(found))
    assert run.episode_circularity[0] == pytest.approx(found.circularity, rel=1e-12)
    assert run.episode_service[0] == pytest.approx(found.service, rel=1e-12)
    scale = found.network.objective.circularity_scale
    reached = found.circularity / scale + found.service
    assert set(found.candidates) == set(standard_candidates(env.agents))
    assert reached >= max(circularity / scale + service for circularity, service in found.candidates.values())
    neutral = rollout(env, Neutral())
    expected = float(neutral.episode_circularity[0]), float(neutral.episode_service[0])
    assert found.candidates["neutral"] == pytest.approx(expected, rel=1e-12)
    assert found.evaluations == 4 + 2 * 8
    assert "no certificate" in str(found)


@pytest.mark.sample(1)
@pytest.mark.parametrize(("name", "gap"), [("copper_net", 0.1), ("carbo_net", 0.02)])
@pytest.mark.medium
def test_comes_close_to_the_bound(name: str, gap: float) -> None:
    """Ten days: where there is a bound the plan stays below it, and not far."""
    proved = bound(name, service_weight=2.0, horizon=40)
    nodes = dict(zip(proved.network.node_index, proved.initial.tolist(), strict=True))
    found = search(name, nodes, service_weight=2.0, horizon=40, knots=8, population=64, iterations=80)
    assert 0 <= proved.gap(found.circularity, found.service)[()] < gap


def test_demanded_service_is_charged() -> None:
    """With a demanded level the merit is λ̄/scale less the stated price of what is missing, and the plan serves it."""
    shares: list[float] = []
    best: list[float] = []

    def progress(share: float, merit: NDArray[np.float64]) -> None:
        shares.append(share)
        best.append(float(merit[0]))

    found = search(
        "carbo_net",
        min_service=0.9,
        horizon=20,
        knots=4,
        iterations=20,
        progress=progress,
    )
    assert len(best) == 21 * 20 + 1  # intervals of the candidates and of each iteration
    assert shares == sorted(shares) and shares[-1] == 1.0 and best[0] == -np.inf
    assert best == sorted(best)
    missing = np.maximum(0.0, 0.9 - found.levels).sum()
    assert best[-1] == pytest.approx(found.circularity / 1420.0 - SHORTFALL_PRICE * missing)
    assert missing < 1e-3


def test_same_seed_finds_the_same_plan() -> None:
    """A seed gives one plan, bit for bit; another seed another."""
    first, again, other = (
        search("copper_net", horizon=8, knots=4, population=16, iterations=4, seed=seed) for seed in (3, 3, 4)
    )
    np.testing.assert_array_equal(first.actions, again.actions)
    assert first.circularity == again.circularity
    assert (first.actions != other.actions).any()


@pytest.mark.medium
def test_starts_are_searched_side_by_side_as_they_are_alone() -> None:
    """Plans from three starts, inner states included, equal those found one by one, and each copy follows its own."""
    env = MultiAgentVectorEnv("net_zero", num_envs=3, horizon=4)
    env.reset(seed=EVALUATION_SEEDS)
    starts = starting_states(env)
    assert (starts[0] != starts[1]).any()
    together = search_each(env.network, starts, knots=2, population=8, iterations=2)
    for found, start in zip(together, starts, strict=True):
        alone = search(env.network, start, knots=2, population=8, iterations=2)
        np.testing.assert_array_equal(found.actions, alone.actions)
        np.testing.assert_array_equal(found.initial, start)
    run = rollout(env, Plan(together))
    np.testing.assert_allclose(run.episode_circularity, [found.circularity for found in together], rtol=1e-12)


def test_starts_by_name() -> None:
    """Stocks and inner states may be given by name; the others are those of the first evaluated episode."""
    first = search("net_zero", horizon=2, knots=1, iterations=0)
    env = MultiAgentVectorEnv("net_zero", num_envs=1, horizon=2)
    named = env.state_names[len(env.network.nodes)]
    row = len(env.network.nodes)
    other = search("net_zero", {named: first.initial[row] * 1.01}, horizon=2, knots=1, iterations=0)
    changed = np.flatnonzero(other.initial != first.initial)
    assert changed.tolist() == [row]
    env.reset(seed=EVALUATION_SEEDS)
    with pytest.raises(ControlError, match=f"in '{named}'"):
        Plan(other).start(env, 0)


def test_optimum_control_searches_where_nothing_is_proved(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each copy of net_zero follows the plan found from its own start, and the controller says that it is no more."""
    monkeypatch.setattr("cirl_marl.optimum.open_loop.search_each", partial(search_each, population=8, iterations=2))
    controller = Optimum(service_weight=1.0)
    run = rollout(MultiAgentVectorEnv("net_zero", num_envs=2, horizon=3), controller)
    assert controller.note.startswith("best plan found, no certificate: network 'net_zero'")
    found = [plan.circularity for plan in controller.plans if isinstance(plan, Incumbent)]
    assert len(found) == 2
    np.testing.assert_allclose(run.episode_circularity, found, rtol=1e-12)
    rollout(MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=3), controller)
    assert controller.note == ""


def test_any_controller_may_be_a_candidate() -> None:
    """A random controller can only be replayed: the plan is what it did in the best copy."""
    found = search("carbo_net", horizon=5, candidates={"random": Random()}, population=8, iterations=2, knots=1)
    assert found.origin == "random"
    env = MultiAgentVectorEnv("carbo_net", num_envs=1, horizon=5)
    assert rollout(env, Plan(found)).episode_circularity[0] == pytest.approx(found.circularity, rel=1e-12)


def test_actions_are_cut_to_their_bounds_and_deviations_with_them() -> None:
    """Added to neutral control, 0.1 for three decisions and 5 for three: the latter comes through as 1 − neutral."""
    network = load_network("copper_net").with_options(episode={"horizon": 6})
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(seed=EVALUATION_SEEDS)
    copies = Population(network, None, starting_states(env), 2)
    neutral = np.concatenate([each[0] for each in env.neutral_action.values()])
    added = np.zeros((1, 2, 2, copies.entries))
    added[0, 1, 0, 0], added[0, 1, 1, 0] = -0.1, 5.0
    run = copies.run([Neutral()], np.zeros((1, 2), dtype=int), added)
    np.testing.assert_allclose(run.deviation[0, 1, :, 0], [-0.1, 1.0 - neutral[0]], atol=1e-12)
    np.testing.assert_allclose(run.actions[:, :, 0, 0], np.tile(neutral, (6, 1)))
    np.testing.assert_allclose(run.actions[:, 0, 0, 1], [neutral[0] - 0.1] * 3 + [1.0] * 3)
    assert not run.deviation[0, 0].any()


def test_method_finds_the_top_of_a_parabola() -> None:
    """Without a simulator: the optimum of −Σ(θ − θ*)² in 8 knots and 2 entries, refined from constants."""
    target = np.linspace(-0.6, 0.6, 16).reshape(8, 2)

    def merit(deviation: np.ndarray) -> np.ndarray:
        fine = np.repeat(deviation, 8 // deviation.shape[2], axis=2)
        result: np.ndarray = -((fine - target) ** 2).sum(axis=(2, 3))
        return result

    gaussians = Gaussians(merit(np.zeros((1, 1, 1, 2)))[:, 0], 64, 2, seed=0)
    best = -np.inf
    for knots in knot_counts(8, 80):
        gaussians.refine(knots)
        drawn = gaussians.draw()
        gaussians.learn(merit(drawn), drawn)
        best = max(best, float(merit(drawn).max()))
    assert best > -1e-3


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"population": 7}, "population must be a whole number of at least 8, got 7"),
        ({"iterations": -1}, "iterations"),
        ({"knots": 0}, "knots"),
        ({"knots": 9, "horizon": 8}, "more than the 8 decisions"),
        ({"candidates": {}}, "at least one controller"),
        ({"service_weight": 1.0, "min_service": 0.5}, "two ways"),
        ({"min_service": 1.5}, "min_service"),
        ({"initial": {"minne": 3.0}}, "Did you mean 'mine'"),
        ({"initial": {"mine": -3.0}}, "not negative"),
        ({"initial": [1.0, 2.0]}, "shape"),
        ({"agents": ["miner"]}, "unknown agent 'miner'"),
    ],
)
def test_bad_input(options: dict[str, object], said: str) -> None:
    """Options that cannot be used are named."""
    with pytest.raises(CirlError, match=said):
        search("copper_net", **options)  # type: ignore[arg-type]


def test_nobody_acts() -> None:
    """Without a controllable compartment there is nothing to search for."""
    nodes = (
        Node(id="use", role=Role.TECHNOSPHERE, initial=(1.0, 1.0)),
        Node(id="tip", role=Role.LANDFILL, initial=(0.0, 0.0)),
    )
    still = Network(name="still", nodes=nodes, arcs=(Arc(id="loss", donor="use", recipient="tip", rate=0.1),))
    with pytest.raises(CirlError, match="nobody acts"):
        search(still, knots=1)
