"""Learners of the same settings that run as one, whatever their algorithm: inputs, normalisers, noise.

N learners with B rows each become arrays with N as leading axis, so that one batched operation does the work of N small
ones. Spaces of unequal lengths are padded with zeros, which weights that are zero multiply.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd
from torch import Tensor

from cirl_marl.controllers.basic import Arrays
from cirl_marl.learners.agent_env import wait
from cirl_marl.learners.checkpoint import observation_statistics
from cirl_marl.learners.learner import Learner
from cirl_marl.learners.policies import Policies
from cirl_marl.learners.stacked.perceptrons import Weights
from cirl_marl.network import Integers


class StackedInputs:
    """Observations, actions and rewards of N learners with B rows each.

    Observations come first, padded with zeros; where critics see the state, it follows, as in the policies' own order.

    Attributes:
        spaces: of the actions of each learner.
        local: entries of the longest observation.
        entries: with the state.
        actor_columns: columns at which the actor of each learner looks.
        critic_columns: columns at which its critic looks.
    """

    def __init__(self, members: Sequence[Learner], device: torch.device) -> None:
        """Lay out the inputs and take over the moments of the normalisers."""
        self._members, self._device = members, device
        views = [learner.agent_env.view for learner in members]
        self.spaces: list[Any] = [view.action_space for view in views]
        self._low, self._high = (_bound_rows([getattr(space, end) for space in self.spaces]) for end in ("low", "high"))
        rows, states = members[0].agent_env.num_envs, views[0].state_entries
        lengths = [spaces.flatdim(view.observation_space) - states for view in views]
        self.local, self.entries = max(lengths), max(lengths) + states
        self.actor_columns: list[Integers] = [np.arange(entries) for entries in lengths]
        state = np.arange(self.local, self.entries)
        self.critic_columns: list[Integers] = [np.concatenate([columns, state]) for columns in self.actor_columns]
        # in the precision in which the learners see them, which is that of their moments
        self._parts: dict[str, NDArray[np.floating]] = {
            "observation": np.zeros((len(members), rows, self.local), dtype=np.float32)
        }
        if states:
            self._parts["state"] = np.zeros((len(members), rows, states))
        self._returns = np.zeros((len(members), rows))
        # of all learners at once, shape (N, entries): they have seen the same number of samples
        self._moments = {key: RunningMeanStd(shape=(len(members), part.shape[2])) for key, part in self._parts.items()}
        self._return_moments = RunningMeanStd(shape=(len(members), 1))
        spec = members[0].spec
        frozen = spec.start.frozen_statistics if spec.start is not None else ()
        self._follows = [key for key in self._parts if spec.normalise.observation and key not in frozen]
        for rows_of_all, moments, of_learner in self._statistics():
            moments.mean[rows_of_all], moments.var[rows_of_all] = of_learner.mean, of_learner.var
            moments.count = of_learner.count
        for returns, learner in zip(self._returns, members, strict=True):
            if learner.normaliser is not None:
                returns[:] = learner.normaliser.returns

    def begin(self) -> Tensor:
        """Return the observations as at a reset: they count in the moments, and discounted returns begin anew."""
        self._returns[:] = 0.0
        return self.observe(update_moments=True)

    def observe(self, *, update_moments: bool) -> Tensor:
        """Return the present observations, shape (N, B, entries); ``update_moments`` has them count in the moments."""
        for i, learner in enumerate(self._members):
            _enter(self._parts, i, learner.agent_env.observation)
        if update_moments:
            for key in self._follows:
                _update(self._moments[key], self._parts[key])
        return self._normalise()

    def final_observations(self, dones: NDArray[np.bool_]) -> Tensor:
        """Return the last observations of the episodes that ended, shape (N, B, entries); anything in other rows."""
        for i, learner in enumerate(self._members):
            if dones[i].any():
                _enter(self._parts, i, learner.agent_env.last_step.final_observation)
        return self._normalise()

    def normalise(self, observations: Sequence[Any], members: slice) -> Tensor:
        """Return what ``members`` observe in another environment, normalised, shape (members, rows, entries)."""
        first = observations[0]
        count = len(next(iter(first.values())) if isinstance(first, dict) else first)
        shape = (len(observations), count)
        parts = {key: np.zeros((*shape, part.shape[2]), dtype=part.dtype) for key, part in self._parts.items()}
        for i, observation in enumerate(observations):
            _enter(parts, i, observation)
        return self._normalise(parts, members)

    def rewards_and_dones(self) -> tuple[Tensor, NDArray[np.bool_]]:
        """Return the rewards as normalisers scale them, and which rows ended, shape (N, B) each."""
        rewards: NDArray[np.floating] = np.empty(self._returns.shape, dtype=np.float32)
        dones = np.empty(rewards.shape, dtype=bool)
        for i, learner in enumerate(self._members):
            rewards[i], dones[i] = learner.agent_env.rewards, learner.agent_env.dones
            learner.agent_env.centre(rewards[i])
        normaliser = self._members[0].normaliser
        if normaliser is not None:
            self._returns = self._returns * normaliser.gamma + rewards
            _update(self._return_moments, self._returns[..., None])
            self._returns[dones] = 0.0
            if normaliser.norm_reward:
                rewards = rewards / np.sqrt(self._return_moments.var + normaliser.epsilon)
                rewards = np.clip(rewards, -normaliser.clip_reward, normaliser.clip_reward)
        return torch.as_tensor(rewards, dtype=torch.float32, device=self._device), dones

    def hand_in(self, actions: Tensor) -> None:
        """Hand in actions, shape (N, B, entries), clipped to their bounds."""
        moves = np.clip(actions.cpu().numpy(), self._low, self._high)  # all at once: a call each costs 5 µs
        for rows, learner, space in zip(moves, self._members, self.spaces, strict=True):
            learner.agent_env.step_async(rows[:, : space.shape[0]])

    def give(self) -> None:
        """Bring the normalisers of the learners up to date."""
        for rows_of_all, moments, of_learner in self._statistics():
            shape = np.shape(of_learner.mean)
            of_learner.mean = np.array(moments.mean[rows_of_all]).reshape(shape)
            of_learner.var = np.array(moments.var[rows_of_all]).reshape(shape)
            of_learner.count = moments.count
        for returns, learner in zip(self._returns, self._members, strict=True):
            if learner.normaliser is not None:
                learner.normaliser.returns = returns.copy()

    def _statistics(self) -> Iterator[tuple[tuple[int, slice], RunningMeanStd, RunningMeanStd]]:
        """Yield where the moments of a learner stand in those of all, these, and its own."""
        for i, learner in enumerate(self._members):
            if learner.normaliser is not None:
                yield (i, slice(1)), self._return_moments, learner.normaliser.ret_rms
                for key, moments in observation_statistics(learner.normaliser).items():
                    length = len(self.actor_columns[i]) if key == "observation" else None  # the rest is padding
                    yield (i, slice(length)), self._moments[key], moments

    @property
    def slopes(self) -> NDArray[np.floating]:
        """By what normalisers multiply differences of observations now, shape (N, 1, entries) or (1, 1, 1)."""
        normaliser = self._members[0].normaliser
        if normaliser is None or not normaliser.norm_obs:
            return np.ones((1, 1, 1))
        return np.asarray(1.0 / np.sqrt(self._moments["observation"].var + normaliser.epsilon)[:, None])

    def _normalise(
        self, blocks: Mapping[str, NDArray[np.floating]] | None = None, members: slice = slice(None)
    ) -> Tensor:
        normaliser, parts = self._members[0].normaliser, list((blocks or self._parts).values())
        if normaliser is not None and normaliser.norm_obs:
            for place, (part, moments) in enumerate(zip(parts, self._moments.values(), strict=True)):
                mean, var = moments.mean[members], moments.var[members]
                standard = (part - mean[:, None]) / np.sqrt(var + normaliser.epsilon)[:, None]
                parts[place] = np.clip(standard, -normaliser.clip_obs, normaliser.clip_obs)
        return torch.as_tensor(np.concatenate(parts, axis=2), dtype=torch.float32, device=self._device)


def _bound_rows(bounds: Sequence[NDArray[np.floating]]) -> NDArray[np.float32]:
    """Return bounds of N learners with zeros after them, shape (N, 1, longest)."""
    rows = np.zeros((len(bounds), 1, max(map(len, bounds))), dtype=np.float32)
    for row, bound in zip(rows, bounds, strict=True):
        row[0, : len(bound)] = bound
    return rows


def _enter(parts: Mapping[str, NDArray[np.floating]], i: int, observation: Any) -> None:
    """Write what learner ``i`` observes into the parts of all."""
    for key, part in parts.items():
        rows = observation[key] if isinstance(observation, dict) else observation
        part[i, :, : rows.shape[1]] = rows


def _update(moments: RunningMeanStd, samples: NDArray[np.floating]) -> None:
    """Add samples, shape (N, samples, entries); their own moments are of their own precision."""
    mean = samples.mean(axis=1)
    moments.update_from_moments(mean, samples.var(axis=1, mean=mean[:, None]), samples.shape[1])


class Stack(ABC):
    """Learners of the same settings, from which it takes everything and to which ``give`` brings it back.

    Attributes:
        members: the learners, whose order is that of all leading axes.
    """

    def __init__(self, members: Sequence[Learner], device: str = "cpu") -> None:
        """Take over the inputs and the torch streams of the learners."""
        self.members = list(members)
        self._models: list[Any] = [member.model for member in members]
        self._device = torch.device(device)
        self._inputs = StackedInputs(members, self._device)
        # Noise comes from a copy of each learner's torch stream.
        self._noise = [torch.Generator().set_state(learner.streams.torch_state) for learner in members]
        self._steps_done, self._steps_given = 0, 0

    @abstractmethod
    def learn(self, steps: int) -> None:
        """Learn for the share of ``steps`` that is the learners'."""

    def act(self) -> None:
        """Act for ever without noise, learning nothing."""
        while True:
            self._arrive()
            self._inputs.hand_in(self._deterministic_actions(self._inputs.observe(update_moments=False)))
            wait()

    def predict(self, observations: Sequence[Any], members: slice) -> list[NDArray[np.floating]]:
        """Return the actions without noise of ``members`` for rows that each observes elsewhere, clipped."""
        outputs = self._deterministic_actions(self._inputs.normalise(observations, members), members).cpu().numpy()
        boxes = self._inputs.spaces[members]
        return [np.clip(rows[:, : box.shape[0]], box.low, box.high) for rows, box in zip(outputs, boxes, strict=True)]

    @property
    def _is_restoring(self) -> bool:
        """Whether the learners go on from where they were saved, and have not come there yet."""
        return any(member.barrier.is_restoring for member in self.members)

    def _arrive(self) -> None:
        """Let the members be saved, or go on."""
        if any(member.barrier.folder is not None for member in self.members):
            self.give()
        for member in self.members:
            member.barrier.arrive()

    def give(self) -> None:
        """Bring models, normalisers and random streams up to date, as if each learner had learnt by itself."""
        if self._steps_given == self._steps_done:
            return
        self._steps_given = self._steps_done
        self._inputs.give()
        self._give_models()
        for learner, noise in zip(self.members, self._noise, strict=True):
            learner.streams.torch_state = noise.get_state()

    @abstractmethod
    def _deterministic_actions(self, observations: Tensor, members: slice = slice(None)) -> Tensor:
        """Return actions without noise of ``members``, shape (members, rows, entries), for what they observe."""

    @abstractmethod
    def _give_models(self) -> None:
        """Bring models up to date."""

    def _move(self, actions: Tensor) -> Tensor:
        """Act while learning; return the next observations."""
        self._inputs.hand_in(actions)
        wait()
        self._steps_done += 1
        return self._inputs.observe(update_moments=True)


