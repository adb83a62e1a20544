"""The best plan found where nothing is proved: the cross-entropy method on the simulator itself.

All copies of one ``MultiAgentVectorEnv`` start from the same state; each tries one sequence of actions, that of a known
controller π plus deviations that are constant between knots,

    a(t) = clip(π(o(t)) + θ_k, −1, 1),    k = ⌊t·knots/steps⌋,

with θ drawn from independent Gaussians whose means and variances follow the best draws so far. The knots are doubled as
the search goes on: the best constants are found soon, and are a good start for what is finer. π is the best of the
candidates. It stays in the loop while the search goes on, so that what it balances by feedback does not fall over at
the first deviation; the plan is the sequence of actions that the best copy took, open loop. As θ = 0 is π itself, no
plan found is worse than a candidate.

References: Rubinstein 1999; Pinneri et al. 2020 (elites kept from one iteration to the next).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Constant, Controller, Neutral
from cirl_marl.controllers.rollout import EVALUATION_SEEDS
from cirl_marl.controllers.scripted import ScriptController
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.network import Floats, Integers, Network
from cirl_marl.network.declarations import frozen_record
from cirl_marl.network.uncertainty import expected_network
from cirl_marl.optimum.options import DEGREE, check_options, demanded_levels
from cirl_marl.optimum.planned_episodes import Episodes, Population, by_state_name, starting_states

SHORTFALL_PRICE = 10.0
"""What a service whose mean level is short of ``min_service`` by 1 costs, against λ̄/circularity_scale. The penalty is
exact where more of it costs less than that; a steeper one lets the draws hug the demanded level and stall there."""
KNOTS = 16
"""Stretches of an episode with deviations of their own, unless another number is asked for."""
SearchReport = Callable[[float, Floats], None]
"""Takes the share of all episodes that is simulated and the best objective from each start so far, shape (starts,)."""
ELITE_SHARE = 0.125
"""Share of a population that makes up the elite."""
MEAN_STEP = 0.6
"""Weight of the elite's mean and variance against those of the iteration before."""
SPREAD = 0.5
"""First standard deviation, in normalised actions."""
SPREAD_DECAY = 0.7
"""Standard deviation at the beginning of a refinement against that of the one before."""


@frozen_record
class Incumbent:
    """The best plan found from one start, without certificate: nothing says how much better another could be."""

    network: Annotated[Network, "the network, under the scenario and horizon that the plan is for"]
    agents: Annotated[tuple[str, ...], "who acts; the others are neutral"]
    initial: Annotated[Floats, "stocks and inner states at the start, the first of ``state_names``, shape (rows,)"]
    actions: Annotated[Floats, "normalised actions, shape (steps, entries)"]
    circularity: Annotated[float, "λ̄ that the plan achieves in the simulator, mass"]
    service: Annotated[float, "mean service level that it achieves"]
    levels: Annotated[Floats, "mean level of each service, shape (services,)"]
    candidates: Annotated[
        Mapping[str, tuple[float, float]], "λ̄ and mean service level of each controller to begin with"
    ]
    origin: Annotated[str, "the candidate that it began with"]
    evaluations: Annotated[int, "episodes simulated from this start, those of the candidates included"]

    def __str__(self) -> str:
        """Say what the plan achieves, and that nothing is proved about others."""
        return (
            f"λ̄ {self.circularity:.6g} {self.network.mass_unit}, service {self.service:.4f}:"
            f" best plan found in {self.evaluations:,} episodes, no certificate"
        )


