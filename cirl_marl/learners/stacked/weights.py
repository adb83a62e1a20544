"""Actors and critics of many learners, and one optimiser for all."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn

from cirl_marl.learners.stacked.layout import ParameterLayout, layers_of
from cirl_marl.learners.stacked.perceptrons import ACTIVATIONS, Perceptrons, linear_layers
from cirl_marl.network import Integers


class Weights:
    """Standard deviations, actors and critics of N policies.

    The optimiser works element by element, so that one for the whole matrix does what N of them do.

    Attributes:
        matrix: parameters of all learners, shape (learners, parameters).
        gradient: of the same shape.
        log_std: logarithm of the standard deviation of each action, shape (learners, actions); a view of the matrix.
        log_std_gradient: its part of the gradient.
        actor: from what an agent sees to the mean of its action.
        critic: from what a critic sees to the value of the state.
        optimiser: of the kind and with the settings that the policies have.
    """

    def __init__(
        self,
        policies: Sequence[ActorCriticPolicy],
        seen: Sequence[Integers],
        criticised: Sequence[Integers],
        device: torch.device,
    ) -> None:
        """Take over the parameters and what the optimisers remember.

        ``seen`` and ``criticised`` are, by learner, the columns of the padded inputs at which its actor and its critic
        look.
        """
        self._policies, self._layout = policies, (layout := ParameterLayout(len(policies)))
        log_std = layout.field([p.log_std for p in policies], [np.arange(len(p.log_std)) for p in policies])
        extractors = [policy.mlp_extractor for policy in policies]
        heads = [(policy.action_net, policy.value_net) for policy in policies]
        linear = [(linear_layers(each.policy_net)[0], linear_layers(each.value_net)[0]) for each in extractors]
        actor = layout.layers([[*own, head] for (own, _), (head, _) in zip(linear, heads, strict=True)], seen)
        critic = layout.layers([[*own, head] for (_, own), (_, head) in zip(linear, heads, strict=True)], criticised)
        self.matrix = nn.Parameter(torch.zeros(len(policies), layout.columns, device=device), requires_grad=False)
        self.gradient = torch.zeros_like(self.matrix)
        self.matrix.grad = self.gradient
        first = policies[0]
        kind: Any = first.optimizer_class
        rate = first.optimizer.param_groups[0]["lr"]
        self.optimiser: torch.optim.Optimizer = kind([self.matrix], lr=rate, **first.optimizer_kwargs)
        self.log_std, self.log_std_gradient = log_std.of(self.matrix), log_std.of(self.gradient)
        activation = ACTIVATIONS[linear_layers(extractors[0].policy_net)[1] or nn.Tanh]
        self.actor, self.critic = (
            Perceptrons(layers_of(fields, self.matrix), activation, layers_of(fields, self.gradient))
            for fields in (actor, critic)
        )
        self._take()

    def clip(self, norm: float) -> None:
        """Scale the gradient of each learner down to at most ``norm``, as torch's ``clip_grad_norm_`` does."""
        own = torch.linalg.vector_norm(self.gradient, dim=1, keepdim=True)
        self.gradient.mul_((norm / (own + 1e-6)).clamp(max=1.0))

    def give(self) -> None:
        """Give each policy its parameters, and its optimiser what it remembers."""
        remembered = self.optimiser.state.get(self.matrix, {})
        rate = self.optimiser.param_groups[0]["lr"]
        for learner, policy in enumerate(self._policies):
            policy.optimizer.param_groups[0]["lr"] = rate
            for parameter, columns in self._layout.places(learner):
                with torch.no_grad():
                    parameter.copy_(self.matrix[learner, columns].view(parameter.shape))
                policy.optimizer.state[parameter] = {
                    name: value[learner, columns].view(parameter.shape).to(parameter.device)
                    if _is_like(value, self.matrix)
                    else _copied(value)
                    for name, value in remembered.items()
                }

    def _take(self) -> None:
        state: dict[str, Any] = {}
        for learner, policy in enumerate(self._policies):
            for parameter, columns in self._layout.places(learner):
                self.matrix[learner, columns] = parameter.detach().flatten().to(self.matrix.device)
                for name, value in policy.optimizer.state.get(parameter, {}).items():
                    if not _is_like(value, parameter):
                        state[name] = _copied(value)  # a number of steps: the same for all, who learn together
                        continue
                    own = state.setdefault(name, torch.zeros_like(self.matrix))
                    own[learner, columns] = value.flatten().to(own.device)
        if state:
            self.optimiser.state[self.matrix] = state


def _is_like(value: object, parameter: Tensor) -> bool:
    return isinstance(value, Tensor) and value.shape == parameter.shape


def _copied(value: Any) -> Any:
    return value.clone() if isinstance(value, Tensor) else value
