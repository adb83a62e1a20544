"""Lifetimes as chains of stages: what stays for a time that is spread, written so that stocks stay linear.

K first-order stages of rate μ follow each other. Of what enters, the part w_n has n of them to go, Σ w = 1; w_0 leaves
at once. After a time t the share ::

    S(t) = Σ_n w_n Q(n, μt)

of it is still there, Q being the regularised upper incomplete gamma function (the survival function of Erlang's
distribution, 0 for n = 0). w is found by non-negative least squares, μ and K by search; the mean is the lifetime's.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import cache
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike
from scipy import special

from cirl_marl.network.declarations import positional_record
from cirl_marl.network.rowsum import Floats

CLOSE = 2e-3
"""Distance from the survival function at which a chain is long enough."""
LENGTHS = (1, 2, 3, 4, 6, 8, 10, 12, 16, 20, 25, 30, 40, 60, 80, 100)
"""Numbers of stages that are tried, one after the other."""
POINTS = 400
"""Ages at which survival is compared."""
FIRM = 1e3
"""Weight of the mean and of Σ w = 1 among the equations."""

Survival = Callable[[Floats], Floats]


def _folded_normal(deviation: float) -> Survival:
    def survival(age: Floats) -> Floats:
        x, mean = np.asarray(age) / deviation, 1 / deviation
        return np.where(x > 0, special.ndtr(-(x - mean)) + special.ndtr(-(x + mean)), 1.0)

    return survival


def _lognormal(deviation: float) -> Survival:
    spread = np.sqrt(np.log1p(deviation**2))

    def survival(age: Floats) -> Floats:
        x = np.asarray(age) / np.exp(-(spread**2) / 2)
        return np.where(x > 0, special.ndtr(-(np.log(np.where(x > 0, x, 1.0)) / spread)), 1.0)

    return survival


def _weibull(deviation: float) -> Survival:
    from scipy.optimize import brentq

    def variance(shape: float) -> float:
        return float(np.expm1(special.gammaln(1 + 2 / shape) - 2 * special.gammaln(1 + 1 / shape)))

    shape = brentq(lambda shape: variance(shape) - deviation**2, 0.1, 1e3)
    scale = 1 / special.gamma(1 + 1 / shape)
    return lambda age: np.exp(-np.power(np.asarray(age) / scale, shape))


SURVIVALS: Mapping[str, Callable[[float], Survival]] = {
    "normal": lambda deviation: lambda age: special.ndtr(-((np.asarray(age) - 1.0) / deviation)),
    "folded_normal": _folded_normal,
    "lognormal": _lognormal,
    "weibull": _weibull,
    "gamma": lambda deviation: lambda age: special.gammaincc(deviation**-2, np.asarray(age) / deviation**2),
    "exponential": lambda deviation: lambda age: np.exp(-age),
}
"""What is left of a lifetime with parameter ``mean`` 1 at an age, from its deviation.

Parameters of the folded normal distribution are those of the normal one before it is folded, as is usual in material
flow analysis; of a normal one what is below 0 leaves at once.
"""


@positional_record
class Chain:
    """The stages of a lifetime with parameter ``mean`` 1."""

    rate: Annotated[float, "μ"]
    weights: Annotated[tuple[float, ...], "w_0, w_1, …, w_K: parts of what enters, by the number of stages to go"]
    error: Annotated[float, "largest distance of its survival function from that of the lifetime"]

    @property
    def stages(self) -> int:
        """K."""
        return len(self.weights) - 1

    def survival(self, age: ArrayLike) -> Floats:
        """Return S at ages in units of ``mean``, in their shape."""
        ages = np.asarray(age, dtype=np.float64)
        share: Floats = _survival_terms(self.stages, self.rate, ages.ravel()) @ np.array(self.weights)
        return share.reshape(ages.shape)

    @property
    def inflow_shares(self) -> Floats:
        """Part of what enters that each stage gets, first the one with most to go, shape (K,)."""
        return np.array(self.weights[:0:-1])

    @property
    def matrix(self) -> Floats:
        """A of ẋ = A x + ``entering`` · u, u what enters; shape (K, K), first the stage with most to go."""
        return self.rate * (np.eye(self.stages, k=-1) - np.eye(self.stages))

    def growing_stock(self, growth: float) -> Floats:
        """Return the stages, shape (K,), of a stock into which u = e^(growth·t) has always flowed, at t = 0.

        With ẋ = growth·x, (growth·I − A) x = ``entering``; growth, in 1/``mean``, lies above −μ.
        """
        stages = np.linalg.solve(growth * np.eye(self.stages) - self.matrix, self.inflow_shares)
        return np.asarray(np.maximum(stages, 0.0))  # where nothing enters, pivots leave round-off of either sign


def _survival_terms(stages: int, rate: float, ages: Floats) -> Floats:
    """Return Q(n, rate·age) for n = 0 … stages, shape (ages, stages + 1)."""
    terms = np.zeros((len(ages), stages + 1))
    terms[:, 1:] = special.gammaincc(np.arange(1, stages + 1), rate * ages[:, None])
    return terms


@cache
def chain_of(distribution: str, deviation: float) -> Chain:
    """Return the shortest chain that is close to a lifetime with mean 1, or of those tried the closest.

    Args:
        distribution: one of ``SURVIVALS``.
        deviation: standard deviation in units of ``mean``.
    """
    if distribution == "exponential":
        return Chain(1.0, (0.0, 1.0), 0.0)
    from scipy.integrate import quad  # takes longer to import than most commands run

    survival = SURVIVALS[distribution](deviation)
    ages = np.linspace(0.0, 1.0 + 8.0 * deviation, POINTS)
    target, mean = survival(ages), float(quad(survival, 0.0, 1.0 + 40.0 * deviation, limit=500)[0])
    best = _fit_chain(LENGTHS[0], 1.0, ages, target, mean)
    for stages in LENGTHS:
        best = min(best, _closest_chain(stages, ages, target, mean), key=lambda chain: chain.error)
        if best.error <= CLOSE:
            break
    return best


def _closest_chain(stages: int, ages: Floats, target: Floats, mean: float) -> Chain:
    rates, chains = np.geomspace(0.2, 1.0, 12) * stages / mean, []
    for _ in range(2):  # then once more, finer, around the best
        chains += [_fit_chain(stages, float(rate), ages, target, mean) for rate in rates]
        best = min(chains, key=lambda chain: chain.error)
        rates = np.clip(best.rate * np.geomspace(0.89, 1.12, 9), 0.0, stages / mean)
    return min(chains, key=lambda chain: chain.error)


def _fit_chain(stages: int, rate: float, ages: Floats, target: Floats, mean: float) -> Chain:
    """Return the chain of some stages and rate that is closest and has a mean."""
    from scipy.optimize import nnls

    terms, to_go = _survival_terms(stages, rate, ages), np.arange(stages + 1)
    # nothing leaves at once unless the lifetime says so
    free = to_go >= (0 if target[0] < 1 else 1)
    firm = FIRM * np.stack([np.ones(stages + 1), to_go / rate])[:, free]
    solution, _ = nnls(np.concatenate([terms[:, free], firm]), np.concatenate([target, [FIRM, FIRM * mean]]))
    weights = np.zeros(stages + 1)
    weights[free] = solution / solution.sum()
    rate = float(weights @ to_go) / mean
    error = float(np.abs(_survival_terms(stages, rate, ages) @ weights - target).max())
    return Chain(rate, tuple(weights.tolist()), error)
