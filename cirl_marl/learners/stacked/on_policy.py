"""PPO and A2C of many learners as one: rollouts in the joint environment, and updates of all at once."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.utils import update_learning_rate
from torch import Tensor

from cirl_marl.learners.learner import Learner
from cirl_marl.learners.stacked.perceptrons import Weights, pieces
from cirl_marl.learners.stacked.stack import Stack


@dataclass(slots=True)
class StackedRollout:
    """T steps of B rows of N learners; shapes are (N, B, T), with entries last where there are some.

    Attributes:
        observations: normalised.
        actions: not clipped.
        rewards: as normalisers scale them.
        log_probabilities: of the actions.
        starts: 1 where an episode began.
        values: of the critic.
        advantages: generalised advantage estimates.
        returns: values plus advantages, the targets of the critic.
        cut: truncations: the step, the rows, shape (N, B), and the last observations, shape (N, B, entries), whose
            value is added to the reward.
    """

    observations: Tensor
    actions: Tensor
    rewards: Tensor
    log_probabilities: Tensor
    starts: Tensor
    values: Tensor
    advantages: Tensor
    returns: Tensor
    cut: list[tuple[int, Tensor, Tensor]] = field(default_factory=list)

    @classmethod
    def empty(cls, shape: tuple[int, int, int], entries: int, actions: int, device: torch.device) -> StackedRollout:
        """Return one to be filled, of shape (N, B, T)."""

        def zeros(*last: int) -> Tensor:
            return torch.zeros(*shape, *last, device=device)

        return cls(zeros(entries), zeros(actions), zeros(), zeros(), zeros(), zeros(), zeros(), zeros())

    def estimate(self, last_value: Tensor, last_starts: Tensor, gamma: float, gae_lambda: float) -> None:
        """Estimate advantages and returns, Schulman et al. 2016, arXiv 1506.02438, eq. 16.

        δ_t = r_t + γ V_{t+1} − V_t,  A_t = δ_t + γ λ A_{t+1},  where V_{t+1} and A_{t+1} are 0 if t ended an episode
        """
        advantage, value, goes_on = torch.zeros_like(last_value), last_value, 1.0 - last_starts
        for t in reversed(range(self.rewards.shape[2])):
            step = self.rewards[:, :, t] + gamma * value * goes_on - self.values[:, :, t]
            advantage = step + gamma * gae_lambda * goes_on * advantage
            self.advantages[:, :, t] = advantage
            value, goes_on = self.values[:, :, t], 1.0 - self.starts[:, :, t]
        self.returns = self.advantages + self.values

    def samples(self, learners: slice, order: Tensor) -> Samples:
        """Return samples of some learners by their indices, shape (learners, samples), of all B·T, row by row."""
        total = self.rewards.shape[1] * self.rewards.shape[2]
        first = torch.arange(order.shape[0], device=order.device)[:, None] * total
        index = (order + first).flatten()

        def pick(values: Tensor) -> Tensor:
            entries = values.shape[3:]
            rows: Tensor = values[learners].reshape(-1, *entries).index_select(0, index)
            return rows.view(*order.shape, *entries)

        parts = (self.observations, self.actions, self.values, self.log_probabilities, self.advantages, self.returns)
        return Samples(*map(pick, parts))


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of some learners; shapes are (learners, samples), with a last axis of entries where there is one."""

    observations: Tensor
    actions: Tensor
    values: Tensor
    log_probabilities: Tensor
    advantages: Tensor
    returns: Tensor

    def normalised_advantages(self) -> Tensor:
        """Return the advantages of each learner with mean 0 and standard deviation 1."""
        mean, std = self.advantages.mean(dim=1, keepdim=True), self.advantages.std(dim=1, keepdim=True)
        return (self.advantages - mean) / (std + 1e-8)


LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)


