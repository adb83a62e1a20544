"""PPO and A2C of many learners as one: rollouts in the joint environment, and updates of all at once."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.utils import update_learning_rate
from torch import Tensor

from cirl_marl.learners.learner import Learner
from cirl_marl.learners.stacked.perceptrons import pieces
from cirl_marl.learners.stacked.stack import ActorStack
from cirl_marl.network.declarations import with_field_docs

LOG_SQRT_2PI = 0.5 * math.log(2 * math.pi)
FIGURES = ("policy_gradient_loss", "clip_fraction", "approx_kl", "value_loss")
"""Means over minibatches."""
AT_ONCE = 1024
"""Samples of a learner that critics value at once."""
EPISODES = 100
"""Last episodes whose mean return is logged, as Stable-Baselines3 does."""


@with_field_docs
@dataclass(slots=True)
class Samples:
    """Samples of N learners: a rollout, shapes (N, B, T) for T steps of B rows, or a minibatch, shapes (N, samples).

    Entries, where there are some, are on a last axis.
    """

    observations: Annotated[Tensor, "normalised"]
    actions: Annotated[Tensor, "not clipped"]
    values: Annotated[Tensor, "of the critic"]
    log_probabilities: Annotated[Tensor, "of the actions"]
    advantages: Annotated[Tensor, "generalised advantage estimates"]
    returns: Annotated[Tensor, "values plus advantages, the targets of the critic"]

    def minibatch(self, learners: slice, order: Tensor) -> Samples:
        """Return samples of some learners by their indices, shape (learners, samples), of all B·T, row by row."""
        first = torch.arange(order.shape[0], device=order.device)[:, None] * self.values[0].numel()
        index = (order + first).flatten()

        def pick(values: Tensor) -> Tensor:
            entries = values.shape[3:]
            rows: Tensor = values[learners].reshape(-1, *entries).index_select(0, index)
            return rows.view(*order.shape, *entries)

        return Samples(*(pick(getattr(self, name)) for name in self.__slots__))


def policy_loss(
    log_probabilities: Tensor, samples: Samples, advantages: Tensor, clip: float | None
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return the loss of PPO, or of A2C if nothing is clipped; M is the number of samples.

    PPO: L = −mean(min(A r, A clip(r, 1 − ε, 1 + ε))) with r = π/π_old, so that ∂L/∂log π = −A r/M, 0 where clipped
    (Schulman et al. 2017, arXiv 1707.06347, eq. 7). A2C: L = −mean(A log π), so that ∂L/∂log π = −A/M.

    Returns:
        L, shape (learners,); ∂L/∂log π, shape (learners, samples); the share of samples that were clipped, and the mean
        of r − 1 − log r, shape (learners,).
    """
    count = advantages.shape[1]
    log_ratio = log_probabilities - samples.log_probabilities
    ratio = log_ratio.exp()
    divergence = (ratio - 1 - log_ratio).mean(dim=1)
    if clip is None:
        loss = -(advantages * log_probabilities).mean(dim=1)
        return loss, -advantages / count, torch.zeros_like(loss), divergence
    gain, clipped_gain = advantages * ratio, advantages * ratio.clamp(1 - clip, 1 + clip)
    loss = -torch.minimum(gain, clipped_gain).mean(dim=1)
    gradient = torch.where(gain <= clipped_gain, -gain / count, 0.0)
    return loss, gradient, ((ratio - 1).abs() > clip).float().mean(dim=1), divergence


def value_loss(values: Tensor, samples: Samples, clip: float | None) -> tuple[Tensor, Tensor]:
    """Return mean((V − R)²) and its gradient by V; V moves from its old value by at most ``clip``, if there is one."""
    clipped_values = values if clip is None else samples.values + (values - samples.values).clamp(-clip, clip)
    error = clipped_values - samples.returns
    gradient = 2 * error / error.shape[1]
    if clip is not None:
        gradient = torch.where((values - samples.values).abs() <= clip, gradient, 0.0)
    return error.square().mean(dim=1), gradient


