"""The environment of one agent: the joint environment as its learner sees it, a ``VecEnv`` of Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Annotated, Any, ClassVar

import numpy as np
from greenlet import getcurrent
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnv, VecEnvObs, VecEnvStepReturn

from cirl_marl.controllers.basic import Arrays
from cirl_marl.environments.vector import Infos, MultiAgentVectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.learners.views import BatchedEnv, ObservedRows, View, by_part, rows_of
from cirl_marl.network import Floats
from cirl_marl.network.declarations import KeptRecord, positional_record
from cirl_marl.network.elements import Compartment


def wait() -> None:
    """Leave a learner's coroutine until every learner has acted and the joint step is done."""
    getcurrent().parent.switch()


@positional_record
class StepResult(KeptRecord):
    """The outcome of a joint step for one learner, one row for each row of its view."""

    NAMES_IN_FILES: ClassVar = {"observation": "seen", "dones": "ended", "final_observation": "final"}

    observation: Annotated[ObservedRows, "on which it acts next"]
    rewards: Annotated[NDArray[np.float32], "of the step"]
    dones: Annotated[NDArray[np.bool_], "rows whose episode ended with it; at a reset all, as episodes begin then too"]
    final_observation: Annotated[ObservedRows | None, "the last of the episodes that ended, anything elsewhere"] = None
    returns: Annotated[Floats | None, "sum of the rewards of the episodes that ended, anything in other rows"] = None
    lengths: Annotated[NDArray[np.integer] | None, "steps of these episodes"] = None
    truncated: Annotated[NDArray[np.bool_] | None, "rows whose episode a time limit ended; None: it ended all"] = None


_NO_STEP = StepResult(np.zeros(0), np.zeros(0, dtype=np.float32), np.zeros(0, dtype=bool))
"""Before the joint environment is reset."""


@positional_record
class JointStep:
    """The outcome of a joint step for all agents."""

    observations: Annotated[Arrays, "of each agent, of the episodes that begin where one ended"]
    state: Annotated[Callable[[], Floats], "returns the state of the environment for critics"]
    rewards: Annotated[Mapping[str, Floats], "of this step by agent, shape (B,)"]
    dones: Annotated[Mapping[str, NDArray[np.bool_]], "copies in which the agent's episode ended, shape (B,)"]
    truncated: Annotated[Mapping[str, NDArray[np.bool_]], "those in which a time limit ended it, likewise"]
    returns: Annotated[Mapping[str, Floats], "of the episodes so far by agent, shape (B,)"]
    lengths: Annotated[Mapping[str, NDArray[np.integer]], "of the episodes so far, likewise"]
    infos: Annotated[Infos, "of the environment"]


class AgentInNetworkCopy:
    """One copy of the environment, as an agent if a row is one's: what ``env_method`` and ``get_attr`` reach.

    Attributes that it lacks are those of the joint environment.
    """

    render_mode: str | None = None

    def __init__(self, env: MultiAgentVectorEnv, index: int, agent: str | None = None) -> None:
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


