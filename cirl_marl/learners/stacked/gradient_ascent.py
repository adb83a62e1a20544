"""Independent policies that climb the exact gradient of what they do together, through the simulator and themselves.

With K copies, prices p_s and mean levels l_s the stack of all agents of an environment maximises ::

    mean over copies of  λ̄/c + Σ_s p_s·l_s − Σ_b p_b·A_b/|B|,

c the circularity scale, A_b the total of an account with a budget B. Each price is a multiplier that moves after every
episode (``price_step``), so that an evaluation, of as many episodes as the recipe says, assures what is demanded. An
episode is played, and gone through backwards (``Derivatives``): what an action is worth goes into the policy that took
it and, by what that saw, a share of it (``FEEDBACK``) into what came before. Nobody sees more than its own observation.
Outputs are clipped to their bounds; where one lies beyond, only what leads back counts, as if the clip were not there
(straight-through).
"""

from __future__ import annotations

import math
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
from cirl_marl.learners.recipe import Run
from cirl_marl.learners.stacked.perceptrons import chain, write_gradients
from cirl_marl.learners.stacked.stack import ActorStack
from cirl_marl.learners.validation import QUANTILE_95, budget_levels, charges_of, first_prices, price_step
from cirl_marl.network import Floats
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum.aims import aims_of

FEEDBACK = 0.5
"""Share of a derivative that passes on to what was before through what a policy saw: where agents act on each other
round the network it would grow from interval to interval without bound. Where each acts as well as it can, what its
action is worth is zero, and so is what is left out."""
MARGIN = 0.05
"""Least margin of a service, in parts of what may lack: where nothing is random its level swings about the demand."""
LARGEST_NORM = 0.2
"""Norm to which gradients are clipped where the algorithm has no ``max_grad_norm``."""
MEAN_SHARE = 0.05
"""Share of an update in the mean of the last policies: swings of prices take some twenty updates."""
LEAST_PRICE = 1e-4
"""Below which no price falls, per circularity scale."""


