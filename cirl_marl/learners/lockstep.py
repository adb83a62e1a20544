"""Many unmodified learners in one joint environment, in lockstep.

Each learner's own ``learn()`` runs in a greenlet against its ``Seat``. A seat's ``step_wait`` switches back here; when
every learner has handed in its actions, the joint environment moves once and the learners go on, in a fixed order.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextvars import copy_context

import numpy as np
from greenlet import GreenletExit, greenlet
from numpy.typing import NDArray
from stable_baselines3.common.vec_env.base_vec_env import VecEnvStepReturn

from cirl_marl.controllers.basic import Arrays
from cirl_marl.environments.vector import Infos, VectorEnv
from cirl_marl.errors import ControlError, LearnerError
from cirl_marl.learners.seat import Seat
from cirl_marl.learners.streams import Streams
from cirl_marl.learners.views import OneAgent, View

StepHook = Callable[[Infos, NDArray[np.bool_]], None]


class BudgetSpent(GreenletExit):  # type: ignore[misc]
    """Raised in a learner that would go on beyond its joint steps."""


class Interrupted(Exception):
    """Raised by a step hook to end training early; what was learnt is kept."""


class Lockstep:
    """Seats the learners of one batched environment and lets them run together.

    Learners are resumed in the order of ``seats``. ``joint_steps`` are control intervals done, each in every copy,
    those of a run that is resumed included.
    """

    def __init__(
        self, env: VectorEnv, seeds: Sequence[int], views: Mapping[str, View] | None = None, *, done: int = 0
    ) -> None:
        """Reset ``env`` with one of ``seeds`` per copy and seat its learners, after ``done`` joint steps before.

        ``views`` are what each learner sees, by its name; together they act for every agent once. None gives every
        agent a learner of its own.
        """
        self.env = env
        self.joint_steps = done
        self._hub = greenlet.getcurrent()
        self._own = Streams()
        self._streams: dict[str, Streams] = {}
        self._coroutines: dict[str, greenlet] = {}
        self._outcomes: dict[str, VecEnvStepReturn] = {}
        self._learning: set[str] = set()
        views = views if views is not None else {agent: OneAgent(env, agent) for agent in env.agents}
        self.seats = {name: Seat(env, name, view, self._exchange) for name, view in views.items()}
        self._show(env.reset(seed=list(seeds)))
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
            learners: by name, what learns; returns when it has learnt enough.
            actors: by name, what acts for ever once its learner is done, so that the others' world goes on.
            streams: by name, its random streams.
            budgets: by name, joint steps after which a learner that has not returned is stopped by ``BudgetSpent``.
            hook: called after each joint step, in the caller's random streams; may raise ``Interrupted``.

        Raises:
            LearnerError: if a learner raises; names it and the joint step.
            Interrupted: if the hook raised it.
        """
        self._hub = greenlet.getcurrent()
        self._streams = dict(streams)
        self._learning = set(self.seats)
        try:
            for name in self.seats:
                self._coroutines[name] = greenlet(self._task(name, learners[name], actors[name]))
                self._coroutines[name].gr_context = copy_context()
                self._resume(name)
            while self._learning:
                self._step_jointly(hook)
                for name in self.seats:
                    self._resume(name)
                    if name in self._learning and self.joint_steps >= budgets[name]:
                        self._stop_learning(name)
        finally:
            self._end()

    def _task(self, name: str, learn: Callable[[], None], act: Callable[[], None]) -> Callable[[], None]:
        def run() -> None:
            try:
                learn()
            except GreenletExit:
                if name in self._learning:
                    return  # training is over for everyone
            self._learning.discard(name)
            act()

        return run

    def _show(self, observations: Arrays) -> None:
        """Show every learner the current observations."""
        for seat in self.seats.values():
            seat.latest = seat.view.observe(observations, self.env.state)

    def _step_jointly(self, hook: StepHook | None) -> None:
        actions: dict[str, NDArray[np.floating]] = {}
        for seat in self.seats.values():
            assert seat.action is not None
            actions.update(seat.view.act(seat.action))
        try:
            observations, rewards, _, truncations, infos = self.env.step(actions)
        except ControlError as error:
            raise LearnerError(f"a learner failed at joint step {self.joint_steps}: {error}") from error
        self.joint_steps += 1
        done = next(iter(truncations.values()))
        self._returns += list(rewards.values())
        self._lengths += 1
        self._show(observations)
        returns = dict(zip(self.env.agents, self._returns, strict=True))
        for name, seat in self.seats.items():
            final = None
            if done.any():
                final = seat.view.observe(
                    {agent: infos[agent]["final_observation"] for agent in seat.view.agents},
                    lambda: infos[self.env.agents[0]]["final_state"],
                )
            self._outcomes[name] = seat.outcome(rewards, done, returns, self._lengths, final)
        if hook is not None:
            if done.any():
                for agent, total in returns.items():
                    infos[agent]["episode_return"] = total.copy()
            hook(infos, done)
        self._returns[:, done] = 0.0
        self._lengths[done] = 0

    def _exchange(self, seat: Seat) -> VecEnvStepReturn:
        """Leave the learner's coroutine until the joint step is done."""
        self._hub.switch()
        return self._outcomes.pop(seat.name)

    def _resume(self, name: str) -> None:
        try:
            self._enter(name, self._coroutines[name].switch)
        except Exception as error:
            who = self.seats[name].title
            raise LearnerError(f"{who} failed at joint step {self.joint_steps}: {error!r}") from error
        if self._coroutines[name].dead:
            raise LearnerError(f"{self.seats[name].title} stopped acting at joint step {self.joint_steps}")

    def _stop_learning(self, name: str) -> None:
        """End ``learn()`` of a learner that has used up its steps; it goes on acting from its next turn."""
        self._learning.discard(name)
        self._enter(name, lambda: self._coroutines[name].throw(BudgetSpent))

    def _end(self) -> None:
        self._learning = set(self.seats)
        for name, coroutine in self._coroutines.items():
            if not coroutine.dead:
                self._enter(name, lambda: coroutine.throw(GreenletExit))  # noqa: B023 (called at once)
        self._coroutines.clear()

    def _enter(self, name: str, action: Callable[[], object]) -> None:
        """Do something in the random streams of a learner."""
        streams = self._streams[name]
        self._own.switch_to(streams)
        try:
            action()
        finally:
            streams.switch_to(self._own)
