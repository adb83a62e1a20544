"""Multilayer perceptrons of one shape side by side: values, and gradients by the chain rule."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

CELLS = 262_144
"""Hidden units times samples that are worked on at once on a CPU: few enough for its cache, many for each call."""


def _tanh_(values: Tensor) -> Tensor:
    """Take the hyperbolic tangent in place; NumPy's is several times as fast as torch's on a CPU."""
    if values.is_cpu and values.is_contiguous():
        array = values.numpy()
        np.tanh(array, out=array)
        return values
    return values.tanh_()


def _multiply(left: Tensor, right: Tensor, into: Tensor) -> None:
    """Write the products of matrices; NumPy's are some ten times as fast as torch's on a CPU where one is narrow."""
    if into.is_cpu:
        np.matmul(left.numpy(), right.numpy(), out=into.numpy())
    else:
        into.copy_(torch.bmm(left, right))


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

    def __getitem__(self, some: slice) -> Layer:
        """Return the layer of some learners."""
        return Layer(self.weight[some], None if self.bias is None else self.bias[some])

    def of(self, inputs: Tensor) -> Tensor:
        """Return W x + b, shape (learners, samples, out)."""
        if self.bias is None:
            return torch.bmm(inputs, self.weight.mT)
        return torch.baddbmm(self.bias[:, None], inputs, self.weight.mT)


@dataclass(frozen=True, slots=True)
class Perceptrons:
    """N perceptrons, each ``x ↦ W_L a(… a(W_1 x + b_1) …) + b_L``, and where their gradients go, if they have any."""

    layers: Sequence[Layer]
    activation: Activation
    gradients: Sequence[Layer] = ()

    @property
    def width(self) -> int:
        """Units of the widest layer."""
        return max(layer.weight.shape[1] for layer in self.layers)

    def forward(self, inputs: Tensor, some: slice = slice(None)) -> list[Tensor]:
        """Return the inputs, shape (learners, samples, in), the hidden units of each layer, and the outputs."""
        values = [inputs]
        for layer in self.layers:
            values.append(layer[some].of(values[-1]))
            if layer is not self.layers[-1]:
                self.activation.value(values[-1])
        return values

    def backward(self, values: Sequence[Tensor], gradient: Tensor, some: slice = slice(None)) -> None:
        """Write the gradients of weights and biases, from what ``forward`` gave and the gradient of the outputs."""
        for place in reversed(range(len(self.layers))):
            into = self.gradients[place][some]
            _multiply(gradient.mT, values[place], into.weight)
            if into.bias is not None:
                into.bias.copy_(gradient.sum(dim=1))
            if place:
                gradient = torch.bmm(gradient, self.layers[place].weight[some])
                gradient = self.activation.gradient(gradient, values[place])


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
