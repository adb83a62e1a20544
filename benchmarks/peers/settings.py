"""What all contenders have alike: those settings of ``independent_ppo`` that every library offers."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

NETWORK = "copper_net"
SERVICE = 0.99
"""Mean level of service that is demanded; a gap counts from there on."""
GOALS = (0.5, 0.2)
"""Gaps whose time is taken."""
ENVIRONMENT: dict[str, Any] = {"reward": "team", "circularity": "mean", "circularity_weight": 0.9}


@dataclass(frozen=True, slots=True, kw_only=True)
class Settings:
    """PPO of one agent, the same for each; ``tests/test_peers.py`` holds it against what our learners are made with.

    Attributes:
        envs: copies of the environment.
        steps: of each copy in a rollout, one episode.
        minibatch: samples of an agent.
        epochs: passes over a rollout.
        discount: γ; the episode is all there is.
        trace: λ of generalised advantage estimation.
        learning_rate: at the beginning, down to ``last_rate`` after ``schedule`` environment steps.
        last_rate: see there.
        schedule: see there.
        clip: of the ratio of probabilities.
        value_weight: of the critic's loss.
        gradient: largest norm.
        epsilon: of Adam.
        log_std: logarithm of the standard deviation of actions at the beginning.
        layers: hidden ones of actor and critic each, with tanh between them.
    """

    envs: int = 32
    steps: int = 160
    minibatch: int = 1280
    epochs: int = 5
    discount: float = 1.0
    trace: float = 1.0
    learning_rate: float = 1e-3
    last_rate: float = 1e-5
    schedule: int = 600_000
    clip: float = 0.2
    value_weight: float = 0.5
    gradient: float = 0.5
    epsilon: float = 1e-5
    log_std: float = -1.0
    layers: tuple[int, ...] = (64, 64)

    @property
    def rollout(self) -> int:
        """Environment steps of a rollout, summed over the copies."""
        return self.envs * self.steps

    def rate_after(self, steps: int) -> float:
        """Return the learning rate after ``steps`` environment steps."""
        done = min(1.0, steps / self.schedule)
        return self.learning_rate + done * (self.last_rate - self.learning_rate)


SETTINGS = Settings()
