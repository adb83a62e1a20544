"""Multilayer perceptrons of one shape side by side: values, and gradients by the chain rule."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from sb3_contrib.tqc.policies import Actor as QuantileActor
from stable_baselines3.common.policies import ActorCriticPolicy, BasePolicy
from stable_baselines3.sac.policies import Actor as SquashedActor
from stable_baselines3.td3.policies import Actor as DeterministicActor
from torch import Tensor, nn

from cirl_marl.network import Integers

CELLS = 262_144
"""Hidden units times samples that are worked on at once on a CPU: few enough for its cache, many for each call."""


def _tanh_(values: Tensor) -> Tensor:
    """Take the hyperbolic tangent in place; NumPy's is several times as fast as torch's on a CPU."""
    if values.is_cpu and values.is_contiguous():
        array = values.numpy()
        np.tanh(array, out=array)
        return values
    return values.tanh_()


def _multiply(first: Tensor, second: Tensor, into: Tensor) -> None:
    """Write the products of matrices; NumPy's are some ten times as fast as torch's on a CPU where one is narrow."""
    if into.is_cpu:
        np.matmul(first.numpy(), second.numpy(), out=into.numpy())
    else:
        into.copy_(torch.bmm(first, second))


@dataclass(frozen=True, slots=True)
class Activation:
    """A function of hidden units, in place, and the gradient before it from that after it and its value."""

    value: Callable[[Tensor], Tensor]
    gradient: Callable[[Tensor, Tensor], Tensor]


ACTIVATIONS: Mapping[type[nn.Module], Activation] = {
    nn.Tanh: Activation(_tanh_, torch.ops.aten.tanh_backward.default),
    nn.ReLU: Activation(torch.relu_, lambda gradient, value: gradient.mul_(value > 0)),
}


@dataclass(frozen=True, slots=True)
class Layer:
    """Weights, shape (learners, out, in), and biases, shape (learners, out), if there are any; or their gradients."""

    weight: Tensor
    bias: Tensor | None

    def __getitem__(self, members: slice) -> Layer:
        """Return the layer of some learners."""
        return Layer(self.weight[members], None if self.bias is None else self.bias[members])

    def of(self, inputs: Tensor) -> Tensor:
        """Return W x + b, shape (learners, samples, out)."""
        if self.bias is None:
            return torch.bmm(inputs, self.weight.mT)
        return torch.baddbmm(self.bias[:, None], inputs, self.weight.mT)


@dataclass(frozen=True, slots=True)
class Perceptrons:
    """N perceptrons, each ``x ↦ W_L a(… a(W_1 x + b_1) …) + b_L``, and where their gradients go, if they have any.

    ``squash`` follows, where the outputs are bounded.
    """

    layers: Sequence[Layer]
    activation: Activation
    gradients: Sequence[Layer] = ()
    squash: Activation | None = None

    @property
    def width(self) -> int:
        """Units of the widest layer."""
        return max(layer.weight.shape[1] for layer in self.layers)

    def forward(self, inputs: Tensor, members: slice = slice(None)) -> list[Tensor]:
        """Return the inputs, shape (learners, samples, in), the hidden units of each layer, and the outputs."""
        values = [inputs]
        for layer in self.layers:
            values.append(layer[members].of(values[-1]))
            if layer is not self.layers[-1]:
                self.activation.value(values[-1])
            elif self.squash is not None:
                self.squash.value(values[-1])
        return values

    def before_squash(self, values: Sequence[Tensor], gradient: Tensor) -> Tensor:
        """Return the gradient of what is squashed, from that of the outputs."""
        return gradient if self.squash is None else self.squash.gradient(gradient, values[-1])

    def backward(self, values: Sequence[Tensor], gradient: Tensor, members: slice = slice(None)) -> None:
        """Write the gradients of weights and biases, from what ``forward`` gave and the gradient of the outputs."""
        gradient = self.before_squash(values, gradient)
        for place in reversed(range(len(self.layers))):
            into = self.gradients[place][members]
            _multiply(gradient.mT, values[place], into.weight)
            if into.bias is not None:
                into.bias.copy_(gradient.sum(dim=1))
            if place:
                gradient = torch.bmm(gradient, self.layers[place].weight[members])
                gradient = self.activation.gradient(gradient, values[place])


def chain(perceptrons: Perceptrons, values: Sequence[Tensor], gradient: Tensor) -> list[Tensor]:
    """Return the gradients of the inputs and of each layer's sums, shape (learners, samples, …), from the outputs'."""
    gradients = [perceptrons.before_squash(values, gradient)]
    for place in reversed(range(len(perceptrons.layers))):
        before = torch.bmm(gradients[0], perceptrons.layers[place].weight)
        gradients.insert(0, perceptrons.activation.gradient(before, values[place]) if place else before)
    return gradients


def write_gradients(
    perceptrons: Perceptrons, values: Sequence[Sequence[Tensor]], gradients: Sequence[Sequence[Tensor]]
) -> None:
    """Write the gradients of weights and biases, summed over batches of samples.

    Of each batch there is what ``forward`` and ``chain`` gave.
    """
    for place, into in enumerate(perceptrons.gradients):
        inputs = torch.cat([batch[place] for batch in values], dim=1)
        gradient = torch.cat([batch[place + 1] for batch in gradients], dim=1)
        _multiply(gradient.mT, inputs, into.weight)
        if into.bias is not None:
            into.bias.copy_(gradient.sum(dim=1))


def pieces(learners: int, cells: int, device: torch.device) -> Iterator[slice]:
    """Yield the learners that are worked on at once, where each has so many ``cells``; off the CPU all of them."""
    at_once = learners if device.type != "cpu" else max(1, CELLS // cells)
    for first in range(0, learners, at_once):
        yield slice(first, min(first + at_once, learners))


def linear_layers(network: nn.Module) -> tuple[list[nn.Linear], type[nn.Module] | None]:
    """Return the linear layers of a sequence, and the one kind of activation that follows each of them, if any.

    Raises:
        TypeError: if the sequence is no such.
    """
    modules: list[Any] = list(network.children())
    linear, between = modules[::2], modules[1::2]
    kinds = {type(module) for module in between}
    if len(linear) != len(between) or len(kinds) > 1 or not all(type(module) is nn.Linear for module in linear):
        raise TypeError(f"not linear layers with an activation after each: {network}")
    return linear, kinds.pop() if kinds else None


@dataclass(frozen=True, slots=True)
class Field:
    """Where a padded tensor of some shape stands in the rows of a matrix."""

    columns: slice
    shape: tuple[int, ...]

    def of(self, matrix: Tensor) -> Tensor:
        """Return it as a view of a matrix, shape (rows, …)."""
        return matrix.detach()[:, self.columns].view(-1, *self.shape)


class ParameterLayout:
    """A matrix with a row for each of N policies.

    Policies with fewer entries of observation or action than the largest are padded by parameters that are zero and
    stay zero: what they multiply is zero, and so are their gradients.

    Attributes:
        columns: of the matrix.
    """

    def __init__(self, learners: int) -> None:
        """Begin with no columns."""
        self.columns = 0
        self._places: list[dict[Tensor, Integers]] = [{} for _ in range(learners)]

    def field(self, parameters: Sequence[Tensor], *indices: Sequence[Integers]) -> Field:
        """Give a parameter of every learner columns; of a padded tensor it fills these rows, columns and so on."""
        shape = tuple(1 + max(int(index_sets.max()) for index_sets in along) for along in indices)
        for places, parameter, *index_sets in zip(self._places, parameters, *indices, strict=True):
            places[parameter] = self.columns + np.ravel_multi_index(np.ix_(*index_sets), shape).ravel()
        first, self.columns = self.columns, self.columns + math.prod(shape)
        return Field(slice(first, self.columns), shape)

    def layers(self, networks: Sequence[Sequence[Any]], inputs: Sequence[Integers]) -> list[tuple[Field, Field | None]]:
        """Give the linear layers of a network of every learner columns; it looks at these entries of the inputs."""
        fields: list[tuple[Field, Field | None]] = []
        for layers in zip(*networks, strict=True):
            outputs = [np.arange(layer.out_features) for layer in layers]
            weight = self.field([layer.weight for layer in layers], outputs, inputs)
            biases = [layer.bias for layer in layers]
            fields.append((weight, None if biases[0] is None else self.field(biases, outputs)))
            inputs = outputs
        return fields

    def places(self, learner: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield each parameter of a learner with its columns."""
        for parameter, columns in self._places[learner].items():
            yield parameter, torch.as_tensor(columns)


