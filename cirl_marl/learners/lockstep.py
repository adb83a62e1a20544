"""Many learners in one joint environment, or in several, in lockstep; each with random streams of its own.

Each learner's own ``learn()`` runs unmodified in a greenlet, a coroutine that need not know that it is one, against its
``AgentVecEnv``. Its ``step_wait`` switches back here; when every learner has left its actions, the joint environment
moves once and the learners go on, in a fixed order.

Stable-Baselines3 draws from the global torch and NumPy streams, and torch keeps its gradient mode per thread. Learners
that take turns in one thread would read each other's; so they are exchanged at every switch, and each learner computes
exactly what it would compute alone.
"""

from __future__ import annotations

import random
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from contextvars import copy_context
from dataclasses import fields
from typing import Annotated, Any

import numpy as np
import torch
from greenlet import GreenletExit, greenlet
from numpy.random.mtrand import get_bit_generator, set_bit_generator
from numpy.typing import NDArray
from stable_baselines3.common.utils import set_random_seed

from cirl_marl.environments.state import Snapshot, State
from cirl_marl.environments.vector import Infos, MultiAgentVectorEnv
from cirl_marl.errors import CirlError, ControlError, LearnerError, RunError
from cirl_marl.learners.agent_env import AgentVecEnv, JointStep
from cirl_marl.learners.barrier import CheckpointBarrier
from cirl_marl.learners.checkpoint import require_alike
from cirl_marl.learners.views import BatchedEnv, OneAgent, View
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.processes import no_paths

_IN_USE = threading.Lock()


class Streams:
    """The torch, NumPy and gradient-mode state of one learner while it is not running.

    NumPy's legacy stream caches one Gaussian; exchanging bit generators drops it, saving the full state keeps it but
    costs some 50 µs. ``keep_gaussian`` is for learners with action noise, the only ones that draw such Gaussians.

    Attributes:
        torch_state: of the torch stream, while it is not active.
        bit_generator: the NumPy stream itself, while it is not active; who draws from it moves it on.
    """

    def __init__(self, seed: int | None = None, *, keep_gaussian: bool = False) -> None:
        """Start fresh streams as Stable-Baselines3 seeds them; without a seed, take the ones that are active now."""
        self.keep_gaussian = keep_gaussian
        if seed is None:
            self._leave()
            return
        with global_streams_kept():
            set_bit_generator(np.random.MT19937())
            set_random_seed(seed)
            torch.set_grad_enabled(True)
            self._leave()

    def state_dict(self, *, active: bool) -> dict[str, Any]:
        """Return the state of the streams, which are the ``active`` ones or put away."""
        if active:
            self._leave()
        numpy = self.bit_generator.state if self._numpy_state is None else self._numpy_state
        return {"torch": self.torch_state, "numpy": numpy, "gaussian": self._numpy_state is not None}

    def load_state_dict(self, state: Mapping[str, Any], *, active: bool) -> None:
        """Bring the streams into a state."""
        self.torch_state, numpy = state["torch"], state["numpy"]
        self.bit_generator.state = {"bit_generator": numpy["bit_generator"], "state": numpy["state"]}
        self._numpy_state = numpy if state["gaussian"] else None
        if active:
            self._enter()

    @contextmanager
    def active(self) -> Iterator[None]:
        """Run the block with these streams; the ones active before come back after it."""
        with global_streams_kept():
            self._enter()
            try:
                yield
            finally:
                self._leave()

    def switch_to(self, successor: Streams) -> None:
        """Put these away and make ``successor`` the active ones."""
        self._leave()
        successor._enter()

    def _leave(self) -> None:
        self.torch_state = torch.get_rng_state()
        self._grad = torch.is_grad_enabled()
        self.bit_generator = get_bit_generator()
        self._numpy_state = np.random.get_state(legacy=False) if self.keep_gaussian else None  # noqa: NPY002 (Stable-Baselines3 draws from it)

    def _enter(self) -> None:
        torch.set_rng_state(self.torch_state)
        torch.set_grad_enabled(self._grad)
        set_bit_generator(self.bit_generator)
        if self._numpy_state is not None:
            np.random.set_state(self._numpy_state)  # noqa: NPY002


@contextmanager
def global_streams_kept() -> Iterator[None]:
    """Put the global torch, NumPy and Python streams and the gradient mode back after the block."""
    python = random.getstate()
    before = Streams(keep_gaussian=True)
    try:
        yield
    finally:
        before._enter()
        random.setstate(python)


@contextmanager
def global_streams_claimed() -> Iterator[None]:
    """Keep the global streams of this process for one training; a ``CirlError`` if another training has them."""
    if not _IN_USE.acquire(blocking=False):
        raise CirlError("another training is under way in this process and draws from its random streams; use another")
    try:
        yield
    finally:
        _IN_USE.release()


StepHook = Callable[[Infos, NDArray[np.bool_]], None]


class BudgetSpent(GreenletExit):  # type: ignore[misc]
    """Raised in a learner that would go on beyond its joint steps."""


