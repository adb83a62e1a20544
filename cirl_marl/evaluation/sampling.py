"""What uncertain numbers do to an episode: many draws of them, bands of what comes of it, and which number matters."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from cirl_marl.controllers.rollout import beginning, rollout
from cirl_marl.environments.vector import VectorEnv
from cirl_marl.errors import CirlError
from cirl_marl.network import Floats, Network
from cirl_marl.network.declared import itemised
from cirl_marl.network.uncertainty import drawn
from cirl_marl.optimum.named import named_controller

FEWEST = 70
"""SampledEpisodes from which on shares of the spread are told."""
RESAMPLES = 200
"""Bootstrap resamples of their intervals."""


@itemised
@dataclass(frozen=True, slots=True)
class SampledEpisodes:
    """Episodes of networks whose uncertain numbers were drawn; everything else is the same."""

    network: Annotated[Network, "the network, its numbers as they are stated"]
    names: Annotated[tuple[str, ...], "paths of the uncertain numbers"]
    factors: Annotated[Floats, "what was drawn, relative to what is stated, shape (samples, numbers)"]
    shares: Annotated[Floats, "share of all draws below each, shape (samples, numbers)"]
    circularity: Annotated[Floats, "mean of λ over each interval, shape (samples, steps), mass"]
    levels: Annotated[Floats, "level of each service, shape (samples, services, steps)"]
    stock: Annotated[Floats, "stocks after each interval, shape (samples, steps, stores), mass"]
    flow: Annotated[Floats, "mean flows of each interval, shape (samples, steps, arcs), mass/time"]


@itemised
@dataclass(frozen=True, slots=True)
class Sensitivity:
    """How much of the spread of a figure each uncertain number causes by itself: first-order Sobol indices."""

    figure: Annotated[str, "what spreads"]
    shares: Annotated[Floats, "share of the variance, shape (numbers,); NaN if nothing spreads"]
    margins: Annotated[Floats, "half-widths of their 95 % intervals, shape (numbers,)"]


def sampled(
    network: Network,
    *,
    samples: int,
    control: str = "neutral",
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> SampledEpisodes:
    """Simulate draws of the uncertain numbers, each in an episode from the middle of all initial ranges.

    Sample i draws from ``[seed, i]``, so that more samples add to those before, and the numbers of a network without
    one of them stay what they were.

    Args:
        network: with uncertain numbers.
        samples: how many, at least 2.
        control: controller of all agents, started anew in each episode.
        seed: of the draws.
        progress: called with the share that is done.

    Raises:
        CirlError: if nothing is uncertain, or there are too few samples.
    """
    if not network.uncertain:
        remedy = "give a number a deviation or a range"
        raise CirlError(
            f"network '{network.name}': nothing is uncertain, so that all samples would be the same; {remedy}"
        )
    if samples < 2:
        raise CirlError(f"samples must be at least 2, got {samples}")
    names = tuple(network.uncertain)
    shares = np.array([np.random.default_rng([seed, i]).random(len(names)) for i in range(samples)])
    spreads = network.uncertain.values()
    factors = np.stack([spread.at(each) for spread, each in zip(spreads, shares.T, strict=True)], axis=1)
    runs = []
    for i, row in enumerate(shares.tolist()):
        env = VectorEnv(drawn(network, row), num_envs=1)
        begun = beginning(env)
        runs.append(rollout(env, named_controller(control), seed=begun.seed, start=begun.given))
        progress((i + 1) / samples)
    return SampledEpisodes(
        network,
        names,
        factors,
        shares,
        np.array([run.circularity_mean[0] for run in runs]),
        np.array([run.levels[0] for run in runs]),
        np.array([run.stock for run in runs]),
        np.array([run.flow for run in runs]),
    )


def sensitivities(found: SampledEpisodes) -> list[Sensitivity]:
    """Return what causes the spread of λ̄, and of the mean level of each service.

    The indices are estimated from the samples themselves, by RBD-FAST (Tarantola, Gatelli and Mara 2006) with the
    correction of Tissot and Prieur (2012), as SALib has them. They sum to less than 1 where numbers act together.

    Raises:
        CirlError: for fewer than 70 samples, from which nothing can be told.
    """
    from SALib.analyze import rbd_fast

    count = len(found.circularity)
    if count < FEWEST:
        raise CirlError(f"{count} samples are too few to tell which number matters; take {FEWEST} or more")
    problem = {"num_vars": len(found.names), "names": list(found.names), "bounds": [[0.0, 1.0]] * len(found.names)}
    figures = {"λ̄": found.circularity.mean(axis=1)}
    levels = found.levels.mean(axis=2)
    figures |= {f"level of {each.id}": levels[:, s] for s, each in enumerate(found.network.services)}
    told = []
    for name, values in figures.items():
        if np.ptp(values) <= 1e-12 * np.abs(values).max(initial=0.0):
            nothing = np.full(len(found.names), np.nan)
            told.append(Sensitivity(name, nothing, nothing))
            continue
        solved = rbd_fast.analyze(problem, found.shares, values, num_resamples=RESAMPLES, seed=0)
        told.append(Sensitivity(name, np.array(solved["S1"]), np.array(solved["S1_conf"])))
    return told
