"""PPO and A2C of many learners as one: rollouts in the joint environment, and updates of all at once."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor

from cirl_marl.learners.learner import Learner
from cirl_marl.learners.stacked.experience import Experience
from cirl_marl.learners.stacked.perceptrons import pieces
from cirl_marl.learners.stacked.stack import Stack
from cirl_marl.learners.stacked.update import LOG_SQRT_2PI, Rules, Update
from cirl_marl.learners.stacked.weights import Weights

AT_ONCE = 1024
"""Samples of a learner that critics value at once."""

EPISODES = 100
"""Last episodes whose mean return is logged, as Stable-Baselines3 does."""


class RolloutStack(Stack):
    """PPO or A2C learners."""

    def __init__(self, members: Sequence[Learner], device: str = "cpu") -> None:
        """Take over what the learners know."""
        super().__init__(members, device)
        self._models = [_stackable(each) for each in members]
        first = self._models[0]
        self._rows, self._steps = members[0].seat.num_envs, first.n_steps
        self._timesteps, self._updates = first.num_timesteps, first._n_updates
        policies = [_policy(model) for model in self._models]
        self._weights = Weights(policies, self._inputs.seen, self._inputs.criticised, self._device)
        self._acts = torch.zeros(len(members), 1, self._weights.log_std.shape[1], device=self._device)
        for own, space in zip(self._acts, self._inputs.spaces, strict=True):
            own[:, : space.shape[0]] = 1.0
        # Minibatches come from each learner's NumPy stream itself.
        self._shuffles = [np.random.RandomState(learner.streams.bit_generator) for learner in members]
        shape = (len(members), self._rows, self._steps)
        self._rollout = Experience.empty(shape, self._inputs.entries, self._acts.shape[2], self._device)
        self._episodes: list[deque[float]] = [deque(maxlen=EPISODES) for _ in members]

    def learn(self, steps: int, wait: Callable[[], None]) -> None:
        """Learn for the share of ``steps`` that is the learners'; ``wait`` returns when the environments have moved."""
        first = self.members[0]
        total = first.spec.steps_of(steps) * (self._rows // first.seat.copies)
        if self._timesteps >= total:
            return
        resuming = self._resuming
        if not resuming:
            self._current = self._inputs.begin()
        while self._timesteps < total:
            self._reached()
            if resuming:
                self._current, resuming = self._inputs.observed(learning=False), False
            starts = np.stack([each.seat.handed.ended for each in self.members])
            self._starts = torch.as_tensor(starts, dtype=torch.float32, device=self._device)
            self._collect(wait)
            rules = Rules.of(self._models[0], self._rows * self._steps, 1.0 - self._timesteps / total)
            update = Update(self._weights, rules, self._rollout, self._acts, self._inputs.local)
            update.run(self._shuffles)
            self._updates += rules.epochs
            self._log(update)

    def _best(self, seen: Tensor) -> Tensor:
        return self._weights.actor.forward(seen[..., : self._inputs.local])[-1]

    def _give_models(self) -> None:
        self._weights.give()
        for model in self._models:
            model.num_timesteps, model._n_updates = self._timesteps, self._updates

    def _collect(self, wait: Callable[[], None]) -> None:
        """Fill the rollout by the policies of now."""
        rollout, log_std = self._rollout, self._weights.log_std[:, None]
        rollout.cut.clear()
        std, rest = log_std.exp(), -log_std - LOG_SQRT_2PI
        for t in range(self._steps):
            noise = self._drawn()
            actions = self._best(self._current) + std * noise
            rollout.seen[:, :, t], rollout.actions[:, :, t] = self._current, actions
            rollout.log_probabilities[:, :, t] = ((rest - 0.5 * noise.square()) * self._acts).sum(dim=-1)
            rollout.starts[:, :, t] = self._starts
            self._current = self._move(actions, wait)
            rollout.rewards[:, :, t], ended = self._inputs.paid()
            self._starts = torch.as_tensor(ended, dtype=torch.float32, device=self._device)
            if ended.any():
                for episodes, learner, own in zip(self._episodes, self.members, ended, strict=True):
                    if learner.seat.handed.returns is not None:
                        episodes.extend(learner.seat.handed.returns[own])
                if self.members[0].spec.bootstrap:
                    rollout.cut.append((t, self._starts, self._inputs.last_seen(ended)))
        self._timesteps += self._steps * self._rows
        model = self._models[0]
        rollout.values = self._values(rollout.seen)
        for t, cut, last in rollout.cut:
            rollout.rewards[:, :, t] += model.gamma * self._values(last) * cut
        rollout.estimate(self._values(self._current), self._starts, model.gamma, model.gae_lambda)

    def _drawn(self) -> Tensor:
        """Return standard normal noise, each learner's from its own stream, in the shape in which it draws it."""
        noise = torch.zeros(len(self.members), self._rows, self._acts.shape[2])
        for own, stream, space in zip(noise, self._noise, self._inputs.spaces, strict=True):
            own[:, : space.shape[0]] = torch.empty(self._rows, space.shape[0]).normal_(generator=stream)
        return noise.to(self._device)

    def _values(self, seen: Tensor) -> Tensor:
        """Return the critics' values, (learners, …), of what is seen, (learners, …, entries), a piece at a time."""
        critic, flat = self._weights.critic, seen.reshape(len(self.members), -1, self._inputs.entries)
        values = torch.empty(flat.shape[:2], device=self._device)
        for some in pieces(len(self.members), min(AT_ONCE, flat.shape[1]) * critic.width, self._device):
            for first in range(0, flat.shape[1], AT_ONCE):
                part = slice(first, first + AT_ONCE)
                values[some, part] = critic.forward(flat[some, part], some)[-1][..., 0]
        return values.view(seen.shape[:-1])

    def _log(self, update: Update) -> None:
        """Write what Stable-Baselines3 writes of an update, for each learner that is kept."""
        if not any(model.logger.output_formats for model in self._models):
            return
        for model, episodes, figures in zip(self._models, self._episodes, update.figures(), strict=True):
            if episodes:
                model.logger.record("rollout/ep_rew_mean", float(np.mean(episodes)))
            for name, value in figures.items():
                model.logger.record(f"train/{name}", value)
            model.logger.dump(self._timesteps)


def _stackable(learner: Learner) -> PPO | A2C:
    assert isinstance(learner.model, PPO | A2C)
    return learner.model


def _policy(model: PPO | A2C) -> ActorCriticPolicy:
    return model.policy