def search(
    network: str | Path | Network,
    initial: Mapping[str, float] | ArrayLike | None = None,
    *,
    service_weight: float | None = None,
    min_service: ArrayLike | None = None,
    agents: Sequence[str] | None = None,
    scenario: str | None = None,
    horizon: int | None = None,
    candidates: Mapping[str, Controller] | None = None,
    knots: int | None = None,
    population: int = 64,
    iterations: int = 30,
    seed: int = 0,
    progress: SearchReport = lambda share, objective: None,
) -> Incumbent:
    """Look for the actions that do best over one episode, for any network; nothing is proved about the result.

    Of a network that is disturbed they are those that do best where everything is as it is expected to be.

    The objective of an episode is λ̄/circularity_scale; with ``service_weight`` w, λ̄/circularity_scale + w·(mean service
    level); with ``min_service`` s, λ̄/circularity_scale − SHORTFALL_PRICE·Σ max(0, s − mean level), over the services: a
    plan may miss s if no better one was found, and its ``levels`` tell.

    Args:
        network: catalogue name, path of a definition file, or a network.
        initial: node → stock and ``compartment.state`` → inner state, the rest as in the first episode of evaluations;
            or all of them, shape (rows,). None: the first episode of evaluations, ``rollout``'s.
        service_weight: w ≥ 0; excludes ``min_service``.
        min_service: s in [0, 1], for every service, or one for each, shape (services,).
        agents: who acts; None is the network's own choice.
        scenario: scenario of the definition; None is the default.
        horizon: decisions per episode; None takes the definition's.
        candidates: name → controller; None takes ``standard_candidates``.
        knots: stretches of the episode in which deviations are constant, at most one for each decision; the search
            begins with a single one and ends with these. None: KNOTS, or where there are fewer decisions one for each.
        population: plans tried in an iteration.
        iterations: of the method; 0 takes the best candidate.
        seed: of the draws; the same seed finds the same plan.
        progress: called after each interval of the episodes that are simulated side by side.

    Raises:
        CirlError: for input that cannot be used.
    """
    env = MultiAgentVectorEnv(network, num_envs=1, agents=agents, scenario=scenario, horizon=horizon)
    initial_state: Mapping[str, ArrayLike] = {}
    if isinstance(initial, Mapping):
        initial_state = initial
    elif initial is not None:
        initial_state = by_state_name(env, np.asarray(initial, dtype=float)[None])
    env.reset(seed=EVALUATION_SEEDS, options={"initial_state": initial_state})
    options: dict[str, Any] = {"service_weight": service_weight, "min_service": min_service, "agents": agents}
    options |= {"candidates": candidates, "knots": knots, "population": population, "iterations": iterations}
    return search_each(env.network, starting_states(env), **options, seed=seed, progress=progress)[0]


def search_each(
    network: Network,
    initial: Floats,
    *,
    service_weight: float | None = None,
    min_service: ArrayLike | None = None,
    agents: Sequence[str] | None = None,
    candidates: Mapping[str, Controller] | None = None,
    knots: int | None = None,
    population: int = 64,
    iterations: int = 30,
    seed: int = 0,
    progress: SearchReport = lambda share, objective: None,
) -> list[Incumbent]:
    """Look for the best actions from several starts at once, which costs less than one after the other.

    All starts share the draws, so each plan is the one that ``search`` finds from that start alone. Arguments and
    errors are those of ``search``, but for ``network``, under its scenario and horizon, and ``initial``, stocks and
    inner states, the first of ``MultiAgentVectorEnv.state_names``, shape (starts, rows).
    """
    check_options(service_weight, min_service, DEGREE)
    knots = min(KNOTS, network.episode.horizon) if knots is None else knots
    for name, value, least in (("population", population, 8), ("iterations", iterations, 0), ("knots", knots, 1)):
        whole_number(name, value, least)
    if knots > network.episode.horizon:
        raise CirlError(f"knots: {knots} are more than the {network.episode.horizon} decisions of an episode")
    network = expected_network(network)
    demand = np.zeros(0) if min_service is None else demanded_levels(network, min_service)
    starts = np.asarray(initial, dtype=float)
    env = MultiAgentVectorEnv(network, num_envs=1, agents=agents)
    options = standard_candidates(env.agents) if candidates is None else dict(candidates)
    if not options:
        raise CirlError("candidates: give at least one controller to begin with")
    first, best, origin = explore(
        lambda size: Population(network, agents, starts, size),
        [*options.values()],
        lambda episodes: objective_of(network, episodes, service_weight, demand),
        knots=knots,
        population=population,
        iterations=iterations,
        seed=seed,
        progress=progress,
    )
    evaluations = len(options) + population * iterations
    return [
        Incumbent(
            network=network,
            agents=env.agents,
            initial=starts[i].copy(),
            actions=best.actions[i],
            circularity=float(best.circularity[i]),
            service=float(best.service[i]),
            levels=best.levels[i],
            candidates={
                name: (float(first.circularity[i, c]), float(first.service[i, c])) for c, name in enumerate(options)
            },
            origin=list(options)[origin[i]],
            evaluations=evaluations,
        )
        for i in range(len(starts))
    ]


