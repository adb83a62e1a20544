"""Shared policies, joint learners and central critics: what they see, what they learn, how they act alone."""

from __future__ import annotations

import warnings
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from small_networks import ONE_OF_EACH
from stable_baselines3 import PPO
from stable_baselines3.common.callbacks import BaseCallback

import cirl_marl
from cirl_marl import DefinitionError, MultiAgentVectorEnv, Network, vector_env
from cirl_marl.controllers.rollout import rollout
from cirl_marl.learners.interface import Trained, train
from cirl_marl.learners.lockstep import Lockstep, NetworkWorld, Participant, Streams
from cirl_marl.learners.policies import CentralCriticPolicy
from cirl_marl.learners.recipe import LearnerSettings, Match, Normalisation, Recipe, Run, load_recipe
from cirl_marl.learners.trainer import Training
from cirl_marl.learners.views import AllAtOnce, OneAgent, SharedPolicy, View, unseen_state

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    from supersuit import agent_indicator_v0, pad_action_space_v0, pad_observations_v0

SMALL: dict[str, Any] = {"n_steps": 8, "batch_size": 16, "n_epochs": 1, "policy_kwargs": {"net_arch": [8]}}
NOTHING = Normalisation(observation=False, reward=False)
JOINT_RECIPES = ["shared_ppo", "shared_ars", "joint_ppo", "joint_sac", "mappo", "independent_ars"]


@pytest.mark.parametrize("name", ONE_OF_EACH)
@pytest.mark.filterwarnings("ignore")
def test_shared_policy_sees_and_does_what_supersuit_pads(name: str) -> None:
    """Observations, actions and rewards of the batched view are those of SuperSuit's wrappers around PettingZoo."""
    plain = cirl_marl.parallel_env(name, horizon=4)
    theirs: Any = agent_indicator_v0(pad_action_space_v0(pad_observations_v0(plain)))
    ours = vector_env(name, num_envs=1, horizon=4)
    view = SharedPolicy(ours, ours.agents)
    agents, rng = list(ours.agents), np.random.default_rng(0)
    longest = max(space.shape[0] for space in ours.observation_spaces.values())
    assert view.observation_space.shape == theirs.observation_space(agents[0]).shape
    assert view.action_space.shape == theirs.action_space(agents[0]).shape
    seen, _ = theirs.reset(seed=5)
    rows = view.observe(ours.reset(seed=5), ours.state)
    for _ in range(3):
        assert isinstance(rows, np.ndarray)
        for row, agent in zip(rows, agents, strict=True):
            np.testing.assert_array_equal(row[:longest], seen[agent][:longest])
            np.testing.assert_array_equal(row[longest:], seen[agent][longest:] != 0)
        actions = rng.uniform(-1, 1, (len(agents), view.action_space.sample().size)).astype(np.float32)
        seen, paid, *_ = theirs.step(dict(zip(agents, actions, strict=True)))
        observations, rewards, *_ = ours.step(view.act(actions))
        rows = view.observe(observations, ours.state)
        assert view.score(rewards).tolist() == [paid[agent] for agent in agents]


