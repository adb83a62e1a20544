"""Policies as functions that can be differentiated: from what they see, as it is named, to what they do."""

from __future__ import annotations

from typing import Any

import torch
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy

from cirl_marl.learners.policies import Policy


class Acting(torch.nn.Module):
    """What a policy does deterministically, before it is clipped to [−1, 1], as a function of rows of its view.

    The normaliser is part of the function, so that rows are in the units of the environment. A policy that remembers
    takes what it remembers as two more arguments.
    """

    def __init__(self, policy: Policy) -> None:
        """Take a policy, which stays as it is."""
        super().__init__()
        self._policy, self._view = policy.model.policy, policy.view
        self._policy.set_training_mode(False)
        normaliser = policy.normaliser
        self._scaled: tuple[torch.Tensor, torch.Tensor, float] | None = None
        if normaliser is not None and normaliser.norm_obs:
            statistics: Any = normaliser.obs_rms
            if isinstance(statistics, dict):
                statistics = statistics.get("observation")
            if statistics is not None:
                spread = (torch.as_tensor(statistics.var) + normaliser.epsilon).sqrt()
                self._scaled = torch.as_tensor(statistics.mean), spread, normaliser.clip_obs

    @property
    def remembers(self) -> bool:
        """Whether it acts on what it remembers, too."""
        return isinstance(self._policy, RecurrentActorCriticPolicy)

    def forward(self, rows: torch.Tensor, *memory: torch.Tensor) -> torch.Tensor:
        """Return actions, shape (rows, entries), for rows of shape (rows, columns).

        ``memory`` are what it remembers, hidden and cell states, shape (rows, layers, units) each.
        """
        if self._scaled is not None:
            mean, spread, clip = self._scaled
            rows = ((rows - mean) / spread).clamp(-clip, clip).to(rows.dtype)
        seen: Any = rows
        if self._view.state_entries:
            # no action depends on the state (``central_critic``)
            seen = {"observation": rows, "state": rows.new_zeros((len(rows), self._view.state_entries))}
        policy: Any = self._policy
        if not self.remembers:
            acted: torch.Tensor = policy._predict(seen, deterministic=True)
            return acted
        states = tuple(each.transpose(0, 1).contiguous() for each in memory)
        return policy._predict(seen, states, rows.new_zeros(len(rows)), deterministic=True)[0]  # type: ignore[no-any-return]
