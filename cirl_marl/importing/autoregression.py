"""Autoregressive noise around a regression, by restricted maximum likelihood.

y = X b + r with r_t = φ r_{t−1} + s ε_t, stationary, so that its deviation is σ = s/√(1 − φ²). The restricted
likelihood is that of what the regression leaves over; its σ and φ are nearly unbiased in short series, where least
squares make both too small. Around a trend, 1.96 standard errors on either side hold φ 93 to 97 times in 100, but σ 88
times in 100 with 100 rows and φ = 0.8, and 76 times with 25; the interval of the profile likelihood of σ holds it 94 to
96 times.

With the whitened rows √(1 − φ²)·w_0 and w_t − φ w_{t−1} of W = [X y] it is, up to a constant,
−2 ln L = (n − k) ln s² + RSS/s² + ln |X*ᵀX*| − ln(1 − φ²), and all products are polynomials of φ.

References: Cheang and Reinsel 2000, Bias reduction of autoregressive estimates in time series regression model through
restricted maximum likelihood.
"""

from __future__ import annotations

from typing import Annotated

import numpy as np
from scipy import optimize, special

from cirl_marl.errors import CirlError
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.rowsum import Floats

RISE = float(special.chdtri(1, 0.05))
"""By how much −2 ln L is larger at the ends of a 95 % interval than at its best, the other number at its best there."""
LARGEST = 3.0
"""Largest artanh φ in size, φ = 0.995: beyond it a series does not tell reversion from a random walk."""
WIDE = 10.0
"""Logarithm of a ratio of deviations beyond what any series leaves open."""
STEP = 1e-3
"""Step of the second differences of the likelihood."""


@positional_record
class Autoregression:
    """What was estimated, with standard errors from the curvature of the likelihood."""

    persistence: Annotated[float, "φ"]
    deviation: Annotated[float, "σ"]
    persistence_error: Annotated[float, "standard error of φ"]
    deviation_error: Annotated[float, "standard error of σ"]
    deviation_interval: Annotated[tuple[float, float], "σ that 95 % of series are as near to: −2 ln L rises by 3.84"]
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

    grid = np.linspace(-LARGEST, LARGEST, 121)
    normals, residuals = zip(*(_projection(products, np.tanh(z)) for z in grid), strict=True)
    constant = np.linalg.slogdet(np.array(normals))[1] + 2 * np.log(np.cosh(grid))  # what s does not change
    nearest = int(np.argmin(degrees * np.log(residuals) + constant))
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

    def beyond(log_deviation: float) -> float:
        """Return by how much −2 ln L at the best φ exceeds what it is at the ends of the interval."""
        logs = log_deviation - np.log(np.cosh(grid))
        profile = 2 * degrees * logs + np.array(residuals) * np.exp(-2 * logs) + constant
        return float(profile.min()) - deviance(z, log_noise) - RISE

    low, high = (np.exp(optimize.brentq(beyond, np.log(sigma), np.log(sigma) + side * WIDE)) for side in (-1, 1))
    # ln σ = ln s + ln cosh z, the derivative of which by z is φ
    slope = np.array([phi, 1.0])
    coefficients = np.asarray(np.linalg.solve(normal, _at(products, phi)[:-1, -1]), dtype=float)
    return Autoregression(
        persistence=float(phi),
        deviation=float(sigma),
        persistence_error=float((1.0 - phi**2) * np.sqrt(covariance[0, 0])),
        deviation_error=float(sigma * np.sqrt(slope @ covariance @ slope)),
        deviation_interval=(float(low), float(high)),
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