@dataclass(frozen=True, slots=True)
class Rules:
    """How an algorithm learns from a rollout; ``clip`` is None for A2C, which moves once and by all samples."""

    epochs: int
    batch: int
    clip: float | None
    clip_value: float | None
    normalises: bool
    entropy_weight: float
    value_weight: float
    largest_norm: float
    rate: float

    @classmethod
    def of(cls, model: PPO | A2C, samples: int, progress_remaining: float) -> Rules:
        """Return those of a model for as many samples, when this share of the run remains."""
        weights = (model.ent_coef, model.vf_coef, model.max_grad_norm)
        rate, normalises = model.lr_schedule(progress_remaining), model.normalize_advantage
        if isinstance(model, A2C):
            return cls(1, samples, None, None, normalises, *weights, rate)
        clip, clip_value = (
            limit(progress_remaining) if callable(limit) else limit for limit in (model.clip_range, model.clip_range_vf)
        )
        return cls(model.n_epochs, model.batch_size, clip, clip_value, normalises, *weights, rate)


@dataclass(frozen=True, slots=True)
class PolicyLoss:
    """A policy's loss, shape (learners,), and its gradient by each log-probability, shape (learners, samples).

    ``clipped`` is the share of samples that were, ``divergence`` the mean of r − 1 − log r for r = π/π_old.
    """

    value: Tensor
    gradient: Tensor
    clip_share: Tensor
    divergence: Tensor


def policy_loss(log_probabilities: Tensor, samples: Samples, advantages: Tensor, clip: float | None) -> PolicyLoss:
    """Return the loss of PPO, or of A2C if nothing is clipped; M is the number of samples.

    PPO: L = −mean(min(A r, A clip(r, 1 − ε, 1 + ε))) with r = π/π_old, so that ∂L/∂log π = −A r/M, 0 where clipped
    (Schulman et al. 2017, arXiv 1707.06347, eq. 7). A2C: L = −mean(A log π), so that ∂L/∂log π = −A/M.
    """
    count = advantages.shape[1]
    log_ratio = log_probabilities - samples.log_probabilities
    ratio = log_ratio.exp()
    divergence = (ratio - 1 - log_ratio).mean(dim=1)
    if clip is None:
        value = -(advantages * log_probabilities).mean(dim=1)
        return PolicyLoss(value, -advantages / count, torch.zeros_like(value), divergence)
    gain, clipped_gain = advantages * ratio, advantages * ratio.clamp(1 - clip, 1 + clip)
    return PolicyLoss(
        value=-torch.minimum(gain, clipped_gain).mean(dim=1),
        gradient=torch.where(gain <= clipped_gain, -gain / count, 0.0),
        clip_share=((ratio - 1).abs() > clip).float().mean(dim=1),
        divergence=divergence,
    )


def value_loss(values: Tensor, samples: Samples, clip: float | None) -> tuple[Tensor, Tensor]:
    """Return mean((V − R)²) and its gradient by V; V moves from its old value by at most ``clip``, if there is one."""
    clipped_values = values if clip is None else samples.values + (values - samples.values).clamp(-clip, clip)
    error = clipped_values - samples.returns
    gradient = 2 * error / error.shape[1]
    if clip is not None:
        gradient = torch.where((values - samples.values).abs() <= clip, gradient, 0.0)
    return error.square().mean(dim=1), gradient