def layers_of(fields: Sequence[tuple[Field, Field | None]], matrix: Tensor) -> list[Layer]:
    """Return layers as views of a matrix."""
    return [Layer(weight.of(matrix), None if bias is None else bias.of(matrix)) for weight, bias in fields]


@dataclass(frozen=True, slots=True)
class Networks:
    """The perceptrons of a policy, and what moves them."""

    optimiser: torch.optim.Optimizer
    actor: Sequence[nn.Module]
    activation: type[nn.Module] | None
    squash: Activation | None = None
    critic: Sequence[nn.Module] = ()
    log_std: Tensor | None = None


def networks_of(policy: BasePolicy) -> Networks:
    """Return the networks of a policy; critics of off-policy algorithms, which judge actions, are left out.

    Raises:
        TypeError: if it is none of multilayer perceptrons.
    """
    squash = ACTIVATIONS[nn.Tanh]
    if isinstance(policy, ActorCriticPolicy):
        actor, activation = linear_layers(policy.mlp_extractor.policy_net)
        critic, _ = linear_layers(policy.mlp_extractor.value_net)
        layers = [*actor, policy.action_net], activation, None, [*critic, policy.value_net]
        return Networks(policy.optimizer, *layers, policy.log_std)
    owner: Any = getattr(policy, "actor", None)
    if isinstance(owner, DeterministicActor):
        *body, last, _ = owner.mu.children()
    elif isinstance(owner, SquashedActor | QuantileActor):
        body, last = [*owner.latent_pi.children()], owner.mu
    else:
        raise TypeError(f"policy {type(policy).__name__} has no actor that is a multilayer perceptron")
    linear, activation = linear_layers(nn.Sequential(*body))
    return Networks(owner.optimizer, [*linear, last], activation, squash)


