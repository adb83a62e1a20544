"""Autoregressive noise around a regression, by restricted maximum likelihood.

y = X b + r with r_t = φ r_{t−1} + s ε_t, stationary, so that its deviation is σ = s/√(1 − φ²). The restricted
likelihood is that of what the regression leaves over; its σ and φ are nearly unbiased in short series, where least
squares make both too small. Around a trend, 1.96 standard errors on either side hold φ 93 to 97 times in 100 and σ 88
times in 100 with 100 rows and φ = 0.8, 76 times with 25.

With the whitened rows √(1 − φ²)·w_0 and w_t − φ w_{t−1} of W = [X y] it is, up to a constant,
−2 ln L = (n − k) ln s² + RSS/s² + ln |X*ᵀX*| − ln(1 − φ²), and all products are polynomials of φ.

References: Cheang and Reinsel 2000, Bias reduction of autoregressive estimates in time series regression model through
restricted maximum likelihood.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from scipy import optimize

from cirl_marl.errors import CirlError
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.rowsum import Floats

LARGEST = 3.0
"""Largest artanh φ in size, φ = 0.995: beyond it a series does not tell reversion from a random walk."""
STEP = 1e-3
"""Step of the second differences of the likelihood."""


@positional_record
class Autoregression:
    """What was estimated, with standard errors from the curvature of the likelihood."""

    persistence: Annotated[float, "φ"]
    deviation: Annotated[float, "σ"]
    persistence_error: Annotated[float, "standard error of φ"]
    deviation_error: Annotated[float, "standard error of σ"]
    coefficients: Annotated[Floats, "b, shape (columns of X,)"]
    coefficient_errors: Annotated[Floats, "standard errors, likewise"]
    residuals: Annotated[Floats, "r, shape (n,)"]

    @property
    def innovations(self) -> Floats:
        """ε_t for t = 1 … n − 1."""
        noise: Floats = np.diff(self.residuals) + (1.0 - self.persistence) * self.residuals[:-1]
        noise /= self.deviation * np.sqrt(1.0 - self.persistence**2)
        return noise


def autoregression(series: Floats, regressors: Floats) -> Autoregression:
    """Return the estimates of a series y, shape (n,), with regressors X, shape (n, k), of full rank.

    Raises:
        CirlError: if the noise does not revert to its mean.
    """
    degrees, products = len(series) - regressors.shape[1], _products(np.column_stack([regressors, series]))

    def deviance(z: float, log_noise: float | None = None) -> float:
        """Return −2 ln L at φ = tanh z; without ln s at the best s."""
        normal, residual = _projection(products, np.tanh(z))
        fit = degrees * np.log(residual / degrees) + degrees
        if log_noise is not None:
            fit = 2 * degrees * log_noise + residual * np.exp(-2 * log_noise)
        return float(fit + np.linalg.slogdet(normal)[1] + 2 * np.log(np.cosh(z)))

    grid = np.linspace(-LARGEST, LARGEST, 61)
    nearest = int(np.argmin([deviance(z) for z in grid]))
    if nearest in (0, len(grid) - 1):
        deviation = np.diff(series).std(ddof=1)
        remedy = f"random_walk forgets nothing (here its steps have the deviation {deviation:.3g})"
        raise CirlError(f"does not revert to its mean, persistence {np.tanh(grid[nearest]):.3g} and beyond; {remedy}")
    ends = grid[nearest - 1], grid[nearest + 1]
    z = float(optimize.minimize_scalar(deviance, bounds=ends, method="bounded", options={"xatol": 1e-10}).x)
    normal, residual = _projection(products, np.tanh(z))
    log_noise = 0.5 * np.log(residual / degrees)
    curvature = np.empty((2, 2))
    for i, a in enumerate(np.eye(2) * STEP):
        for j, b in enumerate(np.eye(2) * STEP):
            corners = [sign * deviance(*(np.array([z, log_noise]) + p * a + q * b)) for sign, p, q in CORNERS]
            curvature[i, j] = sum(corners) / (8 * STEP**2)
    covariance = np.linalg.inv(curvature)
    phi, sigma = np.tanh(z), np.exp(log_noise) * np.cosh(z)
    # ln σ = ln s + ln cosh z, the derivative of which by z is φ
    slope = np.array([phi, 1.0])
    coefficients = np.asarray(np.linalg.solve(normal, _at(products, phi)[:-1, -1]), dtype=float)
    return Autoregression(
        persistence=float(phi),
        deviation=float(sigma),
        persistence_error=float((1.0 - phi**2) * np.sqrt(covariance[0, 0])),
        deviation_error=float(sigma * np.sqrt(slope @ covariance @ slope)),
        coefficients=coefficients,
        coefficient_errors=np.exp(log_noise) * np.sqrt(np.diag(np.linalg.inv(normal))),
        residuals=series - regressors @ coefficients,
    )


CORNERS = ((1, 1, 1), (-1, 1, -1), (-1, -1, 1), (1, -1, -1))
"""Signs of the values and of the two steps of a mixed second difference."""


def _products(table: Floats) -> tuple[Floats, Floats, Floats]:
    """Return M₀, M₁, M₂ of the whitened products M₀ − φ M₁ + φ² M₂ of the columns of a table."""
    cross = table[1:].T @ table[:-1]
    inner = table[1:-1]
    return table.T @ table, cross + cross.T, inner.T @ inner


def _at(products: tuple[Floats, Floats, Floats], phi: float) -> Floats:
    """Return the whitened products of [X y] at φ."""
    constant, linear, square = products
    return constant - phi * linear + phi**2 * square


def _projection(products: tuple[Floats, Floats, Floats], phi: float) -> tuple[Floats, float]:
    """Return X*ᵀX* and the sum of squares RSS that the regression leaves."""
    whole = _at(products, phi)
    normal, right = whole[:-1, :-1], whole[:-1, -1]
    return normal, float(whole[-1, -1] - right @ np.linalg.solve(normal, right))