class AgentVecEnv(VecEnv):
    """The B copies of the joint environment as one learner sees them; its ``step`` waits for all other learners.

    Time limits reach the learner as Stable-Baselines3 expects them: ``done`` with ``TimeLimit.truncated`` (unless
    nothing counts for it beyond the episode) and the true last observation in ``terminal_observation``. A ``reset``
    while the joint episode runs (ARS asks for one) cannot stop the others: it returns the current observation.

    Attributes:
        name: of the learner; an independent learner has its agent's.
        action: its last one.
        wait: returns when every learner has handed in its actions and the joint environment has moved.
        bootstrap: whether time limits are reported as truncations, after which the learner expects more to come.
        centre_rewards: whether rewards are r − mean of r over the agent's copies, which are all in the same interval.
    """

    def __init__(self, env: BatchedEnv, name: str, view: View, row: Callable[..., Any] = AgentInNetworkCopy) -> None:
        """Show ``env`` by ``view``; ``row`` makes what ``env_method`` and ``get_attr`` reach: of copy and agent."""
        self.name, self.view, self.copies = name, view, env.num_envs
        self._joint_step: JointStep | None = None
        self.last_step = _NO_STEP
        self.action: NDArray[np.float32] | None = None
        self.bootstrap, self.centre_rewards = True, False
        self.views = [row(env, i, agent) for agent in view.row_agents or (None,) for i in range(self.copies)]
        self.wait: Callable[[], object] = wait
        super().__init__(len(self.views), view.observation_space, view.action_space)

    @property
    def title(self) -> str:
        """What messages call the learner."""
        return f"agent '{self.name}'" if self.view.agents == (self.name,) else f"learner '{self.name}'"

    def receive_reset(self, observations: Arrays, state: Callable[[], Floats]) -> None:
        """Take over the first observation after a reset of the joint environment."""
        rows = self.num_envs
        first = _in_rows(self.view.observe(observations, state))
        self.last_step = StepResult(first, np.zeros(rows, dtype=np.float32), np.ones(rows, dtype=bool))

    @property
    def absent(self) -> bool:
        """Whether none of its rows has anybody who acts next, so that the learner is not asked."""
        return False

    def receive_step(self, step: JointStep) -> None:
        """Take over the outcome of a joint step; what of it is the learner's is looked up when somebody asks."""
        self._joint_step = step

    @property
    def last_step(self) -> StepResult:
        """The outcome of the last joint step."""
        if self._joint_step is not None:
            self.last_step = self._result_of(self._joint_step)
        return self._last_step

    @last_step.setter
    def last_step(self, result: StepResult) -> None:
        self._last_step, self._joint_step = result, None

    def _result_of(self, step: JointStep) -> StepResult:
        agents, rows = self.view.agents, self.view.row_agents or self.view.agents[:1]
        observation, rewards, dones = _in_rows(self.observation), self.rewards.astype(np.float32), self.dones
        if not dones.any():
            return StepResult(observation, rewards, dones)
        final_by_agent = {agent: step.infos[agent]["final_obs"] for agent in agents}
        final = _in_rows(self.view.observe(final_by_agent, lambda: step.infos[agents[0]]["final_info"]["state"]))
        returns, lengths = self.view.score(step.returns), np.concatenate([step.lengths[agent] for agent in rows])
        truncated = np.concatenate([step.truncated[agent] for agent in rows])
        return StepResult(observation, rewards, dones, final, returns, lengths, truncated)

    @property
    def observation(self) -> ObservedRows:
        """What each row sees now, in whatever order of memory."""
        if (step := self._joint_step) is None:
            return self._last_step.observation
        return self.view.observe(step.observations, step.state)

    @property
    def rewards(self) -> NDArray[np.floating]:
        """The reward of each row in the last step, not centred."""
        step = self._joint_step
        return self._last_step.rewards if step is None else self.view.score(step.rewards)

    @property
    def dones(self) -> NDArray[np.bool_]:
        """Which rows' episodes ended with the last step."""
        if (step := self._joint_step) is None:
            return self._last_step.dones
        return np.concatenate([step.dones[agent] for agent in self.view.row_agents or self.view.agents[:1]])

    def centre(self, rewards: NDArray[np.float32]) -> None:
        """Take the mean over copies off the rewards of the rows, if that is asked for."""
        if self.centre_rewards:
            by_agent = rewards.reshape(-1, self.copies)
            by_agent -= by_agent.mean(axis=1, keepdims=True)

    def reset(self) -> VecEnvObs:
        """Return the current observation of every copy."""
        if self.last_step is _NO_STEP:
            raise CirlError(f"the environment of {self.title} has no observation: the joint environment is not reset")
        return self.last_step.observation

    def step_async(self, actions: NDArray[np.float32]) -> None:
        """Keep the actions, one row for each row of the view, for the next joint step."""
        self.action = actions

    def step_wait(self) -> VecEnvStepReturn:
        """Wait until every learner has handed in its actions and the joint environment has moved."""
        self.wait()
        rewards, dones = self.last_step.rewards.copy(), self.last_step.dones.copy()  # PPO adds to rewards in place
        self.centre(rewards)
        infos: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        now = self.last_step
        if now.final_observation is not None and now.returns is not None and now.lengths is not None:
            for row in np.flatnonzero(dones):
                out_of_time = now.truncated is None or bool(now.truncated[row])
                infos[row] = {
                    "TimeLimit.truncated": self.bootstrap and out_of_time,
                    "terminal_observation": by_part(lambda part: part.copy(), rows_of(now.final_observation, row)),
                    "episode": {"r": float(now.returns[row]), "l": int(now.lengths[row]), "t": 0.0},
                }
        return self.reset(), rewards, dones, infos

    def close(self) -> None:
        """Do nothing: the joint environment is not one agent's to close."""

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Do nothing: every copy of the joint environment has its own seed already."""
        return [seed] * self.num_envs

    def get_attr(self, attr_name: str, indices: int | Iterable[int] | None = None) -> list[Any]:
        """Return an attribute of the given rows' views."""
        return [getattr(view, attr_name) for view in self._envs_at(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: int | Iterable[int] | None = None) -> None:
        """Set an attribute of the given rows' views."""
        for view in self._envs_at(indices):
            setattr(view, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: int | Iterable[int] | None = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the given rows' views."""
        return [getattr(view, method_name)(*method_args, **method_kwargs) for view in self._envs_at(indices)]

    def env_is_wrapped(self, wrapper_class: type, indices: int | Iterable[int] | None = None) -> list[bool]:
        """Return False for each row: no Gymnasium wrapper is involved."""
        return [False for _ in self._envs_at(indices)]

    def _envs_at(self, indices: int | Iterable[int] | None) -> list[AgentInNetworkCopy]:
        return [self.views[i] for i in self._get_indices(indices)]


def _in_rows(observation: ObservedRows) -> ObservedRows:
    """Return an observation in C order, as replayed ones are: matrix products of other layouts round differently."""
    rows: ObservedRows = by_part(np.ascontiguousarray, observation)
    return rows