class Update:
    """One update of all learners by their rollouts; ``acts`` is 1 where a learner has an entry of its action."""

    def __init__(self, weights: Weights, rules: Rules, rollout: StackedRollout, acts: Tensor, local: int) -> None:
        """``local`` is the number of columns of the observations at which actors look."""
        self._weights, self._rules, self._rollout = weights, rules, rollout
        self._acts, self._local = acts, local
        self._sums, self._count = np.zeros((len(acts), len(FIGURES))), 0

    def run(self, shuffles: list[np.random.RandomState]) -> None:
        """Pass over the samples in minibatches, which each learner draws from its own stream."""
        weights, rules = self._weights, self._rules
        learners, device = len(shuffles), weights.matrix.device
        total = self._rollout.rewards[0].numel()
        update_learning_rate(weights.optimiser, rules.rate)
        for _ in range(rules.epochs):
            order = torch.as_tensor(np.stack([stream.permutation(total) for stream in shuffles]), device=device)
            for first in range(0, total, rules.batch):
                part = order[:, first : first + rules.batch]
                for members in pieces(learners, part.shape[1] * weights.actor.width, device):
                    self._differentiate(self._rollout.samples(members, part[members]), members)
                weights.clip(rules.largest_norm)
                weights.optimiser.step()
                self._count += 1

    def _differentiate(self, samples: Samples, members: slice) -> None:
        """Write the gradients of the loss of some learners: L = L_π − c_H H + c_V L_V.

        With z = (a − μ)/σ, ∂log π/∂μ = z/σ and ∂log π/∂log σ = z² − 1 for each entry of the action.
        """
        weights, rules, acts = self._weights, self._rules, self._acts[members]
        log_std = weights.log_std[members][:, None]
        std = log_std.exp()
        units = weights.actor.forward(samples.observations[..., : self._local], members)
        z = (samples.actions - units[-1]) / std
        log_probabilities = ((-0.5 * z.square() - log_std - LOG_SQRT_2PI) * acts).sum(dim=-1)
        normalises = rules.normalises and samples.advantages.shape[1] > 1
        advantages = samples.normalised_advantages() if normalises else samples.advantages
        policy = policy_loss(log_probabilities, samples, advantages, rules.clip)
        action_gradient = policy.gradient[..., None] * acts
        weights.log_std_gradient[members] = ((z.square() - 1) * action_gradient).sum(
            dim=1
        ) - rules.entropy_weight * acts[:, 0]
        weights.actor.backward(units, z / std * action_gradient, members)
        units = weights.critic.forward(samples.observations, members)
        loss, gradient = value_loss(units[-1][..., 0], samples, rules.clip_value)
        weights.critic.backward(units, (rules.value_weight * gradient)[..., None], members)
        figures = torch.stack([policy.value, policy.clip_share, policy.divergence, loss], dim=1)
        self._sums[members] += figures.cpu().numpy()

    def figures(self) -> Iterator[dict[str, float]]:
        """Yield the figures of each learner that Stable-Baselines3 writes of an update."""
        rollout, log_std = self._rollout, self._weights.log_std
        residual = (rollout.returns - rollout.values).flatten(1).var(dim=1) / rollout.returns.flatten(1).var(dim=1)
        entropy = ((log_std + LOG_SQRT_2PI + 0.5) * self._acts[:, 0]).sum(dim=1)
        std = (log_std.exp() * self._acts[:, 0]).sum(dim=1) / self._acts[:, 0].sum(dim=1)
        for i, sums in enumerate(self._sums / max(1, self._count)):
            means = dict(zip(FIGURES, sums.tolist(), strict=True))
            yield means | {
                "entropy_loss": -float(entropy[i]),
                "explained_variance": 1.0 - float(residual[i]),
                "std": float(std[i]),
                "learning_rate": self._rules.rate,
            }


FIGURES = ("policy_gradient_loss", "clip_fraction", "approx_kl", "value_loss")
"""Means over minibatches."""


AT_ONCE = 1024
"""Samples of a learner that critics value at once."""

EPISODES = 100
"""Last episodes whose mean return is logged, as Stable-Baselines3 does."""


