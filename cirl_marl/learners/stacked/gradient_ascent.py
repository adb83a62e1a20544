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
from cirl_marl.learners.stacked.control_variates import ControlVariates
from cirl_marl.learners.stacked.perceptrons import chain, write_gradients
from cirl_marl.learners.stacked.stack import ActorStack
from cirl_marl.learners.validation import QUANTILE_95, budget_levels, charges_of, first_prices, price_step
from cirl_marl.network import Floats, Integers
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum.aims import aims_of

FEEDBACK = 0.5
"""Share of a derivative that passes on to what was before through what a policy saw: where agents act on each other
round the network it would grow from interval to interval without bound. Where each acts as well as it can, what its
action is worth is zero, and so is what is left out."""
LEAST_FEEDBACK = 1 / 64
"""Below which half of it is none. Without any, gradients are bounded: what a mass is worth is at most what it does in
each interval, as it is conserved."""
GROWN = 100.0
"""Norm beyond which a gradient is taken again with half the feedback, while that halves it at least. Where policies are
steep it may grow beyond all numbers (a cycle of 3 agents and 160 decisions); on ``copper_net`` it came
to 5."""
MARGIN = 0.05
"""Least margin of a service, in parts of what may lack: where nothing is random its level swings about the demand."""
LARGEST_NORM = 0.2
"""Norm to which gradients are clipped where the algorithm has no ``max_grad_norm``."""
LEAST_PRICE = 1e-4
"""Below which no price falls, per circularity scale."""


class Places:
    """Where the rows of a stacked array stand in one with a padded row of entries for each member, (N, B, entries).

    Attributes:
        rows: of the stacked array, member by member.
        index: of the same entries in the other.
    """

    def __init__(self, spans: Sequence[slice]) -> None:
        """Take the rows of each member in the stacked array."""
        lengths = [span.stop - span.start for span in spans]
        self.rows: Integers = np.concatenate([np.arange(span.start, span.stop) for span in spans])
        members = np.repeat(np.arange(len(spans)), lengths)
        self.index = (members, slice(None), np.concatenate([np.arange(length) for length in lengths]))

    def of(self, array: NDArray[Any]) -> NDArray[Any]:
        """Return entries of a padded array in the order of ``rows``, shape (rows, B)."""
        return array[self.index]


