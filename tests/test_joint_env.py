"""One learner that acts for all agents, in Gymnasium's environments: alone, in a batch, and behind its wrappers."""

from __future__ import annotations

from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils.env_checker import check_env
from gymnasium.utils.env_match import check_environments_match
from gymnasium.vector import AutoresetMode
from gymnasium.wrappers.vector import (
    DictInfoToList,
    NormalizeObservation,
    RecordEpisodeStatistics,
)
from small_networks import ONE_OF_EACH

from cirl_marl import CirlError, ControlError, JointEnv, JointVectorEnv, Network, Node, parallel_env, vector_env
from cirl_marl.learners.views import AllAtOnce

SAME_STEP = AutoresetMode.SAME_STEP
UNCERTAIN = "steel_japan"
"""A network that draws numbers."""


@pytest.mark.medium
@pytest.mark.filterwarnings("ignore:.*observation space (minimum )?(maximum )?value is -?infinity")
@pytest.mark.filterwarnings("ignore:.*not including the .* infinite")
@pytest.mark.parametrize("name", ONE_OF_EACH)
def test_gymnasiums_own_check(name: str) -> None:
    """Spaces, seeds and determinism are as Gymnasium asks; two are alike."""
    check_env(JointEnv(name, horizon=4, render_mode="rgb_array"), skip_render_check=True)
    check_environments_match(JointEnv(name), JointEnv(name), num_steps=5, seed=1)


@pytest.mark.parametrize("name", ["copper_net", UNCERTAIN])
@pytest.mark.parametrize("mode", ["NextStep", SAME_STEP])
def test_a_batch_is_so_many_alone(name: str, mode: AutoresetMode | str) -> None:
    """Observations, rewards, ends and infos are the same bits, restarts included."""
    options: dict[str, Any] = {"horizon": 3, "uncertain": name == UNCERTAIN}
    envs = JointVectorEnv(name, 3, autoreset_mode=mode, **options)
    alone = gymnasium.vector.SyncVectorEnv(
        [lambda: JointEnv(name, **options) for _ in range(3)], autoreset_mode=AutoresetMode(mode)
    )
    assert envs.single_observation_space == alone.single_observation_space
    assert envs.observation_space == alone.observation_space
    assert envs.action_space == alone.action_space
    assert envs.metadata["autoreset_mode"] is AutoresetMode(mode)
    envs.action_space.seed(0)
    pairs: list[tuple[Any, Any]] = [(envs.reset(seed=5), alone.reset(seed=5))]
    for _ in range(8):
        actions = envs.action_space.sample()
        pairs.append((envs.step(actions), alone.step(actions)))
    for ours, theirs in pairs:
        for mine, other in zip(ours[:-1], theirs[:-1], strict=True):
            np.testing.assert_array_equal(mine, other)
        assert_same_infos(ours[-1], theirs[-1])


def assert_same_infos(ours: dict[str, Any], theirs: dict[str, Any]) -> None:
    """Fail unless vector infos agree; masks of what every copy has may be left out."""
    assert {key for key in ours if key[0] != "_"} == {key for key in theirs if key[0] != "_"}
    for key, value in ours.items():
        if isinstance(value, dict):
            assert_same_infos(value, theirs[key])
        elif value.dtype == object:
            np.testing.assert_array_equal(np.stack(value), np.stack(theirs[key]))
        else:
            np.testing.assert_array_equal(value, theirs[key])


def test_what_is_joint() -> None:
    """Observations and actions one agent after the other, the mean of the rewards, as for learners of joint recipes."""
    envs, apart = JointVectorEnv("carbo_net", 4, reward="mixed"), vector_env("carbo_net", 4, reward="mixed")
    view = AllAtOnce(apart, apart.agents)
    assert envs.single_observation_space == view.observation_space
    assert envs.single_action_space == view.action_space
    envs.action_space.seed(3)
    np.testing.assert_array_equal(envs.reset(seed=2)[0], view.rows(apart.reset(2)))
    for _ in range(3):
        actions = envs.action_space.sample()
        observation, reward, *_, infos = envs.step(actions)
        observations, rewards, _, _, by_agent = apart.step(view.act(actions))
        np.testing.assert_array_equal(observation, view.rows(observations))
        np.testing.assert_allclose(reward, view.score(rewards), rtol=1e-14)
        assert {*infos, "local_reward"} == {*by_agent[apart.agents[0]]}