class GradientStack(ActorStack):
    """All agents of one environment; critics and deviations of their policies stay as they are."""

    def __init__(self, members: Sequence[Learner], device: str, run: Run) -> None:
        """Take over parameters, optimisers and counters of the learners; ``run`` says what is asked of services."""
        super().__init__(members, device)
        self._env: MultiAgentVectorEnv = members[0].agent_env.views[0].env
        self._derivatives, self._run = Derivatives(self._env), run
        # where the entries of each agent's observation and action stand in the stacks of all
        names = [member.name for member in members]
        self._observed = [self._env.layout.slices[name] for name in names]
        self._acted = [self._env.actuators.entries[name] for name in names]
        first, weight = self._models[0], max(self._env.circularity_weight, 1e-6)
        stated = np.array([service.weight for service in self._env.network.services]) * (1.0 - weight) / weight
        self._prices: Floats = getattr(first, "service_prices", stated)
        self._integrals: Floats = getattr(first, "price_integrals", np.maximum(stated, LEAST_PRICE))
        network = self._env.network
        self._aims = aims_of(network, CIRCULARITY, run.at_most)
        start = first_prices(self._aims, network.episode.horizon)
        self._budget_prices: tuple[Floats, Floats] = getattr(first, "budget_prices", (start, start))
        self._charges = np.array(self._env.account_charges)

    def _keep_progress(self) -> None:
        """Leave with the first model what a resumed training needs beside it: prices, and where the episode begins."""
        first = self._models[0]
        first.service_prices, first.price_integrals = self._prices, self._integrals
        first.budget_prices = self._budget_prices
        if not self._is_restoring:
            first.episode_start = asdict(self._env.physical)

    def _give_models(self) -> None:
        super()._give_models()
        for model in self._models:
            if (target := getattr(model, "actor_target", None)) is not None:
                target.load_state_dict(model.actor.state_dict())

    def _play(self) -> None:
        """Play an episode in every copy, and keep what the way back needs."""
        self._tape: list[tuple[Interval, list[Tensor], NDArray[np.floating]]] = []
        accounts = np.zeros_like(self._env.physical.accounts)  # of which runs of old say nothing
        before, is_over = State(**{"accounts": accounts, **self._models[0].episode_start}), False
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

    def _climb(self, progress_remaining: float) -> None:
        """Go back through the episode, and let every policy climb."""
        env, weights, length = self._env, self._weights, len(self._tape)
        count = length * env.num_envs
        by_circularity = np.full(env.num_envs, 1.0 / (env.network.objective.circularity_scale * count))
        by_level = np.repeat(self._prices[:, None] / count, env.num_envs, axis=1)
        charges = self._charges[:, None] + charges_of(env, self._aims, self._budget_prices[1])
        by_account = -charges * by_circularity[0] * length
        after = self._tape[-1][0].after
        stock, paths = np.zeros_like(after.stock), np.zeros_like(after.disturbances)
        seen = np.zeros((max(span.stop for span in self._observed), env.num_envs))
        gradients: list[list[Tensor]] = []
        for interval, values, slopes in reversed(self._tape):
            columns = np.minimum(interval.before.step, by_account.shape[1] - 1)
            outputs = Outputs(stock, by_circularity, by_level, seen, by_account.take(columns, axis=1))
            stock, by_action, _ = self._derivatives.pull_back(interval, outputs, paths)
            gradients.insert(0, chain(weights.actor, values, self._by_output(by_action, values[-1])))
            by_input = gradients[0][0].cpu().numpy() * slopes
            for rows, span in zip(by_input, self._observed, strict=True):
                seen[span] = -FEEDBACK * rows[:, : span.stop - span.start].T
        write_gradients(weights.actor, [values for _, values, _ in self._tape], gradients)
        rate = self._models[0].lr_schedule(progress_remaining)
        update_learning_rate(weights.optimiser, rate)
        weights.clip(getattr(self._models[0], "max_grad_norm", LARGEST_NORM))
        weights.optimiser.step()
        weights.move_mean(MEAN_SHARE)
        self._updates += 1
        levels = after.service / length
        self._move_prices(levels, self._amounts())
        self._log(float(after.circularity.mean()) / length, levels.mean(axis=1), rate)

    def _by_output(self, by_action: Floats, outputs: Tensor) -> Tensor:
        """Return the loss's gradient by the outputs, shape (N, B, actions): minus that of what is maximised."""
        gradient = np.zeros(outputs.shape, dtype=np.float32)
        for rows, entries in zip(gradient, self._acted, strict=True):
            rows[:, : entries.stop - entries.start] = -by_action[entries].T
        beyond = outputs.cpu().numpy()
        gradient[((beyond > 1.0) & (gradient < 0.0)) | ((beyond < -1.0) & (gradient > 0.0))] = 0.0
        return torch.as_tensor(gradient, device=self._device)

    def _amounts(self) -> Floats:
        """Return what the episode booked of each budget in each copy, shape (B, budgets)."""
        intervals = [interval for interval, _, _ in self._tape]
        totals, discount = intervals[-1].after.accounts.T, self._env.ledger.discount
        if not self._aims.has_years:
            return self._aims.amounts(totals, totals[..., None])
        changes = np.stack([each.after.accounts - each.before.accounts for each in intervals], axis=-1)
        return self._aims.amounts(totals, changes.transpose(1, 0, 2) / discount)

    def _move_prices(self, levels: Floats, amounts: Floats) -> None:
        """Move them by what nineteen of twenty evaluations assure whose episodes are like these.

        ``levels`` have shape (services, B), what is booked of budgets (B, budgets).
        """
        run = self._run
        if run.min_service is None:
            return

        def step_prices(integrals: Floats, levels: Floats) -> tuple[Floats, Floats]:
            doubt = 2.0 * QUANTILE_95 * levels.std(axis=1) / math.sqrt(run.episodes)
            margin = np.maximum(doubt, MARGIN * (1.0 - min_service))
            at_once = (integrals, levels.mean(axis=1) - margin, min_service, run.price_rate, run.price_damping)
            return price_step(*at_once, least=LEAST_PRICE)

        min_service = run.min_service
        self._integrals, self._prices = step_prices(self._integrals, levels)
        if self._aims.budgets:
            levels_of_budgets = budget_levels(self._aims, amounts, min_service)
            self._budget_prices = step_prices(self._budget_prices[0], levels_of_budgets)

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
