"""What one learner sees: its agent's view of the joint environment, as a Stable-Baselines3 ``VecEnv``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvObs, VecEnvStepReturn

from cirl_marl.elements import Compartment
from cirl_marl.errors import CirlError
from cirl_marl.vector_env import VectorEnv


class AgentView:
    """One agent in one copy of the environment; what ``env_method`` and ``get_attr`` of a seat reach.

    Attributes that it lacks are those of the joint environment.
    """

    render_mode: str | None = None

    def __init__(self, env: VectorEnv, agent: str, index: int) -> None:
        """View copy ``index`` of ``env`` as ``agent``."""
        self.env = env
        self.agent = agent
        self.index = index

    @property
    def compartment(self) -> Compartment:
        """The compartment that the agent is."""
        return self.env.network.compartments[self.agent]

    def local_reward(self) -> float:
        """Return the local reward that the current state gives the agent."""
        return float(self.env.local_rewards()[self.agent][self.index])

    def __getattr__(self, name: str) -> Any:
        """Fall back on the joint environment."""
        return getattr(self.env, name)


class Seat(VecEnv):
    """The B copies of the joint environment as one agent sees them.

    Time limits reach the learner as Stable-Baselines3 expects them: ``done`` with ``TimeLimit.truncated`` and the true
    last observation in ``terminal_observation``. A ``reset`` while the joint episode runs (ARS asks for one) cannot
    stop the others: it returns the current observation.

    Attributes:
        agent: whose seat it is.
        latest: the observation that the agent acts on next, shape (B, k).
    """

    def __init__(self, env: VectorEnv, agent: str, exchange: Callable[[Seat], VecEnvStepReturn]) -> None:
        """Seat ``agent``; ``exchange`` hands in its action and waits for the outcome of the joint step."""
        self.agent = agent
        self.latest: NDArray[np.float32] | None = None
        self.action: NDArray[np.float32] | None = None
        self.views = [AgentView(env, agent, i) for i in range(env.num_envs)]
        self._exchange = exchange
        super().__init__(env.num_envs, env.observation_spaces[agent], env.action_spaces[agent])

    def reset(self) -> VecEnvObs:
        """Return the current observation of every copy."""
        if self.latest is None:
            raise CirlError(f"the seat of agent '{self.agent}' has no observation: the joint environment is not reset")
        return self.latest

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions, shape (B, 1), for the next joint step."""
        self.action = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Wait until every agent has handed in its actions and the joint environment has moved."""
        return self._exchange(self)

    def close(self) -> None:
        """Do nothing: the joint environment is not the seat's to close."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Do nothing: every copy of the joint environment has its own seed already."""
        return [seed] * self.num_envs

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the agent's view in the given copies."""
        return [getattr(view, attr_name) for view in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of the agent's view in the given copies."""
        for view in self._chosen(indices):
            setattr(view, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the agent's view in the given copies."""
        return [getattr(view, method_name)(*method_args, **method_kwargs) for view in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False for each copy: no Gymnasium wrapper is involved."""
        return [False for _ in self._chosen(indices)]

    def _chosen(self, indices: int | Iterable[int] | None) -> list[AgentView]:
        return [self.views[i] for i in self._get_indices(indices)]