class GradientStack(ActorStack):
    """All agents of one environment; critics and deviations of their policies stay as they are."""

    def __init__(self, members: Sequence[Learner], device: str, run: Run) -> None:
        """Take over parameters, optimisers and counters of the learners; ``run`` says what is asked of services."""
        super().__init__(members, device)
        self._env: MultiAgentVectorEnv = members[0].agent_env.views[0].env
        self._derivatives, self._run = Derivatives(self._env), run
        # where the entries of each agent's observation and action stand in the stacks of all
        names = [member.name for member in members]
        self._observation_places = Places([self._env.layout.slices[name] for name in names])
        self._action_places = Places([self._env.actuators.entries[name] for name in names])
        first, weight = self._models[0], max(self._env.circularity_weight, 1e-6)
        stated = np.array([service.weight for service in self._env.network.services]) * (1.0 - weight) / weight
        self._prices: Floats = getattr(first, "service_prices", stated)
        self._integrals: Floats = getattr(first, "price_integrals", np.maximum(stated, LEAST_PRICE))
        network = self._env.network
        self._aims = aims_of(network, CIRCULARITY, run.at_most)
        start = first_prices(self._aims, network.episode.horizon)
        self._budget_prices: tuple[Floats, Floats] = getattr(first, "budget_prices", (start, start))
        self._charges = np.array(self._env.account_charges)
        self._variates = ControlVariates(getattr(first, "control_variates", None))
        self._drawn_stocks = np.flatnonzero(np.ptp(network.initial, axis=0))

    def _keep_progress(self) -> None:
        """Leave with the first model what a resumed training needs beside it: prices, and where the episode begins."""
        first = self._models[0]
        first.service_prices, first.price_integrals = self._prices, self._integrals
        first.budget_prices, first.control_variates = self._budget_prices, self._variates.state
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
            is_over = bool(self.members[0].agent_env.dones.all())

    def _again(self, before: State, outputs: Tensor) -> Interval:
        """Return an interval that a resumed training has behind it; the environment stays where it is."""
        env, now, controls = self._env, self._env.physical, self._env.controls
        env.go_back(before, controls)
        self._advance(outputs)
        interval = env.interval
        env.go_back(now, controls)
        return interval

    def _advance(self, outputs: Tensor) -> None:
        """Move the environment itself by what policies put out."""
        actions = np.empty((len(self._env.actuators.control_rows), self._env.num_envs))
        actions[self._action_places.rows] = np.clip(self._action_places.of(outputs.cpu().numpy()), -1.0, 1.0)
        self._env.advance(actions)

    def _look_ahead(self) -> None:
        """Play the episode that begins, without a trace but the tape."""
        env, now, controls = self._env, self._env.physical, self._env.controls
        self._tape = []
        while (env.physical.step < env.network.episode.horizon).all():
            observations = env.by_agent(env.stacked_observation())
            seen = [member.agent_env.view.rows(observations) for member in self.members]
            inputs = self._inputs.normalise(seen, slice(None))
            values = self._weights.actor.forward(inputs[..., : self._inputs.local])
            self._advance(values[-1])
            self._tape.append((env.interval, values, self._inputs.slopes))
        env.go_back(now, controls)

    def _climb(self, progress_remaining: float) -> None:
        """Let every policy climb what the episode is worth."""
        weights, model = self._weights, self._models[0]
        charges = self._charges[:, None] + charges_of(self._env, self._aims, self._budget_prices[1])
        self._write_gradient(1.0, self._prices, charges)
        rate = model.lr_schedule(progress_remaining)
        update_learning_rate(weights.optimiser, rate)
        weights.clip(getattr(model, "max_grad_norm", LARGEST_NORM))
        weights.optimiser.step()
        self._updates += 1
        after, length = self._tape[-1][0].after, len(self._tape)
        levels = after.service / length
        self._move_prices(levels, self._amounts())
        self._log(float(after.circularity.mean()) / length, levels.mean(axis=1), rate)

    @property
    def parameters(self) -> Tensor:
        """What policies act by, shape (learners, parameters); a copy."""
        return self._weights.matrix.detach().clone()

    @parameters.setter
    def parameters(self, matrix: Tensor) -> None:
        self._weights.matrix.copy_(matrix)
        self._give_models()

    def slopes(self) -> Floats:
        """Return gradients by all parameters of how the coming episode keeps what is demanded.

        Rows are of the level of each service and of minus each budget's total in parts of it, shape (services +
        budgets, learners · parameters).
        """
        self._look_ahead()
        services, rows = len(self._prices), list[Floats]()
        for unit in np.eye(services + len(self._aims.budgets)):
            self._write_gradient(0.0, unit[:services], charges_of(self._env, self._aims, unit[services:]))
            rows.append(-self._weights.gradient.flatten().double().cpu().numpy())
        return np.stack(rows)

    def _write_gradient(self, weight: float, prices: Floats, charges: Floats) -> None:
        """Write the gradient; ``weight`` is that of circularity, ``charges`` are by account."""
        feedback, before = FEEDBACK, math.inf
        while True:
            with np.errstate(over="ignore", invalid="ignore"):
                self._go_back(weight, prices, charges, feedback)
            norm = float(torch.linalg.vector_norm(self._weights.gradient, dim=1).max())
            if norm <= GROWN or norm > before / 2.0 or not feedback:
                return
            before, feedback = norm, feedback / 2.0 if feedback > LEAST_FEEDBACK else 0.0

    def _go_back(self, weight: float, prices: Floats, charges: Floats, feedback: float) -> None:
        """Go back through the episode; what was seen passes on ``feedback`` of what it is worth."""
        env, weights, length = self._env, self._weights, len(self._tape)
        count = length * env.num_envs
        scale = env.network.objective.circularity_scale
        by_circularity = np.full(env.num_envs, weight / (scale * count))
        by_level = np.repeat(prices[:, None] / count, env.num_envs, axis=1)
        by_account = -charges / (scale * env.num_envs)
        after = self._tape[-1][0].after
        stock, paths = np.zeros_like(after.stock), np.zeros_like(after.disturbances)
        seen = np.zeros((len(self._observation_places.rows), env.num_envs))
        gradients: list[list[Tensor]] = []
        for interval, values, slopes in reversed(self._tape):
            columns = np.minimum(interval.before.step, by_account.shape[1] - 1)
            outputs = Outputs(stock, by_circularity, by_level, seen, by_account.take(columns, axis=1))
            stock, by_action, _ = self._derivatives.pull_back(interval, outputs, paths)
            gradients.insert(0, chain(weights.actor, values, self._by_output(by_action, values[-1])))
            by_input = gradients[0][0].cpu().numpy() * slopes
            seen[self._observation_places.rows] = -feedback * self._observation_places.of(by_input)
        write_gradients(weights.actor, [values for _, values, _ in self._tape], gradients)

    def _by_output(self, by_action: Floats, outputs: Tensor) -> Tensor:
        """Return the loss's gradient by the outputs, shape (N, B, actions): minus that of what is maximised."""
        gradient, values = np.zeros(outputs.shape, dtype=np.float32), outputs.cpu().numpy()
        gradient[self._action_places.index] = -by_action[self._action_places.rows]
        gradient[(abs(values) > 1.0) & (gradient * values < 0.0)] = 0.0  # further out
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
        run, min_service = self._run, self._run.min_service
        if min_service is None:
            return
        if self._aims.budgets:
            levels = np.concatenate([levels, budget_levels(self._aims, amounts, min_service)])
        means = levels.mean(axis=1) - self._variates.luck(self._draws(), levels.T)
        doubt = 2.0 * QUANTILE_95 * levels.std(axis=1) / math.sqrt(run.episodes)
        lower_bounds = means - np.maximum(doubt, MARGIN * (1.0 - min_service))
        integrals = np.concatenate([self._integrals, self._budget_prices[0]])
        both = price_step(integrals, lower_bounds, min_service, run.price_rate, run.price_damping, least=LEAST_PRICE)
        services = len(self._integrals)
        self._integrals, self._prices = (part[:services] for part in both)
        self._budget_prices = both[0][services:], both[1][services:]

    def _draws(self) -> Floats:
        """Return what was drawn for each copy, shape (B, draws): stocks, numbers, means of disturbances."""
        before = self._tape[0][0].before
        paths = before.disturbances[:-1]
        means = paths.mean(axis=0) if len(paths) else before.factors[:0]
        stocks = self._env.rows.stocks(before.stock)[self._drawn_stocks]
        return np.concatenate([stocks, before.factors, means]).T

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
