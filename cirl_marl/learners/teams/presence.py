"""Learners of agents that are absent at times: what a copy tells of an agent that is not there is not learnt.

In Stable-Baselines3 every row of a ``VecEnv`` acts in every step. A learner none of whose rows is present is therefore
not asked at all: its next step is the one in which it is back, so that in a single copy it learns what it would learn
alone. With several copies, some rows may be absent while others act. Those are filled with what was seen last, and
left out of what is learnt: of rollouts before they are cut into minibatches, of the moments of normalisers; in replay
buffers, the transition of another row stands in the place.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from sb3_contrib.common.recurrent.buffers import RecurrentDictRolloutBuffer, RecurrentRolloutBuffer
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.buffers import DictReplayBuffer, ReplayBuffer, RolloutBuffer
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize

from cirl_marl.controllers.basic import Arrays
from cirl_marl.errors import LearnerError
from cirl_marl.learners.agent_env import AgentVecEnv, JointStep
from cirl_marl.learners.checkpoint import observation_statistics
from cirl_marl.learners.teams.copies import AgentInCopy, Copies
from cirl_marl.learners.views import OneAgent, rows_of
from cirl_marl.network import Floats

WHOLE = (ReplayBuffer, DictReplayBuffer)
"""Replay buffers in which every row of a step is a transition by itself."""


class TeamVecEnv(AgentVecEnv):
    """The environment of one agent that may be absent in some copies or in all.

    Attributes:
        present: rows in which the agent acts next.
        acted_rows: rows in which it acted in the last step.
        missed_steps: joint steps in which it was not asked.
    """

    def __init__(self, copies: Copies, agent: str) -> None:
        """Show the copies as ``agent``."""
        super().__init__(copies, agent, OneAgent(copies, agent), AgentInCopy)
        self._joint = copies
        self.missed_steps = 0
        self.present = self.acted_rows = np.ones(copies.num_envs, dtype=bool)
        self._leave_out: Callable[[], None] | None = None

    @property
    def absent(self) -> bool:
        """Whether the agent is in no copy."""
        return not self.present.any()

    def receive_reset(self, observations: Arrays, state: Callable[[], Floats]) -> None:
        """Take over the first observation."""
        super().receive_reset(observations, state)
        self._meet(self._joint.present[self.name])

    def receive_step(self, step: JointStep) -> None:
        """Take over the outcome of a joint step; what came while the agent was away belongs to the step before."""
        rows, before, away = self.present, self.last_step, self.absent
        super().receive_step(step)
        if away:
            self.last_step = replace(before, observation=self.last_step.observation)
        else:
            self.acted_rows = rows
        self._meet(self._joint.present[self.name])

    def at_first_gap(self, leave_out: Callable[[], None]) -> None:
        """Have ``leave_out`` called as soon as the agent is absent in some rows, not in all; it may raise."""
        self._leave_out = leave_out
        self._notice_gap()

    def _meet(self, present: NDArray[np.bool_]) -> None:
        self.present = present
        self.missed_steps += self.absent
        self._notice_gap()

    def _notice_gap(self) -> None:
        whole = self.acted_rows.all() and (self.present.all() or self.absent)
        if not whole and self._leave_out is not None:
            leave_out, self._leave_out = self._leave_out, None
            leave_out()


class _Rollout(RolloutBuffer):
    """Rollouts of which only rows in which the agent acted are learnt."""

    agent_env: TeamVecEnv
    row_acted: NDArray[np.bool_]

    def reset(self) -> None:
        super().reset()
        self.row_acted = np.ones((self.buffer_size, self.n_envs), dtype=bool)

    def add(self, *args: Any, **kwargs: Any) -> None:
        self.row_acted[self.pos] = self.agent_env.acted_rows
        super().add(*args, **kwargs)

    def get(self, batch_size: int | None = None) -> Generator[Any, None, None]:
        if self.row_acted.all():
            yield from super().get(batch_size)
            return
        next(super().get(1))  # it lays the steps of a row one after the other
        order = np.random.permutation(np.flatnonzero(self.row_acted.T))  # noqa: NPY002 (the learner's own stream)
        size = len(order) if batch_size is None else batch_size
        for start in range(0, len(order), size):
            yield self._get_samples(order[start : start + size])


class _Replay(ReplayBuffer):
    """A replay buffer into which no row goes in which the agent did not act."""

    agent_env: TeamVecEnv

    def add(self, obs: Any, next_obs: Any, action: Any, reward: Any, done: Any, infos: list[dict[str, Any]]) -> None:
        is_present = self.agent_env.acted_rows
        rows = np.arange(self.n_envs)
        present = np.flatnonzero(is_present)
        rows[~is_present] = np.resize(present, self.n_envs - len(present))  # transitions of others in their place
        before, after = (rows_of(observation, rows) for observation in (obs, next_obs))
        super().add(before, after, action[rows], reward[rows], done[rows], [infos[row] for row in rows])


class _Moments(RunningMeanStd):
    """Moments of the rows that somebody acts in."""

    agent_env: TeamVecEnv
    rows_attribute: str

    def update(self, arr: NDArray[Any]) -> None:
        super().update(arr[getattr(self.agent_env, self.rows_attribute)])


def leave_out_absent(model: BaseAlgorithm, env: Any, agent_env: TeamVecEnv) -> None:
    """Let a learner learn only from rows of its ``agent_env`` in which the agent is present.

    Raises:
        LearnerError: for algorithms that learn from whole sequences of rows.
    """
    rollout, replay = getattr(model, "rollout_buffer", None), getattr(model, "replay_buffer", None)
    sequences = isinstance(rollout, RecurrentRolloutBuffer | RecurrentDictRolloutBuffer)
    if isinstance(rollout, RolloutBuffer) and not sequences:
        _add_base(rollout, _Rollout, agent_env)
        rollout.row_acted = np.ones((rollout.buffer_size, rollout.n_envs), dtype=bool)  # type: ignore[attr-defined]
    elif replay is not None and type(replay) in WHOLE and not replay.optimize_memory_usage:
        _add_base(replay, _Replay, agent_env)
    else:
        raise LearnerError(
            f"{agent_env.title}: is absent in some copies while it acts in others, and {type(model).__name__} cannot "
            f"leave those out; use num_envs=1, or another algorithm"
        )
    if isinstance(env, VecNormalize):
        of_observations = (("present", part) for part in observation_statistics(env).values())
        for rows, moments in (("acted_rows", env.ret_rms), *of_observations):
            _add_base(moments, _Moments, agent_env)
            moments.rows_attribute = rows  # type: ignore[attr-defined]


def _add_base(thing: Any, kind: type, agent_env: TeamVecEnv) -> None:
    """Make an object one of ``kind`` as well, with what it has in it."""
    thing.__class__ = type(f"Present{type(thing).__name__}", (kind, type(thing)), {})
    thing.agent_env = agent_env
