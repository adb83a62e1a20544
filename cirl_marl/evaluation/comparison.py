"""Comparison of trained policies and controllers on the same fresh episodes."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from cirl_marl.controllers.basic import Controller
from cirl_marl.controllers.rollout import Rollout, first_seed, rollout, starting_stocks
from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, whole_number
from cirl_marl.evaluation.baselines import Baseline, bounds_of_draws, solve_baseline
from cirl_marl.evaluation.calibration import CLOSE, Calibration, calibrate, check_tuning
from cirl_marl.evaluation.contenders import Contender, contenders, differences
from cirl_marl.evaluation.episode_count import MOST_EPISODES, concatenation, enough_episodes, ties
from cirl_marl.evaluation.figures import gain
from cirl_marl.evaluation.statistics import ENOUGH_SEEDS, SHARE, Aggregate, over_episodes, over_seeds, worst_mean
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.network.elements import CIRCULARITY
from cirl_marl.optimum import NoCertificate, gap
from cirl_marl.optimum.aims import NO_AIMS, Aims, aims_of
from cirl_marl.optimum.options import demanded_levels, levels_text
from cirl_marl.optimum.registry import TUNABLE
from cirl_marl.optimum.uncertain_bound import UncertainBound

FIGURES = ("circularity", "gain", "service", "bound", "gap")
EVERYWHERE = (-np.inf, np.inf)
DRAW_GAPS = ("expected_gap", "foresight_gap")
LIMITS = {"service": SHARE, "gap": (0.0, np.inf)}
"""Within which figures lie: the bound is proved, so that no gap is below 0."""
TUNING_SHARE = 0.5
"""Share of setting margins in the work of a comparison that does so."""
SOLVER_SHARE = 0.7
"""Share of solving programs in the work on bounds; the rest is to evaluate their multipliers for every episode."""
ProgressReport = Callable[[str, float], None]
"""Takes what is being done and the share of all that is done."""


@positional_record
class Entry:
    """The episodes of one policy or controller; ``seed``, ``run`` and ``checkpoint`` are of its training, if any."""

    name: str
    seed: int | None
    run: RunDirectory | None
    checkpoint: str
    rollout: Rollout
    gain: Annotated[Floats, "circularity gain over neutral control from the same start, shape (episodes,)"]
    bound: Annotated[
        Floats | None,
        "what no λ̄ of an episode from the same start with at least the same mean level of each service exceeds, "
        "shape (episodes,), mass; None if nothing is proved",
    ]
    uncertain_bound: Annotated[
        UncertainBound | None, "the bound for who does not foresee, on draws that are the episodes"
    ] = None
    calibration: Annotated[Calibration | None, "the margin on what it aims at, if it was tuned"] = None

    @property
    def circularity(self) -> Floats:
        """λ̄ of each episode, shape (episodes,), mass."""
        return self.rollout.episode_circularity

    @property
    def service(self) -> Floats:
        """Mean of the services' levels in each episode, shape (episodes,)."""
        return self.rollout.episode_service

    @property
    def milliseconds(self) -> float:
        """Processor time of a decision in one copy, what was planned before the episode included, ms."""
        return 1e3 * self.rollout.control_seconds / self.rollout.circularity.size

    @property
    def gap(self) -> Floats | None:
        """(bound − λ̄)/|bound| of each episode, shape (episodes,); NaN where the bound is 0."""
        return None if self.bound is None else gap(self.bound, self.circularity)

    @property
    def expected_gap(self) -> Floats | None:
        """(bound for who does not foresee − λ̄ − Σ_s μ_s (level_s − demand_s))/scale, shape (episodes,)."""
        return self._expected_gap(with_foresight=False)

    @property
    def foresight_gap(self) -> Floats | None:
        """The same, held against who knows the future of each episode."""
        return self._expected_gap(with_foresight=True)

    def _expected_gap(self, *, with_foresight: bool) -> Floats | None:
        bound, run = self.uncertain_bound, self.rollout
        if bound is None:
            return None
        bookings = bound.aims.bookings(run)
        return bound.gaps(run.episode_circularity, run.episode_levels, bookings, with_foresight=with_foresight)


