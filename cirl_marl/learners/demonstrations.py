"""Demonstrations: a controller acts in the place of an off-policy learner, which keeps what it sees.

Tasks with a sparse reward are hardly ever solved by random exploration. The first steps of a run may therefore be those
of a controller; their transitions are in the replay buffer when the learner, Stable-Baselines3's own, begins. They are
steps and episodes of the run, in its budget and its metrics. Callbacks and the learning curves of TensorBoard begin
with the learner itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm

from cirl_marl.controllers.basic import Arrays
from cirl_marl.controllers.scripted import Scripted
from cirl_marl.environments.goal import GoalEnv
from cirl_marl.environments.single import SingleAgentEnv
from cirl_marl.environments.state import State
from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import CirlError, RecipeError
from cirl_marl.optimum.named import named_controller

Act = Callable[[], NDArray[np.float32]]
"""Returns what the controller does now, a row for each row of the learner's environment."""


def demonstrate(model: OffPolicyAlgorithm, steps: int, act: Act) -> None:
    """Step the environment of ``model`` by ``act`` and keep the transitions, until the model has counted ``steps``.

    ``model.learn(…, reset_num_timesteps=False)`` goes on from there. What is kept is what the model would have kept of
    its own steps: observations and rewards before normalisation, the true last observation of an episode. Statistics of
    a normaliser are those of all steps. A model that was saved in the middle of its demonstrations gets the rest of
    them; one that has passed them gets none, and has them only if its replay buffer was saved as well. Its actions are
    those of Box(-1, 1), its steps rows.
    """
    if model.num_timesteps >= steps:
        return
    model.learn(0, reset_num_timesteps=model.num_timesteps == 0)  # takes a seat: resets its environment, does no step
    env, buffer = model.get_env(), model.replay_buffer
    assert env is not None and buffer is not None
    while model.num_timesteps < steps:
        actions = act()
        observations, rewards, dones, infos = env.step(actions)
        model.num_timesteps += env.num_envs
        model._store_transition(buffer, actions, observations, rewards, dones, infos)  # type: ignore[arg-type]


class Demonstrator:
    """A controller at work in a batched environment, for all agents, started anew with every episode.

    Several learners may follow it: it acts once for each state.
    """

    def __init__(self, name: str, env: VectorEnv, seed: int) -> None:
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
        if isinstance(self._controller, Scripted) and not set(agents) & set(known := self._controller.scripted):
            raise RecipeError(
                f"{title}: demonstrations by scripted control: there is no script for it; "
                f"there are scripts for {', '.join(known) or 'no agent of this network'}"
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
    followed = [Demonstrator(name, _batch_of(env), seed) for env, seed in zip(envs, seeds, strict=True)]

    def row(demonstrator: Demonstrator) -> NDArray[np.floating]:
        (agent,) = demonstrator.env.agents
        if demonstrator.idle:
            demonstrator.check([agent], f"agent '{agent}'")
        return demonstrator.act()[agent]

    return lambda: np.concatenate([row(each) for each in followed], dtype=np.float32, casting="same_kind")


def _batch_of(env: gymnasium.Env[Any, Any]) -> VectorEnv:
    own = env.unwrapped
    single = own.flat if isinstance(own, GoalEnv) else own
    if not isinstance(single, SingleAgentEnv):
        raise RecipeError(f"demonstrations: controllers act in networks, and {type(own).__name__} is none")
    return single.parallel.batch
