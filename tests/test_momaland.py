"""``mo_parallel_env`` under wrappers of MOMAland and one of its algorithms; skipped where it is not installed."""

from __future__ import annotations

import warnings
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from small_networks import city

from cirl_marl import mo_parallel_env
from cirl_marl.environments.multi_objective import MOParallelEnv

pytest.importorskip("momaland.utils", reason="pip install 'cirl-marl[momaland]'")
pytestmark = pytest.mark.filterwarnings("default")


def city_env(**options: Any) -> MOParallelEnv:
    """Return the paper cycle of a city, with four aims."""
    return mo_parallel_env(city().with_options(episode={"horizon": 10}), observe="full", **options)


def episode_rewards(env: Any, seed: int = 0) -> list[dict[str, Any]]:
    """Return the rewards of an episode under random actions."""
    env.reset(seed=seed)
    rng = np.random.default_rng(seed)
    rewards = []
    while env.agents:
        actions = {agent: rng.uniform(-1, 1, 1).astype(np.float32) for agent in env.agents}
        rewards.append(env.step(actions)[1])
    return rewards


def test_the_interface_is_that_of_momaland() -> None:
    """Its test of interfaces passes, agent by agent."""
    from momaland.test.api_test import api_test
    from momaland.utils.conversions import mo_parallel_to_aec

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of names without a number
        api_test(mo_parallel_to_aec(city_env()), num_cycles=25)


def test_linear_rewards_are_weighted_vectors() -> None:
    """And normalised ones are of about one unit after some steps, in the entry and of the agent that are asked for."""
    from momaland.utils.parallel_wrappers import LinearizeReward, NormalizeReward

    vectors = episode_rewards(city_env())
    env, weights = city_env(), np.array([1.0, 100.0, 1e-3, 0.5])
    assert env.reward_space(env.possible_agents[0]).shape == weights.shape
    linear_rewards = episode_rewards(LinearizeReward(env, dict.fromkeys(env.possible_agents, weights)))
    for linear, vector in zip(linear_rewards, vectors, strict=True):
        assert linear == {agent: pytest.approx(float(reward @ weights)) for agent, reward in vector.items()}
    first, *others = env.possible_agents
    normalised = episode_rewards(NormalizeReward(city_env(), first, 2))
    assert abs(normalised[-1][first][2]) < 10.0 < abs(vectors[-1][first][2])
    for normal, vector in zip(normalised, vectors, strict=True):
        np.testing.assert_array_equal(np.delete(normal[first], 2), np.delete(vector[first], 2))
        assert all((normal[agent] == vector[agent]).all() for agent in others)


def test_one_agent_for_all_is_paid_the_sum() -> None:
    """``CentraliseAgent`` makes a multi-objective environment of one agent, as learners of MO-Gymnasium need it."""
    from momaland.utils.parallel_wrappers import CentraliseAgent

    env = CentraliseAgent(city_env())
    observation, _ = env.reset(seed=0)
    assert env.observation_space.shape == observation.shape and env.action_space.shape == (3,)
    single = city_env()
    single.reset(seed=0)
    action = np.array([0.5, -0.5, 0.2], dtype=np.float32)
    reward = env.step(action)[1]
    actions = {agent: action[[k]] for k, agent in enumerate(single.possible_agents)}
    np.testing.assert_allclose(reward, 3 * single.step(actions)[1]["feed"], rtol=1e-6)


@pytest.mark.slow
def test_momappo_trains_for_each_weight() -> None:
    """Trained for emissions alone MOMAland's MAPPO emits less than trained for service alone."""
    name = "momaland.learning.cooperative_momappo.continuous_momappo"
    momappo = pytest.importorskip(name, reason="needs jax, flax, distrax and morl-baselines", exc_type=ImportError)
    import jax

    env = city_env()
    options = {"seed": 0, "num_steps_per_epoch": 100, "timesteps_per_weight": 3000, "update_epochs": 4, "lr": 3e-3}
    options |= {"num_minibatches": 2, "gamma": 0.99, "gae_lambda": 0.95, "clip_eps": 0.2, "ent_coef": 0.0}
    options |= {"vf_coef": 0.5, "max_grad_norm": 0.5, "anneal_lr": False, "debug": False, "track": False}
    momappo.args, momappo.env, momappo.current_timestep = SimpleNamespace(**options), env, 0
    momappo.single_action_space = env.action_space("feed")
    momappo.actor, momappo.critic = momappo.Actor(1, net_arch=[32]), momappo.Critic(net_arch=[32])
    momappo.vmapped_get_value = jax.vmap(momappo.critic.apply, in_axes=(None, 0))
    emissions = []
    for weights in np.eye(4)[[1, 3]]:
        trained = momappo.train(momappo.args, city_env(), weights, jax.random.PRNGKey(0))
        emissions.append(-mean_return(momappo, trained["runner_state"][0])[3])
    assert emissions[1] < 0.8 * emissions[0]


def mean_return(momappo: Any, policy: Any) -> Any:
    """Return what an episode has of each aim under the mean actions of policies that MOMAPPO trained."""
    from supersuit import agent_indicator_v0, clip_actions_v0, normalize_obs_v0

    env = agent_indicator_v0(normalize_obs_v0(clip_actions_v0(city_env()), env_min=-1.0, env_max=1.0))
    observations, _ = env.reset(seed=1)
    total = np.zeros(4)
    while env.agents:
        actions = {
            agent: np.asarray(momappo.actor.apply(policy.params, observation).mode())
            for agent, observation in observations.items()
        }
        observations, rewards, *_ = env.step(actions)
        total += rewards[env.possible_agents[0]]
    return total
