"""Learners of the same settings that run as one: what does not depend on their algorithm."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
import torch
from gymnasium import spaces
from numpy.typing import NDArray
from stable_baselines3.common.running_mean_std import RunningMeanStd
from stable_baselines3.common.vec_env import VecNormalize
from torch import Tensor

from cirl_marl.learners.learner import Learner
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
        """Lay out the inputs and take over what normalisers know."""
        self._members, self._device = members, device
        views = [learner.agent_env.view for learner in members]
        self.spaces = [_box(view.action_space) for view in views]
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
        self._follows = spec.normalise.observation and spec.start is None  # statistics stay as they are after a start
        for i, columns, statistics, learner_statistics in self._statistics():
            statistics.mean[i, columns], statistics.var[i, columns], statistics.count = (
                learner_statistics.mean,
                learner_statistics.var,
                learner_statistics.count,
            )
        for returns, learner in zip(self._returns, members, strict=True):
            if isinstance(learner.env, VecNormalize):
                returns[:] = learner.env.returns

    def begin(self) -> Tensor:
        """Return what is seen, as at a reset: it counts in the moments, and discounted returns begin anew."""
        self._returns[:] = 0.0
        return self.observe(update_moments=True)

    def observe(self, *, update_moments: bool) -> Tensor:
        """Return what the learners see now, shape (N, B, entries); while learning, it counts in the moments."""
        for i, learner in enumerate(self._members):
            self._enter(i, learner.agent_env.reset())
        if update_moments and self._follows:
            for key, part in self._parts.items():
                _update(self._moments[key], part)
        return self._normalise()

    def final_observations(self, dones: NDArray[np.bool_]) -> Tensor:
        """Return what was seen last in the rows that ``dones``, shape (N, B, entries); in others, anything."""
        for i, learner in enumerate(self._members):
            if dones[i].any():
                self._enter(i, learner.agent_env.last_step.final_observation)
        return self._normalise()

    def rewards_and_dones(self) -> tuple[Tensor, NDArray[np.bool_]]:
        """Return the rewards as normalisers scale them, and which rows ended, shape (N, B) each."""
        rewards, dones = (
            np.stack(parts) for parts in zip(*(x.agent_env.rewards_and_dones() for x in self._members), strict=True)
        )
        env = self._members[0].env
        if isinstance(env, VecNormalize):
            self._returns = self._returns * env.gamma + rewards
            _update(self._return_moments, self._returns[..., None])
            self._returns[dones] = 0.0
            if env.norm_reward:
                rewards = rewards / np.sqrt(self._return_moments.var + env.epsilon)
                rewards = np.clip(rewards, -env.clip_reward, env.clip_reward)
        return torch.as_tensor(rewards, dtype=torch.float32, device=self._device), dones

    def hand_in(self, actions: Tensor) -> None:
        """Hand in actions, shape (N, B, entries), clipped to their bounds."""
        for rows, learner, space in zip(actions.cpu().numpy(), self._members, self.spaces, strict=True):
            learner.agent_env.step_async(np.clip(rows[:, : space.shape[0]], space.low, space.high))

    def give(self) -> None:
        """Give normalisers what they would know by themselves."""
        for i, columns, statistics, learner_statistics in self._statistics():
            shape = np.shape(learner_statistics.mean)
            learner_statistics.mean, learner_statistics.var = (
                np.array(own[i, columns]).reshape(shape) for own in (statistics.mean, statistics.var)
            )
            learner_statistics.count = statistics.count
        for own, learner in zip(self._returns, self._members, strict=True):
            if isinstance(learner.env, VecNormalize):
                learner.env.returns = own.copy()

    def _statistics(self) -> Iterator[tuple[int, slice, RunningMeanStd, RunningMeanStd]]:
        """Yield each learner's own moments beside ours, with its row and columns."""
        for i, learner in enumerate(self._members):
            env = learner.env
            if not isinstance(env, VecNormalize):
                continue
            yield i, slice(1), self._return_moments, env.ret_rms
            if env.norm_obs:
                by_key = env.obs_rms if isinstance(env.obs_rms, dict) else {"observation": env.obs_rms}
                for key, moments in by_key.items():
                    yield (
                        i,
                        slice(len(self.actor_columns[i]) if key == "observation" else None),
                        self._moments[key],
                        moments,
                    )

    def _enter(self, i: int, observation: Any) -> None:
        """Enter what a learner sees into the padded parts."""
        for key, part in self._parts.items():
            part_of_learner = observation[key] if isinstance(observation, dict) else observation
            part[i, :, : part_of_learner.shape[1]] = part_of_learner

    def _normalise(self) -> Tensor:
        """Return what was entered, side by side."""
        env = self._members[0].env
        parts: list[NDArray[np.floating]] = []
        for key, part in self._parts.items():
            moments = self._moments[key]
            if isinstance(env, VecNormalize) and env.norm_obs:
                standard = (part - moments.mean[:, None]) / np.sqrt(moments.var + env.epsilon)[:, None]
                parts.append(np.clip(standard, -env.clip_obs, env.clip_obs))
            else:
                parts.append(part)
        return torch.as_tensor(np.concatenate(parts, axis=2), dtype=torch.float32, device=self._device)


def _update(moments: RunningMeanStd, samples: NDArray[np.floating]) -> None:
    """Add samples, shape (N, samples, entries); their own moments are of their own precision."""
    moments.update_from_moments(samples.mean(axis=1), samples.var(axis=1), samples.shape[1])


def _box(space: spaces.Space[Any]) -> spaces.Box:
    assert isinstance(space, spaces.Box)
    return space


class Stack(ABC):
    """Learners of the same settings, from which it takes everything and to which ``give`` brings it back.

    Attributes:
        members: the learners, whose order is that of all leading axes.
    """

    def __init__(self, members: Sequence[Learner], device: str = "cpu") -> None:
        """Take over what all learners have."""
        self.members = list(members)
        self._device = torch.device(device)
        self._inputs = StackedInputs(members, self._device)
        # Noise comes from a copy of each learner's torch stream.
        self._noise = [torch.Generator().set_state(learner.streams.torch_state) for learner in members]
        self._steps_done, self._steps_given = 0, 0

    @abstractmethod
    def learn(self, steps: int, wait: Callable[[], None]) -> None:
        """Learn for the share of ``steps`` that is the learners'; ``wait`` returns when the environments have moved."""

    def act(self, wait: Callable[[], None]) -> None:
        """Act for ever without noise, learning nothing."""
        while True:
            self._arrive()
            self._inputs.hand_in(self._deterministic_actions(self._inputs.observe(update_moments=False)))
            wait()

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
    def _deterministic_actions(self, observations: Tensor) -> Tensor:
        """Return actions without noise, shape (learners, rows, entries), for what is seen."""

    @abstractmethod
    def _give_models(self) -> None:
        """Bring models up to date."""

    def _move(self, actions: Tensor, wait: Callable[[], None]) -> Tensor:
        """Act while learning; return what is seen then."""
        self._inputs.hand_in(actions)
        wait()
        self._steps_done += 1
        return self._inputs.observe(update_moments=True)
