"""Many unmodified learners in one joint environment, in lockstep.

Each learner's own ``learn()`` runs in a greenlet against its ``Seat``. A seat's ``step_wait`` switches back here; when
every agent has handed in its actions, the joint environment moves once and the learners go on, in a fixed order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextvars import copy_context
from typing import Any

import numpy as np
from greenlet import GreenletExit, greenlet
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from cirl_marl.errors import LearnerError
from cirl_marl.learners.seat import Seat
from cirl_marl.learners.streams import Streams
from cirl_marl.vector_env import Infos, VectorEnv

StepHook = Callable[[Infos, NDArray[np.bool_]], None]


class Interrupted(Exception):
    """Raised by a step hook to end training early; what was learnt is kept."""


class Lockstep:
    """Seats the agents of one batched environment and lets their learners run together.

    Attributes:
        env: the joint environment.
        seats: by agent, in the order in which learners are resumed.
        joint_steps: control intervals done, each in every copy.
    """

    def __init__(self, env: VectorEnv, seeds: Sequence[int]) -> None:
        """Reset ``env`` with one seed per copy and seat its agents."""
        self.env = env
        self.joint_steps = 0
        self._hub = greenlet.getcurrent()
        self._own = Streams()
        self._streams: dict[str, Streams] = {}
        self._coroutines: dict[str, greenlet] = {}
        self._outcomes: dict[str, VecEnvStepReturn] = {}
        self._learning: set[str] = set()
        self.seats = {agent: Seat(env, agent, self._exchange) for agent in env.agents}
        for agent, observation in env.reset(seed=list(seeds)).items():
            self.seats[agent].latest = np.ascontiguousarray(observation)
        self._returns = np.zeros((len(env.agents), env.num_envs))
        self._lengths = np.zeros(env.num_envs, dtype=int)

    def run(
        self,
        learners: Mapping[str, Callable[[], None]],
        actors: Mapping[str, Callable[[], None]],
        streams: Mapping[str, Streams],
        budgets: Mapping[str, int],
        hook: StepHook | None = None,
    ) -> None:
        """Run every learner to its end.

        Args:
            learners: by agent, what learns; returns when it has learnt enough.
            actors: by agent, what acts for ever once its learner is done, so that the others' world goes on.
            streams: by agent, its random streams.
            budgets: by agent, joint steps after which a learner that has not returned is stopped.
            hook: called after each joint step, in the caller's random streams; may raise ``Interrupted``.

        Raises:
            LearnerError: if a learner raises; names its agent and the joint step.
            Interrupted: if the hook raised it.
        """
        self._hub = greenlet.getcurrent()
        self._streams = dict(streams)
        self._learning = set(self.env.agents)
        try:
            for agent in self.env.agents:
                self._coroutines[agent] = greenlet(self._task(agent, learners[agent], actors[agent]))
                self._coroutines[agent].gr_context = copy_context()
                self._resume(agent)
            while self._learning:
                self._step_jointly(hook)
                for agent in self.env.agents:
                    if agent in self._learning and self.joint_steps > budgets[agent]:
                        self._stop_learning(agent)
                    else:
                        self._resume(agent)
        finally:
            self._end()

    def _task(self, agent: str, learn: Callable[[], None], act: Callable[[], None]) -> Callable[[], None]:
        def run() -> None:
            try:
                learn()
            except GreenletExit:
                if agent in self._learning:
                    return  # training is over for everyone
            self._learning.discard(agent)
            act()

        return run

    def _step_jointly(self, hook: StepHook | None) -> None:
        actions = {agent: seat.action for agent, seat in self.seats.items()}
        observations, rewards, _, truncations, infos = self.env.step(actions)  # type: ignore[arg-type]
        self.joint_steps += 1
        done = next(iter(truncations.values()))
        self._returns += list(rewards.values())
        self._lengths += 1
        for row, (agent, seat) in enumerate(self.seats.items()):
            seat.latest = np.ascontiguousarray(observations[agent])
            seat_infos: list[dict[str, Any]] = [{} for _ in range(self.env.num_envs)]
            for copy in np.flatnonzero(done):
                seat_infos[copy] = {
                    "TimeLimit.truncated": True,
                    "terminal_observation": infos[agent]["final_observation"][copy].copy(),
                    "episode": {"r": float(self._returns[row, copy]), "l": int(self._lengths[copy]), "t": 0.0},
                }
            # own copies: PPO adds the bootstrap value to the rewards in place
            self._outcomes[agent] = (seat.latest, rewards[agent].astype(np.float32), done.copy(), seat_infos)
        if hook is not None:
            if done.any():
                for row, agent in enumerate(self.seats):
                    infos[agent]["episode_return"] = self._returns[row].copy()
            hook(infos, done)
        self._returns[:, done] = 0.0
        self._lengths[done] = 0

    def _exchange(self, seat: Seat) -> VecEnvStepReturn:
        """Leave the learner's coroutine until the joint step is done."""
        self._hub.switch()
        return self._outcomes.pop(seat.agent)

    def _resume(self, agent: str) -> None:
        try:
            self._enter(agent, self._coroutines[agent].switch)
        except Exception as error:
            raise LearnerError(f"agent '{agent}' failed at joint step {self.joint_steps}: {error!r}") from error
        if self._coroutines[agent].dead:
            raise LearnerError(f"agent '{agent}' stopped acting at joint step {self.joint_steps}")

    def _stop_learning(self, agent: str) -> None:
        """End ``learn()`` of an agent that has used up its steps; it goes on acting from its next turn."""
        self._learning.discard(agent)
        self._enter(agent, lambda: self._coroutines[agent].throw(GreenletExit))

    def _end(self) -> None:
        self._learning = set(self.env.agents)
        for agent, coroutine in self._coroutines.items():
            if not coroutine.dead:
                self._enter(agent, lambda: coroutine.throw(GreenletExit))  # noqa: B023 (called at once)
        self._coroutines.clear()

    def _enter(self, agent: str, action: Callable[[], object]) -> None:
        """Do something in the random streams of an agent."""
        streams = self._streams[agent]
        self._own.switch_to(streams)
        try:
            action()
        finally:
            streams.switch_to(self._own)