def objective_of(
    network: Network,
    episodes: Episodes,
    service_weight: float | None,
    demand: Floats,
    price: float = SHORTFALL_PRICE,
) -> Floats:
    """Return the objective of episodes, shape (starts, copies); see ``search``.

    ``demand`` is the level demanded of each service, shape (services,), or empty, and ``price`` that of what lacks.
    """
    value: Floats = episodes.circularity / network.objective.circularity_scale
    if service_weight is not None:
        value = value + service_weight * episodes.service
    if len(demand):
        lack = np.maximum(0.0, demand[:, None, None] - episodes.levels)
        value = value - price * lack.sum(axis=0)
    return value


def explore(
    populate: Callable[[int], Population],
    controllers: Sequence[Controller],
    objective: Callable[[Episodes], Floats],
    *,
    knots: int,
    population: int,
    iterations: int,
    seed: int,
    progress: SearchReport = lambda share, objective: None,
) -> tuple[Episodes, Best, Integers]:
    """Look for the best deviations from the actions of some controllers, with the cross-entropy method.

    Args:
        populate: makes so many copies of every start.
        controllers: to begin with.
        objective: of episodes, shape (starts, copies).
        knots: see ``search``.
        population: likewise.
        iterations: likewise.
        seed: likewise.
        progress: likewise.

    Returns:
        The episodes of the controllers, the best of all from each start, and with which of the controllers it began,
        shape (starts,).
    """
    evaluations = len(controllers) + population * iterations
    copies, entrants = populate(population), populate(len(controllers))
    starts = entrants.starts
    highest, episodes_done = np.full(starts, -np.inf), 0

    def report(episodes: int) -> Callable[[float], None]:
        return lambda share: progress((episodes_done + episodes * share) / evaluations, highest)

    choices = np.tile(np.arange(len(controllers)), (starts, 1))
    nothing = np.zeros((*choices.shape, 1, copies.entries))
    first = entrants.run(controllers, choices, nothing, report(len(controllers)))
    best = Best.among(first, objective(first))
    origin = best.copy
    gaussians = Gaussians(best.objective, population, copies.entries, seed)
    episodes_done, highest = len(controllers), best.objective
    for count in knot_counts(knots, iterations):
        gaussians.refine(count)
        choices = np.repeat(origin[:, None], population, axis=1)
        trial = copies.run(controllers, choices, gaussians.draw(), report(population))
        gaussians.learn(objective(trial), trial.deviation)
        best = best.or_better(Best.among(trial, objective(trial)))
        episodes_done, highest = episodes_done + population, best.objective
    progress(1.0, best.objective)
    return first, best, origin


def standard_candidates(agents: Sequence[str]) -> dict[str, Controller]:
    """Return neutral control, scripts (neutral for agents without one), and all agents at either end of their range."""
    ends = {"lowest": -1.0, "highest": 1.0}
    constants = {name: Constant(dict.fromkeys(agents, value)) for name, value in ends.items()}
    return {"neutral": Neutral(), "scripted": ScriptController(), **constants}