class ActorStack(Stack):
    """Learners whose actors and critics are the perceptrons of ``Weights``: they play for a while, then climb."""

    def __init__(self, members: Sequence[Learner], device: str = "cpu") -> None:
        """Take over parameters, optimisers, counters and streams of the learners."""
        super().__init__(members, device)
        inputs, policies = self._inputs, [model.policy for model in self._models]
        self._timesteps, self._updates = self._models[0].num_timesteps, self._models[0]._n_updates
        self._weights = Weights(policies, inputs.actor_columns, inputs.critic_columns, self._device)

    def learn(self, steps: int) -> None:
        """Learn for the share of ``steps`` that is the learners'."""
        first = self.members[0]
        total = first.spec.steps_of(steps) * (first.agent_env.num_envs // first.agent_env.copies)
        if self._timesteps >= total:
            return
        is_restoring = self._is_restoring
        if not is_restoring:
            self._current = self._inputs.begin()
        while self._timesteps < total:
            self._keep_progress()
            self._arrive()
            if is_restoring:
                self._current, is_restoring = self._inputs.observe(update_moments=False), False
            self._play()
            self._climb(1.0 - self._timesteps / total)

    def _keep_progress(self) -> None:
        """Leave with the first model what a resumed training needs beside it."""

    @abstractmethod
    def _play(self) -> None:
        """Act for a while, and keep what is learnt from."""

    @abstractmethod
    def _climb(self, progress_remaining: float) -> None:
        """Move the weights by what was kept."""

    def _deterministic_actions(self, observations: Tensor, members: slice = slice(None)) -> Tensor:
        return self._weights.actor.forward(observations[..., : self._inputs.local], members)[-1]

    def _give_models(self) -> None:
        self._weights.give()
        for model in self._models:
            model.num_timesteps, model._n_updates = self._timesteps, self._updates


class StackedPolicies(Policies):
    """The policies of learners, those of a stack all at once: the same but for rounding."""

    def __init__(self, learners: Mapping[str, Learner], stacks: Sequence[Stack]) -> None:
        """Act by ``learners``; stacks may have those of other trainings too, of which each has its own together."""
        names = {id(learner): name for name, learner in learners.items()}
        self._parts: list[tuple[Stack, slice]] = []
        for stack in stacks:
            places = [i for i, member in enumerate(stack.members) if id(member) in names]
            if places:
                self._parts.append((stack, slice(places[0], places[-1] + 1)))
        in_stacks = {id(member) for stack, part in self._parts for member in stack.members[part]}
        rest = {name: learner.policy for name, learner in learners.items() if id(learner) not in in_stacks}
        super().__init__(rest)

    def act(self, observations: Arrays) -> Arrays:
        """Return the deterministic actions of all agents."""
        actions = dict(super().act(observations))
        for stack, part in self._parts:
            views = [member.agent_env.view for member in stack.members[part]]
            rows = stack.predict([view.observe(observations, self._state) for view in views], part)
            for view, action in zip(views, rows, strict=True):
                actions.update(view.act(action))
        return actions
