"""A world of orders ahead, spoilage and regimes that spread differently, in which plans for what is expected lack."""

from __future__ import annotations

import itertools
from typing import Any

import numpy as np
import pytest

from benchmarks.food_bank import NORMAL, BestOrders, SafetyStock
from benchmarks.uncertain import Supplied
from cirl_marl import MultiAgentVectorEnv, load_network
from cirl_marl.controllers import Constant, Controller, ScriptController
from cirl_marl.controllers.rollout import Rollout, first_seed, rollout
from cirl_marl.network import Floats
from cirl_marl.optimum.mpc import MPC


def played(controller: Controller, copies: int, horizon: int) -> Rollout:
    """Return episodes in the disturbed world."""
    network = load_network("food_bank").scenario("gluts").with_options(episode={"horizon": horizon})
    return rollout(MultiAgentVectorEnv(network, num_envs=copies), controller, seed=first_seed(3))


def test_regimes_have_one_mean_and_two_spreads() -> None:
    """What is expected tomorrow says nothing of the regime; how far it may be off says all."""
    (surplus,) = (d for id_, d in load_network("food_bank").scenario("gluts").disturbances.items() if id_ == "surplus")
    matrix, values = np.array(surplus.matrix), np.array(surplus.values)
    np.testing.assert_allclose(matrix @ values, 1.0, rtol=1e-12)
    calm, glut, shortage = np.sqrt(matrix @ (values - 1.0) ** 2)
    assert glut == shortage > 4 * calm


def test_orders_come_a_day_later_and_who_orders_sees_the_store() -> None:
    """The flow that arrives is the one ordered the day before; the agent sees its stock on the way and beyond it."""
    env = MultiAgentVectorEnv("food_bank", num_envs=3, scenario="gluts", observe="local")
    assert {"stock of on_the_way", "stock of store"} < set(env.observation_names["ordering"])
    observations, random, arcs = env.reset(seed=1), np.random.default_rng(0), env.network.arc_index
    store, entry = env.network.node_index["store"], env.observation_names["ordering"].index("stock of store")
    ordered = np.full(3, 7.0)
    for _ in range(5):
        np.testing.assert_allclose(observations["ordering"][:, entry], env.physical.stock[store] / 20, rtol=1e-6)
        observations = env.by_agent(env.advance(random.uniform(-1, 1, (3, 3))).observation)
        np.testing.assert_allclose(env.physical.flow[arcs["arriving"]], ordered, rtol=1e-9)
        ordered = env.physical.flow[arcs["ordering"]].copy()


def test_who_looks_serves_more_from_less() -> None:
    """Whatever is ordered and served every day: at no less service it costs more than the rule."""
    rule = played(ScriptController(margin=1.4), 64, 63)
    level, circularity = rule.episode_levels.mean(), rule.episode_circularity.mean()
    dearer = 0
    for ordering, serving in itertools.product((-0.5, -0.2, 0.1, 0.4), (0.1, 0.3)):
        blind = played(Constant({"ordering": ordering, "collecting": 1.0, "serving": serving}), 64, 63)
        assert blind.episode_circularity.mean() < circularity - 1.0 or blind.episode_levels.mean() < level - 0.005
        dearer += blind.episode_levels.mean() >= level
    assert dearer


def test_plans_for_what_is_expected_keep_nothing_back_unless_told() -> None:
    """However dear a shortage is, MPC holds less in store than where more is demanded in the days to come."""
    dear, kept_back = (
        played(MPC(min_service=0.99, margin=10.0, reserve=reserve), 3, 10).episode_levels.mean()
        for reserve in (1.0, 1.4)
    )
    assert kept_back > dear + 0.02


def test_a_reserve_is_for_the_days_to_come() -> None:
    """Of today no more is served than is demanded, though twice as much of what comes after is planned for."""
    env = MultiAgentVectorEnv("food_bank", num_envs=4, scenario="gluts", horizon=6)
    planner = MPC(min_service=0.99, reserve=2.0)
    observations = env.reset(seed=5)
    planner.start(env, 0)
    outcome = env.advance(env.stack(planner.act(observations)))
    guests = env.team_info(outcome)["disturbances"]["guests"]
    served = outcome.flow[env.network.arc_index["serving"]]
    np.testing.assert_array_less(served, 20.0 * guests * 1.001)
    assert (served > 10.0).all()


def test_a_safety_stock_follows_what_is_known_of_the_spread() -> None:
    """In each copy that is done which MPC does with the reserve of its regime: five times as much in wild weeks."""
    network = load_network("food_bank").scenario("gluts")
    options: dict[str, Any] = {"min_service": 0.99, "margin": 3.0}
    env = MultiAgentVectorEnv(network, num_envs=8, horizon=4)
    observations = env.reset(seed=5)
    regimes, values = env.physical.processes[0, 0].astype(int), np.array([1.0, 1.7, 0.3])
    assert len(set(regimes.tolist())) == 3
    controllers: list[Controller] = [SafetyStock(env.network, options)]
    chances = np.array([[0.96, 0.02, 0.02], [0.1, 0.45, 0.45]])
    spread = np.hypot(0.7 * np.sqrt(chances @ (values - 1.0) ** 2), 0.06)  # seven tenths of what is wanted; 0.1·0.6
    controllers += [MPC(reserve=1.0 + NORMAL * deviation, **options) for deviation in spread.tolist()]
    orders = []
    for controller in controllers:
        controller.start(env, 0)
        orders.append(controller.act(observations)["ordering"][:, 0])
    np.testing.assert_allclose(orders[0], np.where(regimes == 0, orders[1], orders[2]), atol=1e-9)
    assert (orders[2] > orders[1]).any()


@pytest.mark.slow
def test_dynamic_programming_expects_what_comes_about_and_nobody_does_better() -> None:
    """Its value is the mean of its episodes, and no rule and no order of a quarter more or less has more."""
    network = load_network("food_bank").scenario("gluts")
    env, best = MultiAgentVectorEnv(network, num_envs=512), BestOrders(network)
    env.reset(seed=first_seed(3))
    expected = best.expected(env).mean()

    def worth(controller: Controller) -> Floats:
        run = rollout(env, controller, seed=first_seed(3))
        return run.episode_circularity + best.price * run.episode_levels[:, 0]

    own = worth(best)
    assert abs(own.mean() - expected) < 3.0 * own.std() / 512**0.5
    for other in (ScriptController(margin=1.3), Supplied(best, ["ordering"], 0.75), Supplied(best, ["ordering"], 1.25)):
        less = own - worth(other)
        assert less.mean() > 3.0 * less.std() / 512**0.5