class RolloutStack(Stack):
    """PPO or A2C learners."""

    def __init__(self, members: Sequence[Learner], device: str = "cpu") -> None:
        """Take over parameters, optimisers, counters and streams of the learners."""
        super().__init__(members, device)
        self._models = [_stackable(member) for member in members]
        first = self._models[0]
        self._rows, self._steps = members[0].agent_env.num_envs, first.n_steps
        self._timesteps, self._updates = first.num_timesteps, first._n_updates
        policies = [model.policy for model in self._models]
        self._weights = Weights(policies, self._inputs.actor_columns, self._inputs.critic_columns, self._device)
        self._acts = torch.zeros(len(members), 1, self._weights.log_std.shape[1], device=self._device)
        for mask, space in zip(self._acts, self._inputs.spaces, strict=True):
            mask[:, : space.shape[0]] = 1.0
        # Minibatches come from each learner's NumPy stream itself.
        self._shuffles = [np.random.RandomState(learner.streams.bit_generator) for learner in members]
        shape = (len(members), self._rows, self._steps)
        self._rollout = StackedRollout.empty(shape, self._inputs.entries, self._acts.shape[2], self._device)
        self._episodes: list[deque[float]] = [deque(maxlen=EPISODES) for _ in members]

    def learn(self, steps: int, wait: Callable[[], None]) -> None:
        """Learn for the share of ``steps`` that is the learners'; ``wait`` returns when the environments have moved."""
        first = self.members[0]
        total = first.spec.steps_of(steps) * (self._rows // first.agent_env.copies)
        if self._timesteps >= total:
            return
        is_restoring = self._is_restoring
        if not is_restoring:
            self._current = self._inputs.begin()
        while self._timesteps < total:
            self._arrive()
            if is_restoring:
                self._current, is_restoring = self._inputs.observe(update_moments=False), False
            starts = np.stack([member.agent_env.last_step.dones for member in self.members])
            self._starts = torch.as_tensor(starts, dtype=torch.float32, device=self._device)
            self._collect(wait)
            rules = Rules.of(self._models[0], self._rows * self._steps, 1.0 - self._timesteps / total)
            update = Update(self._weights, rules, self._rollout, self._acts, self._inputs.local)
            update.run(self._shuffles)
            self._updates += rules.epochs
            self._log(update)

    def _deterministic_actions(self, observations: Tensor) -> Tensor:
        return self._weights.actor.forward(observations[..., : self._inputs.local])[-1]

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
            noise = self._draw_noise()
            actions = self._deterministic_actions(self._current) + std * noise
            rollout.observations[:, :, t], rollout.actions[:, :, t] = self._current, actions
            rollout.log_probabilities[:, :, t] = ((rest - 0.5 * noise.square()) * self._acts).sum(dim=-1)
            rollout.starts[:, :, t] = self._starts
            self._current = self._move(actions, wait)
            rollout.rewards[:, :, t], dones = self._inputs.rewards_and_dones()
            self._starts = torch.as_tensor(dones, dtype=torch.float32, device=self._device)
            if dones.any():
                for episodes, learner, rows in zip(self._episodes, self.members, dones, strict=True):
                    if learner.agent_env.last_step.returns is not None:
                        episodes.extend(learner.agent_env.last_step.returns[rows])
                if self.members[0].spec.bootstrap:
                    rollout.cut.append((t, self._starts, self._inputs.final_observations(dones)))
        self._timesteps += self._steps * self._rows
        model = self._models[0]
        rollout.values = self._values(rollout.observations)
        for t, cut, last in rollout.cut:
            rollout.rewards[:, :, t] += model.gamma * self._values(last) * cut
        rollout.estimate(self._values(self._current), self._starts, model.gamma, model.gae_lambda)

    def _draw_noise(self) -> Tensor:
        """Return standard normal noise, each learner's from its own stream, in the shape in which it draws it."""
        noise = torch.zeros(len(self.members), self._rows, self._acts.shape[2])
        for rows, stream, space in zip(noise, self._noise, self._inputs.spaces, strict=True):
            rows[:, : space.shape[0]] = torch.empty(self._rows, space.shape[0]).normal_(generator=stream)
        return noise.to(self._device)

    def _values(self, observations: Tensor) -> Tensor:
        """Return the critics' values, (learners, …), of observations, (learners, …, entries), a piece at a time."""
        critic, flat = self._weights.critic, observations.reshape(len(self.members), -1, self._inputs.entries)
        values = torch.empty(flat.shape[:2], device=self._device)
        for learners in pieces(len(self.members), min(AT_ONCE, flat.shape[1]) * critic.width, self._device):
            for first in range(0, flat.shape[1], AT_ONCE):
                part = slice(first, first + AT_ONCE)
                values[learners, part] = critic.forward(flat[learners, part], learners)[-1][..., 0]
        return values.view(observations.shape[:-1])

    def _log(self, update: Update) -> None:
        """Log the figures of an update that Stable-Baselines3 logs, for each learner with a logger."""
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