def test_gymnasiums_wrappers() -> None:
    """Statistics, normalisation and lists of infos, around what ``make_vec`` makes."""
    envs = gymnasium.make_vec("cirl_marl/copper_net-v0", num_envs=3, horizon=4)
    assert isinstance(envs.unwrapped, JointVectorEnv)
    assert str(envs) == envs.metadata["name"] == "copper_net"
    record = RecordEpisodeStatistics(envs)
    normal = NormalizeObservation(record)
    observations, _ = normal.reset(seed=1)
    total = np.zeros(3)
    for step in range(1, 10):
        observations, rewards, _, truncations, infos = normal.step(normal.action_space.sample())
        assert normal.observation_space.contains(observations)
        total += rewards
        assert truncations.all() == (step % 5 == 4)
        if truncations.all():
            np.testing.assert_allclose(infos["episode"]["r"], total, rtol=1e-12)
            assert (infos["episode"]["l"] == 4).all()
        if step % 5 == 0:
            assert not rewards.any()
            total[:] = 0.0
    same = gymnasium.make_vec("cirl_marl/copper_net.paper-v0", num_envs=2, horizon=2, autoreset_mode="SameStep")
    listed = DictInfoToList(same)
    listed.reset(seed=0)
    listed.step(same.action_space.sample())
    last = listed.step(same.action_space.sample())[-1]
    assert last[1]["final_obs"].shape == same.single_observation_space.shape
    assert "episode_circularity" in last[1]["final_info"]


def test_costs_are_shortfalls() -> None:
    """``cost`` is what lacks of all services, alone and in a batch."""
    alone, batch = parallel_env("carbo_net"), vector_env("carbo_net", num_envs=2)
    alone.reset(seed=1)
    batch.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(4):
        actions = {a: rng.uniform(-1, 1, space.shape) for a, space in alone.action_spaces.items()}
        info = alone.step(actions)[4][alone.agents[0] if alone.agents else alone.possible_agents[0]]
        infos = batch.step({a: np.tile(x, (2, 1)) for a, x in actions.items()})[4]
        for agent in batch.agents:
            levels = infos[agent]["service_levels"]
            assert [*levels] == [service.id for service in batch.network.services]
            for service, level in levels.items():
                np.testing.assert_array_equal(infos[agent][f"cost_{service}"], 1.0 - level)
                assert info["service_levels"][service] == level[0]
                assert isinstance(info[f"cost_{service}"], float)
            np.testing.assert_allclose(infos[agent]["cost"], sum(1.0 - level for level in levels.values()))
        assert info["cost"] == infos[batch.agents[0]]["cost"][0] > 0


def test_what_is_refused() -> None:
    """Options, actions and networks that cannot be used, before anything moves."""
    with pytest.raises(CirlError, match=r"unknown autoreset_mode 'NexStep'\. Did you mean 'NextStep'"):
        JointVectorEnv("copper_net", autoreset_mode="NexStep")
    with pytest.raises(CirlError, match="unknown autoreset_mode 'Disabled'"):
        JointVectorEnv("copper_net", autoreset_mode=AutoresetMode.DISABLED)
    with pytest.raises(CirlError, match="unknown option 'horizn'"):
        gymnasium.make_vec("cirl_marl/copper_net-v0", num_envs=2, horizn=3)
    with pytest.raises(CirlError, match="nothing can act"):
        JointVectorEnv(Network(name="idle", nodes=(Node(id="x", initial=(1.0, 1.0)),), arcs=()))
    env, envs = JointEnv("copper_net"), JointVectorEnv("copper_net", 2)
    for acting in (env, envs):
        acting.reset(seed=0)
        with pytest.raises(ControlError, match=r"joint action has shape .* expected"):
            acting.step(np.zeros(3))
        with pytest.raises(ControlError, match="must hold numbers"):
            acting.step(np.full(acting.action_space.shape or (), "x"))
        actions = np.zeros(acting.action_space.shape or ())
        with pytest.raises(ControlError, match="joint action is masked in part"):
            acting.step(np.ma.masked_array(actions, mask=True))
        with pytest.raises(ControlError, match="joint action is no array of numbers"):
            acting.step(torch.zeros(actions.shape, requires_grad=True))
    with pytest.raises(ControlError, match="must be a number in"):
        env.step(np.full(env.action_space.shape or (), np.nan))
    with pytest.raises(ControlError, match="seed"):
        env.reset(seed="x")  # type: ignore[arg-type]
    with pytest.raises(ControlError, match="2 of them"):
        envs.reset(seed=[1])
