"""What the reported flows of steel say of stocks, lifetimes and collection, with its uncertainty; ``docs/data.md``.

Two numbers of a country are not reported: how much went into use before 2000, and how long it lasts. What was made
since 1900 says the first up to a factor e^a, ODYM's lifetimes the second up to a factor e^b. Together they give
discards, and discards the rate of collection c at which the old scrap that is reported today comes back. The posterior
of (a, b) is computed on a grid, so that it has no error of sampling::

    p(a, b) ∝ N(a; 0, 0.3²) · N(b; 0, 0.1²) · t₃((c − 0.8)/0.12) · (0.05² + Σ_t ((c·D_t − O_t)/Ō)²/n)^(−n/6)

with discards D, old scrap O, and its mean Ō over the n years that count. The last factor leaves open how well old scrap
is known, which differs much from country to country, as it closes the balance of the table. Errors of a year have a
correlation of one half with those of the next, so that n years tell as much as n/3. The prior of c is that of published
recycling at the end of life.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Final

import numpy as np
from scipy.stats import norm, qmc, t

from cirl_marl.network import Floats

LEVEL, STRETCH = 0.3, 0.1
"""Standard deviations of the logarithms of what went into use before 2000, and of lifetimes."""
COLLECTED, WITHIN = 0.8, 0.12
"""Published rates of recycling at the end of life, 0.7 to 0.9 (Pauliuk et al. 2013; UNEP 2011), and their spread."""
FLOOR = 0.05
"""Relative error of old scrap that is always granted."""
MOST = 0.98
"""Largest rate of collection that is believed."""
POINTS: Final = 61
"""Of the grid, a dimension."""
RELATIVE_DEVIATION = 0.3
"""Standard deviation of lifetimes over products, of the mean."""


@dataclass(frozen=True, slots=True)
class Posterior:
    """What is known of one country, on a grid of levels and stretches."""

    levels: Annotated[Floats, "factors on what went into use before the first reported year, shape (points,)"]
    stretches: Annotated[Floats, "factors on lifetimes, shape (points,)"]
    weights: Annotated[Floats, "probabilities, shape (points, points)"]
    collection: Annotated[Floats, "rate that gives the old scrap of today, likewise"]
    discards: Annotated[Floats, "kt/a, shape (points, points, years)"]
    stock: Annotated[Floats, "at the end of the last year, kt, shape (points, points)"]

    def mean(self, values: Floats) -> Floats:
        """Return the expectation of values on the grid."""
        found: Floats = np.tensordot(self.weights, values, axes=2)
        return found

    @property
    def mode(self) -> tuple[float, float]:
        """The most likely level and stretch."""
        row, column = np.unravel_index(np.argmax(self.weights), self.weights.shape)
        return float(self.levels[row]), float(self.stretches[column])

    def range(self, values: Floats, part: float = 0.9) -> tuple[float, float]:
        """Return the interval with equal tails in which values on the grid lie with a probability of ``part``."""
        order = np.argsort(values, axis=None)
        passed = np.cumsum(self.weights.ravel()[order])
        ends = np.searchsorted(passed, [(1 - part) / 2, (1 + part) / 2])
        low, high = values.ravel()[order][np.minimum(ends, len(order) - 1)].tolist()
        return low, high

    def draws(self, count: int, seed: int = 0) -> list[tuple[float, float]]:
        """Return levels and stretches drawn from it, evenly spread (Sobol points through the inverse distribution)."""
        points = qmc.Sobol(2, seed=seed).random(count)
        marginal = np.cumsum(self.weights.sum(axis=1))
        found = []
        for first, second in points.tolist():
            row = int(np.searchsorted(marginal, first * marginal[-1]))
            conditional = np.cumsum(self.weights[row])
            column = int(np.searchsorted(conditional, second * conditional[-1]))
            found.append((float(self.levels[row]), float(self.stretches[column])))
        return found


def survival(years: int, sectors: Mapping[str, tuple[float, float]], stretch: float) -> Floats:
    """Return what is left at the end of a year, and of those after it, of what goes in evenly over the year.

    Args:
        years: how many.
        sectors: share and mean lifetime in years of each sector.
        stretch: factor on lifetimes.
    """
    ages = np.arange(years)[:, None] + (np.arange(20) + 0.5) / 20
    parts = [
        share * norm.sf(ages, stretch * mean, RELATIVE_DEVIATION * stretch * mean).mean(axis=1)
        for share, mean in sectors.values()
    ]
    found: Floats = np.sum(parts, axis=0)
    return found


def cohorts(inflow: Floats, sectors: Mapping[str, tuple[float, float]], stretch: float) -> tuple[Floats, Floats]:
    """Return discards of each year and the stock at its end, of what goes in, kt/a, shape (years,); nothing before."""
    stock = np.convolve(inflow, survival(len(inflow), sectors, stretch))[: len(inflow)]
    return inflow - np.diff(stock, prepend=0.0), stock


def inflow_of(
    growth: Floats, inflow: Floats, sectors: Mapping[str, tuple[float, float]], stretch: float
) -> Annotated[Floats, "kt/a, shape (years,)"]:
    """Return what has to go in so that the stock is so many times what it was at the end of what went in before."""
    left = survival(len(inflow) + len(growth), sectors, stretch)
    first = len(inflow)
    stock = growth * cohorts(inflow, sectors, stretch)[1][-1]
    for year, wanted in enumerate(stock.tolist(), first):
        kept = float(left[year:0:-1] @ inflow[:year])
        inflow = np.append(inflow, max(0.0, wanted - kept) / left[0])
    return inflow[first:]


def calibrate(
    earlier_use: Floats,
    into_use: Floats,
    old_scrap: Floats,
    sectors: Mapping[str, tuple[float, float]],
    years: slice,
    recent: slice,
) -> Posterior:
    """Return what old scrap of some years says of the level of history and of lifetimes.

    Args:
        earlier_use: what went into use before the first reported year, up to a factor, kt/a, shape (earlier years,).
        into_use: reported, kt/a, shape (years,).
        old_scrap: likewise.
        sectors: share and mean lifetime in years of each sector.
        years: reported years whose old scrap counts.
        recent: reported years whose mean of old scrap sets the rate of collection.
    """
    a, b = np.linspace(-3 * LEVEL, 3 * LEVEL, POINTS), np.linspace(-3 * STRETCH, 3 * STRETCH, POINTS)
    first = len(earlier_use)
    parts = [
        [cohorts(series, sectors, stretch) for stretch in np.exp(b).tolist()]
        for series in (np.pad(earlier_use, (0, len(into_use))), np.pad(into_use, (first, 0)))
    ]
    (old, old_stock), (new, new_stock) = (
        (np.array([d[first:] for d, _ in part]), np.array([s[-1] for _, s in part])) for part in parts
    )
    discards = np.exp(a)[:, None, None] * old + new
    collection = old_scrap[recent].mean() / discards[..., recent].mean(axis=-1)
    mean, count = old_scrap[years].mean(), len(range(*years.indices(len(into_use))))
    off = (collection[..., None] * discards[..., years] - old_scrap[years]) / mean if mean > 0 else 0 * discards
    error = FLOOR**2 + (off**2).mean(axis=-1)
    logarithm = norm.logpdf(a, 0, LEVEL)[:, None] + norm.logpdf(b, 0, STRETCH) - count / 6 * np.log(error)
    logarithm = logarithm + t.logpdf(collection, 3, COLLECTED, WITHIN)
    logarithm = np.where(collection < MOST, logarithm, -np.inf)
    if not np.isfinite(logarithm).any():
        raise ValueError(f"old scrap is {collection.min():.2f} of all discards, whatever the history: check the flows")
    weights = np.exp(logarithm - logarithm.max())
    return Posterior(
        np.exp(a),
        np.exp(b),
        weights / weights.sum(),
        collection,
        discards,
        np.exp(a)[:, None] * old_stock + new_stock,
    )
