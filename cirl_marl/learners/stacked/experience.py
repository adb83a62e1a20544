"""What stacked learners saw and did, and what it was worth."""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor


@dataclass(slots=True)
class Experience:
    """T steps of B rows of N learners; shapes are (N, B, T), with entries last where there are some.

    Attributes:
        seen: what was seen, normalised.
        actions: not clipped.
        rewards: as normalisers scale them.
        log_probabilities: of the actions.
        starts: 1 where an episode began.
        values: what the critic expected.
        advantages: how much better it went.
        returns: both together.
        cut: steps after which time was up though more is expected to come, in which rows, shape (N, B), and what was
            seen last, shape (N, B, entries).
    """

    seen: Tensor
    actions: Tensor
    rewards: Tensor
    log_probabilities: Tensor
    starts: Tensor
    values: Tensor
    advantages: Tensor
    returns: Tensor
    cut: list[tuple[int, Tensor, Tensor]] = field(default_factory=list)

    @classmethod
    def empty(cls, shape: tuple[int, int, int], entries: int, actions: int, device: torch.device) -> Experience:
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

        def picked(values: Tensor) -> Tensor:
            entries = values.shape[3:]
            own: Tensor = values[learners].reshape(-1, *entries).index_select(0, index)
            return own.view(*order.shape, *entries)

        parts = (self.seen, self.actions, self.values, self.log_probabilities, self.advantages, self.returns)
        return Samples(*map(picked, parts))


@dataclass(frozen=True, slots=True)
class Samples:
    """Samples of some learners; shapes are (learners, samples), with a last axis of entries where there is one."""

    seen: Tensor
    actions: Tensor
    values: Tensor
    log_probabilities: Tensor
    advantages: Tensor
    returns: Tensor

    def normalised_advantages(self) -> Tensor:
        """Return the advantages of each learner with mean 0 and standard deviation 1."""
        mean, std = self.advantages.mean(dim=1, keepdim=True), self.advantages.std(dim=1, keepdim=True)
        return (self.advantages - mean) / (std + 1e-8)