@dataclass(frozen=True, slots=True)
class Row:
    """A recipe with an entry for each training seed, or a controller."""

    name: str
    entries: tuple[Entry, ...]

    @property
    def seeds(self) -> tuple[int, ...]:
        """Training seeds; empty if nothing was trained."""
        return tuple(entry.seed for entry in self.entries if entry.seed is not None)

    @property
    def has_few_seeds(self) -> bool:
        """Whether there are fewer training seeds than an interval over them should rest on."""
        return 0 < len(self.seeds) < ENOUGH_SEEDS

    def figure(self, name: str) -> Aggregate | None:
        """Return one of FIGURES, or a gap of DRAW_GAPS: over seeds the IQM of means over episodes, else their mean."""
        samples = [getattr(entry, name) for entry in self.entries]
        if any(sample is None for sample in samples):
            return None
        if not self.seeds:
            return over_episodes(samples[0], LIMITS.get(name, EVERYWHERE))
        return over_seeds([sample.mean() for sample in samples])

    def levels(self) -> list[Aggregate]:
        """Return the mean level of each service: over several seeds the IQM, else over the episodes."""
        rows = np.moveaxis(np.array([entry.rollout.episode_levels for entry in self.entries]), 2, 0)
        return [over_seeds(row.mean(axis=1)) if len(row) > 1 else over_episodes(row[0], SHARE) for row in rows]

    def accounts(self) -> list[Aggregate]:
        """Return the total of each account, likewise."""
        rows = np.moveaxis(np.array([entry.rollout.accounts for entry in self.entries]), 2, 0)
        return [over_seeds(row.mean(axis=1)) if len(row) > 1 else over_episodes(row[0]) for row in rows]

    def worst(self) -> list[Aggregate]:
        """Return the mean of the 5 % worst episodes of λ̄, then of the level of each service, likewise."""
        figures = [np.column_stack([entry.circularity, entry.rollout.episode_levels]) for entry in self.entries]
        tails = [[worst_mean(column) for column in of_entry.T] for of_entry in figures]
        return [over_seeds([t.value for t in row]) if len(row) > 1 else row[0] for row in zip(*tails, strict=True)]


@dataclass(frozen=True, slots=True)
class Comparison:
    """What every policy and controller did in the same episodes; episode i starts from seed ``first_seed + i``.

    The network is under its scenario and horizon, and ``baseline`` has the bounds that the entries are held against.
    ``ties`` names the pairs that the episodes do not tell apart, if their number was left to what they say, and
    ``demand`` is the mean level demanded of each service, if one is.
    """

    network: Network
    agents: tuple[str, ...]
    first_seed: int
    entries: tuple[Entry, ...]
    baseline: Baseline
    ties: tuple[str, ...] | None = None
    demand: Floats | None = None

    @property
    def episodes(self) -> int:
        """Episodes of each entry."""
        return len(self.entries[0].circularity)

    @property
    def figures(self) -> tuple[str, ...]:
        """What tables have of each row: FIGURES, with a bound for who does not foresee its gaps in place of others."""
        return FIGURES if self.entries[0].uncertain_bound is None else (*FIGURES[:3], *DRAW_GAPS)

    def misses(self) -> dict[str, float]:
        """Return the rows whose margin was set and that do not deliver what is demanded, within ``calibration.CLOSE``.

        With the least of the expected levels less what is demanded.
        """
        if self.demand is None:
            return {}
        tuned_rows = [row for row in self.rows if row.entries[0].calibration is not None]
        excess = {
            row.name: min(f.value - d for f, d in zip(row.levels(), self.demand, strict=True)) for row in tuned_rows
        }
        return {name: value for name, value in excess.items() if abs(value) > CLOSE}

    @property
    def rows(self) -> tuple[Row, ...]:
        """Entries by name: seeds of one recipe together."""
        groups: dict[str, list[Entry]] = {}
        for entry in self.entries:
            groups.setdefault(entry.name, []).append(entry)
        return tuple(Row(name, tuple(entries)) for name, entries in groups.items())