@given(network=st.from_type(Network), copies=st.integers(1, 3), seed=st.integers(0, 1000))
def test_views_lose_nothing(network: Network, copies: int, seed: int) -> None:
    """Whatever the view, each agent's observation, action and reward is in its place, in every copy."""
    env = MultiAgentVectorEnv(network, num_envs=copies)
    observations, rng = env.reset(seed=seed), np.random.default_rng(seed)
    rewards = {agent: rng.normal(size=copies) for agent in env.agents}
    views: list[View] = [SharedPolicy(env, env.agents), AllAtOnce(env, env.agents)]
    views += [OneAgent(env, agent) for agent in env.agents]
    for view in [*views, *(kind(env, env.agents).with_state(env) for kind in (SharedPolicy, AllAtOnce))]:
        rows = view.observe(observations, env.state)
        if isinstance(rows, dict):
            assert (rows["state"][:copies] == env.state()).all() and (rows["state"][-copies:] == env.state()).all()
            rows = rows["observation"]
        per_copy = max(1, len(view.row_agents))
        assert len(rows) == len(view.score(rewards)) == per_copy * copies
        actions = rng.uniform(-1, 1, (len(rows), *(view.action_space.shape or ())))
        done = view.act(actions)
        assert set(done) == set(view.agents)
        for agent, again in view.act(view.join(done)).items():
            np.testing.assert_array_equal(again, done[agent].astype(np.float32))
        column = 0
        for a, agent in enumerate(view.agents):
            entries = env.action_spaces[agent].shape[0]
            mine, reward = rows[a * copies : (a + 1) * copies], view.score(rewards)[a * copies : (a + 1) * copies]
            if view.row_agents:
                np.testing.assert_array_equal(mine[:, : observations[agent].shape[1]], observations[agent])
                np.testing.assert_array_equal(done[agent], actions[a * copies : (a + 1) * copies, :entries])
                np.testing.assert_array_equal(reward, rewards[agent])
            else:
                np.testing.assert_array_equal(done[agent], actions[:, column : column + entries])
                column += entries
        if not view.row_agents:
            together = np.concatenate([observations[agent] for agent in view.agents], axis=1)
            np.testing.assert_array_equal(rows, together)
            np.testing.assert_allclose(view.score(rewards), sum(rewards.values()) / len(rewards), rtol=1e-12)


def test_joint_learner_is_paid_circularity() -> None:
    """With the team reward a joint learner's reward is λ itself."""
    env = vector_env("copper_net", num_envs=3, reward="circularity")
    env.reset(seed=0)
    _, rewards, _, _, infos = env.step(env.neutral_action)
    paid = AllAtOnce(env, env.agents).score(rewards)
    np.testing.assert_allclose(paid, infos["mine"]["circularity"], rtol=1e-14)


def test_mixed_difference_reward() -> None:
    """w·(λ − λ had the agent been neutral)/scale + (1 − w)·local, of the same steps."""
    envs = {mode: vector_env("copper_net", num_envs=2, reward=mode) for mode in ("mixed_difference", "difference")}
    rng = np.random.default_rng(1)
    actions = rng.uniform(-1, 1, (5, len(envs["difference"].agents), 2))
    got = {}
    for mode, env in envs.items():
        env.reset(seed=4)
        got[mode] = [env.advance(action) for action in actions]
    objective = envs["difference"].network.objective
    weight = objective.circularity_weight
    for mixed, alone in zip(got["mixed_difference"], got["difference"], strict=True):
        expected = weight / objective.circularity_scale * alone.reward + (1 - weight) * alone.local
        np.testing.assert_allclose(mixed.reward, expected, rtol=1e-12)


def test_team_reward() -> None:
    """w·λ/scale − (1 − w)·Σ weight·shortfall, the same for everyone; both services of carbo_net weigh 10."""
    env = vector_env("carbo_net", num_envs=2, reward="team", circularity="mean")
    env.reset(seed=3)
    rng, objective = np.random.default_rng(0), env.network.objective
    assert {service.weight for service in env.network.services} == {10.0}
    for _ in range(5):
        outcome = env.advance(rng.uniform(-1, 1, (len(env.agents), 2)))
        shortfall = 10.0 * 2 * (1 - outcome.service_level)
        weight = objective.circularity_weight
        expected = weight * outcome.circularity_mean / objective.circularity_scale - (1 - weight) * shortfall
        np.testing.assert_allclose(outcome.reward, np.tile(expected, (len(env.agents), 1)), rtol=1e-12)


def small(learner: LearnerSettings, **options: Any) -> Recipe:
    """Return a recipe for two copies."""
    return Recipe(
        name="small",
        title="small",
        learner=learner,
        run=Run(steps=64, envs=2, engine="lockstep", evaluations=0),
        **options,
    )