class TrainingStop(Exception):
    """Raised to end training early; what was learnt is kept."""


class World:
    """A joint environment with the environments of its learners, which it feeds.

    ``joint_steps`` are steps done, each in every copy, those of a run that is resumed included.
    """

    def __init__(
        self, env: BatchedEnv, seeds: Sequence[int], agent_envs: Mapping[str, AgentVecEnv], *, done: int = 0
    ) -> None:
        """Reset ``env`` with one of ``seeds`` per copy for ``agent_envs``, after ``done`` joint steps before.

        Together they act for every agent once.
        """
        self.env, self.agent_envs, self.joint_steps = env, dict(agent_envs), done
        observations = env.reset(seed=list(seeds))
        for agent_env in self.agent_envs.values():
            agent_env.receive_reset(observations, env.state)
        self._returns = np.zeros((len(env.agents), env.num_envs))
        self._lengths = np.zeros((len(env.agents), env.num_envs), dtype=int)

    def step(self, hook: StepHook | None = None) -> None:
        """Move by the actions that were handed in, and tell every learner what came of it.

        Raises:
            LearnerError: if an action cannot be used.
        """
        actions: dict[str, NDArray[np.floating]] = {}
        for agent_env in self.agent_envs.values():
            if not agent_env.absent:
                assert agent_env.action is not None
                actions.update(agent_env.view.act(agent_env.action))
        try:
            observations, rewards, terminations, truncations, infos = self.env.step(actions)
        except ControlError as error:
            raise LearnerError(f"a learner failed at joint step {self.joint_steps}: {error}") from error
        self.joint_steps += 1
        truncated = np.array(list(truncations.values()))
        dones = truncated | list(terminations.values())
        self._returns = self._returns + list(rewards.values())
        self._lengths = self._lengths + 1
        returns, lengths = self._by_agent(self._returns), self._by_agent(self._lengths)
        ends = self._by_agent(dones), self._by_agent(truncated)
        step = JointStep(observations, self.env.state, rewards, *ends, returns, lengths, infos)
        for agent_env in self.agent_envs.values():
            agent_env.receive_step(step)
        if hook is not None:
            if dones.any():
                for agent, total in returns.items():
                    infos[agent]["episode_return"] = total.copy()
            hook(infos, dones.all(axis=0))
        self._returns, self._lengths = np.where(dones, 0.0, self._returns), np.where(dones, 0, self._lengths)

    def _by_agent(self, rows: NDArray[Any]) -> dict[str, NDArray[Any]]:
        return dict(zip(self.env.agents, rows, strict=True))


