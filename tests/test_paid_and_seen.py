"""What agents are paid and shown, in cases in which a wrong term shows: uneven weights, batches, a second episode."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cirl_marl import (
    Arc,
    Control,
    ControlKind,
    Episode,
    Law,
    MultiAgentVectorEnv,
    Network,
    Node,
    Role,
    Service,
)
from cirl_marl.learners.lockstep import Lockstep, NetworkWorld, Participant, Streams

VALVE = Control(kind=ControlKind.RATE, low=0.0, neutral=1.0, high=2.0)
SHIPPED = Network(
    name="shipped",
    nodes=(
        Node(id="mine", role=Role.NONRENEWABLE_RESERVOIR, initial=(90.0, 90.0), scale=9.0, control=VALVE),
        Node(id="works", initial=(7.0, 7.0), scale=2.0),
    ),
    arcs=(
        Arc(
            id="ship",
            donor="mine",
            recipient="works",
            law=Law.BATCH,
            batches=((0.0, 30.0), (0.5, 12.0)),
            delay=0.5,
            scale=10.0,
        ),
        Arc(id="belt", donor="mine", recipient="works", rate=0.1, scale=4.0, control=VALVE),
    ),
    episode=Episode(control_interval=0.5, horizon=4),
)
"""A mine that ships batches and feeds a belt."""


@pytest.mark.parametrize("circularity", ["end", "mean"])
@given(network=st.from_type(Network), seed=st.integers(0, 1000))
@example(network=SHIPPED, seed=0)
@pytest.mark.sample(1)
def test_who_is_neutral_makes_no_difference(circularity: str, network: Network, seed: int) -> None:
    """D = λ − λ had the agent been neutral is 0 for whoever is, whatever the others do and has been shipped before."""
    env = MultiAgentVectorEnv(network, num_envs=2, reward="difference", circularity=circularity)
    env.reset(seed)
    rng = np.random.default_rng(seed)
    for _ in range(network.episode.horizon):
        neutral = env.stack(env.neutral_action)
        idle = rng.random(len(neutral)) < 0.5
        outcome = env.advance(np.where(idle[:, None], neutral, rng.uniform(-1, 1, (len(neutral), 2))))
        size = np.abs(outcome.circularity) + np.abs(outcome.circularity_mean) + np.abs(env.physical.stock).sum(axis=0)
        # the neutral action is the neutral control to round-off, and what was shipped is a sum of its own
        assert (np.abs(outcome.reward[idle]) <= 1e-9 * (1 + size) * network.objective.reference_interval + 1e-9).all()


def test_mixed_reward_with_uneven_weights() -> None:
    """The reward is w·λ/scale + (1 − w)·local with w = 0.9; at a half nobody could tell the weights apart."""
    env = MultiAgentVectorEnv("carbo_net", num_envs=2, reward="mixed", circularity_weight=0.9)
    env.reset(3)
    rng = np.random.default_rng(0)
    for _ in range(4):
        outcome = env.advance(rng.uniform(-1, 1, (len(env.agents), 2)))
        expected = 0.9 * outcome.circularity / env.network.objective.circularity_scale + 0.1 * outcome.local
        np.testing.assert_allclose(outcome.reward, expected, rtol=1e-12, atol=1e-15)


def test_an_arc_sees_both_its_ends() -> None:
    """Its own flow, then the stocks that it leads from and to, each divided by the scale of its compartment."""
    env = MultiAgentVectorEnv(SHIPPED, num_envs=1, agents=["belt"], observe="local")
    env.reset(0)
    assert env.observation_names["belt"] == ("flow of belt", "stock of mine", "stock of works", "time")
    outcome = env.advance(np.zeros((1, 1)))
    stock = env.physical.stock[:2, 0]
    expected = [outcome.flow[1, 0] / 4.0, stock[0] / 9.0, stock[1] / 2.0, 0.25]
    np.testing.assert_allclose(outcome.observation[:, 0], expected, rtol=1e-6)


def test_a_countdown_tells_the_last_intervals_apart() -> None:
    """It is 1/(intervals left), and stands last; an option of the environment goes before the network's own."""
    short = SHIPPED.with_options(observation={"mode": "local"}, episode={"horizon": 3})
    network = short.with_options(observation={"countdown": True})
    stocks = short.with_options(observation={"mode": "stocks", "nodes": ("mine",)})
    for world, option, before in ((network, None, "time"), (short, True, "time"), (stocks, True, "stock of mine")):
        env = MultiAgentVectorEnv(world, num_envs=2, agents=["belt"], countdown=option)
        first = env.reset(0)["belt"]
        assert env.observation_names["belt"][-2:] == (before, "countdown") and not env.layout.array_order
        seen = [first[0, -1], *(env.advance(np.zeros((1, 2))).observation[-1, 0] for _ in range(2))]
        np.testing.assert_allclose(seen, [1 / 3, 1 / 2, 1.0], rtol=1e-6)
    for world, option in ((network, False), (short, None)):
        without = MultiAgentVectorEnv(world, num_envs=2, agents=["belt"], countdown=option)
        assert without.observation_names["belt"][-1] == "time"


