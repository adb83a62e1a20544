"""Independent policies that climb the exact gradient of what they do together, through the simulator and themselves.

With K copies, prices p_s and mean levels l_s the stack of all agents of an environment maximises ::

    mean over copies of  λ̄/c + Σ_s p_s·l_s,    p_s ← max(0, p_s + r·(e_s + d·Δe_s)),    e_s = demanded level − l_s,

c the circularity scale: dual ascent on the price of each service. An episode is played, and gone through backwards
(``Derivatives``): what an action is worth goes into the policy that took it and, by what that saw, into what came
before. Nobody sees more than its own observation. Outputs are clipped to their bounds; where one lies beyond, only what
leads back counts, as if the clip were not there (straight-through).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from stable_baselines3.common.utils import update_learning_rate
from torch import Tensor

from cirl_marl.environments.derivatives import Derivatives, Outputs
from cirl_marl.environments.state import Interval, State
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.learners.learner import Learner
from cirl_marl.learners.stacked.perceptrons import Weights, chain, write_gradients
from cirl_marl.learners.stacked.stack import Stack
from cirl_marl.network import Floats

RATE, DAMPING = 2.0, 10.0
"""r and d of the dual ascent."""
SPREAD, MIDDLE = 10.0, 0.5
"""Observations are scaled, most of them between 0 and 1: fresh weights of the first layer are so many times as large
and centred there, so that hidden units tell apart what differs by a tenth."""
MARGIN = 5e-4
"""How much more than ``min_service`` is asked for, so that an evaluation assures it."""


class GradientStack(Stack):
    """All agents of one environment, whose policies are those of PPO; their critics and deviations stay as they are."""

    def __init__(self, members: Sequence[Learner], device: str, min_service: float | None) -> None:
        """Take over parameters, optimisers and counters of the learners; ``min_service`` is asked of every service."""
        super().__init__(members, device)
        self._env: MultiAgentVectorEnv = members[0].agent_env.views[0].env
        self._derivatives, self._min_service = Derivatives(self._env), min_service
        self._timesteps, self._updates = self._models[0].num_timesteps, self._models[0]._n_updates
        inputs, policies = self._inputs, [model.policy for model in self._models]
        self._weights = Weights(policies, inputs.actor_columns, inputs.critic_columns, self._device)
        # where the entries of each agent's observation and action stand in the stacks of all
        names = [member.name for member in members]
        self._observed = [self._env.layout.slices[name] for name in names]
        self._acted = [self._env.actuators.entries[name] for name in names]
        if not self._timesteps and members[0].spec.start is None and members[0].normaliser is None:
            self._spread()
        services = self._env.network.services
        weight = self._env.circularity_weight
        stated = np.array([service.weight for service in services]) * (1.0 - weight) / max(weight, 1e-6)
        self._prices: Floats = getattr(self._models[0], "service_prices", stated)
        self._lacks: Floats = getattr(self._models[0], "service_lacks", np.zeros(len(services)))

    def _spread(self) -> None:
        """Let hidden units differ over the range of what is observed."""
        first = self._weights.actor.layers[0]
        first.weight.mul_(SPREAD)
        if first.bias is not None:
            first.bias.sub_(MIDDLE * first.weight.sum(dim=2))

    def learn(self, steps: int) -> None:
        """Learn for the share of ``steps`` that is the learners'."""
        total = self.members[0].spec.steps_of(steps)
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
            self._ascend(1.0 - self._timesteps / total)

    def _keep_progress(self) -> None:
        """Leave with the first model what a resumed training needs beside it: prices, and where the episode begins."""
        first = self._models[0]
        first.service_prices, first.service_lacks = self._prices, self._lacks
        if not self._is_restoring:
            first.episode_start = asdict(self._env.physical)

    def _deterministic_actions(self, observations: Tensor) -> Tensor:
        return self._weights.actor.forward(observations[..., : self._inputs.local])[-1]

    def _give_models(self) -> None:
        self._weights.give()
        for model in self._models:
            model.num_timesteps, model._n_updates = self._timesteps, self._updates

    def _play(self) -> None:
        """Play an episode in every copy, and keep what the way back needs."""
        self._tape: list[tuple[Interval, list[Tensor], NDArray[np.floating]]] = []
        before, is_over = State(**self._models[0].episode_start), False
        while not is_over:
            values = self._weights.actor.forward(self._current[..., : self._inputs.local])
            slopes, replays = self._inputs.slopes, bool(self.members[0].barrier.replay_log)
            self._current = self._move(values[-1])
            interval = self._again(before, values[-1]) if replays else self._env.interval
            before = interval.after
            self._tape.append((interval, values, slopes))
            self._timesteps += self._env.num_envs
            is_over = bool(self._inputs.rewards_and_dones()[1].all())

    def _again(self, before: State, outputs: Tensor) -> Interval:
        """Return an interval that a resumed training has behind it; the environment stays where it is."""
        env, actions = self._env, np.empty((len(self._env.actuators.control_rows), self._env.num_envs))
        now, controls = env.physical, env.controls
        for rows, entries in zip(outputs.cpu().numpy(), self._acted, strict=True):
            actions[entries] = np.clip(rows[:, : entries.stop - entries.start], -1.0, 1.0).T
        env.go_back(before, controls)
        env.advance(actions)
        interval = env.interval
        env.go_back(now, controls)
        return interval

    def _ascend(self, progress_remaining: float) -> None:
        """Go back through the episode, and let every policy climb."""
        env, weights, length = self._env, self._weights, len(self._tape)
        count = length * env.num_envs
        by_circularity = np.full(env.num_envs, 1.0 / (env.network.objective.circularity_scale * count))
        by_level = np.repeat(self._prices[:, None] / count, env.num_envs, axis=1)
        after = self._tape[-1][0].after
        stock, paths = np.zeros_like(after.stock), np.zeros_like(after.disturbances)
        seen = np.zeros((max(span.stop for span in self._observed), env.num_envs))
        gradients: list[list[Tensor]] = []
        for interval, values, slopes in reversed(self._tape):
            outputs = Outputs(stock, by_circularity, by_level, seen)
            stock, by_action, _ = self._derivatives.pull_back(interval, outputs, paths)
            gradients.insert(0, chain(weights.actor, values, self._by_output(by_action, values[-1])))
            by_input = gradients[0][0].cpu().numpy() * slopes
            for rows, span in zip(by_input, self._observed, strict=True):
                seen[span] = -rows[:, : span.stop - span.start].T
        write_gradients(weights.actor, [values for _, values, _ in self._tape], gradients)
        rate = self._models[0].lr_schedule(progress_remaining)
        update_learning_rate(weights.optimiser, rate)
        weights.clip(self._models[0].max_grad_norm)
        weights.optimiser.step()
        self._updates += 1
        levels = (after.service / length).mean(axis=1)
        self._move_prices(levels)
        self._log(float(after.circularity.mean()) / length, levels, rate)

    def _by_output(self, by_action: Floats, outputs: Tensor) -> Tensor:
        """Return the loss's gradient by the outputs, shape (N, B, actions): minus that of what is maximised."""
        gradient = np.zeros(outputs.shape, dtype=np.float32)
        for rows, entries in zip(gradient, self._acted, strict=True):
            rows[:, : entries.stop - entries.start] = -by_action[entries].T
        beyond = outputs.cpu().numpy()
        gradient[((beyond > 1.0) & (gradient < 0.0)) | ((beyond < -1.0) & (gradient > 0.0))] = 0.0
        return torch.as_tensor(gradient, device=self._device)

    def _move_prices(self, levels: Floats) -> None:
        if self._min_service is None:
            return
        lacks = self._min_service + MARGIN - levels
        change = RATE * (lacks + DAMPING * (lacks - self._lacks) * (self._updates > 1))
        self._prices, self._lacks = np.maximum(self._prices + change, 0.0), lacks

    def _log(self, circularity: float, levels: Floats, rate: float) -> None:
        """Log the figures of an update for each learner with a logger."""
        for model in self._models:
            if model.logger.output_formats:
                figures: dict[str, Any] = {"rollout/circularity": circularity, "train/learning_rate": rate}
                for service, level, price in zip(self._env.network.services, levels, self._prices, strict=True):
                    figures |= {f"rollout/level_{service.id}": float(level), f"train/price_{service.id}": float(price)}
                for name, value in figures.items():
                    model.logger.record(name, value)
                model.logger.dump(self._timesteps)