def test_rows_of_a_seat_are_agents_in_copies() -> None:
    """Time limits, returns and attributes of a row are those of its agent and copy; the last state as well."""
    env = vector_env("copper_net", num_envs=2, horizon=3)
    by_hand = vector_env("copper_net", num_envs=2, horizon=3)
    world = NetworkWorld(env, [1, 2], {"all": SharedPolicy(env, env.agents).with_state(env)})
    agent_env, count = world.agent_envs["all"], len(env.agents)
    by_hand.reset(seed=[1, 2])
    assert agent_env.get_attr("agent") == [agent for agent in env.agents for _ in range(2)]
    assert agent_env.get_attr("index") == [0, 1] * count
    seen: list[Any] = []

    def learn() -> None:
        for _ in range(3):
            seen.append(agent_env.step(np.zeros((2 * count, 1), dtype=np.float32)))

    def rest() -> None:
        while True:
            agent_env.step(np.zeros((2 * count, 1), dtype=np.float32))

    Lockstep([world], [Participant("all", learn, rest, Streams(0))]).run()
    returns = np.zeros(2 * count)
    for observation, reward, done, infos in seen:
        still = {agent: np.zeros((2, 1)) for agent in env.agents}
        _, rewards, _, truncations, theirs = by_hand.step(still)
        expected = np.concatenate(list(rewards.values()))
        np.testing.assert_array_equal(reward, expected.astype(np.float32))
        np.testing.assert_array_equal(done, np.tile(truncations["mine"], count))
        np.testing.assert_array_equal(observation["state"], np.tile(by_hand.state(), (count, 1)))
        returns += expected
        for row, info in enumerate(infos):
            assert ("terminal_observation" in info) == done[row]
            if done[row]:
                last = info["terminal_observation"]
                agent = env.agents[row // 2]
                k = env.observation_spaces[agent].shape[0]
                np.testing.assert_array_equal(last["observation"][:k], theirs[agent]["final_obs"][row % 2])
                np.testing.assert_array_equal(last["state"], theirs[agent]["final_info"]["state"][row % 2])
                assert last["state"][-1] == 1.0  # the whole time has elapsed; the next episode's share is 0
                assert info["TimeLimit.truncated"]
                assert info["episode"]["r"] == pytest.approx(returns[row], rel=1e-12)


def central_critic() -> PPO:
    """Return PPO with a central critic on a toy view."""
    env = vector_env("carbo_net", num_envs=2)
    world = NetworkWorld(env, [0, 1], {"all": SharedPolicy(env, env.agents).with_state(env)})
    return PPO(CentralCriticPolicy, world.agent_envs["all"], seed=0, device="cpu", **SMALL)


def perturbed(model: PPO) -> tuple[dict[str, torch.Tensor], dict[str, torch.Tensor]]:
    """Return an observation, and the same observation in another state."""
    space: Any = model.observation_space
    rng = torch.Generator().manual_seed(0)
    rows = {key: torch.randn(5, *box.shape, generator=rng) for key, box in space.spaces.items()}
    return rows, {**rows, "state": rows["state"] + 1.0}


def test_actor_is_local_and_critic_central() -> None:
    """The state changes values but no action; neither loss has a gradient in the other's network."""
    policy = central_critic().policy
    here, elsewhere = perturbed(central_critic())
    assert torch.equal(policy.get_distribution(here).mode(), policy.get_distribution(elsewhere).mode())
    assert not torch.allclose(policy.predict_values(here), policy.predict_values(elsewhere))
    actions, values, _ = policy(here, deterministic=True)
    assert torch.equal(actions, policy.get_distribution(here).mode())
    assert torch.equal(values, policy.predict_values(here))

    critic = {"mlp_extractor.value_net", "value_net"}
    for loss in ("actor", "critic"):
        policy.zero_grad()
        values, log_likelihood, _ = policy.evaluate_actions(here, actions)
        (log_likelihood if loss == "actor" else values).sum().backward()  # type: ignore[no-untyped-call]
        moved = {name for name, p in policy.named_parameters() if p.grad is not None and bool(p.grad.any())}
        in_critic = {name for name in moved if any(name.startswith(part) for part in critic)}
        assert moved and in_critic == (set() if loss == "actor" else moved), (loss, moved)


def test_trained_actors_need_no_state(tmp_path: Path) -> None:
    """A saved run acts by observations alone, as its policy does with the state before it."""
    learner = LearnerSettings(scheme="shared", algorithm="PPO", policy="CentralCriticPolicy", parameters=SMALL)
    training = train("carbo_net", small(learner), directory=tmp_path / "run", horizon=8)
    env = vector_env("carbo_net", num_envs=3, horizon=8)
    observations = env.reset(seed=9)
    controller = Trained(tmp_path / "run")
    controller.start(env, 9)
    got = controller.act(observations)
    learnt = training.learners["shared-learner"]
    view = SharedPolicy(env, env.agents).with_state(env)
    rows = view.observe(observations, env.state)
    normalised: Any = learnt.env.normalize_obs(rows)  # type: ignore[attr-defined]
    expected = view.act(learnt.model.predict(normalised, deterministic=True)[0])
    for agent in env.agents:
        np.testing.assert_array_equal(got[agent], expected[agent])
    unseen: Any = view.observe(observations, unseen_state(env))
    assert (unseen["state"] == 0).all()
    assert np.isfinite(rollout(env, controller).episode_circularity).all()


class EpisodeStart(BaseCallback):
    """Remembers the parameters with which learning begins."""

    def parameters_now(self) -> dict[str, torch.Tensor]:
        """Return a copy of the policy's parameters."""
        assert self.model is not None
        return {name: value.detach().clone() for name, value in self.model.policy.named_parameters()}

    def _on_training_start(self) -> None:
        self.first = self.parameters_now()

    def _on_step(self) -> bool:
        return True


def learnt(name: str, recipe: Recipe, **options: Any) -> Training:
    """Train, and require of every policy that learning moves each of its parameters and keeps them finite."""
    network = cirl_marl.load_network(name)
    began = {group.name: EpisodeStart() for group in recipe.groups(network, network.agents)}
    training = train(name, recipe, callbacks=began, **options)
    assert set(training.learners) == set(began)
    for learner, callback in began.items():
        for which, value in callback.parameters_now().items():
            assert not torch.equal(value, callback.first[which]), f"{learner}: {which} did not move"
            assert torch.isfinite(value).all(), f"{learner}: {which}"
    return training


@pytest.mark.medium
def test_learners_share_by_match(tmp_path: Path) -> None:
    """Nodes may share one policy and arcs another, beside an agent that learns alone; every policy moves."""
    matches = [
        Match(agents=["mine"], algorithm="A2C", parameters={"n_steps": 8}),
        Match(kind="node", scheme="shared", algorithm="PPO", parameters=SMALL),
        Match(agents=["use_to_collection", "collection_to_sorting"], scheme="joint", algorithm="PPO", parameters=SMALL),
    ]
    recipe = small(LearnerSettings(scheme="shared", algorithm="PPO", parameters=SMALL), match=matches)
    training = learnt("copper_net", recipe, directory=tmp_path / "run", horizon=8)
    members = {name: learner.agent_env.view.agents for name, learner in training.learners.items()}
    assert set(members) == {"shared-learner-0", "shared-learner-2", "joint-learner", "mine"}
    assert sorted(a for agents in members.values() for a in agents) == sorted(training.env.agents)
    assert members["joint-learner"] == ("use_to_collection", "collection_to_sorting")
    network = training.env.network
    assert all(agent in network.node_index for agent in members["shared-learner-2"])
    assert all(agent in network.arc_index for agent in members["shared-learner-0"])
    for name, learner in training.learners.items():
        assert learner.model.num_timesteps == 64 * max(1, len(learner.agent_env.view.row_agents)), name
    controller, env = Trained(tmp_path / "run"), vector_env("copper_net", num_envs=2, horizon=8)
    assert np.isfinite(rollout(env, controller).episode_circularity).all()


BRIEF = {
    "PPO": {"n_steps": 4, "batch_size": 8, "n_epochs": 1},
    "SAC": {"learning_starts": 2, "buffer_size": 50, "gradient_steps": 1, "batch_size": 4},
    "ARS": {"n_delta": 1, "n_top": 1},
}


def shortened(name: str) -> Recipe:
    """Return a recipe of the catalogue for two copies and a few updates."""
    recipe = load_recipe(name)
    parameters = recipe.learner.parameters | BRIEF[recipe.learner.algorithm]
    learner = recipe.learner.model_copy(update={"parameters": parameters})
    return recipe.model_copy(
        update={"learner": learner, "run": Run(steps=16, envs=2, engine="lockstep", evaluations=0)}
    )


@pytest.mark.parametrize(
    ("name", "network"),
    # a robot that is searched for by returns alone never touches a cube in so few steps, and its policy stays
    [pair for pair in product(JOINT_RECIPES, ONE_OF_EACH) if pair != ("independent_ars", "solids_net")],
)
@pytest.mark.sample(12)
def test_every_recipe_learns_on_every_network(name: str, network: str) -> None:
    """The recipes of the catalogue train on each network, and their policies move."""
    learnt(network, shortened(name), horizon=4, seed=1)


def seen_values(training: Any) -> NDArray[np.floating]:
    """Return all weights of a training in one array."""
    weights = [p.detach().numpy().ravel() for t in training.learners.values() for p in t.model.policy.parameters()]
    return np.concatenate(weights)


@pytest.mark.parametrize("scheme", ["shared", "joint"])
def test_same_seed_gives_the_same_bits(scheme: Any) -> None:
    """Learners of several agents are reproducible, and another seed gives other weights."""
    recipe = small(LearnerSettings(scheme=scheme, algorithm="PPO", parameters=SMALL))
    first, again, other = (seen_values(train("carbo_net", recipe, seed=seed, horizon=8)) for seed in (3, 3, 4))
    np.testing.assert_array_equal(first, again)
    assert (first != other).any()


def test_central_critic_needs_what_it_needs(tmp_path: Path) -> None:
    """Physical units must be normalised, and only on-policy actor-critics have such a policy."""
    text = 'name = "mine"\ntitle = "mine"\n[learner]\nalgorithm = "PPO"\npolicy = "CentralCriticPolicy"\n'
    path = tmp_path / "mine.toml"
    path.write_text(text)
    assert load_recipe(path).learner.policy == "CentralCriticPolicy"
    for changed, said in (
        (text + "normalise = { observation = false }\n", "learner.normalise.observation"),
        (text.replace("PPO", "SAC"), "unknown policy of SAC for vectors 'CentralCriticPolicy'"),
        (text + 'scheme = "sharde"\n', "learner.scheme"),
    ):
        path.write_text(changed)
        with pytest.raises(DefinitionError, match=said):
            load_recipe(path)


def test_time_limit_may_be_the_end() -> None:
    """Without bootstrap the last step's reward stands alone; with it the value of what comes next is added."""
    paid = {}
    for bootstrap in (True, False):
        spec = LearnerSettings(scheme="joint", algorithm="PPO", parameters=SMALL, bootstrap=bootstrap)
        training = train("carbo_net", small(spec.model_copy(update={"normalise": NOTHING})), horizon=8, steps=16)
        model: Any = training.learners["joint-learner"].model
        paid[bootstrap] = model.rollout_buffer.rewards.copy()
    np.testing.assert_array_equal(paid[True][:-1], paid[False][:-1])
    assert (paid[True][-1] != paid[False][-1]).all()


@pytest.mark.parametrize("scheme", ["independent", "shared", "joint"])
def test_centred_rewards_are_what_copies_differ_by(scheme: str) -> None:
    """Of each agent the mean over the copies is taken off in every interval; what runs report stays."""
    plain, centred = (_centred_or_not(scheme, "lockstep", centred) for centred in (False, True))
    rewards = [
        np.stack([model.rollout_buffer.rewards.reshape(8, -1, 3) for model in models]) for models, _ in (plain, centred)
    ]
    differences = rewards[0] - rewards[0].mean(axis=-1, keepdims=True, dtype=float)
    np.testing.assert_allclose(rewards[1], differences, atol=1e-6)
    assert np.abs(differences).max() > 1e-3
    np.testing.assert_array_equal(plain[1], centred[1])
    weights = [[part.detach() for part in models[0].policy.parameters()] for models, _ in (plain, centred)]
    stacked = _centred_or_not(scheme, "stacked", True)[0][0].policy.parameters()
    for part_centred, part_stacked in zip(weights[1], stacked, strict=True):
        torch.testing.assert_close(part_stacked.detach(), part_centred, atol=1e-5, rtol=1e-4)
    assert max(float((part - other).abs().max()) for part, other in zip(*weights, strict=True)) > 1e-4


def _centred_or_not(scheme: str, engine: str, centred: bool) -> tuple[list[Any], NDArray[np.floating]]:
    """Return the models of an episode in three copies, and the returns that each row reports."""
    about: dict[str, Any] = {"scheme": scheme, "normalise": NOTHING, "bootstrap": False, "centre_rewards": centred}
    spec = LearnerSettings(algorithm="PPO", parameters=SMALL | {"batch_size": 8}, **about)
    options: dict[str, Any] = {"horizon": 8, "steps": 24, "envs": 3, "engine": engine}
    training = train("copper_net", small(spec, environment={"reward": "local"}), **options)
    learners = training.learners.values()
    returns = np.concatenate([learner.agent_env.last_step.returns for learner in learners])
    return [learner.model for learner in learners], returns


def test_centred_rewards_are_kept_in_replay_buffers_and_need_copies(tmp_path: Path) -> None:
    """Off-policy learners keep what copies differ by; one copy is refused by name, and recipes of old stay."""
    spec = LearnerSettings(
        algorithm="TD3", parameters={"buffer_size": 16, "learning_starts": 100}, normalise=NOTHING, centre_rewards=True
    )
    training = train("copper_net", small(spec), horizon=8, steps=16, envs=2)
    for learner in training.learners.values():
        model: Any = learner.model
        rewards = model.replay_buffer.rewards
        np.testing.assert_allclose(rewards.sum(axis=1), 0.0, atol=1e-6)
        assert np.abs(rewards).max() > 0.0
    with pytest.raises(cirl_marl.CirlError, match=r"learner\.centre_rewards: in a single copy .* envs of at least 2"):
        train("copper_net", small(spec), horizon=8, steps=16, envs=1, directory=tmp_path / "run")
    assert not (tmp_path / "run").exists()
    assert "centre_rewards" not in LearnerSettings(algorithm="TD3").model_dump()
    assert spec.model_dump()["centre_rewards"] is True


def test_weight_of_circularity_is_an_option(tmp_path: Path) -> None:
    """The reward follows it, a run keeps it as an option beside the unchanged definition, and bad values are named."""
    half, most = (vector_env("copper_net", num_envs=2, reward="team", circularity_weight=w) for w in (None, 0.9))
    assert (half.network.objective.circularity_weight, most.network.objective.circularity_weight) == (0.5, 0.9)
    assert cirl_marl.parallel_env("copper_net", circularity_weight=1.0).network.objective.circularity_weight == 1.0
    recipe = small(LearnerSettings(scheme="joint", algorithm="PPO", parameters=SMALL))
    training = train("copper_net", recipe, directory=tmp_path / "run", horizon=8, steps=16, circularity_weight=0.9)
    assert training.run is not None
    assert training.run.config.options["circularity_weight"] == 0.9
    assert training.run.make_env(1).network == training.env.network
    assert training.run.network().objective.circularity_weight == 0.5
    for wrong in (1.5, "0.5", True):
        with pytest.raises(cirl_marl.CirlError, match=r"circularity_weight must be a number in \[0, 1\]"):
            vector_env("copper_net", circularity_weight=wrong)
