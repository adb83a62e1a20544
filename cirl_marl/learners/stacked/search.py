"""Augmented random search of many learners as one, its candidates side by side in the copies of the environment."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from sb3_contrib import ARS
from sb3_contrib.ars.policies import ARSPolicy
from torch import Tensor, nn

from cirl_marl.learners.learner import Learner
from cirl_marl.learners.stacked import perceptrons
from cirl_marl.learners.stacked.stack import Stack


class SearchStack(Stack):
    """ARS learners of the same settings (Mania et al. 2018, arXiv 1803.07055), who all try their candidates at once.

    Candidate k of every learner acts beside candidate k of the others. If all are paid the same, the search is that of
    one learner whose parameters are those of all, though nobody sees more than its own observation. A candidate has
    ``n_eval_episodes`` episodes, each in a copy of its own; with as many of them as there are copies, candidates take
    turns, which is what the algorithm does by itself.
    """

    def __init__(self, members: Sequence[Learner], device: str = "cpu") -> None:
        """Take over parameters, counters and streams of the learners."""
        super().__init__(members, device)
        first = self._models[0]
        self._layout = perceptrons.ParameterLayout(len(members))
        parts = [parts_of(model.policy) for model in self._models]
        self._fields = self._layout.layers([[*linear, head] for linear, head, _ in parts], self._inputs.actor_columns)
        self._activation = parts[0][2]
        self._squashes = first.policy.squash_output
        self._centre = torch.zeros(len(members), self._layout.columns, device=self._device)
        for i in range(len(members)):
            for parameter, columns in self._layout.places(i):
                self._centre[i, columns] = parameter.detach().flatten().to(self._device)
        self._columns = [torch.cat([c for _, c in self._layout.places(i)]) for i in range(len(members))]
        source, last_layer = members[0].spec.start, self._fields[-1][0]
        self._fixed_columns = slice(last_layer.columns.start) if source is not None and source.last_layer else None
        agent_env = members[0].agent_env
        self._rows, self._copies = agent_env.num_envs, agent_env.copies
        self._copies_per_candidate = copies_per_candidate(members[0])
        # the algorithm counts a step of all its rows once for each of them
        self._before: int = first.num_timesteps // self._rows**2
        self._updates: int = first._n_updates

    def learn(self, steps: int) -> None:
        """Learn for the share of ``steps`` that is the learners'.

        With δ_k standard normal, R_k± the returns of the candidates θ ± s δ_k, and b the number of the best pairs::

            θ ← θ + α/(b σ_R) Σ_k (R_k+ − R_k−) δ_k
        """
        budget, first = self.members[0].budget(steps), self._models[0]
        if not self._is_restoring:
            self._inputs.begin()
        while self._steps < budget:
            self._arrive()
            progress_remaining = 1.0 - self._steps / budget
            rate, std = first.lr_schedule(progress_remaining), first.delta_std_schedule(progress_remaining)
            deltas = self._draw_directions()
            steps_in_weights = std * deltas
            centre = self._centre[:, None]
            returns = self._returns(torch.cat([centre + steps_in_weights, centre - steps_in_weights], dim=1))
            better, worse = returns[:, : first.n_delta], returns[:, first.n_delta :]
            top = torch.argsort(torch.maximum(better, worse), dim=1, descending=True)[:, : first.n_top]
            better, worse = better.gather(1, top), worse.gather(1, top)
            spread = torch.cat([better, worse], dim=1).std(dim=1)
            size = rate / (first.n_top * spread + 1e-6)
            directions = deltas.gather(1, top[..., None].expand(-1, -1, deltas.shape[2]))
            self._centre += size[:, None] * torch.einsum("nk,nkp->np", better - worse, directions)
            self._updates += 1
            self._log(returns, spread, size, rate, std)

    @property
    def _steps(self) -> int:
        return self._before + self._steps_done

    def _deterministic_actions(self, observations: Tensor, members: slice = slice(None)) -> Tensor:
        return self._actions(self._centre[members], observations)

    def _give_models(self) -> None:
        for i, model in enumerate(self._models):
            vector = self._centre[i, self._columns[i]].cpu()
            model.policy.load_from_vector(vector.numpy())
            model.weights = vector
            model.num_timesteps, model._n_updates = self._steps * self._rows**2, self._updates

    def _draw_directions(self) -> Tensor:
        """Return the directions of all learners, each drawn as it draws them, shape (learners, K, columns).

        Where only the last layer learns, the others do not move.
        """
        count = self._models[0].n_delta
        deltas = torch.zeros(len(self.members), count, self._layout.columns)
        for directions, stream, columns in zip(deltas, self._noise, self._columns, strict=True):
            directions[:, columns] = torch.normal(0.0, 1.0, (count, len(columns)), generator=stream)
        if self._fixed_columns is not None:
            deltas[:, :, self._fixed_columns] = 0.0
        return deltas.to(self._device)

    def _returns(self, candidates: Tensor) -> Tensor:
        """Return the returns of each learner in the episodes of each candidate, shape (learners, candidates)."""
        at_once = self._copies // self._copies_per_candidate
        return torch.cat([self._episodes(some) for some in torch.split(candidates, at_once, dim=1)], dim=1)

    def _episodes(self, candidates: Tensor) -> Tensor:
        """Let candidates, shape (learners, C, columns), act for one episode, each in its copies."""
        learners, count = candidates.shape[:2]
        matrix = candidates.reshape(learners * count, -1)
        agents = self._rows // self._copies  # rows of a shared policy, agent by agent
        shape, rows = (learners, agents, count, self._copies_per_candidate), agents * self._copies_per_candidate
        observations, goes_on, total = self._inputs.begin(), True, torch.zeros(learners, count, device=self._device)
        offset = self._models[0].alive_bonus_offset
        while goes_on:
            by_candidate = observations.view(*shape, -1).transpose(1, 2)
            actions = self._actions(matrix, by_candidate.reshape(len(matrix), rows, -1))
            by_row = actions.view(learners, count, agents, self._copies_per_candidate, -1).transpose(1, 2)
            observations = self._move(by_row.reshape(learners, self._rows, -1))
            rewards, dones = self._inputs.rewards_and_dones()
            total += (rewards + offset).view(*shape).sum(dim=(1, 3))
            goes_on = not dones.all()
        return total

    def _actions(self, matrix: Tensor, observations: Tensor) -> Tensor:
        layers = perceptrons.layers_of(self._fields, matrix)
        outputs = perceptrons.Perceptrons(layers, self._activation).forward(observations)[-1]
        return outputs.tanh() if self._squashes else outputs

    def _log(self, returns: Tensor, spread: Tensor, size: Tensor, rate: float, std: float) -> None:
        """Log the figures of an update that the algorithm logs, for each learner with a logger."""
        episodes = self._rows // self._copies * self._copies_per_candidate
        for i, model in enumerate(self._models):
            if model.logger.output_formats:
                model.logger.record("rollout/ep_rew_mean", float(returns[i].mean()) / episodes)
                model.logger.record("rollout/return_std", float(spread[i]))
                model.logger.record("train/step_size", float(size[i]))
                model.logger.record("train/learning_rate", rate)
                model.logger.record("train/delta_std", std)
                model.logger.dump(self._steps * self._copies)


def parts_of(policy: ARSPolicy) -> tuple[list[nn.Linear], nn.Linear, perceptrons.Activation]:
    """Return hidden layers, last layer and activation of a policy.

    Raises:
        TypeError: if it is no such sequence, or there is no gradient-free form of its activation.
    """
    modules = list(policy.action_net.children())
    if policy.squash_output:
        modules = modules[:-1]
    linear, kind = perceptrons.linear_layers(nn.Sequential(*modules[:-1]))
    if type(modules[-1]) is not nn.Linear or (kind or nn.Tanh) not in perceptrons.ACTIVATIONS:
        raise TypeError(f"not linear layers with Tanh or ReLU between them: {policy.action_net}")
    return linear, modules[-1], perceptrons.ACTIVATIONS[kind or nn.Tanh]


def copies_per_candidate(learner: Learner) -> int:
    """Return in how many copies a candidate acts, for the episodes that it has; an episode is one row's.

    Raises:
        ValueError: if candidates do not fill the copies evenly.
    """
    model, agent_env = learner.model, learner.agent_env
    assert isinstance(model, ARS)
    agents = agent_env.num_envs // agent_env.copies
    count, remainder = divmod(model.n_eval_episodes, agents)
    if remainder or not count or agent_env.copies % count or model.pop_size % (agent_env.copies // count):
        raise ValueError(
            f"{model.pop_size} candidates (2 n_delta) of {model.n_eval_episodes} episodes each (n_eval_episodes) "
            f"do not fill {agent_env.copies} copies with {agents} rows evenly"
        )
    return count