def compare(
    runs: Sequence[str | Path | RunDirectory] = (),
    controllers: Sequence[str] = ("neutral", "random"),
    *,
    network: str | Path | Network | None = None,
    scenario: str | None = None,
    episodes: int | None = None,
    seed: int = 0,
    min_service: ArrayLike | None = None,
    at_most: Mapping[str, float] | None = None,
    bounds: bool = True,
    uncertain: bool | None = None,
    uncertain_bound: UncertainBound | None = None,
    tune: int | None = None,
    futures: int | None = None,
    progress: ProgressReport = lambda stage, share: None,
) -> Comparison:
    """Let trained policies and controllers act in the same fresh episodes.

    Everyone meets the same start states and random streams, whose seeds no training draws. Neutral control, to which
    gains refer, is always there.

    Args:
        runs: training runs of one environment.
        controllers: names of controllers, see ``optimum.registry``.
        network: catalogue name, definition file or network; None is that of the first run.
        scenario: of ``network``; None is the default.
        episodes: at least 2; None: 64, or of a network that is disturbed 256, and twice and four times as many while
            the interval of a difference between two rows is wider than that (``episode_count.ties``).
        seed: different seeds share no episode.
        min_service: mean level of every service, or of each, shape (services,), that ``registry.PLANNERS`` plan for;
            None: what ``uncertain_bound`` is for, or else as much as can be had.
        at_most: budgets that those of ``registry.WITH_AIMS`` keep; see ``bound``.
        bounds: whether to hold the episodes against the best possible.
        uncertain: whether each episode draws the uncertain numbers of the network, the same for everyone; each is then
            held against the best possible with the numbers that it drew. None: as in the draws of
            ``uncertain_bound``, or else if it was so in the training.
        uncertain_bound: ``bound(…, uncertain=True)`` of the same network, whatever is observed there, at the same
            service, to which entries have a gap as well: its draws are the episodes, whose number and seed it sets.
            ``price_policy`` acts by its prices.
        tune: draws of its own on which each controller that has a margin on what it aims at sets that so that the
            expected level of the service that lacks most is ``min_service``, and another one so that no expected
            amount exceeds its budget; None: the margins are 1.
        futures: that ``scenario_mpc`` plans for; None: ``registry.FUTURES``.
        progress: called with what is being done and the share of all that is done.

    Raises:
        CirlError: for input that cannot be used, a controller that does not fit the network, or a solver that fails.
        RunError: if a run is incomplete, or of another environment.
    """
    for name, sequence in (("runs", runs), ("controllers", controllers)):
        if isinstance(sequence, str):
            raise CirlError(f"{name}: '{sequence}' is a text; a list is needed, as ['{sequence}']")
    if episodes is not None:
        whole_number("episodes", episodes, 2)  # of fewer there is no confidence interval
    if network is None and scenario is not None:
        raise CirlError(f"scenario '{scenario}' goes with a network; runs have their own")
    from cirl_marl.learners.interface import Trained  # it needs torch

    run_directories = [run if isinstance(run, RunDirectory) else RunDirectory(run) for run in runs]
    controls = controllers if "neutral" in controllers else ["neutral", *controllers]
    variant = None if network is None else load_network(network, scenario=scenario)
    prices = None
    if uncertain_bound is not None:
        prices, numbers = uncertain_bound.prices, uncertain_bound.draws_numbers
        min_service = uncertain_bound.min_service if min_service is None else min_service
        uncertain = numbers if uncertain is None else uncertain
    candidates, env = contenders(
        run_directories, controls, variant, min_service, uncertain, futures=futures, prices=prices, at_most=at_most
    )
    aims = aims_of(env.network, CIRCULARITY, at_most)
    demand = None if min_service is None else demanded_levels(env.network, min_service)
    if tune is not None:
        check_tuning(tune, demand)
        if not any(candidate.is_tunable for candidate in candidates):
            raise CirlError(f"tune {tune}: none of {list(controls)} has a margin; add one of {', '.join(TUNABLE)}")
    if uncertain_bound is not None:
        _check_bound(uncertain_bound, env, demand)
        episodes, seed = _draws_of(uncertain_bound, episodes, seed), uncertain_bound.sampling.seed
    adapts, first = episodes is None and bool(env.network.disturbed), first_seed(seed)
    episodes = enough_episodes(env.network) if episodes is None else episodes
    calibrations: list[Calibration | None] = [None] * len(candidates)
    if tune is not None and demand is not None:
        calibrations, progress = _tune(candidates, demand, aims, tune, progress), _after(progress, TUNING_SHARE)
    share = 1 / (len(candidates) + (len({who_acts.name for who_acts in candidates}) if bounds else 0))
    actors = [
        (contender, contender.controller(**({} if calibration is None else calibration.margins)))
        for contender, calibration in zip(candidates, calibrations, strict=True)
    ]
    checkpoints = [actor.checkpoint.name if isinstance(actor, Trained) else "" for _, actor in actors]
    rollouts, unclear = _play(actors, first, episodes, adapts=adapts, share=share, progress=progress)
    episodes, baseline = len(rollouts[0].circularity), Baseline()
    bounds_by_entry: list[Floats | None] = [None] * len(candidates)
    if bounds:
        first_env, done = candidates[0].env(episodes), len(candidates) * share
        starts, levels = starting_stocks(first_env, first), [run.episode_levels for run in rollouts]
        report = part_of(progress, "bounds", done, 1 - done)
        try:
            if not first_env.dynamics.factors.ranges:
                names = [who_acts.name for who_acts in candidates]
                baseline, bounds_by_entry = _certain_bounds(env, starts, names, levels, report)
            else:
                draws = [first_env.certain_network(i) for i in range(episodes)]
                bounds_by_entry = [*bounds_of_draws(draws, env.agents, starts, levels, progress=report)]
        except NoCertificate as missing:
            report(1.0)
            baseline = Baseline(reason=str(missing))
    rows = [*zip(candidates, checkpoints, rollouts, bounds_by_entry, calibrations, strict=True)]
    neutral = next(run for candidate, _, run, *_ in rows if candidate.run is None and candidate.name == "neutral")
    entries = []
    for candidate, checkpoint, run, bound, calibration in rows:
        training = candidate.name, candidate.seed, candidate.run, checkpoint
        entries.append(Entry(*training, run, gain(run, neutral), bound, uncertain_bound, calibration))
    ties_ = unclear if adapts else None
    return Comparison(env.network, env.agents, first, tuple(entries), baseline, ties_, demand)


