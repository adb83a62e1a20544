"""Updates of PPO and A2C for many learners at once, by hand-written gradients of their losses."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from stable_baselines3 import A2C, PPO
from stable_baselines3.common.utils import update_learning_rate
from torch import Tensor

from cirl_marl.learners.stacked.experience import Experience, Samples
from cirl_marl.learners.stacked.perceptrons import pieces
from cirl_marl.learners.stacked.weights import Weights

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
    def of(cls, model: PPO | A2C, samples: int, remaining: float) -> Rules:
        """Return those of a model for as many samples, when this share of the run remains."""
        weights = (model.ent_coef, model.vf_coef, model.max_grad_norm)
        rate, normalises = model.lr_schedule(remaining), model.normalize_advantage
        if isinstance(model, A2C):
            return cls(1, samples, None, None, normalises, *weights, rate)
        clip, clip_value = (
            limit(remaining) if callable(limit) else limit for limit in (model.clip_range, model.clip_range_vf)
        )
        return cls(model.n_epochs, model.batch_size, clip, clip_value, normalises, *weights, rate)


@dataclass(frozen=True, slots=True)
class PolicyLoss:
    """A policy's loss, shape (learners,), and its gradient by each log-probability, shape (learners, samples).

    ``clipped`` is the share of samples that were, ``divergence`` the mean of r − 1 − log r for r = π/π_old.
    """

    value: Tensor
    gradient: Tensor
    clipped: Tensor
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
    gain, bounded = advantages * ratio, advantages * ratio.clamp(1 - clip, 1 + clip)
    return PolicyLoss(
        value=-torch.minimum(gain, bounded).mean(dim=1),
        gradient=torch.where(gain <= bounded, -gain / count, 0.0),
        clipped=((ratio - 1).abs() > clip).float().mean(dim=1),
        divergence=divergence,
    )


def value_loss(values: Tensor, samples: Samples, clip: float | None) -> tuple[Tensor, Tensor]:
    """Return mean((V − R)²) and its gradient by V; V moves from its old value by at most ``clip``, if there is one."""
    moved = values if clip is None else samples.values + (values - samples.values).clamp(-clip, clip)
    error = moved - samples.returns
    gradient = 2 * error / error.shape[1]
    if clip is not None:
        gradient = torch.where((values - samples.values).abs() <= clip, gradient, 0.0)
    return error.square().mean(dim=1), gradient


class Update:
    """One update of all learners by their rollouts; ``acts`` is 1 where a learner has an entry of its action."""

    def __init__(self, weights: Weights, rules: Rules, rollout: Experience, acts: Tensor, local: int) -> None:
        """``local`` is the number of columns of what is seen at which actors look."""
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
            order = torch.as_tensor(np.stack([own.permutation(total) for own in shuffles]), device=device)
            for first in range(0, total, rules.batch):
                part = order[:, first : first + rules.batch]
                for some in pieces(learners, part.shape[1] * weights.actor.width, device):
                    self._differentiate(self._rollout.samples(some, part[some]), some)
                weights.clip(rules.largest_norm)
                weights.optimiser.step()
                self._count += 1

    def _differentiate(self, samples: Samples, some: slice) -> None:
        """Write the gradients of the loss of some learners: L = L_π − c_H H + c_V L_V.

        With z = (a − μ)/σ, ∂log π/∂μ = z/σ and ∂log π/∂log σ = z² − 1 for each entry of the action.
        """
        weights, rules, acts = self._weights, self._rules, self._acts[some]
        log_std = weights.log_std[some][:, None]
        std = log_std.exp()
        units = weights.actor.forward(samples.seen[..., : self._local], some)
        z = (samples.actions - units[-1]) / std
        log_probabilities = ((-0.5 * z.square() - log_std - LOG_SQRT_2PI) * acts).sum(dim=-1)
        normalises = rules.normalises and samples.advantages.shape[1] > 1
        advantages = samples.normalised_advantages() if normalises else samples.advantages
        policy = policy_loss(log_probabilities, samples, advantages, rules.clip)
        each = policy.gradient[..., None] * acts
        weights.log_std_gradient[some] = ((z.square() - 1) * each).sum(dim=1) - rules.entropy_weight * acts[:, 0]
        weights.actor.backward(units, z / std * each, some)
        units = weights.critic.forward(samples.seen, some)
        loss, gradient = value_loss(units[-1][..., 0], samples, rules.clip_value)
        weights.critic.backward(units, (rules.value_weight * gradient)[..., None], some)
        own = torch.stack([policy.value, policy.clipped, policy.divergence, loss], dim=1)
        self._sums[some] += own.cpu().numpy()

    def figures(self) -> Iterator[dict[str, float]]:
        """Yield the figures of each learner that Stable-Baselines3 writes of an update."""
        rollout, log_std = self._rollout, self._weights.log_std
        unexplained = (rollout.returns - rollout.values).flatten(1).var(dim=1) / rollout.returns.flatten(1).var(dim=1)
        entropy = ((log_std + LOG_SQRT_2PI + 0.5) * self._acts[:, 0]).sum(dim=1)
        std = (log_std.exp() * self._acts[:, 0]).sum(dim=1) / self._acts[:, 0].sum(dim=1)
        for i, sums in enumerate(self._sums / max(1, self._count)):
            own = dict(zip(FIGURES, sums.tolist(), strict=True))
            yield own | {
                "entropy_loss": -float(entropy[i]),
                "explained_variance": 1.0 - float(unexplained[i]),
                "std": float(std[i]),
                "learning_rate": self._rules.rate,
            }


FIGURES = ("policy_gradient_loss", "clip_fraction", "approx_kl", "value_loss")
"""Means over minibatches."""
