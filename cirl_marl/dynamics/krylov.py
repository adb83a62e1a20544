"""Linear systems and fixed points of many copies, of which only images are known, by orthogonal directions.

References: Eisenstat, Elman and Schultz 1983, SIAM Journal on Numerical Analysis 20, 345; Anderson 1965, Journal of
the ACM 12, 547; Walker and Ni 2011, SIAM Journal on Numerical Analysis 49, 1715.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cirl_marl.network import Floats
from cirl_marl.network.compartment_model import Bools

ACCURACY, LEAST = 1e-11, 1e-290
"""Part of a residual that may be left, and what is taken for 0."""
DEPTH, DEPENDENT = 12, 1e-9
"""Most directions that accelerate a fixed point, and the part of one that must be new."""


def conjugate_residuals(
    residual: Floats, total: Floats, respond: Callable[[Floats], tuple[Floats, Floats]]
) -> Floats | None:
    """Solve a linear system of each copy by conjugate residuals; return ``total`` less what the solution does.

    Args:
        residual: right-hand side, shape (unknowns, B).
        total: shape (rows, B).
        respond: for a residual the image of the direction that is to reduce it, and what else this direction does,
            shapes (unknowns, B) and (rows, B).

    Returns:
        None if no solution is found.
    """
    enough, basis = ACCURACY * _size(residual), list[tuple[Floats, Floats]]()
    while (_size(residual) > enough).any():
        if len(basis) > len(residual):
            return None
        image, effect = respond(residual)
        for earlier_image, earlier_effect in basis:
            overlap = (image * earlier_image).sum(axis=0)
            image, effect = image - overlap * earlier_image, effect - overlap * earlier_effect
        size = _size(image)
        inverse = np.divide(1.0, size, out=np.zeros_like(size), where=size > LEAST)
        image, effect = image * inverse, effect * inverse
        part = (residual * image).sum(axis=0)
        residual, total = residual - part * image, total - part * effect
        basis.append((image, effect))
    return total


def _size(vectors: Floats) -> Floats:
    """Return the lengths of the columns."""
    lengths: Floats = np.sqrt((vectors**2).sum(axis=0))
    return lengths


class Acceleration:
    """Anderson acceleration of fixed points x = g(x), shape (B, unknowns), each row for itself.

    What residuals g(x) − x of earlier points tell of the directions between these is taken away from the residual of
    the newest, and the rest of it is a step.
    """

    def __init__(self) -> None:
        """Start without directions."""
        self._basis: list[tuple[Floats, Floats]] = []
        self._point = self._residual = np.empty(0)

    def __call__(self, point: Floats, residual: Floats) -> Floats:
        """Return the next point."""
        if self._point.size:
            change, move = residual - self._residual, point - self._point
            before = _length(change)
            for image, effect in self._basis:
                overlap = (change * image).sum(axis=1, keepdims=True)
                change, move = change - overlap * image, move - overlap * effect
            size = _length(change)
            inverse = np.divide(1.0, size, out=np.zeros_like(size), where=size > DEPENDENT * before + LEAST)
            # where a residual grows the map has a kink between, and earlier directions are forgotten
            falls = _length(residual) < _length(self._residual)
            pairs = [*self._basis[1 - DEPTH :], (change * inverse, move * inverse)]
            self._basis = [(np.where(falls, image, 0.0), np.where(falls, effect, 0.0)) for image, effect in pairs]
        self._point, self._residual = point, residual
        step = residual
        for image, effect in self._basis:
            step = step - (residual * image).sum(axis=1, keepdims=True) * (image + effect)
        return point + step

    def select(self, rows: Bools) -> None:
        """Go on with some rows alone."""
        self._basis = [(image[rows], effect[rows]) for image, effect in self._basis]
        self._point, self._residual = self._point[rows], self._residual[rows]


def _length(vectors: Floats) -> Floats:
    """Return the lengths of the rows, shape (B, 1)."""
    lengths: Floats = np.sqrt((vectors**2).sum(axis=1, keepdims=True))
    return lengths