def _tune(
    candidates: Sequence[Contender], demand: Floats, aims: Aims, draws: int, progress: ProgressReport
) -> list[Calibration | None]:
    """Return the margins of each that has one, set on other draws."""
    calibrations: list[Calibration | None] = [None] * len(candidates)
    share = TUNING_SHARE / len(candidates)
    for place, contender in enumerate(candidates):
        if contender.is_tunable:
            report = part_of(progress, f"{contender.name}, margin", place * share, share)
            budgets = aims if contender.has_budgets else NO_AIMS
            calibrations[place] = calibrate(contender.env, contender.controller, demand, draws, report, budgets)
    return calibrations


def _after(progress: ProgressReport, done: float) -> ProgressReport:
    """Return what takes the progress of all that follows on a share that is ``done``."""
    return lambda stage, share: progress(stage, done + (1 - done) * share)


def _check_bound(bound_: UncertainBound, env: MultiAgentVectorEnv, demand: Floats | None) -> None:
    """Refuse a bound for who does not foresee that is of something else than the episodes.

    Raises:
        CirlError: naming what differs.
    """
    agents, draws_numbers = bound_.agents or None, bound_.draws_numbers
    own = MultiAgentVectorEnv(bound_.network, num_envs=1, agents=agents, uncertain=draws_numbers)
    others = [*differences(env, own)]
    if bound_.initial is not None:
        others.append("starts drawn, not given")
    asked = "nothing" if bound_.min_service is None else levels_text(bound_.network, bound_.min_service)
    if demand is not None and (bound_.min_service is None or (bound_.min_service != demand).any()):
        others.append(f"service of {levels_text(env.network, demand)} demanded, not {asked}")
    if others:
        raise CirlError(f"uncertain_bound: the episodes are of something else than the bound: {'; '.join(others)}")