class NetworkWorld(World):
    """The world of a network, which can be saved and resumed."""

    env: MultiAgentVectorEnv

    def __init__(
        self, env: MultiAgentVectorEnv, seeds: Sequence[int], views: Mapping[str, View] | None = None, *, done: int = 0
    ) -> None:
        """Make the learners' environments, and reset ``env`` as ``World`` does.

        ``views`` are what each learner sees, by its name; None gives every agent a learner of its own.
        """
        views = views if views is not None else {agent: OneAgent(env, agent) for agent in env.agents}
        super().__init__(env, seeds, {name: AgentVecEnv(env, name, view) for name, view in views.items()}, done=done)

    def state_dict(self) -> dict[str, Any]:
        """Return all that a world is resumed from, but for its learners."""
        now = self.env.snapshot()
        state = {part.name: getattr(now.state, part.name) for part in fields(State)}
        progress = {"returns": self._returns, "lengths": self._lengths, "weight": self.env.circularity_weight}
        return {"state": state, "streams": list(now.streams), "joint_steps": self.joint_steps, **progress}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Resume from the state of a world of the same environment; the learners load their last step themselves.

        Raises:
            RunError: if it holds something else than the arrays of this environment.
        """
        physical = state.get("state") if isinstance(state, Mapping) else None
        if isinstance(physical, Mapping):  # older ones say nothing of what there was not
            network, batch = self.env.network, self.env.num_envs
            accounts = np.zeros((len(network.accounts), batch))
            missing = {"processes": no_paths(), "disturbances": no_paths(), "accounts": accounts}
            missing["substances"] = np.zeros((len(network.substances) * len(network.arcs), batch))
            state = {**state, "state": {**missing, **physical}}
        require_alike(state, self.state_dict(), "the state of the environment")
        streams = tuple(state["streams"])
        self.env.restore(Snapshot(State(**state["state"]), streams, self.env.agents, self.env.network))
        self.env.circularity_weight = state["weight"]
        self.joint_steps, self._returns, self._lengths = state["joint_steps"], state["returns"], state["lengths"]


@positional_record
class Participant:
    """Who acts for one or more learners: a learner itself, or a stack of them."""

    title: Annotated[str, "what messages call it"]
    learn: Annotated[Callable[[], None], "learns, waiting for each joint step; returns when it has learnt enough"]
    act: Annotated[Callable[[], None], "acts for ever, once ``learn`` is done, so that the others' world goes on"]
    streams: Annotated[Streams, "its random streams"]
    barriers: Annotated[Sequence[CheckpointBarrier], "of each learner that it is"] = ()
    busy: Annotated[Callable[[], bool], "whether it comes to no barrier before something is over"] = lambda: False
    budget: Annotated[Callable[[], int], "joint steps after which ``BudgetSpent`` stops it"] = lambda: 2**62
    absent: Annotated[Callable[[], bool], "whether it has nothing to do in the next step"] = lambda: False


class Lockstep:
    """Runs participants as coroutines: each goes on until it waits for a joint step; then all worlds move at once.

    Greenlets switch where the code says so, unlike threads, so that the order is always the same and no lock is needed.
    """

    def __init__(self, worlds: Sequence[World], participants: Sequence[Participant]) -> None:
        """``participants`` are resumed in their order; together they act for every agent of ``worlds``."""
        self._worlds, self._participants = worlds, participants
        self._caller_streams = Streams()
        self._coroutines: list[greenlet] = []
        self._learners: set[int] = set()

    @property
    def all_have_saved(self) -> bool:
        """Whether every learner has written the state that was asked for."""
        return all(barrier.log is not None for participant in self._participants for barrier in participant.barriers)

    @property
    def busy(self) -> bool:
        """Whether somebody will not come to a barrier soon."""
        return any(participant.busy() for participant in self._participants)

    def run(self, hooks: Sequence[StepHook] | None = None, after: Callable[[], None] = lambda: None) -> None:
        """Run every learner to its end.

        Args:
            hooks: of each world, called within each joint step, in the caller's random streams.
            after: called after each joint step of all worlds; it ends the run by ``TrainingStop``.

        Raises:
            LearnerError: if a learner raises; names it and the joint step.
            TrainingStop: if it was enough.
        """
        self._learners = set(range(len(self._participants)))
        try:
            for i, participant in enumerate(self._participants):
                self._coroutines.append(greenlet(self._task(i, participant)))
                # a greenlet begins with an empty context otherwise, without ``np.errstate`` of the caller
                self._coroutines[i].gr_context = copy_context()
                if not participant.absent():
                    self._resume(i)
                    self._replay(i)
            while self._learners:
                for place, world in enumerate(self._worlds):
                    world.step(hooks[place] if hooks is not None else None)
                for participant in self._participants:
                    for barrier in participant.barriers:
                        barrier.record()
                after()
                for i in range(len(self._participants)):
                    self._turn(i, self._joint_steps)
        finally:
            self._end()

    def _turn(self, i: int, step: int) -> None:
        """Let a participant go on after a joint step, and stop it if it has used up its steps."""
        if not self._participants[i].absent():
            self._resume(i)
        if i in self._learners and step >= self._participants[i].budget():
            self._stop_learning(i)

    def _replay(self, i: int) -> None:
        """Let a resumed participant repeat the steps of its replay log: it ends where the environment is already."""
        barriers = self._participants[i].barriers
        count = max((len(barrier.replay_log) for barrier in barriers), default=0)
        for place in range(count):
            for barrier in barriers:
                barrier.replay_step(place)
            self._turn(i, self._joint_steps - count + place + 1)
        for barrier in barriers:
            barrier.replay_log = []

    @property
    def _joint_steps(self) -> int:
        """Steps that every world has behind it."""
        return min(world.joint_steps for world in self._worlds)

    def _task(self, i: int, participant: Participant) -> Callable[[], None]:
        def run() -> None:
            try:
                participant.learn()
            except GreenletExit:
                if i in self._learners:
                    return  # training is over for everyone
            self._learners.discard(i)
            participant.act()

        return run

    def _resume(self, i: int) -> None:
        title, step = self._participants[i].title, self._joint_steps
        try:
            self._enter(i, self._coroutines[i].switch)
        except RunError:  # of a checkpoint, which it loads at its first barrier
            raise
        except Exception as error:
            raise LearnerError(f"{title} failed at joint step {step}: {error!r}") from error
        if self._coroutines[i].dead:
            raise LearnerError(f"{title} stopped acting at joint step {step}")

    def _stop_learning(self, i: int) -> None:
        """End ``learn()`` of a learner that has used up its steps; it goes on acting from its next turn."""
        self._learners.discard(i)
        if self._coroutines[i]:
            self._enter(i, lambda: self._coroutines[i].throw(BudgetSpent))
        else:  # it was absent from the beginning, and has not begun
            self._coroutines[i] = greenlet(self._participants[i].act)

    def _end(self) -> None:
        self._learners = set(range(len(self._participants)))
        for i, coroutine in enumerate(self._coroutines):
            if not coroutine.dead:
                self._enter(i, lambda: coroutine.throw(GreenletExit))  # noqa: B023 (called at once)
        self._coroutines.clear()

    def _enter(self, i: int, action: Callable[[], object]) -> None:
        """Run ``action`` in the random streams and torch modes of a participant: both are global to the thread."""
        streams = self._participants[i].streams
        self._caller_streams.switch_to(streams)
        try:
            action()
        finally:
            streams.switch_to(self._caller_streams)