class RolloutStack(ActorStack):
    """PPO or A2C learners."""

    def __init__(self, members: Sequence[Learner], device: str = "cpu") -> None:
        """Take over parameters, optimisers, counters and streams of the learners."""
        super().__init__(members, device)
        self._rows, self._steps = members[0].agent_env.num_envs, self._models[0].n_steps
        self._acts = torch.zeros(len(members), 1, self._weights.log_std.shape[1], device=self._device)
        for mask, space in zip(self._acts, self._inputs.spaces, strict=True):
            mask[:, : space.shape[0]] = 1.0
        # Minibatches come from each learner's NumPy stream itself.
        self._shuffles = [np.random.RandomState(learner.streams.bit_generator) for learner in members]
        shape, entries = (len(members), self._rows, self._steps), self._inputs.entries
        shapes = [(*shape, entries), (*shape, self._acts.shape[2]), shape, shape, shape, shape]
        self._rollout = Samples(*(torch.zeros(part, device=self._device) for part in shapes))
        self._episodes: list[deque[float]] = [deque(maxlen=EPISODES) for _ in members]

    def _play(self) -> None:
        """Fill the rollout by the policies of now."""
        starts_now = np.stack([member.agent_env.last_step.dones for member in self.members])
        self._starts = torch.as_tensor(starts_now, dtype=torch.float32, device=self._device)
        rollout, log_std = self._rollout, self._weights.log_std[:, None]
        rewards, starts = torch.zeros_like(rollout.values), torch.zeros_like(rollout.values)
        truncations: list[tuple[int, Tensor, Tensor]] = []  # step, rows, and the last observations of these
        std, rest = log_std.exp(), -log_std - LOG_SQRT_2PI
        for t in range(self._steps):
            noise = self._draw_noise()
            actions = self._deterministic_actions(self._current) + std * noise
            rollout.observations[:, :, t], rollout.actions[:, :, t] = self._current, actions
            rollout.log_probabilities[:, :, t] = ((rest - 0.5 * noise.square()) * self._acts).sum(dim=-1)
            starts[:, :, t] = self._starts
            self._current = self._move(actions)
            rewards[:, :, t], dones = self._inputs.rewards_and_dones()
            self._starts = torch.as_tensor(dones, dtype=torch.float32, device=self._device)
            if dones.any():
                for episodes, learner, rows in zip(self._episodes, self.members, dones, strict=True):
                    if learner.agent_env.last_step.returns is not None:
                        episodes.extend(learner.agent_env.last_step.returns[rows])
                if self.members[0].spec.bootstrap:
                    truncations.append((t, self._starts, self._inputs.final_observations(dones)))
        self._timesteps += self._steps * self._rows
        rollout.values = self._values(rollout.observations)
        for t, cut, last in truncations:
            rewards[:, :, t] += self._models[0].gamma * self._values(last) * cut
        self._estimate_advantages(rewards, starts)

    def _estimate_advantages(self, rewards: Tensor, starts: Tensor) -> None:
        """Estimate advantages and returns, Schulman et al. 2016, arXiv 1506.02438, eq. 16.

        δ_t = r_t + γ V_{t+1} − V_t,  A_t = δ_t + γ λ A_{t+1},  where V_{t+1} and A_{t+1} are 0 if t ended an episode
        """
        rollout, gamma, gae_lambda = self._rollout, self._models[0].gamma, self._models[0].gae_lambda
        value, goes_on = self._values(self._current), 1.0 - self._starts
        advantage = torch.zeros_like(value)
        for t in reversed(range(self._steps)):
            step = rewards[:, :, t] + gamma * value * goes_on - rollout.values[:, :, t]
            advantage = step + gamma * gae_lambda * goes_on * advantage
            rollout.advantages[:, :, t] = advantage
            value, goes_on = rollout.values[:, :, t], 1.0 - starts[:, :, t]
        rollout.returns = rollout.advantages + rollout.values

    def _climb(self, progress_remaining: float) -> None:
        """Pass over the samples in minibatches that each learner draws from its own stream; A2C once, over all."""
        model, weights, total = self._models[0], self._weights, self._rows * self._steps
        epochs, batch, clips = 1, total, [None, None]
        if isinstance(model, PPO):
            epochs, batch = model.n_epochs, model.batch_size
            limits: list[Any] = [model.clip_range, model.clip_range_vf]
            clips = [limit(progress_remaining) if callable(limit) else limit for limit in limits]
        rate = model.lr_schedule(progress_remaining)
        update_learning_rate(weights.optimiser, rate)
        sums, count = np.zeros((len(self.members), len(FIGURES))), 0
        for _ in range(epochs):
            permutations = np.stack([stream.permutation(total) for stream in self._shuffles])
            order = torch.as_tensor(permutations, device=self._device)
            for first in range(0, total, batch):
                part = order[:, first : first + batch]
                for members in pieces(len(order), part.shape[1] * weights.actor.width, self._device):
                    samples = self._rollout.minibatch(members, part[members])
                    sums[members] += self._differentiate(samples, members, *clips)
                weights.clip(model.max_grad_norm)
                weights.optimiser.step()
                count += 1
        self._updates += epochs
        if any(model.logger.output_formats for model in self._models):
            self._log(sums / max(1, count), rate)

    def _differentiate(
        self, samples: Samples, members: slice, clip: float | None, clip_value: float | None
    ) -> NDArray[np.floating]:
        """Write the gradients of the loss of some learners, L = L_π − c_H H + c_V L_V; return their figures.

        With z = (a − μ)/σ, ∂log π/∂μ = z/σ and ∂log π/∂log σ = z² − 1 for each entry of the action.
        """
        model, weights, acts = self._models[0], self._weights, self._acts[members]
        log_std = weights.log_std[members][:, None]
        std = log_std.exp()
        units = weights.actor.forward(samples.observations[..., : self._inputs.local], members)
        z = (samples.actions - units[-1]) / std
        log_probabilities = ((-0.5 * z.square() - log_std - LOG_SQRT_2PI) * acts).sum(dim=-1)
        advantages = samples.advantages
        if model.normalize_advantage and advantages.shape[1] > 1:
            mean, spread = advantages.mean(dim=1, keepdim=True), advantages.std(dim=1, keepdim=True)
            advantages = (advantages - mean) / (spread + 1e-8)
        policy, gradient, clip_share, divergence = policy_loss(log_probabilities, samples, advantages, clip)
        action_gradient = gradient[..., None] * acts
        std_gradient = ((z.square() - 1) * action_gradient).sum(dim=1)
        weights.log_std_gradient[members] = std_gradient - model.ent_coef * acts[:, 0]
        weights.actor.backward(units, z / std * action_gradient, members)
        units = weights.critic.forward(samples.observations, members)
        loss, gradient = value_loss(units[-1][..., 0], samples, clip_value)
        weights.critic.backward(units, (model.vf_coef * gradient)[..., None], members)
        return torch.stack([policy, clip_share, divergence, loss], dim=1).cpu().numpy()

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

    def _log(self, means: NDArray[np.floating], rate: float) -> None:
        """Log the figures of an update that Stable-Baselines3 logs, for each learner with a logger."""
        rollout, log_std = self._rollout, self._weights.log_std
        residual = (rollout.returns - rollout.values).flatten(1).var(dim=1) / rollout.returns.flatten(1).var(dim=1)
        entropy = ((log_std + LOG_SQRT_2PI + 0.5) * self._acts[:, 0]).sum(dim=1)
        std = (log_std.exp() * self._acts[:, 0]).sum(dim=1) / self._acts[:, 0].sum(dim=1)
        for i, (model, episodes) in enumerate(zip(self._models, self._episodes, strict=True)):
            if episodes:
                model.logger.record("rollout/ep_rew_mean", float(np.mean(episodes)))
            for name, mean in zip(FIGURES, means[i].tolist(), strict=True):
                model.logger.record(f"train/{name}", mean)
            model.logger.record("train/entropy_loss", -float(entropy[i]))
            model.logger.record("train/explained_variance", 1.0 - float(residual[i]))
            model.logger.record("train/std", float(std[i]))
            model.logger.record("train/learning_rate", rate)
            model.logger.dump(self._timesteps)