def _draws_of(bound_: UncertainBound, episodes: int | None, seed: int) -> int:
    """Return the number of draws of a bound for who does not foresee, which are the episodes."""
    draws, own_seed = len(bound_.values), bound_.sampling.seed
    if episodes not in (None, draws) or seed not in (0, own_seed):
        raise CirlError(
            f"uncertain_bound: its {draws} draws of seed {own_seed} are the episodes; leave out episodes ({episodes}) "
            f"and seed ({seed})"
        )
    return draws


def _play(
    actors: Sequence[tuple[Contender, Controller]],
    first: int,
    episodes: int,
    *,
    adapts: bool,
    share: float,
    progress: ProgressReport,
) -> tuple[list[Rollout], tuple[str, ...]]:
    """Return the episodes of each, with ``adapts`` as many as it takes, and which pairs they do not tell apart."""
    rollouts: list[Rollout] = []
    while True:
        done = len(rollouts[0].circularity) if rollouts else 0
        more = []
        for place, (contender, controller) in enumerate(actors):
            activity = f"{contender.name}, {episodes} more episodes" if done else contender.name
            report = part_of(progress, activity, place * share, share)
            run = rollout(contender.env(episodes), controller, seed=first + done, progress=report)
            more.append(concatenation(rollouts[place], run) if done else run)
        rollouts, by_row = more, dict[str, list[Rollout]]()
        for (contender, _), run in zip(actors, rollouts, strict=True):
            by_row.setdefault(contender.name, []).append(run)
        unclear = tuple(ties(actors[0][0].env(1).network, by_row)) if adapts else ()
        episodes = len(rollouts[0].circularity)
        if not unclear or 2 * episodes > MOST_EPISODES:
            return rollouts, unclear


def _certain_bounds(
    env: MultiAgentVectorEnv,
    starts: Floats,
    names: Sequence[str],
    levels: Sequence[Floats],
    progress: Callable[[float], None],
) -> tuple[Baseline, list[Floats | None]]:
    """Return the baseline of all rows, and the bounds of episodes with the ``levels`` of services of each entry."""
    services: dict[str, list[Floats]] = {}
    for name, levels_of_entry in zip(names, levels, strict=True):
        services.setdefault(name, []).append(levels_of_entry)
    means = [np.mean(samples, axis=0) for samples in services.values()]
    baseline = solve_baseline(
        env.network, env.agents, starts, means, progress=lambda share: progress(SOLVER_SHARE * share)
    )
    bounds: list[Floats | None] = []
    for levels_of_entry in levels:
        bounds.append(baseline.at(starts, levels_of_entry))
        progress(SOLVER_SHARE + (1 - SOLVER_SHARE) * len(bounds) / len(levels))
    return baseline, bounds


def part_of(progress: ProgressReport, activity: str, done: float, share: float) -> Callable[[float], None]:
    """Return what takes the part that is done of something that makes up a ``share`` of all and follows on ``done``."""
    progress(activity, done)
    return lambda part: progress(activity, done + share * min(1.0, part))