def test_a_delivery_is_seen_as_a_mass() -> None:
    """What a batch arc delivers in an interval is shown divided by its scale, not by the length of the interval."""
    env = MultiAgentVectorEnv(SHIPPED, num_envs=1, agents=["mine"], observe="full")
    env.reset(0)
    seen = env.observation_names["mine"].index("flow of ship")
    assert [env.advance(np.zeros((1, 1))).observation[seen, 0] for _ in range(3)] == pytest.approx([3.0, 1.2, 0.0])


def test_an_episode_reports_the_means_over_its_own_steps() -> None:
    """λ̄ and the service level of an episode are means over its intervals; those of the one before do not count."""
    env = MultiAgentVectorEnv("carbo_net", num_envs=2, horizon=3)
    env.reset(0)
    rng = np.random.default_rng(0)
    service: list[Any] = []
    twin = MultiAgentVectorEnv("carbo_net", num_envs=2, horizon=3)
    twin.reset(0)
    mean: list[Any] = []
    for step in range(1, 10):
        actions = rng.uniform(-1, 1, (len(env.agents), 2))
        outcome = twin.advance(actions)
        mean.append(outcome.circularity_mean)
        service.append(outcome.service_level)
        infos = env.step(env.unstack(actions))[4][env.agents[0]]
        if step % 3 == 0:
            np.testing.assert_allclose(infos["episode_circularity"], np.mean(mean[-3:], axis=0), rtol=1e-12)
            np.testing.assert_allclose(infos["episode_service_level"], np.mean(service[-3:], axis=0), rtol=1e-12)
            twin.reset()


def test_a_second_episode_has_a_return_of_its_own() -> None:
    """The return and the length that a learner is told are those of the episode that ended, and of no other."""
    world = NetworkWorld(MultiAgentVectorEnv("carbo_net", num_envs=2, horizon=4), seeds=[1, 2])
    seen: dict[str, list[Any]] = {name: [] for name in world.agent_envs}

    def learner(name: str, steps: int) -> None:
        agent_env = world.agent_envs[name]
        agent_env.reset()
        for step in range(steps):
            seen[name].append(agent_env.step(np.full((2, 1), 0.5 * (-1) ** step, dtype=np.float32)))

    acting = [
        Participant(name, partial(learner, name, 12), partial(learner, name, 10**6), Streams(i))
        for i, name in enumerate(world.agent_envs)
    ]
    Lockstep([world], acting).run()
    for told in seen.values():
        for end in (4, 8, 12):
            rewards = np.sum([reward for _, reward, _, _ in told[end - 4 : end]], axis=0, dtype=np.float64)
            infos = [info["episode"] for info in told[end - 1][3]]
            assert [info["l"] for info in infos] == [4, 4]
            np.testing.assert_allclose([info["r"] for info in infos], rewards, rtol=1e-5)


@pytest.mark.parametrize(("stock", "low", "level"), [(0.25, 0.0, 1.0), (16.0, 0.0, 0.5), (0.25, 0.5, 0.5)])
def test_a_band_from_nothing_has_no_lower_end(stock: float, low: float, level: float) -> None:
    """Little is enough where the band begins at 0; above the band the level is high/q."""
    network = Network(
        name="band",
        nodes=(Node(id="heap", initial=(stock, stock)),),
        arcs=(),
        services=(Service(id="kept", provider="heap", quantity="stock", low=low, high=8.0),),
    )
    env = MultiAgentVectorEnv(network, num_envs=1)
    env.reset(0)
    assert env.advance(np.zeros((0, 1))).service_level[0] == pytest.approx(level)
