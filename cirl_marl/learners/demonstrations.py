"""Demonstrations: a controller shows a learner what to do before it learns by itself.

Tasks with a sparse reward are hardly ever solved by random exploration. The first steps of a run may therefore be those
of a controller. Off-policy, their transitions are in the replay buffer when the learner, Stable-Baselines3's own,
begins. Others imitate what they are shown. They are steps and episodes of the run, in its budget and its
metrics. Callbacks and the learning curves of TensorBoard begin with the learner itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from sb3_contrib import ARS
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor

from cirl_marl.controllers.basic import Arrays
from cirl_marl.controllers.scripted import ScriptController
from cirl_marl.environments.goal import GoalEnv
from cirl_marl.environments.single import SingleAgentEnv
from cirl_marl.environments.state import State
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RecipeError
from cirl_marl.learners.views import rows_of
from cirl_marl.optimum.registry import named_controller

Act = Callable[[], NDArray[np.float32]]
"""Returns what the controller does now, a row for each row of the learner's environment."""


def steps_counted(model: BaseAlgorithm, num_envs: int) -> int:
    """Return by how much ``num_timesteps`` grows with a step of all rows; ARS counts each row once for every row."""
    return num_envs**2 if isinstance(model, ARS) else num_envs


def demonstrate(model: BaseAlgorithm, steps: int, act: Act) -> None:
    """Show ``model`` by ``act`` what to do, until it has counted ``steps`` in its environment.

    ``model.learn(…, reset_num_timesteps=False)`` goes on from there.
    """
    if model.num_timesteps >= steps:
        return
    model.learn(0, reset_num_timesteps=model.num_timesteps == 0)  # resets its environment, does no step
    if isinstance(model, OffPolicyAlgorithm):
        _keep(model, steps, act)
    else:
        _imitate(model, steps, act)


def _keep(model: OffPolicyAlgorithm, steps: int, act: Act) -> None:
    """Step the environment by ``act`` and keep the transitions.

    What is kept is what the model would have kept of
    its own steps: observations and rewards before normalisation, the true last observation of an episode. Statistics of
    a normaliser are those of all steps. A model that was saved in the middle of its demonstrations gets the rest of
    them; one that has passed them gets none, and has them only if its replay buffer was saved as well. Its actions are
    those of Box(-1, 1), its steps rows.
    """
    env, buffer = model.get_env(), model.replay_buffer
    assert env is not None and buffer is not None
    while model.num_timesteps < steps:
        actions = act()
        observations, rewards, dones, infos = env.step(actions)
        model.num_timesteps += env.num_envs
        model._store_transition(buffer, actions, observations, rewards, dones, infos)  # type: ignore[arg-type]


IMITATION_RATE, IMITATION_EPOCHS, IMITATION_BATCH = 1e-3, 10, 256
"""Adam's learning rate, passes over all that was shown, and rows at a time, each time that a rollout has ended."""


def _imitate(model: BaseAlgorithm, steps: int, act: Act) -> None:
    """Let ``model`` imitate what ``act`` does: DAgger (Ross, Gordon and Bagnell 2011).

    During the first rollout the controller acts, afterwards the model; the controller says what it would have done in
    each state that comes of it, also in those that it would never have met. A rollout is that of the algorithm, or an
    episode if it has none. After each the likelihood of all that was said is maximised, so that the spread of the
    actions becomes what the model cannot imitate; a policy without a spread comes as close as its mean square allows.
    The critic learns nothing. Of a model that was saved in the middle the policy goes on, what it was shown is lost.
    """
    env = model.get_env()
    assert env is not None
    observations: list[Any] = []
    actions_to_copy: list[NDArray[np.float32]] = []
    rollout = model.n_steps if isinstance(model, OnPolicyAlgorithm) else None
    while model.num_timesteps < steps:
        follows, before = not observations, len(observations)
        dones = np.zeros(env.num_envs, dtype=bool)
        while model.num_timesteps < steps and (
            not dones.any() if rollout is None else len(observations) < before + rollout
        ):
            observations.append(env.get_original_obs() if isinstance(env, VecNormalize) else model._last_obs)
            actions_to_copy.append(act())
            assert model._last_obs is not None
            actions = actions_to_copy[-1] if follows else model.predict(model._last_obs)[0]
            model._last_obs, _, dones, _ = env.step(actions)  # type: ignore[assignment]
            model._last_episode_starts = dones
            model.num_timesteps += steps_counted(model, env.num_envs)
        _fit(model, _concatenate(observations), np.concatenate(actions_to_copy))


def _concatenate(observations: Sequence[Any]) -> Any:
    """Return the observations of several steps as one; those of a dict key by key."""
    if isinstance(observations[0], dict):
        return {key: np.concatenate([observation[key] for observation in observations]) for key in observations[0]}
    return np.concatenate(observations)


