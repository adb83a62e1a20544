"""Where the parameters of many policies stand in the rows of one matrix."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor

from cirl_marl.learners.stacked.perceptrons import Layer
from cirl_marl.network import Integers


class Field:
    """Where a padded tensor stands in the rows of a matrix.

    Attributes:
        first: its first column.
    """

    def __init__(self, columns: slice, shape: tuple[int, ...]) -> None:
        """Stand in these columns, which hold a tensor of this shape."""
        self._columns, self._shape, self.first = columns, shape, columns.start

    def of(self, matrix: Tensor) -> Tensor:
        """Return it as a view of a matrix, shape (rows, …)."""
        return matrix.detach()[:, self._columns].view(-1, *self._shape)


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
        shape = tuple(1 + max(int(own.max()) for own in along) for along in indices)
        for places, parameter, *own in zip(self._places, parameters, *indices, strict=True):
            places[parameter] = self.columns + np.ravel_multi_index(np.ix_(*own), shape).ravel()
        first, self.columns = self.columns, self.columns + math.prod(shape)
        return Field(slice(first, self.columns), shape)

    def layers(self, networks: Sequence[Sequence[Any]], inputs: Sequence[Integers]) -> list[tuple[Field, Field | None]]:
        """Give the linear layers of a network of every learner columns; it looks at these entries of the inputs."""
        found: list[tuple[Field, Field | None]] = []
        for layers in zip(*networks, strict=True):
            outputs = [np.arange(layer.out_features) for layer in layers]
            weight = self.field([layer.weight for layer in layers], outputs, inputs)
            biases = [layer.bias for layer in layers]
            found.append((weight, None if biases[0] is None else self.field(biases, outputs)))
            inputs = outputs
        return found

    def places(self, learner: int) -> Iterator[tuple[Tensor, Tensor]]:
        """Yield each parameter of a learner with its columns."""
        for parameter, columns in self._places[learner].items():
            yield parameter, torch.as_tensor(columns)


def layers_of(fields: Sequence[tuple[Field, Field | None]], matrix: Tensor) -> list[Layer]:
    """Return layers as views of a matrix."""
    return [Layer(weight.of(matrix), None if bias is None else bias.of(matrix)) for weight, bias in fields]
