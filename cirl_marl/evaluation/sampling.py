"""What uncertain numbers and disturbances do to an episode: many draws of them, bands, and which number matters."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Annotated, Any

import numpy as np

from cirl_marl.controllers.episode_quantities import episode_quantities
from cirl_marl.controllers.rollout import Rollout, episode_start, first_seed, rollout
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, optional_module
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum.registry import named_controller

FEWEST = 70
"""Samples from which on shares of the spread are told."""
RESAMPLES = 200
"""Bootstrap resamples of their intervals."""


@positional_record
class SampledEpisodes:
    """Episodes of networks whose uncertain numbers were drawn; everything else is the same."""

    network: Annotated[Network, "the network, its numbers as they are stated"]
    names: Annotated[tuple[str, ...], "paths of the uncertain numbers"]
    factors: Annotated[Floats, "what was drawn, relative to what is stated, shape (samples, numbers)"]
    rollout: Annotated[Rollout, "what came of them: copies are samples, and stocks and flows those of all, as well"]

    def figures(self) -> Iterator[tuple[str, str, Floats]]:
        """Yield λ̄, the mean level of each service and the total of each account: name, unit, shape (samples,)."""
        for quantity in episode_quantities(self.network, "circularity", "service", "account"):
            yield quantity.total_name, quantity.unit, quantity.totals(self.rollout)


@positional_record
class Sensitivity:
    """How much of the spread of a figure each uncertain number causes by itself: first-order Sobol indices."""

    figure: Annotated[str, "what spreads"]
    shares: Annotated[Floats, "share of the variance, shape (numbers,); NaN if nothing spreads"]
    margins: Annotated[Floats, "half-widths of their 95 % intervals, shape (numbers,)"]


def sample_episodes(
    network: Network,
    *,
    samples: int,
    control: str = "neutral",
    seed: int = 0,
    progress: Callable[[float], None] = lambda share: None,
) -> SampledEpisodes:
    """Simulate draws of uncertain numbers and disturbances, each in an episode from the middle of all initial ranges.

    The samples are copies of one environment, so that more of them add to those before. The controller knows the
    numbers as they are stated, not what was drawn.

    Args:
        network: with uncertain or disturbed numbers.
        samples: how many, at least 2.
        control: controller of all agents.
        seed: of the draws; different seeds share none.
        progress: called with the share that is done.

    Raises:
        CirlError: if nothing is uncertain, or there are too few samples.
    """
    if samples < 2:
        raise CirlError(f"samples must be at least 2, got {samples}")
    # without disturbances something has to be uncertain, or there is nothing to draw
    env = MultiAgentVectorEnv(network, num_envs=samples, uncertain=bool(network.uncertain) or not network.disturbed)
    horizon = network.episode.horizon
    stock = np.empty((samples, horizon, len(network.stores)))
    flow = np.empty((samples, horizon, len(network.arcs)))

    def keep(steps: int) -> None:
        stock[:, steps - 1] = env.rows.stocks(env.physical.stock).T
        flow[:, steps - 1] = env.physical.flow.T

    first, middle = first_seed(seed), episode_start(env).initial_state
    run = rollout(env, named_controller(control), seed=first, start=middle, progress=progress, watch=keep)
    factors = env.physical.factors.T.copy()
    return SampledEpisodes(network, tuple(network.uncertain), factors, replace(run, stock=stock, flow=flow))


def rbd_fast() -> Any:
    """Return ``SALib.analyze.rbd_fast``; a ``CirlError`` says what to install."""
    return optional_module("SALib.analyze.rbd_fast", "which uncertain number matters is told by SALib", "sensitivity")


def sensitivities(episodes: SampledEpisodes) -> list[Sensitivity]:
    """Return what causes the spread of λ̄, of the mean level of each service, and of the total of each account.

    The indices are estimated from the samples themselves, by RBD-FAST (Tarantola, Gatelli and Mara 2006) with the
    correction of Tissot and Prieur (2012), as SALib has them. They sum to less than 1 where numbers act together.

    Raises:
        CirlError: for fewer than 70 samples, from which nothing can be told, or if SALib is missing.
    """
    if not episodes.names:
        return []  # what changes all the time is no single number
    analysis = rbd_fast()
    count = len(episodes.factors)
    if count < FEWEST:
        raise CirlError(f"{count} samples are too few to tell which number matters; take {FEWEST} or more")
    # it takes the order of the draws alone
    numbers = len(episodes.names)
    problem = {"num_vars": numbers, "names": list(episodes.names), "bounds": [[0.0, 1.0]] * numbers}
    causes = []
    for name, _, values in episodes.figures():
        if np.ptp(values) <= 1e-12 * np.abs(values).max(initial=0.0):
            no_share = np.full(numbers, np.nan)
            causes.append(Sensitivity(name, no_share, no_share))
            continue
        indices = analysis.analyze(problem, episodes.factors, values, num_resamples=RESAMPLES, seed=0)
        causes.append(Sensitivity(name, np.array(indices["S1"]), np.array(indices["S1_conf"])))
    return causes