def _fit(model: BaseAlgorithm, observations: Any, actions_to_copy: NDArray[np.float32]) -> None:
    """Bring the policy close to the actions to copy, by the statistics that the normaliser has now."""
    env, policy = model.get_env(), model.policy
    inputs, _ = policy.obs_to_tensor(env.normalize_obs(observations) if isinstance(env, VecNormalize) else observations)
    actions = torch.as_tensor(actions_to_copy)
    optimiser = torch.optim.Adam(policy.parameters(), lr=IMITATION_RATE)
    policy.set_training_mode(True)
    for _ in range(IMITATION_EPOCHS):
        for rows in torch.split(torch.randperm(len(actions)), IMITATION_BATCH):
            optimiser.zero_grad()
            _unlike(policy, rows_of(inputs, rows), actions[rows]).backward()  # type: ignore[no-untyped-call]
            optimiser.step()
    policy.set_training_mode(False)
    keep_parameters(model)


def _unlike(policy: BasePolicy, observations: Any, actions_to_copy: Tensor) -> Tensor:
    """Return minus the mean log-likelihood of what was shown; without a spread the mean square of the difference."""
    if isinstance(policy, ActorCriticPolicy):
        return -policy.evaluate_actions(observations, actions_to_copy)[1].mean()
    difference: Tensor = policy(observations) - actions_to_copy
    return difference.square().mean()


def keep_parameters(model: BaseAlgorithm) -> None:
    """Let an algorithm go on from the parameters that its policy has now: ARS learns a vector of its own of them."""
    if isinstance(model, ARS):
        weights = torch.nn.utils.parameters_to_vector(model.policy.parameters())
        model.weights = weights.detach()  # type: ignore[assignment]


class Demonstrator:
    """A controller at work in a batched environment, for all agents, started anew with every episode.

    Several learners may follow it: it acts once for each state.
    """

    def __init__(self, name: str, env: MultiAgentVectorEnv, seed: int) -> None:
        """Make the controller ``name``; a random one draws from ``seed`` and the number of the episode."""
        self.name = name
        self.env = env
        self._controller = named_controller(name)
        self._seed = seed
        self._began: State | None = None
        self._state: State | None = None
        self._actions: Arrays = {}

    @property
    def idle(self) -> bool:
        """Whether it has not started yet, for which the environment needs a state."""
        return self._began is None

    def check(self, agents: Sequence[str], title: str) -> None:
        """Start and act in the current state; raise a ``RecipeError`` if it cannot do so, or not for ``agents``."""
        try:
            self.act()
        except CirlError as error:
            raise RecipeError(f"{title}: demonstrations by {self.name} control: {error}") from error
        if isinstance(self._controller, ScriptController) and not set(agents) & set(
            scripts := self._controller.script_agents
        ):
            raise RecipeError(
                f"{title}: demonstrations by scripted control: there is no script for it; "
                f"there are scripts for {', '.join(scripts) or 'no agent of this network'}"
            )

    def act(self) -> Arrays:
        """Return the actions of all agents in the current state of the environment."""
        state = self.env.physical
        if state is not self._state:
            if self.idle or (state is not self._began and not state.step.any()):
                self._controller.start(self.env, self._seed)
                self._began, self._seed = self.env.physical, self._seed + 1
            self._state, self._actions = state, self._controller.act(self.env.observations())
        return self._actions


def in_copies(name: str, envs: Sequence[gymnasium.Env[Any, Any]], seeds: Sequence[int]) -> Act:
    """Return what the controller ``name`` does in copies of a Gymnasium environment, with a seed for each.

    Each has an agent of a network, as a vector or as a goal task; it may be wrapped.

    Raises:
        RecipeError: if an environment is not of a network, or the controller cannot act in it.
    """
    demonstrators = [Demonstrator(name, _batch_of(env), seed) for env, seed in zip(envs, seeds, strict=True)]

    def row(demonstrator: Demonstrator) -> NDArray[np.floating]:
        (agent,) = demonstrator.env.agents
        if demonstrator.idle:
            demonstrator.check([agent], f"agent '{agent}'")
        return demonstrator.act()[agent]

    return lambda: np.concatenate([row(leader) for leader in demonstrators], dtype=np.float32, casting="same_kind")


def _batch_of(env: gymnasium.Env[Any, Any]) -> MultiAgentVectorEnv:
    inner = env.unwrapped
    if not isinstance(inner, GoalEnv | SingleAgentEnv):
        raise RecipeError(f"demonstrations: controllers act in networks, and {type(inner).__name__} is none")
    return inner.parallel.batch