class Best(NamedTuple):
    """The best episode from each start: which of the copies it was, and what it was like, shape (starts, …)."""

    copy: Integers
    objective: Floats
    circularity: Floats
    service: Floats
    levels: Floats
    actions: Floats

    @classmethod
    def among(cls, episodes: Episodes, objective: Floats) -> Best:
        """Return the first of the best ``episodes``, of ``objective`` (starts, copies)."""
        copy, start = objective.argmax(axis=1), np.arange(len(objective))
        actions = np.stack([episodes.actions[:, :, i, c] for i, c in zip(start, copy, strict=True)])
        figures = episodes.circularity[start, copy], episodes.service[start, copy], episodes.levels[:, start, copy].T
        return cls(copy, objective[start, copy], *figures, actions)

    def or_better(self, rival: Best) -> Best:
        """Return the better of the two from each start, these if they are equal."""
        better = rival.objective > self.objective
        pairs = zip(rival, self, strict=True)
        return Best(*(np.where(better.reshape(-1, *[1] * (pair[0].ndim - 1)), *pair) for pair in pairs))


class Gaussians:
    """Deviations from each start, independent in every stretch of time and entry; first constants around 0."""

    def __init__(self, objective: Floats, population: int, entries: int, seed: int) -> None:
        """Begin with constants.

        Args:
            objective: of no deviation, shape (starts,).
            population: deviations drawn for each start.
            entries: of an action.
            seed: of the draws.
        """
        self._objective, self._elite = objective[:, None], np.zeros((len(objective), 1, 1, entries))
        self._mean, self._variance = self._elite[:, 0].copy(), np.full((len(objective), 1, entries), SPREAD**2)
        self._spread, self._population = SPREAD, population
        self._random = np.random.default_rng(seed)

    def refine(self, knots: int) -> None:
        """Cut each stretch into equal parts, ``knots`` in all, and draw around the best deviation so far again.

        Of the elite only that one stays: the others, all but equal by now, would take the variance away at once.
        """
        parts = knots // self._mean.shape[1]
        if parts == 1:
            return
        self._spread *= SPREAD_DECAY
        self._objective, self._elite = self._objective[:, :1], np.repeat(self._elite[:, :1], parts, axis=2)
        self._mean = self._elite[:, 0].copy()
        self._variance = np.full(self._mean.shape, self._spread**2)

    def draw(self) -> Floats:
        """Draw deviations, from the same normal numbers for each start, shape (starts, population, knots, entries)."""
        normal = self._random.standard_normal((self._population, *self._mean.shape[1:]))
        deviation: Floats = self._mean[:, None] + np.sqrt(self._variance)[:, None] * normal
        return deviation

    def learn(self, objective: Floats, deviation: Floats) -> None:
        """Move the Gaussians towards the best deviations so far; those of earlier iterations compete.

        Args:
            objective: shape (starts, population).
            deviation: as it came through the bounds of the actions, shape (starts, population, knots, entries).
        """
        objective = np.concatenate([self._objective, objective], axis=1)
        deviation = np.concatenate([self._elite, deviation], axis=1)
        order = np.argsort(-objective, axis=1, kind="stable")[:, : round(self._population * ELITE_SHARE)]
        self._objective = np.take_along_axis(objective, order, axis=1)
        self._elite = np.take_along_axis(deviation, order[:, :, None, None], axis=1)
        self._mean += MEAN_STEP * (self._elite.mean(axis=1) - self._mean)
        self._variance += MEAN_STEP * (self._elite.var(axis=1) - self._variance)


def knot_counts(knots: int, iterations: int) -> list[int]:
    """Return the number of knots in each iteration: 1, then ``knots`` halved as often as it can be, up to ``knots``.

    >>> knot_counts(12, 8)
    [1, 1, 3, 3, 6, 6, 12, 12]
    """
    counts = [knots]
    while counts[0] % 2 == 0:
        counts.insert(0, counts[0] // 2)
    if counts[0] > 1:
        counts.insert(0, 1)
    return [counts[i * len(counts) // iterations] for i in range(iterations)]
