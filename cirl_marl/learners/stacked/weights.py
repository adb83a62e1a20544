"""The parameters of many policies as one matrix, a row for each learner, and one optimiser for all."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.policies import ActorCriticPolicy
from torch import Tensor, nn

from cirl_marl.learners.stacked.perceptrons import ACTIVATIONS, Layer, Perceptrons, hidden_layers
from cirl_marl.network import Integers


class Weights:
    """Standard deviations, actors and critics of N policies.

    Policies with fewer entries of observation or action than the largest are padded by weights that are zero and stay
    zero: what they multiply is zero, and so are their gradients. The optimiser works element by element, so that one
    for the whole matrix does what N of them do.

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
        self._policies = policies
        self._places: list[dict[Tensor, Integers]] = [{} for _ in policies]
        self._size = 0
        log_std, actor, critic = self._layout(seen, criticised)
        self.matrix = nn.Parameter(torch.zeros(len(policies), self._size, device=device), requires_grad=False)
        self.gradient = torch.zeros_like(self.matrix)
        self.matrix.grad = self.gradient
        first = policies[0]
        rate = first.optimizer.param_groups[0]["lr"]
        kind: Any = first.optimizer_class
        self.optimiser: torch.optim.Optimizer = kind([self.matrix], lr=rate, **first.optimizer_kwargs)
        self.log_std, self.log_std_gradient = log_std.of(self.matrix), log_std.of(self.gradient)
        found = hidden_layers(first.mlp_extractor.policy_net)
        assert found is not None
        activation = ACTIVATIONS[found[1] or nn.Tanh]
        self.actor, self.critic = (
            Perceptrons(
                [Layer(weight.of(self.matrix), bias.of(self.matrix)) for weight, bias in fields],
                [Layer(weight.of(self.gradient), bias.of(self.gradient)) for weight, bias in fields],
                activation,
            )
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
        for learner, parameter, places in self._all():
            with torch.no_grad():
                parameter.copy_(self.matrix[learner, places].view(parameter.shape))
            optimiser = self._policies[learner].optimizer
            optimiser.param_groups[0]["lr"] = rate
            optimiser.state[parameter] = {
                name: value[learner, places].view(parameter.shape).to(parameter.device)
                if _is_like(value, self.matrix)
                else _copied(value)
                for name, value in remembered.items()
            }

    def _take(self) -> None:
        state: dict[str, Any] = {}
        for learner, parameter, places in self._all():
            self.matrix[learner, places] = parameter.detach().flatten().to(self.matrix.device)
            for name, value in self._policies[learner].optimizer.state.get(parameter, {}).items():
                if not _is_like(value, parameter):
                    state[name] = _copied(value)  # a number of steps: the same for all, who learn together
                    continue
                own = state.setdefault(name, torch.zeros_like(self.matrix))
                own[learner, places] = value.flatten().to(own.device)
        if state:
            self.optimiser.state[self.matrix] = state

    def _all(self) -> Iterator[tuple[int, Tensor, Tensor]]:
        """Yield every learner with each of its parameters and their columns in its row."""
        for learner, (policy, places) in enumerate(zip(self._policies, self._places, strict=True)):
            for parameter in policy.parameters():
                yield learner, parameter, torch.as_tensor(places[parameter], device=self.matrix.device)

    def _layout(
        self, seen: Sequence[Integers], criticised: Sequence[Integers]
    ) -> tuple[_Field, list[tuple[_Field, _Field]], list[tuple[_Field, _Field]]]:
        """Give every parameter its columns."""
        policies = self._policies
        log_std = self._field([policy.log_std for policy in policies], [np.arange(len(p.log_std)) for p in policies])
        actors = [[*_linear(policy.mlp_extractor.policy_net), policy.action_net] for policy in policies]
        critics = [[*_linear(policy.mlp_extractor.value_net), policy.value_net] for policy in policies]
        return log_std, list(self._layers(actors, seen)), list(self._layers(critics, criticised))

    def _layers(self, networks: Sequence[Sequence[Any]], inputs: Sequence[Integers]) -> Iterator[tuple[_Field, _Field]]:
        for layers in zip(*networks, strict=True):
            outputs = [np.arange(layer.out_features) for layer in layers]
            weights = self._field([layer.weight for layer in layers], outputs, inputs)
            yield weights, self._field([layer.bias for layer in layers], outputs)
            inputs = outputs

    def _field(self, parameters: Sequence[Tensor], *indices: Sequence[Integers]) -> _Field:
        """Give a parameter of every learner columns; of a padded tensor it fills these rows, columns and so on."""
        shape = tuple(1 + max(int(own.max()) for own in along) for along in indices)
        for places, parameter, *own in zip(self._places, parameters, *indices, strict=True):
            places[parameter] = self._size + np.ravel_multi_index(np.ix_(*own), shape).ravel()
        first, self._size = self._size, self._size + math.prod(shape)
        return _Field(slice(first, self._size), shape)


class _Field:
    """Where a padded tensor stands in the rows of a matrix."""

    def __init__(self, columns: slice, shape: tuple[int, ...]) -> None:
        self._columns, self._shape = columns, shape

    def of(self, matrix: Tensor) -> Tensor:
        """Return it as a view, shape (learners, …)."""
        return matrix.detach()[:, self._columns].view(-1, *self._shape)


def _linear(network: nn.Module) -> list[nn.Linear]:
    found = hidden_layers(network)
    assert found is not None
    return found[0]


def _is_like(value: object, parameter: Tensor) -> bool:
    return isinstance(value, Tensor) and value.shape == parameter.shape


def _copied(value: Any) -> Any:
    return value.clone() if isinstance(value, Tensor) else value