class Weights:
    """Standard deviations, actors and critics of N policies.

    The optimiser works element by element, so that one for the whole matrix does what N of them do.

    Attributes:
        matrix: parameters of all learners, shape (learners, parameters).
        gradient: of the same shape.
        log_std: logarithm of the standard deviation of each action, shape (learners, actions); a view of the matrix.
            Policies of off-policy algorithms have none, and no critic here.
        log_std_gradient: its part of the gradient.
        actor: from what an agent sees to the mean of its action.
        critic: from what a critic sees to the value of the state.
        optimiser: of the kind and with the settings that the policies have.
    """

    def __init__(
        self,
        policies: Sequence[BasePolicy],
        actor_columns: Sequence[Integers],
        critic_columns: Sequence[Integers],
        device: torch.device,
    ) -> None:
        """Take over the parameters and the states of the optimisers.

        ``actor_columns`` and ``critic_columns`` are, by learner, the columns of the padded inputs at which its actor
        and its critic look.
        """
        self._networks = [networks_of(policy) for policy in policies]
        self._layout = layout = ParameterLayout(len(policies))
        networks, kind = self._networks, self._networks[0]
        deviations = [part.log_std for part in networks if part.log_std is not None]
        log_std = layout.field(deviations, [np.arange(len(part)) for part in deviations]) if deviations else None
        actor = layout.layers([part.actor for part in networks], actor_columns)
        critic = layout.layers([part.critic for part in networks], critic_columns)
        self.matrix = nn.Parameter(torch.zeros(len(policies), layout.columns, device=device), requires_grad=False)
        self.gradient = torch.zeros_like(self.matrix)
        self.matrix.grad = self.gradient
        optimiser: Any = policies[0].optimizer_class
        rate = kind.optimiser.param_groups[0]["lr"]
        self.optimiser: torch.optim.Optimizer = optimiser([self.matrix], lr=rate, **policies[0].optimizer_kwargs)
        if log_std is not None:
            self.log_std, self.log_std_gradient = log_std.of(self.matrix), log_std.of(self.gradient)
        activation = ACTIVATIONS[kind.activation or nn.Tanh]
        self.actor, self.critic = (
            Perceptrons(layers_of(fields, self.matrix), activation, layers_of(fields, self.gradient), squash)
            for fields, squash in ((actor, kind.squash), (critic, None))
        )
        self._take()

    def clip(self, norm: float) -> None:
        """Scale the gradient of each learner down to at most ``norm``, as torch's ``clip_grad_norm_`` does."""
        norms = torch.linalg.vector_norm(self.gradient, dim=1, keepdim=True)
        self.gradient.mul_((norm / (norms + 1e-6)).clamp(max=1.0))

    def give(self) -> None:
        """Give each policy its parameters, and its optimiser its state."""
        optimiser_state = self.optimiser.state.get(self.matrix, {})
        rate = self.optimiser.param_groups[0]["lr"]
        for learner, networks in enumerate(self._networks):
            networks.optimiser.param_groups[0]["lr"] = rate
            for parameter, columns in self._layout.places(learner):
                with torch.no_grad():
                    parameter.copy_(self.matrix[learner, columns].view(parameter.shape))
                networks.optimiser.state[parameter] = {
                    name: value[learner, columns].view(parameter.shape).to(parameter.device)
                    if _is_like(value, self.matrix)
                    else _copy(value)
                    for name, value in optimiser_state.items()
                }

    def _take(self) -> None:
        state: dict[str, Any] = {}
        for learner, networks in enumerate(self._networks):
            for parameter, columns in self._layout.places(learner):
                self.matrix[learner, columns] = parameter.detach().flatten().to(self.matrix.device)
                for name, value in networks.optimiser.state.get(parameter, {}).items():
                    if not _is_like(value, parameter):
                        state[name] = _copy(value)  # a number of steps: the same for all, who learn together
                        continue
                    rows = state.setdefault(name, torch.zeros_like(self.matrix))
                    rows[learner, columns] = value.flatten().to(rows.device)
        if state:
            self.optimiser.state[self.matrix] = state


def _is_like(value: object, parameter: Tensor) -> bool:
    return isinstance(value, Tensor) and value.shape == parameter.shape


def _copy(value: Any) -> Any:
    return value.clone() if isinstance(value, Tensor) else value
