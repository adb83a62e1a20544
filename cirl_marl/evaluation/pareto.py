"""Service against circularity: what is possible, what plans achieve, and where learners with other weights end up."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from cirl_marl.definitions.catalogue import load_network
from cirl_marl.environments.rewards import CIRCULARITY_REWARDS
from cirl_marl.environments.vector import MultiAgentVectorEnv
from cirl_marl.errors import CirlError, RunError, whole_number
from cirl_marl.evaluation import compare
from cirl_marl.evaluation.baselines import FRONT
from cirl_marl.evaluation.comparison import ProgressReport, part_of
from cirl_marl.evaluation.contenders import differences
from cirl_marl.jobs import JobStatus, Tell, check_place, raise_first, run_jobs
from cirl_marl.learners.recipe import Recipe, load_recipe
from cirl_marl.learners.run_directory import RunDirectory
from cirl_marl.network import Floats, Network
from cirl_marl.network.declarations import positional_record
from cirl_marl.optimum import Bound, Envelope, NoCertificate, bound, improve_plan, simulate_plan
from cirl_marl.optimum.bounds import highest_service
from cirl_marl.optimum.mpc import SERVICE_FIRST


@dataclass(frozen=True, slots=True, kw_only=True)
class Point:
    """A point in the plane of service and λ̄: a ``bound``, ``plan``, ``trained`` or ``neutral``.

    The service is the mean level of the service that lacks most. Of a bound, it is demanded of every service, and λ̄ is
    the highest with this level or more. ``weight`` is the circularity weight, and ``seed`` the training seed, of what
    was trained.
    """

    kind: str
    service: float
    circularity: float
    weight: float | None = None
    seed: int | None = None


@positional_record
class ParetoFront:
    """All points of a network."""

    network: Network
    recipe: Annotated[Recipe | None, "what was trained; None for nothing"]
    points: tuple[Point, ...]
    runs: tuple[RunDirectory, ...] = ()
    reason: Annotated[str, "why there is no bound; empty if there is"] = ""
    front: Annotated[
        Floats, "levels of every service and what the multipliers of all bounds prove there, shape (levels, 2)"
    ] = field(default_factory=lambda: np.empty((0, 2)))

    def of(self, kind: str) -> list[Point]:
        """Return the points of one kind."""
        return [point for point in self.points if point.kind == kind]


def pareto_front(
    network: str | Path | Network,
    recipe: str | Path | Recipe | None = None,
    *,
    directory: str | Path,
    scenario: str | None = None,
    points: int = 5,
    seeds: int = 1,
    steps: int | None = None,
    episodes: int = 16,
    on: str = "here",
    workers: int | None = None,
    progress: ProgressReport = lambda activity, share: None,
) -> ParetoFront:
    """Vary the weight between circularity and service, and return what comes of each.

    The bound and its plans start in the middle of all initial ranges. They demand the same mean level of every service,
    from the least that the highest circularity leaves one to the most that all can have at once. Learners are trained
    with circularity weights from 0 to 1, in ``directory/runs``, which stay as they are; the checkpoint that counts is
    the one that is paid most. A finished run there is not repeated, an interrupted one goes on.

    Args:
        network: catalogue name, definition file, or network.
        recipe: what to train; None for nothing.
        directory: where runs are kept.
        scenario: scenario of the definition; None is the default.
        points: how many service levels and weights, at least 2.
        seeds: training seeds 0, 1, … of each weight.
        steps: environment steps of each training; None is the recipe's.
        episodes: fresh episodes on which each policy is evaluated.
        on: where learners are trained: ``here``, ``local``, ``slurm`` or ``ray``, see ``jobs.run_jobs``.
        workers: how many are trained at a time; None is all that the place has.
        progress: as for ``compare``.

    Raises:
        CirlError: for input that cannot be used, or a reward in which the weight has no part.
        NoCertificate: if there is no bound and nothing to train either.
        RunError: if ``directory`` holds the runs of something else, or a training fails elsewhere.
    """
    directory = Path(directory)
    check_place(on, workers)
    whole_number("points", points, 2)
    whole_number("seeds", seeds, 1)
    definition = load_network(network, scenario=scenario)
    recipe_ = _without_service_price(load_recipe(recipe) if isinstance(recipe, str | Path) else recipe)
    if recipe_ is not None:
        _check_fit(definition, recipe_)
    jobs: list[_TrainingJob] = []
    if recipe_ is not None:
        weights = [(place / (points - 1), seed) for place in range(points) for seed in range(seeds)]
        jobs = [_TrainingJob(definition, recipe_, weight, seed, steps, directory / "runs") for weight, seed in weights]
        for job in jobs:
            job.check()
    share = points / (points + len(jobs))
    reason = ""
    possible: tuple[Point, ...] = ()
    front = np.empty((0, 2))
    try:
        possible, front = _possible(definition, points, lambda activity, part: progress(activity, part * share))
    except NoCertificate as missing:
        if recipe_ is None:
            raise
        reason, share = str(missing), 0.0
    if recipe_ is None:
        return ParetoFront(definition, None, possible, front=front)

    def watch(statuses: Sequence[JobStatus]) -> None:
        busy = [job.name for job in statuses if job.state == "running"]
        done = sum(job.share for job in statuses) / len(statuses)
        progress(f"training {', '.join(busy)}", share + (1 - share) * done)

    raise_first(run_jobs(jobs, directory / "runs" / "jobs", on=on, workers=workers, watch=watch))
    runs = [job.directory for job in jobs]
    return ParetoFront(definition, recipe_, (*possible, *_policy_points(runs, episodes)), tuple(runs), reason, front)


@dataclass(frozen=True, slots=True)
class _TrainingJob:
    """A training run of a sweep, as a job."""

    network: Network
    recipe: Recipe
    weight: float
    seed: int
    steps: int | None
    folder: Path

    @property
    def name(self) -> str:
        """Name of its directory."""
        return f"{self.recipe.name}-weight{self.weight:.6g}-seed{self.seed}"

    @property
    def directory(self) -> RunDirectory:
        """The run."""
        return RunDirectory(self.folder / self.name)

    @property
    def _is_begun(self) -> bool:
        return (self.directory.path / "config.json").is_file()

    def is_done(self) -> bool:
        """Return whether the run is complete."""
        return self._is_begun and self.directory.status["state"] == "complete"

    def run(self, tell: Tell) -> None:
        """Train, or go on training."""
        from cirl_marl.learners.interface import complete_run  # it needs torch

        options: dict[str, Any] = {"steps": self.steps, "seed": self.seed, "circularity_weight": self.weight}
        options["report"] = lambda now: tell("training", now.env_steps, max(now.total, 1))
        complete_run(self.directory.path, self.network, self.recipe, **options)

    def check(self) -> None:
        """Refuse a run that is there and answers another question."""
        if not self._is_begun:
            return
        config = self.directory.config
        steps = self.recipe.run.steps if self.steps is None else self.steps
        mismatches = list(differences(self.directory.make_env(1), _env(self.network, self.recipe)))
        mismatches += [f"{config.steps} steps, not {steps}"] if config.steps != steps else []
        mismatches += ["another recipe of this name"] if config.recipe != self.recipe else []
        if mismatches:
            path = self.directory.path
            raise RunError(f"{path}: is of another sweep ({'; '.join(mismatches)}); choose another folder")


def _without_service_price(recipe: Recipe | None) -> Recipe | None:
    """Return a recipe without a demanded service and its price, as what is swept must not move."""
    if recipe is None:
        return None
    overrides = {"min_service": None, "price_rate": 0.0, "price_damping": 0.0}
    return recipe.model_copy(update={"run": recipe.run.model_copy(update=overrides)})


def _env(network: Network, recipe: Recipe) -> MultiAgentVectorEnv:
    options = {name: value for name, value in recipe.environment.items() if name != "scenario"}
    return MultiAgentVectorEnv(network, num_envs=1, **options)


def _check_fit(network: Network, recipe: Recipe) -> None:
    scenario = recipe.environment.get("scenario", network.scenario_name)
    if scenario != network.scenario_name:
        other = f"the sweep for '{network.scenario_name}': ask for one"
        raise CirlError(f"recipe '{recipe.name}' is for scenario '{scenario}', {other}")
    if recipe.run.at_most:
        reason = f"recipe '{recipe.name}': run.at_most: {', '.join(recipe.run.at_most)}"
        raise CirlError(
            f"{reason}: no price moves while weights are compared, so that nobody keeps budgets; leave it out"
        )
    env = _env(network, recipe)
    recipe.check_agents(env.agents)
    if env.reward_mode not in CIRCULARITY_REWARDS:
        raise CirlError(
            f"recipe '{recipe.name}' is paid by '{env.reward_mode}', in which the weight of circularity has no part; "
            f"choose one that is paid by {', '.join(CIRCULARITY_REWARDS)}"
        )


def _possible(network: Network, points: int, progress: ProgressReport) -> tuple[tuple[Point, ...], Floats]:
    """Return bounds by demanded service, what their improved plans do in the simulator, and the front they prove."""
    results: list[Point] = []
    bounds: list[Bound] = []
    progress("bounds and plans", 0.0)
    least = float(bound(network, service_weight=1 / SERVICE_FIRST).levels.min(initial=1.0))
    most = highest_service(network)
    for place, level in enumerate(_levels(least, most, points)):
        solution = bound(network, min_service=level, near=bounds[-1] if bounds else None)
        bounds.append(solution)
        results.append(Point(kind="bound", service=level, circularity=solution.objective))
        report = part_of(progress, "bounds and plans", place / points, 1 / points)
        episode = simulate_plan(improve_plan(solution, progress=report))
        service, circularity = float(episode.least_service[0]), float(episode.episode_circularity[0])
        results.append(Point(kind="plan", service=service, circularity=circularity))
    levels = np.linspace(least, most, FRONT)
    return tuple(results), np.stack([levels, Envelope(tuple(bounds)).at(min_service=levels[:, None])], axis=1)


def _levels(least: float, most: float, points: int) -> list[float]:
    """Return service levels from least to most, rounded down a little so that the most can be had.

    >>> _levels(0.12349, 0.98769, 3)
    [0.1234, 0.5555, 0.9876]
    """
    levels: Floats = np.linspace(least, most, points)
    return sorted({math.floor(level * 1e4) / 1e4 for level in levels.tolist()})


def _policy_points(runs: Sequence[RunDirectory], episodes: int) -> Iterator[Point]:
    for entry in compare(runs, ["neutral"], episodes=episodes, bounds=False).entries:
        run, kind = entry.run, "neutral" if entry.run is None else "trained"
        service, circularity = float(entry.rollout.least_service.mean()), float(entry.circularity.mean())
        weight = None if run is None else run.config.options["circularity_weight"]
        yield Point(kind=kind, service=service, circularity=circularity, weight=weight, seed=entry.seed)
