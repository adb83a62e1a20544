"""Where one learner sits: its view of the joint environment, as a Stable-Baselines3 ``VecEnv``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvObs, VecEnvStepReturn

from cirl_marl.environments.vector import Infos, VectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.learners.views import ObservedRows, View
from cirl_marl.network import Floats
from cirl_marl.network.elements import Compartment


@dataclass(frozen=True, slots=True)
class JointStep:
    """What a joint step brought.

    Attributes:
        rewards: of this step by agent, shape (B,).
        done: the copies whose episode ended, shape (B,).
        returns: of the episodes so far by agent, shape (B,).
        lengths: of the episodes so far, shape (B,).
        infos: of the environment.
    """

    rewards: Mapping[str, Floats]
    done: NDArray[np.bool_]
    returns: Mapping[str, Floats]
    lengths: NDArray[np.integer]
    infos: Infos


class CopyView:
    """One copy of the environment, as an agent if a row is one's: what ``env_method`` and ``get_attr`` reach.

    Attributes that it lacks are those of the joint environment.
    """

    render_mode: str | None = None

    def __init__(self, env: VectorEnv, index: int, agent: str | None = None) -> None:
        """View copy ``index`` of ``env`` as ``agent``, or as all agents of a joint learner."""
        self.env, self.index, self.agent = env, index, agent

    def __getattr__(self, name: str) -> Any:
        """Fall back on the joint environment."""
        return getattr(self.env, name)

    @property
    def compartment(self) -> Compartment:
        """The compartment that the agent is."""
        return self.env.network.compartments[str(self.agent)]

    def local_reward(self) -> float:
        """Return the local reward that the current state gives the agent."""
        return float(self.env.local_rewards()[str(self.agent)][self.index])


class Seat(VecEnv):
    """The B copies of the joint environment as one learner sees them.

    Time limits reach the learner as Stable-Baselines3 expects them: ``done`` with ``TimeLimit.truncated`` (unless
    nothing counts for it beyond the episode) and the true last observation in ``terminal_observation``. A ``reset``
    while the joint episode runs (ARS asks for one) cannot stop the others: it returns the current observation.

    Attributes:
        name: of the learner; an independent learner has its agent's.
        latest: the observation that it acts on next, one row for each row of its view.
        last: the joint step that is behind it.
        action: what it last did.
        bootstrap: whether time limits are reported as truncations, after which the learner expects more to come.
    """

    def __init__(self, env: VectorEnv, name: str, view: View, wait: Callable[[], object]) -> None:
        """Seat the learner ``name``; ``wait`` returns when every learner has acted and the environment has moved."""
        self.name, self.view, self.copies = name, view, env.num_envs
        self.latest: ObservedRows | None = None
        self.last: JointStep | None = None
        self.action: NDArray[np.float32] | None = None
        self.bootstrap = True
        self.views = [CopyView(env, i, agent) for agent in view.row_agents or (None,) for i in range(self.copies)]
        self._wait = wait
        super().__init__(len(self.views), view.observation_space, view.action_space)

    @property
    def title(self) -> str:
        """What messages call the learner."""
        return f"agent '{self.name}'" if self.view.agents == (self.name,) else f"learner '{self.name}'"

    def paid(self) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Return the reward of each row, and whether its episode ended; arrays of its own, which PPO adds to."""
        last = self._past
        return self.view.score(last.rewards).astype(np.float32), np.tile(last.done, self.num_envs // self.copies)

    def final_observation(self) -> ObservedRows:
        """Return what was seen last in the episodes that ended; other rows hold what is seen now."""
        infos = self._past.infos
        seen = {agent: infos[agent]["final_observation"] for agent in self.view.agents}
        return self.view.observe(seen, lambda: infos[self.view.agents[0]]["final_state"])

    def episode_returns(self) -> Floats:
        """Return the sum of the rewards of each row in its episode so far."""
        return self.view.score(self._past.returns)

    @property
    def _past(self) -> JointStep:
        if self.last is None:
            raise CirlError(f"the seat of {self.title} has no step behind it")
        return self.last

    def reset(self) -> VecEnvObs:
        """Return the current observation of every copy."""
        if self.latest is None:
            raise CirlError(f"the seat of {self.title} has no observation: the joint environment is not reset")
        return self.latest

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions, one row for each row of the view, for the next joint step."""
        self.action = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Wait until every learner has handed in its actions and the joint environment has moved."""
        self._wait()
        rewards, ended = self.paid()
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if ended.any():
            final, scores, lengths = self.final_observation(), self.episode_returns(), self._past.lengths
            for row in np.flatnonzero(ended):
                infos[row] = {
                    "TimeLimit.truncated": self.bootstrap,
                    "terminal_observation": _row(final, int(row)),
                    "episode": {"r": float(scores[row]), "l": int(lengths[row % self.copies]), "t": 0.0},
                }
        return self.reset(), rewards, ended, infos

    def close(self) -> None:
        """Do nothing: the joint environment is not the seat's to close."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Do nothing: every copy of the joint environment has its own seed already."""
        return [seed] * self.num_envs

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the given rows' views."""
        return [getattr(view, attr_name) for view in self._chosen(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of the given rows' views."""
        for view in self._chosen(indices):
            setattr(view, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the given rows' views."""
        return [getattr(view, method_name)(*method_args, **method_kwargs) for view in self._chosen(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False for each row: no Gymnasium wrapper is involved."""
        return [False for _ in self._chosen(indices)]

    def _chosen(self, indices: int | Iterable[int] | None) -> list[CopyView]:
        return [self.views[i] for i in self._get_indices(indices)]


def _row(observation: ObservedRows, row: int) -> ObservedRows:
    if isinstance(observation, dict):
        return {key: value[row].copy() for key, value in observation.items()}
    own: NDArray[np.floating] = observation[row].copy()
    return own
